"""The client and its components: life and death, calls, time-outs, several vehicles, links, changes."""

from __future__ import annotations

import asyncio
import gc
import logging
import math
import os
import threading
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import anyio
import anyio.abc
import pytest

from paramclient import (
    Change,
    ClientClosed,
    Component,
    Encoding,
    LinkError,
    NoReply,
    ParamClient,
    ParamType,
    Progress,
    UsageError,
    ValueNotApplied,
)
from paramclient.client import link_task
from paramclient.client.client import COMPONENT_TIMEOUT
from paramclient.links import create_link, serve_endpoint
from paramclient.sim import Air, ArduPilotVehicle, Endpoint, GenericVehicle, PX4Vehicle
from paramclient.wire import frames, messages
from tests.shell import (
    VALUES,
    FlakyLink,
    Tap,
    a_client,
    bits,
    generic,
    in_simulated_time,
    outcome,
    residue,
    settled,
    simulated_time_loop,
    small_px4,
    tasks_beside,
    until,
)
from tests.simulation import is_so

Call = Callable[[ParamClient, Component], Coroutine[Any, Any, object]]

CALLS: dict[str, Call] = {
    "get": lambda client, component: component.get("PARAM_01"),
    "set": lambda client, component: component.set("PARAM_01", 77),
    "fetch_all": lambda client, component: component.fetch_all(),
    "changes": lambda client, component: changes_of(component),
    "client.component": lambda client, component: client.component(system=99, timeout=None),
    "client.fetch_all": lambda client, component: client.fetch_all(),
}
"""The public calls that wait."""


async def changes_of(component: Component, count: int = 1) -> list[Change]:
    """The next changes of a component."""
    changes = component.changes()
    return [await anext(changes) for _ in range(count)]


# Life and death


@in_simulated_time
async def test_an_exception_of_the_body_is_raised_unchanged() -> None:
    class Stop(BaseException):
        pass

    errors: list[BaseException] = [
        ValueError(),
        Stop(),
        asyncio.CancelledError(),
        ExceptionGroup("", [OSError()]),
    ]
    for error in errors:
        try:
            async with a_client(generic()) as client:
                await client.component()
                raise error
        except BaseException as caught:
            assert caught is error  # noqa: PT017 - pytest.raises would want one type for all of them
        else:
            pytest.fail("nothing was raised")
        assert not tasks_beside()


@in_simulated_time
async def test_a_time_limit_around_the_client_ends_it() -> None:
    task = asyncio.current_task()
    assert task is not None
    with pytest.raises(TimeoutError) as caught:
        async with asyncio.timeout(0.5), a_client(generic()) as client:
            await client.component(system=99)
    assert not isinstance(caught.value, NoReply)
    with anyio.move_on_after(0.5) as scope:
        async with a_client(generic()) as client:
            await client.component(system=99)
    assert scope.cancelled_caught
    assert task.cancelling() == 0
    await asyncio.sleep(1.0)
    assert not tasks_beside()


@in_simulated_time
async def test_of_two_openings_at_once_one_is_refused() -> None:
    twice = a_client(generic())
    second = asyncio.create_task(outcome(twice.__aenter__()))
    async with twice:
        assert isinstance(await second, UsageError)
        await twice.component()


def test_a_client_can_be_made_before_the_event_loop() -> None:
    client = a_client(generic())

    async def use() -> None:
        async with client:
            assert (await (await client.component()).get("PARAM_01")).value == 1

    asyncio.run(use())


@in_simulated_time
async def test_calls_on_a_client_that_is_not_open() -> None:
    client = a_client(small_px4())
    for before in (client.component(), client.fetch_all()):
        with pytest.raises(ClientClosed, match="not open"):
            await before
    async with client:
        component = await client.component()
        await component.fetch_all()
    for call in CALLS.values():
        with pytest.raises(ClientClosed, match="was closed"):
            await call(client, component)
    assert len(component.params) == 25, "what was known stays readable"
    assert not residue(component)


