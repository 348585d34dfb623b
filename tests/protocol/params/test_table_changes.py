"""Parameters that appear and disappear on a vehicle while its table is in sync: which events report them, and
how soon."""

from __future__ import annotations

import math
from random import Random
from typing import Any

import pytest

from paramclient.model.values import ParamType, Trust
from paramclient.protocol.events import Fetched, ParamChanged, TableResynced
from paramclient.protocol.params.change import Added, Change, Changed, FirstValue, Removed
from paramclient.protocol.params.sync import SyncSettings, SyncState
from paramclient.protocol.params.sync_interval import PAUSE_MIN
from paramclient.protocol.wire import FileTransfer, ParamRequestList, ParamRequestRead
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle
from tests.protocol.params.test_sync import INTERVAL, World, state

GROUP = {f"GRIP_{number}": (ParamType.INT16, number) for number in range(7)}
TABLE = {
    **{f"A{number:02d}": (ParamType.INT32, number) for number in range(20)},
    "GRIP_ENABLE": (ParamType.INT8, 0),
    **{f"Z{number:02d}": (ParamType.INT32, number) for number in range(20)},
}

RADIO: dict[str, Any] = {"delay": 0.075, "rate": 5760.0, "queue": 1024}
"""A radio of 57600 baud."""
LARGE = {
    **{f"A{number:03d}": (ParamType.INT32, number) for number in range(150)},
    "GRIP_ENABLE": (ParamType.INT8, 0),
    **{f"Z{number:03d}": (ParamType.INT32, number) for number in range(150)},
}
NESTED = {
    "GRIP_ENABLE": {**GROUP, "GRIP_SUB_ENABLE": (ParamType.INT8, 0), "GRIP_LAST": (ParamType.INT8, 0)},
    "GRIP_SUB_ENABLE": {f"GRIP_SUB_{number}": (ParamType.INT16, number) for number in range(4)},
    "Z000": {f"OTHER_{number}": (ParamType.INT16, number) for number in range(5)},
}


def vehicle(*, ftp: bool = True) -> ArduPilotVehicle:
    return ArduPilotVehicle(table=TABLE, groups={"GRIP_ENABLE": GROUP}, live=(), ftp=ftp)


def in_sync(
    *vehicles: ArduPilotVehicle, air: Air | None = None, sync_settings: SyncSettings | None = None
) -> World:
    """A session whose table was fetched a while ago."""
    world = World(*vehicles, air=air, sync_settings=sync_settings)
    assert world.fetch().complete
    world.run(10.0)
    assert state(world) is SyncState.SYNCED
    world.events.clear()
    world.sent.clear()
    return world


def changes(world: World, kind: type[Change]) -> list[Change]:
    reported = [event.change for event in world.events if isinstance(event, ParamChanged)]
    return [change for change in reported if type(change) is kind]


@pytest.mark.parametrize("ftp", [True, False], ids=["file", "list"])
def test_a_group_that_is_switched_on_and_off_is_reported_within_a_second(ftp: bool) -> None:
    world = in_sync(board := vehicle(ftp=ftp))
    began = world.now
    assert world.set("GRIP_ENABLE", 1).actual == 1
    world.until(lambda: state(world) is SyncState.SYNCED and bool(changes(world, Added)))
    assert world.now - began < 1.0
    assert [(each.name, each.old, each.by) for each in changes(world, Added)] == [
        (name, None, "vehicle") for name in GROUP
    ]
    assert [change.name for change in changes(world, Changed)] == ["GRIP_ENABLE"]
    table = world.machine.table
    assert {name: param.index for name, param in table.params.items()} == {
        name: param.index for name, param in board.params.items()
    }
    assert table.complete
    world.run(PAUSE_MIN)
    world.events.clear()
    world.set("GRIP_ENABLE", 0)
    world.until(lambda: state(world) is SyncState.SYNCED and bool(changes(world, Removed)))
    assert sorted(each.name for each in changes(world, Removed)) == sorted(GROUP)
    assert all(each.new is None for each in changes(world, Removed))
    assert table.params.keys() == board.params.keys()
    sent = (len(world.sent_of(ParamRequestList)), bool(world.sent_of(FileTransfer)))
    assert sent == ((0, True) if ftp else (2, False))
    world.run(2 * INTERVAL)
    assert len(world.sent_of(ParamRequestList)) == sent[0], "no list without a change"


