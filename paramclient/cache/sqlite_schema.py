"""Schema of the cache in a file, by version."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from typing import Final, TypeAlias

from paramclient.cache.cells import Damaged
from paramclient.cache.packed_table import packed_row, row_checksum
from paramclient.cache.param_columns import checksum, read_rows
from paramclient.errors import UsageError

__all__ = ["MIGRATIONS", "Step"]

Step: TypeAlias = tuple[str | Callable[[sqlite3.Connection], None], ...]
"""Changes from one version to the next: SQL statements, and functions for other changes."""


def _pack_tables(connection: sqlite3.Connection) -> None:
    """Convert the parameters of each table to a blob.

    Raises:
        Damaged: a table has a wrong checksum or invalid cells.
    """
    for owner, expected in connection.execute("SELECT id, checksum FROM component").fetchall():
        found = connection.execute(
            "SELECT name, type, bits, is_raw, param_index, volatile, heard_at, default_bits FROM param"
            " WHERE owner = ?",
            (owner,),
        )
        rows = read_rows(found)
        if checksum(rows) != expected:
            raise Damaged("a table is not what was written")
        if not rows:
            continue
        try:
            row = packed_row(rows)
        except UsageError as error:
            raise Damaged(str(error)) from error
        connection.execute(
            "INSERT INTO packed (owner, size, heard_last, params) VALUES (?, ?, ?, ?)", (owner, *row)
        )
        connection.execute("UPDATE component SET checksum = ? WHERE id = ?", (row_checksum(*row), owner))


MIGRATIONS: Final[tuple[Step, ...]] = (
    (
        """CREATE TABLE vehicle (
            key TEXT NOT NULL PRIMARY KEY,
            system INTEGER NOT NULL,
            link TEXT NOT NULL,
            uid TEXT,
            autopilot INTEGER NOT NULL,
            vehicle_type INTEGER NOT NULL,
            firmware INTEGER NOT NULL,
            git_hash TEXT NOT NULL,
            board INTEGER NOT NULL,
            vendor_id INTEGER NOT NULL,
            product_id INTEGER NOT NULL,
            capabilities INTEGER NOT NULL,
            first_seen REAL NOT NULL,
            last_seen REAL NOT NULL
        )""",
        """CREATE TABLE component (
            id INTEGER PRIMARY KEY,
            vehicle TEXT NOT NULL REFERENCES vehicle (key) ON DELETE CASCADE,
            component INTEGER NOT NULL,
            own_autopilot INTEGER NOT NULL,
            hash INTEGER,
            count INTEGER,
            complete INTEGER NOT NULL DEFAULT 0,
            volatile_known INTEGER NOT NULL DEFAULT 0,
            synced_at REAL,
            checksum INTEGER NOT NULL,
            updated_at REAL NOT NULL,
            UNIQUE (vehicle, component)
        )""",
        """CREATE TABLE param (
            owner INTEGER NOT NULL REFERENCES component (id) ON DELETE CASCADE,
            name TEXT NOT NULL,
            type INTEGER NOT NULL,
            bits INTEGER NOT NULL,
            is_raw INTEGER NOT NULL,
            param_index INTEGER,
            volatile INTEGER NOT NULL,
            heard_at REAL NOT NULL,
            PRIMARY KEY (owner, name)
        ) WITHOUT ROWID""",
        """CREATE TABLE history (
            id INTEGER PRIMARY KEY,
            owner INTEGER NOT NULL REFERENCES component (id) ON DELETE CASCADE,
            at REAL NOT NULL,
            name TEXT NOT NULL,
            old_type INTEGER NOT NULL,
            old_bits INTEGER NOT NULL,
            old_is_raw INTEGER NOT NULL,
            new_type INTEGER,
            new_bits INTEGER,
            new_is_raw INTEGER,
            by TEXT NOT NULL
        )""",
        "CREATE INDEX history_of_component ON history (owner)",
    ),
    (
        "ALTER TABLE param ADD COLUMN default_bits INTEGER",
        "ALTER TABLE component ADD COLUMN file_works INTEGER",
    ),
    (
        # Earlier versions did not record new names, so the known states of their tables begin now.
        "ALTER TABLE component ADD COLUMN known_since REAL",
        """UPDATE component SET known_since = max(
            updated_at,
            ifnull((SELECT max(heard_at) FROM param WHERE owner = component.id), 0),
            ifnull((SELECT max(at) FROM history WHERE owner = component.id), 0)
        ) WHERE complete""",
        """CREATE TABLE birth (
            owner INTEGER NOT NULL REFERENCES component (id) ON DELETE CASCADE,
            name TEXT NOT NULL,
            line INTEGER NOT NULL,
            at REAL NOT NULL,
            PRIMARY KEY (owner, name, line)
        ) WITHOUT ROWID""",
        """CREATE TABLE setback (
            id INTEGER PRIMARY KEY,
            owner INTEGER NOT NULL REFERENCES component (id) ON DELETE CASCADE,
            since REAL NOT NULL,
            until REAL NOT NULL
        )""",
        "CREATE INDEX setback_of_component ON setback (owner)",
        """CREATE TABLE snapshot (
            id INTEGER PRIMARY KEY AUTOINCREMENT,
            owner INTEGER NOT NULL REFERENCES component (id) ON DELETE CASCADE,
            at REAL NOT NULL,
            reason TEXT NOT NULL,
            size INTEGER NOT NULL,
            hash INTEGER,
            complete INTEGER NOT NULL,
            params BLOB NOT NULL,
            checksum INTEGER NOT NULL
        )""",
        "CREATE INDEX snapshot_of_component ON snapshot (owner)",
        "CREATE INDEX history_of_param ON history (owner, name)",
    ),
    (
        # A table of its own: the row of the component is rewritten by each save, including a blob in it.
        """CREATE TABLE packed (
            owner INTEGER PRIMARY KEY REFERENCES component (id) ON DELETE CASCADE,
            size INTEGER NOT NULL,
            heard_last REAL NOT NULL,
            params BLOB NOT NULL
        )""",
        _pack_tables,
        "DROP TABLE param",
    ),
    ("ALTER TABLE component ADD COLUMN source TEXT",),
    (
        # Extended parameters: apart from the plain ones, as a component may have a name in both tables.
        """CREATE TABLE ext_table (
            owner INTEGER PRIMARY KEY REFERENCES component (id) ON DELETE CASCADE,
            count INTEGER,
            complete INTEGER NOT NULL,
            checksum INTEGER NOT NULL
        )""",
        """CREATE TABLE ext_param (
            owner INTEGER NOT NULL REFERENCES component (id) ON DELETE CASCADE,
            name TEXT NOT NULL,
            type INTEGER NOT NULL,
            raw BLOB NOT NULL,
            param_index INTEGER,
            heard_at REAL NOT NULL,
            PRIMARY KEY (owner, name)
        ) WITHOUT ROWID""",
        """CREATE TABLE ext_history (
            id INTEGER PRIMARY KEY,
            owner INTEGER NOT NULL REFERENCES component (id) ON DELETE CASCADE,
            at REAL NOT NULL,
            name TEXT NOT NULL,
            by TEXT NOT NULL,
            old_type INTEGER NOT NULL,
            old_raw BLOB NOT NULL,
            new_type INTEGER,
            new_raw BLOB
        )""",
        "CREATE INDEX ext_history_of_component ON ext_history (owner)",
    ),
    (
        # Earlier versions did not record when a table of extended parameters was first complete.
        "ALTER TABLE ext_table ADD COLUMN known_since REAL",
        """UPDATE ext_table SET known_since = max(
            ifnull((SELECT max(heard_at) FROM ext_param e WHERE e.owner = ext_table.owner), 0),
            ifnull((SELECT max(at) FROM ext_history h WHERE h.owner = ext_table.owner), 0)
        ) WHERE complete""",
        "ALTER TABLE snapshot ADD COLUMN is_extended INTEGER NOT NULL DEFAULT 0",
    ),
)
"""Changes from each schema version to the next. The version is the number of steps executed. Released steps
never change."""
