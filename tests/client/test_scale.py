"""Many vehicles on one link: nothing is done for all of them that one of them is the reason of."""

from __future__ import annotations

import asyncio
import gc
import inspect
import math
import time
import weakref
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import anyio
import anyio.lowlevel
import pytest
from paramclient.client.loop_scheduler import TURN_MAX
from paramclient.client.suspend_detection import SUSPEND_MIN
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params.fetch import Fetch

from paramclient import ParamCache, ParamClient
from paramclient.cache import CachedComponent
from paramclient.client import link_task, loop_scheduler
from paramclient.client.link_task import LOOP_LATENCY_MIN, TIMEOUT_DELAY_MAX, LinkTask
from paramclient.links import Peer
from paramclient.model.values import ParamType
from paramclient.protocol import scheduler, wire
from paramclient.protocol import station as station_room
from paramclient.protocol.events import ComponentLost
from paramclient.protocol.station import Station
from paramclient.sim import Air, ArduPilotVehicle, Endpoint, PX4Vehicle, SimParam, Vehicle
from paramclient.wire.messages import MAV_AUTOPILOT_PX4, Heartbeat
from tests.shell import Tap, in_simulated_time, simulated_time_loop

MANY = 250
PX4 = Heartbeat(2, MAV_AUTOPILOT_PX4)


def hear(station: Station, system: int, now: float) -> None:
    frame = wire.encode(PX4, system=system, component=1, sequence=0)
    station.receive(frame, "peer", now)


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> Counter[int]:
    """How often the deadlines of each system were worked out."""
    looks: Counter[int] = Counter()
    whole = ComponentMachine.next_deadline

    def counted(machine: ComponentMachine) -> float:
        looks[machine.system] += 1
        return whole(machine)

    monkeypatch.setattr(ComponentMachine, "next_deadline", counted)
    return looks


def test_a_message_of_one_component_examines_no_other(looks: Counter[int]) -> None:
    station = Station(link="x", is_stream=False)
    for system in range(1, MANY + 1):
        hear(station, system, 0.0)
    station.tick(0.0)
    station.next_deadline()
    looks.clear()
    hear(station, 7, 0.1)
    station.tick(0.1)
    station.next_deadline()
    assert set(looks) == {7}
    assert looks[7] <= 3


def test_a_deadline_is_kept_whichever_component_was_processed_meanwhile() -> None:
    """The identity of components that do not respond is requested again in time."""
    station = Station(link="x", is_stream=False)
    for system in range(1, 11):
        hear(station, system, system / 100)
    station.tick(0.1)
    station.data_to_send()
    assert station.next_deadline() == 0.26  # the first timeout, 0.25 s
    requested: list[tuple[float, int]] = []
    now = 0.1
    while len(set(requested)) < 10:
        now = station.next_deadline()
        station.tick(now)
        for data, _ in station.data_to_send():
            for frame in wire.Framer(wire.DECODED_IDS, stream=False).receive(data):
                message = wire.decode(frame)
                if isinstance(message, wire.CommandLong):
                    requested.append((round(now, 3), message.target_system))
    assert sorted(set(requested)) == [(round(0.25 + system / 100, 3), system) for system in range(1, 11)]


def test_a_request_makes_its_component_due() -> None:
    station = Station(link="x", is_stream=False)
    hear(station, 1, 0.0)
    hear(station, 2, 0.0)
    station.tick(0.0)
    station.next_deadline()
    machine = station.components[2, 1]
    for index in range(40):  # more than may go out at once
        machine.reads.ask(index, 0.0)
    assert station.next_deadline() == pytest.approx(machine.reads.pace.next_at())
    assert station.next_deadline() == min(each.next_deadline() for each in station.components.values())


def test_one_tick_handles_a_part_of_many_due_components() -> None:
    station = Station(link="x", is_stream=False)
    for system in range(1, MANY + 1):
        hear(station, system, 0.0)
    station.events()
    ticks = 0
    now = 100.0  # all of them are lost by now
    while station.next_deadline() <= now:
        station.tick(now)
        ticks += 1
        lost = [event for event in station.events() if isinstance(event, ComponentLost)]
        assert len(lost) <= scheduler.TICKED_COMPONENTS_MAX
    assert all(machine.presence.is_lost for machine in station.components.values())
    assert ticks >= MANY / scheduler.TICKED_COMPONENTS_MAX


