"""Merge of earlier observations, such as those of logs, into the cache. The later observation counts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from paramclient.cache.history_columns import HISTORY_ENTRIES_MAX, HistoryLine
from paramclient.cache.param_columns import BY_VEHICLE, StoredParam
from paramclient.cache.records import CachedSummary, CachedVehicle, TableUpdate
from paramclient.cache.table_updates import apply_update, check_times, hashed, save
from paramclient.cache.transaction import Transaction

__all__ = ["merge"]

SAME_CHANGE_MAX: Final = 2.0
"""Maximum seconds between two history lines of one change: a live client writes up to 0.25 s after the
observation, or later by the delay of a slow disk."""


def merge(
    transaction: Transaction,
    updates: Sequence[TableUpdate],
    based_on: Mapping[tuple[str, int], float],
) -> None:
    """Write earlier updates, in the order of their times; see `ParamCache.merge`."""
    tables: dict[tuple[str, int], _TableMerge] = {}
    for update in updates:
        check_times(update)
        key = (update.identity.key, update.component)
        table_merge = tables.get(key)
        if table_merge is None:
            table_merge = tables[key] = _TableMerge(transaction, based_on.get(key))
        table_merge.take(update)
    for table_merge in tables.values():
        table_merge.finish()


@dataclass
class _TableMerge:
    """Merge of the updates of one table.

    Attributes:
        transaction: the transaction.
        based_on: `updated_at` of the stored table on which the updates are based, or None.
        owner: id of the table in the database, or None before it exists.
        goes_on: whether the updates continue from the stored table.
        overtaken: by name, the last observation for which the cache has a later one.
        lines: new history lines, to be inserted by time.
    """

    transaction: Transaction
    based_on: float | None
    owner: int | None = None
    goes_on: bool = False
    overtaken: dict[str, StoredParam] = field(default_factory=dict)
    lines: list[HistoryLine] = field(default_factory=list)

    def take(self, update: TableUpdate) -> None:
        """Merge one update."""
        vehicle, found = _stored(self.transaction, update)
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
        self.catch_up(item.name for item in update.params)
        self._save(update, vehicle)

    def catch_up(self, names: Iterable[str]) -> None:
        """Add history lines for changes between the last overtaken observation and the stored value."""
        found = [self.overtaken.pop(name) for name in names if name in self.overtaken]
        if self.owner is None or not found:
            return
        kept = self.transaction.table(self.owner)
        for item in found:
            new = kept.get(item.name)
            if new is None or item.same_value(new) or self._values(item.name, item.heard_at, new.heard_at):
                continue
            self.lines.append(HistoryLine.of(new.heard_at, item.name, BY_VEHICLE, item.value, new.value))

    def finish(self) -> None:
        """Insert the new history lines by time, and trim the history."""
        self.catch_up(list(self.overtaken))
        if not self.lines:
            return
        assert self.owner is not None
        lines: list[tuple[int | None, HistoryLine]] = list(self.transaction.lines(self.owner))
        for new in self.lines:
            later = (place for place, (_, line) in enumerate(lines) if line.at > new.at)
            lines.insert(next(later, len(lines)), (None, new))
        dropped, lines = lines[:-HISTORY_ENTRIES_MAX], lines[-HISTORY_ENTRIES_MAX:]
        self.transaction.replace_lines(self.owner, lines)
        if dropped:
            self.transaction.raise_known_since(self.owner, max(line.at for _, line in dropped))

    def _save(self, update: TableUpdate, vehicle: CachedVehicle | None) -> None:
        if vehicle is not None and vehicle.last_seen > update.at:
            update = replace(update, identity=vehicle.identity)
        save(self.transaction, [update])
        self._widen(update, vehicle)

    def _widen(self, update: TableUpdate, vehicle: CachedVehicle | None) -> None:
        """Extend the first and last time of the vehicle by the time of an update."""
        if vehicle is not None:
            first, last = min(vehicle.first_seen, update.at), max(vehicle.last_seen, update.at)
            self.transaction.set_seen_times(vehicle.key, first, last)

    def _bring_in(self, update: TableUpdate, table: CachedSummary) -> None:
        """Merge an older update: only values without a later observation change the table."""
        assert self.owner is not None
        before = self.transaction.table(self.owner)
        whole_at = table.synced_at if table.complete and table.synced_at is not None else float("-inf")
        later: list[StoredParam] = []
        observed = {item.name for item in update.params}
        for name in set(self.overtaken) - observed if update.replace else update.removed:
            self.overtaken.pop(name, None)  # a later value of this name is another parameter
        for item in update.params:
            name = item.name
            row = before.get(name)
            removed_at = self.transaction.removal_time(self.owner, name) if row is None else row.heard_at
            if (max(whole_at, removed_at) if row is None else removed_at) < item.heard_at:
                # its index may belong to another count
                later.append(item._replace(param_index=None))
                continue
            before_it = self.overtaken.get(name)
            self.overtaken[name] = item
            if row is not None and before_it is not None:
                self.lines += self._line(before_it, item)
        self.catch_up(item.name for item in later)
        after, changes, added = apply_update(replace(update, params=later, removed=(), replace=False), before)
        if after != before:
            self.transaction.put_table(self.owner, before, after)
            if hashed(before) != hashed(after):
                self.transaction.update_component(self.owner, hash=None)
        self.transaction.record_added_names(self.owner, added)
        self.lines += changes

    def _line(self, old: StoredParam, new: StoredParam) -> Iterator[HistoryLine]:
        """Yield the history line of a change between two observations, unless it exists."""
        if old.same_value(new):
            return
        around = self._values(new.name, new.heard_at - SAME_CHANGE_MAX, new.heard_at + SAME_CHANGE_MAX)
        if new.value not in around:
            yield HistoryLine.of(new.heard_at, new.name, new.by, old.value, new.value)

    def _values(self, name: str, after: float, until: float) -> list[tuple[Any, ...]]:
        """Return the new values of a parameter in a period, from its history lines."""
        assert self.owner is not None
        return self.transaction.values_between(self.owner, name, after, until)


def _stored(
    transaction: Transaction, update: TableUpdate
) -> tuple[CachedVehicle | None, tuple[int, CachedSummary] | None]:
    """Return the stored vehicle and table of an update, or None for each that does not exist."""
    key = update.identity.key
    vehicle = next(iter(transaction.vehicles(key)), None)
    return vehicle, next(iter(transaction.summaries(key, update.component)), None)
