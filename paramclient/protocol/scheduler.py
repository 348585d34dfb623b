"""Whose list is sent now: the components of one link take turns, as many at a time as it has room for."""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple, Protocol

from paramclient.protocol.requests.pacing import Share

__all__ = ["Seen", "Stream", "Turns"]

ENOUGH_SEEN: Final = 20
"""Values of a new list after which it has shown how it comes beside the others."""
FEWEST_EXPECTED: Final = 10.0
"""Values of the earlier lists that must have been due meanwhile for their pace to tell anything."""
SHOWING_GAPS: Final = 8.0
"""The same in its longest gaps: a burst of PX4 is 20 values at once, and says nothing of the time between."""
BURSTY_GAPS: Final = 2.0
"""The same where a burst takes no time: then loss tells, and not the pace."""
SHOWING_TIME: Final = 0.5
"""Seconds after which a slow list has shown enough: it does not take much of the link."""
GROWTH: Final = 2
"""How many times as many may run when those that run have shown room."""
FAST_GROWTH: Final = 8
"""The same where values come in bursts that take no time, until any were lost for want of room: then the link
is idle nearly all of the time. So many begin at once, too: their bursts find room in any buffer."""
SPREAD: Final = 0.00015
"""Seconds between the beginnings of further ones there, for each that runs. Those that begin together bring
nothing at first, and then more than can be read before it is lost: PX4 answers within 20 ms, and what one
brings is to be seen before many have followed. As PX4's list of 1,000 values takes a second, no more than 80
of them run beside each other: more than one core reads."""
FAST_RETRY: Final = 0.25
RETRY: Final = 5.0
LONGEST_RETRY: Final = 60.0
"""Seconds after which more are tried again when there was no room; doubled from the first to the longest.
The fast one is for lists that come in bursts which take no time: they last no longer than a second."""
MEMORY: Final = 30.0
"""Seconds without any list after which what was found out about the link counts no more."""
LOSSIER: Final = 0.1
"""By how much the share of lost values must rise, at the least, before that is for want of room."""
UNLIKELY: Final = 2.0
"""Standard deviations by which it must rise as well."""
SLOWER: Final = 0.8
"""To which share of their pace the earlier lists must fall before that is for want of room."""


class Seen(NamedTuple):
    """What a list has shown since it was asked for.

    Attributes:
        came: values by which it went forward.
        passed: indices that it went over, with those that were lost.
        longest: the longest time of late between two values, in seconds.
        is_bursty: whether most of them come together.
    """

    came: int
    passed: int
    longest: float
    is_bursty: bool


class Stream(Protocol):
    """Someone whose list wants a turn.

    Attributes:
        silent_at: while nothing has come: when that has lasted too long. Else infinity.
        is_awaited: whether nothing of the list has come since the turn began.
    """

    @property
    def silent_at(self) -> float: ...

    @property
    def is_awaited(self) -> bool: ...

    def begin(self, now: float) -> None:
        """It is this one's turn: ask for the list."""

    def seen(self) -> Seen: ...


