"""The retry policy: when a request counts as lost, how it is repeated, and when it is given up.

`RetryPolicy` has the timeouts of one component, by its measured round trip and packet loss. Each kind of
request has a section of its own, with its constants and a class that counts the attempts of one request, in
this order:

- All requests: `Attempts`, the rule that the others refine. A request is repeated after the measured timeout,
  and given up after 5 to 60 attempts, by the packet loss (`RetryPolicy.tries`), or after 5 attempts if
  nothing was received for 20 s.
- PARAM_SET: `WriteAttempts`. PARAM_EXT_SET: `ExtWriteAttempts`.
- COMMAND_LONG: `CommandAttempts`. MAV_CMD_REQUEST_MESSAGE: `MessageAttempts`, `VersionAttempts`.
- PARAM_REQUEST_READ, PARAM_EXT_REQUEST_READ: `ReadAttempts`, `ReadRetries`.
- PARAM_REQUEST_LIST: `ListAttempts`. PARAM_EXT_REQUEST_LIST: `ExtListAttempts`.
- MAVFTP: `FileAttempts`. The blocks of a file: `BurstAttempts`, `BlockRetries`. The parameter file:
  `OpenRetries`.
- Requests at fixed times, where no round trip is measured: `Schedule`. SYSTEM_TIME: `ClockSchedule`.

To change a retry rule, change this module. The senders of the requests ask it and have no rules of their own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Protocol

from paramclient.protocol.requests.round_trip import SAMPLE_WEIGHT, RoundTrip

__all__ = [
    "BASELINE_DELAY",
    "CLOCK_FOLLOW_DELAY",
    "COUNT_CHANGES_MAX",
    "EMPTY_LISTS_MAX",
    "FETCH_RESTARTS_MAX",
    "FILE_IN_USE_RETRY",
    "FILE_READS_MAX",
    "HEARTBEAT_REQUESTS",
    "LISTS_MAX",
    "LIST_REORDER_DEPTH",
    "LIST_SILENCE_MIN",
    "OPENS_MAX",
    "OVERTAKING_READS",
    "PEER_RECHECKS",
    "PEER_REQUESTS",
    "LIST_END_GAPS",
    "READS_BEHIND_BURST_COPIES_MAX",
    "REBOOT_IDENTITY_REQUESTS",
    "REOPENS_MAX",
    "SESSION_IDLE_TIME",
    "STREAM_PAUSE_MAX",
    "SUCCESSOR_REQUESTS",
    "Attempts",
    "BlockRetries",
    "BurstAttempts",
    "ClockSchedule",
    "CommandAttempts",
    "ExtListAttempts",
    "ExtWriteAttempts",
    "FileAttempts",
    "ListAttempts",
    "MessageAttempts",
    "OpenRetries",
    "ReadAttempts",
    "ReadRetries",
    "RetryPolicy",
    "Schedule",
    "VersionAttempts",
    "WriteAttempts",
]

# timeouts of all requests

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

# the end of all requests

ATTEMPTS_MIN: Final = 5
"""Attempts of a request before it is given up, at least."""
ATTEMPTS_MAX: Final = 60
"""Attempts of a request, at most: enough for a link that loses two of three exchanges."""
SILENCE_RISK: Final = 1e-6
"""The probability below which packet loss no longer explains unanswered attempts: they are then enough."""
SILENCE_MAX: Final = 20.0
"""Seconds of silence, without even the heartbeats of every second, after which a component counts as gone
that has received `ATTEMPTS_MIN` requests."""

# copies of all requests

COPY_RISK: Final = 0.01
"""The probability of no response below which early copies of a read or of a block bring it."""
LOSSY_LINK_LOSS: Final = 0.01
"""The share of unanswered requests above which each MAVFTP request is sent twice: servers send the same
response to the same request, so the copy costs only its few bytes."""


class RetryPolicy:
    """The timeouts of the requests to one component, the number of their attempts, and the end of both.

    There is one for each component. Many timeouts in a row without a sample, as when the round trip has
    become longer than the timeout, lead to backoff; packet loss alone does not.

    Attributes:
        round_trip: the measured round trip and packet loss.
    """

    __slots__ = ("_backoff", "_silences", "_timeout", "round_trip")

    def __init__(self) -> None:
        self.round_trip = RoundTrip(FIRST_TIMEOUT)
        self._backoff = 1.0
        self._silences = 0  # timeouts since the last sample
        self._timeout: float | None = None

    @property
    def timeout(self) -> float:
        """The timeout in seconds. Read often, so it is computed once."""
        if self._timeout is None:
            smoothed = self.round_trip.smoothed
            self._timeout = self._wait(0.0 if smoothed is None else smoothed + SERVING_TIME)
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
        return self.repeat_timeout(attempts) if self.round_trip.smoothed is None else self.timeout

    def repeat_timeout(self, attempts: int) -> float:
        """Return the timeout in seconds of a request that may be repeated freely.

        After the first sample that is `prompt_timeout`. Before, it starts at `FIRST_TIMEOUT` and doubles up
        to `TIMEOUT_MAX`, or up to the longest round trip that the responses are compatible with.

        Args:
            attempts: how often the request was sent.
        """
        if self.round_trip.smoothed is not None:
            return self.prompt_timeout
        bound = self.round_trip.longest
        longest = 0.0 if bound == math.inf else GUESS_MARGIN * bound
        first = min(max(FIRST_TIMEOUT, longest), TIMEOUT_MAX)
        return min(first * 2.0 ** (attempts - 1), max(TIMEOUT_MAX, longest))

    def _wait(self, min_before_variation: float) -> float:
        trip = self.round_trip
        smoothed = trip.smoothed
        base = INITIAL_TIMEOUT if smoothed is None else smoothed + max(4 * trip.variation, GRANULARITY)
        if trip.samples < VARIATION_SAMPLES_MIN and smoothed is not None:
            base = max(min(base, 2 * smoothed), min_before_variation)
        base = max(base, TIMEOUT_MIN)
        return min(base * self._backoff, max(TIMEOUT_MAX, base))

    def copies(self, risk: float, copies_max: int) -> int:
        """Return how many requests at once bring the probability of no response below a risk; 1 without
        loss."""
        loss = self.round_trip.seen_loss
        return 1 if loss < risk else min(math.ceil(math.log(risk) / math.log(loss)), copies_max)

    @property
    def is_lossy(self) -> bool:
        """Whether so many requests are lost that each MAVFTP request is sent twice."""
        return self.round_trip.seen_loss >= LOSSY_LINK_LOSS

    @property
    def tries(self) -> int:
        """Attempts after which packet loss no longer explains silence on this link (one in a million)."""
        return min(
            max(math.ceil(math.log(SILENCE_RISK) / math.log(self.round_trip.feared_loss)), ATTEMPTS_MIN),
            ATTEMPTS_MAX,
        )

    def is_silent_too_long(self, now: float) -> bool:
        """Return whether nothing at all of the component was received for `SILENCE_MAX`."""
        return now - self.round_trip.received_at >= SILENCE_MAX

    def should_give_up(self, attempts: int, now: float) -> bool:
        """Return whether a request was repeated often enough: `tries` times, or the component is gone."""
        return attempts >= self.tries or (self.is_silent_too_long(now) and attempts >= ATTEMPTS_MIN)

    def answered(self, sent_at: float, now: float, attempts: int) -> None:
        """Record a response to a request that was sent `attempts` times, the last time at `sent_at`.

        An infinite `sent_at`, as after an outage, shows nothing about the round trip.
        """
        trip = self.round_trip
        self._timeout = None
        if attempts <= 2:
            trip.count_answered()
        sample = now - sent_at
        if attempts != 1 or not math.isfinite(sample):
            if trip.smoothed is None and math.isfinite(sample):
                # a response to the first of them at the earliest
                waits = (min(FIRST_TIMEOUT * 2.0**nth, TIMEOUT_MAX) for nth in range(attempts - 1))
                trip.bound(sample + sum(waits))
            if sample >= LAST_REQUEST_SHARE * (trip.smoothed or math.inf):
                # probably a response to the last of them
                self._silences = 0
                self._backoff = max(self._backoff / 2, 1.0)
            return
        trip.measure(sample)
        self._backoff = 1.0
        self._silences = 0
        trip.forgive_early_timeouts(self.prompt_timeout)

    def timed_out(self, attempts: int) -> None:
        """Record a timeout after this many attempts.

        From the third attempt on, neither a timeout nor a response counts for the loss: a request that is
        silent that long may have no response at all.
        """
        self._timeout = None
        if attempts <= 2:
            self.round_trip.count_unanswered(self.repeat_timeout(attempts))
        self._silences += 1
        likely = math.log(BACKOFF_RISK) / math.log(self.round_trip.loss)
        if self._silences >= min(max(likely, BACKOFF_TIMEOUTS_MIN), BACKOFF_TIMEOUTS_MAX):
            self._silences = 0
            self._backoff = min(self._backoff * 2, TIMEOUT_MAX / TIMEOUT_MIN)


class Attempts:
    """The attempts of one request.

    Without a response it is repeated after `RetryPolicy.timeout`, until packet loss no longer explains the
    silence. The subclasses are the rules of other kinds of requests.

    Attributes:
        count: how often it was sent.
        sent_at: when it was sent last; infinity while it is not in flight.
    """

    __slots__ = ("_policy", "count", "sent_at")

    def __init__(self, policy: RetryPolicy) -> None:
        self._policy = policy
        self.count = 0
        self.sent_at = math.inf

    @property
    def timeout(self) -> float:
        """The seconds after which the present attempt counts as lost."""
        return self._policy.timeout

    @property
    def due_at(self) -> float:
        """When the present attempt counts as lost."""
        return self.sent_at + self.timeout

    def sent(self, now: float) -> None:
        """Count an attempt."""
        self.count += 1
        self.sent_at = now

    def uncount(self) -> None:
        """Take an attempt back: the link was down, and the request is sent again."""
        self.count -= 1

    def answered(self, now: float, *, is_sure: bool = True) -> None:
        """Record the response; it measures the round trip if it is sure to belong to a single attempt."""
        self._policy.answered(self.sent_at, now, self.count if is_sure else self.count + 1)

    def timed_out(self) -> None:
        """Record that the present attempt counts as lost."""
        self._policy.timed_out(self.count)

    def should_give_up(self, now: float) -> bool:
        """Return whether the request is to be given up instead of repeated."""
        return self._policy.should_give_up(self.count, now)


# PARAM_SET

UNAPPLIED_ATTEMPTS_MAX: Final = 2
"""Unanswered PARAM_SETs after which the value is read as well: the vehicle may be silent on this write
only."""
OLD_VALUE_DELAY_MIN: Final = 0.05
"""Seconds, at least, from another value than the written one until the value is read."""


class WriteAttempts(Attempts):
    """The attempts of one PARAM_SET."""

    __slots__ = ()

    @property
    def needs_read(self) -> bool:
        """Whether to read the value as well, after so many attempts."""
        return self.count > UNAPPLIED_ATTEMPTS_MAX

    @property
    def old_value_delay(self) -> float:
        """Seconds from another value than the written one until the value is read: an old response is at most
        about one round trip ahead of the valid one."""
        return max(self.timeout / 2, OLD_VALUE_DELAY_MIN)


# PARAM_EXT_SET

EXT_PROGRESS_TIMEOUT: Final = 10.0
"""Seconds for which PARAM_ACK_IN_PROGRESS is valid. The component sends the result without a request; only a
lost one needs another PARAM_EXT_SET, which a component at work answers with its state (MAVLink,
common.xml)."""
EXT_PROGRESS_TIMEOUT_LOSSY: Final = 2.0
"""The same in seconds on a link that loses packets, and so results."""


class ExtWriteAttempts(WriteAttempts):
    """The attempts of one PARAM_EXT_SET.

    Attributes:
        progress_at: when the component reported last that it works on the write, or None.
    """

    __slots__ = ("progress_at",)

    def __init__(self, policy: RetryPolicy) -> None:
        super().__init__(policy)
        self.progress_at: float | None = None

    @property
    def due_at(self) -> float:
        """When the attempt, or the result after a report of progress, counts as lost."""
        if self.progress_at is None:
            return self.sent_at + self.timeout
        is_lossy = self._policy.is_lossy
        return self.progress_at + (EXT_PROGRESS_TIMEOUT_LOSSY if is_lossy else EXT_PROGRESS_TIMEOUT)

    def sent(self, now: float) -> None:
        super().sent(now)
        self.progress_at = None

    def progressed(self, now: float, *, is_sure: bool) -> None:
        """Record a report of progress: the component has the request, so that earlier attempts do not
        count."""
        self.answered(now, is_sure=is_sure)
        self.progress_at = now
        self.count = min(self.count, 1)

    def answered(self, now: float, *, is_sure: bool = True) -> None:
        if self.progress_at is None:  # later acknowledgements are no response to the request
            super().answered(now, is_sure=is_sure)

    def timed_out(self) -> None:
        if self.progress_at is None:
            super().timed_out()


# COMMAND_LONG

PROGRESS_TIMEOUT: Final = 10.0
"""Seconds for which "in progress" is valid: a component repeats it while it works on a command, and then
reports the result (MAVLink guide, "Command Protocol": the timeout restarts with each)."""
REBOOT_COMMANDS_MAX: Final = 5
"""Unanswered reboot commands to a component that is heard all the time."""
SHUTDOWN_TIME_MAX: Final = 1.0
"""Seconds after a reboot command: a component that still sends heartbeats then has not executed it. PX4 goes
down 0.4 s after it has accepted, ArduPilot 0.2 s (their sources), and neither boots in so little time."""
FIRST_HEARTBEAT_GRACE: Final = 0.5
"""Seconds after such a heartbeat in which a clock may show that it was the first after a boot."""


class CommandAttempts(Attempts):
    """The attempts of one COMMAND_LONG.

    Attributes:
        repeats: whether it is repeated automatically while it is not acknowledged.
        progress_at: when the component reported last that it works on it, or None. It is then not repeated.
    """

    __slots__ = ("progress_at", "repeats")

    def __init__(self, policy: RetryPolicy, *, repeats: bool) -> None:
        super().__init__(policy)
        self.repeats = repeats
        self.progress_at: float | None = None

    @property
    def due_at(self) -> float:
        """When the attempt, or the report of progress, counts as lost."""
        if self.progress_at is not None:
            return self.progress_at + PROGRESS_TIMEOUT
        return self.sent_at + self.timeout if self.repeats else math.inf

    def answered(self, now: float, *, is_sure: bool = True) -> None:
        if self.progress_at is None:  # later acknowledgements are no response to the request
            super().answered(now, is_sure=is_sure)

    def timed_out(self) -> None:
        if self.progress_at is None:
            super().timed_out()

    def should_give_up(self, now: float) -> bool:
        return self.progress_at is not None or super().should_give_up(now)

    def reboot_due_at(self, beat_at: float) -> float:
        """Return when a reboot command counts as lost; infinity while it may be executed.

        Args:
            beat_at: when the component's last heartbeat was received.
        """
        if beat_at < self.sent_at + SHUTDOWN_TIME_MAX:
            return math.inf
        return max(beat_at + FIRST_HEARTBEAT_GRACE, self.sent_at + self.timeout)

    @property
    def is_reboot_hopeless(self) -> bool:
        """Whether a reboot command was sent often enough."""
        return self.count >= REBOOT_COMMANDS_MAX


# MAV_CMD_REQUEST_MESSAGE

VERSION_ATTEMPTS: Final = 4
"""Requests for AUTOPILOT_VERSION where nothing is known of the link, or after a refusal; many components
(cameras, radios) never send one."""
VERSION_DELAY: Final = 0.1
"""Seconds between the acknowledgement of the request and AUTOPILOT_VERSION; later, it counts as lost."""
DOUBT_TIME_MIN: Final = 5.0
"""Seconds, at least, of requests to a component that has sent it before: it may be booting."""
DOUBT_REQUEST_INTERVAL: Final = 1.0
"""Seconds between two requests after the usual number of them."""
LATER_REQUEST_INTERVAL: Final = 5.0
"""Seconds between two requests to a component that has sent its hardware id before and did not in that time,
while it is not lost: its radio may have received nothing. The same, at first, to an autopilot that has never
sent its version; the interval then doubles."""
LATER_REQUEST_INTERVAL_MAX: Final = 60.0
"""Seconds between two such requests to an autopilot that has never sent its version, at most: some have
none."""


class MessageAttempts(Attempts):
    """The attempts of one MAV_CMD_REQUEST_MESSAGE: for COMPONENT_METADATA, or by a rule of its own."""

    __slots__ = ()

    def denied(self, now: float) -> None:
        """Record a refusal."""

    def accepted(self, now: float) -> None:
        """Record an acknowledgement."""

    @property
    def is_denied(self) -> bool:
        """Whether the last request was refused, so that another command is to be used."""
        return False


class VersionAttempts(MessageAttempts):
    """The requests for AUTOPILOT_VERSION since the identity was open."""

    __slots__ = ("_denied_at", "_later_count", "_lost_at", "_until", "_was_blind")

    def __init__(self, policy: RetryPolicy) -> None:
        super().__init__(policy)
        self.sent_at = -math.inf
        self._later_count = 0  # requests after the usual ones
        self._was_blind = True  # whether the component had answered nothing when it was requested last
        self._until = -math.inf  # it is requested until then regardless of the number of requests
        self._denied_at = math.inf
        self._lost_at = math.inf  # when the acknowledged response counts as lost

    def restart(self) -> None:
        """Begin again: the identity is open."""
        self.count = self._later_count = 0

    def extend_requests(self, now: float) -> None:
        """Repeat the request for `DOUBT_TIME_MIN` at least."""
        self._until = now + DOUBT_TIME_MIN

    def sent(self, now: float) -> None:
        super().sent(now)
        self._note_sent()

    def sent_later(self, now: float) -> None:
        """Record a request after the usual ones, which is not counted."""
        self._later_count = 0 if self._has_link_answered else self._later_count + 1
        self.sent_at = now
        self._note_sent()

    def _note_sent(self) -> None:
        self._denied_at = self._lost_at = math.inf
        self._was_blind = self._policy.round_trip.smoothed is None

    @property
    def _has_link_answered(self) -> bool:
        """Whether the component has answered its first request of any kind since the last one of these."""
        return self._was_blind and self._policy.round_trip.smoothed is not None

    def denied(self, now: float) -> None:
        """Record a refusal: the other command is due at once."""
        self._denied_at = now

    def accepted(self, now: float) -> None:
        """Record an acknowledgement: the version follows at once, or was lost."""
        self._lost_at = min(self._lost_at, now + VERSION_DELAY)

    def timed_out(self) -> None:
        """Record nothing: a component that never sends its version says nothing of the link."""

    @property
    def is_denied(self) -> bool:
        return self._denied_at < math.inf

    @property
    def due_at(self) -> float:
        pause = self._policy.repeat_timeout(self.count)
        if self.count >= self._tries and self.sent_at < self._until:
            pause = max(pause, DOUBT_REQUEST_INTERVAL)
        return min(self._denied_at, self._lost_at, self.sent_at + pause)

    @property
    def later_at(self) -> float:
        """When to request it once more after the usual number of requests."""
        return self.sent_at + LATER_REQUEST_INTERVAL

    @property
    def first_later_at(self) -> float:
        """The same for an autopilot that has never sent it: all requests may have been lost before the link
        carried any, and it is due at once when the first response of any kind shows that it does now."""
        if self._has_link_answered:
            return self.sent_at
        return self.sent_at + min(LATER_REQUEST_INTERVAL * 2.0**self._later_count, LATER_REQUEST_INTERVAL_MAX)

    def should_give_up(self, now: float) -> bool:
        return self.count >= self._tries and now >= self._until

    @property
    def _tries(self) -> int:
        is_blind = self._policy.round_trip.smoothed is None or self.is_denied
        return VERSION_ATTEMPTS if is_blind else self._policy.tries


# PARAM_REQUEST_READ

READS_PER_BATCH: Final = 5
"""Reads that ArduPilot answers at once (measured)."""
BATCH_INTERVAL: Final = 0.1
"""Seconds from one such batch to the next (measured)."""
READ_COPIES_MAX: Final = 6
"""Early copies of one request, at most: further ones gain little and take bandwidth."""
COPY_TIMEOUTS_MAX: Final = 16
"""Timeouts in a row, without any response between them, after which early copies are of no use."""
TIMEOUTS_MAX: Final = 16
"""Timeouts in a row, over at least twice `SILENCE_MAX`, after which a component with heartbeats counts as
one that answers no reads: with two of three exchanges lost, this happens once in 650 times."""
UNCONTROLLED_ATTEMPTS_MAX: Final = 2
"""Attempts of a read without a control read, where something has announced the parameter; otherwise 1."""
LATE_CONTROL_TIMEOUTS: Final = 2
"""Timeouts after which a response may not belong to the control read: no read may be left to repeat it."""
CONTROLS_MIN: Final = 3
"""Answered control reads, at least, before a silent parameter counts as unknown."""
CONTROLS_CERTAIN: Final = 4
"""Answered control reads, at least, after which silence is due to the component and not to the link."""
LOSS_RISK: Final = 1e-6
"""The probability of mere packet loss, by the outcome of the control reads, below which a silent parameter
counts as unknown. Where many reads are silent, only control reads show the link's loss."""
DEAD_INDEX_RISK: Final = 1e-3
"""The probability of mere packet loss below which an index of a list is given up, by the reads answered while
it stayed silent."""


