"""The simulated vehicles and the faulty link, property by property, with simulated time."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable

import pytest

from paramclient.errors import UsageError
from paramclient.model.values import Param, ParamType
from paramclient.sim import (
    ArduPilotVehicle,
    Camera,
    FaultyLink,
    GenericVehicle,
    PX4Vehicle,
    SimParam,
    Vehicle,
    ardupilot_table,
)
from paramclient.wire import messages
from tests.ground_station import LIST, SMALL, Station, cast, indices, names, read, write

NO_INDEX = messages.NO_INDEX


# Tables


def test_a_table_from_a_mapping() -> None:
    vehicle = GenericVehicle(SMALL)
    assert vehicle.param("A_FLOAT") == Param("A_FLOAT", 1.5, ParamType.REAL32, 0, 0x3FC00000)
    assert vehicle.param("D_SHORT") == Param("D_SHORT", -3, ParamType.INT16, 3, 0xFFFD)
    assert vehicle.values == {"A_FLOAT": 1.5, "B_INT": 7, "C_BYTE": 200, "D_SHORT": -3}
    assert list(vehicle.params.values()) == [vehicle.param(name) for name in SMALL]


@pytest.mark.parametrize(
    "make",
    [
        lambda: SimParam("", ParamType.INT8, 0),
        lambda: SimParam("A", ParamType.UINT8, 256),
        lambda: GenericVehicle([SimParam("A", ParamType.INT8, 0)] * 2),
        lambda: GenericVehicle(SMALL, system=0),
        lambda: GenericVehicle(SMALL, dead=["NO_SUCH"]),
        lambda: GenericVehicle(SMALL).param("NO_SUCH"),
        lambda: GenericVehicle(SMALL).set_param("NO_SUCH", 1),
        lambda: GenericVehicle(SMALL).set_param("C_BYTE", 256),
        lambda: Camera({"": 1}),
        lambda: Camera({"A": "x" * 129}),
        lambda: Camera({"A": (ParamType.UINT8, 300)}),
        lambda: Camera(supported={"CAM_MODE": ["text"]}),
        lambda: Camera(component=256),
        lambda: Camera({"A": 1}).set_ext_param("A", "text"),
        lambda: Camera({"A": 1}).remove_ext_param("B"),
    ],
)
def test_invalid_arguments_are_rejected(make: Callable[[], object]) -> None:
    with pytest.raises(UsageError):
        make()


@pytest.mark.parametrize("vehicle", [GenericVehicle(SMALL), PX4Vehicle(), ArduPilotVehicle()])
def test_messages_for_others_are_ignored(vehicle: Vehicle) -> None:
    station = Station(vehicle).wait(0.5)
    name = next(iter(vehicle.params))
    assert not station.ask(
        messages.ParamRequestList(2, 1),
        messages.ParamRequestList(1, 2),
        read(name, system=2),
        read(name, component=99),
        write(name, 1.0, ParamType.REAL32, system=2),
    )
    assert not vehicle.requests


# PX4


def test_invalid_requests_are_not_answered_by_a_px4() -> None:
    vehicle = PX4Vehicle()
    before = vehicle.values
    station = Station(vehicle)
    assert not station.ask(
        read("NO_SUCH"),
        read(index=903),
        read("sys_autostart"),
        write("NO_SUCH", 1, ParamType.INT32),
        write("SYS_AUTOSTART", 1.0, ParamType.REAL32),
        write("SYS_AUTOSTART", 1, ParamType.UINT32),
        read("SYS_AUTOSTART", system=0),
        messages.ParamRequestList(0, 0),
    )
    assert vehicle.values == before
    assert not station.receive(messages.ParamError)


def test_a_calibration_id_brings_others_into_use() -> None:
    vehicle = PX4Vehicle()
    fourth = vehicle.param("CAL_MAG3_ID").index
    assert fourth is not None
    station = Station(vehicle)
    (value,) = station.ask(read("CAL_MAG2_XOFF"))
    assert value.param_index == NO_INDEX
    values = station.ask(write("CAL_MAG2_ID", 197900, ParamType.INT32))
    assert [value.param_count for value in values] == [903, 919]
    assert vehicle.param("CAL_MAG3_ID").index == fourth + 16
    values = station.ask(LIST, seconds=2.0)
    assert len(values) == 920
    assert names(values[1:]) == sorted(names(values[1:]))


# ArduPilot


@pytest.mark.parametrize("name", ["EK3_IMU_MASK", "INS_GYRO_FILTER"])
def test_a_set_to_the_default_is_answered_with_another_type(name: str) -> None:
    """Until the parameter has had another value; measured on a real vehicle."""
    vehicle = ArduPilotVehicle()
    param = vehicle.param(name)
    assert isinstance(param.value, int)
    station = Station(vehicle)
    kinds = [
        [value.param_type for value in station.ask(cast(name, value))]
        for value in (param.value, param.value, param.value + 1, param.value + 1, param.value)
    ]
    assert kinds == [[ParamType.REAL32], [ParamType.REAL32], [param.type], [param.type], [param.type]]
    assert vehicle.param(name).type == param.type


def test_early_after_boot_an_ardupilot_ignores_the_request_for_the_list() -> None:
    station = Station(ArduPilotVehicle(boot_time=2.0, table=SMALL))
    assert not station.ask(LIST, seconds=5.0)
    assert len(station.ask(LIST)) == 4


@pytest.mark.parametrize(
    ("name", "value", "stored"),
    [
        ("RTL_ALT", 1234.7, 1234),
        ("RTL_ALT", 3e9, 2**31 - 1),
        ("FLTMODE1", 200, 127),
        ("FS_THR_VALUE", 1e30, 32767),
        ("PILOT_TKOFF_ALT", 0.25, 0.25),
    ],
)
@pytest.mark.parametrize("kind", [ParamType.REAL32, ParamType.INT32, 0, 255])
def test_a_set_is_converted_and_clamped(name: str, value: float, stored: float, kind: int) -> None:
    vehicle = ArduPilotVehicle(table=ardupilot_table())
    station = Station(vehicle).wait(0.0301).send(cast(name, value, kind)).wait(0.1)
    (time,) = station.times()
    assert 0.0 < time - 0.0301 < 0.007
    (answer,) = station.values()
    assert (answer.param_id, answer.param_index) == (name, NO_INDEX)
    assert answer.param_type == vehicle.param(name).type
    assert vehicle.param(name).value == stored
    assert answer.raw == struct.pack("<f", stored)


def test_live_values_are_sent_unsolicited() -> None:
    vehicle = ArduPilotVehicle(live_period=10.0)
    before = vehicle.values
    station = Station(vehicle).wait(35.0)
    assert station.times() == pytest.approx([t for t in (10, 20, 30) for _ in "ab"], abs=0.007)
    values = station.values()
    assert names(values) == ["BARO1_GND_PRESS", "STAT_RUNTIME"] * 3
    assert set(indices(values)) == {NO_INDEX}
    assert vehicle.values["STAT_RUNTIME"] == before["STAT_RUNTIME"] + 30  # type: ignore[operator]  # both are int
    assert vehicle.values["BARO1_GND_PRESS"] == pytest.approx(before["BARO1_GND_PRESS"])
    assert values[0].raw != values[2].raw


def test_a_restart_of_an_ardupilot_changes_ten_values() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    before = vehicle.values
    station = Station(vehicle).wait(3.0)
    assert vehicle.values == before
    vehicle.reboot(station.now)
    station.wait(5.0)
    assert sorted(name for name, value in vehicle.values.items() if value != before[name]) == [
        *("BARO1_GND_PRESS", "BARO2_GND_PRESS", "INS_GYR2OFFS_X", "INS_GYR2OFFS_Y", "INS_GYR2OFFS_Z"),
        *("INS_GYR2_CALTEMP", "INS_GYROFFS_X", "INS_GYROFFS_Y", "INS_GYROFFS_Z", "STAT_BOOTCNT"),
    ]


def pass_through(link: FaultyLink, count: int = 5000, gap: float = 0.001) -> list[tuple[float, int]]:
    """Send numbered datagrams at a constant rate; return arrival time and number of each that arrives."""
    for number in range(count):
        link.send(number.to_bytes(4, "big"), number * gap)
    arrived = []
    while (due := link.next_deadline()) is not None:
        arrived += [(due, int.from_bytes(data, "big")) for data in link.deliver(due)]
    return arrived


# Faulty links


def test_loss_in_bursts() -> None:
    link = FaultyLink(loss=0.2, loss_burst=8.0, seed=6)
    arrived = {number for _, number in pass_through(link)}
    assert 0.15 <= link.lost / link.sent <= 0.25
    groups = itertools.groupby(range(5000), lambda number: number not in arrived)
    runs = [len(list(run)) for is_lost, run in groups if is_lost]
    assert 6.0 <= sum(runs) / len(runs) <= 10.0
    assert link.lost == sum(runs)


def test_bit_errors() -> None:
    link = FaultyLink(bit_errors=0.01, seed=6)
    for _ in range(1000):
        link.send(bytes(100), 0.0)
    assert 7500 <= sum(bit.bit_count() for data in link.deliver(0.0) for bit in data) <= 8500


def test_a_full_queue_drops() -> None:
    link = FaultyLink(rate=1000.0, queue=250)
    for _ in range(10):
        link.send(bytes(100), 0.0)
    assert (link.sent, link.lost) == (10, 8)
    link.send(bytes(100), 0.1)
    assert link.lost == 8
    nothing_waits = FaultyLink(rate=1000.0, queue=0)
    for at in (0.0, 0.05, 0.1):
        nothing_waits.send(bytes(100), at)
    assert nothing_waits.lost == 1


def test_the_same_seed_gives_the_same_faults() -> None:
    def once(seed: int) -> list[tuple[float, int]]:
        link = FaultyLink(
            loss=0.1, jitter=0.01, duplicate=0.1, reorder=0.1, bit_errors=0.001, rate=1e5, seed=seed
        )
        return pass_through(link, 500)

    assert once(1) == once(1) != once(2)