class Turns:
    """Gives the lists of one link their turns.

    A list that is alone begins at once. Others begin when those that run have shown their pace and the last
    ones to begin made none of them slower or lossier: as many again each time. When they did, no more run
    beside each other than before, and one more is tried a while later; where lists come in bursts that take
    no time, soon, and as many again. One that stays silent takes nothing of the link: it is no longer counted
    once its time-out is over.

    On a link that is faster than the program it is the program that has no room. So beyond the first few,
    lists that come in bursts begin one after the other, and none while more has come than was read.

    Attributes:
        share: what all reads of the link may take of it together.
    """

    def __init__(self) -> None:
        self.share = Share()
        self._are_bursty = False  # whether the lists that were looked at last come in bursts: on a fast link
        self._now = -math.inf
        self._limit = 1
        self._shown = 0  # how many have run beside each other and had room
        self._failures = 0
        self._again_at = -math.inf  # when more may be tried
        self._idle_since = -math.inf
        self._begun_at = -math.inf  # when a turn was given last
        self._crowded_at = -math.inf  # when several lists came last
        self._is_crowded = False  # whether other links have lists too
        self._lone: Stream | None = None  # the list that came alone last
        self._lone_at = -math.inf  # when that was
        self._waiting: deque[Stream] = deque()
        self._running: dict[Stream, Seen] = {}  # with what it had shown when the newest began to come
        self._newest: set[Stream] = set()
        self._marked_at: float | None = None  # when that was
        self._paces: dict[Stream, float] = {}  # as they were at the last look
        self._came = self._passed = 0  # of all lists, as long as there was room

    @property
    def is_free(self) -> bool:
        """Whether a list may begin at once."""
        return not self._waiting and self._active() < self._limit

    @property
    def bursts(self) -> int:
        """How many lists come in bursts."""
        return sum(not stream.is_awaited and stream.seen().is_bursty for stream in self._running)

    def awaited(self, now: float) -> int:
        """How many may do so soon: nothing has come of them, and their time-out is not over."""
        return sum(stream.is_awaited and stream.silent_at > now for stream in self._running)

    def ask(self, stream: Stream, now: float) -> None:
        """Want a turn; `Stream.begin` is called at once, or when it comes. Ended by `give_back`."""
        self._now = now
        if not self._running and now - self._idle_since > MEMORY:
            self._limit = 1
            self._failures = self._came = self._passed = self._shown = 0
            self._again_at = -math.inf
        if not self._waiting and self._room() > 0:
            self._begin(stream, now)
        else:
            self._waiting.append(stream)

    def has_begun(self, stream: Stream) -> None:
        """A list runs that was asked for without a turn."""
        self._running[stream] = _NOTHING
        is_one_more = len(self._running) > self._shown  # else it has taken the place of one that is over
        if is_one_more or not self._are_bursty:
            self._newest.add(stream)
            self._marked_at = None

    def give_back(self, stream: Stream, *, is_cut: bool = False) -> None:
        """The list is over, or is wanted no more. The next one begins with the next `tick`.

        Args:
            stream: whose it is.
            is_cut: whether it fell quiet before its end.
        """
        if self._running.pop(stream, None) is None:
            if stream in self._waiting:
                self._waiting.remove(stream)
            return
        self._newest.discard(stream)
        self._paces.pop(stream, None)
        if is_cut and self._running:
            self._fail(len(self._running))
        if not self._running:
            self._idle_since = self._now

    def is_beside_others(self, stream: Stream) -> bool:
        """Whether lists of others come now, be it on other links that take the program's time."""
        return self._is_crowded or any(each is not stream and not each.is_awaited for each in self._running)

    def beside_others_at(self, stream: Stream) -> float:
        """When a list of another one came last."""
        return max(self._crowded_at, -math.inf if self._lone is stream else self._lone_at)

    def tick(self, now: float, *, most: float = math.inf, is_crowded: bool = False) -> bool:
        """Let the next ones begin, if there is room; whether any has.

        Args:
            now: the time.
            most: so many may run beside each other, as the program has no time for more.
            is_crowded: whether lists of other links take the program's time.
        """
        self._now = now
        coming = [stream for stream in self._running if not stream.is_awaited]
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
            self._look(now)
        begins = min(self._room(), len(self._waiting))
        begins = int(min(begins, most - self._active()))
        for _ in range(begins):
            self._begin(self._waiting.popleft(), now)
        return begins > 0

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity."""
        if not self._waiting:
            return math.inf
        if self._active() < self._limit:
            return self._now if self._room() > 0 else self._next_at
        times = [stream.silent_at for stream in self._running if stream.silent_at > self._now]
        if not self._newest:
            # lists in bursts are judged once they come: while all are awaited, nothing is due
            if not self._are_bursty or any(not stream.is_awaited for stream in self._running):
                times.append(max(self._again_at, self._now))
        elif self._marked_at is not None:
            times.append(self._marked_at + SHOWING_TIME)
        return min(times, default=math.inf)

    def resume(self, now: float) -> None:
        """The link is back: what was measured before it went counts no more."""
        self._now = now
        self._paces.clear()
        self._marked_at = None

    def _begin(self, stream: Stream, now: float) -> None:
        self.has_begun(stream)
        self._begun_at = now
        stream.begin(now)

    def _active(self) -> int:
        return sum(stream.silent_at > self._now for stream in self._running)

    @property
    def _next_at(self) -> float:
        """When the next one begins beside many that come in bursts."""
        return self._begun_at + SPREAD * len(self._running)

    def _room(self) -> int:
        """How many may begin now."""
        room = self._limit - self._active()
        if self._are_bursty:
            room = min(room, max(FAST_GROWTH - len(self._running), int(self._now >= self._next_at)))
        return room

    def _look(self, now: float) -> None:
        """Judge by what has come whether the newest lists had room."""
        active = [stream for stream in self._running if stream.silent_at > now]
        judged = self._newest.intersection(active) if self._are_bursty else active
        if any(stream.is_awaited for stream in judged):
            return
        if not active:  # all keep silent, so nothing is known of the link, and nobody is in the way
            self._limit *= GROWTH
            self._newest.clear()
            return
        if self._marked_at is None:
            self._marked_at = now
            for stream in active:
                self._running[stream] = stream.seen()
            return
        since = now - self._marked_at
        came = passed = earlier = 0
        expected = 0.0
        is_shown = is_bursty = True
        paces = {}
        for stream in active:
            seen, mark = stream.seen(), self._running[stream]
            if seen.passed < mark.passed:  # it has begun anew
                mark = _NOTHING
            one_came, one_passed = seen.came - mark.came, seen.passed - mark.passed
            if stream in self._newest:
                gaps = BURSTY_GAPS if seen.is_bursty else SHOWING_GAPS
                is_shown = is_shown and one_came >= ENOUGH_SEEN and since >= gaps * seen.longest
                is_bursty = is_bursty and seen.is_bursty
            came += one_came
            passed += one_passed
            paces[stream] = one_passed / since if since > 0 else 0.0
            if stream in self._paces:
                earlier += one_passed
                expected += self._paces[stream] * since
        if not is_shown and now < self._marked_at + SHOWING_TIME:
            return
        self._are_bursty = is_bursty
        is_slower = expected >= FEWEST_EXPECTED and not is_bursty and earlier < SLOWER * expected
        if is_slower or self._is_lossier(came, passed):
            self._fail(len(active) - len(self._newest) or len(active) // 2 * self._are_bursty)
        else:
            self._shown = max(self._shown, len(active))
            self._came += came
            self._passed += passed
            self._paces = paces
            # several that began together have shown nothing of how each one comes alone
            if now >= self._again_at and (expected or len(active) == 1):
                growth = FAST_GROWTH if is_bursty and not self._failures else GROWTH
                is_careful = self._failures and not is_bursty
                more = len(active) + 1 if is_careful else len(active) * growth
                self._limit = max(self._limit, more)
        self._newest.clear()
        self._marked_at = None

    def _fail(self, limit: int) -> None:
        """There was no room: no more than so many for a while."""
        if self._are_bursty and self._now < self._again_at:
            return  # of as many lists as run there, others are cut for the same want of room
        self._limit = self._shown = max(min(limit, self._limit), 1)
        retry = FAST_RETRY if self._are_bursty else RETRY
        self._again_at = self._now + min(retry * 2**self._failures, LONGEST_RETRY)
        self._failures += 1

    def _is_lossier(self, came: int, passed: int) -> bool:
        """Whether more was lost in this window than is lost on this link anyway."""
        if not passed or not self._passed:
            return False
        before = 1 - self._came / self._passed
        rise = 1 - came / passed - before
        pooled = 1 - (came + self._came) / (passed + self._passed)
        deviation = math.sqrt(pooled * (1 - pooled) * (1 / passed + 1 / self._passed))
        return rise > max(LOSSIER, UNLIKELY * deviation)


_NOTHING = Seen(0, 0, 0.0, False)
