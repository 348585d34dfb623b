"""Tables in the database: written, compared, read. Each function works inside its caller's transaction.

One mechanism writes history: `save` compares every value that it is given with the one that is stored, and
where they differ it writes a line in the same transaction. So no change of a stored value can miss its line,
and when two processes hear the same change, the second finds nothing to write.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from itertools import chain
from types import MappingProxyType
from typing import Final

from paramclient.cache import earlier
from paramclient.cache.database import Damaged
from paramclient.cache.records import (
    BY_VEHICLE,
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    HistoryEntry,
    StoredParam,
    TableState,
    TableUpdate,
)
from paramclient.cache.rows import (
    Row,
    cells,
    checksum,
    identity_cells,
    read_identity,
    read_param,
    read_rows,
    time_cell,
)
from paramclient.identity import Identity
from paramclient.params import ParamMap

__all__ = [
    "HISTORY_LINES",
    "applied",
    "component",
    "hashed",
    "history",
    "make",
    "owner_of",
    "remove",
    "save",
    "stored_rows",
    "summaries",
    "vehicles",
    "write_rows",
]

HISTORY_LINES: Final = 10_000
"""Lines of history kept for each table, the newest ones: about a megabyte, and years of tuning by hand. Each
`save` writes a line for each value that changed, so what a vehicle changes many times a second should be
gathered before it is saved."""

# In the order of `identity_cells`.
_IDENTITY: Final = (
    "system, link, uid, autopilot, vehicle_type, firmware, git_hash,"
    " board, vendor_id, product_id, capabilities"
)

_PARAM: Final = "(?, ?, ?, ?, ?, ?, ?, ?, ?)"
_ROWS_AT_ONCE: Final = 100
"""Parameters that one statement writes: that takes half as long as one by one, and the interpreter's lock is
passed on a hundredth as often. Some builds of SQLite allow 999 variables in one, which these fill."""


def save(connection: sqlite3.Connection, updates: Iterable[TableUpdate]) -> None:
    """Write what was learnt, in the order given."""
    for update in updates:
        _forget_other_firmware(connection, update.identity)
        earlier.watch_clock(connection, update.identity.key, update.component, time_cell(update.at))
        owner = make(connection, update)
        before: Mapping[str, Row] = {}
        after = before
        if update.params or update.removed or update.replace:  # else it is about the table as a whole only
            before = stored_rows(connection, owner)
            after, lines, births = applied(update, before)
            if after != before:
                write_rows(connection, owner, before, after)
            earlier.write_births(connection, owner, births)
            _write_history(connection, owner, lines)
        if update.table is not None:
            _write_state(connection, owner, update.table)
            if update.table.complete:
                earlier.begin(connection, owner, update.at)
        elif hashed(before) != hashed(after):
            connection.execute("UPDATE component SET hash = NULL WHERE id = ?", (owner,))


def remove(connection: sqlite3.Connection, key: str, component: int | None) -> int:
    """Delete tables with all that belongs to them; give their number."""
    removed = connection.execute(
        "DELETE FROM component WHERE vehicle = ? AND component = ifnull(?, component)", (key, component)
    ).rowcount
    connection.execute("DELETE FROM vehicle WHERE key NOT IN (SELECT vehicle FROM component)")
    return removed


def vehicles(connection: sqlite3.Connection) -> list[CachedVehicle]:
    """Every vehicle, the one seen last first."""
    components: dict[str, list[int]] = {}
    for row in connection.execute("SELECT vehicle, component FROM component ORDER BY component"):
        key, component = cells(row, "si")
        components.setdefault(key, []).append(component)
    found = []
    for row in connection.execute(
        f"SELECT key, first_seen, last_seen, {_IDENTITY} FROM vehicle ORDER BY last_seen DESC, key"
    ):
        key, first, last = cells(row[:3], "sff")
        known = tuple(components.get(key, ()))
        found.append(CachedVehicle(key, read_identity(row[3:]), first, last, known))
    return found


def summaries(
    connection: sqlite3.Connection, key: str | None = None, component: int | None = None
) -> list[tuple[int, CachedSummary]]:
    """Tables with their ids in the database, without parameters; of one vehicle or component where given."""
    rows = connection.execute(
        "SELECT id, component, own_autopilot, (SELECT count(*) FROM param WHERE owner = c.id), hash, count,"
        f" complete, volatile_known, synced_at, updated_at, file_works, key, {_IDENTITY}"
        " FROM component c JOIN vehicle ON key = vehicle"
        " WHERE key = ifnull(?, key) AND component = ifnull(?, component)"
        " ORDER BY last_seen DESC, key, component",
        (key, component),
    )
    return [_summary(row) for row in rows]


def component(
    connection: sqlite3.Connection,
    key: str,
    number: int,
    *,
    history: Callable[[str | None, int | None], list[HistoryEntry]],
) -> CachedComponent | None:
    """One table with its parameters, or None."""
    for owner, summary in summaries(connection, key, number):
        rows = stored_rows(connection, owner)
        return CachedComponent(
            **{field.name: getattr(summary, field.name) for field in fields(summary)},
            params=ParamMap(
                {
                    name: read_param(name, *row.value, row.param_index, row.default_bits)
                    for name, row in rows.items()
                }
            ),
            volatile=frozenset(name for name, row in rows.items() if row.volatile),
            heard_at=MappingProxyType({name: row.heard_at for name, row in rows.items()}),
            _history=history,
        )
    return None


def history(
    connection: sqlite3.Connection,
    key: str,
    component: int | None,
    name: str | None,
    limit: int | None,
    since: float | None = None,
) -> list[HistoryEntry]:
    """The changes of a vehicle's values, newest last."""
    rows = connection.execute(
        "SELECT at, component, name, by, old_type, old_bits, old_is_raw, new_type, new_bits, new_is_raw"
        " FROM history h JOIN component c ON c.id = owner"
        " WHERE vehicle = ? AND component = ifnull(?, component) AND name = ifnull(?, name)"
        " AND at >= ifnull(?, at) ORDER BY h.id DESC LIMIT ?",
        (key, component, name, since, -1 if limit is None else limit),
    ).fetchall()
    return [_entry(row) for row in reversed(rows)]


