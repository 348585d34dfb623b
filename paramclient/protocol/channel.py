"""One component's side of the link: requests out, messages to the conversations that wait for them.

A channel holds no state of any conversation. `exchange` is the one rule of requests: send; wait; repeat; give
up. `Timing` has the timeout of each attempt and the number of attempts, `WINDOW` the reads in flight.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from typing import Final, TypeAlias, TypeVar

import anyio
import anyio.abc

from paramclient.errors import LinkError, NoReply
from paramclient.protocol.presence import Presence
from paramclient.wire import messages
from paramclient.wire.messages import Message

T = TypeVar("T")

Key: TypeAlias = object
"""What a conversation waits for: a message class, or one with a name, an index or a command."""

PATIENCE_MIN: Final = 2.0
"""Seconds until a request is given up, at least: a vehicle that writes to its flash may be silent for one."""
UNANSWERED_MAX: Final = 5.0
"""Seconds after which a request to a component that has never answered one is given up, though it sends other
messages: twice the longest round trip in use."""
SILENCE_MAX: Final = 20.0
"""Seconds without a message of a component without heartbeats after which requests are given up."""
LATE_WAKE_UP: Final = 0.05
"""Seconds after a deadline from which on the program counts as stalled: the answer may wait in a buffer."""
LATE_GRACE: Final = 0.02
"""Seconds for which a stalled program looks once more for the answer."""
WINDOW: Final = 12
"""Requests in flight: ArduPilot's queue of reads has 20 places, and its overflow is dropped silently."""
WINDOW_PX4: Final = 60
"""Requests in flight to a PX4, which answers each at once."""
FTP_SEQUENCES_PER_SECOND: Final = 1000
"""Sequence numbers of MAVFTP that a second skips, more than a program uses in it."""

FIRST_TIMEOUT: Final = 0.25
"""Timeout in seconds of a first attempt before the round trip is measured: above that of radios in use."""
FIRST_TIMEOUT_MAX: Final = 1.0
"""The longest of them: a longer one would send no less before the answer over a satellite, but would find a
component late that hears nothing at first."""
TIMEOUT_MIN: Final = 0.1
"""Shortest timeout in seconds: ArduPilot answers reads in batches every 100 ms."""
TIMEOUT_MAX: Final = 4.0
"""Longest timeout in seconds: a round trip of 2.5 s with its variation."""
VARIATION_MIN: Final = 0.02
"""Seconds above the smoothed round trip, at least: the granularity of vehicles' main loops."""
BOUND_VARIATION: Final = 0.025
"""Assumed variation of a round trip of which only an upper bound is known, at most: without any, jitter would
have each request repeated, and none measured."""
BACKOFF: Final = 1.5
"""Factor from one timeout to the next: at a round trip of 2.5 s, five requests are sent before the first
answer, one more than with a factor of 2, and at 20 % loss a list begins in half the time."""
BACKOFF_MEASURED: Final = 1.2
"""The same with a measured round trip: a lost packet alone is no congestion."""
BACKOFF_FROM: Final = 3
"""Attempts without backoff: three losses in a row are common at 20 % loss, and are no congestion."""
SILENCE_BY_LOSS: Final = 1e-6
"""Probability that only loss explains an unanswered request, at which it is given up."""
ATTEMPTS_MIN: Final = 5
ATTEMPTS_MAX: Final = 60
FIRST_LOST: Final = 1.2
FIRST_SENT: Final = 4.0
"""Attempts that are assumed before the first ones, lost and sent: 16 % loss in each direction."""
SENT_MAX: Final = 400.0
"""Attempts that count at full weight; then all earlier ones count half."""
LOSS_MIN: Final = 0.01
"""Assumed share of lost exchanges, at least: a good link can turn bad."""
LOSS_MAX: Final = 0.8
"""Share of lost exchanges above which the estimate does not rise: 55 % loss in each direction."""
MISSED_BY_COPIES: Final = 0.02
"""Probability that all copies of a request are lost, when copies are sent."""
COPIES_MAX: Final = 4


