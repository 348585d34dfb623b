"""Routes of set-ups and of the past: files, plan, apply, restore, snapshots, history."""

from __future__ import annotations

import math
import re
import time
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import Annotated, Any, Final

import anyio
import anyio.to_thread
from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import Response
from pydantic import AwareDatetime

from paramclient.cache import ParamCache, SnapshotSummary
from paramclient.cli.json_apply import ApplyJson, PlanJson
from paramclient.cli.json_cache import HistoryLineJson, SnapshotJson
from paramclient.cli.json_output import SetJson, VehicleJson, as_json
from paramclient.errors import UsageError
from paramclient.files import FileFormat, dumps, writable
from paramclient.files.formats import ENDINGS
from paramclient.model.identity import autopilot_name
from paramclient.model.paramset import ParamSet
from paramclient.provision import ApplyProgress, ApplyResult, apply, restore
from paramclient.provision import plan as plan_of
from paramclient.provision.restore_point import load_state_before_apply
from paramclient.provision.vehicle_params import fetch_set, select_non_defaults, set_maker
from paramclient.service.access import author_of, require_write
from paramclient.service.hub import Hub
from paramclient.service.problems import ServiceError
from paramclient.service.request_bodies import (
    ApplyRequest,
    PlanRequest,
    RestoreRequest,
    SnapshotRequest,
    UploadedFile,
    values_set,
)
from paramclient.service.routes import VEHICLE, At, HubArgument, TargetArgument
from paramclient.service.targets import Target

__all__ = ["ROUTERS"]

HISTORY_ENTRIES: Final = 100
"""Default number of entries of a history."""
PROGRESS_INTERVAL: Final = 0.25
"""Seconds between two progress events of an apply or restore."""

reading = APIRouter(tags=["set-ups and history"])
writing = APIRouter(tags=["set-ups and history"], dependencies=[Depends(require_write)])
ROUTERS: Final = (reading, writing)


# files


@reading.post("/api/files")
async def read_file(body: UploadedFile) -> dict[str, Any]:
    """Parse a parameter file of any format, without names that no vehicle can have. It is not stored."""
    file = await anyio.to_thread.run_sync(partial(body.read, partial=True))
    sets = as_json([SetJson.with_sources(each, {}) for each in file.sets])
    return {"file": file.source, "format": file.file_format, "notes": file.notes, "components": sets}


@reading.get(f"{VEHICLE}/file", response_class=Response)
async def file(
    hub: HubArgument,
    target: TargetArgument,
    file_format: Annotated[FileFormat, Query(alias="format")] = FileFormat.QGC,
    changed: Annotated[bool, Query(description="Only parameters that differ from the defaults.")] = False,
    at: At = None,
) -> Response:
    """Return the parameters as a file. They are fetched first, unless they are in sync."""
    described: dict[str, int | float] = {}
    if at is not None:
        found = await hub.state_at(target, at)
    else:
        found = (await fetch_set(target.component, source=f"link {target.link.name}")).set
        described = {} if target.metadata is None else target.metadata.defaults_of(found)
    if changed:
        found = select_non_defaults(found, described)
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


# set-ups


async def _only_setup(target: TargetArgument) -> AsyncIterator[None]:
    """Run one apply or restore of a component at a time: two would undo each other's changes."""
    try:
        target.setup.acquire_nowait()
    except anyio.WouldBlock:
        raise ServiceError(409, "busy", "Another request is setting up this vehicle.") from None
    try:
        yield
    finally:
        target.setup.release()


@reading.post(f"{VEHICLE}/plan")
async def plan(hub: HubArgument, target: TargetArgument, body: PlanRequest) -> PlanJson:
    """Return which values an apply would write, in which order, and which it would skip, and why."""
    component, wanted = target.component, await _wanted(hub, target, body)
    found = await plan_of(component, wanted, include=body.include, info=target.metadata, force=body.force)
    return PlanJson.of(found, system=component.system, component=component.component)


