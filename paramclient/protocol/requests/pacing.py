"""How fast a component may be asked: what it and its link serve, found out by trying."""

from __future__ import annotations

import math
from typing import Final

from paramclient.protocol.requests.round_trip import RoundTrip

__all__ = ["Pace", "Share"]

FIRST_RATE: Final = 50.0
"""Requests a second before anything is known: what ArduPilot serves, the slowest autopilot there is."""
LARGEST_RATE: Final = 2000.0
BATCHED_RATE: Final = 49.0
"""Requests a second that ArduPilot serves, however many are sent (measured). What is sent faster fills its
queue of 20, and is then dropped without a word."""
SMALLEST_RATE: Final = 4.0
SMALLEST_BURST: Final = 10.0
"""Requests that may go out at once: half of what ArduPilot queues."""
BURST_TIME: Final = 0.1
"""Seconds' worth of requests that may go out at once on a faster component."""
EPOCH: Final = 0.15
EPOCH_ANSWERS: Final = 8
"""Seconds and answers that one look at the component's speed takes, at the least."""
QUEUEING: Final = 0.12
"""Seconds by which answers may come later than the quickest one before that counts as a queue: ArduPilot
answers once in 100 ms."""
ENOUGH_SERVED: Final = 0.5
"""The share of the requests that must be answered for a rate to count as served."""
LOSS_MARGIN: Final = 0.1
"""By how much more exchanges may fail than the list's losses explain before that is the component's doing:
one that is asked too fast drops requests, and that must not pass for a bad link."""
LIST_READS: Final = 1 / 3
"""Requests for each value of its list with which a component is asked at first that does not serve reads in
batches: PX4 answers reads at once, whatever its list does (measured)."""
ROUNDING: Final = 1e-9
"""Of a token: without it, what `next_at` promises could be missed by the last bit of a float, for ever."""
ENOUGH_SERVED_LATE: Final = 0.8
LATE: Final = 1.3
"""The same where answers come later than the quickest one by this factor."""
UPSTREAM_SHARE: Final = 1 / 3
REQUEST_SIZE: Final = 16
VALUE_SIZE: Final = 37
"""Bytes of a PARAM_REQUEST_READ by index and of a PARAM_VALUE, in MAVLink 2."""


class Share:
    """What the reads of all components of one link may take of it together: a third of its rate.

    That is the rate at which their lists were seen to come, of those that ran beside each other the sum. It
    is divided evenly among the components that are asked for something.

    Attributes:
        each: requests a second that every one of them may send.
    """

    __slots__ = ("_askers", "_best", "_best_rate", "_came", "_sent", "_streams", "each")

    def __init__(self) -> None:
        self._askers: set[Pace] = set()
        self._streams: dict[Pace, tuple[float, float]] = {}
        self._best: set[Pace] = set()  # whose lists made the best rate there was
        self._best_rate = self._sent = self._came = 0.0  # the sums, as all of it is wanted for each request
        self.each = LARGEST_RATE

    def join(self, pace: Pace) -> None:
        """A component is asked for something."""
        self._askers.add(pace)
        self._divide()

    def leave(self, pace: Pace) -> None:
        """Nothing is asked of it any more."""
        self._askers.discard(pace)
        self._divide()

    def stream_seen(self, pace: Pace, rate: float, loss: float) -> None:
        """A component sends its list with so many values a second, of which a share is lost."""
        if pace in self._best:
            self._best.clear()  # of an earlier list of it
            self._best_rate = 0.0
        sent, came = self._streams.get(pace, (0.0, 0.0))
        self._streams[pace] = rate, rate * (1.0 - loss)
        self._sent += rate - sent
        self._came += rate * (1.0 - loss) - came
        self._divide()

    def stream_ended(self, pace: Pace) -> None:
        """Its list is over. What it has shown of the link counts on until it sends another."""
        if pace in self._streams:
            if self._rate() > self._best_rate:
                self._best_rate = self._rate()
                self._best = set(self._streams)
            sent, came = self._streams.pop(pace)
            self._sent = self._sent - sent if self._streams else 0.0
            self._came = self._came - came if self._streams else 0.0
            self._divide()

    def _rate(self) -> float:
        """Values a second of the lists that run: beside another one, lost values show no room on the link."""
        return self._sent if len(self._streams) == 1 else self._came

    def _divide(self) -> None:
        values = max(self._best_rate, self._rate())
        if values > 0.0:
            requests = values * VALUE_SIZE * UPSTREAM_SHARE / REQUEST_SIZE
            self.each = max(requests, SMALLEST_RATE) / max(len(self._askers), 1)


