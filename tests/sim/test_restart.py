"""Reboots of simulated vehicles by command, and changes that take effect with them."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import pytest

from paramclient import UsageError
from paramclient.errors import CommandResult
from paramclient.model.values import Encoding, ParamType, encode_value
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, Vehicle, px4_table
from paramclient.wire import frames, messages
from tests.shell import generic

T = TypeVar("T")

REBOOT = 246


class Desk:
    """A ground station's view of one vehicle."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.now = 0.0
        self.received: list[tuple[float, frames.Frame, messages.Message]] = []
        self._framer = frames.Framer(messages.DECODED_IDS, stream=False)
        self._sequence = 0
        vehicle.tick(0.0)
        self._take()

    def run(self, until: float) -> None:
        """Advance the time; all work is done when it is due."""
        while True:
            self._take()
            due = self.vehicle.next_deadline()
            if due is not None and self.now < due <= until:
                self.now = due
            elif self.now < until:
                self.now = until
            else:
                return
            self.vehicle.tick(self.now)

    def send(self, message: messages.Message) -> None:
        data = messages.encode(message, system=255, component=190, sequence=self._sequence)
        self._sequence = (self._sequence + 1) % 256
        self.vehicle.receive(data, self.now)
        self._take()

    def command(self, mode: float = 1.0) -> list[int]:
        """Send the reboot command; return the immediate responses."""
        self.received.clear()
        self.send(messages.CommandLong(self.vehicle.system, 1, REBOOT, mode))
        acks = self.messages(messages.CommandAck)
        assert acks == [messages.CommandAck(REBOOT, ack.result, 255, 190) for ack in acks]
        return [ack.result for ack in acks]

    def set(self, name: str, value: int, kind: ParamType, encoding: Encoding) -> None:
        self.send(messages.ParamSet(self.vehicle.system, 1, name, encode_value(value, kind, encoding), kind))

    def messages(self, kind: type[T]) -> list[T]:
        return [message for _, _, message in self.received if isinstance(message, kind)]

    def silence(self, since: float, until: float) -> bool:
        return not any(since < when < until for when, _, _ in self.received)

    def _take(self) -> None:
        for data in self.vehicle.data_to_send():
            for frame in self._framer.receive(data):
                message = messages.decode(frame)
                assert message is not None
                self.received.append((self.now, frame, message))


@pytest.mark.parametrize(("make", "delay"), [(PX4Vehicle, 0.4), (ArduPilotVehicle, 0.2), (generic, 0.3)])
def test_a_vehicle_acknowledges_switches_off_and_returns(make: Any, delay: float) -> None:
    desk = Desk(make(reboot_down=5.0))
    version = desk.vehicle.version
    desk.run(10.25)
    assert desk.command() == [CommandResult.ACCEPTED]
    desk.run(30.0)
    on_at = 10.25 + delay + 5.0
    assert desk.silence(10.25 + delay, on_at)
    started_at = [when for when, frame, _ in desk.received if frame.sequence == 0][-1]
    assert started_at == pytest.approx(on_at)
    assert desk.vehicle.version == version
    assert [each for _, each, _ in desk.received if each.sequence == 0][-1].message_id == 0
    assert desk.vehicle.system == 1


def test_a_vehicle_may_stay_off() -> None:
    desk = Desk(generic(reboot_down=math.inf))
    desk.command()
    desk.run(100.0)
    assert desk.silence(0.3, 100.0)
    assert desk.vehicle.next_deadline() is None


@pytest.mark.parametrize(
    ("make", "answer"),
    [
        (PX4Vehicle, CommandResult.DENIED),
        (ArduPilotVehicle, CommandResult.FAILED),
        (generic, CommandResult.DENIED),
    ],
)
def test_an_armed_vehicle_refuses_a_reboot(make: Any, answer: int) -> None:
    desk = Desk(make(armed=True))
    assert desk.messages(messages.Heartbeat)[-1].base_mode & 128
    assert desk.command() == [answer]
    desk.run(1.0)
    desk.vehicle.armed = False
    desk.run(2.0)
    beats = desk.messages(messages.Heartbeat)
    assert [bool(beat.base_mode & 128) for beat in beats] == [True, False]
    assert beats[0].base_mode & ~128 == beats[1].base_mode
    assert desk.command() == [CommandResult.ACCEPTED]


