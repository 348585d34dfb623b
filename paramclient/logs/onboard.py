"""Reading of on-board logs: ArduPilot's dataflash logs and PX4's ULog files."""

from __future__ import annotations

import io
import os
import stat
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import LogFormat
from paramclient.logs.logged_params import OnboardLog

__all__ = ["is_onboard_log", "read_onboard_log"]

ULOG_MAGIC: Final = b"ULog\x01\x12\x35"
"""The first bytes of a ULog file."""
DATAFLASH_MAGIC: Final = b"\xa3\x95"
"""The first bytes of each message of a dataflash log."""


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
        if file_format is None:
            raise FileError("neither a dataflash log nor a ULog file", source=source)
        # Both libraries print remarks on damaged parts, which would mix with the output of a program.
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            return _reader_of(file_format, source)(source)
    except UsageError:
        raise
    except OSError as error:
        raise FileError(f"cannot be read: {error.strerror}", source=source) from error
    except Exception as error:  # the libraries do not state what they raise for damaged files
        raise FileError(f"the log is damaged: {error}", source=source) from error


def _format_of(path: Path) -> LogFormat | None:
    """Return the format of a log; None if it is not a regular file of a known format."""
    if not stat.S_ISREG(path.stat().st_mode):
        return None
    with path.open("rb") as file:
        begin = file.read(len(ULOG_MAGIC))
    if begin == ULOG_MAGIC:
        return LogFormat.ULOG
    return LogFormat.DATAFLASH if begin.startswith(DATAFLASH_MAGIC) else None


def _reader_of(file_format: LogFormat, source: str) -> Callable[[str], OnboardLog]:
    """Return the reader of a format. Loads its library, which takes up to 0.3 s."""
    if file_format is LogFormat.DATAFLASH:
        from paramclient.logs.dataflash import read_dataflash

        return read_dataflash
    try:
        from paramclient.logs.ulog import read_ulog
    except ImportError:
        raise UsageError(f"{source}: ULog files need pyulog: pip install 'paramclient[logs]'") from None
    return read_ulog
