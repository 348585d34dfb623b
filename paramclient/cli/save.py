"""The subcommand save: writes the parameters of a vehicle, the cache, a log or a file to a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Final, Literal, TypeAlias

import anyio
import anyio.to_thread
from cyclopts import Parameter

from paramclient.cli.default_sources import (
    DEFAULTS_HINT,
    STORED_DEFAULTS_HINT,
    defaults_in,
    find_defaults,
    say_sources,
)
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.extended import is_extended_link, is_extended_source, save_extended
from paramclient.cli.metadata import MetadataChoice, from_file, known_of_sets
from paramclient.cli.offline import tables_of
from paramclient.cli.options import CacheOptions, LinkOptions
from paramclient.cli.output import print_json, printable, progress_bar, report, say
from paramclient.cli.session import CommandSession, connect
from paramclient.cli.sources import check_link, choose, collect_confirmed, is_file, names_vehicle, open_file
from paramclient.cli.targets import find_vehicles
from paramclient.client.component import Component
from paramclient.errors import UsageError
from paramclient.files import FileFormat, write_file
from paramclient.files.formats import format_of_name
from paramclient.files.param_file import AUTOPILOT, address
from paramclient.metadata import Metadata
from paramclient.model.defaults import default_of
from paramclient.model.paramset import ParamSet
from paramclient.model.patterns import NameChoice
from paramclient.model.wording import counted
from paramclient.protocol.fetch import FetchResult
from paramclient.provision.vehicle_params import NO_DEFAULTS, cached_param_set, select_non_defaults

__all__ = ["save"]

SaveFormat: TypeAlias = Literal["qgc", "parm", "mission-planner", "pck", "json"]
"""The file formats that can be written: all but PX4's start scripts."""

_DEFAULTS: Final = LinkOptions()