class ReadAttempts(Attempts):
    """The attempts of one PARAM_REQUEST_READ.

    Attributes:
        copies: requests sent on top of the last one before it had timed out.
        controls: reads of existing parameters that were answered while this one stayed silent.
        serving_time: seconds that the vehicle needs for the requests ahead of it; the timeout is no shorter.
    """

    __slots__ = ("controls", "copies", "serving_time")

    def __init__(self, policy: RetryPolicy) -> None:
        super().__init__(policy)
        self.copies = 0
        self.controls = 0
        self.serving_time = 0.0

    @property
    def timeout(self) -> float:
        return max(self._policy.read_timeout(self.count), self.serving_time)

    @property
    def is_measurable(self) -> bool:
        """Whether a response now is sure to belong to its only request."""
        return self.count + self.copies == 1 and self.sent_at < math.inf

    def sent(self, now: float) -> None:
        super().sent(now)
        self.copies = 0

    def answered(self, now: float, *, is_sure: bool = True) -> None:
        is_sure = is_sure and self.is_measurable
        if self.count == 1 and self.sent_at < math.inf:
            self._policy.round_trip.note_response(now - self.sent_at)
        self._policy.answered(self.sent_at, now, 1 if is_sure else self.count + 1)


class ReadRetries:
    """What all reads of one component show together: whether it answers reads at all, and what is unknown.

    Silence is not a response: a vehicle may be silent on a parameter that it does not have. The control reads
    of an existing index, which accompany silent reads, distinguish that from packet loss.
    """

    def __init__(self, policy: RetryPolicy) -> None:
        self._policy = policy
        self._silences = 0  # timeouts since the last response
        self._silent_since = math.inf  # the first request since then
        self._control = Attempts(policy)
        self._controls_sent = 0.0  # about the last fifty count
        self._controls_answered = 0.0

    def sent(self, now: float) -> None:
        """Record a request."""
        self._silent_since = min(self._silent_since, now)

    def reset_timeouts(self) -> None:
        """Reset the count of timeouts: there was a response, or the silence has another cause."""
        self._silences = 0
        self._silent_since = math.inf

    def resume(self) -> None:
        """Forget what was in flight: the link is back."""
        self._control.sent_at = self._silent_since = math.inf

    def timed_out(self, request: ReadAttempts, *, shows_loss: bool) -> None:
        """Record that a request counts as lost; `shows_loss` unless something else may bring its value."""
        self._silences += 1
        if shows_loss:
            request.timed_out()

    @staticmethod
    def serving_time(in_flight: int, quickest: float) -> float:
        """Return the seconds until a request sent now is answered, given the requests in flight.

        Requests that reach the vehicle are served in order: 12 in flight are served within three batches, and
        the first batch may be a whole interval away.

        Args:
            in_flight: the requests ahead of it.
            quickest: seconds of the fastest response.
        """
        batches = math.ceil(in_flight / READS_PER_BATCH)
        return (batches + 1) * BATCH_INTERVAL + quickest

    @property
    def copies(self) -> int:
        """Early copies of one request that are worthwhile; 0 without packet loss."""
        if self._silences >= COPY_TIMEOUTS_MAX:
            return 0
        return self._policy.copies(COPY_RISK, READ_COPIES_MAX + 1) - 1

    def needs_control(self, request: ReadAttempts, *, is_known: bool) -> bool:
        """Return whether a control read is to accompany the attempt.

        Args:
            request: the read.
            is_known: whether anything has announced the parameter.
        """
        return request.count > (UNCONTROLLED_ATTEMPTS_MAX if is_known else 1)

    @property
    def is_control_awaited(self) -> bool:
        """Whether a control read is in flight."""
        return self._control.sent_at < math.inf

    def may_send_control(self, now: float) -> bool:
        """Return whether to send a control read now, and count it: the one before it was answered or lost."""
        control = self._control
        if not self.is_control_awaited:
            control.count = 0
        elif now - control.sent_at < control.timeout:
            return False
        else:
            control.timed_out()
        control.sent(now)
        self._controls_sent = self._controls_sent * SAMPLE_WEIGHT + 1
        self._controls_answered *= SAMPLE_WEIGHT
        return True

    def control_answered(self, now: float, *, is_answer: bool) -> None:
        """Record the response to the control read; `is_answer` if it may belong to a read instead."""
        control = self._control
        is_late = now - control.sent_at > LATE_CONTROL_TIMEOUTS * control.timeout
        self._policy.answered(control.sent_at, now, control.count + is_late + is_answer)
        control.sent_at = math.inf
        self.reset_timeouts()

    def count_control(self, requests: Iterable[ReadAttempts]) -> None:
        """Count an answered control read for the requests that stayed silent meanwhile."""
        self._controls_answered += 1
        for request in requests:
            request.controls += request.count > 1

    def seems_unknown(self, request: ReadAttempts, *, is_known: bool) -> bool:
        """Return whether silence shows that there is no such parameter."""
        return request.controls >= CONTROLS_CERTAIN and not is_known

    def should_give_up(self, request: ReadAttempts, now: float, *, is_known: bool) -> bool:
        """Return whether a read is to be given up instead of repeated."""
        silent_for = now - self._silent_since
        has_no_answers = request.count >= ATTEMPTS_MIN and silent_for >= 2 * SILENCE_MAX
        if (self._silences >= ATTEMPTS_MAX and silent_for >= SILENCE_MAX) or (
            self._silences >= TIMEOUTS_MAX and has_no_answers
        ):
            return True  # none of all these was answered
        has_enough_controls = request.controls >= CONTROLS_MIN and request.count >= ATTEMPTS_MIN
        if has_enough_controls and self._loss_probability(request.count) < LOSS_RISK:
            return True
        # half as many are enough if nothing has announced the parameter and the link serves others
        weight = 2 if self.seems_unknown(request, is_known=is_known) else 1
        return self._policy.should_give_up(weight * request.count, now)

    def is_silent(self, now: float) -> bool:
        """Return whether all requests have been unanswered for so long, and so often, that more are
        pointless."""
        return self._silences >= self._policy.tries and now - self._silent_since >= SILENCE_MAX

    def _loss_probability(self, attempts: int) -> float:
        """Return the probability that so many reads in a row get lost, from the outcome of the control reads.

        Uses the rule of succession: ten answered of ten do not prove a link without loss, where so many reads
        are open that the luckiest ten and the unluckiest read coincide.
        """
        lost = self._controls_sent - self._controls_answered
        return math.prod(
            (lost + 1 + before) / (self._controls_sent + 2 + before) for before in range(attempts)
        )

    @staticmethod
    def is_dead_index(attempts: int, controls: int) -> bool:
        """Return whether an index is given up for the whole list.

        Args:
            attempts: requests for it.
            controls: answered control reads meanwhile.
        """
        answered = min(controls / max(attempts - 2, 1), 1.0)
        return (1.0 - answered) ** attempts < DEAD_INDEX_RISK


