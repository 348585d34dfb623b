"""The client and its cache: starting from it, keeping it right, sharing it, and going on without it."""

from __future__ import annotations

import asyncio
import itertools
import math
import subprocess
import sys
from collections.abc import Collection
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import anyio
import anyio.from_thread
import anyio.lowlevel
import pytest

from paramclient import Component, Encoding, FetchResult, ParamCache, ParamClient, Trust, errors
from paramclient.client import cache_writer
from paramclient.client import component as component_module
from paramclient.model.paramset import ParamSet
from paramclient.model.values import ParamType
from paramclient.provision import apply
from paramclient.sim import Air, ArduPilotVehicle, Camera, Endpoint, PX4Vehicle, SimParam
from paramclient.wire import messages
from tests import shell
from tests.caches import read_only
from tests.client.conftest import connected, fetched, table_in
from tests.conversations.partial import Partial
from tests.conversations.virtual import losing
from tests.simulated_on_udp import flying

ODD = ("CAL_ACC0_XOFF", "PARAM_03", "PARAM_07")
"""Volatile parameters that cannot be determined from the hash alone: two are of no group that usually is."""


async def session(endpoint: Endpoint, path: Path | ParamCache, *, refresh: bool = False) -> FetchResult:
    """One session with the first autopilot: a fetch."""
    async with connected(endpoint, cache=path) as (_, component):
        return await component.fetch_all(refresh=refresh)


def kept(path: Path, system: int = 1) -> dict[str, int]:
    """The values that the cache holds."""
    return shell.bits(table_in(path, system=system).params)


def history(path: Path, name: str | None = None, **which: Any) -> list[tuple[str, Any, Any, str]]:
    """The lines of the history of the only vehicle, or of one of its parameters: before, after, author."""
    with ParamCache(path) as cache:
        [vehicle] = cache.vehicles()
        lines = cache.history(vehicle.key, name=name, **which)
        # digits below would be rounded up: no change is printed with a later time than it is kept with
        assert [line.at for line in lines] == [round(line.at, 6) for line in lines]
        return [(line.name, line.old.value, line.new and line.new.value, line.by) for line in lines]


def trusts(component: Component, names: Collection[str] | None = None) -> set[Trust]:
    return {param.trust for name, param in component.params.items() if names is None or name in names}


# Starting from it


async def test_an_unchanged_vehicle_is_not_downloaded_again(path: Path) -> None:
    vehicle = PX4Vehicle()
    volatile = {each.name for each in vehicle.entries if each.row.volatile and each.name in vehicle.params}
    assert (await session(vehicle, path)).source == "stream"
    proven_at = table_in(path).synced_at
    tap = shell.Tap(vehicle)
    async with ParamClient(Air.symmetric([tap], delay=0.1), cache=path) as client:
        await anext(client.events())
        received_at = anyio.current_time()
        component = await client.component()
        assert shell.bits(component.params) == shell.bits(vehicle.params), "from the cache, without a request"
        assert component.state == "cached"
        assert trusts(component, volatile) == {Trust.CACHED}
        result = await component.fetch_all()
        assert anyio.current_time() - received_at < 0.62, "round trips: identity, hash, values outside of it"
        assert (result.source, result.complete, result.hash) == ("cache", True, vehicle.announced_hash())
        assert shell.bits(result.params) == shell.bits(vehicle.params)
        assert trusts(component, component.params.keys() - volatile) == {Trust.VERIFIED}
        assert trusts(component, volatile) == {Trust.LIVE}
        assert repr(component) == "<Component 1/1 px4 synced 903 params from cache in 0.40 s>"
    reads = [message.param_id for message in tap.messages(messages.ParamRequestRead)]
    assert sorted(reads) == sorted([messages.HASH_CHECK, *volatile])
    assert not tap.messages(messages.ParamRequestList)
    assert kept(path) == shell.bits(vehicle.params)
    assert table_in(path).synced_at != proven_at


