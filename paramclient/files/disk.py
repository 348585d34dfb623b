"""Parameter files on disk: read whole, and replaced whole or not at all."""

from __future__ import annotations

import os
import secrets
import stat
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from paramclient.errors import FileError
from paramclient.files.formats import LARGEST_FILE, Content, dumps, loads
from paramclient.files.includes import Includes
from paramclient.files.param_file import FileForm, ParamFile, as_form, form_of_name

__all__ = ["read_file", "write_file"]

if sys.platform == "win32":
    _HOW: Final = os.O_BINARY | os.O_NOINHERIT  # else its runtime would change the ends of lines
else:
    _HOW: Final = os.O_NONBLOCK | os.O_CLOEXEC

_NEW_MODE: Final = 0o666
"""Of a file that was not there, less what the user's umask takes away."""


def read_file(path: str | os.PathLike[str], *, form: FileForm | str | None = None) -> ParamFile:
    """Read a parameter file of any ground station. It blocks for as long as the disk does.

    A list of MAVProxy's or Mission Planner's form may include others with `@include FILE`, by a path that is
    relative to its folder: files in that folder, beside it, or below either. Their lines count in its place.

    Args:
        path: the file.
        form: the form that it has; None to tell by its content (see `loads`).

    Raises:
        FileError: it cannot be read, is too large to be one, has none of the forms or is damaged. Nothing of
            it is given then, and up to 20 bad lines are named.
        UsageError: no such form.
    """
    source = os.fspath(path)
    form = None if form is None else as_form(form)
    try:
        data = _read(source)
    except OSError as error:
        raise FileError(f"cannot be read: {error.strerror}", source=source) from error
    except ValueError as error:  # a NUL in the name
        raise FileError(f"cannot be read: {error}", source=source) from error
    return loads(data, source=source, form=form, includes=Includes.of(source, _read, size_max=LARGEST_FILE))


def write_file(
    path: str | os.PathLike[str], content: Content, *, form: FileForm | str | None = None
) -> FileForm:
    """Write a parameter file, in place of one that is there. It blocks for as long as the disk does.

    Until all of it is on the disk, the old file is there as it was; so it is when anything fails. Its mode is
    kept, and where the path is a symbolic link, the link stays and its target is replaced.

    Args:
        path: the file.
        content: a file as it was read, the parameters of one component, or of several.
        form: the form; None to go by the ending of the name.

    Returns:
        The form in which it was written.

    Raises:
        FileError: the form cannot say it, the ending stands for none, or the disk cannot take it.
        UsageError: no such form.
    """
    source = os.fspath(path)
    form = form_of_name(source) if form is None else as_form(form)
    data = dumps(content, form=form, target=source)
    try:
        _replace(Path(os.path.realpath(source)), data, source)
    except OSError as error:
        raise FileError(f"cannot be written: {error.strerror}", source=source) from error
    except ValueError as error:  # a NUL in the name
        raise FileError(f"cannot be written: {error}", source=source) from error
    return form


def _read(source: str) -> bytes:
    # a pipe that nobody writes to must not hold anyone up
    descriptor = os.open(source, os.O_RDONLY | _HOW)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise FileError("cannot be read: it is no regular file", source=source)
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            return file.read(LARGEST_FILE + 1)
    finally:
        os.close(descriptor)


def _replace(target: Path, data: bytes, source: str) -> None:
    """Put a file with this content in the place of another, or leave that as it is."""
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        mode = None
    if mode is not None and not stat.S_ISREG(mode):
        raise FileError("cannot be written: it is no regular file", source=source)
    beside = target.with_name(f".{target.name[:200]}.{secrets.token_hex(8)}.tmp")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _HOW
    descriptor = os.open(beside, flags, _NEW_MODE)
    try:
        with os.fdopen(descriptor, "wb") as file:
            if mode is not None and sys.platform != "win32":
                os.fchmod(descriptor, stat.S_IMODE(mode))
            file.write(data)
            file.flush()
            os.fsync(descriptor)
        beside.replace(target)
    except BaseException:
        with suppress(OSError):
            beside.unlink()
        raise
    _sync_folder(target.parent)


def _sync_folder(folder: Path) -> None:
    """Have the new name on the disk too. The file is in its place by then, so a failure is not told."""
    if sys.platform != "win32":  # where a folder cannot be opened
        with suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
