"""Blocking set-ups of vehicles: plan, apply, verify, restore, several vehicles, callbacks, Ctrl-C."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import pytest

from paramclient import ClientClosed, ExtParamSet, ParamCache, ParamSet, UsageError, WrittenParam
from paramclient.files import read_file
from paramclient.provision import ApplyProgress
from paramclient.sim import Air, Camera, PX4Vehicle
from paramclient.sync import (
    Component,
    ParamClient,
    apply,
    apply_all,
    apply_extended,
    check_vehicle,
    load_extended_state,
    metadata_of,
    prepare,
    restore,
    restore_all,
    restore_extended,
    verify,
    verify_all,
    verify_extended,
)
from tests.cable import TIMEOUT
from tests.shell import small_px4
from tests.sync.test_blocking import ctrl_c, nothing_remains

__all__ = ["nothing_remains"]


def vehicle(**options: Any) -> PX4Vehicle:
    """A PX4 vehicle that sends its list in a moment."""
    made: PX4Vehicle = small_px4(**{"burst": 50, "period": 0.001} | options)
    return made


def wanted(**values: float) -> ParamSet:
    return ParamSet({name: WrittenParam(name, value) for name, value in values.items()})


def sleep_in_callback(*_: object) -> None:
    """A callback that waits for Ctrl-C; `ctrl_c` knows it by its name."""
    time.sleep(TIMEOUT)


def test_a_set_up_from_the_plan_to_the_restore(tmp_path: Path) -> None:
    board = vehicle()
    with ParamClient(board, cache=tmp_path / "cache.sqlite3") as client:
        component = client.only_component()
        before = component.get("PARAM_01").value
        content = wanted(PARAM_01=77, PARAM_02=78)
        plan = prepare(component, content)
        assert [step.name for step in plan.steps] == ["PARAM_01", "PARAM_02"]
        assert board.params["PARAM_01"].value == before
        assert not verify(component, content).is_met

        reported: list[tuple[ApplyProgress, str]] = []
        result = apply(
            component,
            plan,
            backup=tmp_path / "before.params",
            progress=lambda state: reported.append((state, threading.current_thread().name)),
        )
        assert result.complete
        assert {name for _, name in reported} == {threading.current_thread().name}
        assert verify(component, content).is_met

        assert restore(component, read_file(tmp_path / "before.params").choose()).complete
        assert board.params["PARAM_01"].value == before


def test_before_writing_is_called_in_the_thread_of_the_caller_and_may_call_the_client() -> None:
    board = vehicle()
    with ParamClient(board, cache=False) as client:
        component = client.only_component()
        seen: list[object] = []

        def look() -> None:
            seen.append((component.get("PARAM_01").value, threading.current_thread().name))

        assert apply(component, wanted(PARAM_01=77), before_writing=look).complete
        assert seen == [(1, threading.current_thread().name)]


def test_an_exception_of_before_writing_ends_the_call_and_nothing_is_written() -> None:
    board = vehicle()

    def refuse() -> None:
        raise UsageError("not today")

    async def refuse_in_a_task() -> None:
        raise AssertionError

    with ParamClient(board, cache=False) as client:
        component = client.only_component()
        with pytest.raises(UsageError, match="not today"):
            apply(component, wanted(PARAM_01=77), before_writing=refuse)
        with pytest.raises(UsageError, match="must not be asynchronous"):
            apply(component, wanted(PARAM_01=77), before_writing=refuse_in_a_task)
        assert component.get("PARAM_01").value == 1
    assert board.params["PARAM_01"].value == 1


def test_ctrl_c_in_before_writing_ends_the_call_and_nothing_is_written() -> None:
    board = vehicle()
    with ParamClient(board, cache=False) as client:
        component = client.only_component()
        with ctrl_c():
            apply(component, wanted(PARAM_01=77), before_writing=sleep_in_callback)
        assert component.get("PARAM_01").value == 1


def test_ctrl_c_ends_a_set_up_and_the_next_one_continues() -> None:
    board = vehicle()
    content = wanted(PARAM_01=77, PARAM_02=78)
    with ParamClient(board, cache=False) as client:
        component = client.only_component()
        component.fetch_all()
        with ctrl_c():
            apply(component, content, progress=sleep_in_callback)
        assert component.get("PARAM_03").value == board.params["PARAM_03"].value
        assert apply(component, content).complete
    assert (board.params["PARAM_01"].value, board.params["PARAM_02"].value) == (77, 78)


def test_several_vehicles_with_a_set_and_a_file_for_each(tmp_path: Path) -> None:
    boards = [vehicle(), vehicle(system=2)]
    with ParamClient(Air(boards), cache=False) as client:
        both = [client.component(system=number) for number in (1, 2)]
        reported: set[Component] = set()
        requested: list[Component] = []
        main = threading.current_thread()

        def wanted_of(component: Component) -> ParamSet:
            assert threading.current_thread() is main
            return wanted(PARAM_01=70 + component.system)

        fleet = apply_all(
            both,
            wanted_of,
            backup=lambda component: tmp_path / f"{component.system}.params",
            progress=lambda component, _: reported.add(component),
            before_writing=requested.append,
        )
        assert fleet.complete
        assert reported == set(requested) == set(both)
        assert [board.params["PARAM_01"].value for board in boards] == [71, 72]
        assert sorted(path.name for path in tmp_path.iterdir()) == ["1.params", "2.params"]
        assert verify_all(both, {(1, 1): wanted(PARAM_01=71), (2, 1): wanted(PARAM_01=72)}).is_met
        with pytest.raises(UsageError, match="2/1"):
            verify_all(both, {(1, 1): wanted(PARAM_01=71)})


def test_several_vehicles_are_restored_each_to_its_own_state(tmp_path: Path) -> None:
    boards = [vehicle(), vehicle(system=2)]
    before = [board.params["PARAM_01"].value for board in boards]
    with ParamClient(Air(boards), cache=False) as client:
        both = [client.component(system=number) for number in (1, 2)]
        own = {(each.system, each.component): wanted(PARAM_01=70 + each.system) for each in both}
        applied = apply_all(both, own)
        reported: set[Component] = set()
        requested: list[Component] = []
        fleet = restore_all(
            both,
            lambda each: applied.results[each.system, each.component].before,
            backup=lambda component: tmp_path / f"{component.system}.params",
            progress=lambda component, _: reported.add(component),
            before_writing=requested.append,
        )
        assert fleet.complete
        assert reported == set(requested) == set(both)
        assert [board.params["PARAM_01"].value for board in boards] == before
        assert sorted(path.name for path in tmp_path.iterdir()) == ["1.params", "2.params"]
    assert restore_all([], {}).results == {}


def test_vehicles_of_several_clients_need_a_call_for_each() -> None:
    with ParamClient(vehicle(), cache=False) as one, ParamClient(vehicle(), cache=False) as other:
        both = [one.only_component(), other.only_component()]
        with pytest.raises(UsageError, match="belong to 2 clients"):
            apply_all(both, wanted(PARAM_01=77))
    assert apply_all([], wanted(PARAM_01=77)).results == {}
    assert verify_all([], wanted(PARAM_01=77)).results == {}


def test_extended_parameters_from_the_comparison_to_the_restore(tmp_path: Path) -> None:
    camera = Camera({"MODE": 1, "NAME": "Front"})
    target = Camera({"MODE": 2, "NAME": "Rear"}).ext_params
    with ParamCache(tmp_path / "cache.sqlite3") as cache, ParamClient(camera, cache=cache) as client:
        component = client.component(1, 100)
        content = ExtParamSet(dict(target))
        assert not verify_extended(component, content).is_met
        names: list[str] = []
        result = apply_extended(component, content, progress=lambda outcome: names.append(outcome.name))
        assert result.complete
        assert sorted(names) == ["MODE", "NAME"]
        assert restore_extended(component, load_extended_state(component)).complete
    assert camera.ext_values["MODE"] == 1


def test_metadata_and_a_check_of_a_vehicle() -> None:
    with ParamClient(vehicle(metadata=True), cache=False, traffic=True) as client:
        component = client.only_component()
        found = metadata_of(component)
        assert found is not None
        steps: list[str] = []
        report = check_vehicle(client, component, progress=steps.append)
        assert report.component == 1
        assert steps


def test_a_closed_client_is_named() -> None:
    client = ParamClient(vehicle(), cache=False)
    with client:
        component = client.only_component()
    with pytest.raises(ClientClosed, match="closed"):
        verify(component, wanted(PARAM_01=1))
