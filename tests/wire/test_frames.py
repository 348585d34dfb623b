"""The wire: messages beside pymavlink's packer and parser, frames out of streams, datagrams and noise."""

from __future__ import annotations

import random
import struct
from dataclasses import fields
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect
from pymavlink.generator.mavcrc import x25crc_slow

from paramclient.wire import messages
from paramclient.wire.frames import BOOT_CLOCK_OFFSETS, Frame, Framer, find_magic, message_name
from paramclient.wire.messages import DECODED_IDS, Message, decode, encode, message_id
from paramclient.wire.signing import SigningKey
from tests.recordings import NAMES, read

FRAME_SIZE_MAX = 280
"""Bytes of the longest frame: 10 of header, 255 of payload, 2 of checksum, 13 of signature."""

thorough = settings(max_examples=100, deadline=None)


class Packer:
    """pymavlink as a sender: system 7, component 8."""

    def __init__(self, *, signed: bool = False) -> None:
        self.mav = dialect.MAVLink(None, 7, 8)
        if signed:
            self.mav.signing.secret_key = bytes(range(32))
            self.mav.signing.link_id = 5
            self.mav.signing.sign_outgoing = True

    def __call__(self, message: Any, *, version: int = 2, sequence: int = 0) -> bytes:
        self.mav.seq = sequence
        packed: bytes = message.pack(self.mav, force_mavlink1=version == 1)
        return packed


pack = Packer()
pack_signed = Packer(signed=True)


def message_of(kind: Any, payload: bytes) -> Any:
    """A pymavlink message whose fields have these bytes on the wire."""
    on_wire = list(kind.unpacker.unpack(payload))
    fields = {}
    for name, length in zip(kind.ordered_fieldnames, kind.lengths, strict=True):
        is_array = length > 1 and not isinstance(on_wire[0], bytes)
        fields[name] = [on_wire.pop(0) for _ in range(length)] if is_array else on_wire.pop(0)
    return kind(**fields)


def bare_frame(number: int, payload: bytes, *, version: int = 2, flags: int = 0, extra: int = 0) -> bytes:
    """A frame of any payload, flags and id. `extra` is the checksum's seed for an id that is not known."""
    kind = dialect.mavlink_map.get(number)
    if version == 1:
        body = bytes((len(payload), 0, 7, 8, number)) + payload
    else:
        body = bytes((len(payload), flags, 0, 0, 7, 8)) + number.to_bytes(3, "little") + payload
    crc = x25crc_slow(body + bytes((kind.crc_extra if kind else extra,))).crc
    return bytes((0xFE if version == 1 else 0xFD,)) + body + struct.pack("<H", crc)


def one_frame(data: bytes) -> Frame:
    (frame,) = Framer(stream=False).receive(data)
    return frame


def take(framer: Framer, chunks: list[bytes]) -> list[Frame]:
    """All parsed frames, with a flush at the end."""
    return [frame for chunk in chunks for frame in framer.receive(chunk)] + framer.flush()


# Messages

