"""The watch over tables: what it costs, what keeps it from asking, and how soon others' changes are found."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from itertools import pairwise

import pytest

from paramclient.model.values import ParamType
from paramclient.protocol import wire
from paramclient.protocol.ftp.packets import Opcode, Packet
from paramclient.protocol.params.fetch import Check
from paramclient.protocol.params.fetch_result import FetchResult, FetchSource
from paramclient.protocol.params.sync import (
    FOREIGN_CHECK_INTERVAL,
    FOREIGN_SETTLING_TIME,
    SyncSettings,
    SyncState,
)
from paramclient.protocol.params.sync_interval import FETCHES_KEPT, PAUSE_MIN, SyncInterval
from paramclient.protocol.requests.retry import ATTEMPTS_MIN, FILE_IN_USE_RETRY
from paramclient.protocol.wire import (
    DECODED_IDS,
    CommandLong,
    FileTransfer,
    Framer,
    ParamRequestList,
    ParamRequestRead,
)
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, SimParam, px4_table
from tests.protocol.params.test_sync import INTERVAL, NAMES, PLAIN, TABLE, World, fetched, resynced, state
from tests.shell import Tap
from tests.simulation import is_so, listing_ardupilot

VOLATILE = [row.name for row in TABLE if row.volatile]
PATH = b"@PARAM/param.pck"


def watched(
    vehicle: ArduPilotVehicle, *, sync_settings: SyncSettings | None = None, air: Air | None = None
) -> tuple[World, ArduPilotVehicle]:
    """An ArduPilot whose table was just fetched, as a file where it serves one."""
    world = World(*() if air else (vehicle,), air=air, sync_settings=sync_settings)
    assert world.fetch().complete
    world.run(10.0)  # what is measured at the start has been read
    world.sent.clear()
    world.events.clear()
    return world, vehicle


def packets(world: World, opcode: Opcode) -> list[tuple[float, Packet]]:
    """The requests to the MAVFTP server, with their times."""
    unpacked = [
        (at, Packet.unpack(each.payload)) for at, each in world.sent if isinstance(each, FileTransfer)
    ]
    return [(at, packet) for at, packet in unpacked if packet.opcode == opcode]


def openings(world: World) -> list[float]:
    """When the opening of a file was requested; it is requested twice at once."""
    return list(dict.fromkeys(at for at, _ in packets(world, Opcode.OPEN_FILE_RO)))


class Other:
    """Another station at the files of a vehicle. Where it is on another link, it is not heard on ours."""

    def __init__(self, world: World, *, is_received: bool) -> None:
        self.world = world
        self.is_received = is_received
        self.sequence = 1000

    def ask(self, opcode: Opcode, data: bytes = b"", *, size: int = 0) -> None:
        self.sequence += 2
        packet = Packet(self.sequence, 7, opcode, data, size)
        tap = self.world.tap
        was_mute, tap.is_mute = tap.is_mute, not self.is_received
        self.world.other_station(FileTransfer(0, 1, 1, packet.pack()))
        self.world.run(0.05)
        tap.is_mute = was_mute


# what checks cost


class WithoutServer(Tap):
    """An ArduPilot that says that it serves files, and does not respond to requests for one."""

    def receive(self, data: bytes, now: float) -> None:
        if not any(frame.message_id == 110 for frame in Framer(DECODED_IDS, stream=False).receive(data)):
            super().receive(data, now)


def test_checks_of_a_vehicle_whose_server_never_responds_are_short_and_harm_nothing() -> None:
    """Unanswered requests must not add up to a check of an hour, in which the table counts as fetching."""
    vehicle = ArduPilotVehicle(table=PLAIN)
    air = Air.symmetric([WithoutServer(vehicle)], delay=0.1)
    world = World(air=air)
    assert world.fetch().source == "stream"
    world.run(10.0)
    retry = world.machine.retry
    timeout = retry.timeout
    busy = 0.0
    for _ in range(20):
        world.until(lambda: world.machine.fetch is not None, INTERVAL + 1.0)
        began = world.now
        world.until(lambda: world.machine.fetch is None, 10.0)
        busy += world.now - began
    assert busy < 20 * 0.2 * INTERVAL
    assert retry.timeout <= timeout
    assert (retry.tries, retry.round_trip.seen_loss) == (ATTEMPTS_MIN, 0.0)


def test_one_file_that_takes_long_does_not_end_the_watch() -> None:
    world, vehicle = watched(ArduPilotVehicle(table=PLAIN))
    world.until(lambda: bool(openings(world)))
    world.tap.is_mute = world.tap.is_deaf = True
    world.run(1.8)
    world.tap.is_mute = world.tap.is_deaf = False
    world.until(lambda: world.machine.fetch is None)
    result = world.machine.fetches.last
    assert result is not None
    assert result.elapsed > 1.5
    assert state(world) is SyncState.SYNCED
    world.change_silently(vehicle, P07=700)
    world.run(INTERVAL + 1.0)
    assert resynced(world) == [("P07",)]


@pytest.mark.parametrize("rate", [200.0, 100.0])
def test_a_slow_link_is_looked_at_less_often_and_not_never(rate: float) -> None:
    world, vehicle = watched(ArduPilotVehicle(table=PLAIN, ftp_rate=rate))
    last = world.machine.fetches.last
    assert last is not None
    assert last.source == "ftp"
    world.run(20 * last.elapsed * 8)
    times = openings(world)
    assert len(times) >= 5
    apart = [after - before for before, after in pairwise(times)]
    assert min(apart[1:]) > 15.0 * last.elapsed > INTERVAL
    assert max(apart[1:]) < 30.0 * last.elapsed
    assert world.sent_of(ParamRequestList) == []
    world.change_silently(vehicle, P07=700)
    world.run(1.3 * max(apart))
    assert resynced(world) == [("P07",)]


def test_the_first_of_all_fetches_does_not_settle_how_often_it_is_looked() -> None:
    vehicle = ArduPilotVehicle(table=PLAIN)
    world = World(vehicle)
    world.meet()
    fetch = world.machine.begin_fetch(world.now)
    world.tap.is_mute = True
    world.run(4.0)
    world.tap.is_mute = False
    assert world.outcome(fetch).source == "ftp"
    world.machine.end_fetch(fetch, world.now)
    world.sent.clear()
    world.run(121.0)
    assert len(openings(world)) >= 1
    world.sent.clear()
    world.run(10 * INTERVAL)
    assert len(openings(world)) >= 9


def test_a_check_whose_file_does_not_arrive_downloads_no_list() -> None:
    world, vehicle = watched(ArduPilotVehicle(table=PLAIN))
    files, vehicle._ftp = vehicle._ftp, None
    world.run(2 * INTERVAL)
    assert openings(world)
    assert world.sent_of(ParamRequestList) == []
    assert state(world) is SyncState.SYNCED
    vehicle._ftp = files
    world.change_silently(vehicle, P07=700)
    world.run(2 * INTERVAL)
    assert resynced(world) == [("P07",)], "the watch goes on"


def test_a_chosen_interval_lists_where_there_is_no_file_half_of_the_time_at_most() -> None:
    vehicle = listing_ardupilot(table=PLAIN, burst=1, period=0.08)
    world, _ = watched(vehicle, sync_settings=SyncSettings(5.0, without_hash=True))
    world.run(100.0)
    assert 13 <= len(world.sent_of(ParamRequestList)) <= 16, "the list takes 3.2 s"


def test_a_count_that_changes_all_the_time_is_followed_once_a_second() -> None:
    world, vehicle = watched(
        ArduPilotVehicle(table={**PLAIN, "X_ENABLE": 0}, groups={"X_ENABLE": {"X_A": 1}})
    )
    for number in range(200):
        vehicle.set_param("X_ENABLE", number % 2)
        vehicle.set_param("P01", number)  # reports the count
        world.run(0.05)
    times = openings(world)
    assert 5 <= len(times) <= 2 * 10.0 / PAUSE_MIN, "some are read twice, as the count has changed meanwhile"


# other stations' files


@pytest.mark.parametrize("is_received", [True, False], ids=["heard", "on another link"])
@pytest.mark.parametrize("sync_settings", [SyncSettings(INTERVAL), SyncSettings(INTERVAL, without_hash=True)])
def test_while_another_station_has_a_file_open_a_check_skips_its_turn(
    is_received: bool, sync_settings: SyncSettings
) -> None:
    world, vehicle = watched(ArduPilotVehicle(table=PLAIN), sync_settings=sync_settings)
    other = Other(world, is_received=is_received)
    world.run(INTERVAL - 20.0)
    other.ask(Opcode.OPEN_FILE_RO, PATH)
    assert vehicle.open_files
    world.change_silently(vehicle, P07=700)
    world.sent.clear()
    for _ in range(60):
        other.ask(Opcode.READ_FILE, size=20)
        world.run(0.95)
    assert world.sent_of(ParamRequestList) == []
    closing = (Opcode.RESET_SESSIONS, Opcode.TERMINATE_SESSION)
    assert [packets(world, opcode) for opcode in closing] == [[], []], "which may close what others have open"
    times = openings(world)
    assert is_received == (not times)
    assert len(times) <= 60.0 / FILE_IN_USE_RETRY + 2, "with another number where the first one was in use"
    assert resynced(world) == []
    assert vehicle.open_files == [PATH.decode()]
    other.ask(Opcode.TERMINATE_SESSION)
    world.run((INTERVAL if is_received else 2 * FILE_IN_USE_RETRY) + 1.0)
    assert resynced(world) == [("P07",)]
    world.sent.clear()
    world.run(3 * INTERVAL)
    assert len(openings(world)) == 3, "in its intervals again"


def test_a_caller_that_joins_a_check_gets_the_list_where_the_file_is_in_use() -> None:
    world, _ = watched(ArduPilotVehicle(table=PLAIN))
    other = Other(world, is_received=False)
    other.ask(Opcode.OPEN_FILE_RO, PATH)
    machine = world.machine
    check = machine.begin_fetch(world.now, refresh=True, check=Check(may_list=False))
    fetch = machine.begin_fetch(world.now, refresh=True)
    assert fetch is check, "one at a time"
    for _ in range(20):
        other.ask(Opcode.READ_FILE, size=20)
        world.run(0.4)
    result = world.outcome(fetch)
    assert (result.source, result.complete) == ("stream", True)


def test_start_values_are_read_singly_while_another_station_has_a_file_open() -> None:
    world, vehicle = watched(ArduPilotVehicle())
    vehicle.reboot(world.now, down=0.5)
    world.run(3.0)
    other = Other(world, is_received=True)
    other.ask(Opcode.OPEN_FILE_RO, PATH)
    world.sent.clear()
    for _ in range(6):
        other.ask(Opcode.READ_FILE, size=20)
        world.run(0.95)
    assert world.sent_of(ParamRequestList) == []
    assert openings(world) == []
    assert [each.param_id for each in world.sent_of(ParamRequestRead)]


# the pace


def took(seconds: float, source: FetchSource = "ftp", missing: tuple[int, ...] = ()) -> FetchResult:
    return FetchResult(1, 1, {}, source, 1, 1, missing, None, seconds)


def test_the_median_of_the_last_times_counts() -> None:
    pace = SyncInterval(30.0, is_chosen=False)
    assert pace.interval(may_use_file=False) == math.inf
    assert pace.interval(may_use_file=True) == 28.5
    assert is_so(not pace.file_is_quick)
    for seconds in (0.4, 0.4, 0.4, 20.0, 0.4):
        pace.fetched(took(seconds), 0.0)
    assert pace.interval(may_use_file=False) == 28.1, "the check ends within the interval"
    assert is_so(pace.file_is_quick)
    for _ in range(FETCHES_KEPT):
        pace.fetched(took(5.0), 2.0)
    assert pace.interval(may_use_file=False) == pytest.approx(60.0)
    assert is_so(not pace.file_is_quick)
    pace.fetched(took(0.1, missing=(3,)), 0.0)
    pace.fetched(took(0.1, "cache"), 0.0)
    pace.fetched(took(0.1, "stream"), 0.0)
    assert pace.interval(may_use_file=False) == pytest.approx(60.0)
    pace.forget()
    assert pace.interval(may_use_file=False) == math.inf


def test_a_chosen_interval_is_stretched_less() -> None:
    pace = SyncInterval(10.0, is_chosen=True)
    assert pace.interval(may_use_file=False) == 9.5
    for _ in range(3):
        pace.fetched(took(35.0, "stream"), 0.0)
    assert pace.interval(may_use_file=False) == 70.0
    assert pace.shortest_pause == 35.0
    pace.fetched(took(3.0), 0.0)
    assert pace.interval(may_use_file=False) == 6.5


def test_the_hash_is_requested_so_early_that_a_fetch_ends_within_the_interval() -> None:
    pace = SyncInterval(30.0, is_chosen=False)
    assert pace.hash_interval == 28.5
    for _ in range(3):
        pace.fetched(took(0.9, "stream"), 0.0)
    assert pace.hash_interval == 27.6
    for _ in range(3):
        pace.fetched(took(20.0), 0.0)
    assert pace.hash_interval == 27.0, "a twentieth of the interval, at most"


@pytest.mark.parametrize("after", [0.01, 0.5, 1.2])
def test_a_change_during_or_after_a_file_check_is_corrected_within_one_interval(after: float) -> None:
    world, vehicle = watched(ArduPilotVehicle(table=PLAIN, ftp_rate=500.0))
    last = world.machine.fetches.last
    assert last is not None
    assert 0.8 < last.elapsed < 1.4
    world.run(2 * INTERVAL)
    world.sent.clear()
    world.until(lambda: bool(openings(world)))
    world.run(after)
    entry = vehicle._entry("P07")
    entry.store(entry.bits ^ 1)  # nothing is sent of it
    assert wrong(world, vehicle) == 1
    world.run(INTERVAL)
    assert wrong(world, vehicle) == 0


def test_a_change_of_px4_after_a_hash_check_is_corrected_within_one_interval() -> None:
    vehicle = PX4Vehicle(clamp_delay=None)
    world = World(vehicle)
    elapsed = world.fetch().elapsed
    assert elapsed > 0.5
    world.until(lambda: bool(world.hashes(5.0)))
    world.run(0.1)
    vehicle.load({"MC_ROLL_P": 7.5})
    world.run(INTERVAL)
    assert wrong(world, vehicle) == 0


# what others change on PX4


def quad(seed: int = 0, sync_settings: SyncSettings | None = None) -> tuple[World, PX4Vehicle]:
    vehicle = PX4Vehicle(clamp_delay=None)
    world = World(vehicle, sync_settings=sync_settings)
    assert world.fetch().complete
    world.run(3.0 + seed / 10)
    world.sent.clear()
    world.events.clear()
    return world, vehicle


def wrong(world: World, vehicle: PX4Vehicle | ArduPilotVehicle) -> int:
    """How many values of the table are not the vehicle's."""
    params = world.machine.table.params
    return sum(params[name].value != value for name, value in vehicle.values.items())


