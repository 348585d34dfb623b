"""Tables of parameters as they are stored: loading, updates by observations, import by time.

An observation is written by an upsert whose WHERE lets no older one win, whatever the order of the writes. A
removal is an observation without a value. A stored time in the future is from before the computer's clock was
set back, and is older than every observation. A hash stays with a table only while the stored values are
those for which it was stated. Each function runs in a transaction, which excludes other writers.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import astuple, fields, replace
from itertools import zip_longest
from operator import attrgetter
from typing import Any, Final

from paramclient.cache.database import IDENTITY, Transaction
from paramclient.cache.history import SAME_CHANGE_MAX, Line, add_lines, lines_since, load_lines, merged_lines
from paramclient.cache.records import (
    BY_VEHICLE,
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    StoredParam,
    StoredTable,
    TableState,
    TableUpdate,
    is_same_value,
    stored_params,
    stored_value,
)
from paramclient.errors import UsageError
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamMap
from paramclient.model.px4_hash import hash_bits

YEAR_10000: Final = 253402300800.0
"""Unix seconds at the start of the year 10000, above every stored time."""


_IDENTITY_OF_VEHICLE: Final = ", ".join(f"vehicle.{column}" for column in IDENTITY.split(", "))


def time_cell(at: float) -> float:
    """Check and return a time to store.

    Raises:
        UsageError: the time is not in unix seconds, from 0 to before the year 10000.
    """
    if not 0 <= at < YEAR_10000:
        raise UsageError(f"{at!r} is not a time in unix seconds")
    return float(at)


def identity_cells(identity: Identity) -> tuple[Any, ...]:
    """Return the cells of an identity, in the order of the columns `IDENTITY`."""
    *described, capabilities = astuple(identity)
    return (*described, str(capabilities))  # 64 bits without a sign


def read_identity(cells: Iterable[Any]) -> Identity:
    """Return the identity of cells from `identity_cells`."""
    identity = Identity(*cells)
    return replace(identity, capabilities=int(identity.capabilities))


def load_tables(
    tx: Transaction, key: str | None = None, component: int | None = None, *, extended: bool = False
) -> list[StoredTable]:
    """Return tables, those of the last seen vehicle first, then by component id; optionally of one vehicle or
    component."""
    given = {"vehicle": key, "component": component, "extended": int(extended)}
    known = {column: value for column, value in given.items() if value is not None}
    found = tx.all(
        "SELECT id, known_since, vehicle, component, component.autopilot,"
        " (SELECT count(*) FROM parameter WHERE owner = component.id AND type IS NOT NULL), updated_at,"
        f" hash, param_count, complete, volatile_known, synced_at, file_works, {_IDENTITY_OF_VEHICLE}"
        " FROM component JOIN vehicle ON vehicle.key = component.vehicle"
        f" WHERE {' AND '.join(f'{column} = ?' for column in known)}"
        " ORDER BY last_seen DESC, vehicle, component",
        tuple(known.values()),
    )
    return [
        StoredTable(
            owner,
            known_since,
            CachedSummary(
                hash=hash_,
                count=count,
                complete=bool(complete),
                volatile_known=bool(volatile_known),
                synced_at=synced_at,
                file_works=None if file_works is None else bool(file_works),
                key=vehicle,
                identity=read_identity(identity),
                component=number,
                autopilot=autopilot,
                size=size,
                updated_at=updated_at,
            ),
        )
        for owner, known_since, vehicle, number, autopilot, size, updated_at, *state_and_identity in found
        for hash_, count, complete, volatile_known, synced_at, file_works, *identity in [state_and_identity]
    ]


def find_table(tx: Transaction, key: str, component: int, *, extended: bool = False) -> StoredTable | None:
    """Return a table; None if there is none."""
    return next(iter(load_tables(tx, key, component, extended=extended)), None)


def load_vehicles(tx: Transaction) -> list[CachedVehicle]:
    """Return all vehicles, the last seen first."""
    components: dict[str, list[int]] = defaultdict(list)
    for vehicle, component in tx.all(
        "SELECT vehicle, component FROM component WHERE extended = 0 ORDER BY component"
    ):
        components[vehicle].append(component)
    rows = tx.all(f"SELECT key, first_seen, last_seen, {IDENTITY} FROM vehicle ORDER BY last_seen DESC, key")
    return [
        CachedVehicle(vehicle, read_identity(cells), first, last, tuple(components[vehicle]))
        for vehicle, first, last, *cells in rows
    ]


def load_rows(tx: Transaction, owner: int, names: Collection[str] | None = None) -> dict[str, StoredParam]:
    """Return the rows of a table by name, ordered by index, then name; those without an index last.

    A row without a value is of a parameter that the vehicle no longer has.

    Args:
        tx: the transaction.
        owner: id of the table.
        names: only these, in any order; None for all.
    """
    if names is not None and not names:
        return {}
    where = "" if names is None else f" AND name IN ({', '.join('?' * len(names))})"
    rows = tx.all(
        "SELECT name, param_index, volatile, heard_at, default_value, type, value FROM parameter"
        f" WHERE owner = ?{where}",
        (owner, *(names or ())),
    )
    if names is None:
        rows.sort(key=lambda row: (row[1] is None, row[1], row[0]))
    return {
        name: StoredParam(name, stored_value(value), index, volatile, at, default, "")
        for name, index, volatile, at, default, *value in rows
    }


def load_component(tx: Transaction, table: StoredTable) -> CachedComponent:
    """Return a table with its parameters.

    A hash that the stored values do not have is left out: it cannot confirm them.
    """
    rows = load_rows(tx, table.owner)
    params = stored_params(rows)
    volatile = frozenset(name for name, row in rows.items() if row.volatile)
    described = {each.name: getattr(table.summary, each.name) for each in fields(table.summary)}
    if table.summary.volatile_known:
        bits = {name: param.bits for name, param in params.items() if param.index is not None}
        if hash_bits(bits, leave_out=volatile) != table.summary.hash:
            described["hash"] = None
    return CachedComponent(
        **described,
        params=ParamMap(params),
        volatile=volatile,
        heard_at={name: rows[name].heard_at for name in params},
    )


def remove_tables(tx: Transaction, key: str, component: int | None) -> int:
    """Delete a vehicle's tables with history and snapshots. Return the number of plain tables."""
    removed = load_tables(tx, key, component)
    for table in removed:
        tx.do("DELETE FROM component WHERE vehicle = ? AND component = ?", (key, table.summary.component))
    tx.do("DELETE FROM vehicle WHERE key NOT IN (SELECT vehicle FROM component)")
    return len(removed)


