"""Parameter cache: tables, vehicle identities, history and snapshots, in a file or a shared database.

- `cells`: database cells: checks of their types, times and identities.
- `database_url`: URL of a PostgreSQL database.
- `ext_records`, `ext_tables`: extended parameters: records; updates, reads and copies.
- `ext_snapshots`: snapshots of extended parameters, and their tables at an earlier time.
- `file_ownership`: owner and access rights of files.
- `file_table`: a parameter file as the table of a vehicle.
- `fleet`: comparison of parameters across vehicles.
- `interface`: `Store`, the interface of a file and of a shared database.
- `lock`: lock on a folder or file.
- `lookup`: vehicles by system id, address, nickname, kind, hardware id or key.
- `merge`: merge of earlier observations, such as those of logs.
- `postgres_schema`: schema of the PostgreSQL database.
- `nicknames`: nicknames of vehicles.
- `observed_table`: parameters of a live table as observations.
- `operations`: write operations.
- `outbox`: local copy of a shared database, with the writes that it has not received yet.
- `packed_table`: a table as one binary blob.
- `postgres`: PostgreSQL database.
- `reconciliation`: new observations reconciled with the stored table and history, by time.
- `records`: records that the cache stores and returns.
- `sqlite_schema`: schema of the file.
- `interrupted_setups`: notes about running and interrupted set-ups.
- `shared`: a shared database with its local copy.
- `snapshots`: snapshots, and tables at an earlier time.
- `sqlite`: SQLite transactions.
- `sqlite_file`: the SQLite file: opening, checks, replacement of a damaged one.
- `store`: `ParamCache`, the public class, and the default path of the file.
- `history_columns`: the stored form of a history line, its columns, and how many lines are kept.
- `param_columns`: the stored form of a parameter, and its columns in both databases.
- `table_updates`: updates of tables, with their history lines.
- `transaction`: `Transaction`, one transaction in SQL.
- `transfer`: copies of tables between stores.
"""

from __future__ import annotations

from paramclient.cache.ext_records import (
    CachedExtTable,
    ExtHistoryEntry,
    ExtSnapshot,
    ExtTableUpdate,
    StoredExtParam,
)
from paramclient.cache.file_table import AddedTable
from paramclient.cache.fleet import FleetDiff, FleetValue, FleetVehicle, Holder, NameSpread
from paramclient.cache.history_columns import HISTORY_ENTRIES_MAX
from paramclient.cache.interrupted_setups import InterruptedSetup, RunningSetup, SetupNotes
from paramclient.cache.observed_table import ObservedParams, UnixTimes
from paramclient.cache.param_columns import BY_VEHICLE, StoredParam
from paramclient.cache.records import (
    BY_US,
    CacheChange,
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    HistoryEntry,
    Snapshot,
    SnapshotSummary,
    TableState,
    TableUpdate,
    by_station,
)
from paramclient.cache.snapshots import CLOCK_SLACK, SNAPSHOTS
from paramclient.cache.store import ParamCache, default_path
from paramclient.cache.transfer import CopyResult

__all__ = [
    "AddedTable",
    "BY_US",
    "BY_VEHICLE",
    "CLOCK_SLACK",
    "CacheChange",
    "CachedComponent",
    "CachedExtTable",
    "CachedSummary",
    "CachedVehicle",
    "CopyResult",
    "InterruptedSetup",
    "ExtHistoryEntry",
    "ExtSnapshot",
    "ExtTableUpdate",
    "FleetDiff",
    "FleetValue",
    "FleetVehicle",
    "HISTORY_ENTRIES_MAX",
    "ObservedParams",
    "HistoryEntry",
    "Holder",
    "NameSpread",
    "ParamCache",
    "RunningSetup",
    "SNAPSHOTS",
    "SetupNotes",
    "Snapshot",
    "SnapshotSummary",
    "StoredExtParam",
    "StoredParam",
    "TableState",
    "TableUpdate",
    "UnixTimes",
    "by_station",
    "default_path",
]
