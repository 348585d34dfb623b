"""What one connection may cost: uvicorn's protocol, with an end to what it would wait for without one."""

from __future__ import annotations

import json
from typing import Any, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from paramclient.service.places import Place, Stage

__all__ = ["Connection"]

HEAD_PATIENCE: Final = 10.0
"""Seconds for the head of a request to come, once the connection is there or its first byte has come."""
STALL_PATIENCE: Final = 60.0
"""Seconds in which a client that is being answered has to take something. It comes again, and is told what it
has missed."""


class Connection(H11Protocol):
    """One connection, until it becomes a WebSocket, which has time limits of its own.

    Args:
        place: the one that it has.
        options: as uvicorn's protocol takes them.
    """

    # the timers are asyncio's, which only uvicorn needs to know here
    _head: Any = None
    _stall: Any = None
    _unsent = 0

    def __init__(self, place: Place, **options: Any) -> None:
        super().__init__(**options)
        self._place = place

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._place.leave = transport.abort
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self._is_over():
            return
        if self.transport.get_protocol() is not self:  # it is a WebSocket now
            self._place.stage = Stage.ASKING
            self._stop()
        elif self.conn.their_state is not h11.IDLE:
            self._head_has_come()
        elif self._head is None and not self.transport.is_closing():
            self._await_head()

    def shutdown(self) -> None:
        """The service ends. A body that is still on its way is not waited for: nothing would come of it. Nor
        is a client of whom nothing is expected: over TLS it would have to answer, and may not look at it."""
        is_idle = self.cycle is None or self.cycle.response_complete
        super().shutdown()
        if is_idle and not self._is_over() and not self.transport.get_write_buffer_size():
            self.transport.abort()
        if self.conn.their_state is h11.SEND_BODY:
            self.transport.abort()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.cycle.response_complete:
            self._place.stage = Stage.IDLE
        self._watch()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._watch()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP, as a problem like all others."""
        if self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE):
            self.transport.abort()  # it has been answered already
            return
        problem = {
            "type": "urn:paramclient:bad-request",
            "title": "Bad request",
            "status": 400,
            "detail": "This is no HTTP request.",
        }
        headers = [
            ("content-type", "application/problem+json"),
            ("x-content-type-options", "nosniff"),
            ("connection", "close"),
        ]
        response = h11.Response(status_code=400, headers=headers, reason=b"Bad Request")
        for event in (response, h11.Data(data=json.dumps(problem).encode()), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def _await_head(self) -> None:
        self._head = self.loop.call_later(HEAD_PATIENCE, self.transport.abort)

    def _head_has_come(self) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            self._place.stage = Stage.ASKING
        if self._head is not None:
            self._head.cancel()
            self._head = None

    def _watch(self) -> None:
        """What has been written is to be taken, however slowly."""
        if self._is_over():
            return
        self._unsent = self.transport.get_write_buffer_size()
        if self._unsent and self._stall is None:
            self._stall = self.loop.call_later(STALL_PATIENCE, self._check)

    def _check(self) -> None:
        self._stall = None
        if self._is_over():
            return
        if 0 < self._unsent <= self.transport.get_write_buffer_size():
            self.transport.abort()
        else:
            self._watch()

    def _is_over(self) -> bool:
        """Whether the transport tells nothing any more: that of TLS drops all it has when closed twice."""
        return getattr(self.transport, "_ssl_protocol", self) is None

    def _stop(self) -> None:
        self._head_has_come()
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None
