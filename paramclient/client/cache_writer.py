"""CacheWriter: loads cached tables, and writes new values to the cache in batches, in a worker thread."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, TypeVar

import anyio
import anyio.to_thread

from paramclient.cache import BY_VEHICLE, ParamCache, StoredParam, TableState, TableUpdate
from paramclient.errors import CacheError, UsageError
from paramclient.model.identity import Identity
from paramclient.model.values import Param, ParamType
from paramclient.protocol.node import Node
from paramclient.protocol.selection import vehicle_of
from paramclient.protocol.session import Session
from paramclient.protocol.table import Change

FLUSH_INTERVAL: Final = 0.25
"""Seconds from a change to its commit: changes are collected for half of that time."""
RETRY_INTERVAL: Final = 5.0
"""Seconds until the next attempt after a failed write."""
PENDING_MAX: Final = 4_096
"""Observations of one table that wait for the cache: above it, the whole table is written later."""
CLOCK_STEP: Final = 1.0
"""Seconds by which the computer's clock must differ to count as set, or as suspended."""
CLOSE_RETRY_INTERVAL: Final = 0.3
"""Seconds between two attempts of `close` to write to a cache that was written before: a database may be
restarting, and calls fail at once for a time after a failed connection."""
CLOSE_WAIT_MAX: Final = 6.0
"""Seconds for which `close` waits for the cache: longer than another process may lock a file."""

logger = logging.getLogger(__name__)
T = TypeVar("T")


@dataclass(eq=False)
class TableRecord:
    """What the cache has of one table, and what is to be written of it.

    Attributes:
        generation: of the component, when the first change was received.
        changes: changed parameters in order, each with the time by the clock of the event loop, as the
            computer's clock may be wrong.
        is_whole: whether the whole table is to be written, as it is.
        synced_at: when the table was last proven, in unix time, as the cache has it, or None.
        fetched_at: likewise in this session, by the clock of the event loop.
        stored_at: of that, what the cache has.
    """

    generation: int = 0
    changes: list[tuple[Change, float]] = field(default_factory=list)
    is_whole: bool = False
    synced_at: float | None = None
    fetched_at: float | None = None
    stored_at: float | None = None

    @property
    def is_unwritten(self) -> bool:
        return self.is_whole or bool(self.changes) or self.fetched_at != self.stored_at


