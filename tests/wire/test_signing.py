"""Signatures: keys whose repr hides them, frames beside pymavlink's, and what is refused."""

from __future__ import annotations

import base64
import copy
import pickle
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect

from paramclient.errors import UsageError
from paramclient.wire.frames import Framer, checksum, sign_frame
from paramclient.wire.messages import Message, ParamRequestRead, ParamValue, SetupSigning, decode, encode
from paramclient.wire.signing import (
    ADOPTED_TIMESTAMP_MAX,
    TIMESTAMP_LAG_MAX,
    UNITS_PER_SECOND,
    Refusal,
    Signer,
    SigningKey,
    SigningPolicy,
    Verifier,
)

SECRET = bytes(range(1, 33))
KEY = SigningKey(SECRET)
OTHER_KEY = SigningKey(bytes(range(2, 34)))
NOW = 36_000_000_000_000
"""A timestamp of our days."""
VALUE = ParamValue("MC_ROLL_P", struct.pack("<f", 6.5), 9, 903, 441)

byte = st.integers(0, 255)
timestamps = st.integers(TIMESTAMP_LAG_MAX, ADOPTED_TIMESTAMP_MAX)


def signed_frame(
    message: Message = VALUE,
    *,
    key: SigningKey = KEY,
    timestamp: int = NOW,
    link_id: int = 0,
    system: int = 1,
    component: int = 1,
) -> bytes:
    """A frame with just this timestamp."""
    frame = encode(message, system=system, component=component, sequence=0)
    return sign_frame(frame, Signer(key, link_id=link_id, timestamp=timestamp - 1))


def a_verifier(
    policy: SigningPolicy = SigningPolicy.SIGNED_ONLY, *, timestamp: int = NOW, most_streams: int = 100
) -> Verifier:
    return Verifier(Signer(KEY, timestamp=timestamp), policy, most_streams=most_streams)


def pymavlink(*, key: bytes = SECRET, system: int = 7, timestamp: int = NOW, link_id: int = 5) -> Any:
    """pymavlink as one end of a signed link."""
    mav = dialect.MAVLink(None, system, 8)
    mav.robust_parsing = True
    mav.signing.secret_key = key
    mav.signing.timestamp = timestamp
    mav.signing.link_id = link_id
    mav.signing.sign_outgoing = True
    return mav


def names(messages: Any) -> list[str]:
    return [message.get_type() for message in messages or ()]


# Keys


def test_a_key_has_32_bytes_that_are_not_all_zero() -> None:
    for secret in (b"", SECRET[:31], SECRET + b"\1"):
        with pytest.raises(UsageError, match=f"32 bytes, not {len(secret)}"):
            SigningKey(secret)
    with pytest.raises(UsageError, match="zeros"):
        SigningKey(bytes(32))


def test_a_key_is_given_as_hexadecimal_digits_base64_or_a_passphrase() -> None:
    assert SigningKey.from_text(SECRET.hex()) == KEY
    assert SigningKey.from_text(f"  {SECRET.hex().upper()}\n") == KEY
    assert SigningKey.from_text(base64.b64encode(SECRET).decode() + "\n") == KEY
    by_sha256sum = "6fe4c3d21fca2f875413ac97a5432e4b3e3fd44974c0c816742c6851bdd7dff3"
    assert SigningKey.from_passphrase("Schlüssel ✈") == SigningKey.from_text(by_sha256sum)
    with pytest.raises(UsageError, match="empty"):
        SigningKey.from_passphrase("")


@pytest.mark.parametrize(
    "text",
    ["", "secret", "z" * 64, SECRET.hex()[:-1], SECRET.hex() + "0", "!" * 44, "é" * 64, "ab " * 21 + "c"],
)
def test_an_invalid_key_is_refused_without_printing_it(text: str) -> None:
    with pytest.raises(UsageError, match="64 hexadecimal digits") as caught:
        SigningKey.from_text(text)
    assert not text or text not in str(caught.value)
    assert caught.value.__context__ is None


def test_the_repr_of_a_key_does_not_show_it() -> None:
    forms = [SECRET, SECRET.hex().encode(), base64.b64encode(SECRET), repr(SECRET)[2:-1].encode()]
    for holder in (KEY, SetupSigning(1, 1, KEY, NOW), Signer(KEY, timestamp=NOW), a_verifier()):
        assert not any(form in f"{holder}{holder!r}{holder!a}".encode() for form in forms)
    assert not hasattr(KEY, "__dict__")
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        with pytest.raises(TypeError, match="not pickled"):
            pickle.dumps(KEY, protocol)
    assert copy.copy(KEY) is copy.deepcopy(KEY) is KEY


# Beside pymavlink


@given(timestamp=timestamps, link_id=byte, more=st.lists(st.integers(0, 10_000_000), max_size=5))
def test_pymavlink_takes_what_we_sign_and_reversely(timestamp: int, link_id: int, more: list[int]) -> None:
    signer = Signer(KEY, link_id=link_id, timestamp=timestamp)
    theirs = pymavlink(timestamp=timestamp, link_id=link_id)
    verifier = Verifier(Signer(KEY, timestamp=timestamp), SigningPolicy.SIGNED_ONLY)
    framer = Framer()
    framer.guard = verifier.accepts
    for count, pause in enumerate(more, start=1):
        signer.catch_up(signer.timestamp + pause)
        frame = sign_frame(encode(VALUE, system=1, component=1, sequence=0), signer)
        assert names(theirs.parse_buffer(frame)) == ["PARAM_VALUE"]
        answer = dialect.MAVLink_param_request_read_message(1, 1, b"MC_ROLL_P", -1).pack(theirs)
        (got,) = framer.receive(answer)
        assert decode(got) == ParamRequestRead(1, 1, "MC_ROLL_P")
        assert verifier.report().signed == count
    assert theirs.signing.badsig_count == 0


