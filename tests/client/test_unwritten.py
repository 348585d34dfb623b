"""A cache that cannot be written, or read: no confident answer from it, and nothing lost unsaid."""

from __future__ import annotations

import json
import logging
import re
import signal
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial
from pathlib import Path

import anyio
import pytest

from paramclient import CacheError, Component, ParamCache, ParamClient
from paramclient.cache import sqlite_file
from paramclient.client.cache_writer import CACHE_FLUSH_INTERVAL, RETRY_INTERVAL
from paramclient.client.client import local_client
from paramclient.client.local import local
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.provision import apply
from paramclient.sim import PX4Vehicle
from tests.caches import full_disk, whole_table
from tests.commands import in_process
from tests.service.test_process import ended, served
from tests.service_hub import C, met, problem, service
from tests.shell import in_simulated_time, small_px4, until

NAME = "PARAM_01"


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite_file, "LOCK_WAIT_MAX", 0.05)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cache.sqlite3"


@contextmanager
def locked(path: Path, how: str = "IMMEDIATE") -> Iterator[None]:
    """Another program holds the file: to write (IMMEDIATE), or for itself alone (EXCLUSIVE)."""
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        if how == "EXCLUSIVE":
            other.execute("PRAGMA locking_mode = EXCLUSIVE")
        other.execute(f"BEGIN {how}")
        other.execute("UPDATE vehicle SET system = system")
        yield


@contextmanager
def full(path: Path) -> Iterator[None]:
    """The disk of the file has no room."""
    with full_disk(100):
        yield


def is_received(component: Component, value: float) -> bool:
    return component.params[NAME].value == value


async def written(client: ParamClient, component: Component) -> None:
    """Wait until all that was received from a component is in the cache."""
    await until(lambda: local_client(client).cache_writer.obstacle(local(component).machine) is None)
    await local_client(client).cache_writer.write_all()


Holding = Callable[[Path], AbstractContextManager[None]]
UNWRITABLE = pytest.mark.parametrize("unwritable", [locked, full], ids=["locked", "full"])
ANSWERS = (
    ("GET", f"{C}/history", ""),
    ("GET", f"{C}/snapshots", ""),
    ("POST", f"{C}/snapshots", '{"reason": "test"}'),
    ("GET", f"{C}/state?at=NOW", ""),
    ("GET", f"{C}/file?format=json&from=NOW", ""),
    ("POST", f"{C}/diff", '{"wanted": {"at": NOW}}'),
    ("POST", f"{C}/restore", '{"at": NOW, "dry_run": true}'),
    ("GET", "/api/v1/vehicles", ""),
    ("GET", "/api/v1/vehicles/KEY/1/history", ""),
    ("GET", "/api/v1/vehicles/KEY/1/params", ""),
    ("POST", "/api/v1/fleet/diff", f'{{"names": ["{NAME}"]}}'),
)


@UNWRITABLE
@in_simulated_time
async def test_the_service_answers_nothing_from_a_cache_that_lacks_received_values(
    unwritable: Holding, path: Path
) -> None:
    vehicle = small_px4()
    async with service(vehicle, cache=path, fetches=True) as (hub, browser):
        await met(browser)
        await until(lambda: hub.followed[0].component.sync_state == "synced")
        assert (await browser.get(f"{C}/history")).json()["history"] == []  # and all of it is written
        [known] = (await browser.get("/api/v1/vehicles")).json()["vehicles"]
        now = repr(time.time())

        async def ask() -> list[int]:
            answers = []
            for method, url, body in ANSWERS:
                where = url.replace("NOW", now).replace("KEY", known["key"])
                content = json.loads(body.replace("NOW", now)) if body else None
                answers.append(await browser.request(method, where, json=content))
            return [answer.status_code for answer in answers]

        with unwritable(path):
            vehicle.set_param(NAME, 77.0)
            await until(lambda: hub.followed[0].component.params[NAME].value == 77.0)
            answer = await browser.get(f"{C}/history")
            assert "could not be written" in problem(answer, 503, "cache-error")["detail"]
            assert await ask() == [503] * len(ANSWERS)
        lines = (await browser.get(f"{C}/history")).json()["history"]
        assert [line["new"] for line in lines] == [77.0]
        assert not [status for status in await ask() if status not in (200, 201)]


@in_simulated_time
async def test_a_cache_that_cannot_be_read_is_no_unknown_state(path: Path) -> None:
    async with service(small_px4(), cache=path, fetches=True) as (hub, browser):
        await met(browser)
        await anyio.sleep(5)
        assert hub.cache is not None
        hub.cache.close()
        problem(await browser.get(f"{C}/state?at={time.time()}"), 503, "cache-error")
        problem(await browser.get(f"{C}/history"), 503, "cache-error")


