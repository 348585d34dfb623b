"""Which components' telemetry is looked into for their time since boot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

__all__ = ["ClockSampling"]

SAMPLE_TIME: Final = 0.1
"""Seconds after a heartbeat for which a component's clocks are read. Messages at 10 Hz and more come in that
time; longer for one none of whose clocks has come, until one does."""


class ClockSampling:
    """Opens a window with each heartbeat in which frames with `time_boot_ms` are given out.

    To make an object of each frame of telemetry would cost a third of what framing costs. A restart shows in
    any later clock as well as in the first.

    Args:
        choose: takes whether frames with clocks are wanted now, whenever that changes.
    """

    def __init__(self, choose: Callable[[bool], None]) -> None:
        self._choose = choose
        self._open: dict[tuple[int, int], float] = {}  # by component, until when at the least

    def open(self, address: tuple[int, int], now: float) -> None:
        """Read the clocks of a component for a while."""
        if not self._open:
            self._choose(True)
        self._open[address] = now + SAMPLE_TIME

    def is_open(self, address: tuple[int, int]) -> bool:
        """Whether clocks of this component are read now."""
        return address in self._open

    def sampled(self, address: tuple[int, int], now: float) -> None:
        """A clock of this component was read."""
        if self._open[address] <= now:
            self.close(address)

    def close(self, address: tuple[int, int]) -> None:
        """Read no more clocks of a component."""
        if self._open.pop(address, None) is not None and not self._open:
            self._choose(False)