# PARAM_REQUEST_LIST

LIST_TIMEOUT: Final = 20.0
"""Seconds of silence after which PARAM_REQUEST_LIST counts as unanswered: longer than ArduPilot leaves it
unanswered after boot."""
LIST_DELAY: Final = 0.13
"""Seconds by which the first value of ArduPilot's list may be later than a short response (measured: up to
0.09 s). A repeated request meanwhile restarts the list."""
LIST_DELAY_FACTOR: Final = 3.0
"""How many times longer than for the first list the start of another one may take: reads, which wait for each
other, say less of that."""
LIST_RISK: Final = 0.05
"""The probability of no response below which copies bring a repeated request for the list. The first request
has no copy: PX4 would take it for a restart, and leave out its hash."""
LIST_COPIES_MAX: Final = 3
"""Requests for the list that are sent at once, at most."""
LIST_ATTEMPTS_MIN: Final = 12
"""Requests for the list, at least, before a component that is heard counts as silent: enough at high packet
loss."""
LIST_RETRY_INTERVAL_MAX: Final = 2.5
"""Seconds between two of them, at most, on a link with shorter round trips."""
LISTS_WITHOUT_BACKOFF: Final = 3
"""The first of them that follow without a longer backoff: they were lost rather than left unanswered."""
LISTS_MAX: Final = 20
"""Requests for the list: again when the count has changed, or when too much is missing for single reads."""
EMPTY_LISTS_MAX: Final = 3
"""Passes of the list in a row without a new value, after which only single reads are used."""
COUNT_CHANGES_MAX: Final = 8
"""Changes of the count that invalidate all values. A table that still changes is taken as it arrives."""
LIST_REORDER_DEPTH: Final = 3
"""Later values after which a missing one counts as lost, as in TCP's fast retransmit."""
LIST_SILENCE_MIN: Final = 0.25
"""Seconds without a value, at least, after which a list may be over, before its pace is known."""
LIST_END_GAPS: Final = 3.0
"""A list is over after a pause of this many of its longest gaps; a radio's pauses count among its gaps."""
SILENCE_AT_PACE_MIN: Final = 0.06
"""Seconds without a value after which a list may be over when its last values are due: PX4 sends every 20 ms,
ArduPilot every 10 ms."""
STREAM_PAUSE_MAX: Final = 0.5
"""Seconds without a value after which a list that is not near its end may be over: ArduPilot's pauses for up
to 0.4 s while it serves reads (measured)."""
TAIL_LENGTH: Final = 24
"""Final values that may all be lost: a list that is silent this close to its end is over, however many of its
values are lost."""


