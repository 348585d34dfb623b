"""What moves the bytes of a client: the reader, the sender, and the return of a link that drops."""

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

from paramclient.client.event_loop_share import LONGEST_TURN, LOOK_AGAIN, MANY, SOME, Crowd
from paramclient.client.suspend_detection import Standstill
from paramclient.errors import LinkError
from paramclient.links import Link, Peer
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.station import Station

__all__ = ["Carrier", "Tap"]

REST: Final = 0.02
"""Seconds for which the reader lets telemetry pile up while nobody waits for an answer: to take 20 datagrams
at once costs a fifth of taking them one by one, and a change that comes meanwhile is told that much later."""
MOST_PER_REST: Final = 64
"""Datagrams that may come in one rest, at the rate of the last ones; on a busier link it is shorter. That is
an eighth of what Linux' usual buffer holds (see `paramclient.links.udp`): a burst still finds room there."""
HELD_UP: Final = 0.02
"""Seconds by which a deadline is missed where the program did something else meanwhile, or did not run. What
has come in that time is read before anything counts as not answered."""
LATE: Final = 0.05
"""Seconds for which nothing was read, though the program ran, above which what has come may have come at any
time since: more than a rest and the turns of other links take."""
READING_TIME: Final = 0.002
"""Seconds that the reader is given for that: it is ready to go on, so one turn of the event loop would do."""
READING_TURNS: Final = 4
"""Turns of the event loop that the reader is given before each deadline. A program that was held up until
shortly after a deadline misses it by less than `HELD_UP`, and what came meanwhile is still unread."""
MOST_BEHIND: Final = 3.0
"""Seconds for which time-outs wait for what has come to be read, on a link that brings more and more."""
LINK_PATIENCE: Final = 10.0
"""Seconds that calls wait for a link to come back before they fail with its error."""
FIRST_BACKOFF: Final = 0.25
LONGEST_BACKOFF: Final = 5.0
"""Seconds between two attempts to open a link again: doubled from the first to the longest."""
OTHERS_PER_TURN: Final = 16
MOST_OF_OTHERS: Final = 1_000
"""Frames of another program that are sent before our own have their turn again, and that may wait: a mission
of a thousand items. On a slow link the rest is lost, as it would be with a link of its own."""

logger = logging.getLogger(__name__)


class Tap(Protocol):
    """Somebody who is told of everything that goes over the link. None of the calls may block or raise."""

    def received(self, data: bytes, peer: Peer) -> None:
        """This has come; an empty chunk says that the peer's stream has ended."""

    def sent(self, data: bytes) -> None:
        """This frame was given to the link to be sent."""

    def pause(self) -> None:
        """The link is away: what was cut off by that is not continued."""


