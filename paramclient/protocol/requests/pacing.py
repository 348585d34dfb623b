"""The rate limit of reads: adapts to what the component and its link serve."""

from __future__ import annotations

import math
from typing import Final

from paramclient.protocol.requests.round_trip import RoundTrip

__all__ = ["Pace", "LinkBandwidth"]

FIRST_RATE: Final = 50.0
"""Requests per second before any measurement: the rate of ArduPilot, the slowest autopilot."""
RATE_MAX: Final = 2000.0
"""Requests per second up to which the rate grows."""
BATCHED_RATE: Final = 49.0
"""Requests per second that ArduPilot serves, however many are sent (measured). Faster requests fill its queue
of 20, and are then dropped silently."""
RATE_MIN: Final = 4.0
"""Requests per second below which the rate does not fall."""
BURST_MIN: Final = 10.0
"""Requests that may be sent at once: half of what ArduPilot queues."""
BURST_TIME: Final = 0.1
"""Seconds of the rate that may be sent at once to a faster component."""
EPOCH_TIME: Final = 0.15
"""Seconds of one measurement of the component's rate, at least."""
EPOCH_RESPONSES: Final = 8
"""Responses in one measurement, at least."""
QUEUEING_DELAY: Final = 0.12
"""Seconds by which responses may be later than the fastest one before that counts as a queue: ArduPilot
responds every 100 ms."""
SERVED_SHARE_MIN: Final = 0.5
"""The share of requests that must be answered for a rate to count as served."""
LOSS_MARGIN: Final = 0.1
"""The share of exchanges that may fail on top of the list's losses before the component is the cause: too
fast a rate makes it drop requests, which must not pass for packet loss."""
READS_PER_LIST_VALUE: Final = 1 / 3
"""Requests for each value of its list at first, to a component that does not serve reads in batches: PX4
answers reads at once, also during its list (measured)."""
ROUNDING: Final = 1e-9
"""Tolerance in tokens: without it, `may_send` could stay false at the time of `next_at` by the last bit of a
float."""
SERVED_SHARE_LATE_MIN: Final = 0.8
"""The share of requests that must be answered where responses are late."""
LATE_FACTOR: Final = 1.3
"""The factor over the fastest response by which such responses are late."""
UPSTREAM_SHARE: Final = 1 / 3
"""The share of a link's rate that requests may use in their direction."""
REQUEST_SIZE: Final = 16
"""Bytes of a PARAM_REQUEST_READ by index, in MAVLink 2."""
VALUE_SIZE: Final = 37
"""Bytes of a PARAM_VALUE, in MAVLink 2."""


class LinkBandwidth:
    """The rate that the reads of all components of one link may use together: a third of the link's rate.

    The link's rate is that of the measured lists, and the sum of those that ran in parallel. It is divided
    evenly among the components with open requests.

    Attributes:
        each: requests per second for each of them.
    """

    __slots__ = ("_best", "_best_rate", "_paces", "_received", "_sent", "_streams", "each")

    def __init__(self) -> None:
        self._paces: set[Pace] = set()
        self._streams: dict[Pace, tuple[float, float]] = {}
        self._best: set[Pace] = set()  # with the lists of the best rate so far
        self._best_rate = self._sent = self._received = 0.0  # the sums, as each request uses all of it
        self.each = RATE_MAX

    def join(self, pace: Pace) -> None:
        """Add a component with open requests."""
        self._paces.add(pace)
        self._divide()

    def leave(self, pace: Pace) -> None:
        """Remove a component without open requests."""
        self._paces.discard(pace)
        self._divide()

    def stream_seen(self, pace: Pace, rate: float, loss: float) -> None:
        """Record that a component's list has this many values per second, with this share of them lost."""
        if pace in self._best:
            self._best.clear()  # from its earlier list
            self._best_rate = 0.0
        sent, received = self._streams.get(pace, (0.0, 0.0))
        self._streams[pace] = rate, rate * (1.0 - loss)
        self._sent += rate - sent
        self._received += rate * (1.0 - loss) - received
        self._divide()

    def stream_ended(self, pace: Pace) -> None:
        """Record the end of its list. Its measurements count until its next list."""
        if pace in self._streams:
            if self._rate() > self._best_rate:
                self._best_rate = self._rate()
                self._best = set(self._streams)
            sent, received = self._streams.pop(pace)
            self._sent = self._sent - sent if self._streams else 0.0
            self._received = self._received - received if self._streams else 0.0
            self._divide()

    def _rate(self) -> float:
        """Return the values per second of the running lists: in parallel ones, lost values show no free
        bandwidth."""
        return self._sent if len(self._streams) == 1 else self._received

    def _divide(self) -> None:
        values = max(self._best_rate, self._rate())
        if values > 0.0:
            requests = values * VALUE_SIZE * UPSTREAM_SHARE / REQUEST_SIZE
            self.each = max(requests, RATE_MIN) / max(len(self._paces), 1)


