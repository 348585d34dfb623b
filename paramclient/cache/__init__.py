"""Parameter cache: tables, vehicle identities, history and snapshots, in a file or a shared database.

- `store`: `ParamCache`, the public class, and the default path of the file.
- `records`: records that the cache stores and returns.
- `database`: the tables in one SQL text, and the store in a SQLite file; `postgres`: in a shared database.
- `tables`: reads and updates of tables, import by time.
- `history`: lines of changes, values at an earlier time.
- `snapshots`: snapshots, and tables at an earlier time.
- `lookup`, `moments`: vehicles by system id, address, kind, hardware id or key; times in a user's words.
"""

from __future__ import annotations

from paramclient.cache.records import (
    BY_US,
    BY_VEHICLE,
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    HistoryEntry,
    SnapshotSummary,
    StoredParam,
    TableState,
    TableUpdate,
    check_author,
)
from paramclient.cache.snapshots import SNAPSHOTS
from paramclient.cache.store import ParamCache, default_path, is_database_url

__all__ = [
    "BY_US",
    "BY_VEHICLE",
    "SNAPSHOTS",
    "CachedComponent",
    "CachedSummary",
    "CachedVehicle",
    "HistoryEntry",
    "ParamCache",
    "SnapshotSummary",
    "StoredParam",
    "TableState",
    "TableUpdate",
    "check_author",
    "default_path",
    "is_database_url",
]
