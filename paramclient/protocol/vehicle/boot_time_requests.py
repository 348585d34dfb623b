"""Requests for SYSTEM_TIME by MAV_CMD_REQUEST_MESSAGE, for components that do not stream a clock."""

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
"""Seconds after the identification of a component until its clock is requested: a component with telemetry,
usually at least one message a second, has sent it by then."""
REQUEST_INTERVAL: Final = 0.25
"""Seconds between two requests at first. A booting ArduPilot acknowledges each, and sends SYSTEM_TIME when
its main loop runs (measured: 1.8 to 2.6 s after it went off)."""
FAST_REQUESTS_TIME: Final = 6.0
"""Seconds for which requests are sent at that pace."""
SLOW_REQUEST_INTERVAL: Final = 1.0
"""Seconds between two requests after that, while a reboot on command is awaited, and between those for a
baseline. No caller waits for the baseline, and where 250 lists run at once, the responses are queued behind
the values."""


class ClockRequests(Machine):
    """Requests the time since boot after the identification, and when the component may have rebooted.

    ArduCopter sends neither SYSTEM_TIME nor another message with a clock unless a ground station has
    requested streams (measured with 4.6-dev). No request is sent while another message is requested: a
    COMMAND_ACK names MAV_CMD_REQUEST_MESSAGE and not the message.

    Args:
        context: the component's.
        presence: the component's; its `clock_at` says when its clock was received.
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
        self._wanted_after = -math.inf  # wanted: a clock received after this
        self._begun_at = -math.inf
        self._request_at = math.inf
        self._is_following = False

    def want_baseline(self, now: float) -> None:
        """Request the clock in 2 s, unless it is received by then, while the component is not lost.

        A component known by one message may be a forged address, whose owner would receive the requests.
        """
        if self._request_at == math.inf:
            self._begin(-math.inf, now + BASELINE_DELAY)

    def want(self, now: float) -> None:
        """Request the clock until it is received, for at most 6 s."""
        if not self._is_following:
            self._begin(now, now)

    def follow(self, now: float) -> None:
        """Request the clock again and again: the component was told to reboot."""
        self._begin(now, now + REQUEST_INTERVAL)
        self._is_following = True

    def stop_following(self) -> None:
        """End the repeated requests: the component has rebooted, or no caller waits for that."""
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
        is_quick = now < self._begun_at + FAST_REQUESTS_TIME
        if not self._is_following and (is_told or not is_quick):
            self._request_at = math.inf
            return
        is_baseline = self._wanted_after == -math.inf and not self._is_following
        pace = REQUEST_INTERVAL if is_quick and not is_baseline else SLOW_REQUEST_INTERVAL
        self._request_at = now + pace
        if is_baseline and (self._presence.is_lost or self._presence.is_overdue(now)):
            return
        if now - self._presence.clock_at >= pace:  # otherwise its clock is received anyway
            first = (float(SYSTEM_TIME_ID), *[0.0] * 6)
            self._send(CommandLong(*self._target, MAV_CMD_REQUEST_MESSAGE, first))

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        is_requesting = self._context.is_identifying or self._context.is_locating_metadata
        return math.inf if is_requesting else self._request_at

    def _begin(self, wanted_after: float, at: float) -> None:
        if self._context.may_send:
            self._wanted_after = wanted_after
            self._begun_at = at
            self._request_at = at