def owner_of(connection: sqlite3.Connection, key: str, component: int) -> int | None:
    """The id of a table in the database, or None where there is none."""
    found = connection.execute(
        "SELECT id FROM component WHERE vehicle = ? AND component = ?", (key, component)
    ).fetchone()
    return None if found is None else int(found[0])


def make(connection: sqlite3.Connection, update: TableUpdate) -> int:
    """Write whose table it is; give the id of the table, which is made where there is none."""
    at = time_cell(update.at)
    key = update.identity.key
    columns = f"{_IDENTITY}, last_seen"
    values = ", ".join(f"excluded.{column}" for column in columns.split(", "))
    connection.execute(
        f"INSERT INTO vehicle (key, first_seen, {columns}) VALUES (?{', ?' * 13})"
        f" ON CONFLICT (key) DO UPDATE SET ({columns}) = ({values})",
        (key, at, *identity_cells(update.identity), at),
    )
    connection.execute(
        "INSERT INTO component (vehicle, component, own_autopilot, checksum, updated_at)"
        " VALUES (?, ?, ?, ?, ?)"
        " ON CONFLICT (vehicle, component) DO UPDATE"
        " SET own_autopilot = excluded.own_autopilot, updated_at = excluded.updated_at",
        (key, update.component, update.autopilot, checksum({}), at),
    )
    [(owner,)] = connection.execute(
        "SELECT id FROM component WHERE vehicle = ? AND component = ?", (key, update.component)
    )
    return int(owner)


def stored_rows(connection: sqlite3.Connection, owner: int) -> dict[str, Row]:
    """A table's parameters by index, then name, those without an index last; `Damaged` where one changed."""
    found = connection.execute(
        "SELECT name, type, bits, is_raw, param_index, volatile, heard_at, default_bits"
        " FROM param WHERE owner = ?"
        " ORDER BY param_index IS NULL, param_index, name",
        (owner,),
    )
    rows = read_rows(found)
    [(expected,)] = connection.execute("SELECT checksum FROM component WHERE id = ?", (owner,))
    if checksum(rows) != expected:
        raise Damaged("a table is not what was written")
    return rows


def _forget_other_firmware(connection: sqlite3.Connection, identity: Identity) -> None:
    """Where a vehicle has another firmware than before: drop what was true of that one only."""
    updated = connection.execute(
        "SELECT c.id FROM vehicle JOIN component c ON vehicle = key"
        " WHERE key = ? AND (firmware, git_hash) != (?, ?)",
        (identity.key, identity.firmware, identity.git_hash),
    ).fetchall()
    for (owner,) in updated:
        before = stored_rows(connection, owner)
        after = {name: row._replace(default_bits=None) for name, row in before.items()}
        write_rows(connection, owner, before, after)
        connection.execute("UPDATE component SET file_works = NULL WHERE id = ?", (owner,))


