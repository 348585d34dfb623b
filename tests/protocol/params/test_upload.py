"""Many values as one file to a simulated ArduPilot, over good and bad links, in a time that is passed in."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from paramclient.errors import NoReply, Refused, UnknownParameter, UsageError
from paramclient.model.values import ParamType, WireValue, bits_of
from paramclient.protocol import wire
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.ftp.packets import Opcode, Packet
from paramclient.protocol.ftp.param_pck import PackedParam
from paramclient.protocol.params.table import Table
from paramclient.protocol.params.upload import WriteWay, set_time, spans_of, upload_time
from paramclient.protocol.params.write_batch import SetStatus, WriteBatch
from paramclient.protocol.station import Station
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, SimParam, Vehicle

COUNT = 120
VALUES: dict[str, WireValue] = {f"PARAM_{number:03}": float(number) for number in range(COUNT)}
WANTED: dict[str, WireValue] = {name: float(number) + 0.5 for number, name in enumerate(VALUES)}
OTHER = (254, 7)
"""Another station."""


class Ground:
    """A station and a vehicle whose table it has, on a link; the values are written as a file by default.

    Attributes:
        drops: returns whether a request of MAVFTP to the vehicle is lost.
        is_cut: whether everything is lost in both directions.
    """

    def __init__(self, vehicle: Vehicle, *, way: WriteWay = WriteWay.FILE, **faults: Any) -> None:
        seed = faults.pop("seed", 0)
        self.vehicle = vehicle
        links = (FaultyLink(**faults, seed=2 * seed), FaultyLink(**faults, seed=2 * seed + 1))
        self.air = Air([vehicle], uplink=links[0], downlink=links[1])
        self.station = Station(link="test", is_stream=False)
        self.now = 0.0
        self.drops: Callable[[Packet], bool] = lambda packet: False
        self.is_cut = False
        self._framer = wire.Framer(stream=False)
        self.air.tick(self.now)
        self.until(lambda: (1, 1) in self.station.components)
        fetch = self.machine.begin_fetch(self.now)
        self.until(lambda: fetch.done)
        self.machine.end_fetch(fetch, self.now)
        self.until(lambda: self.machine.files.is_idle)
        self.machine.uploads.way = way
        self.before = vehicle.requests.copy()

    @property
    def machine(self) -> ComponentMachine:
        return self.station.components[1, 1]

    def step(self) -> None:
        for data, _ in self.station.data_to_send():
            if not self.is_cut and not self._is_dropped(data):
                self.air.receive(data, self.now)
        deadline = self.air.next_deadline()
        due = min(self.station.next_deadline(), math.inf if deadline is None else deadline)
        self.now = max(due, self.now + 1e-7)
        self.air.tick(self.now)
        for data in [] if self.is_cut else self.air.data_to_send():
            self.station.receive(data, None, self.now)
        self.station.tick(self.now)

    def _is_dropped(self, data: bytes) -> bool:
        (frame,) = self._framer.receive(data)
        message = wire.decode(frame)
        return isinstance(message, wire.FileTransfer) and self.drops(
            Packet.unpack(message.payload.ljust(251, b"\0"))
        )

    def until(self, condition: Callable[[], bool], limit: float = 120.0) -> None:
        end = self.now + limit
        while not condition():
            assert self.now < end, f"not so within {limit} s"
            self.step()

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.step()

    def begin(self, wanted: Mapping[str, WireValue], **options: Any) -> WriteBatch:
        return self.machine.write_many(list(wanted.items()), self.now, **options)

    def write(self, wanted: Mapping[str, WireValue], **options: Any) -> WriteBatch:
        batch = self.begin(wanted, **options)
        self.until(lambda: batch.done)
        self.machine.write_batches.end(batch, self.now)
        assert len(batch.ended) == len(wanted)
        assert not self.machine.writes.queues
        return batch

    def requests(self, name: str) -> int:
        return self.vehicle.requests[name] - self.before[name]

    def values(self, names: Mapping[str, WireValue] = WANTED) -> dict[str, WireValue]:
        return {name: self.vehicle.param(name).value for name in names}


def vehicle(**options: Any) -> ArduPilotVehicle:
    return ArduPilotVehicle(table=VALUES, **options)


def statuses(batch: WriteBatch) -> dict[str, SetStatus]:
    return {outcome.name: outcome.status for outcome in batch.ended}


@pytest.mark.parametrize("loss", [0.0, 0.05, 0.3])
def test_all_values_are_set_and_proven_without_a_single_param_set(loss: float) -> None:
    for seed in range(5):
        ground = Ground(vehicle(), delay=0.05, loss=loss, seed=seed)
        batch = ground.write(WANTED)
        assert set(statuses(batch).values()) == {SetStatus.ACCEPTED}
        assert ground.values() == WANTED
        assert {name: param.value for name, param in ground.machine.table.params.items()} == WANTED
        assert ground.requests("PARAM_SET") == 0
        ground.run(2.0)
        assert ground.vehicle.open_files == []


def test_the_checksum_proves_the_values_without_a_read() -> None:
    ground = Ground(vehicle())
    opened: list[bytes] = []

    def note(packet: Packet) -> bool:
        if packet.opcode == Opcode.OPEN_FILE_RO:
            opened.append(packet.data)
        return False

    ground.drops = note
    down = ground.station.bytes_received
    ground.write(WANTED)
    assert opened == []
    assert ground.station.bytes_received - down < 600


def test_a_value_that_has_changed_unnoticed_is_no_obstacle() -> None:
    """The checksum differs then, and that part of the table is read."""
    ground = Ground(vehicle())
    ground.vehicle.set_param("PARAM_050", 77.0)
    ground.run(1.0)
    stale = ground.machine.table.params["PARAM_060"]
    ground.vehicle._apply_packed([PackedParam("PARAM_060", ParamType.REAL32, bits_of(5.0, ParamType.REAL32))])
    wanted = {name: value for name, value in WANTED.items() if name != "PARAM_060"}
    assert ground.machine.table.params["PARAM_060"] == stale
    batch = ground.write(wanted)
    assert set(statuses(batch).values()) == {SetStatus.ACCEPTED}
    assert ground.requests("PARAM_SET") == 0


@pytest.mark.parametrize("param_error", [False, True])
def test_every_outcome_is_that_of_a_param_set(param_error: bool) -> None:
    table = [
        *(SimParam(name, ParamType.REAL32, value) for name, value in VALUES.items()),
        SimParam("COUNT_16", ParamType.INT16, 3),
        SimParam("BARO1_DEVID", ParamType.INT32, 5),
    ]
    wanted: dict[str, WireValue] = {
        **WANTED,
        "COUNT_16": 7.6,
        "BARO1_DEVID": 9,
        "NO_SUCH": 1.0,
        "PARAM_007": float("nan"),
    }
    found = {}
    for way in (WriteWay.FILE, WriteWay.SETS):
        ground = Ground(ArduPilotVehicle(table=table, param_error=param_error), way=way)
        batch = ground.write(wanted)
        found[way] = statuses(batch)
        by_name = {outcome.name: outcome for outcome in batch.ended}
        assert by_name["COUNT_16"].status is SetStatus.ADJUSTED
        assert ground.vehicle.param("COUNT_16").value == 7
        assert ground.vehicle.param("BARO1_DEVID").value == 5
        assert isinstance(by_name["BARO1_DEVID"].error, Refused)
        assert isinstance(by_name["NO_SUCH"].error, UnknownParameter)
        assert isinstance(by_name["PARAM_007"].error, UsageError)
        assert (ground.requests("PARAM_SET") < 10) == (way is WriteWay.FILE)
    assert found[WriteWay.FILE] == found[WriteWay.SETS]


def test_a_parameter_that_newer_firmware_skips_is_refused_by_param_set() -> None:
    ground = Ground(vehicle(read_only=["PARAM_033"], param_error=True))
    batch = ground.write(WANTED)
    refused = [outcome.name for outcome in batch.ended if outcome.status is SetStatus.REFUSED]
    assert refused == ["PARAM_033"]
    assert ground.requests("PARAM_SET") == 1
    assert ground.values() == WANTED | {"PARAM_033": 33.0}


def test_values_go_by_param_set_while_another_station_has_a_file_open() -> None:
    ground = Ground(vehicle())
    request = Packet(9, 77, Opcode.OPEN_FILE_RO, b"@PARAM/param.pck").pack()
    data = wire.encode(wire.FileTransfer(0, 1, 1, request), system=OTHER[0], component=OTHER[1], sequence=0)
    ground.vehicle.receive(data, ground.now)  # its response does not pass this link
    batch = ground.write(WANTED)
    assert set(statuses(batch).values()) == {SetStatus.ACCEPTED}
    assert ground.values() == WANTED
    assert ground.requests("PARAM_SET") == COUNT


def test_an_upload_that_the_vehicle_refuses_is_not_repeated() -> None:
    ground = Ground(vehicle())
    server = ground.vehicle._ftp
    assert server is not None
    server.apply = lambda rows: 0.0  # it acknowledges, and takes nothing
    ground.write(WANTED)
    assert ground.requests("PARAM_SET") == COUNT
    files = ground.requests("FILE_TRANSFER_PROTOCOL")
    ground.write(VALUES)
    assert ground.requests("PARAM_SET") == 2 * COUNT
    assert ground.requests("FILE_TRANSFER_PROTOCOL") == files
    assert ground.values() == VALUES


def test_a_lost_beginning_is_no_loss() -> None:
    """The vehicle then drops the file, and acknowledges its end: the values go by PARAM_SET."""
    ground = Ground(vehicle())
    ground.drops = lambda packet: packet.opcode == Opcode.WRITE_FILE and packet.offset == 0
    batch = ground.write(WANTED)
    assert set(statuses(batch).values()) == {SetStatus.ACCEPTED}
    assert ground.values() == WANTED
    assert ground.requests("PARAM_SET") == COUNT


@pytest.mark.parametrize("moment", [0.0, 0.06, 0.12, 0.2, 0.3, 0.42, 0.55, 0.7])
def test_a_cancelled_call_leaves_all_values_or_none_and_no_open_session(moment: float) -> None:
    ground = Ground(vehicle(), delay=0.05)
    batch = ground.begin(WANTED)
    ground.run(moment)
    ground.machine.write_batches.end(batch, ground.now)
    assert not ground.machine.writes.queues
    ground.run(1.0)
    assert ground.machine.files.is_idle
    assert ground.vehicle.open_files == []
    assert ground.values() in (VALUES, WANTED)


@pytest.mark.parametrize("moment", [0.06, 0.2, 0.33])
def test_the_timeout_of_a_call_names_what_may_have_been_set(moment: float) -> None:
    ground = Ground(vehicle(), delay=0.05)
    batch = ground.begin(WANTED)
    ground.run(moment)
    batch.give_up(NoReply("values", attempts=1, waited=moment), ground.now)
    (status,) = set(statuses(batch).values())
    ground.run(1.0)
    assert ground.vehicle.open_files == []
    if status is SetStatus.NOT_TRIED:
        assert ground.values() == VALUES
    else:
        assert status is SetStatus.UNKNOWN
    assert (status is SetStatus.NOT_TRIED) == (moment < 0.25)


def test_a_vehicle_that_is_lost_in_the_middle_has_taken_nothing() -> None:
    ground = Ground(vehicle(), delay=0.05)
    batch = ground.begin(WANTED)
    ground.run(0.2)
    ground.is_cut = True
    ground.until(lambda: batch.done)
    assert set(statuses(batch).values()) == {SetStatus.NOT_TRIED}
    assert isinstance(batch.failure, NoReply)
    ground.machine.write_batches.end(batch, ground.now)
    assert ground.values() == VALUES


def test_the_values_after_a_switch_are_written_after_it() -> None:
    group = {f"GRP_{number:02}": 1.0 for number in range(30)}
    table = [SimParam("GRP_ENABLE", ParamType.INT8, 0)]
    table += [SimParam(name, ParamType.REAL32, value) for name, value in VALUES.items()]
    ground = Ground(ArduPilotVehicle(table=table, groups={"GRP_ENABLE": group}))
    wanted: dict[str, WireValue] = {**WANTED, "GRP_ENABLE": 1, **dict.fromkeys(group, 2.0)}
    batch = ground.write(wanted)
    assert [outcome.name for outcome in batch.ended][COUNT] == "GRP_ENABLE"
    assert set(statuses(batch).values()) == {SetStatus.ACCEPTED}
    assert ground.values(wanted) == wanted
    assert ground.machine.table.count == len(wanted)


def test_values_of_one_name_are_written_in_order() -> None:
    ground = Ground(vehicle())
    pairs = [*WANTED.items(), *((name, value) for name, value in list(VALUES.items())[:30])]
    batch = ground.machine.write_many(pairs, ground.now)
    ground.until(lambda: batch.done)
    assert len(batch.ended) == COUNT + 30
    assert ground.values() == WANTED | dict(list(VALUES.items())[:30])


def test_a_write_of_another_call_waits_for_the_file() -> None:
    ground = Ground(vehicle(), delay=0.05)
    batch = ground.begin(WANTED)
    ground.run(0.1)
    later = ground.machine.write("PARAM_005", 99.0, ground.now)
    ground.until(lambda: batch.done and later.done)
    assert set(statuses(batch).values()) == {SetStatus.ACCEPTED}
    assert ground.values() == WANTED | {"PARAM_005": 99.0}


faults = st.fixed_dictionaries(
    {
        "loss": st.sampled_from((0.0, 0.05, 0.2)),
        "delay": st.sampled_from((0.0, 0.05, 0.3)),
        "jitter": st.sampled_from((0.0, 0.02)),
        "duplicate": st.sampled_from((0.0, 0.1)),
        "reorder": st.sampled_from((0.0, 0.2)),
        "seed": st.integers(0, 10_000),
    }
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(faults, st.lists(st.integers(-1000, 1000), min_size=25, max_size=COUNT), st.booleans())
def test_on_any_link_each_value_is_set_and_has_one_outcome(
    faults: dict[str, Any], numbers: list[int], param_error: bool
) -> None:
    ground = Ground(vehicle(param_error=param_error), **faults)
    wanted: dict[str, WireValue] = {f"PARAM_{at:03}": float(number) for at, number in enumerate(numbers)}
    batch = ground.write(wanted)
    assert set(statuses(batch).values()) == {SetStatus.ACCEPTED}
    assert ground.values() == VALUES | wanted


# Which way


@pytest.mark.parametrize(
    ("values", "options", "by_file"),
    [
        (COUNT, {"delay": 0.075, "rate": 5760.0, "queue": 1024.0}, True),
        (COUNT, {"delay": 0.3}, True),
        (20, {"delay": 0.075, "rate": 5760.0, "queue": 1024.0}, False),
        (COUNT, {"delay": 0.0005}, False),
    ],
)
def test_the_quicker_way_is_taken(values: int, options: dict[str, float], by_file: bool) -> None:
    rate = options.get("rate", 48_500.0)
    table = {**VALUES, **{f"Z_{number:04}": 0.0 for number in range(600)}}
    served = ArduPilotVehicle(table=table, ftp_rate=rate, burst=1, period=0.025)
    ground = Ground(served, way=WriteWay.QUICKEST, **options)
    ground.write(dict(list(WANTED.items())[:values]))
    assert (ground.requests("PARAM_SET") == 0) == by_file


def test_a_link_that_is_not_measured_is_left_to_param_set() -> None:
    """The file was too short to show the rate of the link."""
    ground = Ground(ArduPilotVehicle(table=dict(list(VALUES.items())[:40])), way=WriteWay.QUICKEST, delay=0.3)
    ground.write(dict(list(WANTED.items())[:40]))
    assert ground.requests("PARAM_SET") == 40


def test_values_that_are_watched_are_sent_by_param_set() -> None:
    ground = Ground(vehicle())
    ground.write(WANTED, settle=0.2)
    assert ground.requests("PARAM_SET") == COUNT


def test_parts_end_at_values_that_are_unknown_or_move() -> None:
    ground = Ground(ArduPilotVehicle())
    table: Table = ground.machine.table
    by_index = {param.index: name for name, param in table.params.items()}
    moving = table.params["BARO1_GND_PRESS"].index
    assert moving is not None
    names = [by_index[at] for at in (moving - 5, moving - 1, moving + 1, moving + 3)]
    entries = {name: PackedParam(name, ParamType.REAL32, 0) for name in names}
    assert [span[:] for span in spans_of(entries, table)] == [
        (moving - 5, moving - 1, True),
        (moving + 1, moving + 3, True),
    ]


def test_an_upload_is_no_quicker_for_few_values_on_a_short_way() -> None:
    entries = {name: PackedParam(name, ParamType.REAL32, 0) for name in VALUES}
    assert set_time(30, 0.1, 1e9) == pytest.approx(0.2)
    assert set_time(200, 0.1, 1e9) == pytest.approx(0.8)
    assert set_time(200, 0.1, 5760.0) == pytest.approx(0.1 + 200 * 72 / 5760)
    assert upload_time(entries, [], 0.1, 1e9) == pytest.approx(0.3, rel=1e-3)
