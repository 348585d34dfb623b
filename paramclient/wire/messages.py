"""The messages of this library: their classes, one table of their formats, and decoding and encoding by it.

A parameter's value must not pass through a Python float (see `paramclient.model.values`): the classes hold
its bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from operator import attrgetter
from typing import Any, Final, NamedTuple, TypeAlias

from paramclient.wire.frames import Frame, build_frame
from paramclient.wire.signing import SigningKey

NO_INDEX: Final = 65535
"""param_index of a PARAM_VALUE without a place in the list (PX4: `_HASH_CHECK` and parameters not in use;
ArduPilot: responses by name and pushed changes)."""
PARAMETERS_MAX: Final = 32_768
"""Parameters of a component, at most: param_index of PARAM_REQUEST_READ is signed, so no index above 32767
can be requested. A larger param_count is ignored."""
HASH_CHECK: Final = "_HASH_CHECK"
"""The param_id of PX4's hash of its table."""
COMP_ID_ALL: Final = 0
"""MAV_COMP_ID_ALL: every component of a system."""
AUTOPILOT_COMPONENT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1: the usual component id of an autopilot."""
MAV_TYPE_GENERIC: Final = 0
MAV_TYPE_GCS: Final = 6
MAV_AUTOPILOT_GENERIC: Final = 0
MAV_AUTOPILOT_ARDUPILOTMEGA: Final = 3
MAV_AUTOPILOT_INVALID: Final = 8
MAV_AUTOPILOT_PX4: Final = 12
MAV_MODE_FLAG_SAFETY_ARMED: Final = 128
MAV_STATE_BOOT: Final = 1
MAV_STATE_ACTIVE: Final = 4
MAV_CMD_PREFLIGHT_STORAGE: Final = 245
MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: Final = 246
MAV_CMD_REQUEST_MESSAGE: Final = 512
MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: Final = 520
CAPABILITY_PARAM_ENCODE_BYTEWISE: Final = 16
CAPABILITY_FTP: Final = 32
CAPABILITY_PARAM_ENCODE_C_CAST: Final = 131072
TEXTS_MAX: Final = 4096
"""Remembered texts: the names of a few different autopilots, 100 bytes each. A vehicle with ever new names
uses no more memory than that, and decoding takes a microsecond longer."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    type: int
    autopilot: int
    base_mode: int = 0
    custom_mode: int = 0
    system_status: int = 0
    mavlink_version: int = 3


@dataclass(frozen=True, slots=True)
class SystemTime:
    """SYSTEM_TIME; `time_unix_usec` is 0 while unknown to the vehicle."""

    time_unix_usec: int
    time_boot_ms: int


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
    """PARAM_VALUE; `raw` has the 4 value bytes. A named tuple, as its creation is part of the hot path."""

    param_id: str
    raw: bytes
    param_type: int
    param_count: int
    param_index: int


@dataclass(frozen=True, slots=True)
class ParamSet:
    """PARAM_SET; `raw` has the 4 value bytes."""

    target_system: int
    target_component: int
    param_id: str
    raw: bytes
    param_type: int


@dataclass(frozen=True, slots=True)
class ParamError:
    """PARAM_ERROR; with `param_index` −1 the `param_id` counts; the id may be empty for a read by index."""

    target_system: int
    target_component: int
    param_id: str
    param_index: int
    error: int


@dataclass(frozen=True, slots=True)
class ParamExtRequestRead:
    """PARAM_EXT_REQUEST_READ, with the fields of `ParamRequestRead`."""

    target_system: int
    target_component: int
    param_id: str
    param_index: int = -1


@dataclass(frozen=True, slots=True)
class ParamExtRequestList:
    target_system: int
    target_component: int


class ParamExtValue(NamedTuple):
    """PARAM_EXT_VALUE, with the fields of `ParamValue`; `raw` has 128 bytes."""

    param_id: str
    raw: bytes
    param_type: int
    param_count: int
    param_index: int


@dataclass(frozen=True, slots=True)
class ParamExtSet:
    """PARAM_EXT_SET; `raw` has up to 128 bytes, 128 when decoded."""

    target_system: int
    target_component: int
    param_id: str
    raw: bytes
    param_type: int


@dataclass(frozen=True, slots=True)
class ParamExtAck:
    """PARAM_EXT_ACK; `raw` is the new value if the result is PARAM_ACK_ACCEPTED."""

    param_id: str
    raw: bytes
    param_type: int
    param_result: int


