"""Parsed requests for the access checks, and their rejection."""

from __future__ import annotations

import re
from collections.abc import Iterable, MutableMapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias
from urllib.parse import unquote

from paramclient.service.body_limits import BODY_BYTES_MAX_BY_PATH, PLAIN_BODY_BYTES_MAX
from paramclient.service.client_address import (
    Network,
    client_behind,
    client_network,
    is_in_networks,
    parse_address,
    parse_forwarded,
)

__all__ = [
    "BEARER_CHALLENGE",
    "HOST_PATTERN",
    "SESSION_PATH",
    "RequestDenied",
    "Request",
    "Scope",
]

Scope: TypeAlias = MutableMapping[str, Any]

HEADERS_MAX: Final = 64
"""Maximum number of headers of a request. Browsers send about 15."""
HEADER_BYTES_MAX: Final = 16 * 1024
"""Maximum size of all headers of a request in bytes. Browsers send about 1 kB."""
TARGET_BYTES_MAX: Final = 8 * 1024
"""Maximum size of path and query in bytes."""

SESSION_PATH: Final = "/api/v1/session"
"""Path of the sessions of browsers."""
READING_POSTS: Final = frozenset(
    {
        *("diff", "fetch", "files", "find", "metadata", "plan", "read", "refreshed", "state", "successor"),
        "verify",
    }
)
"""Last part of the paths whose POST changes nothing. All other POST requests, and methods other than GET,
require write permission, so that a forgotten path is rejected."""
HOST_PATTERN: Final = re.compile(
    r"(?P<name>\[[0-9A-Fa-f:.]{2,45}\]|[A-Za-z0-9._-]{1,253})(?::(?P<port>[0-9]{1,5}))?"
)
"""A host name or an address, with an optional port."""
UNIQUE_HEADERS: Final = (
    *(b"host", b"origin", b"authorization", b"content-type", b"content-length", b"transfer-encoding"),
    *(b"sec-fetch-site", b"sec-fetch-mode", b"sec-fetch-dest", b"x-author"),
)
"""Headers that must not be repeated: the application could use another value than the access checks."""
_LARGE_GETS: Final = frozenset(
    {
        *("components", "file", "history", "jobs", "metadata", "metrics", "openapi.json", "params"),
        *("snapshots", "state", "vehicles"),
    }
)
LARGE_RESPONSES: Final = {
    "GET": _LARGE_GETS,
    "HEAD": _LARGE_GETS,
    "POST": frozenset({"diff", "files", "metadata", "plan", "state", "verify"}),
}
"""Paths whose responses can have megabytes, by method: the last part of the path, or the one before an id."""
BEARER_CHALLENGE: Final = [(b"www-authenticate", b'Bearer realm="paramclient"')]
"""Header of a response with status 401."""


