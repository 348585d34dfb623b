"""The cache in trouble: a disk that fails or is full, a lock, a clock that is set, a file that goes."""

from __future__ import annotations

import logging
import math
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import anyio
import pytest

from paramclient import CacheError, NotDurable, ParamCache, ParamClient, Trust, UnknownParameter, UsageError
from paramclient.cache import database
from paramclient.client import cache_writer
from paramclient.provision import apply
from paramclient.sim import Air, PX4Vehicle
from tests.caches import PX4, full_disk, rubbish, set_aside, stored, update
from tests.client.conftest import connected, fetched, table_in
from tests.shell import Tap, bits, simulated_time_loop, small_px4

NAME = "PARAM_01"


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "LOCK_WAIT_MAX", 0.05)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Another program holds the file for itself alone."""
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield


Holding = Callable[[Path], AbstractContextManager[None]]
UNWRITABLE = pytest.mark.parametrize("unwritable", [locked, lambda _: full_disk(100)], ids=["locked", "full"])


HOUR = 3600.0
DAY = 24 * HOUR


def time_of_day() -> float:
    """Seconds as the cache has them: they go on with the clock of the loop."""
    return simulated_time_loop().now + simulated_time_loop().ahead


def set_clock(at: float) -> None:
    simulated_time_loop().ahead = at - simulated_time_loop().now


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.message for record in caplog.records if record.levelno >= logging.WARNING]


@UNWRITABLE
async def test_values_written_late_keep_their_times_and_the_whole_history(
    unwritable: Holding, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    vehicle = PX4Vehicle(table={NAME: 1.0, "PARAM_02": 2.0})
    async with connected(vehicle, cache=path) as (_, component):
        for name in vehicle.params:
            await component.get(name)
        await anyio.sleep(2.0)
        with unwritable(path):
            await anyio.sleep(5.0)
            await component.fetch_all()
            fetched_at = time_of_day()
            changes, received = component.changes(), []
            for value in (5.0, 6.0, 7.0):
                vehicle.set_param(NAME, value)
                await anext(changes)
                received.append(time_of_day())
                await anyio.sleep(10)
        await anyio.sleep(2 * cache_writer.RETRY_INTERVAL + cache_writer.FLUSH_INTERVAL)
        with ParamCache(path) as cache:
            table = cache.component()
            lines = cache.history(table.key)
    assert table.complete
    assert bits(table.params) == bits(vehicle.params)
    assert table.heard_at["PARAM_02"] == pytest.approx(fetched_at, abs=0.1)
    assert not set_aside(path)
    assert [(line.old.value, line.new and line.new.value) for line in lines] == [(1, 5), (5, 6), (6, 7)]
    assert [line.at for line in lines] == pytest.approx(received, abs=0.01)
    [warning] = warnings(caplog)
    assert warning.startswith("continuing without the cache: ")


async def test_one_cause_has_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Also where nothing is to be written for a time: that is no success."""
    vehicle = small_px4()
    async with connected(vehicle, cache=f"postgresql://me@/fleet?host={tmp_path}") as (client, component):
        await client.core.cache_writer.write_all()
        await component.fetch_all()
        await anyio.sleep(2 * cache_writer.RETRY_INTERVAL)
        with pytest.raises(CacheError, match=r"nothing was sent, .*--no-cache"):
            await apply(component, {NAME: 5.0})
        assert not vehicle.requests["PARAM_SET"]
        assert (await component.set(NAME, 5.0)).actual == 5.0
    [warning] = warnings(caplog)
    assert warning.startswith("continuing without the cache: ")
    assert "\n" not in warning


async def test_many_changes_write_the_whole_table(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache_writer, "PENDING_MAX", 20)
    vehicle = small_px4()
    async with fetched(vehicle, cache=path):
        await anyio.sleep(2.0)
        with locked(path):
            for value in range(40):
                vehicle.set_param(NAME, float(value))
                await anyio.sleep(cache_writer.FLUSH_INTERVAL)
        await anyio.sleep(2 * cache_writer.RETRY_INTERVAL)
        with ParamCache(path) as cache:
            assert cache.component().params[NAME].value == vehicle.values[NAME] == 39
            assert cache.component().complete


