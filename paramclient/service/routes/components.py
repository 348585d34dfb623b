"""Routes of components: list, state, reboot, waiting for a component."""

from __future__ import annotations

from typing import Annotated

import anyio.lowlevel
from fastapi import APIRouter, Depends, Request, Response
from pydantic import Field

from paramclient.client.arguments import COMPONENT_TIMEOUT
from paramclient.client.component import Component, successor_of
from paramclient.documents.component import ComponentDoc, ComponentsDoc
from paramclient.documents.document import Body
from paramclient.service.followed_component import FollowedComponent
from paramclient.service.request_body import BodyRoute
from paramclient.service.responses import document_response
from paramclient.service.route_context import (
    HubArgument,
    LinkName,
    Seconds,
    Target,
    require_write,
    run_until_disconnect,
)

__all__ = ["router"]

router = APIRouter(prefix="/api/v1", tags=["components"], route_class=BodyRoute)

Id = Annotated[int | None, Field(ge=1, le=255)]


class TimeoutRequest(Body):
    """Timeout of a request."""

    timeout_s: Seconds = None


class FindRequest(Body):
    """Component to wait for; null matches any. The default timeout is that of the library; null waits without
    a limit.

    With `only`, the response is a problem if another vehicle matches too; see `ParamClient.only_component`.
    """

    system: Id = None
    component: Id = None
    only: bool = False
    timeout_s: Seconds = COMPONENT_TIMEOUT


class SuccessorRequest(Body):
    """New system id of a vehicle."""

    system: Annotated[int, Field(ge=1, le=255)]
    timeout_s: Seconds = COMPONENT_TIMEOUT


class RebootRequest(Body):
    """System id of the vehicle after the reboot, if it changes."""

    system: Id = None
    timeout_s: Seconds = None


@router.get("/components", response_model=ComponentsDoc)
async def all_components(hub: HubArgument) -> Response:
    """Return all components, and the number of the last event included."""
    for followed in hub.followed:
        followed.publish_changes()
        await anyio.lowlevel.checkpoint()
    place = hub.feed.position
    documents = []
    for followed in hub.followed:
        documents.append(followed.document)
        await anyio.lowlevel.checkpoint()
    found = ComponentsDoc(run=place.run, seq=place.seq, components=documents)
    return await document_response(hub.encode_in_thread, lambda: found)


@router.get("/components/{system}/{component}")
async def one_component(target: Target) -> ComponentDoc:
    """Return one component."""
    return target.document


@router.post("/components/{system}/{component}/refreshed", status_code=204)
async def refreshed(request: Request, target: Target, body: TimeoutRequest) -> Response:
    """Wait until the values that the hash does not cover are read again."""
    await run_until_disconnect(request, lambda: target.component.refreshed(timeout=body.timeout_s), target)
    return Response(status_code=204)


@router.post("/components/{system}/{component}/reboot", dependencies=[Depends(require_write)])
async def reboot(request: Request, target: Target, body: RebootRequest) -> ComponentDoc:
    """Reboot the vehicle and wait until it is back."""

    async def work() -> Component:
        return await target.component.reboot(system=body.system, timeout=body.timeout_s)

    return _document(target, await run_until_disconnect(request, work, target))


@router.post("/components/{system}/{component}/successor")
async def successor(request: Request, target: Target, body: SuccessorRequest) -> ComponentDoc:
    """Wait for the same component of the same vehicle with another system id."""

    async def work() -> Component:
        return await successor_of(target.component, body.system, timeout=body.timeout_s)

    return _document(target, await run_until_disconnect(request, work, target))


@router.post("/find")
async def find(request: Request, hub: HubArgument, body: FindRequest, link: LinkName = None) -> ComponentDoc:
    """Wait for a component on any link: the first autopilot, or the given ids. Includes links that open
    later."""
    wait_for = hub.wait_for_only_component if body.only else hub.wait_for_component
    found = await run_until_disconnect(
        request, lambda: wait_for(body.system, body.component, link, body.timeout_s)
    )
    found.publish_changes()
    return found.document


def _document(target: FollowedComponent, component: Component) -> ComponentDoc:
    """Return the state of a component on the same link."""
    followed = target.link.followed[component.system, component.component]
    followed.publish_changes()
    return followed.document
