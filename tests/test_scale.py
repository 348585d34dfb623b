"""Many vehicles on one link: nothing is done for all of them that one of them is the reason of."""

from __future__ import annotations

import inspect
import math
import time
from collections import Counter
from pathlib import Path

import pytest

from paramclient import ParamCache, ParamClient
from paramclient.cache import CachedComponent
from paramclient.protocol import station as station_room
from paramclient.protocol import wire
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.fetch import Fetch
from paramclient.protocol.station import Station
from paramclient.protocol.wire import MAV_AUTOPILOT_PX4, Heartbeat
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, SimParam, Vehicle
from paramclient.values import ParamType

MANY = 250
PX4 = Heartbeat(2, MAV_AUTOPILOT_PX4)


def hear(station: Station, system: int, now: float) -> None:
    frame = wire.encode(PX4, system=system, component=1, sequence=0)
    station.receive(frame, "peer", now)


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> Counter[int]:
    """How often the deadlines of each system were worked out."""
    looks: Counter[int] = Counter()
    whole = ComponentMachine.next_deadline

    def counted(machine: ComponentMachine) -> float:
        looks[machine.system] += 1
        return whole(machine)

    monkeypatch.setattr(ComponentMachine, "next_deadline", counted)
    return looks


def test_what_one_says_makes_nobody_look_at_the_others(looks: Counter[int]) -> None:
    station = Station(link="x", is_stream=False)
    for system in range(1, MANY + 1):
        hear(station, system, 0.0)
    station.tick(0.0)
    station.next_deadline()
    looks.clear()
    hear(station, 7, 0.1)
    station.tick(0.1, everyone=False)
    station.next_deadline(everyone=False)
    assert set(looks) == {7}
    assert looks[7] <= 3


def test_a_deadline_is_kept_whoever_was_looked_at_meanwhile() -> None:
    """Those who were asked who they are and say nothing are asked again in time."""
    station = Station(link="x", is_stream=False)
    for system in range(1, 11):
        hear(station, system, system / 100)
    station.tick(0.1, everyone=False)
    station.data_to_send()
    assert station.next_deadline(everyone=False) == 1.01  # our heartbeat came at 0.1
    asked: list[tuple[float, int]] = []
    now = 0.1
    while len(asked) < 10:
        now = station.next_deadline(everyone=False)
        station.tick(now, everyone=False)
        for data, _ in station.data_to_send():
            for frame in wire.Framer(wire.UNDERSTOOD, stream=False).receive(data):
                message = wire.decode(frame)
                if isinstance(message, wire.CommandLong):
                    asked.append((round(now, 3), message.target_system))
    assert asked == [(1 + system / 100, system) for system in range(1, 11)]


def test_what_was_asked_of_one_goes_out_when_it_was_touched() -> None:
    station = Station(link="x", is_stream=False)
    hear(station, 1, 0.0)
    hear(station, 2, 0.0)
    station.tick(0.0)
    station.next_deadline()
    machine = station.components[2, 1]
    for index in range(40):  # more than may go out at once
        machine.reads.ask(index, 0.0)
    station.touch(machine)
    assert station.next_deadline(everyone=False) == pytest.approx(machine.reads.pace.next_at())
    assert station.next_deadline(everyone=False) == station.next_deadline()


def test_who_was_forgotten_leaves_no_deadline_to_whoever_comes_in_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One that is lost makes room for another, and is asked for a parameter although it is gone."""
    monkeypatch.setattr(station_room, "MOST_COMPONENTS", 2)
    station = Station(link="x", is_stream=False)
    hear(station, 1, 0.0)
    hear(station, 2, 0.0)
    gone = station.components[1, 1]
    for second in range(1, 20):
        hear(station, 2, float(second))
        station.tick(float(second), everyone=False)
        station.next_deadline(everyone=False)
    assert gone.presence.is_lost
    station.touch(gone)
    hear(station, 3, 20.0)
    gone.reads.ask("A", 20.0)
    station.touch(gone)
    hear(station, 2, 20.0)
    for second in range(20, 60):
        station.tick(float(second), everyone=False)
        assert station.next_deadline(everyone=False) > second
    assert [*station.components] == [(2, 1), (3, 1)]
    assert all(machine.presence.is_lost for machine in station.components.values()), "by their own deadlines"
    assert station.autopilot_of(1) is None


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_it_makes_no_difference_who_is_looked_at(loss: float) -> None:
    """A whole session of twelve, with and without looking at everyone."""
    ends = []
    for everyone in (True, False):
        vehicles = [small(system) for system in range(1, 13)]
        air = Air.symmetric(vehicles, loss=loss, delay=0.01, seed=5)
        fetches, now = session(air, vehicles, everyone=everyone)
        assert all(fetch.result is not None and fetch.result.complete for fetch in fetches)
        ends.append(now)
    assert ends[1] <= 1.1 * ends[0]


def small(system: int) -> Vehicle:
    table = [SimParam(f"P_{index:03}", ParamType.INT32, index * system) for index in range(150)]
    if system % 2:
        return PX4Vehicle(system=system, table=table)
    return ArduPilotVehicle(system=system, table=table, ftp=False)


def session(air: Air, vehicles: list[Vehicle], *, everyone: bool) -> tuple[list[Fetch], float]:
    """All of them are fetched at once, as soon as they have said who they are."""
    station = Station(link="x", is_stream=False)
    fetches: list[Fetch] = []
    now = 0.0
    air.tick(now)
    while not (fetches and all(fetch.done for fetch in fetches)):
        assert now < 120.0
        station.tick(now, everyone=everyone)
        machines = list(station.components.values())
        if not fetches and len(machines) == len(vehicles) and all(each.who.settled for each in machines):
            fetches = [machine.begin_fetch(now) for machine in machines]
            for machine in machines:
                station.touch(machine)
        for data, _ in station.data_to_send():
            air.receive(data, now)
        deadline = air.next_deadline()
        ours = station.next_deadline(everyone=everyone)
        now = max(min(ours, math.inf if deadline is None else deadline), now + 1e-7)
        air.tick(now)
        for data in air.data_to_send():
            station.receive(data, None, now)
    return fetches, now


def test_whether_anything_is_awaited_is_asked_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    whole = inspect.getattr_static(ComponentMachine, "is_waiting")

    def counted(machine: ComponentMachine) -> bool:
        asked.append(machine.system)
        return bool(whole.fget(machine))

    monkeypatch.setattr(ComponentMachine, "is_waiting", property(counted))
    station = Station(link="x", is_stream=False)
    for system in range(1, MANY + 1):
        hear(station, system, 0.0)
    for system in range(1, MANY):
        station.components[system, 1].who.settled = True
        station.components[system, 1].who._is_asking = False
    assert station.is_waiting
    asked.clear()
    assert station.is_waiting
    assert asked == [MANY]


class SlowCache(ParamCache):
    """One that has hundreds of others to read first."""

    def load(self, key: str, component: int) -> CachedComponent | None:
        time.sleep(0.3)
        return super().load(key, component)


@pytest.mark.asyncio
async def test_a_cached_table_that_is_being_read_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cache.sqlite3"
    async with ParamClient(small(1), cache=path) as client:
        await (await client.component()).fetch_all()
    monkeypatch.setattr("paramclient.component.IDENTITY_PATIENCE", 0.05)
    with SlowCache(path) as cache:
        async with ParamClient(small(1), cache=cache) as client:
            assert (await client.fetch_all()).results[1, 1].source == "cache"
