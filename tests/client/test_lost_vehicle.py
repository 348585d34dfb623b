"""A vehicle that goes silent in the middle of a call: an end within 7 s, with every value that came."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

import anyio
import pytest

from paramclient import Component, NoReply, ParamCache, ParamClient, SetOutcome, SetStatus, SyncState
from paramclient.cli.json_apply import apply_json
from paramclient.cli.json_output import outcome_json
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType
from paramclient.provision import ApplyStatus, apply
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, Vehicle
from tests.conversations.test_fetch import new_vehicle
from tests.conversations.virtual import Silence
from tests.shell import in_simulated_time

KINDS = pytest.mark.parametrize("kind", ["px4", "ardupilot", "list", "generic"])
DELAYS = pytest.mark.parametrize("delay", [0.05, 0.4, 1.25], ids=lambda delay: f"{2 * delay}s")
TIME_MAX = 7.0


class World:
    """A vehicle on a link with a delay each way, which goes silent when a condition holds."""

    def __init__(self, kind: str, delay: float = 0.05) -> None:
        self.vehicle: Vehicle = new_vehicle(kind)
        self.endpoint = Silence(Air.symmetric([self.vehicle], delay=delay), at=1e9)
        floats = [each.name for each in self.vehicle.listed if each.type is ParamType.REAL32]
        self.wanted = {name: 0.25 + number for number, name in enumerate(plain(floats)[:150])}

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

    def is_written(self, number: int) -> bool:
        """Return whether so many sets have arrived."""
        return self.vehicle.requests["PARAM_SET"] >= number


def plain(names: list[str]) -> list[str]:
    """Return the names that no rule of a firmware limits, moves or protects."""
    return [name for name in names if not name.startswith(("MPC", "LNDMC", "BARO", "STAT", "MIS_", "INS"))]


@KINDS
@DELAYS
@in_simulated_time
async def test_fetch(kind: str, delay: float) -> None:
    world = World(kind, delay)
    received = [0]
    async with ParamClient(world.endpoint, cache=False) as client:
        component = await client.component()
        await anyio.sleep(2.0)

        async def call() -> None:
            result = await component.fetch_all(progress=lambda each: received.append(each.received))
            assert 50 < result.received < result.count
            assert len(result.params) == len(component.params) == result.received
            for name, param in result.params.items():
                assert param.same_value(world.vehicle.param(name))

        began = anyio.current_time()
        cut_off_after = 6 * delay if kind == "ardupilot" else 1e9  # its file shows no progress before the end
        await world.until_silent(
            lambda: received[-1] > 120 or anyio.current_time() > began + cut_off_after, call
        )


@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list"])
@in_simulated_time
async def test_a_refresh_of_a_cached_table(kind: str, tmp_path: Path) -> None:
    world = World(kind)
    cache = tmp_path / "cache.sqlite3"
    async with ParamClient(world.endpoint, cache=cache) as client:
        count = (await (await client.component()).fetch_all()).count
    with ParamCache(cache) as opened:
        synced_at = opened.component(system=1).synced_at
    received = [0]
    assert isinstance(world.vehicle, PX4Vehicle | ArduPilotVehicle)
    world.vehicle.load(world.wanted)
    async with ParamClient(world.endpoint, cache=cache) as client:
        component = await client.component()
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
    with ParamCache(cache) as opened:
        assert opened.component(system=1).synced_at == synced_at


@KINDS
@DELAYS
@in_simulated_time
async def test_set_many(kind: str, delay: float, tmp_path: Path) -> None:
    world = World(kind, delay)
    cache = tmp_path / "cache.sqlite3"
    async with ParamClient(world.endpoint, cache=cache) as client:
        component = await client.component()
        await component.fetch_all()
        accepted: dict[str, float] = {}
        seen: list[SetOutcome] = []

        async def call() -> None:
            result = await component.set_many(world.wanted, progress=seen.append)
            assert isinstance(result.error, NoReply)
            assert sorted(each.name for each in seen) == sorted(world.wanted)
            assert {each.status for each in result.outcomes} == {
                *(SetStatus.ACCEPTED, SetStatus.UNKNOWN, SetStatus.NOT_TRIED)
            }
            for each in result.outcomes:
                shown = outcome_json(each, ParamType.REAL32, None)
                assert shown["status"] == each.status.value
                assert each.is_set is (each.error is None)
                if each.status is SetStatus.ACCEPTED:
                    accepted[each.name] = shown["actual"]

        await world.until_silent(lambda: world.is_written(40), call)
        check_acknowledged(world, component, accepted)
    with ParamCache(cache) as opened:
        params = opened.component(system=1).params
        assert {name: params[name].value for name in accepted} == accepted


def check_acknowledged(world: World, component: Component, accepted: dict[str, float]) -> None:
    """Check that acknowledged values are the wanted ones, in the table and on the vehicle."""
    assert len(accepted) >= 10
    for name, value in accepted.items():
        assert value == world.wanted[name] == component.params[name].value == world.vehicle.param(name).value


@KINDS
@in_simulated_time
async def test_apply(kind: str) -> None:
    world = World(kind)
    wanted = ParamSet(
        {name: WrittenParam(name, value, ParamType.REAL32) for name, value in world.wanted.items()}, 1, 1
    )
    async with ParamClient(world.endpoint, cache=False) as client:
        component = await client.component()

        async def call() -> None:
            result = await apply(component, wanted)
            assert result.error is not None
            assert result.rows.keys() == world.wanted.keys()
            shown = apply_json(result, component)
            rows = {name: row["actual"] for name, row in shown["params"].items()}
            assert rows == {name: row.actual for name, row in result.rows.items()}
            accepted = {name: value for name, value in rows.items() if value == world.wanted[name]}
            check_acknowledged(world, component, accepted)
            assert {result.rows[name].status for name in accepted} <= {
                ApplyStatus.ACCEPTED,
                ApplyStatus.UNPROVEN,
            }

        await world.until_silent(lambda: world.is_written(40), call)
