"""CacheWriter: loads cached tables, and writes new values to the cache in batches, in a thread."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, TypeVar

import anyio
import anyio.from_thread
import anyio.lowlevel

from paramclient.cache import (
    CLOCK_SLACK,
    CacheChange,
    CachedComponent,
    CachedExtTable,
    ExtTableUpdate,
    ObservedParams,
    ParamCache,
    StoredExtParam,
    StoredParam,
    TableState,
    TableUpdate,
    UnixTimes,
)
from paramclient.client.worker_thread import Worker
from paramclient.errors import CacheError, UsageError
from paramclient.links.clock_offset import seconds_ahead
from paramclient.model.ext_params import ExtParam
from paramclient.model.identity import Identity
from paramclient.model.params import Params
from paramclient.model.values import Param
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params.table import Observation

__all__ = ["CacheWriter", "choose_cache"]

CACHE_FLUSH_INTERVAL: Final = 0.25
"""Seconds from a change to its commit, unless the computer is overloaded: changes are collected for this
time, less the expected duration of the commit. A download takes several batches."""
COMMIT_RESERVE: Final = 0.04
"""Seconds of `CACHE_FLUSH_INTERVAL` reserved for a commit that takes longer than expected."""
FIRST_COMMIT_TIME: Final = 0.1
"""Seconds that the first commit is expected to take beside a busy event loop: it creates the file."""
COMMIT_TIME_DECAY: Final = 0.8
"""Factor by which the expected duration of a commit decreases after a quicker one: beside a busy event loop,
durations vary."""
DOWNLOAD_INTERVAL: Final = 10.0
"""Seconds for which the values of a running fetch are collected, if more than `UNBATCHED_FETCHES_MAX` run.
Most fetches end sooner, so that each table is written once; writing it in parts takes several times as long.
A killed process loses at most these values of a download."""
UNBATCHED_FETCHES_MAX: Final = 8
"""Number of running fetches up to which their values are written every `CACHE_FLUSH_INTERVAL`."""
NEW_SHARE_MIN: Final = 0.5
"""Minimum share of new values in a table of a running fetch before a part of it is written: a part takes as
long as the whole table."""
TRANSACTION_PARAMS: Final = 2_000
"""Number of parameters after which a transaction ends: collecting 2,000 blocks the event loop for a few
milliseconds."""
RETRY_INTERVAL: Final = 5.0
"""Seconds until the next attempt after a failed write."""
VEHICLES_MAX: Final = 16
"""Maximum number of vehicles under one address that are cached in a session: more than are swapped in a day.
A vehicle that changes its identity each time cannot fill the disk."""
TABLES_MAX: Final = 4_000
"""Maximum number of tables cached in a session: four for each component that can be followed."""

logger = logging.getLogger(__name__)
Result = TypeVar("Result")


class CacheWriter:
    """Writes the tables of one client to its cache, and loads cached tables of new components.

    A cache error causes one warning in the log until the next successful write. Values that could not be
    written stay queued and are written later.

    Args:
        cache: the cache, or None.
        owned: whether `close` closes the cache.
        identity_of: returns the identity of a component's vehicle; None while it is not settled.
        is_doubted: returns whether another vehicle may use the address of a component by now.
        renewed: called when a write of another station has updated tables.
        detect_suspend: called before times are converted to unix times, to detect suspend of the computer.
        clock: returns unix seconds; None for the clock of this computer.
        now: returns the time of the components.
    """

    def __init__(
        self,
        cache: ParamCache | None,
        *,
        owned: bool,
        identity_of: Callable[[ComponentMachine], Identity | None],
        is_doubted: Callable[[ComponentMachine], bool],
        renewed: Callable[[], None] | None = None,
        detect_suspend: Callable[[], None] | None = None,
        clock: Callable[[], float] | None = None,
        now: Callable[[], float] = anyio.current_time,
    ) -> None:
        self._cache = cache
        self._identity_of = identity_of
        self._is_doubted = is_doubted
        self._renewed = _nothing if renewed is None else renewed
        self._detect_suspend = _nothing if detect_suspend is None else detect_suspend
        self._clock = _time_of_day if clock is None else clock
        self._now = now
        self._owned = owned
        self._worker = Worker("paramclient cache")
        self._cached: dict[ComponentMachine, _CachedComponent] = {}
        self._flushing = anyio.Lock()
        self._failure: CacheError | UsageError | None = None  # None after a successful write
        self._failures = 0
        self._syncs_begun = self._synced = 0  # numbers of the last sync begun, and the last that succeeded
        self._tables: dict[tuple[int, int], bool] = {}
        self._something_to_write = anyio.Event()
        self._waiting_since = -math.inf  # time at which that was set
        self._commit_time = FIRST_COMMIT_TIME  # expected seconds
        self._loading: set[ComponentMachine] = set()
        self._vehicles: dict[tuple[int, int], set[str]] = {}  # keys of identities cached in this session
        self._has_refused = self._has_refused_same_identity = False
        self._replacements = 0 if cache is None else cache.replacements
        self._has_written = False
        self._are_many = False
        self._other_writes: set[CacheChange] = set()
        self._unsubscribe: Callable[[], None] = _nothing
        self._flushed_at = (math.inf, -math.inf)  # by the components' clock, and in unix seconds

    async def open(self) -> None:
        """Load the list of cached components, and subscribe to writes of other stations."""
        if self._cache is not None:
            for each in await self._run(self._cache.components) or ():
                address = (each.system, each.component)
                self._tables[address] = self._tables.get(address, False) or each.hash is not None
            callback = partial(_pass_on, anyio.lowlevel.current_token(), self._record_other_write)
            self._unsubscribe = await self._run(partial(self._cache.subscribe, callback)) or _nothing

    async def close(self) -> None:
        """Write all new values, log a warning for lost ones, and end the thread."""
        self._unsubscribe()
        is_written = False
        try:
            is_written = await self.flush() and await self.flush()  # the second rewrites a replaced file
        finally:
            if not is_written:
                self._log_lost_values()
            cache = self._cache if self._owned else None
            await self._worker.close(_nothing if cache is None else cache.close)

    async def run_in_thread(self, work: Callable[[], Result]) -> Result:
        """Run a blocking call in the cache's thread after queued calls. Cancellation does not stop it."""
        return await self._worker.run(work)

    def may_have(self, system: int, component: int) -> bool:
        """Return whether the cache had a table for this address when the client was opened."""
        return (system, component) in self._tables

    def may_hit(self, system: int, component: int) -> bool:
        """Return whether the cache had a table with a hash for this address when the client was opened."""
        return self._tables.get((system, component), False)

    def follow(self, machine: ComponentMachine, identity: Identity) -> bool:
        """Update the identity of a cached component. Return False if `load_cached` must load its table first.

        If the identity is that of another vehicle, the values queued for the previous vehicle are discarded.
        """
        kept = self._cached.get(machine)
        if kept is not None and kept.identity.key == identity.key:
            kept.identity = identity
            return True
        if kept is not None:
            self.discard_queued(machine)
        return False

    async def load_cached(self, machine: ComponentMachine, identity: Identity) -> bool:
        """Load the table that is cached under an identity, and write new values under it from now on.

        Return False if the call has no effect: another call for the component is running, or the identity is
        no longer settled.
        """
        if machine in self._loading:
            return False
        self._loading.add(machine)
        try:
            while self._has_capacity(machine, identity):
                cached, extended = await self._load(machine, identity)
                logger.debug("cached under %s/%s: %s", identity.key, machine.component, cached or "nothing")
                current = self._identity_of(machine)
                if current is None or (current.key == identity.key and self.follow(machine, current)):
                    return False
                if current.key == identity.key:
                    if self._has_capacity(machine, current):  # others may have used it meanwhile
                        self._begin_caching(machine, current, cached, extended)
                    break
                identity = current  # another vehicle has replaced it meanwhile
            return True
        finally:
            self._loading.discard(machine)

    def is_loading(self, machine: ComponentMachine) -> bool:
        """Return whether `load_cached` is running for a component."""
        return machine in self._loading

    async def save_on_close(self, machine: ComponentMachine) -> None:
        """Write the table of a component that closes before its identity was settled or its cache loaded.

        A component may never report its identity. Its table is written if it is complete.
        """
        known = self._identity_of(machine)
        has_values = bool(machine.table.params or machine.ext.table.params)
        is_complete = machine.table.complete or machine.ext.table.complete
        if not (is_complete or (known is not None and has_values)):
            return
        identity = known or machine.identity
        if not self.follow(machine, identity):
            cached, extended = await self._load(machine, identity)
            if self._has_capacity(machine, identity):
                self._begin_caching(machine, identity, cached, extended)

    def synced(self, machine: ComponentMachine, *, is_whole: bool) -> None:
        """Record that the table was verified now; `is_whole`: by a full download."""
        kept = self._cached.get(machine)
        if kept is not None:
            kept.proven_at = self._now() + machine.table.suspended
            if is_whole:
                kept.whole_at = kept.proven_at

    def discard_queued(self, machine: ComponentMachine) -> None:
        """Discard the queued values of a component: several vehicles use its address, or did until now."""
        self._cached.pop(machine, None)
        machine.table.take_dirty()
        machine.table.take_overwritten()
        machine.table.take_removed_at()
        machine.ext.table.take_dirty()
        machine.ext.table.take_removed_at()
        machine.ext.table.take_overwritten()

    def remove_component(self, machine: ComponentMachine) -> None:
        """Remove a component that is no longer followed."""
        self._cached.pop(machine, None)

    @property
    def is_held_back(self) -> bool:
        """Whether a component with queued values may be another vehicle by now, so that writing must wait."""
        return any(
            (machine.table.dirty or machine.ext.table.dirty) and self._is_doubted(machine)
            for machine in self._cached
        )

    def wake(self) -> None:
        """Run the writer: there may be new values."""
        if not self._something_to_write.is_set():
            self._waiting_since = anyio.current_time()
            self._something_to_write.set()

    async def run(self) -> None:
        """Write new values in batches, until cancelled."""
        while True:
            await self._something_to_write.wait()
            pause = CACHE_FLUSH_INTERVAL - COMMIT_RESERVE - min(self._commit_time, CACHE_FLUSH_INTERVAL / 2)
            await anyio.sleep_until(self._waiting_since + pause)
            self._something_to_write = anyio.Event()
            begun_at = anyio.current_time()
            is_written = await self.flush(is_last=False)
            self._commit_time = max(anyio.current_time() - begun_at, self._commit_time * COMMIT_TIME_DECAY)
            if not is_written:
                await anyio.sleep(RETRY_INTERVAL)
            if self.is_held_back or not is_written:
                self.wake()
            await self._apply_other_writes()

    async def flush(self, *, is_last: bool = True) -> bool:
        """Write new values. Return False if the write failed. Cancellation loses no value.

        Args:
            is_last: whether to write values of running fetches too, which are otherwise collected.
        """
        async with self._flushing:
            return await self._flush(is_last=is_last)

    async def write_all(self) -> None:
        """Write all received values, before a query of the cache.

        Raises:
            CacheError: the write failed. The values stay queued and are written later.
        """
        failures = self._failures
        async with self._flushing:
            if failures == self._failures and await self._flush(is_last=True):
                return
        raise CacheError(f"the last received values could not be written: {self._failure}") from self._failure

    def obstacle(self, machine: ComponentMachine) -> str | None:
        """Return why values of a component cannot be written now; None if they can."""
        if self._cache is None:
            return "the client has no cache"
        if machine not in self._cached or self._is_doubted(machine):
            return f"it is not known which vehicle {machine.system}/{machine.component} is"
        return None

    async def write_durably(self, machine: ComponentMachine) -> None:
        """Write all received values of a component and sync them to the disk, safe from power loss.

        Concurrent calls share a sync.

        Raises:
            CacheError: the write or the sync failed. The values stay queued and are written later.
        """
        cache, begun = self._cache, self._syncs_begun
        async with self._flushing:
            if self._synced <= begun:  # otherwise a sync that started after this call has succeeded
                self._syncs_begun += 1
                number = self._syncs_begun
                is_done = cache is not None and await self._flush(is_last=True)
                if cache is None or not (is_done and await self._run(partial(_sync, cache))):
                    raise CacheError(f"it could not be written: {self._failure}") from self._failure
                self._synced = number
        if (why := self.obstacle(machine)) is not None:
            raise CacheError(why)

    async def _flush(self, *, is_last: bool) -> bool:
        portion: list[_PendingUpdates] = []
        size = 0
        times = self._present_times()
        fetches = sum(machine.fetch is not None for machine in self._cached)
        self._are_many = fetches > (
            0 if self._are_many else UNBATCHED_FETCHES_MAX
        )  # until the last has ended
        for kept in list(self._cached.values()) if self._cache is not None else ():
            if self._are_many and not is_last and self._is_for_later(kept):
                self.wake()
            elif self._cached.get(kept.machine) is kept:
                for new in self._updates_of(kept, times):
                    portion.append(new)
                    size += len(new.update.params)
            if size >= TRANSACTION_PARAMS:
                if not await self._write(portion):
                    return False
                portion, size = [], 0
        return await self._write(portion) and await self._write_extended(times)

    def _is_for_later(self, kept: _CachedComponent) -> bool:
        """Return whether a running fetch delivers more values that are written together later."""
        fetch, table = kept.machine.fetch, kept.machine.table
        if fetch is None:
            return False
        if len(table.dirty) < NEW_SHARE_MIN * len(table.params):
            return True
        began_at = fetch.first_value_at if fetch.first_value_at < math.inf else fetch.begun_at
        return anyio.current_time() < max(kept.written_at, began_at) + DOWNLOAD_INTERVAL

    async def _write(self, updates: list[_PendingUpdates]) -> bool:
        """Write the collected updates. Return False if the write failed."""
        cache = self._cache
        if cache is None or not updates:
            return True
        is_written = False
        try:
            is_written = await self._save(cache, [new.update for new in updates])
        finally:
            for new in updates:
                if not is_written and self._cached.get(new.kept.machine) is new.kept:
                    new.requeue()
            for kept in self._cached.values() if self._failure is not None else ():
                kept.machine.table.keeps_all = True
        if is_written:
            self._failure = None
            for kept in self._cached.values():
                kept.machine.table.keeps_all = False
            logger.debug("written: %s values", sum(len(new.update.params) for new in updates))
            self._requeue_if_replaced(cache.replacements)
        return is_written

    async def _write_extended(self, times: UnixTimes) -> bool:
        """Write the changed extended parameters of all components. Return False if the write failed."""
        cache = self._cache
        if cache is None:
            return True
        pending = [
            new for kept in self._cached.values() if (new := self._ext_updates_of(kept, times)) is not None
        ]
        if not pending:
            return True
        is_written = False
        try:
            updates = [new.update for new in pending]
            is_written = await self._save_extended(cache, updates)
        finally:
            for new in pending:
                if not is_written and self._cached.get(new.kept.machine) is new.kept:
                    new.requeue()
        if is_written:
            self._failure = None
            self._requeue_if_replaced(cache.replacements)
        return is_written

    def _ext_updates_of(self, kept: _CachedComponent, times: UnixTimes) -> _PendingExtUpdate | None:
        """Return the update of a table of extended parameters since the last write, or None."""
        machine, table = kept.machine, kept.machine.ext.table
        state = (table.count, table.complete)
        if not table.complete and kept.ext_state is not None and table.count in (None, kept.ext_state[0]):
            state = kept.ext_state  # a part of a table that is complete in the cache
        is_changed = bool(table.dirty or table.gone) or (table.count is not None and state != kept.ext_state)
        if not is_changed or self._is_doubted(machine):
            return None
        before, kept.ext_state = kept.ext_state, state
        dirty, gone, overwritten = table.take_dirty(), table.take_removed_at(), table.take_overwritten()
        earlier = [StoredExtParam.of(param, times(moment), by) for param, by, moment in overwritten]
        update = ExtTableUpdate(
            identity=kept.identity,
            component=machine.component,
            autopilot=machine.identification.autopilot or 0,
            at=times.at,
            params=earlier
            + [
                StoredExtParam.of(table.params[name], times(table.moments.get(name, math.inf)), by)
                for name, by in dirty.items()
            ],
            removed={name: times(moment) for name, moment in gone.items()},
            count=state[0],
            complete=state[1],
        )
        return _PendingExtUpdate(kept, dirty, gone, overwritten, before, update)

    def _record_other_write(self, change: CacheChange) -> None:
        """Record that another station has written to a table."""
        self._other_writes.add(change)
        self.wake()

    async def _apply_other_writes(self) -> None:
        """Update cached values from the newer writes of other stations."""
        written, self._other_writes = self._other_writes, set()
        for kept in list(self._cached.values()):
            machine, identity = kept.machine, kept.identity
            if CacheChange(identity.key, machine.component) in written and self._cache is not None:
                cached = await self._run(partial(self._cache.load, identity.key, machine.component))
                if cached is not None and self._cached.get(machine) is kept:
                    machine.renew(cached.params, self._moments(cached))
                    self._renewed()
                extended = await self._run(partial(self._cache.load_ext, identity.key, machine.component))
                if extended is not None and self._cached.get(machine) is kept:
                    machine.ext.use_cached(extended.params, self._moments(extended))
                    self._renewed()

    def _requeue_if_replaced(self, replacements: int) -> None:
        """Queue all values again if the cache file was replaced: the new file lacks earlier writes."""
        is_another = replacements != self._replacements and (self._has_written or bool(self._tables))
        self._replacements = replacements
        self._has_written = True
        if not is_another:
            return
        for kept in self._cached.values():
            table = kept.machine.table
            if table.complete and kept.whole_at is None:
                kept.whole_at = self._now() + table.suspended
            kept.state = None
            for name in table.params:
                table.dirty.setdefault(name, "vehicle")
            kept.ext_state = None
            kept.machine.ext.table.mark_dirty()
        self.wake()

    async def _save(self, cache: ParamCache, updates: list[TableUpdate]) -> bool:
        return await self._run(partial(_save, cache, updates, self._clock)) is not None

    async def _save_extended(self, cache: ParamCache, updates: list[ExtTableUpdate]) -> bool:
        return await self._run(partial(_save_ext, cache, updates, self._clock)) is not None

    def _has_capacity(self, machine: ComponentMachine, identity: Identity) -> bool:
        """Return whether the table of a vehicle may be cached, within the limits of the session."""
        address = (machine.system, machine.component)
        others = [each for each in self._cached.values() if _has_same_identity(each, machine, identity)]
        if others:
            if not self._has_refused_same_identity:
                logger.warning(
                    "%d/%d at %s has the same identity as the vehicle at %s (%s): its table is not cached",
                    *address,
                    machine.peer_in_words,
                    others[0].machine.peer_in_words,
                    identity.key,
                )
            self._has_refused_same_identity = True
            return False
        vehicles = self._vehicles.get(address, set())
        if identity.key in vehicles:
            return True
        is_full = sum(map(len, self._vehicles.values())) >= TABLES_MAX
        if len(vehicles) >= VEHICLES_MAX or is_full:
            if not self._has_refused:
                logger.warning("%d/%d: too many vehicles on this link: its table is not cached", *address)
            self._has_refused = True
            return False
        self._vehicles[address] = vehicles | {identity.key}
        return True

    async def _load(
        self, machine: ComponentMachine, identity: Identity
    ) -> tuple[CachedComponent | None, CachedExtTable | None]:
        """Return the cached tables of a component: plain and extended parameters."""
        if self._cache is None:
            return None, None
        found = await self._run(partial(_load_both, self._cache, identity.key, machine.component))
        return (None, None) if found is None else found

    def _begin_caching(
        self,
        machine: ComponentMachine,
        identity: Identity,
        cached: CachedComponent | None,
        extended: CachedExtTable | None,
    ) -> None:
        table = machine.table
        whole_at = self._now() + table.suspended if table.complete else None
        kept = _CachedComponent(machine, identity, whole_at=whole_at, written_at=anyio.current_time())
        self._cached[machine] = kept
        for name in table.params:
            table.dirty.setdefault(name, "vehicle")
        if cached is not None:
            # a partial table is resumed by index: its indices must be of the same firmware on the same board
            is_same = identity.uid is not None and _firmware(cached.identity) == _firmware(identity)
            machine.use_cached(
                _of_firmware(cached, identity),
                self._now(),
                count=cached.count,
                confirmed=cached.hash,
                complete=cached.complete,
                volatile=cached.volatile,
                volatile_known=cached.volatile_known,
                placed=cached.complete or (is_same and cached.count is not None),
                moments=self._moments(cached),
            )
            if is_same and machine.fetches.file_works is None:
                machine.fetches.file_works = cached.file_works
            kept.synced_at = cached.synced_at
            kept.state = None if table.has_outdated_indices else self._state(machine, kept)
        if machine.sync.synced:
            kept.proven_at = self._now() + table.suspended
        machine.ext.table.mark_dirty()
        if extended is not None:
            machine.ext.use_cached(extended.params, self._moments(extended))
            kept.ext_state = (extended.count, extended.complete)

    def _present_times(self) -> UnixTimes:
        """Return the conversion of component times to unix times, by the current clock of the computer.

        If the clock was set back by less than `CLOCK_SLACK` since the last flush, values received since then
        get later times than the values written then.
        """
        self._detect_suspend()
        since, last = self._flushed_at
        ahead = seconds_ahead(self._clock, self._now)
        now = self._now()
        at = now + ahead
        if at < last - CLOCK_SLACK:  # the cache handles such a clock jump
            since, last = math.inf, -math.inf
        times = UnixTimes(max(at, last), ahead, since, last)
        self._flushed_at = (now, times.at)
        return times

    def _moments(self, cached: CachedComponent | CachedExtTable) -> dict[str, float]:
        """Return the observation times of the values of a cached table, in component time."""
        self._detect_suspend()
        now = self._now()
        ahead = seconds_ahead(self._clock, self._now)
        if not math.isfinite(ahead):
            return {}
        return {name: min(at - ahead, now) for name, at in cached.heard_at.items()}

    def _updates_of(self, kept: _CachedComponent, times: UnixTimes) -> list[_PendingUpdates]:
        """Return the updates of a table since the last write, and mark them as written."""
        machine, table = kept.machine, kept.machine.table
        if self._is_doubted(machine):
            return []
        proven_at, kept.proven_at = kept.proven_at, None
        if proven_at is not None:
            kept.synced_at = times(proven_at - table.suspended)
        state = self._state(machine, kept)
        if not (table.dirty or kept.whole_at is not None or state != kept.state):
            return []
        changed = table.changed
        dirty = table.take_dirty()
        overwritten = table.take_overwritten()
        removed_at = table.take_removed_at()
        whole_at, kept.whole_at = kept.whole_at, None
        is_whole = whole_at is not None
        kept.state = state
        kept.written_at = anyio.current_time()
        volatile = table.volatile if table.volatile or table.volatile_known else None
        known = table.params
        params = known.copy() if is_whole else known.only(dirty)
        update = TableUpdate(
            identity=kept.identity,
            component=machine.component,
            autopilot=machine.identification.autopilot or 0,
            at=times.at,
            table=state,
            params=ObservedParams(
                params,
                times,
                volatile=volatile,
                by=dirty,
                overwritten=[
                    StoredParam(
                        param, times(moment), None if volatile is None else param.name in volatile, by
                    )
                    for param, by, moment in overwritten
                ],
            ),
            removed=[name for name in dirty if name not in known],
            removed_at={name: times(moment) for name, moment in removed_at.items()},
            replace=is_whole,
            whole_at=None if whole_at is None else times(whole_at - table.suspended),
        )
        return [
            _PendingUpdates(
                kept, dirty, overwritten, removed_at, changed, params, update, proven_at, whole_at
            )
        ]

    def _state(self, machine: ComponentMachine, kept: _CachedComponent) -> TableState:
        table = machine.table
        return TableState(
            hash=table.hash if table.complete else None,
            count=None if table.has_outdated_indices else table.count,  # the cache keeps the previous indices
            complete=table.complete,
            volatile_known=table.volatile_known,
            synced_at=kept.synced_at,
            file_works=machine.fetches.file_works,
        )

    async def _run(self, work: Callable[[], Result]) -> Result | None:
        """Run a cache call in the thread. Return None if it failed, and log the first failure."""
        try:
            return await self._worker.run(work)
        except (CacheError, UsageError) as error:  # a clock that is far off causes a UsageError
            if self._failure is None:
                logger.warning("continuing without the cache: %s", error)
            self._failure = error
            self._failures += 1
            return None

    def _log_lost_values(self) -> None:
        """Log a warning for each component with values that were not written."""
        for machine, kept in self._cached.items():
            values = len(machine.table.dirty) + len(machine.ext.table.dirty)
            earlier = len(machine.table.overwritten) + len(machine.ext.table.overwritten)
            if values or earlier:
                logger.warning(
                    "%d/%d (%s): not written to the cache, and lost: %d %s and %d earlier %s, as %s",
                    machine.system,
                    machine.component,
                    kept.identity.key,
                    values,
                    "value" if values == 1 else "values",
                    earlier,
                    "value" if earlier == 1 else "values",
                    self._failure,
                )


