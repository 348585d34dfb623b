"""Sources of parameters in arguments (see `provision.sources`), sets in words, file names with ids."""

from __future__ import annotations

import difflib
from collections.abc import Container, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Final

from paramclient.cli.options import LinkOptions
from paramclient.cli.output import local_time, report
from paramclient.cli.session import ChosenVehicle, CommandSession, sessions
from paramclient.errors import UsageError
from paramclient.files.formats import ENDINGS, address
from paramclient.links import FORMS, LinkKind, parse_link
from paramclient.model.identity import autopilot_name
from paramclient.model.names import counted
from paramclient.model.paramset import ParamSet
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.sources import fetched_set, is_file, is_offline, link_of, resolve

SOURCES: Final = f"""\
  FILE                a parameter file or a log (.bin, .ulg, .tlog) that exists; - for the standard input
  cache:VEHICLE       the cached table of a vehicle: 4 or 4/1, px4 or ardupilot, its hardware id (in full,
                      or uid: and at least 6 digits), or its key; cache: may be left out
{FORMS}"""
"""The accepted sources, for messages."""
PLACEHOLDERS: Final = ("{uid}", "{system}")
"""Placeholders in file names, which are replaced by the ids of the vehicle."""
_ENDINGS: Final = frozenset({*ENDINGS, ".bin", ".ulg", ".txt", ".csv"})
"""Extensions of files with parameters, also of formats that are not readable: a text with one of them is
meant as a file, and no link name has one."""


async def resolve_all(texts: Sequence[str], options: LinkOptions, *, writes: bool = False) -> list[ParamSet]:
    """Return the parameters of each source: files first, then cached vehicles, then links.

    A text that is given twice is resolved once. If one of the files has extended parameters, those of the
    vehicles are meant too.

    Args:
        texts: the arguments.
        options: --vehicle selects the vehicle of a link, and the component of a file or of the cache.
        writes: whether the values will be written; see `sessions`.

    Raises:
        ParamClientError: as from `resolve`.
    """
    choice, extended = ChosenVehicle.parse(options.vehicle), options.extended

    async def fetch(url: str) -> ParamSet:
        chosen = replace(without_cache(url, options), extended=extended)
        async with sessions(url, chosen, writes=writes) as opened:
            table = await whole_table(opened[0])
            if not writes:
                opened.report_others()
            return table

    found: dict[str, ParamSet] = {}
    for text in texts:
        check_link(link_of(text))
    for text in sorted(texts, key=lambda text: (not is_file(text), not is_offline(text))):
        if text not in found:
            found[text] = await resolve(
                text,
                system=choice.system,
                component=choice.component,
                extended=extended,
                cache=options.place,
                fetch=fetch,
            )
            extended = extended or found[text].is_extended
    return [found[text] for text in texts]


def without_cache(url: str, options: LinkOptions) -> LinkOptions:
    """Return the options for a link: a log uses no cache, and --cache is for other sources and metadata."""
    is_log = url.startswith(f"{LinkKind.REPLAY}:")
    return replace(options, cache=None, no_cache=True) if is_log else options


async def whole_table(session: CommandSession, *, partial: bool = False) -> ParamSet:
    """Fetch the table of a session's component; return the values received or confirmed in this session.

    Args:
        session: the session.
        partial: whether a set of some parameters is returned; its source names the others.

    Raises:
        VehicleError: some parameters were not received; the message names them.
        NoReply, LinkError: as from `Component.fetch_all`.
    """
    result, link = await session.fetch(), session.client.link.name
    for note in result.notes:
        report(f"{session.label} on {link}: {note}")
    return fetched_set(session.component, result, source=f"link {link}", partial=partial)


def check_link(text: str) -> None:
    """Check that an argument that is neither a file nor a cached vehicle names a link.

    Raises:
        UsageError: it does not; the message lists the accepted sources, unless the text is the name of a
            file that does not exist.
    """
    if is_offline(text):
        return
    try:
        parse_link(text)
    except UsageError as error:
        if PurePath(text).suffix.lower() in _ENDINGS:
            raise UsageError(f"no such file: {text}{_nearest_file(text)}") from None
        problem = str(error).splitlines()[0]
        raise UsageError(
            f"no such file, and no cached vehicle; {problem}\naccepted sources:\n{SOURCES}"
        ) from None


def _nearest_file(text: str) -> str:
    """Return a question about similar names in the folder, or that there is no such folder; or ""."""
    folder = Path(text).parent
    if not folder.is_dir():
        return f"; there is no folder {folder} here"
    similar = difflib.get_close_matches(Path(text).name, [each.name for each in folder.iterdir()], n=1)
    return f" (did you mean {folder / similar[0]}?)" if similar else ""


# Sets


def part_of(params: ParamSet, names: Container[str]) -> ParamSet:
    """Return a set with only the parameters of these names."""
    return replace(params, params={name: param for name, param in params.items() if name in names})


def described(params: ParamSet) -> str:
    """Return a set in words: `903 parameters of 1/1 px4 from link sim:px4, 2026-11-20T18:00:00.000Z`."""
    origin = [
        "" if params.component is None and params.system is None else f"of {address(params)}",
        "" if params.identity is None else autopilot_name(params.identity.autopilot),
        f"from {params.source}" if params.source else "",
    ]
    at = "" if params.at is None else f", {local_time(params.at)}"
    return " ".join(filter(None, [counted(len(params), noun_of(params)), *origin])) + at


def noun_of(params: ParamSet) -> str:
    """Return the parameters of a set in words, in the singular."""
    return "extended parameter" if params.is_extended else "parameter"


# File names for several vehicles


def is_pattern_name(name: str) -> bool:
    """Return whether a file name has a placeholder for the ids of the vehicle."""
    return any(place in name for place in PLACEHOLDERS)


def check_pattern(what: str, pattern: str | None, options: LinkOptions) -> None:
    """Check that a file name has a placeholder if there may be several vehicles.

    Raises:
        UsageError: it has none.
    """
    is_all = ChosenVehicle.parse(options.vehicle).is_all
    if pattern is not None and is_all and not is_pattern_name(pattern):
        raise UsageError(
            f"with --vehicle all, {what} needs {' or '.join(PLACEHOLDERS)} in its name: {pattern}"
        )


async def fill_pattern(pattern: str, session: CommandSession) -> str:
    """Return a file name with the placeholders replaced by the vehicle's ids.

    Raises:
        UsageError: the name has `{uid}`, and the vehicle reports no hardware id.
    """
    if "{uid}" in pattern:
        await wait_for_identity(session.component)
    return filled(pattern, session.component.system, session.component.identity.uid, session.label)


def filled(pattern: str, system: int | None, uid: str | None, label: str) -> str:
    """Return a file name with the placeholders replaced; `label` is the vehicle in words.

    Raises:
        UsageError: the name has `{uid}`, and the vehicle reports no hardware id.
    """
    if uid is None and "{uid}" in pattern:
        raise UsageError(f"{label} does not report a hardware id, which {pattern} needs")
    return pattern.replace("{uid}", uid or "").replace("{system}", str(system))
