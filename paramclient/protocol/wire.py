"""Bytes to frames, frames to messages, messages to bytes. The only room that knows pymavlink.

pymavlink gives the CRC_EXTRA byte of every message of its `all` dialect. Framing, checking and the few
messages of this protocol are done here, on raw bytes, because a parameter's value must not pass through
a Python float (see `paramclient.values`) and because most frames on a link need no decoding at all.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple, TypeAlias

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

__all__ = [
    "AutopilotVersion",
    "CommandAck",
    "CommandLong",
    "Frame",
    "Framer",
    "Heartbeat",
    "HighLatency2",
    "Message",
    "ParamError",
    "ParamRequestList",
    "ParamRequestRead",
    "ParamSet",
    "ParamValue",
    "StatusText",
    "SystemTime",
    "build_frame",
    "checksum",
    "decode",
    "decode_param_value",
    "encode",
    "enum_word",
    "message_name",
]

NO_INDEX: Final = 65535
"""param_index of a PARAM_VALUE that has no place in the list (PX4: `_HASH_CHECK` and parameters not in use;
ArduPilot: replies by name and unasked updates)."""
HASH_CHECK: Final = "_HASH_CHECK"
"""param_id under which PX4 gives the hash of its table."""
COMP_ID_ALL: Final = 0
AUTOPILOT_COMPONENT: Final = 1

MAV_TYPE_GCS: Final = 6
MAV_AUTOPILOT_GENERIC: Final = 0
MAV_AUTOPILOT_ARDUPILOTMEGA: Final = 3
MAV_AUTOPILOT_INVALID: Final = 8
MAV_AUTOPILOT_PX4: Final = 12
MAV_STATE_BOOT: Final = 1
MAV_STATE_ACTIVE: Final = 4
PARAM_VALUE_ID: Final = 22
AUTOPILOT_VERSION_ID: Final = 148
MAV_CMD_REQUEST_MESSAGE: Final = 512
MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: Final = 520
MAV_RESULT_ACCEPTED: Final = 0
MAV_RESULT_UNSUPPORTED: Final = 3
CAPABILITY_PARAM_ENCODE_BYTEWISE: Final = 16
CAPABILITY_PARAM_ENCODE_C_CAST: Final = 131072

_MAGIC_V1 = 0xFE
_MAGIC_V2 = 0xFD
_SIGNED = 0x01
_SIGNATURE_LENGTH = 13
_MAGIC = re.compile(b"[\xfd\xfe]").search
_START = struct.Struct("<BBBxBBB3s").unpack_from  # a header of MAVLink 2; version 1 shares two bytes
_CRC_AT = struct.Struct("<H").unpack_from
_PADDING = bytes(10)  # behind the data: a header can be read at its last byte
_new = tuple.__new__  # what a named tuple's own constructor ends in, after twice the time
_NO_KEY = b""  # of no message


class Frame(NamedTuple):
    """One frame, its checksum proven. A named tuple, because making one is part of the hot path.

    Attributes:
        message_id: 24 bits.
        system, component: who sent it.
        sequence: 0 to 255.
        payload: as sent; MAVLink 2 cuts trailing zero bytes.
        version: 1 or 2.
    """

    message_id: int
    system: int
    component: int
    sequence: int
    payload: bytes
    version: int


@dataclass(frozen=True, slots=True)
class Heartbeat:
    type: int
    autopilot: int
    base_mode: int = 0
    custom_mode: int = 0
    system_status: int = 0
    mavlink_version: int = 3


@dataclass(frozen=True, slots=True)
class AutopilotVersion:
    """AUTOPILOT_VERSION; `git_hash` is flight_custom_version, `uid2` has 18 bytes."""

    capabilities: int
    flight_sw_version: int = 0
    git_hash: bytes = bytes(8)
    board_version: int = 0
    vendor_id: int = 0
    product_id: int = 0
    uid: int = 0
    uid2: bytes = bytes(18)


@dataclass(frozen=True, slots=True)
class CommandLong:
    target_system: int
    target_component: int
    command: int
    params: tuple[float, ...] = (0.0,) * 7
    confirmation: int = 0


@dataclass(frozen=True, slots=True)
class CommandAck:
    command: int
    result: int
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True, slots=True)
class ParamRequestRead:
    """PARAM_REQUEST_READ by `param_index`, or by `param_id` where the index is −1."""

    target_system: int
    target_component: int
    param_id: str
    param_index: int = -1


@dataclass(frozen=True, slots=True)
class ParamRequestList:
    target_system: int
    target_component: int


class ParamValue(NamedTuple):
    """PARAM_VALUE; `raw` is the four value bytes, undecoded. A named tuple for the same reason as `Frame`."""

    param_id: str
    raw: bytes
    param_type: int
    param_count: int
    param_index: int


@dataclass(frozen=True, slots=True)
class ParamSet:
    """PARAM_SET; `raw` is the four value bytes."""

    target_system: int
    target_component: int
    param_id: str
    raw: bytes
    param_type: int


@dataclass(frozen=True, slots=True)
class ParamError:
    """PARAM_ERROR; `param_index` −1 says that `param_id` counts; the id may be empty for a read by index."""

    target_system: int
    target_component: int
    param_id: str
    param_index: int
    error: int


@dataclass(frozen=True, slots=True)
class StatusText:
    severity: int
    text: str


@dataclass(frozen=True, slots=True)
class SystemTime:
    """SYSTEM_TIME; `time_unix_usec` is 0 where the vehicle does not know it."""

    time_unix_usec: int
    time_boot_ms: int


@dataclass(frozen=True, slots=True)
class HighLatency2:
    """HIGH_LATENCY2, in the place of the heartbeat on satellite links; its telemetry is left out, or zero."""

    type: int
    autopilot: int


Message: TypeAlias = (
    Heartbeat
    | AutopilotVersion
    | CommandLong
    | CommandAck
    | ParamRequestRead
    | ParamRequestList
    | ParamValue
    | ParamSet
    | ParamError
    | StatusText
    | SystemTime
    | HighLatency2
)


class Framer:
    """Finds the frames in what a link delivers.

    Every frame whose message id is known is checked by its CRC; one with an unknown id cannot be checked
    and is passed over. A candidate that fails is retried from its second byte, so that no noise can hide a
    frame that stands whole outside a longer valid one. Signatures are not verified: the 13 bytes behind the
    checksum of a signed frame count as its signature, whatever they are.

    Args:
        wanted: the message ids to give out; None for every known one. Frames with other ids are still
            checked and stepped over, but no object is made of them.
        stream: whether a frame may be spread over several calls (TCP, serial). Datagrams are taken one by
            one and never joined.

    Attributes:
        frames: frames that were found whole, wanted or not.
        skipped: bytes that belonged to no such frame.
    """

    def __init__(self, wanted: Collection[int] | None = None, *, stream: bool = True) -> None:
        ids = _CRC_EXTRA if wanted is None else wanted
        self._wanted = {number.to_bytes(3, "little"): number for number in ids}
        self._stream = stream
        self._tail = b""
        self.frames = 0
        self.skipped = 0

    def receive(self, data: bytes, *, final: bool = False) -> list[Frame]:
        """Take bytes from the link; give the frames that are complete now, in order.

        Of a stream, at most one unfinished frame (less than 280 bytes) is kept between calls. Where `data` is
        final, as datagrams always are, nothing will complete such a candidate, and it is passed over like any
        other that fails. The loop is the hot path of the library: about ten operations for each frame,
        nothing for each byte.
        """
        if self._tail:
            data = self._tail + data
        may_go_on = self._stream and not final
        found: list[Frame] = []
        number_of = self._wanted.get
        extra_of = _EXTRA_BY_ID_BYTES.get
        length = len(data)
        padded = data + _PADDING
        good = 0
        skipped = 0
        at = 0
        while at < length:
            magic, size, flags, sequence, system, component, key = _START(padded, at)
            if magic == _MAGIC_V2:
                crc_at = at + 10 + size
                end = crc_at + 2
                if flags:
                    end += _SIGNATURE_LENGTH
                    if flags != _SIGNED:
                        key = _NO_KEY  # a format that is not defined yet
            elif magic == _MAGIC_V1:
                crc_at = at + 6 + size
                end = crc_at + 2
                key = padded[at + 5 : at + 6] + b"\0\0"
            else:
                crc_at = end = at
                key = _NO_KEY
            extra = extra_of(key)
            if end > length:
                header_is_cut = crc_at - size > length
                if may_go_on and (header_is_cut or extra is not None):
                    break
            elif extra is not None and _CRC_AT(data, crc_at)[0] == mcrf4xx(data[at + 1 : crc_at] + extra):
                good += 1
                number = number_of(key)
                if number is not None:
                    if magic == _MAGIC_V2:
                        payload = data[at + 10 : crc_at]
                        found.append(_new(Frame, (number, system, component, sequence, payload, 2)))
                    else:
                        sequence, system, component = data[at + 2 : at + 5]
                        payload = data[at + 6 : crc_at]
                        found.append(Frame(number, system, component, sequence, payload, 1))
                at = end
                continue
            candidate = _MAGIC(data, at + 1)
            next_at = candidate.start() if candidate else length
            skipped += next_at - at
            at = next_at
        self.frames += good
        self.skipped += skipped
        self._tail = data[at:]
        return found

    def flush(self) -> list[Frame]:
        """The stream has ended or was interrupted: give what stands behind the unfinished candidate."""
        return self.receive(b"", final=True)


def decode(frame: Frame) -> Message | None:
    """The message in a frame, or None where this library has no use for its id.

    Missing trailing bytes count as zero and further ones are passed over, as MAVLink 2 asks.
    """
    decoder = _DECODERS.get(frame.message_id)
    return None if decoder is None else decoder(frame.payload)


def decode_param_value(payload: bytes) -> ParamValue:
    """The message in the payload of a PARAM_VALUE, as `decode` gives it: for those who know the id."""
    if len(payload) < 25:
        payload = payload.ljust(25, b"\0")
    raw, count, index, name, number = _PARAM_VALUE.unpack_from(payload)
    return _new(ParamValue, (text_of(name), raw, number, count, index))


def encode(message: Message, *, system: int, component: int, sequence: int, version: int = 2) -> bytes:
    """Pack a message into a frame.

    Args:
        message: any of this room's messages.
        system, component: the sender, 1 to 255.
        sequence: 0 to 255.
        version: 2, or 1 for peers that know only that; ids above 255 (PARAM_ERROR) exist in 2 alone.
    """
    number, payload = _ENCODERS[type(message)](message)
    if version == 1:
        payload = payload[: _V1_LENGTHS.get(number)]
    return build_frame(
        number, payload, system=system, component=component, sequence=sequence, version=version
    )


def build_frame(
    message_id: int, payload: bytes, *, system: int, component: int, sequence: int, version: int = 2
) -> bytes:
    """Put a payload into a frame; for messages that have no class here, any id of the dialect.

    MAVLink 2 drops the payload's trailing zeros. The other arguments are those of `encode`.
    """
    if version == 1:
        body = bytes((len(payload), sequence, system, component, message_id)) + payload
        magic = b"\xfe"
    else:
        payload = payload.rstrip(b"\0") or b"\0"
        head = bytes((len(payload), 0, 0, sequence, system, component))
        body = head + message_id.to_bytes(3, "little") + payload
        magic = b"\xfd"
    crc: int = mcrf4xx(body + bytes((_CRC_EXTRA[message_id],)))
    return magic + body + crc.to_bytes(2, "little")


def checksum(message_id: int, body: bytes) -> int | None:
    """The checksum of a frame's bytes between its first one and the checksum; None for an unknown id."""
    extra = _CRC_EXTRA.get(message_id)
    return None if extra is None else int(mcrf4xx(body + bytes((extra,))))


