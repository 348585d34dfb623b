"""The cache in a SQLite file.

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
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Final, TypeVar

from paramclient.cache.database import SCHEMA_VERSION, TABLES, Store, Transaction
from paramclient.errors import CacheError, ParamClientError

__all__ = ["SqliteStore"]

APPLICATION_ID: Final = 0x5041524D
"""Application id of paramclient in the header of the file: `PARM`."""
LOCK_WAIT_MAX: Final = 5.0
"""Seconds for which a call waits while another process writes. Transactions take milliseconds."""
WAL_SWITCH_INTERVAL: Final = 0.01
"""Seconds between two attempts to switch a new file to WAL mode: SQLite does not wait for other processes."""

_PARTS: Final = ("", "-wal", "-shm")
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
        self._is_read_only = False  # whether the file is opened as one that nobody writes

    def _transact(self, work: Callable[[Transaction], T], *, writing: bool, durable: bool) -> T:
        if self._file is not None and self._which() != self._file:  # deleted, renamed or replaced
            self._drop()
            self._file = None
            self.replacements += 1
        if not writing and not self._path.exists():
            return _read_nothing(work)
        if writing and self._is_read_only:
            self._drop()
            self._is_read_only = False
        if self._connection is None:
            self._connection = self._open(writing=writing)
        connection = self._connection
        if durable:
            connection.execute("PRAGMA synchronous = FULL")
        connection.execute("BEGIN IMMEDIATE" if writing else "BEGIN")
        is_empty = not _has_tables(connection)
        if is_empty and not writing:
            connection.execute("COMMIT")
            return _read_nothing(work)
        if is_empty:
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
            case sqlite3.DatabaseError() if code & 0xFF in _DAMAGE:
                self._set_aside("damaged")
            case sqlite3.DatabaseError() if code in _UNWRITABLE and not writing and not self._is_read_only:
                self._is_read_only = True
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
        if self._is_read_only:
            return _connect(f"{self._path.as_uri()}?mode=ro&immutable=1")
        connection = _connect(f"{self._path.as_uri()}?mode=rw")
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

    def _part(self, suffix: str) -> Path:
        return self._path.with_name(self._path.name + suffix)

    def _set_aside(self, kind: str) -> None:
        """Rename the file that was open, with its -wal and -shm; unless another process has done so."""
        if self._which() != self._file:
            return
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        names = (f"{self._path.name}.{kind}-{stamp}-{number}" for number in itertools.count(1))
        name = next(each for each in names if not self._path.with_name(each).exists())
        try:
            for suffix in reversed(_PARTS):
                with suppress(FileNotFoundError):
                    self._part(suffix).rename(self._path.with_name(name + suffix))
        except OSError as error:
            raise CacheError(f"the cache {self.place} is {kind}, and cannot be renamed: {error}") from error
        self.notes.append(f"the cache {self.place} is {_KINDS[kind]}. It is kept as {name}; a new one begins")
        logger.warning("%s", self.notes[-1])


_KINDS: Final = {
    "damaged": "damaged",
    "foreign": "a database of another program, or of an unreleased version of paramclient",
    "newer": "of a newer version of paramclient",
}


def _connect(uri: str) -> sqlite3.Connection:
    return sqlite3.connect(
        uri, uri=True, timeout=LOCK_WAIT_MAX, isolation_level=None, check_same_thread=False
    )


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
    connection = _connect("file::memory:")
    try:
        _create(connection)
        return work(Transaction(connection))
    finally:
        connection.close()
