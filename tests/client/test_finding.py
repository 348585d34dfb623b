"""Finding components: the first autopilot, the only vehicle, all vehicles; two with the same ids."""

from __future__ import annotations

from typing import Any

import anyio
import anyio.abc
import pytest

from paramclient import AmbiguousVehicle, NoReply, ParamClient, UsageError
from paramclient.client.client import COMPONENT_TIMEOUT, VEHICLES_LISTENING_TIME
from paramclient.links import Peer
from paramclient.protocol.identity import HEARTBEAT_WAIT
from paramclient.sim import Air, ArduPilotVehicle, Endpoint
from paramclient.wire import messages
from tests import shell
from tests.client.conftest import connected, fetched


async def test_the_first_autopilot_is_the_component() -> None:
    camera = shell.generic(component=100, autopilot=messages.MAV_AUTOPILOT_INVALID)
    air = Air([camera, shell.generic(system=7, component=1), shell.generic(system=9)])
    async with connected(air) as (client, component):
        await client.fetch_all()
        assert client.autopilots == [client.components[7, 1], client.components[9, 1]]
        assert (component.system, component.component) == (7, 1)
        assert await client.component() is component
        assert await client.component(system=9) is client.components[9, 1]
        assert await client.component(component=100) is client.components[1, 100]
        assert await client.component(system=1, component=100) is client.components[1, 100]
        assert set(client.components) == {(1, 100), (7, 1), (9, 1)}
        with pytest.raises(TypeError):
            client.components[1, 1] = component  # type: ignore[index]  # that it is read-only is the point


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
    camera = shell.generic(component=101, autopilot=messages.MAV_AUTOPILOT_INVALID)
    async with shell.a_client(camera) as client:
        with pytest.raises(NoReply) as caught:
            await client.component(**wanted, timeout=2.5)
        error = caught.value
        assert (error.awaited, error.attempts, round(error.waited, 3)) == (words, 0, 2.5)
        began = anyio.current_time()
        with pytest.raises(NoReply):
            await client.component(**wanted)
        assert round(anyio.current_time() - began, 3) == COMPONENT_TIMEOUT


@pytest.mark.parametrize("wanted", [{"system": 300}, {"system": "x"}, {"component": -1}])
async def test_an_id_that_no_component_has_is_an_error_at_once(wanted: dict[str, Any]) -> None:
    async with ParamClient("sim:px4", cache=False) as client:
        for find in (client.component, client.only_component):
            with pytest.raises(UsageError, match="component ids 0 to 255, not"):
                await find(**wanted, timeout=None)


# the only vehicle

TEXT = "2 vehicles on this link: 1/1 PX4 quadrotor, 2/1 ArduPilot quadrotor."


def copter() -> ArduPilotVehicle:
    return ArduPilotVehicle(system=2, table={"RTL_ALT": 1500})


async def test_the_only_vehicle_is_given_when_it_is_certain_and_at_once_from_then_on() -> None:
    began = shell.simulated_time_loop().now
    async with shell.a_client(shell.Late(shell.small_px4(), 0.5)) as client:
        found = await client.only_component()
        assert found.address == (1, 1)
        assert 0.5 + HEARTBEAT_WAIT <= shell.simulated_time_loop().now - began < 0.5 + HEARTBEAT_WAIT + 0.1
        before = shell.simulated_time_loop().now
        for named in ((None, None), (1, None), (1, 1), (None, 1)):
            assert await client.only_component(*named) is found
        assert shell.simulated_time_loop().now - before < 0.05


@pytest.mark.parametrize("phase", [0.0, 0.4, 0.99])
async def test_several_are_refused_with_the_list_as_soon_as_they_are_heard(phase: float) -> None:
    began = shell.simulated_time_loop().now
    tap = shell.Tap(Air([shell.Late(copter(), phase), shell.small_px4()]))
    async with shell.a_client(tap) as client:
        with pytest.raises(AmbiguousVehicle) as caught:
            await client.only_component()
        assert shell.simulated_time_loop().now - began < phase + 0.1
    error = caught.value
    assert str(error) == f"{TEXT} Choose one with the argument system."
    assert error.vehicles == ("1/1 PX4 quadrotor", "2/1 ArduPilot quadrotor")
    assert (error.choose_by, error.summary) == ("system", TEXT)
    assert isinstance(error, UsageError | ValueError)
    assert {type(message) for _, _, message in tap.received} <= {messages.Heartbeat, messages.CommandLong}


async def test_a_named_system_is_returned_although_there_are_several() -> None:
    async with shell.a_client(Air([shell.small_px4(), copter(), shell.small_px4(system=3)])) as client:
        assert (await client.only_component(2)).address == (2, 1)
        assert (await client.only_component(3, 1)).address == (3, 1)
        with pytest.raises(AmbiguousVehicle, match="3 vehicles"):
            await client.only_component(component=1)


