"""The firmware's defaults in the command line: which metadata gives them, and what is printed of it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Final

from paramclient.cli.metadata import known_of_session
from paramclient.cli.output import report, say
from paramclient.cli.session import CommandSession
from paramclient.metadata import Metadata
from paramclient.model.defaults import Default, DefaultSource
from paramclient.model.values import Param
from paramclient.model.wording import counted

__all__ = [
    "DEFAULTS_HINT",
    "STORED_DEFAULTS_HINT",
    "defaults_in",
    "find_defaults",
    "report_no_defaults",
    "say_sources",
]

DEFAULTS_HINT: Final = (
    "--metadata vehicle requests it from a vehicle that serves it, as PX4 does; --metadata FILE takes a "
    "file, and `paramclient metadata add FILE` remembers one"
)
"""What to do if no defaults are known."""
STORED_DEFAULTS_HINT: Final = (
    "`paramclient fetch LINK --metadata vehicle` stores that of a vehicle that serves it, as PX4 does; "
    "--metadata FILE takes a file, and `paramclient metadata add FILE` remembers one"
)
"""What to do if no defaults are known to a subcommand that requests no metadata from a vehicle."""


def defaults_in(metadata: Metadata | None, names: Iterable[str]) -> Mapping[str, int | float]:
    """Return the defaults that metadata gives for parameters, by name; see `default_of`."""
    return {} if metadata is None else metadata.defaults_of(names)


async def find_defaults(
    session: CommandSession,
    choice: str | None,
    given: Metadata | None,
    params: Collection[Param],
) -> Mapping[str, int | float]:
    """Return the defaults in the metadata of a vehicle by name, where the vehicle has given none.

    The metadata is that of --metadata, else the stored one of the firmware.

    Args:
        session: the session.
        choice: the value of --metadata.
        given: the metadata of the file that --metadata names, or None.
        params: the parameters.

    Raises:
        UsageError, VehicleError, NoReply, LinkError: as `known_of_session`.
    """
    unknown = [param.name for param in params if param.default is None]
    if not unknown:
        return {}
    found = given
    if found is None:
        found = await known_of_session(session, choice)
    return defaults_in(found, unknown)


def say_sources(label: str, defaults: Iterable[Default | None]) -> None:
    """Print how many defaults are from the metadata of the firmware, if any are.

    Args:
        label: the vehicle in words.
        defaults: the known defaults of the parameters.
    """
    sources = [default.source for default in defaults if default is not None]
    described = sources.count(DefaultSource.METADATA)
    if described:
        what = f"{described} of {counted(len(sources), 'default')} from the metadata of the firmware"
        say(f"{label}: {what}, which does not have the defaults of an airframe")


def report_no_defaults(hint: str = DEFAULTS_HINT) -> None:
    """Print that the defaults are not known, and what to do."""
    from paramclient.provision.sources import NO_DEFAULTS  # only here: loads provision

    report(f"{NO_DEFAULTS}; {hint}")
