"""Tables, identities and history on disk: what a vehicle's parameters were when it was last heard.

`records` says what goes in and comes out. The other rooms stand on one another: `store` is what is called,
and `interface` what it calls; `operations` are what can be written. `settle` brings in what programs and
stations observe, and `merge` what is of the past;
`tables` keeps tables and their history, `earlier` tells what they were before,
`fleet` puts those of many vehicles beside each other, `rows` lays them into cells. `session` is one
transaction in the SQL of every database, `sqlite` in that of a file, where `packed` makes a blob of a table;
`database` looks after the file, and `schema` says what is in it.

Where stations share a database, `shared` puts this together: `postgres` (with `migrations` and `address`),
and the local copy with its `outbox`. `transfer` copies tables.
"""

from __future__ import annotations

from paramclient.cache.fleet import FleetDiff, FleetValue, FleetVehicle, Holder, NameSpread
from paramclient.cache.observed_table import HeardParams, UnixTimes
from paramclient.cache.records import (
    BY_US,
    BY_VEHICLE,
    CacheChange,
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
from paramclient.cache.setups import CutOff, RunningSetup, SetupNotes
from paramclient.cache.snapshots import CLOCK_SLACK, SNAPSHOTS
from paramclient.cache.store import ParamCache, default_path
from paramclient.cache.tables import HISTORY_LINES
from paramclient.cache.transfer import CopyResult

__all__ = [
    "BY_US",
    "BY_VEHICLE",
    "CLOCK_SLACK",
    "CacheChange",
    "CachedComponent",
    "CachedSummary",
    "CachedVehicle",
    "CopyResult",
    "CutOff",
    "FleetDiff",
    "FleetValue",
    "FleetVehicle",
    "HISTORY_LINES",
    "HeardParams",
    "HistoryEntry",
    "Holder",
    "NameSpread",
    "ParamCache",
    "RunningSetup",
    "SNAPSHOTS",
    "SetupNotes",
    "Snapshot",
    "SnapshotSummary",
    "StoredParam",
    "TableState",
    "TableUpdate",
    "UnixTimes",
    "by_station",
    "default_path",
]