def test_deadlines_of_many_are_evaluated_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    station = Station(link="x", is_stream=False)
    for system in range(1, MANY + 1):
        hear(station, system, 0.0)
    station.tick(0.0)
    while station.next_deadline() <= 0.0:
        station.tick(0.0)
    evaluated: list[ComponentMachine] = []
    next_deadline = ComponentMachine.next_deadline

    def evaluate(machine: ComponentMachine) -> float:
        evaluated.append(machine)
        return next_deadline(machine)

    monkeypatch.setattr(scheduler, "EXAMINED_COMPONENTS_MAX", MANY // 5)
    monkeypatch.setattr(ComponentMachine, "next_deadline", evaluate)
    station.scheduler.reschedule_all()
    for part in range(1, 6):
        assert len(evaluated) == (part - 1) * (MANY // 5)
        due = station.next_deadline()
        assert (due <= 0.0) is (part < 5), "it is due again at once until all have been evaluated"
    assert set(evaluated) == set(station.components.values())
    assert due == station.next_deadline()


def test_a_released_fetch_is_freed_without_a_garbage_collection() -> None:
    station = Station(link="x", is_stream=False)
    hear(station, 1, 0.0)
    machine = station.components[1, 1]
    gc.collect()
    gc.disable()
    try:
        fetch = machine.begin_fetch(0.0)
        left = [weakref.ref(each) for each in (fetch, fetch.download, fetch._hash_read)]
        assert all(each() is not None for each in left)
        machine.end_fetch(fetch, 1.0)
        del fetch
        assert [each() for each in left] == [None, None, None]
    finally:
        gc.enable()


def test_a_forgotten_component_leaves_no_deadline_to_its_successor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A lost component makes room for another, and a parameter is requested from it although it is gone."""
    monkeypatch.setattr(station_room, "COMPONENTS_MAX", 2)
    station = Station(link="x", is_stream=False)
    hear(station, 1, 0.0)
    hear(station, 2, 0.0)
    gone = station.components[1, 1]
    for second in range(1, 20):
        hear(station, 2, float(second))
        station.tick(float(second))
        station.next_deadline()
    assert gone.presence.is_lost
    hear(station, 3, 20.0)
    gone.reads.ask("A", 20.0)
    hear(station, 2, 20.0)
    for second in range(20, 60):
        station.tick(float(second))
        assert station.next_deadline() > second
    assert [*station.components] == [(2, 1), (3, 1)]
    assert all(machine.presence.is_lost for machine in station.components.values()), "by their own deadlines"
    assert station.autopilot_of(1) is None


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_a_session_ends_the_same_whether_or_not_all_components_are_examined(loss: float) -> None:
    """A whole session of twelve, with and without looking at everyone."""
    ends = []
    for everyone in (True, False):
        vehicles = [small(system) for system in range(1, 13)]
        air = Air.symmetric(vehicles, loss=loss, delay=0.01, seed=5)
        fetches, now = session(air, vehicles, everyone=everyone)
        assert all(fetch.result is not None and fetch.result.complete for fetch in fetches)
        ends.append(now)
    assert ends[1] <= 1.1 * ends[0]


def small(system: int) -> Vehicle:
    table = [SimParam(f"P_{index:03}", ParamType.INT32, index * system) for index in range(150)]
    if system % 2:
        return PX4Vehicle(system=system, table=table)
    return ArduPilotVehicle(system=system, table=table, ftp=False)


def session(air: Air, vehicles: list[Vehicle], *, everyone: bool) -> tuple[list[Fetch], float]:
    """All of them are fetched at once, as soon as they have said who they are."""
    station = Station(link="x", is_stream=False)
    fetches: list[Fetch] = []
    now = 0.0
    air.tick(now)
    while not (fetches and all(fetch.done for fetch in fetches)):
        assert now < 120.0
        if everyone:
            station.scheduler.reschedule_all()
        station.tick(now)
        machines = list(station.components.values())
        if (
            not fetches
            and len(machines) == len(vehicles)
            and all(each.identification.settled for each in machines)
        ):
            fetches = [machine.begin_fetch(now) for machine in machines]
        for data, _ in station.data_to_send():
            air.receive(data, now)
        deadline = air.next_deadline()
        if everyone:
            station.scheduler.reschedule_all()
        ours = station.next_deadline()
        now = max(min(ours, math.inf if deadline is None else deadline), now + 1e-7)
        air.tick(now)
        for data in air.data_to_send():
            station.receive(data, None, now)
    return fetches, now


def test_only_one_component_is_checked_for_awaited_responses(monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[int] = []
    whole = inspect.getattr_static(ComponentMachine, "is_waiting")

    def counted(machine: ComponentMachine) -> bool:
        requested.append(machine.system)
        return bool(whole.fget(machine))

    monkeypatch.setattr(ComponentMachine, "is_waiting", property(counted))
    station = Station(link="x", is_stream=False)
    for system in range(1, MANY + 1):
        hear(station, system, 0.0)
    for system in range(1, MANY):
        station.components[system, 1].identification.settled = True
        station.components[system, 1].identification._context.is_identifying = False
    assert station.is_waiting
    requested.clear()
    assert station.is_waiting
    assert requested == [MANY]


class SlowCache(ParamCache):
    """One that has hundreds of others to read first."""

    def load(self, key: str, component: int) -> CachedComponent | None:
        time.sleep(0.3)
        return super().load(key, component)


@pytest.mark.asyncio
async def test_a_cached_table_that_is_being_read_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cache.sqlite3"
    async with ParamClient(small(1), cache=path) as client:
        await (await client.component()).fetch_all()
    monkeypatch.setattr("paramclient.client.component_core.IDENTITY_TIMEOUT", 0.05)
    with SlowCache(path) as cache:
        async with ParamClient(small(1), cache=cache) as client:
            assert (await client.fetch_all()).results[1, 1].source == "cache"


class Flood:
    """A link that brings the given number of datagrams every few milliseconds."""

    name = "flood"
    is_stream = False
    reconnects = False
    interval = 0.005

    def __init__(self) -> None:
        self.size = 0
        self.is_stuck = anyio.Event()

    async def open(self) -> None: ...

    async def close(self) -> None: ...

    async def send(self, data: bytes, peer: Peer | None) -> None: ...

    async def receive(self) -> list[tuple[Peer, bytes]]:
        await anyio.sleep(self.interval)
        while not self.size:
            await self.is_stuck.wait()
        return [("peer", b"x")] * self.size


class Watched(Station):
    """A station with a deadline every ten milliseconds, that notes when it looks at what is due."""

    def __init__(self) -> None:
        super().__init__(link="flood", is_stream=False)
        self.ticks: list[float] = []
        self.on_receive: Callable[[], None] = lambda: None

    def receive(self, data: bytes, peer: Peer, now: float, moment: float | None = None) -> bool:
        self.on_receive()
        return True

    def tick(self, now: float) -> None:
        self.ticks.append(now)

    def next_deadline(self) -> float:
        return anyio.current_time() + 0.01


async def carry(link: Flood, station: Watched, seconds: float, dispatch: Callable[[], None]) -> None:
    whole = LinkTask(link, station, dispatch=dispatch, end=lambda error: None)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(whole.read)
        tasks.start_soon(whole.send)
        await anyio.sleep(seconds)
        tasks.cancel_scope.cancel()


@in_simulated_time
async def test_time_outs_wait_until_received_data_is_read() -> None:
    link, station = Flood(), Watched()
    link.size = loop_scheduler.BACKLOG_DATAGRAMS_MIN
    began = anyio.current_time()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(carry, link, station, 2.0, lambda: None)
        await anyio.sleep(1.0)
        meanwhile = [at for at in station.ticks if at > began + link.interval]
        assert not meanwhile, "more was there after each reading"
        link.size = loop_scheduler.BACKLOG_DATAGRAMS_MIN - 1
        await anyio.sleep(0.1)
        assert station.ticks[-1] > began + 1.0
        assert len(station.ticks) > 5
        assert station.scheduler.lists_max > 1


@in_simulated_time
async def test_time_outs_do_not_wait_for_ever() -> None:
    link, station = Flood(), Watched()
    link.size = loop_scheduler.BACKLOG_DATAGRAMS_MIN
    began = anyio.current_time()
    await carry(link, station, TIMEOUT_DELAY_MAX + 1.0, lambda: None)
    meanwhile = [at - began for at in station.ticks if at > began + link.interval]
    assert TIMEOUT_DELAY_MAX <= meanwhile[0] < TIMEOUT_DELAY_MAX + 0.1
    assert 50 < len(meanwhile) < 1.0 / TURN_MAX
    assert station.scheduler.lists_max == 1, "and no further list begins"


class Starved(Watched):
    """Other programs have the processor whenever it has said until when to wait."""

    def next_deadline(self) -> float:
        simulated_time_loop().call_later(0.001, self._starve)
        return super().next_deadline()

    def _starve(self) -> None:
        simulated_time_loop().now += LOOP_LATENCY_MIN + 0.002


@in_simulated_time
async def test_time_outs_wait_while_other_programs_have_the_processor() -> None:
    """What has arrived is there, but the reader had no turn meanwhile."""
    link, station = Flood(), Starved()
    link.size = loop_scheduler.BACKLOG_DATAGRAMS_MIN
    link.interval = TURN_MAX + 0.003  # the sender wakes before it
    began = anyio.current_time()
    await carry(link, station, 1.0, lambda: None)
    assert not [at for at in station.ticks if at > began + link.interval + LOOP_LATENCY_MIN]


@in_simulated_time
async def test_time_outs_do_not_wait_for_data_that_does_not_arrive() -> None:
    """The last reading brought many, and then the link falls silent."""
    link, station = Flood(), Watched()
    link.size = loop_scheduler.BACKLOG_DATAGRAMS_MIN
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(carry, link, station, 1.0, lambda: None)
        await anyio.sleep(0.5)
        link.size = 0
        silent_at = anyio.current_time()
        await anyio.sleep(0.2)
    assert next(at for at in station.ticks if at > silent_at) < silent_at + LOOP_LATENCY_MIN + 2 * TURN_MAX


@in_simulated_time
async def test_time_outs_wait_for_what_waits_for_its_turn() -> None:
    """Few datagrams were read, among them perhaps the answers, and another link has the turn."""
    link, station = Flood(), Watched()
    link.size = loop_scheduler.TURN_DATAGRAMS_MIN
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(carry, link, station, 3.0, lambda: None)
        await anyio.sleep(0.5)
        assert len(station.ticks) > 5
        async with loop_scheduler.LoopScheduler.of_this_loop().turn:
            await anyio.sleep(2 * link.interval)
            before = len(station.ticks)
            await anyio.sleep(0.5)
            assert len(station.ticks) == before
        await anyio.sleep(0.1)
        assert len(station.ticks) > before
        tasks.cancel_scope.cancel()


@in_simulated_time
async def test_many_frames_at_once_give_way_to_other_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A datagram is sent without yielding, and a fetch of many components queues a frame for each."""

    class Clock:
        now = 0.0

        def perf_counter(self) -> float:
            return self.now

    class Counted(Flood):
        async def send(self, data: bytes, peer: Peer | None) -> None:
            clock.now += 0.001
            happened.append("sent")

    async def beside() -> None:
        while True:
            await anyio.lowlevel.checkpoint()
            happened.append("another")

    clock = Clock()
    monkeypatch.setattr(link_task, "time", clock)
    happened: list[str] = []
    station = Watched()
    frames: list[tuple[bytes, Peer | None]] = [(b"x", None)] * 100
    monkeypatch.setattr(station, "data_to_send", lambda: [frames.pop() for _ in range(len(frames))])
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(beside)
        await carry(Counted(), station, 0.1, lambda: None)
        tasks.cancel_scope.cancel()
    assert happened.count("sent") == 100
    rounds = "".join(each[0] for each in happened).split("a")
    assert max(map(len, rounds)) == round(TURN_MAX / 0.001)


class Due(Watched):
    """Has one deadline, and counts suspends.

    Args:
        due: the deadline, in seconds from now.
    """

    def __init__(self, due: float) -> None:
        super().__init__()
        self.due = anyio.current_time() + due
        self.resumed = 0

    def next_deadline(self) -> float:
        return self.due

    def handle_suspend(self, unseen: float, now: float) -> None:
        self.resumed += 1


@in_simulated_time
async def test_a_deadline_that_passed_while_the_sender_was_blocked_is_no_suspend() -> None:
    """A slow serial link takes seconds to send; every request was sent again then."""

    class Slow(Flood):
        async def send(self, data: bytes, peer: Peer | None) -> None:
            await anyio.sleep(SUSPEND_MIN + 1.0)

    class Resumed(Due):
        frames: tuple[tuple[bytes, Peer | None], ...] = ((b"x", None),)

        def tick(self, now: float) -> None:
            super().tick(now)
            if now >= self.due:
                self.due = math.inf

        def data_to_send(self) -> list[tuple[bytes, Peer | None]]:
            frames, self.frames = self.frames, ()
            return list(frames)

    station = Resumed(0.5)
    await carry(Slow(), station, 10.0, lambda: None)
    assert station.due == math.inf, "the passed deadline was handled"
    assert not station.resumed


@in_simulated_time
async def test_deadlines_that_wait_for_those_of_other_components_are_no_suspend() -> None:
    """A tick handles a few components: the last of 1,000 that are due together is late by seconds."""

    class Behind(Due):
        def tick(self, now: float) -> None:
            super().tick(now)
            if len(self.ticks) >= 20:
                self.due = math.inf

    station = Behind(-SUSPEND_MIN - 1.0)
    await carry(Flood(), station, 5.0, lambda: None)
    assert station.due == math.inf, "the deadlines were handled"
    assert not station.resumed


@in_simulated_time
async def test_many_datagrams_at_once_give_way_to_other_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each datagram takes a millisecond; so do the tasks that process them."""

    class Clock:
        now = 0.0

        def perf_counter(self) -> float:
            return self.now

    def take() -> None:
        clock.now += 0.001
        happened.append("read")

    async def beside() -> None:
        while True:
            await anyio.lowlevel.checkpoint()
            happened.append("another")

    clock = Clock()
    monkeypatch.setattr(link_task, "time", clock)
    happened: list[str] = []
    link, station = Flood(), Watched()
    station.on_receive = take
    link.size = 100
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(beside)
        await carry(link, station, 0.008, lambda: happened.append("told"))
        tasks.cancel_scope.cancel()
    assert happened.count("read") == 100
    most = round(TURN_MAX / 0.001)
    rounds = "".join(each[0] for each in happened).split("a")
    longest = max(part.count("r") for part in rounds)
    assert longest == most
    assert all(part.endswith("t") for part in rounds if "r" in part)


def test_a_link_has_no_more_lists_than_the_others_leave_it() -> None:
    readers = loop_scheduler.LoopScheduler()
    most = loop_scheduler.BURST_LISTS_MAX
    assert readers.most_lists("a", 10 * most, 1.0) == math.inf, "it has its own measure"
    assert readers.most_lists("a", 0, 1.0) == math.inf
    assert readers.most_lists("b", most - 3, 2.0) == math.inf
    assert readers.most_lists("a", 1, 2.0) == 3
    assert readers.most_lists("c", 0, 2.0) == 2
    assert readers.most_lists("d", 9, 2.0) == 2
    assert readers.most_lists("a", 1, 2.0) == 1
    readers.unregister("b")
    assert readers.most_lists("a", 1, 2.0) == most - 9
    assert readers.most_lists("c", 0, 2.0, awaited=4) == most - 10
    assert readers.most_lists("a", 1, 2.0, awaited=1) == most - 13


def test_a_list_that_is_only_awaited_takes_no_time_of_others() -> None:
    readers = loop_scheduler.LoopScheduler()
    readers.most_lists("a", 0, 1.0, awaited=5)
    assert not readers.is_busy_without("b")
    readers.most_lists("a", 1, 1.0)
    assert readers.is_busy_without("b")
    assert not readers.is_busy_without("a")
    readers.unregister("a")
    assert not readers.is_busy_without("b")


def test_no_link_has_parallel_lists_while_one_has_unread_data() -> None:
    readers = loop_scheduler.LoopScheduler()
    readers.record_read("b", loop_scheduler.BACKLOG_DATAGRAMS_MIN - 1)
    assert readers.most_lists("a", 0, 1.0) == math.inf
    readers.record_read("b", loop_scheduler.BACKLOG_DATAGRAMS_MIN)
    assert readers.most_lists("a", 0, 1e6) == 1, "it is not done with them"
    readers.record_processed("b", 2.0)
    assert readers.most_lists("a", 0, 2.0) == 1
    assert readers.most_lists("a", 0, 2.0 + loop_scheduler.BACKLOG_VALIDITY) == math.inf
    readers.record_read("b", loop_scheduler.BACKLOG_DATAGRAMS_MIN - 1)
    readers.record_processed("b", 2.0)
    assert readers.most_lists("a", 0, 2.0) == math.inf


def test_links_of_two_event_loops_share_nothing() -> None:
    async def find() -> loop_scheduler.LoopScheduler:
        assert loop_scheduler.LoopScheduler.of_this_loop() is loop_scheduler.LoopScheduler.of_this_loop()
        return loop_scheduler.LoopScheduler.of_this_loop()

    assert anyio.run(find) is not anyio.run(find)


@in_simulated_time
async def test_no_list_begins_while_another_link_brings_more_than_is_read() -> None:
    busy, quiet, station = Flood(), Flood(), Watched()
    busy.size, quiet.size = loop_scheduler.BACKLOG_DATAGRAMS_MIN, 1
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(carry, quiet, station, 3.0, lambda: None)
        await anyio.sleep(0.5)
        seen = [station.scheduler.lists_max]
        tasks.start_soon(carry, busy, Watched(), 2.0, lambda: None)
        for size in (loop_scheduler.BACKLOG_DATAGRAMS_MIN, 0, loop_scheduler.BACKLOG_DATAGRAMS_MIN):
            busy.size = size
            busy.is_stuck.set()
            await anyio.sleep(0.5)
            seen.append(station.scheduler.lists_max)
        assert seen == [math.inf, 1, math.inf, 1]
        half_a_second = [at for at in station.ticks if at > anyio.current_time() - 0.5]
        assert len(half_a_second) > 20, "what is due is done all the same"
        await anyio.sleep(0.6)
        assert station.scheduler.lists_max > 1, "that one was closed"
        tasks.cancel_scope.cancel()


@in_simulated_time
async def test_a_link_that_was_closed_leaves_nothing_behind_whichever_of_its_tasks_ends_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    station = Watched()
    monkeypatch.setattr(scheduler.ListAdmission, "bursts", loop_scheduler.BURST_LISTS_MAX)
    for first in ("read", "send"):
        tasks = {}
        link = LinkTask(Flood(), station, dispatch=lambda: None, end=lambda error: None)
        for name in ("read", "send"):
            tasks[name] = asyncio.create_task(getattr(link, name)())
        await anyio.sleep(0.1)
        readers = loop_scheduler.LoopScheduler.of_this_loop()
        assert readers.most_lists("another", 0, anyio.current_time()) == 1
        for name in (first, *({*tasks} - {first})):
            tasks[name].cancel()
            await anyio.sleep(0.1)
        assert readers.most_lists("another", 0, anyio.current_time()) == math.inf


class Busy(Tap):
    """A vehicle that does nothing for a while when its parameters are requested: it has others to see to.

    Args:
        vehicle: the vehicle that receives the requests.
        seconds: for so long it does not speak, from the first time on; half a second later it hears, too.
        beats: whether its heartbeats arrive all the same.
    """

    def __init__(self, vehicle: Vehicle, seconds: float, *, beats: bool) -> None:
        super().__init__(vehicle)
        self._vehicle = vehicle
        self._seconds = seconds
        self._beats = beats
        self._until: float | None = None
        self._waiting: list[bytes] = []

    def receive(self, data: bytes, now: float) -> None:
        self.is_deaf = True
        super().receive(data, now)
        if self.messages(wire.ParamRequestList) and self._until is None:
            self._until = now + self._seconds
        self._waiting.append(data)
        self.tick(now)

    def tick(self, now: float) -> None:
        until = -1.0 if self._until is None else self._until
        self.is_mute = now < until and not self._beats
        if now >= until + 0.5:
            waiting, self._waiting = self._waiting, []
            for data in waiting:
                self._vehicle.receive(data, now)
        super().tick(now)

    def next_deadline(self) -> float | None:
        deadline = super().next_deadline()
        if not self._waiting or self._until is None:
            return deadline
        return min(self._until + 0.5, math.inf if deadline is None else deadline)


@in_simulated_time
async def test_a_component_that_is_as_slow_as_another_is_waited_for() -> None:
    """Where another one took a while as well, an answer that is late says nothing."""
    vehicles = [Busy(small(1), 0.3, beats=True), Busy(small(2), 2.3, beats=True)]
    async with ParamClient(Air.symmetric(vehicles), cache=False) as client:
        everything = await client.fetch_all()
        assert everything.complete
        assert everything.results.keys() == {(1, 1), (2, 1)}


@in_simulated_time
async def test_a_component_without_heartbeats_is_waited_for_until_it_is_lost() -> None:
    """It owes its heartbeats as well, and is not lost."""
    vehicles: list[Endpoint] = [small(1), *(Busy(small(system), 3.5, beats=False) for system in (2, 3))]
    async with ParamClient(Air.symmetric(vehicles), cache=False) as client:
        everything = await client.fetch_all()
        assert everything.complete
        assert everything.results.keys() == {(1, 1), (2, 1), (3, 1)}
