"""An operation with exactly one end: the base of every read, write and download."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Generic, TypeVar

__all__ = ["Operation"]

Result = TypeVar("Result")


class Operation(Generic[Result]):
    """An operation that ends once, with a result or with an error.

    Attributes:
        result, error: one of them is set when `done`.
        begun_at, ended_at: in the time of the `now` arguments.
        on_done: called once, in order, at the end. Callers that wait add a callback here.
    """

    def __init__(self, begun_at: float) -> None:
        self.begun_at = begun_at
        self.ended_at = math.inf
        self.done = False
        self.result: Result | None = None
        self.error: Exception | None = None
        self.on_done: list[Callable[[], None]] = []

    def finish(self, result: Result, now: float) -> None:
        """End with a result; later ends are ignored."""
        if not self.done:
            self.result = result
            self._end(now)

    def fail(self, error: Exception, now: float) -> None:
        """End with an error; later ends are ignored."""
        if not self.done:
            self.error = error
            self._end(now)

    def drop_callbacks(self) -> None:
        """Drop the callbacks: the operation was given up, and its end matters to no caller.

        They refer to the operation, so that without this only a garbage collection would free it.
        """
        self.on_done.clear()

    def _end(self, now: float) -> None:
        self.done = True
        self.ended_at = now
        callbacks, self.on_done = self.on_done, []
        for callback in callbacks:
            callback()
