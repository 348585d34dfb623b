"""The subcommands cache (list, remove) and history, which need no link."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Final

from paramclient.cache import CachedComponent, CachedSummary, ParamCache, SnapshotSummary
from paramclient.cli.json_output import history_json, snapshot_json
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import ExitCode, local_time, print_json, print_line, say, show
from paramclient.cli.param_names import check_given
from paramclient.cli.time_arguments import parse_time
from paramclient.errors import UsageError
from paramclient.model.identity import autopilot_name
from paramclient.model.names import NameChoice, counted
from paramclient.model.notation import hash_text, time_or_none
from paramclient.model.values import Param, format_value
from paramclient.provision.sources import component_of, tables_in

_DEFAULTS: Final = CacheOptions()


def cache_list(*, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """List the tables in the cache, most recently received vehicles first."""
    with ParamCache(options.cache) as cache:
        summaries, sizes = cache.components(), extended_sizes(cache)
    show_summaries(cache, summaries, sizes, json=options.json)
    return ExitCode.DONE


def cache_remove(vehicle: str, /, *, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """Remove a vehicle from the cache: its tables and their history.

    Args:
        vehicle: A vehicle in the cache: 4, px4 or ardupilot, its hardware id (in full, or uid: and at least 6
            digits), or its key; or 4/1, to remove only the table of this component.
    """
    with ParamCache(options.cache) as cache:
        key = tables_in(cache, vehicle)[0].key
        removed = cache.remove(key, component_of(vehicle))
    if options.json:
        print_json({"key": key, "removed": removed})
    else:
        print_line(f"removed {counted(removed, 'table')} of {key}")
    return ExitCode.DONE


def show_summaries(
    cache: ParamCache,
    summaries: Sequence[CachedSummary],
    sizes: Mapping[tuple[str, int], int],
    *,
    json: bool = False,
) -> None:
    """Print a line for each table, with the number of extended parameters."""
    rows, components = [], []
    for each in summaries:
        extended = sizes.get((each.key, each.component))
        components.append(_summary_json(each, extended))
        synced = None if each.synced_at is None else local_time(each.synced_at)
        row = [f"{each.system}/{each.component}", autopilot_name(each.autopilot), each.size]
        rows.append([*row, extended, hash_text(each.hash), synced, each.key])
    columns = ["component", "autopilot", "params", "extended", "hash", "synced", "key"]
    found = {"path": cache.place, "components": components}
    show(found, columns, rows, json=json, right="params extended", empty="no table is in the cache")
    if not json:
        say(f"the cache is {cache.place}")


def _summary_json(summary: CachedSummary, extended: int | None) -> dict[str, object]:
    """Return a table without its parameters, with the number of its extended ones or None."""
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
        "synced_at": time_or_none(summary.synced_at),
        "updated_at": time_or_none(summary.updated_at),
        **({} if extended is None else {"extended": extended}),
    }


def extended_sizes(cache: ParamCache) -> dict[tuple[str, int], int]:
    """Return the number of extended parameters of each component that has some, by key and component."""
    return {(each.key, each.component): each.size for each in cache.components(extended=True)}


def load_tables(
    cache: ParamCache, summaries: Sequence[CachedSummary], *, extended: bool = False
) -> list[CachedComponent]:
    """Load tables; another process may have removed one."""
    loaded = (cache.load(each.key, each.component, extended=extended) for each in summaries)
    return [table for table in loaded if table is not None]


# history


def history(
    vehicle: str,
    /,
    *names: str,
    since: str | None = None,
    snapshots: bool = False,
    extended: bool = False,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Print the changes of a vehicle's values: time, old and new value, author. The newest change is last.

    With --snapshots, print the snapshots of the vehicle's tables instead, each with its number.

    Args:
        vehicle: A vehicle in the cache: 4 or 4/1, px4 or ardupilot, its hardware id (in full, or uid: and at
            least 6 digits), or its key.
        names: Print only these parameters: names in upper or lower case, or patterns such as "MC_*".
        since: Print only changes from this time on: 2h ago, yesterday, '2026-11-20 14:00'. A time without a
            time zone is in the time zone of this computer, like the printed times.
        snapshots: Print the snapshots instead of the changes.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    begin = None if since is None else parse_time(since, time.time())
    if begin is not None and not options.json:
        say(f"since {local_time(begin)}")
    if snapshots and names:
        raise UsageError("--snapshots lists whole tables and takes no parameter name")
    with ParamCache(options.cache) as cache:
        tables = tables_in(cache, vehicle, extended=extended)
        key, component = tables[0].key, component_of(vehicle)
        if snapshots:
            kept = cache.snapshots(key, component, extended=extended)
            kept = [each for each in kept if begin is None or each.at >= begin]
        else:
            entries = cache.history(key, component, extended=extended)
            known = {each.name for each in entries}
            known.update(*(each.params for each in load_tables(cache, tables, extended=extended)))
    if snapshots:
        show(
            {"snapshots": [snapshot_json(each) for each in kept]},
            ["id", "time", "component", "params", "hash", "reason"],
            map(_snapshot_cells, kept),
            json=options.json,
            right="id params",
            empty="no snapshots: apply and restore store one before they write",
        )
        return ExitCode.DONE
    chosen = NameChoice(check_given(names)).choose(known, f" of {key} in the cache")
    entries = [
        each for each in entries if (each.name in chosen or not names) and (begin is None or each.at >= begin)
    ]
    rows = (
        (local_time(each.at), each.component, each.name, _value(each.old), _value(each.new), each.by)
        for each in entries
    )
    columns = ["time", "component", "name", "old", "new", "by"]
    show({"history": [history_json(each) for each in entries]}, columns, rows, json=options.json)
    return ExitCode.DONE


def _snapshot_cells(each: SnapshotSummary) -> Sequence[object]:
    notes = [] if each.complete else ["not complete"]
    if each.ended is False:
        notes.append("interrupted, or still running")
    reason = f"{each.reason} ({', '.join(notes)})" if notes else each.reason
    return each.id, local_time(each.at), each.component, each.size, hash_text(each.hash), reason


def _value(param: Param | None) -> str | None:
    return None if param is None else format_value(param.settable, param.type)
