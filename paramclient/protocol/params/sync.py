"""Whether a table is still the vehicle's, and what is done to keep it so."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from typing import Final, Protocol

from paramclient.errors import FileTransferError, UnknownParameter, UsageError
from paramclient.model.values import Trust
from paramclient.protocol.ftp import BUSY, FileTransfers
from paramclient.protocol.params.change_origin import is_ours
from paramclient.protocol.params.fetch import Check, Fetch
from paramclient.protocol.params.fetch_result import Announcement, FetchResult, Policy
from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.sync_interval import CheckPace
from paramclient.protocol.params.table import MOST_NAMES, Table
from paramclient.protocol.params.volatile_values import Refresh
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.vehicle.presence import Presence
from paramclient.protocol.wire import HASH_CHECK, ParamValue

__all__ = ["Sync", "SyncState", "Upkeep"]

WATCH_INTERVAL: Final = 30.0
"""Seconds after which a vehicle with a hash is asked for it again, unless the user says otherwise."""
SHORTEST_INTERVAL: Final = 1.0
"""Seconds that may be chosen instead, at the least."""
SETTLING_TIME: Final = 0.06
"""Seconds from the last of our writes until the hash is asked for: what PX4 changed with it, it pushes 10 to
24 ms later."""
FOREIGN_SETTLING_TIME: Final = 0.5
"""Seconds from the last value that the vehicle or another station has changed until the hash is asked for. Of
200 values that another station set at full speed, PX4 told this one 73 to 178; the others it had passed or
saved before their turn came (measured)."""
FOREIGN_CHECK_INTERVAL: Final = 2.0
"""Seconds between two such questions, at the least: values may change for ever."""
VOLATILE_SHARE: Final = 0.05
"""The share of the time that may be taken by reading again what the hash leaves out."""
BUSY_WAIT: Final = 0.1
"""Seconds until it is looked again whether the link is idle."""
GAPS_INTERVAL: Final = 5.0
"""Seconds between two checks that gaps in the heartbeats bring about: they are many on a bad link."""
SKIPPED_TURN_WAIT: Final = 5.0
"""Seconds until a check is made that was skipped as another station has a file open. ArduPilot ends a session
3 s after its last reply to anybody, so asking more often would keep open what nobody uses any more."""
LOW_BANDWIDTH_GAP: Final = 0.1
"""Seconds from one value of the list to the next that tell of a low-bandwidth mode: PX4's sends 8 a second, a
57600-baud radio carries 40."""

_PAST: Final = -math.inf  # when something was announced that is no longer so


class SyncState(StrEnum):
    """How the table of a component stands to the vehicle's.

    Attributes:
        UNSYNCED: it was never brought up to date on this link, or a sign has come since that it moved.
        SYNCED: it was brought up to date, and no sign has come since that it moved.
        CHECKING: the vehicle was lost or has started again: its identity and its hash are being asked for.
        RESYNCING: it has moved, and what did is being fetched.
        LOST: the component is not heard any more.
    """

    UNSYNCED = "unsynced"
    SYNCED = "synced"
    CHECKING = "checking"
    RESYNCING = "resyncing"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class Upkeep:
    """What is done for a table without being asked.

    Attributes:
        interval: seconds after which the vehicle is asked again whether it has moved; infinity for never.
        without_hash: whether that goes for every vehicle without a hash too: its whole table is then fetched.
            It goes anyway for those that give it as a file, as often as that costs little.
        policy: what may be asked.
        listens_only: nothing is sent at all, for whatever reason; the policy is then "cache-only".
        is_log: the link is a log, in which nobody can be asked and which ends.
    """

    interval: float = math.inf
    without_hash: bool = False
    policy: Policy = Policy.AUTO
    listens_only: bool = False
    is_log: bool = False

    @classmethod
    def chosen(
        cls,
        interval: float | None,
        policy: Policy | str,
        *,
        listen_only: bool = False,
        is_log: bool = False,
    ) -> Upkeep:
        """What a user's choice means; see `ParamClient`.

        Raises:
            UsageError: there is no such policy, the interval is too short, or either is chosen where nothing
                may be asked.
        """
        if listen_only or is_log:
            if interval or policy != Policy.AUTO:
                raise UsageError("watch_interval and policy are for clients that ask; here nothing is sent")
            return cls(policy=Policy.CACHE_ONLY, listens_only=True, is_log=is_log)
        try:
            policy = Policy(policy)
        except ValueError:
            raise UsageError(f"policy is one of {', '.join(Policy)}, not {policy!r}") from None
        if interval is None:
            return cls(WATCH_INTERVAL, policy=policy)
        if not (interval == 0 or interval >= SHORTEST_INTERVAL):
            raise UsageError(f"watch_interval is 0 or seconds from {SHORTEST_INTERVAL:g} up, not {interval}")
        return cls(interval or math.inf, without_hash=True, policy=policy)


class SyncHost(Protocol):
    """What the watch of a table needs of its component."""

    @property
    def is_link_busy(self) -> bool:
        """Whether anything is requested on the link."""

    @property
    def may_use_file(self) -> bool:
        """Whether the component says that it serves its table as a file, or has done so."""

    def begin_fetch(self, now: float, *, refresh: bool, check: Check | None) -> Fetch:
        """Begin a fetch (with a check, of everything); give it back with `end_fetch`."""

    def end_fetch(self, fetch: Fetch, now: float) -> None:
        """Wait for it no longer."""

    def resynced(self, changed: tuple[str, ...], confirmed: int | None) -> None:
        """Take that the table agrees with the vehicle's again, what had moved, and the hash."""


