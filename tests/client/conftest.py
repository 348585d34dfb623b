"""Both event loops, a cache, clients that have found a vehicle, and tasks beside a test."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import anyio.abc
import pytest

from paramclient import Component, ParamCache, ParamClient
from paramclient.cache import CachedComponent
from tests.cable import TIMEOUT
from tests.shell import a_client


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where a cache may be: neither the file nor its folder exists yet."""
    return tmp_path / "cache" / "parameters.sqlite3"


@asynccontextmanager
async def beside() -> AsyncIterator[anyio.abc.TaskGroup]:
    """Tasks beside the test, which end with it."""
    with anyio.fail_after(TIMEOUT):
        async with anyio.create_task_group() as tasks:
            yield tasks
            tasks.cancel_scope.cancel()


@asynccontextmanager
async def connected(link: Any, **options: Any) -> AsyncIterator[tuple[ParamClient, Component]]:
    """A client, without a cache unless one is given, and the first autopilot."""
    async with a_client(link, **options) as client:
        yield client, await client.component()


@asynccontextmanager
async def fetched(link: Any, **options: Any) -> AsyncIterator[tuple[ParamClient, Component]]:
    """A client, and the first autopilot with its whole table; see `connected`."""
    async with connected(link, **options) as (client, component):
        await component.fetch_all()
        yield client, component


def table_in(path: Path, *key: Any, **which: Any) -> CachedComponent:
    """A table of a cache that is not open; see `ParamCache.component`."""
    with ParamCache(path) as cache:
        return cache.component(*key, **which)
