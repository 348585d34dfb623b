"""Who may do what: every request passes here before anything else sees it.

Pure ASGI, and independent of the framework behind it. What is let through has in `scope["state"]` who asks
(`asker`, `name`), what that one may do (`role`, `read_only`), and neither token nor cookie in its headers.
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

from paramclient.errors import UsageError
from paramclient.protocol.params.change_origin import ASKER_LENGTH_MAX
from paramclient.service.client_address import is_in, is_loopback, network
from paramclient.service.held_bodies import HeldBodies, HeldBody
from paramclient.service.log_limit import LogLimit
from paramclient.service.quota import (
    LARGE_GETS_MAX,
    LARGE_GETS_OF_HOLDER_MAX,
    LARGE_POSTS_MAX,
    LARGE_POSTS_OF_HOLDER_MAX,
    Quota,
)
from paramclient.service.request import (
    ASK,
    HOST,
    LARGEST_DESCRIPTION,
    SESSION_PATH,
    Denied,
    Request,
    Scope,
)
from paramclient.service.tokens import GUESS_DELAY, SESSION_AGE, Guesses, Holder, Sessions, Tokens

__all__ = ["AccessMiddleware", "AccessSettings", "may_write"]

logger = logging.getLogger(__name__)

Message: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[Message]]
Send: TypeAlias = Callable[[Message], Awaitable[None]]
App: TypeAlias = Callable[[Scope, Receive, Send], Awaitable[None]]

LONGEST_SESSION: Final = 1_024
"""Bytes of the body that begins a session: all that those without a token may send."""
BODY_PATIENCE: Final = 60.0
"""Seconds for a body to come."""
SENT_AT_ONCE: Final = 65_536
"""Bytes of an answer that are handed to the connection at once: it keeps what the client has not taken."""
LONGEST_CLIENT: Final = 64
"""Characters in which a client says what it is, in X-Asker."""

API_POLICY: Final = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox"
PAGE_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
ALLOWED_METHODS: Final = "GET, HEAD, POST, PUT, PATCH, DELETE"
ALLOWED_HEADERS: Final = "Authorization, Content-Type, Last-Event-ID, X-Asker"
SHOWN_HEADERS: Final = "Content-Disposition, Location, Retry-After, X-Seq"
PREFLIGHT_AGE: Final = 600
"""Seconds for which a browser need not ask again."""


@dataclass(frozen=True, slots=True)
class AccessSettings:
    """Who is let in.

    Attributes:
        listen: the address or name that is listened at.
        tokens: who has one; None only where nobody but this machine can connect.
        hosts: names by which the service may be called, beside this machine's loopback names, and addresses.
        origins: pages elsewhere that may use it from a browser, such as `https://station.example`; without
            tokens they may read only.
        proxies: addresses and networks of proxies, whose X-Forwarded-For or Forwarded says who asks. Tokens
            are needed then: everyone who can reach the proxy comes from its address.
        read_only: nobody may change anything.
        max_body: bytes of one body, where `Request.longest_body` allows as many.

    Raises:
        UsageError: it would be open to others without a token, or something in it cannot be.
    """

    listen: str = "127.0.0.1"
    tokens: Tokens | None = None
    hosts: Collection[str] = ()
    origins: Collection[str] = ()
    proxies: Collection[str] = ()
    read_only: bool = False
    max_body: int = LARGEST_DESCRIPTION

    def __post_init__(self) -> None:
        object.__setattr__(self, "hosts", frozenset(map(_host_name, self.hosts)))
        object.__setattr__(self, "origins", frozenset(map(_origin, self.origins)))
        object.__setattr__(self, "proxies", frozenset(str(network(each)) for each in self.proxies))
        if self.tokens is None and self.proxies:
            raise UsageError(
                "behind a proxy the service would let everyone who reaches that change parameters: it needs "
                "a token. Make one with `paramclient token NAME --file FILE` and start with --token-file FILE"
            )
        beyond = [name for name in (self.listen, *sorted(self.hosts)) if not _is_only_here(name)]
        if self.tokens is None and beyond:
            raise UsageError(
                f"as {beyond[0]} the service would let everyone on the network change parameters: it needs a "
                "token. Make one with `paramclient token NAME --file FILE` and start with --token-file FILE, "
                "or listen at 127.0.0.1 alone"
            )

    def is_proxy(self, address: str) -> bool:
        """Whether an address is that of a proxy that is trusted."""
        return is_in(address, map(network, self.proxies))


class AccessMiddleware:
    """An ASGI application in front of another one.

    Args:
        app: the other one.
        settings: who is let in.
        clock: seconds, that only go forward.
    """

    def __init__(
        self, app: App, settings: AccessSettings, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._app = app
        self._settings = settings
        self._sessions = Sessions(clock)
        self._guesses = Guesses(clock)
        self._proxies = tuple(map(network, settings.proxies))
        self._limit = LogLimit(clock)
        self._bodies = HeldBodies()
        self._large_gets = Quota(
            "large responses", most=LARGE_GETS_MAX, most_of_holder=LARGE_GETS_OF_HOLDER_MAX
        )
        self._large_posts = Quota(
            "large responses", most=LARGE_POSTS_MAX, most_of_holder=LARGE_POSTS_OF_HOLDER_MAX
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        request = Request(scope, self._proxies)
        answer = _Answer(request, send, varies=bool(self._settings.origins))
        try:
            await self._let_in(request, receive, answer)
        except Denied as denied:
            await answer.refuse(denied, receive)

    async def _let_in(self, request: Request, receive: Receive, answer: _Answer) -> None:
        request.check_shape()
        request.take_forwarded()
        self._check_host(request)
        self._check_origin(request)
        answer.origin = request.origin if request.origin in self._settings.origins else None
        if request.is_preflight:
            await answer.preflight()
            return
        holder = await self._holder(request)
        if request.path == SESSION_PATH and request.method in ("POST", "DELETE"):
            await self._session(request, receive, answer, holder)
            return
        self._check_role(request, holder)
        state = request.scope.setdefault("state", {})
        state["asker"] = _asker(request, holder if self._settings.tokens is not None else None)
        state["name"] = None if holder is None else holder.name
        state["role"] = None if holder is None else holder.role
        state["read_only"] = self._settings.read_only
        state["quota"] = _quota(request, holder if self._settings.tokens is not None else None)
        scope = {**request.scope, "headers": [each for each in request.headers if each[0] not in _SECRET]}
        with self._bodies.hold(state["quota"]) as held:
            if request.has_body:
                request.check_content()
                most = min(request.longest_body, self._settings.max_body)
                receive = _after(await self._body(request, receive, most, held), receive)
            if not request.has_large_answer:
                await self._app(scope, receive, answer.send)
                return
            quota = self._large_posts if request.method == "POST" else self._large_gets
            async with quota.wait(state["quota"]):  # until the whole response is sent
                await self._app(scope, receive, answer.send)

    # Where it comes from

    def _check_host(self, request: Request) -> None:
        """The service is called by a name of its own: another one may be led here by its owner's DNS.

        Starlette's TrustedHostMiddleware is not equal, as it matches names only, not ranges of addresses
        or names with a final dot, and refuses with 400 in plain text, also on a WebSocket whose server
        cannot send a response.
        """
        name = request.host_name
        if name in _LOOPBACK_NAMES or name in self._settings.hosts or name == self._settings.listen.lower():
            return
        try:
            address = ip_address(name)
        except ValueError:
            pass
        else:  # an address is no name that could be led elsewhere
            if address.is_loopback or not _is_only_here(self._settings.listen):
                return
        raise Denied(
            421,
            "foreign-host",
            "This service does not go by the name in Host; `paramclient serve --host NAME` allows another.",
        )

    def _check_origin(self, request: Request) -> None:
        """No page of somebody else uses the browser of one who may do more than that page."""
        origin = request.origin
        if origin is not None:
            if origin in self._settings.origins or origin == request.own_origin:
                return
            raise Denied(
                403,
                "foreign-origin",
                "Pages from elsewhere may not use this service; those that may are named with "
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
            raise Denied(403, "foreign-origin", "Pages from elsewhere may not use this service.")

    # Who it is

    async def _holder(self, request: Request) -> Holder | None:
        """Whose token or session came with it; None for nobody's, where that is enough."""
        tokens = self._settings.tokens
        if tokens is None:
            is_foreign = request.origin is not None and request.origin != request.own_origin
            return _FOREIGN if is_foreign else _LOCAL
        token = request.token
        if token is not None:
            return await self._holder_of(token, request.address, tokens)
        cookie = request.cookie
        holder = None if cookie is None else self._sessions.holder(cookie)
        if holder is None and not request.is_public:
            raise Denied(401, "unauthenticated", "This service is open to those who have a token.", ASK)
        return holder

    async def _holder_of(self, token: bytes, address: str, tokens: Tokens) -> Holder:
        """Whose token this is; late where many wrong ones have come from the same address.

        A right one is late too, else a guess that is not answered at once would be known to be wrong. It is
        never refused: the address may be that of a proxy with others behind it.
        """
        if is_late := self._guesses.wait(address) > 0:
            await anyio.sleep(GUESS_DELAY)
        holder = tokens.holder(token)
        if holder is not None:
            return holder
        if self._guesses.add(address, token):
            self._limit.tell(logger, "guesses", f"many wrong tokens have come from {address}")
        if is_late:
            wait = max(1, math.ceil(self._guesses.wait(address)))
            raise Denied(
                429,
                "too-many-guesses",
                f"Too many wrong tokens have come from this address; for {wait} s all of its tokens wait.",
                [(b"retry-after", str(wait).encode())],
            )
        raise Denied(401, "unauthenticated", "The service does not know this token.", ASK)

    def _check_role(self, request: Request, holder: Holder | None) -> None:
        if not request.changes:
            return
        if self._settings.read_only:
            raise Denied(403, "read-only", "This service was started with --read-only; nothing is changed.")
        if holder is _FOREIGN:
            raise Denied(
                403,
                "forbidden",
                "Without tokens a page from elsewhere may read only; start the service with --token-file.",
            )
        if holder is None or holder.role != "write":
            raise Denied(403, "forbidden", "This token allows to read only.")

    async def _session(
        self, request: Request, receive: Receive, answer: _Answer, holder: Holder | None
    ) -> None:
        """Begin or end the session of a browser."""
        if request.has_body or request.method == "POST":
            request.check_content()
        if request.method == "DELETE":
            if request.cookie is not None:
                self._sessions.end(request.cookie)
            await answer.respond(204, b"", [(b"set-cookie", _set_cookie(request, "", 0))])
            return
        with self._bodies.hold(_quota(request, None)) as held:
            token = _token_in(await self._body(request, receive, LONGEST_SESSION, held))
        headers = []
        if self._settings.tokens is not None:
            holder = await self._holder_of(token, request.address, self._settings.tokens)
            value = _set_cookie(request, self._sessions.begin(holder), int(SESSION_AGE))
            headers.append((b"set-cookie", value))
        assert holder is not None
        me = {"role": holder.role, "name": holder.name, "read_only": self._settings.read_only}
        await answer.respond(200, json.dumps(me).encode(), [*headers, _JSON])

    # What it brings

    async def _body(self, request: Request, receive: Receive, most: int, held: HeldBody) -> bytes:
        """All of it, before anything is done with it.

        Raises:
            Denied: it is too long, takes too long, or there are too many at once.
        """
        too_large = Denied(413, "too-large", f"A body of this request has at most {most} bytes.")
        if request.length is not None and request.length > most:
            raise too_large
        body = bytearray()
        try:
            with anyio.fail_after(BODY_PATIENCE):
                is_whole = False
                while not is_whole:
                    message = await receive()
                    if message["type"] == "http.disconnect":
                        raise Denied(400, "bad-request", "The body ends before its end.")
                    piece = message.get("body", b"")
                    body += piece
                    held.add(len(piece))
                    if len(body) > most:
                        raise too_large
                    is_whole = not message.get("more_body", False)
        except TimeoutError:
            raise Denied(408, "too-slow", f"The body has not come within {BODY_PATIENCE:.0f} s.") from None
        return bytes(body)