class RequestDenied(Exception):
    """The access checks reject a request.

    Attributes:
        status: HTTP status code.
        kind: name of the problem, for programs.
        detail: text for users.
        headers: additional response headers.
    """

    def __init__(
        self, status: int, kind: str, detail: str, headers: Iterable[tuple[bytes, bytes]] = ()
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.kind = kind
        self.detail = detail
        self.headers = list(headers)


@dataclass(slots=True)
class Request:
    """A request as the access checks see it. Each header has one interpretation.

    Attributes:
        scope: ASGI scope.
        proxies: trusted proxies.
        headers: names in lower case, and values.
        method: HTTP method; GET for a WebSocket.
        path: decoded path.
        address: address of the client; "here" if there is none.
    """

    scope: Scope
    proxies: Sequence[Network] = ()
    headers: list[tuple[bytes, bytes]] = field(init=False)
    method: str = field(init=False)
    path: str = field(init=False)
    address: str = field(init=False)

    def __post_init__(self) -> None:
        self.headers = [(bytes(name).lower(), bytes(value)) for name, value in self.scope["headers"]]
        self.method = self.scope.get("method", "GET")
        self.path = self.scope["path"]
        self.address = self._peer

    def header(self, name: bytes) -> bytes | None:
        """Return the value of a header, or None.

        Raises:
            RequestDenied: the header is repeated.
        """
        values = [value for key, value in self.headers if key == name]
        if len(values) > 1:
            raise RequestDenied(400, "bad-request", f"The header {name.decode('latin-1')} is repeated.")
        return values[0] if values else None

    def check_format(self) -> None:
        """Check sizes and the format of headers and path.

        Raises:
            RequestDenied: a limit is exceeded, or the request is ambiguous.
        """
        for name in UNIQUE_HEADERS:
            self.header(name)
        if len(self.headers) > HEADERS_MAX or sum(map(_length, self.headers)) > HEADER_BYTES_MAX:
            raise RequestDenied(
                431,
                "headers-too-large",
                f"A request may have {HEADERS_MAX} headers and {HEADER_BYTES_MAX} bytes of headers.",
            )
        raw = self.scope.get("raw_path") or self.path.encode()
        if len(raw) + len(self.scope.get("query_string", b"")) > TARGET_BYTES_MAX:
            raise RequestDenied(414, "address-too-long", f"Path and query may have {TARGET_BYTES_MAX} bytes.")
        # %2F is a slash within a name, such as that of a serial port
        parts = [unquote(part) for part in raw.decode("ascii", "replace").split("/")]
        is_plain = (
            raw.startswith(b"/")
            and "" not in parts[1:-1]
            and not any(part in (".", "..") for part in parts)
            and not _UNPRINTABLE.search(self.path)
        )
        if not is_plain:
            raise RequestDenied(
                400, "bad-path", "The path is not in normal form: it has empty, dot or unprintable parts."
            )
        if self.header(b"transfer-encoding") is not None and self.header(b"content-length") is not None:
            raise RequestDenied(
                400, "bad-request", "Content-Length and Transfer-Encoding exclude each other."
            )

    @property
    def announces_body(self) -> bool:
        """Return whether a header announces a body, valid or not."""
        return any(name in (b"content-length", b"transfer-encoding") for name, _ in self.headers)

    @property
    def length(self) -> int | None:
        """Return the value of Content-Length, or None.

        Raises:
            RequestDenied: the value is not a number.
        """
        length = self.header(b"content-length")
        if length is None:
            return None
        if not length.isdigit() or len(length) > 18:
            raise RequestDenied(400, "bad-request", "Content-Length is not a number.")
        return int(length)

    @property
    def has_body(self) -> bool:
        """Return whether a body follows."""
        return bool(self.length) or self.header(b"transfer-encoding") is not None

    @property
    def body_bytes_max(self) -> int:
        """Return the maximum size of the body in bytes."""
        return BODY_BYTES_MAX_BY_PATH.get((self.method, self.path.rpartition("/")[2]), PLAIN_BODY_BYTES_MAX)

    def check_content_type(self) -> None:
        """Check that the method permits a body, and that a foreign page cannot send its type without a
        preflight request.

        Raises:
            RequestDenied: the method or the content type is not permitted.
        """
        if self.method not in ("POST", "PUT", "PATCH"):
            raise RequestDenied(
                400, "bad-request", f"A request with the method {self.method:.10} must not have a body."
            )
        given = (self.header(b"content-type") or b"").split(b";")[0].strip().lower()
        if given not in (b"application/json", b"application/octet-stream"):
            raise RequestDenied(
                415,
                "content-type",
                "The content type must be application/json, or application/octet-stream for a file.",
            )

    @property
    def _host(self) -> re.Match[str]:
        given = self.header(b"host")
        found = HOST_PATTERN.fullmatch("" if given is None else given.decode("latin-1"))
        if found is None:
            raise RequestDenied(400, "bad-request", "The header Host is missing or not a host name.")
        return found

    @property
    def host_name(self) -> str:
        """Return the host name or address in Host."""
        return self._host["name"].strip("[]").lower().removesuffix(".")

    @property
    def own_origin(self) -> str:
        """Return the origin of pages of this service."""
        return f"{'https' if self.is_secure else 'http'}://{self._host[0].lower()}"

    @property
    def origin(self) -> str | None:
        """Return the origin of the requesting page, or None."""
        origin = self.header(b"origin")
        return None if origin is None else origin.decode("latin-1").lower()

    @property
    def is_secure(self) -> bool:
        """Return whether the connection uses TLS."""
        return self.scope.get("scheme") in ("https", "wss")

    @property
    def is_preflight(self) -> bool:
        """Return whether the request is a CORS preflight request."""
        requested_method = self.header(b"access-control-request-method")
        return self.method == "OPTIONS" and self.origin is not None and requested_method is not None

    @property
    def is_public(self) -> bool:
        """Return whether the request needs no token: the page with its login, and the health check."""
        if self.path == SESSION_PATH:
            return self.method in ("POST", "DELETE")
        is_page = self.path in ("/", "/health", "/favicon.ico") or self.path.startswith("/page/")
        return self.scope["type"] == "http" and self.method in ("GET", "HEAD") and is_page

    @property
    def is_page(self) -> bool:
        """Return whether the path belongs to the web page or the API reference."""
        return self.path in ("/", "/docs") or self.path.startswith(("/page/", "/docs/"))

    @property
    def is_change(self) -> bool:
        """Return whether the request can change something."""
        if self.scope["type"] == "websocket" or self.method in ("GET", "HEAD", "OPTIONS"):
            return False
        if self.method == "DELETE" and self.path.startswith("/api/v1/jobs/"):
            return False  # readers may cancel fetches; the route checks other jobs
        return self.method != "POST" or self.path.rpartition("/")[2] not in READING_POSTS

    @property
    def has_large_response(self) -> bool:
        """Return whether the response can have megabytes."""
        *_, before, last = ("", "", *self.path.split("/"))
        names = LARGE_RESPONSES.get(self.method, frozenset())
        return self.scope["type"] == "http" and (last in names or before in {"jobs", "snapshots"} & names)

    @property
    def token(self) -> bytes | None:
        """Return the bearer token, or None.

        Raises:
            RequestDenied: the header Authorization has another scheme.
        """
        given = self.header(b"authorization")
        if given is None:
            return None
        scheme, _, token = given.partition(b" ")
        if scheme.lower() != b"bearer" or not token.strip():
            raise RequestDenied(
                401, "unauthenticated", "Send the token as `Authorization: Bearer TOKEN`.", BEARER_CHALLENGE
            )
        return token.strip()

    @property
    def cookie_name(self) -> str:
        """Return the name of the session cookie, which contains the port: all ports of a host share
        cookies."""
        port = (self.scope.get("server") or ("", 0))[1]
        return f"paramclient-{port or 0}"

    @property
    def cookie(self) -> bytes | None:
        """Return the value of the session cookie, or None."""
        name = self.cookie_name.encode()
        for pair in b";".join(value for key, value in self.headers if key == b"cookie").split(b";"):
            key, _, value = pair.strip().partition(b"=")
            if key == name:
                return value
        return None

    def apply_forwarded_headers(self) -> None:
        """Replace the address by that of the client behind trusted proxies.

        Raises:
            RequestDenied: X-Forwarded-For and Forwarded name different clients.
        """
        if not is_in_networks(self._peer, self.proxies):
            return
        clients = {
            client_behind(self.proxies, self._peer, parse_forwarded(values))
            for name in (b"x-forwarded-for", b"forwarded")
            if (values := [value.decode("latin-1") for key, value in self.headers if key == name])
        }
        if len(clients) > 1:
            raise RequestDenied(400, "bad-request", "X-Forwarded-For and Forwarded name different clients.")
        self.address = next(iter(clients), self._peer)

    @property
    def network(self) -> str:
        """Return the network that counts as one client: a computer has 2⁶⁴ IPv6 addresses."""
        return client_network(self.address)

    @property
    def _peer(self) -> str:
        client = self.scope.get("client")
        address = parse_address(str(client[0])) if client else None
        return "here" if address is None else str(address)


def _length(header: tuple[bytes, bytes]) -> int:
    return len(header[0]) + len(header[1])


_UNPRINTABLE: Final = re.compile(r"[\x00-\x1f\x7f\\\ufffd]")
