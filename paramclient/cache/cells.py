"""Database cells: checks of their types, and the cells of times and identities.

Cells that cannot have been written raise `Damaged`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, replace
from typing import Any, Final

from paramclient.errors import UsageError
from paramclient.model.identity import Identity

__all__ = [
    "Damaged",
    "MASK_64",
    "YEAR_10000",
    "are_times",
    "cells",
    "identity_cells",
    "read_identity",
    "signed",
    "time_cell",
]

YEAR_10000: Final = 253402300800.0
"""Unix seconds at the start of the year 10000, above every stored time."""
# Python types of a cell, by the letters of `cells`.
_KINDS: Final[dict[str, tuple[type, ...]]] = {
    "i": (int,),
    "f": (float,),
    "s": (str,),
    "I": (int, type(None)),
    "F": (float, type(None)),
    "S": (str, type(None)),
}
MASK_64: Final = (1 << 64) - 1
"""Mask of 64 bits, which converts a signed integer of the database to unsigned."""
_TIMES: Final[dict[tuple[object, ...], tuple[int, ...]]] = {}
"""Positions of times in a row, by the kinds and types of its cells, for valid rows so far."""


class Damaged(Exception):
    """The content of a store is not what was written to it. Internal: callers receive a CacheError."""

    kind = "damaged"


def cells(row: Sequence[object], kinds: str) -> Any:
    """Check the types of a row's cells, and return the row.

    Args:
        row: the cells.
        kinds: a letter for each cell: i integer, f time, s text; a capital letter if NULL is possible.

    Raises:
        Damaged: a cell has another type, or is not a valid time.
    """
    shape = (kinds, *map(type, row))
    times = _TIMES.get(shape)
    if times is None:  # the first row of this shape; the rows of a table have only a few shapes
        times = _TIMES[shape] = _times(row, kinds)
    for place in times:
        if not 0 <= row[place] < YEAR_10000:  # type: ignore[operator]  # the shape says that it is a float
            raise Damaged(f"a cell holds {row[place]!r:.40}")
    return row


def are_times(times: Sequence[float]) -> bool:
    """Return whether all of these are times to store, in a few calls."""
    return not times or (min(times) >= 0 and max(times) < YEAR_10000 and math.isfinite(sum(times)))


def time_cell(at: float) -> float:
    """Check and return a time to store.

    Raises:
        UsageError: the time is not in unix seconds, from 0 to before the year 10000.
    """
    if not 0 <= at < YEAR_10000:
        raise UsageError(f"{at!r} is not a time in unix seconds")
    return float(at)


def identity_cells(identity: Identity) -> tuple[object, ...]:
    """Return the cells of an identity, in the order of its attributes."""
    *described, capabilities = astuple(identity)
    return (*described, signed(capabilities))


def read_identity(row: Sequence[object]) -> Identity:
    """Return the identity of cells from `identity_cells`.

    Raises:
        Damaged: a cell has a wrong type.
    """
    identity = Identity(*cells(row, "isSiiisiiii"))
    return replace(identity, capabilities=identity.capabilities & MASK_64)


def _times(row: Sequence[object], kinds: str) -> tuple[int, ...]:
    """Return the positions of times in a row.

    Raises:
        Damaged: a cell has a wrong type.
    """
    for cell, kind in zip(row, kinds, strict=True):
        if not isinstance(cell, _KINDS[kind]):
            raise Damaged(f"a cell holds {cell!r:.40}")
    return tuple(place for place, cell in enumerate(row) if isinstance(cell, float))


def signed(number: int) -> int:
    """Return a 64-bit unsigned number as signed, the form of SQLite's integers."""
    return number - (1 << 64) if number >> 63 else number