@in_simulated_time
async def test_closing_while_the_link_is_disconnected() -> None:
    tap = Tap(generic())
    link = FlakyLink(tap)
    async with a_client(link) as client:
        component = await client.component()
        tap.is_mute = True
        waiting = [asyncio.create_task(outcome(call(client, component))) for call in CALLS.values()]
        await settled()
        await link.drop(stays_offline=True)
        await asyncio.sleep(1.0)
        assert not any(task.done() for task in waiting)
    assert [type(await task) for task in waiting] == [ClientClosed] * len(CALLS)
    assert not tasks_beside()


def own_threads() -> list[threading.Thread]:
    """Return the threads, without the idle ones that anyio keeps for its event loop."""
    return [each for each in threading.enumerate() if "AnyIO worker" not in each.name]


@pytest.mark.asyncio
@pytest.mark.parametrize("cached", [False, True])
async def test_nothing_is_left_behind(tmp_path: Path, cached: bool) -> None:
    async with Served(small_px4(), "udpin") as served:
        before = tasks_beside(), open_files()
        threads = own_threads()
        for _ in range(2):
            url = f"udpout:127.0.0.1:{served.port}"
            async with ParamClient(url, cache=tmp_path / "cache" if cached else False) as client:
                component = await client.component()
                await component.fetch_all()
                await component.set("PARAM_01", 5)
            del client, component
            assert (tasks_beside(), open_files()) == before
            assert not set(own_threads()) - set(threads), "one of an earlier test may end meanwhile"
        gc.collect()


@pytest.mark.asyncio
async def test_the_port_is_free_again_at_once() -> None:
    async with a_client("udpin:127.0.0.1:0") as client:
        port = client.link.address[1]  # type: ignore[attr-defined]  # only sockets have one
    async with a_client(f"udpin:127.0.0.1:{port}"):
        pass
    async with a_client(f"tcpin:127.0.0.1:{port}"):
        pass


def open_files() -> int:
    return len(os.listdir("/dev/fd"))  # noqa: PTH208 - numbers, not paths


class Served:
    """A vehicle on a listening link of this kind, in a task of its own.

    Attributes:
        port: where it listens.
    """

    def __init__(self, endpoint: Endpoint, kind: str) -> None:
        self.port = 0
        self.endpoint = endpoint
        self._kind = kind

    async def __aenter__(self) -> Served:
        link: Any = create_link(f"{self._kind}:127.0.0.1:{self.port}")
        self._task = asyncio.create_task(serve_endpoint(self.endpoint, link))
        await until(lambda: link.address is not None)
        self.port = link.address[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()
        await asyncio.wait([self._task])


# On the link


@in_simulated_time
async def test_the_user_knows_better_how_values_are_laid_out() -> None:
    async with a_client(generic(), encoding=Encoding.C_CAST) as client:
        component = await client.component()
        assert component.encoding is Encoding.C_CAST
        assert component.encoding_reason == "chosen by the user"
        assert (await component.get("PARAM_01")).value == 0, "1 as the bits of a float32 is next to nothing"


@in_simulated_time
async def test_bytes_are_counted_both_ways() -> None:
    tap = Tap(generic())
    async with a_client(tap) as client:
        assert client.bytes_received == 0
        await (await client.component()).get("PARAM_01")
        assert client.bytes_sent == sum(12 + len(frame.payload) for _, frame, _ in tap.received)
        assert client.bytes_received > 2 * 21


# Finding a component


@in_simulated_time
async def test_the_first_autopilot_is_the_component() -> None:
    camera = generic(component=100, autopilot=messages.MAV_AUTOPILOT_INVALID)
    async with a_client(Air([camera, generic(system=7, component=1), generic(system=9)])) as client:
        component = await client.component()
        assert (component.system, component.component) == (7, 1)
        assert await client.component() is component
        assert await client.component(system=9) is client.components[9, 1]
        assert await client.component(component=100) is client.components[1, 100]
        assert await client.component(system=1, component=100) is client.components[1, 100]
        assert set(client.components) == {(1, 100), (7, 1), (9, 1)}
        with pytest.raises(TypeError):
            client.components[1, 1] = component  # type: ignore[index]  # that it is read-only is the point


@in_simulated_time
@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({}, "an autopilot"),
        ({"system": 3}, "an autopilot with system id 3"),
        ({"component": 100}, "component */100"),
        ({"system": 3, "component": 100}, "component 3/100"),
    ],
)
async def test_a_component_that_is_not_there(wanted: dict[str, Any], words: str) -> None:
    async with a_client(generic(component=101, autopilot=messages.MAV_AUTOPILOT_INVALID)) as client:
        with pytest.raises(NoReply) as caught:
            await client.component(**wanted, timeout=2.5)
        error = caught.value
        assert (error.awaited, error.attempts, round(error.waited, 3)) == (words, 0, 2.5)
        began = anyio.current_time()
        with pytest.raises(NoReply):
            await client.component(**wanted)
        assert round(anyio.current_time() - began, 3) == COMPONENT_TIMEOUT


