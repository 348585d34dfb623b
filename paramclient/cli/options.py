"""Options that several subcommands share. The texts below the fields are their help.

All are options of the subcommand itself (name `*`), also those of subclasses, which inherit this. The
annotations are evaluated at once: cyclopts would look up the names of inherited ones in the module of the
subclass.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Final, TypeAlias

from cyclopts import Group, Parameter
from cyclopts.validators import Number, mutually_exclusive

from paramclient.client.signing import Signing, key_from_environment, read_key
from paramclient.model.values import Encoding
from paramclient.wire.signing import SigningKey

CONNECTION: Final = Parameter(group=Group("Connection", sort_key=9))
"""Options of the link, which stand at the end of the help."""

CACHE: Final = Parameter(group=("Parameters", Group("Cache", show=False, validator=mutually_exclusive)))
"""The options that name a cache and that use none; both together are an error."""


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

    no_cache: ClassVar[bool] = False
    """As in `LinkOptions`."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class KeyOptions:
    """The signing key, this computer's own id and the log of steps, of subcommands that open a link."""

    verbose: Annotated[bool, Parameter(name=("--verbose", "-v"))] = False
    """Log each step on stderr, without the key."""

    signing_key: Annotated[Path | None, CONNECTION] = None
    """A file with the key. Default: that of the environment."""

    source_system: Annotated[int, CONNECTION, Parameter(validator=Number(gte=1, lte=255))] = 255
    """System id of this computer. Default: 255."""

    @property
    def key(self) -> SigningKey | None:
        """The signing key, or None.

        Raises:
            UsageError: the key cannot be read.
        """
        return key_from_environment() if self.signing_key is None else read_key(self.signing_key)

    @property
    def signing(self) -> Signing | None:
        """The signing argument of `ParamClient`, with errors as `key`."""
        key = self.key
        return None if key is None else Signing(key)


@dataclass(frozen=True, kw_only=True, slots=True)
class TrafficOptions(KeyOptions):
    """Options of subcommands that open a link."""

    json: bool = False
    """Print JSON."""

    tlog: Annotated[Path | None, CONNECTION] = None
    """Record the link in this new telemetry log."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LinkOptions(TrafficOptions):
    """Options of subcommands that communicate with a vehicle."""

    vehicle: str | None = None
    """4, 4/1 (system/component), uid:ID or all. Default: the first one heard, and for writes the only one."""

    timeout: Seconds = None
    """Seconds for the whole command. Default: 10 for the first heartbeat."""

    cache: Annotated[str | None, CACHE] = None
    """The cache file, or the postgresql:// URL of a shared cache. Default: the user's own cache."""

    no_cache: Annotated[bool, CACHE] = False
    """Neither read nor write a cache."""

    extended: bool = False
    """Extended parameters (PARAM_EXT_*), such as a camera's. Not needed with a file of them."""

    encoding: Annotated[Encoding | None, CONNECTION] = None
    """Encoding of values, if the component reports a wrong one."""

    listen_only: Annotated[bool, CONNECTION] = False
    """Send nothing; receive what other stations on the link request."""

    @property
    def place(self) -> str | bool | None:
        """The cache argument of `ParamClient`."""
        return False if self.no_cache else self.cache


@dataclass(frozen=True, kw_only=True)
class ApplyFlags(LinkOptions):
    """Options of apply and restore."""

    include: tuple[str, ...] = ()
    """Include a left-out category, such as calibration, or a name or pattern (STAT_*); repeatable."""

    reboot: bool = False
    """Reboot the vehicle if values take effect only after a reboot."""

    allow_armed: bool = False
    """Continue if the vehicle is armed."""

    backup: str | None = None
    """A new file for the state before the first write; {uid} and {system} become the ids of the vehicle."""

    dry_run: bool = False
    """Print the values that would be sent, and send none of them."""

    yes: bool = False
    """Do not ask for confirmation."""
