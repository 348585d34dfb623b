"""The interface of links, and the base class of links over sockets.

The sockets are non-blocking and used with `anyio.wait_readable`, because anyio's own UDP socket keeps 100
datagrams and drops all others silently. `close` takes effect immediately: it wakes waiting tasks and frees
the port before it returns, and no transport, task or thread outlives it.
"""

from __future__ import annotations

import socket
import sys
from abc import ABC, abstractmethod
from collections.abc import Hashable
from contextlib import suppress
from typing import Any, Final, NoReturn, Protocol, TypeAlias, runtime_checkable

import anyio

from paramclient.errors import LinkError
from paramclient.links.names import LinkSpec
from paramclient.links.refusals import host_refusal, socket_refusal

__all__ = ["Address", "Link", "Peer", "SocketLink", "claim", "close_socket"]

Peer: TypeAlias = Hashable
"""The sender of data: an address on UDP, a connection on TCP, a constant on links with one remote end."""

Address: TypeAlias = tuple[Any, ...]
"""A socket address: (host, port), with two more numbers for IPv6."""

OPEN_TIMEOUT: Final = 5.0
"""Seconds for resolving a name and connecting. A TCP connection on a slow radio takes about 1 s."""


@runtime_checkable
class Link(Protocol):
    """A link: receives and sends bytes.

    One task may wait in `receive` and one in `send` at a time; a third may call `open` and `close`. Every
    call may be cancelled: data that had arrived by then stays for the next `receive`.
    """

    @property
    def name(self) -> str:
        """The canonical name; equal for all spellings of the same link."""

    @property
    def is_stream(self) -> bool:
        """Whether the link is a byte stream; otherwise it delivers datagrams, which are never joined."""

    @property
    def reconnects(self) -> bool:
        """Whether `open` may restore the link after a LinkError of `receive` or `send`."""

    async def open(self) -> None:
        """Open the link. LinkError if that fails; its cause is the operating system's error."""

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """Wait for data; return all received data with its peers, in order of arrival.

        Empty bytes mean that the peer has disconnected (streams only). An empty list means that there will be
        no more data, as at the end of a log: the next call waits for `close`. LinkError: the link dropped,
        was closed, or is not open.
        """

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """Send to a peer, or with None to all known peers.

        Does nothing if there is no known peer, or the peer has disconnected. LinkError: the link dropped or
        is not open.
        """

    async def close(self) -> None:
        """Close the link and release its resources. A waiting `receive` raises LinkError. Idempotent."""


class SocketLink(ABC):
    """Base class of the links over sockets: opening and closing, name, and errors.

    Attributes:
        name: the canonical name.
        is_stream: see `Link.is_stream`.
        address: the local host and port while the link is open, else None. With port 0, shows the port that
            the operating system chose.
    """

    is_stream: bool

    def __init__(self, spec: LinkSpec) -> None:
        self.name = spec.name
        self._host = spec.host
        self._port = spec.port
        self._socket: socket.socket | None = None
        self._openings = 0
        self._close_reason: tuple[str, OSError | None] = ("closed", None)

    @property
    def address(self) -> tuple[str, int] | None:
        if self._socket is None:
            return None
        host, port, *_ = self._socket.getsockname()
        return host, port

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name} {'closed' if self._socket is None else 'open'}>"

    async def open(self) -> None:
        """See `Link.open`; an open link is closed first."""
        self._discard()
        opening = self._openings
        try:
            with anyio.fail_after(OPEN_TIMEOUT):
                await self._open(opening)
        except BaseException as error:
            if opening == self._openings:
                self._discard()
            if isinstance(error, OSError) and not isinstance(error, LinkError):
                problem = socket_refusal(
                    error, self._host, self._port, self._target, is_stream=self.is_stream
                )
                raise self._error(problem) from error
            raise

    async def close(self) -> None:
        """See `Link.close`."""
        self._discard()

    @abstractmethod
    async def _open(self, opening: int) -> None:
        """Make the sockets; an OSError becomes a LinkError. Pass `opening` to `_adopt` and `_check`."""

    def _adopt(self, sock: socket.socket, opening: int) -> None:
        """Replace the current socket, unless the link was closed while the new socket was opened."""
        if opening != self._openings:
            sock.close()
        self._check(opening)
        if self._socket is not None:
            close_socket(self._socket)
        self._socket = sock

    def _discard(self) -> None:
        """Close the socket and wake waiting tasks. An `open` in progress fails from now on."""
        self._openings += 1
        self._close_reason = ("closed", None)
        if self._socket is not None:
            close_socket(self._socket)
            self._socket = None

    def _fail(self, problem: str, cause: OSError | None = None) -> NoReturn:
        """Close the link because of an error; tasks that wait elsewhere get the same LinkError."""
        self._discard()
        self._close_reason = (problem, cause)
        raise self._error(problem) from cause

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise self._error("not open")
        return self._socket

    async def _readable(self, waitable: socket.socket | int) -> None:
        """Wait until there is data to read; LinkError if the link is closed meanwhile."""
        opening = self._openings
        with suppress(anyio.ClosedResourceError):
            await anyio.wait_readable(waitable)
        self._check(opening)

    def _check(self, opening: int) -> None:
        """Raise LinkError if the link has been closed since it was opened as `opening`."""
        if opening != self._openings:
            problem, cause = self._close_reason
            raise self._error(problem) from cause

    @property
    def _target(self) -> str:
        return f"[{self._host}]:{self._port}" if ":" in self._host else f"{self._host}:{self._port}"

    def _error(self, problem: str) -> LinkError:
        return LinkError(f"{self.name}: {problem}", link=self.name)

    async def _resolve(self, kind: socket.SocketKind) -> list[tuple[socket.AddressFamily, Address]]:
        """Return the addresses of the host, IPv4 first, because most MAVLink programs listen on IPv4."""
        try:
            return _addresses(socket.getaddrinfo(self._host, self._port, type=kind, flags=_NUMERIC))
        except socket.gaierror:
            pass  # not an address: use the resolver, in a thread
        try:
            return _addresses(await anyio.getaddrinfo(self._host, self._port, type=kind))
        except socket.gaierror as error:
            raise self._error(host_refusal(self._host, error)) from error


def claim(sock: socket.socket) -> None:
    """Make a socket's port exclusive, before binding.

    On systems other than Windows, two sockets share a port only if both request it.
    """
    if sys.platform == "win32":
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)


def close_socket(sock: socket.socket) -> None:
    """Close a socket; tasks that wait for it get ClosedResourceError."""
    anyio.notify_closing(sock)
    sock.close()


_NUMERIC = socket.AI_NUMERICHOST | socket.AI_NUMERICSERV


def _addresses(found: Any) -> list[tuple[socket.AddressFamily, Address]]:
    pairs = [(family, address) for family, _, _, _, address in found]
    return sorted(pairs, key=lambda pair: pair[0] != socket.AF_INET)
