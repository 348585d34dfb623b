"""The blocking client: a whole session, its streams, callbacks, interruption, threads and ends."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from paramclient import ParamCache, Progress, Value, errors
from paramclient.sync import Component, ParamClient, apply, for_each, plan, restore
from tests.sync_stub import STUB, meaning, stub
from tests.test_docs import run

NAME = "MC_ROLL_P"


def test_the_types_are_those_of_the_asynchronous_client() -> None:
    assert meaning(STUB.read_text(encoding="utf-8")) == meaning(stub()), "make sync"


def test_a_whole_session(tmp_path: Path) -> None:
    client = ParamClient("sim:px4", cache=tmp_path / "cache")
    events = client.events()
    with client:
        found = next(events)
        vehicle = client.only_component()
        assert found.kind == "discovered"
        assert found.component is vehicle is client.component() is client.components[1, 1]
        assert client.autopilots == client.find_autopilots(expect=1) == [vehicle]
        assert isinstance(vehicle, Component)
        progress: list[int | None] = []
        result = vehicle.fetch_all(progress=lambda each: progress.append(vehicle.count))
        assert (result.received, result.missing) == (903, ())
        assert progress[-1] == 903
        changes = vehicle.changes()
        assert vehicle.set(NAME, 6.0).actual == 6.0
        change = next(changes)
        assert change.new is not None
        assert (change.kind, change.name, change.new.value) == ("changed", NAME, 6.0)
        with pytest.raises(TimeoutError):
            changes.next(timeout=0.01)
        done = vehicle.set_many((name, 7.0) for name in [NAME] if vehicle.get(name).value == 6.0)
        assert done.is_complete
        assert [len(vehicle.params), vehicle.params[NAME].value] == [903, 7.0]
        assert sum(1 for name in vehicle.params if vehicle.params[name].value == 7.0) >= 1
        assert vehicle.silence < 5.0
        with pytest.raises(errors.UnknownParameter):
            vehicle.get("NO_SUCH_NAME")
        with pytest.raises(errors.NoReply):
            vehicle.ext.fetch_all(timeout=0.05)
        with pytest.raises(errors.FileTransferError):
            vehicle.read_file("/no/such/file")
    assert next(changes).name == NAME, "what was queued"
    with pytest.raises(errors.ClientClosed):
        changes.next(timeout=1.0)
    with pytest.raises(errors.ClientClosed):
        vehicle.get(NAME)
    assert vehicle.params[NAME].value == 7.0
    assert "closed" in repr(client)
    with ParamCache(tmp_path / "cache") as cache:
        assert cache.component().params[NAME].value == 7.0


def test_a_vehicle_is_set_up_and_restored(tmp_path: Path) -> None:
    asked: list[Value] = []
    with ParamClient("sim:px4", cache=False) as client:
        vehicle = client.only_component()
        result = apply(vehicle, {NAME: 6.5}, before_writing=lambda: asked.append(vehicle.get(NAME).value))
        assert (result.complete, asked) == (True, [4.0])
        assert plan(vehicle, {NAME: 6.5}).complete
        assert restore(vehicle, result.before).complete
        done = for_each([vehicle], lambda each: apply(each, {NAME: 6.5}, backup=tmp_path / "1.params"))
        assert done.results[1, 1].complete
        assert (tmp_path / "1.params").exists()
        failed = for_each([vehicle], lambda each: apply(each, {"NO_SUCH": 6.5}))
        assert isinstance(failed.errors[1, 1], errors.InvalidParameters)
    assert not for_each([], lambda each: plan(each, {NAME: 6.5})).results


def test_an_error_of_a_callback_ends_the_call() -> None:
    with ParamClient("sim:px4", cache=False) as client:
        vehicle = client.only_component()

        def fail(_: Progress) -> None:
            raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            vehicle.fetch_all(progress=fail)
        assert vehicle.get(NAME).value == 4.0


def test_open_and_close() -> None:
    client = ParamClient("sim:px4", cache=False)
    with pytest.raises(errors.ClientClosed, match="not open"):
        client.component()
    assert client.open() is client
    with pytest.raises(errors.UsageError, match="only once"):
        client.open()
    assert client.component().get(NAME).value == 4.0
    client.close()
    client.close()
    with pytest.raises(errors.ClientClosed):
        client.component()
    with pytest.raises(errors.UsageError, match="HTTP"):
        ParamClient("http://127.0.0.1:8765")
    with pytest.raises(errors.LinkError), ParamClient("tcp:127.0.0.1:1", cache=False):
        pass
    assert not [each for each in threading.enumerate() if each.name.startswith("paramclient")]


def test_threads_share_a_client_and_closing_ends_their_calls() -> None:
    with ParamClient("sim:px4", cache=False) as client, ThreadPoolExecutor() as threads:
        vehicle = client.only_component()
        names = [NAME, "MC_PITCH_P", "MC_YAW_P"]
        assert [each.name for each in threads.map(vehicle.get, names)] == names
        begun = threading.Event()

        def wait() -> None:
            changes = vehicle.changes()
            begun.set()
            changes.next()

        waiting = threads.submit(wait)
        begun.wait()
        client.close()
        assert isinstance(waiting.exception(), errors.ClientClosed)


@pytest.mark.parametrize(
    "call", [lambda client: client.component(timeout=None), lambda client: client.events().next()]
)
def test_ctrl_c_ends_a_call_and_the_client_goes_on(call: Callable[[ParamClient], object]) -> None:
    with ParamClient("udpin:127.0.0.1:0", cache=False) as client:
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            call(client)
        with pytest.raises(errors.NoReply):
            client.component(timeout=0.01)


def test_ctrl_c_cancels_the_calls_to_several_vehicles() -> None:
    with ParamClient("sim:px4", cache=False) as client:
        vehicle, changes = client.only_component(), client.component().changes()
        threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            for_each(
                [vehicle], lambda each: apply(each, {NAME: 6.5}, before_writing=lambda: changes.next(60.0))
            )
        assert vehicle.get(NAME).value == 4.0


PROGRAM = """
import sys, gc
from paramclient.sync import ParamClient
client = ParamClient("sim:px4", cache=sys.argv[1]).open()
vehicle = client.component()
vehicle.set("MC_ROLL_P", 6.0)
"""


@pytest.mark.parametrize("end", ["", "del client, vehicle; gc.collect()", "1 / 0"])
def test_a_program_that_does_not_close_its_client_keeps_its_values(tmp_path: Path, end: str) -> None:
    path = tmp_path / "cache"
    done = run("-c", PROGRAM + end, str(path), cwd=tmp_path)
    assert done.returncode == (1 if "/" in end else 0), done.stderr
    with ParamCache(path) as cache:
        assert cache.component().params[NAME].value == 6.0
