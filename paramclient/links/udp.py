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
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Final
from zlib import crc32

import anyio
import anyio.lowlevel

from paramclient.links.link import Address, Peer, SocketLink, claim
from paramclient.links.names import LinkSpec
from paramclient.links.refusals import reason
from paramclient.wire.frames import Framer

RECEIVE_BUFFER: Final = 4 * 1024 * 1024
"""Bytes requested for the kernel's buffer; Linux doubles them. Holds about 10,000 PARAM_VALUEs."""

DATAGRAMS_PER_READ: Final = 128
"""Datagrams that one `receive` returns at most, so that other tasks run during a burst."""

PEERS_MAX: Final = 256
"""Addresses that a link remembers, one for each system id: broadcasts go to those. The limit bounds the
memory for unknown senders; messages to a single vehicle do not depend on it."""

PEER_TIMEOUT: Final = 60.0
"""Seconds without data after which an address is forgotten."""

LOCAL_PORTS: Final = range(20480, 28672)
"""Local ports of `udpout`. Linux, macOS and Windows assign ports from 32768 on, so other programs rarely use
one of these."""


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
        self._peers: dict[Address, float] = {}
        """The senders of valid frames and the time of their last data, the latest sender last."""

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
                    if error.errno not in _TRANSIENT:
                        raise self._error(f"cannot receive: {reason(error)}") from error
                    continue  # an ICMP error for an earlier datagram
                if size and self._accepts(address):
                    batch.append((address, bytes(data[:size])))
                    self._learn(address, batch[-1][1])
        return batch

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`. Does not wait for the network: drops datagrams that cannot be sent."""
        await anyio.lowlevel.checkpoint()
        sock = self._socket
        for address in self._destinations(peer):
            try:
                sock.sendto(data, address)
            except OSError as error:
                if error.errno not in _TRANSIENT:
                    raise self._error(f"cannot send: {reason(error)}") from error

    async def _open(self, opening: int) -> None:
        family, (host, port, *more) = (await self._resolve(socket.SOCK_DGRAM))[0]
        sock = self._new_socket(family, opening)
        sock.bind((host, port or self._local_port, *more))
        self._local_port = sock.getsockname()[1]

    def _new_socket(self, family: socket.AddressFamily, opening: int) -> socket.socket:
        sock = socket.socket(family, socket.SOCK_DGRAM)
        self._adopt(sock, opening)
        sock.setblocking(False)
        claim(sock)
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
        """Remember the sender if it is known or the data is a frame; forget the one silent for longest."""
        if self._peers.pop(sender, None) is not None or self._framer.receive(data):
            self._peers[sender] = anyio.current_time()
            if len(self._peers) > PEERS_MAX:
                del self._peers[next(iter(self._peers))]

    def _destinations(self, peer: Peer | None) -> Sequence[Address]:
        """Return the addresses to send to: of a peer, or for None of all."""
        if peer is not None:
            return [peer] if isinstance(peer, tuple) else []
        oldest = anyio.current_time() - PEER_TIMEOUT
        return [address for address, at in self._peers.items() if at > oldest]


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

    _is_group = False
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


_TRANSIENT = frozenset(
    {
        *(errno.EADDRNOTAVAIL, errno.EINVAL, errno.ENETDOWN, errno.ENETUNREACH, errno.EHOSTDOWN),
        *(errno.EHOSTUNREACH, errno.EAGAIN, errno.ECONNREFUSED, errno.ECONNRESET, errno.ENETRESET),
        *(errno.ENOBUFS, errno.ENOMEM, errno.EPERM),
    }
)
"""Errors that may not occur for the next datagram: no route (EINVAL is that of Linux before 5.3), no listener
(two errors on Windows), no buffer space, rejected by a firewall."""

_LARGEST_DATAGRAM = 65535
_SO_RCVBUFFORCE = 33  # Linux, asm-generic/socket.h; the socket module has no name for it