def test_the_first_values_of_a_table_are_not_added() -> None:
    world = World(vehicle())
    world.fetch()
    assert len(changes(world, FirstValue)) == len(TABLE)
    assert changes(world, Added) == []


def test_a_parameter_that_has_just_appeared_is_set_at_once() -> None:
    world = in_sync(vehicle())
    world.set("GRIP_ENABLE", 1)
    began = world.now
    assert world.set("GRIP_3", 30).actual == 30
    assert world.now - began < 0.3
    world.until(lambda: state(world) is SyncState.SYNCED)
    assert world.machine.table.params["GRIP_3"].value == 30
    assert sorted(each.name for each in changes(world, Added)) == sorted(GROUP)


def test_a_list_after_a_changed_count_that_does_not_arrive_is_requested_again() -> None:
    world = in_sync(board := vehicle(ftp=False))
    world.tap.is_deaf = True
    board.set_param("GRIP_ENABLE", 1)
    world.until(lambda: state(world) is not SyncState.SYNCED)
    world.run(30.0)
    assert changes(world, Added) == []
    world.tap.is_deaf = False
    world.until(lambda: state(world) is SyncState.SYNCED)
    assert len(changes(world, Added)) == len(GROUP)


def test_without_a_watch_a_changed_count_requests_nothing() -> None:
    world = in_sync(board := vehicle(ftp=False), sync_settings=SyncSettings())
    board.set_param("GRIP_ENABLE", 1)
    world.run(INTERVAL)
    assert state(world) is SyncState.UNSYNCED
    assert world.sent_of(ParamRequestList) == []


def test_a_slow_list_is_requested_half_of_the_time_at_most() -> None:
    board = ArduPilotVehicle(
        table=TABLE, groups={"GRIP_ENABLE": GROUP}, live=(), ftp=False, burst=1, period=0.08
    )
    world = in_sync(board)
    for number in range(400):
        board.set_param("GRIP_ENABLE", number % 2)
        world.run(0.25)
    assert 5 <= len(world.sent_of(ParamRequestList)) <= 17, "the list takes 3.3 s"


def test_a_kind_of_change_is_recognized_by_its_class() -> None:
    world = in_sync(board := vehicle())
    board.set_param("GRIP_ENABLE", 1)
    world.until(lambda: bool(changes(world, Added)))
    added = changes(world, Added)[0]
    assert repr(added).startswith("Added(name='GRIP_0'")
    assert Change.between(added.name, None, added.new, is_added=True) == added
    assert type(Change.between(added.name, None, added.new)) is FirstValue
    assert type(Change.between(added.name, added.new, added.new, is_added=True)) is Changed
    assert type(Change.between(added.name, added.new, None)) is Removed


def slow(**options: Any) -> ArduPilotVehicle:
    """A vehicle without MAVFTP and with a slow list, so that single reads are the cheapest way."""
    groups = options.pop("groups", {"GRIP_ENABLE": GROUP})
    return ArduPilotVehicle(table=LARGE, groups=groups, live=(), ftp=False, burst=1, period=0.025, **options)


def followed(world: World, board: ArduPilotVehicle, within: float = 20.0) -> None:
    """Wait until the table is in sync, and check that it is the vehicle's."""
    began = world.now
    world.until(lambda: state(world) is not SyncState.SYNCED or world.now > began + 0.3)
    world.until(lambda: state(world) is SyncState.SYNCED or world.now > began + within)
    table = world.machine.table
    assert state(world) is SyncState.SYNCED
    assert table.complete
    assert table.count == len(board.params)
    assert {name: (param.index, param.value) for name, param in table.params.items()} == {
        name: (param.index, param.value) for name, param in board.params.items()
    }
    assert {param.trust for param in table.params.values()} == {Trust.LIVE}
    assert table.previous_order == ()