@dataclass(slots=True)
class _CachedComponent:
    """State of a cached component.

    Attributes:
        machine: the component.
        identity: the identity under which its table is written.
        state: the table state written last, or None.
        synced_at: time of the last verification, in unix seconds, or None.
        proven_at: time of a verification since the last write, in component time with `Table.suspended`, or
            None.
        whole_at: time of a full download since the last write, as `proven_at`.
        written_at: time of the last write, by the clock of the event loop.
        ext_state: count and completeness of the extended parameters, as written last, or None.
    """

    machine: ComponentMachine
    identity: Identity
    state: TableState | None = None
    synced_at: float | None = None
    proven_at: float | None = None
    whole_at: float | None = None
    written_at: float = 0.0
    ext_state: tuple[int | None, bool] | None = None


@dataclass(slots=True)
class _PendingUpdates:
    """Updates of one component in a write, kept to queue them again after a failure."""

    kept: _CachedComponent
    dirty: dict[str, str]
    overwritten: list[Observation]
    removed_at: dict[str, float]
    changed: dict[str, tuple[float, str]]
    params: Params
    update: TableUpdate
    proven_at: float | None
    whole_at: float | None

    def requeue(self) -> None:
        """Queue the updates again after a failed write."""
        kept = self.kept
        if kept.proven_at is None:
            kept.proven_at = self.proven_at
        if kept.whole_at is None:
            kept.whole_at = self.whole_at
        kept.machine.table.restore_unwritten(
            self.dirty, self.overwritten, self.removed_at, self.changed, self.params
        )
        kept.state = None


