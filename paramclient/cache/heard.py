"""What a table of the protocol holds, on its way into the cache."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, overload

from paramclient.cache.records import BY_VEHICLE, StoredParam
from paramclient.cache.rows import Row, signed, time_cell
from paramclient.params import NOWHERE, Params, iter_parts, parts_of
from paramclient.values import bits_of

__all__ = ["FirstRows", "HeardParams"]


class HeardParams(Sequence[StoredParam]):
    """Parameters to keep, as a table holds them: each `StoredParam` is made when it is asked for.

    That is never, where a whole table of a thousand is written: the cells of its rows are made of what the
    table holds.

    Args:
        params: as they are now: a copy of what the table holds.
        heard_at: when the vehicle said so.
        volatile: the names that it leaves out of its hash; None leaves what is known.
        by: who caused the changes, by name; of the others it was the vehicle.
        overwritten: what some of them were before, and is to be kept first.
    """

    def __init__(
        self,
        params: Params,
        heard_at: float,
        *,
        volatile: frozenset[str] | None,
        by: Mapping[str, str],
        overwritten: Sequence[StoredParam] = (),
    ) -> None:
        self._params = params
        self._heard_at = heard_at
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
        for name, param in self._params.items():
            is_volatile = None if self._volatile is None else name in self._volatile
            yield StoredParam(param, self._heard_at, is_volatile, self._by.get(name, BY_VEHICLE))

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
        return FirstRows(self._params, self._volatile or frozenset(), time_cell(self._heard_at))


class FirstRows(Mapping[str, Row]):
    """The rows of parameters as a table holds them: each is made when it is asked for.

    The columns of all of them are made in a few calls, and without an object for each row: those of some
    tables at once would be what the garbage collector goes through everything for.

    Args:
        params: at least one.
        volatile: the names of those that the vehicle leaves out of its hash.
        heard_at: when the vehicle said so.
    """

    def __init__(self, params: Params, volatile: frozenset[str], heard_at: float) -> None:
        self._params = params
        self._volatile = volatile
        self._heard_at = heard_at

    def __len__(self) -> int:
        return len(self._params)

    def __iter__(self) -> Iterator[str]:
        return iter(self._params)

    def __getitem__(self, name: str) -> Row:
        bits, number, is_raw, _, place = parts_of(self._params.held[name])
        default = self._params.defaults.get(name)
        initial = None if default is None else signed(bits_of(default, number))
        index = None if place == NOWHERE else place
        return Row(number, signed(bits), is_raw, index, int(name in self._volatile), self._heard_at, initial)

    def columns(self) -> tuple[Sequence[str], list[Sequence[Any]]]:
        """The names, and the cells of all rows in the order of `Row`."""
        held, defaults = self._params.held, self._params.defaults
        bits, types, is_raw, _, places = zip(*iter_parts(b"".join(held.values())), strict=True)
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
            (self._heard_at,) * len(held),
            initial,
        ]
