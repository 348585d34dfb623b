"""Worker: a thread for blocking calls."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any, Final, Generic, TypeVar

import anyio
import anyio.from_thread
import anyio.lowlevel

__all__ = ["Worker"]

Result = TypeVar("Result")

THREAD_END_INTERVAL: Final = 0.01
"""Seconds between two checks whether a thread has ended."""


class Worker:
    """One thread that runs blocking calls in order, until `close`. A call after `close` runs in a new thread.

    A thread of anyio's pool would stay idle until the event loop ends.

    Args:
        name: name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._calls: SimpleQueue[_Call[Any] | None] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._waiting: dict[_Call[Any], None] = {}
        self._is_closed = False
        self._ended_with: Callable[[], Exception] | None = None

    async def run(self, work: Callable[[], Result]) -> Result:
        """Run a call in the thread and return its result. Cancellation does not stop a queued call.

        Raises:
            Exception: that of `abandon`, if the call had not ended by then.
        """
        if self._ended_with is not None:
            raise self._ended_with()
        if self._thread is None:
            self._thread = threading.Thread(target=self._main, name=self._name, daemon=True)
            self._thread.start()
        call = _Call(work, self._waiting)
        self._calls.put(call)
        if self._is_closed:
            self._end()
        await call.ended.wait()
        return call.future.result()

    def drop(self, error: Callable[[], Exception]) -> None:
        """Drop all calls that have not begun: their callers, and later ones, get this error."""
        self._ended_with = error
        with suppress(Empty):
            while True:
                call = self._calls.get_nowait()
                if call is not None:
                    call.give_up(error())

    async def abandon(self, error: Callable[[], Exception], within: float) -> None:
        """End the thread as `drop` does. Wait at most these seconds for a call that has begun."""
        self.drop(error)
        thread = self._thread
        if thread is None:
            return
        self._end()
        with anyio.move_on_after(within, shield=True):
            while thread.is_alive():  # noqa: ASYNC110 - a thread sets no event
                await anyio.sleep(THREAD_END_INTERVAL)
        for call in list(self._waiting):
            call.give_up(error())

    async def close(self, work: Callable[[], None]) -> None:
        """Run a last call and end the thread."""
        if self._thread is None:
            work()
            return
        thread = self._thread
        try:
            await self.run(work)
        finally:
            with anyio.CancelScope(shield=True):
                while self._waiting:  # other tasks may have queued calls, and await their results here
                    await self.run(_nothing)
            self._is_closed = True
            self._end()
        thread.join()  # returns immediately: its queue is empty

    def _end(self) -> None:
        """End the thread after its queued calls."""
        self._calls.put(None)
        self._thread = None

    def _main(self) -> None:
        while (call := self._calls.get()) is not None:
            call.run()


class _Call(Generic[Result]):
    """One call: runs in the thread, and reports its end in the event loop."""

    def __init__(self, work: Callable[[], Result], waiting: dict[_Call[Any], None]) -> None:
        self.future: Future[Result] = Future()
        self.ended = anyio.Event()
        self._work = work
        self._waiting = waiting
        self._token = anyio.lowlevel.current_token()
        waiting[self] = None

    def run(self) -> None:
        """Run the call in the thread."""
        done: Future[Result] = Future()
        try:
            done.set_result(self._work())
        except BaseException as error:
            done.set_exception(error)
        with suppress(anyio.RunFinishedError):
            anyio.from_thread.run_sync(self._finish, done, token=self._token)

    def give_up(self, error: Exception) -> None:
        """Stop waiting for the call."""
        done: Future[Result] = Future()
        done.set_exception(error)
        self._finish(done)

    def _finish(self, done: Future[Result]) -> None:
        if not self.ended.is_set():
            self.future = done
            del self._waiting[self]
            self.ended.set()


def _nothing() -> None:
    return
