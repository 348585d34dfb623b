"""Routes of set-ups and of the past: files, plan, apply, restore, snapshots, history."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Annotated, Any, Final

import anyio
import anyio.to_thread
from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import JSONResponse, Response

from paramclient.errors import UsageError
from paramclient.files import FileFormat, dumps, writable
from paramclient.files.formats import ENDINGS
from paramclient.model.identity import autopilot_name
from paramclient.model.paramset import ParamSet
from paramclient.provision import ApplyProgress, apply, prepare, restore
from paramclient.provision.apply_restore import restore_categories
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.restore_point import load_state_before_apply
from paramclient.provision.vehicle_params import fetch_set, load_cached_set, select_non_defaults, set_maker
from paramclient.service import documents
from paramclient.service.access import author_of, require_write
from paramclient.service.hub import Hub
from paramclient.service.problems import ServiceError
from paramclient.service.request_bodies import (
    ApplyRequest,
    PlanRequest,
    RestoreRequest,
    SnapshotRequest,
    Timestamp,
    UploadedFile,
    values_set,
)
from paramclient.service.routes import (
    VEHICLE,
    HubArgument,
    Snapshot,
    SourceArgument,
    TargetArgument,
    run_until_disconnect,
)
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
async def read_file(body: UploadedFile) -> Response:
    """Parse a parameter file of any format, without names that no vehicle can have. It is not stored."""
    return await anyio.to_thread.run_sync(lambda: JSONResponse(documents.param_file(body.read(partial=True))))


@reading.get(f"{VEHICLE}/file", response_class=Response)
async def file(
    request: Request,
    hub: HubArgument,
    source: SourceArgument,
    file_format: Annotated[FileFormat, Query(alias="format")] = FileFormat.QGC,
    changed: Annotated[bool, Query(description="Only parameters that differ from the defaults.")] = False,
    snapshot: Snapshot = None,
) -> Response:
    """Return the parameters as a file. Those of a connected vehicle are fetched first, unless in sync."""
    place, extended, target = (source.key, source.component), source.extended, source.target
    described: dict[str, int | float] = {}
    if snapshot is not None:
        found = await hub.read_cache(lambda cache: cache.state_at(*place, snapshot, extended=extended))
    elif target is None:
        found = await hub.read_cache(lambda cache: load_cached_set(cache, *place, extended=extended))
    else:
        fetch = partial(fetch_set, target.component, source=f"link {target.link.name}")
        found = (await run_until_disconnect(request, fetch)).set
        described = {} if target.metadata is None else target.metadata.defaults_of(found)
    if changed:
        found = select_non_defaults(found, described)
    ending = next((ending for ending, each in ENDINGS.items() if each is file_format), ".txt")
    name = f"{_stem(found)}{ending}"
    found, _ = writable(found, file_format)
    data = await anyio.to_thread.run_sync(lambda: dumps(found, file_format=file_format, target=name))
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    return Response(data, media_type="application/octet-stream", headers=headers)


# set-ups


@reading.post(f"{VEHICLE}/plan")
async def plan(
    request: Request, hub: HubArgument, target: TargetArgument, body: PlanRequest
) -> dict[str, Any]:
    """Return which values an apply would write, in which order, and which it would skip, and why."""

    async def work() -> dict[str, Any]:
        wanted = await _wanted(hub, target, body)
        return await _plan(target, wanted, body.include, force=body.force)

    return await run_until_disconnect(request, work)


@writing.post(f"{VEHICLE}/apply")
async def apply_(
    request: Request, hub: HubArgument, target: TargetArgument, body: ApplyRequest
) -> dict[str, Any]:
    """Write the wanted values in a working order, and verify each of them.

    The progress is in the events. If the client disconnects, the apply ends; written values stay.
    """
    author = author_of(request)

    async def work() -> dict[str, Any]:
        wanted = await _wanted(hub, target, body)
        component, options = target.component, _options(hub, target, body, author)
        result = await apply(
            component, wanted, skip_invalid=body.skip_invalid, durable=body.durable, **options
        )
        return documents.apply_result(result, target)

    with _only_setup(target, author):
        return await run_until_disconnect(request, work)


@writing.post(f"{VEHICLE}/restore")
async def restore_(
    request: Request, hub: HubArgument, target: TargetArgument, body: RestoreRequest
) -> dict[str, Any]:
    """Restore an earlier state, with the vehicle's own identity and calibration; `dry_run` writes nothing."""
    author = author_of(request)

    async def work() -> dict[str, Any]:
        component = target.component
        state = await _earlier_state(hub, target, body.when)
        if body.dry_run:
            categories = await restore_categories(component, state)
            return await _plan(target, state, (*categories, *body.include), force=body.force)
        result = await restore(component, state, **_options(hub, target, body, author))
        return documents.apply_result(result, target)

    with _only_setup(target, author):
        return await run_until_disconnect(request, work)


