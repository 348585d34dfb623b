"""A cache that cannot be written, or read: the session goes on, and nothing is lost unsaid."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial
from pathlib import Path

import anyio
import pytest

from paramclient import CacheError, Component, ParamCache, ParamClient
from paramclient.cache import database
from paramclient.client.cache_writer import FLUSH_INTERVAL, PENDING_MAX, RETRY_INTERVAL
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.provision import apply
from paramclient.sim import PX4Vehicle
from tests.caches import full_disk, whole_table
from tests.commands import in_process
from tests.shell import in_simulated_time, small_px4, until

NAME = "PARAM_01"


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "LOCK_WAIT_MAX", 0.05)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cache.sqlite3"


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


def fails_at_first(save: Callable[..., None]) -> Callable[..., None]:
    """A write that succeeds only the tenth time."""
    failures = iter([CacheError("the database is starting")] * 9)

    def write(*args: object, **kwargs: object) -> None:
        if (error := next(failures, None)) is not None:
            raise error
        save(*args, **kwargs)

    return write


Holding = Callable[[Path], AbstractContextManager[None]]
UNWRITABLE = pytest.mark.parametrize("unwritable", [locked, full], ids=["locked", "full"])


def is_received(component: Component, value: float) -> bool:
    return component.params[NAME].value == value


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
        await component.fetch_all()
        await anyio.sleep(2.0)
        began_at = anyio.current_time()
        with unwritable(path):
            received = []
            for value in (5.0, 6.0, 7.0):
                vehicle.set_param(NAME, value)
                await until(partial(is_received, component, value))
                received.append(anyio.current_time() - began_at)
                await anyio.sleep(10)
        await anyio.sleep(2 * RETRY_INTERVAL + FLUSH_INTERVAL)
        with ParamCache(path) as cache:
            lines = cache.history(cache.vehicles()[0].key)
    assert [(line.old.value, line.new and line.new.value) for line in lines] == [(1, 5), (5, 6), (6, 7)]
    ahead = lines[0].at - received[0]
    assert [line.at - ahead for line in lines] == pytest.approx(received, abs=0.01)
    [warning] = warnings(caplog)
    assert warning.startswith("continuing without the cache: ")


@in_simulated_time
async def test_a_cause_has_one_warning_from_open_to_close(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also where nothing is to be written for a time: that is no success."""
    async with ParamClient(small_px4(), cache=f"postgresql://me@/fleet?host={tmp_path}") as client:
        component = await client.only_component()
        await client.core.cache_writer.write_all()
        await component.fetch_all()
        await anyio.sleep(2 * RETRY_INTERVAL)
        with pytest.raises(CacheError, match=r"nothing was sent, .*--no-cache"):
            await apply(component, ParamSet({NAME: WrittenParam(NAME, 5.0)}))
        assert (await component.set(NAME, 5.0)).actual == 5.0
    [warning] = warnings(caplog)
    assert warning.startswith("continuing without the cache: ")
    assert "\n" not in warning


@in_simulated_time
async def test_after_very_many_changes_the_whole_table_is_written(path: Path) -> None:
    vehicle = small_px4()
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.only_component()
        await component.fetch_all()
        await anyio.sleep(2.0)
        with locked(path):
            for value in range(PENDING_MAX + 20):
                vehicle.set_param(NAME, float(value))
                await anyio.sleep(FLUSH_INTERVAL)
        await anyio.sleep(2 * RETRY_INTERVAL)
        with ParamCache(path) as cache:
            assert cache.component().params[NAME].value == vehicle.values[NAME] == PENDING_MAX + 19
            assert cache.component().complete


@UNWRITABLE
@in_simulated_time
async def test_a_client_that_ends_says_what_is_lost(
    unwritable: Holding, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with ParamClient(small_px4(), cache=path) as client:
        component = await client.only_component()
        await component.fetch_all()
        await anyio.sleep(2.0)
        key = component.identity.key
        holding = unwritable(path)
        holding.__enter__()
        await component.set(NAME, 5.0)
    try:
        [lost] = warnings(caplog)
    finally:
        holding.__exit__(None, None, None)
    assert lost.startswith(f"the last values of 1/1 ({key}) are not in the cache, and lost: ")


@in_simulated_time
async def test_a_client_that_ends_waits_for_the_cache(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A database that is restarting refuses connections for a time."""
    with ParamCache(path) as cache:
        async with ParamClient(small_px4(), cache=cache) as client:
            component = await client.only_component()
            await component.fetch_all()
            await anyio.sleep(2.0)
            await component.set(NAME, 5.0)
            monkeypatch.setattr(cache, "save", fails_at_first(cache.save))
        assert cache.component().params[NAME].value == 5.0


@in_simulated_time
async def test_nothing_is_applied_where_the_state_before_cannot_be_kept(path: Path) -> None:
    vehicle = small_px4()
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.only_component()
        await component.fetch_all()
        await anyio.sleep(2.0)
        with locked(path), pytest.raises(CacheError, match=r"nothing was sent, .*locked"):
            await apply(component, ParamSet({NAME: WrittenParam(NAME, 5.0)}))
        assert vehicle.values[NAME] != 5.0


@pytest.mark.parametrize("words", [("history", "1"), ("show", "1"), ("cache", "list")], ids=" ".join)
def test_the_command_ends_with_5_where_the_cache_cannot_be_read(
    words: tuple[str, ...], path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = in_process(capsys, "--cache", str(path))
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("PRAGMA locking_mode = EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        other.execute("UPDATE vehicle SET system = system")
        ended = command(*words)
    assert (ended.code, ended.out) == (5, "")
    assert "cannot be used: database is locked" in ended.err
    assert command(*words).code == 0
