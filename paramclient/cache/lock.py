"""A lock on the folder of a cache, for what must not be done by two processes at once."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from paramclient.errors import CacheError

__all__ = ["BUSY_TIMEOUT", "locked", "try_to_lock"]

BUSY_TIMEOUT: Final = 5.0
"""Seconds to wait for another process. Its transactions take milliseconds; who holds the file for longer is
stuck, and the cache is not worth the wait."""

_LOCK_POLL: Final = 0.01
_LOCK_FILE: Final = ".paramclient.lock"
"""What is locked on Windows, where a folder cannot be: it stays in the folder, empty."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder against every other process and thread that would open, create or rename a cache.

    Raises:
        OSError: there is no such folder.
        CacheError: another process holds it for longer than `BUSY_TIMEOUT`.
    """
    descriptor = _open(folder)
    try:
        deadline = time.monotonic() + BUSY_TIMEOUT
        while not try_to_lock(descriptor):
            if time.monotonic() > deadline:
                raise CacheError(f"another process holds the folder {folder}")
            time.sleep(_LOCK_POLL)
        yield
    finally:
        os.close(descriptor)  # and the lock goes with it


def try_to_lock(descriptor: int) -> bool:
    """Lock a file or folder until its descriptor is closed or this process ends.

    False where another descriptor holds it.
    """
    from filelock import lock_descriptor  # only here: it adds 10 ms to the import of paramclient

    return lock_descriptor(descriptor, blocking=False)


if sys.platform == "win32":

    def _open(folder: Path) -> int:
        return os.open(folder / _LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_NOINHERIT, 0o600)

else:

    def _open(folder: Path) -> int:
        return os.open(folder, os.O_RDONLY)
