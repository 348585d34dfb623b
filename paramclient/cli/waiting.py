"""A line on the terminal that says what a command waits for."""

from __future__ import annotations

import sys
from collections.abc import Awaitable, Callable
from typing import Final, TypeVar

import anyio

from paramclient.cli.output import StatusLine

__all__ = ["while_waiting"]

Result = TypeVar("Result")

NOTICE_INTERVAL: Final = 0.5
"""Seconds between two updates of the line."""


async def while_waiting(
    work: Callable[[Callable[[], None]], Awaitable[Result]],
    awaited: str,
    received: Callable[[], str] = lambda: "",
) -> Result:
    """Await `work`; meanwhile, name the awaited response on a terminal. The line is erased at the end.

    Args:
        work: the function to await. Its argument is a function that erases the line for good, to call before
            anything else is printed.
        awaited: the awaited response in words.
        received: returns what was received so far, as a sentence.

    Raises:
        Exception: as from `work`.
    """
    line = StatusLine()
    if not sys.stderr.isatty():
        return await work(line.end)
    outcome: list[Result] = []
    failure: Exception | None = None
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_draw, line, awaited, received)
        try:
            outcome.append(await work(line.end))
        except Exception as error:  # raised here, the task group would wrap it in a group
            failure = error
        finally:
            line.end()
        tasks.cancel_scope.cancel()
    if failure is not None:
        raise failure
    return outcome[0]


async def _draw(line: StatusLine, awaited: str, received: Callable[[], str]) -> None:
    began = anyio.current_time()
    while True:
        line.draw(f"waiting for {awaited}", anyio.current_time() - began, received())
        await anyio.sleep(NOTICE_INTERVAL)
