"""Snapshots of tables, and tables at an earlier time. Each function runs in a transaction."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Final, TypeAlias

from paramclient.cache.database import Transaction
from paramclient.cache.history import values_at
from paramclient.cache.records import (
    SnapshotSummary,
    StoredParam,
    StoredTable,
    StoredValue,
    written_value,
)
from paramclient.cache.tables import (
    identity_cells,
    load_rows,
    read_identity,
    time_cell,
)
from paramclient.errors import NotInCache, UsageError
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import bits_of

__all__ = [
    "SNAPSHOTS",
    "SnapshotRow",
    "end_operation",
    "load_snapshots",
    "load_state",
    "rows_of",
    "rows_of_table",
    "store_snapshot",
]

SNAPSHOTS: Final = 50
"""Maximum number of snapshots of each table, the newest: one is stored before each applied file, so they
cover weeks of work on one vehicle."""

SnapshotRow: TypeAlias = tuple[str, StoredValue, bytes | None]
"""Name, value and default of a parameter."""


def store_snapshot(
    tx: Transaction,
    table: StoredTable,
    identity: Identity,
    rows: Sequence[SnapshotRow],
    *,
    at: float,
    reason: str,
    hash: int | None,  # noqa: A002  # the word of the record
    complete: bool,
    is_of_operation: bool,
) -> SnapshotSummary:
    """Store a snapshot of a table, delete the oldest ones beyond `SNAPSHOTS`, and return it."""
    text = reason.encode("utf-8", "backslashreplace").decode()  # a file name in it may not be UTF-8
    [(number,)] = tx.all(
        "INSERT INTO snapshot (owner, at, reason, identity, hash, complete, ended)"
        " VALUES (?, ?, ?, ?, ?, ?, ?) RETURNING id",
        (
            table.owner,
            round(time_cell(at), 3),
            text.replace("\0", "\\x00"),  # PostgreSQL's text type does not allow NUL
            json.dumps(identity_cells(identity)),
            hash,
            int(complete),
            0 if is_of_operation else None,
        ),
    )
    tx.many(
        "INSERT INTO snapshot_parameter (snapshot, position, name, type, value, is_raw, default_value)"
        " VALUES (?, ?, ?, ?, ?, ?, ?)",
        [(number, place, name, *value, default) for place, (name, value, default) in enumerate(rows)],
    )
    tx.do(
        "DELETE FROM snapshot WHERE owner = ? AND id NOT IN"
        f" (SELECT id FROM snapshot WHERE owner = ? ORDER BY id DESC LIMIT {SNAPSHOTS})",
        (table.owner, table.owner),
    )
    return load_snapshots(tx, table)[-1]


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
    rows: list[SnapshotRow] = [(name, value, None) for name, value in values.items()]
    return _param_set(rows, table, identity, when, f"history of {known.key}")


def rows_of_table(rows: Mapping[str, StoredParam]) -> list[SnapshotRow]:
    """Return the parameters of a stored table as those of a snapshot."""
    return [(name, row.stored, row.default) for name, row in rows.items() if row.stored is not None]


def rows_of(params: ParamSet) -> list[SnapshotRow]:
    """Return the parameters of a set as those of a snapshot.

    Raises:
        UsageError: the type of a parameter is unknown, or does not hold its value.
    """
    rows: list[SnapshotRow] = []
    for name, each in params.items():
        number = each.type_number
        if number is None:
            raise UsageError(f"a snapshot has the type of each parameter; that of {name} is not known")
        value = written_value(number, each.bits_as(number), is_raw=each.is_raw)
        default = None
        if each.default is not None:
            default = written_value(number, bits_of(each.default, number), is_raw=False).value
        rows.append((name, value, default))
    return rows


def _of_snapshot(tx: Transaction, table: StoredTable, number: int) -> ParamSet:
    key, component = table.summary.key, table.summary.component
    found = tx.all("SELECT at, identity FROM snapshot WHERE owner = ? AND id = ?", (table.owner, number))
    if not found:
        kept = [str(each.id) for each in load_snapshots(tx, table)]
        listed = f"those kept are {', '.join(kept)}" if kept else "none is kept"
        raise NotInCache(f"there is no snapshot {number} of {key}, component {component}: {listed}")
    [(at, described)] = found
    rows: list[SnapshotRow] = [
        (name, StoredValue(*value), default)
        for name, default, *value in tx.all(
            "SELECT name, default_value, type, value, is_raw FROM snapshot_parameter"
            " WHERE snapshot = ? ORDER BY position",
            (number,),
        )
    ]
    return _param_set(rows, table, read_identity(json.loads(described)), at, f"snapshot {number} of {key}")


def _param_set(
    rows: Iterable[SnapshotRow], table: StoredTable, identity: Identity, at: float, source: str
) -> ParamSet:
    params = {}
    for name, stored, default in rows:
        each = stored.param(name, None, default)
        params[name] = WrittenParam(name, each.value, stored.type, each.default, is_raw=each.is_raw)
    known = table.summary
    return ParamSet(params, known.component, known.identity.system, identity, at, source)


def _second(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%dT%H:%M:%SZ}"
