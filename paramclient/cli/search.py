"""The subcommands search and info, which need no link: find parameters by words, and describe one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cache import CachedComponent, HistoryEntry, ParamCache
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.json_cache import HistoryLineJson
from paramclient.cli.json_output import InfoJson, ParamJson
from paramclient.cli.metadata import (
    MetadataChoice,
    from_file,
    how_to_describe,
    known_of_table,
    print_descriptions,
)
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import local_time, print_json, print_line, print_table, printable, report, say
from paramclient.cli.param_names import unmatched_text
from paramclient.cli.sources import tables_in
from paramclient.errors import NotInCache, UsageError
from paramclient.metadata import Metadata, ParamInfo
from paramclient.model.defaults import DefaultSource, default_of
from paramclient.model.identity import autopilot_name, has_autopilot
from paramclient.model.notation import time_text
from paramclient.model.values import check_name, format_value, type_name
from paramclient.model.wording import counted

__all__ = ["info", "search"]

CHANGES_SHOWN: Final = 5
"""Last changes of a parameter that info prints, so that the values stay in view; history prints all."""

_DEFAULTS: Final = CacheOptions()


def search(
    word: str,
    /,
    *words: str,
    vehicle: str | None = None,
    limit: Annotated[int | None, Parameter(validator=Number(gte=1))] = None,
    metadata: MetadataChoice = None,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Find parameters whose name, description or value names contain all words, in upper or lower case.

    Searches the tables in the cache, with the stored metadata of their firmware, and the file of --metadata.
    Parameters with the words in their name come first, then those with the words in the short description.
    Exit code 1: nothing was found.

    Args:
        word: A word or a part of one, or several words in quotes.
        words: Further words.
        vehicle: Search only this vehicle in the cache: 4, px4 or ardupilot, its hardware id, or its key.
        limit: Print at most this number of parameters.
        metadata: A file that describes parameters. Default: the stored metadata of each vehicle's firmware.
    """
    lowered_words = " ".join((word, *words)).casefold().split()
    if not lowered_words:
        raise UsageError("search takes one or more words")
    found = _Known.of(options, vehicle, from_file(metadata, offline=True))
    ranked = sorted(
        (rank, name)
        for name in found.names
        if (rank := _rank(name, found.info(name), lowered_words)) is not None
    )
    names = [name for _, name in ranked[:limit]]
    if options.json:
        print_json({"results": [found.as_json(name) for name in names]})
    elif names:
        print_table(["name", "value", "vehicle", "description"], map(found.cells, names), right="value")
        if len(ranked) > len(names):
            say(f"{len(names)} of {counted(len(ranked), 'parameter')} shown")
    if not names:
        report(f"nothing found; {counted(len(found.names), 'parameter')} searched")
    if found.undescribed and not options.json:
        addresses = ", ".join(f"{each.system}/{each.component}" for each in found.undescribed)
        of_some = f"of {addresses}, " if found.metadata else ""
        request = how_to_describe(found.undescribed, names[0] if names else "")
        say(printable(f"{of_some}only names were searched: {request}"))
    if not names:
        return ExitCode.INCOMPLETE
    return ExitCode.DONE


