"""Routes of fetches and jobs."""

from __future__ import annotations

from typing import Annotated

import anyio
from fastapi import APIRouter, Request, Response
from pydantic import Field

from paramclient.client.client import ParamClient
from paramclient.documents.document import Body
from paramclient.documents.job import JobDoc, JobsDoc
from paramclient.documents.results import FetchedAllDoc, FetchResultDoc, SilentDoc
from paramclient.errors import NoReply, ParamClientError
from paramclient.service.hub import Hub
from paramclient.service.jobs import FETCHES, Job
from paramclient.service.problems import problem_of
from paramclient.service.request_body import BodyRoute, long_request
from paramclient.service.responses import JSON, document_response, encode_document
from paramclient.service.route_context import (
    HubArgument,
    LinkName,
    Seconds,
    Target,
    author_of,
    holder_of,
    require_write,
    run_until_disconnect,
)

__all__ = ["job_response", "wait_for_job", "router"]

router = APIRouter(prefix="/api/v1", tags=["fetches"], route_class=BodyRoute)


class FetchRequest(Body):
    """Options of a fetch; see `Component.fetch_all`. With `wait` false, the response is a job."""

    refresh: bool = False
    timeout_s: Seconds = None
    wait: bool = True


class FetchAllRequest(Body):
    """Options of a fetch of all components, or of those of one system."""

    system: Annotated[int, Field(ge=1, le=255)] | None = None
    refresh: bool = False
    timeout_s: Seconds = None


@router.post(
    "/components/{system}/{component}/fetch",
    response_model=FetchResultDoc,
    responses={202: {"model": JobDoc, "description": "The started job"}},
)
async def fetch(
    request: Request, response: Response, hub: HubArgument, target: Target, body: FetchRequest
) -> FetchResultDoc | Response:
    """Fetch the whole table. Simultaneous requests share one download."""
    job = hub.start_fetch(
        target,
        author_of(request),
        holder_of(request),
        refresh=body.refresh,
        timeout=body.timeout_s,
    )
    if not body.wait:
        return job_response(job)
    result = await wait_for_job(request, job)
    assert isinstance(result, FetchResultDoc)
    return result


@router.post("/fetch", response_model=FetchedAllDoc)
async def fetch_all(
    request: Request, hub: HubArgument, body: FetchAllRequest, link: LinkName = None
) -> Response:
    """Fetch the tables of all components, on all links in parallel."""
    with long_request(request):
        fetched = await run_until_disconnect(request, lambda: _fetch_all(hub, body, link), *hub.followed)
        return await document_response(hub.encode_in_thread, lambda: fetched)


@router.get("/jobs", response_model=JobsDoc)
async def jobs(hub: HubArgument) -> Response:
    """Return running and recent jobs. Members of a result with more than 64 entries are omitted."""
    documents = hub.jobs.document_factories

    def write() -> bytes:
        return encode_document(JobsDoc(jobs=[]), jobs=(document() for document in documents))

    return Response(await hub.run_in_thread(write), media_type=JSON)


@router.get("/jobs/{job}", response_model=JobDoc)
async def one_job(hub: HubArgument, job: str) -> Response:
    """Return one job."""
    return await document_response(hub.run_in_thread, hub.jobs.document_factory(job))


@router.delete("/jobs/{job}", status_code=204)
async def cancel(request: Request, hub: HubArgument, job: str) -> Response:
    """Cancel a job. A download continues while another client waits for it."""
    found = hub.jobs.find(job)
    if found.kind not in FETCHES:
        await require_write(request)
    found.cancel()
    return Response(status_code=204)


async def wait_for_job(request: Request, job: Job) -> object:
    """Wait for the result of a job, and cancel the job if the client disconnects."""
    try:
        return await run_until_disconnect(request, job.wait, job.followed)
    finally:
        job.cancel()  # no effect on an ended job


def job_response(job: Job) -> Response:
    """Return the response for a client that does not wait."""
    content = job.document().model_dump_json()
    where = f"/api/v1/jobs/{job.id}"
    return Response(content, 202, headers={"Location": where}, media_type="application/json")


async def _fetch_all(hub: Hub, body: FetchAllRequest, link: str | None) -> FetchedAllDoc:
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
