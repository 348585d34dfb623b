"""Documents of single subcommands: fetched tables, writes, saved and imported files, events, serial ports."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal

from paramclient.client.events import Contested, Found, Lost, Resynced
from paramclient.documents.component import ContestDoc
from paramclient.documents.document import Document, Maybe, Scalar
from paramclient.documents.param import ParamDoc, ReadOutputDoc
from paramclient.documents.receiver import ReceiverDoc
from paramclient.documents.setup import FailedVehicleDoc
from paramclient.model.defaults import DefaultSource
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import hash_text, rounded, time_text, typed, value_json
from paramclient.model.values import ParamType
from paramclient.protocol.events import Change

if TYPE_CHECKING:
    from paramclient.client.component import Component
    from paramclient.client.events import Rebooted, Uncontested
    from paramclient.errors import ParamClientError
    from paramclient.links.ports import SerialPort
    from paramclient.logs.imported_table import ImportedTable
    from paramclient.metadata import AddedMetadata, Metadata, ParamInfo
    from paramclient.model.paramset import ParamSet
    from paramclient.model.values import Param, WireValue
    from paramclient.protocol.fetch import FetchResult
    from paramclient.protocol.set_results import SetOutcome

__all__ = [
    "AddedMetadataDoc",
    "AddedMetadataListDoc",
    "ChangeLineDoc",
    "ContestedLineDoc",
    "EventLineDoc",
    "FetchOutputDoc",
    "FleetFetchDoc",
    "FleetReadDoc",
    "FleetWritesDoc",
    "ImportDoc",
    "ImportedDoc",
    "PortDoc",
    "PortsDoc",
    "RemovedMetadataDoc",
    "ResetOutputDoc",
    "ResetPlanDoc",
    "ResetValueDoc",
    "ResyncedLineDoc",
    "SavedDoc",
    "SavedFilesDoc",
    "SavedSetDoc",
    "WriteOutputDoc",
    "WritesOutputDoc",
    "SigningOutputDoc",
    "SilenceLineDoc",
    "VehicleReadDoc",
    "VehicleWritesDoc",
]


class FetchOutputDoc(Document):
    """A fetched table, and the details of the fetch.

    `missing` are indices that were not received, `cached` names whose values are cached and not confirmed.
    """

    system: int
    component: int
    autopilot: str
    uid: str | None
    count: int
    received: int
    source: str
    hash: str | None
    missing: list[int]
    cached: list[str]
    lost: int
    repeated: int
    round_trip_s: float | None
    elapsed_s: float
    bytes_received: int
    bytes_sent: int
    params: dict[str, ParamDoc]

    @classmethod
    def of(
        cls,
        component: Component,
        result: FetchResult,
        params: Iterable[Param],
        *,
        missing: list[int],
        cached: list[str],
        bytes_received: int,
        bytes_sent: int,
        described: Mapping[str, int | float] | None = None,
    ) -> FetchOutputDoc:
        """Return the document of a fetch of a component.

        Args:
            component: the component.
            result: the result of the fetch.
            params: the parameters to include.
            missing: indices that were not received.
            cached: names whose values are cached and not confirmed.
            bytes_received, bytes_sent: totals of the link.
            described: defaults in the metadata by name, or None; see `default_of`.
        """
        known = described or {}
        return cls(
            system=component.system,
            component=component.component,
            autopilot=component.autopilot,
            uid=component.identity.uid,
            count=result.count,
            received=result.count - len(missing),
            source=result.source,
            hash=hash_text(result.hash),
            missing=missing,
            cached=cached,
            lost=result.lost,
            repeated=result.repeated,
            round_trip_s=rounded(result.round_trip),
            elapsed_s=round(result.elapsed, 4),
            bytes_received=bytes_received,
            bytes_sent=bytes_sent,
            params={param.name: ParamDoc.of(param, described=known.get(param.name)) for param in params},
        )


class WriteOutputDoc(Document):
    """The outcome of one write; see `SetOutcome`.

    `reason` is the cause if the value was not set or is not on the disk, `error` the class of that error,
    `note` a remark on the outcome.
    """

    name: str
    requested: Scalar
    actual: Scalar | None
    status: str
    reason: Maybe[str] = None
    error: Maybe[str] = None
    note: Maybe[str] = None
    text: Maybe[str] = None
    reboot_required: Maybe[bool] = None

    @classmethod
    def of(cls, outcome: SetOutcome, kind: ParamType | int, info: ParamInfo | None) -> WriteOutputDoc:
        """Return the document of a write.

        Args:
            outcome: the outcome.
            kind: the vehicle's type of the parameter.
            info: the metadata of the parameter, or None.
        """
        actual, error, result = outcome.reported, outcome.error, outcome.result
        return cls(
            name=outcome.name,
            requested=value_json(outcome.requested, ParamType.REAL64),
            actual=None if actual is None else value_json(actual, kind),
            status=outcome.status,
            reason=None if error is None else str(error),
            error=None if error is None else type(error).__name__,
            note=None if result is None else result.note or None,
            text=None if info is None or actual is None else info.text(actual) or None,
            reboot_required=(info is not None and info.reboot_required) or None,
        )


class WritesOutputDoc(Document):
    """The outcomes of several writes to a vehicle, in their order."""

    vehicle: ReceiverDoc
    results: list[WriteOutputDoc]


class ResetOutputDoc(Document):
    """The outcomes of a reset to the firmware's defaults, and the names that were not written."""

    vehicle: ReceiverDoc
    results: list[WriteOutputDoc]
    unchanged: list[str]
    without_default: list[str]
    read_only: list[str]


