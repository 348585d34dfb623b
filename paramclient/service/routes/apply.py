"""Routes of set-ups: comparing, planning, verifying, applying, restoring."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Final, TypeVar

import anyio
from fastapi import APIRouter, Depends, Request, Response

from paramclient.documents.diff import DiffDoc
from paramclient.documents.document import Body, Document
from paramclient.documents.job import JobDoc
from paramclient.documents.receiver import ReceiverDoc
from paramclient.documents.setup import ApplyProgressDoc, ApplyResultDoc, InterruptedDoc, PlanDoc, VerifiedDoc
from paramclient.errors import NoReply
from paramclient.metadata import Metadata
from paramclient.model.comparison import compare
from paramclient.model.paramset import ParamSet
from paramclient.provision import ApplyProgress, ApplyResult, ApplyRow, Plan, apply, overlay, prepare, restore
from paramclient.provision.apply_restore import restore_categories
from paramclient.provision.vehicle_params import FetchedSet, collect_defaults, fetch_set
from paramclient.service.followed_component import FollowedComponent
from paramclient.service.hub import Hub
from paramclient.service.jobs import FETCHES, Job, Kind
from paramclient.service.param_sources import (
    EarlierState,
    Patterns,
    UploadedRenames,
    WantedParams,
    current_set,
    load_state,
    read_renames,
    resolve_source,
)
from paramclient.service.problems import ServiceError, problem_of
from paramclient.service.request_body import BodyRoute, long_request
from paramclient.service.responses import JSON, document_response, encode_document
from paramclient.service.route_context import (
    HubArgument,
    Seconds,
    Target,
    author_of,
    holder_of,
    require_write,
    run_until_disconnect,
)
from paramclient.service.routes.fetches import job_response, wait_for_job

__all__ = ["router"]

router = APIRouter(prefix="/api/v1/components/{system}/{component}", tags=["set-ups"], route_class=BodyRoute)

SETUP_PROGRESS_INTERVAL: Final = 0.25
"""Seconds between two progress events of a set-up."""

Result = TypeVar("Result")


class DiffRequest(Body):
    """Parameters to compare with those of a component; `known` compares without requests to the vehicle.

    With `renames`, a parameter that only one side has is compared with the parameter of its other name.
    """

    wanted: WantedParams
    base: WantedParams | None = None
    renames: UploadedRenames | None = None
    only: Patterns = ()
    partial: bool = False
    full: bool = False
    known: bool = False
    timeout_s: Seconds = None


class PlanRequest(Body):
    """Wanted parameters: those of `wanted`, overlaid by `over`, limited to `only`.

    With `renames`, a parameter that the vehicle has under another name gets the value under that name.
    """

    wanted: WantedParams
    over: WantedParams | None = None
    renames: UploadedRenames | None = None
    only: Patterns = ()
    include: Patterns = ()
    force: bool = False
    full: bool = False
    timeout_s: Seconds = None


class ApplyRequest(PlanRequest):
    """Wanted parameters with options; see `paramclient.provision.apply`."""

    reboot: bool = False
    allow_armed: bool = False
    skip_invalid: bool = False
    durable: bool = False
    dry_run: bool = False
    wait: bool = True


class RestorePlanRequest(EarlierState):
    """The state to restore."""

    include: Patterns = ()
    force: bool = False
    full: bool = False
    timeout_s: Seconds = None


class RestoreRequest(RestorePlanRequest):
    """The state to restore, with options."""

    reboot: bool = False
    allow_armed: bool = False
    dry_run: bool = False
    wait: bool = True


@router.post("/diff", response_model=DiffDoc)
async def diff(request: Request, hub: HubArgument, target: Target, body: DiffRequest) -> Response:
    """Compare given parameters (left) with those of a component (right)."""
    with long_request(request):
        return await run_until_disconnect(request, lambda: _diff(hub, target, body), target)


@router.post("/plan", response_model=PlanDoc)
async def plan(request: Request, hub: HubArgument, target: Target, body: PlanRequest) -> Response:
    """Return which values a set-up would write, in which order, and which it would skip. Nothing is
    written."""
    return await _planned(request, hub, target, body, PlanDoc)


@router.post("/verify", response_model=VerifiedDoc)
async def verify(request: Request, hub: HubArgument, target: Target, body: PlanRequest) -> Response:
    """Compare a component with its wanted parameters. Nothing is written."""
    return await _planned(request, hub, target, body, VerifiedDoc)


@router.post(
    "/apply",
    response_model=ApplyResultDoc | PlanDoc,
    responses={202: {"model": JobDoc, "description": "The started job"}},
    dependencies=[Depends(require_write)],
)
async def apply_(
    request: Request, hub: HubArgument, target: Target, body: ApplyRequest
) -> Document | Response:
    """Write the wanted values in a working order, and verify each of them.

    With `wait`, a disconnect of the client cancels the set-up; without, it continues.
    """
    if body.dry_run:
        return await plan(request, hub, target, body)
    author = author_of(request)

    async def work(publish_progress: Callable[[ApplyProgress], None]) -> ApplyResult:
        return await apply(
            target.component,
            await _wanted(hub, target, body),
            include=body.include,
            info=target.metadata,
            reboot=body.reboot,
            allow_armed=body.allow_armed,
            skip_invalid=body.skip_invalid,
            force=body.force,
            renames=await read_renames(hub, body.renames),
            durable=body.durable,
            timeout=body.timeout_s,
            author=author,
            progress=publish_progress,
        )

    job = _begin(hub, "apply", target, request, work, full=body.full)
    return await _result(request, job, waits=body.wait)


@router.post(
    "/restore",
    response_model=ApplyResultDoc | PlanDoc,
    responses={202: {"model": JobDoc, "description": "The started job"}},
    dependencies=[Depends(require_write)],
)
async def restore_(
    request: Request, hub: HubArgument, target: Target, body: RestoreRequest
) -> Document | Response:
    """Restore an earlier state of a component, with its own identity and calibration."""
    if body.dry_run:
        return await plan_restore(request, hub, target, body)
    author = author_of(request)

    async def work(publish_progress: Callable[[ApplyProgress], None]) -> ApplyResult:
        return await restore(
            target.component,
            await load_state(hub, target, body.when),
            include=body.include,
            info=target.metadata,
            reboot=body.reboot,
            allow_armed=body.allow_armed,
            force=body.force,
            timeout=body.timeout_s,
            author=author,
            progress=publish_progress,
        )

    job = _begin(hub, "restore", target, request, work, full=body.full)
    return await _result(request, job, waits=body.wait)


@router.post("/restore/plan", response_model=PlanDoc)
async def plan_restore(
    request: Request, hub: HubArgument, target: Target, body: RestorePlanRequest
) -> Response:
    """Return which values a restore would write, and which it would skip. Nothing is written."""
    return await _plan_response(
        request, hub, target, lambda: _plan_back(hub, target, body), PlanDoc, full=body.full
    )


async def _diff(hub: Hub, target: FollowedComponent, body: DiffRequest) -> Response:
    left = await resolve_source(hub, target, body.wanted)
    base = None
    if body.base is not None and not body.base.defaults:
        base = await resolve_source(hub, target, body.base)
    right = await _present(hub, target, body)
    renames = await read_renames(hub, body.renames)
    known, whole = left, right
    if renames is not None:
        known = await hub.run_in_file_thread(lambda: renames.apply_to(left, whole))
    has_defaults = body.base is not None and body.base.defaults is not None
    sets = [left, right] if base is None else [left, right, base]
    described = await _described(hub, target, sets)
    found = [*described, described[0] or described[1]][:3]
    if has_defaults:
        compared = [known, whole]

        def defaults() -> ParamSet:
            more = [
                {} if each is None else each.defaults_of(names)
                for each, names in zip(described, compared, strict=True)
            ]
            return collect_defaults(compared, more)

        base = await hub.run_in_file_thread(defaults)
    if body.partial:
        right = await hub.run_in_file_thread(
            lambda: replace(whole, params={name: each for name, each in whole.items() if name in known})
        )

    def encode() -> bytes:
        """Compare, and encode row by row: a full garbage collection of all rows would block every thread."""
        outcome = compare(left, right, base=base, names=body.only or None, renames=renames)
        rows = DiffDoc.rows(outcome, *found, everything=body.full, has_defaults=has_defaults)
        return encode_document(DiffDoc.without_params(outcome), params=rows)

    return Response(await hub.run_in_file_thread(encode), media_type=JSON)


async def _present(hub: Hub, target: FollowedComponent, body: DiffRequest) -> ParamSet:
    """Return the current parameters of the component."""
    if body.known:
        return (await current_set(target, hub.run_in_file_thread)).set
    source = f"link {target.link.name}"

    async def work() -> FetchedSet:
        return await fetch_set(target.component, source=source)

    return (await _within(target, body.timeout_s, work)).set


async def _described(hub: Hub, target: FollowedComponent, sets: list[ParamSet]) -> list[Metadata | None]:
    """Return the descriptions for each set: those of its firmware, else of the component."""
    store = hub.metadata_store
    if store is None:
        return [target.metadata] * len(sets)
    known = await hub.run_in_file_thread(lambda: store.known_of_sets(sets))
    return [each or target.metadata for each in known]


async def _wanted(hub: Hub, target: FollowedComponent, body: PlanRequest) -> ParamSet:
    """Return the wanted parameters."""
    found = await resolve_source(hub, target, body.wanted)
    if body.over is not None:
        found = overlay(found, await resolve_source(hub, target, body.over))
    whole = found
    return await hub.run_in_file_thread(lambda: whole.only(body.only)) if body.only else whole


async def _planned(
    request: Request,
    hub: Hub,
    target: FollowedComponent,
    body: PlanRequest,
    kind: type[PlanDoc] | type[VerifiedDoc],
) -> Response:
    """Return the response with the plan, as a document of this kind."""
    return await _plan_response(request, hub, target, lambda: _plan(hub, target, body), kind, full=body.full)


async def _plan_response(
    request: Request,
    hub: Hub,
    target: FollowedComponent,
    plan: Callable[[], Awaitable[Plan]],
    kind: type[PlanDoc] | type[VerifiedDoc],
    *,
    full: bool,
) -> Response:
    system, component = target.address

    async def work() -> Response:
        found = await plan()
        return await document_response(
            hub.run_in_file_thread,
            lambda: kind.of(found, system=system, component=component, full=full),
        )

    with long_request(request):
        return await run_until_disconnect(request, work, target)


async def _plan(hub: Hub, target: FollowedComponent, body: PlanRequest) -> Plan:
    wanted = await _wanted(hub, target, body)
    renames = await read_renames(hub, body.renames)

    async def work() -> Plan:
        return await prepare(
            target.component,
            wanted,
            include=body.include,
            info=target.metadata,
            force=body.force,
            renames=renames,
        )

    return await _within(target, body.timeout_s, work)


async def _plan_back(hub: Hub, target: FollowedComponent, body: RestorePlanRequest) -> Plan:
    earlier = await load_state(hub, target, body.when)

    async def work() -> Plan:
        include = (*await restore_categories(target.component, earlier), *body.include)
        info = target.metadata
        return await prepare(
            target.component,
            earlier,
            include=include,
            info=info,
            force=body.force,
        )

    return await _within(target, body.timeout_s, work)


async def _within(
    target: FollowedComponent, timeout: float | None, work: Callable[[], Awaitable[Result]]
) -> Result:
    """Run work with a timeout.

    Raises:
        NoReply: the timeout has expired.
    """
    with anyio.move_on_after(timeout):
        return await work()
    system, component = target.address
    raise NoReply(f"the parameters of {system}/{component}", attempts=0, waited=timeout or 0.0)


def _begin(
    hub: Hub,
    kind: Kind,
    target: FollowedComponent,
    request: Request,
    work: Callable[[Callable[[ApplyProgress], None]], Awaitable[ApplyResult]],
    *,
    full: bool,
) -> Job:
    """Start a set-up as a job; one at a time for each component, because two would undo each other's changes.

    Raises:
        ServiceError: a set-up of the component is running, or too many jobs are running.
    """
    for other in hub.jobs.all:
        if other.state == "running" and other.kind not in FETCHES and other.followed is target:
            what = f"{other.requested_by} is already setting up this component in job {other.id}."
            raise ServiceError(409, "busy", what, job=other.id)
    system, component = target.address

    async def run(job: Job) -> Document:
        rows: dict[str, ApplyRow] = {}
        published_at, published_phase = -SETUP_PROGRESS_INTERVAL, ""

        def publish_progress(progress: ApplyProgress) -> None:
            nonlocal published_at, published_phase
            if progress.row is not None:
                rows[progress.row.name] = progress.row.so_far
            job.progress = ApplyProgressDoc.of(progress)
            now = anyio.current_time()
            if progress.phase != published_phase or now >= published_at + SETUP_PROGRESS_INTERVAL:
                published_at, published_phase = now, progress.phase
                hub.jobs.publish(job)

        try:
            result = await work(publish_progress)
        except anyio.get_cancelled_exc_class():
            job.result = InterruptedDoc.of(rows.values(), system=system, component=component)
            raise
        vehicle = ReceiverDoc.at(system, component, target.component.identity)
        problem = None if result.error is None else problem_of(result.error)
        return ApplyResultDoc.of(
            result, system=system, component=component, full=full, vehicle=vehicle, problem=problem
        )

    return hub.jobs.start(kind, target, run, author_of(request), holder_of(request))


async def _result(request: Request, job: Job, *, waits: bool) -> Document | Response:
    if not waits:
        return job_response(job)
    result = await wait_for_job(request, job)
    assert isinstance(result, ApplyResultDoc)
    return result
