"""What was observed in the past, brought into what is kept: the later observation counts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from paramclient.cache.records import BY_VEHICLE, CachedSummary, CachedVehicle, StoredParam, TableUpdate
from paramclient.cache.rows import Row
from paramclient.cache.tables import HISTORY_LINES, applied, hashed, save
from paramclient.cache.transaction import Line, Session

__all__ = ["merge"]

SAME_CHANGE: Final = 2.0
"""Seconds between two lines of history that tell of one change: who heard it live wrote it up to a quarter of
a second later, or as much later as a slow disk took."""


def merge(
    session: Session,
    updates: Sequence[TableUpdate],
    based_on: Mapping[tuple[str, int], float],
) -> None:
    """Write past updates, in the order of their times; see `ParamCache.merge`."""
    tables: dict[tuple[str, int], _Past] = {}
    for update in updates:
        key = (update.identity.key, update.component)
        past = tables.get(key)
        if past is None:
            past = tables[key] = _Past(session, based_on.get(key))
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

    session: Session
    based_on: float | None
    owner: int | None = None
    goes_on: bool = False
    overtaken: dict[str, StoredParam] = field(default_factory=dict)
    lines: list[Line] = field(default_factory=list)

    def take(self, update: TableUpdate) -> None:
        """Bring in one update."""
        vehicle, found = _standing(self.session, update)
        if found is None:
            self.goes_on = True
            self._save(update, vehicle)
            return
        self.owner, table = found
        goes_on = self.goes_on or self.based_on == table.updated_at
        if update.at < table.updated_at or (update.at == table.updated_at and not goes_on):
            self._bring_in(update, table)
            self._widen(update, vehicle)
            return
        self.goes_on = goes_on or update.replace
        if not self.goes_on:
            update = replace(update, table=None)
        self.catch_up(item.param.name for item in update.params)
        self._save(update, vehicle)

    def catch_up(self, names: Iterable[str]) -> None:
        """Tell of the change between the last observation that was overtaken, and what is kept."""
        found = [self.overtaken.pop(name) for name in names if name in self.overtaken]
        if self.owner is None or not found:
            return
        kept = self.session.table(self.owner)
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
        assert self.owner is not None
        lines: list[tuple[int | None, Line]] = list(self.session.lines(self.owner))
        for new in self.lines:
            later = (place for place, (_, line) in enumerate(lines) if line[0] > new[0])
            lines.insert(next(later, len(lines)), (None, new))
        dropped, lines = lines[:-HISTORY_LINES], lines[-HISTORY_LINES:]
        self.session.replace_lines(self.owner, lines)
        if dropped:
            self.session.forget(self.owner, max(line[0] for _, line in dropped))

    def _save(self, update: TableUpdate, vehicle: CachedVehicle | None) -> None:
        if vehicle is not None and vehicle.last_seen > update.at:
            update = replace(update, identity=vehicle.identity)
        save(self.session, [update])
        self._widen(update, vehicle)

    def _widen(self, update: TableUpdate, vehicle: CachedVehicle | None) -> None:
        """The vehicle has been seen from the first time to the last, whichever was written first."""
        if vehicle is not None:
            first, last = min(vehicle.first_seen, update.at), max(vehicle.last_seen, update.at)
            self.session.seen(vehicle.key, first, last)

    def _bring_in(self, update: TableUpdate, table: CachedSummary) -> None:
        """Bring in what an update has of values that are not kept of a later time."""
        assert self.owner is not None
        before = self.session.table(self.owner)
        whole_at = table.synced_at if table.complete and table.synced_at is not None else float("-inf")
        later: list[StoredParam] = []
        heard = {item.param.name for item in update.params}
        for name in set(self.overtaken) - heard if update.replace else update.removed:
            self.overtaken.pop(name, None)  # what comes under it later is another parameter
        for item in update.params:
            name = item.param.name
            row = before.get(name)
            gone_at = self.session.gone_at(self.owner, name) if row is None else row.heard_at
            if (max(whole_at, gone_at) if row is None else gone_at) < item.heard_at:
                # its place is that of another count, perhaps
                later.append(replace(item, param=replace(item.param, index=None)))
                continue
            before_it = self.overtaken.get(name)
            self.overtaken[name] = item
            if row is not None and before_it is not None:
                self.lines += self._line(before_it, item)
        self.catch_up(item.param.name for item in later)
        after, changes, births = applied(replace(update, params=later, removed=(), replace=False), before)
        if after != before:
            self.session.put_table(self.owner, before, after)
            if hashed(before) != hashed(after):
                self.session.describe(self.owner, hash=None)
        self.session.add_births(self.owner, births)
        self.lines += changes

    def _line(self, old_item: StoredParam, item: StoredParam) -> Iterator[Line]:
        """The line of a change between two observations, unless it is there."""
        old, new = _row(old_item), _row(item)
        if old.same_value(new):
            return
        around = self._lines(item.param.name, item.heard_at - SAME_CHANGE, item.heard_at + SAME_CHANGE)
        if new.value not in around:
            yield (item.heard_at, item.param.name, item.by, *old.value, *new.value)

    def _lines(self, name: str, after: float, until: float) -> list[Line]:
        """What a parameter became in a time, by its lines of history."""
        assert self.owner is not None
        return self.session.became(self.owner, name, after, until)


def _standing(
    session: Session, update: TableUpdate
) -> tuple[CachedVehicle | None, tuple[int, CachedSummary] | None]:
    """The vehicle and the table that are kept, as far as they are."""
    key = update.identity.key
    vehicle = next(iter(session.vehicles(key)), None)
    return vehicle, next(iter(session.summaries(key, update.component)), None)


def _row(item: StoredParam) -> Row:
    return Row.of(item.param, None, False, item.heard_at)
