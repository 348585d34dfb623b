"""Earlier states of a table: snapshots, and what can be told of any other moment.

A state is worked backwards from the present table. Each line of history takes back one change. A name leaves
no line when it appears, so from the moment on when a table was first complete, every new name is noted with
its time (`birth`). That moment is `known_since`; it moves on as lines of history are dropped. Before it,
nothing is claimed. Nor is anything of a time that the clock of this computer went through twice, because it
was set back in between (`setback`).

Each function works inside its caller's transaction.
"""

from __future__ import annotations

import json
import sqlite3
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from datetime import UTC, datetime
from typing import Any, Final

from paramclient.cache.database import Damaged
from paramclient.cache.records import Snapshot, SnapshotSummary
from paramclient.cache.rows import Row, cells, identity_cells, read_identity, read_param, time_cell
from paramclient.errors import CacheError
from paramclient.identity import Identity
from paramclient.paramset import ParamSet, WrittenParam
from paramclient.values import Value, known_type

__all__ = [
    "CLOCK_SLACK",
    "SNAPSHOTS",
    "begin",
    "forget",
    "snapshot",
    "snapshots",
    "state_at",
    "store",
    "watch_clock",
    "write_births",
]

SNAPSHOTS: Final = 50
"""Snapshots kept for each table, the newest ones: one is made before each file that is applied, so they are
weeks of work on one vehicle. One of a thousand parameters takes about 10 kB."""

CLOCK_SLACK: Final = 5.0
"""Seconds that a time may lie before the one written last without the clock having been set back: so long may
one process wait for another before it writes (`BUSY_TIMEOUT`)."""


def watch_clock(connection: sqlite3.Connection, key: str, component: int, at: float) -> None:
    """Note it where a table is written to at an earlier time than the last time."""
    connection.execute(
        "INSERT INTO setback (owner, since, until) SELECT id, ?1, updated_at FROM component"
        " WHERE vehicle = ?2 AND component = ?3 AND updated_at > ?1 + ?4",
        (at, key, component, CLOCK_SLACK),
    )


def write_births(connection: sqlite3.Connection, owner: int, births: Iterable[tuple[str, float]]) -> None:
    """Note names that a table did not have, ahead of the lines of the same update.

    Before the table was first complete this is not needed, and not done.
    """
    [(is_needed,)] = connection.execute(
        "SELECT known_since IS NOT NULL FROM component WHERE id = ?", (owner,)
    )
    if not is_needed:
        return
    connection.executemany(
        "INSERT INTO birth (owner, name, line, at)"
        " VALUES (?1, ?2, ifnull((SELECT max(id) FROM history WHERE owner = ?1), 0), ?3)",
        [(owner, name, at) for name, at in births],
    )


def begin(connection: sqlite3.Connection, owner: int, at: float) -> None:
    """A table is complete: if it is for the first time, its states are known from now on."""
    connection.execute(
        "UPDATE component SET known_since = ? WHERE id = ? AND known_since IS NULL", (at, owner)
    )


def forget(connection: sqlite3.Connection, owner: int, at: float) -> None:
    """Lines of history up to this time have gone: what happened before can be told no more."""
    connection.execute("UPDATE component SET known_since = max(known_since, ?) WHERE id = ?", (at, owner))
    for table, column in (("birth", "at"), ("setback", "until")):
        connection.execute(
            f"DELETE FROM {table} WHERE owner = ?1"
            f" AND {column} <= (SELECT known_since FROM component WHERE id = ?1)",
            (owner,),
        )


def store(
    connection: sqlite3.Connection,
    owner: int,
    params: ParamSet,
    *,
    at: float,
    reason: str,
    hash: int | None,  # noqa: A002  # the word of the record
    complete: bool,
) -> Snapshot:
    """Set a table down, and drop the oldest snapshots of it beyond `SNAPSHOTS`.

    Args:
        params: with the identity of the vehicle.
    """
    assert params.identity is not None
    blob = _packed(params.identity, params)
    text = reason.encode("utf-8", "backslashreplace").decode()  # a file's name need not be UTF-8
    row = (round(time_cell(at), 3), text, len(params), hash, int(complete))
    connection.execute(
        "INSERT INTO snapshot (owner, at, reason, size, hash, complete, params, checksum)"
        " VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
        (owner, *row, blob, _checksum(row, blob)),
    )
    [(number,)] = connection.execute("SELECT last_insert_rowid()")
    connection.execute(
        "DELETE FROM snapshot WHERE owner = ?1 AND id <="
        " (SELECT id FROM snapshot WHERE owner = ?1 ORDER BY id DESC LIMIT 1 OFFSET ?2)",
        (owner, SNAPSHOTS),
    )
    return snapshot(connection, owner, number)


