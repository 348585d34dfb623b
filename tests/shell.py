"""Makings of the client's tests: an event loop that never sleeps, small vehicles, links that drop."""

from __future__ import annotations

import asyncio
import functools
import math
import selectors
import struct
import time
from collections.abc import Awaitable, Callable, Collection, Coroutine, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, ParamSpec, TypeAlias, TypeVar
from unittest import mock

import anyio
import anyio.to_thread

from paramclient import Component, Param, ParamClient, ParamType
from paramclient.client import cache_writer
from paramclient.errors import LinkError
from paramclient.links import Peer, SimLink
from paramclient.sim import Endpoint, GenericVehicle, PX4Vehicle, SimParam
from paramclient.wire import frames, messages

P = ParamSpec("P")
T = TypeVar("T")

TIMEOUT = 120.0
"""Seconds after which a test on real sockets gives up; nothing waits that long when all is well. On a machine
that is busy with ten other programs the service takes half a minute to start in a process of its own."""

VALUES: dict[str, int | float] = {
    f"PARAM_{number:02}": number if number % 3 else number / 4 for number in range(24)
}
"""A small table: whole numbers, and every third with a fraction."""


class SimulatedTimeLoop(asyncio.SelectorEventLoop):
    """An event loop whose clock leaps to the next thing to do.

    A session with simulated vehicles takes no real time on it, and goes the same way on every machine. While
    a thread is at work the clock stands still. Where nothing would ever happen again, it says so.

    Attributes:
        now: its clock.
        ahead: seconds that the time of day, as the cache receives it, is ahead of that.
        threads: calls in threads that are under way.
        has_run_action: whether the last `run_between_rounds` met its task still at work.
    """

    def __init__(self) -> None:
        super().__init__(_LeapingSelector(self))
        self.now = 1000.0
        self.ahead = time.time() - self.now
        self.threads = 0
        self.has_run_action = False
        self._settled_waiters: list[asyncio.Future[None]] = []
        self._rounds_left = 0
        self._observed_task: asyncio.Task[Any] | None = None
        self._action: Callable[[], object] = lambda: None

    def time(self) -> float:
        return self.now

    def run_between_rounds(self, task: asyncio.Task[Any], action: Callable[[], Any], *, after: int) -> None:
        """Do this between two rounds of the loop, so many from now, if the task is not done by then."""
        self.has_run_action = False
        self._rounds_left = after
        self._observed_task = task
        self._action = action

    async def settled(self) -> None:
        """Wait until nothing can happen any more without the clock."""
        waiter = self.create_future()
        self._settled_waiters.append(waiter)
        await waiter

    def wake_settled(self) -> bool:
        """Whether a caller waited for nothing to happen."""
        waiters, self._settled_waiters = self._settled_waiters, []
        for waiter in waiters:
            if not waiter.done():
                waiter.set_result(None)
        return bool(waiters)

    def begin_round(self) -> bool:
        """Whether there is something to do that was not there before."""
        self.now += 1e-6  # nothing is done in no time at all
        self._rounds_left -= 1
        if self._rounds_left or self._observed_task is None or self._observed_task.done():
            return False
        self.has_run_action = True
        self._action()
        return True


