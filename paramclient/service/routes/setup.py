"""Set-ups: how a component compares, what would be sent to it, and sending that."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Final, TypeVar

import anyio
from fastapi import APIRouter, Depends, Request, Response
from pydantic import model_validator

from paramclient.documents.diff import DiffDoc
from paramclient.documents.document import Body, Document
from paramclient.documents.job import JobDoc
from paramclient.documents.setup import ApplyProgressDoc, ApplyResultDoc, InterruptedDoc, PlanDoc, VerifiedDoc
from paramclient.errors import NoReply, UsageError
from paramclient.metadata import Metadata, MetadataStore
from paramclient.model.comparison import compare, defaults_of
from paramclient.model.paramset import ParamSet
from paramclient.provision import ApplyProgress, ApplyResult, ApplyRow, Plan, apply, overlay, prepare, restore
from paramclient.provision.set_up import restore_categories
from paramclient.provision.vehicle_params import NO_DEFAULTS, FetchedSet, fetch_set
from paramclient.service.answering import JSON, document_answer, written_out
from paramclient.service.followed_component import Followed
from paramclient.service.hub import Hub
from paramclient.service.jobs import Job, Kind
from paramclient.service.param_sources import Moment, Number, Patterns, Source, known_set, resolved, state
from paramclient.service.problems import ServiceError
from paramclient.service.reading import BodyRoute, long_request
from paramclient.service.route_context import (
    Seconds,
    Target,
    TheHub,
    answered,
    asker_of,
    holder_of,
    may_write,
)
from paramclient.service.routes.fetches import accepted, awaited

__all__ = ["router"]

router = APIRouter(prefix="/api/v1/components/{system}/{component}", tags=["set-ups"], route_class=BodyRoute)

PROGRESS_INTERVAL: Final = 0.25
"""Seconds between two events that tell how far a set-up is."""

Result = TypeVar("Result")


class Compared(Body):
    """What to hold a component against; `known` is without asking the vehicle for anything."""

    wanted: Source
    base: Source | None = None
    only: Patterns = ()
    partial: bool = False
    full: bool = False
    known: bool = False
    timeout_s: Seconds = None


class Wanted(Body):
    """What a component shall have: of `wanted`, with `over` laid over it, what `only` names."""

    wanted: Source
    over: Source | None = None
    only: Patterns = ()
    include: Patterns = ()
    force: bool = False
    full: bool = False
    timeout_s: Seconds = None


class Applied(Wanted):
    """The same, and how it is to be brought there; see `paramclient.provision.apply`."""

    reboot: bool = False
    allow_armed: bool = False
    skip_invalid: bool = False
    durable: bool = False
    dry_run: bool = False
    wait: bool = True


class Restored(Body):
    """Which state is to come back: of a snapshot, of a time, or with neither that before the last apply."""

    snapshot: Number | None = None
    at: Moment | None = None
    include: Patterns = ()
    reboot: bool = False
    allow_armed: bool = False
    force: bool = False
    dry_run: bool = False
    full: bool = False
    wait: bool = True
    timeout_s: Seconds = None

    @model_validator(mode="after")
    def _is_one(self) -> Restored:
        if self.snapshot is not None and self.at is not None:
            raise ValueError("a state is that of a snapshot or of a time, not of both")
        return self

    @property
    def when(self) -> int | float | None:
        """The snapshot's number, a time, or None."""
        return self.at if self.snapshot is None else self.snapshot


@router.post("/diff", response_model=DiffDoc)
async def diff(request: Request, hub: TheHub, target: Target, body: Compared) -> Response:
    """Compare parameters, as the left side, with those of a component, as the right one."""
    with long_request(request):
        return await answered(request, lambda: _diff(hub, target, body), target)


@router.post("/plan", response_model=PlanDoc)
async def plan(request: Request, hub: TheHub, target: Target, body: Wanted) -> Response:
    """Work out what a set-up would send, in which order, and what not and why. Nothing is written."""
    system, component = target.address

    async def work() -> Response:
        found = await _plan(hub, target, body)
        return await document_answer(
            hub.read_aside, lambda: PlanDoc.of(found, system=system, component=component, full=body.full)
        )

    with long_request(request):
        return await answered(request, work, target)