class ListAttempts(Attempts):
    """The requests for the list since its turn began, until its first value.

    Attributes:
        timeout_since: since when the component has had the time to answer.
        wait: seconds from the last request until it counts as lost; it grows with the requests.
    """

    __slots__ = ("timeout_since", "wait")

    def __init__(self, policy: RetryPolicy, now: float) -> None:
        super().__init__(policy)
        self.sent_at = self.timeout_since = now
        self.wait = 0.0

    @property
    def timeout(self) -> float:
        """The timeout in seconds of the present attempt, without backoff."""
        timeout = self._policy.repeat_timeout(self.count)
        return timeout if self._policy.round_trip.smoothed is None else timeout + LIST_DELAY

    @property
    def due_at(self) -> float:
        return self.sent_at + self.wait

    @property
    def copies(self) -> int:
        """The number of requests that are sent at once for a repeated attempt."""
        return self._policy.copies(LIST_RISK, LIST_COPIES_MAX)

    def restart(self) -> None:
        """Begin again: it is the list's turn."""
        self.count = 0
        self.wait = 0.0

    def sent(self, now: float) -> None:
        super().sent(now)
        growth = 2 if self.count > LISTS_WITHOUT_BACKOFF else 1
        self.wait = max(min(self.wait * growth, LIST_RETRY_INTERVAL_MAX), self.timeout)

    def was_sent(self) -> None:
        """Count the request that was sent before this object was made."""
        self.count = 1
        self.wait = self._policy.repeat_timeout(1) + LIST_DELAY

    def head_received(self, now: float) -> None:
        """Record that the head of the list was received: the values follow."""
        self.sent_at = now
        self.wait = max(self.wait, LIST_SILENCE_MIN)

    def resume(self, now: float) -> None:
        """Make the request due at once: the link is back."""
        self.sent_at = now - self.wait
        self.timeout_since = now

    def should_give_up(self, now: float) -> bool:
        is_enough = self._policy.is_silent_too_long(now) or self.count >= LIST_ATTEMPTS_MIN
        return is_enough and now - self.timeout_since >= LIST_TIMEOUT

    @staticmethod
    def later_timeout(first: float) -> float:
        """Return the seconds in which a later pass of the list begins at the latest.

        Args:
            first: seconds in which the first one has begun.
        """
        return LIST_DELAY_FACTOR * first

    @staticmethod
    def silence_before_end(timeout: float, left: int, longest: float | None) -> float:
        """Return the seconds without a value after which a list with values is over.

        Args:
            timeout: seconds after which it is over before its pace is known.
            left: the number of values behind its front.
            longest: the longest time between two values, in seconds; None before its pace is known.
        """
        is_near_end = left <= TAIL_LENGTH
        if longest is None:
            return max(LIST_SILENCE_MIN if is_near_end else STREAM_PAUSE_MAX, timeout)
        return max(LIST_END_GAPS * longest, SILENCE_AT_PACE_MIN if is_near_end else STREAM_PAUSE_MAX)


