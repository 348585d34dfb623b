"""LocalCopy: local copy of a shared database, with an outbox of writes for the database."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from paramclient.cache.cells import Damaged, identity_cells, read_identity
from paramclient.cache.ext_records import ExtTableUpdate, StoredExtParam
from paramclient.cache.operations import Merge, Save, SaveExt, StoreExtSnapshot, StoreOperation, StoreSnapshot
from paramclient.cache.param_columns import COLUMN_NAMES, StoredParam
from paramclient.cache.records import TableState, TableUpdate
from paramclient.cache.snapshots import read_written, written_cells
from paramclient.cache.sqlite import SqliteTransaction
from paramclient.cache.sqlite_file import Database
from paramclient.cache.transaction import Transaction
from paramclient.cache.transfer import TableDump, put_snapshots, put_whole
from paramclient.model.ext_params import ExtParam
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Trust

__all__ = ["QueuedOperation", "LocalCopy", "packed", "unpacked"]

# Tables of the local copy beside those of a cache file: the outbox, and the copied revision of each table.
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
_FIRST: Final = (
    *("name", "type", "bits", "is_raw", "param_index", "default_bits"),
    *("heard_at", "volatile", "by"),
)
_LATER: Final = tuple(name for name in COLUMN_NAMES if name not in _FIRST)
_ITEM: Final = (*_FIRST, *_LATER)
"""Fields of a queued parameter, in order: those of the first version, then later columns."""
T = TypeVar("T")
_Key = tuple[str, int]


@dataclass(frozen=True)
class QueuedOperation:
    """A queued operation.

    Attributes:
        id: its position in the queue.
        writer, number: program and number under which the database executes it only once.
        operation: the operation.
    """

    id: int
    writer: str
    number: int
    operation: StoreOperation[object]


class LocalCopy:
    """A cache file with the tables of the database that the programs of this computer use.

    Several processes of one computer share the file.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.database = Database(path)

    @property
    def exists(self) -> bool:
        """Whether the file exists, that is, whether the database was reached from this computer before."""
        return self.path.exists()

    def begin(self) -> None:
        """Create the file if it does not exist, after the database was reached."""
        self._write(lambda transaction: None)

    def read(self, work: Callable[[Transaction], T]) -> T:
        """Run a function that only reads, in one transaction, and return its result."""
        return self.database.read(lambda connection: work(SqliteTransaction(connection, is_shared=True)))

    def do(self, operation: StoreOperation[T]) -> T:
        """Execute an operation that the database has executed."""
        return self._write(operation.do)

    def spool(self, operation: StoreOperation[T], writer: str, number: int) -> T:
        """Execute an operation and queue it for the database, in one transaction."""

        def work(transaction: SqliteTransaction) -> T:
            result = operation.do(transaction)
            transaction.connection.execute(
                "INSERT INTO outbox (writer, number, operation) VALUES (?, ?, ?)",
                (writer, number, packed(operation)),
            )
            return result

        return self._write(work, durable=operation.is_durable)

    def waiting(self, limit: int) -> list[QueuedOperation]:
        """Return queued operations, the oldest first, without those that the database has refused."""

        def work(transaction: SqliteTransaction) -> list[QueuedOperation]:
            found = transaction.connection.execute(
                "SELECT id, writer, number, operation FROM outbox WHERE refused IS NULL ORDER BY id LIMIT ?",
                (limit,),
            )
            return [
                QueuedOperation(place, writer, number, unpacked(operation))
                for place, writer, number, operation in found.fetchall()
            ]

        return self._write(work) if self.exists else []

    def mark_delivered(self, entries: Sequence[QueuedOperation], tables: Iterable[_Key]) -> None:
        """Remove executed operations from the queue, and mark these tables as stale."""

        def work(transaction: SqliteTransaction) -> None:
            done = [(each.id,) for each in entries]
            transaction.connection.executemany("DELETE FROM outbox WHERE id = ?", done)
            transaction.connection.executemany("REPLACE INTO mirrored VALUES (?, ?, -1)", list(tables))

        self._write(work)

    def refuse(self, entry: QueuedOperation, why: str) -> None:
        """Mark an operation as refused by the database. It stays in the file."""
        self._write(
            lambda transaction: transaction.connection.execute(
                "UPDATE outbox SET refused = ? WHERE id = ?", (why, entry.id)
            )
        )

    def revisions(self) -> dict[_Key, int]:
        """Return the copied revision of each table."""

        def work(transaction: SqliteTransaction) -> dict[_Key, int]:
            found = transaction.connection.execute("SELECT vehicle, component, revision FROM mirrored")
            return {(key, component): revision for key, component, revision in found}

        return self._write(work) if self.exists else {}

    def set_copied_revision(self, key: _Key, revision: int | None) -> None:
        """Set the copied revision of a table; None if it is no longer a copy."""

        def work(transaction: SqliteTransaction) -> None:
            if revision is None:
                transaction.connection.execute(
                    "DELETE FROM mirrored WHERE (vehicle, component) = (?, ?)", key
                )
            else:
                transaction.connection.execute("REPLACE INTO mirrored VALUES (?, ?, ?)", (*key, revision))

        self._write(work)

    def mirror(self, key: _Key, whole: TableDump | None, revision: int | None) -> None:
        """Replace a table with that of the database; None removes it."""

        def work(transaction: SqliteTransaction) -> None:
            if whole is None:
                transaction.remove(*key)
                transaction.connection.execute(
                    "DELETE FROM mirrored WHERE (vehicle, component) = (?, ?)", key
                )
            else:
                owner = put_whole(transaction, whole)
                put_snapshots(transaction, owner, whole)
                transaction.connection.execute("REPLACE INTO mirrored VALUES (?, ?, ?)", (*key, revision))

        self._write(work)

    def snapshots(self, key: _Key) -> frozenset[int]:
        """Return the numbers of the snapshots of a table in this file."""

        def work(transaction: Transaction) -> frozenset[int]:
            kinds = (transaction.snapshots(*key, is_extended=each) for each in (False, True))
            return frozenset(each.id for kind in kinds for each in kind)

        return self.read(work)

    def close(self) -> None:
        """Close the file."""
        self.database.close()

    def _write(self, work: Callable[[SqliteTransaction], T], *, durable: bool = False) -> T:
        def whole(connection: Any) -> T:
            for statement in _TABLES:
                connection.execute(statement)
            return work(SqliteTransaction(connection, is_shared=True))

        return self.database.write(whole, durable=durable)


