"""Every public call, cancelled at every point: nothing of it is left, and the next call works.

A call is cancelled after each round of the event loop in turn: before or after what it waits for has
arrived, and in each state of the protocol below.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from itertools import count
from pathlib import Path
from typing import Any

import anyio
import pytest

from paramclient import Component, ParamClient
from paramclient.sim import Air, PX4Vehicle
from paramclient.wire import messages
from tests import shell
from tests.caches import set_aside
from tests.client.conftest import fetched, table_in

Call = Callable[[ParamClient, Component], Coroutine[Any, Any, object]]

FEW_VALUES = {name: shell.VALUES[name] for name in list(shell.VALUES)[:8]}
fresh = count(1000)

POINTS_MAX = 1000
"""None of these calls has as many rounds: a test that gets here cancels nothing."""


async def first_change(client: ParamClient, component: Component) -> object:
    """A change that another call brings about."""
    changes = component.changes()
    writing = asyncio.create_task(component.set("PARAM_02", next(fresh)))
    try:
        return await anext(changes)
    finally:
        writing.cancel()
        await asyncio.wait([writing])


CALLS: dict[str, Call] = {
    "get": lambda client, component: component.get("PARAM_01"),
    "get by index": lambda client, component: component.get(5, timeout=9),
    "set": lambda client, component: component.set("PARAM_01", 77),
    "set_many": lambda client, component: component.set_many(dict.fromkeys(FEW_VALUES, 7), progress=seen),
    "set_many in order": lambda client, component: component.set_many([("PARAM_01", 1), ("PARAM_01", 2)]),
    "fetch_all": lambda client, component: component.fetch_all(),
    "fetch_all anew": lambda client, component: component.fetch_all(refresh=True, timeout=9, progress=seen),
    "changes": first_change,
    "component": lambda client, component: client.component(system=2),
    "fetch_all of everyone": lambda client, component: client.fetch_all(),
    "fetch_all of a system": lambda client, component: client.fetch_all(1),
}


def seen(progress: object) -> None:
    return


@asynccontextmanager
async def a_session() -> AsyncIterator[tuple[ParamClient, Component]]:
    """A client that has just found a vehicle with a camera; another one is found a little later."""
    late = shell.generic(system=2, table=FEW_VALUES)
    late.reboot(shell.simulated_time_loop().time(), down=0.03)
    camera = shell.generic(component=100, table=FEW_VALUES, autopilot=messages.MAV_AUTOPILOT_INVALID)
    vehicle = PX4Vehicle(table={**FEW_VALUES, "CAL_ACC0_XOFF": 0.5}, burst=3)
    async with shell.a_client(Air.symmetric([vehicle, camera, late], delay=0.004)) as client:
        yield client, await client.component()


def is_idle(client: ParamClient) -> bool:
    """Whether nothing is registered in any component."""
    return not any(shell.residue(each) for each in client.components.values())


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
@pytest.mark.parametrize("how", ["task", "scope"])
async def test_cancelled_at_each_point(call: Call, how: str) -> None:
    loop = shell.simulated_time_loop()
    for number in range(1, POINTS_MAX):
        async with a_session() as (client, component):
            before, scope = shell.tasks_beside(), anyio.CancelScope()

            async def scoped() -> None:
                with scope:  # noqa: B023 - it has ended before the next one is made
                    await call(client, component)

            task = asyncio.create_task(scoped())
            loop.run_between_rounds(task, scope.cancel if how == "scope" else task.cancel, after=number)
            await asyncio.wait([task])
            is_struck = loop.has_run_action
            # a task that goes on already leaves its scope without another look at it
            was_cancelled = task.cancelled() or scope.cancelled_caught
            assert was_cancelled == is_struck or (how == "scope" and not was_cancelled)
            await shell.settled()
            assert shell.tasks_beside() == before
            assert is_idle(client)
            await call(client, component)  # it can be made again
            await shell.settled()
            assert is_idle(client)
            await asyncio.sleep(0.5)
            assert is_idle(client)
        assert not shell.tasks_beside()
        if not is_struck:
            break
    assert 1 < number < POINTS_MAX - 1


async def test_a_whole_session_cancelled_at_each_point(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    vehicle = shell.small_px4()
    loop = shell.simulated_time_loop()

    async def session() -> None:
        async with fetched(vehicle, cache=path) as (_, component):
            await component.set("PARAM_01", number)
            await asyncio.sleep(0.3)

    for number in range(1, POINTS_MAX):
        task = asyncio.create_task(session())
        loop.run_between_rounds(task, task.cancel, after=number)
        await asyncio.wait([task])
        assert task.cancelled() == loop.has_run_action
        await shell.settled()
        assert not shell.tasks_beside()
        await shell.until(lambda: not any(each.name == "paramclient cache" for each in threading.enumerate()))
        if not loop.has_run_action:
            break
    assert 5 < number < POINTS_MAX - 1
    cached = table_in(path)
    assert shell.bits(cached.params) == shell.bits(vehicle.params)
    assert cached.hash == vehicle.announced_hash()
    assert not set_aside(path)
