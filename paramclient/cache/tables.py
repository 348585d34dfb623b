"""Tables of parameters: updates with their history lines, and reads. Each function runs in a transaction.

The later observation of a value counts, whatever the order of the writes. A stored time in the future is from
before the computer's clock was set back, and counts as older than every observation. A hash stays with a
table only while the stored values are exactly those for which it was stated.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import astuple, dataclass, field, replace
from typing import Any, Final

from paramclient.cache.history import Line, add_lines, last_removal
from paramclient.cache.records import (
    BY_VEHICLE,
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    StoredParam,
    StoredValue,
    TableState,
    TableUpdate,
    stored_params,
)
from paramclient.cache.schema import IDENTITY, Transaction
from paramclient.errors import UsageError
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.px4_hash import hash_bits

__all__ = [
    "find_owner",
    "identity_cells",
    "load_component",
    "load_extended_sizes",
    "load_rows",
    "load_summaries",
    "load_updated_at",
    "load_vehicles",
    "read_identity",
    "remove_tables",
    "save_table",
    "time_cell",
    "upsert_owner",
]

CLOCK_SLACK: Final = 5.0
"""Seconds by which a stored time may be ahead of the clock although the clock was not set back: a call may
wait this long for its transaction."""
YEAR_10000: Final = 253402300800.0
"""Unix seconds at the start of the year 10000, above every stored time."""
NAMES_SELECTED_MAX: Final = 200
"""Names above which an update reads the whole table: SQLite allows at least 999 values in a statement."""

_STATE: Final = "hash, param_count, complete, volatile_known, synced_at, updated_at, file_works, known_since"
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


# reads


def find_owner(tx: Transaction, key: str, component: int, *, extended: bool = False) -> int | None:
    """Return the id of a table; None if there is none."""
    found = tx.all(
        "SELECT id FROM component WHERE vehicle = ? AND component = ? AND extended = ?",
        (key, component, int(extended)),
    )
    return int(found[0][0]) if found else None


def load_vehicles(tx: Transaction) -> list[CachedVehicle]:
    """Return all vehicles, the last seen first."""
    components: dict[str, list[int]] = {}
    for key, component in tx.all(
        "SELECT vehicle, component FROM component WHERE extended = 0 ORDER BY component"
    ):
        components.setdefault(key, []).append(component)
    found = [
        CachedVehicle(key, read_identity(cells), first, last, tuple(components.get(key, ())))
        for key, first, last, *cells in tx.all(f"SELECT key, first_seen, last_seen, {IDENTITY} FROM vehicle")
    ]
    return sorted(found, key=lambda each: (-each.last_seen, each.key))


def load_summaries(
    tx: Transaction, key: str | None = None, component: int | None = None, *, extended: bool = False
) -> list[CachedSummary]:
    """Return tables without their parameters, optionally of one vehicle or component."""
    conditions, values = _conditions({"c.vehicle": key, "c.component": component})
    found = []
    for last_seen, *cells in tx.all(
        f"SELECT v.last_seen, c.vehicle, c.component, c.autopilot, {_STATE},"
        " (SELECT count(*) FROM parameter p WHERE p.owner = c.id),"
        f" {', '.join('v.' + column for column in IDENTITY.split(', '))}"
        f" FROM component c JOIN vehicle v ON v.key = c.vehicle WHERE c.extended = ?{conditions}",
        [int(extended), *values],
    ):
        vehicle, number, autopilot, *state = cells[:11]
        size, *described = cells[11:]
        hash_, count, complete, volatile_known, synced_at, updated_at, file_works, _ = state
        summary = CachedSummary(
            vehicle,
            read_identity(described),
            number,
            autopilot,
            size,
            hash_,
            count,
            bool(complete),
            bool(volatile_known),
            synced_at,
            updated_at,
            None if file_works is None else bool(file_works),
        )
        found.append((-last_seen, vehicle, number, summary))
    return [summary for *_, summary in sorted(found, key=lambda each: each[:3])]


def load_updated_at(tx: Transaction, key: str, component: int, extended: bool) -> float | None:
    """Return the time of the last update of a table; None if there is none."""
    owner = find_owner(tx, key, component, extended=extended)
    found = tx.all("SELECT updated_at FROM component WHERE id = ?", (owner,))
    return float(found[0][0]) if found else None


def load_extended_sizes(tx: Transaction) -> dict[tuple[str, int], int]:
    """Return the number of extended parameters by key and component."""
    found = tx.all(
        "SELECT vehicle, component, count(*) FROM component JOIN parameter ON owner = id"
        " WHERE extended = 1 GROUP BY vehicle, component"
    )
    return {(key, component): size for key, component, size in found}


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
    owner = find_owner(tx, key, component, extended=extended)
    if owner is None:
        return None
    [summary] = load_summaries(tx, key, component, extended=extended)
    rows = load_rows(tx, owner)
    params = stored_params(rows)
    volatile = frozenset(name for name, row in rows.items() if row.volatile)
    confirmed = summary.hash
    if confirmed is not None and summary.volatile_known:
        listed = {name: param.bits for name, param in params.items() if param.index is not None}
        if hash_bits(listed, leave_out=volatile) != confirmed:
            confirmed = None
    described = {name: getattr(summary, name) for name in CachedSummary.__slots__}
    return CachedComponent(
        **described | {"hash": confirmed},
        params=ParamMap(params),
        volatile=volatile,
        heard_at={name: row.heard_at for name, row in rows.items()},
    )


# writes


def remove_tables(tx: Transaction, key: str, component: int | None) -> int:
    """Delete a vehicle's tables with history and snapshots. Return the number of plain tables."""
    conditions, values = _conditions({"vehicle": key, "component": component})
    removed = tx.all(f"SELECT id FROM component WHERE extended = 0{conditions}", values)
    tx.do(f"DELETE FROM component WHERE extended IN (0, 1){conditions}", values)
    tx.do("DELETE FROM vehicle WHERE key NOT IN (SELECT vehicle FROM component)")
    return len(removed)


