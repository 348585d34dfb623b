"""The interface of links, and their base classes.

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
from paramclient.links.refusals import host_refusal, reason, socket_refusal

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


class BaseLink(ABC):
    """Base class of all links here: name, opening and closing, and errors.

    Attributes:
        name: the canonical name.
        is_stream: see `Link.is_stream`.
        reconnects: see `Link.reconnects`.
    """

    is_stream = False
    reconnects = True

    def __init__(self, name: str) -> None:
        self.name = name
        self._is_open = False
        self._openings = 0
        self._close_reason: tuple[str, OSError | None] = ("closed", None)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name} {'open' if self._is_open else 'closed'}>"

    async def open(self) -> None:
        """See `Link.open`; an open link is closed first."""
        await self._end("closed")
        opening = self._openings
        try:
            with anyio.fail_after(OPEN_TIMEOUT):
                await self._open(opening)
        except BaseException as error:
            if opening == self._openings:
                await self._end("closed")
            elif isinstance(error, OSError):
                self._check(opening)
            if isinstance(error, OSError) and not isinstance(error, LinkError):
                raise self._error(self._refusal(error)) from error
            raise
        self._is_open = True

    async def close(self) -> None:
        """See `Link.close`."""
        await self._end("closed")

    @abstractmethod
    async def _open(self, opening: int) -> None:
        """Open the link; an OSError becomes a LinkError with the text of `_refusal`.

        `_check` of `opening` fails once the link has been closed meanwhile.
        """

    @abstractmethod
    async def _release(self) -> None:
        """Release what `_open` has opened, and wake waiting tasks. Idempotent."""

    def _refusal(self, error: OSError) -> str:
        return f"cannot open: {reason(error)}"

    async def _end(self, problem: str, cause: OSError | None = None) -> None:
        """Close the link. An `open` in progress fails from now on."""
        self._openings += 1
        self._close_reason = (problem, cause)
        self._is_open = False
        await self._release()

    async def _fail(self, opening: int, problem: str, cause: OSError | None = None) -> NoReturn:
        """Close the link because of an error, unless already closed; waiting tasks get the same LinkError."""
        self._check(opening)
        await self._end(problem, cause)
        raise self._error(problem) from cause

    def _opened(self) -> int:
        """Return the number of this opening; LinkError if the link is not open."""
        if not self._is_open:
            raise self._error("not open")
        return self._openings

    def _check(self, opening: int) -> None:
        """Raise LinkError if the link has been closed since it was opened as `opening`."""
        if opening != self._openings:
            problem, cause = self._close_reason
            raise self._error(problem) from cause

    def _error(self, problem: str) -> LinkError:
        return LinkError(f"{self.name}: {problem}", link=self.name)


class SocketLink(BaseLink):
    """Base class of the links over sockets.

    Attributes:
        address: the local host and port while the link is open, else None. With port 0, shows the port that
            the operating system chose.
    """

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec.name)
        self._host = spec.host
        self._port = spec.port
        self._open_socket: socket.socket | None = None

    @property
    def address(self) -> tuple[str, int] | None:
        if self._open_socket is None:
            return None
        host, port, *_ = self._open_socket.getsockname()
        return host, port

    @property
    def _socket(self) -> socket.socket:
        if self._open_socket is None:
            raise self._error("not open")
        return self._open_socket

    def _adopt(self, sock: socket.socket, opening: int) -> None:
        """Replace the current socket, unless the link was closed while the new socket was opened."""
        if opening != self._openings:
            sock.close()
        self._check(opening)
        close_socket(self._open_socket)
        self._open_socket = sock

    async def _release(self) -> None:
        close_socket(self._open_socket)
        self._open_socket = None

    async def _readable(self, waitable: socket.socket | int, opening: int) -> None:
        """Wait until there is data to read; LinkError if the link is closed meanwhile."""
        with suppress(anyio.ClosedResourceError):
            await anyio.wait_readable(waitable)
        self._check(opening)

    def _refusal(self, error: OSError) -> str:
        return socket_refusal(error, self._host, self._port, self._target, is_stream=self.is_stream)

    @property
    def _target(self) -> str:
        return f"[{self._host}]:{self._port}" if ":" in self._host else f"{self._host}:{self._port}"

    async def _resolve(self, kind: socket.SocketKind) -> list[tuple[socket.AddressFamily, Address]]:
        """Return the addresses of the host, IPv4 first, because most MAVLink programs listen on IPv4."""
        try:
            found: Any = socket.getaddrinfo(self._host, self._port, type=kind, flags=_NUMERIC)
        except socket.gaierror:  # not an address: use the resolver, in a thread
            try:
                found = await anyio.getaddrinfo(self._host, self._port, type=kind)
            except socket.gaierror as error:
                raise self._error(host_refusal(self._host, error)) from error
        pairs = [(family, address) for family, _, _, _, address in found]
        return sorted(pairs, key=lambda pair: pair[0] != socket.AF_INET)


def claim(sock: socket.socket) -> None:
    """Make a socket's port exclusive, before binding.

    On systems other than Windows, two sockets share a port only if both request it.
    """
    if sys.platform == "win32":
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)


def close_socket(sock: socket.socket | None) -> None:
    """Close a socket; tasks that wait for it get ClosedResourceError."""
    if sock is not None:
        anyio.notify_closing(sock)
        sock.close()


_NUMERIC = socket.AI_NUMERICHOST | socket.AI_NUMERICSERV