@dataclass(slots=True)
class _PendingExtUpdate:
    """An update of extended parameters in a write, kept to queue it again after a failure."""

    kept: _CachedComponent
    dirty: dict[str, str]
    gone: dict[str, float]
    overwritten: list[tuple[ExtParam, str, float]]
    state: tuple[int | None, bool] | None
    update: ExtTableUpdate

    def requeue(self) -> None:
        """Queue the update again after a failed write."""
        self.kept.ext_state = self.state
        self.kept.machine.ext.table.put_back(self.dirty, self.gone, self.overwritten)


def choose_cache(
    cache: ParamCache | str | os.PathLike[str] | bool | None, *, is_log: bool
) -> ParamCache | None:
    """Return the cache for the `cache` argument of `ParamClient`, or None.

    Raises:
        UsageError: the argument names a cache, and the link is a log.
    """
    if is_log and cache not in (None, True, False):
        raise UsageError("a replayed log uses no cache: `paramclient import` writes its values into one")
    if isinstance(cache, ParamCache):
        return cache
    if cache is False or is_log:
        return None
    return ParamCache(None if cache is None or cache is True else cache)


def _has_same_identity(kept: _CachedComponent, machine: ComponentMachine, identity: Identity) -> bool:
    """Return whether a cached component has equal ids and identity at another peer."""
    other = kept.machine
    has_equal_ids = (other.system, other.component) == (machine.system, machine.component)
    return has_equal_ids and other is not machine and kept.identity.key == identity.key


