"""History of tables: lines of changes, earlier states, and the insertion of earlier observations by time.

A line connects two observations: of the old value, last at `old_at`, and of the new one, first at `at`. A
name that appears in a table that was complete before has a line without an old value, which readers of the
history do not see. Each function runs in a transaction.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from operator import attrgetter, itemgetter
from typing import Any, Final, NamedTuple

from paramclient.cache.database import Transaction
from paramclient.cache.records import (
    BY_VEHICLE,
    HistoryEntry,
    StoredParam,
    StoredValue,
    is_same_value,
    stored_value,
)

HISTORY_ENTRIES_MAX: Final = 10_000
"""Maximum number of history lines of each table, the newest: about 1 MB, and years of tuning by hand."""
SAME_CHANGE_MAX: Final = 2.0
"""Maximum seconds between the times of one change in the cache and in a log, or of two programs: one may have
received it later, or from another link."""

_OLD: Final = "old_type, old_value"
_LINE: Final = f"at, name, author, old_at, {_OLD}, new_type, new_value"


class Line(NamedTuple):
    """A line of history as it is stored.

    Attributes:
        at: time of the first observation of the new value.
        name: param_id.
        by: author of the change.
        old_at: time of the last observation of the old value, or None.
        old: the old value; None if the name appeared in a complete table.
        new: the new value; None if the vehicle no longer has the parameter.
    """

    at: float
    name: str
    by: str
    old_at: float | None
    old: StoredValue | None
    new: StoredValue | None


def add_lines(tx: Transaction, owner: int, lines: Iterable[Line]) -> int:
    """Add history lines, and delete the oldest beyond `HISTORY_ENTRIES_MAX`. Return the last one's number."""
    rows = [
        (owner, line.at, line.name, line.by, line.old_at, *(line.old or _NO_VALUE), *(line.new or _NO_VALUE))
        for line in sorted(lines, key=attrgetter("at"))
    ]
    if not rows:
        return 0
    tx.many(f"INSERT INTO history (owner, {_LINE}) VALUES (?{', ?' * 8})", rows)
    found = tx.all(
        "SELECT at FROM history WHERE owner = ? ORDER BY at DESC, id DESC"
        f" LIMIT 1 OFFSET {HISTORY_ENTRIES_MAX}",
        (owner,),
    )
    for (at,) in found:
        tx.do("DELETE FROM history WHERE owner = ? AND at <= ?", (owner, at))
        tx.do("UPDATE component SET known_since = ? WHERE id = ? AND known_since < ?", (at, owner, at))
    return last_line(tx, owner)


def last_line(tx: Transaction, owner: int) -> int:
    """Return the number of the line of a table that was written last; 0 if there is none."""
    [(last,)] = tx.all("SELECT max(id) FROM history WHERE owner = ?", (owner,))
    return last or 0


def lines_since(tx: Transaction, owner: int, since: float) -> dict[str, list[tuple[int, Line]]]:
    """Return the lines since a time, with their numbers, by parameter and in the order in which they were
    written."""
    lines: dict[str, list[tuple[int, Line]]] = {}
    which = f"SELECT id, {_LINE} FROM history WHERE owner = ? AND at > ? ORDER BY id"
    for number, *row in tx.all(which, (owner, since)):
        line = _line(row)
        lines.setdefault(line.name, []).append((number, line))
    return lines


def load_lines(tx: Transaction, owner: int) -> dict[str, list[Line]]:
    """Return the history lines of a table by parameter, in the order of their times."""
    lines: dict[str, list[Line]] = {}
    for row in tx.all(f"SELECT {_LINE} FROM history WHERE owner = ? ORDER BY at, id", (owner,)):
        line = _line(row)
        lines.setdefault(line.name, []).append(line)
    return lines


