"""Fuzz target: metadata of a file or a vehicle. Only FileError is raised, and all descriptions work."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.metadata.store import read_content

__all__ = ["INPUT_SIZE_MAX", "run"]

INPUT_SIZE_MAX: Final = 3000
"""Maximum bytes of an input: longer ones are slow and find nothing new."""

VALUES = (0, 1, -1, 255, 1 << 31, 0.0, 1.5, -0.0, math.nan, math.inf, 1e39, b"\1\2\3\4")
WORDS = ("", "0", "1.5", "0x10", "Enabled", "a,b", "1+2", "nan")


def run(data: bytes) -> None:
    """Read a metadata file with this content."""
    try:
        known = read_content(data, source="fuzz")
    except FileError as error:
        assert str(error).startswith("fuzz")
        return
    assert len(known) == len(list(known))
    for name, info in list(known.items())[:20]:
        assert name in known
        for value in VALUES:
            info.text(value)
            info.problem(value)
        for word in WORDS:
            with suppress(UsageError):
                info.parse(word)
