"""Links over TCP: `tcp` connects, `tcpin` accepts connections."""

from __future__ import annotations

import errno
import os
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Final, NamedTuple

import anyio
import anyio.lowlevel

from paramclient.links.link import Peer, SocketLink, claim, close_socket
from paramclient.links.names import LinkSpec
from paramclient.links.refusals import reason

SEND_TIMEOUT: Final = 5.0
"""Seconds that a peer may leave the send buffer full before its connection counts as dropped."""

SILENCE_TIMEOUT: Final = 15.0
"""Seconds without a TCP acknowledgement after which a connection counts as dropped (Linux; its own default is
15 minutes). The heartbeat that every station sends each second needs an acknowledgement."""

CONNECTIONS_MAX: Final = 64
"""Connections of `tcpin` at a time; further ones are closed immediately, which bounds the memory for unknown
senders."""

READ_SIZE: Final = 65536
"""Bytes that are read from one connection before the next one is read."""


class TcpConnection(NamedTuple):
    """A TCP connection as a peer. The number distinguishes several connections of the same address."""

    number: int
    host: str
    port: int


class TcpOut(SocketLink):
    """`tcp`: one outgoing connection. `open` makes a new one after it has dropped."""

    is_stream = True

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self._peer = TcpConnection(0, spec.host, spec.port)

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`: one chunk of up to `READ_SIZE` bytes."""
        sock, opening = self._socket, self._openings
        while True:
            await self._readable(sock, opening)
            try:
                data = sock.recv(READ_SIZE)
            except BlockingIOError:
                continue
            except OSError as error:
                await self._fail(opening, f"connection to {self._target} lost: {reason(error)}", error)
            if not data:
                await self._fail(opening, f"connection closed by {self._target}")
            return [(self._peer, data)]

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`. Waits at most `SEND_TIMEOUT` for space; then the connection counts as dropped.

        After cancellation, a part may have been sent.
        """
        await anyio.lowlevel.checkpoint()
        sock, opening = self._socket, self._openings
        if peer in (None, self._peer):
            try:
                await _send_all(sock, data)
            except OSError as error:
                await self._fail(opening, f"connection to {self._target} lost: {reason(error)}", error)

    async def _open(self, opening: int) -> None:
        status = 0
        for family, address in await self._resolve(socket.SOCK_STREAM):
            sock = socket.socket(family, socket.SOCK_STREAM)
            self._adopt(sock, opening)
            _set_up(sock)
            status = sock.connect_ex(address)
            if status in (errno.EINPROGRESS, errno.EWOULDBLOCK):
                await _writable(sock)
                status = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            if not status:
                self._peer = self._peer._replace(number=self._peer.number + 1)
                return
        raise OSError(status, os.strerror(status))


class TcpIn(SocketLink):
    """`tcpin`: listens, and sends to every connection. The end of one connection does not affect others.

    Attributes:
        accepted: called with each new connection, before it has sent anything.
    """

    is_stream = True
    reconnects = False

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self._clients: dict[Peer, socket.socket] = {}
        self.accepted: Callable[[Peer], object] = lambda peer: None
        self._accepted = 0

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`: up to `READ_SIZE` bytes from each readable connection."""
        listener, opening = self._socket, self._openings
        batch: list[tuple[Peer, bytes]] = []
        while not batch:
            async with anyio.create_task_group() as tasks:

                async def wait(sock: socket.socket) -> None:
                    with suppress(anyio.ClosedResourceError):
                        await anyio.wait_readable(sock)
                    tasks.cancel_scope.cancel()

                for sock in (listener, *self._clients.values()):
                    tasks.start_soon(wait, sock)
            self._check(opening)
            self._accept(listener)
            for peer in tuple(self._clients):
                batch += self._read(peer)
        return batch

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`. A connection without space for `SEND_TIMEOUT` is closed.

        After cancellation, a part may have been sent.
        """
        await anyio.lowlevel.checkpoint()
        opening = self._opened()
        known = self._clients.values() if peer is None else filter(None, [self._clients.get(peer)])
        for client in tuple(known):
            try:
                await _send_all(client, data)
            except OSError:
                self._check(opening)
                with suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)  # `receive` then reads the end, reports and closes it

    async def _open(self, opening: int) -> None:
        family, address = (await self._resolve(socket.SOCK_STREAM))[0]
        listener = socket.socket(family, socket.SOCK_STREAM)
        self._adopt(listener, opening)
        listener.setblocking(False)
        claim(listener)
        if sys.platform != "win32":  # on Windows the option would let others share the port
            # The option allows binding again while old connections are in TIME_WAIT.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()

    async def _release(self) -> None:
        await super()._release()
        while self._clients:
            close_socket(self._clients.popitem()[1])

    def _accept(self, listener: socket.socket) -> None:
        """Accept a waiting connection, if there is one."""
        try:
            client, (host, port, *_) = listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError as error:
            raise self._error(f"cannot accept: {reason(error)}") from error
        if len(self._clients) >= CONNECTIONS_MAX:
            client.close()
            return
        _set_up(client)
        self._accepted += 1
        peer = TcpConnection(self._accepted, host, port)
        self._clients[peer] = client
        self.accepted(peer)

    def _read(self, peer: Peer) -> list[tuple[Peer, bytes]]:
        """Read what a connection has received; empty bytes are its end."""
        try:
            data = self._clients[peer].recv(READ_SIZE)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            close_socket(self._clients.pop(peer))
        return [(peer, data)]


def _set_up(sock: socket.socket) -> None:
    sock.setblocking(False)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if sys.platform == "linux":
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(SILENCE_TIMEOUT * 1000))


async def _send_all(sock: socket.socket, data: bytes) -> None:
    """Send all bytes; OSError if the connection dropped, was closed here, or stalled for `SEND_TIMEOUT`."""
    view = memoryview(data)
    with anyio.move_on_after(SEND_TIMEOUT):
        while view:
            try:
                view = view[sock.send(view) :]
            except BlockingIOError:
                await _writable(sock)
        return
    raise OSError(errno.ETIMEDOUT, f"the peer has not read any data for {SEND_TIMEOUT:g} s")


async def _writable(sock: socket.socket) -> None:
    try:
        await anyio.wait_writable(sock)
    except anyio.ClosedResourceError:
        raise OSError(errno.EBADF, os.strerror(errno.EBADF)) from None
