"""Database: a SQLite file that several processes share. A damaged file is renamed and replaced.

SQLite runs in WAL mode with synchronous=NORMAL. Committed transactions survive a killed process at any time;
a power loss may lose the last transactions, but does not damage the file. A durable transaction is committed
with synchronous=FULL: the log is synced to the disk before the call returns, including all earlier commits
(SQLite, "PRAGMA synchronous").

The structure of the file is checked when it is opened; each table has its own checksum, checked on every
read. Only an empty file, or a database with the application id of paramclient, is ever changed or renamed;
any other file under the path is an error. This is checked before SQLite opens the file, because SQLite would
use, truncate or delete any log beside it. While a connection is open, another process may find the file
damaged and rename it, or a user may delete it: every operation checks that its file is still the one under
the path. SQLite checks this too before it writes to the `-wal` of a new file. Opening, creating, upgrading
and renaming run under a lock on the folder (`flock`), so that two processes never do this at the same time.
While any cache of this process has the file open, only SQLite opens it: closing another descriptor of it
would release SQLite's locks (POSIX, fcntl).
"""

from __future__ import annotations

import errno
import logging
import math
import os
import sqlite3
import stat
import sys
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import cache
from itertools import chain, count
from pathlib import Path
from typing import Final, TypeAlias, TypeVar

from paramclient.cache.cells import Damaged
from paramclient.cache.file_ownership import OF_OTHERS, OTHERS_WRITE, is_own, make_private, mode_of
from paramclient.cache.lock import LOCK_WAIT_MAX, locked, preload
from paramclient.cache.sqlite_schema import MIGRATIONS, Step
from paramclient.errors import CacheError

__all__ = ["APPLICATION_ID", "Database"]

APPLICATION_ID: Final = 0x5041524D
"""Application id of paramclient in the header of the file: `PARM`."""

_MAGIC: Final = b"SQLite format 3\0"
"""First bytes of a SQLite database (SQLite, "Database File Format")."""
_ID_AT: Final = slice(68, 72)
"""Position of the application id in a SQLite database (SQLite, "Database File Format")."""
_LOG_MAGICS: Final = (b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")
"""First bytes of a write-ahead log of SQLite, in either byte order of its checksums."""
# Bytes of a write-ahead log before its first frame, and of each frame before its page.
_LOG_HEADER, _FRAME_HEADER = 32, 24
_JOURNAL_MAGIC: Final = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
"""First bytes of a valid rollback journal of SQLite."""

LOCK_WAIT_PART: Final = 0.25
"""Timeout in seconds of one of the attempts to begin a write, which together take at most `LOCK_WAIT_MAX`.
SQLite cannot be interrupted while it waits for a lock; `Database.limit_lock_waits` has effect after each."""

_ATTEMPTS_MAX: Final = 3
"""Maximum number of attempts of one operation: another process may rename the file, and the file may be
damaged, once each."""

_LINKS_MAX: Final = 40
"""Maximum number of symbolic links that lead from one to the next, as in Linux (path_resolution(7))."""

# Error codes if no -wal or -shm can be created: the folder is read-only, or the disk is full.
_UNWRITABLE: Final = frozenset(
    {
        sqlite3.SQLITE_CANTOPEN,
        sqlite3.SQLITE_IOERR_SHMSIZE,
        sqlite3.SQLITE_READONLY_DIRECTORY,
    }
)

_CLOSES_TO_RENAME: Final = sys.platform == "win32"
"""Whether an open file cannot be renamed, as on Windows. Closing it then moves its -wal into the file."""
_VFS_WITHOUT_LOCKS: Final = "win32-none" if sys.platform == "win32" else "unix-none"
"""Name of SQLite's file system layer without locks."""

# Error codes of a damaged file.
_DAMAGE: Final = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB})

_log = logging.getLogger("paramclient.cache")

_IN_USE: Final[Counter[tuple[int, int]]] = Counter()
"""Number of open connections in this process by file (device, inode). These files are known to be caches."""
_IN_USE_LOCK: Final = threading.Lock()
"""Lock for `_IN_USE`."""

T = TypeVar("T")
Work: TypeAlias = Callable[[sqlite3.Connection], T]


class _Newer(Damaged):
    """The file was written by a later version of paramclient."""

    kind = "newer"


class _FileReplaced(Exception):
    """The checked or written file is no longer the one under the path."""


class _Empty(Exception):
    """The file has no tables: the disk was full when it was created."""


