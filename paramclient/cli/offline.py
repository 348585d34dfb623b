"""The subcommands show and cache (list, add, path, remove, copy), which need no link."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from paramclient.cache import CachedComponent, CachedSummary, ParamCache
from paramclient.cache.database_url import is_address
from paramclient.cli.default_sources import STORED_DEFAULTS_HINT, defaults_in, report_no_defaults, say_sources
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.extended import is_extended_source, show_extended
from paramclient.cli.file_output import show_file
from paramclient.cli.logs import cache_of_log
from paramclient.cli.metadata import (
    DESCRIBED_COLUMNS,
    MetadataChoice,
    described_cells,
    from_file,
    known_of_table,
    print_descriptions,
)
from paramclient.cli.options import CacheOptions, Id
from paramclient.cli.output import (
    by_index,
    default_text,
    local_time,
    print_document,
    print_line,
    print_table,
    printable,
    report,
    say,
)
from paramclient.cli.param_names import cached_names, check_given, unmatched_text
from paramclient.cli.sources import VehicleChoice, choose, chosen_vehicle, is_file, open_file, tables_in
from paramclient.errors import NotInCache, UnknownVehicle, UsageError
from paramclient.metadata import Metadata, MetadataStore
from paramclient.model.defaults import add_default, default_of
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import hash_text
from paramclient.model.paramset import ParamSet
from paramclient.model.patterns import NameChoice
from paramclient.model.values import Param, format_value, type_name
from paramclient.model.wording import counted
from paramclient.provision.vehicle_params import left_out_note

if TYPE_CHECKING:
    from paramclient.documents.cached import CachedTableDoc

__all__ = [
    "cache_add",
    "cache_copy",
    "cache_list",
    "cache_name",
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
    cached: VehicleChoice = None,
    component: Id = None,
    changed: bool = False,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Print the cached parameters of a vehicle, or those of a parameter file or a telemetry log.

    With --changed, exit code 1: the firmware's defaults are not known.

    Args:
        vehicle: A parameter file; a vehicle in the cache: 4 or 4/1, px4 or ardupilot, a nickname, its
            hardware id (in full, or uid: and at least 6 digits) or its key, also with the prefix cache:; or
            replay:FILE, a telemetry log.
        cached: The vehicle in the cache, instead of the first argument; then all arguments are names.
        component: Print only this component.
        changed: Print only parameters that differ from the firmware's defaults: those of the vehicle, else
            those of its metadata.
        names: Print only these parameters of a vehicle, with their metadata: names in upper or lower case, or
            patterns such as "MC_*".
        metadata: A file that describes parameters. Default: the stored metadata of the vehicle's firmware.
            With a parameter file only for --changed.
        extended: Use extended parameters (PARAM_EXT_*), such as those of a camera.
    """
    vehicle, names = chosen_vehicle(cached, vehicle, names)
    if extended or (vehicle is not None and is_extended_source(vehicle)):
        if changed or metadata is not None:
            raise UsageError("--changed and --metadata are for plain parameters")
        return show_extended(vehicle, names, component, options)
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

        return show_file(open_file(vehicle), component, known, changed=changed, json=options.json)
    name_patterns = tuple(check_given(names))
    described = from_file(metadata, offline=True)
    is_log = vehicle is not None and vehicle.lower().startswith("replay:")
    with _open(options) if not is_log or vehicle is None else cache_of_log(vehicle) as cache:
        summaries = _tables_to_show(cache, None if is_log else vehicle, component)
        extended_sizes = cache.ext_sizes()
        nicknames = _names_by_key(cache)
        is_list = vehicle is None and len(summaries) > 1 and not options.json
        tables = [] if is_list else _load(cache, summaries)
        _check_known(cache, name_patterns, [name for table in tables for name in table.params])
    views = [_View.of(table, name_patterns, described, cache, changed=changed) for table in tables]
    if options.json:
        from paramclient.documents.cached import CachedTablesDoc  # only here: loads pydantic

        print_document(CachedTablesDoc(components=[view.document() for view in views]))
    elif is_list:
        _print_summaries(summaries, nicknames, extended_sizes)
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
        summaries, names, extended = cache.components(), _names_by_key(cache), cache.ext_sizes()
    if options.json:
        from paramclient.documents.cached import CachedListDoc, CachedSummaryDoc  # only here: loads pydantic

        components = [
            CachedSummaryDoc.of(each, names.get(each.key), extended.get((each.key, each.component)))
            for each in summaries
        ]
        print_document(CachedListDoc(path=cache.place, components=components))
    elif summaries:
        _print_summaries(summaries, names, extended)
    else:
        say(f"the cache {printable(cache.place)} is empty")
    return ExitCode.DONE


