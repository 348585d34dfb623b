"""Tables, identities and history on disk: what a vehicle's parameters were when it was last heard.

`records` says what goes in and comes out. The other rooms stand on one another: `store` is what is called,
`merge` brings in what is of the past,
`tables` keeps tables and their history, `earlier` tells what they were before,
`fleet` puts those of many vehicles beside each other, `rows` lays them into cells, `database` looks after
the file.
"""

from __future__ import annotations

from paramclient.cache.earlier import SNAPSHOTS
from paramclient.cache.fleet import FleetDiff, FleetValue, FleetVehicle, Holder, NameSpread
from paramclient.cache.records import (
    BY_US,
    BY_VEHICLE,
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    HistoryEntry,
    Snapshot,
    SnapshotSummary,
    StoredParam,
    TableState,
    TableUpdate,
    by_station,
)
from paramclient.cache.store import ParamCache, default_path
from paramclient.cache.tables import HISTORY_LINES

__all__ = [
    "BY_US",
    "BY_VEHICLE",
    "CachedComponent",
    "CachedSummary",
    "CachedVehicle",
    "FleetDiff",
    "FleetValue",
    "FleetVehicle",
    "HISTORY_LINES",
    "HistoryEntry",
    "Holder",
    "NameSpread",
    "ParamCache",
    "SNAPSHOTS",
    "Snapshot",
    "SnapshotSummary",
    "StoredParam",
    "TableState",
    "TableUpdate",
    "by_station",
    "default_path",
]