@pytest.mark.parametrize("pause", [0.0002, 0.001, 0.002, 0.005])
def test_values_set_by_another_station_at_full_speed_are_corrected_after_the_last_one(pause: float) -> None:
    """On a link of its own: ours receives a part only."""
    world, vehicle = quad()
    rows = [row for row in px4_table() if row.type is ParamType.REAL32 and not row.volatile]
    random.Random(1).shuffle(rows)
    for row in rows[:200]:
        world.run(pause)
        vehicle.set_param(row.name, float(row.value) + 1.0)
    world.run(FOREIGN_SETTLING_TIME - 0.1)
    assert wrong(world, vehicle) > 5, "PX4 does not report all changes"
    world.run(1.6)
    assert wrong(world, vehicle) == 0
    assert state(world) is SyncState.SYNCED
    assert len(world.sent_of(ParamRequestList)) == 1
    assert len(world.sent_of(ParamRequestRead)) <= 10, "its pushes are no list of another station"
    assert len(world.hashes()) <= 4
    assert len(resynced(world)) == 1


def test_foreign_values_cost_one_question_when_they_have_stopped() -> None:
    world, vehicle = fetched()
    world.run(2.0)
    for number in range(8):
        vehicle.set_param(NAMES[number], 1000 + number)
        world.run(0.25)
    stopped = world.now - 0.25
    world.run(10.0)
    (at,) = world.hashes()
    assert at == pytest.approx(stopped + 0.02 + FOREIGN_SETTLING_TIME, abs=0.01)
    assert world.requests() == 1
    assert state(world) is SyncState.SYNCED


