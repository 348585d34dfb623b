"""Documents of the comparison of many vehicles."""

from __future__ import annotations

from typing import TYPE_CHECKING

from paramclient.documents.document import Document, Scalar
from paramclient.model.notation import bits_text, time_or_none, value_json
from paramclient.model.values import ParamType, type_name

if TYPE_CHECKING:
    from paramclient.cache import FleetDiff, FleetValue, Holder, NameSpread

__all__ = ["FleetDiffDoc", "FleetValueDoc", "HolderDoc", "NameSpreadDoc"]


class HolderDoc(Document):
    """A vehicle with a given value; see `Holder`."""

    key: str
    system: int
    since: str | None
    changed: bool

    @classmethod
    def of(cls, holder: Holder) -> HolderDoc:
        """Return the document of a `Holder`."""
        return cls(
            key=holder.vehicle.key,
            system=holder.vehicle.system,
            since=time_or_none(holder.since),
            changed=holder.changed,
        )


class FleetValueDoc(Document):
    """A value, and the vehicles that have it; see `FleetValue`."""

    value: Scalar
    type: str
    bits: str
    agrees: bool
    vehicles: list[HolderDoc]

    @classmethod
    def of(cls, value: FleetValue) -> FleetValueDoc:
        """Return the document of a `FleetValue`."""
        return cls(
            value=value_json(value.param.settable, value.param.type_number),
            type=type_name(value.param.type_number),
            bits=bits_text(value.param),
            agrees=value.agrees,
            vehicles=[HolderDoc.of(holder) for holder in value.holders],
        )


class NameSpreadDoc(Document):
    """One parameter across the vehicles; see `NameSpread`."""

    name: str
    different: bool
    wanted: Scalar | None
    values: list[FleetValueDoc]
    lacking: list[HolderDoc]
    unknown: list[HolderDoc]

    @classmethod
    def of(cls, each: NameSpread) -> NameSpreadDoc:
        """Return the document of a `NameSpread`."""
        wanted = each.wanted
        return cls(
            name=each.name,
            different=each.differs,
            wanted=None
            if wanted is None
            else value_json(wanted.settable, wanted.type_number or ParamType.REAL32),
            values=[FleetValueDoc.of(value) for value in each.values],
            lacking=[HolderDoc.of(holder) for holder in each.lacking],
            unknown=[HolderDoc.of(holder) for holder in each.unknown],
        )


class FleetDiffDoc(Document):
    """The comparison of vehicles with each other, or with wanted values; see `FleetDiff`."""

    component: int
    vehicles: int
    different: bool
    names: list[NameSpreadDoc]

    @classmethod
    def of(cls, found: FleetDiff) -> FleetDiffDoc:
        """Return the document of a `FleetDiff`, with the number of vehicles."""
        return cls(
            component=found.component,
            vehicles=len(found.vehicles),
            different=found.differs,
            names=[NameSpreadDoc.of(each) for each in found.names],
        )