NAME = "SIXTEEN_LETTERS_"
PACKED_FLOAT = struct.pack("<f", 6.5)
SENT: list[Message] = [
    messages.Heartbeat(2, 12, 81, 0x01020304, 4, 3),
    messages.AutopilotVersion(
        64495, 0x01110040, b"git hash", 9, 10, 11, 0xFEDCBA9876543210, b"eighteen bytes uid"
    ),
    messages.CommandLong(1, 2, 512, 148.0, 0.5, 0.0, -1.0, 0.0, 0.0, 3.0, 1),
    messages.CommandAck(512, 3, 255, 190),
    messages.ParamRequestRead(1, 2, "MC_ROLL_P"),
    messages.ParamRequestRead(1, 0, "", 903),
    messages.ParamRequestList(1, 0),
    messages.ParamValue("MC_ROLL_P", PACKED_FLOAT, 9, 903, 441),
    messages.ParamValue(NAME, struct.pack("<f", -0.0), 9, 65535, 65535),
    messages.ParamValue("", bytes(4), 0, 0, 0),
    messages.ParamSet(1, 2, NAME, PACKED_FLOAT, 6),
    messages.StatusText(4, "write denied (A)"),
    messages.StatusText(6, "x" * 50),
    messages.ParamError(255, 190, "A", -1, 5),
    messages.ParamError(0, 0, "", 7, 1),
    messages.ParamExtRequestRead(1, 100, "CAM_MODE"),
    messages.ParamExtRequestList(1, 100),
    messages.ParamExtValue(NAME, bytes(range(1, 129)), 11, 300, 299),
    messages.ParamExtSet(1, 100, "CAM_MODE", b"\x05".ljust(128, b"\0"), 5),
    messages.ParamExtAck("CAM_MODE", b"text".ljust(128, b"\0"), 11, 3),
    messages.SystemTime(2**40 + 1, 2**31 + 2),
    messages.HighLatency2(2, 12),
    messages.SetupSigning(1, 2, SigningKey(bytes(range(32))), 2**40 + 3),
    messages.SetupSigning(1, 2, None, 0),
    messages.FileTransfer(0, 1, 2, bytes(range(1, 252))),
    messages.FileTransfer(3, 255, 190, b"\x02" + bytes(250)),
]
RENAMED = {"raw": "param_value", "git_hash": "flight_custom_version", "key": "secret_key"}
"""Fields that have another name here than in the standard."""


def of_pymavlink(number: int, **given: Any) -> Any:
    """A message of pymavlink with these fields; all others are zero."""
    kind = dialect.mavlink_map[number]
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    blank = {
        name: b"" if field == "char" else [0] * lengths[name] if lengths[name] else 0
        for name, field in zip(kind.fieldnames, kind.fieldtypes, strict=True)
    }
    return kind(**blank | given)


def theirs_of(ours: Message) -> Any:
    """The same message of pymavlink."""
    names = ours._fields if isinstance(ours, tuple) else [each.name for each in fields(ours)]
    given = {RENAMED.get(name, name): getattr(ours, name) for name in names}
    for name, value in given.items():
        if isinstance(value, str):
            given[name] = value.encode()
        elif name == "secret_key":
            given[name] = [0] * 32 if value is None else list(range(32))
        elif name == "param_value" and len(value) == 4:
            (given[name],) = struct.unpack("<f", value)
    return of_pymavlink(message_id(type(ours)), **given)


MESSAGES = [(ours, theirs_of(ours)) for ours in SENT]
MESSAGES_OF_1 = [pair for pair in MESSAGES if message_id(type(pair[0])) < 256]
BEFORE_EXTENSIONS = {"AUTOPILOT_VERSION": 60, "COMMAND_ACK": 3, "STATUSTEXT": 51}
"""Length of a payload without its extension fields, which MAVLink 1 does not carry. pymavlink sends them."""


def kind_of(value: object) -> str:
    return type(value).__name__


def test_every_message_that_is_understood_is_tested() -> None:
    assert {theirs.get_msgId() for _, theirs in MESSAGES} | {397} == DECODED_IDS


def test_a_message_that_pymavlink_does_not_have() -> None:
    """COMPONENT_METADATA: uint32 time_boot_ms, uint32 file_crc, char uri[100] (MAVLink, common.xml)."""
    assert 397 not in dialect.mavlink_map
    assert message_name(397) == "COMPONENT_METADATA"
    seed = x25crc_slow(b"COMPONENT_METADATA uint32_t time_boot_ms uint32_t file_crc char uri " + b"\x64")
    extra = seed.crc & 0xFF ^ seed.crc >> 8  # as the serialisation page of the guide has it
    message = messages.ComponentMetadata("mftp://etc/extras/component_general.json.xz", 0x01020304)
    payload = bytes(4) + b"\x04\x03\x02\x01" + message.uri.encode()
    frame = encode(message, system=7, component=8, sequence=0)
    assert frame == bare_frame(397, payload, extra=extra)
    assert decode(one_frame(frame)) == message
    for longer in (payload.ljust(108, b"\0"), payload.ljust(120, b"\0")):
        assert decode(one_frame(bare_frame(397, longer, extra=extra))) == message
    longest = messages.ComponentMetadata("mftp://" + "x" * 93, 1)
    assert decode(one_frame(encode(longest, system=7, component=8, sequence=0))) == longest
    assert decode(one_frame(bare_frame(397, b"", extra=extra))) == messages.ComponentMetadata("", 0)


