"""ClientThread: an asynchronous client in an event loop of its own thread, and blocking calls to it."""

from __future__ import annotations

import atexit
import contextvars
import logging
import os
import threading
import time
import weakref
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, Final, Generic, ParamSpec, TypeVar

import anyio
import anyio.lowlevel
from anyio.from_thread import BlockingPortal

from paramclient.client.client import ParamClient
from paramclient.client.short_traceback import shortened
from paramclient.errors import ClientClosed, ParamClientError, UsageError

__all__ = ["ClientThread", "EventLoopThread", "ReportingCall"]

THREAD_NAME: Final = "paramclient blocking client"
"""Name of the thread, in debuggers."""
WAIT_INTERVAL: Final = 0.1
"""Seconds after which a waiting thread wakes up: Windows delivers Ctrl-C only then."""
CANCEL_TIMEOUT: Final = 0.5
"""Seconds for which an interrupted call waits until the client has cancelled it. Most calls take 1 ms. A file
transfer also closes its session on board, which continues in the background."""
EXIT_TIMEOUT: Final = 3.0
"""Seconds for which the end of the program waits until open clients are closed: longer than a file session
takes to be closed on board."""

logger = logging.getLogger(__name__)

Result = TypeVar("Result")
Item = TypeVar("Item")
Report = ParamSpec("Report")

_running: set[EventLoopThread] = set()
"""The threads that have not ended. The end of the program closes their clients."""


