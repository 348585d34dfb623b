"""On-board logs for tests, written by hand: the bytes that the formats' documents describe."""

from __future__ import annotations

import struct
from collections.abc import Iterable

FORMATS = {
    "FMT": (0x80, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "PARM": (0x81, "QNff", "TimeUS,Name,Value,Default"),
    "MSG": (0x82, "QZ", "TimeUS,Message"),
    "GPS": (0x83, "QBBIHB", "TimeUS,I,Status,GMS,GWk,NSats"),
    "VER": (0x84, "QBHBBBBIZHBQ", "TimeUS,BT,BST,Maj,Min,Pat,FWT,GH,FWS,APJ,BU,FV"),
    "OLD": (0x81, "QNf", "TimeUS,Name,Value"),
}
"""Number, format and columns of each message; OLD is the PARM of versions before 4.3."""
SIZES = {"B": "B", "H": "H", "I": "I", "Q": "Q", "f": "f", "n": "4s", "N": "16s", "Z": "64s"}


def dataflash(messages: Iterable[tuple[object, ...]]) -> bytes:
    """Return a dataflash log with these messages, each a name and the fields."""
    written = [*messages]
    names = dict.fromkeys(["FMT", *(str(name) for name, *_ in written)])
    head = b"".join(_message("FMT", *_format(name)) for name in names)
    return head + b"".join(_message(str(name), *fields) for name, *fields in written)


def _format(name: str) -> tuple[object, ...]:
    number, layout, columns = FORMATS[name]
    shown = "PARM" if name == "OLD" else name
    size = 3 + struct.calcsize("<" + "".join(SIZES[each] for each in layout))
    return number, size, shown, layout, columns


def _message(name: str, *fields: object) -> bytes:
    number, layout, _ = FORMATS[name]
    packed = [field.encode() if isinstance(field, str) else field for field in fields]
    return bytes((0xA3, 0x95, number)) + struct.pack("<" + "".join(SIZES[each] for each in layout), *packed)


class ULogWriter:
    """Writes a ULog file, message by message, to `data`."""

    def __init__(self, *, start: int = 0, has_defaults: bool = True) -> None:
        self.data = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start))
        self._add("B", bytes((has_defaults, *[0] * 39)))
        self._add("F", b"vehicle_status:uint64_t timestamp;uint8_t arming_state;")
        self._add("F", b"vehicle_gps_position:uint64_t timestamp;uint64_t time_utc_usec;uint8_t fix_type;")

    def info(self, name: str, value: str | int) -> None:
        self._add("I", _entry(name, value))

    def param(self, name: str, value: float) -> None:
        self._add("P", _entry(name, value))

    def default(self, name: str, value: float, types: int = 1) -> None:
        self._add("Q", bytes((types,)) + _entry(name, value))

    def begin_data(self) -> None:
        self._add("A", b"\0" + struct.pack("<H", 0) + b"vehicle_status")
        self._add("A", b"\0" + struct.pack("<H", 1) + b"vehicle_gps_position")

    def status(self, time: int) -> None:
        self._add("D", struct.pack("<HQB", 0, time, 1))

    def gps(self, time: int, utc: int, fix: int) -> None:
        self._add("D", struct.pack("<HQQB", 1, time, utc, fix))

    def _add(self, kind: str, data: bytes) -> None:
        self.data += struct.pack("<HB", len(data), ord(kind)) + data


def _entry(name: str, value: str | float) -> bytes:
    if isinstance(value, str):
        kind, data = f"char[{len(value)}]", value.encode()
    elif isinstance(value, int):
        kind, data = "int32_t", struct.pack("<i", value)
    else:
        kind, data = "float", struct.pack("<f", value)
    key = f"{kind} {name}".encode()
    return bytes((len(key),)) + key + data
