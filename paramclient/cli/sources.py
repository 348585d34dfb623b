"""Sources of parameters that an argument can name: a file, a vehicle in the cache, or a link.

1. A file that exists, independent of its name, or `-` for the standard input; a telemetry log is a link;
2. `cache:VEHICLE`, or a text that can only name a vehicle in the cache (see `paramclient.cache.lookup`);
3. any other text: a link.

If both exist, `./1` is the file and `cache:1` the vehicle.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path, PurePath
from typing import Final

import anyio

from paramclient.cache import CachedSummary, ParamCache
from paramclient.cache.lookup import address_of, is_vehicle_name
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import STDIN, report
from paramclient.cli.session import ChosenVehicle, CommandSession, sessions
from paramclient.errors import FileError, NotInCache, UnknownVehicle, UsageError
from paramclient.files import LARGEST_FILE, ParamFile, loads, read_file
from paramclient.files.formats import AUTOPILOT, ENDINGS
from paramclient.links import FORMS, parse_link
from paramclient.logs.onboard import is_onboard_log, read_onboard_log
from paramclient.model.paramset import ParamSet
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.vehicle_params import cached_set, fetched_set

__all__ = [
    "check_link",
    "check_new",
    "check_pattern",
    "choose",
    "component_of",
    "fill_pattern",
    "is_file",
    "is_pattern_name",
    "names_vehicle",
    "open_file",
    "resolve",
    "resolve_all",
    "source_of",
    "tables_in",
    "whole_table",
]

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
_CACHED: Final = "cache:"
"""The prefix of a vehicle in the cache."""


async def resolve(
    text: str, options: LinkOptions, *, writes: bool = False, extended: bool = False
) -> ParamSet:
    """Return the parameters of the source that an argument names: a file, a vehicle in the cache, or a link.

    Opens a link and fetches the whole table, from the cache if the vehicle confirms it.

    Args:
        text: the argument; see the docstring of this module.
        options: --vehicle selects the vehicle of a link, and the component of a file or of the cache.
        writes: whether the values will be written; see `sessions`.
        extended: the extended parameters of the vehicle.

    Raises:
        UsageError: the text names none of the three; a file cannot be read (FileError).
        UnknownVehicle, AmbiguousVehicle, CacheError: as `tables_in`, and the cached table is incomplete.
        VehicleError: some parameters were not received; the message names them.
        NoReply, LinkError: as `sessions`.
    """
    (params,) = await resolve_all([text], options, writes=writes, extended=extended)
    return params


async def resolve_all(
    texts: Sequence[str], options: LinkOptions, *, writes: bool = False, extended: bool = False
) -> list[ParamSet]:
    """Resolve several sources, as `resolve` does: files, then cached vehicles, then links concurrently.

    A text that is given twice is resolved once. The first error ends all. If one of the files has extended
    parameters, those of the vehicles are meant too.
    """
    texts = [*map(source_of, texts)]
    choice = ChosenVehicle.parse(options.vehicle)
    found = {
        text: choose(open_file(text, partial=not writes), choice.component, choice.system)
        for text in dict.fromkeys(texts)
        if is_file(text)
    }
    extended = extended or any(each.is_extended for each in found.values())
    links: list[str] = []
    for text in dict.fromkeys(texts):
        if text in found:
            continue
        if names_vehicle(text):
            found[text] = _from_cache(text, options, choice.component, extended=extended)
        else:
            check_link(text)
            links.append(text)
    errors: list[Exception] = []

    async def fetch(url: str) -> None:
        try:
            async with sessions(url, options, writes=writes, extended=extended) as opened:
                found[url] = await whole_table(opened[0])
                if not writes:
                    opened.report_others()
        except Exception as error:  # raised here, the task group would wrap it in a group
            errors.append(error)
            tasks.cancel_scope.cancel()

    async with anyio.create_task_group() as tasks:
        for url in links:
            tasks.start_soon(fetch, url)
    if errors:
        raise errors[0]
    return [found[text] for text in texts]


async def whole_table(session: CommandSession, *, refresh: bool = False, partial: bool = False) -> ParamSet:
    """Fetch the table of a session's component; return the values received or confirmed in this session.

    Args:
        session: the session.
        refresh: as in `Component.fetch_all`.
        partial: whether a set of some parameters is returned; its source names the others.

    Raises:
        VehicleError: some parameters were not received; the message names them.
        NoReply, LinkError: as from `Component.fetch_all`.
    """
    component, link = session.component, session.client.link.name
    result = await session.fetch(refresh=refresh)
    for note in result.notes:
        report(f"{session.label} on {link}: {note}")
    return fetched_set(component, result, source=f"link {link}", partial=partial)


def is_file(text: str) -> bool:
    """Return whether an argument names an existing file or the standard input.

    A device is not a file: it may be a link.
    """
    if text == STDIN:
        return True
    with suppress(OSError, ValueError):  # a text that is too long or has a NUL is not a file name
        path = Path(text)
        return path.is_file() or path.is_fifo()
    return False


def source_of(text: str) -> str:
    """Return the source that an argument names: `replay:FILE` for a telemetry log, else the argument."""
    is_telemetry = PurePath(text).suffix.lower() == ".tlog" and is_file(text)
    return f"replay:{text}" if is_telemetry else text


def names_vehicle(text: str) -> bool:
    """Return whether an argument has the form of a name of a vehicle in the cache."""
    return text.startswith(_CACHED) or is_vehicle_name(text)


def check_link(text: str) -> None:
    """Check that an argument that is neither a file nor a cached vehicle names a link.

    Raises:
        UsageError: it does not; the message lists the accepted sources, unless the text is the name of a
            file that does not exist.
    """
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
    try:
        names = [each.name for each in folder.iterdir()]
    except OSError:
        return ""
    similar = difflib.get_close_matches(Path(text).name, names, n=1)
    return f" (did you mean {folder / similar[0]}?)" if similar else ""


def open_file(path: str, *, partial: bool = False) -> ParamFile:
    """Read a parameter file, or the values at the end of an on-board log; report the notes on stderr.

    Args:
        path: the file.
        partial: leave out parameters with a name that no vehicle can have, and report their lines.

    Raises:
        FileError: the file cannot be read.
        UsageError: the log needs a library that is not installed.
    """
    if path == STDIN:
        file = loads(sys.stdin.buffer.read(LARGEST_FILE + 1), source="standard input", partial=partial)
    elif is_onboard_log(path):
        log = read_onboard_log(path)
        file = ParamFile((log.at_end(),), log.file_format, path, notes=log.notes)
    else:
        file = read_file(path, partial=partial)
    for note in file.notes:
        report(f"{file.source}: {note}")
    return file


def choose(file: ParamFile, component: int | None, system: int | None) -> ParamSet:
    """Return a file's parameters for a component; `system` selects only in a file of several systems.

    Raises:
        FileError: the file has no parameters for it.
    """
    is_of_several = len({each.system for each in file.sets}) > 1
    return file.choose(component, system=system if is_of_several else None)


def tables_in(
    cache: ParamCache, vehicle: str | None, component: int | None = None, *, extended: bool = False
) -> list[CachedSummary]:
    """Return the tables in the cache that an argument names. All subcommands use this function.

    Args:
        cache: the cache.
        vehicle: the name of the vehicle, also with the prefix `cache:`; None for all vehicles.
        component: return only the table of this component, unless the name has one.
        extended: only components with extended parameters. A system id is then enough, also if a camera of
            the system has a hardware id of its own.

    Raises:
        NotInCache: no component of the vehicle has extended parameters in the cache.
        UsageError: the name is empty, such as an unset variable of a script.
        UnknownVehicle: no vehicle in the cache has this name, or none of its tables is of this component.
        AmbiguousVehicle: several vehicles have this name.
    """
    name = None if vehicle is None else vehicle.removeprefix(_CACHED)
    if name == "":
        raise UsageError("a vehicle in the cache needs a name: its system id, its hardware id, or its key")
    is_system = extended and name is not None and name.isdecimal()
    known = cache.components(None if is_system else name, extended=extended)
    known = [each for each in known if not is_system or str(each.system) == name]
    address = None if name is None else address_of(name)
    component = component if address is None else address[1]
    chosen = [each for each in known if component in (None, each.component)]
    if not chosen and extended:
        raise NotInCache("there are no extended parameters of that vehicle in the cache")
    if not chosen and (known or vehicle is not None):
        addresses = [f"{each.system}/{each.component} ({each.key})" for each in known]
        raise UnknownVehicle(
            f"component {component} is not in the cache {cache.place}, which has {', '.join(addresses)}",
            vehicles=addresses,
        )
    return chosen


def component_of(vehicle: str) -> int | None:
    """Return the component id in the name of a vehicle in the cache, such as `4/1`; None without one."""
    address = address_of(vehicle.removeprefix(_CACHED))
    return None if address is None else address[1]


def _from_cache(vehicle: str, options: LinkOptions, component: int | None, *, extended: bool) -> ParamSet:
    if options.place is False:
        raise UsageError(f"{vehicle!r} is a vehicle in the cache, which --no-cache excludes")
    with ParamCache(options.cache) as cache:
        tables = tables_in(cache, vehicle, component, extended=extended)
        table = next((each for each in tables if each.component == AUTOPILOT), tables[0])
        if len(tables) > 1 and table.component != AUTOPILOT:
            known = ", ".join(f"{each.system}/{each.component}" for each in tables)
            raise UsageError(f"no autopilot is among {known}; name one of them instead of {vehicle}")
        found = cache.load(table.key, table.component, extended=extended)
        if found is None:  # removed since the line above
            raise NotInCache(f"the cache has no table of {vehicle}")
        return cached_set(found, extended=extended)


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
        uid = session.component.identity.uid
        if uid is None:
            raise UsageError(f"{session.label} does not report a hardware id, which {pattern} needs")
        pattern = pattern.replace("{uid}", uid)
    return pattern.replace("{system}", str(session.component.system))


def check_new(path: str) -> Path:
    """Return the path of a new file. An existing file may be the only copy of an earlier state.

    Raises:
        FileError: the file exists.
    """
    if Path(path).exists():
        raise FileError(
            "exists already, and may be the backup of an earlier run; choose another name", source=path
        )
    return Path(path)