class Carrier:
    """Carries what a link delivers to a station, and what that wants sent to the link.

    `read` and `send` run side by side for as long as the client is open. A link that drops and can come back
    is opened again; meanwhile time stands still for the station. So it does while this computer sleeps, or
    nobody lets us work. A second call of either waits until the first one has ended, and goes on in its place
    if that was cancelled.

    Args:
        link: an open one.
        station: the core.
        dispatch: hands out what has happened, after each time that something may have.
        end: takes the error of a link that has failed for good, and calls `fail_for_good`.
        taps: who is told of everything that goes over the link.
        may_rest: whether telemetry may be left to the link for a while: not where somebody else waits for it.

    Attributes:
        is_away: whether the link is away and being opened again.
        broken: what calls raise now, or None.
        ended: the same, for good.
        news: is set, and replaced, when anything was received, the link drops or the calls fail.
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
        self.is_away = False
        self.broken: LinkError | None = None
        self.ended: LinkError | None = None
        self.news = anyio.Event()
        self._link = link
        self._station = station
        self._dispatch = dispatch
        self._end = end
        self._taps = taps
        self._may_rest = may_rest
        self._of_others: deque[bytes] = deque()
        self._something_to_send = anyio.Event()
        self._sent = anyio.Event()  # set when anything is sent
        self._behind_since = math.inf  # since when more comes than is read at once
        self._read_at = -math.inf
        self._due = math.inf  # when the sender is to go on
        self._held_up_at = -math.inf  # when it went on that much later
        self._unseen = 0.0  # seconds of sleep since the last read that the loop's clock has left out
        self._is_taking = False  # what was read, or waits for its turn to do so
        self._asked = True  # whether anything may have been asked of anybody
        self._standstill = Standstill()
        self._reading, self._sending = anyio.Lock(), anyio.Lock()

    async def read(self) -> None:
        """Take what comes, until the link fails for good."""
        crowd = Crowd.of_this_loop()
        async with self._reading:
            crowd.joined(self)
            try:
                await self._read(crowd)
            finally:
                crowd.left(self)

    async def _read(self, crowd: Crowd) -> None:
        self._is_taking, self._behind_since = False, math.inf
        before = drained_at = anyio.current_time()
        while True:
            asked_at = anyio.current_time()
            try:
                chunks = await self._link.receive()
            except LinkError as error:
                if not self._link.reconnects:
                    self._end(error)
                    return
                await self._reopen(error)
                drained_at = anyio.current_time()
                continue
            now = anyio.current_time()
            self._look_at_the_clock(now)
            moments = self._moments(len(chunks), drained_at, asked_at, now)
            drained_at = now if len(chunks) < MANY else drained_at
            is_news = not chunks
            if not chunks:
                self._station.over(now)
                self._asked = True
            crowd.came(self, len(chunks))
            self._behind_since = math.inf if len(chunks) < MANY else min(self._behind_since, now)
            self._read_at = math.inf
            rest = zip(chunks, moments, strict=True)
            if len(chunks) >= SOME or (crowd.has_others and self._station.is_waiting):
                self._is_taking = True
                is_news |= await self._take_turns(rest, crowd)
                self._is_taking = False
            is_news |= self._take(rest, math.inf)
            now = self._read_at = anyio.current_time()
            crowd.taken(self, now)
            if is_news:
                self._dispatch()
                self.tell()
                self._something_to_send.set()
            elif self._may_rest and not self._station.is_waiting:
                await self._rest(min(REST, MOST_PER_REST * (now - before) / max(1, len(chunks))))
            before = now

    def _moments(self, count: int, drained_at: float, asked_at: float, now: float) -> Sequence[float]:
        """Return when each chunk of a read came from the link.

        Where the link does not tell and the reader was late, that is open, and each counts as of the time
        when everything had been read last: so none counts as newer than what another program has observed
        meanwhile.

        Args:
            count: how many there are.
            drained_at: when everything that had come was read last.
            asked_at, now: when this read began and ended.
        """
        longest = now - drained_at + self._unseen
        self._unseen = 0.0
        arrived_at: Sequence[float] = getattr(self._link, "arrived_at", ())
        if len(arrived_at) == count:
            return [min(max(at, now - longest), now) for at in arrived_at]
        was_held_up = now - self._held_up_at < LATE or now - self._due > LATE
        is_late = was_held_up or asked_at - drained_at > LATE
        return [now - longest if is_late else now] * count

    async def _take_turns(self, chunks: Iterator[tuple[tuple[Peer, bytes], float]], crowd: Crowd) -> bool:
        """Take what has come, and give way to other tasks and to other links; whether it is news."""
        is_news = is_done = False
        while not is_done:
            async with crowd.turn:
                turn_ends = time.perf_counter() + LONGEST_TURN
                is_news |= self._take(chunks, turn_ends)
                is_done = time.perf_counter() < turn_ends
                self._dispatch()
                await anyio.lowlevel.checkpoint()  # before another link has its turn
        return is_news

    def _take(self, chunks: Iterator[tuple[tuple[Peer, bytes], float]], until: float) -> bool:
        """Take what has come, until this time has passed; whether any of it is news."""
        is_news = False
        now = anyio.current_time()
        for (peer, data), moment in chunks:
            is_news |= self._station.receive(data, peer, now, moment)
            for tap in self._taps:
                tap.received(data, peer)
            if time.perf_counter() >= until:
                break
        return is_news

    async def send(self) -> None:
        """Send what is to be sent, and do what is due, until the calls have failed for good."""
        crowd = Crowd.of_this_loop()
        async with self._sending:
            try:
                await self._send(crowd)
            finally:
                crowd.left(self)

    async def _send(self, crowd: Crowd) -> None:
        station = self._station
        while self.ended is None:
            self._something_to_send = anyio.Event()
            now = anyio.current_time()
            self._look_at_the_clock(now)
            self._standstill.expect(math.inf)  # a slow link may hold us up
            self._due = math.inf
            everyone = self._asked
            is_behind = self._is_behind(now)
            bursts, awaited = station.bursts(now)
            most_lists = 1 if is_behind else crowd.most_lists(self, bursts, now, awaited=awaited)
            if not is_behind or now >= self._behind_since + MOST_BEHIND:
                self._asked = False
                is_crowded = crowd.is_busy_without(self)
                station.tick(now, everyone=everyone, most_lists=most_lists, is_crowded=is_crowded)
            self._dispatch()
            to_send = station.data_to_send()
            if to_send:
                self._sent.set()
            for data, peer in to_send:
                await self._transmit(data, peer)
            for _ in range(min(len(self._of_others), OTHERS_PER_TURN)):
                await self._transmit(self._of_others.popleft(), None)
            if self._of_others:
                self._asked |= everyone  # whose deadlines have not been noted
                continue
            due = station.next_deadline(everyone=everyone)
            now = anyio.current_time()
            is_behind = self._is_behind(now)
            if is_behind:
                due = now + LONGEST_TURN
            elif most_lists < math.inf:  # a list that waits for its turn may not begin, and wants to
                due = max(due, now + LOOK_AGAIN)
            self._standstill.expect(due)
            self._due = due
            wait = due - now
            with anyio.move_on_after(None if wait == math.inf else max(wait, 0.0)):
                await self._something_to_send.wait()
            now = anyio.current_time()
            if now - due > LATE:
                self._held_up_at = now
            if self._behind_since < math.inf or now - due > HELD_UP:
                await anyio.sleep(READING_TIME)
            elif now >= due:
                for _ in range(READING_TURNS):
                    await anyio.lowlevel.checkpoint()

    def send_for_another(self, frame: bytes) -> None:
        """Send a frame of another program to every peer, in its turn; it is lost where too many wait."""
        if len(self._of_others) < MOST_OF_OTHERS and not self.is_away:
            self._of_others.append(frame)
            self._station.overhear(frame, anyio.current_time())
            self._something_to_send.set()

    def wake(self, machine: ComponentMachine | None = None) -> None:
        """There may be something to send, or another deadline: of this component, or of any."""
        if machine is None:
            self._asked = True
        else:
            self._station.touch(machine)
        self._something_to_send.set()

    def tell(self) -> None:
        """There is news for those who wait for `news`."""
        news, self.news = self.news, anyio.Event()
        news.set()

    def look_at_the_clock(self) -> None:
        """Notice that this computer has slept, or that nothing was done here."""
        self._look_at_the_clock(anyio.current_time())

    async def read_up(self, due: float) -> None:
        """Wait until what had come by now was read, where the reader is behind or this call is late.

        Args:
            due: when the caller was to go on.
        """
        now = anyio.current_time()
        while now - due > HELD_UP or self._is_behind(now):
            await anyio.sleep(READING_TIME)
            now, due = anyio.current_time(), math.inf

    def fail_for_good(self, error: LinkError) -> None:
        """No call can be answered any more."""
        self.ended = error
        self.fail_calls(error)

    def _is_behind(self, now: float) -> bool:
        """Whether more has come than was read, so that nothing can be said not to have been answered."""
        return self._is_taking or self._behind_since <= now < self._read_at + HELD_UP

    async def _transmit(self, data: bytes, peer: Peer | None) -> None:
        for tap in self._taps:
            tap.sent(data)
        # a link that drops is the reader's business; what is not sent now is sent again in time
        with suppress(LinkError):
            await self._link.send(data, peer)

    def _look_at_the_clock(self, now: float) -> None:
        """Before anything is taken or sent: see whether we were away."""
        unseen = self._standstill.unseen(now)
        if unseen is not None:
            logger.info("%s: time has stood still here", self._link.name)
            self._unseen += unseen
            self._station.stood_still(unseen, now)
            self.wake()

    async def _rest(self, seconds: float) -> None:
        """Leave what comes to the link for a while, unless something is sent that may be answered."""
        self._sent = anyio.Event()
        with anyio.move_on_after(seconds):
            await self._sent.wait()

    async def _reopen(self, error: LinkError) -> None:
        """Open the link again, for as long as it takes."""
        logger.warning("%s; trying to open it again", error)
        self.is_away = True
        self.tell()
        self._of_others.clear()
        self._station.pause()
        for tap in self._taps:
            tap.pause()
        patience_ends = anyio.current_time() + LINK_PATIENCE
        backoff = FIRST_BACKOFF
        while True:
            patience = patience_ends - anyio.current_time()
            await anyio.sleep(min(backoff, patience) if patience > 0 else backoff)
            backoff = min(backoff * 2, LONGEST_BACKOFF)
            try:
                await self._link.open()
            except LinkError as again:
                if anyio.current_time() >= patience_ends:
                    self.fail_calls(again)
            else:
                logger.info("%s: open again", self._link.name)
                self.is_away = False
                self.broken = None
                self._station.resume(anyio.current_time())
                self.wake()
                return

    def fail_calls(self, error: LinkError) -> None:
        """Whoever waits gets this error, and so does every new call until the link is back.

        The sessions of open files are closed on board nevertheless.
        """
        self.broken = error
        self._station.fail_all(error, anyio.current_time())
        self.tell()
