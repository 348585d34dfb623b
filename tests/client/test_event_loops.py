"""The public face on asyncio and on trio: over every kind of link, opened and closed in any way."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import anyio.abc
import anyio.lowlevel
import pytest

from paramclient import ClientClosed, Component, ParamClient, Progress, UsageError
from paramclient.client import core, link_task
from paramclient.errors import LinkError
from paramclient.links import Link, Peer, SimLink, create_link, serve_endpoint
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.sim import Air, ArduPilotVehicle, Endpoint, Vehicle
from paramclient.wire import messages
from tests.cable import TIMEOUT, Cable
from tests.client.conftest import beside, table_in
from tests.shell import Tap, a_client, bits, generic, residue, small_px4

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


async def test_a_serial_port_that_is_unplugged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_task, "RECONNECT_BACKOFF_MIN", 0.01)
    vehicle = generic(stream=True, **QUICK)
    with Cable(tmp_path) as cable:
        async with beside() as tasks, a_client(cable.link) as client:
            tasks.start_soon(partial(cable.carry, vehicle, rate=40_000.0))
            component = await client.component()
            cable.pull_out()
            with anyio.move_on_after(0):
                await component.get("PARAM_02")
            cable.plug_in()
            tasks.start_soon(partial(cable.carry, vehicle, rate=40_000.0))
            await everything(component, vehicle)


@pytest.mark.parametrize("link", ["udpin", "tcpin", "tcp"])
async def test_a_link_that_cannot_be_opened(link: str) -> None:
    """Not even a task remains: the error is raised unchanged, in no group."""
    taken = create_link("udpin:127.0.0.1:0" if link == "udpin" else "tcpin:127.0.0.1:0")
    await taken.open()
    port = port_of(taken)
    if link == "tcp":
        await taken.close()
    with pytest.raises(LinkError, match=r"in use by another link|refused"):
        async with a_client(f"{link}:127.0.0.1:{port}"):
            pass
    await taken.close()


@pytest.mark.parametrize("how", ["error", "scope"])
async def test_what_was_learnt_is_written_however_the_client_ends(how: str, tmp_path: Path) -> None:
    vehicle = small_px4(**QUICK)
    with anyio.fail_after(TIMEOUT), anyio.CancelScope() as scope, suppress(ZeroDivisionError):
        async with ParamClient(vehicle, cache=tmp_path / "cache") as client:
            await (await client.component()).fetch_all()
            if how == "error":
                raise ZeroDivisionError
            scope.cancel()
            await anyio.sleep_forever()
    assert scope.cancelled_caught == (how == "scope")
    assert bits(table_in(tmp_path / "cache", system=1).params) == bits(vehicle.params)


async def test_a_scope_around_a_client_has_the_file_closed_before_it_ends() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    tap = Tap(Air.symmetric([vehicle], delay=0.02))

    def cancel_in_the_file(progress: Progress) -> None:
        if progress.received > 0:
            assert vehicle.open_files
            scope.cancel()

    async with beside():
        with anyio.CancelScope() as scope:
            async with a_client(tap) as client:
                await (await client.component()).fetch_all(progress=cancel_in_the_file)
        assert scope.cancelled_caught
        assert not vehicle.open_files
        assert not residue(client.components[1, 1])
        *_, last = tap.messages(messages.FileTransfer)
        assert Packet.unpack(last.payload).opcode == Opcode.TERMINATE_SESSION
        async with a_client(tap) as client:
            again = await (await client.component()).fetch_all()
        assert again.source == "ftp"
        assert again.elapsed < 2.0, "a session that stays open is closed on board after 3 s"


ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def nothing_remains() -> Iterator[None]:
    """No task and no thread of ours outlives its client."""
    yield
    assert not core.running
    assert [thread.name for thread in threading.enumerate() if "paramclient" in thread.name] == []


class SlowLink(SimLink):
    """A link that opens when it is let.

    Attributes:
        may_open: lets it open.
        is_open: whether it is open.
    """

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


class FaultyLink(SimLink):
    """A link with a mistake in its program.

    Attributes:
        fails: makes the next read fail.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(endpoint, "tcp:faulty:5760")
        self.fails = anyio.Event()

    async def receive(self) -> list[tuple[Peer, bytes]]:
        await self.fails.wait()
        raise ZeroDivisionError("a mistake")


async def test_opened_used_and_closed_in_different_tasks() -> None:
    client = a_client(generic())
    async with beside():
        async with anyio.create_task_group() as opening:
            opening.start_soon(client.open)
        assert (await (await client.component()).get("PARAM_01")).value == 1
        async with anyio.create_task_group() as closing:
            for _ in range(3):
                closing.start_soon(client.aclose)
        assert " closed, " in repr(client)


