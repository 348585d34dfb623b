"""Conversion between records and database cells. Cells that cannot have been written raise `Damaged`."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, replace
from operator import itemgetter
from typing import Any, Final, NamedTuple

from paramclient.errors import UsageError
from paramclient.model.identity import Identity
from paramclient.model.params import CACHED, NOWHERE, Params, pack_fields
from paramclient.model.values import Param, ParamType, Trust, Value, bits_of, from_bits, known_type, same_bits

__all__ = [
    "Damaged",
    "Row",
    "YEAR_10000",
    "cells",
    "checksum",
    "identity_cells",
    "read_cells",
    "read_identity",
    "read_param",
    "read_params",
    "read_rows",
    "signed",
    "time_cell",
]

YEAR_10000: Final = 253402300800.0
"""Unix seconds at the start of the year 10000, above every stored time."""
# Python types of a cell, by the letters of `cells`.
_KINDS: Final[dict[str, tuple[type, ...]]] = {
    "i": (int,),
    "f": (float,),
    "s": (str,),
    "I": (int, type(None)),
    "F": (float, type(None)),
    "S": (str, type(None)),
}
_MASK_64: Final = (1 << 64) - 1
"""Mask of 64 bits, which converts a signed integer of the database to unsigned."""
_ENDS: Final = tuple(1 << 8 * (ParamType(each).size if 1 <= each <= 10 else 4) for each in range(256))
"""By type: upper limit of the bits of a value, exclusive. For a type that MAVLink does not define, and for
raw values, the bits are the four bytes of the message."""
_TIMES: Final[dict[tuple[object, ...], tuple[int, ...]]] = {}
"""Positions of times in a row, by the kinds and types of its cells, for valid rows so far."""
_name: Final = itemgetter(0)
_new = tuple.__new__  # half the time of a named tuple's own constructor, which ends in this call


class Damaged(Exception):
    """The content of a store is not what was written to it. Internal: callers receive a CacheError."""

    kind = "damaged"


def cells(row: Sequence[object], kinds: str) -> Any:
    """Check the types of a row's cells, and return the row.

    Args:
        row: the cells.
        kinds: a letter for each cell: i integer, f time, s text; a capital letter if NULL is possible.

    Raises:
        Damaged: a cell has another type, or is not a valid time.
    """
    shape = (kinds, *map(type, row))
    times = _TIMES.get(shape)
    if times is None:  # the first row of this shape; the rows of a table have only a few shapes
        times = _TIMES[shape] = _times(row, kinds)
    for place in times:
        if not 0 <= row[place] < YEAR_10000:  # type: ignore[operator]  # the shape says that it is a float
            raise Damaged(f"a cell holds {row[place]!r:.40}")
    return row


def time_cell(at: float) -> float:
    """Check and return a time to store.

    Raises:
        UsageError: the time is not in unix seconds, from 0 to before the year 10000.
    """
    if not 0 <= at < YEAR_10000:
        raise UsageError(f"{at!r} is not a time in unix seconds")
    return float(at)


def identity_cells(identity: Identity) -> tuple[object, ...]:
    """Return the cells of an identity, in the order of its attributes."""
    *described, capabilities = astuple(identity)
    return (*described, signed(capabilities))


def read_identity(row: Sequence[object]) -> Identity:
    """Return the identity of cells from `identity_cells`.

    Raises:
        Damaged: a cell has a wrong type.
    """
    identity = Identity(*cells(row, "isSiiisiiii"))
    return replace(identity, capabilities=identity.capabilities & _MASK_64)


class Row(NamedTuple):
    """The cells of a parameter, without its name. Equal rows need no write.

    Attributes:
        type: number of the MAVLink type.
        bits: the value's bits, as a signed integer.
        is_raw: 1 if the value is only known as the four bytes of the message.
        param_index: index, or None.
        volatile: 1 if the vehicle's hash excludes the parameter.
        heard_at: time of the observation, in unix seconds.
        default_bits: bits of the firmware's default, or None.
    """

    type: int
    bits: int
    is_raw: int
    param_index: int | None
    volatile: int
    heard_at: float
    default_bits: int | None = None

    @classmethod
    def of(cls, param: Param, index: int | None, volatile: bool, heard_at: float) -> Row:
        """Return the row of a parameter.

        Raises:
            UsageError: the time is not in unix seconds.
        """
        number = int(param.type)
        bits = param.bits
        default = None if param.default is None else signed(bits_of(param.default, number))
        return _new(
            cls,
            (
                number,
                bits - (1 << 64) if bits >> 63 else bits,
                int(isinstance(param.value, bytes)),
                index,
                int(volatile),
                time_cell(heard_at),
                default,
            ),
        )

    @property
    def value(self) -> tuple[int, int, int]:
        """Type, bits and is_raw, the arguments of `read_param`."""
        return self[:3]

    @property
    def hashed(self) -> tuple[int, int, int] | None:
        """The value if the vehicle's hash covers it; None if the parameter is volatile or not in use."""
        return None if self.volatile or self.param_index is None else self.value

    def same_value(self, other: Row) -> bool:
        """Return whether two rows have the same value and type (−0 equals 0)."""
        return (self.type, self.is_raw) == (other.type, other.is_raw) and same_bits(
            self.type, self.bits & _MASK_64, other.bits & _MASK_64
        )