# Reading and writing


@in_simulated_time
@pytest.mark.parametrize("wanted", [{"system": 300}, {"component": -1}])
async def test_an_id_that_no_component_has_is_an_error_at_once(wanted: dict[str, Any]) -> None:
    async with ParamClient("sim:px4", cache=False) as client:
        for find in (client.component, client.only_component):
            with pytest.raises(UsageError, match="ids are 0 to 255, not"):
                await find(**wanted, timeout=None)


@in_simulated_time
async def test_a_read_gives_the_value_the_vehicle_has_now() -> None:
    vehicle = small_px4()
    async with a_client(vehicle) as client:
        component = await client.component()
        assert await component.get("PARAM_03") == vehicle.param("PARAM_03")
        vehicle.set_param("PARAM_05", 1234)
        param = await component.get("PARAM_05")
        assert (param.value, param.type, param.index) == (1234, ParamType.INT32, 6)
        assert (await component.get(6)).name == "PARAM_05"
        assert component.params["PARAM_05"].value == 1234


@in_simulated_time
async def test_the_hash_can_be_read_like_a_parameter_and_is_none() -> None:
    vehicle = small_px4()
    async with a_client(vehicle) as client:
        component = await client.component()
        param = await component.get("_HASH_CHECK")
        assert (param.value, param.type, param.index) == (vehicle.announced_hash(), ParamType.UINT32, None)
        assert "_HASH_CHECK" not in component.params
        with pytest.raises(UsageError, match="_HASH_CHECK is read-only"):
            await component.set("_HASH_CHECK", 0)


@in_simulated_time
async def test_a_write_learns_the_type_first() -> None:
    tap = Tap(small_px4())
    async with a_client(tap) as client:
        component = await client.component()
        result = await component.set("PARAM_03", 2)
        assert (result.status, result.requested, result.actual, result.attempts) == ("accepted", 2, 2.0, 1)
        assert result.param == await component.get("PARAM_03")
        await component.set("PARAM_03", 3)
    assert [message.param_type for message in tap.messages(messages.ParamSet)] == [ParamType.REAL32] * 2
    assert len(tap.messages(messages.ParamRequestRead)) - len(reads_of_hash(tap)) == 2, (
        "once to learn, once to get"
    )


def reads_of_hash(tap: Tap) -> list[messages.ParamRequestRead]:
    return [each for each in tap.messages(messages.ParamRequestRead) if each.param_id == messages.HASH_CHECK]


class Retyping(GenericVehicle):
    """It calls its parameters REAL32 when they are read, and INT32 when they are written."""

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        if isinstance(message, messages.ParamSet):
            kind = ParamType.REAL32 if message.param_type == ParamType.INT32 else ParamType.INT32
            self.send(messages.ParamValue(message.param_id, message.raw, kind, 24, 1))
        else:
            super().respond(message, sender)


@in_simulated_time
async def test_a_vehicle_that_acknowledges_in_another_type_has_not_changed_the_type() -> None:
    async with a_client(Retyping(VALUES)) as client:
        component = await client.component()
        with pytest.raises(ValueNotApplied):
            await component.set("PARAM_01", 9)
        assert not residue(component)


