"""Parameters of a live table as records and rows of the cache."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, overload

from paramclient.cache.records import BY_VEHICLE, StoredParam
from paramclient.cache.rows import Row, signed, time_cell
from paramclient.model.params import NOWHERE, Params, iter_unpack_fields, unpack_fields
from paramclient.model.values import bits_of

__all__ = ["FirstRows", "HeardParams", "UnixTimes"]


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


class HeardParams(Sequence[StoredParam]):
    """Parameters of a live table to store. Each `StoredParam` is created on access.

    A write of a whole table creates none: the cells of its rows come from the packed values of the table.

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
        self._current_times: list[float] | None = None

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
        for (name, param), at in zip(self._params.items(), self._heard_at(), strict=True):
            is_volatile = None if self._volatile is None else name in self._volatile
            yield StoredParam(param, at, is_volatile, self._by.get(name, BY_VEHICLE))

    def heard_at(self) -> Iterator[tuple[str, float]]:
        """Yield the name and the unix time of each parameter, without creating records."""
        for item in self._overwritten:
            yield item.param.name, item.heard_at
        yield from zip(self._params.held, self._heard_at(), strict=True)

    def _heard_at(self) -> list[float]:
        """Return the unix times of the table's parameters, in table order."""
        if self._current_times is None:
            times, moments, held = self._times, self._params.moments, self._params.held
            present = times.at - times.ahead
            self._current_times = times.of_all([moments.get(name, present) for name in held])
        return self._current_times

    def rows(self) -> Iterator[tuple[str, Row, bool | None, str]]:
        """Yield the name, the row, the volatile flag and the author of each parameter."""
        for item in self._overwritten:
            param = item.param
            row = Row.of(param, param.index, bool(item.volatile), item.heard_at)
            yield param.name, row, item.volatile, item.by
        for name, row in self._rows().items():
            is_volatile = None if self._volatile is None else bool(row.volatile)
            yield name, row, is_volatile, self._by.get(name, BY_VEHICLE)

    def first_rows(self) -> FirstRows | None:
        """Return the rows for a table without rows; None if a name may occur twice, or there is no row."""
        return self._rows() if self._params and not self._overwritten else None

    def _rows(self) -> FirstRows:
        times = self._heard_at()
        for at in (min(times), max(times)) if times else ():
            time_cell(at)
        return FirstRows(self._params, self._volatile or frozenset(), times)


class FirstRows(Mapping[str, Row]):
    """Rows of a live table's parameters. Each row is created on access.

    `columns` returns all columns in a few calls, without an object for each row: the objects of several
    tables at the same time would trigger full garbage collections.

    Args:
        params: at least one parameter.
        volatile: names outside the vehicle's hash.
        heard_at: unix times of the observations, in the order of the parameters.
    """

    def __init__(self, params: Params, volatile: frozenset[str], heard_at: Sequence[float]) -> None:
        self._params = params
        self._volatile = volatile
        self._heard_at = heard_at
        self._by_name: dict[str, float] | None = None

    def __len__(self) -> int:
        return len(self._params)

    def __iter__(self) -> Iterator[str]:
        return iter(self._params)

    def __getitem__(self, name: str) -> Row:
        bits, number, is_raw, _, place = unpack_fields(self._params.held[name])
        default = self._params.defaults.get(name)
        initial = None if default is None else signed(bits_of(default, number))
        index = None if place == NOWHERE else place
        is_volatile = int(name in self._volatile)
        if self._by_name is None:
            self._by_name = dict(zip(self._params.held, self._heard_at, strict=True))
        return Row(number, signed(bits), is_raw, index, is_volatile, self._by_name[name], initial)

    def columns(self) -> tuple[Sequence[str], list[Sequence[Any]]]:
        """Return the names, and the columns of all rows in the order of `Row`."""
        held, defaults = self._params.held, self._params.defaults
        bits, types, is_raw, _, places = zip(*iter_unpack_fields(b"".join(held.values())), strict=True)
        initial: Sequence[int | None] = (None,) * len(held)
        if defaults:
            initial = [
                signed(bits_of(defaults[name], number)) if name in defaults else None
                for name, number in zip(held, types, strict=True)
            ]
        return tuple(held), [
            types,
            [signed(each) for each in bits] if max(bits) >> 63 else bits,
            is_raw,
            [None if place == NOWHERE else place for place in places] if NOWHERE in places else places,
            bytes(map(self._volatile.__contains__, held)),
            self._heard_at,
            initial,
        ]
