"""Telemetry logs (.tlog), also as links: a time, 8 bytes, big-endian, Unix microseconds, before each frame.

The file format of Mission Planner, MAVProxy, QGroundControl and pymavlink.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import anyio
import anyio.lowlevel

from paramclient.errors import LinkError
from paramclient.links.link import BaseLink, Peer, reason
from paramclient.links.names import LinkSpec
from paramclient.wire.frames import find_magic, frame_size

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
        size = frame_size(buffer, start + 8)
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
            candidate = find_magic(buffer, start + 9)
            start = max(start + 1, len(buffer) - 8) if candidate is None else candidate.start() - 8


def _time_at(buffer: bytes, at: int) -> float:
    return float(_TIME.unpack_from(buffer, at)[0] / 1e6)


def _is_confirmed(buffer: bytes, end: int, at: float, alone: bool) -> bool:
    """Return whether the next record has about the same time; at the end of the file, return `alone`."""
    size = frame_size(buffer, end + 8)
    if size is None:
        return alone
    return size > 0 and abs(_time_at(buffer, end) - at) <= TIME_STEP_MAX


LOG_PEER: Final = "log"
"""The only peer of a log."""
RECORDS_PER_READ: Final = 256
"""Frames that one `receive` returns at most, so that other tasks run in between."""
PAUSE_MAX: Final = 60.0
"""Seconds of the log after which a pause is shortened: joined logs may be days apart."""


class ReplayLink(BaseLink):
    """Delivers the frames of a log, of both directions, at the times in the log.

    Data that is sent is discarded. Opening the link again starts at the beginning of the log.

    Args:
        spec: a parsed name such as `replay:flight.tlog?speed=10`: ten times the original speed. 0 is as fast
            as the file can be read; without speed, the original speed.

    Attributes:
        at: the time of the last delivered frame, as a Unix time in seconds; None before the first.
    """

    reconnects = False

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec.name)
        self.at: float | None = None
        self._path = spec.host
        self._speed = dict(spec.options).get("speed", 1.0)
        self._file: BinaryIO | None = None
        self._records: Iterator[Record] = iter(())
        self._next: Record | None = None
        self._due = -math.inf
        self._closed = anyio.Event()

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`."""
        with anyio.CancelScope(deadline=self._due):
            await self._closed.wait()
        self._opened()
        found: list[tuple[Peer, bytes]] = []
        while self._next is not None and self._due <= anyio.current_time() and len(found) < RECORDS_PER_READ:
            found.append((LOG_PEER, self._next.data))
            self.at = self._next.at
            try:
                self._next = next(self._records, None)
            except OSError as error:
                raise self._error(f"cannot read: {reason(error)}") from error
            if self._next is not None and self._speed:
                self._due += min(max(self._next.at - self.at, 0.0), PAUSE_MAX) / self._speed
        if not found:  # the log is over
            self._due = math.inf
        return found

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`; discards the data."""
        await anyio.lowlevel.checkpoint()

    async def _open(self, opening: int) -> None:
        await anyio.lowlevel.checkpoint()
        self._file = open_log(self._path, self.name)
        self._records = read_records(self._file)
        self._closed = anyio.Event()
        self._due = anyio.current_time()
        self._next = next(self._records, None)

    async def _release(self) -> None:
        self._closed.set()
        if self._file is not None:
            self._file.close()
            self._file = None