@dataclass(frozen=True, slots=True)
class CommandLong:
    target_system: int
    target_component: int
    command: int
    param1: float = 0.0
    param2: float = 0.0
    param3: float = 0.0
    param4: float = 0.0
    param5: float = 0.0
    param6: float = 0.0
    param7: float = 0.0
    confirmation: int = 0


@dataclass(frozen=True, slots=True)
class CommandAck:
    command: int
    result: int
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True, slots=True)
class FileTransfer:
    """FILE_TRANSFER_PROTOCOL; `payload` has 251 bytes when decoded, see `paramclient.protocol.ftp`."""

    target_network: int
    target_system: int
    target_component: int
    payload: bytes


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
class HighLatency2:
    """HIGH_LATENCY2, which replaces the heartbeat on satellite links; its telemetry is left out, or zero."""

    type: int
    autopilot: int


@dataclass(frozen=True, slots=True)
class StatusText:
    """STATUSTEXT; the extension fields, for long texts in pieces, are not read."""

    severity: int
    text: str


@dataclass(frozen=True, slots=True)
class SetupSigning:
    """SETUP_SIGNING: sets a vehicle's key, in clear; without a key (zeros) it disables signing.

    There is no acknowledgement. It exists in MAVLink 2 only.
    """

    target_system: int
    target_component: int
    key: SigningKey | None
    initial_timestamp: int


@dataclass(frozen=True, slots=True)
class ComponentMetadata:
    """COMPONENT_METADATA: the location of the general metadata file, and its CRC-32; its time is not read."""

    uri: str
    file_crc: int


Message: TypeAlias = (
    Heartbeat
    | SystemTime
    | ParamRequestRead
    | ParamRequestList
    | ParamValue
    | ParamSet
    | ParamError
    | ParamExtRequestRead
    | ParamExtRequestList
    | ParamExtValue
    | ParamExtSet
    | ParamExtAck
    | CommandLong
    | CommandAck
    | FileTransfer
    | AutopilotVersion
    | HighLatency2
    | StatusText
    | SetupSigning
    | ComponentMetadata
)


class _Format(NamedTuple):
    """The payload of a message: its id, its layout, and the fields of its class in the order of the wire.

    Attributes:
        v1_length: bytes in MAVLink 1, which has no extension fields; None for all.
    """

    number: int
    message: type[Any]
    layout: struct.Struct
    fields: tuple[str, ...]
    v1_length: int | None = None


def _format(number: int, message: type, layout: str, fields: str, v1_length: int | None = None) -> _Format:
    return _Format(number, message, struct.Struct("<" + layout), tuple(fields.split()), v1_length)


_COMMAND_PARAMS = " ".join(f"param{number}" for number in range(1, 8))
_TARGET = "target_system target_component"
_FORMATS = (
    _format(0, Heartbeat, "IBBBBB", "custom_mode type autopilot base_mode system_status mavlink_version"),
    _format(2, SystemTime, "QI", "time_unix_usec time_boot_ms"),
    _format(20, ParamRequestRead, "hBB16s", f"param_index {_TARGET} param_id"),
    _format(21, ParamRequestList, "BB", _TARGET),
    _format(22, ParamValue, "4sHH16sB", "raw param_count param_index param_id param_type"),
    _format(23, ParamSet, "4sBB16sB", f"raw {_TARGET} param_id param_type"),
    _format(76, CommandLong, "7fHBBB", f"{_COMMAND_PARAMS} command {_TARGET} confirmation"),
    _format(77, CommandAck, "HB5xBB", f"command result {_TARGET}", v1_length=3),
    _format(110, FileTransfer, "BBB251s", f"target_network {_TARGET} payload"),
    _format(
        148,
        AutopilotVersion,
        "QQI8xIHH8s16x18s",
        "capabilities uid flight_sw_version board_version vendor_id product_id git_hash uid2",
        v1_length=60,
    ),
    _format(235, HighLatency2, "24xBB16x", "type autopilot"),
    _format(253, StatusText, "B50s", "severity text"),
    _format(256, SetupSigning, "QBB32s", f"initial_timestamp {_TARGET} key"),
    _format(320, ParamExtRequestRead, "hBB16s", f"param_index {_TARGET} param_id"),
    _format(321, ParamExtRequestList, "BB", _TARGET),
    _format(322, ParamExtValue, "HH16s128sB", "param_count param_index param_id raw param_type"),
    _format(323, ParamExtSet, "BB16s128sB", f"{_TARGET} param_id raw param_type"),
    _format(324, ParamExtAck, "16s128sBB", "param_id raw param_type param_result"),
    _format(345, ParamError, "hBB16sB", f"param_index {_TARGET} param_id error"),
    _format(397, ComponentMetadata, "4xI100s", "file_crc uri"),
)