class CacheWriter:
    """Writes the tables of one client to its cache, and loads cached tables of new components.

    The program goes on after a cache error, and values that could not be written are written later. The log
    has one warning until the next successful write, unless a call that needs the cache fails before it.

    Args:
        cache: the cache, or None.
        owned: whether `close` closes the cache.

    Attributes:
        cache: as given.
        failure: why the cache cannot be written; None while it can.
    """

    def __init__(self, cache: ParamCache | None, *, owned: bool) -> None:
        self.failure: CacheError | UsageError | None = None
        self.cache = cache
        self._owned = owned
        self._thread = anyio.CapacityLimiter(1)
        self._identities: dict[Node, Identity] = {}  # of the vehicle, under which tables are written
        self._vehicles: dict[Node, Node] = {}  # the autopilot with this identity
        self._records: dict[Session, TableRecord] = {}
        self._writing = anyio.Lock()
        self._is_told = False  # the user knows of the failure
        self._has_written = False  # so the cache is one that can be written
        self._is_synced = True  # what was written is safe from power loss
        self._something_to_write = anyio.Event()
        self._known: set[tuple[int | str, int]] = set()  # systems and keys of vehicles, with components
        self._ahead = -math.inf  # of unix time to the time of the event loop, in seconds
        self._replacements = 0 if cache is None else cache.replacements

    async def open(self) -> None:
        """Load the list of cached components."""
        if self.cache is not None:
            found = await self.attempt(self.cache.components) or []
            self._known = {(which, each.component) for each in found for which in (each.system, each.key)}

    async def close(self, nodes: Collection[Node]) -> None:
        """Write all new values, warn of lost ones, and close the cache if it is owned.

        Args:
            nodes: the components. The complete table of one that was not identified yet is written too, and
                the values of one whose cached table was not loaded yet.
        """
        if self.cache is None:
            return
        is_written = False
        was_told, self._is_told = self._is_told, True
        with anyio.move_on_after(CLOSE_WAIT_MAX, shield=True):
            for node in nodes:
                is_known = node.identification.is_settled
                if is_known or any(each.table.is_complete for each in node.sessions):
                    await self.load(node, vehicle_of(nodes, node))
            for attempt in range(int(CLOSE_WAIT_MAX / CLOSE_RETRY_INTERVAL) if self._has_written else 2):
                await anyio.sleep(CLOSE_RETRY_INTERVAL if attempt else 0.0)
                with suppress(CacheError):
                    await self.write_all()
                    await self.write_all()  # after a replaced file
                    is_written = True
                    break
        known = () if is_written or was_told else self._identities
        lost = [each for each in known if any(self._record(each, one).is_unwritten for one in each.sessions)]
        if lost:
            words = [f"{each.system}/{each.component} ({self._identities[each].key})" for each in lost]
            what, why = ", ".join(words), self.failure or "timeout"
            logger.warning("the last values of %s are not in the cache, and lost: %s", what, why)
        if self._owned:
            with anyio.move_on_after(CLOSE_WAIT_MAX, shield=True):
                await self.run_in_thread(self.cache.close)

    def may_have(self, node: Node) -> bool:
        """Return whether the cache had a table for these ids when the client was opened."""
        return (node.system, node.component) in self._known

    def may_load(self, node: Node, vehicle: Node) -> bool:
        """Return whether it is known which vehicle a component belongs to, as far as the cache knows: the
        vehicle is identified, or has never been before."""
        key = vehicle.identification.identity.key
        return vehicle.identification.is_settled or (key, node.component) in self._known

    async def load(self, node: Node, vehicle: Node) -> None:
        """Load the cached tables of a component, and write its values from now on.

        Args:
            node: the component.
            vehicle: the autopilot of its vehicle, which is identified.
        """
        identity = vehicle.identification.identity
        kept = self._identities.get(node)
        self._vehicles[node] = vehicle
        if self.cache is None or (kept is not None and kept.key == identity.key):
            self._identities[node] = identity
            self._something_to_write.set()
            return
        for session in node.sessions:
            load = partial(self.cache.load, identity.key, node.component, extended=session is node.extended)
            cached = await self.attempt(load)
            if vehicle.identification.identity.key != identity.key:
                return  # another vehicle has taken the address meanwhile, and its table is loaded
            if identity.uid is not None:
                session.table.forget_doubtful()
            if kept is not None and session.table.params:  # received before it was known which vehicle it is
                self._record(node, session).is_whole = True
            if cached is None:
                continue
            known = cached.identity
            if vehicle.identification.autopilot is None:  # no heartbeat yet
                identity = replace(identity, autopilot=known.autopilot, vehicle_type=known.vehicle_type)
            self._records.setdefault(session, TableRecord(node.generation)).synced_at = cached.synced_at
            is_same_firmware = (known.firmware, known.git_hash) == (identity.firmware, identity.git_hash)
            params, ahead, now = cached.params.values(), self._seconds_ahead(), anyio.current_time()
            session.table.load(
                params if is_same_firmware else [replace(each, default=None) for each in params],
                count=cached.count if cached.complete and is_same_firmware else None,
                hash=cached.hash,
                volatile=cached.volatile,
                volatile_is_known=cached.volatile_known,
                moments={name: min(at - ahead, now) for name, at in cached.heard_at.items()},
            )
            if is_same_firmware and session.serves_file is None:
                session.serves_file = cached.file_works
        self._identities[node] = identity
        self._something_to_write.set()

    def forget(self, node: Node) -> None:
        """Drop what waits: another vehicle uses the ids of the component."""
        self._identities.pop(node, None)
        for session in node.sessions:
            self._records.pop(session, None)

    def changed(self, node: Node, session: Session, change: Change) -> None:
        """Take a change of a parameter."""
        if self.cache is None:
            return
        record, param = self._record(node, session), change.new or change.old
        is_certain = not session.encoding_doubt or (param and param.type is ParamType.REAL32)
        if len(record.changes) < PENDING_MAX and is_certain:
            at = min(session.table.moments.get(change.name, math.inf), anyio.current_time())
            record.changes.append((change, at))
        else:
            record.is_whole = True
        self._something_to_write.set()

    def fetched(self, node: Node, session: Session, *, is_whole: bool) -> None:
        """Take note of a complete fetch; `is_whole`: indices may have changed without values."""
        record = self._record(node, session)
        record.fetched_at = anyio.current_time()
        record.is_whole |= is_whole
        self._something_to_write.set()

    def _record(self, node: Node, session: Session) -> TableRecord:
        """Return the record of a table.

        What was received of an unidentified component before it was lost may be of another vehicle.
        """
        record = self._records.get(session)
        if record is None or (record.generation != node.generation and node not in self._identities):
            record = self._records[session] = TableRecord(node.generation)
        return record

    async def run(self) -> None:
        """Write new values in batches, until cancelled."""
        while True:
            await self._something_to_write.wait()
            await anyio.sleep(FLUSH_INTERVAL / 2)
            self._something_to_write = anyio.Event()
            try:
                await self.write_all(is_told=False)
            except CacheError:
                await anyio.sleep(RETRY_INTERVAL)
                self._tell()
                self._something_to_write.set()

    async def write_all(self, *, durable: bool = False, is_told: bool = True) -> None:
        """Write all received values now. Cancellation loses no value.

        Args:
            durable: whether to wait until they are safe from power loss.
            is_told: as for `call`.

        Raises:
            CacheError: the write failed. The values stay in memory and are written later.
        """
        if self.cache is None:
            return
        async with self._writing:
            certain = [node for node in self._identities if self._is_certain(node)]
            sessions = [(node, each) for node in certain for each in node.sessions if not each.encoding_doubt]
            records = [(node, each, self._record(node, each)) for node, each in sessions]
            taken = [each for each in records if each[2].is_unwritten]
            if not taken and (self._is_synced or not durable):
                return  # which says nothing of the cache
            updates = [self._update(*each) for each in taken]
            before = [(each, len(each.changes), each.is_whole, each.fetched_at) for _, _, each in taken]
            for _, _, record in taken:
                record.is_whole = False
            self._is_synced = False
            try:
                await self.call(partial(self.cache.save, updates, durable=durable), is_told=is_told)
            except BaseException:
                for record, _, was_whole, _ in before:
                    record.is_whole |= was_whole
                raise
            for record, count, _, record.stored_at in before:
                del record.changes[:count]
            self._has_written = True
            self._is_synced = durable
            self.failure, self._is_told = None, False
            if self.cache.replacements != self._replacements:  # a new file, without the earlier values
                self._replacements = self.cache.replacements
                for _, _, record in records:
                    record.is_whole = True
                self._something_to_write.set()

    async def write_durably(self, node: Node, session: Session) -> None:
        """Write all received values, safe from power loss.

        Raises:
            UsageError, CacheError: as from `check_kept` and `write_all`.
        """
        self.check_kept(node, session)
        await self.write_all(durable=True)

    def check_kept(self, node: Node, session: Session) -> None:
        """Check that the values of a component's table are written.

        Raises:
            UsageError: there is no cache.
            CacheError: they are not.
        """
        if self.cache is None:
            raise UsageError("durable needs a cache, and the client has none; open it with a cache")
        doubt = session.encoding_doubt
        if doubt or node not in self._identities or not self._is_certain(node):
            raise CacheError(doubt or f"it is not known which vehicle {node.system}/{node.component} is")

    def _is_certain(self, node: Node) -> bool:
        """Return whether the vehicle and the component are still those that were identified."""
        return node.identification.is_confirmed and self._vehicles[node].identification.is_confirmed

    def _update(self, node: Node, session: Session, record: TableRecord) -> TableUpdate:
        vehicle = self._vehicles[node]
        identity, heard = self._identities[node], vehicle.identification
        if heard.autopilot is not None:
            identity = replace(identity, autopilot=heard.autopilot, vehicle_type=heard.vehicle_type or 0)
        return update_of(
            *(node, session, identity, record),
            autopilot=identity.autopilot if node is vehicle else node.identification.autopilot or 0,
            at=time.time(),
            ahead=self._seconds_ahead(),
        )

    def _seconds_ahead(self) -> float:
        """Return the seconds from the event loop's clock to unix time, always the same.

        The two clocks are compared once, and again where the computer's clock was set or was suspended.
        """
        ahead = time.time() - anyio.current_time()
        if not abs(ahead - self._ahead) <= CLOCK_STEP:  # also where the clock is NaN
            self._ahead = ahead
        return self._ahead

    async def run_in_thread(self, work: Callable[[], T]) -> T:
        """Run a blocking call in the cache's thread after earlier calls. Cancellation does not stop it."""
        return await anyio.to_thread.run_sync(work, abandon_on_cancel=True, limiter=self._thread)

    async def call(self, work: Callable[[], T], *, is_told: bool = True) -> T:
        """Run a cache call in the thread.

        Args:
            work: the call.
            is_told: whether the caller passes its error on to the user.

        Raises:
            CacheError: it failed.
        """
        try:
            return await self.run_in_thread(work)
        except (CacheError, UsageError) as error:  # UsageError: the clock has an impossible time
            self.failure = error
            self._is_told |= is_told
            raise CacheError(str(error)) from error

    async def attempt(self, work: Callable[[], T]) -> T | None:
        """Run a cache call in the thread; return None where it fails, as the log says."""
        with suppress(CacheError):
            return await self.call(work, is_told=False)
        self._tell()
        return None

    def _tell(self) -> None:
        """Log a failure once, unless a call has raised it, or `close` logs what is lost."""
        if self.failure is not None and not self._is_told:
            self._is_told = True
            logger.warning("continuing without the cache: %s", self.failure)


