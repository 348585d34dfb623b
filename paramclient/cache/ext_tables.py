"""Tables of extended parameters and their history: updates, reads, and copies between stores.

The rules are those of plain tables, without a hash: the later of two observations
of a value counts, and every change of a stored value leaves a line of history in the same transaction. An
observation that arrives after a newer one is dropped.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from paramclient.cache.cells import time_cell
from paramclient.cache.ext_records import (
    CachedExtTable,
    ExtLine,
    ExtTableUpdate,
    StoredExtParam,
    ext_checksum,
)
from paramclient.cache.history_columns import HISTORY_ENTRIES_MAX
from paramclient.cache.param_columns import BY_VEHICLE
from paramclient.cache.reconciliation import reconcile
from paramclient.cache.records import TableUpdate
from paramclient.cache.snapshots import CLOCK_SLACK
from paramclient.cache.transaction import ExtState, Transaction
from paramclient.model.ext_params import ExtParam

__all__ = ["ExtDump", "load_ext", "put_ext", "save_ext", "take_ext"]


@dataclass(frozen=True)
class ExtDump:
    """All stored data of one table of extended parameters.

    Attributes:
        count, complete: as in `CachedExtTable`.
        rows: its parameters by name.
        lines: its history lines, in order.
        known_since: time since which its states are known, or None.
    """

    count: int | None
    complete: bool
    rows: Mapping[str, StoredExtParam]
    lines: tuple[ExtLine, ...]
    known_since: float | None

    @property
    def heard_last(self) -> float:
        """The time of the last observation; minus infinity for an empty table."""
        return max((row.heard_at for row in self.rows.values()), default=-math.inf)

    def lacks(self, other: ExtDump) -> str | None:
        """Return what this table lacks of another one; None if it has all of it, or later data."""
        removed = {line[1] for line in self.lines if line[5] is None}
        for name, row in other.rows.items():
            mine = self.rows.get(name)
            if (mine is None and name not in removed) or (mine is not None and mine.heard_at < row.heard_at):
                return f"extended parameter {name}"
        first = self.lines[0][0] if len(self.lines) >= HISTORY_ENTRIES_MAX else 0.0
        if any(line[0] >= first for line in set(other.lines) - set(self.lines)):
            return "a line of the history of extended parameters"
        return None

    def joined(self, other: ExtDump) -> ExtDump:
        """Return the union of one table of two stores: the later observation of a value counts.

        If both have changes of their own, earlier states are not available before this merge, as two
        independent histories form no sequence.
        """
        rows = dict(self.rows)
        for name, row in other.rows.items():
            mine = rows.get(name)
            if mine is None or mine.heard_at < row.heard_at:
                rows[name] = row
        lines = sorted(dict.fromkeys((*self.lines, *other.lines)), key=lambda line: line[0])
        gone = {line[1]: line[0] for line in lines if line[5] is None}
        rows = {name: row for name, row in rows.items() if row.heard_at > gone.get(name, -math.inf)}
        later = max(self, other, key=lambda each: each.heard_last)
        is_complete = later.complete and set(rows) == set(later.rows)
        is_continued = set(lines) == set(later.lines)
        since = later.known_since if is_continued else max(self.heard_last, other.heard_last)
        return ExtDump(later.count, is_complete, rows, tuple(lines[-HISTORY_ENTRIES_MAX:]), since)


def save_ext(
    transaction: Transaction, updates: Iterable[ExtTableUpdate], present: float | None = None
) -> None:
    """Write updates, see `ParamCache.save_ext`.

    Args:
        transaction: the transaction.
        updates: the updates, in order of execution.
        present: current time by the clock of the updates, in unix seconds; None uses `at` of each update.
    """
    for update in updates:
        for row in update.params:
            time_cell(row.heard_at)
        known = TableUpdate(
            identity=update.identity, component=update.component, autopilot=update.autopilot, at=update.at
        )
        reconcile(transaction, [known], present)
        owner = transaction.owner_of(update.identity.key, update.component)
        assert owner is not None, "it was written just now"
        now = max(time_cell(update.at), 0.0 if present is None else present)
        _write(transaction, owner, update, math.inf if transaction.is_shared else now + CLOCK_SLACK)


def _write(transaction: Transaction, owner: int, update: ExtTableUpdate, horizon: float) -> None:
    """Write the values of an update. A stored time after `horizon` is older than every observation."""
    before = transaction.ext_rows(owner)
    after = dict(before)
    lines: list[ExtLine] = []
    for name, at in update.removed.items():
        old = after.get(name)
        if old is not None and not at < old.heard_at <= horizon:
            del after[name]
            lines.append((time_cell(at), name, BY_VEHICLE, old.type, old.raw, None, None))
    for new in update.params:
        old = after.get(new.name)
        if old is None:
            after[new.name] = new._replace(by="")
        elif not new.heard_at < old.heard_at <= horizon:
            index = old.param_index if new.param_index is None else new.param_index
            after[new.name] = new._replace(param_index=index, by="")
            if not old.param.same_value(new.param):
                lines.append((new.heard_at, new.name, new.by, old.type, old.raw, new.type, new.raw))
    state = transaction.ext_state(owner)
    count = update.count if update.count is not None or state is None else state.count
    complete = update.complete
    if complete is None:
        complete = state is not None and state.complete
    since = None if state is None else state.known_since
    if since is None and complete:
        since = max([time_cell(update.at), *(row.heard_at for row in after.values())])
    transaction.put_ext_rows(owner, before, after)
    if lines:
        transaction.add_ext_lines(owner, lines)
        dropped = transaction.trim_ext_lines(owner, HISTORY_ENTRIES_MAX)
        if dropped is not None and since is not None:
            since = max(since, dropped)
    transaction.put_ext_state(owner, ExtState(count, complete, ext_checksum(after), since))


def load_ext(transaction: Transaction, key: str, component: int) -> CachedExtTable | None:
    """Return the extended parameters of a component; None if there are none."""
    owner = transaction.owner_of(key, component)
    state = None if owner is None else transaction.ext_state(owner)
    if owner is None or state is None:
        return None
    rows = transaction.ext_rows(owner)
    params: dict[str, ExtParam] = {name: row.param for name, row in rows.items()}
    heard_at = {name: row.heard_at for name, row in rows.items()}
    return CachedExtTable(key, component, params, heard_at, state.count, state.complete)


def take_ext(transaction: Transaction, owner: int) -> ExtDump | None:
    """Return all stored data of a table of extended parameters; None if there is none."""
    state = transaction.ext_state(owner)
    if state is None:
        return None
    rows, lines = transaction.ext_rows(owner), tuple(transaction.ext_lines(owner))
    return ExtDump(state.count, state.complete, rows, lines, state.known_since)


def put_ext(transaction: Transaction, owner: int, whole: ExtDump | None) -> None:
    """Replace a table of extended parameters; None removes it."""
    transaction.drop_ext(owner)
    if whole is not None:
        transaction.put_ext_rows(owner, {}, whole.rows)
        state = ExtState(whole.count, whole.complete, ext_checksum(whole.rows), whole.known_since)
        transaction.put_ext_state(owner, state)
        transaction.add_ext_lines(owner, whole.lines)
