"""The file: opened when needed, shared with other processes, and set aside when it cannot be trusted.

SQLite in WAL mode with synchronous=NORMAL. What was committed survives the death of a process at any moment;
a power cut may take the last transactions, never the file. A durable transaction is committed with
synchronous=FULL: the log is synchronised with the disk before the call returns, and with it all that was
committed before (SQLite, "PRAGMA synchronous").

The structure of the file is checked when it is opened; each table has a checksum of its own, checked when it
is read. Only a file that is empty, or a database with our application id, is ever changed or renamed;
anything else under the path is an error. That is seen before SQLite opens it, which would take up, empty or
delete any log that stands beside it. Under an open connection, another process may find the file damaged
and rename it, or somebody may delete it: every operation looks whether its file still stands under the path.
SQLite does so too before it would touch the `-wal` of the file that came in its place. Opening, creating,
upgrading and renaming happen under a lock on the folder (`flock`), so that two processes never do it at once.
The file itself is opened by SQLite alone while any cache of this process has it open: to close another
descriptor of it would drop SQLite's locks (POSIX, fcntl).
"""

from __future__ import annotations

import errno
import logging
import os
import sqlite3
import stat
import sys
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cache
from itertools import chain, count
from pathlib import Path
from typing import Final, TypeAlias, TypeVar

from paramclient.cache.file_ownership import OF_OTHERS, OTHERS_WRITE, is_own, make_private, mode_of
from paramclient.cache.lock import BUSY_TIMEOUT, locked
from paramclient.cache.rows import Damaged
from paramclient.cache.schema import MIGRATIONS, Step
from paramclient.errors import CacheError

__all__ = ["APPLICATION_ID", "Database"]

APPLICATION_ID: Final = 0x5041524D
"""Stands in the file's header and says whose database it is: `PARM`."""

_MAGIC: Final = b"SQLite format 3\0"
_ID_AT: Final = slice(68, 72)
"""How a database of SQLite begins, and where its application id stands (SQLite, "Database File Format")."""
_LOG_MAGICS: Final = (b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")
_LOG_HEADER, _FRAME_HEADER = 32, 24
"""How a write-ahead log of SQLite begins, and the bytes before the first page in it and before each page."""
_JOURNAL_MAGIC: Final = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
"""How a rollback journal of SQLite begins, once it counts."""

_TRIES: Final = 3
"""Rounds of one operation: the file may be renamed under it by another process, and be damaged, once each."""

# So a place shows itself where no -wal or -shm can be made: a folder is read-only, a disk is full.
_UNWRITABLE: Final = frozenset(
    {
        sqlite3.SQLITE_CANTOPEN,
        sqlite3.SQLITE_IOERR_SHMSIZE,
        sqlite3.SQLITE_READONLY_DIRECTORY,
    }
)

_CLOSES_TO_RENAME: Final = sys.platform == "win32"
"""Whether no open file can be renamed. What stands in its -wal then goes into the file on closing."""
_VFS_WITHOUT_LOCKS: Final = "win32-none" if sys.platform == "win32" else "unix-none"

_DAMAGE: Final = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB})

_log = logging.getLogger("paramclient.cache")

_IN_USE: Final[Counter[tuple[int, int]]] = Counter()
"""How often each file, by device and number, is open in this process: they are known to be caches."""
_IN_USE_LOCK: Final = threading.Lock()

T = TypeVar("T")
Work: TypeAlias = Callable[[sqlite3.Connection], T]


class _Newer(Damaged):
    """The file was written by a later version."""

    kind = "newer"


class _Moved(Exception):
    """The file that was looked at, or written to, no longer stands under the path."""


class _Empty(Exception):
    """The file holds no tables: whoever began it found the disk full."""


