"""Where commands take parameters from: a file, a link, or a vehicle in the cache.

The form of a text alone says which of them it is, and whether there is a file of that name:

1. a file that exists, whatever its name looks like;
2. `cache:VEHICLE`, or what can only be the name of a vehicle in the cache (see `paramclient.cache.lookup`):
   a number is a system id, `uid:` and at least six digits are the beginning of a hardware id;
3. anything else: a link.

So `./1` is the file and `cache:1` the vehicle, if ever there are both.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Final

import anyio

from paramclient.cache import CachedSummary, ParamCache
from paramclient.cache.lookup import is_vehicle_name
from paramclient.cli.connection import Deadline, connect
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import progress_bar, report
from paramclient.client.component import Component
from paramclient.errors import UnknownVehicle, UsageError
from paramclient.files import ParamFile, read_file
from paramclient.files.param_file import AUTOPILOT
from paramclient.links import FORMS, parse_link
from paramclient.links.names import names_service
from paramclient.model.paramset import ParamSet
from paramclient.protocol.params.fetch_result import FetchResult
from paramclient.provision.vehicle_params import FetchedSet, collect_set, incomplete_error, load_cached_set

__all__ = [
    "check_link",
    "choose",
    "confirmed",
    "is_file",
    "names_vehicle",
    "open_file",
    "resolve",
    "resolve_all",
    "tables_in",
]

SOURCES: Final = f"""\
  FILE                a parameter file that exists
  cache:VEHICLE       last known of a vehicle: its system id, its hardware id in full, uid: and at least 6
                      digits of it, or its key; without cache: where it can be nothing else, as 1, uid:000200
{FORMS}"""

_CACHED: Final = "cache:"


async def resolve(text: str, options: LinkOptions, *, only: bool = False) -> ParamSet:
    """The parameters that a user's word stands for: of a file, of a vehicle in the cache, or of a link.

    A link is opened and its whole table fetched, from the cache where the vehicle's hash confirms that.

    Args:
        text: see the top of this room.
        only: whether several vehicles on the link are an error, unless the options name one: for values that
            will be written.
        options: `component` chooses in all three (without it the autopilot, or the only one there is);
            `system`, `timeout` and `encoding` are for links.

    Raises:
        UsageError: it is none of the three; a file that cannot be read (FileError); options that exclude
            each other.
        UnknownVehicle: the cache has no such vehicle or component.
        AmbiguousVehicle: several vehicles in the cache have this name; with `only`, several are on the link.
        CacheError: the cache does not have its whole table.
        VehicleError: some parameters did not come; the text names them.
        NoReply: nobody was heard, or answered.
        LinkError: the link cannot be opened, or failed.
    """
    (params,) = await resolve_all([text], options, only=only)
    return params


async def resolve_all(texts: Sequence[str], options: LinkOptions, *, only: bool = False) -> list[ParamSet]:
    """As `resolve`, for several: links side by side, and not before all the others are at hand.

    A text that is given twice is resolved once. The first error ends all.
    """
    found: dict[str, ParamSet] = {}
    links: list[str] = []
    for text in dict.fromkeys(texts):
        if is_file(text):
            found[text] = _from_file(text, options)
        elif names_vehicle(text):
            found[text] = _from_cache(text, options)
        else:
            check_link(text)
            links.append(text)
    errors: list[Exception] = []

    async def fetch(url: str) -> None:
        try:
            found[url] = await _from_link(url, options, is_alone=len(links) == 1, only=only)
        except Exception as error:  # out of the group it would come wrapped
            errors.append(error)
            tasks.cancel_scope.cancel()

    async with anyio.create_task_group() as tasks:
        for url in links:
            tasks.start_soon(fetch, url)
    if errors:
        raise errors[0]
    return [found[text] for text in texts]


def is_file(text: str) -> bool:
    """Whether a word of the user names a file that is there. A device is none: it may be a link."""
    with suppress(OSError, ValueError):  # too long for a name, or with a NUL: then it is none
        path = Path(text)
        return path.is_file() or path.is_fifo()
    return False


def names_vehicle(text: str) -> bool:
    """Whether a word of the user names a vehicle in the cache. It need not be there."""
    return text.startswith(_CACHED) or is_vehicle_name(text)


def check_link(text: str) -> None:
    """See that a word that is neither a file nor a cached vehicle names a link.

    Raises:
        UsageError: it does not; the text says what there is.
    """
    try:
        if not names_service(text):
            parse_link(text)
    except UsageError as error:
        problem = str(error).splitlines()[0]
        raise UsageError(
            f"no such file, and no cached vehicle; {problem}\naccepted forms:\n{SOURCES}"
        ) from None


async def confirmed(component: Component, result: FetchResult, link: str, deadline: Deadline) -> FetchedSet:
    """What of a fetched table was given or confirmed in this session; see `collect_set`.

    Raises:
        LinkError: the link failed.
    """
    for note in result.notes:
        report(f"{component.system}/{component.component} {component.autopilot} on {link}: {note}")
    return await collect_set(component, result, source=f"link {link}", timeout=deadline.left())


def open_file(path: str) -> ParamFile:
    """A parameter file, whole; what its reader should know is told on stderr.

    Raises:
        FileError: it cannot be read.
    """
    file = read_file(path)
    for note in file.notes:
        report(f"{path}: {note}")
    return file


def choose(file: ParamFile, component: int | None, system: int | None) -> ParamSet:
    """What a file has for a component; the system counts only in a file that has several.

    Raises:
        FileError: it has nothing for it.
    """
    is_of_several = len({each.system for each in file.sets}) > 1
    return file.choose(component, system=system if is_of_several else None)


def tables_in(cache: ParamCache, vehicle: str | None, component: int | None) -> list[CachedSummary]:
    """Return the tables in the cache that the user means. All commands find cached vehicles by this function.

    Args:
        cache: the cache.
        vehicle: the vehicle as the user names it, also with `cache:` before it; None for all vehicles.
        component: the table of this component only.

    Raises:
        UsageError: the name is empty, as an unset variable of a script is.
        UnknownVehicle: no vehicle in the cache has this name, or none of its tables is of this component.
        AmbiguousVehicle: several vehicles have this name.
    """
    name = None if vehicle is None else vehicle.removeprefix(_CACHED)
    if name == "":
        raise UsageError("a vehicle in the cache needs a name: its system id, its hardware id, or its key")
    known = cache.components(name)
    chosen = [each for each in known if component in (None, each.component)]
    if not chosen and (known or vehicle is not None):
        held = [f"{each.system}/{each.component} ({each.key})" for each in known]
        raise UnknownVehicle(
            f"component {component} is not in the cache {cache.place}, which holds {', '.join(held)}",
            vehicles=held,
        )
    return chosen


def _from_file(path: str, options: LinkOptions) -> ParamSet:
    return choose(open_file(path), options.component, options.system)


def _from_cache(vehicle: str, options: LinkOptions) -> ParamSet:
    if options.place is False:
        raise UsageError(f"{vehicle!r} is a vehicle in the cache, and --no-cache excludes that")
    with ParamCache(options.cache) as cache:
        tables = tables_in(cache, vehicle, options.component)
        table = next((each for each in tables if each.component == AUTOPILOT), tables[0])
        if options.component is None and len(tables) > 1 and table.component != AUTOPILOT:
            known = ", ".join(f"{each.system}/{each.component}" for each in tables)
            raise UsageError(f"no autopilot is among {known}; choose with --component")
        return load_cached_set(cache, table.key, table.component, note=report)


async def _from_link(url: str, options: LinkOptions, *, is_alone: bool, only: bool) -> ParamSet:
    """The whole table of a component; progress is drawn for a link that is alone, as two would mingle."""
    async with connect(url, options, only=only) as session:
        component, deadline = session.component, session.deadline
        link = session.client.link.name
        with progress_bar(f"fetching {session.who}") if is_alone else nullcontext() as progress:
            result = await component.fetch_all(timeout=deadline.left(), progress=progress)
        found = await confirmed(component, result, link, deadline)
        if found.missing:
            raise incomplete_error(component, found.missing)
        return found.set