class Database:
    """One SQLite file, opened by the first operation. Thread-safe.

    A file that is damaged, or newer than this version, is renamed together with its `-wal` and `-shm`; the
    new name has the reason and the time. A warning is logged and added to `notes`, and a new file is created.
    No file is ever deleted. A file that other users can write to is restricted to its owner, with a warning;
    if that fails, it is an error.

    Args:
        path: the file, absolute, with resolved symbolic links.
        link: the symbolic link that was given as path, or None. The target of a link has to belong to the
            user of this process; while it does not exist, all links to it.

    Attributes:
        path: the file.
        notes: the warnings so far.
        replacements: number of times that a new file was created, or found in place of the previous one.
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
        self._empty: sqlite3.Connection | None = None
        self._close_template: Callable[[], object] = _nothing
        self._end_use: Callable[[], object] = _nothing
        self._file: tuple[int, int] | None = None
        self._for_once = False
        self._without_locks = False
        self._lock_waits_end = math.inf  # by time.monotonic
        self._is_ours = False  # whether the open file has the application id of paramclient

    def read(self, work: Work[T]) -> T:
        """Run a function that only reads, in one transaction, and return its result.

        It creates no file: without one, the function reads an empty database. The file and the folder may be
        read-only.

        Raises:
            CacheError: the file cannot be read, or another process locks it for more than `LOCK_WAIT_MAX`.
        """
        return self._run(work, writing=False)

    def write(self, work: Work[T], *, durable: bool = False) -> T:
        """Run a function in one transaction with the file's write lock: either all or nothing is written.

        It creates the file (mode 0600) and its folder (0700). If the file has to be replaced, the function
        runs again from the start.

        Args:
            work: the function.
            durable: return only when this and all earlier transactions are synced to the disk, safe from
                power loss.

        Raises:
            CacheError: the file cannot be written: it is read-only, the disk is full, or another process
                locks it for more than `LOCK_WAIT_MAX`.
        """
        return self._run(work, writing=True, durable=durable)

    def limit_lock_waits(self, seconds: float) -> None:
        """Wait for locks of other processes for at most these seconds from now in all, in this and all later
        writes. Returns immediately, also while another thread waits in a write. A write after that time is
        still attempted once.
        """
        self._lock_waits_end = time.monotonic() + seconds

    def close(self) -> None:
        """Close the file; every later operation raises CacheError. Closing again does nothing."""
        with self._lock:
            self._closed = True
            self._drop()
            self._close_template()

    def _run(self, work: Work[T], *, writing: bool, durable: bool = False) -> T:
        with self._lock:
            if self._closed:
                raise CacheError(f"the cache {self.path} is closed")
            for _ in range(_ATTEMPTS_MAX):
                try:
                    if not writing and self._is_absent():
                        return work(self._template())
                    return self._transact(work, writing=writing, durable=durable)
                except _Empty:
                    self._drop()
                    return work(self._template())
                except _FileReplaced:
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
            raise CacheError(
                f"the cache {self.path} was damaged or replaced {_ATTEMPTS_MAX} times during one operation"
            )

    def _transact(self, work: Work[T], *, writing: bool, durable: bool) -> T:
        """Run one attempt. After an error, closing the connection rolls the transaction back."""
        try:
            connection = self._connected(writing=writing)
            if durable:
                connection.execute("PRAGMA synchronous = FULL")
            if writing:
                self._begin_write(connection)
            else:
                connection.execute("BEGIN")
            result = work(connection)
            if durable:  # a transaction without a write would not sync; this writes the unchanged version
                connection.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")
            connection.execute("COMMIT")
            if durable:
                connection.execute("PRAGMA synchronous = NORMAL")
        except (sqlite3.ProgrammingError, sqlite3.InterfaceError):
            raise  # an error of the program, not of the file
        except sqlite3.Error as error:
            raise self._judged(error) from error
        except UnicodeDecodeError as error:
            raise Damaged(str(error)) from error
        if writing and self._which() != self._file:
            raise _FileReplaced
        if self._for_once:
            self._drop()
        return result

    def _begin_write(self, connection: sqlite3.Connection) -> None:
        """Begin a transaction with the file's write lock.

        Raises:
            sqlite3.OperationalError: another process has locked it for `LOCK_WAIT_MAX`, or until the time of
                `limit_lock_waits`.
        """
        begun = time.monotonic()
        try:
            while True:
                left = min(begun + LOCK_WAIT_MAX, self._lock_waits_end) - time.monotonic()
                wait = max(0.0, min(left, LOCK_WAIT_PART))
                connection.execute(f"PRAGMA busy_timeout = {round(1000 * wait)}")
                try:
                    connection.execute("BEGIN IMMEDIATE")
                    return
                except sqlite3.OperationalError as error:
                    if left <= LOCK_WAIT_PART or (_code(error) or 0) & 0xFF != sqlite3.SQLITE_BUSY:
                        raise
        finally:
            connection.execute(f"PRAGMA busy_timeout = {round(1000 * LOCK_WAIT_MAX)}")

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
                    raise _FileReplaced
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
        if not version:  # before the first log exists, so that the file itself always has the id
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute("PRAGMA fullfsync = ON")  # for macOS, whose fsync leaves data in the drive's cache
        connection.execute("PRAGMA foreign_keys = ON")
        if not version:
            self._create_tables(connection)
        elif version < len(MIGRATIONS) or not self._is_ours:
            connection.execute("BEGIN IMMEDIATE")
            _migrate(connection, version)
            connection.execute("COMMIT")
            self._is_ours = True
        return connection

    def _create_tables(self, connection: sqlite3.Connection) -> None:
        """Write the template to an empty file.

        One call writes the template, in place of about 40 statements: each SQL statement releases the
        interpreter lock, and beside a busy event loop, getting it again takes 5 ms (`sys.getswitchinterval`).

        Raises:
            CacheError: another process locks the file for more than `LOCK_WAIT_MAX`.
        """

        def check_locks(status: int, _remaining: int, _total: int) -> None:
            is_locked = status in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
            if is_locked and time.monotonic() >= deadline:  # `backup` waits without a limit
                raise CacheError(f"the cache {self.path} cannot be used: database is locked")

        deadline = min(time.monotonic() + LOCK_WAIT_MAX, self._lock_waits_end)
        self._template().backup(connection, progress=check_locks)
        self._is_ours = True

    def _template(self) -> sqlite3.Connection:
        """Return an empty cache in memory, which is also what an absent file is read as."""
        if self._empty is None:
            preload()
            template = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
            self._close_template = weakref.finalize(self, template.close)
            _migrate(template, 0)
            template.execute("PRAGMA query_only = ON")
            self._empty = template
        return self._empty

    def _open_without_locks(self) -> sqlite3.Connection:
        """Open a file without creating -wal and -shm.

        These do not exist, so no other process is writing. If they were created for a read-only file, they
        would be read-only and remain after closing.
        """
        connection = self._keep(self._connect_without_locks())
        version = self._inspect(connection)
        if not version:
            raise _Empty
        self._make_private()
        if version < len(MIGRATIONS):
            raise CacheError(
                f"the cache {self.path} is of an older version and cannot be upgraded, as it is read-only"
            )
        return connection

    def _connect_without_locks(self) -> sqlite3.Connection:
        """Connect without any write to the file or its folder."""
        if _size(self._companion("-wal")):
            # It has transactions of a killed process. Without locks, SQLite reads it without a -shm.
            connection = self._connect(f"mode=ro&vfs={_VFS_WITHOUT_LOCKS}")
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")
            return connection
        return self._connect("mode=ro&immutable=1")

    def _connect(self, how: str) -> sqlite3.Connection:
        return sqlite3.connect(
            f"{self.path.as_uri()}?{how}",
            uri=True,
            timeout=LOCK_WAIT_MAX,
            isolation_level=None,
            check_same_thread=False,
        )

    def _keep(self, connection: sqlite3.Connection) -> sqlite3.Connection:
        self._connection = connection
        self._close_connection = weakref.finalize(self, connection.close)
        return connection

    def _inspect(self, connection: sqlite3.Connection) -> int:
        """Return the schema version of the file; 0 for an empty file.

        The integrity check takes a few milliseconds for each megabyte. Without it, a flipped bit may make
        SQLite skip an existing row without an error.

        Raises:
            Damaged: the file is damaged, or of a later version.
            CacheError: it is a database of another program.
        """
        version = self._version_of(connection)
        if version:
            [(verdict,)] = connection.execute("PRAGMA integrity_check(1)")
            if verdict != "ok":
                raise Damaged(verdict)
        return version

    def _version_of(self, connection: sqlite3.Connection) -> int:
        """Return the schema version, without the integrity check; see `_inspect` for errors."""
        [(application,)] = connection.execute("PRAGMA application_id")
        self._is_ours = application == APPLICATION_ID
        [(version,)] = connection.execute("PRAGMA user_version")
        try:
            tables = _schema_of(connection)
        except sqlite3.OperationalError as error:
            if _code(error) != sqlite3.SQLITE_ERROR:
                raise
            raise Damaged(str(error)) from error  # the statement is valid, so the header is damaged
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
        """Return `Damaged` for an SQLite error of a damaged file, CacheError for another cause."""
        code = _code(error)
        if code is None or code & 0xFF in _DAMAGE:
            return Damaged(str(error))
        if code == sqlite3.SQLITE_READONLY and self._may_write():
            return Damaged("its header forbids writing")
        return CacheError(f"the cache {self.path} cannot be used: {error}")

    def _check_file(self) -> None:
        """Check that the file is a cache or empty, and count it as in use.

        Only the first connection of this process checks it: the check would release SQLite's locks of others.

        Raises:
            CacheError: it is another file.
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
        # a file of an early version has no id: its tables identify it, which may only be in its log
        with closing(self._connect_without_locks()) as connection:
            try:
                self._version_of(connection)
            except (sqlite3.DatabaseError, Damaged) as error:
                raise self._is_no_cache(error) from error

    def _check_alone(self) -> None:
        """Check that beside an absent or empty file there is no log of another program.

        SQLite would delete it.
        A cache whose process was killed during its creation has a journal.

        Raises:
            Damaged: there is a log of a cache.
            CacheError: there is another log.
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
        """Check by the first page in a log without its file that the log belongs to a cache.

        Raises:
            CacheError: the log has no first page with the application id of paramclient.
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
            f"{self.path} is not a cache of paramclient ({text:.200}) and was not changed; name another file"
        )

    def _is_of_another_program(self, application: int) -> CacheError:
        return CacheError(
            f"{self.path} is a database of another program (its application id is {application:#x}) and was"
            " not changed; name another file"
        )

    def _check_link(self) -> None:
        """Check that the target of a symbolic link belongs to this user; without a target, all links to it.

        Otherwise another user could choose where a file of this user is created.

        Raises:
            CacheError: one of them belongs to another user.
        """
        if self._link is None:
            return
        status = _status(self.path)
        if not is_own(status or self._link.lstat()):
            raise CacheError(
                f"the symbolic link {self._link} leads to a file of another user, {self.path}; name that file"
            )
        if status is None and not all(is_own(each.lstat()) for each in _links(self._link)):
            raise CacheError(
                f"the symbolic link {self._link} leads over a link of another user to a file that does not"
                f" exist, {self.path}; name that file"
            )

    def _make_private(self) -> None:
        """Restrict a file that other users can write to its owner, with a warning.

        Raises:
            CacheError: its mode cannot be changed.
        """
        for file in filter(Path.exists, map(self._companion, ("", "-wal", "-shm"))):
            try:
                mode = make_private(file)
            except FileNotFoundError:
                continue  # another process has just closed the database
            except OSError as error:
                mode = mode_of(file.stat())
                if mode & OTHERS_WRITE and error.errno != errno.EROFS:
                    raise CacheError(
                        f"other users can write to the cache {file} (mode {mode:o}), and its mode cannot be"
                        f" changed: {error.strerror}"
                    ) from error
                continue
            if mode & OTHERS_WRITE and file == self.path:
                _log.warning(
                    "other users than its owner could write to the cache %s (mode %o); its mode is now %o",
                    *(file, mode, mode & ~OF_OTHERS),
                )

    def _set_aside(self, damage: Damaged) -> None:
        what = f"the cache {self.path} is {damage.kind} ({' '.join(str(damage).split()):.200})"
        # The file is renamed before it is closed, so that SQLite does not change its -wal.
        if _CLOSES_TO_RENAME:
            self._close_connection()
        try:
            if self._without_locks:
                raise PermissionError("the file or its folder is read-only")
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
        """Return device and inode of the file under the path now; a replaced file has another inode."""
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
    """Do nothing: there is no connection to close."""


