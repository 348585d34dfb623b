"""Signatures: keys whose repr hides them, frames beside pymavlink's, what is refused, and signed sessions."""

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
from paramclient.protocol.station import Station
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, Vehicle
from paramclient.wire import frames, messages
from paramclient.wire.frames import Framer, sign_frame
from paramclient.wire.messages import (
    TIMESTAMP_LAG_MAX,
    Message,
    ParamRequestRead,
    ParamValue,
    SetupSigning,
    encode,
)
from paramclient.wire.signing import (
    ADOPTED_TIMESTAMP_MAX,
    UNITS_PER_SECOND,
    Refusal,
    Signer,
    SigningKey,
    SigningPolicy,
    Verifier,
)
from tests.shell import VALUES, small_px4
from tests.simulation import PEER, Simulation

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
    shown = [repr(KEY), str(KEY), f"{KEY}", f"{KEY!a}", repr(SetupSigning(1, 1, KEY, NOW)), KEY.fingerprint]
    shown += [repr(Signer(KEY, timestamp=NOW)), repr(a_verifier()), repr(a_verifier().report())]
    for text in shown:
        assert not any(form in text.encode() for form in forms)
    assert not hasattr(KEY, "__dict__")
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        with pytest.raises(TypeError, match="not pickled"):
            pickle.dumps(KEY, protocol)
    assert copy.copy(KEY) is copy.deepcopy(KEY) is KEY


# Beside pymavlink


@given(
    timestamp=timestamps,
    link_id=byte,
    sequence=byte,
    system=st.integers(1, 255),
    component=st.integers(1, 255),
    payload=st.binary(min_size=2, max_size=2),
)
def test_our_signatures_are_pymavlinks(
    timestamp: int, link_id: int, sequence: int, system: int, component: int, payload: bytes
) -> None:
    message = messages.ParamRequestList(*payload)
    frame = encode(message, system=system, component=component, sequence=sequence)
    ours = sign_frame(frame, Signer(KEY, link_id=link_id, timestamp=timestamp - 1))
    mav = pymavlink(system=system, timestamp=timestamp, link_id=link_id)
    mav.srcComponent = component
    mav.seq = sequence
    assert ours == dialect.MAVLink_param_request_list_message(*payload).pack(mav)


@given(timestamp=timestamps, link_id=byte, more=st.lists(st.integers(0, 10_000_000), max_size=5))
def test_pymavlink_takes_what_we_sign_and_we_what_it_signs(
    timestamp: int, link_id: int, more: list[int]
) -> None:
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
        assert messages.decode(got) == ParamRequestRead(1, 1, "MC_ROLL_P")
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
    crc = frames.checksum(22, bytes(frame[1:-15]))
    assert crc is not None
    frame[-15:-13] = crc.to_bytes(2, "little")
    framer = Framer()
    verifier = a_verifier()
    framer.guard = verifier.accepts
    if at not in (len(frame) - 15, len(frame) - 14):  # the checksum itself, which was put right
        assert framer.receive(bytes(frame)) == []
        assert verifier.report().refused == {Refusal.BAD_SIGNATURE: 1}
        assert verifier.report().streams == ()


def test_every_stream_has_its_own_timestamps() -> None:
    verifier = a_verifier()
    for number, place in enumerate([(1, 1, 0), (2, 1, 0), (1, 2, 0), (1, 1, 1)]):
        system, component, link_id = place
        frame = signed_frame(timestamp=NOW - number, system=system, component=component, link_id=link_id)
        assert verifier.accepts(frame)
        assert not verifier.accepts(frame)
    report = verifier.report()
    assert [(s.system, s.component, s.link_id, s.timestamp) for s in report.streams] == [
        (1, 1, 0, NOW),
        (1, 1, 1, NOW - 3),
        (1, 2, 0, NOW - 2),
        (2, 1, 0, NOW - 1),
    ]
    assert (report.signed, report.refused) == (4, {Refusal.REPLAYED: 4})


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


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("number", [109, 166, 0, 22])
@pytest.mark.parametrize("policy", SigningPolicy)
def test_unsigned_frames_that_each_policy_accepts(policy: SigningPolicy, number: int, version: int) -> None:
    frame = frames.build_frame(number, b"\1" * 9, system=51, component=68, sequence=0, version=version)
    verifier = a_verifier(policy)
    is_radio = number in (109, 166) and policy is SigningPolicy.UNSIGNED_RADIOS
    is_taken = is_radio or policy is SigningPolicy.ACCEPT_ALL
    assert verifier.accepts(frame) is is_taken
    assert verifier.report().unsigned == is_taken
    assert verifier.report().refused == ({} if is_taken else {Refusal.UNSIGNED: 1})


