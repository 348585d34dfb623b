"""Names that several parameters share: which one the table holds, and what is said of the others."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from paramclient import ParamClient
from paramclient.model.values import ParamType
from paramclient.protocol.params.duplicate_names import (
    DUPLICATES_LISTED_MAX,
    EQUAL_RESPONSES_MIN,
    RESPONSE_PAUSE,
    RESPONSES_MAX,
    DuplicateNameReads,
    repeated_names,
)
from paramclient.protocol.params.sync import SyncState
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.retry import RetryPolicy
from paramclient.sim import Air, GenericVehicle, OtherStation, PX4Vehicle, SimParam, Vehicle
from tests.protocol.params.test_reads import Desk
from tests.simulation import Simulation, is_so, listing_ardupilot, param_value

CUT = "CAMERA_EXPOSURE_"
ROWS = [
    SimParam(CUT, ParamType.INT32, 1),
    SimParam("GAIN", ParamType.INT32, 5),
    SimParam(CUT, ParamType.REAL32, 2.0),
]
EVERY_KIND = pytest.mark.parametrize("kind", [GenericVehicle, PX4Vehicle, listing_ardupilot])


def test_which_names_are_repeated() -> None:
    assert repeated_names({}) == {}
    assert repeated_names({0: "A", 1: "B"}) == {}
    assert repeated_names({4: "A", 1: "B", 0: "A", 2: "A"}) == {"A": (0, 2, 4)}


@EVERY_KIND
@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_the_table_holds_what_the_vehicle_means_by_the_name(
    kind: Callable[..., Vehicle], loss: float
) -> None:
    vehicle = kind(table=ROWS, repeated_names=True)
    for seed in range(10 if loss else 1):
        world = Simulation(air=Air.symmetric([vehicle], delay=0.05, loss=loss, duplicate=loss, seed=seed))
        for _ in range(2):
            result = world.fetch()
            assert result.complete
            assert result.count == 3
            assert any(CUT in note and "by name" in note for note in result.notes)
            assert {name: param.value for name, param in result.params.items()} == {CUT: 1, "GAIN": 5}
            assert not world.machine.table.complete
            assert world.machine.state == "partial"
            assert world.machine.sync_state is SyncState.UNSYNCED


@pytest.mark.parametrize("seed", [0, 9, 34, 36, 62, 71])
def test_late_responses_to_reads_by_index_decide_nothing(seed: int) -> None:
    """On a slow radio the last values of a list are requested several times, and arrive seconds later."""
    between = [SimParam(f"Z{number:03}", ParamType.INT32, number) for number in range(60)]
    rows = [SimParam(CUT, ParamType.INT32, 1), *between, SimParam(CUT, ParamType.REAL32, 2.0)]
    vehicle = GenericVehicle(rows, repeated_names=True)
    world = Simulation(
        air=Air.symmetric(
            [vehicle], delay=0.02, jitter=0.3, loss=0.05, duplicate=0.2, reorder=0.2, rate=1200.0, queue=1024,
            seed=seed,
        )
    )  # fmt: skip
    world.run(12.0)
    result = world.fetch(limit=120.0)
    assert result.complete
    assert result.params[CUT].value == 1


@EVERY_KIND
def test_values_of_the_other_parameter_with_the_name_are_ignored(kind: Callable[..., Vehicle]) -> None:
    vehicle = kind(table=ROWS, repeated_names=True)
    world = Simulation(air=Air([vehicle], others=[OtherStation(list_every=7.0)]))
    assert world.fetch(limit=5.0).complete
    world.events.clear()
    world.run(30.0)
    world.get(2)
    assert not [event for event in world.events if "Changed" in type(event).__name__]
    assert world.machine.table.params[CUT].value == 1
    assert world.set(CUT, 9).actual == 9
    assert world.machine.table.params[CUT].value == 9


@EVERY_KIND
def test_while_another_station_lists_all_the_time(kind: Callable[..., Vehicle]) -> None:
    rows = [*ROWS, *(SimParam(f"Z{number:03}", ParamType.INT32, number) for number in range(100))]
    vehicle = kind(table=rows, repeated_names=True)
    world = Simulation(air=Air.symmetric([vehicle], delay=0.05, others=[OtherStation(list_every=0.5)]))
    result = world.fetch()
    assert result.complete
    assert len(result.notes) == (2 if kind is PX4Vehicle else 1)
    assert {name: param.value for name, param in result.params.items()} == vehicle.values


def test_a_name_that_is_repeated_no_longer_is_requested() -> None:
    vehicle = PX4Vehicle(table=[*ROWS, SimParam("A", ParamType.INT32, 0)], repeated_names=True)
    world = Simulation(vehicle)
    world.fetch()
    assert world.machine.table.duplicate_indices == {CUT: {2}}
    # another one goes out of use as one comes into it: the count stays, and the name now stands at 2 alone
    vehicle._entries[1].name = "B"
    vehicle._by_name[CUT] = vehicle._entries[2]
    result = world.fetch(refresh=True)
    assert not any(CUT in note for note in result.notes)
    assert world.machine.table.duplicate_indices == {}
    assert result.params[CUT].value == 2.0


def test_with_another_count_indices_mean_something_else() -> None:
    vehicle = PX4Vehicle(
        table=[*ROWS, SimParam("A", ParamType.INT32, 0)], not_in_use=["A"], repeated_names=True
    )
    world = Simulation(vehicle)
    world.fetch()
    assert world.machine.table.duplicate_indices == {CUT: {1}}
    vehicle.use("A")
    world.get("GAIN")
    assert world.machine.table.duplicate_indices == {}
    assert world.fetch().params[CUT].value == 1
    assert world.machine.table.duplicate_indices == {CUT: {2}}


def test_the_last_one_who_waits_ends_it() -> None:
    world = Simulation(air=Air.symmetric([GenericVehicle(ROWS, repeated_names=True)], delay=0.5))
    machine = world.meet()
    fetch = machine.begin_fetch(world.now)
    world.until(lambda: fetch._repeated is not None and bool(fetch._repeated._open))
    assert fetch._repeated is not None
    (read,) = fetch._repeated._open.values()
    machine.end_fetch(fetch, world.now)
    assert read.holders <= 1  # a value that has changed twice is requested too
    world.run(60.0)
    assert len(machine.reads) == 0
    assert not fetch.done
    assert machine.table.duplicate_indices == {}


def repeated(desk: Desk, **names: tuple[int, ...]) -> tuple[DuplicateNameReads, Table]:
    table = Table()
    asking = DuplicateNameReads(names, RetryPolicy(), desk.reads, table, desk.now)
    assert desk.take() == []
    desk.now = asking.next_deadline()
    asking.tick(desk.now)
    return asking, table


def answer(desk: Desk, asking: DuplicateNameReads, name: str, index: int) -> None:
    """Answer the read, and pass the time until the next one."""
    desk.hear(name, index=index)
    if (next_at := asking.next_deadline()) < math.inf:
        desk.now = next_at
        asking.tick(next_at)


def test_late_values_that_arrive_in_one_moment_are_one_answer() -> None:
    desk = Desk("A")
    asking, table = repeated(desk, A=(3, 5))
    for _ in range(EQUAL_RESPONSES_MIN):
        desk.hear("A", index=5)
    assert not asking.done
    assert asking.next_deadline() == desk.now + RESPONSE_PAUSE
    desk.now += RESPONSE_PAUSE
    asking.tick(desk.now)
    for _ in range(EQUAL_RESPONSES_MIN):
        answer(desk, asking, "A", 3)
    assert is_so(asking.done)
    assert table.duplicate_indices == {"A": {5}}


def test_answers_that_never_agree_leave_it_open() -> None:
    desk = Desk("A")
    asking, table = repeated(desk, A=(3, 5))
    for number in range(RESPONSES_MAX):
        assert not asking.done
        answer(desk, asking, "A", (3, 5)[number % 2])
    assert asking.done
    assert table.duplicate_indices == {}


def test_a_name_that_is_not_answered_leaves_it_open() -> None:
    desk = Desk("A", "B")
    asking, table = repeated(desk, A=(3, 5), B=(0, 1))
    for _ in range(EQUAL_RESPONSES_MIN):
        answer(desk, asking, "B", 1)
    desk.pass_time()
    assert asking.done
    assert table.duplicate_indices == {"B": {0}}
    table.store_value(param_value("B", 1.0, index=1), "vehicle")
    assert table.store_value(param_value("B", 2.0, index=0), "vehicle") is None
    assert table.params["B"].value == 1.0


def test_the_note_names_a_few() -> None:
    names = {f"N{number}": (number, number + 100) for number in range(DUPLICATES_LISTED_MAX + 2)}
    note = DuplicateNameReads(names, RetryPolicy(), Desk().reads, Table(), 0.0).note
    assert "N0 (indices 0, 100)" in note
    assert "N4 (indices 4, 104) and 2 more" in note
    assert "N5" not in note


@pytest.mark.asyncio
async def test_a_duplicate_name_is_read_by_index() -> None:
    async with ParamClient(GenericVehicle(ROWS, repeated_names=True), cache=False) as client:
        vehicle = await client.component()
        await vehicle.fetch_all()
        other, meant = await vehicle.get(2), await vehicle.get(CUT)
        assert (other.name, other.index, other.value) == (CUT, 2, 2.0)
        assert (meant.index, meant.value) == (0, 1)
        assert vehicle.params[CUT].value == 1