async def test_changes_are_on_the_disk_within_the_flush_interval_whatever_a_commit_takes(path: Path) -> None:
    """Beside a busy event loop, commits took 0.03 to 0.11 s in turn, and the first one longest."""
    loop = shell.simulated_time_loop()
    durations = itertools.chain([0.11], itertools.cycle([0.03, 0.1, 0.05, 0.11, 0.04]))
    sent: dict[float, float] = {}
    ages: list[float] = []
    with ParamCache(path) as cache:
        save = cache.save

        def slow(*args: Any, **options: Any) -> Any:
            begun_with = set(sent)
            loop.now += next(durations)
            result = save(*args, **options)
            ages.extend(loop.now - sent.pop(value) for value in begun_with)
            return result

        async with connected(shell.small_px4(), cache=cache) as (_, component):
            await component.set("PARAM_01", 1)
            with mock.patch.object(cache, "save", slow):
                for value in range(100, 300):
                    await component.set("PARAM_01", value)
                    sent[value] = loop.now
                    await anyio.sleep(0.013)
    assert len(ages) > 150
    assert max(ages) <= cache_writer.FLUSH_INTERVAL


@pytest.mark.parametrize("delay", [0.1, 1.0])
async def test_a_fetch_waits_for_the_cached_table(path: Path, delay: float) -> None:
    """The cached table is known only with the identity, which is late at a long round trip."""
    vehicle = ArduPilotVehicle()
    await session(vehicle, path)
    async with shell.a_client(Air.symmetric([vehicle], delay=delay), cache=path) as client:
        await shell.until(lambda: client.components)
        result = await client.components[1, 1].fetch_all()
        assert (result.source, result.missing) == ("cache", ())


async def test_a_change_between_two_sessions_is_a_cache_miss(path: Path) -> None:
    await session(PX4Vehicle(table=shell.VALUES), path)
    vehicle = PX4Vehicle(table={**shell.VALUES, "PARAM_01": 1000}, not_in_use=["PARAM_04"])
    async with connected(vehicle, cache=path) as (_, component):
        changes = component.changes()
        result = await component.fetch_all()
        assert (result.source, result.count, result.hash) == ("stream", 23, vehicle.announced_hash())
        assert {(await anext(changes)).name for _ in range(2)} == {"PARAM_01", "PARAM_04"}
    assert kept(path) == shell.bits(vehicle.params)
    assert sorted(history(path)) == [("PARAM_01", 1, 1000, "vehicle"), ("PARAM_04", 4, None, "vehicle")]
    assert (await session(vehicle, path)).source == "cache"


# Who it is


def is_no_command(message: messages.Message) -> bool:
    return not isinstance(message, messages.CommandLong)


@pytest.mark.parametrize("known", [False, True])
async def test_another_vehicle_takes_the_place_within_a_session(path: Path, known: bool) -> None:
    first, second = shell.small_px4(uid=0xA), shell.small_px4(uid=0xB)
    second.set_param("PARAM_01", 77)
    if known:
        await session(second, path)
    first.tick(shell.simulated_time_loop().time())
    second.reboot(shell.simulated_time_loop().time(), down=math.inf)
    async with fetched(Air([first, second]), cache=path) as (_, component):
        first.reboot(anyio.current_time(), down=math.inf)
        second.reboot(anyio.current_time(), down=10.0)
        await asyncio.sleep(10.5)
        assert component.identity.uid == f"{0xB:016x}"
        if known:
            assert shell.bits(component.params) == shell.bits(second.params)
        result = await component.fetch_all()
        assert result.source == ("cache" if known else "stream")
        assert shell.bits(result.params) == shell.bits(second.params)
        await asyncio.sleep(1.0)
    with ParamCache(path) as cache:
        for vehicle, uid in ((first, 0xA), (second, 0xB)):
            table = cache.component(f"uid:{uid:016x}")
            assert shell.bits(table.params) == shell.bits(vehicle.params)
            assert (table.hash, table.complete) == (vehicle.announced_hash(), True)
        assert not any(cache.history(each.key) for each in cache.vehicles()), "nothing was changed"


