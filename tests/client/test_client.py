"""The client and its components: life and death, calls, time-outs, several vehicles, links, changes."""

from __future__ import annotations

import asyncio
import logging
import math
import os
import threading
from collections.abc import Callable, Coroutine
from contextlib import suppress
from pathlib import Path
from typing import Any

import anyio
import anyio.abc
import pytest

from paramclient import (
    Change,
    Changes,
    Component,
    NoReply,
    ParamClient,
    ParamType,
    Progress,
    SetStatus,
    errors,
)
from paramclient.client import link_task
from paramclient.model.px4_hash import crc32_px4
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle
from paramclient.wire import messages
from tests import shell
from tests.client.conftest import connected, fetched
from tests.conversations.partial import Partial
from tests.conversations.virtual import meanwhile, virtual_on_both
from tests.simulated_on_udp import flying

Call = Callable[[ParamClient, Component], Coroutine[Any, Any, object]]

CALLS: dict[str, Call] = {
    "get": lambda client, component: component.get("PARAM_01"),
    "set": lambda client, component: component.set("PARAM_01", 77),
    "fetch_all": lambda client, component: component.fetch_all(),
    "changes": lambda client, component: first_change(component),
    "client.component": lambda client, component: client.component(system=99, timeout=None),
    "client.events": lambda client, component: anext(client.events()),
    "client.fetch_all": lambda client, component: client.fetch_all(),
}
"""The public calls that wait."""


async def first_change(component: Component) -> Change:
    return await anext(component.changes())


# Life and death


@pytest.mark.parametrize(
    "error", [ValueError(), KeyboardInterrupt(), asyncio.CancelledError(), ExceptionGroup("", [OSError()])]
)
async def test_an_exception_of_the_body_is_raised_unchanged(error: BaseException) -> None:
    async def use() -> None:
        async with shell.a_client(shell.generic()) as client:
            await client.component()
            raise error

    with pytest.raises(type(error)) as caught:
        await use()
    assert caught.value is error
    assert not shell.tasks_beside()


async def test_calls_on_a_client_that_is_not_open() -> None:
    client = shell.a_client(shell.small_px4())
    for before in (client.component(), client.only_component(), client.fetch_all()):
        with pytest.raises(errors.ClientClosed, match="not open"):
            await before
    async with client:
        component = await client.component()
        await component.fetch_all()
    for call in (*(call(client, component) for call in CALLS.values()), client.only_component()):
        with pytest.raises(errors.ClientClosed, match="was closed"):
            await call
    assert len(component.params) == 25, "what was known stays readable"
    assert not shell.residue(component)


LONG_CALLS: dict[str, Call] = {
    "settle": lambda client, component: component.set("MC_ROLL_P", 5.0, settle=60),
    "fetch": lambda client, component: component.fetch_all(refresh=True),
    "extended": lambda client, component: component.ext.fetch_all(),
    "reboot": lambda client, component: component.reboot(timeout=None),
}


@pytest.mark.parametrize("call", LONG_CALLS)
@virtual_on_both
async def test_closing_ends_a_call_of_another_task_at_once(call: str) -> None:
    client = await shell.a_client(PX4Vehicle(burst=1, period=0.05)).open()
    async with meanwhile(LONG_CALLS[call](client, await client.component())) as raised:
        await anyio.sleep(1.0)
        await client.aclose()
        closed_at = anyio.current_time()
    assert anyio.current_time() - closed_at < 0.1
    assert [type(error) for error in raised] == [errors.ClientClosed]


@pytest.mark.asyncio
async def test_nothing_is_left_behind(tmp_path: Path) -> None:
    def present() -> tuple[set[str], int, set[threading.Thread]]:
        """The tasks, the open files, and the threads but those that anyio keeps for its event loop."""
        threads = {each for each in threading.enumerate() if "AnyIO worker" not in each.name}
        return shell.tasks_beside(), len(os.listdir("/dev/fd")), threads  # noqa: PTH208 - numbers, not paths

    with flying(shell.small_px4()) as url:
        tasks, files, threads = present()
        for _ in range(2):
            async with fetched(url, cache=tmp_path / "cache") as (_, component):
                await component.set("PARAM_01", 5)
            del component
            assert present()[:2] == (tasks, files)
            assert not present()[2] - threads, "one of an earlier test may end meanwhile"


# On the link


