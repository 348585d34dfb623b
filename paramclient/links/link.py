"""What every link offers, and what all links over sockets share.

The sockets are plain non-blocking ones with `anyio.wait_readable`: anyio's own UDP socket keeps 100
datagrams and drops the rest without a word. `close` then takes effect at once: it wakes who waits and
frees the port before it returns, and there is no transport, task or thread that could outlive it.
"""

from __future__ import annotations

import errno
import socket
import sys
from abc import ABC, abstractmethod
from collections.abc import Hashable
from contextlib import suppress
from typing import Any, Final, NoReturn, Protocol, TypeAlias, runtime_checkable

import anyio

from paramclient.errors import LinkError
from paramclient.links.names import LinkSpec

__all__ = ["Address", "Link", "Peer", "SocketLink", "claim", "close_socket", "reason"]

Peer: TypeAlias = Hashable
"""Who sent something: an address on UDP, a connection on TCP, a constant on links with one far end."""

Address: TypeAlias = tuple[Any, ...]
"""A socket address: (host, port), with two more numbers for IPv6."""

OPEN_TIMEOUT: Final = 5.0
"""Seconds for finding a name and connecting. A TCP connection on a slow radio takes about one."""


@runtime_checkable
class Link(Protocol):
    """Bytes in and out.

    One task may wait in `receive` and one in `send` at a time; `open` and `close` may come from a third.
    Every call may be cancelled: what had arrived by then stays for the next `receive`.

    A link whose system tells when something arrived has an attribute `arrived_at` too: when each item of the
    last `receive` did, in their order, by the event loop's clock; an empty list where that is open.
    """

    @property
    def name(self) -> str:
        """The canonical name; the same for every link that was made from the same spelling."""

    @property
    def is_stream(self) -> bool:
        """Whether bytes come as a stream; otherwise as datagrams, which are never joined."""

    @property
    def reconnects(self) -> bool:
        """Whether `open` may bring the link back after a LinkError of `receive` or `send`."""

    async def open(self) -> None:
        """Make the link ready. LinkError when it cannot be; its cause is the operating system's error."""

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """Wait for bytes; give what is there, in order of arrival, and from whom.

        An empty bytes object says that a peer has left (streams only), and an empty list that nothing more
        will ever come, as at the end of a log: the next call then waits for `close`. LinkError: the link
        dropped, was closed, or is not open.
        """

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """Send to a peer, or with None to every peer that is known now.

        Nothing happens when that is nobody, or a peer that has gone. LinkError: the link dropped or is not
        open.
        """

    async def close(self) -> None:
        """End it and leave nothing behind. A waiting `receive` raises LinkError. Twice is as good as once."""


class SocketLink(ABC):
    """What the links over sockets share: their life, their name, and their errors.

    Attributes:
        name: the canonical name.
        address: where the link is bound, host and port, while it is open; else None. This tells the port
            that the system chose for port 0.
    """

    def __init__(self, spec: LinkSpec) -> None:
        self.name = spec.name
        self._host = spec.host
        self._port = spec.port
        self._socket: socket.socket | None = None
        self._openings = 0
        self._end: tuple[str, OSError | None] = ("closed", None)

    @property
    def address(self) -> tuple[str, int] | None:
        if self._socket is None:
            return None
        host, port, *_ = self._socket.getsockname()
        return host, port

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name} {'closed' if self._socket is None else 'open'}>"

    async def open(self) -> None:
        """See `Link.open`; a link that is open is closed first."""
        self._discard()
        opening = self._openings
        try:
            with anyio.fail_after(OPEN_TIMEOUT):
                await self._open(opening)
        except BaseException as error:
            if opening == self._openings:
                self._discard()
            if isinstance(error, OSError) and not isinstance(error, LinkError):
                raise self._error(self._refusal(error)) from error
            raise

    async def close(self) -> None:
        """See `Link.close`."""
        self._discard()

    @abstractmethod
    async def _open(self, opening: int) -> None:
        """Make the sockets; an OSError becomes a LinkError. `opening` is for `_adopt` and `_check`."""

    def _adopt(self, sock: socket.socket, opening: int) -> None:
        """Hold a new socket in place of one that failed, unless the link was closed while it was opened."""
        if opening != self._openings:
            sock.close()
        self._check(opening)
        if self._socket is not None:
            close_socket(self._socket)
        self._socket = sock

    def _discard(self) -> None:
        """Close what is open and wake who waits for it. From here on an `open` under way comes too late."""
        self._openings += 1
        self._end = ("closed", None)
        if self._socket is not None:
            close_socket(self._socket)
            self._socket = None

    def _fail(self, problem: str, cause: OSError | None = None) -> NoReturn:
        """Close the link because of a fault; who waits elsewhere gets the same LinkError."""
        self._discard()
        self._end = (problem, cause)
        raise self._error(problem) from cause

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise self._error("not open")
        return self._socket

    async def _readable(self, waitable: socket.socket | int) -> None:
        """Wait until there is something to read; LinkError when the link is closed meanwhile."""
        opening = self._openings
        with suppress(anyio.ClosedResourceError):
            await anyio.wait_readable(waitable)
        self._check(opening)

    def _check(self, opening: int) -> None:
        """LinkError when the link has been closed since it was opened as `opening`."""
        if opening != self._openings:
            problem, cause = self._end
            raise self._error(problem) from cause

    @property
    def _target(self) -> str:
        return f"[{self._host}]:{self._port}" if ":" in self._host else f"{self._host}:{self._port}"

    def _error(self, problem: str) -> LinkError:
        return LinkError(f"{self.name}: {problem}", link=self.name)

    def _refusal(self, error: OSError) -> str:
        if isinstance(error, TimeoutError):
            return f"no answer from {self._target}"
        if isinstance(error, ConnectionRefusedError):
            return f"connection refused by {self._target}"
        if error.errno == errno.EADDRINUSE or (sys.platform == "win32" and error.errno == errno.EACCES):
            return f"port {self._port} is in use by another program"
        if error.errno == errno.EADDRNOTAVAIL:
            return f"{self._host} is no address of this computer"
        return f"cannot open: {reason(error)}"

    async def _resolve(self, kind: socket.SocketKind) -> list[tuple[socket.AddressFamily, Address]]:
        """The addresses of the host. IPv4 comes first, because that is where MAVLink programs listen."""
        try:
            return _addresses(socket.getaddrinfo(self._host, self._port, type=kind, flags=_NUMERIC))
        except socket.gaierror:
            pass  # a name: ask the resolver, in a thread
        try:
            return _addresses(await anyio.getaddrinfo(self._host, self._port, type=kind))
        except socket.gaierror as error:
            raise self._error(f"host {self._host} not found: {reason(error)}") from error


def claim(sock: socket.socket) -> None:
    """Before it is bound: let nobody else have its port, whatever he asks for.

    Elsewhere than on Windows two sockets share a port only where both have asked for that.
    """
    if sys.platform == "win32":
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)


def close_socket(sock: socket.socket) -> None:
    """Close a socket and wake who waits for it with ClosedResourceError."""
    anyio.notify_closing(sock)
    sock.close()


def reason(error: OSError) -> str:
    """The operating system's words for an error, without its number."""
    return error.strerror or str(error)


_NUMERIC = socket.AI_NUMERICHOST | socket.AI_NUMERICSERV


def _addresses(found: Any) -> list[tuple[socket.AddressFamily, Address]]:
    pairs = [(family, address) for family, _, _, _, address in found]
    return sorted(pairs, key=lambda pair: pair[0] != socket.AF_INET)
