"""Accepting connections before TLS and HTTP: slots, timeouts, and TLS handshakes."""

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
from paramclient.service.connection_slots import ConnectionSlot, ConnectionSlots, ConnectionStage
from paramclient.service.log_limit import LogLimit

__all__ = ["Acceptor"]

HANDSHAKE_TIMEOUT: Final = 5.0
"""Timeout of a TLS handshake in seconds, from the start of the connection."""
TLS_SHUTDOWN_TIMEOUT: Final = 2.0
"""Timeout in seconds for the client's response to the end of TLS."""
ACCEPTS_PER_TURN: Final = 16
"""Maximum number of connections accepted in one turn of the event loop."""
ACCEPT_RETRY: Final = 0.25
"""Seconds until the next attempt after an error of `accept`, such as too many open files."""
SUPPRESSED_LINES_INTERVAL: Final = 5.0
"""Seconds between two checks for numbers of suppressed log lines."""

logger = logging.getLogger(__name__)


class Acceptor:
    """Accepts connections, and creates the protocol of each after its first byte.

    A connection without a free slot is reset immediately, which limits the open files of the process. Before
    its first byte, a connection needs only a socket and a task, and no TLS state.

    Args:
        listener: non-blocking listening socket.
        slots: slots of connections.
        protocol: creates the protocol of a connection.
        tls: TLS context of the server, or None.
        limit: limits log lines.
    """

    def __init__(
        self,
        listener: socket.socket,
        slots: ConnectionSlots,
        protocol: Callable[[ConnectionSlot], connections.ServiceConnection],
        *,
        tls: ssl.SSLContext | None,
        limit: LogLimit,
    ) -> None:
        self._listener = listener
        self._slots = slots
        self._protocol = protocol
        self._tls = tls
        self._limit = limit
        self._scope = anyio.CancelScope()

    async def run(self) -> None:
        """Accept connections until `close`."""
        with self._limit.limit_libraries(), self._scope:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._flush)
                while True:
                    await anyio.wait_readable(self._listener)
                    if not self._accept(tasks):
                        await anyio.sleep(ACCEPT_RETRY)
        self._limit.flush(ends=True)

    def close(self) -> None:
        """Stop accepting, and close the connections without a request in progress."""
        self._scope.cancel()
        self._slots.close_idle()

    def _accept(self, tasks: anyio.abc.TaskGroup) -> bool:
        """Accept waiting connections. Return False after an error."""
        for _ in range(ACCEPTS_PER_TURN):
            try:
                accepted, address = self._listener.accept()
            except (BlockingIOError, InterruptedError):
                return True
            except ConnectionError:
                continue
            except OSError as error:
                self._limit.log(logger, "accept", f"cannot accept a connection: {error.strerror}")
                return False
            slot = self._slots.take(address[0])
            if slot is None:
                text = f"refused a connection from {address[0]}: the maximum number of connections is reached"
                self._limit.log(logger, "full", text)
                _reset(accepted)
            else:
                tasks.start_soon(self._hand_over, _SlotSocket.of(accepted, slot), slot, address[0])
        return True

    async def _hand_over(self, connection: _SlotSocket, slot: ConnectionSlot, address: str) -> None:
        """Wait for the first byte, then pass the connection to its protocol."""
        is_handed_over = False
        try:
            with anyio.CancelScope() as scope:
                slot.close = scope.cancel
                timeout = connections.REQUEST_HEAD_TIMEOUT if self._tls is None else HANDSHAKE_TIMEOUT
                with anyio.fail_after(timeout):
                    await anyio.wait_readable(connection)
                    if not connection.recv(1, socket.MSG_PEEK):
                        return  # closed without a request
                    slot.stage = ConnectionStage.STARTED
                    protocol = self._protocol(slot)
                    is_handed_over = True  # the transport closes the socket in all cases
                    options = {} if self._tls is None else _timeouts(self._tls)
                    await protocol.loop.connect_accepted_socket(lambda: protocol, connection, **options)
        except TimeoutError:
            what = "TLS handshake" if self._tls is not None else "request"
            text = f"closed a connection from {address}: no {what} within {timeout:.0f} s"
            self._limit.log(logger, "silent", text, logging.INFO)
        except ssl.SSLError as error:
            reason = (error.reason or str(error)).replace("_", " ").lower()
            self._limit.log(logger, "tls", f"TLS handshake with {address} failed: {reason}")
        except OSError as error:
            self._limit.log(logger, "lost", f"lost a connection from {address}: {error}", logging.DEBUG)
        finally:
            if not is_handed_over:
                connection.close()

    async def _flush(self) -> None:
        while True:
            await anyio.sleep(SUPPRESSED_LINES_INTERVAL)
            self._limit.flush()


class _SlotSocket(socket.socket):
    """A socket that frees its slot when it is closed."""

    slot: ConnectionSlot | None = None

    @classmethod
    def of(cls, accepted: socket.socket, slot: ConnectionSlot) -> _SlotSocket:
        wrapped = cls(fileno=accepted.detach())
        wrapped.setblocking(False)
        wrapped.slot = slot
        return wrapped

    def close(self) -> None:
        super().close()
        if self.slot is not None:
            self.slot.release()


def _timeouts(tls: ssl.SSLContext) -> dict[str, Any]:
    return {
        "ssl": tls,
        "ssl_handshake_timeout": HANDSHAKE_TIMEOUT,
        "ssl_shutdown_timeout": TLS_SHUTDOWN_TIMEOUT,
    }


def _reset(connection: socket.socket) -> None:
    """Close a connection with RST, so that the client notices and the system keeps no state."""
    try:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_NOT)
    finally:
        connection.close()


_LINGER_NOT: Final = struct.pack("HH", 1, 0) if sys.platform == "win32" else struct.pack("ii", 1, 0)
