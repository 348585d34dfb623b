"""PARAM_EXT_SET: acknowledgement, progress, verification, retries, and one queue per name."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, Protocol

from paramclient.errors import (
    ExtAckResult,
    ExtSetRefused,
    NoReply,
    SetFailed,
    UsageError,
    ValueNotApplied,
    ValueUnsupported,
)
from paramclient.model.ext_params import ExtParam, ExtValue, encode_ext_value, format_ext_value
from paramclient.model.values import Trust
from paramclient.protocol.ext.reads import ExtRead, ExtReads
from paramclient.protocol.ext.table import ExtTable
from paramclient.protocol.params.change_origin import by_us
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import ExtWriteAttempts, RetryPolicy
from paramclient.protocol.wire import ParamExtAck, ParamExtSet

__all__ = ["ExtSetResult", "ExtWrite", "ExtWrites"]

LATE_ACK_TIME: Final = 2.0
"""Seconds after the end of a write in which a copy of its PARAM_EXT_ACK may still arrive. An acknowledgement
has nothing that says to which of two writes to one name it belongs."""
ENDED_MAX: Final = 1_024
"""Ended writes that are remembered for that time; the oldest is dropped first."""


@dataclass(frozen=True, slots=True)
class ExtSetResult:
    """The outcome of a `set` of an extended parameter.

    Attributes:
        name: param_id.
        status: "accepted" (the component holds the requested value, as far as the type can represent it), or
            "adjusted" (it stored another value).
        requested: the requested value.
        actual: the value that the component holds.
        param: the parameter as it is now.
        attempts: PARAM_EXT_SETs sent since the component last reported progress.
    """

    name: str
    status: Literal["accepted", "adjusted"]
    requested: ExtValue
    actual: ExtValue
    param: ExtParam
    attempts: int

    @property
    def adjusted(self) -> bool:
        return self.status == "adjusted"

    def __str__(self) -> str:
        actual = format_ext_value(self.actual, self.param.type)
        if self.adjusted:
            requested = format_ext_value(self.requested, self.param.type)
            return f"{self.name} = {actual} (adjusted from {requested})"
        return f"{self.name} = {actual}"


class ExtWrite(Operation[ExtSetResult]):
    """One PARAM_EXT_SET until its value is confirmed; see `ExtWrites`.

    Attributes:
        name, value: as requested.
        by: its author.
        request: its attempts.
        wanted: the value as it is sent; None before the type is known.
        is_in_progress: whether the component has reported that it works on it.
    """

    def __init__(
        self, name: str, value: ExtValue, policy: RetryPolicy, begun_at: float, author: str | None
    ) -> None:
        super().__init__(begun_at)
        self.name = name
        self.value = value
        self.by = by_us(author)
        self.request = ExtWriteAttempts(policy)
        self.wanted: ExtParam | None = None
        self.before: ExtParam | None = None
        self.made: ExtParam | None = None  # the value that an earlier PARAM_EXT_SET has led to
        self.adjusted: ExtParam | None = None  # the other value that the component has accepted instead
        self.refusal: ExtSetRefused | None = None  # one that may belong to an earlier write
        self.is_answered = False  # an inconclusive acknowledgement followed the last PARAM_EXT_SET
        self.is_sent = False
        self.verify_at = math.inf
        self.read: ExtRead | None = None

    @property
    def attempts(self) -> int:
        """PARAM_EXT_SETs sent since the component last reported progress."""
        return self.request.count

    @property
    def is_in_progress(self) -> bool:
        return self.request.progress_at is not None


class RecipientCheck(Protocol):
    """Says whether it is certain which vehicle receives a write."""

    @property
    def is_recipient_certain(self) -> bool:
        """Whether no other vehicle may have the address by now."""


class ExtWrites(Machine):
    """The writes of extended parameters to one component: in order for one name, in parallel for different
    names.

    The steps of a write: learn the type (unless it was received on this link), send exactly that type, wait
    for PARAM_EXT_ACK. PARAM_ACK_ACCEPTED with the requested value proves success. PARAM_ACK_IN_PROGRESS
    extends the wait. A refusal is an error.

    Acknowledgements carry no number, and links repeat packets. One with another value, or a refusal shortly
    after another write to the name, may therefore belong to that write: with another value the parameter is
    read, and a refusal counts if the repeated PARAM_EXT_SET is refused again.

    Args:
        context, reads, table: the component's.
        permission: says whether the recipient is certain.
        stored: called with a parameter that a write has proven, its author and the time.

    Attributes:
        queues: open writes by name, the active one first; no name has an empty queue.
        is_awaiting_permission: whether a write waits for the permission.
        left_open: called with the name and the author of a write that ended with its outcome unknown.
    """

    def __init__(
        self,
        context: Context,
        reads: ExtReads,
        table: ExtTable,
        permission: RecipientCheck,
        stored: Callable[[ExtParam, str, float], None],
    ) -> None:
        self._context = context
        self._target = context.target
        self._policy = context.retry
        self._send = context.send
        self._trace = context.trace
        self._reads = reads
        self._table = table
        self._permission = permission
        self._stored = stored
        self._ended_at: dict[str, float] = {}
        self.is_awaiting_permission = False
        self.queues: dict[str, deque[ExtWrite]] = {}
        self.left_open: Callable[[str, str, float], None] = _ignore

    def __len__(self) -> int:
        return len(self.queues)

    def author(self, name: str) -> str | None:
        """Return the author of an active PARAM_EXT_SET to this name, or None."""
        write = self._active(name)
        return None if write is None else write.by

    def set(self, name: str, value: ExtValue, now: float, author: str | None = None) -> ExtWrite:
        """Begin a write, after the open ones to the same name."""
        write = ExtWrite(name, value, self._policy, now, author)
        queue = self.queues.setdefault(name, deque())
        queue.append(write)
        if len(queue) == 1:
            self._start(write, now)
        return write

    def cancel(self, write: ExtWrite, now: float) -> None:
        """Cancel a write. A PARAM_EXT_SET that was sent cannot be recalled."""
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
            if queue and not queue[0].is_sent and queue[0].read is None:
                self._start(queue[0], now)

    def acknowledged(self, message: ParamExtAck, now: float) -> bool:
        """Process a PARAM_EXT_ACK; return whether a write to its name is active."""
        write = self._active(message.param_id)
        if write is None:
            return False
        is_sure = not write.is_answered and write.refusal is None and write.read is None
        if message.param_result == ExtAckResult.IN_PROGRESS:
            write.request.progressed(now, is_sure=is_sure)
            write.is_answered = False
            write.verify_at = math.inf
            self._release(write)  # the value before the end of the work decides nothing
        elif message.param_result == ExtAckResult.ACCEPTED:
            actual = ExtParam.of(message.param_id, message.raw, message.param_type)
            assert write.wanted is not None, "it is active"
            if write.wanted.same_value(actual):
                write.request.answered(now, is_sure=is_sure)
                self._stored(actual, write.by, now)
                self._succeed(write, actual, now)
            else:
                if not self._may_be_late(write, now):
                    write.adjusted = actual
                self._verify_later(write, now)
        else:
            error = self._refusal(write, message.param_result)
            if write.refusal is None and self._may_be_late(write, now):
                write.refusal = error
                self._verify_later(write, now)
            elif not write.is_answered:
                write.request.answered(now, is_sure=is_sure)
                self._fail(write, error, now)
        return True

    def tick(self, now: float) -> None:
        """Verify, repeat and give up writes; nothing while the recipient is in doubt."""
        if not self._permission.is_recipient_certain:
            return
        overdue = {queue[0] for queue in self.queues.values() if queue[0].request.due_at <= now}
        for queue in list(self.queues.values()):
            if not queue:
                continue
            write = queue[0]
            if write.verify_at <= now:
                write.verify_at = math.inf
                if write.refusal is not None:
                    self._transmit(write, now)
                else:
                    self._read(write, now)
            elif write in overdue and self._awaits_answer(write):
                write.request.timed_out()
                if write.request.should_give_up(now):
                    self._give_up(write, now)
                    continue
                self._transmit(write, now)
                if write.request.needs_read and not write.done:
                    self._read(write, now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        earliest = math.inf
        if not self.queues or not self._permission.is_recipient_certain:
            return earliest
        for queue in self.queues.values():
            write = queue[0]
            earliest = min(earliest, write.verify_at)
            if self._awaits_answer(write):
                earliest = min(earliest, write.request.due_at)
        return earliest

    def resume(self, now: float) -> None:
        """Continue active writes at once: the link is back."""
        for queue in list(self.queues.values()):
            if queue and queue[0].is_sent and queue[0].read is None:
                if self._permission.is_recipient_certain and not queue[0].is_in_progress:
                    queue[0].request.uncount()
                self._transmit(queue[0], now)

    def lose(self, now: float) -> None:
        """End all writes: the component is lost. Whether it applied them is unknown."""
        self._end_all(lambda write: self._no_reply(write, now, " (lost)"), now)

    def fail_all(self, error: Exception, now: float) -> None:
        """End all writes with the error."""
        self._end_all(lambda write: error, now)

    def _end_all(self, error_of: Callable[[ExtWrite], Exception], now: float) -> None:
        queues, self.queues = self.queues, {}
        for queue in queues.values():
            for write in queue:
                self._release(write)
                write.fail(error_of(write), now)

    def _active(self, name: str) -> ExtWrite | None:
        """Return the write whose PARAM_EXT_SET to this name is in flight."""
        queue = self.queues.get(name)
        return queue[0] if queue and queue[0].is_sent else None

    @staticmethod
    def _awaits_answer(write: ExtWrite) -> bool:
        return write.is_sent and write.read is None and not write.is_answered

    def _may_be_late(self, write: ExtWrite, now: float) -> bool:
        """Return whether an acknowledgement may belong to an earlier write to the name."""
        return now - self._ended_at.get(write.name, -math.inf) <= LATE_ACK_TIME

    def _verify_later(self, write: ExtWrite, now: float) -> None:
        """Wait a little for another acknowledgement after one that proves nothing."""
        if write.read is None:
            write.is_answered = True
            write.verify_at = min(write.verify_at, now + write.request.old_value_delay)

    def _start(self, write: ExtWrite, now: float) -> None:
        if not self._permission.is_recipient_certain:
            self.is_awaiting_permission = True
            return
        known = self._table.params.get(write.name)
        if known is not None and known.trust is not Trust.CACHED:
            self._begin(write, known, now)
        else:
            self._read(write, now)

    def _begin(self, write: ExtWrite, known: ExtParam, now: float) -> None:
        try:
            raw = encode_ext_value(write.value, known.type)
        except UsageError as error:
            self._fail(write, error, now)
            return
        write.before = known
        write.wanted = ExtParam.of(write.name, raw, known.type)
        self._transmit(write, now)

    def _transmit(self, write: ExtWrite, now: float) -> None:
        write.is_sent = True
        write.is_answered = False
        write.verify_at = math.inf
        if not self._permission.is_recipient_certain:
            # the write is not meant for whichever vehicle is there now: it is overdue once that is known
            self.is_awaiting_permission = True
            write.request.sent_at = -math.inf
            return
        wanted = write.wanted
        assert wanted is not None, "its type is known"
        write.request.sent(now)
        self._send(ParamExtSet(*self._target, write.name, wanted.raw, wanted.type))

    def _read(self, write: ExtWrite, now: float) -> None:
        """Read the component's value: before the first PARAM_EXT_SET for the type, later to decide."""
        read = write.read = self._reads.ask(write.name, now)

        def answered() -> None:
            if write.read is not read:
                return  # ended meanwhile, or cancelled
            write.read = None
            if read.error is not None:
                self._fail(write, read.error, read.ended_at)
                return
            message = read.result
            assert message is not None
            actual = ExtParam.of(message.param_id, message.raw, message.param_type)
            if write.is_sent:
                self._decide(write, actual, read.ended_at)
            else:
                self._begin(write, actual, read.ended_at)

        read.on_done.append(answered)

    def _decide(self, write: ExtWrite, actual: ExtParam, now: float) -> None:
        """Decide after a read that followed the PARAM_EXT_SET."""
        assert write.wanted is not None, "it was sent"
        if write.wanted.same_value(actual):
            self._succeed(write, actual, now)
            return
        is_made_again = write.made is not None and write.made.same_value(actual)
        is_last = write.request.should_give_up(now)
        is_adjusted = write.is_answered or (write.adjusted is not None and write.adjusted.same_value(actual))
        if (write.is_answered and is_made_again) or (is_last and is_adjusted):
            self._succeed(write, actual, now)
        elif is_last:
            self._fail(write, self._not_applied(write, actual), now)
        else:
            # the old value: the PARAM_EXT_SET may be lost, and the acknowledgement that of an earlier write
            is_old = write.before is not None and write.before.same_value(actual)
            is_made = write.is_answered and not (is_old and self._may_be_late(write, now))
            if is_made:
                write.made = actual
            elif not is_made_again:
                write.made = None
            self._transmit(write, now)

    def _succeed(self, write: ExtWrite, actual: ExtParam, now: float) -> None:
        actual = self._table.params.get(write.name, actual)  # with its index
        assert write.wanted is not None, "it was sent"
        status: Literal["accepted", "adjusted"] = (
            "accepted" if write.wanted.same_value(actual) else "adjusted"
        )
        self._trace("%s/%s %s: %s after try %s", *self._target, write.name, status, write.attempts)
        result = ExtSetResult(write.name, status, write.value, actual.value, actual, write.attempts)
        self._leave(write, now)
        write.finish(result, now)

    def _give_up(self, write: ExtWrite, now: float) -> None:
        """End a write without an acknowledgement: with an error that says what was read meanwhile."""
        actual = self._table.params.get(write.name)
        has_read = actual is not None and write.request.needs_read and actual.trust is not Trust.CACHED
        if (
            actual is not None
            and has_read
            and write.adjusted is not None
            and write.adjusted.same_value(actual)
        ):
            self._succeed(write, actual, now)
        elif actual is not None and has_read:
            self._fail(write, self._not_applied(write, actual), now)
        else:
            self._fail(write, self._no_reply(write, now), now)

    def _fail(self, write: ExtWrite, error: Exception, now: float) -> None:
        if isinstance(error, NoReply):
            self._report_outcome_unknown(write, now)
            if write.is_sent:
                error = self._no_reply(write, now)
        self._leave(write, now)
        self._trace("%s/%s %s: not written: %s", *self._target, write.name, error)
        write.fail(error, now)

    def _report_outcome_unknown(self, write: ExtWrite, now: float) -> None:
        if write.is_sent:
            self.left_open(write.name, write.by, now)

    def _leave(self, write: ExtWrite, now: float) -> None:
        self._release(write)
        if write.is_sent:
            self._ended_at.pop(write.name, None)
            self._ended_at[write.name] = now
            if len(self._ended_at) > ENDED_MAX:
                del self._ended_at[next(iter(self._ended_at))]
        queue = self.queues[write.name]
        queue.remove(write)
        if queue:
            self._start(queue[0], now)
        else:
            del self.queues[write.name]

    def _release(self, write: ExtWrite) -> None:
        if write.read is not None:
            read, write.read = write.read, None
            self._reads.release(read)

    def _no_reply(self, write: ExtWrite, now: float, why: str = "") -> NoReply:
        what = f"PARAM_EXT_SET {write.name} to {self._target[0]}/{self._target[1]}{why}"
        if write.is_in_progress:
            what += ": the component works on it"
        return NoReply(what, attempts=write.attempts, waited=now - write.begun_at)

    def _refusal(self, write: ExtWrite, code: int) -> ExtSetRefused:
        system, component = self._target
        kinds = {int(ExtAckResult.VALUE_UNSUPPORTED): ValueUnsupported, int(ExtAckResult.FAILED): SetFailed}
        assert write.wanted is not None, "it was sent"
        value = format_ext_value(write.value, write.wanted.type)
        reason = ExtAckResult.name_of(code)
        return kinds.get(code, ExtSetRefused)(
            f"{system}/{component} did not set {write.name} to {value}: {reason}",
            system=system,
            component=component,
            code=code,
            name=write.name,
        )

    def _not_applied(self, write: ExtWrite, actual: ExtParam) -> Exception:
        system, component = self._target
        value = format_ext_value(write.value, actual.type)
        return ValueNotApplied(
            f"{system}/{component} keeps {write.name} at {format_ext_value(actual.value, actual.type)}; "
            f"{value} was sent {write.attempts} times",
            system=system,
            component=component,
            name=write.name,
            requested=write.value,
            actual=actual.value,
        )


def _ignore(_name: str, _by: str, _now: float) -> None:
    return