async def test_the_hash_can_be_read_like_a_parameter_and_is_none() -> None:
    vehicle = shell.small_px4()
    async with connected(vehicle) as (_, component):
        param = await component.get("_HASH_CHECK")
        assert (param.value, param.type, param.index) == (vehicle.announced_hash(), ParamType.UINT32, None)
        assert "_HASH_CHECK" not in component.params
        with pytest.raises(errors.UsageError, match="_HASH_CHECK is read-only"):
            await component.set("_HASH_CHECK", 0)


async def test_a_px4_has_fewer_parameters_from_its_second_start_on() -> None:
    async with fetched(PX4Vehicle()) as (_, component):
        before = set(component.params)
        result = await (await component.reboot()).fetch_all()
        assert before - set(result.params) == {"CAL_BARO1_ID", "CAL_BARO2_ID", "CAL_BARO3_ID"}
        assert (result.complete, result.count) == (True, len(before) - 3)


async def test_invalid_values_and_names_are_not_sent() -> None:
    table: dict[str, Any] = {"SMALL": (ParamType.UINT8, 1), "WHOLE": 1}
    tap = shell.Tap(GenericVehicle(table))
    async with fetched(tap) as (_, component):
        await shell.settled()
        tap.received.clear()
        names = ("SEVENTEEN_LETTERS", "GRÖSSE", "")
        numbers = [("SMALL", 300), ("SMALL", -1), ("WHOLE", 1.5), ("WHOLE", 2**31), ("WHOLE", math.nan)]
        texts: list[tuple[str, Any]] = [("WHOLE", each) for each in ("1", None, b"123", [1])]
        gets: list[Any] = [*names, -1, 32_768, 1.5]
        sets = [component.set(*each) for each in (*numbers, *texts, *((name, 1) for name in names))]
        wrong: list[dict[str, Any]] = [{"no name": 1}, {"WHOLE": "two"}, {"_HASH_CHECK": 1}]
        many = [component.set_many({"SMALL": 2, **each}) for each in wrong]
        many.append(component.set_many({"SMALL": 2}, settle=-1))
        for call in (*sets, *many, *(component.get(each) for each in gets)):
            with pytest.raises(errors.UsageError):
                await call
        assert (await component.set_many({})).is_complete
        await shell.settled()
        assert not tap.received
        assert not shell.residue(component)


# Time-outs


@pytest.mark.parametrize("timeout", [math.nan, -1.0, "1"])
async def test_a_timeout_is_a_number_of_seconds(timeout: Any) -> None:
    async with connected(shell.generic()) as (client, component):
        for call in (
            *(component.get("A", timeout=timeout), component.set("A", 1, timeout=timeout)),
            *(component.set_many({"A": 1}, timeout=timeout), component.fetch_all(timeout=timeout)),
            *(client.component(timeout=timeout), client.fetch_all(timeout=timeout)),
        ):
            with pytest.raises(errors.UsageError, match="a timeout is a number of seconds from 0"):
                await call


async def test_every_call_has_a_time_limit_of_its_own() -> None:
    tap = shell.Tap(shell.generic())
    async with connected(tap) as (_, component):
        await asyncio.sleep(0.1)
        tap.is_deaf = True
        limited = {
            "parameter PARAM_01 of 1/1": component.get("PARAM_01", timeout=2.5),
            "parameter 5 of 1/1": component.get(5, timeout=2.5),
            "the acknowledgement of PARAM_01 by 1/1": component.set("PARAM_01", 2, timeout=2.5),
            "the parameters of 1/1": component.fetch_all(timeout=2.5),
        }
        for awaited, call in limited.items():
            with pytest.raises(errors.NoReply) as caught:
                await call
            error = caught.value
            assert error.awaited == awaited
            assert math.isclose(error.waited, 2.5, abs_tol=0.01), awaited
            await shell.settled()
            assert not shell.residue(component)


async def test_a_fetch_that_times_out_returns_the_received_values() -> None:
    slow = shell.generic(burst=1, period=0.1)
    async with connected(slow) as (client, component):
        seen: list[Progress] = []
        result = await component.fetch_all(timeout=1.05, progress=seen.append)
        assert 8 < seen[-1].rate < 12
        assert max(each.rate for each in seen) < 25
        assert seen == sorted(seen, key=lambda progress: progress.received)
        assert (seen[-1].received, seen[-1].total) == (result.received, 24)
        assert 9 <= result.received <= 11
        assert result.count == 24
        assert not result.complete
        assert result.missing == tuple(range(result.received, 24))
        assert result.notes == ("The fetch ended at its timeout.",)
        assert math.isclose(result.elapsed, 1.05, abs_tol=0.001)
        assert list(result.params) == list(shell.VALUES)[: result.received]
        await shell.settled()
        assert not shell.residue(component)
        both = await client.fetch_all(timeout=1.0)
        assert not both.complete
        assert both.results[1, 1].missing
        whole = await component.fetch_all()
        assert whole.complete
        assert dict(whole.params) == slow.params


