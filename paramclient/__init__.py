"""The ground-station side of MAVLink's parameter protocol for asyncio programs, with a cache."""

from __future__ import annotations

from paramclient.cache import CachedComponent, CachedVehicle, HistoryEntry, ParamCache
from paramclient.client import FetchedAll, ParamClient
from paramclient.component import Component
from paramclient.errors import (
    CacheError,
    ClientClosed,
    FileErrorCode,
    FileTransferError,
    LinkError,
    NoReply,
    PackError,
    ParamClientError,
    ParamErrorCode,
    Refused,
    TypeMismatch,
    UnknownParameter,
    UsageError,
    ValueNotApplied,
    VehicleError,
)
from paramclient.events import Changes, Event, Events, Found, Heard, Lost, Rebooted, Resynced
from paramclient.ftp import Ftp
from paramclient.identity import Identity
from paramclient.params import ParamMap
from paramclient.protocol.ftp import DirectoryEntry
from paramclient.protocol.result import FetchResult, Policy, Progress
from paramclient.protocol.sampling import Sample
from paramclient.protocol.sync import SyncState
from paramclient.protocol.table import Change
from paramclient.protocol.traffic import ComponentTraffic, MessageTraffic, RadioStatus, TrafficReport
from paramclient.protocol.writes import SetResult
from paramclient.stats import ClientStats
from paramclient.values import Encoding, Param, ParamType, Trust
from paramclient.version import __version__

__all__ = [
    "CacheError",
    "CachedComponent",
    "CachedVehicle",
    "Change",
    "Changes",
    "ClientClosed",
    "ClientStats",
    "Component",
    "ComponentTraffic",
    "DirectoryEntry",
    "Encoding",
    "Event",
    "Events",
    "FetchResult",
    "FetchedAll",
    "FileErrorCode",
    "FileTransferError",
    "Found",
    "Ftp",
    "Heard",
    "HistoryEntry",
    "Identity",
    "LinkError",
    "Lost",
    "MessageTraffic",
    "NoReply",
    "PackError",
    "Param",
    "ParamCache",
    "ParamClient",
    "ParamClientError",
    "ParamErrorCode",
    "ParamMap",
    "ParamType",
    "Policy",
    "Progress",
    "Rebooted",
    "RadioStatus",
    "Refused",
    "Resynced",
    "Sample",
    "SetResult",
    "SyncState",
    "TrafficReport",
    "Trust",
    "TypeMismatch",
    "UnknownParameter",
    "UsageError",
    "ValueNotApplied",
    "VehicleError",
    "__version__",
]