def may_write(request: Any) -> bool:
    """Whether a request may change something, where its address alone does not tell whether it does.

    Takes anything with the `scope` of a request.
    """
    state = request.scope["state"]
    return state["role"] == "write" and not state["read_only"]


@dataclass(slots=True)
class _Answer:
    """What goes back, with the headers that every answer has."""

    request: Request
    original: Send
    origin: str | None = None
    varies: bool = False

    async def send(self, message: Message) -> None:
        """Send a message of the application. A large body goes in parts, as far as the client takes them."""
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            message = {**message, "headers": self._headers(message.get("headers", ()))}
        elif message["type"] == "http.response.body" and not message.get("more_body", False):
            whole = memoryview(message.get("body", b""))
            while len(whole) > SENT_AT_ONCE:
                part, whole = bytes(whole[:SENT_AT_ONCE]), whole[SENT_AT_ONCE:]
                await self.original({**message, "body": part, "more_body": True})
            message = {**message, "body": bytes(whole)}
        await self.original(message)

    async def respond(self, status: int, body: bytes, headers: Iterable[tuple[bytes, bytes]]) -> None:
        """Send an answer of our own."""
        kind = "websocket.http" if self.request.scope["type"] == "websocket" else "http"
        given = [*headers, (b"content-length", str(len(body)).encode())] if status != 204 else list(headers)
        await self.send({"type": f"{kind}.response.start", "status": status, "headers": given})
        await self.original({"type": f"{kind}.response.body", "body": body})

    async def preflight(self) -> None:
        """Tell a browser what a page that is named may ask."""
        headers = [
            (b"access-control-allow-methods", ALLOWED_METHODS.encode()),
            (b"access-control-allow-headers", ALLOWED_HEADERS.encode()),
            (b"access-control-max-age", str(PREFLIGHT_AGE).encode()),
            (b"vary", b"Access-Control-Request-Method, Access-Control-Request-Headers"),
        ]
        await self.respond(204, b"", headers)

    async def refuse(self, denied: Denied, receive: Receive) -> None:
        """Say why not. Where it is not certain where the next request begins, the connection ends."""
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
        if self.request.says_body or denied.status in _MISSHAPEN:
            headers.append((b"connection", b"close"))
        await self.respond(denied.status, json.dumps(problem).encode(), headers)

    def _headers(self, given: Iterable[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
        is_page = self.request.is_page
        ours = [*_ALWAYS, (b"content-security-policy", (PAGE_POLICY if is_page else API_POLICY).encode())]
        if not is_page:
            ours.append((b"cache-control", b"no-store"))
        if self.origin is not None:
            ours.append((b"access-control-allow-origin", self.origin.encode("latin-1")))
            ours.append((b"access-control-expose-headers", SHOWN_HEADERS.encode()))
        if self.varies:
            ours.append((b"vary", b"Origin"))
        names = {name for name, _ in ours} - {b"vary"}
        kept = [(name, value) for name, value in given if name.lower() not in names]
        if is_page and not any(name.lower() == b"cache-control" for name, _ in kept):
            ours.append((b"cache-control", b"no-cache"))
        return [*kept, *ours]


def _asker(request: Request, holder: Holder | None) -> str:
    """Who asks, for the history: `anna@10.0.0.2 (what the client says it is)`."""
    who = "local" if holder is None else f"{holder.name}@{request.address}"
    given = request.header(b"x-asker")
    if given is None:
        return who
    client = given.decode("latin-1")
    if not 1 <= len(client) <= LONGEST_CLIENT or not (client.isascii() and client.isprintable()):
        raise Denied(400, "bad-request", f"X-Asker has 1 to {LONGEST_CLIENT} printable ASCII characters.")
    return f"{who} ({client})"[:ASKER_LENGTH_MAX]


def _quota(request: Request, holder: Holder | None) -> str:
    """Who has a share of what is there for all: the holder of a token, or without tokens the address."""
    return f"the address {request.network}" if holder is None else f"the token {holder.name}"


def _after(body: bytes, receive: Receive) -> Receive:
    """What gives a whole body first, and then whatever comes."""
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


def _token_in(body: bytes) -> bytes:
    """The token in the body that begins a session."""
    try:
        document = json.loads(body)
    except (ValueError, RecursionError):
        document = None
    if isinstance(document, Mapping) and list(document) == ["token"] and isinstance(document["token"], str):
        return document["token"].encode("utf-8", "surrogatepass")
    raise Denied(422, "invalid-request", 'A session begins with {"token": TOKEN}.')


def _host_name(text: str) -> str:
    name = text.strip("[]").lower().removesuffix(".")
    with suppress(ValueError):
        return str(ip_address(name))
    found = HOST.fullmatch(name)
    if found is None or found["port"] is not None:
        raise UsageError(f"{text!r:.100} is no name of a host, such as companion.local")
    return name


def _origin(text: str) -> str:
    scheme, separator, host = text.lower().partition("://")
    if scheme not in ("http", "https") or not separator or not HOST.fullmatch(host):
        raise UsageError(f"{text!r:.100} is no origin of pages, such as https://station.example:8443")
    return f"{scheme}://{host}"


def _is_only_here(listen: str) -> bool:
    """Whether only this machine can connect there. Of another name than localhost nothing is known."""
    return listen.lower() == "localhost" or is_loopback(listen.strip("[]"))


_LOOPBACK_NAMES: Final = frozenset({"localhost"})
_LOCAL: Final = Holder("local", "write")
_FOREIGN: Final = Holder("local", "read")
"""A page from elsewhere, where there are no tokens: it is in a browser of somebody on this computer."""
_SECRET: Final = frozenset({b"authorization", b"cookie"})
_MISSHAPEN: Final = (400, 414, 431)
_JSON: Final = (b"content-type", b"application/json")
_ALWAYS: Final = [
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
]
