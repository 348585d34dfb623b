"""An ASGI application as an httpx transport: responses are received as they are sent, also endless ones."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Final

import anyio
import httpx
from starlette.types import ASGIApp, Message, Scope

MESSAGES_MAX: Final = 64
"""Messages that an application may have sent, and no client has read, before `send` waits."""


class _Transport(httpx.AsyncBaseTransport):
    """Calls an application in a task of its own for each request."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        url = request.url
        scope = {
            "type": "http",
            "http_version": "1.1",
            "method": request.method,
            "scheme": url.scheme,
            "path": url.path,
            "query_string": url.query,
            "headers": [(name.lower(), value) for name, value in request.headers.raw],
            "client": ("127.0.0.1", 50_000),
        }
        exchange = _Exchange(self._app, scope, await request.aread())
        try:
            start = await exchange.answers.receive()
        except BaseException:
            await exchange.aclose()
            raise
        exchange.status = start["status"]
        return httpx.Response(exchange.status, headers=start["headers"], stream=exchange)


class _Exchange(httpx.AsyncByteStream):
    """One request and what is answered to it.

    The application receives `http.disconnect` when the response is closed or the request is cancelled. What
    it raises is raised there, unless it has responded with the status 500.
    """

    def __init__(self, app: ASGIApp, scope: Scope, body: bytes) -> None:
        self._requests: list[Message] = [{"type": "http.request", "body": body}]
        self.status = 0
        self._gone = asyncio.Event()
        self._sent, self.answers = anyio.create_memory_object_stream[Message](MESSAGES_MAX)
        self._task = asyncio.create_task(self._run(app, scope))

    async def __aiter__(self) -> AsyncIterator[bytes]:
        async for message in self.answers:
            yield message.get("body", b"")

    async def aclose(self) -> None:
        """The client leaves; the application has as long to notice as it takes."""
        self._gone.set()
        self.answers.close()
        await asyncio.wait([self._task])
        if (error := self._task.exception()) is not None and self.status != 500:
            raise error

    async def _run(self, app: ASGIApp, scope: Scope) -> None:
        with self._sent:
            await app(scope, self._receive, self._send)

    async def _receive(self) -> Message:
        if self._requests:
            return self._requests.pop()
        await self._gone.wait()
        return {"type": "http.disconnect"}

    async def _send(self, message: Message) -> None:
        with suppress(anyio.BrokenResourceError):
            await self._sent.send(message)


def a_browser(app: ASGIApp) -> httpx.AsyncClient:
    """A client of an application."""
    return httpx.AsyncClient(transport=_Transport(app), base_url="http://127.0.0.1:8765", timeout=None)