# PARAM_EXT_REQUEST_LIST

EXT_UNANSWERED_ATTEMPTS: Final = 6
"""Requests for the list to a component that has never sent an extended parameter: with half of the exchanges
lost, all of them are lost once in 60 times."""
EXT_LISTS_MAX: Final = 3
"""Requests for a list of extended parameters, after which missing ones are read singly."""
EXT_SINGLE_READS: Final = 16
"""Missing extended parameters that are read singly in any case: sooner done than another list."""
EXT_SINGLE_READS_SHARE: Final = 0.25
"""The same as a share of all."""


class ExtListAttempts(ListAttempts):
    """The requests for a list of extended parameters, until its first value.

    Most components have no extended parameters, and do not say so: a component that has never sent one is
    given up after a few attempts, and its silence shows nothing about the link. `ListAttempts` waits longer,
    for a vehicle that boots.

    Attributes:
        is_spoken: whether the component has sent an extended parameter.
    """

    __slots__ = ("is_spoken",)

    def __init__(self, policy: RetryPolicy, now: float, *, is_spoken: bool) -> None:
        super().__init__(policy, now)
        self.is_spoken = is_spoken

    def should_list_again(self, missing: int, count: int, lists: int) -> bool:
        """Return whether to request the list again rather than to read what it lacks.

        Args:
            missing: the number of missing parameters.
            count: the number of all parameters.
            lists: the number of lists so far.
        """
        return lists < EXT_LISTS_MAX and missing > max(EXT_SINGLE_READS, EXT_SINGLE_READS_SHARE * count)

    def should_give_up(self, now: float) -> bool:
        return super().should_give_up(now) if self.is_spoken else self.count >= EXT_UNANSWERED_ATTEMPTS

    def timed_out(self) -> None:
        if self.is_spoken:
            super().timed_out()


