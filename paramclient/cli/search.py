"""The subcommands search and info, which need no link: find parameters by words, and describe one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from paramclient.cache import CachedComponent, HistoryEntry, ParamCache
from paramclient.cli.cached import load_tables
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.json_output import JsonObject, history_json, info_json, table_param_json
from paramclient.cli.metadata import (
    MetadataChoice,
    from_file,
    how_to_describe,
    known_of_table,
    print_descriptions,
)
from paramclient.cli.options import CacheOptions, Positive
from paramclient.cli.output import local_time, print_json, print_line, print_table, report, say
from paramclient.cli.param_names import unmatched_text
from paramclient.errors import UsageError
from paramclient.metadata import Metadata, ParamInfo
from paramclient.model.defaults import DefaultSource, default_of
from paramclient.model.identity import autopilot_name, has_autopilot
from paramclient.model.notation import time_text
from paramclient.model.values import Param, check_name, format_value
from paramclient.model.wording import counted
from paramclient.provision.sources import tables_in

__all__ = ["info", "search"]

CHANGES_SHOWN: Final = 5
"""Last changes of a parameter that info prints, so that the values stay in view; history prints all."""

_DEFAULTS: Final = CacheOptions()


def search(
    word: str,
    /,
    *words: str,
    vehicle: str | None = None,
    limit: Positive = None,
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
    found = _Known(options, vehicle, from_file(metadata, offline=True))
    ranks = {name: _rank(name, found.info(name), lowered_words) for name in found.names}
    ranked = sorted((rank, name) for name, rank in ranks.items() if rank is not None)
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
        say(f"{of_some}only names were searched: {request}")
    return ExitCode.DONE if names else ExitCode.INCOMPLETE


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
    found = _Known(options, vehicle, from_file(metadata, offline=True))
    # a description of a group, FOO{n}_BAR, is not among the names
    spelled = next((each for each in found.names if each.upper() == name.upper()), name.upper())
    described, tables = found.info(spelled), found.having(spelled)
    if described is None and not tables:
        text = unmatched_text([name], found.names, lambda: ())
        raise UsageError(f"no parameter of the cache is called {text}")
    with ParamCache(options.cache) as cache:
        changes = [cache.history(each.key, each.component, spelled, CHANGES_SHOWN) for each in tables]
    if options.json:
        values = [_value_json(*each, spelled, described) for each in zip(tables, changes, strict=True)]
        known = None if described is None else info_json(described)
        print_json({"name": spelled, "metadata": known, "vehicles": values})
        return ExitCode.DONE
    print_descriptions([spelled], Metadata.of([described] if described is not None else []))
    if described is None and found.undescribed:
        say(how_to_describe(found.undescribed, spelled))
    for each in zip(tables, changes, strict=True):
        print_line("")
        for line in _lines_of(*each, spelled, described):
            print_line(line)
    return ExitCode.DONE


class _Known:
    """The cached tables of all vehicles or of one, and the metadata of each.

    Attributes:
        tables: the tables.
        metadata: all metadata.
        names: the names of the tables; without a table, those of the metadata.
        undescribed: the tables without metadata. A camera has none: its firmware has no such metadata.
    """

    def __init__(self, options: CacheOptions, vehicle: str | None, given: Metadata | None) -> None:
        with ParamCache(options.cache) as cache:
            summaries = sorted(tables_in(cache, vehicle), key=lambda each: (each.system, each.component))
            self.tables = load_tables(cache, summaries)
            found = [given or known_of_table(cache.path, table) for table in self.tables]
        known = [each for each in [given, *found] if each is not None]
        self.metadata = list({id(each): each for each in known}.values())
        self.names = {name for table in self.tables for name in table.params}
        if given is not None:
            self.names.update(name for name in given if "{" not in name)
        self.undescribed = [
            table
            for table, each in zip(self.tables, found, strict=True)
            if each is None and has_autopilot(table.autopilot)
        ]

    def info(self, name: str) -> ParamInfo | None:
        """Return the description of a parameter, or None."""
        return next((known for each in self.metadata if (known := each.find(name)) is not None), None)

    def having(self, name: str) -> list[CachedComponent]:
        """Return the tables with this parameter."""
        return [table for table in self.tables if name in table.params]

    def as_json(self, name: str) -> JsonObject:
        """Return the JSON of a found parameter; `vehicles` are the keys of the vehicles that have it."""
        described = self.info(name)
        description = None if described is None else described.short_description or None
        vehicles = [each.key for each in self.having(name)]
        return {"name": name, "description": description, "vehicles": vehicles}

    def cells(self, name: str) -> tuple[object, ...]:
        """Return the row of a found parameter, with its value if that is the same on all vehicles."""
        tables, described = self.having(name), self.info(name)
        values = {_value(table.params[name]) for table in tables}
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
    table: CachedComponent, changes: Sequence[HistoryEntry], name: str, described: ParamInfo | None
) -> JsonObject:
    """Return the JSON of the cached value of one vehicle, with its last changes."""
    default = None if described is None else described.default
    return {
        "key": table.key,
        "system": table.system,
        "component": table.component,
        "autopilot": autopilot_name(table.autopilot),
        "heard_at": time_text(table.heard_at[name]),
        "param": table_param_json(table.params[name], described=default),
        "changes": [history_json(each) for each in changes],
    }


def _lines_of(
    table: CachedComponent, changes: Sequence[HistoryEntry], name: str, described: ParamInfo | None
) -> Iterator[str]:
    """Yield the lines about the value of one vehicle."""
    param = table.params[name]
    meaning = "" if described is None else described.text(param.settable) or ""
    yield f"{table.system}/{table.component} {autopilot_name(table.autopilot)} ({table.key})"
    yield f"  value: {_value(param)}{f' ({meaning})' if meaning else ''}, {param.type.name}"
    default = default_of(param, None if described is None else described.default)
    if default is not None:
        origin = " (from the metadata)" if default.source is DefaultSource.METADATA else ""
        yield f"  default of the firmware: {format_value(default.value, param.type)}{origin}"
    yield f"  heard: {local_time(table.heard_at[name])}"
    for entry in changes:
        new = "removed" if entry.new is None else _value(entry.new)
        yield f"  changed: {local_time(entry.at)}  {_value(entry.old)} -> {new}  ({entry.by})"


def _value(param: Param) -> str:
    return format_value(param.settable, param.type)
