"""The ground station's side of one link: every component heard on it, our heartbeat, and who gets what."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from typing import Final, TypeAlias

from paramclient.errors import LinkError
from paramclient.identity import Identity
from paramclient.protocol.component import ComponentHeard, ComponentMachine, Event
from paramclient.protocol.fetch import Fetch, present_of
from paramclient.protocol.turns import Turns
from paramclient.protocol.wire import (
    AUTOPILOT_COMPONENT,
    COMP_ID_ALL,
    MAV_AUTOPILOT_INVALID,
    MAV_STATE_ACTIVE,
    MAV_TYPE_GCS,
    Framer,
    Heartbeat,
    Message,
    ParamRequestList,
    ParamSet,
    ParamValue,
    decode,
    encode,
)
from paramclient.values import Encoding

__all__ = ["Address", "Peer", "Station"]

Address: TypeAlias = tuple[int, int]
"""System and component."""
Peer: TypeAlias = Hashable
"""Who sent something, as the link tells them apart."""

HEARTBEAT_INTERVAL: Final = 1.0
MOST_COMPONENTS: Final = 1_000
"""Components followed on one link: more than 250 systems with a few each have. Further ones are not heard."""
MOST_PEERS: Final = 256
"""Stream peers whose unfinished frames are kept."""
HEARD: Final = frozenset({0, 22, 23, 77, 148, 253, 345})
"""The message ids that matter here: HEARTBEAT, PARAM_VALUE, PARAM_SET (of others), COMMAND_ACK,
AUTOPILOT_VERSION, STATUSTEXT, PARAM_ERROR."""


class Station:
    """Turns what a link delivers into tables and answers, and what is wanted into bytes to send.

    Feed it with `receive`, call `tick` at `next_deadline`, send what `data_to_send` gives, look at `events`.

    Args:
        link: the link's canonical name.
        is_stream: whether frames may be spread over several chunks.
        system, component: who we are.
        encoding: for all components, where the user knows better; None: judged by the evidence.

    Attributes:
        components: every component heard, by (system, component).
        bytes_received, bytes_sent: on this link, by this station.
    """

    def __init__(
        self,
        *,
        link: str,
        is_stream: bool,
        system: int = 255,
        component: int = 190,
        encoding: Encoding | None = None,
    ) -> None:
        self.link = link
        self.own: Address = (system, component)
        self.components: dict[Address, ComponentMachine] = {}
        self.bytes_received = 0
        self.bytes_sent = 0
        self._is_stream = is_stream
        self._encoding = encoding
        self._framers: dict[Peer, Framer] = {}
        self._peers: dict[int, Peer] = {}
        self._outbox: list[tuple[bytes, Peer | None]] = []
        self._events: list[Event] = []
        self._sequence = 0
        self._heartbeat_at = -math.inf
        self._is_paused = False
        self._turns = Turns()

    def receive(self, data: bytes, peer: Peer, now: float) -> None:
        """Take a datagram, or a chunk of a stream. An empty chunk says that the peer's stream has ended."""
        self.bytes_received += len(data)
        key = peer if self._is_stream else None
        framer = self._framers.get(key)
        if framer is None:
            framer = self._framers[key] = Framer(HEARD, stream=self._is_stream)
            if len(self._framers) > MOST_PEERS:
                del self._framers[next(iter(self._framers))]
        frames = framer.receive(data)
        if not data:
            frames += framer.flush()
            self._framers.pop(key, None)
        for frame in frames:
            _, system, component, _, _, version = frame
            sender = (system, component)
            if sender == self.own or system == 0 or (message := decode(frame)) is None:
                continue
            self._peers[system] = peer
            if isinstance(message, ParamSet):
                self._receive_foreign_set(message, sender, now)
                continue
            machine = self.components.get(sender) or self._meet(sender, message)
            if machine is not None:
                machine.receive(message, now, version=version)
        if self._is_stream and not data:
            self._peers = {system: each for system, each in self._peers.items() if each != peer}

    def tick(self, now: float) -> None:
        """Do what is due: our heartbeat, and every component's time-outs."""
        if self._is_paused:
            return
        if self._heartbeat_at <= now:
            self._heartbeat_at = now + HEARTBEAT_INTERVAL
            beat = Heartbeat(MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID, system_status=MAV_STATE_ACTIVE)
            self._send(beat, None, 2)
        for machine in list(self.components.values()):
            if machine.next_deadline() <= now:
                machine.tick(now)
        self._turns.tick(now)

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity while the link is away."""
        if self._is_paused:
            return math.inf
        turns_at = self._turns.next_deadline()
        return min(
            [self._heartbeat_at, turns_at, *(machine.next_deadline() for machine in self.components.values())]
        )

    def data_to_send(self) -> list[tuple[bytes, Peer | None]]:
        """Frames to send, in order, each with the peer it is for; None is for all."""
        outbox, self._outbox = self._outbox, []
        return outbox

    def events(self) -> list[Event]:
        """What has happened since the last call."""
        events = self._events.copy()  # the components hold on to the list itself
        self._events.clear()
        return events

    def pause(self) -> None:
        """The link is away: time stands still for whatever waits."""
        self._is_paused = True
        self._outbox.clear()
        self._framers.clear()
        self._peers.clear()  # the link that comes back has others

    def resume(self, now: float) -> None:
        """The link is back: our heartbeat goes out, and whatever waits is asked for again."""
        self._is_paused = False
        self._heartbeat_at = now
        self._turns.resume(now)
        for machine in self.components.values():
            machine.resume(now)

    def fail_all(self, error: LinkError, now: float) -> None:
        """The link is gone for good: everyone who waits gets its error."""
        for machine in list(self.components.values()):
            machine.fail_all(error, now)

    def identity_of(self, machine: ComponentMachine) -> Identity | None:
        """Who the vehicle is that a component belongs to: its autopilot says. None while that is open."""
        autopilot = self.autopilot_of(machine.system) or machine
        return autopilot.identity if autopilot.who.settled else None

    def autopilot_of(self, system: int) -> ComponentMachine | None:
        """The component of a system that is its autopilot: the usual id first."""
        first = self.components.get((system, AUTOPILOT_COMPONENT))
        if first is not None and first.who.is_autopilot:
            return first
        for machine in self.components.values():
            if machine.system == system and machine.who.is_autopilot:
                return machine
        return None

    def begin_fetches(
        self, machines: Sequence[ComponentMachine], now: float, *, refresh: bool = False
    ) -> list[Fetch]:
        """Begin a fetch of several components of one system.

        When they are all that is known of it, none of them has a table worth going on with, none is being
        fetched, and no other list runs, the list is asked for once, of all components.
        """
        is_new = self._turns.is_free and all(machine.fetch is None for machine in machines)
        if (
            len(machines) > 1
            and is_new
            and (refresh or not any(m.can_hit or present_of(m.table, m.reads) for m in machines))
        ):
            system = machines[0].system
            known = [m for m in self.components.values() if m.system == system and m.who.has_parameters]
            if len(known) == len(machines):
                version = max(machine.version for machine in machines)
                self._send(ParamRequestList(system, COMP_ID_ALL), system, version)
                return [machine.begin_fetch(now, refresh=refresh, listed=True) for machine in machines]
        return [machine.begin_fetch(now, refresh=refresh) for machine in machines]

    def _meet(self, sender: Address, message: Message) -> ComponentMachine | None:
        """A component that was not heard before; only what shows that it has parameters makes it one."""
        if not isinstance(message, Heartbeat | ParamValue) or len(self.components) >= MOST_COMPONENTS:
            return None
        system, component = sender
        machine: ComponentMachine | None = None

        def send(message: Message) -> None:
            self._send(message, system, 2 if machine is None else machine.version)

        machine = ComponentMachine(
            system,
            component,
            own=self.own,
            link=self.link,
            send=send,
            emit=self._events.append,
            encoding=self._encoding,
            turns=self._turns,
        )
        self.components[sender] = machine
        self._events.append(ComponentHeard(machine))
        return machine

    def _receive_foreign_set(self, message: ParamSet, sender: Address, now: float) -> None:
        station = f"station {sender[0]}/{sender[1]}"
        for machine in self.components.values():
            is_target = message.target_component in (machine.component, COMP_ID_ALL)
            if is_target and message.target_system in (machine.system, 0):
                machine.foreign_set(message.param_id, station, now)

    def _send(self, message: Message, system: int | None, version: int) -> None:
        own_system, own_component = self.own
        data = encode(
            message, system=own_system, component=own_component, sequence=self._sequence, version=version
        )
        self._sequence = (self._sequence + 1) & 0xFF
        self.bytes_sent += len(data)
        self._outbox.append((data, None if system is None else self._peers.get(system)))
