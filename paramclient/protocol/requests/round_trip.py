"""What a component's answers tell of its link: the round trip, and how many tries an answer is worth."""

from __future__ import annotations

import math
from typing import Final

__all__ = ["RoundTrip"]

INITIAL_TIMEOUT: Final = 1.0
"""Seconds before anything was measured (RFC 6298, 2.1), for requests that must not be repeated too early."""
FIRST_TIMEOUT: Final = 0.25
"""Seconds before anything was measured, for the first of several requests that may be repeated at will; each
further one waits twice as long. On most links a lost first answer then costs little more than a round trip,
and a link of 2.5 s sees four requests in the place of one."""
GUESS_MARGIN: Final = 1.25
"""How many times longer than the longest round trip that an answer allows its timeout is."""
SHORTEST_TIMEOUT: Final = 0.1
"""ArduPilot answers reads in batches every 100 ms, PX4 once in its loop: asking sooner gains nothing."""
SERVING_TIME: Final = 0.22
"""Seconds that the first reads get beyond the first samples, which may be of what is answered at once:
ArduPilot answers ten reads in two batches."""
LONGEST_TIMEOUT: Final = 4.0
"""To which backing off leads; a link that is measured to be slower than that gets what it needs."""
FEWEST_SILENCES: Final = 6
MOST_SILENCES: Final = 30
UNEXPLAINED: Final = 1e-3
"""Time-outs in a row that lead to backing off: as many as loss alone explains with this chance."""
FEW_SAMPLES: Final = 8
"""Samples below which the variation is a guess: the time-out is then at most two round trips."""
GRANULARITY: Final = 0.02
"""Seconds that an answer may come later than usual for no reason: PX4 looks at its messages every 20 ms."""
LIKELY: Final = 0.8
"""The share of the usual round trip after which an answer may belong to the request that was sent last."""
FEWEST_TRIES: Final = 5
MOST_TRIES: Final = 60
"""Enough for a link that loses two exchanges of three."""
ENOUGH_SEEN: Final = 10
"""Answers and silences beyond which the share of the silences is measured, and no longer guessed."""
LONGEST_SILENCE: Final = 20.0
"""Seconds without a word, not even one of the heartbeats that come every second, after which a component that
was asked `FEWEST_TRIES` times counts as gone."""
_CHANCE_OF_BAD_LUCK = 1e-6
MEMORY: Final = 0.98
"""Weight that older answers keep with each new one: about the last fifty count."""