def downloads(world: World) -> int:
    return len(world.sent_of(ParamRequestList)) + len(world.sent_of(FileTransfer))


def real_size(*, ftp: bool, **options: Any) -> ArduPilotVehicle:
    """The real quad with a group of 7, on a radio."""
    groups = {"GRIP_ENABLE": GROUP}
    return ArduPilotVehicle(
        groups=groups, live=(), ftp=ftp, ftp_rate=5760.0, burst=1, period=0.025, **options
    )


@pytest.mark.parametrize("ftp", [True, False], ids=["file", "list"])
@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_on_a_radio_a_group_is_followed_by_reads_within_a_second(ftp: bool, loss: float) -> None:
    board = real_size(ftp=ftp)
    air = Air(
        [board],
        uplink=FaultyLink(**RADIO, loss=loss, seed=1),
        downlink=FaultyLink(**RADIO, loss=loss, seed=2),
    )
    world = World(air=air)
    assert world.fetch().complete
    world.run(70.0)
    assert state(world) is SyncState.SYNCED
    for value, kind in ((1, Added), (0, Removed)):
        world.run(10.0)
        world.events.clear()
        world.sent.clear()
        world.set("GRIP_ENABLE", value)
        acknowledged_at = world.now
        assert state(world) is not SyncState.SYNCED
        followed(world, board)
        assert world.now - acknowledged_at < 1.0, "the file takes 3 s, and the list 35 s"
        assert sorted(each.name for each in changes(world, kind)) == sorted(GROUP)
        assert [change.name for change in changes(world, Changed)] == ["GRIP_ENABLE"]
        assert downloads(world) == 0
        least = 14 if value else 7
        assert least <= len(world.sent_of(ParamRequestRead)) <= (least if not loss else 3 * least)


def test_reads_of_shifted_indices_do_not_put_off_the_next_file() -> None:
    board = real_size(ftp=True)
    world = World(air=Air([board], uplink=FaultyLink(**RADIO), downlink=FaultyLink(**RADIO)))
    world.fetch()
    world.run(30.0)
    planned = world.machine.sync.next_deadline()
    assert world.now + 10.0 < planned < math.inf
    world.set("GRIP_ENABLE", 1)
    followed(world, board)
    assert world.machine.sync.next_deadline() == pytest.approx(planned)


def test_values_that_stay_keep_their_moment() -> None:
    world = in_sync(board := slow())
    before = dict(world.machine.table.params.moments)
    world.set("GRIP_ENABLE", 1)
    followed(world, board)
    after = world.machine.table.params.moments
    assert sum(after[name] == moment for name, moment in before.items()) >= len(before) - 10
    assert all(after[name] > max(before.values()) for name in GROUP)
    assert downloads(world) == 0


def test_the_changes_of_followed_reads_are_reported_once() -> None:
    world = in_sync(board := slow())
    world.set("GRIP_ENABLE", 1)
    followed(world, board)
    assert [event.changed for event in world.reported(TableResynced) if isinstance(event, TableResynced)] == [
        ("GRIP_ENABLE", *GROUP)
    ]
    assert world.reported(Fetched) == []
    dirty = world.machine.table.take_dirty()
    assert dirty.keys() >= {*GROUP, *(name for name in LARGE if name.startswith("Z"))}, "for the cache"


def test_a_group_in_a_group_is_followed() -> None:
    world = in_sync(board := slow(groups=NESTED))
    world.set("GRIP_SUB_ENABLE", 1)  # hidden so far, and read by name
    assert state(world) is SyncState.SYNCED
    for name, value in (
        ("GRIP_ENABLE", 1),
        ("GRIP_SUB_ENABLE", 0),
        ("GRIP_SUB_ENABLE", 1),
        ("GRIP_ENABLE", 0),
    ):
        world.set(name, value)
        followed(world, board)
        world.run(5.0)
    assert downloads(world) == 0