# MAVFTP requests

SESSION_IDLE_TIME: Final = 3.2
"""Seconds without a request to a server whose session is in use: ArduPilot ends a session 3 s after its last
response to any station, and the refusal of an open is such a response (measured)."""
BUSY_TIMEOUT: Final = 30.0
"""Seconds of waiting for the end of another station's session. Its transfer keeps the session open."""
OPEN_FAILURES_MAX: Final = 8
"""Failures of an open without a reason. ArduPilot says no more when the session is open already, as after an
open whose response was lost; it is then closed and opened again at once."""
OPEN_FAILURES_LOSSY_MAX: Final = 16
"""The same with packet loss: a lost close request, or one that arrives after the open, leaves the session
open."""
OPENS_MAX: Final = 3
"""Opens of a file whose session is lost on board."""
REOPENS_MAX: Final = 2
"""Times that a file is opened again when it is unknown whether it is open."""
CLOSE_ATTEMPTS: Final = 4
"""Close requests, or requests for the response to an open. The session of a server that is silent for that
long ends by its own timeout: ArduPilot after 3 s, PX4 after 10 s."""
CLOSE_COPIES_MAX: Final = 4
"""Copies of a close request on a lossy link: each has 12 bytes of payload."""
UNANSWERED_ATTEMPTS_MAX: Final = 16
"""Requests after which a server that has never responded counts as none: with two of three exchanges lost,
all of them are lost once in 700 times."""
UNANSWERED_ATTEMPTS_WITHOUT_BACKOFF: Final = 2
"""Requests without backoff to a server that has not responded yet."""
SLOW_ATTEMPTS_WITHOUT_BACKOFF: Final = 4
"""Requests without backoff on which the server works for long: the first ones may only be lost."""
SLOW_ATTEMPTS_MIN: Final = 9
"""Attempts of such a request before it is given up, at least: with the backoff some seconds, in which a small
board applies a file of parameters."""
SLOW_TIME_MAX: Final = 60.0
"""Seconds after which such a request is given up, however lossy the link is: no server works that long on a
file of parameters, and one that has died answers none of `ATTEMPTS_MAX` requests either."""
BACKOFF_DOUBLINGS_MAX: Final = 4
"""Doublings of the timeout after these."""


class Server(Protocol):
    """The part of a MAVFTP server that the retry policy uses."""

    @property
    def received_at(self) -> float:
        """When the server's last message to us was received; minus infinity before the first."""


class FileAttempts(Attempts):
    """The attempts of one MAVFTP request, except for single reads of a file's blocks.

    Many components have no server, and do not say so: a server that has never responded is given up after
    `UNANSWERED_ATTEMPTS_MAX` requests, and its silence shows nothing about the link.

    Args:
        policy: the component's.
        server: its server.
        is_slow: whether the server works on the request for long, which shows nothing about the link.
    """

    __slots__ = ("_begun_at", "_is_slow", "_server")

    def __init__(self, policy: RetryPolicy, server: Server, *, is_slow: bool = False) -> None:
        super().__init__(policy)
        self._server = server
        self._is_slow = is_slow
        self._begun_at = math.inf  # when it was sent first

    @property
    def timeout(self) -> float:
        policy = self._policy
        if self._is_slow:
            doublings = min(max(self.count - SLOW_ATTEMPTS_WITHOUT_BACKOFF, 0), BACKOFF_DOUBLINGS_MAX)
            return min(policy.timeout * 2.0**doublings, max(TIMEOUT_MAX, policy.timeout))
        timeout = policy.repeat_timeout(self.count)
        if self._is_unanswered and policy.round_trip.smoothed is not None:
            # the server may be busy with another station, whose burst nothing interrupts
            doublings = min(max(self.count - UNANSWERED_ATTEMPTS_WITHOUT_BACKOFF, 0), BACKOFF_DOUBLINGS_MAX)
            return min(timeout * 2.0**doublings, max(TIMEOUT_MAX, timeout))
        return timeout

    @property
    def due_at(self) -> float:
        # during a burst the server does nothing else
        since = min(max(self.sent_at, self._server.received_at), self.sent_at + SILENCE_MAX)
        return since + self.timeout

    @property
    def copies(self) -> int:
        """The number of requests that are sent at once."""
        return 2 if self._policy.is_lossy else 1

    @property
    def close_copies(self) -> int:
        """The same for a request to close a session."""
        return self._policy.copies(LOSSY_LINK_LOSS, CLOSE_COPIES_MAX)

    def answered(self, now: float, *, is_sure: bool = True) -> None:
        self._policy.answered(self.sent_at, now, 2 if self._is_slow else self.count)

    def sent(self, now: float) -> None:
        super().sent(now)
        self._begun_at = min(self._begun_at, now)

    def restart(self) -> None:
        """Begin again: the link is back."""
        self.count = 0
        self._begun_at = math.inf

    def await_open(self) -> None:
        """Count anew for a request to open a file whose response is only needed to close it."""
        self.count = min(self.count, 1)

    def timed_out(self) -> None:
        if not self._is_unanswered:
            super().timed_out()

    def should_give_up(self, now: float, *, yields: bool = False) -> bool:
        """See `Attempts.should_give_up`.

        Args:
            now: the time.
            yields: whether no caller waits, and the request is made again later.
        """
        if self._is_unanswered and not self._policy.is_silent_too_long(now):
            return self.count >= (UNANSWERED_OPENS_MAX if yields else UNANSWERED_ATTEMPTS_MAX)
        if self._is_slow and now - self._begun_at >= SLOW_TIME_MAX:
            return self.count >= ATTEMPTS_MIN
        if self._is_slow and self.count < SLOW_ATTEMPTS_MIN:
            return False
        return super().should_give_up(now)

    @property
    def _is_unanswered(self) -> bool:
        """Whether the server has never responded: nothing shows that there is one."""
        return self._server.received_at == -math.inf

    @property
    def is_close_hopeless(self) -> bool:
        """Whether a request was sent often enough whose only purpose is to close a session."""
        return self.count >= CLOSE_ATTEMPTS

    @property
    def open_failures_max(self) -> int:
        """Failures of an open without a reason, at most."""
        return OPEN_FAILURES_LOSSY_MAX if self._policy.is_lossy else OPEN_FAILURES_MAX

    @staticmethod
    def may_wait(busy_since: float, now: float) -> bool:
        """Return whether to wait for the end of another station's session."""
        return now - busy_since < BUSY_TIMEOUT


