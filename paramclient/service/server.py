"""The service as a server: its socket, uvicorn with our settings, and a good end."""

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
from paramclient.service.app import Settings, create_app
from paramclient.service.connections import Connection, WebSocketConnection
from paramclient.service.gate import Gate
from paramclient.service.hub import Hub
from paramclient.service.log_limit import LogLimit
from paramclient.service.places import Place, Places
from paramclient.service.tls import tls_of

__all__ = ["Listening", "serve"]

BACKLOG: Final = 256
"""Connections that may wait to be accepted: all listeners that come back at once after a restart."""
ENDING_TIME: Final = 1.5
"""Seconds for answers that are under way when the service ends; then their connections are cut off."""
CUT_OFF_TIME: Final = 0.5
"""Seconds for requests to notice that their connection was cut off; then they are cancelled."""
ENDING_INTERVAL: Final = 0.02
"""Seconds between two looks whether all has ended."""
KEEP_ALIVE: Final = 30.0
"""Seconds for which a connection without a request is kept."""
LARGEST_FRAME: Final = 4_096
"""Bytes of a WebSocket message to us; nothing is expected."""


@dataclass(frozen=True, slots=True)
class Listening:
    """Where to listen.

    Attributes:
        host, port: port 0 lets the system choose.
        tls_cert, tls_key: files in PEM, or neither.
    """

    host: str = "127.0.0.1"
    port: int = 8765
    tls_cert: Path | None = None
    tls_key: Path | None = None

    @classmethod
    def at(cls, text: str, *, tls_cert: Path | None = None, tls_key: Path | None = None) -> Listening:
        """What `HOST:PORT` means; an IPv6 address stands in brackets.

        Raises:
            UsageError: it is none.
        """
        host, colon, port = text.rpartition(":")
        bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
        is_number = port.isascii() and port.isdecimal() and int(port) < 1 << 16
        if not (colon and bare and is_number) or (":" in bare and bare == host):
            raise UsageError(f"where to listen is HOST:PORT, such as 127.0.0.1:8765 or [::1]:0, not {text!r}")
        return cls(bare, int(port), tls_cert, tls_key)

    @property
    def url(self) -> str:
        """Its address."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'http' if self.tls_cert is None else 'https'}://{host}:{self.port}"


class _Server(uvicorn.Server):
    """Accepts by a gate, tells when it is ready, and leaves signals to whoever has started it."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.is_ready = anyio.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await self.lifespan.startup()
        self.started = True
        self.is_ready.set()

    def protocol(self, place: Place) -> Connection:
        """The protocol of a new connection."""
        return Connection(
            place, config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Let answers come to their end for a while; then cut off whoever does not take them."""
        state = self.server_state
        for connection in list(state.connections):
            connection.shutdown()
        with anyio.move_on_after(ENDING_TIME):
            while state.connections or state.tasks:  # noqa: ASYNC110 - these sets tell nobody
                await anyio.sleep(ENDING_INTERVAL)
        self.cut_off()
        with anyio.move_on_after(CUT_OFF_TIME):
            while state.tasks:  # noqa: ASYNC110
                await anyio.sleep(ENDING_INTERVAL)
        for task in state.tasks:
            task.cancel()

    def cut_off(self) -> None:
        """End all connections at once."""
        for connection in list(self.server_state.connections):
            connection.transport.abort()

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        yield


class _Ending:
    """An application whose requests may be cancelled when the service ends, and nothing is wrong then."""

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
    """Serve a hub, which is not open yet, until `stop` is set; then end in good order.

    Streams of events end, calls that wait are answered with a problem, the cache is written. Cancelled, it
    cuts connections off, and writes the cache all the same. It runs on asyncio alone, as uvicorn does.

    Args:
        hub: the links and the cache.
        settings: of the application.
        listening: where.
        stop: what ends it; None for nothing but cancellation.
        listens: is told the address when it can be reached.

    Raises:
        LinkError: nobody can listen there.
        UsageError: the certificate cannot be used, or others could connect and there are no tokens.
    """
    listening = Listening() if listening is None else listening
    settings = Settings() if settings is None else settings
    settings = replace(settings, access=replace(settings.access, listen=listening.host))
    stop = anyio.Event() if stop is None else stop
    app = _Ending(create_app(hub, settings), stop)
    config = _config(app, listening)
    opened = _open(listening)
    server = _Server(config)
    try:
        port: int = opened.getsockname()[1]
        url = Listening(listening.host, port, listening.tls_cert, listening.tls_key).url
        async with anyio.create_task_group() as tasks, hub:
            tasks.start_soon(server.serve)
            await server.is_ready.wait()
            places = Places(is_proxy=settings.access.is_proxy)
            gate = Gate(opened, places, server.protocol, tls=config.ssl, limit=LogLimit())
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
        server.cut_off()


def _config(app: ASGIApp, listening: Listening) -> uvicorn.Config:
    tls = tls_of(listening.tls_cert, listening.tls_key)
    return uvicorn.Config(
        app,
        lifespan="off",
        http=Connection,
        ws=WebSocketConnection,
        ws_max_size=LARGEST_FRAME,
        ws_per_message_deflate=False,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_keep_alive=int(KEEP_ALIVE),
        ssl_certfile=None if tls is None else tls.cert,
        ssl_keyfile=None if tls is None else tls.key,
    )


def _open(listening: Listening) -> socket.socket:
    """A socket that is bound."""
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
