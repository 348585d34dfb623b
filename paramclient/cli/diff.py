"""The subcommand diff: compares the parameters of files, vehicles in the cache, and links."""

from __future__ import annotations

from typing import Final

from paramclient.cli.json_output import JsonObject, diff_json
from paramclient.cli.metadata import (
    METADATA_HINT,
    MetadataFile,
    defaults_in,
    known_of_sets,
)
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import Coloured, ExitCode, print_json, print_table, say
from paramclient.cli.sources import described, part_of, resolve_all
from paramclient.errors import UsageError
from paramclient.model.comparison import ChangedSide, Comparison, DifferenceStatus, compare
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
    outcome = compare(first, second, base=before, names=only or None)
    found = diff_json(outcome, [*known, None][:3], has_defaults=base == DEFAULTS)
    if options.json:
        print_json(found)
        return ExitCode.DONE if outcome.is_same else ExitCode.DIFFERENT
    _print(found)
    for side, params in (("left", first), ("right", second), ("base", before)):
        if params is not None:
            say(f"{side}: {described(params)}")
    say(_summary(found))
    if not partial and (hint := _partial_hint(outcome, left, right)):
        say(hint)
    return ExitCode.DONE if outcome.is_same else ExitCode.DIFFERENT


# Tables


def _print(found: JsonObject) -> None:
    """Print the entries that differ. With a base, values that differ from it are coloured, else all."""
    rows = []
    for name, entry in found["params"].items():
        side, words = entry["changed_side"], [entry["is"]]
        style = "bold red" if side == ChangedSide.CONFLICT else _STYLES[entry["is"]]
        left, right = (
            text and Coloured(text, "" if side in (other, ChangedSide.NEITHER) else style)
            for text, other in (
                (_shown(entry["left"]), ChangedSide.RIGHT),
                (_shown(entry["right"]), ChangedSide.LEFT),
            )
        )
        if entry["types_differ"]:
            words.append(f"{entry['left']['type']} and {entry['right']['type']}")
        if entry["rounding"]:
            words.append("the same as float32")
        is_ = Coloured(", ".join(words), style)
        changed = None if found["base"] is None else side or "unknown"
        rows.append([name, left, right, _shown(entry["base"]), entry.get("units"), is_, changed])
    if rows:
        print_table(["name", "left", "right", "base", "units", "is", "changed"], rows)


def _shown(side: JsonObject | None) -> str | None:
    """Return a value with its meaning, if known: `5 (Loiter)`. `info` prints all names of a bit mask."""
    if side is None:
        return None
    meaning = side.get("text", "")
    if len(meaning) > MEANING_LENGTH_MAX:
        meaning = f"{meaning[:MEANING_LENGTH_MAX]}..."
    return f"{side['value']} ({meaning})" if meaning else str(side["value"])


def _summary(found: JsonObject) -> str:
    """Return the numbers of entries of each kind."""
    entries, sides = found["params"].values(), found["changed_sides"]
    numbers = [(number, kind) for kind, number in found["counts"].items()]
    numbers.append((sum(entry["types_differ"] for entry in entries), "of another type"))
    words = [f"{number} {kind}" for number, kind in numbers if number]
    if sides is not None:
        changed = [
            f"{number} {side}" for side, number in sides.items() if number and side != ChangedSide.NEITHER
        ]
        words.append(f"changed from the base: {', '.join(changed) or 'none'}")
        if unknown := sum(found["counts"].values()) - sum(sides.values()):
            words.append(f"{unknown} not in the base")
    return "; ".join(words)


def _partial_hint(outcome: Comparison, left: str, right: str) -> str:
    """Return a hint at --partial if one source is a file of a few parameters, and the other one a table."""
    for source, other, compared, status in (
        (left, right, outcome.left, DifferenceStatus.ONLY_RIGHT),
        (right, left, outcome.right, DifferenceStatus.ONLY_LEFT),
    ):
        if is_file(source) and not is_file(other) and (more := outcome.counts[status]) > len(compared):
            return f"--partial leaves out the {more} parameters that {source} does not have"
    return ""
