"""CacheWriter: loads cached tables, and writes new values to the cache in batches, in a thread."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, TypeAlias, TypeVar

import anyio
import anyio.to_thread

from paramclient.cache import (
    YEAR_10000,
    CachedComponent,
    CachedExtTable,
    ParamCache,
    StoredParam,
    TableState,
    TableUpdate,
    is_database_url,
)
from paramclient.errors import CacheError, UsageError
from paramclient.links.clock_offset import seconds_ahead
from paramclient.model.identity import Identity
from paramclient.model.params import Params
from paramclient.model.values import Param
from paramclient.protocol.component import ComponentMachine

__all__ = ["CACHE_FLUSH_INTERVAL", "CacheWriter", "choose_cache"]

CACHE_FLUSH_INTERVAL: Final = 0.25
"""Seconds from a change to its commit, unless the computer is overloaded: changes are collected for this
time, less `COMMIT_RESERVE`."""
COMMIT_RESERVE: Final = 0.125
"""Seconds of `CACHE_FLUSH_INTERVAL` reserved for a commit, which takes up to 0.11 s beside a busy loop."""
RETRY_INTERVAL: Final = 5.0
"""Seconds until the next attempt after a failed write."""
PENDING_MAX: Final = 1_024
"""Updates of one component that wait for the cache: above it, the oldest are dropped, and the whole table is
written later. They take four minutes of changes without a pause."""
CLOSE_WAIT_MAX: Final = 6.0
"""Seconds for which `close` waits for the cache: longer than another process may lock a file."""
DATABASE_WAIT_MAX: Final = 2.0
"""Seconds for which `close` waits for a database that is away: about those of its restart."""
DATABASE_RETRY_INTERVAL: Final = 0.3
"""Seconds between two attempts of `close` to reach a database."""
CLOCK_STEP_MAX: Final = 5.0
"""Seconds by which the clock may be set back without an effect: later values keep later times."""

logger = logging.getLogger(__name__)
Result = TypeVar("Result")
Update: TypeAlias = Callable[[], TableUpdate]
"""Makes an update in the cache's thread, of copies of what it needs."""