def _status(path: Path) -> os.stat_result | None:
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    if not stat.S_ISREG(status.st_mode):
        raise CacheError(f"{path} cannot be a cache: it is not a regular file")
    return status


def _links(link: Path) -> Iterator[Path]:
    """Yield a symbolic link and the links that it leads to, one by one."""
    for _ in range(_LINKS_MAX):
        if not link.is_symlink():
            return
        yield link
        link = link.parent / link.readlink()


def _size(path: Path) -> int:
    status = _status(path)
    return status.st_size if status else 0


def _code(error: sqlite3.Error) -> int | None:
    """Return SQLite's extended result code; None for text that is not UTF-8."""
    code: int | None = getattr(error, "sqlite_errorcode", None)
    return code


def _migrate(connection: sqlite3.Connection, version: int) -> None:
    """Convert a cache of a schema version, 0 for an empty database, to the current version."""
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    _execute(connection, MIGRATIONS[version:])
    connection.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")


def _execute(connection: sqlite3.Connection, steps: Sequence[Step]) -> None:
    for change in chain.from_iterable(steps):
        if isinstance(change, str):
            connection.execute(change)
        else:
            change(connection)


def _schema_of(connection: sqlite3.Connection) -> frozenset[tuple[str, ...]]:
    """Return every table and index with its CREATE statement, without SQLite's internal ones."""
    rows = connection.execute(
        "SELECT type, name, tbl_name, sql FROM sqlite_master"
        " WHERE sql IS NOT NULL AND name NOT GLOB 'sqlite_*'"
    )
    return frozenset(rows.fetchall())


@cache
def _schema_after(steps: tuple[Step, ...]) -> frozenset[tuple[str, ...]]:
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        _execute(connection, steps)
        return _schema_of(connection)