class ClientThread:
    """A client that runs in a thread of its own, for callers that block.

    The thread runs from `open` to `close`. It ends also when the last reference to this object is dropped,
    and at the end of the program. Several threads may call at the same time.

    Args:
        make: makes the client. It is called in a thread without an event loop.

    Attributes:
        client: the asynchronous client. While it is open, only its event loop may use it.

    Raises:
        Exception: that of `make`.
    """

    def __init__(self, make: Callable[[], ParamClient]) -> None:
        try:
            self.client = _outside_event_loops(make)
        except ParamClientError as error:
            raise shortened(error)  # noqa: B904 - the same error
        self._link = self.client.link.name
        self._thread: EventLoopThread | None = None
        self._is_closed = False
        self._shared: weakref.WeakValueDictionary[object, Any] = weakref.WeakValueDictionary()
        self._lock = threading.RLock()  # a signal handler may call `close` during any other call

    def open(self) -> None:
        """Start the thread, and open the client in it. An interrupted call closes the client again.

        Raises:
            UsageError: the client was opened before.
            ParamClientError: as from `paramclient.ParamClient.open`.
        """
        is_first = False
        try:
            with self._lock:
                if self._thread is None:
                    is_first = True
                    self._thread = EventLoopThread(self.client)
                    weakref.finalize(self, self._thread.end).atexit = False  # _end_all waits for its end
                    _end_all_at_exit()
                    self._thread.start()
            if self._is_closed:
                raise UsageError("a ParamClient can be opened only once; create a new one")
            self.call(self.client.open)
        except BaseException:
            if is_first:
                self._end()
            raise

    def close(self, *, failed: bool = False) -> None:
        """Close the client and end the thread; without effect on a client that is not open.

        Args:
            failed: close without waiting for a hash.

        Raises:
            Exception: as from `paramclient.ParamClient.aclose`.
        """
        if self._thread is None or self._is_closed:
            return
        try:
            with suppress(ClientClosed):  # another thread has closed it meanwhile
                self.call(partial(_close_quickly, self.client) if failed else self.client.aclose)
        finally:
            self._end()

    def _end(self) -> None:
        thread = self._thread
        assert thread is not None
        try:
            with self._lock:  # no call is being submitted
                self._is_closed = True
        finally:
            thread.end()
        thread.join()

    def call(self, function: Callable[[], Awaitable[Result]]) -> Result:
        """Run an asynchronous function in the event loop of the client, and return its result.

        KeyboardInterrupt, or another exception that a signal handler raises, cancels the function.

        Raises:
            ClientClosed: the client is not open.
            UsageError: the caller is in the event loop itself, or in a forked process.
            Exception: that of the function; see `shortened` for its traceback.
        """
        try:
            return self._run(_Call[Result](), function)
        except ParamClientError as error:
            raise shortened(error)  # noqa: B904 - the same error

    def call_reporting(
        self,
        function: Callable[..., Awaitable[Result]],
        progress: Callable[Report, None] | None,
    ) -> Result:
        """Run an asynchronous function that reports progress, as `call` does.

        Args:
            function: takes a callback as its argument `progress`.
            progress: called in the thread of the caller. An exception of it cancels the function.
        """
        call = _Call[Result]()
        try:
            return self._run(call, lambda: function(progress=call.reporter(progress)))
        except ParamClientError as error:
            raise shortened(error)  # noqa: B904 - the same error

    def begin_reporting(self, function: Callable[..., Awaitable[Result]]) -> ReportingCall[Any, Result]:
        """Start an asynchronous function that reports progress, without waiting for it.

        Args:
            function: takes a callback as its argument `progress`.

        Raises:
            ClientClosed: the client is not open.
            UsageError: the caller is in the event loop itself, or in a forked process.
        """
        call, reports = _Call[Result](), deque[Any]()
        work = partial(function, progress=call.reporter(reports.append))
        try:
            thread = self._begin(call, lambda thread: thread.submit(partial(call.run, work)))
        except _NoEventLoop as error:
            raise ClientClosed(str(error), link=self._link) from None
        return ReportingCall(call, thread, reports, self._link)

    def read(self, function: Callable[[], Result]) -> Result:
        """Run a function that does not wait, in the event loop while that runs. Return its result.

        Received values can also be read before the client is opened and after it is closed: then the function
        runs in the thread of the caller.

        Raises:
            Exception: that of the function.
        """
        if self._thread is not None and self._thread.is_current:
            return function()

        call = _Call[Result]()
        try:
            return self._wait(call, lambda thread: thread.call_soon(partial(call.run_at_once, function)))
        except _NoEventLoop:
            if self._thread is not None:
                self._thread.join()
            return function()

    def make(self, function: Callable[[], Result]) -> Result:
        """Run a function as `read` does, but never in a thread that has another event loop."""
        return self.read(function if self.is_open else partial(_outside_event_loops, function))

    def shared(self, key: object, make: Callable[[], Result]) -> Result:
        """Return the object that was made for a key, or make one if no reference to it remains."""
        with self._lock:
            found: Result | None = self._shared.get(key)
            if found is None:
                self._shared[key] = found = make()
            return found

    def release(self, used: list[Any]) -> None:
        """Clear a list in the event loop, which may be iterating over a weak set with its items.

        Takes no lock: the garbage collector may call this.
        """
        if self._thread is not None:
            self._thread.call_soon(used.clear)

    @property
    def is_open(self) -> bool:
        """Whether the event loop of the client runs."""
        return self._thread is not None and not self._is_closed

    @property
    def is_closed(self) -> bool:
        """Whether the client was opened, and is closed."""
        return self._is_closed

    def _run(self, call: _Call[Result], function: Callable[[], Awaitable[Result]]) -> Result:
        try:
            return self._wait(call, lambda thread: thread.submit(partial(call.run, function)))
        except _NoEventLoop as error:
            raise ClientClosed(str(error), link=self._link) from None

    def _wait(self, call: _Call[Result], begin: Callable[[EventLoopThread], None]) -> Result:
        """Begin a call and wait for its end. If that is interrupted, cancel it.

        Raises:
            _NoEventLoop: the client is not open.
        """
        thread = self._begin(call, begin)
        try:
            return call.wait(thread)
        except BaseException:
            if call.is_running:
                call.cancel(thread)
            raise

    def _begin(self, call: _Call[Result], begin: Callable[[EventLoopThread], None]) -> EventLoopThread:
        """Begin a call. If that is interrupted, cancel it.

        Raises:
            _NoEventLoop: the client is not open.
        """
        thread = self._thread
        if thread is None:
            raise _NoEventLoop("the client is not open; use `with` or `open`")
        try:
            with self._lock:  # the event loop does not end meanwhile
                if self._is_closed:
                    raise _NoEventLoop("the client was closed")
                thread.check_caller()
                call.is_running = True
                begin(thread)
            return thread
        except BaseException:
            if call.is_running:
                call.cancel(thread)
            raise


