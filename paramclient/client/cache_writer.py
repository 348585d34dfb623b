"""What the tables learn goes to the cache: in batches, in a thread of its own, never in anybody's way."""

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
    HeardParams,
    ParamCache,
    StoredParam,
    TableState,
    TableUpdate,
    UnixTimes,
)
from paramclient.client.worker_thread import Worker
from paramclient.errors import CacheError, UsageError
from paramclient.links.clock_offset import seconds_ahead
from paramclient.model.identity import Identity
from paramclient.model.params import Params
from paramclient.model.values import Param
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params.table import Observation

__all__ = ["WriteThrough", "chosen_cache"]

FLUSH_INTERVAL: Final = 0.25
"""Seconds after which a change is on the disk, as long as the machine keeps up: changes are gathered for so
long, less what the last commit took. A download fills several batches."""
FLUSH_RESERVE: Final = 0.04
"""Seconds of that for a commit that takes longer than the last one."""
DOWNLOAD_INTERVAL: Final = 10.0
FEW_FETCHES: Final = 8
"""Seconds for which what a fetch under way brings is gathered, and the number of fetches above which that is
done: most are over by then, and each table is written once, where parts of it would take several times as
long. So much of a download is lost where the process is killed in its course."""
LEAST_NEW: Final = 0.5
"""The share of a table that must be new for a part of it to be written: that costs as much as all of it."""
PORTION: Final = 2_000
"""Parameters after which a transaction ends, of those that are written together: to gather so many takes a
few milliseconds, in which nothing else is done."""
RETRY_INTERVAL: Final = 5.0
"""Seconds until a cache that could not be written is tried again."""
MOST_VEHICLES: Final = 16
"""Vehicles under one address whose tables are kept in one session: more than are changed in a day. One that
says each time that it is another vehicle fills no disk."""
MOST_TABLES: Final = 4_000
"""Tables that are kept in one session: four for each component that can be followed."""

logger = logging.getLogger(__name__)
Result = TypeVar("Result")