class Sync(Machine):
    """Follows the hashes that one component announces, and asks for them when there is a reason to.

    Reasons are a write of ours, which moves the hash; values that others have changed, of which the vehicle
    may not have told all; a silence, in which an update may have been lost; and the interval of the upkeep,
    as PARAM_VALUEs of changes are sent once and never repeated. All but the first count only for a table that
    was brought up to date on this link. Nothing is asked for in high-latency mode, or on a link that is
    measured to be a low-bandwidth one, nor, but after changes, while anything else goes on.

    With each interval, the values that the hash leaves out are read again. Of a component without a hash the
    file, or the list, is fetched, as often as `check_pace` says.

    Args:
        context, reads, table, presence, files: the component's.
        upkeep: what is done without being asked.
        check_pace: how often a table without a hash is fetched again.
        host: the component itself.

    Attributes:
        announced: the last hash that was heard, or None.
        synced: whether the table was brought up to date on this link and no sign came since that it moved.
        refresh: the reading of what a hash that confirmed the table does not cover, or None.
        holds: how many set-ups are under way, which read the table themselves: no check is begun meanwhile.
    """

    def __init__(
        self,
        context: Context,
        reads: Reads,
        table: Table,
        upkeep: Upkeep,
        check_pace: CheckPace,
        presence: Presence,
        files: FileTransfers,
        host: SyncHost,
    ) -> None:
        self._context = context
        self._reads = reads
        self._table = table
        self._upkeep = upkeep
        self._check_pace = check_pace
        self._presence = presence
        self._files = files
        self._host = host
        self.announced: Announcement | None = None
        self.synced = False
        self.refresh: Refresh | None = None
        self.holds = 0
        self._was_synced = False  # at any time on this link: only then is there something to keep up
        self._moved_by_us_alone = False
        self._settle_at = math.inf  # when to ask for the hash after our writes
        self._foreign_check_at = math.inf  # when to ask for the hash after changes by others
        self._foreign_checked_at = -math.inf
        self._check_at = math.inf
        self._checked_at = -math.inf
        self._is_checking = False
        self._volatile_at = -math.inf  # when what the hash leaves out may be read again
        self._reads_volatile = False  # once the hash that is being asked for agrees
        self._resync: Fetch | None = None
        self._has_fallen = False  # it was synced, and is not
        self._moved: dict[str, None] = {}  # what has changed since then

    @property
    def state(self) -> SyncState:
        """How the table stands to the vehicle's, of a component that is heard."""
        if self.synced:
            return SyncState.SYNCED
        if self._resync is not None:
            return SyncState.RESYNCING
        return SyncState.CHECKING if self._is_checking else SyncState.UNSYNCED

    @property
    def expects_hash(self) -> bool:
        """Whether the component has a hash, as far as is known."""
        return self._context.expects_hash

    @property
    def is_doubted(self) -> bool:
        """Whether it is open who the component is."""
        return self._context.is_doubted

    @property
    def is_settling(self) -> bool:
        """Whether the hash after a write of ours has not come yet."""
        return self._settle_at < math.inf or HASH_CHECK in self._reads

    # what is heard

    def hash_heard(self, message: ParamValue, now: float) -> Announcement:
        """A `_HASH_CHECK` has come."""
        self.announced = Announcement.of(message, now)
        self._context.has_hash = True
        return self.announced

    def changed(self, name: str, by: str, now: float | None = None) -> None:
        """A parameter has changed: the hash that was announced is of the past, unless that leaves it out.

        Args:
            name: param_id.
            by: who has changed it.
            now: the time; None where a fetch has found it out, which brings the others too.
        """
        if name not in self._table.volatile:
            if not is_ours(by):
                self._moved_by_us_alone = False
                if now is not None:
                    self._foreign_changed(now)
            self.expire_hash()
        if (self._has_fallen or self._resync is not None) and len(self._moved) < MOST_NAMES:
            self._moved[name] = None

    def expire_hash(self) -> None:
        """The hash that was announced last is of the past: it is asked for again before it counts."""
        announced = self.announced
        if announced is not None and announced.at != _PAST:
            self.announced = replace(announced, at=_PAST)

    def count_moved(self, now: float) -> None:
        """Another number of parameters was heard: the table is not what it was."""
        self._fall()
        if self._is_kept_up:
            pause = 0.0 if self.expects_hash else self._check_pace.shortest_pause
            self._check_at = min(self._check_at, max(now, self._checked_at + pause))

    def silence(self, now: float) -> None:
        """The component is heard again after a silence in which something may have been missed.

        That is worth a question for the hash, but no list of one that has none: gaps are many on a bad link.
        """
        if self._is_kept_up and self.expects_hash:
            self._check_at = min(self._check_at, max(now, self._checked_at + GAPS_INTERVAL))

    def write_ended(self, now: float) -> None:
        """A write of ours has ended, and may have moved the hash."""
        if self.expects_hash and now < math.inf:
            self._settle_at = now + SETTLING_TIME

    def doubt(self) -> None:
        """The component is lost, or has started again: the table counts once its hash has confirmed it."""
        self._fall()
        self.stop()
        self.expire_hash()

    def check(self, now: float) -> None:
        """It is there again: see whether the table still holds, as soon as the link is idle."""
        may_ask = self._upkeep.policy is not Policy.CACHE_ONLY
        if may_ask and (self._table.complete or self._is_kept_up):
            self._is_checking = self.expects_hash
            self._check_at = now

    def fetched(self, result: FetchResult, now: float) -> bool:
        """A fetch has ended, not only one of ours. False when the vehicle has said nothing of its table."""
        if result.source == "cache" and result.hash is None:
            self._not_confirmed()
            return False
        table = self._table
        complete = result.complete and table.complete and not result.has_moved
        if result.hash is None:  # what came before it was lost may have moved since
            complete = complete and not table.only_cached
        if not complete:
            self._fall()
        self.synced = complete
        self._was_synced |= complete or result.has_moved
        self._moved_by_us_alone = result.hash is not None
        self._settled(now, now if result.hash is not None else now - result.elapsed)
        if result.has_moved and self._is_kept_up:
            self._check_at = now + GAPS_INTERVAL
        if result.hash is not None:
            self._read_unhashed(result.hash, now)
        return True

    def contradicted(self) -> None:
        """A hash has come that is not the table's, and nothing can be done about it."""
        self._not_confirmed()

    def forget(self) -> None:
        """Another vehicle has taken the address: nothing that is known is about it."""
        self.announced = None
        self._context.has_hash = None
        self.synced = self._was_synced = self._moved_by_us_alone = False
        self._has_fallen = False
        self.stop()

    # what is asked

    def ask(self, now: float) -> None:
        """Ask for the hash: ahead of a fetch, so that it need not wait for it, or to see whether it moved."""
        if self._upkeep.policy is not Policy.CACHE_ONLY:
            read = self._reads.ask(HASH_CHECK, now)
            read.on_done.append(lambda: self._hash_came(read))

    def fetch_quick_file(self, now: float) -> bool:
        """Fetch the table anew where it comes as a file in no time; false where it does not, or may not."""
        may_fetch = self._is_kept_up and not self.is_spared and not self._files.is_in_use(now)
        if not may_fetch or not self._check_pace.file_is_quick:
            return False
        self._begin_resync(now, Check(may_list=True))
        return True

    def compare(self, now: float) -> bool:
        """Whether the vehicle has just announced the hash that belongs to the table; then it is confirmed."""
        table, announced = self._table, self.announced
        if announced is None or not announced.is_fresh(now) or announced.hash != table.hash:
            return False
        if not table.complete or announced.count != table.size:
            return False
        table.verify()
        self._moved_by_us_alone = True
        return True

    def tick(self, now: float) -> None:
        """Ask for the hash when it is due."""
        if self._settle_at <= now:
            self._settle_at = math.inf
            self.ask(now)
        if self._foreign_check_at <= now:
            self._foreign_check_at = math.inf
            self._check_after_foreign(now)
        if self._check_at <= now:
            self._check(now)

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity."""
        return min(self._settle_at, self._foreign_check_at, self._check_at)

    def fail_all(self, error: Exception, now: float) -> None:
        """End the reading of volatile values with the error, and request nothing any more."""
        if self.refresh is not None:
            self.refresh.fail(error, now)
        self.stop()

    def stop(self) -> None:
        """Ask for nothing any more, unless there is a new reason to."""
        self._settle_at = self._foreign_check_at = self._check_at = math.inf
        self._is_checking = self._reads_volatile = False

    @property
    def is_spared(self) -> bool:
        """Whether the component is lost, or in a mode in which nothing is requested unasked."""
        presence = self._presence
        return presence.is_lost or presence.is_high_latency or self._reads.pace.gap >= LOW_BANDWIDTH_GAP

    @property
    def wants_start_values(self) -> bool:
        """Whether what is measured at each start is to be read again unasked, as no hash shows it."""
        upkeep = self._upkeep
        is_kept_up = upkeep.interval < math.inf and upkeep.policy is Policy.AUTO
        return is_kept_up and not self.expects_hash and not self.is_spared

    @property
    def may_resync(self) -> bool:
        """Whether a hash that is not the table's leads to a new fetch."""
        return self._is_kept_up and not self.is_spared

    # private

    @property
    def _is_kept_up(self) -> bool:
        """Whether the table is to be followed without being asked."""
        upkeep = self._upkeep
        return self._was_synced and upkeep.interval < math.inf and upkeep.policy is Policy.AUTO

    def _fall(self) -> None:
        if self.synced:
            self.synced = False
            self._has_fallen = True
            self._moved.clear()

    def _not_confirmed(self) -> None:
        """The table was to be confirmed, and is not: what a hash has confirmed before is in doubt."""
        self._fall()
        self._table.doubt(Trust.VERIFIED)

    def _read_unhashed(self, confirmed: int, now: float, *, again: bool = False) -> None:
        """Read what the hash says nothing about; `again` is as in `Refresh`."""
        if self._upkeep.policy is not Policy.AUTO:
            return
        refresh = Refresh(self._reads, self._table, confirmed, self._context, now, again=again)
        if not refresh.done:
            self.refresh = refresh
            refresh.on_done.append(partial(self._refresh_ended, refresh))

    def _refresh_ended(self, refresh: Refresh) -> None:
        took = refresh.ended_at - refresh.begun_at
        self._volatile_at = refresh.ended_at + took * (1.0 / VOLATILE_SHARE - 1.0)
        if self.refresh is refresh:
            self.refresh = None

    def _foreign_changed(self, now: float) -> None:
        """The vehicle or another station has changed a value. A fetch under way brings the others too."""
        if self._is_kept_up and self.expects_hash and not self._context.is_fetching:
            earliest = self._foreign_checked_at + FOREIGN_CHECK_INTERVAL
            self._foreign_check_at = max(now + FOREIGN_SETTLING_TIME, earliest)

    def _check_after_foreign(self, now: float) -> None:
        """Values of others have stopped: ask for the hash where it can prove the present values."""
        if self._table.is_provable and not (self._context.is_fetching or self.is_spared):
            self._foreign_checked_at = now
            self.ask(now)

    def _check(self, now: float) -> None:
        """See whether the table still is the vehicle's, if there is room for that on the link."""
        if self.holds or self._host.is_link_busy:
            self._check_at = now + BUSY_WAIT
            return
        self._plan_check(now, now)
        if self.is_spared:
            self._is_checking = False
        elif self.expects_hash:
            self._reads_volatile = self._is_kept_up
            self.ask(now)
        elif self._check_at < math.inf:
            if self._files.is_in_use(now):
                self._check_at = min(self._check_at, now + SKIPPED_TURN_WAIT)
            else:
                self._begin_resync(now, Check(may_list=self._check_pace.may_list))

    def _plan_check(self, now: float, known_at: float) -> None:
        """Plan the next check so that it ends an interval after the moment of which the table is known."""
        self._checked_at = now
        self._check_at = math.inf
        if self._is_kept_up:
            pace = self._check_pace
            if self.expects_hash:
                self._check_at = max(known_at + pace.hash_interval, now)
            else:
                interval = pace.interval(may_use_file=self._host.may_use_file)
                self._check_at = max(known_at + interval, now + pace.shortest_pause)

    def _hash_came(self, read: Read) -> None:
        """A hash has come, or will not come, for which nobody but us waits."""
        table, now = self._table, read.ended_at
        reads_volatile, self._reads_volatile = self._reads_volatile, False
        if read.result is None:
            has_none = isinstance(read.error, UnknownParameter) and self.announced is None
            if has_none:
                self._context.has_hash = False
            elif self._context.has_hash is False:
                self._context.has_hash = None
            self._is_checking = False
            if has_none and self._is_kept_up:
                self._check_at = now  # in the way of those without one
            return
        if self._context.is_doubted:
            self._check_at = now  # again, when it is known whose it is
            return
        announced = int.from_bytes(read.result.raw, "little")
        if self.compare(now):
            if self._has_fallen:
                self.synced = True
                self._read_unhashed(announced, now)
            if reads_volatile and now >= self._volatile_at:
                self._read_unhashed(announced, now, again=True)
            self._settled(now, now)
        elif self._context.is_writing or self._context.is_fetching:
            return
        elif table.hash is None and self._moved_by_us_alone and not self._is_kept_up:
            # it cannot be computed here: what moved it may be our doing alone, or something unheard too
            self._is_checking = False
        else:
            self._not_confirmed()
            self._is_checking = False
            if self._is_kept_up and not self.is_spared:
                self._begin_resync(now, None)

    def _begin_resync(self, now: float, check: Check | None) -> None:
        fetch = self._resync = self._host.begin_fetch(now, refresh=check is not None, check=check)

        def ended() -> None:
            self._resync = None
            self._host.end_fetch(fetch, fetch.ended_at)
            if isinstance(fetch.error, FileTransferError) and fetch.error.code in BUSY:
                self._check_at = min(self._check_at, fetch.ended_at + SKIPPED_TURN_WAIT)

        if fetch.done:
            ended()
        else:
            fetch.on_done.append(ended)

    def _settled(self, now: float, known_at: float) -> None:
        """It is known how the table stands: say so, if it was in doubt.

        Args:
            now: the time.
            known_at: the moment of the vehicle's table that is known: what changed later may be missing.
        """
        self._is_checking = False
        self._plan_check(now, known_at)
        if not self.synced:
            return
        if self._has_fallen or self._moved:
            self._host.resynced(tuple(self._moved), self._table.hash)
        self._has_fallen = False
        self._moved.clear()
