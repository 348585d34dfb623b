"""The call that refuses when several vehicles are there."""

from __future__ import annotations

import anyio
import pytest

from paramclient import AmbiguousVehicle, NoReply, UsageError
from paramclient.protocol.identity import HEARTBEAT_WAIT
from paramclient.sim import Air, ArduPilotVehicle
from paramclient.wire import messages
from tests.shell import (
    FlakyLink,
    Late,
    Tap,
    a_client,
    in_simulated_time,
    outcome,
    simulated_time_loop,
    small_px4,
    until,
)

TEXT = "2 vehicles on this link: 1/1 PX4 quadrotor, 2/1 ArduPilot quadrotor."


def copter() -> ArduPilotVehicle:
    return ArduPilotVehicle(system=2, table={"RTL_ALT": 1500})


@in_simulated_time
async def test_the_only_vehicle_is_given_when_it_is_certain_and_at_once_from_then_on() -> None:
    began = simulated_time_loop().now
    async with a_client(Late(small_px4(), 0.5)) as client:
        found = await client.only_component()
        assert found.address == (1, 1)
        assert 0.5 + HEARTBEAT_WAIT <= simulated_time_loop().now - began < 0.5 + HEARTBEAT_WAIT + 0.1
        before = simulated_time_loop().now
        for named in ((None, None), (1, None), (1, 1), (None, 1)):
            assert await client.only_component(*named) is found
        assert simulated_time_loop().now - before < 0.05


@pytest.mark.parametrize("phase", [0.0, 0.4, 0.99])
@in_simulated_time
async def test_several_are_refused_with_the_list_as_soon_as_they_are_heard(phase: float) -> None:
    began = simulated_time_loop().now
    tap = Tap(Air([Late(copter(), phase), small_px4()]))
    async with a_client(tap) as client:
        with pytest.raises(AmbiguousVehicle) as caught:
            await client.only_component()
        assert simulated_time_loop().now - began < phase + 0.1
    error = caught.value
    assert str(error) == f"{TEXT} Choose one with the argument system."
    assert error.vehicles == ("1/1 PX4 quadrotor", "2/1 ArduPilot quadrotor")
    assert (error.choose_by, error.summary) == ("system", TEXT)
    assert isinstance(error, UsageError | ValueError)
    assert {type(message) for _, _, message in tap.received} <= {messages.Heartbeat, messages.CommandLong}


@in_simulated_time
async def test_a_named_system_is_returned_although_there_are_several() -> None:
    async with a_client(Air([small_px4(), copter(), small_px4(system=3)])) as client:
        assert (await client.only_component(2)).address == (2, 1)
        assert (await client.only_component(3, 1)).address == (3, 1)
        with pytest.raises(AmbiguousVehicle, match="3 vehicles"):
            await client.only_component(component=1)


@in_simulated_time
async def test_a_time_limit_holds_for_everything() -> None:
    async with a_client(Late(small_px4(), 0.5)) as client:
        with pytest.raises(NoReply, match="an autopilot") as caught:
            await client.only_component(timeout=0.4)
        assert 0.3 < caught.value.waited < 0.5
        with pytest.raises(NoReply, match=r"an autopilot, then 1\.2 s without another vehicle"):
            await client.only_component(timeout=1.0)
        with pytest.raises(NoReply, match="system id 7"):
            await client.only_component(7, timeout=0.1)
        assert (await client.only_component()).address == (1, 1)


@in_simulated_time
async def test_a_vehicle_that_was_lost_is_waited_for() -> None:
    async with a_client(Air([small_px4(), Late(copter(), 0.0, until=2.0)])) as client:
        assert isinstance(await outcome(client.only_component()), AmbiguousVehicle)
        await anyio.sleep(8.0)
        assert client.components[2, 1].state == "lost"
        assert (await client.only_component()).address == (1, 1)
        with pytest.raises(NoReply, match="system id 2"):
            await client.only_component(2, timeout=3.0)


@in_simulated_time
async def test_after_an_absence_of_the_link_a_second_one_is_looked_for_again() -> None:
    link = FlakyLink(Air([small_px4(), copter()]))
    tap = link.endpoint = Tap(Air([small_px4(), Late(copter(), 4.0)]))
    async with a_client(link) as client:
        await client.only_component()
        await link.drop()
        await until(lambda: client.core.link_task.is_disconnected)
        began = simulated_time_loop().now
        found = await client.only_component()
        assert simulated_time_loop().now - began >= HEARTBEAT_WAIT
        assert found.address == (1, 1)
        assert not tap.messages(messages.ParamSet)
