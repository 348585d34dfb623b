"""Characters that draw quantities on a terminal: blocks, or ASCII where the encoding has no blocks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, TextIO, TypeAlias

__all__ = ["ASCII", "BLOCKS", "Marks", "Piece", "marks_for"]

Piece: TypeAlias = tuple[str, str]
"""A part of a line: text that any terminal can show, and its style for rich."""


@dataclass(frozen=True, slots=True)
class Marks:
    """The characters of a drawing.

    Attributes:
        levels: the heights of a column, from zero to the full one.
    """

    levels: str

    @property
    def full(self) -> str:
        """The full column."""
        return self.levels[-1]

    def column(self, share: float) -> str:
        """Return the column for a share from 0 to 1: the lowest for zero only, the full one for 1 only."""
        if share <= 0.0:
            return self.levels[0]
        between = len(self.levels) - 2
        return self.full if share >= 1.0 else self.levels[min(math.floor(share * between), between - 1) + 1]


BLOCKS: Final = Marks(levels="▁▂▃▄▅▆▇█")
"""Block elements of Unicode."""
ASCII: Final = Marks(levels="_-:=+*%#")
"""The same in ASCII."""


def marks_for(output: TextIO) -> Marks:
    """Return the characters that an output can show."""
    try:
        BLOCKS.levels.encode(output.encoding or "ascii")
    except (LookupError, UnicodeEncodeError):
        return ASCII
    return BLOCKS