@in_simulated_time
async def test_invalid_values_and_names_are_not_sent() -> None:
    table: dict[str, Any] = {"SMALL": (ParamType.UINT8, 1), "WHOLE": 1}
    tap = Tap(GenericVehicle(table))
    async with a_client(tap) as client:
        component = await client.component()
        await component.fetch_all()
        await settled()
        tap.received.clear()
        for name, value in [
            ("SMALL", 300),
            ("SMALL", -1),
            ("WHOLE", 1.5),
            ("WHOLE", 2**31),
            ("WHOLE", math.nan),
        ]:
            with pytest.raises(UsageError):
                await component.set(name, value)
        for bad_name in ("SEVENTEEN_LETTERS", "GRÖSSE", ""):
            with pytest.raises(UsageError):
                await component.set(bad_name, 1)
            with pytest.raises(UsageError):
                await component.get(bad_name)
        bad_value: Any
        bad_index: Any
        for bad_value in ("1", None, b"123", [1]):
            with pytest.raises(UsageError):
                await component.set("WHOLE", bad_value)
        for bad_index in (-1, 32_768, 1.5):
            with pytest.raises(UsageError):
                await component.get(bad_index)
        await settled()
        assert not tap.received
        assert not residue(component)


# Time-outs


@in_simulated_time
async def test_every_call_has_a_time_limit_of_its_own() -> None:
    tap = Tap(generic())
    async with a_client(tap) as client:
        component = await client.component()
        await asyncio.sleep(0.1)
        tap.is_deaf = True
        limited = {
            "parameter PARAM_01 of 1/1": component.get("PARAM_01", timeout=2.5),
            "parameter 5 of 1/1": component.get(5, timeout=2.5),
            "the acknowledgement of PARAM_01 by 1/1": component.set("PARAM_01", 2, timeout=2.5),
            "the parameters of 1/1": component.fetch_all(timeout=2.5),
        }
        for awaited, call in limited.items():
            with pytest.raises(NoReply) as caught:
                await call
            error = caught.value
            assert error.awaited == awaited
            assert math.isclose(error.waited, 2.5, abs_tol=0.01), awaited
            await settled()
            assert not residue(component)


@in_simulated_time
async def test_calls_without_a_time_limit_end_by_themselves() -> None:
    tap = Tap(generic())
    async with a_client(tap) as client:
        component = await client.component()
        tap.is_deaf = True
        for name in ("get", "set", "fetch_all", "client.fetch_all"):
            began = anyio.current_time()
            with pytest.raises(NoReply) as caught:
                await CALLS[name](client, component)
            assert caught.value.attempts >= 4, name
            assert caught.value.waited <= anyio.current_time() - began + 1e-6 < 60, name
            await settled()
            assert not residue(component)


@in_simulated_time
async def test_a_fetch_that_times_out_returns_the_received_values() -> None:
    slow = generic(burst=1, period=0.1)
    async with a_client(slow) as client:
        component = await client.component()
        result = await component.fetch_all(timeout=1.05)
        assert 9 <= result.received <= 11
        assert result.count == 24
        assert not result.complete
        assert result.missing == tuple(range(result.received, 24))
        assert result.notes == ("The fetch ended at its timeout.",)
        assert math.isclose(result.elapsed, 1.05, abs_tol=0.001)
        assert list(result.params) == list(VALUES)[: result.received]
        await settled()
        assert not residue(component)
        both = await client.fetch_all(timeout=1.0)
        assert not both.complete
        assert both.results[1, 1].missing
        whole = await component.fetch_all()
        assert whole.complete
        assert dict(whole.params) == slow.params


# Fetching


@in_simulated_time
async def test_a_fetch_brings_every_parameter() -> None:
    by_list = (small_px4(), generic(), ArduPilotVehicle(ftp=False))
    for vehicle in (*by_list, ArduPilotVehicle()):
        async with a_client(vehicle) as client:
            component = await client.component()
            assert component.state == "new"
            result = await component.fetch_all()
            assert result.complete
            assert result.source == ("stream" if vehicle in by_list else "ftp")
            assert bits(result.params) == bits(vehicle.params)
            assert component.params == result.params
            assert (component.state, component.count) == ("synced", len(vehicle.params))
            assert (
                component.hash
                == result.hash
                == (vehicle.announced_hash() if isinstance(vehicle, PX4Vehicle) else None)
            )
            assert component.round_trip is not None


