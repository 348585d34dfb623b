"""Set-ups: what is to be done, what became of it, and how a vehicle compares."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from pydantic import Field

from paramclient.documents.document import Document, Scalar
from paramclient.model.notation import typed, value_json
from paramclient.model.values import Value, type_name
from paramclient.provision.planning import PlanStatus, RowStanding
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
        """All of it."""
        return cls(
            name=step.name,
            value=value_json(step.value, step.type),
            type=type_name(step.type),
            before=value_json(step.before, step.type),
            needs_reboot=step.needs_reboot,
        )


class StageDoc(Document):
    """Values that are written side by side, before those of the next stage; see `Stage`."""

    purpose: str
    reboot_first: bool
    steps: list[StepDoc]

    @classmethod
    def of(cls, stage: Stage) -> StageDoc:
        """What a user has of it."""
        return cls(
            purpose=stage.purpose,
            reboot_first=stage.reboot_first,
            steps=[StepDoc.of(step) for step in stage.steps],
        )


class PlanRowDoc(Document):
    """What is meant to be done with one parameter; see `PlanRow`."""

    status: PlanStatus
    type: str | None
    before: Scalar | None
    wanted: Scalar
    category: str
    reason: str
    nearest: list[str]

    @classmethod
    def of(cls, row: PlanRow) -> PlanRowDoc:
        """All of it."""
        return cls(status=row.status, **_members(row))


class PlanDoc(Document):
    """What a set-up means to do; see `Plan`. `extra` is how many parameters the vehicle has besides."""

    system: int
    component: int
    dry_run: Literal[True]
    counts: dict[PlanStatus, int]
    stages: list[StageDoc]
    params: dict[str, PlanRowDoc]
    extra: int
    reboot_for: list[str]

    @classmethod
    def of(cls, plan: Plan, *, system: int, component: int, full: bool = False) -> PlanDoc:
        """A plan for a vehicle; what it has already only where everything is asked for."""
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
        )


class VerifiedRowDoc(Document):
    """How one parameter compares with what is wanted; see `PlanRow.standing`."""

    standing: RowStanding = Field(validation_alias="is", serialization_alias="is")
    type: str | None
    before: Scalar | None
    wanted: Scalar
    category: str
    reason: str
    nearest: list[str]

    @classmethod
    def of(cls, row: PlanRow) -> VerifiedRowDoc:
        """All of it."""
        return cls(standing=row.standing, **_members(row))


class VerifiedDoc(Document):
    """How one vehicle compares with what is wanted."""

    system: int
    component: int
    met: bool
    counts: dict[RowStanding, int]
    params: dict[str, VerifiedRowDoc]

    @classmethod
    def of(cls, plan: Plan, *, system: int, component: int, full: bool = False) -> VerifiedDoc:
        """What a plan says of it; what is as it should be only where everything is asked for."""
        rows = list(plan.rows.values())
        return cls(
            system=system,
            component=component,
            met=plan.is_met,
            counts={standing: sum(row.standing is standing for row in rows) for standing in RowStanding},
            params={row.name: VerifiedRowDoc.of(row) for row in rows if full or not row.is_met},
        )


class AppliedRowDoc(Document):
    """What became of one parameter; see `ApplyRow`."""

    status: ApplyStatus
    type: str | None
    before: Scalar | None
    wanted: Scalar
    actual: Scalar | None
    category: str
    reason: str
    nearest: list[str]

    @classmethod
    def of(cls, row: ApplyRow) -> AppliedRowDoc:
        """All of it."""
        return cls(status=row.status, actual=_value(row.actual, row), **_members(row))


class AddressDoc(Document):
    """Where a vehicle is heard."""

    system: int
    component: int


class ApplyResultDoc(Document):
    """What came of a set-up; see `ApplyResult`.

    `system` and `component` are the vehicle's address when it began, `now` when it ended. `extra` is how many
    parameters the vehicle has besides.
    """

    system: int
    component: int
    now: AddressDoc
    complete: bool
    counts: dict[ApplyStatus, int]
    params: dict[str, AppliedRowDoc]
    extra: int
    reboots: int
    reboot_required: list[str]
    error: str | None
    elapsed_s: float

    @classmethod
    def of(cls, result: ApplyResult, *, system: int, component: int, full: bool = False) -> ApplyResultDoc:
        """The result for a vehicle that had this address; what it had already only on demand."""
        return cls(
            system=system,
            component=component,
            now=AddressDoc(system=result.system, component=result.component),
            complete=result.complete,
            counts={status: result.counts.get(status, 0) for status in ApplyStatus},
            params={
                row.name: AppliedRowDoc.of(row) for row in (result.rows.values() if full else result.news)
            },
            extra=len(result.extra),
            reboots=result.reboots,
            reboot_required=list(result.reboot_required),
            error=None if result.error is None else str(result.error),
            elapsed_s=round(result.elapsed, 3),
        )


class InterruptedDoc(Document):
    """What had become of each value when somebody ended a set-up."""

    system: int
    component: int
    complete: Literal[False]
    params: dict[str, AppliedRowDoc]
    error: Literal["interrupted"]

    @classmethod
    def of(cls, rows: Iterable[ApplyRow], *, system: int, component: int) -> InterruptedDoc:
        """The rows so far, of a vehicle that had this address."""
        return cls(
            system=system,
            component=component,
            complete=False,
            params={row.name: AppliedRowDoc.of(row) for row in rows},
            error="interrupted",
        )


class FailedVehicleDoc(Document):
    """A vehicle on which nothing was done, and why."""

    system: int
    component: int
    error: str


SetUpDoc: TypeAlias = ApplyResultDoc | PlanDoc | VerifiedDoc | InterruptedDoc
"""What a set-up tells of one vehicle."""


class FleetSetupDoc(Document):
    """What came of a command for several vehicles."""

    vehicles: list[SetUpDoc]
    errors: list[FailedVehicleDoc]

    @classmethod
    def of(
        cls, vehicles: Iterable[SetUpDoc], errors: Mapping[tuple[int, int], ParamClientError]
    ) -> FleetSetupDoc:
        """What is told of each, and the errors by address."""
        failed = [
            FailedVehicleDoc(system=system, component=component, error=str(error))
            for (system, component), error in errors.items()
        ]
        return cls(vehicles=list(vehicles), errors=failed)


class ApplyProgressDoc(Document):
    """How far a set-up is; see `ApplyProgress`. `row` is what has just become of the parameter `name`."""

    phase: str
    done: int
    total: int
    name: str | None
    row: AppliedRowDoc | None

    @classmethod
    def of(cls, progress: ApplyProgress) -> ApplyProgressDoc:
        """All of it."""
        row = progress.row
        return cls(
            phase=progress.phase,
            done=progress.done,
            total=progress.total,
            name=None if row is None else row.name,
            row=None if row is None else AppliedRowDoc.of(row),
        )


def _members(row: ApplyRow | PlanRow) -> dict[str, Any]:
    """What every row tells of its parameter."""
    return {
        "type": None if row.type is None else type_name(row.type),
        "before": _value(row.before, row),
        "wanted": value_json(*typed(row.wanted.value, row.type)),
        "category": row.category,
        "reason": row.reason,
        "nearest": list(row.nearest),
    }


def _value(value: Value | None, row: ApplyRow | PlanRow) -> Scalar | None:
    return None if value is None else value_json(*typed(value, row.type))
