"""A serial cable for tests: a pseudo-terminal behind a symbolic link, to be plugged in and pulled out."""

from __future__ import annotations

import os
import select
import tty
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import anyio

from paramclient.sim import Endpoint

__all__ = ["Cable"]

PATIENCE = 120.0
"""Seconds after which a test gives up; nothing waits that long when all is well."""


class Cable:
    """The far end of a serial port. `device` is a path that stays the same, as those of /dev/serial/by-id do.

    Attributes:
        device: the path of the port.
    """

    def __init__(self, folder: Path) -> None:
        self.device = folder / "ttyTEST0"
        self._file = -1

    def __enter__(self) -> Cable:
        self.plug_in()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file >= 0:
            self.pull_out()

    @property
    def link(self) -> str:
        """The name of the link over it."""
        return f"serial:{self.device}:115200"

    def plug_in(self) -> None:
        self._file, port = os.openpty()
        tty.setraw(port)
        os.set_blocking(self._file, False)
        self.device.symlink_to(os.ttyname(port))
        os.close(port)

    def pull_out(self) -> None:
        self.device.unlink()
        file, self._file = self._file, -1
        os.close(file)

    def send(self, data: bytes) -> None:
        assert self.offer(data) == len(data)

    def offer(self, data: bytes) -> int:
        """Send as much as there is room for; how much that was."""
        try:
            return os.write(self._file, data)
        except BlockingIOError:
            return 0

    def recv(self, size: int) -> bytes:
        """Wait for bytes, as a socket does."""
        readable, _, _ = select.select([self._file], [], [], PATIENCE)
        assert readable, "nothing has come"
        return os.read(self._file, size)

    def drain(self) -> None:
        """Take, and forget, what has come."""
        with suppress(OSError):  # nothing more, or nobody has the port open
            while os.read(self._file, 65536):
                pass

    async def carry(self, vehicle: Endpoint, *, rate: float, portion: int = 64) -> None:
        """Let a vehicle speak at the port, at so many bytes a second each way, until the cable is pulled out.

        Bytes come in portions that have nothing to do with frames, as from a USB driver.
        """
        outgoing = bytearray()
        while self._file >= 0:
            now = anyio.current_time()
            with suppress(OSError):  # nothing has come, or nobody has the port open
                vehicle.receive(os.read(self._file, portion), now)
            vehicle.tick(now)
            outgoing += b"".join(vehicle.data_to_send())
            del outgoing[: self.offer(bytes(outgoing[:portion]))]
            await anyio.sleep(portion / rate)