@lru_cache(maxsize=TEXTS_MAX)
def text_of(field: bytes) -> str:
    """Decode a text field up to the first NUL. Latin-1 keeps every byte, so that damaged names differ.

    Results are remembered, because the same names are repeated: equal names are then one object.
    """
    return field.split(b"\0", 1)[0].decode("latin-1")


def _text_bytes(text: str) -> bytes:
    return text.encode("latin-1")


def _key_of(secret: bytes) -> SigningKey | None:
    return SigningKey(secret) if any(secret) else None


def _secret_of(key: SigningKey | None) -> bytes:
    return b"" if key is None else key.secret


_READERS: dict[str, Callable[[Any], Any]] = {
    "param_id": text_of,
    "text": text_of,
    "uri": text_of,
    "key": _key_of,
}
"""Conversions of the fields of that name that are not integers, floats or bytes."""
_WRITERS: dict[str, Callable[[Any], Any]] = {
    "param_id": _text_bytes,
    "text": _text_bytes,
    "uri": _text_bytes,
    "key": _secret_of,
}


def _decoder(form: _Format) -> Callable[[bytes], Message]:
    layout, fields, make = form.layout, form.fields, form.message
    readers = [(field, _READERS[field]) for field in fields if field in _READERS]

    def decode_payload(payload: bytes) -> Message:
        if len(payload) < layout.size:
            payload = payload.ljust(layout.size, b"\0")
        values = dict(zip(fields, layout.unpack_from(payload), strict=True))
        for field, read in readers:
            values[field] = read(values[field])
        message: Message = make(**values)
        return message

    return decode_payload


def _encoder(form: _Format) -> Callable[[Message], bytes]:
    layout, values_of = form.layout, attrgetter(*form.fields)
    writers = [(at, _WRITERS[field]) for at, field in enumerate(form.fields) if field in _WRITERS]

    def encode_payload(message: Message) -> bytes:
        values = list(values_of(message))
        for at, write in writers:
            values[at] = write(values[at])
        return layout.pack(*values)

    return encode_payload


_PARAM_VALUE = struct.Struct("<4sHH16sB")
_new = tuple.__new__  # the constructor of a named tuple ends in this call and takes twice as long


def _decode_param_value(payload: bytes) -> ParamValue:
    """Decode the message of which there are a thousand in a second, in a third of the usual time."""
    if len(payload) < 25:
        payload = payload.ljust(25, b"\0")
    raw, count, index, name, number = _PARAM_VALUE.unpack_from(payload)
    return _new(ParamValue, (text_of(name), raw, number, count, index))


_DECODERS = {form.number: _decoder(form) for form in _FORMATS} | {22: _decode_param_value}
_ENCODERS = {form.message: (form.number, _encoder(form), form.v1_length) for form in _FORMATS}

DECODED_IDS: Final = frozenset(_DECODERS)
"""The message ids that `decode` supports."""


def message_id(message: type[Message]) -> int:
    """Return the id of a message class."""
    return _ENCODERS[message][0]


def decode(frame: Frame) -> Message | None:
    """Decode the message in a frame; return None for an id that this library does not use.

    Missing trailing bytes count as zero and further ones are ignored, as MAVLink 2 requires.
    """
    decoder = _DECODERS.get(frame.message_id)
    return None if decoder is None else decoder(frame.payload)


def encode(message: Message, *, system: int, component: int, sequence: int, version: int = 2) -> bytes:
    """Encode a message as a frame.

    Args:
        message: any message of this module.
        system, component: the sender, 1 to 255.
        sequence: 0 to 255.
        version: 2, or 1 for peers without MAVLink 2; ids above 255 exist in 2 only.
    """
    number, encode_payload, v1_length = _ENCODERS[type(message)]
    payload = encode_payload(message)
    if version == 1:
        payload = payload[:v1_length]
    return build_frame(
        number, payload, system=system, component=component, sequence=sequence, version=version
    )
