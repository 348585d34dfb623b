"""Where commands take parameters from: a file, a link, or a vehicle in the cache.

The form of a text alone says which of them it is, and whether there is a file of that name:

1. a file that exists, whatever its name looks like;
2. `cache:VEHICLE`, a key of the cache (`uid:…`, `system:…`), a system id (`1`), or hexadecimal digits (the
   beginning of a hardware id, or one with a system id behind it): a vehicle in the cache;
3. anything else: a link.

So `./1` is the file and `cache:1` the vehicle, if ever there are both.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Final

import anyio

from paramclient.cache import CachedSummary, ParamCache
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import progress_bar, report
from paramclient.cli.session import Deadline, connect
from paramclient.component import Component
from paramclient.errors import CacheError, UsageError
from paramclient.files import ParamFile, read_file
from paramclient.files.model import AUTOPILOT
from paramclient.links import FORMS, parse_link
from paramclient.links.names import names_service
from paramclient.paramset import ParamSet
from paramclient.protocol.result import FetchResult
from paramclient.taken import Taken, cached_set, incomplete, taken

__all__ = [
    "check_link",
    "choose",
    "confirmed",
    "is_file",
    "names_vehicle",
    "open_file",
    "resolve",
    "resolve_all",
    "vehicle_key",
]

SOURCES: Final = f"""\
  FILE                a parameter file that exists
  cache:VEHICLE       last known of a vehicle: its system id, the beginning of its hardware id, or its key;
                      without cache: where it can be nothing else, as 1, 0002000000, uid:0002000000
{FORMS}"""

_CACHED: Final = "cache:"
_VEHICLE: Final = re.compile(rf"{_CACHED}.*|uid:.*|system:.*|[0-9]+|[0-9a-fA-F]{{4,}}(/[0-9]*)?")


async def resolve(text: str, options: LinkOptions) -> ParamSet:
    """The parameters that a user's word stands for: of a file, of a vehicle in the cache, or of a link.

    A link is opened and its whole table fetched, from the cache where the vehicle's hash confirms that.

    Args:
        text: see the top of this room.
        options: `component` chooses in all three (without it the autopilot, or the only one there is);
            `system`, `timeout` and `encoding` are for links.

    Raises:
        UsageError: it is none of the three; a file that cannot be read (FileError); options that exclude
            each other.
        CacheError: the cache has no such vehicle or component, more than one, or not its whole table.
        VehicleError: some parameters did not come; the text names them.
        NoReply: nobody was heard, or answered.
        LinkError: the link cannot be opened, or failed.
    """
    (params,) = await resolve_all([text], options)
    return params


async def resolve_all(texts: Sequence[str], options: LinkOptions) -> list[ParamSet]:
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
            found[url] = await _from_link(url, options, is_alone=len(links) == 1)
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
    return _VEHICLE.fullmatch(text) is not None


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


async def confirmed(component: Component, result: FetchResult, link: str, deadline: Deadline) -> Taken:
    """What of a fetched table was given or confirmed in this session; see `taken`.

    Raises:
        LinkError: the link failed.
    """
    for note in result.notes:
        report(f"{component.system}/{component.component} {component.autopilot} on {link}: {note}")
    return await taken(component, result, source=f"link {link}", timeout=deadline.left())


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


def vehicle_key(cache: ParamCache, vehicle: str) -> str:
    """The key of the vehicle that the user means: by its system id, the beginning of its hardware id, or key.

    `cache:` may stand before each of them.

    Raises:
        UsageError: nothing is named, as by an empty variable of a script; every id begins with nothing.
        CacheError: none fits, or more than one.
    """
    vehicle = vehicle.removeprefix(_CACHED)
    if not vehicle:
        raise UsageError("a vehicle in the cache needs a name: its system id, its hardware id, or its key")
    if vehicle.isdecimal():
        fits = [known for known in cache.vehicles() if str(known.identity.system) == vehicle]
        if len(fits) > 1:
            listed = "; ".join(map(str, fits))
            raise CacheError(f"system {vehicle} fits more than one vehicle in the cache: {listed}")
        if fits:
            return fits[0].key
    return cache.components(vehicle)[0].key


def _from_file(path: str, options: LinkOptions) -> ParamSet:
    return choose(open_file(path), options.component, options.system)


def _from_cache(vehicle: str, options: LinkOptions) -> ParamSet:
    if options.place is False:
        raise UsageError(f"{vehicle!r} is a vehicle in the cache, and --no-cache excludes that")
    with ParamCache(options.cache) as cache:
        key = vehicle_key(cache, vehicle)
        return cached_set(cache, key, _component(cache.components(key), options.component))


def _component(summaries: Sequence[CachedSummary], component: int | None) -> int:
    """The component that the user means, of those of one vehicle."""
    by_id = {each.component: each for each in summaries}
    if component is None:
        component = AUTOPILOT if AUTOPILOT in by_id or len(by_id) > 1 else next(iter(by_id))
    if component not in by_id:
        raise CacheError(
            f"component {component} of {summaries[0].key} is not in the cache, which holds "
            f"{', '.join(map(str, sorted(by_id)))}"
        )
    return component


async def _from_link(url: str, options: LinkOptions, *, is_alone: bool) -> ParamSet:
    """The whole table of a component; progress is drawn for a link that is alone, as two would mingle."""
    async with connect(url, options) as session:
        component, deadline = session.component, session.deadline
        link = session.client.link.name
        with progress_bar(f"fetching {session.who}") if is_alone else nullcontext() as progress:
            result = await component.fetch_all(timeout=deadline.left(), progress=progress)
        found = await confirmed(component, result, link, deadline)
        if found.missing:
            raise incomplete(component, found.missing)
        return found.set