@in_simulated_time
@pytest.mark.parametrize("refresh", [False, True])
async def test_a_first_fetch_waits_to_hear_whether_there_is_a_file(refresh: bool) -> None:
    """The list of ArduPilot takes several times longer, on a radio ten times."""
    for of_all in (False, True):
        async with a_client(Air.symmetric([ArduPilotVehicle()], delay=0.2)) as client:
            component = await client.component()
            assert component.identity.uid is None  # it has not said who it is yet
            if of_all:
                results = (await client.fetch_all(refresh=refresh)).results
                assert [result.source for result in results.values()] == ["ftp"]
            else:
                assert (await component.fetch_all(refresh=refresh)).source == "ftp"


@in_simulated_time
async def test_the_progress_of_a_fetch_is_reported() -> None:
    async with a_client(generic(burst=1, period=0.05)) as client:
        component = await client.component()
        seen: list[Progress] = []
        await component.fetch_all(progress=seen.append)
        assert [each.received for each in seen] == sorted(each.received for each in seen)
        assert seen[-1].received == seen[-1].total == 24
        assert 15 < seen[-1].rate < 25

        def stop(progress: Progress) -> None:
            raise ValueError(progress)

        with pytest.raises(ValueError, match="Progress"):
            await component.fetch_all(refresh=True, progress=stop)
        await settled()
        assert not residue(component)


# Several vehicles


@in_simulated_time
async def test_several_vehicles_are_fetched_side_by_side() -> None:
    vehicles: dict[tuple[int, int], Any] = {
        (1, 1): small_px4(period=0.1, burst=1),
        (1, 100): generic(
            component=100, autopilot=messages.MAV_AUTOPILOT_INVALID, table={"ZOOM": 1, "FOCUS": 2.5}
        ),
        (2, 1): generic(system=2, table={"OTHER": 7}),
        (3, 1): ArduPilotVehicle(system=3),
    }
    async with a_client(Air(list(vehicles.values()))) as client:
        everything = await client.fetch_all()
        assert everything.complete
        assert not everything.silent
        assert everything.results.keys() == vehicles.keys()
        for address, result in everything.results.items():
            assert bits(result.params) == bits(vehicles[address].params)
            assert client.components[address].params == result.params
        one_system = await client.fetch_all(1, refresh=True)
        assert one_system.results.keys() == {(1, 1), (1, 100)}


class Silent(GenericVehicle):
    """A component that sends heartbeats and nothing else."""

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        return


@in_simulated_time
@pytest.mark.parametrize("autopilot", [messages.MAV_AUTOPILOT_GENERIC, messages.MAV_AUTOPILOT_INVALID])
async def test_a_silent_component_delays_no_other_component(autopilot: int) -> None:
    silent = Silent(VALUES, component=100, autopilot=autopilot), Silent(VALUES, system=2, autopilot=autopilot)
    async with a_client(Air([*silent, generic()])) as client:
        component = await client.component(system=1, component=1)
        began = anyio.current_time()
        assert (await component.fetch_all()).complete
        assert anyio.current_time() - began < 0.5
        began = anyio.current_time()
        everything = await client.fetch_all(refresh=True)
        assert anyio.current_time() - began < 3.0
        assert everything.results.keys() == {(1, 1)}
        assert everything.silent.keys() == {(1, 100), (2, 1)}
        for error in everything.silent.values():
            assert isinstance(error, NoReply)
            assert "sends messages" in str(error)
        assert everything.complete
        assert (await component.get("PARAM_01")).value == 1
        assert not any(residue(each) for each in client.components.values())


@in_simulated_time
async def test_fetch_all_waits_for_a_vehicle_at_a_long_round_trip() -> None:
    far = Air.symmetric([generic(system=2)], delay=1.25)
    async with a_client(Air([generic(), far])) as client:
        while (2, 1) not in client.components:  # noqa: ASYNC110 - in simulated time
            await anyio.sleep(0.1)
        assert (await client.fetch_all()).results.keys() == {(1, 1), (2, 1)}


@in_simulated_time
async def test_fetch_all_includes_a_vehicle_that_is_heard_late() -> None:
    late = generic(system=2)
    late.reboot(1000.0, down=0.9)
    async with a_client(Air([generic(), late])) as client:
        assert (await client.fetch_all()).results.keys() == {(1, 1), (2, 1)}


