"""`@include FILE` in parameter lists: which files may be included, and reading them.

ArduPilot's build tools replace the line with the named file (chibios_hwdef.py); its path is relative to the
file with the line. In ArduPilot's tree, all such lines name a file in a folder next to that of the file.
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

INCLUDE_DEPTH_MAX: Final = 8
"""Largest depth of nested `@include` lines, so that a chain of files ends."""
FILES_MAX: Final = 64
"""Files that one file may include in total. Two lines in each of a few files could include thousands."""


@dataclass(frozen=True, slots=True)
class Include:
    """An included file.

    Attributes:
        text: the content.
        source: the file's name, for errors.
        includes: reads the files that this file includes.
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
    """Reads the files of the `@include` lines of one file.

    A path is relative to the folder of the file with the line. The included file must be in the folder of the
    first file, beside that folder, or below either; symbolic links are resolved before the check.

    Args:
        source: the file's name as given.
        read: reads a file; raises OSError if it cannot be read, FileError if it must not be.
        chain: the real paths of the files that include each other, from the first file to this one.
        budget: the files and bytes that all of them together may still include.
    """

    source: str
    read: Callable[[str], bytes]
    chain: tuple[Path, ...]
    budget: _Budget

    @classmethod
    def of(cls, source: str, read: Callable[[str], bytes], *, size_max: int) -> Includes:
        """Return the includes of a file on disk, limited to a total size in bytes."""
        return cls(source, read, (Path(os.path.realpath(source)),), _Budget(size_max))

    def follow(self, path: str) -> Include:
        """Read the file of an `@include` line.

        Raises:
            UsageError: the file must not be included or cannot be read; with the reason in words.
            FileError: the file is not text.
        """
        if PurePath(path).is_absolute():
            raise UsageError("absolute paths are not allowed")
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
            raise UsageError("the included files are too large together")
        includes = Includes(name, self.read, (*self.chain, real), self.budget)
        return Include(decode_text(data, name), name, includes)

    def _check(self, real: Path) -> None:
        """Raise UsageError if the file must not be included."""
        top = self.chain[0].parent.parent
        if not real.is_relative_to(top):
            raise UsageError(f"it lies outside of {top}; only files below that folder can be included")
        if real in self.chain:
            raise UsageError("the files include each other (circular @include)")
        if len(self.chain) > INCLUDE_DEPTH_MAX:
            raise UsageError(f"@include is nested more than {INCLUDE_DEPTH_MAX} files deep")
        if self.budget.files == 0:
            raise UsageError(f"more than {FILES_MAX} files are included")
