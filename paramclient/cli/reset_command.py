"""The subcommand reset: applies the firmware's defaults, as apply does the values of a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Final

from cyclopts import Parameter

from paramclient.cli.apply import State, run
from paramclient.cli.metadata import (
    MetadataChoice,
    defaults_in,
    known_of_session,
    no_defaults,
    request_from_vehicle,
    say_sources,
)
from paramclient.cli.options import ApplyFlags
from paramclient.cli.output import LINE_NAMES_MAX, report, say
from paramclient.cli.session import CommandSession, check_given, get_chosen
from paramclient.errors import NoReply, UsageError, VehicleError
from paramclient.metadata import Metadata
from paramclient.model.names import counted, first_of, is_pattern
from paramclient.model.paramset import ParamSet, default_of
from paramclient.model.values import Param

_OPTIONS: Final = ApplyFlags()


async def reset(
    url: str,
    /,
    *names: str,
    all_: Annotated[bool, Parameter(name="--all")] = False,
    changed: bool = False,
    metadata: MetadataChoice = None,
    options: ApplyFlags = _OPTIONS,
) -> int:
    """Set parameters to the firmware's defaults, in dependency order, and verify each of them.

    Fetches the table first. ArduPilot, and PX4 from 1.18 on, give the defaults in the parameter file over
    MAVFTP; defaults that the vehicle does not give are taken from its metadata. The state before is stored,
    for `restore`. On a terminal, the changes are shown and must be confirmed. If several vehicles are heard,
    --vehicle must choose one, or all. The exit codes are those of apply; 1 also if a default is not known.

    Args:
        url: The link.
        names: The parameters, in upper or lower case, or patterns such as "MC_*".
        all_: Reset all parameters, except those that apply leaves out: identity, calibration, counters and so
            on, see --include.
        changed: The same, without a complaint about single parameters whose default is not known.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
    """
    if bool(names) + all_ + changed != 1:
        raise UsageError("reset takes names, or --all, or --changed")
    chosen = check_given(names)

    async def load(session: CommandSession) -> State:
        missing = (await session.fetch()).missing
        params, errors = await get_chosen(session, chosen or ["*"], is_fetched=True)
        for error in errors.values():
            raise error
        known = defaults_in(await _known(session, metadata, params), [each.name for each in params])
        found = {param.name: default_of(param, known.get(param.name)) for param in params}
        wanted = {name: default.value for name, default in found.items() if default is not None}
        if not wanted:
            raise VehicleError(no_defaults(), *session.component.address)
        say_sources(session.label, found.values())
        problems = []
        if missing and any(map(is_pattern, chosen or "*")):
            problems.append(f"incomplete: {counted(len(missing), 'parameter')} not received")
        if (without := [name for name in found if name not in wanted]) and not changed:
            listed = first_of(without, LINE_NAMES_MAX)
            problems.append(f"not written, as their default is not known: {listed}")
        for problem in problems:
            report(f"{session.prefix}{problem}")
        return State(ParamSet(wanted, source="the firmware's defaults"), is_part=bool(problems))

    flags = replace(options, include=(*options.include, *(name.upper() for name in chosen)))
    return await run(url, flags, load, metadata=metadata)


async def _known(session: CommandSession, choice: MetadataChoice, params: Sequence[Param]) -> Metadata | None:
    """Return the metadata of the vehicle, or None if there is none.

    Without a choice of the user, it is downloaded only if the vehicle does not give a default.
    """
    found = await known_of_session(session, choice)
    if found is not None or all(param.default is not None for param in params):
        return found
    try:
        return await request_from_vehicle(session)
    except (UsageError, VehicleError, NoReply) as error:
        say(f"{session.label} gives no metadata with defaults: {error}")
        return None
