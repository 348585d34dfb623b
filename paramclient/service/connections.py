"""uvicorn's protocols with limits: bytes per turn of the event loop, and timeouts."""

from __future__ import annotations

import asyncio
import json
from typing import Any, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from paramclient.service.places import Place, Stage

__all__ = ["Connection", "WebSocketConnection"]

HEAD_PATIENCE: Final = 10.0
"""Seconds for the head of a request to come, once the connection is there or its first byte has come."""
STALL_PATIENCE: Final = 60.0
"""Seconds in which a client that is being answered has to take something. It comes again, and is told what it
has missed."""
BYTES_AT_ONCE: Final = 4_096
"""Bytes of one connection that are parsed in one turn of the event loop. As chunks of 1 byte: 5 ms."""
UNSENT_MAX: Final = 65_536
"""Bytes that wait for a client before an answer waits too; with TLS asyncio would keep 512 kB."""
FRAGMENTS_MAX: Final = 64
"""Frames of one WebSocket message. Empty ones count for nothing in its size."""


class _InSlices(asyncio.BufferedProtocol):
    """Receives at most `BYTES_AT_ONCE` in one turn of the event loop, with TLS and without.

    asyncio reads only as much as the buffer of the protocol holds. What is left waits in the socket, or is
    decrypted in a later turn.
    """

    _buffer = memoryview(b"")

    def get_buffer(self, sizehint: int) -> memoryview:
        self._buffer = memoryview(bytearray(BYTES_AT_ONCE))
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        data, self._buffer = bytes(self._buffer[:nbytes]), memoryview(b"")
        self.data_received(data)

    def data_received(self, data: bytes) -> None:
        """Parse these bytes."""
        raise NotImplementedError


class _StallWatch:
    """Aborts a connection whose client takes none of the bytes that wait for it for `STALL_PATIENCE`."""

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._transport = transport
        self._loop = loop
        self._timer: asyncio.TimerHandle | None = None
        self._unsent = 0

    def look(self) -> None:
        """Begin to watch if anything waits."""
        if _is_over(self._transport):
            return
        self._unsent = self._transport.get_write_buffer_size()
        if self._unsent and self._timer is None:
            self._timer = self._loop.call_later(STALL_PATIENCE, self._check)

    def stop(self) -> None:
        """End the watch."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _check(self) -> None:
        self._timer = None
        if _is_over(self._transport):
            return
        if 0 < self._unsent <= self._transport.get_write_buffer_size():
            self._transport.abort()
        else:
            self.look()


class Connection(H11Protocol, _InSlices):
    """One connection, until it becomes a WebSocket: see `WebSocketConnection`.

    Args:
        place: the one that it has.
        options: as uvicorn's protocol takes them.
    """

    _head: asyncio.TimerHandle | None = None

    def __init__(self, place: Place, **options: Any) -> None:
        super().__init__(**options)
        self._place = place

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        limit_tls = getattr(transport, "set_read_buffer_limits", None)
        if limit_tls is not None:  # else each read of the socket would add a turn that decrypts
            limit_tls(high=BYTES_AT_ONCE, low=0)
        transport.set_write_buffer_limits(high=UNSENT_MAX)
        self._stall = _StallWatch(transport, self.loop)
        self._place.leave = transport.abort
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if _is_over(self.transport):
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
        if is_idle and not _is_over(self.transport) and not self.transport.get_write_buffer_size():
            self.transport.abort()
        if self.conn.their_state is h11.SEND_BODY:
            self.transport.abort()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.cycle.response_complete:
            self._place.stage = Stage.IDLE
        self._stall.look()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._stall.look()

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

    def _stop(self) -> None:
        self._head_has_come()
        self._stall.stop()


class WebSocketConnection(WebSocketsSansIOProtocol, _InSlices):
    """A WebSocket. While its client does not read, nothing is read from it: each ping would be answered."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._stall = _StallWatch(transport, self.loop)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stall.stop()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        super().pause_writing()
        self.transport.pause_reading()
        self._stall.look()

    def resume_writing(self) -> None:
        super().resume_writing()
        if not self.read_paused and not _is_over(self.transport):
            self.transport.resume_reading()

    async def receive(self) -> Any:
        message = await super().receive()
        if not self.writable.is_set() and not _is_over(self.transport):
            self.transport.pause_reading()  # uvicorn resumes it for each message that is taken
        return message

    def handle_cont(self, event: Any) -> None:
        if len(self.frames) < FRAGMENTS_MAX:
            super().handle_cont(event)
        else:
            self._fail(1009, "too many fragments")

    def send_receive_event_to_app(self) -> None:
        if self.curr_msg_data_type == "text":
            try:
                b"".join(self.frames).decode()
            except UnicodeDecodeError:
                self._fail(1007, "no UTF-8")
                return
        super().send_receive_event_to_app()

    def _fail(self, code: int, reason: str) -> None:
        """Close because of what the client has sent; nothing that follows it is read."""
        self.frames = []
        self.conn.fail(code, reason)
        if not self.close_sent and self.conn.close_sent is not None:
            self.handle_parser_exception()


def _is_over(transport: asyncio.Transport) -> bool:
    """Whether the transport tells nothing any more: that of TLS drops all it has when closed twice."""
    return getattr(transport, "_ssl_protocol", transport) is None