def test_frames_are_refused_as_by_pymavlink() -> None:
    """Frame after frame, good and bad: the judgement is the same."""
    good = signed_frame(timestamp=NOW + 10)
    frames = [
        good,
        good,
        signed_frame(timestamp=NOW + 9),
        signed_frame(timestamp=NOW + 11),
        signed_frame(timestamp=NOW, system=2),
        signed_frame(timestamp=NOW + 11 - TIMESTAMP_LAG_MAX, system=3),
        signed_frame(timestamp=NOW + 10 - TIMESTAMP_LAG_MAX, system=4),
        signed_frame(timestamp=NOW + 20, link_id=3),
        signed_frame(timestamp=NOW + 30, key=OTHER_KEY, system=5),
        encode(VALUE, system=6, component=1, sequence=0),
        encode(VALUE, system=6, component=1, sequence=0, version=1),
    ]
    # its clock, unlike ours, has not begun to run: both stand at the last timestamp that they have received
    verifier = a_verifier(timestamp=NOW)
    theirs = pymavlink(timestamp=NOW)
    judged = [verifier.accepts(frame) for frame in frames]
    assert judged == [names(theirs.parse_buffer(frame)) == ["PARAM_VALUE"] for frame in frames]
    assert judged == [True, False, False, True, True, True, False, True, False, False, False]


# What is sent


def test_the_timestamp_rises_from_frame_to_frame_and_with_the_time() -> None:
    signer = Signer(KEY, link_id=9, timestamp=NOW)
    frame = encode(VALUE, system=1, component=1, sequence=0)

    def used() -> int:
        signed = sign_frame(frame, signer)
        assert signed[-13] == 9
        assert len(signed) == len(frame) + 13
        return int.from_bytes(signed[-12:-6], "little")

    assert [used(), used()] == [NOW + 1, NOW + 2]
    signer.advance(50.0)
    assert used() == NOW + 3
    signer.advance(51.0)
    assert used() == NOW + UNITS_PER_SECOND + 1
    signer.advance(50.5)
    assert used() == NOW + UNITS_PER_SECOND + 2
    signer.catch_up(NOW + 5 * UNITS_PER_SECOND)
    assert used() == NOW + 5 * UNITS_PER_SECOND + 1
    signer.advance(52.0)
    assert used() == NOW + 5 * UNITS_PER_SECOND + 2


# What is refused


@given(data=st.data())
def test_no_changed_byte_passes(data: st.DataObject) -> None:
    """A forger can put the checksum right; not the signature."""
    frame = bytearray(signed_frame())
    at = data.draw(st.sampled_from([n for n in range(3, len(frame)) if n not in (7, 8, 9)]))
    frame[at] ^= data.draw(st.integers(1, 255))
    crc = checksum(22, bytes(frame[1:-15]))
    assert crc is not None
    frame[-15:-13] = crc.to_bytes(2, "little")
    framer = Framer()
    verifier = a_verifier()
    framer.guard = verifier.accepts
    if at not in (len(frame) - 15, len(frame) - 14):  # the checksum itself, which was put right
        assert framer.receive(bytes(frame)) == []
        assert verifier.report().refused == {Refusal.BAD_SIGNATURE: 1}
        assert verifier.report().streams == ()


def test_a_forged_frame_does_not_move_our_timestamp_nor_its_streams() -> None:
    signer = Signer(KEY, timestamp=NOW)
    verifier = Verifier(signer)
    assert not verifier.accepts(signed_frame(key=OTHER_KEY, timestamp=NOW + 1_000_000))
    assert signer.timestamp == NOW
    assert verifier.accepts(signed_frame(timestamp=NOW + 1))
    assert not verifier.accepts(signed_frame(timestamp=NOW + 1))
    assert verifier.report().refused == {Refusal.BAD_SIGNATURE: 1, Refusal.REPLAYED: 1}


def test_a_stream_begins_at_most_a_minute_behind_us_and_may_fall_behind_later() -> None:
    signer = Signer(KEY, timestamp=NOW)
    verifier = Verifier(signer)
    signer.advance(0.0)
    signer.advance(60.0)
    assert not verifier.accepts(signed_frame(timestamp=NOW - 1))
    assert verifier.accepts(signed_frame(timestamp=NOW))
    signer.advance(600.0)
    assert verifier.accepts(signed_frame(timestamp=NOW + 1))
    assert verifier.report().refused == {Refusal.OLD: 1}


@pytest.mark.parametrize("missing", range(1, 14))
def test_a_cut_off_signature_is_refused_and_counted(missing: int) -> None:
    verifier = a_verifier(SigningPolicy.ACCEPT_ALL)
    framer = Framer(stream=False)
    framer.guard = verifier.accepts
    assert framer.receive(signed_frame()[:-missing]) == []
    assert verifier.report().refused == {Refusal.TRUNCATED: 1}
    assert len(framer.receive(signed_frame())) == 1


def test_to_accept_all_is_to_accept_what_is_wrong_and_to_count_it() -> None:
    signer = Signer(KEY, timestamp=NOW)
    verifier = Verifier(signer, SigningPolicy.ACCEPT_ALL)
    assert verifier.accepts(signed_frame())
    assert verifier.accepts(signed_frame())
    assert verifier.accepts(signed_frame(key=OTHER_KEY, timestamp=NOW + 999))
    report = verifier.report()
    assert (report.signed, report.unsigned, report.refused) == (1, 0, {})
    assert report.unproven == {Refusal.REPLAYED: 1, Refusal.BAD_SIGNATURE: 1}
    assert signer.timestamp == NOW, "what is not proven moves nothing"
