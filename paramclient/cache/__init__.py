"""Tables, identities and history on disk: what a vehicle's parameters were when it was last heard.

`records` says what goes in and comes out. The other rooms stand on one another: `store` is what is called,
`merge` brings in what is of the past,
`tables` keeps tables and their history, `rows` lays them into cells, `database` looks after the file.
"""

from __future__ import annotations

from paramclient.cache.records import (
    BY_US,
    BY_VEHICLE,
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    HistoryEntry,
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
    "HISTORY_LINES",
    "HistoryEntry",
    "ParamCache",
    "StoredParam",
    "TableState",
    "TableUpdate",
    "by_station",
    "default_path",
]
