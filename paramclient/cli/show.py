"""The subcommand show: cached tables, parameter files and logs, without a link."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from paramclient.cache import CachedComponent, CachedSummary, ParamCache
from paramclient.cli.cached import extended_sizes, load_tables, show_summaries
from paramclient.cli.default_sources import STORED_DEFAULTS_HINT, defaults_in, report_no_defaults, say_sources
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.file_output import described
from paramclient.cli.json_output import JsonObject, set_json
from paramclient.cli.logs import cache_of_log
from paramclient.cli.metadata import (
    MetadataChoice,
    from_file,
    known_of_table,
    print_descriptions,
)
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import by_index, local_time, print_json, print_table, say
from paramclient.cli.param_names import cached_names, check_given, unmatched_text
from paramclient.cli.param_table import RIGHT, ParamTable
from paramclient.errors import UnknownVehicle, UsageError
from paramclient.files import ParamFile
from paramclient.files.formats import address
from paramclient.metadata import Metadata, MetadataStore
from paramclient.model.comparison import non_defaults
from paramclient.model.defaults import Default, add_defaults, default_of
from paramclient.model.identity import autopilot_name
from paramclient.model.names import NameChoice
from paramclient.model.notation import hash_text, time_or_none, typed
from paramclient.model.paramset import ParamSet
from paramclient.model.values import format_value
from paramclient.provision.sources import is_file, read_source, source_of, tables_in

__all__ = ["show"]

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
        file = read_source(vehicle)
        assert file is not None, "it is no link"
        return _show_file(file, from_file(metadata, offline=True), options, changed=changed)
    chosen, given = check_given(names), from_file(metadata, offline=True)
    is_log = vehicle is not None and vehicle.lower().startswith("replay:")
    with cache_of_log(vehicle) if vehicle and is_log else ParamCache(options.cache) as cache:
        summaries = _tables_to_show(cache, None if is_log else vehicle, extended=extended)
        sizes = extended_sizes(cache)
        if vehicle is None and not options.json and len(summaries) != 1:
            show_summaries(cache, summaries, sizes)
            if summaries:
                say("paramclient show VEHICLE prints the table of one vehicle, by its system id or its key")
            return ExitCode.DONE
        tables = load_tables(cache, summaries, extended=extended)
        known = [name for table in tables for name in table.params]
        _, unmatched = NameChoice(chosen).divide(known)
        if unmatched:
            text = unmatched_text(unmatched, known, lambda: cached_names(cache))
            raise UsageError(f"not among the cached parameters: {text}")
        views = [
            _View(each, chosen, given or known_of_table(cache.path, each), changed=changed) for each in tables
        ]
    if options.json:
        print_json({"components": [view.as_json() for view in views]})
    for view in [] if options.json else views:
        view.print()
        if not view.table.size and (number := sizes.get((view.table.key, view.table.component))):
            say(f"{number} extended parameters: --extended prints them")
    if changed and views and not any(view.has_defaults for view in views):
        report_no_defaults(STORED_DEFAULTS_HINT)
        return ExitCode.INCOMPLETE
    return ExitCode.DONE


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


class _View:
    """A cached table, and the part of it to show.

    Args:
        table: the table.
        names: names and patterns; empty for all parameters.
        metadata: the metadata of the parameters, or None.
        changed: whether to show only parameters that differ from the defaults.
    """

    def __init__(
        self, table: CachedComponent, names: Sequence[str], metadata: Metadata | None, *, changed: bool
    ) -> None:
        self.table, self._is_part, self._changed = table, bool(names), changed
        heard = ("received", lambda param: local_time(table.heard_at[param.name]))
        described = defaults_in(metadata, table.params)
        params = table.params.values()
        self._shown = ParamTable(by_index(params), metadata=metadata, described=described, more=heard)
        self.has_defaults = bool(self._shown.defaults)
        if names:
            self._shown.keep(NameChoice(names).divide(table.params)[0])
        if changed:
            self._shown.keep_changed()

    def as_json(self) -> JsonObject:
        """Return the JSON of the table."""
        table = self.table
        return {
            "system": table.system,
            "component": table.component,
            "autopilot": autopilot_name(table.autopilot),
            "uid": table.identity.uid,
            "hash": hash_text(table.hash),
            "synced_at": time_or_none(table.synced_at),
            "params": self._shown.as_json(whole=self._is_part),
        }

    def print(self) -> None:
        """Print the table, and a line about it on stderr."""
        table, shown = self.table, self._shown
        if self._changed and not self.has_defaults:
            return
        print_table(shown.columns, shown.rows(), right=RIGHT)
        if self._is_part:
            if shown.metadata is not None:
                print_descriptions([each.name for each in shown.params], shown.metadata)
            return
        address = f"{table.system}/{table.component}"
        count = f"{table.size} parameters of"
        if self._changed:
            say_sources(address, shown.defaults)
            count = f"{len(shown.params)} of {table.size} parameters differ from their default:"
        synced = "never complete" if table.synced_at is None else f"synced {local_time(table.synced_at)}"
        crc = "" if table.hash is None else f"; hash {hash_text(table.hash)}"
        say(f"{count} {address} {autopilot_name(table.autopilot)} ({table.key}), {synced}{crc}")


# Files


def _show_file(file: ParamFile, given: Metadata | None, options: CacheOptions, *, changed: bool) -> ExitCode:
    """Print the parameters of a file; with `changed`, those that differ from the firmware's defaults."""
    shown: list[tuple[ParamSet, dict[str, Default]]] = [(each, {}) for each in file.sets]
    if changed:
        store = MetadataStore.beside(ParamCache(options.cache).path)
        known = store.known_of_sets(file.sets) if given is None else [given] * len(file.sets)
        shown = []
        for each, metadata in zip(file.sets, known, strict=True):
            more = defaults_in(metadata, each)
            filled = add_defaults(each, more)
            if any(param.default is not None for param in filled.values()):
                differing = non_defaults(filled)
                found = {name: default_of(each[name], more.get(name)) for name in differing}
                shown.append((differing, {name: each for name, each in found.items() if each is not None}))
    if options.json:
        components = [
            set_json(each, {name: default.source for name, default in defaults.items()})
            for each, defaults in shown
        ]
        print_json({"file": file.source, "format": file.file_format.value, "components": components})
    for each, defaults in [] if options.json else shown:
        _print_set(each, ", those that differ from their default" if changed else "")
        say_sources(address(each), defaults.values())
    if changed and not shown:
        report_no_defaults(STORED_DEFAULTS_HINT)
        return ExitCode.INCOMPLETE
    return ExitCode.DONE


def _print_set(params: ParamSet, more: str) -> None:
    """Print the table of a set, without empty columns."""
    rows = [
        (
            param.name,
            format_value(*typed(param.settable, param.type)),
            None if param.default is None else format_value(*typed(param.default, param.type)),
            None if param.type is None else param.type.name,
            param.comment or None,
        )
        for param in params.values()
    ]
    columns = ("name", "value", "default", "type", "comment")
    kept = [at for at in range(5) if at < 2 or any(row[at] is not None for row in rows)]
    shown = ([row[at] for at in kept] for row in rows)
    print_table([columns[at] for at in kept], shown, right="value default")
    say(f"{described(params)}{more}")
