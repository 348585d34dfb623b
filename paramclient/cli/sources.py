"""The subcommands save and diff; the parameters that an argument names; file names with ids of vehicles."""

from __future__ import annotations

import os
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from functools import partial as bind
from pathlib import Path
from typing import Annotated, Final

import anyio.to_thread
from cyclopts import Parameter

from paramclient.cli.json_output import JsonObject, diff_json, taken
from paramclient.cli.metadata import MetadataFile, defaults_in, known_of_sets, say_sources
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import ExitCode, listed, local_time, print_json, print_table, report, say
from paramclient.cli.session import ChosenVehicle, CommandSession, noun_of, sessions
from paramclient.client.component import Component
from paramclient.errors import UsageError
from paramclient.files import FileFormat, writable, write_file
from paramclient.files.disk import check_folder
from paramclient.files.formats import address, format_of_name
from paramclient.links import LinkKind, parse_link
from paramclient.metadata import Metadata
from paramclient.model.comparison import compare
from paramclient.model.names import counted
from paramclient.model.paramset import ParamSet, default_of
from paramclient.provision import sources

DEFAULTS: Final = "defaults"
"""The value of --base for the firmware's defaults; a file of this name is `./defaults`."""
MEANING_LENGTH_MAX: Final = 40
"""Characters of the meaning of a value in a table. A bit mask of ArduPilot may have 30 names, and one such
row would make the table wider than every screen."""


# Sources


async def resolve_all(texts: Sequence[str], options: LinkOptions, **more: bool) -> list[ParamSet]:
    """Return the parameters of each source: files first, then cached vehicles, then links.

    A text that is given twice is resolved once. If one of the files has extended parameters, those of the
    vehicles are meant too.

    Args:
        texts: the arguments.
        options: --vehicle selects the vehicle of a link, and the component of a file or of the cache.
        more: `writes` and `incomplete`, as in `sets_of`.

    Raises:
        ParamClientError: as from `sets_of`.
    """
    if ChosenVehicle.parse(options.vehicle).is_all:  # these are the vehicles to write to
        options = replace(options, vehicle=None)
    for text in texts:
        check_link(sources.link_of(text))
    found: dict[str, ParamSet] = {}
    each = sorted({*texts}, key=lambda text: (not sources.is_file(text), not sources.is_offline(text), text))
    for text in each:
        (found[text],), _ = await sets_of(text, options, **more)
        options = replace(options, extended=options.extended or found[text].is_extended)
    return [found[text] for text in texts]


async def sets_of(
    text: str, options: LinkOptions, *, writes: bool = False, incomplete: bool = False
) -> tuple[list[ParamSet], bool]:
    """Return the parameters of a source, and whether those of some vehicle could not be read.

    Args:
        text: a file, a vehicle in the cache, or a link.
        options: --vehicle selects the vehicle of a link, the component of a file or of the cache, or all.
        writes: whether the values will be written; see `sessions`.
        incomplete: whether some parameters of a table may be missing.

    Raises:
        UsageError: the text names none of them, or has no parameters for --vehicle.
        VehicleError: some parameters were not received; the message names them.
        ParamClientError: the cache has no such table; the vehicle did not answer; the link failed.
    """
    choice, link = ChosenVehicle.parse(options.vehicle), sources.link_of(text)
    check_link(link)
    if sources.is_offline(text):
        read = bind(sources.read_source, text, component=choice.component, every=choice.is_all)
        read = bind(read, extended=options.extended, incomplete=incomplete, cache=options.place)
        file = await anyio.to_thread.run_sync(read)  # a log of 100 MB takes seconds
        assert file is not None, "it is no link"
        found = [*file.sets] if choice.is_all else [sources.choose(file, choice.component, choice.system)]
        return found, False

    async def fetch(session: CommandSession) -> ParamSet:
        result, source = await session.fetch(), f"link {session.client.link.name}"
        for note in result.notes:
            report(f"{session.label} on {session.client.link.name}: {note}")
        return sources.fetched_set(session.component, result, source=source, partial=incomplete)

    if link.startswith(f"{LinkKind.REPLAY}:"):  # --cache is for other sources, and for metadata
        options = replace(options, cache=None, no_cache=True)
    async with sessions(link, options, writes=writes) as opened:
        done = await opened.work(fetch)
        opened.report_others("fetch --vehicle")
    opened.report_errors()
    return [*done.values()], bool(opened.errors)


