"""SYSTEM_TIME by MAV_CMD_REQUEST_MESSAGE, for components that tell no time since boot unasked."""

from __future__ import annotations

import math
from typing import Final

from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.vehicle.presence import Presence
from paramclient.protocol.wire import (
    MAV_CMD_REQUEST_MESSAGE,
    SYSTEM_TIME_ID,
    CommandLong,
)

__all__ = ["ClockRequests"]

BASELINE_DELAY: Final = 2.0
"""Seconds after a component is identified until its clock is requested: one that streams telemetry, at least
once a second as usual, has told it by then."""
REQUEST_PACE: Final = 0.25
"""Seconds between two requests at first. An ArduPilot that starts acknowledges each, and sends SYSTEM_TIME
when its main loop runs (measured: 1.8 to 2.6 s after it went off)."""
QUICK_TIME: Final = 6.0
"""Seconds for which requests are sent at that pace."""
SLOW_PACE: Final = 1.0
"""Seconds between two requests after that, while a restart on command is awaited; and between those for a
baseline. Nobody waits for it, and where 250 lists come at once, the answers stand behind the values."""


class ClockRequests(Machine):
    """Requests the time since boot once a component is identified, and where it may have started again.

    ArduCopter sends neither SYSTEM_TIME nor another message with a clock unless a ground station has asked
    for streams (measured with 4.6-dev). No request is sent while another message is requested: a
    COMMAND_ACK names MAV_CMD_REQUEST_MESSAGE and not the message.

    Args:
        context: the component's.
        presence: the component's; its `clock_at` says when it told its clock.
    """

    def __init__(
        self,
        context: Context,
        presence: Presence,
    ) -> None:
        self._context = context
        self._target = context.target
        self._presence = presence
        self._send = context.send
        self._wanted_after = -math.inf  # a clock that was told later is what is wanted
        self._begun_at = -math.inf
        self._request_at = math.inf
        self._is_following = False

    def want_baseline(self, now: float) -> None:
        """Request the clock in 2 s, unless the component has told it by then, and while it is heard.

        Whoever was heard once may be a forged address, whose owner would get the requests.
        """
        if self._request_at == math.inf:
            self._begin(-math.inf, now + BASELINE_DELAY)

    def want(self, now: float) -> None:
        """Request the clock until it is told, for at most 6 s."""
        if not self._is_following:
            self._begin(now, now)

    def follow(self, now: float) -> None:
        """Request the clock again and again: the component was told to start again."""
        self._begin(now, now + REQUEST_PACE)
        self._is_following = True

    def stop_following(self) -> None:
        """It has started again, or nobody waits for that."""
        if self._is_following:
            self.stop()

    def stop(self) -> None:
        """Request nothing any more."""
        self._request_at = math.inf
        self._is_following = False

    def fail_all(self, error: Exception, now: float) -> None:
        """Request nothing any more."""
        self.stop()

    def tick(self, now: float) -> None:
        """Send a request that is due."""
        if self.next_deadline() > now:
            return
        is_told = self._presence.clock_at > self._wanted_after
        is_quick = now < self._begun_at + QUICK_TIME
        if not self._is_following and (is_told or not is_quick):
            self._request_at = math.inf
            return
        is_baseline = self._wanted_after == -math.inf and not self._is_following
        pace = REQUEST_PACE if is_quick and not is_baseline else SLOW_PACE
        self._request_at = now + pace
        if is_baseline and (self._presence.is_lost or self._presence.is_overdue(now)):
            return
        if now - self._presence.clock_at >= pace:  # else it is telling its clock anyway
            first = (float(SYSTEM_TIME_ID), *[0.0] * 6)
            self._send(CommandLong(*self._target, MAV_CMD_REQUEST_MESSAGE, first))

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity."""
        is_requesting = self._context.is_identifying or self._context.is_locating_metadata
        return math.inf if is_requesting else self._request_at

    def _begin(self, wanted_after: float, at: float) -> None:
        if self._context.may_send:
            self._wanted_after = wanted_after
            self._begun_at = at
            self._request_at = at
