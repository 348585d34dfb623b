"""The subcommand history: changes of a vehicle's values, and snapshots of its tables."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Annotated, Final

from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cache import HistoryEntry, ParamCache, SnapshotSummary
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.json_cache import HistoryLineJson, SnapshotJson
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import local_time, print_json, print_table, say
from paramclient.cli.param_names import cached_names, check_given, unmatched_text
from paramclient.cli.sources import component_of, tables_in
from paramclient.cli.time_arguments import parse_time
from paramclient.errors import NotInCache, UsageError
from paramclient.model.names import NameChoice
from paramclient.model.notation import hash_text
from paramclient.model.values import Param, format_value

__all__ = ["history"]

_DEFAULTS: Final = CacheOptions()


def history(
    vehicle: str,
    /,
    *names: str,
    since: str | None = None,
    limit: Annotated[int | None, Parameter(validator=Number(gte=1))] = None,
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
        limit: Print at most this number of changes, the newest ones.
        snapshots: Print the snapshots instead of the changes.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    begin = None if since is None else parse_time(since, time.time())
    if begin is not None and not options.json:
        say(f"since {local_time(begin)}")
    name_patterns = check_given(names)
    if snapshots and name_patterns:
        raise UsageError("--snapshots lists whole tables and takes no parameter name")
    with ParamCache(options.cache) as cache:
        key, component = tables_in(cache, vehicle, extended=extended)[0].key, component_of(vehicle)
        if snapshots:
            found = cache.snapshots(key, component, extended=extended)
            kept = [each for each in found if begin is None or each.at >= begin]
            _print_snapshots(kept[-limit:] if limit else kept, options)
        else:
            entries = _entries(cache, key, component, name_patterns, begin, extended=extended)
            entries = entries[-limit:] if limit else entries
            _print_entries(entries, options)
    return ExitCode.DONE


def _entries(
    cache: ParamCache,
    key: str,
    component: int | None,
    name_patterns: Sequence[str],
    begin: float | None,
    *,
    extended: bool,
) -> list[HistoryEntry]:
    """Return the changes of the parameters that names and patterns choose; of all parameters without any.

    Raises:
        NotInCache: the vehicle has and had no such parameter.
    """
    if not name_patterns:
        return cache.history(key, component, None, None, begin, extended=extended)
    entries = cache.history(key, component, extended=extended)
    known = {entry.name for entry in entries}
    for each in cache.components(key):
        is_meant = component in (None, each.component)
        table = cache.load(key, each.component, extended=extended) if is_meant else None
        known.update(() if table is None else table.params)
    chosen, unmatched = NameChoice(name_patterns).divide(known)
    if unmatched:
        text = unmatched_text(unmatched, known, lambda: cached_names(cache))
        raise NotInCache(f"no parameter of {key} in the cache is called {text}")
    return [entry for entry in entries if entry.name in chosen and (begin is None or entry.at >= begin)]


def _print_entries(entries: Sequence[HistoryEntry], options: CacheOptions) -> None:
    if options.json:
        print_json({"history": [HistoryLineJson.of(each) for each in entries]})
        return
    print_table(["time", "component", "name", "old", "new", "by"], map(_entry_cells, entries))


def _print_snapshots(kept: Sequence[SnapshotSummary], options: CacheOptions) -> None:
    if options.json:
        print_json({"snapshots": [SnapshotJson.of(each) for each in kept]})
        return
    if not kept:
        say("no snapshots: apply and restore store one before they write")
        return
    rows = (
        (each.id, local_time(each.at), each.component, each.size, hash_text(each.hash), _reason(each))
        for each in kept
    )
    print_table(["id", "time", "component", "params", "hash", "reason"], rows, right="id params")


def _entry_cells(entry: HistoryEntry) -> tuple[object, ...]:
    new = None if entry.new is None else _value(entry.new)
    return local_time(entry.at), entry.component, entry.name, _value(entry.old), new, entry.by


def _reason(each: SnapshotSummary) -> str:
    notes = [] if each.complete else ["not complete"]
    if each.ended is False:
        notes.append("interrupted, or still running")
    return f"{each.reason} ({', '.join(notes)})" if notes else each.reason


def _value(param: Param) -> str:
    return format_value(param.settable, param.type_number)
