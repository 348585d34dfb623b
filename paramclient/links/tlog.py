"""Telemetry logs: eight bytes of time, big-endian, in unix microseconds, before each frame.

The form of Mission Planner, MAVProxy, QGroundControl and pymavlink.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from paramclient.errors import LinkError

__all__ = ["Record", "open_log", "packed_time", "read_records"]

BLOCK: Final = 65536
"""Bytes that are read at once."""
LONGEST_LEAP: Final = 366 * 86400.0
"""Seconds between two frames that are believed behind a damaged place: logs of many days may be joined."""
EARLIEST: Final = 315_532_800.0
LATEST: Final = 7_258_118_400.0
"""Times that the first frame of a log may have, 1980 to 2200: an autopilot without a clock begins with the
former, and bytes that are no log have any."""

_TIME: Final = struct.Struct(">Q")
_LONGEST_RECORD: Final = 8 + 12 + 255 + 13
_MAGIC_V1: Final = 0xFE
_MAGIC_V2: Final = 0xFD


class Record(NamedTuple):
    """One frame of a log.

    Attributes:
        at: when, in unix seconds.
        data: the frame as it stood on the wire; nothing proves it.
    """

    at: float
    data: bytes


def packed_time(at: float) -> bytes:
    """A time, in unix seconds, as it stands in a log."""
    return _TIME.pack(round(at * 1e6))


def open_log(path: str, name: str) -> BinaryIO:
    """Open a log.

    Args:
        path: the file.
        name: of the link, for the error.

    Raises:
        LinkError: it cannot be read, or is no log.
    """
    try:
        file = Path(path).open("rb")  # noqa: SIM115 - the caller closes it
    except OSError as error:
        raise LinkError(f"{name}: cannot open {path}: {error.strerror}", link=name) from error
    try:
        if next(read_records(file), None) is None:
            raise LinkError(f"{name}: {path} is no telemetry log, or holds no frame", link=name)
        file.seek(0)
    except OSError as error:
        file.close()
        if isinstance(error, LinkError):
            raise
        raise LinkError(f"{name}: cannot read {path}: {error.strerror}", link=name) from error
    return file


def read_records(file: BinaryIO) -> Iterator[Record]:
    """The frames of a log, in order.

    Where what stands there is no record, as behind a write that was cut off, the next place is looked for
    that may be one. A record that the end cuts off is left out.
    """
    buffer = b""
    start = 0
    before: float | None = None
    is_over = False
    while True:
        if not is_over and len(buffer) - start < _LONGEST_RECORD:
            block = file.read(BLOCK)
            is_over = not block
            buffer = buffer[start:] + block
            start = 0
            continue
        size = _size_at(buffer, start + 8)
        if size is None:
            return
        at = _TIME.unpack_from(buffer, start)[0] / 1e6
        if size and _may_be(at, before):
            end = start + 8 + size
            if end > len(buffer):
                return
            yield Record(at, buffer[start + 8 : end])
            before = at
            start = end
        else:
            start += 1


def _size_at(buffer: bytes, at: int) -> int | None:
    """Bytes of the frame that begins there, 0 where none does; None where the end cuts off its header."""
    if at + 3 > len(buffer):
        return None
    if buffer[at] == _MAGIC_V1:
        return 8 + buffer[at + 1]
    if buffer[at] == _MAGIC_V2:
        return 12 + buffer[at + 1] + (13 if buffer[at + 2] & 1 else 0)
    return 0


def _may_be(at: float, before: float | None) -> bool:
    if before is None:
        return EARLIEST <= at <= LATEST
    return abs(at - before) <= LONGEST_LEAP
