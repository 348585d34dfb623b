"""JSON of comparisons, of plans, and of results of apply and restore."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from paramclient.cli.json_output import Json, OriginJson, VehicleJson, WrittenJson, short_text
from paramclient.model.comparison import ChangedSide, DifferenceStatus
from paramclient.model.defaults import DefaultSource
from paramclient.model.identity import version_text
from paramclient.model.notation import Scalar, typed, value_json
from paramclient.model.values import ParamType, WireValue, type_name
from paramclient.provision.planning import ApplyStatus

if TYPE_CHECKING:
    from paramclient.metadata import Metadata
    from paramclient.model.comparison import Comparison, Difference
    from paramclient.provision import ApplyResult, ApplyRow, Plan, Stage
    from paramclient.provision.planning import Rows

__all__ = ["ApplyJson", "ApplyRowJson", "DiffJson", "DifferenceJson", "PlanJson", "StageJson"]


# Comparisons


@dataclass(frozen=True, slots=True, kw_only=True)
class DifferenceJson(Json):
    """The comparison of one name.

    `default_source` is the origin of a base that is the firmware's default. `renamed` is the left value under
    the name `right_name`.
    """

    is_: str
    types_differ: bool
    rounding: bool
    left: WrittenJson | None
    right: WrittenJson | None
    base: WrittenJson | None
    default_source: str | None = None
    changed_side: str | None
    units: str | None = None
    renamed: WrittenJson | None = None
    right_name: str | None = None

    @classmethod
    def of(
        cls,
        entry: Difference,
        left: Metadata | None,
        right: Metadata | None,
        base: Metadata | None,
        *,
        has_defaults: bool,
    ) -> DifferenceJson:
        """Return the comparison of a name; see `DiffJson.of`."""
        right_name = entry.name if entry.renamed is None else entry.renamed.name
        infos = [
            side.find(name) for side, name in ((left, entry.name), (right, right_name)) if side is not None
        ]
        source = None
        if has_defaults and entry.base is not None:
            is_given = any(
                each is not None and each.default is not None for each in (entry.left, entry.right)
            )
            source = DefaultSource.VEHICLE if is_given else DefaultSource.METADATA
        return cls(
            is_=entry.status.value,
            types_differ=entry.types_differ,
            rounding=entry.is_rounding,
            left=None if entry.left is None else WrittenJson.compared(entry.left, left),
            right=None if entry.right is None else WrittenJson.compared(entry.right, right),
            base=None if entry.base is None else WrittenJson.compared(entry.base, base),
            default_source=None if source is None else source.value,
            changed_side=None if entry.changed_side is None else entry.changed_side.value,
            units=short_text(next((info.units for info in infos if info is not None and info.units), None)),
            renamed=None if entry.renamed is None else WrittenJson.compared(entry.renamed, right),
            right_name=None if entry.renamed is None else right_name,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DiffJson(Json):
    """A comparison. `params` has the names that differ, or all names."""

    same: bool
    left: OriginJson
    right: OriginJson
    base: OriginJson | None
    counts: dict[str, int]
    changed_sides: dict[str, int] | None
    params: dict[str, DifferenceJson]

    @classmethod
    def of(
        cls,
        outcome: Comparison,
        left: Metadata | None = None,
        right: Metadata | None = None,
        base: Metadata | None = None,
        *,
        everything: bool = False,
        has_defaults: bool = False,
    ) -> DiffJson:
        """Return a comparison.

        Args:
            outcome: the comparison.
            left, right, base: the metadata of each side, or None.
            everything: include names that do not differ.
            has_defaults: whether the base are the firmware's defaults.
        """
        sides = None
        if outcome.base is not None:
            sides = {side.value: outcome.changed_sides[side] for side in ChangedSide}
        return cls(
            same=outcome.is_same,
            left=OriginJson.of(outcome.left),
            right=OriginJson.of(outcome.right),
            base=None if outcome.base is None else OriginJson.of(outcome.base),
            counts={status.value: outcome.counts[status] for status in DifferenceStatus},
            changed_sides=sides,
            params={
                entry.name: DifferenceJson.of(entry, left, right, base, has_defaults=has_defaults)
                for entry in outcome.entries
                if everything or entry.is_shown
            },
        )


# Plans and results of apply and restore


@dataclass(frozen=True, slots=True, kw_only=True)
class StepJson(Json):
    """One value to write."""

    name: str
    value: Scalar
    type: str
    before: Scalar
    needs_reboot: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class StageJson(Json):
    """Values that are written concurrently, before those of the next stage."""

    purpose: str
    reboot_first: bool
    steps: list[StepJson]

    @classmethod
    def of(cls, stage: Stage) -> StageJson:
        """Return a stage of a plan."""
        steps = []
        for row in stage.rows:
            kind = ParamType.REAL32 if row.type is None else row.type
            assert row.before is not None, "only parameters that the vehicle has are set"
            value, before = value_json(row.target.settable, kind), value_json(row.before, kind)
            name, number = row.target.name, type_name(kind)
            steps.append(StepJson.take(row, name=name, value=value, type=number, before=before))
        return cls.take(stage, steps=steps)


@dataclass(frozen=True, slots=True, kw_only=True)
class ApplyRowJson(Json):
    """What is planned for one parameter, or what became of it; `actual` is null in a plan."""

    status: str
    type: str | None
    before: Scalar | None
    wanted: Scalar
    actual: Scalar | None
    category: str
    reason: str
    nearest: list[str]
    vehicle_name: str | None = None

    @classmethod
    def of_all(cls, rows: Iterable[ApplyRow]) -> dict[str, ApplyRowJson]:
        """Return rows by name in the file."""
        return {row.name: cls.of(row) for row in rows}

    @classmethod
    def of(cls, row: ApplyRow) -> ApplyRowJson:
        """Return a row."""

        def value(given: WireValue | None) -> Scalar | None:
            return None if given is None else value_json(*typed(given, row.type))

        return cls(
            status=row.status.value,
            type=None if row.type is None else type_name(row.type),
            before=value(row.before),
            wanted=value_json(*typed(row.target.settable, row.type)),
            actual=value(row.actual),
            category=row.category,
            reason=row.reason,
            nearest=list(row.nearest),
            vehicle_name=None if row.renamed is None else row.renamed.name,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FirmwareJson(Json):
    """The firmware versions of a file and a vehicle that differ."""

    file: str
    vehicle: str


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanJson(Json):
    """A plan. `extra` is the number of the vehicle's other parameters, `unchecked` that of values to write
    without metadata."""

    system: int
    component: int
    dry_run: bool
    counts: dict[str, int]
    stages: list[StageJson]
    params: dict[str, ApplyRowJson]
    extra: int
    unchecked: int
    reboot_for: list[str]
    firmware: FirmwareJson | None = None

    @classmethod
    def of(cls, plan: Plan, *, system: int, component: int, full: bool = False) -> PlanJson:
        """Return the plan for the vehicle at this address, with unchanged parameters only if `full`."""
        firmware = None
        if plan.firmware_note:
            file, vehicle = (version_text(each.firmware) for each in plan.firmware)
            firmware = FirmwareJson(file=file, vehicle=vehicle)
        rows = [row for row in plan.rows.values() if full or row.status is not ApplyStatus.UNCHANGED]
        return cls(
            system=system,
            component=component,
            dry_run=True,
            counts=_counts(plan),
            stages=[StageJson.of(stage) for stage in plan.stages],
            params=ApplyRowJson.of_all(rows),
            extra=len(plan.extra),
            unchecked=len(plan.unchecked),
            reboot_for=list(plan.reboot_for),
            firmware=firmware,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class AddressJson(Json):
    """The MAVLink address of a vehicle."""

    system: int
    component: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ApplyJson(Json):
    """The result of apply or restore. The first address is that at the start, `now` the one at the end."""

    system: int
    component: int
    vehicle: VehicleJson | None = None
    now: AddressJson
    complete: bool
    counts: dict[str, int]
    params: dict[str, ApplyRowJson]
    extra: int
    unchecked: int
    reboots: int
    reboot_required: list[str]
    error: str | None
    elapsed_s: float

    @classmethod
    def of(cls, result: ApplyResult, vehicle: VehicleJson, *, full: bool = False) -> ApplyJson:
        """Return the result for a vehicle with its address at the start.

        Unchanged parameters, and left-out ones that do not differ, are included only if `full`.
        """
        return cls(
            system=vehicle.system,
            component=vehicle.component,
            vehicle=vehicle,
            now=AddressJson.take(result),
            complete=result.complete,
            counts=_counts(result),
            params=ApplyRowJson.of_all(result.rows.values() if full else result.shown_rows),
            extra=len(result.extra),
            unchecked=len(result.plan.unchecked),
            reboots=result.reboots,
            reboot_required=list(result.reboot_required),
            error=None if result.error is None else str(result.error),
            elapsed_s=round(result.elapsed, 3),
        )


def _counts(rows: Rows) -> dict[str, int]:
    return {status.value: count for status in ApplyStatus if (count := rows.counts.get(status, 0))}
