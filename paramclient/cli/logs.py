"""The subcommand import: logs into the cache."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Final

from paramclient.cache import ParamCache
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import ExitCode, code_of, print_json, print_table, report
from paramclient.errors import FileError, LinkError, ParamClientError
from paramclient.files.conversion import kind_of
from paramclient.logs.imports import ImportedTable, import_log, import_onboard_log
from paramclient.logs.onboard import is_onboard_log
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import hash_text

KIND_BYTES: Final = 4096
"""Bytes at the beginning of a file that identify its format."""

_DEFAULTS: Final = CacheOptions()


async def import_(file: Path, /, *files: Path, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """Import logs into the cache: vehicles, tables and changes, with the times of the logs.

    Later values in the cache are kept, so neither order nor repetition matters. All files are tried even if
    one cannot be read.

    Args:
        file: A telemetry log (.tlog), or an on-board log of ArduPilot (.bin) or PX4 (.ulg).
        files: Further logs.
    """
    code, found = ExitCode.DONE, []
    with ParamCache(options.cache) as cache:
        for each in (file, *files):
            try:
                tables = await _import(each, cache)
            except ParamClientError as error:
                report(str(error))
                code = max(code, code_of(error))
                continue
            for table in tables:
                autopilot = None if table.autopilot is None else autopilot_name(table.autopilot)
                more = {"autopilot": autopilot, "hash": hash_text(table.hash)}
                found.append({"file": str(each)} | asdict(table) | more)
                for note in table.notes:
                    report(f"{each.name}, {table.system}/{table.component}: {note}")
            if not tables:
                report(f"{each} has no parameters")
    if options.json:
        print_json({"tables": found})
    elif found:
        columns = ["file", "component", "autopilot", "params", "complete", "hash", "key"]
        rows = (
            {
                **each,
                "file": Path(each["file"]).name,
                "component": f"{each['system']}/{each['component']}",
                "complete": "yes" if each["complete"] else "no",
            }
            for each in found
        )
        print_table(columns, ([row[name] for name in columns] for row in rows), right="params")
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
            kind = kind_of(file.read(KIND_BYTES)) or "neither a telemetry log (.tlog) nor one of .bin or .ulg"
            raise FileError(f"not imported: {kind}", source=str(path)) from error
        raise FileError(str(error).partition(": ")[2]) from error
