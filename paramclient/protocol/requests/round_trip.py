"""Round-trip time, timeouts, packet loss, and the number of attempts of a request."""

from __future__ import annotations

import math
from typing import Final

__all__ = ["RoundTrip"]

INITIAL_TIMEOUT: Final = 1.0
"""The timeout in seconds before any measurement (RFC 6298, 2.1), for requests that must not be repeated
early."""
FIRST_TIMEOUT: Final = 0.25
"""The timeout in seconds before any measurement, for the first of several requests that may be repeated
freely; it doubles with each further one. On most links a lost first response then costs little more than a
round trip, and a link of 2.5 s carries four requests instead of one."""
GUESS_MARGIN: Final = 1.25
"""The timeout as a multiple of the longest round trip that a response is compatible with."""
TIMEOUT_MIN: Final = 0.1
"""The shortest timeout in seconds: ArduPilot answers reads in batches every 100 ms, PX4 once in its loop, so
an earlier retry gains nothing."""
SERVING_TIME: Final = 0.22
"""Seconds that are added to the timeout of the first reads, as the first samples may be of messages that are
answered at once: ArduPilot answers ten reads in two batches."""
TIMEOUT_MAX: Final = 4.0
"""The limit of backoff in seconds; a link with longer measured round trips gets the timeout that it needs."""
BACKOFF_TIMEOUTS_MIN: Final = 6
"""Timeouts in a row before backoff, at least."""
BACKOFF_TIMEOUTS_MAX: Final = 30
"""Timeouts in a row before backoff, at most."""
BACKOFF_RISK: Final = 1e-3
"""The probability below which packet loss no longer explains the timeouts in a row, which leads to
backoff."""
VARIATION_SAMPLES_MIN: Final = 8
"""Samples below which the variation is a guess: the timeout is then at most two round trips."""
GRANULARITY: Final = 0.02
"""Seconds by which a response may be late without a cause: PX4 handles its messages every 20 ms."""
LAST_REQUEST_SHARE: Final = 0.8
"""The share of the usual round trip after which a response may belong to the last request."""
ATTEMPTS_MIN: Final = 5
"""Attempts of a request before it is given up, at least."""
ATTEMPTS_MAX: Final = 60
"""Attempts of a request, at most: enough for a link that loses two of three exchanges."""
LOSS_SAMPLES_MIN: Final = 10
"""Responses and timeouts above which the loss is measured, and no longer assumed."""
SILENCE_MAX: Final = 20.0
"""Seconds of silence, without even the heartbeats of every second, after which a component counts as gone
that has received `ATTEMPTS_MIN` requests."""
_LOSS_RISK = 1e-6
SAMPLE_WEIGHT: Final = 0.98
"""The weight of earlier samples with each new one: about the last fifty count."""


