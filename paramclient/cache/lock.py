"""Lock on the folder of a cache, or on a file, between processes."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from paramclient.errors import CacheError

__all__ = ["LOCK_WAIT_MAX", "locked", "preload", "try_to_lock"]

LOCK_WAIT_MAX: Final = 5.0
"""Timeout in seconds for a lock of another process. Transactions take milliseconds; a process that holds a
lock for longer is blocked."""

_LOCK_POLL: Final = 0.01
"""Seconds between two attempts to lock the folder."""
_LOCK_FILE: Final = ".paramclient.lock"
"""Empty file that is locked on Windows, where a folder cannot be locked. It stays in the folder."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder against other processes and threads that open, create or rename a cache.

    Raises:
        OSError: the folder does not exist.
        CacheError: another process holds the lock for longer than `LOCK_WAIT_MAX`.
    """
    descriptor = _open(folder)
    try:
        deadline = time.monotonic() + LOCK_WAIT_MAX
        while not try_to_lock(descriptor):
            if time.monotonic() > deadline:
                raise CacheError(f"another process has locked the folder {folder} for {LOCK_WAIT_MAX:g} s")
            time.sleep(_LOCK_POLL)
        yield
    finally:
        os.close(descriptor)  # releases the lock


def try_to_lock(descriptor: int) -> bool:
    """Lock a file or folder until its descriptor is closed or this process ends.

    Return False if another descriptor holds the lock.
    """
    from filelock import lock_descriptor  # only here: it adds 10 ms to the import of paramclient

    return lock_descriptor(descriptor, blocking=False)


def preload() -> None:
    """Import what a lock needs, which takes much longer later, beside a busy event loop."""
    import filelock  # noqa: F401 - only here: it adds 10 ms to the import of paramclient


if sys.platform == "win32":

    def _open(folder: Path) -> int:
        return os.open(folder / _LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_NOINHERIT, 0o600)

else:

    def _open(folder: Path) -> int:
        return os.open(folder, os.O_RDONLY)