class ResetValueDoc(Document):
    """A default that a reset would write; `source` is `vehicle` or `metadata`."""

    name: str
    value: Scalar
    default: Scalar
    source: DefaultSource

    @classmethod
    def of(cls, param: Param, default: WireValue, source: DefaultSource) -> ResetValueDoc:
        """Return the document of a parameter and its default."""
        return cls(
            name=param.name,
            value=value_json(param.settable, param.type_number),
            default=value_json(*typed(default, param.type_number)),
            source=source,
        )


class ResetPlanDoc(Document):
    """The values that a reset to the firmware's defaults would write; see `ResetChoice`."""

    vehicle: ReceiverDoc
    dry_run: bool = True
    values: list[ResetValueDoc]
    unchanged: list[str]
    without_default: list[str]
    read_only: list[str]


class FleetFetchDoc(Document):
    """The fetches of every vehicle on a link, and the errors of vehicles."""

    vehicles: list[FetchOutputDoc]
    errors: list[FailedVehicleDoc]


class VehicleReadDoc(Document):
    """Requested parameters of one of several vehicles; see `ReadOutputDoc`."""

    system: int
    component: int
    params: dict[str, ParamDoc]
    errors: Maybe[dict[str, str]] = None


class FleetReadDoc(Document):
    """Requested parameters of every vehicle on a link, and the errors of vehicles."""

    vehicles: list[VehicleReadDoc]
    errors: list[FailedVehicleDoc]

    @classmethod
    def of(
        cls,
        read: Iterable[tuple[Component, Iterable[Param], Mapping[str, ParamClientError], Metadata | None]],
        errors: list[FailedVehicleDoc],
    ) -> FleetReadDoc:
        """Return the document of vehicles, each with its parameters, the errors by name and its metadata."""
        vehicles = [
            VehicleReadDoc(
                system=component.system,
                component=component.component,
                params=(document := ReadOutputDoc.of(params, metadata, failed)).params,
                errors=document.errors,
            )
            for component, params, failed, metadata in read
        ]
        return cls(vehicles=vehicles, errors=errors)


class VehicleWritesDoc(Document):
    """The outcomes of the writes to one of several vehicles."""

    system: int
    component: int
    vehicle: ReceiverDoc
    results: list[WriteOutputDoc]


class FleetWritesDoc(Document):
    """The outcomes of writes to every vehicle on a link."""

    vehicles: list[VehicleWritesDoc]


class ChangeLineDoc(Document):
    """One line of `watch`: a changed value, or an added or removed parameter."""

    time: str
    name: str
    old: Scalar | None
    new: Scalar | None
    by: str
    kind: Literal["changed", "added", "removed"]

    @classmethod
    def of(cls, change: Change, at: float) -> ChangeLineDoc:
        """Return the document of a change that was received `at` this unix time in seconds."""
        old, new = (
            None if param is None else value_json(param.settable, param.type_number)
            for param in (change.old, change.new)
        )
        kind: Literal["changed", "added", "removed"] = "changed"
        if isinstance(change, Removed):
            kind = "removed"
        elif isinstance(change, Added):
            kind = "added"
        return cls(time=time_text(at), name=change.name, old=old, new=new, by=change.by, kind=kind)


