"""Worker: a thread for blocking calls."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from queue import SimpleQueue
from typing import TypeVar

import anyio
import anyio.from_thread
import anyio.lowlevel

__all__ = ["Worker"]

Result = TypeVar("Result")


class Worker:
    """One thread that runs blocking calls in order, until `close`. A call after `close` runs in a new thread.

    A thread of anyio's pool would stay idle until the event loop ends.

    Args:
        name: name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._calls: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._under_way = 0
        self._is_closed = False

    async def run(self, work: Callable[[], Result]) -> Result:
        """Run a call in the thread and return its result. Cancellation does not stop a queued call."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._main, name=self._name, daemon=True)
            self._thread.start()
        future: Future[Result] = Future()
        ended = anyio.Event()
        token = anyio.lowlevel.current_token()

        def call() -> None:
            try:
                future.set_result(work())
            except BaseException as error:
                future.set_exception(error)
            with suppress(anyio.RunFinishedError):
                anyio.from_thread.run_sync(done, token=token)

        def done() -> None:
            self._under_way -= 1
            ended.set()

        self._under_way += 1
        self._calls.put(call)
        if self._is_closed:
            self._end()
        await ended.wait()
        return future.result()

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
                while self._under_way:  # other tasks may have queued calls, and await their results here
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
            call()


def _nothing() -> None:
    return
