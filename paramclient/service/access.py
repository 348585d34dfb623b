"""Access tokens, and the checks of each request: its token and role, and the page that it comes from.

Tokens come in the header Authorization only. There are no cookies, so a page of another site has no authority
to use. Without tokens, every program of this computer may write; pages of other sites must not, and are
recognized by the header Origin, which browsers send with every write.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

import anyio
from fastapi import Request
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from paramclient.client.signing import read_private
from paramclient.errors import UsageError
from paramclient.service.problems import ServiceError, problem_response

__all__ = ["AccessMiddleware", "Tokens", "add_token", "author_of", "cancel_on_disconnect", "require_write"]

# tokens


Role: TypeAlias = Literal["read", "write"]
"""Permission of a token: read, or read and write."""

TOKEN_BYTES: Final = 32
"""Number of random bytes of a token: it cannot be guessed, so wrong tokens need no delay."""
TOKEN_FILE_BYTES_MAX: Final = 100_000
"""Maximum size of a token file in bytes."""
_LINE: Final = re.compile(r"([A-Za-z0-9._-]{1,32})\s+(read|write)\s+sha256:([0-9a-f]{64})")


@dataclass(frozen=True, slots=True)
class TokenHolder:
    """Holder of a token.

    Attributes:
        name: its name in the history.
        role: permission of the token.
    """

    name: str
    role: Role


@dataclass(frozen=True, slots=True)
class Tokens:
    """The valid tokens, by the SHA-256 of each: the time of a look-up tells nothing of a token."""

    holders: Mapping[bytes, TokenHolder]

    def holder(self, token: str) -> TokenHolder | None:
        """Return the holder of a token, or None."""
        return self.holders.get(_digest(token))

    @classmethod
    def of_text(cls, text: str) -> Tokens:
        """Parse lines of `NAME ROLE sha256:DIGEST`; `#` starts a comment.

        Raises:
            UsageError: a line is invalid, two have the same name or token, or there is none. The message
                contains no part of a line.
        """
        holders: dict[bytes, TokenHolder] = {}
        for number, line in enumerate(text.splitlines(), 1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            found = _LINE.fullmatch(line.strip())
            if found is None:
                raise UsageError(
                    f"line {number} is not NAME read|write sha256:DIGEST; use `paramclient token`"
                )
            holder = TokenHolder(found[1], "write" if found[2] == "write" else "read")
            digest = bytes.fromhex(found[3])
            if digest in holders or holder.name in {each.name for each in holders.values()}:
                raise UsageError(f"line {number} repeats a name or a token")
            holders[digest] = holder
        if not holders:
            raise UsageError("the file has no token; create one with `paramclient token`")
        return cls(holders)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Tokens:
        """Read a token file, which only its owner may access.

        Raises:
            UsageError: the file cannot be read, other users can access it, or it is invalid.
        """
        try:
            return cls.of_text(_read(path))
        except UsageError as error:
            raise UsageError(f"{os.fspath(path)}: {error}") from None


def add_token(path: str | os.PathLike[str], name: str, role: Role) -> str:
    """Create a token, append the line with its digest to a file, and return it. A new file has the mode 0600.

    Raises:
        UsageError: the file cannot be written, is accessible by other users, is not a token file, or contains
            the name; or the name is not valid.
    """
    token = secrets.token_urlsafe(TOKEN_BYTES)
    line = f"{name} {role} sha256:{_digest(token).hex()}\n"
    if _LINE.fullmatch(line.strip()) is None:
        raise UsageError("a name must have 1 to 32 letters, digits, dots, hyphens and underscores")
    try:
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0), 0o600))
        before = _read(path)
        gap = "" if before.endswith("\n") or not before else "\n"
        Tokens.of_text(f"{before}{gap}{line}")
        with Path(path).open("a", encoding="ascii") as file:
            file.write(gap + line)
    except UsageError as error:
        raise UsageError(f"{os.fspath(path)}: {error}") from None
    except OSError as error:
        raise UsageError(f"{os.fspath(path)}: the token cannot be written: {error.strerror}") from error
    return token


def _read(path: str | os.PathLike[str]) -> str:
    data = read_private(path, "file of tokens", TOKEN_FILE_BYTES_MAX + 1)
    if len(data) > TOKEN_FILE_BYTES_MAX:
        raise UsageError(f"a file of tokens may have at most {TOKEN_FILE_BYTES_MAX} bytes")
    return data.decode("utf-8", "replace")


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()


# requests


PROTECTED: Final = ("/api/", "/metrics")
"""Begin of the paths that require a token. The others are the page, its description, and `/health`."""
SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})
LOCAL: Final = TokenHolder("local", "write")
"""The holder of all requests to a service without tokens."""
RESPONSE_HEADERS: Final = {
    "cache-control": "no-store",
    "content-security-policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}
"""Headers of all responses: the page loads nothing from other sites, and no other page can frame it."""
_PAGE_NAME: Final = re.compile(r"[A-Za-z0-9._ -]{1,64}")


class AccessMiddleware:
    """Finds the holder of the token of a request. Rejects requests without a valid one, and writes of other
    sites, before their body is received.

    Args:
        app: the application.
        tokens: the valid tokens; None lets every request read and write.
    """

    def __init__(self, app: ASGIApp, tokens: Tokens | None) -> None:
        self._app = app
        self._tokens = tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in RESPONSE_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        try:
            headers = Headers(scope=scope)
            if scope["method"] not in SAFE_METHODS:
                _check_origin(headers)
            holder = self._holder(headers)
            if holder is None and scope["path"].startswith(PROTECTED):
                detail = "This service requires a token in the header Authorization: Bearer TOKEN."
                raise ServiceError(401, "unauthorized", detail)
            scope.setdefault("state", {})["holder"] = holder
        except ServiceError as error:
            await problem_response(error)(scope, receive, send_with_headers)
            return
        await self._app(scope, receive, send_with_headers)

    def _holder(self, headers: Headers) -> TokenHolder | None:
        """Return the holder of the token of a request; None without a token.

        Raises:
            ServiceError: 401, the token is wrong.
        """
        if self._tokens is None:
            return LOCAL
        given = headers.get("authorization")
        if given is None:
            return None
        scheme, _, token = given.partition(" ")
        holder = self._tokens.holder(token.strip()) if scheme.lower() == "bearer" else None
        if holder is None:
            raise ServiceError(401, "unauthorized", "The token is not valid for this service.")
        return holder


def _check_origin(headers: Headers) -> None:
    """Check that a request that may change something is not from a page of another site.

    Raises:
        ServiceError: 403, it is.
    """
    origin = headers.get("origin")
    if origin is not None and origin.partition("://")[2] != headers.get("host"):
        raise ServiceError(403, "other-origin", f"Pages of {origin[:200]} may not change anything here.")


def cancel_on_disconnect(app: ASGIApp) -> ASGIApp:
    """Return an application whose work for a request is cancelled when the client disconnects."""

    async def cancellable(scope: Scope, receive: Receive, send: Send) -> None:
        pieces, inbox = anyio.create_memory_object_stream[Message](1)

        async def watch() -> None:
            while (message := await receive())["type"] != "http.disconnect":
                await pieces.send(message)
            tasks.cancel_scope.cancel()

        with pieces, inbox:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(watch)
                await app(scope, inbox.receive, send)
                tasks.cancel_scope.cancel()

    return cancellable


async def author_of(request: Request) -> str:
    """Return the author of the changes of a request: the name of the token, and that in X-Author, if any."""
    name: str = request.state.holder.name
    page = request.headers.get("x-author", "")
    return f"{name} ({page})" if _PAGE_NAME.fullmatch(page) else name


async def require_write(request: Request) -> None:
    """Reject a request with a token that may not write.

    Raises:
        ServiceError: 403, it may not.
    """
    if request.state.holder.role != "write":
        raise ServiceError(403, "forbidden", "This request requires a token that may write.")
