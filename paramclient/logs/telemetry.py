"""Import of telemetry logs into a cache, with the times of the log."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from typing import Final

import anyio
import anyio.lowlevel

from paramclient.cache import CachedComponent, CachedExtTable, ParamCache, TableUpdate
from paramclient.client.cache_writer import CACHE_FLUSH_INTERVAL, CacheWriter
from paramclient.links.replay import LOG_PEER
from paramclient.links.tlog import Record, open_log, read_records
from paramclient.logs.imported_table import ImportedTable
from paramclient.model.identity import Identity
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.events import (
    ComponentDiscovered,
    ComponentForgotten,
    ComponentIdentified,
    ComponentReplaced,
    Fetched,
)
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.station import Address, Station
from paramclient.wire.frames import Framer
from paramclient.wire.messages import AutopilotVersion, Heartbeat, message_id

__all__ = ["import_log"]

RECORDS_PER_CHECKPOINT: Final = 1_000
"""Frames between two checkpoints, at which other tasks can run: a few milliseconds."""


async def import_log(path: str | os.PathLike[str], cache: ParamCache) -> tuple[ImportedTable, ...]:
    """Import the parameters of a telemetry log into a cache, in one transaction.

    Each value and each change has the time of the log. Later observations in the cache stay unchanged, so
    logs may be imported in any order and repeatedly. A vehicle is identified by its hardware id if the log
    contains its AUTOPILOT_VERSION; otherwise the vehicle has a key that is unique to the log.

    Args:
        path: the log.
        cache: the cache to write to.

    Raises:
        LinkError: the file cannot be read, or is not a telemetry log.
        CacheError: the cache cannot be written.
    """
    name = f"replay:{await anyio.Path(path).resolve()}"
    with closing(open_log(os.fspath(path), name)) as file:
        introductions = await _first_introductions(read_records(file))
        file.seek(0)
        return await _Import(name, introductions, cache).read(read_records(file))


async def _first_introductions(records: Iterator[Record]) -> dict[int, dict[Address, bytes]]:
    """Return the first HEARTBEAT and AUTOPILOT_VERSION of each component, by message, as in the log."""
    found: dict[int, dict[Address, bytes]] = {message_id(Heartbeat): {}, message_id(AutopilotVersion): {}}
    framer = Framer(set(found), stream=False)
    for number, record in enumerate(records):
        for frame in framer.receive(record.data):
            found[frame.message_id].setdefault((frame.system, frame.component), record.data)
        if not number % RECORDS_PER_CHECKPOINT:
            await anyio.lowlevel.checkpoint()
    return found


class _Import:
    """The import of one log.

    Args:
        name: the log's link name, part of an identity without a hardware id.
        introductions: HEARTBEAT and AUTOPILOT_VERSION of the components, which define identity and encoding
            before their time in the log.
        cache: the cache to write to.
    """

    def __init__(
        self, name: str, introductions: Mapping[int, Mapping[Address, bytes]], cache: ParamCache
    ) -> None:
        self._heartbeats = introductions[message_id(Heartbeat)]
        self._versions = introductions[message_id(AutopilotVersion)]
        self._at = 0.0
        self._station = Station(
            link=name, is_stream=False, sync_settings=SyncSettings.chosen(None, "auto", is_log=True)
        )
        self._writer = _LogWriter(
            cache,
            identity_of=self._identity_of,
            is_doubted=lambda machine: False,  # a log cannot be queried: the last identity applies
            clock=lambda: self._at,
        )

    async def read(self, records: Iterator[Record]) -> tuple[ImportedTable, ...]:
        station, writer = self._station, self._writer
        machines = station.components
        try:
            flush_at = 0.0
            for number, record in enumerate(records):
                if record.at >= flush_at and number:
                    station.tick(record.at)  # operations that time out in a pause end before it
                    await self._follow()
                    await writer.flush()
                    flush_at = record.at + CACHE_FLUSH_INTERVAL
                self._at = max(self._at, record.at)  # a clock that was set back does not turn back the time
                station.receive(record.data, LOG_PEER, self._at)
                await self._follow()
                if not number % RECORDS_PER_CHECKPOINT:
                    await anyio.lowlevel.checkpoint()
            station.over(self._at)
            await self._follow()
            await writer.flush()
            await writer.merge()
        finally:
            await writer.close()
        machines_in_order = (machines[address] for address in sorted(machines))
        return tuple(self._imported_table(each) for each in machines_in_order if _has_content(each))

    async def _follow(self) -> None:
        """Handle the station's events, as the client does."""
        station, writer = self._station, self._writer
        while events := station.events():
            for event in events:
                machine = event.machine
                if isinstance(event, ComponentDiscovered):
                    address = (machine.system, machine.component)
                    for introductions in (self._heartbeats, self._versions):
                        if (
                            address in introductions
                        ):  # frames before the first introduction are of the same vehicle
                            station.receive(introductions[address], LOG_PEER, self._at)
                    await self._bring(machine)
                elif isinstance(event, ComponentIdentified):
                    for each in station.components.values():
                        if each.system == machine.system:
                            await self._bring(each)
                elif isinstance(event, ComponentReplaced):
                    writer.discard_queued(machine)
                elif isinstance(event, ComponentForgotten):
                    writer.remove_component(machine)
                elif isinstance(event, Fetched) and event.result.complete:
                    writer.synced(machine, is_whole=event.result.source != "cache")

    async def _bring(self, machine: ComponentMachine) -> None:
        identity = self._identity_of(machine)
        if identity is not None and not self._writer.follow(machine, identity):
            await self._writer.load_cached(machine, identity)

    def _identity_of(self, machine: ComponentMachine) -> Identity | None:
        """Return the vehicle's identity; without one in the log, an identity that is unique to the log."""
        identity = self._station.identity_of(machine)
        is_silent = all(system != machine.system for system, _ in self._versions)
        return machine.identity if identity is None and is_silent else identity

    def _imported_table(self, machine: ComponentMachine) -> ImportedTable:
        identity = self._identity_of(machine) or machine.identity
        complete = machine.table.complete if machine.table.params else machine.ext.table.complete
        return ImportedTable(
            identity.key,
            machine.system,
            machine.component,
            machine.identification.autopilot,
            params=len(machine.table.params) + len(machine.ext.table.params),
            complete=complete,
            hash=machine.table.hash if machine.table.complete else None,
        )


