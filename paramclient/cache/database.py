"""The tables of the cache in one SQL text for SQLite and PostgreSQL, and the store that runs transactions.

A new column or another meaning needs another `SCHEMA_VERSION`: a file of another version is set aside, and a
database keeps each version in a schema of its own. Values are marked by `?`.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, TypeVar

from paramclient.errors import CacheError

__all__ = ["IDENTITY", "SCHEMA_VERSION", "TABLES", "Store", "Transaction"]

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
        rows: list[tuple[Any, ...]] = self._connection.execute(self._marked(sql), values).fetchall()
        return rows

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
        notes: one text for each file that was set aside.
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
