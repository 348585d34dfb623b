"""The service itself: whether it is well, what it holds, how much has gone over its links."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from paramclient.documents.link import HealthDoc, HealthLinkDoc, LinksDoc, MeDoc
from paramclient.service.metrics import MEDIA_TYPE, metrics_text
from paramclient.service.route_context import TheHub, asker_of
from paramclient.version import __version__

__all__ = ["router"]

router = APIRouter(tags=["service"])


@router.get("/health")
async def health(request: Request, hub: TheHub) -> HealthDoc:
    """That the service answers. Which links it has is for those alone who may know."""
    is_known = request.scope["state"]["role"] is not None
    links = [HealthLinkDoc(name=line.name, state=line.state) for line in hub.lines.values()]
    return HealthDoc(
        status="ok", version=__version__, up_s=round(hub.age, 1), links=links if is_known else None
    )


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
async def metrics(hub: TheHub) -> Response:
    """Numbers for Prometheus, in its text format 0.0.4."""
    return Response(metrics_text(hub), media_type=MEDIA_TYPE)


@router.get("/api/v1/me")
async def me(request: Request) -> MeDoc:
    """Who asks, and what that one may do."""
    state = request.scope["state"]
    return MeDoc(
        name=state["name"], asker=asker_of(request), role=state["role"], read_only=state["read_only"]
    )


@router.get("/api/v1/links")
async def links(hub: TheHub) -> LinksDoc:
    """All links, and what has gone over each."""
    return LinksDoc(links=[line.document for line in hub.lines.values()])