@in_simulated_time
async def test_a_link_without_an_autopilot_can_be_fetched() -> None:
    async with a_client(generic(component=100, autopilot=messages.MAV_AUTOPILOT_INVALID)) as client:
        assert (await client.fetch_all()).results.keys() == {(1, 100)}
        assert (await client.fetch_all(1)).results.keys() == {(1, 100)}
        with pytest.raises(NoReply, match="system 2"):
            await client.fetch_all(2)


@in_simulated_time
async def test_a_vehicle_that_answers_nothing_ends_a_fetch_within_7_s() -> None:
    for silent in (Silent(VALUES), Silent(VALUES, component=100, autopilot=messages.MAV_AUTOPILOT_INVALID)):
        async with a_client(silent) as client:
            await asyncio.sleep(1.5)
            began = anyio.current_time()
            with pytest.raises(NoReply, match="answers no request"):
                await client.fetch_all()
            assert anyio.current_time() - began < 7.0


@in_simulated_time
async def test_a_lossy_link_to_one_vehicle_is_not_given_up_early() -> None:
    tap = Tap(generic())
    async with a_client(tap) as client:
        await client.component()
        tap.is_deaf = True
        fetch = asyncio.create_task(client.fetch_all())
        await asyncio.sleep(6.0)
        tap.is_deaf = False
        assert (await fetch).complete


# Changes


@in_simulated_time
async def test_changes_have_the_old_and_the_new_value() -> None:
    vehicle = small_px4()
    async with a_client(vehicle) as client:
        component = await client.component()
        first, second = component.changes(), component.changes()
        await component.get("PARAM_01")
        vehicle.set_param("PARAM_01", 40)
        await until(lambda: component.params["PARAM_01"].value == 40)
        change = await anext(first)
        assert (change.name, change.old) == ("PARAM_01", None)
        assert change.new is not None
        assert change.new.value == 40, "two unread changes have become one"
        await component.set("PARAM_01", 41)
        change = await anext(first)
        assert change.old is not None
        assert change.new is not None
        assert (change.old.value, change.new.value, change.by) == (40, 41, "us")
        change = await anext(second)
        assert change.old is None
        assert change.new is not None
        assert change.new.value == 41


@in_simulated_time
async def test_queued_changes_of_one_parameter_are_merged() -> None:
    vehicle = small_px4()
    async with a_client(vehicle) as client:
        component = await client.component()
        await component.fetch_all()
        changes = component.changes()
        for value in range(100, 150):
            for name in ("PARAM_01", "PARAM_02"):
                await component.set(name, value)
        given = [await anext(changes), await anext(changes)]
        assert sorted(change.name for change in given) == ["PARAM_01", "PARAM_02"]
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(anext(changes), 1.0)


@in_simulated_time
async def test_changes_end_with_the_client_after_the_queued_ones() -> None:
    async with a_client(small_px4()) as client:
        component = await client.component()
        changes = component.changes()
        await component.get("PARAM_01")
    assert (await anext(changes)).name == "PARAM_01"
    for _ in range(2):
        with pytest.raises(ClientClosed):
            await anext(changes)
    with pytest.raises(ClientClosed):
        async for _ in component.changes():
            pass


# Links that drop


@in_simulated_time
async def test_calls_go_on_when_the_link_is_back() -> None:
    vehicle = generic(burst=1, period=0.1)
    link = FlakyLink(vehicle)
    async with a_client(link) as client:
        component = await client.component()
        changes = component.changes()
        fetch = asyncio.create_task(component.fetch_all())
        await asyncio.sleep(1.0)
        read = asyncio.create_task(component.get("PARAM_20"))
        write = asyncio.create_task(component.set("PARAM_22", 5))
        await link.drop(stays_offline=True)
        await asyncio.sleep(4.0)
        assert repr(client) == "<ParamClient tcp:flaky:5760 reconnecting, 1 component>"
        assert not any(task.done() for task in (fetch, read, write))
        link.is_offline = False
        assert (await read).value == 20
        assert (await write).status == "accepted"
        result = await fetch
        assert result.complete
        assert bits(component.params) == bits(vehicle.params)
        assert (await anext(changes)).name == "PARAM_00"
        assert "open" in repr(client)
        assert not residue(component)


