"""Import of telemetry logs into a cache, with the times of the log."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Final

import anyio
import anyio.lowlevel
import anyio.to_thread

from paramclient.cache import ParamCache, TableUpdate
from paramclient.client.cache_writer import update_of
from paramclient.links.replay import LOG_PEER
from paramclient.links.tlog import Record, open_log, read_records
from paramclient.logs.logged_params import ImportedTable
from paramclient.model.identity import Identity
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
        self._changes: dict[Session, list[tuple[Change, float]]] = {}
        self._complete_at: dict[Session, float] = {}
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
        if session.table.is_complete:
            self._complete_at.setdefault(session, self._at)
        self._changes.setdefault(session, []).append((change, self._at))

    def _update(self, node: Node, session: Session) -> TableUpdate:
        session.confirm_announced()
        return update_of(
            node,
            session,
            self._identity_of(node),
            self._changes.get(session, ()),
            autopilot=node.identification.autopilot or 0,
            at=node.presence.received_at,
            synced_at=self._complete_at.get(session) if session.table.is_complete else None,
            is_whole=True,
        )

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
