"""The blocking client, made awaitable: each call runs in a thread, the client in the event loop of the test.

The tests of the asynchronous client run through it; see `tests/client_kinds.py`. Time is that of the test's
event loop: where that is a `SimulatedTimeLoop`, its clock stands still while a thread is at work, and leaps
while all threads wait for the client.
"""

from __future__ import annotations

import asyncio
import inspect
import threading
import weakref
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import fields, replace
from functools import partial
from queue import Empty, SimpleQueue
from types import MappingProxyType
from typing import Any, TypeVar

import anyio
import pytest

import paramclient
from paramclient import Component, ParamClient, sync
from paramclient.sync import client_thread
from paramclient.sync.wrappers import BlockingStream, wrapped_by

__all__ = ["BlockedClient", "BlockedStream", "block", "unblocked"]

Result = TypeVar("Result")

INTERFACES: dict[type, type] = {
    sync.ParamClient: ParamClient,
    sync.Component: Component,
    sync.ExtParams: paramclient.ExtParams,
    sync.Ftp: paramclient.Ftp,
}
"""The blocking classes, and the asynchronous ones."""

EVENTS: dict[type, type] = {
    getattr(sync, name): getattr(paramclient, name)
    for name in ("Discovered", "Lost", "Found", "Rebooted", "Resynced", "Contested", "Uncontested")
}


