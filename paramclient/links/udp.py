"""Links over UDP: `udpin` listens for vehicles, `udpout` sends to one address; the peers of a link.

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
import math
import socket
import sys
from abc import abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from typing import Final
from zlib import crc32

import anyio
import anyio.lowlevel

from paramclient.errors import LinkError
from paramclient.links.link import OPEN_TIMEOUT, Address, Peer, SocketLink, claim
from paramclient.links.names import LinkSpec
from paramclient.links.refusals import reason
from paramclient.wire.frames import Framer

__all__ = ["UdpIn", "UdpOut"]

RECEIVE_BUFFER: Final = 4 * 1024 * 1024
"""Bytes requested for the kernel's buffer; Linux doubles them. Holds about 10,000 PARAM_VALUEs."""

DATAGRAMS_PER_READ: Final = 128
"""Datagrams that one `receive` returns at most, so that other tasks run during a burst."""

PEERS_MAX: Final = 256
"""Addresses that a listening link remembers, one for each system id: broadcasts go to those. The limit bounds
the memory for unknown senders; messages to a single vehicle do not depend on it."""

PEER_TIMEOUT: Final = 60.0
"""Seconds without a valid frame after which an address is forgotten."""

FRAME_CHECK_INTERVAL: Final = 1.0
"""Seconds after which the link checks another frame of a known address. The station checks every frame in any
case."""

UNREACHABLE_TIMEOUT: Final = 3.0
"""Seconds without a route, after which the socket counts as dropped: three heartbeats. The socket keeps the
local address of its opening, and this computer may have got another one since."""

RESOLVE_INTERVAL: Final = 10.0
"""Seconds without data after which a host name is resolved again, in case its address has changed."""

LOCAL_PORTS: Final = range(20480, 28672)
"""Local ports of `udpout`. Linux, macOS and Windows assign ports from 32768 on, so other programs rarely use
one of these."""