async def save(
    where: str,
    file: Path,
    /,
    *,
    file_format: Annotated[SaveFormat | None, Parameter(name="--format")] = None,
    changed: bool = False,
    only: Annotated[tuple[str, ...], Parameter(show_default=False)] = (),
    all_: Annotated[bool, Parameter(name="--all")] = False,
    refresh: bool = False,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Write the parameters of a vehicle to a file, in the file format of any ground station.

    An existing file is replaced once the new one is completely on the disk. An incomplete table is not
    written. Exit code 1: the table is incomplete, or with --changed, no parameter differs or the defaults are
    not known.

    Args:
        where: The link, such as udpin:0.0.0.0:14550 or sim:px4; an on-board log (.bin, .ulg), for the values
            at its end, or another parameter file; or a vehicle in the cache: 4 or 4/1, px4 or ardupilot, its
            hardware id (in full, or uid: and at least 6 digits), or its key.
        file: The file. Its extension determines the file format: .params, .parm, .param, .pck, .json.
        file_format: The file format, if the extension does not determine it.
        changed: Write only parameters that differ from the firmware's defaults: those of the vehicle, else
            those of its metadata.
        only: Write only this name or pattern, such as "MC_*". May be given several times.
        all_: Write all components of every vehicle heard within 3 s, or of the one with --system.
            A file with {system} or {uid} in its name becomes a file for each vehicle; otherwise the file
            format must be able to hold several components.
        refresh: Download all parameters even if the cache is up to date.
        metadata: With --changed, a file with the firmware's defaults; or vehicle, to download the vehicle's
            own metadata. Default: the stored metadata of the firmware; else that of the vehicle if it can be
            downloaded in 2 s.
        extended: Use extended parameters (PARAM_EXT_*), such as those of a camera.
    """
    extended = extended or is_extended_source(where)
    if extended or (not (changed or all_ or refresh or only) and await is_extended_link(where, options)):
        if changed or all_ or only:
            raise UsageError("--changed, --only and --all are for plain parameters")
        return await save_extended(
            where, file, None if file_format is None else FileFormat(file_format), options
        )
    if metadata is not None and not changed:
        raise UsageError("--metadata gives the defaults for --changed")
    written = format_of_name(str(file)) if file_format is None else FileFormat(file_format)
    if all_ and options.component is not None:
        raise UsageError("--all and --component exclude each other")
    if is_file(where):
        if refresh:
            raise UsageError(f"--refresh needs a link; {where!r} is a file")
        chosen = _Changed(changed, metadata, from_file(metadata, offline=True), STORED_DEFAULTS_HINT)
        sets, faults = _from_file(where, options, chosen, all_=all_)
    elif names_vehicle(where, options.cache):
        if refresh:
            raise UsageError(f"--refresh needs a link; {where!r} is a vehicle in the cache")
        chosen = _Changed(changed, metadata, from_file(metadata, offline=True), STORED_DEFAULTS_HINT)
        sets, faults = _from_cache(where, options, chosen, all_=all_)
    else:
        check_link(where)
        chosen = _Changed(changed, metadata, from_file(metadata), DEFAULTS_HINT)
        sets, faults = await _from_link(where, options, chosen, all_=all_, refresh=refresh)
    for fault in faults:
        report(fault)
    sets = _chosen(sets, only) if only else sets
    files = _by_file(str(file), sets) if all_ else {file: sets}
    if sets:
        for path, each in files.items():
            await anyio.to_thread.run_sync(partial(write_file, path, each, file_format=written))
        _show(files, written, as_json=options.json)
    else:
        report(f"nothing was written to {file}")
    return ExitCode.INCOMPLETE if faults or not sets else ExitCode.DONE


@dataclass(frozen=True, slots=True)
class _Changed:
    """Whether only parameters that differ from the firmware's defaults are written.

    Attributes:
        is_chosen: whether they are.
        choice: the value of --metadata.
        given: the metadata of the file that it names, or None.
        hint: what to do if no defaults are known.
    """

    is_chosen: bool
    choice: str | None
    given: Metadata | None
    hint: str

    def known_of(self, sets: Sequence[ParamSet], options: LinkOptions) -> list[Metadata | None]:
        """Return the metadata of each set, without a link."""
        if not self.is_chosen or self.given is not None:
            return [self.given] * len(sets)
        return known_of_sets(sets, options)

    def add(
        self, sets: list[ParamSet], whole: ParamSet, described: Mapping[str, int | float]
    ) -> Sequence[str]:
        """Add a set, or its non-default parameters if chosen; return the sentences on a failure."""
        try:
            sets.append(select_non_defaults(whole, described) if self.is_chosen else whole)
        except UsageError as error:
            hint = f"; {self.hint}" if str(error) == NO_DEFAULTS else ""
            return [f"{address(whole)}: {error}{hint}"]
        if self.is_chosen:
            written = sets[-1].values()
            say_sources(address(whole), [default_of(each, described.get(each.name)) for each in written])
        return []


async def _from_link(
    url: str, options: LinkOptions, changed: _Changed, *, all_: bool, refresh: bool
) -> tuple[list[ParamSet], list[str]]:
    """Return the parameters received or confirmed in this session, and sentences on incomplete tables."""
    sets: list[ParamSet] = []
    faults: list[str] = []
    async with connect(url, options) as session:
        fetched, silent = await _fetch(session, all_=all_, refresh=refresh)
        faults += silent
        for component, result in fetched:
            found = await collect_confirmed(component, result, session.client.link.name, session.deadline)
            if found.missing:
                faults.append(
                    f"{component.system}/{component.component} is incomplete: {len(found.missing)} of "
                    f"{result.count} parameters were not received"
                )
            else:
                described: Mapping[str, int | float] = {}
                if changed.is_chosen:
                    params = [component.params[name] for name in found.set if name in component.params]
                    one = replace(session, component=component)
                    described = await find_defaults(one, changed.choice, changed.given, params)
                faults += changed.add(sets, found.set, described)
        if not all_:
            await session.report_others(has_all=True)
    return sets, faults


async def _fetch(
    session: CommandSession, *, all_: bool, refresh: bool
) -> tuple[list[tuple[Component, FetchResult]], list[str]]:
    """Return the components to save with the results of their fetches, and sentences on silent ones."""
    deadline = session.deadline
    if all_ and session.options.split_peers:
        raise UsageError("--all and --split-peers exclude each other: a file has each component once")
    if not all_:
        with progress_bar(f"fetching {session.label}") as progress:
            result = await session.component.fetch_all(
                refresh=refresh, timeout=deadline.left(), progress=progress
            )
        return [(session.component, result)], []
    client, system = session.client, session.options.system
    if system is None:
        await find_vehicles(client, None, None, deadline)
    everything = await client.fetch_all(system, refresh=refresh, timeout=deadline.left())
    fetched = [(client.components[each], everything.results[each]) for each in sorted(everything.results)]
    silent = [f"{each[0]}/{each[1]}: {everything.silent[each]}" for each in sorted(everything.silent)]
    return fetched, silent


def _from_file(
    path: str, options: LinkOptions, changed: _Changed, *, all_: bool
) -> tuple[list[ParamSet], list[str]]:
    """Return the parameters of a file or an on-board log, and sentences on sets without changes."""
    file = open_file(path)
    chosen = file.sets if all_ else [choose(file, options.component, options.system)]
    sets: list[ParamSet] = []
    faults: list[str] = []
    for each, known in zip(chosen, changed.known_of(chosen, options), strict=True):
        faults += changed.add(sets, each, defaults_in(known, each))
    return sets, faults


def _from_cache(
    vehicle: str, options: LinkOptions, changed: _Changed, *, all_: bool
) -> tuple[list[ParamSet], list[str]]:
    """Return the cached parameters of a vehicle, and sentences on incomplete tables."""
    if options.no_cache or options.system is not None or options.encoding or options.timeout is not None:
        raise UsageError(
            "--no-cache, --system, --encoding and --timeout need a link; "
            f"{vehicle!r} is a vehicle in the cache"
        )
    tables = tables_of(CacheOptions(cache=options.cache), vehicle, options.component)
    if not all_ and len(tables) > 1:
        pilots = [table for table in tables if table.component == AUTOPILOT]
        if not pilots:
            known = ", ".join(f"{table.system}/{table.component}" for table in tables)
            raise UsageError(f"no autopilot is among {known}; choose one with --component, or use --all")
        tables = pilots
    sets: list[ParamSet] = []
    faults: list[str] = []
    for table in tables:
        if not table.complete:
            of = "" if table.count is None else f" of {table.count}"
            faults.append(
                f"{table.system}/{table.component} is incomplete: "
                f"{table.size}{of} parameters are in the cache"
            )
            continue
        whole = cached_param_set(table)
        (metadata,) = changed.known_of([whole], options)
        faults += changed.add(sets, whole, defaults_in(metadata, whole))
    return sets, faults


def _chosen(sets: Sequence[ParamSet], only: Sequence[str]) -> list[ParamSet]:
    """Return the sets with only the parameters that names and patterns choose, without empty sets.

    Raises:
        UsageError: a name or pattern fits no parameter of any set.
    """
    names, unmatched = NameChoice(only).choose({name for each in sets for name in each})
    if unmatched and sets:
        raise UsageError(f"no parameter is called {unmatched}")
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
        contents = ", ".join(f"{counted(len(each), 'parameter')} of {address(each)}" for each in sets)
        say(printable(f"{contents} written to {file} ({file_format})"))