def test_values_that_change_for_ever_cost_one_question_in_two_seconds() -> None:
    world, vehicle = fetched()
    for number in range(60):
        vehicle.set_param("P07", 1000 + number)
        world.run(1.0)
    times = world.hashes()
    assert 20 <= len(times) <= 60 / FOREIGN_CHECK_INTERVAL + 2
    assert min(after - before for before, after in pairwise(times)) > 0.4
    assert world.sent_of(ParamRequestList) == []


def test_our_own_writes_are_no_foreign_values() -> None:
    world, _ = fetched()
    for number in range(5):
        world.set("P07", 1000 + number)
        world.run(3.0)
    assert len(world.hashes()) == 10, "one after each, and one as modules may have changed the value"


@pytest.mark.parametrize("loaded", [{"P07": 700}, {"P07": 700, "P21": 2100, "COM_FLIGHT_UUID": 8}])
def test_changes_that_px4_does_not_push_are_found_within_one_interval(loaded: dict[str, int]) -> None:
    world, vehicle = fetched()
    vehicle.load(loaded)
    world.run(5.0)
    assert world.requests() == 0
    world.run(INTERVAL)
    assert resynced(world) == [tuple(sorted(loaded, key=list(vehicle.values).index))]
    assert wrong(world, vehicle) == 0


