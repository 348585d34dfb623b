"""Garbage collection of a process that serves: full collections skip the components that are followed, and
wait until no request waits and no job runs."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable
from typing import Final

import anyio

__all__ = ["GarbageCollection"]

CHECK_INTERVAL: Final = 1.0
"""Seconds between two checks."""
COLLECTED_COMPONENTS_MAX: Final = 32
"""Number of components that full garbage collections may examine: 5 ms. Also the number of forgotten
components that may occupy memory."""
COLLECTIONS_WHEN_IDLE: Final = 10
"""Collections of the middle generation, of about 7,000 new objects each, after which a full one runs at the
next idle check. Up to Python 3.13 it would run at any moment after as many. Python 3.14 collects in steps."""
COLLECTIONS_WHEN_BUSY: Final = 60
"""Collections of the middle generation after which a full one runs also while requests are in progress. At
most 420,000 objects are left as garbage, about 40 MB."""


class GarbageCollection:
    """Runs full garbage collections at moments when they delay nobody, as each blocks the event loop.

    A full collection of 460 waiting requests takes 20 ms, and one of 1,000 components 0.2 s. So it waits
    until no request waits and no job runs, and followed components are excluded by `gc.freeze`. A forgotten
    component that is excluded is never collected, so after some have been forgotten, one full collection
    examines everything.
    """

    def __init__(self) -> None:
        self._frozen: set[object] = set()
        self._followed: set[object] = set()
        self._forgotten = 0  # components, since everything was examined

    async def run(self, followed: Callable[[], Iterable[object]], is_busy: Callable[[], bool]) -> None:
        """Check every `CHECK_INTERVAL` seconds, until cancelled; then restore Python's thresholds.

        Args:
            followed: returns the followed components.
            is_busy: returns whether requests wait or jobs run.
        """
        before = gc.get_threshold()
        gc.set_threshold(*before[:2], COLLECTIONS_WHEN_BUSY)
        try:
            while True:
                await anyio.sleep(CHECK_INTERVAL)
                self.check(set(followed()), is_busy=is_busy())
        finally:
            gc.set_threshold(*before)

    def check(self, followed: set[object], *, is_busy: bool) -> None:
        """Collect what enough forgotten components occupy, freeze enough new ones, and collect if idle."""
        self._forgotten += len(self._followed - followed)
        self._followed = followed
        if self._forgotten >= COLLECTED_COMPONENTS_MAX:
            self._forgotten = 0
            self._frozen = followed
            gc.unfreeze()
            gc.collect()
            gc.freeze()
            return
        if len(followed - self._frozen) >= COLLECTED_COMPONENTS_MAX:
            self._frozen = followed
            gc.collect(1)  # garbage that is excluded would stay
            gc.freeze()
        if not is_busy and gc.get_count()[2] >= COLLECTIONS_WHEN_IDLE:
            gc.collect()
