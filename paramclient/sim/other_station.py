"""OtherStation: a second ground station on the same channel."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from heapq import heapify, heapreplace
from itertools import count
from typing import TypeAlias

from paramclient.errors import UsageError
from paramclient.model.values import Encoding
from paramclient.sim.param_table import Entry, SimParam, check_range
from paramclient.wire import messages

__all__ = ["OtherStation"]

_Event: TypeAlias = tuple[float, int, messages.Message, float]
"""The time of a message, its place among those of the same time, the message, and the time until the next."""


@dataclass(kw_only=True, eq=False)
class OtherStation:
    """A second ground station of an `Air`. The vehicles and the program receive its messages.

    Sends a heartbeat each second, requests the list, which restarts the vehicle's list, and sets parameters.
    Ignores what it receives.

    Args:
        system, component: the station's ids, 1 to 255.
        target_system, target_component: the receiver of its requests.
        list_every: seconds from the first call to the first PARAM_REQUEST_LIST, and between two of them;
            `math.inf` for none.
        sets: the parameters to set, each with the seconds from the first call.
        encoding: of the values in `sets`.

    Raises:
        UsageError: an argument is invalid.
    """

    system: int = 254
    component: int = 190
    target_system: int = 1
    target_component: int = messages.AUTOPILOT_COMPONENT
    list_every: float = math.inf
    sets: Iterable[tuple[float, SimParam]] = ()
    encoding: Encoding = Encoding.BYTEWISE

    def __post_init__(self) -> None:
        check_range(1, 255, system=self.system, component=self.component)
        if not self.list_every > 0.0:
            raise UsageError(f"list_every must be a number of seconds above 0, not {self.list_every}")
        target = (self.target_system, self.target_component)
        beat = messages.Heartbeat(
            messages.MAV_TYPE_GCS, messages.MAV_AUTOPILOT_INVALID, system_status=messages.MAV_STATE_ACTIVE
        )
        self._events: list[_Event] = [
            (0.0, 0, beat, 1.0),
            (self.list_every, 1, messages.ParamRequestList(*target), self.list_every),
        ]
        for place, (at, row) in enumerate(self.sets, start=2):
            check_range(0.0, **{f"the time of {row.name}": at})
            request = messages.ParamSet(*target, row.name, Entry(row, 0, self.encoding).raw, row.type)
            self._events.append((at, place, request, math.inf))
        heapify(self._events)
        self._started_at: float | None = None
        self._sequence = count()
        self._out: list[bytes] = []

    def receive(self, data: bytes, now: float) -> None:
        """See `Endpoint`; the data is ignored."""

    def tick(self, now: float) -> None:
        """Do all work that is due by `now`; a late call skips periods of repeated work."""
        if self._started_at is None:
            self._started_at = now
        while self._started_at + self._events[0][0] <= now:
            at, place, message, period = self._events[0]
            later = max(at + period, now - self._started_at)
            heapreplace(self._events, (later, place, message, period))
            number = next(self._sequence) & 0xFF
            address = {"system": self.system, "component": self.component, "sequence": number}
            self._out.append(messages.encode(message, **address))

    def next_deadline(self) -> float | None:
        """Return the time of the next work; None before the first call."""
        return None if self._started_at is None else self._started_at + self._events[0][0]

    def data_to_send(self) -> list[bytes]:
        """Return the frames to send, and clear them."""
        out, self._out = self._out, []
        return out
