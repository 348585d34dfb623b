"""One component: what is known of it, its table, and the exchanges with it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final, Protocol

from paramclient.errors import NoReply, ParamClientError, UsageError
from paramclient.model.identity import Identity, autopilot_name, reason_against_non_finite
from paramclient.model.params import unpack_fields
from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    Trust,
    Value,
    as_sent,
    encode,
    is_portable_name,
)
from paramclient.protocol.addresses import Address, Peer, PeerAddress, peer_in_words
from paramclient.protocol.ftp import FileTransfers
from paramclient.protocol.params.boot_values import StartValues
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch import Check, Fetch
from paramclient.protocol.params.fetch_queue import Fetches
from paramclient.protocol.params.fetch_result import FetchResult, Means, Policy, Sampled
from paramclient.protocol.params.foreign_list import Following
from paramclient.protocol.params.name_search import NameSearch, NameSearches
from paramclient.protocol.params.reads import Key, Read, Reads
from paramclient.protocol.params.sync import Sync, SyncState, Upkeep
from paramclient.protocol.params.sync_interval import CheckPace
from paramclient.protocol.params.table import Room, Table
from paramclient.protocol.params.value_check import Rereads
from paramclient.protocol.params.volatile_values import Refresh
from paramclient.protocol.params.writes import Write, Writes
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.scheduler import Turns
from paramclient.protocol.stats.trace import Trace, silent
from paramclient.protocol.vehicle.boot_time_requests import ClockRequests
from paramclient.protocol.vehicle.claims import Claim, Verdict
from paramclient.protocol.vehicle.commands import Commands
from paramclient.protocol.vehicle.identification import Identification
from paramclient.protocol.vehicle.metadata_location import Descriptions
from paramclient.protocol.vehicle.peers import NO_PEER, ComponentPeers, Contest
from paramclient.protocol.vehicle.presence import Presence
from paramclient.protocol.vehicle.reboot import Restart, Restarts
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
    ParamValue,
    StatusText,
    SystemTime,
)

__all__ = ["ComponentMachine", "ComponentObserver"]

RESTART_SILENCE: Final = 0.25
"""Seconds of silence behind which a new numbering of frames has a fetch begun anew: an ArduPilot that starts
again says nothing for that long at least (measured: 0.31 s with a station that talks to it, else 1.0 s)."""
FRESH_IDENTITY: Final = 1.0
"""Seconds for which an AUTOPILOT_VERSION needs no other."""


class ComponentObserver(Protocol):
    """Is told what happens to components. `paramclient.protocol.events` makes events of it."""

    def identified(self, machine: ComponentMachine) -> None:
        """The identity is settled, as far as it ever will be; the cached table can be looked up."""

    def lost(self, machine: ComponentMachine, silence: float) -> None:
        """The heartbeat timeout has expired; `silence` is the time since the last message in s."""

    def found(self, machine: ComponentMachine, silence: float) -> None:
        """A lost component is heard again, after `silence` s."""

    def rebooted(self, machine: ComponentMachine) -> None:
        """The vehicle has started again."""

    def replaced(self, machine: ComponentMachine) -> None:
        """Another vehicle has the address: nothing that was known is about that one."""

    def contested(self, machine: ComponentMachine, contest: Contest) -> None:
        """Several vehicles have the address: nothing is taken from them or requested of them."""

    def uncontested(self, machine: ComponentMachine) -> None:
        """One vehicle alone has the address again, or the peers are proven to be one vehicle."""

    def changed(self, machine: ComponentMachine, change: Change) -> None:
        """A parameter appeared, changed or went away, and each change is to be told (`tells_changes`)."""

    def moved(self, machine: ComponentMachine) -> None:
        """Parameters have changed, and not each change is to be told."""

    def fetched(self, machine: ComponentMachine, result: FetchResult) -> None:
        """A fetch has ended with a result."""

    def resynced(self, machine: ComponentMachine, changed: tuple[str, ...], confirmed: int | None) -> None:
        """The table agrees with the vehicle's again; see `TableResynced`."""


