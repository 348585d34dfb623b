"""Scripted set-up of vehicles: plan what a parameter file would change, apply it, verify it, undo it."""

from __future__ import annotations

from paramclient.provision.cautions import CATEGORIES
from paramclient.provision.plan import (
    MISSING,
    WRONG,
    ParamInfo,
    Plan,
    PlanRow,
    PlanStatus,
    Stage,
    Step,
    overlay,
    plan,
)

__all__ = [
    "CATEGORIES",
    "MISSING",
    "WRONG",
    "ParamInfo",
    "Plan",
    "PlanRow",
    "PlanStatus",
    "Stage",
    "Step",
    "overlay",
    "plan",
]
