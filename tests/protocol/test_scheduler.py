"""Several components on one link: which are due, whose list runs, and what they make of a link that has no
room for all."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from itertools import pairwise

import anyio
import pytest

from paramclient import ParamClient
from paramclient.errors import LinkError, NoReply
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.scheduler import (
    GROWTH,
    GROWTH_BURSTY,
    JUDGED_TIME,
    JUDGED_VALUES_MIN,
    LIMIT_RECHECK_INTERVAL,
    MEASUREMENT_LIFETIME,
    RETRY_DELAY,
    RETRY_DELAY_BURSTY,
    RETRY_DELAY_MAX,
    STALE_DEADLINES_MAX,
    START_INTERVAL_BURSTY,
    TICKED_COMPONENTS_MAX,
    ListAdmission,
    ListStatistics,
    Scheduler,
)
from paramclient.protocol.wire import ParamRequestList, ParamRequestRead
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle, Vehicle
from tests.shell import Tap, in_simulated_time
from tests.simulation import Simulation

TIMEOUT = 0.2
STEP = 0.01
"""Seconds between two values of the streams here."""


class Lane:
    """A component that waits for a list; `run` delivers the values of the lists that have begun."""

    def __init__(self) -> None:
        self.began_at = math.inf
        self.received = 0
        self.covered = 0
        self.is_bursty = False

    def begin(self, now: float) -> None:
        self.began_at = now

    @property
    def is_awaited(self) -> bool:
        return self.received == 0

    @property
    def silent_at(self) -> float:
        return self.began_at + TIMEOUT if self.is_awaited else math.inf

    @property
    def is_running(self) -> bool:
        return self.began_at < math.inf

    def seen(self) -> ListStatistics:
        return ListStatistics(self.received, self.covered, STEP, self.is_bursty)


class Road:
    """Turns for so many lanes, requested in their order."""

    def __init__(self, lanes: int) -> None:
        self.now = 0.0
        self.turns = ListAdmission()
        self.lanes = [Lane() for _ in range(lanes)]
        for lane in self.lanes:
            self.turns.ask(lane, self.now)

    @property
    def running(self) -> int:
        return sum(lane.is_running for lane in self.lanes)

    def run(self, steps: int = 1, *, room: float = math.inf, silent: int = 0) -> None:
        """Let values arrive, on a link that takes so many lists; the first so many lanes keep silent."""
        for _ in range(steps):
            self.now += STEP
            speaking = [lane for lane in self.lanes[silent:] if lane.is_running]
            for lane in speaking:
                lane.covered += 10
                lane.received += int(10 * min(room / len(speaking), 1.0))
            self.turns.tick(self.now)

    def until(self, wanted: int, *, room: float = math.inf, silent: int = 0, limit: int = 10_000) -> float:
        """Seconds until so many lists run."""
        began = self.now
        for _ in range(limit):
            if self.running >= wanted:
                return self.now - began
            self.run(room=room, silent=silent)
        raise AssertionError(f"{self.running} run")

    def end(self, lane: Lane, *, is_cut: bool = False) -> None:
        """One list is over."""
        lane.began_at = math.inf
        self.turns.release(lane, is_cut=is_cut)


def test_a_list_that_is_alone_begins_at_once() -> None:
    assert Road(1).running == 1


def test_with_room_twice_as_many_run_each_time() -> None:
    road = Road(20)
    seen = [road.running]
    while road.running < 20:
        road.run()
        if road.running != seen[-1]:
            seen.append(road.running)
    assert seen == [1, GROWTH, GROWTH**2, GROWTH**3, GROWTH**4, 20]


def test_where_values_arrive_in_bursts_lists_are_faster() -> None:
    road = Road(100)
    for lane in road.lanes:
        lane.is_bursty = True
    while road.running < GROWTH_BURSTY:
        assert road.running == 1
        road.run()
    assert road.until(GROWTH_BURSTY**2) < 1.0
    assert road.until(100) < 2.0


def bursty(lanes: int) -> Road:
    """A link so fast that the values of a list arrive together."""
    road = Road(lanes)
    for lane in road.lanes:
        lane.is_bursty = True
    return road


def test_where_bursts_are_lost_it_is_tried_again_soon_and_with_as_many_again() -> None:
    road = bursty(100)
    road.until(16)
    failed_at = road.now
    for lane in road.lanes[12:16]:
        road.end(lane, is_cut=True)
    assert road.running == 12
    while road.now < failed_at + RETRY_DELAY_BURSTY - STEP:
        road.run()
        assert road.running <= 16, "no more than before"
    assert road.until(32) < 2 * RETRY_DELAY_BURSTY < RETRY_DELAY


def test_many_that_are_cut_at_once_have_failed_once() -> None:
    """They were cut for one want of room: neither are fewer allowed for each, nor is it waited for longer."""
    road = bursty(100)
    road.until(32)
    failed_at = road.now
    for lane in road.lanes[:20]:
        road.end(lane, is_cut=True)
    road.until(31)
    while road.now < failed_at + RETRY_DELAY_BURSTY - STEP:
        road.run()
        assert road.running == 31, "that of the first, without it"
    road.until(40)
    assert road.now - failed_at < 2 * RETRY_DELAY_BURSTY


def test_where_all_of_many_bursts_lose_half_as_many_run() -> None:
    """None of them received before the others, so nothing says how many of them have room."""
    road = bursty(100)
    road.until(32)
    road.end(road.lanes[31], is_cut=True)
    road.run(round(RETRY_DELAY_BURSTY / STEP) - 2)
    road.run(10, room=16)
    running = [lane for lane in road.lanes if lane.is_running]
    assert len(running) == 31
    for ended, lane in enumerate(running):
        road.end(lane)
        road.turns.tick(road.now)
        if road.running >= 31 - ended:
            break  # another one has begun
    assert road.running == 31 // 2


def test_while_all_bursts_are_awaited_nothing_is_due() -> None:
    """Those that took the place of others are not new, so there is nothing to measure before one arrives."""
    road = Road(40)
    for lane in road.lanes:
        lane.is_bursty = True
    road.until(8)
    for lane in [lane for lane in road.lanes if lane.is_running]:
        road.end(lane)
    while road.turns.next_deadline() <= road.now:
        road.turns.tick(road.now)
    road.turns._limit = road.running  # as many as run
    road.turns._newest.clear()
    assert all(lane.is_awaited for lane in road.lanes if lane.is_running)
    road.turns.tick(road.now)
    assert road.turns.next_deadline() > road.now


def test_a_list_in_the_place_of_another_delays_none() -> None:
    """Where so many have run before, it need not have shown anything for further ones to begin."""
    road = bursty(100)
    road.until(32)
    failed_at = road.now
    road.end(road.lanes[31], is_cut=True)
    while road.now < failed_at + RETRY_DELAY_BURSTY - 5 * STEP:
        road.run()
    road.end(road.lanes[0])
    road.turns.tick(road.now)
    late = next(lane for lane in reversed(road.lanes) if lane.is_running)
    assert late.is_awaited
    waiting = road.lanes
    road.lanes = [lane for lane in waiting if lane is not late]  # no result
    road.until(40)
    assert road.now < late.silent_at


def test_bursts_begin_one_after_the_other_beyond_the_first_few() -> None:
    """They bring nothing at first, and all together would bring more than can be read."""
    road = bursty(100)
    road.until(GROWTH_BURSTY)
    while road.running == GROWTH_BURSTY:
        road.run()
    while road.running < 60:
        running, road.now = road.running, road.turns.next_deadline()
        road.turns.tick(road.now)
        road.run(0)
        if road.running == running:  # it is time to look whether these have room
            road.run()
        assert running <= road.running <= running + 1
        began = sorted(lane.began_at for lane in road.lanes if lane.is_running)
        assert began[-1] - began[-2] >= START_INTERVAL_BURSTY * (len(began) - 1) - 1e-9


def test_a_later_list_waits_for_the_next_one_as_well() -> None:
    road = bursty(40)
    road.until(40)
    late = [Lane() for _ in range(10)]
    for lane in late:
        road.turns.ask(lane, road.now)
    assert sum(lane.is_running for lane in late) <= 1


def test_no_list_begins_beside_others_while_unread_data_is_waiting() -> None:
    road = bursty(20)
    road.until(GROWTH_BURSTY)
    for lane in road.lanes[1:GROWTH_BURSTY]:
        road.end(lane)
    for _ in range(50):
        road.now += STEP
        road.lanes[0].received += 10
        road.lanes[0].covered += 10
        assert not road.turns.tick(road.now, lists_max=1)
    assert road.running == 1
    road.end(road.lanes[0])
    assert road.turns.tick(road.now, lists_max=1), "else it would wait without end"
    assert road.running == 1
    road.run()
    assert road.running == GROWTH_BURSTY


def test_no_list_begins_before_the_running_ones_are_judged() -> None:
    road = Road(2)
    road.run()
    while road.lanes[0].received < JUDGED_VALUES_MIN:
        assert road.running == 1
        road.run()


def test_without_room_no_more_run_than_before() -> None:
    road = Road(8)
    road.until(2, room=1.2)
    road.run(100, room=1.2)
    assert road.running == 2
    road.end(road.lanes[0])
    road.run(room=1.2)
    assert road.running == 1  # and not two again
    road.end(road.lanes[1])
    road.run(room=1.2)
    assert sum(lane.is_running for lane in road.lanes[2:]) == 1


def test_slower_lists_end_the_growth_of_parallel_lists() -> None:
    road = Road(8)
    while road.running < 2:
        road.run()
    for _ in range(100):
        road.now += STEP
        for lane in road.lanes[:2]:
            lane.covered += 5
            lane.received += 5
        road.turns.tick(road.now)
    road.end(road.lanes[0])
    road.run()
    assert road.running == 1


def test_one_more_is_tried_a_while_after_there_was_no_room() -> None:
    road = Road(8)
    road.until(2, room=1.2)
    road.run(50, room=1.2)
    road.end(road.lanes[0])
    waited = road.until(2)
    assert RETRY_DELAY / 2 < waited < 2 * RETRY_DELAY


def test_where_there_is_never_room_it_is_tried_ever_more_seldom() -> None:
    road = Road(100)
    tried = []
    for _ in range(6):
        road.until(2, room=1.0)
        tried.append(road.now)
        road.run(50, room=1.0)
        for lane in [lane for lane in road.lanes if lane.is_running][1:]:
            road.end(lane)
            lane.received = lane.covered = 0
            road.turns.ask(lane, road.now)
    waits = [later - sooner for sooner, later in pairwise(tried)]
    assert waits == sorted(waits)
    assert waits[1] > 1.5 * waits[0]
    assert waits[-1] <= RETRY_DELAY_MAX + RETRY_DELAY


def test_a_link_that_loses_much_anyway_has_room_all_the_same() -> None:
    road = Road(20)
    for _ in range(1000):
        road.now += STEP
        for lane in road.lanes:
            if lane.is_running:
                lane.covered += 10
                lane.received += 6
        road.turns.tick(road.now)
    assert road.running == 20


def test_a_silent_one_holds_the_turn_for_no_longer_than_its_time_out() -> None:
    road = Road(3)
    assert road.turns.next_deadline() == TIMEOUT
    road.turns.tick(TIMEOUT - 0.01)
    assert road.running == 1
    road.turns.tick(TIMEOUT)
    assert road.running == 1 + GROWTH


def test_many_silent_ones_do_not_wait_for_each_other() -> None:
    road = Road(64)
    assert road.until(64, silent=64) < 9 * TIMEOUT + 6 * JUDGED_TIME


def test_a_slow_one_does_not_hold_up_the_others() -> None:
    road = Road(40)
    slow = road.lanes[0]
    while road.running < 40 and road.now < 60.0:
        road.now += STEP
        slow.received = slow.covered = 1 + int(road.now)
        for lane in road.lanes[1:]:
            if lane.is_running:
                lane.covered += 10
                lane.received += 10
        road.turns.tick(road.now)
    assert road.now < 3.0


def test_a_list_that_stops_beside_others_ends_the_growth_of_parallel_lists() -> None:
    road = Road(8)
    road.until(4)
    road.end(road.lanes[3], is_cut=True)
    road.run(50)
    assert road.running == 3


def test_a_list_that_stops_alone_changes_no_limit() -> None:
    road = Road(8)
    road.run(2)
    road.end(road.lanes[0], is_cut=True)
    road.run(50)
    assert road.running >= 2


def test_a_turn_released_while_waiting_is_dropped() -> None:
    road = Road(3)
    road.turns.release(road.lanes[1])
    road.end(road.lanes[0])
    road.run()
    assert [lane.is_running for lane in road.lanes] == [False, False, True]
    road.turns.release(road.lanes[1])  # it is no longer there; that does no harm


def test_measurements_expire_without_a_list() -> None:
    road = Road(4)
    road.until(2, room=1.0)
    road.run(50, room=1.0)
    for lane in road.lanes:
        road.end(lane)
        lane.received = lane.covered = 0
    road.now += MEASUREMENT_LIFETIME + 1
    for lane in road.lanes:
        road.turns.ask(lane, road.now)
    assert road.until(4) < RETRY_DELAY


def test_deadlines_always_lie_ahead_or_something_happens() -> None:
    road = Road(30)
    for step in range(3000):
        deadline = road.turns.next_deadline()
        if deadline <= road.now:
            before = (road.running, road.turns.next_deadline())
            road.turns.tick(road.now)
            assert (road.running, road.turns.next_deadline()) != before
        else:
            road.run(room=3.0, silent=2)
        if step % 400 == 0:
            road.end(next(lane for lane in road.lanes if lane.is_running))


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


def test_a_program_that_stays_behind_follows_one_after_the_other() -> None:
    vehicles = [PX4Vehicle(system=system, table=table(60)) for system in range(1, 5)]
    world = Simulation(*vehicles)
    world.station.scheduler.lists_max = 1
    fetches = begin_all(world, 4)
    while not all(fetch.done for fetch in fetches):
        world.run(0.005)
        ended = sum(fetch.done for fetch in fetches)
        assert len(world.sent_of(ParamRequestList)) <= ended + 1
    assert all(fetch.result is not None and fetch.result.complete for fetch in fetches)


def test_upstream_all_reads_together_stay_under_a_third_of_the_link() -> None:
    vehicles = [MAKES["PX4"](system) for system in range(1, 6)]
    world = a_radio(vehicles, loss=0.15, seed=5)
    fetches = begin_all(world, 5)
    began, sent = world.now, world.station.bytes_sent
    world.until(lambda: all(fetch.done for fetch in fetches), 300.0)
    assert (world.station.bytes_sent - sent) / (world.now - began) < 5760 / 3
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


def test_a_list_for_another_station_fills_the_table_of_a_waiting_fetch() -> None:
    vehicles = [MAKES["ArduPilot"](1), MAKES["PX4"](2)]
    world = a_radio(vehicles)
    slow, waiting = begin_all(world, 2)
    world.other_station(ParamRequestList(2, 1))
    world.until(lambda: waiting.done)
    assert waiting.result is not None
    assert waiting.result.complete
    world.until(lambda: slow.done)
    assert slow.result is not None
    assert slow.result.complete


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


async def is_given_up(system: int) -> float:
    """After how many seconds a vehicle that receives nothing is given up."""
    vehicle = Tap(PX4Vehicle(system=system, table=table(10)))
    vehicle.is_deaf = True
    async with ParamClient(vehicle, cache=False) as client:
        began = anyio.current_time()
        component = await client.component()
        with pytest.raises(NoReply):
            await component.fetch_all()
        return anyio.current_time() - began


@in_simulated_time
async def test_silent_lists_on_two_links_do_not_wait_for_each_other() -> None:
    alone = await is_given_up(1)
    with anyio.fail_after(2 * alone):
        both = await asyncio.gather(is_given_up(1), is_given_up(2))
    assert both == pytest.approx([alone, alone], abs=0.01)


def test_a_silent_list_delays_none_where_the_program_has_time_for_one() -> None:
    road = Road(2)
    road.now += TIMEOUT / 2
    assert not road.turns.tick(road.now, lists_max=1)
    assert road.turns.awaited(road.now) == 1
    road.now += TIMEOUT
    assert road.turns.awaited(road.now) == 0
    assert road.turns.tick(road.now, lists_max=1)


def test_only_lists_on_other_links_are_parallel() -> None:
    road = Road(1)
    [lane] = road.lanes
    road.turns.tick(road.now, lists_max=1)
    assert not road.turns.is_parallel_to_others(lane), "those may be awaited for ever"
    road.turns.tick(road.now, lists_max=1, is_crowded=True)
    assert road.turns.is_parallel_to_others(lane)
    assert road.turns.parallel_to_others_at(lane) == road.now


class Timer:
    """A component with a single deadline, which its `tick` ends.

    Args:
        scheduler: handles it.
        due: its deadline.
    """

    def __init__(self, scheduler: Scheduler, due: float = math.inf) -> None:
        self.due = due
        self.ticked: list[float] = []
        self.looks = 0
        self.is_waiting = self.is_busy = False
        self._reschedule = scheduler.reporter(self)
        scheduler.add(self)

    def set(self, due: float) -> None:
        self.due = due
        self._reschedule()

    def tick(self, now: float) -> None:
        self.ticked.append(now)
        self.due = math.inf

    def next_deadline(self) -> float:
        self.looks += 1
        return self.due


def state_of(scheduler: Scheduler) -> tuple[bool, bool]:
    return scheduler.is_waiting, scheduler.is_busy


def test_a_component_is_handled_at_its_deadline_and_looked_at_after_changes_only() -> None:
    scheduler = Scheduler()
    timers = [Timer(scheduler, due) for due in (3.0, 1.0, math.inf)]
    assert scheduler.next_deadline() == 1.0
    scheduler.tick(1.0)
    assert [timer.ticked for timer in timers] == [[], [1.0], []]
    assert scheduler.next_deadline() == 3.0
    timers[2].set(2.0)
    assert scheduler.next_deadline() == 2.0
    timers[2].set(5.0)
    assert scheduler.next_deadline() == 3.0, "the earlier deadline is stale"
    scheduler.tick(10.0)
    assert [timer.ticked for timer in timers] == [[10.0], [1.0], [10.0]]
    assert scheduler.next_deadline() == math.inf
    assert [timer.looks for timer in timers] == [2, 2, 4]


def test_a_deadline_that_returns_is_handled_once() -> None:
    scheduler = Scheduler()
    timer = Timer(scheduler, 1.0)
    for due in (2.0, 1.0, 2.0, 1.0):
        timer.set(due)
        scheduler.next_deadline()
    scheduler.tick(5.0)
    scheduler.tick(5.0)
    assert timer.ticked == [5.0]


def test_a_removed_component_is_not_handled_any_more() -> None:
    scheduler = Scheduler()
    gone, other = Timer(scheduler, 1.0), Timer(scheduler, 2.0)
    gone.is_waiting = gone.is_busy = True
    assert scheduler.next_deadline() == 1.0
    assert state_of(scheduler) == (True, True)
    scheduler.remove(gone)
    gone.set(0.5)
    assert scheduler.next_deadline() == 2.0
    assert state_of(scheduler) == (False, False)
    scheduler.tick(3.0)
    assert not gone.ticked
    assert other.ticked == [3.0]


def test_many_due_components_are_handled_in_parts_the_most_overdue_first() -> None:
    scheduler = Scheduler()
    timers = [Timer(scheduler, 1000.0 - number) for number in range(TICKED_COMPONENTS_MAX + 10)]
    scheduler.tick(2000.0)
    assert [timer for timer in timers if not timer.ticked] == timers[:10]
    assert scheduler.next_deadline() <= 2000.0, "due again at once"
    scheduler.tick(2000.0)
    assert all(timer.ticked for timer in timers)


def test_deadlines_that_move_often_take_no_memory() -> None:
    scheduler = Scheduler()
    timer, _ = Timer(scheduler), Timer(scheduler, 1.0)
    for due in range(1000, 0, -1):
        timer.set(2.0 + due)
        assert scheduler.next_deadline() == 1.0
        assert len(scheduler._order) <= STALE_DEADLINES_MAX * 3
    timer.set(0.5)
    assert scheduler.next_deadline() == 0.5


def test_a_list_that_the_event_loop_does_not_permit_is_tried_again_soon() -> None:
    scheduler, lanes = Scheduler(), [Lane(), Lane()]
    scheduler.lists_max = 1
    for lane in lanes:
        scheduler.list_admission.ask(lane, 0.0)
        lane.covered = lane.received = JUDGED_VALUES_MIN
    now = 0.0
    for _ in range(100):
        now += STEP
        lanes[0].covered += 10
        lanes[0].received += 10
        scheduler.tick(now)
        assert now < scheduler.next_deadline() <= now + max(JUDGED_TIME, LIMIT_RECHECK_INTERVAL)
    assert not lanes[1].is_running
    scheduler.lists_max = math.inf
    scheduler.tick(now)
    assert lanes[1].is_running
