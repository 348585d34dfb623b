"""Links over sockets: `udpin` and `tcpin` listen for vehicles, `udpout` sends to one address, `tcp` connects.

Datagrams that arrive while the reader is late wait in the kernel's buffer, and only there. A datagram with
one PARAM_VALUE takes 832 bytes of it (Linux 6.18, loopback), so a burst of 2,000 needs 1.7 MB. Linux' usual
limit for a program's buffer (`net.core.rmem_max` = 212992, doubled by the kernel) holds 512. Datagrams
received of such a burst, sent in 6 ms while the event loop was blocked for 100 ms:

==================================  ============  =============
way of reading                      loop sleeps   loop computes
==================================  ============  =============
4 MiB buffer, read by the loop      2,000         2,000
small buffer, read by the loop      512           512
small buffer, drained by a thread   1,167–1,694   512–1,258
small buffer, thread with recvmmsg  1,891–2,000   512
==================================  ============  =============

A thread waits for the interpreter's lock after each call, so it does not replace a large buffer. The link
therefore requests the buffer, beyond the limit if the program is privileged, and `receive_buffer` is its
actual size. If that is too small, `sysctl -w net.core.rmem_max=4194304` helps.
"""

from __future__ import annotations

import errno
import os
import selectors
import socket
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, TypeAlias
from zlib import crc32

import anyio
import anyio.lowlevel

from paramclient.links.link import READ_SIZE, BaseLink, Peer, StreamLink, read_some, reason, write_all
from paramclient.links.names import LinkSpec
from paramclient.wire.frames import Framer

Address: TypeAlias = tuple[Any, ...]
"""A socket address: (host, port), with two more numbers for IPv6."""

RECEIVE_BUFFER: Final = 4 * 1024 * 1024
"""Bytes requested for the kernel's buffer; Linux doubles them. Holds about 10,000 PARAM_VALUEs."""

DATAGRAMS_PER_READ: Final = 128
"""Datagrams that one `receive` returns at most, so that other tasks run during a burst."""

PEERS_MAX: Final = 256
"""Addresses that a link remembers, one for each system id: broadcasts go to those. The limit bounds the
memory for unknown senders; messages to a single vehicle do not depend on it."""

FIRST_BYTES: Final = 600
"""Bytes of a datagram that are searched for the first frame of a sender: two frames. The limit bounds the
time and the memory for noise."""

PEER_TIMEOUT: Final = 60.0
"""Seconds without data after which an address is forgotten."""

LOCAL_PORTS: Final = range(20480, 28672)
"""Local ports of `udpout`. Linux, macOS and Windows assign ports from 32768 on, so other programs rarely use
one of these."""

SEND_TIMEOUT: Final = 5.0
"""Seconds that a peer may leave the send buffer full before its connection counts as dropped."""

SILENCE_TIMEOUT: Final = 15.0
"""Seconds without a TCP acknowledgement after which a connection counts as dropped (Linux; its own default is
15 minutes). The heartbeat that every station sends each second needs an acknowledgement."""

CONNECTIONS_MAX: Final = 64
"""Connections of `tcpin` at a time; further ones are closed immediately, which bounds the memory for unknown
senders."""

