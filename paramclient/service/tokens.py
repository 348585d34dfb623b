"""Tokens: who has one, what it allows, the sessions of browsers, and those who guess."""

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
from paramclient.service.client_address import network_of

__all__ = [
    "Guesses",
    "Holder",
    "Role",
    "Sessions",
    "Tokens",
    "add_token",
    "new_token",
    "token_line",
    "tokens_from",
]

Role: TypeAlias = Literal["read", "write"]
"""What a token allows: to see everything, or to change it too."""

TOKEN_VARIABLE: Final = "PARAMCLIENT_SERVICE_TOKEN"
FILE_VARIABLE: Final = "PARAMCLIENT_SERVICE_TOKEN_FILE"
NAME_IN_ENVIRONMENT: Final = "token"
"""The name of the holder of a token that comes without one."""
TOKEN_BYTES: Final = 32
SHORTEST_TOKEN: Final = 16
"""Characters: of a token that is drawn at random it cannot be guessed, at the rate that is allowed."""
LONGEST_TOKEN: Final = 256
MOST_TOKENS: Final = 256
"""Each is compared for each request."""
LONGEST_FILE: Final = 100_000
_NO_LINK: Final = getattr(os, "O_NOFOLLOW", 0)  # Windows has no such flag
DIGEST: Final = "sha256:"
"""How a line begins its third word that has not the token but its digest."""

SESSION_AGE: Final = 12 * 3600.0
"""Seconds for which a browser is known: a day in the field."""
MOST_SESSIONS: Final = 16
"""Sessions of one holder: a laptop, a phone, and what was not ended. The oldest goes first."""

GUESSES: Final = 10
"""Different wrong tokens from one address before its tokens are looked at late. The same one again is no
guess: a program that was not told of a change must not slow down the others on its machine."""
GUESS_DELAY: Final = 1.0
"""Seconds until a token from such an address is looked at, right or wrong: with its 128 connections an
address gets as many answers a second."""
GUESSES_AGE: Final = 60.0
"""Seconds after which a wrong token is forgotten."""
MOST_GUESSERS: Final = 1_024
"""Addresses that are remembered for it; the one that was there first goes first."""


@dataclass(frozen=True, slots=True)
class Holder:
    """Who has a token.

    Attributes:
        name: as it stands in the history.
        role: what the token allows.
    """

    name: str
    role: Role


class Tokens:
    """The tokens that are valid, each kept as its digest only.

    Args:
        digests: by holder, SHA-256 of the token.

    Raises:
        UsageError: there is none, too many, or two of the same name or token.
    """

    def __init__(self, digests: Iterable[tuple[Holder, bytes]]) -> None:
        self._digests = tuple(digests)
        names = [holder.name for holder, _ in self._digests]
        if not 1 <= len(names) <= MOST_TOKENS:
            raise UsageError(f"there are 1 to {MOST_TOKENS} tokens, not {len(names)}")
        if len(set(names)) < len(names):
            raise UsageError("two tokens have the same name; the history could not tell them apart")
        if len({digest for _, digest in self._digests}) < len(names):
            raise UsageError("two names have the same token; the history could not tell them apart")

    def holder(self, token: bytes) -> Holder | None:
        """Whose token this is. It takes as long for each of them, and for one that nobody has."""
        digest = _digest(token)
        found = None
        for holder, known in self._digests:
            if hmac.compare_digest(known, digest):
                found = holder
        return found

    @classmethod
    def of_text(cls, text: str) -> Tokens:
        """Tokens by lines: `NAME ROLE TOKEN`, or `NAME ROLE sha256:DIGEST`; `#` begins a comment.

        Raises:
            UsageError: a line is none of these. The text never tells what is in it.
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
        """The tokens in a file, which must be its owner's alone.

        Raises:
            UsageError: it cannot be read, is open to others, or is no such file.
        """
        data = read_private(path, "file of tokens", LONGEST_FILE + 1)
        try:
            if len(data) > LONGEST_FILE:
                raise UsageError(f"a file of tokens has no more than {LONGEST_FILE} bytes")
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
    """The tokens of a file, else those that the environment names, or None.

    `PARAMCLIENT_SERVICE_TOKEN_FILE` names a file, `PARAMCLIENT_SERVICE_TOKEN` has one token, which may write.

    Raises:
        UsageError: both are there, or what they name are no tokens.
    """
    if path is not None:
        return Tokens.read(path)
    given = [name for name in (FILE_VARIABLE, TOKEN_VARIABLE) if environment.get(name)]
    if not given:
        return None
    if len(given) > 1:
        raise UsageError(f"the environment has {' and '.join(given)}; one of them is enough")
    value = environment[given[0]]
    try:
        if given[0] == FILE_VARIABLE:
            return Tokens.read(value)
        return Tokens([_of_line([NAME_IN_ENVIRONMENT, "write", value])])
    except UsageError as error:
        raise UsageError(f"{given[0]}: {error}") from None


def new_token() -> str:
    """A token that nobody can guess."""
    return secrets.token_urlsafe(TOKEN_BYTES)


def token_line(name: str, role: str, token: str) -> str:
    """The line of a file of tokens that lets a token in without telling it.

    Raises:
        UsageError: no such name, role or token can be.
    """
    holder, digest = _of_line([name, role, token])
    return f"{holder.name} {holder.role} {DIGEST}{digest.hex()}"


def add_token(path: str | os.PathLike[str], name: str, role: Role) -> str:
    """Make a token, and add its line to a file, which is made for its owner alone if it is not there.

    Raises:
        UsageError: the file cannot be written, is a link, belongs to another user, is open to others, holds
            something else, or has the name.
    """
    token = new_token()
    line = token_line(name, role, token)
    try:
        if Path(path).is_symlink():
            raise UsageError(f"{os.fspath(path)}: it is a link; name the file itself")
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | _NO_LINK, 0o600))
        before = read_private(path, "file of tokens", LONGEST_FILE + 1).decode("utf-8", "replace")
        gap = "" if before.endswith("\n") or not before else "\n"
        try:
            Tokens.of_text(f"{before}{gap}{line}")
        except UsageError as error:
            raise UsageError(f"{os.fspath(path)}: {error}") from None
        with Path(path).open("a", encoding="ascii") as file:
            file.write(f"{gap}{line}\n")
    except OSError as error:
        raise UsageError(f"{os.fspath(path)}: the token cannot be kept: {error.strerror}") from error
    return token


class Sessions:
    """The browsers that have shown a token, by the random text of their cookies.

    Args:
        clock: seconds, that only go forward.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._open: dict[bytes, tuple[Holder, float]] = {}

    def begin(self, holder: Holder) -> str:
        """A new one; what it gives is the cookie's value, which is not kept."""
        now = self._clock()
        self._open = {key: each for key, each in self._open.items() if each[1] > now}
        own = [key for key, (whose, _) in self._open.items() if whose == holder]
        for key in own[: max(0, len(own) + 1 - MOST_SESSIONS)]:
            del self._open[key]
        text = new_token()
        self._open[_digest(text.encode())] = (holder, now + SESSION_AGE)
        return text

    def holder(self, text: bytes) -> Holder | None:
        """Whose session this is, if it is one."""
        holder, until = self._open.get(_digest(text), (None, 0.0))
        return holder if until > self._clock() else None

    def end(self, text: bytes) -> None:
        """It is one no more."""
        self._open.pop(_digest(text), None)

    def __len__(self) -> int:
        return len(self._open)


