"""The HTTP server of the service: listening socket, uvicorn with its settings, and shutdown."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import anyio
import uvicorn
from starlette.types import ASGIApp, Receive, Scope, Send

from paramclient.errors import LinkError, UsageError
from paramclient.service.acceptor import Acceptor
from paramclient.service.app import Settings, create_app
from paramclient.service.connection_slots import ConnectionSlot, ConnectionSlots
from paramclient.service.connections import ServiceConnection, WebSocketConnection
from paramclient.service.hub import Hub
from paramclient.service.log_limit import LogLimit
from paramclient.service.tls import tls_of

__all__ = ["Listening", "serve"]

BACKLOG: Final = 256
"""Maximum number of connections waiting for `accept`: all event listeners reconnect at once after a
restart."""
SHUTDOWN_TIMEOUT: Final = 1.5
"""Timeout in seconds for responses in progress at shutdown. Their connections are then aborted."""
CANCEL_TIMEOUT: Final = 0.5
"""Timeout in seconds for requests of aborted connections. They are then cancelled."""
SHUTDOWN_CHECK_INTERVAL: Final = 0.02
"""Seconds between two checks whether all requests have ended."""
IDLE_CONNECTION_TIMEOUT: Final = 30.0
"""Seconds after which an idle connection is closed."""
WEBSOCKET_MESSAGE_BYTES_MAX: Final = 4_096
"""Maximum size of a received WebSocket message in bytes; none is expected."""


@dataclass(frozen=True, slots=True)
class Listening:
    """Listening address of the service.

    Attributes:
        host: host name or IP address.
        port: TCP port; 0 for any free port.
        tls_cert: path of the certificate in PEM, or None.
        tls_key: path of its private key in PEM, or None.
    """

    host: str = "127.0.0.1"
    port: int = 8765
    tls_cert: Path | None = None
    tls_key: Path | None = None

    @classmethod
    def at(cls, text: str, *, tls_cert: Path | None = None, tls_key: Path | None = None) -> Listening:
        """Parse `HOST:PORT`; an IPv6 address is in brackets.

        Raises:
            UsageError: the text has another format.
        """
        host, colon, port = text.rpartition(":")
        bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
        is_number = port.isascii() and port.isdecimal() and int(port) < 1 << 16
        if not (colon and bare and is_number) or (":" in bare and bare == host):
            raise UsageError(
                f"{text!r} is not a listening address HOST:PORT such as 127.0.0.1:8765 or [::1]:0"
            )
        return cls(bare, int(port), tls_cert, tls_key)

    @property
    def url(self) -> str:
        """Return the URL of the service."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'http' if self.tls_cert is None else 'https'}://{host}:{self.port}"


class _Server(uvicorn.Server):
    """uvicorn without its own listening socket and signal handlers; `is_ready` is set after its start."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.is_ready = anyio.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await self.lifespan.startup()
        self.started = True
        self.is_ready.set()

    def protocol(self, slot: ConnectionSlot) -> ServiceConnection:
        """Return the protocol of a new connection."""
        return ServiceConnection(
            slot, config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Wait for responses in progress, then abort connections and cancel requests."""
        state = self.server_state
        for connection in list(state.connections):
            connection.shutdown()
        with anyio.move_on_after(SHUTDOWN_TIMEOUT):
            while state.connections or state.tasks:  # noqa: ASYNC110 - uvicorn's sets have no event
                await anyio.sleep(SHUTDOWN_CHECK_INTERVAL)
        self.abort_connections()
        with anyio.move_on_after(CANCEL_TIMEOUT):
            while state.tasks:  # noqa: ASYNC110
                await anyio.sleep(SHUTDOWN_CHECK_INTERVAL)
        for task in state.tasks:
            task.cancel()

    def abort_connections(self) -> None:
        """Abort all connections."""
        for connection in list(self.server_state.connections):
            connection.transport.abort()

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        yield


class _ShutdownCancellation:
    """Runs an application whose requests may be cancelled without an error at shutdown."""

    def __init__(self, app: ASGIApp, stop: anyio.Event) -> None:
        self._app = app
        self._stop = stop

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self._app(scope, receive, send)
        except anyio.get_cancelled_exc_class():
            if not self._stop.is_set():
                raise


async def serve(
    hub: Hub,
    settings: Settings | None = None,
    *,
    listening: Listening | None = None,
    stop: anyio.Event | None = None,
    listens: Callable[[str], None] | None = None,
) -> None:
    """Open a hub and serve it until `stop` is set.

    At the end, event streams end, waiting requests get a problem as response, and the cache is written.
    Cancellation aborts connections, and writes the cache too. Runs on asyncio only, because of uvicorn.

    Args:
        hub: links and cache, not yet open.
        settings: settings of the application.
        listening: listening address.
        stop: ends the call when set; None for no end but cancellation.
        listens: called with the URL as soon as the service accepts connections.

    Raises:
        LinkError: the address cannot be listened on.
        UsageError: the certificate is invalid, or other computers could connect without tokens.
    """
    listening = Listening() if listening is None else listening
    settings = Settings() if settings is None else settings
    settings = replace(settings, access=replace(settings.access, listen=listening.host))
    stop = anyio.Event() if stop is None else stop
    app = _ShutdownCancellation(create_app(hub, settings), stop)
    config = _config(app, listening)
    opened = _open(listening)
    server = _Server(config)
    try:
        port: int = opened.getsockname()[1]
        url = Listening(listening.host, port, listening.tls_cert, listening.tls_key).url
        async with anyio.create_task_group() as tasks, hub:
            tasks.start_soon(server.serve)
            await server.is_ready.wait()
            slots = ConnectionSlots(is_proxy=settings.access.is_proxy)
            gate = Acceptor(opened, slots, server.protocol, tls=config.ssl, limit=LogLimit())
            tasks.start_soon(gate.run)
            if listens is not None:
                listens(url)
            try:
                await stop.wait()
            finally:
                gate.close()
                server.should_exit = True
    finally:
        opened.close()
        server.abort_connections()


def _config(app: ASGIApp, listening: Listening) -> uvicorn.Config:
    tls = tls_of(listening.tls_cert, listening.tls_key)
    return uvicorn.Config(
        app,
        lifespan="off",
        http=ServiceConnection,
        ws=WebSocketConnection,
        ws_max_size=WEBSOCKET_MESSAGE_BYTES_MAX,
        ws_per_message_deflate=False,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_keep_alive=int(IDLE_CONNECTION_TIMEOUT),
        ssl_certfile=None if tls is None else tls.cert,
        ssl_keyfile=None if tls is None else tls.key,
    )


def _open(listening: Listening) -> socket.socket:
    """Return a listening socket.

    Raises:
        LinkError: the address cannot be listened on.
    """
    where = f"{listening.host}:{listening.port}"
    try:
        found = socket.getaddrinfo(
            listening.host, listening.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        family, kind, protocol, _, address = found[0]
        opened = socket.socket(family, kind, protocol)
    except OSError as error:
        raise LinkError(f"cannot listen on {where}: {error.strerror}", link=where) from error
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind(address)
        opened.listen(BACKLOG)
        opened.setblocking(False)
    except OSError as error:
        opened.close()
        raise LinkError(f"cannot listen on {where}: {error.strerror}", link=where) from error
    return opened
