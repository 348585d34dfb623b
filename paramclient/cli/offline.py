"""The subcommands show and cache (list, path, remove), which need no link."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from paramclient.cache import CachedComponent, CachedSummary, ParamCache
from paramclient.cli.default_sources import STORED_DEFAULTS_HINT, defaults_in, report_no_defaults, say_sources
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.file_output import show_file
from paramclient.cli.json_cache import SummaryJson, TableJson
from paramclient.cli.json_output import ParamJson
from paramclient.cli.logs import cache_of_log
from paramclient.cli.metadata import (
    DESCRIBED_COLUMNS,
    MetadataChoice,
    described_cells,
    from_file,
    known_of_table,
    print_descriptions,
)
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import (
    by_index,
    default_text,
    local_time,
    print_json,
    print_line,
    print_table,
    printable,
    say,
)
from paramclient.cli.param_names import cached_names, check_given, unmatched_text
from paramclient.cli.sources import component_of, is_file, open_file, source_of, tables_in
from paramclient.errors import NotInCache, UnknownVehicle, UsageError
from paramclient.metadata import Metadata, MetadataStore
from paramclient.model.defaults import add_default, default_of
from paramclient.model.identity import autopilot_name
from paramclient.model.names import NameChoice
from paramclient.model.notation import hash_text
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param, format_value, type_name
from paramclient.model.wording import counted

__all__ = [
    "cache_list",
    "cache_path",
    "cache_remove",
    "show",
    "tables_of",
]

_DEFAULTS: Final = CacheOptions()


def show(
    vehicle: str | None = None,
    /,
    *names: str,
    changed: bool = False,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Print the cached parameters of a vehicle, or those of a parameter file or a telemetry log.

    With --changed, exit code 1: the firmware's defaults are not known.

    Args:
        vehicle: A parameter file, or - for the standard input; a log (.bin, .ulg, .tlog); a vehicle in the
            cache: 4 or 4/1, px4 or ardupilot, its hardware id (in full, or uid: and at least 6 digits) or its
            key, also with the prefix cache:.
        changed: Print only parameters that differ from the firmware's defaults: those of the vehicle, else
            those of its metadata.
        names: Print only these parameters of a vehicle, with their metadata: names in upper or lower case, or
            patterns such as "MC_*".
        metadata: A file that describes parameters. Default: the stored metadata of the vehicle's firmware.
            With a parameter file only for --changed.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    vehicle = None if vehicle is None else source_of(vehicle)
    if vehicle is not None and is_file(vehicle):
        if names or (metadata is not None and not changed):
            raise UsageError(
                "names, and --metadata without --changed, go with a vehicle in the cache, not with a "
                "parameter file"
            )
        given = from_file(metadata, offline=True)

        def known(sets: Sequence[ParamSet]) -> list[Metadata | None]:
            store = MetadataStore.beside(ParamCache(options.cache).path)
            return store.known_of_sets(sets) if given is None else [given] * len(sets)

        return show_file(open_file(vehicle, partial=True), known, changed=changed, json=options.json)
    name_patterns = tuple(check_given(names))
    described = from_file(metadata, offline=True)
    is_log = vehicle is not None and vehicle.lower().startswith("replay:")
    with _open(options) if not is_log or vehicle is None else cache_of_log(vehicle) as cache:
        summaries = _tables_to_show(cache, None if is_log else vehicle, extended=extended)
        extended_sizes = _extended_sizes(cache)
        is_list = vehicle is None and len(summaries) > 1 and not options.json
        tables = [] if is_list else _load(cache, summaries, extended=extended)
        _check_known(cache, name_patterns, [name for table in tables for name in table.params])
    views = [_View.of(table, name_patterns, described, cache, changed=changed) for table in tables]
    if options.json:
        print_json({"components": [view.as_json() for view in views]})
    elif is_list:
        _print_summaries(summaries, extended_sizes)
        say("paramclient show VEHICLE prints the table of one vehicle, by its system id or its key")
    elif not summaries:
        say(f"the cache {printable(cache.place)} is empty")
    for view in [] if options.json else views:
        _print_table(view)
        table = view.table
        if not table.size and (number := extended_sizes.get((table.key, table.component))):
            say(f"{number} extended parameters: --extended prints them")
    if changed and tables and not any(view.has_defaults for view in views):
        report_no_defaults(STORED_DEFAULTS_HINT)
        return ExitCode.INCOMPLETE
    return ExitCode.DONE


def cache_list(*, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """List the tables in the cache, most recently received vehicles first."""
    with _open(options) as cache:
        summaries, extended = cache.components(), _extended_sizes(cache)
    if options.json:
        components = [SummaryJson.of(each, extended.get((each.key, each.component))) for each in summaries]
        print_json({"path": cache.place, "components": components})
    elif summaries:
        _print_summaries(summaries, extended)
    else:
        say(f"the cache {printable(cache.place)} is empty")
    return ExitCode.DONE


def cache_path(*, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """Print the path or the URL of the cache."""
    with _open(options) as cache:
        path = cache.place
    if options.json:
        print_json({"path": path})
    else:
        print_line(path)
    return ExitCode.DONE


def cache_remove(vehicle: str, /, *, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """Remove a vehicle from the cache: its tables and their history.

    Args:
        vehicle: A vehicle in the cache: 4, px4 or ardupilot, its hardware id (in full, or uid: and at least 6
            digits), or its key; or 4/1, to remove only the table of this component.
    """
    with _open(options) as cache:
        key = tables_in(cache, vehicle)[0].key
        removed = cache.remove(key, component_of(vehicle))
    if options.json:
        print_json({"key": key, "removed": removed})
    else:
        print_line(f"removed {counted(removed, 'table')} of {key}")
    return ExitCode.DONE


def tables_of(
    cache: str | None, vehicle: str, component: int | None, *, extended: bool
) -> list[CachedComponent]:
    """Return the cached tables of a vehicle, or that of one of its components.

    Raises:
        NotInCache, UnknownVehicle, AmbiguousVehicle: as `tables_in`.
        CacheError: the cache cannot be read.
    """
    with ParamCache(cache) as opened:
        summaries = tables_in(opened, vehicle, component, extended=extended)
        return _load(opened, summaries, extended=extended)


def _tables_to_show(cache: ParamCache, vehicle: str | None, *, extended: bool) -> list[CachedSummary]:
    """Return the tables that the arguments of show name, as `tables_in` does.

    Raises:
        UsageError: the name of a parameter is in the place of the vehicle.
        UnknownVehicle, AmbiguousVehicle: as `tables_in`.
    """
    try:
        return tables_in(cache, vehicle, extended=extended)
    except UnknownVehicle:
        if vehicle is None or vehicle.upper() not in map(str.upper, cached_names(cache)):
            raise
        raise UsageError(
            f"{vehicle} is the name of a parameter: the first argument of show is the vehicle, as in "
            f"`paramclient show 1 {vehicle}`; `paramclient info {vehicle}` prints it for every vehicle"
        ) from None


def _check_known(cache: ParamCache, name_patterns: Sequence[str], known: Sequence[str]) -> None:
    """Check that each name and pattern fits a cached parameter.

    Raises:
        NotInCache: one fits none. The message suggests similar names.
    """
    _, unmatched = NameChoice(name_patterns).divide(known)
    if unmatched:
        text = unmatched_text(unmatched, known, lambda: cached_names(cache))
        raise NotInCache(f"not among the cached parameters: {text}")


def _open(options: CacheOptions) -> ParamCache:
    return ParamCache(options.cache)


def _load(cache: ParamCache, summaries: Sequence[CachedSummary], *, extended: bool) -> list[CachedComponent]:
    loaded = (cache.load(each.key, each.component, extended=extended) for each in summaries)
    return [table for table in loaded if table is not None]  # another process may have removed one


@dataclass(frozen=True, slots=True)
class _View:
    """A cached table, and the part of it to show.

    Attributes:
        table: the table.
        names: the named parameters; empty for all.
        metadata: the metadata of the parameters, or None.
        changed: whether to show only parameters that differ from the defaults.
    """

    table: CachedComponent
    names: tuple[str, ...]
    metadata: Metadata | None
    changed: bool

    @classmethod
    def of(
        cls,
        table: CachedComponent,
        names: tuple[str, ...],
        metadata: Metadata | None,
        cache: ParamCache,
        *,
        changed: bool,
    ) -> _View:
        """Return the view of a table; without `metadata`, with the stored metadata of its firmware."""
        known = known_of_table(cache.path, table) if metadata is None else metadata
        chosen, _ = NameChoice(names).divide(table.params)
        return cls(table, tuple(name for name in table.params if name in chosen), known, changed)

    @property
    def has_defaults(self) -> bool:
        """Whether the default of a parameter of the table is known."""
        described = defaults_in(self.metadata, self.table.params)
        return bool(described) or any(param.default is not None for param in self.table.params.values())

    @property
    def params(self) -> Iterable[Param]:
        """The parameters to show."""
        params: Mapping[str, Param] = self.table.params
        if self.changed:
            differing = self.table.params.changed(defaults_in(self.metadata, params))
            params = {name: params[name] for name in differing}
        return [params[name] for name in self.names if name in params] if self.names else params.values()

    def as_json(self) -> TableJson:
        """Return the JSON object."""
        metadata, whole = self.metadata, bool(self.names)
        infos = {each.name: None if metadata is None else metadata.find(each.name) for each in self.params}
        params = {each.name: ParamJson.of(each, infos[each.name], whole=whole) for each in self.params}
        return TableJson.of(self.table, params)


def _extended_sizes(cache: ParamCache) -> dict[tuple[str, int], int]:
    """Return the number of extended parameters of each component that has some, by key and component."""
    return {(each.key, each.component): each.size for each in cache.components(extended=True)}


def _print_summaries(summaries: Sequence[CachedSummary], extended: Mapping[tuple[str, int], int]) -> None:
    """Print a line for each table, with the number of extended parameters if any table has some."""
    rows = (
        (
            f"{each.system}/{each.component}",
            autopilot_name(each.autopilot),
            each.size,
            *([extended.get((each.key, each.component))] if extended else []),
            hash_text(each.hash),
            _synced(each),
            each.key,
        )
        for each in summaries
    )
    more = ["extended"] if extended else []
    columns = ["component", "autopilot", "params", *more, "hash", "synced", "key"]
    print_table(columns, rows, right="params extended")


def _synced(table: CachedSummary) -> str | None:
    """Return when a table was verified last."""
    return None if table.synced_at is None else local_time(table.synced_at)


def _print_table(view: _View) -> None:
    table, changed, metadata = view.table, view.changed, view.metadata
    if changed and not view.has_defaults:
        return
    described = defaults_in(metadata, table.params) if changed else {}
    params = [add_default(param, described.get(param.name)) for param in by_index(view.params)]
    rows = (
        (
            *(param.name, _value(param), *([default_text(param)] if changed else [])),
            *(type_name(param.type_number), param.index, local_time(table.heard_at[param.name])),
            *(() if metadata is None else described_cells(metadata, param)),
        )
        for param in params
    )
    default = ["default"] if changed else []
    more = [] if metadata is None else DESCRIBED_COLUMNS
    columns = ["name", "value", *default, "type", "index", "received", *more]
    print_table(columns, rows, right="value default index")
    if metadata is not None:
        print_descriptions(view.names, metadata)
    if view.names:
        return
    synced = "never complete" if table.synced_at is None else f"synced {local_time(table.synced_at)}"
    crc = "" if table.hash is None else f"; hash {hash_text(table.hash)}"
    vehicle = f"{table.system}/{table.component} {autopilot_name(table.autopilot)} ({table.key})"
    if changed:
        shown = [default_of(table.params[each.name], described.get(each.name)) for each in params]
        say_sources(f"{table.system}/{table.component}", shown)
        text = f"{len(params)} of {table.size} parameters differ from their default: {vehicle}"
    else:
        text = f"{table.size} parameters of {vehicle}"
    say(printable(f"{text}, {synced}{crc}"))


def _value(param: Param) -> str:
    return format_value(param.settable, param.type_number)
