"""HTTP requests to a service, and its event stream."""

from __future__ import annotations

import errno
import math
import os
import socket
import ssl
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Mapping
from contextlib import aclosing, asynccontextmanager
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import anyio
import httpx

from paramclient.errors import LinkError, ParamClientError, UsageError
from paramclient.remote.bounded import (
    RESPONSE_BYTES_MAX,
    EventReader,
    ResponseDeadline,
    checked_document,
    decoder_of,
)
from paramclient.remote.decoding import decode_errors
from paramclient.remote.problems import error_of
from paramclient.remote.service_address import CLIENT_TOKEN_VARIABLE, ServiceAddress
from paramclient.version import __version__

__all__ = ["ServiceResponse", "StreamPosition", "Requests", "ServiceUnreachable"]

PREFIX: Final = "/api/v1"
"""Path of the API."""
SERVICE_OPEN_TIMEOUT: Final = 10.0
"""Timeout in seconds for name resolution and connecting over TLS, and for the headers of an event stream."""
STREAM_TIMEOUT: Final = 6.0
"""Seconds without data on the event stream after which the connection counts as lost: the service sends data
every 2 s. A vehicle counts as lost after 5 s."""
HELLO_TIMEOUT: Final = 10.0
"""Timeout in seconds for the first event of a stream, which the service sends immediately."""
PLACE_LENGTH_MAX: Final = 64
"""Maximum number of characters of an event position: a run has 16 digits, a number at most 18."""
PARALLEL_REQUESTS_MAX: Final = 64
"""Maximum number of requests in flight, the event stream included; further ones wait. A service refuses more
than 64 waiting requests of one holder."""
KEEPALIVE_OPTIONS: Final = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3}
"""TCP keepalive, in seconds and probes: it detects a lost network while a response takes minutes."""


class StreamPosition(NamedTuple):
    """Position in the events of one run of a service.

    Attributes:
        run: id of the run, new with each start of the service.
        seq: number of the event.
    """

    run: str
    seq: int

    @classmethod
    def read(cls, text: str | None) -> StreamPosition | None:
        """Parse `RUN-SEQ`; None for any other text."""
        run, dash, seq = (text or "").rpartition("-")
        is_one = dash and seq.isdecimal() and len(run) + len(seq) < PLACE_LENGTH_MAX
        return cls(run, int(seq)) if is_one else None

    def __str__(self) -> str:
        return f"{self.run}-{self.seq}"


@dataclass(frozen=True, slots=True)
class ServiceResponse:
    """Response of a service.

    Attributes:
        document: the JSON document, or None for an empty response.
        place: position of the last event that it includes, or None if a proxy removes the header.
    """

    document: Any
    place: StreamPosition | None


class ServiceUnreachable(Exception):
    """The service has not responded.

    Attributes:
        error: the reason.
        may_be_done: whether the service may have received the request.
    """

    def __init__(self, error: LinkError, *, may_be_done: bool) -> None:
        super().__init__(str(error))
        self.error = error
        self.may_be_done = may_be_done