def read_rows(found: Iterable[Sequence[object]]) -> dict[str, Row]:
    """Return the rows of a table by name, from cells in the order name, then as in `Row`.

    Raises:
        Damaged: a cell has a wrong type.
    """
    return {row[0]: _new(Row, row[1:]) for row in (cells(each, "siiiIifI") for each in found)}


def checksum(rows: Mapping[str, Row]) -> int:
    """Return a CRC-32 of all rows of a table, independent of their order.

    A row without a default gives the checksum of earlier versions, which had no defaults.
    """
    kept = [
        (name, *(row[:-1] if row.default_bits is None else row))
        for name, row in sorted(rows.items(), key=_name)
    ]
    return zlib.crc32(repr(kept).encode())


def read_param(
    name: str,
    number: int,
    bits: int,
    is_raw: int,
    index: int | None = None,
    default_bits: int | None = None,
) -> Param:
    """Return the parameter of a row's `value`, with trust CACHED.

    Raises:
        Damaged: the value or the type is not valid.
    """
    value = _value(number, bits, bool(is_raw))
    default = None if default_bits is None else _value(number, default_bits, False)
    if not 0 <= number <= 255:
        raise Damaged(f"{number} is not a type")
    return Param(name, value, known_type(number), index, bits & _MASK_64, Trust.CACHED, default)


def read_params(rows: Mapping[str, Row]) -> Params:
    """Return the parameters of rows, with trust CACHED."""
    return read_cells((name, *row[:4], row.default_bits) for name, row in rows.items())


def read_cells(cells_: Iterable[tuple[str, int, int, int, int | None, int | None]]) -> Params:
    """Return the parameters of cells: name, type, bits, is_raw, index and default, with trust CACHED.

    Raises:
        Damaged: a value, type or index is not valid.
    """
    params = Params()
    held, defaults = params.held, params.defaults
    for name, number, bits, is_raw, index, default_bits in cells_:
        if not 0 <= number <= 255:
            raise Damaged(f"{number} is not a type")
        bits &= _MASK_64
        if bits >= (_ENDS[0] if is_raw else _ENDS[number]):
            raise Damaged(f"{bits} is not a value of type {number}")
        place = NOWHERE if index is None else index
        try:
            held[name] = pack_fields(bits, number, bool(is_raw), CACHED, place)
        except struct.error as error:
            raise Damaged(f"an index is {place}: {error}") from error
        if default_bits is not None:
            defaults[name] = _value(number, default_bits, False)
    return params


def _times(row: Sequence[object], kinds: str) -> tuple[int, ...]:
    """Return the positions of times in a row.

    Raises:
        Damaged: a cell has a wrong type.
    """
    for cell, kind in zip(row, kinds, strict=True):
        if not isinstance(cell, _KINDS[kind]):
            raise Damaged(f"a cell holds {cell!r:.40}")
    return tuple(place for place, cell in enumerate(row) if isinstance(cell, float))


def _value(number: int, bits: int, is_raw: bool) -> Value:
    bits &= _MASK_64
    try:
        return from_bits(bits, number, is_raw=is_raw)
    except OverflowError:
        raise Damaged(f"{bits} is not a value of type {number}") from None


def signed(number: int) -> int:
    """Return a 64-bit unsigned number as signed, the form of SQLite's integers."""
    return number - (1 << 64) if number >> 63 else number
