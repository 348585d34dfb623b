"""Telemetry logs: eight bytes of time, big-endian, in unix microseconds, before each frame.

The form of Mission Planner, MAVProxy, QGroundControl and pymavlink.
"""

from __future__ import annotations

import math
import re
import stat
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from paramclient.errors import LinkError

__all__ = ["Record", "open_log", "packed_time", "read_records"]

BLOCK: Final = 65536
"""Bytes that are read at once."""
FIRST_WITHIN: Final = 1 << 20
"""Bytes in which a log's first frame begins: what is no log may be a disk image, too long to be read."""
LONGEST_LEAP: Final = 366 * 86400.0
"""Seconds between two frames that are believed at once. A longer leap must be shared by the next frame: a
clock that was not set begins with 1970 or 1980, and logs of many years may be joined; damage is alone."""
LATEST: Final = 7_258_118_400.0
"""The latest time that a frame may have, in the year 2200: bytes that are no log have any."""

_TIME: Final = struct.Struct(">Q")
_LONGEST_RECORD: Final = 8 + 12 + 255 + 13
_LOOKED_AT: Final = _LONGEST_RECORD + 8 + 3
"""Bytes that say whether a record is one: it, and the beginning of the next one."""
_MAGIC_V1: Final = 0xFE
_MAGIC_V2: Final = 0xFD
_MAGIC: Final = re.compile(b"[\xfd\xfe]").search


class Record(NamedTuple):
    """One frame of a log.

    Attributes:
        at: when, in unix seconds.
        data: the frame as it stood on the wire; nothing proves it.
    """

    at: float
    data: bytes


def packed_time(at: float) -> bytes:
    """A time, in unix seconds, as it stands in a log: 1970 for a clock that stands before it."""
    return _TIME.pack(max(0, round(at * 1e6)))


def open_log(path: str, name: str) -> BinaryIO:
    """Open a log.

    Args:
        path: the file.
        name: of the link, for the error.

    Raises:
        LinkError: it cannot be read, or is no log. Nor is what is no regular file: it may have no end, or
            keep us waiting.
    """
    try:
        mode = Path(path).stat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise LinkError(f"{name}: {path} is no regular file", link=name)
        file = Path(path).open("rb")  # noqa: SIM115 - the caller closes it
    except LinkError:
        raise
    except OSError as error:
        raise LinkError(f"{name}: cannot open {path}: {error.strerror}", link=name) from error
    try:
        if next(read_records(BytesIO(file.read(FIRST_WITHIN))), None) is None:
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
    before = -math.inf
    is_over = False
    while True:
        if not is_over and len(buffer) - start < _LOOKED_AT:
            block = file.read(BLOCK)
            is_over = not block
            buffer = buffer[start:] + block
            start = 0
            continue
        size = _size_at(buffer, start + 8)
        if size is None:
            return
        end = start + 8 + size
        at = _time_at(buffer, start)
        if (
            size
            and at <= LATEST
            and (_are_near(at, before) or _is_shared(buffer, end, at, alone=before == -math.inf))
        ):
            if end > len(buffer):
                return
            yield Record(at, buffer[start + 8 : end])
            before = at
            start = end
        else:
            candidate = _MAGIC(buffer, start + 9)
            start = max(start + 1, len(buffer) - 8) if candidate is None else candidate.start() - 8


def _size_at(buffer: bytes, at: int) -> int | None:
    """Bytes of the frame that begins there, 0 where none does; None where the end cuts off its header."""
    if at + 3 > len(buffer):
        return None
    if buffer[at] == _MAGIC_V1:
        return 8 + buffer[at + 1]
    if buffer[at] == _MAGIC_V2:
        return 12 + buffer[at + 1] + (13 if buffer[at + 2] & 1 else 0)
    return 0


def _time_at(buffer: bytes, at: int) -> float:
    return float(_TIME.unpack_from(buffer, at)[0] / 1e6)


def _are_near(at: float, before: float) -> bool:
    return abs(at - before) <= LONGEST_LEAP


def _is_shared(buffer: bytes, end: int, at: float, *, alone: bool) -> bool:
    """Whether what stands behind a record is one of about the same time; the end will do for one alone."""
    size = _size_at(buffer, end + 8)
    if size is None:
        return alone
    return size > 0 and _are_near(_time_at(buffer, end), at)