class Guesses:
    """Wrong tokens by the address that they came from, for a short while.

    Args:
        clock: seconds, that only go forward.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._key = secrets.token_bytes(16)
        self._wrong: OrderedDict[str, dict[bytes, float]] = OrderedDict()

    def wait(self, address: str) -> float:
        """Seconds for which tokens from this address are still looked at late; 0 where they are not."""
        wrong = self._wrong.get(network_of(address))
        if wrong is None or len(wrong) < GUESSES:
            return 0.0
        return max(0.0, next(iter(wrong.values())) + GUESSES_AGE - self._clock())

    def add(self, address: str, token: bytes) -> bool:
        """A wrong one has come; true when it was the last before tokens are looked at late."""
        now = self._clock()
        network = network_of(address)
        wrong = {key: at for key, at in self._wrong.pop(network, {}).items() if now - at < GUESSES_AGE}
        key = hmac.digest(self._key, token, "sha256")[:8]
        is_new = key not in wrong
        if len(wrong) < GUESSES:
            wrong.setdefault(key, now)
        self._wrong[network] = wrong
        while len(self._wrong) > MOST_GUESSERS:
            self._wrong.popitem(last=False)
        return is_new and len(wrong) == GUESSES

    def __len__(self) -> int:
        return len(self._wrong)


def _of_line(words: list[str]) -> tuple[Holder, bytes]:
    """Nothing of it is repeated in errors: the words may be in another order, and any of them the token."""
    if len(words) != 3:
        raise UsageError("a line has three words: NAME, read or write, and TOKEN")
    name, role, token = words
    if not _NAME.fullmatch(name):
        raise UsageError("a name has 1 to 32 letters, digits, dots, hyphens and underscores")
    if role == "read":
        holder = Holder(name, "read")
    elif role == "write":
        holder = Holder(name, "write")
    else:
        raise UsageError("the second word says what the token allows: read, or write")
    if token.startswith(DIGEST):
        digits = token.removeprefix(DIGEST)
        if not _DIGEST.fullmatch(digits):
            raise UsageError("a digest has 64 hexadecimal digits")
        return holder, bytes.fromhex(digits)
    is_sound = token.isascii() and token.isprintable() and " " not in token
    if not is_sound or not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN:
        raise UsageError(
            f"a token has {SHORTEST_TOKEN} to {LONGEST_TOKEN} printable ASCII characters; "
            "`paramclient token` makes a good one"
        )
    return holder, _digest(token.encode())


def _digest(token: bytes) -> bytes:
    return hashlib.sha256(token).digest()


_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,31}")
_DIGEST: Final = re.compile(r"[0-9a-fA-F]{64}")
