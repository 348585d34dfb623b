"""The cache in PostgreSQL. psycopg is imported only for the URL of a database.

All tables are in the schema `paramclient`. A write holds advisory locks on its vehicles, so that no other
write changes rows between its reads and its writes. A read is a consistent snapshot (REPEATABLE READ).
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeVar
from uuid import uuid4

from paramclient.cache.cells import Damaged, cells
from paramclient.cache.database_url import DatabaseAddress
from paramclient.cache.operations import StoreOperation
from paramclient.cache.param_columns import (
    COLUMN_NAMES,
    COLUMNS,
    StoredParam,
    StoredTable,
    checksum,
    read_rows,
)
from paramclient.cache.postgres_schema import CHANNEL, MIGRATIONS, SCHEMA
from paramclient.cache.transaction import Transaction
from paramclient.cache.transfer import LOCAL_NUMBERS_MIN
from paramclient.errors import CacheError, UsageError

if TYPE_CHECKING:
    import psycopg
    from psycopg_pool import ConnectionPool

__all__ = ["Unavailable", "PostgresDatabase", "PostgresTransaction", "Revisions"]

CONNECT_TIMEOUT: Final = 3
"""Timeout in seconds for a connection to the database; after it, the local copy is used."""
UNACKNOWLEDGED_MAX: Final = 5_000
"""TCP user timeout in milliseconds: a connection with data unacknowledged for longer is closed (Linux)."""
LOCK_TIMEOUT: Final = "5s"
"""Timeout for the lock on a vehicle, as a PostgreSQL setting: transactions take milliseconds."""
STATEMENT_TIMEOUT: Final = 20.0
"""Timeout in seconds for a statement. The database cancels a longer one; if it does not respond even then,
because its machine swaps or its disk hangs, the connection is closed. The longest statements take 1 s to 2 s,
and wait 5 s for a lock."""
IDLE_TRANSACTION_TIMEOUT: Final = "15s"
"""Timeout after which the database ends an idle transaction, as a PostgreSQL setting: a stopped station would
keep its vehicles locked."""
CLOSING_WAIT_MIN: Final = 0.25
"""Timeout in seconds for a statement after the time of `PostgresDatabase.limit_waits`."""
POOL_SIZE_MAX: Final = 4
"""Maximum number of connections of one cache, in addition to the one that listens."""

_LOCKS: Final = 0x5041524D
"""First half of the advisory locks on vehicles: `PARM`."""
_MIGRATION_LOCK: Final = 0x5041524D_0000_0001
"""Advisory lock for schema migrations."""
_DEADLOCK_ATTEMPTS_MAX: Final = 5
"""Maximum number of attempts of a write that ends in a deadlock."""

Revisions = dict[tuple[str, int], int]
"""Revision of each table, by key and component: a random number that changes with every write. It is random
so that it also differs after the database was replaced by a backup or by another database."""
T = TypeVar("T")


class Unavailable(Exception):
    """The database cannot be reached or used at present. An attempted write may have been executed."""


class PostgresDatabase:
    """A database shared by several stations. Thread-safe.

    Args:
        address: its address.
    """

    def __init__(self, address: DatabaseAddress) -> None:
        self.address = address
        self._waits_end = math.inf  # by time.monotonic
        self._pool: ConnectionPool[psycopg.Connection[tuple[Any, ...]]] | None = None
        self._lock = threading.Lock()

    def open(self) -> psycopg.Connection[tuple[Any, ...]]:
        """Connect to the database, upgrade its schema, and return a connection that listens to notifications.

        Raises:
            Unavailable: the database cannot be reached.
            CacheError: its schema is of a later version.
        """
        _, pools = _libraries()
        with self._translated():
            kind = _connection_kind(lambda: self._waits_end)
            listener: psycopg.Connection[tuple[Any, ...]] = kind.connect(**self._options(), autocommit=True)
            try:
                _migrate(listener, self.address.place)
                listener.execute(f"LISTEN {CHANNEL}")
                pool = pools.ConnectionPool(
                    connection_class=kind,
                    kwargs=self._options(),
                    min_size=0,
                    max_size=POOL_SIZE_MAX,
                    timeout=CONNECT_TIMEOUT,
                    num_workers=1,
                    reconnect_timeout=CONNECT_TIMEOUT,
                    open=True,
                    name=self.address.place,
                )
            except BaseException:
                listener.close()
                raise
        with self._lock:
            before, self._pool = self._pool, pool
        self._end(before)
        return listener

    def limit_waits(self, seconds: float) -> None:
        """Wait for responses of the database for at most these seconds from now in all, in statements that
        are in progress and in later ones. A statement after that time has `CLOSING_WAIT_MIN`. Returns
        immediately, also while another thread waits.
        """
        self._waits_end = time.monotonic() + seconds

    @property
    def is_given_up(self) -> bool:
        """Whether the time of `limit_waits` has passed: the database is not worth a new connection."""
        return time.monotonic() >= self._waits_end

    def close(self) -> None:
        """Close all connections except the one that listens."""
        with self._lock:
            pool, self._pool = self._pool, None
        self._end(pool)

    def read(self, work: Callable[[Transaction], T]) -> T:
        """Run a function that only reads, in one consistent snapshot, and return its result.

        Raises:
            Unavailable: the database cannot be reached.
            CacheError: its content is damaged.
        """
        with self._translated(), self._connection() as connection:
            connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY")
            return work(PostgresTransaction(connection))

    def read_with_revision(
        self, work: Callable[[Transaction], T], table: tuple[str, int]
    ) -> tuple[T, int | None]:
        """Run a function that only reads one table. Return its result and the revision of the table.

        Raises:
            Unavailable, CacheError: as `read`.
        """
        with self._translated(), self._connection() as connection:
            connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY")
            return work(PostgresTransaction(connection)), _revisions(connection, [table[0]]).get(table)

    def write(
        self, operations: Sequence[tuple[StoreOperation[Any], str, int]]
    ) -> tuple[list[Any], Revisions, Revisions]:
        """Execute operations in one transaction, each exactly once.

        Args:
            operations: operations with writer and number. An operation is skipped if this writer has executed
                one with this number or a higher one before.

        Returns:
            Their results, None for a skipped one; the revisions of the vehicles' tables before and after.

        Raises:
            Unavailable: the database cannot be reached. It is unknown whether they were executed: repeat the
                call.
            CacheError: one of them cannot be executed; none was.
        """
        with self._translated():
            for _ in range(_DEADLOCK_ATTEMPTS_MAX - 1):
                try:
                    return self._write(operations)
                except _libraries()[0].errors.DeadlockDetected:
                    continue
            return self._write(operations)

    def revisions(self) -> Revisions:
        """Return the revision of every table.

        Raises:
            Unavailable, CacheError: as `read`.
        """
        with self._translated(), self._connection() as connection:
            return _revisions(connection, None)

    def _write(
        self, operations: Sequence[tuple[StoreOperation[Any], str, int]]
    ) -> tuple[list[Any], Revisions, Revisions]:
        tables = {table for operation, _, _ in operations for table in operation.tables}
        keys = sorted({key for key, _ in tables})
        with self._connection() as connection:
            connection.execute(
                "SELECT pg_advisory_xact_lock(%s, half) FROM"
                " (SELECT DISTINCT hashtext(key) AS half FROM unnest(%s::text[]) AS key ORDER BY half) AS a",
                (_LOCKS, keys),
            )
            if any(operation.is_durable for operation, _, _ in operations):
                connection.execute(
                    "SELECT set_config('synchronous_commit', 'on', true)"
                    " WHERE current_setting('synchronous_commit') = 'off'"
                )
            before = _revisions(connection, keys)
            transaction = PostgresTransaction(connection)
            results = [
                operation.do(transaction) if _is_new(connection, writer, number) else None
                for operation, writer, number in operations
            ]
            connection.execute(
                "UPDATE component c SET revision = %s"
                " FROM unnest(%s::text[], %s::integer[]) AS touched (key, number)"
                " WHERE vehicle = key AND component = coalesce(number, component)",
                (uuid4().int >> 65, [key for key, _ in tables], [component for _, component in tables]),
            )
            after = _revisions(connection, keys)
            changed = {each for each in {*before, *after} if before.get(each) != after.get(each)}
            writer = operations[-1][1]
            payloads = [
                json.dumps([writer, key, number, after.get((key, number))]) for key, number in changed
            ]
            connection.execute(
                "SELECT pg_notify(%s, payload) FROM unnest(%s::text[]) AS payload", (CHANNEL, payloads)
            )
        return results, before, after

    @contextmanager
    def _connection(self) -> Iterator[psycopg.Connection[tuple[Any, ...]]]:
        with self._lock:
            pool = self._pool
        if pool is None:
            raise Unavailable("the connection is closed")
        with pool.connection(timeout=self._left()) as connection, connection.transaction():
            yield connection

    def _end(self, pool: ConnectionPool[Any] | None) -> None:
        if pool is not None:
            pool.close(timeout=self._left())

    def _left(self) -> float:
        """Return the seconds to wait for a connection."""
        return max(CLOSING_WAIT_MIN, min(CONNECT_TIMEOUT, self._waits_end - time.monotonic()))

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Translate errors of psycopg to `Unavailable` and CacheError, without the password."""
        library, pools = _libraries()
        place = self.address.place
        try:
            yield
        except (pools.PoolClosed, pools.PoolTimeout) as error:
            raise Unavailable(f"the database {place} does not respond") from error
        except library.errors.LockNotAvailable as error:
            raise Unavailable(f"another station has locked a vehicle in the cache {place}") from error
        except (library.OperationalError, library.InterfaceError) as error:
            text = self.address.without_password(" ".join(str(error).split()))
            raise Unavailable(f"the database {place} cannot be reached: {text}") from None
        except (library.DataError, library.IntegrityError) as error:
            text = self.address.without_password(" ".join(str(error).split()))
            raise CacheError(f"the cache {place} cannot store this: {text}") from None
        except library.Error as error:  # read-only, forbidden, dropped: independent of the written data
            text = self.address.without_password(" ".join(str(error).split()))
            raise Unavailable(f"the database {place} cannot be used: {text}") from None
        except Damaged as damage:
            raise CacheError(f"the cache {place} is damaged ({damage})") from damage

    def _options(self) -> dict[str, Any]:
        settings = {
            "search_path": SCHEMA,
            "lock_timeout": LOCK_TIMEOUT,
            "statement_timeout": round(1000 * STATEMENT_TIMEOUT),
            "idle_in_transaction_session_timeout": IDLE_TRANSACTION_TIMEOUT,
        }
        chosen = " ".join(f"-c {name}={value}" for name, value in settings.items())
        given = self.address.options
        defaults = {
            "connect_timeout": CONNECT_TIMEOUT,
            "tcp_user_timeout": UNACKNOWLEDGED_MAX,
            "keepalives_idle": 10,
            "keepalives_interval": 5,
            "keepalives_count": 2,
            "application_name": "paramclient",
            "client_encoding": "utf8",
        }
        return {**defaults, **given, "options": f"{chosen} {given.get('options', '')}".strip()}


