"""After a hash hit: read what the hash says nothing about, and learn from it what that is."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Final

from paramclient.errors import ContestedAddress, LinkError
from paramclient.model.values import Trust
from paramclient.protocol.params.hash_exclusions import find_volatile
from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.wire import HASH_CHECK

__all__ = ["Refresh"]

MOST_AT_ONCE: Final = 16
"""Values that are asked for at a time: more than are on their way on any link but one that is fast as well as
far. Each that waits is an object, and 250 vehicles have 14,000 such values together."""


class Refresh(Operation[None]):
    """The reading of values that a confirmed hash does not cover. It ends when each has come or was given up.

    While it is not known which parameters are volatile, that is every value that was not heard on this link.
    Then the hash is asked for once more: if it still holds, what differs from before is volatile, and with
    that the whole set may be proven.

    Args:
        reads: the component's.
        table: what is refreshed.
        confirmed: the hash that the vehicle has just announced for the table.
        again: whether to read all that count as volatile once more, also those heard on this link, and to
            learn nothing from it.
        context: the component's; a write in progress moves the table too.
        now: the time.

    Attributes:
        in_flight: reads that are under way for it.
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
        while self._waiting and self.in_flight < MOST_AT_ONCE:
            name = self._waiting.popleft()
            if name in self._table.params:
                self.in_flight += 1
                read = self._reads.ask(name, now, urgent=False)
                read.on_done.append(partial(self._one_ended, read))

    def _one_ended(self, read: Read) -> None:
        self.in_flight -= 1
        if isinstance(read.error, LinkError | ContestedAddress):
            self._waiting.clear()  # nothing can be asked any more
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
