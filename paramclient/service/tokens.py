"""Access tokens, sessions of browsers, and the delay after wrong tokens."""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

from paramclient.client.signing import read_private
from paramclient.errors import UsageError
from paramclient.service.client_address import client_network

__all__ = [
    "WrongTokens",
    "TokenHolder",
    "Role",
    "Sessions",
    "Tokens",
    "add_token",
    "new_token",
    "token_line",
    "tokens_from",
]

Role: TypeAlias = Literal["read", "write"]
"""Permission of a token: read, or read and write."""

SERVICE_TOKEN_VARIABLE: Final = "PARAMCLIENT_SERVICE_TOKEN"
"""Environment variable with one token."""
SERVICE_TOKEN_FILE_VARIABLE: Final = "PARAMCLIENT_SERVICE_TOKEN_FILE"
"""Environment variable with the path of a token file."""
ENVIRONMENT_TOKEN_NAME: Final = "token"
"""Name of the holder of a token from `SERVICE_TOKEN_VARIABLE`."""
TOKEN_BYTES: Final = 32
"""Number of random bytes of a new token."""
TOKEN_LENGTH_MIN: Final = 16
"""Minimum number of characters of a token: a random one cannot be guessed at the permitted rate."""
TOKEN_LENGTH_MAX: Final = 256
"""Maximum number of characters of a token."""
TOKENS_MAX: Final = 256
"""Maximum number of tokens: each request is compared with all."""
TOKEN_FILE_BYTES_MAX: Final = 100_000
"""Maximum size of a token file in bytes."""
_NO_LINK: Final = getattr(os, "O_NOFOLLOW", 0)  # Windows has no such flag
DIGEST_PREFIX: Final = "sha256:"
"""Prefix of the third word of a line that contains a digest in place of a token."""

SESSION_LIFETIME: Final = 12 * 3600.0
"""Lifetime of a session in seconds: a working day."""
SESSIONS_OF_HOLDER_MAX: Final = 16
"""Maximum number of sessions of one holder. The oldest is removed first."""

WRONG_TOKENS_MAX: Final = 10
"""Different wrong tokens from one address before its tokens are delayed. A repeated token does not count: a
program with an old token must not delay the others on its computer."""
WRONG_TOKEN_DELAY: Final = 1.0
"""Delay in seconds of each token from such an address, valid or not: its at most 128 connections get as many
responses per second."""
WRONG_TOKEN_LIFETIME: Final = 60.0
"""Seconds after which a wrong token is forgotten."""
WRONG_TOKEN_ADDRESSES_MAX: Final = 1_024
"""Maximum number of remembered addresses with wrong tokens. The oldest is removed first."""


@dataclass(frozen=True, slots=True)
class TokenHolder:
    """Holder of a token.

    Attributes:
        name: its name in the history.
        role: permission of the token.
    """

    name: str
    role: Role


