"""Set-ups that run: noted on the disk, so that one whose process has ended can be told of.

Each is a small file in a folder beside the cache, locked by the process at work. The system takes the lock
away when that process ends, however it ends; a file that nobody has locked is of a set-up that was cut off.
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

__all__ = ["CutOff", "RunningSetup", "SetupNotes"]

MOST_KEPT: Final = 64
"""Set-ups that were cut off and are remembered, the newest."""
LONGEST_NOTE: Final = 65_536
"""Bytes of one file: its first line, and a line for each second of half an hour."""
NOTE_INTERVAL: Final = 1.0
"""Seconds between two notes of how far a set-up is: what is noted last may be older by that."""
_SUFFIX: Final = ".json"

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CutOff:
    """A set-up that has not come to its end, as the process at work ended before.

    Attributes:
        id: its name.
        kind: "apply" or "restore".
        key: of the vehicle in the cache, or None where it was not known yet.
        link, system, component: where the vehicle was heard.
        asked_by: for whom it was done.
        began: unix seconds.
        at: when it was last known to run, in unix seconds.
        done, total: values that were written by then, and that were to be written as far as known.
        is_told: whether it was told of already.
    """

    id: str
    kind: str
    key: str | None
    link: str
    system: int
    component: int
    asked_by: str
    began: float
    at: float
    done: int = 0
    total: int = 0
    is_told: bool = False


class RunningSetup:
    """The note of a set-up that runs in this process.

    Args:
        path: the file.
        descriptor: of the file, locked.
        clock: unix seconds.
    """

    def __init__(self, path: Path, descriptor: int, clock: Callable[[], float]) -> None:
        self._path = path
        self._descriptor = descriptor
        self._clock = clock
        self._length = os.fstat(descriptor).st_size
        self._noted_at = -NOTE_INTERVAL
        self._far: dict[str, Any] = {}

    def note(self, **far: Any) -> None:
        """Note how far it is (`done`, `total`, `key`), once a second. A power cut may take that."""
        self._far = far
        if abs(self._clock() - self._noted_at) >= NOTE_INTERVAL:
            self._write()

    def end(self) -> None:
        """It has come to an end, and needs no note any more."""
        with suppress(OSError):
            os.close(self._descriptor)
        with suppress(OSError):
            self._path.unlink()
            _sync_folder(self._path.parent)

    def cut_off(self) -> None:
        """It ends before its time, as the process does: leave the note."""
        self._write()
        with suppress(OSError):
            os.fsync(self._descriptor)
            os.close(self._descriptor)

    def _write(self) -> None:
        self._noted_at = self._clock()
        line = _line({**self._far, "at": self._noted_at})
        if self._length + len(line) > LONGEST_NOTE:
            return
        with suppress(OSError):  # the first line is there, and that is what counts
            self._length += os.write(self._descriptor, line)


class SetupNotes:
    """The notes of all set-ups that run over a cache, and of those that were cut off. Every call blocks.

    Args:
        folder: the folder; it is made when something is to be noted.
        clock: unix seconds.
    """

    def __init__(self, folder: Path, *, clock: Callable[[], float] = time.time) -> None:
        self.folder = folder
        self._clock = clock

    @classmethod
    def beside(cls, cache: str | os.PathLike[str]) -> SetupNotes:
        """Those that belong to a cache: the folder of its name with `.setups` for a suffix."""
        return cls(Path(cache).with_suffix(".setups"))

    def begin(
        self, name: str, kind: str, *, link: str, system: int, component: int, asked_by: str, key: str | None
    ) -> RunningSetup:
        """Note that a set-up begins. When this returns, it is on the disk.

        Raises:
            CacheError: it cannot be noted.
        """
        now = self._clock()
        begun = CutOff(name, kind, key, link, system, component, asked_by, now, now)
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
            raise CacheError(f"the set-up cannot be noted in {self.folder}: {error.strerror}") from error
        return RunningSetup(path, descriptor, self._clock)

    def cut_off(self, *, tells: bool = False) -> list[CutOff]:
        """The set-ups that were cut off, the first one first. Without the folder there are none.

        Args:
            tells: note that they are told of now; those beyond `MOST_KEPT` are forgotten then.
        """
        paths: list[Path] = []
        with suppress(FileNotFoundError):
            paths = [path for path in self.folder.iterdir() if path.suffix == _SUFFIX]
        read = [self._read(path, tells=tells) for path in paths]
        found = sorted(filter(None, read), key=lambda note: note.at)
        if tells:
            for note in found[:-MOST_KEPT]:
                (self.folder / f"{note.id}{_SUFFIX}").unlink(missing_ok=True)
        return found[-MOST_KEPT:]

    def _read(self, path: Path, *, tells: bool) -> CutOff | None:
        """What a file tells, unless it is of a set-up that runs, or none at all."""
        try:
            descriptor = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
        except OSError:
            return None
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode) or not try_to_lock(descriptor):
                return None
            note = _parsed(os.read(descriptor, LONGEST_NOTE))
            if note is None or note.id != path.stem:
                return None
            if tells and not note.is_told:
                os.write(descriptor, _line({"is_told": True}))
            return note
        except OSError as error:
            logger.warning("%s cannot be read: %s", path, error.strerror)
            return None
        finally:
            os.close(descriptor)


def _parsed(data: bytes) -> CutOff | None:
    """The note in a file: its first line, with what later lines say of it; None for anything else."""
    told: dict[str, Any] = {}
    kinds = {"began": float, "at": float, "system": int, "component": int, "done": int, "total": int}
    for line in data.split(b"\n")[:-1]:
        try:
            found = json.loads(line)
            told |= {each.name: found[each.name] for each in fields(CutOff) if each.name in found}
        except (ValueError, TypeError, RecursionError):
            break
    try:
        told |= {name: kind(told[name]) for name, kind in kinds.items() if name in told}
        texts = [told[name] for name in ("id", "kind", "link", "asked_by")]
        if not all(isinstance(text, str) for text in texts) or not isinstance(told["key"], str | None):
            return None
        return CutOff(**told)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _line(told: dict[str, Any]) -> bytes:
    return json.dumps(told, separators=(",", ":")).encode() + b"\n"


if sys.platform == "win32":

    def _sync_folder(folder: Path) -> None:
        """Nothing: a folder cannot be opened there."""

else:

    def _sync_folder(folder: Path) -> None:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