@given(chunk=st.integers(1, 60), wanted=st.booleans())
def test_a_guarded_framer_finds_what_another_finds(chunk: int, wanted: bool) -> None:
    """Where the guard lets all pass it changes nothing, signed or not, of either version."""
    frames = [
        signed_frame(),
        encode(VALUE, system=1, component=1, sequence=4, version=1),
        encode(messages.Heartbeat(2, 12), system=1, component=1, sequence=5),
        signed_frame(messages.StatusText(6, "\xfd\xfe" * 9)),
    ]
    stream = b"noise\xfd".join(frames)
    plain, guarded = Framer([22] if wanted else None), Framer([22] if wanted else None)
    seen: list[bytes] = []

    def take(frame: bytes) -> bool:
        seen.append(frame)
        return True

    guarded.guard = take
    pieces = [stream[at : at + chunk] for at in range(0, len(stream), chunk)]
    assert [guarded.receive(piece) for piece in pieces] == [plain.receive(piece) for piece in pieces]
    assert guarded.flush() == plain.flush()
    assert seen == frames, "the guard is called for each frame, wanted or not"
    assert (guarded.frames, guarded.skipped) == (plain.frames, plain.skipped)


# Sessions


def a_station(
    key: SigningKey | None = KEY,
    policy: SigningPolicy = SigningPolicy.UNSIGNED_RADIOS,
    *,
    timestamp: int = NOW,
    is_stream: bool = False,
) -> Station:
    station = Station(link="sim:test", is_stream=is_stream)
    if key is not None:
        signer = Signer(key, timestamp=timestamp)
        station.begin_signing(signer, Verifier(signer, policy))
    return station


VEHICLES: list[Any] = [
    lambda **options: small_px4(**options),
    lambda **options: ArduPilotVehicle(table=VALUES, **options),
    lambda **options: ArduPilotVehicle(table=VALUES, ftp=False, **options),
    lambda **options: GenericVehicle(table=VALUES, **options),
]
EVERY_VEHICLE = pytest.mark.parametrize("make", VEHICLES, ids=["px4", "ardupilot", "by list", "generic"])


@EVERY_VEHICLE
@pytest.mark.parametrize("policy", SigningPolicy)
def test_a_signed_session(make: Any, policy: SigningPolicy) -> None:
    vehicle: Vehicle = make(signing_key=KEY)
    simulation = Simulation(vehicle, station=a_station(policy=policy))
    result = simulation.fetch()
    assert result.complete
    assert {name: param.value for name, param in result.params.items()} == vehicle.values
    assert simulation.set("PARAM_04", 77).actual == 77
    assert simulation.get("PARAM_04").value == vehicle.param("PARAM_04").value == 77
    assert simulation.station.verifier is not None
    report = simulation.station.verifier.report()
    assert report.signed > 5
    assert report.unsigned == 0
    theirs = vehicle.signing_report
    assert theirs is not None
    assert (theirs.signed >= 3, theirs.refused) == (True, {})


@EVERY_VEHICLE
def test_frames_without_the_key_are_refused(make: Any) -> None:
    vehicle: Vehicle = make(signing_key=KEY)
    simulation = Simulation(vehicle, station=a_station(OTHER_KEY))
    simulation.run(5.0)
    assert simulation.station.components == {}
    assert simulation.station.verifier is not None
    assert simulation.station.verifier.report().refused.keys() == {Refusal.BAD_SIGNATURE}
    assert vehicle.requests == {}


