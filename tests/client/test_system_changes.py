"""The clock is set, and the cache's folder goes, fills up or is locked, while a client is at work."""

from __future__ import annotations

import logging
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import anyio
import pytest

from paramclient import ParamCache, ParamClient, Trust
from paramclient.cache import TableUpdate
from paramclient.client import cache_writer
from tests.caches import PX4, rubbish, stored, update
from tests.shell import Tap, bits, in_simulated_time, simulated_time_loop, small_px4

HOUR = 3600.0
DAY = 24 * HOUR


class Wall:
    """The time of day that the cache uses: it goes on with the clock of the loop, and can be set."""

    @property
    def now(self) -> float:
        return simulated_time_loop().now + simulated_time_loop().ahead

    @now.setter
    def now(self, at: float) -> None:
        simulated_time_loop().ahead = at - simulated_time_loop().now


@pytest.fixture
def wall() -> Wall:
    return Wall()


# The clock is set


@pytest.mark.parametrize("step", [-HOUR, -DAY, HOUR, 400 * DAY])
@in_simulated_time
async def test_a_step_of_the_clock_changes_only_recorded_times(path: Path, wall: Wall, step: float) -> None:
    tap = Tap(vehicle := small_px4())
    wall.now = 1_800_000_000.0
    set_at: list[float] = []

    async def write(value: int) -> None:
        await component.set("PARAM_01", value)
        set_at.append(wall.now)

    async with ParamClient(tap, cache=path) as client:
        component = await client.component()
        await component.fetch_all()
        await anyio.sleep(2.0)
        await write(10)
        await anyio.sleep(2.0)
        tap.received.clear()
        wall.now += step
        await anyio.sleep(5.0)
        assert len(tap.received) <= 6, "our heartbeats"
        assert component.params["PARAM_02"].trust is Trust.LIVE
        await write(20)
        await anyio.sleep(2.0)
        wall.now -= step
        await write(30)
    with ParamCache(path) as cache:
        table = cache.component(system=1)
        lines = cache.history(table.key, name="PARAM_01")
        written = sorted(zip(set_at, [10, 20, 30], strict=True))
        assert [line.new and line.new.value for line in lines] == [value for _, value in written]
        assert [line.at for line in lines] == pytest.approx(sorted(set_at), abs=0.001)
        assert table.heard_at["PARAM_01"] == pytest.approx(set_at[-1], abs=0.05), "it is received once more"
        assert bits(table.params) == bits(vehicle.params)
    wall.now += step
    async with ParamClient(vehicle, cache=path) as client:
        result = await (await client.component()).fetch_all()
        assert result.source == "cache", "the hash says so, whatever the clock says"


@pytest.mark.parametrize("wrong", [-DAY, 1e12, math.nan])
@in_simulated_time
async def test_a_clock_that_cannot_be_costs_a_warning_and_nothing_is_lost(
    path: Path, wall: Wall, wrong: float, caplog: pytest.LogCaptureFixture
) -> None:
    vehicle, right = small_px4(), wall.now
    async with ParamClient(vehicle, cache=path) as client:
        wall.now = wrong
        component = await client.component()
        assert (await component.fetch_all()).complete
        await anyio.sleep(1.0)
        wall.now = right
        await anyio.sleep(cache_writer.RETRY_INTERVAL + 1.0)
    [warning] = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert warning.startswith("continuing without the cache: ")
    with ParamCache(path) as cache:
        assert bits(cache.component(system=1).params) == bits(vehicle.params)


# The cache's folder


def delete(path: Path) -> None:
    shutil.rmtree(path.parent)


def move(path: Path) -> None:
    path.parent.rename(path.parent.with_name("elsewhere"))


def damage(path: Path) -> None:
    """Another program finds it damaged, and sets it aside."""
    path.write_bytes(rubbish(90_000))
    with ParamCache(path) as other:
        other.components()


def put_another_in_its_place(path: Path) -> None:
    delete(path)
    with ParamCache(path) as other:
        other.save(of_another_vehicle())


def of_another_vehicle() -> TableUpdate:
    return update(stored("OTHER", 1), identity=replace(PX4, system=7))


@pytest.mark.parametrize("happens", [delete, move, damage, put_another_in_its_place])
@pytest.mark.parametrize("known", [False, True], ids=["new", "known from before"])
@in_simulated_time
async def test_a_file_that_goes_is_followed_by_one_that_holds_everything(
    path: Path, happens: Callable[[Path], None], known: bool
) -> None:
    """Not only what is received from then on: a table that is called whole has to be."""
    vehicle = small_px4()
    if known:
        async with ParamClient(vehicle, cache=path) as client:
            await (await client.component()).fetch_all()
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.component()
        result = await component.fetch_all()
        assert result.source == ("cache" if known else "stream")
        await anyio.sleep(2.0)
        happens(path)
        await component.set("PARAM_01", 55)
        await anyio.sleep(3.0)
        with ParamCache(path) as cache:
            assert bits(cache.component(system=1).params) == bits(vehicle.params)
    with ParamCache(path) as cache:
        table = cache.component(system=1)
        assert (table.complete, table.hash) == (True, vehicle.announced_hash())
        assert bits(table.params) == bits(vehicle.params)
    async with ParamClient(vehicle, cache=path) as client:
        assert (await (await client.component()).fetch_all()).source == "cache"


@in_simulated_time
async def test_a_file_that_goes_just_before_the_end(path: Path) -> None:
    vehicle = small_px4()
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.component()
        await component.fetch_all()
        await anyio.sleep(2.0)
        delete(path)
        await component.set("PARAM_01", 55)
    with ParamCache(path) as cache:
        assert bits(cache.component(system=1).params) == bits(vehicle.params)


@in_simulated_time
async def test_half_a_table_removes_nothing_from_a_file_that_others_made(path: Path) -> None:
    """Another program has fetched all of it into the file that it found gone; we know a part."""
    vehicle = small_px4()
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.component()
        await component.get("PARAM_02")
        await anyio.sleep(2.0)
        delete(path)
        async with ParamClient(small_px4(), cache=path) as other:
            await (await other.component()).fetch_all()
        await component.get("PARAM_03")
        vehicle.set_param("PARAM_03", 5)
        await anyio.sleep(3.0)
    with ParamCache(path) as cache:
        assert len(cache.component(system=1).params) == len(vehicle.params)
