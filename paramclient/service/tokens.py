"""Access tokens of the service: the token file, and the holder of a token."""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

from paramclient.client.signing import read_private
from paramclient.errors import UsageError

__all__ = ["Role", "TokenHolder", "Tokens", "add_token"]

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
