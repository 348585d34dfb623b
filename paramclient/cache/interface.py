"""Store: the interface of a place that stores a cache."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol, TypeVar

from paramclient.cache.operations import StoreOperation
from paramclient.cache.records import CacheChange
from paramclient.cache.transaction import Transaction

__all__ = ["Store"]

T = TypeVar("T")


class Store(Protocol):
    """Storage of tables, identities and history. Thread-safe.

    Attributes:
        place: file, or URL without password, for messages and the log.
        path: file on this computer: the cache, or the local copy of a database.
    """

    @property
    def place(self) -> str: ...

    @property
    def path(self) -> Path: ...

    @property
    def notes(self) -> tuple[str, ...]:
        """Repaired problems of the file: one text for each damaged or newer file that was renamed."""
        ...

    @property
    def replacements(self) -> int:
        """Number of times that a new file was created, or found in place of the previous one."""
        ...

    def read(self, work: Callable[[Transaction], T]) -> T:
        """Run a function that only reads, in one transaction, and return its result.

        Raises:
            CacheError: the store cannot be read.
        """
        ...

    def do(self, operation: StoreOperation[T]) -> T:
        """Run a write operation in one transaction and return its result: either all or nothing is written.

        Raises:
            CacheError: the store cannot be written.
            UsageError: a time is not in unix seconds.
        """
        ...

    @property
    def offline_reason(self) -> str | None:
        """Why the local copy is used instead of the database. None while the database is used."""
        ...

    def follow(self, key: str, component: int) -> None:
        """Keep a table of this program in the local copy, for the time without a database connection."""
        ...

    def subscribe(self, callback: Callable[[CacheChange], None]) -> Callable[[], None]:
        """Call a function, in a thread of the store, after each write of another station to a table.

        Return a function that ends the subscription.
        """
        ...

    def limit_lock_waits(self, seconds: float) -> None:
        """Wait for locks of other processes on files, and for responses of a database, for at most these
        seconds from now in all. Does not block."""
        ...

    def close(self) -> None:
        """Close files, connections and threads; later calls raise CacheError."""
        ...