class ComponentMachine:
    """Everything about one component that needs no clock and no socket.

    Args:
        system, component: who it is.
        own: system and component that we send as.
        link: the link's canonical name, part of an identity without a hardware id.
        send: takes each message for it, in order.
        observer: is told what happens to the component.
        send_to: takes each message that is for one of its peers; None where there is only one.
        encoding: what the user said about its encoding, or None.
        upkeep: what is done for its table without being asked.
        is_link_busy: whether anything is being asked for on the link.
        vehicle: gives all components of its vehicle.
        another: is told that another vehicle has taken the system id; by default `become_another`.
        read_clock: has `boot_clock` called with clocks from its telemetry for a while; see `ClockSampling`.
        peer: the peer that it is of, where components are kept apart by their peers; else None.
        turns: those of the lists on the link; None for a link that it has for itself.
        room: what the tables of the link may hold together; None likewise.
        trace: is told of each step.

    Attributes:
        address: system and component, and with `peer` that as well.
        vehicle: what all components of a vehicle have in common: the system, and with `peer` that as well.
        version: the MAVLink version that it speaks, as far as heard.
        who: its identity, and how it writes values.
        table: its parameters.
        round_trip: what its answers tell of the link.
        presence: whether it is there.
        peers: which peers speak for it, and whether several vehicles do.
        following: the list that another station has asked for, while none of ours comes.
        sync: whether the table is still the vehicle's.
        files: its files.
        descriptions: where it says that what it has to say of itself lies.
        name_searches: the search for names that may not exist.
        commands: what it is told to do.
        clock_requests: the requests for its time since boot.
        start_values: the reading of what it measures at each start.
        restarts: the restart that it was told to make.
        rereads: the values that are to be read again.
        fetches: what was and is being fetched.
        tells_changes: whether somebody wants to be told of each change. An event for each value of a long
            list takes a tenth of what the value takes, and the garbage collector goes through those that
            wait.
        has_moved: whether an event says that something has changed; who hands it out sets this back.
    """

    def __init__(
        self,
        system: int,
        component: int,
        *,
        own: tuple[int, int],
        link: str,
        send: Callable[[Message], None],
        observer: ComponentObserver,
        send_to: Callable[[Message, Peer], None] | None = None,
        encoding: Encoding | None = None,
        upkeep: Upkeep | None = None,
        is_link_busy: Callable[[], bool] = lambda: False,
        vehicle: Callable[[], Iterable[ComponentMachine]] = lambda: (),
        another: Callable[[float], None] | None = None,
        read_clock: Callable[[float], None] = lambda now: None,
        peer: Peer | None = None,
        turns: Turns | None = None,
        room: Room | None = None,
        trace: Trace = silent,
    ) -> None:
        target = (system, component)
        upkeep = upkeep or Upkeep()
        self.system = system
        self.component = component
        self.address: Address = target if peer is None else PeerAddress(system, component, peer)
        self.vehicle: tuple[int, Peer] = (system, peer)
        self.version = 1
        context = Context(target, send, own, trace=trace, may_send=not upkeep.listens_only)
        self.round_trip = context.round_trip
        self.who = Identification(context, link, encoding)
        self.table = Table(self.who.encoding, room)
        self.turns = Turns() if turns is None else turns
        self.reads = Reads(context, self.table, self.turns.share)
        self.writes = Writes(context, self.reads, self.table, permission=self)
        self.presence = Presence()
        self.peers = ComponentPeers(target, self, may_ask=context.may_send)
        self.files = FileTransfers(context)
        check_pace = CheckPace(upkeep.interval, is_chosen=upkeep.without_hash)
        self.sync = Sync(
            context, self.reads, self.table, upkeep, check_pace, self.presence, self.files, host=self
        )
        self.descriptions = Descriptions(context)
        self.commands = Commands(context)
        self.clock_requests = ClockRequests(context, self.presence)
        self.start_values = StartValues(context, self.reads, self.table, self.sync)
        self.restarts = Restarts(
            context, self.commands, self.who, self.presence, self.clock_requests, self._restart_noticed
        )
        self.following = Following()
        means = Means(
            context,
            self.reads,
            self.table,
            self.turns,
            self.files,
            changed=self._moved,
            doubt=self._doubt_identity,
            following=self.following,
        )
        self.fetches = Fetches(means, self.sync, upkeep, check_pace, ended=self._fetched)
        self.name_searches = NameSearches(context, self.reads, self.table, self.following)
        # where nothing is asked there are no reads: what others ask for is heard in their place
        overheard = self.fetches.overheard
        self._value_heard = self.reads.heard if overheard is None else overheard.heard
        self._own = own
        self._observer = observer
        self._send_to = send_to or (lambda message, peer: send(message))
        self._policy = upkeep.policy
        self._is_link_busy = is_link_busy
        self._listens_only = upkeep.listens_only
        self._another = another or self.become_another
        self._read_clock = read_clock
        self._vehicle = vehicle
        self._known_as: str | None = None  # the key of the identity that was reported
        self.tells_changes = True
        self.has_moved = False
        self.rereads = Rereads(context, self.reads, self.table, self.sync, upkeep.policy)
        self._authors = self.rereads.authors
        self._checks = self.rereads.checks
        self.writes.left_open = self._authors.foreign_set
        self._machines: tuple[Machine, ...] = (
            *(self.reads, self.name_searches, self.sync, self.writes, self.files, self.commands),
            *(self.restarts, self.fetches, self.who, self.descriptions, self.clock_requests),
            *(self.start_values, self.rereads),
        )
        """Each stands behind those that it uses or tells. They end in the reverse order: a machine does not
        take the end of what it uses for a result, and is told nothing after its own end."""

    @property
    def peer_in_words(self) -> str:
        """Where its messages come from, `127.0.0.1:14550`; "" while that is not known."""
        if isinstance(self.address, PeerAddress):
            return peer_in_words(self.address.peer)
        return "" if self.peers.home is NO_PEER else peer_in_words(self.peers.home)

    def address_in(self, system: int) -> Address:
        """The address that it has under another system id."""
        if isinstance(self.address, PeerAddress):
            return PeerAddress(system, self.component, self.address.peer)
        return system, self.component

    @property
    def identity(self) -> Identity:
        """Who the vehicle is, as far as this component has said."""
        return self.who.identity

    @property
    def may_be_written(self) -> bool:
        """Whether it is certain whom a write reaches, and what it makes of it."""
        home = self.peers.home
        is_open = any(each.who.was_away or each.peers.is_rival(home) for each in self._autopilots())
        return self.who.may_be_written and not is_open

    @property
    def may_use_file(self) -> bool:
        """Whether the table is worth requesting as a file."""
        return self.fetches.may_use_file()

    @property
    def is_link_busy(self) -> bool:
        """Whether anything is requested on the link."""
        return self._is_link_busy()

    @property
    def state(self) -> str:
        """The table's state in a word: new, cached, fetching, synced, partial, contested, lost."""
        if self.presence.is_lost:
            return "lost"
        if self.peers.contest is not None:
            return "contested"
        if self.fetch is not None:
            return "fetching"
        if self.sync.synced:
            return "synced"
        if not self.table.params:
            return "new"
        return "cached" if self.table.complete else "partial"

    def _autopilots(self) -> Iterator[ComponentMachine]:
        """The autopilot that it belongs to, where that is another component."""
        return (each for each in self._vehicle() if each is not self and each.who.is_autopilot)

    @property
    def is_restarting(self) -> bool:
        """Whether it was told to start again, and that is awaited."""
        return self.restarts.is_under_way

    @property
    def is_identified(self) -> bool:
        """Whether it is settled who it is, and that is not being asked for."""
        return self.who.settled and not self.who.is_asking

    def read_clock(self, now: float) -> None:
        """Have clocks in telemetry read for a while."""
        self._read_clock(now)

    def send_to(self, message: Message, peer: Peer) -> None:
        """Send a message to one of the peers that speak for it."""
        self._send_to(message, peer)

    @property
    def fetch(self) -> Fetch | None:
        """The fetch under way, or None."""
        return self.fetches.current

    @property
    def sync_state(self) -> SyncState:
        """How the table stands to the vehicle's."""
        return SyncState.LOST if self.presence.is_lost else self.sync.state

    @property
    def refresh(self) -> Refresh | None:
        """The reading of volatile values under way after a hash hit, or None."""
        return self.sync.refresh

    @property
    def can_hit(self) -> bool:
        """Whether the vehicle's hash may confirm the table as it stands."""
        return self.table.complete and self.table.hash is not None

    @property
    def is_waiting(self) -> bool:
        """Whether anything is awaited: an answer, a fetch, a file, or who it is."""
        return len(self.reads) > 0 or self.is_busy

    @property
    def is_busy(self) -> bool:
        """Whether anything is awaited but the values that are read after the hash has agreed."""
        in_background = 0 if self.refresh is None else self.refresh.in_flight
        is_asked = len(self.reads) > in_background or len(self.writes) > 0 or not self.files.is_idle
        is_asked = is_asked or len(self.commands) > 0 or self.restarts.current is not None
        is_asked = is_asked or self.descriptions.is_asking or len(self.name_searches) > 0
        return is_asked or self.fetch is not None or self.who.is_asking

    @property
    def is_settling(self) -> bool:
        """Whether a write is under way, or the hash after one has not come yet."""
        return len(self.writes) > 0 or self.sync.is_settling

    # what comes in

    def receive(
        self,
        message: Message,
        now: float,
        *,
        version: int = 2,
        moment: float | None = None,
        sequence: int | None = None,
    ) -> None:
        """Take a message that this component sent; the arguments are those of `receive_value`.

        `sequence` is the sequence number of its frame, where it had one.
        """
        if isinstance(message, ParamValue):
            self.receive_value(message, now, version, moment)
            return
        silent_since = self.presence.heard_at
        self._heard(now, version)
        if sequence is not None and self.presence.numbering_begins(sequence):
            self._numbering_began(silent_since, now)
        if isinstance(message, Heartbeat):
            self._kind_told(message, now)
            state = self.presence.state
            if self.presence.heartbeat(message, now):
                self._rebooted(now)
            elif state not in (None, message.system_status):
                self.clock_requests.want(now)
            self.rereads.forget_old(now)
            if self.fetches.overheard is not None:
                self.fetches.overheard.file.tick(now)  # in a log nothing else tells the time
        elif isinstance(message, AutopilotVersion):
            before = self.who.firmware
            if self.who.version(message, now):
                self._another(now)
            elif before not in (None, self.who.firmware):
                self.fetches.updated(now)
        elif isinstance(message, ParamError):
            addressee = (message.target_system, message.target_component)
            if message.param_index < 0 and not is_portable_name(message.param_id):
                self.table.leave_out(message.param_id)
            elif addressee in (self._own, (0, 0)) and not self.writes.refused(message, now):
                self.reads.refused(message, now)
                self.name_searches.refused(message, now)
        elif isinstance(message, CommandAck):
            self.who.acknowledged(message, now)
            self.descriptions.acknowledged(message, now)
            self.commands.acknowledged(message, now)
        elif isinstance(message, StatusText):
            denied = _WRITE_DENIED.search(message.text)
            if denied:
                self.writes.denied(denied.group(1), now)
        elif isinstance(message, SystemTime):
            self._clock_told(self.presence.system_time(message, now), now)
        elif isinstance(message, FileTransfer):
            self.files.heard(message, now)
            if self.fetches.overheard is not None:
                self.fetches.overheard.file.reply_heard(message, now)
        elif isinstance(message, ComponentMetadata):
            self.descriptions.heard(message, now)
        elif isinstance(message, HighLatency2):
            self._kind_told(message, now)
            self.presence.high_latency()
        self.who.heard(now)
        self._follow_identity(now)

    def _kind_told(self, message: Heartbeat | HighLatency2, now: float) -> None:
        """Another autopilot or vehicle type is another vehicle's, or the same one has other firmware."""
        if self.who.heartbeat(message) and self.who.settled:
            self._doubt()
            self.sync.check(now)
            self.who.doubt(now)

    def receive_contested(self, message: Message, now: float, *, version: int = 2) -> None:
        """Take a message while several vehicles have the address: it shows that one is there."""
        self._heard(now, version)
        if isinstance(message, Heartbeat):
            self.presence.heartbeat(message, now)

    def receive_value(
        self, message: ParamValue, now: float, version: int = 2, moment: float | None = None
    ) -> None:
        """Take a PARAM_VALUE that it sent: for those who know that it is one.

        Args:
            message: the message.
            now: the time.
            version: the MAVLink version of the frame.
            moment: when it came from the link, where that was earlier; None for `now`.
        """
        self._heard(now, version)
        who = self.who
        who.heard(now)
        name, _, number, count, index = message
        if not is_portable_name(name):
            if name:
                self.table.leave_out(name)
            return
        if name == HASH_CHECK:
            announced = self.sync.hash_heard(message, now)
            if self.fetch is not None:
                self.fetch.announced(announced)
            if self.fetches.overheard is not None:
                self.fetches.overheard.announced(announced, now)
            self.reads.heard(message, now)
            return
        table = self.table
        if who.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA:
            if not name.isupper():
                name = _in_capitals(name)
                message = message._replace(param_id=name)
            if number == ParamType.REAL32 and index == NO_INDEX:
                message = table.with_known_type(message)
        if count != table.count and count <= PARAMETERS_MAX:
            self._count_moved(count, now)
        authors = self._authors
        writes = self.writes
        by = writes.author(name) if writes.queues else None
        is_ours = by is not None
        if by is None:
            by = authors.of(name, now) if authors.foreign_sets else "vehicle"
        is_wanted = is_ours and writes.wants(message)
        if is_ours and not is_wanted and authors.foreign_sets:
            by = authors.setter_of(name, message.raw, now) or by
        if self._checks:
            until = self._checks.ambiguous_until(message, now, is_wanted=is_wanted)
            if until > now:
                self._receive_ambiguous(message, until, now)
                return
        came_at = now if moment is None else moment
        change = table.hear(message, by, came_at, is_exact=is_wanted)
        if change is not None:
            authors.changed(name, now, is_ours)
            self._note_replaced(change, message, now)
            self.sync.changed(name, by, now)
            self._tell(change)
        elif name not in table.params:
            return  # more names than there can be
        fetch = self.fetches.current
        if fetch is not None:
            fetch.heard(message, now)
        elif not self.reads.awaits(message):
            self.following.heard(message, now)
        if writes.queues:
            writes.heard(message, now)
        self._value_heard(message, now)
        if self.name_searches:
            self.name_searches.heard(message, now)

    def boot_clock(self, message_id: int, boot_ms: int, now: float) -> None:
        """Take `time_boot_ms` of a message of telemetry that it sent."""
        self._clock_told(self.presence.boot_clock(message_id, boot_ms, now), now)

    def _clock_told(self, has_restarted: bool, now: float) -> None:
        if has_restarted:
            self._rebooted(now, by_clock=True)
        started_at = self.presence.started_at
        if started_at is not None and self.presence.clock_at == now:
            self.start_values.clock_told(now - started_at, now)

    def _numbering_began(self, silent_since: float, now: float) -> None:
        """Its frames may be numbered from 0 again, as after a start: its clock tells whether it is one.

        A fetch that was held up meanwhile does not wait for that.
        """
        if self.restarts.numbering_began(now):
            return
        self.clock_requests.want(now)
        if now - silent_since >= RESTART_SILENCE and self.fetches.seems_restarted(silent_since, now):
            self.following.forget()
            self._doubt()

    def _note_replaced(self, change: Change, message: ParamValue, now: float) -> None:
        """Remember the value before a change. PX4 has none on the way: it answers with the value of now."""
        old = change[1]
        if old is not None and self.who.autopilot != MAV_AUTOPILOT_PX4:
            bits, number, *_ = unpack_fields(old)
            raw = as_sent(bits, number, self.table.encoding)
            self._checks.replaced(change.name, number, raw, message, now, self.reads.sent_at)

    def _receive_ambiguous(self, message: ParamValue, until: float, now: float) -> None:
        """Take a PARAM_VALUE whose value may be older than the last change: only its index counts."""
        self.table.hear_index(message)
        self._checks.ask(message.param_id, until)
        fetch = self.fetches.current
        if fetch is not None:
            fetch.heard(message, now)
        elif not self.reads.awaits(message):
            self.following.heard(message, now)
        self.writes.defer(message, until)
        if self.fetches.overheard is not None:
            self.fetches.overheard.heard(message, now)
        self.reads.defer(message, until, now)

    def foreign_set(self, name: str, raw: bytes, station: str, now: float) -> None:
        """Another station was heard setting a parameter of this component to these four bytes."""
        if not is_portable_name(name):
            self.table.leave_out(name)
            return
        self._authors.foreign_set(self.spelling(name), station, now, raw)

    def foreign_file_request(self, message: FileTransfer, station: tuple[int, int], now: float) -> None:
        """Another station was heard asking for a file of this component."""
        self.files.foreign_at = now
        if self.fetches.overheard is not None:
            self.fetches.overheard.file.request_heard(message, station, now)

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
        """Take what the cache knows of this component. What was heard on this link stays as it is.

        Args:
            params: the cached table.
            now: the time.
            count: the param_count with it.
            confirmed: the hash under which the vehicle would confirm it, or None.
            complete, placed: whether it held every index below the count, and whether these still hold.
            volatile, volatile_known: as in `Table`.
            moments: when each value was observed last, in seconds as `now`.
        """
        if self.table.complete:
            return
        if count is not None and count > PARAMETERS_MAX:  # what an earlier version has believed
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

    def renew(self, params: Mapping[str, Param], moments: Mapping[str, float] | None = None) -> None:
        """Take what another station has heard since, where a value is only *cached* here.

        Args:
            params, moments: as in `use_cached`.
        """
        self._report(self.table.renew(params, moments))

    # what is asked of it

    def read(self, key: Key, now: float) -> Read:
        """Ask for one parameter; give it back with `reads.release`.

        Raises:
            NoReply: the component is lost. Nothing was sent.
        """
        what = key if isinstance(key, str) else f"parameter {key}"
        self.check_present(f"{what} of {self.system}/{self.component}", now)
        read = self.reads.ask(self.spelling(key) if isinstance(key, str) else key, now)
        read.is_of_caller = True
        return read

    def search(self, names: Iterable[str], now: float) -> NameSearch:
        """Search for parameters that may not exist; give it back with `name_searches.cancel`.

        Raises:
            NoReply: the component is lost. Nothing was sent.
        """
        self.check_present(f"names of {self.system}/{self.component}", now)
        return self.name_searches.begin(names, now)

    def write(
        self,
        name: str,
        value: Value,
        now: float,
        asker: str | None = None,
        *,
        settle: float = 0.0,
        force: bool = False,
    ) -> Write:
        """Write one parameter, for somebody.

        Args:
            name, value, asker: as in `Component.set`.
            now: the time.
            settle: seconds from the acknowledgement until the value is read once more.
            force: send NaN and infinity also to an autopilot that cannot store them.

        Raises:
            UsageError: the type is known and the value does not fit it, or the autopilot cannot store it.
                Nothing was sent.
            NoReply: the component is lost. Nothing was sent.
        """
        self.check_present(f"PARAM_SET {name} to {self.system}/{self.component}", now)
        for each in (self, *self._autopilots()):
            if each.who.is_unconfirmed:
                each.who.doubt(now)
        name = self.spelling(name)
        known = self.table.params.get(name)
        if known is not None and known.trust is not Trust.CACHED and self.may_be_written:
            encode(value, known.type, self.table.encoding)
        self.writes.check_finite(name, value, force=force)
        write = self.writes.set(name, value, now, asker, settle=settle, force=force)
        write.on_done.append(lambda: self._write_ended(write))
        return write

    def begin_restart(self, now: float, *, returns: bool = True) -> Restart:
        """Tell it to start again, or join the one under way; give it back with `end_restart`.

        Args:
            now: the time.
            returns: whether it comes back under its address, see `Restart`.

        Raises:
            NoReply: the component is lost. Nothing was sent.
        """
        if not self.restarts.is_under_way:
            self.check_present(f"the restart of {self.system}/{self.component}", now)
        self._read_clock(now)
        self.start_values.stop()
        return self.restarts.begin(now, returns=returns)

    def end_restart(self, restart: Restart, now: float) -> None:
        """Wait for it no longer. The last one who waited ends it; whether it is obeyed is then not known."""
        self.restarts.end(restart, now)

    def begin_fetch(
        self,
        now: float,
        *,
        refresh: bool = False,
        listed: bool = False,
        by_list: bool = False,
        check: Check | None = None,
        sampled: Sampled | None = None,
    ) -> Fetch:
        """Begin a fetch, or join the one under way; give it back with `end_fetch`.

        Args:
            now: the time.
            refresh: download even if the vehicle's hash would confirm the cached table.
            listed: the list has been asked for already, of all components at once.
            by_list: download by list also where the vehicle serves the file.
            check: how, where nobody waits for it but the watch.
            sampled: the sample that may settle it where there is no hash, or None.

        Raises:
            ContestedAddress: several vehicles have its address.
            NoReply: the component is lost, and no fetch is under way. Nothing was sent.
        """
        self.check_uncontested()
        if self.fetch is None and self._policy is not Policy.CACHE_ONLY:
            self.check_present(f"the parameters of {self.system}/{self.component}", now)
        return self.fetches.begin(
            now, refresh=refresh, listed=listed, by_list=by_list, check=check, sampled=sampled
        )

    def end_fetch(self, fetch: Fetch, now: float) -> None:
        """Wait for it no longer. The last one who waited cancels it."""
        self.fetches.end(fetch, now)

    def spelling(self, name: str) -> str:
        """The name as the vehicle has it. ArduPilot answers to any case; its own names have capitals only."""
        return _in_capitals(name) if self.who.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA else name

    def check_present(self, what: str, now: float) -> None:
        """See whether it can be asked for something.

        Raises:
            UsageError: nothing may be sent.
            ContestedAddress: several vehicles have its address.
            NoReply: it is lost.
        """
        if self._listens_only:
            raise UsageError(
                f"{what} cannot be asked for where nothing is sent; what has been heard is in `params`"
            )
        self.check_uncontested()
        if self.presence.is_lost:
            silence = now - self.presence.heard_at
            raise NoReply(f"{what} (lost)", attempts=0, waited=silence)

    def check_uncontested(self) -> None:
        """See whether one vehicle alone has the address, and that of its autopilot.

        Raises:
            ContestedAddress: several have it.
        """
        for each in (self, *self._autopilots()):
            if each.peers.contest is not None:
                raise each.peers.contest.error

    # peers

    def peer_moved(self, claim: Claim, now: float, verdict: Verdict) -> None:
        """Another peer has the address now, and is asked who it is."""
        if verdict is Verdict.OTHER:
            self._replaced(now)
        else:
            if verdict is Verdict.OPEN:
                self._doubt()
                self.sync.check(now)
            self.who.doubt(now)
        self._take_claim(claim, now)
        self.clock_requests.want(now)

    def contest_began(self, contest: Contest, now: float) -> None:
        """Several vehicles have the address: whoever waits for one of them gets the error."""
        self._observer.contested(self, contest)
        self.fail_all(contest.error, now)
        self._forget_companions(contest.error, now)

    def contest_ended(self, claim: Claim, now: float, *, is_same: bool) -> None:
        """One vehicle has the address: it is asked who it is before anything counts or is kept."""
        if is_same:
            self._doubt()
            self.who.doubt(now)
            what = f"the components of system {self.system}: it is being asked which vehicle it is"
            self._forget_companions(NoReply(what, attempts=0, waited=0.0), now)
        else:
            self._replaced(now)
        self._observer.uncontested(self)
        self._known_as = None
        self.sync.check(now)
        self._take_claim(claim, now)
        self.clock_requests.want(now)

    def _forget_companions(self, error: ParamClientError, now: float) -> None:
        """Where the autopilot was contested, its other components may have been heard from either vehicle."""
        if self.who.is_autopilot:
            for each in self._vehicle():
                if each is not self and each.who.has_parameters:
                    each.fail_all(error, now)
                    each.become_another(now)

    def _replaced(self, now: float) -> None:
        """Another vehicle has the address: with an autopilot go the components of its vehicle."""
        is_autopilot = self.who.is_autopilot
        self.who.forget(now)
        if is_autopilot:
            self._another(now)
        else:
            self.become_another(now)

    def _take_claim(self, claim: Claim, now: float) -> None:
        """Take what a peer has said of itself before its messages counted."""
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
        """When `tick` has something to do, or infinity."""
        first = min(self.presence.lost_at(), self.peers.next_deadline())
        if self.peers.contest is not None:
            return first
        for machine in self._machines:
            deadline = machine.next_deadline()
            if deadline < first:
                first = deadline
        return first

    def resume(self, now: float) -> None:
        """The link was away and is back: whatever waits for an answer is asked for again."""
        self.round_trip.heard_at = now
        if not self.presence.is_lost:
            if self.presence.was_away(silence := self.presence.heard(now)):
                self._doubt()
                self.sync.check(now)
            elif self.identity.uid is not None:
                self.who.doubt(now)  # it may be another one that was plugged in
            self._was_silent(silence, now)
        for machine in self._machines:
            machine.resume(now)

    def fail_all(self, error: ParamClientError, now: float) -> None:
        """The link is gone for good, or the address is contested: every operation ends with the error."""
        for machine in reversed(self._machines):
            machine.fail_all(error, now)

    def become_another(self, now: float) -> None:
        """Another vehicle has taken this system id: nothing that is known is about it."""
        self._report(self.table.forget())
        self._observer.replaced(self)
        self.sync.forget()
        self.fetches.forget()
        self.following.forget()
        self._checks.clear()
        self._known_as = None
        self.restarts.another(now)
        self.commands.lose(now, ": another vehicle answers there now")
        self.name_searches.lose(now)
        what = f"writes to {self.system}/{self.component}: another vehicle answers there now"
        self.writes.fail_all(NoReply(what, attempts=0, waited=0.0), now)
        if self.fetch is not None:
            self.fetch.restart(now)

    def __repr__(self) -> str:
        kind = "unknown" if self.who.autopilot is None else autopilot_name(self.who.autopilot)
        return f"<ComponentMachine {self.system}/{self.component} {kind} {self.state}>"

    def _heard(self, now: float, version: int) -> None:
        """Anything has come."""
        presence = self.presence
        silence = presence.heard(now)
        self.round_trip.heard_at = now
        if silence >= presence.gap or presence.is_lost:
            self._was_silent(silence, now)
        if version > self.version:
            self.version = version

    def _count_moved(self, count: int, now: float) -> None:
        if self.table.count is not None:
            self.sync.count_moved(now)
        self.table.move(count)

    def _doubt(self) -> None:
        """What is known may be of the past: it counts again when the vehicle has confirmed it."""
        self.table.doubt(Trust.LIVE, Trust.VERIFIED)
        self.sync.doubt()
        if self.fetch is not None:
            self.fetch.doubt()
        if self.fetches.overheard is not None:
            self.fetches.overheard.forget()

    def _lose(self, now: float) -> None:
        """It is not heard any more. A fetch goes on for a while: it may only be starting again."""
        presence = self.presence
        presence.is_lost = True
        self._observer.lost(self, now - presence.heard_at)
        for machine in reversed(self._machines):
            machine.lose(now)
        self._doubt()

    def _was_silent(self, silence: float, now: float) -> None:
        """It is heard again. After a while, who it is and its hash are asked for before anything counts."""
        presence = self.presence
        if presence.is_lost or silence == math.inf:
            presence.since = now
        if presence.is_lost:
            presence.is_lost = False
            self.reads.forgive()  # the silence of before says nothing of it
            self._observer.found(self, silence)
            self.sync.check(now)
            self.who.doubt(now)
        elif presence.was_away(silence) and silence < math.inf:
            self.who.doubt(now)
        self.restarts.silent(silence, now)
        if presence.has_beaten:  # else nothing says when it should have been heard
            self.sync.silence(now)

    def _restart_noticed(self, now: float) -> None:
        """It has started again on command, and its clock has not shown that, or not by going back."""
        self.presence.forget_clock(now)
        self._rebooted(now)

    def _rebooted(self, now: float, *, by_clock: bool = False) -> None:
        """The vehicle has started again: what it had not saved is gone, and its list begins anew."""
        self._observer.rebooted(self)
        self.fetches.interrupt(now)
        self.start_values.restarted(now, by_clock=by_clock)
        started_at = self.presence.started_at if by_clock else None
        is_of_this_run = started_at is not None and self.fetches.are_since(started_at)
        if not is_of_this_run:
            self._doubt()
        self.following.forget()
        self.rereads.clear()
        self.sync.check(now)
        self.who.doubt(now)
        self.restarts.rebooted(now)
        if not by_clock:
            self.clock_requests.want(now)
        if self.fetch is not None and self.fetch.is_under_way and not is_of_this_run:
            self.fetch.restart(now)

    def _follow_identity(self, now: float) -> None:
        """What the identification has come to know takes effect."""
        self._report(self.table.use_encoding(self.who.encoding))
        autopilot = self.who.autopilot
        self.reads.pace.is_batched = autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA
        name = autopilot_name(MAV_AUTOPILOT_PX4 if autopilot is None else autopilot)  # it may be one
        self.writes.against_non_finite = reason_against_non_finite(name)
        if self.fetch is not None:
            self.fetch.look(now)
        if self.who.settled and self._known_as != self.identity.key:
            self._known_as = self.identity.key
            self._observer.identified(self)
            if self.who.is_autopilot:
                self.clock_requests.want_baseline(now)
        if self.writes.is_held and self.may_be_written:
            self.writes.proceed(now)
        elif self.writes.queues:
            self._fail_unconfirmed(now)

    def _fail_unconfirmed(self, now: float) -> None:
        """Nothing is written where it was asked in vain which vehicle it is, or that of its autopilot."""
        for each in (self, *self._autopilots()):
            if each.who.is_unconfirmed:
                what = f"{each.system}/{each.component} has not said since it was away which vehicle it is"
                waited = now - each.who.doubted_at
                self.writes.fail_all(NoReply(what, attempts=each.who.attempts, waited=waited), now)

    def _doubt_identity(self, now: float) -> None:
        """The table is not what it was: it may be another vehicle that answers by now."""
        if self.who.settled and now - self.who.known_at > FRESH_IDENTITY:
            self.who.ask_again(now)

    def _moved(self, changes: list[Change]) -> None:
        """What a fetch has found out otherwise than by a PARAM_VALUE."""
        for change in changes:
            self.sync.changed(change.name, change.by)
        self._report(changes)

    def _write_ended(self, write: Write) -> None:
        now = write.ended_at
        self.restarts.write_ended(now)
        self.sync.write_ended(now)
        self.rereads.write_ended(write, now)

    def resynced(self, changed: tuple[str, ...], confirmed: int | None) -> None:
        """Report that the table agrees with the vehicle's again."""
        self._observer.resynced(self, changed, confirmed)

    def _fetched(self, result: FetchResult) -> None:
        self._observer.fetched(self, result)

    def _report(self, changes: list[Change]) -> None:
        for change in changes:
            self._tell(change)

    def _tell(self, change: Change) -> None:
        if self.tells_changes:
            self._observer.changed(self, change)
        elif not self.has_moved:
            self.has_moved = True
            self._observer.moved(self)


def _in_capitals(name: str) -> str:
    """The name with capitals for its ASCII letters. Of others, as damage may bring them, the capital may be
    two letters or none that a message can hold.
    """
    return name.encode("latin-1").upper().decode("latin-1")


_WRITE_DENIED = re.compile(r"Param write denied \((\w{1,16})\)")
