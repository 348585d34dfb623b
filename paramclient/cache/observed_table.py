"""Parameters of a live table as observations to store."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import overload

from paramclient.cache.param_columns import StoredParam, StoredTable
from paramclient.model.params import Params

__all__ = ["ObservedParams", "UnixTimes"]


@dataclass(frozen=True, slots=True)
class UnixTimes:
    """Converts times of a monotonic clock to unix times.

    Attributes:
        at: the current time, in unix seconds: an upper limit of all results.
        ahead: offset of unix time from the monotonic clock, in seconds.
        since, not_before: monotonic times from `since` on give at least the unix time `not_before`, even if
            the computer's clock was set back slightly in between.
    """

    at: float
    ahead: float = 0.0
    since: float = math.inf
    not_before: float = 0.0

    def __call__(self, moment: float) -> float:
        """Return the unix time of a monotonic time."""
        at = moment + self.ahead
        if moment >= self.since and at < self.not_before:
            at = self.not_before
        return min(max(at, 0.0), self.at)

    def of_all(self, moments: Sequence[float]) -> list[float]:
        """Return the unix times of many monotonic times, in a tenth of the time of single calls."""
        times = [moment + self.ahead for moment in moments]
        was_set_back = self.since + self.ahead < self.not_before
        if times and (was_set_back or min(times) < 0.0 or max(times) > self.at):
            return [self(moment) for moment in moments]
        return times


class ObservedParams(Sequence[StoredParam]):
    """Parameters of a live table to store. Each `StoredParam` is created on access.

    A write of a whole table creates none: its columns are the packed values of the table.

    Args:
        params: a copy of the table's parameters, with the times of the observations.
        times: converts these to unix times. A value without a time counts as observed at `times.at`.
        volatile: names outside the vehicle's hash; None keeps the stored flags.
        by: authors of changes, by name; the default is the vehicle.
        overwritten: earlier values of some parameters, written first.
    """

    def __init__(
        self,
        params: Params,
        times: UnixTimes,
        *,
        volatile: frozenset[str] | None,
        by: Mapping[str, str],
        overwritten: Sequence[StoredParam] = (),
    ) -> None:
        self._params = params
        self._times = times
        self._volatile = volatile
        self._by = by
        self._overwritten = overwritten

    def __len__(self) -> int:
        return len(self._overwritten) + len(self._params)

    @overload
    def __getitem__(self, place: int) -> StoredParam: ...

    @overload
    def __getitem__(self, place: slice) -> Sequence[StoredParam]: ...

    def __getitem__(self, place: int | slice) -> StoredParam | Sequence[StoredParam]:
        return list(self)[place]

    def __iter__(self) -> Iterator[StoredParam]:
        yield from self._overwritten
        yield from self._table.observations(self._by, with_volatile=self._volatile is not None)

    def heard_at(self) -> Iterator[tuple[str, float]]:
        """Yield the name and the unix time of each parameter, without creating records."""
        for item in self._overwritten:
            yield item.name, item.heard_at
        yield from zip(self._params.compact, self._table.column("heard_at"), strict=True)

    def first_table(self) -> StoredTable | None:
        """Return the first stored parameters of a table; None if a name may occur twice, or there is none."""
        return self._table if self._params and not self._overwritten else None

    @cached_property
    def _table(self) -> StoredTable:
        times, moments, compact = self._times, self._params.moments, self._params.compact
        present = times.at - times.ahead
        heard_at = times.of_all([moments.get(name, present) for name in compact])
        return StoredTable.of_live(self._params, self._volatile or frozenset(), heard_at)
