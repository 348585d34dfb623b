"""Files on disk: reading, and atomic replacement."""

from __future__ import annotations

import os
import secrets
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from paramclient.errors import FileError

LARGEST_FILE: Final = 16 * 1024 * 1024
"""Largest parameter file, in bytes. 65,535 parameters, the most that an index can count, with names, bits,
defaults and comments take less in the longest format."""


def read_bytes(source: str) -> bytes:
    """Return the content of a file, at most one byte more than `LARGEST_FILE`.

    Raises:
        FileError: the file cannot be read, or is not a regular file.
    """
    with _named_errors(source, "read"):
        if not stat.S_ISREG(Path(source).stat().st_mode):  # opening a pipe would wait for its other end
            raise FileError("cannot be read: not a regular file", source=source)
        with Path(source).open("rb") as file:
            return file.read(LARGEST_FILE + 1)


def replace_file(source: str, data: bytes, new_mode: int | None = None) -> None:
    """Replace a file atomically by one with this content; on failure, leave the old file unchanged.

    The mode is kept. If the path is a symbolic link, the link stays and its target is replaced.

    Args:
        source: the file.
        data: the content.
        new_mode: the mode of a file that did not exist; None for that of the user's umask.

    Raises:
        FileError: writing failed.
    """
    with _named_errors(source, "written"):
        target = Path(os.path.realpath(source))
        mode = new_mode
        with suppress(FileNotFoundError):
            mode = target.stat().st_mode
            if not stat.S_ISREG(mode):
                raise FileError("cannot be written: not a regular file", source=source)
        temporary = target.with_name(f".{target.name[:40]}.{secrets.token_hex(8)}.tmp")
        try:
            with temporary.open("xb") as file:
                if mode is not None and sys.platform != "win32":
                    os.fchmod(file.fileno(), stat.S_IMODE(mode))
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(target)
        finally:
            with suppress(OSError):  # it has become the target, unless an error ended this
                temporary.unlink()
        _sync_folder(target.parent)


def check_folder(source: str) -> None:
    """Check that a file can be created in the folder of a file, before work that takes long.

    Raises:
        FileError: as `replace_file` would raise.
    """
    with _named_errors(source, "written"):
        tempfile.TemporaryFile(dir=Path(os.path.realpath(source)).parent).close()


@contextmanager
def _named_errors(source: str, done: str) -> Iterator[None]:
    """Turn errors of the system into a FileError with the file's name."""
    try:
        yield
    except FileError:
        raise  # is a ValueError too, and has its path already
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        why = error.strerror if isinstance(error, OSError) else error
        raise FileError(f"cannot be {done}: {why}", source=source) from error


def _sync_folder(folder: Path) -> None:
    """Flush the new directory entry to disk. Ignores errors, as the file has been replaced already."""
    with suppress(OSError):  # Windows cannot open a folder
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