async def test_a_time_limit_holds_for_everything() -> None:
    async with shell.a_client(shell.Late(shell.small_px4(), 0.5)) as client:
        with pytest.raises(NoReply, match="an autopilot") as caught:
            await client.only_component(timeout=0.4)
        assert 0.3 < caught.value.waited < 0.5
        with pytest.raises(NoReply, match=r"an autopilot, then 1\.2 s without another vehicle"):
            await client.only_component(timeout=1.0)
        with pytest.raises(NoReply, match="system id 7"):
            await client.only_component(7, timeout=0.1)
        assert (await client.only_component()).address == (1, 1)


async def test_a_vehicle_that_was_lost_is_waited_for() -> None:
    async with shell.a_client(Air([shell.small_px4(), shell.Late(copter(), 0.0, until=2.0)])) as client:
        assert isinstance(await shell.outcome(client.only_component()), AmbiguousVehicle)
        await anyio.sleep(8.0)
        assert client.components[2, 1].state == "lost"
        assert (await client.only_component()).address == (1, 1)
        with pytest.raises(NoReply, match="system id 2"):
            await client.only_component(2, timeout=3.0)


async def test_after_an_absence_of_the_link_a_second_one_is_looked_for_again() -> None:
    link = shell.FlakyLink(Air([shell.small_px4(), copter()]))
    tap = link.endpoint = shell.Tap(Air([shell.small_px4(), shell.Late(copter(), 4.0)]))
    async with shell.a_client(link) as client:
        await client.only_component()
        await link.drop()
        await shell.until(lambda: client.core.link_task.is_disconnected)
        began = shell.simulated_time_loop().now
        found = await client.only_component()
        assert shell.simulated_time_loop().now - began >= HEARTBEAT_WAIT
        assert found.address == (1, 1)
        assert not tap.messages(messages.ParamSet)


# all vehicles, or an expected number


@pytest.mark.parametrize("expect", [4, None])
async def test_all_vehicles_of_a_time_or_an_expected_number_are_found(expect: int | None) -> None:
    """Four vehicles, heard one after the other, and a camera of the first."""
    began = shell.simulated_time_loop().now
    vehicles = [shell.Late(shell.small_px4(system=number), 0.7 * number) for number in (1, 2, 3, 4)]
    async with shell.a_client(Air([*vehicles, shell.generic(system=1, component=100)])) as client:
        found = await client.find_autopilots(expect=expect)
        assert [each.system for each in found] == [1, 2, 3, 4]
        waited = shell.simulated_time_loop().now - began
        assert waited < 3.5 if expect else waited >= VEHICLES_LISTENING_TIME
        assert await client.find_autopilots(expect=4, timeout=0.5) == found
        with pytest.raises(NoReply) as caught:
            await client.find_autopilots(expect=5, timeout=6.0)
        assert ", ".join(f"{system}/1 PX4 quadrotor" for system in (1, 2, 3, 4)) in str(caught.value)
        assert caught.value.waited == pytest.approx(6.0, abs=0.2)
        with pytest.raises(UsageError, match="from 1 up, not 0"):
            await client.find_autopilots(expect=0)
    async with shell.a_client(Air([])) as client:
        with pytest.raises(NoReply):
            await client.find_autopilots(expect=expect, timeout=0.5)


async def test_another_live_peer_is_one_warning_and_forbids_writes(caplog: pytest.LogCaptureFixture) -> None:
    first, second = shell.small_px4(uid=1), shell.Tap(shell.small_px4(uid=2))
    peers: dict[Peer, Endpoint] = {"one": first, "two": second}
    second.is_mute = True
    async with fetched(shell.PeersLink(peers)) as (_, component):
        second.is_mute = False
        await anyio.sleep(3.0)
        for write in (component.set("PARAM_01", 5), component.set_many({"PARAM_01": 5})):
            with pytest.raises(AmbiguousVehicle, match="nothing was written"):
                await write
        assert (first.params["PARAM_01"].value, len(second.messages(object))) == (1, len(second.received))
        assert (await component.get("PARAM_01")).value == 1
        second.is_mute = True
        await anyio.sleep(10.0)
        assert (await component.set("PARAM_01", 5)).actual == 5
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == 1
    assert "two vehicles have the same ids" in warnings[0]


async def test_the_new_connection_of_a_vehicle_has_its_ids_at_once() -> None:
    """As of a vehicle that connects to us again after its TCP connection broke."""
    first = shell.Tap(shell.generic())
    link = shell.PeersLink({"one": first})
    async with fetched(link) as (client, component):
        first.is_mute = True
        client.core.station.receive(b"", "one", anyio.current_time())
        link.endpoints["two"] = shell.generic()
        await anyio.sleep(1.1)
        assert (await component.set("PARAM_01", 5)).actual == 5
