"""The subcommand save: writes the parameters of a vehicle, the cache, a log or a file to a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Final, Literal, TypeAlias

import anyio.to_thread
from cyclopts import Parameter

from paramclient.cli.cached import tables_of
from paramclient.cli.default_sources import (
    DEFAULTS_HINT,
    STORED_DEFAULTS_HINT,
    defaults_in,
    find_defaults,
    say_sources,
)
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.file_output import noun_of
from paramclient.cli.metadata import MetadataChoice, from_file, known_of_sets
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import print_json, report, say
from paramclient.cli.session import ChosenVehicle, CommandSession, sessions
from paramclient.cli.sources import (
    check_link,
    choose,
    is_file,
    is_pattern_name,
    names_vehicle,
    open_file,
    source_of,
    whole_table,
)
from paramclient.errors import NotInCache, UsageError, VehicleError
from paramclient.files import FileFormat, writable, write_file
from paramclient.files.formats import AUTOPILOT, address, format_of_name
from paramclient.model.defaults import default_of
from paramclient.model.names import NameChoice
from paramclient.model.paramset import ParamSet
from paramclient.model.wording import counted, first_of
from paramclient.provision.vehicle_params import (
    NAMES_SHOWN_MAX,
    NO_DEFAULTS,
    cached_set,
    select_non_defaults,
)

__all__ = ["save"]

SaveFormat: TypeAlias = Literal["qgc", "parm", "mission-planner", "pck", "json"]
"""The file formats that can be written."""

INCOMPLETE_HINT: Final = "--incomplete writes what was received"
"""What to do with a table that is not complete."""
_DEFAULTS: Final = LinkOptions()


async def save(
    where: str,
    file: Path,
    /,
    *,
    file_format: Annotated[SaveFormat | None, Parameter(name="--format")] = None,
    changed: bool = False,
    only: tuple[str, ...] = (),
    refresh: bool = False,
    incomplete: bool = False,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Write the parameters of a vehicle to a file, in the file format of any ground station.

    An existing file is replaced once the new one is completely on the disk. An incomplete table is written
    with --incomplete only. Exit code 1: the table is incomplete, or with --changed, no parameter differs or
    the defaults are not known. With --vehicle all, a file with {system} or {uid} in its name becomes a file
    for each vehicle; otherwise the file format must be able to hold several components.

    Args:
        where: The link, such as udpin:0.0.0.0:14550 or sim:px4; an on-board log (.bin, .ulg), for the values
            at its end, or another parameter file; or a vehicle in the cache: 4 or 4/1, px4 or ardupilot, its
            hardware id (in full, or uid: and at least 6 digits), or its key.
        file: The file. Its extension determines the file format: .params, .parm, .param, .pck, .json.
        file_format: The file format, if the extension does not determine it.
        changed: Write only parameters that differ from the firmware's defaults: those of the vehicle, else
            those of its metadata.
        only: Write only this name or pattern, such as "MC_*". May be given several times.
        refresh: Download all parameters even if the cache is up to date.
        incomplete: Write the parameters that were received where others were not; the file names these.
        metadata: With --changed, a file with the firmware's defaults; or vehicle, to download the vehicle's
            own metadata. Default: the stored metadata of the firmware; else that of the vehicle if it can be
            downloaded in 2 s.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's. Not needed with a file of them.
    """
    if metadata is not None and not changed:
        raise UsageError("--metadata gives the defaults for --changed")
    written = format_of_name(str(file)) if file_format is None else FileFormat(file_format)
    where = source_of(where)
    is_offline = is_file(where) or names_vehicle(where)
    if is_offline and refresh:
        raise UsageError(f"--refresh needs a link; {where!r} is a file or a vehicle in the cache")
    given = from_file(metadata, offline=is_offline)
    sets: list[ParamSet] = []
    faults: list[str] = []

    def add(whole: ParamSet, described: Mapping[str, int | float]) -> None:
        """Add a set to write; `described` has defaults of the metadata by name."""
        if not changed:
            sets.append(whole)
            return
        try:
            sets.append(differing := select_non_defaults(whole, described))
        except UsageError as error:
            hint = f"; {STORED_DEFAULTS_HINT if is_offline else DEFAULTS_HINT}"
            faults.append(f"{address(whole)}: {error}{hint if str(error) == NO_DEFAULTS else ''}")
            return
        known = [default_of(each, described.get(each.name)) for each in differing.values()]
        say_sources(address(whole), known)

    if is_offline:
        found = _offline_sets(where, options, faults, incomplete=incomplete, extended=extended)
        described = known_of_sets(found, options) if changed and given is None else [given] * len(found)
        for each, known_of_set in zip(found, described, strict=True):
            add(each, defaults_in(known_of_set, each))
    else:
        check_link(where)
        async with sessions(where, options, extended=extended) as opened:
            fetch = partial(_fetch, refresh=refresh, incomplete=incomplete)
            for done in await opened.work(fetch):
                if done.result is None:
                    faults.append(f"{done.session.address}: {done.error}")
                    continue
                table = done.session.component.params
                params = [table[name] for name in done.result if changed and name in table]
                add(done.result, await find_defaults(done.session, metadata, given, params))
            opened.report_others()
    for fault in faults:
        report(fault)
    sets = [_writable(each, written) for each in (_chosen(sets, only) if only else sets)]
    files = _by_file(str(file), sets) if is_pattern_name(str(file)) else {file: sets}
    if sets:
        for path, of_file in files.items():
            await anyio.to_thread.run_sync(partial(write_file, path, of_file, file_format=written))
        _show(files, written, as_json=options.json)
    else:
        report(f"nothing was written to {file}")
    return ExitCode.INCOMPLETE if faults or not sets else ExitCode.DONE