@pytest.mark.parametrize(("ours", "theirs"), MESSAGES, ids=kind_of)
def test_a_mavlink_2_frame_is_pymavlinks(ours: Message, theirs: Any) -> None:
    frame = encode(ours, system=7, component=8, sequence=255)
    assert frame == pack(theirs, sequence=255)
    assert one_frame(frame) == Frame(theirs.get_msgId(), 7, 8, 255, frame[10:-2], 2)
    assert decode(one_frame(frame)) == ours


@pytest.mark.parametrize(("ours", "theirs"), MESSAGES_OF_1, ids=kind_of)
def test_a_mavlink_1_frame_is_pymavlinks_without_extension_fields(ours: Message, theirs: Any) -> None:
    number = theirs.get_msgId()
    frame = encode(ours, system=7, component=8, sequence=0, version=1)
    payload = pack(theirs, version=1)[6:-2][: BEFORE_EXTENSIONS.get(theirs.get_type())]
    assert frame == bare_frame(number, payload, version=1)
    assert one_frame(frame) == Frame(number, 7, 8, 0, payload, 1)
    (read,) = dialect.MAVLink(None).parse_buffer(frame)
    assert read.get_type() == theirs.get_type()
    if theirs.get_type() not in BEFORE_EXTENSIONS:
        assert decode(one_frame(frame)) == ours


def test_fields_missing_in_mavlink_1_are_zero() -> None:
    frame = encode(messages.CommandAck(512, 3, 255, 190), system=1, component=1, sequence=0, version=1)
    assert decode(one_frame(frame)) == messages.CommandAck(512, 3, 0, 0)
    version = messages.AutopilotVersion(16, uid=5, uid2=b"eighteen bytes uid")
    frame = encode(version, system=1, component=1, sequence=0, version=1)
    assert decode(one_frame(frame)) == messages.AutopilotVersion(16, uid=5)


def test_an_id_above_255_has_no_mavlink_1_frame() -> None:
    with pytest.raises(ValueError, match="range"):
        encode(messages.ParamError(1, 1, "A", -1, 5), system=1, component=1, sequence=0, version=1)


@pytest.mark.parametrize(("ours", "theirs"), MESSAGES, ids=kind_of)
def test_a_payload_may_be_longer_or_shorter_than_known(ours: Message, theirs: Any) -> None:
    payload = pack(theirs)[10:-2]
    number = theirs.get_msgId()
    full = payload.ljust(theirs.unpacker.size, b"\0")
    for variant in (payload, full, (full + b"new field")[:255]):
        frame = one_frame(bare_frame(number, variant))
        assert frame.payload == variant
        assert decode(frame) == ours
    assert decode(one_frame(bare_frame(number, b""))) is not None


def test_a_name_ends_at_its_first_nul_and_keeps_odd_bytes() -> None:
    payload = bytes(4) + b"\x01\0\x02\0" + b"A\xff\0GARBAGE".ljust(16, b"!") + b"\x06"
    value = decode(one_frame(bare_frame(22, payload)))
    assert value == messages.ParamValue("A\xff", bytes(4), 6, 1, 2)
    assert encode(value, system=7, component=8, sequence=0)[18:21] == b"A\xff\0"


# Frames


def sample_messages() -> list[Any]:
    """One message of each of the dialect's ids, its fields filled with seeded random bytes."""
    rng = random.Random(1)
    return [message_of(kind, rng.randbytes(kind.unpacker.size)) for kind in dialect.mavlink_map.values()]