# Several vehicles


async def test_several_vehicles_are_fetched_side_by_side() -> None:
    vehicles: dict[tuple[int, int], Any] = {
        (1, 1): shell.small_px4(period=0.1, burst=1),
        (1, 100): shell.generic(
            component=100, autopilot=messages.MAV_AUTOPILOT_INVALID, table={"ZOOM": 1, "FOCUS": 2.5}
        ),
        (2, 1): shell.generic(system=2, table={"OTHER": 7}),
        (3, 1): ArduPilotVehicle(system=3),
    }
    async with shell.a_client(Air(list(vehicles.values()))) as client:
        everything = await client.fetch_all()
        assert everything.complete
        assert not everything.silent
        assert everything.results.keys() == vehicles.keys()
        for address, result in everything.results.items():
            assert shell.bits(result.params) == shell.bits(vehicles[address].params)
            assert client.components[address].params == result.params
        assert (await client.fetch_all(1, refresh=True)).results.keys() == {(1, 1), (1, 100)}
        await client.components[3, 1].set("RTL_ALT", 1234)
        assert [each.requests["PARAM_SET"] for each in vehicles.values()] == [0, 0, 0, 1]
        assert vehicles[3, 1].param("RTL_ALT").value == 1234


def silent(**options: Any) -> shell.Tap:
    """A component that sends heartbeats and nothing else."""
    tap = shell.Tap(shell.generic(**options))
    tap.is_deaf = True
    return tap


@pytest.mark.parametrize("autopilot", [messages.MAV_AUTOPILOT_GENERIC, messages.MAV_AUTOPILOT_INVALID])
async def test_a_silent_component_delays_no_other_component(autopilot: int) -> None:
    parts = [silent(**at, autopilot=autopilot) for at in ({"component": 100}, {"system": 2})]
    camera = Partial(serves=("commands",), component=101, heartbeat=messages.Heartbeat(30, 8))
    async with shell.a_client(Air([*parts, camera, shell.generic()])) as client:
        component = await client.component(system=1, component=1)
        with anyio.fail_after(0.5):
            assert (await component.fetch_all()).complete
        with anyio.fail_after(3.0):
            everything = await client.fetch_all(refresh=True)
        assert everything.results.keys() == {(1, 1)}
        assert everything.silent.keys() == {(1, 100), (1, 101), (2, 1)}
        for error in everything.silent.values():
            assert isinstance(error, errors.NoReply)
            assert "sends messages" in str(error)
        assert everything.complete
        assert (await component.get("PARAM_01")).value == 1
        assert not any(shell.residue(each) for each in client.components.values())


@pytest.mark.parametrize("delay", [1.25, 0.0], ids=["far away", "heard late"])
async def test_fetch_all_waits_for_a_second_vehicle(delay: float) -> None:
    second = shell.generic(system=2)
    if not delay:
        second.reboot(1000.0, down=0.9)
    async with shell.a_client(Air([shell.generic(), Air.symmetric([second], delay=delay)])) as client:
        await shell.until(lambda: (2, 1) in client.components or not delay)
        assert (await client.fetch_all()).results.keys() == {(1, 1), (2, 1)}


@pytest.mark.parametrize(("serves", "delay"), [("list", 0.25), ("indices", 0.0)])
async def test_fetch_all_waits_for_a_companion_that_answers_no_command(serves: str, delay: float) -> None:
    companion = Partial(serves=[serves], component=2, heartbeat=messages.Heartbeat(0, 8, system_status=4))
    async with shell.a_client(Air.symmetric([shell.generic(), companion], delay=delay)) as client:
        assert (await client.fetch_all()).results.keys() == {(1, 1), (1, 2)}


async def test_fetch_all_waits_for_a_px4_that_is_starting() -> None:
    starting = silent(system=2, autopilot=messages.MAV_AUTOPILOT_PX4)
    async with shell.a_client(Air([shell.generic(), starting])) as client:
        asyncio.get_running_loop().call_later(4.0, setattr, starting, "is_deaf", False)
        assert (await client.fetch_all()).results.keys() == {(1, 1), (2, 1)}


