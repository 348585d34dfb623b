"""Other stations on the same link, and other programs with the same cache: all get along."""

from __future__ import annotations

import itertools
import math
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import anyio
import pytest
from paramclient.protocol.params.fetch import Fetch

from paramclient import ParamCache
from paramclient.model.values import ParamType
from paramclient.protocol.station import Station
from paramclient.sim import Air, OtherStation, PX4Vehicle, SimParam, Vehicle
from paramclient.wire import messages
from paramclient.wire.messages import ParamRequestList
from tests.simulation import Simulation, listing_ardupilot

Make = Callable[[], Vehicle]
KINDS: dict[str, Make] = {"px4": PX4Vehicle, "ardupilot": listing_ardupilot}


class Shared:
    """Two stations with paramclient on one air: both receive all messages, and neither receives those of the
    other."""

    def __init__(self, vehicle: Vehicle, **faults: float) -> None:
        self.vehicle = vehicle
        self.air = Air.symmetric([vehicle], seed=3, **faults)  # type: ignore[arg-type]  # numbers, all of them
        self.stations = [Station(link="x", is_stream=False, system=system) for system in (255, 254)]
        self.now = 0.0
        self.air.tick(0.0)

    def run(self, until: Callable[[], bool], limit: float = 120.0) -> float:
        """Let time pass until something is so; what time it is then."""
        while not until():
            assert self.now < limit
            for station in self.stations:
                station.tick(self.now)
                for data, _ in station.data_to_send():
                    self.air.receive(data, self.now)
            ours = min(station.next_deadline() for station in self.stations)
            theirs = self.air.next_deadline()
            self.now = max(min(ours, math.inf if theirs is None else theirs), self.now + 1e-7)
            self.air.tick(self.now)
            for data in self.air.data_to_send():
                for station in self.stations:
                    station.receive(data, None, self.now)
        return self.now

    def meet(self) -> None:
        """Wait until both know who the vehicle is."""
        self.run(lambda: all((1, 1) in each.components for each in self.stations))
        self.run(lambda: all(each.components[1, 1].identification.settled for each in self.stations))

    def fetch(self, number: int) -> Fetch:
        return self.stations[number].components[1, 1].begin_fetch(self.now)

    def is_right(self, fetch: Fetch) -> bool:
        result = fetch.result
        return (
            result is not None
            and result.complete
            and all(
                result.params[name].same_value(param)
                for name, param in self.vehicle.params.items()
                if name not in ("STAT_RUNTIME", "BARO1_GND_PRESS")  # they move by themselves
            )
        )


@pytest.mark.parametrize("kind", KINDS)
def test_two_fetches_of_two_stations_complete_with_packet_loss(kind: str) -> None:
    world = Shared(KINDS[kind](), loss=0.1, delay=0.01)
    world.meet()
    began = world.now
    first = world.fetch(0)
    world.run(lambda: world.now >= began + 0.5)
    second = world.fetch(1)
    world.run(lambda: first.done and second.done)
    assert world.is_right(first)
    assert world.is_right(second)


@pytest.mark.parametrize("kind", KINDS)
def test_values_requested_by_another_station_fill_the_table(kind: str) -> None:
    vehicle = KINDS[kind]()
    setting = SimParam("MC_ROLL_P" if kind == "px4" else "RTL_ALT", ParamType.REAL32, 7.5)
    world = Simulation(air=Air([vehicle], others=[OtherStation(list_every=4.0, sets=[(10.0, setting)])]))
    world.meet()
    world.run(6.0)
    params = world.machine.table.params
    assert params.keys() >= vehicle.params.keys()
    assert not world.sent_of(ParamRequestList)


def test_a_fetch_reads_what_a_stopped_list_of_another_station_lacks() -> None:
    world = Shared(PX4Vehicle(list_stops_at=500))
    world.meet()
    message = messages.encode(ParamRequestList(1, 1), system=253, component=190, sequence=0)
    world.air.receive(message, world.now)
    began = world.now
    world.run(lambda: world.now >= began + 0.3)
    fetch = world.fetch(1)
    world.run(lambda: fetch.done)
    assert world.is_right(fetch)


PROGRAM = """
import anyio, sys
from paramclient import ParamClient

async def main(port, cache, name, values):
    async with ParamClient(f"udpin:127.0.0.1:{port}", cache=cache) as client:
        async with anyio.create_task_group() as tasks:
            for system in (1, 2):
                tasks.start_soon(work, client, system, name, values)

async def work(client, system, name, values):
    vehicle = await client.component(system, timeout=30)
    result = await vehicle.fetch_all()
    assert result.complete, result
    for value in values.split(","):
        done = await vehicle.set(name, int(value))
        assert done.actual == int(value), done
    await anyio.sleep(0.5)

anyio.run(main, *sys.argv[1:])
"""


@pytest.mark.asyncio
async def test_two_programs_share_vehicles_and_a_cache(tmp_path: Path) -> None:
    """Both fetch and set at once; each vehicle speaks to both, as over mavlink-router."""
    path = tmp_path / "cache.sqlite3"
    table = [SimParam(f"P_{index:03}", ParamType.INT32, index) for index in range(300)]
    vehicles = [PX4Vehicle(system=system, table=table) for system in (1, 2)]
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for sock in sockets:
        sock.bind(("127.0.0.1", 0))
    ports = [sock.getsockname()[1] for sock in sockets]
    for sock in sockets:
        sock.close()
    router = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    router.bind(("127.0.0.1", 0))
    router.setblocking(False)

    async def route() -> None:
        """What a vehicle says goes to both programs, what they say to both vehicles."""
        while True:
            now = anyio.current_time()
            with suppress(BlockingIOError, ConnectionRefusedError):
                while True:
                    data = router.recv(65535)
                    for vehicle in vehicles:
                        vehicle.receive(data, now)
            for vehicle in vehicles:
                vehicle.tick(now)
                for data in vehicle.data_to_send():
                    for port in ports:
                        with suppress(ConnectionRefusedError):
                            router.sendto(data, ("127.0.0.1", port))
            await anyio.sleep(0.005)

    with router:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(route)
            async with anyio.create_task_group() as programs:
                for port, name, values in zip(ports, ("P_100", "P_200"), ("7,8,9", "17,18,19"), strict=True):
                    arguments = [sys.executable, "-c", PROGRAM, str(port), str(path), name, values]
                    programs.start_soon(partial(anyio.run_process, arguments, stderr=None))
            tasks.cancel_scope.cancel()
    with ParamCache(path) as cache:
        assert not cache.notes
        for vehicle in vehicles:
            cached = cache.component(system=vehicle.system)
            assert cached.complete
            assert {name: param.bits for name, param in cached.params.items()} == {
                name: param.bits for name, param in vehicle.params.items()
            }
            changes = [
                (line.name, line.old.value, line.new and line.new.value) for line in cache.history(cached.key)
            ]
            for name, before, after in (("P_100", 100, 9), ("P_200", 200, 19)):
                steps = [change[1:] for change in changes if change[0] == name]
                assert steps[0][0] == before
                assert steps[-1][1] == after
                assert all(one[1] == two[0] for one, two in itertools.pairwise(steps)), "nothing stands twice"
