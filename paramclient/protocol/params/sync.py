"""Sync: whether the table still matches the vehicle's, and the checks that keep it so."""

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
from paramclient.protocol.params.table import NAMES_MAX, Table
from paramclient.protocol.params.volatile_values import VolatileReads
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.retry import FILE_IN_USE_RETRY
from paramclient.protocol.vehicle.presence import Presence
from paramclient.protocol.wire import HASH_CHECK, ParamValue

__all__ = ["ComponentState", "Sync", "SyncState", "SyncSettings"]

WATCH_INTERVAL: Final = 30.0
"""Seconds between two checks of the hash, by default."""
WATCH_INTERVAL_MIN: Final = 1.0
"""The shortest interval in seconds that a user may choose."""
SETTLING_TIME: Final = 0.06
"""Seconds from the last of our writes to the check of the hash: PX4 pushes changes caused by the write 10 to
24 ms later."""
FOREIGN_SETTLING_TIME: Final = 0.5
"""Seconds from the last change by the vehicle or another station to the check of the hash. Of 200 values that
another station set at full speed, PX4 pushed 73 to 178 to this one; the others it had passed or saved before
their turn (measured)."""
FOREIGN_CHECK_INTERVAL: Final = 2.0
"""Seconds between two such checks, at least: values may change without end."""
VOLATILE_SHARE: Final = 0.05
"""The share of time for repeated reads of the values that the hash does not cover."""
IDLE_CHECK_INTERVAL: Final = 0.1
"""Seconds until the next look at whether the link is idle."""
GAP_CHECK_INTERVAL: Final = 5.0
"""Seconds between two checks caused by gaps in the heartbeats, which are frequent on a bad link."""
DOWNLOAD_SHARE: Final = 0.05
"""The share of time that downloads may take that check a table without a hash: 1.5 s of 30 s."""
CHOSEN_DOWNLOAD_SHARE: Final = 0.5
"""The same if the user has chosen the interval."""
DOWNLOAD_PAUSE_MIN: Final = 1.0
"""Seconds from one check by download to the next, at least: the count may change all the time."""
LOW_BANDWIDTH_GAP: Final = 0.1
"""Seconds between two values of the list that indicate a low-bandwidth mode: PX4's sends 8 values/s, a
57600-baud radio carries 40."""
_EXPIRED: Final = -math.inf  # the time of an announcement that is stale


class ComponentState(StrEnum):
    """The state of a component's table.

    Attributes:
        NEW: no parameter is known.
        CACHED: complete, from the cache, and not confirmed by the vehicle.
        FETCHING: being fetched.
        SYNCED: fetched or confirmed, without a sign of change since.
        PARTIAL: some parameters are known.
        CONTESTED: several vehicles use the address of the component.
        LOST: the component is lost.
    """

    NEW = "new"
    CACHED = "cached"
    FETCHING = "fetching"
    SYNCED = "synced"
    PARTIAL = "partial"
    CONTESTED = "contested"
    LOST = "lost"


class SyncState(StrEnum):
    """The relation of a component's table to the vehicle's.

    Attributes:
        UNSYNCED: never fetched on this link, or changed since by some sign.
        SYNCED: fetched, without a sign of change since.
        CHECKING: the vehicle was lost or has restarted: identity and hash are being requested.
        RESYNCING: the vehicle's table has changed and is being fetched.
        LOST: the component is lost.
    """

    UNSYNCED = "unsynced"
    SYNCED = "synced"
    CHECKING = "checking"
    RESYNCING = "resyncing"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class SyncSettings:
    """What is done for a table without a request of the user.

    Attributes:
        interval: seconds between two checks whether the table has changed; infinity for none.
        without_hash: whether every vehicle without a hash is checked too, by fetching its whole table.
            Vehicles that serve it as a file are checked anyway.
        policy: what may be requested.
        listens_only: nothing is sent, for any reason; the policy is then "cache-only".
        is_log: the link is a log, which accepts no requests and ends.
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
    ) -> SyncSettings:
        """Return the settings for a user's choice; see `ParamClient`.

        Raises:
            UsageError: no such policy, the interval is too short, or either is chosen where nothing may be
                requested.
        """
        if listen_only or is_log:
            if interval or policy != Policy.AUTO:
                raise UsageError("watch_interval and policy need requests, and the client only listens")
            return cls(policy=Policy.CACHE_ONLY, listens_only=True, is_log=is_log)
        try:
            policy = Policy(policy)
        except ValueError:
            raise UsageError(f"policy is one of {', '.join(Policy)}, not {policy!r}") from None
        if interval is None:
            return cls(WATCH_INTERVAL, policy=policy)
        if not (interval == 0 or interval >= WATCH_INTERVAL_MIN):
            raise UsageError(f"watch_interval is 0 or seconds from {WATCH_INTERVAL_MIN:g} up, not {interval}")
        return cls(interval or math.inf, without_hash=True, policy=policy)


class SyncHost(Protocol):
    """The part of a component that sync uses."""

    @property
    def is_link_busy(self) -> bool:
        """Whether requests are in flight on the link."""

    @property
    def may_use_file(self) -> bool:
        """Whether the component says that it serves its table as a file, or has done so."""

    def begin_fetch(self, now: float, *, refresh: bool, check: Check | None) -> Fetch:
        """Begin a fetch (with a check, of everything); give it back with `end_fetch`."""

    def end_fetch(self, fetch: Fetch, now: float) -> None:
        """Give a fetch back."""

    def resynced(self, changed: tuple[str, ...], confirmed: int | None) -> None:
        """Report that the table matches the vehicle's again, with the changed names and the hash."""