async def test_a_link_without_an_autopilot_can_be_fetched() -> None:
    camera = shell.generic(component=100, autopilot=messages.MAV_AUTOPILOT_INVALID)
    async with shell.a_client(camera) as client:
        assert (await client.fetch_all()).results.keys() == {(1, 100)}
        assert (await client.fetch_all(1)).results.keys() == {(1, 100)}
        with pytest.raises(errors.NoReply, match="system 2"):
            await client.fetch_all(2)


async def test_a_vehicle_that_answers_nothing_ends_a_fetch_within_7_s() -> None:
    for options in ({}, {"component": 100, "autopilot": messages.MAV_AUTOPILOT_INVALID}):
        async with shell.a_client(silent(**options)) as client:
            await asyncio.sleep(1.5)
            with pytest.raises(errors.NoReply, match="answers no request"), anyio.fail_after(7.0):
                await client.fetch_all()


async def test_a_lossy_link_to_one_vehicle_is_not_given_up_early() -> None:
    tap = shell.Tap(shell.generic())
    async with shell.a_client(tap) as client:
        await client.component()
        tap.is_deaf = True
        fetch = asyncio.create_task(client.fetch_all())
        await asyncio.sleep(4.5)
        tap.is_deaf = False
        assert (await fetch).complete


# Changes


async def test_changes_have_the_old_and_the_new_value() -> None:
    vehicle = shell.small_px4()
    async with connected(vehicle) as (_, component):
        first, second = component.changes(), component.changes()

        async def told(changes: Changes) -> tuple[object, ...]:
            change = await anext(changes)
            return change.name, change.old and change.old.value, change.new and change.new.value, change.by

        await component.get("PARAM_01")
        vehicle.set_param("PARAM_01", 40)
        await shell.until(lambda: component.params["PARAM_01"].value == 40)
        assert await told(first) == ("PARAM_01", None, 40, "vehicle"), "two unread changes have become one"
        await component.set("PARAM_01", 41)
        assert await told(first) == ("PARAM_01", 40, 41, "us")
        assert (await told(second))[:3] == ("PARAM_01", None, 41)


# Links that drop


async def test_calls_go_on_when_the_link_is_back() -> None:
    vehicle = shell.generic(burst=1, period=0.1)
    link = shell.FlakyLink(vehicle)
    async with connected(link) as (client, component):
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
        assert (await fetch).complete
        assert shell.bits(component.params) == shell.bits(vehicle.params)
        assert (await anext(changes)).name == "PARAM_00"
        assert "open" in repr(client)
        assert not shell.residue(component)


async def test_a_link_that_stays_disconnected_fails_only_calls(caplog: pytest.LogCaptureFixture) -> None:
    tap = shell.Tap(shell.generic())
    link = shell.FlakyLink(tap)
    async with connected(link) as (client, component):
        tap.is_mute = True
        calls = {name: shell.outcome(call(client, component)) for name, call in CALLS.items()}
        waiting = {name: asyncio.create_task(call) for name, call in calls.items()}
        await shell.settled()
        changes, events = waiting.pop("changes"), waiting.pop("client.events")
        limited = asyncio.create_task(shell.outcome(component.get("PARAM_05", timeout=2)))
        await link.drop(stays_offline=True)
        disconnected_at = anyio.current_time()
        assert isinstance(await limited, errors.NoReply)
        for name, task in waiting.items():
            error = await task
            assert type(error) is errors.LinkError, name
            assert "refused" in str(error)
            assert math.isclose(anyio.current_time() - disconnected_at, link_task.LINK_TIMEOUT, abs_tol=0.1)
        for call in ("get", "set", "fetch_all", "client.component", "client.fetch_all"):
            with pytest.raises(errors.LinkError, match="refused"):
                await CALLS[call](client, component)
        assert not shell.residue(component)
        await asyncio.sleep(30.0)
        attempts = link.openings
        await asyncio.sleep(30.0)
        assert 5 <= link.openings - attempts <= 7, "one every five seconds"
        tap.is_mute = False
        link.is_offline = False
        await asyncio.sleep(5.1)
        assert (await component.get("PARAM_01")).value == 1
        assert (await component.fetch_all()).complete
        assert isinstance(await changes, Change), "a subscription waits on"
        assert not isinstance(await events, Exception)
    reported = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(reported) == 1
    assert "reconnecting" in reported[0].getMessage()