async def test_a_vehicle_that_does_not_say_who_it_is(path: Path) -> None:
    vehicle = PX4Vehicle(table=shell.VALUES)
    link = shell.Tap(vehicle, up=is_no_command)
    async with ParamClient(link, cache=path) as client:
        began = anyio.current_time()
        component = await client.component()
        assert anyio.current_time() - began < 0.01, "nothing is cached that could be waited for"
        assert (await component.fetch_all()).complete
        await asyncio.sleep(20.0)
        assert component.identity.uid is None
    assert kept(path) == shell.bits(vehicle.params), "kept under its system id and link"
    vehicle.reboot(anyio.current_time())
    async with ParamClient(link, cache=path) as client:
        began = anyio.current_time()
        component = await client.component(timeout=0.5)
        assert not component.params, "not yet"
        assert math.isclose(anyio.current_time() - began, 0.5, abs_tol=0.01)
        assert await client.component() is component
        assert 0.5 < anyio.current_time() - began < component_module.CACHE_TIMEOUT + 0.01
        assert shell.bits(component.params) == shell.bits(vehicle.params)
        assert (await component.fetch_all()).complete
    vehicle.reboot(anyio.current_time())
    async with ParamClient(link, cache=path) as client:
        waiting = asyncio.create_task(shell.outcome(client.component()))
        await asyncio.sleep(0.1)
    await shell.settled()
    assert isinstance(waiting.result(), errors.ClientClosed)


@pytest.mark.parametrize("fetched", [True, False])
async def test_an_identity_that_arrives_long_after_the_values(path: Path, fetched: bool) -> None:
    await session(PX4Vehicle(table=shell.VALUES), path)
    changed = PX4Vehicle(table={**shell.VALUES, "PARAM_01": 99}, not_in_use=["PARAM_02"])
    link = shell.Tap(changed, up=is_no_command)
    tap = shell.Tap(link)
    async with connected(tap, cache=path) as (_, component):
        if fetched:
            assert (await component.fetch_all()).complete
        else:
            await component.get("PARAM_01")
        await asyncio.sleep(10.0)
        assert component.identity.key.startswith("system:1@")
        link.up = lambda message: True
        tap.is_mute = True
        await asyncio.sleep(6.0)
        tap.is_mute = False
        await asyncio.sleep(2.0)
        assert component.identity.key.startswith("uid:")
        if fetched:
            assert trusts(component) == {Trust.LIVE}, "read again from the vehicle that is there now"
        else:
            assert component.params["PARAM_01"].value == 1, "another vehicle may have been received before"
            await component.get("PARAM_01")
    params = table_in(path, component.identity.key).params
    assert params["PARAM_01"].value == 99
    assert ("PARAM_02" in params) != fetched
    assert (await session(changed, path)).source == ("cache" if fetched else "stream")
    assert shell.bits(table_in(path, component.identity.key).params) == shell.bits(changed.params)


# Keeping it right


async def test_no_value_of_a_wrong_encoding_is_kept_where_the_heartbeat_comes_late(path: Path) -> None:
    vehicle = Partial(encoding=Encoding.C_CAST, heartbeat=messages.Heartbeat(2, 3, system_status=4))
    late = losing(6, lambda message: isinstance(message, messages.Heartbeat))
    async with shell.a_client(shell.Tap(vehicle, down=late), cache=path) as client:
        component = await client.component(1, 1)
        assert (await component.fetch_all()).params["MODE"].value == 1084227584
        await component.set("GAIN_1", 7.5)  # which is the same in both
        await asyncio.sleep(8.0)
    assert history(path) == [("GAIN_1", 0.5, 7.5, "us")]
    assert "MODE" not in table_in(path, "1").params