# blocks of a file over MAVFTP

BURST_DOUBLINGS_MAX: Final = 1
"""Doublings of the timeout of a burst."""
BURST_ATTEMPTS_WITHOUT_BACKOFF: Final = 2
"""Requests for a burst before its timeout doubles."""
FIRST_BLOCK_DELAY: Final = 0.7
"""Seconds by which the first block of a burst may be later than a short response: at 1,200 bytes/s it takes
0.22 s alone, and 0.67 s where the vehicle uses a third of that. After that a read is sent behind the burst:
its response, without a block before it, shows that the burst was lost."""
FIRST_BLOCK_ROUND_TRIPS: Final = 2.5
"""The same in round trips."""
BURST_SILENCE: Final = 0.5
"""Seconds without a message of the server after which a burst without a block is repeated. At 57600 baud its
first block arrives 0.1 s after the request, behind the banner (measured), and later behind telemetry.
ArduPilot ends no burst for another one: repeated meanwhile, the whole file is sent twice."""
SECOND_BLOCK_TIMEOUT: Final = 2.0
"""Seconds until the second block of a burst counts as late while the pace is unknown."""
SILENT_GAPS: Final = 6
"""Usual gaps of silence after which a burst is over, or its remaining blocks were lost."""
BURST_END_SILENCE_MIN: Final = 0.05
"""The same in seconds, at least."""
BURST_DELAY: Final = 0.03
"""Seconds by which the first block of a burst may be later than the response to a read that was sent behind
it: PX4 answers reads at once, and begins a burst up to 20 ms later (measured)."""
READS_BEHIND_BURST_COPIES_MAX: Final = 2
"""Reads that are sent behind a burst at once on a lossy link."""
OVERTAKING_READS: Final = 2
"""Answered later reads after which a read counts as lost."""
FILE_READ_COPIES_MAX: Final = 6
"""Early copies of one read, at most."""


class BurstAttempts(Attempts):
    """The requests for a burst since its last block.

    Args:
        policy: the component's.
        server: its server.
    """

    __slots__ = ("_server",)

    def __init__(self, policy: RetryPolicy, server: Server) -> None:
        super().__init__(policy)
        self._server = server

    def begins_by(self, opened_at: float | None) -> float:
        """Return when the first block is late.

        Args:
            opened_at: when the file was opened, if the burst was requested together with that.
        """
        smoothed = self._policy.round_trip.smoothed
        longer = min(FIRST_BLOCK_DELAY, FIRST_BLOCK_ROUND_TRIPS * (smoothed or FIRST_BLOCK_DELAY))
        if opened_at is not None:
            return opened_at + longer
        backoff = 2.0 ** min(max(self.count - BURST_ATTEMPTS_WITHOUT_BACKOFF, 0), BURST_DOUBLINGS_MAX)
        return self.sent_at + (self._policy.timeout + longer) * backoff

    def repeats_at(self, begins_by: float) -> float:
        """Return when a burst without a block is requested again.

        Args:
            begins_by: when the first block is late.
        """
        received_at = min(self._server.received_at, self.sent_at + SILENCE_MAX)
        return max(begins_by, max(self.sent_at, received_at) + BURST_SILENCE)

    def next_read_behind_at(self, read_at: float) -> float:
        """Return when another read is sent behind the burst, after the one at `read_at`."""
        return read_at + self._policy.prompt_timeout

    @staticmethod
    def overtaken_at(read_at: float) -> float:
        """Return when the burst counts as lost, whose read behind it was answered at `read_at`."""
        return read_at + BURST_DELAY

    @staticmethod
    def over_at(block_at: float, gap: float | None) -> float:
        """Return when the burst is over, or its remaining blocks were lost.

        Args:
            block_at: when the last block was received.
            gap: seconds between two blocks; None before they are known.
        """
        return block_at + (
            SECOND_BLOCK_TIMEOUT if gap is None else max(SILENT_GAPS * gap, BURST_END_SILENCE_MIN)
        )

    def answered(self, now: float, *, is_sure: bool = True) -> None:
        if self.count == 1:
            super().answered(now, is_sure=is_sure)

    def restart(self) -> None:
        """Count anew: a block was received, or the file was opened."""
        self.count = 0


class BlockRetries:
    """The single reads of the blocks of one file.

    Args:
        policy: the component's.
    """

    __slots__ = ("_policy",)

    def __init__(self, policy: RetryPolicy) -> None:
        self._policy = policy

    @property
    def may_burst_early(self) -> bool:
        """Whether to request the burst together with the open.

        Before the round trip is measured, a response may take several timeouts.
        """
        trip = self._policy.round_trip
        return trip.smoothed is None or trip.seen_loss < COPY_RISK

    def due_at(self, sent_at: float, ahead: int, gap: float) -> float:
        """Return when a read counts as lost.

        Args:
            sent_at: when it was sent.
            ahead: the number of reads ahead of it.
            gap: seconds that each takes.
        """
        return sent_at + self._policy.timeout + ahead * gap

    def answered(self, sent_at: float, now: float, *, is_sure: bool) -> None:
        """Record a response."""
        self._policy.answered(sent_at, now, 1 if is_sure else 2)

    def timed_out(self, attempts: int) -> None:
        """Record that a read counts as lost, after so many of its block."""
        self._policy.timed_out(attempts)

    def should_give_up(self, attempts: int, now: float, *, is_silence: bool) -> bool:
        """Return whether to give the file up.

        Args:
            attempts: unanswered reads of one block.
            now: the time.
            is_silence: whether the server has answered nothing since the read. Otherwise it is there, and the
                loss is higher than measured.
        """
        return attempts >= ATTEMPTS_MAX or (is_silence and self._policy.should_give_up(attempts, now))

    def copies(self, received: int, lost: int) -> int:
        """Return how many early copies of one read are worthwhile.

        Args:
            received: received blocks of bursts.
            lost: lost blocks of bursts.
        """
        passed = received / (received + lost) if received else 1.0
        loss = max(self._policy.round_trip.seen_loss, 1.0 - passed * passed)
        if loss < COPY_RISK:
            return 0
        return min(math.ceil(math.log(COPY_RISK) / math.log(loss)) - 1, FILE_READ_COPIES_MAX)


