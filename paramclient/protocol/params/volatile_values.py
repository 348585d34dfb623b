"""Reads of the values that a confirmed hash does not cover, and what they prove about volatile names."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Final

from paramclient.errors import ContestedAddress, LinkError
from paramclient.model.px4_hash import find_volatile
from paramclient.model.values import Trust
from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.wire import HASH_CHECK

__all__ = ["VolatileReads"]

REFRESH_READS_MAX: Final = 16
"""Values requested at a time: more than are in flight on any link except a fast one with a long round trip.
Each waiting read is an object, and 250 vehicles have 14,000 such values together."""


class VolatileReads(Operation[None]):
    """The reads of all values that a confirmed hash does not cover. Ends when each was answered or given up.

    While the volatile parameters are unknown, these are all values that were not received on this link. Then
    the hash is requested once more: if it still holds, values that differ from before are volatile, which may
    prove the whole set.

    Args:
        reads: the component's.
        table: the table to refresh.
        confirmed: the hash that the vehicle has just announced for the table.
        again: whether to read all volatile values once more, also those received on this link, without
            learning from them.
        context: the component's; a write in progress changes the table too.
        now: the time.

    Attributes:
        in_flight: its open reads.
    """

    def __init__(
        self,
        reads: Reads,
        table: Table,
        confirmed: int,
        context: Context,
        now: float,
        *,
        again: bool = False,
    ) -> None:
        super().__init__(now)
        self._reads = reads
        self._table = table
        self._confirmed = confirmed
        self._context = context
        params = table.params
        self._again = again
        names = [name for name in (table.volatile if again else table.unhashed()) if name in params]
        self._before = {name: params[name] for name in names if again or params[name].trust is not Trust.LIVE}
        self._waiting = deque(sorted(self._before))
        self.in_flight = 0
        self._ask(now)
        if not self.in_flight:
            self.finish(None, now)

    def _ask(self, now: float) -> None:
        while self._waiting and self.in_flight < REFRESH_READS_MAX:
            name = self._waiting.popleft()
            if name in self._table.params:
                self.in_flight += 1
                read = self._reads.ask(name, now, urgent=False)
                read.on_done.append(partial(self._one_ended, read))

    def _one_ended(self, read: Read) -> None:
        self.in_flight -= 1
        if isinstance(read.error, LinkError | ContestedAddress):
            self._waiting.clear()  # no further request is possible
        self._ask(read.ended_at)
        if self.in_flight:
            return
        if not (
            self._again or self._table.volatile_known or isinstance(read.error, LinkError | ContestedAddress)
        ):
            again = self._reads.ask(HASH_CHECK, read.ended_at)
            again.on_done.append(partial(self._learn, again))
        self.finish(None, read.ended_at)

    def _learn(self, read: Read) -> None:
        table = self._table
        answer = read.result
        if (
            answer is None
            or int.from_bytes(answer.raw, "little") != self._confirmed
            or self._context.is_writing
        ):
            return
        listed = table.listed_bits()
        if answer.param_count != len(listed) or not table.complete:
            return
        now = table.params
        differ = {name for name, old in self._before.items() if name in now and not now[name].same_value(old)}
        believed = table.volatile | differ
        volatile, is_proven = find_volatile(listed, self._confirmed, believed=believed)
        table.confirm(self._confirmed, volatile if is_proven else believed, proven=is_proven)