PRIVILEGED_PORTS: Final = 1024
"""Ports below this number need privileges on POSIX systems."""


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
        self._target = spec.name.partition(":")[2]
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

    def _create(self, family: socket.AddressFamily, kind: socket.SocketKind, opening: int) -> socket.socket:
        """Replace the current socket by a new one, unless the link has been closed meanwhile.

        Its port is exclusive. On systems other than Windows, two sockets share a port only if both request
        it.
        """
        self._check(opening)
        close_socket(self._open_socket)
        sock = self._open_socket = socket.socket(family, kind)
        sock.setblocking(False)
        if sys.platform == "win32":
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        return sock

    async def _release(self) -> None:
        close_socket(self._open_socket)
        self._open_socket = None

    async def _readable(self, waitable: socket.socket | int, opening: int) -> None:
        """Wait until there is data to read; LinkError if the link is closed meanwhile."""
        with suppress(anyio.ClosedResourceError):
            await anyio.wait_readable(waitable)
        self._check(opening)

    def _refusal(self, error: OSError) -> str:
        """Return why the link cannot be opened, with the cause and the remedy."""
        host, port, target = self._host, self._port, self._target
        if isinstance(error, socket.gaierror):
            why = reason(error)
            return f"host {host} not found: {why}. Check the spelling and the network, or use the IP address"
        if error.errno == errno.EADDRINUSE or (sys.platform == "win32" and error.errno == errno.EACCES):
            close = f"port {port} is in use by another link or program. Close it, or choose another port"
            both = f"{close} and let the vehicle or a MAVLink router send there too"
            return close if self.is_stream else both
        if isinstance(error, TimeoutError):
            return f"no response from {target}. Check the address, the network and firewalls"
        if isinstance(error, ConnectionRefusedError):
            return (
                f"connection refused by {target}: nothing listens there. Is the vehicle or simulator running?"
            )
        if error.errno == errno.EADDRNOTAVAIL:
            return f"{host} is not an address of this computer; 0.0.0.0 listens on all of them"
        if error.errno in _NO_ROUTE:
            return f"no route to {target}: {reason(error)}. Is this computer in the network of the vehicle?"
        if error.errno in (errno.EACCES, errno.EPERM) and 0 < port < PRIVILEGED_PORTS:
            return f"no permission to use port {port}: ports below {PRIVILEGED_PORTS} need privileges"
        return super()._refusal(error)

    async def _resolve(self, kind: socket.SocketKind) -> list[tuple[socket.AddressFamily, Address]]:
        """Return the addresses of the host, IPv4 first, because most MAVLink programs listen on IPv4."""
        try:
            found: Any = socket.getaddrinfo(self._host, self._port, type=kind, flags=_NUMERIC)
        except socket.gaierror:  # not an address: use the resolver, in a thread
            found = await anyio.getaddrinfo(self._host, self._port, type=kind)
        pairs = [(family, address) for family, _, _, _, address in found]
        return sorted(pairs, key=lambda pair: pair[0] != socket.AF_INET)


def close_socket(sock: socket.socket | None) -> None:
    """Close a socket; tasks that wait for it get ClosedResourceError."""
    if sock is not None:
        anyio.notify_closing(sock)
        sock.close()


_NUMERIC = socket.AI_NUMERICHOST | socket.AI_NUMERICSERV


# UDP


