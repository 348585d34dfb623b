"""JSON of parameters, sets, fetches, writes, plans and history: printed by the command, sent by the service.

Each function returns one object that `json.dumps` accepts; docs/json.md describes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from paramclient.model.comparison import ChangedSide, DifferenceStatus
from paramclient.model.identity import version_text
from paramclient.model.notation import (
    Scalar,
    bits_text,
    bits_written,
    hash_text,
    rounded,
    time_or_none,
    time_text,
    typed,
    value_json,
    value_written,
)
from paramclient.model.paramset import DefaultSource, add_default, default_of
from paramclient.model.values import Param, ParamType, Value, format_value
from paramclient.protocol.identity import kind_in_words

if TYPE_CHECKING:
    from paramclient.cache import HistoryEntry, SnapshotSummary
    from paramclient.client.component import Component
    from paramclient.metadata import Metadata, ParamInfo
    from paramclient.model.comparison import Comparison, Difference
    from paramclient.model.paramset import ParamSet, WrittenParam
    from paramclient.protocol.fetch import FetchResult
    from paramclient.protocol.set_results import SetOutcome
    from paramclient.provision import ApplyResult, ApplyRow, Plan

JsonObject: TypeAlias = dict[str, Any]
"""An object of JSON."""

SHORT_TEXT_LENGTH_MAX: Final = 400
"""Characters of the members `text` and `units`, which thousands of rows may repeat."""


def known_members(**members: object) -> JsonObject:
    """Return the members that are not None."""
    return {name: value for name, value in members.items() if value is not None}


def taken(source: object, *names: str) -> JsonObject:
    """Return attributes of an object as members."""
    return {name: getattr(source, name) for name in names}


def short_text(text: str | None) -> str | None:
    """Return a text of metadata; None if it is empty or longer than `SHORT_TEXT_LENGTH_MAX`."""
    return text if text and len(text) <= SHORT_TEXT_LENGTH_MAX else None


# Parameters


def info_of(metadata: Metadata | None, name: str) -> ParamInfo | None:
    """Return the metadata of a parameter, or None."""
    return None if metadata is None else metadata.find(name)


def param_value(param: Param | None) -> Scalar | None:
    """Return the value of a parameter; None for None."""
    return None if param is None else value_json(param.settable, param.type)


def info_json(info: ParamInfo) -> JsonObject:
    """Return the metadata of a parameter, without name, type and empty members."""
    found: JsonObject = {each.name: getattr(info, each.name) for each in fields(info)[2:]}
    found["values"] = {format_value(value): name for value, name in info.values.items()}
    found["bits"] = {str(bit): name for bit, name in info.bits.items()}
    return {
        name: value_json(each, ParamType.REAL64) if isinstance(each, float) else each
        for name, each in found.items()
        if each not in (None, "", {}) and each is not False
    }


def param_json(param: Param, info: ParamInfo | None = None, *, whole: bool = False) -> JsonObject:
    """Return a parameter with its default, also that of the metadata; in the command its name is the key.

    Args:
        param: the parameter.
        info: its metadata, or None.
        whole: whether to include all metadata.
    """
    found: JsonObject = {"value": param_value(param), "type": param.type.name, "index": param.index}
    return {**found, "bits": bits_text(param), **_described(param, info, whole=whole)}


def table_param_json(param: Param, info: ParamInfo | None = None, *, whole: bool = False) -> JsonObject:
    """Return a parameter as `param_json` does, with its name and its trust."""
    is_changed = add_default(param, None if info is None else info.default).is_changed
    return {
        "name": param.name,
        **param_json(param, info, whole=whole),
        **known_members(is_default=None if is_changed is None else not is_changed, trust=param.trust),
    }


def written_json(param: WrittenParam, info: ParamInfo | None = None, *, whole: bool = False) -> JsonObject:
    """Return a parameter of a file or of another set, as `param_json` does."""
    return compared_json(param) | _described(param, info, whole=whole, comment=param.comment or None)


def _described(
    param: Param | WrittenParam, info: ParamInfo | None, *, whole: bool, comment: str | None = None
) -> JsonObject:
    """Return the default of a parameter, its comment, and its metadata."""
    default = default_of(param, None if info is None else info.default)
    kind = ParamType.REAL64 if param.type is None else param.type
    return known_members(
        default=default and value_json(default.value, kind),
        default_source=default and default.source,
        comment=comment,
        text=info and short_text(info.text(param.settable)),
        units=info and short_text(info.units),
        metadata=info_json(info) if info and whole else None,
    )


def compared_json(param: WrittenParam, metadata: Metadata | None = None) -> JsonObject:
    """Return a parameter of one side of a comparison, with the meaning of its value."""
    info = info_of(metadata, param.name)
    return {
        "value": value_written(param.settable, param),
        "type": None if param.type is None else param.type.name,
        "bits": bits_written(param),
    } | known_members(text=info and short_text(info.text(param.settable)))


# Vehicles and sets


def vehicle_json(vehicle: Component) -> JsonObject:
    """Return a vehicle that is written to."""
    identity, heard = vehicle.identity, vehicle.node.identification
    return {
        **taken(vehicle, "system", "component", "autopilot"),
        "kind": kind_in_words(heard.autopilot, heard.vehicle_type),
        "firmware": version_text(identity.firmware) if identity.firmware else None,
        "uid": identity.uid,
    }


def origin_json(params: ParamSet) -> JsonObject:
    """Return the origin of a set, and the time at which the vehicle had these values."""
    return {
        **taken(params, "source", "system", "component"),
        "autopilot": params.autopilot or None,
        "uid": params.identity and params.identity.uid,
        "at": time_or_none(params.at),
        "count": len(params),
        **known_members(lacks=params.lacks or None),
    }


def set_json(params: ParamSet, metadata: Metadata | None = None, *, whole: bool = False) -> JsonObject:
    """Return a set with its parameters by name; with `whole`, with all their metadata."""
    values = {name: written_json(each, info_of(metadata, name), whole=whole) for name, each in params.items()}
    return {**origin_json(params), "params": values}


# Fetches and writes


def fetch_json(
    component: Component, result: FetchResult, params: Iterable[Param], metadata: Metadata | None
) -> JsonObject:
    """Return a fetch with these parameters."""
    return {
        **vehicle_json(component),
        **taken(result, "count", "received", "source"),
        "hash": hash_text(result.hash),
        **taken(result, "missing", "cached", "changed", "lost", "repeated", "notes"),
        "round_trip_s": rounded(result.round_trip),
        "elapsed_s": round(result.elapsed, 4),
        **taken(component.core.link_task, "bytes_received", "bytes_sent"),
        "params": {
            each.name: param_json(each, info_of(metadata, each.name)) | {"trust": each.trust}
            for each in params
        },
    }


def outcome_json(outcome: SetOutcome, vehicle: Component, metadata: Metadata | None) -> JsonObject:
    """Return the outcome of a write.

    Args:
        outcome: the outcome.
        vehicle: which was written to.
        metadata: of its parameters, or None.
    """
    requested, actual, error = outcome.requested, outcome.reported, outcome.error
    known, info = vehicle.params.get(outcome.name), info_of(metadata, outcome.name)
    kind = ParamType.REAL64 if known is None else known.type
    return {
        "name": outcome.name,
        "requested": value_json(requested, kind if isinstance(requested, bytes) else ParamType.REAL64),
        "actual": None if actual is None else value_json(actual, kind),
        "status": outcome.status,
    } | known_members(
        reason=error and str(error),
        error=error and type(error).__name__,
        note=outcome.result and (outcome.result.note or None),
        text=None if info is None or actual is None else info.text(actual) or None,
        reboot_required=info and (info.reboot_required or None),
    )


def results_json(outcomes: Iterable[SetOutcome], vehicle: Component, metadata: Metadata | None) -> JsonObject:
    """Return a vehicle and the outcomes of writes to it; see `outcome_json`."""
    results = [outcome_json(each, vehicle, metadata) for each in outcomes]
    return taken(vehicle, "system", "component") | {"vehicle": vehicle_json(vehicle), "results": results}


# Comparisons


def diff_json(
    outcome: Comparison, known: Sequence[Metadata | None], *, has_defaults: bool = False
) -> JsonObject:
    """Return a comparison.

    Args:
        outcome: the comparison.
        known: the metadata of left, right and base.
        has_defaults: whether the base are the firmware's defaults.
    """

    def entry_json(entry: Difference) -> JsonObject:
        params = (entry.left, entry.right, entry.base)
        sides = [each and compared_json(each, metadata) for each, metadata in zip(params, known, strict=True)]
        infos = [metadata.find(entry.name) for metadata in known[:2] if metadata is not None]
        units = next((info.units for info in infos if info is not None and info.units), None)
        is_given = any(each and each.default is not None for each in (entry.left, entry.right))
        source = DefaultSource.VEHICLE if is_given else DefaultSource.METADATA
        return {
            "is": entry.status,
            "types_differ": entry.types_differ,
            "rounding": entry.is_rounding,
            **dict(zip(("left", "right", "base"), sides, strict=True)),
            "changed_side": entry.changed_side,
            **known_members(
                default_source=source if has_defaults and entry.base else None, units=short_text(units)
            ),
        }

    base = outcome.base
    return {
        "same": outcome.is_same,
        "left": origin_json(outcome.left),
        "right": origin_json(outcome.right),
        "base": None if base is None else origin_json(base),
        "counts": {status: outcome.counts[status] for status in DifferenceStatus},
        "changed_sides": base and {side: outcome.changed_sides[side] for side in ChangedSide},
        "params": {each.name: entry_json(each) for each in outcome.entries if each.is_shown},
    }


# Plans and results of apply and restore


def row_json(row: ApplyRow) -> JsonObject:
    """Return what is planned for a parameter, or what became of it."""

    def value(given: Value | None) -> Scalar | None:
        return None if given is None else value_json(*typed(given, row.type))

    return {
        "status": row.status,
        "type": None if row.type is None else ParamType(row.type).name,
        "before": value(row.before),
        "wanted": value(row.wanted.settable),
        "actual": value(row.actual),
        **taken(row, "category", "reason", "nearest"),
    }


def rows_json(rows: Iterable[ApplyRow]) -> JsonObject:
    """Return rows by the names in the file."""
    return {row.name: row_json(row) for row in rows}


def plan_json(plan: Plan, component: Component) -> JsonObject:
    """Return the plan for a vehicle, without unchanged parameters; the steps are names."""
    stages = [
        {**taken(stage, "purpose", "reboot_first"), "steps": [row.name for row in stage.rows]}
        for stage in plan.stages
    ]
    return {
        **taken(component, "system", "component"),
        "counts": plan.counts,
        "stages": stages,
        "params": rows_json(row for row in plan.rows.values() if row.status != "unchanged"),
        "extra": len(plan.extra),
        "unchecked": len(plan.unchecked),
        "reboot_for": plan.reboot_for + plan.awaiting_reboot,
        **known_members(firmware=plan.firmware_note or None),
    }


def apply_json(result: ApplyResult, component: Component) -> JsonObject:
    """Return the result for a vehicle; its first address is that at the start, `now` the one at the end.

    Unchanged parameters, and left-out ones that do not differ, are not included.
    """
    return {
        **taken(component, "system", "component"),
        "vehicle": vehicle_json(component),
        "now": taken(result, "system", "component"),
        **taken(result, "complete", "counts"),
        "params": rows_json(result.shown_rows),
        "extra": len(result.extra),
        "unchecked": len(result.plan.unchecked),
        **taken(result, "reboots", "reboot_required"),
        "error": None if result.error is None else str(result.error),
        "elapsed_s": round(result.elapsed, 3),
    }


# The cache


def history_json(entry: HistoryEntry) -> JsonObject:
    """Return one change of a value."""
    return {
        "time": time_text(entry.at),
        **taken(entry, "component", "name"),
        "old": param_value(entry.old),
        "new": param_value(entry.new),
        "by": entry.by,
    }


def snapshot_json(summary: SnapshotSummary) -> JsonObject:
    """Return a snapshot of a table, without its parameters."""
    return {
        "id": summary.id,
        "time": time_text(summary.at),
        **taken(summary, "component", "size", "complete"),
        "hash": hash_text(summary.hash),
        "reason": summary.reason,
    }
