"""JSON of the service itself; parameters and results are as the command prints them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from paramclient.cli.json_output import (
    InfoJson,
    Json,
    ParamJson,
    VehicleJson,
    WriteJson,
    WrittenJson,
    as_json,
)
from paramclient.model.notation import hash_text, rounded
from paramclient.model.values import ParamType

if TYPE_CHECKING:
    from paramclient.metadata import ParamInfo
    from paramclient.model.values import Param
    from paramclient.protocol.events import Change
    from paramclient.protocol.set_results import SetOutcome
    from paramclient.service.stations import GroundStation
    from paramclient.service.targets import Target


@dataclass(frozen=True, slots=True, kw_only=True)
class ParamsJson(Json):
    """Parameters by name, with the number of the last event whose effects they include."""

    run: str
    seq: int
    params: Mapping[str, ParamJson | WrittenJson]


def param(known: Param, info: ParamInfo | None, *, whole: bool = True) -> ParamJson:
    """Return a parameter of a table, with its metadata, or if not `whole`, with the meaning of its value."""
    shown = ParamJson.of_table(known, info)
    return replace(shown, metadata=InfoJson.of(info)) if whole and info is not None else shown


def write(outcome: SetOutcome, target: Target) -> WriteJson:
    """Return the outcome of a write."""
    known = target.component.params.get(outcome.name)
    kind = ParamType.REAL64 if known is None else known.type_number
    return WriteJson.of(outcome, kind, target.info(outcome.name))


def vehicle(target: Target) -> dict[str, Any]:
    """Return the state of the parameters of a component on a link.

    `params` is the number of known parameters, `count` the number that the component announces, `fetch` the
    progress of a running fetch, `fetches` the number of ended ones.
    """
    component, now = target.component, target.progress
    return {
        **target.address,
        **as_json(VehicleJson.of(component)),
        "link_state": target.link.state,
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
        "fetch": None if now is None else {**asdict(now), "rate": round(now.rate, 1)},
        "fetches": target.fetches,
        "has_metadata": target.metadata is not None,
    }


def change(found: Change, info: ParamInfo | None) -> dict[str, Any]:
    """Return the members of an event about a changed, added or removed parameter."""

    def shown(each: Param | None) -> dict[str, Any] | None:
        return None if each is None else as_json(param(each, info, whole=False))

    old, new = shown(found.old), shown(found.new)
    return {"name": found.name, "old": old, "new": new, "by": found.by, "kind": found.kind}


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
