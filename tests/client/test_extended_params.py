"""Extended parameters through the client: calls, deadlines, changes, policies."""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import closing
from pathlib import Path
from unittest import mock

import anyio
import pytest
from paramclient.model.ext_params import ExtParamType, ExtSettable

from paramclient import (
    CacheError,
    LinkError,
    NoReply,
    NotDurable,
    ParamCache,
    Policy,
    Progress,
    SetStatus,
    UnknownParameter,
    UsageError,
)
from paramclient.errors import SetFailed, ValueUnsupported
from paramclient.protocol.events import Change
from paramclient.protocol.set_results import SetOutcome
from paramclient.sim import Air, Camera, PX4Vehicle
from tests import shell
from tests.caches import extended
from tests.shell import a_client, in_simulated_time, settled

MANY = {f"PARAM_{number:03}": number for number in range(120)}


@in_simulated_time
async def test_the_calls_of_a_camera() -> None:
    camera = Camera()
    async with a_client(camera) as client:
        component = await client.component(1, 100)
        ext = component.ext
        assert (ext.is_expected, ext.is_spoken, ext.count, ext.is_complete) == (True, False, None, False)
        result = await ext.fetch_all()
        assert result.complete
        assert dict(result.params) == camera.ext_params == dict(ext.params)
        assert (ext.is_spoken, ext.count, ext.is_complete) == (True, 16, True)
        assert repr(ext) == "<ExtParams 1/100 16 extended params>"
        assert (await ext.get("CAM_NAME")).value == "Front camera"
        assert (await ext.get(0)).name == "CAM_MODE"
        done = await ext.set("CAM_CLOCK", 2**62 + 1)
        assert (done.actual, camera.ext_values["CAM_CLOCK"]) == (2**62 + 1, 2**62 + 1)
        assert ext.params["CAM_CLOCK"].type is ExtParamType.INT64
        assert not component.params, "the plain table is apart"
        with pytest.raises(TypeError):
            ext.params["A"] = done.param  # type: ignore[index]


@in_simulated_time
async def test_a_vehicle_with_a_camera_on_one_link_that_loses_packets() -> None:
    camera = Camera(MANY, slow={"PARAM_001": 2.0})
    air = Air.symmetric([PX4Vehicle(table={"A": 1, "B": 2.0}), camera], loss=0.1, delay=0.03, seed=3)
    async with a_client(air) as client:
        vehicle = await client.component()
        component = await client.component(1, 100)
        plain, extended = await asyncio.gather(vehicle.fetch_all(), component.ext.fetch_all())
        assert plain.complete
        assert extended.complete
        result = await component.ext.set_many({name: value + 1 for name, value in MANY.items()})
        assert result.is_complete
        assert camera.ext_values == {name: value + 1 for name, value in MANY.items()}
        assert not vehicle.ext.params
        assert not shell.machine_of(component).is_busy


@in_simulated_time
async def test_outcomes_of_many_values() -> None:
    camera = Camera(
        {"A": 1, "B": 2, "C": 3, "D": "text"},
        supported={"A": [1, 2]},
        failing=["B"],
        limits={"C": (0, 5)},
    )
    seen: list[SetOutcome] = []
    async with a_client(camera) as client:
        ext = (await client.component(1, 100)).ext
        await ext.fetch_all()
        pairs: list[tuple[str, ExtSettable]] = [
            ("A", 9),
            ("B", 1),
            ("C", 9),
            ("D", 5),
            ("NO_SUCH", 1),
            ("D", "one"),
            ("D", "two"),
        ]
        result = await ext.set_many(pairs, progress=seen.append)
        assert [each.status for each in result.outcomes] == [
            *("refused", "refused", "adjusted", "refused", "refused", "accepted", "accepted"),
        ]
        errors = [type(each.error) for each in result.outcomes]
        assert errors == [
            *(ValueUnsupported, SetFailed, type(None), UsageError, UnknownParameter, type(None), type(None))
        ]
        assert result["D"].requested == "two"
        assert result["D"].result is not None
        assert result["D"].result.actual == camera.ext_values["D"] == "two"
        assert str(result["C"]) == "C = 5 (adjusted from 9)"
        assert "value unsupported" in str(result["A"])
        assert result.counts[SetStatus.REFUSED] == 4
        assert not result.is_complete
        assert repr(result).startswith("<ExtSetManyResult 1/100 4 refused, 1 adjusted, 2 accepted in ")
        assert sorted(map(str, seen)) == sorted(map(str, result.outcomes))
        with pytest.raises(KeyError):
            result["E"]


