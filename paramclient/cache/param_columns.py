"""`StoredParam`: the one form in which the cache stores a parameter, and the columns of it.

The columns of PostgreSQL, of the packed tables of a file and of the outbox, and the checks of their cells,
are derived from `COLUMNS`. To store another field, add it to `StoredParam` and, as an optional column, to
`COLUMNS`; and a step to the migrations in `postgres_schema`, and an empty one in `sqlite_schema`, which makes
earlier versions set the file aside instead of misreading it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import repeat
from operator import itemgetter
from typing import Any, Final, NamedTuple

from paramclient.cache.cells import MASK_64, Damaged, cells, signed
from paramclient.model.params import CACHED, COMPACT_NO_INDEX, Params, iter_unpack_fields, pack_fields
from paramclient.model.values import (
    Param,
    ParamType,
    Trust,
    WireValue,
    bits_of,
    from_bits,
    known_type,
    same_bits,
)

__all__ = [
    "BY_VEHICLE",
    "COLUMNS",
    "COLUMN_NAMES",
    "Column",
    "StoredParam",
    "StoredTable",
    "checksum",
    "read_param",
    "read_rows",
]

BY_VEHICLE: Final = "vehicle"
"""Author of a change by the vehicle, and of a change that a download has shown."""


class Column(NamedTuple):
    """One column of a stored parameter.

    Attributes:
        name: name of the field of `StoredParam`, and of the column in PostgreSQL.
        sql: type of the column in PostgreSQL.
        code: form in a packed table: `s` text, `B` a byte, `?` a byte that is 0 or 1, `d` a unix time in 8
            bytes, `q` and `i` integers of 8 and 4 bytes.
        null: number in a packed table that stands for NULL.
        is_optional: whether stored parameters may lack it: it was added later, or is rarely known. It may be
            NULL, and is in a packed table only if a parameter has it.
    """

    name: str
    sql: str
    code: str
    null: int | None = None
    is_optional: bool = False

    @property
    def kind(self) -> str:
        """The types of its cells, as a letter of `cells`."""
        kind = {"s": "s", "d": "f"}.get(self.code, "i")
        return kind.upper() if self.is_optional or self.null is not None else kind


COLUMNS: Final = (
    Column("name", "text", "s"),
    Column("type", "smallint", "B"),
    Column("bits", "bigint", "q"),
    Column("is_raw", "smallint", "?"),
    Column("param_index", "integer", "i", null=(1 << 31) - 1),  # above all indices: sorted last
    Column("volatile", "smallint", "?"),
    Column("heard_at", "double precision", "d"),
    Column("default_bits", "bigint", "q", is_optional=True),
)
"""The columns, in the order of the fields of `StoredParam`. Later ones are optional."""
COLUMN_NAMES: Final = tuple(column.name for column in COLUMNS)
"""Names of the columns."""
_KINDS: Final = "".join(column.kind for column in COLUMNS)
_INDEX, _VOLATILE, _HEARD_AT = map(COLUMN_NAMES.index, ("param_index", "volatile", "heard_at"))
_ENDS: Final = tuple(1 << 8 * (ParamType(each).size if 1 <= each <= 10 else 4) for each in range(256))
"""By type: upper limit of the bits of a value, exclusive. For a type that MAVLink does not define, and for
raw values, the bits are the four bytes of the message."""
_name: Final = itemgetter(0)
_new = tuple.__new__  # half the time of a named tuple's own constructor, which ends in this call


class _Fields(NamedTuple):
    """The fields of `StoredParam`: the columns, then the author."""

    name: str
    type: int
    bits: int
    is_raw: int
    param_index: int | None
    volatile: int | None
    heard_at: float
    default_bits: int | None = None
    by: str = ""


class StoredParam(_Fields):
    """One observation of a parameter to store, or one stored parameter. Equal stored ones need no write.

    Args:
        param: the parameter; its trust is not stored. An index of None does not change a stored index, except
            in a whole table.
        heard_at: time of the observation, not after the update's `at`. The later of two observations of a
            parameter counts, independent of the order of writes.
        volatile: whether the vehicle's hash excludes the parameter; None does not change the stored flag.
        by: author, if the value is a change: `BY_US`, `us for NAME`, `BY_VEHICLE` or `by_station(…)`.

    Attributes:
        name: param_id.
        type: number of the MAVLink type.
        bits: the value's bits, as a signed integer.
        is_raw: 1 if the value is only known as the four bytes of the message.
        param_index: index, or None.
        volatile: 1 if the vehicle's hash excludes the parameter; None if an observation does not say.
        heard_at: time of the observation, in unix seconds.
        default_bits: bits of the firmware's default, or None.
        by: author of the observation; "" for a stored parameter.
    """

    __slots__ = ()

    def __new__(
        cls, param: Param, heard_at: float, volatile: bool | None = None, by: str = BY_VEHICLE
    ) -> StoredParam:
        number = int(param.type_number)
        return _new(
            cls,
            (
                param.name,
                number,
                signed(param.bits),
                int(param.is_raw),
                param.index,
                None if volatile is None else int(volatile),
                float(heard_at),
                None if param.default is None else signed(bits_of(param.default, number)),
                by,
            ),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self)._make, (tuple(self),)

    @property
    def value(self) -> tuple[int, int, int]:
        """Type, bits and is_raw."""
        return self[1:4]

    @property
    def hashed(self) -> tuple[int, int, int] | None:
        """The value if the vehicle's hash covers it; None if the parameter is volatile or not in use."""
        return None if self.volatile or self.param_index is None else self.value

    @property
    def param(self) -> Param:
        """The parameter, with trust CACHED.

        Raises:
            Damaged: the value or the type is not valid.
        """
        return read_param(self.name, *self.value, self.param_index, self.default_bits)

    def same_value(self, other: StoredParam) -> bool:
        """Return whether both have the same value and type (−0 equals 0)."""
        return self.has_value(other.value)

    def has_value(self, value: Sequence[int | None]) -> bool:
        """Return whether it has this value: type, bits and is_raw, or three None for no value."""
        number, bits, is_raw = value
        return (self.type, self.is_raw) == (number, is_raw) and same_bits(
            self.type, self.bits & MASK_64, (bits or 0) & MASK_64
        )

    def stored_over(self, old: StoredParam | None, *, keeps_index: bool) -> StoredParam:
        """Return this observation as it is stored in place of the stored one.

        Args:
            old: the stored parameter, or None. It provides the flag that the observation lacks.
            keeps_index: whether it also provides the index.
        """
        index, volatile = self[_INDEX:_HEARD_AT]
        if index is None and keeps_index and old is not None:
            index = old.param_index
        if volatile is None:
            volatile = 0 if old is None else old.volatile
        return _new(StoredParam, (*self[:_INDEX], index, volatile, *self[_HEARD_AT:-1], ""))


