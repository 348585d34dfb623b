"""Requests for SYSTEM_TIME by MAV_CMD_REQUEST_MESSAGE, for components that do not stream a clock."""

from __future__ import annotations

import math

from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.retry import BASELINE_DELAY, CLOCK_FOLLOW_DELAY, ClockSchedule
from paramclient.protocol.vehicle.commands import MessageRequests
from paramclient.protocol.vehicle.presence import Presence
from paramclient.protocol.wire import SYSTEM_TIME_ID

__all__ = ["BootTimeRequests"]


class BootTimeRequests(Machine):
    """Requests the time since boot after the identification, and when the component may have rebooted.

    ArduCopter sends neither SYSTEM_TIME nor another message with a clock unless a ground station has
    requested streams (measured with 4.6-dev). No request is sent while another message is requested: a
    COMMAND_ACK names MAV_CMD_REQUEST_MESSAGE and not the message.

    Args:
        context, messages: the component's.
        presence: the component's; its `clock_at` says when its clock was received.
    """

    def __init__(
        self,
        context: Context,
        messages: MessageRequests,
        presence: Presence,
    ) -> None:
        self._context = context
        self._messages = messages
        self._presence = presence
        self._requested_after = -math.inf  # requested: a clock received after this
        self._schedule = ClockSchedule()
        self._request_at = math.inf
        self._is_following = False

    def want_baseline(self, now: float) -> None:
        """Request the clock in 2 s, unless it is received by then, while the component is not lost.

        A component known by one message may be a forged address, whose owner would receive the requests.
        """
        if self._request_at == math.inf:
            self._begin(-math.inf, ClockSchedule(now + BASELINE_DELAY, is_slow=True))

    def want(self, now: float) -> None:
        """Request the clock until it is received, for at most 6 s."""
        if not self._is_following:
            self._begin(now, ClockSchedule(now))

    def follow(self, now: float) -> None:
        """Request the clock again and again: the component was commanded to reboot."""
        self._begin(now, ClockSchedule(now + CLOCK_FOLLOW_DELAY))
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
        is_received = self._presence.clock_at > self._requested_after
        if not self._is_following and (is_received or self._schedule.is_over(now)):
            self._request_at = math.inf
            return
        is_baseline = self._requested_after == -math.inf and not self._is_following
        pace = self._schedule.interval(now)
        self._request_at = now + pace
        if is_baseline and (self._presence.is_lost or self._presence.is_overdue(now)):
            return
        if now - self._presence.clock_at >= pace:  # otherwise its clock is received anyway
            self._messages.send(SYSTEM_TIME_ID)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return math.inf if self._context.is_requesting_message else self._request_at

    def _begin(self, requested_after: float, schedule: ClockSchedule) -> None:
        if self._context.may_send:
            self._requested_after = requested_after
            self._schedule = schedule
            self._request_at = schedule.begun_at