def test_two_switches_in_a_row_are_followed_together() -> None:
    world = in_sync(board := slow(groups=NESTED))
    for value in (1, 0):
        world.set("GRIP_ENABLE", value)
        world.set("Z000", value)
        followed(world, board)
        world.run(5.0)
    assert downloads(world) == 0


def test_a_count_that_changes_again_during_the_reads_begins_them_anew() -> None:
    world = in_sync(board := slow(groups=NESTED))
    world.set("GRIP_ENABLE", 1)
    world.run(0.15)
    assert state(world) is SyncState.RESYNCING
    board.set_param("Z000", 1)
    followed(world, board)
    assert sorted(each.name for each in changes(world, Added)) == sorted(
        [*NESTED["GRIP_ENABLE"], *NESTED["Z000"]]
    )
    assert downloads(world) == 0


def test_a_group_that_appears_and_disappears_at_once_is_fetched() -> None:
    world = in_sync(board := slow(groups=NESTED))
    world.set("GRIP_ENABLE", 1)
    world.run(0.15)
    board.set_param("GRIP_ENABLE", 0)
    followed(world, board)
    assert downloads(world) == 1, "additions and removals leave no certain order"


def test_one_group_for_another_of_the_same_size_is_fetched() -> None:
    world = in_sync(board := slow(groups={**NESTED, "A000": {f"MORE_{n}": n for n in range(5)}}))
    world.set("A000", 1)
    world.run(60.0)
    world.sent.clear()
    board.set_param("A000", 0)
    board.set_param("GRIP_ENABLE", 1)
    board.set_param("Z000", 0)
    followed(world, board)
    assert downloads(world) <= 1


@pytest.mark.parametrize("later", [0.0, 0.12, 3.0])
def test_parameters_that_appear_elsewhere_and_later_are_found(later: float) -> None:
    """The switch brings four at its place, and, once a driver runs, three behind another parameter."""
    groups: dict[str, dict[str, Any]] = {
        "GRIP_ENABLE": dict(list(GROUP.items())[:4]),
        "A003": {f"LATE_{n}": 1.0 for n in range(3)},
    }
    board = slow(groups=groups, reboot_groups=["A003"])
    board._was_on["A003"] = False
    board._relist()
    world = in_sync(board)
    board.set_param("GRIP_ENABLE", 1)
    world.run(later)
    board._was_on["A003"] = True
    board._relist()
    board.set_param("A149", 5)
    followed(world, board)
    assert sorted(each.name for each in changes(world, Added)) == sorted(
        [*groups["GRIP_ENABLE"], *groups["A003"]]
    )


def test_a_value_that_arrives_during_the_reads_counts() -> None:
    world = in_sync(board := slow())
    world.set("GRIP_ENABLE", 1)
    world.run(0.15)
    assert state(world) is SyncState.RESYNCING
    board.set_param("GRIP_3", 30)
    board.set_param("Z007", 70)
    world.run(2.0)  # responses from before the change are read again after 1 s
    followed(world, board)
    assert world.machine.table.params["GRIP_3"].value == 30
    assert downloads(world) == 0


def test_a_fetch_of_the_user_takes_over() -> None:
    world = in_sync(board := slow())
    world.set("GRIP_ENABLE", 1)
    world.run(0.15)
    assert state(world) is SyncState.RESYNCING
    result = world.fetch()
    assert result.complete
    assert result.source == "stream"
    followed(world, board)
    assert len(world.sent_of(ParamRequestList)) <= 1


