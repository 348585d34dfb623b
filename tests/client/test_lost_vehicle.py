"""A vehicle that goes silent in the middle of a call: an end within 7 s, with every value that came."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

import anyio
import pytest

from paramclient import NoReply, ParamClient, SetOutcome, SetStatus, SyncState
from paramclient.model.values import ParamType
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, Vehicle
from tests.client.conftest import connected, fetched, table_in
from tests.conversations.test_fetch import new_vehicle
from tests.conversations.virtual import Silence

TIME_MAX = 7.0


class World:
    """A vehicle on a link with a delay each way, which goes silent when a condition holds."""

    def __init__(self, kind: str, delay: float = 0.05) -> None:
        self.vehicle: Vehicle = new_vehicle(kind)
        self.endpoint = Silence(Air.symmetric([self.vehicle], delay=delay), at=1e9)
        # those that no rule of a firmware limits, moves or protects
        names = [each.name for each in self.vehicle.listed if each.type is ParamType.REAL32]
        ruled = ("MPC", "LNDMC", "BARO", "STAT", "MIS_", "INS")
        free = [name for name in names if not name.startswith(ruled)][:150]
        self.wanted = {name: 0.25 + number for number, name in enumerate(free)}

    async def until_silent(self, is_due: Callable[[], bool], call: Callable[[], Awaitable[object]]) -> None:
        """Run a call; check that it ends in time after the vehicle went silent."""

        async def watch() -> None:
            while not is_due():  # noqa: ASYNC110 - in simulated time
                await anyio.sleep(0.01)
            self.endpoint.at = anyio.current_time()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(watch)
            await call()
            assert self.endpoint.at <= anyio.current_time() < self.endpoint.at + TIME_MAX


@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list"])
async def test_a_refresh_of_a_cached_table(kind: str, tmp_path: Path) -> None:
    world = World(kind)
    cache = tmp_path / "cache.sqlite3"
    async with ParamClient(world.endpoint, cache=cache) as client:
        count = (await (await client.component()).fetch_all()).count
    synced_at = table_in(cache, system=1).synced_at
    received = [0]
    assert isinstance(world.vehicle, PX4Vehicle | ArduPilotVehicle)
    world.vehicle.load(world.wanted)
    async with connected(world.endpoint, cache=cache) as (_, component):
        await anyio.sleep(2.0)

        async def call() -> None:
            result = await component.fetch_all(
                refresh=True, progress=lambda each: received.append(each.received)
            )
            assert not result.complete
            assert result.hash is None
            assert (result.count, len(result.params)) == (count, count)
            assert {result.params[name].index for name in result.cached} == set(result.missing)
            assert 50 < result.received == count - len(result.cached)
            wrong = {
                name
                for name, param in result.params.items()
                if not param.same_value(world.vehicle.param(name))
            }
            assert wrong <= set(result.cached)

        began = anyio.current_time()
        await world.until_silent(lambda: received[-1] > 120 or anyio.current_time() > began + 0.3, call)
        world.endpoint.at = 1e9
        await anyio.sleep(2.0)
        assert (component.state, component.sync_state) == ("cached", SyncState.UNSYNCED)
    assert table_in(cache, system=1).synced_at == synced_at


@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list", "generic"])
@pytest.mark.parametrize("delay", [0.05, 1.25])
async def test_set_many(kind: str, delay: float, tmp_path: Path) -> None:
    world = World(kind, delay)
    cache = tmp_path / "cache.sqlite3"
    async with fetched(world.endpoint, cache=cache) as (_, component):
        accepted: set[str] = set()
        seen: list[SetOutcome] = []

        async def call() -> None:
            result = await component.set_many(world.wanted, progress=seen.append)
            assert isinstance(result.error, NoReply)
            assert sorted(each.name for each in seen) == sorted(world.wanted)
            assert {each.status for each in result.outcomes} == {
                *(SetStatus.ACCEPTED, SetStatus.UNKNOWN, SetStatus.NOT_TRIED)
            }
            assert all(each.is_set is (each.error is None) for each in result.outcomes)
            assert delay > 1.0 or 1 <= result.counts[SetStatus.UNKNOWN] <= 20
            accepted.update(each.name for each in result.outcomes if each.status is SetStatus.ACCEPTED)

        await world.until_silent(lambda: world.vehicle.requests["PARAM_SET"] >= 40, call)
    assert len(accepted) >= 10
    params = table_in(cache, system=1).params
    for name in accepted:
        value = world.wanted[name]
        assert value == params[name].value == component.params[name].value == world.vehicle.param(name).value
