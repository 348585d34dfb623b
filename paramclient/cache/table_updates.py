"""Updates of tables and their history lines. Each function runs inside the transaction of its caller.

Only `apply_update` creates history lines: it compares every new value with the stored one, and a difference
gives a line, written in the same transaction. Therefore every change of a stored value has its line, and if
two processes receive the same change, the second one has nothing to write. `reconcile` and `merge` decide
which values count.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

from paramclient.cache import history_columns, snapshots
from paramclient.cache.cells import are_times, time_cell
from paramclient.cache.history_columns import NO_VALUE, HistoryLine
from paramclient.cache.observed_table import ObservedParams
from paramclient.cache.param_columns import BY_VEHICLE, StoredParam
from paramclient.cache.records import CachedComponent, HistoryEntry, TableState, TableUpdate
from paramclient.cache.transaction import Transaction
from paramclient.model.identity import Identity

__all__ = [
    "apply_update",
    "check_times",
    "component",
    "forget_other_firmware",
    "hashed",
    "observation_times",
    "save",
    "write_lines",
    "write_state",
]


def save(transaction: Transaction, updates: Iterable[TableUpdate]) -> None:
    """Write updates in order. All of them are later than the stored values."""
    for update in updates:
        forget_other_firmware(transaction, update.identity)
        snapshots.record_clock_rollback(
            transaction, update.identity.key, update.component, time_cell(update.at)
        )
        owner = transaction.upsert_table(update)
        before: Mapping[str, StoredParam] = {}
        after = before
        if update.params or update.removed or update.replace:  # otherwise it has only the state of the table
            before = transaction.table(owner)
            after, lines, added = apply_update(update, before)
            if len(after) != len(before) or after != before:
                transaction.put_table(owner, before, after)
            transaction.record_added_names(owner, added)
            write_lines(transaction, owner, lines)
        if update.table is not None:
            write_state(transaction, owner, update.table)
            if update.table.complete:
                transaction.set_known_since(owner, update.at)
        elif hashed(before) != hashed(after):
            transaction.update_component(owner, hash=None)


def component(
    transaction: Transaction,
    key: str,
    number: int,
    *,
    history: Callable[[str | None, int | None], list[HistoryEntry]],
) -> CachedComponent | None:
    """Return a table with its parameters; None if there is none."""
    for owner, summary in transaction.summaries(key, number):
        return CachedComponent.of(summary, transaction.columns(owner), history=history)
    return None


def forget_other_firmware(transaction: Transaction, identity: Identity) -> None:
    """If a vehicle has another firmware than before, remove defaults and state of the previous one."""
    for owner in transaction.of_other_firmware(identity.key, identity.firmware, identity.git_hash):
        before = transaction.table(owner)
        after = {name: row._replace(default_bits=None) for name, row in before.items()}
        if after != before:
            transaction.put_table(owner, before, after)
        transaction.update_component(owner, file_works=None)


def apply_update(
    update: TableUpdate, before: Mapping[str, StoredParam], stays: Collection[str] = ()
) -> tuple[Mapping[str, StoredParam], list[HistoryLine], Iterable[tuple[str, float]]]:
    """Return the rows after an update, its history lines, and the new names with their times.

    Args:
        update: the update, without overtaken values.
        before: the stored rows.
        stays: names that the update does not remove.
    """
    if not before and isinstance(update.params, ObservedParams):
        first = update.params.first_table()
        if first is not None:
            return first, [], zip(first, first.column("heard_at"), strict=True)
    after = dict(before)
    added: list[tuple[str, float]] = []
    observations = list(update.params)
    observed = {item.name for item in observations}
    lines: list[HistoryLine] = [
        HistoryLine.of(update.removal_time(name), name, BY_VEHICLE, after.pop(name).value, NO_VALUE)
        for name in dict.fromkeys(before if update.replace else update.removed)
        if name in before and name not in observed and name not in stays
    ]
    for item in observations:
        name = item.name
        old = after.get(name)
        after[name] = item.stored_over(old, keeps_index=not update.replace)
        if old is None:
            added.append((name, item.heard_at))
        elif not old.same_value(item):
            lines.append(HistoryLine.of(item.heard_at, name, item.by, old.value, item.value))
    return after, lines, added


def check_times(update: TableUpdate) -> None:
    """Check the times of all observations of an update.

    Raises:
        UsageError: a time is not in unix seconds.
    """
    times = [at for _, at in observation_times(update.params)]
    if not are_times(times):
        for at in times:
            time_cell(at)


def observation_times(params: Sequence[StoredParam]) -> Iterable[tuple[str, float]]:
    """Return the names and times of observations."""
    if isinstance(params, ObservedParams):
        return params.heard_at()
    return ((item.name, item.heard_at) for item in params)


def hashed(rows: Mapping[str, StoredParam]) -> dict[str, tuple[int, int, int]]:
    """Return the values that the vehicle's hash covers, by name."""
    return {name: row.hashed for name, row in rows.items() if row.hashed is not None}


def write_lines(transaction: Transaction, owner: int, lines: Sequence[HistoryLine]) -> None:
    """Append history lines, and delete the oldest beyond `HISTORY_ENTRIES_MAX`."""
    if not lines:
        return
    transaction.add_lines(owner, lines)
    at = transaction.trim_lines(owner, history_columns.HISTORY_ENTRIES_MAX)
    if at is not None:
        transaction.raise_known_since(owner, at)


def write_state(transaction: Transaction, owner: int, state: TableState) -> None:
    """Write the state of a table as a whole."""
    if state.source is not None or state.synced_at is not None:
        transaction.update_component(owner, source=state.source)
    transaction.update_component(
        owner,
        hash=state.hash,
        count=state.count,
        complete=state.complete,
        volatile_known=state.volatile_known,
        synced_at=None if state.synced_at is None else time_cell(state.synced_at),
        file_works=state.file_works,
    )