@in_simulated_time
async def test_timeouts() -> None:
    camera = Camera(MANY, slow={"PARAM_001": 100.0})
    async with a_client(camera) as client:
        component = await client.component(1, 100)
        ext = component.ext
        partial = await ext.fetch_all(timeout=0.1)
        assert 0 < len(partial.params) < 120
        assert not partial.complete
        assert partial.notes == ("The fetch of extended parameters ended at its timeout.",)
        with pytest.raises(NoReply, match="PARAM_EXT_SET PARAM_001 to 1/100"):
            await ext.set("PARAM_001", 7, timeout=1.0)
        result = await ext.set_many({"PARAM_001": 7, "PARAM_002": 7}, timeout=1.0)
        assert [each.status for each in result.outcomes] == ["unknown", "accepted"]
        assert isinstance(result.error, NoReply)
        assert not shell.machine_of(component).is_busy
    async with a_client(Camera({})) as client:
        component = await client.component(1, 100)
        with pytest.raises(NoReply, match="extended parameters of 1/100"):
            await component.ext.fetch_all(timeout=1.0)
        with pytest.raises(NoReply, match="after 6 tries"):
            await component.ext.fetch_all()
        assert not shell.machine_of(component).is_busy


@in_simulated_time
async def test_progress() -> None:
    seen: list[Progress] = []
    async with a_client(Camera(MANY, burst=1, period=0.02)) as client:
        ext = (await client.component(1, 100)).ext
        await ext.fetch_all(progress=seen.append)
    assert len(seen) > 10
    assert [each.received for each in seen] == sorted(each.received for each in seen)
    assert seen[-1].total == 120


@in_simulated_time
async def test_changes() -> None:
    camera = Camera({"A": 1, "B": "text"})
    async with a_client(camera) as client:
        component = await client.component(1, 100)
        changes = component.ext.changes()
        plain = component.changes()
        await component.ext.fetch_all()
        await component.ext.set("A", 2)
        await component.ext.set("B", "other")
        await component.ext.set("B", "third")
        found: list[Change] = [await anext(changes), await anext(changes)]
        assert [(each.name, each.old, each.new and each.new.value, each.by) for each in found] == [
            ("A", None, 2, "us"),
            ("B", None, "third", "us"),
        ]
        with anyio.move_on_after(1.0) as scope:
            await anext(changes)
        assert scope.cancelled_caught
        with anyio.move_on_after(0.1) as scope:
            await anext(plain)
        assert scope.cancelled_caught, "plain streams have plain changes"
    with pytest.raises(LinkError):
        await anext(changes)


@in_simulated_time
async def test_a_change_on_behalf_of_another() -> None:
    async with a_client(Camera({"A": 1})) as client:
        ext = (await client.component(1, 100)).ext
        changes = ext.changes()
        await ext.set("A", 2, author="anna")
        assert (await anext(changes)).by == "us for anna"


@in_simulated_time
async def test_a_parameter_that_the_component_has_anew_is_added() -> None:
    camera = Camera({"A": 1, "B": 2})
    async with a_client(camera) as client:
        ext = (await client.component(1, 100)).ext
        camera.remove_ext_param("B")
        changes = ext.changes()
        await ext.fetch_all()
        first = await anext(changes)
        assert (first.name, first.new and first.new.index, first.is_added) == ("A", 0, False)
        camera.add_ext_param("C", "text")
        assert set((await ext.fetch_all()).params) == {"A", "C"}
        second = await anext(changes)
        assert (second.name, second.new and second.new.index, second.is_added) == ("C", 1, True)


@in_simulated_time
async def test_a_cancelled_call_leaves_nothing_behind() -> None:
    async with a_client(Camera(MANY, slow={"PARAM_001": 100.0})) as client:
        component = await client.component(1, 100)
        ext = component.ext
        for call in (
            lambda: ext.fetch_all(),
            lambda: ext.get("NO_SUCH"),
            lambda: ext.set("PARAM_001", 7),
            lambda: ext.set_many({"PARAM_001": 8, "PARAM_002": 9}),
        ):
            with anyio.move_on_after(0.05) as scope:
                await call()
            assert scope.cancelled_caught
            await settled()
            assert not shell.machine_of(component).ext.is_busy
            assert len(shell.machine_of(component).ext.batches) == 0


