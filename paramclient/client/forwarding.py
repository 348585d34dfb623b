"""Forwarder: frames between the vehicle link and one other program, in both directions."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import anyio

from paramclient.client.frame_cutter import FrameCutter
from paramclient.errors import LinkError
from paramclient.links import Link, Peer

__all__ = ["Forwarder"]

QUEUED_FRAMES_MAX: Final = 1_000
"""Maximum number of frames queued for a slow program; further frames are dropped. A parameter list, which PX4
sends in bursts, fits."""
PROGRAM_BACKOFF_MIN: Final = 0.5
"""Seconds before the first attempt to reopen the link to the program; doubled after each attempt."""
PROGRAM_BACKOFF_MAX: Final = 5.0
"""Maximum seconds between two attempts to reopen the link to the program."""

logger = logging.getLogger(__name__)


class Forwarder:
    """Forwards received frames to another program, and frames of the program to the vehicle link.

    Frames are complete and unchanged. Frames that this client sends are not forwarded. A slow or absent
    program does not block the client: frames above the queue limit are dropped.

    Args:
        link: link to the program.
        is_stream: whether the vehicle link delivers a byte stream.

    Attributes:
        to_vehicle: called with each frame of the program; None if nothing may be sent to vehicles.
        lost: number of dropped frames.
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

    def received(self, data: bytes, peer: Peer) -> None:
        """Queue received data for the program."""
        self._pass_on(self._from_vehicle.cut(data, peer))

    def sent(self, data: bytes) -> None:
        """Ignore a sent frame: it is not forwarded."""

    def pause(self) -> None:
        """Discard an incomplete frame: the vehicle link is disconnected."""
        self._pass_on(self._from_vehicle.flush())

    async def read(self) -> None:
        """Receive frames of the program and reconnect to it, until its link fails permanently."""
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
                    logger.warning("forwarding has stopped: %s", error)
                    return
                logger.warning("%s; reconnecting", error)

    async def send(self) -> None:
        """Send the queued frames to the program, until cancelled."""
        while True:
            self._something_waits = anyio.Event()
            while self._waiting:
                frame = self._waiting.popleft()
                with suppress(LinkError):  # the reader reconnects
                    await self._link.send(frame, None)
            await self._something_waits.wait()

    async def _reach(self) -> None:
        """Reopen the link with backoff, without a time limit."""
        backoff = PROGRAM_BACKOFF_MIN
        while not self._is_there:
            await anyio.sleep(backoff)
            backoff = min(2 * backoff, PROGRAM_BACKOFF_MAX)
            with suppress(LinkError):
                await self._link.open()
                self._is_there = True
        logger.info("%s: reconnected", self._link.name)

    def _pass_on(self, frames: list[bytes]) -> None:
        free_frames = QUEUED_FRAMES_MAX - len(self._waiting) if self._is_there else 0
        self.lost += max(0, len(frames) - free_frames)
        if frames[:free_frames]:
            self._waiting.extend(frames[:free_frames])
            self._something_waits.set()