class CacheWriter:
    """Writes the tables of one client to its cache, and loads cached tables of new components.

    A cache error causes one warning in the log until the next successful write. Values that could not be
    written stay in memory and are written later.

    Args:
        cache: the cache, or None.
        owned: whether `close` closes the cache.
        identity_of: returns the identity of a component's vehicle; None while it is not settled.
        is_doubted: returns whether another vehicle may use the address of a component by now.
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
        detect_suspend: Callable[[], None] | None = None,
        clock: Callable[[], float] | None = None,
        now: Callable[[], float] = anyio.current_time,
    ) -> None:
        self._cache = cache
        self._identity_of = identity_of
        self._is_doubted = is_doubted
        self._detect_suspend = detect_suspend
        self._clock = clock
        self._now = now
        self._owned = owned
        self._thread = anyio.CapacityLimiter(1)
        self._cached: dict[ComponentMachine, _CachedComponent] = {}
        self._flushing = anyio.Lock()
        self._failure: CacheError | None = None  # None after a successful write
        self._logs_failures = True
        self._retry_at = -math.inf
        self._syncs_begun = self._synced = 0  # numbers of the last sync begun, and the last that succeeded
        self._tables: dict[tuple[int, int], bool] = {}
        self._something_to_write = anyio.Event()
        self._waiting_since = -math.inf  # time at which that was set
        self._loading: set[ComponentMachine] = set()
        self._replacements = 0 if cache is None else cache.replacements
        self._ahead = -math.inf  # of unix time to the components' time, in seconds

    async def open(self) -> None:
        """Load the list of cached components."""
        if self._cache is not None:
            for each in await self._try(self._cache.components) or ():
                address = (each.system, each.component)
                self._tables[address] = self._tables.get(address, False) or each.hash is not None

    async def close(self) -> None:
        """Write all new values, and close the cache if it is owned. Log a warning if the values are lost."""
        cache, is_written = self._cache, False
        if cache is None:
            return
        has_failed = self._failure is not None  # and was logged
        self._logs_failures = False  # one warning says what is lost
        with anyio.move_on_after(CLOSE_WAIT_MAX, shield=True):
            give_up_at = anyio.current_time() + (DATABASE_WAIT_MAX if is_database_url(cache.place) else 0)
            # the second flush rewrites a replaced file
            while not (is_written := await self.flush() and await self.flush()):
                if anyio.current_time() >= give_up_at:
                    break
                await anyio.sleep(DATABASE_RETRY_INTERVAL)
        lost = [
            f"{kept.machine.system}/{kept.machine.component} ({kept.identity.key})"
            for kept in self._cached.values()
            if kept.pending or kept.machine.table.dirty or kept.machine.ext.table.dirty
        ]
        if lost and not is_written and not has_failed:
            why = self._failure or "it did not respond"
            logger.warning("the last values of %s are not in the cache, and lost: %s", ", ".join(lost), why)
        if self._owned:
            with anyio.move_on_after(CLOSE_WAIT_MAX, shield=True):
                await self.run_in_thread(cache.close)

    async def run_in_thread(self, work: Callable[[], Result]) -> Result:
        """Run a blocking call in the cache's thread after earlier calls. Cancellation does not stop it."""
        return await anyio.to_thread.run_sync(work, abandon_on_cancel=True, limiter=self._thread)

    def may_have(self, system: int, component: int) -> bool:
        """Return whether the cache had a table for this address when the client was opened."""
        return (system, component) in self._tables

    def may_hit(self, system: int, component: int) -> bool:
        """Return whether the cache had a table with a hash for this address when the client was opened."""
        return self._tables.get((system, component), False)

    # components

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
            while not self._is_duplicate(machine, identity):
                plain, extended = await self.load_tables(identity, machine.component)
                logger.debug("cached under %s/%s: %s", identity.key, machine.component, plain or "nothing")
                current = self._identity_of(machine)
                if current is None or (current.key == identity.key and self.follow(machine, current)):
                    return False
                if current.key == identity.key:
                    if not self._is_duplicate(machine, current):  # others may have used it meanwhile
                        self._begin_caching(machine, current, plain, extended)
                    break
                identity = current  # another vehicle has replaced it meanwhile
            return True
        finally:
            self._loading.discard(machine)

    def is_loading(self, machine: ComponentMachine) -> bool:
        """Return whether `load_cached` is running for a component."""
        return machine in self._loading

    async def save_on_close(self, machine: ComponentMachine) -> None:
        """Prepare the table of a component that closes before its identity was settled or its cache loaded.

        A component may never report its identity. Its table is written if it is complete.
        """
        known = self._identity_of(machine)
        has_values = bool(machine.table.params or machine.ext.table.params)
        is_complete = machine.table.complete or machine.ext.table.complete
        if not (is_complete or (known is not None and has_values)):
            return
        identity = known or machine.identity
        if not self.follow(machine, identity) and not self._is_duplicate(machine, identity):
            self._begin_caching(machine, identity, *await self.load_tables(identity, machine.component))

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
        for table in (machine.table, machine.ext.table):
            table.take_dirty()
            table.take_overwritten()
            table.take_removed_at()

    def remove_component(self, machine: ComponentMachine) -> None:
        """Remove a component that is no longer followed."""
        self._cached.pop(machine, None)

    # writes

    def wake(self) -> None:
        """Run the writer: there may be new values."""
        if not self._something_to_write.is_set():
            self._waiting_since = anyio.current_time()
            self._something_to_write.set()

    async def run(self) -> None:
        """Write new values in batches, until cancelled."""
        while True:
            is_failing = any(kept.pending for kept in self._cached.values())
            with anyio.move_on_after(self._retry_at - anyio.current_time() if is_failing else math.inf):
                await self._something_to_write.wait()
            await anyio.sleep_until(self._waiting_since + CACHE_FLUSH_INTERVAL - COMMIT_RESERVE)
            self._something_to_write = anyio.Event()
            async with self._flushing:
                is_collected = self._collect()
                if is_collected and anyio.current_time() >= self._retry_at:
                    await self._write()
            # a component may be another vehicle by now, and its values wait until that is known
            is_held_back = any(
                (machine.table.dirty or machine.ext.table.dirty) and self._is_doubted(machine)
                for machine in self._cached
            )
            if is_held_back or not is_collected:
                self.wake()

    async def flush(self, *, durable: bool = False) -> bool:
        """Write all received values now. Return False if the write failed. Cancellation loses no value.

        Args:
            durable: whether to wait until they are safe from power loss.
        """
        async with self._flushing:
            return self._collect() and await self._write(durable=durable)

    async def write_all(self) -> None:
        """Write all received values, before a query of the cache.

        Raises:
            CacheError: the write failed. The values stay in memory and are written later.
        """
        if not await self.flush():
            raise CacheError(f"the last received values could not be written: {self._failure}")

    def obstacle(self, machine: ComponentMachine) -> str | None:
        """Return why values of a component cannot be written now; None if they can."""
        if self._cache is None:
            return "the client has no cache"
        if machine not in self._cached or self._is_doubted(machine):
            return f"it is not known which vehicle {machine.system}/{machine.component} is"
        return None

    async def write_durably(self, machine: ComponentMachine) -> None:
        """Write all received values of a component, safe from power loss. Concurrent calls share a sync.

        Raises:
            CacheError: the write failed. The values stay in memory and are written later.
        """
        begun = self._syncs_begun
        async with self._flushing:
            if self._synced <= begun:  # otherwise a sync that started after this call has succeeded
                self._syncs_begun += 1
                number = self._syncs_begun
                if not (self._collect() and await self._write(durable=True)):
                    raise CacheError(f"it could not be written: {self._failure}") from self._failure
                self._synced = number
        if (why := self.obstacle(machine)) is not None:
            raise CacheError(why)

    # for the import of logs, which overrides these two

    async def load_tables(
        self, identity: Identity, component: int
    ) -> tuple[CachedComponent | None, CachedExtTable | None]:
        """Return the cached tables of a component: plain and extended parameters."""
        cache = self._cache
        if cache is None:
            return None, None

        def load() -> tuple[CachedComponent | None, CachedExtTable | None]:
            return cache.load(identity.key, component), cache.load_ext(identity.key, component)

        return await self._try(load) or (None, None)

    def save_updates(self, cache: ParamCache, updates: Sequence[TableUpdate], *, durable: bool) -> None:
        """Write updates, in the cache's thread."""
        cache.save(updates, durable=durable)

    async def _write(self, *, durable: bool = False) -> bool:
        """Write the collected updates. Return False if the write failed."""
        cache = self._cache
        if cache is None:
            return not durable
        taken = {kept: list(kept.pending) for kept in self._cached.values() if kept.pending}
        made = [update for pending in taken.values() for update in pending]
        if not made and not durable:
            return True

        def save() -> bool:
            self.save_updates(cache, [update() for update in made], durable=durable)
            return True

        if not await self._try(save):
            self._retry_at = anyio.current_time() + RETRY_INTERVAL
            return False
        self._failure = None
        for kept, pending in taken.items():
            written = set(map(id, pending))
            kept.pending = [update for update in kept.pending if id(update) not in written]
        is_another = cache.replacements != self._replacements  # a new file, which lacks earlier writes
        self._replacements = cache.replacements
        for kept in self._cached.values():
            if is_another or kept.has_dropped:
                kept.mark_all(self._now())
                self.wake()
        return True

    async def _try(self, work: Callable[[], Result]) -> Result | None:
        """Run a cache call in the thread. Return None if it failed, and log the first failure."""
        try:
            return await self.run_in_thread(work)
        except CacheError as error:
            self._note(error)
            return None

    def _note(self, failure: CacheError) -> None:
        """Log the first of several failures."""
        if self._failure is None and self._logs_failures:
            logger.warning("continuing without the cache: %s", failure)
        self._failure = failure

    def _is_duplicate(self, machine: ComponentMachine, identity: Identity) -> bool:
        """Return whether the table of this vehicle is cached already, from another peer with equal ids."""
        ids = (machine.system, machine.component)
        for other, kept in self._cached.items():
            is_same = (other.system, other.component) == ids and kept.identity.key == identity.key
            if is_same and other is not machine:
                if not kept.has_warned:
                    logger.warning(
                        "%d/%d at %s has the identity of the vehicle at %s (%s): its table is not cached",
                        *ids,
                        machine.peer_in_words,
                        other.peer_in_words,
                        identity.key,
                    )
                kept.has_warned = True
                return True
        return False

    def _begin_caching(
        self,
        machine: ComponentMachine,
        identity: Identity,
        plain: CachedComponent | None,
        extended: CachedExtTable | None,
    ) -> None:
        table = machine.table
        kept = self._cached[machine] = _CachedComponent(machine, identity)
        kept.mark_all(self._now())
        if plain is not None:
            # a partial table is resumed by index: its indices must be of the same firmware on the same board
            is_same = identity.uid is not None and _firmware(plain.identity) == _firmware(identity)
            machine.use_cached(
                _of_firmware(plain, identity),
                self._now(),
                count=plain.count,
                confirmed=plain.hash,
                complete=plain.complete,
                volatile=plain.volatile,
                volatile_known=plain.volatile_known,
                placed=plain.complete or (is_same and plain.count is not None),
                moments=self._moments(plain),
            )
            if is_same and machine.fetches.file_works is None:
                machine.fetches.file_works = plain.file_works
            kept.synced_at = plain.synced_at
            kept.state = None if table.has_outdated_indices else kept.current_state()
        if machine.sync.synced:
            kept.proven_at = self._now() + table.suspended
        if extended is not None:
            machine.ext.use_cached(extended.params, self._moments(extended))
            kept.ext_state = TableState(count=extended.count, complete=extended.complete)

    def _moments(self, cached: CachedComponent | CachedExtTable) -> dict[str, float]:
        """Return the observation times of the values of a cached table, in component time."""
        self._align_clocks()
        now = self._now()
        return {name: min(at - self._ahead, now) for name, at in cached.heard_at.items()}

    def _align_clocks(self) -> None:
        """Update the offset of unix time. A small step back of the clock has no effect."""
        if self._detect_suspend is not None:
            self._detect_suspend()
        measured = seconds_ahead(self._clock or time.time, self._now)
        if not self._ahead - CLOCK_STEP_MAX <= measured < self._ahead:
            self._ahead = measured

    def _collect(self) -> bool:
        """Queue the changes of all tables since the last call. Return False while the clock is not set."""
        if self._cache is None:
            return True
        self._align_clocks()
        times = _Times(self._now(), self._ahead)
        if not 0 <= times.at < YEAR_10000:
            self._note(CacheError(f"the clock of this computer is {times.at} s after 1970"))
            return False
        for kept in self._cached.values():
            if not self._is_doubted(kept.machine):
                kept.collect(times)
        return True


