"""Routes: the service, vehicles and their parameters, files, plan, apply, restore, snapshots, history.

With `?ext=true`, the routes of parameters are about the extended parameters of a component.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Final

import anyio
import anyio.to_thread
from fastapi import APIRouter, Depends, Header, Path, Query, Request
from fastapi.responses import PlainTextResponse, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import AwareDatetime

from paramclient.cache import ParamCache, SnapshotSummary
from paramclient.cli.json_apply import ApplyJson, PlanJson
from paramclient.cli.json_output import (
    FetchJson,
    HistoryLineJson,
    Json,
    ParamJson,
    SetJson,
    SnapshotJson,
    VehicleJson,
    WriteJson,
    WrittenJson,
    as_json,
)
from paramclient.errors import UsageError
from paramclient.files import FileFormat, dumps, writable
from paramclient.files.formats import ENDINGS
from paramclient.model.identity import autopilot_name
from paramclient.model.names import NameChoice
from paramclient.model.paramset import ParamSet
from paramclient.model.values import check_name
from paramclient.protocol.set_results import SetOutcome, SetStatus
from paramclient.provision import ApplyProgress, apply, restore
from paramclient.provision import plan as plan_of
from paramclient.provision.restore_point import load_restore_point
from paramclient.provision.vehicle_params import component_set, fetched_set, select_non_defaults
from paramclient.service import bodies
from paramclient.service.access import author_of, require_write
from paramclient.service.hub import Hub, Target
from paramclient.service.metrics import METRICS_MEDIA_TYPE, metrics_text
from paramclient.service.problems import ServiceError
from paramclient.version import __version__

__all__ = ["ROUTERS"]

VEHICLE: Final = "/api/vehicles/{system}/{component}"
HISTORY_ENTRIES: Final = 100
"""Default number of entries of a history."""
PROGRESS_INTERVAL: Final = 0.25
"""Seconds between two progress events of an apply or restore."""

reading = APIRouter()
writing = APIRouter(dependencies=[Depends(require_write)])
ROUTERS: Final = (reading, writing)


async def _hub_of(request: Request) -> Hub:
    hub: Hub = request.app.state.hub
    return hub


Author = Annotated[str, Depends(author_of)]
HubArgument = Annotated[Hub, Depends(_hub_of)]
System = Annotated[int, Path(ge=1, le=255)]
ComponentId = Annotated[int, Path(ge=0, le=255)]
LinkName = Annotated[
    str | None, Query(max_length=200, description="Name of the link, if several have the ids.")
]
At = Annotated[bodies.Moment | None, Query(description="An earlier state: a snapshot's number, or a time.")]
Names = Annotated[list[str] | None, Query(max_length=64, description="Names, or patterns such as MC_*.")]
Ext = Annotated[bool, Query(description="The extended parameters (PARAM_EXT_*).")]


async def _target_of(
    hub: HubArgument, system: System, component: ComponentId, link: LinkName = None, ext: Ext = False
) -> Target:
    return hub.target(system, component, link, extended=ext)


TargetArgument = Annotated[Target, Depends(_target_of)]
"""The plain parameters of a component on a link; with `ext`, the extended ones."""


# the service


@reading.get("/health")
async def health(request: Request, hub: HubArgument) -> dict[str, Any]:
    """Return that the service responds; with a valid token also its role, and the links."""
    holder = request.state.holder
    found: dict[str, Any] = {"status": "ok", "version": __version__}
    if holder is None:
        return found | {"role": None}
    links = [{"name": link.name, "state": link.state, "error": link.error} for link in hub.links.values()]
    return found | {"role": holder.role, "up_s": round(time.monotonic() - hub.started, 1), "links": links}


@reading.get("/metrics")
async def metrics(hub: HubArgument) -> PlainTextResponse:
    """Return the metrics for Prometheus in text format."""
    return PlainTextResponse(metrics_text(hub), media_type=METRICS_MEDIA_TYPE)


@reading.get("/api/events", response_class=EventSourceResponse)
async def events(
    hub: HubArgument, last_event_id: Annotated[str | None, Header()] = None
) -> AsyncIterator[ServerSentEvent]:
    """Stream all events (server-sent events); with Last-Event-ID, those that were missed first."""
    async for event in hub.feed.follow(last_event_id):
        yield event


@reading.get("/api/stations")
async def stations(hub: HubArgument) -> list[dict[str, Any]]:
    """Return the ground stations at the endpoints, with what the answers to them have saved."""
    return [each.state for each in hub.gateway.stations]


@reading.get("/api/vehicles")
async def vehicles(hub: HubArgument) -> dict[str, Any]:
    """Return the components on the links, the lowest ids first."""
    return {**hub.feed.position, "vehicles": [target.state for target in hub.targets]}


# parameters


@dataclass(frozen=True, slots=True, kw_only=True)
class ParamsJson(Json):
    """Parameters by name, with the number of the last event whose effects they include."""

    run: str
    seq: int
    params: Mapping[str, ParamJson | WrittenJson]


@reading.get(f"{VEHICLE}/params")
async def params(
    target: TargetArgument,
    names: Names = None,
    metadata: Annotated[bool, Query(description="Include the whole metadata of the parameters.")] = False,
    at: At = None,
) -> ParamsJson:
    """Return the known parameters by name, without traffic."""
    position = target.hub.feed.position
    choice = NameChoice(names or ["*"])
    if at is not None:
        state = await target.state_at(at)
        earlier = {name: WrittenJson.of(each) for name, each in state.items() if choice.has(name)}
        return ParamsJson(**position, params=earlier)
    known = [each for name, each in target.component.params.items() if choice.has(name)]

    def encode() -> ParamsJson:
        return ParamsJson(
            **position, params={each.name: target.shown(each, whole=metadata) for each in known}
        )

    return await anyio.to_thread.run_sync(encode)


@reading.get(f"{VEHICLE}/params/{{name:path}}")
async def param(
    target: TargetArgument,
    name: str,
    live: Annotated[bool, Query(description="Read it from the vehicle, also if it is known.")] = False,
) -> ParamJson:
    """Return one parameter: the known value, else that of the vehicle."""
    known = None if live else target.component.params.get(name)
    return target.shown(known or await target.component.get(name), whole=True)


@writing.put(f"{VEHICLE}/params/{{name:path}}")
async def set_param(
    author: Author, target: TargetArgument, name: str, body: bodies.WriteRequest
) -> WriteJson:
    """Write one parameter, and verify the value that the vehicle reports."""
    values = await target.values({name: body.value}, force=body.force)
    options = body.model_dump(exclude={"value"})
    result = await target.component.set(name, values[name], **options, author=author)
    return target.outcome(SetOutcome(name, values[name], SetStatus(result.status), result))


@writing.patch(f"{VEHICLE}/params")
async def set_params(author: Author, target: TargetArgument, body: bodies.WriteManyRequest) -> dict[str, Any]:
    """Write several parameters in order, many at a time, and verify each.

    If a value is invalid or out of range, nothing is written. A value that the vehicle refuses does not stop
    the others. `error` says why not all could be tried, if so.
    """
    values = await target.values(body.values, force=body.force)
    options = body.model_dump(exclude={"values"})
    result = await target.component.set_many(values, **options, author=author)
    results = [target.outcome(each) for each in result.outcomes]
    error = {} if result.error is None else {"error": str(result.error)}
    return dict(as_json({"vehicle": VehicleJson.of(target.component), "results": results} | error))


@reading.post(f"{VEHICLE}/fetch")
async def fetch(target: TargetArgument, body: bodies.FetchRequest) -> FetchJson:
    """Fetch all parameters. Simultaneous requests share one download; the progress is in the events."""
    component = target.component
    result = await target.fetch(refresh=body.refresh, timeout=body.timeout_s)
    if body.metadata:
        await target.load_metadata(timeout=body.timeout_s)
    known = dict(component.params)
    return FetchJson.of(
        component,
        result,
        known.values(),
        bytes_received=component.client.bytes_received,
        bytes_sent=component.client.bytes_sent,
        described=target.defaults_of(known),
    )


# files


@reading.post("/api/files")
async def read_file(body: bodies.UploadedFile) -> dict[str, Any]:
    """Parse a parameter file of any format, without names that no vehicle can have. It is not stored."""
    file = await anyio.to_thread.run_sync(partial(body.read, partial=True))
    sets = as_json([SetJson.with_sources(each, {}) for each in file.sets])
    return {"file": file.source, "format": file.file_format, "notes": file.notes, "components": sets}


@reading.get(f"{VEHICLE}/file", response_class=Response)
async def file(
    target: TargetArgument,
    file_format: Annotated[FileFormat, Query(alias="format")] = FileFormat.QGC,
    changed: Annotated[bool, Query(description="Only parameters that differ from the defaults.")] = False,
    at: At = None,
) -> Response:
    """Return the parameters as a file. They are fetched first, unless they are in sync."""
    if at is not None:
        found = await target.state_at(at)
    else:
        fetched = await target.component.fetch_all()
        found = fetched_set(target.component, fetched, source=f"link {target.link.name}")
    if changed:
        found = select_non_defaults(found, target.defaults_of(found) if at is None else {})
    name = _file_name(found, file_format)
    found, _ = writable(found, file_format)
    data = await anyio.to_thread.run_sync(lambda: dumps(found, file_format=file_format, target=name))
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    return Response(data, media_type="application/octet-stream", headers=headers)


def _file_name(params: ParamSet, file_format: FileFormat) -> str:
    """Return a name with firmware, ids and time, in characters that are safe in headers and files."""
    autopilot = "params" if params.identity is None else autopilot_name(params.identity.autopilot)
    at = time.strftime("%Y%m%d-%H%M%S", time.gmtime(time.time() if params.at is None else params.at))
    parts = [str(each) for each in (autopilot, params.system, params.component, at) if each is not None]
    ending = next((ending for ending, each in ENDINGS.items() if each is file_format), ".txt")
    return re.sub(r"[^A-Za-z0-9._-]", "_", "-".join(parts))[:100] + ending


# apply and restore


async def _only_apply(target: TargetArgument) -> AsyncIterator[None]:
    """Run one apply or restore of a component at a time: two would undo each other's changes."""
    if target.applying.locked():
        raise ServiceError(409, "busy", "Another apply or restore of this vehicle is running.")
    async with target.applying:
        yield


