"""The machines that one component consists of, joined with each other, and how it stands by them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator

from paramclient.errors import ParamClientError
from paramclient.model.identity import Identity
from paramclient.model.values import Encoding
from paramclient.protocol.addresses import Address, Peer, PeerAddress, peer_in_words
from paramclient.protocol.events import Event
from paramclient.protocol.ftp import FileTransfers
from paramclient.protocol.params.boot_values import StartValues
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.change_origin import Authors
from paramclient.protocol.params.fetch import Check, Fetch
from paramclient.protocol.params.fetch_queue import Fetches
from paramclient.protocol.params.fetch_result import FetchResult, Means, Policy, Sampled
from paramclient.protocol.params.foreign_list import Following
from paramclient.protocol.params.name_search import NameSearches
from paramclient.protocol.params.reads import Key, Reads
from paramclient.protocol.params.sync import LOW_BANDWIDTH_GAP, Sync, SyncState, Upkeep
from paramclient.protocol.params.sync_interval import CheckPace
from paramclient.protocol.params.table import Room, Table
from paramclient.protocol.params.value_check import ValueChecks
from paramclient.protocol.params.volatile_values import Refresh
from paramclient.protocol.params.writes import Writes
from paramclient.protocol.requests.round_trip import RoundTrip
from paramclient.protocol.scheduler import Turns
from paramclient.protocol.stats.trace import Trace, silent
from paramclient.protocol.vehicle.boot_time_requests import ClockRequests
from paramclient.protocol.vehicle.claims import Claim, Verdict
from paramclient.protocol.vehicle.commands import Commands
from paramclient.protocol.vehicle.identification import Identification
from paramclient.protocol.vehicle.metadata_location import Descriptions
from paramclient.protocol.vehicle.peers import NO_PEER, ComponentPeers, Contest
from paramclient.protocol.vehicle.presence import Presence
from paramclient.protocol.vehicle.reboot import Restart
from paramclient.protocol.wire import MAV_AUTOPILOT_ARDUPILOTMEGA, MAV_AUTOPILOT_PX4, Message

__all__ = ["Parts"]


class Parts(ABC):
    """What one component consists of. `ComponentMachine` says what happens to it; arguments and attributes
    are described there.
    """

    def __init__(
        self,
        system: int,
        component: int,
        *,
        own: tuple[int, int],
        link: str,
        send: Callable[[Message], None],
        emit: Callable[[Event], None],
        send_to: Callable[[Message, Peer], None] | None = None,
        encoding: Encoding | None = None,
        upkeep: Upkeep | None = None,
        is_link_busy: Callable[[], bool] = lambda: False,
        vehicle: Callable[[], Iterable[Parts]] = lambda: (),
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
        self.round_trip = RoundTrip()
        self.who = Identification(
            target, link, self.round_trip, send, encoding, may_ask=not upkeep.listens_only
        )
        self.table = Table(self.who.encoding, room)
        self.turns = Turns() if turns is None else turns
        self.reads = Reads(target, self.round_trip, send, self._is_known, self.turns.share, trace)
        self.writes = Writes(
            target,
            self.round_trip,
            send,
            self.reads,
            self.table.params,
            encoding=lambda: self.table.encoding,
            is_certain=lambda: self.may_be_written,
            trace=trace,
        )
        self.presence = Presence()
        self.peers = ComponentPeers(target, self, may_ask=not upkeep.listens_only)
        self.files = FileTransfers(
            target,
            own,
            self.round_trip,
            send,
            keeps_session=lambda: self.who.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA,
        )
        check_pace = CheckPace(upkeep.interval, is_chosen=upkeep.without_hash)
        self.sync = Sync(
            self.reads,
            self.table,
            upkeep,
            check_pace,
            is_px4=lambda: self.who.autopilot == MAV_AUTOPILOT_PX4,
            is_writing=lambda: len(self.writes) > 0,
            is_fetching=lambda: self.fetch is not None,
            is_busy=is_link_busy,
            may_use_file=lambda: self.fetches.may_use_file(),
            file_is_in_use=self.files.is_in_use,
            is_spared=lambda: self._is_spared,
            is_doubted=lambda: self.who.is_doubted,
            begin_fetch=lambda now, check: self.begin_fetch(now, refresh=check is not None, check=check),
            end_fetch=self.end_fetch,
            resynced=self._resynced,
        )
        self.descriptions = Descriptions(
            target, own, self.round_trip, send, is_identifying=lambda: self.who.is_asking
        )
        self.commands = Commands(target, own, self.round_trip, send)
        self.clock_requests = ClockRequests(
            target,
            self.presence,
            send,
            is_requesting=lambda: self.who.is_asking or self.descriptions.is_asking,
            may_send=not upkeep.listens_only,
        )
        self.start_values = StartValues(
            self.reads,
            self.table,
            is_wanted=lambda: self._may_read_start_values,
            is_fetching=lambda: self.fetch is not None,
            fetch_file=self.sync.fetch_quick_file,
        )
        self.restart: Restart | None = None
        self.following = Following()
        self.fetches = Fetches(
            Means(
                target,
                self.round_trip,
                send,
                self.reads,
                self.table,
                self.turns,
                self.files,
                expects_hash=lambda: self.sync.expects_hash,
                adds_defaults=lambda: self.who.adds_defaults,
                changed=self._moved,
                doubt=self._doubt_identity,
                following=self.following,
                trace=trace,
            ),
            self.sync,
            upkeep,
            check_pace,
            says_file=lambda: self.who.says_file,
            ended=self._fetched,
        )
        self.name_searches = NameSearches(
            target,
            self.round_trip,
            self.reads,
            send,
            count=lambda: self.table.count,
            is_listing=self._is_listing,
        )
        # where nothing is asked there are no reads: what others ask for is heard in their place
        overheard = self.fetches.overheard
        self._value_heard = self.reads.heard if overheard is None else overheard.heard
        self._own = own
        self._emit = emit
        self._send_to = send_to or (lambda message, peer: send(message))
        self._policy = upkeep.policy
        self._is_kept_up = upkeep.interval < math.inf and upkeep.policy is Policy.AUTO
        self._listens_only = upkeep.listens_only
        self._another = another or self.become_another
        self._read_clock = read_clock
        self._vehicle = vehicle
        self._known_as: str | None = None  # the key of the identity that was reported
        self._saved_at = -math.inf  # when all that we have written will have been saved
        self._authors = Authors()
        self._checks = ValueChecks()
        self.tells_changes = True
        self.has_moved = False
        self.writes.left_open = self._authors.foreign_set

    @abstractmethod
    def begin_fetch(
        self,
        now: float,
        *,
        refresh: bool = False,
        listed: bool = False,
        check: Check | None = None,
        sampled: Sampled | None = None,
    ) -> Fetch:
        """Begin a fetch, or join the one under way; give it back with `end_fetch`."""

    @abstractmethod
    def end_fetch(self, fetch: Fetch, now: float) -> None:
        """Wait for it no longer."""

    @abstractmethod
    def peer_moved(self, claim: Claim, now: float, verdict: Verdict) -> None:
        """Another peer has the address now."""

    @abstractmethod
    def contest_began(self, contest: Contest, now: float) -> None:
        """Several vehicles have the address."""

    @abstractmethod
    def contest_ended(self, claim: Claim, now: float, *, is_same: bool) -> None:
        """One vehicle has the address."""

    @abstractmethod
    def fail_all(self, error: ParamClientError, now: float) -> None:
        """Every operation ends with the error."""

    @abstractmethod
    def become_another(self, now: float) -> None:
        """Another vehicle has taken this system id."""

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

    def _autopilots(self) -> Iterator[Parts]:
        """The autopilot that it belongs to, where that is another component."""
        return (each for each in self._vehicle() if each is not self and each.who.is_autopilot)

    @property
    def is_restarting(self) -> bool:
        """Whether it was told to start again, and that is awaited."""
        return self.restart is not None and not self.restart.done

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
        is_asked = is_asked or len(self.commands) > 0 or self.restart is not None
        is_asked = is_asked or self.descriptions.is_asking or len(self.name_searches) > 0
        return is_asked or self.fetch is not None or self.who.is_asking

    @property
    def is_settling(self) -> bool:
        """Whether a write is under way, or the hash after one has not come yet."""
        return len(self.writes) > 0 or self.sync.is_settling

    @property
    def _is_spared(self) -> bool:
        """Whether it is lost, or in a mode in which nothing is asked of it unasked."""
        presence = self.presence
        return presence.is_lost or presence.is_high_latency or self.reads.pace.gap >= LOW_BANDWIDTH_GAP

    @property
    def _may_read_start_values(self) -> bool:
        """Whether what is measured at each start is to be read again without being asked."""
        return self._is_kept_up and not self.sync.expects_hash and not self._is_spared

    def _is_listing(self, now: float) -> bool:
        """Whether a list comes, for us or for another station."""
        reads = self.reads
        is_ours = reads.list_runs_again or not reads.is_idle or now < reads.list_until
        return is_ours or self.following.is_running(now)

    def _is_known(self, key: Key) -> bool:
        """Whether anything speaks for such a parameter."""
        if isinstance(key, str):
            return key in self.table.params
        return self.table.count is None or key < self.table.count

    @abstractmethod
    def _moved(self, changes: list[Change]) -> None:
        """A fetch has found out something otherwise than by a PARAM_VALUE."""

    @abstractmethod
    def _doubt_identity(self, now: float) -> None:
        """A fetch has found out that the table is not what it was."""

    @abstractmethod
    def _resynced(self, changed: tuple[str, ...], confirmed: int | None) -> None:
        """The table agrees with the vehicle's again."""

    @abstractmethod
    def _fetched(self, result: FetchResult) -> None:
        """A fetch has ended with a result."""