@in_simulated_time
async def test_waiting_reads_are_sent_at_once_when_the_link_is_back() -> None:
    link = FlakyLink(Air.symmetric([generic()], delay=0.5))
    async with a_client(link) as client:
        component = await client.component()
        await component.get("PARAM_00")
        await link.drop()
        await settled()
        read = asyncio.create_task(component.get("PARAM_01"))
        await until(lambda: link.openings == 2)
        reconnected_at = anyio.current_time()
        await read
        assert anyio.current_time() - reconnected_at < 1.1, "one round trip, and no time-out before it"


@in_simulated_time
async def test_a_link_that_stays_disconnected_fails_the_calls_and_not_the_client(
    caplog: pytest.LogCaptureFixture,
) -> None:
    tap = Tap(generic())
    link = FlakyLink(tap)
    async with a_client(link) as client:
        component = await client.component()
        tap.is_mute = True
        waiting = {
            name: asyncio.create_task(outcome(call(client, component))) for name, call in CALLS.items()
        }
        await settled()
        changes = waiting.pop("changes")
        limited = asyncio.create_task(outcome(component.get("PARAM_05", timeout=2)))
        await link.drop(stays_offline=True)
        disconnected_at = anyio.current_time()
        assert isinstance(await limited, NoReply)
        for name, task in waiting.items():
            error = await task
            assert type(error) is LinkError, name
            assert "refused" in str(error)
            assert math.isclose(anyio.current_time() - disconnected_at, link_task.LINK_TIMEOUT, abs_tol=0.1)
        for call in ("get", "set", "fetch_all", "client.component", "client.fetch_all"):
            with pytest.raises(LinkError, match="refused"):
                await CALLS[call](client, component)
        assert not residue(component)
        await asyncio.sleep(30.0)
        attempts = link.openings
        await asyncio.sleep(30.0)
        assert 5 <= link.openings - attempts <= 7, "one every five seconds"
        tap.is_mute = False
        link.is_offline = False
        await asyncio.sleep(5.1)
        assert (await component.get("PARAM_01")).value == 1
        assert (await component.fetch_all()).complete
        assert isinstance(await changes, list), "a subscription waits on"
    reported = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(reported) == 1
    assert "reconnecting" in reported[0].getMessage()


@in_simulated_time
async def test_a_link_that_cannot_reconnect_ends_every_call() -> None:
    tap = Tap(generic())
    link = FlakyLink(tap)
    link.reconnects = False
    async with a_client(link) as client:
        component = await client.component()
        tap.is_mute = True
        waiting = {
            name: asyncio.create_task(outcome(call(client, component))) for name, call in CALLS.items()
        }
        await settled()
        await link.drop()
        for name, task in waiting.items():
            assert type(await task) is LinkError, name
        for name, call in CALLS.items():
            assert type(await outcome(call(client, component))) is LinkError, name
        assert "closed" in repr(client)
        assert not residue(component)
    assert isinstance(await outcome(component.get("PARAM_01")), ClientClosed)


# Pauses between reads of the link


class Chatter(Tap):
    """An endpoint with telemetry at an even rate.

    Attributes:
        portions: what was handed over, as it was taken together.
    """

    def __init__(self, endpoint: Endpoint, interval: float) -> None:
        super().__init__(endpoint)
        self.portions: list[list[bytes]] = []
        self._interval = interval
        self._next_at = -math.inf
        self._count = 0
        self._said: list[bytes] = []

    def say(self, data: bytes) -> None:
        """Send this beside all else."""
        self._said.append(data)

    def tick(self, now: float) -> None:
        super().tick(now)
        if self._next_at == -math.inf:
            self._next_at = now
        while self._next_at <= now:
            self._count += 1
            payload = self._count.to_bytes(4, "little").rjust(28, b"\1")
            self.say(frames.build_frame(30, payload, system=1, component=1, sequence=0))
            self._next_at += self._interval

    def next_deadline(self) -> float:
        return min(self._next_at, super().next_deadline() or math.inf)

    def data_to_send(self) -> list[bytes]:
        said, self._said = self._said, []
        portion = super().data_to_send() + said
        if portion:
            self.portions.append(portion)
        return portion


