"""Many PARAM_EXT_SETs in one call: pipelining, order, and one outcome for each value."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from paramclient.errors import ParamClientError
from paramclient.model.ext_params import ExtValue
from paramclient.protocol.ext.writes import ExtSetResult, ExtWrite
from paramclient.protocol.requests.bulk_writes import BulkOutcome, BulkResult, BulkWrites, SetStatus

__all__ = ["ExtSetManyResult", "ExtSetOutcome", "ExtWriteBatch"]


@dataclass(frozen=True, slots=True)
class ExtSetOutcome(BulkOutcome[ExtValue, ExtSetResult]):
    """The outcome of one value of a `set_many` of extended parameters; see `SetOutcome`."""


@dataclass(frozen=True, slots=True, repr=False)
class ExtSetManyResult(BulkResult[ExtSetOutcome]):
    """The outcomes of a `set_many` of extended parameters; see `SetManyResult`."""


class ExtWriteBatch(BulkWrites[ExtValue, ExtWrite, ExtSetOutcome]):
    """The writes of one `set_many` of extended parameters; see `WriteBatches`.

    Args:
        pairs: names and values.
        begin: begins a write: name, value, time.
        cancel: cancels a write.
        begun_at: the time.
    """

    def __init__(
        self,
        pairs: Sequence[tuple[str, ExtValue]],
        begin: Callable[[str, ExtValue, float], ExtWrite],
        cancel: Callable[[ExtWrite, float], None],
        begun_at: float,
    ) -> None:
        super().__init__(pairs, begun_at)
        self._begin_write = begin
        self._cancel_begun = cancel

    def proceed(self, now: float) -> None:
        """See `BulkWrites.proceed`."""
        while self.failure is None and self._waiting and len(self._open) < self._window.limit:
            number = self._waiting.popleft()
            try:
                write = self._begin_write(*self._pairs[number], now)
            except ParamClientError as error:
                self._not_begun(number, error)
            else:
                self._follow(number, write)
        if not self._open and (self.failure is not None or not self._waiting):
            self._finish(now)

    def _outcome(
        self,
        number: int,
        status: SetStatus,
        result: ExtSetResult | None,
        error: ParamClientError | None,
    ) -> ExtSetOutcome:
        return ExtSetOutcome(*self._pairs[number], status, result, error)

    def _cancel_write(self, write: ExtWrite, now: float) -> None:
        self._cancel_begun(write, now)

    def _result_of(self, write: ExtWrite) -> ExtSetResult:
        assert write.result is not None
        return write.result

    def _is_sent(self, write: ExtWrite) -> bool:
        return write.is_sent

    def _ended(self, number: int, write: ExtWrite) -> None:
        if write.result is not None:
            self._window.acknowledged()
        self._take(number, write)
        self.proceed(write.ended_at)
