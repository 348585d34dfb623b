"""SIGINT and SIGTERM, which end a command in an orderly way."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

__all__ = ["on_end_signal"]

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def on_end_signal(end: Callable[[int], object]) -> Iterator[None]:
    """Call `end` in the event loop on SIGINT or SIGTERM. A second signal ends the process immediately.

    Args:
        end: takes the signal number.
    """
    loop = asyncio.get_running_loop()
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def receive(number: int, _: FrameType | None) -> None:
        for each in _SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        loop.call_soon_threadsafe(end, number)

    for number in _SIGNALS:
        signal.signal(number, receive)  # not by the event loop, which has no signal handlers on Windows
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
