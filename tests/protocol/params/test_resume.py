"""Downloads that were not brought to their end, and what the next one makes of what is there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from paramclient import ParamCache, ParamClient, Trust
from paramclient.protocol.fetch import FetchResult
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, Vehicle
from paramclient.wire.messages import ParamRequestList, ParamRequestRead
from tests.caches import kill_when, params_on_disk
from tests.shell import bits, in_simulated_time
from tests.simulation import Simulation, listing_ardupilot

SIZE = 200
TABLE = {f"P{number:03d}": number for number in range(SIZE)}
MAKES: dict[str, Callable[[], PX4Vehicle | ArduPilotVehicle]] = {
    "PX4": lambda: PX4Vehicle(table=TABLE, burst=1, period=0.01),
    "ArduPilot": lambda: ArduPilotVehicle(ftp=False, table=TABLE, burst=1, period=0.01),
}
both = pytest.mark.parametrize("kind", MAKES)


def cancelled(vehicle: Vehicle, received: int = SIZE // 2, *, delay: float = 0.01) -> Simulation:
    """A session whose fetch was cancelled after the given number of values; the vehicle has stopped its
    list."""
    world = Simulation(air=Air.symmetric([vehicle], delay=delay))
    machine = world.meet()
    fetch = machine.begin_fetch(world.now)
    world.until(lambda: len(machine.table.params) >= received)
    machine.end_fetch(fetch, world.now)
    vehicle._position = None
    world.run(5.0)
    world.sent.clear()
    return world


def next_session(world: Simulation) -> None:
    """A new session that starts from what a cache has kept."""
    memory = world.memory()
    world.next_session()
    world.meet().use_cached(now=world.now, **memory)
    world.run(2.0)
    world.sent.clear()


def requests(world: Simulation) -> tuple[int, int]:
    """Lists and reads by index that were sent."""
    reads = [message for message in world.sent_of(ParamRequestRead) if message.param_index >= 0]
    return len(world.sent_of(ParamRequestList)), len(reads)


def is_right(result: FetchResult, vehicle: Vehicle) -> bool:
    return result.complete and {name: p.value for name, p in result.params.items()} == vehicle.values


# in the same session


@both
def test_the_next_fetch_goes_on_with_what_is_there(kind: str) -> None:
    vehicle = MAKES[kind]()
    world = cancelled(vehicle, 180)
    there = len(world.machine.table.params)
    fetch = world.machine.begin_fetch(world.now)
    world.run(0.03)
    assert fetch.progress(world.now).received >= there
    result = world.outcome(fetch)
    assert is_right(result, vehicle)
    assert (result.source, result.resumed) == ("stream", there)
    assert requests(world) == (0, SIZE - there + 1)
    assert world.machine.sync.synced
    assert world.machine.table.complete
    assert result.notes == ()
    assert (result.hash is not None) == (kind == "PX4")


def test_a_refresh_does_not_go_on_with_anything() -> None:
    world = cancelled(MAKES["PX4"]())
    result = world.fetch(refresh=True)
    assert result.complete
    assert result.resumed == 0
    assert requests(world) == (1, 0)


def test_after_a_changed_count_no_download_is_resumed() -> None:
    vehicle = ArduPilotVehicle(
        ftp=False, table=TABLE, groups={"P001": {"GROUP_A": 1, "GROUP_B": 2}}, burst=1, period=0.01
    )
    vehicle.set_param("P001", 0)
    world = cancelled(vehicle, 180)
    vehicle.set_param("P001", 1)
    vehicle.tick(world.now)
    vehicle.data_to_send()  # of which nothing is received
    result = world.fetch()
    assert is_right(result, vehicle)
    assert result.resumed == 0
    assert requests(world)[0] == 1
    assert result.count == SIZE + 2


def test_other_names_under_the_same_count_make_it_worthless() -> None:
    vehicle = ArduPilotVehicle(ftp=False, table=TABLE, burst=1, period=0.01)
    world = cancelled(vehicle, 180)
    names = dict(TABLE)
    del names["P010"]
    other = ArduPilotVehicle(ftp=False, table={**names, "Q": 1}, burst=1, period=0.01)
    memory = world.memory()
    world = Simulation(other)
    world.meet().use_cached(now=world.now, **memory)
    result = world.fetch()
    assert is_right(result, other)
    assert result.resumed == 0


# in the next session


def test_with_a_hash_the_whole_is_proven_and_counts_as_verified() -> None:
    table = {**TABLE, "COM_FLIGHT_UUID": 7}
    vehicle = PX4Vehicle(table=table, burst=1, period=0.01)
    vehicle._entry("COM_FLIGHT_UUID").volatile = True
    world = cancelled(vehicle, 150)
    vehicle.set_param("COM_FLIGHT_UUID", 8)
    world.run(1.0)
    next_session(world)
    there = len(world.machine.table.params)
    result = world.fetch()
    assert result.complete
    assert result.hash == vehicle.announced_hash()
    assert result.resumed == there
    assert requests(world) == (0, SIZE + 1 - there + 1)
    assert world.machine.sync.synced
    world.run(1.0)
    trusts = {name: param.trust for name, param in world.machine.table.params.items()}
    assert trusts["COM_FLIGHT_UUID"] is Trust.LIVE, "no hash covers it, so it was read afresh"
    assert trusts["P000"] is Trust.VERIFIED
    assert Trust.CACHED not in trusts.values()
    assert world.machine.table.params["COM_FLIGHT_UUID"].value == 8


def test_a_change_since_the_interruption_leads_to_a_new_list() -> None:
    vehicle = MAKES["PX4"]()
    world = cancelled(vehicle, 150)
    memory = world.memory()
    vehicle.set_param("P003", 1234)
    world.run(1.0)
    world.next_session()
    world.meet().use_cached(now=world.now, **memory)
    result = world.fetch()
    assert is_right(result, vehicle)
    assert result.resumed == 0
    assert requests(world)[0] == 1
    assert any("does not match" in note for note in result.notes)
    assert isinstance(vehicle, PX4Vehicle)
    assert result.hash == vehicle.announced_hash()
    assert {param.trust for param in result.params.values()} == {Trust.LIVE}


def test_without_a_hash_earlier_values_stay_what_they_are() -> None:
    vehicle = MAKES["ArduPilot"]()
    world = cancelled(vehicle, 180)
    next_session(world)
    there = len(world.machine.table.params)
    result = world.fetch()
    assert result.complete
    assert result.resumed == there
    assert not result.is_confirmed
    assert any(f"{there - 1} values are from an earlier session" in note for note in result.notes)
    assert requests(world) == (0, SIZE - there + 1)
    assert not world.machine.sync.synced
    assert world.machine.state == "cached"
    assert sum(param.trust is Trust.CACHED for param in result.params.values()) == there - 1, (
        "one was requested"
    )
    again = world.fetch(refresh=True)
    assert again.is_confirmed
    assert world.machine.sync.synced


@both
def test_another_count_by_now_leads_to_a_fresh_list(kind: str) -> None:
    vehicle = MAKES[kind]()
    world = cancelled(vehicle, 180)
    memory = world.memory()
    grown = {**TABLE, "AAA": 1}
    grown_vehicle = (
        PX4Vehicle(table=grown, burst=1, period=0.01)
        if kind == "PX4"
        else ArduPilotVehicle(ftp=False, table=grown, burst=1, period=0.01)
    )
    world = Simulation(grown_vehicle)
    world.meet().use_cached(now=world.now, **memory)
    result = world.fetch()
    assert is_right(result, grown_vehicle)
    assert result.resumed == 0
    assert {param.trust for param in result.params.values()} == {Trust.LIVE}


# from the cache on disk


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cache.sqlite3"


KILLED_SESSION = """
import anyio, sys
from paramclient import ParamClient
from paramclient import sim