def snapshots(connection: sqlite3.Connection, key: str, component: int | None) -> list[SnapshotSummary]:
    """The snapshots of a vehicle's tables, newest last."""
    rows = connection.execute(
        f"SELECT {_SUMMARY} FROM snapshot s JOIN component c ON c.id = owner"
        " WHERE vehicle = ? AND component = ifnull(?, component) ORDER BY s.id",
        (key, component),
    )
    return [_summary(row) for row in rows]


def snapshot(connection: sqlite3.Connection, owner: int, number: int) -> Snapshot:
    """One snapshot of a table.

    Raises:
        CacheError: there is none of this number, or it is damaged.
    """
    row = connection.execute(
        f"SELECT {_SUMMARY}, params, s.checksum FROM snapshot s JOIN component c ON c.id = owner"
        " WHERE s.id = ? AND owner = ?",
        (number, owner),
    ).fetchone()
    if row is None:
        raise CacheError(_no_such(connection, owner, number))
    *described, blob, expected = row
    summary = _summary(described)
    try:
        if not isinstance(blob, bytes) or _checksum(described[3:], blob) != expected:
            raise ValueError("it is not what was written")
        identity, params = _unpacked(blob)
    except (ArithmeticError, LookupError, TypeError, ValueError, Damaged, struct.error, zlib.error) as error:
        raise CacheError(
            f"snapshot {number} of {summary.key}, component {summary.component}, is damaged: {error}"
        ) from error
    return Snapshot(
        **{field.name: getattr(summary, field.name) for field in fields(summary)},
        params=ParamSet(
            params,
            summary.component,
            identity.system,
            identity,
            summary.at,
            f"snapshot {number} of {summary.key}",
        ),
    )


def state_at(
    connection: sqlite3.Connection, owner: int, identity: Identity, rows: Mapping[str, Row], when: float
) -> ParamSet:
    """A table as it was last known at a moment.

    Args:
        identity: the vehicle, as it was last seen.
        rows: the present table.
        when: unix seconds.

    Raises:
        CacheError: that cannot be told.
    """
    when = time_cell(when)
    number, since = _described(connection, owner)
    for (exact,) in connection.execute(
        "SELECT max(id) FROM snapshot WHERE owner = ? AND at = ? HAVING max(id) NOTNULL", (owner, when)
    ).fetchall():
        return snapshot(connection, owner, exact).params
    who = f"{identity.key}, component {number}"
    if since is None or when < since:
        reach = (
            "is not known: its table was never complete"
            if since is None
            else f"at {_text(when)} is not known: what is kept of its history begins at {_text(since)}"
        )
        raise CacheError(f"the state of {who} {reach}{_older(connection, owner, when)}")
    for until, back in connection.execute(
        "SELECT until, since FROM setback WHERE owner = ? AND since <= ? AND until > ?", (owner, when, when)
    ):
        raise CacheError(
            f"the state of {who} at {_text(when)} cannot be told: the clock of this computer was set back"
            f" from {_text(until)} to {_text(back)}{_older(connection, owner, when)}"
        )
    first = _first_events_after(connection, owner, when)
    state = {name: first.get(name, row.value) for name, row in rows.items()} | first
    params = {}
    for name, value in state.items():
        if value is not None:
            params[name] = WrittenParam.of(read_param(name, *value))
    then = replace(identity, firmware=0, git_hash="", capabilities=0)
    return ParamSet(params, number, identity.system, then, when, f"history of {identity.key}")


# The value that the first event after a moment took away: None where there was no such name.
_Taken = tuple[int, int, int] | None


