"""The tables of the cache, in the one SQL text for SQLite and PostgreSQL, and transactions on them.

A new column or another meaning needs another `SCHEMA_VERSION`: a file of another version is set aside, and a
database keeps each version in a schema of its own. Values are marked by `?`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

__all__ = ["IDENTITY", "SCHEMA_VERSION", "TABLES", "Transaction"]

SCHEMA_VERSION: Final = 21
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
    # no value: the vehicle no longer has the parameter
    """CREATE TABLE parameter (
        owner BIGINT NOT NULL REFERENCES component (id) ON DELETE CASCADE,
        name TEXT NOT NULL,
        type INTEGER,
        value BYTEA,
        is_raw INTEGER,
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
        old_is_raw INTEGER,
        new_type INTEGER,
        new_value BYTEA,
        new_is_raw INTEGER
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
        is_raw INTEGER NOT NULL,
        default_value BYTEA,
        PRIMARY KEY (snapshot, position)
    ){clustered}""",
)
"""Statements that create the tables. `{id}` is a number that is never used again, `{clustered}` stores the
rows in the order of the primary key."""


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
