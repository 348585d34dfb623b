"""Extended parameters: the same class, cached, with a history."""

from __future__ import annotations

import math
from pathlib import Path

import anyio
import pytest

from paramclient import Component, ParamCache, ParamClient, Trust
from paramclient.sim import Air, Camera
from tests.shell import small_px4

TABLE: dict[str, int | float | str | bytes] = {"CAM_MODE": 1, "CAM_NAME": "Front", "CAM_ISO": 100}


def kept(path: Path) -> dict[str, object]:
    with ParamCache(path) as cache:
        [table] = cache.components(extended=True)
        params = cache.component(table.key, component=100, extended=True).params
        return {name: param.value for name, param in params.items()}


def history(path: Path) -> list[tuple[str, object, object, str]]:
    with ParamCache(path) as cache:
        [vehicle] = cache.vehicles()
        found = cache.history(vehicle.key, 100, extended=True)
        return [(each.name, each.old.value, each.new and each.new.value, each.by) for each in found]


async def test_the_next_session_knows_the_table(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    camera = Camera(TABLE)
    async with ParamClient(camera, cache=path) as client:
        ext = (await client.component(1, 100)).ext
        assert isinstance(ext, Component)
        assert (await ext.fetch_all()).complete
        assert (await ext.set("CAM_NAME", "Rear", author="anna")).actual == "Rear"
    assert kept(path) == TABLE | {"CAM_NAME": "Rear"}
    camera.set_ext_param("CAM_ISO", 400)
    camera.remove_ext_param("CAM_MODE")
    async with ParamClient(camera, cache=path) as client:
        ext = (await client.component(1, 100)).ext
        assert {name: param.value for name, param in ext.params.items()} == TABLE | {"CAM_NAME": "Rear"}
        assert {param.trust for param in ext.params.values()} == {Trust.CACHED}
        changes = ext.changes()
        assert (await ext.fetch_all()).complete
        reported = {(each.name, each.kind) for each in [await anext(changes), await anext(changes)]}
        assert reported == {("CAM_ISO", "changed"), ("CAM_MODE", "removed")}
    assert kept(path) == {"CAM_NAME": "Rear", "CAM_ISO": 400}
    assert sorted(history(path)) == [
        ("CAM_ISO", 100, 400, "vehicle"),
        ("CAM_MODE", 1, None, "vehicle"),
        ("CAM_NAME", "Front", "Rear", "us for anna"),
    ]


@pytest.mark.parametrize("is_first", [True, False], ids=["before its autopilot", "after its autopilot"])
async def test_a_camera_is_cached_with_its_vehicle(tmp_path: Path, is_first: bool) -> None:
    """A vehicle is its autopilot's hardware id; the camera has another one of its own."""
    path = tmp_path / "cache"
    camera, autopilot = Camera(TABLE), small_px4()
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
        found_lines = cache.history("1", extended=True)
    assert [(each.name, each.new and each.new.value) for each in found_lines] == [
        ("CAM_ISO", 200),
        ("CAM_ISO", 400),
    ]