@router.post("/verify", response_model=VerifiedDoc)
async def verify(request: Request, hub: TheHub, target: Target, body: Wanted) -> Response:
    """Compare a component with what it should have. Nothing is written."""
    system, component = target.address

    async def work() -> Response:
        found = await _plan(hub, target, body)
        return await document_answer(
            hub.read_aside, lambda: VerifiedDoc.of(found, system=system, component=component, full=body.full)
        )

    with long_request(request):
        return await answered(request, work, target)


@router.post(
    "/apply",
    response_model=ApplyResultDoc | PlanDoc,
    responses={202: {"model": JobDoc, "description": "It is under way"}},
    dependencies=[Depends(may_write)],
)
async def apply_(request: Request, hub: TheHub, target: Target, body: Applied) -> Document | Response:
    """Bring a component to the wanted values, in an order that works, and prove each of them.

    Whoever waits for it and leaves ends it; with `wait` false it goes on.
    """
    if body.dry_run:
        return await plan(request, hub, target, body)
    asker = asker_of(request)

    async def work(tell: Callable[[ApplyProgress], None]) -> ApplyResult:
        return await apply(
            target.component,
            await _wanted(hub, target, body),
            include=body.include,
            info=target.metadata,
            reboot=body.reboot,
            allow_armed=body.allow_armed,
            skip_invalid=body.skip_invalid,
            force=body.force,
            durable=body.durable,
            timeout=body.timeout_s,
            asker=asker,
            progress=tell,
        )

    job = _begin(hub, "apply", target, request, work, full=body.full)
    return await _result(request, job, waits=body.wait)


@router.post(
    "/restore",
    response_model=ApplyResultDoc | PlanDoc,
    responses={202: {"model": JobDoc, "description": "It is under way"}},
    dependencies=[Depends(may_write)],
)
async def restore_(request: Request, hub: TheHub, target: Target, body: Restored) -> Document | Response:
    """Bring an earlier state of a component back, with its own identity and calibration."""
    asker = asker_of(request)
    if body.dry_run:
        with long_request(request):
            found = await answered(request, lambda: _plan_back(hub, target, body), target)
        system, component = target.address
        return PlanDoc.of(found, system=system, component=component, full=body.full)

    async def work(tell: Callable[[ApplyProgress], None]) -> ApplyResult:
        return await restore(
            target.component,
            await state(hub, target, body.when),
            include=body.include,
            info=target.metadata,
            reboot=body.reboot,
            allow_armed=body.allow_armed,
            force=body.force,
            timeout=body.timeout_s,
            asker=asker,
            progress=tell,
        )

    job = _begin(hub, "restore", target, request, work, full=body.full)
    return await _result(request, job, waits=body.wait)


async def _diff(hub: Hub, target: Followed, body: Compared) -> Response:
    left = await resolved(hub, target, body.wanted)
    base = None
    if body.base is not None and not body.base.defaults:
        base = await resolved(hub, target, body.base)
    right = await _present(hub, target, body)
    if body.base is not None and body.base.defaults:
        base = await hub.read_aside(lambda: defaults_of(left, right))
        if not base:
            raise UsageError(NO_DEFAULTS)
    if body.partial:
        whole = right
        right = await hub.read_aside(
            lambda: replace(whole, params={name: each for name, each in whole.items() if name in left})
        )
    sets = [left, right] if base is None else [left, right, base]
    found = [*await _described(hub, target, sets), None][:3]

    def write() -> bytes:
        """Compare and write row by row: a full garbage collection of all rows would block every thread."""
        outcome = compare(left, right, base=base, names=body.only or None)
        rows = DiffDoc.rows(outcome, *found, everything=body.full)
        return written_out(DiffDoc.without_params(outcome), params=rows)

    return Response(await hub.read_aside(write), media_type=JSON)


async def _present(hub: Hub, target: Followed, body: Compared) -> ParamSet:
    """What the component has now."""
    if body.known:
        return (await known_set(target, hub.read_aside)).set
    source = f"link {target.line.name}"

    async def work() -> FetchedSet:
        return await fetch_set(target.component, source=source, run=hub.read_aside)

    return (await _within(target, body.timeout_s, work)).set


