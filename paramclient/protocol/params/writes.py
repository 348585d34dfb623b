"""PARAM_SET: acknowledgement, verification, retries, and one queue per name."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, Protocol

from paramclient.errors import (
    NoReply,
    ParamErrorCode,
    TypeMismatch,
    UsageError,
    ValueNotApplied,
)
from paramclient.model.values import (
    Param,
    ParamType,
    Trust,
    Value,
    WireValue,
    decode_value,
    encode_value,
    format_value,
    type_name,
)
from paramclient.protocol.params.change_origin import by_us
from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.small_changes import note_on_small_change
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import RetryPolicy, WriteAttempts
from paramclient.protocol.wire import ParamError, ParamSetMessage, ParamValue

__all__ = ["SetResult", "Write", "Writes"]


@dataclass(frozen=True, slots=True)
class SetResult:
    """The outcome of a `set`.

    Attributes:
        name: param_id.
        status: "accepted" (the vehicle holds the requested value, as far as the type can represent it), or
            "adjusted" (the vehicle changed the value: ArduPilot makes 1234 of 1234.7 for an integer; modules
            of PX4 change values up to 1.1 s later, which is seen while the value is watched).
        requested: the requested value: a number, or bytes if bytes were requested.
        param: the parameter as it is now.
        attempts: PARAM_SETs sent.
        note: a further sentence: PX4 does not save a change as small as this one.
    """

    name: str
    status: Literal["accepted", "adjusted"]
    requested: WireValue
    param: Param
    attempts: int
    note: str = ""

    @property
    def actual(self) -> Value:
        """The value that the vehicle reports: `param.value`."""
        return self.param.value

    @property
    def adjusted(self) -> bool:
        return self.status == "adjusted"

    def __str__(self) -> str:
        number = self.param.type_number
        actual = format_value(self.param.settable, number)
        if self.adjusted:
            return f"{self.name} = {actual} (adjusted from {format_value(self.requested, number)})"
        return f"{self.name} = {actual}"


class Write(Operation[SetResult]):
    """One PARAM_SET until its value is confirmed; see `Writes`.

    Attributes:
        request: its attempts.
        settle: seconds from the acknowledgement until the value is read once more.
        is_forced: whether a value that the vehicle cannot store is sent anyway.
        acknowledged: the result so far, while the value is watched for `settle` seconds.
        on_acknowledged: called with the time when that begins.
    """

    def __init__(
        self,
        name: str,
        value: WireValue,
        policy: RetryPolicy,
        begun_at: float,
        author: str | None = None,
        *,
        settle: float = 0.0,
        is_forced: bool = False,
    ) -> None:
        super().__init__(begun_at)
        self.name = name
        self.value = value
        self.by = by_us(author)
        self.settle = settle
        self.is_forced = is_forced
        self.acknowledged: SetResult | None = None
        self.on_acknowledged: list[Callable[[float], None]] = []
        self.request = WriteAttempts(policy)
        self.number = 0  # the type that was sent
        self.wanted: Param | None = None
        self.before: Param | None = None
        self.is_answered = False  # a value other than the requested one was received after the last PARAM_SET
        self.seen_after_set: Param | None = None  # the value after an earlier PARAM_SET, if not the old one
        self.verify_at = math.inf
        self.read: Read | None = None
        self.was_retyped = False

    @property
    def attempts(self) -> int:
        """PARAM_SETs sent."""
        return self.request.count


class WritePermission(Protocol):
    """Says whether writes are permitted.

    Queried before each PARAM_SET rather than set on the context: it depends on other components of the
    vehicle, and a stale permission could send a write to another vehicle.
    """

    @property
    def may_be_written(self) -> bool:
        """See `ComponentMachine.may_be_written`."""


class Writes(Machine):
    """The writes to one component: in order for one name, in parallel for different names.

    The steps of a write: learn the type (unless it was received or verified on this link), send exactly that
    type, wait for a PARAM_VALUE of the name. Only the requested value proves success. Another value may be
    the response to an old read, or part of a list: wait a little, read by name, then decide. A value that is
    neither the old nor the requested one may be the vehicle's adjustment, or a PARAM_SET of another station
    that was received between: the PARAM_SET is sent again, and an equal result is the adjustment. The old
    value means that nothing was applied; the PARAM_SET may have been lost and is sent again until loss is
    unlikely.

    If the caller requests it, the value is watched for a while after that and then read once more: a
    different value is then the vehicle's adjustment. The write is acknowledged during this time, so that
    changes of the value are not ours, but the next write to the name waits.

    Nothing is sent until the component's encoding is certain: an integer in the wrong encoding would be taken
    as another number.

    Args:
        context, reads, table: the component's.
        permission: says whether writes are permitted.

    Attributes:
        queues: open writes by name, the active one first; no name has an empty queue.
        is_awaiting_permission: whether a write waits for the permission.
        begun, retries: writes so far, and repeated PARAM_SETs.
        against_non_finite: why NaN and infinity must not be sent to the vehicle; "" where they may.
        on_outcome_unknown: called with the name and the author of a write that ended with its outcome
            unknown.
    """

    def __init__(
        self,
        context: Context,
        reads: Reads,
        table: Table,
        permission: WritePermission,
    ) -> None:
        self._context = context
        self._target = context.target
        self._retry_policy = context.retry
        self._send = context.send
        self._reads = reads
        self._table = table
        self._params: Mapping[str, Param] = table.params
        self._permission = permission
        self._trace = context.trace
        self.begun = self.retries = 0
        self.is_awaiting_permission = False
        self.against_non_finite = ""
        self.queues: dict[str, deque[Write]] = {}
        self.on_outcome_unknown: Callable[[str, str, float], None] = _ignore

    def __len__(self) -> int:
        return len(self.queues)

    def author(self, name: str) -> str | None:
        """Return the author of an active PARAM_SET to this name, or None."""
        write = self._active(name)
        return None if write is None else write.by

    def set(
        self,
        name: str,
        value: WireValue,
        now: float,
        author: str | None = None,
        *,
        settle: float = 0.0,
        force: bool = False,
    ) -> Write:
        """Begin a write, after the open ones to the same name."""
        write = Write(name, value, self._retry_policy, now, author, settle=settle, is_forced=force)
        self.begun += 1
        queue = self.queues.setdefault(name, deque())
        queue.append(write)
        self._context.is_writing = True
        if len(queue) == 1:
            self._start(write, now)
        return write

    def check_finite(self, name: str, value: WireValue, *, force: bool) -> None:
        """Check that a value may be sent as far as it must be a finite number.

        Raises:
            UsageError: the value is NaN or infinite, and the vehicle must not receive that.
        """
        if isinstance(value, float) and not math.isfinite(value) and self.against_non_finite and not force:
            raise UsageError(
                f"{name} = {value} was not sent to {self._target[0]}/{self._target[1]}: "
                f"{self.against_non_finite}. Force it to send it all the same."
            )

    def cancel(self, write: Write, now: float) -> None:
        """Cancel a write. A PARAM_SET that was sent cannot be recalled: the vehicle may have applied it."""
        queue = self.queues.get(write.name)
        if queue is None or write not in queue:
            return
        if queue[0] is write:
            self._report_outcome_unknown(write, now)
            self._leave(write, now)
        else:
            queue.remove(write)

    def proceed(self, now: float) -> None:
        """Begin the writes that waited for the permission."""
        self.is_awaiting_permission = False
        for queue in list(self.queues.values()):
            if queue and not queue[0].attempts and queue[0].read is None:
                self._start(queue[0], now)

    def wants(self, message: ParamValue) -> bool:
        """Return whether a PARAM_VALUE has the value of the active PARAM_SET to its name."""
        write = self._active(message.param_id)
        wanted = None if write is None else write.wanted
        if wanted is None or wanted.type_number != message.param_type:
            return False
        return wanted.bits == decode_value(message.raw, message.param_type, self._table.encoding)[1]

    def receive(self, message: ParamValue, now: float) -> None:
        """Process a PARAM_VALUE of the component, after the table has stored it."""
        write = self._active(message.param_id)
        if write is None:
            return
        value, bits = decode_value(message.raw, message.param_type, self._table.encoding)
        received = Param(write.name, value, message.param_type, None, bits)
        if message.param_type != write.number:
            if write.was_retyped:
                reported = type_name(received.type_number)
                words = f"it is written as {type_name(write.number)} and reported as {reported}"
                self._fail(write, self._type_mismatch(write, words), now)
            else:
                write.was_retyped = True
                self._begin(write, received, now)
        elif write.wanted is not None and write.wanted.same_value(received):
            is_sure = write.read is None and not write.is_answered
            write.request.answered(now, is_sure=is_sure)
            self._succeed(write, now)
        else:
            if write.read is None:
                write.is_answered = True
                write.verify_at = min(write.verify_at, now + write.request.old_value_delay)

    def defer(self, message: ParamValue, until: float) -> None:
        """Process a PARAM_VALUE that may be older than the last change: it proves nothing.

        If it has the requested value, the parameter is read at `until` to decide.
        """
        write = self._active(message.param_id)
        if write is not None and write.read is None and self.wants(message):
            write.is_answered = True
            write.verify_at = min(write.verify_at, until)

    def refused(self, message: ParamError, now: float) -> bool:
        """Process a PARAM_ERROR and return whether it ended a write."""
        write = self._active(message.param_id) if message.param_index < 0 or message.param_id else None
        if write is None:
            return False
        self._fail(write, self._reads.error_of(message, write.name), now)
        return True

    def denied(self, name: str, now: float) -> None:
        """Process ArduPilot's STATUSTEXT that a write to this name was denied."""
        write = self._active(name)
        if write is not None:
            message = ParamError(0, 0, name, -1, ParamErrorCode.READ_ONLY)
            self._fail(write, self._reads.error_of(message, name), now)

    def tick(self, now: float) -> None:
        """Verify, repeat and give up writes; nothing while writes are not permitted."""
        if not self._permission.may_be_written:
            return
        # all by one timeout: the first of them may change it
        overdue = {queue[0] for queue in self.queues.values() if queue[0].request.due_at <= now}
        for queue in list(self.queues.values()):
            if not queue:
                continue
            write = queue[0]
            if write.verify_at <= now:  # also for a watched write at the end of that time
                write.verify_at = math.inf
                self._read(write, now)
            elif write in overdue and self._awaits_answer(write) and not write.is_answered:
                write.request.timed_out()
                if write.request.should_give_up(now):
                    # reads in between have shown that nothing was applied
                    self._fail(write, self._not_applied(write, self._params[write.name]), now)
                    continue
                self._transmit(write, now)
                if write.request.needs_read and not write.done:
                    self._read(write, now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        earliest = math.inf
        if not self.queues or not self._permission.may_be_written:
            return earliest
        for queue in self.queues.values():
            write = queue[0]
            earliest = min(earliest, write.verify_at)
            if self._awaits_answer(write) and not write.is_answered:
                earliest = min(earliest, write.request.due_at)
        return earliest

    def resume(self, now: float) -> None:
        """Continue active writes at once: the link is back."""
        for queue in list(self.queues.values()):
            if queue and self._awaits_answer(queue[0]):
                if self._permission.may_be_written:
                    queue[0].request.uncount()
                self._transmit(queue[0], now)

    def lose(self, now: float) -> None:
        """End all writes: the component is lost. Whether it applied them is unknown."""
        self._end_all(lambda write: self._no_reply(write, now, " (lost)"), now)

    def fail_all(self, error: Exception, now: float) -> None:
        """End all writes with the error."""
        self._end_all(lambda write: error, now)

    def _end_all(self, error_of: Callable[[Write], Exception], now: float) -> None:
        queues, self.queues = self.queues, {}
        self._context.is_writing = False
        for queue in queues.values():
            for write in queue:
                if write.read is not None:
                    self._reads.release(write.read)
                    write.read = None
                write.fail(error_of(write), now)

    def _active(self, name: str) -> Write | None:
        """Return the write whose PARAM_SET to this name is in flight and not acknowledged."""
        queue = self.queues.get(name)
        return queue[0] if queue and queue[0].attempts and queue[0].acknowledged is None else None

    @staticmethod
    def _awaits_answer(write: Write) -> bool:
        return write.attempts > 0 and write.acknowledged is None and write.read is None

    def _start(self, write: Write, now: float) -> None:
        known = self._params.get(write.name)
        if not self._permission.may_be_written:
            self.is_awaiting_permission = True
            return
        if known is not None and known.trust is not Trust.CACHED:
            self._begin(write, known, now)
        else:
            self._read(write, now)

    def _begin(self, write: Write, known: Param, now: float) -> None:
        write.before = known
        write.number = known.type_number
        self._transmit(write, now)

    def _transmit(self, write: Write, now: float) -> None:
        if not self._permission.may_be_written:
            # the write is not meant for whichever vehicle is there now: it begins, or is overdue, once that
            # is known
            self.is_awaiting_permission = True
            write.request.sent_at = -math.inf
            write.is_answered = False
            write.verify_at = math.inf
            return
        raw = self._prepare(write, now)
        if raw is None:
            return
        write.request.sent(now)
        self.retries += write.attempts > 1
        write.is_answered = False
        write.verify_at = math.inf
        self._send(ParamSetMessage(*self._target, write.name, raw, write.number))

    def _prepare(self, write: Write, now: float) -> bytes | None:
        """Set the value that proves the write, and return its 4 bytes; end the write if it cannot be sent."""
        encoding = self._table.encoding
        known = write.before
        if known is not None and known.is_raw and write.value == known.value and not write.is_forced:
            self._fail(write, self._raw_number(write, known), now)
            return None
        try:
            raw = encode_value(write.value, write.number, encoding)
        except UsageError as error:
            # something was sent before, and the vehicle has turned out to be a different one
            self._fail(write, self._type_mismatch(write, str(error)) if write.was_retyped else error, now)
            return None
        value, bits = decode_value(raw, write.number, encoding)
        try:
            self.check_finite(write.name, value, force=write.is_forced)
        except UsageError as error:
            self._fail(write, error, now)
            return None
        write.wanted = Param(write.name, value, write.number, None, bits)
        return raw

    def _read(self, write: Write, now: float) -> None:
        """Read the vehicle's value: before the first PARAM_SET for the type, later to decide."""
        read = write.read = self._reads.ask(write.name, now)

        def answered() -> None:
            if write.read is not read:
                return  # ended meanwhile, or cancelled
            write.read = None
            if isinstance(read.error, NoReply) and write.attempts:
                self._fail(write, self._no_reply(write, read.ended_at), read.ended_at)
            elif read.error is not None:
                self._fail(write, read.error, read.ended_at)
            elif write.acknowledged is not None:
                self._end_settling(write, write.acknowledged, read.ended_at)
            elif write.attempts:
                self._decide(write, self._params[write.name], read.ended_at)
            else:
                self._begin(write, self._params[write.name], read.ended_at)

        read.on_done.append(answered)

    def _decide(self, write: Write, actual: Param, now: float) -> None:
        """Decide after a read that followed the PARAM_SET and showed a value other than the requested one."""
        is_made_again = write.seen_after_set is not None and write.seen_after_set.same_value(actual)
        if write.is_answered and is_made_again:
            self._succeed(write, now)
        elif write.request.should_give_up(now):
            self._fail(write, self._not_applied(write, actual), now)
        else:
            is_old = write.before is not None and write.before.same_value(actual)
            write.seen_after_set = None if is_old else actual
            self._transmit(write, now)

    def _succeed(self, write: Write, now: float) -> None:
        actual = self._params[write.name]
        wanted = write.wanted
        exact = wanted is not None and wanted.same_value(actual)
        if exact and actual.type_number != ParamType.REAL32 and not isinstance(write.value, bytes):
            exact = actual.settable == write.value
        status: Literal["accepted", "adjusted"] = "accepted" if exact else "adjusted"
        before = write.before if self._context.is_px4 else None
        note = "" if before is None else note_on_small_change(before, actual)
        result = SetResult(write.name, status, write.value, actual, write.attempts, note)
        self._trace("%s/%s %s: %s after try %s", *self._target, write.name, status, write.attempts)
        if write.settle > 0.0:
            if write.read is not None:
                self._reads.release(write.read)
                write.read = None
            write.acknowledged = result
            write.verify_at = now + write.settle
            for callback in write.on_acknowledged:
                callback(now)
            return
        self._leave(write, now)
        write.finish(result, now)

    def _end_settling(self, write: Write, result: SetResult, now: float) -> None:
        """Compare the value that was read after the watch with the acknowledged one."""
        actual = self._params[write.name]
        if not result.param.same_value(actual):
            result = replace(result, status="adjusted")
        self._leave(write, now)
        write.finish(replace(result, param=actual), now)

    def _fail(self, write: Write, error: Exception, now: float) -> None:
        if isinstance(error, NoReply):
            self._report_outcome_unknown(write, now)
        self._leave(write, now)
        self._trace("%s/%s %s: not written: %s", *self._target, write.name, error)
        write.fail(error, now)

    def _report_outcome_unknown(self, write: Write, now: float) -> None:
        if write.attempts and write.acknowledged is None:
            self.on_outcome_unknown(write.name, write.by, now)

    def _leave(self, write: Write, now: float) -> None:
        if write.read is not None:
            self._reads.release(write.read)
            write.read = None
        queue = self.queues[write.name]
        queue.remove(write)
        if queue:
            self._start(queue[0], now)
        else:
            del self.queues[write.name]
            self._context.is_writing = bool(self.queues)

    def _no_reply(self, write: Write, now: float, why: str = "") -> Exception:
        what = f"PARAM_SET {write.name} to {self._target[0]}/{self._target[1]}{why}"
        if write.acknowledged is not None:
            what += ": it was acknowledged, and could not be read once more"
        return NoReply(what, attempts=write.attempts, waited=now - write.begun_at)

    def _not_applied(self, write: Write, actual: Param) -> Exception:
        system, component = self._target
        number = actual.type_number
        return ValueNotApplied(
            f"{system}/{component} keeps {write.name} at {format_value(actual.settable, number)}; "
            f"{format_value(write.value, number)} was sent {write.attempts} times",
            system=system,
            component=component,
            name=write.name,
            requested=write.value,
            actual=actual.settable,
        )

    def _raw_number(self, write: Write, known: Param) -> UsageError:
        return UsageError(
            f"{write.name} = {known.value} was not sent: this is the number of the raw bytes that "
            f"{self._target[0]}/{self._target[1]} has instead of a {type_name(known.type_number)}. "
            "Pass `Param.settable`, or force it."
        )

    def _type_mismatch(self, write: Write, words: str) -> Exception:
        system, component = self._target
        return TypeMismatch(
            f"{write.name} of {system}/{component} is not what it was: {words}",
            system=system,
            component=component,
            name=write.name,
        )


def _ignore(_name: str, _by: str, _now: float) -> None:
    return
