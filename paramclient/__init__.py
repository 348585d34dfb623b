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

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from paramclient.version import __version__

if TYPE_CHECKING:
    from paramclient.cache import (
        CachedComponent,
        CachedExtTable,
        CachedVehicle,
        ExtHistoryEntry,
        HistoryEntry,
        ParamCache,
        SnapshotSummary,
    )
    from paramclient.cache.records import CachedSummary
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
    from paramclient.client.signing import Signing, key_from_environment, read_key
    from paramclient.client.stats import ClientStats
    from paramclient.client.subscription import Changes, ExtChanges
    from paramclient.errors import (
        AlreadyRestored,
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
    from paramclient.files import FileFormat, ParamFile, read_file, read_renames, write_file
    from paramclient.files.formats import LogFormat
    from paramclient.model.comparison import (
        ChangedSide,
        Comparison,
        Difference,
        DifferenceStatus,
        compare,
        defaults_of,
        same_value,
    )
    from paramclient.model.ext_params import ExtParam, ExtParamType, ExtSettable, ExtValue
    from paramclient.model.ext_paramset import ExtParamSet
    from paramclient.model.identity import Identity
    from paramclient.model.params import ParamMap
    from paramclient.model.paramset import ParamSet, WrittenParam
    from paramclient.model.renames import Rename, Renames
    from paramclient.model.values import Encoding, Param, ParamType, Settable, Trust, Value, WireValue
    from paramclient.protocol.addresses import Address
    from paramclient.protocol.ext.change import ExtChange
    from paramclient.protocol.ext.fetch import ExtFetchResult
    from paramclient.protocol.ext.write_batch import ExtSetManyResult, ExtSetOutcome
    from paramclient.protocol.ext.writes import ExtSetResult
    from paramclient.protocol.ftp import DirectoryEntry
    from paramclient.protocol.params.change import Added, Change, Changed, FirstValue, Removed
    from paramclient.protocol.params.fetch_result import FetchResult, FetchSource, Policy, Progress
    from paramclient.protocol.params.sync import ComponentState, SyncState
    from paramclient.protocol.params.write_batch import SetManyResult, SetOutcome, SetStatus
    from paramclient.protocol.params.writes import SetResult
    from paramclient.protocol.stats.traffic import (
        ComponentTraffic,
        MessageTraffic,
        RadioStatus,
        TrafficReport,
    )
    from paramclient.protocol.vehicle.address_contest import Contest
    from paramclient.protocol.wire import (
        AutopilotVersion,
        Heartbeat,
        Refusal,
        SigningKey,
        SigningPolicy,
        SigningReport,
        SigningStream,
    )
__all__ = [
    "Added",
    "Address",
    "AlreadyRestored",
    "AmbiguousVehicle",
    "AnotherVehicle",
    "AutopilotVersion",
    "CacheError",
    "CachedComponent",
    "CachedExtTable",
    "CachedSummary",
    "CachedVehicle",
    "Change",
    "Changed",
    "Changes",
    "ClientClosed",
    "ClientStats",
    "CommandRefused",
    "CommandResult",
    "Comparison",
    "Component",
    "ComponentState",
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
    "ExtParamSet",
    "ExtParamType",
    "ExtParams",
    "ExtSetManyResult",
    "ExtSetOutcome",
    "ExtSetRefused",
    "ExtSetResult",
    "ExtSettable",
    "ExtValue",
    "FetchResult",
    "FetchSource",
    "FetchedAll",
    "FileError",
    "FileErrorCode",
    "FileFormat",
    "FileTransferError",
    "FirstValue",
    "Found",
    "Ftp",
    "Discovered",
    "Heartbeat",
    "HistoryEntry",
    "Identity",
    "InvalidParameters",
    "LinkError",
    "LogFormat",
    "Lost",
    "MessageTraffic",
    "MetadataError",
    "ChangedSide",
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
    "SnapshotSummary",
    "DifferenceStatus",
    "SyncState",
    "TrafficReport",
    "Trust",
    "TypeMismatch",
    "Uncontested",
    "UnknownParameter",
    "UnknownVehicle",
    "UsageError",
    "Value",
    "ValueNotApplied",
    "ValueUnsupported",
    "VehicleArmed",
    "VehicleError",
    "WireValue",
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

_HOMES: Final = {
    "paramclient.cache": (
        "CachedComponent",
        "CachedExtTable",
        "CachedVehicle",
        "ExtHistoryEntry",
        "HistoryEntry",
        "ParamCache",
        "SnapshotSummary",
    ),
    "paramclient.cache.records": ("CachedSummary",),
    "paramclient.client.client": ("ParamClient",),
    "paramclient.client.component": ("Component",),
    "paramclient.client.events": (
        "Contested",
        "Event",
        "Events",
        "Found",
        "Discovered",
        "Lost",
        "Rebooted",
        "Resynced",
        "Uncontested",
    ),
    "paramclient.client.extended_params": ("ExtParams",),
    "paramclient.client.fetch_all": ("FetchedAll",),
    "paramclient.client.files": ("Ftp",),
    "paramclient.client.reset": ("ResetResult",),
    "paramclient.client.signing": (
        "Signing",
        "key_from_environment",
        "read_key",
    ),
    "paramclient.client.stats": ("ClientStats",),
    "paramclient.client.subscription": ("Changes", "ExtChanges"),
    "paramclient.errors": (
        "AlreadyRestored",
        "AmbiguousVehicle",
        "AnotherVehicle",
        "CacheError",
        "ClientClosed",
        "CommandRefused",
        "CommandResult",
        "ContestedAddress",
        "ExtAckResult",
        "ExtSetRefused",
        "FileError",
        "FileErrorCode",
        "FileTransferError",
        "InvalidParameters",
        "LinkError",
        "MetadataError",
        "NoReply",
        "NotDurable",
        "NotInCache",
        "PackError",
        "ParamClientError",
        "ParamErrorCode",
        "Refused",
        "SetFailed",
        "TypeMismatch",
        "UnknownParameter",
        "UnknownVehicle",
        "UsageError",
        "ValueNotApplied",
        "ValueUnsupported",
        "VehicleArmed",
        "VehicleError",
    ),
    "paramclient.files": (
        "FileFormat",
        "ParamFile",
        "read_file",
        "read_renames",
        "write_file",
    ),
    "paramclient.files.formats": ("LogFormat",),
    "paramclient.model.comparison": (
        "Comparison",
        "Difference",
        "ChangedSide",
        "DifferenceStatus",
        "compare",
        "defaults_of",
        "same_value",
    ),
    "paramclient.model.ext_params": (
        "ExtParam",
        "ExtParamType",
        "ExtSettable",
        "ExtValue",
    ),
    "paramclient.model.ext_paramset": ("ExtParamSet",),
    "paramclient.model.identity": ("Identity",),
    "paramclient.model.params": ("ParamMap",),
    "paramclient.model.paramset": (
        "ParamSet",
        "WrittenParam",
    ),
    "paramclient.model.renames": (
        "Rename",
        "Renames",
    ),
    "paramclient.model.values": (
        "Encoding",
        "Param",
        "ParamType",
        "Settable",
        "Trust",
        "Value",
        "WireValue",
    ),
    "paramclient.protocol.addresses": ("Address",),
    "paramclient.protocol.ext.change": ("ExtChange",),
    "paramclient.protocol.ext.fetch": ("ExtFetchResult",),
    "paramclient.protocol.ext.write_batch": (
        "ExtSetManyResult",
        "ExtSetOutcome",
    ),
    "paramclient.protocol.ext.writes": ("ExtSetResult",),
    "paramclient.protocol.ftp": ("DirectoryEntry",),
    "paramclient.protocol.params.change": (
        "Added",
        "Change",
        "Changed",
        "FirstValue",
        "Removed",
    ),
    "paramclient.protocol.params.fetch_result": (
        "FetchResult",
        "FetchSource",
        "Policy",
        "Progress",
    ),
    "paramclient.protocol.params.sync": ("ComponentState", "SyncState"),
    "paramclient.protocol.params.write_batch": (
        "SetManyResult",
        "SetOutcome",
        "SetStatus",
    ),
    "paramclient.protocol.params.writes": ("SetResult",),
    "paramclient.protocol.stats.traffic": (
        "ComponentTraffic",
        "MessageTraffic",
        "RadioStatus",
        "TrafficReport",
    ),
    "paramclient.protocol.vehicle.address_contest": ("Contest",),
    "paramclient.protocol.wire": (
        "AutopilotVersion",
        "Heartbeat",
        "Refusal",
        "SigningKey",
        "SigningPolicy",
        "SigningReport",
        "SigningStream",
    ),
}
"""The modules of the public names. A module is imported at the first use of one of its names: the command
needs few of them, and shell completion almost none."""
_HOME_OF: Final = {name: module for module, names in _HOMES.items() for name in names}


if not TYPE_CHECKING:  # type checkers would take any name for one of the package

    def __getattr__(name: str) -> Any:
        module = _HOME_OF.get(name)
        if module is None:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(module), name)
        return value


def __dir__() -> list[str]:
    return sorted(__all__)
