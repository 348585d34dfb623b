"""Tables of parameters: vehicles, summaries, rows, and their updates. Functions run in a transaction.

The later observation of a value counts, whatever the order of the writes. A stored time in the future is from
before the computer's clock was set back, and counts as older than every observation. A hash stays with a
table only while the stored values are exactly those for which it was stated.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, astuple, replace
from typing import Any, Final

from paramclient.cache.history import Line, add_lines, last_removal
from paramclient.cache.records import (
    BY_VEHICLE,
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    StoredParam,
    StoredTable,
    StoredValue,
    TableState,
    TableUpdate,
    stored_params,
)
from paramclient.cache.sqlite import IDENTITY, Transaction
from paramclient.errors import UsageError
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.px4_hash import hash_bits

__all__ = [
    "ensure_table",
    "find_table",
    "identity_cells",
    "load_component",
    "load_rows",
    "load_summaries",
    "load_tables",
    "load_vehicles",
    "read_identity",
    "remove_tables",
    "save_table",
    "time_cell",
]

YEAR_10000: Final = 253402300800.0
"""Unix seconds at the start of the year 10000, above every stored time."""
CLOCK_SLACK: Final = 5.0
"""Seconds by which a stored time may be ahead of the clock although the clock was not set back: a call may
wait this long for its transaction."""
NAMES_SELECTED_MAX: Final = 200
"""Names above which an update reads the whole table: SQLite allows at least 999 values in a statement."""

_CELLS_END: Final = StoredParam._fields.index("by")
_UPSERT: Final = """
    INSERT INTO parameter
        (owner, name, type, value, is_raw, param_index, volatile, heard_at, default_value)
    VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)
    ON CONFLICT (owner, name) DO UPDATE SET
        (type, value, is_raw, param_index, volatile, heard_at, default_value) =
        (excluded.type, excluded.value, excluded.is_raw, excluded.param_index, excluded.volatile,
         excluded.heard_at, excluded.default_value)
    WHERE parameter.heard_at <= excluded.heard_at OR parameter.heard_at > ?"""


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
    """Return tables, ordered by component id, optionally of one vehicle or component."""
    given = {"vehicle": key, "component": component, "extended": int(extended)}
    known = {column: value for column, value in given.items() if value is not None}
    found = tx.all(
        "SELECT id, vehicle, component, autopilot,"
        " (SELECT count(*) FROM parameter WHERE owner = component.id), updated_at, known_since,"
        " hash, param_count, complete, volatile_known, synced_at, file_works FROM component"
        f" WHERE {' AND '.join(f'{column} = ?' for column in known)} ORDER BY component",
        tuple(known.values()),
    )
    tables = []
    for *described, hash_, count, complete, volatile_known, synced_at, file_works in found:
        works = None if file_works is None else bool(file_works)
        state = TableState(hash_, count, bool(complete), bool(volatile_known), synced_at, works)
        owner, vehicle, number, autopilot, size, updated_at, known_since = described
        tables.append(StoredTable(owner, vehicle, number, autopilot, size, updated_at, known_since, state))
    return tables


def find_table(tx: Transaction, key: str, component: int, *, extended: bool = False) -> StoredTable | None:
    """Return a table; None if there is none."""
    return next(iter(load_tables(tx, key, component, extended=extended)), None)


def load_vehicles(tx: Transaction, key: str | None = None) -> list[CachedVehicle]:
    """Return all vehicles, the last seen first; or the one with this key."""
    of_key, where, values = ("", "", ()) if key is None else (" AND vehicle = ?", " WHERE key = ?", (key,))
    components: dict[str, list[int]] = defaultdict(list)
    for vehicle, component in tx.all(
        f"SELECT vehicle, component FROM component WHERE extended = 0{of_key} ORDER BY component", values
    ):
        components[vehicle].append(component)
    rows = tx.all(f"SELECT key, first_seen, last_seen, {IDENTITY} FROM vehicle{where}", values)
    found = [
        CachedVehicle(vehicle, read_identity(cells), first, last, tuple(components[vehicle]))
        for vehicle, first, last, *cells in rows
    ]
    return sorted(found, key=lambda each: (-each.last_seen, each.key))


def load_summaries(
    tx: Transaction, key: str | None = None, component: int | None = None, *, extended: bool = False
) -> list[CachedSummary]:
    """Return tables without their parameters, optionally of one vehicle or component."""
    of_vehicle: dict[str, list[StoredTable]] = defaultdict(list)
    for table in load_tables(tx, key, component, extended=extended):
        of_vehicle[table.key].append(table)
    return [
        CachedSummary(
            key=table.key,
            identity=vehicle.identity,
            component=table.component,
            autopilot=table.autopilot,
            size=table.size,
            updated_at=table.updated_at,
            **asdict(table.state),
        )
        for vehicle in load_vehicles(tx, key)
        for table in of_vehicle[vehicle.key]
    ]


def load_rows(tx: Transaction, owner: int, names: Collection[str] | None = None) -> dict[str, StoredParam]:
    """Return the parameters of a table by name, ordered by index, then name; those without an index last.

    Args:
        tx: the transaction.
        owner: id of the table.
        names: only these, in any order; None for all.
    """
    where, values = "", (owner, *(names or ()))
    if names is not None:
        where = f" AND name IN ({', '.join('?' * len(names))})"
    found = tx.all(
        "SELECT name, type, value, is_raw, param_index, volatile, heard_at, default_value FROM parameter"
        f" WHERE owner = ?{where}",
        values,
    )
    rows = [
        StoredParam(name, StoredValue(number, value, is_raw), index, volatile, at, default, "")
        for name, number, value, is_raw, index, volatile, at, default in found
    ]
    if names is None:
        rows.sort(key=lambda row: (row.param_index is None, row.param_index, row.name))
    return {row.name: row for row in rows}


def load_component(
    tx: Transaction, key: str, component: int, *, extended: bool = False
) -> CachedComponent | None:
    """Return a table; None if there is none.

    A hash that the stored values do not have is left out: it cannot confirm them.
    """
    table = find_table(tx, key, component, extended=extended)
    if table is None:
        return None
    rows = load_rows(tx, table.owner)
    params = stored_params(rows)
    volatile = frozenset(name for name, row in rows.items() if row.volatile)
    [summary] = load_summaries(tx, key, component, extended=extended)
    described = {name: getattr(summary, name) for name in CachedSummary.__slots__}
    if summary.hash is not None and summary.volatile_known:
        bits = {name: param.bits for name, param in params.items() if param.index is not None}
        if hash_bits(bits, leave_out=volatile) != summary.hash:
            described["hash"] = None
    return CachedComponent(
        **described,
        params=ParamMap(params),
        volatile=volatile,
        heard_at={name: row.heard_at for name, row in rows.items()},
    )


def remove_tables(tx: Transaction, key: str, component: int | None) -> int:
    """Delete a vehicle's tables with history and snapshots. Return the number of plain tables."""
    removed = load_tables(tx, key, component)
    for table in removed:
        tx.do("DELETE FROM component WHERE vehicle = ? AND component = ?", (key, table.component))
    tx.do("DELETE FROM vehicle WHERE key NOT IN (SELECT vehicle FROM component)")
    return len(removed)


