"""A request as those see it who decide whether it is let in, and why it is not."""

from __future__ import annotations

import re
from collections.abc import Iterable, MutableMapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias
from urllib.parse import unquote

from paramclient.service.client_address import Network, first_beyond, forwarded_for, is_in, network_of, parsed

__all__ = [
    "ASK",
    "HOST",
    "LARGEST_DESCRIPTION",
    "LARGEST_UPLOAD",
    "SESSION_PATH",
    "Denied",
    "Request",
    "Scope",
]

Scope: TypeAlias = MutableMapping[str, Any]

MOST_HEADERS: Final = 64
LONGEST_HEADERS: Final = 16 * 1024
"""How many headers a request has, and how long they are together. Browsers send about 15 with 1 kB."""
LONGEST_TARGET: Final = 8 * 1024
"""Bytes of path and query."""
LONGEST_BODY: Final = 64 * 1024
"""Bytes of a body that has neither values nor a file in it."""
LONGEST_VALUES: Final = 3 * 1024 * 1024
"""Bytes of a body with values, or with files in JSON: the largest file in base64, and what stands beside."""
LARGEST_UPLOAD: Final = 2 * 1024 * 1024
"""Bytes of a parameter file that somebody sends: ten thousand parameters in the longest of the forms. To read
more takes more than a few seconds, in which everybody else has half of the processor."""
LARGEST_DESCRIPTION: Final = 8 * 1024 * 1024
"""Bytes of a file that describes parameters: ArduPilot's for one vehicle has half of that."""

SESSION_PATH: Final = "/api/v1/session"
READ_BY_POST: Final = frozenset(
    {"diff", "fetch", "files", "find", "metadata", "plan", "read", "refreshed", "successor", "verify"}
)
"""What asks by POST and changes nothing, by the last part of its path. All other methods than GET, and all
other POSTs, need a token that may write: what is forgotten here is forbidden."""
HOST: Final = re.compile(r"(?P<name>\[[0-9A-Fa-f:.]{2,45}\]|[A-Za-z0-9._-]{1,253})(?::(?P<port>[0-9]{1,5}))?")
"""A name or an address, and a port."""
ONCE: Final = (
    *(b"host", b"origin", b"authorization", b"content-type", b"content-length", b"transfer-encoding"),
    *(b"sec-fetch-site", b"sec-fetch-mode", b"sec-fetch-dest", b"x-asker"),
)
"""Headers that decide something: of two, what is behind here might take the other one."""
LONG_BODIES: Final = {
    ("POST", "apply"): LONGEST_VALUES,
    ("POST", "diff"): LONGEST_VALUES,
    ("POST", "plan"): LONGEST_VALUES,
    ("POST", "verify"): LONGEST_VALUES,
    ("PATCH", "params"): LONGEST_VALUES,
    ("POST", "files"): LARGEST_UPLOAD,
    ("PUT", "metadata"): LARGEST_DESCRIPTION,
}
"""Bytes of the bodies with values and files, by method and the last part of the path."""
_LARGE_READS: Final = frozenset(
    {
        *("components", "file", "history", "jobs", "metadata", "metrics", "openapi.json", "params"),
        *("snapshots", "state", "vehicles"),
    }
)
LARGE_ANSWERS: Final = {
    "GET": _LARGE_READS,
    "HEAD": _LARGE_READS,
    "POST": frozenset({"diff", "files", "metadata", "plan", "verify"}),
}
"""What may be answered with megabytes, by method and the last part of the path or the one before a name."""
ASK: Final = [(b"www-authenticate", b'Bearer realm="paramclient"')]
"""What goes with 401."""


