"""The subcommands search and info, which need no link: find parameters by words, and describe one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from paramclient.cache import CachedComponent, ParamCache
from paramclient.cli.cached import load_tables
from paramclient.cli.json_output import JsonObject, info_json, table_param_json, taken
from paramclient.cli.metadata import (
    METADATA_HINT,
    MetadataChoice,
    from_file,
    known_of_table,
    print_descriptions,
)
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import ExitCode, local_time, print_json, print_line, print_table, report, say
from paramclient.errors import UsageError
from paramclient.metadata import Metadata, ParamInfo
from paramclient.model.identity import autopilot_name, has_autopilot
from paramclient.model.names import NameChoice, counted
from paramclient.model.notation import time_text
from paramclient.model.paramset import default_of
from paramclient.model.values import Param, check_name, format_value
from paramclient.provision.sources import tables_in

_DEFAULTS: Final = CacheOptions()


def search(
    word: str,
    /,
    *words: str,
    vehicle: str | None = None,
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
        metadata: A file that describes parameters. Default: the stored metadata of each vehicle's firmware.
    """
    lowered_words = " ".join((word, *words)).casefold().split()
    if not lowered_words:
        raise UsageError("search takes one or more words")
    known = _Known(options, vehicle, from_file(metadata, offline=True))
    ranks = {name: _rank(name, known.info(name), lowered_words) for name in known.names}
    ranked = sorted((rank, name) for name, rank in ranks.items() if rank is not None)
    names = [name for _, name in ranked]
    if options.json:
        print_json({"results": [known.as_json(name) for name in names]})
    elif names:
        print_table(["name", "value", "vehicle", "description"], map(known.cells, names), right="value")
    if not names:
        report(f"nothing found; {counted(len(known.names), 'parameter')} searched")
    if known.undescribed and not options.json:
        say(f"only names of {known.undescribed} were searched: {METADATA_HINT}")
    return ExitCode.DONE if names else ExitCode.INCOMPLETE


def info(
    name: str,
    /,
    *,
    vehicle: str | None = None,
    metadata: MetadataChoice = None,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Print the description, range, value names and cached values of a parameter.

    Args:
        name: The parameter, in upper or lower case.
        vehicle: Only of this vehicle in the cache: 4, px4 or ardupilot, its hardware id, or its key.
        metadata: A file that describes parameters. Default: the stored metadata of each vehicle's firmware.
    """
    check_name(name)
    known = _Known(options, vehicle, from_file(metadata, offline=True))
    spelled = next((each for each in known.names if each.upper() == name.upper()), name.upper())
    described = known.info(spelled)  # also that of a group, FOO{n}_BAR, which is not among the names
    if described is None:
        NameChoice([name]).choose(known.names, " of the cache")
    found = [(each, each.params[spelled]) for each in known.having(spelled)]
    default = None if described is None else described.default
    if options.json:
        vehicles = [
            {
                **taken(each, "key", "system", "component"),
                "autopilot": autopilot_name(each.autopilot),
                "heard_at": time_text(each.heard_at[spelled]),
                "param": table_param_json(param, described=default),
            }
            for each, param in found
        ]
        print_json({"name": spelled, "metadata": described and info_json(described), "vehicles": vehicles})
        return ExitCode.DONE
    print_descriptions([spelled], Metadata.of([described] if described is not None else []))
    if described is None and known.undescribed:
        say(f"no metadata of {known.undescribed} is known: {METADATA_HINT}")
    if found:
        print_line("")
        columns = ("vehicle", "value", "meaning", "type", "default", "source", "heard", "key")
        print_table(columns, (_cells(*each, described) for each in found), right="value default")
    return ExitCode.DONE


class _Known:
    """The cached tables of all vehicles or of one, and the metadata of each.

    Attributes:
        names: the names of the tables; without a table, those of the metadata.
        undescribed: the vehicles without metadata, in words. A camera has none: its firmware has none.
    """

    def __init__(self, options: CacheOptions, vehicle: str | None, given: Metadata | None) -> None:
        with ParamCache(options.cache) as cache:
            summaries = sorted(
                cache.components() if vehicle is None else tables_in(cache, vehicle),
                key=lambda each: (each.system, each.component),
            )
            self._tables = load_tables(cache, summaries)
            found = [given or known_of_table(cache.path, table) for table in self._tables]
        known = [each for each in [given, *found] if each is not None]
        self._metadata = list({id(each): each for each in known}.values())
        self.names = {name for table in self._tables for name in table.params}
        if given is not None:
            self.names.update(name for name in given if "{" not in name)
        self.undescribed = ", ".join(
            f"{table.system}/{table.component} {autopilot_name(table.autopilot)}"
            for table, each in zip(self._tables, found, strict=True)
            if each is None and has_autopilot(table.autopilot)
        )

    def info(self, name: str) -> ParamInfo | None:
        """Return the description of a parameter, or None."""
        return next((known for each in self._metadata if (known := each.find(name)) is not None), None)

    def having(self, name: str) -> list[CachedComponent]:
        """Return the tables with this parameter."""
        return [table for table in self._tables if name in table.params]

    def as_json(self, name: str) -> JsonObject:
        """Return the JSON of a found parameter; `vehicles` are the keys of the vehicles that have it."""
        described = self.info(name)
        description = None if described is None else described.short_description or None
        return {
            "name": name,
            "description": description,
            "vehicles": [each.key for each in self.having(name)],
        }

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


def _cells(table: CachedComponent, param: Param, described: ParamInfo | None) -> tuple[object, ...]:
    """Return the row of the value of one vehicle."""
    default = default_of(param, None if described is None else described.default)
    return (
        f"{table.system}/{table.component}",
        _value(param),
        None if described is None else described.text(param.settable),
        param.type.name,
        None if default is None else format_value(default.value, param.type),
        None if default is None else default.source,
        local_time(table.heard_at[param.name]),
        table.key,
    )


def _value(param: Param) -> str:
    return format_value(param.settable, param.type)