class EventLoopThread:
    """A thread with an event loop in which a client runs, until `end`.

    Args:
        client: the client to close at the end.
    """

    def __init__(self, client: ParamClient) -> None:
        self._client = client
        self._process = os.getpid()
        self._error: Exception | None = None
        self._loop: Any = None
        self._is_ending = False
        self._has_started = threading.Event()
        self._thread = threading.Thread(target=self._main, name=THREAD_NAME, daemon=True)

    def start(self) -> None:
        """Start the thread and its event loop.

        Raises:
            Exception: the event loop cannot be created, such as OSError for too many open files.
        """
        _running.add(self)
        self._thread.start()
        self._has_started.wait()
        if self._error is not None:
            raise self._error

    @property
    def is_current(self) -> bool:
        """Whether the caller runs in this thread."""
        return threading.get_ident() == self._thread.ident

    @property
    def is_running(self) -> bool:
        """Whether the event loop has not ended."""
        return self._thread.is_alive()

    def check_caller(self) -> None:
        """Check that the caller can wait for a call.

        Raises:
            UsageError: the caller is in this thread, or in a forked process.
        """
        if self.is_current:
            raise UsageError("a call that blocks cannot be made from a callback in the client's event loop")
        if os.getpid() != self._process:
            raise UsageError("a client cannot be used in a forked process; create a new one there")

    def submit(self, function: Callable[[], Awaitable[None]]) -> None:
        """Start a function in a task of its own. It must not raise an exception.

        Raises:
            _NoEventLoop: the event loop has ended, as at the end of the program.
        """
        try:
            self._portal.start_task_soon(function)
        except RuntimeError:
            raise _NoEventLoop("the client was closed") from None

    def end(self) -> None:
        """Close the client unless it is closed, and end the thread. Does not wait, and takes no lock."""
        self._is_ending = True
        if self._loop is not None and os.getpid() == self._process:
            self.call_soon(self._is_to_end.set)

    def call_soon(self, function: Callable[[], object]) -> None:
        """Run a function in the event loop. Does not wait, and takes no lock."""
        with suppress(RuntimeError):  # the event loop has ended
            self._loop.call_soon_threadsafe(function)

    def join(self, timeout: float | None = None) -> None:
        """Wait until the thread has ended, at most for these seconds."""
        has_started = self._thread.ident is not None
        if has_started and not self.is_current and os.getpid() == self._process:
            self._thread.join(timeout)

    def _main(self) -> None:
        try:
            contextvars.Context().run(anyio.run, self._serve)
        except Exception as error:
            if self._has_started.is_set():
                raise
            self._error = error
        finally:
            self._has_started.set()
            _running.discard(self)

    async def _serve(self) -> None:
        self._is_to_end = anyio.Event()
        self._loop = anyio.lowlevel.current_token().native_token
        async with BlockingPortal() as self._portal:
            self._has_started.set()
            if not self._is_ending:
                await self._is_to_end.wait()
            try:
                await _close_quickly(self._client)
            except Exception:
                logger.exception("%s: an unexpected error on closing the client", self._client.link.name)
            await self._portal.stop(cancel_remaining=True)


class _Call(Generic[Result]):
    """One call: runs in the event loop, and is waited for by the thread of its caller.

    Attributes:
        is_running: whether the event loop has the call, or will have it.
    """

    def __init__(self) -> None:
        self.is_running = False
        self._reports: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._scope: anyio.CancelScope | None = None
        self._is_cancelled = False
        self._error: Exception | None = None
        self._result: Result

    def reporter(self, progress: Callable[Report, None] | None) -> Callable[Report, None] | None:
        """Return a function that has `progress` called in the thread of the caller."""
        if progress is None:
            return None

        def report(*args: Report.args, **kwargs: Report.kwargs) -> None:
            self._reports.put(partial(progress, *args, **kwargs))

        return report

    async def run(self, function: Callable[[], Awaitable[Result]]) -> None:
        """Run a function in the event loop, and keep its result or error."""
        try:
            with anyio.CancelScope() as self._scope:
                if self._is_cancelled:
                    self._scope.cancel()
                self._result = await function()
        except Exception as error:
            self._error = error
        except anyio.get_cancelled_exc_class():
            self._error = _NoEventLoop("the client was closed")
            raise
        finally:
            self.is_running = False
            self._reports.put(None)

    def run_at_once(self, function: Callable[[], Result]) -> None:
        """Run a function that does not wait in the event loop, and keep its result or error."""
        try:
            self._result = function()
        except Exception as error:
            self._error = error
        finally:
            self.is_running = False
            self._reports.put(None)

    def wait(self, thread: EventLoopThread) -> Result:
        """Wait for the end, and call the progress callbacks meanwhile.

        Raises:
            _NoEventLoop: the event loop has ended first.
            Exception: that of the function, or of a progress callback.
        """
        while self.receive(thread):
            pass
        return self.outcome()

    def receive(self, thread: EventLoopThread) -> bool:
        """Wait for a report, and call its callback; return False after the end instead.

        Raises:
            _NoEventLoop: the event loop has ended first.
            Exception: that of the callback.
        """
        report = self._next_report(thread, None)
        if report is not None:
            report()
        return report is not None

    def outcome(self) -> Result:
        """Return the result of a call that has ended.

        Raises:
            _NoEventLoop: the event loop has ended first.
            Exception: that of the function.
        """
        if self._error is not None:
            raise self._error
        return self._result

    def cancel(self, thread: EventLoopThread) -> None:
        """Cancel the call, and wait for its end, at most `CANCEL_TIMEOUT` seconds."""
        self._is_cancelled = True
        thread.call_soon(self.cancel_scope)
        deadline = time.monotonic() + CANCEL_TIMEOUT
        with suppress(Empty, _NoEventLoop):
            while self._next_report(thread, deadline) is not None:
                pass

    def cancel_scope(self) -> None:
        """Cancel the call. To be called in the event loop."""
        if self._scope is not None:
            self._scope.cancel()

    def _next_report(self, thread: EventLoopThread, deadline: float | None) -> Callable[[], None] | None:
        """Return the next progress call, or None after the end.

        Raises:
            Empty: the deadline has passed.
            _NoEventLoop: the event loop has ended without an end of the call.
        """
        while True:
            is_running = thread.is_running
            left = WAIT_INTERVAL if deadline is None else min(WAIT_INTERVAL, deadline - time.monotonic())
            try:
                return self._reports.get(timeout=max(left, 0.0))
            except Empty:
                if not is_running:
                    self.is_running = False
                    raise _NoEventLoop("the client was closed") from None
                if left <= 0.0:
                    raise


