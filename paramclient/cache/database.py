"""The tables of the cache in one SQL text for SQLite and PostgreSQL, and the store in a SQLite file.

A new column or another meaning needs another `SCHEMA_VERSION`: a file of another version is set aside, and a
database keeps each version in a schema of its own. Values are marked by `?`.

Several processes may use the file. SQLite runs in WAL mode with synchronous=NORMAL: committed transactions
survive a killed process; a power loss may lose the last ones, but does not damage the file. A durable
transaction is committed with synchronous=FULL, which syncs all earlier ones too (SQLite, "PRAGMA
synchronous").
"""

from __future__ import annotations

import itertools
import logging
import os
import sqlite3
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Final, TypeVar

from paramclient.errors import CacheError, ParamClientError

SCHEMA_VERSION: Final = 22
"""Version of the tables. Unreleased versions had lower numbers."""
IDENTITY: Final = (
    "system, link, uid, autopilot, vehicle_type, firmware, git_hash,"
    " board, vendor_id, product_id, capabilities"
)
"""Columns of a vehicle's identity, in the order of the attributes of `Identity`."""

TABLES: Final = (
    """CREATE TABLE vehicle (
        key TEXT NOT NULL PRIMARY KEY,
        system INTEGER NOT NULL,
        link TEXT NOT NULL,
        uid TEXT,
        autopilot INTEGER NOT NULL,
        vehicle_type INTEGER NOT NULL,
        firmware BIGINT NOT NULL,
        git_hash TEXT NOT NULL,
        board BIGINT NOT NULL,
        vendor_id INTEGER NOT NULL,
        product_id INTEGER NOT NULL,
        capabilities TEXT NOT NULL,
        first_seen DOUBLE PRECISION NOT NULL,
        last_seen DOUBLE PRECISION NOT NULL
    )""",
    # a table of parameters: the plain or the extended ones of a component
    """CREATE TABLE component (
        id {id},
        vehicle TEXT NOT NULL REFERENCES vehicle (key) ON DELETE CASCADE,
        component INTEGER NOT NULL,
        extended INTEGER NOT NULL,
        autopilot INTEGER NOT NULL,
        hash BIGINT,
        param_count INTEGER,
        complete INTEGER NOT NULL DEFAULT 0,
        volatile_known INTEGER NOT NULL DEFAULT 0,
        synced_at DOUBLE PRECISION,
        updated_at DOUBLE PRECISION NOT NULL,
        file_works INTEGER,
        known_since DOUBLE PRECISION,
        UNIQUE (vehicle, component, extended)
    )""",
    # value: `Param.bits`, little-endian, in 8 bytes, in more for text and bytes, in 4 for the raw bytes of a
    # message; no value: the vehicle no longer has the parameter
    """CREATE TABLE parameter (
        owner BIGINT NOT NULL REFERENCES component (id) ON DELETE CASCADE,
        name TEXT NOT NULL,
        type INTEGER,
        value BYTEA,
        param_index INTEGER,
        volatile INTEGER NOT NULL,
        heard_at DOUBLE PRECISION NOT NULL,
        default_value BYTEA,
        PRIMARY KEY (owner, name)
    ){clustered}""",
    # old_at: when the old value was last observed; no old value: the name appeared in a complete table;
    # no new value: the vehicle no longer has the parameter
    """CREATE TABLE history (
        id {id},
        owner BIGINT NOT NULL REFERENCES component (id) ON DELETE CASCADE,
        at DOUBLE PRECISION NOT NULL,
        name TEXT NOT NULL,
        author TEXT NOT NULL,
        old_at DOUBLE PRECISION,
        old_type INTEGER,
        old_value BYTEA,
        new_type INTEGER,
        new_value BYTEA
    )""",
    "CREATE INDEX history_by_time ON history (owner, at)",
    "CREATE INDEX history_by_name ON history (owner, name)",
    # ended: of the apply or restore that has stored the snapshot; NULL for others
    """CREATE TABLE snapshot (
        id {id},
        owner BIGINT NOT NULL REFERENCES component (id) ON DELETE CASCADE,
        at DOUBLE PRECISION NOT NULL,
        reason TEXT NOT NULL,
        identity TEXT NOT NULL,
        hash BIGINT,
        complete INTEGER NOT NULL,
        ended INTEGER
    )""",
    "CREATE INDEX snapshot_of_component ON snapshot (owner)",
    """CREATE TABLE snapshot_parameter (
        snapshot BIGINT NOT NULL REFERENCES snapshot (id) ON DELETE CASCADE,
        position INTEGER NOT NULL,
        name TEXT NOT NULL,
        type INTEGER NOT NULL,
        value BYTEA NOT NULL,
        default_value BYTEA,
        PRIMARY KEY (snapshot, position)
    ){clustered}""",
)
"""Statements that create the tables. `{id}` is a number that is never used again, `{clustered}` stores the
rows in the order of the primary key."""

