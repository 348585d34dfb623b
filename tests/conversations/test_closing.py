"""A client that is closed, or whose link fails for good, ends the calls and the streams of other tasks."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import anyio
import pytest

from paramclient import ClientClosed, Component, LinkError, ParamClient
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from tests.conversations.virtual import run
from tests.shell import FlakyLink

BACKENDS = pytest.mark.parametrize("backend", ["trio", "asyncio"])
CALLS: dict[str, Callable[[Component], Awaitable[object]]] = {
    "settle": lambda component: component.set("MC_ROLL_P", 5.0, settle=60),
    "fetch": lambda component: component.fetch_all(refresh=True),
    "extended": lambda component: component.ext.fetch_all(),
    "reboot": lambda component: component.reboot(timeout=None),
}


@BACKENDS
@pytest.mark.parametrize("call", CALLS)
def test_closing_ends_a_call_of_another_task_at_once(call: str, backend: str) -> None:
    async def test() -> None:
        client = ParamClient(PX4Vehicle(burst=1, period=0.05), cache=False)
        errors: list[LinkError] = []

        async def wait(component: Component) -> None:
            try:
                await CALLS[call](component)
            except LinkError as error:
                errors.append(error)

        async with anyio.create_task_group() as tasks:
            await client.open()
            tasks.start_soon(wait, await client.component())
            await anyio.sleep(1.0)
            await client.aclose()
            closed_at = anyio.current_time()
        assert anyio.current_time() - closed_at < 0.1
        assert [type(error) for error in errors] == [ClientClosed]

    run(test, backend=backend)


@BACKENDS
def test_a_call_that_begins_while_a_file_is_closed_on_board_ends_too(backend: str) -> None:
    async def test() -> None:
        vehicle = ArduPilotVehicle()
        client = ParamClient(Air.symmetric([vehicle], delay=0.3), cache=False)
        errors: list[LinkError] = []

        async def fetch(component: Component) -> None:
            with pytest.raises(LinkError) as caught:
                await component.fetch_all()
            errors.append(caught.value)

        async with anyio.create_task_group() as tasks:
            await client.open()
            component = await client.component()
            tasks.start_soon(fetch, component)
            await anyio.sleep(1.3)
            tasks.start_soon(client.aclose)
            await anyio.sleep(0.01)
            tasks.start_soon(fetch, component.ext)
        assert [type(error) for error in errors] == [ClientClosed] * 2

    run(test, backend=backend)


@BACKENDS
def test_a_link_that_fails_for_good_ends_the_streams(backend: str) -> None:
    async def test() -> None:
        link = FlakyLink(PX4Vehicle())
        link.reconnects = False
        async with ParamClient(link, cache=False) as client:
            component = await client.component()
            events, changes = client.events(), component.changes()
            await link.drop()
            with anyio.fail_after(1.0):
                for stream in (events, changes):
                    with pytest.raises(LinkError, match="flaky"):
                        async for _ in stream:
                            pass

    run(test, backend=backend)
