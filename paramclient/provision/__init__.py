"""Parameter files on vehicles: `plan` says what `apply` would write, `restore` writes an earlier state.

They work on one component, or on its extended parameters, `component.ext`; `for_each` makes the same call for
several vehicles.

- `planning`: the values to write, their order, and the reason for each parameter that is not written.
- `inspection`: read what a vehicle has; `plan`.
- `apply_restore`: `apply`, `restore`, and the state before the last `apply`; `for_each`.
- `execution`: one run of them, which stores the state before the first write.
- `sources`: `resolve`, the parameters of a file, a log, a vehicle of the cache, or a link.
- `apply_rules`: parameters that `apply` leaves out, writes first or last, or reboots for; the list is
  `apply_rules.toml`.
"""

from __future__ import annotations

from paramclient.provision.apply_restore import FleetResult, apply, for_each, restore
from paramclient.provision.apply_rules import CATEGORIES
from paramclient.provision.execution import ApplyOptions, ApplyProgress, ApplyResult
from paramclient.provision.inspection import plan
from paramclient.provision.planning import MISSING, WRONG, ApplyRow, ApplyStatus, Plan, PlanOptions, plan_from
from paramclient.provision.sources import resolve

__all__ = [
    "ApplyOptions",
    "ApplyProgress",
    "ApplyResult",
    "ApplyRow",
    "ApplyStatus",
    "CATEGORIES",
    "FleetResult",
    "MISSING",
    "Plan",
    "PlanOptions",
    "WRONG",
    "apply",
    "for_each",
    "plan",
    "plan_from",
    "resolve",
    "restore",
]
