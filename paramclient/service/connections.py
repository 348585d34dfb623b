"""Protocols of HTTP and WebSocket connections: uvicorn's, with limits of bytes per turn of the event loop,
and timeouts."""

from __future__ import annotations

import asyncio
import json
from typing import Any, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from paramclient.service.connection_slots import ConnectionSlot, ConnectionStage

__all__ = ["ServiceConnection", "WebSocketConnection"]

REQUEST_HEAD_TIMEOUT: Final = 10.0
"""Timeout in seconds for the head of a request, from the start of the connection or its first byte."""
CLIENT_STALL_TIMEOUT: Final = 60.0
"""Seconds without progress after which a client that does not receive its response is disconnected. An event
listener reconnects, and learns of the missed events."""
BYTES_PER_TURN: Final = 4_096
"""Maximum number of bytes of a connection parsed in one turn of the event loop. As chunks of 1 byte they take
5 ms."""
UNSENT_BYTES_MAX: Final = 65_536
"""Maximum number of unsent bytes of a connection before its response waits; with TLS asyncio would buffer 512
kB."""
WEBSOCKET_FRAMES_MAX: Final = 64
"""Maximum number of frames of a WebSocket message. Empty frames do not count in its size."""


class _LimitedReads(asyncio.BufferedProtocol):
    """Receives at most `BYTES_PER_TURN` in one turn of the event loop, with and without TLS.

    asyncio reads only as much as the buffer of the protocol holds. The remaining bytes stay in the socket,
    or are decrypted in a later turn.
    """

    _buffer = memoryview(b"")

    def get_buffer(self, sizehint: int) -> memoryview:
        self._buffer = memoryview(bytearray(BYTES_PER_TURN))
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        data, self._buffer = bytes(self._buffer[:nbytes]), memoryview(b"")
        self.data_received(data)

    def data_received(self, data: bytes) -> None:
        """Parse these bytes."""
        raise NotImplementedError


class _StallTimer:
    """Aborts a connection whose client receives none of the unsent bytes for `CLIENT_STALL_TIMEOUT`."""

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._transport = transport
        self._loop = loop
        self._timer: asyncio.TimerHandle | None = None
        self._unsent = 0

    def start(self) -> None:
        """Start the timer if bytes are unsent."""
        if _is_closed(self._transport):
            return
        self._unsent = self._transport.get_write_buffer_size()
        if self._unsent and self._timer is None:
            self._timer = self._loop.call_later(CLIENT_STALL_TIMEOUT, self._check)

    def stop(self) -> None:
        """Stop the timer."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _check(self) -> None:
        self._timer = None
        if _is_closed(self._transport):
            return
        if 0 < self._unsent <= self._transport.get_write_buffer_size():
            self._transport.abort()
        else:
            self.start()


class ServiceConnection(H11Protocol, _LimitedReads):
    """An HTTP connection, until it becomes a WebSocket; see `WebSocketConnection`.

    Args:
        slot: its slot.
        options: arguments of uvicorn's protocol.
    """

    _head: asyncio.TimerHandle | None = None

    def __init__(self, slot: ConnectionSlot, **options: Any) -> None:
        super().__init__(**options)
        self._slot = slot

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        limit_tls = getattr(transport, "set_read_buffer_limits", None)
        if limit_tls is not None:  # each read of the socket adds a turn that decrypts
            limit_tls(high=BYTES_PER_TURN, low=0)
        transport.set_write_buffer_limits(high=UNSENT_BYTES_MAX)
        self._stall = _StallTimer(transport, self.loop)
        self._slot.close = transport.abort
        self._start_head_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timers()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if _is_closed(self.transport):
            return
        if self.transport.get_protocol() is not self:  # the connection has become a WebSocket
            self._slot.stage = ConnectionStage.ACTIVE
            self._stop_timers()
        elif self.conn.their_state is not h11.IDLE:
            self._stop_head_timer()
        elif self._head is None and not self.transport.is_closing():
            self._start_head_timer()

    def shutdown(self) -> None:
        """Close the connection at the end of the service.

        Abort it if a body is incomplete, because no response will follow, and if it is idle, because over
        TLS an inattentive client delays the end.
        """
        is_idle = self.cycle is None or self.cycle.response_complete
        super().shutdown()
        if is_idle and not _is_closed(self.transport) and not self.transport.get_write_buffer_size():
            self.transport.abort()
        if self.conn.their_state is h11.SEND_BODY:
            self.transport.abort()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.cycle.response_complete:
            self._slot.stage = ConnectionStage.IDLE
        self._stall.start()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._stall.start()

    def send_400_response(self, msg: str) -> None:
        """Respond with a problem to data that is not HTTP."""
        if self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE):
            self.transport.abort()  # the response has started
            return
        problem = {
            "type": "urn:paramclient:bad-request",
            "title": "Bad request",
            "status": 400,
            "detail": "This is not a valid HTTP request.",
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

    def _start_head_timer(self) -> None:
        self._head = self.loop.call_later(REQUEST_HEAD_TIMEOUT, self.transport.abort)

    def _stop_head_timer(self) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            self._slot.stage = ConnectionStage.ACTIVE
        if self._head is not None:
            self._head.cancel()
            self._head = None

    def _stop_timers(self) -> None:
        self._stop_head_timer()
        self._stall.stop()


class WebSocketConnection(WebSocketsSansIOProtocol, _LimitedReads):
    """A WebSocket. Nothing is read while its client does not read, because each ping would be answered."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._stall = _StallTimer(transport, self.loop)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stall.stop()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        super().pause_writing()
        self.transport.pause_reading()
        self._stall.start()

    def resume_writing(self) -> None:
        super().resume_writing()
        if not self.read_paused and not _is_closed(self.transport):
            self.transport.resume_reading()

    async def receive(self) -> Any:
        message = await super().receive()
        if not self.writable.is_set() and not _is_closed(self.transport):
            self.transport.pause_reading()  # uvicorn resumes it with each message
        return message

    def handle_cont(self, event: Any) -> None:
        if len(self.frames) < WEBSOCKET_FRAMES_MAX:
            super().handle_cont(event)
        else:
            self._fail(1009, "too many fragments")

    def send_receive_event_to_app(self) -> None:
        if self.curr_msg_data_type == "text":
            try:
                b"".join(self.frames).decode()
            except UnicodeDecodeError:
                self._fail(1007, "not UTF-8")
                return
        super().send_receive_event_to_app()

    def _fail(self, code: int, reason: str) -> None:
        """Close because of invalid data of the client. Data after it is not read."""
        self.frames = []
        self.conn.fail(code, reason)
        if not self.close_sent and self.conn.close_sent is not None:
            self.handle_parser_exception()


def _is_closed(transport: asyncio.Transport) -> bool:
    """Return whether the transport is closed: a TLS transport discards its unsent bytes when closed twice."""
    return getattr(transport, "_ssl_protocol", transport) is None
