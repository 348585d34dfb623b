"""The ground-station side of MAVLink's parameter protocol for asyncio programs, with a cache."""

from __future__ import annotations

from paramclient.cache import CachedComponent, CachedVehicle, HistoryEntry, ParamCache
from paramclient.client import FetchedAll, ParamClient
from paramclient.component import Component
from paramclient.errors import (
    CacheError,
    ClientClosed,
    LinkError,
    NoReply,
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
from paramclient.identity import Identity
from paramclient.params import ParamMap
from paramclient.protocol.result import FetchResult, Policy, Progress
from paramclient.protocol.sync import SyncState
from paramclient.protocol.table import Change
from paramclient.protocol.traffic import ComponentTraffic, MessageTraffic, RadioStatus, TrafficReport
from paramclient.protocol.writes import SetResult
from paramclient.values import Encoding, Param, ParamType, Trust
from paramclient.version import __version__

__all__ = [
    "CacheError",
    "CachedComponent",
    "CachedVehicle",
    "Change",
    "Changes",
    "ClientClosed",
    "Component",
    "ComponentTraffic",
    "Encoding",
    "Event",
    "Events",
    "FetchResult",
    "FetchedAll",
    "Found",
    "Heard",
    "HistoryEntry",
    "Identity",
    "LinkError",
    "Lost",
    "MessageTraffic",
    "NoReply",
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