CLOCK_SLACK: Final = 5.0
"""Seconds by which a stored time may be ahead of the clock although the clock was not set back: a call may
wait this long for its transaction."""
NAMES_SELECTED_MAX: Final = 200
"""Names above which an update reads the whole table: SQLite allows at least 999 values in a statement."""

_UPSERT: Final = """
    INSERT INTO parameter (owner, name, type, value, param_index, volatile, heard_at, default_value)
    VALUES (?, ?, ?, ?, ?, ?, ?, ?)
    ON CONFLICT (owner, name) DO UPDATE SET
        (type, value, param_index, volatile, heard_at, default_value) =
        (excluded.type, excluded.value, excluded.param_index, excluded.volatile, excluded.heard_at,
         coalesce(excluded.default_value,
                  CASE WHEN parameter.type = excluded.type THEN parameter.default_value END))
    WHERE parameter.heard_at <= excluded.heard_at OR parameter.heard_at > ?"""
"""The last value is the time after which stored times are from before the clock was set back. A default stays
where the observer does not know it."""


KnownLines = dict[tuple[int, str], tuple[int, float]]
"""The last line that a program has written, or has received too, by table and name; with no name, the last
when it loaded the table, and when that was: what it had heard before may be in such a line. Another program
may have written later ones of changes that this one, on a busy computer, receives late."""


