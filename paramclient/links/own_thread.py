"""Blocking calls of a link in a thread of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

import anyio
import anyio.from_thread
import anyio.lowlevel

__all__ = ["run_in_own_thread"]

T = TypeVar("T")


async def run_in_own_thread(
    work: Callable[[], T], *, undo: Callable[[T], object] | None = None, grace: float = 0.0
) -> T:
    """Run a blocking function in a thread of its own, and return its result.

    A thread of anyio's pool would stay idle until the event loop ends.

    Args:
        work: the function.
        undo: called with the result after a cancellation, even if the result arrives later.
        grace: seconds for which a cancellation waits for the end of the function.

    Raises:
        Exception: that of the function.
    """
    ended = anyio.Event()
    token = anyio.lowlevel.current_token()
    lock = threading.Lock()
    is_awaited = True
    results: list[T] = []
    failures: list[BaseException] = []

    def run() -> None:
        try:
            result = work()
            with lock:
                results.append(result)
                if is_awaited:
                    return
            if undo is not None:
                undo(result)
        except BaseException as error:
            failures.append(error)
        finally:
            with suppress(anyio.RunFinishedError):
                anyio.from_thread.run_sync(ended.set, token=token)

    thread = threading.Thread(target=run, name="paramclient link", daemon=True)
    thread.start()
    try:
        await ended.wait()
    except BaseException:
        with lock:
            is_awaited = False
            finished_before_cancel = bool(results)
        with anyio.move_on_after(grace, shield=True):
            await ended.wait()
            thread.join()
        if finished_before_cancel and undo is not None:
            undo(results[0])
        raise
    thread.join()
    if failures:
        raise failures[0]
    return results[0]