async def _plan(target: Target, wanted: ParamSet, include: Iterable[str], *, force: bool) -> dict[str, Any]:
    component, info = target.component, target.metadata
    found = await prepare(component, wanted, include=include, info=info, force=force)
    return documents.plan(found, target)


def _options(hub: Hub, target: Target, body: ApplyRequest | RestoreRequest, author: str) -> dict[str, Any]:
    """Return the arguments that `apply` and `restore` have in common."""
    return {
        "include": body.include,
        "info": target.metadata,
        "reboot": body.reboot,
        "allow_armed": body.allow_armed,
        "force": body.force,
        "timeout": body.timeout_s,
        "author": author,
        "progress": _Publisher(hub, target),
    }


# the past


@reading.get(f"{VEHICLE}/snapshots")
async def snapshots(hub: HubArgument, source: SourceArgument) -> dict[str, Any]:
    """Return the snapshots, the newest last."""
    place = source.key, source.component
    return documents.snapshots(
        await hub.read_cache(lambda cache: cache.snapshots(*place, extended=source.extended))
    )


@writing.post(f"{VEHICLE}/snapshots", status_code=201)
async def create_snapshot(hub: HubArgument, target: TargetArgument, body: SnapshotRequest) -> dict[str, Any]:
    """Store a snapshot of the known table."""
    component = target.component
    await wait_for_identity(component)
    if not component.params:
        raise UsageError("no parameter of the vehicle is known")
    table = set_maker(component, f"link {target.link.name}")(list(component.params.values()))
    complete = component.count is not None and len(component.params) >= component.count
    kept = await hub.read_cache(
        lambda cache: cache.store_snapshot(
            component.identity,
            component.component,
            table,
            reason=body.reason,
            hash=component.hash,
            complete=complete,
            extended=component.is_extended,
        )
    )
    return {"id": kept.id}


@reading.get(f"{VEHICLE}/history")
async def history(
    hub: HubArgument,
    source: SourceArgument,
    name: Annotated[str | None, Query(max_length=16)] = None,
    limit: Annotated[int, Query(ge=1, le=1_000)] = HISTORY_ENTRIES,
    since: Annotated[Timestamp | None, Query(description="Only from this time on.")] = None,
) -> Response:
    """Return the newest changes of values, the newest last."""
    which = source.key, source.component, name, limit, since
    entries = await hub.read_cache(lambda cache: cache.history(*which, extended=source.extended))
    return JSONResponse(documents.history(entries))


async def _wanted(hub: Hub, target: Target, body: PlanRequest) -> ParamSet:
    """Return the wanted parameters of a request."""
    upload, snapshot = body.file, body.snapshot
    if upload is not None:
        found = await anyio.to_thread.run_sync(lambda: upload.read_set(target))
    elif snapshot is not None:
        found = await _earlier_state(hub, target, snapshot)
    else:
        found = await values_set(body.values or {}, target)
    return found if body.only is None else found.only(body.only)


async def _earlier_state(hub: Hub, target: Target, when: float | None) -> ParamSet:
    """Return a state of a component from the cache; None for that before the last apply."""
    component = target.component
    await wait_for_identity(component)
    place, extended = (component.identity.key, component.component), component.is_extended
    if when is None:
        return await hub.read_cache(lambda cache: load_state_before_apply(cache, *place, extended=extended))
    return await hub.read_cache(lambda cache: cache.state_at(*place, when, extended=extended))


@contextmanager
def _only_setup(target: Target, author: str) -> Iterator[None]:
    """Run one apply or restore of a component at a time: two would undo each other's changes.

    Raises:
        ServiceError: another one is running.
    """
    setup = target.setup
    if setup.author is not None:
        raise ServiceError(409, "busy", f"{setup.author} is setting up this vehicle already.")
    setup.author = author
    try:
        yield
    finally:
        setup.author = None


class _Publisher:
    """Publishes the progress of an apply or restore: each phase, and values at an interval."""

    def __init__(self, hub: Hub, target: Target) -> None:
        self._hub = hub
        self._target = target
        self._phase = ""
        self._published_at = 0.0

    def __call__(self, progress: ApplyProgress) -> None:
        now = time.monotonic()
        if progress.phase == self._phase and now < self._published_at + PROGRESS_INTERVAL:
            return
        self._phase, self._published_at = progress.phase, now
        members = {"phase": progress.phase, "done": progress.done, "total": progress.total}
        self._hub.feed.publish("setup", **self._target.address, **members)


def _stem(params: ParamSet) -> str:
    """Return a file name with firmware, ids and time, in characters that are safe in headers and files."""
    autopilot = "params" if params.identity is None else autopilot_name(params.identity.autopilot)
    ids = [str(each) for each in (params.system, params.component) if each is not None]
    at = time.strftime("%Y%m%d-%H%M%S", time.gmtime(time.time() if params.at is None else params.at))
    return re.sub(r"[^A-Za-z0-9._-]", "_", "-".join([autopilot, *ids, at]))[:100]
