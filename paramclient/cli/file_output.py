"""Tables and texts for parameters of files and of compared sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from paramclient.cli.default_sources import STORED_DEFAULTS_HINT, defaults_in, report_no_defaults, say_sources
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.json_output import SetJson
from paramclient.cli.output import local_time, print_json, print_table, printable, say
from paramclient.files import ParamFile
from paramclient.files.formats import address
from paramclient.metadata import Metadata
from paramclient.model.comparison import non_defaults
from paramclient.model.defaults import Default, add_defaults, default_of
from paramclient.model.identity import autopilot_name
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, WireValue, format_value, type_name
from paramclient.model.wording import counted

__all__ = ["described", "noun_of", "show_file", "value_text"]


def show_file(
    file: ParamFile,
    known: Callable[[Sequence[ParamSet]], Sequence[Metadata | None]],
    *,
    changed: bool,
    json: bool,
) -> ExitCode:
    """Print the parameters of a file; see `paramclient show`.

    Args:
        file: the file.
        known: returns the metadata of each set; called with `changed` only.
        changed: print only the parameters that differ from the firmware's defaults.
        json: print JSON.
    """
    sets = file.sets
    shown = [*sets]
    defaults: list[dict[str, Default]] = [{} for _ in sets]
    if changed:
        shown, defaults = [], []
        for each, metadata in zip(sets, known(sets), strict=True):
            more = defaults_in(metadata, each)
            filled = add_defaults(each, more)
            if any(param.default is not None for param in filled.values()):
                differing = non_defaults(filled)
                shown.append(differing)
                known_defaults = {name: default_of(each[name], more.get(name)) for name in differing}
                defaults.append({name: found for name, found in known_defaults.items() if found is not None})
    if json:
        components = [
            SetJson.with_sources(each, {name: default.source.value for name, default in of_set.items()})
            for each, of_set in zip(shown, defaults, strict=True)
        ]
        print_json({"file": file.source, "format": file.file_format.value, "components": components})
    else:
        for each, of_set in zip(shown, defaults, strict=True):
            _print_set(each, changed=changed)
            say_sources(address(each), of_set.values())
    if changed and not shown:
        report_no_defaults(STORED_DEFAULTS_HINT)
        return ExitCode.INCOMPLETE
    return ExitCode.DONE


def described(params: ParamSet) -> str:
    """Return a set in words: `903 parameters of 1/1 px4 from link sim:px4, 2026-11-20T18:00:00.000Z`."""
    origin = [
        "" if params.component is None and params.system is None else f"of {address(params)}",
        "" if params.identity is None else autopilot_name(params.identity.autopilot),
        f"from {params.source}" if params.source else "",
    ]
    at = "" if params.at is None else f", {local_time(params.at)}"
    return " ".join(filter(None, [counted(len(params), noun_of(params)), *origin])) + at


def noun_of(params: ParamSet) -> str:
    """Return the parameters of a set in words, in the singular."""
    return "extended parameter" if params.is_extended else "parameter"


def value_text(param: WrittenParam) -> str:
    """Return a parameter's value as text."""
    return _text(param.settable, param)


_COLUMNS: Final = ("name", "value", "default", "type", "comment")
"""Columns of the table of a set."""


def _print_set(params: ParamSet, *, changed: bool) -> None:
    """Print the table of a set, without empty columns."""
    rows = [
        (
            param.name,
            value_text(param),
            None if param.default is None else _text(param.default, param),
            None if param.type_number is None else type_name(param.type_number),
            param.comment or None,
        )
        for param in params.values()
    ]
    kept = [
        place
        for place, column in enumerate(_COLUMNS)
        if place < 2 or any(row[place] is not None for row in rows)
    ]
    print_table(
        [_COLUMNS[place] for place in kept],
        ([row[place] for place in kept] for row in rows),
        right="value default",
    )
    say(printable(f"{described(params)}{', those that differ from their default' if changed else ''}"))


def _text(value: WireValue, param: WrittenParam) -> str:
    return format_value(value, ParamType.REAL32 if param.type_number is None else param.type_number)
