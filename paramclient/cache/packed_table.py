"""A table's parameters as one piece of bytes, column after column.

A thousand rows of SQL cost milliseconds, one blob a tenth of that: each column becomes bytes, and comes back,
in one call; where only some columns are wanted, the others are not looked at.

All numbers are little-endian. First comes a head: version, whether there are defaults, the character between
two names, how many parameters, bytes of all names. Then the names in UTF-8; a byte of each parameter for its
type, for is_raw, for volatile and, where there are defaults, for whether it has one; bits, heard_at, index
and, where there are any, defaults. At last comes a CRC-32 of all that: in here, and not only beside it, so
that the bytes tell of themselves whether they are whole. The parameters are in the order in which a table
gives them: who reads need not sort.

The file may have come from anywhere. Whatever `pack` would not have made is `Damaged`, before memory is taken
for what it claims to hold.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from itertools import compress, repeat
from operator import itemgetter, lt
from typing import Any, Final, TypeVar

from paramclient.cache.observed_table import FirstRows
from paramclient.cache.rows import YEAR_10000, Damaged, Row, read_cells
from paramclient.errors import UsageError
from paramclient.model.params import Params

__all__ = ["Packed", "pack", "packed_row", "row_checksum", "unpack"]

_VERSION: Final = 1
_HEAD: Final = struct.Struct("<BBIII")
_CRC: Final = struct.Struct("<I")
_NO_INDEX: Final = (1 << 31) - 1
"""Stands for no index; above all others, so that these parameters come last."""
_INDEX: Final = Row._fields.index("param_index")
_CHARACTERS: Final = 0x110000
_HEARD_AT: Final = Row._fields.index("heard_at")
_new = tuple.__new__  # as in `rows`

S = TypeVar("S", bound=Sequence[float])
T = TypeVar("T")


def pack(rows: Mapping[str, Row]) -> bytes:
    """The rows of a table as bytes, by index, then name, those without an index last.

    Raises:
        UsageError: a name with half a character in it, or a number that is too large.
    """
    return _pack(*_columns(rows))


def _columns(rows: Mapping[str, Row]) -> tuple[Sequence[str], list[Sequence[Any]]]:
    if isinstance(rows, FirstRows):
        return rows.columns()
    return tuple(rows), list(zip(*rows.values(), strict=True)) or [()] * len(Row._fields)


def _pack(names: Sequence[str], columns: list[Sequence[Any]]) -> bytes:
    indices = columns[_INDEX]
    if _NO_INDEX in indices:
        raise UsageError(f"a table cannot be kept: {_NO_INDEX} is no index")
    if None in indices:
        indices = columns[_INDEX] = [_NO_INDEX if index is None else index for index in indices]
    if not all(map(lt, indices, indices[1:])):
        in_order = itemgetter(*_order(names, indices))
        names, *columns = map(in_order, (names, *columns))
    types, bits, is_raw, indices, volatile, heard_at, defaults = columns
    size = len(names)
    has_defaults = defaults.count(None) < size
    all_names = "".join(names)
    between = next(number for number in range(_CHARACTERS) if chr(number) not in all_names)
    try:
        text = chr(between).join(names).encode()
        parts = [
            _HEAD.pack(_VERSION, has_defaults, between, size, len(text)),
            text,
            bytes(types),
            _flags(bytes(is_raw)),
            _flags(bytes(volatile)),
            bytes(default is not None for default in defaults) if has_defaults else b"",
            struct.pack(f"<{size}q", *bits),
            struct.pack(f"<{size}d", *heard_at),
            struct.pack(f"<{size}i", *indices),
            struct.pack(f"<{size}q", *(default or 0 for default in defaults)) if has_defaults else b"",
        ]
    except (Damaged, ValueError, struct.error) as error:
        raise UsageError(f"a table cannot be kept: {error}") from error
    whole = b"".join(parts)
    return whole + _CRC.pack(zlib.crc32(whole))


def unpack(blob: bytes) -> dict[str, Row]:
    """The rows of a table, in the order of `pack`; `Damaged` where the bytes are not what that gives."""
    return Packed(blob).rows()


def packed_row(rows: Mapping[str, Row]) -> tuple[int, float, bytes]:
    """What is kept of a table that is not empty: its size, when a value was heard last, and its bytes."""
    names, columns = _columns(rows)
    return len(names), max(columns[_HEARD_AT]), _pack(names, columns)


def row_checksum(size: int, heard_last: float, blob: bytes) -> int:
    """What stands with the component: so a row that is missing, or another one's, is found."""
    return zlib.crc32(repr((size, heard_last, blob[-_CRC.size :])).encode())


