"""Virtual time: runs a test on trio or asyncio with a clock that jumps to the next deadline."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any, TypeVar

import anyio
from trio.testing import MockClock

from paramclient.links.sim import SimLink
from paramclient.protocol.events import Change, ComponentEvent
from paramclient.protocol.node import Node
from paramclient.protocol.session import Session
from paramclient.protocol.station import Station
from paramclient.sim import Endpoint

T = TypeVar("T")

TIME_LIMIT = 300.0
"""Virtual seconds after which a test hangs."""


class _JumpingSelector(selectors.SelectSelector):
    """Waits for nothing: the time of the wait passes at once."""

    passed = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if not ready and timeout is None:
            raise RuntimeError("nothing will ever happen")
        if not ready and timeout:
            self.passed += timeout
        return ready


class _VirtualLoop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        self._jumps = _JumpingSelector()
        super().__init__(self._jumps)

    def time(self) -> float:
        return self._jumps.passed


def run(test: Callable[..., Awaitable[T]], *arguments: Any, backend: str = "trio") -> T:
    """Run an async function in virtual time."""

    async def limited() -> T:
        with anyio.fail_after(TIME_LIMIT):
            return await test(*arguments)

    if backend == "trio":
        options: dict[str, Any] = {"clock": MockClock(autojump_threshold=0)}
    else:
        options = {"loop_factory": _VirtualLoop}
    return anyio.run(limited, backend=backend, backend_options=options)


class Conversation:
    """A station that talks to a simulated endpoint, and what happened.

    Attributes:
        station: the station.
        events: of all components.
        changes: of all parameters.
        sent: the frames that the station has sent.
    """

    def __init__(self, station: Station) -> None:
        self.station = station
        self.events: list[ComponentEvent] = []
        self.changes: list[Change] = []
        self.sent: list[bytes] = []

    async def node(self, system: int = 1, component: int = 1) -> Node:
        """Wait for a component."""
        while (system, component) not in self.station.nodes:
            await anyio.sleep(0.01)
        return self.station.nodes[system, component]

    def of(self, kind: type[T]) -> list[T]:
        """Return the events of a kind."""
        return [event for event in self.events if isinstance(event, kind)]


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

    def emit(node: Node, event: ComponentEvent) -> None:
        conversation.events.append(event)

    def changed(node: Node, session: Session, change: Change) -> None:
        conversation.changes.append(change)

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
                spawn=tasks.start_soon,
                emit=emit,
                changed=changed,
                **options,
            )
        )
        for task in (read, write, conversation.station.send_heartbeats):
            tasks.start_soon(task)
        try:
            yield conversation
        finally:
            tasks.cancel_scope.cancel()


class Silence:
    """An endpoint that goes silent at a time, as a vehicle that crashes.

    Args:
        endpoint: the vehicle.
        at: seconds on the event loop's clock.
    """

    def __init__(self, endpoint: Endpoint, at: float) -> None:
        self.at = at
        self._endpoint = endpoint

    def receive(self, data: bytes, now: float) -> None:
        """Take a frame, unless silent."""
        if now < self.at:
            self._endpoint.receive(data, now)

    def tick(self, now: float) -> None:
        """Let the vehicle run."""
        self._endpoint.tick(now)

    def next_deadline(self) -> float | None:
        """Return when the vehicle has something to do."""
        return self._endpoint.next_deadline()

    def data_to_send(self) -> list[bytes]:
        """Return the frames of the vehicle; none while silent."""
        data = self._endpoint.data_to_send()
        return data if anyio.current_time() < self.at else []
