"""The HTTP server: access tokens, the checks of each request, the application with its routes and page, and
uvicorn with its limits.

Tokens come in the header Authorization only. There are no cookies, so a page of another site has no authority
to use. Without tokens, every program of this computer may write; pages of other sites must not, and are
recognized by the header Origin, which browsers send with every write.
"""

from __future__ import annotations

import asyncio
import hashlib
import os
import re
import secrets
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import anyio
import uvicorn
from fastapi import FastAPI
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from paramclient.client.signing import read_private
from paramclient.errors import LinkError, UsageError
from paramclient.protocol.channel import task_group
from paramclient.service import routes
from paramclient.service.hub import Hub
from paramclient.service.problems import ERRORS, RESPONSES, Problem, ServiceError, problem_response, respond
from paramclient.version import __version__

BODY_BYTES_MAX: Final = 4 * 2**20
"""Maximum size of a request body in bytes: a parameter file of 2 MB in base64, and some."""
_ADDRESS: Final = re.compile(r"(?:\[([0-9a-fA-F:.]+)\]|([^:\s]+))(?::([0-9]{1,5}))?")
"""A host and a port; an IPv6 address is in brackets."""
CONNECTIONS_MAX: Final = 200
"""Maximum number of connections, and of requests; further ones get the status 503."""
IDLE_TIMEOUT: Final = 30
"""Seconds after a response in which a connection without a request is closed."""
SHUTDOWN_TIMEOUT: Final = 1
"""Seconds for responses in progress at shutdown; their connections are then closed."""


# tokens


TOKEN_BYTES: Final = 32
"""Number of random bytes of a token: it cannot be guessed, so wrong tokens need no delay."""
TOKEN_FILE_BYTES_MAX: Final = 100_000
"""Maximum size of a token file in bytes: a line that is cut off there is invalid."""
_LINE: Final = re.compile(r"([A-Za-z0-9._-]{1,32})\s+(read|write)\s+sha256:([0-9a-f]{64})")


class TokenHolder(NamedTuple):
    """Holder of a token.

    Attributes:
        name: its name in the history.
        role: "read", or "write" for both.
    """

    name: str
    role: str


Tokens: TypeAlias = Mapping[str, TokenHolder]
"""The holders of the valid tokens, by the SHA-256 of each: the time of a look-up tells nothing of a token."""


def read_tokens(path: str | os.PathLike[str]) -> Tokens:
    """Read a token file, which only its owner may access.

    A line is `NAME ROLE sha256:DIGEST`; `#` starts a comment.

    Raises:
        UsageError: the file cannot be read, other users can access it, a line is invalid, two have the same
            name or token, or there is none. The message contains no part of a line.
    """
    return _parse_tokens(_read(path), os.fspath(path))


def add_token(path: str | os.PathLike[str], name: str, role: str) -> str:
    """Create a token, append the line with its digest to a file, and return it. A new file has the mode 0600.

    Args:
        path: the file.
        name: of the holder.
        role: "read" or "write".

    Raises:
        UsageError: the file cannot be written, is accessible by other users, is not a token file, or contains
            the name; or the name is not valid.
    """
    token = secrets.token_urlsafe(TOKEN_BYTES)
    line = f"{name} {role} sha256:{_digest(token)}\n"
    if _LINE.fullmatch(line.strip()) is None:
        raise UsageError("a name must have 1 to 32 letters, digits, dots, hyphens and underscores")
    try:
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0), 0o600))
        before = _read(path)
        added = line if before.endswith("\n") or not before else f"\n{line}"
        _parse_tokens(before + added, os.fspath(path))
        with Path(path).open("a", encoding="ascii") as file:
            file.write(added)
    except OSError as error:
        raise UsageError(f"{os.fspath(path)}: the token cannot be written: {error.strerror}") from error
    return token


def _read(path: str | os.PathLike[str]) -> str:
    return read_private(path, "file of tokens", TOKEN_FILE_BYTES_MAX).decode("utf-8", "replace")


def _parse_tokens(text: str, source: str) -> Tokens:
    holders: dict[str, TokenHolder] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        found = _LINE.fullmatch(line.strip())
        if found is None:
            raise UsageError(f"{source}: line {number} is not NAME ROLE sha256:DIGEST of `paramclient token`")
        holder = TokenHolder(found[1], found[2])
        if found[3] in holders or holder.name in {each.name for each in holders.values()}:
            raise UsageError(f"{source}: line {number} repeats a name or a token")
        holders[found[3]] = holder
    if not holders:
        raise UsageError(f"{source}: the file has no token; create one with `paramclient token`")
    return holders


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).hexdigest()


# requests


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


def guard(app: ASGIApp, tokens: Tokens | None) -> ASGIApp:
    """Return an application that finds the holder of the token of each request.

    It rejects requests without a valid one, and writes of other sites, before their body is received.
    """

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in RESPONSE_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        try:
            scope.setdefault("state", {})["holder"] = _holder_of(scope, tokens)
        except (ServiceError, HTTPException) as error:
            await problem_response(error)(scope, receive, send_with_headers)
        else:
            # of a HEAD, the server leaves the body out
            await app({**scope, "method": scope["method"].replace("HEAD", "GET")}, receive, send_with_headers)

    return guarded