@UNWRITABLE
@in_simulated_time
async def test_values_written_late_keep_their_observation_times_and_the_whole_history(
    unwritable: Holding, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    vehicle = PX4Vehicle(table={NAME: 1.0, "PARAM_02": 2.0})
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.only_component()
        await component.fetch_all()
        await written(client, component)
        began_at = anyio.current_time()
        with unwritable(path):
            received = []
            for value in (5.0, 6.0, 7.0):
                vehicle.set_param(NAME, value)
                await until(partial(is_received, component, value))
                received.append(anyio.current_time() - began_at)
                await anyio.sleep(10)
        await anyio.sleep(2 * RETRY_INTERVAL + CACHE_FLUSH_INTERVAL)
    with ParamCache(path) as cache:
        lines = cache.history(cache.vehicles()[0].key)
    assert [(line.old.value, line.new and line.new.value) for line in lines] == [(1, 5), (5, 6), (6, 7)]
    ahead = lines[0].at - received[0]
    assert [line.at - ahead for line in lines] == pytest.approx(received, abs=0.01)
    assert [record.message for record in caplog.records if record.levelno >= logging.WARNING][1:] == []


@UNWRITABLE
@in_simulated_time
async def test_a_client_that_ends_says_what_is_lost(
    unwritable: Holding, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    vehicle = small_px4()
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.only_component()
        await component.fetch_all()
        await written(client, component)
        key = component.identity.key
        caplog.clear()
        holding = unwritable(path)
        holding.__enter__()
        await component.set(NAME, 5.0)
        await component.set(NAME, 6.0)
    try:
        [_, lost] = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    finally:
        holding.__exit__(None, None, None)
    reported = (
        rf"1/1 \({key}\): not written to the cache, and lost: 1 value and 1 earlier value, as the cache .*"
    )
    assert re.fullmatch(reported, lost), lost


@in_simulated_time
async def test_nothing_is_applied_where_the_state_before_cannot_be_kept(path: Path) -> None:
    vehicle = small_px4()
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.only_component()
        await component.fetch_all()
        await written(client, component)
        with locked(path):
            vehicle.set_param("PARAM_02", 9.0)
            await until(lambda: component.params["PARAM_02"].value == 9.0)
            with pytest.raises(CacheError, match="could not be written"):
                await apply(component, ParamSet({NAME: WrittenParam(NAME, 5.0)}))
        assert vehicle.values[NAME] != 5.0


@pytest.mark.parametrize(
    "words",
    [
        ("history", "1"),
        ("history", "1", "--snapshots"),
        ("history", "1", "--json"),
        ("show", "1"),
        ("cache", "list"),
        ("fleet", "diff", "PARAM_0"),
    ],
    ids=" ".join,
)
def test_the_command_ends_with_5_where_the_cache_cannot_be_read(
    words: tuple[str, ...], path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = in_process(capsys, "--cache", str(path))
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
    with locked(path, "EXCLUSIVE"):
        ended = command(*words)
        assert (ended.code, ended.out) == (5, "")
        assert "cannot be used: database is locked" in ended.err
    assert command(*words).code == 0


@pytest.mark.anyio
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_service_that_is_ended_says_on_stderr_what_is_lost(path: Path) -> None:
    async with served("sim:px4", "--cache", str(path)) as (process, browser):
        with anyio.fail_after(20):
            while (await browser.get("/api/v1/vehicles")).json()["vehicles"] == []:  # noqa: ASYNC110
                await anyio.sleep(0.1)
            while (await browser.get(C)).json()["sync_state"] != "synced":  # noqa: ASYNC110
                await anyio.sleep(0.1)
            await browser.get(f"{C}/history")  # now all is written
        with locked(path):
            done = await browser.patch(f"{C}/params", json={"values": {"MC_ROLL_P": 4.5}})
            assert done.status_code == 200, done.text
            begun_at = time.monotonic()
            process.send_signal(signal.SIGTERM)
            code, err = await ended(process)
            assert time.monotonic() - begun_at < 4.5  # one attempt alone waits 5 s for the lock
    assert code == 0
    assert re.search(
        r"warning: 1/1 \(uid:\w+/1\): not written to the cache, and lost: \d+ values? and", err
    ), err
    assert "Traceback" not in err


@pytest.mark.parametrize("words", [("show",), ("history", "1"), ("cache", "remove", "1")], ids=" ".join)
def test_the_command_leaves_a_file_that_is_no_cache_as_it_is(
    words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("things to do\n" * 100)
    ended = in_process(capsys, "--cache", str(notes))(*words)
    assert (ended.code, ended.out) == (5, "")
    assert "notes.txt is not a cache of paramclient (file is not a database) and was not changed" in ended.err
    assert notes.read_text() == "things to do\n" * 100
    assert [*tmp_path.iterdir()] == [notes]
