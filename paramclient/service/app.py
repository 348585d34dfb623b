"""The ASGI application: routes, errors, web page, API reference, and headers of all responses."""

from __future__ import annotations

import hashlib
import json
from collections.abc import MutableMapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any, Final

import anyio
from fastapi import FastAPI, Request, Response, WebSocket
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from paramclient.documents.document import build_documents
from paramclient.service import problems
from paramclient.service.access import AccessMiddleware, AccessSettings
from paramclient.service.event_feed import COMPACT_SEPARATORS
from paramclient.service.hub import Hub
from paramclient.service.problems import RESPONSES, ServiceError
from paramclient.service.routes import ROUTERS
from paramclient.version import __version__

__all__ = ["Settings", "create_app"]

MEDIA_TYPES: Final = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}
"""Media types of the static files, by file name extension."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings of the application.

    Attributes:
        access: settings of the access checks; the default allows only this computer.
    """

    access: AccessSettings = field(default_factory=AccessSettings)


def create_app(hub: Hub, settings: Settings | None = None) -> ASGIApp:
    """Create the application over a hub, which the caller opens and closes."""
    app = FastAPI(
        title="paramclient",
        version=__version__,
        summary="MAVLink parameters of the components on the links of this service",
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        responses=RESPONSES,
    )
    app.state.hub = hub
    problems.install_handlers(app)
    for router in ROUTERS:
        app.include_router(router)
    _add_openapi(app, hub)
    _add_files(app, "page", index="/", prefix="/page/")
    _add_files(app, "reference", index="/docs", prefix="/docs/")
    app.add_api_websocket_route("/{path:path}", _reject_websocket)
    _build_routes(app)
    access = Settings().access if settings is None else settings.access
    return AccessMiddleware(_PositionHeader(_HeadResponses(app), hub), access)


class _HeadResponses:
    """Responds to HEAD with the headers of GET (RFC 9110, section 9.3.2)."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return

        answering = anyio.CancelScope()

        async def send_head(message: Message) -> None:
            """Send the headers and cancel the response, because an event stream has no end."""
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body", "body": b"", "more_body": False})
                answering.cancel()

        with answering:
            await self._app({**scope, "method": "GET"}, receive, send_head)


class _PositionHeader:
    """Adds the position of the newest event to every response."""

    def __init__(self, app: ASGIApp, hub: Hub) -> None:
        self._app = app
        self._feed = hub.feed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        is_answered = False

        async def send_with_position(message: Message) -> None:
            nonlocal is_answered
            if message["type"] == "http.response.start":
                given = list(message.get("headers", ()))
                given.append((b"x-seq", str(self._feed.position).encode()))
                message["headers"] = given
            await send(message)
            is_answered = message["type"] == "http.response.body" and not message.get("more_body", False)

        try:
            await self._app(scope, receive, send_with_position)
        except Exception:
            if not is_answered:  # a sent problem is logged already
                raise


async def _reject_websocket(socket: WebSocket) -> None:
    """Reject a WebSocket with an unknown path by a problem; the framework would send 403 without a body."""
    raise ServiceError(404, "not-found", "This path does not exist.")


def _build_routes(app: FastAPI) -> None:
    """Build the handlers of all routes, and the models of all documents.

    FastAPI and pydantic build them on first use, which takes up to 60 ms in the first request to a router.
    """
    anywhere = {"type": "http", "method": "GET", "path": "/", "root_path": "", "headers": []}
    for route in app.routes:
        route.matches(dict(anywhere))  # an included router builds its routes for a comparison
    build_documents()


def _add_openapi(app: FastAPI, hub: Hub) -> None:
    """Serve the OpenAPI document. Creating it takes 0.2 s, once, in a worker thread."""

    @cache
    def text() -> str:
        return json.dumps(app.openapi(), separators=COMPACT_SEPARATORS)

    async def answer(_: Request) -> Response:
        return Response(await hub.run_in_thread(text), media_type="application/json")

    app.add_route("/openapi.json", answer, methods=["GET"], include_in_schema=False)


def _add_files(app: FastAPI, folder: str, *, index: str, prefix: str) -> None:
    """Serve the files of a folder of this package from memory."""
    files: MutableMapping[str, tuple[bytes, str, str]] = {}
    place = resources.files("paramclient.service").joinpath(folder)
    for file in place.iterdir() if place.is_dir() else ():
        media_type = MEDIA_TYPES.get(file.name.rpartition(".")[2])
        if media_type is not None:
            content = file.read_bytes()
            files[file.name] = (content, media_type, f'"{hashlib.sha256(content).hexdigest()[:16]}"')

    async def answer(request: Request) -> Response:
        name: Any = request.path_params.get("name", "index.html")
        if name not in files:
            raise ServiceError(404, "not-found", "This path does not exist.")
        content, media_type, tag = files[name]
        headers = {"etag": tag, "cache-control": "no-cache"}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=headers)
        return Response(content, media_type=media_type, headers=headers)

    app.add_route(index, answer, methods=["GET"], include_in_schema=False)
    app.add_route(f"{prefix}{{name}}", answer, methods=["GET"], include_in_schema=False)
