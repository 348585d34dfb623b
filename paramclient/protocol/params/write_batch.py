"""Many PARAM_SETs in one call: pipelining, order, and one outcome for each value.

`writes` repeats a PARAM_SET.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from paramclient.errors import NoReply, ParamClientError, ValueNotApplied
from paramclient.model.values import Param, Value, WireValue
from paramclient.protocol.ftp.param_pck import PackedParam
from paramclient.protocol.params.upload import ParamUpload, UploadHooks, Uploads
from paramclient.protocol.params.writes import SetResult, Write
from paramclient.protocol.requests.bulk_writes import BulkOutcome, BulkResult, BulkWrites, SetStatus
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.wire import ParamValue

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
        begin: begins a write: name, value, time, and whether it is filed (see `Writes.set`).
        cancel: cancels a write.
        committed: records that the vehicle may take the parameter file with the value of a filed write.
        unfile: continues a filed write with PARAM_SET.
        receive: processes a PARAM_VALUE of the component.
        is_switch: whether other parameters depend on one with this name.
        fileable: returns the parameter with this name if its value can be written with the parameter file;
            None otherwise.
        may_commit: whether it is still certain which vehicle receives a write.
        uploads: the component's; None if the values are not to be written as a file.
    """

    begin: Callable[[str, WireValue, float, bool], Write]
    cancel: Callable[[Write, float], None]
    committed: Callable[[Write, float], None]
    unfile: Callable[[Write, float], None]
    receive: Callable[[ParamValue, float], None]
    is_switch: Callable[[str], bool]
    fileable: Callable[[str], Param | None]
    may_commit: Callable[[], bool]
    uploads: Uploads | None


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
        self._upload: ParamUpload | None = None
        self._unproven: deque[int] = deque()  # numbers of filed writes that go on with PARAM_SET
        self._barrier: int | None = None  # the open write that the next ones wait for

    def proceed(self, now: float) -> None:
        """See `BulkWrites.proceed`."""
        while self._unproven and self._in_flight < self._window.limit:
            self._rules.unfile(self._open[self._unproven.popleft()], now)
        while self.failure is None and self._waiting and self._may_begin():
            if not self._open and (filed := self._stage_for_file(now)):
                self._begin_upload(filed, now)
                continue
            number = self._waiting.popleft()
            if self._rules.is_switch(self._pairs[number][0]):
                self._barrier = number
            self._begin(number, now)
        if not self._open and (self.failure is not None or not self._waiting):
            self._finish(now)

    def _begin(self, number: int, now: float, *, filed: bool = False) -> None:
        """Begin one write."""
        name, value = self._pairs[number]
        try:
            write = self._rules.begin(name, value, now, filed)
        except ParamClientError as error:
            if self._barrier == number:
                self._barrier = None
            self._not_begun(number, error)
            return
        if not write.done:
            write.on_acknowledged.append(self._acknowledged)
        self._follow(number, write)

    # by one file

    def _stage_for_file(self, now: float) -> list[int]:
        """Return the pairs up to the next switch that are to be written as one file; none for PARAM_SET."""
        uploads = self._rules.uploads
        if uploads is None or not uploads.is_served(now):
            return []
        numbers: list[int] = []
        params: list[Param] = []
        names = set()
        for number in self._waiting:
            name = self._pairs[number][0]
            if self._rules.is_switch(name):
                break
            param = self._rules.fileable(name)
            if param is not None and param.name not in names:
                numbers.append(number)
                params.append(param)
            elif param is not None:
                break  # the values of one name follow each other
            if param is not None:
                names.add(param.name)
        return numbers if uploads.is_quicker(params) else []

    def _begin_upload(self, numbers: Sequence[int], now: float) -> None:
        """Begin the writes of these pairs, and write their values as one file."""
        filed = frozenset(numbers)
        self._waiting = deque(number for number in self._waiting if number not in filed)
        entries: dict[str, PackedParam] = {}
        for number in numbers:
            self._begin(number, now, filed=True)
            write = self._open.get(number)
            if write is not None and write.filed_as is not None:
                entries[write.name] = write.filed_as
        if not entries:
            return
        uploads = self._rules.uploads
        assert uploads is not None
        hooks = UploadHooks(self._commit, self._rules.receive)
        upload = self._upload = uploads.begin(entries, hooks, now)
        if upload.done:
            self._upload_ended(upload)
        else:
            upload.on_done.append(partial(self._upload_ended, upload))

    def _commit(self, now: float) -> bool:
        """Record that the vehicle may take the file, if that is still the vehicle."""
        if not self._rules.may_commit() or self.failure is not None:
            return False
        for write in self._open.values():
            if write.is_filed:
                self._rules.committed(write, now)
        return True

    def _upload_ended(self, upload: ParamUpload) -> None:
        """Continue with PARAM_SET what the file has not proven."""
        self._upload = None
        self._unproven.extend(number for number, write in self._open.items() if write.is_filed)
        self.proceed(upload.ended_at)

    def _cancel_upload(self, now: float) -> None:
        upload, self._upload = self._upload, None
        self._unproven.clear()
        if upload is not None:
            upload.cancel(now)

    # the end

    def interrupt(self, error: ParamClientError, now: float) -> None:
        """Begin no further write and end an upload; `Writes` ends the open writes."""
        super().interrupt(error, now)
        self._cancel_upload(now)

    def give_up(self, error: ParamClientError, now: float) -> None:
        """See `BulkWrites.give_up`."""
        if not self.done:
            self._cancel_upload(now)
        super().give_up(error, now)

    def discard(self, now: float) -> None:
        """See `BulkWrites.discard`."""
        self._cancel_upload(now)
        super().discard(now)

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
        return sum(write.acknowledged is None and not write.is_filed for write in self._open.values())

    def _acknowledged(self, now: float) -> None:
        """Begin further writes while the value of one is watched."""
        self._window.acknowledged()
        self.proceed(now)

    def _ended(self, number: int, write: Write) -> None:
        if write.result is not None and write.acknowledged is None and not write.is_filed:
            self._window.acknowledged()
        self._take(number, write)
        if self._upload is None or not write.is_filed:
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
    follow each other, and a write that other parameters depend on is alone. Between two of these, many values
    for ArduPilot are written as one file if that should be quicker (see `Uploads`). A value that the file
    does not prove is then sent by PARAM_SET, whose outcome counts. A write that fails does not stop the
    others, unless the component is lost, the link fails, or `UNANSWERED_WRITES_MAX` writes in a row get no
    response.

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
