"""What was: history, snapshots and earlier states, of who is heard and of everyone in the cache."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any, Final

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from pydantic import Field, model_validator

from paramclient.cache import HISTORY_LINES, CutOff, HistoryEntry
from paramclient.documents.cached import CachedTableDoc, VehicleDoc, VehiclesDoc
from paramclient.documents.document import Body, InParts
from paramclient.documents.fleet import FleetDiffDoc, NameSpreadDoc
from paramclient.documents.history import HistoryDoc, SnapshotDoc, SnapshotsDoc, WholeSnapshotDoc
from paramclient.documents.paramset import SetDoc
from paramclient.errors import UsageError
from paramclient.files import FileForm
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import check_name
from paramclient.service.answering import JSON, document_answer, written_out
from paramclient.service.followed_component import Followed
from paramclient.service.hub import Hub
from paramclient.service.param_sources import (
    FewPatterns,
    GivenFile,
    Moment,
    cached,
    key_of,
    known_to,
    parsed,
    past,
    state,
    the_cache,
    written,
)
from paramclient.service.problems import ServiceError
from paramclient.service.reading import BodyRoute, long_request
from paramclient.service.route_context import Target, TheHub, answered, may_write
from paramclient.service.routes.param_files import Form, From, attachment, moment

__all__ = ["router"]

router = APIRouter(prefix="/api/v1", tags=["history"], route_class=BodyRoute)

LONGEST_PAGE: Final = 1_000
"""Lines of history in one answer."""
A_PAGE: Final = 100
MOST_NAMES: Final = 1_000
"""Names and patterns that a fleet is compared in."""
MOST_CELLS: Final = 250_000
"""Names times vehicles of one comparison of a fleet: its answer has up to 30 MB."""

Key = Annotated[str, Path(max_length=400, description="As /vehicles names it, percent-encoded.")]
Id = Annotated[int, Path(ge=1, le=255)]
Snapshot = Annotated[int, Path(ge=1, lt=1 << 62)]
Name = Annotated[str | None, Query(max_length=16)]
Limit = Annotated[int, Query(ge=1, le=LONGEST_PAGE)]
Since = Annotated[Moment | None, Query(description="From this time on only.")]
Before = Annotated[Moment | None, Query(description="Before this time only: `before` of the last answer.")]
At = Annotated[Moment, Query(description="Unix seconds, or ISO 8601 with a zone.")]

_FILE: Final[dict[int | str, dict[str, Any]]] = {
    200: {"content": {"application/octet-stream": {}}, "description": "The file"}
}


class SetDown(Body):
    """What a snapshot is for, in words."""

    reason: Annotated[str, Field(min_length=1, max_length=200)]


class FleetCompared(Body):
    """What all vehicles are compared in: names and patterns, or what a file or values want of them."""

    names: (
        Annotated[
            tuple[Annotated[str, Field(min_length=1, max_length=64)], ...],
            Field(max_length=MOST_NAMES, fail_fast=True),
            FewPatterns,
        ]
        | None
    ) = None
    file: GivenFile | None = None
    values: Annotated[dict[str, int | float], InParts, Field(min_length=1, max_length=MOST_NAMES)] | None = (
        None
    )
    component: Annotated[int, Field(ge=1, le=255)] | None = None

    @model_validator(mode="after")
    def _is_one(self) -> FleetCompared:
        if sum(each is not None for each in (self.names, self.file, self.values)) != 1:
            raise ValueError("vehicles are compared either in names, with a file, or with values")
        return self


# of who is heard


@router.get("/components/{system}/{component}/history", response_model=HistoryDoc)
async def history(
    request: Request,
    hub: TheHub,
    target: Target,
    name: Name = None,
    limit: Limit = A_PAGE,
    since: Since = None,
    before: Before = None,
) -> Response:
    """How the values of a component have changed, the newest last."""
    return await answered(request, lambda: _history(hub, target, name, limit, since, before))


@router.get("/components/{system}/{component}/snapshots")
async def snapshots(request: Request, hub: TheHub, target: Target) -> SnapshotsDoc:
    """What was set down of a component's table, the newest last."""

    async def work() -> SnapshotsDoc:
        key = await _key(hub, target)
        return await _snapshots(hub, key, target.component.component)

    return await answered(request, work)


