"""Everything that goes over a link into a telemetry log, in a thread, never in anybody's way."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import anyio

from paramclient.client.worker_thread import Worker
from paramclient.errors import UsageError
from paramclient.links import Peer
from paramclient.links.tlog import packed_time
from paramclient.protocol.stats.sniffer import FrameCutter
from paramclient.protocol.wire import bears_key, unsign_frame

__all__ = ["Capture"]

FLUSH_INTERVAL: Final = 0.25
"""Seconds that frames are gathered for before they are written: what a killed process may lose."""
MOST_UNWRITTEN: Final = 16 * 1024 * 1024
"""Bytes that may wait for the disk: ten seconds of a link with 100 Mbit/s, an hour of a radio. A disk that
falls further behind does not come back, and memory is not to follow it."""

_OURS: Final = None
"""Who sent a frame of the station itself, in the place of a peer."""

logger = logging.getLogger(__name__)


class _Chunk(NamedTuple):
    """What came or went at a time; our own without a peer, and the end of what came before without data."""

    at: bytes
    peer: Peer | None
    data: bytes


class Capture:
    """Writes a `.tlog`: before each frame the time, eight bytes, big-endian, in unix microseconds.

    Frames of both directions are written whole, without their signatures, in the order in which the client
    read and sent them; the time is that of the reading, which may be up to 20 ms after the arrival. Damaged
    frames, other bytes, and messages with a key for signing are left out.

    A file that cannot be written any more ends the capture with a warning in the log, and nothing else: what
    stands in it up to there is whole.

    Args:
        path: of a file that is made here.
        is_stream: whether the link delivers a stream.
    """

    def __init__(self, path: str | os.PathLike[str], *, is_stream: bool) -> None:
        self._path = Path(path)
        self._cutter = FrameCutter(stream=is_stream)
        self._worker = Worker("paramclient tlog")
        self._file: int | None = None
        self._unwritten: list[_Chunk] = []
        self._size = 0
        self._has_failed = False
        self._something_to_write = anyio.Event()

    async def open(self) -> None:
        """Make the file.

        Raises:
            UsageError: it exists, or cannot be made.
        """
        await self._worker.run(self._create)

    def received(self, data: bytes, peer: Peer) -> None:
        """Take what the link has delivered; an empty chunk says that the peer's stream has ended."""
        self._take(peer, data)

    def sent(self, data: bytes) -> None:
        """Take a frame that went out."""
        self._take(_OURS, data)

    def pause(self) -> None:
        """The link is away: what was cut off by that is not continued."""
        self._unwritten.append(_Chunk(packed_time(time.time()), _OURS, b""))

    async def run(self) -> None:
        """Write in batches, until cancelled."""
        while not self._has_failed:
            await self._something_to_write.wait()
            self._something_to_write = anyio.Event()
            await anyio.sleep(FLUSH_INTERVAL)
            await self._flush()

    async def close(self) -> None:
        """Write what is left, and end the thread."""
        try:
            self.pause()
            await self._flush()
        finally:
            await self._worker.close(self._close)

    def _take(self, peer: Peer | None, data: bytes) -> None:
        if self._has_failed:
            return
        self._size += len(data)
        if self._size > MOST_UNWRITTEN:
            self._fail("the disk does not keep up")
            return
        self._unwritten.append(_Chunk(packed_time(time.time()), peer, data))
        self._something_to_write.set()

    async def _flush(self) -> None:
        batch, self._unwritten, self._size = self._unwritten, [], 0
        if self._has_failed or self._file is None or not batch:
            return
        try:
            await self._worker.run(partial(self._write, batch))
        except OSError as error:
            self._fail(error.strerror or str(error))

    def _fail(self, why: str) -> None:
        self._has_failed = True
        self._unwritten.clear()
        logger.warning("nothing more is written to %s: %s", self._path, why)

    # in the thread

    def _create(self) -> None:
        try:
            self._file = os.open(self._path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | _BINARY, 0o666)
        except FileExistsError:
            raise UsageError(f"the log {self._path} exists, and is not written over; name another") from None
        except OSError as error:
            raise UsageError(f"the log {self._path} cannot be made: {error.strerror}") from error

    def _write(self, batch: Sequence[_Chunk]) -> None:
        """Write a batch; where that fails, the file ends with a whole frame all the same."""
        assert self._file is not None
        data = b"".join(part for chunk in batch for frame in self._cut(chunk) for part in (chunk.at, frame))
        whole = os.fstat(self._file).st_size
        try:
            while data:
                data = data[os.write(self._file, data) :]
        except OSError:
            os.ftruncate(self._file, whole)
            raise

    def _cut(self, chunk: _Chunk) -> Sequence[bytes]:
        if chunk.peer is not _OURS:
            frames = self._cutter.cut(chunk.data, chunk.peer)
        elif chunk.data:
            frames = [] if bears_key(chunk.data) else [chunk.data]
        else:
            frames = self._cutter.flush()
        return [unsign_frame(frame) for frame in frames]

    def _close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None


_BINARY: Final = getattr(os, "O_BINARY", 0)  # of Windows
