"""What is acknowledged as durable is on the disk, and what is not is said."""

from __future__ import annotations

import platform
import sqlite3
from contextlib import closing
from pathlib import Path
from unittest import mock

import anyio
import pytest

from paramclient import CacheError, NotDurable, ParamCache, ParamClient, UsageError
from paramclient.cache.sqlite_file import Database
from paramclient.client.client import local_client
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.provision import apply
from tests.caches import CACHE_ALONE, start, whole_table
from tests.commands import behind, in_process, leaping
from tests.service_hub import C, met, problem, service
from tests.shell import in_simulated_time, small_px4

NAME = "PARAM_01"

WITHOUT_FSYNC = f"""{CACHE_ALONE}
import ctypes, errno, pathlib, struct
numbers = {{"x86_64": (74, 75), "aarch64": (82, 83)}}[{platform.machine()!r}]
path = pathlib.Path(sys.argv[1])
from paramclient.cache.records import TableUpdate
from paramclient.model.identity import Identity

def write(at):
    cache.save(TableUpdate(identity=Identity(1, "x"), component=1, autopilot=0, at=at))

cache = ParamCache(path)
write(1e9)
libc = ctypes.CDLL(None, use_errno=True)
rules = [(0x20, 0, 0, 0), (0x15, 1, 0, numbers[0]), (0x15, 0, 1, numbers[1]), (0x06, 0, 0, 0x00050005),
         (0x06, 0, 0, 0x7FFF0000)]  # load the number of the call; fsync, fdatasync: EIO; else allow
code = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *rule) for rule in rules))
program = struct.pack("@HP", len(rules), ctypes.addressof(code))
assert libc.prctl(38, 1, 0, 0, 0) == 0  # PR_SET_NO_NEW_PRIVS
assert libc.prctl(22, 2, program) == 0  # PR_SET_SECCOMP, SECCOMP_MODE_FILTER
write(2e9)
print("written")
try:
    cache.sync()
    print("synchronised")
except Exception as error:
    print(type(error).__name__, error)
"""
"""Writes to a cache where the system refuses to synchronise any file."""


@pytest.mark.skipif(platform.machine() not in ("x86_64", "aarch64"), reason="the numbers of calls are others")
def test_only_a_durable_write_waits_for_the_disk(tmp_path: Path) -> None:
    with start(WITHOUT_FSYNC, tmp_path / "cache") as program:
        said = program.communicate()[0].splitlines()
    assert said[0] == "written"
    assert said[1].startswith("CacheError")
    assert said[1].endswith("disk I/O error")


