"""Forwarder: frames between the vehicle link and one other program, in both directions."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from typing import Final

import anyio

from paramclient.client.taps import FrameCutter, SeenFrame, Tap
from paramclient.errors import LinkError
from paramclient.links import Link
from paramclient.wire.frames import bears_key

__all__ = ["Forwarder"]

QUEUED_FRAMES_MAX: Final = 1_000
"""Maximum number of frames queued for a slow program; further frames are dropped. A parameter list, which PX4
sends in bursts, fits."""
PROGRAM_RETRY_INTERVAL: Final = 1.0
"""Seconds between two attempts to reopen the link to the program, which is usually on this machine."""

logger = logging.getLogger(__name__)


class Forwarder(Tap):
    """Forwards received frames to another program, and frames of the program to the vehicle link.

    Frames are complete and unchanged. Frames that this client sends are not forwarded. A slow or absent
    program does not block the client: frames above the queue limit are dropped.

    Args:
        link: link to the program.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._cutter = FrameCutter(stream=link.is_stream)
        self._waiting: deque[bytes] = deque()
        self._something_waits = anyio.Event()
        self._is_there = False

    async def open(self) -> None:
        """Open the link to the program. A stream link that can reconnect may also open later, in `read`.

        Raises:
            LinkError: the link cannot be opened, and cannot be opened later.
        """
        try:
            await self._link.open()
            self._is_there = True
        except LinkError as error:
            if not (self._link.reconnects and self._link.is_stream):
                raise  # a datagram link needs no listener to open: retries would not help
            logger.warning("%s; retrying until the program listens", error)

    async def close(self) -> None:
        """Close the link to the program."""
        await self._link.close()

    def received(self, frames: Sequence[SeenFrame], size: int, peer: Hashable) -> None:
        """Queue received frames for the program."""
        for each in frames:
            if self._is_there and len(self._waiting) < QUEUED_FRAMES_MAX and not bears_key(each.data):
                self._waiting.append(each.data)
                self._something_waits.set()

    async def run(self, to_vehicles: Callable[[bytes], None]) -> None:
        """Pass frames in both directions, until cancelled."""
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._send)
            await self._read(to_vehicles)

    async def _read(self, to_vehicles: Callable[[bytes], None]) -> None:
        """Receive frames of the program and reconnect to it, until its link fails permanently."""
        while True:
            try:
                if not self._is_there:
                    await self._reach()
                for peer, data in await self._link.receive():
                    for each in self._cutter.cut(data, peer):
                        if not bears_key(each.data):
                            to_vehicles(each.data)
            except LinkError as error:
                self._is_there = False
                self._cutter = FrameCutter(stream=self._link.is_stream)
                if not self._link.reconnects:
                    logger.warning("forwarding has stopped: %s", error)
                    return
                logger.warning("%s; reconnecting", error)

    async def _send(self) -> None:
        """Send the queued frames to the program, until cancelled."""
        while True:
            self._something_waits = anyio.Event()
            while self._waiting:
                with suppress(LinkError):  # the reader reconnects
                    await self._link.send(self._waiting.popleft(), None)
            await self._something_waits.wait()

    async def _reach(self) -> None:
        """Reopen the link, without a time limit."""
        while not self._is_there:
            await anyio.sleep(PROGRAM_RETRY_INTERVAL)
            with suppress(LinkError):
                await self._link.open()
                self._is_there = True
        logger.info("%s: reconnected", self._link.name)