def applied(
    update: TableUpdate, before: Mapping[str, Row]
) -> tuple[dict[str, Row], list[tuple[object, ...]], list[tuple[str, float]]]:
    """The rows after an update, the lines of history that it causes, and the new names with their times."""
    after = dict(before)
    births: list[tuple[str, float]] = []
    heard = {item.param.name for item in update.params}
    lines: list[tuple[object, ...]] = [
        (update.at, name, BY_VEHICLE, *after.pop(name).value, None, None, None)
        for name in dict.fromkeys(before if update.replace else update.removed)
        if name in before and name not in heard
    ]
    for item in update.params:
        name = item.param.name
        old = after.get(name)
        new = after[name] = _merged(item, old, whole=update.replace)
        if not old:
            births.append((name, new.heard_at))
        elif not old.same_value(new):
            lines.append((new.heard_at, name, item.by, *old.value, *new.value))
    return after, lines, births


def _merged(item: StoredParam, old: Row | None, *, whole: bool) -> Row:
    index, volatile = item.param.index, item.volatile
    if index is None and old and not whole:
        index = old.param_index
    if volatile is None:
        volatile = bool(old and old.volatile)
    return Row.of(item.param, index, volatile, item.heard_at)


def hashed(rows: Mapping[str, Row]) -> dict[str, tuple[int, int, int]]:
    """What the vehicle's hash covers of a table."""
    return {name: row.hashed for name, row in rows.items() if row.hashed is not None}


def write_rows(
    connection: sqlite3.Connection, owner: int, before: Mapping[str, Row], after: Mapping[str, Row]
) -> None:
    """Make the stored rows of a table the ones after an update."""
    connection.executemany(
        "DELETE FROM param WHERE owner = ? AND name = ?",
        [(owner, name) for name in before.keys() - after.keys()],
    )
    changed = [(owner, name, *row) for name, row in sorted(after.items()) if before.get(name) != row]
    for first in range(0, len(changed), _ROWS_AT_ONCE):
        rows = changed[first : first + _ROWS_AT_ONCE]
        connection.execute(
            "REPLACE INTO param"
            " (owner, name, type, bits, is_raw, param_index, volatile, heard_at, default_bits)"
            f" VALUES {', '.join([_PARAM] * len(rows))}",
            [*chain.from_iterable(rows)],
        )
    connection.execute("UPDATE component SET checksum = ? WHERE id = ?", (checksum(after), owner))


def _write_history(connection: sqlite3.Connection, owner: int, lines: Sequence[tuple[object, ...]]) -> None:
    if not lines:
        return
    connection.executemany(
        "INSERT INTO history"
        " (owner, at, name, by, old_type, old_bits, old_is_raw, new_type, new_bits, new_is_raw)"
        " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        [(owner, *line) for line in lines],
    )
    for (last,) in connection.execute(
        "SELECT id FROM history WHERE owner = ? ORDER BY id DESC LIMIT 1 OFFSET ?", (owner, HISTORY_LINES)
    ).fetchall():
        [(at,)] = connection.execute("SELECT max(at) FROM history WHERE owner = ? AND id <= ?", (owner, last))
        connection.execute("DELETE FROM history WHERE owner = ? AND id <= ?", (owner, last))
        earlier.forget(connection, owner, at)


def _write_state(connection: sqlite3.Connection, owner: int, state: TableState) -> None:
    synced = None if state.synced_at is None else time_cell(state.synced_at)
    connection.execute(
        "UPDATE component"
        " SET hash = ?, count = ?, complete = ?, volatile_known = ?, synced_at = ?, file_works = ?"
        " WHERE id = ?",
        (state.hash, state.count, state.complete, state.volatile_known, synced, state.file_works, owner),
    )


def _summary(row: Sequence[object]) -> tuple[int, CachedSummary]:
    owner, component, autopilot, size, *state, key = cells(row[:12], "iiiiIIiiFfIs")
    crc, count, complete, volatile_known, synced_at, updated_at, file_works = state
    return owner, CachedSummary(
        key=key,
        identity=read_identity(row[12:]),
        component=component,
        autopilot=autopilot,
        size=size,
        hash=crc,
        count=count,
        complete=bool(complete),
        volatile_known=bool(volatile_known),
        synced_at=synced_at,
        updated_at=updated_at,
        file_works=None if file_works is None else bool(file_works),
    )


def _entry(row: Sequence[object]) -> HistoryEntry:
    at, component, name, by, *values = cells(row, "fissiiiIII")
    old, new = values[:3], values[3:]
    return HistoryEntry(
        at=at,
        component=component,
        name=name,
        old=read_param(name, *old),
        new=None if None in new else read_param(name, *new),
        by=by,
    )
