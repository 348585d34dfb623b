"""The measured round-trip time and packet loss of the exchanges with one component."""

from __future__ import annotations

import math
from typing import Final

__all__ = ["SAMPLE_WEIGHT", "RoundTrip"]

LOSS_SAMPLES_MIN: Final = 10
"""Responses and timeouts above which the loss is measured, and no longer assumed."""
SAMPLE_WEIGHT: Final = 0.98
"""The weight of earlier samples with each new one: about the last fifty count."""


class RoundTrip:
    """The round-trip estimate of RFC 6298 with Karn's rule, and the share of unanswered requests.

    There is one for each component, which all exchanges with it share. `RetryPolicy` feeds it and decides by
    it: nothing here says when a request counts as lost. Samples are taken only from requests that were sent
        once.

    Args:
        first_timeout: the shortest timeout in seconds before the first sample. A request that was silent for
            no longer is no sign of loss.

    Attributes:
        smoothed: the smoothed round trip in seconds, or None before the first sample.
        shortest: the shortest sample in seconds; infinity before the first.
        variation: the variation of the round trip, in seconds.
        samples: the number of samples.
        response_time: seconds from the last read that was answered without a timeout to its response. It is
            also known where copies of the read were sent at once, so that the response is no sample.
        responses: the number of such reads.
        longest: the longest round trip in seconds that the responses to repeated requests are compatible
            with; infinity without any.
        list_loss: the expected share of lost exchanges, by the losses of a list; 0 before a list.
        received_at: when the last message of the component was received; its receiver keeps that up to date.
    """

    __slots__ = (
        "_answered",
        "_early_waits",
        "_first_timeout",
        "_unanswered",
        "list_loss",
        "longest",
        "received_at",
        "response_time",
        "responses",
        "samples",
        "shortest",
        "smoothed",
        "variation",
    )

    def __init__(self, first_timeout: float = 0.0) -> None:
        self.received_at = math.inf
        self.list_loss = 0.0
        self.smoothed: float | None = None
        self.shortest = math.inf
        self.longest = math.inf
        self.variation = 0.0
        self.samples = 0
        self.response_time = 0.0
        self.responses = 0
        self._answered = 0.0
        self._unanswered = 0.0
        self._first_timeout = first_timeout
        self._early_waits: list[float] = []  # the timeouts of requests before the first sample

    @property
    def loss(self) -> float:
        """The share of unanswered requests, lost in either direction; 0.1 at first."""
        return (self._unanswered + 0.2) / (self._unanswered + self._answered + 2.0)

    @property
    def seen_loss(self) -> float:
        """The observed share of unanswered requests: 0 while all were answered.

        Before enough requests were answered, the losses of a list count as well. Before the first sample, a
        request that was unanswered after the shortest timeout only is no sign of loss.
        """
        bound = min(self.longest, self._first_timeout)
        unanswered = max(self._unanswered - sum(wait <= bound for wait in self._early_waits), 0.0)
        seen = unanswered + self._answered
        measured = unanswered / (seen + 1.0)
        return max(measured, self.list_loss) if seen < LOSS_SAMPLES_MIN else measured

    @property
    def feared_loss(self) -> float:
        """The highest share of unanswered requests that the observations allow."""
        seen = self._unanswered + self._answered + 2.0
        loss = self.loss
        return min(loss + 2 * math.sqrt(loss * (1 - loss) / seen), 0.99) if seen > LOSS_SAMPLES_MIN else loss

    def count_answered(self) -> None:
        """Count a response for the loss."""
        self._answered = self._answered * SAMPLE_WEIGHT + 1
        self._unanswered *= SAMPLE_WEIGHT

    def count_unanswered(self, waited: float) -> None:
        """Count a timeout of this many seconds for the loss."""
        if self.smoothed is None:
            self._early_waits.append(waited)
        self._unanswered = self._unanswered * SAMPLE_WEIGHT + 1
        self._answered *= SAMPLE_WEIGHT

    def bound(self, longest: float) -> None:
        """Record that a response arrived at most this many seconds after its request, which was repeated."""
        if self.smoothed is None:
            self.longest = min(self.longest, longest)

    def measure(self, sample: float) -> None:
        """Record the round trip of a request that was sent once, in seconds."""
        if self.smoothed is None:
            self.smoothed = sample
            self.variation = sample / 2
        else:
            self.variation += (abs(self.smoothed - sample) - self.variation) / 4
            self.smoothed += (sample - self.smoothed) / 8
        self.shortest = min(self.shortest, sample)
        self.samples += 1

    def note_response(self, seconds: float) -> None:
        """Record the time to the response of a read that had no timeout."""
        self.response_time = seconds
        self.responses += 1

    def forgive_early_timeouts(self, timeout: float) -> None:
        """Remove timeouts shorter than this one, in seconds, from the loss: the round trip is known now, and
        they lost nothing."""
        if self._early_waits:
            early = sum(wait < timeout for wait in self._early_waits)
            self._unanswered = max(self._unanswered - early, 0.0)
            self._early_waits.clear()
