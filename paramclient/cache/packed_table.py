"""Packed tables: the parameters of a table as one binary blob, by column.

1,000 rows of SQL take milliseconds, one blob a tenth of that: each column is encoded and decoded in one call,
and unused columns are not decoded.

All numbers are little-endian. The header has the version, a flag for defaults, the separator character of
names, the number of parameters, and the size of all names in bytes. The names in UTF-8 follow; then, for each
parameter, one byte for its type, is_raw, volatile and, with defaults, whether it has one; then the columns
bits, heard_at, index and, with defaults, default. The last field is a CRC-32 of the preceding bytes, inside
the blob, so that the blob can be verified without other data. The parameters are in table order, so that
readers need not sort.

The file may be from an untrusted source. Data that `pack` cannot have written raises `Damaged`, before memory
is allocated for its claimed size.
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
"""Version of the format."""
_HEAD: Final = struct.Struct("<BBIII")
"""Header: version, has defaults, separator, number of parameters, size of the names in bytes."""
_CRC: Final = struct.Struct("<I")
"""Last field: CRC-32 of all preceding bytes."""
_NO_INDEX: Final = (1 << 31) - 1
"""Encodes a missing index. It is above all indices, so that these parameters are last."""
_INDEX: Final = Row._fields.index("param_index")
"""Position of the index among the columns."""
_CHARACTERS: Final = 0x110000
"""Number of Unicode code points."""
_HEARD_AT: Final = Row._fields.index("heard_at")
"""Position of the observation time among the columns."""
_new = tuple.__new__  # as in `rows`

S = TypeVar("S", bound=Sequence[float])
T = TypeVar("T")


def pack(rows: Mapping[str, Row]) -> bytes:
    """Encode the rows of a table, ordered by index, then name, those without an index last.

    Raises:
        UsageError: a name has a lone surrogate, or a number is too large.
    """
    return _pack(*_columns(rows))


def _columns(rows: Mapping[str, Row]) -> tuple[Sequence[str], list[Sequence[Any]]]:
    if isinstance(rows, FirstRows):
        return rows.columns()
    return tuple(rows), list(zip(*rows.values(), strict=True)) or [()] * len(Row._fields)


def _pack(names: Sequence[str], columns: list[Sequence[Any]]) -> bytes:
    indices = columns[_INDEX]
    if _NO_INDEX in indices:
        raise UsageError(f"the table cannot be stored: {_NO_INDEX} is not a valid index")
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
        raise UsageError(f"the table cannot be stored: {error}") from error
    whole = b"".join(parts)
    return whole + _CRC.pack(zlib.crc32(whole))


def unpack(blob: bytes) -> dict[str, Row]:
    """Decode the rows of a table, in the order of `pack`.

    Raises:
        Damaged: the bytes are not a result of `pack`.
    """
    return Packed(blob).rows()


def packed_row(rows: Mapping[str, Row]) -> tuple[int, float, bytes]:
    """Return the database cells of a table with parameters: number, last observation time, encoded rows."""
    names, columns = _columns(rows)
    return len(names), max(columns[_HEARD_AT]), _pack(names, columns)


def row_checksum(size: int, heard_last: float, blob: bytes) -> int:
    """Return the checksum stored with the component, which detects a missing or exchanged row."""
    return zlib.crc32(repr((size, heard_last, blob[-_CRC.size :])).encode())


class Packed:
    """An encoded table, of which only the requested columns are decoded.

    Args:
        blob: a result of `pack`.

    Attributes:
        size: number of parameters.
        named: header and names as bytes; equal for tables with equal names in equal order.

    Raises:
        Damaged: the blob is not a result of `pack`; also from its methods.
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
        """Return all rows by name."""
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
        """Return the result of `Session.params`, without an object for each row."""
        names = self._names()
        volatile = compress(names, _flags(self._bytes(2)))
        heard_at = self._by_name(_checked(self._times()))
        numbers = self._bytes(0), self._numbers("q", self._wide), _flags(self._bytes(1))
        params = read_cells(zip(names, *numbers, self._indices(), self._defaults(), strict=True))
        return params, frozenset(volatile), heard_at

    def places(self) -> dict[str, int]:
        """Return the position of each name."""
        return self._by_name(range(self.size))

    def values(self, places: Iterable[tuple[str, int]]) -> list[tuple[str, int, int, int]]:
        """Return name, type, bits, is_raw of the parameters with these names and positions."""
        types, bits, is_raw = self._bytes(0), self._numbers("q", self._wide), _flags(self._bytes(1))
        return [(name, types[place], bits[place], is_raw[place]) for name, place in places]

    def heard_at(self, places: Iterable[int]) -> list[float]:
        """Return the observation times of the parameters at these positions, in unix seconds."""
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
    """Return the positions of a table's parameters, sorted by index, then name."""
    order: Iterable[int] = range(len(names))
    if len(set(indices)) < len(names):
        order = sorted(order, key=names.__getitem__)
    return sorted(order, key=indices.__getitem__)


def _flags(column: bytes) -> bytes:
    """Check and return a column of zeros and ones.

    Raises:
        Damaged: a cell has another value.
    """
    if column.strip(b"\0\1"):
        raise Damaged("a cell is neither 0 nor 1")
    return column


def _checked(times: S) -> S:
    """Check and return a column of unix times.

    Raises:
        Damaged: a cell is not a valid time.
    """
    if times and not (min(times) >= 0 and max(times) < YEAR_10000 and math.isfinite(sum(times))):
        raise Damaged(f"a cell holds {next(at for at in times if not 0 <= at < YEAR_10000)!r}")
    return times