async def test_a_cancel_scope_around_open_does_not_reach_the_client() -> None:
    client = a_client(generic())
    async with beside():
        with anyio.CancelScope() as scope:
            await client.open()
            scope.cancel()
        assert (await (await client.component()).get("PARAM_01")).value == 1
        await client.aclose()


@pytest.mark.parametrize("by", ["open", "async with"])
async def test_a_client_is_opened_only_once(by: str) -> None:
    client = a_client(generic())
    await client.aclose()  # of a client that is not open
    async with beside():
        if by == "open":
            await client.open()
        else:
            await client.__aenter__()
        for again in (client.open, client.__aenter__):
            with pytest.raises(UsageError, match="opened only once"):
                await again()
        assert (await (await client.component()).get("PARAM_01")).value == 1
        if by == "async with":
            await client.__aexit__(None, None, None)
            assert " closed, " in repr(client)
        await client.aclose()
        await client.aclose()
        with pytest.raises(UsageError, match="opened only once"):
            await client.open()


@pytest.mark.parametrize("how", ["cancelled", "aclose"])
async def test_opening_is_given_up(how: str) -> None:
    link = SlowLink(generic())
    client = a_client(link)
    async with beside() as tasks:
        if how == "cancelled":
            with anyio.CancelScope() as scope:
                tasks.start_soon(_when_it_waits, link, scope.cancel)
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


async def _when_it_waits(link: SlowLink, call: Callable[[], object]) -> None:
    """Call something when the link is waiting to be opened."""
    while not link.may_open.statistics().tasks_waiting:
        await anyio.lowlevel.checkpoint()
    call()


async def test_a_cancelled_aclose_closes_nevertheless(tmp_path: Path) -> None:
    vehicle = small_px4(burst=50, period=0.001)
    client = ParamClient(vehicle, cache=tmp_path / "cache")
    async with beside():
        await client.open()
        await (await client.component()).fetch_all()
        with anyio.CancelScope() as scope:
            scope.cancel()
            await client.aclose()
        assert scope.cancelled_caught
        assert not core.running
    assert len(table_in(tmp_path / "cache", system=1).params) == len(vehicle.params)


async def test_an_error_in_a_task_of_the_client_reaches_its_callers(caplog: pytest.LogCaptureFixture) -> None:
    link = FaultyLink(generic())
    client = a_client(link)
    async with beside():
        await client.open()
        link.fails.set()
        with caplog.at_level(logging.ERROR, "paramclient"), pytest.raises(ClientClosed) as waiting:
            await client.component(timeout=None)
        while core.running:
            await anyio.lowlevel.checkpoint()
        with pytest.raises(ClientClosed) as late:
            await client.component()
        with pytest.raises(ExceptionGroup) as closing:
            await client.aclose()
        await client.aclose()  # it was reported once
    assert closing.group_contains(ZeroDivisionError)
    assert late.value.__cause__ is waiting.value.__cause__ is closing.value
    assert [record.getMessage() for record in caplog.records] == [
        "tcp:faulty:5760: an unexpected error has ended the client"
    ]


LEFT_OPEN = """
import {loop} as loop
from paramclient import ParamClient
async def main():
    vehicle = await (await ParamClient("sim:px4").open()).component()
    await vehicle.fetch_all()
    await vehicle.set("MC_ROLL_P", 7.25)
loop.run({main})
"""


@pytest.mark.parametrize("loop", ["asyncio", "trio"])
def test_a_client_that_is_left_open_is_closed_with_the_event_loop(loop: str, tmp_path: Path) -> None:
    program = LEFT_OPEN.format(loop=loop, main="main()" if loop == "asyncio" else "main")
    assert run("-W", "error", "-c", program, cache=tmp_path) == ""
    assert "7.25" in run("-m", "paramclient", "show", "1", "MC_ROLL_P", cache=tmp_path)


TYPED = """
from paramclient import ParamClient
client = await ParamClient("sim:px4").open()
vehicle = await client.only_component()
await vehicle.fetch_all()
print("value", (await vehicle.get("MC_ROLL_P")).value)
await client.aclose()
print(client)
"""


@pytest.mark.parametrize("repl", ["asyncio", "trio"])
def test_typed_into_a_repl(repl: str, tmp_path: Path) -> None:
    printed = run("-m", repl, cache=tmp_path, typed=TYPED)
    assert "value 4.0" in printed
    assert "<ParamClient sim:px4 closed, 1 component>" in printed


def run(*arguments: str, cache: Path, typed: str = "") -> str:
    """What a Python program prints, with a cache of its own."""
    done = subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(cache)},
        input=typed,
        capture_output=True,
        encoding="utf-8",
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout
