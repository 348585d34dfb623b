"""SharedStore: a cache in a database shared by stations, with a local copy for the time without a connection.

While the database is connected, reads and writes use it, and the local copy follows. Without a connection,
reads and writes use the local copy, and writes are queued in its outbox. After the reconnection, queued
writes are executed in the database first, in order, each exactly once.

A thread of each cache listens to the database. It receives the writes of other stations, and reconnects.
"""

from __future__ import annotations

import json
import logging
import selectors
import socket
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar
from uuid import uuid4

from paramclient.cache.database_url import DatabaseAddress
from paramclient.cache.operations import Remove, StoreExtSnapshot, StoreOperation, StoreSnapshot
from paramclient.cache.outbox import LocalCopy, QueuedOperation
from paramclient.cache.postgres import PostgresDatabase, Revisions, Unavailable
from paramclient.cache.records import CacheChange, SnapshotSummary
from paramclient.cache.transaction import Transaction
from paramclient.cache.transfer import LOCAL_NUMBERS_MIN, MergeTable, take_whole
from paramclient.errors import CacheError, UsageError

if TYPE_CHECKING:
    import psycopg

__all__ = ["SharedStore"]

RETRY_INTERVAL_MIN: Final = 0.1
"""Seconds before the first attempt to reconnect to the database; doubled after each attempt."""
RETRY_INTERVAL_MAX: Final = 5.0
"""Maximum seconds between two attempts to reconnect."""
DELIVERY_BATCH: Final = 50
"""Number of operations of the outbox in one transaction."""

_log = logging.getLogger("paramclient.cache")
T = TypeVar("T")


class SharedStore:
    """A cache in PostgreSQL with a local copy, see `Store`.

    Args:
        address: the database.
        path: the local copy.

    Attributes:
        path: the local copy.
        place: URL of the database, without password.
    """

    def __init__(self, address: DatabaseAddress, path: Path) -> None:
        self.path = path
        self.place = address.place
        self._connection = _Connection(address, path)
        self._finalizer = weakref.finalize(self, self._connection.close)

    @property
    def notes(self) -> tuple[str, ...]:
        """Repaired problems of the local copy: one text for each file that was renamed."""
        return tuple(self._connection.local.database.notes)

    @property
    def replacements(self) -> int:
        """Always 0: only a file can be replaced."""
        return 0

    @property
    def offline_reason(self) -> str | None:
        """Why the local copy is used at present; None while the database is used."""
        return self._connection.offline_reason

    def read(self, work: Callable[[Transaction], T]) -> T:
        """See `Store.read`."""
        return self._connection.read(work)

    def do(self, operation: StoreOperation[T]) -> T:
        """See `Store.do`. Without a connection, the operation is queued for the database."""
        result: T = self._connection.do(operation)
        return result

    def follow(self, key: str, component: int) -> None:
        """See `Store.follow`."""
        self._connection.follow((key, component))

    def subscribe(self, callback: Callable[[CacheChange], None]) -> Callable[[], None]:
        """See `Store.subscribe`."""
        return self._connection.subscribe(callback)

    def limit_lock_waits(self, seconds: float) -> None:
        """See `Store.limit_lock_waits`. Of the local copy and the database."""
        self._connection.limit_waits(seconds)

    def close(self) -> None:
        """End the thread, and close the database connections and the file."""
        self._finalizer()


