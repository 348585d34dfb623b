"""The components whose telemetry is read for their time since boot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

__all__ = ["BootTimeSampling"]

SAMPLE_TIME: Final = 0.1
"""Seconds after a heartbeat in which a component's clocks are read. Messages at 10 Hz and more arrive in that
time; without any clock the window stays open until one arrives."""


class BootTimeSampling:
    """Opens a window after each heartbeat in which frames with `time_boot_ms` are decoded.

    An object for each telemetry frame would take a third of the time of framing. A reboot shows in any later
    clock as well as in the first.

    Args:
        choose: called with whether frames with clocks are needed, at each change.
    """

    def __init__(self, choose: Callable[[bool], None]) -> None:
        self._choose = choose
        self._open: dict[tuple[int, int], float] = {}  # by component, until when at least

    def open(self, address: tuple[int, int], now: float) -> None:
        """Read the clocks of a component for a while."""
        if not self._open:
            self._choose(True)
        self._open[address] = now + SAMPLE_TIME

    def is_open(self, address: tuple[int, int]) -> bool:
        """Return whether clocks of this component are read now."""
        return address in self._open

    def sampled(self, address: tuple[int, int], now: float) -> None:
        """Record that a clock of this component was read."""
        if self._open[address] <= now:
            self.close(address)

    def close(self, address: tuple[int, int]) -> None:
        """Read no more clocks of a component."""
        if self._open.pop(address, None) is not None and not self._open:
            self._choose(False)
