"""The places of a cache: each test of the shared suite runs on a file and on a PostgreSQL database."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from paramclient.cache import ParamCache
from paramclient.cache.database import SCHEMA_VERSION
from tests.postgres import GIVEN, PROGRAMS, WHY_NONE, database_on, server

Open = Callable[[], ParamCache]
"""Opens the cache of a test once more, as another program would."""


@pytest.fixture(scope="session")
def postgres_url() -> Iterator[str]:
    """The URL of an empty PostgreSQL database."""
    if GIVEN is None and PROGRAMS is None:
        pytest.skip(WHY_NONE)
    with ExitStack() as stack:
        url = stack.enter_context(server()).url if GIVEN is None else GIVEN
        yield stack.enter_context(database_on(url))


@pytest.fixture(params=["sqlite", "postgres"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """Where a cache is: a file that does not exist yet, or an empty database."""
    if request.param == "sqlite":
        yield str(tmp_path / "cache" / "parameters.sqlite3")
        return
    url = request.getfixturevalue("postgres_url")
    yield url
    import psycopg

    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute(f"DROP SCHEMA IF EXISTS paramclient_{SCHEMA_VERSION} CASCADE".encode())


@pytest.fixture
def open_cache(place: str) -> Iterator[Open]:
    with ExitStack() as stack:
        yield lambda: stack.enter_context(ParamCache(place))


@pytest.fixture
def cache(open_cache: Open) -> ParamCache:
    return open_cache()
