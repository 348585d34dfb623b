"""What was observed in the past, brought into what is kept: the later observation counts."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from paramclient.cache.records import BY_VEHICLE, CachedSummary, CachedVehicle, StoredParam, TableUpdate
from paramclient.cache.rows import Row
from paramclient.cache.tables import (
    applied,
    hashed,
    rows_of,
    save,
    summaries,
    vehicles,
    write_history,
    write_rows,
)

__all__ = ["merge"]

SAME_CHANGE: Final = 2.0
"""Seconds between two lines of history that tell of one change: who heard it live wrote it up to a quarter of
a second later, or as much later as a slow disk took."""


def merge(
    connection: sqlite3.Connection,
    updates: Sequence[TableUpdate],
    based_on: Mapping[tuple[str, int], float],
) -> None:
    """Write past updates, in the order of their times; see `ParamCache.merge`."""
    tables: dict[tuple[str, int], _Past] = {}
    for update in updates:
        key = (update.identity.key, update.component)
        past = tables.get(key)
        if past is None:
            past = tables[key] = _Past(connection, based_on.get(key))
        past.take(update)
    for past in tables.values():
        past.finish()


@dataclass
class _Past:
    """What a log holds of one table.

    Attributes:
        based_on: `updated_at` of the table that the updates go on from, or None.
        owner: of the table in the database, once it is there.
        goes_on: whether the kept table is the one that the updates know.
        overtaken: by name, the last observation of which a later one is kept.
        lines: of history, to be put in their places.
    """

    connection: sqlite3.Connection
    based_on: float | None
    owner: int | None = None
    goes_on: bool = False
    overtaken: dict[str, StoredParam] = field(default_factory=dict)
    lines: list[tuple[Any, ...]] = field(default_factory=list)

    def take(self, update: TableUpdate) -> None:
        """Bring in one update."""
        vehicle, found = _standing(self.connection, update)
        if found is None:
            self.goes_on = True
            self._save(update, vehicle)
            return
        self.owner, table = found
        if update.at < table.updated_at:
            self._bring_in(update, table)
            self._widen(update, vehicle)
            return
        self.goes_on |= update.replace or self.based_on == table.updated_at
        if not self.goes_on:
            update = replace(update, table=None)
        self.catch_up(item.param.name for item in update.params)
        self._save(update, vehicle)

    def catch_up(self, names: Iterable[str]) -> None:
        """Tell of the change between the last observation that was overtaken, and what is kept."""
        found = [self.overtaken.pop(name) for name in names if name in self.overtaken]
        if self.owner is None or not found:
            return
        kept = rows_of(self.connection, self.owner)
        for item in found:
            name = item.param.name
            old, new = _row(item), kept.get(name)
            if new is None or old.same_value(new) or self._lines(name, item.heard_at, new.heard_at):
                continue
            self.lines.append((new.heard_at, name, BY_VEHICLE, *old.value, *new.value))

    def finish(self) -> None:
        """Put the lines of history in their places by time."""
        self.catch_up(list(self.overtaken))
        if not self.lines:
            return
        columns = "at, name, by, old_type, old_bits, old_is_raw, new_type, new_bits, new_is_raw"
        kept = self.connection.execute(
            f"SELECT {columns} FROM history WHERE owner = ? ORDER BY id", (self.owner,)
        ).fetchall()
        self.connection.execute("DELETE FROM history WHERE owner = ?", (self.owner,))
        assert self.owner is not None
        lines = sorted([*kept, *self.lines], key=lambda line: float(line[0]))
        write_history(self.connection, self.owner, lines)

    def _save(self, update: TableUpdate, vehicle: CachedVehicle | None) -> None:
        if vehicle is not None and vehicle.last_seen > update.at:
            update = replace(update, identity=vehicle.identity)
        save(self.connection, [update])
        self._widen(update, vehicle)

    def _widen(self, update: TableUpdate, vehicle: CachedVehicle | None) -> None:
        """The vehicle has been seen from the first time to the last, whichever was written first."""
        if vehicle is not None:
            self.connection.execute(
                "UPDATE vehicle SET first_seen = ?, last_seen = ? WHERE key = ?",
                (min(vehicle.first_seen, update.at), max(vehicle.last_seen, update.at), vehicle.key),
            )

    def _bring_in(self, update: TableUpdate, table: CachedSummary) -> None:
        """Bring in what an update has of values that are not kept of a later time."""
        assert self.owner is not None
        before = rows_of(self.connection, self.owner)
        gone_since = table.synced_at if table.complete and table.synced_at is not None else float("-inf")
        later: list[StoredParam] = []
        for item in update.params:
            name = item.param.name
            row = before.get(name)
            if (gone_since if row is None else row.heard_at) < item.heard_at:
                # its place is that of another count, perhaps
                later.append(replace(item, param=replace(item.param, index=None)))
                continue
            earlier = self.overtaken.get(name)
            self.overtaken[name] = item
            if row is not None and earlier is not None:
                self.lines += self._line(earlier, item)
        self.catch_up(item.param.name for item in later)
        after, changes = applied(replace(update, params=later, removed=(), replace=False), before)
        if after != before:
            write_rows(self.connection, self.owner, before, after)
            if hashed(before) != hashed(after):
                self.connection.execute("UPDATE component SET hash = NULL WHERE id = ?", (self.owner,))
        self.lines += changes

    def _line(self, earlier: StoredParam, item: StoredParam) -> Iterator[tuple[Any, ...]]:
        """The line of a change between two observations, unless it is there."""
        old, new = _row(earlier), _row(item)
        if old.same_value(new):
            return
        around = self._lines(item.param.name, item.heard_at - SAME_CHANGE, item.heard_at + SAME_CHANGE)
        if new.value not in around:
            yield (item.heard_at, item.param.name, item.by, *old.value, *new.value)

    def _lines(self, name: str, after: float, until: float) -> list[tuple[Any, ...]]:
        """What a parameter became in a time, by its lines of history."""
        return self.connection.execute(
            "SELECT new_type, new_bits, new_is_raw FROM history"
            " WHERE owner = ? AND name = ? AND at > ? AND at <= ?",
            (self.owner, name, after, until),
        ).fetchall()


def _standing(
    connection: sqlite3.Connection, update: TableUpdate
) -> tuple[CachedVehicle | None, tuple[int, CachedSummary] | None]:
    """The vehicle and the table that are kept, as far as they are."""
    key = update.identity.key
    vehicle = next((each for each in vehicles(connection) if each.key == key), None)
    return vehicle, next(iter(summaries(connection, key, update.component)), None)


def _row(item: StoredParam) -> Row:
    return Row.of(item.param, None, False, item.heard_at)
