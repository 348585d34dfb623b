"""Suspend and resume: the computer sleeps, and vehicles go on without us."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import anyio
import pytest
from paramclient.client.suspend_detection import SUSPEND_MIN, SuspendDetector, time_asleep
from paramclient.protocol.vehicle.presence import Presence

from paramclient import Component, Event, Events, Lost, NoReply, Rebooted, Resynced, SyncState, Trust
from paramclient.client import suspend_detection
from paramclient.sim import Air, Endpoint
from paramclient.wire.messages import ParamSet, SystemTime
from tests.shell import (
    FlakyLink,
    Tap,
    a_client,
    bits,
    in_simulated_time,
    simulated_time_loop,
    small_px4,
    until,
)

HOURS = 3 * 3600.0

Sleep = Callable[[float], None]


@pytest.fixture(params=["the clock goes on", "the clock stands still"])
def sleep(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Sleep:
    """What a suspended computer looks like from inside, on Windows and on the others."""
    asleep = 0.0
    monkeypatch.setattr(suspend_detection, "time_asleep", lambda: asleep)

    def fall_asleep(seconds: float) -> None:
        nonlocal asleep
        if request.param == "the clock goes on":
            simulated_time_loop().now += seconds
        else:
            asleep += seconds

    return fall_asleep


class Berth(Tap):
    """An address that one vehicle takes after the other."""

    def moor(self, vehicle: Endpoint) -> None:
        self._endpoint = vehicle


def drained(events: Events) -> list[Event]:
    waiting = list(events._waiting)
    events._waiting.clear()
    return waiting


def trusts(component: Component) -> set[Trust]:
    return {param.trust for param in component.params.values()}


@in_simulated_time
async def test_a_change_during_a_suspend_is_found_and_no_component_is_lost(sleep: Sleep) -> None:
    tap = Tap(vehicle := small_px4())
    async with a_client(tap) as client:
        component = await client.component()
        await component.fetch_all()
        await anyio.sleep(10.0)
        events = client.events()
        tap.is_mute = True  # the radio wakes up later
        vehicle.set_param("PARAM_01", 1001)
        sleep(HOURS)
        await until(lambda: component.sync_state is SyncState.CHECKING)
        assert trusts(component) == {Trust.CACHED}
        await anyio.sleep(1.2)
        tap.is_mute = False
        await anyio.sleep(6.0)
        assert drained(events) == [Resynced(component, ("PARAM_01",), vehicle.announced_hash())]
        assert bits(component.params) == bits(vehicle.params)
        assert Trust.CACHED not in trusts(component)


@in_simulated_time
async def test_requests_of_waiting_calls_are_repeated(sleep: Sleep) -> None:
    tap = Tap(vehicle := small_px4())
    async with a_client(tap) as client, asyncio.TaskGroup() as tasks:
        component = await client.component()
        await component.fetch_all()
        events = client.events()
        tap.is_deaf = tap.is_mute = True
        reading = tasks.create_task(component.get("PARAM_01"))
        writing = tasks.create_task(component.set("PARAM_02", 22))
        await anyio.sleep(0.1)
        sleep(HOURS)
        await anyio.sleep(2.5)  # the radio, too, wakes up only now
        tap.is_deaf = tap.is_mute = False
        assert (await reading).value == 1
        assert (await writing).actual == 22
        assert vehicle.params["PARAM_02"].value == 22
        await anyio.sleep(5.0)
        assert not any(isinstance(event, Lost) for event in drained(events))


@pytest.mark.parametrize("at", [0.0, 0.2, 0.5])
@in_simulated_time
async def test_a_fetch_that_is_under_way_goes_on(sleep: Sleep, at: float) -> None:
    """The hash at the head of the list was announced before: it says nothing of what has changed since."""
    tap = Tap(vehicle := small_px4(burst=1, period=0.04))
    async with a_client(tap) as client, asyncio.TaskGroup() as tasks:
        component = await client.component()
        fetching = tasks.create_task(component.fetch_all())
        await anyio.sleep(at)
        tap.is_mute = True
        vehicle.set_param("PARAM_00", 77)
        sleep(HOURS)
        woken = anyio.current_time()
        await anyio.sleep(1.0)
        tap.is_mute = False
        assert (await fetching).complete
        assert anyio.current_time() - woken < 10.0
        for name, param in component.params.items():
            assert param.trust is Trust.CACHED or param.bits == vehicle.params[name].bits
        await anyio.sleep(15.0)
        assert component.sync_state is SyncState.SYNCED
        assert bits(component.params) == bits(vehicle.params)


@in_simulated_time
async def test_a_write_does_not_reach_another_vehicle_at_the_address(sleep: Sleep) -> None:
    berth = Berth(small_px4(uid=1))
    stranger = small_px4(uid=2)
    async with a_client(berth) as client, asyncio.TaskGroup() as tasks:
        component = await client.component()
        await component.fetch_all()
        berth.is_deaf = True
        writing = tasks.create_task(_error_of(component, "PARAM_02", 22))
        await anyio.sleep(0.1)
        berth.received.clear()
        berth.moor(stranger)
        berth.is_deaf = False
        sleep(HOURS)
        assert "another vehicle" in str(await writing)
        assert berth.messages(ParamSet) == []
        assert stranger.params["PARAM_02"].value == 2


@in_simulated_time
async def test_nor_does_a_list_that_is_requested_before_the_loss_is_detected(sleep: Sleep) -> None:
    berth = Berth(small_px4(uid=1))
    async with a_client(berth) as client:
        component = await client.component()
        await component.fetch_all()
        sleep(HOURS)
        berth.moor(small_px4(uid=2))
        assert "another vehicle" in str(await _error_of(component, "PARAM_02", 22))
        assert berth.messages(ParamSet) == []


@in_simulated_time
async def test_a_vehicle_gone_during_a_suspend_is_lost_soon_with_few_requests(sleep: Sleep) -> None:
    tap = Tap(small_px4())
    async with a_client(tap) as client, asyncio.TaskGroup() as tasks:
        component = await client.component()
        await component.fetch_all()
        events = client.events()
        tap.is_deaf = tap.is_mute = True
        reads = [tasks.create_task(_error_of(component, f"PARAM_{number:02}")) for number in range(20)]
        await anyio.sleep(0.1)
        tap.received.clear()
        sleep(HOURS)
        woken = anyio.current_time()
        async for event in events:
            if isinstance(event, Lost):
                break
        assert 4.5 < anyio.current_time() - woken < 6.5
        tries, others = 7, 40  # while it counts as present; heartbeats, and what identifies it
        assert len(tap.received) < 20 * tries + others, (
            "twenty reads, each with its tries and none beside them"
        )
        for read in reads:
            assert isinstance(await read, NoReply)
        tap.received.clear()
        await anyio.sleep(60.0)
        assert len(tap.received) < 65, "our heartbeat, and nothing else"


@in_simulated_time
async def test_a_vehicle_that_started_again_meanwhile(sleep: Sleep) -> None:
    """Its clock is lower than before, and higher than the elapsed time of ours."""
    berth = Berth(small_px4(uid=1))
    async with a_client(berth) as client:
        component = await client.component()
        await component.fetch_all()
        await anyio.sleep(100.0)
        events = client.events()
        sleep(HOURS)
        restarted = small_px4(uid=1)
        restarted.tick(anyio.current_time() - 60.0)
        restarted.data_to_send()
        berth.moor(restarted)
        await anyio.sleep(4.0)
        reported = drained(events)
        assert Rebooted(component) in reported


@in_simulated_time
async def test_a_link_that_is_disconnected_at_the_suspend_of_the_computer(sleep: Sleep) -> None:
    """The vehicle was lost for hours, although our clock may show a second."""
    vehicle = small_px4()
    link = FlakyLink(Air.symmetric([vehicle], delay=0.05))
    async with a_client(link) as client:
        component = await client.component()
        await component.fetch_all()
        events = client.events()
        await link.drop(stays_offline=True)
        await anyio.sleep(0.1)
        vehicle.set_param("PARAM_01", 1001)
        sleep(HOURS)
        link.is_offline = False
        await until(lambda: component.state == "cached")
        await anyio.sleep(5.0)
        assert drained(events) == [Resynced(component, ("PARAM_01",), vehicle.announced_hash())]


async def _error_of(component: Component, name: str, value: float | None = None) -> Exception | None:
    try:
        await (component.get(name) if value is None else component.set(name, value))
    except NoReply as error:
        return error
    return None


# The clocks
