"""Ground stations of the gateway: the endpoints to which they connect, their queues and sequence numbers."""

from __future__ import annotations

import logging
import math
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import suppress
from itertools import cycle
from typing import Any, Final, TypeAlias

import anyio
import anyio.abc

from paramclient.cli.json_output import taken
from paramclient.client.signing import Signing, read_key
from paramclient.client.taps import FrameCutter, SeenFrame
from paramclient.errors import LinkError, UsageError
from paramclient.links import Link, Peer, create_link
from paramclient.links.sockets import TcpIn
from paramclient.protocol.addresses import peer_in_words
from paramclient.wire.frames import renumber_frame, sign_frame, unsign_frame
from paramclient.wire.messages import Heartbeat, Message, encode, message_id
from paramclient.wire.signing import Signer, SigningKey, SigningPolicy

FRAMES_PER_DATAGRAM: Final = 37
"""Frames in one datagram, at most: as many PARAM_VALUEs as fit in `DATAGRAM_SIZE`."""
DATAGRAM_SIZE: Final = 1_400
"""Bytes in one datagram, at most: MAVSDK reads 2,048, and an Ethernet frame carries 1,472."""
DATAGRAM_INTERVAL: Final = 0.002
"""Seconds between two datagrams to a station: one that sleeps for 0.5 s loses nothing then, as Linux' default
buffer holds 256 of them (measured)."""
STATION_QUEUE_MAX: Final = 4_000
"""Frames that wait for a station, at most: two seconds of a busy link. Further ones are dropped."""
QUEUE_TIME: Final = 2.0
"""Seconds for which a vehicle's frame waits if a newer message of its kind does too: a slow link cannot carry
all, and answers wait behind them."""
STREAMS_PER_STATION_MAX: Final = 256
"""Lists and files in progress for one station, at most: one of each vehicle."""
STATION_TIMEOUT: Final = 60.0
"""Seconds of silence after which a station on UDP is forgotten."""
STATIONS_MAX: Final = 64
"""Stations of one endpoint, at most; the one that was silent for longest is forgotten first."""
NOISE_MAX: Final = 4_096
"""Bytes outside of frames and whole frames, of one sender and in one second, after which its others are
dropped unread: no flood delays other stations. Data is read in pieces of as many bytes."""
REQUESTS_MAX: Final = 200
"""Requests of one station that wait for a vehicle or a fetch, at most; further ones are dropped, as on a full
link."""
READS_AT_ONCE: Final = 3
"""Reads of one station that vehicles are asked for at once: fewer than an ArduPilot queues (20)."""
SETS_AT_ONCE: Final = 20
"""Sets likewise: bursts of 20 to a PX4 were all acknowledged (measured)."""
SOURCES_MAX: Final = 64
"""Senders that are named of one station, at most."""
ENDPOINT_BACKOFF: Final = 1.0
"""Seconds before an endpoint that failed is opened again."""
ANSWER_LINK_ID: Final = 200
"""Link id of the signatures of answers: vehicles number their links from 0, and a newer timestamp under an id
of theirs would make their own frames replays."""
V1_MESSAGE_ID_MAX: Final = 255
"""The highest message id in MAVLink 1."""

Source: TypeAlias = tuple[int, int]
"""System and component of a sender."""

logger = logging.getLogger(__name__)


