"""Garbage collection of a process that serves: full collections skip the components that are followed."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable
from typing import Final

import anyio

__all__ = ["ComponentFreezer"]

FREEZE_INTERVAL: Final = 1.0
"""Seconds between two checks of the number of followed components."""
COLLECTED_COMPONENTS_MAX: Final = 32
"""Number of components that full garbage collections may examine: 5 ms."""


class ComponentFreezer:
    """Excludes followed components from full garbage collections, by `gc.freeze`.

    A full collection of 1,000 components takes 0.2 s and blocks the event loop. After components have been
    forgotten, one full collection examines everything before the others are excluded again.
    """

    def __init__(self) -> None:
        self._frozen: set[object] = set()
        self._unfrozen_at: int | None = None  # number of full collections at that time

    async def run(self, followed: Callable[[], Iterable[object]]) -> None:
        """Check the followed components every `FREEZE_INTERVAL` seconds; until cancelled."""
        while True:
            await anyio.sleep(FREEZE_INTERVAL)
            self.check(set(followed()))

    def check(self, followed: set[object]) -> None:
        """Freeze new components, or unfreeze all if enough of the frozen ones are no longer followed."""
        if len(self._frozen - followed) >= COLLECTED_COMPONENTS_MAX:
            gc.unfreeze()
            self._frozen = set()
            self._unfrozen_at = _full_collections()
        elif (
            len(followed - self._frozen) >= COLLECTED_COMPONENTS_MAX
            and self._unfrozen_at != _full_collections()
        ):
            gc.freeze()
            self._frozen = followed
            self._unfrozen_at = None


def _full_collections() -> int:
    return int(gc.get_stats()[2]["collections"])
