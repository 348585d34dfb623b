"""The subcommand fleet diff: compares all vehicles in the cache."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from paramclient.cache import FleetDiff, FleetVehicle, Holder, NameSpread, ParamCache
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import CacheOptions, Id
from paramclient.cli.output import local_time, print_document, print_table, report, say
from paramclient.cli.param_names import unmatched_text
from paramclient.errors import NotInCache, UsageError
from paramclient.files.param_file import AUTOPILOT
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.patterns import NameChoice
from paramclient.model.values import Param, ParamType, check_name, format_value
from paramclient.model.wording import counted

__all__ = ["fleet_diff"]

_DEFAULTS: Final = CacheOptions()


def fleet_diff(
    *wanted: str,
    component: Id = None,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Compare parameters of all vehicles in the cache, with each other or with a parameter file.

    Without a file, vehicles that differ from the most common value are printed, and those that lack a
    parameter which another vehicle with the same autopilot has. Exit code 1: some vehicles differ.

    Args:
        wanted: Names of parameters in upper or lower case, or patterns such as 'MC_*', and '*' for all; or
            one parameter file.
        component: Compare this component instead of the autopilot.
    """
    if not wanted:
        raise UsageError("name the parameters to compare, or a parameter file; '*' compares all parameters")
    chosen = _chosen(wanted, component)
    with ParamCache(options.cache) as cache:
        try:
            found = cache.fleet_diff(chosen, component=component)
        except NotInCache:
            if isinstance(chosen, ParamSet):
                raise
            found = cache.fleet_diff(_spelled(cache, chosen, component or AUTOPILOT), component=component)
    if options.json:
        from paramclient.documents.fleet import FleetDiffDoc  # only here: loads pydantic

        print_document(FleetDiffDoc.of(found))
    else:
        _print(found)
    return ExitCode.DIFFERENT if found.differs else ExitCode.DONE


def _chosen(wanted: tuple[str, ...], component: int | None) -> ParamSet | tuple[str, ...]:
    """Return the parameters to compare: those of a file for a component, or names."""
    files = [word for word in wanted if "/" in word or "." in word or Path(word).is_file()]
    if not files:
        return tuple(map(check_name, wanted))
    if len(wanted) > 1:
        raise UsageError(f"{files[0]} is a file: name one file, or parameters, not both")

    from paramclient.files import read_file  # only here: takes long to load

    file = read_file(files[0])
    for note in file.notes:
        report(note)
    return file.choose(component)


def _spelled(cache: ParamCache, wanted: Sequence[str], component: int) -> list[str]:
    """Return the names in the cache that names and patterns choose, in upper or lower case.

    Raises:
        NotInCache: one chooses none. The message suggests similar names.
    """
    _, known = cache.fleet_names(["*"], component=component)
    names: dict[str, None] = {}
    unmatched: list[str] = []
    for text in wanted:
        chosen, without = NameChoice([text]).divide(known)
        names |= dict.fromkeys(sorted(chosen))
        unmatched += without
    if unmatched:
        text = unmatched_text(unmatched, known, lambda: ())
        raise NotInCache(f"no vehicle in the cache {cache.place} has a parameter {text}")
    return list(names)


def _print(found: FleetDiff) -> None:
    rows = [row for each in found.names if each.differs for row in _rows(each, len(found.vehicles))]
    if rows:
        print_table(["name", "value", "vehicles", "since", "vehicle"], rows, right="value vehicles")
    count = sum(each.differs for each in found.names)
    some = f"{count} of {counted(len(found.names), 'parameter')}" if count else "no parameter"
    say(f"{some} {'differ' if count > 1 else 'differs'} among {counted(len(found.vehicles), 'vehicle')}")


def _rows(each: NameSpread, vehicles: int) -> Iterator[tuple[object, ...]]:
    """Yield a row for the wanted or most common value, then a row for each vehicle that differs."""
    name: str | None = each.name
    agreeing = [value for value in each.values if value.agrees]
    if each.wanted is not None:
        count = sum(len(value.holders) for value in agreeing)
        yield name, _written(each.wanted), f"{count} of {vehicles}", None, "wanted"
        name = None
    else:
        for value in agreeing:
            yield name, _value(value.param), f"{len(value.holders)} of {vehicles}", None, "most"
            name = None
    for value in each.values:
        for number, holder in enumerate(() if value.agrees else value.holders):
            count_text = None if number else f"{len(value.holders)} of {vehicles}"
            yield name, _value(value.param), count_text, _since(holder), _vehicle_text(holder.vehicle)
            name = None
    for label, holders in (("lacks it", each.lacking), ("not known", each.unknown)):
        for number, holder in enumerate(holders):
            count_text = None if number else f"{len(holders)} of {vehicles}"
            yield name, label, count_text, _since(holder), _vehicle_text(holder.vehicle)
            name = None


def _since(holder: Holder) -> str | None:
    if holder.since is None:
        return None
    return f"{'' if holder.changed else 'before '}{local_time(holder.since)}"


def _vehicle_text(vehicle: FleetVehicle) -> str:
    return f"{vehicle.system} ({vehicle.key})"


def _written(wanted: WrittenParam) -> str:
    return format_value(
        wanted.settable, ParamType.REAL32 if wanted.type_number is None else wanted.type_number
    )


def _value(param: Param) -> str:
    return format_value(param.settable, param.type_number)
