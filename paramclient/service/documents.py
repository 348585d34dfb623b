"""JSON of the service: vehicles and events of its own; parameters and results as the command prints them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

from paramclient.cli.json_cache import HistoryLineJson, SnapshotJson, SummaryJson
from paramclient.cli.json_output import (
    FetchJson,
    IdentityJson,
    InfoJson,
    ParamJson,
    SetJson,
    VehicleJson,
    WriteJson,
    WrittenJson,
    as_json,
)
from paramclient.cli.json_setup import ApplyJson, PlanJson
from paramclient.model.notation import bits_text, hash_text, rounded
from paramclient.model.values import ParamType
from paramclient.protocol.identity import expects_extended

if TYPE_CHECKING:
    from paramclient.cache import CachedSummary, CachedVehicle, HistoryEntry, SnapshotSummary
    from paramclient.files import ParamFile
    from paramclient.metadata import Metadata
    from paramclient.model.paramset import ParamSet
    from paramclient.model.values import Param
    from paramclient.protocol.events import Change
    from paramclient.protocol.fetch import FetchResult, Progress
    from paramclient.protocol.set_results import SetManyResult, SetOutcome
    from paramclient.provision import ApplyResult, Plan
    from paramclient.service.stations import GroundStation
    from paramclient.service.targets import Target

CHANGING_MEMBERS: Final = frozenset({"silence_s", "round_trip_s", "params", "fetch"})
"""Members of a vehicle that change all the time: they cause no event."""


# Vehicles


def vehicle(target: Target) -> dict[str, Any]:
    """Return the state of a component on a link.

    `params` is the number of known parameters, `count` the number that the component announces, `fetch` the
    progress of a running fetch, `fetches` the number of ended ones, `key` the key of its table in the cache.
    """
    component, identity, ext = target.component, target.component.identity, target.component.ext
    return {
        **target.address,
        "link_state": target.link.state,
        "autopilot": component.autopilot,
        "vehicle_type": identity.vehicle_type,
        "key": identity.key,
        "uid": identity.uid,
        "identity": as_json(IdentityJson.of(identity)),
        "encoding": component.encoding.value,
        "count": component.count,
        "params": len(component.params),
        "hash": hash_text(component.hash),
        "state": component.state,
        "sync_state": component.sync_state.value,
        "is_armed": component.is_armed,
        "is_lost": component.sync_state == "lost",
        "silence_s": round(component.silence, 3),
        "round_trip_s": rounded(component.round_trip),
        "fetch": None if target.progress is None else progress(target.progress),
        "fetches": target.fetches,
        "has_metadata": target.metadata is not None,
        "extended": {
            "is_expected": expects_extended(identity.vehicle_type, component.component),
            "count": ext.count,
            "params": len(ext.params),
        },
    }


def station(found: GroundStation) -> dict[str, Any]:
    """Return the state of a ground station. `saved_bytes` did not have to come over the vehicle's link."""
    return {
        "name": found.name,
        "endpoint": found.endpoint.name,
        "ids": sorted(f"{system}/{component}" for system, component in found.sources),
        "mavlink": found.version,
        "silence_s": round(found.silence, 3),
        "requests": dict(found.requests),
        "relayed": found.relayed,
        "answered": found.answered,
        "dropped": found.dropped,
        "saved_bytes": found.saved,
    }


def lasting_members(found: dict[str, Any]) -> dict[str, Any]:
    """Return the members of a vehicle whose changes are events."""
    return {name: value for name, value in found.items() if name not in CHANGING_MEMBERS}


def cached_vehicles(
    vehicles: Iterable[CachedVehicle], tables: Iterable[CachedSummary]
) -> list[dict[str, Any]]:
    """Return the tables of the cache, the last heard first, each with the time when its vehicle was heard."""
    by_key: dict[str, list[CachedSummary]] = {}
    for table in tables:
        by_key.setdefault(table.key, []).append(table)
    return [
        {**as_json(SummaryJson.of(table)), "last_seen": each.last_seen}
        for each in vehicles
        for table in by_key.get(each.key, ())
    ]