class EventLineDoc(Document):
    """One line of `watch`: an event of a component."""

    time: str
    event: str
    system: int
    component: int

    @classmethod
    def of(
        cls, event: Lost | Found | Rebooted | Resynced | Contested | Uncontested, at: float
    ) -> EventLineDoc:
        """Return the document of an event `at` this unix time in seconds."""
        members: dict[str, Any] = {
            "time": time_text(at),
            "event": type(event).__name__.lower(),
            "system": event.component.system,
            "component": event.component.component,
        }
        if isinstance(event, Lost | Found):
            return SilenceLineDoc(**members, silence_s=round(event.silence, 4))
        if isinstance(event, Contested):
            return ContestedLineDoc(**members, contest=ContestDoc.of(event.contest))
        if isinstance(event, Resynced):
            return ResyncedLineDoc(**members, changed=list(event.changed), hash=hash_text(event.hash))
        return EventLineDoc(**members)


class SilenceLineDoc(EventLineDoc):
    """A component that was lost or found, and the time in seconds in which it was not heard."""

    silence_s: float


class ContestedLineDoc(EventLineDoc):
    """A component whose address several vehicles use."""

    contest: ContestDoc


class ResyncedLineDoc(EventLineDoc):
    """A table that matches the vehicle again, and the names of the values that had changed."""

    changed: list[str]
    hash: str | None


class SigningOutputDoc(Document):
    """Whether a vehicle signs its frames now, and the fingerprint of the key."""

    system: int
    component: int
    autopilot: str
    signs: bool
    fingerprint: str | None


class SavedSetDoc(Document):
    """A component whose parameters were written to a file."""

    system: int | None
    component: int | None
    params: int


class SavedDoc(Document):
    """A parameter file that was written; `format` is the file format."""

    path: str
    format: str
    components: list[SavedSetDoc]

    @classmethod
    def of(cls, path: str, file_format: str, sets: Iterable[ParamSet]) -> SavedDoc:
        """Return the document of a file: its path, its format, and the sets in it."""
        components = [
            SavedSetDoc(system=each.system, component=each.component, params=len(each)) for each in sets
        ]
        return cls(path=path, format=file_format, components=components)


class SavedFilesDoc(Document):
    """The files that were written for several vehicles."""

    files: list[SavedDoc]


class AddedMetadataDoc(Document):
    """A metadata file that was added; `firmware` is null for every version."""

    vehicle: str
    firmware: str | None
    descriptions: int

    @classmethod
    def of(cls, added: AddedMetadata, count: int) -> AddedMetadataDoc:
        """Return the document of an added file with this number of descriptions."""
        return cls(vehicle=added.kind, firmware=added.firmware, descriptions=count)


class AddedMetadataListDoc(Document):
    """The metadata files that were added."""

    metadata: list[AddedMetadataDoc]


class RemovedMetadataDoc(Document):
    """A metadata file that was removed."""

    vehicle: str
    firmware: str | None


class ImportedDoc(Document):
    """A table imported from a log; see `ImportedTable`."""

    file: str
    key: str
    system: int
    component: int
    autopilot: str | None
    params: int
    complete: bool
    hash: str | None
    notes: list[str]

    @classmethod
    def of(cls, file: str, table: ImportedTable) -> ImportedDoc:
        """Return the document of a table of the log `file`."""
        return cls(
            file=file,
            key=table.key,
            system=table.system,
            component=table.component,
            autopilot=None if table.autopilot is None else autopilot_name(table.autopilot),
            params=table.params,
            complete=table.complete,
            hash=hash_text(table.hash),
            notes=list(table.notes),
        )


class ImportDoc(Document):
    """All tables that were imported into the cache."""

    tables: list[ImportedDoc]


class PortDoc(Document):
    """A serial port; see `SerialPort`."""

    device: str
    by_id: str | None
    link: str
    autopilot: str | None
    vendor_id: str | None
    product_id: str | None
    manufacturer: str | None
    product: str | None
    serial_number: str | None
    interface: int | None

    @classmethod
    def of(cls, port: SerialPort) -> PortDoc:
        """Return the document of a `SerialPort`."""
        return cls(
            device=port.device,
            by_id=port.by_id,
            link=port.link,
            autopilot=port.autopilot,
            vendor_id=_hex(port.vendor_id),
            product_id=_hex(port.product_id),
            manufacturer=port.manufacturer,
            product=port.product,
            serial_number=port.serial_number,
            interface=port.interface,
        )


class PortsDoc(Document):
    """The serial ports of this computer."""

    ports: list[PortDoc]


def _hex(number: int | None) -> str | None:
    return None if number is None else f"{number:04x}"
