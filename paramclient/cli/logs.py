"""The subcommand import: logs into the cache."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Final

import anyio
import anyio.to_thread

from paramclient.cache import ParamCache
from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import print_json, print_table, report
from paramclient.errors import FileError, LinkError, ParamClientError
from paramclient.files import read_file
from paramclient.logs.logged_params import ImportedTable
from paramclient.logs.onboard import import_onboard_log, is_onboard_log
from paramclient.logs.telemetry import import_log
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import hash_text

__all__ = ["import_"]

KIND_BYTES: Final = 4096
"""Bytes at the beginning of a file that identify its format."""
SQLITE_MAGIC: Final = b"SQLite format 3\0"
"""The first bytes of an SQLite database (its file format, section 1.3)."""

_DEFAULTS: Final = CacheOptions()


async def import_(file: Path, /, *files: Path, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """Import logs into the cache: vehicles, tables and changes, with the times of the logs.

    Later values in the cache are kept, so neither order nor repetition matters. All files are tried even if
    one cannot be read.

    Args:
        file: A telemetry log (.tlog), or an on-board log of ArduPilot (.bin) or PX4 (.ulg).
        files: Further logs.
    """
    found: list[tuple[Path, ImportedTable]] = []
    code = ExitCode.DONE
    with ParamCache(options.cache) as cache:
        for each in (file, *files):
            try:
                tables = await _import(each, cache)
            except ParamClientError as error:
                report(str(error))
                code = max(code, code_of(error))
                continue
            found += ((each, table) for table in tables)
            for table in tables:
                for note in table.notes:
                    report(f"{each.name}, {table.system}/{table.component}: {note}")
            if not tables:
                report(f"{each} has no parameters")
    if options.json:
        print_json({"tables": [_table_json(log, table) for log, table in found]})
    elif found:
        columns = ["file", "component", "autopilot", "params", "complete", "hash", "key"]
        print_table(columns, (_cells(*each) for each in found), right="params")
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
        kind = await anyio.to_thread.run_sync(_kind_of, path)
        if kind is None:
            raise FileError(str(error).partition(": ")[2]) from error
        raise FileError(f"not imported: {kind}", source=str(path)) from error


def _kind_of(path: Path) -> str | None:
    """Return the kind of a file that is no log, in words; None if it cannot be read."""
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            begin = file.read(KIND_BYTES)
    except OSError:
        return None
    if not begin:
        return "the file is empty"
    if begin.startswith(SQLITE_MAGIC):
        return "an SQLite database, and no log"
    with suppress(ParamClientError):
        file_format = read_file(path).file_format
        return f"a parameter file ({file_format}), and no log"
    with suppress(UnicodeDecodeError):
        begin.decode()
        return "a text file, and no log"
    return "neither a telemetry log (.tlog) nor an on-board log (.bin, .ulg): it has no MAVLink frame"


def _table_json(file: Path, table: ImportedTable) -> dict[str, object]:
    return {
        "file": str(file),
        "key": table.key,
        "system": table.system,
        "component": table.component,
        "autopilot": _autopilot(table),
        "params": table.params,
        "complete": table.complete,
        "hash": hash_text(table.hash),
        "notes": list(table.notes),
    }


def _cells(file: Path, table: ImportedTable) -> tuple[object, ...]:
    address = f"{table.system}/{table.component}"
    complete = "yes" if table.complete else "no"
    return (
        *(file.name, address, _autopilot(table), table.params),
        *(complete, hash_text(table.hash), table.key),
    )


def _autopilot(table: ImportedTable) -> str | None:
    return None if table.autopilot is None else autopilot_name(table.autopilot)