@dataclass(frozen=True, slots=True)
class _Times:
    """Converts component times to unix times.

    Attributes:
        now: the component time.
        ahead: offset of unix time, in seconds.
    """

    now: float
    ahead: float

    @property
    def at(self) -> float:
        """The current unix time."""
        return self.now + self.ahead

    def __call__(self, moment: float) -> float:
        """Return the unix time of a component time."""
        return max(min(moment, self.now) + self.ahead, 0.0)


@dataclass(eq=False)
class _CachedComponent:
    """State of a cached component.

    Attributes:
        machine: the component.
        identity: the identity under which its table is written.
        pending: updates that are not written yet, in order.
        state, ext_state: the states of the tables as collected last, or None.
        synced_at: time of the last verification, in unix seconds, or None.
        proven_at: time of a verification since the last update, in component time with `Table.suspended`, or
            None.
        whole_at: time of a full download since the last update, as `proven_at`.
        has_dropped: whether `pending` has lost updates.
        has_warned: whether a second component with this identity was reported.
    """

    machine: ComponentMachine
    identity: Identity
    pending: list[Update] = field(default_factory=list)
    state: TableState | None = None
    ext_state: TableState | None = None
    synced_at: float | None = None
    proven_at: float | None = None
    whole_at: float | None = None
    has_dropped: bool = False
    has_warned: bool = False

    def mark_all(self, now: float) -> None:
        """Mark all values as not written."""
        table = self.machine.table
        self.has_dropped = False
        self.state = self.ext_state = None
        if table.complete and self.whole_at is None:
            self.whole_at = now + table.suspended
        for name in table.params:
            table.dirty.setdefault(name, "vehicle")
        self.machine.ext.table.mark_dirty()

    def current_state(self) -> TableState:
        """Return the state of the plain table."""
        table = self.machine.table
        return TableState(
            hash=table.hash if table.complete else None,
            count=None if table.has_outdated_indices else table.count,  # the cache keeps the previous indices
            complete=table.complete,
            volatile_known=table.volatile_known,
            synced_at=self.synced_at,
            file_works=self.machine.fetches.file_works,
        )

    def collect(self, times: _Times) -> None:
        """Queue the changes of both tables."""
        for update in (self._plain_update(times), self._ext_update(times)):
            if update is not None:
                self.pending.append(update)
        if len(self.pending) > PENDING_MAX:
            del self.pending[: len(self.pending) - PENDING_MAX]
            self.has_dropped = True

    def _plain_update(self, times: _Times) -> Update | None:
        table = self.machine.table
        proven_at, self.proven_at = self.proven_at, None
        if proven_at is not None:
            self.synced_at = times(proven_at - table.suspended)
        state = self.current_state()
        if not (table.dirty or self.whole_at is not None or state != self.state):
            return None
        self.state = state
        whole_at, self.whole_at = self.whole_at, None
        is_whole = whole_at is not None
        by, overwritten, removed_at = table.take_dirty(), table.take_overwritten(), table.take_removed_at()
        known = table.params
        return partial(
            _make_update,
            self._new_update(times, state, {name: removed_at.get(name) for name in by if name not in known}),
            [StoredParam.of(param, times(moment), None, author) for param, author, moment in overwritten],
            known.copy() if is_whole else known.only(by),
            table.volatile if table.volatile or table.volatile_known else None,
            by,
            times,
            None if whole_at is None else times(whole_at - table.suspended),
        )

    def _ext_update(self, times: _Times) -> Update | None:
        table = self.machine.ext.table
        state, kept = TableState(count=table.count, complete=table.complete), self.ext_state
        if not table.complete and kept is not None and table.count in (None, kept.count):
            state = kept  # a part of a table that is complete in the cache
        if not (table.dirty or table.gone or (table.count is not None and state != kept)):
            return None
        self.ext_state = state
        by, overwritten, removed_at = table.take_dirty(), table.take_overwritten(), table.take_removed_at()
        known, moments = table.params, table.moments
        params = [StoredParam.of_ext(param, times(moment), author) for param, author, moment in overwritten]
        params += [
            StoredParam.of_ext(known[name], times(moments.get(name, math.inf)), author)
            for name, author in by.items()
            if name in known
        ]
        update = self._new_update(times, state, removed_at)
        return lambda: replace(update, params=params, extended=True)

    def _new_update(
        self, times: _Times, state: TableState, removed_at: Mapping[str, float | None]
    ) -> TableUpdate:
        return TableUpdate(
            identity=self.identity,
            component=self.machine.component,
            autopilot=self.machine.identification.autopilot or 0,
            at=times.at,
            table=state,
            removed={
                name: times.at if moment is None else times(moment) for name, moment in removed_at.items()
            },
        )


def _make_update(
    update: TableUpdate,
    overwritten: Sequence[StoredParam],
    params: Params,
    volatile: frozenset[str] | None,
    by: Mapping[str, str],
    times: _Times,
    whole_at: float | None,
) -> TableUpdate:
    """Return the update of a table of plain parameters with its values."""
    moments, defaults = params.moments, params.defaults
    current = [
        StoredParam.of_compact(
            name,
            compact,
            defaults.get(name),
            None if volatile is None else int(name in volatile),
            times(moments.get(name, math.inf)),
            by.get(name, "vehicle"),
        )
        for name, compact in params.compact.items()
    ]
    return replace(update, params=[*overwritten, *current], replace=whole_at is not None, whole_at=whole_at)


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


def _firmware(identity: Identity) -> tuple[int, str]:
    return identity.firmware, identity.git_hash


def _of_firmware(cached: CachedComponent, identity: Identity) -> Mapping[str, Param]:
    """Return the cached parameters, without defaults if they are of another firmware."""
    if _firmware(cached.identity) == _firmware(identity):
        return cached.params
    return {name: replace(param, default=None) for name, param in cached.params.items()}
