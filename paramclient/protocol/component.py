"""One component: what is known of it, its table, and the exchanges with it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple, TypeAlias

from paramclient.errors import LinkError, NoReply, UnknownParameter
from paramclient.identity import Identity, autopilot_name
from paramclient.protocol.fetch import FRESH_HASH, Announcement, Fetch, FetchResult
from paramclient.protocol.identify import Identification
from paramclient.protocol.reads import Key, Read, Reads
from paramclient.protocol.refresh import Refresh
from paramclient.protocol.table import Change, Table
from paramclient.protocol.timing import RoundTrip
from paramclient.protocol.turns import Turns
from paramclient.protocol.wire import (
    HASH_CHECK,
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_PX4,
    NO_INDEX,
    AutopilotVersion,
    CommandAck,
    Heartbeat,
    Message,
    ParamError,
    ParamValue,
    StatusText,
)
from paramclient.protocol.writes import Write, Writes
from paramclient.values import Encoding, Param, Trust, Value, encode

__all__ = ["ComponentHeard", "ComponentIdentified", "ComponentMachine", "Event", "Fetched", "ParamChanged"]

SETTLING_TIME: Final = 0.06
"""Seconds from the last of our writes until the hash is asked for: what PX4 changed with it, it pushes 10 to
24 ms later."""
FRESH_IDENTITY: Final = 1.0
"""Seconds for which an AUTOPILOT_VERSION needs no other."""
FOREIGN_SET_MEMORY: Final = 2.0
"""Seconds for which a PARAM_SET of another station explains a change."""
MOST_FOREIGN_SETS: Final = 256
"""Names remembered for that; the oldest goes first."""
DOUBT: Final = 2.0
"""Seconds within which a second change of one value may be an old answer that came late: ArduPilot takes the
values for a batch of answers up to 100 ms before it sends them, and what was set meanwhile overtakes them."""


@dataclass(frozen=True, slots=True)
class ComponentHeard:
    """A component was heard for the first time."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentIdentified:
    """It is settled who the component is, as far as it ever will be; its cached table can be looked for."""

    machine: ComponentMachine


class ParamChanged(NamedTuple):
    """A parameter appeared, changed or went away. A named tuple: each first value makes one."""

    machine: ComponentMachine
    change: Change


@dataclass(frozen=True, slots=True)
class Fetched:
    """A fetch has ended with a result."""

    machine: ComponentMachine
    result: FetchResult


Event: TypeAlias = ComponentHeard | ComponentIdentified | ParamChanged | Fetched