def update_of(
    node: Node,
    session: Session,
    identity: Identity,
    record: TableRecord,
    *,
    autopilot: int,
    at: float,
    ahead: float = 0.0,
) -> TableUpdate:
    """Return the update with which the cache takes a table.

    Args:
        node, session: the component and its parameters.
        identity: of its vehicle.
        record: of the table.
        autopilot: MAV_AUTOPILOT of the component.
        at: time of the update, in unix seconds.
        ahead: seconds from the times of the table and of the record to unix time.
    """
    table = session.table

    def unix(moment: float) -> float:
        return round(moment + ahead, 6)  # a printed time, whose digits are cut off, is never later

    def observed(param: Param, moment: float, by: str = BY_VEHICLE) -> StoredParam:
        is_volatile = param.name in table.volatile if table.volatile or table.volatile_is_known else None
        return StoredParam.of(table.with_default(param), unix(moment), is_volatile, by)

    params = [
        StoredParam.gone(each.name, unix(moment)) if each.new is None else observed(each.new, moment, each.by)
        for each, moment in record.changes
    ]
    if record.is_whole:
        params += [observed(param, table.moments[name]) for name, param in table.params.items()]
    state = TableState(
        hash=table.hash if table.is_complete else None,
        count=table.count,
        complete=table.is_complete,
        volatile_known=table.volatile_is_known,
        synced_at=record.synced_at if record.fetched_at is None else record.fetched_at + ahead,
        file_works=session.serves_file or (None if session.ftp_unanswered else session.serves_file),
    )
    return TableUpdate(
        identity=identity,
        component=node.component,
        autopilot=autopilot,
        at=at,
        table=state,
        params=params,
        replace=record.is_whole and table.is_complete,
        extended=session is node.extended,
    )


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