class Database:
    """One SQLite file, opened at the first operation. Safe to use from several threads.

    A file that is damaged, or newer than this version, is renamed to say why and when (with its `-wal` and
    `-shm`), a warning is logged and remembered, and a fresh one takes its place. Nothing is ever deleted. A
    file that others can write to is made its owner's alone, with a warning, or is an error.

    Args:
        path: the file, absolute, with links followed.
        link: the link by which the file was named, or None: then it has to belong to the user of this
            process.

    Attributes:
        path: the same.
        notes: the warnings so far.
        replacements: how often a fresh file was made, or another one than before was found in its place.
    """

    def __init__(self, path: Path, *, link: Path | None = None) -> None:
        self.path = path
        self._link = link
        self.notes: list[str] = []
        self.replacements = 0
        self._lock = threading.Lock()
        self._closed = False
        self._connection: sqlite3.Connection | None = None
        self._close_connection: Callable[[], object] = _nothing
        self._end_use: Callable[[], object] = _nothing
        self._file: tuple[int, int] | None = None
        self._for_once = False
        self._without_locks = False
        self._is_ours = False  # what is open has our application id

    def read(self, work: Work[T]) -> T:
        """Do work that only reads, in one transaction.

        Creates nothing: without a file, the work finds an empty database. Works on a file, or in a folder,
        that cannot be written to.

        Raises:
            CacheError: the file cannot be read, or another process holds it for too long.
        """
        return self._run(work, writing=False)

    def write(self, work: Work[T], *, durable: bool = False) -> T:
        """Do work in one transaction that holds the file's only write lock; all of it happens, or nothing.

        Creates the file (mode 0600) and its folder (0700). The work is done again, from the start, where the
        file had to be set aside.

        Args:
            work: what is done.
            durable: return when this, and all that was written before, is on the disk, past a loss of power.

        Raises:
            CacheError: the file cannot be written: read-only, disk full, held for too long by another
                process.
        """
        return self._run(work, writing=True, durable=durable)

    def close(self) -> None:
        """Close the file; every later operation raises CacheError. Closing again does nothing."""
        with self._lock:
            self._closed = True
            self._drop()

    def _run(self, work: Work[T], *, writing: bool, durable: bool = False) -> T:
        with self._lock:
            if self._closed:
                raise CacheError(f"the cache {self.path} is closed")
            for _ in range(_TRIES):
                try:
                    if not writing and self._is_absent():
                        with _fresh(MIGRATIONS) as nothing:
                            return work(nothing)
                    return self._transact(work, writing=writing, durable=durable)
                except _Empty:
                    self._drop()
                    with _fresh(MIGRATIONS) as nothing:
                        return work(nothing)
                except _Moved:
                    self.replacements += 1
                    self._drop()
                except Damaged as damage:
                    self._set_aside(damage)
                except OSError as error:
                    self._drop()
                    raise CacheError(f"the cache {self.path} cannot be used: {error}") from error
                except BaseException:
                    self._drop()
                    raise
            raise CacheError(f"the cache {self.path} is damaged or replaced again and again")

    def _transact(self, work: Work[T], *, writing: bool, durable: bool) -> T:
        """One try. Where it fails the connection is left as it is; to close it takes the transaction back."""
        try:
            connection = self._connected(writing=writing)
            if durable:
                connection.execute("PRAGMA synchronous = FULL")
            connection.execute("BEGIN IMMEDIATE" if writing else "BEGIN")
            result = work(connection)
            if durable:  # the same version once more: what writes nothing synchronises nothing
                connection.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")
            connection.execute("COMMIT")
            if durable:
                connection.execute("PRAGMA synchronous = NORMAL")
        except (sqlite3.ProgrammingError, sqlite3.InterfaceError):
            raise  # the program's mistake, not the file's
        except sqlite3.Error as error:
            raise self._judged(error) from error
        except UnicodeDecodeError as error:
            raise Damaged(str(error)) from error
        if writing and self._which() != self._file:
            raise _Moved
        if self._for_once:
            self._drop()
        return result

    def _connected(self, *, writing: bool) -> sqlite3.Connection:
        if self._connection is not None:
            if self._which() == self._file:
                return self._connection
            self.replacements += 1
            self._drop()
        self._check_link()
        if writing:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with locked(self.path.parent):
            self._file = self._which()
            if self._is_absent():
                if not writing:
                    raise _Moved
                self._check_alone()
                os.close(os.open(self.path, os.O_CREAT | os.O_WRONLY, 0o600))
                self.replacements += 1
                self._file = self._which()
            self._check_file()
            may_write = self._may_write()
            if writing and not may_write:
                raise PermissionError("it is read-only")
            if may_write or self._companion("-shm").exists():
                try:
                    connection = self._open_with_locks(writing=writing)
                    self._for_once = not may_write
                    return connection
                except sqlite3.OperationalError as error:
                    if writing or _code(error) not in _UNWRITABLE:
                        raise
                self._drop()
            self._for_once = self._without_locks = True
            return self._open_without_locks()

    def _open_with_locks(self, *, writing: bool) -> sqlite3.Connection:
        connection = self._keep(self._connect("mode=rw"))
        version = self._inspect(connection)
        if not (version or writing):
            raise _Empty
        self._make_private()
        if not version:  # before there is a log: so the file itself says at any moment whose it is
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute("PRAGMA fullfsync = ON")  # of macOS, whose fsync leaves data in the drive's cache
        connection.execute("PRAGMA foreign_keys = ON")
        if version < len(MIGRATIONS) or not self._is_ours:
            connection.execute("BEGIN IMMEDIATE")
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            _migrate(connection, MIGRATIONS[version:])
            connection.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")
            connection.execute("COMMIT")
            self._is_ours = True
        return connection

    def _open_without_locks(self) -> sqlite3.Connection:
        """Open a file beside which no -wal and -shm can, or should, be made.

        None is in use, so nobody else is writing. Made for a read-only file, they would be read-only too and
        stay behind.
        """
        connection = self._keep(self._connect_without_locks())
        version = self._inspect(connection)
        if not version:
            raise _Empty
        self._make_private()
        if version < len(MIGRATIONS):
            raise CacheError(
                f"the cache {self.path} is of an older version and cannot be upgraded where it is"
            )
        return connection

    def _connect_without_locks(self) -> sqlite3.Connection:
        """Connect so that nothing is written, not beside the file either."""
        if _size(self._companion("-wal")):
            # A killed process left transactions in it. Without locks, SQLite reads it with no -shm.
            connection = self._connect(f"mode=ro&vfs={_VFS_WITHOUT_LOCKS}")
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")
            return connection
        return self._connect("mode=ro&immutable=1")

    def _connect(self, how: str) -> sqlite3.Connection:
        return sqlite3.connect(
            f"{self.path.as_uri()}?{how}",
            uri=True,
            timeout=BUSY_TIMEOUT,
            isolation_level=None,
            check_same_thread=False,
        )

    def _keep(self, connection: sqlite3.Connection) -> sqlite3.Connection:
        self._connection = connection
        self._close_connection = weakref.finalize(self, connection.close)
        return connection

    def _inspect(self, connection: sqlite3.Connection) -> int:
        """The schema version of the file, 0 for one that is still empty; `Damaged` where it is that.

        The integrity check takes a few milliseconds for each megabyte. Without it a flipped bit can make
        SQLite miss a row that is there, and nothing would tell.
        """
        version = self._version_of(connection)
        if version:
            [(verdict,)] = connection.execute("PRAGMA integrity_check(1)")
            if verdict != "ok":
                raise Damaged(verdict)
        return version

    def _version_of(self, connection: sqlite3.Connection) -> int:
        """The same by the tables alone. A file without an application id counts as ours by these."""
        [(application,)] = connection.execute("PRAGMA application_id")
        self._is_ours = application == APPLICATION_ID
        [(version,)] = connection.execute("PRAGMA user_version")
        try:
            tables = _schema_of(connection)
        except sqlite3.OperationalError as error:
            if _code(error) != sqlite3.SQLITE_ERROR:
                raise
            raise Damaged(str(error)) from error  # the statement cannot be wrong: the header is
        if application in (0, APPLICATION_ID) and not (version or tables):
            return 0
        looks_like_ours = 1 <= version <= len(MIGRATIONS) and _schema_after(MIGRATIONS[:version]) <= tables
        if not (self._is_ours or (application == 0 and looks_like_ours)):
            raise self._is_of_another_program(application)
        if version > len(MIGRATIONS):
            raise _Newer(f"its schema has version {version}, this program knows {len(MIGRATIONS)}")
        if not looks_like_ours:
            raise Damaged(f"its tables are not those of version {version}")
        return int(version)

    def _judged(self, error: sqlite3.Error) -> Exception:
        """What an error of SQLite means: damage, or a trouble of the surroundings or of ours."""
        code = _code(error)
        if code is None or code & 0xFF in _DAMAGE:
            return Damaged(str(error))
        if code == sqlite3.SQLITE_READONLY and self._may_write():
            return Damaged("its header forbids writing")
        return CacheError(f"the cache {self.path} cannot be used: {error}")

    def _check_file(self) -> None:
        """See that the file is a cache, or empty, and note that it is in use.

        It is looked at without SQLite's locks, where nobody in this process has any to lose.

        Raises:
            CacheError: it is something else.
        """
        assert self._file is not None, "it exists"
        with _IN_USE_LOCK:
            if not _IN_USE[self._file]:
                self._look()
            _IN_USE[self._file] += 1
        self._end_use = weakref.finalize(self, _end_use, self._file)

    def _look(self) -> None:
        with self.path.open("rb") as file:
            begins = file.read(_ID_AT.stop)
        application = int.from_bytes(begins[_ID_AT], "big")
        if not begins or (begins.startswith(_MAGIC) and application == APPLICATION_ID):
            return
        if not begins.startswith(_MAGIC) or len(begins) < _ID_AT.stop:
            raise self._is_no_cache("file is not a database")
        if application:
            raise self._is_of_another_program(application)
        # one of an early version has no id: its tables tell, also where they stand in its log alone
        with closing(self._connect_without_locks()) as connection:
            try:
                self._version_of(connection)
            except (sqlite3.DatabaseError, Damaged) as error:
                raise self._is_no_cache(error) from error

    def _check_alone(self) -> None:
        """See that where there is no file, or an empty one, nothing of another program stands beside it.

        SQLite would delete it. A cache whose program was killed as it made it has a journal.

        Raises:
            Damaged: it is the log of a cache.
            CacheError: it is something else.
        """
        if _size(self._companion("-wal")):
            self._check_log()
            raise Damaged("only its write-ahead log is left")
        if self._companion("-shm").exists():
            raise self._is_no_cache("there is only an index of a write-ahead log")
        if _size(journal := self._companion("-journal")):
            with journal.open("rb") as file:
                begins = file.read(len(_JOURNAL_MAGIC))
            if begins.strip(b"\0") and begins != _JOURNAL_MAGIC:
                raise self._is_no_cache("there is only a rollback journal")

    def _check_log(self) -> None:
        """See by the first page, if it has that, that a log whose file is gone or empty is of a cache.

        Raises:
            CacheError: nothing shows that.
        """
        with self._companion("-wal").open("rb") as file:
            begins = file.read(_LOG_HEADER)
            size = int.from_bytes(begins[8:12], "big")
            while begins.startswith(_LOG_MAGICS) and len(frame := file.read(_FRAME_HEADER + size)) > size:
                page = frame[_FRAME_HEADER:]
                if page.startswith(_MAGIC) and page[_ID_AT] == APPLICATION_ID.to_bytes(4, "big"):
                    return
        raise self._is_no_cache("there is only a write-ahead log")

    def _is_no_cache(self, why: object) -> CacheError:
        text = " ".join(str(why).split())
        return CacheError(
            f"{self.path} is no cache of paramclient ({text:.200}), and was left as it is; name another file"
        )

    def _is_of_another_program(self, application: int) -> CacheError:
        return CacheError(
            f"{self.path} is another program's database (its application id is {application:#x}), and was"
            " left as it is; name another file"
        )

    def _check_link(self) -> None:
        """See that a link leads to a file of this user, or is this user's own where there is no file yet.

        Raises:
            CacheError: it is another user's.
        """
        if self._link is None:
            return
        status = _status(self.path) or self._link.lstat()
        if not is_own(status):
            raise CacheError(
                f"{self._link} leads to a file of another user, {self.path}, and is not followed"
            )

    def _make_private(self) -> None:
        """Make a file that others can write to its owner's alone, with a warning.

        Raises:
            CacheError: that is not possible.
        """
        for file in filter(Path.exists, map(self._companion, ("", "-wal", "-shm"))):
            try:
                mode = make_private(file)
            except FileNotFoundError:
                continue  # another process has closed the database just now
            except OSError as error:
                mode = mode_of(file.stat())
                if mode & OTHERS_WRITE and error.errno != errno.EROFS:
                    raise CacheError(
                        f"others can write to the cache {file} (mode {mode:o}), and that cannot be ended: "
                        f"{error.strerror}"
                    ) from error
                continue
            if mode & OTHERS_WRITE and file == self.path:
                _log.warning(
                    "others than its owner could write to the cache %s (mode %o); it is mode %o now",
                    *(file, mode, mode & ~OF_OTHERS),
                )

    def _set_aside(self, damage: Damaged) -> None:
        what = f"the cache {self.path} is {damage.kind} ({' '.join(str(damage).split()):.200})"
        # The file is renamed before it is closed: SQLite then leaves its -wal as it is.
        if _CLOSES_TO_RENAME:
            self._close_connection()
        try:
            if self._without_locks:
                raise PermissionError("nothing can be written there")
            with locked(self.path.parent):
                if self._which() == self._file:
                    kept = self._free_path(damage.kind)
                    for suffix in ("-journal", "-wal", "-shm", ""):
                        if self._companion(suffix).exists():
                            self._companion(suffix).rename(f"{kept}{suffix}")
                    self.notes.append(f"{what}; it is kept as {kept.name}")
                    _log.warning("%s", self.notes[-1])
        except OSError as error:
            raise CacheError(f"{what} and cannot be set aside: {error}") from error
        finally:
            self._drop()

    def _free_path(self, kind: str) -> Path:
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        paths = (self._companion(f".{kind}-{stamp}-{number}") for number in count(1))
        return next(path for path in paths if not path.exists())

    def _companion(self, suffix: str) -> Path:
        return self.path.with_name(self.path.name + suffix)

    def _is_absent(self) -> bool:
        return not _size(self.path)

    def _which(self) -> tuple[int, int] | None:
        """Which file stands under the path now: a file that took another's place has another number."""
        status = _status(self.path)
        return status and (status.st_dev, status.st_ino)

    def _may_write(self) -> bool:
        files = filter(Path.exists, map(self._companion, ("", "-wal", "-shm")))
        return all(
            os.access(file, os.W_OK, effective_ids=os.access in os.supports_effective_ids) for file in files
        )

    def _drop(self) -> None:
        self._close_connection()
        self._end_use()
        self._connection = None
        self._close_connection = self._end_use = _nothing
        self._for_once = self._without_locks = self._is_ours = False


