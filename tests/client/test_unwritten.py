"""A cache that cannot be written, or read: the session goes on, and nothing is lost unsaid."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

from paramclient import CacheError, ParamCache, ParamClient
from paramclient.cache import database
from paramclient.client import cache_writer
from paramclient.provision import apply
from paramclient.sim import PX4Vehicle
from tests.caches import full_disk, set_aside
from tests.shell import bits, in_simulated_time, simulated_time_loop, small_px4

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


@contextmanager
def full(path: Path) -> Iterator[None]:
    """The disk of the file has no room."""
    with full_disk(100):
        yield


Holding = Callable[[Path], AbstractContextManager[None]]
UNWRITABLE = pytest.mark.parametrize("unwritable", [locked, full], ids=["locked", "full"])


def time_of_day() -> float:
    """The time by which the cache keeps values."""
    return simulated_time_loop().now + simulated_time_loop().ahead


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.message for record in caplog.records if record.levelno >= logging.WARNING]


@UNWRITABLE
@in_simulated_time
async def test_values_written_late_keep_their_times_and_the_whole_history(
    unwritable: Holding, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    vehicle = PX4Vehicle(table={NAME: 1.0, "PARAM_02": 2.0})
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.only_component()
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


@in_simulated_time
async def test_a_cause_has_one_warning_from_open_to_close(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also where nothing is to be written for a time: that is no success."""
    vehicle = small_px4()
    async with ParamClient(vehicle, cache=f"postgresql://me@/fleet?host={tmp_path}") as client:
        component = await client.only_component()
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


@in_simulated_time
async def test_after_very_many_changes_the_whole_table_is_written(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache_writer, "PENDING_MAX", 20)
    vehicle = small_px4()
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.only_component()
        await component.fetch_all()
        await anyio.sleep(2.0)
        with locked(path):
            for value in range(40):
                vehicle.set_param(NAME, float(value))
                await anyio.sleep(cache_writer.FLUSH_INTERVAL)
        await anyio.sleep(2 * cache_writer.RETRY_INTERVAL)
        with ParamCache(path) as cache:
            assert cache.component().params[NAME].value == vehicle.values[NAME] == 39
            assert cache.component().complete


@UNWRITABLE
@in_simulated_time
async def test_a_client_that_ends_says_what_is_lost(
    unwritable: Holding, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with ExitStack() as held:
        async with ParamClient(small_px4(), cache=path) as client:
            component = await client.only_component()
            await component.fetch_all()
            await anyio.sleep(2.0)
            key = component.identity.key
            held.enter_context(unwritable(path))
            await component.set(NAME, 5.0)
        [lost] = warnings(caplog)
    assert lost.startswith(f"the last values of 1/1 ({key}) are not in the cache, and lost: ")


@in_simulated_time
async def test_a_client_that_ends_waits_for_the_cache(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A database that is restarting refuses connections for a time."""
    failures = iter([CacheError("the database is starting")] * 9)

    def save_at_last(*args: Any, **options: Any) -> None:
        if error := next(failures, None):
            raise error
        ParamCache.save(cache, *args, **options)

    with ParamCache(path) as cache:
        async with ParamClient(small_px4(), cache=cache) as client:
            component = await client.only_component()
            await component.fetch_all()
            await anyio.sleep(2.0)
            await component.set(NAME, 5.0)
            monkeypatch.setattr(cache, "save", save_at_last)
        assert cache.component().params[NAME].value == 5.0
