"""JSON of comparisons, of plans, and of results of apply and restore; see `json_output`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from paramclient.cli.json_output import (
    JsonObject,
    compared_json,
    known_members,
    origin_json,
    short_text,
    taken,
    vehicle_json,
)
from paramclient.model.comparison import ChangedSide, DifferenceStatus
from paramclient.model.identity import version_text
from paramclient.model.notation import Scalar, typed, value_json
from paramclient.model.paramset import DefaultSource
from paramclient.model.values import ParamType, Value
from paramclient.provision.planning import ApplyStatus

if TYPE_CHECKING:
    from paramclient.client.component import Component
    from paramclient.metadata import Metadata
    from paramclient.model.comparison import Comparison, Difference
    from paramclient.provision import ApplyResult, ApplyRow, Plan
    from paramclient.provision.planning import Rows

# Comparisons


def diff_json(
    outcome: Comparison,
    left: Metadata | None = None,
    right: Metadata | None = None,
    base: Metadata | None = None,
    *,
    has_defaults: bool = False,
) -> JsonObject:
    """Return a comparison.

    Args:
        outcome: the comparison.
        left, right, base: the metadata of each side, or None.
        has_defaults: whether the base are the firmware's defaults.
    """

    def entry_json(entry: Difference) -> JsonObject:
        given = [each for each in (entry.left, entry.right) if each is not None]
        found = [side and side.find(entry.name) for side in (left, right)]
        source = None
        if has_defaults and entry.base is not None:
            is_given = any(each.default is not None for each in given)
            source = DefaultSource.VEHICLE if is_given else DefaultSource.METADATA
        return {
            "is": entry.status,
            "types_differ": entry.types_differ,
            "rounding": entry.is_rounding,
            "left": entry.left and compared_json(entry.left, left),
            "right": entry.right and compared_json(entry.right, right),
            "base": entry.base and compared_json(entry.base, base),
            **known_members(default_source=source),
            "changed_side": entry.changed_side,
            **known_members(
                units=short_text(next((info.units for info in found if info and info.units), None))
            ),
        }

    has_base = outcome.base is not None
    return {
        "same": outcome.is_same,
        "left": origin_json(outcome.left),
        "right": origin_json(outcome.right),
        "base": None if outcome.base is None else origin_json(outcome.base),
        "counts": {status: outcome.counts[status] for status in DifferenceStatus},
        "changed_sides": {side: outcome.changed_sides[side] for side in ChangedSide} if has_base else None,
        "params": {each.name: entry_json(each) for each in outcome.entries if each.is_shown},
    }


# Plans and results of apply and restore


def rows_json(rows: Iterable[ApplyRow]) -> JsonObject:
    """Return what is planned for parameters, or what became of them, by name in the file."""

    def row_json(row: ApplyRow) -> JsonObject:
        def value(given: Value | None) -> Scalar | None:
            return None if given is None else value_json(*typed(given, row.type))

        return {
            "status": row.status,
            "type": None if row.type is None else ParamType(row.type).name,
            "before": value(row.before),
            "wanted": value(row.wanted.settable),
            "actual": value(row.actual),
            "category": row.category,
            "reason": row.reason,
            "nearest": row.nearest,
        }

    return {row.name: row_json(row) for row in rows}


def plan_json(plan: Plan, component: Component) -> JsonObject:
    """Return the plan for a vehicle, without unchanged parameters."""

    def step_json(row: ApplyRow) -> JsonObject:
        value, kind = typed(row.wanted.settable, row.type)
        assert row.before is not None, "only parameters that the vehicle has are set"
        return {
            "name": row.name,
            "value": value_json(value, kind),
            "type": ParamType(kind).name,
            "before": value_json(row.before, kind),
            "needs_reboot": row.needs_reboot,
        }

    rows = [row for row in plan.rows.values() if row.status is not ApplyStatus.UNCHANGED]
    found: JsonObject = {
        **taken(component, "system", "component"),
        "dry_run": True,
        "counts": _counts(plan),
        "stages": [
            {
                "purpose": stage.purpose,
                "reboot_first": stage.reboot_first,
                "steps": [step_json(row) for row in stage.rows],
            }
            for stage in plan.stages
        ],
        "params": rows_json(rows),
        "extra": len(plan.extra),
        "unchecked": len(plan.unchecked),
        "reboot_for": plan.reboot_for,
    }
    if plan.firmware_note:
        file, vehicle = (version_text(each.firmware) for each in plan.firmware)
        found["firmware"] = {"file": file, "vehicle": vehicle}
    return found


def apply_json(result: ApplyResult, component: Component) -> JsonObject:
    """Return the result for a vehicle; its first address is that at the start, `now` the one at the end.

    Unchanged parameters, and left-out ones that do not differ, are not included.
    """
    return {
        **taken(component, "system", "component"),
        "vehicle": vehicle_json(component),
        "now": taken(result, "system", "component"),
        "complete": result.complete,
        "counts": _counts(result),
        "params": rows_json(result.shown_rows),
        "extra": len(result.extra),
        "unchecked": len(result.plan.unchecked),
        "reboots": result.reboots,
        "reboot_required": result.reboot_required,
        "error": None if result.error is None else str(result.error),
        "elapsed_s": round(result.elapsed, 3),
    }


def _counts(rows: Rows) -> JsonObject:
    return {status: count for status in ApplyStatus if (count := rows.counts.get(status, 0))}
