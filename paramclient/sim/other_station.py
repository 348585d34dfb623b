"""OtherStation: a second ground station on the same channel."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

from paramclient.errors import UsageError
from paramclient.model.values import Encoding, as_reported
from paramclient.sim.device import Device
from paramclient.sim.param_table import SimParam, check_range
from paramclient.wire import messages

__all__ = ["OtherStation"]


@dataclass(kw_only=True, eq=False, repr=False)
class OtherStation(Device):
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
        if not self.list_every > 0.0:
            raise UsageError(f"list_every must be a number of seconds above 0, not {self.list_every}")
        self._sets = tuple(self.sets)
        for at, row in self._sets:
            check_range(0.0, **{f"the time of {row.name}": at})
        kind, no_autopilot = messages.MAV_TYPE_GCS, messages.MAV_AUTOPILOT_INVALID
        beat = messages.Heartbeat(kind, no_autopilot, system_status=messages.MAV_STATE_ACTIVE)
        self._set_up(beat, messages.AutopilotVersion(0))

    def receive(self, data: bytes, now: float) -> None:
        """See `Endpoint`; ignores the data."""

    def _switch_on(self, at: float) -> None:
        super()._switch_on(at)
        self._due[self._request_list] = at + self.list_every
        for when, row in self._sets:
            self._due[partial(self._set, row)] = at + when

    def _send_clock(self, now: float) -> None:
        """Send nothing."""

    def _request_list(self, at: float) -> None:
        self._due[self._request_list] = self._again(at, self.list_every)
        self.send(messages.ParamRequestList(self.target_system, self.target_component))

    def _set(self, row: SimParam, at: float) -> None:
        raw = as_reported(row.bits, row.type, self.encoding)
        self.send(messages.ParamSet(self.target_system, self.target_component, row.name, raw, row.type))
