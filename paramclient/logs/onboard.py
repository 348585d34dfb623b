"""On-board logs, ArduPilot's dataflash logs and PX4's ULog files: reading, and import into a cache."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Final

import anyio.to_thread

from paramclient.cache import ParamCache, StoredParam, TableUpdate
from paramclient.errors import FileError, UsageError
from paramclient.files.formats import AUTOPILOT, LogFormat
from paramclient.logs.logged_params import ImportedTable, OnboardLog
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import ParamType

LOG_MAGICS: Final = {b"ULog\x01\x12\x35": LogFormat.ULOG, b"\xa3\x95": LogFormat.DATAFLASH}
"""The first bytes of a ULog file, and of each message of a dataflash log."""


def is_onboard_log(path: str | os.PathLike[str]) -> bool:
    """Return whether a regular file begins as an on-board log. False if it cannot be read."""
    try:
        return _format_of(Path(path)) is not None
    except (OSError, ValueError):
        return False


def read_onboard_log(path: str | os.PathLike[str]) -> OnboardLog:
    """Read the parameters of an on-board log. Blocks: a log of 100 MB takes seconds.

    Args:
        path: a dataflash log (`.bin`) or a ULog file (`.ulg`); the content decides.

    Raises:
        FileError: the file cannot be read, is neither, is damaged, or has no parameters.
        UsageError: a ULog file, and pyulog is not installed.
    """
    source = os.fspath(path)
    try:
        file_format = _format_of(Path(source))
        # Both libraries print remarks on damaged parts, which would mix with the output of a program. They
        # take up to 0.3 s to load.
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            if file_format is LogFormat.DATAFLASH:
                from paramclient.logs.dataflash import read_dataflash

                return read_dataflash(source)
            if file_format is LogFormat.ULOG:
                from paramclient.logs.ulog import read_ulog

                return read_ulog(source)
    except UsageError:
        raise
    except ImportError:
        raise UsageError(f"{source}: ULog files need pyulog: pip install 'paramclient[logs]'") from None
    except OSError as error:
        raise FileError(f"cannot be read: {error.strerror}", source=source) from error
    except Exception as error:  # the libraries do not state what they raise for damaged files
        raise FileError(f"the log is damaged: {error}", source=source) from error
    raise FileError("neither a dataflash log nor a ULog file", source=source)


def _format_of(path: Path) -> LogFormat | None:
    """Return the format of a log; None if it is not a regular file of a known format."""
    if path.exists() and not path.is_file():
        return None
    with path.open("rb") as file:
        begin = file.read(max(map(len, LOG_MAGICS)))
    return next((each for magic, each in LOG_MAGICS.items() if begin.startswith(magic)), None)


async def import_onboard_log(path: str | os.PathLike[str], cache: ParamCache) -> ImportedTable:
    """Import the parameters of an on-board log into a cache, in one transaction.

    Each value and each change has the time of the log. Later observations in the cache stay unchanged, so
    logs may be imported in any order and repeatedly. A log does not say whether it has all parameters of the
    vehicle: the table is complete only after a fetch. A dataflash log has no types: they are those of the
    vehicle's cached table, else those of another cached vehicle of the same autopilot, else REAL32.

    Args:
        path: the log.
        cache: the cache to write to.

    Raises:
        FileError: as from `read_onboard_log`; or the log has no UTC time or no system id.
        UsageError: a ULog file, and pyulog is not installed.
        CacheError: the cache cannot be written.
    """
    return await anyio.to_thread.run_sync(lambda: _store(read_onboard_log(path), cache))


def _store(log: OnboardLog, cache: ParamCache) -> ImportedTable:
    identity = log.identity
    if log.boot_time is None:
        raise FileError(
            "not imported: the log has no UTC time, as no GPS receiver had a fix, so its values cannot be "
            "ordered with those in the cache. show, diff and save can read it",
            source=log.source,
        )
    if not identity.system:
        raise FileError("not imported: the log has no system id", source=log.source)
    types, boot = _types(log, cache), log.boot_time
    observed = [(log.began, each) for each in log.initial.values()] + [*log.changes]
    stored = [_stored(each, types, boot + time) for time, each in observed]
    update = partial(TableUpdate, identity=identity, component=AUTOPILOT, autopilot=identity.autopilot)
    times = [each.heard_at for each in stored]
    cache.merge([update(at=min(times)), update(at=max(times), params=stored)])
    notes = log.notes
    if untyped := sum(param.type is None and name not in types for name, param in log.initial.items()):
        notes += (f"the log has no types: {untyped} parameters that no cached table has are REAL32",)
    ids = identity.system, AUTOPILOT, identity.autopilot
    return ImportedTable(identity.key, *ids, params=len(log.at_end()), notes=notes)


def _types(log: OnboardLog, cache: ParamCache) -> Mapping[str, ParamType | int]:
    """Return types by name: those of the vehicle's cached table, else of another one."""
    types: dict[str, ParamType | int] = {}
    if log.file_format is LogFormat.DATAFLASH:
        own = log.identity.key, AUTOPILOT
        same = [each for each in cache.components() if each.autopilot == log.identity.autopilot]
        for each in sorted(same, key=lambda each: (each.key, each.component) == own):
            table = cache.load(each.key, each.component)
            if table is not None:  # another process may have removed it
                types |= {name: param.type for name, param in table.params.items()}
    return types


def _stored(param: WrittenParam, types: Mapping[str, ParamType | int], at: float) -> StoredParam:
    """Return the observation of a logged value; as a REAL32 if its type is unknown or cannot hold it."""
    kind = types.get(param.name, ParamType.REAL32) if param.type is None else param.type
    try:
        return StoredParam.of(WrittenParam(param.name, param.value, kind, param.default), at)
    except UsageError:
        return StoredParam.of(WrittenParam(param.name, param.value, ParamType.REAL32), at)