class StoredTable(Mapping[str, StoredParam]):
    """Stored parameters of a table by column. Each `StoredParam` is created on access.

    The objects of several tables of rows at the same time would trigger full garbage collections.

    Args:
        columns: the columns, in the order of `COLUMNS`.
    """

    def __init__(self, columns: Sequence[Sequence[Any]]) -> None:
        self.columns = columns
        self._places: dict[str, int] = {}

    @classmethod
    def of(cls, rows: Mapping[str, StoredParam]) -> StoredTable:
        """Return stored parameters by column."""
        if isinstance(rows, StoredTable):
            return rows
        return cls(list(zip(*rows.values(), strict=True))[:-1] or [()] * len(COLUMNS))

    @classmethod
    def of_live(cls, params: Params, volatile: frozenset[str], heard_at: Sequence[float]) -> StoredTable:
        """Return the parameters of a live table by column, in a few calls.

        Args:
            params: the parameters.
            volatile: names outside the vehicle's hash.
            heard_at: unix times of the observations, in the order of the parameters.
        """
        compact, defaults = params.compact, params.defaults
        if not compact:
            return cls.of({})
        bits, types, is_raw, _, places = zip(*iter_unpack_fields(b"".join(compact.values())), strict=True)
        initial: Sequence[int | None] = (None,) * len(compact)
        if defaults:
            initial = [
                signed(bits_of(defaults[name], number)) if name in defaults else None
                for name, number in zip(compact, types, strict=True)
            ]
        return cls(
            [
                tuple(compact),
                types,
                [signed(each) for each in bits] if max(bits) >> 63 else bits,
                is_raw,
                [None if place == COMPACT_NO_INDEX else place for place in places]
                if COMPACT_NO_INDEX in places
                else places,
                bytes(map(volatile.__contains__, compact)),
                heard_at,
                initial,
            ]
        )

    def __len__(self) -> int:
        return len(self.columns[0])

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns[0])

    def __getitem__(self, name: str) -> StoredParam:
        if not self._places:
            self._places = {each: place for place, each in enumerate(self.columns[0])}
        place = self._places[name]
        return _new(StoredParam, (*(column[place] for column in self.columns), ""))

    def column(self, name: str) -> Sequence[Any]:
        """Return the column of this name."""
        return self.columns[COLUMN_NAMES.index(name)]

    def rows(self) -> dict[str, StoredParam]:
        """Return all stored parameters by name."""
        return dict(zip(self, map(_new, repeat(StoredParam), zip(*self.columns, repeat(""))), strict=True))

    def observations(self, by: Mapping[str, str], *, with_volatile: bool) -> Iterator[StoredParam]:
        """Yield the parameters as observations.

        Args:
            by: authors of changes, by name; the default is the vehicle.
            with_volatile: whether the volatile flags are known.
        """
        columns: list[Iterable[Any]] = [*self.columns, [by.get(name, BY_VEHICLE) for name in self]]
        if not with_volatile:
            columns[_VOLATILE] = repeat(None)
        return map(_new, repeat(StoredParam), zip(*columns))  # noqa: B905  # one of them may be endless

    def params(self) -> Params:
        """Return the parameters, with trust CACHED.

        Raises:
            Damaged: a value, type or index is not valid.
        """
        params = Params()
        compact, defaults = params.compact, params.defaults
        read = ("name", "type", "bits", "is_raw", "param_index", "default_bits")
        for name, number, bits, is_raw, index, default_bits in zip(*map(self.column, read), strict=True):
            if not 0 <= number <= 255:
                raise Damaged(f"{number} is not a type")
            unsigned = bits & MASK_64
            if unsigned >= (_ENDS[0] if is_raw else _ENDS[number]):
                raise Damaged(f"{unsigned} is not a value of type {number}")
            place = COMPACT_NO_INDEX if index is None else index
            try:
                compact[name] = pack_fields(unsigned, number, bool(is_raw), CACHED, place)
            except struct.error as error:
                raise Damaged(f"an index is {place}: {error}") from error
            if default_bits is not None:
                defaults[name] = _value(number, default_bits, False)
        return params