CALL_ATTEMPTS_MAX: Final = 3
"""Attempts of one call: the file may be set aside, and another process may replace it, once each."""

APPLICATION_ID: Final = 0x5041524D
"""Application id of paramclient in the header of the file: `PARM`."""
LOCK_WAIT_MAX: Final = 5.0
"""Seconds for which a call waits while another process writes. Transactions take milliseconds."""
WAL_SWITCH_INTERVAL: Final = 0.01
"""Seconds between two attempts to switch a new file to WAL mode: SQLite does not wait for other processes."""

_PARTS: Final = ("-shm", "-wal", "")
_DAMAGE: Final = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB})
# Error codes if no -wal or -shm can be created: the folder is read-only, or the disk is full.
_UNWRITABLE: Final = frozenset(
    {sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_IOERR_SHMSIZE, sqlite3.SQLITE_READONLY_DIRECTORY}
)
_CAUSES: Final = {sqlite3.SQLITE_IOERR_SHMSIZE: "the disk is full"}
"""Words for error codes of which SQLite says less."""
_SYNTAX: Final = {"id": "INTEGER PRIMARY KEY AUTOINCREMENT", "clustered": " WITHOUT ROWID"}

logger = logging.getLogger("paramclient.cache")
T = TypeVar("T")


class Transaction:
    """Runs the statements of one transaction. A write transaction excludes all others.

    Args:
        connection: a connection of `sqlite3` or psycopg.
        mark: the placeholder of a value in its statements.
    """

    def __init__(self, connection: Any, mark: str = "?") -> None:
        self._connection = connection
        self._mark = mark

    def all(self, sql: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """Run a statement and return its rows."""
        return list(self._connection.execute(self._marked(sql), values))

    def do(self, sql: str, values: Sequence[object] = ()) -> int:
        """Run a statement and return the number of rows that it changed."""
        return int(self._connection.execute(self._marked(sql), values).rowcount)

    def many(self, sql: str, rows: Sequence[Sequence[object]]) -> list[int]:
        """Run a statement once for each row of values, and return the numbers of rows that were changed."""
        return [self.do(sql, row) for row in rows]

    def _marked(self, sql: str) -> str:
        return sql.replace("?", self._mark)


class Store(ABC):
    """A file or a database with the tables, opened by the first call. Thread-safe.

    Args:
        place: the file, or the URL of the database without password, for messages.

    Attributes:
        place: as given.
        notes: one text for each file that was set aside, and for writes that are left out.
        replacements: number of times that another file has taken the place of one that was used.
    """

    def __init__(self, place: str) -> None:
        self.place = place
        self.notes: list[str] = []
        self.replacements = 0
        self._connection: Any = None
        self._lock = threading.Lock()
        self._is_closed = False

    def run(self, work: Callable[[Transaction], T], *, writing: bool, durable: bool = False) -> T:
        """Run a function in one transaction and return its result: either all or nothing is written.

        Args:
            work: the function. It may run again from the start.
            writing: whether it writes.
            durable: return only when this and all earlier transactions are safe from power loss.

        Raises:
            CacheError: the cache cannot be used. Nothing was written.
        """
        with self._lock:
            if self._is_closed:
                raise CacheError(f"the cache {self.place} is closed")
            for _ in range(CALL_ATTEMPTS_MAX):
                try:
                    return self._transact(work, writing=writing, durable=durable)
                except BaseException as error:
                    self._drop()  # this rolls the transaction back
                    self._recover(error, writing=writing)
            raise CacheError(f"the cache {self.place} was replaced {CALL_ATTEMPTS_MAX} times during one call")

    def close(self) -> None:
        """Close it; later calls raise CacheError."""
        with self._lock:
            self._is_closed = True
            self._drop()

    @abstractmethod
    def _transact(self, work: Callable[[Transaction], T], *, writing: bool, durable: bool) -> T:
        """Run one attempt."""

    @abstractmethod
    def _recover(self, error: BaseException, *, writing: bool) -> None:
        """Return if another attempt may succeed after an error; raise otherwise."""

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            with suppress(Exception):
                connection.close()


class _Unusable(Exception):
    """The file is no cache of this version. Its argument is the kind of file, a part of its new name."""


class _Replaced(Exception):
    """The open file is no longer the one under the path."""


class SqliteStore(Store):
    """A cache in a file. Reading creates no file.

    A file that is damaged, of another version of paramclient or no cache is renamed, with a warning in the
    log, and a new one is created. No file is deleted.

    Args:
        path: the file, absolute.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._path = path
        self._file: tuple[int, int] | None = None  # device and inode of the open file
        self._is_read_only = False  # whether the open file counts as one that nobody writes

    def _transact(self, work: Callable[[Transaction], T], *, writing: bool, durable: bool) -> T:
        if self._file is not None and self._which() != self._file:  # deleted, renamed or replaced
            self._drop()
            self._file = None
            self.replacements += 1
        if not writing and self._which() is None:
            return _read_nothing(work)
        if self._is_read_only:  # another process may have written since
            self._drop()
        if self._connection is None:
            self._connection = self._open(writing=writing)
        connection = self._connection
        if durable:
            connection.execute("PRAGMA synchronous = FULL")
        connection.execute("BEGIN IMMEDIATE" if writing else "BEGIN")
        if not _has_tables(connection):
            if not writing:
                connection.execute("COMMIT")
                return _read_nothing(work)
            _create(connection)
        result = work(Transaction(connection))
        if durable:  # a transaction without a write would not sync; this writes the unchanged version
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        connection.execute("COMMIT")
        if durable:
            connection.execute("PRAGMA synchronous = NORMAL")
        if writing and self._which() != self._file:
            raise _Replaced
        return result

    def _recover(self, error: BaseException, *, writing: bool) -> None:
        code = getattr(error, "sqlite_errorcode", 0)
        match error:
            case _Replaced():
                return
            case _Unusable():
                self._set_aside(str(error))
            case sqlite3.DatabaseError() if code & 0xFF in _DAMAGE and not self._is_read_only:
                self._set_aside("damaged")
            case sqlite3.DatabaseError() | OSError():
                cause = _CAUSES.get(code, error)
                raise CacheError(f"the cache {self.place} cannot be used: {cause}") from error
            case Exception() if not isinstance(error, ParamClientError):
                # a value that this program cannot have written, or cannot write
                if self._is_sound():
                    raise CacheError(f"the cache {self.place} cannot be used: {error!r}") from error
                self._set_aside("damaged")
            case _:
                raise error

    def _open(self, *, writing: bool) -> sqlite3.Connection:
        if writing:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            os.close(os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600))
        self._file = self._which()
        connection = _connect(f"{self._path.as_uri()}?mode=rw")
        self._is_read_only = not writing and _is_unwritable(connection)
        if self._is_read_only:
            connection.close()
            wal = Path(f"{self._path}-wal")
            if wal.exists() and wal.stat().st_size:  # a full disk leaves an empty one
                self._warn(_WITHOUT_WAL.format(self.place))
            return _connect(f"{self._path.as_uri()}?mode=ro&immutable=1")
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA synchronous = NORMAL")
        if writing:
            connection.execute("BEGIN")  # another process may be creating the tables
            _has_tables(connection)  # nothing is changed in a file that is no cache
            connection.execute("COMMIT")
            _switch_to_wal(connection)
        return connection

    def _is_sound(self) -> bool:
        """Return whether SQLite finds the file undamaged."""
        try:
            with closing(self._open(writing=False)) as connection:
                return connection.execute("PRAGMA quick_check(1)").fetchall() == [("ok",)]
        except (sqlite3.Error, OSError):
            return False

    def _which(self) -> tuple[int, int] | None:
        """Return device and inode of the file under the path; None if there is none."""
        with suppress(FileNotFoundError):
            status = self._path.stat()
            return status.st_dev, status.st_ino
        return None

    def _set_aside(self, kind: str) -> None:
        """Rename the file that was open, with its -wal and -shm; unless another process has done so."""
        if self._which() != self._file:
            return
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        names = (f"{self._path.name}.{kind}-{stamp}-{number}" for number in itertools.count(1))
        name = next(each for each in names if not self._path.with_name(each).exists())
        try:
            for suffix in _PARTS:
                with suppress(FileNotFoundError):
                    Path(f"{self._path}{suffix}").rename(self._path.with_name(name + suffix))
        except OSError as error:
            raise CacheError(f"the cache {self.place} is {kind}, and cannot be renamed: {error}") from error
        self._warn(f"the cache {self.place} is {_KINDS[kind]}. It is kept as {name}; a new one begins")

    def _warn(self, note: str) -> None:
        """Log a warning, once."""
        if note not in self.notes:
            self.notes.append(note)
            logger.warning("%s", note)


_WITHOUT_WAL: Final = (
    "the last writes, in {0}-wal, are left out: the folder is read-only. Copy it, and open the cache there"
)


_KINDS: Final = {
    "damaged": "damaged",
    "foreign": "a database of another program, or of an unreleased version of paramclient",
    "newer": "of a newer version of paramclient",
}


def _connect(uri: str) -> sqlite3.Connection:
    return sqlite3.connect(
        uri, uri=True, timeout=LOCK_WAIT_MAX, isolation_level=None, check_same_thread=False
    )


def _is_unwritable(connection: sqlite3.Connection) -> bool:
    try:
        connection.execute("PRAGMA user_version").fetchall()
    except sqlite3.OperationalError as error:
        return error.sqlite_errorcode in _UNWRITABLE
    return False


def _switch_to_wal(connection: sqlite3.Connection) -> None:
    deadline = time.monotonic() + LOCK_WAIT_MAX
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > deadline:
                raise
            time.sleep(WAL_SWITCH_INTERVAL)


def _has_tables(connection: sqlite3.Connection) -> bool:
    """Return whether the file has the tables of a cache, or none at all.

    Raises:
        _Unusable: it has others.
    """
    [(application,)] = connection.execute("PRAGMA application_id")
    [(version,)] = connection.execute("PRAGMA user_version")
    if (application, version) == (APPLICATION_ID, SCHEMA_VERSION):
        return True
    [(tables,)] = connection.execute("SELECT count(*) FROM sqlite_master")
    if not tables:
        return False
    if application == APPLICATION_ID and version > SCHEMA_VERSION:
        raise _Unusable("newer")
    raise _Unusable("foreign")


def _create(connection: sqlite3.Connection) -> None:
    for statement in TABLES:
        connection.execute(statement.format(**_SYNTAX))
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


def _read_nothing(work: Callable[[Transaction], T]) -> T:
    """Run a function that reads on an empty cache."""
    with closing(_connect("file::memory:")) as connection:
        _create(connection)
        return work(Transaction(connection))
