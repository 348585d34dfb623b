"""The cache in a file: what SQLite says in its own way."""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final, TypeVar

from paramclient.cache.database import Database
from paramclient.cache.operations import Operation
from paramclient.cache.records import CacheChange
from paramclient.cache.rows import Row, cells
from paramclient.cache.session import Session

__all__ = ["SqliteSession", "SqliteStore"]

_PARAM: Final = "(?, ?, ?, ?, ?, ?, ?, ?, ?)"
_ROWS_AT_ONCE: Final = 100
"""Parameters that one statement writes: that takes half as long as one by one, and the interpreter's lock is
passed on a hundredth as often. Some builds of SQLite allow 999 variables in one, which these fill."""

T = TypeVar("T")


class SqliteStore:
    """A cache in one file of this computer, see `Database`.

    Args:
        path: the file, absolute, with links followed.

    Attributes:
        path: the same.
        place: the same, for people.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.place = str(path)
        self._database = Database(path)

    @property
    def notes(self) -> tuple[str, ...]:
        """What went wrong with the file and was mended."""
        return tuple(self._database.notes)

    @property
    def replacements(self) -> int:
        """How often a fresh file was made, or another one found in its place."""
        return self._database.replacements

    @property
    def away(self) -> None:
        """None: the file is the cache."""
        return

    def follow(self, key: str, component: int) -> None:
        """Nothing: the file has every table."""

    def subscribe(self, told: Callable[[CacheChange], None]) -> Callable[[], None]:
        """Nothing: a file tells nobody."""
        return _nothing

    def read(self, work: Callable[[Session], T]) -> T:
        """Do work that only reads, in one transaction."""
        return self._database.read(lambda connection: work(SqliteSession(connection)))

    def do(self, operation: Operation[T]) -> T:
        """Write, in one transaction."""
        return self._database.write(lambda connection: operation.do(SqliteSession(connection)))

    def close(self) -> None:
        """Close the file."""
        self._database.close()


class SqliteSession(Session):
    """One transaction on a file. It holds the file's only write lock, where it writes."""

    def __init__(self, connection: sqlite3.Connection, *, is_shared: bool = False) -> None:
        self.connection = connection
        self.is_shared = is_shared

    def put_rows(self, owner: int, rows: Mapping[str, Row]) -> None:
        cells_of = [(owner, name, *row) for name, row in rows.items()]
        for first in range(0, len(cells_of), _ROWS_AT_ONCE):
            some = cells_of[first : first + _ROWS_AT_ONCE]
            self.connection.execute(
                "REPLACE INTO param"
                " (owner, name, type, bits, is_raw, param_index, volatile, heard_at, default_bits)"
                f" VALUES {', '.join([_PARAM] * len(some))}",
                [*chain.from_iterable(some)],
            )

    def names_between(self, component: int, first: str, end: str) -> list[str]:
        # one after the other: a table's names are found by its index
        rows = self.connection.execute(
            "SELECT DISTINCT name FROM component c CROSS JOIN param ON owner = c.id"
            " WHERE component = ? AND name >= ? AND name < ?",
            (component, first, end),
        )
        return [name for row in rows for name in cells(row, "s")]

    def holders(self, owners: Sequence[int], names: Sequence[str]) -> Mapping[tuple[Any, ...], list[int]]:
        found: defaultdict[tuple[Any, ...], list[int]] = defaultdict(list)
        marks = ", ".join("?" * len(names))
        select = f"SELECT name, type, bits, is_raw FROM param WHERE owner = ? AND name IN ({marks})"
        for owner in owners:
            for row in self.connection.execute(select, (owner, *names)):
                found[row].append(owner)
        return found

    def since(self, named: Mapping[int, Sequence[str]]) -> list[tuple[int, str, str, int, float]]:
        found: list[tuple[int, str, str, int, float]] = []
        for owner, names in named.items():
            marks = ", ".join("?" * len(names))
            begins = self.connection.execute(
                "SELECT known_since FROM component WHERE id = ? AND known_since IS NOT NULL", (owner,)
            )
            found.extend((owner, "", "known", 0, *cells(row, "f")) for row in begins)
            for what, select, end in (
                ("heard", "SELECT name, 0, heard_at FROM param", ""),
                ("line", "SELECT name, max(id), at FROM history", " GROUP BY name"),
                ("birth", "SELECT name, max(line), at FROM birth", " GROUP BY name"),
            ):
                for row in self.connection.execute(
                    f"{select} WHERE owner = ? AND name IN ({marks}){end}", (owner, *names)
                ):
                    name, line, heard = cells(row, "sif")
                    found.append((owner, name, what, line, heard))
        return found

    def _all(self, sql: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        return self.connection.execute(sql, values).fetchall()

    def _do(self, sql: str, values: Sequence[object] = ()) -> int:
        return self.connection.execute(sql, values).rowcount

    def _many(self, sql: str, rows: Iterable[Sequence[object]]) -> None:
        self.connection.executemany(sql, rows)

    def _insert(self, sql: str, values: Sequence[object]) -> int:
        self.connection.execute(sql, values)
        [(number,)] = self.connection.execute("SELECT last_insert_rowid()")
        return int(number)

    def _numbers(self, count: int) -> Sequence[int]:
        [(last,)] = self.connection.execute("SELECT ifnull(max(id), 0) FROM history")
        return range(last + 1, last + 1 + count)


def _nothing() -> None:
    return
