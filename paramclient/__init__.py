"""Client for MAVLink's parameter protocol, for asyncio and trio programs, with a parameter cache.

- `client`: the client over a link.
- `sync`: the same client for scripts and notebooks, without `await`.
- `protocol`, `links`: the sans-I/O core, and the bytes in and out.
- `cache`, `files`, `metadata`, `logs`, `provision`: cached tables, parameter files, units
  and ranges, telemetry logs, setting up vehicles, the check of a vehicle.
- `model`, `errors`, `version`: plain data, exceptions, the version.
- `service`, `cli`: the HTTP service, the command line.
- `sim`, `testing`: simulated vehicles, and fixtures for tests.

To find the module of a rule, see "Find the code" in `docs/internals/design.md`.
"""

from __future__ import annotations

from paramclient.cache import CachedComponent, ParamCache
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.events import (
    Contested,
    Discovered,
    Event,
    Events,
    Found,
    Lost,
    Rebooted,
    Resynced,
    Uncontested,
)
from paramclient.client.extended_params import ExtParams
from paramclient.client.fetch_all import FetchedAll
from paramclient.client.files import Ftp
from paramclient.client.reset import ResetResult
from paramclient.client.signing import Signing, read_key
from paramclient.client.stats import ClientStats
from paramclient.client.subscription import Changes
from paramclient.errors import (
    AlreadyRestored,
    AmbiguousVehicle,
    AnotherVehicle,
    CacheError,
    ClientClosed,
    CommandRefused,
    ContestedAddress,
    FileError,
    FileTransferError,
    InvalidParameters,
    LinkError,
    MetadataError,
    NoReply,
    NotDurable,
    NotInCache,
    ParamClientError,
    Refused,
    TypeMismatch,
    UnknownParameter,
    UnknownVehicle,
    UsageError,
    ValueNotApplied,
    VehicleArmed,
    VehicleError,
)
from paramclient.files import ParamFile, read_file, write_file
from paramclient.model.comparison import Comparison, compare
from paramclient.model.ext_params import ExtParam
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import Encoding, Param, ParamType, Settable, Trust, Value
from paramclient.protocol.addresses import Address
from paramclient.protocol.params.change import Added, Change, Changed, FirstValue, Removed
from paramclient.protocol.params.fetch_result import FetchResult, Policy, Progress
from paramclient.protocol.params.sync import ComponentState, SyncState
from paramclient.protocol.params.write_batch import SetManyResult, SetOutcome, SetStatus
from paramclient.protocol.params.writes import SetResult
from paramclient.protocol.wire import SigningKey, SigningPolicy
from paramclient.version import __version__

__all__ = [
    "Added",
    "Address",
    "AlreadyRestored",
    "AmbiguousVehicle",
    "AnotherVehicle",
    "CacheError",
    "CachedComponent",
    "Change",
    "Changed",
    "Changes",
    "ClientClosed",
    "ClientStats",
    "CommandRefused",
    "Comparison",
    "Component",
    "ComponentState",
    "Contested",
    "ContestedAddress",
    "Discovered",
    "Encoding",
    "Event",
    "Events",
    "ExtParam",
    "ExtParamSet",
    "ExtParams",
    "FetchResult",
    "FetchedAll",
    "FileError",
    "FileTransferError",
    "FirstValue",
    "Found",
    "Ftp",
    "Identity",
    "InvalidParameters",
    "LinkError",
    "Lost",
    "MetadataError",
    "NoReply",
    "NotDurable",
    "NotInCache",
    "Param",
    "ParamCache",
    "ParamClient",
    "ParamClientError",
    "ParamFile",
    "ParamMap",
    "ParamSet",
    "ParamType",
    "Policy",
    "Progress",
    "Rebooted",
    "Refused",
    "Removed",
    "ResetResult",
    "Resynced",
    "SetManyResult",
    "SetOutcome",
    "SetResult",
    "SetStatus",
    "Settable",
    "Signing",
    "SigningKey",
    "SigningPolicy",
    "SyncState",
    "Trust",
    "TypeMismatch",
    "Uncontested",
    "UnknownParameter",
    "UnknownVehicle",
    "UsageError",
    "Value",
    "ValueNotApplied",
    "VehicleArmed",
    "VehicleError",
    "WrittenParam",
    "__version__",
    "compare",
    "read_file",
    "read_key",
    "write_file",
]


def __dir__() -> list[str]:
    return sorted(__all__)
