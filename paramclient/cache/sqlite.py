"""The cache in a SQLite file."""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final, TypeVar

from paramclient.cache.cells import Damaged, cells
from paramclient.cache.operations import StoreOperation
from paramclient.cache.packed_table import Packed, packed_row, row_checksum
from paramclient.cache.param_columns import StoredParam, StoredTable, checksum
from paramclient.cache.records import CacheChange
from paramclient.cache.sqlite_file import Database
from paramclient.cache.transaction import Transaction

__all__ = ["SqliteTransaction", "SqliteStore"]

_EMPTY_CHECKSUM: Final = checksum({})
"""Checksum of a table without parameters, which has no packed row."""
VARIABLES_MAX: Final = 999
"""Values of one statement that every SQLite takes (before 3.32.0, SQLITE_MAX_VARIABLE_NUMBER was 999)."""
_NAME_SETS_MAX: Final = 16
"""Maximum number of name sets with cached positions: a fleet has a few firmwares. Each takes 100 kB."""

T = TypeVar("T")


class SqliteStore:
    """A cache in one file of this computer, see `Store` and `Database`.

    Args:
        path: the file, absolute, with resolved symbolic links.
        link: the symbolic link that was given as path, or None.

    Attributes:
        path: the file.
        place: the file, for messages.
    """

    def __init__(self, path: Path, *, link: Path | None = None) -> None:
        self.path = path
        self.place = str(path)
        self._database = Database(path, link=link)

    @property
    def notes(self) -> tuple[str, ...]:
        """See `Store.notes`."""
        return tuple(self._database.notes)

    @property
    def replacements(self) -> int:
        """See `Store.replacements`."""
        return self._database.replacements

    @property
    def offline_reason(self) -> None:
        """Always None: a file has no local copy."""
        return

    def follow(self, key: str, component: int) -> None:
        """Do nothing: the file has every table."""

    def subscribe(self, callback: Callable[[CacheChange], None]) -> Callable[[], None]:
        """Do nothing: a file has no notifications."""
        return _nothing

    def read(self, work: Callable[[Transaction], T]) -> T:
        """See `Store.read`."""
        return self._database.read(lambda connection: work(SqliteTransaction(connection)))

    def do(self, operation: StoreOperation[T]) -> T:
        """See `Store.do`."""

        def work(connection: sqlite3.Connection) -> T:
            return operation.do(SqliteTransaction(connection))

        return self._database.write(work, durable=operation.is_durable)

    def limit_lock_waits(self, seconds: float) -> None:
        """See `Store.limit_lock_waits`."""
        self._database.limit_lock_waits(seconds)

    def close(self) -> None:
        """Close the file."""
        self._database.close()