def ensure_table(
    tx: Transaction, identity: Identity, component: int, at: float, *, extended: bool
) -> StoredTable:
    """Return the table of a vehicle's component, which is created if there is none."""
    table = find_table(tx, identity.key, component, extended=extended)
    if table is None:
        autopilot = identity.autopilot if component == 1 else 0
        new = TableUpdate(
            identity=identity, component=component, autopilot=autopilot, at=at, extended=extended
        )
        _upsert(tx, new, math.inf)
        table = find_table(tx, identity.key, component, extended=extended)
    assert table is not None
    return table


def save_table(
    tx: Transaction,
    update: TableUpdate,
    now: float,
    *,
    keeps_state: bool = False,
    is_apart: bool = False,
) -> tuple[int, list[StoredParam]]:
    """Write an update with its history lines.

    Return the id of the table, and the observations for which a later one is stored.

    Args:
        tx: the transaction.
        update: the update.
        now: current time in unix seconds.
        keeps_state: whether the state of the update is of another table than the stored one.
        is_apart: whether only values without a stored observation of this time or later change the table.
    """
    if keeps_state or is_apart:
        update = replace(update, table=None)
    if is_apart:
        update = replace(update, removed={}, replace=False)
    for item in update.params:
        time_cell(item.heard_at)
    horizon = max(now, update.at) + CLOCK_SLACK
    before = find_table(tx, update.identity.key, update.component, extended=update.extended)
    owner = _upsert(tx, update, horizon)
    return owner, _Save(tx, update, owner, before, horizon, is_apart=is_apart).run()