def load_history(
    tx: Transaction,
    key: str,
    component: int | None,
    name: str | None,
    limit: int | None,
    since: float | None,
    extended: bool,
) -> list[HistoryEntry]:
    """Return the changes of a vehicle's values, newest last."""
    given = {"c.component = ?": component, "h.name = ?": name, "h.at >= ?": since}
    conditions = {condition: value for condition, value in given.items() if value is not None}
    found = tx.all(
        f"SELECT {_LINE}, component"
        " FROM history h JOIN component c ON c.id = h.owner"
        " WHERE c.vehicle = ? AND c.extended = ? AND h.old_type IS NOT NULL"
        f"{''.join(f' AND {condition}' for condition in conditions)}"
        f" ORDER BY h.at DESC, h.id DESC{'' if limit is None or limit < 0 else f' LIMIT {int(limit)}'}",
        (key, int(extended), *conditions.values()),
    )
    return [
        HistoryEntry(at, number, name, old.param(name), new and new.param(name), by)
        for *row, number in reversed(found)
        for at, name, by, _, old, new in [_line(row)]
        if old is not None
    ]


def values_at(
    tx: Transaction, owner: int, rows: Mapping[str, StoredParam], when: float
) -> dict[str, StoredValue]:
    """Return the values that a table had at a time since which its states are known."""
    values = {name: row.stored for name, row in rows.items()}
    later = f"SELECT name, {_OLD} FROM history WHERE owner = ? AND at > ? ORDER BY at DESC, id DESC"
    for name, *old in tx.all(later, (owner, when)):
        values[name] = stored_value(old)
    return {name: value for name, value in values.items() if value is not None}


class _Point(NamedTuple):
    """An observation of a parameter: its value, or None where it was missing."""

    at: float
    value: StoredValue | None
    by: str


def merged_lines(
    name: str,
    lines: Sequence[Line],
    row: StoredParam | None,
    items: Iterable[StoredParam],
    known_since: float | None,
    confirmed_at: float,
) -> list[Line]:
    """Return the lines of a parameter anew, from its stored observations and those that are inserted.

    Args:
        name: the parameter.
        lines: its lines so far.
        row: its stored value.
        items: the observations to insert.
        known_since: time since which the states of the table are known, or None.
        confirmed_at: time at which the stored value was last confirmed by the hash; minus infinity if never.
    """
    points: list[_Point] = []
    known: list[tuple[_Point, float]] = []  # and within how many seconds an observation is the same
    first_value = lines[0].old if lines else row and row.stored
    begin = lines[0].at if lines else math.inf
    if first_value is not None and known_since is not None and known_since < begin:
        points.append(_Point(known_since, first_value, BY_VEHICLE))  # the table was complete with it
    for line in lines:
        if line.old is not None and line.old_at is not None:
            points.append(_Point(line.old_at, line.old, BY_VEHICLE))
            known.append((points[-1], 0.0))
        points.append(_Point(line.at, line.new, line.by))
        known.append((points[-1], SAME_CHANGE_MAX))
    points += [
        _Point(item.heard_at, item.stored, item.by)
        for item in items
        if not any(
            is_same_value(point.value, item.stored) and abs(point.at - item.heard_at) <= tolerance
            for point, tolerance in known
        )
    ]
    if row is not None:
        moments = (row.heard_at, max(row.heard_at, confirmed_at))
        points += [_Point(at, row.stored, BY_VEHICLE) for at in moments]
    points.sort(key=itemgetter(0))
    has_appeared = lines[0].old is None if lines else row is None and known_since is not None
    first = points[0]
    merged = [Line(first.at, name, first.by, None, None, first.value)] if has_appeared else []
    for last, point in pairwise(points):
        if not is_same_value(last.value, point.value):
            old_at = None if last.value is None else last.at
            merged.append(Line(point.at, name, point.by, old_at, last.value, point.value))
    return merged


def _line(cells: Sequence[Any]) -> Line:
    at, name, author, old_at, *values = cells
    return Line(at, name, author, old_at, stored_value(values[:2]), stored_value(values[2:]))


_NO_VALUE: Final = (None, None)
