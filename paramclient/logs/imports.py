"""Import of logs into a cache, with the times of the log: telemetry logs and on-board logs."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import anyio
import anyio.lowlevel
import anyio.to_thread

from paramclient.cache import ParamCache, StoredParam, TableUpdate
from paramclient.client.cache_writer import TableRecord, update_of
from paramclient.errors import FileError, UsageError
from paramclient.files.formats import AUTOPILOT
from paramclient.links.tlog import LOG_PEER, Record, open_log, read_records
from paramclient.logs.onboard import LogFormat, OnboardLog, printable_path, read_onboard_log
from paramclient.model.identity import Identity
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import ParamType
from paramclient.protocol.addresses import Address
from paramclient.protocol.node import Node
from paramclient.protocol.selection import vehicle_of
from paramclient.protocol.session import Session
from paramclient.protocol.station import Station
from paramclient.protocol.table import Change
from paramclient.wire.frames import Framer
from paramclient.wire.messages import AutopilotVersion, Heartbeat, message_id

RECORDS_PER_CHECKPOINT: Final = 1_000
"""Frames between two checkpoints, at which other tasks can run: a few milliseconds."""


@dataclass(frozen=True, slots=True)
class ImportedTable:
    """The imported table of one component.

    Attributes:
        key: the key of the vehicle's tables in the cache.
        system, component: its address.
        autopilot: MAV_AUTOPILOT of its heartbeat, or None.
        params: the number of received parameters, plain and extended.
        complete: whether the plain table is complete; the extended one if there are no plain parameters.
        hash: the PX4 hash that confirms the table at the end of the log, or None.
        notes: remarks for the user, in sentences: parts that were skipped, types that are unknown.
    """

    key: str
    system: int
    component: int
    autopilot: int | None
    params: int
    complete: bool = False
    hash: int | None = None
    notes: tuple[str, ...] = ()


# Telemetry logs


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
    name = f"replay:{printable_path(path)}"
    with closing(open_log(os.fspath(path), name)) as file:
        introductions = await _first_introductions(read_records(file))
        file.seek(0)
        return await _Import(name, introductions, cache).read(read_records(file))


async def _first_introductions(records: Iterator[Record]) -> dict[int, dict[Address, bytes]]:
    """Return the first HEARTBEAT and AUTOPILOT_VERSION of each component, by message, as in the log."""
    found: dict[int, dict[Address, bytes]] = {message_id(Heartbeat): {}, message_id(AutopilotVersion): {}}
    framer = Framer(set(found), stream=False)
    async for record in _in_turns(records):
        for frame in framer.receive(record.data):
            found[frame.message_id].setdefault((frame.system, frame.component), record.data)
    return found


async def _in_turns(records: Iterator[Record]) -> AsyncIterator[Record]:
    """Generate records, and let other tasks run between them."""
    for number, record in enumerate(records):
        yield record
        if not number % RECORDS_PER_CHECKPOINT:
            await anyio.lowlevel.checkpoint()


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
        self._introductions = introductions
        self._cache = cache
        self._at = 0.0
        self._tables: defaultdict[Session, TableRecord]
        self._tables = defaultdict(partial(TableRecord, is_whole=True))
        self._station = Station(
            link=name,
            is_stream=False,
            send=_ignore,
            spawn=_ignore,
            listens_only=True,
            discovered=self._introduce,
        )

    async def read(self, records: Iterator[Record]) -> tuple[ImportedTable, ...]:
        """Take all frames, and write the tables."""
        async for record in _in_turns(records):
            self._at = max(self._at, record.at)  # a clock that was set back does not turn back the time
            self._station.receive(record.data, LOG_PEER, self._at)
        nodes = [node for _, node in sorted(self._station.nodes.items())]
        nodes = [node for node in nodes if node.plain.table.params or node.extended.table.params]
        updates = [self._update(node, session) for node in nodes for session in node.sessions]
        updates = [update for update in updates if update.params]
        seen = [  # that the vehicle was there at the beginning
            replace(self._update(node, node.plain), at=node.since, table=None, params=()) for node in nodes
        ]
        await anyio.to_thread.run_sync(partial(self._cache.merge, [*seen, *updates]))
        return tuple(self._imported_table(node) for node in nodes)

    def _introduce(self, node: Node) -> None:
        """Take the first HEARTBEAT and AUTOPILOT_VERSION: frames before them are of the same vehicle."""
        for session in node.sessions:
            session.table.changed = partial(self._take_change, session)
        for introductions in self._introductions.values():
            if (frame := introductions.get((node.system, node.component))) is not None:
                self._station.receive(frame, LOG_PEER, self._at)

    def _take_change(self, session: Session, change: Change) -> None:
        table = self._tables[session]
        if session.table.is_complete and table.synced_at is None:
            table.synced_at = self._at
        table.changes.append((change, self._at))

    def _update(self, node: Node, session: Session) -> TableUpdate:
        session.confirm_announced()
        table, autopilot = self._tables[session], node.identification.autopilot or 0
        if not session.table.is_complete:
            table.synced_at = None
        at = node.presence.received_at
        return update_of(node, session, self._identity_of(node), table, autopilot=autopilot, at=at)

    def _identity_of(self, node: Node) -> Identity:
        """Return the identity of a component's vehicle."""
        return vehicle_of(self._station.nodes.values(), node).identification.identity

    def _imported_table(self, node: Node) -> ImportedTable:
        plain, extended = node.plain.table, node.extended.table
        return ImportedTable(
            self._identity_of(node).key,
            node.system,
            node.component,
            node.identification.autopilot,
            params=len(plain.params) + len(extended.params),
            complete=plain.is_complete if plain.params else extended.is_complete,
            hash=plain.hash if plain.is_complete else None,
        )