class Packed:
    """The bytes of a table, of which only what is asked for becomes rows.

    Args:
        blob: what `pack` gave; `Damaged` where it is not that.

    Attributes:
        size: how many parameters.
        named: the names as they stand in the bytes; the same for tables of the same names in the same order.
    """

    def __init__(self, blob: bytes) -> None:
        whole = len(blob) - _CRC.size
        if whole < _HEAD.size:
            raise Damaged(f"a table has {len(blob)} bytes")
        if _CRC.pack(zlib.crc32(memoryview(blob)[:whole])) != blob[whole:]:
            raise Damaged("a table is not what was written")
        version, has_defaults, between, size, length = _HEAD.unpack_from(blob)
        if version != _VERSION or has_defaults > 1 or between >= _CHARACTERS:
            raise Damaged(f"a table begins with {blob[: _HEAD.size].hex()}")
        self._start = _HEAD.size + length
        if whole != self._start + size * (23 + 9 * has_defaults) or (length and not size):
            raise Damaged(f"a table of {size} parameters has {len(blob)} bytes")
        self._blob = blob
        self._has_defaults = bool(has_defaults)
        self._between = chr(between)
        self.size = size
        self.named = blob[: self._start]
        self._wide = self._start + size * (3 + has_defaults)

    def rows(self) -> dict[str, Row]:
        """All of it."""
        rows = zip(
            self._bytes(0),
            self._numbers("q", self._wide),
            _flags(self._bytes(1)),
            self._indices(),
            _flags(self._bytes(2)),
            _checked(self._times()),
            self._defaults(),
            strict=True,
        )
        return self._by_name(map(_new, repeat(Row), rows))

    def params(self) -> tuple[Params, frozenset[str], dict[str, float]]:
        """All of it as `Session.params` gives it, without an object for each row."""
        names = self._names()
        volatile = compress(names, _flags(self._bytes(2)))
        heard_at = self._by_name(_checked(self._times()))
        numbers = self._bytes(0), self._numbers("q", self._wide), _flags(self._bytes(1))
        params = read_cells(zip(names, *numbers, self._indices(), self._defaults(), strict=True))
        return params, frozenset(volatile), heard_at

    def places(self) -> dict[str, int]:
        """Where each name stands."""
        return self._by_name(range(self.size))

    def values(self, places: Iterable[tuple[str, int]]) -> list[tuple[str, int, int, int]]:
        """Name, type, bits, is_raw of the parameters of these names in these places."""
        types, bits, is_raw = self._bytes(0), self._numbers("q", self._wide), _flags(self._bytes(1))
        return [(name, types[place], bits[place], is_raw[place]) for name, place in places]

    def heard_at(self, places: Iterable[int]) -> list[float]:
        """When the parameters in these places were heard."""
        times = self._times()
        return _checked([times[place] for place in places])

    def _names(self) -> list[str]:
        try:
            text = self.named[_HEAD.size :].decode()
        except UnicodeDecodeError as error:
            raise Damaged(str(error)) from error
        if text.count(self._between) != max(self.size - 1, 0):
            raise Damaged(f"a table of {self.size} parameters has another number of names")
        return text.split(self._between) if self.size else []

    def _times(self) -> Sequence[float]:
        return self._numbers("d", self._wide + 8 * self.size)

    def _indices(self) -> Sequence[int | None]:
        found = self._numbers("i", self._wide + 16 * self.size)
        return [None if each == _NO_INDEX else each for each in found] if _NO_INDEX in found else found

    def _defaults(self) -> Iterable[int | None]:
        if not self._has_defaults:
            return repeat(None, self.size)
        found = self._numbers("q", self._wide + 20 * self.size)
        there = _flags(self._bytes(3))
        return [bits if is_there else None for bits, is_there in zip(found, there, strict=True)]

    def _by_name(self, cells: Iterable[T]) -> dict[str, T]:
        found = dict(zip(self._names(), cells, strict=True))
        if len(found) != self.size:
            raise Damaged("a table has a name twice")
        return found

    def _bytes(self, number: int) -> bytes:
        start = self._start + number * self.size
        return self._blob[start : start + self.size]

    def _numbers(self, kind: str, start: int) -> tuple[Any, ...]:
        return struct.unpack_from(f"<{self.size}{kind}", self._blob, start)


def _order(names: Sequence[str], indices: Sequence[int]) -> list[int]:
    """The places of a table's parameters by index, then name."""
    order: Iterable[int] = range(len(names))
    if len(set(indices)) < len(names):
        order = sorted(order, key=names.__getitem__)
    return sorted(order, key=indices.__getitem__)


def _flags(column: bytes) -> bytes:
    """A column of zeros and ones; else `Damaged`."""
    if column.strip(b"\0\1"):
        raise Damaged("a cell is neither 0 nor 1")
    return column


def _checked(times: S) -> S:
    """Times; else `Damaged`."""
    if times and not (min(times) >= 0 and max(times) < YEAR_10000 and math.isfinite(sum(times))):
        raise Damaged(f"a cell holds {next(at for at in times if not 0 <= at < YEAR_10000)!r}")
    return times
