"""Accepts connections, before TLS and before HTTP: counts them, and waits for what each has to send first."""

from __future__ import annotations

import logging
import socket
import ssl
import struct
import sys
from collections.abc import Callable
from typing import Any, Final

import anyio
import anyio.abc

from paramclient.service import connections
from paramclient.service.log_limit import LogLimit
from paramclient.service.places import Place, Places, Stage

__all__ = ["Gate"]

HANDSHAKE_PATIENCE: Final = 5.0
"""Seconds for a TLS handshake, from the moment at which the connection is there."""
SHUTDOWN_PATIENCE: Final = 2.0
"""Seconds for a client to answer the end of TLS."""
ACCEPTED_AT_ONCE: Final = 16
"""Connections that are accepted before the event loop does other work again."""
ACCEPT_RETRY: Final = 0.25
"""Seconds until the next try where no connection could be accepted: no file or no memory was left."""
FLUSH_INTERVAL: Final = 5.0
"""Seconds between two looks whether lines that were left out of the log are to be told."""

logger = logging.getLogger(__name__)


class Gate:
    """Gives a protocol to each connection that finds a place and has sent something.

    A connection without a place is ended at once, so that the others, and the files of the process, stay
    what they are. Until a connection has sent its first byte it costs a socket and a task, and no TLS.

    Args:
        listener: a socket that listens, and does not block.
        places: for connections.
        protocol: makes the protocol of a connection.
        tls: of a server; None for none.
        limit: what keeps the log short.
    """

    def __init__(
        self,
        listener: socket.socket,
        places: Places,
        protocol: Callable[[Place], connections.Connection],
        *,
        tls: ssl.SSLContext | None,
        limit: LogLimit,
    ) -> None:
        self._listener = listener
        self._places = places
        self._protocol = protocol
        self._tls = tls
        self._limit = limit
        self._scope = anyio.CancelScope()

    async def run(self) -> None:
        """Accept connections until `close` is called."""
        with self._limit.of_libraries(), self._scope:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._flush)
                while True:
                    await anyio.wait_readable(self._listener)
                    if not self._accept(tasks):
                        await anyio.sleep(ACCEPT_RETRY)
        self._limit.flush(ends=True)

    def close(self) -> None:
        """Accept no more, and end the connections that are not being answered."""
        self._scope.cancel()
        self._places.end_all()

    def _accept(self, tasks: anyio.abc.TaskGroup) -> bool:
        """Accept some of those that wait; false where that cannot be done now."""
        for _ in range(ACCEPTED_AT_ONCE):
            try:
                accepted, address = self._listener.accept()
            except (BlockingIOError, InterruptedError):
                return True
            except ConnectionError:
                continue
            except OSError as error:
                self._limit.tell(logger, "accept", f"no connection can be accepted: {error.strerror}")
                return False
            place = self._places.take(address[0])
            if place is None:
                text = f"a connection from {address[0]} was refused: there are as many as there may be"
                self._limit.tell(logger, "full", text)
                _reset(accepted)
            else:
                tasks.start_soon(self._begin, _Placed.of(accepted, place), place, address[0])
        return True

    async def _begin(self, connection: _Placed, place: Place, address: str) -> None:
        """Wait for the first byte, and hand the connection over."""
        is_handed_over = False
        try:
            with anyio.CancelScope() as scope:
                place.leave = scope.cancel
                patience = connections.HEAD_PATIENCE if self._tls is None else HANDSHAKE_PATIENCE
                with anyio.fail_after(patience):
                    await anyio.wait_readable(connection)
                    if not connection.recv(1, socket.MSG_PEEK):
                        return  # it has left without a word
                    place.stage = Stage.BEGUN
                    protocol = self._protocol(place)
                    is_handed_over = True  # whatever happens, the transport closes the socket
                    options = {} if self._tls is None else _timeouts(self._tls)
                    await protocol.loop.connect_accepted_socket(lambda: protocol, connection, **options)
        except TimeoutError:
            what = "TLS handshake" if self._tls is not None else "request"
            text = f"a connection from {address} was ended: no {what} in {patience:.0f} s"
            self._limit.tell(logger, "silent", text, logging.INFO)
        except ssl.SSLError as error:
            reason = (error.reason or str(error)).replace("_", " ").lower()
            self._limit.tell(logger, "tls", f"the TLS handshake with {address} failed: {reason}")
        except OSError as error:
            self._limit.tell(logger, "lost", f"a connection from {address} was lost: {error}", logging.DEBUG)
        finally:
            if not is_handed_over:
                connection.close()

    async def _flush(self) -> None:
        while True:
            await anyio.sleep(FLUSH_INTERVAL)
            self._limit.flush()


class _Placed(socket.socket):
    """A socket that gives its place back when it is closed, whoever closes it."""

    place: Place | None = None

    @classmethod
    def of(cls, accepted: socket.socket, place: Place) -> _Placed:
        placed = cls(fileno=accepted.detach())
        placed.setblocking(False)
        placed.place = place
        return placed

    def close(self) -> None:
        super().close()
        if self.place is not None:
            self.place.free()


def _timeouts(tls: ssl.SSLContext) -> dict[str, Any]:
    return {
        "ssl": tls,
        "ssl_handshake_timeout": HANDSHAKE_PATIENCE,
        "ssl_shutdown_timeout": SHUTDOWN_PATIENCE,
    }


def _reset(connection: socket.socket) -> None:
    """End a connection at once, so that its other end sees it, and the system keeps nothing of it."""
    try:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_NOT)
    finally:
        connection.close()


_LINGER_NOT: Final = struct.pack("HH", 1, 0) if sys.platform == "win32" else struct.pack("ii", 1, 0)
