"""Whose a file is, and who else can get at it: for files that hold secrets, or are believed."""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path
from typing import Final

__all__ = [
    "GROUP_READS",
    "OF_OTHERS",
    "OTHERS_WRITE",
    "has_trusted_owner",
    "is_own",
    "make_private",
    "mode_of",
]

OF_OTHERS: Final = 0o077
"""The bits of a file's mode that let others than its owner get at it."""
OTHERS_WRITE: Final = 0o022
"""Those of them that let others change it."""
GROUP_READS: Final = 0o040


def mode_of(status: os.stat_result) -> int:
    """Return what a file's mode allows to whom, without its kind; of Windows, which has no such modes, 0."""
    return 0 if sys.platform == "win32" else stat.S_IMODE(status.st_mode)


def is_own(status: os.stat_result) -> bool:
    """Return whether a file belongs to the user of this process; of Windows, which does not say, True."""
    return sys.platform == "win32" or status.st_uid == os.geteuid()


def has_trusted_owner(status: os.stat_result) -> bool:
    """Return whether a file belongs to the user of this process, or to root, who can change it anyway."""
    return is_own(status) or status.st_uid == 0


def make_private(path: Path) -> int:
    """Take everybody's access but its owner's away from a file that others can write; return the mode it had.

    Raises:
        OSError: that is not possible.
    """
    mode = mode_of(path.stat())
    if mode & OTHERS_WRITE:
        path.chmod(mode & ~OF_OTHERS)
    return mode
