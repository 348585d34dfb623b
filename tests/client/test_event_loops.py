"""The public face on asyncio and on trio: over every kind of link, opened and closed in any way."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from textwrap import indent
from typing import Any

import anyio
import anyio.abc
import anyio.lowlevel
import pytest

from paramclient import ClientClosed, Component, ParamClient, UsageError
from paramclient.client import core
from paramclient.links import Link, Peer, SimLink, create_link, serve_endpoint
from paramclient.sim import Endpoint, Vehicle
from tests.cable import TIMEOUT
from tests.client.conftest import beside, table_in
from tests.shell import a_client, bits, generic, small_px4

pytestmark = pytest.mark.anyio

QUICK: dict[str, Any] = {"burst": 50, "period": 0.001}
"""A list that takes no time to speak of."""


def port_of(link: Link) -> int:
    return int(link.address[1])  # type: ignore[attr-defined]  # a link over sockets, which is open


async def everything(component: Component, vehicle: Vehicle) -> None:
    """What most programs do."""
    assert (await component.fetch_all()).complete
    assert bits(component.params) == bits(vehicle.params)
    assert (await component.set("PARAM_01", 77)).status == "accepted"
    assert (await component.get("PARAM_01")).value == 77
    assert await component.get(2) == vehicle.param("PARAM_02")


@pytest.mark.parametrize(
    ("ours", "theirs"), [("udpout", "udpin"), ("tcp", "tcpin"), ("udpin", "udpout"), ("tcpin", "tcp")]
)
async def test_a_session_over_sockets(ours: str, theirs: str) -> None:
    vehicle = generic(stream="tcp" in ours, **QUICK)
    async with beside() as tasks:
        if theirs.endswith("in"):
            listening = create_link(f"{theirs}:127.0.0.1:0")
            await tasks.start(serve_endpoint, vehicle, listening)
            async with a_client(f"{ours}:127.0.0.1:{port_of(listening)}") as client:
                await everything(await client.component(), vehicle)
            return
        async with a_client(f"{ours}:127.0.0.1:0") as client, anyio.create_task_group() as serving:
            calling = create_link(f"{theirs}:127.0.0.1:{port_of(client.link)}")
            await serving.start(serve_endpoint, vehicle, calling)
            await everything(await client.component(), vehicle)
            serving.cancel_scope.cancel()


@pytest.mark.parametrize("how", ["error", "scope", "cancelled aclose"])
async def test_what_was_learnt_is_written_however_the_client_ends(how: str, tmp_path: Path) -> None:
    vehicle = small_px4(**QUICK)
    with anyio.fail_after(TIMEOUT), anyio.CancelScope() as scope, suppress(ZeroDivisionError):
        async with ParamClient(vehicle, cache=tmp_path / "cache") as client:
            await (await client.component()).fetch_all()
            if how == "error":
                raise ZeroDivisionError
            scope.cancel()
            if how == "scope":
                await anyio.sleep_forever()
            await client.aclose()
    assert scope.cancelled_caught == (how != "error")
    assert not core.running
    assert bits(table_in(tmp_path / "cache", system=1).params) == bits(vehicle.params)


ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def nothing_remains() -> Iterator[None]:
    """No task and no thread of ours outlives its client."""
    yield
    assert not core.running
    assert [thread.name for thread in threading.enumerate() if "paramclient" in thread.name] == []


async def test_a_client_is_opened_once_used_and_closed_in_any_tasks_and_scopes() -> None:
    client = a_client(generic())
    await client.aclose()  # of a client that is not open
    async with beside():
        async with anyio.create_task_group() as opening:
            opening.start_soon(client.open)
        for again in (client.open, client.__aenter__):
            with pytest.raises(UsageError, match="opened only once"):
                await again()
        assert (await (await client.component()).get("PARAM_01")).value == 1
        async with anyio.create_task_group() as closing:
            for _ in range(3):
                closing.start_soon(client.aclose)
        assert " closed, " in repr(client)
        with pytest.raises(UsageError, match="opened only once"):
            await client.open()
        client = a_client(generic())
        with anyio.CancelScope() as scope:
            await client.open()
            scope.cancel()
        assert (await (await client.component()).get("PARAM_01")).value == 1
        await client.aclose()


class SlowLink(SimLink):
    """A link that opens when the test lets it, and then fails by a mistake in its program."""

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(endpoint, "tcp:slow:5760")
        self.may_open = anyio.Event()
        self.is_open = False

    async def open(self) -> None:
        await self.may_open.wait()
        await super().open()
        self.is_open = True

    async def close(self) -> None:
        self.is_open = False
        await super().close()

    async def receive(self) -> list[tuple[Peer, bytes]]:
        raise ZeroDivisionError("a mistake")


@pytest.mark.parametrize("how", ["cancelled", "aclose"])
async def test_opening_is_given_up(how: str) -> None:
    link = SlowLink(generic())
    client = a_client(link)
    async with beside() as tasks:
        if how == "cancelled":
            with anyio.move_on_after(0.05) as scope:
                await client.open()
            assert scope.cancelled_caught
        else:
            tasks.start_soon(client.aclose)
            with pytest.raises(ClientClosed, match="while it was being opened"):
                await client.open()
        assert not core.running
        link.may_open.set()
        await client.aclose()
        with pytest.raises(ClientClosed):
            await client.component()
    assert not link.is_open


async def test_an_error_in_a_task_of_the_client_reaches_its_callers(caplog: pytest.LogCaptureFixture) -> None:
    link = SlowLink(generic())
    link.may_open.set()
    client = a_client(link)
    async with beside():
        await client.open()
        with caplog.at_level(logging.ERROR, "paramclient"), pytest.raises(ClientClosed) as waiting:
            await client.component(timeout=None)
        while core.running:
            await anyio.lowlevel.checkpoint()
        with pytest.raises(ExceptionGroup) as closing:
            await client.aclose()
        await client.aclose()  # it was reported once
    assert closing.group_contains(ZeroDivisionError)
    assert waiting.value.__cause__ is closing.value
    assert len(caplog.records) == 1


USE = """
client = await ParamClient("sim:px4").open()
vehicle = await client.only_component()
await vehicle.fetch_all()
print((await vehicle.set("MC_ROLL_P", 7.25)).actual)
"""
IMPORT = "from paramclient import ParamClient"


@pytest.mark.parametrize("loop", ["asyncio", "trio"])
@pytest.mark.parametrize("way", ["program", "typed"])
def test_a_client_of_a_program_that_leaves_it_open_and_of_a_repl(loop: str, way: str, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path)}
    main = "main()" if loop == "asyncio" else "main"
    program = f"import {loop}\n{IMPORT}\nasync def main():{indent(USE, '  ')}\n{loop}.run({main})"
    words = ("-m", loop) if way == "typed" else ("-W", "error", "-c", program)
    typed = f"{IMPORT}{USE}await client.aclose()\n"
    done = subprocess.run(
        [sys.executable, *words], env=environment, input=typed, capture_output=True, text=True, timeout=60
    )
    outcome = (done.returncode, "7.25" in done.stdout, "Traceback" in done.stderr)
    assert outcome == (0, True, False), done.stderr
    assert table_in(tmp_path / "paramclient/parameters.sqlite3").params["MC_ROLL_P"].value == 7.25