async def _fetch(session: CommandSession, *, refresh: bool, incomplete: bool) -> ParamSet:
    """Return the whole table of a vehicle, or with `incomplete` what was received of it."""
    try:
        return await whole_table(session, refresh=refresh, partial=incomplete)
    except VehicleError as error:
        message = f"{error}; {INCOMPLETE_HINT}"
        raise VehicleError(message, system=error.system, component=error.component) from None


def _offline_sets(
    where: str, options: LinkOptions, faults: list[str], *, incomplete: bool, extended: bool
) -> list[ParamSet]:
    """Return the parameters of a file, of an on-board log, or of a vehicle in the cache.

    Appends a sentence to `faults` for each cached table that is not complete, unless `incomplete` is given.
    """
    choice = ChosenVehicle.parse(options.vehicle)
    if is_file(where):
        file = open_file(where, partial=incomplete)
        return list(file.sets) if choice.is_all else [choose(file, choice.component, choice.system)]
    if options.place is False:
        raise UsageError(f"{where!r} is a vehicle in the cache, which --no-cache excludes")
    tables = tables_of(options.cache, where, choice.component, extended=extended)
    if not choice.is_all and len(tables) > 1:
        pilots = [table for table in tables if table.component == AUTOPILOT]
        if not pilots:
            known = ", ".join(f"{table.system}/{table.component}" for table in tables)
            raise UsageError(f"no autopilot is among {known}; name one of them, or use --vehicle all")
        tables = pilots
    sets = []
    for table in tables:
        try:
            sets.append(cached_set(table, extended=extended, partial=incomplete))
        except NotInCache as error:
            faults.append(f"{error}; {INCOMPLETE_HINT}")
    return sets


def _writable(params: ParamSet, file_format: FileFormat) -> ParamSet:
    """Return a set without what the format cannot hold."""
    kept, left_out = writable(params, file_format)
    if left_out:
        names = first_of(left_out, NAMES_SHOWN_MAX)
        report(f"{address(params)}: left out, as only a .json file can hold them: {names}")
    return kept


def _chosen(sets: Sequence[ParamSet], only: Sequence[str]) -> list[ParamSet]:
    """Return the sets with only the parameters that names and patterns choose, without empty sets.

    Raises:
        UsageError: a name or pattern fits no parameter of any set.
    """
    names = NameChoice(only).choose({name for each in sets for name in each}) if sets else ()
    parts = [replace(each, params={n: param for n, param in each.items() if n in names}) for each in sets]
    return [each for each in parts if each]


def _by_file(pattern: str, sets: Sequence[ParamSet]) -> dict[Path, list[ParamSet]]:
    """Return the sets of each file: those of a vehicle share one if the name has a placeholder.

    Raises:
        UsageError: the name has {uid}, and a set is of a vehicle that reports no hardware id.
    """
    files: dict[Path, list[ParamSet]] = {}
    for each in sets:
        name = pattern.replace("{system}", str(each.system))
        if "{uid}" in name:
            uid = None if each.identity is None else each.identity.uid
            if uid is None:
                raise UsageError(f"{address(each)} does not report a hardware id, which {pattern} needs")
            name = name.replace("{uid}", uid)
        files.setdefault(Path(name), []).append(each)
    return files


def _show(files: Mapping[Path, Sequence[ParamSet]], file_format: FileFormat, *, as_json: bool) -> None:
    if as_json:
        written = [
            {
                "path": str(file),
                "format": file_format.value,
                "components": [
                    {"system": each.system, "component": each.component, "params": len(each)} for each in sets
                ],
            }
            for file, sets in files.items()
        ]
        print_json(written[0] if len(written) == 1 else {"files": written})
        return
    for file, sets in files.items():
        contents = ", ".join(f"{counted(len(each), noun_of(each))} of {address(each)}" for each in sets)
        say(f"{contents} written to {file} ({file_format})")
