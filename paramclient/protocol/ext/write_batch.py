"""Many PARAM_EXT_SETs in one call: pipelining, order, and one outcome for each value."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from paramclient.errors import NoReply, ParamClientError
from paramclient.model.ext_params import ExtValue
from paramclient.protocol.ext.writes import ExtSetResult, ExtWrite
from paramclient.protocol.params.write_batch import UNANSWERED_WRITES_MAX, SetStatus, is_refusal
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.pacing import WriteWindow

__all__ = ["ExtSetManyResult", "ExtSetOutcome", "ExtWriteBatch"]


@dataclass(frozen=True, slots=True)
class ExtSetOutcome:
    """The outcome of one value of a `set_many` of extended parameters.

    Attributes:
        name: param_id, as requested.
        requested: the requested value.
        status: what became of it.
        result: the result as of `set` for an accepted or adjusted value, else None.
        error: the error that `set` would have raised, or None. For a value that was not tried, the error that
            ended the call.
    """

    name: str
    requested: ExtValue
    status: SetStatus
    result: ExtSetResult | None = None
    error: ParamClientError | None = None

    @property
    def is_set(self) -> bool:
        """Whether the component has acknowledged the value, also if it adjusted it."""
        return self.status in (SetStatus.ACCEPTED, SetStatus.ADJUSTED)

    def __str__(self) -> str:
        if self.result is not None:
            return str(self.result)
        return f"{self.name}: {self.status}" + ("" if self.error is None else f": {self.error}")


@dataclass(frozen=True, slots=True)
class ExtSetManyResult:
    """The outcomes of a `set_many` of extended parameters.

    Attributes:
        system, component: MAVLink ids of the component.
        outcomes: one for each requested value, in the order of the request.
        error: why values were not tried, or None.
        elapsed: seconds.
    """

    system: int
    component: int
    outcomes: tuple[ExtSetOutcome, ...]
    error: ParamClientError | None
    elapsed: float

    def __getitem__(self, name: str) -> ExtSetOutcome:
        """Return the outcome of a name; of the last value for it if it was requested several times."""
        for outcome in reversed(self.outcomes):
            if outcome.name == name:
                return outcome
        raise KeyError(name)

    @property
    def is_complete(self) -> bool:
        """Whether the component has acknowledged every value, also if it adjusted some, without an error."""
        return self.error is None and all(outcome.is_set for outcome in self.outcomes)

    @property
    def counts(self) -> Mapping[SetStatus, int]:
        """The number of values with each status."""
        return Counter(outcome.status for outcome in self.outcomes)

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.counts.items())
        whose = f"{self.system}/{self.component}"
        return f"<ExtSetManyResult {whose} {counts or 'nothing'} in {self.elapsed:.2f} s>"


class ExtWriteBatch(Operation[tuple[ExtSetOutcome, ...]]):
    """The writes of one `set_many`; see `params.write_batch.WriteBatches`.

    Attributes:
        ended: the outcomes so far, in the order in which they came.
        failure: the error after which no further write is begun, or None.
        on_outcome: called after each outcome.
    """

    def __init__(
        self,
        pairs: Sequence[tuple[str, ExtValue]],
        begin: Callable[[str, ExtValue, float], ExtWrite],
        cancel: Callable[[ExtWrite, float], None],
        begun_at: float,
    ) -> None:
        super().__init__(begun_at)
        self.ended: list[ExtSetOutcome] = []
        self.failure: ParamClientError | None = None
        self.on_outcome: Callable[[], None] = _ignore
        self._pairs = pairs
        self._begin_write = begin
        self._cancel_write = cancel
        self._outcomes: dict[int, ExtSetOutcome] = {}
        self._open: dict[int, ExtWrite] = {}
        self._window = WriteWindow()
        self._next = 0
        self._unanswered = 0

    @property
    def attempts(self) -> int:
        """PARAM_EXT_SETs sent for the open writes."""
        return sum(write.attempts for write in self._open.values())

    @property
    def open_names(self) -> list[str]:
        """The names of the writes that have begun and not ended."""
        return [write.name for write in self._open.values()]

    def proceed(self, now: float) -> None:
        """Begin as many writes as may be in flight, and end when none is left."""
        while self.failure is None and self._next < len(self._pairs) and self._has_capacity:
            number = self._next
            self._next += 1
            try:
                write = self._begin_write(*self._pairs[number], now)
            except ParamClientError as error:
                if is_refusal(error):
                    self._record(number, SetStatus.REFUSED, error=error)
                else:
                    self.stop(error)
                    self._record(number, SetStatus.NOT_TRIED, error=error)
                continue
            self._open[number] = write
            if write.done:
                self._take(number, write)
            else:
                write.on_done.append(partial(self._ended, number, write))
        if not self._open and (self.failure is not None or self._next == len(self._pairs)):
            self._finish(now)

    def stop(self, error: ParamClientError) -> None:
        """Begin no further write; the open ones end by themselves."""
        self.failure = self.failure or error

    def interrupt(self, error: ParamClientError, now: float) -> None:
        """Begin no further write; `ExtWrites` ends the open ones."""
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
        self._next = len(self._pairs)
        self.on_outcome = _ignore
        self._cancel(now)

    @property
    def _has_capacity(self) -> bool:
        return len(self._open) < self._window.limit

    def _cancel(self, now: float) -> dict[int, ExtWrite]:
        """Cancel the open writes and return them."""
        given_up, self._open = self._open, {}
        for write in reversed(given_up.values()):  # the last first: no write that waits for another begins
            write.drop_callbacks()
            self._cancel_write(write, now)
        return given_up

    def _ended(self, number: int, write: ExtWrite) -> None:
        if write.result is not None:
            self._window.acknowledged()
        self._take(number, write)
        self.proceed(write.ended_at)

    def _take(self, number: int, write: ExtWrite) -> None:
        """Record the outcome of a write that has ended."""
        del self._open[number]
        error = write.error
        if error is None:
            assert write.result is not None
            self._unanswered = 0
            self._record(number, SetStatus(write.result.status), result=write.result)
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

    def _record_unanswered(self, number: int, write: ExtWrite, error: ParamClientError) -> None:
        status = SetStatus.UNKNOWN if write.is_sent else SetStatus.NOT_TRIED
        self._record(number, status, error=error)

    def _record(
        self,
        number: int,
        status: SetStatus,
        *,
        result: ExtSetResult | None = None,
        error: ParamClientError | None = None,
    ) -> None:
        outcome = ExtSetOutcome(*self._pairs[number], status, result, error)
        self._outcomes[number] = outcome
        self.ended.append(outcome)
        self.on_outcome()

    def _finish(self, now: float) -> None:
        for number in range(self._next, len(self._pairs)):
            self._record(number, SetStatus.NOT_TRIED, error=self.failure)
        self._next = len(self._pairs)
        self.finish(tuple(self._outcomes[number] for number in range(len(self._pairs))), now)


def _ignore() -> None:
    return
