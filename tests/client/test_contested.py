"""Two vehicles under one address of a link: the client, the cache and the command."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import pytest
from paramclient.protocol.vehicle.presence import LOST_AFTER

from paramclient import (
    AmbiguousVehicle,
    Contested,
    ContestedAddress,
    NoReply,
    ParamCache,
    ParamClient,
    Uncontested,
)
from paramclient.client import cache_writer
from paramclient.links import create_link, serve_endpoint
from paramclient.links.udp import UdpIn
from paramclient.sim import ArduPilotVehicle, Endpoint, GenericVehicle, PX4Vehicle
from paramclient.wire import messages
from tests.commands import Command, behind, in_process, leaping
from tests.shell import Late, PeersLink, in_simulated_time, outcome, until
from tests.simulation import param_value

TABLE: dict[str, Any] = {"SHARED_A": 1, "SHARED_B": 2, "PX4_ONLY": 3}
OTHER: dict[str, Any] = {"SHARED_A": 100.0, "SHARED_B": 200.0, "APM_ONLY": 300.0}

px4 = partial(PX4Vehicle, table=TABLE)
ardupilot = partial(ArduPilotVehicle, table=OTHER, ftp=False)


def two(*, first: Endpoint | None = None, by: float = 0.0, until: float = 1e9) -> PeersLink:
    """A PX4 and an ArduPilot, both system 1, at two peers of one link."""
    return PeersLink({("10.0.0.1", 14550): first or px4(), ("10.0.0.2", 14550): Late(ardupilot(), by, until)})


def cached(path: Path) -> dict[str, dict[str, float]]:
    """Every table in a cache, by its vehicle."""
    with ParamCache(path) as cache:
        return {
            vehicle.identity.key: {name: float(p.value) for name, p in table.params.items()}
            for vehicle in cache.vehicles()
            for table in [cache.load(vehicle.identity.key, 1)]
            if table is not None
        }


def lines(path: Path) -> list[Any]:
    """Every line of history."""
    with ParamCache(path) as cache:
        return [line for each in cache.vehicles() for line in cache.history(vehicle=each.identity.key)]


@in_simulated_time
async def test_no_mixed_table_and_no_false_line_reaches_the_cache(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "cache.sqlite3"
    async with ParamClient(two(), cache=path) as client:
        events = client.events()
        vehicle = await client.component()
        await outcome(vehicle.fetch_all(timeout=10.0))
        await anyio.sleep(3.0)
        assert vehicle.contest is not None
        assert vehicle.state == "contested"
        calls: list[Callable[[], Any]] = [
            lambda: vehicle.fetch_all(),
            lambda: vehicle.get("SHARED_A"),
            lambda: vehicle.set("SHARED_A", 5),
            lambda: vehicle.set("SHARED_A", 5, durable=True),
            lambda: vehicle.reboot(),
            lambda: client.ftp(vehicle).read("@PARAM/param.pck"),
        ]
        for call in calls:
            with pytest.raises(ContestedAddress) as caught:
                await call()
            assert (caught.value.system, caught.value.component) == (1, 1)
            assert len(caught.value.claimants) == 2
        reported = [await anext(events) for _ in range(2)]
        assert isinstance(reported[1], Contested)
        assert reported[1].contest == vehicle.contest
    whole = [set(TABLE), set(OTHER)]
    for table in cached(path).values():
        assert set(table) in whole, "no table of both"
        assert table in ({name: float(value) for name, value in each.items()} for each in (TABLE, OTHER))
    assert lines(path) == []
    [warning] = [each for each in caplog.records if each.levelno >= logging.WARNING]
    text = warning.getMessage()
    for said in ("1/1", "PX4 quadrotor", "10.0.0.1:14550", "ArduPilot quadrotor", "10.0.0.2:14550"):
        assert said in text


@in_simulated_time
async def test_values_received_in_a_contest_through_one_peer_are_not_cached(tmp_path: Path) -> None:
    """Both vehicles behind one radio, with values of both in the table before they are distinguished."""
    path = tmp_path / "cache.sqlite3"
    link = PeersLink({"radio": px4(), "radio ": Late(ardupilot(), 6.0, 20.0)})
    link_receive = link.receive

    async def through_one_peer() -> Any:
        return [("radio", data) for _, data in await link_receive()]

    link.receive = through_one_peer  # type: ignore[method-assign]
    async with ParamClient(link, cache=path) as client:
        vehicle = await client.component()
        await vehicle.fetch_all()
        await vehicle.set("SHARED_A", 7)
        await anyio.sleep(4.0)  # all of that is written by now
        before = cached(path)
        written = len(lines(path))
        await until(lambda: vehicle.contest is not None)
        with pytest.raises(ContestedAddress):
            await vehicle.set("SHARED_A", 8)
        await anyio.sleep(1.0)
        assert cached(path) == before
        await until(lambda: vehicle.contest is None)
        await anyio.sleep(1.0)
        assert (await vehicle.fetch_all()).params["SHARED_A"].value == 7
        assert set(vehicle.params) == set(TABLE)
    assert cached(path) == before
    assert len(lines(path)) == written


@in_simulated_time
async def test_when_one_is_silent_the_other_is_identified_anew_and_written_again(tmp_path: Path) -> None:
    path = tmp_path / "cache.sqlite3"
    async with ParamClient(two(by=2.0, until=8.0), cache=path) as client:
        events = client.events()
        vehicle = await client.component()
        await vehicle.fetch_all()
        await until(lambda: vehicle.contest is not None)
        began = anyio.current_time()
        await until(lambda: vehicle.contest is None)
        assert anyio.current_time() - began < 8.0 + LOST_AFTER
        reported = [await anext(events) for _ in range(3)]
        assert [type(each) for each in reported][1:] == [Contested, Uncontested]
        assert (await vehicle.set("SHARED_A", 9)).actual == 9
        await anyio.sleep(2 * cache_writer.CACHE_FLUSH_INTERVAL)
    [table] = cached(path).values()
    assert table == {"SHARED_A": 9.0, "SHARED_B": 2.0, "PX4_ONLY": 3.0}


@in_simulated_time
async def test_closing_in_a_contest_writes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "cache.sqlite3"
    for table in (TABLE, {**TABLE, "SHARED_A": 50}):
        async with ParamClient(two(first=px4(table=table)), cache=path) as client:
            vehicle = await client.component()
            await until(lambda: vehicle.contest is not None)  # noqa: B023 - awaited at once
    assert lines(path) == []


def test_the_command_says_so_on_stderr(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = "udpin:0.0.0.0:14550"
    leaping(monkeypatch)
    put = behind(monkeypatch, url)
    command: Command = in_process(capsys, "--cache", str(tmp_path / "cache.sqlite3"))
    put(two())
    done = command("set", url, "SHARED_A", "5")
    assert done.code == 1
    assert "not tried" in done.out
    for peer in ("10.0.0.1:14550", "10.0.0.2:14550"):
        assert peer in done.err


@in_simulated_time
async def test_a_fetch_of_all_vehicles_goes_on_without_the_contested_one() -> None:
    link = two()
    link.endpoints["10.0.0.3", 14550] = px4(system=3)
    async with ParamClient(link, cache=False) as client:
        await until(lambda: client.components.get((1, 1)) and client.components[1, 1].contest)
        everything = await client.fetch_all()
        assert [*everything.results] == [(3, 1)]
        assert isinstance(everything.silent[1, 1], ContestedAddress)
        with pytest.raises(ContestedAddress):
            await client.fetch_all(1)


# One after the other


class Reporting(Late):
    """A vehicle without a hardware id that sends the value 99 of A twice a second."""

    def __init__(self, by: float, until: float) -> None:
        super().__init__(GenericVehicle(table={"A": 99.0, "B": 2.0}, uid=0), by, until)
        self._report_at = 0.0
        self._out: list[bytes] = []

    def tick(self, now: float) -> None:
        super().tick(now)
        if self._on_at <= now < self._off_at and now >= self._report_at:
            self._report_at = now + 0.5
            value = param_value("A", 99.0, index=0, count=2)
            self._out.append(messages.encode(value, system=1, component=1, sequence=0))

    def next_deadline(self) -> float | None:
        deadline = super().next_deadline()
        return None if deadline is None else min(deadline, max(self._report_at, self._on_at))

    def data_to_send(self) -> list[bytes]:
        out, self._out = self._out, []
        return super().data_to_send() + out


@in_simulated_time
@pytest.mark.parametrize("stays", [4.0, 40.0])
async def test_one_without_a_hardware_id_in_place_of_a_vehicle_leaves_nothing_with_it(
    tmp_path: Path, stays: float
) -> None:
    """It speaks while the vehicle is silent, for so many seconds, and has the same names."""
    path = tmp_path / "cache.sqlite3"
    table: dict[str, Any] = {"A": 1.0, "B": 2.0}
    link = PeersLink(
        {
            ("10.0.0.1", 14550): Late(GenericVehicle(table=table, uid=5), 0.0, 8.0),
            ("10.0.0.2", 14550): Reporting(8.5, 8.5 + stays),
            ("10.0.0.3", 14550): Late(GenericVehicle(table=table, uid=5), 9.5 + stays),
        }
    )
    async with ParamClient(link, cache=path) as client:
        vehicle = await client.component()
        await vehicle.fetch_all()
        for _ in range(30):
            await anyio.sleep(0.5)
            held = vehicle.params.get("A")
            assert held is None or vehicle.identity.uid is None or held.value == 1.0
        if stays > 10.0:
            assert vehicle.identity.uid is None
            assert (await vehicle.set("B", 7.0)).status == "accepted"
            assert (await vehicle.get("A")).value == 99.0
        await until(lambda: vehicle.identity.uid == f"{5:016x}" and vehicle.peer.startswith("10.0.0.3"))
        assert (await vehicle.fetch_all()).params["A"].value == 1.0
        await anyio.sleep(2 * cache_writer.CACHE_FLUSH_INTERVAL)
    tables = cached(path)
    assert tables[f"uid:{5:016x}"] == table
    assert [line.name for line in lines(path)] == (["B"] if stays > 10.0 else []), "its own alone"


# Kept apart


@in_simulated_time
async def test_split_peers_have_components_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "cache.sqlite3"
    first, second = px4(), ardupilot()
    link = PeersLink({("10.0.0.1", 14550): first, ("10.0.0.2", 14550): second})
    async with ParamClient(link, cache=path, split_peers=True) as client:
        with pytest.raises(AmbiguousVehicle, match="Choose one with the argument peer") as caught:
            await client.only_component()
        assert caught.value.vehicles == (
            "1/1 PX4 quadrotor at 10.0.0.1:14550",
            "1/1 ArduPilot quadrotor at 10.0.0.2:14550",
        )
        one = await client.only_component(peer="10.0.0.1")
        other = await client.component(1, 1, peer="10.0.0.2:14550")
        assert (one.peer, other.peer) == ("10.0.0.1:14550", "10.0.0.2:14550")
        assert one.address != other.address
        assert [(system, number) for system, number in client.components] == [(1, 1)] * 2
        assert client.components[one.address] is one
        assert client.autopilots == [one, other]
        everything = await client.fetch_all()
        assert {len(each.params) for each in everything.results.values()} == {3}
        assert (await other.set("SHARED_A", 7)).actual == 7.0
        assert (first.requests["PARAM_SET"], second.requests["PARAM_SET"]) == (0, 1)
        assert (await one.get("SHARED_A")).value == 1
        await anyio.sleep(10.0)
        assert one.contest is None
        assert other.contest is None
        assert {*client.stats.round_trips} == {one.address, other.address}
        with pytest.raises(NoReply, match=r"at 10\.0\.0\.9"):
            await client.component(peer="10.0.0.9", timeout=0.5)
    assert {frozenset(table) for table in cached(path).values()} == {frozenset(TABLE), frozenset(OTHER)}


@in_simulated_time
async def test_split_vehicles_without_a_hardware_id_are_cached_by_their_peer(tmp_path: Path) -> None:
    path = tmp_path / "cache.sqlite3"
    tables: list[dict[str, Any]] = [{"A": 1.0, "B": 2.0}, {"A": 5.0, "B": 6.0}]
    vehicles = [GenericVehicle(table=table, uid=0) for table in tables]
    link = PeersLink({(f"10.0.0.{host}", 1): each for host, each in enumerate(vehicles)})
    async with ParamClient(link, cache=path, split_peers=True) as client:
        await until(lambda: len(client.components) == 2)
        await client.fetch_all()
        await anyio.sleep(10.0)
    assert sorted(cached(path).values(), key=lambda each: each["A"]) == tables
    assert lines(path) == []


@in_simulated_time
async def test_of_split_vehicles_that_say_to_be_one_the_first_is_cached(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As two simulated PX4 do, which all have one hardware id; and as a vehicle with a new port does."""
    path = tmp_path / "cache.sqlite3"
    first, second = Late(px4(), 0.0, 15.0), Late(px4(table={**TABLE, "SHARED_A": 50}), 2.0)
    link = PeersLink({("10.0.0.1", 14550): first, ("10.0.0.2", 14550): second})
    async with ParamClient(link, cache=path, split_peers=True) as client:
        await until(lambda: len(client.components) == 2)
        await client.fetch_all()
        await anyio.sleep(10.0)
        [table] = cached(path).values()
        assert table["SHARED_A"] == 1.0
        assert lines(path) == []
        [warning] = [each.getMessage() for each in caplog.records if each.levelno >= logging.WARNING]
        assert "10.0.0.2:14550 has the identity of the vehicle at 10.0.0.1:14550" in warning
        await until(lambda: client.components[next(iter(client.components))].state == "lost")
        await anyio.sleep(2.0)
        [table] = cached(path).values()
        assert table["SHARED_A"] == 50.0