def sample_frames() -> list[bytes]:
    """Every message of the dialect as MAVLink 2, signed, and (where its id allows) MAVLink 1."""
    frames = []
    for sequence, message in enumerate(sample_messages()):
        frames.append(pack(message, sequence=sequence % 256))
        frames.append(pack_signed(message, sequence=sequence % 256))
        if message.get_msgId() < 256:
            frames.append(pack(message, version=1, sequence=sequence % 256))
    random.Random(2).shuffle(frames)
    return frames


def read_by_pymavlink(stream: bytes) -> list[Frame]:
    """What pymavlink's parser finds. Ids that its dialect lacks are MAVLink_unknown, their checksum
    unproven: PX4 sends 8, 380, 410 and 411. They are left out, as `Framer` leaves them out."""
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    frames = []
    for message in parser.parse_buffer(stream):
        assert not isinstance(message, dialect.MAVLink_bad_data)
        if isinstance(message, dialect.MAVLink_unknown):
            assert message.get_msgId() < 0 or message.get_msgId() in {8, 380, 410, 411}
            continue
        packed = bytes(message.get_msgbuf())
        version, header = (2, 10) if packed[0] == 0xFD else (1, 6)
        source = message.get_srcSystem(), message.get_srcComponent(), message.get_seq()
        frames.append(Frame(message.get_msgId(), *source, packed[header : header + packed[1]], version))
    return frames


@pytest.mark.parametrize("name", NAMES)
def test_a_recording_gives_the_frames_that_pymavlink_finds(name: str) -> None:
    parts = [record.data for record in read(name)]
    stream = b"".join(parts)
    expected = read_by_pymavlink(stream)
    assert Framer().receive(stream) == expected
    datagrams = Framer(stream=False)
    assert [frame for part in parts for frame in datagrams.receive(part)] == expected
    values = [decode(frame) for frame in Framer({22}).receive(stream)]
    theirs = [m for m in dialect.MAVLink(None).parse_buffer(stream) if m.get_type() == "PARAM_VALUE"]
    for ours, message in zip(values, theirs, strict=True):
        assert isinstance(ours, messages.ParamValue)
        assert ours.raw == bytes(message.get_msgbuf()[10:14])
        place = (message.param_count, message.param_index)
        assert ours[:1] + ours[2:] == (message.param_id, message.param_type, *place)


def test_every_message_of_the_dialect_in_every_form_is_found() -> None:
    frames = sample_frames()
    stream = b"".join(frames)
    framer = Framer()
    assert framer.receive(stream) == read_by_pymavlink(stream)
    assert (framer.frames, framer.skipped) == (len(frames), 0)


PV = pack(MESSAGES[7][1])
PV_V1 = pack(MESSAGES[7][1], version=1)
PV_SIGNED = pack_signed(MESSAGES[7][1])
HEARTBEAT = pack(MESSAGES[0][1], sequence=1)
STATUS = pack(dialect.MAVLink_statustext_message(6, b"\xfd\xfe" * 20))
# Any mix of frames and noise


def frames_to_be_found(data: bytes) -> list[Frame]:
    """The definition, slowly: from the left, whether a frame starts here; if so, go on behind it."""
    found = []
    at = 0
    while at < len(data):
        frame, size = frame_at(data[at : at + FRAME_SIZE_MAX])
        found += [frame] if frame else []
        at += size or 1
    return found


def frame_at(data: bytes) -> tuple[Frame | None, int]:
    """The frame that starts with the first byte, and its size; none where the id, the flags or the checksum
    (pymavlink's, written in Python) are not right."""
    if data[0] == 0xFD and len(data) >= 12 and data[2] in (0, 1):
        head, number, version = 10, int.from_bytes(data[7:10], "little"), 2
        sequence, system, component = data[4:7]
    elif data[0] == 0xFE and len(data) >= 8:
        head, number, version = 6, data[5], 1
        sequence, system, component = data[2:5]
    else:
        return None, 0
    end = head + data[1]
    size = end + 2 + (13 if version == 2 and data[2] else 0)
    if number not in dialect.mavlink_map or len(data) < size:
        return None, 0
    seed = dialect.mavlink_map[number].crc_extra
    if x25crc_slow(data[1:end] + bytes((seed,))).crc != int.from_bytes(data[end : end + 2], "little"):
        return None, 0
    return Frame(number, system, component, sequence, data[head:end], version), size