class Tokens:
    """The valid tokens. Only their digests are kept.

    Args:
        digests: holders and SHA-256 of their tokens.

    Raises:
        UsageError: there are none or too many, or two have the same name or token.
    """

    def __init__(self, digests: Iterable[tuple[TokenHolder, bytes]]) -> None:
        self._digests = tuple(digests)
        names = [holder.name for holder, _ in self._digests]
        if not 1 <= len(names) <= TOKENS_MAX:
            raise UsageError(f"1 to {TOKENS_MAX} tokens are permitted, not {len(names)}")
        if len(set(names)) < len(names):
            raise UsageError("two tokens have the same name; the history could not distinguish them")
        if len({digest for _, digest in self._digests}) < len(names):
            raise UsageError("two names have the same token; the history could not distinguish them")

    def holder(self, token: bytes) -> TokenHolder | None:
        """Return the holder of a token, or None, in constant time."""
        digest = _digest(token)
        found = None
        for holder, known in self._digests:
            if hmac.compare_digest(known, digest):
                found = holder
        return found

    @classmethod
    def of_text(cls, text: str) -> Tokens:
        """Parse lines of `NAME ROLE TOKEN` or `NAME ROLE sha256:DIGEST_PREFIX`; `#` starts a comment.

        Raises:
            UsageError: a line is invalid. The message never contains parts of the line.
        """
        digests = []
        for number, line in enumerate(text.splitlines(), 1):
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            try:
                digests.append(_of_line(words))
            except UsageError as error:
                raise UsageError(f"line {number}: {error}") from None
        return cls(digests)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Tokens:
        """Read a token file, which only its owner may access.

        Raises:
            UsageError: the file cannot be read, other users can access it, or it is invalid.
        """
        data = read_private(path, "file of tokens", TOKEN_FILE_BYTES_MAX + 1)
        try:
            if len(data) > TOKEN_FILE_BYTES_MAX:
                raise UsageError(f"a file of tokens may have at most {TOKEN_FILE_BYTES_MAX} bytes")
            return cls.of_text(data.decode("utf-8", "replace"))
        except UsageError as error:
            raise UsageError(f"{os.fspath(path)}: {error}") from None

    def __len__(self) -> int:
        return len(self._digests)

    def __repr__(self) -> str:
        return f"<Tokens of {', '.join(holder.name for holder, _ in self._digests)}>"


def tokens_from(
    path: str | os.PathLike[str] | None = None, environment: Mapping[str, str] = os.environ
) -> Tokens | None:
    """Return the tokens of a file, or those of the environment, or None.

    Args:
        path: the token file; None for the environment.
        environment: `PARAMCLIENT_SERVICE_TOKEN_FILE` is the path of a token file,
            `PARAMCLIENT_SERVICE_TOKEN` a token with write permission.

    Raises:
        UsageError: both variables are set, or the tokens are invalid.
    """
    if path is not None:
        return Tokens.read(path)
    given = [name for name in (SERVICE_TOKEN_FILE_VARIABLE, SERVICE_TOKEN_VARIABLE) if environment.get(name)]
    if not given:
        return None
    if len(given) > 1:
        raise UsageError(f"{' and '.join(given)} are set; one of them is enough")
    value = environment[given[0]]
    try:
        if given[0] == SERVICE_TOKEN_FILE_VARIABLE:
            return Tokens.read(value)
        return Tokens([_of_line([ENVIRONMENT_TOKEN_NAME, "write", value])])
    except UsageError as error:
        raise UsageError(f"{given[0]}: {error}") from None


def new_token() -> str:
    """Return a new random token."""
    return secrets.token_urlsafe(TOKEN_BYTES)


def token_line(name: str, role: str, token: str) -> str:
    """Return the line of a token file, with the digest of the token.

    Raises:
        UsageError: the name, role or token is invalid.
    """
    holder, digest = _of_line([name, role, token])
    return f"{holder.name} {holder.role} {DIGEST_PREFIX}{digest.hex()}"


def add_token(path: str | os.PathLike[str], name: str, role: Role) -> str:
    """Create a token and append its line to a file. A new file is accessible only by its owner.

    Raises:
        UsageError: the file cannot be written, is a symbolic link, belongs to another user, is accessible by
            other users, is not a token file, or contains the name.
    """
    token = new_token()
    line = token_line(name, role, token)
    try:
        if Path(path).is_symlink():
            raise UsageError(f"{os.fspath(path)}: the file is a symbolic link; give the path of its target")
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | _NO_LINK, 0o600))
        before = read_private(path, "file of tokens", TOKEN_FILE_BYTES_MAX + 1).decode("utf-8", "replace")
        gap = "" if before.endswith("\n") or not before else "\n"
        try:
            Tokens.of_text(f"{before}{gap}{line}")
        except UsageError as error:
            raise UsageError(f"{os.fspath(path)}: {error}") from None
        with Path(path).open("a", encoding="ascii") as file:
            file.write(f"{gap}{line}\n")
    except OSError as error:
        raise UsageError(f"{os.fspath(path)}: the token cannot be written: {error.strerror}") from error
    return token


