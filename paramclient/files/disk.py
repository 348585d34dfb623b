"""Reading parameter files from disk, and replacing them atomically."""

from __future__ import annotations

import os
import secrets
import stat
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

from paramclient.errors import FileError
from paramclient.files.conversion import LARGEST_FILE, dumps, loads
from paramclient.files.formats import FileFormat, ParamFile, format_of_name, parse_format
from paramclient.files.includes import Includes
from paramclient.model.paramset import ParamSet

__all__ = [
    "read_bytes",
    "read_file",
    "write_file",
]

if sys.platform == "win32":
    _OPEN_FLAGS: Final = os.O_BINARY | os.O_NOINHERIT  # text mode would convert line ends
else:
    _OPEN_FLAGS: Final = os.O_NONBLOCK | os.O_CLOEXEC

_NEW_FILE_MODE: Final = 0o666
"""Mode of a new file, before the user's umask."""


def read_file(path: str | os.PathLike[str], *, file_format: FileFormat | str | None = None) -> ParamFile:
    """Read a parameter file of any supported format. Blocks until the disk has delivered it.

    A list in MAVProxy's or Mission Planner's format may include others with `@include FILE`. The path is
    relative to the file's folder, and the included file must be in that folder, beside it, or below either.
    Its lines replace the `@include` line.

    Args:
        path: the file.
        file_format: the format; None to detect it from the content (see `loads`).

    Raises:
        FileError: the file cannot be read, is too large, has no known format or is damaged. Nothing is
            returned then; the error names up to 20 bad lines.
        UsageError: unknown format.
    """
    source = os.fspath(path)
    file_format = None if file_format is None else parse_format(file_format)
    data = read_bytes(source)
    return loads(
        data,
        source=source,
        file_format=file_format,
        includes=Includes.of(source, _read, size_max=LARGEST_FILE),
    )


def read_bytes(source: str) -> bytes:
    """Return the content of a file, at most one byte more than `LARGEST_FILE`.

    Raises:
        FileError: the file cannot be read, or is not a regular file.
    """
    try:
        return _read(source)
    except FileError:
        raise  # is a ValueError too, and has its path already
    except OSError as error:
        raise FileError(f"cannot be read: {error.strerror}", source=source) from error
    except ValueError as error:  # a NUL in the path
        raise FileError(f"cannot be read: {error}", source=source) from error


def write_file(
    path: str | os.PathLike[str],
    content: ParamFile | ParamSet | Iterable[ParamSet],
    *,
    file_format: FileFormat | str | None = None,
) -> FileFormat:
    """Write a parameter file, and replace an existing one atomically. Blocks until the file is on disk.

    The old file stays unchanged until the new one is completely on disk, and also if writing fails. The mode
    is kept. If the path is a symbolic link, the link stays and its target is replaced.

    Args:
        path: the file.
        content: a file as read, the parameters of one component, or of several.
        file_format: the format; None to choose it by the file extension.

    Returns:
        The format of the written file.

    Raises:
        FileError: the format cannot express the content, the extension is unknown, or writing failed.
        UsageError: unknown format.
    """
    source = os.fspath(path)
    file_format = format_of_name(source) if file_format is None else parse_format(file_format)
    data = dumps(content, file_format=file_format, target=source)
    _replace_file(source, data)
    return file_format


def _replace_file(source: str, data: bytes) -> None:
    """Replace a file atomically by one with this content; on failure, leave the old file unchanged.

    Args:
        source: the file. If it is a symbolic link, its target is replaced.
        data: the new content.

    Raises:
        FileError: writing failed.
    """
    try:
        _replace(Path(os.path.realpath(source)), data, source)
    except FileError:
        raise  # is a ValueError too, and has its path already
    except OSError as error:
        raise FileError(f"cannot be written: {error.strerror}", source=source) from error
    except ValueError as error:  # a NUL in the path
        raise FileError(f"cannot be written: {error}", source=source) from error


def _read(source: str) -> bytes:
    # With O_NONBLOCK, opening a pipe without a writer does not block.
    descriptor = os.open(source, os.O_RDONLY | _OPEN_FLAGS)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise FileError("cannot be read: not a regular file", source=source)
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            return file.read(LARGEST_FILE + 1)
    finally:
        os.close(descriptor)


def _replace(target: Path, data: bytes, source: str) -> None:
    """Replace a file by one with this content; on failure, leave the old file unchanged."""
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        mode = None
    if mode is not None and not stat.S_ISREG(mode):
        raise FileError("cannot be written: not a regular file", source=source)
    temporary = target.with_name(f".{target.name[:200]}.{secrets.token_hex(8)}.tmp")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _OPEN_FLAGS
    descriptor = os.open(temporary, flags, _NEW_FILE_MODE)
    try:
        with os.fdopen(descriptor, "wb") as file:
            if mode is not None and sys.platform != "win32":
                os.fchmod(descriptor, stat.S_IMODE(mode))
            file.write(data)
            file.flush()
            os.fsync(descriptor)
        temporary.replace(target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    _sync_folder(target.parent)


def _sync_folder(folder: Path) -> None:
    """Flush the new directory entry to disk. Ignores errors, as the file has been replaced already."""
    if sys.platform != "win32":  # Windows cannot open a folder
        with suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
