"""Snapshots of tables, and tables at an earlier time. Each function runs in a transaction."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from datetime import UTC, datetime
from typing import Any, Final, TypeAlias

from paramclient.cache.history import values_at
from paramclient.cache.records import (
    Snapshot,
    SnapshotSummary,
    StoredParam,
    StoredValue,
    default_value,
    written_value,
)
from paramclient.cache.schema import IDENTITY, Transaction
from paramclient.cache.tables import identity_cells, load_rows, read_identity, time_cell
from paramclient.errors import NotInCache, UsageError
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import bits_of, from_bits

__all__ = [
    "SNAPSHOTS",
    "end_operation",
    "load_snapshot",
    "load_summaries",
    "param_set_rows",
    "state_at",
    "store_snapshot",
    "stored_rows",
]

SNAPSHOTS: Final = 50
"""Maximum number of snapshots of each table, the newest: one is stored before each applied file, so they
cover weeks of work on one vehicle."""

SnapshotRow: TypeAlias = tuple[str, StoredValue, bytes | None]
"""Name, value and default of a parameter of a snapshot."""

_SUMMARY: Final = (
    "s.id, c.vehicle, c.component, s.at, s.reason,"
    " (SELECT count(*) FROM snapshot_parameter p WHERE p.snapshot = s.id), s.hash, s.complete, s.ended"
)
_FROM: Final = "FROM snapshot s JOIN component c ON c.id = s.owner"


def store_snapshot(
    tx: Transaction,
    owner: int,
    identity: Identity,
    rows: list[SnapshotRow],
    *,
    at: float,
    reason: str,
    hash: int | None = None,  # noqa: A002  # the word of the record
    complete: bool,
    is_of_operation: bool = False,
) -> int:
    """Store a snapshot of a table, delete the oldest ones beyond `SNAPSHOTS`, and return its number."""
    text = reason.encode("utf-8", "backslashreplace").decode()  # a file name in it may not be UTF-8
    [(number,)] = tx.all(
        "INSERT INTO snapshot (owner, at, reason, identity, hash, complete, ended)"
        " VALUES (?, ?, ?, ?, ?, ?, ?) RETURNING id",
        (
            owner,
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
        (owner, owner),
    )
    return int(number)


def end_operation(tx: Transaction, number: int) -> None:
    """Record that the `apply` or `restore` that has stored a snapshot has ended."""
    tx.do("UPDATE snapshot SET ended = 1 WHERE id = ?", (number,))


def load_summaries(
    tx: Transaction, key: str, component: int | None, *, extended: bool
) -> list[SnapshotSummary]:
    """Return the snapshots of a vehicle's tables, newest last."""
    where = "c.vehicle = ? AND c.extended = ?" + ("" if component is None else " AND c.component = ?")
    values = (key, int(extended), *(() if component is None else (component,)))
    return [_summary(row) for row in tx.all(f"SELECT {_SUMMARY} {_FROM} WHERE {where} ORDER BY s.id", values)]


def load_snapshot(tx: Transaction, owner: int, number: int) -> Snapshot:
    """Return a snapshot of a table.

    Raises:
        NotInCache: the table has no such snapshot.
    """
    known, identity, rows = _load(tx, owner, number)
    written = {name: _written(name, value, default) for name, value, default in rows}
    source = f"snapshot {number} of {known['key']}"
    content = ParamSet(written, known["component"], identity.system, identity, known["at"], source)
    return Snapshot(**known, params=content)


