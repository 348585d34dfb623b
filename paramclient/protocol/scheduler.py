"""Scheduler: which of the many components of a link are handled when, and which of their lists run."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from heapq import heapify, heappop, heappush
from itertools import islice
from typing import Final, NamedTuple, Protocol

from paramclient.protocol.requests.pacing import LinkBandwidth

__all__ = ["Scheduled", "Scheduler", "ListStatistics", "QueuedList", "ListAdmission"]

TICKED_COMPONENTS_MAX: Final = 16
"""Components handled in one `tick`, which takes a few milliseconds. For more, `tick` is due again at once."""
EXAMINED_COMPONENTS_MAX: Final = 128
"""Components whose deadlines are evaluated in one call: 3 ms. For more, `tick` is due again at once."""
STALE_DEADLINES_MAX: Final = 8
"""Stale deadlines for each component that the heap may hold before it is rebuilt."""
LIMIT_RECHECK_INTERVAL: Final = 0.01
"""Seconds between two attempts to begin a list while the event loop limits the number of lists."""

JUDGED_VALUES_MIN: Final = 20
"""Values of a new list after which its effect on the others is judged."""
EXPECTED_VALUES_MIN: Final = 10.0
"""Expected values of the earlier lists, at least, before their pace is judged."""
JUDGED_GAPS: Final = 8.0
"""The same in longest gaps of the list: a burst of PX4 is 20 values at once, and says nothing of the time
between bursts."""
JUDGED_GAPS_BURSTY: Final = 2.0
"""The same where a burst takes no time: then loss decides, and not the pace."""
JUDGED_TIME: Final = 0.5
"""Seconds after which a slow list is judged anyway: it does not use much of the link."""
GROWTH: Final = 2
"""The factor by which the number of parallel lists may grow when the running ones show free bandwidth."""
GROWTH_BURSTY: Final = 8
"""The same for lists in bursts that take no time, until values are lost at the limit: the link is then idle
nearly all of the time. The same number begins at once: their bursts fit into any buffer."""
START_INTERVAL_BURSTY: Final = 0.00015
"""Seconds between the starts of further lists in bursts, for each running list. Lists that start together
send nothing at first, and then more than can be read before it is lost: PX4 answers within 20 ms, and the
effect of one list is to be seen before many have followed. As PX4's list of 1,000 values takes 1 s, no more
than 80 of them run in parallel: more than one core reads."""
RETRY_DELAY_BURSTY: Final = 0.25
"""Seconds until the next attempt with more lists after a failed one, for lists in bursts that take no time:
they last no longer than 1 s."""
RETRY_DELAY: Final = 5.0
"""The same for other lists; doubled after each failed attempt."""
RETRY_DELAY_MAX: Final = 60.0
"""The longest delay in seconds until the next attempt."""
MEASUREMENT_LIFETIME: Final = 30.0
"""Seconds without any list after which the measurements of the link expire."""
LOSS_RISE_MIN: Final = 0.1
"""The increase of the share of lost values, at least, that indicates a lack of bandwidth."""
LOSS_RISE_DEVIATIONS: Final = 2.0
"""The same in standard deviations; both must be exceeded."""
PACE_DROP: Final = 0.8
"""The share of their former pace below which the earlier lists indicate a lack of bandwidth."""


class ListStatistics(NamedTuple):
    """The statistics of a list since its request.

    Attributes:
        received: values by which it advanced.
        covered: indices that it covered, including lost ones.
        longest: the longest recent time between two values, in seconds.
        is_bursty: whether most values are received together.
    """

    received: int
    covered: int
    longest: float
    is_bursty: bool


class QueuedList(Protocol):
    """A list download that needs a turn.

    Attributes:
        silent_at: when the list counts as silent, while nothing was received; otherwise infinity.
        is_awaited: whether nothing of the list was received since the turn began.
    """

    @property
    def silent_at(self) -> float: ...

    @property
    def is_awaited(self) -> bool: ...

    def begin(self, now: float) -> None:
        """Request the list: its turn begins."""

    def seen(self) -> ListStatistics: ...


class ListAdmission:
    """Gives the lists of one link their turns.

    A single list begins at once. Others begin when the running lists have shown their pace and the last ones
    to begin made none of them slower or lossier: each time as many again. If they did, no more lists run in
    parallel than before, and one more is tried later; with lists in bursts that take no time, after a short
    delay, and as many again. A silent list uses no bandwidth: it is no longer counted after its timeout.

    On a link that is faster than the program, the program is the bottleneck. Beyond the first few, lists in
    bursts therefore begin one after the other, and none while unread data is waiting.

    Attributes:
        bandwidth: the bandwidth that all reads of the link may use together.
    """

    def __init__(self) -> None:
        self.bandwidth = LinkBandwidth()
        self._are_bursty = False  # whether the lists judged last arrive in bursts: on a fast link
        self._now = -math.inf
        self._limit = 1
        self._shown = 0  # the number of parallel lists that had enough bandwidth
        self._failures = 0
        self._again_at = -math.inf  # when more may be tried
        self._idle_since = -math.inf
        self._begun_at = -math.inf  # when a turn began last
        self._crowded_at = -math.inf  # when several lists ran last
        self._is_crowded = False  # whether other links have lists too
        self._lone: QueuedList | None = None  # the last list that ran alone
        self._lone_at = -math.inf  # when that was
        self._waiting: dict[QueuedList, None] = {}
        self._running: dict[QueuedList, ListStatistics] = {}  # as the newest began to arrive
        self._newest: set[QueuedList] = set()
        self._marked_at: float | None = None  # when that was
        self._paces: dict[QueuedList, float] = {}  # at the last look
        self._received = self._covered = 0  # of all lists while there was enough bandwidth

    @property
    def is_free(self) -> bool:
        """Whether a list may begin at once."""
        return not self._waiting and self._active() < self._limit

    @property
    def bursts(self) -> int:
        """The number of lists in bursts."""
        return sum(not queued.is_awaited and queued.seen().is_bursty for queued in self._running)

    def awaited(self, now: float) -> int:
        """Return the number of lists about to start: nothing was received of them, within their timeout."""
        return sum(queued.is_awaited and queued.silent_at > now for queued in self._running)

    def ask(self, queued: QueuedList, now: float) -> None:
        """Request a turn; `QueuedList.begin` is called at once or later. Give it back with `release`."""
        self._now = now
        if not self._running and now - self._idle_since > MEASUREMENT_LIFETIME:
            self._limit = 1
            self._failures = self._received = self._covered = self._shown = 0
            self._again_at = -math.inf
        if not self._waiting and self._free_slots() > 0:
            self._begin(queued, now)
        else:
            self._waiting[queued] = None

    def has_begun(self, queued: QueuedList) -> None:
        """Record a list that was requested without a turn."""
        self._running[queued] = _NOTHING
        is_one_more = len(self._running) > self._shown  # otherwise it replaces a finished list
        if is_one_more or not self._are_bursty:
            self._newest.add(queued)
            self._marked_at = None

    def release(self, queued: QueuedList, *, is_cut: bool = False) -> None:
        """Give a turn back. The next list begins with the next `tick`.

        Args:
            queued: the holder of the turn.
            is_cut: whether the list went silent before its end.
        """
        if self._running.pop(queued, None) is None:
            self._waiting.pop(queued, None)
            return
        self._newest.discard(queued)
        self._paces.pop(queued, None)
        if is_cut and self._running:
            self._fail(len(self._running))
        if not self._running:
            self._idle_since = self._now

    def is_parallel_to_others(self, queued: QueuedList) -> bool:
        """Return whether other lists run, also on other links that share the event loop."""
        return self._is_crowded or any(each is not queued and not each.is_awaited for each in self._running)

    def parallel_to_others_at(self, queued: QueuedList) -> float:
        """Return when another list ran last."""
        return max(self._crowded_at, -math.inf if self._lone is queued else self._lone_at)

    def tick(self, now: float, *, lists_max: float = math.inf, is_crowded: bool = False) -> bool:
        """Begin further lists if there is bandwidth; return whether any has begun.

        Args:
            now: the time.
            lists_max: the limit of parallel lists by the event-loop latency.
            is_crowded: whether lists of other links share the event loop.
        """
        self._now = now
        coming = [queued for queued in self._running if not queued.is_awaited]
        self._is_crowded = is_crowded
        if len(coming) > 1 or is_crowded:
            self._crowded_at = now
        elif coming:
            if self._lone is not coming[0]:
                self._crowded_at = max(self._crowded_at, self._lone_at)
                self._lone = coming[0]
            self._lone_at = now
        if self._waiting and not self._newest and self._again_at <= now:
            self._newest.update(coming if self._are_bursty else self._running)
        if self._newest:
            self._judge_bandwidth(now)
        begins = min(self._free_slots(), len(self._waiting))
        begins = int(min(begins, lists_max - self._active()))
        for _ in range(begins):
            queued = next(iter(self._waiting))
            del self._waiting[queued]
            self._begin(queued, now)
        return begins > 0

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        if not self._waiting:
            return math.inf
        if self._active() < self._limit:
            return self._now if self._free_slots() > 0 else self._next_at
        times = [queued.silent_at for queued in self._running if queued.silent_at > self._now]
        if not self._newest:
            # lists in bursts are judged on arrival: while all are awaited, nothing is due
            if not self._are_bursty or any(not queued.is_awaited for queued in self._running):
                times.append(max(self._again_at, self._now))
        elif self._marked_at is not None:
            times.append(self._marked_at + JUDGED_TIME)
        return min(times, default=math.inf)

    def resume(self, now: float) -> None:
        """Drop the measurements: the link is back, and may have changed."""
        self._now = now
        self._paces.clear()
        self._marked_at = None

    def _begin(self, queued: QueuedList, now: float) -> None:
        self.has_begun(queued)
        self._begun_at = now
        queued.begin(now)

    def _active(self) -> int:
        return sum(queued.silent_at > self._now for queued in self._running)

    @property
    def _next_at(self) -> float:
        """When the next list begins beside many lists in bursts."""
        return self._begun_at + START_INTERVAL_BURSTY * len(self._running)

    def _free_slots(self) -> int:
        """Return how many lists may begin now."""
        slots = self._limit - self._active()
        if self._are_bursty:
            slots = min(slots, max(GROWTH_BURSTY - len(self._running), int(self._now >= self._next_at)))
        return slots

    def _judge_bandwidth(self, now: float) -> None:
        """Judge by the statistics whether the newest lists had enough bandwidth."""
        active = [queued for queued in self._running if queued.silent_at > now]
        judged = self._newest.intersection(active) if self._are_bursty else active
        if any(queued.is_awaited for queued in judged):
            return
        if not active:  # all are silent: nothing is known of the link, and its bandwidth is free
            self._limit *= GROWTH
            self._newest.clear()
            return
        if self._marked_at is None:
            self._marked_at = now
            for queued in active:
                self._running[queued] = queued.seen()
            return
        since = now - self._marked_at
        received = covered = earlier = 0
        expected = 0.0
        is_shown = is_bursty = True
        paces = {}
        for queued in active:
            seen, mark = queued.seen(), self._running[queued]
            if seen.covered < mark.covered:  # restarted
                mark = _NOTHING
            one_received, one_covered = seen.received - mark.received, seen.covered - mark.covered
            if queued in self._newest:
                gaps = JUDGED_GAPS_BURSTY if seen.is_bursty else JUDGED_GAPS
                is_shown = is_shown and one_received >= JUDGED_VALUES_MIN and since >= gaps * seen.longest
                is_bursty = is_bursty and seen.is_bursty
            received += one_received
            covered += one_covered
            paces[queued] = one_covered / since if since > 0 else 0.0
            if queued in self._paces:
                earlier += one_covered
                expected += self._paces[queued] * since
        if not is_shown and now < self._marked_at + JUDGED_TIME:
            return
        self._are_bursty = is_bursty
        is_slower = expected >= EXPECTED_VALUES_MIN and not is_bursty and earlier < PACE_DROP * expected
        if is_slower or self._has_loss_risen(received, covered):
            self._fail(len(active) - len(self._newest) or len(active) // 2 * self._are_bursty)
        else:
            self._shown = max(self._shown, len(active))
            self._received += received
            self._covered += covered
            self._paces = paces
            # several lists that began together show nothing of a single one
            if now >= self._again_at and (expected or len(active) == 1):
                growth = GROWTH_BURSTY if is_bursty and not self._failures else GROWTH
                is_careful = self._failures and not is_bursty
                more = len(active) + 1 if is_careful else len(active) * growth
                self._limit = max(self._limit, more)
        self._newest.clear()
        self._marked_at = None

    def _fail(self, limit: int) -> None:
        """Limit the number of parallel lists for a while: there was not enough bandwidth."""
        if self._are_bursty and self._now < self._again_at:
            return  # with as many lists as run there, further ones are cut off for the same reason
        self._limit = self._shown = max(min(limit, self._limit), 1)
        retry = RETRY_DELAY_BURSTY if self._are_bursty else RETRY_DELAY
        self._again_at = self._now + min(retry * 2**self._failures, RETRY_DELAY_MAX)
        self._failures += 1

    def _has_loss_risen(self, received: int, covered: int) -> bool:
        """Return whether more was lost in this window than the link usually loses."""
        if not covered or not self._covered:
            return False
        before = 1 - self._received / self._covered
        rise = 1 - received / covered - before
        pooled = 1 - (received + self._received) / (covered + self._covered)
        deviation = math.sqrt(pooled * (1 - pooled) * (1 / covered + 1 / self._covered))
        return rise > max(LOSS_RISE_MIN, LOSS_RISE_DEVIATIONS * deviation)


_NOTHING = ListStatistics(0, 0, 0.0, False)


class Scheduled(Protocol):
    """A component, as far as the scheduler knows it.

    Attributes:
        is_waiting: whether anything is in progress.
        is_busy: whether anything is in progress that a check would delay.
    """

    @property
    def is_waiting(self) -> bool: ...

    @property
    def is_busy(self) -> bool: ...

    def tick(self, now: float) -> None:
        """Do what is due."""

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""


class Scheduler:
    """Handles the components of one link that are due, and none of the others.

    With many components, to look at the deadlines of all of them takes most of the time. The scheduler
    therefore keeps the deadline of each. A component reports with its `reporter` that its deadline may have
    changed: it has received or sent a message, or a caller's operation has begun or ended. A larger share of
    the link's bandwidth, when other components have ended their requests, is used from its next deadline on.

    Attributes:
        list_admission: which lists run.
        lists_max: the limit of parallel lists by the event-loop latency. Set by the shell.
        is_crowded: whether lists of other links share the event loop. Set by the shell.
    """

    def __init__(self) -> None:
        self.list_admission = ListAdmission()
        self.lists_max = math.inf
        self.is_crowded = False
        self._now = -math.inf
        self._numbers: dict[Scheduled, int] = {}
        self._components: dict[int, Scheduled] = {}  # by number
        self._deadlines: dict[int, float] = {}  # by number, if not infinite
        self._order: list[tuple[float, int]] = []  # a heap of these, some of them stale
        self._last_number = 0
        self._changed: dict[Scheduled, None] = {}
        self._last_waiting: Scheduled | None = None
        self._last_busy: Scheduled | None = None

    def add(self, component: Scheduled) -> None:
        """Handle a component from now on."""
        self._last_number += 1
        self._numbers[component] = self._last_number
        self._components[self._last_number] = component
        self._changed[component] = None

    def remove(self, component: Scheduled) -> None:
        """Forget a component."""
        number = self._numbers.pop(component)
        del self._components[number]
        self._deadlines.pop(number, None)
        self._last_waiting = self._last_busy = None

    def reporter(self, component: Scheduled) -> Callable[[], None]:
        """Return the function with which a component reports that its deadline may have changed.

        It is called for each message, and therefore takes the least time possible.
        """
        return partial(self._changed.__setitem__, component, None)

    def reschedule_all(self) -> None:
        """Note that any deadline may have changed."""
        self._changed.update(dict.fromkeys(self._numbers))

    @property
    def is_waiting(self) -> bool:
        """Whether any component waits for anything."""
        last = self._last_waiting
        if last is None or not last.is_waiting:  # mostly still the same one
            self._last_waiting = next((each for each in self._numbers if each.is_waiting), None)
        return self._last_waiting is not None

    @property
    def is_busy(self) -> bool:
        """Whether anything is in progress on the link that a check would delay."""
        last = self._last_busy
        if last is None or not last.is_busy:
            self._last_busy = next((each for each in self._numbers if each.is_busy), None)
        return self._last_busy is not None

    def tick(self, now: float) -> None:
        """Handle up to `TICKED_COMPONENTS_MAX` due components, and begin the lists whose turn it is."""
        self._now = now
        self._note_changed()
        for component in self._take_due(now):
            component.tick(now)
            self._changed[component] = None
        if self.list_admission.tick(now, lists_max=self.lists_max, is_crowded=self.is_crowded):
            self.reschedule_all()

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        self._note_changed()
        if self._changed:
            return self._now
        order = self._order
        while order and self._deadlines.get(order[0][1]) != order[0][0]:
            heappop(order)
        lists = self.list_admission.next_deadline()
        if self.lists_max < math.inf:  # a waiting list has a deadline, but may not begin yet
            lists = max(lists, self._now + LIMIT_RECHECK_INTERVAL)
        return min(lists, order[0][0]) if order else lists

    def _note_changed(self) -> None:
        """Note the deadlines of components that have reported a change, at most `EXAMINED_COMPONENTS_MAX`."""
        changed = list(islice(self._changed, EXAMINED_COMPONENTS_MAX))
        deadlines, order = self._deadlines, self._order
        for component in changed:
            del self._changed[component]
            number = self._numbers.get(component)
            if number is None:
                continue  # removed
            deadline = component.next_deadline()
            if deadline == math.inf:
                deadlines.pop(number, None)
            elif deadline != deadlines.get(number):
                deadlines[number] = deadline
                heappush(order, (deadline, number))
        if len(order) > STALE_DEADLINES_MAX * (len(deadlines) + 1):
            order[:] = ((at, number) for number, at in deadlines.items())
            heapify(order)

    def _take_due(self, now: float) -> list[Scheduled]:
        """Return the components that are due, at most `TICKED_COMPONENTS_MAX`, without their deadlines."""
        due: list[int] = []
        while self._order and self._order[0][0] <= now and len(due) < TICKED_COMPONENTS_MAX:
            at, number = heappop(self._order)
            if self._deadlines.get(number) == at:
                del self._deadlines[number]
                due.append(number)
        return [self._components[number] for number in sorted(due)]