def _end_use(file: tuple[int, int]) -> None:
    with _IN_USE_LOCK:
        _IN_USE[file] -= 1
        if not _IN_USE[file]:
            del _IN_USE[file]


def _nothing() -> None:
    """What there is to close without a connection."""


def _status(path: Path) -> os.stat_result | None:
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    if not stat.S_ISREG(status.st_mode):
        raise CacheError(f"{path} cannot be a cache: it is not a regular file")
    return status


def _size(path: Path) -> int:
    status = _status(path)
    return status.st_size if status else 0


def _code(error: sqlite3.Error) -> int | None:
    """SQLite's extended result code; None where its module found text that is not UTF-8."""
    code: int | None = getattr(error, "sqlite_errorcode", None)
    return code


def _migrate(connection: sqlite3.Connection, steps: Sequence[Step]) -> None:
    for change in chain.from_iterable(steps):
        if isinstance(change, str):
            connection.execute(change)
        else:
            change(connection)


def _schema_of(connection: sqlite3.Connection) -> frozenset[tuple[str, ...]]:
    """Every table and index with the statement that made it, without those that SQLite makes for itself."""
    rows = connection.execute(
        "SELECT type, name, tbl_name, sql FROM sqlite_master"
        " WHERE sql IS NOT NULL AND name NOT GLOB 'sqlite_*'"
    )
    return frozenset(rows.fetchall())


@contextmanager
def _fresh(steps: tuple[Step, ...]) -> Iterator[sqlite3.Connection]:
    """An empty database in memory."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        _migrate(connection, steps)
        yield connection


@cache
def _schema_after(steps: tuple[Step, ...]) -> frozenset[tuple[str, ...]]:
    with _fresh(steps) as connection:
        return _schema_of(connection)