class Numbering:
    """The sequence numbers of one sender as a station sees them: no gap by frames that are inserted or
    withheld, and the gaps of frames that were lost before."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._offset: int | None = None

    def relay(self, number: int) -> int:
        """Return the number of a relayed frame."""
        if self._offset is None:
            self._offset = 0 if self._last is None else self._last + 1 - number
        self._last = (number + self._offset) & 0xFF
        return self._last

    def insert(self) -> int:
        """Return the number of an inserted frame."""
        self._last = 0 if self._last is None else (self._last + 1) & 0xFF
        if self._offset is not None:
            self._offset += 1
        return self._last

    def withhold(self) -> None:
        """Close the gap of a frame that is not relayed."""
        if self._offset is not None:
            self._offset -= 1


class GroundStation:
    """One partner at an endpoint.

    Frames are numbered as they leave, so that the numbers follow the order on the wire. Lists and files are
    streams, whose messages are made as the station takes them; they take turns with the frames of vehicles.

    Args:
        endpoint: where it is connected.
        peer: its address on the link; None for the only one of a link with one remote end.

    Attributes:
        endpoint, peer: as given.
        scope: of `send`.
        received_at: when its last frame arrived.
        sources: the system and component ids under which it sends.
        version: of MAVLink, of the answers: 1 only for a station that has sent version 1 and never 2.
        requests: of parameters, by kind.
        list_asked: when it last asked for a list of which no table was known; its address, and whether it is
            of extended parameters; and the tables that have answered since.
        is_loop: whether it returns what others have sent.
        waiting: requests that wait.
        files: that it has open over MAVFTP, by session.
        reading, writing: limit its reads and sets in progress, so that no station holds others up.
        relayed, answered, dropped: frames.
        saved: bytes of answers that did not have to come over the vehicle's link.
    """

    def __init__(self, endpoint: MavlinkEndpoint, peer: Peer | None) -> None:
        self.endpoint = endpoint
        self.peer = peer
        self.scope = anyio.CancelScope()
        self.received_at = anyio.current_time()
        self.sources: set[Source] = set()
        self.version = 2
        self.requests: Counter[str] = Counter()
        self.list_asked: tuple[float, Source, bool, set[Any]] = (-math.inf, (0, 0), False, set())
        self.is_loop = False
        self.waiting = 0
        self.files: dict[tuple[Hashable, ...], Any] = {}
        self.reading = anyio.CapacityLimiter(READS_AT_ONCE)
        self.writing = anyio.CapacityLimiter(SETS_AT_ONCE)
        self.relayed = self.answered = self.dropped = self.saved = 0
        self._numbering: defaultdict[Source, Numbering] = defaultdict(Numbering)
        self._queue: deque[tuple[float, Source, bytes | Message | None, bool]] = deque()  # None: withheld
        self._streams: dict[Hashable, tuple[Source, Iterator[Message]]] = {}
        self._turns = cycle((self._next_of_streams, self._next_of_queue))  # neither holds the other up
        self._held: bytes | None = None  # numbered, but too long for the last datagram
        self._something_to_send = anyio.Event()

    @property
    def name(self) -> str:
        """The endpoint's address, and its own one there."""
        return self.endpoint.address + ("" if self.peer is None else f"#{peer_in_words(self.peer)}")

    @property
    def silence(self) -> float:
        """Seconds since its last frame."""
        return anyio.current_time() - self.received_at

    @property
    def state(self) -> dict[str, Any]:
        """The state of the station, as JSON. `saved_bytes` did not have to come over the vehicle's link."""
        return {
            "name": self.name,
            "ids": sorted(f"{system}/{component}" for system, component in self.sources),
            "mavlink": self.version,
            "silence_s": round(self.silence, 3),
            "requests": dict(self.requests),
            **taken(self, "relayed", "answered", "dropped"),
            "saved_bytes": self.saved,
        }

    def received(self, seen: SeenFrame) -> None:
        """Take note of a frame of the station."""
        self.received_at = anyio.current_time()
        self.version = max(seen.frame.version, self.version if self.sources else 1)
        if len(self.sources) < SOURCES_MAX:
            self.sources.add((seen.frame.system, seen.frame.component))

    def relay(self, seen: SeenFrame, *, is_withheld: bool) -> None:
        """Queue a frame of a vehicle; a withheld one is left out, and does not count as lost."""
        self._put((seen.frame.system, seen.frame.component), None if is_withheld else seen.data)

    def say(self, message: Message, source: Source, *, is_answer: bool = True) -> None:
        """Queue a message in the name of a component; none that MAVLink 1 lacks for a station of that."""
        if self.version == 2 or message_id(type(message)) <= V1_MESSAGE_ID_MAX:
            self._put(source, message, is_answer)

    def stream(self, key: Hashable, source: Source, messages: Iterator[Message]) -> None:
        """Send messages one by one as the station takes them, in place of an earlier stream of this key."""
        if len(self._streams) < STREAMS_PER_STATION_MAX:
            self._streams[key] = (source, messages)
            self._something_to_send.set()

    def next_datagram(self) -> bytes:
        """Return the next frames, as many as fit in one datagram; empty if there are none."""
        datagram, frames = b"", 0
        while frames < FRAMES_PER_DATAGRAM:
            data, self._held = self._held or next(self._turns)() or next(self._turns)(), None
            if data is None or (frames and len(datagram) + len(data) > DATAGRAM_SIZE):
                self._held = data
                break
            datagram, frames = datagram + data, frames + 1
            self.endpoint.sending(data)
        if frames > 1:
            self.endpoint.sending(datagram)
        return datagram

    async def send(self) -> None:
        """Send what is queued, until the scope is cancelled."""
        turn_at = anyio.current_time()
        with self.scope:
            while True:
                self._something_to_send = anyio.Event()
                while data := self.next_datagram():
                    await anyio.sleep_until(turn_at)
                    turn_at = max(turn_at, anyio.current_time() - DATAGRAM_INTERVAL) + DATAGRAM_INTERVAL
                    with suppress(LinkError):  # the endpoint opens its link again
                        await self.endpoint.link.send(data, self.peer)
                await self._something_to_send.wait()

    def _put(self, source: Source, item: bytes | Message | None, is_answer: bool = False) -> None:
        if len(self._queue) < STATION_QUEUE_MAX:
            self._queue.append((anyio.current_time(), source, item, is_answer))
            self._something_to_send.set()
        else:
            self.dropped += 1

    def _next_of_queue(self) -> bytes | None:
        while self._queue:
            queued_at, source, item, is_answer = self._queue.popleft()
            numbering = self._numbering[source]
            if item is None:
                numbering.withhold()
            elif not isinstance(item, bytes):
                return self._inserted(source, item, is_answer)
            elif anyio.current_time() - queued_at > QUEUE_TIME and self._has_newer(item):
                self.dropped += 1
            else:
                self.relayed += 1
                is_version_2 = item[0] == 0xFD
                if is_version_2 and item[2] and not self.endpoint.is_trusted:
                    return item  # signed: renumbered, it would be rejected
                return renumber_frame(unsign_frame(item), numbering.relay(item[4 if is_version_2 else 2]))
        return None

    def _has_newer(self, item: bytes) -> bool:
        """Return whether a message of the kind of a frame waits behind it."""
        kind = slice(5, 10) if item[0] == 0xFD else slice(3, 6)  # sender and message id
        return any(isinstance(each, bytes) and each[kind] == item[kind] for _, _, each, _ in self._queue)

    def _next_of_streams(self) -> bytes | None:
        for key, (source, messages) in list(self._streams.items()):
            for message in messages:
                return self._inserted(source, message, not isinstance(message, Heartbeat))
            del self._streams[key]
        return None

    def _inserted(self, source: Source, message: Message, is_answer: bool) -> bytes:
        ids = {"system": source[0], "component": source[1], "sequence": self._numbering[source].insert()}
        data = encode(message, version=self.version, **ids)
        if self.endpoint.signer is not None:
            data = sign_frame(data, self.endpoint.signer)
        self.answered += is_answer
        self.saved += len(data) * is_answer
        return data


