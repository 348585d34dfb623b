"""The public face on both event loops that anyio knows, asyncio and trio, over every kind of link."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import anyio.abc
import anyio.lowlevel
import pytest

from paramclient import (
    AmbiguousVehicle,
    ClientClosed,
    Component,
    ParamCache,
    ParamClient,
    ParamSet,
    Progress,
    Signing,
    SigningKey,
    Trust,
    WrittenParam,
)
from paramclient.client import client as client_module
from paramclient.client import link_task
from paramclient.errors import LinkError
from paramclient.links import Link, create_link, serve_endpoint
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.protocol.identity import HEARTBEAT_WAIT
from paramclient.provision import apply, plan, restore
from paramclient.sim import Air, ArduPilotVehicle, Endpoint, Vehicle
from paramclient.wire import messages
from tests.cable import TIMEOUT, Cable
from tests.client.conftest import beside
from tests.shell import FlakyLink, Tap, a_client, bits, generic, residue, small_px4

pytestmark = pytest.mark.anyio

QUICK: dict[str, Any] = {"burst": 50, "period": 0.001}
"""A list that takes no time to speak of."""


@pytest.fixture(autouse=True)
def nothing_remains() -> Iterator[None]:
    """No thread of ours outlives its client."""
    yield
    assert [thread.name for thread in threading.enumerate() if "paramclient" in thread.name] == []


async def serve(
    vehicle: Endpoint,
    link: Link,
    scope: anyio.CancelScope,
    *,
    task_status: anyio.abc.TaskStatus[Link] = anyio.TASK_STATUS_IGNORED,
) -> None:
    """Run a vehicle on a link until a scope is cancelled."""
    with scope:
        await serve_endpoint(vehicle, link, task_status=task_status)


class Woken(Tap):
    """An endpoint that starts with the first received frame: no caller waits for its second heartbeat."""

    is_awake = False

    def receive(self, data: bytes, now: float) -> None:
        super().receive(data, now)
        self.is_awake = True

    def tick(self, now: float) -> None:
        if self.is_awake:
            super().tick(now)


def port_of(link: Link) -> int:
    return int(link.address[1])  # type: ignore[attr-defined]  # a link over sockets, which is open


async def everything(component: Component, vehicle: Vehicle) -> None:
    """What most programs do."""
    fetched = await component.fetch_all()
    assert fetched.complete
    assert bits(component.params) == bits(vehicle.params)
    assert (await component.set("PARAM_01", 77)).status == "accepted"
    assert (await component.get("PARAM_01")).value == 77
    assert (await component.get(2)).index == 2


# Links


@pytest.mark.parametrize("ours", ["udpout", "tcp"])
async def test_a_session_with_a_vehicle_that_listens(ours: str) -> None:
    vehicle = generic(stream=ours == "tcp", **QUICK)
    listening = create_link("udpin:127.0.0.1:0" if ours == "udpout" else "tcpin:127.0.0.1:0")
    async with beside() as tasks:
        await tasks.start(serve_endpoint, Woken(vehicle), listening)
        async with a_client(f"{ours}:127.0.0.1:{port_of(listening)}") as client:
            await everything(await client.component(), vehicle)


@pytest.mark.parametrize("ours", ["udpin", "tcpin"])
async def test_a_session_where_we_listen(ours: str) -> None:
    vehicle = generic(stream=ours == "tcpin", **QUICK)
    async with beside() as tasks, a_client(f"{ours}:127.0.0.1:0") as client:
        there = f"{'udpout' if ours == 'udpin' else 'tcp'}:127.0.0.1:{port_of(client.link)}"
        scope = anyio.CancelScope()
        await tasks.start(serve, vehicle, create_link(there), scope)
        await everything(await client.component(), vehicle)
        scope.cancel()


async def test_a_second_vehicle_is_looked_for() -> None:
    async with beside() as tasks, a_client("udpin:127.0.0.1:0") as client:
        there = f"udpout:127.0.0.1:{port_of(client.link)}"
        began = anyio.current_time()
        await tasks.start(serve_endpoint, generic(**QUICK), create_link(there))
        assert (await client.only_component()).system == 1
        assert anyio.current_time() - began >= HEARTBEAT_WAIT
        await tasks.start(serve_endpoint, generic(system=2, **QUICK), create_link(there))
        await client.component(2)
        with pytest.raises(AmbiguousVehicle, match="2 vehicles"):
            await client.only_component()
        assert (await client.only_component(2)).system == 2


async def test_a_tcp_connection_that_drops_is_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_task, "RECONNECT_BACKOFF_MIN", 0.01)
    vehicle, scope = generic(stream=True, **QUICK), anyio.CancelScope()
    listening = create_link("tcpin:127.0.0.1:0")
    async with beside() as tasks:
        await tasks.start(serve, Woken(vehicle), listening, scope)
        port = port_of(listening)
        async with a_client(f"tcp:127.0.0.1:{port}") as client:
            component = await client.component()
            scope.cancel()
            while " reconnecting, " not in repr(client):  # noqa: ASYNC110 - no event reports it
                await anyio.sleep(0.001)
            await tasks.start(serve_endpoint, vehicle, create_link(f"tcpin:127.0.0.1:{port}"))
            await everything(component, vehicle)


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


# The cache, and the three ways to a whole table


async def test_a_table_is_downloaded_by_list_and_then_taken_from_the_cache(tmp_path: Path) -> None:
    sources = []
    reported: list[Progress] = []
    with anyio.fail_after(TIMEOUT):
        for _ in range(2):
            vehicle = small_px4(**QUICK)
            async with ParamClient(vehicle, cache=tmp_path / "cache") as client:
                component = await client.component()
                result = await component.fetch_all(progress=reported.append)
                sources.append(result.source)
                assert bits(component.params) == bits(vehicle.params)
    assert sources == ["stream", "cache"]
    assert reported
    assert component.params["PARAM_01"].trust is Trust.VERIFIED
    with ParamCache(tmp_path / "cache") as cache:
        assert bits(cache.component(system=1).params) == bits(vehicle.params)


async def test_a_table_is_served_as_a_file_and_files_are_read() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    async with beside(), a_client(vehicle) as client:
        component = await client.component()
        result = await component.fetch_all()
        assert (result.source, result.complete) == ("ftp", True)
        data = await component.read_file("@PARAM/param.pck")
        assert data


async def test_several_vehicles_are_fetched_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "LISTENING_TIME", 0.1)
    vehicles = [generic(system=system, **QUICK) for system in (1, 2, 3)]
    async with beside(), a_client(Air(vehicles)) as client:
        fetched = await client.fetch_all()
        assert set(fetched.results) == {(1, 1), (2, 1), (3, 1)}
        assert fetched.complete


async def test_a_vehicle_is_set_up_and_put_back() -> None:
    wanted = ParamSet({name: WrittenParam(name, 7) for name in ("PARAM_01", "PARAM_02", "PARAM_04")})
    vehicle = generic(**QUICK)
    before = bits(vehicle.params)
    async with beside(), a_client(vehicle) as client:
        component = await client.component()
        done = await apply(component, wanted)
        assert done.complete
        assert {vehicle.params[name].value for name in wanted} == {7}
        assert (await plan(component, wanted)).complete
        assert done.before is not None
        await restore(component, done.before)
        assert bits(vehicle.params) == before


async def test_a_link_whose_bytes_are_signed() -> None:
    signing = Signing(SigningKey.from_passphrase("a key"))
    vehicle = small_px4(signing_key=signing.key, **QUICK)
    async with beside(), a_client(vehicle, signing=signing) as client:
        await everything(await client.component(), vehicle)


# Reports


async def test_a_reboot_is_reported_to_listeners() -> None:
    seen: list[str] = []
    async with beside(), a_client(generic(reboot_down=0.05, **QUICK)) as client:
        events = client.events()
        component = await client.component()
        assert await component.reboot() is component
        while "rebooted" not in seen:
            seen.append((await anext(events)).kind)
    assert seen[0] == "discovered"


# Ends


async def test_calls_that_are_cancelled_leave_nothing() -> None:
    tap = Tap(generic(**QUICK))
    async with beside(), a_client(tap) as client:
        component = await client.component()
        tap.is_deaf = True
        for call in (
            partial(component.get, "PARAM_01"),
            partial(component.set, "PARAM_01", 3),
            component.fetch_all,
            component.reboot,
            partial(client.component, 99),
            partial(component.read_file, "/a"),
        ):
            with anyio.move_on_after(0.01) as scope:
                await call()
            assert scope.cancelled_caught
            assert residue(component) == []
            with pytest.raises(TimeoutError), anyio.fail_after(0):
                await call()
        tap.is_deaf = False
        assert (await component.get("PARAM_02")).value == 2


async def test_calls_that_wait_end_with_the_client() -> None:
    tap = Tap(generic(**QUICK))
    endings: list[str] = []

    async def wait(component: Component) -> None:
        try:
            await component.get("PARAM_01")
        except LinkError as error:
            endings.append(type(error).__name__)

    async with beside() as tasks:
        async with a_client(tap) as client:
            component = await client.component()
            tap.is_deaf = True
            for _ in range(3):
                tasks.start_soon(wait, component)
            await anyio.sleep(0.01)
        with pytest.raises(ClientClosed):
            await component.get("PARAM_01")
        while len(endings) < 3:  # noqa: ASYNC110 - no event reports it
            await anyio.sleep(0.001)
    assert endings == ["ClientClosed"] * 3


async def test_an_exception_of_the_body_is_raised_unchanged_and_the_cache_is_written(tmp_path: Path) -> None:
    vehicle = small_px4(**QUICK)
    with pytest.raises(ZeroDivisionError), anyio.fail_after(TIMEOUT):  # noqa: PT012 - the body is what counts
        async with ParamClient(vehicle, cache=tmp_path / "cache") as client:
            await (await client.component()).fetch_all()
            _ = 1 / 0
    with ParamCache(tmp_path / "cache") as cache:
        assert len(cache.component(system=1).params) == len(vehicle.params)


async def test_a_client_that_is_cancelled_writes_what_it_has_learnt(tmp_path: Path) -> None:
    vehicle = small_px4(**QUICK)
    with anyio.fail_after(TIMEOUT), anyio.CancelScope() as scope:
        async with ParamClient(vehicle, cache=tmp_path / "cache") as client:
            await (await client.component()).fetch_all()
            scope.cancel()
            await anyio.sleep_forever()
    assert scope.cancelled_caught
    with ParamCache(tmp_path / "cache") as cache:
        assert len(cache.component(system=1).params) == len(vehicle.params)


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


async def test_a_link_that_fails_reaches_everyone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(link_task, "LINK_TIMEOUT", 0.05)
    monkeypatch.setattr(link_task, "RECONNECT_BACKOFF_MIN", 0.01)
    link = FlakyLink(generic(**QUICK))
    async with beside(), a_client(link) as client:
        component = await client.component()
        await link.drop(stays_offline=True)
        with caplog.at_level(logging.ERROR), pytest.raises(LinkError, match="refused"):
            await component.get("PARAM_01")
        link.is_offline = False
        while " open, " not in repr(client):  # noqa: ASYNC110 - no event reports it
            await anyio.sleep(0.001)
        assert (await component.get("PARAM_01")).value == 1
