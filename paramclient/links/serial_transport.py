"""Serial ports through serialx's asyncio transport: for Windows, where a port is not a file descriptor."""

from __future__ import annotations

import asyncio
import errno
import os
from collections import deque
from typing import Final

import anyio
import serialx

from paramclient.errors import UsageError

__all__ = ["Transport"]

CLOSE_TIMEOUT: Final = 2.0
"""Seconds that closing waits for the driver."""

UNREAD_BYTES_MAX: Final = 65536
"""Received bytes that may wait for a reader; above it reading pauses, and the operating system drops
bytes."""


class Transport(asyncio.Protocol):
    """An open port with the interface that `paramclient.links.serial` needs.

    Takes bytes from the operating system as they arrive, up to `UNREAD_BYTES_MAX`. Bytes to send wait for the
    operating system, one frame at a time.

    Attributes:
        unread: received bytes that wait for a reader.
    """

    def __init__(self) -> None:
        self._chunks: deque[bytes] = deque()
        self.unread = 0
        self._changed = anyio.Event()
        self._may_write = anyio.Event()
        self._may_write.set()
        self._is_closed = False
        self._loss: OSError | None = None
        self._transport: serialx.BaseSerialTransport

    @classmethod
    async def opened(cls, device: str, baud: int) -> Transport:
        """Open a port. OSError if that fails; UsageError on event loops other than asyncio's own."""
        port = cls()
        try:
            loop = asyncio.get_running_loop()
            port._transport, _ = await serialx.create_serial_connection(loop, lambda: port, device, baud)
        except serialx.UnsupportedSetting as error:
            raise UsageError(f"{device}: this system does not support {baud} baud") from error
        except RuntimeError as error:  # trio, or an asyncio loop without pipes
            raise UsageError(f"{device}: on Windows serial ports need asyncio's own event loop") from error
        port._transport.set_write_buffer_limits(high=0)
        return port

    async def read(self) -> bytes:
        """Wait for bytes; return b"" if the port is closed meanwhile."""
        while not self._chunks and not self._is_closed:
            self._changed = anyio.Event()
            await self._changed.wait()
        if not self._chunks and self._loss is not None:
            raise self._loss
        data = b"".join(self._chunks)
        self._chunks.clear()
        self.unread = 0
        self._transport.resume_reading()
        return data

    async def write(self, data: bytes) -> None:
        """Wait until the operating system has accepted all bytes, or the port is closed."""
        await self._may_write.wait()
        if not self._is_closed:
            self._transport.write(data)
            await self._may_write.wait()
        if self._loss is not None:
            raise self._loss

    async def close(self) -> None:
        """Wake waiting tasks, drop unsent bytes, close."""
        self._finish(None)
        with anyio.move_on_after(CLOSE_TIMEOUT, shield=True):
            self._transport.abort()
            await self._transport.wait_closed()

    # asyncio.Protocol: called by the transport

    def data_received(self, data: bytes) -> None:
        self._chunks.append(data)
        self.unread += len(data)
        if self.unread >= UNREAD_BYTES_MAX:
            self._transport.pause_reading()
        self._changed.set()

    def pause_writing(self) -> None:
        self._may_write = anyio.Event()

    def resume_writing(self) -> None:
        self._may_write.set()

    def connection_lost(self, exc: Exception | None) -> None:
        self._finish(exc if isinstance(exc, OSError) else OSError(errno.EIO, os.strerror(errno.EIO)))

    def _finish(self, loss: OSError | None) -> None:
        if not self._is_closed:
            self._is_closed = True
            self._loss = loss
        self._changed.set()
        self._may_write.set()