def upsert_owner(tx: Transaction, update: TableUpdate, horizon: float = math.inf) -> int:
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
    owner = find_owner(tx, key, update.component, extended=update.extended)
    assert owner is not None
    return owner


def save_table(
    tx: Transaction,
    update: TableUpdate,
    now: float,
    *,
    keeps_state: bool = False,
    is_apart: bool = False,
) -> list[StoredParam]:
    """Write an update with its history lines. Return the observations for which a later one is stored.

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
    kept = _kept(tx, update, horizon)
    owner = upsert_owner(tx, update, horizon)
    return _Save(tx, update, owner, kept, horizon, is_apart=is_apart).run()


@dataclass(frozen=True)
class _Kept:
    """State of a stored table before an update; of a new one by default.

    Attributes:
        state: its state.
        updated_at: time of the last update; minus infinity for a new table.
        known_since: time since which its states are known, or None.
    """

    state: TableState = field(default_factory=TableState)
    updated_at: float = -math.inf
    known_since: float | None = None

    @property
    def verified_at(self) -> float:
        """Time at which the table was last known to have all names of the vehicle."""
        at = self.state.synced_at if self.state.complete else None
        return -math.inf if at is None else at


def _kept(tx: Transaction, update: TableUpdate, horizon: float) -> _Kept:
    found = tx.all(
        f"SELECT {_STATE} FROM component WHERE vehicle = ? AND component = ? AND extended = ?",
        (update.identity.key, update.component, int(update.extended)),
    )
    if not found:
        return _Kept()
    hash_, count, complete, volatile_known, synced_at, updated_at, file_works, since = found[0]
    state = TableState(hash_, count, bool(complete), bool(volatile_known), synced_at, file_works)
    return _Kept(state, -math.inf if updated_at > horizon else updated_at, since)


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
        kept: _Kept,
        horizon: float,
        *,
        is_apart: bool,
    ) -> None:
        self._tx = tx
        self._update = update
        self._owner = owner
        self._kept = kept
        self._horizon = horizon
        self._is_apart = is_apart
        self._is_late = is_apart or kept.updated_at > update.at
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
            if at < self._kept.updated_at and at < max(
                self._kept.verified_at, last_removal(self._tx, self._owner, name)
            ):  # the vehicle had no such parameter later
                self._older.append(item)
                self.agrees = self.agrees and item.param_index is None
                return
            rows[name] = item._replace(volatile=item.volatile or 0, by="")
            if self._kept.known_since is not None:
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
            last = max(last, self._kept.verified_at)
        return (at < last or (self._is_apart and at == last)) and last <= self._horizon

    def _write_state(self) -> None:
        state, kept = self._respectful(), self._kept.state
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
        update, kept = self._update, self._kept.state
        state = update.table
        if state is None or state.complete or update.replace or not kept.complete:
            return state
        has_received_less = state.count == kept.count or (state.count is None and not update.params)
        return None if has_received_less else state


def _conditions(columns: Mapping[str, object]) -> tuple[str, list[object]]:
    """Return SQL conditions of the columns that have a value, and these values."""
    given = {column: value for column, value in columns.items() if value is not None}
    return "".join(f" AND {column} = ?" for column in given), list(given.values())