def test_px4s_system_id_takes_effect_after_a_reboot() -> None:
    desk = Desk(PX4Vehicle(uid=7))
    desk.set("MAV_SYS_ID", 9, ParamType.INT32, Encoding.BYTEWISE)
    desk.run(10.0)
    assert {frame.system for _, frame, _ in desk.received} == {1}
    desk.command()
    desk.run(20.0)
    assert desk.vehicle.system == 9
    assert {frame.system for when, frame, _ in desk.received if when > 10.5} == {9}
    desk.received.clear()
    desk.send(messages.ParamRequestRead(1, 1, "MAV_SYS_ID"))
    assert not desk.received
    desk.send(messages.ParamRequestRead(9, 1, "MAV_SYS_ID"))
    assert desk.messages(messages.ParamValue)


def test_sys_autoconfig_resets_all_but_kept_parameters() -> None:
    vehicle = PX4Vehicle(table=px4_table(), system=3)
    desk = Desk(vehicle)
    before = vehicle.values
    kept = {"SYS_AUTOSTART": 4001, "CAL_ACC0_PRIO": 75, "COM_FLTMODE1": 2, "RC1_MIN": 1100}
    reset = {"COM_RC_IN_MODE": 2, "SYS_HAS_MAG": 0}
    assert {**kept, **reset}.keys() <= before.keys()
    for name, value in {**kept, **reset}.items():
        assert before[name] != value
        vehicle.set_param(name, value)
    desk.command()
    desk.run(5.0)
    assert vehicle.values == before | kept | reset  # unchanged without SYS_AUTOCONFIG
    announced = vehicle.announced_hash()
    vehicle.set_param("SYS_AUTOCONFIG", 1)
    desk.command()
    desk.run(10.0)
    assert vehicle.values == before | kept | {"MAV_SYS_ID": 1}
    assert vehicle.system == 1
    assert vehicle.announced_hash() != announced
    vehicle.set_param("SYS_HAS_MAG", 0)
    desk.command()
    desk.run(15.0)
    assert vehicle.param("SYS_HAS_MAG").value == 0  # resets only once


def test_first_start_only_parameters_are_unused_from_the_second_start_on() -> None:
    px4 = PX4Vehicle()
    count, announced = len(px4.params), px4.announced_hash()
    px4.reboot(5.0, down=1.0)
    assert len(px4.params) == count - 3
    assert px4.announced_hash() != announced
    second = px4.announced_hash()
    px4.reboot(10.0, down=1.0)
    assert (len(px4.params), px4.announced_hash()) == (count - 3, second)


def test_plane_and_rover_change_their_system_id_within_a_second() -> None:
    desk = Desk(ArduPilotVehicle(kind="plane"))
    desk.run(10.25)
    desk.set("SYSID_THISMAV", 9, ParamType.INT16, Encoding.C_CAST)
    desk.run(10.9)
    assert {frame.system for _, frame, _ in desk.received} == {1}
    desk.received.clear()
    desk.run(12.0)
    assert {frame.system for _, frame, _ in desk.received} == {9}
    assert desk.vehicle.version.uid2 == ArduPilotVehicle().version.uid2
    desk.command()
    desk.run(20.0)
    assert desk.vehicle.system == 9


def test_copters_system_id_takes_effect_after_a_reboot() -> None:
    desk = Desk(ArduPilotVehicle())
    desk.set("SYSID_THISMAV", 9, ParamType.INT16, Encoding.C_CAST)
    desk.run(5.0)
    assert desk.vehicle.system == 1
    desk.command()
    desk.run(10.0)
    assert desk.vehicle.system == 9


def test_a_reboot_group_appears_after_a_reboot() -> None:
    vehicle = ArduPilotVehicle(
        table={"A_ENABLE": 0, "B_ENABLE": 1, "C_ENABLE": 0},
        groups={"A_ENABLE": {"A_X": 1}, "B_ENABLE": {"B_X": 1}, "C_ENABLE": {"C_X": 1}},
        reboot_groups=["A_ENABLE", "B_ENABLE"],
    )
    desk = Desk(vehicle)
    assert list(vehicle.params) == ["A_ENABLE", "B_ENABLE", "B_X", "C_ENABLE"]
    for name, value in {"A_ENABLE": 1, "B_ENABLE": 0, "C_ENABLE": 1}.items():
        vehicle.set_param(name, value)
    assert list(vehicle.params) == ["A_ENABLE", "B_ENABLE", "B_X", "C_ENABLE", "C_X"]
    desk.command()
    desk.run(5.0)
    assert list(vehicle.params) == ["A_ENABLE", "A_X", "B_ENABLE", "C_ENABLE", "C_X"]


def test_invalid_reboot_arguments_are_rejected() -> None:
    with pytest.raises(UsageError, match="copter, plane, rover"):
        ArduPilotVehicle(kind="blimp")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="reboot_down"):
        generic(reboot_down=-1.0)
    with pytest.raises(UsageError, match="A_ENABLE"):
        ArduPilotVehicle(table={"A_ENABLE": 0}, reboot_groups=["A_ENABLE"])
