"""Extended parameters, `component.ext`, in the calls that set up a vehicle: text, bytes, 64-bit numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from paramclient import NoReply, ParamCache, ParamSet, ParamType, UsageError, VehicleArmed
from paramclient.files import read_file
from paramclient.provision import ApplyResult, ApplyStatus, Plan, apply, plan, restore
from paramclient.provision.apply_restore import load_restore_point
from paramclient.sim import Air, Camera, PX4Vehicle
from tests.shell import a_client


def small() -> Camera:
    return Camera(
        {"MODE": 1, "NAME": "Front", "KEY": b"\xff\0\xfe", "EV": 0.5, "CLOCK": (8, 2**62 + 1)},
        limits={"MODE": (0, 5)},
        failing=["EV"],
    )


def statuses(found: Plan | ApplyResult) -> dict[str, str]:
    return {name: str(row.status) for name, row in found.rows.items()}


async def test_a_plan_names_what_cannot_be_written() -> None:
    async with a_client(camera := small()) as client:
        component = await client.component(1, 100)
        made = await plan(
            component.ext,
            {"MODE": 2, "NAME": "Front", "KEY": b"\1", "LOST": "x", "EV": "x", "CLOCK": 2**62 + 1},
        )
        assert statuses(made) == {
            "MODE": "set",
            "NAME": "unchanged",
            "KEY": "set",
            "LOST": "skipped",
            "EV": "invalid",
            "CLOCK": "unchanged",
        }
        assert camera.ext_values["MODE"] == 1
        for target, wanted, why in (
            (component.ext, ParamSet({}, component=101, is_extended=True), "101, not of component 100"),
            (
                component,
                ParamSet({"MODE": 2}, is_extended=True),
                "are extended ones, and plain ones are needed",
            ),
            (component.ext, ParamSet({"MODE": 2}), "are plain ones, and extended ones are needed"),
        ):
            with pytest.raises(UsageError, match=why):
                await apply(target, wanted)


async def test_values_are_written_verified_and_restored(tmp_path: Path) -> None:
    camera = small()
    before = camera.ext_values
    wanted: dict[str, Any] = {"MODE": 2, "NAME": "Rear", "KEY": b"\1", "CLOCK": 2**62 + 3}
    with ParamCache(tmp_path / "cache.sqlite3") as cache:
        async with a_client(camera, cache=cache) as client:
            ext = (await client.component(1, 100)).ext
            result = await apply(ext, wanted, backup=tmp_path / "before.json")
            assert set(statuses(result).values()) == {"accepted"}
            assert camera.ext_values == before | wanted
            (backup,) = read_file(tmp_path / "before.json").sets
            assert {name: param.value for name, param in backup.items()} == before
            assert set(statuses(await apply(ext, wanted)).values()) == {"unchanged"}
            await ext.set("NAME", "Top")
            await ext.core.cache_writer.write_all()
            key = ext.identity.key
            point = load_restore_point(cache, key, 100, extended=True)
            assert next(iter(point.changes)) == "NAME"
            assert (await restore(ext, point.state)).complete
            assert camera.ext_values == before
            reasons = [each.reason for each in cache.snapshots(key, 100, extended=True)]
            assert reasons == ["before apply", "before restore"]
            assert cache.snapshots(key, 100) == []
            undone = cache.state_at(key, 100, 2, extended=True)
            assert (await restore(ext, undone)).complete
            assert camera.ext_values["NAME"] == "Top"


async def test_adjusted_and_refused_values_are_reported() -> None:
    async with a_client(small()) as client:
        ext = (await client.component(1, 100)).ext
        result = await apply(ext, {"MODE": 9, "EV": 0.75, "NAME": "Rear"})
    assert statuses(result) == {"MODE": "adjusted", "EV": "refused", "NAME": "accepted"}
    assert (result.complete, result.error, result.rows["MODE"].actual) == (False, None, 5)


async def test_the_timeout_ends_the_run_with_the_rows_so_far() -> None:
    async with a_client(Camera({"A": 1, "B": 2}, slow={"B": 9.0})) as client:
        result = await apply((await client.component(1, 100)).ext, {"A": 5, "B": 6}, timeout=4.0)
    assert isinstance(result.error, NoReply)
    assert result.rows["A"].status is ApplyStatus.UNPROVEN
    assert result.rows["A"].type is ParamType.INT32
    assert not result.complete


async def test_nothing_is_set_on_the_camera_of_an_armed_vehicle_unless_allowed() -> None:
    async with a_client(Air.symmetric([PX4Vehicle(table={"A": 1}, armed=True), small()])) as client:
        await client.component(1, 1)
        ext = (await client.component(1, 100)).ext
        with pytest.raises(VehicleArmed):
            await apply(ext, {"NAME": "Rear"})
        assert (await apply(ext, {"NAME": "Rear"}, allow_armed=True)).complete
