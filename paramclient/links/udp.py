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

Linux notes when each datagram arrives, and tells it of the one that was read last (SIOCGSTAMP, socket(7)).
One such call for each read costs 0.6 µs; with control messages (SO_TIMESTAMPNS) each datagram would cost
twice that. So the datagrams of a read are told apart only where the first of them has waited.
"""

from __future__ import annotations

import errno
import math
import socket
import struct
import sys
import time
from contextlib import suppress
from typing import Final
from zlib import crc32

import anyio
import anyio.lowlevel

from paramclient.errors import LinkError
from paramclient.links.clock_offset import seconds_ahead
from paramclient.links.link import OPEN_TIMEOUT, Address, Peer, SocketLink, claim, reason
from paramclient.links.names import LinkSpec
from paramclient.protocol.wire import HEARTBEAT_ID, Framer

__all__ = ["UdpIn", "UdpOut"]

RECEIVE_BUFFER: Final = 4 * 1024 * 1024
"""Bytes asked for; Linux doubles it. Holds about 10,000 PARAM_VALUEs."""

DATAGRAMS_PER_READ: Final = 128
"""Datagrams that one `receive` gives at most, so that other tasks get their turn during a burst."""

PEERS: Final = 256
"""Addresses that a listening link remembers, one for each system id: what is for all goes to those. Strangers
cannot make it grow, nor come between a vehicle and what is for it alone."""

PEER_SILENCE: Final = 60.0
"""Seconds without a valid frame after which an address is forgotten."""

PROOF_PACE: Final = 1.0
"""Seconds after which a frame of an address that has sent heartbeats is checked again here, beside the check
that the station makes of every frame."""

STRANGERS_PACE: Final = 1.0
"""Seconds between two heartbeats to addresses that have sent none, all of them together: whoever forges the
address of another computer has it sent no more than that."""

UNREACHABLE_PATIENCE: Final = 3.0
"""Seconds in which nothing found a way out, after which the socket is made anew: three heartbeats. It has its
own address from when it was opened, and this computer may have got another one since."""

LOOK_AGAIN: Final = 10.0
"""Seconds of silence after which it is looked whether a name has another address by now."""

LOCAL_PORTS: Final = range(20480, 28672)
"""Ports that `udpout` speaks from. Linux, macOS and Windows give out ports from 32768 on by themselves, so
other programs rarely have one of these."""

AT_ONCE: Final = 0.001
"""Seconds within which the first datagram of a read was read at once: the others came later than that one."""


class _Known:
    """What is known of an address.

    Attributes:
        proven_at: when a valid frame came from it last.
        served_at: when one that has sent no heartbeat was sent ours last.
    """

    __slots__ = ("proven_at", "served_at")

    def __init__(self) -> None:
        self.proven_at = self.served_at = -math.inf


class UdpLink(SocketLink):
    """What both kinds share: one UDP socket, and the peers on it.

    While the network is away, what is sent is lost, and counted. A socket that has its own address from when
    it was opened, and finds no way out with it for `UNREACHABLE_PATIENCE`, counts as dropped.

    Attributes:
        receive_buffer: bytes that the kernel granted for unread datagrams, its own book-keeping included.
        lost_sends: datagrams that the system did not take: no route, full buffer, firewall. Like those lost
            on the way they are made up for by the protocol's own repeats.
        arrived_at: when each datagram of the last `receive` came into the kernel's buffer, in their order, by
            the event loop's clock; empty where the system does not tell.
    """

    is_stream = False
    reconnects = True

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self.receive_buffer = 0
        self.lost_sends = 0
        self.arrived_at: list[float] = []
        self._tells_arrivals = False
        self._local_port = 0  # of the opening before
        self._room = memoryview(bytearray(_LARGEST_DATAGRAM))
        self._stuck_since: float | None = None
        self._peers: dict[Address, _Known] = {}  # that have sent heartbeats; who spoke last is last
        self._strangers: dict[Address, _Known] = {}  # that have sent other frames
        self._stranger_served_at = -math.inf
        self._framer = Framer((HEARTBEAT_ID,), stream=False)

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`. At most `DATAGRAMS_PER_READ` at a time; empty datagrams are passed over."""
        sock = self._open_socket()
        into, room = sock.recvfrom_into, self._room
        batch: list[tuple[Address, bytes]] = []
        arrivals: list[float] = []
        while not batch:
            await self._readable(sock)
            asks = self._tells_arrivals
            for _ in range(DATAGRAMS_PER_READ):
                try:
                    size, address = into(room)
                except BlockingIOError:
                    break
                except OSError as error:
                    if error.errno not in _PASSING:
                        raise self._error(f"cannot receive: {reason(error)}") from error
                    continue  # an ICMP message about something that was sent earlier
                if size:
                    batch.append((address, bytes(room[:size])))
                    if asks:
                        arrivals.append(_arrived_at(sock))
                        asks = time.time() - arrivals[-1] > AT_ONCE
        if arrivals:
            ahead = seconds_ahead(time.time, anyio.current_time)
            arrivals = [at - ahead for at in arrivals]
        self.arrived_at = arrivals + arrivals[-1:] * (len(batch) - len(arrivals))
        self._learn(batch)
        return [*batch]

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`. Does not wait for the network: what cannot go out now is lost, and counted."""
        await anyio.lowlevel.checkpoint()
        sock = self._open_socket()
        for address in self._for_all(data) if peer is None else self._destinations(peer):
            try:
                self._transmit(sock, data, address)
            except OSError as error:
                if error.errno not in _PASSING:
                    raise self._error(f"cannot send: {reason(error)}") from error
                self.lost_sends += 1
                if error.errno in _NO_WAY_OUT and self._has_own_address:
                    self._be_stuck(error)
            else:
                self._stuck_since = None

    async def close(self) -> None:
        """See `Link.close`."""
        await super().close()
        self._local_port = 0

    @property
    def _has_own_address(self) -> bool:
        """Whether the socket sends from one address, which this computer may lose."""
        return True

    def _be_stuck(self, error: OSError) -> None:
        now = anyio.current_time()
        if self._stuck_since is None:
            self._stuck_since = now
        elif now - self._stuck_since >= UNREACHABLE_PATIENCE:
            self._fail(f"no way out from {self._own_host} any more: {reason(error)}", error)

    @property
    def _own_host(self) -> str:
        return self.address[0] if self.address else self._host

    def _learn(self, batch: list[tuple[Address, bytes]]) -> None:
        """Remember who sends valid frames, the latest last; forget who has been silent for longest."""
        peers, now = self._peers, anyio.current_time()
        for address, data in batch:
            known = peers.pop(address, None)
            if known is not None:
                peers[address] = known
                if now < known.proven_at + PROOF_PACE:
                    continue
            self._prove(address, data, now)

    def _prove(self, address: Address, data: bytes, now: float) -> None:
        """See whether a datagram has a valid frame, and whether that is a heartbeat."""
        before = self._framer.frames
        beats = self._framer.receive(data)
        if self._framer.frames == before:
            return
        known = self._strangers.pop(address, None) or self._peers.get(address) or _Known()
        known.proven_at = now
        if beats or address in self._peers:
            self._peers[address] = known
        else:
            self._strangers[address] = known
        if len(self._peers) + len(self._strangers) > PEERS:
            fewest = self._strangers or self._peers
            del fewest[next(iter(fewest))]

    def _forget_silent(self, now: float) -> None:
        for known in (self._peers, self._strangers):
            for address in [each for each, at in known.items() if now - at.proven_at >= PEER_SILENCE]:
                del known[address]

    def _for_all(self, data: bytes) -> list[Address]:
        """Where what is for all goes: a heartbeat to one of those that have sent none, in turn."""
        now = anyio.current_time()
        self._forget_silent(now)
        strangers = list(self._strangers)
        if strangers and self._framer.receive(data):
            is_due = now >= self._stranger_served_at + STRANGERS_PACE
            strangers = [min(strangers, key=lambda each: self._strangers[each].served_at)] if is_due else []
            for address in strangers:
                self._stranger_served_at = self._strangers[address].served_at = now
        return [*self._peers, *strangers]

    def _destinations(self, peer: Peer) -> list[Address]:
        return [each for each in (peer,) if each in self._peers or each in self._strangers]

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
        self._tells_arrivals = _note_arrivals(sock)
        self._peers, self._strangers = {}, {}
        self._stuck_since = None
        return sock


if sys.platform == "linux":
    from fcntl import ioctl

    def _note_arrivals(sock: socket.socket) -> bool:
        """Have the kernel note when datagrams arrive; whether it does."""
        try:
            _arrived_at(sock)
        except OSError as error:
            return error.errno == errno.ENOENT  # nothing was read yet
        return True

    def _arrived_at(sock: socket.socket) -> float:
        """Return when the datagram that was read last came into the kernel's buffer, in unix seconds."""
        stamp = ioctl(sock, _SIOCGSTAMP, bytes(_TIMEVAL.size))
        seconds, microseconds = _TIMEVAL.unpack(stamp)
        arrived_at: float = seconds + microseconds * 1e-6
        return arrived_at

else:

    def _note_arrivals(sock: socket.socket) -> bool:
        """Return false: the system does not tell when a datagram arrived."""
        return False

    def _arrived_at(sock: socket.socket) -> float:
        """Return 0: nobody asks."""
        return 0.0


class UdpIn(UdpLink):
    """`udpin`: bound to a port; speaks to everyone who has spoken MAVLink to it.

    Several vehicles may come from different addresses, or one after a restart from a new one. The `PEERS`
    that sent valid frames last, in the last `PEER_SILENCE` seconds, get what is for all; those that have sent
    no heartbeat share one of ours a second, in turn. What is for one peer goes there, however many others
    speak.
    """

    async def _open(self, opening: int) -> None:
        family, (host, port, *more) = (await self._resolve(socket.SOCK_DGRAM))[0]
        sock = self._new_socket(family, opening)
        sock.bind((host, port or self._local_port, *more))
        self._local_port = sock.getsockname()[1]

    @property
    def _has_own_address(self) -> bool:
        return self._host not in _EVERY_ADDRESS

    def _destinations(self, peer: Peer) -> list[Address]:
        return [peer] if isinstance(peer, tuple) else []


class UdpOut(UdpLink):
    """`udpout`: speaks to one address, from one local port for as long as it is open.

    Only what comes from that very address and port is heard: it is where a vehicle answers from. Nobody need
    be there yet: refusals are passed over.

    PX4 answers only the address and port that it heard first, until it restarts (`MavlinkReceiver::run`). So
    the local port follows from the remote address, and is the same in each session. While another program on
    this computer has it, the system chooses another one.

    From a broadcast address nobody answers. There everyone who speaks to the local port is heard and is a
    peer; what is for all peers still goes to the broadcast address.

    A name is looked up on opening, and again every `LOOK_AGAIN` seconds for as long as nothing comes: where
    it has another address by then, the link counts as dropped.
    """

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self._group: Address | None = None
        self._far: Address | None = None
        self._near: Address | None = None  # the same, as datagrams from there name it

    async def _open(self, opening: int) -> None:
        family, address = (await self._resolve(socket.SOCK_DGRAM))[0]
        sock = self._new_socket(family, opening)
        try:
            sock.bind(("", self._local_port or _usual_port(address)))
        except OSError:  # another program has it
            sock.bind(("", 0))
        self._local_port = sock.getsockname()[1]
        self._far = address
        self._group = self._near = None
        try:
            sock.connect(address)
        except PermissionError:  # how the system says that this is a broadcast address
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._group = address
        else:
            self._near = sock.getpeername()

    async def _readable(self, waitable: socket.socket | int) -> None:
        while True:
            with anyio.move_on_after(LOOK_AGAIN):
                await super()._readable(waitable)
                return
            failures: list[LinkError] = []
            async with anyio.create_task_group() as tasks:  # a slow resolver must not keep what comes waiting
                tasks.start_soon(self._look_again)
                try:
                    await super()._readable(waitable)
                except LinkError as error:
                    failures.append(error)
                tasks.cancel_scope.cancel()
            if failures:
                raise failures[0]
            return

    async def _look_again(self) -> None:
        """While nothing comes: fail when the name has another address than the one that is spoken to."""
        opening = self._openings
        while True:
            with suppress(LinkError, TimeoutError), anyio.fail_after(OPEN_TIMEOUT):
                found = [address for _, address in await self._resolve(socket.SOCK_DGRAM)]
                if opening == self._openings and self._far not in found:
                    self._fail(f"{self._host} is at {found[0][0]} now")
            await anyio.sleep(LOOK_AGAIN)

    def _learn(self, batch: list[tuple[Address, bytes]]) -> None:
        if self._group is not None:
            super()._learn(batch)

    def _for_all(self, data: bytes) -> list[Address]:
        return [each for each in (self._group or self._near,) if each is not None]

    def _destinations(self, peer: Peer) -> list[Address]:
        if self._group is not None:
            return super()._destinations(peer)
        return [] if self._near is None or peer != self._near else [self._near]

    def _transmit(self, sock: socket.socket, data: bytes, address: Address) -> None:
        if self._group is not None:
            sock.sendto(data, address)
            return
        try:
            sock.send(data)
        except ConnectionRefusedError:
            sock.send(data)  # that was the answer to an earlier datagram; this one had not been sent


def _usual_port(address: Address) -> int:
    """Return the local port from which a remote address is spoken to, one of `LOCAL_PORTS`."""
    return LOCAL_PORTS.start + crc32(f"{address[0]} {address[1]}".encode()) % len(LOCAL_PORTS)


_NO_WAY_OUT = frozenset({errno.EADDRNOTAVAIL, errno.EINVAL, errno.ENETDOWN, errno.ENETUNREACH})
"""What is said of a socket whose own address has gone; the second by Linux before 5.3."""

_PASSING = _NO_WAY_OUT | frozenset(
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
"""What may be gone at the next datagram: no route, no listener (in two words of Windows, too), no room, a
firewall's refusal."""

_EVERY_ADDRESS = ("0.0.0.0", "::")

_LARGEST_DATAGRAM = 65535
_SO_RCVBUFFORCE = 33  # Linux, asm-generic/socket.h; the socket module has no name for it
_SIOCGSTAMP = 0x8906  # Linux, asm-generic/sockios.h
_TIMEVAL = struct.Struct("@ll")
