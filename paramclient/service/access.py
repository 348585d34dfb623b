"""Access checks of every request: host, origin, token or session, role, size of the body.

An ASGI middleware in front of the application. The application finds the author of the request (`author`,
`name`), its permissions (`role`, `read_only`) and the holder of its quota (`quota`) in `scope["state"]`.
Tokens and cookies are removed from its headers.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, MutableMapping
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any, Final, TypeAlias

import anyio

from paramclient.client.arguments import AUTHOR_LENGTH_MAX
from paramclient.errors import UsageError
from paramclient.service.body_limits import METADATA_BYTES_MAX, SESSION_BODY_BYTES_MAX
from paramclient.service.body_memory import BodyMemory, BodyReservation
from paramclient.service.client_address import is_in_networks, is_loopback, parse_network
from paramclient.service.log_limit import LogLimit
from paramclient.service.quota import (
    LARGE_GETS_MAX,
    LARGE_GETS_OF_HOLDER_MAX,
    LARGE_POSTS_MAX,
    LARGE_POSTS_OF_HOLDER_MAX,
    Quota,
)
from paramclient.service.request import (
    BEARER_CHALLENGE,
    HOST_PATTERN,
    SESSION_PATH,
    Request,
    RequestDenied,
    Scope,
)
from paramclient.service.tokens import (
    SESSION_LIFETIME,
    WRONG_TOKEN_DELAY,
    Sessions,
    TokenHolder,
    Tokens,
    WrongTokens,
)

__all__ = ["AccessMiddleware", "AccessSettings", "may_write"]

logger = logging.getLogger(__name__)

Message: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[Message]]
Send: TypeAlias = Callable[[Message], Awaitable[None]]
App: TypeAlias = Callable[[Scope, Receive, Send], Awaitable[None]]

BODY_TIMEOUT: Final = 60.0
"""Timeout in seconds for receiving a body."""
SEND_CHUNK_BYTES: Final = 65_536
"""Maximum number of bytes of a response passed to the connection at once: the connection buffers unsent
bytes."""
CLIENT_NAME_LENGTH_MAX: Final = 64
"""Maximum number of characters of the header X-Author."""

API_POLICY: Final = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox"
"""Content-Security-Policy of responses of the API."""
PAGE_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content-Security-Policy of the web page and the API reference."""
ALLOWED_METHODS: Final = "GET, HEAD, POST, PUT, PATCH, DELETE"
"""Methods that pages of allowed origins may use."""
ALLOWED_HEADERS: Final = "Authorization, Content-Type, Last-Event-ID, X-Author"
"""Headers that pages of allowed origins may send."""
EXPOSED_HEADERS: Final = "Content-Disposition, Location, Retry-After, X-Seq"
"""Response headers that pages of allowed origins may read."""
PREFLIGHT_AGE: Final = 600
"""Seconds for which a browser caches the response to a preflight request."""


@dataclass(frozen=True, slots=True)
class AccessSettings:
    """Settings of the access checks.

    Attributes:
        listen: address or host name of the listening socket.
        tokens: valid tokens; None is allowed only if the service listens on a loopback address.
        hosts: host names accepted in Host, besides `localhost`, loopback addresses and `listen`.
        origins: origins of foreign pages that may use the API, such as `https://station.example`; without
            tokens they may only read.
        proxies: addresses and networks of trusted proxies, whose X-Forwarded-For or Forwarded names the
            client. Require tokens, because every client of the proxy has the proxy's address.
        read_only: rejects every change.
        max_body: maximum size in bytes of any body; `Request.body_bytes_max` applies too.

    Raises:
        UsageError: other computers could connect without a token, or a host, origin or proxy is invalid.
    """

    listen: str = "127.0.0.1"
    tokens: Tokens | None = None
    hosts: Collection[str] = ()
    origins: Collection[str] = ()
    proxies: Collection[str] = ()
    read_only: bool = False
    max_body: int = METADATA_BYTES_MAX

    def __post_init__(self) -> None:
        object.__setattr__(self, "hosts", frozenset(map(_host_name, self.hosts)))
        object.__setattr__(self, "origins", frozenset(map(_origin, self.origins)))
        object.__setattr__(self, "proxies", frozenset(str(parse_network(each)) for each in self.proxies))
        if self.tokens is None and self.proxies:
            raise UsageError(
                "behind a proxy, every client of the proxy could change parameters: the service needs a "
                "token. Create one with `paramclient token NAME --file FILE` and start with --token-file FILE"
            )
        exposed = [name for name in (self.listen, *sorted(self.hosts)) if not _is_loopback_only(name)]
        if self.tokens is None and exposed:
            raise UsageError(
                f"with {exposed[0]}, everyone on the network could change parameters: the service needs a "
                "token. Create one with `paramclient token NAME --file FILE` and start with "
                "--token-file FILE, or listen on 127.0.0.1 only"
            )

    def is_proxy(self, address: str) -> bool:
        """Return whether an address belongs to a trusted proxy."""
        return is_in_networks(address, map(parse_network, self.proxies))


