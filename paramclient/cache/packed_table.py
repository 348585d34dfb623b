"""Packed tables: the parameters of a table as one binary blob, by column.

1,000 rows of SQL take milliseconds, one blob a tenth of that: each column is encoded and decoded in one call,
and unused columns are not decoded. The layout is derived from `COLUMNS`.

All numbers are little-endian. The header has the version, a bit for each optional column that is present (the
lowest one for the first), the separator character of texts, the number of parameters, and the size of all
texts in bytes. The texts in UTF-8 follow, first the names; then, for each parameter, the columns of one byte
(type, is_raw, volatile), and for each present optional column a byte, 1 if the parameter has it; then the
columns of 8 bytes (bits, heard_at), of 4 bytes (index), and the optional ones (default). The last field is a
CRC-32 of the preceding bytes, inside the blob, so that the blob can be verified without other data. The
parameters are in table order, so that readers need not sort.

The file may be from an untrusted source. Data that `pack` cannot have written raises `Damaged`, before memory
is allocated for its claimed size.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import chain
from operator import itemgetter, lt
from typing import Any, Final, NamedTuple, TypeVar

from paramclient.cache.cells import YEAR_10000, Damaged, are_times
from paramclient.cache.param_columns import COLUMN_NAMES, COLUMNS, StoredParam, StoredTable
from paramclient.errors import UsageError

__all__ = ["Packed", "pack", "packed_row", "row_checksum", "unpack"]

_VERSION: Final = 1
"""Version of the format."""
_HEAD: Final = struct.Struct("<BBIII")
"""Header: version, optional columns, separator, number of parameters, size of the texts in bytes."""
_CRC: Final = struct.Struct("<I")
"""Last field: CRC-32 of all preceding bytes."""
_CHARACTERS: Final = 0x110000
"""Number of Unicode code points."""
_COLUMNS: Final = dict(zip(COLUMN_NAMES, COLUMNS, strict=True))
_OPTIONAL: Final = tuple(column for column in COLUMNS if column.is_optional)
_HAS: Final = "has "
"""Before the name of an optional column: the bytes that show which parameters have it."""

S = TypeVar("S", bound=Sequence[float])


class _Layout(NamedTuple):
    """Layout of a packed table with some of the optional columns.

    Attributes:
        texts: names of the columns whose texts follow the header, in order.
        numbers: codes of the columns of numbers by name, in order.
        offsets: by name, bytes of each parameter in the preceding columns of numbers.
        width: bytes of each parameter in all columns of numbers.
    """

    texts: tuple[str, ...]
    numbers: dict[str, str]
    offsets: dict[str, int]
    width: int


@cache
def _layout(optional: int) -> _Layout:
    """Return the layout with the optional columns of these bits."""
    added = [column for bit, column in enumerate(_OPTIONAL) if optional >> bit & 1]
    required = [column for column in COLUMNS if not column.is_optional]
    by_width = sorted(required, key=lambda column: -_width(column.code))
    numbers = {column.name: column.code for column in required if _width(column.code) == 1}
    numbers |= {f"{_HAS}{column.name}": "?" for column in added}
    numbers |= {column.name: column.code for column in by_width if _width(column.code) > 1}
    numbers |= {column.name: column.code for column in added if column.code != "s"}
    offsets: dict[str, int] = {}
    width = 0
    for name, code in numbers.items():
        offsets[name] = width
        width += _width(code)
    texts = tuple(column.name for column in (*required, *added) if column.code == "s")
    return _Layout(texts, numbers, offsets, width)


def _width(code: str) -> int:
    return 0 if code == "s" else struct.calcsize(f"<{code}")


def pack(rows: Mapping[str, StoredParam]) -> bytes:
    """Encode the parameters of a table, ordered by index, then name, those without an index last.

    Raises:
        UsageError: a name has a lone surrogate, or a number is too large.
    """
    columns = dict(zip(COLUMN_NAMES, StoredTable.of(rows).columns, strict=True))
    optional = 0
    for bit, column in enumerate(_OPTIONAL):
        cells = columns[column.name]
        if cells.count(None) < len(cells):
            optional |= 1 << bit
            columns[f"{_HAS}{column.name}"] = [cell is not None for cell in cells]
            absent: Any = "" if column.code == "s" else 0
            columns[column.name] = [absent if cell is None else cell for cell in cells]
    for column in COLUMNS:
        cells = columns[column.name]
        if column.null is None:
            continue
        if column.null in cells:
            what = column.name.removeprefix("param_")
            raise UsageError(f"the table cannot be stored: {column.null} is not a valid {what}")
        if None in cells:
            columns[column.name] = [column.null if cell is None else cell for cell in cells]
    indices = columns["param_index"]
    if not all(map(lt, indices, indices[1:])):
        in_order = itemgetter(*_order(columns["name"], indices))
        columns = {name: in_order(cells) for name, cells in columns.items()}
    layout = _layout(optional)
    texts: list[str] = list(chain.from_iterable(columns[name] for name in layout.texts))
    joined = "".join(texts)
    between = next(number for number in range(_CHARACTERS) if chr(number) not in joined)
    try:
        text = chr(between).join(texts).encode()
        numbers = [_encoded(code, columns[name]) for name, code in layout.numbers.items()]
        head = _HEAD.pack(_VERSION, optional, between, len(indices), len(text))
    except (Damaged, ValueError, struct.error) as error:
        raise UsageError(f"the table cannot be stored: {error}") from error
    whole = b"".join((head, text, *numbers))
    return whole + _CRC.pack(zlib.crc32(whole))


def _encoded(code: str, cells: Sequence[Any]) -> bytes:
    if code == "B":
        return bytes(cells)
    if code == "?":
        return _flags(bytes(cells))
    return struct.pack(f"<{len(cells)}{code}", *cells)


def unpack(blob: bytes) -> dict[str, StoredParam]:
    """Decode the parameters of a table, in the order of `pack`.

    Raises:
        Damaged: the bytes are not a result of `pack`.
    """
    return Packed(blob).table().rows()


def packed_row(rows: Mapping[str, StoredParam]) -> tuple[int, float, bytes]:
    """Return the database cells of a table with parameters: number, last observation time, encoded rows."""
    table = StoredTable.of(rows)
    return len(table), max(table.column("heard_at")), pack(table)


def row_checksum(size: int, heard_last: float, blob: bytes) -> int:
    """Return the checksum stored with the component, which detects a missing or exchanged row."""
    return zlib.crc32(repr((size, heard_last, blob[-_CRC.size :])).encode())


class Packed:
    """An encoded table, of which only the requested columns are decoded.

    Args:
        blob: a result of `pack`.

    Attributes:
        size: number of parameters.
        named: header and texts as bytes; equal for tables with equal names in equal order.

    Raises:
        Damaged: the blob is not a result of `pack`; also from its methods.
    """

    def __init__(self, blob: bytes) -> None:
        whole = len(blob) - _CRC.size
        if whole < _HEAD.size:
            raise Damaged(f"a table has {len(blob)} bytes")
        if _CRC.pack(zlib.crc32(memoryview(blob)[:whole])) != blob[whole:]:
            raise Damaged("a table is not what was written")
        version, optional, between, size, length = _HEAD.unpack_from(blob)
        if version != _VERSION or optional >> len(_OPTIONAL) or between >= _CHARACTERS:
            raise Damaged(f"a table begins with {blob[: _HEAD.size].hex()}")
        self._layout = _layout(optional)
        self._start = _HEAD.size + length
        if whole != self._start + size * self._layout.width or (length and not size):
            raise Damaged(f"a table of {size} parameters has {len(blob)} bytes")
        self._blob = blob
        self._between = chr(between)
        self.size: int = size
        self.named = blob[: self._start]

    def table(self) -> StoredTable:
        """Return all columns."""
        names, *numbers = map(self.column, COLUMN_NAMES)
        if len(set(names)) != self.size:
            raise Damaged("a table has a name twice")
        return StoredTable([names, *numbers])

    def column(self, name: str) -> Sequence[Any]:
        """Return the column of this name."""
        column, layout = _COLUMNS[name], self._layout
        if column.is_optional and f"{_HAS}{name}" not in layout.numbers:
            return (None,) * self.size
        found: Sequence[Any] = self._texts(name) if column.code == "s" else self._numbers(name)
        if column.is_optional:
            there = self._numbers(f"{_HAS}{name}")
            return [cell if is_there else None for cell, is_there in zip(found, there, strict=True)]
        if column.null is not None and column.null in found:
            return [None if cell == column.null else cell for cell in found]
        return found

    def places(self) -> dict[str, int]:
        """Return the position of each name."""
        places = {name: place for place, name in enumerate(self.column("name"))}
        if len(places) != self.size:
            raise Damaged("a table has a name twice")
        return places

    def values(self, places: Iterable[tuple[str, int]]) -> list[tuple[str, int, int, int]]:
        """Return name, type, bits, is_raw of the parameters with these names and positions."""
        types, bits, is_raw = map(self.column, ("type", "bits", "is_raw"))
        return [(name, types[place], bits[place], is_raw[place]) for name, place in places]

    def heard_at(self, places: Iterable[int]) -> list[float]:
        """Return the observation times of the parameters at these positions, in unix seconds."""
        times = self.column("heard_at")
        return [times[place] for place in places]

    def _texts(self, name: str) -> Sequence[str]:
        names = self._layout.texts
        try:
            text = self.named[_HEAD.size :].decode()
        except UnicodeDecodeError as error:
            raise Damaged(str(error)) from error
        if text.count(self._between) != max(self.size * len(names) - 1, 0):
            raise Damaged(f"a table of {self.size} parameters has another number of names")
        start = names.index(name) * self.size
        return text.split(self._between)[start : start + self.size] if self.size else []

    def _numbers(self, name: str) -> Sequence[Any]:
        code, start = self._layout.numbers[name], self._start + self.size * self._layout.offsets[name]
        if code in "B?":
            cells = self._blob[start : start + self.size]
            return _flags(cells) if code == "?" else cells
        found: tuple[Any, ...] = struct.unpack_from(f"<{self.size}{code}", self._blob, start)
        return _checked(found) if code == "d" else found


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
    if not are_times(times):
        raise Damaged(f"a cell holds {next(at for at in times if not 0 <= at < YEAR_10000)!r}")
    return times