def ensure_table(
    tx: Transaction, identity: Identity, component: int, at: float, *, extended: bool
) -> StoredTable:
    """Return the table of a vehicle's component, which is created if there is none."""
    autopilot = identity.autopilot if component == 1 else 0
    new = TableUpdate(identity=identity, component=component, autopilot=autopilot, at=at, extended=extended)
    found = find_table(tx, identity.key, component, extended=extended)
    return _upsert_table(tx, new, math.inf) if found is None else found


def save_table(tx: Transaction, update: TableUpdate, now: float, known: KnownLines) -> None:
    """Write an update with its history lines.

    Args:
        tx: the transaction.
        update: the update.
        now: the current time in unix seconds.
        known: the lines that the program knows; updated.
    """
    horizon = max(now, update.at) + CLOCK_SLACK
    before = find_table(tx, update.identity.key, update.component, extended=update.extended)
    owner = _upsert_table(tx, update, horizon).owner
    names = {item.name for item in update.params}
    if update.table and not update.table.volatile_known and any(item.volatile for item in update.params):
        tx.do("UPDATE parameter SET volatile = 0 WHERE owner = ?", (owner,))  # it was learnt anew which are
    rows = load_rows(tx, owner, None if update.replace or len(names) > NAMES_SELECTED_MAX else names)
    gone = [name for name, row in rows.items() if row.stored and name not in names] if update.replace else []
    observed = [*update.params, *(StoredParam.gone(name, update.at) for name in gone)]
    is_known = before is not None and before.known_since is not None
    is_whole, is_rehashed = True, False
    lines: list[Line] = []
    unrecorded = _unrecorded(tx, owner, observed, rows, known)
    agrees = sum(map(len, unrecorded)) == len(observed)
    for new in zip_longest(*unrecorded):
        items = [_completed(item, rows.get(item.name), is_whole=update.replace) for item in new if item]
        for item, has_won in zip(items, _write_rows(tx, owner, items, horizon), strict=True):
            old = rows.get(item.name)
            is_same = is_same_value(old and old.stored, item.stored)
            if not has_won:
                agrees = agrees and is_same
                is_whole = is_whole and (is_same or item.stored is not None)
                continue
            if not is_same and (old is not None or is_known):
                old_value, old_at = (old and old.stored), (old and old.stored and old.heard_at)
                lines.append(Line(item.heard_at, item.name, item.by, old_at, old_value, item.stored))
            rows[item.name] = item
            is_rehashed = is_rehashed or item.hashed != (old and old.hashed)
    known |= dict.fromkeys(((owner, line.name) for line in lines), (add_lines(tx, owner, lines), 0.0))
    kept = TableState() if before is None else before.summary
    is_late = before is not None and update.at < before.summary.updated_at <= horizon
    state = _state_to_write(update, kept, agrees=agrees, is_late=is_late) if is_whole else None
    if state is not None:
        _write_state(tx, owner, state, update, kept)
    elif is_rehashed:
        tx.do("UPDATE component SET hash = NULL WHERE id = ?", (owner,))


def import_tables(tx: Transaction, updates: Iterable[TableUpdate]) -> None:
    """Insert earlier observations by their times, with those that are later than the stored ones.

    Repeating an import changes nothing. The state of an update is stored only with a new table.
    """
    observed: dict[int, list[StoredParam]] = {}
    of_new_tables: dict[int, TableUpdate] = {}
    for each in updates:
        is_new = find_table(tx, each.identity.key, each.component, extended=each.extended) is None
        owner = _upsert_table(tx, each, math.inf).owner
        if is_new or owner in of_new_tables:
            of_new_tables[owner] = each
        observed.setdefault(owner, []).extend(each.params)
    for owner, items in observed.items():
        is_rehashed = _insert_by_time(tx, owner, items)
        update = of_new_tables.get(owner)
        if update is not None and update.table is not None:
            _write_state(tx, owner, update.table, update, TableState())
        elif is_rehashed:
            tx.do("UPDATE component SET hash = NULL WHERE id = ?", (owner,))