def packed(operation: StoreOperation[object]) -> bytes:
    """Serialize an operation for the outbox.

    Raises:
        TypeError: operations of this type cannot be queued.
    """
    data: list[Any]
    if isinstance(operation, Save):
        data = ["save", [_update_cells(each) for each in operation.updates]]
    elif isinstance(operation, SaveExt):
        data = ["save ext", [_ext_update_cells(each) for each in operation.updates]]
    elif isinstance(operation, Merge):
        based_on = [[*key, at] for key, at in operation.based_on.items()]
        data = ["merge", [_update_cells(each) for each in operation.updates], based_on]
    elif isinstance(operation, StoreSnapshot):
        vehicle = operation.vehicle
        vehicle_cells = vehicle if isinstance(vehicle, str) else identity_cells(vehicle)
        params = operation.params
        rest = [operation.at, operation.reason, operation.hash, operation.complete, operation.number]
        shown = None if params is None else [written_cells(each) for each in params.values()]
        data = ["set down", vehicle_cells, operation.component, shown, *rest]
    elif isinstance(operation, StoreExtSnapshot):
        vehicle = operation.vehicle
        vehicle_cells = vehicle if isinstance(vehicle, str) else identity_cells(vehicle)
        ext = operation.params
        rows = None if ext is None else [_ext_param_cells(each) for each in ext.params.values()]
        last = [operation.at, operation.reason, operation.complete, operation.number]
        data = ["set down ext", vehicle_cells, operation.component, rows, *last]
    else:
        raise TypeError(f"{type(operation).__name__} cannot be queued")
    return zlib.compress(json.dumps(data, separators=(",", ":")).encode("utf-8", "surrogatepass"))


