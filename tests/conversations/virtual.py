"""Virtual time: runs a test on trio or asyncio with a clock that jumps to the next deadline."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager, suppress
from functools import wraps
from typing import Any, TypeVar

import anyio
import pytest
import sniffio
import trio
from trio.testing import MockClock

from paramclient.errors import ParamClientError
from paramclient.links.sim import SimLink
from paramclient.protocol.node import Node
from paramclient.protocol.session import Session
from paramclient.protocol.station import Station
from paramclient.protocol.table import Change
from paramclient.sim import Endpoint
from paramclient.wire.messages import Heartbeat, Message, encode
from tests.shell import Passes, SimulatedTimeLoop, decoded, outcome, simulated_time_loop

T = TypeVar("T")


def run(test: Callable[..., Awaitable[T]], *arguments: Any, backend: str = "trio") -> T:
    """Run an async function in virtual time."""

    async def limited() -> T:
        with anyio.fail_after(300.0):  # virtual seconds after which a test hangs
            return await test(*arguments)

    if backend == "trio":
        # trio runs its tasks in a random order, which it lets only pytest-trio decide
        scheduling: Any = trio._core._run
        scheduling._ALLOW_DETERMINISTIC_SCHEDULING, scheduling._r = True, random.Random(0)
        options: dict[str, Any] = {"clock": MockClock(autojump_threshold=0)}
    else:
        options = {"loop_factory": SimulatedTimeLoop}
    return anyio.run(limited, backend=backend, backend_options=options)


def jump(seconds: float) -> None:
    """Let the clock jump, as after a suspend of the computer."""
    if sniffio.current_async_library() == "trio":
        clock = trio.lowlevel.current_clock()
        assert isinstance(clock, MockClock)
        clock.jump(seconds)
    else:
        simulated_time_loop().now += seconds


def virtual(test: Callable[..., Awaitable[None]], backend: str = "trio") -> Callable[..., None]:
    """Make an async test one that runs in virtual time."""

    @wraps(test)
    def wrapper(*arguments: Any, **options: Any) -> None:
        run(lambda: test(*arguments, **options), backend=backend)

    return wrapper


virtual_on_both = pytest.mark.usefixtures("backend")
"""Runs an async test in virtual time on trio, and on asyncio."""


class Conversation:
    """A station that talks to a simulated endpoint, and what happened.

    Attributes:
        station: the station.
        events: of all components: kinds, and what they tell.
        changes: of all parameters.
        sent: the frames that the station has sent.
    """

    def __init__(self, station: Station) -> None:
        self.station = station
        self.events: list[tuple[str, dict[str, Any]]] = []
        self.changes: list[Change] = []
        self.sent: list[bytes] = []
        self._sequence = 0

    def sent_of(self, kind: type[T]) -> list[T]:
        """Return the sent messages of a kind."""
        return [each for data in self.sent for _, each in decoded(data) if isinstance(each, kind)]

    def hear(self, *messages: Message, system: int = 1, component: int = 1, peer: object = "sim") -> None:
        """Receive messages now, beside those of the endpoint."""
        for message in messages:
            self._sequence = (self._sequence + 1) & 0xFF
            data = encode(message, system=system, component=component, sequence=self._sequence)
            self.station.receive(data, peer, anyio.current_time())

    async def node(self, system: int = 1, component: int = 1) -> Node:
        """Wait for a component."""
        while (system, component) not in self.station.nodes:  # noqa: ASYNC110 - in virtual time
            await anyio.sleep(0.01)
        return self.station.nodes[system, component]

    def of(self, kind: str) -> list[dict[str, Any]]:
        """Return the events of a kind, as what they tell."""
        return [facts for each, facts in self.events if each == kind]


@asynccontextmanager
async def converse(endpoint: Endpoint, **options: Any) -> AsyncIterator[Conversation]:
    """Open a station on a simulated endpoint."""
    link = SimLink(endpoint)
    await link.open()
    queue: list[bytes] = []
    wake = [anyio.Event()]

    def send(data: bytes, peer: object) -> None:
        queue.append(data)
        conversation.sent.append(data)
        wake[0].set()

    def discovered(node: Node) -> None:
        node.emit = lambda kind, **facts: conversation.events.append((kind, facts))
        for session in node.sessions:
            session.table.changed = conversation.changes.append

    async def supervise(work: Callable[..., Awaitable[object]], *arguments: object) -> None:
        with suppress(ParamClientError):
            await work(*arguments)

    async def read() -> None:
        while True:
            for peer, data in await link.receive():
                conversation.station.receive(data, peer, anyio.current_time())

    async def write() -> None:
        while True:
            while queue:
                await link.send(queue.pop(0), None)
            wake[0] = anyio.Event()
            await wake[0].wait()

    async with anyio.create_task_group() as tasks:
        conversation = Conversation(
            Station(
                link="sim:test",
                is_stream=False,
                send=send,
                spawn=lambda *work: tasks.start_soon(supervise, *work),
                discovered=discovered,
                **options,
            )
        )
        for task in (read, write, conversation.station.send_heartbeats):
            tasks.start_soon(task)
        try:
            yield conversation
        finally:
            tasks.cancel_scope.cancel()


@asynccontextmanager
async def talking(endpoint: Endpoint, **options: Any) -> AsyncIterator[tuple[Conversation, Session]]:
    """Open a station on a simulated endpoint, and wait for 1/1: gives its plain parameters too."""
    async with converse(endpoint, **options) as conversation:
        yield conversation, (await conversation.node()).plain


@asynccontextmanager
async def meanwhile(*calls: Awaitable[Any]) -> AsyncIterator[list[Any]]:
    """Begin some calls, and wait for them after the block: gives what each returns or raises, as they end."""
    outcomes: list[Any] = []

    async def run_call(call: Awaitable[Any]) -> None:
        outcomes.append(await outcome(call))

    async with anyio.create_task_group() as tasks:
        for call in calls:
            tasks.start_soon(run_call, call)
        yield outcomes


def losing(number: int, is_lost: Callable[[Message], bool]) -> Passes:
    """Return a filter for a `Tap`, which loses the first messages of which a function says so."""
    left = [number]

    def passes(message: Message) -> bool:
        drops = left[0] > 0 and is_lost(message)
        left[0] -= drops
        return not drops

    return passes


QUIET = Heartbeat(2, 0, system_status=4)
"""The heartbeat of a generic quadrotor."""


class Puppet:
    """A component that answers each message by a function of the test, and sends a heartbeat each second.

    Args:
        answer: returns the answers to a message.
        heartbeat: once a second; None for a component without heartbeats.
        system, component: its address.
    """

    def __init__(
        self,
        answer: Callable[[Message], Iterable[Message]],
        *,
        heartbeat: Heartbeat | None = QUIET,
        system: int = 1,
        component: int = 1,
    ) -> None:
        self.received: list[Message] = []
        self._answer = answer
        self._heartbeat = heartbeat
        self._address = {"system": system, "component": component}
        self._sequence = 0
        self._beat_at = 0.0
        self._out: list[bytes] = []

    def receive(self, data: bytes, now: float) -> None:
        """Answer the messages in a datagram."""
        for _, message in decoded(data):
            self.received.append(message)
            for each in self._answer(message):
                self.say(each)

    def say(self, message: Message) -> None:
        """Send a message."""
        self._sequence = (self._sequence + 1) & 0xFF
        self._out.append(encode(message, sequence=self._sequence, **self._address))

    def say_bytes(self, data: bytes) -> None:
        """Send a datagram."""
        self._out.append(data)

    def tick(self, now: float) -> None:
        """Send the heartbeat if it is due."""
        if self._heartbeat is not None and now >= self._beat_at:
            self._beat_at = now + 1.0
            self.say(self._heartbeat)

    def next_deadline(self) -> float | None:
        """Return the time of the next heartbeat."""
        return None if self._heartbeat is None else self._beat_at

    def data_to_send(self) -> list[bytes]:
        """Return the frames to send, and clear them."""
        out, self._out = self._out, []
        return out
