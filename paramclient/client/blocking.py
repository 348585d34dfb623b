"""The blocking client: proxies of the objects of an asynchronous client, which runs in its own thread."""

from __future__ import annotations

import atexit
import inspect
import os
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent import futures
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial, wraps
from queue import Empty, SimpleQueue
from types import MappingProxyType
from typing import Any, ClassVar, Final, Self

import anyio
from anyio.from_thread import BlockingPortal, start_blocking_portal

import paramclient.client.client as asynchronous
from paramclient.client import component, streams
from paramclient.errors import ClientClosed, ParamClientError, UsageError
from paramclient.protocol.addresses import Address

THREAD_NAME: Final = "paramclient blocking client"
"""Name of the thread of a client, in debuggers."""
WAIT_INTERVAL: Final = 0.1
"""Seconds after which a waiting thread wakes up: Windows delivers Ctrl-C only then."""


class _Session:
    """An asynchronous client in an event loop of its own thread.

    The thread ends when the client is closed, when the last proxy of the session is dropped, or with the
    program.

    Args:
        make: makes the client.
    """

    def __init__(self, make: Callable[[], asynchronous.ParamClient]) -> None:
        with ExitStack() as thread:
            self._portal = thread.enter_context(start_blocking_portal(name=THREAD_NAME))
            self.client = self._portal.call(make)
            self._thread = thread.pop_all()
        self.proxies: weakref.WeakValueDictionary[object, Proxy] = weakref.WeakValueDictionary()
        self._running: list[futures.Future[Any]] = []
        self._process = os.getpid()
        self._end = weakref.finalize(self, _end_in_background, self._portal, self.client, self._thread)
        self._end.atexit = False  # `_close_all` ends it
        _sessions.add(self)

    def close(self) -> None:
        """Close the client, and end the thread. Without effect after the first call."""
        try:
            with suppress(ClientClosed):
                self.run(self.client.aclose)
        finally:
            if self._end.detach() is not None:
                self._thread.close()

    def run(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call a function in the event loop, and await what it returns. Return the result as a proxy.

        Callbacks among the arguments are called in this thread. KeyboardInterrupt, or another exception of
        a signal handler or a callback, cancels the call.

        Raises:
            ClientClosed: the client was closed.
            UsageError: the caller is in the event loop itself, or in a forked process.
        """
        calls: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        values = [self._argument(calls, "", value) for value in args]
        options = {name: self._argument(calls, name, value) for name, value in kwargs.items()}
        if os.getpid() != self._process:
            raise UsageError("a client cannot be used in a forked process; create a new one there")
        try:
            future = self._portal.start_task_soon(partial(function, *values, **options))
        except RuntimeError as error:
            if "event loop thread" in str(error):
                raise UsageError("a blocking call cannot be made in the event loop of its client") from None
            raise ClientClosed("the client was closed", link=self.client.link.name) from None
        future.add_done_callback(lambda _: calls.put(None))
        self._running.append(future)
        try:
            while (call := _next(calls)) is not None:
                call()
            return self.shown(future.result())
        except futures.CancelledError:
            raise ClientClosed("the client was closed", link=self.client.link.name) from None
        except BaseException:
            future.cancel()
            raise
        finally:
            self._running.remove(future)

    def cancel(self) -> None:
        """Cancel the calls that run in other threads."""
        for future in list(self._running):
            future.cancel()

    def read(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call a function that also works with a closed client: in the event loop, or after its end, when
        nothing waits, in another one."""
        if self._end.alive:
            return self.run(function, *args)
        with start_blocking_portal() as portal:
            return self.shown(portal.call(function, *map(_target_of, args)))

    def shown(self, value: Any) -> Any:
        """Return a value of the client as the caller is to see it."""
        kind = Proxy._kinds.get(type(value))
        if kind is not None:
            found = self.proxies.get(value)
            if found is None:
                found = self.proxies[value] = kind.__new__(kind)
                found._session, found._target = self, value
            return found
        if isinstance(value, list):
            return [self.shown(each) for each in value]
        if isinstance(value, MappingProxyType):
            return {key: self.shown(each) for key, each in value.items()}
        if isinstance(value, asynchronous.Event):
            return replace(value, component=self.shown(value.component))
        return value

    def _argument(self, calls: SimpleQueue[Callable[[], object] | None], name: str, value: Any) -> Any:
        """Return an argument of a call as the client is to see it."""

        async def ask(*items: Any) -> None:
            answered = anyio.Event()
            call = partial(value, *map(self.shown, items))
            calls.put(lambda: (call(), self._portal.start_task_soon(answered.set)))
            await answered.wait()

        if name == "progress" and value is not None:
            return lambda *items: calls.put(partial(value, *map(self.shown, items)))
        if name == "before_writing" and value is not None:
            return ask
        if isinstance(value, list | tuple):
            return type(value)(map(_target_of, value))
        return list(value) if isinstance(value, Iterator) else _target_of(value)


_sessions: weakref.WeakSet[_Session] = weakref.WeakSet()


class Proxy:
    """An object of the client. Its methods block, and its attributes are those of the object."""

    _kinds: ClassVar[dict[type | None, type[Proxy]]] = {}  # by the class of the client's objects
    _session: _Session
    _target: Any

    def __init_subclass__(cls, of: type | None = None) -> None:
        cls._kinds[of] = cls

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        target, session = self._target, self._session
        method = getattr(type(target), name, None)
        if inspect.isfunction(method):
            call = session.run if inspect.iscoroutinefunction(method) else session.read
            return wraps(method)(partial(call, getattr(target, name)))
        if name in vars(target):
            return session.shown(vars(target)[name])
        return session.read(getattr, target, name)

    def __dir__(self) -> list[str]:
        return sorted(name for name in dir(self._target) if not name.startswith("_"))

    def __repr__(self) -> str:
        shown: str = self._session.read(repr, self._target)
        return shown


class ParamClient(Proxy, of=asynchronous.ParamClient):
    """See `paramclient.ParamClient`: the same arguments and calls, without `await`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._session = _Session(partial(asynchronous.ParamClient, *args, **kwargs))
        self._target = self._session.client
        self._session.proxies[self._target] = self

    def open(self) -> Self:
        """Open the client without a `with`, until `close`. Return the client."""
        try:
            self._session.run(self._target.open)
        except BaseException:
            if self._target.core.state == "closed":
                self.close()
            raise
        return self

    def close(self) -> None:
        """Close the client, as on exit from a `with`. Calls that wait in other threads raise ClientClosed."""
        self._session.close()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *error: object) -> None:
        self.close()


class Component(Proxy, of=component.Component):
    """See `paramclient.Component`."""


class Stream(Proxy, Iterator[Any]):
    """Items as they arrive: a `for` loop waits for each. Ctrl-C loses none."""

    def __next__(self) -> Any:
        return self.next()

    def next(self, timeout: float | None = None) -> Any:
        """Return the next item.

        Args:
            timeout: seconds; None waits without limit.

        Raises:
            TimeoutError: no item arrived in time. None is lost: it remains for the next call.
            StopIteration: the stream has ended, as at the end of a log.
            ParamClientError: the stream has ended with this error.
        """
        taken: deque[Any] = self.__dict__.setdefault("_taken", deque())  # an interrupted call leaves its item
        if not taken:
            try:
                self._session.read(self._take, taken, timeout)
            except StopAsyncIteration:
                raise StopIteration from None
        return self._session.shown(taken.popleft())

    async def _take(self, taken: deque[Any], timeout: float | None) -> None:
        """Move one item into `taken`."""
        with anyio.fail_after(timeout):
            taken.append(await anext(self._target))


class Changes(Stream, of=streams.Changes):
    """See `paramclient.Changes`."""


class Events(Stream, of=asynchronous.Events):
    """See `paramclient.Events`."""


def blocking(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that takes a client or a component with calls that block."""

    @wraps(function)
    def call(first: Proxy, *args: Any, **kwargs: Any) -> Any:
        return first._session.run(function, first, *args, **kwargs)

    return call


def call_each(components: Iterable[Any], call: Callable[[Any], Any]) -> tuple[dict[Address, Any], ...]:
    """Make a call for each vehicle, each in a thread. Return the results and the errors by address."""
    vehicles = {(each.system, each.component): each for each in components}
    results: dict[Address, Any] = {}
    errors: dict[Address, Any] = {}
    with ThreadPoolExecutor(max(len(vehicles), 1)) as threads:
        calls = {address: threads.submit(call, vehicle) for address, vehicle in vehicles.items()}
        try:
            for address, running in calls.items():
                try:
                    results[address] = running.result()
                except ParamClientError as error:
                    errors[address] = error
        except BaseException:  # such as Ctrl-C
            for vehicle in vehicles.values():
                vehicle._session.cancel()
            raise
    return results, errors


def _target_of(value: Any) -> Any:
    return value._target if isinstance(value, Proxy) else value


def _next(calls: SimpleQueue[Callable[[], object] | None]) -> Callable[[], object] | None:
    while True:
        with suppress(Empty):
            return calls.get(timeout=WAIT_INTERVAL)


def _end_in_background(
    portal: BlockingPortal, client: asynchronous.ParamClient, portal_thread: ExitStack
) -> None:
    """Close a client whose last reference was dropped. The garbage collector may call this in any thread."""

    def end() -> None:
        with suppress(Exception):
            portal.call(client.aclose)
        portal_thread.close()

    threading.Thread(target=end, name=THREAD_NAME).start()


@atexit.register
def _close_all() -> None:
    """Close the clients that are open at the end of the program."""
    for session in list(_sessions):
        with suppress(ClientClosed, UsageError):
            session.close()
