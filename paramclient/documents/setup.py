"""Documents of set-ups: plans, results of `apply` and `restore`, comparisons, progress."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from pydantic import Field

from paramclient.documents.document import Document, Maybe, Scalar
from paramclient.documents.problem import Problem
from paramclient.documents.receiver import ReceiverDoc
from paramclient.model.identity import version_text
from paramclient.model.notation import typed, value_json
from paramclient.model.values import WireValue, type_name
from paramclient.provision.planning import PlanStatus, RowComparison
from paramclient.provision.results import ApplyStatus

if TYPE_CHECKING:
    from paramclient.errors import ParamClientError
    from paramclient.provision.planning import Plan, PlanRow, Stage, Step
    from paramclient.provision.results import ApplyProgress, ApplyResult, ApplyRow

__all__ = [
    "AddressDoc",
    "AppliedRowDoc",
    "ApplyProgressDoc",
    "ApplyResultDoc",
    "FailedVehicleDoc",
    "FirmwareDoc",
    "FleetSetupDoc",
    "InterruptedDoc",
    "PlanDoc",
    "PlanRowDoc",
    "StageDoc",
    "StepDoc",
    "SetUpDoc",
    "VerifiedDoc",
    "VerifiedRowDoc",
]


class StepDoc(Document):
    """One value to write; see `Step`."""

    name: str
    value: Scalar
    type: str
    before: Scalar
    needs_reboot: bool

    @classmethod
    def of(cls, step: Step) -> StepDoc:
        """Return the document of a `Step`."""
        return cls(
            name=step.name,
            value=value_json(step.value, step.type),
            type=type_name(step.type),
            before=value_json(step.before, step.type),
            needs_reboot=step.needs_reboot,
        )


class StageDoc(Document):
    """Values that are written concurrently, before those of the next stage; see `Stage`."""

    purpose: str
    reboot_first: bool
    steps: list[StepDoc]

    @classmethod
    def of(cls, stage: Stage) -> StageDoc:
        """Return the document of a `Stage`."""
        return cls(
            purpose=stage.purpose,
            reboot_first=stage.reboot_first,
            steps=[StepDoc.of(step) for step in stage.steps],
        )


class FirmwareDoc(Document):
    """The firmware versions of the file and the vehicle; see `Plan.firmware_note`."""

    file: str
    vehicle: str

    @classmethod
    def of(cls, plan: Plan) -> FirmwareDoc | None:
        """Return the document of the versions of a plan; None unless they differ."""
        before, own = plan.wanted.identity, plan.identity
        if before is None or own is None or not plan.firmware_note:
            return None
        return cls(file=version_text(before.firmware), vehicle=version_text(own.firmware))


class PlanRowDoc(Document):
    """The planned action for one parameter; see `PlanRow`."""

    status: PlanStatus
    type: str | None
    before: Scalar | None
    wanted: Scalar
    category: str
    reason: str
    nearest: list[str]
    vehicle_name: Maybe[str] = None

    @classmethod
    def of(cls, row: PlanRow) -> PlanRowDoc:
        """Return the document of a `PlanRow`."""
        return cls(status=row.status, **_members(row))


class PlanDoc(Document):
    """The plan of a set-up; see `Plan`.

    `extra` is the number of the vehicle's other parameters. The names of `params` are those of the file, and
    the names of `stages` those of the vehicle.
    """

    system: int
    component: int
    dry_run: Literal[True]
    counts: dict[PlanStatus, int]
    stages: list[StageDoc]
    params: dict[str, PlanRowDoc]
    extra: int
    reboot_for: list[str]
    firmware: Maybe[FirmwareDoc] = None

    @classmethod
    def of(cls, plan: Plan, *, system: int, component: int, full: bool = False) -> PlanDoc:
        """Return the document of a plan for the vehicle `system`/`component`.

        Unchanged parameters are included only if `full`.
        """
        return cls(
            system=system,
            component=component,
            dry_run=True,
            counts={status: plan.counts.get(status, 0) for status in PlanStatus},
            stages=[StageDoc.of(stage) for stage in plan.stages],
            params={
                row.name: PlanRowDoc.of(row)
                for row in plan.rows.values()
                if full or row.status is not PlanStatus.UNCHANGED
            },
            extra=len(plan.extra),
            reboot_for=list(plan.reboot_for),
            firmware=FirmwareDoc.of(plan),
        )


class VerifiedRowDoc(Document):
    """The comparison of one parameter with the wanted one; see `PlanRow.comparison`."""

    comparison: RowComparison = Field(validation_alias="is", serialization_alias="is")
    type: str | None
    before: Scalar | None
    wanted: Scalar
    category: str
    reason: str
    nearest: list[str]
    vehicle_name: Maybe[str] = None

    @classmethod
    def of(cls, row: PlanRow) -> VerifiedRowDoc:
        """Return the document of a `PlanRow`."""
        return cls(comparison=row.comparison, **_members(row))


class VerifiedDoc(Document):
    """The comparison of one vehicle with the wanted parameters."""

    system: int
    component: int
    met: bool
    counts: dict[RowComparison, int]
    params: dict[str, VerifiedRowDoc]
    firmware: Maybe[FirmwareDoc] = None

    @classmethod
    def of(cls, plan: Plan, *, system: int, component: int, full: bool = False) -> VerifiedDoc:
        """Return the document of the comparison in a plan.

        Parameters that have the wanted value, or are left out, are included only if `full`.
        """
        rows = list(plan.rows.values())
        return cls(
            system=system,
            component=component,
            met=plan.is_met,
            counts={
                comparison: sum(row.comparison is comparison for row in rows) for comparison in RowComparison
            },
            params={row.name: VerifiedRowDoc.of(row) for row in rows if full or not row.is_met},
            firmware=FirmwareDoc.of(plan),
        )


class AppliedRowDoc(Document):
    """The outcome for one parameter; see `ApplyRow`."""

    status: ApplyStatus
    type: str | None
    before: Scalar | None
    wanted: Scalar
    actual: Scalar | None
    category: str
    reason: str
    nearest: list[str]
    vehicle_name: Maybe[str] = None

    @classmethod
    def of(cls, row: ApplyRow) -> AppliedRowDoc:
        """Return the document of an `ApplyRow`."""
        return cls(status=row.status, actual=_value(row.actual, row), **_members(row))


class AddressDoc(Document):
    """The MAVLink address of a vehicle."""

    system: int
    component: int


class ApplyResultDoc(Document):
    """The result of a set-up; see `ApplyResult`.

    `system` and `component` are the vehicle's address at the start, `now` is its address at the end. `extra`
    is the number of the vehicle's other parameters. `vehicle` has its kind and firmware. `problem` is the
    error of a service's set-up that ended early.
    """

    system: int
    component: int
    vehicle: Maybe[ReceiverDoc] = None
    now: AddressDoc
    complete: bool
    counts: dict[ApplyStatus, int]
    params: dict[str, AppliedRowDoc]
    extra: int
    reboots: int
    reboot_required: list[str]
    error: str | None
    elapsed_s: float
    problem: Maybe[Problem] = None

    @classmethod
    def of(
        cls,
        result: ApplyResult,
        *,
        system: int,
        component: int,
        full: bool = False,
        vehicle: ReceiverDoc | None = None,
        problem: Problem | None = None,
    ) -> ApplyResultDoc:
        """Return the document of the result for a vehicle that had this address at the start.

        Unchanged parameters, and left-out ones that do not differ, are included only if `full`.
        """
        return cls(
            system=system,
            component=component,
            vehicle=vehicle,
            now=AddressDoc(system=result.system, component=result.component),
            complete=result.complete,
            counts={status: result.counts.get(status, 0) for status in ApplyStatus},
            params={
                row.name: AppliedRowDoc.of(row)
                for row in (result.rows.values() if full else result.shown_rows)
            },
            extra=len(result.extra),
            reboots=result.reboots,
            reboot_required=list(result.reboot_required),
            error=None if result.error is None else str(result.error),
            elapsed_s=round(result.elapsed, 3),
            problem=problem,
        )


class InterruptedDoc(Document):
    """The outcome for each value up to the interruption of a set-up."""

    system: int
    component: int
    complete: Literal[False]
    params: dict[str, AppliedRowDoc]
    error: Literal["interrupted"]

    @classmethod
    def of(cls, rows: Iterable[ApplyRow], *, system: int, component: int) -> InterruptedDoc:
        """Return the document of the rows so far, for a vehicle that had this address at the start."""
        return cls(
            system=system,
            component=component,
            complete=False,
            params={row.name: AppliedRowDoc.of(row) for row in rows},
            error="interrupted",
        )


class FailedVehicleDoc(Document):
    """A vehicle to which nothing was written, and the error."""

    system: int
    component: int
    error: str


SetUpDoc: TypeAlias = ApplyResultDoc | PlanDoc | VerifiedDoc | InterruptedDoc
"""The document of a set-up of one vehicle."""


class FleetSetupDoc(Document):
    """The result of a set-up or comparison of several vehicles."""

    vehicles: list[SetUpDoc]
    errors: list[FailedVehicleDoc]

    @classmethod
    def of(
        cls, vehicles: Iterable[SetUpDoc], errors: Mapping[tuple[int, int], ParamClientError]
    ) -> FleetSetupDoc:
        """Return the document of the documents of the vehicles, and the errors by address."""
        failed = [
            FailedVehicleDoc(system=system, component=component, error=str(error))
            for (system, component), error in errors.items()
        ]
        return cls(vehicles=list(vehicles), errors=failed)


class ApplyProgressDoc(Document):
    """The progress of a set-up; see `ApplyProgress`. `row` is the latest outcome, for `name`."""

    phase: str
    done: int
    total: int
    name: str | None
    row: AppliedRowDoc | None

    @classmethod
    def of(cls, progress: ApplyProgress) -> ApplyProgressDoc:
        """Return the document of an `ApplyProgress`."""
        row = progress.row
        return cls(
            phase=progress.phase,
            done=progress.done,
            total=progress.total,
            name=None if row is None else row.name,
            row=None if row is None else AppliedRowDoc.of(row),
        )


def _members(row: ApplyRow | PlanRow) -> dict[str, Any]:
    """Return the members that the documents of all rows share."""
    return {
        "type": None if row.type is None else type_name(row.type),
        "before": _value(row.before, row),
        "wanted": value_json(*typed(row.target.settable, row.type)),
        "category": row.category,
        "reason": row.reason,
        "nearest": list(row.nearest),
        "vehicle_name": None if row.renamed is None else row.renamed.name,
    }


def _value(value: WireValue | None, row: ApplyRow | PlanRow) -> Scalar | None:
    return None if value is None else value_json(*typed(value, row.type))