def message_name(message_id: int) -> str:
    """`HEARTBEAT` for 0, and so on; `UNKNOWN_4711` for an id that the dialect does not have."""
    known = dialect.mavlink_map.get(message_id)
    return f"UNKNOWN_{message_id}" if known is None else str(known.msgname)


def enum_word(enum: str, number: int) -> str:
    """A number of one of the dialect's enums in words, `fixed wing` for 1 of MAV_TYPE; else the number."""
    entry = dialect.enums[enum].get(number)
    return (
        str(number) if entry is None else str(entry.name.removeprefix(f"{enum}_").lower().replace("_", " "))
    )


@lru_cache(maxsize=4096)
def text_of(field: bytes) -> str:
    """A text field: cut at the first NUL. Latin-1 keeps every byte, so that odd names can be told apart.

    Remembered, because the same names come again and again: equal names are then one object.
    """
    return field.split(b"\0", 1)[0].decode("latin-1")


_CRC_EXTRA: dict[int, int] = {number: message.crc_extra for number, message in dialect.mavlink_map.items()}
_EXTRA_BY_ID_BYTES = {number.to_bytes(3, "little"): bytes((extra,)) for number, extra in _CRC_EXTRA.items()}

_HEARTBEAT = struct.Struct("<IBBBBB")
_AUTOPILOT_VERSION = struct.Struct("<QQIIIIHH8s8s8s18s")
_COMMAND_LONG = struct.Struct("<7fHBBB")
_COMMAND_ACK = struct.Struct("<HBBiBB")
_PARAM_REQUEST_READ = struct.Struct("<hBB16s")
_PARAM_REQUEST_LIST = struct.Struct("<BB")
_PARAM_VALUE = struct.Struct("<4sHH16sB")
_PARAM_SET = struct.Struct("<4sBB16sB")
_STATUSTEXT = struct.Struct("<B50s")  # its extension fields, for long texts in pieces, are not read
_PARAM_ERROR = struct.Struct("<hBB16sB")
_SYSTEM_TIME = struct.Struct("<QI")
_HIGH_LATENCY2 = struct.Struct("<24xBB16x")
_V1_LENGTHS = {77: 3, 148: 60}  # extension fields exist in MAVLink 2 only