@in_simulated_time
async def test_a_split_vehicle_is_followed_to_its_new_system_id() -> None:
    plane = ArduPilotVehicle(kind="plane", ftp=False)
    link = PeersLink({("10.0.0.1", 1): plane, ("10.0.0.2", 1): ArduPilotVehicle(system=7, ftp=False)})
    async with ParamClient(link, cache=False, split_peers=True) as client:
        vehicle = await client.component(peer="10.0.0.1")
        await outcome(vehicle.set("SYSID_THISMAV", 7))
        found = await client.successor(vehicle, 7)
        assert (found.system, found.peer) == (7, "10.0.0.1:1")


def test_two_autopilots_on_one_udp_port(tmp_path: Path) -> None:
    """Over sockets: two simulated vehicles that send to one port from two others."""
    path = tmp_path / "cache.sqlite3"

    async def main() -> None:
        vehicles = (px4(), ardupilot())
        async with ParamClient("udpin:127.0.0.1:0", cache=path) as client, anyio.create_task_group() as tasks:
            assert isinstance(client.link, UdpIn)
            assert client.link.address is not None
            name = f"udpout:127.0.0.1:{client.link.address[1]}"
            for vehicle in vehicles:
                await tasks.start(serve_endpoint, vehicle, create_link(name))
            component = await client.component()
            await outcome(component.fetch_all(timeout=3.0))
            await until(lambda: component.contest is not None)
            with pytest.raises(ContestedAddress):
                await component.set("SHARED_A", 5)
            assert [vehicle.requests["PARAM_SET"] for vehicle in vehicles] == [0, 0]
            tasks.cancel_scope.cancel()

    anyio.run(main)
    for table in cached(path).values():
        assert set(table) in (set(TABLE), set(OTHER))
    assert lines(path) == []
