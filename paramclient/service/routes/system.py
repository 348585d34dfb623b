"""Routes of the service itself: health, metrics, links, current user."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from paramclient.documents.link import HealthDoc, HealthLinkDoc, LinksDoc, TokenHolderDoc
from paramclient.service.metrics import METRICS_MEDIA_TYPE, metrics_text
from paramclient.service.route_context import HubArgument, author_of
from paramclient.version import __version__

__all__ = ["router"]

router = APIRouter(tags=["service"])


@router.get("/health")
async def health(request: Request, hub: HubArgument) -> HealthDoc:
    """Return that the service responds, and its links if the client may see them."""
    is_known = request.scope["state"]["role"] is not None
    links = [HealthLinkDoc(name=link.name, state=link.state) for link in hub.links.values()]
    return HealthDoc(
        status="ok", version=__version__, up_s=round(hub.uptime, 1), links=links if is_known else None
    )


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
async def metrics(hub: HubArgument) -> Response:
    """Return the metrics for Prometheus in text format 0.0.4."""
    return Response(await metrics_text(hub), media_type=METRICS_MEDIA_TYPE)


@router.get("/api/v1/me")
async def me(request: Request) -> TokenHolderDoc:
    """Return name and permissions of the client."""
    state = request.scope["state"]
    return TokenHolderDoc(
        name=state["name"], author=author_of(request), role=state["role"], read_only=state["read_only"]
    )


@router.get("/api/v1/links")
async def links(hub: HubArgument) -> LinksDoc:
    """Return all links with their traffic."""
    return LinksDoc(links=[link.document for link in hub.links.values()])
