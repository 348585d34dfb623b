"""What a table of the protocol holds, on its way into the cache."""

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
    """Turns moments of a clock that nobody sets into unix times.

    Attributes:
        at: the present, in unix seconds: no moment is after it.
        ahead: seconds that unix time is ahead of the other clock.
        since, not_before: a moment from `since` on is not before the unix time `not_before`, though the
            computer's clock was set back a little in between.
    """

    at: float
    ahead: float = 0.0
    since: float = math.inf
    not_before: float = 0.0

    def __call__(self, moment: float) -> float:
        """Return the unix time of a moment."""
        at = moment + self.ahead
        if moment >= self.since and at < self.not_before:
            at = self.not_before
        return min(max(at, 0.0), self.at)

    def of_all(self, moments: Sequence[float]) -> list[float]:
        """Return the unix times of many moments, in a tenth of the time that a call for each takes."""
        times = [moment + self.ahead for moment in moments]
        was_set_back = self.since + self.ahead < self.not_before
        if times and (was_set_back or min(times) < 0.0 or max(times) > self.at):
            return [self(moment) for moment in moments]
        return times


class HeardParams(Sequence[StoredParam]):
    """Parameters to keep, as a table holds them: each `StoredParam` is made when it is asked for.

    That is never, where a whole table of a thousand is written: the cells of its rows are made of what the
    table holds.

    Args:
        params: as they are now: a copy of what the table holds, with the moments of the observations.
        times: what turns these into unix times. A value without a moment counts as observed at `times.at`.
        volatile: the names that it leaves out of its hash; None leaves what is known.
        by: who caused the changes, by name; of the others it was the vehicle.
        overwritten: what some of them were before, and is to be kept first.
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
        """Give the name and the time of each, without making anything of it."""
        for item in self._overwritten:
            yield item.param.name, item.heard_at
        yield from zip(self._params.held, self._heard_at(), strict=True)

    def _heard_at(self) -> list[float]:
        """The times of what the table holds, in its order."""
        if self._current_times is None:
            times, moments, held = self._times, self._params.moments, self._params.held
            present = times.at - times.ahead
            self._current_times = times.of_all([moments.get(name, present) for name in held])
        return self._current_times

    def rows(self) -> Iterator[tuple[str, Row, bool | None, str]]:
        """Each one's name and cells, whether it is volatile, and who caused its change."""
        for item in self._overwritten:
            param = item.param
            row = Row.of(param, param.index, bool(item.volatile), item.heard_at)
            yield param.name, row, item.volatile, item.by
        for name, row in self._rows().items():
            is_volatile = None if self._volatile is None else bool(row.volatile)
            yield name, row, is_volatile, self._by.get(name, BY_VEHICLE)

    def first_rows(self) -> FirstRows | None:
        """The rows of a table that had none before, or None where that cannot be told by name."""
        return self._rows() if self._params and not self._overwritten else None

    def _rows(self) -> FirstRows:
        times = self._heard_at()
        for at in (min(times), max(times)) if times else ():
            time_cell(at)
        return FirstRows(self._params, self._volatile or frozenset(), times)


class FirstRows(Mapping[str, Row]):
    """The rows of parameters as a table holds them: each is made when it is asked for.

    The columns of all of them are made in a few calls, and without an object for each row: those of some
    tables at once would be what the garbage collector goes through everything for.

    Args:
        params: at least one.
        volatile: the names of those that the vehicle leaves out of its hash.
        heard_at: when the vehicle said so, in their order.
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
        """The names, and the cells of all rows in the order of `Row`."""
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
