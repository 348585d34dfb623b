"""What happens, as it happens: server-sent events, and the same over a WebSocket."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Annotated, Any, Final

import anyio
from fastapi import APIRouter, Header, Query, Response, WebSocket
from starlette.types import Receive, Scope, Send

from paramclient.service.event_feed import Listener, Place, Wanted
from paramclient.service.hub import Hub
from paramclient.service.problems import ServiceError
from paramclient.service.route_context import LinkName, TheHub

__all__ = ["router"]

KEEPALIVE: Final = 2.0
"""Seconds without an event after which a comment says that the service is still there."""
SLOWEST: Final = 30.0
"""Seconds in which a listener must have taken what it was sent; one that has not is left."""
MOST_LISTENERS: Final = 1_000
"""Streams that are open at once; each is a connection."""
AWAY: Final = 1001
"""The WebSocket's code for a server that ends (RFC 6455, section 7.4.1)."""

router = APIRouter(prefix="/api/v1", tags=["events"])

Types = Annotated[str | None, Query(max_length=200, description="Kinds of events, with commas between them.")]
After = Annotated[str | None, Query(max_length=64, description="The id of the event that was seen last.")]
Id = Annotated[int | None, Query(ge=0, le=255)]


@router.get(
    "/events",
    response_class=Response,
    responses={200: {"content": {"text/event-stream": {}}, "description": "Events, without an end"}},
)
async def events(
    hub: TheHub,
    types: Types = None,
    link: LinkName = None,
    system: Id = None,
    component: Id = None,
    after: After = None,
    last_event_id: Annotated[str | None, Header(max_length=64)] = None,
) -> Response:
    """What happens from now on, or since the event that was seen last, as server-sent events."""
    wanted = _wanted(types, link, system, component)
    return _EventStream(_listener(hub, last_event_id or after, wanted))


@router.websocket("/ws")
async def websocket(
    socket: WebSocket,
    types: Types = None,
    link: LinkName = None,
    system: Id = None,
    component: Id = None,
    after: After = None,
) -> None:
    """The same events as text frames."""
    hub: Hub = socket.app.state.hub
    listener = _listener(hub, after, _wanted(types, link, system, component))
    await socket.accept()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_cancel_when, "websocket.disconnect", socket.receive, tasks.cancel_scope)
        with listener:
            await _send_texts(listener, socket.send_text)
        with anyio.move_on_after(SLOWEST):
            await socket.close(AWAY)
        tasks.cancel_scope.cancel()


class _EventStream(Response):
    """Events until the listener leaves, is too slow, or the service ends."""

    media_type = "text/event-stream"

    def __init__(self, listener: Listener) -> None:
        super().__init__(headers={"cache-control": "no-store", "x-accel-buffering": "no"})
        del self.headers["content-length"]
        self._listener = listener

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_cancel_when, "http.disconnect", receive, tasks.cancel_scope)
            await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
            with self._listener:
                await self._send_events(send)
            await send({"type": "http.response.body", "body": b"", "more_body": False})
            tasks.cancel_scope.cancel()

    async def _send_events(self, send: Send) -> None:
        listener = self._listener
        chunk = _as_event(listener.place, listener.hello())
        while True:
            with anyio.move_on_after(SLOWEST) as patience:
                await send({"type": "http.response.body", "body": chunk, "more_body": True})
            if patience.cancelled_caught:
                return
            try:
                news = await listener.next(KEEPALIVE)
            except EOFError:
                return
            if news is None:
                chunk = f": \nid: {listener.place}\n\n".encode()
                continue
            batch, chunk = news
            if batch.missed:
                chunk = _as_event(listener.place, listener.gap(batch.missed))


async def _send_texts(listener: Listener, send: Callable[[str], Awaitable[None]]) -> None:
    texts = [listener.hello()]
    while True:
        with anyio.move_on_after(SLOWEST) as patience:
            for text in texts:
                await send(text)
        if patience.cancelled_caught:
            return
        try:
            news = await listener.next(KEEPALIVE)
        except EOFError:
            return
        texts = []
        if news is not None:
            batch = news[0]
            texts = [listener.gap(batch.missed)] if batch.missed else [text for _, text in batch.texts]


async def _cancel_when(
    kind: str, receive: Callable[[], Awaitable[MutableMapping[str, Any]]], scope: anyio.CancelScope
) -> None:
    while (await receive())["type"] != kind:
        pass
    scope.cancel()


def _wanted(types: str | None, link: str | None, system: int | None, component: int | None) -> Wanted:
    kinds = None if types is None else frozenset(filter(None, types.split(",")))
    return Wanted(kinds, link, system, component)


def _listener(hub: Hub, after: str | None, wanted: Wanted) -> Listener:
    feed = hub.feed
    if feed.is_over:
        raise ServiceError(503, "closing", "The service is ending.")
    if feed.listeners >= MOST_LISTENERS:
        raise ServiceError(429, "too-many", f"{MOST_LISTENERS} streams of events are open already.")
    return feed.listen(None if after is None else Place.read(after), wanted)


def _as_event(place: Place, text: str) -> bytes:
    return f"id: {place}\ndata: {text}\n\n".encode()
