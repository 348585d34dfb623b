"""One component on the link: its channel, presence, identity, and its plain and extended parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import anyio

from paramclient.model.identity import Identity, hardware_id
from paramclient.model.values import Encoding
from paramclient.protocol.addresses import Address, Peer, PeerAddress
from paramclient.protocol.channel import WINDOW_PX4, Channel, Gate
from paramclient.protocol.dialect import EXTENDED, PLAIN, Digest
from paramclient.protocol.identity import HEARTBEAT_WAIT, Identification
from paramclient.protocol.presence import SYSTEM_TIME, Presence
from paramclient.protocol.reads import read_again
from paramclient.protocol.session import Session, Shared, Spawn
from paramclient.wire import messages
from paramclient.wire.messages import CommandLong, Message

RIVAL_TIME: Final = 5.0
"""Seconds after its last message for which a peer counts as live: no other takes its ids meanwhile."""
REBOOT_SILENCE_MIN: Final = 1.25
"""Seconds without a message after which an ArduPilot may have rebooted (measured)."""
CLOCK_DELAY: Final = 2.0
"""Seconds from the identification until the clock of an ArduPilot without telemetry is requested."""
CLOCK_REQUESTS: Final = 2
"""Requests for it: one may be lost, and nothing waits for the answer."""
CLOCK_INTERVAL: Final = 1.0
"""Seconds between them."""
ACCEPTED: Final = 0
"""PARAM_ACK_ACCEPTED in PARAM_EXT_ACK."""


class Node:
    """One component on the link, as its messages show it.

    Args:
        address: its address, with the peer where equal ids at other peers are other components.
        link: the link's name, part of an identity without a hardware id.
        peer: from which its messages arrive.
        since: when it was heard first.
        transmit: queues a message for the component.
        gate: whether the link carries messages.
        encoding: chosen by the user, or None.
        listens_only: whether nothing is requested.
        spawn: starts an async function in the background.

    Attributes:
        channel, presence, identification: the parts.
        plain, extended: the parameters.
        emit: called with what happens: "identified" (as far as it ever is), "lost" and "found" with the
            `silence` in seconds, "rebooted", "replaced" (another vehicle uses the address: everything known
            is invalid).
        address, peer, since: as given; a vehicle may move to another peer.
        system, component, is_split: what the address has.
        rival: another live peer that uses the same ids, and when it was heard; None without one.
        told_rival: the one of which the user was warned.
        version: of MAVLink, 1 or 2, by its last message.
        generation: counts how often the component was lost, has rebooted or was replaced: a conversation that
            sees another number than at its begin knows that values are of different times.
    """

    def __init__(
        self,
        address: Address,
        *,
        link: str,
        peer: Peer,
        since: float,
        transmit: Callable[[Message], None],
        gate: Gate,
        encoding: Encoding | None,
        listens_only: bool,
        spawn: Spawn,
    ) -> None:
        self.address = address
        self.system, self.component = address
        self.peer = peer
        self.since = since
        self.is_split = isinstance(address, PeerAddress)
        self.rival: tuple[Peer, float] | None = None
        self.told_rival: Peer | None = None
        self.presence = Presence()
        self.channel = Channel(*address, transmit, gate, self.presence)
        self.identification = Identification(Identity(self.system, link), encoding, listens_only)
        self.plain = Session(self.channel, self.identification, PLAIN, spawn, self.identified)
        self.extended = Session(self.channel, self.identification, EXTENDED, spawn, self.identified)
        self.sessions = (self.plain, self.extended)
        self.emit: Callable[..., None] = lambda kind, **facts: None
        self.version = 2
        self.generation = 0
        self._spawn = spawn
        self._identifying: Shared[None] = Shared(spawn, gate)
        self.identification.derived = self._settle_encoding
        self._settle_encoding()  # the user may have chosen it

    def receive(self, message: Message, now: float, version: int = 2, sequence: int = 0) -> None:
        """Take a message of the component: into the tables, and to the conversations that wait for it."""
        presence = self.presence
        silence, presence.received_at = now - presence.received_at, now
        self.version = version
        if presence.is_lost:
            presence.is_lost = False
            self.emit("found", silence=silence)
            self._spawn(self.identify)
        elif silence > REBOOT_SILENCE_MIN and self.identification.is_settled:
            self._spawn(self._request_clock)
        match message:
            case messages.ParamValue():
                if (until := self.plain.receive(message, now, sequence)) is not None:
                    self._spawn(read_again, self.plain, message.param_id, until)
                if message.param_id == messages.HASH_CHECK:
                    self.plain.announce(Digest.of(message))
            case messages.ParamExtValue():
                self.extended.table.store(message, now)
            case messages.ParamExtAck(param_id=name, raw=raw, param_type=number, param_result=result):
                table = self.extended.table
                if result == ACCEPTED and (known := table.params.get(name)) is not None:
                    index = 65535 if known.index is None else known.index
                    table.store(messages.ParamExtValue(name, raw, number, table.count or 0, index), now)
            case messages.Heartbeat():
                if self.identification.heartbeat(message):
                    self._doubt()
                    self._spawn(self.identify)
                if presence.heartbeat(message, now):
                    self.rebooted(now)
            case messages.HighLatency2():
                presence.high_latency()
                self.identification.heartbeat(message)
            case messages.SystemTime(time_boot_ms=boot_ms):
                self.boot_clock(SYSTEM_TIME, boot_ms, now)
            case messages.AutopilotVersion():
                if self.identification.version(message):
                    self._replace()
                self.emit("identified")
        self.channel.dispatch(message)

    async def identified(self) -> None:
        """Wait for the identity that was requested last."""
        await self._identifying.join(lambda: self.identification.request(self.channel))

    def boot_clock(self, number: int, boot_ms: int, now: float) -> None:
        """Take the time since boot in a message."""
        if self.presence.boot_clock(number, boot_ms, now):
            self.rebooted(now)

    def rebooted(self, now: float) -> None:
        """Doubt all values: the vehicle has rebooted, and may have measured or loaded others."""
        self.presence.rebooted(now)
        self._doubt()
        self.emit("rebooted")
        self._spawn(self.identify)

    def resumed(self) -> None:
        """Doubt all values: the link was interrupted, and may lead to another vehicle."""
        self._doubt()
        for session in self.sessions:
            session.table.recounted()
        self._spawn(self.identify)

    def is_same_vehicle(self, message: Message) -> bool:
        """Return whether a message of another peer proves to be of this vehicle, by its hardware id."""
        if not isinstance(message, messages.AutopilotVersion):
            return False
        uid = hardware_id(message.uid, message.uid2)
        return uid is not None and uid == self.identification.identity.uid

    def has_rival(self, now: float) -> bool:
        """Return whether another live peer uses the same ids."""
        return self.rival is not None and now - self.rival[1] <= RIVAL_TIME

    def _settle_encoding(self) -> None:
        if self.identification.is_px4:
            self.channel.widen(WINDOW_PX4)
        self.plain.table.encoding = self.identification.encoding
        if self.identification.is_encoding_certain:
            self.plain.table.report_held()

    def _doubt(self) -> None:
        self.generation += 1
        self.identification.doubt()
        for session in self.sessions:
            session.table.doubt()

    def _replace(self) -> None:
        self.generation += 1
        for session in self.sessions:
            session.table.clear()
        self.emit("replaced")

    async def identify(self) -> None:
        """Request the identity, unless that is in progress."""
        if not self.identification.has_parameters:
            self.identification.settle()  # so that nothing waits for what is never requested
            return
        was_settled = self.identification.is_settled
        await self.identified()
        if not was_settled and self.identification.capabilities is None:
            self.emit("identified")
        if not self.identification.is_encoding_certain:
            await anyio.sleep(HEARTBEAT_WAIT)
            self.identification.miss_heartbeat()
        if not self.channel.answered.is_set():  # requests may not reach it yet
            await self.channel.answered.wait()
            await self.identified()
        await anyio.sleep(CLOCK_DELAY)
        await self._request_clock()

    async def _request_clock(self) -> None:
        """Request the time since boot: a reboot of an ArduCopter without telemetry shows in nothing else."""
        request = CommandLong(*self.channel.target, messages.MAV_CMD_REQUEST_MESSAGE, float(SYSTEM_TIME))
        for _ in range(CLOCK_REQUESTS):
            if self.identification.is_ardupilot and not self.presence.has_telemetry:
                self.channel.send(request)
            await anyio.sleep(CLOCK_INTERVAL)

    async def watch_presence(self) -> None:
        """Mark the component as lost when it is silent for its timeout."""
        presence = self.presence
        while True:
            silence = anyio.current_time() - presence.received_at
            timeout = presence.timeout
            if not presence.is_lost and silence >= timeout:
                presence.is_lost = True
                self._doubt()
                self.emit("lost", silence=silence)
                if self.channel.gate.is_open:
                    self.channel.lose()
            await anyio.sleep(min(max(timeout - silence, 0.001), 1.0) if not presence.is_lost else 1.0)
