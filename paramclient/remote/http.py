"""What goes over HTTP to a service and back: requests with their answers, and the stream of events."""

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
from paramclient.remote.bounded import MOST_ANSWER, EventReader, Pace, checked_document, decoder_of
from paramclient.remote.decoding import understood
from paramclient.remote.problems import error_of
from paramclient.remote.service_address import TOKEN_VARIABLE, ServiceAddress
from paramclient.version import __version__

__all__ = ["Answer", "Place", "Requests", "Unreached"]

PREFIX: Final = "/api/v1"
OPEN_TIMEOUT: Final = 10.0
"""Seconds for finding a name, connecting over TLS and beginning to answer an event stream."""
SILENCE: Final = 6.0
"""Seconds without a word on the event stream after which the service counts as away: it says something every
two. A vehicle counts as lost after five."""
HELLO_PATIENCE: Final = 10.0
"""Seconds for the first event of a stream, which the service sends at once."""
LONGEST_PLACE: Final = 64
"""Characters of a place: a run has 16 digits, a number 18 at most."""
MOST_CONNECTIONS: Final = 200
"""Requests that are under way at once; further ones wait for their turn."""
KEEPALIVE: Final = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3}
"""When the system looks whether a service from which an answer is awaited still is there, in seconds and
times: a network that has gone says nothing, and an answer may take minutes."""


class Place(NamedTuple):
    """A place in the list of events of one run of a service."""

    run: str
    seq: int

    @classmethod
    def read(cls, text: str | None) -> Place | None:
        """What `RUN-SEQ` says; None for anything else."""
        run, dash, seq = (text or "").rpartition("-")
        is_one = dash and seq.isdecimal() and len(run) + len(seq) < LONGEST_PLACE
        return cls(run, int(seq)) if is_one else None

    def __str__(self) -> str:
        return f"{self.run}-{self.seq}"


@dataclass(frozen=True, slots=True)
class Answer:
    """What a service has answered.

    Attributes:
        document: as JSON, or None where there is nothing to say.
        place: what happened up to there is in it, or None where a proxy keeps that to itself.
    """

    document: Any
    place: Place | None


class Unreached(Exception):
    """The service gave no answer.

    Attributes:
        error: the reason.
        may_be_done: whether the request may have reached it all the same.
    """

    def __init__(self, error: LinkError, *, may_be_done: bool) -> None:
        super().__init__(str(error))
        self.error = error
        self.may_be_done = may_be_done