@pytest.mark.parametrize("is_told", [False, True])
@UNWRITABLE
async def test_an_end_says_what_is_lost_unless_an_error_said_why(
    unwritable: Holding, is_told: bool, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with ExitStack() as held:
        async with fetched(Air([small_px4(), small_px4(system=2)]), cache=path) as (client, component):
            await anyio.sleep(2.0)
            names = [f"{each.system}/1 ({each.identity.key})" for each in client.autopilots]
            held.enter_context(unwritable(path))
            for each in client.autopilots:
                await each.set(NAME, 5.0)
            if is_told:
                await anyio.sleep(1.0)  # a write fails meanwhile
                with pytest.raises(CacheError, match="nothing was sent"):
                    await apply(component, {NAME: 6.0})
        lost = [each.partition(", and lost: ")[0] for each in warnings(caplog)]
    assert lost == [f"the last values of {', '.join(names)} are not in the cache"] * (not is_told)


async def test_a_client_that_ends_waits_for_the_cache(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A database that is restarting refuses connections for a time."""
    failures = iter([CacheError("the database is starting")] * 9)

    def save_at_last(*args: Any, **options: Any) -> None:
        if error := next(failures, None):
            raise error
        ParamCache.save(cache, *args, **options)

    with ParamCache(path) as cache:
        async with fetched(small_px4(), cache=cache) as (_, component):
            await anyio.sleep(2.0)
            await component.set(NAME, 5.0)
            monkeypatch.setattr(cache, "save", save_at_last)
        assert cache.component().params[NAME].value == 5.0


# Durable writes


@contextmanager
def no_disk() -> Iterator[None]:
    """No write of any cache can be made durable."""
    save = ParamCache.save

    def fail(cache: ParamCache, update: Any, *, durable: bool = False) -> None:
        if durable:
            raise CacheError("no room")
        save(cache, update)

    with mock.patch.object(ParamCache, "save", fail):
        yield


async def test_a_durable_set_is_on_the_disk_with_its_line_when_it_returns(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    async with connected(small_px4(), cache=path) as (_, component):
        for number, value in enumerate((5.0, 6.0, 6.0)):  # at once, with the vehicle hardly known
            assert (await component.set(NAME, value, durable=True)).status == "accepted"
            with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as other:
                assert other.execute("SELECT count(*) FROM history").fetchone() == (min(number + 1, 2),)
            assert table_in(path).params[NAME].value == value


async def test_without_a_disk_nothing_is_sent_or_it_is_said_what_the_vehicle_has(tmp_path: Path) -> None:
    vehicle = small_px4()
    async with connected(vehicle, cache=False) as (_, component):
        values = {NAME: 5.0}
        for call in (component.set_many(values, durable=True), apply(component, values, durable=True)):
            with pytest.raises(UsageError, match="durable needs a cache"):
                await call
        with pytest.raises(UsageError, match="durable needs a cache"):
            await component.set(NAME, 5.0, durable=True)
    assert vehicle.values[NAME] != 5.0
    async with fetched(vehicle, cache=tmp_path / "cache") as (client, component):
        with no_disk(), pytest.raises(NotDurable, match=f"1/1 has accepted {NAME}, but .*: no room"):
            await component.set(NAME, 10.0, durable=True)
        assert vehicle.values[NAME] == component.params[NAME].value == 10.0
        with no_disk():
            result = await component.set_many({NAME: 3, "NO_SUCH": 1, "PARAM_02": 4}, durable=True)
        assert isinstance(result.error, NotDurable)
        assert isinstance(result["PARAM_02"].error, NotDurable)
        assert (result["PARAM_02"].status, result["PARAM_02"].is_set) == ("accepted", True)
        assert isinstance(result["NO_SUCH"].error, UnknownParameter)
        assert not result.is_complete
        await component.set(NAME, 11.0, durable=True)
        assert client.cache is not None
        assert client.cache.component().params[NAME].value == 11.0


async def test_a_durable_apply_ends_on_the_disk(tmp_path: Path) -> None:
    async with connected(vehicle := small_px4(), cache=tmp_path / "cache") as (_, component):
        assert (await apply(component, {NAME: 5.0}, durable=True)).complete
        with no_disk():
            result = await apply(component, {NAME: 6.0}, durable=True)
        assert isinstance(result.error, CacheError)
        assert vehicle.values[NAME] == 6.0


# The clock is set


@pytest.mark.parametrize("step", [-HOUR, -DAY, HOUR, 400 * DAY])
async def test_a_step_of_the_clock_changes_only_recorded_times(path: Path, step: float) -> None:
    tap = Tap(vehicle := small_px4())
    set_clock(1_800_000_000.0)
    set_at: list[float] = []

    async def write(value: int) -> None:
        await component.set("PARAM_01", value)
        set_at.append(time_of_day())

    async with fetched(tap, cache=path) as (_, component):
        await anyio.sleep(2.0)
        await write(10)
        await anyio.sleep(2.0)
        tap.received.clear()
        simulated_time_loop().ahead += step
        await anyio.sleep(5.0)
        assert len(tap.received) <= 6, "our heartbeats"
        assert component.params["PARAM_02"].trust is Trust.LIVE
        await write(20)
        await anyio.sleep(2.0)
        simulated_time_loop().ahead -= step
        await write(30)
    with ParamCache(path) as cache:
        table = cache.component(system=1)
        lines = cache.history(table.key, name="PARAM_01")
        written = sorted(zip(set_at, [10, 20, 30], strict=True))
        assert [line.new and line.new.value for line in lines] == [value for _, value in written]
        assert [line.at for line in lines] == pytest.approx(sorted(set_at), abs=0.001)
        assert table.heard_at["PARAM_01"] == pytest.approx(set_at[-1], abs=0.05), "it is received once more"
        assert bits(table.params) == bits(vehicle.params)
    simulated_time_loop().ahead += step
    async with ParamClient(vehicle, cache=path) as client:
        result = await (await client.component()).fetch_all()
        assert result.source == "cache", "the hash says so, whatever the clock says"


@pytest.mark.parametrize("wrong", [-DAY, 1e12, math.nan])
async def test_a_clock_that_cannot_be_costs_a_warning_and_nothing_is_lost(
    path: Path, wrong: float, caplog: pytest.LogCaptureFixture
) -> None:
    vehicle, right = small_px4(), time_of_day()
    async with ParamClient(vehicle, cache=path) as client:
        set_clock(wrong)
        assert (await (await client.component()).fetch_all()).complete
        await anyio.sleep(1.0)
        set_clock(right)
        await anyio.sleep(cache_writer.RETRY_INTERVAL + 1.0)
    [warning] = warnings(caplog)
    assert warning.startswith("continuing without the cache: ")
    assert bits(table_in(path, system=1).params) == bits(vehicle.params)


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
        other.save(update(stored("OTHER", 1), identity=replace(PX4, system=7)))


@pytest.mark.parametrize("happens", [delete, move, damage, put_another_in_its_place])
@pytest.mark.parametrize("known", [False, True], ids=["new", "known from before"])
@pytest.mark.parametrize("seconds_to_the_end", [3.0, 0.0])
async def test_a_file_that_goes_is_followed_by_one_that_holds_everything(
    path: Path, happens: Callable[[Path], None], known: bool, seconds_to_the_end: float
) -> None:
    """Not only what is received from then on: a table that is called whole has to be."""
    vehicle = small_px4()
    if known:
        async with fetched(vehicle, cache=path):
            pass
    async with connected(vehicle, cache=path) as (_, component):
        assert (await component.fetch_all()).source == ("cache" if known else "stream")
        await anyio.sleep(2.0)
        happens(path)
        await component.set(NAME, 55)
        await anyio.sleep(seconds_to_the_end)
        if seconds_to_the_end:
            assert bits(table_in(path, system=1).params) == bits(vehicle.params)
    table = table_in(path, system=1)
    assert (table.complete, table.hash) == (True, vehicle.announced_hash())
    assert bits(table.params) == bits(vehicle.params)
    async with connected(vehicle, cache=path) as (_, component):
        assert (await component.fetch_all()).source == "cache"


async def test_half_a_table_removes_nothing_from_a_file_that_others_made(path: Path) -> None:
    """Another program has fetched all of it into the file that it found gone; we know a part."""
    vehicle = small_px4()
    async with connected(vehicle, cache=path) as (_, component):
        await component.get("PARAM_02")
        await anyio.sleep(2.0)
        delete(path)
        async with ParamClient(small_px4(), cache=path) as other:
            await (await other.component()).fetch_all()
        await component.get("PARAM_03")
        vehicle.set_param("PARAM_03", 5)
        await anyio.sleep(3.0)
    assert len(table_in(path, system=1).params) == len(vehicle.params)
