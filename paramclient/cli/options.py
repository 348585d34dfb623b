"""What several commands can be told. The texts below the fields are their help."""

from __future__ import annotations

import getpass
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, TypeAlias

from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.client.signing import Signing, key_from_environment, read_key
from paramclient.errors import UsageError
from paramclient.model.values import Encoding
from paramclient.protocol.wire import SigningKey, SigningPolicy

__all__ = ["CacheOptions", "Id", "KeyOptions", "LinkOptions", "Seconds", "SigningOptions"]

Id: TypeAlias = Annotated[int | None, Parameter(validator=Number(gte=1, lte=255))]
"""A system or component id."""


def _check_seconds(_: object, seconds: float | None) -> None:
    if seconds is not None and not 0 < seconds < math.inf:
        raise ValueError("It is a number of seconds above 0.")


Seconds: TypeAlias = Annotated[float | None, Parameter(validator=_check_seconds)]
"""A time limit."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class CacheOptions:
    """Of commands that work with no link."""

    json: bool = False
    """Print JSON, for programs."""

    cache: str | None = None
    """The cache file, or the postgresql:// URL of one that stations share, instead of the user's own."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class KeyOptions:
    """Which signing key, of commands that open a link."""

    signing_key: Path | None = None
    """A file with the key for signed messages. Without it, the one that the environment names, if any."""

    signing_passphrase: bool = False
    """Ask for the passphrase of which the key is made, instead."""

    _typed: ClassVar[SigningKey | None] = None  # of the class, as the fields of one are options

    def __post_init__(self) -> None:
        if self.signing_passphrase:
            if self.signing_key is not None:
                raise UsageError("--signing-key and --signing-passphrase exclude each other")
            object.__setattr__(self, "_typed", _typed_passphrase())

    @property
    def key(self) -> SigningKey | None:
        """The key, if there is one.

        Raises:
            UsageError: it cannot be read.
        """
        if self._typed is not None:
            return self._typed
        return key_from_environment() if self.signing_key is None else read_key(self.signing_key)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class SigningOptions(KeyOptions):
    """Of commands that sign what they send and check what comes."""

    signing_policy: SigningPolicy = SigningPolicy.UNSIGNED_RADIOS
    """What is taken of what comes, where there is a key."""

    @property
    def signing(self) -> Signing | None:
        """As `ParamClient` takes it.

        Raises:
            UsageError: the key cannot be read.
        """
        key = self.key
        return None if key is None else Signing(key, self.signing_policy)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class LinkOptions(SigningOptions):
    """Of commands that speak to a vehicle."""

    json: bool = False
    """Print JSON, for programs."""

    system: Id = None
    """The system to speak to, 1 to 255. Without it, the first one heard; the only one, for what writes."""

    component: Id = None
    """The component to speak to, 1 to 255. Without it, the autopilot."""

    peer: str | None = None
    """The peer to speak to, HOST or HOST:PORT, where several have equal ids; goes with --split-peers."""

    split_peers: bool = False
    """Take components with equal ids for different ones where they come from different peers."""

    timeout: Seconds = None
    """Seconds for everything together. Without it, 10 to hear the vehicle, then as many as it takes."""

    encoding: Encoding | None = None
    """How the component lays values into messages, where what it says of itself is wrong."""

    cache: str | None = None
    """The cache file, or the postgresql:// URL of one that stations share, instead of the user's own."""

    no_cache: bool = False
    """Neither read nor write a cache."""

    listen_only: bool = False
    """Send nothing, and take what others on the link ask for."""

    forward: str | None = None
    """The link to one other program, such as udpout:127.0.0.1:14551, that is to share the vehicle's."""

    verbose: Annotated[bool, Parameter(name=("--verbose", "-v"))] = False
    """Tell on stderr what is done, step by step."""

    tlog: Path | None = None
    """Write everything on the link, both ways, to this telemetry log, which must not exist yet."""

    @property
    def place(self) -> str | bool:
        """Where tables are kept, as `ParamClient` takes it.

        Raises:
            UsageError: a cache was named and none was wanted.
        """
        if self.no_cache and self.cache is not None:
            raise UsageError("--cache and --no-cache exclude each other")
        return not self.no_cache if self.cache is None else self.cache


def _typed_passphrase() -> SigningKey:
    """The key of a passphrase that the user types, unseen.

    Not to be asked within the event loop, where Ctrl-C would not end it.

    Raises:
        UsageError: there is no terminal to ask at, or nothing was typed.
    """
    if not sys.stdin.isatty():
        raise UsageError("there is no terminal to ask for the passphrase at")
    try:
        return SigningKey.from_passphrase(getpass.getpass("Signing passphrase: "))
    except EOFError:
        raise UsageError("no passphrase was given") from None
