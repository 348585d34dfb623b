"""Routes of earlier states: history and snapshots, of connected components and of all vehicles in the
cache."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any, Final

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from pydantic import Field

from paramclient.cache import HISTORY_ENTRIES_MAX, HistoryEntry
from paramclient.documents.cached import CachedTableDoc, VehicleDoc, VehiclesDoc
from paramclient.documents.document import Body
from paramclient.documents.extended_output import ExtHistoryDoc
from paramclient.documents.history import HistoryDoc, SnapshotDoc, SnapshotsDoc, WholeSnapshotDoc
from paramclient.documents.paramset import SetDoc, StateDoc
from paramclient.files import FileFormat
from paramclient.service.followed_component import FollowedComponent
from paramclient.service.hub import Hub
from paramclient.service.param_sources import (
    EarlierState,
    Timestamp,
    flush_cache,
    load_cached_state,
    load_cached_table,
    load_last_restore_point,
    load_state,
    read_cache,
    require_cache,
    wait_for_key,
)
from paramclient.service.problems import ServiceError
from paramclient.service.request_body import BodyRoute
from paramclient.service.responses import document_response
from paramclient.service.route_context import HubArgument, Target, require_write, run_until_disconnect
from paramclient.service.routes.param_files import Format, From, file_response, parse_state

__all__ = ["router"]

router = APIRouter(prefix="/api/v1", tags=["history"], route_class=BodyRoute)

HISTORY_PAGE_LINES_MAX: Final = 1_000
"""Maximum number of lines of history in a response."""
HISTORY_PAGE_LINES: Final = 100
"""Default number of lines of history in a response."""
Key = Annotated[str, Path(max_length=400, description="Key of the vehicle in /vehicles, percent-encoded.")]
Id = Annotated[int, Path(ge=1, le=255)]
Snapshot = Annotated[int, Path(ge=1, lt=1 << 62)]
Name = Annotated[str | None, Query(max_length=16)]
Limit = Annotated[int, Query(ge=1, le=HISTORY_PAGE_LINES_MAX)]
Since = Annotated[Timestamp | None, Query(description="Only from this time on.")]
Before = Annotated[
    Timestamp | None, Query(description="Only before this time: `before` of the previous response.")
]
At = Annotated[Timestamp, Query(description="Unix seconds, or ISO 8601 with a zone.")]

_FILE: Final[dict[int | str, dict[str, Any]]] = {
    200: {"content": {"application/octet-stream": {}}, "description": "The file"}
}


class SnapshotRequest(Body):
    """Reason of a snapshot."""

    reason: Annotated[str, Field(min_length=1, max_length=200)]


# connected components


@router.get("/components/{system}/{component}/history", response_model=HistoryDoc)
async def history(
    request: Request,
    hub: HubArgument,
    target: Target,
    name: Name = None,
    limit: Limit = HISTORY_PAGE_LINES,
    since: Since = None,
    before: Before = None,
) -> Response:
    """Return the changes of values of a component, the newest last."""
    return await run_until_disconnect(request, lambda: _history(hub, target, name, limit, since, before))


@router.get("/components/{system}/{component}/extended/history", response_model=ExtHistoryDoc)
async def extended_history(
    request: Request,
    hub: HubArgument,
    target: Target,
    name: Name = None,
    limit: Limit = HISTORY_PAGE_LINES,
    since: Since = None,
) -> Response:
    """Return the newest changes of extended parameters of a component, the newest last."""

    async def work() -> Response:
        cache, component = require_cache(hub), target.component.component
        key = await wait_for_key(hub, target)
        lines = await read_cache(hub, lambda: cache.ext_history(key, component, name, limit, since))
        return await document_response(hub.run_in_thread, partial(ExtHistoryDoc.of, lines))

    return await run_until_disconnect(request, work)


@router.get("/components/{system}/{component}/snapshots")
async def snapshots(request: Request, hub: HubArgument, target: Target) -> SnapshotsDoc:
    """Return the snapshots of a component, the newest last."""

    async def work() -> SnapshotsDoc:
        key = await _key(hub, target)
        return await _snapshots(hub, key, target.component.component)

    return await run_until_disconnect(request, work)


@router.post(
    "/components/{system}/{component}/snapshots", status_code=201, dependencies=[Depends(require_write)]
)
async def create_snapshot(
    request: Request, hub: HubArgument, target: Target, body: SnapshotRequest
) -> SnapshotDoc:
    """Create a snapshot of the currently known table of a component."""

    async def work() -> SnapshotDoc:
        cache, key, component = require_cache(hub), await _key(hub, target), target.component.component
        kept = await hub.run_in_thread(lambda: cache.snapshot(key, component, reason=body.reason))
        return SnapshotDoc.of(kept, exact=True)

    return await run_until_disconnect(request, work)


@router.get("/components/{system}/{component}/snapshots/{snapshot}", response_model=WholeSnapshotDoc)
async def one_snapshot(request: Request, hub: HubArgument, target: Target, snapshot: Snapshot) -> Response:
    """Return a snapshot with its parameters."""

    async def work() -> Response:
        return await _snapshot(hub, await _key(hub, target), target.component.component, snapshot)

    return await run_until_disconnect(request, work)


@router.get("/components/{system}/{component}/state", response_model=SetDoc)
async def state_at(request: Request, hub: HubArgument, target: Target, at: At) -> Response:
    """Return the table of a component at a time."""

    async def work() -> Response:
        found = await load_state(hub, target, at)
        return await document_response(hub.run_in_thread, lambda: SetDoc.of(found))

    return await run_until_disconnect(request, work)


@router.post("/components/{system}/{component}/state", response_model=StateDoc)
async def earlier_state(request: Request, hub: HubArgument, target: Target, body: EarlierState) -> Response:
    """Return the state that a restore with the same members writes.

    Of the state before the last apply, also what its restore undoes.
    """

    async def work() -> Response:
        point = await load_last_restore_point(hub, target) if body.when is None else None
        found = await load_state(hub, target, body.when) if point is None else point.state
        return await document_response(hub.run_in_thread, lambda: StateDoc.of(found, point))

    return await run_until_disconnect(request, work)


# vehicles in the cache


@router.get("/vehicles", response_model=VehiclesDoc)
async def vehicles(hub: HubArgument) -> Response:
    """Return all vehicles in the cache with their tables, the last heard first."""
    cache = require_cache(hub)
    await flush_cache(hub)
    known, tables = await hub.run_in_thread(lambda: (cache.vehicles(), cache.components()))
    return await document_response(
        hub.run_in_thread, lambda: VehiclesDoc(vehicles=[VehicleDoc.of(each, tables) for each in known])
    )


@router.get("/vehicles/{key:path}/{component}/params", response_model=CachedTableDoc)
async def kept_params(
    hub: HubArgument,
    key: Key,
    component: Id,
    metadata: Annotated[bool, Query(description="Include the descriptions of the parameters.")] = False,
) -> Response:
    """Return the last known parameters of a vehicle."""
    table = await load_cached_table(hub, key, component)
    store = hub.metadata_store
    known = (
        None
        if store is None
        else await hub.run_in_file_thread(partial(store.known, table.identity, table.component))
    )
    return await document_response(
        hub.run_in_thread, lambda: CachedTableDoc.of(table, metadata=known, whole=metadata, kept=True)
    )


@router.get("/vehicles/{key:path}/{component}/history", response_model=HistoryDoc)
async def kept_history(
    hub: HubArgument,
    key: Key,
    component: Id,
    name: Name = None,
    limit: Limit = HISTORY_PAGE_LINES,
    since: Since = None,
    before: Before = None,
) -> Response:
    """Return the changes of values of a vehicle, the newest last."""
    await load_cached_table(hub, key, component)
    return await _page(hub, key, component, name, limit, since, before)


@router.get("/vehicles/{key:path}/{component}/snapshots")
async def kept_snapshots(hub: HubArgument, key: Key, component: Id) -> SnapshotsDoc:
    """Return the snapshots of a vehicle, the newest last."""
    await load_cached_table(hub, key, component)
    return await _snapshots(hub, key, component)


@router.get("/vehicles/{key:path}/{component}/snapshots/{snapshot}", response_model=WholeSnapshotDoc)
async def kept_snapshot(hub: HubArgument, key: Key, component: Id, snapshot: Snapshot) -> Response:
    """Return a snapshot with its parameters."""
    await load_cached_table(hub, key, component)
    return await _snapshot(hub, key, component, snapshot)


@router.get("/vehicles/{key:path}/{component}/state", response_model=SetDoc)
async def kept_state(hub: HubArgument, key: Key, component: Id, at: At) -> Response:
    """Return the table of a vehicle at a time."""
    found = await load_cached_state(hub, key, component, at)
    return await document_response(hub.run_in_thread, lambda: SetDoc.of(found))


@router.get("/vehicles/{key:path}/{component}/file", responses=_FILE, response_class=Response)
async def kept_file(
    hub: HubArgument, key: Key, component: Id, file_format: Format = FileFormat.QGC, source: From = "known"
) -> Response:
    """Return the parameters of a vehicle as a file: the last known ones if complete, a snapshot, or those at
    a time."""
    when = None if source == "known" else parse_state(source)
    return await file_response(hub, await load_cached_state(hub, key, component, when), file_format)


async def _key(hub: Hub, target: FollowedComponent) -> str:
    """Return the key of a component with a table in the cache, after all received values are in the cache.

    Raises:
        ServiceError: there is no cache, or the cache has no table of the component.
    """
    require_cache(hub)
    key = await wait_for_key(hub, target)
    await load_cached_table(hub, key, target.component.component)
    return key


async def _history(
    hub: Hub,
    target: FollowedComponent,
    name: str | None,
    limit: int,
    since: float | None,
    before: float | None,
) -> Response:
    key = await _key(hub, target)
    return await _page(hub, key, target.component.component, name, limit, since, before)


async def _page(
    hub: Hub,
    key: str,
    component: int,
    name: str | None,
    limit: int,
    since: float | None,
    before: float | None,
) -> Response:
    """Return the newest lines before a time. Lines of one time stay on one page, because the time selects the
    next page."""
    cache = require_cache(hub)
    most = limit + 1 if before is None else HISTORY_ENTRIES_MAX
    lines = await hub.run_in_thread(lambda: cache.history(key, component, name, most, since))
    if before is not None:
        lines = [line for line in lines if line.at < before]
    page = lines[-limit:]
    if len(page) == len(lines):
        return await document_response(hub.run_in_thread, partial(HistoryDoc.of, page, exact=True))
    if before is None and lines[0].at == page[0].at:  # older lines may have the same time
        lines = await hub.run_in_thread(
            lambda: cache.history(key, component, name, HISTORY_ENTRIES_MAX, since)
        )
    oldest = page[0].at
    page = [*_same_moment(lines[: len(lines) - len(page)], oldest), *page]
    if len(page) == len(lines):
        return await document_response(hub.run_in_thread, partial(HistoryDoc.of, page, exact=True))
    return await document_response(hub.run_in_thread, partial(HistoryDoc.of, page, exact=True, before=oldest))


def _same_moment(lines: Sequence[HistoryEntry], at: float) -> Sequence[HistoryEntry]:
    """Return the last lines with this time."""
    count = 0
    while count < len(lines) and lines[-1 - count].at == at:
        count += 1
    return lines[len(lines) - count :]


async def _snapshots(hub: Hub, key: str, component: int) -> SnapshotsDoc:
    cache = require_cache(hub)
    return SnapshotsDoc.of(await hub.run_in_thread(lambda: cache.snapshots(key, component)), exact=True)


async def _snapshot(hub: Hub, key: str, component: int, number: int) -> Response:
    cache = require_cache(hub)
    kept = await hub.run_in_thread(lambda: cache.snapshots(key, component))
    for each in kept:
        if each.id == number:
            found = await load_cached_state(hub, key, component, number)
            return await document_response(hub.run_in_thread, partial(WholeSnapshotDoc.whole, each, found))
    raise ServiceError(404, "unknown-snapshot", f"The component has no snapshot {number}.")
