"""`@include FILE` in parameter lists: which files may be included, and reading them.

ArduPilot's build tools replace the line with the named file (chibios_hwdef.py); its path is relative to the
file with the line. In ArduPilot's tree, all such lines name a file in a folder next to that of the file.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.files.text import decode_text

__all__ = ["Includes"]

FILES_MAX: Final = 64
"""Files that one file may include in total, nested or not. Two lines in each of a few files could include
thousands."""


@dataclass(frozen=True, slots=True)
class Includes:
    """Reads the files of the `@include` lines of one file.

    A path is relative to the folder of the file with the line. The included file must be in the folder of the
    first file, beside that folder, or below either; symbolic links are resolved before the check.

    Args:
        source: the file's name as given.
        read_bytes: reads a file; raises OSError if it cannot be read, FileError if it must not be.
        size_max: bytes that all included files may have together.
        chain: the real paths of the files that include each other, from the first file to that of `source`.
    """

    source: str
    read_bytes: Callable[[str], bytes]
    size_max: int
    chain: tuple[Path, ...]
    _sizes: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, source: str, read_bytes: Callable[[str], bytes], *, size_max: int) -> Includes:
        """Return the includes of a file on disk."""
        return cls(source, read_bytes, size_max, (Path(os.path.realpath(source)),))

    def read(self, path: str) -> tuple[str, Includes]:
        """Return the text of the file of an `@include` line, and the reader of the files that it includes.

        Raises:
            UsageError: the file must not be included or cannot be read; with the reason in words.
            FileError: the file is not text.
        """
        if PurePath(path).is_absolute():
            raise UsageError("absolute paths are not allowed")
        name = str(Path(self.source).parent / path)
        real = Path(os.path.realpath(name))
        top = self.chain[0].parent.parent
        if not real.is_relative_to(top):
            raise UsageError(f"it lies outside of {top}; only files below that folder can be included")
        if real in self.chain:
            raise UsageError("the files include each other (circular @include)")
        if len(self._sizes) == FILES_MAX:
            raise UsageError(f"more than {FILES_MAX} files are included")
        try:
            data = self.read_bytes(name)
        except FileError as error:
            raise UsageError(f"{name} {error.reason}") from None
        except OSError as error:
            raise UsageError(f"{name} cannot be read: {error.strerror}") from None
        self._sizes.append(len(data))
        if sum(self._sizes) > self.size_max:
            raise UsageError("the included files are too large together")
        inner = Includes(name, self.read_bytes, self.size_max, (*self.chain, real), self._sizes)
        return decode_text(data, name), inner
