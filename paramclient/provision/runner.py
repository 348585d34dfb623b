"""Runners of long computations: in place, or in the worker thread of a service."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

__all__ = ["Runner", "run_here"]

Result = TypeVar("Result")


class Runner(Protocol):
    """Runs a computation and returns its result, such as in a worker thread, to keep the event loop free.

    An exception of the computation is raised by the call. The computation touches nothing that the event
    loop may change meanwhile.
    """

    async def __call__(self, work: Callable[[], Result], /) -> Result: ...


async def run_here(work: Callable[[], Result], /) -> Result:
    """Run a computation in place."""
    return work()