@pytest.mark.parametrize("volatile", [("CAL_ACC0_XOFF",), ODD], ids=["proven", "not proven"])
@pytest.mark.parametrize("fetched", [True, False])
async def test_after_our_own_set_the_next_session_hits_where_the_hash_is_computed(
    path: Path, volatile: Collection[str], fetched: bool
) -> None:
    """Where it cannot be, it may stand for more than our set: for what was not received as well."""
    vehicle = shell.small_px4(volatile=volatile)
    await session(vehicle, path)
    for name, value in (("PARAM_01", 100), ("PARAM_04", 400), ("PARAM_01", 101)):
        async with connected(vehicle, cache=path) as (_, component):
            if fetched:
                assert (await component.fetch_all()).source == "cache"
            await component.set(name, value)
        assert (await session(vehicle, path)).source == ("stream" if volatile is ODD else "cache"), name
        assert kept(path) == shell.bits(vehicle.params)
    assert history(path, "PARAM_01") == [("PARAM_01", 1, 100, "us"), ("PARAM_01", 100, 101, "us")]


async def test_a_search_takes_no_longer_for_what_was_changed_before(path: Path) -> None:
    """Somebody else changes two other values before each session: they do not move by themselves."""
    vehicle = ArduPilotVehicle(live_period=0.0)
    await session(vehicle, path)
    asked = []
    for tuned in range(1, 17, 2):
        vehicle.load({f"SERVO{tuned}_MIN": 1111, f"RC{tuned}_DZ": 33})
        tap = shell.Tap(vehicle)
        assert (await session(tap, path)).source == "cache"
        asked.append(len(tap.messages(messages.FileTransfer)))
    assert max(asked[4:]) <= max(asked[:4]), asked


async def test_every_own_write_is_in_the_history_however_briefly_it_was_valid(path: Path) -> None:
    vehicle = shell.small_px4()
    await session(vehicle, path)
    async with connected(vehicle, cache=path) as (_, component):
        before = (await component.get("PARAM_01")).value
        changes = component.changes()
        async with anyio.create_task_group() as tasks:
            for value, author in ((100, "anna"), (101, "ben"), (before, "anna"), (100, None)):
                tasks.start_soon(partial(component.set, "PARAM_01", value, author=author))
        assert (await anext(changes)).by == "us"
        vehicle.set_param("PARAM_01", 7)
        await component.get("PARAM_01")
    assert [line[1:] for line in history(path, "PARAM_01")] == [
        (before, 100, "us for anna"),
        (100, 101, "us for ben"),
        (101, before, "us for anna"),
        (before, 100, "us"),
        (100, 7, "vehicle"),
    ]


@shell.in_simulated_time
async def test_a_first_value_is_as_old_as_its_request(path: Path) -> None:
    """It may have waited for a busy program, while another one has stored a later value."""
    async with connected(Air.symmetric([shell.small_px4()], delay=1.0), cache=path) as (_, component):
        await component.fetch_all()
    cached = table_in(path)
    assert cached.synced_at is not None
    assert max(cached.heard_at.values()) < cached.synced_at - 1.9


async def test_a_write_is_in_the_history_also_where_the_cache_knew_nothing_before(path: Path) -> None:
    vehicle = shell.small_px4()
    before, vehicle_had = (vehicle.param(name).value for name in ("PARAM_01", "PARAM_02"))
    async with connected(vehicle, cache=path) as (_, component):
        await component.set("PARAM_01", 100, author="anna")
        await component.fetch_all()
        await component.set("PARAM_02", 200)
    assert history(path) == [("PARAM_01", before, 100, "us for anna"), ("PARAM_02", vehicle_had, 200, "us")]


