"""Several components on one link: which are due, whose list runs, and what they make of a link that has no
room for all."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest
from paramclient.protocol.params.fetch import Fetch

from paramclient import ParamClient
from paramclient.errors import LinkError, NoReply
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle, Vehicle
from paramclient.wire.messages import ParamRequestList, ParamRequestRead
from tests.shell import in_simulated_time
from tests.simulation import Simulation

# whole sessions

MAKES: dict[str, Callable[[int], Vehicle]] = {
    "PX4": lambda system: PX4Vehicle(system=system, table=table(150), burst=3, period=0.025),
    "ArduPilot": lambda system: ArduPilotVehicle(
        ftp=False, system=system, table=table(150), burst=1, period=0.025
    ),
}


def table(size: int) -> dict[str, int]:
    return {f"P{number:04d}": number for number in range(size)}


def a_radio(vehicles: list[Vehicle], *, loss: float = 0.0, seed: int = 0) -> Simulation:
    """A radio at 57600 baud that all share."""
    faults = {"loss": loss, "delay": 0.075, "rate": 5760.0}
    up, down = (FaultyLink(**faults, queue=1024, seed=2 * seed + each) for each in (1, 2))
    return Simulation(air=Air(vehicles, uplink=up, downlink=down))


def begin_all(world: Simulation, count: int) -> list[Fetch]:
    """Begin a fetch of every vehicle at once."""
    machines = world.station.components
    world.until(
        lambda: len(machines) == count and all(each.identification.settled for each in machines.values())
    )
    return [machine.begin_fetch(world.now) for machine in machines.values()]


def time_of(make: Callable[[int], Vehicle], count: int, *, loss: float, seed: int) -> float:
    """Seconds until so many vehicles are fetched that share a radio, all complete and right."""
    vehicles = [make(system) for system in range(1, count + 1)]
    world = a_radio(vehicles, loss=loss, seed=seed)
    fetches = begin_all(world, count)
    began = world.now
    world.until(lambda: all(fetch.done for fetch in fetches), 300.0)
    for vehicle, fetch in zip(vehicles, fetches, strict=True):
        assert fetch.result is not None
        assert fetch.result.complete
        assert {name: param.value for name, param in fetch.result.params.items()} == vehicle.values
    return world.now - began


@pytest.mark.parametrize("kind", MAKES)
@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_five_vehicles_on_one_radio_take_no_longer_than_five_single_ones(kind: str, loss: float) -> None:
    alone = time_of(MAKES[kind], 1, loss=loss, seed=3)
    assert time_of(MAKES[kind], 5, loss=loss, seed=3) <= 1.1 * 5 * alone


def test_many_vehicles_on_a_fast_link_are_hardly_slower_than_one() -> None:
    vehicles = [PX4Vehicle(system=system, table=table(300)) for system in range(1, 31)]
    world = Simulation(*vehicles)
    fetches = begin_all(world, 30)
    began = world.now
    world.until(lambda: all(fetch.done for fetch in fetches))
    assert world.now - began < 0.3 + 0.15  # one takes 0.3 s
    assert all(fetch.result is not None and fetch.result.complete for fetch in fetches)


def lists(world: Simulation, system: int) -> int:
    return sum(message.target_system == system for message in world.sent_of(ParamRequestList))


def test_a_read_is_never_held_up() -> None:
    world = a_radio([MAKES["PX4"](system) for system in (1, 2)])
    fetches = begin_all(world, 2)
    world.run(0.05)
    assert [lists(world, system) for system in (1, 2)] == [1, 0]
    read = world.station.components[2, 1].read("P0003", world.now)
    world.until(lambda: read.done, 1.0)
    assert read.result is not None
    assert not fetches[0].done


def test_a_list_that_waits_for_its_turn_is_not_silent_and_gives_it_back() -> None:
    world = a_radio([MAKES["ArduPilot"](system) for system in (1, 2, 3)])
    first, second, third = begin_all(world, 3)
    world.run(0.3)
    assert not second.is_silent
    assert second.queue_wait(world.now) == pytest.approx(0.3)
    assert first.queue_wait(world.now) == 0.0
    with pytest.raises(NoReply) as caught:
        second.partial(world.now, "")
    assert caught.value.attempts == 0
    assert caught.value.waited == pytest.approx(0.3)
    world.station.components[2, 1].end_fetch(second, world.now)
    world.station.components[1, 1].end_fetch(first, world.now)
    world.run(0.0)
    assert [lists(world, system) for system in (1, 2, 3)] == [1, 0, 1]
    world.until(lambda: third.done)
    assert third.result is not None
    assert third.result.complete


def test_the_turns_go_on_when_the_link_was_disconnected() -> None:
    world = a_radio([MAKES["ArduPilot"](system) for system in (1, 2)])
    fetches = begin_all(world, 2)
    world.run(0.2)
    world.station.pause()
    world.run(30.0)
    world.station.resume(world.now)
    world.until(lambda: all(fetch.done for fetch in fetches))
    assert all(fetch.result is not None and fetch.result.complete for fetch in fetches)


def test_when_the_link_has_ended_no_list_waits() -> None:
    world = a_radio([MAKES["ArduPilot"](system) for system in (1, 2)])
    fetches = begin_all(world, 2)
    world.run(0.2)
    error = LinkError("gone", link="x")
    world.station.fail_all(error, world.now)
    assert [fetch.error for fetch in fetches] == [error, error]
    world.run(5.0)
    again = begin_all(world, 2)
    world.until(lambda: all(fetch.done for fetch in again))
    assert all(fetch.result is not None and fetch.result.complete for fetch in again)


def test_a_starved_vehicle_is_not_given_up_while_the_lists_of_others_fill_the_link() -> None:
    quick = ArduPilotVehicle(ftp=False, system=1, table=table(1400), burst=1, period=0.025)  # 35 s
    starved = PX4Vehicle(system=2, table=table(40), burst=1, period=0.3)
    world = a_radio([quick, starved])
    first, second = begin_all(world, 2)
    world.until(lambda: second.download is not None and second.download.received > 3)
    received = world.station.components[2, 1].round_trip
    hold = world.air.downlink.send

    def starve(data: bytes, now: float) -> None:
        if data[5] != 2:  # the sender's system
            hold(data, now)

    world.air.downlink.send = starve  # type: ignore[method-assign]  # no fault of the link's picks a vehicle
    world.until(lambda: first.done)
    assert not second.done
    world.air.downlink.send = hold  # type: ignore[method-assign]
    world.until(lambda: second.done)
    assert second.result is not None
    assert second.result.complete
    assert received.loss > 0.0
    assert len(world.sent_of(ParamRequestRead)) > 0


@in_simulated_time
async def test_the_time_limit_of_a_fetch_holds_while_it_waits_for_its_turn() -> None:
    slow, quick = (
        PX4Vehicle(system=1, table=table(40), burst=1, period=0.1),
        PX4Vehicle(system=2, table=table(40)),
    )
    async with ParamClient(Air.symmetric([slow, quick], delay=0.02), cache=False) as client:
        first, second = await client.component(1), await client.component(2)
        await asyncio.sleep(1.0)
        began = asyncio.get_running_loop().time()
        running = asyncio.create_task(first.fetch_all())
        await asyncio.sleep(0)
        with pytest.raises(NoReply) as caught:
            await second.fetch_all(timeout=0.3)
        assert asyncio.get_running_loop().time() - began == pytest.approx(0.3, abs=0.01)
        assert caught.value.attempts == 0
        assert caught.value.waited == pytest.approx(0.3, abs=0.01)
        assert (await second.fetch_all()).complete
        assert (await running).complete


@in_simulated_time
async def test_a_cancelled_fetch_makes_room_at_once() -> None:
    vehicles = [MAKES["ArduPilot"](system) for system in (1, 2)]
    async with ParamClient(Air.symmetric(vehicles, delay=0.02, rate=5760.0), cache=False) as client:
        first, second = await client.component(1), await client.component(2)
        await asyncio.sleep(1.0)
        began = asyncio.get_running_loop().time()
        leaving = asyncio.create_task(first.fetch_all())
        await asyncio.sleep(0.1)
        waiting = asyncio.create_task(second.fetch_all())
        await asyncio.sleep(0.1)
        assert vehicles[1].requests["PARAM_REQUEST_LIST"] == 0
        leaving.cancel()
        await asyncio.sleep(0.05)
        assert vehicles[1].requests["PARAM_REQUEST_LIST"] == 1
        assert (await waiting).complete
        assert asyncio.get_running_loop().time() - began < 6.0