def _has_content(machine: ComponentMachine) -> bool:
    """Return whether the log has parameters of a component, or something to say of them."""
    return bool(machine.table.params or machine.ext.table.params)


class _LogWriter(CacheWriter):
    """Collects the updates of the tables, with the times of the log, until `merge`."""

    def __init__(
        self,
        cache: ParamCache,
        *,
        identity_of: Callable[[ComponentMachine], Identity | None],
        is_doubted: Callable[[ComponentMachine], bool],
        clock: Callable[[], float],
    ) -> None:
        super().__init__(
            cache, owned=False, identity_of=identity_of, is_doubted=is_doubted, clock=clock, now=clock
        )
        self._tables_in = cache
        self._log_time = clock
        self._updates: list[TableUpdate] = []
        self._based_on: dict[tuple[str, int], float] = {}
        self._loaded: set[tuple[str, int]] = set()
        self._has_values: set[tuple[str, int]] = set()

    async def merge(self) -> None:
        """Write all collected updates."""
        await self.run_in_thread(partial(self._tables_in.merge, self._updates, based_on=self._based_on))

    async def load_tables(
        self, identity: Identity, component: int
    ) -> tuple[CachedComponent | None, CachedExtTable | None]:
        """Return the cached table if it is older; only once, as later updates are not written yet.

        Extended parameters need no cached table: they are compared with it when they are written.
        """
        key = (identity.key, component)
        if key in self._loaded:
            return None, None
        self._loaded.add(key)
        cached = await self.run_in_thread(partial(self._tables_in.load, *key))
        if cached is None or cached.updated_at >= self._log_time():
            return None, None
        self._based_on[key] = cached.updated_at
        return cached, None

    def save_updates(self, cache: ParamCache, updates: Sequence[TableUpdate], *, durable: bool) -> None:
        """Collect updates, but not of a table of which the log has no value."""
        for update in updates:
            key = (update.identity.key, update.component)
            if update.params or key in self._based_on or key in self._has_values:
                self._updates.append(update)
                self._has_values.add(key)
