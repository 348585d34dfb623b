"""Records to cells and back. Whatever does not look like what was written is damage, not a value."""

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
"""Unix seconds in which no time that is stored can lie any more."""
_KINDS: Final[dict[str, tuple[type, ...]]] = {
    "i": (int,),
    "f": (float,),
    "s": (str,),
    "I": (int, type(None)),
    "F": (float, type(None)),
    "S": (str, type(None)),
}
_MASK_64: Final = (1 << 64) - 1
_ENDS: Final = tuple(1 << 8 * (ParamType(each).size if 1 <= each <= 10 else 4) for each in range(256))
"""By type: what the bits of a value are below. Of a type that MAVLink does not define they are the four bytes
of the message, as they are of a value that is kept raw."""
_TIMES: Final[dict[tuple[object, ...], tuple[int, ...]]] = {}
"""Where rows of a shape hold times: by the kinds and the types of cells that were found to be right."""
_name: Final = itemgetter(0)
_new = tuple.__new__  # what a named tuple's own constructor ends in, after twice the time


class Damaged(Exception):
    """The file does not hold what was written to it. Work may raise this; it never reaches a caller."""

    kind = "damaged"


def cells(row: Sequence[object], kinds: str) -> Any:
    """Give a row back whose cells are what they should be; else `Damaged`.

    Args:
        kinds: a letter for each cell: i integer, f time, s text; in capitals where NULL is possible.
    """
    shape = (kinds, *map(type, row))
    times = _TIMES.get(shape)
    if times is None:  # a row like none before; those of a table are all like a few
        times = _TIMES[shape] = _times(row, kinds)
    for place in times:
        if not 0 <= row[place] < YEAR_10000:  # type: ignore[operator]  # the shape says that it is a float
            raise Damaged(f"a cell holds {row[place]!r:.40}")
    return row


def time_cell(at: float) -> float:
    """A time to be stored: unix seconds, before the year 10000; else UsageError."""
    if not 0 <= at < YEAR_10000:
        raise UsageError(f"{at!r} is not a time in unix seconds")
    return float(at)


def identity_cells(identity: Identity) -> tuple[object, ...]:
    """A vehicle's cells, in the order of the attributes."""
    *described, capabilities = astuple(identity)
    return (*described, signed(capabilities))


def read_identity(row: Sequence[object]) -> Identity:
    """The inverse of `identity_cells`."""
    identity = Identity(*cells(row, "isSiiisiiii"))
    return replace(identity, capabilities=identity.capabilities & _MASK_64)


class Row(NamedTuple):
    """A parameter's cells, without its name. Two rows are equal when nothing of them needs to be written."""

    type: int
    bits: int
    is_raw: int
    param_index: int | None
    volatile: int
    heard_at: float
    default_bits: int | None = None

    @classmethod
    def of(cls, param: Param, index: int | None, volatile: bool, heard_at: float) -> Row:
        """The cells of a parameter."""
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
        """type, bits, is_raw: what `read_param` takes."""
        return self[:3]

    @property
    def hashed(self) -> tuple[int, int, int] | None:
        """What the vehicle's hash covers of it: its value, or nothing where it is volatile or not in use."""
        return None if self.volatile or self.param_index is None else self.value

    def same_value(self, other: Row) -> bool:
        """Whether both hold the same value in the same type (−0 equals 0)."""
        return (self.type, self.is_raw) == (other.type, other.is_raw) and same_bits(
            self.type, self.bits & _MASK_64, other.bits & _MASK_64
        )


def read_rows(found: Iterable[Sequence[object]]) -> dict[str, Row]:
    """The rows of a table by name, of cells in this order: name, then as in `Row`."""
    return {row[0]: _new(Row, row[1:]) for row in (cells(each, "siiiIifI") for each in found)}


def checksum(rows: Mapping[str, Row]) -> int:
    """A CRC-32 of all that is kept of a table's parameters, whatever their order.

    A row without a default counts as it did before there were any.
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
    """The parameter of a row's `value`; its trust is CACHED."""
    value = _value(number, bits, bool(is_raw))
    default = None if default_bits is None else _value(number, default_bits, False)
    if not 0 <= number <= 255:
        raise Damaged(f"{number} is not a type")
    return Param(name, value, known_type(number), index, bits & _MASK_64, Trust.CACHED, default)


def read_params(rows: Mapping[str, Row]) -> Params:
    """The parameters of a table, as it keeps them; their trust is CACHED."""
    return read_cells((name, *row[:4], row.default_bits) for name, row in rows.items())


def read_cells(cells_: Iterable[tuple[str, int, int, int, int | None, int | None]]) -> Params:
    """The same of name, type, bits, is_raw, index and default of each."""
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
    """Where a row holds times; `Damaged` where a cell is not of its kind."""
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
    """A 64-bit unsigned number as SQLite's integers, which are signed, can hold it."""
    return number - (1 << 64) if number >> 63 else number
