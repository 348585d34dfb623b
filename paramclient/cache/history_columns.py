"""`HistoryLine`: a line of history as the cache stores it, its columns, and how many lines are kept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple, TypeAlias

from paramclient.cache.cells import cells
from paramclient.cache.param_columns import read_param
from paramclient.cache.records import HistoryEntry

__all__ = [
    "HISTORY_COLUMNS",
    "HISTORY_ENTRIES_MAX",
    "HISTORY_MARKS",
    "NO_VALUE",
    "HistoryLine",
    "LineValue",
    "NumberedLine",
    "read_entry",
    "read_line",
]

LineValue: TypeAlias = tuple[int, int, int] | tuple[None, None, None]
"""Type, bits and is_raw of a value, as in `StoredParam.value`; or `NO_VALUE`."""
HISTORY_ENTRIES_MAX: Final = 10_000
"""Maximum number of history lines of each table, the newest: about 1 MB, and years of tuning by hand. Each
`save` writes a line for each changed value, so values that change many times a second should be collected
first."""
NO_VALUE: Final = (None, None, None)
"""The new value of a parameter that was removed."""


class HistoryLine(NamedTuple):
    """A line of history as it is stored: columns of the table `history`.

    To add a column: add a field here and its letter to `_CELLS`, and add the column to the table in
    `sqlite_schema` and `postgres_schema`, with a new version of each. Users see a line as a `HistoryEntry`,
    which `read_entry` creates. Lines of extended parameters are `ExtLine` in `ext_records`.

    Attributes:
        at: unix seconds at which the new value was received.
        name: param_id.
        by: author of the change.
        old_type, old_bits, old_is_raw: the previous value.
        new_type, new_bits, new_is_raw: the new value; None if the parameter was removed.
    """

    at: float
    name: str
    by: str
    old_type: int
    old_bits: int
    old_is_raw: int
    new_type: int | None
    new_bits: int | None
    new_is_raw: int | None

    @classmethod
    def of(cls, at: float, name: str, by: str, old: tuple[int, int, int], new: LineValue) -> HistoryLine:
        """Return the line of a change from one value to another, or to `NO_VALUE`."""
        return cls(at, name, by, *old, *new)

    @property
    def old(self) -> tuple[int, int, int]:
        """The previous value: type, bits and is_raw."""
        return self[3:6]

    @property
    def new(self) -> LineValue:
        """The new value, or `NO_VALUE`."""
        values: LineValue = self[6:9]  # type: ignore[assignment]  # all three are None, or none is
        return values


NumberedLine: TypeAlias = tuple[int, HistoryLine]
"""A history line with its number."""

HISTORY_COLUMNS: Final = ", ".join(HistoryLine._fields)
"""Names of the columns, for SQL."""
HISTORY_MARKS: Final = ", ".join("?" * len(HistoryLine._fields))
"""A placeholder for each column, for SQL."""
_CELLS: Final = "fssiiiIII"
"""The types of the columns, see `cells`."""


def read_line(row: Sequence[object]) -> NumberedLine:
    """Return a row of the number and the columns as a line with its number.

    Raises:
        Damaged: a cell has another type than its column.
    """
    number, *line = cells(row, f"i{_CELLS}")
    return number, HistoryLine._make(line)


def read_entry(row: Sequence[object]) -> HistoryEntry:
    """Return a row of the component and the columns as users see it.

    Raises:
        Damaged: a cell has another type than its column.
    """
    component, *values = cells(row, f"i{_CELLS}")
    line = HistoryLine._make(values)
    return HistoryEntry(
        at=line.at,
        component=component,
        name=line.name,
        old=read_param(line.name, *line.old),
        new=None if None in line.new else read_param(line.name, *line.new),
        by=line.by,
    )