@router.post("/components/{system}/{component}/snapshots", status_code=201, dependencies=[Depends(may_write)])
async def set_down(request: Request, hub: TheHub, target: Target, body: SetDown) -> SnapshotDoc:
    """Set the table of a component down as it is known now, to have it again however it changes."""

    async def work() -> SnapshotDoc:
        cache, key, component = the_cache(hub), await _key(hub, target), target.component.component
        kept = await hub.aside(lambda: cache.snapshot(key, component, reason=body.reason))
        return SnapshotDoc.of(kept, exact=True)

    return await answered(request, work)


@router.get("/components/{system}/{component}/snapshots/{snapshot}", response_model=WholeSnapshotDoc)
async def one_snapshot(request: Request, hub: TheHub, target: Target, snapshot: Snapshot) -> Response:
    """A snapshot with its parameters."""

    async def work() -> Response:
        return await _snapshot(hub, await _key(hub, target), target.component.component, snapshot)

    return await answered(request, work)


@router.get("/components/{system}/{component}/state", response_model=SetDoc)
async def state_at(request: Request, hub: TheHub, target: Target, at: At) -> Response:
    """The table of a component as it was at a time."""

    async def work() -> Response:
        found = await state(hub, target, at)
        return await document_answer(hub.aside, lambda: SetDoc.of(found))

    return await answered(request, work)


# of everyone in the cache


@router.get("/vehicles", response_model=VehiclesDoc)
async def vehicles(hub: TheHub) -> Response:
    """Every vehicle that was ever heard, the one heard last first, with what is kept of it."""
    cache = the_cache(hub)
    await written(hub)
    known, tables = await hub.aside(lambda: (cache.vehicles(), cache.components()))
    return await document_answer(
        hub.aside, lambda: VehiclesDoc(vehicles=[VehicleDoc.of(each, tables) for each in known])
    )


@router.get("/vehicles/{key:path}/{component}/params", response_model=CachedTableDoc)
async def kept_params(hub: TheHub, key: Key, component: Id) -> Response:
    """The parameters of a vehicle as they were last known."""
    table = await cached(hub, key, component)
    return await document_answer(hub.aside, lambda: CachedTableDoc.of(table, kept=True))


@router.get("/vehicles/{key:path}/{component}/history", response_model=HistoryDoc)
async def kept_history(
    hub: TheHub,
    key: Key,
    component: Id,
    name: Name = None,
    limit: Limit = A_PAGE,
    since: Since = None,
    before: Before = None,
) -> Response:
    """How its values have changed, the newest last."""
    await cached(hub, key, component)
    return await _page(hub, key, component, name, limit, since, before)


@router.get("/vehicles/{key:path}/{component}/snapshots")
async def kept_snapshots(hub: TheHub, key: Key, component: Id) -> SnapshotsDoc:
    """What was set down of its table, the newest last."""
    await cached(hub, key, component)
    return await _snapshots(hub, key, component)


@router.get("/vehicles/{key:path}/{component}/snapshots/{snapshot}", response_model=WholeSnapshotDoc)
async def kept_snapshot(hub: TheHub, key: Key, component: Id, snapshot: Snapshot) -> Response:
    """A snapshot with its parameters."""
    await cached(hub, key, component)
    return await _snapshot(hub, key, component, snapshot)


@router.get("/vehicles/{key:path}/{component}/state", response_model=SetDoc)
async def kept_state(hub: TheHub, key: Key, component: Id, at: At) -> Response:
    """Its table as it was at a time."""
    found = await past(hub, key, component, at)
    return await document_answer(hub.aside, lambda: SetDoc.of(found))


@router.get("/vehicles/{key:path}/{component}/file", responses=_FILE, response_class=Response)
async def kept_file(
    hub: TheHub, key: Key, component: Id, form: Form = FileForm.QGC, source: From = "known"
) -> Response:
    """Its parameters as a file: as last known, if that is all of them, of a snapshot, or of a time."""
    when = None if source == "known" else moment(source)
    return await attachment(hub, await past(hub, key, component, when), form)


@router.post("/fleet/diff", response_model=FleetDiffDoc)
async def fleet_diff(request: Request, hub: TheHub, body: FleetCompared) -> Response:
    """Compare all vehicles in the cache: in some parameters with each other, or with what is wanted."""
    with long_request(request):
        return await _fleet_diff(hub, body)


