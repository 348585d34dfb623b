"""The subcommand diff: compares the parameters of files, vehicles in the cache, and links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Final

from cyclopts import Parameter

from paramclient.cli.default_sources import STORED_DEFAULTS_HINT, defaults_in
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.file_output import described, value_text
from paramclient.cli.json_apply import diff_json
from paramclient.cli.metadata import MetadataChoice, from_file, known_of_sets, meaning_of, units_of
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import Coloured, print_json, print_table, say
from paramclient.cli.sources import is_file, names_vehicle, resolve_all
from paramclient.errors import UsageError
from paramclient.metadata import Metadata
from paramclient.model.comparison import ChangedSide, Comparison, Difference, DifferenceStatus, compare
from paramclient.model.notation import bits_written
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.provision.vehicle_params import collect_defaults

__all__ = ["diff"]

DEFAULTS: Final = "defaults"
"""The value of --base for the firmware's defaults; a file of this name is `./defaults`."""

MEANING_LENGTH_MAX: Final = 40
"""Characters of the meaning of a value in a table. A bit mask of ArduPilot may have 30 names, and one such
row would make the table wider than every screen."""

_OPTIONS: Final = LinkOptions()


async def diff(
    left: str,
    right: str,
    /,
    *,
    base: str | None = None,
    only: tuple[str, ...] = (),
    partial: bool = False,
    everything: Annotated[bool, Parameter(name="--all")] = False,
    metadata: MetadataChoice = None,
    extended: bool = False,
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
        everything: Also print parameters that do not differ.
        metadata: A file that describes parameters. Default: the stored metadata of the vehicles' firmware.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's. Not needed with a file of them.
    """
    chosen = from_file(metadata, offline=True)
    third_source = [] if base is None or base == DEFAULTS else [base]
    if left == right and not is_file(left) and not names_vehicle(left):
        raise UsageError(
            f"both sides are the vehicle on {left}. Two vehicles of one link are compared in the cache: "
            f"`paramclient fetch {left} --vehicle all`, then `paramclient diff 1 2`"
        )
    first, second, *third = await resolve_all([left, right, *third_source], options, extended=extended)
    is_right_partial = partial and is_file(right) and not is_file(left)
    if is_right_partial:
        first = replace(first, params={name: first[name] for name in first if name in second})
    sides = _Sides([first, second, *third], options, chosen)
    has_defaults = base == DEFAULTS
    before = sides.defaults(first, second) if has_defaults else next(iter(third), None)
    if partial and not is_right_partial:
        second = replace(second, params={name: second[name] for name in second if name in first})
    outcome = compare(first, second, base=before, names=only or None)
    shown = [entry for entry in outcome.entries if everything or entry.is_shown]
    if options.json:
        shown_sides = (sides.left, sides.right, sides.base)
        print_json(diff_json(outcome, *shown_sides, everything=everything, has_defaults=has_defaults))
    else:
        if shown:
            _print(outcome, shown, sides)
        for line in _summary(outcome):
            say(line)
        if not partial and (hint := _partial_hint(outcome, left, right)):
            say(hint)
    return ExitCode.DONE if outcome.is_same else ExitCode.DIFFERENT


class _Sides:
    """The metadata of each side: two versions of a firmware may name a value differently."""

    def __init__(self, sets: Sequence[ParamSet], options: LinkOptions, chosen: Metadata | None) -> None:
        found = known_of_sets(sets, options) if chosen is None else [chosen] * len(sets)
        self.left, self.right, self.base = [*found, found[0] or found[1]][:3]
        self.is_known = any(each is not None for each in found)

    def defaults(self, left: ParamSet, right: ParamSet) -> ParamSet:
        """Return the firmware's defaults of both sides.

        Raises:
            UsageError: they are not known.
        """
        sets = [left, right]
        try:
            return collect_defaults(sets, [*map(defaults_in, (self.left, self.right), sets)])
        except UsageError as error:
            raise UsageError(f"{error}; {STORED_DEFAULTS_HINT}") from None

    def units(self, entry: Difference) -> str:
        """Return the units of a parameter, or ""."""
        return units_of(self.left, entry.name) or units_of(self.right, entry.name)


# Tables


def _print(outcome: Comparison, shown: list[Difference], sides: _Sides) -> None:
    has_base = outcome.base is not None
    columns = [
        *("name", "left", "right", *(["base"] if has_base else []), *(["units"] if sides.is_known else [])),
        *("is", *(["changed"] if has_base else [])),
    ]
    rows = (_cells(entry, sides, has_base=has_base) for entry in shown)
    print_table(columns, rows, right="left right base")


def _cells(entry: Difference, sides: _Sides, *, has_base: bool) -> list[object]:
    """Return a row; with a base, values that differ from it are coloured, else values that differ."""
    left, right = _shown(entry.left, sides.left), _shown(entry.right, sides.right)
    if left == right and not entry.is_same:
        left, right = _with_bits(entry.left), _with_bits(entry.right)
    style = "bold red" if entry.changed_side is ChangedSide.CONFLICT else _STYLES[entry.status]
    side = entry.changed_side
    both_sides = (ChangedSide.BOTH, ChangedSide.CONFLICT, None)
    base = _shown(entry.base, sides.base)
    return [
        entry.name,
        None if left is None else Coloured(left, style if side in (ChangedSide.LEFT, *both_sides) else ""),
        None if right is None else Coloured(right, style if side in (ChangedSide.RIGHT, *both_sides) else ""),
        *([base] if has_base else []),
        *([sides.units(entry)] if sides.is_known else []),
        Coloured(_comparison_text(entry), style),
        *([side or "unknown"] if has_base else []),
    ]


def _shown(param: WrittenParam | None, metadata: Metadata | None) -> str | None:
    """Return a value with its meaning, if known: `5 (Loiter)`. `info` prints all names of a bit mask."""
    if param is None:
        return None
    meaning = meaning_of(metadata, param.name, param.settable)
    if len(meaning) > MEANING_LENGTH_MAX:
        meaning = f"{meaning[:MEANING_LENGTH_MAX]}..."
    return f"{value_text(param)} ({meaning})" if meaning else value_text(param)


def _with_bits(param: WrittenParam | None) -> str | None:
    """Return a value with its bits, for two values with the same text that differ, such as NaNs."""
    if param is None:
        return None
    bits = bits_written(param)
    return value_text(param) if bits is None else f"{value_text(param)} = 0x{bits}"


def _comparison_text(entry: Difference) -> str:
    """Return the comparison of an entry in words."""
    more = []
    if entry.types_differ:
        more.append(" and ".join(_type(each) for each in (entry.left, entry.right)))
    if entry.is_rounding:
        more.append("the same as float32")
    return ", ".join([entry.status, *more])


def _type(param: WrittenParam | None) -> str:
    return "" if param is None or param.type is None else param.type.name


def _summary(outcome: Comparison) -> list[str]:
    """Return the lines that name the compared sets, and the numbers of entries of each kind."""
    sides = [("left", outcome.left), ("right", outcome.right)]
    if outcome.base is not None:
        sides.append(("base", outcome.base))
    lines = [f"{side}: {described(params)}" for side, params in sides]
    found = [f"{number} {status}" for status in DifferenceStatus if (number := outcome.counts[status])]
    if retyped := sum(entry.types_differ for entry in outcome.entries):
        found.append(f"{retyped} of another type")
    if outcome.base is not None:
        changed_sides = [
            f"{number} {changed_side}"
            for changed_side in ChangedSide
            if changed_side is not ChangedSide.NEITHER and (number := outcome.changed_sides[changed_side])
        ]
        found.append(f"changed from the base: {', '.join(changed_sides) or 'none'}")
        if unknown := sum(entry.changed_side is None for entry in outcome.entries):
            found.append(f"{unknown} not in the base")
    return [*lines, "; ".join(found)]


def _partial_hint(outcome: Comparison, left: str, right: str) -> str | None:
    """Return a hint at --partial if one source is a file of a few parameters, and the other one a table."""
    for source, other, compared, status in (
        (left, right, outcome.left, DifferenceStatus.ONLY_RIGHT),
        (right, left, outcome.right, DifferenceStatus.ONLY_LEFT),
    ):
        if is_file(source) and not is_file(other) and (more := outcome.counts[status]) > len(compared):
            return f"--partial leaves out the {more} parameters that {source} does not have"
    return None


_STYLES: Final = {
    DifferenceStatus.SAME: "",
    DifferenceStatus.DIFFERENT: "yellow",
    DifferenceStatus.ONLY_LEFT: "red",
    DifferenceStatus.ONLY_RIGHT: "green",
}
"""Styles of rich for each kind of entry."""
