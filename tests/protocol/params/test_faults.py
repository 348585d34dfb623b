"""What befalls real vehicles: each session ends in the true table, or says what is missing."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import pytest
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.sync import WATCH_INTERVAL, SyncSettings

from paramclient.errors import NoReply
from paramclient.model.values import Encoding, ParamType
from paramclient.protocol.events import ComponentRebooted
from paramclient.protocol.fetch import FetchResult
from paramclient.protocol.station import Station
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, OtherStation, PX4Vehicle, SimParam, Vehicle
from tests.simulation import Simulation

Make: TypeAlias = Callable[..., Vehicle]

LOSSES = pytest.mark.parametrize("loss", [0.1], ids=["10 %"])
UPTIME = 12.0
"""Seconds that a vehicle runs before the first request: longer than its identification takes."""

MEASURED = {
    *(f"INS_{sensor}OFFS_{axis}" for sensor in ("GYR", "GYR2") for axis in "XYZ"),
    *("INS_GYR1_CALTEMP", "INS_GYR2_CALTEMP", "BARO1_GND_PRESS", "BARO2_GND_PRESS"),
}
"""What the simulated ArduPilot measures with each start."""


def px4(**options: object) -> PX4Vehicle:
    return PX4Vehicle(**options)  # type: ignore[arg-type]  # those of every vehicle


def ardupilot(**options: object) -> ArduPilotVehicle:
    return ArduPilotVehicle(ftp=False, live_period=0.0, **options)  # type: ignore[arg-type]  # the same


def generic(**options: object) -> GenericVehicle:
    table = {f"P{number:03d}": number for number in range(300)}
    return GenericVehicle(table, **options)  # type: ignore[arg-type]  # the same


EVERY_KIND = pytest.mark.parametrize("kind", [px4, ardupilot, generic])
BOTH_AUTOPILOTS = pytest.mark.parametrize("kind", [px4, ardupilot])


def world_of(
    *vehicles: Vehicle, loss: float, others: tuple[OtherStation, ...] = (), seed: int = 1
) -> Simulation:
    """A session with these vehicles, which have been running for a while; 50 ms there and 50 ms back."""
    air = Air.symmetric(vehicles, loss=loss, delay=0.05, others=others, seed=seed)
    station = Station(link="sim:test", is_stream=False, sync_settings=SyncSettings(30.0))
    world = Simulation(air=air, station=station)
    world.meet()
    world.run(UPTIME - world.now)
    return world


def check(world: Simulation, vehicle: Vehicle, result: FetchResult, *missing: int) -> None:
    """It says what is missing, and all else is what the vehicle has."""
    assert result.missing == missing
    lacking = {vehicle.listed[index].name for index in missing}
    held = {name: param for name, param in result.params.items() if param.index is not None}
    assert {name: param.value for name, param in held.items()} == {
        name: value for name, value in vehicle.values.items() if name not in lacking
    }
    assert {param.index for param in held.values()} == set(range(len(vehicle.listed))) - set(missing)
    assert result.count == len(vehicle.listed)
    assert result.complete == world.machine.table.complete == world.machine.sync.synced == (not missing)
    if isinstance(vehicle, PX4Vehicle) and not missing:
        assert result.hash == vehicle.announced_hash()


def differing(world: Simulation, vehicle: Vehicle) -> set[str]:
    """The names of parameters of which the table has another value than the vehicle."""
    values = vehicle.values
    return {name for name, param in world.machine.table.params.items() if param.value != values[name]}


def assert_no_more_requests(world: Simulation, seconds: float = 16.0) -> None:
    """No request is without an end: once what changed was looked at, there are heartbeats and little else."""
    world.run(10.0)
    assert not world.station.is_waiting
    world.sent.clear()
    world.run(seconds)
    requests = [message for _, message in world.sent if type(message).__name__ != "Heartbeat"]
    assert len(requests) <= 20, requests  # the question for the hash, and its repetitions


@LOSSES
class TestDeadIndices:
    @EVERY_KIND
    @pytest.mark.parametrize(
        ("dead", "within", "within_lossy"),
        [
            ((3, 100, 200), 10.0, 15.0),
            ((0,), 20.0, 20.0),
            ((-1,), 15.0, 15.0),
            ((0, 1, -1), 30.0, 30.0),
        ],
        ids=["three", "the first", "the last", "the first two and the last"],
    )
    def test_dead_indices_are_listed_as_missing(
        self, kind: Make, dead: tuple[int, ...], within: float, within_lossy: float, loss: float
    ) -> None:
        indices = sorted(index % len(kind().listed) for index in dead)
        for seed in range(1, 4 if loss else 2):
            vehicle = kind(dead=indices)
            world = world_of(vehicle, loss=loss, seed=seed)
            check(world, vehicle, world.fetch(limit=within_lossy if loss else within), *indices)
            assert world.machine.state == "partial"
            assert_no_more_requests(world)

    @EVERY_KIND
    def test_by_the_dozen(self, kind: Make, loss: float) -> None:
        vehicle = kind(dead=range(100, 136))
        world = world_of(vehicle, loss=loss)
        # of ArduPilot, which answers 50 reads a second, 16 to 74 s, by where the losses fall
        check(world, vehicle, world.fetch(limit=90.0), *range(100, 136))

    def test_cached_values_of_dead_indices_are_kept(self, loss: float) -> None:
        world = world_of(px4(), loss=loss)
        world.fetch()
        memory = world.memory()
        vehicle = px4(dead=[500])
        vehicle.set_param("MC_ROLL_P", 7.5)
        world = world_of(vehicle, loss=loss)
        world.machine.use_cached(now=world.now, **memory)
        result = world.fetch(limit=10.0)
        assert result.missing == (500,)
        assert result.params["MC_ROLL_P"].value == 7.5
        assert {name: param.value for name, param in result.params.items()} == vehicle.values


@LOSSES
class TestAListThatStops:
    @EVERY_KIND
    def test_once(self, kind: Make, loss: float) -> None:
        vehicle = kind(list_stops_at=150)
        world = world_of(vehicle, loss=loss)
        check(world, vehicle, world.fetch(limit=10.0))

    @EVERY_KIND
    def test_always_at_the_same_place(self, kind: Make, loss: float) -> None:
        """ArduPilot then serves the rest at 49 a second: 25 s for 1232."""
        vehicle = kind(list_stops_at=150, list_stops=math.inf)
        world = world_of(vehicle, loss=loss)
        check(world, vehicle, world.fetch(limit=45.0))
        assert vehicle.requests["PARAM_REQUEST_LIST"] <= 12
        assert_no_more_requests(world)

    @EVERY_KIND
    def test_before_its_first_value(self, kind: Make, loss: float) -> None:
        """The number of parameters is unknown, as with a component without any."""
        vehicle = kind(list_stops_at=0, list_stops=math.inf)
        world = world_of(vehicle, loss=loss)
        with pytest.raises(NoReply, match="the parameter list of 1/1"):
            world.fetch(limit=30.0)
        assert_no_more_requests(world)


@LOSSES
class TestAnotherStation:
    @EVERY_KIND
    @pytest.mark.parametrize(("every", "within"), [(0.5, 30.0)], ids=["twice a second"])
    def test_a_fetch_completes_while_another_station_restarts_the_list(
        self, kind: Make, every: float, within: float, loss: float
    ) -> None:
        vehicle = kind()
        world = world_of(vehicle, loss=loss, others=(OtherStation(list_every=every),))
        check(world, vehicle, world.fetch(limit=within))

    @EVERY_KIND
    def test_once_in_mid_stream(self, kind: Make, loss: float) -> None:
        vehicle = kind()
        world = world_of(vehicle, loss=loss, others=(OtherStation(list_every=UPTIME + 0.3),))
        check(world, vehicle, world.fetch(limit=10.0))

    @BOTH_AUTOPILOTS
    def test_a_fetch_has_the_values_that_another_station_sets_meanwhile(
        self, kind: Make, loss: float
    ) -> None:
        vehicle = kind()
        names = [param.name for param in vehicle.listed if param.type == ParamType.REAL32][::60]
        sets = [
            (UPTIME + 0.1 * number, SimParam(name, ParamType.REAL32, 40.0 + number))
            for number, name in enumerate(names)
        ]
        encoding = Encoding.C_CAST if kind is ardupilot else Encoding.BYTEWISE
        world = world_of(vehicle, loss=loss, others=(OtherStation(sets=sets, encoding=encoding),))
        result = world.fetch(limit=15.0)
        assert result.complete
        assert sum(vehicle.values[row.name] == row.value for _, row in sets) > len(sets) / 2
        # a change that was lost on the air is seen with the next look at the hash; ArduPilot has none
        world.run(40.0)
        if kind is px4 or not loss:
            held = {name: param.value for name, param in world.machine.table.params.items()}
            assert held == vehicle.values
            assert world.machine.sync.synced


@LOSSES
class TestTheCountMoves:
    def test_px4_uses_one_for_the_first_time(self, loss: float) -> None:
        vehicle = px4(not_in_use=["BAT1_CAPACITY"])
        vehicle.when_listed(400, lambda: vehicle.use("BAT1_CAPACITY"))
        world = world_of(vehicle, loss=loss)
        result = world.fetch(limit=10.0)
        assert "BAT1_CAPACITY" in result.params
        check(world, vehicle, result)

    def test_px4_finds_a_sensor(self, loss: float) -> None:
        vehicle = px4()
        vehicle.when_listed(400, lambda: vehicle.set_param("CAL_MAG2_ID", 197900))
        world = world_of(vehicle, loss=loss)
        result = world.fetch(limit=10.0)
        assert result.count == 919
        check(world, vehicle, result)

    def test_ardupilot_shows_a_group(self, loss: float) -> None:
        vehicle = ardupilot()
        vehicle.when_listed(400, lambda: vehicle.set_param("EK2_ENABLE", 1))
        world = world_of(vehicle, loss=loss)
        result = world.fetch(limit=20.0)
        assert result.count == 1434
        check(world, vehicle, result)

    def test_ardupilot_hides_a_group(self, loss: float) -> None:
        vehicle = ardupilot()
        vehicle.set_param("EK2_ENABLE", 1)
        vehicle.when_listed(800, lambda: vehicle.set_param("EK2_ENABLE", 0))
        world = world_of(vehicle, loss=loss)
        result = world.fetch(limit=20.0)
        assert result.count == 1382
        check(world, vehicle, result)

    def test_ardupilot_shows_one_and_hides_it(self, loss: float) -> None:
        vehicle = ardupilot()
        for count in range(200, 1300, 200):
            vehicle.when_listed(count, lambda: vehicle.set_param("EK2_ENABLE", 1))
            vehicle.when_listed(count + 100, lambda: vehicle.set_param("EK2_ENABLE", 0))
        world = world_of(vehicle, loss=loss)
        result = world.fetch(limit=40.0)
        world.run(1.0)  # a change back within 0.3 s may be a late answer: a read has to confirm it
        check(world, vehicle, replace(result, params=world.machine.table.params.copy()))

    @BOTH_AUTOPILOTS
    def test_a_change_during_a_link_loss_is_detected_later(self, kind: Make, loss: float) -> None:
        """The update that reports it is lost; the next value of any kind carries the new count."""
        vehicle = kind()
        world = world_of(vehicle, loss=loss)
        world.fetch(limit=10.0)
        vehicle.set_param("CAL_MAG2_ID" if kind is px4 else "EK2_ENABLE", 1)
        vehicle.data_to_send()
        if isinstance(vehicle, PX4Vehicle):
            vehicle.use(*vehicle._late_use["CAL_MAG2_ID"])
        world.get(5)
        assert not world.machine.sync.synced
        check(world, vehicle, world.fetch(limit=20.0))


class TestArduPilotStartsAgainInAFetch:
    """It is off for 1.04 s, and sends its clock 1.4 s after its first heartbeat (measured)."""

    @pytest.mark.parametrize(
        ("kind", "at"), [("copter", 30), ("copter", 1350), ("plane", 400), ("rover", 1000)]
    )
    def test_in_mid_list(self, kind: str, at: int) -> None:
        vehicle = ardupilot(kind=kind)
        name = vehicle.listed[2].name

        def reboot() -> None:
            entry = vehicle._entry(name)  # it has arrived before: only a new list can bring it
            entry.store(entry.bits ^ 1)
            vehicle.reboot(down=1.04)

        vehicle.when_listed(at, reboot)
        world = world_of(vehicle, loss=0.0)
        self.check_then_and_later(world, vehicle, world.fetch(limit=4.0))

    @pytest.mark.parametrize("after", [0.03, 0.06, 0.2, 0.4])
    def test_in_mid_file(self, after: float) -> None:
        vehicle = ArduPilotVehicle(live_period=0.0)
        world = world_of(vehicle, loss=0.0)
        fetch = world.machine.begin_fetch(world.now)
        world.run(after)
        vehicle.reboot(world.now, down=1.04)
        result = world.outcome(fetch, limit=4.0)
        world.machine.end_fetch(fetch, world.now)
        self.check_then_and_later(world, vehicle, result)

    def check_then_and_later(self, world: Simulation, vehicle: Vehicle, result: FetchResult) -> None:
        """The table is of the new run; a file also brings what is measured after that."""
        assert result.complete
        assert differing(world, vehicle) <= MEASURED
        world.run(1.5)
        assert len([event for event in world.events if isinstance(event, ComponentRebooted)]) == 1
        assert world.machine.state == "synced", "the clock has shown a start before the fetch"
        assert differing(world, vehicle) == MEASURED
        world.run(3 * WATCH_INTERVAL)
        assert differing(world, vehicle) == (set() if result.source == "ftp" else MEASURED)

    def test_a_long_list_waits_for_the_clock(self) -> None:
        """On a radio, more would be repeated than the clock takes, as the sequence numbers show no
        restart."""
        vehicle = ardupilot(burst=1, period=0.025)
        vehicle.when_listed(400, lambda: vehicle.reboot(down=1.04))
        world = world_of(vehicle, loss=0.0)
        fetch = world.machine.begin_fetch(world.now)
        world.until(lambda: any(isinstance(event, ComponentRebooted) for event in world.events))
        assert fetch.restarted_at == -math.inf
        check(world, vehicle, world.outcome(fetch))
        world.machine.end_fetch(fetch, world.now)


@LOSSES
class TestAReboot:
    @EVERY_KIND
    @pytest.mark.parametrize("down", [0.0, 3.0, 8.0])
    def test_in_mid_stream(self, kind: Make, down: float, loss: float) -> None:
        vehicle = kind()
        name = vehicle.listed[2].name

        def reboot() -> None:
            entry = vehicle._entry(name)  # it has arrived before: only a new start of the fetch can bring it
            entry.store(entry.bits ^ 1)
            vehicle.reboot(down=down)

        vehicle.when_listed(150, reboot)
        world = world_of(vehicle, loss=loss)
        result = world.fetch(limit=down + 20.0)
        if kind is ardupilot:
            assert result.complete
            assert differing(world, vehicle) <= MEASURED
            world.run(3.0)  # its clock shows the restart later than the list is over
        else:
            check(world, vehicle, result)
        assert any(isinstance(event, ComponentRebooted) for event in world.events)

    @BOTH_AUTOPILOTS
    def test_a_reboot_during_a_fetch_with_a_long_boot(self, kind: Make, loss: float) -> None:
        """ArduPilot ignores the list meanwhile and answers reads, 33 a second."""
        vehicle = kind(boot_time=5.0)
        vehicle.when_listed(150, lambda: vehicle.reboot(down=1.0))
        world = world_of(vehicle, loss=loss)
        check(world, vehicle, world.fetch(limit=70.0))

    @EVERY_KIND
    def test_again_and_again(self, kind: Make, loss: float) -> None:
        vehicle = kind()
        for count in range(60, 160, 10):
            vehicle.when_listed(count, lambda: vehicle.reboot(down=3.0))
        world = world_of(vehicle, loss=loss)
        machine = world.machine
        fetch = machine.begin_fetch(world.now)
        world.until(lambda: fetch.done, limit=200.0)
        assert fetch.error is None or isinstance(fetch.error, NoReply)
        machine.end_fetch(fetch, world.now)
        assert_no_more_requests(world)

    @EVERY_KIND
    def test_for_good(self, kind: Make, loss: float) -> None:
        vehicle = kind()
        vehicle.when_listed(150, lambda: vehicle.reboot(down=math.inf))
        world = world_of(vehicle, loss=loss)
        result = world.fetch(limit=120.0)
        assert len(result.missing) >= len(vehicle.listed) - 150
        assert world.machine.state == "lost"
        assert_no_more_requests(world)


@LOSSES
@BOTH_AUTOPILOTS
def test_the_list_after_a_boot(kind: Make, loss: float) -> None:
    """ArduPilot ignores what arrives in its first seconds, PX4 answers then."""
    vehicle = kind(boot_time=UPTIME + 5.0)
    world = world_of(vehicle, loss=loss)
    check(world, vehicle, world.fetch(limit=20.0))


@LOSSES
@BOTH_AUTOPILOTS
def test_two_components_with_the_same_names(kind: Make, loss: float) -> None:
    autopilot = kind()
    names = [param.name for param in autopilot.listed]
    camera = GenericVehicle({name: 7000 + at for at, name in enumerate(names[:400])}, component=100)
    world = world_of(autopilot, camera, loss=loss)
    machines = [world.station.components[1, 1], world.station.components[1, 100]]
    fetches: list[Fetch] = world.station.begin_fetches(machines, world.now)
    results = [world.outcome(fetch, limit=20.0) for fetch in fetches]
    check(world, autopilot, results[0])
    assert {name: param.value for name, param in results[1].params.items()} == camera.values
    assert results[1].complete
    name = names[3]
    write = machines[1].write(name, 9, world.now)
    assert world.outcome(write).actual == 9
    assert (camera.values[name], machines[1].table.params[name].value) == (9, 9)
    assert machines[0].table.params[name].value == autopilot.values[name]


@LOSSES
def test_a_satellite_link_keeps_the_list_to_itself(loss: float) -> None:
    vehicle = px4(high_latency=True)
    world = world_of(vehicle, loss=loss)
    with pytest.raises(NoReply, match="the parameter list of 1/1"):
        world.fetch(limit=30.0)
    assert world.get("MC_ROLL_P", limit=30.0).value == vehicle.values["MC_ROLL_P"]
    vehicle.high_latency = False
    world.run(10.0)
    check(world, vehicle, world.fetch(limit=10.0))


@LOSSES
@EVERY_KIND
def test_an_update_that_is_lost(kind: Make, loss: float) -> None:
    """Nothing repeats it. Where there is a hash, the next hash shows it; elsewhere the next fetch."""
    vehicle = kind()
    world = world_of(vehicle, loss=loss)
    world.fetch(limit=10.0)
    name = vehicle.listed[7].name
    entry = vehicle._entry(name)
    entry.store(entry.bits ^ 1)
    if isinstance(vehicle, PX4Vehicle):
        vehicle._hash = None
        world.run(35.0)
    else:
        world.fetch(limit=10.0)
    assert world.machine.table.params[name].value == vehicle.values[name]
    assert world.machine.sync.synced
