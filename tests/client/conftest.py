"""Both event loops, a cache, and tasks beside a test."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import anyio
import anyio.abc
import pytest

from tests.cable import TIMEOUT


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
