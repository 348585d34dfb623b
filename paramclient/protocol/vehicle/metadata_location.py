"""COMPONENT_METADATA: the location of a component's metadata files.

MAV_CMD_REQUEST_MESSAGE requests COMPONENT_METADATA, which names a general file; that names the other files
(MAVLink guide, "Component Metadata Protocol").
"""

from __future__ import annotations

import math
from typing import Final

from paramclient.errors import CommandResult, NoReply
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import Attempts
from paramclient.protocol.wire import (
    COMPONENT_METADATA_ID,
    MAV_CMD_REQUEST_MESSAGE,
    CommandAck,
    CommandLong,
    ComponentMetadata,
)

__all__ = ["DescriptionAsk", "Descriptions"]

NOT_SUPPORTED: Final = (CommandResult.UNSUPPORTED, CommandResult.DENIED, CommandResult.FAILED)
"""Results that mean that the protocol is not supported; other results are ignored."""


class DescriptionAsk(Operation[ComponentMetadata | None]):
    """One request for the general file; its result is None where the component has none.

    Attributes:
        attempts: requests sent.
    """

    def __init__(self, begun_at: float) -> None:
        super().__init__(begun_at)
        self.attempts = 0


class Descriptions(Machine):
    """Requests COMPONENT_METADATA of a component until it is received, refused or given up.

    Args:
        context: the component's. While AUTOPILOT_VERSION is requested with the same command, a refusal is not
            taken for one of COMPONENT_METADATA.
    """

    def __init__(
        self,
        context: Context,
    ) -> None:
        self._context = context
        self._target = context.target
        self._own = context.own
        self._policy = context.retry
        self._request = Attempts(context.retry)
        self._send = context.send
        self._asks: list[DescriptionAsk] = []

    @property
    def is_asking(self) -> bool:
        """Whether a response is awaited."""
        return bool(self._asks)

    def ask(self, now: float) -> DescriptionAsk:
        """Request the message; give the request back with `release`. Parallel requests share the response."""
        ask = DescriptionAsk(now)
        self._asks.append(ask)
        self._context.is_locating_metadata = True
        if len(self._asks) == 1:
            self._request = Attempts(self._policy)
            self._transmit(now)
        ask.attempts = self._request.count
        return ask

    def release(self, ask: DescriptionAsk) -> None:
        """Give a request back."""
        if ask in self._asks:
            self._asks.remove(ask)
            self._context.is_locating_metadata = self.is_asking

    def heard(self, message: ComponentMetadata, now: float) -> None:
        """Process COMPONENT_METADATA; an empty address means none."""
        if self._asks:
            self._request.answered(now)
            self._finish(message if message.uri else None, now)

    def acknowledged(self, message: CommandAck, now: float) -> None:
        """Process a COMMAND_ACK: a refusal ends the request with None."""
        is_ours = (message.target_system, message.target_component) in (self._own, (0, 0))
        is_meant = message.command == MAV_CMD_REQUEST_MESSAGE and is_ours and not self._context.is_identifying
        if self._asks and is_meant and message.result in NOT_SUPPORTED:
            self._request.answered(now)
            self._finish(None, now)

    def tick(self, now: float) -> None:
        """Repeat the request, or give up."""
        if self.next_deadline() > now:
            return
        self._request.timed_out()
        if self._request.is_hopeless(now):
            self._give_up("", now)
        else:
            self._transmit(now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return self._request.due_at if self._asks else math.inf

    def lose(self, now: float) -> None:
        """End the request with NoReply: the component is lost."""
        self._give_up(" (lost)", now)

    def resume(self, now: float) -> None:
        """Repeat the request: the link is back."""
        if self._asks:
            self._transmit(now)

    def fail_all(self, error: Exception, now: float) -> None:
        """End the request with the error."""
        asks, self._asks = self._asks, []
        self._context.is_locating_metadata = False
        for ask in asks:
            ask.fail(error, now)

    def _give_up(self, why: str, now: float) -> None:
        what = f"COMPONENT_METADATA of {self._target[0]}/{self._target[1]}{why}"
        asks, self._asks = self._asks, []
        self._context.is_locating_metadata = False
        for ask in asks:
            ask.fail(NoReply(what, attempts=ask.attempts, waited=now - ask.begun_at), now)

    def _transmit(self, now: float) -> None:
        self._request.sent(now)
        for ask in self._asks:
            ask.attempts = self._request.count
        first = (float(COMPONENT_METADATA_ID), *[0.0] * 6)
        self._send(CommandLong(*self._target, MAV_CMD_REQUEST_MESSAGE, first))

    def _finish(self, result: ComponentMetadata | None, now: float) -> None:
        asks, self._asks = self._asks, []
        self._context.is_locating_metadata = False
        for ask in asks:
            ask.finish(result, now)
