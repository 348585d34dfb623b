"""The subcommand diff: compares the parameters of files, vehicles in the cache, and links."""

from __future__ import annotations

from typing import Final

from paramclient.cli.json_output import diff_json
from paramclient.cli.metadata import (
    METADATA_HINT,
    MetadataFile,
    defaults_in,
    known_of_sets,
    meaning_of,
    units_of,
)
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import Coloured, ExitCode, print_json, print_table, say
from paramclient.cli.sources import described, part_of, resolve_all, value_text
from paramclient.errors import UsageError
from paramclient.metadata import Metadata
from paramclient.model.comparison import ChangedSide, Comparison, Difference, DifferenceStatus, compare
from paramclient.model.paramset import WrittenParam
from paramclient.provision.sources import collect_defaults, is_file, is_offline

DEFAULTS: Final = "defaults"
"""The value of --base for the firmware's defaults; a file of this name is `./defaults`."""

MEANING_LENGTH_MAX: Final = 40
"""Characters of the meaning of a value in a table. A bit mask of ArduPilot may have 30 names, and one such
row would make the table wider than every screen."""
_STYLES: Final = {
    DifferenceStatus.SAME: "",
    DifferenceStatus.DIFFERENT: "yellow",
    DifferenceStatus.ONLY_LEFT: "red",
    DifferenceStatus.ONLY_RIGHT: "green",
}
"""Styles of rich for each kind of entry."""

_OPTIONS: Final = LinkOptions()


async def diff(
    left: str,
    right: str,
    /,
    *,
    base: str | None = None,
    only: tuple[str, ...] = (),
    partial: bool = False,
    metadata: MetadataFile = None,
    options: LinkOptions = _OPTIONS,
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
        metadata: A file that describes parameters. Default: the stored metadata of the vehicles' firmware.
    """
    if left == right and not is_offline(left):
        raise UsageError(
            f"both sides are the vehicle on {left}. Two vehicles of one link are compared in the cache: "
            f"`paramclient fetch {left} --vehicle all`, then `paramclient diff 1 2`"
        )
    given = [left, right, *([] if base in (None, DEFAULTS) else [base or ""])]
    first, second, *third = await resolve_all(given, options)
    if partial and is_file(right) and not is_file(left):
        first = part_of(first, second)
    elif partial:
        second = part_of(second, first)
    known = known_of_sets([first, second, *third], options, metadata)
    before = third[0] if third else None
    if base == DEFAULTS:
        try:
            before = collect_defaults([first, second], [*map(defaults_in, known, (first, second))])
        except UsageError as error:
            raise UsageError(f"{error}; {METADATA_HINT}") from None
        known.append(known[0] or known[1])
    known = [*known, None][:3]
    outcome = compare(first, second, base=before, names=only or None)
    if options.json:
        print_json(diff_json(outcome, known, has_defaults=base == DEFAULTS))
    else:
        _print(outcome, known)
        hint = "" if partial else _partial_hint(outcome, left, right)
        for line in [*_summary(outcome), *filter(None, [hint])]:
            say(line)
    return ExitCode.DONE if outcome.is_same else ExitCode.DIFFERENT


# Tables


def _print(outcome: Comparison, known: list[Metadata | None]) -> None:
    """Print the entries that differ; `known` is the metadata of left, right and base.

    Two versions of a firmware may name a value differently. With a base, values that differ from it are
    coloured, else values that differ.
    """
    rows = []
    for entry in outcome.entries:
        if not entry.is_shown:
            continue
        sides = entry.left, entry.right, entry.base
        left, right, base = (_shown(side, info) for side, info in zip(sides, known, strict=True))
        style = "bold red" if entry.changed_side is ChangedSide.CONFLICT else _STYLES[entry.status]
        cells = [
            text and Coloured(text, "" if entry.changed_side in (other, ChangedSide.NEITHER) else style)
            for text, other in ((left, ChangedSide.RIGHT), (right, ChangedSide.LEFT))
        ]
        units = units_of(known[0], entry.name) or units_of(known[1], entry.name)
        changed = None if outcome.base is None else entry.changed_side or "unknown"
        rows.append([entry.name, *cells, base, units, Coloured(_comparison_text(entry), style), changed])
    if rows:
        columns = ["name", "left", "right", "base", "units", "is", "changed"]
        print_table(columns, rows)


def _shown(param: WrittenParam | None, metadata: Metadata | None) -> str | None:
    """Return a value with its meaning, if known: `5 (Loiter)`. `info` prints all names of a bit mask."""
    if param is None:
        return None
    meaning = meaning_of(metadata, param.name, param.settable) or ""
    if len(meaning) > MEANING_LENGTH_MAX:
        meaning = f"{meaning[:MEANING_LENGTH_MAX]}..."
    return f"{value_text(param)} ({meaning})" if meaning else value_text(param)


def _comparison_text(entry: Difference) -> str:
    """Return the comparison of an entry in words."""
    types = [
        each.type.name for each in (entry.left, entry.right) if each is not None and each.type is not None
    ]
    more = [" and ".join(types)] if entry.types_differ else []
    return ", ".join([entry.status, *more, *["the same as float32"] * entry.is_rounding])


def _summary(outcome: Comparison) -> list[str]:
    """Return the lines that name the compared sets, and the numbers of entries of each kind."""
    sides = {"left": outcome.left, "right": outcome.right, "base": outcome.base}
    lines = [f"{side}: {described(params)}" for side, params in sides.items() if params is not None]
    found = [f"{number} {status}" for status in DifferenceStatus if (number := outcome.counts[status])]
    if retyped := sum(entry.types_differ for entry in outcome.entries):
        found.append(f"{retyped} of another type")
    if outcome.base is not None:
        changed = [
            f"{number} {side}"
            for side in ChangedSide
            if side is not ChangedSide.NEITHER and (number := outcome.changed_sides[side])
        ]
        found.append(f"changed from the base: {', '.join(changed) or 'none'}")
        if unknown := sum(entry.changed_side is None for entry in outcome.entries):
            found.append(f"{unknown} not in the base")
    return [*lines, "; ".join(found)]


def _partial_hint(outcome: Comparison, left: str, right: str) -> str:
    """Return a hint at --partial if one source is a file of a few parameters, and the other one a table."""
    for source, other, compared, status in (
        (left, right, outcome.left, DifferenceStatus.ONLY_RIGHT),
        (right, left, outcome.right, DifferenceStatus.ONLY_LEFT),
    ):
        if is_file(source) and not is_file(other) and (more := outcome.counts[status]) > len(compared):
            return f"--partial leaves out the {more} parameters that {source} does not have"
    return ""
