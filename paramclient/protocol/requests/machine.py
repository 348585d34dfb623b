"""The lifecycle that all machines of a component share."""

from __future__ import annotations

import math

__all__ = ["Machine"]


class Machine:
    """One kind of exchange with a component: reads, writes, file transfers, hash checks …

    `ComponentMachine` holds its machines in a tuple and calls these methods of each. Times are in seconds of
    one monotonic clock. A machine derives from this class and overrides the methods that it needs; each
    method does nothing here.
    """

    def tick(self, now: float) -> None:
        """Do what is due at `next_deadline`."""

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return math.inf

    def resume(self, now: float) -> None:
        """Repeat the requests in flight: the link was reconnected."""

    def lose(self, now: float) -> None:
        """End what waits for a response with NoReply: the component is lost."""

    def fail_all(self, error: Exception, now: float) -> None:
        """End every operation with the error: the link has ended, or the address is contested."""