class AccessMiddleware:
    """Checks each request before it reaches an ASGI application.

    Args:
        app: the application.
        settings: what the checks allow.
        clock: returns monotonic time in seconds.
    """

    def __init__(
        self, app: App, settings: AccessSettings, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._app = app
        self._settings = settings
        self._sessions = Sessions(clock)
        self._wrong_tokens = WrongTokens(clock)
        self._proxies = tuple(map(parse_network, settings.proxies))
        self._log_limit = LogLimit(clock)
        self._bodies = BodyMemory()
        self._large_gets = Quota(
            "large responses", total_max=LARGE_GETS_MAX, holder_max=LARGE_GETS_OF_HOLDER_MAX
        )
        self._large_posts = Quota(
            "large responses", total_max=LARGE_POSTS_MAX, holder_max=LARGE_POSTS_OF_HOLDER_MAX
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        request = Request(scope, self._proxies)
        response = _Response(request, send, varies=bool(self._settings.origins))
        try:
            await self._handle_request(request, receive, response)
        except RequestDenied as denied:
            await response.refuse(denied, receive)

    async def _handle_request(self, request: Request, receive: Receive, response: _Response) -> None:
        request.check_format()
        request.apply_forwarded_headers()
        self._check_host(request)
        self._check_origin(request)
        response.origin = request.origin if request.origin in self._settings.origins else None
        if request.is_preflight:
            await response.preflight()
            return
        holder = await self._authenticate(request)
        if request.path == SESSION_PATH and request.method in ("POST", "DELETE"):
            await self._session(request, receive, response, holder)
            return
        self._check_role(request, holder)
        state = request.scope.setdefault("state", {})
        state["author"] = _author_of(request, holder if self._settings.tokens is not None else None)
        state["name"] = None if holder is None else holder.name
        state["role"] = None if holder is None else holder.role
        state["read_only"] = self._settings.read_only
        state["quota"] = _quota_holder(request, holder if self._settings.tokens is not None else None)
        scope = {
            **request.scope,
            "headers": [each for each in request.headers if each[0] not in _SECRET_HEADERS],
        }
        with self._bodies.hold(state["quota"]) as reserved:
            if request.has_body:
                request.check_content_type()
                size_max = min(request.body_bytes_max, self._settings.max_body)
                receive = _with_body(await self._read_body(request, receive, size_max, reserved), receive)
            if not request.has_large_response:
                await self._app(scope, receive, response.send)
                return
            quota = self._large_posts if request.method == "POST" else self._large_gets
            async with quota.wait(state["quota"]):  # until the whole response is sent
                await self._app(scope, receive, response.send)

    # Host and origin

    def _check_host(self, request: Request) -> None:
        """Reject requests with a foreign host name, which DNS rebinding could direct to this service.

        Starlette's TrustedHostMiddleware is not equivalent: it matches only names, not address ranges or
        names with a final dot, and rejects with 400 in plain text, also on a WebSocket whose server cannot
        send a response.

        Raises:
            RequestDenied: 421, the host name is not allowed.
        """
        name = request.host_name
        if name in _LOOPBACK_NAMES or name in self._settings.hosts or name == self._settings.listen.lower():
            return
        try:
            address = ip_address(name)
        except ValueError:
            pass
        else:  # DNS cannot redirect an address
            if address.is_loopback or not _is_loopback_only(self._settings.listen):
                return
        raise RequestDenied(
            421,
            "foreign-host",
            "The host name in Host is not allowed. Allow it with `paramclient serve --host NAME`.",
        )

    def _check_origin(self, request: Request) -> None:
        """Reject requests from pages of foreign origins, which would use the permissions of the browser's
        user.

        Raises:
            RequestDenied: 403, the origin is not allowed.
        """
        origin = request.origin
        if origin is not None:
            if origin in self._settings.origins or origin == request.own_origin:
                return
            raise RequestDenied(
                403,
                "foreign-origin",
                "Pages of this origin may not use the service. Allow it with "
                "`paramclient serve --allow-origin ORIGIN`.",
            )
        site = request.header(b"sec-fetch-site")
        if site in (None, b"none", b"same-origin"):
            return
        is_followed_link = request.method in ("GET", "HEAD") and (
            request.header(b"sec-fetch-mode"),
            request.header(b"sec-fetch-dest"),
        ) == (b"navigate", b"document")
        if not is_followed_link:
            raise RequestDenied(403, "foreign-origin", "Pages of other sites may not use the service.")

    # Authentication and permissions

    async def _authenticate(self, request: Request) -> TokenHolder | None:
        """Return the holder of the token or session; None for a public request without one.

        Raises:
            RequestDenied: 401, the token or session is missing or invalid; 429, too many wrong tokens.
        """
        tokens = self._settings.tokens
        if tokens is None:
            is_foreign = request.origin is not None and request.origin != request.own_origin
            return _FOREIGN if is_foreign else _LOCAL
        token = request.token
        if token is not None:
            return await self._authenticate_token(token, request.address, tokens)
        cookie = request.cookie
        holder = None if cookie is None else self._sessions.holder(cookie)
        if holder is None and not request.is_public:
            raise RequestDenied(
                401,
                "unauthenticated",
                "This service requires a token: send `Authorization: Bearer TOKEN`.",
                BEARER_CHALLENGE,
            )
        return holder

    async def _authenticate_token(self, token: bytes, address: str, tokens: Tokens) -> TokenHolder:
        """Return the holder of a token, with a delay after many wrong tokens from its address.

        The delay applies to valid tokens too: otherwise a missing response would reveal a wrong token. Valid
        tokens are never rejected, because other clients of a proxy share its address.

        Raises:
            RequestDenied: 401, the token is invalid; 429, after many wrong tokens from this address.
        """
        if is_late := self._wrong_tokens.wait(address) > 0:
            await anyio.sleep(WRONG_TOKEN_DELAY)
        holder = tokens.holder(token)
        if holder is not None:
            return holder
        if self._wrong_tokens.add(address, token):
            self._log_limit.log(logger, "guesses", f"many wrong tokens from {address}")
        if is_late:
            wait = max(1, math.ceil(self._wrong_tokens.wait(address)))
            raise RequestDenied(
                429,
                "too-many-guesses",
                f"Too many wrong tokens from this address. Its tokens are checked with delay for {wait} s.",
                [(b"retry-after", str(wait).encode())],
            )
        raise RequestDenied(
            401, "unauthenticated", "The token is not valid for this service.", BEARER_CHALLENGE
        )

    def _check_role(self, request: Request, holder: TokenHolder | None) -> None:
        """Reject a change without permission to write."""
        if not request.is_change:
            return
        if self._settings.read_only:
            raise RequestDenied(
                403, "read-only", "The service was started with --read-only and changes nothing."
            )
        if holder is _FOREIGN:
            raise RequestDenied(
                403,
                "forbidden",
                "Without tokens, pages of other origins may only read. Start the service with --token-file.",
            )
        if holder is None or holder.role != "write":
            raise RequestDenied(403, "forbidden", "This token only allows reading.")

    async def _session(
        self, request: Request, receive: Receive, response: _Response, holder: TokenHolder | None
    ) -> None:
        """Start or end the session of a browser."""
        if request.has_body or request.method == "POST":
            request.check_content_type()
        if request.method == "DELETE":
            if request.cookie is not None:
                self._sessions.end(request.cookie)
            await response.respond(204, b"", [(b"set-cookie", _set_cookie(request, "", 0))])
            return
        with self._bodies.hold(_quota_holder(request, None)) as reserved:
            token = _parse_session_token(
                await self._read_body(request, receive, SESSION_BODY_BYTES_MAX, reserved)
            )
        headers = []
        if self._settings.tokens is not None:
            holder = await self._authenticate_token(token, request.address, self._settings.tokens)
            value = _set_cookie(request, self._sessions.begin(holder), int(SESSION_LIFETIME))
            headers.append((b"set-cookie", value))
        assert holder is not None
        me = {"role": holder.role, "name": holder.name, "read_only": self._settings.read_only}
        await response.respond(200, json.dumps(me).encode(), [*headers, _JSON])

    # Body

    async def _read_body(
        self, request: Request, receive: Receive, size_max: int, reserved: BodyReservation
    ) -> bytes:
        """Return the whole body.

        Args:
            size_max: maximum size in bytes.
            reserved: counts the bytes in memory.

        Raises:
            RequestDenied: the body is too large or too slow, or too many bytes are in memory.
        """
        too_large = RequestDenied(
            413, "too-large", f"The body of this request may have at most {size_max} bytes."
        )
        if request.length is not None and request.length > size_max:
            raise too_large
        body = bytearray()
        try:
            with anyio.fail_after(BODY_TIMEOUT):
                is_whole = False
                while not is_whole:
                    message = await receive()
                    if message["type"] == "http.disconnect":
                        raise RequestDenied(
                            400, "bad-request", "The connection was closed before the end of the body."
                        )
                    piece = message.get("body", b"")
                    body += piece
                    reserved.add(len(piece))
                    if len(body) > size_max:
                        raise too_large
                    is_whole = not message.get("more_body", False)
        except TimeoutError:
            raise RequestDenied(
                408, "too-slow", f"The body was not received within {BODY_TIMEOUT:.0f} s."
            ) from None
        return bytes(body)


def may_write(request: Any) -> bool:
    """Return whether the author of a request may change something, for paths that allow reading and changing.

    Accepts any object with the `scope` of a request.
    """
    state = request.scope["state"]
    return state["role"] == "write" and not state["read_only"]


@dataclass(slots=True)
class _Response:
    """Sends a response with the headers that every response has."""

    request: Request
    original: Send
    origin: str | None = None
    varies: bool = False

    async def send(self, message: Message) -> None:
        """Send a message of the application. A large body is sent in chunks, as the client receives them."""
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            message = {**message, "headers": self._headers(message.get("headers", ()))}
        elif message["type"] == "http.response.body" and not message.get("more_body", False):
            whole = memoryview(message.get("body", b""))
            while len(whole) > SEND_CHUNK_BYTES:
                part, whole = bytes(whole[:SEND_CHUNK_BYTES]), whole[SEND_CHUNK_BYTES:]
                await self.original({**message, "body": part, "more_body": True})
            message = {**message, "body": bytes(whole)}
        await self.original(message)

    async def respond(self, status: int, body: bytes, headers: Iterable[tuple[bytes, bytes]]) -> None:
        """Send a response of the access checks."""
        kind = "websocket.http" if self.request.scope["type"] == "websocket" else "http"
        given = [*headers, (b"content-length", str(len(body)).encode())] if status != 204 else list(headers)
        await self.send({"type": f"{kind}.response.start", "status": status, "headers": given})
        await self.original({"type": f"{kind}.response.body", "body": body})

    async def preflight(self) -> None:
        """Respond to a CORS preflight request of an allowed origin."""
        headers = [
            (b"access-control-allow-methods", ALLOWED_METHODS.encode()),
            (b"access-control-allow-headers", ALLOWED_HEADERS.encode()),
            (b"access-control-max-age", str(PREFLIGHT_AGE).encode()),
            (b"vary", b"Access-Control-Request-Method, Access-Control-Request-Headers"),
        ]
        await self.respond(204, b"", headers)

    async def refuse(self, denied: RequestDenied, receive: Receive) -> None:
        """Respond with a problem. Close the connection if the start of the next request is unknown."""
        if self.request.scope["type"] == "websocket":
            await receive()
            if "websocket.http.response" not in self.request.scope.get("extensions", {}):
                await self.original({"type": "websocket.close", "code": 1008, "reason": denied.detail[:100]})
                return
        problem = {
            "type": f"urn:paramclient:{denied.kind}",
            "title": denied.kind.replace("-", " ").capitalize(),
            "status": denied.status,
            "detail": denied.detail,
        }
        headers = [*denied.headers, (b"content-type", b"application/problem+json")]
        if self.request.announces_body or denied.status in _AMBIGUOUS_STATUSES:
            headers.append((b"connection", b"close"))
        await self.respond(denied.status, json.dumps(problem).encode(), headers)

    def _headers(self, given: Iterable[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
        is_page = self.request.is_page
        ours = [
            *_RESPONSE_HEADERS,
            (b"content-security-policy", (PAGE_POLICY if is_page else API_POLICY).encode()),
        ]
        if not is_page:
            ours.append((b"cache-control", b"no-store"))
        if self.origin is not None:
            ours.append((b"access-control-allow-origin", self.origin.encode("latin-1")))
            ours.append((b"access-control-expose-headers", EXPOSED_HEADERS.encode()))
        if self.varies:
            ours.append((b"vary", b"Origin"))
        names = {name for name, _ in ours} - {b"vary"}
        kept = [(name, value) for name, value in given if name.lower() not in names]
        if is_page and not any(name.lower() == b"cache-control" for name, _ in kept):
            ours.append((b"cache-control", b"no-cache"))
        return [*kept, *ours]


def _author_of(request: Request, holder: TokenHolder | None) -> str:
    """Return the author of changes for the history: `anna@10.0.0.2 (content of X-Author)`."""
    holder_name = "local" if holder is None else f"{holder.name}@{request.address}"
    given = request.header(b"x-author")
    if given is None:
        return holder_name
    client = given.decode("latin-1")
    if not 1 <= len(client) <= CLIENT_NAME_LENGTH_MAX or not (client.isascii() and client.isprintable()):
        raise RequestDenied(
            400,
            "bad-request",
            f"X-Author must have 1 to {CLIENT_NAME_LENGTH_MAX} printable ASCII characters.",
        )
    return f"{holder_name} ({client})"[:AUTHOR_LENGTH_MAX]


def _quota_holder(request: Request, holder: TokenHolder | None) -> str:
    """Return the holder of the quotas of a request: the token's holder, or the address without tokens."""
    return f"the address {request.network}" if holder is None else f"the token {holder.name}"


def _with_body(body: bytes, receive: Receive) -> Receive:
    """Return a receive function that returns a received body first."""
    given = False

    async def next_message() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return next_message


def _set_cookie(request: Request, value: str, age: int) -> bytes:
    secure = "; Secure" if request.is_secure else ""
    cookie = f"{request.cookie_name}={value}; Path=/; Max-Age={age}; HttpOnly; SameSite=Strict{secure}"
    return cookie.encode()


def _parse_session_token(body: bytes) -> bytes:
    """Return the token in the body that starts a session."""
    try:
        document = json.loads(body)
    except (ValueError, RecursionError):
        document = None
    if isinstance(document, Mapping) and list(document) == ["token"] and isinstance(document["token"], str):
        return document["token"].encode("utf-8", "surrogatepass")
    raise RequestDenied(422, "invalid-request", 'The body must be {"token": TOKEN}.')


def _host_name(text: str) -> str:
    name = text.strip("[]").lower().removesuffix(".")
    with suppress(ValueError):
        return str(ip_address(name))
    found = HOST_PATTERN.fullmatch(name)
    if found is None or found["port"] is not None:
        raise UsageError(f"{text!r:.100} is not a host name such as companion.local")
    return name


def _origin(text: str) -> str:
    scheme, separator, host = text.lower().partition("://")
    if scheme not in ("http", "https") or not separator or not HOST_PATTERN.fullmatch(host):
        raise UsageError(f"{text!r:.100} is not an origin such as https://station.example:8443")
    return f"{scheme}://{host}"


def _is_loopback_only(listen: str) -> bool:
    """Return whether only this computer can connect to an address. Names other than localhost may resolve to
    any."""
    return listen.lower() == "localhost" or is_loopback(listen.strip("[]"))


_LOOPBACK_NAMES: Final = frozenset({"localhost"})
_LOCAL: Final = TokenHolder("local", "write")
"""Holder of requests without tokens."""
_FOREIGN: Final = TokenHolder("local", "read")
"""Holder of requests of foreign pages without tokens, which run in a browser on this computer."""
_SECRET_HEADERS: Final = frozenset({b"authorization", b"cookie"})
_AMBIGUOUS_STATUSES: Final = (400, 414, 431)
_JSON: Final = (b"content-type", b"application/json")
_RESPONSE_HEADERS: Final = [
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
]
