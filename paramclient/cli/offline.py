"""The commands that need no link: show, cache list, cache history, cache path, cache remove."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Final

from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cache import CachedComponent, CachedSummary, HistoryEntry, ParamCache
from paramclient.cli.logs import cache_of_log
from paramclient.cli.options import CacheOptions, Id
from paramclient.cli.outcome import ExitCode
from paramclient.cli.output import (
    NO_DEFAULTS,
    as_json,
    by_index,
    default_text,
    hash_text,
    print_json,
    print_line,
    print_table,
    printable,
    report,
    say,
    time_text,
    value_json,
)
from paramclient.errors import CacheError
from paramclient.identity import autopilot_name
from paramclient.values import Param, check_name, format_value, type_name

__all__ = ["cache_history", "cache_list", "cache_path", "cache_remove", "show"]

_DEFAULTS: Final = CacheOptions()


def show(
    vehicle: str | None = None,
    /,
    *,
    component: Id = None,
    changed: bool = False,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Print what was last known of a vehicle, with no link, or what a telemetry log holds.

    With --changed, exit code 1 says that the firmware's defaults are not known.

    Args:
        vehicle: Its system id, the beginning of its hardware id, or its key in the cache; or replay:FILE.
        component: This component only.
        changed: Only what differs from the firmware's defaults.
    """
    is_log = vehicle is not None and vehicle.lower().startswith("replay:")
    with _open(options) if not is_log or vehicle is None else cache_of_log(vehicle) as cache:
        summaries = _choose(cache, None if is_log else vehicle, component)
        is_list = vehicle is None and len(summaries) > 1 and not options.json
        tables = [] if is_list else _load(cache, summaries)
    if options.json:
        print_json({"components": [_table_json(table, changed=changed) for table in tables]})
    elif is_list:
        _print_summaries(summaries)
        say("paramclient show VEHICLE shows one of them: by its system id, or the beginning of its key")
    elif not summaries:
        say(f"the cache {printable(str(cache.path))} is empty")
    for table in [] if options.json else tables:
        _print_table(table, changed=changed)
    if changed and tables and not any(_has_defaults(table) for table in tables):
        report(NO_DEFAULTS)
        return ExitCode.INCOMPLETE
    return ExitCode.DONE