@pytest.mark.parametrize("author", ["", "x" * 129, "a\nb", "Änne", "\x7f"])
async def test_an_author_must_be_printable_ascii(path: Path, author: str) -> None:
    async with connected(shell.small_px4(), cache=path) as (_, component):
        with pytest.raises(errors.UsageError, match="author must have 1 to 128 printable ASCII"):
            await component.set("PARAM_01", 100, author=author)
        with pytest.raises(errors.UsageError, match="author must have"):
            await apply(component, ParamSet({}), author=author)


async def test_a_change_by_another_station_is_in_the_history_with_its_address(path: Path) -> None:
    vehicle = shell.small_px4()
    radio = shell.Radio(vehicle)
    async with fetched(radio, cache=path) as (_, component):
        await asyncio.sleep(1.0)
        message = messages.ParamSet(1, 1, "PARAM_01", (55).to_bytes(4, "little"), 6)
        radio.other = [messages.encode(message, system=254, component=190, sequence=0)]
        await anext(component.changes())
        await component.set("PARAM_02", 22)
        vehicle.set_param("PARAM_04", 44)
        await asyncio.sleep(1.0)
        assert table_in(path).params["PARAM_04"].value == 44, "while the client is open"
    assert {(name, by) for name, _, _, by in history(path)} == {
        ("PARAM_01", "station 254/190"),
        ("PARAM_02", "us"),
        ("PARAM_04", "vehicle"),
    }
    assert (await session(vehicle, path)).source == "cache"


# With it, and without


async def test_a_value_announced_just_before_the_file_was_read_keeps_its_index(path: Path) -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)

    def passes(message: messages.Message) -> bool:
        if isinstance(message, messages.FileTransfer):
            vehicle.set_param("RTL_ALT", 4321)
        return True

    first = await session(Air.symmetric([shell.Tap(vehicle, up=passes)], delay=0.05), path)
    second = await session(vehicle, path)
    assert (first.source, second.source, second.params["RTL_ALT"].value) == ("ftp", "cache", 4321)


async def test_a_cache_that_was_given_stays_open(path: Path) -> None:
    with ParamCache(path) as cache:
        async with ParamClient(shell.small_px4(), cache=cache) as client:
            assert client.cache is cache
            await (await client.component()).fetch_all()
        assert len(cache.component().params) == 25
    async with ParamClient(shell.small_px4(), cache=path) as client:
        await client.component()
    assert client.cache is not None
    with pytest.raises(errors.CacheError, match="closed"):
        client.cache.components()


async def test_the_users_cache_is_used_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    async with ParamClient(shell.small_px4(), cache=False) as client:
        assert client.cache is None
        component = await client.component()
        await component.fetch_all()
        await component.set("PARAM_01", 5)
        await asyncio.sleep(1.0)
    assert not any(tmp_path.iterdir())  # noqa: ASYNC240 - an empty folder
    for cache in (None, True):
        async with ParamClient(shell.small_px4(), cache=cache) as client:
            assert client.cache is not None
            assert client.cache.path == tmp_path / "paramclient" / "parameters.sqlite3"
            assert (await (await client.component()).fetch_all()).source == ("cache" if cache else "stream")


