"""The command save: the parameters of a vehicle, or those last known of one, into a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Final

import anyio
import anyio.to_thread
from cyclopts import Parameter

from paramclient.cli.connection import Session, connect
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.offline import tables_of
from paramclient.cli.options import CacheOptions, LinkOptions
from paramclient.cli.output import print_document, printable, progress_bar, report, say
from paramclient.cli.sources import check_link, confirmed, names_vehicle
from paramclient.client.component import Component
from paramclient.errors import UsageError
from paramclient.files import FileForm, write_file
from paramclient.files.param_file import AUTOPILOT, address, form_of_name
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param
from paramclient.protocol.params.fetch_result import FetchResult
from paramclient.provision.vehicle_params import cached_param_set, select_non_defaults

__all__ = ["save"]

_DEFAULTS: Final = LinkOptions()


async def save(
    where: str,
    file: Path,
    /,
    *,
    form: FileForm | None = None,
    changed: bool = False,
    all_: Annotated[bool, Parameter(name="--all")] = False,
    refresh: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Write the parameters of a vehicle into a file, in the form of any ground station.

    What is there is replaced when all of the new file is on the disk. A table that is not complete is not
    written: exit code 1 says so, as it does with --changed where nothing differs or no defaults are known.

    Args:
        where: The link, such as udpin:0.0.0.0:14550 or sim:px4; or with no link a vehicle in the cache: its
            system id, its hardware id in full, uid: and at least 6 digits of it, or its key.
        file: The file. Its ending names the form: .params, .parm, .param, .pck, .json, .yaml.
        form: The form, where the ending does not name it.
        changed: Only what differs from the firmware's defaults.
        all_: All components of the vehicle, where the form can hold several.
        refresh: Download even what the cache has.
    """
    form = form_of_name(str(file)) if form is None else form
    if form is FileForm.PX4_SCRIPT:
        raise UsageError("start scripts of PX4 are read and not written; choose another form")
    if all_ and options.component is not None:
        raise UsageError("--all and --component exclude each other")
    if names_vehicle(where):
        if refresh:
            raise UsageError("--refresh goes with a link")
        sets, faults = _from_cache(where, options, all_=all_, changed=changed)
    else:
        check_link(where)
        sets, faults = await _from_link(where, options, all_=all_, refresh=refresh, changed=changed)
    for fault in faults:
        report(fault)
    if sets:
        await anyio.to_thread.run_sync(lambda: write_file(file, sets, form=form))
        _tell(file, form, sets, as_json=options.json)
    else:
        report(f"nothing was written to {file}")
    return ExitCode.INCOMPLETE if faults or not sets else ExitCode.DONE


async def _from_link(
    url: str, options: LinkOptions, *, all_: bool, refresh: bool, changed: bool
) -> tuple[list[ParamSet], list[str]]:
    """What the components have given or confirmed in this session, and what is wrong with it."""
    sets: list[ParamSet] = []
    faults: list[str] = []
    async with connect(url, options) as session:
        fetched, silent = await _fetch(session, all_=all_, refresh=refresh)
        faults += silent
        for component, result in fetched:
            found = await confirmed(component, result, session.client.link.name, session.deadline)
            if found.missing:
                who = f"{component.system}/{component.component}"
                faults.append(
                    f"{who} is incomplete: {len(found.missing)} of {result.count} parameters did not come"
                )
            else:
                faults += _add(sets, found.set, found.params, changed=changed)
    return sets, faults


async def _fetch(
    session: Session, *, all_: bool, refresh: bool
) -> tuple[list[tuple[Component, FetchResult]], list[str]]:
    """The components that are meant, with what their fetches brought; and who has not answered."""
    deadline = session.deadline
    if all_ and session.options.split_peers:
        raise UsageError("--all and --split-peers exclude each other: a file has each component once")
    if not all_:
        with progress_bar(f"fetching {session.who}") as progress:
            result = await session.component.fetch_all(
                refresh=refresh, timeout=deadline.left(), progress=progress
            )
        return [(session.component, result)], []
    client, system = session.client, session.component.system
    everything = await client.fetch_all(system, refresh=refresh, timeout=deadline.left())
    fetched = [(client.components[who], everything.results[who]) for who in sorted(everything.results)]
    silent = [f"{who[0]}/{who[1]}: {everything.silent[who]}" for who in sorted(everything.silent)]
    return fetched, silent


def _from_cache(
    vehicle: str, options: LinkOptions, *, all_: bool, changed: bool
) -> tuple[list[ParamSet], list[str]]:
    """What was last known of a vehicle, and what is wrong with it."""
    if options.no_cache or options.system is not None or options.encoding or options.timeout is not None:
        raise UsageError(
            f"--no-cache, --system, --encoding and --timeout go with a link; {vehicle!r} names none"
        )
    tables = tables_of(CacheOptions(cache=options.cache), vehicle, options.component)
    if not all_ and len(tables) > 1:
        pilots = [table for table in tables if table.component == AUTOPILOT]
        if not pilots:
            known = ", ".join(f"{table.system}/{table.component}" for table in tables)
            raise UsageError(f"no autopilot is among {known}; choose with --component, or take --all")
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
        faults += _add(sets, cached_param_set(table), table.params.values(), changed=changed)
    return sets, faults


def _add(sets: list[ParamSet], whole: ParamSet, params: Iterable[Param], *, changed: bool) -> Sequence[str]:
    """Take a set in, or what of it differs from the defaults; say what keeps that from being done."""
    try:
        sets.append(select_non_defaults(whole, params) if changed else whole)
    except UsageError as error:
        return [f"{address(whole)}: {error}"]
    return []


def _tell(file: Path, form: FileForm, sets: Sequence[ParamSet], *, as_json: bool) -> None:
    if as_json:
        from paramclient.documents.command import SavedDoc  # only here: loads pydantic

        print_document(SavedDoc.of(str(file), form, sets))
        return
    held = ", ".join(
        f"{len(each)} parameter{'' if len(each) == 1 else 's'} of {address(each)}" for each in sets
    )
    say(printable(f"{held} written to {file} ({form})"))
