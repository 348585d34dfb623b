"""Scripted set-up of vehicles: plan what a parameter file would change, apply it, verify it, undo it."""

from __future__ import annotations

from paramclient.provision.cautions import CATEGORIES
from paramclient.provision.fleet import apply_all, verify_all
from paramclient.provision.inspection import prepare, verify
from paramclient.provision.planning import (
    MISSING,
    WRONG,
    ParamInfo,
    Plan,
    PlanRow,
    PlanStatus,
    RowStanding,
    Stage,
    Step,
    overlay,
    plan,
)
from paramclient.provision.results import (
    ApplyProgress,
    ApplyResult,
    ApplyRow,
    ApplyStatus,
    FleetApplied,
    FleetVerified,
)
from paramclient.provision.set_up import apply, restore

__all__ = [
    "CATEGORIES",
    "MISSING",
    "WRONG",
    "ApplyProgress",
    "ApplyResult",
    "ApplyRow",
    "ApplyStatus",
    "FleetApplied",
    "FleetVerified",
    "ParamInfo",
    "Plan",
    "PlanRow",
    "PlanStatus",
    "RowStanding",
    "Stage",
    "Step",
    "apply",
    "apply_all",
    "overlay",
    "plan",
    "prepare",
    "restore",
    "verify",
    "verify_all",
]
