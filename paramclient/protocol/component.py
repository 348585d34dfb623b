"""One component: what is known of it, its table, and the exchanges with it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

from paramclient.errors import LinkError, NoReply
from paramclient.identity import Identity, autopilot_name
from paramclient.protocol.authors import Authors
from paramclient.protocol.events import (
    ComponentFound,
    ComponentIdentified,
    ComponentLost,
    ComponentRebooted,
    Event,
    Fetched,
    ParamChanged,
    TableResynced,
)
from paramclient.protocol.fetch import Fetch, FetchResult, Policy
from paramclient.protocol.identify import Identification
from paramclient.protocol.presence import Presence
from paramclient.protocol.reads import Key, Read, Reads
from paramclient.protocol.refresh import Refresh
from paramclient.protocol.sync import LOW_BANDWIDTH_GAP, Sync, SyncState, Upkeep
from paramclient.protocol.table import Change, Table
from paramclient.protocol.timing import RoundTrip
from paramclient.protocol.wire import (
    HASH_CHECK,
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_PX4,
    NO_INDEX,
    AutopilotVersion,
    CommandAck,
    Heartbeat,
    HighLatency2,
    Message,
    ParamError,
    ParamValue,
    StatusText,
    SystemTime,
)
from paramclient.protocol.writes import Write, Writes
from paramclient.values import Encoding, Param, Trust, Value, encode

__all__ = ["ComponentMachine"]

FRESH_IDENTITY: Final = 1.0
"""Seconds for which an AUTOPILOT_VERSION needs no other."""


class ComponentMachine:
    """Everything about one component that needs no clock and no socket.

    Args:
        system, component: who it is.
        own: system and component that we send as.
        link: the link's canonical name, part of an identity without a hardware id.
        send: takes each message for it, in order.
        emit: takes each event.
        encoding: what the user said about its encoding, or None.
        upkeep: what is done for its table without being asked.
        is_link_busy: whether anything is being asked for on the link.
        another: is told that another vehicle has taken the system id; by default `become_another`.

    Attributes:
        version: the MAVLink version that it speaks, as far as heard.
        who: its identity, and how it writes values.
        table: its parameters.
        round_trip: what its answers tell of the link.
        presence: whether it is there.
        sync: whether the table is still the vehicle's.
        fetch: the fetch under way, or None.
        last_fetch: the result of the last one that ended, or None.
        refresh: the reading of volatile values under way after a hash hit, or None.
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
        encoding: Encoding | None = None,
        upkeep: Upkeep | None = None,
        is_link_busy: Callable[[], bool] = lambda: False,
        another: Callable[[float], None] | None = None,
    ) -> None:
        target = (system, component)
        upkeep = upkeep or Upkeep()
        self.system = system
        self.component = component
        self.version = 1
        self.round_trip = RoundTrip()
        self.who = Identification(target, link, self.round_trip, send, encoding)
        self.table = Table(self.who.encoding)
        self.reads = Reads(target, self.round_trip, send, self._is_known)
        self.writes = Writes(
            target,
            self.round_trip,
            send,
            self.reads,
            self.table.params,
            encoding=lambda: self.table.encoding,
            is_certain=lambda: self.who.may_be_written,
        )
        self.presence = Presence()
        self.sync = Sync(
            self.reads,
            self.table,
            upkeep,
            is_px4=lambda: self.who.autopilot == MAV_AUTOPILOT_PX4,
            is_writing=lambda: len(self.writes) > 0,
            is_fetching=lambda: self.fetch is not None,
            is_busy=is_link_busy,
            is_spared=lambda: self._is_spared,
            begin_fetch=lambda now, refresh: self.begin_fetch(now, refresh=refresh),
            end_fetch=self.end_fetch,
            confirmed=self._refresh_unhashed,
            resynced=lambda changed, confirmed: emit(TableResynced(self, changed, confirmed)),
        )
        self.fetch: Fetch | None = None
        self.last_fetch: FetchResult | None = None
        self.refresh: Refresh | None = None
        self._own = own
        self._send = send
        self._emit = emit
        self._policy = upkeep.policy
        self._another = another or self.become_another
        self._known_as: str | None = None  # the key of the identity that was reported
        self._may_write = False
        self._authors = Authors()

    # what comes in

    def receive(self, message: Message, now: float, *, version: int = 2) -> None:
        """Take a message that this component sent."""
        silence = self.presence.heard(now)
        self.round_trip.heard_at = now
        if self.presence.is_lost:
            self._find(silence, now)
        if version > self.version:
            self.version = version
        if isinstance(message, ParamValue):
            self._receive_value(message, now)
        elif isinstance(message, Heartbeat):
            self.who.heartbeat(message)
            if self.presence.heartbeat(message, now):
                self._rebooted(now)
            self.sync.silence(silence, now)
            self._authors.forget(now)
        elif isinstance(message, AutopilotVersion):
            if self.who.version(message, now):
                self._another(now)
        elif isinstance(message, ParamError):
            addressee = (message.target_system, message.target_component)
            if addressee in (self._own, (0, 0)) and not self.writes.refused(message, now):
                self.reads.refused(message, now)
        elif isinstance(message, CommandAck):
            self.who.acknowledged(message, now)
        elif isinstance(message, StatusText):
            denied = _WRITE_DENIED.search(message.text)
            if denied:
                self.writes.denied(denied.group(1), now)
        elif isinstance(message, SystemTime):
            if self.presence.system_time(message):
                self._rebooted(now)
        elif isinstance(message, HighLatency2):
            self.who.heartbeat(message)
            self.presence.high_latency()
        if self.presence.was_away(silence):
            self.who.doubt(now)
        else:
            self.who.heard(now)
        if not isinstance(message, ParamValue):  # a value tells nothing of who it is
            self._follow_identity(now)

    def foreign_set(self, name: str, station: str, now: float) -> None:
        """Another station was heard setting a parameter of this component."""
        self._authors.foreign_set(self.spelling(name), station, now)

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
    ) -> None:
        """Take what the cache knows of this component. What was heard on this link stays as it is.

        Args:
            params: the cached table.
            now: the time.
            count: the param_count with it.
            confirmed: the hash under which the vehicle would confirm it, or None.
            complete: whether it held every index below the count.
            volatile, volatile_known: as in `Table`.
        """
        if self.table.complete:
            return
        changes = self.table.restore(
            params,
            count=count,
            confirmed=confirmed,
            complete=complete,
            volatile=volatile,
            volatile_known=volatile_known,
        )
        self._report(changes)
        self.sync.compare(now)

    # what is asked of it

    def read(self, key: Key, now: float) -> Read:
        """Ask for one parameter; give it back with `reads.release`.

        Raises:
            NoReply: the component is lost. Nothing was sent.
        """
        what = key if isinstance(key, str) else f"parameter {key}"
        self._check_present(f"{what} of {self.system}/{self.component}", now)
        read = self.reads.ask(self.spelling(key) if isinstance(key, str) else key, now)
        read.is_of_caller = True
        return read

    def write(self, name: str, value: Value, now: float) -> Write:
        """Write one parameter.

        Raises:
            UsageError: the type is known and the value does not fit it. Nothing was sent.
            NoReply: the component is lost. Nothing was sent.
        """
        self._check_present(f"PARAM_SET {name} to {self.system}/{self.component}", now)
        name = self.spelling(name)
        known = self.table.params.get(name)
        if known is not None and known.trust is not Trust.CACHED and self.who.may_be_written:
            encode(value, known.type, self.table.encoding)
        write = self.writes.set(name, value, now)
        write.on_done.append(lambda: self.sync.write_ended(write.ended_at))
        return write

    def begin_fetch(self, now: float, *, refresh: bool = False, listed: bool = False) -> Fetch:
        """Begin a fetch, or join the one under way; give it back with `end_fetch`.

        Args:
            now: the time.
            refresh: download even if the vehicle's hash would confirm the cached table.
            listed: the list has been asked for already, of all components at once.

        Raises:
            NoReply: the component is lost, and no fetch is under way. Nothing was sent.
        """
        fetch = self.fetch
        if fetch is None and self._policy is not Policy.CACHE_ONLY:
            self._check_present(f"the parameters of {self.system}/{self.component}", now)
        if fetch is not None and refresh and fetch.download is None:
            fetch.restart(now)
        if fetch is None:
            fetch = self.fetch = Fetch(
                (self.system, self.component),
                self.round_trip,
                self._send,
                self.reads,
                self.table,
                now,
                announced=self.sync.announced,
                expects_hash=lambda: self.sync.expects_hash,
                refresh=refresh,
                listed=listed,
                policy=self._policy,
                changed=self._report,
                doubt=self._doubt_identity,
            )
            if fetch.done:
                self._fetch_ended(fetch)
            else:
                begun = fetch
                fetch.on_done.append(lambda: self._fetch_ended(begun))
        fetch.holders += 1
        return fetch

    def end_fetch(self, fetch: Fetch) -> None:
        """Wait for it no longer. The last one who waited cancels it."""
        fetch.holders -= 1
        if fetch.holders <= 0 and not fetch.done:
            fetch.cancel()
            if self.fetch is fetch:
                self.fetch = None

    def spelling(self, name: str) -> str:
        """The name as the vehicle has it. ArduPilot answers to any case; its own names have capitals only."""
        return name.upper() if self.who.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA else name

    # time

    def tick(self, now: float) -> None:
        """Do what is due."""
        if self.presence.lost_at() <= now:
            self._lose(now)
        self.reads.tick(now)
        self.writes.tick(now)
        if self.fetch is not None:
            self.fetch.tick(now)
        self.who.tick(now)
        self._follow_identity(now)
        self.sync.tick(now)
        for name in self._authors.doubted(now):
            self.reads.ask(name, now, urgent=False)

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity."""
        return min(
            self.reads.next_deadline(),
            self.writes.next_deadline(),
            math.inf if self.fetch is None else self.fetch.next_deadline(),
            self.who.next_deadline(),
            self.sync.next_deadline(),
            self.presence.lost_at(),
            self._authors.next_deadline(),
        )

    def resume(self, now: float) -> None:
        """The link was away and is back: whatever waits for an answer is asked for again."""
        # it could not be heard while the link was away
        if now - self.presence.heard_at >= self.presence.patience and not self.presence.is_lost:
            self._doubt()
            self.sync.check(now)
        self.presence.heard_at = self.round_trip.heard_at = now
        self.reads.resume(now)
        self.writes.resume(now)
        if self.fetch is not None:
            self.fetch.resume(now)

    def fail_all(self, error: LinkError, now: float) -> None:
        """The link is gone for good: everyone who waits gets its error."""
        if self.fetch is not None:
            self.fetch.cancel()
            self.fetch.fail(error, now)
        if self.refresh is not None:
            self.refresh.fail(error, now)
        self.writes.fail_all(error, now)
        self.reads.fail_all(error, now)
        self.sync.stop()
        self._authors.clear()

    def become_another(self, now: float) -> None:
        """Another vehicle has taken this system id: nothing that is known is about it."""
        self._report(self.table.remove(lambda param: True))
        self.table.unconfirm()
        self.table.volatile = frozenset()
        self.table.volatile_known = False
        self.table.count = None
        self.table.complete = False
        self.sync.forget()
        self._known_as = None
        what = f"writes to {self.system}/{self.component}: another vehicle answers there now"
        self.writes.fail_all(NoReply(what, attempts=0, waited=0.0), now)
        if self.fetch is not None:
            self.fetch.restart(now)

    # how it stands

    @property
    def identity(self) -> Identity:
        """Who the vehicle is, as far as this component has said."""
        return self.who.identity

    @property
    def state(self) -> str:
        """The table's state in a word: new, cached, fetching, synced, partial, lost."""
        if self.presence.is_lost:
            return "lost"
        if self.fetch is not None:
            return "fetching"
        if self.sync.synced:
            return "synced"
        if not self.table.params:
            return "new"
        return "cached" if self.table.complete else "partial"

    @property
    def sync_state(self) -> SyncState:
        """How the table stands to the vehicle's."""
        return SyncState.LOST if self.presence.is_lost else self.sync.state

    @property
    def can_hit(self) -> bool:
        """Whether the vehicle's hash may confirm the table as it stands."""
        return self.table.complete and self.table.hash is not None

    @property
    def is_waiting(self) -> bool:
        """Whether an answer is awaited: to a read, a write or a fetch, or to the question who it is."""
        return len(self.reads) > 0 or len(self.writes) > 0 or self.fetch is not None or self.who.is_asking

    @property
    def is_settling(self) -> bool:
        """Whether a write is under way, or the hash after one has not come yet."""
        return len(self.writes) > 0 or self.sync.is_settling

    def __repr__(self) -> str:
        kind = "unknown" if self.who.autopilot is None else autopilot_name(self.who.autopilot)
        return f"<ComponentMachine {self.system}/{self.component} {kind} {self.state}>"

    # private

    def _receive_value(self, message: ParamValue, now: float) -> None:
        name, _, _, count, _ = message
        if not name:
            return
        if name == HASH_CHECK:
            announced = self.sync.hash_heard(message, now)
            if self.fetch is not None:
                self.fetch.announced(announced)
            self.reads.heard(message, now)
            return
        if self.who.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA and not name.isupper():
            name = name.upper()
            message = message._replace(param_id=name)
        table = self.table
        if count != table.count and count != NO_INDEX:
            self._count_moved(count, now)
        is_writing = len(self.writes) > 0
        is_ours = is_writing and name in self.writes
        change = table.hear(message, "us" if is_ours else self._authors.of(name, now))
        if change is not None:
            self._authors.changed(name, now, is_written=is_ours)
            self.sync.changed(change)
            self._emit(_new(ParamChanged, (self, change)))
        elif name not in table.params:
            return  # more names than there can be
        if self.fetch is not None:
            self.fetch.heard(message, now)
        if is_writing:
            self.writes.heard(message, now)
        self.reads.heard(message, now)

    def _count_moved(self, count: int, now: float) -> None:
        if self.table.count is not None:
            self.table.count_moved()
            self.sync.count_moved(now)
        self.table.count = count

    @property
    def _is_spared(self) -> bool:
        """Whether it is in a mode in which nothing is asked of it unasked."""
        return self.presence.is_high_latency or self.reads.pace.stream_gap >= LOW_BANDWIDTH_GAP

    def _check_present(self, what: str, now: float) -> None:
        if self.presence.is_lost:
            silence = now - self.presence.heard_at
            raise NoReply(f"{what} (lost)", attempts=0, waited=silence)

    def _doubt(self) -> None:
        """What is known may be of the past: it counts again when the vehicle has confirmed it."""
        self.table.doubt()
        self.sync.doubt()

    def _lose(self, now: float) -> None:
        """It is not heard any more. A fetch goes on for a while: it may only be starting again."""
        presence = self.presence
        presence.is_lost = True
        silence = now - presence.heard_at
        self._doubt()
        self._emit(ComponentLost(self, silence))
        self.writes.lose(now)
        self.reads.lose(now)

    def _find(self, silence: float, now: float) -> None:
        """It is heard again: who it is and its hash are asked for before anything counts."""
        self.presence.is_lost = False
        self.reads.found()
        self._emit(ComponentFound(self, silence))
        self.sync.check(now)

    def _rebooted(self, now: float) -> None:
        """The vehicle has started again: what it had not saved is gone, and its list begins anew."""
        self._emit(ComponentRebooted(self))
        self._doubt()
        self._authors.clear()
        self.sync.check(now)
        self.who.doubt(now)
        if self.fetch is not None and self.fetch.download is not None and not self.fetch.download.done:
            self.fetch.restart(now)

    def _is_known(self, key: Key) -> bool:
        """Whether anything speaks for such a parameter."""
        if isinstance(key, str):
            return key in self.table.params
        return self.table.count is None or key < self.table.count

    def _follow_identity(self, now: float) -> None:
        """What the identification has come to know takes effect."""
        self._report(self.table.use_encoding(self.who.encoding))
        if self.who.settled and self._known_as != self.identity.key:
            self._known_as = self.identity.key
            self._emit(ComponentIdentified(self))
        may_write = self.who.may_be_written
        if may_write and not self._may_write:
            self.writes.proceed(now)
        self._may_write = may_write

    def _doubt_identity(self, now: float) -> None:
        """The table is not what it was: it may be another vehicle that answers by now."""
        if self.who.settled and now - self.who.known_at > FRESH_IDENTITY:
            self.who.ask_again(now)

    def _report(self, changes: list[Change]) -> None:
        for change in changes:
            self._emit(ParamChanged(self, change))

    def _fetch_ended(self, fetch: Fetch) -> None:
        self.fetch = None
        result = fetch.result
        if result is None:
            return
        self.last_fetch = result
        if result.source == "cache" and result.hash is None:
            return  # the vehicle was not asked, or has not confirmed it
        self.sync.fetched(result.complete and self.table.complete, result.hash, fetch.ended_at)
        self._emit(Fetched(self, result))
        if result.source == "cache" and result.hash is not None:
            self._refresh_unhashed(result.hash, fetch.ended_at)

    def _refresh_unhashed(self, confirmed: int, now: float) -> None:
        """Read what the hash says nothing about."""
        refresh = Refresh(self.reads, self.table, confirmed, lambda: len(self.writes) > 0, now)
        if refresh.done:
            return
        self.refresh = refresh
        refresh.on_done.append(partial(self._refresh_ended, refresh))

    def _refresh_ended(self, refresh: Refresh) -> None:
        if self.refresh is refresh:
            self.refresh = None


_new = tuple.__new__  # what a named tuple's own constructor ends in, after twice the time
_WRITE_DENIED = re.compile(r"Param write denied \((\w{1,16})\)")
