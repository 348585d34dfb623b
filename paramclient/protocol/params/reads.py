"""One read: PARAM_REQUEST_READ until the answer or the end of patience. All reads share one pace."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Container
from typing import Final, Protocol, TypeAlias

from paramclient.errors import (
    NoReply,
    ParamErrorCode,
    Refused,
    TypeMismatch,
    UnknownParameter,
    VehicleError,
)
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.pacing import Pace, Share
from paramclient.protocol.requests.round_trip import (
    FEWEST_TRIES,
    LONGEST_SILENCE,
    MEMORY,
    MOST_TRIES,
)
from paramclient.protocol.wire import MOST_PARAMETERS, ParamError, ParamRequestRead, ParamValue

__all__ = ["Key", "Read", "Reads"]

Key: TypeAlias = str | int
"""What a read asks for: a name, or an index."""

CONTROL: Final = 0
"""The index that every component with parameters has, and that is asked for where none is known to answer."""
COPY_RESERVE: Final = 2.0
"""Requests that must remain possible when one is sent again early."""
COPY_RISK: Final = 0.01
"""The chance of no answer to go below by asking again early."""
MOST_COPIES: Final = 6
SILENCES_TO_SPARE: Final = 16
"""Time-outs in a row, with no answer at all between them, after which asking twice cannot be of help."""
SILENCES_TO_GIVE_UP: Final = 16
"""Time-outs in a row, in twice `LONGEST_SILENCE` at the least, after which a component that is heard is one
that answers no reads at all: where two exchanges of three are lost, it comes to that once in 650 times."""
FEWEST_CONTROLS: Final = 3
BAD_LUCK: Final = 1e-6
"""Answered controls, at the least, and the chance of bad luck below which a silence is the component's doing,
by the controls that were answered. Where much is silent, nothing else tells of the link."""
ENOUGH_CONTROLS: Final = 4
"""Answered controls, at the least, after which a silence is the component's and not the link's."""
READS_PER_BATCH: Final = 5
BATCH_INTERVAL: Final = 0.1
"""Reads that ArduPilot answers at once, and seconds from one such batch to the next (measured)."""


class Read(Operation[ParamValue]):
    """One PARAM_REQUEST_READ and its answer, shared by everyone who wants the same.

    Attributes:
        key: name or index.
        holders: how many want the answer; nobody any more: it is dropped.
        attempts: requests sent.
        copies: requests sent on top of the last one, before it had timed out.
        is_of_caller: whether somebody waits for it, and not only a fetch.
        controls: reads of something that exists which were answered while this one stayed silent.
        sent_at: when the last request was sent; infinity while none is awaited.
        serving_time: seconds that the vehicle needs for the requests ahead of it; its timeout is no shorter.
        ask_again_at: when the request is sent again, because the answer may be older than a set; else
            infinity.
    """

    def __init__(self, key: Key, begun_at: float) -> None:
        super().__init__(begun_at)
        self.key = key
        self.sent_at = math.inf
        self.serving_time = 0.0
        self.ask_again_at = math.inf
        self.attempts = 0
        self.copies = 0
        self.holders = 0
        self.is_of_caller = False
        self.controls = 0


class KnownParams(Protocol):
    """What reads need of a table, to tell a parameter that is unknown from an answer that was lost."""

    @property
    def params(self) -> Container[str]:
        """The names that are known."""

    @property
    def count(self) -> int | None:
        """The number of parameters in the list, None while it is unknown."""


class Reads(Machine):
    """Every read of one component: as fast as it serves them, single ones before a download's.

    Silence is not an answer: PX4 up to 1.17 and ArduPilot say nothing to what they do not have. What stays
    silent is therefore asked for together with an index that it has. When that
    keeps being answered, and a name that nobody has heard of or an index that is not below the count does
    not, the link is not the reason: the parameter is unknown.

    Args:
        context, table: the component's.
        share: what all reads of the link may take of it together; None for a link of its own.

    Attributes:
        pace: how fast requests may go out.
        asked, retries: reads so far, and requests that were sent for another time.
        answered_at: when a read, or the index asked for with it, was answered last.
        list_runs_again: set while a list comes for another time: then it may answer reads by index, and that
            tells nothing of the round trip.
        is_idle: false while a list comes: then nothing is asked for twice to save time.
        list_until: until when a list may still come that nobody follows any more.
        control: the index that is asked for to learn whether the component answers at all: one that is known
            to be there.
        sent_at: when a request was sent last.
    """

    def __init__(
        self,
        context: Context,
        table: KnownParams,
        share: Share | None = None,
    ) -> None:
        self._target = context.target
        self._round_trip = context.round_trip
        self._send = context.send
        self._table = table
        self._trace = context.trace
        self.asked = self.retries = 0
        self.pace = Pace(context.round_trip, share)
        self._open: dict[Key, Read] = {}
        self._flying: dict[Key, Read] = {}
        self._again: deque[Read] = deque()
        self._urgent: deque[Read] = deque()
        self._patient: deque[Read] = deque()
        self.answered_at = self.sent_at = -math.inf
        self.list_runs_again = False
        self.is_idle = True
        self._silences = 0  # time-outs since anything was answered
        self._silent_since = math.inf  # the first request since then
        self.list_until = -math.inf
        self.control = CONTROL
        self._control_at = math.inf
        self._control_index = CONTROL  # of the one under way
        self._control_attempts = 0
        self._controls_sent = 0.0  # the last fifty or so count
        self._controls_answered = 0.0

    def __len__(self) -> int:
        return len(self._open)

    def __contains__(self, key: Key) -> bool:
        return key in self._open

    def _is_known(self, key: Key) -> bool:
        """Whether anything speaks for such a parameter."""
        if isinstance(key, str):
            return key in self._table.params
        return self._table.count is None or key < self._table.count

    def awaits(self, message: ParamValue) -> bool:
        """Whether this is the answer to a read under way."""
        return message.param_id in self._open or message.param_index in self._open

    def ask(self, key: Key, now: float, *, urgent: bool = True) -> Read:
        """Want an answer; joins an open read of the same. Give it back with `release`."""
        read = self._open.get(key)
        if read is None:
            read = Read(key, now)
            self.asked += 1
            self._open[key] = read
            (self._urgent if urgent else self._patient).append(read)
        elif urgent and read in self._patient:
            self._patient.remove(read)
            self._urgent.append(read)
        read.holders += 1
        self._send_waiting(now, may_copy=False)  # others may be asked for at the same moment
        return read

    def release(self, read: Read) -> None:
        """Want it no longer. The last holder drops it."""
        read.holders -= 1
        if read.holders <= 0 and self._open.get(read.key) is read:
            self._drop(read)

    def heard(self, message: ParamValue, now: float) -> None:
        """Every PARAM_VALUE of the component passes here after it went into the table."""
        name, _, _, count, index = message
        wanted = self._open
        is_answer = False
        for read in (wanted.get(name), wanted.get(index)) if wanted else ():
            if read is None or wanted.get(read.key) is not read:
                continue
            if read.attempts:
                is_answer = True
                self._count_answer(read, now)
                self._trace(
                    "%s/%s %s: answered %.3f s after try %s",
                    *self._target,
                    read.key,
                    now - read.sent_at,
                    read.attempts,
                )
            self._drop(read)
            read.finish(message, now)
            self._send_waiting(now)
        self._hear_control(index, count, now, is_answer=is_answer)

    def defer(self, message: ParamValue, until: float, now: float) -> None:
        """Take an answer whose value may be older than a set: it ends no read; ask again at `until`."""
        is_answer = False
        for key in (message.param_id, message.param_index):
            read = self._flying.get(key)
            if read is not None and read.sent_at < math.inf:
                is_answer = True
                self._count_answer(read, now)
                read.sent_at = math.inf
                read.ask_again_at = until
        self._hear_control(message.param_index, message.param_count, now, is_answer=is_answer)

    def _hear_control(self, index: int, count: int, now: float, *, is_answer: bool) -> None:
        """Take an index that was answered: it exists, and may be the one asked for to learn of the link.

        Where a read of the same parameter was in flight, the message may answer either request: `is_answer`.
        """
        if index < count <= MOST_PARAMETERS:
            self.control = index  # it exists, and is answered
        if index == self._control_index and self._control_at < math.inf:
            # one that was lost may have nobody left to ask again; then this is not its answer
            is_late = now - self._control_at > 2 * self._round_trip.timeout
            attempts = self._control_attempts + is_late + is_answer
            self._round_trip.answered(self._control_at, now, attempts)
            self._control_at = math.inf
            self._not_silent(now)
            if not self.list_runs_again:  # else it may have brought the value
                self._controls_answered += 1
                for read in self._flying.values():
                    read.controls += read.attempts > 1

    def refused(self, message: ParamError, now: float) -> None:
        """A PARAM_ERROR that may be about a read."""
        key: Key = message.param_id if message.param_index < 0 else message.param_index
        read = self._flying.get(key)
        if read is not None:
            self._count_answer(read, now)
            self._drop(read)
            read.fail(self.error_of(message, read.key), now)
            self._send_waiting(now)

    def error_of(self, message: ParamError, key: Key) -> VehicleError:
        """A PARAM_ERROR as an exception."""
        system, component = self._target
        name, index = (key, None) if isinstance(key, str) else (None, key)
        words = ParamErrorCode.name_of(message.error)
        what = name if name is not None else f"parameter {index}"
        if message.error == ParamErrorCode.DOES_NOT_EXIST:
            return UnknownParameter(
                f"{system}/{component} has no {what}",
                system=system,
                component=component,
                name=name,
                index=index,
            )
        if message.error == ParamErrorCode.TYPE_MISMATCH:
            return TypeMismatch(
                f"{system}/{component} refuses {what}: {words}",
                system=system,
                component=component,
                name=name,
                index=index,
            )
        return Refused(
            f"{system}/{component} refuses {what}: {words}",
            system=system,
            component=component,
            name=name,
            index=index,
            code=message.error,
        )

    def tick(self, now: float) -> None:
        """Ask again what stayed unanswered, give up what stayed so too often."""
        timeout = self._round_trip.timeout
        for read in [read for read in self._flying.values() if self._due_at(read) <= now]:
            if self._flying.get(read.key) is not read:
                continue  # what the end of another one brought about
            if read.ask_again_at < math.inf:
                read.ask_again_at = math.inf
                self._again.append(read)
                continue
            self._silences += 1
            if not (self.list_runs_again and isinstance(read.key, int)):
                self._round_trip.timed_out(read.attempts)
            if self._is_hopeless(read, now):
                self._drop(read)
                self._trace("%s/%s %s: given up after try %s", *self._target, read.key, read.attempts)
                read.fail(self._silence(read, now), now)
            else:
                self._trace(
                    "%s/%s %s: no answer to try %s in %.3f s", *self._target, read.key, read.attempts, timeout
                )
                read.sent_at = math.inf
                self._again.append(read)
        self._send_waiting(now)

    def is_silent(self, now: float) -> bool:
        """Whether nothing at all was answered for so long, and so often, that it leads nowhere."""
        tries = min(self._round_trip.tries, MOST_TRIES)
        return self._silences >= tries and now - self._silent_since >= LONGEST_SILENCE

    def forgive(self) -> None:
        """The silence so far has another reason."""
        self._silences = 0
        self._silent_since = math.inf

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity."""
        earliest = math.inf
        if self._flying:
            earliest = min(map(self._due_at, self._flying.values()))
        if self._again or self._urgent or self._patient:
            return min(earliest, self.pace.next_at())
        if self._copy_wanted() is not None:
            return min(earliest, self.pace.next_at(COPY_RESERVE))
        return earliest

    def resume(self, now: float) -> None:
        """The link is back: ask again, in its turn, for everything that was in flight."""
        self._control_at = self._silent_since = math.inf
        self._again.clear()
        for read in self._flying.values():
            read.attempts -= 1
            read.sent_at = read.ask_again_at = math.inf
            self._again.append(read)
        self._send_waiting(now)

    def lose(self, now: float) -> None:
        """The component is lost: callers wait no longer. What a fetch asks for goes on for a while."""
        for read in list(self._open.values()):
            if self._open.get(read.key) is read and read.is_of_caller:
                self._drop(read)
                what = f"{self._name(read.key)} (lost)"
                read.fail(NoReply(what, attempts=read.attempts, waited=now - read.begun_at), now)

    def fail_all(self, error: Exception, now: float) -> None:
        """Nothing can be answered any more. What is asked for from now on stands."""
        for read in list(self._open.values()):
            if self._open.get(read.key) is read:
                self._drop(read)
                read.fail(error, now)

    def _due_at(self, read: Read) -> float:
        """When a read in flight times out, or is sent again."""
        timeout = max(self._round_trip.read_timeout(read.attempts), read.serving_time)
        return min(read.sent_at + timeout, read.ask_again_at)

    def _time_to_serve(self) -> float:
        """Seconds until the request that is sent now is answered, by the requests that are in flight.

        The requests that reach the vehicle wait for each other: 12 in flight are served within three batches,
        and the first batch may be a whole interval away.
        """
        in_flight = sum(1 + read.copies for read in self._flying.values() if read.sent_at < math.inf)
        batches = math.ceil(in_flight / READS_PER_BATCH)
        return (batches + 1) * BATCH_INTERVAL + self.pace.quickest

    def _is_hopeless(self, read: Read, now: float) -> bool:
        silent_for = now - self._silent_since
        is_mute = read.attempts >= FEWEST_TRIES and silent_for >= 2 * LONGEST_SILENCE
        if (self._silences >= MOST_TRIES and silent_for >= LONGEST_SILENCE) or (
            self._silences >= SILENCES_TO_GIVE_UP and is_mute
        ):
            return True  # not one of all these was answered
        are_enough = read.controls >= FEWEST_CONTROLS and read.attempts >= FEWEST_TRIES
        if are_enough and self._bad_luck(read.attempts) < BAD_LUCK:
            return True
        # half as often will do where nothing speaks for it and the link is good enough for others
        weight = 2 if self._seems_unknown(read) else 1
        return self._round_trip.is_hopeless(weight * read.attempts, now)

    def _bad_luck(self, attempts: int) -> float:
        """The chance that so many reads in a row get lost, by what became of the controls.

        It is reckoned by the rule of succession: ten of ten that were answered are no proof of a link that
        loses nothing, where so many reads ask that the luckiest ten and the unluckiest read come together.
        """
        lost = self._controls_sent - self._controls_answered
        return math.prod(
            (lost + 1 + before) / (self._controls_sent + 2 + before) for before in range(attempts)
        )

    def _seems_unknown(self, read: Read) -> bool:
        return read.controls >= ENOUGH_CONTROLS and not self._is_known(read.key)

    def _count_answer(self, read: Read, now: float) -> None:
        self._not_silent(now)
        if self.list_runs_again and isinstance(read.key, int):
            return
        is_sure = read.attempts + read.copies == 1 and read.sent_at < math.inf
        self._round_trip.answered(read.sent_at, now, 1 if is_sure else read.attempts + 1)
        self.pace.answered(now - read.sent_at if is_sure else None, now)

    def _not_silent(self, now: float) -> None:
        self.answered_at = now
        self.forgive()

    def _silence(self, read: Read, now: float) -> Exception:
        system, component = self._target
        name, index = (read.key, None) if isinstance(read.key, str) else (None, read.key)
        what = name if name is not None else f"parameter {index}"
        if self._seems_unknown(read):
            return UnknownParameter(
                f"{system}/{component} has no {what}: it keeps silent on it and answers other reads",
                system=system,
                component=component,
                name=name,
                index=index,
            )
        return NoReply(self._name(read.key), attempts=read.attempts, waited=now - read.begun_at)

    def _name(self, key: Key) -> str:
        what = key if isinstance(key, str) else f"parameter {key}"
        return f"{what} of {self._target[0]}/{self._target[1]}"

    @property
    def _is_answered(self) -> bool:
        """Whether everything that was sent has been answered: one more request cannot make a queue."""
        return not self._flying and self.answered_at >= self.sent_at

    def _transmit(self, read: Read, now: float, *, is_charged: bool = True) -> None:
        read.attempts += 1
        self.retries += read.attempts > 1
        read.copies = 0
        read.sent_at = now
        read.serving_time = self._time_to_serve() if self.pace.is_batched else 0.0
        self._silent_since = min(self._silent_since, now)
        self.pace.sent(now, is_charged=is_charged)
        self._request(read, now)
        if read.key != self.control and read.attempts > (2 if self._is_known(read.key) else 1):
            self._send_control(now)

    def _request(self, read: Read, now: float) -> None:
        self.sent_at = now
        if isinstance(read.key, int):
            self._send(ParamRequestRead(*self._target, "", read.key))
        else:
            self._send(ParamRequestRead(*self._target, read.key, -1))

    def _send_control(self, now: float) -> None:
        """Ask for what is known to exist, unless that is under way for another read."""
        if self._control_at < math.inf:
            if now - self._control_at < self._round_trip.timeout:
                return
            self._round_trip.timed_out(self._control_attempts)
            self._control_attempts += 1
        else:
            self._control_attempts = 1
        if not self._is_known(self.control):
            self.control = CONTROL  # the vehicle has fewer by now
        self._control_at = now
        self._control_index = self.control
        self._controls_sent = self._controls_sent * MEMORY + 1
        self._controls_answered *= MEMORY
        self.pace.sent(now)
        self._send(ParamRequestRead(*self._target, "", self.control))

    def _send_waiting(self, now: float, *, may_copy: bool = True) -> None:
        """Send what waits, as far as the pace allows; on an idle link ask twice rather than wait.

        A caller's read goes out whatever the pace when nothing is in flight and the last request was
        answered: whoever asks for one value after the other is as quick as the vehicle.
        """
        while self._again or self._urgent or self._patient:
            queue = self._urgent or self._again or self._patient
            if self._open.get(queue[0].key) is not queue[0]:
                queue.popleft()
                continue
            has_token = self.pace.may_send(now)
            if not has_token and not (queue is self._urgent and self._is_answered):
                return
            read = queue.popleft()
            self._flying[read.key] = read
            self._transmit(read, now, is_charged=has_token)
        while (
            may_copy
            and (read_again := self._copy_wanted()) is not None
            and self.pace.may_send(now, COPY_RESERVE)
        ):
            read_again.copies += 1
            self.pace.sent(now)
            self._request(read_again, now)

    def _copy_wanted(self) -> Read | None:
        """A read that is worth asking for once more while its answer may be on the way."""
        if not self.is_idle or not self._flying or self._silences >= SILENCES_TO_SPARE:
            return None
        most = self._round_trip.copies(COPY_RISK, MOST_COPIES + 1) - 1
        if not most:
            return None
        fewest = min(self._flying.values(), key=lambda read: read.copies)
        return fewest if fewest.copies < most and fewest.sent_at < math.inf else None

    def _drop(self, read: Read) -> None:
        del self._open[read.key]
        self._flying.pop(read.key, None)
        if not self._open:
            self.pace.idle()
