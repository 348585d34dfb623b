"""The HTTP server of the service: the application with its middleware, routes and page; uvicorn with its
limits; start and shutdown."""

from __future__ import annotations

import contextlib
import re
import socket
from collections.abc import Callable, Generator
from dataclasses import dataclass
from importlib import resources
from ipaddress import ip_address
from typing import Final

import anyio
import uvicorn
from fastapi import FastAPI
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.staticfiles import StaticFiles

from paramclient.errors import LinkError, UsageError
from paramclient.service import routes
from paramclient.service.access import AccessMiddleware, Tokens, cancel_on_disconnect
from paramclient.service.hub import Hub
from paramclient.service.problems import ERRORS, RESPONSES, respond
from paramclient.version import __version__

__all__ = ["Listening", "create_app", "serve"]

BODY_BYTES_MAX: Final = 4 * 2**20
"""Maximum size of a request body in bytes: a parameter file of 2 MB in base64, and some."""
LOOPBACK_NAMES: Final = ("localhost", "127.0.0.1", "[::1]")
"""Names of this computer in the header Host: without tokens, no other site can point its name at the service
and let its pages read."""
CONNECTIONS_MAX: Final = 200
"""Maximum number of connections, and of requests; further ones get the status 503."""
IDLE_TIMEOUT: Final = 30
"""Seconds after which an idle connection is closed."""
PORT_MAX: Final = 65_535
"""The highest TCP port."""
HEADER_BYTES_MAX: Final = 32_768
"""Maximum size of the headers of a request in bytes."""
SHUTDOWN_TIMEOUT: Final = 1
"""Seconds for responses in progress at shutdown; their requests are then cancelled."""


def create_app(hub: Hub, *, tokens: Tokens | None = None) -> FastAPI:
    """Create the application over a hub, which the caller opens and closes.

    Args:
        hub: links and cache.
        tokens: the valid tokens; None lets every program of this computer read and write.
    """
    app = FastAPI(
        title="paramclient",
        version=__version__,
        summary="MAVLink parameters of the vehicles on the links of this service",
        docs_url=None,  # its scripts would come from another site
        redoc_url=None,
        responses=RESPONSES,
        exception_handlers=dict.fromkeys(ERRORS, respond),
    )
    app.state.hub = hub
    app.add_middleware(RequestBodyLimitMiddleware, max_body_size=BODY_BYTES_MAX)
    app.add_middleware(cancel_on_disconnect)
    app.add_middleware(AccessMiddleware, tokens=tokens)
    if tokens is None:
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=LOOPBACK_NAMES, www_redirect=False)
    for router in routes.ROUTERS:
        app.include_router(router)
    page = resources.files("paramclient.service").joinpath("page")
    app.mount("/", StaticFiles(directory=str(page), html=True))
    return app


@dataclass(frozen=True, slots=True)
class Listening:
    """Listening address of the service.

    Attributes:
        host: host name or IP address.
        port: TCP port; 0 for any free port.
    """

    host: str = "127.0.0.1"
    port: int = 8765

    @classmethod
    def at(cls, text: str) -> Listening:
        """Parse `HOST:PORT`; an IPv6 address is in brackets.

        Raises:
            UsageError: the text has another format.
        """
        found = re.fullmatch(r"(?:\[([0-9a-fA-F:.]+)\]|([^:\s]+)):([0-9]{1,5})", text)
        if found is None or int(found[3]) > PORT_MAX:
            what = "is not a listening address HOST:PORT such as 127.0.0.1:8765 or [::1]:0"
            raise UsageError(f"{text!r} {what}")
        return cls(found[1] or found[2], int(found[3]))

    @property
    def is_loopback(self) -> bool:
        """Whether only programs of this computer can connect."""
        try:
            return ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    def open(self) -> tuple[socket.socket, str]:
        """Return a listening socket and its URL.

        Raises:
            LinkError: the address cannot be listened on.
        """
        is_v6 = ":" in self.host
        name = f"[{self.host}]" if is_v6 else self.host
        try:
            family = socket.AF_INET6 if is_v6 else socket.AF_INET
            opened = socket.create_server((self.host, self.port), family=family)
        except OSError as error:
            where = f"{name}:{self.port}"
            raise LinkError(f"cannot listen on {where}: {error.strerror}", link=where) from error
        return opened, f"http://{name}:{opened.getsockname()[1]}"


class _Server(uvicorn.Server):
    """uvicorn without its signal handlers: the command has its own."""

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        yield


async def serve(
    hub: Hub,
    *,
    listening: Listening | None = None,
    tokens: Tokens | None = None,
    stop: anyio.Event | None = None,
    listens: Callable[[str], None] | None = None,
) -> None:
    """Open a hub and serve it until `stop` is set. At the end, the cache is written.

    Args:
        hub: links and cache, not yet open.
        listening: listening address.
        tokens: the valid tokens; None only for a loopback address.
        stop: ends the call when set; None for no end but cancellation.
        listens: called with the URL as soon as the service accepts connections.

    Raises:
        LinkError: the address cannot be listened on.
        UsageError: other computers could connect without tokens.
    """
    listening = Listening() if listening is None else listening
    stop = anyio.Event() if stop is None else stop
    if tokens is None and not listening.is_loopback:
        raise UsageError(
            f"{listening.host} is not a loopback address: a service for other computers needs --tokens FILE"
        )
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
        timeout_graceful_shutdown=SHUTDOWN_TIMEOUT,
        h11_max_incomplete_event_size=HEADER_BYTES_MAX,
    )
    server = _Server(config)
    opened, url = listening.open()
    with opened:
        async with anyio.create_task_group() as tasks:
            try:
                async with hub:
                    tasks.start_soon(server.serve, [opened])
                    while not server.started:  # noqa: ASYNC110 - uvicorn has no event for it
                        await anyio.sleep(0.01)
                    if listens is not None:
                        listens(url)
                    await stop.wait()
            finally:
                server.should_exit = True
