"""WriteWindow: how many PARAM_SETs are in flight to one component."""

from __future__ import annotations

from typing import Final

__all__ = ["WRITES_IN_FLIGHT_MAX", "WRITES_IN_FLIGHT_FIRST", "WriteWindow"]

WRITES_IN_FLIGHT_FIRST: Final = 10
"""PARAM_SETs in flight at first: half of what ArduPilot queues of other requests."""
WRITES_IN_FLIGHT_MAX: Final = 30
"""PARAM_SETs in flight, at most: a real ArduPilot acknowledges 30 in one burst within 20 ms, a real PX4 20
within 1 ms (measured), and the buffer of a telemetry radio holds about as many."""


class WriteWindow:
    """The number of PARAM_SETs that may be in flight: grows by one with each acknowledgement.

    A vehicle applies and acknowledges a PARAM_SET in its next loop, so the writes need no rate. The limit
    bounds what a slow link has to buffer, and the slow start lets the timeout follow its round trip.

    Attributes:
        limit: PARAM_SETs that may be in flight.
    """

    __slots__ = ("limit",)

    def __init__(self) -> None:
        self.limit = WRITES_IN_FLIGHT_FIRST

    def acknowledged(self) -> None:
        """Record an acknowledgement."""
        self.limit = min(self.limit + 1, WRITES_IN_FLIGHT_MAX)