def unpacked(data: object) -> StoreOperation[object]:
    """Deserialize a result of `packed`.

    Raises:
        Damaged: the data is not a result of `packed`.
    """
    try:
        assert isinstance(data, bytes)
        kind, *rest = json.loads(zlib.decompress(data).decode("utf-8", "surrogatepass"))
        if kind == "save":
            return Save([_update(each) for each in rest[0]])
        if kind == "save ext":
            return SaveExt([_ext_update(each) for each in rest[0]])
        if kind == "merge":
            return Merge(
                [_update(each) for each in rest[0]], {(key, number): at for key, number, at in rest[1]}
            )
        if kind == "set down ext":
            vehicle_cells, component, rows, *last = rest
            ext = None if rows is None else ExtParamSet({row[0]: _ext_param(*row) for row in rows})
            vehicle = vehicle_cells if isinstance(vehicle_cells, str) else read_identity(vehicle_cells)
            return StoreExtSnapshot(vehicle, component, ext, *last)
        vehicle_cells, component, shown, at, reason, crc, complete, number = rest
        params = None if shown is None else ParamSet({each.name: each for each in map(read_written, shown)})
        vehicle = vehicle_cells if isinstance(vehicle_cells, str) else read_identity(vehicle_cells)
        return StoreSnapshot(vehicle, component, params, at, reason, crc, complete, number)
    except (AssertionError, LookupError, TypeError, ValueError, zlib.error) as error:
        raise Damaged(f"a queued operation is damaged: {error}") from error


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
    vehicle_cells, component, autopilot, at, state, items, removed, is_whole, *times = data
    removed_at, whole_at = times or ({}, None)  # earlier versions wrote neither
    return TableUpdate(
        identity=read_identity(vehicle_cells),
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


def _ext_update_cells(update: ExtTableUpdate) -> list[Any]:
    return [
        identity_cells(update.identity),
        update.component,
        update.autopilot,
        update.at,
        [[*row[:2], row.raw.hex(), *row[3:]] for row in update.params],
        dict(update.removed),
        update.count,
        update.complete,
    ]


def _ext_update(data: list[Any]) -> ExtTableUpdate:
    vehicle_cells, component, autopilot, at, rows, removed, count, complete = data
    return ExtTableUpdate(
        identity=read_identity(vehicle_cells),
        component=component,
        autopilot=autopilot,
        at=at,
        params=[_ext_row(*row) for row in rows],
        removed=removed,
        count=count,
        complete=complete,
    )


def _ext_param_cells(param: ExtParam) -> list[Any]:
    return [param.name, int(param.type), param.raw.hex(), param.index]


def _ext_param(name: str, number: int, raw: str, index: int | None) -> ExtParam:
    return ExtParam.of(name, bytes.fromhex(raw), number, index, Trust.CACHED)


def _ext_row(name: str, number: int, raw: str, index: int | None, heard_at: float, by: str) -> StoredExtParam:
    return StoredExtParam(name, number, bytes.fromhex(raw), index, heard_at, by)


def _item_cells(item: StoredParam) -> list[Any]:
    return [getattr(item, name) for name in _ITEM]


def _item(data: list[Any]) -> StoredParam:
    found = dict(zip(_ITEM, data, strict=False))  # earlier versions have fewer
    item = StoredParam._make(map(found.get, StoredParam._fields))
    volatile = None if item.volatile is None else bool(item.volatile)
    later: dict[str, Any] = {name: found.get(name) for name in _LATER}
    checked = StoredParam(item.param, item.heard_at, volatile, item.by)
    return checked._replace(**later)