class Requests:
    """The connections to one service.

    Args:
        address: where it is.
        token: what it wants to see, or None.
        transport: how requests travel; None for sockets.
    """

    def __init__(
        self, address: ServiceAddress, token: str | None, transport: httpx.AsyncBaseTransport | None
    ) -> None:
        self.name = address.name
        headers = {"User-Agent": f"paramclient/{__version__}", "Accept-Encoding": "gzip, deflate"}
        headers["X-Asker"] = f"paramclient {os.getpid()}"  # so that another program's changes are not ours
        if token is not None:
            headers["Authorization"] = f"Bearer {token}"
        self._has_token = token is not None
        self._base = address.base + PREFIX
        self._headers = headers
        self._transport = transport
        self._http: httpx.AsyncClient | None = None

    async def open(self) -> None:
        """Be ready; nothing is sent yet."""
        transport = self._transport or httpx.AsyncHTTPTransport(
            limits=httpx.Limits(max_connections=MOST_CONNECTIONS, max_keepalive_connections=20),
            socket_options=_socket_options(),
        )
        self._http = httpx.AsyncClient(
            headers=self._headers,
            transport=transport,
            timeout=httpx.Timeout(None, connect=OPEN_TIMEOUT),
            follow_redirects=False,
        )

    async def close(self) -> None:
        """Leave no connection behind."""
        if self._http is not None:
            await self._http.aclose()

    async def ask(
        self,
        method: str,
        path: str,
        body: Mapping[str, Any] | None = None,
        *,
        link: str | None = None,
        patience: float | None = None,
    ) -> Answer:
        """Send a request and wait for its answer. Cancelled, it is withdrawn.

        Args:
            method, path: behind the prefix.
            body: as JSON, or None for none.
            link: which link is meant, or None.
            patience: seconds until the answer begins; None for however long that takes. An answer that has
                begun has to go on, see `Pace`.

        Raises:
            Unreached: there was no answer.
            ParamClientError: that of a problem; LinkError for what is no answer of a service.
        """
        query = {} if link is None else {"link": link}
        async with self._sent(method, path, body, query, None, patience) as response:
            content = await self._read(response)
            place = Place.read(response.headers.get("X-Seq"))
            if response.is_success and not content:
                return Answer(None, place)
            document = self._document(response, content)
            if not response.is_success:
                raise self._error(response, document)
            return Answer(document, place)

    @asynccontextmanager
    async def events(self, after: Place | None) -> AsyncIterator[AsyncIterator[list[Any]]]:
        """The events after a place or from now on, as they come, several at once.

        Raises:
            Unreached, ParamClientError: as in `ask`; while listening, Unreached when it ends.
        """
        headers = {"Accept": "text/event-stream", "Accept-Encoding": "identity"} | (
            {} if after is None else {"Last-Event-ID": str(after)}
        )
        async with self._sent("GET", "/events", None, {}, headers, OPEN_TIMEOUT) as response:
            kind = response.headers.get("Content-Type", "")
            if response.headers.get("Content-Encoding", "identity") != "identity":
                raise self._foreign()
            if not (response.is_success and kind.startswith("text/event-stream")):
                raise self._error(response, self._document(response, await self._read(response)))
            async with aclosing(self._heard(response)) as heard:
                yield heard

    async def _heard(self, response: httpx.Response) -> AsyncGenerator[list[Any], None]:
        chunks = _pieces(response)
        reader = EventReader()
        now = anyio.current_time()
        pace, hello_ends = Pace(now), now + HELLO_PATIENCE
        while True:
            try:
                patience = min(SILENCE, pace.left(reader.size, now), hello_ends - now)
                with anyio.fail_after(patience):
                    chunk = await anext(chunks)
                now = anyio.current_time()
                events = [checked_document(data) for data in reader.receive(chunk)]
                if events:
                    hello_ends = math.inf
                if reader.size <= len(chunk):  # the last event has begun in it
                    pace = Pace(now)
                yield events
            except TimeoutError:
                raise self._unreached("says nothing any more", None) from None
            except StopAsyncIteration:
                raise self._unreached("has ended the stream of events", None) from None
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
        patience: float | None = None,
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
            with anyio.fail_after(patience):
                response = await self._http.send(request, stream=True)
        except TimeoutError:
            raise self._unreached("does not answer", None) from None
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
        pace, received = Pace(anyio.current_time()), 0
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
                content += decode(chunk, MOST_ANSWER - len(content))
                if max(len(content), received) > MOST_ANSWER:
                    raise LinkError(f"{self.name}: an answer without end", link=self.name)
        except TimeoutError:
            raise self._unreached("answers too slowly", None) from None
        except httpx.TransportError as error:
            raise self._unreached(_reason(error), error) from error
        except ValueError as error:
            raise self._foreign() from error

    def _document(self, response: httpx.Response, content: bytes) -> Any:
        kind = response.headers.get("Content-Type", "").partition(";")[0].strip()
        if response.status_code in (502, 503, 504) and kind != "application/problem+json":
            raise self._unreached(f"a proxy answers {response.status_code}", None)
        if kind not in ("application/json", "application/problem+json"):
            raise self._foreign()
        try:
            return checked_document(content)
        except ValueError as error:
            raise self._foreign() from error

    def _error(self, response: httpx.Response, problem: Any) -> ParamClientError:
        """What an answer says that is none of success."""
        status = response.status_code
        if not isinstance(problem, dict) or status < 400:
            return self._foreign()
        if status == 401:
            words = "does not take the token" if self._has_token else "wants a token"
            return UsageError(f"{self.name} {words}; give it with token=… or in {TOKEN_VARIABLE}")
        if problem.get("error") == "ClientClosed" or str(problem.get("type")).endswith(":closing"):
            raise self._unreached("is closing", None)
        try:
            with understood(self.name):
                return error_of(problem, status=status, link=self.name)
        except LinkError:
            return self._foreign()

    def _unreached(self, words: str, cause: Exception | None, *, may_be_done: bool = True) -> Unreached:
        error = LinkError(f"{self.name}: {words}", link=self.name)
        error.__cause__ = cause
        return Unreached(error, may_be_done=may_be_done)

    def _foreign(self) -> LinkError:
        return LinkError(f"{self.name} answers, but not as a service of paramclient does", link=self.name)


def _pieces(response: httpx.Response) -> AsyncIterator[bytes]:
    """The bytes of an answer as they come; decoded already where the transport has read all of it."""
    return response.aiter_bytes() if response.is_stream_consumed else response.aiter_raw()


def _socket_options() -> list[tuple[int, int, int]]:
    options = [(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1), (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)]
    for name, number in KEEPALIVE.items():
        if hasattr(socket, name):
            options.append((socket.IPPROTO_TCP, getattr(socket, name), number))
    return options


def _handshake_watch() -> Callable[[str, Mapping[str, Any]], Awaitable[None]]:
    """What closes a connection whose TLS handshake fails: when it is cancelled, httpcore leaves it open."""
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
    """Why, in words: the system's where there are any."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ssl.SSLCertVerificationError):
            return f"its certificate is not trusted: {cause.verify_message}"
        if isinstance(cause, ssl.SSLError):  # their numbers are not the system's
            return f"TLS: {(cause.reason or str(cause)).replace('_', ' ').lower()}"
        if isinstance(cause, OSError) and cause.errno is not None and cause.errno in errno.errorcode:
            return os.strerror(cause.errno).lower()
        if isinstance(cause, OSError) and cause.strerror:
            return cause.strerror.lower()
        cause = cause.__cause__ or cause.__context__
    return str(error).lower() or "the connection was lost"
