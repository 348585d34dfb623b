"""When a value arrived from the link: it is kept from the socket to the cache, and decides what counts
there."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import anyio
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params.table import Table

from paramclient import ParamCache, ParamType
from paramclient.cache import HistoryEntry
from paramclient.client import suspend_detection
from paramclient.client.cache_writer import CacheWriter
from paramclient.client.link_task import LinkTask
from paramclient.links import Peer
from paramclient.links.clock_offset import seconds_ahead
from paramclient.protocol.station import Station
from paramclient.wire import messages
from paramclient.wire.messages import NO_INDEX, AutopilotVersion, Heartbeat, Message, ParamValue
from tests.shell import a_client, in_simulated_time, simulated_time_loop, small_px4, until
from tests.simulation import param_value

NOW = 1_795_000_000.0
"""Unix seconds when the clock of the core stands at 0."""


# In the table


def receive(table: Table, value: int, by: str, moment: float) -> None:
    table.store_value(param_value("A", value, index=0, kind=ParamType.INT32), by, moment)


# On the way to the cache


# Two programs, one cache

NAMES = "ABC"
SIDES = st.integers(0, 1)


class Side:
    """One program: what waits in its socket, its core, and its way to the cache."""

    def __init__(self, cache: ParamCache, now: Callable[[], float]) -> None:
        self.socket: list[tuple[float, bytes]] = []
        self.station = Station(link="x", is_stream=False)
        self.writer = CacheWriter(
            cache,
            owned=False,
            identity_of=self.station.identity_of,
            is_doubted=lambda machine: False,  # there is one vehicle
            clock=lambda: NOW + now(),
            now=now,
        )

    @property
    def machine(self) -> ComponentMachine:
        return self.station.components[1, 1]


class Programs(RuleBasedStateMachine):
    """Two programs that follow one vehicle and share a cache, each read and flushed whenever it is.

    The model is what the vehicle had at each moment. Whatever stands in the cache was so then.
    """

    caches: Callable[[], tuple[ParamCache, ParamCache]]

    @initialize()
    def begin(self) -> None:
        self.now = 100.0
        self.sequence = 0
        self.truth: dict[str, list[tuple[float, int | None]]] = {name: [(99.0, 0)] for name in NAMES}
        self.reported: dict[str, float] = {}
        self.runner = asyncio.Runner()
        self.opened = self.caches()
        for left in self.opened[0].vehicles():
            self.opened[0].remove(left.key)
        self.sides = [Side(cache, lambda: self.now) for cache in self.opened]
        self.announce(Heartbeat(2, 12, 0), 3)
        self.announce(AutopilotVersion(0, 1, uid=7), 3)
        for side in self.sides:
            self.read_all(side)
        for number, side in enumerate(self.sides):
            identity = side.station.identity_of(side.machine)
            assert identity is not None
            self.runner.run(side.writer.load_cached(side.machine, identity))
            self.list_all(number)

    def teardown(self) -> None:
        if not hasattr(self, "sides"):
            return
        for number, side in enumerate(self.sides):
            self.read_all(side)
            self.flush(number)
        for side, cache in zip(self.sides, self.opened, strict=True):
            self.runner.run(side.writer.close())
            cache.close()
        self.runner.close()

    # what happens

    @rule(name=st.sampled_from(NAMES), value=st.integers(0, 2), at=st.integers(1, 3))
    def changes(self, name: str, value: int, at: int) -> None:
        """The vehicle changes a value; it is received by one program, or by both."""
        self.become(name, value)
        self.announce(self.value_of(name), at)

    @rule(number=SIDES, name=st.sampled_from(NAMES), value=st.integers(0, 2), at=st.integers(1, 3))
    def is_set(self, number: int, name: str, value: int, at: int) -> None:
        """One program sets a value."""
        self.sides[number].machine.write(name, value, self.now)
        self.sides[number].station.data_to_send()
        self.changes(name, value, at)

    @rule(name=st.sampled_from(NAMES))
    def goes(self, name: str) -> None:
        """The vehicle no longer has a parameter, and no message reports it."""
        self.become(name, None)

    @rule(number=SIDES, count=st.integers(1, 4))
    def reads(self, number: int, count: int) -> None:
        """One program reads some of what waits in its socket."""
        side = self.sides[number]
        for _ in range(min(count, len(side.socket))):
            self.now += 1e-4
            arrived, data = side.socket.pop(0)
            side.station.receive(data, None, self.now, arrived)

    @rule(number=SIDES)
    def lists(self, number: int) -> None:
        """One program downloads everything. The other one is held up meanwhile, and its socket fills."""
        self.list_all(number)

    @rule(number=SIDES)
    def flushes(self, number: int) -> None:
        """One program writes what is new."""
        self.flush(number)

    @rule(seconds=st.sampled_from([0.01, 3.0, 20.0]))
    def waits(self, seconds: float) -> None:
        """Time passes."""
        self.now += seconds

    # how

    def become(self, name: str, value: int | None) -> None:
        self.now += 0.001
        self.truth[name].append((self.now, value))

    def announce(self, message: Message, at: int) -> None:
        """Send a message: it arrives in one socket a little later than in the other one."""
        self.sequence = (self.sequence + 1) % 256
        data = messages.encode(message, system=1, component=1, sequence=self.sequence)
        for number, side in enumerate(self.sides):
            if at & 1 << number:
                self.now += 1e-5
                side.socket.append((self.now, data))

    def value_of(self, name: str, index: int = NO_INDEX) -> ParamValue:
        present = [each for each in NAMES if self.truth[each][-1][1] is not None]
        value = self.truth[name][-1][1]
        assert value is not None
        return ParamValue(name, value.to_bytes(4, "little"), ParamType.INT32, len(present), index)

    def list_all(self, number: int) -> None:
        side = self.sides[number]
        self.read_all(side)
        present = [name for name in NAMES if self.truth[name][-1][1] is not None]
        for index, name in enumerate(present):
            self.announce(self.value_of(name, index), 3)
        self.read_all(side)
        if present:  # else not even a count was received
            side.machine.table.settle(dict(enumerate(present)))
            side.machine.table.complete = True
            side.writer.synced(side.machine, is_whole=True)

    def read_all(self, side: Side) -> None:
        self.reads(self.sides.index(side), len(side.socket))

    def flush(self, number: int) -> None:
        side = self.sides[number]
        table = side.machine.table
        for name in table.dirty:
            if name in table.params:
                self.reported[name] = max(self.reported.get(name, 0.0), table.params.moments[name])
        assert self.runner.run(side.writer.flush())
        self.now += 0.001
        self.check()

    # what must be so

    def check(self) -> None:
        if not self.opened[0].components():
            return
        cached = self.opened[0].component(system=1)
        for name, param in cached.params.items():
            at = cached.heard_at[name]
            assert self.so_at(name, at) == param.value, f"{name} was not {param.value!r} at {at - NOW}"
            assert at >= NOW + self.reported.get(name, 0.0) - 1e-6, "the latest observation counts"
        for name in NAMES:
            self.check_lines(name, self.opened[0].history(cached.key, name=name))

    def check_lines(self, name: str, lines: Sequence[HistoryEntry]) -> None:
        before: int | None = None
        for line in lines:
            new = None if line.new is None else line.new.value
            assert self.so_at(name, line.at) == new, f"{name} was not {new!r} at {line.at - NOW}: {lines}"
            assert before in (None, line.old.value), f"the lines of {name} are no chain: {lines}"
            assert line.old.value != new
            before = new  # type: ignore[assignment]  # every value here is a whole number
        assert [line.at for line in lines] == sorted(line.at for line in lines)

    def so_at(self, name: str, at: float) -> int | None:
        return [value for since, value in self.truth[name] if NOW + since <= at + 1e-6][-1]


def interleaved(caches: Callable[[], tuple[ParamCache, ParamCache]], examples: int, steps: int = 30) -> None:
    """Run two programs side by side, at random."""
    machine = type("Machine", (Programs,), {"caches": staticmethod(caches)})
    run_state_machine_as_test(
        machine, settings=settings(max_examples=examples, stateful_step_count=steps, deadline=None)
    )


def test_a_name_removed_before_the_first_write_does_not_return(tmp_path: Path) -> None:
    """Its first value had no index, and a later one had: the list without it overtakes both."""
    path = tmp_path / "cache"
    caches = staticmethod(lambda: (ParamCache(path), ParamCache(path)))
    programs = type("Machine", (Programs,), {"caches": caches})()
    programs.begin()
    programs.goes(name="B")
    programs.is_set(number=1, name="C", value=2, at=1)
    programs.lists(number=1)
    programs.goes(name="C")
    programs.is_set(number=0, name="B", value=2, at=2)
    programs.lists(number=0)
    for number, side in enumerate(programs.sides):
        programs.read_all(side)
        programs.flush(number)
    assert programs.opened[0].component(system=1).params.keys() == {"A", "B"}
    programs.teardown()


def test_a_file_that_two_programs_write_to_agrees_with_a_model(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    interleaved(lambda: (ParamCache(path), ParamCache(path)), examples=100)


# From the link


class Scripted:
    """A link that gives what a test puts into it."""

    name = "scripted"
    is_stream = False
    reconnects = False

    def __init__(self) -> None:
        self._reads: list[list[tuple[Peer, bytes]]] = []
        self._is_there = anyio.Event()

    def arrive(self, *chunks: bytes) -> None:
        self._reads.append([("peer", chunk) for chunk in chunks])
        self._is_there.set()

    async def receive(self) -> list[tuple[Peer, bytes]]:
        while not self._reads:
            self._is_there = anyio.Event()
            await self._is_there.wait()
        return self._reads.pop(0)

    async def send(self, data: bytes, peer: Peer | None) -> None:
        raise AssertionError("nothing is sent here")

    async def open(self) -> None: ...

    async def close(self) -> None: ...


class Asking(Station):
    """A station that has something to do every 0.1 s; it records for each chunk when it arrived from the
    link."""

    def __init__(self) -> None:
        super().__init__(link="scripted", is_stream=False)
        self.received: dict[bytes, float] = {}

    def receive(self, data: bytes, peer: Peer, now: float, moment: float | None = None) -> bool:
        assert moment is not None
        self.received[data] = moment
        return False

    def tick(self, now: float) -> None: ...

    def next_deadline(self) -> float:
        return anyio.current_time() + 0.1


@asynccontextmanager
async def carried(link: Scripted) -> AsyncIterator[dict[bytes, float]]:
    """The data that arrived over a link, with the times that its station received."""
    station = Asking()
    mover = LinkTask(link, station, dispatch=lambda: None, end=lambda error: None, may_rest=False)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(mover.read)
        tasks.start_soon(mover.send)
        await anyio.sleep(1.0)
        yield station.received
        tasks.cancel_scope.cancel()


@in_simulated_time
async def test_bytes_read_at_once_have_the_present_time() -> None:
    async with carried(link := Scripted()) as received:
        await anyio.sleep(5.0)
        link.arrive(b"1")
        now = anyio.current_time()
        await anyio.sleep(0.01)
        assert received[b"1"] == pytest.approx(now, abs=0.001)


@in_simulated_time
async def test_bytes_read_late_have_the_time_of_the_last_read() -> None:
    async with carried(link := Scripted()) as received:
        link.arrive(b"1")
        now = anyio.current_time()
        await anyio.sleep(0.01)
        link.arrive(*[b"2"] * 128)
        simulated_time_loop().now += 0.5  # nothing is done here meanwhile
        link.arrive(b"3")
        await anyio.sleep(0.01)
        assert [received[b"2"], received[b"3"]] == pytest.approx([now] * 2, abs=0.001), "the buffer was full"
        assert received[b"3"] > received[b"2"] + 0.0001, "of two values the later one is the newer one"
        await anyio.sleep(0.01)
        link.arrive(b"4")
        late = anyio.current_time()
        await anyio.sleep(0.2)
        link.arrive(b"5")
        await anyio.sleep(0.01)
        assert received[b"4"] <= late
        assert received[b"5"] == pytest.approx(late + 0.2, abs=0.001)


@in_simulated_time
async def test_a_station_that_slept_writes_when_things_were_observed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its value is written after an hour of sleep, and is older than what another program saw meanwhile."""
    asleep = 0.0
    monkeypatch.setattr(suspend_detection, "time_asleep", lambda: asleep)
    vehicle = small_px4()
    with ParamCache(tmp_path / "cache") as other:
        async with a_client(vehicle, cache=tmp_path / "cache") as client:
            component = await client.component()
            await component.fetch_all()
            await anyio.sleep(2.0)
            vehicle.set_param("PARAM_01", 5)  # and it sends the value
            await until(lambda: component.params["PARAM_01"].value == 5)
            observed_at = simulated_time_loop().now + simulated_time_loop().ahead
            assert not other.history(other.component(system=1).key), "it is not written yet"
            asleep = 3600.0
            simulated_time_loop().ahead += 3600.0
            await anyio.sleep(2.0)
        [line] = other.history(other.component(system=1).key, name="PARAM_01")
    assert line.new is not None
    assert line.new.value == 5
    assert line.at == pytest.approx(observed_at, abs=0.01)
