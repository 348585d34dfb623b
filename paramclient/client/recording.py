"""Capture: a telemetry log (`.tlog`) of all frames of a link, written in a thread."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import anyio
import anyio.to_thread

from paramclient.client.frame_cutter import FrameCutter
from paramclient.errors import UsageError
from paramclient.links import Peer
from paramclient.links.tlog import packed_time
from paramclient.wire.frames import bears_key, unsign_frame

__all__ = ["Capture"]

RECORDING_FLUSH_INTERVAL: Final = 0.25
"""Seconds between two writes to the file: a killed process loses the frames of at most this time."""
UNWRITTEN_BYTES_MAX: Final = 16 * 1024 * 1024
"""Maximum number of bytes queued for the disk: 10 seconds of a link with 100 Mbit/s, an hour of a radio. A
disk that falls further behind does not catch up, and the limit bounds memory."""

_OURS: Final = None
"""Value of `peer` for frames that this client sends."""

logger = logging.getLogger(__name__)


class _Chunk(NamedTuple):
    """Data received or sent, with its time in `.tlog` encoding.

    Sent data has no peer. Empty data marks the end of a stream.
    """

    at: bytes
    peer: Peer | None
    data: bytes


class Capture:
    """Writes a `.tlog`: each frame follows its time, eight bytes, big-endian, in unix microseconds.

    The file has complete frames of both directions, without signatures, in the order in which the client read
    and sent them. The time is that of the read, up to 20 ms after the arrival. Damaged frames, other bytes,
    and messages with a signing key are omitted.

    A write error ends the capture with a warning in the log and has no other effect. The file then ends with
    a complete frame.

    Args:
        path: file to create.
        is_stream: whether the link delivers a byte stream.
    """

    def __init__(self, path: str | os.PathLike[str], *, is_stream: bool) -> None:
        self._path = Path(path)
        self._cutter = FrameCutter(stream=is_stream)
        self._file: int | None = None
        self._unwritten: list[_Chunk] = []
        self._size = 0
        self._has_failed = False
        self._something_to_write = anyio.Event()

    async def open(self) -> None:
        """Create the file.

        Raises:
            UsageError: the file exists, or cannot be created.
        """
        await anyio.to_thread.run_sync(self._create)

    def received(self, data: bytes, peer: Peer) -> None:
        """Queue received data; empty data marks the end of the peer's stream."""
        self._take(peer, data)

    def sent(self, data: bytes) -> None:
        """Queue a sent frame."""
        self._take(_OURS, data)

    def pause(self) -> None:
        """Discard an incomplete frame: the link is disconnected."""
        self._unwritten.append(_Chunk(packed_time(time.time()), _OURS, b""))

    async def run(self) -> None:
        """Write the queued frames in batches, until cancelled or a write error."""
        while not self._has_failed:
            await self._something_to_write.wait()
            self._something_to_write = anyio.Event()
            await anyio.sleep(RECORDING_FLUSH_INTERVAL)
            await self._flush()

    async def close(self) -> None:
        """Write the queued frames and close the file."""
        try:
            self.pause()
            await self._flush()
        finally:
            await anyio.to_thread.run_sync(self._close)

    def _take(self, peer: Peer | None, data: bytes) -> None:
        if self._has_failed:
            return
        self._size += len(data)
        if self._size > UNWRITTEN_BYTES_MAX:
            self._fail("the disk is slower than the link")
            return
        self._unwritten.append(_Chunk(packed_time(time.time()), peer, data))
        self._something_to_write.set()

    async def _flush(self) -> None:
        batch, self._unwritten, self._size = self._unwritten, [], 0
        if self._has_failed or self._file is None or not batch:
            return
        try:
            with anyio.CancelScope(shield=True):  # the batch is no longer queued
                await anyio.to_thread.run_sync(self._write, batch)
        except OSError as error:
            self._fail(error.strerror or str(error))

    def _fail(self, why: str) -> None:
        self._has_failed = True
        self._unwritten.clear()
        logger.warning("the telemetry log %s ends here: %s", self._path, why)

    # called in the thread

    def _create(self) -> None:
        try:
            self._file = os.open(self._path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | _BINARY, 0o666)
        except FileExistsError:
            raise UsageError(
                f"the log {self._path} exists and is not overwritten; name another file"
            ) from None
        except OSError as error:
            raise UsageError(f"the log {self._path} cannot be created: {error.strerror}") from error

    def _write(self, batch: Sequence[_Chunk]) -> None:
        """Write a batch. After an error, truncate the file to its last complete batch.

        Raises:
            OSError: the batch cannot be written.
        """
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


_BINARY: Final = getattr(os, "O_BINARY", 0)
"""Flag of `os.open` on Windows for binary mode; 0 elsewhere."""
