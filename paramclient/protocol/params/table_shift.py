"""A table followed by single reads after parameters were added or removed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Final, NamedTuple

from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.requests.operation import Operation

__all__ = [
    "SEARCH_ROUNDS",
    "CountChange",
    "ShiftedOrder",
    "TableShift",
    "reads_expected",
    "search_reads_expected",
]

CONTROL_READS: Final = 4
"""Reads spread over the table, which show a second change elsewhere. Together with the last index they are
the 5 reads that ArduPilot answers at once."""
READS_AROUND: Final = 2
"""Reads for each switch besides those of its group: the switch, and the parameter behind the group."""
SPLITS: Final = 3
"""Reads that divide a gap in which the indices shift: 1,400 indices take 5 rounds of them."""
SEARCH_ROUNDS: Final = 6
"""Round trips until a group of an unknown place in such a table is found: those, and the group itself."""
NEIGHBOURS: Final = 5
"""Reads on each side of an added parameter that was found: a group lies side by side."""


class CountChange(NamedTuple):
    """One change of the number of parameters.

    Attributes:
        switch: the parameter whose new value is its probable cause; "" if none is known.
        added: parameters more than before; negative if there are fewer.
    """

    switch: str
    added: int


def reads_expected(changes: Iterable[CountChange]) -> int:
    """Return the number of reads that find the parameters that these changes have added or removed, if each
    group lies behind its switch."""
    around = sum(READS_AROUND + max(change.added, 0) for change in changes)
    return around + CONTROL_READS + 1


def search_reads_expected(changes: Iterable[CountChange]) -> int:
    """Return the same if nothing shows where the adjacent parameters are."""
    around = sum(2 * NEIGHBOURS + max(change.added, 0) for change in changes)
    return around + SPLITS * (SEARCH_ROUNDS - 1) + CONTROL_READS + 1


class ShiftedOrder:
    """The order of a table after additions or removals, but not both, as far as some indices show it.

    The parameters that stay keep their relative order. Two of them whose distance is unchanged therefore have
    nothing new and nothing missing between them.

    Args:
        order: the names by index before.
        count: parameters since.
    """

    def __init__(self, order: Sequence[str], count: int) -> None:
        self._order = order
        self._places = {name: index for index, name in enumerate(order)}
        self._count = count
        self._adds = count > len(order)
        self._names: dict[int, str] = {}

    def add(self, index: int, name: str) -> None:
        """Record the name at an index."""
        self._names[index] = name

    def first_indices(self, changes: Iterable[CountChange]) -> list[int]:
        """Return the indices that show everything if each group lies behind its switch."""
        last = self._count - 1
        indices = {last, *(last * number // (CONTROL_READS + 1) for number in range(1, CONTROL_READS + 1))}
        known = sorted(
            (self._places[each.switch], each.added) for each in changes if each.switch in self._places
        )
        shift = 0
        for place, added in known:
            at = place + shift
            indices.update(range(at, at + max(added, 0) + READS_AROUND))
            shift += added
        return sorted(index for index in indices if 0 <= index <= last)

    def next_indices(self) -> list[int] | None:
        """Return indices whose names narrow the changes down, rising; none when the order is known.

        Returns None if the names contradict the premise.
        """
        if len(set(self._names.values())) < len(self._names):
            return None
        indices: set[int] = set()
        for (start, place), (end, next_place) in pairwise(self._kept()):
            added = (end - start) - (next_place - place)
            found = [index for index in self._added if start < index < end]
            if (
                next_place <= place
                or len(found) > max(added, 0)
                or (added != 0 and (added > 0) != self._adds)
            ):
                return None
            if added > len(found) or (added < 0 and end - start > 1):
                indices.update(self._within(start, end, found, added))
        return sorted(indices)

    def names(self) -> dict[int, str]:
        """Return the names by index, when `next_indices` returns none."""
        names = dict(self._names)
        for (start, place), (end, _) in pairwise(self._kept()):
            for index in range(start + 1, end):
                if index not in names:
                    place += 1
                    names[index] = self._order[place]
        return names

    @property
    def _added(self) -> list[int]:
        """The known indices of added parameters, rising."""
        return sorted(index for index, name in self._names.items() if name not in self._places)

    def _kept(self) -> list[tuple[int, int]]:
        """Return the known indices of parameters that stay, each with its index before, and both ends."""
        kept = ((index, self._places.get(name, -1)) for index, name in self._names.items())
        inner = sorted(each for each in kept if each[1] >= 0)
        return [(-1, -1), *inner, (self._count, len(self._order))]

    def _within(self, start: int, end: int, found: Sequence[int], added: int) -> Iterable[int]:
        """Return the next indices to read between two parameters that stay."""
        unread = [index for index in range(start + 1, end) if index not in self._names]
        if len(unread) <= max(added, 0) - len(found) + NEIGHBOURS:
            return unread
        if found:
            near = range(-NEIGHBOURS, NEIGHBOURS + 1)
            beside = {index + distance for index in found for distance in near}
            return beside.intersection(unread)
        return {start + (end - start) * number // (SPLITS + 1) for number in range(1, SPLITS + 1)}


class TableShift(Operation[Mapping[int, str] | None]):
    """Reads of the indices where a table has changed. Ends with all names by index.

    Ends with None if the reads do not show the table: a read has failed, the number of parameters has changed
    again, the names contradict the premise of `ShiftedOrder`, or more reads would be necessary than are
    allowed. The values of all responses are then in the table.

    Args:
        reads: the component's.
        order: the names by index before the changes.
        count: the number of parameters since.
        changes: the changes of that number, in order.
        now: the time.
        reads_max: reads that are allowed.
    """

    def __init__(
        self,
        reads: Reads,
        order: Sequence[str],
        count: int,
        changes: Sequence[CountChange],
        now: float,
        *,
        reads_max: int,
    ) -> None:
        super().__init__(now)
        self._reads = reads
        self._count = count
        self._left = reads_max
        self._order = ShiftedOrder(order, count)
        self._open: dict[int, Read] = {}
        self._ask(self._order.first_indices(changes), now)

    def cancel(self) -> None:
        """Cancel the reads."""
        left, self._open = self._open, {}
        for read in left.values():
            self._reads.release(read)

    def _ask(self, indices: Sequence[int], now: float) -> None:
        self._left -= len(indices)
        if self._left < 0:
            self.finish(None, now)
            return
        self._open = {index: self._reads.ask(index, now, urgent=False) for index in indices}
        for index, read in self._open.items():
            read.on_done.append(partial(self._take_value, index, read))

    def _take_value(self, index: int, read: Read) -> None:
        if self._open.get(index) is not read:
            return
        del self._open[index]
        now = read.ended_at
        if read.result is None or read.result.param_count != self._count:
            self.cancel()
            self.finish(None, now)
            return
        self._order.add(index, read.result.param_id)
        if self._open:
            return
        indices = self._order.next_indices()
        if indices is None:
            self.finish(None, now)
        elif indices:
            self._ask(indices, now)
        else:
            self.finish(self._order.names(), now)
