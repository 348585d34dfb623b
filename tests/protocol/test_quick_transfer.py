"""Whether a large file may be read without a request of the user, in simulated time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from paramclient.protocol import wire
from paramclient.protocol.params.fetch_result import Policy
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.quick_transfer import obstacle_to_quick_transfer
from paramclient.protocol.station import Station
from paramclient.sim import Air, PX4Vehicle
from tests.simulation import PEER, Simulation

TABLE = {f"P{number:02d}": number for number in range(60)}


def a_station(**options: Any) -> Station:
    return Station(link="sim:test", is_stream=False, **options)


def fetched(*, air_delay: float = 0.0, station: Station | None = None, **options: Any) -> Simulation:
    """A vehicle whose table was fetched."""
    vehicle = PX4Vehicle(table=TABLE, **options)
    air = Air.symmetric([vehicle], delay=air_delay)
    world = Simulation(air=air, station=a_station() if station is None else station)
    assert world.fetch().complete
    world.run(2.0)
    return world


def obstacle(world: Simulation) -> str | None:
    return obstacle_to_quick_transfer(world.station, world.machine)


def test_nothing_is_in_the_way_on_a_quick_link() -> None:
    assert obstacle(fetched()) is None
    assert obstacle(fetched(air_delay=0.05)) is None


@pytest.mark.parametrize("options", [{"burst": 1, "period": 0.125}, {"burst": 3}])
def test_a_slow_list_is_a_slow_link(options: dict[str, Any]) -> None:
    assert obstacle(fetched(**options)) == "the link is slow: its list arrived at less than 200 values/s"


def test_a_long_round_trip_is_a_slow_link() -> None:
    assert obstacle(fetched(air_delay=0.3)) == "the link is slow: a round trip takes more than 0.2 s"


def test_the_obstacle_of_an_armed_vehicle_ends_with_its_disarming() -> None:
    vehicle = PX4Vehicle(table=TABLE, armed=True)
    world = Simulation(vehicle)
    assert world.fetch().complete
    assert obstacle(world) == "the vehicle is armed"
    vehicle.armed = False
    world.run(2.0)
    assert obstacle(world) is None


def test_a_lost_vehicle_is_sent_no_request() -> None:
    vehicle = PX4Vehicle(table=TABLE)
    world = Simulation(vehicle)
    assert world.fetch().complete
    world.air = Air([])
    world.run(10.0)
    assert obstacle(world) == "the vehicle is lost"


def test_a_telemetry_radio_is_a_slow_link_where_traffic_is_counted() -> None:
    world = fetched(station=a_station(counts_traffic=True))
    assert obstacle(world) is None
    world.station.receive(
        wire.build_frame(109, bytes(9), system=51, component=68, sequence=0), PEER, world.now
    )
    assert obstacle(world) == "a telemetry radio is on the link"


def test_without_permission_to_send_there_is_no_transfer() -> None:
    world = fetched()
    policy = replace(SyncSettings(), policy=Policy.HASH_ONLY)
    station = a_station(sync_settings=policy)
    assert obstacle_to_quick_transfer(station, world.machine) == "the policy is hash-only"
    listener = a_station(sync_settings=replace(SyncSettings(), listens_only=True, policy=Policy.CACHE_ONLY))
    assert obstacle_to_quick_transfer(listener, world.machine) == "the client only listens"
