"""One component: its identity, presence and table, and the machines that exchange messages with it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final, Protocol

from paramclient.errors import NoReply, ParamClientError, UsageError
from paramclient.model.ext_params import ExtValue, encode_ext_value
from paramclient.model.group_switches import is_group_switch
from paramclient.model.identity import Identity, autopilot_name, reason_against_non_finite
from paramclient.model.params import unpack_fields
from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    Trust,
    WireValue,
    as_reported,
    encode_value,
    is_portable_name,
)
from paramclient.protocol.addresses import Address, Peer, PeerAddress, peer_in_words
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.ext.extended import ExtendedParams
from paramclient.protocol.ext.fetch import ExtFetch
from paramclient.protocol.ext.reads import ExtRead
from paramclient.protocol.ext.write_batch import ExtWriteBatch
from paramclient.protocol.ext.writes import ExtWrite
from paramclient.protocol.ftp import FileTransfers
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch import Check, Fetch
from paramclient.protocol.params.fetch_queue import Fetches
from paramclient.protocol.params.fetch_result import FetchContext, FetchResult, Policy
from paramclient.protocol.params.reads import Key, Read, Reads
from paramclient.protocol.params.sync import ComponentState, Sync, SyncSettings, SyncState
from paramclient.protocol.params.table import NameQuota, Table
from paramclient.protocol.params.value_check import Rereads
from paramclient.protocol.params.volatile_values import VolatileReads
from paramclient.protocol.params.write_batch import BatchRules, WriteBatch, WriteBatches
from paramclient.protocol.params.writes import Write, Writes
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.scheduler import Scheduler
from paramclient.protocol.stats.trace import Trace, discard
from paramclient.protocol.vehicle.address_contest import NO_PEER, ComponentPeers, Contest
from paramclient.protocol.vehicle.boot_time_requests import BootTimeRequests
from paramclient.protocol.vehicle.commands import Commands, MessageRequests
from paramclient.protocol.vehicle.extended_kinds import expects_extended
from paramclient.protocol.vehicle.identification import Identification
from paramclient.protocol.vehicle.metadata_request import MetadataRequests
from paramclient.protocol.vehicle.peer_claims import Claim, PeerRelation
from paramclient.protocol.vehicle.presence import Presence
from paramclient.protocol.vehicle.reboot_command import Reboot, Reboots
from paramclient.protocol.wire import (
    HASH_CHECK,
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_PX4,
    NO_INDEX,
    PARAMETERS_MAX,
    AutopilotVersion,
    CommandAck,
    ComponentMetadata,
    FileTransfer,
    Heartbeat,
    HighLatency2,
    Message,
    ParamError,
    ParamExtAck,
    ParamExtValue,
    ParamValue,
    StatusText,
    SystemTime,
)

__all__ = ["ComponentMachine", "ComponentObserver"]

NUMBERING_SILENCE: Final = 0.25
"""Seconds of silence before a new frame numbering, after which a fetch restarts: an ArduPilot that reboots is
silent for at least that long (measured: 0.31 s with a station that talks to it, otherwise 1.0 s)."""
IDENTITY_VALID_TIME: Final = 1.0
"""Seconds for which an AUTOPILOT_VERSION is not requested again."""


class ComponentObserver(Protocol):
    """Receives what happens to components. `paramclient.protocol.events` makes events of it."""

    def identified(self, machine: ComponentMachine) -> None:
        """The identity is as complete as it gets; the cached table can be looked up."""

    def lost(self, machine: ComponentMachine, silence: float) -> None:
        """The heartbeat timeout has expired; `silence` is the time since the last message in s."""

    def found(self, machine: ComponentMachine, silence: float) -> None:
        """Messages of a lost component are received again, after `silence` s."""

    def rebooted(self, machine: ComponentMachine) -> None:
        """The vehicle has rebooted."""

    def replaced(self, machine: ComponentMachine) -> None:
        """Another vehicle uses the address: everything known is invalid."""

    def contested(self, machine: ComponentMachine, contest: Contest) -> None:
        """Several vehicles use the address: their messages are ignored and nothing is requested of them."""

    def uncontested(self, machine: ComponentMachine) -> None:
        """Only one vehicle uses the address again, or the peers are proven to be one vehicle."""

    def changed(self, machine: ComponentMachine, change: Change) -> None:
        """A parameter appeared, changed or was removed; called for each change with `reports_each_change`."""

    def ext_changed(self, machine: ComponentMachine, change: ExtChange) -> None:
        """An extended parameter appeared, changed or was removed."""

    def params_changed(self, machine: ComponentMachine) -> None:
        """Parameters have changed; called once for several changes without `reports_each_change`."""

    def fetched(self, machine: ComponentMachine, result: FetchResult) -> None:
        """A fetch has ended with a result."""

    def resynced(self, machine: ComponentMachine, changed: tuple[str, ...], confirmed: int | None) -> None:
        """The table matches the vehicle's again; see `TableResynced`."""


