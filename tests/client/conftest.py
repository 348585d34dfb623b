"""Both event loops, and tasks beside a test."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
import anyio.abc
import pytest

from tests.cable import TIMEOUT


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@asynccontextmanager
async def beside() -> AsyncIterator[anyio.abc.TaskGroup]:
    """Tasks beside the test, which end with it."""
    with anyio.fail_after(TIMEOUT):
        async with anyio.create_task_group() as tasks:
            yield tasks
            tasks.cancel_scope.cancel()