class Pace:
    """A token bucket whose rate follows what the component serves.

    As long as requests wait for their turn and answers come no later than before, the rate doubles with the
    first look and grows fourfold with each further one. When answers begin to queue up, or fewer come than
    should, it falls to what was answered, and from there on only creeps.
    It never takes more than the component's share of the link.

    Args:
        round_trip: the component's.
        share: the link's; None for a component that has the link for itself.

    Attributes:
        gap: seconds between two values of its list, as far as it was measured; 0 before.
        is_batched: whether it is known to serve reads as ArduPilot does, in batches and no faster than
            `BATCHED_RATE`. Then no higher rate is tried.
    """

    __slots__ = (
        "_answers",
        "_epoch_at",
        "_is_found",
        "_late",
        "_likely_loss",
        "_quickest",
        "_rate",
        "_round_trip",
        "_sent",
        "_share",
        "_timed",
        "_tokens",
        "_tokens_at",
        "_was_short",
        "gap",
        "is_batched",
    )

    def __init__(self, round_trip: RoundTrip, share: Share | None = None) -> None:
        self._round_trip = round_trip
        self._share = Share() if share is None else share
        self.gap = 0.0
        self.is_batched = False
        self._likely_loss = 1.0  # of exchanges, by what the list has lost
        self._rate = FIRST_RATE
        self._tokens = SMALLEST_BURST
        self._tokens_at = -math.inf
        self._epoch_at = math.inf
        self._answers = 0
        self._sent = 0
        self._timed = 0
        self._late = 0.0
        self._quickest = math.inf
        self._was_short = False
        self._is_found = False

    @property
    def rate(self) -> float:
        """Requests a second."""
        return min(self._rate, self._share.each, self._served)

    @property
    def _served(self) -> float:
        """Requests a second that it is known to serve, and those that are lost on the way to it."""
        if not self.is_batched:
            return math.inf
        return BATCHED_RATE / math.sqrt(1.0 - min(self._round_trip.seen_loss, 0.9))

    @property
    def quickest(self) -> float:
        """Seconds that the quickest answer has taken; 0 before the first one."""
        return self._quickest if self._quickest < math.inf else 0.0

    @property
    def prospect(self) -> float:
        """Requests a second that the next look may allow: what is served is not found yet."""
        if self._is_found or self.is_batched:
            return self.rate
        return min(self.rate * self._growth, self._share.each)

    @property
    def _growth(self) -> float:
        if self._is_found:
            return 1.1
        # at the first rate ArduPilot still keeps up; what serves twice that is of another kind
        return 2.0 if self._rate <= FIRST_RATE else 4.0

    @property
    def _burst(self) -> float:
        return max(self.rate * BURST_TIME, min(SMALLEST_BURST, self._share.each * BURST_TIME * 2), 1.0)

    def may_send(self, now: float, reserve: float = 0.0) -> bool:
        """Whether a request may go out now; with a reserve, whether that many more still could."""
        self._fill(now)
        if self._tokens >= 1.0 + reserve - ROUNDING:
            return True
        self._was_short = self._was_short or reserve == 0.0
        return False

    def next_at(self, reserve: float = 0.0) -> float:
        """When `may_send` will be true."""
        short = 1.0 + reserve - self._tokens
        return self._tokens_at + short / self.rate if short > 0 else self._tokens_at

    def sent(self, now: float, *, is_charged: bool = True) -> None:
        """A request went out.

        Args:
            now: the time.
            is_charged: whether it counts; not where it has waited for the answer to the one before.
        """
        self._fill(now)
        self._tokens -= is_charged
        self._sent += 1
        if self._epoch_at == math.inf:
            self._share.join(self)
            self._epoch_at = now + (self._round_trip.smoothed or 0.0)

    def answered(self, delay: float | None, now: float) -> None:
        """A request was answered, after `delay` seconds if it was sent only once."""
        if delay is not None:
            self._quickest = min(self._quickest, delay)
        if now < self._epoch_at:
            return
        self._answers += 1
        if delay is not None:
            self._late += delay
            self._timed += 1
        if self._answers >= EPOCH_ANSWERS and now - self._epoch_at >= EPOCH:
            self._look(now)

    def stream_seen(self, gap: float, loss: float = 0.0, gain: float = 1.0) -> None:
        """The list's stream brings a value every `gap` seconds, but for the share of them that is lost.

        The link is known to be so many times faster.
        """
        if gap > 0:
            self.gap = gap
            self._likely_loss = 1.0 - (1.0 - loss) ** 2 + LOSS_MARGIN
            if self._rate == FIRST_RATE and not self._is_found:
                self._rate = max(FIRST_RATE, LIST_READS / gap)
            self._share.stream_seen(self, gain / gap, loss)

    def stream_ended(self) -> None:
        """It brings no more."""
        self._share.stream_ended(self)

    def rest(self) -> None:
        """What was answered of late tells nothing: what is measured next begins anew."""
        self._begin_epoch(math.inf)

    def idle(self) -> None:
        """Nothing is asked for any more: what is measured next begins anew."""
        self._share.leave(self)
        self._begin_epoch(math.inf)

    def _begin_epoch(self, at: float) -> None:
        self._epoch_at = at
        self._answers = 0
        self._sent = 0
        self._timed = 0
        self._late = 0.0
        self._was_short = False

    def _look(self, now: float) -> None:
        elapsed = now - self._epoch_at
        served = self._answers / elapsed / (1.0 - min(self._round_trip.loss, self._likely_loss, 0.9))
        late = self._late / self._timed if self._timed else 0.0
        is_queueing = late > 1.25 * self._quickest + QUEUEING
        # few answers say little; that those which came were late as well says more
        enough = ENOUGH_SERVED_LATE if late > LATE * self._quickest else ENOUGH_SERVED
        expected = min(self._rate, self._sent / elapsed)  # it may have been asked for less
        if is_queueing or (self._was_short and served < enough * expected):
            self._rate = max(min(served, self._rate), FIRST_RATE)
            self._is_found = True
        elif self._was_short:
            self._rate = min(self._rate * self._growth, LARGEST_RATE)
        # what comes within the next round trip answers to the rate before
        self._begin_epoch(now + self._quickest)

    def _fill(self, now: float) -> None:
        if now > self._tokens_at:
            self._tokens = min(self._tokens + (now - self._tokens_at) * self.rate, self._burst)
            self._tokens_at = now