class Gate:
    """Whether the link carries messages: open; interrupted, so that requests wait; or failed.

    Attributes:
        error: with which requests fail, or None.
        is_closed: whether the link has failed for good.
    """

    def __init__(self) -> None:
        self.error: LinkError | None = None
        self.is_closed = False
        self._open = anyio.Event()
        self._open.set()
        self._waits: dict[anyio.CancelScope, bool] = {}  # and whether they also end at a failure for a time

    @property
    def is_open(self) -> bool:
        """Whether requests are sent."""
        return self._open.is_set() and self.error is None

    def open(self) -> None:
        """Let requests go on, unless the link is closed."""
        if not self.is_closed:
            self.error = None
            self._open.set()

    def interrupt(self) -> None:
        """Hold requests until the link is open again."""
        if self._open.is_set():
            self._open = anyio.Event()

    def fail(self, error: LinkError, *, for_good: bool = False) -> None:
        """End all waits and all later requests with an error, until the link is open again, or for good."""
        if for_good or not self.is_closed:
            self.error = error
            self.is_closed = for_good
            self._open.set()
            for scope, is_brief in self._waits.items():
                if for_good or is_brief:
                    scope.cancel()

    def check(self) -> None:
        """Raise the error of the link, if it has failed."""
        if self.error is not None:
            raise self.error.with_traceback(None)

    async def wait(self) -> None:
        """Wait until the link is open.

        Raises:
            LinkError: it has failed.
        """
        await self._open.wait()
        self.check()

    @contextmanager
    def until_closed(self, *, or_failed: bool = False) -> Iterator[None]:
        """Run a block that waits for something else than a message, such as a pause.

        Args:
            or_failed: whether the block ends also where the link may come back.

        Raises:
            LinkError: the link has failed for good; the block was cancelled.
        """
        if self.is_closed:
            self.check()
        with anyio.CancelScope() as scope:
            self._waits[scope] = or_failed
            try:
                yield
            finally:
                del self._waits[scope]
        if scope.cancelled_caught:
            self.check()


class Inbox:
    """The messages with some keys, from the moment of its creation until the end of its `with` block."""

    def __init__(self) -> None:
        self._messages: deque[Message] = deque()
        self._arrived = anyio.Event()

    def put(self, message: Message) -> None:
        """Add a message, and wake the conversation."""
        self._messages.append(message)
        self._arrived.set()

    def __bool__(self) -> bool:
        return bool(self._messages)

    async def next(self) -> Message:
        """Wait for the next message."""
        while not self._messages:
            self._arrived = anyio.Event()
            await self._arrived.wait()
        return self._messages.popleft()


class Timing:
    """Round trip and loss, as measured by exchanges with one component.

    The timeout follows RFC 6298. Only exchanges without a repetition are measured (Karn's rule); before the
    first of these, a repeated one gives an upper bound.

    Attributes:
        round_trip: smoothed, in seconds; None before the first measurement.
        slowest: the longest time in seconds from a first request to its answer: so long may an answer wait in
            the queue of a slow link.
        loss: share of attempts without an answer, counted when the exchange was answered at last: an
            unsupported request is no loss.
    """

    def __init__(self) -> None:
        self.round_trip: float | None = None
        self.slowest = 0.0
        self._variation = 0.0
        self._is_bound = False  # the round trip is only an upper bound
        self._lost = FIRST_LOST
        self._sent = FIRST_SENT

    @property
    def loss(self) -> float:
        return min(max(self._lost / self._sent, LOSS_MIN), LOSS_MAX)

    def measure(self, sample: float) -> None:
        """Take the round trip of an exchange that needed one attempt."""
        if self.round_trip is None or self._is_bound:
            self.round_trip, self._variation = sample, sample / 4
            self._is_bound = False
        else:
            self._variation += (abs(self.round_trip - sample) - self._variation) / 4
            self.round_trip += (sample - self.round_trip) / 8

    def bound(self, elapsed: float) -> None:
        """Take the time from the first attempt of a repeated exchange to its answer: an upper bound."""
        if self.round_trip is None or elapsed < self.round_trip:
            self.round_trip, self._variation = elapsed, min(elapsed / 4, BOUND_VARIATION)
            self._is_bound = True

    def answered(self, attempts: int) -> None:
        """Count the attempts of an exchange that was answered: all but one were lost."""
        self._lost += attempts - 1
        self._sent += attempts
        if self._sent > SENT_MAX:
            self._lost, self._sent = self._lost / 2, self._sent / 2

    def timeout(self, attempt: int) -> float:
        """Return the seconds to wait for the answer to an attempt, counted from 0."""
        if self.round_trip is None:
            return float(min(FIRST_TIMEOUT * BACKOFF**attempt, FIRST_TIMEOUT_MAX))
        timeout = max(TIMEOUT_MIN, self.round_trip + max(4 * self._variation, VARIATION_MIN))
        return float(min(timeout * BACKOFF_MEASURED ** max(0, attempt - BACKOFF_FROM), TIMEOUT_MAX))

    @property
    def attempts_max(self) -> int:
        """Attempts after which loss no longer explains the silence."""
        return min(max(self.attempts_for(SILENCE_BY_LOSS), ATTEMPTS_MIN), ATTEMPTS_MAX)

    @property
    def copies(self) -> int:
        """Copies of a request to send at once, where few are missing and waiting costs more than sending."""
        return min(self.attempts_for(MISSED_BY_COPIES), COPIES_MAX)

    def attempts_for(self, probability: float) -> int:
        """Return the attempts of which all are lost with no more than this probability."""
        return math.ceil(math.log(probability) / math.log(self.loss))


