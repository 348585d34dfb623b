"""The subcommands cache (list, remove), import and history, which need no link."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from paramclient.cache import CachedSummary, ParamCache, SnapshotSummary
from paramclient.cache.moments import parse_time
from paramclient.cli.json_output import JsonObject, history_json, known_members, snapshot_json, taken
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import local_time, print_result, report, report_all, say, show
from paramclient.cli.session import check_given
from paramclient.errors import FileError, LinkError, ParamClientError, UsageError
from paramclient.files.conversion import BEGIN_SIZE, kind_of
from paramclient.logs.imports import ImportedTable, import_log, import_onboard_log
from paramclient.logs.onboard import is_onboard_log
from paramclient.model.identity import autopilot_name
from paramclient.model.names import NameChoice, counted
from paramclient.model.notation import hash_text, time_or_none
from paramclient.provision.sources import component_of, tables_in


def cache_list(*, options: CacheOptions = CacheOptions()) -> None:
    """List the tables in the cache, most recently received vehicles first."""
    with ParamCache(options.cache) as cache:
        show_summaries(cache, cache.components(), json=options.json)


def cache_remove(vehicle: str, /, *, options: CacheOptions = CacheOptions()) -> None:
    """Remove a vehicle from the cache: its tables and their history.

    Args:
        vehicle: A vehicle in the cache: 4, px4 or ardupilot, its hardware id (in full, or uid: and at least 6
            digits), or its key; or 4/1, to remove only the table of this component.
    """
    with ParamCache(options.cache) as cache:
        key = tables_in(cache, vehicle)[0].key
        removed = cache.remove(key, component_of(vehicle))
    words = f"removed {counted(removed, 'table')} of {key}"
    print_result({"key": key, "removed": removed}, words, json=options.json)


def show_summaries(cache: ParamCache, summaries: Sequence[CachedSummary], *, json: bool) -> None:
    """Print a line for each table, with the number of extended parameters."""
    sizes = {(each.key, each.component): each.size for each in cache.components(extended=True)}
    components, rows = list[JsonObject](), list[Sequence[object]]()
    for each in summaries:
        found = {
            **taken(each, "key", "system", "component"),
            "autopilot": autopilot_name(each.autopilot),
            "uid": each.identity.uid,
            **taken(each, "size", "count", "complete"),
            "hash": hash_text(each.hash),
            "synced_at": time_or_none(each.synced_at),
            "updated_at": time_or_none(each.updated_at),
            **known_members(extended=sizes.get((each.key, each.component))),
        }
        components.append(found)
        synced = each.synced_at and local_time(each.synced_at)
        members = map(found.get, ("autopilot", "size", "extended", "hash"))
        rows.append([f"{each.system}/{each.component}", *members, synced, each.key])
    columns = ["component", "autopilot", "params", "extended", "hash", "synced", "key"]
    show({"path": cache.place, "components": components}, columns, rows, json=json, empty="nothing is cached")
    if not json:
        say(f"the cache is {cache.place}")


# import


async def import_(file: Path, /, *files: Path, options: CacheOptions = CacheOptions()) -> int:
    """Import logs into the cache: vehicles, tables and changes, with the times of the logs.

    Later values in the cache are kept. Import logs in the order of their times, or a change may be dated
    later. All files are tried even if one cannot be read.

    Args:
        file: A telemetry log (.tlog), or an on-board log of ArduPilot (.bin) or PX4 (.ulg).
        files: Further logs.
    """
    code, found = 0, []
    with ParamCache(options.cache) as cache:
        for each in (file, *files):
            try:
                tables = await _import(each, cache)
            except ParamClientError as error:
                code = max(code, report_all([error]))
                continue
            for table in tables:
                autopilot = None if table.autopilot is None else autopilot_name(table.autopilot)
                more = {"autopilot": autopilot, "hash": hash_text(table.hash)}
                found.append({"file": str(each)} | asdict(table) | more)
                for note in table.notes:
                    report(f"{each.name}, {table.system}/{table.component}: {note}")
            if not tables:
                report(f"{each} has no parameters")
    if found or options.json:
        members = ("file", "system", "component", "autopilot", "params", "complete", "hash", "key")
        show({"tables": found}, members, ([*map(each.get, members)] for each in found), json=options.json)
    return code


async def _import(path: Path, cache: ParamCache) -> tuple[ImportedTable, ...]:
    """Import one log.

    Raises:
        FileError: it is no log, or cannot be read.
        CacheError: the cache cannot be written.
    """
    if is_onboard_log(path):
        return (await import_onboard_log(path, cache),)
    try:
        return await import_log(path, cache)
    except LinkError as error:
        with suppress(OSError), path.open("rb") as file:
            kind = kind_of(file.read(BEGIN_SIZE)) or "neither a telemetry log (.tlog) nor one of .bin or .ulg"
            raise FileError(f"not imported: {kind}", source=str(path)) from error
        raise FileError(str(error).partition(": ")[2]) from error


# history


def history(
    vehicle: str,
    /,
    *names: str,
    since: str | None = None,
    snapshots: bool = False,
    extended: bool = False,
    options: CacheOptions = CacheOptions(),
) -> None:
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
    if snapshots and names:
        raise UsageError("--snapshots lists whole tables and takes no parameter name")
    chosen, begin = check_given(names), None if since is None else parse_time(since, time.time())
    with ParamCache(options.cache) as cache:
        tables = tables_in(cache, vehicle, extended=extended)
        key, component = tables[0].key, component_of(vehicle)
        kept = cache.snapshots(key, component, extended=extended)
        entries = cache.history(key, component, since=begin, extended=extended)
        loaded = cache.load_all(tables, extended=extended)
    if snapshots:
        kept = [each for each in kept if each.at >= (begin or 0)]
        columns = ["id", "time", "component", "params", "hash", "reason"]
        empty = "no snapshots: apply and restore store one before they write"
        item = {"snapshots": [snapshot_json(each) for each in kept]}
        show(item, columns, map(_snapshot_cells, kept), json=options.json, empty=empty)
        return
    if chosen:
        known = {each.name for each in entries}.union(*(each.params for each in loaded))
        selected = NameChoice(chosen).choose(known, f" of {key} in the cache")
        entries = [each for each in entries if each.name in selected]
    found = [history_json(each) for each in entries]
    members = ("component", "name", "old", "new", "by")
    rows = ([local_time(each.at), *map(line.get, members)] for each, line in zip(entries, found, strict=True))
    show({"history": found}, ["time", *members], rows, json=options.json, empty="no changes are in the cache")


def _snapshot_cells(each: SnapshotSummary) -> Sequence[object]:
    notes = [] if each.complete else ["not complete"]
    if each.ended is False:
        notes.append("interrupted, or still running")
    reason = f"{each.reason} ({', '.join(notes)})" if notes else each.reason
    return each.id, local_time(each.at), each.component, each.size, hash_text(each.hash), reason
