"""Extended parameters between sessions: what the cache keeps of them, and what counts again when."""

from __future__ import annotations

import logging
from pathlib import Path

import anyio
import pytest

from paramclient import ParamCache, ParamClient, Policy, Trust
from paramclient.cache import CachedExtTable
from paramclient.cache.sqlite import SqliteStore
from paramclient.errors import CacheError
from paramclient.logs.telemetry import import_log
from paramclient.protocol.events import Change
from paramclient.sim import Air, Camera, PX4Vehicle
from tests.caches import extended
from tests.shell import in_simulated_time

TABLE: dict[str, int | float | str | bytes] = {"CAM_MODE": 1, "CAM_NAME": "Front", "CAM_ISO": 100}


def kept(path: Path) -> CachedExtTable:
    with ParamCache(path) as cache:
        return extended(cache)


def history(path: Path) -> list[tuple[str, object, object, str]]:
    with ParamCache(path) as cache:
        [vehicle] = cache.vehicles()
        found = cache.ext_history(vehicle.key)
        return [(each.name, each.old.value, each.new and each.new.value, each.by) for each in found]


@in_simulated_time
async def test_the_next_session_knows_the_table(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    camera = Camera(TABLE)
    async with ParamClient(camera, cache=path) as client:
        ext = (await client.component(1, 100)).ext
        await ext.fetch_all()
        await ext.set("CAM_NAME", "Rear", author="anna")
    found = kept(path)
    assert {name: param.value for name, param in found.params.items()} == TABLE | {"CAM_NAME": "Rear"}
    assert (found.count, found.complete) == (3, True)
    assert [param.index for param in found.params.values()] == [0, 1, 2]
    camera.set_ext_param("CAM_ISO", 400)
    async with ParamClient(camera, cache=path) as client:
        component = await client.component(1, 100)
        ext = component.ext
        assert {name: param.value for name, param in ext.params.items()} == TABLE | {"CAM_NAME": "Rear"}
        assert {param.trust for param in ext.params.values()} == {Trust.CACHED}
        assert (ext.is_spoken, ext.count) == (False, None), "nothing was received on this link"
        changes = ext.changes()
        assert (await ext.get("CAM_MODE")).trust is Trust.LIVE
        result = await ext.fetch_all()
        assert result.complete
        change: Change = await anext(changes)
        assert (change.name, change.old and change.old.value) == ("CAM_ISO", 100)
        assert not component.params
    assert history(path) == [
        ("CAM_NAME", "Front", "Rear", "us for anna"),
        ("CAM_ISO", 100, 400, "vehicle"),
    ]
    assert kept(path).complete


@in_simulated_time
async def test_a_removed_parameter_leaves_the_cache(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    camera = Camera(TABLE)
    for _ in range(2):
        async with ParamClient(camera, cache=path) as client:
            await (await client.component(1, 100)).ext.fetch_all()
        if "CAM_NAME" in camera.ext_params:
            camera.remove_ext_param("CAM_NAME")
    assert list(kept(path).params) == ["CAM_MODE", "CAM_ISO"]
    assert (kept(path).count, kept(path).complete) == (2, True)
    assert history(path) == [("CAM_NAME", "Front", None, "vehicle")]


@in_simulated_time
async def test_a_part_of_a_table_does_not_make_it_partial(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    camera = Camera(TABLE)
    async with ParamClient(camera, cache=path) as client:
        await (await client.component(1, 100)).ext.fetch_all()
    async with ParamClient(camera, cache=path) as client:
        await (await client.component(1, 100)).ext.get("CAM_MODE")
    assert (len(kept(path).params), kept(path).complete) == (3, True)


@in_simulated_time
async def test_a_policy_without_downloads_gives_the_cached_table(tmp_path: Path) -> None:
    camera = Camera(TABLE)
    async with ParamClient(camera, cache=tmp_path / "cache") as client:
        await (await client.component(1, 100)).ext.fetch_all()
    async with ParamClient(camera, cache=tmp_path / "cache", policy=Policy.CACHE_ONLY) as client:
        result = await (await client.component(1, 100)).ext.fetch_all()
        assert (result.source, len(result.params)) == ("cache", 3)


@in_simulated_time
async def test_plain_and_extended_tables_of_one_system_are_kept_apart(tmp_path: Path) -> None:
    camera = Camera(TABLE, plain={"CAM_MODE": 0.5})
    air = Air.symmetric([PX4Vehicle(table={"A": 1, "B": 2.0}), camera])
    async with ParamClient(air, cache=tmp_path / "cache") as client:
        for component in (await client.component(1, 100), await client.component()):
            await component.fetch_all()
        await (await client.component(1, 100)).ext.fetch_all()
    with ParamCache(tmp_path / "cache") as cache:
        plain = cache.component(component=100)
        assert {name: param.value for name, param in plain.params.items()} == {"CAM_MODE": 0.5}
        assert extended(cache).params["CAM_MODE"].value == 1
        assert set(cache.component().params) == {"A", "B"}
        [vehicle] = cache.vehicles()
        assert vehicle.components == (1, 100)


@in_simulated_time
async def test_values_that_could_not_be_written_are_written_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "cache"
    run = SqliteStore.run

    def fail(*_: object, **options: object) -> None:
        raise CacheError("the disk is full")

    async with ParamClient(Camera(TABLE), cache=path) as client:
        ext = (await client.component(1, 100)).ext
        await anyio.sleep(3.0)  # it is known which vehicle it is
        monkeypatch.setattr(SqliteStore, "run", fail)
        await ext.fetch_all()
        await ext.set("CAM_MODE", 2)
        assert not await (await client.component(1, 100)).core.client.cache_writer.flush()
        monkeypatch.setattr(SqliteStore, "run", run)
    assert kept(path).params["CAM_MODE"].value == 2
    assert [record.levelno for record in caplog.records if record.name.startswith("paramclient.cl")] == [
        logging.WARNING
    ]


@in_simulated_time
async def test_values_that_were_never_written_are_logged_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object, **options: object) -> None:
        raise CacheError("the disk is full")

    async with ParamClient(Camera(TABLE), cache=tmp_path / "cache") as client:
        monkeypatch.setattr(SqliteStore, "run", fail)
        await (await client.component(1, 100)).ext.fetch_all()
    [warning] = [each.message for each in caplog.records if each.levelno >= logging.WARNING]
    assert warning == "continuing without the cache: the disk is full"


@in_simulated_time
async def test_another_vehicle_gets_a_table_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    async with ParamClient(Camera(TABLE), cache=path) as client:
        await (await client.component(1, 100)).ext.fetch_all()
    async with ParamClient(Camera({"OTHER": 1}, system=2), cache=path) as client:
        component = await client.component(2, 100)
        assert not component.ext.params
        await component.ext.fetch_all()
    with ParamCache(path) as cache:
        assert list(extended(cache, cache.components("1")[0].key).params) == list(TABLE)
        assert list(extended(cache, cache.components("2")[0].key).params) == ["OTHER"]


@pytest.mark.asyncio
async def test_a_log_has_them_too(tmp_path: Path) -> None:
    log, path = tmp_path / "flight.tlog", tmp_path / "cache"
    camera = Camera(TABLE)
    async with ParamClient(camera, cache=False, tlog=log) as client:
        ext = (await client.component(1, 100)).ext
        await ext.fetch_all()
        await ext.set("CAM_MODE", 2)
    for _ in range(2):
        with ParamCache(path) as cache:
            [imported] = await import_log(log, cache)
            assert (imported.component, imported.params, imported.complete) == (100, 3, True)
    assert {name: param.value for name, param in kept(path).params.items()} == TABLE | {"CAM_MODE": 2}
    assert [line[:3] for line in history(path)] == [("CAM_MODE", 1, 2)]
    async with ParamClient(f"replay:{log}?speed=0") as client:
        component = await client.component(1, 100)
        changes = component.ext.changes()
        async for _ in changes:
            pass
        assert component.ext.params["CAM_MODE"].value == 2
