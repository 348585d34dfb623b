"""Links over UDP: `udpin` waits for vehicles, `udpout` speaks to one address.

A reader that comes late finds in the kernel's buffer what arrived meanwhile, and only there. A datagram
with one PARAM_VALUE takes 832 bytes of it (Linux 6.18, loopback), so a burst of 2,000 needs 1.7 MB, and
Linux' usual limit for what a program may ask for (`net.core.rmem_max` = 212992, doubled by the kernel)
holds 512. What was received of such a burst, sent in 6 ms while the event loop was held up for 100 ms:

==================================  ============  =============
way of reading                      loop sleeps   loop computes
==================================  ============  =============
4 MiB buffer, read by the loop      2,000         2,000
small buffer, read by the loop      512           512
small buffer, drained by a thread   1,167–1,694   512–1,258
small buffer, thread with recvmmsg  1,891–2,000   512
==================================  ============  =============

A thread must wait for the interpreter's lock after each call, so it does not make up for a small buffer.
The buffer is therefore asked for, beyond the limit where the program is privileged enough, and what was
granted can be read. Where that is too little, `sysctl -w net.core.rmem_max=4194304` helps.
"""

from __future__ import annotations

import errno
import socket
import sys
from contextlib import suppress
from typing import Final

import anyio.lowlevel

from paramclient.links.base import Address, Peer, SocketLink, reason
from paramclient.links.names import LinkSpec

__all__ = ["UdpIn", "UdpOut"]

RECEIVE_BUFFER: Final = 4 * 1024 * 1024
"""Bytes asked for; Linux doubles it. Holds about 10,000 PARAM_VALUEs."""

DATAGRAMS_PER_READ: Final = 256
"""Datagrams that one `receive` gives at most, so that other tasks get their turn during a burst."""

PEERS: Final = 256
"""Addresses that a listening link remembers: one for each system id. Strangers cannot make it grow."""


class UdpLink(SocketLink):
    """What both kinds share: one UDP socket, and the peers on it.

    Attributes:
        receive_buffer: bytes that the kernel granted for unread datagrams, its own book-keeping included.
        lost_sends: datagrams that the system did not take: no route, full buffer, firewall. Like those lost
            on the way they are made up for by the protocol's own repeats.
    """

    is_stream = False
    reconnects = False

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self.receive_buffer = 0
        self.lost_sends = 0
        self._peers: dict[Peer, Address] = {}

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`. At most `DATAGRAMS_PER_READ` at a time; empty datagrams are passed over."""
        sock = self._open_socket()
        batch: list[tuple[Address, bytes]] = []
        while not batch:
            await self._readable(sock)
            for _ in range(DATAGRAMS_PER_READ):
                try:
                    data, address = sock.recvfrom(_LARGEST_DATAGRAM)
                except BlockingIOError:
                    break
                except OSError as error:
                    if error.errno not in _PASSING:
                        raise self._error(f"cannot receive: {reason(error)}") from error
                    continue  # an ICMP message about something that was sent earlier
                if data:
                    batch.append((address, data))
        self._learn(batch)
        return [*batch]

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`. Does not wait for the network: what cannot go out now is lost, and counted."""
        await anyio.lowlevel.checkpoint()
        sock = self._open_socket()
        for address in self._destinations(peer):
            try:
                self._transmit(sock, data, address)
            except OSError as error:
                if error.errno not in _PASSING:
                    raise self._error(f"cannot send: {reason(error)}") from error
                self.lost_sends += 1

    def _learn(self, batch: list[tuple[Address, bytes]]) -> None:
        """Remember who spoke MAVLink, the latest last; forget who has been silent for longest."""
        peers = self._peers
        for address, data in batch:
            if peers.pop(address, None) or any(magic in data for magic in _MAGICS):
                peers[address] = address
        while len(peers) > PEERS:
            del peers[next(iter(peers))]

    def _destinations(self, peer: Peer | None) -> list[Address]:
        if peer is None:
            return list(self._peers.values())
        return [self._peers[peer]] if peer in self._peers else []

    def _transmit(self, sock: socket.socket, data: bytes, address: Address) -> None:
        sock.sendto(data, address)

    def _new_socket(self, family: socket.AddressFamily, opening: int) -> socket.socket:
        sock = socket.socket(family, socket.SOCK_DGRAM)
        self._adopt(sock, opening)
        sock.setblocking(False)
        for option in (socket.SO_RCVBUF, _SO_RCVBUFFORCE) if sys.platform == "linux" else (socket.SO_RCVBUF,):
            with suppress(OSError):  # beyond the limit, or not privileged
                sock.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER)
        self.receive_buffer = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        self._peers = {}
        return sock


class UdpIn(UdpLink):
    """`udpin`: bound to a port; speaks to everyone who has spoken MAVLink to it.

    Several vehicles may come from different addresses, or one after a restart from a new one. The `PEERS`
    that were heard last are remembered.
    """

    async def _open(self, opening: int) -> None:
        family, address = (await self._resolve(socket.SOCK_DGRAM))[0]
        self._new_socket(family, opening).bind(address)


class UdpOut(UdpLink):
    """`udpout`: speaks to one address, from one local port for as long as it is open.

    Only what comes from that very address and port is heard: it is where a vehicle answers from, and PX4
    answers only the first partner that spoke to it. Nobody need be there yet: refusals are passed over.

    From a broadcast address nobody answers. There everyone who speaks to the local port is heard and is a
    peer; what is for all peers still goes to the broadcast address.
    """

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self._group: Address | None = None

    async def _open(self, opening: int) -> None:
        family, address = (await self._resolve(socket.SOCK_DGRAM))[0]
        sock = self._new_socket(family, opening)
        sock.bind(("", 0))
        self._group = None
        try:
            sock.connect(address)
        except PermissionError:  # how the system says that this is a broadcast address
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._group = address
        else:
            far = sock.getpeername()
            self._peers = {far: far}

    def _destinations(self, peer: Peer | None) -> list[Address]:
        return [self._group] if peer is None and self._group is not None else super()._destinations(peer)

    def _transmit(self, sock: socket.socket, data: bytes, address: Address) -> None:
        if self._group is not None:
            sock.sendto(data, address)
            return
        try:
            sock.send(data)
        except ConnectionRefusedError:
            sock.send(data)  # that was the answer to an earlier datagram; this one had not been sent


_PASSING = frozenset(
    {
        errno.EAGAIN,
        errno.ECONNREFUSED,
        errno.EHOSTDOWN,
        errno.EHOSTUNREACH,
        errno.ENETDOWN,
        errno.ENETUNREACH,
        errno.ENOBUFS,
        errno.ENOMEM,
        errno.EPERM,
    }
)
"""What may be gone at the next datagram: no route, no listener, no room, a firewall's refusal."""

_MAGICS = (b"\xfd", b"\xfe")
_LARGEST_DATAGRAM = 65535
_SO_RCVBUFFORCE = 33  # Linux, asm-generic/socket.h; the socket module has no name for it