class Sessions:
    """Sessions of browsers, by the digest of their cookies.

    Args:
        clock: returns monotonic time in seconds.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._open: dict[bytes, tuple[TokenHolder, float]] = {}

    def begin(self, holder: TokenHolder) -> str:
        """Start a session. Return the value of its cookie, which is not kept."""
        now = self._clock()
        self._open = {key: each for key, each in self._open.items() if each[1] > now}
        own = [key for key, (whose, _) in self._open.items() if whose == holder]
        for key in own[: max(0, len(own) + 1 - SESSIONS_OF_HOLDER_MAX)]:
            del self._open[key]
        text = new_token()
        self._open[_digest(text.encode())] = (holder, now + SESSION_LIFETIME)
        return text

    def holder(self, text: bytes) -> TokenHolder | None:
        """Return the holder of a session, or None if it is unknown or expired."""
        holder, until = self._open.get(_digest(text), (None, 0.0))
        return holder if until > self._clock() else None

    def end(self, text: bytes) -> None:
        """End a session."""
        self._open.pop(_digest(text), None)

    def __len__(self) -> int:
        return len(self._open)


class WrongTokens:
    """Recent wrong tokens by address.

    Args:
        clock: returns monotonic time in seconds.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._key = secrets.token_bytes(16)
        self._wrong: OrderedDict[str, dict[bytes, float]] = OrderedDict()

    def wait(self, address: str) -> float:
        """Return the seconds for which tokens from this address are delayed; 0 if they are not."""
        wrong = self._wrong.get(client_network(address))
        if wrong is None or len(wrong) < WRONG_TOKENS_MAX:
            return 0.0
        return max(0.0, next(iter(wrong.values())) + WRONG_TOKEN_LIFETIME - self._clock())

    def add(self, address: str, token: bytes) -> bool:
        """Count a wrong token. Return whether tokens from this address are delayed from now on."""
        now = self._clock()
        network = client_network(address)
        wrong = {
            key: at for key, at in self._wrong.pop(network, {}).items() if now - at < WRONG_TOKEN_LIFETIME
        }
        key = hmac.digest(self._key, token, "sha256")[:8]
        is_new = key not in wrong
        if len(wrong) < WRONG_TOKENS_MAX:
            wrong.setdefault(key, now)
        self._wrong[network] = wrong
        while len(self._wrong) > WRONG_TOKEN_ADDRESSES_MAX:
            self._wrong.popitem(last=False)
        return is_new and len(wrong) == WRONG_TOKENS_MAX

    def __len__(self) -> int:
        return len(self._wrong)


def _of_line(words: list[str]) -> tuple[TokenHolder, bytes]:
    """Parse the words of a line. Errors contain no word: any of them could be the token.

    Raises:
        UsageError: the line is invalid.
    """
    if len(words) != 3:
        raise UsageError("a line must have three words: NAME, read or write, and TOKEN")
    name, role, token = words
    if not _NAME.fullmatch(name):
        raise UsageError("a name must have 1 to 32 letters, digits, dots, hyphens and underscores")
    if role == "read":
        holder = TokenHolder(name, "read")
    elif role == "write":
        holder = TokenHolder(name, "write")
    else:
        raise UsageError("the second word is the permission: read or write")
    if token.startswith(DIGEST_PREFIX):
        digits = token.removeprefix(DIGEST_PREFIX)
        if not _DIGEST.fullmatch(digits):
            raise UsageError("a digest must have 64 hexadecimal digits")
        return holder, bytes.fromhex(digits)
    is_sound = token.isascii() and token.isprintable() and " " not in token
    if not is_sound or not TOKEN_LENGTH_MIN <= len(token) <= TOKEN_LENGTH_MAX:
        raise UsageError(
            f"a token must have {TOKEN_LENGTH_MIN} to {TOKEN_LENGTH_MAX} printable ASCII characters; "
            "create one with `paramclient token`"
        )
    return holder, _digest(token.encode())


def _digest(token: bytes) -> bytes:
    return hashlib.sha256(token).digest()


_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,31}")
_DIGEST: Final = re.compile(r"[0-9a-fA-F]{64}")
