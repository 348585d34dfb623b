"""LinkTask: reader, sender and reconnection of a client's link."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final

import anyio
import anyio.lowlevel

from paramclient.client.taps import FrameCutter, Tap
from paramclient.errors import ClientClosed, LinkError
from paramclient.links import Link
from paramclient.protocol.addresses import Peer
from paramclient.protocol.station import Station

READ_PAUSE: Final = 0.02
"""Seconds for which the reader pauses while no conversation waits, so that telemetry accumulates: one read of
20 datagrams takes a fifth of the CPU time of 20 reads. A change in a pause is reported that much later."""
PAUSE_DATAGRAMS_MAX: Final = 64
"""Datagrams in one pause at the rate of the last read, at most: an eighth of Linux' default socket buffer."""
CHUNKS_PER_TURN: Final = 64
"""Chunks that are processed before other tasks run: less than 1 ms."""
FRAMES_PER_TURN: Final = 64
"""Frames that are sent before other tasks run: a datagram is sent without yielding."""
FORWARDED_QUEUE_MAX: Final = 1_000
"""Queued frames of another program, at most: a mission of 1,000 items. Further frames are dropped, as they
would be on a link of its own."""
LINK_TIMEOUT: Final = 10.0
"""Seconds for which calls wait for a reconnection before they fail with the error of the link."""
RECONNECT_BACKOFF_MIN: Final = 0.25
"""Seconds before the first attempt to reopen a link; doubled after each attempt."""
RECONNECT_BACKOFF_MAX: Final = 5.0
"""Seconds between two attempts to reopen a link, at most."""

logger = logging.getLogger(__name__)


class LinkTask:
    """Passes received data from a link to the station, and its frames to the link.

    `read` and `send` run concurrently while the client is open. A dropped link that can reconnect is
    reopened; requests wait meanwhile, and fail after `LINK_TIMEOUT`.

    Args:
        link: an open link.
        ended: called when a log has ended, or the link has failed for good.

    Attributes:
        taps: receivers of all frames on the link.
        station: takes the received data; set before `read`.
        is_disconnected: whether the link is disconnected and being reopened.
        bytes_received, bytes_sent: on this link.
        accepts: whether to take received data of a peer; called with each chunk.
        cutter: cuts the received data for the taps.
        closed: the error of calls that wait when the client is closed.
    """

    station: Station

    def __init__(self, link: Link, taps: Iterable[Tap], *, ended: Callable[[], None]) -> None:
        self.is_disconnected = False
        self._activity = anyio.Event()
        self.bytes_received = self.bytes_sent = 0
        self.cutter = FrameCutter(stream=link.is_stream)
        self.accepts: Callable[[bytes, Peer], bool] = lambda data, peer: True
        self.closed = ClientClosed("the client was closed", link=link.name)
        self._link = link
        self.taps = list(taps)
        self._ended = ended
        self._queue: deque[tuple[bytes, Peer | None]] = deque()
        self._forwarded: deque[bytes] = deque()
        self._something_to_send = anyio.Event()

    def queue(self, data: bytes, peer: Peer | None) -> None:
        """Queue a frame for a peer; None for all."""
        self._queue.append((data, peer))
        self._something_to_send.set()

    def forward(self, frame: bytes) -> None:
        """Queue a frame of another program for all peers, if this client sends and the queue is not full."""
        may_send = not (self.is_disconnected or self.station.listens_only)
        if may_send and len(self._forwarded) < FORWARDED_QUEUE_MAX:
            self._forwarded.append(frame)
            self.station.overhear(frame, anyio.current_time())
            self._something_to_send.set()

    def notify(self) -> None:
        """Wake the tasks that wait for activity."""
        self._activity.set()
        self._activity = anyio.Event()

    async def wait_for_activity(self) -> None:
        """Wait until data was received, or the link has dropped.

        Raises:
            LinkError: it has failed.
        """
        await self._activity.wait()
        self.station.gate.check()

    async def read(self) -> None:
        """Receive data and reconnect, until the link fails for good or its log has ended."""
        while True:
            before = anyio.current_time()
            try:
                chunks = await self._link.receive()
            except LinkError as error:
                if self._link.reconnects:
                    await self._reconnect(error)
                    continue
                self.station.fail(error, for_good=True)
                chunks = []
            if not chunks:
                self._ended()
                self.notify()
                return
            for place, (peer, data) in enumerate(chunks, start=1):
                self.bytes_received += len(data)
                if self.accepts(data, peer):
                    self.station.receive(data, peer, anyio.current_time())
                    self._show(data, peer)
                if not place % CHUNKS_PER_TURN:
                    await anyio.lowlevel.checkpoint()
            self.notify()
            if not self.station.is_waiting:
                spent = anyio.current_time() - before
                with anyio.move_on_after(min(READ_PAUSE, PAUSE_DATAGRAMS_MAX * spent / len(chunks))):
                    await self._something_to_send.wait()  # a sent frame may cause a response

    async def send(self) -> None:
        """Send queued frames, those of another program after those of this one, until cancelled."""
        try:
            while True:
                self._something_to_send = anyio.Event()
                await self.flush()
                await self._something_to_send.wait()
        finally:  # the event loop may cancel all tasks at once: no conversation waits for an answer then
            self.station.fail(self.closed, for_good=True)

    async def flush(self) -> None:
        """Send all queued frames."""
        sent = 0
        while self._queue or self._forwarded:
            data, peer = self._queue.popleft() if self._queue else (self._forwarded.popleft(), None)
            self.bytes_sent += len(data)
            for tap in self.taps:
                tap.sent(data)
            with suppress(LinkError):  # the reader reconnects; unanswered requests are repeated
                await self._link.send(data, peer)
            sent += 1
            if not sent % FRAMES_PER_TURN:
                await anyio.lowlevel.checkpoint()

    def end_streams(self) -> None:
        """End the unfinished frames: the link is down, or closed."""
        for peer in self.cutter.unfinished:
            self._show(b"", peer)

    def _show(self, data: bytes, peer: Peer) -> None:
        """Pass received data to the taps."""
        if self.taps:
            frames = self.cutter.cut(data, peer)
            for tap in self.taps:
                tap.received(frames, len(data), peer)

    async def _reconnect(self, error: LinkError) -> None:
        """Reopen the link, without a time limit."""
        logger.warning("%s; reconnecting", error)
        self.is_disconnected = True
        self.station.interrupt()
        self._queue.clear()
        self._forwarded.clear()
        self.end_streams()
        self.notify()
        deadline = anyio.current_time() + LINK_TIMEOUT
        delay = RECONNECT_BACKOFF_MIN
        while True:
            await anyio.sleep(delay)
            delay = min(2 * delay, RECONNECT_BACKOFF_MAX)
            try:
                await self._link.open()
            except LinkError as again:
                if anyio.current_time() >= deadline:
                    self.station.fail(again)
                    self.notify()
                else:
                    delay = min(delay, max(deadline - anyio.current_time(), 0.0))
            else:
                break
        logger.info("%s: reconnected", self._link.name)
        self.is_disconnected = False
        self.station.resume(anyio.current_time())
        self.notify()