class UdpIn(SocketLink):
    """`udpin`: bound to a port; sends to all addresses from which MAVLink frames were received.

    Several vehicles may send from different addresses, or one after a restart from a new one. Broadcasts go
    to the `PEERS_MAX` latest senders of the last `PEER_TIMEOUT` seconds that have sent a valid frame.
    Messages to one peer go to its address, independent of the number of senders.

    The socket is not connected, so it follows changes of routes and of this computer's addresses. Datagrams
    that the operating system rejects (no route, full buffer, firewall) are lost; the protocol's retries
    replace them, like those lost on the way.

    Attributes:
        receive_buffer: bytes that the kernel granted for unread datagrams, its own overhead included.
    """

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self.receive_buffer = 0
        self._local_port = 0  # of the previous opening
        self._data = memoryview(bytearray(_LARGEST_DATAGRAM))
        self._framer = Framer(stream=False)
        self._peers: dict[Address, tuple[float, bytes]] = {}
        """The senders, the latest one last: the time of their last data, and its beginning until a broadcast
        looks for a frame there."""

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`. Returns at most `DATAGRAMS_PER_READ` datagrams; skips empty ones."""
        sock, opening, data = self._socket, self._openings, self._data
        receive_into = sock.recvfrom_into
        batch: list[tuple[Peer, bytes]] = []
        while not batch:
            await self._readable(sock, opening)
            for _ in range(DATAGRAMS_PER_READ):
                try:
                    size, address = receive_into(data)
                except BlockingIOError:
                    break
                except OSError as error:
                    if error.errno not in _DELAYED:
                        raise self._error(f"cannot receive: {reason(error)}") from error
                    continue
                if size and self._accepts(address):
                    batch.append((address, bytes(data[:size])))
                    self._learn(address, batch[-1][1])
        return batch

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`. Does not wait for the network: drops datagrams that cannot be sent."""
        await anyio.lowlevel.checkpoint()
        sock = self._socket
        for address in self._destinations(peer):
            with suppress(OSError):
                sock.sendto(data, address)

    async def _open(self, opening: int) -> None:
        family, (host, port, *more) = (await self._resolve(socket.SOCK_DGRAM))[0]
        sock = self._new_socket(family, opening)
        sock.bind((host, port or self._local_port, *more))
        self._local_port = sock.getsockname()[1]

    def _new_socket(self, family: socket.AddressFamily, opening: int) -> socket.socket:
        sock = self._create(family, socket.SOCK_DGRAM, opening)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        for option in (socket.SO_RCVBUF, _SO_RCVBUFFORCE) if sys.platform == "linux" else (socket.SO_RCVBUF,):
            with suppress(OSError):  # beyond the limit, or not privileged
                sock.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER)
        self.receive_buffer = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        self._peers = {}
        return sock

    def _accepts(self, sender: Address) -> bool:
        return True

    def _learn(self, sender: Address, data: bytes) -> None:
        """Remember the sender; forget one of which no frame is known, else the one silent for longest. A
        datagram of noise takes no time here."""
        _, unproven = self._peers.pop(sender, (0.0, data))
        self._peers[sender] = anyio.current_time(), unproven and data[:FIRST_BYTES]
        if len(self._peers) > PEERS_MAX:
            del self._peers[min(self._peers, key=lambda each: not self._peers[each][1])]

    def _destinations(self, peer: Peer | None) -> Sequence[Address]:
        """Return the addresses to send to: of a peer, or for None of all."""
        if peer is not None:
            return [peer] if isinstance(peer, tuple) else []
        oldest = anyio.current_time() - PEER_TIMEOUT
        for address, (at, unproven) in list(self._peers.items()):
            self._peers[address] = at, b""
            if at <= oldest or (unproven and not self._framer.receive(unproven)):
                del self._peers[address]
        return list(self._peers)


class UdpOut(UdpIn):
    """`udpout`: sends to one address, from one local port while it is open.

    Receives only datagrams from exactly that address and port, from which a vehicle responds. The vehicle may
    start later. A host name is resolved on opening.

    PX4 responds only to the first address and port from which it received data, until it restarts
    (`MavlinkReceiver::run`). The local port is therefore derived from the remote address, and is equal in
    each session. While another program on this computer uses it, the operating system chooses another one.

    A broadcast address never responds. With one, every sender to the local port is received and is a peer;
    broadcasts still go to the broadcast address.
    """

    _remote: Address

    async def _open(self, opening: int) -> None:
        family, self._remote = (await self._resolve(socket.SOCK_DGRAM))[0]
        self._is_group = False
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(self._remote)
                self._remote = probe.getpeername()  # of 0.0.0.0, this computer
            except PermissionError:  # the operating system's error for a broadcast address
                self._is_group = True
        sock = self._new_socket(family, opening)
        try:
            sock.bind(("", self._local_port or _usual_port(self._remote)))
        except OSError:  # another program uses the port
            sock.bind(("", 0))
        self._local_port = sock.getsockname()[1]

    def _accepts(self, sender: Address) -> bool:
        return self._is_group or sender == self._remote

    def _destinations(self, peer: Peer | None) -> Sequence[Address]:
        if peer is None or peer == self._remote:
            return [self._remote]
        return [each for each in (peer,) if each in self._peers]


def _usual_port(address: Address) -> int:
    """Return the local port for a remote address, one of `LOCAL_PORTS`."""
    return LOCAL_PORTS.start + crc32(f"{address[0]} {address[1]}".encode()) % len(LOCAL_PORTS)


_NO_ROUTE = (errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN)
_DELAYED = (errno.ECONNREFUSED, errno.ECONNRESET, errno.ENETRESET, errno.EHOSTDOWN, *_NO_ROUTE)
"""Errors of earlier datagrams, which the operating system reports on receiving."""
_LARGEST_DATAGRAM = 65535
_SO_RCVBUFFORCE = 33  # Linux, asm-generic/socket.h; the socket module has no name for it


# TCP


class TcpOut(SocketLink, StreamLink):
    """`tcp`: one outgoing connection. `open` makes a new one after it has dropped."""

    async def _read(self) -> bytes:
        return await read_some(self._socket, self._socket.recv)

    async def _write(self, data: bytes) -> None:
        await _send_all(self._socket, data)

    def _loss(self, error: OSError | None) -> str:
        if error is None:
            return f"connection closed by {self._target}"
        return f"connection to {self._target} lost: {reason(error)}"

    async def _open(self, opening: int) -> None:
        status = 0
        for family, address in await self._resolve(socket.SOCK_STREAM):
            sock = self._create(family, socket.SOCK_STREAM, opening)
            _set_up(sock)
            status = sock.connect_ex(address)
            if status in (errno.EINPROGRESS, errno.EWOULDBLOCK):
                await anyio.wait_writable(sock)
                status = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            if not status:
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
        self.accepted: Callable[[Peer], object] = lambda peer: None
        self._accepted = 0
        self._clients: dict[Peer, socket.socket] = {}
        self._selector: selectors.BaseSelector | None = None

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`: up to `READ_SIZE` bytes from each readable connection."""
        opening = self._opened()
        assert self._selector is not None
        batch: list[tuple[Peer, bytes]] = []
        while not batch:
            await self._any_readable(self._selector, opening)
            for key, _ in self._selector.select(0):
                if key.data is None:
                    self._accept(self._selector)
                else:
                    batch += self._read(key.data)
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
            except (OSError, anyio.ClosedResourceError):
                self._check(opening)
                with suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)  # `receive` then reads the end, reports and closes it

    async def _open(self, opening: int) -> None:
        family, address = (await self._resolve(socket.SOCK_STREAM))[0]
        listener = self._create(family, socket.SOCK_STREAM, opening)
        if sys.platform != "win32":  # on Windows the option would let others share the port
            # The option allows binding again while old connections are in TIME_WAIT.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)

    async def _release(self) -> None:
        await super()._release()
        while self._clients:
            close_socket(self._clients.popitem()[1])
        if self._selector is not None:
            if (fileno := getattr(self._selector, "fileno", None)) is not None:
                anyio.notify_closing(fileno())
            self._selector.close()
            self._selector = None

    async def _any_readable(self, selector: selectors.BaseSelector, opening: int) -> None:
        """Wait until a connection has data, or another one waits to be accepted."""
        if (fileno := getattr(selector, "fileno", None)) is not None:
            await self._readable(fileno(), opening)
            return
        async with anyio.create_task_group() as tasks:  # on Windows, a selector cannot be waited for

            async def wait(sock: Any) -> None:
                with suppress(anyio.ClosedResourceError):
                    await anyio.wait_readable(sock)
                tasks.cancel_scope.cancel()

            for key in selector.get_map().values():
                tasks.start_soon(wait, key.fileobj)
        self._check(opening)

    def _accept(self, selector: selectors.BaseSelector) -> None:
        """Accept a waiting connection, if there is one."""
        try:
            client, address = self._socket.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError as error:
            raise self._error(f"cannot accept: {reason(error)}") from error
        if len(self._clients) >= CONNECTIONS_MAX:
            client.close()
            return
        _set_up(client)
        self._accepted += 1
        peer = (self._accepted, *address)
        self._clients[peer] = client
        selector.register(client, selectors.EVENT_READ, peer)
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
            client = self._clients.pop(peer)
            if self._selector is not None:
                self._selector.unregister(client)
            close_socket(client)
        return [(peer, data)]


def _set_up(sock: socket.socket) -> None:
    sock.setblocking(False)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if sys.platform == "linux":
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(SILENCE_TIMEOUT * 1000))


async def _send_all(sock: socket.socket, data: bytes) -> None:
    """Send all bytes; OSError if the connection dropped, or stalled for `SEND_TIMEOUT`."""
    with anyio.move_on_after(SEND_TIMEOUT):
        await write_all(sock, sock.send, data)
        return
    raise OSError(errno.ETIMEDOUT, f"the peer has not read any data for {SEND_TIMEOUT:g} s")