def test_sync_writes_everything_and_later_writes_are_not_synced(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    with ParamCache(path) as cache:
        cache.sync()  # also where there is nothing yet
        cache.save(whole_table(3))
        before = path.with_name("cache-wal").stat().st_size
        cache.sync()
        assert path.with_name("cache-wal").stat().st_size > before, "there was something to synchronise"
    file = Database(path)
    levels = []
    for durable in (True, False):
        file.write(lambda _: None, durable=durable)
        file.read(lambda each: levels.append(each.execute("PRAGMA synchronous").fetchone()))
    file.write(lambda each: levels.append(each.execute("PRAGMA synchronous").fetchone()), durable=True)
    file.close()
    assert levels == [(1,), (1,), (2,)]


@in_simulated_time
async def test_a_durable_set_is_on_the_disk_with_its_line_when_it_returns(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    async with ParamClient(small_px4(), cache=path) as client:
        component = await client.only_component()
        for number, value in enumerate((5.0, 6.0, 6.0)):  # at once, with the vehicle hardly known
            assert (await component.set(NAME, value, durable=True)).status == "accepted"
            with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as other:
                assert other.execute("SELECT count(*) FROM history").fetchone() == (min(number + 1, 2),)
            with ParamCache(path) as cache:
                assert cache.component().params[NAME].value == value


@in_simulated_time
async def test_durable_sets_at_the_same_time_share_the_work(tmp_path: Path) -> None:
    with ParamCache(tmp_path / "cache") as cache:
        async with ParamClient(small_px4(), cache=cache) as client:
            component = await client.only_component()
            await component.fetch_all()
            with mock.patch.object(cache, "sync", side_effect=cache.sync) as sync:
                async with anyio.create_task_group() as tasks:
                    for number in range(10, 20):
                        tasks.start_soon(lambda name: component.set(name, 7, durable=True), f"PARAM_{number}")
                assert 1 <= sync.call_count <= 5
            values = cache.component().params
            assert {values[f"PARAM_{number}"].value for number in range(10, 20)} == {7}


@in_simulated_time
async def test_without_a_disk_nothing_is_sent_or_it_is_said_what_the_vehicle_has(tmp_path: Path) -> None:
    vehicle = small_px4()
    async with ParamClient(vehicle, cache=False) as client:
        component = await client.only_component()
        with pytest.raises(UsageError, match="durable needs a cache"):
            await component.set(NAME, 5.0, durable=True)
        with pytest.raises(UsageError, match="durable needs a cache"):
            await apply(component, ParamSet({NAME: WrittenParam(NAME, 5.0)}), durable=True)
    assert vehicle.values[NAME] != 5.0
    with ParamCache(tmp_path / "cache") as cache:
        async with ParamClient(vehicle, cache=cache) as client:
            component = await client.only_component()
            await component.fetch_all()
            for broken in ("save", "sync"):
                with mock.patch.object(cache, broken, side_effect=CacheError("no room")):
                    reported = (
                        f"1/1 has accepted {NAME}, but it is not on the disk: it could not be written: no"
                    )
                    with pytest.raises(NotDurable, match=reported):
                        await component.set(NAME, 6.0 + len(broken), durable=True)
                    assert vehicle.values[NAME] == component.params[NAME].value == 10.0
            await component.set(NAME, 11.0, durable=True)
            assert cache.component().params[NAME].value == 11.0
            with (
                mock.patch.object(local_client(client).cache_writer, "_is_doubted", return_value=True),
                pytest.raises(CacheError, match="nothing was set: it is not known which vehicle 1/1 is"),
            ):
                await component.set(NAME, 12.0, durable=True)
            assert vehicle.values[NAME] == 11.0


@in_simulated_time
async def test_a_durable_apply_ends_on_the_disk(tmp_path: Path) -> None:
    with ParamCache(tmp_path / "cache") as cache:
        async with ParamClient(vehicle := small_px4(), cache=cache) as client:
            component = await client.only_component()
            wanted = ParamSet({NAME: WrittenParam(NAME, 5.0)})
            with mock.patch.object(cache, "sync", side_effect=cache.sync) as sync:
                assert (await apply(component, wanted, durable=True)).complete
                assert sync.call_count == 1
            wanted = ParamSet({NAME: WrittenParam(NAME, 6.0)})
            with mock.patch.object(cache, "sync", side_effect=CacheError("no room")):
                result = await apply(component, wanted, durable=True)
            assert isinstance(result.error, CacheError)
            assert vehicle.values[NAME] == 6.0


@in_simulated_time
async def test_the_service_answers_when_it_is_on_the_disk(tmp_path: Path) -> None:
    with ParamCache(tmp_path / "cache") as cache:
        async with service(small_px4(), cache=cache) as (_, browser):
            await met(browser)
            body = {"value": 5.0, "durable": True}
            with mock.patch.object(cache, "sync", side_effect=cache.sync) as sync:
                assert (await browser.put(f"{C}/params/{NAME}", json=body)).status_code == 200
                assert sync.call_count == 1
            with mock.patch.object(cache, "sync", side_effect=CacheError("no room")):
                reported = problem(await browser.put(f"{C}/params/{NAME}", json=body), 503, "not-durable")
                assert "has accepted PARAM_01, but it is not on the disk" in reported["detail"]
                assert reported["error"] == "NotDurable"


def test_the_command_says_what_is_not_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    leaping(monkeypatch)
    command, put = in_process(capsys), behind(monkeypatch, "sim:px4")
    vehicle = small_px4()
    words = ("set", put(vehicle), NAME, "5", "--durable")
    assert command(*words, "--cache", tmp_path / "cache").code == 0
    assert command(*words, "--no-cache").code == 2
    with mock.patch.object(ParamCache, "sync", side_effect=CacheError("no room")):
        ended = command("set", put(vehicle), NAME, "6", "--durable", "--cache", tmp_path / "cache")
    assert (ended.code, ended.rows[1]) == (5, [NAME, "6", "6", "accepted"])
    assert "1/1 has accepted PARAM_01, but it is not on the disk" in ended.err
    file = tmp_path / "quad.parm"
    file.write_text(f"{NAME} 7\n")
    applied = command("apply", put(vehicle), file, "--durable", "--yes", "--cache", tmp_path / "cache")
    assert applied.code == 0, applied.err