class RoundTrip:
    """The round-trip estimate of RFC 6298 with Karn's rule, and the share of requests that stay unanswered.

    One stands for one component, and every exchange with it feeds the same one. Samples come only from
    requests that were sent once. When many in a row time out and no sample comes, as happens when the round
    trip has become longer than the time-out, that backs off; a link that merely loses much keeps it.

    Attributes:
        smoothed: the smoothed round trip in seconds, or None before the first sample.
        shortest: the shortest sample in seconds; infinity before the first one.
        variation: how much it varies, in seconds.
        list_loss: the share of exchanges that would be lost, by what a list has lost; 0 before one came.
        heard_at: when anything at all came from the component last; its receiver keeps that up to date.
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
        self._silences = 0  # time-outs since the last sample
        self._answered = 0.0
        self._unanswered = 0.0
        self._was_answered = False
        self._timeout: float | None = None
        self._guess = math.inf  # the longest round trip that the answers allow, before one was measured
        self._early_waits: list[float] = []  # after which requests timed out before that

    @property
    def is_guessed(self) -> bool:
        """Whether answers have come, but only to what was asked for repeatedly, so that nothing is measured.

        The way is then longer than the first time-out, or much is lost on it.
        """
        return self.smoothed is None and self._was_answered

    @property
    def timeout(self) -> float:
        """Seconds to wait for an answer before asking again. Asked often, so it is worked out once."""
        if self._timeout is None:
            self._timeout = self._wait(0.0 if self.smoothed is None else self.smoothed + SERVING_TIME)
        return self._timeout

    @property
    def prompt_timeout(self) -> float:
        """The same for what is answered at once, or as soon as the vehicle looks at it."""
        return self._wait(0.0)

    def read_timeout(self, attempts: int) -> float:
        """Seconds to wait for the answer to a read, which the vehicle may serve in batches.

        Args:
            attempts: how often the request was sent.
        """
        return self.repeat_timeout(attempts) if self.smoothed is None else self.timeout

    def repeat_timeout(self, attempts: int) -> float:
        """Seconds to wait for the answer to a request that may be repeated at will.

        Once the round trip is measured that is `prompt_timeout`. Before, it starts at `FIRST_TIMEOUT` and
        doubles up to `LONGEST_TIMEOUT`, or as far as the longest round trip that the answers allow.

        Args:
            attempts: how often the request was sent.
        """
        if self.smoothed is not None:
            return self.prompt_timeout
        longest = 0.0 if self._guess == math.inf else GUESS_MARGIN * self._guess
        first = min(max(FIRST_TIMEOUT, longest), LONGEST_TIMEOUT)
        return min(first * 2.0 ** (attempts - 1), max(LONGEST_TIMEOUT, longest))

    def _wait(self, least_at_first: float) -> float:
        base = (
            INITIAL_TIMEOUT if self.smoothed is None else self.smoothed + max(4 * self.variation, GRANULARITY)
        )
        if self._samples < FEW_SAMPLES and self.smoothed is not None:
            base = max(min(base, 2 * self.smoothed), least_at_first)
        base = max(base, SHORTEST_TIMEOUT)
        return min(base * self._backoff, max(LONGEST_TIMEOUT, base))

    @property
    def loss(self) -> float:
        """The share of requests that stay unanswered, lost on the way there or back; a tenth at first."""
        return (self._unanswered + 0.2) / (self._unanswered + self._answered + 2.0)

    @property
    def seen_loss(self) -> float:
        """The same as far as it was seen: 0 as long as everything was answered.

        Before enough requests were answered, the losses of a list count as well. Before the round trip is
        measured, a request that was unanswered after `FIRST_TIMEOUT` only is no sign of loss.
        """
        bound = min(self._guess, FIRST_TIMEOUT)
        unanswered = max(self._unanswered - sum(wait <= bound for wait in self._early_waits), 0.0)
        seen = unanswered + self._answered
        measured = unanswered / (seen + 1.0)
        return max(measured, self.list_loss) if seen < ENOUGH_SEEN else measured

    def copies(self, risk: float, most: int) -> int:
        """How many requests at once bring the chance of no answer below a risk; one without loss."""
        loss = self.seen_loss
        return 1 if loss < risk else min(math.ceil(math.log(risk) / math.log(loss)), most)

    @property
    def feared_loss(self) -> float:
        """The same on a link that is as much worse than it looks as it may be, measured on few."""
        seen = self._unanswered + self._answered + 2.0
        loss = self.loss
        return min(loss + 2 * math.sqrt(loss * (1 - loss) / seen), 0.99) if seen > ENOUGH_SEEN else loss

    @property
    def tries(self) -> int:
        """How often to ask before silence can no longer be bad luck on this link (one in a million)."""
        return min(
            max(math.ceil(math.log(_CHANCE_OF_BAD_LUCK) / math.log(self.feared_loss)), FEWEST_TRIES),
            MOST_TRIES,
        )

    def is_hopeless(self, attempts: int, now: float) -> bool:
        """Whether something was asked for often enough: `tries` times, or the component is gone."""
        is_gone = now - self.heard_at >= LONGEST_SILENCE
        return attempts >= self.tries or (is_gone and attempts >= FEWEST_TRIES)

    def answered(self, sent_at: float, now: float, attempts: int) -> None:
        """A request got its answer; it had been sent `attempts` times, the last time at `sent_at`.

        Where that is infinite, as after an absence, nobody knows: it tells nothing of the round trip.
        """
        self._was_answered = True
        self._timeout = None
        if attempts <= 2:
            self._answered = self._answered * MEMORY + 1
            self._unanswered *= MEMORY
        sample = now - sent_at
        if attempts != 1 or not math.isfinite(sample):
            if self.smoothed is None and math.isfinite(sample):
                # it answers the first of them at the earliest
                waits = (min(FIRST_TIMEOUT * 2.0**nth, LONGEST_TIMEOUT) for nth in range(attempts - 1))
                self._guess = min(self._guess, sample + sum(waits))
            if sample >= LIKELY * (self.smoothed or math.inf):
                # it may well be the answer to the last of them
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
        """A request stayed unanswered for `timeout`, after so many attempts.

        From the third on neither this nor an answer counts into the loss: what stays silent that long may
        have no answer at all.
        """
        self._timeout = None
        if attempts <= 2:
            if self.smoothed is None:
                self._early_waits.append(self.repeat_timeout(attempts))
            self._unanswered = self._unanswered * MEMORY + 1
            self._answered *= MEMORY
        self._silences += 1
        likely = math.log(UNEXPLAINED) / math.log(self.loss)
        if self._silences >= min(max(likely, FEWEST_SILENCES), MOST_SILENCES):
            self._silences = 0
            self._backoff = min(self._backoff * 2, LONGEST_TIMEOUT / SHORTEST_TIMEOUT)

    def _forgive_early_repeats(self) -> None:
        """The round trip is known now: requests that were repeated before it had passed were not lost."""
        early = sum(wait < self.prompt_timeout for wait in self._early_waits)
        self._unanswered = max(self._unanswered - early, 0.0)
        self._early_waits.clear()
