"""Snapshots of tables, and tables at an earlier time. Each function runs in a transaction."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Final

from paramclient.cache.database import Transaction
from paramclient.cache.history import values_at
from paramclient.cache.records import SnapshotSummary, StoredParam, StoredTable, StoredValue
from paramclient.cache.tables import identity_cells, load_rows, read_identity, time_cell
from paramclient.errors import NotInCache, UsageError
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param

SNAPSHOTS: Final = 50
"""Maximum number of snapshots of each table, the newest: one is stored before each applied file, so they
cover weeks of work on one vehicle."""


def store_snapshot(
    tx: Transaction, owner: int, new: SnapshotSummary, identity: Identity, rows: Sequence[StoredParam]
) -> SnapshotSummary:
    """Store a snapshot of a table, delete the oldest ones beyond `SNAPSHOTS`, and return it.

    Its number and its size are those that it gets.
    """
    stored = [(each.name, *each.stored, each.default) for each in rows if each.stored is not None]
    reason = new.reason.encode("utf-8", "backslashreplace").decode()  # a file name in it may not be UTF-8
    reason = reason.replace("\0", "\\x00")  # PostgreSQL's text type does not allow NUL
    at, ended = round(new.at, 3), None if new.ended is None else int(new.ended)
    [(number,)] = tx.all(
        "INSERT INTO snapshot (owner, at, reason, identity, hash, complete, ended)"
        " VALUES (?, ?, ?, ?, ?, ?, ?) RETURNING id",
        (owner, at, reason, json.dumps(identity_cells(identity)), new.hash, int(new.complete), ended),
    )
    tx.many(
        "INSERT INTO snapshot_parameter (snapshot, position, name, type, value, default_value)"
        " VALUES (?, ?, ?, ?, ?, ?)",
        [(number, place, *cells) for place, cells in enumerate(stored)],
    )
    tx.do(
        "DELETE FROM snapshot WHERE owner = ? AND id NOT IN"
        f" (SELECT id FROM snapshot WHERE owner = ? ORDER BY id DESC LIMIT {SNAPSHOTS})",
        (owner, owner),
    )
    return replace(new, id=number, at=at, reason=reason, size=len(stored))


def end_operation(tx: Transaction, number: int) -> None:
    """Record that the `apply` or `restore` that has stored a snapshot has ended."""
    tx.do("UPDATE snapshot SET ended = 1 WHERE id = ?", (number,))


def load_snapshots(tx: Transaction, table: StoredTable) -> list[SnapshotSummary]:
    """Return the snapshots of a table, newest last."""
    found = tx.all(
        "SELECT id, at, reason,"
        " (SELECT count(*) FROM snapshot_parameter WHERE snapshot = snapshot.id), hash, complete, ended"
        " FROM snapshot WHERE owner = ? ORDER BY id",
        (table.owner,),
    )
    return [
        SnapshotSummary(
            *(number, table.summary.key, table.summary.component, at, reason, size, hash_, bool(complete)),
            None if ended is None else bool(ended),
        )
        for number, at, reason, size, hash_, complete, ended in found
    ]


def load_state(tx: Transaction, table: StoredTable, when: float) -> ParamSet:
    """Return an earlier state of a table.

    Args:
        tx: the transaction.
        table: the table.
        when: a float is a time, in unix seconds; an int is the id of a snapshot.

    Raises:
        NotInCache: there is no such snapshot; or the history begins later, or the table was never complete.
        UsageError: the time is not in unix seconds.
    """
    if isinstance(when, int):
        return _of_snapshot(tx, table, when)
    when = time_cell(when)
    snapshots = load_snapshots(tx, table)
    for each in snapshots:
        if each.at == when:
            return _of_snapshot(tx, table, each.id)
    since, known = table.known_since, table.summary
    if since is None or when < since:
        reach = "its table was never complete" if since is None else f"the history begins at {_second(since)}"
        kept = ", ".join(f"{each.id} of {_second(each.at)}" for each in snapshots) or "none"
        raise NotInCache(
            f"the state of {known.key}, component {known.component}, at {_second(when)} is not known:"
            f" {reach}; snapshots: {kept}"
        )
    identity = replace(known.identity, firmware=0, git_hash="", capabilities=0)
    values = values_at(tx, table.owner, load_rows(tx, table.owner), when)
    params = [value.param(name) for name, value in values.items()]
    return _param_set(params, table, identity, when, f"history of {known.key}")


def rows_of(params: ParamSet) -> list[StoredParam]:
    """Return the parameters of a set as those of a snapshot.

    Raises:
        UsageError: the type of a parameter is unknown, or does not hold its value.
    """
    untyped = [name for name, each in params.items() if each.type is None]
    if untyped:
        raise UsageError(f"a snapshot has the type of each parameter; that of {untyped[0]} is not known")
    return [StoredParam.of(each, 0.0) for each in params.values()]


def _of_snapshot(tx: Transaction, table: StoredTable, number: int) -> ParamSet:
    key, component = table.summary.key, table.summary.component
    found = tx.all("SELECT at, identity FROM snapshot WHERE owner = ? AND id = ?", (table.owner, number))
    if not found:
        kept = [str(each.id) for each in load_snapshots(tx, table)]
        listed = f"those kept are {', '.join(kept)}" if kept else "none is kept"
        raise NotInCache(f"there is no snapshot {number} of {key}, component {component}: {listed}")
    [(at, described)] = found
    rows = tx.all(
        "SELECT name, default_value, type, value FROM snapshot_parameter"
        " WHERE snapshot = ? ORDER BY position",
        (number,),
    )
    params = [StoredValue(*value).param(name, None, default) for name, default, *value in rows]
    return _param_set(params, table, read_identity(json.loads(described)), at, f"snapshot {number} of {key}")


def _param_set(
    params: Iterable[Param], table: StoredTable, identity: Identity, at: float, source: str
) -> ParamSet:
    known = table.summary
    system = known.identity.system
    return ParamSet({each.name: each for each in params}, known.component, system, identity, at, source)


def _second(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%dT%H:%M:%SZ}"
