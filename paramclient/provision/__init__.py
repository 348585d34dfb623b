"""Setting up vehicles from parameter files: plan, apply, verify and restore, for one vehicle or several.

A component with extended parameters, `component.ext`, is set up by the same calls.

- `planning`: the values to write, their order, and the reason for each parameter that is not written.
- `inspection`: read what a vehicle has; `prepare` and `verify`.
- `apply_restore`: `apply` and `restore`; `execution` runs them, and stores the
  snapshot before the first write; `results` holds their results.
- `fleet`: `apply_all`, `verify_all` and `restore_all` for several vehicles.
- `vehicle_params`: parameters of a vehicle or of the cache as a set.
- `restore_point`: reads the snapshot that the last `apply` stored, and what has changed since.
- `apply_rules`: parameters that `apply` leaves out, writes first or last, or reboots for; the list is
  `apply_rules.toml`.
"""

from __future__ import annotations

from paramclient.provision.apply_restore import apply, restore
from paramclient.provision.apply_rules import CATEGORIES
from paramclient.provision.fleet import Wanted, apply_all, restore_all, verify_all
from paramclient.provision.inspection import prepare, verify
from paramclient.provision.planning import (
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
from paramclient.provision.results import (
    ApplyProgress,
    ApplyResult,
    ApplyRow,
    ApplyStatus,
    FleetApplied,
    FleetVerified,
)

__all__ = [
    "ApplyProgress",
    "ApplyResult",
    "ApplyRow",
    "ApplyStatus",
    "CATEGORIES",
    "FleetApplied",
    "FleetVerified",
    "MISSING",
    "ParamInfo",
    "Plan",
    "PlanRow",
    "PlanStatus",
    "Stage",
    "Step",
    "WRONG",
    "Wanted",
    "apply",
    "apply_all",
    "overlay",
    "plan",
    "prepare",
    "restore",
    "restore_all",
    "verify",
    "verify_all",
]
