"""JSON of parameters, sets, fetches, writes and history: the command prints it, and the service sends it.

Each function returns one object that `json.dumps` accepts; docs/json.md describes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from paramclient.model.identity import autopilot_name, version_text
from paramclient.model.notation import (
    Scalar,
    bits_text,
    bits_written,
    hash_text,
    rounded,
    time_or_none,
    time_text,
    value_json,
    value_written,
)
from paramclient.model.paramset import add_default, default_of
from paramclient.model.values import Param, ParamType, format_value
from paramclient.protocol.identity import kind_in_words

if TYPE_CHECKING:
    from paramclient.cache import HistoryEntry, SnapshotSummary
    from paramclient.client.component import Component
    from paramclient.metadata import Metadata, ParamInfo
    from paramclient.model.paramset import ParamSet, WrittenParam
    from paramclient.protocol.fetch import FetchResult
    from paramclient.protocol.set_results import SetOutcome

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


def param_value(param: Param | None) -> Scalar | None:
    """Return the value of a parameter; None for None."""
    return None if param is None else value_json(param.settable, param.type)


def info_json(info: ParamInfo) -> JsonObject:
    """Return the metadata of a parameter, without name, type and empty members."""
    found: JsonObject = {each.name: getattr(info, each.name) for each in fields(info)[2:]}
    found["values"] = {format_value(value): name for value, name in info.values.items()}
    found["bits"] = {str(bit): name for bit, name in info.bits.items()}
    for name, member in found.items():
        if isinstance(member, float):
            found[name] = value_json(member, ParamType.REAL64)
    return {name: each for name, each in found.items() if each not in (None, "", {}) and each is not False}


def param_json(
    param: Param,
    info: ParamInfo | None = None,
    *,
    described: int | float | None = None,
    whole: bool = False,
) -> JsonObject:
    """Return a parameter with its default, also that of the metadata; in the command its name is the key.

    Args:
        param: the parameter.
        info: its metadata, or None.
        described: its default in the metadata, where `info` is None; or None.
        whole: whether to include all metadata.
    """
    default = default_of(param, described if info is None else info.default)
    return {
        "value": param_value(param),
        "type": param.type.name,
        "index": param.index,
        "bits": bits_text(param),
    } | known_members(
        default=default and value_json(default.value, param.type),
        default_source=default and default.source,
        text=info and short_text(info.text(param.settable)),
        units=info and short_text(info.units),
        metadata=info_json(info) if info and whole else None,
    )


def table_param_json(
    param: Param,
    info: ParamInfo | None = None,
    *,
    described: int | float | None = None,
    whole: bool = False,
) -> JsonObject:
    """Return a parameter as `param_json` does, with its name and its trust."""
    is_changed = add_default(param, described if info is None else info.default).is_changed
    return {
        "name": param.name,
        **param_json(param, info, described=described, whole=whole),
        **known_members(is_default=None if is_changed is None else not is_changed, trust=param.trust),
    }


def written_json(param: WrittenParam, default_source: str | None = None) -> JsonObject:
    """Return a parameter of a file or of another set, with the origin of its default if that is given."""
    return compared_json(param) | known_members(
        default=None if param.default is None else value_written(param.default, param),
        default_source=default_source,
        comment=param.comment or None,
    )


def compared_json(param: WrittenParam, metadata: Metadata | None = None) -> JsonObject:
    """Return a parameter of one side of a comparison, with the meaning of its value."""
    info = None if metadata is None else metadata.find(param.name)
    return {
        "value": value_written(param.settable, param),
        "type": None if param.type is None else param.type.name,
        "bits": bits_written(param),
    } | known_members(text=info and short_text(info.text(param.settable)))


# Vehicles and sets


def vehicle_json(vehicle: Component) -> JsonObject:
    """Return a vehicle that is written to."""
    identity = vehicle.identity
    return {
        **taken(vehicle, "system", "component"),
        "autopilot": autopilot_name(identity.autopilot),
        "kind": kind_in_words(identity.autopilot, identity.vehicle_type),
        "firmware": version_text(identity.firmware) if identity.firmware else None,
        "uid": identity.uid,
    }


def origin_json(params: ParamSet) -> JsonObject:
    """Return the origin of a set, and the time at which the vehicle had these values."""
    identity = params.identity
    return {
        **taken(params, "source", "system", "component"),
        "autopilot": None if identity is None else autopilot_name(identity.autopilot),
        "uid": None if identity is None else identity.uid,
        "at": time_or_none(params.at),
        "count": len(params),
    }


def set_json(params: ParamSet, sources: Mapping[str, str] | None = None) -> JsonObject:
    """Return a set with its parameters by name, and with the origins of its defaults where they are given."""
    written = {name: written_json(each, (sources or {}).get(name)) for name, each in params.items()}
    return {**origin_json(params), "params": written}


# Fetches and writes


def fetch_json(
    component: Component, result: FetchResult, params: Iterable[Param], described: Mapping[str, int | float]
) -> JsonObject:
    """Return a fetch with these parameters; `described` has defaults of the metadata by name."""
    return {
        **taken(component, "system", "component", "autopilot"),
        "uid": component.identity.uid,
        **taken(result, "count", "received", "source"),
        "hash": hash_text(result.hash),
        **taken(result, "missing", "cached", "changed", "lost", "repeated"),
        "round_trip_s": rounded(result.round_trip),
        "elapsed_s": round(result.elapsed, 4),
        **taken(component.core.link_task, "bytes_received", "bytes_sent"),
        "params": {each.name: param_json(each, described=described.get(each.name)) for each in params},
    }


def outcome_json(outcome: SetOutcome, kind: ParamType | int, info: ParamInfo | None) -> JsonObject:
    """Return the outcome of a write.

    Args:
        outcome: the outcome.
        kind: the vehicle's type of the parameter.
        info: its metadata, or None.
    """
    requested, actual, error = outcome.requested, outcome.reported, outcome.error
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
