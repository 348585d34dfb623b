"""Ground stations in virtual time: a link with any number of them, and a gateway between it and vehicles."""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import anyio

from paramclient import ParamClient
from paramclient.client.signing import timestamp_now
from paramclient.links import Peer
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.service.gateway import Gateway
from paramclient.service.stations import MavlinkEndpoint
from paramclient.sim import Endpoint
from paramclient.wire.frames import Frame, Framer, sign_frame
from paramclient.wire.messages import DECODED_IDS, FileTransfer, Heartbeat, Message, decode, encode
from paramclient.wire.signing import Signer, SigningKey, SigningPolicy, Verifier
from tests.shell import PeersLink, a_client, until

T = TypeVar("T")


class StationsLink(PeersLink):
    """A link on which ground stations of the test speak to the gateway.

    Attributes:
        is_stuck: nothing is taken, and a sender waits.
    """

    def __init__(self, name: str = "udpin:stations:14551") -> None:
        super().__init__({}, name)
        self.is_stuck = False

    def add(self, station: Partner) -> Callable[[], None]:
        """Add a station; return what it calls when it has something to send."""
        self.endpoints["station", len(self.endpoints)] = station
        return self._wake

    async def send(self, data: bytes, peer: Peer | None) -> None:
        while self.is_stuck:  # noqa: ASYNC110 - set by the test
            await anyio.sleep(0.1)
        await super().send(data, peer)


class Partner:
    """A ground station: it sends messages, and keeps what it receives.

    Attributes:
        datagrams, frames: received.
        times: when each frame was received.
        signer, verifier: sign what is sent, and judge what is received; None without a key.
        lost: frames that the sequence numbers say are lost, by sender.
    """

    def __init__(
        self,
        link: StationsLink,
        *,
        system: int = 255,
        component: int = 190,
        version: int = 2,
        key: SigningKey | None = None,
    ) -> None:
        self.datagrams: list[bytes] = []
        self.frames: list[Frame] = []
        self.times: list[float] = []
        self.lost = Counter[tuple[int, int]]()
        self.address = (system, component)
        self._version = version
        self._out: list[bytes] = []
        self._wake = link.add(self)
        self._framer = Framer(stream=False)
        self.signer = None if key is None else Signer(key, link_id=100, timestamp=timestamp_now())
        self.verifier = None if self.signer is None else Verifier(self.signer, SigningPolicy.SIGNED_ONLY)
        if self.verifier is not None:
            self._framer.guard = self.verifier.accepts
        self._last: dict[tuple[int, int], int] = {}
        self._sequence = 0

    def send(self, *messages: Message) -> None:
        for message in messages:
            system, component = self.address
            options: dict[str, Any] = {"sequence": self._sequence, "version": self._version}
            data = encode(message, system=system, component=component, **options)
            self.send_bytes(data if self.signer is None else sign_frame(data, self.signer))
            self._sequence = (self._sequence + 1) & 0xFF

    def send_bytes(self, data: bytes) -> None:
        self._out.append(data)
        self._wake()

    def data_to_send(self) -> list[bytes]:
        out, self._out = self._out, []
        return out

    def tick(self, now: float) -> None:
        """Nothing is due."""

    def next_deadline(self) -> None:
        return None

    def receive(self, data: bytes, now: float) -> None:
        self.datagrams.append(data)
        for frame in self._framer.receive(data):
            if (source := (frame.system, frame.component)) in self._last:
                self.lost[source] += frame.sequence - self._last[source] - 1 & 0xFF
            self._last[source] = frame.sequence
            self.frames.append(frame)
            self.times.append(now)

    def of(self, kind: type[T], *, system: int | None = None) -> list[T]:
        """The received messages of a kind."""
        chosen = [each for each in self.frames if system in (None, each.system)]
        found = (decode(each) for each in chosen if each.message_id in DECODED_IDS)
        return [each for each in found if isinstance(each, kind)]

    def clear(self) -> None:
        self.datagrams.clear()
        self.frames.clear()
        self.times.clear()

    async def ask(self, *messages: Message, seconds: float = 0.5) -> None:
        """Forget what was received, send, and wait."""
        self.clear()
        self.send(*messages)
        await anyio.sleep(seconds)

    async def ask_file(self, opcode: Opcode, *, seconds: float = 0.5, **fields: Any) -> list[Packet]:
        """Send a request of MAVFTP to 1/1, and return the answers."""
        packet = Packet(**{"sequence": 1, "session": 0, "opcode": opcode} | fields)
        await self.ask(FileTransfer(0, 1, 1, packet.pack()), seconds=seconds)
        return [Packet.unpack(each.payload) for each in self.of(FileTransfer)]


class _Behind:
    """An endpoint whose data is what a partner of a gateway receives."""

    def __init__(self, partner: Partner) -> None:
        self._partner = partner

    def receive(self, data: bytes, now: float) -> None:
        self._partner.send_bytes(data)

    def tick(self, now: float) -> None:
        self._at = now + 0.005

    def next_deadline(self) -> float:
        return self._at

    def data_to_send(self) -> list[bytes]:
        data, self._partner.datagrams = self._partner.datagrams, []
        return data


@dataclass
class Served:
    """A gateway over the links of some vehicles, with ground stations.

    Attributes:
        gateway, clients, link: the parts.
    """

    gateway: Gateway
    clients: list[ParamClient]
    link: StationsLink

    def partner(self, **options: Any) -> Partner:
        """A new ground station; it is known from its first frame on."""
        return Partner(self.link, **options)

    async def heard(self, **options: Any) -> Partner:
        """A new ground station, which has heard a vehicle."""
        station = self.partner(**options)
        station.send(Heartbeat(6, 8))
        await until(lambda: station.frames)
        return station

    def as_vehicles(self) -> Endpoint:
        """The gateway as another one sees it: an endpoint with the vehicles."""
        return _Behind(self.partner(system=254, component=191))

    async def synced(self) -> None:
        """Fetch all tables."""
        for client in self.clients:
            await (await client.component()).fetch_all()


@asynccontextmanager
async def gateway_over(
    *links: Any, endpoint: dict[str, Any] | None = None, **options: Any
) -> AsyncIterator[Served]:
    """Open a gateway over vehicles. `endpoint`: options of the endpoint."""
    link = StationsLink()
    gateway = Gateway([MavlinkEndpoint(link, **(endpoint or {}))])
    clients = [a_client(each, **options) for each in links]
    async with anyio.create_task_group() as tasks:
        await gateway.open()
        tasks.start_soon(gateway.run)
        for client in clients:
            gateway.attach(client)
            await client.open()
        try:
            yield Served(gateway, clients, link)
        finally:
            for client in clients:
                await client.aclose()
            tasks.cancel_scope.cancel()
