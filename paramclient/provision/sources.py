"""Parameters as a `ParamSet`: `resolve` reads a file, a log, a vehicle of the cache or a link."""

from __future__ import annotations

import logging
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePath
from typing import Final

import anyio.to_thread

from paramclient.cache import CachedComponent, CachedSummary, ParamCache
from paramclient.cache.lookup import address_of, is_vehicle_name
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.errors import NotInCache, UnknownVehicle, UsageError, VehicleError
from paramclient.files import LARGEST_FILE, FileFormat, ParamFile, loads, read_file
from paramclient.files.formats import AUTOPILOT
from paramclient.links import ReplayLink
from paramclient.logs.onboard import is_onboard_log, read_onboard_log
from paramclient.model.comparison import defaults_of, non_defaults
from paramclient.model.names import NameChoice, first_of
from paramclient.model.paramset import ParamSet, add_defaults
from paramclient.model.values import Param
from paramclient.protocol.fetch import FetchResult

STANDARD_INPUT: Final = "-"
"""The word for the standard input."""
NAMES_SHOWN_MAX: Final = 20
"""Parameters that a message names, so that it stays readable; it gives the number of further ones."""
NO_DEFAULTS: Final = (
    "the firmware's defaults are not known: they come with the parameter file over MAVFTP, which ArduPilot "
    "and PX4 from 1.18 on serve and `paramclient fetch LINK --refresh` takes, or with the metadata of the "
    "firmware, which `paramclient fetch LINK --metadata vehicle` and `paramclient metadata add FILE` store"
)
"""The message for a request that needs the firmware's defaults when no parameter has one."""
_CACHED: Final = "cache:"
"""The prefix of a vehicle in the cache."""

logger = logging.getLogger(__name__)


async def resolve(
    text: str,
    *,
    system: int | None = None,
    component: int | None = None,
    extended: bool = False,
    incomplete: bool = False,
    cache: ParamCache | str | bool | None = None,
) -> ParamSet:
    """Return the parameters that a text names.

    1. A file that exists, whatever its name, or `-` for the standard input: a parameter file, or a log.
    2. `cache:VEHICLE`, or a text that can only name a vehicle in the cache (see `paramclient.cache.lookup`).
    3. Any other text: a link. The whole table is fetched, from the cache if the vehicle confirms it.

    `./1` is a file, `cache:1` the vehicle.

    Args:
        text: the file, the vehicle or the link.
        system, component: select a set of a file, a table of the cache, or a vehicle of the link.
        extended: extended parameters of a vehicle; a file with them needs no mention.
        incomplete: also an incomplete table of the cache or of a link: `ParamSet.lacks` says what is missing.
        cache: as in `ParamClient`; False excludes vehicles of the cache.

    Raises:
        UsageError: the text names none of the three; a file, or a line of it, cannot be read (FileError).
        UnknownVehicle, AmbiguousVehicle, CacheError: as `tables_in`.
        VehicleError: without `incomplete`, some parameters were not received; the message names them, or
            counts those in the cache.
        NoReply, LinkError: as from `ParamClient.component` and `Component.fetch_all`.
    """
    read = partial(read_source, text, component=component, extended=extended, incomplete=incomplete)
    # in a thread, as a log of 100 MB takes seconds
    if (found := await anyio.to_thread.run_sync(partial(read, partial=False, cache=cache))) is not None:
        return choose(found, component, system)
    link = link_of(text)
    async with ParamClient(link, cache=cache if link == text else False) as client:
        vehicle = await client.component(system, component)
        vehicle = vehicle.ext if extended else vehicle
        fetched, source = await vehicle.fetch_all(), f"link {client.link.name}"
        return fetched_set(vehicle, fetched, source=source, partial=incomplete)


def read_source(
    text: str,
    *,
    component: int | None = None,
    every: bool = False,
    extended: bool = False,
    incomplete: bool = False,
    partial: bool = True,
    cache: ParamCache | str | bool | None = None,
) -> ParamFile | None:
    """Return the sets of a file, of a log, or of a vehicle of the cache; None if the text names a link.

    Args:
        text, component, extended, cache: as in `resolve`; `component` selects only a table of the cache.
        every: all tables of a vehicle of the cache, instead of that of its autopilot.
        incomplete: also an incomplete table of the cache.
        partial: leave out the lines of a file that cannot be read, with a warning for each.

    Raises:
        ParamClientError: as in `resolve`.
    """
    if is_file(text):
        return _read(text, partial=partial)
    if not is_offline(text):
        return None
    if cache is False:
        raise UsageError(f"{text!r} is a vehicle in the cache, which --no-cache excludes")
    place = cache if isinstance(cache, str) else None
    with nullcontext(cache) if isinstance(cache, ParamCache) else ParamCache(place) as opened:
        tables = tables_in(opened, text, component, extended=extended)
        if not every and len(tables) > 1:
            known = ", ".join(f"{each.system}/{each.component}" for each in tables)
            tables = [each for each in tables if each.component == AUTOPILOT]
            if not tables:
                raise UsageError(f"no autopilot is among {known}; name one of them instead of {text}")
        loaded = opened.load_all(tables, extended=extended)
    sets = [_cached_set(each, extended=extended, partial=incomplete) for each in loaded]
    if not sets:  # removed meanwhile
        raise NotInCache(f"the cache has no table of {text}")
    return ParamFile(tuple(sets), FileFormat.JSON, sets[0].source)


