"""The subcommands set and reset: values of the arguments, and the firmware's defaults."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cli.metadata import (
    MetadataChoice,
    default_in,
    info_of,
    known_of_session,
    no_defaults,
    request_from_vehicle,
    say_sources,
)
from paramclient.cli.options import ApplyFlags, LinkOptions
from paramclient.cli.output import LINE_NAMES_MAX, can_ask, confirm, report, say
from paramclient.cli.session import CommandSession, check_given, get_chosen, sessions, spelling
from paramclient.cli.writes import SetJob, write_all
from paramclient.client.component import SETTLE_MAX
from paramclient.errors import NoReply, ParamClientError, UnknownParameter, UsageError, VehicleError
from paramclient.metadata import Metadata
from paramclient.metadata.info import ParamInfo, number_of
from paramclient.model.names import counted, first_of, is_pattern
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param, Value, check_name, format_value, parse_ext_value

if TYPE_CHECKING:
    from paramclient.cli.apply import State

_DEFAULTS: Final = LinkOptions()
_APPLY: Final = ApplyFlags()


async def set_(
    url: str,
    /,
    *pairs: Annotated[str, Parameter(name="NAME VALUE", allow_leading_hyphen=True)],
    settle: Annotated[float, Parameter(validator=Number(gte=0, lte=SETTLE_MAX))] = 0.0,
    force: bool = False,
    metadata: MetadataChoice = None,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Write parameters in the order given, and verify each by the value that the vehicle reports.

    A value is a decimal or hexadecimal number (0x1F), nan or inf; of an extended parameter also text, or
    bytes as hex:00FF. It may also be the name of a value, or names of bits separated by |, if metadata
    describes the parameter: it is downloaded from the vehicle unless --metadata names a file. A refused value
    does not stop the others. If several vehicles are heard, --vehicle must choose one, or all. A value
    outside the range in the metadata, or a fraction for an integer parameter, is written only after
    confirmation on a terminal, or with --force.

    Args:
        url: The link.
        pairs: A parameter, in upper or lower case, and its value, or NAME=VALUE. May be given several times.
        settle: Seconds to watch each value before it is read again. 1.2 detects values that PX4's modules
            clamp.
        force: Do not ask about values outside the range, and fractions for integers, which ArduPilot
            truncates. Send NaN and infinity also to PX4, which cannot save them and may stop, and to
            ArduPilot.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
    """
    wanted = _parse_pairs(pairs)
    if isinstance(metadata, Metadata) and not options.extended:
        _values(wanted, metadata)
    async with sessions(url, options, writes=True) as found:
        jobs = [await _prepare(each, wanted, metadata) for each in found]
        doubts = dict.fromkeys([doubt for job in jobs for doubt in await _doubts(job)])
        for doubt in doubts:
            report(doubt)
        if doubts and not force:
            if not can_ask():
                raise UsageError("nothing was written; --force writes these values all the same")
            receivers = ", ".join(job.session.receiver for job in jobs)
            if not await confirm(f"Write these values to {receivers} all the same?"):
                raise UsageError("nothing was written")
        ready = {job.session: replace(job, settle=settle, force=force) for job in jobs}
        return await write_all(found, ready)


def _parse_pairs(words: Sequence[str]) -> dict[str, str]:
    """Return the texts of values by parameter, from `NAME VALUE` or `NAME=VALUE`.

    Raises:
        UsageError: a name has no value, is invalid, or is given twice.
    """
    pairs: dict[str, str] = {}
    left = iter(words)
    for word in left:
        if word.startswith("-"):  # values may be negative, so that an unknown option would be a name
            raise UsageError(f"Unknown option: {word.partition('=')[0]}. Nothing was written.")
        name, equals, text = word.partition("=")
        value = text if equals else next(left, None)
        if value is None:
            raise UsageError(f"set takes pairs of NAME and VALUE, or NAME=VALUE, and {name} has no value")
        if check_name(name) in pairs:
            raise UsageError(f"{name} is given twice")
        pairs[name] = value
    if not pairs:
        raise UsageError("set takes pairs of NAME and VALUE, or NAME=VALUE")
    return pairs


async def _prepare(session: CommandSession, wanted: dict[str, str], choice: MetadataChoice) -> SetJob:
    """Return names and values as the vehicle and its metadata have them.

    The types of extended parameters are read, as their texts have values only with them.

    Raises:
        UsageError: a text is no value of its parameter.
        ParamClientError: the type of an extended parameter could not be read.
    """
    component = session.component
    if component.is_extended:
        params, errors = await get_chosen(session, [*wanted])
        for error in errors.values():
            if not isinstance(error, UnknownParameter):  # the write reports that
                raise error
        types = {param.name: param.type for param in params}
    texts = {spelling(name, component): text for name, text in wanted.items()}
    if component.is_extended:
        values = {
            name: parse_ext_value(name, text, types[name]) if name in types else text
            for name, text in texts.items()
        }
        return SetJob(session, values, None)
    named = [f"{name}: {text!r} is not a number" for name, text in texts.items() if not _is_number(text)]
    described = await known_of_session(session, choice, needed_for=named[0] if named else "")
    return SetJob(session, _values(texts, described), described)


def _values(texts: Mapping[str, str], described: Metadata | None) -> dict[str, Value]:
    """Return the values of texts, which are numbers or names in the metadata.

    Raises:
        UsageError: a text is neither.
    """
    values: dict[str, Value] = {}
    for name, text in texts.items():
        info = info_of(described, name)
        if info is None and not _is_number(text):
            raise UsageError(f"{name}: {text!r} is not a number, and no metadata describes {name}")
        values[name] = (info or ParamInfo(name)).parse(text)
    return values


def _is_number(text: str) -> bool:
    with suppress(UsageError):
        return number_of(text) is not None
    return True  # beyond the range of a float


async def _doubts(job: SetJob) -> list[str]:
    """Return sentences on values outside the range, and on fractions for integers."""
    doubts: list[str] = []
    component = job.session.component
    for name, value in job.writes.items():
        info = info_of(job.described, name)
        if info is not None and (problem := info.problem(value)) is not None:
            doubts.append(problem)
        if isinstance(value, float) and math.isfinite(value) and not value.is_integer():
            with suppress(ParamClientError):  # the write fails for the same reason, and says so
                timeout = job.session.deadline.left()
                known = component.params.get(name) or await component.get(name, timeout=timeout)
                if known.type.is_integer:
                    doubts.append(
                        f"{name}: {format_value(value)} is not a whole number, and {name} is an integer"
                    )
    return doubts


# reset


async def reset(
    url: str,
    /,
    *names: str,
    all_: Annotated[bool, Parameter(name="--all")] = False,
    changed: bool = False,
    metadata: MetadataChoice = None,
    options: ApplyFlags = _APPLY,
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
    from paramclient.cli.apply import State, run  # only here: loads provision

    if bool(names) + all_ + changed != 1:
        raise UsageError("reset takes names, or --all, or --changed")
    chosen = check_given(names)

    async def load(session: CommandSession) -> State:
        missing = (await session.fetch()).missing
        params, errors = await get_chosen(session, chosen or ["*"], is_fetched=True)
        for error in errors.values():
            raise error
        known = await _known(session, metadata, params)
        found = {param.name: default_in(known, param) for param in params}
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
