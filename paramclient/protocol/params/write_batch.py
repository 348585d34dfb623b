"""Many PARAM_SETs in one call: pipelining, order, and one outcome for each value."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Final

from paramclient.errors import (
    ContestedAddress,
    NoReply,
    ParamClientError,
    UsageError,
    ValueNotApplied,
    VehicleError,
)
from paramclient.model.values import Value
from paramclient.protocol.params.writes import SetResult, Write
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.pacing import WriteWindow

__all__ = [
    "UNANSWERED_WRITES_MAX",
    "BatchRules",
    "SetManyResult",
    "SetOutcome",
    "SetStatus",
    "WriteBatch",
    "WriteBatches",
    "is_refusal",
]

UNANSWERED_WRITES_MAX: Final = 3
"""Consecutive writes without an acknowledgement, each after all its attempts, after which no further write is
begun."""


class SetStatus(StrEnum):
    """What became of one value of a `set_many`."""

    ACCEPTED = "accepted"
    """The vehicle holds the requested value, as far as the type can represent it."""
    ADJUSTED = "adjusted"
    """The vehicle stored another value."""
    REFUSED = "refused"
    """The vehicle does not have the value: it refused it, or the value cannot be sent to it."""
    UNKNOWN = "unknown"
    """The value was sent and not acknowledged: the vehicle may have it."""
    NOT_TRIED = "not tried"
    """The value was not sent."""


@dataclass(frozen=True, slots=True)
class SetOutcome:
    """The outcome of one value of a `set_many`.

    Attributes:
        name: param_id, as requested.
        requested: the requested value.
        status: what became of it.
        result: the result as of `set` for an accepted or adjusted value, else None. Over a service, also None
            if the value is not on the disk.
        error: the error that `set` would have raised, or None. For a value that was not tried, the error that
            ended the call. An accepted or adjusted value has one (NotDurable) if it is not on the disk.
    """

    name: str
    requested: Value
    status: SetStatus
    result: SetResult | None = None
    error: ParamClientError | None = None

    @property
    def is_set(self) -> bool:
        """Whether the vehicle has acknowledged the value, also if it adjusted it."""
        return self.status in (SetStatus.ACCEPTED, SetStatus.ADJUSTED)

    @property
    def actual(self) -> Value | None:
        """The value that the vehicle has reported after the write; None if it has reported none."""
        if self.result is not None:
            return self.result.actual
        actual = self.error.actual if isinstance(self.error, ValueNotApplied) else None
        return None if isinstance(actual, str) else actual

    def __str__(self) -> str:
        if self.result is not None and self.error is None:
            return str(self.result)
        return f"{self.name}: {self.status}" + ("" if self.error is None else f": {self.error}")


@dataclass(frozen=True, slots=True)
class SetManyResult:
    """The outcomes of a `set_many`.

    Attributes:
        system, component: MAVLink ids of the component.
        outcomes: one for each requested value, in the order of the request.
        error: why values were not tried, or why values are not on the disk; None otherwise.
        elapsed: seconds.
    """

    system: int
    component: int
    outcomes: tuple[SetOutcome, ...]
    error: ParamClientError | None
    elapsed: float

    def __getitem__(self, name: str) -> SetOutcome:
        """Return the outcome of a name; of the last value for it if it was requested several times."""
        for outcome in reversed(self.outcomes):
            if outcome.name == name:
                return outcome
        raise KeyError(name)

    @property
    def is_complete(self) -> bool:
        """Whether the vehicle has acknowledged every value, also if it adjusted some, without an error."""
        return self.error is None and all(outcome.is_set for outcome in self.outcomes)

    @property
    def counts(self) -> Mapping[SetStatus, int]:
        """The number of values with each status."""
        return Counter(outcome.status for outcome in self.outcomes)

    def of(self, status: SetStatus) -> list[SetOutcome]:
        """Return the outcomes with this status, in order."""
        return [outcome for outcome in self.outcomes if outcome.status is status]

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.counts.items())
        return f"<SetManyResult {self.system}/{self.component} {counts or 'nothing'} in {self.elapsed:.2f} s>"


@dataclass(frozen=True, slots=True)
class BatchRules:
    """What a batch needs of its component.

    Attributes:
        begin: begins a write: name, value, time.
        cancel: cancels a write.
        is_switch: whether other parameters depend on one with this name.
    """

    begin: Callable[[str, Value, float], Write]
    cancel: Callable[[Write, float], None]
    is_switch: Callable[[str], bool]


class WriteBatch(Operation[tuple[SetOutcome, ...]]):
    """The writes of one `set_many`; see `WriteBatches`.

    Attributes:
        ended: the outcomes so far, in the order in which they came.
        failure: the error after which no further write is begun, or None.
        on_outcome: called after each outcome.
    """

    def __init__(self, pairs: Sequence[tuple[str, Value]], rules: BatchRules, begun_at: float) -> None:
        super().__init__(begun_at)
        self.ended: list[SetOutcome] = []
        self.failure: ParamClientError | None = None
        self.on_outcome: Callable[[], None] = _ignore
        self._pairs = pairs
        self._rules = rules
        self._outcomes: dict[int, SetOutcome] = {}
        self._open: dict[int, Write] = {}
        self._window = WriteWindow()
        self._next = 0
        self._barrier: int | None = None  # the open write that the next ones wait for
        self._unanswered = 0

    @property
    def attempts(self) -> int:
        """PARAM_SETs sent for the open writes."""
        return sum(write.attempts for write in self._open.values())

    def proceed(self, now: float) -> None:
        """Begin as many writes as may be in flight, and end when none is left."""
        while self.failure is None and self._next < len(self._pairs) and self._may_begin():
            number = self._next
            self._next += 1
            name, value = self._pairs[number]
            try:
                write = self._rules.begin(name, value, now)
            except ParamClientError as error:
                if is_refusal(error):
                    self._record(number, SetStatus.REFUSED, error=error)
                else:
                    self.stop(error)
                    self._record(number, SetStatus.NOT_TRIED, error=error)
                continue
            if self._rules.is_switch(name):
                self._barrier = number
            self._open[number] = write
            if write.done:
                self._take(number, write)
            else:
                write.on_acknowledged.append(self._acknowledged)
                write.on_done.append(partial(self._ended, number, write))
        if not self._open and (self.failure is not None or self._next == len(self._pairs)):
            self._finish(now)

    def stop(self, error: ParamClientError) -> None:
        """Begin no further write; the open ones end by themselves."""
        self.failure = self.failure or error

    @property
    def open_names(self) -> list[str]:
        """The names of the writes that have begun and not ended."""
        return [write.name for write in self._open.values()]

    def give_up(self, error: ParamClientError, now: float) -> None:
        """End at once: open writes are cancelled, and their outcome is unknown if anything was sent."""
        if self.done:
            return
        self.failure = self.failure or error
        self._cancel(now, lambda number, write: self._record_unanswered(number, write, error))
        self._finish(now)

    def discard(self, now: float) -> None:
        """Cancel the open writes: the caller was cancelled."""
        self._next = len(self._pairs)
        self.on_outcome = _ignore
        self._cancel(now, lambda number, write: None)

    def _cancel(self, now: float, record: Callable[[int, Write], None]) -> None:
        given_up, self._open = self._open, {}
        for write in reversed(given_up.values()):  # the last first: no write that waits for another begins
            write.drop_callbacks()
            write.on_acknowledged.clear()
            self._rules.cancel(write, now)
        for number, write in given_up.items():
            record(number, write)

    def _may_begin(self) -> bool:
        if not self._open:
            return True
        if self._barrier is not None or self._rules.is_switch(self._pairs[self._next][0]):
            return False
        in_flight = sum(write.acknowledged is None for write in self._open.values())
        return in_flight < self._window.limit

    def _acknowledged(self, now: float) -> None:
        """Begin further writes while the value of one is watched."""
        self._window.acknowledged()
        self.proceed(now)

    def _ended(self, number: int, write: Write) -> None:
        if write.result is not None and write.acknowledged is None:
            self._window.acknowledged()
        self._take(number, write)
        self.proceed(write.ended_at)

    def _take(self, number: int, write: Write) -> None:
        """Record the outcome of a write that has ended."""
        del self._open[number]
        if self._barrier == number:
            self._barrier = None
        error = write.error
        if error is None:
            result = write.result
            assert result is not None
            self._unanswered = 0
            self._record(number, SetStatus(result.status), result=result)
            return
        assert isinstance(error, ParamClientError)
        if is_refusal(error):
            self._unanswered = 0
            self._record(number, SetStatus.REFUSED, error=error)
        else:
            self._unanswered += 1
            if not isinstance(error, NoReply) or self._unanswered >= UNANSWERED_WRITES_MAX:
                self.stop(error)
            self._record_unanswered(number, write, error)

    def _record_unanswered(self, number: int, write: Write, error: ParamClientError) -> None:
        status = SetStatus.UNKNOWN if write.attempts else SetStatus.NOT_TRIED
        self._record(number, status, error=error)

    def _record(
        self,
        number: int,
        status: SetStatus,
        *,
        result: SetResult | None = None,
        error: ParamClientError | None = None,
    ) -> None:
        outcome = SetOutcome(*self._pairs[number], status, result, error)
        self._outcomes[number] = outcome
        self.ended.append(outcome)
        self.on_outcome()

    def _finish(self, now: float) -> None:
        for number in range(self._next, len(self._pairs)):
            self._record(number, SetStatus.NOT_TRIED, error=self.failure)
        self._next = len(self._pairs)
        self.finish(tuple(self._outcomes[number] for number in range(len(self._pairs))), now)


class WriteBatches(Machine):
    """The batches of writes to one component.

    As many writes are in flight as `WriteWindow` permits, in the order of the request: the writes to one name
    follow each other, and a write that other parameters depend on is alone. A write that fails does not stop
    the others, unless the component is lost, the link fails, or `UNANSWERED_WRITES_MAX` writes in a row get
    no response.

    Args:
        target: system and component.
    """

    def __init__(self, target: tuple[int, int]) -> None:
        self._target = target
        self._batches: set[WriteBatch] = set()

    def __len__(self) -> int:
        return len(self._batches)

    def begin(self, pairs: Sequence[tuple[str, Value]], rules: BatchRules, now: float) -> WriteBatch:
        """Begin a batch. The caller ends it with `end`."""
        batch = WriteBatch(pairs, rules, now)
        self._batches.add(batch)
        batch.proceed(now)
        return batch

    def end(self, batch: WriteBatch, now: float) -> None:
        """End a batch. The vehicle may have the values whose writes are in flight."""
        self._batches.discard(batch)
        batch.discard(now)

    def lose(self, now: float) -> None:
        """Begin no further writes: the component is lost. `Writes` ends the open ones."""
        for batch in self._batches:
            what = f"PARAM_SET to {self._target[0]}/{self._target[1]} (lost)"
            batch.stop(NoReply(what, attempts=0, waited=now - batch.begun_at))

    def fail_all(self, error: Exception, now: float) -> None:
        """Begin no further writes. `Writes` ends the open ones with the error."""
        assert isinstance(error, ParamClientError)
        for batch in self._batches:
            batch.stop(error)


def is_refusal(error: ParamClientError) -> bool:
    """Return whether an error is about one value; otherwise it is about the vehicle or the link."""
    return isinstance(error, (UsageError, VehicleError)) and not isinstance(error, ContestedAddress)


def _ignore() -> None:
    return