class PostgresTransaction(Transaction):
    """One transaction in PostgreSQL."""

    is_shared = True
    SNAPSHOT_ORDER: ClassVar[str] = "s.at, s.id"
    SIZE: ClassVar[str] = "(SELECT count(*) FROM param WHERE owner = c.id)"

    def __init__(self, connection: psycopg.Connection[tuple[Any, ...]]) -> None:
        self.connection = connection

    def columns(self, owner: int) -> StoredTable:
        return StoredTable.of(self.table(owner))

    def table(self, owner: int) -> dict[str, StoredParam]:
        rows = self._rows(owner)
        [(expected,)] = self._all("SELECT checksum FROM component WHERE id = ?", (owner,))
        if checksum(rows) != expected:
            raise Damaged("a table is not what was written")
        return rows

    def put_table(
        self, owner: int, before: Mapping[str, StoredParam] | None, after: Mapping[str, StoredParam]
    ) -> None:
        if before is None:
            before = self._rows(owner)
        removed = list(before.keys() - after.keys())
        if removed:
            self._do("DELETE FROM param WHERE owner = ? AND name = ANY (?)", (owner, removed))
        self._put_rows(owner, {name: row for name, row in sorted(after.items()) if before.get(name) != row})
        self.update_component(owner, checksum=checksum(after))

    def heard_last(self, owner: int) -> float:
        [(at,)] = self._all("SELECT max(heard_at) FROM param WHERE owner = ?", (owner,))
        return float("-inf") if at is None else float(at)

    def _rows(self, owner: int) -> dict[str, StoredParam]:
        return read_rows(
            self._all(
                f"SELECT {', '.join(COLUMN_NAMES)} FROM param"
                " WHERE owner = ? ORDER BY param_index IS NULL, param_index, name",
                (owner,),
            )
        )

    def _put_rows(self, owner: int, rows: Mapping[str, StoredParam]) -> None:
        if rows:
            self.connection.execute(_PUT_ROWS, (owner, *map(list, StoredTable.of(rows).columns)))

    def add_snapshot(
        self,
        owner: int,
        row: Sequence[object],
        blob: bytes,
        crc: int,
        number: int | None = None,
        *,
        is_extended: bool = False,
    ) -> int:
        given = super().add_snapshot(owner, row, blob, crc, number, is_extended=is_extended)
        if number is not None and number < LOCAL_NUMBERS_MIN:
            self._all(
                "SELECT setval('snapshot_id_seq', greatest((SELECT last_value FROM snapshot_id_seq), ?))",
                (number,),
            )
        return given

    def names_between(self, component: int, first: str, end: str) -> list[str]:
        found = self._all(
            "SELECT DISTINCT name FROM component c JOIN param ON owner = c.id"
            " WHERE component = ? AND name >= ? AND name < ?",
            (component, first, end),
        )
        return [name for row in found for name in cells(row, "s")]

    def holders(self, owners: Sequence[int], names: Sequence[str]) -> Mapping[tuple[Any, ...], list[int]]:
        # filtered by names only, so that the database uses the index by names
        found = self._all(
            "SELECT name, type, bits, is_raw, array_agg(owner) FROM param WHERE name = ANY (?)"
            " GROUP BY name, type, bits, is_raw",
            (list(names),),
        )
        meant = frozenset(owners)
        holders = {tuple(value): [each for each in having if each in meant] for *value, having in found}
        return {value: some for value, some in holders.items() if some}

    def value_dates(self, named: Mapping[int, Sequence[str]]) -> list[tuple[int, str, str, int, float]]:
        owners = list(named)
        found = [
            (owner, "", "known", 0, at)
            for owner, at in self._all(
                "SELECT id, known_since FROM component WHERE id = ANY (?) AND known_since IS NOT NULL",
                (owners,),
            )
        ]
        by_names: defaultdict[tuple[str, ...], list[int]] = defaultdict(list)
        for owner, names in named.items():
            by_names[tuple(names)].append(owner)
        for names, some in by_names.items():
            query_arguments = (some, list(names))
            for what, select in (
                ("heard", "SELECT owner, name, 0, heard_at FROM param WHERE {}"),
                ("line", _LAST.format("history", "id")),
                ("birth", _LAST.format("birth", "line")),
            ):
                rows = self._all(select.format("owner = ANY (?) AND name = ANY (?)"), query_arguments)
                found += [(owner, name, what, line, at) for owner, name, line, at in rows]
        return found

    def _all(self, sql: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        return self.connection.execute(_marked(sql), tuple(map(_sent, values))).fetchall()

    def _do(self, sql: str, values: Sequence[object] = ()) -> int:
        return self.connection.execute(_marked(sql), tuple(map(_sent, values))).rowcount

    def _many(self, sql: str, rows: Iterable[Sequence[object]]) -> None:
        sent = [tuple(map(_sent, row)) for row in rows]
        if sent:
            with self.connection.cursor() as cursor:
                cursor.executemany(_marked(sql), sent)

    def _insert(self, sql: str, values: Sequence[object]) -> int:
        [(number,)] = self._all(f"{sql} RETURNING id", values)
        return int(number)

    def _numbers(self, count: int) -> Sequence[int]:
        found = self._all("SELECT nextval('history_id_seq') FROM generate_series(1, ?)", (count,))
        return sorted(number for (number,) in found)


_PUT_ROWS: Final = (
    f"INSERT INTO param (owner, {', '.join(COLUMN_NAMES)})"
    f" SELECT %s, * FROM unnest({', '.join(f'%s::{column.sql}[]' for column in COLUMNS)})"
    f" ON CONFLICT (owner, name) DO UPDATE SET ({', '.join(COLUMN_NAMES)})"
    f" = ({', '.join(f'excluded.{name}' for name in COLUMN_NAMES)})"
).encode()
_LAST: Final = (
    "SELECT DISTINCT ON (owner, name) owner, name, {1}, at FROM {0} WHERE {{}} ORDER BY owner, name, {1} DESC"
)


@cache
def _marked(sql: str) -> bytes:
    """Return a statement with psycopg's placeholders. No statement has `?` or `%` in its text."""
    return sql.replace("?", "%s").encode()


def _sent(cell: object) -> object:
    """Return a cell in PostgreSQL's form: its text type allows neither NUL nor lone surrogates."""
    if isinstance(cell, str):
        return cell.encode("utf-8", "backslashreplace").decode().replace("\0", "\\x00")
    return cell


def _is_new(connection: psycopg.Connection[tuple[Any, ...]], writer: str, number: int) -> bool:
    """Record an operation of a writer. Return whether it was not executed before."""
    return bool(
        connection.execute(
            "INSERT INTO writer (id, done) VALUES (%s, %s) ON CONFLICT (id)"
            " DO UPDATE SET done = excluded.done WHERE writer.done < excluded.done",
            (writer, number),
        ).rowcount
    )


def _revisions(connection: psycopg.Connection[tuple[Any, ...]], keys: Sequence[str] | None) -> Revisions:
    which = "" if keys is None else " WHERE vehicle = ANY (%s)"
    found = connection.execute(
        f"SELECT vehicle, component, revision FROM component{which}".encode(),
        () if keys is None else (list(keys),),
    )
    return {(key, component): revision for key, component, revision in found}


def _migrate(connection: psycopg.Connection[tuple[Any, ...]], place: str) -> None:
    """Upgrade the schema to this version. Concurrent upgrades by several stations run one after another.

    Raises:
        CacheError: the schema is of a later version.
    """
    if _version(connection) == len(MIGRATIONS):
        return
    # locked before the transaction, so that the transaction sees an upgrade by another station
    connection.execute("SELECT pg_advisory_lock(%s)", (_MIGRATION_LOCK,))
    try:
        with connection.transaction():
            version = _version(connection)
            if version > len(MIGRATIONS):
                raise CacheError(
                    f"the cache {place} is of a later version of paramclient (its schema has version"
                    f" {version}, this program knows {len(MIGRATIONS)}): upgrade paramclient"
                )
            if version == 0:
                connection.execute(f"CREATE SCHEMA IF NOT EXISTS {SCHEMA}")
                connection.execute("CREATE TABLE version (number integer NOT NULL)")
                connection.execute("INSERT INTO version VALUES (0)")
            for statement in (each for step in MIGRATIONS[version:] for each in step):
                connection.execute(statement.encode())
            connection.execute("UPDATE version SET number = %s", (len(MIGRATIONS),))
    finally:
        connection.execute("SELECT pg_advisory_unlock(%s)", (_MIGRATION_LOCK,))


def _version(connection: psycopg.Connection[tuple[Any, ...]]) -> int:
    [(found,)] = connection.execute("SELECT to_regclass(%s) IS NOT NULL", (f"{SCHEMA}.version",))
    if not found:
        return 0
    [(number,)] = connection.execute("SELECT number FROM version")
    return int(number)


@cache
def _libraries() -> tuple[Any, Any]:
    """Return psycopg and psycopg_pool.

    Raises:
        UsageError: one of them is not installed.
    """
    try:
        import psycopg
        import psycopg_pool
    except ImportError as error:
        raise UsageError(
            f"a cache in PostgreSQL needs psycopg ({error}): pip install 'paramclient[postgres]'"
        ) from error
    return psycopg, psycopg_pool


def _connection_kind(waits_end: Callable[[], float]) -> Any:
    """Return a connection class that closes the connection when a statement exceeds `STATEMENT_TIMEOUT`.

    No setting of the database or of TCP detects a server that hangs: it cancels no statement, while its
    operating system continues to acknowledge received packets.

    Args:
        waits_end: returns the time, by `time.monotonic`, after which a statement has `CLOSING_WAIT_MIN`.
    """

    class Connection(_libraries()[0].Connection):  # type: ignore[misc]  # imported at runtime
        def wait(self, work: Any, *arguments: Any, **options: Any) -> Any:
            return super().wait(self._limited(work), *arguments, **options)

        def _limited(self, work: Generator[Any, Any, T]) -> Generator[Any, Any, T]:
            """Run the work, which psycopg resumes when the socket is ready, and ten times a second."""
            begun = time.monotonic()
            try:
                wanted = next(work)
                while time.monotonic() < min(
                    begun + STATEMENT_TIMEOUT, max(begun + CLOSING_WAIT_MIN, waits_end())
                ):
                    wanted = work.send((yield wanted))
            except StopIteration as end:
                result: T = end.value
                return result
            self.close()
            waited = time.monotonic() - begun
            raise _libraries()[0].OperationalError(f"no response in {waited:.3g} s")

    return Connection