class _Save:
    """One update of a table, see `save_table`.

    Attributes:
        agrees: whether no value of the update differs from a stored later one.
        is_whole: whether the table has no other names than an update of the whole table.
        is_rehashed: whether a value that the hash covers has changed.
    """

    def __init__(
        self,
        tx: Transaction,
        update: TableUpdate,
        owner: int,
        before: StoredTable | None,
        horizon: float,
        *,
        is_apart: bool,
    ) -> None:
        self._tx = tx
        self._update = update
        self._owner = owner
        self._state = TableState() if before is None else before.state
        self._updated_at = -math.inf
        if before is not None and before.updated_at <= horizon:
            self._updated_at = before.updated_at
        # when the stored table was last known to have all names of the vehicle
        is_verified = self._state.complete and self._state.synced_at is not None
        self._verified_at = (self._state.synced_at or 0.0) if is_verified else -math.inf
        self._is_known = before is not None and before.known_since is not None
        self._horizon = horizon
        self._is_apart = is_apart
        self._is_late = is_apart or self._updated_at > update.at
        self._older: list[StoredParam] = []
        self._lines: list[Line] = []
        self.agrees = self.is_whole = True
        self.is_rehashed = False

    def run(self) -> list[StoredParam]:
        """Write the values, the lines and the state of the table."""
        update, tx = self._update, self._tx
        names = {item.name for item in update.params}
        if names or update.removed or update.replace:
            chosen = names | update.removed.keys()
            is_all = update.replace or len(chosen) > NAMES_SELECTED_MAX
            rows = load_rows(tx, self._owner, None if is_all else chosen)
            before = dict(rows)
            gone = dict(update.removed)
            if update.replace:
                at = update.at if update.whole_at is None else update.whole_at
                gone = {name: gone.get(name, at) for name in rows if name not in names}
            self._remove(rows, {name: at for name, at in gone.items() if name not in names})
            for item in update.params:
                self._observe(rows, item)
            changed = [row for name, row in rows.items() if row != before.get(name)]
            tx.many(
                _UPSERT,
                [(self._owner, row.name, *row.stored, *row[2:_CELLS_END], self._horizon) for row in changed],
            )
            add_lines(tx, self._owner, self._lines)
        self._write_state()
        return self._older

    def _remove(self, rows: dict[str, StoredParam], gone: Mapping[str, float]) -> None:
        for name, at in gone.items():
            row = rows.get(name)
            if row is None:
                continue
            if self._is_overtaken(at, row):
                self.is_whole = False
                continue
            del rows[name]
            self._tx.do("DELETE FROM parameter WHERE owner = ? AND name = ?", (self._owner, name))
            self._lines.append(Line(time_cell(at), name, BY_VEHICLE, row.heard_at, row.stored, None))
            self.is_rehashed = self.is_rehashed or row.hashed is not None

    def _observe(self, rows: dict[str, StoredParam], item: StoredParam) -> None:
        """Take one observation: `rows` are the stored parameters, and change."""
        name, at = item.name, item.heard_at
        old = rows.get(name)
        if old is None:
            if at < self._updated_at and at < max(
                self._verified_at, last_removal(self._tx, self._owner, name)
            ):  # the vehicle had no such parameter later
                self._older.append(item)
                self.agrees = self.agrees and item.param_index is None
                return
            rows[name] = item._replace(volatile=item.volatile or 0, by="")
            if self._is_known:
                self._lines.append(Line(at, name, item.by, None, None, item.stored))
        elif self._is_overtaken(at, old):
            self._older.append(item)
            is_same = old.stored.is_same(item.stored)
            self.agrees = self.agrees and is_same
            if old.param_index is None and item.param_index is not None and not self._is_late:
                rows[name] = old._replace(param_index=item.param_index, volatile=item.volatile or 0)
        else:
            index = item.param_index
            if index is None and not self._update.replace:
                index = old.param_index
            volatile = old.volatile if item.volatile is None else item.volatile
            rows[name] = item._replace(param_index=index, volatile=volatile, by="")
            if not old.stored.is_same(item.stored):
                self._lines.append(Line(at, name, item.by, old.heard_at, old.stored, item.stored))
        hashed = None if old is None else old.hashed
        self.is_rehashed = self.is_rehashed or rows[name].hashed != hashed

    def _is_overtaken(self, at: float, row: StoredParam) -> bool:
        """Return whether a stored value was observed after this time, or confirmed by the hash."""
        last = row.heard_at
        if self._is_late and row.hashed is not None:
            last = max(last, self._verified_at)
        return (at < last or (self._is_apart and at == last)) and last <= self._horizon

    def _write_state(self) -> None:
        state, kept = self._respectful(), self._state
        if state is None or not self.is_whole or (self._is_late and not state.complete):
            state = None
        elif not self.agrees:  # the hash belongs to other values
            state = replace(state, hash=None) if state.complete and not kept.complete else None
        if state is None:
            if self.is_rehashed:
                self._tx.do("UPDATE component SET hash = NULL WHERE id = ?", (self._owner,))
            return
        if state.complete and not self._update.replace and not kept.complete:
            [(listed,)] = self._tx.all(
                "SELECT count(*) FROM parameter WHERE owner = ? AND param_index IS NOT NULL", (self._owner,)
            )
            if listed < (state.count or 0):  # the other parameters were written to another file
                state = replace(state, hash=None, complete=False)
        self._tx.do(
            "UPDATE component SET (hash, param_count, complete, volatile_known, synced_at, file_works) ="
            " (?, ?, ?, ?, ?, ?) WHERE id = ?",
            (
                state.hash,
                state.count,
                int(state.complete),
                int(state.volatile_known),
                None if state.synced_at is None else time_cell(state.synced_at),
                None if state.file_works is None else int(state.file_works),
                self._owner,
            ),
        )
        if state.complete:
            self._tx.do(
                "UPDATE component SET known_since = ? WHERE id = ? AND known_since IS NULL",
                (self._update.at, self._owner),
            )

    def _respectful(self) -> TableState | None:
        """Return the table state of the update; None if the stored state has more information."""
        update, kept = self._update, self._state
        state = update.table
        if state is None or state.complete or update.replace or not kept.complete:
            return state
        has_received_less = state.count == kept.count or (state.count is None and not update.params)
        return None if has_received_less else state


def _upsert(tx: Transaction, update: TableUpdate, horizon: float) -> int:
    """Write the vehicle and component of an update, and return the id of the table, which may be new.

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
    return table.owner