def cache_list(*, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """List the tables in the cache, those of the vehicle seen last first."""
    with _open(options) as cache:
        summaries = cache.components()
    if options.json:
        print_json({"path": str(cache.path), "components": [_summary_json(each) for each in summaries]})
    elif summaries:
        _print_summaries(summaries)
    else:
        say(f"the cache {printable(str(cache.path))} is empty")
    return ExitCode.DONE


def cache_history(
    vehicle: str,
    name: str | None = None,
    /,
    *,
    component: Id = None,
    limit: Annotated[int | None, Parameter(validator=Number(gte=1))] = None,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Print how the values of a vehicle have changed: when, from, to, and by whom. The newest comes last.

    Args:
        vehicle: Its system id, the beginning of its hardware id, or its key in the cache.
        name: This parameter only.
        component: This component only.
        limit: The newest so many only.
    """
    with _open(options) as cache:
        key = _key(cache, vehicle)
        entries = cache.history(key, component, None if name is None else check_name(name), limit)
    if options.json:
        print_json({"history": [_entry_json(entry) for entry in entries]})
    else:
        print_table(["time", "component", "name", "old", "new", "by"], map(_entry_cells, entries))
    return ExitCode.DONE


def cache_path(*, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """Print where the cache is kept."""
    with _open(options) as cache:
        path = str(cache.path)
    if options.json:
        print_json({"path": path})
    else:
        print_line(path)
    return ExitCode.DONE


def cache_remove(vehicle: str, /, *, component: Id = None, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """Forget a vehicle: its tables and their history.

    Args:
        vehicle: Its system id, the beginning of its hardware id, or its key in the cache.
        component: This component's table only.
    """
    with _open(options) as cache:
        _choose(cache, vehicle, component)
        key = _key(cache, vehicle)
        removed = cache.remove(key, component)
    if options.json:
        print_json({"key": key, "removed": removed})
    else:
        print_line(f"removed {removed} {'table' if removed == 1 else 'tables'} of {key}")
    return ExitCode.DONE


def _open(options: CacheOptions) -> ParamCache:
    return ParamCache(options.cache)


def _key(cache: ParamCache, vehicle: str) -> str:
    """The key of the vehicle that the user means.

    Raises:
        CacheError: none fits, or more than one.
    """
    if vehicle.isdecimal():
        fits = [known for known in cache.vehicles() if str(known.identity.system) == vehicle]
        if len(fits) > 1:
            listed = "; ".join(map(str, fits))
            raise CacheError(f"system {vehicle} fits more than one vehicle in the cache: {listed}")
        if fits:
            return fits[0].key
    return cache.components(vehicle)[0].key


def _choose(cache: ParamCache, vehicle: str | None, component: int | None) -> list[CachedSummary]:
    """The tables that the user means.

    Raises:
        CacheError: a vehicle was named and there is none such, or more than one; or it has no such component.
    """
    summaries = cache.components(None if vehicle is None else _key(cache, vehicle))
    chosen = [each for each in summaries if component in (None, each.component)]
    if not chosen and (summaries or vehicle is not None):
        known = ", ".join(f"{each.system}/{each.component}" for each in summaries)
        raise CacheError(f"component {component} is not in the cache {cache.path}, which holds {known}")
    return chosen


def _load(cache: ParamCache, summaries: Sequence[CachedSummary]) -> list[CachedComponent]:
    loaded = (cache.load(each.key, each.component) for each in summaries)
    return [table for table in loaded if table is not None]  # another process may have removed one


def _has_defaults(table: CachedComponent) -> bool:
    return any(param.default is not None for param in table.params.values())


def _table_json(table: CachedComponent, *, changed: bool) -> dict[str, Any]:
    return {
        "system": table.system,
        "component": table.component,
        "autopilot": autopilot_name(table.autopilot),
        "uid": table.identity.uid,
        "hash": hash_text(table.hash),
        "synced_at": _time(table.synced_at),
        "params": as_json((table.params.changed() if changed else table.params).values()),
    }


def _summary_json(summary: CachedSummary) -> dict[str, Any]:
    return {
        "key": summary.key,
        "system": summary.system,
        "component": summary.component,
        "autopilot": autopilot_name(summary.autopilot),
        "uid": summary.identity.uid,
        "size": summary.size,
        "count": summary.count,
        "complete": summary.complete,
        "hash": hash_text(summary.hash),
        "synced_at": _time(summary.synced_at),
        "updated_at": _time(summary.updated_at),
    }


def _entry_json(entry: HistoryEntry) -> dict[str, Any]:
    new = entry.new
    return {
        "time": time_text(entry.at),
        "component": entry.component,
        "name": entry.name,
        "old": value_json(entry.old.value, entry.old.type),
        "new": None if new is None else value_json(new.value, new.type),
        "by": entry.by,
    }


def _entry_cells(entry: HistoryEntry) -> tuple[object, ...]:
    new = None if entry.new is None else _value(entry.new)
    return time_text(entry.at), entry.component, entry.name, _value(entry.old), new, entry.by


def _print_summaries(summaries: Sequence[CachedSummary]) -> None:
    rows = (
        (
            f"{each.system}/{each.component}",
            autopilot_name(each.autopilot),
            each.size,
            hash_text(each.hash),
            _time(each.synced_at),
            each.key,
        )
        for each in summaries
    )
    print_table(["component", "autopilot", "params", "hash", "synced", "key"], rows, right="params")


def _print_table(table: CachedComponent, *, changed: bool) -> None:
    if changed and not _has_defaults(table):
        return
    params = by_index((table.params.changed() if changed else table.params).values())
    rows = (
        (
            *(param.name, _value(param), *([default_text(param)] if changed else [])),
            *(type_name(param.type), param.index, time_text(table.heard_at[param.name])),
        )
        for param in params
    )
    default = ["default"] if changed else []
    print_table(["name", "value", *default, "type", "index", "heard"], rows, right="value default index")
    synced = "never complete" if table.synced_at is None else f"synced {time_text(table.synced_at)}"
    crc = "" if table.hash is None else f"; hash {hash_text(table.hash)}"
    who = f"{table.system}/{table.component} {autopilot_name(table.autopilot)} ({table.key})"
    number = f"{len(params)} of {table.size} parameters differ from their default" if changed else table.size
    what = f"{number}: {who}" if changed else f"{number} parameters of {who}"
    say(printable(f"{what}, {synced}{crc}"))


def _value(param: Param) -> str:
    return format_value(param.value, param.type)


def _time(at: float | None) -> str | None:
    return None if at is None else time_text(at)
