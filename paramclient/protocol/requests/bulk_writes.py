"""Many writes in one call, of plain or of extended parameters: one outcome for each value."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Any, Final, Generic, Protocol, TypeVar

from paramclient.errors import ContestedAddress, NoReply, ParamClientError, UsageError, VehicleError
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.write_window import WriteWindow

__all__ = [
    "UNANSWERED_WRITES_MAX",
    "BulkOutcome",
    "BulkResult",
    "BulkWrites",
    "SetStatus",
    "is_refusal",
]

UNANSWERED_WRITES_MAX: Final = 3
"""Consecutive writes without an acknowledgement, each after all its attempts, after which no further write is
begun."""


class SetStatus(StrEnum):
    """The outcome of one value of a `set_many`."""

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


class WriteResult(Protocol):
    """The part of the result of a write that a batch needs."""

    @property
    def status(self) -> str:
        """Accepted or adjusted."""


Value = TypeVar("Value")
Result = TypeVar("Result", bound=WriteResult)


@dataclass(frozen=True, slots=True)
class BulkOutcome(Generic[Value, Result]):
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
    result: Result | None = None
    error: ParamClientError | None = None

    @property
    def is_set(self) -> bool:
        """Whether the vehicle has acknowledged the value, also if it adjusted it."""
        return self.status in (SetStatus.ACCEPTED, SetStatus.ADJUSTED)

    def __str__(self) -> str:
        if self.result is not None and self.error is None:
            return str(self.result)
        return f"{self.name}: {self.status}" + ("" if self.error is None else f": {self.error}")


Outcome = TypeVar("Outcome", bound=BulkOutcome[Any, Any])


@dataclass(frozen=True, slots=True)
class BulkResult(Generic[Outcome]):
    """The outcomes of a `set_many`.

    Attributes:
        system, component: MAVLink ids of the component.
        outcomes: one for each requested value, in the order of the request.
        error: why values were not tried, or why values are not on the disk; None otherwise.
        elapsed: seconds.
    """

    system: int
    component: int
    outcomes: tuple[Outcome, ...]
    error: ParamClientError | None
    elapsed: float

    def __getitem__(self, name: str) -> Outcome:
        """Return the outcome of a name; of the last value for it if it was requested several times."""
        named = {outcome.name: outcome for outcome in self.outcomes}
        return named[name]

    @property
    def is_complete(self) -> bool:
        """Whether the vehicle has acknowledged every value, also if it adjusted some, without an error."""
        return self.error is None and all(outcome.is_set for outcome in self.outcomes)

    @property
    def counts(self) -> Mapping[SetStatus, int]:
        """The number of values with each status."""
        return Counter(outcome.status for outcome in self.outcomes)

    def of(self, status: SetStatus) -> list[Outcome]:
        """Return the outcomes with this status, in order."""
        return [outcome for outcome in self.outcomes if outcome.status is status]

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.counts.items())
        whose = f"{self.system}/{self.component}"
        return f"<{type(self).__name__} {whose} {counts or 'nothing'} in {self.elapsed:.2f} s>"


class BulkWrite(Protocol):
    """The part of a write that a batch needs."""

    name: str
    done: bool
    error: Exception | None
    ended_at: float
    on_done: list[Callable[[], None]]

    @property
    def attempts(self) -> int:
        """Messages sent for it."""

    def drop_callbacks(self) -> None:
        """Drop the callbacks."""


WriteT = TypeVar("WriteT", bound=BulkWrite)


class BulkWrites(Operation[tuple[Outcome, ...]], ABC, Generic[Value, WriteT, Outcome]):
    """The writes of one `set_many`; see `WriteBatches`.

    A subclass begins them in `proceed`.

    Attributes:
        ended: the outcomes so far, in the order in which they were received.
        failure: the error after which no further write is begun, or None.
        on_outcome: called after each outcome.

    Args:
        pairs: names and values.
        begun_at: the time.
    """

    def __init__(self, pairs: Sequence[tuple[str, Value]], begun_at: float) -> None:
        super().__init__(begun_at)
        self.ended: list[Outcome] = []
        self.failure: ParamClientError | None = None
        self.on_outcome: Callable[[], None] = _ignore
        self._pairs = pairs
        self._outcomes: dict[int, Outcome] = {}
        self._open: dict[int, WriteT] = {}
        self._window = WriteWindow()
        self._waiting = deque(range(len(pairs)))  # numbers of the pairs that have not begun
        self._unanswered = 0

    @property
    def attempts(self) -> int:
        """Messages sent for the open writes."""
        return sum(write.attempts for write in self._open.values())

    @property
    def open_names(self) -> list[str]:
        """The names of the writes that have begun and not ended."""
        return [write.name for write in self._open.values()]

    @abstractmethod
    def proceed(self, now: float) -> None:
        """Begin as many writes as may be in flight, and end when none is left."""

    def stop(self, error: ParamClientError) -> None:
        """Begin no further write; the open ones end by themselves."""
        self.failure = self.failure or error

    def interrupt(self, error: ParamClientError, now: float) -> None:
        """Begin no further write; the machine of the writes ends the open ones."""
        self.stop(error)

    def give_up(self, error: ParamClientError, now: float) -> None:
        """End at once: open writes are cancelled, and their outcome is unknown if anything was sent."""
        if self.done:
            return
        self.stop(error)
        for number, write in self._cancel(now).items():
            self._record_unanswered(number, write, error)
        self._finish(now)

    def discard(self, now: float) -> None:
        """Cancel the open writes: the caller was cancelled."""
        self._waiting.clear()
        self.on_outcome = _ignore
        self._cancel(now)

    @abstractmethod
    def _outcome(
        self, number: int, status: SetStatus, result: Any | None, error: ParamClientError | None
    ) -> Outcome:
        """Return the outcome of a pair."""

    @abstractmethod
    def _cancel_write(self, write: WriteT, now: float) -> None:
        """Cancel one write."""

    @abstractmethod
    def _result_of(self, write: WriteT) -> WriteResult:
        """Return the result of a write that has ended without an error."""

    @abstractmethod
    def _is_sent(self, write: WriteT) -> bool:
        """Return whether the value was sent."""

    def _follow(self, number: int, write: WriteT) -> None:
        """Take the outcome of a write when it ends."""
        self._open[number] = write
        if write.done:
            self._take(number, write)
        else:
            write.on_done.append(partial(self._ended, number, write))

    def _not_begun(self, number: int, error: ParamClientError) -> None:
        """Record that a write could not begin."""
        if is_refusal(error):
            self._record(number, SetStatus.REFUSED, error=error)
        else:
            self.stop(error)
            self._record(number, SetStatus.NOT_TRIED, error=error)

    @abstractmethod
    def _ended(self, number: int, write: WriteT) -> None:
        """Take the outcome of a write that has ended, and begin further ones."""

    def _cancel(self, now: float) -> dict[int, WriteT]:
        """Cancel the open writes and return them."""
        given_up, self._open = self._open, {}
        for write in reversed(given_up.values()):  # the last first: no write that waits for another begins
            write.drop_callbacks()
            self._cancel_write(write, now)
        return given_up

    def _take(self, number: int, write: WriteT) -> None:
        """Record the outcome of a write that has ended."""
        del self._open[number]
        error = write.error
        if error is None:
            result = self._result_of(write)
            self._unanswered = 0
            self._record(number, SetStatus(result.status), result=result)
            return
        assert isinstance(error, ParamClientError)
        if is_refusal(error):
            self._unanswered = 0
            self._record(number, SetStatus.REFUSED, error=error)
            return
        self._unanswered += 1
        if not isinstance(error, NoReply) or self._unanswered >= UNANSWERED_WRITES_MAX:
            self.stop(error)
        self._record_unanswered(number, write, error)

    def _record_unanswered(self, number: int, write: WriteT, error: ParamClientError) -> None:
        status = SetStatus.UNKNOWN if self._is_sent(write) else SetStatus.NOT_TRIED
        self._record(number, status, error=error)

    def _record(
        self,
        number: int,
        status: SetStatus,
        *,
        result: Any | None = None,
        error: ParamClientError | None = None,
    ) -> None:
        outcome = self._outcome(number, status, result, error)
        self._outcomes[number] = outcome
        self.ended.append(outcome)
        self.on_outcome()

    def _finish(self, now: float) -> None:
        for number in self._waiting:
            self._record(number, SetStatus.NOT_TRIED, error=self.failure)
        self._waiting.clear()
        self.finish(tuple(self._outcomes[number] for number in range(len(self._pairs))), now)


def is_refusal(error: ParamClientError) -> bool:
    """Return whether an error is about one value; otherwise it is about the vehicle or the link."""
    return isinstance(error, (UsageError, VehicleError)) and not isinstance(error, ContestedAddress)


def _ignore() -> None:
    return