async def known_component(client: ParamClient) -> Component:
    """The component, after it has said who it is."""
    component = await client.component()
    await until(lambda: not client.core.station.is_waiting)
    return component


@in_simulated_time
async def test_a_change_waits_for_the_end_of_a_rest_at_the_most() -> None:
    vehicle = Chatter(generic(), 1 / 2000)
    async with a_client(vehicle) as client:
        component = await known_component(client)
        changes = component.changes()
        for value in range(20):
            await asyncio.sleep(0.0137)
            began = anyio.current_time()
            message = messages.ParamValue("PARAM_01", bytes((value + 1, 0, 0, 0)), ParamType.INT32, 24, 1)
            vehicle.say(messages.encode(message, system=1, component=1, sequence=0))
            with anyio.fail_after(1.0):
                assert (await anext(changes)).name == "PARAM_01"
            assert anyio.current_time() - began < link_task.READ_PAUSE + 0.001


@in_simulated_time
async def test_a_busy_link_shortens_the_rests() -> None:
    vehicle = Chatter(generic(), 1 / 20_000)
    async with a_client(vehicle) as client:
        await known_component(client)
        await asyncio.sleep(0.1)
        vehicle.portions.clear()
        await asyncio.sleep(0.5)
        largest = max(map(len, vehicle.portions))
    assert 0.9 * link_task.PAUSE_DATAGRAMS_MAX < largest < 1.1 * link_task.PAUSE_DATAGRAMS_MAX


@pytest.mark.parametrize("call", ["get", "set", "fetch_all", "client.fetch_all"])
@in_simulated_time
async def test_a_call_ends_a_rest_at_once(call: str, monkeypatch: pytest.MonkeyPatch) -> None:
    async def seconds(rest: float) -> float:
        """How long the call takes where a rest, once begun, would last until our next heartbeat."""
        monkeypatch.setattr(link_task, "READ_PAUSE", rest)
        vehicle = Chatter(small_px4(), 0.005)
        async with a_client(vehicle) as client:
            component = await known_component(client)
            vehicle.received.clear()
            await until(lambda: vehicle.messages(messages.Heartbeat))
            await asyncio.sleep(0.05)
            began = anyio.current_time()
            await CALLS[call](client, component)
            return anyio.current_time() - began

    monkeypatch.setattr(link_task, "PAUSE_DATAGRAMS_MAX", math.inf)
    with_rests, without = await seconds(60.0), await seconds(0.0)
    assert with_rests < without + 0.05


@in_simulated_time
async def test_a_blocked_program_processes_received_data_before_timeouts_count() -> None:
    """As by a call that blocks the event loop for half a second, in the middle of a list."""
    loop = simulated_time_loop()
    px4 = PX4Vehicle()
    async with a_client(px4) as client:
        vehicle = await client.component()
        loop.call_later(0.41, lambda: setattr(loop, "now", loop.now + 0.5))
        result = await vehicle.fetch_all()
    assert result.complete
    assert (result.lost, result.repeated, px4.requests["PARAM_REQUEST_READ"]) == (0, 0, 0)


@in_simulated_time
async def test_the_autopilots_are_the_vehicles_without_what_they_carry() -> None:
    camera = generic(system=1, component=100)
    vehicles = [generic(system=3), small_px4(), camera, generic(system=2, component=7)]
    async with a_client(Air(vehicles)) as client:
        assert client.autopilots == []
        await client.fetch_all()
        addresses = [(each.system, each.component) for each in client.autopilots]
        assert addresses == [(1, 1), (2, 7), (3, 1)]
        assert len(client.components) == 4


@in_simulated_time
async def test_a_vehicle_that_receives_nothing_at_first_is_identified_later() -> None:
    tap = Tap(PX4Vehicle())
    tap.is_deaf = True
    async with a_client(tap) as client:
        component = await client.component()
        await anyio.sleep(300.0)
        assert component.identity.uid is None
        tap.is_deaf = False
        assert (await component.get("SYS_AUTOSTART")).value
        await anyio.sleep(0.2)
        assert is_so(component.identity.uid is not None)