class WriteThrough:
    """The way from the tables of one client to its cache, and back at the beginning.

    A cache that fails costs a warning in the log, once until it can be written again, and nothing else: what
    could not be written is written when it can be.

    Args:
        cache: where to, or None for nowhere.
        owned: whether `close` closes it.
        identity_of: says who the vehicle is that a component belongs to; None while that is open.
        is_doubted: says whether another vehicle may have taken its place by now.
        renewed: is called when another station has brought tables up to date.
        look: is called before moments become unix times: to notice that the computer has slept.
        clock: the time in unix seconds; None for that of this computer.
        now: the time of the components.
    """

    def __init__(
        self,
        cache: ParamCache | None,
        *,
        owned: bool,
        identity_of: Callable[[ComponentMachine], Identity | None],
        is_doubted: Callable[[ComponentMachine], bool],
        renewed: Callable[[], None] | None = None,
        look: Callable[[], None] | None = None,
        clock: Callable[[], float] | None = None,
        now: Callable[[], float] = anyio.current_time,
    ) -> None:
        self._cache = cache
        self._identity_of = identity_of
        self._is_doubted = is_doubted
        self._renewed = _nothing if renewed is None else renewed
        self._look = _nothing if look is None else look
        self._clock = _time_of_day if clock is None else clock
        self._now = now
        self._owned = owned
        self._worker = Worker("paramclient cache")
        self._kept: dict[ComponentMachine, _Kept] = {}
        self._flushing = anyio.Lock()
        self._failure: CacheError | UsageError | None = None  # None once it could be written again
        self._failures = 0
        self._syncs_begun = self._synced = 0  # the number of the last one that has succeeded
        self._tables: dict[tuple[int, int], bool] = {}
        self._something_to_write = anyio.Event()
        self._waiting_since = -math.inf  # as long as that is set
        self._commit_time = 0.0
        self._bringing: set[ComponentMachine] = set()
        self._vehicles: dict[tuple[int, int], set[str]] = {}  # that were kept in this session
        self._has_refused = self._has_refused_twin = False
        self._replacements = 0 if cache is None else cache.replacements
        self._has_written = False
        self._are_many = False
        self._news: set[CacheChange] = set()
        self._end_news: Callable[[], None] = _nothing
        self._flushed_at = (math.inf, -math.inf)  # by the components' clock, and in unix seconds

    async def open(self) -> None:
        """Find out which components the cache knows."""
        if self._cache is not None:
            for each in await self._run(self._cache.components) or ():
                address = (each.system, each.component)
                self._tables[address] = self._tables.get(address, False) or each.hash is not None
            told = partial(_pass_on, anyio.lowlevel.current_token(), self._hear_of)
            self._end_news = await self._run(partial(self._cache.subscribe, told)) or _nothing

    async def close(self) -> None:
        """Write what is left, or warn of what is lost, and end the thread."""
        self._end_news()
        is_written = False
        try:
            is_written = await self.flush() and await self.flush()  # all of it, where the file had gone
        finally:
            if not is_written:
                self._tell_of_loss()
            cache = self._cache if self._owned else None
            await self._worker.close(_nothing if cache is None else cache.close)

    async def aside(self, work: Callable[[], Result]) -> Result:
        """Do what blocks in the cache's thread, behind what is under way there. Cancelled, it is done."""
        return await self._worker.run(work)

    def may_have(self, system: int, component: int) -> bool:
        """Whether the cache had a table for such an address when the client was opened."""
        return (system, component) in self._tables

    def may_hit(self, system: int, component: int) -> bool:
        """Whether it had one that the vehicle's hash may confirm."""
        return self._tables.get((system, component), False)

    def follow(self, machine: ComponentMachine, identity: Identity) -> bool:
        """Go on under an identity; false where `bring` must come first, as for another vehicle.

        What becomes of the table when another vehicle takes the address is no news of the one before.
        """
        kept = self._kept.get(machine)
        if kept is not None and kept.identity.key == identity.key:
            kept.identity = identity
            return True
        if kept is not None:
            self.let_go(machine)
        return False

    async def bring(self, machine: ComponentMachine, identity: Identity) -> bool:
        """Give a component the table that is cached under an identity, and keep what it learns under that.

        False where it was overtaken meanwhile: by another vehicle, or by the same call for another reason.
        """
        if machine in self._bringing:
            return False  # that sees to it
        self._bringing.add(machine)
        try:
            while self._has_room(machine, identity):
                cached = await self._load(machine, identity)
                logger.debug("cached under %s/%s: %s", identity.key, machine.component, cached or "nothing")
                current = self._identity_of(machine)
                if current is None or (current.key == identity.key and self.follow(machine, current)):
                    return False
                if current.key == identity.key:
                    if self._has_room(machine, current):  # another one may have come first meanwhile
                        self._keep(machine, current, cached)
                    break
                identity = current  # another vehicle has taken its place meanwhile
            return True
        finally:
            self._bringing.discard(machine)

    def is_bringing(self, machine: ComponentMachine) -> bool:
        """Whether `bring` is under way for it."""
        return machine in self._bringing

    async def keep_late(self, machine: ComponentMachine) -> None:
        """Keep a table that there was no time to bring the cached one for.

        A component that has not said who it is by now may be one that never does: what is whole is kept.
        """
        known = self._identity_of(machine)
        if not (machine.table.complete or (known is not None and machine.table.params)):
            return
        identity = known or machine.identity
        if not self.follow(machine, identity):
            cached = await self._load(machine, identity)
            if self._has_room(machine, identity):
                self._keep(machine, identity, cached)

    def synced(self, machine: ComponentMachine, *, is_whole: bool) -> None:
        """The table was proven to be the vehicle's just now; `is_whole` by a download of all of it."""
        kept = self._kept.get(machine)
        if kept is not None:
            kept.proven_at = self._now() + machine.table.slept
            if is_whole:
                kept.whole_at = kept.proven_at

    def let_go(self, machine: ComponentMachine) -> None:
        """Several vehicles have its address, or had it until now: what it has learnt is kept under none."""
        self._kept.pop(machine, None)
        machine.table.take_dirty()
        machine.table.take_overwritten()
        machine.table.take_gone()

    def part_with(self, machine: ComponentMachine) -> None:
        """It is not followed any more."""
        self._kept.pop(machine, None)

    @property
    def is_held_back(self) -> bool:
        """Whether there is news of a component of which it is open who it is: it may be another vehicle."""
        return any(machine.table.dirty and self._is_doubted(machine) for machine in self._kept)

    def wake(self) -> None:
        """There may be something to write."""
        if not self._something_to_write.is_set():
            self._waiting_since = anyio.current_time()
            self._something_to_write.set()

    async def run(self) -> None:
        """Write whatever is new, in batches, until cancelled."""
        while True:
            await self._something_to_write.wait()
            pause = FLUSH_INTERVAL - FLUSH_RESERVE - min(self._commit_time, FLUSH_INTERVAL / 2)
            await anyio.sleep_until(self._waiting_since + pause)
            self._something_to_write = anyio.Event()
            begun_at = anyio.current_time()
            is_written = await self.flush(is_last=False)
            self._commit_time = anyio.current_time() - begun_at
            if not is_written:
                await anyio.sleep(RETRY_INTERVAL)
            if self.is_held_back or not is_written:
                self.wake()
            await self._take_news()

    async def flush(self, *, is_last: bool = True) -> bool:
        """Write what is new; false when the cache could not take it. Cancelled, it loses nothing.

        Args:
            is_last: whether what a fetch under way has brought must not be left for later.
        """
        async with self._flushing:
            return await self._flush(is_last=is_last)

    async def write_all(self) -> None:
        """Write all that has been heard, so that the cache can be asked about it.

        Raises:
            CacheError: the cache could not take it. It is kept, and written when that is possible.
        """
        failures = self._failures
        async with self._flushing:
            if failures == self._failures and await self._flush(is_last=True):
                return
        raise CacheError(f"what was heard last could not be written: {self._failure}") from self._failure

    def obstacle(self, machine: ComponentMachine) -> str | None:
        """Why nothing of a component can be written at present, in words; None where it can."""
        if self._cache is None:
            return "the client keeps no cache"
        if machine not in self._kept or self._is_doubted(machine):
            return f"it is not known which vehicle {machine.system}/{machine.component} is"
        return None

    async def write_durably(self, machine: ComponentMachine) -> None:
        """Have all that was heard of a component on the disk, past a loss of power.

        Calls at the same time share the work.

        Raises:
            CacheError: it cannot be written. It is kept, and written when that is possible.
        """
        cache, begun = self._cache, self._syncs_begun
        async with self._flushing:
            if self._synced <= begun:  # else one that was begun after this call has succeeded
                self._syncs_begun += 1
                number = self._syncs_begun
                is_done = cache is not None and await self._flush(is_last=True)
                if cache is None or not (is_done and await self._run(partial(_sync, cache))):
                    raise CacheError(f"it could not be written: {self._failure}") from self._failure
                self._synced = number
        if (why := self.obstacle(machine)) is not None:
            raise CacheError(why)

    async def _flush(self, *, is_last: bool) -> bool:
        portion: list[_News] = []
        size = 0
        times = self._present_times()
        fetches = sum(machine.fetch is not None for machine in self._kept)
        self._are_many = fetches > (0 if self._are_many else FEW_FETCHES)  # the last ones of many count too
        for kept in list(self._kept.values()) if self._cache is not None else ():
            if self._are_many and not is_last and self._is_for_later(kept):
                self.wake()
            elif self._kept.get(kept.machine) is kept:
                for new in self._news_of(kept, times):
                    portion.append(new)
                    size += len(new.update.params)
            if size >= PORTION:
                if not await self._write(portion):
                    return False
                portion, size = [], 0
        return await self._write(portion)

    def _is_for_later(self, kept: _Kept) -> bool:
        """Whether a fetch brings more of it that is better written together."""
        fetch, table = kept.machine.fetch, kept.machine.table
        if fetch is None:
            return False
        if len(table.dirty) < LEAST_NEW * len(table.params):
            return True
        began_at = fetch.first_value_at if fetch.first_value_at < math.inf else fetch.begun_at
        return anyio.current_time() < max(kept.written_at, began_at) + DOWNLOAD_INTERVAL

    async def _write(self, news: list[_News]) -> bool:
        """Write what was gathered; false when the cache could not take it."""
        cache = self._cache
        if cache is None or not news:
            return True
        is_written = False
        try:
            is_written = await self._save(cache, [new.update for new in news])
        finally:
            for new in news:
                if not is_written and self._kept.get(new.kept.machine) is new.kept:
                    new.take_back()
            for kept in self._kept.values() if self._failure is not None else ():
                kept.machine.table.keeps_all = True
        if is_written:
            self._failure = None
            for kept in self._kept.values():
                kept.machine.table.keeps_all = False
            logger.debug("written: %s values", sum(len(new.update.params) for new in news))
            self._begin_anew(cache.replacements)
        return is_written

    def _hear_of(self, change: CacheChange) -> None:
        """Another station has written to a table."""
        self._news.add(change)
        self.wake()

    async def _take_news(self) -> None:
        """Bring up to date what is only cached here, where another station has heard it since."""
        news, self._news = self._news, set()
        for kept in list(self._kept.values()):
            machine, identity = kept.machine, kept.identity
            if CacheChange(identity.key, machine.component) in news and self._cache is not None:
                cached = await self._run(partial(self._cache.load, identity.key, machine.component))
                if cached is not None and self._kept.get(machine) is kept:
                    machine.renew(cached.params, self._moments(cached))
                    self._renewed()

    def _begin_anew(self, replacements: int) -> None:
        """Where the file is another one than before: nothing that was written earlier is in it."""
        is_another = replacements != self._replacements and (self._has_written or bool(self._tables))
        self._replacements = replacements
        self._has_written = True
        if not is_another:
            return
        for kept in self._kept.values():
            table = kept.machine.table
            if table.complete and kept.whole_at is None:
                kept.whole_at = self._now() + table.slept
            kept.state = None
            for name in table.params:
                table.dirty.setdefault(name, "vehicle")
        self.wake()

    async def _save(self, cache: ParamCache, updates: list[TableUpdate]) -> bool:
        return await self._run(partial(_save, cache, updates, self._clock)) is not None

    def _has_room(self, machine: ComponentMachine, identity: Identity) -> bool:
        """Whether a vehicle's table may be kept, beside those of this session that are."""
        address = (machine.system, machine.component)
        twins = [each for each in self._kept.values() if _is_twin(each, machine, identity)]
        if twins:
            if not self._has_refused_twin:
                logger.warning(
                    "%d/%d at %s has the identity of the one at %s (%s), so it is not cached",
                    *address,
                    machine.peer_in_words,
                    twins[0].machine.peer_in_words,
                    identity.key,
                )
            self._has_refused_twin = True
            return False
        vehicles = self._vehicles.get(address, set())
        if identity.key in vehicles:
            return True
        is_full = sum(map(len, self._vehicles.values())) >= MOST_TABLES
        if len(vehicles) >= MOST_VEHICLES or is_full:
            if not self._has_refused:
                logger.warning("%d/%d: too many vehicles on this link, so it is not cached", *address)
            self._has_refused = True
            return False
        self._vehicles[address] = vehicles | {identity.key}
        return True

    async def _load(self, machine: ComponentMachine, identity: Identity) -> CachedComponent | None:
        if self._cache is None:
            return None
        return await self._run(partial(self._cache.load, identity.key, machine.component))

    def _keep(self, machine: ComponentMachine, identity: Identity, cached: CachedComponent | None) -> None:
        table = machine.table
        whole_at = self._now() + table.slept if table.complete else None
        kept = _Kept(machine, identity, whole_at=whole_at, written_at=anyio.current_time())
        self._kept[machine] = kept
        for name in table.params:
            table.dirty.setdefault(name, "vehicle")
        if cached is not None:
            # the indices of an unfinished table are gone on with: they must be this firmware's on this board
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
            machine.fetches.is_same_firmware = is_same
            if is_same and machine.fetches.file_works is None:
                machine.fetches.file_works = cached.file_works
            kept.synced_at = cached.synced_at
            kept.state = None if table.is_displaced else self._state(machine, kept)
        if machine.sync.synced:
            kept.proven_at = self._now() + table.slept

    def _present_times(self) -> UnixTimes:
        """Return what turns moments of the components into unix times, as the computer's clock is now.

        Where that was set back by less than `CLOCK_SLACK` since the last flush, what has come since counts as
        later than what was written then.
        """
        self._look()
        since, last = self._flushed_at
        ahead = seconds_ahead(self._clock, self._now)
        now = self._now()
        at = now + ahead
        if at < last - CLOCK_SLACK:  # the cache sees to that
            since, last = math.inf, -math.inf
        times = UnixTimes(max(at, last), ahead, since, last)
        self._flushed_at = (now, times.at)
        return times

    def _moments(self, cached: CachedComponent) -> dict[str, float]:
        """Return when the values of a cached table were observed, as moments of the components."""
        self._look()
        now = self._now()
        ahead = seconds_ahead(self._clock, self._now)
        if not math.isfinite(ahead):
            return {}
        return {name: min(at - ahead, now) for name, at in cached.heard_at.items()}

    def _news_of(self, kept: _Kept, times: UnixTimes) -> list[_News]:
        """What the cache does not know of a table yet; it counts as written from now on."""
        machine, table = kept.machine, kept.machine.table
        if self._is_doubted(machine):
            return []
        proven_at, kept.proven_at = kept.proven_at, None
        if proven_at is not None:
            kept.synced_at = times(proven_at - table.slept)
        state = self._state(machine, kept)
        if not (table.dirty or kept.whole_at is not None or state != kept.state):
            return []
        changed = table.changed
        dirty = table.take_dirty()
        overwritten = table.take_overwritten()
        gone = table.take_gone()
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
            autopilot=machine.who.autopilot or 0,
            at=times.at,
            table=state,
            params=HeardParams(
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
            removed_at={name: times(moment) for name, moment in gone.items()},
            replace=is_whole,
            whole_at=None if whole_at is None else times(whole_at - table.slept),
        )
        return [_News(kept, dirty, overwritten, gone, changed, params, update, proven_at, whole_at)]

    def _state(self, machine: ComponentMachine, kept: _Kept) -> TableState:
        table = machine.table
        return TableState(
            hash=table.hash if table.complete else None,
            count=None if table.is_displaced else table.count,  # the cache keeps the indices of before
            complete=table.complete,
            volatile_known=table.volatile_known,
            synced_at=kept.synced_at,
            file_works=machine.fetches.file_works,
        )

    async def _run(self, work: Callable[[], Result]) -> Result | None:
        """Run a call of the cache in the thread; None when it failed, which is worth a warning once."""
        try:
            return await self._worker.run(work)
        except (CacheError, UsageError) as error:  # a UsageError comes of a clock that is far off
            if self._failure is None:
                logger.warning("going on without the cache: %s", error)
            self._failure = error
            self._failures += 1
            return None

    def _tell_of_loss(self) -> None:
        """Warn of what can no longer be written."""
        for machine, kept in self._kept.items():
            values, earlier = len(machine.table.dirty), len(machine.table.overwritten)
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
class _Kept:
    """What is known of a component's place in the cache."""

    machine: ComponentMachine
    identity: Identity
    state: TableState | None = None
    synced_at: float | None = None
    proven_at: float | None = None  # since it was written last: by the components' clock, with `Table.slept`
    whole_at: float | None = None  # when all of it was downloaded, likewise
    written_at: float = 0.0  # by the event loop's clock


