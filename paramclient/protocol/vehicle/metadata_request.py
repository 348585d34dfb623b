"""COMPONENT_METADATA: the location of a component's metadata files.

MAV_CMD_REQUEST_MESSAGE requests COMPONENT_METADATA, which names a general file; that names the other files
(MAVLink guide, "Component Metadata Protocol").
"""

from __future__ import annotations

from typing import Final

from paramclient.errors import CommandResult, NoReply
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import MessageAttempts
from paramclient.protocol.vehicle.commands import MessageRequest, MessageRequests
from paramclient.protocol.wire import COMPONENT_METADATA_ID, ComponentMetadata

__all__ = ["MetadataRequest", "MetadataRequests"]

NOT_SUPPORTED: Final = (CommandResult.UNSUPPORTED, CommandResult.DENIED, CommandResult.FAILED)
"""Results that mean that the protocol is not supported; other results are ignored."""


class MetadataRequest(Operation[ComponentMetadata | None]):
    """One request for the general file; its result is None where the component has none.

    Attributes:
        request: its attempts, shared with parallel requests.
    """

    def __init__(self, request: MessageAttempts, begun_at: float) -> None:
        super().__init__(begun_at)
        self.request = request

    @property
    def attempts(self) -> int:
        """Requests sent."""
        return self.request.count


class MetadataRequests(Machine):
    """Requests COMPONENT_METADATA of a component until it is received, refused or given up.

    Args:
        context, messages: the component's.
    """

    def __init__(self, context: Context, messages: MessageRequests) -> None:
        self._target = context.target
        self._retry_policy = context.retry
        self._messages = messages
        self._asks: list[MetadataRequest] = []
        self._request: MessageRequest | None = None

    @property
    def is_asking(self) -> bool:
        """Whether a response is awaited."""
        return bool(self._asks)

    def ask(self, now: float) -> MetadataRequest:
        """Request the message; give the request back with `release`. Parallel requests share the response."""
        request = self._request
        if request is None:
            request = self._request = self._messages.begin(
                COMPONENT_METADATA_ID, MessageAttempts(self._retry_policy), now, refusals=NOT_SUPPORTED
            )
            request.on_done.append(self._ended)
        ask = MetadataRequest(request.request, now)
        self._asks.append(ask)
        return ask

    def release(self, ask: MetadataRequest) -> None:
        """Give a request back."""
        if ask in self._asks:
            self._asks.remove(ask)
            if not self._asks:
                self._end()

    def receive(self, message: ComponentMetadata, now: float) -> None:
        """Process COMPONENT_METADATA; an empty address means none."""
        self._messages.received(COMPONENT_METADATA_ID, now)
        for ask in self._end():
            ask.finish(message if message.uri else None, now)

    def lose(self, now: float) -> None:
        """End the request with NoReply: the component is lost."""
        self._give_up(" (lost)", now)

    def resume(self, now: float) -> None:
        """Repeat the request: the link is back."""
        if self._request is not None:
            self._messages.repeat(self._request, now)

    def fail_all(self, error: Exception, now: float) -> None:
        """End the request with the error."""
        for ask in self._end():
            ask.fail(error, now)

    def _ended(self) -> None:
        """Process the end of the request without the message: a refusal ends it with None."""
        request = self._request
        if request is None or request.error is None:
            return
        if isinstance(request.error, NoReply):
            self._give_up("", request.ended_at)
        else:
            for ask in self._end():
                ask.finish(None, request.ended_at)

    def _give_up(self, why: str, now: float) -> None:
        what = f"COMPONENT_METADATA of {self._target[0]}/{self._target[1]}{why}"
        for ask in self._end():
            ask.fail(NoReply(what, attempts=ask.attempts, waited=now - ask.begun_at), now)

    def _end(self) -> list[MetadataRequest]:
        """End the request and return the open asks."""
        asks, self._asks = self._asks, []
        request, self._request = self._request, None
        if request is not None:
            self._messages.end(request)
        return asks
