"""The state before the last `apply`: what a restore without a time writes, and when it is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient import AlreadyRestored, Component, NotInCache, ParamCache, ParamSet, WrittenParam
from paramclient.provision import apply, restore
from paramclient.provision.apply_restore import load_restore_point
from paramclient.sim import GenericVehicle
from tests.shell import a_client, in_simulated_time


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cache.sqlite3"


def wanted(**values: float) -> ParamSet:
    return ParamSet({name: WrittenParam(name, value) for name, value in values.items()})


def where(component: Component) -> tuple[str, int]:
    return component.identity.key, component.component


@in_simulated_time
async def test_the_point_has_the_state_before_the_apply_and_later_changes(path: Path) -> None:
    async with a_client(GenericVehicle({"GAIN": 1, "MODE": 2, "RATE": 3}), cache=path) as client:
        component = await client.component()
        first = await apply(component, wanted(GAIN=5))
        assert first.complete
        await component.set("RATE", 7)
    with ParamCache(path) as cache:
        point = load_restore_point(cache, *where(component))
        assert {name: each.value for name, each in point.state.items()} == {"GAIN": 1, "MODE": 2, "RATE": 3}
        assert list(point.changes) == ["RATE", "GAIN"]
        with pytest.raises(NotInCache, match="no snapshot from before an apply to uid:00"):
            load_restore_point(cache, "uid:00", 1)


@in_simulated_time
async def test_an_apply_is_not_undone_twice(path: Path) -> None:
    async with a_client(GenericVehicle({"GAIN": 1, "RATE": 3}), cache=path) as client:
        component = await client.component()
        first = await apply(component, wanted(GAIN=5))
        assert (await restore(component, first.before)).complete
        await component.set("RATE", 7)
        with ParamCache(path) as cache:
            before_apply, before_restore = cache.snapshots(*where(component))
            with pytest.raises(
                AlreadyRestored,
                match=r"a restore ran \d+ s ago, after the last apply \(\d+ s ago\); name the state to "
                r"restore: snapshot \d+ for the state before that apply, also to continue that restore; "
                r"snapshot \d+ for the state before that restore; or a time",
            ) as caught:
                load_restore_point(cache, *where(component))
            error = caught.value
            assert (error.before_apply, error.before_restore) == (before_apply.id, before_restore.id)
            assert error.restored_at == before_restore.at
            assert (await apply(component, wanted(GAIN=6))).complete
            assert load_restore_point(cache, *where(component)).state["RATE"].value == 7
