"""The subcommand save: writes the parameters of a vehicle, the cache, a log or a file to a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import anyio.to_thread
from cyclopts import Parameter

from paramclient.cli.json_output import taken
from paramclient.cli.metadata import MetadataFile, defaults_in, known_of_sets, no_defaults, say_sources
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import LINE_NAMES_MAX, ExitCode, print_json, report, say
from paramclient.cli.session import ChosenVehicle, sessions
from paramclient.cli.sources import check_link, filled, noun_of, part_of, whole_table, without_cache
from paramclient.errors import UsageError, VehicleError
from paramclient.files import FileFormat, writable, write_file
from paramclient.files.formats import address, format_of_name
from paramclient.metadata import Metadata
from paramclient.model.names import NameChoice, counted, first_of
from paramclient.model.paramset import ParamSet, default_of
from paramclient.provision.sources import choose, is_offline, link_of, read_source, select_non_defaults

_DEFAULTS: Final = LinkOptions()


async def save(
    where: str,
    file: Path,
    /,
    *,
    file_format: Annotated[FileFormat | None, Parameter(name="--format")] = None,
    changed: bool = False,
    only: tuple[str, ...] = (),
    incomplete: bool = False,
    metadata: MetadataFile = None,
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
        incomplete: Write the parameters that were received where others were not; the file names these.
        metadata: With --changed, a file with the firmware's defaults. Default: the stored metadata of the
            firmware.
    """
    if metadata is not None and not changed:
        raise UsageError("--metadata gives the defaults for --changed")
    written = file_format or format_of_name(str(file))
    try:
        sets, is_part = await _sets_of(where, options, incomplete=incomplete)
    except VehicleError as error:  # the table is incomplete
        hint = f"{error}; --incomplete writes what was received"
        raise VehicleError(hint, system=error.system, component=error.component) from None
    if changed:
        given, known = sets, known_of_sets(sets, options, metadata)
        sets = [each for whole, info in zip(given, known, strict=True) if (each := _differing(whole, info))]
        is_part = is_part or len(sets) < len(given)
    if only:
        names = NameChoice(only).choose({name for each in sets for name in each}) if sets else ()
        sets = [each for whole in sets if (each := part_of(whole, names))]
    files: dict[Path, list[ParamSet]] = {}
    for each in sets:
        uid = None if each.identity is None else each.identity.uid
        path = Path(filled(str(file), each.system, uid, address(each)))
        kept, left_out = writable(each, written)
        if left_out:
            listed = first_of(left_out, LINE_NAMES_MAX)
            report(f"{address(each)}: left out, as only a .json file can hold them: {listed}")
        files.setdefault(path, []).append(kept)
    for path, of_file in files.items():
        await anyio.to_thread.run_sync(partial(write_file, path, of_file, file_format=written))
    if files:
        _show(files, written, as_json=options.json)
    else:
        report(f"nothing was written to {file}")
    return ExitCode.DONE if files and not is_part else ExitCode.INCOMPLETE


async def _sets_of(where: str, options: LinkOptions, *, incomplete: bool) -> tuple[list[ParamSet], bool]:
    """Return the sets of the vehicles that --vehicle names, and whether those of some could not be read."""
    choice, link = ChosenVehicle.parse(options.vehicle), link_of(where)
    if is_offline(where):
        found = read_source(
            where,
            component=choice.component,
            every=choice.is_all,
            extended=options.extended,
            incomplete=incomplete,
            cache=options.place,
        )
        assert found is not None, "it is no link"
        return [*found.sets] if choice.is_all else [choose(found, choice.component, choice.system)], False

    check_link(link)
    async with sessions(link, without_cache(link, options)) as opened:
        done = await opened.work(partial(whole_table, partial=incomplete))
        opened.report_others()
    for session, error in opened.errors.items():
        report(f"{session.address}: {error}")
    return [*done.values()], bool(opened.errors)


def _differing(whole: ParamSet, metadata: Metadata | None) -> ParamSet | None:
    """Return the parameters that differ from the defaults; None, and an error line, if none is known to."""
    described = defaults_in(metadata, whole)
    try:
        differing = select_non_defaults(whole, described)
    except UsageError as error:
        report(f"{address(whole)}: {no_defaults() if str(error) in no_defaults() else error}")
        return None
    say_sources(address(whole), (default_of(each, described.get(each.name)) for each in differing.values()))
    return differing


def _show(files: Mapping[Path, Sequence[ParamSet]], file_format: FileFormat, *, as_json: bool) -> None:
    if as_json:
        written = [
            {
                "path": str(file),
                "format": file_format.value,
                "components": [taken(each, "system", "component") | {"params": len(each)} for each in sets],
            }
            for file, sets in files.items()
        ]
        print_json(written[0] if len(written) == 1 else {"files": written})
        return
    for file, sets in files.items():
        contents = ", ".join(f"{counted(len(each), noun_of(each))} of {address(each)}" for each in sets)
        say(f"{contents} written to {file} ({file_format})")
