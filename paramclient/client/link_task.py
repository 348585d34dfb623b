"""LinkTask: reader, sender and reconnection of a client's link."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Final, Protocol

import anyio
import anyio.lowlevel

from paramclient.client.loop_scheduler import (
    BACKLOG_DATAGRAMS_MIN,
    TURN_MAX,
    LoopScheduler,
)
from paramclient.client.reconnect_delays import Backoff
from paramclient.client.suspend_detection import SuspendDetector
from paramclient.errors import LinkError
from paramclient.links import Link, Peer
from paramclient.protocol.station import Station

__all__ = ["LinkTask", "Tap"]

READ_PAUSE: Final = 0.02
"""Seconds for which the reader pauses while no request is open, so that telemetry accumulates: 20 datagrams
in one read take a fifth of the CPU time of 20 reads. A parameter change in a pause is reported that much
later."""
PAUSE_DATAGRAMS_MAX: Final = 64
"""Maximum number of datagrams in one pause at the rate of the last read; a pause is shorter on a busier link.
It is an eighth of the default Linux socket buffer (see `paramclient.links.udp`), which leaves room for a
burst."""
LOOP_LATENCY_MIN: Final = 0.02
"""Event-loop latency in seconds, from which the sender counts a deadline as missed because the program was
busy or did not run. Data received meanwhile is read before any request times out."""
ARRIVAL_STEP: Final = 0.0002
"""Seconds between uncertain arrival times of two reads: more than the error of conversion to unix time."""
READ_GAP_MIN: Final = 0.05
"""Seconds without a read, although the program ran, above which the arrival time of received data is
uncertain: more than a pause and the turns of other links take."""
READER_TIME: Final = 0.002
"""Seconds that the sender leaves to the reader after a missed deadline: the reader is ready, so that one
iteration of the event loop is enough."""
READER_ITERATIONS: Final = 4
"""Iterations of the event loop that the sender leaves to the reader before each deadline. A program that was
blocked until shortly after a deadline misses it by less than `LOOP_LATENCY_MIN`, while received data is still
unread."""
TIMEOUT_DELAY_MAX: Final = 3.0
"""Maximum seconds for which timeouts wait for the reader, on a link with a growing backlog."""
FORWARDED_PER_TURN: Final = 16
"""Maximum number of frames of another program sent before frames of this client are sent again."""
FORWARDED_QUEUE_MAX: Final = 1_000
"""Maximum number of queued frames of another program: a mission of 1,000 items. On a slow link further frames
are dropped, as they would be with a link of its own."""
SEND_BLOCK_MAX: Final = 10.0
"""Seconds for which a slow link may block the sender; a longer time counts as a suspend of the computer."""

logger = logging.getLogger(__name__)


class Tap(Protocol):
    """Receiver of all data on a link. Its calls must neither block nor raise."""

    def received(self, data: bytes, peer: Peer) -> None:
        """Process received data; empty data marks the end of the peer's stream."""

    def sent(self, data: bytes) -> None:
        """Process a frame that is passed to the link."""

    def pause(self) -> None:
        """Discard an incomplete frame: the link is disconnected."""