def _first_events_after(connection: sqlite3.Connection, owner: int, when: float) -> dict[str, _Taken]:
    """By name, what was there before the first thing that happened after a moment."""
    events: list[tuple[int, int, str, _Taken]] = []
    for row in connection.execute(
        "SELECT id, name, old_type, old_bits, old_is_raw FROM history WHERE owner = ? AND at > ?",
        (owner, when),
    ):
        line, name, *value = cells(row, "isiii")
        events.append((line, 0, name, tuple(value)))
    for row in connection.execute("SELECT line, name FROM birth WHERE owner = ? AND at > ?", (owner, when)):
        line, name = cells(row, "is")
        events.append((line, 1, name, None))  # after the line that was the last one then
    first: dict[str, _Taken] = {}
    for _, _, name, value in sorted(events, key=lambda event: event[:2]):
        first.setdefault(name, value)
    return first


def _described(connection: sqlite3.Connection, owner: int) -> tuple[int, float | None]:
    """A table's component id, and since when its states are known."""
    [row] = connection.execute("SELECT component, known_since FROM component WHERE id = ?", (owner,))
    number, since = cells(row, "iF")
    return number, since


def _older(connection: sqlite3.Connection, owner: int, when: float) -> str:
    """What snapshots there are where history does not help: those next to the moment."""
    found = [
        cells(row, "if")
        for order in ("at <= ? ORDER BY at DESC, id DESC", "at > ? ORDER BY at, id")
        for row in connection.execute(
            f"SELECT id, at FROM snapshot WHERE owner = ? AND {order} LIMIT 1", (owner, when)
        )
    ]
    listed = " and ".join(f"snapshot {number} of {_text(at)}" for number, at in found)
    return f"; there is {listed}" if listed else "; there is no snapshot"


def _no_such(connection: sqlite3.Connection, owner: int, number: int) -> str:
    [row] = connection.execute("SELECT vehicle, component FROM component WHERE id = ?", (owner,))
    key, component = cells(row, "si")
    kept = [str(each.id) for each in snapshots(connection, key, component)]
    listed = f"those kept are {', '.join(kept)}" if kept else "none is kept"
    return f"there is no snapshot {number} of {key}, component {component}: {listed}"


def _text(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%dT%H:%M:%SZ}"


_SUMMARY: Final = "s.id, vehicle, component, at, reason, size, s.hash, s.complete"


def _summary(row: Sequence[object]) -> SnapshotSummary:
    number, key, component, at, reason, size, crc, complete = cells(row, "isifsiIi")
    return SnapshotSummary(number, key, component, at, reason, size, crc, bool(complete))


def _checksum(described: Sequence[object], blob: bytes) -> int:
    return zlib.crc32(blob, zlib.crc32(repr(tuple(described)).encode()))


def _packed(identity: Identity, params: Mapping[str, WrittenParam]) -> bytes:
    """Strict JSON, compressed: who the vehicle is, and name, type, value, default of each parameter."""
    rows = [
        (each.name, None if each.type is None else int(each.type), _cell(each.value), _cell(each.default))
        for each in params.values()
    ]
    text = json.dumps([identity_cells(identity), rows], separators=(",", ":"), allow_nan=False)
    return zlib.compress(text.encode("ascii"))


def _unpacked(blob: bytes) -> tuple[Identity, dict[str, WrittenParam]]:
    identity, rows = json.loads(zlib.decompress(blob))
    params = {}
    for name, number, value, default in rows:
        kind = None if number is None else known_type(number)
        written = _written(value)
        assert written is not None
        params[str(name)] = WrittenParam(str(name), written, kind, _written(default))
    return read_identity(identity), params


def _cell(value: Value | None) -> int | str | None:
    """A value so that it comes back to the last bit: a float by its bytes, four where a float32 holds it."""
    if value is None or isinstance(value, int):
        return value
    if isinstance(value, bytes):
        return f"x{value.hex()}"
    wide = struct.pack("<d", value)
    try:
        narrow = struct.pack("<f", value)
    except OverflowError:
        return f"d{wide.hex()}"
    is_whole = struct.pack("<d", *struct.unpack("<f", narrow)) == wide
    return f"f{narrow.hex()}" if is_whole else f"d{wide.hex()}"


def _written(cell: Any) -> Value | None:
    if cell is None or isinstance(cell, int):
        return cell
    kind, data = cell[0], bytes.fromhex(cell[1:])
    if kind == "x":
        return data
    value: float = struct.unpack({"f": "<f", "d": "<d"}[kind], data)[0]
    return value