class Pace:
    """A token bucket whose rate follows what the component serves.

    While requests are queued and responses are not delayed, the rate doubles with the first measurement and
    grows fourfold with each further one. When responses are delayed, or fewer arrive than expected, it falls
    to the measured rate, and grows only slowly from then on. It never exceeds the component's share of the
    link.

    Args:
        round_trip: the component's.
        share: the link's; None for the only component of a link.

    Attributes:
        gap: seconds between two values of its list, as far as measured; 0 before.
        is_batched: whether it is known to serve reads like ArduPilot, in batches and no faster than
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

    def __init__(self, round_trip: RoundTrip, share: LinkBandwidth | None = None) -> None:
        self._round_trip = round_trip
        self._share = LinkBandwidth() if share is None else share
        self.gap = 0.0
        self.is_batched = False
        self._likely_loss = 1.0  # of exchanges, by the losses of the list
        self._rate = FIRST_RATE
        self._tokens = BURST_MIN
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
        """Requests per second."""
        return min(self._rate, self._share.each, self._served)

    @property
    def _served(self) -> float:
        """Requests per second that it is known to serve, plus the expected lost ones."""
        if not self.is_batched:
            return math.inf
        return BATCHED_RATE / math.sqrt(1.0 - min(self._round_trip.seen_loss, 0.9))

    @property
    def quickest(self) -> float:
        """Seconds of the fastest response; 0 before the first."""
        return self._quickest if self._quickest < math.inf else 0.0

    @property
    def prospect(self) -> float:
        """Requests per second that the next measurement may allow: the limit is not found yet."""
        if self._is_found or self.is_batched:
            return self.rate
        return min(self.rate * self._growth, self._share.each)

    @property
    def _growth(self) -> float:
        if self._is_found:
            return 1.1
        # ArduPilot still serves the first rate; a component that serves twice that is of another kind
        return 2.0 if self._rate <= FIRST_RATE else 4.0

    @property
    def _burst(self) -> float:
        return max(self.rate * BURST_TIME, min(BURST_MIN, self._share.each * BURST_TIME * 2), 1.0)

    def may_send(self, now: float, reserve: float = 0.0) -> bool:
        """Return whether a request may be sent now; with a reserve, whether that many more still could."""
        self._fill(now)
        if self._tokens >= 1.0 + reserve - ROUNDING:
            return True
        self._was_short = self._was_short or reserve == 0.0
        return False

    def next_at(self, reserve: float = 0.0) -> float:
        """Return when `may_send` becomes true."""
        short = 1.0 + reserve - self._tokens
        return self._tokens_at + short / self.rate if short > 0 else self._tokens_at

    def sent(self, now: float, *, is_charged: bool = True) -> None:
        """Record a sent request.

        Args:
            now: the time.
            is_charged: whether it uses a token; not if it was sent after the response to the one before.
        """
        self._fill(now)
        self._tokens -= is_charged
        self._sent += 1
        if self._epoch_at == math.inf:
            self._share.join(self)
            self._epoch_at = now + (self._round_trip.smoothed or 0.0)

    def answered(self, delay: float | None, now: float) -> None:
        """Record a response, after `delay` seconds if its request was sent only once."""
        if delay is not None:
            self._quickest = min(self._quickest, delay)
        if now < self._epoch_at:
            return
        self._answers += 1
        if delay is not None:
            self._late += delay
            self._timed += 1
        if self._answers >= EPOCH_RESPONSES and now - self._epoch_at >= EPOCH_TIME:
            self._look(now)

    def stream_seen(self, gap: float, loss: float = 0.0, gain: float = 1.0) -> None:
        """Record a value of the list every `gap` seconds, with this share of them lost.

        The link is `gain` times faster.
        """
        if gap > 0:
            self.gap = gap
            self._likely_loss = 1.0 - (1.0 - loss) ** 2 + LOSS_MARGIN
            if self._rate == FIRST_RATE and not self._is_found:
                self._rate = max(FIRST_RATE, READS_PER_LIST_VALUE / gap)
            self._share.stream_seen(self, gain / gap, loss)

    def stream_ended(self) -> None:
        """Record the end of the list."""
        self._share.stream_ended(self)

    def rest(self) -> None:
        """Discard the present measurement: recent responses show nothing."""
        self._begin_epoch(math.inf)

    def idle(self) -> None:
        """Discard the present measurement: no request is open."""
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
        is_queueing = late > 1.25 * self._quickest + QUEUEING_DELAY
        # a few responses say little; that these were late as well says more
        enough = SERVED_SHARE_LATE_MIN if late > LATE_FACTOR * self._quickest else SERVED_SHARE_MIN
        expected = min(self._rate, self._sent / elapsed)  # fewer may have been needed
        if is_queueing or (self._was_short and served < enough * expected):
            self._rate = max(min(served, self._rate), FIRST_RATE)
            self._is_found = True
        elif self._was_short:
            self._rate = min(self._rate * self._growth, RATE_MAX)
        # responses within the next round trip belong to the rate before
        self._begin_epoch(now + self._quickest)

    def _fill(self, now: float) -> None:
        if now > self._tokens_at:
            self._tokens = min(self._tokens + (now - self._tokens_at) * self.rate, self._burst)
            self._tokens_at = now
