"""Extended parameters, `component.ext`, in the calls that set up a vehicle: text, bytes, 64-bit numbers."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient import (
    NoReply,
    ParamCache,
    ParamSet,
    ParamType,
    UsageError,
    Value,
    VehicleArmed,
    WrittenParam,
)
from paramclient.files import read_file
from paramclient.provision import ApplyStatus, apply, plan, restore
from paramclient.provision.apply_restore import load_restore_point
from paramclient.sim import Air, Camera, PX4Vehicle
from tests.shell import a_client, in_simulated_time


def small() -> Camera:
    return Camera(
        {"MODE": 1, "NAME": "Front", "KEY": b"\xff\0\xfe", "EV": 0.5, "CLOCK": (8, 2**62 + 1)},
        limits={"MODE": (0, 5)},
        failing=["EV"],
    )


def wanted(camera: Camera, **values: Value) -> ParamSet:
    """The set of a camera with some values changed."""
    other = Camera({name: (param.type, param.value) for name, param in camera.ext_params.items()})
    for name, value in values.items():
        other.set_ext_param(name, value)
    return ParamSet({name: other.ext_params[name] for name in values}, is_extended=True)


@in_simulated_time
async def test_a_plan_names_what_cannot_be_written() -> None:
    camera = small()
    async with a_client(camera) as client:
        ext = (await client.component(1, 100)).ext
        content = wanted(camera, MODE=2, NAME="Front", KEY=b"\1")
        more = {name: WrittenParam(name, "x", ParamType.CUSTOM) for name in ("LOST", "EV")}
        made = await plan(ext, ParamSet({**content.params, **more}, is_extended=True))
        assert {name: row.status.value for name, row in made.rows.items()} == {
            "MODE": "set",
            "NAME": "unchanged",
            "KEY": "set",
            "LOST": "skipped",
            "EV": "invalid",
        }
        assert (await plan(ext, wanted(camera, NAME="Front", KEY=b"\xff\0\xfe"))).complete
        assert camera.ext_values["MODE"] == 1
        with pytest.raises(UsageError, match="of component 101, not of component 100"):
            await plan(ext, ParamSet({}, component=101, is_extended=True))
        with pytest.raises(UsageError, match="are extended ones, and plain ones are needed"):
            await apply(await client.component(1, 100), content)
        with pytest.raises(UsageError, match="are plain ones, and extended ones are needed"):
            await apply(ext, ParamSet(content.params))


@in_simulated_time
async def test_values_are_written_verified_and_restored(tmp_path: Path) -> None:
    camera = small()
    before = camera.ext_values
    with ParamCache(tmp_path / "cache.sqlite3") as cache:
        async with a_client(camera, cache=cache) as client:
            ext = (await client.component(1, 100)).ext
            content = wanted(camera, MODE=2, NAME="Rear", KEY=b"\1", CLOCK=2**62 + 3)
            result = await apply(ext, content, backup=tmp_path / "before.json")
            assert result.complete
            assert set(result.counts) == {ApplyStatus.ACCEPTED}
            assert camera.ext_values == before | {"MODE": 2, "NAME": "Rear", "KEY": b"\1", "CLOCK": 2**62 + 3}
            (backup,) = read_file(tmp_path / "before.json").sets
            assert {name: param.value for name, param in backup.items()} == before
            again = await apply(ext, content)
            assert set(again.counts) == {ApplyStatus.UNCHANGED}
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


@in_simulated_time
async def test_adjusted_and_refused_values_are_reported() -> None:
    camera = small()
    async with a_client(camera) as client:
        result = await apply(
            (await client.component(1, 100)).ext, wanted(camera, MODE=9, EV=0.75, NAME="Rear")
        )
        statuses = {name: row.status for name, row in result.rows.items()}
        assert statuses == {
            "MODE": ApplyStatus.ADJUSTED,
            "EV": ApplyStatus.REFUSED,
            "NAME": ApplyStatus.ACCEPTED,
        }
        assert (result.complete, result.error, result.rows["MODE"].actual) == (False, None, 5)


@in_simulated_time
async def test_the_timeout_ends_the_run_with_the_rows_so_far() -> None:
    camera = Camera({"A": 1, "B": 2}, slow={"B": 9.0})
    async with a_client(camera) as client:
        ext = (await client.component(1, 100)).ext
        result = await apply(ext, wanted(camera, A=5, B=6), timeout=4.0)
        assert isinstance(result.error, NoReply)
        assert result.rows["A"].status is ApplyStatus.UNPROVEN
        assert not result.complete


@in_simulated_time
async def test_nothing_is_set_on_the_camera_of_an_armed_vehicle_unless_allowed() -> None:
    camera = small()
    async with a_client(Air.symmetric([PX4Vehicle(table={"A": 1}, armed=True), camera])) as client:
        await client.component(1, 1)
        ext = (await client.component(1, 100)).ext
        with pytest.raises(VehicleArmed):
            await apply(ext, wanted(camera, NAME="Rear"))
        assert (await apply(ext, wanted(camera, NAME="Rear"), allow_armed=True)).complete