Take: TypeAlias = Callable[[GroundStation, SeenFrame], None]
"""Called with each frame of a station."""


class MavlinkEndpoint:
    """A link on which ground stations connect to the gateway.

    `udpin:` and `tcpin:` take any number of stations; on any other link, there is one.

    Args:
        link: its name, or a link.
        is_readonly: whether nothing of its stations changes a vehicle.
        is_trusted: whether its stations, which do not sign, may write to a signed vehicle. They receive its
            frames without signatures.
        key: with which its stations and the answers are signed; None for unsigned stations.

    Attributes:
        link, name, is_readonly, is_trusted: as given; with a key, all its stations sign.
        may_sign: whether what its stations ask may be sent with the gateway's signature.
        signer: signs the answers; None without a key. Its time follows that of the stations' frames.
        stations: the connected stations.
        sending: called with each frame and each datagram that is about to be sent to a station.
    """

    def __init__(
        self,
        link: str | Link,
        *,
        is_readonly: bool = False,
        is_trusted: bool = False,
        key: SigningKey | None = None,
    ) -> None:
        self.link = create_link(link)
        self.name = self.link.name
        self.is_readonly = is_readonly
        self.is_trusted = is_trusted and key is None
        self.may_sign = is_trusted or key is not None
        self.stations: dict[Peer | None, GroundStation] = {}
        self.sending: Callable[[bytes], None] = lambda data: None
        self.signer: Signer | None = None
        self._accepts: Callable[[bytes], bool] = lambda data: True
        if key is not None:
            self.signer, verifier = Signing(key, SigningPolicy.SIGNED_ONLY, ANSWER_LINK_ID).begin()
            self._accepts = verifier.accepts
        self._listens = self.name.startswith(("udpin:", "tcpin:"))

    @property
    def address(self) -> str:
        """The name, with the port that the system has chosen in place of 0."""
        bound = getattr(self.link, "address", None)
        if bound is None or not self.name.endswith(":0"):
            return self.name
        return f"{self.name.removesuffix('0')}{bound[1]}"

    async def open(self) -> None:
        """Open the link.

        Raises:
            LinkError: a listening link cannot be opened. Another one is opened later.
        """
        try:
            await self.link.open()
        except LinkError as error:
            if self._listens:
                raise
            logger.warning("%s", error)

    async def run(self, take: Take) -> None:
        """Receive frames of the stations and send theirs to them, until cancelled.

        Args:
            take: called with each frame of a station.
        """
        try:
            async with anyio.create_task_group() as tasks:
                if isinstance(self.link, TcpIn):  # a station may wait for the first heartbeat
                    self.link.accepted = lambda peer: self._station(peer, tasks)
                elif not self._listens:
                    self._station(None, tasks)
                while True:
                    try:
                        await self._read(take, tasks)
                    except LinkError as error:
                        logger.warning("%s; reopening", error)
                        await self._reopen()
        finally:
            with anyio.CancelScope(shield=True):
                await self.link.close()

    async def _read(self, take: Take, tasks: anyio.abc.TaskGroup) -> None:
        """Receive frames until the link fails."""
        cutter = FrameCutter(stream=self.link.is_stream)
        noise: Counter[Peer] = Counter()  # bytes outside of frames, and frames, since
        since = anyio.current_time()
        while True:
            received = list[tuple[Peer, bytes]]()
            with anyio.move_on_after(STATION_TIMEOUT):
                received = await self.link.receive()
            if anyio.current_time() >= since + 1:
                noise, since = Counter(), anyio.current_time()
            for peer, chunk in received:
                for at in range(0, len(chunk) or 1, NOISE_MAX):
                    data = chunk[at : at + NOISE_MAX]
                    for seen in cutter.cut(data, peer) if noise[peer] < NOISE_MAX else ():
                        noise[peer] += 1 - seen.size
                        if self._accepts(seen.data):
                            station = self._station(peer if self._listens else None, tasks)
                            station.received(seen)
                            take(station, seen)
                    noise[peer] += len(data)
                if not chunk and self._listens:
                    self._forget(peer)
            if self._listens and not self.link.is_stream:
                for peer in [peer for peer, each in self.stations.items() if each.silence > STATION_TIMEOUT]:
                    self._forget(peer)

    async def _reopen(self) -> None:
        for peer in list(self.stations) if self._listens else ():
            self._forget(peer)
        while True:
            await anyio.sleep(ENDPOINT_BACKOFF)
            with suppress(LinkError):
                return await self.link.open()

    def _station(self, peer: Peer | None, tasks: anyio.abc.TaskGroup) -> GroundStation:
        station = self.stations.get(peer)
        if station is None:
            if len(self.stations) >= STATIONS_MAX:
                self._forget(max(self.stations, key=lambda each: self.stations[each].silence))
            station = self.stations[peer] = GroundStation(self, peer)
            logger.info("%s: connected", station.name)
            tasks.start_soon(station.send)
        return station

    def _forget(self, peer: Peer | None) -> None:
        station = self.stations.pop(peer, None)
        if station is not None:
            logger.info("%s: disconnected", station.name)
            station.scope.cancel()


def parse_endpoint(text: str) -> MavlinkEndpoint:
    """Return the endpoint with this name: that of a link, with options, such as `tcpin:5760?readonly`.

    A listening link without an address listens on the loopback address.

    Raises:
        UsageError: the name or an option is invalid, or no station can be there.
    """
    link, _, query = text.partition("?")
    kind, _, port = link.partition(":")
    if kind in ("sim", "replay"):
        raise UsageError(f"{link} is no endpoint: stations connect to udpin, udpout, tcpin, tcp or serial")
    if kind in ("udpin", "udp", "tcpin") and port.isdecimal():
        link = f"{kind}:127.0.0.1:{port}"
    options = dict(each.partition("=")[::2] for each in query.split("&") if each)
    for each, value in options.items():
        if each not in ("readonly", "trusted", "sign") or bool(value) != (each == "sign"):
            given = f"{each}={value}".rstrip("=")
            raise UsageError(f"{given!r} is not an option; those are readonly, trusted and sign=KEYFILE")
    key = read_key(options["sign"]) if "sign" in options else None
    return MavlinkEndpoint(link, is_readonly="readonly" in options, is_trusted="trusted" in options, key=key)