class ReportingCall(Iterator[Item], Generic[Item, Result]):
    """A running call as an iterator of its reports.

    Ctrl-C while an item is awaited cancels the call, and so does dropping the last reference to this object.

    Args:
        call: the call, which runs.
        thread: its event loop.
        reports: the reports that the iterator has not yet yielded.
        link: name of the link, for errors.
    """

    def __init__(self, call: _Call[Result], thread: EventLoopThread, reports: deque[Item], link: str) -> None:
        self._call = call
        self._thread = thread
        self._reports = reports
        self._link = link
        self._is_ended = False
        weakref.finalize(self, thread.call_soon, call.cancel_scope).atexit = False

    def __next__(self) -> Item:
        while not self._reports:
            if self._is_ended:
                raise StopIteration
            self._receive()
        return self._reports.popleft()

    @property
    def result(self) -> Result:
        """The result of the call, after its end; until then, waits for it and discards the reports.

        Raises:
            ClientClosed: the client was closed.
            Exception: that of the function.
        """
        while not self._is_ended:
            self._receive()
            self._reports.clear()
        return self._result()

    def _receive(self) -> None:
        """Wait for a report, or for the end of the call.

        Raises:
            ClientClosed: the client was closed.
            Exception: that of the function.
        """
        try:
            self._is_ended = not self._call.receive(self._thread)
        except _NoEventLoop as error:
            self._is_ended = True
            raise ClientClosed(str(error), link=self._link) from None
        except BaseException:
            self._call.cancel(self._thread)
            raise
        if self._is_ended:
            self._result()

    def _result(self) -> Result:
        try:
            return self._call.outcome()
        except _NoEventLoop as error:
            raise ClientClosed(str(error), link=self._link) from None
        except ParamClientError as error:
            raise shortened(error)  # noqa: B904 - the same error


class _NoEventLoop(Exception):
    """No event loop runs that could take a call, or it has ended during the call."""


def _outside_event_loops(function: Callable[[], Result]) -> Result:
    """Run a function in a thread without an event loop, as synchronization primitives belong to theirs.

    Raises:
        Exception: that of the function.
    """
    results: list[Result] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(function())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=contextvars.Context().run, args=(run,), name=THREAD_NAME, daemon=True)
    thread.start()
    thread.join()
    if errors:
        try:
            raise errors.pop()
        finally:
            del errors
    return results[0]


async def _close_quickly(client: ParamClient) -> None:
    """Close a client without waiting for a hash."""
    with anyio.CancelScope() as scope:
        scope.cancel()
        await client.aclose()


def _end_all() -> None:
    """Close the clients that are open at the end of the program."""
    threads = [thread for thread in _running if thread.is_running]
    for thread in threads:
        thread.end()
    deadline = time.monotonic() + EXIT_TIMEOUT
    for thread in threads:
        thread.join(max(deadline - time.monotonic(), 0.0))


def _end_all_at_exit() -> None:
    """Call `_end_all` at exit, before `weakref.finalize`, which is registered already, closes the cache."""
    atexit.unregister(_end_all)
    atexit.register(_end_all)
