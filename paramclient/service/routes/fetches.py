"""Fetches, and the jobs that they and other long work are."""

from __future__ import annotations

from typing import Annotated, Literal

import anyio
from fastapi import APIRouter, Request, Response
from pydantic import Field

from paramclient.client.client import ParamClient
from paramclient.documents.document import Body
from paramclient.documents.job import JobDoc, JobsDoc
from paramclient.documents.results import FetchedAllDoc, FetchResultDoc, SilentDoc
from paramclient.errors import NoReply, ParamClientError
from paramclient.protocol.params.sampling import SAMPLE_SIZE
from paramclient.service.answering import JSON, document_answer, written_out
from paramclient.service.hub import Hub
from paramclient.service.jobs import Job
from paramclient.service.problems import problem_of
from paramclient.service.reading import BodyRoute
from paramclient.service.route_context import (
    LinkName,
    Seconds,
    Target,
    TheHub,
    answered,
    asker_of,
    holder_of,
    may_write,
)

__all__ = ["accepted", "awaited", "router"]

router = APIRouter(prefix="/api/v1", tags=["fetches"], route_class=BodyRoute)


class Fetched(Body):
    """How to bring a table up to date; see `Component.fetch_all`. With `wait` false the answer is a job."""

    refresh: bool = False
    accept: Literal["verified", "sampled"] = "verified"
    sample: Annotated[int, Field(ge=1, le=65_535)] = SAMPLE_SIZE
    seed: Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)] | None = None
    timeout_s: Seconds = None
    wait: bool = True


class EverybodyFetched(Body):
    """How to bring the tables of all components up to date, or those of one system."""

    system: Annotated[int, Field(ge=1, le=255)] | None = None
    refresh: bool = False
    timeout_s: Seconds = None


@router.post(
    "/components/{system}/{component}/fetch",
    response_model=FetchResultDoc,
    responses={202: {"model": JobDoc, "description": "It is under way"}},
)
async def fetch(
    request: Request, response: Response, hub: TheHub, target: Target, body: Fetched
) -> FetchResultDoc | Response:
    """Bring the whole table up to date. Those who ask at the same time share one download."""
    job = hub.begin_fetch(
        target,
        asker_of(request),
        holder_of(request),
        refresh=body.refresh,
        accept=body.accept,
        sample=body.sample,
        seed=body.seed,
        timeout=body.timeout_s,
    )
    if not body.wait:
        return accepted(job)
    result = await awaited(request, job)
    assert isinstance(result, FetchResultDoc)
    return result


@router.post("/fetch")
async def fetch_everybody(
    request: Request, hub: TheHub, body: EverybodyFetched, link: LinkName = None
) -> FetchedAllDoc:
    """Bring the tables of everybody up to date, on all links side by side."""
    return await answered(request, lambda: _fetch_everybody(hub, body, link), *hub.followed)


@router.get("/jobs", response_model=JobsDoc)
async def jobs(hub: TheHub) -> Response:
    """What is under way, and what was lately. Members of a result with more than 64 entries are left out."""
    documents = hub.jobs.later_documents

    def write() -> bytes:
        return written_out(JobsDoc(jobs=[]), jobs=(document() for document in documents))

    return Response(await hub.aside(write), media_type=JSON)


@router.get("/jobs/{job}", response_model=JobDoc)
async def one_job(hub: TheHub, job: str) -> Response:
    """One of them."""
    return await document_answer(hub.aside, hub.jobs.later_document(job))


@router.delete("/jobs/{job}", status_code=204)
async def cancel(request: Request, hub: TheHub, job: str) -> Response:
    """Cancel it. A download goes on for as long as somebody else waits for it."""
    found = hub.jobs.find(job)
    if found.kind != "fetch":
        await may_write(request)
    found.cancel()
    return Response(status_code=204)


async def awaited(request: Request, job: Job) -> object:
    """What a job ends with, for somebody who waits; should they leave, it is cancelled."""
    try:
        return await answered(request, job.wait, job.followed)
    finally:
        job.cancel()  # it is over, or nobody wants it


def accepted(job: Job) -> Response:
    """The answer to those who do not wait."""
    content = job.document().model_dump_json()
    where = f"/api/v1/jobs/{job.id}"
    return Response(content, 202, headers={"Location": where}, media_type="application/json")


async def _fetch_everybody(hub: Hub, body: EverybodyFetched, link: str | None) -> FetchedAllDoc:
    results: list[FetchResultDoc] = []
    silent: list[SilentDoc] = []
    failures: list[ParamClientError] = []
    clients = hub.clients(link)

    async def of_line(name: str, client: ParamClient) -> None:
        try:
            fetched = await client.fetch_all(body.system, refresh=body.refresh, timeout=body.timeout_s)
        except ParamClientError as error:
            failures.append(error)
            return
        results.extend(FetchResultDoc.of(each, link=name) for each in fetched.results.values())
        for (system, component), reason in fetched.silent.items():
            problem = problem_of(reason)
            silent.append(SilentDoc(link=name, system=system, component=component, problem=problem))

    async with anyio.create_task_group() as tasks:
        for line, client in clients:
            tasks.start_soon(of_line, line.name, client)
    if failures and not results:
        raise failures[0]
    if not clients:
        raise NoReply("the parameters of any component: no link is open", attempts=0, waited=0.0)
    return FetchedAllDoc(results=results, silent=silent)
