"""Client for MAVLink's parameter protocol, for asyncio and trio programs, with a parameter cache.

- `client`: the client over a link.
- `sync`: the same client for scripts and notebooks, without `await`.
- `protocol`, `wire`, `links`: the conversations with a component, messages from and to bytes, the bytes in
  and out.
- `cache`, `files`, `metadata`, `logs`, `provision`: cached tables, parameter files, units
  and ranges, telemetry logs, setting up vehicles, the check of a vehicle.
- `model`, `errors`, `version`: plain data, exceptions, the version.
- `service`, `cli`: the HTTP service, the command line.
- `sim`, `testing`: simulated vehicles, and fixtures for tests.

To find the module of a rule, see "Find the code" in `docs/internals.md`.
"""

from __future__ import annotations

from paramclient.cache import CachedComponent, ParamCache
from paramclient.client.client import Event, Events, FetchedAll, ParamClient
from paramclient.client.component import Component, ComponentState
from paramclient.client.signing import Signing, read_key
from paramclient.client.streams import Changes
from paramclient.errors import (
    AlreadyRestored,
    AmbiguousVehicle,
    AnotherVehicle,
    CacheError,
    ClientClosed,
    CommandRefused,
    FileError,
    FileTransferError,
    InvalidParameters,
    LinkError,
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
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamMap, ParamSet, WrittenParam
from paramclient.model.values import Encoding, Param, ParamType, Settable, Trust, Value
from paramclient.protocol.addresses import Address
from paramclient.protocol.fetch import FetchResult, Policy, Progress
from paramclient.protocol.set_results import SetManyResult, SetOutcome, SetResult, SetStatus
from paramclient.protocol.table import Change
from paramclient.protocol.watch import SyncState
from paramclient.version import __version__
from paramclient.wire.signing import SigningKey, SigningPolicy

__all__ = [
    "Address",
    "AlreadyRestored",
    "AmbiguousVehicle",
    "AnotherVehicle",
    "CacheError",
    "CachedComponent",
    "Change",
    "Changes",
    "ClientClosed",
    "CommandRefused",
    "Comparison",
    "Component",
    "ComponentState",
    "Encoding",
    "Event",
    "Events",
    "FetchResult",
    "FetchedAll",
    "FileError",
    "FileTransferError",
    "Identity",
    "InvalidParameters",
    "LinkError",
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
    "Refused",
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
