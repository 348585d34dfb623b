"""Checks of each request: its token and role, and the page that it comes from; headers of all responses.

Tokens come in the header Authorization only. There are no cookies, so a page of another site has no authority
to use. Without tokens, every program of this computer may write; pages of other sites must not, and are
recognized by the header Origin, which browsers send with every write.
"""

from __future__ import annotations

import re
from typing import Final

import anyio
from fastapi import Request
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from paramclient.service.problems import ServiceError, problem_response
from paramclient.service.tokens import TokenHolder, Tokens

__all__ = ["AccessMiddleware", "author_of", "cancel_on_disconnect", "require_write"]

PROTECTED: Final = ("/api/", "/metrics")
"""Begin of the paths that require a token. The others are the page, its description, and `/health`."""
SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})
LOCAL: Final = TokenHolder("local", "write")
"""The holder of all requests to a service without tokens."""
RESPONSE_HEADERS: Final = {
    "cache-control": "no-store",
    "content-security-policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}
"""Headers of all responses: the page loads nothing from other sites, and no other page can frame it."""
_PAGE_NAME: Final = re.compile(r"[A-Za-z0-9._ -]{1,64}")


class AccessMiddleware:
    """Finds the holder of the token of a request. Rejects requests without a valid one, and writes of other
    sites, before their body is received.

    Args:
        app: the application.
        tokens: the valid tokens; None lets every request read and write.
    """

    def __init__(self, app: ASGIApp, tokens: Tokens | None) -> None:
        self._app = app
        self._tokens = tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in RESPONSE_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        try:
            headers = Headers(scope=scope)
            if scope["method"] not in SAFE_METHODS:
                _check_origin(headers)
            holder = self._holder(headers)
            if holder is None and scope["path"].startswith(PROTECTED):
                detail = "This service requires a token in the header Authorization: Bearer TOKEN."
                raise ServiceError(401, "unauthorized", detail)
            scope.setdefault("state", {})["holder"] = holder
        except ServiceError as error:
            await problem_response(error)(scope, receive, send_with_headers)
            return
        await self._app(scope, receive, send_with_headers)

    def _holder(self, headers: Headers) -> TokenHolder | None:
        """Return the holder of the token of a request; None without a token.

        Raises:
            ServiceError: 401, the token is wrong.
        """
        if self._tokens is None:
            return LOCAL
        given = headers.get("authorization")
        if given is None:
            return None
        scheme, _, token = given.partition(" ")
        holder = self._tokens.holder(token.strip()) if scheme.lower() == "bearer" else None
        if holder is None:
            raise ServiceError(401, "unauthorized", "The token is not valid for this service.")
        return holder


def _check_origin(headers: Headers) -> None:
    """Check that a request that may change something is not from a page of another site.

    Raises:
        ServiceError: 403, it is.
    """
    origin = headers.get("origin")
    if origin is not None and origin.partition("://")[2] != headers.get("host"):
        raise ServiceError(403, "other-origin", f"Pages of {origin[:200]} may not change anything here.")


def cancel_on_disconnect(app: ASGIApp) -> ASGIApp:
    """Return an application whose work for a request is cancelled when the client disconnects."""

    async def cancellable(scope: Scope, receive: Receive, send: Send) -> None:
        pieces, inbox = anyio.create_memory_object_stream[Message](1)

        async def watch() -> None:
            while (message := await receive())["type"] != "http.disconnect":
                await pieces.send(message)
            tasks.cancel_scope.cancel()

        with pieces, inbox:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(watch)
                await app(scope, inbox.receive, send)
                tasks.cancel_scope.cancel()

    return cancellable


def author_of(request: Request) -> str:
    """Return the author of the changes of a request: the name of the token, and that in X-Author, if any."""
    name: str = request.state.holder.name
    page = request.headers.get("x-author", "")
    return f"{name} ({page})" if _PAGE_NAME.fullmatch(page) else name


async def require_write(request: Request) -> None:
    """Reject a request with a token that may not write.

    Raises:
        ServiceError: 403, it may not.
    """
    if request.state.holder.role != "write":
        raise ServiceError(403, "forbidden", "This request requires a token that may write.")
