"""The files of a component, as users of the client see them."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Any

import anyio
import pytest

from paramclient import NoReply
from paramclient.sim import Air, ArduPilotVehicle
from tests.client.conftest import connected
from tests.shell import FlakyLink, outcome, tasks_beside

LOG = bytes(range(256)) * 200
"""A file of 51,200 bytes, which takes a second."""
FILES = {"/APM/LOGS/1.BIN": LOG, "/APM/a.txt": b"hello", "/APM/empty": b""}


def with_files(**options: Any) -> ArduPilotVehicle:
    vehicle = ArduPilotVehicle(live_period=0, **options)
    vehicle.files.update(FILES)
    return vehicle


async def test_a_time_limit_ends_a_read_and_closes_the_file() -> None:
    vehicle = with_files()
    async with connected(vehicle) as (_, component):
        began = anyio.current_time()
        with pytest.raises(NoReply, match=r"/APM/LOGS/1.BIN of 1/1"):
            await component.read_file("/APM/LOGS/1.BIN", timeout=0.3)
        assert anyio.current_time() - began < 1.41  # the vehicle ends its burst of a second before it closes
        await anyio.sleep(1.0)
        assert not vehicle.open_files


@pytest.mark.parametrize("how", ["timeout", "error", "task", "all tasks", "scope"])
async def test_a_client_leaves_no_file_open_at_whatever_moment_it_ends(how: str) -> None:
    """All tasks are cancelled, each for itself, by `asyncio.run` when its main task has ended."""
    requests = 0
    for step in range(1, 40):
        vehicle, seconds = ArduPilotVehicle(live_period=0), step / 100
        air = Air.symmetric([vehicle], delay=0.02)

        async def session(air: Air, seconds: float) -> None:
            with anyio.move_on_after(seconds if how == "scope" else None) as scope:
                async with connected(air) as (_, component):
                    if how == "error":
                        fetching = asyncio.ensure_future(outcome(component.fetch_all()))
                        await anyio.sleep(seconds)
                        assert not fetching.done()
                        raise RuntimeError("of the body")
                    with suppress(NoReply):
                        await component.fetch_all(timeout=seconds if how == "timeout" else None)
            assert scope.cancelled_caught == (how == "scope")

        task = asyncio.ensure_future(session(air, seconds))
        if how.endswith(("task", "tasks")):
            await anyio.sleep(seconds)
            for each in {task} if how == "task" else asyncio.all_tasks() - {asyncio.current_task()}:
                each.cancel()
        with anyio.fail_after(0.5 if how == "all tasks" else 5.0):
            await asyncio.wait([task])
        assert task.cancelled() == how.endswith(("task", "tasks"))
        assert task.cancelled() or bool(task.exception()) == (how == "error")
        assert not tasks_beside()
        if how == "all tasks":  # the vehicle ends its burst before it closes
            await anyio.sleep(1.0)
            air.tick(anyio.current_time())
        assert not vehicle.open_files
        requests += vehicle.requests["FILE_TRANSFER_PROTOCOL"]
    assert requests > 80


async def test_a_read_goes_on_when_the_link_is_back() -> None:
    link = FlakyLink(with_files())
    async with connected(link) as (_, component):
        reading = asyncio.ensure_future(component.read_file("/APM/LOGS/1.BIN"))
        await anyio.sleep(0.3)
        await link.drop()
        assert await reading == LOG