async def _described(hub: Hub, target: Followed, sets: list[ParamSet]) -> list[Metadata | None]:
    """What is known of the parameters of each set: for its firmware, else of the component."""
    cache = hub.cache
    if cache is None:
        return [target.metadata] * len(sets)
    store = MetadataStore.beside(cache.path)
    return [each or target.metadata for each in await hub.aside(lambda: store.known_of_sets(sets))]


async def _wanted(hub: Hub, target: Followed, body: Wanted) -> ParamSet:
    """What the component shall have."""
    found = await resolved(hub, target, body.wanted)
    if body.over is not None:
        found = overlay(found, await resolved(hub, target, body.over))
    whole = found
    return await hub.read_aside(lambda: whole.only(body.only)) if body.only else whole


async def _plan(hub: Hub, target: Followed, body: Wanted) -> Plan:
    wanted = await _wanted(hub, target, body)

    async def work() -> Plan:
        include, info = body.include, target.metadata
        return await prepare(
            target.component, wanted, include=include, info=info, force=body.force, run=hub.read_aside
        )

    return await _within(target, body.timeout_s, work)


async def _plan_back(hub: Hub, target: Followed, body: Restored) -> Plan:
    earlier = await state(hub, target, body.when)

    async def work() -> Plan:
        include = (*await restore_categories(target.component, earlier), *body.include)
        info = target.metadata
        return await prepare(
            target.component, earlier, include=include, info=info, force=body.force, run=hub.read_aside
        )

    return await _within(target, body.timeout_s, work)


async def _within(target: Followed, timeout: float | None, work: Callable[[], Awaitable[Result]]) -> Result:
    """Do it in this time."""
    with anyio.move_on_after(timeout):
        return await work()
    system, component = target.address
    raise NoReply(f"the parameters of {system}/{component}", attempts=0, waited=timeout or 0.0)


def _begin(
    hub: Hub,
    kind: Kind,
    target: Followed,
    request: Request,
    work: Callable[[Callable[[ApplyProgress], None]], Awaitable[ApplyResult]],
    *,
    full: bool,
) -> Job:
    """Begin to set a component up, as a job; one at a time, as two would undo each other's work.

    Raises:
        ServiceError: one is under way, or too many jobs are.
    """
    for other in hub.jobs.all:
        if other.state == "running" and other.kind != "fetch" and other.followed is target:
            what = f"It is being set up already, by {other.asked_by}; see job {other.id}."
            raise ServiceError(409, "busy", what, job=other.id)
    system, component = target.address

    async def run(job: Job) -> Document:
        rows: dict[str, ApplyRow] = {}
        told_at, told = -PROGRESS_INTERVAL, ""

        def tell(progress: ApplyProgress) -> None:
            nonlocal told_at, told
            if progress.row is not None:
                rows[progress.row.name] = progress.row.so_far
            job.progress = ApplyProgressDoc.of(progress)
            if note is not None and not hub.is_closing:  # what then fails was not written
                note.note(done=progress.done, total=progress.total, key=target.key)
            now = anyio.current_time()
            if progress.phase != told or now >= told_at + PROGRESS_INTERVAL:
                told_at, told = now, progress.phase
                hub.jobs.tell(job)

        note = await hub.note_setup(job)
        is_whole = False
        try:
            result = await work(tell)
            is_whole = result.error is None
        except anyio.get_cancelled_exc_class():
            job.result = InterruptedDoc.of(rows.values(), system=system, component=component)
            raise
        finally:
            if note is not None:
                await hub.end_note(note, is_cut_off=hub.is_closing and not is_whole)
        return ApplyResultDoc.of(result, system=system, component=component, full=full)

    return hub.jobs.begin(kind, target, run, asker_of(request), holder_of(request))


async def _result(request: Request, job: Job, *, waits: bool) -> Document | Response:
    if not waits:
        return accepted(job)
    result = await awaited(request, job)
    assert isinstance(result, ApplyResultDoc)
    return result