class Denied(Exception):
    """A request that goes no further."""

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
    """What is looked at of a request, read in one way only.

    Attributes:
        scope: that of ASGI.
        proxies: those whose word is taken for whom they forward.
        address: where it comes from; "here" where there is no address.
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
        """The value of a header that comes once at most.

        Raises:
            Denied: it comes more than once.
        """
        values = [value for key, value in self.headers if key == name]
        if len(values) > 1:
            raise Denied(400, "bad-request", f"{name.decode('latin-1')} comes more than once.")
        return values[0] if values else None

    def check_shape(self) -> None:
        """See that it is short, and means one thing to everyone who reads it."""
        for name in ONCE:
            self.header(name)
        if len(self.headers) > MOST_HEADERS or sum(map(_length, self.headers)) > LONGEST_HEADERS:
            raise Denied(431, "headers-too-large", "The headers are too many or too long.")
        raw = self.scope.get("raw_path") or self.path.encode()
        if len(raw) + len(self.scope.get("query_string", b"")) > LONGEST_TARGET:
            raise Denied(414, "address-too-long", "The address is too long.")
        # a slash that is written %2F belongs to a name, as to that of a serial port
        parts = [unquote(part) for part in raw.decode("ascii", "replace").split("/")]
        is_plain = (
            raw.startswith(b"/")
            and "" not in parts[1:-1]
            and not any(part in (".", "..") for part in parts)
            and not _UNPRINTABLE.search(self.path)
        )
        if not is_plain:
            raise Denied(400, "bad-path", "This is no path: it is not in its plain form.")
        if self.header(b"transfer-encoding") is not None and self.header(b"content-length") is not None:
            raise Denied(400, "bad-request", "A body has a length or is sent in chunks, not both.")

    @property
    def says_body(self) -> bool:
        """Whether anything in it says that a body follows, right or wrong."""
        return any(name in (b"content-length", b"transfer-encoding") for name, _ in self.headers)

    @property
    def length(self) -> int | None:
        """How long it says that its body is."""
        length = self.header(b"content-length")
        if length is None:
            return None
        if not length.isdigit() or len(length) > 18:
            raise Denied(400, "bad-request", "Content-Length is no number.")
        return int(length)

    @property
    def has_body(self) -> bool:
        return bool(self.length) or self.header(b"transfer-encoding") is not None

    @property
    def longest_body(self) -> int:
        """Bytes that its body may have."""
        return LONG_BODIES.get((self.method, self.path.rpartition("/")[2]), LONGEST_BODY)

    def check_content(self) -> None:
        """See that it may have a body, of a kind that no page elsewhere can send without asking first."""
        if self.method not in ("POST", "PUT", "PATCH"):
            raise Denied(400, "bad-request", f"{self.method:.10} has no body.")
        given = (self.header(b"content-type") or b"").split(b";")[0].strip().lower()
        if given not in (b"application/json", b"application/octet-stream"):
            raise Denied(
                415, "content-type", "A body is application/json, or application/octet-stream for a file."
            )

    @property
    def _host(self) -> re.Match[str]:
        given = self.header(b"host")
        found = HOST.fullmatch("" if given is None else given.decode("latin-1"))
        if found is None:
            raise Denied(400, "bad-request", "Host names no host.")
        return found

    @property
    def host_name(self) -> str:
        """The name or address by which the service was called."""
        return self._host["name"].strip("[]").lower().removesuffix(".")

    @property
    def own_origin(self) -> str:
        """The origin of a page that comes from here."""
        return f"{'https' if self.is_secure else 'http'}://{self._host[0].lower()}"

    @property
    def origin(self) -> str | None:
        """The origin of the page that asks, if one does."""
        origin = self.header(b"origin")
        return None if origin is None else origin.decode("latin-1").lower()

    @property
    def is_secure(self) -> bool:
        return self.scope.get("scheme") in ("https", "wss")

    @property
    def is_preflight(self) -> bool:
        """Whether a browser asks what a page may ask."""
        asked = self.header(b"access-control-request-method")
        return self.method == "OPTIONS" and self.origin is not None and asked is not None

    @property
    def is_public(self) -> bool:
        """Whether it needs no token: the page that asks for one, and whether anybody is there."""
        if self.path == SESSION_PATH:
            return self.method in ("POST", "DELETE")
        is_page = self.path in ("/", "/health", "/favicon.ico") or self.path.startswith("/page/")
        return self.scope["type"] == "http" and self.method in ("GET", "HEAD") and is_page

    @property
    def is_page(self) -> bool:
        return self.path in ("/", "/docs") or self.path.startswith(("/page/", "/docs/"))

    @property
    def changes(self) -> bool:
        """Whether it may change something."""
        if self.scope["type"] == "websocket" or self.method in ("GET", "HEAD", "OPTIONS"):
            return False
        if self.method == "DELETE" and self.path.startswith("/api/v1/jobs/"):
            return False  # whoever may begin a download may end it; of other jobs the route asks
        return self.method != "POST" or self.path.rpartition("/")[2] not in READ_BY_POST

    @property
    def has_large_answer(self) -> bool:
        """Whether its answer may have megabytes."""
        *_, before, last = ("", "", *self.path.split("/"))
        names = LARGE_ANSWERS.get(self.method, frozenset())
        return self.scope["type"] == "http" and (last in names or before in {"jobs", "snapshots"} & names)

    @property
    def token(self) -> bytes | None:
        """The token that it shows."""
        given = self.header(b"authorization")
        if given is None:
            return None
        scheme, _, token = given.partition(b" ")
        if scheme.lower() != b"bearer" or not token.strip():
            raise Denied(401, "unauthenticated", "A token is shown as `Authorization: Bearer TOKEN`.", ASK)
        return token.strip()

    @property
    def cookie_name(self) -> str:
        """Cookies of one machine are the same for all ports: each service has a name of its own."""
        port = (self.scope.get("server") or ("", 0))[1]
        return f"paramclient-{port or 0}"

    @property
    def cookie(self) -> bytes | None:
        """The session that it shows."""
        name = self.cookie_name.encode()
        for pair in b";".join(value for key, value in self.headers if key == b"cookie").split(b";"):
            key, _, value = pair.strip().partition(b"=")
            if key == name:
                return value
        return None

    def take_forwarded(self) -> None:
        """Where a trusted proxy has sent it, take the address from what that says.

        Raises:
            Denied: X-Forwarded-For and Forwarded name different clients; one of them is not the proxy's.
        """
        if not is_in(self._peer, self.proxies):
            return
        clients = {
            first_beyond(self.proxies, self._peer, forwarded_for(values))
            for name in (b"x-forwarded-for", b"forwarded")
            if (values := [value.decode("latin-1") for key, value in self.headers if key == name])
        }
        if len(clients) > 1:
            raise Denied(400, "bad-request", "X-Forwarded-For and Forwarded name different clients.")
        self.address = next(iter(clients), self._peer)

    @property
    def network(self) -> str:
        """The address, or the network of an IPv6 one: a machine has 2⁶⁴ of these."""
        return network_of(self.address)

    @property
    def _peer(self) -> str:
        client = self.scope.get("client")
        address = parsed(str(client[0])) if client else None
        return "here" if address is None else str(address)


def _length(header: tuple[bytes, bytes]) -> int:
    return len(header[0]) + len(header[1])


_UNPRINTABLE: Final = re.compile(r"[\x00-\x1f\x7f\\\ufffd]")
