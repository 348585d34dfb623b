"""Staying in step with a vehicle, losing it and finding it again: whole sessions in simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import pytest
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params.reads import Read
from paramclient.protocol.params.sync import GAP_CHECK_INTERVAL, WATCH_INTERVAL, SyncSettings
from paramclient.protocol.params.writes import Write
from paramclient.protocol.requests.retry import FETCH_RESTARTS_MAX
from paramclient.protocol.vehicle.presence import LOST_AFTER

from paramclient.errors import NoReply, UsageError
from paramclient.model.values import ParamType, Trust
from paramclient.protocol.events import (
    ComponentFound,
    ComponentLost,
    ComponentRebooted,
    Event,
    Fetched,
    ParamChanged,
    TableResynced,
)
from paramclient.protocol.fetch import Policy
from paramclient.protocol.station import Station
from paramclient.protocol.watch import SyncState
from paramclient.sim import Air, ArduPilotVehicle, Endpoint, GenericVehicle, PX4Vehicle, SimParam
from paramclient.wire import messages
from paramclient.wire.messages import (
    HASH_CHECK,
    CommandLong,
    FileTransfer,
    ParamRequestList,
    ParamRequestRead,
    ParamSet,
)
from tests.shell import Tap
from tests.simulation import Memory, Simulation, is_so, listed

INTERVAL = 30.0
NAMES = [f"P{number:02d}" for number in range(40)]
TABLE = [
    *(SimParam(name, ParamType.INT32, number) for number, name in enumerate(NAMES)),
    SimParam("CAL_MAG0_XOFF", ParamType.INT32, 7, volatile=True),
    SimParam("COM_FLIGHT_UUID", ParamType.INT32, 7, volatile=True),
]
VOLATILE = 2
PLAIN = {name: number for number, name in enumerate(NAMES)}


class World(Simulation):
    """A simulation whose station keeps its tables up, with one tapped vehicle after the other."""

    def __init__(
        self, *vehicles: Endpoint, air: Air | None = None, sync_settings: SyncSettings | None = None
    ) -> None:
        self.taps = [Tap(vehicle) for vehicle in vehicles]
        self.sync_settings = SyncSettings(INTERVAL) if sync_settings is None else sync_settings
        super().__init__(*self.taps, air=air, station=self.a_station())

    def a_station(self) -> Station:
        return Station(link="sim:test", is_stream=False, sync_settings=self.sync_settings)

    @property
    def tap(self) -> Tap:
        return self.taps[0]

    def away(self, seconds: float) -> None:
        """The vehicle is out of reach for a while, both ways."""
        self.tap.is_mute = self.tap.is_deaf = True
        self.run(seconds)
        self.tap.is_mute = self.tap.is_deaf = False

    def change_silently(self, vehicle: PX4Vehicle | ArduPilotVehicle, **values: int) -> None:
        """Values change on board, and the messages that report it are lost."""
        self.tap.is_mute = True
        for name, value in values.items():
            vehicle.set_param(name, value)
        self.run(0.2)
        self.tap.is_mute = False

    def reported(self, *kinds: type) -> list[Event]:
        return [event for event in self.events if isinstance(event, kinds)]

    def hashes(self, since: float = 0.0) -> list[float]:
        """When the hash was requested."""
        return [
            now
            for now, message in self.sent
            if now >= since and isinstance(message, ParamRequestRead) and message.param_id == HASH_CHECK
        ]

    def requests(self) -> int:
        """Everything sent that has to do with parameters."""
        return sum(len(self.sent_of(kind)) for kind in (ParamRequestRead, ParamRequestList, ParamSet))


def fetched(
    make: Callable[..., PX4Vehicle] = PX4Vehicle,
    *,
    sync_settings: SyncSettings | None = None,
    **options: object,
) -> tuple[World, PX4Vehicle]:
    """A vehicle whose table was just fetched."""
    vehicle = make(table=TABLE, **options)
    world = World(vehicle, sync_settings=sync_settings)
    assert world.fetch().complete
    assert state(world) is SyncState.SYNCED
    world.run(1.0)
    world.events.clear()
    world.sent.clear()
    return world, vehicle


def state(world: World) -> SyncState:
    return world.machine.sync_state


def resynced(world: World) -> list[tuple[str, ...]]:
    return [event.changed for event in world.events if isinstance(event, TableResynced)]


def trusts(machine: ComponentMachine) -> set[Trust]:
    return {param.trust for param in machine.table.params.values()}


# the watch


def test_an_update_that_was_lost_is_found_within_one_interval() -> None:
    world, vehicle = fetched()
    world.change_silently(vehicle, P07=700, P09=900)
    assert world.machine.table.params["P07"].value == 7
    assert state(world) is SyncState.SYNCED, "nothing shows it yet"
    world.run(INTERVAL)
    assert world.machine.table.params["P07"].value == 700
    assert resynced(world) == [("P07", "P09")]
    (event,) = world.reported(TableResynced)
    assert isinstance(event, TableResynced)
    assert event.hash == vehicle.announced_hash() == world.machine.table.hash
    changes = [event.change.name for event in world.events if isinstance(event, ParamChanged)]
    assert changes == ["P07", "P09"], "and nothing else"
    assert state(world) is SyncState.SYNCED
    assert trusts(world.machine) == {Trust.LIVE}


def test_without_changes_an_interval_costs_one_hash_request_and_the_volatile_values() -> None:
    world, _ = fetched()
    world.run(10 * INTERVAL + 1.0)
    times = world.hashes()
    assert len(times) == 10
    assert world.requests() == 10 * (1 + VOLATILE)
    apart = [after - before for before, after in pairwise(times)]
    assert apart == pytest.approx([INTERVAL] * 9, abs=0.1)
    assert world.events == []


def test_without_a_watch_nothing_is_requested() -> None:
    world, vehicle = fetched(sync_settings=SyncSettings())
    world.change_silently(vehicle, P07=700)
    world.away(4.0)
    world.run(500.0)
    assert world.requests() == 0
    assert state(world) is SyncState.SYNCED, "no sign has arrived"


def test_a_table_that_was_never_fetched_is_not_kept_up() -> None:
    world = World(PX4Vehicle(table=TABLE))
    world.get("P07")
    world.away(3.0)
    world.run(200.0)
    assert world.hashes() == []
    assert state(world) is SyncState.UNSYNCED


def test_nothing_is_requested_while_the_link_is_busy() -> None:
    world = World(PX4Vehicle(table=TABLE), GenericVehicle(table=PLAIN, system=2))
    world.fetch()
    fetched_at = world.now  # the fetch itself asks for the hash beside the list
    other = world.station.components[2, 1]
    world.run(INTERVAL - 1.0)
    world.taps[1].is_deaf = True
    fetch = other.begin_fetch(world.now)
    assert world.hashes(fetched_at) == []
    world.until(lambda: fetch.done, 200.0)
    assert world.now > INTERVAL + 5.0
    assert world.hashes(fetched_at) == [], "although it was due long ago"
    world.run(0.2)
    assert len(world.hashes(fetched_at)) == 1


def test_nothing_is_requested_in_high_latency_mode() -> None:
    world, vehicle = fetched()
    vehicle.high_latency = True
    world.run(10 * INTERVAL)
    assert state(world) is SyncState.SYNCED, "nor is it lost"
    assert world.requests() == 0
    assert not world.sent_of(CommandLong)
    vehicle.high_latency = False
    world.run(INTERVAL + 1.0)
    assert len(world.hashes()) >= 1


def test_nothing_is_requested_in_low_bandwidth_mode() -> None:
    world, vehicle = fetched(burst=1, period=0.125)
    world.change_silently(vehicle, P07=700)
    world.away(4.0)
    world.run(10 * INTERVAL)
    assert world.requests() == 0


@pytest.mark.parametrize("sync_settings", [SyncSettings(INTERVAL), SyncSettings(INTERVAL, without_hash=True)])
def test_a_vehicle_without_a_hash(sync_settings: SyncSettings) -> None:
    vehicle = ArduPilotVehicle(ftp=False, table=PLAIN)
    world = World(vehicle, sync_settings=sync_settings)
    world.fetch()
    world.run(1.0)
    world.sent.clear()
    world.events.clear()
    world.run(2 * INTERVAL)
    lists = len(world.sent_of(ParamRequestList))
    assert world.requests() == lists, "no hash, no reads"
    if not sync_settings.without_hash:
        assert lists == 0
        return
    assert lists == 2
    assert resynced(world) == [], "nothing had changed"
    assert state(world) is SyncState.SYNCED
    world.change_silently(vehicle, P07=700)
    world.run(INTERVAL)
    assert resynced(world) == [("P07",)]
    assert world.machine.table.params["P07"].value == 700


def test_a_table_received_as_a_file_is_kept_in_sync_by_its_hash_alone() -> None:
    unknown = [SimParam(row.name, row.type, row.value, volatile=row.name in NAMES[::9]) for row in TABLE]
    vehicle = PX4Vehicle(ftp=True, table=unknown)
    world = World(air=Air.symmetric([vehicle], delay=0.05), sync_settings=SyncSettings(INTERVAL))
    result = world.fetch()
    assert result.source == "ftp"
    assert result.hash == vehicle.announced_hash(), "it was the same before and after"
    world.run(1.0)
    world.sent.clear()
    world.run(3 * INTERVAL)
    assert len(world.hashes()) == 3
    assert world.sent_of(ParamRequestList) == []
    assert world.sent_of(FileTransfer) == []


def test_another_count_leads_to_a_check_at_once() -> None:
    world, vehicle = fetched(not_in_use=["P30"])
    vehicle.use("P30")
    vehicle.set_param("P07", 700)
    world.run(1.0)
    assert world.machine.table.params["P30"].index == 32
    assert resynced(world) == [("P07", "P30")] or resynced(world) == [("P30",)]
    assert state(world) is SyncState.SYNCED


# gaps


def test_after_a_gap_in_the_heartbeats_the_hash_is_requested() -> None:
    world, vehicle = fetched()
    vehicle.set_param("P07", 700)
    world.away(3.0)
    assert world.hashes() == []
    world.run(1.5)
    assert len(world.hashes()) == 1
    assert resynced(world) == [("P07",)]
    assert world.reported(ComponentLost) == []


class Heartless(Tap):
    """Lets no sign of life through."""

    def data_to_send(self) -> list[bytes]:
        return [each for each in super().data_to_send() if each[7] not in (0, 2)]


def test_a_component_without_heartbeats_is_never_lost() -> None:
    heartless = Heartless(GenericVehicle(table=PLAIN))
    world = World(air=Air([heartless]))
    world.station.receive(
        messages.encode(messages.ParamValue("P00", bytes(4), 6, 40, 0), system=1, component=1, sequence=0),
        "the only peer",
        world.now,
    )
    world.run(60.0)
    assert world.reported(ComponentLost) == []
    assert world.get("P07").value == 7
    assert world.machine.state != "lost"


# lost and found


def test_after_five_seconds_without_a_word_it_is_lost() -> None:
    world, _ = fetched()
    machine = world.machine
    last = machine.presence.received_at
    world.tap.is_mute = True
    world.until(lambda: machine.presence.is_lost)
    assert world.now == last + LOST_AFTER
    (lost,) = world.reported(ComponentLost)
    assert lost == ComponentLost(machine, LOST_AFTER)
    assert machine.state == "lost"
    assert state(world) is SyncState.LOST
    assert [param.value for param in listed(machine.table)][2:4] == [0, 1]
    assert trusts(machine) == {Trust.CACHED}
    world.run(100.0)
    assert world.reported(ComponentLost) == [lost], "once"
    world.sent.clear()
    world.run(100.0)
    assert world.requests() == 0
    assert not world.sent_of(CommandLong)


def test_waiting_calls_end_with_the_loss_and_new_calls_at_once() -> None:
    world, _ = fetched()
    machine = world.machine
    world.tap.is_mute = True
    world.run(4.0)
    read = machine.read("P01", world.now)
    writes = [machine.write("P02", value, world.now) for value in (1, 2, 3)]
    queued = machine.write("P03", 9, world.now)
    world.until(lambda: machine.presence.is_lost)
    operations: list[Read | Write] = [read, *writes, queued]
    for operation in operations:
        assert operation.done
        assert isinstance(operation.error, NoReply)
        assert "1/1" in str(operation.error)
        assert "lost" in str(operation.error)
        assert operation.error.attempts == operation.attempts
    assert read.attempts > 1
    assert [write.attempts > 0 for write in writes] == [True, False, False]
    world.sent.clear()
    for call in (
        lambda: machine.read("P01", world.now),
        lambda: machine.write("P02", 2, world.now),
        lambda: machine.begin_fetch(world.now),
    ):
        error = world.error_of(call)
        assert isinstance(error, NoReply)
        assert "1/1" in str(error)
        assert error.attempts == 0
        assert error.waited == pytest.approx(LOST_AFTER)
    world.run(60.0)
    assert world.requests() == 0, "neither now nor because writes have ended"
    assert len(machine.reads) == len(machine.writes) == 0


def test_back_with_the_same_table() -> None:
    world, vehicle = fetched()
    machine = world.machine
    world.away(9.0)
    world.sent.clear()
    began = world.now
    world.until(lambda: not machine.presence.is_lost)
    (found,) = world.reported(ComponentFound)
    assert isinstance(found, ComponentFound)
    assert 9.0 <= found.silence <= 10.1
    assert state(world) is SyncState.CHECKING
    assert machine.state == "cached"
    world.run(1.0)
    assert world.now < began + 2.5
    commands = [now for now, message in world.sent if isinstance(message, CommandLong)]
    assert commands, "who it is"
    assert commands[0] <= world.hashes()[0], "the command is sent before the hash request"
    assert resynced(world) == [()]
    assert state(world) is SyncState.SYNCED
    volatile = vehicle.params.keys() - set(NAMES)
    assert {machine.table.params[name].trust for name in NAMES} == {Trust.VERIFIED}
    assert {machine.table.params[name].trust for name in volatile} == {Trust.LIVE}, "read afresh"
    assert not world.sent_of(ParamRequestList)


def test_back_with_another_table() -> None:
    world, vehicle = fetched()
    world.tap.is_mute = world.tap.is_deaf = True
    vehicle.set_param("P07", 700)
    world.away(9.0)
    world.run(3.0)
    assert resynced(world) == [("P07",)]
    assert state(world) is SyncState.SYNCED
    assert trusts(world.machine) == {Trust.LIVE}


def test_back_without_a_hash_its_values_are_cached_until_they_are_fetched() -> None:
    vehicle = ArduPilotVehicle(ftp=False, table=PLAIN)
    world = World(vehicle)
    world.fetch()
    world.away(9.0)
    world.sent.clear()
    world.run(60.0)
    machine = world.machine
    assert state(world) is SyncState.UNSYNCED
    assert trusts(machine) == {Trust.CACHED}
    assert world.requests() == 0
    world.get("P07")
    assert machine.table.params["P07"].trust is Trust.LIVE
    world.events.clear()
    world.fetch()
    assert state(world) is SyncState.SYNCED
    assert trusts(machine) == {Trust.LIVE}
    assert resynced(world) == [()]


class Berth(Tap):
    """An address that one vehicle takes after the other."""

    def moor(self, vehicle: Endpoint) -> None:
        self._endpoint = vehicle


@pytest.mark.parametrize("is_alike", [True, False], ids=["same table", "another table"])
def test_another_vehicle_has_taken_the_place(is_alike: bool) -> None:
    berth = Berth(PX4Vehicle(table=TABLE, uid=1))
    camera = Berth(GenericVehicle(table=PLAIN, component=100))
    world = World(air=Air([berth, camera]))
    world.fetch()
    eye = world.station.components[1, 100]
    fetch = eye.begin_fetch(world.now)
    world.outcome(fetch)
    eye.end_fetch(fetch, world.now)
    world.run(1.0)
    berth.is_mute = berth.is_deaf = camera.is_mute = camera.is_deaf = True
    world.run(9.0)
    world.events.clear()
    rows = TABLE if is_alike else [SimParam("P07", ParamType.INT32, 1), SimParam("B", ParamType.INT32, 2)]
    berth.moor(PX4Vehicle(table=rows, uid=2, boot_time=0.0))
    camera.moor(GenericVehicle(table={"P07": 1}, component=100))
    berth.is_mute = berth.is_deaf = camera.is_mute = camera.is_deaf = False
    machine = world.machine
    while not (machine.identity.uid or "").endswith("2"):
        assert state(world) is not SyncState.SYNCED
        assert trusts(machine) <= {Trust.CACHED}
        world.now += 0.01
        world.air.tick(world.now)
        world.exchange()
    world.run(60.0)
    assert machine.table.params == {}
    assert eye.table.params == {}
    assert resynced(world) == []
    assert state(world) is SyncState.UNSYNCED
    result = world.fetch()
    assert result.params.keys() == {row.name for row in rows}


def test_a_running_fetch_waits_for_a_lost_vehicle() -> None:
    world, vehicle = fetched(burst=1, period=0.05)
    fetch = world.machine.begin_fetch(world.now, refresh=True)
    world.run(1.0)
    assert not fetch.done
    vehicle.reboot(world.now, down=8.0)
    world.until(lambda: world.machine.presence.is_lost)
    assert not fetch.done
    vehicle.set_param("P07", 700)
    result = world.outcome(fetch)
    assert result.complete
    assert result.params["P07"].value == 700
    assert len(world.reported(ComponentRebooted)) == 1
    assert state(world) is SyncState.SYNCED
    assert trusts(world.machine) == {Trust.LIVE}


@pytest.mark.parametrize("has_hash", [True, False])
def test_a_fade_in_the_middle_of_a_fetch(has_hash: bool) -> None:
    """What arrived before it may have changed in it: only a hash can show that it has not."""
    vehicle: PX4Vehicle | ArduPilotVehicle = (
        PX4Vehicle(table=TABLE, burst=1, period=0.05)
        if has_hash
        else ArduPilotVehicle(ftp=False, table=PLAIN, burst=1, period=0.05)
    )
    world = World(vehicle)
    world.meet()
    fetch = world.machine.begin_fetch(world.now)
    world.run(1.0)
    world.away(7.0)
    assert world.machine.presence.is_lost
    assert world.outcome(fetch).complete
    world.run(1.0)
    machine = world.machine
    if has_hash:
        assert state(world) is SyncState.SYNCED
        assert Trust.CACHED not in trusts(machine)
    else:
        assert Trust.CACHED in trusts(machine)
        assert state(world) is SyncState.UNSYNCED
        world.fetch()
        assert is_so(state(world) is SyncState.SYNCED)


# the link itself


def test_a_link_that_was_disconnected_for_long_is_checked_like_a_loss() -> None:
    world, vehicle = fetched()
    vehicle.set_param("P07", 700)
    world.station.pause()
    world.away(9.0)
    world.station.resume(world.now)
    assert world.machine.identification.is_doubted, "it may be another vehicle by now"
    assert state(world) is SyncState.CHECKING
    assert trusts(world.machine) == {Trust.CACHED}
    world.run(3.0)
    assert resynced(world) == [("P07",)]
    assert world.reported(ComponentLost, ComponentFound)[-2:] == []


# writes wait for it


def test_a_write_waits_for_the_identity_of_the_vehicle() -> None:
    berth = Berth(PX4Vehicle(table=TABLE, uid=1))
    world = World(air=Air.symmetric([berth], delay=0.2))
    world.fetch()
    berth.is_mute = berth.is_deaf = True
    world.run(9.0)
    stranger = PX4Vehicle(table=TABLE, uid=2)
    berth.moor(stranger)
    berth.is_mute = berth.is_deaf = False
    world.until(lambda: not world.machine.presence.is_lost)
    write = world.machine.write("P07", 700, world.now)
    world.run(3.0)
    assert isinstance(write.error, NoReply)
    assert "another vehicle" in str(write.error)
    assert stranger.requests["PARAM_SET"] == 0
    assert world.set("P07", 701).actual == 701


def test_writes_to_a_camera_wait_for_its_vehicle() -> None:
    berth = Berth(PX4Vehicle(table=TABLE, uid=1))
    camera = GenericVehicle(table=PLAIN, component=100)
    world = World(air=Air.symmetric([berth, camera], delay=0.2))
    world.fetch()
    eye = world.station.components[1, 100]
    world.until(lambda: eye.identification.settled)
    world.outcome(eye.read("P07", world.now))
    berth.is_mute = berth.is_deaf = True
    world.run(9.0)
    berth.moor(PX4Vehicle(table=TABLE, uid=2))
    berth.is_mute = berth.is_deaf = False
    world.until(lambda: not world.machine.presence.is_lost)
    write = eye.write("P07", 700, world.now)
    world.run(0.05)
    assert write.attempts == 0
    world.run(3.0)
    assert isinstance(write.error, NoReply)
    assert camera.requests["PARAM_SET"] == 0


# reboots


def test_a_reboot_is_reported_and_the_table_checked() -> None:
    world, vehicle = fetched()
    vehicle.reboot(world.now, down=2.0)
    world.run(3.0)
    assert world.reported(ComponentRebooted) == [ComponentRebooted(world.machine)]
    assert world.reported(ComponentLost) == []
    world.run(2.0)
    assert resynced(world) == [()]
    assert state(world) is SyncState.SYNCED
    assert world.sent_of(CommandLong), "it may be another one"


def test_a_vehicle_that_never_stops_starting_again_ends_a_fetch() -> None:
    vehicle = PX4Vehicle(table=TABLE, burst=1, period=0.2)
    world = World(vehicle)
    world.meet()
    world.run(3.0)
    fetch = world.machine.begin_fetch(world.now)
    reboots = 0
    while not fetch.done:
        reboots += 1
        vehicle.reboot(world.now, down=1.5)
        world.run(5.0)
        assert reboots < 20
    assert reboots == FETCH_RESTARTS_MAX + 1 == 9
    assert isinstance(fetch.error, NoReply)
    assert "started again" in str(fetch.error)
    assert world.machine.fetch is None


# policies


def offline(memory: Memory, vehicle: Endpoint, policy: Policy) -> World:
    world = World(vehicle, sync_settings=SyncSettings(INTERVAL, policy=policy))
    world.meet().use_cached(now=world.now, **memory)
    return world


def the_memory() -> tuple[Memory, PX4Vehicle]:
    world, _ = fetched()
    return world.memory(), PX4Vehicle(table=TABLE)


def test_cache_only_sends_nothing() -> None:
    memory, vehicle = the_memory()
    world = offline(memory, vehicle, Policy.CACHE_ONLY)
    result = world.fetch()
    assert (result.source, result.complete, result.hash, result.received) == ("cache", True, None, 42)
    assert ["cache-only" in note for note in result.notes] == [True]
    machine = world.machine
    assert state(world) is SyncState.UNSYNCED
    assert machine.state == "cached"
    assert trusts(machine) == {Trust.CACHED}
    assert world.reported(Fetched) == []
    vehicle.set_param("P07", 1)  # two changes in a short while, of which one may be an old one
    world.run(0.5)
    vehicle.set_param("P07", 2)
    world.run(5.0)
    assert machine.table.params["P07"].value == 2, "it listens"
    world.away(4.0)
    world.run(1.0)
    world.away(9.0)
    world.run(2.0)
    vehicle.reboot(world.now, down=2.0)
    world.run(5 * INTERVAL)
    assert world.fetch().source == "cache"
    assert world.requests() == 0
    assert world.sent_of(CommandLong)


def test_hash_only_requests_the_hash_and_nothing_more() -> None:
    memory, vehicle = the_memory()
    world = offline(memory, vehicle, Policy.HASH_ONLY)
    result = world.fetch()
    assert (result.source, result.complete, result.hash) == ("cache", True, vehicle.announced_hash())
    assert ["hash-only" in note for note in result.notes] == [True]
    machine = world.machine
    assert state(world) is SyncState.SYNCED
    assert {machine.table.params[name].trust for name in NAMES} == {Trust.VERIFIED}
    assert machine.table.params["COM_FLIGHT_UUID"].trust is Trust.CACHED
    assert machine.refresh is None
    world.away(4.0)
    world.run(5 * INTERVAL)
    assert world.requests() == len(world.hashes()) == 1


def test_hash_only_says_when_the_hash_is_another_one() -> None:
    memory, vehicle = the_memory()
    world = offline(memory, vehicle, Policy.HASH_ONLY)
    assert world.fetch().hash is not None
    world.change_silently(vehicle, P07=700)
    world.run(1.0)
    result = world.fetch()
    assert (result.source, result.hash, result.params["P07"].value) == ("cache", None, 7)
    assert "does not match" in result.notes[0]
    machine = world.machine
    assert state(world) is SyncState.UNSYNCED, "it is known not to agree"
    assert trusts(machine) == {Trust.CACHED}
    world.run(5 * INTERVAL)
    assert world.requests() == len(world.hashes()) == 2
    world.away(9.0)
    world.run(5.0)
    assert state(world) is SyncState.UNSYNCED
    assert world.requests() == len(world.hashes()) == 3, "on return the hash is requested once"


@pytest.mark.parametrize("policy", [Policy.CACHE_ONLY, Policy.HASH_ONLY])
def test_no_list_goes_to_all_components_at_once(policy: Policy) -> None:
    vehicles = [GenericVehicle(table=PLAIN, component=number) for number in (1, 2)]
    world = World(*vehicles, sync_settings=SyncSettings(INTERVAL, policy=policy))
    world.run(10.0)
    world.station.begin_fetches(list(world.station.components.values()), world.now)
    assert world.sent_of(ParamRequestList) == []
    with pytest.raises(UsageError, match=policy):
        world.station.check_refresh(True)
    world.station.check_refresh(False)


def test_sync_settings_of_interval_and_policy() -> None:
    assert SyncSettings.chosen(None, "auto") == SyncSettings(WATCH_INTERVAL)
    assert SyncSettings.chosen(5, Policy.AUTO) == SyncSettings(5, without_hash=True)
    assert SyncSettings.chosen(0, "hash-only") == SyncSettings(
        math.inf, without_hash=True, policy=Policy.HASH_ONLY
    )
    wrong: Sequence[tuple[float | None, str]] = [(0.5, "auto"), (-1, "auto"), (math.nan, "auto"), (None, "x")]
    for interval, policy in wrong:
        with pytest.raises(UsageError):
            SyncSettings.chosen(interval, policy)


def test_a_table_that_changed_during_its_download_is_fetched_again() -> None:
    """The hash of its beginning proves the table; what changed after that is fetched then."""
    names = ["A_LATE", "SWITCH", *list(PLAIN)[:12]]
    rows = [SimParam(name, ParamType.INT32, number) for number, name in enumerate(names)]
    vehicle = PX4Vehicle(table=rows, late_use={"SWITCH": ["A_LATE"]})
    world = World(air=Air.symmetric([vehicle], delay=0.3), sync_settings=SyncSettings(INTERVAL))
    vehicle.when_listed(3, lambda: vehicle.set_param("SWITCH", 9))
    world.until(lambda: (1, 1) in world.station.components)
    fetch = world.machine.begin_fetch(world.now, refresh=True)
    assert "A_LATE" not in world.outcome(fetch).params
    assert fetch.result is not None
    assert fetch.result.hash is not None
    world.run(GAP_CHECK_INTERVAL + 5.0)
    assert state(world) is SyncState.SYNCED
    assert "A_LATE" in world.machine.table.params
