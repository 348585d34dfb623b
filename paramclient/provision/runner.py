"""Functions that the caller of a set-up gives: runners of long computations, and `before_writing`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Protocol, TypeVar

__all__ = ["Runner", "call_and_wait", "run_here"]

Result = TypeVar("Result")


class Runner(Protocol):
    """Runs a computation and returns its result, for example in a worker thread to keep the event loop free.

    The call raises the exception of the computation. The computation must not use objects that the event
    loop may change while it runs.
    """

    async def __call__(self, work: Callable[[], Result], /) -> Result: ...


async def run_here(work: Callable[[], Result], /) -> Result:
    """Run a computation in the calling task."""
    return work()


async def call_and_wait(function: Callable[[], object]) -> None:
    """Call a function; if it is asynchronous, wait for its end."""
    result = function()
    if inspect.isawaitable(result):
        await result