def read_rows(found: Iterable[Sequence[object]]) -> dict[str, StoredParam]:
    """Return stored parameters by name, from cells in the order of `COLUMNS`; the last ones may be missing.

    Raises:
        Damaged: a cell has a wrong type.
    """
    rows = {}
    for each in found:
        row = cells(each, _KINDS[: len(each)])
        rows[row[0]] = _new(StoredParam, (*row, *(None,) * (len(COLUMNS) - len(row)), ""))
    return rows


def checksum(rows: Mapping[str, StoredParam]) -> int:
    """Return a CRC-32 of all parameters of a table, independent of their order.

    A parameter that lacks the last columns gives the checksum of earlier versions, which did not have them.
    """
    return zlib.crc32(repr([_without_end(row) for _, row in sorted(rows.items(), key=_name)]).encode())


def read_param(
    name: str,
    number: int,
    bits: int,
    is_raw: int,
    index: int | None = None,
    default_bits: int | None = None,
) -> Param:
    """Return the parameter of a stored value, with trust CACHED.

    Raises:
        Damaged: the value or the type is not valid.
    """
    value = _value(number, bits, bool(is_raw))
    default = None if default_bits is None else _value(number, default_bits, False)
    if not 0 <= number <= 255:
        raise Damaged(f"{number} is not a type")
    return Param(name, value, known_type(number), index, bits & MASK_64, Trust.CACHED, default)


def _value(number: int, bits: int, is_raw: bool) -> WireValue:
    bits &= MASK_64
    try:
        return from_bits(bits, number, is_raw=is_raw)
    except OverflowError:
        raise Damaged(f"{bits} is not a value of type {number}") from None


def _without_end(row: StoredParam) -> tuple[object, ...]:
    """Return the cells of a stored parameter, without those at the end that are None."""
    end = len(COLUMNS)
    while row[end - 1] is None:
        end -= 1
    return row[:end]