def keys_of(message: Message) -> tuple[Key, ...]:
    """Return the keys under which conversations wait for a message."""
    match message:
        case messages.ParamValue() | messages.ParamExtValue():
            value: Key = type(message)
            if message.param_index == messages.NO_INDEX:
                return (value, message.param_id), value
            return (value, message.param_id), (value, message.param_index), value
        case messages.ParamError(param_id=name, param_index=index):
            return (messages.ParamValue, name if index == -1 or name else index), (messages.ParamValue, index)
        case messages.ParamExtAck(param_id=name):
            return ((messages.ParamExtAck, name),)
        case messages.CommandAck(command=command):
            return ((messages.CommandAck, command),)
        case messages.FileTransfer(payload=payload):
            return (messages.FileTransfer, int.from_bytes(payload[:2], "little")), messages.FileTransfer
        case _:
            return (type(message),)


@dataclass(eq=False, repr=False)
class Channel:
    """One component's side of the link.

    Args:
        system, component: the component's address.
        send: queues a message for the component.
        gate: whether the link carries messages.
        presence: when the component was heard.

    Attributes:
        target: the component's address.
        reads_from: where reads and lists are sent to: the address, or the autopilot of the system.
        send: queues a message for the component.
        timing: round trip and loss.
        window: limits the reads in flight; it follows what the vehicle serves.
        window_size: of the window.
        is_streaming: whether a list runs: an answer to a read may be a part of it, and measures nothing.
        ftp: taken for each use of MAVFTP: servers have one session.
        answered: set when the component has answered its first request.
        inboxes: those of the conversations that wait, by key.
    """

    system: int
    component: int
    send: Callable[[Message], None]
    gate: Gate
    presence: Presence

    def __post_init__(self) -> None:
        self.target = self.reads_from = (self.system, self.component)
        self.timing = Timing()
        self.is_streaming = False
        self.ftp = anyio.Lock()
        self.answered = anyio.Event()
        self._ftp_sequence: int | None = None
        self.inboxes: dict[Key, list[Inbox]] = {}
        self._waits: dict[anyio.CancelScope, tuple[float, int, float] | None] = {}
        self.window = anyio.Semaphore(WINDOW)
        self.window_size = WINDOW

    def __str__(self) -> str:
        return f"{self.system}/{self.component}"

    def widen(self, requests: int) -> None:
        """Enlarge the window to this many requests."""
        for _ in range(requests - self.window_size):
            self.window.release()
        self.window_size = max(self.window_size, requests)

    def next_ftp_sequence(self) -> int:
        """Return the sequence number of the next MAVFTP request: servers answer a repeated one again.

        The first one follows from the time, so that it differs from the last one of an earlier program, to
        which the server would answer again.
        """
        if self._ftp_sequence is None:
            self._ftp_sequence = int(anyio.current_time() * FTP_SEQUENCES_PER_SECOND)
        self._ftp_sequence = (self._ftp_sequence + 2) & 0xFFFF
        return self._ftp_sequence

    def dispatch(self, message: Message) -> None:
        """Wake the conversations that wait for a message."""
        if self.inboxes:
            for key in keys_of(message):
                for inbox in self.inboxes.get(key, ()):
                    inbox.put(message)

    @contextmanager
    def inbox(self, *keys: Key) -> Iterator[Inbox]:
        """Collect the messages with some keys for one conversation, without a gap between its steps."""
        inbox = Inbox()
        for key in keys:
            self.inboxes.setdefault(key, []).append(inbox)
        try:
            yield inbox
        finally:
            for key in keys:
                self.inboxes[key].remove(inbox)
                if not self.inboxes[key]:
                    del self.inboxes[key]

    @property
    def is_lost(self) -> bool:
        """Whether the component sends heartbeats, and was silent for longer than these explain."""
        return anyio.current_time() - self.presence.received_at >= self.presence.timeout

    def is_silent(self, began: float) -> bool:
        """Return whether a conversation ends that began then: the component is silent for too long.

        One that begins in such a silence has as much time of its own.
        """
        now, heard = anyio.current_time(), self.presence.received_at
        silence_max = min(self.presence.timeout, SILENCE_MAX)
        return now - (heard if began - heard < silence_max else began) >= silence_max

    def is_hopeless(self, attempts: int, began: float, attempts_max: int | None = None) -> bool:
        """Return whether to give up a request that was sent so often since `began`.

        Without `attempts_max`, loss must not explain the silence, and the component must have had time.
        """
        elapsed = anyio.current_time() - began
        if self.is_silent(began) or (not self.answered.is_set() and elapsed >= UNANSWERED_MAX):
            return True
        if attempts_max is not None:
            return attempts >= attempts_max
        return attempts >= self.timing.attempts_max and elapsed >= PATIENCE_MIN

    @contextmanager
    def waiting_until(
        self, deadline: float, attempt: tuple[float, int, float] | None = None
    ) -> Iterator[anyio.CancelScope]:
        """Run a block that waits for a message, until the deadline or until the component is lost.

        Args:
            deadline: on the clock of the event loop.
            attempt: when a request was sent, how often before, and the seconds to wait at least: a shorter
                round trip that is measured meanwhile shortens the wait.

        Raises:
            LinkError: the link has failed.
        """
        with anyio.CancelScope(deadline=deadline) as scope:
            self._waits[scope] = attempt
            try:
                yield scope
            finally:
                del self._waits[scope]
        if scope.cancelled_caught:
            self.gate.check()

    def lose(self) -> None:
        """End the waits for messages: the component is lost, or the link has failed."""
        for scope in self._waits:
            scope.cancel()

    async def exchange(
        self,
        request: Message | Callable[[int], Message],
        inbox: Inbox,
        accept: Callable[[Message], T | None],
        *,
        what: str,
        attempts: int | Callable[[], int] | None = None,
        copies: Callable[[int], int] = lambda attempt: 1,
        timeout_min: float = 0.0,
        ready: Callable[[], Awaitable[None]] | None = None,
    ) -> T:
        """Send a request until it is answered. Cancellation leaves nothing behind.

        Args:
            request: sent in each attempt, or a function that returns it for an attempt, counted from 0.
            inbox: takes the answers; it may hold earlier ones.
            accept: returns the answer in a message, or None for a message that is none. It may raise the
                error that the message tells.
            what: names the request in the error.
            attempts: at most, or a function that returns them; None for as many as loss explains.
            copies: returns how often an attempt, counted from 0, is sent at once.
            timeout_min: seconds to wait in each attempt, at least.
            ready: awaited before each attempt, in place of the open link.

        Raises:
            NoReply: loss no longer explains the silence, or nothing at all was heard of the component.
            LinkError: the link is closed for good.
        """
        began = anyio.current_time()
        attempt = 0
        while True:
            await (self.gate.wait if ready is None else ready)()
            sent = anyio.current_time()
            message = request(attempt) if callable(request) else request
            for _ in range(copies(attempt)):
                self.send(message)
            answer = await self.wait_for(inbox, accept, sent, attempt, timeout_min)
            attempt += 1
            now = anyio.current_time()
            if answer is not None:
                self._measure(attempt, now - sent, now - began)
                return answer
            if self.is_hopeless(attempt, began, attempts() if callable(attempts) else attempts):
                raise NoReply(what, attempts=attempt, waited=now - began)

    async def wait_for(
        self,
        inbox: Inbox,
        accept: Callable[[Message], T | None],
        sent: float,
        attempt: int,
        timeout_min: float = 0.0,
    ) -> T | None:
        """Wait for the answer to an attempt that was sent; return None at its timeout, or in a loss.

        A program that wakes up late, as it was stalled, looks once more.
        """
        answer: T | None = None
        deadline = sent + max(self.timing.timeout(attempt), timeout_min)
        with self.waiting_until(deadline, (sent, attempt, timeout_min)) as scope:
            answer = await _accepted(inbox, accept)
        if answer is None and anyio.current_time() > scope.deadline + LATE_WAKE_UP:
            with anyio.move_on_after(LATE_GRACE):
                answer = await _accepted(inbox, accept)
        return answer

    def _measure(self, attempts: int, last: float, whole: float) -> None:
        """Take the times of an answered exchange; it shortens the waits that are open."""
        timing = self.timing
        self.answered.set()
        timing.slowest = max(timing.slowest, whole)
        if self.is_streaming:
            return
        timing.answered(attempts)
        if attempts == 1:
            timing.measure(last)
        else:
            timing.bound(whole)
        for scope, request in self._waits.items():
            if request is not None:
                sent, attempt, timeout_min = request
                scope.deadline = min(scope.deadline, sent + max(timing.timeout(attempt), timeout_min))


@asynccontextmanager
async def task_group() -> AsyncIterator[anyio.abc.TaskGroup]:
    """Run the tasks of one conversation. The first of their errors is raised itself, and ends the others."""
    try:
        async with anyio.create_task_group() as tasks:
            yield tasks
    except ExceptionGroup as group:
        raise group.exceptions[0] from None


async def _accepted(inbox: Inbox, accept: Callable[[Message], T | None]) -> T:
    while True:
        answer = accept(await inbox.next())
        if answer is not None:
            return answer
