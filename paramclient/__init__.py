"""The ground-station side of MAVLink's parameter protocol for asyncio programs, with a cache."""

from __future__ import annotations

from paramclient.cache import (
    CachedComponent,
    CachedVehicle,
    FleetDiff,
    FleetValue,
    FleetVehicle,
    HistoryEntry,
    Holder,
    NameSpread,
    ParamCache,
    Snapshot,
    SnapshotSummary,
)
from paramclient.client import FetchedAll, ParamClient
from paramclient.component import Component
from paramclient.errors import (
    AmbiguousVehicle,
    AnotherVehicle,
    CacheError,
    ClientClosed,
    CommandRefused,
    CommandResult,
    ContestedAddress,
    FileError,
    FileErrorCode,
    FileTransferError,
    InvalidParameters,
    LinkError,
    MetadataError,
    NoReply,
    NotDurable,
    NotInCache,
    PackError,
    ParamClientError,
    ParamErrorCode,
    Refused,
    TypeMismatch,
    UnknownParameter,
    UnknownVehicle,
    UsageError,
    ValueNotApplied,
    VehicleArmed,
    VehicleError,
)
from paramclient.events import (
    Changes,
    Contested,
    Event,
    Events,
    Found,
    Heard,
    Lost,
    Rebooted,
    Resynced,
    Uncontested,
)
from paramclient.files import FileForm, ParamFile, read_file, write_file
from paramclient.ftp import Ftp
from paramclient.identity import Identity
from paramclient.params import ParamMap
from paramclient.paramset import ParamSet, WrittenParam
from paramclient.protocol.change import Change
from paramclient.protocol.ftp import DirectoryEntry
from paramclient.protocol.peers import Contest
from paramclient.protocol.result import FetchResult, Policy, Progress
from paramclient.protocol.sampling import Sample
from paramclient.protocol.sync import SyncState
from paramclient.protocol.traffic import ComponentTraffic, MessageTraffic, RadioStatus, TrafficReport
from paramclient.protocol.wire import Refusal, SigningKey, SigningPolicy, SigningReport, SigningStream
from paramclient.protocol.writes import SetResult
from paramclient.signing import Signing, key_from_environment, read_key
from paramclient.stats import ClientStats
from paramclient.values import Encoding, Param, ParamType, Trust
from paramclient.version import __version__

__all__ = [
    "AmbiguousVehicle",
    "AnotherVehicle",
    "CacheError",
    "CachedComponent",
    "CachedVehicle",
    "Change",
    "Changes",
    "ClientClosed",
    "ClientStats",
    "CommandRefused",
    "CommandResult",
    "Component",
    "ComponentTraffic",
    "Contest",
    "Contested",
    "ContestedAddress",
    "DirectoryEntry",
    "Encoding",
    "Event",
    "Events",
    "FetchResult",
    "FetchedAll",
    "FileError",
    "FileErrorCode",
    "FileForm",
    "FileTransferError",
    "FleetDiff",
    "FleetValue",
    "FleetVehicle",
    "Found",
    "Ftp",
    "Heard",
    "HistoryEntry",
    "Holder",
    "Identity",
    "InvalidParameters",
    "LinkError",
    "Lost",
    "MessageTraffic",
    "MetadataError",
    "NameSpread",
    "NoReply",
    "NotDurable",
    "NotInCache",
    "PackError",
    "Param",
    "ParamCache",
    "ParamClient",
    "ParamClientError",
    "ParamErrorCode",
    "ParamFile",
    "ParamMap",
    "ParamSet",
    "ParamType",
    "Policy",
    "Progress",
    "Rebooted",
    "RadioStatus",
    "Refusal",
    "Refused",
    "Resynced",
    "Sample",
    "SetResult",
    "Signing",
    "SigningKey",
    "SigningPolicy",
    "SigningReport",
    "SigningStream",
    "Snapshot",
    "SnapshotSummary",
    "SyncState",
    "TrafficReport",
    "Trust",
    "TypeMismatch",
    "Uncontested",
    "UnknownParameter",
    "UnknownVehicle",
    "UsageError",
    "ValueNotApplied",
    "VehicleArmed",
    "VehicleError",
    "WrittenParam",
    "__version__",
    "key_from_environment",
    "read_key",
    "read_file",
    "write_file",
]
