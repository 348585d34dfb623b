"""The public face on both event loops that anyio knows, asyncio and trio, over every kind of link."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import pytest

from paramclient import Component, ParamClient, Progress
from paramclient.client import client as client_module
from paramclient.client import link_task
from paramclient.errors import LinkError
from paramclient.links import Link, create_link, serve_endpoint
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.sim import Air, ArduPilotVehicle, Vehicle
from paramclient.wire import messages
from tests.cable import TIMEOUT, Cable
from tests.client.conftest import beside, table_in
from tests.shell import Tap, a_client, bits, generic, residue, small_px4

pytestmark = pytest.mark.anyio

QUICK: dict[str, Any] = {"burst": 50, "period": 0.001}
"""A list that takes no time to speak of."""


@pytest.fixture(autouse=True)
def nothing_remains() -> Iterator[None]:
    """No thread of ours outlives its client."""
    yield
    assert [thread.name for thread in threading.enumerate() if "paramclient" in thread.name] == []


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


async def test_several_vehicles_are_fetched_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "LISTENING_TIME", 0.1)
    vehicles = [generic(system=system, **QUICK) for system in (1, 2, 3)]
    async with beside(), a_client(Air(vehicles)) as client:
        fetched = await client.fetch_all()
        assert set(fetched.results) == {(1, 1), (2, 1), (3, 1)}
        assert fetched.complete


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