def test_a_folder_that_can_only_be_read(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    @shell.in_simulated_time
    async def fill() -> None:
        await session(shell.small_px4(system=9), path)

    @shell.in_simulated_time
    async def use() -> None:  # in threads of its own, which have no powers of root
        async with fetched(shell.small_px4(), cache=path) as (_, component):
            await component.set("PARAM_01", 5)
            await asyncio.sleep(20.0)
            assert (await component.get("PARAM_01")).value == 5
        [warning] = [record.getMessage() for record in caplog.records]
        assert warning.startswith("continuing without the cache: ")
        assert (await session(shell.small_px4(system=9), path)).source == "cache", "what can be read is used"

    fill()
    with read_only(path.parent):
        use()


# Defaults, and whether there is a file


def said(path: Path) -> tuple[int, bool | None]:
    """How many defaults the cache knows of the first vehicle, and whether it gives its table as a file."""
    with ParamCache(path) as cache:
        params = cache.component(system=1).params.values()
        return sum(param.default is not None for param in params), cache.components()[0].file_works


async def test_defaults_are_kept_over_sessions_and_go_with_the_firmware(path: Path) -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    defaults = {name: param.default for name, param in (await session(vehicle, path)).params.items()}
    assert said(path) == (1382, True)
    async with connected(vehicle, cache=path) as (_, component):
        assert {name: param.default for name, param in component.params.items()} == defaults
        assert len(component.params.changed()) == 41
    vehicle.version = replace(vehicle.version, git_hash=b"01234567")
    async with connected(vehicle, cache=path) as (_, component):
        assert component.params.changed() == {}
        before = component.params["STAT_RUNTIME"].value
        await component.set("STAT_RUNTIME", int(before) + 5)  # something is written, and no fetch
    assert said(path) == (0, None), "those of the other firmware are not passed off as this one's"
    assert len(kept(path)) == 1382
    assert (await session(vehicle, path)).source == "cache", "the checksum proves values, not defaults"
    assert said(path) == (0, None)


@pytest.mark.parametrize("kind", ["no file", "silent", "refreshed"])
async def test_that_there_is_no_file_is_remembered_but_no_silence(path: Path, kind: str) -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    server = vehicle.file_server
    assert server is not None
    rows = server.params
    if kind == "silent":
        vehicle.file_server = None
    server.params = lambda: None
    requested = shell.Tap(vehicle)
    first = await session(requested, path)
    assert (first.source, first.complete) == ("stream", True)
    assert "Downloaded as a list" in first.notes[0]
    assert said(path)[1] is (None if kind == "silent" else False)
    assert requested.messages(messages.FileTransfer)
    requested.received.clear()
    second = await session(requested, path)
    assert second.source == "stream"
    why = "did not answer" if kind == "silent" else "no file of its parameters"
    assert [why in note for note in second.notes] == [True]
    assert bool(requested.messages(messages.FileTransfer)) == (kind == "silent")
    vehicle.file_server, server.params = server, rows
    third = await session(requested, path, refresh=kind == "refreshed")
    assert third.source == {"no file": "stream", "silent": "cache", "refreshed": "ftp"}[kind]
    vehicle.version = replace(vehicle.version, flight_sw_version=67502081)
    assert (await session(requested, path)).source == "ftp"
    assert said(path)[1] is True


PROGRAM = """
import anyio, sys
from paramclient import ParamClient

async def main(url, cache, name, *values):
    async with ParamClient(url, cache=cache) as client:
        async with anyio.create_task_group() as tasks:
            for system in (1, 2):
                tasks.start_soon(work, client, system, name, values)

async def work(client, system, name, values):
    vehicle = await client.component(system, timeout=30)
    result = await vehicle.fetch_all()
    assert result.complete, result
    for value in values:
        assert (await vehicle.set(name, int(value))).actual == int(value)
    await anyio.sleep(0.5)

anyio.run(main, *sys.argv[1:])
"""


def test_two_programs_share_vehicles_and_a_cache(tmp_path: Path) -> None:
    """Both fetch and set at once; each vehicle speaks to both, as over mavlink-router."""
    path = tmp_path / "cache.sqlite3"
    table = [SimParam(f"P_{index:03}", ParamType.INT32, index) for index in range(300)]
    vehicles = [PX4Vehicle(system=system, table=table) for system in (1, 2)]
    with flying(Air(vehicles)) as url:
        running = [
            subprocess.Popen([sys.executable, "-c", PROGRAM, url, str(path), *words])
            for words in (("P_100", "7", "8", "9"), ("P_200", "17", "18", "19"))
        ]
        assert [each.wait(60) for each in running] == [0, 0]
    with ParamCache(path) as cache:
        assert not cache.notes
        for vehicle in vehicles:
            cached = cache.component(system=vehicle.system)
            assert cached.complete
            assert shell.bits(cached.params) == shell.bits(vehicle.params)
            for name, before, after in (("P_100", 100, 9), ("P_200", 200, 19)):
                lines = cache.history(cached.key, name=name)
                steps = [(line.old.value, line.new and line.new.value) for line in lines]
                assert (steps[0][0], steps[-1][1]) == (before, after)
                assert all(one[1] == two[0] for one, two in itertools.pairwise(steps)), "nothing stands twice"


# extended parameters

TABLE: dict[str, int | float | str | bytes] = {"CAM_MODE": 1, "CAM_NAME": "Front", "CAM_ISO": 100}


def kept_of_camera(path: Path) -> dict[str, object]:
    return {each.name: each.value for each in table_in(path, component=100, extended=True).params.values()}


async def test_the_next_session_knows_extended_parameters(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    camera = Camera(TABLE)
    async with ParamClient(camera, cache=path) as client:
        ext = (await client.component(1, 100)).ext
        assert isinstance(ext, Component)
        assert (await ext.fetch_all()).complete
        assert (await ext.set("CAM_NAME", "Rear", author="anna")).actual == "Rear"
    assert kept_of_camera(path) == TABLE | {"CAM_NAME": "Rear"}
    camera.set_ext_param("CAM_ISO", 400)
    camera.remove_ext_param("CAM_MODE")
    camera.add_ext_param("CAM_GAIN", 3)
    async with ParamClient(camera, cache=path) as client:
        ext = (await client.component(1, 100)).ext
        assert {name: param.value for name, param in ext.params.items()} == TABLE | {"CAM_NAME": "Rear"}
        assert {param.trust for param in ext.params.values()} == {Trust.CACHED}
        changes = ext.changes()
        assert (await ext.fetch_all()).complete
        reported = {change.name: change.kind for change in [await anext(changes) for _ in range(3)]}
        assert reported == {"CAM_ISO": "changed", "CAM_MODE": "removed", "CAM_GAIN": "added"}
    assert kept_of_camera(path) == {"CAM_NAME": "Rear", "CAM_ISO": 400, "CAM_GAIN": 3}
    assert sorted(history(path, component=100, extended=True)) == [
        ("CAM_ISO", 100, 400, "vehicle"),
        ("CAM_MODE", 1, None, "vehicle"),
        ("CAM_NAME", "Front", "Rear", "us for anna"),
    ]


@pytest.mark.parametrize("is_first", [True, False], ids=["before its autopilot", "after its autopilot"])
async def test_a_camera_is_cached_with_its_vehicle(tmp_path: Path, is_first: bool) -> None:
    """A vehicle is its autopilot's hardware id; the camera has another one of its own."""
    path = tmp_path / "cache"
    camera, autopilot = Camera(TABLE), shell.small_px4()
    late = autopilot if is_first else camera
    for value in (200, 400):
        late.reboot(anyio.current_time(), down=math.inf)
        async with ParamClient(Air([camera, autopilot]), cache=path) as client:
            late.reboot(anyio.current_time(), down=1.0 if is_first else 5.0)
            found = await client.component(1, 100, timeout=10.0)
            await client.component(1, 1)
            await found.wait_for_cache()
            assert ("CAM_ISO" in found.ext.params) == (value == 400)
            await found.ext.fetch_all()
            await found.ext.set("CAM_ISO", value)
            assert found.identity == client.components[1, 1].identity
    with ParamCache(path) as cache:
        [vehicle] = cache.vehicles()
        assert vehicle.key == client.components[1, 1].identity.key
        assert 100 in vehicle.components
        lines = [(each.name, each.new and each.new.value) for each in cache.history("1", extended=True)]
    assert lines == [("CAM_ISO", 200), ("CAM_ISO", 400)]
