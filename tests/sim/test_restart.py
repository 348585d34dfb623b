"""Reboots of simulated vehicles by command, and changes that take effect with them."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest

from paramclient.errors import CommandResult
from paramclient.model.values import ParamType
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, px4_table
from paramclient.wire import messages
from tests.ground_station import Station, cast, read, write
from tests.shell import generic


def reboot(station: Station, system: int = 1) -> list[int]:
    """Send the reboot command; return the immediate responses."""
    station.log.clear()
    station.send(messages.CommandLong(system, 1, messages.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0))
    return [ack.result for _, _, ack in station.log if isinstance(ack, messages.CommandAck)]


def systems(station: Station) -> set[int]:
    """Return the system ids in the log, and clear it."""
    found = {frame.system for _, frame, _ in station.log}
    station.log.clear()
    return found


@pytest.mark.parametrize(
    ("make", "delay", "armed"),
    [
        (PX4Vehicle, 0.4, CommandResult.DENIED),
        (ArduPilotVehicle, 0.2, CommandResult.FAILED),
        (generic, 0.3, CommandResult.DENIED),
    ],
)
def test_a_vehicle_acknowledges_switches_off_and_returns(make: Any, delay: float, armed: int) -> None:
    """While it is armed, it refuses."""
    vehicle = make(reboot_down=5.0, armed=True)
    station = Station(vehicle)
    assert station.receive(messages.Heartbeat)[-1].base_mode & messages.MAV_MODE_FLAG_SAFETY_ARMED
    assert reboot(station) == [armed]
    vehicle.armed = False
    station.wait(10.25)
    assert not station.receive(messages.Heartbeat)[-1].base_mode & messages.MAV_MODE_FLAG_SAFETY_ARMED
    version = vehicle.version
    assert reboot(station) == [CommandResult.ACCEPTED]
    station.wait(20.0)
    on_at = 10.25 + delay + 5.0
    assert not [when for when, _, _ in station.log if 10.25 + delay < when < on_at]
    assert [when for when, frame, _ in station.log if frame.sequence == 0][-1] == pytest.approx(on_at)
    assert (vehicle.version, vehicle.system) == (version, 1)


@pytest.mark.parametrize(
    ("make", "request_of", "at_once"),
    [
        (partial(PX4Vehicle, uid=7), write("MAV_SYS_ID", 9, ParamType.INT32), False),
        (ArduPilotVehicle, cast("SYSID_THISMAV", 9), False),
        (partial(ArduPilotVehicle, kind="plane"), cast("SYSID_THISMAV", 9), True),
        (partial(ArduPilotVehicle, kind="rover"), cast("SYSID_THISMAV", 9), True),
    ],
)
def test_a_new_system_id_takes_effect_with_a_reboot_or_within_a_second(
    make: Any, request_of: messages.ParamSet, at_once: bool
) -> None:
    vehicle = make()
    uid = vehicle.version.uid, vehicle.version.uid2
    station = Station(vehicle).wait(10.25).send(request_of).wait(0.6)
    assert systems(station) == {1}
    station.wait(1.0)
    assert systems(station) == ({9} if at_once else {1})
    reboot(station, system=vehicle.system)
    station.wait(10.0)
    assert vehicle.system == 9
    assert (vehicle.version.uid, vehicle.version.uid2) == uid
    assert not station.ask(read("MAV_SYS_ID"), read("SYSID_THISMAV"))


def test_sys_autoconfig_resets_all_but_kept_parameters() -> None:
    vehicle = PX4Vehicle(table=px4_table(), system=3)
    station = Station(vehicle)
    before = vehicle.values
    kept = {"SYS_AUTOSTART": 4001, "CAL_ACC0_PRIO": 75, "COM_FLTMODE1": 2, "RC1_MIN": 1100}
    reset = {"COM_RC_IN_MODE": 2, "SYS_HAS_MAG": 0}
    for name, value in {**kept, **reset}.items():
        assert before[name] != value
        vehicle.set_param(name, value)
    reboot(station, system=3)
    station.wait(5.0)
    assert vehicle.values == before | kept | reset  # unchanged without SYS_AUTOCONFIG
    announced = vehicle.announced_hash()
    vehicle.set_param("SYS_AUTOCONFIG", 1)
    reboot(station, system=3)
    station.wait(5.0)
    assert vehicle.values == before | kept | {"MAV_SYS_ID": 1}
    assert vehicle.system == 1
    assert vehicle.announced_hash() != announced
    vehicle.set_param("SYS_HAS_MAG", 0)
    reboot(station)
    station.wait(5.0)
    assert vehicle.param("SYS_HAS_MAG").value == 0  # resets only once