def _fields(layout: struct.Struct, payload: bytes) -> tuple:  # type: ignore[type-arg]  # struct gives no types
    if len(payload) < layout.size:
        payload = payload.ljust(layout.size, b"\0")
    return layout.unpack_from(payload)


def _decode_heartbeat(payload: bytes) -> Heartbeat:
    custom_mode, kind, autopilot, base_mode, status, version = _fields(_HEARTBEAT, payload)
    return Heartbeat(kind, autopilot, base_mode, custom_mode, status, version)


def _decode_autopilot_version(payload: bytes) -> AutopilotVersion:
    capabilities, uid, flight, _, _, board, vendor, product, git, _, _, uid2 = _fields(
        _AUTOPILOT_VERSION, payload
    )
    return AutopilotVersion(capabilities, flight, git, board, vendor, product, uid, uid2)


def _decode_command_long(payload: bytes) -> CommandLong:
    *params, command, system, component, confirmation = _fields(_COMMAND_LONG, payload)
    return CommandLong(system, component, command, tuple(params), confirmation)


def _decode_command_ack(payload: bytes) -> CommandAck:
    command, result, _, _, system, component = _fields(_COMMAND_ACK, payload)
    return CommandAck(command, result, system, component)


def _decode_param_request_read(payload: bytes) -> ParamRequestRead:
    index, system, component, name = _fields(_PARAM_REQUEST_READ, payload)
    return ParamRequestRead(system, component, text_of(name), index)


