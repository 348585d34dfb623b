"""Copies of whole tables between stores, with history, snapshots and vehicle identity."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Final

from paramclient.cache.ext_tables import ExtDump, put_ext, take_ext
from paramclient.cache.history_columns import HISTORY_ENTRIES_MAX, NO_VALUE, HistoryLine
from paramclient.cache.operations import StoreOperation
from paramclient.cache.param_columns import StoredParam
from paramclient.cache.records import CachedSummary, CachedVehicle, SnapshotSummary, TableState, TableUpdate
from paramclient.cache.snapshots import SNAPSHOTS
from paramclient.cache.table_updates import hashed, write_state
from paramclient.cache.transaction import Transaction
from paramclient.errors import CacheError, UsageError

if TYPE_CHECKING:
    from paramclient.cache.interface import Store

__all__ = [
    "CopyResult",
    "MergeTable",
    "LOCAL_NUMBERS_MIN",
    "StoredSnapshot",
    "TableDump",
    "copy_store",
    "put_snapshots",
    "put_whole",
    "take_whole",
]

LOCAL_NUMBERS_MIN: Final = 1 << 50
"""Smallest snapshot number that stations assign while the database is not connected. The database assigns
numbers below it."""


@dataclass(frozen=True)
class StoredSnapshot:
    """A snapshot as stored.

    Attributes:
        row: at, reason, size, hash, complete.
        blob: its encoded parameters; None if the target has them.
        crc: its checksum.
        is_extended: whether it is of extended parameters.
    """

    row: tuple[object, ...]
    blob: bytes | None = field(repr=False)
    crc: int
    is_extended: bool = False


@dataclass(frozen=True)
class TableDump:
    """All stored data of one table.

    Attributes:
        vehicle: the vehicle.
        table: its summary.
        known_since: time since which its states are known, or None.
        rows: its parameters by name.
        lines: its history lines, in order.
        added_names: name, time, and number of history lines at the appearance of the name.
        clock_rollbacks: periods, from and until, that the clock has passed twice.
        shots: its snapshots by number.
        ext: its extended parameters, or None.
    """

    vehicle: CachedVehicle
    table: CachedSummary
    known_since: float | None
    rows: Mapping[str, StoredParam]
    lines: tuple[HistoryLine, ...]
    added_names: tuple[tuple[str, float, int], ...]
    clock_rollbacks: tuple[tuple[float, float], ...]
    shots: Mapping[int, StoredSnapshot]
    ext: ExtDump | None = None

    def lacks(self, other: TableDump) -> str | None:
        """Return what this table lacks of another one; None if it has all of it, or later data."""
        for name, row in other.rows.items():
            mine = self.rows.get(name)
            if (mine is None and not self.was_removed(name)) or (
                mine is not None and mine.heard_at < row.heard_at
            ):
                return f"parameter {name}"
        gone = self.lines[0].at if len(self.lines) >= HISTORY_ENTRIES_MAX else 0.0
        if any(line.at >= gone for line in set(other.lines) - set(self.lines)):
            return "a line of history"
        shots = {shot.crc for shot in self.shots.values()}
        for is_extended in (False, True):
            wanted = {shot.crc for shot in other.shots.values() if shot.is_extended is is_extended}
            kept = sum(shot.is_extended is is_extended for shot in self.shots.values())
            if kept < SNAPSHOTS and not wanted <= shots:
                return "a snapshot"
        if other.ext is not None:
            return "its extended parameters" if self.ext is None else self.ext.lacks(other.ext)
        return None

    def was_removed(self, name: str) -> bool:
        """Return whether a history line removes a parameter."""
        return any(line.name == name and line.new == NO_VALUE for line in self.lines)


@dataclass(frozen=True)
class CopyResult:
    """Result of a copy of a cache.

    Attributes:
        tables: number of written tables.
        unchanged: number of tables that were already complete in the target.
        params, lines, snapshots: numbers of parameters, history lines and snapshots in the source.
    """

    tables: int
    unchanged: int
    params: int
    lines: int
    snapshots: int


@dataclass(frozen=True)
class MergeTable(StoreOperation[None]):
    """Merge a whole table into a store: the later observation of a value counts."""

    whole: TableDump

    @property
    def tables(self) -> Iterable[tuple[str, int | None]]:
        return [(self.whole.table.key, self.whole.table.component)]

    def do(self, transaction: Transaction) -> None:
        table = self.whole.table
        there = take_whole(transaction, table.key, table.component)
        owner = put_whole(transaction, self.whole if there is None else _joined(there, self.whole))
        mine = set() if there is None else {shot.crc for shot in there.shots.values()}
        for number, shot in self.whole.shots.items():
            if shot.crc not in mine and shot.blob is not None:
                is_free = number < LOCAL_NUMBERS_MIN and not transaction.has_snapshot(number)
                transaction.add_snapshot(
                    owner,
                    shot.row,
                    shot.blob,
                    shot.crc,
                    number if is_free else None,
                    is_extended=shot.is_extended,
                )


def copy_store(
    source: Store, target: Store, progress: Callable[[str, int, int], None] | None = None
) -> CopyResult:
    """Copy every table of a store to another one, and verify the copy.

    Each table is one transaction. A table that is already complete in the target is skipped: an interrupted
    copy can be repeated.

    Args:
        source: the store to copy.
        target: the store to write.
        progress: called for each table with the key of the vehicle, the number of the table, and the total.

    Raises:
        CacheError: a store cannot be used, or the verification failed.
        UsageError: both stores are the same.
    """
    if source.place == target.place:
        raise UsageError(f"{source.place} cannot be copied to itself")
    listed = source.read(lambda transaction: [summary for _, summary in transaction.summaries()])
    written = params = lines = shots = 0
    for number, each in enumerate(listed, start=1):
        if progress is not None:
            progress(each.key, number, len(listed))
        key, component = each.key, each.component
        found = source.read(partial(take_whole, key=key, component=component))
        if found is None:
            continue  # it was removed meanwhile
        if _lacking(target, found) is not None:
            target.do(MergeTable(found))
            lacking = _lacking(target, found)
            if lacking is not None:
                raise CacheError(
                    f"{lacking} of {key}, component {component}, is missing in {target.place}; copy again"
                )
            written += 1
        params += len(found.rows)
        lines += len(found.lines)
        shots += len(found.shots)
    return CopyResult(written, len(listed) - written, params, lines, shots)


def take_whole(
    transaction: Transaction, key: str, component: int, having: Collection[int] = frozenset()
) -> TableDump | None:
    """Return all stored data of a table; None if there is none.

    Args:
        transaction: the transaction.
        key: key of the vehicle.
        component: component id.
        having: numbers of snapshots whose parameters are not needed.

    Raises:
        Damaged: the parameters are damaged.
        CacheError: a snapshot is damaged.
    """
    found = transaction.summaries(key, component)
    if not found:
        return None
    [(owner, table)] = found
    [vehicle] = transaction.vehicles(key)
    _, _, known_since = transaction.component_row(owner)
    numbered = transaction.lines(owner)
    order = {number: place for place, (number, _) in enumerate(numbered, start=1)}
    added = tuple(
        (name, at, max((place for number, place in order.items() if number <= line), default=0))
        for name, line, at in transaction.added_names(owner)
    )
    shots = {}
    for summary, is_extended in _snapshots(transaction, key, component):
        kept = transaction.snapshot(owner, summary.id, is_extended=is_extended)
        assert kept is not None
        _, row, blob, crc = kept
        if not isinstance(blob, bytes) or not isinstance(crc, int):
            raise CacheError(f"snapshot {summary.id} of {key}, component {component}, is damaged")
        shown = None if summary.id in having else blob
        shots[summary.id] = StoredSnapshot(tuple(row), shown, crc, is_extended)
    return TableDump(
        vehicle,
        table,
        known_since,
        transaction.table(owner),
        tuple(line for _, line in numbered),
        added,
        tuple(transaction.clock_rollbacks(owner)),
        shots,
        take_ext(transaction, owner),
    )


def put_whole(transaction: Transaction, whole: TableDump) -> int:
    """Replace a table in a store, except its snapshots. Return its id."""
    table = whole.table
    known = next(iter(transaction.vehicles(table.key)), None)
    last = whole.vehicle if known is None or known.last_seen <= whole.vehicle.last_seen else known
    owner = transaction.upsert_table(
        TableUpdate(
            identity=last.identity,
            component=table.component,
            autopilot=table.autopilot,
            at=table.updated_at,
        )
    )
    first = whole.vehicle.first_seen if known is None else min(known.first_seen, whole.vehicle.first_seen)
    transaction.set_seen_times(table.key, first, last.last_seen)
    transaction.put_table(owner, None, whole.rows)
    numbers = transaction.put_past(owner, whole.lines, whole.clock_rollbacks)
    transaction.put_added_names(
        owner, [(name, at, numbers[place - 1] if place else 0) for name, at, place in whole.added_names]
    )
    write_state(transaction, owner, _state(table))
    transaction.update_component(owner, known_since=whole.known_since)
    put_ext(transaction, owner, whole.ext)
    return owner


def put_snapshots(transaction: Transaction, owner: int, whole: TableDump) -> None:
    """Replace the snapshots of a table by those of another store, with equal numbers."""
    there = {each.id for each, _ in _snapshots(transaction, whole.table.key, whole.table.component)}
    transaction.drop_snapshots(there - whole.shots.keys())
    for number, shot in whole.shots.items():
        if number not in there and shot.blob is not None:
            transaction.add_snapshot(
                owner, shot.row, shot.blob, shot.crc, number, is_extended=shot.is_extended
            )


def _snapshots(transaction: Transaction, key: str, component: int) -> list[tuple[SnapshotSummary, bool]]:
    """Return the snapshots of a table, and whether each is of extended parameters."""
    return [
        (each, is_extended)
        for is_extended in (False, True)
        for each in transaction.snapshots(key, component, is_extended=is_extended)
    ]


def _lacking(target: Store, whole: TableDump) -> str | None:
    key, component = whole.table.key, whole.table.component
    there = target.read(lambda transaction: take_whole(transaction, key, component))
    return "everything" if there is None else there.lacks(whole)


def _joined(there: TableDump, new: TableDump) -> TableDump:
    """Return the union of one table of two stores, without snapshots.

    If one of them continues the other, earlier states remain available. If both have changes of their own,
    earlier states are not available before this merge, as two independent histories form no sequence.
    """
    later = new if there.table.updated_at < new.table.updated_at else there
    rows = dict(there.rows)
    for name, row in new.rows.items():
        mine = rows.get(name)
        if mine is None or mine.heard_at < row.heard_at:
            rows[name] = row
    rows = {name: row for name, row in rows.items() if name in later.rows or not later.was_removed(name)}
    table = later.table if hashed(rows) == hashed(later.rows) else replace(later.table, hash=None)
    lines = sorted(dict.fromkeys((*there.lines, *new.lines)), key=attrgetter("at"))
    ext = there.ext or new.ext
    if there.ext is not None and new.ext is not None:
        ext = there.ext.joined(new.ext)
    for whole in (there, new):
        if set(lines) == set(whole.lines) and whole is later:
            return replace(whole, table=table, rows=rows, ext=ext)
    return TableDump(
        later.vehicle,
        table,
        max(there.table.updated_at, new.table.updated_at),
        rows,
        tuple(lines[-HISTORY_ENTRIES_MAX:]),
        (),
        (),
        {},
        ext,
    )


def _state(table: CachedSummary) -> TableState:
    return TableState(
        hash=table.hash,
        count=table.count,
        complete=table.complete,
        volatile_known=table.volatile_known,
        synced_at=table.synced_at,
        file_works=table.file_works,
        source=table.source,
    )