def _holder_of(scope: Scope, tokens: Tokens | None) -> TokenHolder | None:
    """Return the holder of the token of a request; None without a token where none is needed.

    Raises:
        ServiceError: 400, the host is not this computer, without tokens; 401, a token is missing or wrong;
            403, a page of another site would change something.
        HTTPException: 413, the body is too long.
    """
    headers = Headers(scope=scope)
    origin, given = headers.get("origin"), headers.get("authorization")
    is_write = scope["method"] not in SAFE_METHODS
    if is_write and origin is not None and origin.partition("://")[2] != headers.get("host"):
        raise ServiceError(403, "other-origin", f"Pages of {origin[:200]} may not change anything here.")
    if int(headers.get("content-length", 0)) > BODY_BYTES_MAX:
        raise HTTPException(413)
    if tokens is None:
        found = _ADDRESS.fullmatch(headers.get("host", ""))
        if found is None or not _is_loopback(found[1] or found[2]):  # the name of another site points here
            raise ServiceError(400, "invalid-host", "Without tokens, the host must be this computer.")
        return LOCAL
    if given is not None:
        scheme, _, token = given.partition(" ")
        holder = tokens.get(_digest(token.strip())) if scheme.lower() == "bearer" else None
        if holder is None:
            raise ServiceError(401, "unauthorized", "The token is not valid for this service.")
        return holder
    if scope["path"].startswith(PROTECTED):
        raise ServiceError(401, "unauthorized", "A token is required: Authorization: Bearer TOKEN.")
    return None


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


# the application


class _Application(FastAPI):
    """FastAPI whose description is valid OpenAPI 3.1: the schema of an event is of 3.2.

    With a model, FastAPI would describe errors as application/json too.
    """

    def openapi(self) -> dict[str, Any]:
        described = super().openapi()
        content = described["paths"]["/api/events"]["get"]["responses"]["200"]["content"]
        content["text/event-stream"] = {"schema": {"type": "string"}}
        described["components"]["schemas"]["Problem"] = Problem.model_json_schema()
        return described


def create_app(hub: Hub, *, tokens: Tokens | None = None) -> FastAPI:
    """Create the application over a hub, which the caller opens and closes.

    Args:
        hub: links and cache.
        tokens: the valid tokens; None lets every program of this computer read and write.
    """
    app = _Application(
        title="paramclient",
        version=__version__,
        summary="MAVLink parameters of the vehicles on the links of this service",
        docs_url=None,  # its scripts would come from another site
        redoc_url=None,
        redirect_slashes=False,
        responses=RESPONSES,
        exception_handlers=dict.fromkeys(ERRORS, respond),
    )
    app.state.hub = hub
    app.add_middleware(RequestBodyLimitMiddleware, max_body_size=BODY_BYTES_MAX)
    app.add_middleware(cancel_on_disconnect)
    app.add_middleware(guard, tokens=tokens)
    for router in (routes.public, routes.reading, routes.writing):
        app.include_router(router)
    app.router.default = StaticFiles(packages=[("paramclient.service", "page")], html=True)
    return app


def listen_at(address: str, *, is_protected: bool) -> tuple[socket.socket, str]:
    """Return a listening socket and its URL.

    Args:
        address: `HOST:PORT`; an IPv6 address is in brackets, and port 0 is any free port.
        is_protected: whether other computers may connect.

    Raises:
        UsageError: the address has another format, or other computers could connect.
        LinkError: the address cannot be listened on.
    """
    found = _ADDRESS.fullmatch(address)
    if found is None or int(found[3] or 65_536) > 65_535:  # the highest TCP port
        raise UsageError(f"{address!r} is not HOST:PORT such as 127.0.0.1:8765 or [::1]:0")
    host, family = (found[1], socket.AF_INET6) if found[1] else (found[2], socket.AF_INET)
    if not (is_protected or _is_loopback(host)):
        raise UsageError(f"{host} is no loopback address: a service for other computers needs --tokens FILE")
    try:
        opened = socket.create_server((host, int(found[3])), family=family)
    except OSError as error:
        raise LinkError(f"cannot listen on {address}: {error.strerror}", link=address) from error
    return opened, f"http://{address.rpartition(':')[0]}:{opened.getsockname()[1]}"


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


class _Server(uvicorn.Server):
    """uvicorn without signal handlers: the command has its own."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def disconnect(self) -> None:
        """Close the connections, which cancels their requests: uvicorn itself would log each as an error."""
        for connection in list(self.server_state.connections):
            connection.transport.abort()


async def serve(
    hub: Hub,
    address: str,
    *,
    tokens: Tokens | None = None,
    stop: anyio.Event,
    listens: Callable[[str], None],
) -> None:
    """Open a hub and serve it until `stop` is set. At the end, the cache is written.

    Args:
        hub: links and cache, not yet open.
        address: `HOST:PORT` to listen on.
        tokens: the valid tokens; None only for a loopback address.
        stop: ends the call when set.
        listens: called with the URL as soon as the service accepts connections.

    Raises:
        LinkError: the address cannot be listened on, or an endpoint for ground stations.
        UsageError: the address is invalid, or other computers could connect without tokens.
    """
    config = uvicorn.Config(
        create_app(hub, tokens=tokens),
        lifespan="off",
        ws="none",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        limit_concurrency=CONNECTIONS_MAX,
        timeout_keep_alive=IDLE_TIMEOUT,
    )
    server = _Server(config)
    opened, url = listen_at(address, is_protected=tokens is not None)
    with opened:
        async with task_group() as tasks:
            try:
                async with hub:
                    tasks.start_soon(server.serve, [opened])
                    while not server.started:  # noqa: ASYNC110 - uvicorn has no event for it
                        await anyio.sleep(0.01)
                    listens(url)
                    await stop.wait()
            finally:
                server.should_exit = True
                asyncio.get_running_loop().call_later(SHUTDOWN_TIMEOUT, server.disconnect)
