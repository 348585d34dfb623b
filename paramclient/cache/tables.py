"""Tables of parameters as they are stored: vehicles, summaries, rows. Functions run in a transaction."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import astuple, fields, replace
from typing import Any, Final

from paramclient.cache.database import IDENTITY, Transaction
from paramclient.cache.records import (
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    StoredParam,
    StoredTable,
    stored_params,
    stored_value,
)
from paramclient.errors import UsageError
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.px4_hash import hash_bits

__all__ = [
    "find_table",
    "identity_cells",
    "load_component",
    "load_rows",
    "load_tables",
    "load_vehicles",
    "read_identity",
    "remove_tables",
    "time_cell",
]

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
