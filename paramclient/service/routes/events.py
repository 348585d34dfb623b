"""Routes of the event stream: server-sent events, and a WebSocket."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Annotated, Any, Final

import anyio
from fastapi import APIRouter, Header, Query, Response, WebSocket
from starlette.types import Receive, Scope, Send

from paramclient.service.event_feed import EventFilter, EventPosition, Listener
from paramclient.service.hub import Hub
from paramclient.service.problems import ServiceError
from paramclient.service.route_context import HubArgument, LinkName

__all__ = ["router"]

KEEPALIVE_INTERVAL: Final = 2.0
"""Seconds without an event after which a comment is sent."""
LISTENER_SEND_TIMEOUT: Final = 30.0
"""Seconds without progress after which a listener is disconnected."""
LISTENERS_MAX: Final = 1_000
"""Maximum number of open event streams; each is a connection."""
GOING_AWAY: Final = 1001
"""Close code of a WebSocket at the end of the service: going away (RFC 6455, section 7.4.1)."""

router = APIRouter(prefix="/api/v1", tags=["events"])

Types = Annotated[str | None, Query(max_length=200, description="Types of events, separated by commas.")]
After = Annotated[str | None, Query(max_length=64, description="Id of the last received event.")]
Id = Annotated[int | None, Query(ge=0, le=255)]


@router.get(
    "/events",
    response_class=Response,
    responses={200: {"content": {"text/event-stream": {}}, "description": "An endless stream of events"}},
)
async def events(
    hub: HubArgument,
    types: Types = None,
    link: LinkName = None,
    system: Id = None,
    component: Id = None,
    after: After = None,
    last_event_id: Annotated[str | None, Header(max_length=64)] = None,
) -> Response:
    """Return the events from now on, or after the last received event, as server-sent events."""
    event_filter = _event_filter(types, link, system, component)
    return _EventStream(_listener(hub, last_event_id or after, event_filter))


@router.websocket("/ws")
async def websocket(
    socket: WebSocket,
    types: Types = None,
    link: LinkName = None,
    system: Id = None,
    component: Id = None,
    after: After = None,
) -> None:
    """Send the same events as text frames."""
    hub: Hub = socket.app.state.hub
    listener = _listener(hub, after, _event_filter(types, link, system, component))
    await socket.accept()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_cancel_when, "websocket.disconnect", socket.receive, tasks.cancel_scope)
        with listener:
            await _send_texts(listener, socket.send_text)
        with anyio.move_on_after(LISTENER_SEND_TIMEOUT):
            await socket.close(GOING_AWAY)
        tasks.cancel_scope.cancel()


class _EventStream(Response):
    """Sends events until the client disconnects or stalls for `LISTENER_SEND_TIMEOUT`, or the feed ends."""

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
        chunk = _as_event(listener.position, listener.hello())
        while True:
            with anyio.move_on_after(LISTENER_SEND_TIMEOUT) as deadline:
                await send({"type": "http.response.body", "body": chunk, "more_body": True})
            if deadline.cancelled_caught:
                return
            try:
                item = await listener.next(KEEPALIVE_INTERVAL)
            except EOFError:
                return
            if item is None:
                chunk = f": \nid: {listener.position}\n\n".encode()
                continue
            batch, chunk = item
            if batch.missed:
                chunk = _as_event(listener.position, listener.gap(batch.missed))


async def _send_texts(listener: Listener, send: Callable[[str], Awaitable[None]]) -> None:
    texts = [listener.hello()]
    while True:
        with anyio.move_on_after(LISTENER_SEND_TIMEOUT) as deadline:
            for text in texts:
                await send(text)
        if deadline.cancelled_caught:
            return
        try:
            item = await listener.next(KEEPALIVE_INTERVAL)
        except EOFError:
            return
        texts = []
        if item is not None:
            batch = item[0]
            texts = [listener.gap(batch.missed)] if batch.missed else [text for _, text in batch.texts]


async def _cancel_when(
    kind: str, receive: Callable[[], Awaitable[MutableMapping[str, Any]]], scope: anyio.CancelScope
) -> None:
    while (await receive())["type"] != kind:
        pass
    scope.cancel()


def _event_filter(
    types: str | None, link: str | None, system: int | None, component: int | None
) -> EventFilter:
    kinds = None if types is None else frozenset(filter(None, types.split(",")))
    return EventFilter(kinds, link, system, component)


def _listener(hub: Hub, after: str | None, event_filter: EventFilter) -> Listener:
    feed = hub.feed
    if feed.is_ended:
        raise ServiceError(503, "closing", "The service is shutting down.")
    if feed.listeners >= LISTENERS_MAX:
        raise ServiceError(
            429, "too-many", f"{LISTENERS_MAX} event streams are already open. Try again later."
        )
    return feed.listen(None if after is None else EventPosition.read(after), event_filter)


def _as_event(position: EventPosition, text: str) -> bytes:
    return f"id: {position}\ndata: {text}\n\n".encode()