def _insert_by_time(tx: Transaction, owner: int, items: Iterable[StoredParam]) -> bool:
    """Insert observations into a table and its history, and return whether hashed values have changed.

    A name that a later complete table did not have is left out.
    """
    [(known_since, complete, synced_at)] = tx.all(
        "SELECT known_since, complete, synced_at FROM component WHERE id = ?", (owner,)
    )
    verified_at = synced_at if complete and synced_at is not None else -math.inf
    rows, lines = load_rows(tx, owner), load_lines(tx, owner)
    by_name: dict[str, list[StoredParam]] = {}
    for item in items:
        time_cell(item.heard_at)
        by_name.setdefault(item.name, []).append(item)
    new_lines: list[Line] = []
    new_rows: list[StoredParam] = []
    for name, found in by_name.items():
        row, kept = rows.get(name), lines.get(name, [])
        if row is None:
            found = [item for item in found if item.heard_at >= verified_at]
        if not found:
            continue
        confirmed_at = -math.inf if row is None or row.hashed is None else verified_at
        merged = merged_lines(name, kept, row, found, known_since, confirmed_at)
        if merged != kept:
            tx.do("DELETE FROM history WHERE owner = ? AND name = ?", (owner, name))
            new_lines += merged
        last = max(reversed(found), key=attrgetter("heard_at"))
        if row is None or last.heard_at > max(row.heard_at, confirmed_at):
            new_rows.append(_completed(last, row, is_whole=False))
    _write_rows(tx, owner, new_rows, math.inf)
    add_lines(tx, owner, new_lines)
    return any(row.hashed != (old and old.hashed) for row in new_rows for old in [rows.get(row.name)])


def _unrecorded(
    tx: Transaction, owner: int, items: Sequence[StoredParam], rows: dict[str, StoredParam], known: KnownLines
) -> list[list[StoredParam]]:
    """Return observations by parameter, in their order, without those that another program has stored with a
    later change, or that were received before a change that it has stored."""
    first = min((item.heard_at for item in items), default=math.inf)
    recent, loaded = lines_since(tx, owner, first - SAME_CHANGE_MAX), known.get((owner, ""), (0, 0.0))
    kept: dict[str, list[StoredParam]] = {}
    for item in items:
        row, (newest, since) = rows.get(item.name), known.get((owner, item.name), loaded)
        last = newest if item.heard_at > since else 0
        is_kept = True
        for number, line in recent.get(item.name, ()):
            is_near = number > last and line.at > item.heard_at - SAME_CHANGE_MAX
            if is_near and is_same_value(line.new, item.stored):
                if line.by == BY_VEHICLE != item.by:  # the other program does not know who has set it
                    tx.do("UPDATE history SET author = ? WHERE id = ?", (item.by, number))
                known[owner, item.name] = (number, 0.0)
                kept[item.name] = []
                is_kept = is_same_value(row and row.stored, item.stored)
                break
        kept.setdefault(item.name, []).extend([item] * is_kept)
    return list(kept.values())


def _completed(item: StoredParam, old: StoredParam | None, *, is_whole: bool) -> StoredParam:
    """Return an observation with the stored index and flag where it has none."""
    time_cell(item.heard_at)
    if old is None or item.stored is None:
        return item
    index = old.param_index if item.param_index is None and not is_whole else item.param_index
    return item._replace(param_index=index, volatile=old.volatile if item.volatile is None else item.volatile)


def _write_rows(tx: Transaction, owner: int, items: Sequence[StoredParam], horizon: float) -> list[bool]:
    """Write observations of different names; return of each whether no newer one is stored."""
    rows = [
        (
            *(owner, item.name, *(item.stored or (None, None))),
            *(item.param_index, item.volatile or 0, item.heard_at, item.default, horizon),
        )
        for item in items
    ]
    return [count > 0 for count in tx.many(_UPSERT, rows)]