# the parameter file

FILE_READS_MAX: Final = 2
"""Reads of a parameter file that turns out to be invalid or stale: it is generated for each reader, and a gap
that is filled later may contain newer values of another length."""
FILE_OPEN_TIMEOUT: Final = 1.0
"""Seconds, at least, for which the opening of the file may stay unanswered before the list is requested as
well."""
FILE_OPEN_TIMEOUT_FACTOR: Final = 4.0
"""The same in timeouts of a request: on a slow link it is longer."""
FILE_OPEN_TIMEOUT_SILENT: Final = 2.0
"""The same in seconds where no request at all has been answered: until then four requests of each kind have
been sent."""
UNANSWERED_OPENS_MAX: Final = 5
"""Unanswered requests to open the file after which the component counts as one that serves no files."""
FILE_IN_USE_RETRY: Final = 5.0
"""Seconds until the next attempt of a check that was skipped because another station has a file open.
ArduPilot ends a session 3 s after its last reply to any station, so frequent attempts would keep an unused
session open."""
FETCH_RESTARTS_MAX: Final = 8
"""Times that a fetch starts over because the vehicle has rebooted or is another one; then it is given up."""


class OpenRetries:
    """The opening of the parameter file, as a fetch waits for it.

    Args:
        policy: the component's.
    """

    __slots__ = ("_policy",)

    def __init__(self, policy: RetryPolicy) -> None:
        self._policy = policy

    def list_due_at(self, requested_at: float) -> float:
        """Return when the list is requested as well, if the opening at `requested_at` stays unanswered."""
        if self._policy.round_trip.smoothed is None:
            return requested_at + FILE_OPEN_TIMEOUT_SILENT
        return requested_at + max(FILE_OPEN_TIMEOUT, FILE_OPEN_TIMEOUT_FACTOR * self._policy.prompt_timeout)

    @staticmethod
    def should_give_up(attempts: int) -> bool:
        """Return whether the component counts as one that serves no files."""
        return attempts >= UNANSWERED_OPENS_MAX


# requests at fixed times


@dataclass(frozen=True, slots=True)
class Schedule:
    """Requests at fixed times: no round trip is measured, or none would show when the response is due.

    Attributes:
        pauses: seconds after each request. The last one is the time for the response to the last request.
        later: seconds between further requests; infinity for none.
    """

    pauses: tuple[float, ...] = ()
    later: float = math.inf

    @property
    def count(self) -> int:
        """The number of requests, without the later ones."""
        return len(self.pauses)

    @property
    def duration(self) -> float:
        """Seconds of all of them."""
        return sum(self.pauses)

    def pause_after(self, requests: int) -> float:
        """Return the seconds until the next request, by the number of requests so far; 0 before the first."""
        if not requests:
            return 0.0
        return self.pauses[requests - 1] if requests < self.count else self.later

    def is_over(self, requests: int, sent_at: float, now: float) -> bool:
        """Return whether the last response is late.

        Args:
            requests: the number of requests so far.
            sent_at: when the last one was sent.
            now: the time.
        """
        is_last_late = requests == self.count and now >= sent_at + self.pauses[-1]
        return requests > self.count or is_last_late


HEARTBEAT_REQUESTS: Final = Schedule((0.25,) * 8, later=0.25)
"""Requests for the heartbeat of a vehicle that has sent other messages only: two heartbeats are due in the
2 s that they take. Further ones are sent while other vehicles are searched."""
PEER_REQUESTS: Final = Schedule((0.5, 1.0, 1.5, 2.0), later=5.0)
"""Identity requests to a further peer: 5 s in all, in which a radio with a round trip of 1 s and a packet
loss of one half responds in three of four cases. A peer that contests the address without a known difference
receives further ones, as its radio may have received nothing; not more often, as it may also be unrelated."""
PEER_RECHECKS: Final = Schedule(later=1.0)
"""Requests for the hardware id of a peer that has just sent two different ones."""
REBOOT_IDENTITY_REQUESTS: Final = Schedule(later=1.0)
"""Identity requests to a component that is back after a reboot."""
SUCCESSOR_REQUESTS: Final = Schedule(later=2.0)
"""Identity requests to a component that may be the searched one under another system id."""

# SYSTEM_TIME

BASELINE_DELAY: Final = 2.0
"""Seconds after the identification of a component until its clock is requested: a component with telemetry,
usually at least one message a second, has sent it by then."""
CLOCK_REQUEST_INTERVAL: Final = 0.25
"""Seconds between two requests at first. A booting ArduPilot acknowledges each, and sends SYSTEM_TIME when
its main loop runs (measured: 1.8 to 2.6 s after it went off)."""
CLOCK_FOLLOW_DELAY: Final = CLOCK_REQUEST_INTERVAL
"""Seconds from a reboot command to the first request: its acknowledgement arrives first."""
FAST_REQUESTS_TIME: Final = 6.0
"""Seconds for which requests are sent at that pace."""
SLOW_REQUEST_INTERVAL: Final = 1.0
"""Seconds between two requests after that, while a reboot on command is awaited, and between those for a
baseline. No caller waits for the baseline, and where 250 lists run at once, the responses are queued behind
the values."""


@dataclass(frozen=True, slots=True)
class ClockSchedule:
    """The requests for SYSTEM_TIME, by the time since the first one.

    Attributes:
        begun_at: when the first request is due.
        is_slow: whether all requests are slow: those for a baseline.
    """

    begun_at: float = -math.inf
    is_slow: bool = False

    def interval(self, now: float) -> float:
        """Return the seconds until the next request."""
        is_fast = not self.is_slow and self._is_early(now)
        return CLOCK_REQUEST_INTERVAL if is_fast else SLOW_REQUEST_INTERVAL

    def is_over(self, now: float) -> bool:
        """Return whether no further request is sent, unless a reboot is awaited."""
        return not self._is_early(now)

    def _is_early(self, now: float) -> bool:
        return now < self.begun_at + FAST_REQUESTS_TIME