def _read(path: str, *, partial: bool) -> ParamFile:
    """Read a parameter file, or the values at the end of an on-board log; its notes become warnings."""
    if path == STANDARD_INPUT:
        file = loads(sys.stdin.buffer.read(LARGEST_FILE + 1), source="standard input", partial=partial)
    elif is_onboard_log(path):
        log = read_onboard_log(path)
        file = ParamFile((log.at_end(),), log.file_format, path, notes=log.notes)
    else:
        file = read_file(path, partial=partial)
    for note in file.notes:
        logger.warning("%s: %s", file.source, note)
    return file


def is_file(text: str) -> bool:
    """Return whether a text names a file with parameters that exists, or the standard input.

    A telemetry log is a link, and a device may be one.
    """
    return text == STANDARD_INPUT or (_exists(text) and link_of(text) == text)


def is_offline(text: str) -> bool:
    """Return whether a text names a file or a vehicle in the cache, and no link."""
    return is_file(text) or text.startswith(_CACHED) or is_vehicle_name(text)


def link_of(text: str) -> str:
    """Return the link that replays a telemetry log at full speed, for the name of one; else the text."""
    return f"replay:{text}?speed=0" if PurePath(text).suffix.lower() == ".tlog" and _exists(text) else text


def _exists(text: str) -> bool:
    with suppress(OSError, ValueError):  # a text that is too long or has a NUL is not a file name
        return Path(text).is_file() or Path(text).is_fifo()
    return False


def choose(file: ParamFile, component: int | None, system: int | None) -> ParamSet:
    """Return a file's parameters for a component; `system` selects only in a file of several systems.

    Parameters without ids get these.

    Raises:
        FileError: the file has no parameters for it.
    """
    found = file.choose(component, system=system if len({each.system for each in file.sets}) > 1 else None)
    component = component if found.component is None else found.component
    return replace(found, system=found.system or system, component=component)


def choose_names(patterns: Collection[str], sets: Iterable[ParamSet]) -> set[str]:
    """Return the names in sets that names and patterns choose; without any, all names.

    Raises:
        UsageError: one matches no name; the error says which sets are incomplete.
    """
    known = {name for each in sets for name in each}
    of = "".join(f" of {each.source} ({each.lacks})" for each in sets if each.lacks)
    return NameChoice(patterns).choose(known, of) if patterns else known


def tables_in(
    cache: ParamCache, vehicle: str, component: int | None = None, *, extended: bool = False
) -> list[CachedSummary]:
    """Return the tables in the cache that an argument names. All subcommands use this function.

    Args:
        cache: the cache.
        vehicle: the name of the vehicle, also with the prefix `cache:`.
        component: return only the table of this component, unless the name has one.
        extended: only components with extended parameters. A system id is then enough, also if a camera of
            the system has a hardware id of its own.

    Raises:
        NotInCache: no component of the vehicle has extended parameters in the cache.
        UsageError: the name is empty, such as an unset variable of a script.
        UnknownVehicle: no vehicle in the cache has this name, or none of its tables is of this component.
        AmbiguousVehicle: several vehicles have this name.
    """
    name, own = vehicle.removeprefix(_CACHED), component_of(vehicle)
    if not name:
        raise UsageError("a vehicle in the cache needs a name: its system id, its hardware id, or its key")
    is_system = extended and name.isdecimal()
    known = cache.components(None if is_system else name, extended=extended)
    known = [each for each in known if not is_system or str(each.system) == name]
    chosen = [each for each in known if (component if own is None else own) in (None, each.component)]
    if not chosen and extended:
        raise NotInCache("there are no extended parameters of that vehicle in the cache")
    if not chosen:
        addresses = [f"{each.system}/{each.component} ({each.key})" for each in known]
        what = f"component {component} is not in the cache {cache.place}, which has {', '.join(addresses)}"
        raise UnknownVehicle(what, vehicles=addresses)
    return chosen


def component_of(vehicle: str) -> int | None:
    """Return the component id in the name of a vehicle in the cache, such as `4/1`; None without one."""
    address = address_of(vehicle.removeprefix(_CACHED))
    return None if address is None else address[1]


