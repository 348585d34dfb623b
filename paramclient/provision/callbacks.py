"""Calls of the functions that the caller of a set-up gives."""

from __future__ import annotations

import inspect
from collections.abc import Callable

__all__ = ["call_and_wait"]


async def call_and_wait(function: Callable[[], object]) -> None:
    """Call a function; if it is asynchronous, wait for its end."""
    result = function()
    if inspect.isawaitable(result):
        await result