def check_link(text: str) -> None:
    """Check that an argument that is neither a file nor a cached vehicle names a link.

    Raises:
        UsageError: it does not; the message lists the links, unless the text can only be a mistyped file or
            vehicle.
    """
    try:
        if not sources.is_offline(text):
            parse_link(text)
    except UsageError as error:
        links = f"; {error}" if ":" in text else ""
        raise UsageError(f"{not_a_file(text)}, nor a vehicle in the cache (cache:VEHICLE){links}") from None


def not_a_file(text: str) -> str:
    """Return why a text names no file, as the beginning of a sentence."""
    return f"{text} is a folder, not a file" if os.path.isdir(text) else f"no such file: {text}"  # noqa: PTH112 - any text


def part_of(params: ParamSet, names: Container[str]) -> ParamSet:
    """Return a set with only the parameters of these names."""
    return replace(params, params={name: param for name, param in params.items() if name in names})


# save


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
    options: LinkOptions = LinkOptions(),
) -> int:
    """Write the parameters of a vehicle to a file, in the file format of any ground station.

    An existing file is replaced once the new one is completely on the disk. An incomplete table of a vehicle
    is written with --incomplete only. Exit code 1: the table is incomplete, or with --changed, no parameter
    differs or the defaults are not known. With --vehicle all, a file with {system} or {uid} in its name
    becomes a file for each vehicle; otherwise the file format must be able to hold several components.

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
    written = file_format or format_of_name(str(file))
    if not is_pattern_name(str(file.parent)):
        check_folder(str(file))
    sets, is_part = await sets_of(where, options, incomplete=incomplete)
    if changed:
        known = known_of_sets(sets, options, metadata)
        differing = [_differing(*each) for each in zip(sets, known, strict=True)]
        sets, is_part = [each for each in differing if each], is_part or None in differing
    if only and sets:
        names = sources.choose_names(only, sets)
        sets = [part for each in sets if (part := part_of(each, names))]
    files: dict[str, list[ParamSet]] = {}
    for each in sets:
        kept, left_out = writable(each, written)
        if left_out:
            report(f"{address(each)}: left out, as {written} cannot hold them: {listed(left_out)}; json can")
        if each.lacks:
            report(f"{address(each)} is incomplete: {each.lacks}")
        files.setdefault(filled(str(file), each, address(each)), []).append(kept)
    found: list[JsonObject] = []
    for path, of_file in files.items():
        await anyio.to_thread.run_sync(bind(write_file, path, of_file, file_format=written))
        members = [taken(each, "system", "component") | {"params": len(each)} for each in of_file]
        found.append({"path": path, "format": written.value, "components": members})
        if not options.json:
            contents = [f"{counted(len(each), noun_of(each))} of {address(each)}" for each in of_file]
            say(f"{', '.join(contents)} written to {path} ({written})")
    if found and options.json:
        print_json(found[0] if len(found) == 1 else {"files": found})
    return ExitCode.DONE if found and not is_part else ExitCode.INCOMPLETE


def _differing(whole: ParamSet, metadata: Metadata | None) -> ParamSet | None:
    """Return the parameters that differ from the defaults; None, and an error line, if none is known to."""
    described = defaults_in(metadata, whole)
    try:
        differing = sources.select_non_defaults(whole, described)
    except UsageError as error:
        report(f"{address(whole)}: {error}")
        return None
    say_sources(address(whole), (default_of(each, described.get(each.name)) for each in differing.values()))
    return differing


# diff


async def diff(
    left: str,
    right: str,
    /,
    *,
    base: str | None = None,
    only: tuple[str, ...] = (),
    partial: bool = False,
    incomplete: bool = False,
    metadata: MetadataFile = None,
    options: LinkOptions = LinkOptions(),
) -> ExitCode:
    """Compare the parameters of two files, links or vehicles in the cache.

    Exit code 0: both have the same names with the same values. Exit code 1: they differ.

    Args:
        left: A parameter file; a vehicle in the cache, as 4, px4 or ardupilot, its hardware id (in full, or
            uid: and at least 6 digits), its key, or cache:VEHICLE; or a link.
        right: A file, a vehicle in the cache, or a link, like LEFT.
        base: A third source, or "defaults" for the firmware's defaults, to see which side differs from it.
        only: Compare only this name or pattern, such as "MC_*". May be given several times.
        partial: Leave out parameters that only the right side has; if the right side is a file and the left
            one is not, those that only the left side has.
        incomplete: Take tables of which parameters are missing.
        metadata: A file that describes parameters. Default: the stored metadata of the vehicles' firmware.
    """
    given = [left, right, *([] if base in (None, DEFAULTS) else [base or ""])]
    first, second, *third = await resolve_all(given, options, incomplete=incomplete)
    if partial and sources.is_file(right) and not sources.is_file(left):
        first = part_of(first, second)
    elif partial:
        second = part_of(second, first)
    known = known_of_sets([first, second, *third], options, metadata)
    before = third[0] if third else None
    if base == DEFAULTS:
        before = sources.collect_defaults([first, second], [*map(defaults_in, known, (first, second))])
        known.append(known[0] or known[1])
    outcome = compare(first, second, base=before, names=only or None)
    found = diff_json(outcome, [*known, None][:3], has_defaults=base == DEFAULTS)
    if options.json:
        print_json(found)
    else:
        sides = {"left": first, "right": second} | ({} if before is None else {"base": before})
        _print(found, sides)
        for side, params in sides.items():
            say(f"{side}: {described(params)}")
        say(_summary(found))
        has_more = any(number for kind, number in found["counts"].items() if kind.startswith("only"))
        if has_more and not partial and sources.is_file(left) != sources.is_file(right):
            say("--partial leaves out the parameters that the file does not have")
    return ExitCode.DONE if outcome.is_same else ExitCode.INCOMPLETE


def _print(found: JsonObject, sides: Mapping[str, ParamSet]) -> None:
    """Print the entries that differ, below the sides with the addresses of their vehicles, if known."""
    rows = []
    for name, entry in found["params"].items():
        side, words = entry["changed_side"], [entry["is"]]
        if entry["types_differ"]:
            words.append(f"{entry['left']['type']} and {entry['right']['type']}")
        if entry["rounding"]:
            words.append("the same as float32")
        values = [_shown(entry[each]) for each in sides]
        changed = None if found["base"] is None else side or "unknown"
        rows.append([name, *values, entry.get("units"), ", ".join(words), changed])
    heads = (f"{side} {address(each)}" if each.system else side for side, each in sides.items())
    print_table(["name", *heads, "units", "is", "changed"], rows)


def _shown(side: JsonObject | None) -> object:
    """Return a value with its meaning, if known: `5 (Loiter)`. `info` prints all names of a bit mask."""
    if side is None:
        return None
    meaning = side.get("text", "")
    if len(meaning) > MEANING_LENGTH_MAX:
        meaning = f"{meaning[:MEANING_LENGTH_MAX]}..."
    return f"{side['value']} ({meaning})" if meaning else side["value"]


def _summary(found: JsonObject) -> str:
    """Return the numbers of entries of each kind."""
    counts, sides = found["counts"], found["changed_sides"]
    other = sum(entry["types_differ"] for entry in found["params"].values())
    words = [f"{number} {kind}" for kind, number in (counts | {"of another type": other}).items() if number]
    if sides is not None:
        sides |= {"not in the base": sum(counts.values()) - sum(sides.values())}
        changed = [f"{number} {side}" for side, number in sides.items() if number and side != "neither"]
        words.append(f"changed from the base: {', '.join(changed) or 'none'}")
    return "; ".join(words)


# Sets in words, and file names for several vehicles


def described(params: ParamSet) -> str:
    """Return a set in words: `903 parameters of 1/1 px4 from link sim:px4, 2026-11-20T18:00:00.000Z`."""
    of = "" if params.component is None else f"of {address(params)}"
    origin = [of, params.autopilot, params.source and f"from {params.source}"]
    lacks = f" (incomplete: {params.lacks})" if params.lacks else ""
    at = "" if params.at is None else f", {local_time(params.at)}"
    return " ".join(filter(None, [counted(len(params), noun_of(params)), *origin])) + at + lacks


def is_pattern_name(name: str) -> bool:
    """Return whether a file name has a placeholder for the ids of the vehicle."""
    return "{uid}" in name or "{system}" in name


def filled(pattern: str, vehicle: Component | ParamSet, label: str) -> str:
    """Return a file name with the placeholders replaced by the ids of a vehicle, which is `label` in words.

    Raises:
        UsageError: the name has `{uid}` or `{system}`, and that of the vehicle is not known.
    """
    uid = None if vehicle.identity is None else vehicle.identity.uid
    if uid is None and "{uid}" in pattern:
        raise UsageError(f"{label} does not report a hardware id, which {pattern} needs")
    if vehicle.system is None and "{system}" in pattern:
        raise UsageError(f"{label} has no system id, which {pattern} needs")
    return pattern.replace("{uid}", uid or "").replace("{system}", str(vehicle.system))