def _state_to_write(
    update: TableUpdate, kept: TableState, *, agrees: bool, is_late: bool
) -> TableState | None:
    """Return the state of a table after an update; None if the stored state stays.

    `agrees`: no value of the update differs from a newer stored one; otherwise its hash is of other values.
    `is_late`: a later update of the table is stored.
    """
    state = update.table
    if state is None or (is_late and not state.complete):
        return None
    if not agrees:
        return replace(state, hash=None) if state.complete and not kept.complete else None
    if state.complete or update.replace or not kept.complete:
        return state
    # one that has received less stays behind
    return None if state.count == kept.count or (state.count is None and not update.params) else state


def _write_state(
    tx: Transaction, owner: int, state: TableState, update: TableUpdate, kept: TableState
) -> None:
    if state.complete and not update.replace and not kept.complete:
        [(listed,)] = tx.all(
            "SELECT count(*) FROM parameter WHERE owner = ? AND param_index IS NOT NULL", (owner,)
        )
        if listed < (state.count or 0):  # the other parameters were written to another file
            state = replace(state, hash=None, complete=False)
    synced_at = max(state.synced_at or 0.0, min(kept.synced_at or 0.0, update.at + CLOCK_SLACK))
    tx.do(
        "UPDATE component SET (hash, param_count, complete, volatile_known, synced_at, file_works) ="
        " (?, ?, ?, ?, ?, ?) WHERE id = ?",
        (
            state.hash,
            state.count,
            int(state.complete),
            int(state.volatile_known),
            None if state.synced_at is None else time_cell(synced_at),
            None if state.file_works is None else int(state.file_works),
            owner,
        ),
    )
    if state.complete:
        tx.do("UPDATE component SET known_since = ? WHERE id = ? AND known_since IS NULL", (update.at, owner))


def _upsert_table(tx: Transaction, update: TableUpdate, horizon: float) -> StoredTable:
    """Write the vehicle and component of an update, and return the table, which may be new.

    Later information about the vehicle stays. A firmware other than the stored one removes what belongs to
    the previous one: defaults, and whether the vehicle serves its parameters as a file.
    """
    key, identity, at = update.identity.key, update.identity, time_cell(update.at)
    before = tx.all("SELECT firmware, git_hash FROM vehicle WHERE key = ?", (key,))
    columns = f"{IDENTITY}, last_seen"
    written = tx.do(
        f"INSERT INTO vehicle (key, first_seen, {columns}) VALUES (?{', ?' * 13})"
        f" ON CONFLICT (key) DO UPDATE SET ({columns}) ="
        f" ({', '.join('excluded.' + column for column in columns.split(', '))})"
        " WHERE vehicle.last_seen <= excluded.last_seen OR vehicle.last_seen > ?",
        (key, at, *identity_cells(identity), at, horizon),
    )
    tx.do("UPDATE vehicle SET first_seen = ? WHERE key = ? AND first_seen > ?", (at, key, at))
    if written and before and before[0] != (identity.firmware, identity.git_hash):
        owners = "SELECT id FROM component WHERE vehicle = ?"
        tx.do(f"UPDATE parameter SET default_value = NULL WHERE owner IN ({owners})", (key,))
        tx.do("UPDATE component SET file_works = NULL WHERE vehicle = ?", (key,))
    insert = (
        "INSERT INTO component (vehicle, component, extended, autopilot, updated_at) VALUES (?, ?, ?, ?, ?)"
        " ON CONFLICT (vehicle, component, extended) DO "
    )
    if update.extended:  # the components of a vehicle are those with a plain table, which may be empty
        tx.do(f"{insert} NOTHING", (key, update.component, 0, update.autopilot, at))
    tx.do(
        f"{insert} UPDATE SET (autopilot, updated_at) = (excluded.autopilot, excluded.updated_at)"
        " WHERE component.updated_at <= excluded.updated_at OR component.updated_at > ?",
        (key, update.component, int(update.extended), update.autopilot, at, horizon),
    )
    table = find_table(tx, key, update.component, extended=update.extended)
    assert table is not None
    return table
