"""`@include FILE` in lists of parameters: which files it may name, and reading them.

ArduPilot's build tools put the named file in the place of the line (chibios_hwdef.py), its path relative to
the file with the line. In ArduPilot's tree all of them name a file in a folder beside that of the file.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.files.text import decode_text

__all__ = ["Include", "Includes"]

DEPTH_MAX: Final = 8
"""Files that may include each other in a row."""
FILES_MAX: Final = 64
"""Files that one file may bring in, in all: two lines in each of a few files would bring in thousands."""


@dataclass(frozen=True, slots=True)
class Include:
    """An included file.

    Attributes:
        text: what it holds.
        source: its name, for errors.
        includes: those of its own lines.
    """

    text: str
    source: str
    includes: Includes


@dataclass(slots=True)
class _Budget:
    size: int
    files: int = FILES_MAX


@dataclass(frozen=True, slots=True)
class Includes:
    """Follows the `@include` lines of one file.

    A path is relative to the folder of the file with the line. The file must lie in the folder of the first
    file, beside that folder, or below either; symbolic links are followed before that is looked at.

    Args:
        source: the file's name as it was given.
        read: reads a file; OSError where it cannot be read, FileError where it is not to be.
        chain: the real paths of the files that include each other, from the first one to this one.
        budget: what all of them together may still bring in.
    """

    source: str
    read: Callable[[str], bytes]
    chain: tuple[Path, ...]
    budget: _Budget

    @classmethod
    def of(cls, source: str, read: Callable[[str], bytes], *, size_max: int) -> Includes:
        """Those of a file on the disk that nothing includes, of at most so many bytes in all."""
        return cls(source, read, (Path(os.path.realpath(source)),), _Budget(size_max))

    def follow(self, path: str) -> Include:
        """Read the file that a line names.

        Raises:
            UsageError: it is not to be included or cannot be read; the reason in words.
            FileError: it is no text.
        """
        if PurePath(path).is_absolute():
            raise UsageError("an absolute path is not followed")
        name = str(Path(self.source).parent / path)
        try:
            real = Path(os.path.realpath(name))
            self._check(real)
            data = self.read(name)
        except FileError as error:
            raise UsageError(f"{name} {error.reason}") from None
        except OSError as error:
            raise UsageError(f"{name} cannot be read: {error.strerror}") from None
        self.budget.files -= 1
        self.budget.size -= len(data)
        if self.budget.size < 0:
            raise UsageError("the files that are included are too large")
        includes = Includes(name, self.read, (*self.chain, real), self.budget)
        return Include(decode_text(data, name), name, includes)

    def _check(self, real: Path) -> None:
        """Raise UsageError where this file is not to be included."""
        top = self.chain[0].parent.parent
        if not real.is_relative_to(top):
            raise UsageError(f"it lies outside of {top}; files are included from there")
        if real in self.chain:
            raise UsageError("the files include each other in a circle")
        if len(self.chain) > DEPTH_MAX:
            raise UsageError(f"more than {DEPTH_MAX} files include each other in a row")
        if self.budget.files == 0:
            raise UsageError(f"more than {FILES_MAX} files are included")