def pool() -> list[bytes]:
    """Frames of all forms and sizes: short ones more often, so that noise and frames meet."""
    rng = random.Random(3)
    frames = rng.sample([frame for frame in sample_frames() if len(frame) < 80], 60)
    frames += rng.sample(sample_frames(), 20)
    frames += [PV, PV_V1, PV_SIGNED, HEARTBEAT, STATUS, bare_frame(22, b""), bare_frame(0, bytes(255))]
    for inner in (PV, PV_V1, HEARTBEAT):
        frames.append(
            pack(dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, list(inner.ljust(251, b"\1"))))
        )
        frames.append(
            pack_signed(dialect.MAVLink_tunnel_message(1, 1, 0, 128, list((inner * 3)[:128].ljust(128))))
        )
    return frames


def test_a_flood_of_a_first_byte_has_no_candidates() -> None:
    """Each would take 5 µs: 0.3 s of a chunk, in which others wait."""
    assert find_magic(b"\xfd" * 65_536 + b"\xff\xff") is None


whole = st.sampled_from(pool())
damaged = st.builds(
    lambda frame, at, damage: (
        frame[: at % len(frame)] + bytes((frame[at % len(frame)] ^ damage,)) + frame[at % len(frame) + 1 :]
    ),
    whole,
    st.integers(0, FRAME_SIZE_MAX),
    st.integers(1, 255),
)
magic_rich = st.lists(
    st.sampled_from(b"\xfd\xfd\xfe\xfe\x00\x01\x05\x09\x16\xff"), min_size=1, max_size=40
).map(bytes)
noise = (
    st.binary(min_size=1, max_size=30)
    | magic_rich
    | damaged
    | st.builds(lambda frame, cut: frame[: cut % len(frame)], whole, st.integers(1, FRAME_SIZE_MAX))
    | st.builds(lambda frame, cut: frame[cut % len(frame) :], whole, st.integers(1, FRAME_SIZE_MAX))
    | st.builds(lambda frame: bare_frame(410, frame[:255]), whole)
)
pieces = st.lists(whole | noise, max_size=12)


@thorough
@given(pieces, st.data())
def test_in_a_stream_every_whole_frame_is_found(mix: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(mix)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    chunks = [stream[start:end] for start, end in pairwise([0, *cuts, len(stream)])]
    framer, some = Framer(), Framer({0, 22, 253})
    found = take(framer, chunks)
    assert found == frames_to_be_found(stream)
    assert framer.frames == len(found)
    assert take(some, chunks) == [frame for frame in found if frame.message_id in (0, 22, 253)]
    assert (some.frames, some.skipped) == (framer.frames, framer.skipped)


@thorough
@given(st.lists(pieces, max_size=4))
def test_in_datagrams_every_whole_frame_is_found(mixes: list[list[bytes]]) -> None:
    framer = Framer(stream=False)
    for mix in mixes:
        assert framer.receive(b"".join(mix)) == frames_to_be_found(b"".join(mix))
    assert framer.flush() == []


@pytest.mark.parametrize("number", sorted(BOOT_CLOCK_OFFSETS))
def test_the_position_of_time_boot_ms_in_each_message(number: int) -> None:
    """pymavlink packs each message that has it; in the payload its trailing zeros are cut off."""
    for boot_ms in (0xA1B2C3D4, 0x00000017):
        frame = one_frame(pack(of_pymavlink(number, time_boot_ms=boot_ms)))
        at = BOOT_CLOCK_OFFSETS[number]
        assert int.from_bytes(frame.payload[at : at + 4], "little") == boot_ms
