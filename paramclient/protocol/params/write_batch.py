"""Many PARAM_SETs in one call: pipelining, order, and one outcome for each value.

`writes` repeats a PARAM_SET.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from paramclient.errors import NoReply, ParamClientError, ValueNotApplied
from paramclient.model.values import Value, WireValue
from paramclient.protocol.params.writes import SetResult, Write
from paramclient.protocol.requests.bulk_writes import BulkOutcome, BulkResult, BulkWrites, SetStatus
from paramclient.protocol.requests.machine import Machine

__all__ = [
    "Batch",
    "BatchRules",
    "SetManyResult",
    "SetOutcome",
    "SetStatus",
    "WriteBatch",
    "WriteBatches",
]


@dataclass(frozen=True, slots=True)
class SetOutcome(BulkOutcome[WireValue, SetResult]):
    """The outcome of one value of a `set_many`. `requested` is a number, or bytes if bytes were requested."""

    @property
    def actual(self) -> Value | None:
        """The value that the vehicle has reported after the write, as `Param.value`; None if none."""
        reported = self.reported
        return int.from_bytes(reported, "little") if isinstance(reported, bytes) else reported

    @property
    def reported(self) -> WireValue | None:
        """The value that the vehicle has reported after the write, as `Param.settable`; None if none."""
        if self.result is not None:
            return self.result.param.settable
        actual = self.error.actual if isinstance(self.error, ValueNotApplied) else None
        return None if isinstance(actual, str) else actual


@dataclass(frozen=True, slots=True, repr=False)
class SetManyResult(BulkResult[SetOutcome]):
    """The outcomes of a `set_many`."""


@dataclass(frozen=True, slots=True)
class BatchRules:
    """What a batch needs of its component.

    Attributes:
        begin: begins a write: name, value, time.
        cancel: cancels a write.
        is_switch: whether other parameters depend on one with this name.
    """

    begin: Callable[[str, WireValue, float], Write]
    cancel: Callable[[Write, float], None]
    is_switch: Callable[[str], bool]


class WriteBatch(BulkWrites[WireValue, Write, SetOutcome]):
    """The writes of one `set_many`; see `WriteBatches`.

    Args:
        pairs: names and values.
        rules: what it needs of its component.
        begun_at: the time.
    """

    def __init__(self, pairs: Sequence[tuple[str, WireValue]], rules: BatchRules, begun_at: float) -> None:
        super().__init__(pairs, begun_at)
        self._rules = rules
        self._barrier: int | None = None  # the open write that the next ones wait for

    def proceed(self, now: float) -> None:
        """See `BulkWrites.proceed`."""
        while self.failure is None and self._waiting and self._may_begin():
            number = self._waiting.popleft()
            if self._rules.is_switch(self._pairs[number][0]):
                self._barrier = number
            self._begin(number, now)
        if not self._open and (self.failure is not None or not self._waiting):
            self._finish(now)

    def _begin(self, number: int, now: float) -> None:
        """Begin one write."""
        name, value = self._pairs[number]
        try:
            write = self._rules.begin(name, value, now)
        except ParamClientError as error:
            if self._barrier == number:
                self._barrier = None
            self._not_begun(number, error)
            return
        if not write.done:
            write.on_acknowledged.append(self._acknowledged)
        self._follow(number, write)

    def _cancel_write(self, write: Write, now: float) -> None:
        write.on_acknowledged.clear()
        self._rules.cancel(write, now)

    def _may_begin(self) -> bool:
        if not self._open:
            return True
        if self._barrier is not None or self._rules.is_switch(self._pairs[self._waiting[0]][0]):
            return False
        return self._in_flight < self._window.limit

    @property
    def _in_flight(self) -> int:
        """PARAM_SETs that are not acknowledged."""
        return sum(write.acknowledged is None for write in self._open.values())

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
        if self._barrier == number:
            self._barrier = None
        super()._take(number, write)

    def _outcome(
        self, number: int, status: SetStatus, result: SetResult | None, error: ParamClientError | None
    ) -> SetOutcome:
        return SetOutcome(*self._pairs[number], status, result, error)

    def _result_of(self, write: Write) -> SetResult:
        assert write.result is not None
        return write.result

    def _is_sent(self, write: Write) -> bool:
        return bool(write.attempts)


class Batch(Protocol):
    """The part of a batch that `WriteBatches` needs."""

    @property
    def begun_at(self) -> float:
        """Time at which it was begun."""

    def proceed(self, now: float) -> None:
        """Begin as many writes as may be in flight, and end when none is left."""

    def interrupt(self, error: ParamClientError, now: float) -> None:
        """Begin no further write; the open ones are ended by the machine of the writes."""

    def discard(self, now: float) -> None:
        """Cancel the open writes: the caller was cancelled."""


class WriteBatches(Machine):
    """The batches of writes to one component, of plain or of extended parameters.

    As many writes are in flight as `WriteWindow` permits, in the order of the request: the writes to one name
    follow each other, and a write that other parameters depend on is alone. A write that fails does not stop
    the others, unless the component is lost, the link fails, or `UNANSWERED_WRITES_MAX` writes in a row get
    no response.

    Args:
        target: system and component.
        request: name of the message that writes one value.
    """

    def __init__(self, target: tuple[int, int], request: str) -> None:
        self._target = target
        self._request = request
        self._batches: set[Batch] = set()

    def __len__(self) -> int:
        return len(self._batches)

    def begin(self, batch: Batch, now: float) -> None:
        """Begin a batch. The caller ends it with `end`."""
        self._batches.add(batch)
        batch.proceed(now)

    def end(self, batch: Batch, now: float) -> None:
        """End a batch. The component may have the values whose writes are in flight."""
        self._batches.discard(batch)
        batch.discard(now)

    def lose(self, now: float) -> None:
        """Begin no further writes: the component is lost. The machine of the writes ends the open ones."""
        for batch in self._batches:
            what = f"{self._request} to {self._target[0]}/{self._target[1]} (lost)"
            batch.interrupt(NoReply(what, attempts=0, waited=now - batch.begun_at), now)

    def fail_all(self, error: Exception, now: float) -> None:
        """Begin no further writes. The machine of the writes ends the open ones with the error."""
        assert isinstance(error, ParamClientError)
        for batch in self._batches:
            batch.interrupt(error, now)