class LinkTask:
    """Passes received data from a link to the protocol core, and frames of the core to the link.

    `read` and `send` run concurrently while the client is open. A dropped link that can reconnect is
    reopened; the deadlines of the core are suspended meanwhile, and also while the computer is suspended or
    the process is stopped. A second call of `read` or `send` waits until the first one ends, and replaces it
    if that was cancelled.

    Args:
        link: an open link.
        station: the protocol core.
        dispatch: processes the events of the core; called after each change of its state.
        end: called with the error of a link that has failed permanently; it calls `fail_for_good`.
        taps: receivers of all data on the link.
        may_rest: whether the reader may pause while telemetry arrives; disabled while frames are forwarded to
            another program.

    Attributes:
        is_disconnected: whether the link is disconnected and being reopened.
        broken: the error that calls raise now, or None.
        ended: the error that all calls raise permanently, or None.
        activity: set, and replaced, when data was received, the link drops or the calls fail.
    """

    def __init__(
        self,
        link: Link,
        station: Station,
        *,
        dispatch: Callable[[], None],
        end: Callable[[LinkError], None],
        taps: Sequence[Tap] = (),
        may_rest: bool = True,
    ) -> None:
        self.is_disconnected = False
        self.broken: LinkError | None = None
        self.ended: LinkError | None = None
        self.activity = anyio.Event()
        self._link = link
        self._station = station
        self._dispatch = dispatch
        self._end = end
        self._taps = taps
        self._may_rest = may_rest
        self._forwarded: deque[bytes] = deque()
        self._something_to_send = anyio.Event()
        self._sent = anyio.Event()  # set after each sent frame
        self._behind_since = math.inf  # start of the backlog of the reader
        self._read_at = -math.inf
        self._due = math.inf  # next deadline of the sender
        self._sender_late_at = -math.inf  # last time at which the sender ran late by more than `READ_GAP_MIN`
        self._arrived_at = -math.inf  # arrival time of the last chunk
        self._unseen = 0.0  # seconds of suspend since the last read that the loop's clock has left out
        self._is_processing = False  # whether the reader processes data, or waits for its turn to do so
        self._suspend = SuspendDetector()
        self._reading, self._sending = anyio.Lock(), anyio.Lock()

    async def read(self) -> None:
        """Receive data and reconnect, until the link fails permanently or cancellation."""
        loop = LoopScheduler.of_this_loop()
        async with self._reading:
            loop.register(self)
            try:
                await self._read(loop)
            finally:
                loop.unregister(self)

    async def _read(self, loop: LoopScheduler) -> None:
        self._is_processing, self._behind_since = False, math.inf
        before = drained_at = anyio.current_time()
        while True:
            read_at = anyio.current_time()
            try:
                chunks = await self._link.receive()
            except LinkError as error:
                if not self._link.reconnects:
                    self._end(error)
                    return
                await self._reconnect(error)
                drained_at = anyio.current_time()
                continue
            now = anyio.current_time()
            self._detect_suspend(now)
            moments = self._moments(len(chunks), drained_at, read_at, now)
            drained_at = now if len(chunks) < BACKLOG_DATAGRAMS_MIN else drained_at
            has_data = not chunks
            if not chunks:
                self._station.over(now)
            loop.record_read(self, len(chunks))
            self._behind_since = (
                math.inf if len(chunks) < BACKLOG_DATAGRAMS_MIN else min(self._behind_since, now)
            )
            self._read_at = math.inf
            rest = zip(chunks, moments, strict=True)
            if loop.needs_turns(len(chunks), self._station.scheduler):
                self._is_processing = True
                has_data |= await self._take_turns(rest, loop)
                self._is_processing = False
            has_data |= self._take(rest, math.inf)
            now = self._read_at = anyio.current_time()
            loop.record_processed(self, now)
            if has_data:
                self._dispatch()
                self.notify()
                self._something_to_send.set()
            elif self._may_rest and not self._station.is_waiting:
                await self._rest(min(READ_PAUSE, PAUSE_DATAGRAMS_MAX * (now - before) / max(1, len(chunks))))
            before = now

    def _moments(self, count: int, drained_at: float, read_at: float, now: float) -> Sequence[float]:
        """Return the arrival time of each chunk of a read, by the clock of the event loop.

        If the reader was late, the time is uncertain. Each chunk then gets the time at which the link was
        last drained, so that no value counts as newer than a value that another program has observed since.
        It is `ARRIVAL_STEP` later than that of the chunks before, if it would be earlier: otherwise an older
        value of the same parameter could count as the newer one.

        Args:
            count: number of chunks.
            drained_at: time at which the link was last drained.
            read_at, now: start and end of this read.
        """
        longest = now - drained_at + self._unseen
        self._unseen = 0.0
        was_sender_late = now - self._sender_late_at < READ_GAP_MIN or now - self._due > READ_GAP_MIN
        is_late = was_sender_late or read_at - drained_at > READ_GAP_MIN
        at = now - longest if is_late else now
        self._arrived_at = max(at, min(self._arrived_at + ARRIVAL_STEP, now))
        return [self._arrived_at] * count

    async def _take_turns(
        self, chunks: Iterator[tuple[tuple[Peer, bytes], float]], loop: LoopScheduler
    ) -> bool:
        """Process received data in turns with other tasks and links. Return whether there are new events."""
        has_data = is_done = False
        while not is_done:
            async with loop.turn:
                turn_ends = time.perf_counter() + TURN_MAX
                has_data |= self._take(chunks, turn_ends)
                is_done = time.perf_counter() < turn_ends
                self._dispatch()
                await anyio.lowlevel.checkpoint()  # other tasks run before the turn of another link
        return has_data

    def _take(self, chunks: Iterator[tuple[tuple[Peer, bytes], float]], until: float) -> bool:
        """Process received data until this time. Return whether there are new events.

        Args:
            chunks: peer, data and arrival time of each chunk.
            until: time by `time.perf_counter`.
        """
        has_data = False
        now = anyio.current_time()
        for (peer, data), moment in chunks:
            has_data |= self._station.receive(data, peer, now, moment)
            for tap in self._taps:
                tap.received(data, peer)
            if time.perf_counter() >= until:
                break
        return has_data

    async def send(self) -> None:
        """Send frames of the core and run its deadlines, until calls fail permanently or cancellation."""
        loop = LoopScheduler.of_this_loop()
        async with self._sending:
            try:
                await self._send(loop)
            finally:
                loop.unregister(self)

    async def _send(self, loop: LoopScheduler) -> None:
        station = self._station
        while self.ended is None:
            self._something_to_send = anyio.Event()
            began = now = anyio.current_time()
            self._detect_suspend(now)
            self._suspend.expect(math.inf)  # a slow link may block the sender
            self._due = math.inf
            is_behind = self._is_behind(now)
            if not is_behind or now >= self._behind_since + TIMEOUT_DELAY_MAX:
                loop.limit_lists(self, station.scheduler, now, is_behind=is_behind)
                station.tick(now)
            self._dispatch()
            to_send = station.data_to_send()
            if to_send:
                self._sent.set()
            sent_from = anyio.current_time()
            turn_ends = time.perf_counter() + TURN_MAX
            for data, peer in to_send:
                await self._transmit(data, peer)
                if time.perf_counter() >= turn_ends:  # a datagram is sent without yielding
                    await anyio.lowlevel.checkpoint()
                    turn_ends = time.perf_counter() + TURN_MAX
            for _ in range(min(len(self._forwarded), FORWARDED_PER_TURN)):
                await self._transmit(self._forwarded.popleft(), None)
            if self._forwarded:
                continue
            due = station.next_deadline()
            now = anyio.current_time()
            is_behind = self._is_behind(now)
            if is_behind:
                due = now + TURN_MAX
            blocked = min(now - sent_from, SEND_BLOCK_MAX)
            # it may have passed while others were ticked before it, or while the link blocked the sender
            self._suspend.expect(max(due, began) + blocked)
            self._due = due
            wait = due - now
            with anyio.move_on_after(None if wait == math.inf else max(wait, 0.0)):
                await self._something_to_send.wait()
            now = anyio.current_time()
            if now - due > READ_GAP_MIN:
                self._sender_late_at = now
            if self._behind_since < math.inf or now - due > LOOP_LATENCY_MIN:
                await anyio.sleep(READER_TIME)
            elif now >= due:
                for _ in range(READER_ITERATIONS):
                    await anyio.lowlevel.checkpoint()

    def send_for_another(self, frame: bytes) -> None:
        """Queue a frame of another program for every peer, unless the queue is full or the link is down."""
        if len(self._forwarded) < FORWARDED_QUEUE_MAX and not self.is_disconnected:
            self._forwarded.append(frame)
            self._station.overhear(frame, anyio.current_time())
            self._something_to_send.set()

    def wake(self) -> None:
        """Run the sender: something is to be sent, or a deadline has changed."""
        self._something_to_send.set()

    def notify(self) -> None:
        """Wake the tasks that wait for `activity`."""
        activity, self.activity = self.activity, anyio.Event()
        activity.set()

    def detect_suspend(self) -> None:
        """Detect suspend of the computer, or a stopped process."""
        self._detect_suspend(anyio.current_time())

    async def wait_for_reader(self, due: float) -> None:
        """Wait until received data has been read, if the reader has a backlog or this call is late.

        Args:
            due: time at which the caller was due to continue.
        """
        now = anyio.current_time()
        while now - due > LOOP_LATENCY_MIN or self._is_behind(now):
            await anyio.sleep(READER_TIME)
            now, due = anyio.current_time(), math.inf

    def fail_for_good(self, error: LinkError) -> None:
        """Fail all calls permanently with this error."""
        self.ended = error
        self.fail_calls(error)

    def _is_behind(self, now: float) -> bool:
        """Return whether received data is still unread, so that no request may time out."""
        return self._is_processing or self._behind_since <= now < self._read_at + LOOP_LATENCY_MIN

    async def _transmit(self, data: bytes, peer: Peer | None) -> None:
        for tap in self._taps:
            tap.sent(data)
        # the reader handles a dropped link; requests without a response are sent again
        with suppress(LinkError):
            await self._link.send(data, peer)

    def _detect_suspend(self, now: float) -> None:
        """Detect a suspension, and suspend the deadlines of the core for its duration."""
        unseen = self._suspend.unseen(now)
        if unseen is not None:
            logger.info("%s: the computer was suspended or the process stopped", self._link.name)
            self._unseen += unseen
            self._station.handle_suspend(unseen, now)
            self.wake()

    async def _rest(self, seconds: float) -> None:
        """Pause reading for this time, or until a frame is sent, which may cause a response."""
        self._sent = anyio.Event()
        with anyio.move_on_after(seconds):
            await self._sent.wait()

    async def _reconnect(self, error: LinkError) -> None:
        """Reopen the link, without a time limit. `Backoff` has the delays, and the timeout of calls."""
        logger.warning("%s; reconnecting", error)
        self.is_disconnected = True
        self.notify()
        self._forwarded.clear()
        self._station.pause()
        for tap in self._taps:
            tap.pause()
        backoff = Backoff()
        while True:
            await backoff.wait()
            try:
                await self._link.open()
            except LinkError as again:
                if backoff.is_timed_out:
                    self.fail_calls(again)
            else:
                logger.info("%s: reconnected", self._link.name)
                self.is_disconnected = False
                self.broken = None
                self._station.resume(anyio.current_time())
                self.wake()
                return

    def fail_calls(self, error: LinkError) -> None:
        """End waiting calls with this error, and new ones until the link reconnects.

        Open file sessions are still closed on board.
        """
        self.broken = error
        self._station.fail_all(error, anyio.current_time())
        self.notify()