class ComponentMachine:
    """The sans-I/O state of one component.

    Args:
        system, component: its address.
        own_address: system and component that requests are sent as.
        link: the link's canonical name, part of an identity without a hardware id.
        send: takes each message for the component, in order.
        observer: receives what happens to the component.
        send_to: takes each message for one of its peers; None where there is only one.
        encoding: the user's choice of its encoding, or None.
        sync_settings: what is done for its table without a request of the user.
        companions: the components of its vehicle, to which it adds itself; None for a vehicle with one.
        read_clock: enables `boot_clock` calls with clocks from its telemetry for a while; see
            `BootTimeSampling`.
        peer: its peer, where components are distinguished by peer; otherwise None.
        scheduler: the scheduler of the link; None for a link with one component.
        name_quota: the name count shared by the tables of the link; None likewise.
        trace: receives each step.

    Attributes:
        address: system and component, with `peer` also the peer.
        vehicle: the address part that all components of a vehicle share: the system, with `peer` also the
            peer.
        version: the MAVLink version of its frames.
        context: the facts about it that its machines share.
        identification: its identity and encoding.
        table: its parameters.
        retry: when its requests count as lost.
        round_trip: round-trip time and loss of its responses.
        presence: whether its messages are received.
        peers: the peers that send with its address, and whether several vehicles do.
        sync: whether the table still matches the vehicle's.
        files: its files over MAVFTP.
        metadata_requests: the location of its metadata.
        commands: its commands.
        messages: the messages that are requested from it.
        boot_time_requests: the requests for its time since boot.
        ext: its extended parameters.
        reboots: its reboot on command.
        rereads: the values to be read again.
        fetches: the fetches of its table.
        reports_each_change: whether the observer is called for each change. An event for each value of a list
            takes a tenth of the time of the value itself, and the garbage collector visits all waiting
            events.
        has_changed: whether an unhandled event reports changes; the consumer of events resets it.
    """

    def __init__(
        self,
        system: int,
        component: int,
        *,
        own_address: tuple[int, int],
        link: str,
        send: Callable[[Message], None],
        observer: ComponentObserver,
        send_to: Callable[[Message, Peer], None] | None = None,
        encoding: Encoding | None = None,
        sync_settings: SyncSettings | None = None,
        companions: list[ComponentMachine] | None = None,
        read_clock: Callable[[float], None] = lambda now: None,
        peer: Peer | None = None,
        scheduler: Scheduler | None = None,
        name_quota: NameQuota | None = None,
        trace: Trace = discard,
    ) -> None:
        target = (system, component)
        sync_settings = sync_settings or SyncSettings()
        self.system = system
        self.component = component
        self.address: Address = target if peer is None else PeerAddress(system, component, peer)
        self.vehicle: tuple[int, Peer] = (system, peer)
        self.version = 1
        scheduler = Scheduler() if scheduler is None else scheduler
        self._scheduler = scheduler
        self.reschedule = scheduler.reporter(self)
        context = Context(
            *(target, self._send, own_address),
            trace=trace,
            may_send=not sync_settings.listens_only,
            reschedule=self.reschedule,
        )
        self.context = context
        self.retry = context.retry
        self.round_trip = context.round_trip
        self.messages = MessageRequests(context)
        self.identification = Identification(context, self.messages, link, encoding)
        self.table = Table(self.identification.encoding, name_quota)
        self.reads = Reads(context, self.table, scheduler.list_admission.bandwidth)
        self.writes = Writes(context, self.reads, self.table, permission=self)
        self.write_batches = WriteBatches(target, "PARAM_SET")
        self.presence = Presence()
        self.peers = ComponentPeers(target, self, may_ask=context.may_send)
        self.files = FileTransfers(context)
        self.sync = Sync(
            context,
            self.reads,
            self.table,
            sync_settings,
            self.presence,
            self.files,
            host=self,
        )
        self.metadata_requests = MetadataRequests(context, self.messages)
        self.commands = Commands(context)
        self.boot_time_requests = BootTimeRequests(context, self.messages, self.presence)
        self.reboots = Reboots(
            context,
            self.commands,
            self.identification,
            self.presence,
            self.boot_time_requests,
            self._reboot_noticed,
        )
        fetch_context = FetchContext(
            context,
            self.reads,
            self.table,
            scheduler.list_admission,
            self.files,
            changed=self._fetch_changed,
            doubt=self._doubt_identity,
        )
        self.fetches = Fetches(fetch_context, self.sync, sync_settings, ended=self._fetched)
        # without requests there are no reads: the lists of other stations take their place
        passive_table = self.fetches.passive_table
        self._receive_read = self.reads.receive if passive_table is None else passive_table.receive
        self._own_address = own_address
        self._observer = observer
        self._transmit = send
        self._send_to = send_to or (lambda message, peer: send(message))
        self._fetch_policy = sync_settings.policy
        self._listens_only = sync_settings.listens_only
        self._read_clock = read_clock
        self._companions: list[ComponentMachine] = [] if companions is None else companions
        self._companions.append(self)
        self._known_as: str | None = None  # the key of the reported identity
        self.reports_each_change = True
        self.has_changed = False
        self.rereads = Rereads(context, self.reads, self.table, self.sync, sync_settings.policy)
        self.ext = ExtendedParams(
            context,
            self,
            share=scheduler.list_admission.bandwidth,
            name_quota=name_quota,
            may_read=sync_settings.policy is Policy.AUTO,
        )
        self._authors = self.rereads.authors
        self._checks = self.rereads.checks
        self.writes.on_outcome_unknown = self._authors.foreign_set
        self._machines: tuple[Machine, ...] = (
            *(self.reads, self.sync, self.writes, self.files, self.commands),
            *(self.reboots, self.fetches, self.messages, self.identification, self.metadata_requests),
            *(self.boot_time_requests, self.rereads, self.ext, self.write_batches),
        )
        """Each machine stands behind those that it uses or calls. They end in reverse order: a machine does
        not take the end of another one for a result, and is not called after its own end."""

    @property
    def peer_in_words(self) -> str:
        """The peer of its messages, `127.0.0.1:14550`; "" while unknown."""
        if isinstance(self.address, PeerAddress):
            return peer_in_words(self.address.peer)
        return "" if self.peers.home is NO_PEER else peer_in_words(self.peers.home)

    def address_in(self, system: int) -> Address:
        """Return its address under another system id."""
        if isinstance(self.address, PeerAddress):
            return PeerAddress(system, self.component, self.address.peer)
        return system, self.component

    @property
    def identity(self) -> Identity:
        """The identity of the vehicle, as far as this component has sent it."""
        return self.identification.identity

    @property
    def may_be_written(self) -> bool:
        """Whether it is certain which vehicle receives a write, and in which encoding."""
        return self.identification.is_certain and self.is_recipient_certain

    @property
    def is_recipient_certain(self) -> bool:
        """Whether it is certain which vehicle receives a write."""
        home = self.peers.home
        is_open = any(
            each.context.may_be_another or each.peers.is_rival(home) or each.peers.is_home_unproven
            for each in self._autopilots()
        )
        return not (self.context.may_be_another or self.peers.is_home_unproven or is_open)

    @property
    def expects_extended(self) -> bool:
        """Whether it speaks the extended parameter protocol: it has done so, or is a kind of component that
        does."""
        return self.ext.is_spoken or expects_extended(self.identification.vehicle_type, self.component)

    @property
    def may_use_file(self) -> bool:
        """Whether the table is worth requesting as a file."""
        return self.fetches.may_use_file()

    @property
    def is_link_busy(self) -> bool:
        """Whether any request is in flight on the link."""
        return self._scheduler.is_busy

    @property
    def state(self) -> ComponentState:
        """The state of the table: new, cached, fetching, synced, partial, contested, lost."""
        if self.presence.is_lost:
            return ComponentState.LOST
        if self.peers.contest is not None:
            return ComponentState.CONTESTED
        if self.fetch is not None:
            return ComponentState.FETCHING
        if self.sync.synced:
            return ComponentState.SYNCED
        if not self.table.params:
            return ComponentState.NEW
        return ComponentState.CACHED if self.table.complete else ComponentState.PARTIAL

    def _autopilots(self) -> Iterator[ComponentMachine]:
        """Yield the autopilot of its vehicle, where that is another component."""
        return (each for each in self._companions if each is not self and each.identification.is_autopilot)

    @property
    def is_rebooting(self) -> bool:
        """Whether a reboot on command is in progress."""
        return self.reboots.is_in_progress

    @property
    def is_identified(self) -> bool:
        """Whether its identity is settled and not being requested."""
        return self.identification.settled and not self.identification.is_asking

    def read_clock(self, now: float) -> None:
        """Have clocks in its telemetry read for a while."""
        self._read_clock(now)

    def _send(self, message: Message) -> None:
        """Send a message to the component: its response has a deadline."""
        self.reschedule()
        self._transmit(message)

    def send_to(self, message: Message, peer: Peer) -> None:
        """Send a message to one of its peers."""
        self._send_to(message, peer)

    @property
    def fetch(self) -> Fetch | None:
        """The fetch in progress, or None."""
        return self.fetches.current

    @property
    def sync_state(self) -> SyncState:
        """The relation of the table to the vehicle's."""
        return SyncState.LOST if self.presence.is_lost else self.sync.state

    @property
    def refresh(self) -> VolatileReads | None:
        """The reads of volatile values in progress after a hash match, or None."""
        return self.sync.refresh

    @property
    def can_hit(self) -> bool:
        """Whether the vehicle's hash may confirm the present table."""
        return self.table.complete and self.table.hash is not None

    @property
    def is_waiting(self) -> bool:
        """Whether anything is in progress: a request, a fetch, a file, or the identification."""
        return len(self.reads) > 0 or self.is_busy

    @property
    def is_busy(self) -> bool:
        """Whether anything is in progress except reads of volatile values after a hash match."""
        in_background = 0 if self.refresh is None else self.refresh.in_flight
        is_busy = len(self.reads) > in_background or len(self.writes) > 0 or not self.files.is_idle
        is_busy = is_busy or len(self.commands) > 0 or self.reboots.current is not None
        is_busy = is_busy or self.metadata_requests.is_asking
        is_busy = is_busy or self.ext.is_busy
        return is_busy or self.fetch is not None or self.identification.is_asking

    @property
    def is_settling(self) -> bool:
        """Whether a write is in progress, or the hash after one has not been received yet."""
        return len(self.writes) > 0 or self.sync.is_settling

    # received messages

    def receive(
        self,
        message: Message,
        now: float,
        *,
        version: int = 2,
        moment: float | None = None,
        sequence: int | None = None,
    ) -> None:
        """Process a message of this component; the arguments are those of `receive_value`.

        `sequence` is the sequence number of its frame, if it had one.
        """
        if isinstance(message, ParamValue):
            self.receive_value(message, now, version, moment)
            return
        silent_since = self.presence.received_at
        self._receive_any(now, version)
        if sequence is not None and self.presence.numbering_begins(sequence):
            self._numbering_began(silent_since, now)
        if isinstance(message, Heartbeat):
            self._receive_kind(message, now)
            state = self.presence.state
            if self.presence.heartbeat(message, now):
                self._rebooted(now)
            elif state not in (None, message.system_status):
                self.boot_time_requests.want(now)
            self.rereads.forget_old(now)
        elif isinstance(message, AutopilotVersion):
            before = self.identification.firmware
            if self.identification.version(message, now):
                self._vehicle_replaced(now)
            elif before not in (None, self.identification.firmware):
                self.fetches.updated()
        elif isinstance(message, ParamError):
            addressee = (message.target_system, message.target_component)
            if message.param_index < 0 and not is_portable_name(message.param_id):
                self.table.leave_out(message.param_id)
            elif addressee in (self._own_address, (0, 0)) and not self.writes.refused(message, now):
                self.reads.refused(message, now)
        elif isinstance(message, ParamExtValue):
            self.ext.receive_value(message, now, moment)
        elif isinstance(message, ParamExtAck):
            self.ext.receive_ack(message, now, moment)
        elif isinstance(message, CommandAck):
            self.messages.acknowledged(message, now)
            self.commands.acknowledged(message, now)
        elif isinstance(message, StatusText):
            denied = _WRITE_DENIED.search(message.text)
            if denied:
                self.writes.denied(denied.group(1), now)
        elif isinstance(message, SystemTime):
            self._receive_clock(self.presence.system_time(message, now), now)
        elif isinstance(message, FileTransfer):
            self.files.receive(message, now)
        elif isinstance(message, ComponentMetadata):
            self.metadata_requests.receive(message, now)
        elif isinstance(message, HighLatency2):
            self._receive_kind(message, now)
            self.presence.high_latency()
        self.identification.receive(now)
        self._follow_identity(now)

    def _receive_kind(self, message: Heartbeat | HighLatency2, now: float) -> None:
        """Process a changed autopilot or vehicle type: another vehicle, or the same one with other
        firmware."""
        if self.identification.heartbeat(message) and self.identification.settled:
            self._doubt()
            self.sync.check(now)
            self.identification.doubt(now)

    def receive_contested(self, message: Message, now: float, *, version: int = 2) -> None:
        """Process a message while several vehicles use the address: it only shows that one is there."""
        self._receive_any(now, version)
        if isinstance(message, Heartbeat):
            self.presence.heartbeat(message, now)

    def receive_value(
        self, message: ParamValue, now: float, version: int = 2, moment: float | None = None
    ) -> None:
        """Process a PARAM_VALUE of the component; a fast path for callers that know the type of message.

        Args:
            message: the message.
            now: the time.
            version: the MAVLink version of the frame.
            moment: when it arrived from the link, if earlier; None for `now`.
        """
        self._receive_any(now, version)
        identification = self.identification
        identification.receive(now)
        name, _, number, count, index = message
        if not is_portable_name(name):
            if name:
                self.table.leave_out(name)
            return
        if name == HASH_CHECK:
            announced = self.sync.receive_hash(message, now)
            if self.fetch is not None:
                self.fetch.announced(announced)
            if self.fetches.passive_table is not None:
                self.fetches.passive_table.announced(announced, now)
            is_count_new = count != self.table.count and count <= PARAMETERS_MAX
            if is_count_new and self.sync.synced and self.fetch is None:
                self._count_changed(count, now)
            self.reads.receive(message, now)
            return
        table = self.table
        if identification.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA:
            if not name.isupper():
                name = _in_capitals(name)
                message = message._replace(param_id=name)
            if number == ParamType.REAL32 and index == NO_INDEX:
                message = table.with_known_type(message)
        if count != table.count and count <= PARAMETERS_MAX:
            self._count_changed(count, now)
        authors = self._authors
        writes = self.writes
        by = writes.author(name) if writes.queues else None
        is_ours = by is not None
        if by is None:
            by = authors.of(name, now) if authors.foreign_sets else "vehicle"
        is_requested_value = is_ours and writes.wants(message)
        if is_ours and not is_requested_value and authors.foreign_sets:
            by = authors.setter_of(name, message.raw, now) or by
        if self._checks:
            until = self._checks.ambiguous_until(message, now, is_requested=is_requested_value)
            if until > now:
                self._receive_ambiguous(message, until, now)
                return
        arrived_at = now if moment is None else moment
        change = table.store_value(message, by, arrived_at, is_exact=is_requested_value)
        if change is not None:
            authors.changed(name, now, is_ours)
            self._note_replaced(change, message, now)
            self.sync.changed(name, by, now)
            self._report_change(change)
        elif name not in table.params:
            return  # more names than the table may hold
        fetch = self.fetches.current
        if fetch is not None:
            fetch.receive(message, now)
        if writes.queues:
            writes.receive(message, now)
        self._receive_read(message, now)

    def boot_clock(self, message_id: int, boot_ms: int, now: float) -> None:
        """Process `time_boot_ms` of a telemetry message."""
        self.reschedule()
        self._receive_clock(self.presence.boot_clock(message_id, boot_ms, now), now)

    def _receive_clock(self, has_restarted: bool, now: float) -> None:
        if has_restarted:
            self._rebooted(now, by_clock=True)

    def _numbering_began(self, silent_since: float, now: float) -> None:
        """Process a possible new frame numbering, as after a reboot: the clock decides whether it is one.

        A fetch that was interrupted does not wait for the clock.
        """
        if self.reboots.numbering_began(now):
            return
        self.boot_time_requests.want(now)
        if now - silent_since >= NUMBERING_SILENCE and self.fetches.seems_restarted(silent_since, now):
            self._doubt()

    def _note_replaced(self, change: Change, message: ParamValue, now: float) -> None:
        """Remember the value before a change. PX4 has none in flight: its responses have the present
        value."""
        old = change[1]
        if old is not None and self.identification.autopilot != MAV_AUTOPILOT_PX4:
            bits, number, *_ = unpack_fields(old)
            raw = as_reported(bits, number, self.table.encoding)
            self._checks.replaced(change.name, number, raw, message, now, self.reads.sent_at)

    def _receive_ambiguous(self, message: ParamValue, until: float, now: float) -> None:
        """Process a PARAM_VALUE whose value may be older than the last change: only its index counts."""
        self.table.hear_index(message)
        self._checks.ask(message.param_id, until)
        fetch = self.fetches.current
        if fetch is not None:
            fetch.receive(message, now)
        self.writes.defer(message, until)
        if self.fetches.passive_table is not None:
            self.fetches.passive_table.receive(message, now)
        self.reads.defer(message, until, now)

    def foreign_set(self, name: str, raw: bytes, station: str, now: float) -> None:
        """Record another station's PARAM_SET to this component, with the 4 bytes of its value."""
        self.reschedule()
        if not is_portable_name(name):
            self.table.leave_out(name)
            return
        self._authors.foreign_set(self.spelling(name), station, now, raw)

    def foreign_ext_set(self, name: str, station: str, now: float) -> None:
        """Record another station's PARAM_EXT_SET to this component."""
        self.reschedule()
        self.ext.foreign_set(name, station, now)

    def use_cached(
        self,
        params: Mapping[str, Param],
        now: float,
        *,
        count: int | None,
        confirmed: int | None,
        complete: bool,
        volatile: frozenset[str],
        volatile_known: bool,
        placed: bool = True,
        moments: Mapping[str, float] | None = None,
    ) -> None:
        """Load the cached table of this component. Values received on this link stay.

        Args:
            params: the cached table.
            now: the time.
            count: its param_count.
            confirmed: the hash by which the vehicle would confirm it, or None.
            complete, placed: whether it had every index below the count, and whether the indices are still
                valid.
            volatile, volatile_known: as in `Table`.
            moments: when each value was observed last, in seconds as `now`.
        """
        if self.table.complete:
            return
        if count is not None and count > PARAMETERS_MAX:  # accepted by an earlier version
            count, complete, placed = None, False, False
        changes = self.table.restore(
            params,
            count=count,
            confirmed=confirmed,
            complete=complete,
            placed=placed,
            volatile=volatile,
            volatile_known=volatile_known,
            moments=moments,
        )
        self._report(changes)
        self.sync.compare(now)

    # requests

    def read(self, key: Key, now: float) -> Read:
        """Read one parameter; give it back with `reads.release`.

        Raises:
            NoReply: the component is lost. Nothing was sent.
        """
        what = key if isinstance(key, str) else f"parameter {key}"
        self.check_present(f"{what} of {self.system}/{self.component}", now)
        read = self.reads.ask(self.spelling(key) if isinstance(key, str) else key, now)
        read.is_of_caller = True
        return read

    def write(
        self,
        name: str,
        value: WireValue,
        now: float,
        author: str | None = None,
        *,
        settle: float = 0.0,
        force: bool = False,
    ) -> Write:
        """Write one parameter, also on behalf of another user.

        Args:
            name, value, author: as in `Component.set`.
            now: the time.
            settle: seconds from the acknowledgement until the value is read once more.
            force: send NaN and infinity also to an autopilot that cannot store them.

        Raises:
            UsageError: the type is known and the value does not fit it, or the autopilot cannot store it.
                Nothing was sent.
            NoReply: the component is lost. Nothing was sent.
        """
        self._check_writable(f"PARAM_SET {name}", now)
        name = self.spelling(name)
        known = self.table.params.get(name)
        if known is not None and known.trust is not Trust.CACHED and self.may_be_written:
            encode_value(value, known.type_number, self.table.encoding)
        self.writes.check_finite(name, value, force=force)
        write = self.writes.set(name, value, now, author, settle=settle, force=force)
        write.on_done.append(lambda: self._write_ended(write))
        return write

    def write_many(
        self,
        pairs: Sequence[tuple[str, WireValue]],
        now: float,
        author: str | None = None,
        *,
        settle: float = 0.0,
        force: bool = False,
    ) -> WriteBatch:
        """Write several parameters; end the batch with `write_batches.end`.

        Args:
            pairs: names and values, in order.
            now, author, settle, force: as in `write`.

        Raises:
            UsageError: nothing may be sent.
            NoReply: the component is lost. Nothing was sent.
        """
        self.check_present(f"PARAM_SET to {self.system}/{self.component}", now)

        def begin(name: str, value: WireValue, at: float) -> Write:
            return self.write(name, value, at, author, settle=settle, force=force)

        number = self.identification.autopilot
        autopilot = "" if number is None else autopilot_name(number)

        def is_switch(name: str) -> bool:
            return is_group_switch(self.spelling(name), autopilot)

        batch = WriteBatch(pairs, BatchRules(begin, self.writes.cancel, is_switch), now)
        self.write_batches.begin(batch, now)
        return batch

    def read_ext(self, key: Key, now: float) -> ExtRead:
        """Read one extended parameter; give it back with `ext.reads.release`.

        Raises:
            NoReply: the component is lost. Nothing was sent.
        """
        what = key if isinstance(key, str) else f"extended parameter {key}"
        self.check_present(f"{what} of {self.system}/{self.component}", now)
        return self.ext.read(key, now)

    def write_ext(self, name: str, value: ExtValue, now: float, author: str | None = None) -> ExtWrite:
        """Write one extended parameter; end it with `ext.writes.cancel`.

        Raises:
            UsageError: the type is known and the value does not fit it. Nothing was sent.
            NoReply: the component is lost. Nothing was sent.
        """
        self._check_writable(f"PARAM_EXT_SET {name}", now)
        known = self.ext.table.params.get(name)
        if known is not None and known.trust is not Trust.CACHED and self.is_recipient_certain:
            encode_ext_value(value, known.type)
        return self.ext.write(name, value, now, author)

    def write_many_ext(
        self, pairs: Sequence[tuple[str, ExtValue]], now: float, author: str | None = None
    ) -> ExtWriteBatch:
        """Write several extended parameters; end the batch with `ext.batches.end`.

        Raises:
            UsageError: nothing may be sent.
            NoReply: the component is lost. Nothing was sent.
        """
        self.check_present(f"PARAM_EXT_SET to {self.system}/{self.component}", now)

        def begin(name: str, value: ExtValue, at: float) -> ExtWrite:
            return self.write_ext(name, value, at, author)

        batch = ExtWriteBatch(pairs, begin, self.ext.writes.cancel, now)
        self.ext.batches.begin(batch, now)
        return batch

    def begin_ext_fetch(self, now: float) -> ExtFetch:
        """Begin a fetch of the extended parameters, or join the one in progress; give it back with
        `ext.fetches.end`.

        Raises:
            ContestedAddress: several vehicles use its address.
            NoReply: the component is lost. Nothing was sent.
        """
        self.reschedule()
        self.check_present(f"the extended parameters of {self.system}/{self.component}", now)
        return self.ext.begin_fetch(now)

    def _check_writable(self, what: str, now: float) -> None:
        """Check that a write can be sent, and confirm an identity that is open."""
        self.check_present(f"{what} to {self.system}/{self.component}", now)
        for each in (self, *self._autopilots()):
            if each.identification.is_unconfirmed:
                each.identification.doubt(now)

    def begin_reboot(self, now: float, *, returns: bool = True) -> Reboot:
        """Reboot the component, or join the reboot in progress; give it back with `end_reboot`.

        Args:
            now: the time.
            returns: whether it returns under its address, see `Reboot`.

        Raises:
            NoReply: the component is lost. Nothing was sent.
        """
        if not self.reboots.is_in_progress:
            self.check_present(f"the restart of {self.system}/{self.component}", now)
        self._read_clock(now)
        self.reschedule()
        return self.reboots.begin(now, returns=returns)

    def end_reboot(self, reboot: Reboot, now: float) -> None:
        """Give a reboot back. The last holder ends it; whether the command takes effect is then unknown."""
        self.reschedule()
        self.reboots.end(reboot, now)

    def begin_fetch(
        self,
        now: float,
        *,
        refresh: bool = False,
        listed: bool = False,
        by_list: bool = False,
        check: Check | None = None,
    ) -> Fetch:
        """Begin a fetch, or join the one in progress; give it back with `end_fetch`.

        Args:
            now: the time.
            refresh: download even if the vehicle's hash would confirm the cached table.
            listed: the list was requested already, of all components at once.
            by_list: download by list even if the vehicle serves the file.
            check: the options of a fetch that only the watch has requested.

        Raises:
            ContestedAddress: several vehicles use its address.
            NoReply: the component is lost, and no fetch is in progress. Nothing was sent.
        """
        self.check_uncontested()
        self.reschedule()
        if self.fetch is None and self._fetch_policy is not Policy.CACHE_ONLY:
            self.check_present(f"the parameters of {self.system}/{self.component}", now)
        return self.fetches.begin(now, refresh=refresh, listed=listed, by_list=by_list, check=check)

    def end_fetch(self, fetch: Fetch, now: float) -> None:
        """Give a fetch back. The last holder cancels it."""
        self.reschedule()
        self.fetches.end(fetch, now)

    def spelling(self, name: str) -> str:
        """Return the vehicle's spelling of a name. ArduPilot accepts any case; its own names are in
        capitals."""
        return _in_capitals(name) if self.identification.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA else name

    def check_present(self, what: str, now: float) -> None:
        """Check that requests can be sent to it.

        Raises:
            UsageError: nothing may be sent.
            ContestedAddress: several vehicles use its address.
            NoReply: the component is lost.
        """
        if self._listens_only:
            raise UsageError(
                f"{what} cannot be requested: the client only listens. Received values are in `params`"
            )
        self.check_uncontested()
        if self.presence.is_lost:
            silence = now - self.presence.received_at
            raise NoReply(f"{what} (lost)", attempts=0, waited=silence)

    def check_uncontested(self) -> None:
        """Check that one vehicle alone uses the address, and that of its autopilot.

        Raises:
            ContestedAddress: several vehicles do.
        """
        for each in (self, *self._autopilots()):
            if each.peers.contest is not None:
                raise each.peers.contest.error

    # peers

    def home_changed(self, claim: Claim, now: float, verdict: PeerRelation) -> None:
        """Take another peer as the one with the address, and request its identity."""
        if verdict is PeerRelation.OTHER:
            self._replaced(now)
        else:
            if verdict is PeerRelation.OPEN:
                self._doubt()
                self.sync.check(now)
            self.identification.doubt(now)
        self._take_claim(claim, now)
        self.boot_time_requests.want(now)

    def contest_began(self, contest: Contest, now: float) -> None:
        """End all operations with an error: several vehicles use the address."""
        self._observer.contested(self, contest)
        self.fail_all(contest.error, now)
        self._forget_companions(contest.error, now)

    def contest_ended(self, claim: Claim, now: float, *, is_same: bool) -> None:
        """Request the identity of the one vehicle with the address, before anything of it counts."""
        if is_same:
            self._doubt()
            self.identification.doubt(now)
            what = f"the components of system {self.system}: the vehicle is being identified"
            self._forget_companions(NoReply(what, attempts=0, waited=0.0), now)
        else:
            self._replaced(now)
        self._observer.uncontested(self)
        self._known_as = None
        self.sync.check(now)
        self._take_claim(claim, now)
        self.boot_time_requests.want(now)

    def _forget_companions(self, error: ParamClientError, now: float) -> None:
        """Forget the autopilot's other components after a contest: their messages may be of either
        vehicle."""
        if self.identification.is_autopilot:
            for each in self._companions:
                if each is not self and each.identification.has_parameters:
                    each.fail_all(error, now)
                    each.become_another(now)

    def _replaced(self, now: float) -> None:
        """Forget the vehicle: another one uses the address. An autopilot takes its vehicle's components with
        it."""
        is_autopilot = self.identification.is_autopilot
        self.identification.forget(now)
        if is_autopilot:
            self._vehicle_replaced(now)
        else:
            self.become_another(now)

    def _vehicle_replaced(self, now: float) -> None:
        """Forget all components of the system id: another vehicle uses it."""
        for each in self._companions:
            each.become_another(now)

    def _take_claim(self, claim: Claim, now: float) -> None:
        """Process what a peer has sent before its messages counted."""
        for message in (claim.heartbeat, claim.version):
            if message is not None:
                self.receive(message, now, version=self.version)

    # time

    def tick(self, now: float) -> None:
        """Do what is due."""
        self.peers.tick(now)
        if self.presence.lost_at() <= now:
            self._lose(now)
        if self.peers.contest is not None:
            return
        for machine in self._machines:
            machine.tick(now)
        self._follow_identity(now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        first = min(self.presence.lost_at(), self.peers.next_deadline())
        if self.peers.contest is not None:
            return first
        for machine in self._machines:
            deadline = machine.next_deadline()
            if deadline < first:
                first = deadline
        return first

    def resume(self, now: float) -> None:
        """Repeat all requests in flight: the link is back."""
        self.reschedule()
        self.round_trip.received_at = now
        if not self.presence.is_lost:
            if self.presence.was_silent(silence := self.presence.receive(now)):
                self._doubt()
                self.sync.check(now)
            elif self.identity.uid is not None:
                self.identification.doubt(now)  # another vehicle may have been plugged in
            self._was_silent(silence, now)
        for machine in self._machines:
            machine.resume(now)

    def fail_all(self, error: ParamClientError, now: float) -> None:
        """End every operation with the error: the link has ended, or the address is contested."""
        self.reschedule()
        for machine in reversed(self._machines):
            machine.fail_all(error, now)

    def become_another(self, now: float) -> None:
        """Forget everything: another vehicle uses the system id."""
        self.reschedule()
        self._report(self.table.forget())
        self._observer.replaced(self)
        self.sync.forget()
        self.fetches.forget()
        self.ext.forget(now)
        self._checks.clear()
        self._known_as = None
        self.reboots.vehicle_replaced(now)
        self.commands.lose(now, ": another vehicle has this address now")
        what = f"writes to {self.system}/{self.component}: another vehicle has this address now"
        self._fail_writes(NoReply(what, attempts=0, waited=0.0), now)
        if self.fetch is not None:
            self.fetch.restart(now)

    def __repr__(self) -> str:
        kind = (
            "unknown"
            if self.identification.autopilot is None
            else autopilot_name(self.identification.autopilot)
        )
        return f"<ComponentMachine {self.system}/{self.component} {kind} {self.state}>"

    def _receive_any(self, now: float, version: int) -> None:
        """Process the arrival of any message."""
        self.reschedule()
        presence = self.presence
        silence = presence.receive(now)
        self.round_trip.received_at = now
        if silence >= presence.gap or presence.is_lost:
            self._was_silent(silence, now)
        if version > self.version:
            self.version = version

    def _count_changed(self, count: int, now: float) -> None:
        """Process a changed param_count in a PARAM_VALUE."""
        if self.table.count is not None:
            self.sync.count_changed(now)
        self.table.change_count(count)

    def _doubt(self) -> None:
        """Doubt everything known: it counts again when the vehicle has confirmed it."""
        self.table.doubt(Trust.LIVE, Trust.VERIFIED)
        self.ext.doubt()
        self.sync.doubt()
        if self.fetch is not None:
            self.fetch.doubt()
        if self.fetches.passive_table is not None:
            self.fetches.passive_table.forget()

    def _lose(self, now: float) -> None:
        """Mark the component as lost. A fetch goes on for a while: the component may only be rebooting."""
        presence = self.presence
        presence.is_lost = True
        self._observer.lost(self, now - presence.received_at)
        for machine in reversed(self._machines):
            machine.lose(now)
        self._doubt()

    def _was_silent(self, silence: float, now: float) -> None:
        """Process the end of a silence. After a long one, identity and hash are requested again."""
        presence = self.presence
        if presence.is_lost or silence == math.inf:
            presence.since = now
        if presence.is_lost:
            presence.is_lost = False
            self.reads.reset_timeouts()  # its cause has nothing to do with the silence before
            self._observer.found(self, silence)
            self.sync.check(now)
            self.identification.doubt(now)
        elif presence.was_silent(silence) and silence < math.inf:
            self.identification.doubt(now)
        self.reboots.silence_ended(silence, now)
        if presence.has_beaten:  # without heartbeats, no message is ever overdue
            self.sync.silence(now)

    def _reboot_noticed(self, now: float) -> None:
        """Process a reboot on command that the clock has not shown, or not by going back."""
        self.presence.forget_clock(now)
        self._rebooted(now)

    def _rebooted(self, now: float, *, by_clock: bool = False) -> None:
        """Process a reboot: unsaved values are lost, and a list starts again."""
        self._observer.rebooted(self)
        started_at = self.presence.started_at if by_clock else None
        is_of_this_run = started_at is not None and self.fetches.are_since(started_at)
        if not is_of_this_run:
            self._doubt()
        self.ext.restart(now)
        self.rereads.clear()
        if self.sync.expects_hash or self.fetch is not None or not is_of_this_run:
            self.sync.check(now)  # otherwise it would only repeat the download
        self.identification.doubt(now)
        self.reboots.rebooted(now)
        if not by_clock:
            self.boot_time_requests.want(now)
        if self.fetch is not None and self.fetch.is_receiving and not is_of_this_run:
            self.fetch.restart(now)

    def _follow_identity(self, now: float) -> None:
        """Apply the results of the identification."""
        self._report(self.table.use_encoding(self.identification.encoding))
        autopilot = self.identification.autopilot
        self.reads.pace.is_batched = autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA
        name = autopilot_name(MAV_AUTOPILOT_PX4 if autopilot is None else autopilot)  # may be one
        self.writes.against_non_finite = reason_against_non_finite(name)
        if self.fetch is not None:
            self.fetch.check_file(now)
        if self.identification.settled and self._known_as != self.identity.key:
            self._known_as = self.identity.key
            self._observer.identified(self)
            if self.identification.is_autopilot:
                self.boot_time_requests.want_baseline(now)
        for each in self._companions:
            if each.writes.queues or each.ext.writes.queues:
                each._follow_permission(now)

    def _follow_permission(self, now: float) -> None:
        """Continue the writes, or end them with an error where the identity of the vehicle, or of its
        autopilot, was requested without success."""
        self.reschedule()
        if self.ext.writes.is_awaiting_permission and self.is_recipient_certain:
            self.ext.writes.proceed(now)
        if self.writes.is_awaiting_permission and self.may_be_written:
            self.writes.proceed(now)
            return
        for each in (self, *self._autopilots()):
            if each.identification.is_unconfirmed:
                what = f"{each.system}/{each.component} has not identified itself since it was silent"
                waited = now - each.identification.doubted_at
                self._fail_writes(NoReply(what, attempts=each.identification.attempts, waited=waited), now)

    def _fail_writes(self, error: ParamClientError, now: float) -> None:
        self.write_batches.fail_all(error, now)
        self.writes.fail_all(error, now)
        self.ext.fail_writes(error, now)

    def _doubt_identity(self, now: float) -> None:
        """Doubt the table: another vehicle may respond by now."""
        if self.identification.settled and now - self.identification.known_at > IDENTITY_VALID_TIME:
            self.identification.ask_again(now)

    def _fetch_changed(self, changes: list[Change]) -> None:
        """Report changes that a fetch has found without a PARAM_VALUE."""
        for change in changes:
            self.sync.changed(change.name, change.by)
        self._report(changes)

    def _write_ended(self, write: Write) -> None:
        now = write.ended_at
        self.reboots.write_ended(now)
        self.sync.write_ended(now)
        self.rereads.write_ended(write, now)

    def resynced(self, changed: tuple[str, ...], confirmed: int | None) -> None:
        """Report that the table matches the vehicle's again."""
        self._observer.resynced(self, changed, confirmed)

    def _fetched(self, result: FetchResult) -> None:
        self._observer.fetched(self, result)

    def ext_changed(self, change: ExtChange) -> None:
        """Report a change of an extended parameter."""
        self._observer.ext_changed(self, change)

    def _report(self, changes: list[Change]) -> None:
        for change in changes:
            self._report_change(change)

    def _report_change(self, change: Change) -> None:
        if self.reports_each_change:
            self._observer.changed(self, change)
        elif not self.has_changed:
            self.has_changed = True
            self._observer.params_changed(self)


def _in_capitals(name: str) -> str:
    """Return the name with its ASCII letters in capitals. The capital of other letters, which only damage
    brings, may have two letters or not fit into a message."""
    return name.encode("latin-1").upper().decode("latin-1")


_WRITE_DENIED = re.compile(r"Param write denied \((\w{1,16})\)")
