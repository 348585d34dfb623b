"""A serial cable for tests: a pseudo-terminal behind a symbolic link that can be plugged in and unplugged."""

from __future__ import annotations

import os
import select
import tty
from contextlib import suppress
from pathlib import Path

import anyio

from paramclient.sim import Endpoint

TIMEOUT = 120.0
"""Seconds after which a test fails; a passing test never waits that long."""


class Cable:
    """The remote end of a serial port. `device` is a path that stays the same, like those of
    /dev/serial/by-id.

    Attributes:
        device: the path of the port.
    """

    def __init__(self, folder: Path) -> None:
        self.device = folder / "ttyTEST0"
        self._file = -1

    def __enter__(self) -> Cable:
        self.plug_in()
        return self

    def __exit__(self, *error: object) -> None:
        if self._file >= 0:
            self.pull_out()

    @property
    def link(self) -> str:
        """The link name of the port."""
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
        """Write as much as the buffer accepts; return the number of bytes."""
        try:
            return os.write(self._file, data)
        except BlockingIOError:
            return 0

    def recv(self, size: int) -> bytes:
        """Wait for bytes, like a socket."""
        readable, _, _ = select.select([self._file], [], [], TIMEOUT)
        assert readable, "nothing has arrived"
        return os.read(self._file, size)

    def drain(self) -> None:
        """Read and discard all received bytes."""
        with suppress(OSError):  # no more bytes, or no program has the port open
            while os.read(self._file, 65536):
                pass

    async def carry(self, vehicle: Endpoint, *, rate: float, portion: int = 64) -> None:
        """Connect a vehicle to the port, with this many bytes per second each way, until unplugged.

        Bytes are transferred in portions independent of frames, as by a USB driver.
        """
        outgoing = bytearray()
        while self._file >= 0:
            now = anyio.current_time()
            with suppress(OSError):  # no bytes, or no program has the port open
                vehicle.receive(os.read(self._file, portion), now)
            vehicle.tick(now)
            outgoing += b"".join(vehicle.data_to_send())
            del outgoing[: self.offer(bytes(outgoing[:portion]))]
            await anyio.sleep(portion / rate)