def _decode_param_request_list(payload: bytes) -> ParamRequestList:
    return ParamRequestList(*_fields(_PARAM_REQUEST_LIST, payload))


def _decode_param_set(payload: bytes) -> ParamSet:
    raw, system, component, name, number = _fields(_PARAM_SET, payload)
    return ParamSet(system, component, text_of(name), raw, number)


def _decode_statustext(payload: bytes) -> StatusText:
    severity, text = _fields(_STATUSTEXT, payload)
    return StatusText(severity, text_of(text))


def _decode_param_error(payload: bytes) -> ParamError:
    index, system, component, name, error = _fields(_PARAM_ERROR, payload)
    return ParamError(system, component, text_of(name), index, error)


def _decode_system_time(payload: bytes) -> SystemTime:
    return SystemTime(*_fields(_SYSTEM_TIME, payload))


def _decode_high_latency2(payload: bytes) -> HighLatency2:
    return HighLatency2(*_fields(_HIGH_LATENCY2, payload))


_DECODERS: dict[int, Callable[[bytes], Message]] = {
    0: _decode_heartbeat,
    2: _decode_system_time,
    20: _decode_param_request_read,
    21: _decode_param_request_list,
    PARAM_VALUE_ID: decode_param_value,
    23: _decode_param_set,
    76: _decode_command_long,
    77: _decode_command_ack,
    148: _decode_autopilot_version,
    235: _decode_high_latency2,
    253: _decode_statustext,
    345: _decode_param_error,
}