def _ignore(*_: object) -> None:
    """Send nothing, and start nothing: a log is only read."""


# On-board logs


async def import_onboard_log(path: str | os.PathLike[str], cache: ParamCache) -> ImportedTable:
    """Import the parameters of an on-board log into a cache, in one transaction.

    Each value and each change has the time of the log. Later observations in the cache stay unchanged, so
    logs may be imported in any order and repeatedly. A log does not say whether it has all parameters of the
    vehicle: the table is complete only after a fetch. A dataflash log has no types: they are those of the
    vehicle's cached table, else those of another cached vehicle of the same autopilot, else REAL32.

    Args:
        path: the log.
        cache: the cache to write to.

    Raises:
        FileError: as from `read_onboard_log`; or the log has no UTC time or no system id.
        UsageError: a ULog file, and pyulog is not installed.
        CacheError: the cache cannot be written.
    """
    return await anyio.to_thread.run_sync(lambda: _store(read_onboard_log(path), cache))


def _store(log: OnboardLog, cache: ParamCache) -> ImportedTable:
    identity = log.identity
    if log.boot_time is None:
        raise FileError(
            "not imported: the log has no UTC time, as no GPS receiver had a fix, so its values cannot be "
            "ordered with those in the cache. show, diff and save can read it",
            source=log.source,
        )
    if not identity.system:
        raise FileError("not imported: the log has no system id", source=log.source)
    types, boot = _types(log, cache), log.boot_time
    observed = [(log.began, each) for each in log.initial.values()] + [*log.changes]
    stored = [_stored(each, types, boot + time) for time, each in observed]
    update = partial(TableUpdate, identity=identity, component=AUTOPILOT, autopilot=identity.autopilot)
    times = [each.heard_at for each in stored]
    cache.merge([update(at=min(times)), update(at=max(times), params=stored)])
    notes = log.notes
    if untyped := sum(param.type is None and name not in types for name, param in log.initial.items()):
        notes += (f"the log has no types: {untyped} parameters that no cached table has are REAL32",)
    ids = identity.system, AUTOPILOT, identity.autopilot
    return ImportedTable(identity.key, *ids, params=len(log.at_end()), notes=notes)


def _types(log: OnboardLog, cache: ParamCache) -> Mapping[str, ParamType | int]:
    """Return types by name: those of the vehicle's cached table, else of another one."""
    types: dict[str, ParamType | int] = {}
    if log.file_format is LogFormat.DATAFLASH:
        own = log.identity.key, AUTOPILOT
        same = [each for each in cache.components() if each.autopilot == log.identity.autopilot]
        for each in sorted(same, key=lambda each: (each.key, each.component) == own):
            table = cache.load(each.key, each.component)
            if table is not None:  # another process may have removed it
                types |= {name: param.type for name, param in table.params.items()}
    return types


def _stored(param: WrittenParam, types: Mapping[str, ParamType | int], at: float) -> StoredParam:
    """Return the observation of a logged value; as a REAL32 if its type is unknown or cannot hold it."""
    kind = types.get(param.name, ParamType.REAL32) if param.type is None else param.type
    try:
        return StoredParam.of(WrittenParam(param.name, param.value, kind, param.default), at)
    except UsageError:
        return StoredParam.of(WrittenParam(param.name, param.value, ParamType.REAL32), at)