def test_after_a_cancelled_fetch_the_table_is_fetched_all_the_same() -> None:
    world = in_sync(board := slow())
    world.set("GRIP_ENABLE", 1)
    world.run(0.15)
    fetch = world.machine.begin_fetch(world.now)
    world.run(0.05)
    world.machine.end_fetch(fetch, world.now)
    followed(world, board)
    assert sorted(each.name for each in changes(world, Added)) == sorted(GROUP)


def test_a_list_follows_where_a_read_is_not_answered() -> None:
    at = list(LARGE).index("GRIP_ENABLE") + 3
    world = in_sync(board := slow())
    board._dead.add(at)
    world.set("GRIP_ENABLE", 1)
    world.run(20.0)
    board._dead.clear()
    assert len(world.sent_of(ParamRequestList)) >= 1
    followed(world, board)


def test_values_in_doubt_are_fetched() -> None:
    world = in_sync(board := slow())
    world.machine.table.doubt_value("A005")
    world.set("GRIP_ENABLE", 1)
    followed(world, board)
    assert len(world.sent_of(ParamRequestList)) == 1


def test_a_vehicle_that_is_lost_meanwhile_is_fetched() -> None:
    world = in_sync(board := slow())
    world.set("GRIP_ENABLE", 1)
    world.run(0.15)
    world.away(8.0)
    world.run(2.0)
    assert world.fetch().complete
    followed(world, board)


def test_a_large_group_is_fetched_at_once() -> None:
    group = {f"GRIP_{number}": number for number in range(150)}
    world = in_sync(board := slow(groups={"GRIP_ENABLE": group}))
    world.set("GRIP_ENABLE", 1)
    followed(world, board)
    assert len(world.sent_of(ParamRequestList)) == 1
    assert len(world.sent_of(ParamRequestRead)) <= 1


def test_a_switch_that_others_set_without_a_message_is_found_by_the_next_value() -> None:
    board = real_size(ftp=False)
    world = in_sync(board)
    world.change_silently(board, GRIP_ENABLE=1)
    world.sent.clear()
    board.set_param("RTL_ALT", 1600)
    followed(world, board)
    assert downloads(world) == 0
    assert 20 <= len(world.sent_of(ParamRequestRead)) < 80
    assert sorted(each.name for each in changes(world, Added)) == sorted(GROUP)


@pytest.mark.parametrize("seed", range(12))
def test_whatever_is_lost_ends_in_the_vehicles_table(seed: int) -> None:
    random = Random(seed)
    board = slow(groups=NESTED)
    faults: dict[str, Any] = {
        "loss": random.choice([0.05, 0.2, 0.4]),
        "delay": 0.05,
        "duplicate": 0.1,
        "reorder": 0.1,
    }
    air = Air([board], uplink=FaultyLink(**faults, seed=seed), downlink=FaultyLink(**faults, seed=seed + 99))
    world = World(air=air)
    world.run(3.0)
    assert world.fetch().complete
    for _ in range(8):
        for _ in range(random.choice([1, 1, 2])):
            board.set_param(random.choice(["GRIP_ENABLE", "GRIP_SUB_ENABLE", "Z000"]), random.choice([0, 1]))
            world.run(random.choice([0.05, 0.3, 2.0]))
        board.set_param("A001", random.randrange(1000))
        world.run(random.choice([0.0, 10.0]))
    air.uplink, air.downlink = FaultyLink(delay=0.05), FaultyLink(delay=0.05)
    for name, value in {"A001": 1, "GRIP_ENABLE": 1, "Z000": 1}.items():
        board.set_param(name, value)
        world.run(60.0)
    table = world.machine.table
    assert table.params.keys() == board.params.keys()
    assert {name: param.index for name, param in table.params.items()} == {
        name: param.index for name, param in board.params.items()
    }


# PX4: parameters that come into use


MAG2 = "CAL_MAG2_ID"
"""Its change brings 16 more parameters of the real quad into use."""