class Requests:
    """The HTTP connections to one service.

    Args:
        address: address of the service.
        token: access token, or None.
        transport: HTTP transport; None for sockets.
    """

    def __init__(
        self, address: ServiceAddress, token: str | None, transport: httpx.AsyncBaseTransport | None
    ) -> None:
        self.name = address.name
        headers = {"User-Agent": f"paramclient/{__version__}", "Accept-Encoding": "gzip, deflate"}
        headers["X-Author"] = f"paramclient {os.getpid()}"  # author of changes, distinct for each program
        if token is not None:
            headers["Authorization"] = f"Bearer {token}"
        self._has_token = token is not None
        self._base = address.base + PREFIX
        self._headers = headers
        self._transport = transport
        self._http: httpx.AsyncClient | None = None

    async def open(self) -> None:
        """Create the HTTP client. Nothing is sent yet."""
        transport = self._transport or httpx.AsyncHTTPTransport(
            limits=httpx.Limits(max_connections=PARALLEL_REQUESTS_MAX, max_keepalive_connections=20),
            socket_options=_socket_options(),
        )
        self._http = httpx.AsyncClient(
            headers=self._headers,
            transport=transport,
            timeout=httpx.Timeout(None, connect=SERVICE_OPEN_TIMEOUT),
            follow_redirects=False,
        )

    async def close(self) -> None:
        """Close all connections."""
        if self._http is not None:
            await self._http.aclose()

    async def ask(
        self,
        method: str,
        path: str,
        body: Mapping[str, Any] | None = None,
        *,
        link: str | None = None,
        timeout: float | None = None,
    ) -> ServiceResponse:
        """Send a request and return its response. Cancellation closes the request.

        Args:
            method: HTTP method.
            path: path after the prefix.
            body: JSON object, or None.
            link: name of a link of the service, or None.
            timeout: seconds until the response begins; None for no limit. `ResponseDeadline` limits the rest.

        Raises:
            Unreached: the service has not responded.
            LinkError: the response is not of a service of paramclient.
            ParamClientError: the error that the service reports.
        """
        query = {} if link is None else {"link": link}
        async with self._sent(method, path, body, query, None, timeout) as response:
            content = await self._read(response)
            place = StreamPosition.read(response.headers.get("X-Seq"))
            if response.is_success and not content:
                return ServiceResponse(None, place)
            document = self._document(response, content)
            if not response.is_success:
                raise self._error(response, document)
            return ServiceResponse(document, place)

    @asynccontextmanager
    async def events(self, after: StreamPosition | None) -> AsyncIterator[AsyncIterator[list[Any]]]:
        """Open the stream of events after a position, or from now on, and yield them in batches.

        Raises:
            Unreached, ParamClientError: as in `ask`; Unreached also at the end of the stream.
        """
        headers = {"Accept": "text/event-stream", "Accept-Encoding": "identity"} | (
            {} if after is None else {"Last-Event-ID": str(after)}
        )
        async with self._sent("GET", "/events", None, {}, headers, SERVICE_OPEN_TIMEOUT) as response:
            kind = response.headers.get("Content-Type", "")
            if response.headers.get("Content-Encoding", "identity") != "identity":
                raise self._foreign()
            if not (response.is_success and kind.startswith("text/event-stream")):
                raise self._error(response, self._document(response, await self._read(response)))
            async with aclosing(self._chunks(response)) as chunks:
                yield chunks

    async def _chunks(self, response: httpx.Response) -> AsyncGenerator[list[Any], None]:
        chunks = _pieces(response)
        reader = EventReader()
        now = anyio.current_time()
        pace, hello_ends = ResponseDeadline(now), now + HELLO_TIMEOUT
        while True:
            try:
                timeout = min(STREAM_TIMEOUT, pace.left(reader.size, now), hello_ends - now)
                with anyio.fail_after(timeout):
                    chunk = await anext(chunks)
                now = anyio.current_time()
                events = [checked_document(data) for data in reader.receive(chunk)]
                if events:
                    hello_ends = math.inf
                if reader.size <= len(chunk):  # the incomplete event has begun in this chunk
                    pace = ResponseDeadline(now)
                yield events
            except TimeoutError:
                raise self._unreached("the service sends no more events", None) from None
            except StopAsyncIteration:
                raise self._unreached("the service has ended the event stream", None) from None
            except httpx.TransportError as error:
                raise self._unreached(_reason(error), error) from error
            except ValueError as error:
                raise self._foreign() from error

    @asynccontextmanager
    async def _sent(
        self,
        method: str,
        path: str,
        body: Mapping[str, Any] | None,
        query: Mapping[str, str],
        headers: Mapping[str, str] | None = None,
        timeout: float | None = None,
    ) -> AsyncIterator[httpx.Response]:
        assert self._http is not None
        request = self._http.build_request(
            method,
            self._base + path,
            json=body,
            params=query,
            headers=headers,
            extensions={"trace": _handshake_watch()},
        )
        try:
            with anyio.fail_after(timeout):
                response = await self._http.send(request, stream=True)
        except TimeoutError:
            raise self._unreached("the service does not respond", None) from None
        except (httpx.ConnectError, httpx.ConnectTimeout) as error:
            raise self._unreached(_reason(error), error, may_be_done=False) from error
        except httpx.TransportError as error:
            raise self._unreached(_reason(error), error) from error
        try:
            yield response
        finally:
            with anyio.CancelScope(shield=True):
                await response.aclose()

    async def _read(self, response: httpx.Response) -> bytes:
        content = bytearray()
        pace, received = ResponseDeadline(anyio.current_time()), 0
        chunks = _pieces(response)
        encoding = "" if response.is_stream_consumed else response.headers.get("Content-Encoding", "")
        try:
            decode = decoder_of(encoding.strip().lower())
            while True:
                with anyio.fail_after(pace.left(received, anyio.current_time())):
                    chunk = await anext(chunks, None)
                if chunk is None:
                    return bytes(content)
                received += len(chunk)
                content += decode(chunk, RESPONSE_BYTES_MAX - len(content))
                if max(len(content), received) > RESPONSE_BYTES_MAX:
                    raise LinkError(
                        f"{self.name}: a response of more than {RESPONSE_BYTES_MAX} bytes", link=self.name
                    )
        except TimeoutError:
            raise self._unreached("the response is too slow", None) from None
        except httpx.TransportError as error:
            raise self._unreached(_reason(error), error) from error
        except ValueError as error:
            raise self._foreign() from error

    def _document(self, response: httpx.Response, content: bytes) -> Any:
        kind = response.headers.get("Content-Type", "").partition(";")[0].strip()
        if response.status_code in (502, 503, 504) and kind != "application/problem+json":
            raise self._unreached(f"a proxy responds with HTTP status {response.status_code}", None)
        if kind not in ("application/json", "application/problem+json"):
            raise self._foreign()
        try:
            return checked_document(content)
        except ValueError as error:
            raise self._foreign() from error

    def _error(self, response: httpx.Response, problem: Any) -> ParamClientError:
        """Return the error of an unsuccessful response."""
        status = response.status_code
        if not isinstance(problem, dict) or status < 400:
            return self._foreign()
        if status == 401:
            words = "refuses the token" if self._has_token else "requires a token"
            return UsageError(f"{self.name} {words}; pass one with token=… or in {CLIENT_TOKEN_VARIABLE}")
        if problem.get("error") == "ClientClosed" or str(problem.get("type")).endswith(":closing"):
            raise self._unreached("the service is closing", None)
        try:
            with decode_errors(self.name):
                return error_of(problem, status=status, link=self.name)
        except LinkError:
            return self._foreign()

    def _unreached(
        self, words: str, cause: Exception | None, *, may_be_done: bool = True
    ) -> ServiceUnreachable:
        error = LinkError(f"{self.name}: {words}", link=self.name)
        error.__cause__ = cause
        return ServiceUnreachable(error, may_be_done=may_be_done)

    def _foreign(self) -> LinkError:
        return LinkError(f"{self.name} responds, but not as a service of paramclient", link=self.name)


