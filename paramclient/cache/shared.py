"""A cache that stations share: in a database while that can be reached, in a local copy while it cannot.

While the database is there, it is what is read and written, and the local copy follows it. When it is lost,
what is written goes into the local copy, and waits in an outbox there. When it is back, that is done in the
database, in order, each thing once, before anything else is.

A thread of each cache listens to the database: it learns what other stations have written, and finds the
database again.
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

from paramclient.cache.database_url import Address
from paramclient.cache.operations import Operation, Remove, SetDown
from paramclient.cache.outbox import Entry, LocalCopy
from paramclient.cache.postgres import Away, PostgresDatabase, Revisions
from paramclient.cache.records import CacheChange, Snapshot
from paramclient.cache.transaction import Session
from paramclient.cache.transfer import OWN_NUMBERS, Join, take_whole
from paramclient.errors import CacheError, UsageError

if TYPE_CHECKING:
    import psycopg

__all__ = ["SharedStore"]

RETRY_FIRST: Final = 0.1
RETRY_LAST: Final = 5.0
"""Seconds until a database that cannot be reached is tried again: the first time, and after many times."""
BATCH: Final = 50
"""Operations of the outbox that are done in one transaction."""

_log = logging.getLogger("paramclient.cache")
T = TypeVar("T")


class SharedStore:
    """A cache in PostgreSQL with a local copy, see `Store`.

    Args:
        address: the database.
        path: the local copy.

    Attributes:
        path: the same.
        place: the database, without a password.
    """

    def __init__(self, address: Address, path: Path) -> None:
        self.path = path
        self.place = address.place
        self._link = _Link(address, path)
        self._finalizer = weakref.finalize(self, self._link.close)

    @property
    def notes(self) -> tuple[str, ...]:
        """What went wrong with the local copy and was mended."""
        return tuple(self._link.local.database.notes)

    @property
    def replacements(self) -> int:
        """None: what a database holds, it holds."""
        return 0

    @property
    def away(self) -> str | None:
        """Why the local copy is what is read and written at present; None while it is the database."""
        return self._link.away

    def read(self, work: Callable[[Session], T]) -> T:
        """Do work that only reads, in one transaction."""
        return self._link.read(work)

    def do(self, operation: Operation[T]) -> T:
        """Write, in one transaction; what the database cannot do now, it will do once it is back."""
        result: T = self._link.do(operation)
        return result

    def follow(self, key: str, component: int) -> None:
        """Have a table in the local copy from now on."""
        self._link.follow((key, component))

    def subscribe(self, told: Callable[[CacheChange], None]) -> Callable[[], None]:
        """Be told, in a thread of the cache, what other stations have written; gives what ends that."""
        return self._link.subscribe(told)

    def close(self) -> None:
        """End the thread, and let go of database and file."""
        self._finalizer()


class _Link:
    """What a store has to do with the database, its thread, and the local copy.

    Attributes:
        away: why the database is not used at present.
        local: the copy.
    """

    def __init__(self, address: Address, path: Path) -> None:
        self.away: str | None = None
        self.local = LocalCopy(path)
        self._address = address
        self._database = PostgresDatabase(address)
        self._writer = uuid4().hex
        self._number = 0
        self._is_here = False
        self._is_closed = False
        self._has_warned = False
        self._reaching = threading.Lock()  # who holds it may take the next, not the other way round
        self._writing = threading.RLock()  # who holds it writes to database, outbox and copy
        self._state = threading.Lock()  # for a moment, around what follows
        self._listener: psycopg.Connection[tuple[Any, ...]] | None = None
        self._thread: threading.Thread | None = None
        self._bell, self._ringer = socket.socketpair()
        self._bell.setblocking(False)
        self._revisions: Revisions = {}
        self._wanted: set[tuple[str, int]] = set()
        self._subscribers: list[Callable[[CacheChange], None]] = []

    # what a store does

    def read(self, work: Callable[[Session], T]) -> T:
        for is_second in (False, True):
            if not self._meet(at_once=is_second):
                break
            try:
                return self._database.read(work)
            except Away as error:
                self._lose(error)
        return self.local.read(work)

    def do(self, operation: Operation[Any]) -> Any:
        self._meet()
        with self._writing:
            self._number += 1
            number = self._number
            for is_second in (False, True):
                if not self._meet(at_once=is_second):
                    break
                try:
                    [result], before, after = self._database.write([(operation, self._writer, number)])
                    if is_second and result is None:  # it may have been done the first time
                        result = self._database.read(operation.done)
                except Away as error:
                    self._lose(error)
                else:
                    return self._copy_done(operation, result, before, after)
            if isinstance(operation, Remove | Join):
                raise CacheError(f"{self.away or 'the database is away'}; this has to wait until it is back")
            if isinstance(operation, SetDown):
                shown = self.local.read(operation.resolved)
                own = OWN_NUMBERS + uuid4().int % OWN_NUMBERS
                return self.local.spool(_numbered(shown, own), self._writer, number)
            return self.local.spool(operation, self._writer, number)

    def follow(self, key: tuple[str, int]) -> None:
        with self._state:
            if not self._is_here:
                return
            self._wanted.add(key)
        self._ring()

    def subscribe(self, told: Callable[[CacheChange], None]) -> Callable[[], None]:
        self._subscribers.append(told)
        with suppress(CacheError):  # every other call says so; once it is reached, there may be news
            self._meet()

        def end() -> None:
            with suppress(ValueError):
                self._subscribers.remove(told)

        return end

    def close(self) -> None:
        self._is_closed = True
        self._ring()
        with self._reaching:
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()
        with self._writing:
            self._is_here = False
            if self._listener is not None:
                self._listener.close()
            self._database.close()
            self.local.close()
        self._bell.close()
        self._ringer.close()

    # reaching the database

    def _meet(self, *, at_once: bool = False) -> bool:
        """Whether the database is here; tries to reach it where nobody has yet, or where this is wanted.

        Raises:
            CacheError: it is closed; or the database was never reached, and there is no copy.
        """
        if self._is_closed:
            raise CacheError(f"the cache {self._address.place} is closed")
        is_first = self._thread is None
        if not self._is_here and (is_first or at_once) and self._reaching.acquire(blocking=is_first):
            try:
                if not self._is_here:
                    self._reach()
                if self._thread is None:
                    self._thread = threading.Thread(
                        target=self._listen, name="paramclient cache listener", daemon=True
                    )
                    self._thread.start()
            finally:
                self._reaching.release()
        if not self._is_here and not self.local.exists:
            raise CacheError(f"{self.away}; it was never reached from here, so there is no local copy")
        return self._is_here

    def _reach(self) -> None:
        """Reach the database and do there what has waited; if that cannot be, `away` says why.

        Raises:
            CacheError: it cannot be used.
        """
        try:
            listener = self._database.open()
            try:
                self._begin_copy()
                with self._writing:  # or what comes could come faster than it goes
                    self._deliver()
                    revisions = self._database.revisions()
                    self._take_up(listener, revisions)
            except BaseException:
                listener.close()
                raise
        except Away as error:
            self._lose(error)

    def _take_up(self, listener: psycopg.Connection[tuple[Any, ...]], revisions: Revisions) -> None:
        kept = self._kept()
        if self.away is not None:
            _log.warning("the database %s is back", self._address.place)
        with self._state:
            before, self._revisions = self._revisions, revisions
            old, self._listener = self._listener, listener
            self._wanted |= {key for key, revision in kept.items() if revisions.get(key) != revision}
            self.away = None
            self._is_here = True
        if old is not None:
            old.close()
        if before:
            self._tell({key for key in {*before, *revisions} if before.get(key) != revisions.get(key)})
        self._ring()

    def _begin_copy(self) -> None:
        try:
            self.local.begin()
        except CacheError as error:
            self._warn_of_copy(error)

    def _deliver(self) -> None:
        """Do in the database what has waited, in order, until nothing waits.

        What waits in a copy that cannot be used goes when it can, the next time that the database is reached.
        """
        try:
            while entries := self.local.waiting(BATCH):
                self._deliver_all(entries)
        except CacheError as error:
            self._warn_of_copy(error)

    def _deliver_all(self, entries: Sequence[Entry]) -> None:
        try:
            operations = [(each.operation, each.writer, each.number) for each in entries]
            _, _, after = self._database.write(operations)
        except CacheError as error:
            if len(entries) > 1:
                for entry in entries:
                    self._deliver_all([entry])
                return
            _log.warning("the database refuses what was written while it was away: %s", error)
            self.local.refuse(entries[0], str(error))
            return
        # the copies are made anew: others may have written meanwhile
        self.local.arrived(entries, [key for each in entries for key in _touched(each.operation, after)])

    def _lose(self, error: Away) -> None:
        with self._state:
            is_news = self.away is None
            self.away = str(error)
            self._is_here = False
        if is_news:
            copy = self.local
            meanwhile = f"going on with the local copy {copy.path}" if copy.exists else "trying again"
            _log.warning("%s; %s", error, meanwhile)
        self._database.close()
        self._ring()

    # the local copy

    def _copy_done(self, operation: Operation[Any], result: Any, before: Revisions, after: Revisions) -> Any:
        """Do the same in the local copy, where that was up to date; it is made so where it was not."""
        touched = set(_touched(operation, before | after))
        stale = touched
        try:
            if not isinstance(operation, Join):
                kept = self.local.revisions()
                number = result.id if isinstance(result, Snapshot) else None
                self.local.do(operation if number is None else _numbered(operation, number))
                stale = {key for key in touched if kept.get(key) != before.get(key)}
                for key in touched - stale:
                    self.local.goes_on(key, after.get(key))
        except (CacheError, UsageError) as error:
            self._warn_of_copy(error)
        with self._state:
            for key in touched:
                if key in after:
                    self._revisions[key] = after[key]
                else:
                    self._revisions.pop(key, None)
            self._wanted |= stale
        if stale:
            self._ring()
        return result

    def _mirror(self) -> None:
        """Make the copy of every table that is wanted what the database has."""
        while self._is_here and not self._is_closed:
            with self._state:
                if not self._wanted:
                    return
                key = self._wanted.pop()
            try:
                with self._writing:
                    having = self.local.snapshots(key)
                    take = partial(take_whole, key=key[0], component=key[1], having=having)
                    whole, revision = self._database.read_with_revision(take, key)
                    self.local.mirror(key, whole, revision)
            except Away as error:
                self._lose(error)
            except (CacheError, UsageError) as error:  # a file cannot keep all that a database can
                self._warn_of_copy(error)

    def _kept(self) -> Revisions:
        """Of which tables there is a copy, and of which revision; none where it cannot be read."""
        try:
            return self.local.revisions()
        except CacheError as error:
            self._warn_of_copy(error)
            return {}

    def _warn_of_copy(self, error: CacheError | UsageError) -> None:
        if not self._has_warned:
            _log.warning("the local copy is not up to date: %s", error)
        self._has_warned = True

    # the thread

    def _listen(self) -> None:
        pause = RETRY_FIRST
        with selectors.DefaultSelector() as selector:
            selector.register(self._bell, selectors.EVENT_READ)
            while not self._is_closed:
                if self._is_here and self._listener is not None:
                    pause = RETRY_FIRST
                    self._mirror()
                    self._hear(selector, self._listener)
                    continue
                self._wait(selector, pause)
                pause = min(2 * pause, RETRY_LAST)
                if not self._is_closed and not self._is_here and self._reaching.acquire(blocking=False):
                    try:
                        self._reach()
                    except CacheError as error:
                        self.away = str(error)
                    finally:
                        self._reaching.release()

    def _wait(self, selector: selectors.BaseSelector, pause: float) -> None:
        deadline = time.monotonic() + pause
        while not self._is_closed and not self._is_here and (left := deadline - time.monotonic()) > 0:
            selector.select(left)
            self._silence()

    def _hear(self, selector: selectors.BaseSelector, listener: psycopg.Connection[tuple[Any, ...]]) -> None:
        """Wait until the database says something, or somebody here rings; pass on what it says."""
        try:
            file = listener.fileno()
            selector.register(file, selectors.EVENT_READ)
            try:
                if self._is_here and not self._wanted:
                    selector.select()
            finally:
                selector.unregister(file)
            self._silence()
            told = [_news(each.payload) for each in listener.notifies(timeout=0)]
        except Exception as error:  # whatever it is, the connection is of no more use
            if listener is self._listener and self._is_here and not self._is_closed:
                text = self._address.without_password(" ".join(str(error).split()))
                self._lose(Away(f"the database {self._address.place} is gone: {text}"))
            return
        changed = set()
        with self._state:
            for writer, key, component, revision in filter(None, told):
                if writer != self._writer:
                    changed.add((key, component))
                    self._revisions[key, component] = revision
        if changed:
            kept = self._kept()
            with self._state:
                self._wanted |= changed & kept.keys()
            self._tell(changed)

    def _tell(self, changed: set[tuple[str, int]]) -> None:
        for key, component in sorted(changed):
            for told in list(self._subscribers):
                try:
                    told(CacheChange(key, component))
                except Exception:
                    _log.exception("a listener of the cache failed")

    def _ring(self) -> None:
        with suppress(OSError):
            self._ringer.send(b"!")

    def _silence(self) -> None:
        with suppress(OSError):
            self._bell.recv(4096)


def _touched(operation: Operation[Any], known: Revisions) -> Iterator[tuple[str, int]]:
    for key, component in operation.tables:
        if component is not None:
            yield key, component
        else:
            yield from (each for each in known if each[0] == key)


def _news(payload: str) -> tuple[Any, ...] | None:
    """What a station has told; None where it was somebody else who did, as anybody in the database can."""
    try:
        writer, key, component, revision = json.loads(payload)
    except (TypeError, ValueError):
        return None
    is_ours = isinstance(writer, str) and isinstance(key, str) and isinstance(component, int)
    return (writer, key, component, revision) if is_ours else None


def _numbered(operation: Operation[Any], number: int) -> SetDown:
    assert isinstance(operation, SetDown)
    return replace(operation, number=number)
