"""OtherStation: a second ground station on the same channel."""

from __future__ import annotations

import math
from collections.abc import Iterable

from paramclient.errors import UsageError
from paramclient.model.values import Encoding
from paramclient.sim.param_table import Entry, SimParam
from paramclient.wire import messages

__all__ = ["OtherStation"]


class OtherStation:
    """A second ground station of an `Air`. The vehicles and the program receive its messages.

    Sends a heartbeat each second, requests the list, which restarts the vehicle's list, and sets parameters.
    Receives nothing, and ignores the outcome of its requests.

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

    def __init__(
        self,
        *,
        system: int = 254,
        component: int = 190,
        target_system: int = 1,
        target_component: int = messages.AUTOPILOT_COMPONENT,
        list_every: float = math.inf,
        sets: Iterable[tuple[float, SimParam]] = (),
        encoding: Encoding = Encoding.BYTEWISE,
    ) -> None:
        for what, number in (("system", system), ("component", component)):
            if not 1 <= number <= 255:
                raise UsageError(f"{what} must be a number from 1 to 255, not {number}")
        if not list_every > 0.0:
            raise UsageError(f"list_every must be a number of seconds above 0, not {list_every}")
        self.system = system
        self.component = component
        self._target = (target_system, target_component)
        self._list_every = list_every
        self._encoding = encoding
        self._sets = sorted(sets, key=lambda each: each[0])
        if not all(0.0 <= when < math.inf for when, _ in self._sets):
            raise UsageError("the times in sets must be numbers of seconds from 0 up")
        self._started_at: float | None = None
        self._next_heartbeat = math.inf
        self._next_list = math.inf
        self._sequence = 0
        self._out: list[bytes] = []

    def tick(self, now: float) -> None:
        """Do all work that is due by `now`; a late call skips periods of repeated work."""
        if self._started_at is None:
            self._started_at = self._next_heartbeat = now
            self._next_list = now + self._list_every
        if self._next_heartbeat <= now:
            beat = messages.Heartbeat(
                messages.MAV_TYPE_GCS, messages.MAV_AUTOPILOT_INVALID, system_status=messages.MAV_STATE_ACTIVE
            )
            self._send(beat)
            self._next_heartbeat = _next(self._next_heartbeat, 1.0, now)
        if self._next_list <= now:
            self._send(messages.ParamRequestList(*self._target))
            self._next_list = _next(self._next_list, self._list_every, now)
        while self._sets and self._started_at + self._sets[0][0] <= now:
            row = self._sets.pop(0)[1]
            raw = Entry(row, 0, self._encoding).raw
            self._send(messages.ParamSet(*self._target, row.name, raw, row.type))

    def next_deadline(self) -> float | None:
        """Return the time of the next work; None before the first call."""
        if self._started_at is None:
            return None
        due = min(self._next_heartbeat, self._next_list)
        return min(due, self._started_at + self._sets[0][0]) if self._sets else due

    def data_to_send(self) -> list[bytes]:
        """Return the frames to send, and clear them."""
        out, self._out = self._out, []
        return out

    def _send(self, message: messages.Message) -> None:
        frame = messages.encode(
            message, system=self.system, component=self.component, sequence=self._sequence
        )
        self._sequence = (self._sequence + 1) & 0xFF
        self._out.append(frame)


def _next(due: float, pause: float, now: float) -> float:
    """Return the next deadline of repeated work; after a late call, a full period from now."""
    due += pause
    return due if due > now else now + pause