@reading.post(f"{VEHICLE}/plan")
async def plan(target: TargetArgument, body: bodies.PlanRequest) -> PlanJson:
    """Return which values an apply would write, in which order, and which it would skip, and why."""
    component, wanted = target.component, await _wanted(target, body)
    found = await plan_of(component, wanted, include=body.include, info=target.metadata, force=body.force)
    return PlanJson.of(found, system=component.system, component=component.component)


@writing.post(f"{VEHICLE}/apply", dependencies=[Depends(_only_apply)])
async def apply_(author: Author, target: TargetArgument, body: bodies.ApplyRequest) -> ApplyJson:
    """Write the wanted values in a working order, and verify each of them.

    The progress is in the events. If the client disconnects, the apply ends; written values stay.
    """
    wanted = await _wanted(target, body)
    options = body.model_dump(exclude={"values", "file", "at", "only"}) | _context(author, target)
    result = await apply(target.component, wanted, **options)
    return ApplyJson.of(result, VehicleJson.of(target.component))


@writing.post(f"{VEHICLE}/restore", dependencies=[Depends(_only_apply)])
async def restore_(author: Author, target: TargetArgument, body: bodies.RestoreRequest) -> ApplyJson:
    """Restore an earlier state, with the vehicle's own identity and calibration."""
    if body.at is None:
        state = (await target.cached(load_restore_point)).state
    else:
        state = await target.state_at(body.at)
    options = body.model_dump(exclude={"at"}) | _context(author, target)
    result = await restore(target.component, state, **options)
    return ApplyJson.of(result, VehicleJson.of(target.component))