class Sync(Machine):
    """Follows the hashes that one component announces, and requests them when changes may have been missed.

    The reasons are: a write of ours, which changes the hash; changes by others, of which the vehicle may not
    have pushed all; a gap in the heartbeats, in which a change may have been lost; and the interval of
    `SyncSettings`, as a PARAM_VALUE of a change is sent once and never repeated. All but the first apply only
    to a table that was fetched on this link. Nothing is requested in high-latency mode, or on a link measured
    to be in a low-bandwidth mode, nor, except after changes, while other requests are in flight.

    When parameters were added or removed, the table is fetched.

    With each interval, the values that the hash does not cover are read again. For a component without a hash
    the file, or the list, is fetched: with each interval, or less often if that takes long.

    Args:
        context, reads, table, presence, files: the component's.
        sync_settings: what is done without a request.
        host: the component.

    Attributes:
        announced: the last hash received, or None.
        synced: whether the table was fetched on this link, without a sign of change since.
        refresh: the reads of values that a confirmed hash does not cover, or None.
        holds: set-ups in progress, which read the table themselves: no check begins meanwhile, see `hold`.
    """

    def __init__(
        self,
        context: Context,
        reads: Reads,
        table: Table,
        sync_settings: SyncSettings,
        presence: Presence,
        files: FileTransfers,
        host: SyncHost,
    ) -> None:
        self._context = context
        self._reads = reads
        self._table = table
        self._sync_settings = sync_settings
        self._presence = presence
        self._files = files
        self._host = host
        self.announced: Announcement | None = None
        self.synced = False
        self.refresh: VolatileReads | None = None
        self.holds = 0
        self._was_synced = False  # at any time on this link: checks are for such tables only
        self._changed_only_by_us = False
        self._settle_at = math.inf  # when to request the hash after our writes
        self._foreign_check_at = math.inf  # when to request the hash after changes by others
        self._foreign_checked_at = -math.inf
        self._check_at = math.inf
        self._checked_at = -math.inf
        self._is_checking = False
        self._has_count_changed = False  # since the last complete fetch
        self._volatile_at = -math.inf  # when values outside the hash may be read again
        self._reads_volatile = False  # after a match of the requested hash
        self._resync: Fetch | None = None
        self._download_time = 0.0  # seconds of the last download of the whole table
        self._was_marked_unsynced = False  # was synced and is not
        self._changed_names: dict[str, None] = {}  # names changed since then

    @property
    def state(self) -> SyncState:
        """The state of the table of a component that is not lost."""
        if self.synced:
            return SyncState.SYNCED
        if self._resync is not None:
            return SyncState.RESYNCING
        return SyncState.CHECKING if self._is_checking else SyncState.UNSYNCED

    @property
    def expects_hash(self) -> bool:
        """Whether the component has a hash, as far as known."""
        return self._context.expects_hash

    @property
    def is_doubted(self) -> bool:
        """Whether the component's identity is in doubt."""
        return self._context.is_doubted

    @property
    def is_settling(self) -> bool:
        """Whether the hash after a write of ours has not been received yet."""
        return self._settle_at < math.inf or HASH_CHECK in self._reads

    # received messages

    def receive_hash(self, message: ParamValue, now: float) -> Announcement:
        """Process a `_HASH_CHECK`."""
        self.announced = Announcement.of(message, now)
        self._context.has_hash = True
        return self.announced

    def changed(self, name: str, by: str, now: float | None = None) -> None:
        """Process a changed parameter: the announced hash is stale, unless it excludes the parameter.

        Args:
            name: param_id.
            by: the author of the change.
            now: the time; None for a change found by a fetch, which brings other changes too.
        """
        if name not in self._table.volatile:
            if not is_ours(by):
                self._changed_only_by_us = False
                if now is not None:
                    self._foreign_changed(now)
            self.expire_hash()
        if (self._was_marked_unsynced or self._resync is not None) and len(self._changed_names) < NAMES_MAX:
            self._changed_names[name] = None

    def expire_hash(self) -> None:
        """Mark the last announced hash as stale: it is requested again before it counts."""
        announced = self.announced
        if announced is not None and announced.at != _EXPIRED:
            self.announced = replace(announced, at=_EXPIRED)

    def count_changed(self, now: float) -> None:
        """Process a changed count: the table has changed.

        Without a hash, the table is fetched, by list where it is not served as a file.
        """
        self._mark_unsynced()
        if self._keeps_in_sync:
            self._has_count_changed = not self.expects_hash
            pause = 0.0 if self.expects_hash else self._shortest_pause
            self._check_at = min(self._check_at, max(now, self._checked_at + pause))

    def silence(self, now: float) -> None:
        """Process the end of a gap in which changes may have been missed.

        Requests the hash, but no list of a component without one: gaps are frequent on a bad link.
        """
        if self._keeps_in_sync and self.expects_hash:
            self._check_at = min(self._check_at, max(now, self._checked_at + GAP_CHECK_INTERVAL))

    def write_ended(self, now: float) -> None:
        """Process the end of a write of ours, which may have changed the hash."""
        if self.expects_hash and now < math.inf:
            self._settle_at = now + SETTLING_TIME

    def doubt(self) -> None:
        """Doubt the table until its hash has confirmed it: the component is lost or has restarted."""
        self._mark_unsynced()
        self.stop()
        self.expire_hash()

    def check(self, now: float) -> None:
        """Plan a check of the table as soon as the link is idle: the component is back."""
        may_ask = self._sync_settings.policy is not Policy.CACHE_ONLY
        if may_ask and (self._table.complete or self._keeps_in_sync):
            self._is_checking = self.expects_hash
            self._check_at = now

    def fetched(self, result: FetchResult, now: float, *, waited: float = 0.0) -> bool:
        """Process the end of any fetch. Return False when the vehicle has sent nothing of its table.

        Args:
            result: of the fetch.
            now: the time.
            waited: seconds for which the fetch waited for its turn on the link.
        """
        if result.source == "cache" and result.hash is None:
            self._not_confirmed()
            return False
        if result.source != "cache" and result.complete:
            self._download_time = result.elapsed - waited
        table = self._table
        complete = result.complete and table.complete and not result.may_be_mixed
        if result.hash is None:  # values from before the loss may have changed since
            complete = complete and not table.only_cached
        if not complete:
            self._mark_unsynced()
        self.synced = complete
        self._has_count_changed &= not complete
        self._was_synced |= complete or result.may_be_mixed
        self._changed_only_by_us = result.hash is not None
        self._settled(now, now if result.hash is not None else now - result.elapsed)
        if result.may_be_mixed and self._keeps_in_sync:
            self._check_at = now + GAP_CHECK_INTERVAL
        if result.hash is not None:
            self._read_unhashed(result.hash, now)
        return True

    def contradicted(self) -> None:
        """Process a hash mismatch after which nothing can be fetched."""
        self._not_confirmed()

    def forget(self) -> None:
        """Forget everything: another vehicle uses the address."""
        self.announced = None
        self._context.has_hash = None
        self.synced = self._was_synced = self._changed_only_by_us = False
        self._was_marked_unsynced = self._has_count_changed = False
        self._download_time = 0.0
        self.stop()

    # requests

    def ask(self, now: float) -> None:
        """Request the hash: ahead of a fetch, to save its round trip, or to detect a change."""
        if self._sync_settings.policy is not Policy.CACHE_ONLY:
            read = self._reads.ask(HASH_CHECK, now)
            read.on_done.append(lambda: self._take_hash(read))

    def hold(self) -> None:
        """Begin no check until `release`: a set-up reads the table itself."""
        self.holds += 1

    def release(self) -> None:
        """Let checks begin again: those that were due meanwhile at once, unless the table was fetched."""
        self.holds -= 1

    def drop_check(self, now: float) -> None:
        """Cancel a check in progress for which no caller waits, and make it due again.

        Values are about to be written: if they change the number of parameters, its file is stale, and is
        read again.
        """
        fetch = self._resync
        if fetch is not None and fetch.check is not None:
            self._resync = None
            self._host.end_fetch(fetch, now)
            self._check_at = now

    def compare(self, now: float) -> bool:
        """Return whether the vehicle has just announced the table's hash, which is then confirmed."""
        table, announced = self._table, self.announced
        if announced is None or not announced.is_fresh(now) or announced.hash != table.hash:
            return False
        if not table.complete or announced.count != table.size:
            return False
        table.verify()
        self._changed_only_by_us = True
        return True

    def tick(self, now: float) -> None:
        """Request the hash when it is due."""
        if self._settle_at <= now:
            self._settle_at = math.inf
            self.ask(now)
        if self._foreign_check_at <= now:
            self._foreign_check_at = math.inf
            self._check_after_foreign(now)
        if self._check_at <= now:
            self._check(now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return min(self._settle_at, self._foreign_check_at, self._check_at)

    def fail_all(self, error: Exception, now: float) -> None:
        """End the reads of volatile values with the error, and request nothing any more."""
        if self.refresh is not None:
            self.refresh.fail(error, now)
        self.stop()

    def stop(self) -> None:
        """Request nothing any more until there is a new reason."""
        self._settle_at = self._foreign_check_at = self._check_at = math.inf
        self._is_checking = self._reads_volatile = False

    @property
    def must_not_poll(self) -> bool:
        """Whether the component is lost, or in a mode in which requests are sent for callers only."""
        presence = self._presence
        return presence.is_lost or presence.is_high_latency or self._reads.pace.gap >= LOW_BANDWIDTH_GAP

    @property
    def may_resync(self) -> bool:
        """Whether a hash mismatch leads to a new fetch."""
        return self._keeps_in_sync and not self.must_not_poll

    # private

    @property
    def _keeps_in_sync(self) -> bool:
        """Whether the table is to be kept in sync."""
        sync_settings = self._sync_settings
        return self._was_synced and sync_settings.interval < math.inf and sync_settings.policy is Policy.AUTO

    @property
    def _shortest_pause(self) -> float:
        """Seconds from one check by download to the next, at least, for any reason."""
        return max(DOWNLOAD_PAUSE_MIN, self._download_time)

    def _mark_unsynced(self) -> None:
        if self.synced:
            self.synced = False
            self._was_marked_unsynced = True
            self._changed_names.clear()

    def _not_confirmed(self) -> None:
        """Doubt the verified values: the table was to be confirmed and was not."""
        self._mark_unsynced()
        self._table.doubt(Trust.VERIFIED)

    def _read_unhashed(self, confirmed: int, now: float, *, again: bool = False) -> None:
        """Read the values that the hash does not cover; `again` is as in `VolatileReads`."""
        if self._sync_settings.policy is not Policy.AUTO:
            return
        refresh = VolatileReads(self._reads, self._table, confirmed, self._context, now, again=again)
        if not refresh.done:
            self.refresh = refresh
            refresh.on_done.append(partial(self._refresh_ended, refresh))

    def _refresh_ended(self, refresh: VolatileReads) -> None:
        took = refresh.ended_at - refresh.begun_at
        self._volatile_at = refresh.ended_at + took * (1.0 / VOLATILE_SHARE - 1.0)
        if self.refresh is refresh:
            self.refresh = None

    def _foreign_changed(self, now: float) -> None:
        """Process a change by the vehicle or another station. A fetch in progress brings further ones too."""
        if self._keeps_in_sync and self.expects_hash and not self._context.is_fetching:
            earliest = self._foreign_checked_at + FOREIGN_CHECK_INTERVAL
            self._foreign_check_at = max(now + FOREIGN_SETTLING_TIME, earliest)

    def _check_after_foreign(self, now: float) -> None:
        """Request the hash, where it can prove the present values: changes by others have stopped."""
        if self._table.is_provable and not (self._context.is_fetching or self.must_not_poll):
            self._foreign_checked_at = now
            self.ask(now)

    def _check(self, now: float) -> None:
        """Check whether the table still matches the vehicle's, if the link is idle."""
        if self.holds or self._host.is_link_busy:
            self._check_at = now + IDLE_CHECK_INTERVAL
            return
        self._plan_check(now, now)
        if self.must_not_poll:
            self._is_checking = False
        elif self.expects_hash:
            self._reads_volatile = self._keeps_in_sync
            self.ask(now)
        elif self._check_at < math.inf or self._has_count_changed:
            if self._files.is_in_use(now):
                self._check_at = min(self._check_at, now + FILE_IN_USE_RETRY)
            else:
                may_list = self._sync_settings.without_hash or self._has_count_changed
                self._begin_resync(now, Check(may_list=may_list))

    def _plan_check(self, now: float, known_at: float) -> None:
        """Plan the next check to end an interval after the moment of the known table."""
        self._checked_at = now
        self._check_at = math.inf
        if not self._keeps_in_sync:
            return
        settings = self._sync_settings
        if self.expects_hash:
            self._check_at = max(known_at + settings.interval, now)
        elif settings.without_hash or self._host.may_use_file:
            share = CHOSEN_DOWNLOAD_SHARE if settings.without_hash else DOWNLOAD_SHARE
            interval = max(settings.interval, self._download_time / share)
            self._check_at = max(known_at + interval, now + self._shortest_pause)

    def _take_hash(self, read: Read) -> None:
        """Process a response to our own request for the hash, or its absence."""
        table, now = self._table, read.ended_at
        reads_volatile, self._reads_volatile = self._reads_volatile, False
        if read.result is None:
            has_none = isinstance(read.error, UnknownParameter) and self.announced is None
            if has_none:
                self._context.has_hash = False
            elif self._context.has_hash is False:
                self._context.has_hash = None
            self._is_checking = False
            if has_none and self._keeps_in_sync:
                self._check_at = now  # blocks checks of tables without one
            return
        if self._context.is_doubted:
            self._check_at = now  # again once the identity is known
            return
        announced = int.from_bytes(read.result.raw, "little")
        if self.compare(now):
            if self._was_marked_unsynced:
                self.synced = True
                self._read_unhashed(announced, now)
            if reads_volatile and now >= self._volatile_at:
                self._read_unhashed(announced, now, again=True)
            self._settled(now, now)
        elif self._context.is_writing or self._context.is_fetching:
            return
        elif table.hash is None and self._changed_only_by_us and not self._keeps_in_sync:
            # cannot be recomputed here: the cause may be our writes only, or also a missed change
            self._is_checking = False
        else:
            self._not_confirmed()
            self._is_checking = False
            if self._keeps_in_sync and not self.must_not_poll:
                self._begin_resync(now, None)

    def _begin_resync(self, now: float, check: Check | None) -> None:
        fetch = self._resync = self._host.begin_fetch(now, refresh=check is not None, check=check)

        def ended() -> None:
            self._resync = None
            self._host.end_fetch(fetch, fetch.ended_at)
            if isinstance(fetch.error, FileTransferError) and fetch.error.code in BUSY:
                self._check_at = min(self._check_at, fetch.ended_at + FILE_IN_USE_RETRY)
            elif self._has_count_changed:
                pause = max(GAP_CHECK_INTERVAL, self._shortest_pause)
                self._check_at = min(self._check_at, fetch.ended_at + pause)

        if fetch.done:
            ended()
        else:
            fetch.on_done.append(ended)

    def _settled(self, now: float, known_at: float) -> None:
        """Take the state of the table as known, and report that if it was in doubt.

        Args:
            now: the time.
            known_at: the moment of the vehicle's table that is known: later changes may be missing.
        """
        self._is_checking = False
        self._plan_check(now, known_at)
        if not self.synced:
            return
        if self._was_marked_unsynced or self._changed_names:
            self._host.resynced(tuple(self._changed_names), self._table.hash)
        self._was_marked_unsynced = False
        self._changed_names.clear()