class _Connection:
    """Database connection, listener thread and local copy of a store.

    Attributes:
        offline_reason: why the database is not used, or None.
        local: the local copy.
    """

    def __init__(self, address: DatabaseAddress, path: Path) -> None:
        self.offline_reason: str | None = None
        self.local = LocalCopy(path)
        self._address = address
        self._database = PostgresDatabase(address)
        self._writer = uuid4().hex
        self._number = 0
        self._is_connected = False
        self._is_closed = False
        self._has_warned = False
        self._reaching = threading.Lock()  # held while connecting; always acquired before `_writing`
        self._writing = threading.RLock()  # held during writes to database, outbox and copy
        self._state = threading.Lock()  # held briefly for access to the following attributes
        self._listener: psycopg.Connection[tuple[Any, ...]] | None = None
        self._thread: threading.Thread | None = None
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._wake_reader.setblocking(False)
        self._revisions: Revisions = {}
        self._stale_keys: set[tuple[str, int]] = set()
        self._subscribers: list[Callable[[CacheChange], None]] = []

    # calls of the store
    def read(self, work: Callable[[Transaction], T]) -> T:
        for is_second in (False, True):
            if not self._ensure_connected(at_once=is_second):
                break
            try:
                return self._database.read(work)
            except Unavailable as error:
                self._lose(error)
        return self.local.read(work)

    def do(self, operation: StoreOperation[Any]) -> Any:
        self._ensure_connected()
        with self._writing:
            self._number += 1
            number = self._number
            for is_second in (False, True):
                if not self._ensure_connected(at_once=is_second):
                    break
                try:
                    [result], before, after = self._database.write([(operation, self._writer, number)])
                    if is_second and result is None:  # the first attempt may have executed it
                        result = self._database.read(operation.done)
                except Unavailable as error:
                    self._lose(error)
                else:
                    return self._copy_done(operation, result, before, after)
            if isinstance(operation, Remove | MergeTable):
                raise CacheError(
                    f"{self.offline_reason or 'the database is not connected'}; "
                    "repeat the call after the reconnection"
                )
            if isinstance(operation, StoreSnapshot | StoreExtSnapshot):
                shown = self.local.read(operation.resolved)
                own = LOCAL_NUMBERS_MIN + uuid4().int % LOCAL_NUMBERS_MIN
                return self.local.spool(_numbered(shown, own), self._writer, number)
            return self.local.spool(operation, self._writer, number)

    def follow(self, key: tuple[str, int]) -> None:
        with self._state:
            if not self._is_connected:
                return
            self._stale_keys.add(key)
        self._wake_listener()

    def subscribe(self, callback: Callable[[CacheChange], None]) -> Callable[[], None]:
        self._subscribers.append(callback)
        with suppress(CacheError):  # other calls report it; the subscription works after a reconnection
            self._ensure_connected()

        def end() -> None:
            with suppress(ValueError):
                self._subscribers.remove(callback)

        return end

    def limit_waits(self, seconds: float) -> None:
        self.local.database.limit_lock_waits(seconds)
        self._database.limit_waits(seconds)

    def close(self) -> None:
        self._is_closed = True
        self._wake_listener()
        with self._reaching:
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()
        with self._writing:
            self._is_connected = False
            if self._listener is not None:
                self._listener.close()
            self._database.close()
            self.local.close()
        self._wake_reader.close()
        self._wake_writer.close()

    # connection to the database

    def _ensure_connected(self, *, at_once: bool = False) -> bool:
        """Return whether the database is connected. Connect on the first call, or if `at_once` is given.

        Raises:
            CacheError: the cache is closed; or the database was never reached, and there is no local copy.
        """
        if self._is_closed:
            raise CacheError(f"the cache {self._address.place} is closed")
        is_first = self._thread is None
        is_wanted = is_first or (at_once and not self._database.is_given_up)
        if not self._is_connected and is_wanted and self._reaching.acquire(blocking=is_first):
            try:
                if not self._is_connected:
                    self._reach()
                if self._thread is None:
                    self._thread = threading.Thread(
                        target=self._listen, name="paramclient cache listener", daemon=True
                    )
                    self._thread.start()
            finally:
                self._reaching.release()
        if not self._is_connected and not self.local.exists:
            raise CacheError(
                f"{self.offline_reason}; there is no local copy, as it was never reached from this computer"
            )
        return self._is_connected

    def _reach(self) -> None:
        """Connect to the database and execute queued operations. On failure, `offline_reason` has the reason.

        Raises:
            CacheError: the database cannot be used.
        """
        try:
            listener = self._database.open()
            try:
                self._begin_copy()
                with self._writing:  # otherwise new operations could be queued faster than executed
                    self._deliver()
                    revisions = self._database.revisions()
                    self._use_connection(listener, revisions)
            except BaseException:
                listener.close()
                raise
        except Unavailable as error:
            self._lose(error)

    def _use_connection(self, listener: psycopg.Connection[tuple[Any, ...]], revisions: Revisions) -> None:
        kept = self._kept()
        if self.offline_reason is not None:
            _log.warning("the database %s is connected again", self._address.place)
        with self._state:
            before, self._revisions = self._revisions, revisions
            old, self._listener = self._listener, listener
            self._stale_keys |= {key for key, revision in kept.items() if revisions.get(key) != revision}
            self.offline_reason = None
            self._is_connected = True
        if old is not None:
            old.close()
        if before:
            self._notify({key for key in {*before, *revisions} if before.get(key) != revisions.get(key)})
        self._wake_listener()

    def _begin_copy(self) -> None:
        try:
            self.local.begin()
        except CacheError as error:
            self._warn_of_copy(error)

    def _deliver(self) -> None:
        """Execute queued operations in the database, in order, until the queue is empty.

        If the local copy cannot be read, this is done after a later reconnection.
        """
        try:
            while entries := self.local.waiting(DELIVERY_BATCH):
                self._deliver_all(entries)
        except CacheError as error:
            self._warn_of_copy(error)

    def _deliver_all(self, entries: Sequence[QueuedOperation]) -> None:
        try:
            operations = [(each.operation, each.writer, each.number) for each in entries]
            _, _, after = self._database.write(operations)
        except CacheError as error:
            if len(entries) > 1:
                for entry in entries:
                    self._deliver_all([entry])
                return
            _log.warning("the database refuses a write that was queued while it was not connected: %s", error)
            self.local.refuse(entries[0], str(error))
            return
        # the tables are copied again: other stations may have written meanwhile
        self.local.mark_delivered(
            entries, [key for each in entries for key in _touched(each.operation, after)]
        )

    def _lose(self, error: Unavailable) -> None:
        with self._state:
            is_new_failure = self.offline_reason is None
            self.offline_reason = str(error)
            self._is_connected = False
        if is_new_failure:
            copy = self.local
            meanwhile = f"using the local copy {copy.path}" if copy.exists else "reconnecting"
            _log.warning("%s; %s", error, meanwhile)
        self._database.close()
        self._wake_listener()

    # the local copy

    def _copy_done(
        self, operation: StoreOperation[Any], result: Any, before: Revisions, after: Revisions
    ) -> Any:
        """Execute an operation in the local copy too. Tables that were stale there are copied again."""
        touched = set(_touched(operation, before | after))
        stale = touched
        try:
            if not isinstance(operation, MergeTable):
                kept = self.local.revisions()
                number = result.id if isinstance(result, SnapshotSummary) else None
                self.local.do(operation if number is None else _numbered(operation, number))
                stale = {key for key in touched if kept.get(key) != before.get(key)}
                for key in touched - stale:
                    self.local.set_copied_revision(key, after.get(key))
        except (CacheError, UsageError) as error:
            self._warn_of_copy(error)
        with self._state:
            for key in touched:
                if key in after:
                    self._revisions[key] = after[key]
                else:
                    self._revisions.pop(key, None)
            self._stale_keys |= stale
        if stale:
            self._wake_listener()
        return result

    def _mirror(self) -> None:
        """Copy every requested table from the database to the local copy."""
        while self._is_connected and not self._is_closed:
            with self._state:
                if not self._stale_keys:
                    return
                key = self._stale_keys.pop()
            try:
                with self._writing:
                    having = self.local.snapshots(key)
                    take = partial(take_whole, key=key[0], component=key[1], having=having)
                    whole, revision = self._database.read_with_revision(take, key)
                    self.local.mirror(key, whole, revision)
            except Unavailable as error:
                self._lose(error)
            except (CacheError, UsageError) as error:  # a file cannot store every value of a database
                self._warn_of_copy(error)

    def _kept(self) -> Revisions:
        """Return the copied revision of each table; empty if the local copy cannot be read."""
        try:
            return self.local.revisions()
        except CacheError as error:
            self._warn_of_copy(error)
            return {}

    def _warn_of_copy(self, error: CacheError | UsageError) -> None:
        if not self._has_warned:
            _log.warning("the local copy of the cache is not up to date: %s", error)
        self._has_warned = True

    # the thread

    def _listen(self) -> None:
        pause = RETRY_INTERVAL_MIN
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake_reader, selectors.EVENT_READ)
            while not self._is_closed:
                if self._is_connected and self._listener is not None:
                    pause = RETRY_INTERVAL_MIN
                    self._mirror()
                    self._hear(selector, self._listener)
                    continue
                self._wait(selector, pause)
                pause = min(2 * pause, RETRY_INTERVAL_MAX)
                if self._is_closed or self._is_connected or self._database.is_given_up:
                    continue
                if self._reaching.acquire(blocking=False):
                    try:
                        self._reach()
                    except CacheError as error:
                        self.offline_reason = str(error)
                    finally:
                        self._reaching.release()

    def _wait(self, selector: selectors.BaseSelector, pause: float) -> None:
        deadline = time.monotonic() + pause
        while not self._is_closed and not self._is_connected and (left := deadline - time.monotonic()) > 0:
            selector.select(left)
            self._drain_wakeup()

    def _hear(self, selector: selectors.BaseSelector, listener: psycopg.Connection[tuple[Any, ...]]) -> None:
        """Wait for a notification of the database or a wake-up, and process the notifications."""
        try:
            file = listener.fileno()
            selector.register(file, selectors.EVENT_READ)
            try:
                if self._is_connected and not self._stale_keys:
                    selector.select()
            finally:
                selector.unregister(file)
            self._drain_wakeup()
            notifications = [_notification(each.payload) for each in listener.notifies(timeout=0)]
        except Exception as error:  # after any error, the connection is unusable
            if listener is self._listener and self._is_connected and not self._is_closed:
                text = self._address.without_password(" ".join(str(error).split()))
                self._lose(Unavailable(f"the connection to {self._address.place} is lost: {text}"))
            return
        changed = set()
        with self._state:
            for writer, key, component, revision in filter(None, notifications):
                if writer != self._writer:
                    changed.add((key, component))
                    self._revisions[key, component] = revision
        if changed:
            kept = self._kept()
            with self._state:
                self._stale_keys |= changed & kept.keys()
            self._notify(changed)

    def _notify(self, changed: set[tuple[str, int]]) -> None:
        for key, component in sorted(changed):
            for callback in list(self._subscribers):
                try:
                    callback(CacheChange(key, component))
                except Exception:
                    _log.exception("a listener of the cache failed")

    def _wake_listener(self) -> None:
        with suppress(OSError):
            self._wake_writer.send(b"!")

    def _drain_wakeup(self) -> None:
        with suppress(OSError):
            self._wake_reader.recv(4096)


def _touched(operation: StoreOperation[Any], known: Revisions) -> Iterator[tuple[str, int]]:
    for key, component in operation.tables:
        if component is not None:
            yield key, component
        else:
            yield from (each for each in known if each[0] == key)


def _notification(payload: str) -> tuple[Any, ...] | None:
    """Parse a notification; None if it is not of a station, as any user of the database may send one."""
    try:
        writer, key, component, revision = json.loads(payload)
    except (TypeError, ValueError):
        return None
    is_ours = isinstance(writer, str) and isinstance(key, str) and isinstance(component, int)
    return (writer, key, component, revision) if is_ours else None


def _numbered(operation: StoreOperation[Any], number: int) -> StoreOperation[Any]:
    assert isinstance(operation, StoreSnapshot | StoreExtSnapshot)
    return replace(operation, number=number)
