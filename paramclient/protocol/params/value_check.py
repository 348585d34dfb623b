"""Values that may be older than a change: which ones are ambiguous, and when they are read again."""

from __future__ import annotations

import math
from typing import Final

from paramclient.protocol.params.change_origin import Authors
from paramclient.protocol.params.fetch_result import Policy
from paramclient.protocol.params.reads import Reads
from paramclient.protocol.params.sync import Sync
from paramclient.protocol.params.table import Table
from paramclient.protocol.params.writes import Write
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.wire import ParamExtValue, ParamValue

__all__ = ["LATER_CHANGE_TIME", "READS_PAUSE", "REREADS_MAX", "Rereads", "ValueChecks"]

AMBIGUITY_WINDOW: Final = 0.3
"""Seconds after a change in which a PARAM_VALUE with the previous value is ambiguous: ArduPilot takes the
value of a read when it queues the response, and sends it up to 100 ms later. Jitter adds to that."""
LATER_CHANGE_TIME: Final = 1.2
"""Seconds from the acknowledgement until a value is read again on PX4, whose modules clamp the value, or set
other parameters, up to 1.1 s after it (measured)."""
LATE_ANSWER_TIME: Final = 1.0
"""Seconds after a request was sent in which its response may still arrive."""
REREADS_MAX: Final = 256
"""Open reads of a component above which no value is read again: each uses bandwidth."""
READS_PAUSE: Final = 0.1
"""Seconds until the next attempt to read a value again when too many reads are open."""
REPLACED_MAX: Final = 4_096
"""Names with a remembered previous value, more than an autopilot has; the oldest is dropped first."""


class Rereads(Machine):
    """Reads values again whose last observation may be older than a change, or that may have been clamped.

    Args:
        context, reads, table, sync: the component's.
        policy: whether reads are allowed.

    Attributes:
        authors: the authors of changes.
        checks: the previous values, and the values to be read again.
    """

    def __init__(self, context: Context, reads: Reads, table: Table, sync: Sync, policy: Policy) -> None:
        self._context = context
        self.authors = Authors()
        self.checks = ValueChecks()
        self._reads = reads
        self._table = table
        self._sync = sync
        self._fetch_policy = policy

    def write_ended(self, write: Write, now: float) -> None:
        """Plan to read a value after a write, where the vehicle may change it without a PARAM_VALUE."""
        if (
            self._context.is_px4
            and write.result is not None
            and self._fetch_policy is Policy.AUTO
            and not write.settle
        ):
            self.checks.ask(write.name, now + LATER_CHANGE_TIME)

    def forget_old(self, now: float) -> None:
        """Drop expired entries; once a second is enough."""
        self.authors.forget(now)
        self.checks.forget(now)

    def clear(self) -> None:
        """Drop everything: the vehicle has restarted."""
        self.authors.clear()
        self.checks.clear()

    def tick(self, now: float) -> None:
        """Read the values that are due."""
        for name in self.authors.doubted(now):
            if self._fetch_policy is Policy.AUTO:
                self._read(name, now)
        if self.checks.next_deadline() <= now:
            self._read_due(now)

    def next_deadline(self) -> float:
        """See `Machine`."""
        return min(self.authors.next_deadline(), self.checks.next_deadline())

    def fail_all(self, error: Exception, now: float) -> None:
        """Read nothing any more."""
        self.clear()

    def _read_due(self, now: float) -> None:
        """Read the values that are due, by the hash alone as far as the hash proves them."""
        names = self.checks.due(now)
        if self._context.is_px4 and self._sync.may_resync and self._table.is_provable:
            names = [name for name in names if not self._table.is_hashed(name)]
            self._sync.ask(now)
        for name in names:
            if self._fetch_policy is not Policy.AUTO:
                self._table.doubt_value(name)
            elif not self._read(name, now):
                self.checks.ask(name, now + READS_PAUSE)

    def _read(self, name: str, now: float) -> bool:
        """Request a value; return False if too many reads are open."""
        is_free = len(self._reads) < REREADS_MAX
        if is_free:
            self._reads.ask(name, now, urgent=False)
        return is_free


class ValueChecks:
    """The previous values of one component's parameters, and which parameters to read again, and when.

    The rule: a value that may be older than a change is not an observation of the present. Within
    `AMBIGUITY_WINDOW` of a change only the previous value is ambiguous: it may have been taken before the
    change, or be a change back. It is ignored, and the parameter is read again at the end of that time. Every
    other value counts.

    This applies to responses to reads and to lists. During a file read, PARAM_VALUEs have precedence anyway.
    """

    __slots__ = ("_ask_at", "_replaced")

    def __init__(self) -> None:
        self._replaced: dict[str, dict[tuple[int, bytes], tuple[float, bool]]] = {}
        self._ask_at: dict[str, float] = {}

    def __bool__(self) -> bool:
        """Return whether any previous value is remembered."""
        return bool(self._replaced)

    def replaced(
        self, name: str, number: int, old: bytes, new: ParamValue | ParamExtValue, now: float, sent_at: float
    ) -> None:
        """Record that a value has changed.

        Args:
            name: param_id.
            number: the type of the previous value.
            old: its 4 bytes, as in a message.
            new: the message with the present value.
            now: the time.
            sent_at: when the last read of any parameter was sent: without a read, no response can be late.
        """
        values = self._replaced.pop(name, {})
        values.pop((new.param_type, new.raw), None)
        values[number, old] = (now + AMBIGUITY_WINDOW, now - sent_at < LATE_ANSWER_TIME)
        self._replaced[name] = values
        if len(self._replaced) > REPLACED_MAX:
            del self._replaced[next(iter(self._replaced))]

    def ambiguous_until(
        self, message: ParamValue | ParamExtValue, now: float, *, is_requested: bool
    ) -> float:
        """Return until when the value of a message may be older than the last change.

        Args:
            message: the PARAM_VALUE.
            now: the time.
            is_requested: whether it has the value of an active PARAM_SET. Then it counts, unless it may be
                the response to an earlier read.

        Returns:
            A time after `now`, or -infinity if the value is not ambiguous.
        """
        values = self._replaced.get(message.param_id)
        until, was_read = -math.inf, True
        if values is not None:
            until, was_read = values.get((message.param_type, message.raw), (until, was_read))
        return until if until > now and (was_read or not is_requested) else -math.inf

    def ask(self, name: str, at: float) -> None:
        """Plan to read a value again at a time, or at a later one that is already planned."""
        self._ask_at[name] = max(at, self._ask_at.get(name, at))

    def due(self, now: float) -> list[str]:
        """Take the names whose values are to be read now."""
        names = [name for name, at in self._ask_at.items() if at <= now]
        for name in names:
            del self._ask_at[name]
        return names

    def next_deadline(self) -> float:
        """Return when `due` has names, or infinity."""
        return min(self._ask_at.values(), default=math.inf)

    def forget(self, now: float) -> None:
        """Drop expired entries; once a second is enough."""
        if self._replaced:
            self._replaced = {
                name: values
                for name, values in self._replaced.items()
                if any(until > now for until, _ in values.values())
            }

    def clear(self) -> None:
        """Drop everything: the vehicle has restarted, or is another one."""
        self._replaced.clear()
        self._ask_at.clear()