class _LeapingSelector(selectors.DefaultSelector):
    def __init__(self, loop: SimulatedTimeLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        loop = self._loop
        if loop.begin_round():
            timeout = 0
        ready = super().select(0)
        if ready or timeout == 0:
            return ready
        if loop.threads:  # one of them will wake the loop
            ready = super().select(TIMEOUT)
            if not ready:
                raise RuntimeError(f"a thread was at work for {TIMEOUT} s; the clock stood still meanwhile")
            return ready
        if loop.wake_settled():
            return []
        if timeout is None:
            raise RuntimeError("everybody waits, and for nothing")
        loop.now += timeout
        return []


def simulated_time_loop() -> SimulatedTimeLoop:
    """The loop that the caller runs on."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, SimulatedTimeLoop)
    return loop


def while_the_clock_stands(in_thread: Callable[..., Awaitable[Any]]) -> Callable[..., Awaitable[Any]]:
    """Wrap a call that runs in a worker thread: the clock of the loop stands still meanwhile."""

    async def call(*arguments: Any, **options: Any) -> Any:
        loop = simulated_time_loop()
        loop.threads += 1
        try:
            return await in_thread(*arguments, **options)
        finally:
            loop.threads -= 1

    return call


def in_simulated_time(test: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, T]:
    """Run an asynchronous test on a `SimulatedTimeLoop`."""

    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        in_thread = while_the_clock_stands(anyio.to_thread.run_sync)
        with asyncio.Runner(loop_factory=SimulatedTimeLoop) as runner:
            loop = runner.get_loop()
            assert isinstance(loop, SimulatedTimeLoop)
            clock = SimpleNamespace(time=lambda: loop.now + loop.ahead)
            with (
                mock.patch.object(anyio.to_thread, "run_sync", in_thread),
                mock.patch.object(cache_writer, "time", clock),
            ):
                return runner.run(test(*args, **kwargs))

    return run


def small_px4(*, volatile: Collection[str] = ("CAL_ACC0_XOFF", "PARAM_03"), **options: Any) -> PX4Vehicle:
    """A PX4 vehicle with VALUES and CAL_ACC0_XOFF, of which some are not in its hash."""
    rows = [
        SimParam(
            name, ParamType.REAL32 if isinstance(value, float) else ParamType.INT32, value, name in volatile
        )
        for name, value in {**VALUES, "CAL_ACC0_XOFF": 0.5}.items()
    ]
    return PX4Vehicle(**{"table": rows} | options)


def clamped(message: messages.Message, name: str, low: float, high: float) -> messages.Message:
    """A set of this parameter of an ArduPilot with its value in this range; any other message as it is."""
    if not isinstance(message, messages.ParamSet) or message.param_id != name:
        return message
    (value,) = struct.unpack("<f", message.raw)
    return replace(message, raw=struct.pack("<f", min(max(value, low), high)))


def generic(**options: Any) -> GenericVehicle:
    """A vehicle that keeps to the standard, with VALUES."""
    return GenericVehicle(**{"table": VALUES} | options)


def decoded(data: bytes) -> list[tuple[frames.Frame, messages.Message]]:
    """The frames in a datagram that are understood, and their messages."""
    found = frames.Framer(messages.DECODED_IDS, stream=False).receive(data)
    return [(frame, message) for frame in found if (message := messages.decode(frame)) is not None]


Passes: TypeAlias = Callable[[messages.Message], bool]
"""Returns whether a message arrives."""


def all_pass(message: messages.Message) -> bool:
    """The link loses nothing."""
    return True


class Tap:
    """An endpoint through which another one speaks: it listens, and can hold either direction up.

    Args:
        endpoint: the vehicle; another one may take its place.
        up, down: of a message to the vehicle, and from it.

    Attributes:
        received: what the station has sent, if it may arrive: time, frame, message.
        is_deaf: the endpoint receives nothing.
        is_mute: nothing that it sends arrives.
        silent_at: from when on both hold, on the clock of the event loop, as of a vehicle that crashes.
    """

    def __init__(self, endpoint: Endpoint, *, up: Passes = all_pass, down: Passes = all_pass) -> None:
        self.received: list[tuple[float, frames.Frame, messages.Message]] = []
        self.up = up
        self.down = down
        self.is_deaf = False
        self.is_mute = False
        self.silent_at = math.inf
        self.endpoint = endpoint

    def messages(self, kind: type[T]) -> list[T]:
        """What the station has sent, of one kind."""
        return [message for _, _, message in self.received if isinstance(message, kind)]

    def receive(self, data: bytes, now: float) -> None:
        heard = decoded(data)
        if all(self.up(message) for _, message in heard):
            self.received += [(now, *each) for each in heard]
            if not self.is_deaf and now < self.silent_at:
                self.endpoint.receive(data, now)

    def tick(self, now: float) -> None:
        self.endpoint.tick(now)

    def next_deadline(self) -> float | None:
        return self.endpoint.next_deadline()

    def data_to_send(self) -> list[bytes]:
        sent = self.endpoint.data_to_send()
        if self.is_mute or anyio.current_time() >= self.silent_at:
            return []
        return [data for data in sent if all(self.down(message) for _, message in decoded(data))]


class Late:
    """A vehicle that is switched on later than the link is opened, or was present before and falls silent.

    Args:
        endpoint: the vehicle.
        by: seconds from the opening of the link.
        until: seconds after which it says nothing more.
    """

    def __init__(self, endpoint: Endpoint, by: float, until: float = math.inf) -> None:
        self.endpoint = endpoint
        self._by, self._until = by, until
        self._on_at = self._off_at = math.inf  # known from the first tick on

    def receive(self, data: bytes, now: float) -> None:
        if self._on_at <= now < self._off_at:
            self.endpoint.receive(data, now)

    def tick(self, now: float) -> None:
        if self._on_at == math.inf:
            self._on_at, self._off_at = now + self._by, now + self._until
        if now >= self._off_at:
            self._on_at = self._off_at
        elif now >= self._on_at:
            self.endpoint.tick(now)

    def next_deadline(self) -> float | None:
        if self._on_at == self._off_at:
            return None
        deadline = self.endpoint.next_deadline()
        return min(self._on_at if deadline is None else deadline, self._off_at)

    def data_to_send(self) -> list[bytes]:
        return self.endpoint.data_to_send()


class Eventful(Tap):
    """An endpoint to which things happen.

    Args:
        endpoint: the vehicle.
        events: seconds after the link is opened, and what happens then.
    """

    def __init__(self, endpoint: Endpoint, *events: tuple[float, Callable[[], object]]) -> None:
        super().__init__(endpoint)
        self._events = [*events]
        self._began = math.inf

    def tick(self, now: float) -> None:
        super().tick(now)
        self._began = min(self._began, now)
        while self._events and now > self._began + self._events[0][0]:
            self._events.pop(0)[1]()


class Radio(Tap):
    """A channel that another station shares: the endpoint and we receive what it sends.

    Attributes:
        other: the other station's frames that are still to be sent.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(endpoint)
        self.other: list[bytes] = []

    def data_to_send(self) -> list[bytes]:
        sent, self.other = self.other, []
        for data in sent:
            self.endpoint.receive(data, anyio.current_time())
        return sent + super().data_to_send()


class PeersLink:
    """A link with several peers, as one UDP port is where vehicles send to.

    Attributes:
        endpoints: who speaks from which peer; may change while it is open.
    """

    is_stream = False
    reconnects = False

    def __init__(self, endpoints: Mapping[Peer, Endpoint], name: str = "udpin:peers:14550") -> None:
        self.name = name
        self.endpoints = dict(endpoints)
        self._activity: anyio.Event | None = None

    async def open(self) -> None:
        await anyio.lowlevel.checkpoint()
        self._activity = anyio.Event()

    async def receive(self) -> list[tuple[Peer, bytes]]:
        while self._activity is not None:
            now = anyio.current_time()
            for endpoint in self.endpoints.values():
                endpoint.tick(now)
            received = [(peer, data) for peer, each in self.endpoints.items() for data in each.data_to_send()]
            if received:
                await anyio.lowlevel.checkpoint()
                return received
            due = [at for each in self.endpoints.values() if (at := each.next_deadline()) is not None]
            self._activity = anyio.Event()
            with anyio.move_on_after(max(min(due, default=now + 1.0) - now, 0.0)):
                await self._activity.wait()
        raise LinkError(f"{self.name}: not open", link=self.name)

    async def send(self, data: bytes, peer: Peer | None) -> None:
        await anyio.lowlevel.checkpoint()
        for each, endpoint in self.endpoints.items():
            if peer in (None, each):
                endpoint.receive(data, anyio.current_time())
        self._wake()

    async def close(self) -> None:
        self._wake()
        self._activity = None

    def _wake(self) -> None:
        if self._activity is not None:
            self._activity.set()


class FlakyLink(SimLink):
    """A link to an endpoint that can drop, and be opened again.

    Attributes:
        is_offline: whether it cannot be opened now.
        openings: how often a caller tried.
    """

    reconnects = True

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(endpoint, "tcp:flaky:5760")
        self.is_offline = False
        self.openings = 0

    async def open(self) -> None:
        self.openings += 1
        if self.is_offline:
            raise LinkError(f"{self.name}: connection refused", link=self.name)
        await super().open()

    async def drop(self, *, stays_offline: bool = False) -> None:
        self.is_offline = stays_offline
        await self.close()

    async def receive(self) -> list[tuple[Peer, bytes]]:
        # who has spoken is another one after each opening, as with a TCP connection
        return [((peer, self.openings), data) for peer, data in await super().receive()]

    async def send(self, data: bytes, peer: Peer | None) -> None:
        if peer in (None, ("sim", self.openings)):
            await super().send(data, None)


def bits(params: Mapping[str, Param]) -> dict[str, int]:
    """The values to the last bit, whatever the order."""
    return {name: param.bits for name, param in params.items()}


def residue(component: Component) -> list[object]:
    """What is still under way with a component: messages that a call waits for, and a fetch.

    The request for its identity, which the client sends by itself, is none of them."""
    identity = (messages.AutopilotVersion, (messages.CommandAck, 512), (messages.CommandAck, 520))
    waits = component.node.channel.inboxes.items()
    left: list[object] = [key for key, waiting in waits if waiting and key not in identity]
    return [*left, "fetch"] if component.session.fetching.is_running else left


async def outcome(call: Awaitable[T]) -> T | Exception:
    """What a call returns or raises."""
    try:
        return await call
    except Exception as error:
        return error


def tasks_beside() -> set[str]:
    """The tasks that run besides the caller's."""
    return {task.get_name() for task in asyncio.all_tasks() - {asyncio.current_task()}}


async def until(condition: Callable[[], object], pause: float = 0.001) -> None:
    """Wait until a condition holds that no event reports."""
    with anyio.fail_after(TIMEOUT):
        while not condition():  # noqa: ASYNC110 - no event reports it
            await asyncio.sleep(pause)


async def settled() -> None:
    """Let everything happen that happens now."""
    await simulated_time_loop().settled()


def a_client(link: Any, **options: Any) -> ParamClient:
    """A client without a cache, unless one is given."""
    return ParamClient(link, **{"cache": False} | options)