async def _fleet_diff(hub: Hub, body: FleetCompared) -> Response:
    cache = the_cache(hub)
    wanted: ParamSet | tuple[str, ...]
    if body.file is not None:
        wanted = (await parsed(hub, body.file.read)).choose(body.component)
    elif body.values is not None:
        wanted = ParamSet(
            {name: WrittenParam(check_name(name), value) for name, value in body.values.items()}
        )
    else:
        wanted = tuple(map(check_name, body.names or ()))
        if not wanted:
            raise UsageError("name the parameters to compare")
    await written(hub)
    await hub.aside(cache.components)  # whether it can be read at all
    found = await known_to(hub, lambda: cache.fleet_diff(wanted, component=body.component))
    cells = len(found.names) * len(found.vehicles)
    if cells > MOST_CELLS:
        few = MOST_CELLS // len(found.vehicles)
        what = f"Of {len(found.vehicles)} vehicles, {few} names may be compared at once, not more."
        raise ServiceError(413, "too-large", what, most=MOST_CELLS)
    spreads = (NameSpreadDoc.of(each) for each in found.names)
    head = FleetDiffDoc(
        component=found.component, vehicles=len(found.vehicles), different=found.differs, names=[]
    )
    return Response(await hub.read_aside(lambda: written_out(head, names=spreads)), media_type=JSON)


async def _key(hub: Hub, target: Followed) -> str:
    """The key under which a component is kept, when all that was heard of it is on the disk.

    Raises:
        ServiceError: there is no cache, or nothing of it in there yet.
    """
    the_cache(hub)
    key = await key_of(hub, target)
    await cached(hub, key, target.component.component)
    return key


async def _history(
    hub: Hub, target: Followed, name: str | None, limit: int, since: float | None, before: float | None
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
    """The newest lines before a time; those of one moment stay together, as that tells the next page."""
    cache = the_cache(hub)
    most = limit + 1 if before is None else HISTORY_LINES
    lines = await hub.aside(lambda: cache.history(key, component, name, most, since))
    if before is not None:
        lines = [line for line in lines if line.at < before]
    page = lines[-limit:]
    told = [] if name is not None else await _cut_off(hub, key, component, since, before)
    if len(page) == len(lines):
        return await document_answer(hub.aside, partial(HistoryDoc.of, page, exact=True, cut_off=told))
    if before is None and lines[0].at == page[0].at:  # there may be more of them
        lines = await hub.aside(lambda: cache.history(key, component, name, HISTORY_LINES, since))
    oldest = page[0].at
    page = [*_same_moment(lines[: len(lines) - len(page)], oldest), *page]
    if len(page) == len(lines):
        return await document_answer(hub.aside, partial(HistoryDoc.of, page, exact=True, cut_off=told))
    told = [note for note in told if note.at >= oldest]
    return await document_answer(
        hub.aside, partial(HistoryDoc.of, page, exact=True, before=oldest, cut_off=told)
    )


async def _cut_off(
    hub: Hub, key: str, component: int, since: float | None, before: float | None
) -> list[CutOff]:
    """The set-ups of a component that were cut off in a time."""
    begin, end = -math.inf if since is None else since, math.inf if before is None else before
    return [
        note
        for note in await hub.cut_off()
        if (note.key, note.component) == (key, component) and begin <= note.at < end
    ]


def _same_moment(lines: Sequence[HistoryEntry], at: float) -> Sequence[HistoryEntry]:
    """The last lines that are all of one moment."""
    count = 0
    while count < len(lines) and lines[-1 - count].at == at:
        count += 1
    return lines[len(lines) - count :]


async def _snapshots(hub: Hub, key: str, component: int) -> SnapshotsDoc:
    cache = the_cache(hub)
    return SnapshotsDoc.of(await hub.aside(lambda: cache.snapshots(key, component)), exact=True)


async def _snapshot(hub: Hub, key: str, component: int, number: int) -> Response:
    cache = the_cache(hub)
    kept = await hub.aside(lambda: cache.snapshots(key, component))
    for each in kept:
        if each.id == number:
            found = await past(hub, key, component, number)
            return await document_answer(hub.aside, partial(WholeSnapshotDoc.whole, each, found))
    raise ServiceError(404, "unknown-snapshot", f"There is no snapshot {number} of it.")
