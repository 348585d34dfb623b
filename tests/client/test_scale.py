"""Many vehicles on one link: nothing is done for all of them that one of them is the reason of."""

from __future__ import annotations

import math
import time
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


def small(system: int) -> Vehicle:
    table = [SimParam(f"P_{index:03}", ParamType.INT32, index * system) for index in range(150)]
    if system % 2:
        return PX4Vehicle(system=system, table=table)
    return ArduPilotVehicle(system=system, table=table, ftp=False)


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
