"""What a place must do to keep a cache."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol, TypeVar

from paramclient.cache.operations import Operation
from paramclient.cache.records import CacheChange
from paramclient.cache.transaction import Session

__all__ = ["Store"]

T = TypeVar("T")


class Store(Protocol):
    """Where tables, identities and history are kept. Safe to use from several threads.

    Attributes:
        place: what it is, for people and for the log: without a password.
        path: the file on this computer: the cache, or the local copy of one.
    """

    @property
    def place(self) -> str: ...

    @property
    def path(self) -> Path: ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What went wrong with the file and was mended."""
        ...

    @property
    def replacements(self) -> int:
        """How often a fresh file was made, or another one found in its place."""
        ...

    def read(self, work: Callable[[Session], T]) -> T:
        """Do work that only reads, in one transaction.

        Raises:
            CacheError: it cannot be read.
        """
        ...

    def do(self, operation: Operation[T]) -> T:
        """Write, in one transaction: all of it is kept, or nothing.

        Raises:
            CacheError: it cannot be written.
            UsageError: a time that is not in unix seconds.
        """
        ...

    @property
    def away(self) -> str | None:
        """Why a local copy is what is read and written at present; None while it is the cache itself."""
        ...

    def follow(self, key: str, component: int) -> None:
        """This program has to do with a table: have it where it stays when a database is lost."""
        ...

    def subscribe(self, told: Callable[[CacheChange], None]) -> Callable[[], None]:
        """Have something called, in a thread of the store, when another station has written to a table.

        Gives what ends that.
        """
        ...

    def close(self) -> None:
        """Let go of everything; later calls raise CacheError."""
        ...
