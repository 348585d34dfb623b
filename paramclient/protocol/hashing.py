"""Which parameters a PX4 vehicle leaves out of its hash: found by recomputing the hash, not believed.

PX4 does not count volatile parameters into `_HASH_CHECK`, and which ones are volatile depends on its version.
The names below are only where the search begins; the set is *known* when the hash that is computed without
it equals the one the vehicle announced.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations
from typing import Final

from paramclient.values import Param, crc32_px4, hash_chunk

__all__ = ["find_volatile"]

MOST_HASHED: Final = 1_000_000
"""Parameters that go into hashes while single names are tried, about a tenth of a second: trying one costs a
hash of the whole table."""

# Groups of PX4 parameters marked @volatile in one firmware or another: calibration that is learnt in flight,
# flight counters, and what follows the place on earth.
_GROUPS = tuple(
    re.compile(pattern)
    for pattern in (
        r"CAL_ACC\d_[XYZ](OFF|SCALE)",
        r"CAL_GYRO\d_[XYZ]OFF",
        r"CAL_MAG\d_[XYZ](OFF|SCALE|ODIAG)",
        r"CAL_MAG\d_[XYZ]COMP",
        r"CAL_BARO\d_OFF",
        r"ASPD_SCALE_\d",
        r"LND_FLIGHT_T_(HI|LO)",
        r"COM_FLIGHT_UUID",
        r"EKF2_MAG_DECL",
        r"SENS_DPRES_OFF",
    )
)


def find_volatile(
    params: Sequence[Param], announced: int, *, believed: Iterable[str] = ()
) -> tuple[frozenset[str], bool]:
    """The names that a vehicle left out when it computed its hash.

    Tries what is believed (from an earlier session), the usual groups, none, the usual groups but for one or
    two of them, and then the first guess with each single name taken out or in.

    Args:
        params: the parameters that have an index.
        announced: the vehicle's hash for exactly these.
        believed: names that an earlier download proved, or that changed under an unchanged hash.

    Returns:
        The names, and True when the hash agrees. Without agreement: the best guess, and False.
    """
    chunks = sorted((param.name, hash_chunk(param)) for param in params)
    guess: frozenset[str] | None = None
    for candidate in _candidates([name for name, _ in chunks], frozenset(believed)):
        if guess is None:
            guess = candidate
        if crc32_px4(b"".join(chunk for name, chunk in chunks if name not in candidate)) == announced:
            return candidate, True
    return guess or frozenset(), False


def _candidates(names: Sequence[str], believed: frozenset[str]) -> Iterator[frozenset[str]]:
    groups = [frozenset(name for name in names if group.fullmatch(name)) for group in _GROUPS]
    groups = [group for group in groups if group]
    usual = frozenset().union(*groups)
    first = (believed & frozenset(names)) | usual
    yield first
    if believed:
        yield believed & frozenset(names)
    yield usual
    yield frozenset()
    for left_out in (1, 2):
        for some in combinations(groups, left_out):
            yield usual.difference(*some)
    for name in names[: MOST_HASHED // max(len(names), 1)]:
        yield first ^ {name}
