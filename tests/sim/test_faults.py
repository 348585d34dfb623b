"""Faults of simulated vehicles: dead indices, stopped lists, reboots, other stations, high latency."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Literal

import pytest

from paramclient.errors import CommandResult
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, Vehicle
from paramclient.wire import messages
from tests.ground_station import LIST, Station, indices, names

NO_INDEX = messages.NO_INDEX
TEN = {f"P{number}": number for number in range(10)}
CLOCK_REQUEST = messages.CommandLong(
    1, 1, messages.MAV_CMD_REQUEST_MESSAGE, float(messages.message_id(messages.SystemTime))
)


def test_the_count_of_a_list_rises_and_falls_as_groups_appear_and_go() -> None:
    vehicle = ArduPilotVehicle(
        table=TEN | {"Q_ENABLE": 0, "R": 5}, groups={"Q_ENABLE": {"Q_A": 1, "Q_B": 2}}, burst=1
    )
    vehicle.when_listed(3, lambda: vehicle.set_param("Q_ENABLE", 1))
    vehicle.when_listed(12, lambda: vehicle.set_param("Q_ENABLE", 0))
    values = Station(vehicle).ask(LIST, seconds=1.0)
    assert [count for count, _ in Counter(value.param_count for value in values).items()] == [12, 14]
    stream = [value for value in values if value.param_index != NO_INDEX]
    assert names(stream) == [*TEN, "Q_ENABLE", "Q_A", "R"]
    assert indices(stream) == list(range(13))


# The clock


@pytest.mark.parametrize(("kind", "requested"), [("copter", [True]), ("plane", []), ("rover", [])])
def test_ardupilot_sends_system_time_when_its_main_loop_runs(
    kind: Literal["copter", "plane", "rover"], requested: list[bool]
) -> None:
    """A Copter only on request; an earlier request is acknowledged, and SYSTEM_TIME sent then."""
    vehicle = ArduPilotVehicle(table=TEN, kind=kind)
    station = Station(vehicle).wait(5.5)
    unasked = [time.time_boot_ms for time in station.receive(messages.SystemTime)]
    assert unasked == ([] if requested else [2000, 3000, 4000, 5000])
    vehicle.reboot(station.now, down=1.0)
    station.wait(1.2)
    station.log.clear()
    station.send(CLOCK_REQUEST).wait(1.1)
    assert [message.result for message in station.receive(messages.CommandAck)] == [CommandResult.ACCEPTED]
    assert [time.time_boot_ms for time in station.wait(0.2).receive(messages.SystemTime)] == [1400]
    station.send(CLOCK_REQUEST).wait(0.001)
    assert [time.time_boot_ms for time in station.receive(messages.SystemTime)] == [1500]


@pytest.mark.parametrize(
    ("make", "first", "then"),
    [
        (PX4Vehicle, 0, 3),
        (ArduPilotVehicle, 4, 3),
        (partial(ArduPilotVehicle, kind="plane"), 2, 3),
        (partial(ArduPilotVehicle, kind="rover"), 2, 4),
    ],
)
def test_the_state_after_a_reboot(make: Callable[..., Vehicle], first: int, then: int) -> None:
    vehicle = make(table=TEN)
    station = Station(vehicle).wait(3.5)
    assert {beat.system_status for beat in station.receive(messages.Heartbeat)} == {then}
    vehicle.reboot(station.now)
    states = [beat.system_status for beat in station.wait(5.0).receive(messages.Heartbeat)]
    assert states[0] == first
    assert states[-1] == then
    assert states == sorted(states, key=[first, then].index)
