"""Decoder and encoder of the messages that this library uses, on raw bytes.

A parameter's value must not pass through a Python float (see `paramclient.model.values`).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import Final

from paramclient.protocol.wire.frames import Frame, build_frame
from paramclient.protocol.wire.messages import (
    COMPONENT_METADATA_ID,
    PARAM_EXT_VALUE_ID,
    PARAM_VALUE_ID,
    AutopilotVersion,
    CommandAck,
    CommandLong,
    ComponentMetadata,
    FileTransfer,
    Heartbeat,
    HighLatency2,
    Message,
    ParamError,
    ParamExtAck,
    ParamExtRequestList,
    ParamExtRequestRead,
    ParamExtSet,
    ParamExtValue,
    ParamRequestList,
    ParamRequestRead,
    ParamSetMessage,
    ParamValue,
    SetupSigning,
    StatusText,
    SystemTime,
)
from paramclient.protocol.wire.signing import SigningKey

__all__ = ["DECODED_IDS", "decode", "decode_param_value", "encode"]

TEXTS_MAX: Final = 4096
"""Remembered texts: the names of a few different autopilots, 100 bytes each. A vehicle with ever new names
uses no more memory than that, and decoding takes a microsecond longer."""

_new = tuple.__new__  # the constructor of a named tuple ends in this call and takes twice as long


def decode(frame: Frame) -> Message | None:
    """Decode the message in a frame; return None for an id that this library does not use.

    Missing trailing bytes count as zero and further ones are ignored, as MAVLink 2 requires.
    """
    decoder = _DECODERS.get(frame.message_id)
    return None if decoder is None else decoder(frame.payload)


def decode_param_value(payload: bytes) -> ParamValue:
    """Decode the payload of a PARAM_VALUE, as `decode` does: for callers that know the id."""
    if len(payload) < 25:
        payload = payload.ljust(25, b"\0")
    raw, count, index, name, number = _PARAM_VALUE.unpack_from(payload)
    return _new(ParamValue, (text_of(name), raw, number, count, index))


def encode(message: Message, *, system: int, component: int, sequence: int, version: int = 2) -> bytes:
    """Encode a message as a frame.

    Args:
        message: any message of this package.
        system, component: the sender, 1 to 255.
        sequence: 0 to 255.
        version: 2, or 1 for peers without MAVLink 2; ids above 255 (PARAM_ERROR) exist in 2 only.
    """
    number, payload = _ENCODERS[type(message)](message)
    if version == 1:
        payload = payload[: _V1_LENGTHS.get(number)]
    return build_frame(
        number, payload, system=system, component=component, sequence=sequence, version=version
    )


@lru_cache(maxsize=TEXTS_MAX)
def text_of(field: bytes) -> str:
    """Decode a text field up to the first NUL. Latin-1 keeps every byte, so that damaged names differ.

    Results are remembered, because the same names are repeated: equal names are then one object.
    """
    return field.split(b"\0", 1)[0].decode("latin-1")


_HEARTBEAT = struct.Struct("<IBBBBB")
_AUTOPILOT_VERSION = struct.Struct("<QQIIIIHH8s8s8s18s")
_COMMAND_LONG = struct.Struct("<7fHBBB")
_COMMAND_ACK = struct.Struct("<HBBiBB")
_PARAM_REQUEST_READ = struct.Struct("<hBB16s")
_PARAM_REQUEST_LIST = struct.Struct("<BB")
_PARAM_VALUE = struct.Struct("<4sHH16sB")
_PARAM_SET = struct.Struct("<4sBB16sB")
_STATUSTEXT = struct.Struct("<B50s")  # the extension fields, for long texts in pieces, are not read
_PARAM_ERROR = struct.Struct("<hBB16sB")
_PARAM_EXT_VALUE = struct.Struct("<HH16s128sB")
_PARAM_EXT_SET = struct.Struct("<BB16s128sB")
_PARAM_EXT_ACK = struct.Struct("<16s128sBB")
_FILE_TRANSFER = struct.Struct("<BBB251s")
_SYSTEM_TIME = struct.Struct("<QI")
_HIGH_LATENCY2 = struct.Struct("<24xBB16x")
_SETUP_SIGNING = struct.Struct("<QBB32s")
_COMPONENT_METADATA = struct.Struct("<4xI100s")
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


def _decode_param_set(payload: bytes) -> ParamSetMessage:
    raw, system, component, name, number = _fields(_PARAM_SET, payload)
    return ParamSetMessage(system, component, text_of(name), raw, number)


def _decode_statustext(payload: bytes) -> StatusText:
    severity, text = _fields(_STATUSTEXT, payload)
    return StatusText(severity, text_of(text))


def _decode_param_error(payload: bytes) -> ParamError:
    index, system, component, name, error = _fields(_PARAM_ERROR, payload)
    return ParamError(system, component, text_of(name), index, error)


def _decode_param_ext_request_read(payload: bytes) -> ParamExtRequestRead:
    index, system, component, name = _fields(_PARAM_REQUEST_READ, payload)
    return ParamExtRequestRead(system, component, text_of(name), index)


def _decode_param_ext_request_list(payload: bytes) -> ParamExtRequestList:
    return ParamExtRequestList(*_fields(_PARAM_REQUEST_LIST, payload))


def _decode_param_ext_value(payload: bytes) -> ParamExtValue:
    count, index, name, raw, number = _fields(_PARAM_EXT_VALUE, payload)
    return ParamExtValue(text_of(name), raw, number, count, index)


def _decode_param_ext_set(payload: bytes) -> ParamExtSet:
    system, component, name, raw, number = _fields(_PARAM_EXT_SET, payload)
    return ParamExtSet(system, component, text_of(name), raw, number)


def _decode_param_ext_ack(payload: bytes) -> ParamExtAck:
    name, raw, number, result = _fields(_PARAM_EXT_ACK, payload)
    return ParamExtAck(text_of(name), raw, number, result)


def _decode_file_transfer(payload: bytes) -> FileTransfer:
    return FileTransfer(*_fields(_FILE_TRANSFER, payload))


def _decode_system_time(payload: bytes) -> SystemTime:
    return SystemTime(*_fields(_SYSTEM_TIME, payload))


def _decode_high_latency2(payload: bytes) -> HighLatency2:
    return HighLatency2(*_fields(_HIGH_LATENCY2, payload))


def _decode_setup_signing(payload: bytes) -> SetupSigning:
    timestamp, system, component, secret = _fields(_SETUP_SIGNING, payload)
    key = SigningKey(secret) if any(secret) else None
    return SetupSigning(system, component, key, timestamp)


def _decode_component_metadata(payload: bytes) -> ComponentMetadata:
    crc, uri = _fields(_COMPONENT_METADATA, payload)
    return ComponentMetadata(text_of(uri), crc)


_DECODERS: dict[int, Callable[[bytes], Message]] = {
    0: _decode_heartbeat,
    2: _decode_system_time,
    20: _decode_param_request_read,
    21: _decode_param_request_list,
    PARAM_VALUE_ID: decode_param_value,
    23: _decode_param_set,
    76: _decode_command_long,
    77: _decode_command_ack,
    110: _decode_file_transfer,
    148: _decode_autopilot_version,
    235: _decode_high_latency2,
    253: _decode_statustext,
    256: _decode_setup_signing,
    320: _decode_param_ext_request_read,
    321: _decode_param_ext_request_list,
    PARAM_EXT_VALUE_ID: _decode_param_ext_value,
    323: _decode_param_ext_set,
    324: _decode_param_ext_ack,
    345: _decode_param_error,
    COMPONENT_METADATA_ID: _decode_component_metadata,
}

DECODED_IDS: Final = frozenset(_DECODERS)
"""The message ids that `decode` supports."""


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
    ParamSetMessage: lambda m: (
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
    FileTransfer: lambda m: (
        110,
        _FILE_TRANSFER.pack(m.target_network, m.target_system, m.target_component, m.payload),
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
    ParamExtRequestRead: lambda m: (
        320,
        _PARAM_REQUEST_READ.pack(m.param_index, m.target_system, m.target_component, _name(m.param_id)),
    ),
    ParamExtRequestList: lambda m: (321, _PARAM_REQUEST_LIST.pack(m.target_system, m.target_component)),
    ParamExtValue: lambda m: (
        PARAM_EXT_VALUE_ID,
        _PARAM_EXT_VALUE.pack(m.param_count, m.param_index, _name(m.param_id), m.raw, m.param_type),
    ),
    ParamExtSet: lambda m: (
        323,
        _PARAM_EXT_SET.pack(m.target_system, m.target_component, _name(m.param_id), m.raw, m.param_type),
    ),
    ParamExtAck: lambda m: (
        324,
        _PARAM_EXT_ACK.pack(_name(m.param_id), m.raw, m.param_type, m.param_result),
    ),
    SystemTime: lambda m: (2, _SYSTEM_TIME.pack(m.time_unix_usec, m.time_boot_ms)),
    HighLatency2: lambda m: (235, _HIGH_LATENCY2.pack(m.type, m.autopilot)),
    SetupSigning: lambda m: (
        256,
        _SETUP_SIGNING.pack(
            m.initial_timestamp, m.target_system, m.target_component, b"" if m.key is None else m.key.secret
        ),
    ),
    ComponentMetadata: lambda m: (
        COMPONENT_METADATA_ID,
        _COMPONENT_METADATA.pack(m.file_crc, m.uri.encode("latin-1")),
    ),
}
