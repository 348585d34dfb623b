"""Extended parameters from a set or an earlier state: compared, written, verified, restored."""

from __future__ import annotations

from pathlib import Path

import anyio
import pytest

from paramclient import (
    CacheError,
    Component,
    NoReply,
    NotInCache,
    ParamCache,
    ParamSet,
    ParamType,
    SetStatus,
    UsageError,
    Value,
    WrittenParam,
)
from paramclient.cache import SnapshotSummary
from paramclient.files.disk import read_extended_file
from paramclient.protocol.set_results import SetOutcome
from paramclient.provision import (
    apply_extended,
    load_extended_state,
    restore_extended,
    verify_extended,
)
from paramclient.sim import Camera
from tests.shell import a_client, in_simulated_time


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cache.sqlite3"


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
    return ParamSet.of(param for name, param in other.ext_params.items() if name in values)


def snapshots(component: Component) -> list[SnapshotSummary]:
    assert component.core.cache is not None
    return component.core.cache.snapshots(component.identity.key, 100, extended=True)


async def the_camera(client: object, number: int = 100) -> Component:
    component: Component = await client.component(1, number)  # type: ignore[attr-defined]
    return component


@in_simulated_time
async def test_a_set_is_compared_and_nothing_is_written() -> None:
    camera = small()
    async with a_client(camera) as client:
        component = await the_camera(client)
        content = wanted(camera, MODE=2, NAME="Front", KEY=b"\1")
        more = {name: WrittenParam(name, "x", ParamType.CUSTOM) for name in ("LOST", "EV")}
        plan = await verify_extended(component, ParamSet({**content.params, **more}))
        assert (list(plan.changes), plan.missing, plan.mistyped) == (["MODE", "KEY"], ("LOST",), ("EV",))
        assert (plan.is_possible, plan.is_met) == (False, False)
        assert (await verify_extended(component, wanted(camera, NAME="Front"))).is_met
        assert camera.ext_values["MODE"] == 1
        with pytest.raises(UsageError, match="of component 101, and 1/100 is chosen"):
            await verify_extended(component, ParamSet({}, component=101))


@in_simulated_time
async def test_what_differs_is_written_and_read_back(tmp_path: Path, path: Path) -> None:
    camera = small()
    with ParamCache(path) as cache:
        async with a_client(camera, cache=cache) as client:
            component = await the_camera(client)
            reported: list[SetOutcome] = []
            result = await apply_extended(
                component,
                wanted(camera, MODE=2, NAME="Rear", KEY=b"\xff\0\xfe", CLOCK=2**62 + 3),
                backup=tmp_path / "before.json",
                progress=reported.append,
            )
            assert result.complete
            assert [each.name for each in result.outcomes] == ["MODE", "NAME", "CLOCK"]
            assert sorted(each.name for each in reported) == ["CLOCK", "MODE", "NAME"]
            assert camera.ext_values["CLOCK"] == 2**62 + 3
            before = read_extended_file(tmp_path / "before.json")
            assert before.params["CLOCK"].value == 2**62 + 1
            assert {name: each.value for name, each in result.before.params.items()} == {
                name: each.value for name, each in before.params.items()
            }
            [kept] = snapshots(component)
            assert (kept.id, kept.reason, kept.size, kept.complete) == (
                result.snapshot,
                "before apply",
                5,
                True,
            )
            again = await apply_extended(component, wanted(camera, MODE=2))
            assert (again.complete, again.outcomes, again.snapshot) == (True, (), None)


@in_simulated_time
async def test_adjusted_and_refused_values_are_reported(path: Path) -> None:
    camera = small()
    async with a_client(camera, cache=path) as client:
        component = await the_camera(client)
        result = await apply_extended(component, wanted(camera, MODE=9, EV=0.75, NAME="Rear"))
        assert [each.status for each in result.outcomes] == [
            SetStatus.ADJUSTED,
            SetStatus.ACCEPTED,
            SetStatus.REFUSED,
        ]
        assert (result.complete, result.different, result.error) == (False, ("MODE", "EV"), None)


@in_simulated_time
async def test_the_state_before_the_last_apply_is_restored(path: Path) -> None:
    camera = small()
    before = camera.ext_values
    async with a_client(camera, cache=path) as client:
        component = await the_camera(client)
        with pytest.raises(NotInCache, match="no snapshot from before an apply"):
            await load_extended_state(component)
        await apply_extended(component, wanted(camera, MODE=2, NAME="Rear", KEY=b"\1", CLOCK=5))
        await component.ext.set("NAME", "Top")
        state = await load_extended_state(component)
        assert {name: param.value for name, param in state.params.items()} == before
        result = await restore_extended(component, state)
        assert (result.complete, camera.ext_values) == (True, before)
        reasons = [each.reason for each in snapshots(component)]
        assert reasons == ["before apply", "before restore"]
        undone = await restore_extended(component, await load_extended_state(component, result.snapshot))
        assert (undone.complete, camera.ext_values["NAME"]) == (True, "Top")


@in_simulated_time
async def test_a_state_at_a_time_is_restored(path: Path) -> None:
    camera = small()
    with ParamCache(path) as cache:
        async with a_client(camera, cache=cache) as client:
            component = await the_camera(client)
            await component.ext.fetch_all()
            await anyio.sleep(2.0)  # until the camera is identified, and the cache has its table
            first = cache.store_snapshot("1", 100, reason="by hand", extended=True).id
            await component.ext.set("NAME", "Rear")
            [kept] = snapshots(component)
            state = await load_extended_state(component, kept.at)
            assert state.params["NAME"].value == "Front"
            assert state == await load_extended_state(component, first)
            assert (await restore_extended(component, state)).complete
            assert camera.ext_values["NAME"] == "Front"
            with pytest.raises(CacheError, match="no snapshot 99 of"):
                await load_extended_state(component, 99)
            with pytest.raises(NotInCache, match="the history begins at"):
                await load_extended_state(component, 5.0)


@in_simulated_time
async def test_a_lost_component_ends_the_run_with_the_outcomes_so_far(path: Path) -> None:
    camera = Camera({"A": 1, "B": 2}, slow={"B": 3.0})
    async with a_client(camera, cache=path) as client:
        component = await the_camera(client)
        result = await apply_extended(component, wanted(camera, A=5, B=6), timeout=1.0)
        assert [each.status for each in result.outcomes] == [SetStatus.ACCEPTED, SetStatus.UNKNOWN]
        assert isinstance(result.error, NoReply)
        assert (result.complete, result.snapshot) == (False, 1)
        assert "B" in result.different
