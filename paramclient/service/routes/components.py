"""Who is heard: all components, one of them, and what is asked of it as a whole."""

from __future__ import annotations

from typing import Annotated

import anyio.lowlevel
from fastapi import APIRouter, Depends, Request, Response
from pydantic import Field

from paramclient.client.arguments import COMPONENT_TIMEOUT
from paramclient.client.component import Component
from paramclient.documents.component import ComponentDoc, ComponentsDoc
from paramclient.documents.document import Body
from paramclient.service.answering import document_answer
from paramclient.service.followed_component import Followed
from paramclient.service.reading import BodyRoute
from paramclient.service.route_context import LinkName, Seconds, Target, TheHub, answered, may_write

__all__ = ["router"]

router = APIRouter(prefix="/api/v1", tags=["components"], route_class=BodyRoute)

Id = Annotated[int | None, Field(ge=1, le=255)]


class Patience(Body):
    """For how long to wait."""

    timeout_s: Seconds = None


class Sought(Body):
    """Whom to wait for; null is any. Without `timeout_s` as long as the library waits, null for ever.

    With `only`, the answer is a problem where another vehicle can be meant, see `ParamClient.only_component`.
    """

    system: Id = None
    component: Id = None
    only: bool = False
    timeout_s: Seconds = COMPONENT_TIMEOUT


class Moved(Body):
    """Under which system id a vehicle is looked for."""

    system: Annotated[int, Field(ge=1, le=255)]
    timeout_s: Seconds = COMPONENT_TIMEOUT


class Restarted(Body):
    """The system id that a vehicle takes with the start, where another one was set."""

    system: Id = None
    timeout_s: Seconds = None


@router.get("/components", response_model=ComponentsDoc)
async def all_components(hub: TheHub) -> Response:
    """Everyone who is heard, and the number of the event up to which that holds."""
    for followed in hub.followed:
        followed.look()
        await anyio.lowlevel.checkpoint()
    place = hub.feed.place
    documents = []
    for followed in hub.followed:
        documents.append(followed.document)
        await anyio.lowlevel.checkpoint()
    found = ComponentsDoc(run=place.run, seq=place.seq, components=documents)
    return await document_answer(hub.aside, lambda: found)


@router.get("/components/{system}/{component}")
async def one_component(target: Target) -> ComponentDoc:
    """One component."""
    return target.document


@router.post("/components/{system}/{component}/refreshed", status_code=204)
async def refreshed(request: Request, target: Target, body: Patience) -> Response:
    """Wait until the values that a hash does not cover have been read afresh."""
    await answered(request, lambda: target.component.refreshed(timeout=body.timeout_s), target)
    return Response(status_code=204)


@router.post("/components/{system}/{component}/reboot", dependencies=[Depends(may_write)])
async def reboot(request: Request, target: Target, body: Restarted) -> ComponentDoc:
    """Let the vehicle start again, and wait until the same one is back."""

    async def work() -> Component:
        return await target.component.reboot(system=body.system, timeout=body.timeout_s)

    return _document(target, await answered(request, work, target))


@router.post("/components/{system}/{component}/successor")
async def successor(request: Request, target: Target, body: Moved) -> ComponentDoc:
    """Wait for the same component of the same vehicle under another system id."""

    async def work() -> Component:
        client = target.component.client
        return await client.successor(target.component, body.system, timeout=body.timeout_s)

    return _document(target, await answered(request, work, target))


@router.post("/find")
async def find(request: Request, hub: TheHub, body: Sought, link: LinkName = None) -> ComponentDoc:
    """Wait for a component on any link: the first autopilot, or what is named; also on links to come."""
    wait_for = hub.wait_for_only if body.only else hub.wait_for
    found = await answered(request, lambda: wait_for(body.system, body.component, link, body.timeout_s))
    found.look()
    return found.document


def _document(target: Followed, component: Component) -> ComponentDoc:
    """How a component stands that is on the same link."""
    followed = target.line.followed[component.system, component.component]
    followed.look()
    return followed.document