class SqliteTransaction(Transaction):
    """One transaction in a file. A write transaction holds the file's only write lock."""

    SIZE: ClassVar[str] = "ifnull((SELECT size FROM packed WHERE owner = c.id), 0)"

    def __init__(self, connection: sqlite3.Connection, *, is_shared: bool = False) -> None:
        self.connection = connection
        self.is_shared = is_shared
        self._places_of: dict[bytes, Mapping[str, int]] = {}

    def columns(self, owner: int) -> StoredTable:
        packed = self._packed(owner)
        return StoredTable.of({}) if packed is None else packed.table()

    def table(self, owner: int) -> dict[str, StoredParam]:
        return self.columns(owner).rows()

    def put_table(
        self, owner: int, before: Mapping[str, StoredParam] | None, after: Mapping[str, StoredParam]
    ) -> None:
        if not after:
            self._do("DELETE FROM packed WHERE owner = ?", (owner,))
            self.update_component(owner, checksum=_EMPTY_CHECKSUM)
            return
        row = packed_row(after)
        # updated in place: for a blob of equal length, only changed pages are written
        self._do(
            "INSERT INTO packed (owner, size, heard_last, params) VALUES (?, ?, ?, ?)"
            " ON CONFLICT (owner) DO UPDATE SET (size, heard_last, params)"
            " = (excluded.size, excluded.heard_last, excluded.params)",
            (owner, *row),
        )
        self.update_component(owner, checksum=row_checksum(*row))

    def heard_last(self, owner: int) -> float:
        found = self._all("SELECT heard_last FROM packed WHERE owner = ?", (owner,))
        return max((at for row in found for at in cells(row, "f")), default=float("-inf"))

    def names_between(self, component: int, first: str, end: str) -> list[str]:
        owners = self._all("SELECT id FROM component WHERE component = ?", (component,))
        names: set[str] = set()
        seen: set[bytes] = set()
        for packed in filter(None, (self._packed(owner) for (owner,) in owners)):
            if packed.named not in seen:
                seen.add(packed.named)
                names.update(self._places(packed))
        return [name for name in names if first <= name < end]

    def holders(self, owners: Sequence[int], names: Sequence[str]) -> Mapping[tuple[Any, ...], list[int]]:
        found: defaultdict[tuple[Any, ...], list[int]] = defaultdict(list)
        for owner in owners:
            packed = self._packed(owner)
            if packed is not None:
                places = self._places(packed)
                for value in packed.values((name, places[name]) for name in names if name in places):
                    found[value].append(owner)
        return found

    def value_dates(self, named: Mapping[int, Sequence[str]]) -> list[tuple[int, str, str, int, float]]:
        found: list[tuple[int, str, str, int, float]] = []
        for owner, names in named.items():
            marks = ", ".join("?" * len(names))
            begins = self.connection.execute(
                "SELECT known_since FROM component WHERE id = ? AND known_since IS NOT NULL", (owner,)
            )
            found.extend((owner, "", "known", 0, *cells(row, "f")) for row in begins)
            packed = self._packed(owner)
            if packed is not None:
                places = self._places(packed)
                there = [name for name in names if name in places]
                times = packed.heard_at(places[name] for name in there)
                found.extend((owner, name, "heard", 0, at) for name, at in zip(there, times, strict=True))
            for what, select, end in (
                ("line", "SELECT name, max(id), at FROM history", " GROUP BY name"),
                ("birth", "SELECT name, max(line), at FROM birth", " GROUP BY name"),
            ):
                for row in self.connection.execute(
                    f"{select} WHERE owner = ? AND name IN ({marks}){end}", (owner, *names)
                ):
                    name, line, observed_at = cells(row, "sif")
                    found.append((owner, name, what, line, observed_at))
        return found

    def _packed(self, owner: int) -> Packed | None:
        """Return the parameters of a table, or None if it has none.

        Raises:
            Damaged: the checksum does not match.
        """
        [(expected, *row)] = self._all(
            "SELECT checksum, size, heard_last, params FROM component LEFT JOIN packed ON owner = id"
            " WHERE id = ?",
            (owner,),
        )
        blob = row[-1]
        if not isinstance(blob, bytes | None):
            raise Damaged(f"a table is {blob!r:.40}")
        if expected != (_EMPTY_CHECKSUM if blob is None else row_checksum(*row)):
            raise Damaged("a table is not what was written")
        return None if blob is None else Packed(blob)

    def _places(self, packed: Packed) -> Mapping[str, int]:
        """Return the positions of a table's names, which are usually equal for one firmware."""
        found = self._places_of.get(packed.named)
        if found is None:
            if len(self._places_of) >= _NAME_SETS_MAX:
                self._places_of.clear()
            found = self._places_of[packed.named] = packed.places()
        return found

    def _all(self, sql: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        return self.connection.execute(sql, values).fetchall()

    def _do(self, sql: str, values: Sequence[object] = ()) -> int:
        return self.connection.execute(sql, values).rowcount

    def _many(self, sql: str, rows: Iterable[Sequence[object]]) -> None:
        """See `Transaction`. Inserts rows by one statement: beside a busy event loop, each may take 5 ms."""
        if " VALUES (" not in sql:
            self.connection.executemany(sql, rows)
            return
        head, marks, tail = _around_values(sql)
        pending = list(rows)
        size = VARIABLES_MAX // sql.count("?")
        for at in range(0, len(pending), size):
            some = pending[at : at + size]
            values = ", ".join([marks] * len(some))
            self.connection.execute(f"{head}{values}{tail}", [value for row in some for value in row])

    def _insert(self, sql: str, values: Sequence[object]) -> int:
        self.connection.execute(sql, values)
        [(number,)] = self.connection.execute("SELECT last_insert_rowid()")
        return int(number)

    def _numbers(self, count: int) -> Sequence[int]:
        [(last,)] = self.connection.execute("SELECT ifnull(max(id), 0) FROM history")
        return range(last + 1, last + 1 + count)


def _around_values(sql: str) -> tuple[str, str, str]:
    """Return an INSERT in three parts: the text before its list of values, the list, the text after it."""
    begin = sql.index(" VALUES (") + len(" VALUES ")
    depth = 0
    for end, character in enumerate(sql[begin:], begin + 1):
        depth += (character == "(") - (character == ")")
        if not depth:
            return sql[:begin], sql[begin:end], sql[end:]
    raise AssertionError(f"unclosed list of values: {sql}")


def _nothing() -> None:
    return