@dataclass(slots=True)
class _News:
    """What is on its way to the cache for one component."""

    kept: _Kept
    dirty: dict[str, str]
    overwritten: list[Observation]
    gone: dict[str, float]
    changed: dict[str, tuple[float, str]]
    params: Params
    update: TableUpdate
    proven_at: float | None
    whole_at: float | None

    def take_back(self) -> None:
        """It has not arrived: it is news again."""
        kept = self.kept
        if kept.proven_at is None:
            kept.proven_at = self.proven_at
        if kept.whole_at is None:
            kept.whole_at = self.whole_at
        kept.machine.table.give_back(self.dirty, self.overwritten, self.gone, self.changed, self.params)
        kept.state = None


def chosen_cache(
    cache: ParamCache | str | os.PathLike[str] | bool | None, *, is_log: bool
) -> ParamCache | None:
    """The cache that a user's choice means, see `ParamClient`.

    Raises:
        UsageError: a cache is named for a log.
    """
    if is_log and cache not in (None, True, False):
        raise UsageError("what a log holds is of the past: `paramclient import` brings it into a cache")
    if isinstance(cache, ParamCache):
        return cache
    if cache is False or is_log:
        return None
    return ParamCache(None if cache is None or cache is True else cache)


def _is_twin(kept: _Kept, machine: ComponentMachine, identity: Identity) -> bool:
    """Whether the cache would take a component for one that is kept, with equal ids at another peer."""
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


def _sync(cache: ParamCache) -> bool:
    cache.sync()
    return True


def _of_firmware(cached: CachedComponent, identity: Identity) -> Mapping[str, Param]:
    """The cached parameters, without the defaults of another firmware than the present one."""
    if _firmware(cached.identity) == _firmware(identity):
        return cached.params
    return {name: replace(param, default=None) for name, param in cached.params.items()}


def _pass_on(
    token: anyio.lowlevel.EventLoopToken, told: Callable[[CacheChange], None], change: CacheChange
) -> None:
    """Tell something to the event loop, from another thread; to nobody where that has ended."""
    with suppress(anyio.RunFinishedError):
        anyio.from_thread.run_sync(told, change, token=token)


def _nothing() -> None:
    return