@in_simulated_time
async def test_arguments_that_are_rejected() -> None:
    async with a_client(Camera()) as client:
        ext = (await client.component(1, 100)).ext
        with pytest.raises(UsageError, match="129 bytes"):
            await ext.set("CAM_NAME", "x" * 129)
        with pytest.raises(UsageError, match="parameter name"):
            await ext.set("", 1)
        with pytest.raises(UsageError, match="parameter index -1"):
            await ext.get(-1)
        with pytest.raises(UsageError, match="not NoneType"):
            await ext.set_many({"CAM_MODE": None})  # type: ignore[arg-type]
        with pytest.raises(UsageError, match="author"):
            await ext.set("CAM_MODE", 1, author="")


@in_simulated_time
async def test_policies_that_allow_no_download() -> None:
    async with a_client(Camera(), policy=Policy.CACHE_ONLY) as client:
        ext = (await client.component(1, 100)).ext
        with pytest.raises(CacheError, match="the policy is cache-only"):
            await ext.fetch_all()
        await ext.get("CAM_MODE")
        result = await ext.fetch_all()
        assert (list(result.params), result.source) == (["CAM_MODE"], "cache")


@in_simulated_time
async def test_a_client_that_only_listens() -> None:
    async with a_client(Camera(), listen_only=True) as client:
        ext = (await client.component(1, 100)).ext
        with pytest.raises(UsageError, match="only listens"):
            await ext.fetch_all()
        with pytest.raises(UsageError, match="only listens"):
            await ext.set("CAM_MODE", 1)


@in_simulated_time
async def test_a_closed_client() -> None:
    async with a_client(Camera()) as client:
        ext = (await client.component(1, 100)).ext
    for call in (ext.fetch_all(), ext.get("CAM_MODE"), ext.set("CAM_MODE", 1), ext.set_many({"CAM_MODE": 1})):
        with pytest.raises(LinkError):
            await call
    with pytest.raises(LinkError):
        await anext(ext.changes())


@pytest.mark.asyncio
async def test_the_link_of_a_camera_with_loss() -> None:
    async with a_client("sim:camera?loss=0.2&delay=0.01&seed=5") as client:
        component = await client.component(1, 100)
        assert (await component.ext.fetch_all()).complete
        assert (await component.ext.set("CAM_NAME", "Rear")).actual == "Rear"


@in_simulated_time
async def test_a_durable_set_is_on_the_disk_with_its_line_when_it_returns(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    async with a_client(Camera({"A": 1, "B": "text"}), cache=path) as client:
        ext = (await client.component(1, 100)).ext
        for number, value in enumerate((5, 6, 6)):  # at once, with the component hardly known
            assert (await ext.set("A", value, durable=True)).actual == value
            with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as other:
                lines = other.execute("SELECT count(*) FROM history").fetchone()
                assert lines == (min(number + 1, 2),)
        result = await ext.set_many([("A", 7), ("B", b"\xff")], durable=True)
        assert result.is_complete
        with ParamCache(path) as cache:
            assert {name: each.value for name, each in extended(cache).params.items()} == {
                "A": 7,
                "B": b"\xff",
            }


@in_simulated_time
async def test_without_a_disk_nothing_is_sent_or_it_is_said_what_the_component_has(tmp_path: Path) -> None:
    camera = Camera({"A": 1, "B": 2, "C": 3}, supported={"C": [3]})
    async with a_client(camera) as client:
        ext = (await client.component(1, 100)).ext
        for call in (ext.set("A", 5, durable=True), ext.set_many({"A": 5}, durable=True)):
            with pytest.raises(UsageError, match="durable needs a cache"):
                await call
    assert camera.requests["PARAM_EXT_SET"] == 0
    with ParamCache(tmp_path / "cache") as cache:
        async with a_client(camera, cache=cache) as client:
            ext = (await client.component(1, 100)).ext
            await ext.fetch_all()
            with mock.patch.object(cache, "save", side_effect=CacheError("no room")):
                with pytest.raises(NotDurable, match="1/100 has accepted A, but it is not on the disk"):
                    await ext.set("A", 5, durable=True)
                assert camera.ext_values["A"] == ext.params["A"].value == 5
                result = await ext.set_many({"A": 6, "B": 6, "C": 6}, durable=True)
            assert [each.status for each in result.outcomes] == ["accepted", "accepted", "refused"]
            errors = [type(each.error) for each in result.outcomes]
            assert errors == [NotDurable, NotDurable, ValueUnsupported]
            assert isinstance(result.error, NotDurable)
            assert "has accepted 2 values, but they are not on the disk" in str(result.error)
            await ext.set("A", 7, durable=True)
            assert extended(cache).params["A"].value == 7