class RoundTrip:
    """The round-trip estimate of RFC 6298 with Karn's rule, and the share of unanswered requests.

    There is one for each component, which all exchanges with it share. Samples come only from requests that
    were sent once. Many timeouts in a row without a sample, as when the round trip has become longer than the
    timeout, lead to backoff; packet loss alone does not.

    Attributes:
        smoothed: the smoothed round trip in seconds, or None before the first sample.
        shortest: the shortest sample in seconds; infinity before the first.
        variation: the variation of the round trip, in seconds.
        list_loss: the expected share of lost exchanges, by the losses of a list; 0 before a list.
        heard_at: when the last message of the component was received; its receiver keeps that up to date.
    """

    __slots__ = (
        "_answered",
        "_backoff",
        "_early_waits",
        "_guess",
        "_samples",
        "_silences",
        "_timeout",
        "_unanswered",
        "_was_answered",
        "heard_at",
        "list_loss",
        "shortest",
        "smoothed",
        "variation",
    )

    def __init__(self) -> None:
        self.heard_at = math.inf
        self.list_loss = 0.0
        self.smoothed: float | None = None
        self.shortest = math.inf
        self.variation = 0.0
        self._backoff = 1.0
        self._samples = 0
        self._silences = 0  # timeouts since the last sample
        self._answered = 0.0
        self._unanswered = 0.0
        self._was_answered = False
        self._timeout: float | None = None
        self._guess = math.inf  # the longest possible round trip, before a sample
        self._early_waits: list[float] = []  # the timeouts of requests before that

    @property
    def is_guessed(self) -> bool:
        """Whether all responses so far were to repeated requests, so that nothing is measured.

        The round trip then exceeds the first timeout, or the packet loss is high.
        """
        return self.smoothed is None and self._was_answered

    @property
    def timeout(self) -> float:
        """The timeout in seconds. Read often, so it is computed once."""
        if self._timeout is None:
            self._timeout = self._wait(0.0 if self.smoothed is None else self.smoothed + SERVING_TIME)
        return self._timeout

    @property
    def prompt_timeout(self) -> float:
        """The timeout in seconds of requests that are answered at once, or in the vehicle's next loop."""
        return self._wait(0.0)

    def read_timeout(self, attempts: int) -> float:
        """Return the timeout in seconds of a read, which the vehicle may serve in batches.

        Args:
            attempts: how often the request was sent.
        """
        return self.repeat_timeout(attempts) if self.smoothed is None else self.timeout

    def repeat_timeout(self, attempts: int) -> float:
        """Return the timeout in seconds of a request that may be repeated freely.

        After the first sample that is `prompt_timeout`. Before, it starts at `FIRST_TIMEOUT` and doubles up
        to `TIMEOUT_MAX`, or up to the longest round trip that the responses are compatible with.

        Args:
            attempts: how often the request was sent.
        """
        if self.smoothed is not None:
            return self.prompt_timeout
        longest = 0.0 if self._guess == math.inf else GUESS_MARGIN * self._guess
        first = min(max(FIRST_TIMEOUT, longest), TIMEOUT_MAX)
        return min(first * 2.0 ** (attempts - 1), max(TIMEOUT_MAX, longest))

    def _wait(self, least_at_first: float) -> float:
        base = (
            INITIAL_TIMEOUT if self.smoothed is None else self.smoothed + max(4 * self.variation, GRANULARITY)
        )
        if self._samples < VARIATION_SAMPLES_MIN and self.smoothed is not None:
            base = max(min(base, 2 * self.smoothed), least_at_first)
        base = max(base, TIMEOUT_MIN)
        return min(base * self._backoff, max(TIMEOUT_MAX, base))

    @property
    def loss(self) -> float:
        """The share of unanswered requests, lost in either direction; 0.1 at first."""
        return (self._unanswered + 0.2) / (self._unanswered + self._answered + 2.0)

    @property
    def seen_loss(self) -> float:
        """The observed share of unanswered requests: 0 while all were answered.

        Before enough requests were answered, the losses of a list count as well. Before the first sample, a
        request that was unanswered after `FIRST_TIMEOUT` only is no sign of loss.
        """
        bound = min(self._guess, FIRST_TIMEOUT)
        unanswered = max(self._unanswered - sum(wait <= bound for wait in self._early_waits), 0.0)
        seen = unanswered + self._answered
        measured = unanswered / (seen + 1.0)
        return max(measured, self.list_loss) if seen < LOSS_SAMPLES_MIN else measured

    def copies(self, risk: float, most: int) -> int:
        """Return how many requests at once bring the probability of no response below a risk; 1 without
        loss."""
        loss = self.seen_loss
        return 1 if loss < risk else min(math.ceil(math.log(risk) / math.log(loss)), most)

    @property
    def feared_loss(self) -> float:
        """The highest share of unanswered requests that the observations allow."""
        seen = self._unanswered + self._answered + 2.0
        loss = self.loss
        return min(loss + 2 * math.sqrt(loss * (1 - loss) / seen), 0.99) if seen > LOSS_SAMPLES_MIN else loss

    @property
    def tries(self) -> int:
        """Attempts after which packet loss no longer explains silence on this link (one in a million)."""
        return min(
            max(math.ceil(math.log(_LOSS_RISK) / math.log(self.feared_loss)), ATTEMPTS_MIN),
            ATTEMPTS_MAX,
        )

    def is_hopeless(self, attempts: int, now: float) -> bool:
        """Return whether a request was repeated often enough: `tries` times, or the component is gone."""
        is_gone = now - self.heard_at >= SILENCE_MAX
        return attempts >= self.tries or (is_gone and attempts >= ATTEMPTS_MIN)

    def answered(self, sent_at: float, now: float, attempts: int) -> None:
        """Record a response to a request that was sent `attempts` times, the last time at `sent_at`.

        An infinite `sent_at`, as after an outage, tells nothing of the round trip.
        """
        self._was_answered = True
        self._timeout = None
        if attempts <= 2:
            self._answered = self._answered * SAMPLE_WEIGHT + 1
            self._unanswered *= SAMPLE_WEIGHT
        sample = now - sent_at
        if attempts != 1 or not math.isfinite(sample):
            if self.smoothed is None and math.isfinite(sample):
                # a response to the first of them at the earliest
                waits = (min(FIRST_TIMEOUT * 2.0**nth, TIMEOUT_MAX) for nth in range(attempts - 1))
                self._guess = min(self._guess, sample + sum(waits))
            if sample >= LAST_REQUEST_SHARE * (self.smoothed or math.inf):
                # probably a response to the last of them
                self._silences = 0
                self._backoff = max(self._backoff / 2, 1.0)
            return
        if self.smoothed is None:
            self.smoothed = sample
            self.variation = sample / 2
        else:
            self.variation += (abs(self.smoothed - sample) - self.variation) / 4
            self.smoothed += (sample - self.smoothed) / 8
        self.shortest = min(self.shortest, sample)
        self._backoff = 1.0
        self._silences = 0
        self._samples += 1
        if self._early_waits:
            self._forgive_early_repeats()

    def timed_out(self, attempts: int) -> None:
        """Record a timeout after this many attempts.

        From the third attempt on, neither a timeout nor a response counts for the loss: a request that is
        silent that long may have no response at all.
        """
        self._timeout = None
        if attempts <= 2:
            if self.smoothed is None:
                self._early_waits.append(self.repeat_timeout(attempts))
            self._unanswered = self._unanswered * SAMPLE_WEIGHT + 1
            self._answered *= SAMPLE_WEIGHT
        self._silences += 1
        likely = math.log(BACKOFF_RISK) / math.log(self.loss)
        if self._silences >= min(max(likely, BACKOFF_TIMEOUTS_MIN), BACKOFF_TIMEOUTS_MAX):
            self._silences = 0
            self._backoff = min(self._backoff * 2, TIMEOUT_MAX / TIMEOUT_MIN)

    def _forgive_early_repeats(self) -> None:
        """Remove timeouts shorter than the round trip from the loss: it is known now, and they lost
        nothing."""
        early = sum(wait < self.prompt_timeout for wait in self._early_waits)
        self._unanswered = max(self._unanswered - early, 0.0)
        self._early_waits.clear()
