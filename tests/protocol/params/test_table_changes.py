"""Parameters that appear and disappear on a vehicle while its table is in sync: which events report them, and
how soon."""

from __future__ import annotations

import pytest
from paramclient.protocol.params.sync import DOWNLOAD_PAUSE_MIN, SyncSettings

from paramclient.model.values import ParamType
from paramclient.protocol.events import Change, ParamChanged
from paramclient.protocol.watch import SyncState
from paramclient.sim import Air, ArduPilotVehicle
from paramclient.wire.messages import FileTransfer, ParamRequestList
from tests.protocol.params.test_sync import INTERVAL, World, state

GROUP = {f"GRIP_{number}": (ParamType.INT16, number) for number in range(7)}
TABLE = {
    **{f"A{number:02d}": (ParamType.INT32, number) for number in range(20)},
    "GRIP_ENABLE": (ParamType.INT8, 0),
    **{f"Z{number:02d}": (ParamType.INT32, number) for number in range(20)},
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
    world.run(DOWNLOAD_PAUSE_MIN)
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
    assert 5 <= len(world.sent_of(ParamRequestList)) <= 25, "the list takes 3.3 s"


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