def cache_add(
    vehicle: str,
    file: Path,
    /,
    *,
    component: Id = None,
    force: bool = False,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Make a parameter file the cached table of a vehicle, for example before using a slow link.

    The table is marked with the file until the vehicle confirms or replaces it. If PX4's hash matches the
    table when the vehicle is heard, nothing is downloaded; otherwise, and from a vehicle without a hash,
    the next fetch downloads the table. A table that was received later than the file was written is not
    replaced.

    Args:
        vehicle: A vehicle in the cache, or the one that the file names: 4 or 4/1, px4 or ardupilot, a
            nickname, its hardware id (in full, or uid: and at least 6 digits), or its key.
        file: The parameter file. Without types, those of the vehicle's previous table or of another one of
            the same firmware are used.
        component: The component. Default: the autopilot, or the only one of the file.
        force: Replace a table that was received later.
    """
    params = choose(open_file(str(file)), component, None)
    at = file.stat().st_mtime if params.at is None else params.at
    with _open(options) as cache:
        added = cache.add(params, vehicle, component=component, at=at, force=force)
    for note in added.notes:
        report(f"{file.name}: {note}")
    if options.json:
        from paramclient.documents.cached import AddedDoc  # only here: loads pydantic

        print_document(AddedDoc.of(added, str(file)))
    else:
        crc = "" if added.hash is None else f"; hash {hash_text(added.hash)}"
        print_line(
            f"{counted(added.size, 'parameter')} of {file} are the cached table of "
            f"{added.system}/{added.component} ({added.key}), values of {local_time(added.at)}{crc}"
        )
    return ExitCode.DONE


def cache_path(*, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """Print the path or the URL of the cache."""
    with _open(options) as cache:
        path = cache.place
    if options.json:
        from paramclient.documents.cached import PlaceDoc  # only here: loads pydantic

        print_document(PlaceDoc(path=path))
    else:
        print_line(path)
    return ExitCode.DONE


def cache_remove(vehicle: str, /, *, component: Id = None, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """Remove a vehicle from the cache: its tables and their history.

    Args:
        vehicle: A vehicle in the cache: 4 or 4/1, px4 or ardupilot, a nickname, its hardware id (in full, or
            uid: and at least 6 digits), or its key.
        component: Remove only the table of this component.
    """
    with _open(options) as cache:
        key = tables_in(cache, vehicle, component)[0].key
        removed = cache.remove(key, component)
    if options.json:
        from paramclient.documents.cached import RemovedDoc  # only here: loads pydantic

        print_document(RemovedDoc(key=key, removed=removed))
    else:
        print_line(f"removed {counted(removed, 'table')} of {key}")
    return ExitCode.DONE


def cache_name(
    vehicle: str,
    nickname: str | None = None,
    /,
    *,
    remove: bool = False,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Give a vehicle a nickname. Every subcommand accepts it, on links as --vehicle.

    Nicknames are stored in a file beside the cache, on this computer only.

    Args:
        vehicle: A vehicle in the cache: 4 or 4/1, px4 or ardupilot, its current nickname, its hardware id (in
            full, or uid: and at least 6 digits), or its key.
        nickname: 1 to 32 letters, digits, _ and -, beginning with a letter. It replaces the previous
            nickname.
        remove: Remove its nickname.
    """
    if (nickname is None) is not remove:
        raise UsageError("cache name takes a nickname, or --remove")
    with _open(options) as cache:
        key = cache.set_nickname(vehicle, nickname)
    if options.json:
        from paramclient.documents.cached import NicknameDoc  # only here: loads pydantic

        print_document(NicknameDoc(key=key, nickname=nickname))
    else:
        print_line(f"{key} has no nickname now" if nickname is None else f"{nickname} is {key}")
    return ExitCode.DONE


def cache_copy(source: str, target: str, /, *, json: bool = False) -> ExitCode:
    """Copy every table of a cache to another one, with history and snapshots, and verify the copy.

    Tables in both caches are merged: for each parameter, the later value is kept. Nothing is duplicated.
    After an interruption, run the same command again to continue.

    Args:
        source: The cache to copy: a file, or the postgresql:// URL of a shared cache.
        target: The cache to copy to.
        json: Print JSON.
    """
    if not is_address(source) and not Path(source).is_file():
        raise NotInCache(f"there is no cache {source}")

    def show_progress(key: str, number: int, count: int) -> None:
        if sys.stderr.isatty():
            say(f"{number} of {count}: {printable(key)}")

    with ParamCache(source) as old, ParamCache(target) as new:
        done = old.copy_to(new, progress=show_progress)
        place = new.place
    if json:
        from paramclient.documents.cached import CopiedDoc  # only here: loads pydantic

        print_document(CopiedDoc(path=place, **asdict(done)))
    else:
        print_line(
            f"copied {counted(done.tables, 'table')} to {printable(place)}, {done.unchanged} were there "
            f"already; in all {done.params} parameters, {done.lines} lines of history, {done.snapshots} "
            "snapshots, verified"
        )
    return ExitCode.DONE


def tables_of(options: CacheOptions, vehicle: str, component: int | None) -> list[CachedComponent]:
    """Return the cached tables of a vehicle, or that of one of its components.

    Raises:
        UnknownVehicle, AmbiguousVehicle: as `tables_in`.
        CacheError: the cache cannot be read.
    """
    with _open(options) as cache:
        return _load(cache, tables_in(cache, vehicle, component))


def _tables_to_show(cache: ParamCache, vehicle: str | None, component: int | None) -> list[CachedSummary]:
    """Return the tables that the arguments of show name, as `tables_in` does.

    Raises:
        UsageError: the name of a parameter is in the place of the vehicle.
        UnknownVehicle, AmbiguousVehicle: as `tables_in`.
    """
    try:
        return tables_in(cache, vehicle, component)
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


def _load(cache: ParamCache, summaries: Sequence[CachedSummary]) -> list[CachedComponent]:
    loaded = (cache.load(each.key, each.component) for each in summaries)
    tables = [table for table in loaded if table is not None]  # another process may have removed one
    for table in tables:
        if table.left_out:
            report(left_out_note(table))
    return tables


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

    def document(self) -> CachedTableDoc:
        """Return the JSON document."""
        from paramclient.documents.cached import CachedTableDoc  # only here: loads pydantic

        return CachedTableDoc.of(self.table, self.params, self.metadata, whole=bool(self.names))


def _names_by_key(cache: ParamCache) -> dict[str, str]:
    """Return the nicknames of vehicles by key."""
    return {key: nickname for nickname, key in cache.nicknames.items()}


def _print_summaries(
    summaries: Sequence[CachedSummary], names: Mapping[str, str], extended: Mapping[tuple[str, int], int]
) -> None:
    """Print a line for each table; with nickname and number of extended parameters if any table has one."""
    rows = (
        (
            *([names.get(each.key)] if names else []),
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
    columns = [*(["name"] if names else []), "component", "autopilot", "params"]
    columns += [*(["extended"] if extended else []), "hash", "synced", "key"]
    print_table(columns, rows, right="params extended")


def _synced(table: CachedSummary) -> str | None:
    """Return when a table was verified last, or the file that it was added from."""
    if table.source is not None:
        return f"file {table.source}"
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
    if table.source is not None:
        synced = f"added from the file {table.source}, not confirmed by the vehicle"
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