def _time_of_day() -> float:
    return time.time()


def _firmware(identity: Identity) -> tuple[int, str]:
    return identity.firmware, identity.git_hash


def _save(cache: ParamCache, updates: list[TableUpdate], clock: Callable[[], float]) -> bool:
    cache.save(updates, clock=clock)
    return True


def _save_ext(cache: ParamCache, updates: list[ExtTableUpdate], clock: Callable[[], float]) -> bool:
    cache.save_ext(updates, clock=clock)
    return True


def _load_both(
    cache: ParamCache, key: str, component: int
) -> tuple[CachedComponent | None, CachedExtTable | None]:
    return cache.load(key, component), cache.load_ext(key, component)


def _sync(cache: ParamCache) -> bool:
    cache.sync()
    return True


def _of_firmware(cached: CachedComponent, identity: Identity) -> Mapping[str, Param]:
    """Return the cached parameters, without defaults if they are of another firmware."""
    if _firmware(cached.identity) == _firmware(identity):
        return cached.params
    return {name: replace(param, default=None) for name, param in cached.params.items()}


def _pass_on(
    token: anyio.lowlevel.EventLoopToken, callback: Callable[[CacheChange], None], change: CacheChange
) -> None:
    """Call a function in the event loop from another thread; do nothing if the event loop has ended."""
    with suppress(anyio.RunFinishedError):
        anyio.from_thread.run_sync(callback, change, token=token)


def _nothing() -> None:
    return
