"""What could not be written to the database yet: kept beside the local copy, in order, until it is there."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from paramclient.cache.operations import Merge, Operation, Save, SetDown
from paramclient.cache.records import StoredParam, TableState, TableUpdate
from paramclient.cache.rows import Damaged, Row, identity_cells, read_identity, read_param
from paramclient.cache.snapshots import read_written, written_cells
from paramclient.cache.sqlite import SqliteSession
from paramclient.cache.sqlite_file import Database
from paramclient.cache.transaction import Session
from paramclient.cache.transfer import Whole, put_shots, put_whole
from paramclient.model.paramset import ParamSet

__all__ = ["Entry", "LocalCopy", "packed", "unpacked"]

_TABLES: Final = (
    """CREATE TABLE IF NOT EXISTS outbox (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        writer TEXT NOT NULL,
        number INTEGER NOT NULL,
        operation BLOB NOT NULL,
        refused TEXT
    )""",
    """CREATE TABLE IF NOT EXISTS mirrored (
        vehicle TEXT NOT NULL,
        component INTEGER NOT NULL,
        revision INTEGER NOT NULL,
        PRIMARY KEY (vehicle, component)
    )""",
)
T = TypeVar("T")
_Key = tuple[str, int]


@dataclass(frozen=True)
class Entry:
    """One operation that waits.

    Attributes:
        id: its place in the order of all that wait.
        writer, number: under which the database does it once.
    """

    id: int
    writer: str
    number: int
    operation: Operation[object]


class LocalCopy:
    """A file like that of a cache without a database, with what of that this station has to do with.

    Several processes of one computer share it.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.database = Database(path)

    @property
    def exists(self) -> bool:
        """Whether the database was reached from here before."""
        return self.path.exists()

    def begin(self) -> None:
        """Make the file, if need be: the database has been reached."""
        self._write(lambda session: None)

    def read(self, work: Callable[[Session], T]) -> T:
        """Do work that only reads, in one transaction."""
        return self.database.read(lambda connection: work(SqliteSession(connection, is_shared=True)))

    def do(self, operation: Operation[T]) -> T:
        """Do what the database has done."""
        return self._write(operation.do)

    def spool(self, operation: Operation[T], writer: str, number: int) -> T:
        """Do what the database will have to do, and keep it for that; both, or nothing."""

        def work(session: SqliteSession) -> T:
            result = operation.do(session)
            session.connection.execute(
                "INSERT INTO outbox (writer, number, operation) VALUES (?, ?, ?)",
                (writer, number, packed(operation)),
            )
            return result

        return self._write(work, durable=operation.is_durable)

    def waiting(self, limit: int) -> list[Entry]:
        """What waits, the oldest first; without what the database has refused."""

        def work(session: SqliteSession) -> list[Entry]:
            found = session.connection.execute(
                "SELECT id, writer, number, operation FROM outbox WHERE refused IS NULL ORDER BY id LIMIT ?",
                (limit,),
            )
            return [
                Entry(place, writer, number, unpacked(operation))
                for place, writer, number, operation in found.fetchall()
            ]

        return self._write(work) if self.exists else []

    def arrived(self, entries: Sequence[Entry], tables: Iterable[_Key]) -> None:
        """Forget what has been done; these tables are no copies any more."""

        def work(session: SqliteSession) -> None:
            done = [(each.id,) for each in entries]
            session.connection.executemany("DELETE FROM outbox WHERE id = ?", done)
            session.connection.executemany("REPLACE INTO mirrored VALUES (?, ?, -1)", list(tables))

        self._write(work)

    def refuse(self, entry: Entry, why: str) -> None:
        """Set aside what the database cannot do. It stays in the file."""
        self._write(
            lambda session: session.connection.execute(
                "UPDATE outbox SET refused = ? WHERE id = ?", (why, entry.id)
            )
        )

    def revisions(self) -> dict[_Key, int]:
        """Of which tables this is a copy, and of which revision."""

        def work(session: SqliteSession) -> dict[_Key, int]:
            found = session.connection.execute("SELECT vehicle, component, revision FROM mirrored")
            return {(key, component): revision for key, component, revision in found}

        return self._write(work) if self.exists else {}

    def goes_on(self, key: _Key, revision: int | None) -> None:
        """Say of which revision a table is a copy; None where it is none any more."""

        def work(session: SqliteSession) -> None:
            if revision is None:
                session.connection.execute("DELETE FROM mirrored WHERE (vehicle, component) = (?, ?)", key)
            else:
                session.connection.execute("REPLACE INTO mirrored VALUES (?, ?, ?)", (*key, revision))

        self._write(work)

    def mirror(self, key: _Key, whole: Whole | None, revision: int | None) -> None:
        """Make a table what the database has of it; None where that has it no more."""

        def work(session: SqliteSession) -> None:
            if whole is None:
                session.remove(*key)
                session.connection.execute("DELETE FROM mirrored WHERE (vehicle, component) = (?, ?)", key)
            else:
                owner = put_whole(session, whole)
                put_shots(session, owner, whole)
                session.connection.execute("REPLACE INTO mirrored VALUES (?, ?, ?)", (*key, revision))

        self._write(work)

    def snapshots(self, key: _Key) -> frozenset[int]:
        """The numbers of a table's snapshots that are here."""
        return self.read(lambda session: frozenset(each.id for each in session.snapshots(*key)))

    def close(self) -> None:
        """Close the file."""
        self.database.close()

    def _write(self, work: Callable[[SqliteSession], T], *, durable: bool = False) -> T:
        def whole(connection: Any) -> T:
            for statement in _TABLES:
                connection.execute(statement)
            return work(SqliteSession(connection, is_shared=True))

        return self.database.write(whole, durable=durable)


