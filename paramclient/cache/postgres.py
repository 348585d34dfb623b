"""The cache in a PostgreSQL database, which several stations share. Needs the extra `postgres`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar
from urllib.parse import quote

import psycopg
from psycopg.conninfo import conninfo_to_dict

from paramclient.cache.database import SCHEMA_VERSION, TABLES, Store, Transaction
from paramclient.errors import CacheError, UsageError

CONNECT_WAIT_MAX: Final = 5
"""Seconds for which a call waits for a new connection."""
SERVER_SILENCE_MAX: Final = 20
"""Seconds after which a server that does not respond counts as unreachable."""
RETRY_INTERVAL_MIN: Final = 0.25
"""Minimum seconds after a failed connection in which calls fail at once; otherwise as long as that took: each
call would wait for the connection."""

_SCHEMA: Final = f"paramclient_{SCHEMA_VERSION}"
_WRITE_LOCK: Final = 0x5041524D
"""Advisory lock of the writers: one write at a time, as in a file."""
_SYNTAX: Final = {"id": "BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY", "clustered": ""}
_OPTIONS: Final = {
    "connect_timeout": CONNECT_WAIT_MAX,
    "tcp_user_timeout": SERVER_SILENCE_MAX * 1000,
    "keepalives_idle": SERVER_SILENCE_MAX,
    "application_name": "paramclient",
}
_SECRETS: Final = ("password", "sslpassword")

T = TypeVar("T")


class PostgresStore(Store):
    """A cache in a database, over one connection, which is opened again after a loss. Each transaction is
    durable.

    The tables are in a schema of their own, which the first station creates; its role needs the privilege
    CREATE on the database.

    Args:
        url: the URL of the database.

    Raises:
        UsageError: the URL is not valid.
    """

    def __init__(self, url: str) -> None:
        try:
            given = {name: value for name, value in conninfo_to_dict(url).items() if value}
        except psycopg.Error:  # its text may have the password
            raise UsageError(
                "the URL of the database is not valid; its form is postgresql://USER@HOST:PORT/DATABASE, and"
                " characters of a password other than letters and digits are percent-encoded"
            ) from None
        super().__init__(_place(given))
        self._options: dict[str, Any] = _OPTIONS | given
        self._secrets = [str(given[name]) for name in _SECRETS if name in given]
        self._failure: tuple[float, str] | None = None
        self._is_new = False  # whether the last attempt has opened the connection

    def _transact(self, work: Callable[[Transaction], T], *, writing: bool, durable: bool) -> T:
        self._is_new = self._connection is None
        if self._is_new:
            self._connection = self._connect()
        connection = self._connection
        with connection.transaction():
            if writing:
                connection.execute("SELECT pg_advisory_xact_lock(%s)", (_WRITE_LOCK,))
            else:
                connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")
            return work(_Transaction(connection))

    def _recover(self, error: BaseException, *, writing: bool) -> None:
        if not isinstance(error, psycopg.Error):
            raise error
        if self._is_new or not isinstance(error, psycopg.OperationalError):
            raise self._error(error) from None
        # else the server may have been restarted since the last call

    def _connect(self) -> psycopg.Connection:
        if self._failure is not None and time.monotonic() < self._failure[0]:
            raise CacheError(self._failure[1])
        began = time.monotonic()
        try:
            connection = psycopg.connect(**self._options, autocommit=True)
        except psycopg.Error as error:
            now = time.monotonic()
            self._failure = (now + max(now - began, RETRY_INTERVAL_MIN), str(self._error(error)))
            raise
        self._failure = None
        try:
            connection.execute(f"SET statement_timeout = {SERVER_SILENCE_MAX * 1000}")
            connection.execute(f"SET search_path = {_SCHEMA}")
            self._create(connection)
        except BaseException:
            connection.close()
            raise
        return connection

    def _create(self, connection: psycopg.Connection) -> None:
        """Create the tables, unless they exist."""
        exists = "SELECT 1 FROM pg_namespace WHERE nspname = %s"
        if connection.execute(exists, (_SCHEMA,)).fetchone() is not None:
            return
        with connection.transaction():
            connection.execute("SELECT pg_advisory_xact_lock(%s)", (_WRITE_LOCK,))
            if connection.execute(exists, (_SCHEMA,)).fetchone() is None:
                connection.execute(f"CREATE SCHEMA {_SCHEMA}")
                for statement in TABLES:
                    connection.execute(statement.format(**_SYNTAX).encode())

    def _error(self, error: psycopg.Error) -> CacheError:
        """Return the error without the password."""
        lines = str(error).splitlines()
        text = " ".join(line.strip() for line in lines if "Is the server running" not in line)
        for secret in self._secrets:
            for each in {secret, quote(secret), quote(secret, safe="")}:
                text = text.replace(each, "***")
        return CacheError(f"the cache {self.place} cannot be used: {text}")


class _Transaction(Transaction):
    """A transaction of psycopg, which marks values by `%s`."""

    def __init__(self, connection: psycopg.Connection) -> None:
        super().__init__(connection, "%s")
        self._cursor = connection.cursor()

    def many(self, sql: str, rows: Sequence[Sequence[object]]) -> list[int]:
        """See `Transaction.many`. The rows are sent at once: each round trip would take time."""
        counts: list[int] = []
        if rows:
            self._cursor.executemany(self._marked(sql).encode(), rows, returning=True)
            counts.append(self._cursor.rowcount)
            while self._cursor.nextset():
                counts.append(self._cursor.rowcount)
        return counts


def _place(options: dict[str, Any]) -> str:
    """Return the URL without password and options."""
    user = f"{quote(str(options['user']))}@" if "user" in options else ""
    host = str(options.get("host") or options.get("hostaddr") or options.get("service") or "")
    database = quote(str(options.get("dbname") or options.get("user") or ""))
    if host.startswith("/"):  # the folder of a socket
        return f"postgresql://{user}/{database}?host={quote(host)}"
    port = f":{options['port']}" if "port" in options else ""
    return f"postgresql://{user}{quote(host, safe=':,[]')}{port}/{database}"
