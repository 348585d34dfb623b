"""Notes about running set-ups on the disk, so that an interrupted set-up can be reported.

Each note is a small file in a folder beside the cache, locked by the process that runs the set-up. The
operating system releases the lock when that process ends; a file without a lock belongs to an interrupted
set-up.
"""

from __future__ import annotations

import json
import logging
import os
import stat
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

from paramclient.cache.lock import try_to_lock
from paramclient.errors import CacheError

__all__ = ["InterruptedSetup", "RunningSetup", "SetupNotes"]

INTERRUPTED_MAX: Final = 64
"""Maximum number of interrupted set-ups that are kept, the newest."""
NOTE_BYTES_MAX: Final = 65_536
"""Maximum size of one file in bytes: its first line, and a line for each second of half an hour."""
NOTE_INTERVAL: Final = 1.0
"""Seconds between two progress notes of a set-up: the last note may be older by this time."""
_SUFFIX: Final = ".json"
"""Suffix of the files."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class InterruptedSetup:
    """An interrupted set-up: its process ended before the set-up did.

    Attributes:
        id: its id.
        kind: "apply" or "restore".
        key: key of the vehicle in the cache, or None if it was not known yet.
        link, system, component: link and ids of the vehicle.
        requested_by: the user who has requested it.
        began: start time, in unix seconds.
        at: last time at which it was known to run, in unix seconds.
        done, total: values written by then, and known values to write.
        is_reported: whether it was reported already.
    """

    id: str
    kind: str
    key: str | None
    link: str
    system: int
    component: int
    requested_by: str
    began: float
    at: float
    done: int = 0
    total: int = 0
    is_reported: bool = False


class RunningSetup:
    """The note of a set-up that runs in this process.

    Args:
        path: the file.
        descriptor: the locked file descriptor.
        clock: returns unix seconds.
    """

    def __init__(self, path: Path, descriptor: int, clock: Callable[[], float]) -> None:
        self._path = path
        self._descriptor = descriptor
        self._clock = clock
        self._length = os.fstat(descriptor).st_size
        self._noted_at = -NOTE_INTERVAL
        self._far: dict[str, Any] = {}

    def note(self, **far: Any) -> None:
        """Write its progress (`done`, `total`, `key`), at most once a second. A power loss may lose it."""
        self._far = far
        if abs(self._clock() - self._noted_at) >= NOTE_INTERVAL:
            self._write()

    def end(self) -> None:
        """Remove the note after the end of the set-up."""
        with suppress(OSError):
            os.close(self._descriptor)
        with suppress(OSError):
            self._path.unlink()
            _sync_folder(self._path.parent)

    def cut_off(self) -> None:
        """Write the last progress and keep the note: the process ends before the set-up."""
        self._write()
        with suppress(OSError):
            os.fsync(self._descriptor)
            os.close(self._descriptor)

    def _write(self) -> None:
        self._noted_at = self._clock()
        line = _line({**self._far, "at": self._noted_at})
        if self._length + len(line) > NOTE_BYTES_MAX:
            return
        with suppress(OSError):  # the first line exists, which is enough to report the set-up
            self._length += os.write(self._descriptor, line)


class SetupNotes:
    """The notes of all running and interrupted set-ups of a cache. Every call blocks.

    Args:
        folder: the folder; created with the first note.
        clock: returns unix seconds.
    """

    def __init__(self, folder: Path, *, clock: Callable[[], float] = time.time) -> None:
        self.folder = folder
        self._clock = clock

    @classmethod
    def beside(cls, cache: str | os.PathLike[str]) -> SetupNotes:
        """Return the notes of a cache: in the folder with its name and the suffix `.setups`."""
        return cls(Path(cache).with_suffix(".setups"))

    def begin(
        self,
        name: str,
        kind: str,
        *,
        link: str,
        system: int,
        component: int,
        requested_by: str,
        key: str | None,
    ) -> RunningSetup:
        """Write a note about a new set-up, and sync it to the disk.

        Args:
            name: id of the set-up.
            kind: "apply" or "restore".
            link, system, component: link and ids of the vehicle.
            requested_by: the user who has requested it.
            key: key of the vehicle in the cache, or None.

        Raises:
            CacheError: the note cannot be written.
        """
        now = self._clock()
        begun = InterruptedSetup(name, kind, key, link, system, component, requested_by, now, now)
        path = self.folder / f"{name}{_SUFFIX}"
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            flags = os.O_CREAT | os.O_EXCL | os.O_RDWR
            descriptor = os.open(path, flags, 0o600)
            try:
                try_to_lock(descriptor)
                os.write(descriptor, _line(asdict(begun)))
                os.fsync(descriptor)
                _sync_folder(self.folder)
            except BaseException:
                os.close(descriptor)
                path.unlink()
                raise
        except OSError as error:
            raise CacheError(
                f"the note of the set-up cannot be written to {self.folder}: {error.strerror}"
            ) from error
        return RunningSetup(path, descriptor, self._clock)

    def cut_off(self, *, mark_reported: bool = False) -> list[InterruptedSetup]:
        """Return the interrupted set-ups, the oldest first; empty if the folder does not exist.

        Args:
            mark_reported: mark them as reported, and delete the oldest beyond `INTERRUPTED_MAX`.
        """
        paths: list[Path] = []
        with suppress(FileNotFoundError):
            paths = [path for path in self.folder.iterdir() if path.suffix == _SUFFIX]
        read = [self._read(path, mark_reported=mark_reported) for path in paths]
        found = sorted(filter(None, read), key=lambda note: note.at)
        if mark_reported:
            for note in found[:-INTERRUPTED_MAX]:
                (self.folder / f"{note.id}{_SUFFIX}").unlink(missing_ok=True)
        return found[-INTERRUPTED_MAX:]

    def _read(self, path: Path, *, mark_reported: bool) -> InterruptedSetup | None:
        """Return the note in a file; None if its set-up is running, or the file is not a note."""
        try:
            descriptor = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
        except OSError:
            return None
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode) or not try_to_lock(descriptor):
                return None
            note = _parsed(os.read(descriptor, NOTE_BYTES_MAX))
            if note is None or note.id != path.stem:
                return None
            if mark_reported and not note.is_reported:
                os.write(descriptor, _line({"is_reported": True}))
            return note
        except OSError as error:
            logger.warning("%s cannot be read: %s", path, error.strerror)
            return None
        finally:
            os.close(descriptor)


def _parsed(data: bytes) -> InterruptedSetup | None:
    """Return the note in a file: its first line, updated by later lines; None if it is not a note."""
    entry: dict[str, Any] = {}
    kinds = {"began": float, "at": float, "system": int, "component": int, "done": int, "total": int}
    for line in data.split(b"\n")[:-1]:
        try:
            found = json.loads(line)
            entry |= {each.name: found[each.name] for each in fields(InterruptedSetup) if each.name in found}
        except (ValueError, TypeError, RecursionError):
            break
    try:
        entry |= {name: kind(entry[name]) for name, kind in kinds.items() if name in entry}
        texts = [entry[name] for name in ("id", "kind", "link", "requested_by")]
        if not all(isinstance(text, str) for text in texts) or not isinstance(entry["key"], str | None):
            return None
        return InterruptedSetup(**entry)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _line(entry: dict[str, Any]) -> bytes:
    return json.dumps(entry, separators=(",", ":")).encode() + b"\n"


if sys.platform == "win32":

    def _sync_folder(folder: Path) -> None:
        """Do nothing: Windows cannot open a folder."""

else:

    def _sync_folder(folder: Path) -> None:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