async def _wanted(target: Target, body: bodies.PlanRequest) -> ParamSet:
    """Return the wanted parameters of a request."""
    if body.file is not None:
        found = await anyio.to_thread.run_sync(body.file.read_set, target.component)
    elif body.at is not None:
        found = await target.state_at(body.at)
    else:
        values = await target.values(body.values or {})
        found = ParamSet(
            {check_name(name): value for name, value in values.items()},
            is_extended=target.component.is_extended,
        )
    return found if body.only is None else found.only(body.only)


def _context(author: str, target: Target) -> dict[str, Any]:
    """Return the arguments of `apply` and `restore` that are not in the body.

    Each phase is published, and its progress at an interval.
    """
    phase, due_at = "", 0.0

    def progress(now: ApplyProgress) -> None:
        nonlocal phase, due_at
        if now.phase != phase or time.monotonic() >= due_at:
            phase, due_at = now.phase, time.monotonic() + PROGRESS_INTERVAL
            target.publish("apply", phase=now.phase, done=now.done, total=now.total)

    return {"info": target.metadata, "author": author, "progress": progress}


# the past


@reading.get(f"{VEHICLE}/snapshots")
async def snapshots(target: TargetArgument) -> dict[str, list[SnapshotJson]]:
    """Return the snapshots, the newest last."""
    return {"snapshots": [SnapshotJson.of(each) for each in await target.cached(ParamCache.snapshots)]}


@writing.post(f"{VEHICLE}/snapshots", status_code=201)
async def create_snapshot(target: TargetArgument, body: bodies.SnapshotRequest) -> SnapshotJson:
    """Store a snapshot of the known table."""
    component = target.component
    known = list(component.params.values())
    if not known:
        raise UsageError("no parameter of the vehicle is known")
    table = component_set(component, known, f"link {target.link.name}")
    about = {
        "reason": body.reason,
        "hash": component.hash,
        "complete": len(known) >= (component.count or math.inf),
    }

    def store(cache: ParamCache, _: str, number: int, **which: bool) -> SnapshotSummary:
        return cache.store_snapshot(component.identity, number, table, **about, **which)

    return SnapshotJson.of(await target.cached(store))


@reading.get(f"{VEHICLE}/history")
async def history(
    target: TargetArgument,
    name: Annotated[str | None, Query(max_length=16)] = None,
    limit: Annotated[int, Query(ge=1, le=1_000)] = HISTORY_ENTRIES,
    since: Annotated[AwareDatetime | None, Query(description="Only from this time on.")] = None,
) -> dict[str, list[HistoryLineJson]]:
    """Return the newest changes of values, the newest last."""
    begin = None if since is None else since.timestamp()
    entries = await target.cached(ParamCache.history, name, limit, begin)
    return {"history": [HistoryLineJson.of(each) for each in entries]}