UNDERSTOOD: Final = frozenset(_DECODERS)
"""The message ids that `decode` knows."""


def _name(param_id: str) -> bytes:
    return param_id.encode("latin-1")


_ENCODERS: dict[type, Callable[..., tuple[int, bytes]]] = {
    Heartbeat: lambda m: (
        0,
        _HEARTBEAT.pack(m.custom_mode, m.type, m.autopilot, m.base_mode, m.system_status, m.mavlink_version),
    ),
    ParamRequestRead: lambda m: (
        20,
        _PARAM_REQUEST_READ.pack(m.param_index, m.target_system, m.target_component, _name(m.param_id)),
    ),
    ParamRequestList: lambda m: (21, _PARAM_REQUEST_LIST.pack(m.target_system, m.target_component)),
    ParamValue: lambda m: (
        22,
        _PARAM_VALUE.pack(m.raw, m.param_count, m.param_index, _name(m.param_id), m.param_type),
    ),
    ParamSet: lambda m: (
        23,
        _PARAM_SET.pack(m.raw, m.target_system, m.target_component, _name(m.param_id), m.param_type),
    ),
    CommandLong: lambda m: (
        76,
        _COMMAND_LONG.pack(*m.params, m.command, m.target_system, m.target_component, m.confirmation),
    ),
    CommandAck: lambda m: (
        77,
        _COMMAND_ACK.pack(m.command, m.result, 0, 0, m.target_system, m.target_component),
    ),
    AutopilotVersion: lambda m: (
        148,
        _AUTOPILOT_VERSION.pack(
            m.capabilities,
            m.uid,
            m.flight_sw_version,
            0,
            0,
            m.board_version,
            m.vendor_id,
            m.product_id,
            m.git_hash,
            b"",
            b"",
            m.uid2,
        ),
    ),
    StatusText: lambda m: (253, _STATUSTEXT.pack(m.severity, m.text.encode("latin-1"))),
    ParamError: lambda m: (
        345,
        _PARAM_ERROR.pack(m.param_index, m.target_system, m.target_component, _name(m.param_id), m.error),
    ),
    SystemTime: lambda m: (2, _SYSTEM_TIME.pack(m.time_unix_usec, m.time_boot_ms)),
    HighLatency2: lambda m: (235, _HIGH_LATENCY2.pack(m.type, m.autopilot)),
}