def _pieces(response: httpx.Response) -> AsyncIterator[bytes]:
    """Return the chunks of a response; already decoded if the transport has read all of it."""
    return response.aiter_bytes() if response.is_stream_consumed else response.aiter_raw()


def _socket_options() -> list[tuple[int, int, int]]:
    options = [(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1), (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)]
    for name, number in KEEPALIVE_OPTIONS.items():
        if hasattr(socket, name):
            options.append((socket.IPPROTO_TCP, getattr(socket, name), number))
    return options


def _handshake_watch() -> Callable[[str, Mapping[str, Any]], Awaitable[None]]:
    """Return a trace function that closes a connection after a failed TLS handshake.

    After a cancelled handshake, httpcore leaves the connection open.
    """
    stream: Any = None

    async def trace(event: str, info: Mapping[str, Any]) -> None:
        nonlocal stream
        if event == "connection.connect_tcp.complete":
            stream = info["return_value"]
        elif event == "connection.start_tls.failed":
            with anyio.CancelScope(shield=True):
                await stream.aclose()

    return trace


def _reason(error: Exception) -> str:
    """Return the reason of a connection error: the text of the operating system, if there is one."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ssl.SSLCertVerificationError):
            return f"its certificate is not trusted: {cause.verify_message}"
        if isinstance(cause, ssl.SSLError):  # its errno is not one of the operating system
            return f"TLS: {(cause.reason or str(cause)).replace('_', ' ').lower()}"
        if isinstance(cause, OSError) and cause.errno == errno.ECONNREFUSED:
            return "connection refused. Is `paramclient serve` running there?"
        if isinstance(cause, OSError) and cause.errno is not None and cause.errno in errno.errorcode:
            return os.strerror(cause.errno).lower()
        if isinstance(cause, OSError) and cause.strerror:
            return cause.strerror.lower()
        cause = cause.__cause__ or cause.__context__
    return str(error).lower() or "the connection was lost"
