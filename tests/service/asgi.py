"""An ASGI application as an httpx transport: responses are received as they are sent, also endless ones."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any, Final

import httpx
from starlette.types import ASGIApp, Message

__all__ = ["ASGITransport", "a_browser"]

HIGH_WATER: Final = 65_536
"""Bytes that an application may have sent, and no client has read, before `send` waits, as with uvicorn."""


class ASGITransport(httpx.AsyncBaseTransport):
    """Calls an application in a task of its own for each request.

    The application receives `http.disconnect` when the response is closed or the request is cancelled. What
    it raises is raised by the request, unless it has responded with the status 500.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        url = request.url
        scope = {
            "type": "http",
            "asgi": {"version": "3.0", "spec_version": "2.4"},
            "http_version": "1.1",
            "method": request.method,
            "scheme": url.scheme,
            "path": url.path,
            "raw_path": url.raw_path.partition(b"?")[0],
            "query_string": url.query,
            "root_path": "",
            "headers": [(name.lower(), value) for name, value in request.headers.raw],
            "server": (url.host, url.port or 80),
            "client": ("127.0.0.1", 50_000),
        }
        exchange = _Exchange(await request.aread())
        exchange.begin(self._app, scope)
        try:
            await exchange.started.wait()
        except asyncio.CancelledError:
            await exchange.aclose()
            raise
        if exchange.error is not None and exchange.status is None:
            await exchange.aclose()
            raise exchange.error
        assert exchange.status is not None, "the application has not answered"
        return httpx.Response(exchange.status, headers=exchange.headers, stream=exchange)


class _Exchange(httpx.AsyncByteStream):
    """One request and what is answered to it."""

    def __init__(self, body: bytes) -> None:
        self.status: int | None = None
        self.headers: list[tuple[bytes, bytes]] = []
        self.started = asyncio.Event()
        self.error: Exception | None = None
        self._body: bytes | None = body
        self._gone = asyncio.Event()
        self._chunks: asyncio.Queue[bytes | None] = asyncio.Queue()
        self._waiting = 0
        self._has_room = asyncio.Event()
        self._has_room.set()
        self._task: asyncio.Task[None] | None = None

    def begin(self, app: ASGIApp, scope: dict[str, Any]) -> None:
        self._task = asyncio.create_task(self._run(app, scope), name=f"asgi {scope['path']}")

    async def __aiter__(self) -> AsyncIterator[bytes]:
        while (chunk := await self._chunks.get()) is not None:
            self._waiting -= len(chunk)
            if self._waiting <= HIGH_WATER:
                self._has_room.set()
            yield chunk
        if self.error is not None and self.status != 500:
            raise self.error

    async def aclose(self) -> None:
        """The client leaves; the application has as long to notice as it takes."""
        self._gone.set()
        self._has_room.set()
        if self._task is not None:
            with suppress(asyncio.CancelledError):
                await asyncio.shield(self._task)

    async def _run(self, app: ASGIApp, scope: dict[str, Any]) -> None:
        try:
            await app(scope, self._receive, self._send)
        except Exception as error:
            self.error = error
        finally:
            self._gone.set()
            self._chunks.put_nowait(None)
            self.started.set()

    async def _receive(self) -> Message:
        if self._body is not None:
            body, self._body = self._body, None
            return {"type": "http.request", "body": body, "more_body": False}
        await self._gone.wait()
        return {"type": "http.disconnect"}

    async def _send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
            self.headers = list(message.get("headers", ()))
        elif message["type"] == "http.response.body":
            chunk = message.get("body", b"")
            if chunk and not self._gone.is_set():
                self._waiting += len(chunk)
                self._chunks.put_nowait(chunk)
                if self._waiting > HIGH_WATER:
                    self._has_room.clear()
            self.started.set()
            if not message.get("more_body", False):
                self._gone.set()
                self._chunks.put_nowait(None)
            await self._has_room.wait()


def a_browser(app: ASGIApp, **options: Any) -> httpx.AsyncClient:
    """A client of an application; the options are those of `httpx.AsyncClient`."""
    defaults = {"base_url": "http://127.0.0.1:8765", "timeout": None}
    return httpx.AsyncClient(transport=ASGITransport(app), **(defaults | options))