def info(
    name: str,
    /,
    *,
    vehicle: str | None = None,
    metadata: MetadataChoice = None,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Print the description, range, value names, cached values and last changes of a parameter.

    Args:
        name: The parameter, in upper or lower case.
        vehicle: Only of this vehicle in the cache: 4, px4 or ardupilot, its hardware id, or its key.
        metadata: A file that describes parameters. Default: the stored metadata of each vehicle's firmware.
    """
    check_name(name)
    found = _Known.of(options, vehicle, from_file(metadata, offline=True))
    spelled = {each.upper(): each for each in found.names}.get(name.upper())
    described = None if spelled is None else found.info(spelled)
    if spelled is None:  # a description of a group, FOO{n}_BAR, is not among the names
        described, spelled = found.info(name.upper()), name.upper()
    tables = found.having(spelled)
    if described is None and not tables:
        text = unmatched_text([name], found.names, lambda: ())
        raise NotInCache(f"no parameter of the cache is called {text}")
    with ParamCache(options.cache) as cache:
        changes = {
            (each.key, each.component): cache.history(each.key, each.component, spelled, CHANGES_SHOWN)
            for each in tables
        }
    if options.json:
        values = [_value_json(each, spelled, described, changes[each.key, each.component]) for each in tables]
        known = None if described is None else InfoJson.of(described)
        print_json({"name": spelled, "metadata": known, "vehicles": values})
        return ExitCode.DONE
    print_descriptions([spelled], Metadata.of([described] if described is not None else []))
    if described is None and found.undescribed:
        say(printable(how_to_describe(found.undescribed, spelled)))
    for table in tables:
        print_line("")
        for line in _lines_of(table, spelled, described, changes[table.key, table.component]):
            print_line(line)
    return ExitCode.DONE


@dataclass(frozen=True)
class _Known:
    """The cached tables, and the metadata of each."""

    tables: Sequence[CachedComponent]
    metadata: Sequence[Metadata]
    names: frozenset[str]
    undescribed: Sequence[CachedComponent]
    """The tables without metadata. A camera has none: its firmware has no such metadata."""

    @classmethod
    def of(cls, options: CacheOptions, vehicle: str | None, described: Metadata | None) -> _Known:
        """Load the tables of all vehicles, or of one."""
        with ParamCache(options.cache) as cache:
            summaries = tables_in(cache, vehicle, None)
            summaries.sort(key=lambda each: (each.system, each.component))
            loaded = (cache.load(each.key, each.component) for each in summaries)
            tables = [table for table in loaded if table is not None]
            found = [described] * max(1, len(tables))
            if described is None:
                found = [known_of_table(cache.path, table) for table in tables]
        metadata = list({id(each): each for each in found if each is not None}.values())
        names = {name for table in tables for name in table.params}
        if not tables or described is not None:
            names.update(name for each in metadata for name in each if "{" not in name)
        without = [
            table
            for table, each in zip(tables, found, strict=False)
            if each is None and has_autopilot(table.autopilot)
        ]
        return cls(tables, metadata, frozenset(names), without)

    def info(self, name: str) -> ParamInfo | None:
        """Return the description of a parameter, or None."""
        return next((known for each in self.metadata if (known := each.find(name)) is not None), None)

    def having(self, name: str) -> list[CachedComponent]:
        """Return the tables with this parameter."""
        return [table for table in self.tables if name in table.params]

    def as_json(self, name: str) -> dict[str, object]:
        """Return the JSON of a found parameter; `vehicles` are the keys of the vehicles that have it."""
        described = self.info(name)
        description = None if described is None else described.short_description or None
        vehicles = [each.key for each in self.having(name)]
        return {"name": name, "description": description, "vehicles": vehicles}

    def cells(self, name: str) -> tuple[object, ...]:
        """Return the row of a found parameter, with its value if that is the same on all vehicles."""
        tables = self.having(name)
        described = self.info(name)
        params = [table.params[name] for table in tables]
        values = {format_value(each.settable, each.type_number) for each in params}
        return (
            name,
            f"{len(values)} values" if len(values) > 1 else next(iter(values), None),
            ", ".join(f"{each.system}/{each.component}" for each in tables),
            None if described is None else described.short_description,
        )


def _rank(name: str, described: ParamInfo | None, lowered_words: Iterable[str]) -> int | None:
    """Return 0 if all words are in the name, 1 with the short description, 2 elsewhere; None if not."""
    places = [name.casefold()]
    if described is not None:
        places.append(f"{places[0]} {described.short_description}".casefold())
        named = " ".join([*described.values.values(), *described.bits.values(), described.group])
        places.append(f"{places[1]} {described.long_description} {named}".casefold())
    return next(
        (rank for rank, text in enumerate(places) if all(word in text for word in lowered_words)), None
    )


def _value_json(
    table: CachedComponent, name: str, described: ParamInfo | None, changes: Sequence[HistoryEntry]
) -> dict[str, object]:
    """Return the JSON of the cached value of one vehicle, with its last changes."""
    default = None if described is None else described.default
    return {
        "key": table.key,
        "system": table.system,
        "component": table.component,
        "autopilot": autopilot_name(table.autopilot),
        "heard_at": time_text(table.heard_at[name]),
        "param": ParamJson.of_table(table.params[name], described=default),
        "changes": [HistoryLineJson.of(each) for each in changes],
    }


def _lines_of(
    table: CachedComponent, name: str, described: ParamInfo | None, changes: Sequence[HistoryEntry]
) -> Iterator[str]:
    """Yield the lines about the value of one vehicle."""
    param = table.params[name]
    meaning = "" if described is None else described.text(param.settable) or ""
    yield f"{table.system}/{table.component} {autopilot_name(table.autopilot)} ({table.key})"
    value = format_value(param.settable, param.type_number)
    yield f"  value: {value}{f' ({meaning})' if meaning else ''}, {type_name(param.type_number)}"
    default = default_of(param, None if described is None else described.default)
    if default is not None:
        origin = " (from the metadata)" if default.source is DefaultSource.METADATA else ""
        yield f"  default of the firmware: {format_value(default.value, param.type_number)}{origin}"
    yield f"  heard: {local_time(table.heard_at[name])}"
    for entry in changes:
        new = "removed" if entry.new is None else format_value(entry.new.settable, entry.new.type_number)
        old = format_value(entry.old.settable, entry.old.type_number)
        yield f"  changed: {local_time(entry.at)}  {old} -> {new}  ({entry.by})"
