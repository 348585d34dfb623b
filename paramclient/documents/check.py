"""Documents of the diagnosis of a vehicle and its link; see `paramclient.diagnosis`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median
from typing import TYPE_CHECKING, Literal

from paramclient.documents.component import IdentityDoc
from paramclient.documents.document import Document
from paramclient.model.notation import hash_text, rounded

if TYPE_CHECKING:
    from paramclient.diagnosis import (
        FileService,
        Finding,
        HashService,
        LinkReport,
        ListService,
        ReadService,
        VehicleReport,
    )

__all__ = [
    "CheckDoc",
    "CheckedFilesDoc",
    "CheckedHashDoc",
    "CheckedLinkDoc",
    "CheckedListDoc",
    "CheckedReadsDoc",
    "FindingDoc",
    "RoundTripsDoc",
    "StationDoc",
    "VersionsDoc",
]


class VersionsDoc(Document):
    """The programs that made a report."""

    paramclient: str
    pymavlink: str
    python: str
    system: str


class FindingDoc(Document):
    """One finding of the diagnosis; `advice` is empty if there is nothing to do."""

    severity: Literal["note", "slow", "problem"]
    text: str
    advice: str

    @classmethod
    def of(cls, finding: Finding) -> FindingDoc:
        """Return the document of a `Finding`."""
        return cls(severity=finding.severity.value, text=finding.text, advice=finding.advice)


class RoundTripsDoc(Document):
    """Measured round-trip times in seconds, and their number."""

    count: int
    min_s: float
    median_s: float
    max_s: float


class StationDoc(Document):
    """Another ground station on the link."""

    system: int
    component: int
    has_our_address: bool


class CheckedLinkDoc(Document):
    """The state of the link; see `LinkReport`. Addresses are written `system/component`."""

    name: str
    seconds: float
    round_trip: RoundTripsDoc | None
    unanswered: int
    loss: float | None
    lost: int
    repeated: int
    damaged: int
    unusable_names: int
    unknown: int
    other_bytes: int
    bytes_received: int
    bytes_sent: int
    mavlink: int
    signed: int
    autopilots: list[str]
    stations: list[StationDoc]
    radio_free: int | None

    @classmethod
    def of(cls, link: LinkReport) -> CheckedLinkDoc:
        """Return the document of a `LinkReport`."""
        plain = (
            *("name", "unanswered", "lost", "repeated", "damaged", "unusable_names"),
            *("unknown", "other_bytes", "bytes_received", "bytes_sent", "mavlink", "signed", "radio_free"),
        )
        trips = link.round_trips
        return cls(
            **{name: getattr(link, name) for name in plain},
            seconds=round(link.seconds, 3),
            round_trip=RoundTripsDoc(
                count=len(trips),
                min_s=round(trips[0], 4),
                median_s=round(median(trips), 4),
                max_s=round(trips[-1], 4),
            )
            if trips
            else None,
            loss=rounded(link.loss),
            autopilots=[f"{system}/{component}" for system, component in link.autopilots],
            stations=[
                StationDoc(system=each.system, component=each.component, has_our_address=each.has_our_address)
                for each in link.stations
            ],
        )


class CheckedReadsDoc(Document):
    """Reads of single parameters; see `ReadService`."""

    single_s: float | None
    per_s: float | None
    in_flight: int
    answered: int
    requests: int

    @classmethod
    def of(cls, reads: ReadService) -> CheckedReadsDoc:
        """Return the document of a `ReadService`."""
        return cls(
            single_s=rounded(reads.single),
            per_s=rounded(reads.rate),
            in_flight=reads.in_flight,
            answered=reads.answered,
            requests=reads.requests,
        )


class CheckedListDoc(Document):
    """The list download; see `ListService`."""

    count: int | None
    received: int
    elapsed_s: float
    first_s: float | None
    per_s: float | None
    longest_pause_s: float
    lost: int
    missing: int
    is_cut_short: bool
    error: str | None

    @classmethod
    def of(cls, listed: ListService) -> CheckedListDoc:
        """Return the document of a `ListService`."""
        return cls(
            count=listed.count,
            received=listed.received,
            elapsed_s=round(listed.elapsed, 4),
            first_s=rounded(listed.first),
            per_s=rounded(listed.rate),
            longest_pause_s=round(listed.longest_pause, 2),
            lost=listed.lost,
            missing=listed.missing,
            is_cut_short=listed.is_cut_short,
            error=listed.error,
        )


class CheckedFilesDoc(Document):
    """MAVFTP and the packed parameter file; see `FileService`."""

    is_announced: bool | None
    is_serving: bool
    entries: list[str] | None
    size: int | None
    elapsed_s: float | None
    parameters: int | None
    defaults: int | None
    error: str | None

    @classmethod
    def of(cls, files: FileService) -> CheckedFilesDoc:
        """Return the document of a `FileService`."""
        return cls(
            is_announced=files.is_announced,
            is_serving=files.is_serving,
            entries=None if files.entries is None else list(files.entries),
            size=files.size,
            elapsed_s=rounded(files.elapsed),
            parameters=files.parameters,
            defaults=files.defaults,
            error=files.error,
        )


class CheckedHashDoc(Document):
    """The vehicle's hash; see `HashService`."""

    before: str | None
    after: str | None
    seconds: float
    confirms_list: bool | None
    error: str | None

    @classmethod
    def of(cls, found: HashService) -> CheckedHashDoc:
        """Return the document of a `HashService`."""
        return cls(
            before=hash_text(found.before),
            after=hash_text(found.after),
            seconds=round(found.seconds, 3),
            confirms_list=found.confirms_list,
            error=found.error,
        )


class CheckDoc(Document):
    """The diagnosis of one vehicle; see `VehicleReport`. A part that was not measured is null."""

    system: int
    component: int
    autopilot: str
    vehicle_type: str | None
    identity: IdentityDoc
    has_version: bool
    encoding: str
    encoding_reason: str
    is_armed: bool | None
    descriptions: str | None
    link: CheckedLinkDoc
    reads: CheckedReadsDoc | None
    list: CheckedListDoc | None
    files: CheckedFilesDoc | None
    hash: CheckedHashDoc | None
    elapsed_s: float
    findings: Sequence[FindingDoc]
    versions: VersionsDoc

    @classmethod
    def of(cls, report: VehicleReport, findings: Iterable[Finding], versions: VersionsDoc) -> CheckDoc:
        """Return the document of a report, its findings, and the versions of the programs."""
        plain = ("system", "component", "autopilot", "vehicle_type", "has_version", "encoding_reason")
        return cls(
            **{name: getattr(report, name) for name in (*plain, "is_armed", "descriptions")},
            identity=IdentityDoc.of(report.identity),
            encoding=report.encoding,
            link=CheckedLinkDoc.of(report.link),
            reads=None if report.reads is None else CheckedReadsDoc.of(report.reads),
            list=None if report.list is None else CheckedListDoc.of(report.list),
            files=None if report.files is None else CheckedFilesDoc.of(report.files),
            hash=None if report.hash is None else CheckedHashDoc.of(report.hash),
            elapsed_s=round(report.elapsed, 3),
            findings=[FindingDoc.of(each) for each in findings],
            versions=versions,
        )
