"""One other program beside this one on the same link: every frame is passed on, both ways."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import anyio

from paramclient.errors import LinkError
from paramclient.links import Link, Peer
from paramclient.protocol.stats.sniffer import FrameCutter

__all__ = ["Forwarder"]

MOST_WAITING: Final = 1_000
"""Frames that wait for a program that reads slowly; further ones are lost to it. A list of parameters, which
PX4 sends in bursts, finds room."""
FIRST_BACKOFF: Final = 0.5
LONGEST_BACKOFF: Final = 5.0
"""Seconds between two attempts to reach the program again: doubled from the first to the longest."""

logger = logging.getLogger(__name__)


class Forwarder:
    """Passes what a vehicle link delivers to another program, and what that sends to the vehicle link.

    Frames go whole and as they were; what this client itself sends is not passed on. A program that is slow,
    or not there, is no reason to wait: what it has no room for is lost to it.

    Args:
        link: to the program.
        is_stream: whether the vehicle link delivers a stream.

    Attributes:
        to_vehicle: takes each frame of the program; None for nobody, where nothing may be sent.
        lost: frames that the program had no room for.
    """

    def __init__(self, link: Link, *, is_stream: bool) -> None:
        self.lost = 0
        self._link = link
        self.to_vehicle: Callable[[bytes], None] | None = None
        self._from_vehicle = FrameCutter(stream=is_stream)
        self._from_program = FrameCutter(stream=link.is_stream)
        self._waiting: deque[bytes] = deque()
        self._something_waits = anyio.Event()
        self._is_there = False

    async def open(self) -> None:
        """Open the link to the program; one that may come later is waited for.

        Raises:
            LinkError: it cannot be opened, and not later either.
        """
        try:
            await self._link.open()
            self._is_there = True
        except LinkError as error:
            if not (self._link.reconnects and self._link.is_stream):
                raise  # a datagram reaches whoever comes later: there is nobody to wait for
            logger.warning("%s; trying again until somebody is there", error)

    async def close(self) -> None:
        """Close the link to the program."""
        await self._link.close()

    def received(self, data: bytes, peer: Peer) -> None:
        """Take what the vehicle link has delivered."""
        self._pass_on(self._from_vehicle.cut(data, peer))

    def sent(self, data: bytes) -> None:
        """What went out is not for the program."""

    def pause(self) -> None:
        """The vehicle link is away."""
        self._pass_on(self._from_vehicle.flush())

    async def read(self) -> None:
        """Take what the program sends, and reach it again when it was lost, until its link fails for good."""
        while True:
            try:
                if not self._is_there:
                    await self._reach()
                for peer, data in await self._link.receive():
                    for frame in self._from_program.cut(data, peer):
                        if self.to_vehicle is not None:
                            self.to_vehicle(frame)
            except LinkError as error:
                self._is_there = False
                self._from_program.flush()
                if not self._link.reconnects:
                    logger.warning("nothing is forwarded any more: %s", error)
                    return
                logger.warning("%s; trying again", error)

    async def send(self) -> None:
        """Give the program what waits for it, until cancelled."""
        while True:
            self._something_waits = anyio.Event()
            while self._waiting:
                frame = self._waiting.popleft()
                with suppress(LinkError):  # the reader's business
                    await self._link.send(frame, None)
            await self._something_waits.wait()

    async def _reach(self) -> None:
        """Open the link again, for as long as it takes."""
        backoff = FIRST_BACKOFF
        while not self._is_there:
            await anyio.sleep(backoff)
            backoff = min(2 * backoff, LONGEST_BACKOFF)
            with suppress(LinkError):
                await self._link.open()
                self._is_there = True
        logger.info("%s: open again", self._link.name)

    def _pass_on(self, frames: list[bytes]) -> None:
        room = MOST_WAITING - len(self._waiting) if self._is_there else 0
        self.lost += max(0, len(frames) - room)
        if frames[:room]:
            self._waiting.extend(frames[:room])
            self._something_waits.set()
