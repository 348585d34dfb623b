"""Client for MAVLink's parameter protocol, for asyncio and trio programs, with a parameter cache.

- `client`, `remote`: the client over a link, and over a service.
- `protocol`, `links`: the sans-I/O core, and the bytes in and out.
- `cache`, `files`, `metadata`, `logs`, `provision`, `diagnosis`: cached tables, parameter files, units
  and ranges, telemetry logs, setting up vehicles, the check of a vehicle.
- `model`, `errors`, `version`: plain data, exceptions, the version.
- `service`, `documents`, `cli`: the HTTP service, JSON documents, the command line.
- `sim`, `testing`: simulated vehicles, and fixtures for tests.
"""

from __future__ import annotations

from paramclient.cache import (
    AddedTable,
    CachedComponent,
    CachedExtTable,
    CachedVehicle,
    ExtHistoryEntry,
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
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.events import (
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
from paramclient.client.extended_params import ExtChanges, ExtParams
from paramclient.client.fetch_all import FetchedAll
from paramclient.client.files import Ftp
from paramclient.client.reset import ResetResult
from paramclient.client.signing import Signing, key_from_environment, read_key
from paramclient.client.stats import ClientStats
from paramclient.client.subscription import Changes
from paramclient.errors import (
    AmbiguousVehicle,
    AnotherVehicle,
    CacheError,
    ClientClosed,
    CommandRefused,
    CommandResult,
    ContestedAddress,
    ExtAckResult,
    ExtSetRefused,
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
    SetFailed,
    TypeMismatch,
    UnknownParameter,
    UnknownVehicle,
    UsageError,
    ValueNotApplied,
    ValueUnsupported,
    VehicleArmed,
    VehicleError,
)
from paramclient.files import FileForm, ParamFile, read_file, read_renames, write_file
from paramclient.model.comparison import (
    Comparison,
    Difference,
    Moved,
    Standing,
    compare,
    defaults_of,
    same_value,
)
from paramclient.model.ext_params import ExtParam, ExtParamType, ExtSettable
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.renames import Rename, Renames
from paramclient.model.values import Encoding, Param, ParamType, Settable, Trust
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.ext.fetch import ExtFetchResult
from paramclient.protocol.ext.write_batch import ExtSetManyResult, ExtSetOutcome
from paramclient.protocol.ext.writes import ExtSetResult
from paramclient.protocol.ftp import DirectoryEntry
from paramclient.protocol.params.change import Added, Change, Removed
from paramclient.protocol.params.fetch_result import FetchResult, Policy, Progress
from paramclient.protocol.params.sampling import Sample
from paramclient.protocol.params.sync import SyncState
from paramclient.protocol.params.write_batch import SetManyResult, SetOutcome, SetStatus
from paramclient.protocol.params.writes import SetResult
from paramclient.protocol.stats.traffic import ComponentTraffic, MessageTraffic, RadioStatus, TrafficReport
from paramclient.protocol.vehicle.address_contest import Contest
from paramclient.protocol.wire import Refusal, SigningKey, SigningPolicy, SigningReport, SigningStream
from paramclient.version import __version__

__all__ = [
    "AddedTable",
    "Added",
    "AmbiguousVehicle",
    "AnotherVehicle",
    "CacheError",
    "CachedComponent",
    "CachedExtTable",
    "CachedVehicle",
    "Change",
    "Changes",
    "ClientClosed",
    "ClientStats",
    "CommandRefused",
    "CommandResult",
    "Comparison",
    "Component",
    "ComponentTraffic",
    "Contest",
    "Contested",
    "ContestedAddress",
    "Difference",
    "DirectoryEntry",
    "Encoding",
    "Event",
    "Events",
    "ExtAckResult",
    "ExtChange",
    "ExtChanges",
    "ExtFetchResult",
    "ExtHistoryEntry",
    "ExtParam",
    "ExtParamType",
    "ExtParams",
    "ExtSetManyResult",
    "ExtSetOutcome",
    "ExtSetRefused",
    "ExtSetResult",
    "ExtSettable",
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
    "Moved",
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
    "Removed",
    "Rename",
    "Renames",
    "ResetResult",
    "Resynced",
    "Sample",
    "SetFailed",
    "SetManyResult",
    "SetOutcome",
    "SetResult",
    "SetStatus",
    "Settable",
    "Signing",
    "SigningKey",
    "SigningPolicy",
    "SigningReport",
    "SigningStream",
    "Snapshot",
    "SnapshotSummary",
    "Standing",
    "SyncState",
    "TrafficReport",
    "Trust",
    "TypeMismatch",
    "Uncontested",
    "UnknownParameter",
    "UnknownVehicle",
    "UsageError",
    "ValueNotApplied",
    "ValueUnsupported",
    "VehicleArmed",
    "VehicleError",
    "WrittenParam",
    "__version__",
    "compare",
    "defaults_of",
    "key_from_environment",
    "read_key",
    "read_file",
    "read_renames",
    "same_value",
    "write_file",
]
