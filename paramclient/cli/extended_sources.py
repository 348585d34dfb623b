"""Extended parameters in the subcommands that need no link, or only read: show, save, diff and history."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import anyio.to_thread

from paramclient.cache import HistoryEntry, ParamCache
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.extended import (
    EXT_COLUMNS,
    cached_extended,
    differences_json,
    ext_cells,
    ext_text,
    extended_source,
    in_order,
)
from paramclient.cli.json_output import ExtParamJson
from paramclient.cli.options import CacheOptions, LinkOptions
from paramclient.cli.output import local_time, print_json, print_table, printable, say
from paramclient.cli.sources import component_of, is_file, tables_in
from paramclient.errors import NotInCache
from paramclient.files import FileFormat
from paramclient.files.disk import read_extended_file, write_extended_file
from paramclient.model.comparison import same_value
from paramclient.model.ext_values import encode_ext_value, ext_param
from paramclient.model.notation import time_text
from paramclient.model.paramset import WrittenParam
from paramclient.model.patterns import NameChoice
from paramclient.model.values import Param, ParamType, Trust

__all__ = ["diff_extended", "history_extended", "save_extended", "show_extended"]


def show_extended(vehicle: str | None, names: Sequence[str], options: CacheOptions) -> ExitCode:
    """Print extended parameters of a file, or cached ones."""
    if vehicle is not None and is_file(vehicle):
        params = [_param_of(each) for each in read_extended_file(vehicle).values()]
        description = f"{len(params)} extended parameters from {vehicle}"
    else:
        table = cached_extended(vehicle, options.cache)
        params = in_order(table.params.values())
        description = f"{len(params)} extended parameters of {table.key}, component {table.component}"
    if names:
        chosen, unmatched = NameChoice(names).choose({each.name for each in params})
        if unmatched:
            raise NotInCache(f"not among the extended parameters: {unmatched}")
        params = [each for each in params if each.name in chosen]
    if options.json:
        print_json({"extended": {each.name: ExtParamJson.of(each) for each in params}})
    else:
        print_table(EXT_COLUMNS, map(ext_cells, params), right="index")
        say(printable(description))
    return ExitCode.DONE


async def save_extended(
    where: str, file: Path, file_format: FileFormat | None, options: LinkOptions
) -> ExitCode:
    """Write extended parameters to a file. An incomplete table is not written."""
    content, _ = await extended_source(where, options)
    written = await anyio.to_thread.run_sync(
        lambda: write_extended_file(file, content, file_format=file_format)
    )
    count = len(content.params)
    if options.json:
        print_json(
            {
                "file": str(file),
                "format": written.value,
                "system": content.system,
                "component": content.component,
                "count": count,
            }
        )
    else:
        whose = f"{content.system}/{content.component}"
        say(printable(f"{count} extended parameters of {whose} written to {file} ({written})"))
    return ExitCode.DONE


async def diff_extended(
    left: str, right: str, options: LinkOptions, *, partial: bool, everything: bool
) -> ExitCode:
    """Compare the extended parameters of two sources."""
    first, known = await extended_source(left, options)
    second, other = await extended_source(right, options)
    names = list(dict.fromkeys((*first.params, *second.params)))
    if partial:
        names = list(second.params if is_file(right) and not is_file(left) else first.params)
    pairs = [(name, first.params.get(name), second.params.get(name)) for name in names]
    entries = [(name, one, two, _comparison(one, two)) for name, one, two in pairs]
    different = [entry for entry in entries if entry[3] != "same"]
    shown = entries if everything else different
    if options.json:
        sides = ((name, known.get(name, one), other.get(name, two), word) for name, one, two, word in shown)
        print_json(differences_json(sides, is_same=not different))
    else:
        if shown:
            rows = ((name, ext_text(one), ext_text(two), word) for name, one, two, word in shown)
            print_table(["name", "left", "right", "is"], rows)
        for side, content in (("left", first), ("right", second)):
            say(printable(f"{side}: {len(content.params)} extended parameters from {content.source}"))
        say(f"{len(entries) - len(different)} same, {len(different)} different")
    return ExitCode.DIFFERENT if different else ExitCode.DONE


def history_extended(
    vehicle: str, names: Sequence[str], options: CacheOptions, *, limit: int | None, since: float | None
) -> ExitCode:
    """Print the changes of a vehicle's extended parameters, the newest last."""
    with ParamCache(options.cache) as cache:
        key, component = tables_in(cache, vehicle)[0].key, component_of(vehicle)
        entries = cache.history(key, component, None, None if names else limit, since, extended=True)
    if names:
        choice = NameChoice(names)
        entries = [each for each in entries if choice.has(each.name)]
        entries = entries[-limit:] if limit else entries
    if options.json:
        print_json({"history": [_entry_json(each) for each in entries]})
        return ExitCode.DONE
    rows = (
        (local_time(each.at), each.component, each.name, ext_text(each.old), ext_text(each.new), each.by)
        for each in entries
    )
    print_table(["time", "component", "name", "old", "new", "by"], rows)
    return ExitCode.DONE


def _entry_json(entry: HistoryEntry) -> dict[str, object]:
    return {
        "time": time_text(entry.at),
        "at": entry.at,
        "component": entry.component,
        "name": entry.name,
        "old": ExtParamJson.of(entry.old),
        "new": None if entry.new is None else ExtParamJson.of(entry.new),
        "by": entry.by,
    }


def _param_of(written: WrittenParam) -> Param:
    number = written.type_number or ParamType.UNKNOWN
    return ext_param(written.name, encode_ext_value(written.settable, number), number, None, Trust.CACHED)


def _comparison(left: WrittenParam | None, right: WrittenParam | None) -> str:
    if left is None or right is None:
        return "only right" if left is None else "only left"
    return "same" if same_value(left, right) and left.type_number == right.type_number else "different"