def progress(now: Progress) -> dict[str, Any]:
    """Return the progress of a fetch: received parameters, their total, rate per second, seconds left."""
    return {
        "received": now.received,
        "total": now.total,
        "rate": round(now.rate, 1),
        "seconds_left": rounded(now.seconds_left),
    }


# Parameters


def param(known: Param, metadata: Metadata | None = None, *, whole: bool = True) -> dict[str, Any]:
    """Return a parameter of a table.

    Args:
        known: the parameter.
        metadata: the metadata of the vehicle, for the default and the meaning of the value; or None.
        whole: whether to include the whole metadata of the parameter.
    """
    info = None if metadata is None else metadata.find(known.name)
    found: dict[str, Any] = as_json(ParamJson.of_table(known, info))
    return found | {"metadata": as_json(InfoJson.of(info))} if whole and info is not None else found


def params(
    known: Iterable[Param], metadata: Metadata | None = None, *, whole: bool = True
) -> dict[str, dict[str, Any]]:
    """Return parameters by name."""
    return {each.name: param(each, metadata, whole=whole) for each in known}


def param_set(found: ParamSet) -> dict[str, dict[str, Any]]:
    """Return the parameters of a set by name."""
    return {name: as_json(WrittenJson.of(each)) for name, each in found.items()}


def param_file(file: ParamFile) -> dict[str, Any]:
    """Return the content of a file: a set for each component."""
    sets = [as_json(SetJson.with_sources(each, {})) for each in file.sets]
    return {"file": file.source, "format": file.file_format, "notes": list(file.notes), "components": sets}


def change(found: Change, target: Target) -> dict[str, Any]:
    """Return the members of an event about a changed, added or removed parameter."""

    def shown(each: Param | None) -> dict[str, Any] | None:
        return None if each is None else param(each, target.metadata, whole=False)

    old, new = shown(found.old), shown(found.new)
    about = {"name": found.name, "old": old, "new": new, "by": found.by, "kind": found.kind}
    return {**about, "extended": target.component.is_extended}


# Fetches, writes and set-ups


def fetch_result(result: FetchResult, target: Target) -> dict[str, Any]:
    """Return the result of a fetch, without the parameters."""
    client, component = target.link.client, target.component
    found: dict[str, Any] = as_json(
        FetchJson.of(
            component,
            result,
            (),
            bytes_received=0 if client is None else client.bytes_received,
            bytes_sent=0 if client is None else client.bytes_sent,
            described={},
        )
    )
    del found["params"]
    return found | {"notes": list(result.notes)}


def write(outcome: SetOutcome, target: Target) -> dict[str, Any]:
    """Return the outcome of a write, with the `bits` of a value that was set."""
    known = target.component.params.get(outcome.name)
    kind = ParamType.REAL64 if known is None else known.type_number
    found = dict(as_json(WriteJson.of(outcome, kind, target.info(outcome.name))))
    return found if outcome.result is None else found | {"bits": bits_text(outcome.result.param)}


def writes(result: SetManyResult, target: Target) -> dict[str, Any]:
    """Return the outcomes of several writes in order; `error` says why not all were tried."""
    return {
        "vehicle": as_json(VehicleJson.of(target.component)),
        "results": [write(outcome, target) for outcome in result.outcomes],
        "error": None if result.error is None else str(result.error),
    }


def plan(found: Plan, target: Target) -> dict[str, Any]:
    """Return a plan."""
    component = target.component
    return dict(as_json(PlanJson.of(found, system=component.system, component=component.component)))


def apply_result(result: ApplyResult, target: Target) -> dict[str, Any]:
    """Return the result of an apply or restore."""
    component = target.component
    return dict(
        as_json(
            ApplyJson.of(
                result,
                system=component.system,
                component=component.component,
                vehicle=VehicleJson.of(component),
            )
        )
    )


# The past


def history(entries: Iterable[HistoryEntry]) -> dict[str, Any]:
    """Return changes of values."""
    return {"history": [as_json(HistoryLineJson.of(entry)) for entry in entries]}


def snapshots(kept: Iterable[SnapshotSummary]) -> dict[str, Any]:
    """Return snapshots without their parameters."""
    return {"snapshots": [as_json(SnapshotJson.of(each)) for each in kept]}
