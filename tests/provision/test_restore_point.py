"""The state before the last `apply`: what a restore without a time writes, and when it is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient import AlreadyRestored, NotInCache, ParamCache
from paramclient.provision import apply, restore
from paramclient.provision.apply_restore import load_restore_point
from paramclient.sim import GenericVehicle
from tests.shell import a_client


async def test_the_point_is_the_state_before_an_apply_that_was_not_restored(tmp_path: Path) -> None:
    path = tmp_path / "cache.sqlite3"
    async with a_client(GenericVehicle({"GAIN": 1, "MODE": 2, "RATE": 3}), cache=path) as client:
        component = await client.component()
        first = await apply(component, {"GAIN": 5})
        await component.set("RATE", 7)
        await component.core.cache_writer.write_all()
        where = component.identity.key, component.component
        with ParamCache(path) as cache:
            point = load_restore_point(cache, *where)
            assert {name: each.value for name, each in point.state.items()} == {
                "GAIN": 1,
                "MODE": 2,
                "RATE": 3,
            }
            assert list(point.changes) == ["RATE", "GAIN"]
            with pytest.raises(NotInCache, match="no snapshot from before an apply to uid:00"):
                load_restore_point(cache, "uid:00", 1)
            assert (await restore(component, first.before)).complete
            before_apply, before_restore = cache.snapshots(*where)
            with pytest.raises(
                AlreadyRestored, match=r"a restore ran \d+ s ago, after the last apply"
            ) as caught:
                load_restore_point(cache, *where)
            error = caught.value
            assert (error.before_apply, error.before_restore) == (before_apply.id, before_restore.id)
            assert error.restored_at == before_restore.at
            assert (await apply(component, {"GAIN": 6})).complete
            assert load_restore_point(cache, *where).state["RATE"].value == 3