def px4_in_sync(board: PX4Vehicle, faults: dict[str, Any], *, loss: float = 0.0) -> World:
    """A session whose table was fetched and proven a while ago."""
    links = [FaultyLink(**faults, loss=loss, seed=number) for number in (1, 2)]
    world = World(air=Air([board], uplink=links[0], downlink=links[1]))
    assert world.fetch().hash is not None
    world.run(10.0)
    assert state(world) is SyncState.SYNCED
    world.events.clear()
    world.sent.clear()
    return world


def proven(world: World, board: PX4Vehicle) -> bool:
    """Whether the table is in sync, and is the vehicle's; its hash is."""
    table = world.machine.table
    listed = {name: param for name, param in table.params.items() if param.index is not None}
    return (
        state(world) is SyncState.SYNCED
        and table.complete
        and table.hash == board.announced_hash()
        and {name: (param.index, param.value) for name, param in listed.items()}
        == {name: (param.index, param.value) for name, param in board.params.items()}
    )


SERIAL: dict[str, Any] = {"burst": 3, "period": 0.075}
"""A list of 40 values per second, as on a radio of 57600 baud."""


@pytest.mark.parametrize(
    ("options", "faults", "loss", "within"),
    [
        ({}, {"delay": 0.0005}, 0.0, 0.2),
        ({}, {"delay": 0.05}, 0.05, 2.0),
        (SERIAL, RADIO, 0.0, 3.0),
        (SERIAL, RADIO, 0.05, 4.0),
    ],
    ids=["quick", "100 ms", "radio", "radio with loss"],
)
def test_parameters_that_come_into_use_are_found_by_reads_that_the_hash_proves(
    options: dict[str, Any], faults: dict[str, Any], loss: float, within: float
) -> None:
    world = px4_in_sync(board := PX4Vehicle(**options), faults, loss=loss)
    before = len(board.params)
    world.set(MAG2, 131_341)
    began = world.now
    world.until(lambda: proven(world, board) and bool(changes(world, Added)))
    assert world.now - began < within
    assert len(changes(world, Added)) == len(board.params) - before == 16
    assert all(change.name.startswith("CAL_MAG2_") for change in changes(world, Added))
    assert world.sent_of(ParamRequestList) == []
    indices = {read.param_index for read in world.sent_of(ParamRequestRead)} - {-1}
    assert 16 <= len(indices) <= 70, "the list has more than 900"
    world.run(2 * INTERVAL)
    assert world.sent_of(ParamRequestList) == []


def test_parameters_that_come_into_use_unannounced_are_found_by_reads_after_the_next_hash() -> None:
    board = PX4Vehicle(not_in_use=("MC_ROLL_P", "MC_ROLLRATE_P", "RTL_DESCEND_ALT", "COM_RC_LOSS_T"))
    world = px4_in_sync(board, {"delay": 0.0005})
    board.use("MC_ROLL_P", "MC_ROLLRATE_P", "RTL_DESCEND_ALT", "COM_RC_LOSS_T")
    world.until(lambda: proven(world, board) and bool(changes(world, Added)))
    assert len(changes(world, Added)) == 4
    assert world.sent_of(ParamRequestList) == []


def test_a_table_that_the_hash_does_not_prove_is_fetched() -> None:
    """A value has changed without a message."""
    world = px4_in_sync(board := PX4Vehicle(), {"delay": 0.0005})
    board.load({"MC_PITCH_P": 4.25})
    world.set(MAG2, 131_341)
    world.until(lambda: proven(world, board))
    assert len(changes(world, Added)) == 16
    assert len(world.sent_of(ParamRequestList)) == 1
    assert "MC_PITCH_P" in {change.name for change in changes(world, Changed)}


def test_with_a_long_round_trip_the_whole_table_is_quicker_than_the_search() -> None:
    world = px4_in_sync(board := PX4Vehicle(), {"delay": 0.3})
    world.set(MAG2, 131_341)
    world.until(lambda: proven(world, board) and bool(changes(world, Added)))
    assert len({read.param_index for read in world.sent_of(ParamRequestRead)}) > 900