def component_set(component: Component, params: Iterable[Param], source: str, lacks: str = "") -> ParamSet:
    """Return parameters of a component as a set of this moment, or of that of the log on the link.

    `source` and `lacks` are as in `ParamSet`.
    """
    link = component.core.link
    named, ids = {param.name: param for param in params}, (component.component, component.system)
    at = link.at if isinstance(link, ReplayLink) else time.time()
    return ParamSet(named, *ids, component.identity, at, source, component.is_extended, lacks)


def fetched_set(component: Component, result: FetchResult, *, source: str, partial: bool = False) -> ParamSet:
    """Return a fetched table as a set, without values that are only cached.

    Args:
        component: the component.
        result: the result of its fetch.
        source: the origin of the set, in words; a doubt of the encoding is added.
        partial: whether some parameters may be missing.

    Raises:
        VehicleError: some parameters were not received, or their encoding is probably wrong.
    """
    if (doubt := component.session.encoding_doubt) and not partial:
        raise VehicleError(doubt, component.system, component.component)
    source = f"{source} ({doubt})" if doubt else source
    cached = {result.params[name].index: name for name in result.cached}
    indices = sorted({*result.missing, *(index for index in cached if index is not None)})
    missing = [cached.get(index, f"index {index}") for index in indices]
    if missing and not partial:
        was = f"{first_of(missing, NAMES_SHOWN_MAX)} {'was' if len(missing) == 1 else 'were'} not received"
        raise _incomplete(was, component.system, component.component)
    known = [name for name in result.params if name not in result.cached]
    return part_set(component, [result.params[name] for name in known], source, missing)


def part_set(component: Component, params: Collection[Param], source: str, lacks: Iterable[str]) -> ParamSet:
    """Return a set that lacks these parameters, and those with a name that the client does not store, or that
    another one has too."""
    table = component.session.table
    twice = [f"a second {name}" for name, number in Counter(table.names.values()).items() if number > 1]
    names = [*lacks, *map(repr, sorted(table.left_out)), *twice]
    listed, count = sum(each.index is not None for each in params) + len(names), component.count or 0
    # of a list whose count has changed, indices may be those of the earlier one
    of = f" of {count} parameters," if listed <= count else f" parameters; of the list of {count}"
    words = f"{len(params)}{of} without {first_of(names, NAMES_SHOWN_MAX)}"
    return component_set(component, params, source, words if names else "")


def _incomplete(why: str, system: int, component: int) -> VehicleError:
    what = f"{system}/{component} is incomplete: {why}; save and diff take it with --incomplete"
    return VehicleError(what, system, component)


def _cached_set(table: CachedComponent, *, extended: bool, partial: bool) -> ParamSet:
    """Return a component's cached parameters as a set.

    Raises:
        VehicleError: the cache has not all of them, and `partial` is false.
    """
    lacks = ""
    others = 0 if table.count is None else sum(param.index is None for param in table.params.values())
    if not table.complete or table.size - others < (table.count or 0):
        of = "" if table.count is None else f" of {table.count}"
        lacks = f"{table.size - others}{of} parameters are in the cache"
        lacks += f", and {others} read by name" if others else ""
        if not (table.complete or partial):
            raise _incomplete(lacks, table.system, table.component)
    at, source = table.updated_at if table.synced_at is None else table.synced_at, f"cache {table.key}"
    return ParamSet(table.params, table.component, table.system, table.identity, at, source, extended, lacks)


def select_non_defaults(whole: ParamSet, described: Mapping[str, int | float]) -> ParamSet:
    """Return the parameters of a set that differ from the firmware's defaults.

    Args:
        whole: the set.
        described: defaults in the metadata by name, for parameters of the set without a default.

    Raises:
        UsageError: the defaults are not known, or no parameter differs.
    """
    known = add_defaults(whole, described)
    if not any(param.default is not None for param in known.values()):
        raise UsageError(NO_DEFAULTS)
    found = {name: whole[name] for name in non_defaults(known)}
    if not found:
        raise UsageError("no parameter differs from its default")
    return replace(whole, params=found)


def collect_defaults(sets: Sequence[ParamSet], described: Sequence[Mapping[str, int | float]]) -> ParamSet:
    """Return the firmware's defaults of the parameters of sets: a base for `compare`.

    Args:
        sets: the sets.
        described: defaults in the metadata of each set by name, for parameters without a default in the set.

    Raises:
        UsageError: the defaults are not known.
    """
    base = defaults_of(*(add_defaults(each, more) for each, more in zip(sets, described, strict=True)))
    if not base:
        raise UsageError(NO_DEFAULTS)
    given = {name for each in sets for name, param in each.items() if param.default is not None}
    if count := len(base.keys() - given):
        base = replace(base, source=f"{base.source}, {count} of {len(base)} from the metadata")
    return base
