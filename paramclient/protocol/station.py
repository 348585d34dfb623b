"""The ground station's side of one link: its components, the heartbeat, and the routing of messages."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import anyio

from paramclient.errors import LinkError, UsageError
from paramclient.model.values import Encoding
from paramclient.protocol.addresses import Address, Peer, PeerAddress, peer_in_words
from paramclient.protocol.channel import Gate
from paramclient.protocol.dialect import EXTENDED, PLAIN
from paramclient.protocol.node import RIVAL_TIME, Node
from paramclient.protocol.session import Spawn
from paramclient.wire import messages
from paramclient.wire.frames import BOOT_CLOCK_OFFSETS, Frame, Framer, sign_frame
from paramclient.wire.messages import Heartbeat, Message, ParamExtSet, ParamSet, decode, encode, message_id
from paramclient.wire.signing import Signer, Verifier

SEEK_INTERVAL: Final = 0.25
"""Seconds between two requests for the heartbeat of an unknown component."""
SEEK_MAX: Final = 20
"""Requests for the heartbeat of one system: it may be no vehicle, or serve no such request."""
HEARTBEAT_INTERVAL: Final = 1.0
"""Seconds between two heartbeats of ours, by the standard."""
PROBES: Final = 13
"""Turns of a search for a component that was not heard."""
PROBES_OTHER: Final = range(7, 10)
"""Those in which another address is asked; from the first of them on, the answers are to these requests."""
COMPONENTS_MAX: Final = 1_000
"""Components followed on one link: more than 250 systems with a few each."""
STREAM_PEERS_MAX: Final = 256
"""Peers of a stream with an unfinished frame."""
_SIGNS: Final = (Heartbeat, messages.HighLatency2, messages.ParamValue, messages.ParamExtValue)
"""Messages that show a new component."""
_MAVLINK2_REQUESTS: Final = (messages.ParamExtRequestRead, messages.ParamExtRequestList, ParamExtSet)
"""Requests that exist in MAVLink 2 only: a component that has sent MAVLink 1 so far may understand them."""

logger = logging.getLogger(__name__)


@dataclass(kw_only=True, eq=False, repr=False)
class Station:
    """Turns received bytes into messages of components, and their requests into bytes to send.

    The first live peer owns the ids of a component. Messages with these ids from another live peer are
    ignored, with a warning, and nothing is written to the component meanwhile. With `split_peers`, they are
    another component.

    Args:
        link: the link's name.
        is_stream: whether frames may be spread over several chunks.
        send: queues bytes for a peer; None for all.
        spawn: starts an async function in the background.
        own_address: our system and component ids.
        encoding: of all components, by the user's choice; None: by the evidence.
        listens_only: whether nothing is ever sent.
        split_peers: whether equal ids at different peers are different components.
        discovered: called with a new component, before its first message is taken.

    Attributes:
        nodes: every known component, by (system, component).
        gate: whether the link carries messages.
        listening_since: since when everything on the link is received.
        verifier: verifies signatures; None without a key.
        broadcaster: the last heartbeat with the system id 0, which no vehicle may have; None without one.
        own_type: MAV_TYPE of our heartbeat.
    """

    link: str
    is_stream: bool
    send: Callable[[bytes, Peer | None], None]
    spawn: Spawn
    own_address: Address = (255, 190)
    encoding: Encoding | None = None
    listens_only: bool = False
    split_peers: bool = False
    discovered: Callable[[Node], None] = lambda node: None

    def __post_init__(self) -> None:
        self.nodes: dict[Address, Node] = {}
        self.gate = Gate()
        self.own_type = messages.MAV_TYPE_GCS
        self.listening_since = -math.inf
        self.verifier: Verifier | None = None
        self.broadcaster: Heartbeat | None = None
        self._datagrams = self._new_framer(stream=False)
        self._framers: dict[Peer, Framer] = {}
        self._ended_peers: set[Peer] = set()  # of components: another connection may take their ids
        self._sequence = 0
        self._seek_at = -math.inf  # when the next heartbeat may be requested
        self._sought: Counter[int] = Counter()  # requests by system
        self._signer: Signer | None = None
        self._asked: dict[Address, int] = {}  # probes to components that were not heard

    @property
    def is_waiting(self) -> bool:
        """Whether a conversation waits for a message."""
        return any(node.channel.inboxes for node in self.nodes.values())

    @property
    def frames(self) -> int:
        """Frames that were received."""
        return sum(framer.frames for framer in (self._datagrams, *self._framers.values()))

    def check_may_send(self) -> None:
        """Check that requests can be sent.

        Raises:
            UsageError: the client only listens.
            LinkError: the link failed, or the client is not open.
        """
        self.gate.check()
        if self.listens_only:
            raise UsageError("the client only listens, and sends no requests")

    def begin_signing(self, signer: Signer, verifier: Verifier) -> None:
        """Sign what is sent, and accept what the verifier accepts; call it before `receive`."""
        self._signer = signer
        self.verifier = verifier
        self._datagrams.guard = verifier.accepts

    def receive(self, data: bytes, peer: Peer, now: float) -> None:
        """Take a datagram, or a chunk of a stream; an empty chunk means the end of the peer's stream."""
        framer = self._framer_of(peer) if self.is_stream else self._datagrams
        for frame in framer.receive(data):
            self._take(frame, peer, now)
        if not data:
            self._ended_peers.update(node.peer for node in self.nodes.values() if node.peer == peer)

    def _seek(self, frame: Frame, peer: Peer, now: float) -> None:
        """Request the heartbeat of an autopilot of which only other messages were received.

        A heartbeat is due once a second only; the command brings it in one round trip (measured on PX4).
        """
        requests = self._sought[frame.system]
        if frame.component == messages.AUTOPILOT_COMPONENT and now >= self._seek_at and requests < SEEK_MAX:
            self._seek_at = now + SEEK_INTERVAL
            self._sought[frame.system] += 1
            target, wanted = (frame.system, frame.component), float(message_id(Heartbeat))
            request = messages.CommandLong(*target, messages.MAV_CMD_REQUEST_MESSAGE, wanted)
            self.transmit(request, peer, frame.version)

    def probe(self, system: int, component: int) -> None:
        """Request a value of a component that was not heard: it may send no heartbeat.

        By turns its first parameter; the list, for firmware without reads; the index 1, where some begin; an
        extended parameter; and the first of the autopilot, under whose address some answer with their own.
        Before and after that, a few turns go by: an answer must tell which address was asked.
        """
        number = self._asked[system, component] = (self._asked.get((system, component), -1) + 1) % PROBES
        target = (system, component)
        ways = {
            0: PLAIN.request_read(target, 0),
            1: PLAIN.request_list(target),
            2: PLAIN.request_read(target, 1),
            3: EXTENDED.request_read(target, 0),
            **dict.fromkeys(PROBES_OTHER, PLAIN.request_read((system, messages.AUTOPILOT_COMPONENT), 0)),
        }
        if number in ways:
            self.transmit(ways[number], None, next((node.version for node in self.nodes.values()), 2))

    def overhear(self, data: bytes, now: float) -> None:
        """Take a frame that another program sends to the vehicles over this link: it may be a PARAM_SET."""
        for frame in self._new_framer(stream=False).receive(data):
            message = decode(frame)
            if isinstance(message, ParamSet | ParamExtSet):
                self._take_foreign_set(message, frame, now)

    def transmit(self, message: Message, peer: Peer | None, version: int = 2) -> None:
        """Queue a message for a peer, or with None for all."""
        if self.listens_only:
            return
        system, component = self.own_address
        if logger.isEnabledFor(logging.DEBUG) and not isinstance(message, Heartbeat):
            logger.debug("%s: to %s: %r", self.link, "all" if peer is None else peer_in_words(peer), message)
        if isinstance(message, _MAVLINK2_REQUESTS):
            version = 2
        data = encode(message, system=system, component=component, sequence=self._sequence, version=version)
        self._sequence = (self._sequence + 1) & 0xFF
        if self._signer is not None:
            data = sign_frame(data, self._signer)
        self.send(data, peer)

    async def send_heartbeats(self) -> None:
        """Send our heartbeat once a second."""
        beat = Heartbeat(
            self.own_type, messages.MAV_AUTOPILOT_INVALID, system_status=messages.MAV_STATE_ACTIVE
        )
        while not self.listens_only:
            if self.gate.is_open:
                if self._signer is not None:
                    self._signer.advance(anyio.current_time())
                self.transmit(beat, None)
            await anyio.sleep(HEARTBEAT_INTERVAL)

    def interrupt(self) -> None:
        """Hold all requests: the link is down."""
        self.gate.interrupt()
        self.listening_since = math.inf
        self._framers.clear()

    def resume(self, now: float) -> None:
        """Let requests go on: the link is back."""
        self.listening_since = now
        self.gate.open()
        for node in self.nodes.values():
            if not (node.presence.is_lost or self.listens_only):
                node.resumed()

    def fail(self, error: LinkError, *, for_good: bool = False) -> None:
        """End all conversations: the link is down for too long, or for good."""
        self.gate.fail(error, for_good=for_good)
        for node in self.nodes.values():
            node.channel.lose()

    def _new_framer(self, *, stream: bool) -> Framer:
        framer = Framer(messages.DECODED_IDS, occasional=BOOT_CLOCK_OFFSETS, stream=stream)
        framer.takes_occasional = True
        return framer

    def _framer_of(self, peer: Peer) -> Framer:
        framer = self._framers.get(peer)
        if framer is None:
            framer = self._framers[peer] = self._new_framer(stream=True)
            framer.guard = self._datagrams.guard
            if len(self._framers) > STREAM_PEERS_MAX:
                del self._framers[next(iter(self._framers))]
        return framer

    def _take(self, frame: Frame, peer: Peer, now: float) -> None:
        system, component = frame.system, frame.component
        address = PeerAddress(system, component, peer) if self.split_peers else (system, component)
        node = self.nodes.get(address)
        message = decode(frame)
        is_own = (system, component) == self.own_address and not self.listens_only
        if system == 0 and isinstance(message, Heartbeat):
            self.broadcaster = message
        if is_own or system == 0:
            return
        if message is None:
            if node is None:
                self._seek(frame, peer, now)
            elif peer == node.peer:
                at = BOOT_CLOCK_OFFSETS[frame.message_id]
                node.boot_clock(frame.message_id, int.from_bytes(frame.payload[at : at + 4], "little"), now)
            return
        if isinstance(message, ParamSet | ParamExtSet):
            self._take_foreign_set(message, frame, now)
            return
        if node is None:
            if not isinstance(message, _SIGNS) or len(self.nodes) >= COMPONENTS_MAX:
                return
            node = self._add(address, peer, now)
            is_other = self._asked.get((system, component), 0) >= PROBES_OTHER.start
            if is_other and isinstance(message, messages.ParamValue):  # the answer to a probe
                node.channel.reads_from = (system, messages.AUTOPILOT_COMPONENT)
        if peer != node.peer:
            if not self._moves(node, peer, message, now):
                return
        elif node.rival is not None and node.told_rival != node.rival[0]:  # both are there
            node.told_rival = node.rival[0]
            logger.warning(
                "%s: messages of %d/%d arrive from %s too, and are ignored: two vehicles have the same ids",
                *(self.link, node.system, node.component, peer_in_words(node.told_rival)),
            )
        self._ended_peers.discard(peer)
        node.receive(message, now, frame.version, frame.sequence)

    def _moves(self, node: Node, peer: Peer, message: Message, now: float) -> bool:
        """Return whether a component is at another peer now: its own is silent, or it is the same link."""
        last = node.presence.received_at
        is_gone = now - last > RIVAL_TIME or last < self.listening_since  # the link was opened again
        if is_gone or node.peer in self._ended_peers or node.is_same_vehicle(message):
            node.peer = peer
            node.rival = None
            if not node.is_same_vehicle(message):
                node.resumed()
            return True
        node.rival = (peer, now)
        return False

    def _take_foreign_set(self, message: ParamSet | ParamExtSet, frame: Frame, now: float) -> None:
        for node in self.nodes.values():
            ids = (node.component, messages.COMP_ID_ALL)
            if message.target_system == node.system and message.target_component in ids:
                session = node.plain if isinstance(message, ParamSet) else node.extended
                session.foreign_set(message.param_id, f"station {frame.system}/{frame.component}", now)

    def _add(self, address: Address, peer: Peer, now: float) -> Node:
        node: Node

        def transmit(message: Message) -> None:
            is_reopened = node.presence.received_at < self.listening_since  # its peer may have another name
            self.transmit(message, None if is_reopened else node.peer, node.version)

        node = Node(
            address,
            link=f"{self.link}#{peer_in_words(peer)}" if self.split_peers else self.link,
            peer=peer,
            since=now,
            transmit=transmit,
            gate=self.gate,
            encoding=self.encoding,
            listens_only=self.listens_only,
            spawn=self.spawn,
        )
        self.nodes[address] = node
        self.discovered(node)
        self.spawn(node.watch_presence)
        if not self.listens_only:
            self.spawn(node.identify)
        return node