def test_a_vehicle_with_a_key_does_not_respond_without_it() -> None:
    vehicle = small_px4(signing_key=KEY)
    simulation = Simulation(vehicle, station=a_station(None))
    simulation.run(5.0)
    assert simulation.machine.table.params == {}
    assert vehicle.requests == {}, "it sees no request, and we take its frames, unproven"
    assert vehicle.signing_report is not None
    assert vehicle.signing_report.refused.keys() == {Refusal.UNSIGNED}


def test_a_vehicle_with_old_timestamps_takes_ours_and_is_accepted() -> None:
    """A clock that was never set; our heartbeat brings it to our time."""
    vehicle = small_px4(signing_key=KEY, signing_timestamp=1)
    simulation = Simulation(vehicle, station=a_station())
    assert simulation.fetch().complete
    assert simulation.station.verifier is not None
    report = simulation.station.verifier.report()
    assert report.refused.keys() == {Refusal.OLD}
    assert report.streams[0].timestamp > NOW


def test_frames_of_a_vehicle_that_starts_again_are_accepted_again() -> None:
    vehicle = small_px4(signing_key=KEY)
    simulation = Simulation(vehicle, station=a_station())
    simulation.fetch()
    vehicle.reboot(simulation.now, down=2.0)
    simulation.run(6.0)
    assert simulation.set("PARAM_04", 5).actual == 5


def test_replayed_frames_change_nothing() -> None:
    vehicle = ArduPilotVehicle(table=VALUES, ftp=False, signing_key=KEY)
    simulation = Simulation(vehicle, station=a_station())
    simulation.fetch()
    recorded: list[bytes] = []

    class Recorder(Air):
        def data_to_send(self) -> list[bytes]:
            data = super().data_to_send()
            recorded.extend(data)
            return data

    simulation.air = Recorder([vehicle])
    simulation.set("PARAM_04", 40)
    simulation.set("PARAM_04", 41)
    before = simulation.station.verifier
    assert before is not None
    refused = before.report().refused.get(Refusal.REPLAYED, 0)
    for frame in recorded:
        simulation.station.receive(frame, PEER, simulation.now)
    assert simulation.machine.table.params["PARAM_04"].value == 41
    assert before.report().refused[Refusal.REPLAYED] == refused + len(recorded)


def test_a_forged_value_gets_into_no_table() -> None:
    simulation = Simulation(small_px4(signing_key=KEY), station=a_station())
    simulation.fetch()
    table = dict(simulation.machine.table.params)
    forged = ParamValue("PARAM_04", struct.pack("<i", 666), 6, len(table), table["PARAM_04"].index or 0)
    stripped = encode(forged, system=1, component=1, sequence=0)
    for frame in (
        stripped,
        encode(forged, system=1, component=1, sequence=0, version=1),
        signed_frame(forged, key=OTHER_KEY, timestamp=NOW * 2),
        signed_frame(forged, timestamp=NOW * 2)[:-1],
    ):
        assert not simulation.station.receive(frame, PEER, simulation.now)
    assert simulation.machine.table.params == table
    assert simulation.station.receive(signed_frame(forged, timestamp=NOW * 2), PEER, simulation.now)
    assert simulation.machine.table.params["PARAM_04"].value == 666


@EVERY_VEHICLE
def test_a_vehicle_obeys_setup_signing(make: Any) -> None:
    vehicle: Vehicle = make()
    simulation = Simulation(vehicle, station=a_station(None))
    simulation.meet()
    simulation.station.send_setup_signing(1, 1, KEY, NOW)
    simulation.run(1.0)
    assert vehicle.signing_key == KEY
    assert vehicle.requests["SETUP_SIGNING"] == 1
    simulation.station.send_setup_signing(1, 1, OTHER_KEY, NOW)
    simulation.station.send_setup_signing(1, 1, None, 0)
    simulation.run(1.0)
    assert vehicle.signing_key == KEY, "what is not signed is not for it any more"
    simulation.next_session(a_station(timestamp=NOW + TIMESTAMP_LAG_MAX))
    assert simulation.fetch().complete
    simulation.station.send_setup_signing(1, 1, None, 0)
    simulation.run(1.0)
    assert is_unsigned(vehicle)
    simulation.next_session(a_station(None))
    assert simulation.fetch().complete


def is_unsigned(vehicle: Vehicle) -> bool:
    return vehicle.signing_key is None and vehicle.signing_report is None