def _table_at(
    tx: Transaction, owner: int, when: float
) -> tuple[dict[str, StoredValue], Identity, int, float]:
    """Return the values that a table had at a time, the vehicle, the component id, and the time.

    The identity is the last known one, without the firmware: only a snapshot has that of its time.

    Raises:
        NotInCache: the history of the table begins later, or the table was never complete.
    """
    when = time_cell(when)
    [(key, component, since)] = tx.all(
        "SELECT vehicle, component, known_since FROM component WHERE id = ?", (owner,)
    )
    if since is None or when < since:
        near = tx.all(
            "SELECT id, at FROM snapshot WHERE owner = ? ORDER BY abs(at - ?), id LIMIT 2", (owner, when)
        )
        listed = " and ".join(f"snapshot {number} of {_second(at)}" for number, at in sorted(near))
        reach = (
            "is not known: its table was never complete"
            if since is None
            else f"at {_second(when)} is not known: what is kept of its history begins at {_second(since)}"
        )
        kept = f"there is {listed}" if listed else "there is no snapshot"
        raise NotInCache(f"the state of {key}, component {component}, {reach}; {kept}")
    [cells] = tx.all(f"SELECT {IDENTITY} FROM vehicle WHERE key = ?", (key,))
    identity = replace(read_identity(cells), firmware=0, git_hash="", capabilities=0)
    return values_at(tx, owner, load_rows(tx, owner), when), identity, component, when


def state_at(tx: Transaction, owner: int, when: float) -> ParamSet:
    """Return a table as it was at a time. Errors as of `_table_at`."""
    values, identity, component, at = _table_at(tx, owner, when)
    written = {name: _written(name, value, None) for name, value in values.items()}
    return ParamSet(written, component, identity.system, identity, at, f"history of {identity.key}")


def stored_rows(rows: Mapping[str, StoredParam]) -> list[SnapshotRow]:
    """Return the parameters of a stored table as those of a snapshot."""
    return [(name, row.stored, row.default) for name, row in rows.items()]


def param_set_rows(params: ParamSet) -> list[SnapshotRow]:
    """Return the parameters of a set as those of a snapshot.

    Raises:
        UsageError: the type of a parameter is unknown, or does not hold its value.
    """
    rows: list[SnapshotRow] = []
    for name, each in params.items():
        if each.type_number is None:
            raise UsageError(f"a snapshot has the type of each parameter; that of {name} is not known")
        value = written_value(each.type_number, each.bits_as(each.type_number), is_raw=each.is_raw)
        default = None
        if each.default is not None:
            default = written_value(each.type_number, bits_of(each.default, each.type_number), is_raw=False)
        rows.append((name, value, None if default is None else default.value))
    return rows


def _load(tx: Transaction, owner: int, number: int) -> tuple[dict[str, Any], Identity, list[SnapshotRow]]:
    """Return the attributes of a snapshot's summary, the identity of the vehicle, and the parameters."""
    where = f"{_FROM} WHERE s.owner = ? AND s.id = ?"
    found = tx.all(f"SELECT s.identity, {_SUMMARY} {where}", (owner, number))
    if not found:
        kept = tx.all("SELECT id FROM snapshot WHERE owner = ? ORDER BY id", (owner,))
        listed = f"those kept are {', '.join(str(each) for (each,) in kept)}" if kept else "none is kept"
        raise NotInCache(f"there is no snapshot {number} of this table: {listed}")
    [(described, *row)] = found
    summary = _summary(row)
    rows: list[SnapshotRow] = [
        (name, StoredValue(number_, value, is_raw), default)
        for name, number_, value, is_raw, default in tx.all(
            "SELECT name, type, value, is_raw, default_value FROM snapshot_parameter"
            " WHERE snapshot = ? ORDER BY position",
            (number,),
        )
    ]
    known = {each.name: getattr(summary, each.name) for each in fields(SnapshotSummary)}
    return known, read_identity(json.loads(described)), rows


def _summary(row: Sequence[Any]) -> SnapshotSummary:
    number, key, component, at, reason, size, hash_, complete, ended = row
    is_ended = None if ended is None else bool(ended)
    return SnapshotSummary(number, key, component, at, reason, size, hash_, bool(complete), is_ended)


def _written(name: str, value: StoredValue, default: bytes | None) -> WrittenParam:
    number, bits, is_raw = value
    settable = from_bits(int.from_bytes(bits, "little"), number, is_raw=bool(is_raw))
    return WrittenParam(name, settable, number, default_value(default, number))


def _second(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%dT%H:%M:%SZ}"