# many writes in one call

MANY: dict[str, int | float] = {f"MANY_{number:03}": float(number) for number in range(200)}
NEW: dict[str, int | float] = {name: value + 0.5 for name, value in MANY.items()}


async def test_the_timeout_is_that_of_the_whole_call() -> None:
    tap = shell.Tap(Air.symmetric([PX4Vehicle(table=MANY)], delay=0.05))
    async with fetched(tap) as (_, component):
        result = await component.set_many(NEW, timeout=0.25)
        assert 0.2 < result.elapsed < 0.4
        assert isinstance(result.error, errors.NoReply)
        assert result.counts[SetStatus.ACCEPTED] >= 10
        assert result.counts[SetStatus.UNKNOWN] >= 10
        assert result.counts[SetStatus.NOT_TRIED] >= 100
        assert not shell.residue(component)
        sent = len(tap.messages(messages.ParamSet))
        await asyncio.sleep(1.0)
        assert len(tap.messages(messages.ParamSet)) == sent
        assert (await component.set_many(NEW)).is_complete


# files

LOG = bytes(range(256)) * 200
"""A file of 51,200 bytes, which takes a second."""


def with_files(**options: Any) -> ArduPilotVehicle:
    vehicle = ArduPilotVehicle(live_period=0, **options)
    vehicle.files.update({"/APM/LOGS/1.BIN": LOG, "/APM/a.txt": b"hello", "/APM/empty": b""})
    return vehicle


async def test_a_time_limit_ends_a_read_and_closes_the_file() -> None:
    vehicle = with_files()
    async with connected(vehicle) as (_, component):
        began = anyio.current_time()
        with pytest.raises(NoReply, match=r"/APM/LOGS/1.BIN of 1/1"):
            await component.read_file("/APM/LOGS/1.BIN", timeout=0.3)
        assert anyio.current_time() - began < 1.41  # the vehicle ends its burst of a second before it closes
        await anyio.sleep(1.0)
        assert not vehicle.open_files
        assert await component.file_checksum("/APM/a.txt") == crc32_px4(b"hello")


@pytest.mark.parametrize("how", ["timeout", "error", "task", "all tasks", "scope"])
async def test_a_client_leaves_no_file_open_at_whatever_moment_it_ends(how: str) -> None:
    """All tasks are cancelled, each for itself, by `asyncio.run` when its main task has ended."""
    requests = 0
    for step in range(1, 40):
        vehicle, seconds = ArduPilotVehicle(live_period=0), step / 100
        air = Air.symmetric([vehicle], delay=0.02)

        async def session(air: Air, seconds: float) -> None:
            with anyio.move_on_after(seconds if how == "scope" else None) as scope:
                async with connected(air) as (_, component):
                    if how == "error":
                        fetching = asyncio.ensure_future(shell.outcome(component.fetch_all()))
                        await anyio.sleep(seconds)
                        assert not fetching.done()
                        raise RuntimeError("of the body")
                    with suppress(NoReply):
                        await component.fetch_all(timeout=seconds if how == "timeout" else None)
            assert scope.cancelled_caught == (how == "scope")

        task = asyncio.ensure_future(session(air, seconds))
        if how.endswith(("task", "tasks")):
            await anyio.sleep(seconds)
            for each in {task} if how == "task" else asyncio.all_tasks() - {asyncio.current_task()}:
                each.cancel()
        with anyio.fail_after(0.5 if how == "all tasks" else 5.0):
            await asyncio.wait([task])
        assert task.cancelled() == how.endswith(("task", "tasks"))
        assert task.cancelled() or bool(task.exception()) == (how == "error")
        assert not shell.tasks_beside()
        if how == "all tasks":  # the vehicle ends its burst before it closes
            await anyio.sleep(1.0)
            air.tick(anyio.current_time())
        assert not vehicle.open_files
        requests += vehicle.requests["FILE_TRANSFER_PROTOCOL"]
    assert requests > 80


async def test_a_read_goes_on_when_the_link_is_back() -> None:
    link = shell.FlakyLink(with_files())
    async with connected(link) as (_, component):
        reading = asyncio.ensure_future(component.read_file("/APM/LOGS/1.BIN"))
        await anyio.sleep(0.3)
        await link.drop()
        assert await reading == LOG
