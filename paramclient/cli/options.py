"""Options that several subcommands share. The texts below the fields are their help."""

from __future__ import annotations

import getpass
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Final, TypeAlias, TypedDict

from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cli.vehicle_name import VehicleName
from paramclient.client.signing import Signing, key_from_environment, read_key
from paramclient.errors import UsageError
from paramclient.model.values import Encoding
from paramclient.wire.signing import SigningKey, SigningPolicy

__all__ = [
    "CacheOptions",
    "Count",
    "Id",
    "KeyOptions",
    "LinkOptions",
    "Seconds",
    "SigningOptions",
    "TrafficOptions",
]

SOURCE_SYSTEM: Final = 255
"""The usual system id of ground stations, and the default of `ParamClient`."""
SOURCE_COMPONENT: Final = 190
"""MAV_COMP_ID_MISSIONPLANNER, the usual component id of ground stations, and the default of `ParamClient`."""

Id: TypeAlias = Annotated[int | None, Parameter(validator=Number(gte=1, lte=255))]
"""A system or component id."""
Count: TypeAlias = Annotated[int | None, Parameter(validator=Number(gte=1, lte=255))]
"""A number of vehicles, at most as many as there are system ids."""


class SourceIds(TypedDict):
    """Own ids, as arguments of a client."""

    system: int
    component: int


def _check_seconds(_: object, seconds: float | None) -> None:
    if seconds is not None and not 0 < seconds < math.inf:
        raise ValueError("It must be a number of seconds above 0.")


Seconds: TypeAlias = Annotated[float | None, Parameter(validator=_check_seconds)]
"""A timeout in seconds."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class CacheOptions:
    """Options of subcommands that need no link."""

    json: bool = False
    """Print JSON."""

    cache: str | None = None
    """The cache file, or the postgresql:// URL of a shared cache. Default: the user's own cache."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class KeyOptions:
    """The signing key and this computer's own ids, of subcommands that open a link."""

    signing_key: Path | None = None
    """A file with the key for signed messages. Default: the key that the environment names, if any."""

    signing_passphrase: bool = False
    """Ask for a passphrase, and derive the key from it."""

    source_system: Id = None
    """System id of this computer on the link, 1 to 255. Default: 255."""

    source_component: Id = None
    """Component id of this computer on the link, 1 to 255. Default: 190."""

    _typed: ClassVar[SigningKey | None] = None  # a class variable, because each field would be an option

    def __post_init__(self) -> None:
        if self.signing_passphrase:
            if self.signing_key is not None:
                raise UsageError("--signing-key and --signing-passphrase exclude each other")
            object.__setattr__(self, "_typed", _typed_passphrase())

    @property
    def source(self) -> SourceIds:
        """The arguments `system` and `component` of `ParamClient`."""
        return {
            "system": SOURCE_SYSTEM if self.source_system is None else self.source_system,
            "component": SOURCE_COMPONENT if self.source_component is None else self.source_component,
        }

    @property
    def key(self) -> SigningKey | None:
        """The signing key, or None.

        Raises:
            UsageError: the key cannot be read.
        """
        if self._typed is not None:
            return self._typed
        return key_from_environment() if self.signing_key is None else read_key(self.signing_key)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class SigningOptions(KeyOptions):
    """Options of subcommands that sign sent frames and check received ones."""

    signing_policy: SigningPolicy = SigningPolicy.UNSIGNED_RADIOS
    """With a key: which received frames are accepted."""

    @property
    def signing(self) -> Signing | None:
        """The signing argument of `ParamClient`.

        Raises:
            UsageError: the key cannot be read.
        """
        key = self.key
        return None if key is None else Signing(key, self.signing_policy)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class TrafficOptions(SigningOptions):
    """Options of subcommands that open a link."""

    json: bool = False
    """Print JSON."""

    verbose: Annotated[bool, Parameter(name=("--verbose", "-v"))] = False
    """Log each step on stderr."""

    tlog: Path | None = None
    """Record all frames of the link, received and sent, in this new telemetry log."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class LinkOptions(TrafficOptions):
    """Options of subcommands that communicate with a vehicle."""

    vehicle: str | None = None
    """The vehicle: 4 or 4/1 (system and component id), px4 or ardupilot if only one vehicle has that
    autopilot, or a hardware id or key of the cache. Instead of --system."""

    system: Id = None
    """System id of the vehicle, 1 to 255. Default: the first one received; for writes, the only one."""

    component: Id = None
    """Component id, 1 to 255. Default: the autopilot."""

    peer: str | None = None
    """The peer of the vehicle, HOST or HOST:PORT, if several have equal ids. Needs --split-peers."""

    split_peers: bool = False
    """Treat components with equal ids as different ones if their messages come from different peers."""

    timeout: Seconds = None
    """Timeout for the whole command in seconds. Default: 10 for the first heartbeat, then no limit."""

    encoding: Encoding | None = None
    """Encoding of values in messages, if the component reports a wrong one."""

    cache: str | None = None
    """The cache file, or the postgresql:// URL of a shared cache. Default: the user's own cache."""

    no_cache: bool = False
    """Neither read nor write a cache."""

    listen_only: bool = False
    """Send nothing; receive the parameters that other stations on the link request."""

    forward: str | None = None
    """Share the vehicle's link with one other program over this link, such as udpout:127.0.0.1:14551."""

    named: ClassVar[VehicleName] = VehicleName()  # a class variable, because each field would be an option

    def __post_init__(self) -> None:
        KeyOptions.__post_init__(self)  # a class with slots has no super() without arguments
        if self.vehicle is not None:
            named = VehicleName.chosen(
                self.vehicle, self.system, self.component, cache=self.cache, uses_cache=not self.no_cache
            )
            object.__setattr__(self, "named", named)
            object.__setattr__(self, "system", named.system)
            object.__setattr__(self, "component", named.component)

    @property
    def place(self) -> str | bool:
        """The cache argument of `ParamClient`.

        Raises:
            UsageError: --cache and --no-cache are both given.
        """
        if self.no_cache and self.cache is not None:
            raise UsageError("--cache and --no-cache exclude each other")
        return not self.no_cache if self.cache is None else self.cache


def _typed_passphrase() -> SigningKey:
    """Ask for a passphrase without echo; return its key.

    Must be called outside of the event loop, in which Ctrl-C would not interrupt it.

    Raises:
        UsageError: stdin is not a terminal, or no passphrase was entered.
    """
    if not sys.stdin.isatty():
        raise UsageError("--signing-passphrase needs a terminal to enter the passphrase")
    try:
        return SigningKey.from_passphrase(getpass.getpass("Signing passphrase: "))
    except EOFError:
        raise UsageError("no passphrase was given") from None
