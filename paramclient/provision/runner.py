"""Runners of long computations: in the calling task, or in a worker thread of a service."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

__all__ = ["Runner", "run_here"]

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