@writing.post(f"{VEHICLE}/apply", dependencies=[Depends(_only_setup)])
async def apply_(request: Request, hub: HubArgument, target: TargetArgument, body: ApplyRequest) -> ApplyJson:
    """Write the wanted values in a working order, and verify each of them.

    The progress is in the events. If the client disconnects, the apply ends; written values stay.
    """
    wanted = await _wanted(hub, target, body)
    options = body.model_dump(exclude={"values", "file", "at", "only"}) | _context(request, hub, target)
    return _applied(target, await apply(target.component, wanted, **options))


@writing.post(f"{VEHICLE}/restore", dependencies=[Depends(_only_setup)])
async def restore_(
    request: Request, hub: HubArgument, target: TargetArgument, body: RestoreRequest
) -> ApplyJson:
    """Restore an earlier state, with the vehicle's own identity and calibration."""
    if body.at is None:
        state = await hub.read_cache(load_state_before_apply, target)
    else:
        state = await hub.state_at(target, body.at)
    options = body.model_dump(exclude={"at"}) | _context(request, hub, target)
    return _applied(target, await restore(target.component, state, **options))


async def _wanted(hub: Hub, target: Target, body: PlanRequest) -> ParamSet:
    """Return the wanted parameters of a request."""
    if body.file is not None:
        found = await anyio.to_thread.run_sync(body.file.read_set, target)
    elif body.at is not None:
        found = await hub.state_at(target, body.at)
    else:
        found = await values_set(body.values or {}, target)
    return found if body.only is None else found.only(body.only)


def _applied(target: Target, result: ApplyResult) -> ApplyJson:
    return ApplyJson.of(result, VehicleJson.of(target.component))


def _context(request: Request, hub: Hub, target: Target) -> dict[str, Any]:
    """Return the arguments of `apply` and `restore` that are not in the body."""
    progress = _publisher(partial(hub.feed.publish, "setup", **target.address))
    return {"info": target.metadata, "author": author_of(request), "progress": progress}


def _publisher(publish: Callable[..., None]) -> Callable[[ApplyProgress], None]:
    """Return a function that publishes each phase of a set-up, and its progress at an interval."""
    phase, due_at = "", 0.0

    def progress(now: ApplyProgress) -> None:
        nonlocal phase, due_at
        if now.phase != phase or time.monotonic() >= due_at:
            phase, due_at = now.phase, time.monotonic() + PROGRESS_INTERVAL
            publish(phase=now.phase, done=now.done, total=now.total)

    return progress


# the past


@reading.get(f"{VEHICLE}/snapshots")
async def snapshots(hub: HubArgument, target: TargetArgument) -> dict[str, list[SnapshotJson]]:
    """Return the snapshots, the newest last."""
    found = await hub.read_cache(ParamCache.snapshots, target)
    return {"snapshots": [SnapshotJson.of(each) for each in found]}


@writing.post(f"{VEHICLE}/snapshots", status_code=201)
async def create_snapshot(hub: HubArgument, target: TargetArgument, body: SnapshotRequest) -> SnapshotJson:
    """Store a snapshot of the known table."""
    component = target.component
    known = list(component.params.values())
    if not known:
        raise UsageError("no parameter of the vehicle is known")
    table = set_maker(component, f"link {target.link.name}")(known)
    is_whole, crc = len(known) >= (component.count or math.inf), component.hash

    def store(cache: ParamCache, _: str, number: int, **which: bool) -> SnapshotSummary:
        vehicle, reason = component.identity, body.reason
        return cache.store_snapshot(
            vehicle, number, table, reason=reason, hash=crc, complete=is_whole, **which
        )

    return SnapshotJson.of(await hub.read_cache(store, target))


@reading.get(f"{VEHICLE}/history")
async def history(
    hub: HubArgument,
    target: TargetArgument,
    name: Annotated[str | None, Query(max_length=16)] = None,
    limit: Annotated[int, Query(ge=1, le=1_000)] = HISTORY_ENTRIES,
    since: Annotated[AwareDatetime | None, Query(description="Only from this time on.")] = None,
) -> dict[str, list[HistoryLineJson]]:
    """Return the newest changes of values, the newest last."""
    begin = None if since is None else since.timestamp()
    entries = await hub.read_cache(ParamCache.history, target, name, limit, begin)
    return {"history": [HistoryLineJson.of(each) for each in entries]}
