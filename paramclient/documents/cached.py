"""Documents of the cache: tables and vehicles, and results of adding, copying and removing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from paramclient.documents.document import Document, Maybe
from paramclient.documents.history import HistoryEntryDoc
from paramclient.documents.param import InfoDoc, ParamDoc
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import hash_text, time_or_none, time_text

if TYPE_CHECKING:
    from paramclient.cache import CachedComponent, CachedSummary, CachedVehicle, HistoryEntry
    from paramclient.metadata import Metadata, ParamInfo
    from paramclient.model.values import Param

__all__ = [
    "CachedListDoc",
    "CachedSummaryDoc",
    "CachedTableDoc",
    "CachedTablesDoc",
    "FoundDoc",
    "FoundParamDoc",
    "KnownValueDoc",
    "ParamInfoDoc",
    "PlaceDoc",
    "RemovedDoc",
    "VehicleDoc",
    "VehiclesDoc",
]


class CachedSummaryDoc(Document):
    """The table of one component without its parameters; see `CachedSummary`."""

    key: str
    system: int
    component: int
    autopilot: str
    uid: str | None
    size: int
    count: int | None
    complete: bool
    hash: str | None
    synced_at: str | None
    updated_at: str | None
    extended: Maybe[int] = None

    @classmethod
    def of(cls, summary: CachedSummary, extended: int | None = None) -> CachedSummaryDoc:
        """Return the document of a `CachedSummary`.

        Args:
            summary: the table.
            extended: the number of extended parameters of the component, or None.
        """
        return cls(
            key=summary.key,
            system=summary.system,
            component=summary.component,
            autopilot=autopilot_name(summary.autopilot),
            uid=summary.identity.uid,
            size=summary.size,
            count=summary.count,
            complete=summary.complete,
            hash=hash_text(summary.hash),
            synced_at=time_or_none(summary.synced_at),
            updated_at=time_or_none(summary.updated_at),
            extended=extended,
        )


class CachedListDoc(Document):
    """The tables of the cache at `path`."""

    path: str
    components: list[CachedSummaryDoc]


class CachedTableDoc(Document):
    """The cached table of one component."""

    system: int
    component: int
    autopilot: str
    uid: str | None
    hash: str | None
    synced_at: str | None
    params: dict[str, ParamDoc]

    @classmethod
    def of(
        cls,
        table: CachedComponent,
        params: Iterable[Param] | None = None,
        metadata: Metadata | None = None,
        *,
        whole: bool = False,
        kept: bool = False,
    ) -> CachedTableDoc:
        """Return the document of a cached table.

        Args:
            table: the table.
            params: the parameters of it to include; None for all.
            metadata: the metadata of the parameters, or None.
            whole: whether to include all metadata of each parameter.
            kept: whether to include trust and time of reception of each parameter.
        """
        shown = table.params.values() if params is None else params
        members = {}
        for param in shown:
            info = None if metadata is None else metadata.find(param.name)
            heard_at = table.heard_at.get(param.name)
            members[param.name] = (
                ParamDoc.kept(param, info, heard_at=heard_at, whole=whole)
                if kept
                else ParamDoc.of(param, info, whole=whole)
            )
        return cls(
            system=table.system,
            component=table.component,
            autopilot=autopilot_name(table.autopilot),
            uid=table.identity.uid,
            hash=hash_text(table.hash),
            synced_at=time_or_none(table.synced_at),
            params=members,
        )


class CachedTablesDoc(Document):
    """The tables of one vehicle or of all vehicles."""

    components: list[CachedTableDoc]


class VehicleDoc(Document):
    """A vehicle with cached tables; see `CachedVehicle`. Times are in unix seconds."""

    key: str
    system: int
    autopilot: str
    uid: str | None
    first_seen: float
    last_seen: float
    components: list[CachedSummaryDoc]

    @classmethod
    def of(cls, vehicle: CachedVehicle, tables: Iterable[CachedSummary]) -> VehicleDoc:
        """Return the document of a vehicle and of those of `tables` that are its own."""
        return cls(
            key=vehicle.key,
            system=vehicle.identity.system,
            autopilot=autopilot_name(vehicle.identity.autopilot),
            uid=vehicle.identity.uid,
            first_seen=vehicle.first_seen,
            last_seen=vehicle.last_seen,
            components=[CachedSummaryDoc.of(each) for each in tables if each.key == vehicle.key],
        )


class VehiclesDoc(Document):
    """All vehicles in the cache."""

    vehicles: list[VehicleDoc]


class PlaceDoc(Document):
    """The place of the cache."""

    path: str


class FoundParamDoc(Document):
    """A parameter that a search has found; `vehicles` are the keys of the vehicles that have it."""

    name: str
    description: str | None
    vehicles: list[str]

    @classmethod
    def of(cls, name: str, info: ParamInfo | None, tables: Iterable[CachedComponent]) -> FoundParamDoc:
        """Return the document of a parameter with the tables that have it."""
        description = None if info is None else info.short_description or None
        return cls(name=name, description=description, vehicles=[each.key for each in tables])


class FoundDoc(Document):
    """The parameters that a search has found, best match first."""

    results: list[FoundParamDoc]


class KnownValueDoc(Document):
    """The cached value of a parameter on one vehicle, the time of its reception, and its last changes."""

    key: str
    system: int
    component: int
    autopilot: str
    heard_at: str
    param: ParamDoc
    changes: list[HistoryEntryDoc]


class ParamInfoDoc(Document):
    """What is known of a parameter: its metadata, and its value on each vehicle."""

    name: str
    metadata: InfoDoc | None
    vehicles: list[KnownValueDoc]

    @classmethod
    def of(
        cls,
        name: str,
        info: ParamInfo | None,
        tables: Iterable[CachedComponent],
        changes: Mapping[tuple[str, int], Iterable[HistoryEntry]],
    ) -> ParamInfoDoc:
        """Return the document of a parameter.

        Args:
            name: param_id.
            info: its metadata, or None.
            tables: the tables that have it.
            changes: its last changes by key and component.
        """
        return cls(
            name=name,
            metadata=None if info is None else InfoDoc.of(info),
            vehicles=[
                KnownValueDoc(
                    key=each.key,
                    system=each.system,
                    component=each.component,
                    autopilot=autopilot_name(each.autopilot),
                    heard_at=time_text(each.heard_at[name]),
                    param=ParamDoc.kept(
                        each.params[name],
                        described=None if info is None else info.default,
                    ),
                    changes=[HistoryEntryDoc.of(line) for line in changes[each.key, each.component]],
                )
                for each in tables
            ],
        )


class RemovedDoc(Document):
    """The number of tables of a vehicle that were removed."""

    key: str
    removed: int
