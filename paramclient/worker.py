"""A thread for what blocks."""

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
    """One thread for calls that block. They are done in order; `close` ends it.

    Not a thread of anyio's pool: that would be left behind, idle, until the event loop ends.

    Args:
        name: of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._calls: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread: threading.Thread | None = None

    async def run(self, work: Callable[[], Result]) -> Result:
        """Do it in the thread. Cancelled, it is done all the same."""
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
                anyio.from_thread.run_sync(ended.set, token=token)

        self._calls.put(call)
        await ended.wait()
        return future.result()

    async def close(self, work: Callable[[], None]) -> None:
        """Do a last piece of work, and end the thread."""
        if self._thread is None:
            work()
            return
        try:
            await self.run(work)
        finally:
            self._calls.put(None)
        self._thread.join()  # at once: it has nothing more to do

    def _main(self) -> None:
        while (call := self._calls.get()) is not None:
            call()