def block(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let blocking clients run in the event loop of the test."""
    monkeypatch.setattr(client_thread, "EventLoopThread", LoopOfTest)
    monkeypatch.setattr(client_thread, "SimpleQueue", CountingQueue)


class Interrupted(BaseException):
    """What KeyboardInterrupt is in the main thread: the end of a call that is cancelled."""


class Caller:
    """A call that blocks a thread, and its place in the event loop.

    Args:
        call: the call.
    """

    here = threading.local()
    """The caller that runs in this thread."""

    def __init__(self, call: Callable[[], Any]) -> None:
        self.loop = asyncio.get_running_loop()
        self._call = call
        self._ended = self.loop.create_future()
        self._queue: CountingQueue | None = None
        self._is_interrupted = False

    async def run(self) -> Any:
        """Run the call. Cancellation interrupts it, and waits for its end."""
        self.count(1)
        threading.Thread(target=self._main, name="blocked caller", daemon=True).start()
        try:
            return await asyncio.shield(self._ended)
        except asyncio.CancelledError:
            self._is_interrupted = True
            self._interrupt()
            with anyio.CancelScope(shield=True):
                while not self._ended.done():
                    await asyncio.wait([self._ended])
            self._ended.exception()
            raise

    def count(self, change: int) -> None:
        """Report to a `SimulatedTimeLoop` that the thread begins or ends to work."""
        if hasattr(self.loop, "threads"):
            self.loop.threads += change

    def wait(self, queue: CountingQueue) -> None:
        """The thread waits for this queue. Called in the event loop."""
        self.count(-1)
        self._queue = queue
        if self._is_interrupted:
            self._interrupt()

    def go_on(self) -> None:
        """The thread has something to do again. Called in the event loop."""
        self.count(1)
        self._queue = None

    def _interrupt(self) -> None:
        """Raise an exception in the thread, which waits."""
        if self._queue is not None:
            self._is_interrupted = False
            self._queue.put(_raise_interrupted)

    def _main(self) -> None:
        self.here.caller = self
        end: Callable[[], None]
        try:
            end = partial(self._ended.set_result, self._call())
        except BaseException as error:
            end = partial(self._ended.set_exception, error)
        self.loop.call_soon_threadsafe(self._end, end)

    def _end(self, end: Callable[[], None]) -> None:
        self.count(-1)
        end()


def _raise_interrupted() -> None:
    raise Interrupted


class CountingQueue:
    """A queue between the event loop, which puts, and one thread, which is counted while it has work."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[Any] = SimpleQueue()
        self._items_put = 0
        self._items_got = 0
        self._waiting: Caller | None = None

    def put(self, item: object) -> None:
        """Add an item. Called in the event loop."""
        self._items_put += 1
        if self._waiting is not None:
            self._waiting.go_on()
            self._waiting = None
        self._queue.put(item)

    def get(self, timeout: float | None = None) -> object:
        """Return an item. Called in the thread; the timeout is for the clock of another event loop."""
        try:
            item = self._queue.get_nowait()
        except Empty:
            caller: Caller = Caller.here.caller
            caller.loop.call_soon_threadsafe(self._wait, caller, self._items_got)
            item = self._queue.get()
        self._items_got += 1
        return item

    def _wait(self, caller: Caller, items_got: int) -> None:
        if self._items_put == items_got:  # nothing was put meanwhile
            self._waiting = caller
            caller.wait(self)


class LoopOfTest:
    """In place of `EventLoopThread`: the event loop that runs already."""

    def __init__(self, client: ParamClient) -> None:
        self._loop: asyncio.AbstractEventLoop = Caller.here.caller.loop
        self._thread = threading.main_thread().ident
        self._tasks: set[asyncio.Task[None]] = set()
        self.is_running = True

    def start(self) -> None:
        pass

    @property
    def is_current(self) -> bool:
        return threading.get_ident() == self._thread

    def check_caller(self) -> None:
        assert not self.is_current

    def submit(self, function: Callable[[], Any]) -> None:
        self.call_soon(partial(self._start, function))

    def _start(self, function: Callable[[], Any]) -> None:
        task = self._loop.create_task(function())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def call_soon(self, function: Callable[[], object]) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(function)

    def end(self) -> None:
        self.is_running = False

    def join(self, timeout: float | None = None) -> None:
        pass


class Blocked:
    """An object of the blocking client whose calls can be awaited, as those of the asynchronous one.

    Args:
        blocking: the object.
    """

    def __init__(self, blocking: Any) -> None:
        self._blocking = blocking

    def __repr__(self) -> str:
        return repr(self._blocking)

    def __getattr__(self, name: str) -> Any:
        interface = INTERFACES[next(kind for kind in INTERFACES if isinstance(self._blocking, kind))]
        value = getattr(self._blocking, "close" if name == "aclose" else name)
        if inspect.iscoroutinefunction(getattr(interface, name, None)):
            return partial(self._awaited, value)
        if inspect.ismethod(value):
            return lambda *args: shown(value(*map(hidden, args)))
        return shown(value)

    async def _awaited(self, value: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        return shown(await Caller(lambda: value(*map(hidden, args), **kwargs)).run())


KNOWN: weakref.WeakValueDictionary[object, Blocked] = weakref.WeakValueDictionary()
"""By the asynchronous object: tests compare components by identity."""


class BlockedClient(Blocked):
    """A blocking client whose calls can be awaited."""

    def __init__(self, link: Any, **options: Any) -> None:
        super().__init__(sync.ParamClient(link, **options))

    async def __aenter__(self) -> BlockedClient:
        await Caller(self._blocking.__enter__).run()
        return self

    async def __aexit__(self, *error: Any) -> None:
        await Caller(lambda: self._blocking.__exit__(*error)).run()


class BlockedStream(AsyncIterator[Any]):
    """A stream of the blocking client as an asynchronous one."""

    def __init__(self, blocking: BlockingStream[Any]) -> None:
        self._blocking = blocking

    async def __anext__(self) -> Any:
        ended = object()
        item = shown(await Caller(lambda: next(self._blocking, ended)).run())
        if item is ended:
            raise StopAsyncIteration
        return item

    def shown(self, item: Any) -> Any:
        """Return what the test sees of an item of the asynchronous stream."""
        return shown(self._blocking._made(item))


def shown(value: Any) -> Any:
    """Return what the test sees of a value: calls that it can await, and asynchronous events."""
    if is_awaitable(value):
        return KNOWN.setdefault(wrapped_by(value), Blocked(value))
    if isinstance(value, BlockingStream):
        return BlockedStream(value)
    if type(value) in EVENTS:
        values = {each.name: shown(getattr(value, each.name)) for each in fields(value)}
        return EVENTS[type(value)](**values)
    if isinstance(value, list):
        return [shown(each) for each in value]
    if isinstance(value, Mapping) and any(map(is_awaitable, value.values())):
        return MappingProxyType({key: shown(each) for key, each in value.items()})
    return value


def is_awaitable(value: Any) -> bool:
    """Whether a value is an object with calls that block."""
    return isinstance(value, tuple(INTERFACES))


def hidden(value: Any) -> Any:
    """Return what the blocking client takes for a value."""
    return value._blocking if isinstance(value, Blocked) else value


def unblocked(value: Any) -> Any:
    """Return the asynchronous object behind one that was made awaitable again."""
    if isinstance(value, BlockedStream):
        return value._blocking._stream[0]
    if type(value) in EVENTS.values():
        return replace(value, component=unblocked(value.component))
    return wrapped_by(value._blocking) if isinstance(value, Blocked) else value