class UdpLink(SocketLink):
    """Base class of the UDP links: one socket, and the peers on it.

    While the network is down, datagrams to send are lost, and counted. A socket with the local address of its
    opening and without a route for `UNREACHABLE_TIMEOUT` counts as dropped.

    Attributes:
        receive_buffer: bytes that the kernel granted for unread datagrams, its own overhead included.
        lost_sends: datagrams that the operating system rejected: no route, full buffer, firewall. The
            protocol's retries replace them, like datagrams lost on the way.
    """

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self.receive_buffer = 0
        self.lost_sends = 0
        self._local_port = 0  # of the previous opening
        self._data = memoryview(bytearray(_LARGEST_DATAGRAM))
        self._no_route_since: float | None = None
        # The senders of valid frames and the time of the last one, the latest sender last.
        self._peers: dict[Address, float] = {}
        self._framer = Framer((), stream=False)

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`. Returns at most `DATAGRAMS_PER_READ` datagrams; skips empty ones."""
        sock, opening, data = self._socket, self._openings, self._data
        receive_into = sock.recvfrom_into
        batch: list[tuple[Address, bytes]] = []
        while not batch:
            await self._readable(sock, opening)
            for _ in range(DATAGRAMS_PER_READ):
                try:
                    size, address = receive_into(data)
                except BlockingIOError:
                    break
                except OSError as error:
                    if error.errno not in _TRANSIENT:
                        raise self._error(f"cannot receive: {reason(error)}") from error
                    continue  # an ICMP error for an earlier datagram
                if size:
                    batch.append((address, bytes(data[:size])))
        self._learn(batch)
        return [*batch]

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`. Does not wait for the network: drops and counts datagrams that cannot be sent."""
        await anyio.lowlevel.checkpoint()
        for address in self._destinations(self._socket, peer):
            try:
                self._transmit(self._socket, data, address)
            except OSError as error:
                if error.errno not in _TRANSIENT:
                    raise self._error(f"cannot send: {reason(error)}") from error
                self.lost_sends += 1
                if error.errno in _NO_ROUTE and self._host not in _ANY_ADDRESS:
                    await self._note_no_route(error)
            else:
                self._no_route_since = None

    async def close(self) -> None:
        """See `Link.close`."""
        await super().close()
        self._local_port = 0

    async def _note_no_route(self, error: OSError) -> None:
        """Drop a socket that sends from one fixed address, which this computer may have lost."""
        now = anyio.current_time()
        if self._no_route_since is None:
            self._no_route_since = now
        elif now - self._no_route_since >= UNREACHABLE_TIMEOUT:
            host = self._socket.getsockname()[0]
            await self._fail(self._openings, f"no route from {host} any more: {reason(error)}", error)

    def _learn(self, batch: list[tuple[Address, bytes]]) -> None:
        """Remember the senders of valid frames, the latest last; forget the one silent for longest."""
        peers, now = self._peers, anyio.current_time()
        for address, data in batch:
            proven_at = peers.pop(address, -math.inf)
            if now >= proven_at + FRAME_CHECK_INTERVAL:
                before = self._framer.frames
                self._framer.receive(data)
                proven_at = now if self._framer.frames > before else proven_at
            if proven_at > now - PEER_TIMEOUT:
                peers[address] = proven_at
            if len(peers) > PEERS_MAX:
                del peers[next(iter(peers))]

    @abstractmethod
    def _destinations(self, sock: socket.socket, peer: Peer | None) -> Sequence[Address]:
        """Return the addresses to send to: of a peer, or for None of all."""

    def _transmit(self, sock: socket.socket, data: bytes, address: Address) -> None:
        sock.sendto(data, address)

    def _new_socket(self, family: socket.AddressFamily, opening: int) -> socket.socket:
        sock = socket.socket(family, socket.SOCK_DGRAM)
        self._adopt(sock, opening)
        sock.setblocking(False)
        claim(sock)
        for option in (socket.SO_RCVBUF, _SO_RCVBUFFORCE) if sys.platform == "linux" else (socket.SO_RCVBUF,):
            with suppress(OSError):  # beyond the limit, or not privileged
                sock.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER)
        self.receive_buffer = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        self._peers = {}
        self._no_route_since = None
        return sock


class UdpIn(UdpLink):
    """`udpin`: bound to a port; sends to all addresses from which MAVLink frames were received.

    Several vehicles may send from different addresses, or one after a restart from a new one. Broadcasts go
    to the `PEERS_MAX` latest senders of valid frames in the last `PEER_TIMEOUT` seconds. Messages to one peer
    go to its address, independent of the number of senders.
    """

    async def _open(self, opening: int) -> None:
        family, (host, port, *more) = (await self._resolve(socket.SOCK_DGRAM))[0]
        sock = self._new_socket(family, opening)
        sock.bind((host, port or self._local_port, *more))
        self._local_port = sock.getsockname()[1]

    def _destinations(self, sock: socket.socket, peer: Peer | None) -> Sequence[Address]:
        if peer is not None:
            return [peer] if isinstance(peer, tuple) else []
        oldest = anyio.current_time() - PEER_TIMEOUT
        self._peers = {address: at for address, at in self._peers.items() if at > oldest}
        return [*self._peers]


class UdpOut(UdpLink):
    """`udpout`: sends to one address, from one local port while it is open.

    Receives only datagrams from exactly that address and port, from which a vehicle responds. The vehicle may
    start later: ICMP port-unreachable errors are ignored.

    PX4 responds only to the first address and port from which it received data, until it restarts
    (`MavlinkReceiver::run`). The local port is therefore derived from the remote address, and is equal in
    each session. While another program on this computer uses it, the operating system chooses another one.

    A broadcast address never responds. With one, every sender to the local port is received and is a peer;
    broadcasts still go to the broadcast address.

    A host name is resolved on opening, and again every `RESOLVE_INTERVAL` seconds without data: if its
    address has changed, the link counts as dropped.
    """

    _is_group = False
    _remote: Address
    """The address as `_resolve` returned it."""

    async def _open(self, opening: int) -> None:
        family, self._remote = (await self._resolve(socket.SOCK_DGRAM))[0]
        sock = self._new_socket(family, opening)
        try:
            sock.bind(("", self._local_port or _usual_port(self._remote)))
        except OSError:  # another program uses the port
            sock.bind(("", 0))
        self._local_port = sock.getsockname()[1]
        self._is_group = False
        try:
            sock.connect(self._remote)
        except PermissionError:  # the operating system's error for a broadcast address
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._is_group = True

    async def _readable(self, waitable: socket.socket | int, opening: int) -> None:
        while True:
            with anyio.move_on_after(RESOLVE_INTERVAL):
                await super()._readable(waitable, opening)
                return
            found = [self._remote]
            with suppress(LinkError, TimeoutError), anyio.fail_after(OPEN_TIMEOUT):
                found = [address for _, address in await self._resolve(socket.SOCK_DGRAM)]
            self._check(opening)
            if self._remote not in found:
                await self._fail(opening, f"the address of {self._host} changed to {found[0][0]}")

    def _learn(self, batch: list[tuple[Address, bytes]]) -> None:
        if self._is_group:
            super()._learn(batch)

    def _destinations(self, sock: socket.socket, peer: Peer | None) -> Sequence[Address]:
        if self._is_group:
            return [self._remote] if peer is None else [each for each in (peer,) if each in self._peers]
        return [self._remote] if peer in (None, sock.getpeername()) else []

    def _transmit(self, sock: socket.socket, data: bytes, address: Address) -> None:
        if self._is_group:
            sock.sendto(data, address)
            return
        try:
            sock.send(data)
        except ConnectionRefusedError:
            sock.send(data)  # the error was for an earlier datagram; this one had not been sent


def _usual_port(address: Address) -> int:
    """Return the local port for a remote address, one of `LOCAL_PORTS`."""
    return LOCAL_PORTS.start + crc32(f"{address[0]} {address[1]}".encode()) % len(LOCAL_PORTS)


_NO_ROUTE = frozenset({errno.EADDRNOTAVAIL, errno.EINVAL, errno.ENETDOWN, errno.ENETUNREACH})
"""Errors of a socket whose local address is gone; EINVAL is that of Linux before 5.3."""

_TRANSIENT = _NO_ROUTE | frozenset(
    {
        errno.EAGAIN,
        errno.ECONNREFUSED,
        errno.ECONNRESET,
        errno.EHOSTDOWN,
        errno.EHOSTUNREACH,
        errno.ENETRESET,
        errno.ENOBUFS,
        errno.ENOMEM,
        errno.EPERM,
    }
)
"""Errors that may not occur for the next datagram: no route, no listener (two errors on Windows), no buffer
space, rejected by a firewall."""

_ANY_ADDRESS = ("0.0.0.0", "::")

_LARGEST_DATAGRAM = 65535
_SO_RCVBUFFORCE = 33  # Linux, asm-generic/socket.h; the socket module has no name for it
