"""A restart on command, and another system id: the same vehicle, once, and nothing left behind."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import anyio
import pytest
from paramclient.protocol.requests.retry import REBOOT_COMMANDS_MAX
from paramclient.protocol.vehicle.reboot_command import SAVING_TIME, UNOBSERVED_TIMEOUT

from paramclient import (
    AnotherVehicle,
    CommandRefused,
    Component,
    NoReply,
    ParamClient,
    Rebooted,
)
from paramclient.client.component import REBOOT_TIMEOUT
from paramclient.errors import CommandResult
from paramclient.sim import Air, ArduPilotVehicle, Endpoint, PX4Vehicle, Vehicle
from paramclient.wire import frames, messages
from tests.shell import Tap, a_client, generic, in_simulated_time, outcome, residue, tasks_beside
from tests.simulation import is_so

Make: TypeAlias = Callable[..., Vehicle]


def px4(**options: Any) -> PX4Vehicle:
    return PX4Vehicle(**{"table": {"A": 1, "MAV_SYS_ID": options.get("system", 1)}} | options)


def ardupilot(**options: Any) -> ArduPilotVehicle:
    """A Copter, unless another kind is chosen."""
    return ArduPilotVehicle(**{"table": {"A": 1, "SYSID_THISMAV": options.get("system", 1)}} | options)


plane = partial(ardupilot, kind="plane")
MAKES = pytest.mark.parametrize(
    "make", [px4, ardupilot, plane, generic], ids=["px4", "copter", "plane", "generic"]
)


def counted(vehicle: Vehicle) -> list[float]:
    """The times at which a vehicle starts again from now on."""
    starts: list[float] = []
    reboot = vehicle.reboot

    def count(now: float | None = None, *, down: float = 0.0) -> None:
        starts.append(math.nan if now is None else now + down)
        reboot(now, down=down)

    vehicle.reboot = count  # type: ignore[method-assign]  # to be counted
    return starts


async def known(client: ParamClient, uptime: float = 10.0) -> Component:
    """The component, after it has been up for a while."""
    component = await client.component()
    await asyncio.sleep(uptime)
    return component


def reports_clock(data: bytes) -> bool:
    """Whether a datagram has the time since boot in it."""
    frames = frames.Framer(stream=False).receive(data)
    return any(frame.message_id in frames.BOOT_CLOCK_OFFSETS for frame in frames)


class Clockless(Tap):
    """An endpoint whose time since boot is never received."""

    def data_to_send(self) -> list[bytes]:
        return [data for data in super().data_to_send() if not reports_clock(data)]


class Exchanged(Tap):
    """An endpoint in whose place another one is from some time on."""

    def exchange(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint


# the way it goes


@MAKES
@pytest.mark.parametrize("uptime", [0.0, 0.7, 30.0])
@pytest.mark.parametrize("down", [0.0, 1.0, 3.0, 20.0])
@pytest.mark.parametrize("ack", [True, False])
@in_simulated_time
async def test_reboot_returns_when_the_vehicle_is_back(
    make: Make, uptime: float, down: float, ack: bool
) -> None:
    vehicle = make(reboot_down=down, reboot_ack=ack)
    starts = counted(vehicle)
    tap = Tap(vehicle)
    async with a_client(tap) as client:
        component = await known(client, uptime)
        events = client.events()
        assert await component.reboot() is component
        assert len(starts) == 1
        assert starts[0] <= anyio.current_time() < starts[0] + 3.5
        assert component.core.machine.identification.known_at >= starts[0]  # it has said who it is since
        assert (await component.get(next(iter(vehicle.params)))).value is not None
        assert residue(component) == []
        await asyncio.sleep(10.0)
        assert len(starts) == 1
        seen = [type(event) for event in events._waiting]
        assert seen.count(Rebooted) == 1
    commands = [each for each in tap.messages(messages.CommandLong) if each.command == 246]
    assert commands == [messages.CommandLong(1, 1, 246, (1.0, *[0.0] * 6), 0)]


@MAKES
@in_simulated_time
async def test_reboot_waits_until_the_vehicle_has_booted(make: Make) -> None:
    vehicle = make(boot_time=7.0)
    starts = counted(vehicle)
    async with a_client(vehicle) as client:
        component = await known(client)
        await component.reboot()
        assert anyio.current_time() >= starts[0] + 7.0
        assert len(starts) == 1


@MAKES
@in_simulated_time
async def test_a_command_that_is_lost_is_sent_again(make: Make) -> None:
    vehicle = make()
    starts = counted(vehicle)
    tap = Tap(vehicle)
    async with a_client(tap) as client:
        component = await known(client)
        tap.is_deaf = True
        asyncio.get_running_loop().call_later(4.0, setattr, tap, "is_deaf", False)
        await component.reboot()
        assert len(starts) == 1
        commands = [each for each in tap.messages(messages.CommandLong) if each.command == 246]
        assert [each.confirmation for each in commands] == list(range(len(commands)))
        assert len(commands) > 1


@in_simulated_time
async def test_a_vehicle_that_receives_nothing_is_given_up() -> None:
    tap = Tap(generic())
    async with a_client(tap) as client:
        component = await known(client)
        tap.is_deaf = True
        error = await outcome(component.reboot())
        assert isinstance(error, NoReply)
        assert error.attempts == REBOOT_COMMANDS_MAX
        assert "the restart of 1/1" in str(error)
        assert residue(component) == []


@pytest.mark.parametrize(("down", "longest"), [(1.0, UNOBSERVED_TIMEOUT + 2.0), (4.0, 8.0), (12.0, 16.0)])
@MAKES
@in_simulated_time
async def test_a_vehicle_without_a_clock(make: Make, down: float, longest: float) -> None:
    vehicle = make(reboot_down=down)
    starts = counted(vehicle)
    async with a_client(Clockless(vehicle)) as client:
        component = await known(client)
        began = anyio.current_time()
        await component.reboot()
        assert down < anyio.current_time() - began < longest
        assert len(starts) == 1


@in_simulated_time
async def test_a_silence_alone_is_no_restart() -> None:
    """The command is lost, and so is everything for a while; the clock goes on, so it is commanded again."""
    vehicle = generic()
    starts = counted(vehicle)
    tap = Tap(vehicle)
    async with a_client(tap) as client:
        component = await known(client)
        tap.is_deaf = tap.is_mute = True
        asyncio.get_running_loop().call_later(4.0, setattr, tap, "is_mute", False)
        asyncio.get_running_loop().call_later(5.0, setattr, tap, "is_deaf", False)
        await component.reboot()
        assert len(starts) == 1
        assert starts[0] <= anyio.current_time()


@in_simulated_time
async def test_a_reboot_waits_until_px4_has_saved_the_last_write() -> None:
    tap = Tap(px4())
    async with a_client(tap) as client:
        component = await known(client)
        await component.set("A", 2)
        written = anyio.current_time()
        await component.reboot()
        [reported] = [
            now
            for now, _, each in tap.received
            if isinstance(each, messages.CommandLong) and each.command == 246
        ]
        assert SAVING_TIME - 0.01 <= reported - written < SAVING_TIME + 0.1
        assert (await component.get("A")).value == 2


# ends


@pytest.mark.parametrize(
    ("make", "code"), [(px4, CommandResult.DENIED), (ardupilot, CommandResult.FAILED), (generic, 2)]
)
@in_simulated_time
async def test_an_armed_vehicle_refuses(make: Make, code: int) -> None:
    vehicle = make(armed=True)
    starts = counted(vehicle)
    async with a_client(vehicle) as client:
        component = await known(client)
        assert component.is_armed is True
        error = await outcome(component.reboot())
        assert isinstance(error, CommandRefused)
        assert (error.command, error.code) == (246, code)
        assert residue(component) == []
        await asyncio.sleep(5.0)
        assert not starts
        vehicle.armed = False
        await asyncio.sleep(1.1)
        assert is_so(component.is_armed is False)
        await component.reboot()
        assert len(starts) == 1


@pytest.mark.parametrize(("timeout", "patience"), [(None, REBOOT_TIMEOUT), (10.0, 10.0), (1.0, 1.0)])
@pytest.mark.parametrize("ack", [True, False])
@in_simulated_time
async def test_a_vehicle_that_does_not_return_is_no_reply(
    ack: bool, timeout: float | None, patience: float
) -> None:
    vehicle = generic(reboot_down=math.inf, reboot_ack=ack)
    async with a_client(vehicle) as client:
        component = await known(client)
        began = anyio.current_time()
        error = await outcome(component.reboot(timeout=timeout))
        assert isinstance(error, NoReply)
        assert math.isclose(anyio.current_time() - began, patience, abs_tol=0.01)
        assert error.attempts == 1
        assert residue(component) == []
        await asyncio.sleep(6.0)
        assert component.is_armed is None  # unknown
        assert isinstance(await outcome(component.reboot()), NoReply)  # it is lost


@pytest.mark.parametrize("ack", [True, False])
@pytest.mark.parametrize(
    ("before", "after"),
    [
        (partial(generic, uid=1), partial(generic, uid=2)),
        (partial(generic, uid=0), partial(generic, uid=0, autopilot=messages.MAV_AUTOPILOT_PX4)),
        (partial(px4, uid=1), ardupilot),
    ],
    ids=["uid", "kind", "both"],
)
@in_simulated_time
async def test_another_vehicle_after_the_reboot_raises_another_vehicle(
    before: Make, after: Make, ack: bool
) -> None:
    place = Exchanged(before(reboot_down=math.inf, reboot_ack=ack))
    async with a_client(place) as client:
        component = await known(client)
        asyncio.get_running_loop().call_later(4.0, place.exchange, after())
        error = await outcome(component.reboot())
        assert isinstance(error, AnotherVehicle)
        assert (error.system, error.component) == (1, 1)
        assert error.expected in str(error)
        assert error.found in str(error)
        assert error.expected != error.found
        assert residue(component) == []
        # the one that is there now can be commanded, too
        assert await component.reboot() is component


@in_simulated_time
async def test_another_hardware_id_after_the_reboot_raises_at_once() -> None:
    place = Exchanged(generic(uid=1, reboot_down=math.inf))
    async with a_client(place) as client:
        component = await known(client)
        asyncio.get_running_loop().call_later(10.0, place.exchange, Clockless(generic(uid=2)))
        began = anyio.current_time()
        assert isinstance(await outcome(component.reboot()), AnotherVehicle)
        assert anyio.current_time() - began < 11.5


@in_simulated_time
async def test_calls_at_the_same_time_share_one_restart() -> None:
    vehicle = generic()
    starts = counted(vehicle)
    async with a_client(vehicle) as client:
        component = await known(client)
        impatient = asyncio.ensure_future(component.reboot(timeout=0.1))
        assert list(await asyncio.gather(component.reboot(), component.reboot())) == [component] * 2
        assert isinstance(await outcome(impatient), NoReply)
        assert len(starts) == 1
        assert residue(component) == []


@pytest.mark.parametrize("after", [0.0, 0.1, 0.5, 1.2, 2.0])
@MAKES
@in_simulated_time
async def test_cancelling_leaves_nothing(make: Make, after: float) -> None:
    vehicle = make(reboot_ack=False)
    async with a_client(vehicle) as client:
        component = await known(client)
        tasks = tasks_beside()
        call = asyncio.ensure_future(component.reboot())
        await asyncio.sleep(after)
        call.cancel()
        await asyncio.wait([call])
        assert call.cancelled() or call.done()
        assert residue(component) == []
        assert len(component.core.machine.commands) == 0
        assert component.core.machine.reboots.current is None
        assert tasks_beside() == tasks
        await asyncio.sleep(5.0)
        assert await component.reboot() is component


# another system id


@in_simulated_time
async def test_px4_takes_its_system_id_with_the_start() -> None:
    vehicle = px4(uid=7)
    async with a_client(vehicle) as client:
        component = await known(client)
        await component.set("MAV_SYS_ID", 9)
        await asyncio.sleep(5.0)
        assert set(client.components) == {(1, 1)}
        changed = await component.reboot(system=9)
        assert (changed.system, changed.component) == (9, 1)
        assert changed.identity.uid == component.identity.uid
        assert (await changed.get("MAV_SYS_ID")).value == 9
        assert residue(component) == residue(changed) == []
        assert await changed.reboot(system=9) is changed
        assert vehicle.system == 9


@pytest.mark.parametrize("ack", [True, False])
@pytest.mark.parametrize("uid", [7, None])  # None: what all simulated PX4 have
@in_simulated_time
async def test_there_and_back_again(uid: int | None, ack: bool) -> None:
    vehicle = px4(uid=uid, reboot_ack=ack)
    async with a_client(vehicle) as client:
        component = await known(client)
        for system in (9, 1, 9):
            await component.set("MAV_SYS_ID", system)
            component = await component.reboot(system=system)
            assert component.system == system
            assert (await component.get("MAV_SYS_ID")).value == system


@in_simulated_time
async def test_a_vehicle_that_keeps_its_old_system_id_is_no_reply() -> None:
    vehicle = px4()
    async with a_client(vehicle) as client:
        component = await known(client)
        began = anyio.current_time()
        error = await outcome(component.reboot(system=9, timeout=20.0))
        assert isinstance(error, NoReply)
        assert "as 9/1" in str(error)
        assert math.isclose(anyio.current_time() - began, 20.0, abs_tol=0.01)
        vehicle.armed = True
        assert isinstance(await outcome(component.reboot(system=9)), CommandRefused)


@in_simulated_time
async def test_plane_and_rover_take_it_at_once() -> None:
    vehicle = ardupilot(kind="plane")
    async with a_client(vehicle) as client:
        component = await known(client)
        await component.fetch_all()
        await component.set("SYSID_THISMAV", 9)
        began = anyio.current_time()
        changed = await client.successor(component, 9)
        assert changed.system == 9
        assert anyio.current_time() - began < 2.0
        assert changed.identity.uid == component.identity.uid
        result = await changed.fetch_all()
        assert result.complete


@in_simulated_time
async def test_copter_takes_it_with_the_next_start() -> None:
    vehicle = ardupilot()
    async with a_client(vehicle) as client:
        component = await known(client)
        await component.set("SYSID_THISMAV", 9)
        await asyncio.sleep(5.0)
        assert set(client.components) == {(1, 1)}
        changed = await component.reboot(system=9)
        assert changed.system == 9
        assert (await changed.get("SYSID_THISMAV")).value == 9


@pytest.mark.parametrize("seed", range(6))
@in_simulated_time
async def test_a_copter_whose_acknowledgement_is_lost_starts_once(seed: int) -> None:
    """It is received again 1.2 s later, and sends its clock 1.4 s after that: it is not commanded again
    meanwhile."""
    vehicle = ardupilot(reboot_down=0.8 + 0.1 * seed, reboot_ack=False)
    starts = counted(vehicle)
    async with a_client(vehicle) as client:
        component = await known(client)
        await component.reboot()
        await asyncio.sleep(10.0)
        assert len(starts) == 1


@MAKES
@in_simulated_time
async def test_a_reboot_by_another_station_is_detected(make: Make) -> None:
    vehicle = make()
    async with a_client(vehicle) as client:
        await known(client)
        events = client.events()
        vehicle.reboot(down=1.0)
        await asyncio.sleep(1.0 + 1.4 + 1.1)
        assert [type(event) for event in events._waiting] == [Rebooted]
        await asyncio.sleep(30.0)
        assert len(events._waiting) == 1


@in_simulated_time
async def test_successor_raises_if_another_vehicle_has_the_new_id() -> None:
    air = Air.symmetric([generic(), generic(system=9)])
    async with a_client(air) as client:
        component = await client.component(system=1)
        error = await outcome(client.successor(component, 9))
        assert isinstance(error, AnotherVehicle)
        assert (error.system, error.component) == (9, 1)