def test_a_storage_reset_by_another_station_is_found_within_one_interval() -> None:
    world, vehicle = fetched()
    world.set("P07", 700)
    world.run(5.0)
    reset = CommandLong(1, 1, wire.MAV_CMD_PREFLIGHT_STORAGE, (2.0, *[0.0] * 6))
    world.other_station(reset)
    assert vehicle.values["P07"] == 7
    world.run(INTERVAL + 1.0)
    assert wrong(world, vehicle) == 0


def test_volatile_values_are_read_again_in_each_interval() -> None:
    world, vehicle = fetched()
    world.change_silently(vehicle, COM_FLIGHT_UUID=8)
    world.run(INTERVAL)
    assert world.machine.table.params["COM_FLIGHT_UUID"].value == 8
    assert resynced(world) == []
    assert state(world) is SyncState.SYNCED
    world.sent.clear()
    world.run(3 * INTERVAL)
    names = [each.param_id for each in world.sent_of(ParamRequestRead)]
    assert sorted(set(names)) == sorted([wire.HASH_CHECK, *VOLATILE])
    assert len(names) == 3 * 3


def test_on_a_slow_link_they_are_read_in_a_twentieth_of_the_time_at_most() -> None:
    rows = [
        SimParam(f"CAL_MAG{n}_{axis}OFF", ParamType.INT32, 7, volatile=True)
        for n in range(4)
        for axis in "XYZ"
    ]
    vehicle = PX4Vehicle(table=[*TABLE, *(row for row in rows if row.name != "CAL_MAG0_XOFF")])
    world = World(air=Air.symmetric([vehicle], delay=0.4), sync_settings=SyncSettings(10.0))
    world.fetch()
    world.run(20.0)
    world.sent.clear()
    world.run(400.0)
    reads = [each for each in world.sent_of(ParamRequestRead) if each.param_id != wire.HASH_CHECK]
    rounds = len(reads) / len(world.machine.table.volatile)
    assert len(world.hashes()) >= 35
    assert 15 <= rounds <= 21, "0.8 s in 20"


