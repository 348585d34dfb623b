"""Reconciliation of observations of several programs and stations: the later observation of a value counts.

An observation that is not older than the stored value is written, with a history line if the value has
changed. An older one (of a slow program, or of a station without a connection) is inserted into the history,
and changes the table only where no later observation exists. The result therefore does not depend on the
order of writes. Repeated observations of an unchanged value leave no history line, so a late observation may
date its change later or earlier than a complete log. Of two observations with equal times, the one written
later counts.

Times are those of the stations' clocks, which have to agree. Programs that share a file share a clock. If
such a file has a time in the future, the clock was set back since: that value is older than new ones,
independent of its time.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter

from paramclient.cache import history_columns
from paramclient.cache.cells import time_cell
from paramclient.cache.history_columns import HistoryLine, NumberedLine
from paramclient.cache.merge import SAME_CHANGE_MAX
from paramclient.cache.param_columns import BY_VEHICLE, StoredParam
from paramclient.cache.records import CachedSummary, TableState, TableUpdate
from paramclient.cache.snapshots import CLOCK_SLACK
from paramclient.cache.table_updates import (
    apply_update,
    check_times,
    forget_other_firmware,
    hashed,
    observation_times,
    write_lines,
    write_state,
)
from paramclient.cache.transaction import Transaction

__all__ = ["TableHistory", "reconcile"]


def reconcile(transaction: Transaction, updates: Iterable[TableUpdate], present: float | None = None) -> None:
    """Write updates, see `ParamCache.save`.

    Args:
        transaction: the transaction.
        updates: the updates, in order of execution.
        present: current time by the clock of the updates, in unix seconds; None uses `at` of each update.
    """
    for update in updates:
        check_times(update)
        _reconcile(transaction, update, max(time_cell(update.at), 0.0 if present is None else present))


@dataclass
class TableHistory:
    """The history of a table from some time on, into which observations are inserted.

    Attributes:
        lines: history lines in order, each with its number, or None for a new line.
        known_since: time since which the states of the table are known, or None.
        added: by name, the time at which it appeared or, for a changed parameter of the first table, at
            which its first value was observed; the earliest of these times.
        new_added_names: new or earlier times from the inserted observations.
    """

    lines: list[tuple[int | None, HistoryLine]]
    known_since: float | None = None
    added: Mapping[str, float] = field(default_factory=dict)
    new_added_names: dict[str, float] = field(default_factory=dict)

    def observe(
        self, seen: StoredParam, kept: StoredParam | None, *, ahead: Sequence[int | None] | None = None
    ) -> None:
        """Insert an observation of a parameter that was observed again later.

        Args:
            seen: the observation.
            kept: the stored parameter, observed later; None if the table has no such name.
            ahead: new value of its last line before `lines`; None if there is none.
        """
        name, at, by = seen.name, seen.heard_at, seen.by
        place = next(
            (n for n, (_, line) in enumerate(self.lines) if line.name == name and line.at > at), None
        )
        for _, line in self.lines[:place]:
            if line.name == name:
                ahead = line.new
        is_known = ahead is not None
        has_returned = ahead is not None and ahead[0] is None  # with this value, or an older one
        if place is None:
            if kept is None or seen.same_value(kept):
                return
            if has_returned:
                self._insert(HistoryLine.of(kept.heard_at, name, BY_VEHICLE, seen.value, kept.value))
                return
            since = self._added_at(name, self.known_since)
            is_new = since is None or at < since
            if is_known or not is_new:
                self._insert(HistoryLine.of(at, name, by, kept.value, seen.value))
            else:
                self.new_added_names[name] = at
            self._insert(HistoryLine.of(kept.heard_at, name, BY_VEHICLE, seen.value, kept.value))
            return
        number, line = self.lines[place]
        later, old, new = line.at, line.old, line.new
        if seen.has_value(old) or has_returned:  # the time at which it became `old` is not known
            return
        added_at = self._added_at(name)
        if added_at is not None and at < added_at <= later and not is_known:  # it was `old` at `added_at`
            self.new_added_names[name] = at
            self._insert(HistoryLine.of(added_at, name, BY_VEHICLE, seen.value, old), before=place)
            return
        if seen.has_value(new):
            if later - at > SAME_CHANGE_MAX:  # the change was earlier than recorded
                del self.lines[place]
                self._insert(HistoryLine.of(at, name, by, old, new))
            return
        self.lines[place] = (number, HistoryLine.of(later, name, line.by, seen.value, new))
        self._insert(HistoryLine.of(at, name, by, old, seen.value))

    def _added_at(self, name: str, default: float | None = None) -> float | None:
        """Return the recorded time before which a name is unknown; a new record is the earlier one."""
        return self.new_added_names.get(name, self.added.get(name, default))

    def add(self, line: HistoryLine) -> None:
        """Insert a line by its time."""
        self._insert(line)

    def _insert(self, line: HistoryLine, *, before: int | None = None) -> None:
        """Insert a line by its time, but at most at position `before`."""
        place = next((n for n, (_, each) in enumerate(self.lines) if each.at > line.at), len(self.lines))
        self.lines.insert(place if before is None else min(place, before), (None, line))


def _reconcile(transaction: Transaction, update: TableUpdate, present: float) -> None:
    """Write one update: identity, values, history and the state of the table."""
    key, at = update.identity.key, update.at
    horizon = math.inf if transaction.is_shared else present + CLOCK_SLACK
    vehicle = next(iter(transaction.vehicles(key)), None)
    if vehicle is not None and at < vehicle.last_seen <= horizon:
        update = replace(update, identity=vehicle.identity)
    forget_other_firmware(transaction, update.identity)
    found = next(iter(transaction.summaries(key, update.component)), None)
    owner = transaction.upsert_table(update)
    if vehicle is not None:
        last = vehicle.last_seen if vehicle.last_seen <= horizon else at
        transaction.set_seen_times(key, min(vehicle.first_seen, at), max(last, at))
    table = None if found is None else found[1]
    is_late = False
    if table is not None:
        if table.updated_at > horizon:
            transaction.add_clock_rollback(owner, present, table.updated_at)
        elif table.updated_at > at:
            is_late = True
            transaction.update_component(owner, updated_at=table.updated_at)
    before: Mapping[str, StoredParam] = {}
    after = before
    agrees = is_whole = True
    if update.params or update.removed or update.replace:  # otherwise it has only the state of the table
        before = transaction.table(owner)
        seen = _Seen(transaction, owner, table, before, horizon)
        after, agrees, is_whole = _write_values(transaction, owner, update, seen, is_late=is_late)
    state = update.table if table is None else _respectful(update, table)
    if state is not None and is_whole and (state.complete or not is_late):
        if agrees:
            write_state(transaction, owner, state)
        elif state.complete and table is not None and not table.complete:
            write_state(transaction, owner, replace(state, hash=None))  # the hash belongs to other values
        else:
            state = None
    else:
        state = None
    if state is not None and state.complete:
        transaction.set_known_since(owner, at)
    if state is None and hashed(before) != hashed(after):
        transaction.update_component(owner, hash=None)


def _write_values(
    transaction: Transaction, owner: int, update: TableUpdate, seen: _Seen, *, is_late: bool
) -> tuple[Mapping[str, StoredParam], bool, bool]:
    """Write the values of an update.

    Returns:
        The new rows; whether they agree with the update; and, for an update with the whole table, whether it
        has all of their names.
    """
    before = seen.rows
    part = update
    older: Sequence[StoredParam] = ()
    agrees = True
    if seen.table is not None and not all(
        seen.is_newer(name, at) for name, at in observation_times(update.params)
    ):
        part, older, agrees = _divided(update, seen, is_late=is_late)
    removed: Collection[str] = update.removed
    if update.replace:
        removed = before.keys() - {name for name, _ in observation_times(update.params)} if before else ()
    stays = {
        name for name in removed if name in before and not seen.is_newer(name, update.removal_time(name))
    }
    after, lines, added = apply_update(part, before, stays.union(item.name for item in older))
    if len(after) != len(before) or after != before:
        transaction.put_table(owner, before, after)
    transaction.record_added_names(owner, added)
    if lines:
        transaction.add_first_times(owner, _first_changes(transaction, owner, before, dict(added), lines))
    _write_past(transaction, owner, older, lines, seen)
    return after, agrees, not (stays and update.replace)


def _divided(
    update: TableUpdate, seen: _Seen, *, is_late: bool
) -> tuple[TableUpdate, list[StoredParam], bool]:
    """Return the new and the overtaken values of an update, and whether the latter match the stored ones."""
    table = seen.table
    newer: list[StoredParam] = []
    older: list[StoredParam] = []
    agrees = True
    overtaken: dict[str, float] = {}  # older observations of these names are overtaken too
    for item in update.params:
        name = item.name
        if not seen.is_newer(name, item.heard_at):
            overtaken[name] = max(item.heard_at, overtaken.get(name, -math.inf))
    for item in update.params:
        name = item.name
        if item.heard_at > overtaken.get(name, -math.inf):
            newer.append(item)
            continue
        row = seen.rows.get(name)
        older.append(item)
        if row is None:
            agrees = agrees and item.param_index is None  # a list and its hash do not cover the others
        elif row.same_value(item):
            newer.append(item._replace(heard_at=row.heard_at))  # its index may have been unknown
        else:
            agrees = False
            if row.param_index is None and item.param_index is not None:
                older_row = row._replace(param_index=item.param_index, volatile=item.volatile, by=item.by)
                newer.append(older_row)
    count = None if update.table is None else update.table.count
    if is_late and table is not None and (count is None or table.count not in (None, count)):
        newer = [item._replace(param_index=None) for item in newer]  # the indices may belong to another count
    return replace(update, params=newer), older, agrees


def _first_changes(
    transaction: Transaction,
    owner: int,
    before: Mapping[str, StoredParam],
    added: Mapping[str, float],
    lines: Sequence[HistoryLine],
) -> list[tuple[str, float]]:
    """Return the observation times of first-table values that change now, as their rows lose these times.

    Args:
        transaction: the transaction.
        owner: id of the table.
        before: its rows.
        added: new names with the times of their first observations.
        lines: the changes.
    """
    _, _, known_since = transaction.component_row(owner)
    until = math.inf if known_since is None else known_since
    first = {
        name: before[name].heard_at if name in before else added.get(name, math.inf)
        for name in {line.name for line in lines}
    }
    changed = {name for name, at in first.items() if at < until}
    if changed:
        changed -= transaction.first_times(owner).keys()
    return [(name, first[name]) for name in sorted(changed)]


@dataclass
class _Seen:
    """The stored state of a table before an update.

    Attributes:
        transaction: the transaction.
        owner: id of the table.
        table: the table; None if there was none.
        rows: its parameters.
        horizon: unix seconds; later stored times are from before the clock was set back.
        removal_times: times of the last removals by name, loaded on first use.
    """

    transaction: Transaction
    owner: int
    table: CachedSummary | None
    rows: Mapping[str, StoredParam]
    horizon: float
    removal_times: Mapping[str, float] | None = None

    def is_newer(self, name: str, at: float) -> bool:
        """Return whether the cache has no later observation of a parameter.

        Args:
            name: the parameter.
            at: time of the observation, in unix seconds.
        """
        row, table = self.rows.get(name), self.table
        if row is not None:
            return row.heard_at <= at or row.heard_at > self.horizon
        if table is None or table.updated_at <= at or table.updated_at > self.horizon:
            return True
        is_whole = table.complete and table.size >= (table.count or 0)  # a new file may have only a part
        if is_whole and table.synced_at is not None and table.synced_at > at:
            return False
        if self.removal_times is None:
            self.removal_times = self.transaction.removal_times(self.owner)
        return self.removal_times.get(name, -math.inf) <= at


def _write_past(
    transaction: Transaction,
    owner: int,
    older: Sequence[StoredParam],
    lines: Sequence[HistoryLine],
    seen: _Seen,
) -> None:
    """Insert lines and overtaken observations into the history, by time."""
    times = [item.heard_at for item in older] + [line.at for line in lines]
    if not times:
        return
    since = min(times)
    if not older and not since < transaction.last_line_at(owner) <= seen.horizon:
        write_lines(transaction, owner, sorted(lines, key=attrgetter("at")))
        return
    _, _, known_since = transaction.component_row(owner)
    kept: list[NumberedLine] = transaction.lines_from(owner, since)
    ahead = max((place for place, (_, line) in enumerate(kept, 1) if line.at > seen.horizon), default=0)
    kept = kept[ahead:]
    history = TableHistory(list(kept), known_since, transaction.first_times(owner))
    for item in older:
        became = transaction.last_became(owner, item.name, since)
        history.observe(item, seen.rows.get(item.name), ahead=became)
    for line in lines:  # after the observations, which refer to the rows before these changes
        history.add(line)
    transaction.add_first_times(owner, history.new_added_names.items())
    if history.lines == kept:
        return
    if history.lines[: len(kept)] == kept:
        transaction.add_lines(owner, [line for _, line in history.lines[len(kept) :]])
    else:
        transaction.replace_lines(owner, history.lines, start=kept[0][0])
    at = transaction.trim_lines(owner, history_columns.HISTORY_ENTRIES_MAX)
    if at is not None:
        transaction.raise_known_since(owner, at)


def _respectful(update: TableUpdate, table: CachedSummary) -> TableState | None:
    """Return the table state of an update; None if the stored state has more information."""
    state = update.table
    if state is None or state.complete or update.replace or not table.complete:
        return state
    has_received_less = state.count == table.count or (state.count is None and not update.params)
    return None if has_received_less else state
