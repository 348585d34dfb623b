"""Every public call, cancelled at every point: nothing of it is left, and the next call works.

Two ways lead to every point. One cancels a call at each of its own suspensions, before or after what it
waits for has arrived. The other lets it wait and cancels it after each round of the event loop, which meets
the protocol below in each of its states.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Generator
from contextlib import asynccontextmanager
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any

import anyio
import pytest

from paramclient import Component, ParamClient
from paramclient.sim import Air, PX4Vehicle
from paramclient.wire import messages
from tests.caches import set_aside
from tests.client.conftest import connected, fetched, table_in
from tests.shell import (
    VALUES,
    FlakyLink,
    a_client,
    bits,
    generic,
    residue,
    settled,
    simulated_time_loop,
    small_px4,
    tasks_beside,
    until,
)

Call = Callable[[ParamClient, Component], Coroutine[Any, Any, object]]

FEW_VALUES = {name: VALUES[name] for name in list(VALUES)[:8]}
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
EVERY_CALL = pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)


def seen(progress: object) -> None:
    return


class Struck(Coroutine[Any, Any, Any]):
    """A coroutine whose task is cancelled at its suspension of this number, from 1.

    Args:
        inner: the coroutine.
        number: which suspension.
        late: strike only when what it waits for has arrived, and it would go on.

    Attributes:
        is_struck: whether it had so many.
    """

    def __init__(self, inner: Coroutine[Any, Any, Any], number: int, *, late: bool) -> None:
        self.is_struck = False
        self._inner = inner
        self._left = number
        self._late = late

    def __await__(self) -> Generator[Any, Any, Any]:
        raise NotImplementedError

    def send(self, value: Any) -> Any:
        return self._strike(self._inner.send(value))

    def throw(self, kind: Any, error: Any = None, trace: TracebackType | None = None) -> Any:
        return self._strike(self._inner.throw(kind, error, trace) if error else self._inner.throw(kind))

    def close(self) -> None:
        self._inner.close()

    def _strike(self, awaited: Any) -> Any:
        self._left -= 1
        if not self._left:
            self.is_struck = True
            task = asyncio.current_task()
            assert task is not None
            if self._late and asyncio.isfuture(awaited):
                awaited.add_done_callback(lambda _: task.cancel())
            else:
                task.cancel()
        return awaited


@asynccontextmanager
async def a_session() -> AsyncIterator[tuple[ParamClient, Component]]:
    """A client that has just found a vehicle with a camera; another one is found a little later."""
    late = generic(system=2, table=FEW_VALUES)
    late.reboot(simulated_time_loop().time(), down=0.03)
    camera = generic(component=100, table=FEW_VALUES, autopilot=messages.MAV_AUTOPILOT_INVALID)
    vehicle = PX4Vehicle(table={**FEW_VALUES, "CAL_ACC0_XOFF": 0.5}, burst=3)
    air = Air.symmetric([vehicle, camera, late], delay=0.004)
    async with a_client(air) as client:
        yield client, await client.component()


def is_idle(client: ParamClient) -> bool:
    """Whether nothing is registered in any component."""
    return not any(residue(each) for each in client.components.values())


async def check_after(call: Call, client: ParamClient, component: Component) -> None:
    """A call was cancelled: nothing is left, and it can be made again."""
    assert is_idle(client)
    await call(client, component)
    await settled()
    assert is_idle(client)
    await asyncio.sleep(0.5)
    assert is_idle(client)


@EVERY_CALL
@pytest.mark.parametrize("how", ["before", "after", "task", "scope"])
async def test_cancelled_at_each_point(call: Call, how: str) -> None:
    loop = simulated_time_loop()
    in_rounds = how in ("task", "scope")
    for number in range(1, POINTS_MAX):
        async with a_session() as (client, component):
            before, scope = tasks_beside(), anyio.CancelScope()

            async def scoped() -> None:
                with scope:  # noqa: B023 - it has ended before the next one is made
                    await call(client, component)

            struck = Struck(scoped(), 0 if in_rounds else number, late=how == "after")
            task = asyncio.create_task(struck)
            if in_rounds:
                loop.run_between_rounds(task, scope.cancel if how == "scope" else task.cancel, after=number)
            await asyncio.wait([task])
            is_struck = struck.is_struck or loop.has_run_action
            # a task that goes on already leaves its scope without another look at it
            was_cancelled = task.cancelled() or scope.cancelled_caught
            assert was_cancelled == is_struck or (how == "scope" and not was_cancelled)
            await settled()
            assert tasks_beside() == before
            await check_after(call, client, component)
        assert not tasks_beside()
        if not is_struck:
            break
    assert 1 < number < POINTS_MAX - 1


@EVERY_CALL
async def test_cancelled_while_the_link_is_disconnected(call: Call) -> None:
    link = FlakyLink(Air([small_px4(), generic(system=2)]))
    async with connected(link) as (client, component):
        await link.drop(stays_offline=True)
        task = asyncio.create_task(call(client, component))
        await asyncio.sleep(1.0)
        task.cancel()
        await asyncio.wait([task])
        assert is_idle(client)
        link.is_offline = False
        await asyncio.sleep(1.0)
        await check_after(call, client, component)


@pytest.mark.parametrize("point", ["before", "after", "round"])
async def test_a_whole_session_cancelled_at_each_point(tmp_path: Path, point: str) -> None:
    path = tmp_path / "cache"
    vehicle = small_px4()
    loop = simulated_time_loop()

    async def session() -> None:
        async with fetched(vehicle, cache=path) as (_, component):
            await component.set("PARAM_01", number)
            await asyncio.sleep(0.3)

    for number in range(1, POINTS_MAX):
        struck = Struck(session(), 0 if point == "round" else number, late=point == "after")
        task = asyncio.create_task(struck)
        if point == "round":
            loop.run_between_rounds(task, task.cancel, after=number)
        await asyncio.wait([task])
        is_struck = struck.is_struck or loop.has_run_action
        assert task.cancelled() == is_struck
        await settled()
        assert not tasks_beside()
        await until(lambda: not any(each.name == "paramclient cache" for each in threading.enumerate()))
        if not is_struck:
            break
    assert 5 < number < POINTS_MAX - 1
    cached = table_in(path)
    assert bits(cached.params) == bits(vehicle.params)
    assert cached.hash == vehicle.announced_hash()
    assert not set_aside(path)