def test_the_volatile_values_of_one_vehicle_keep_no_other_from_its_check() -> None:
    vehicles = [PX4Vehicle(system=system, table=TABLE) for system in range(1, 41)]
    taps = [Tap(vehicle) for vehicle in vehicles]
    world = World(air=Air.symmetric(taps, delay=0.3), sync_settings=SyncSettings(INTERVAL))
    world.run(2.0)
    machines = list(world.station.components.values())
    fetches = [machine.begin_fetch(world.now) for machine in machines]
    world.until(lambda: all(fetch.done for fetch in fetches))
    for machine, fetch in zip(machines, fetches, strict=True):
        machine.end_fetch(fetch, world.now)
    world.run(INTERVAL)
    world.sent.clear()
    world.run(4 * INTERVAL)
    checked = [
        each.target_system for each in world.sent_of(ParamRequestRead) if each.param_id == wire.HASH_CHECK
    ]
    assert all(3 <= checked.count(system) <= 5 for system in range(1, 41))
    assert len(world.sent) < 40 * 4 * 3 * 1.3 + 200, "three questions in each interval, and our heartbeats"


@pytest.mark.parametrize(
    "sync_settings", [SyncSettings(), replace(SyncSettings(INTERVAL), interval=math.inf)]
)
def test_without_a_watch_nothing_is_requested_after_foreign_values(sync_settings: SyncSettings) -> None:
    world, vehicle = fetched(sync_settings=sync_settings)
    world.run(2.0)
    vehicle.set_param("P07", 700)
    world.run(100.0)
    assert world.requests() == 0


def test_nothing_is_requested_after_foreign_values_in_high_latency_mode() -> None:
    world, vehicle = fetched()
    world.run(2.0)
    vehicle.set_param("P07", 700)
    world.run(0.2)
    vehicle.high_latency = True
    world.machine.receive(wire.HighLatency2(2, wire.MAV_AUTOPILOT_PX4), world.now)
    world.run(20.0)
    assert world.requests() == 0


def test_a_listen_only_station_sends_nothing_after_changes() -> None:
    vehicle = PX4Vehicle(table=TABLE)
    sync_settings = SyncSettings.chosen(None, "auto", listen_only=True)
    world = World(vehicle, sync_settings=sync_settings)
    world.other_station(ParamRequestList(1, 1))
    world.run(5.0)
    for number in range(20):
        vehicle.set_param(NAMES[number], 1000 + number)
        world.run(0.3)
    vehicle.load({"P30": 7})
    world.run(100.0)
    assert world.sent == []
    assert world.station.frames_sent == 0
