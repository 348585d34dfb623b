"""Capture: a telemetry log (`.tlog`) of all frames of a link, written in a thread."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Hashable, Sequence
from io import FileIO
from pathlib import Path
from typing import Final

import anyio
import anyio.to_thread

from paramclient.client.taps import SeenFrame, Tap
from paramclient.errors import UsageError
from paramclient.links.tlog import packed_time
from paramclient.wire.frames import bears_key, unsign_frame

RECORDING_FLUSH_INTERVAL: Final = 0.25
"""Seconds between two writes to the file: a killed process loses the frames of at most this time."""
UNWRITTEN_BYTES_MAX: Final = 16 * 1024 * 1024
"""Maximum number of bytes queued for the disk: 10 seconds of a link with 100 Mbit/s, an hour of a radio. A
disk that falls further behind does not catch up, and the limit bounds memory."""

logger = logging.getLogger(__name__)


class Capture(Tap):
    """Writes a `.tlog`: each frame follows its time, eight bytes, big-endian, in unix microseconds.

    The file has complete frames of both directions, without signatures, in the order in which the client read
    and sent them. The time is that of the read, up to 20 ms after the arrival. Damaged frames, other bytes,
    and messages with a signing key are omitted.

    A write error ends the capture with a warning in the log and has no other effect. The file then ends with
    a complete frame.

    Args:
        path: file to create.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)
        self._file: FileIO | None = None
        self._unwritten = bytearray()
        self._has_failed = False
        self._something_to_write = anyio.Event()

    async def open(self) -> None:
        """Create the file.

        Raises:
            UsageError: the file exists, or cannot be created.
        """
        try:
            self._file = await anyio.to_thread.run_sync(FileIO, self._path, "x")
        except FileExistsError:
            raise UsageError(
                f"the log {self._path} exists and is not overwritten; name another file"
            ) from None
        except OSError as error:
            raise UsageError(f"the log {self._path} cannot be created: {error.strerror}") from error

    def received(self, frames: Sequence[SeenFrame], size: int, peer: Hashable) -> None:
        """Queue received frames."""
        for each in frames:
            self.sent(each.data)

    def sent(self, frame: bytes) -> None:
        """Queue a frame."""
        if self._has_failed or bears_key(frame):
            return
        self._unwritten += packed_time(time.time()) + unsign_frame(frame)
        self._something_to_write.set()
        if len(self._unwritten) > UNWRITTEN_BYTES_MAX:
            self._fail("the disk is slower than the link")

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
            await self._flush()
        finally:
            if self._file is not None:
                await anyio.to_thread.run_sync(self._file.close)

    async def _flush(self) -> None:
        batch, self._unwritten = self._unwritten, bytearray()
        if self._has_failed or self._file is None or not batch:
            return
        try:
            with anyio.CancelScope(shield=True):  # the batch is no longer queued
                await anyio.to_thread.run_sync(_write, self._file, batch)
        except OSError as error:
            self._fail(error.strerror or str(error))

    def _fail(self, why: str) -> None:
        self._has_failed = True
        self._unwritten.clear()
        logger.warning("the telemetry log %s ends here: %s", self._path, why)


def _write(file: FileIO, data: bytearray) -> None:
    """Write a batch. After an error, truncate the file to its last complete batch.

    Raises:
        OSError: the batch cannot be written.
    """
    whole = file.tell()
    try:
        while data:
            data = data[file.write(data) :]
    except OSError:
        file.truncate(whole)
        raise
