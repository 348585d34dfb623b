"""Round trip and loss of one component's side of a link, and the timeouts and attempts that follow."""

from __future__ import annotations

import math
from typing import Final

__all__ = ["Timing"]

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


class Timing:
    """Round trip and loss, as measured by exchanges with one component.

    The timeout follows RFC 6298. Only exchanges without a repetition are measured (Karn's rule); before the
    first of these, a repeated one gives an upper bound.

    Attributes:
        round_trip: smoothed, in seconds; None before the first measurement.
        loss: share of attempts without an answer, counted when the exchange was answered at last: an
            unsupported request is no loss.
    """

    __slots__ = ("_is_bound", "_lost", "_sent", "_variation", "round_trip")

    def __init__(self) -> None:
        self.round_trip: float | None = None
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
