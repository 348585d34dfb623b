"""Telemetry logs (.tlog): 8 bytes of time, big-endian, in Unix microseconds, before each frame.

The file format of Mission Planner, MAVProxy, QGroundControl and pymavlink.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from paramclient.errors import LinkError

BLOCK_SIZE: Final = 65536
"""Bytes per read."""
FIRST_FRAME_OFFSET_MAX: Final = 1 << 20
"""Bytes within which the first frame must begin: the file may be a disk image, too long to be searched."""
TIME_STEP_MAX: Final = 366 * 86400.0
"""Seconds between two frames that are accepted without a check. After a larger step, the next frame must have
about the same time: a clock that was not set starts in 1970 or 1980, and logs of many years may be joined,
but damage affects a single frame."""
TIME_MAX: Final = 7_258_118_400.0
"""Latest Unix time of a frame, in the year 2200, to reject random bytes."""

_TIME: Final = struct.Struct(">Q")
_LONGEST_RECORD: Final = 8 + 12 + 255 + 13
_RECORD_CHECK_SIZE: Final = _LONGEST_RECORD + 8 + 3
"""Bytes that decide whether a record is valid: the record, and the beginning of the next one."""
_MAGIC_V1: Final = 0xFE
_MAGIC_V2: Final = 0xFD
_MAGIC: Final = re.compile(b"[\xfd\xfe]").search


class Record(NamedTuple):
    """One frame of a log.

    Attributes:
        at: Unix time in seconds.
        data: the frame as on the wire; its checksum is not verified.
    """

    at: float
    data: bytes


def packed_time(at: float) -> bytes:
    """Return a Unix time in seconds, encoded for a log; times before 1970 become 1970."""
    return _TIME.pack(max(0, round(at * 1e6)))


def open_log(path: str, name: str) -> BinaryIO:
    """Open a log.

    Args:
        path: the file.
        name: the link's name, for errors.

    Raises:
        LinkError: the file cannot be read, is not a log, or is not a regular file, which may be endless or
            block the reader.
    """

    def error(problem: str) -> LinkError:
        return LinkError(f"{name}: {problem}", link=name)

    where = Path(path)
    if where.exists() and not (where.is_file() or where.is_dir()):
        raise error(f"{path} is not a regular file")
    try:
        file = where.open("rb")
        first = next(read_records(BytesIO(file.read(FIRST_FRAME_OFFSET_MAX))), None)
        file.seek(0)
    except OSError as problem:
        raise error(f"cannot open {path}: {problem.strerror}") from problem
    if first is None:
        file.close()
        raise error(f"{path} is not a telemetry log, or contains no frames")
    return file


def read_records(file: BinaryIO) -> Iterator[Record]:
    """Generate the frames of a log, in order.

    Skips invalid bytes, as after an interrupted write, up to the next possible record. Leaves out a record
    that the end of the file cuts off.
    """
    buffer = b""
    start = 0
    before = -math.inf
    is_over = False
    while True:
        if not is_over and len(buffer) - start < _RECORD_CHECK_SIZE:
            block = file.read(BLOCK_SIZE)
            is_over = not block
            buffer = buffer[start:] + block
            start = 0
            continue
        size = _size_at(buffer, start + 8)
        if size is None:
            return
        end = start + 8 + size
        at = _time_at(buffer, start)
        is_near = abs(at - before) <= TIME_STEP_MAX
        if size and at <= TIME_MAX and (is_near or _is_confirmed(buffer, end, at, before == -math.inf)):
            if end > len(buffer):
                return
            yield Record(at, buffer[start + 8 : end])
            before = at
            start = end
        else:
            candidate = _MAGIC(buffer, start + 9)
            start = max(start + 1, len(buffer) - 8) if candidate is None else candidate.start() - 8


def _size_at(buffer: bytes, at: int) -> int | None:
    """Return the size of the frame at a position, 0 for no frame, None if the end cuts off its header."""
    if at + 3 > len(buffer):
        return None
    if buffer[at] == _MAGIC_V1:
        return 8 + buffer[at + 1]
    if buffer[at] == _MAGIC_V2:
        return 12 + buffer[at + 1] + (13 if buffer[at + 2] & 1 else 0)
    return 0


def _time_at(buffer: bytes, at: int) -> float:
    return float(_TIME.unpack_from(buffer, at)[0] / 1e6)


def _is_confirmed(buffer: bytes, end: int, at: float, alone: bool) -> bool:
    """Return whether the next record has about the same time; at the end of the file, return `alone`."""
    size = _size_at(buffer, end + 8)
    if size is None:
        return alone
    return size > 0 and abs(_time_at(buffer, end) - at) <= TIME_STEP_MAX