async def main():
    vehicle = sim.{made}
    async with ParamClient(vehicle, cache=sys.argv[1]) as client:
        component = await client.component()
        changes = component.changes()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(component.fetch_all)
            async for _ in changes:
                print(flush=True)

anyio.run(main)
"""


@pytest.mark.slow  # it runs a process
@pytest.mark.parametrize(
    ("make", "made", "after"),
    [
        (PX4Vehicle, "PX4Vehicle(burst=1, period=0.004)", 520),
        (listing_ardupilot, "ArduPilotVehicle(ftp=False, burst=1, period=0.005)", 1200),
    ],
)
def test_after_a_killed_process_only_what_is_missing_is_fetched(
    path: Path, make: Callable[..., Vehicle], made: str, after: int
) -> None:
    vehicle = make()
    kill_when(KILLED_SESSION.format(made=made), path, lambda params: len(params) >= after)
    there = len(params_on_disk(path))

    @in_simulated_time
    async def next_session() -> None:
        async with ParamClient(vehicle, cache=path) as client:
            component = await client.component()
            result = await component.fetch_all()
            assert result.complete
            assert result.resumed == there
            count = len(vehicle.params)
            assert vehicle.requests["PARAM_REQUEST_LIST"] == 0
            assert vehicle.requests["PARAM_REQUEST_READ"] < 1.5 * (count - there), "some are requested twice"
            assert bits(result.params) == bits(vehicle.params)
            assert (result.hash == vehicle.announced_hash()) if isinstance(vehicle, PX4Vehicle) else True
        with ParamCache(path) as cache:
            kept = cache.component()
            assert kept.complete
            assert (kept.synced_at is not None) == isinstance(vehicle, PX4Vehicle)

    next_session()


async def left_unfinished(vehicle: Vehicle, path: Path) -> None:
    """A session that ends in the middle of its download."""
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.component()
        assert not (await component.fetch_all(timeout=1.7)).complete


async def fetched(vehicle: Vehicle, path: Path) -> FetchResult:
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.component()
        return await component.fetch_all()


@in_simulated_time
async def test_a_download_begun_under_another_count_is_no_mixture(path: Path) -> None:
    """The first table is whole, the download of a grown one breaks off: old indices count for nothing."""
    await fetched(MAKES["ArduPilot"](), path)
    grown_table = {"AAA": 1, **TABLE}
    grown = ArduPilotVehicle(ftp=False, table=grown_table, burst=1, period=0.01)
    await left_unfinished(grown, path)
    with ParamCache(path) as cache:
        kept = cache.component()
        assert not kept.complete
        assert kept.count is None, "some indices are of before"
    again = ArduPilotVehicle(ftp=False, table=grown_table, burst=1, period=0.01)
    result = await fetched(again, path)
    assert is_right(result, again)
    assert result.resumed == 0
    with ParamCache(path) as cache:
        assert cache.component().count == SIZE + 1
