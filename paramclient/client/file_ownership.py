"""Owner and access rights of files with secrets or with trusted content."""

from __future__ import annotations

import errno
import os
import stat
import sys
from typing import BinaryIO, Final

__all__ = [
    "GROUP_READS",
    "OF_OTHERS",
    "has_trusted_owner",
    "is_own",
    "mode_of",
    "open_regular",
]

OF_OTHERS: Final = 0o077
"""Mode bits that give access to other users than the owner."""
GROUP_READS: Final = 0o040
"""Mode bit that gives read access to the group."""
_NO_WAIT: Final = getattr(os, "O_NONBLOCK", 0)  # Windows has neither the flag nor such pipes


def mode_of(status: os.stat_result) -> int:
    """Return the permission bits of a file's mode; 0 on Windows, which has no such modes."""
    return 0 if sys.platform == "win32" else stat.S_IMODE(status.st_mode)


def is_own(status: os.stat_result) -> bool:
    """Return whether a file belongs to the user of this process; True on Windows, which has no such ids."""
    return sys.platform == "win32" or status.st_uid == os.geteuid()


def has_trusted_owner(status: os.stat_result) -> bool:
    """Return whether a file belongs to the user of this process, or to root, who can change it anyway."""
    return is_own(status) or status.st_uid == 0


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading. Never waits, unlike `open` for a named pipe without a writer.

    Raises:
        OSError: the file cannot be opened, or is not a regular file.
    """
    file = open(path, "rb", opener=_open_at_once)  # noqa: SIM115 - the caller closes it
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "Not a regular file", os.fspath(path))
    return file


def _open_at_once(path: str, flags: int) -> int:
    return os.open(path, flags | _NO_WAIT)