def packed(operation: Operation[object]) -> bytes:
    """An operation as bytes. One that cannot wait raises TypeError."""
    data: list[Any]
    if isinstance(operation, Save):
        data = ["save", [_update_cells(each) for each in operation.updates]]
    elif isinstance(operation, Merge):
        based_on = [[*key, at] for key, at in operation.based_on.items()]
        data = ["merge", [_update_cells(each) for each in operation.updates], based_on]
    elif isinstance(operation, SetDown):
        vehicle = operation.vehicle
        who = vehicle if isinstance(vehicle, str) else identity_cells(vehicle)
        params = operation.params
        rest = [operation.at, operation.reason, operation.hash, operation.complete, operation.number]
        shown = None if params is None else [written_cells(each) for each in params.values()]
        data = ["set down", who, operation.component, shown, *rest]
    else:
        raise TypeError(f"{type(operation).__name__} cannot wait")
    return zlib.compress(json.dumps(data, separators=(",", ":")).encode("utf-8", "surrogatepass"))


def unpacked(data: object) -> Operation[object]:
    """The inverse of `packed`; `Damaged` where it is not its result."""
    try:
        assert isinstance(data, bytes)
        kind, *rest = json.loads(zlib.decompress(data).decode("utf-8", "surrogatepass"))
        if kind == "save":
            return Save([_update(each) for each in rest[0]])
        if kind == "merge":
            return Merge(
                [_update(each) for each in rest[0]], {(key, number): at for key, number, at in rest[1]}
            )
        who, component, shown, at, reason, crc, complete, number = rest
        params = None if shown is None else ParamSet({each.name: each for each in map(read_written, shown)})
        vehicle = who if isinstance(who, str) else read_identity(who)
        return SetDown(vehicle, component, params, at, reason, crc, complete, number)
    except (AssertionError, LookupError, TypeError, ValueError, zlib.error) as error:
        raise Damaged(f"what waits to be written is damaged: {error}") from error


def _update_cells(update: TableUpdate) -> list[Any]:
    return [
        identity_cells(update.identity),
        update.component,
        update.autopilot,
        update.at,
        None if update.table is None else astuple(update.table),
        [_item_cells(each) for each in update.params],
        list(update.removed),
        update.replace,
        dict(update.removed_at),
        update.whole_at,
    ]


def _update(data: list[Any]) -> TableUpdate:
    who, component, autopilot, at, state, items, removed, is_whole, *times = data
    removed_at, whole_at = times or ({}, None)  # an earlier version has kept neither
    return TableUpdate(
        identity=read_identity(who),
        component=component,
        autopilot=autopilot,
        at=at,
        table=None if state is None else TableState(*state),
        params=[_item(each) for each in items],
        removed=removed,
        removed_at=removed_at,
        replace=is_whole,
        whole_at=whole_at,
    )


def _item_cells(item: StoredParam) -> list[Any]:
    param = item.param
    row = Row.of(param, param.index, False, item.heard_at)
    return [param.name, *row.value, param.index, row.default_bits, item.heard_at, item.volatile, item.by]


def _item(data: list[Any]) -> StoredParam:
    name, number, bits, is_raw, index, default, heard_at, volatile, by = data
    return StoredParam(read_param(name, number, bits, is_raw, index, default), heard_at, volatile, by)
