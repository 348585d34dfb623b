"""The ground station's side of one link: its components, our heartbeat, and the routing of messages."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final

from paramclient.errors import LinkError, UsageError
from paramclient.model.identity import Identity
from paramclient.model.values import Encoding
from paramclient.protocol.addresses import Address, Peer, PeerAddress, peer_in_words
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.events import Event, EventMaker
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_result import Policy
from paramclient.protocol.params.list_download import present_of
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.params.table import NameQuota
from paramclient.protocol.requests.retry import HEARTBEAT_REQUESTS
from paramclient.protocol.scheduler import Scheduler
from paramclient.protocol.stats.trace import LazyMessageText, Trace, discard
from paramclient.protocol.stats.traffic import Traffic
from paramclient.protocol.vehicle.address_contest import NO_PEER
from paramclient.protocol.vehicle.boot_time_sampling import BootTimeSampling
from paramclient.protocol.vehicle.commands import message_requests
from paramclient.protocol.wire import (
    AUTOPILOT_COMPONENT,
    BOOT_CLOCK_OFFSETS,
    COMP_ID_ALL,
    COMP_ID_MISSIONPLANNER,
    HEARTBEAT_ID,
    MAV_AUTOPILOT_INVALID,
    MAV_STATE_ACTIVE,
    MAV_TYPE_GCS,
    PARAM_VALUE_ID,
    FileTransfer,
    Frame,
    Framer,
    Heartbeat,
    HighLatency2,
    Message,
    ParamExtRequestList,
    ParamExtRequestRead,
    ParamExtSet,
    ParamExtValue,
    ParamRequestList,
    ParamSetMessage,
    ParamValue,
    SetupSigning,
    Signer,
    SigningKey,
    Verifier,
    decode,
    decode_param_value,
    encode,
    sign_frame,
)

__all__ = ["Address", "Peer", "Station"]


HEARTBEAT_INTERVAL: Final = 1.0
"""Seconds between two heartbeats of ours, by the standard."""
NO_ADDRESS: Final = (0, 0)
"""Our own address where nothing is sent: a sender with our ids is then another station."""
COMPONENTS_MAX: Final = 1_000
"""Components followed on one link: more than 250 systems with a few each. Further ones replace a lost
component without parameters."""
REMOVAL_SEARCH_INTERVAL: Final = 0.5
"""Seconds between two searches for a component to forget, where there was none: each looks at all."""
STREAM_PEERS_MAX: Final = 256
"""Stream peers with an incomplete frame."""
SENDERS_MAX: Final = 32
"""Senders that are remembered while no autopilot has been heard, to name them to the user."""
HANDLED_IDS: Final = frozenset({0, 2, 22, 23, 77, 110, 148, 235, 253, 322, 323, 324, 345, 397})
"""The message ids that the core handles: HEARTBEAT, SYSTEM_TIME, PARAM_VALUE, PARAM_SET (of other stations),
COMMAND_ACK, FILE_TRANSFER_PROTOCOL, AUTOPILOT_VERSION, HIGH_LATENCY2, STATUSTEXT, PARAM_EXT_VALUE,
PARAM_EXT_SET (of other stations), PARAM_EXT_ACK, PARAM_ERROR, COMPONENT_METADATA."""
_SETS: Final = frozenset({23, 323})
_MAVLINK2_REQUESTS: Final = (ParamExtRequestRead, ParamExtRequestList, ParamExtSet)
"""Requests that exist in MAVLink 2 only: a component that has sent MAVLink 1 so far may understand them."""
_TELEMETRY_CLOCKS: Final = {
    number: at for number, at in BOOT_CLOCK_OFFSETS.items() if number not in HANDLED_IDS
}
"""The offset of `time_boot_ms` in messages that are read for nothing else."""


class Station:
    """Turns received bytes into tables and responses, and requests into bytes to send.

    Call `receive` with received bytes and `tick` at `next_deadline`, send what `data_to_send` returns, and
    handle `events`. After an operation of a component has begun or ended, `next_deadline` may be earlier.

    Args:
        link: the link's canonical name.
        is_stream: whether frames may be spread over several chunks.
        system, component: our address.
        encoding: of all components, by the user's choice; None: judged by the evidence.
        sync_settings: what is done for tables without a request of the user; by default nothing.
        split_peers: whether components with equal ids but different peers are different components.
        counts_traffic: whether all traffic of the link is counted, which takes time for each frame.
        trace: receives each step.

    Attributes:
        components: every known component, by (system, component); with `split_peers` by `PeerAddress`.
        senders: the senders of all frames before the first autopilot, at most `SENDERS_MAX`; empty if the
            client only listens or has a signing key.
        bytes_received, bytes_sent, frames_sent: on this link, by this station.
        traffic: the counts, or None without `counts_traffic`.
        policy: the requests that may be sent to bring tables up to date.
        listens_only: whether nothing is ever sent.
        listening_since: since when everything on the link is received, without an outage of the link or a
            suspend; infinity while the link is down.
        is_log: whether the link is a log, which ends: then timeouts do not apply, and no component is lost.
        is_over: whether nothing more is received, as at the end of a log.
        verifier: verifies signatures; None without a key: signatures are then ignored.
        scheduler: handles the components that are due.
    """

    def __init__(
        self,
        *,
        link: str,
        is_stream: bool,
        system: int = 255,
        component: int = 190,
        encoding: Encoding | None = None,
        sync_settings: SyncSettings | None = None,
        split_peers: bool = False,
        counts_traffic: bool = False,
        trace: Trace = discard,
    ) -> None:
        self.traffic = Traffic(is_stream=is_stream) if counts_traffic else None
        self.link = link
        self.listens_only = sync_settings is not None and sync_settings.listens_only
        self.is_log = sync_settings is not None and sync_settings.is_log
        self.is_over = False
        self.listening_since = -math.inf
        self.own_address: Address = NO_ADDRESS if self.listens_only else (system, component)
        self.components: dict[Address, ComponentMachine] = {}
        self.senders: set[Address] = set()
        self.bytes_received = 0
        self.bytes_sent = self.frames_sent = 0
        self._trace = trace
        self._frames = self._skipped = self._damaged = 0  # of removed framers
        self._is_stream = is_stream
        self._encoding = encoding
        self.policy = Policy.AUTO if sync_settings is None else sync_settings.policy
        self._sync_settings = sync_settings
        # for datagrams of all peers
        self._framer = Framer(HANDLED_IDS, occasional=_TELEMETRY_CLOCKS, stream=False)
        self._clock_sampling = BootTimeSampling(self._take_clocks)
        self._framers: dict[Peer, Framer] = {}  # for streams
        self._outbox: list[tuple[bytes, Peer | None]] = []
        self._events: list[Event] = []
        self._reporter = EventMaker(self._events.append)
        self._sequence = 0
        self._signer: Signer | None = None
        self._needs_raw_data = counts_traffic  # one check in the hot path for both
        self.verifier: Verifier | None = None
        self._heartbeat_at = math.inf if self.listens_only else -math.inf
        self._is_paused = False
        self.scheduler = Scheduler()
        self._splits_peers = split_peers
        self._by_vehicle: dict[tuple[int, Peer], list[ComponentMachine]] = {}
        self._name_quota = NameQuota()
        self._full_until = -math.inf
        self._awaits_autopilot = not self.listens_only  # none was received yet
        self._heartbeat_requested_at = -math.inf
        self._heartbeat_requests = 0
        self._ignored_messages = 0  # of forgotten components
        self._looks_for_others = 0  # callers of `looking_for_others`

    def begin_signing(self, signer: Signer, verifier: Verifier) -> None:
        """Sign what is sent and accept what the verifier accepts from now on; call it before `receive`."""
        self._signer = signer
        self._needs_raw_data = True
        self.verifier = verifier
        self._framer.guard = verifier.accepts
        self._awaits_autopilot = False  # would verify each signature twice

    def send_setup_signing(
        self, system: int, component: int, key: SigningKey | None, timestamp: int, *, peer: Peer = None
    ) -> None:
        """Give a vehicle its signing key, in clear, or with None disable signing. There is no
        acknowledgement.

        `peer` is the vehicle's peer, with `split_peers`; otherwise None.
        """
        self._send(SetupSigning(system, component, key, timestamp), self._key(system, component, peer), 2)

    def receive(self, data: bytes, peer: Peer, now: float, moment: float | None = None) -> bool:
        """Process a datagram, or a chunk of a stream. An empty chunk means the end of the peer's stream.

        Return whether it contained anything except telemetry.

        Args:
            data, peer: the bytes, and their sender.
            now: the time.
            moment: when they arrived from the link, if earlier; None for `now`.
        """
        self.bytes_received += len(data)
        if self._needs_raw_data:
            self._before_decoding(data, peer, now)
        frames = self._cut_stream(data, peer) if self._is_stream else self._framer.receive(data)
        clocks = 0
        for frame in frames:
            number, system, component, _, payload, version = frame
            address = PeerAddress(system, component, peer) if self._splits_peers else (system, component)
            machine = self.components.get(address)
            if number == PARAM_VALUE_ID and component == COMP_ID_MISSIONPLANNER and self._is_made_up(machine):
                continue
            if number == PARAM_VALUE_ID and machine is not None:  # fast path for the most frequent message
                peers = machine.peers
                if peer == peers.speaker:
                    peers.received_at = now
                elif not self._accepts(machine, peer, now):
                    continue
                machine.receive_value(decode_param_value(payload), now, version, moment)
            elif number in _TELEMETRY_CLOCKS:
                clocks += 1
                if machine is not None and self._clock_sampling.is_open(address):
                    self._receive_clock(machine, number, payload, peer, now)
            else:
                self._receive_other(frame, peer, now, moment)
        if self._is_stream and not data:
            for machine in self.components.values():
                machine.peers.left(peer, now)
        is_seeking = self._awaits_autopilot or (self._looks_for_others and self.verifier is None)
        if is_seeking and self._request_heartbeat(data, peer, now):
            return True
        return len(frames) > clocks

    @contextmanager
    def looking_for_others(self) -> Iterator[None]:
        """Request the heartbeats of vehicles that send other messages only, for the time of the block.

        A vehicle that sends telemetry is thus found although its heartbeat was lost.
        """
        self._looks_for_others += 1
        try:
            yield
        finally:
            self._looks_for_others -= 1

    def overhear(self, data: bytes, now: float) -> None:
        """Process a frame that another program sends to the vehicles over this link: it may be a
        PARAM_SET or a PARAM_EXT_SET."""
        for frame in Framer(_SETS, stream=False).receive(data):
            message = decode(frame)
            if isinstance(message, ParamSetMessage | ParamExtSet):
                self._receive_foreign_set(message, (frame.system, frame.component), now)

    def tick(self, now: float) -> None:
        """Do what is due: our heartbeat, and the timeouts of components. In a log nothing is due."""
        if self.is_log or self._is_paused:
            return
        if self._signer is not None:
            self._signer.advance(now)
        if self._heartbeat_at <= now:
            self._heartbeat_at = now + HEARTBEAT_INTERVAL
            beat = Heartbeat(MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID, system_status=MAV_STATE_ACTIVE)
            self._transmit(beat, None, 2)
        self.scheduler.tick(now)
        if self.traffic is not None:
            self.traffic.sent(self.bytes_sent, now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity while the link is down, and in a log."""
        if self._is_paused or self.is_log:
            return math.inf
        return min(self._heartbeat_at, self.scheduler.next_deadline())

    def data_to_send(self) -> list[tuple[bytes, Peer | None]]:
        """Return the frames to send, in order, each with its peer; None means all."""
        outbox, self._outbox = self._outbox, []
        return outbox

    def events(self) -> list[Event]:
        """Return the events since the last call."""
        events = self._events.copy()  # the components hold a reference to the list
        self._events.clear()
        return events

    def pause(self) -> None:
        """Stop all timeouts: the link is down."""
        self._is_paused = True
        self.listening_since = math.inf
        self._outbox.clear()
        for peer in list(self._framers):
            self._retire(peer)
        if self.traffic is not None:
            self.traffic.pause()
        for machine in self.components.values():
            machine.peers.forget()

    def resume(self, now: float) -> None:
        """Send our heartbeat and repeat all requests in flight: the link is back."""
        self._is_paused = False
        self.listening_since = now
        if not self.listens_only:
            self._heartbeat_at = now
        self.scheduler.list_admission.resume(now)
        for machine in self.components.values():
            machine.resume(now)

    def handle_suspend(self, unseen: float, now: float) -> None:
        """Process a time in which this program did not run, as in a system suspend: silence then means
        nothing.

        If it was as long as the heartbeat timeout, every component is identified again, as after an outage of
        the link. Requests in flight are repeated.

        Args:
            unseen: seconds of it that are missing in `now`.
            now: the time.
        """
        for machine in self.components.values():
            machine.presence.age(unseen)
            machine.peers.age(unseen)
            machine.table.age(unseen)
            machine.ext.table.age(unseen)
        if not self._is_paused:
            self._outbox.clear()  # meant for the components before it
            self.resume(now)

    def over(self, now: float) -> None:
        """End all waits with what was received: nothing more is received."""
        self.is_over = True
        for machine in self.components.values():
            machine.fetches.over(now)

    @property
    def framing(self) -> tuple[int, int, int]:
        """Received frames, bytes outside of frames, and damaged frames among these."""
        framers = [self._framer, *self._framers.values()]
        return (
            self._frames + sum(framer.frames for framer in framers),
            self._skipped + sum(framer.skipped for framer in framers),
            self._damaged + sum(framer.damaged for framer in framers),
        )

    @property
    def foreign(self) -> int:
        """Messages that were ignored because their peer may be another vehicle."""
        return self._ignored_messages + sum(
            machine.peers.ignored_messages for machine in self.components.values()
        )

    @property
    def is_waiting(self) -> bool:
        """Whether any component waits for anything."""
        return self.scheduler.is_waiting

    def fail_all(self, error: LinkError, now: float) -> None:
        """End all operations with the error: the link has ended."""
        for machine in list(self.components.values()):
            machine.fail_all(error, now)

    def identity_of(self, machine: ComponentMachine) -> Identity | None:
        """Return the identity of a component's vehicle, which its autopilot has sent; None while it is
        open."""
        autopilot = self.autopilot_of(*machine.vehicle) or machine
        return autopilot.identity if autopilot.identification.settled else None

    def is_doubted(self, machine: ComponentMachine) -> bool:
        """Return whether it is in doubt which vehicle a component belongs to.

        Its autopilot is lost, or was lost and is not identified since; or several vehicles seem to use the
        address of either.
        """
        autopilot = self.autopilot_of(*machine.vehicle) or machine
        if autopilot.peers.is_unclear or machine.peers.is_unclear:
            return True
        if autopilot is not machine and autopilot.peers.is_rival(machine.peers.home):
            return True
        is_lost = autopilot is not machine and autopilot.presence.is_lost
        return is_lost or autopilot.context.may_be_another

    def autopilot_of(self, system: int, peer: Peer = None) -> ComponentMachine | None:
        """Return the component of a system that is its autopilot: the usual id first.

        Args:
            system: the system.
            peer: its peer, with `split_peers`; otherwise None.
        """
        first = self.components.get(self._key(system, AUTOPILOT_COMPONENT, peer))
        if first is not None and first.identification.is_autopilot:
            return first
        for machine in self._by_vehicle.get((system, peer), ()):
            if machine.identification.is_autopilot:
                return machine
        return None

    def at_peer(self, peer: str | None) -> list[ComponentMachine]:
        """Return the components of a peer, by its address or the host alone; None for all."""
        machines = list(self.components.values())
        if peer is None:
            return machines
        by_peer = [(each, each.peer_in_words) for each in machines]
        return [each for each, words in by_peer if peer in (words, words.rpartition(":")[0])]

    def find(
        self, system: int | None, component: int | None, peer: str | None = None
    ) -> ComponentMachine | None:
        """Return the first component that an address fits; without a component id, an autopilot."""
        for machine in self.at_peer(peer):
            if system not in (None, machine.system):
                continue
            if component is None and machine.identification.is_autopilot:
                return self.autopilot_of(*machine.vehicle) or machine
            if component == machine.component and machine.identification.has_response:
                return machine
        return None

    def check_refresh(self, refresh: bool) -> None:
        """Check that a fetch may download what is cached.

        Raises:
            UsageError: the policy forbids it, or nothing is sent at all.
        """
        if refresh and self.listens_only:
            raise UsageError("refresh needs a download, and the client only listens")
        if refresh and self.policy is not Policy.AUTO:
            raise UsageError(f"the policy is {self.policy}: nothing may be downloaded, so not with refresh")

    def begin_fetches(
        self, machines: Sequence[ComponentMachine], now: float, *, refresh: bool = False
    ) -> list[Fetch]:
        """Begin a fetch of several components of one system.

        The list is requested once for all components if they are all known ones of the system, none of them
        has a table worth resuming, a fetch in progress or a file to serve, and no other list runs.
        """
        is_new = self.scheduler.list_admission.is_free and not any(
            machine.fetch is not None for machine in machines
        )
        may_list = self.policy is Policy.AUTO
        is_fresh = refresh or not any(m.can_hit or present_of(m.table, m.reads) for m in machines)
        has_file = any(machine.fetches.may_use_file() for machine in machines)
        if len(machines) > 1 and may_list and is_new and is_fresh and not has_file:
            system = machines[0].system
            known = [
                each for each in self._by_vehicle[machines[0].vehicle] if each.identification.has_parameters
            ]
            have_one_peer = len({machine.peers.home for machine in machines}) == 1
            if len(known) == len(machines) and have_one_peer:
                for machine in machines:
                    machine.check_uncontested()
                version = max(machine.version for machine in machines)
                self._send(ParamRequestList(system, COMP_ID_ALL), machines[0].address, version)
                return [machine.begin_fetch(now, refresh=refresh, listed=True) for machine in machines]
        return [machine.begin_fetch(now, refresh=refresh) for machine in machines]

    def _before_decoding(self, data: bytes, peer: Peer, now: float) -> None:
        """Pass received bytes to traffic counts and the search for heartbeats, before they are decoded."""
        if self._signer is not None:
            self._signer.advance(now)
        if self.traffic is not None:
            self.traffic.receive(data, peer, now)

    def _cut_stream(self, data: bytes, peer: Peer) -> list[Frame]:
        """Return the frames that a chunk of a peer's stream completes, or that its end leaves."""
        framer = self._framers.get(peer)
        if framer is None:
            framer = self._framers[peer] = Framer(HANDLED_IDS, occasional=_TELEMETRY_CLOCKS)
            framer.guard = self._framer.guard
            framer.takes_occasional = self._framer.takes_occasional
            if len(self._framers) > STREAM_PEERS_MAX:
                self._retire(next(iter(self._framers)))
        if data:
            return framer.receive(data)
        frames = framer.flush()
        self._retire(peer)
        return frames

    def _request_heartbeat(self, data: bytes, peer: Peer, now: float) -> bool:
        """Request the heartbeat of an autopilot that sends other messages; return whether one was found.

        A heartbeat is due once a second; MAV_CMD_REQUEST_MESSAGE brings it in one round trip (measured on PX4
        and ArduPilot). This is done until the first autopilot is found, and while others are searched:
        otherwise the regular heartbeats are enough.
        """
        if self._is_paused or now < self._heartbeat_requested_at + HEARTBEAT_REQUESTS.later:
            return False
        for frame in Framer(stream=False).receive(data):
            address = (frame.system, frame.component)
            if len(self.senders) < SENDERS_MAX:
                self.senders.add(address)
            is_autopilot = frame.component == AUTOPILOT_COMPONENT and frame.system != 0
            known = self.components.get(self._key(*address, peer))
            if is_autopilot and address != self.own_address and not (known and known.presence.has_beaten):
                self._heartbeat_requested_at = now
                if self._awaits_autopilot:
                    self._heartbeat_requests += 1
                    self._awaits_autopilot = self._heartbeat_requests < HEARTBEAT_REQUESTS.count
                for message in message_requests(address, HEARTBEAT_ID):
                    self._transmit(message, peer, frame.version)
                return True
        return False

    def _retire(self, peer: Peer) -> None:
        """Remove the framer of a peer, and keep its counts."""
        framer = self._framers.pop(peer)
        self._frames += framer.frames
        self._skipped += framer.skipped
        self._damaged += framer.damaged

    def _is_made_up(self, machine: ComponentMachine | None) -> bool:
        """Return whether a PARAM_VALUE of component 190 is from no component that has parameters.

        After MAVProxy has read a parameter file, it writes a PARAM_VALUE of each parameter into its log, with
        the vehicle's system id, component 190 and the type REAL32 (measured with 1.8.75). Nothing sends
        heartbeats from that address, unless a ground station has the vehicle's system id. On a link with
        requests, parameters sent by a ground station are accepted.

        Args:
            machine: the component with the address, or None where none is known.
        """
        return machine is None or (self.listens_only and not machine.identification.has_parameters)

    def _receive_other(self, frame: Frame, peer: Peer, now: float, moment: float | None) -> None:
        """Process a frame that is not a value of a known component."""
        sender = (frame.system, frame.component)
        if sender == self.own_address or frame.system == 0 or (message := decode(frame)) is None:
            return
        if isinstance(message, Heartbeat | HighLatency2) and message.autopilot != MAV_AUTOPILOT_INVALID:
            self._awaits_autopilot = False
        if isinstance(message, ParamSetMessage | ParamExtSet):
            self._receive_foreign_set(message, sender, now)
            return
        if isinstance(message, FileTransfer):
            self._receive_foreign_file_request(message, sender, now)
        address = self._key(*sender, peer)
        machine = self.components.get(address) or self._add_component(sender, peer, message, now)
        if machine is None:
            return
        if not machine.identification.has_parameters:
            machine.peers.follow(peer)
        elif not machine.peers.accepts_identifying(message, peer, now):
            if machine.peers.contest is not None and peer == machine.peers.home:
                machine.receive_contested(message, now, version=frame.version)
                if isinstance(message, Heartbeat):
                    self._clock_sampling.open(address, now)  # clocks may distinguish the peers
            return
        machine.receive(message, now, version=frame.version, moment=moment, sequence=frame.sequence)
        if isinstance(message, Heartbeat):
            self._clock_sampling.open(address, now)

    def _receive_clock(
        self, machine: ComponentMachine, number: int, payload: bytes, peer: Peer, now: float
    ) -> None:
        """Process the time since boot in a telemetry frame. Trailing zeros may be cut off."""
        at = _TELEMETRY_CLOCKS[number]
        boot_ms = int.from_bytes(payload[at : at + 4], "little")
        if machine.identification.has_parameters and not machine.peers.accepts_clock(
            number, boot_ms, peer, now
        ):
            return
        machine.boot_clock(number, boot_ms, now)
        if machine.reboots.current is None and not machine.peers.wants_clocks:
            self._clock_sampling.sampled(machine.address, now)

    def _take_clocks(self, takes: bool) -> None:
        for framer in (self._framer, *self._framers.values()):
            framer.takes_occasional = takes

    def _key(self, system: int, component: int, peer: Peer) -> Address:
        return PeerAddress(system, component, peer) if self._splits_peers else (system, component)

    def _add_component(
        self, sender: Address, peer: Peer, message: Message, now: float
    ) -> ComponentMachine | None:
        """Add a component on its first message; only messages that show parameters make one."""
        is_sign = isinstance(message, Heartbeat | HighLatency2 | ParamValue | ParamExtValue)
        if not is_sign or not self._has_capacity(now):
            return None
        system, component = sender
        address = self._key(system, component, peer)
        vehicle = (system, peer if self._splits_peers else None)
        machine: ComponentMachine | None = None

        def send(message: Message) -> None:
            self._send(message, address, 2 if machine is None else machine.version)

        def send_to(message: Message, peer: Peer) -> None:
            self._transmit(message, peer, 2 if machine is None else machine.version)

        machine = ComponentMachine(
            system,
            component,
            own_address=self.own_address,
            link=f"{self.link}#{peer_in_words(peer)}" if self._splits_peers else self.link,
            send=send,
            observer=self._reporter,
            send_to=send_to,
            encoding=self._encoding,
            sync_settings=self._sync_settings,
            companions=self._by_vehicle.setdefault(vehicle, []),
            read_clock=lambda now: self._clock_sampling.open(address, now),
            peer=peer if self._splits_peers else None,
            scheduler=self.scheduler,
            name_quota=self._name_quota,
            trace=self._trace,
        )
        self.components[address] = machine
        self.scheduler.add(machine)
        self._reporter.discovered(machine)
        return machine

    def _has_capacity(self, now: float) -> bool:
        """Return whether one more component can be followed.

        At the limit, the first lost component without parameters and waiting requests is removed: a sender of
        heartbeats with many addresses must not keep out later components.
        """
        if len(self.components) < COMPONENTS_MAX:
            return True
        if now < self._full_until:
            return False
        for machine in self.components.values():
            if machine.presence.is_lost and not machine.table.params and not machine.is_waiting:
                self._forget(machine)
                return True
        self._full_until = now + REMOVAL_SEARCH_INTERVAL
        return False

    def _forget(self, machine: ComponentMachine) -> None:
        """Remove a component and its records: another one may take its address."""
        address = machine.address
        del self.components[address]
        self._by_vehicle[machine.vehicle].remove(machine)
        if not self._by_vehicle[machine.vehicle]:
            del self._by_vehicle[machine.vehicle]
        self._clock_sampling.close(address)
        self.scheduler.remove(machine)
        machine.reads.pace.idle()
        self._ignored_messages += machine.peers.ignored_messages
        self._reporter.forgotten(machine)

    def _receive_foreign_set(
        self, message: ParamSetMessage | ParamExtSet, sender: Address, now: float
    ) -> None:
        station = f"station {sender[0]}/{sender[1]}"
        for machine in self.components.values():
            is_target = message.target_component in (machine.component, COMP_ID_ALL)
            if not is_target or message.target_system not in (machine.system, 0):
                continue
            if isinstance(message, ParamExtSet):
                machine.foreign_ext_set(message.param_id, station, now)
            else:
                machine.foreign_set(message.param_id, message.raw, station, now)

    def _receive_foreign_file_request(self, message: FileTransfer, sender: Address, now: float) -> None:
        """Process a MAVFTP request of another station."""
        target = (message.target_system, message.target_component)
        machines = (
            self.components.values() if self._splits_peers else self._by_vehicle.get((target[0], None), ())
        )
        for machine in machines:
            if machine.system == target[0] and message.target_component in (machine.component, COMP_ID_ALL):
                machine.files.foreign_at = now

    def _accepts(self, machine: ComponentMachine, peer: Peer, now: float) -> bool:
        """Return whether to accept a message that cannot distinguish vehicles."""
        if not machine.identification.has_parameters:
            machine.peers.follow(peer)
            return True
        return machine.peers.accepts(peer, now)

    def _peer_of(self, address: Address) -> Peer | None:
        """Return the peer of a component, else of its autopilot, else any of the system; None for all.

        NO_PEER after the end of the component's connection: another peer would be another vehicle.
        """
        if isinstance(address, PeerAddress):
            return address.peer
        vehicle = (address[0], None)
        own, autopilot = self.components.get(address), self.autopilot_of(*vehicle)
        if own is not None and own.peers.has_left:
            return NO_PEER
        machines = [each for each in (own, autopilot, *self._by_vehicle.get(vehicle, ())) if each is not None]
        return next((each.peers.home for each in machines if each.peers.home is not NO_PEER), None)

    def _send(self, message: Message, address: Address, version: int) -> None:
        peer = self._peer_of(address)
        if not self.listens_only and peer is not NO_PEER:
            self._trace("to system %s: %s", address[0], LazyMessageText(message))
            self._transmit(message, peer, version)

    def _transmit(self, message: Message, peer: Peer | None, version: int) -> None:
        """Queue a message for a peer, or with None for all."""
        if self.listens_only:
            return
        own_system, own_component = self.own_address
        if isinstance(message, _MAVLINK2_REQUESTS):
            version = 2
        data = encode(
            message, system=own_system, component=own_component, sequence=self._sequence, version=version
        )
        if self._signer is not None:
            data = sign_frame(data, self._signer)
        self._sequence = (self._sequence + 1) & 0xFF
        self.bytes_sent += len(data)
        self.frames_sent += 1
        self._outbox.append((data, peer))
