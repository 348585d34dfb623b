"""What the command tells of its own doing: what it fetched, set, wrote and read, and what it saw happen."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

from paramclient.client.events import Contested, Found, Lost, Resynced
from paramclient.documents.component import ContestDoc
from paramclient.documents.document import Document, Maybe, Scalar
from paramclient.documents.param import ParamDoc
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import hash_text, rounded, time_text, value_json
from paramclient.model.values import ParamType

if TYPE_CHECKING:
    from paramclient.client.component import Component
    from paramclient.client.events import Rebooted, Uncontested
    from paramclient.links.ports import SerialPort
    from paramclient.logs.telemetry import ImportedTable
    from paramclient.metadata import ParamInfo
    from paramclient.model.paramset import ParamSet
    from paramclient.model.values import Param, Value
    from paramclient.protocol.params.change import Change
    from paramclient.protocol.params.fetch_result import FetchResult
    from paramclient.protocol.params.sampling import Sample

__all__ = [
    "ChangeLineDoc",
    "ContestedLineDoc",
    "EventLineDoc",
    "FetchedDoc",
    "ImportDoc",
    "ImportedDoc",
    "PortDoc",
    "PortsDoc",
    "ResyncedLineDoc",
    "SavedDoc",
    "SavedSetDoc",
    "SetDoneDoc",
    "SetsDoneDoc",
    "SignsDoc",
    "SilenceLineDoc",
    "TrustedSampleDoc",
]

SUPPOSED: Final = (1, 10, 100)
"""Parameters that may have changed: of these numbers it is said how probably a sample shows it."""


class TrustedSampleDoc(Document):
    """A sample that agreed, and the chance that it would not have if so many others had changed."""

    size: int
    count: int
    confidence: dict[str, float]

    @classmethod
    def of(cls, sample: Sample) -> TrustedSampleDoc:
        """What it is worth."""
        chances = {str(each): round(sample.confidence(each), 4) for each in SUPPOSED}
        return cls(size=sample.size, count=sample.count, confidence=chances)


class FetchedDoc(Document):
    """A whole table, and how it came.

    `missing` are indices that did not come, `cached` names whose values nobody has confirmed.
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
    sample: TrustedSampleDoc | None
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
    ) -> FetchedDoc:
        """What a fetch of a component brought."""
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
            sample=None if result.sample is None else TrustedSampleDoc.of(result.sample),
            lost=result.lost,
            repeated=result.repeated,
            round_trip_s=rounded(result.round_trip),
            elapsed_s=round(result.elapsed, 4),
            bytes_received=bytes_received,
            bytes_sent=bytes_sent,
            params={param.name: ParamDoc.of(param) for param in params},
        )


class SetDoneDoc(Document):
    """What became of one value that was set; `reason` says why it was not, `note` what there is to know."""

    name: str
    requested: Scalar
    actual: Scalar | None
    status: str
    reason: Maybe[str] = None
    note: Maybe[str] = None
    text: Maybe[str] = None
    reboot_required: Maybe[bool] = None

    @classmethod
    def of(
        cls,
        name: str,
        kind: ParamType | int,
        requested: Value,
        actual: Value | None,
        *,
        status: str,
        reason: str = "",
        note: str = "",
        info: ParamInfo | None = None,
    ) -> SetDoneDoc:
        """A value of this type, and what is known of the parameter."""
        return cls(
            name=name,
            requested=value_json(requested, ParamType.REAL64),
            actual=None if actual is None else value_json(actual, kind),
            status=status,
            reason=reason or None,
            note=note or None,
            text=None if info is None or actual is None else info.text(actual) or None,
            reboot_required=(info is not None and info.reboot_required) or None,
        )


class SetsDoneDoc(Document):
    """What became of each, in the order in which they were set."""

    results: list[SetDoneDoc]


class ChangeLineDoc(Document):
    """A value that has changed, as it happened."""

    time: str
    name: str
    old: Scalar | None
    new: Scalar | None
    by: str

    @classmethod
    def of(cls, change: Change, at: float) -> ChangeLineDoc:
        """A change that was heard at this unix time."""
        old, new = (
            None if param is None else value_json(param.value, param.type)
            for param in (change.old, change.new)
        )
        return cls(time=time_text(at), name=change.name, old=old, new=new, by=change.by)


class EventLineDoc(Document):
    """What has become of a component, as it happened."""

    time: str
    event: str
    system: int
    component: int

    @classmethod
    def of(
        cls, event: Lost | Found | Rebooted | Resynced | Contested | Uncontested, at: float
    ) -> EventLineDoc:
        """An event of this unix time."""
        told: dict[str, Any] = {
            "time": time_text(at),
            "event": type(event).__name__.lower(),
            "system": event.component.system,
            "component": event.component.component,
        }
        if isinstance(event, Lost | Found):
            return SilenceLineDoc(**told, silence_s=round(event.silence, 4))
        if isinstance(event, Contested):
            return ContestedLineDoc(**told, contest=ContestDoc.of(event.contest))
        if isinstance(event, Resynced):
            return ResyncedLineDoc(**told, changed=list(event.changed), hash=hash_text(event.hash))
        return EventLineDoc(**told)


class SilenceLineDoc(EventLineDoc):
    """A component that was lost or found, and for how long it was not heard."""

    silence_s: float


class ContestedLineDoc(EventLineDoc):
    """A component whose address several vehicles have."""

    contest: ContestDoc


class ResyncedLineDoc(EventLineDoc):
    """A table that agrees with the vehicle's again, and which of its values had moved."""

    changed: list[str]
    hash: str | None


class SignsDoc(Document):
    """Whether a vehicle signs now, and with which key."""

    system: int
    component: int
    autopilot: str
    signs: bool
    fingerprint: str | None


class SavedSetDoc(Document):
    """A component whose parameters were written."""

    system: int | None
    component: int | None
    params: int


class SavedDoc(Document):
    """A file that was written."""

    path: str
    form: str
    components: list[SavedSetDoc]

    @classmethod
    def of(cls, path: str, form: str, sets: Iterable[ParamSet]) -> SavedDoc:
        """Where, in which form, and what."""
        held = [SavedSetDoc(system=each.system, component=each.component, params=len(each)) for each in sets]
        return cls(path=path, form=form, components=held)


class ImportedDoc(Document):
    """A table that a telemetry log held; see `ImportedTable`."""

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
        """A table of a log of this name."""
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
    """All tables that were brought into the cache."""

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
        """All of it."""
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