class ComponentMachine:
    """Everything about one component that needs no clock and no socket.

    Args:
        system, component: who it is.
        own: system and component that we send as.
        link: the link's canonical name, part of an identity without a hardware id.
        send: takes each message for it, in order.
        emit: takes each event.
        encoding: what the user said about its encoding, or None.
        turns: those of the lists on the link; None for a link that it has for itself.

    Attributes:
        version: the MAVLink version that it speaks, as far as heard.
        who: its identity, and how it writes values.
        table: its parameters.
        round_trip: what its answers tell of the link.
        announced: the last hash that it announced, or None.
        synced: whether the table was brought up to date on this link and no sign came since that it moved.
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
        turns: Turns | None = None,
    ) -> None:
        target = (system, component)
        self.system = system
        self.component = component
        self.version = 1
        self.round_trip = RoundTrip()
        self.who = Identification(target, link, self.round_trip, send, encoding)
        self.table = Table(self.who.encoding)
        self.turns = Turns() if turns is None else turns
        self.reads = Reads(target, self.round_trip, send, self._is_known, self.turns.share)
        self.writes = Writes(
            target,
            self.round_trip,
            send,
            self.reads,
            self.table.params,
            encoding=lambda: self.table.encoding,
            is_certain=lambda: self.who.encoding_is_certain,
        )
        self.announced: Announcement | None = None
        self.synced = False
        self.fetch: Fetch | None = None
        self.last_fetch: FetchResult | None = None
        self.refresh: Refresh | None = None
        self._own = own
        self._send = send
        self._emit = emit
        self._last_heard = -math.inf
        self._has_no_hash = False
        self._hash_due = math.inf
        self._moved_by_us_alone = False
        self._known_as: str | None = None  # the key of the identity that was reported
        self._may_write = False
        self._foreign_sets: dict[str, tuple[str, float]] = {}
        self._changed_at: dict[str, float] = {}  # what changed lately; each heartbeat clears it
        self._doubts: dict[str, float] = {}  # what changed again: when to ask for it

    # what comes in

    def receive(self, message: Message, now: float, *, version: int = 2) -> None:
        """Take a message that this component sent."""
        silence = now - self._last_heard
        self._last_heard = self.round_trip.heard_at = now
        if version > self.version:
            self.version = version
        if isinstance(message, ParamValue):
            self._receive_value(message, now)
        elif isinstance(message, Heartbeat):
            self.who.heartbeat(message)
            self._changed_at = {name: at for name, at in self._changed_at.items() if now - at <= DOUBT}
        elif isinstance(message, AutopilotVersion):
            if self.who.version(message, now):
                self._become_another(now)
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
        self.who.heard(silence, now)
        if not isinstance(message, ParamValue):  # a value tells nothing of who it is
            self._follow_identity(now)

    def foreign_set(self, name: str, station: str, now: float) -> None:
        """Another station was heard setting a parameter of this component."""
        name = self.spelling(name)
        self._foreign_sets.pop(name, None)
        self._foreign_sets[name] = (station, now)
        if len(self._foreign_sets) > MOST_FOREIGN_SETS:
            del self._foreign_sets[next(iter(self._foreign_sets))]

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
    ) -> None:
        """Take what the cache knows of this component. What was heard on this link stays as it is.

        Args:
            params: the cached table.
            now: the time.
            count: the param_count with it.
            confirmed: the hash under which the vehicle would confirm it, or None.
            complete, placed: whether it held every index below the count, and whether these still hold.
            volatile, volatile_known: as in `Table`.
        """
        table = self.table
        if table.complete:
            return
        self._report(table.fill(params, placed=placed and table.count in (None, count)))
        if table.count not in (None, count):
            return
        table.count = count
        table.complete = complete
        if confirmed is None:
            return
        table.confirm(confirmed, volatile, proven=volatile_known)
        if volatile_known:
            table.rehash()  # what is in the table counts, not what stood beside it
        elif any(
            not table.params[name].same_value(param) for name, param in params.items() if name not in volatile
        ):
            table.unconfirm()
        self._compare_hash(now)

    # what is asked of it

    def read(self, key: Key, now: float) -> Read:
        """Ask for one parameter; give it back with `reads.release`."""
        return self.reads.ask(self.spelling(key) if isinstance(key, str) else key, now)

    def write(self, name: str, value: Value, now: float) -> Write:
        """Write one parameter.

        Raises:
            UsageError: the type is known and the value does not fit it. Nothing was sent.
        """
        name = self.spelling(name)
        known = self.table.params.get(name)
        if known is not None and known.trust is not Trust.CACHED and self.who.encoding_is_certain:
            encode(value, known.type, self.table.encoding)
        write = self.writes.set(name, value, now)
        write.on_done.append(lambda: self._write_ended(write.ended_at))
        return write

    def begin_fetch(self, now: float, *, refresh: bool = False, listed: bool = False) -> Fetch:
        """Begin a fetch, or join the one under way; give it back with `end_fetch`.

        Args:
            now: the time.
            refresh: download even if the vehicle's hash would confirm the cached table.
            listed: the list has been asked for already, of all components at once.
        """
        fetch = self.fetch
        if fetch is not None and refresh and (fetch.download is None or fetch.download.resumed):
            fetch.restart(now)
        if fetch is None:
            fetch = self.fetch = Fetch(
                (self.system, self.component),
                self.round_trip,
                self._send,
                self.reads,
                self.table,
                self.turns,
                now,
                announced=self.announced,
                expects_hash=self._expects_hash,
                refresh=refresh,
                listed=listed,
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

    def ask_hash(self, now: float) -> None:
        """Ask for the hash ahead of a fetch, so that it need not wait for it, or after a write."""
        read = self.reads.ask(HASH_CHECK, now)
        read.on_done.append(lambda: self._hash_ended(read))

    def spelling(self, name: str) -> str:
        """The name as the vehicle has it. ArduPilot answers to any case; its own names have capitals only."""
        return name.upper() if self.who.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA else name

    # time

    def tick(self, now: float) -> None:
        """Do what is due."""
        self.reads.tick(now)
        self.writes.tick(now)
        if self.fetch is not None:
            self.fetch.tick(now)
        self.who.tick(now)
        self._follow_identity(now)
        if self._hash_due <= now:
            self._hash_due = math.inf
            self.ask_hash(now)
        while self._doubts and (name := next(iter(self._doubts))) and self._doubts[name] <= now:
            del self._doubts[name]
            self.reads.ask(name, now, urgent=False)

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity."""
        return min(
            self.reads.next_deadline(),
            self.writes.next_deadline(),
            math.inf if self.fetch is None else self.fetch.next_deadline(),
            self.who.next_deadline(),
            self._hash_due,
            next(iter(self._doubts.values()), math.inf),
        )

    def resume(self, now: float) -> None:
        """The link was away and is back: whatever waits for an answer is asked for again."""
        self.round_trip.heard_at = now  # it could not be heard while the link was away
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
        self._hash_due = math.inf
        self._doubts.clear()

    # how it stands

    @property
    def identity(self) -> Identity:
        """Who the vehicle is, as far as this component has said."""
        return self.who.identity

    @property
    def state(self) -> str:
        """The table's state in a word: new, cached, fetching, synced, partial."""
        if self.fetch is not None:
            return "fetching"
        if self.synced:
            return "synced"
        if not self.table.params:
            return "new"
        return "cached" if self.table.complete else "partial"

    @property
    def can_hit(self) -> bool:
        """Whether the vehicle's hash may confirm the table as it stands."""
        return self.table.complete and self.table.hash is not None

    @property
    def is_settling(self) -> bool:
        """Whether a write is under way, or the hash after one has not come yet."""
        return len(self.writes) > 0 or self._hash_due < math.inf or HASH_CHECK in self.reads

    def __repr__(self) -> str:
        kind = "unknown" if self.who.autopilot is None else autopilot_name(self.who.autopilot)
        return f"<ComponentMachine {self.system}/{self.component} {kind} {self.state}>"

    # private

    def _receive_value(self, message: ParamValue, now: float) -> None:
        name, _, _, count, _ = message
        if not name:
            return
        if name == HASH_CHECK:
            announced = int.from_bytes(message.raw, "little")
            self.announced = Announcement(announced, message.param_count, now)
            self._has_no_hash = False
            if self.fetch is not None:
                self.fetch.announced(self.announced)
            self.reads.heard(message, now)
            return
        if self.who.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA and not name.isupper():
            name = name.upper()
            message = message._replace(param_id=name)
        if count != self.table.count and count != NO_INDEX:
            self._count_moved(count)
        is_writing = len(self.writes) > 0
        by = self._who_did(name, now) if is_writing or self._foreign_sets else "vehicle"
        change = self.table.hear(message, by)
        if name not in self.table.params:
            return  # more names than there can be
        if change is not None:
            self._notice(name, now)
            if name not in self.table.volatile:
                self._moved_by_us_alone &= change.by == "us"
                if self.announced is not None and self.announced.at != _NEVER:
                    self.announced = replace(self.announced, at=_NEVER)
            self._emit(_new(ParamChanged, (self, change)))
        if self.fetch is not None:
            self.fetch.heard(message, now)
        if is_writing:
            self.writes.heard(message, now)
        self.reads.heard(message, now)

    def _count_moved(self, count: int) -> None:
        if self.table.count is not None:
            self.synced = False
        self.table.move(count)

    def _notice(self, name: str, now: float) -> None:
        """A value changed: the second time in a short while, the one that came last may be the older one."""
        before = self._changed_at.pop(name, _NEVER)
        if now - before <= DOUBT and name not in self.writes:
            self._doubts.setdefault(name, now + DOUBT / 2)
        self._changed_at[name] = now

    def _who_did(self, name: str, now: float) -> str:
        if name in self.writes:
            return "us"
        if self._foreign_sets:
            station, at = self._foreign_sets.get(name, ("", -math.inf))
            if now - at <= FOREIGN_SET_MEMORY:
                return station
        return "vehicle"

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
        if not self._may_write and self.who.encoding_is_certain:
            self._may_write = True
            self.writes.proceed(now)

    def _doubt_identity(self, now: float) -> None:
        """The table is not what it was: it may be another vehicle that answers by now."""
        if self.who.settled and now - self.who.known_at > FRESH_IDENTITY:
            self.who.ask_again(now)

    def _become_another(self, now: float) -> None:
        """Another vehicle has taken this system id: nothing that is known is about it."""
        self._report(self.table.remove(lambda param: True))
        self.table.unconfirm()
        self.table.volatile = frozenset()
        self.table.volatile_known = False
        self.table.count = None
        self.table.complete = False
        self.announced = None
        self.synced = False
        self._has_no_hash = False
        self._moved_by_us_alone = False
        self._known_as = None
        what = f"writes to {self.system}/{self.component}: another vehicle answers there now"
        self.writes.fail_all(NoReply(what, attempts=0, waited=0.0), now)
        if self.fetch is not None:
            self.fetch.restart(now)

    def _report(self, changes: list[Change]) -> None:
        for change in changes:
            self._emit(ParamChanged(self, change))

    def _expects_hash(self) -> bool:
        if self._has_no_hash:
            return False
        return self.announced is not None or self.who.autopilot == MAV_AUTOPILOT_PX4

    def _write_ended(self, now: float) -> None:
        if self._expects_hash() and now < math.inf:
            self._hash_due = now + SETTLING_TIME

    def _hash_ended(self, read: Read) -> None:
        """A hash has come, or will not come, for which nobody but us waits."""
        table = self.table
        if read.result is None:
            self._has_no_hash = isinstance(read.error, UnknownParameter) and self.announced is None
            return
        if self._compare_hash(read.ended_at) or len(self.writes) or self.fetch is not None:
            return
        if table.complete and self._moved_by_us_alone and not table.volatile_known:
            table.confirm(int.from_bytes(read.result.raw, "little"), table.volatile, proven=False)
        else:
            self.synced = False

    def _compare_hash(self, now: float) -> bool:
        """Whether the vehicle has just announced the hash that belongs to the table; then it is confirmed."""
        table, announced = self.table, self.announced
        if announced is None or now - announced.at > FRESH_HASH or announced.hash != table.hash:
            return False
        listed = table.listed()
        if not table.complete or announced.count != len(listed):
            return False
        table.verify()
        self._moved_by_us_alone = True
        return True

    def _fetch_ended(self, fetch: Fetch) -> None:
        self.fetch = None
        result = fetch.result
        if result is None:
            return
        self.last_fetch = result
        self.synced = result.complete and self.table.complete and result.is_confirmed
        self._moved_by_us_alone = result.hash is not None
        self._emit(Fetched(self, result))
        if result.hash is not None and (result.source == "cache" or result.resumed):
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


_NEVER = -math.inf
_new = tuple.__new__  # what a named tuple's own constructor ends in, after twice the time
_WRITE_DENIED = re.compile(r"Param write denied \((\w{1,16})\)")
