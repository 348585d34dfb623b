"""PX4's hash of its parameters, `_HASH_CHECK`: what it covers, and the search for the excluded parameters.

The hash is a CRC-32 over the name and the four value bytes of each parameter in use, in the order of the
names (`hash_bits`). Volatile parameters are excluded, and which ones are volatile depends on
PX4's version. The names below are only where the search begins (`find_volatile`); the set is *known* when the
hash recomputed without it equals the one that the vehicle announced.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import combinations
from operator import itemgetter
from typing import Final

HASHED_PARAMETERS_MAX: Final = 1_000_000
"""Parameters hashed while single names are tried, about 0.1 s: each attempt hashes the whole table."""
GROUP_NAMES_MAX: Final = 4_096
"""Names whose group is remembered: those of a few firmwares. A lookup of the group takes ten times as long,
and all vehicles of a fleet have the same names."""

# Groups of PX4 parameters marked @volatile in one firmware or another: calibration learnt in flight, flight
# counters, and values that depend on the location on earth.
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


def crc32_px4(data: bytes, crc: int = 0) -> int:
    """Return PX4's CRC-32: polynomial 0xEDB88320, reflected, start 0, no final xor (crc.c, `crc32part`).

    MAVFTP and component metadata use the same one for files.
    """
    return zlib.crc32(data, crc ^ 0xFFFFFFFF) ^ 0xFFFFFFFF


_STEPS = [crc32_px4(bytes((byte,))) for byte in range(256)]
_BYTES = {step >> 24: byte for byte, step in enumerate(_STEPS)}


def crc32_px4_before(crc: int, size: int) -> int:
    """Return the CRC-32 from which `size` zero bytes lead to this one: the inverse of `crc32_px4`.

    Of the difference of two checksums, it is for up to 4 bytes the difference of the last `size` bytes of two
    files that are equal before them.
    """
    for _ in range(size):
        byte = _BYTES[crc >> 24]
        crc = (crc ^ _STEPS[byte]) << 8 | byte
    return crc


def hash_bits(bits: Mapping[str, int], *, leave_out: Iterable[str] = ()) -> int:
    """Return the value of PX4's `_HASH_CHECK` for a table.

    Args:
        bits: the bits of the parameters in use (see `Param.bits`), by name; PX4's types have 4 bytes each.
        leave_out: names of volatile parameters, which PX4 excludes from the hash.
    """
    return _hash(_hashed_bytes(bits.items()), frozenset(leave_out))


def find_volatile(
    bits: Mapping[str, int], announced: int, *, believed: Iterable[str] = ()
) -> tuple[frozenset[str], bool]:
    """Return the names that a vehicle excluded when it computed its hash.

    Tries `believed` (from an earlier session), the usual groups, none, the usual groups except one or two of
    them, and then the first guess with each single name removed or added.

    Args:
        bits: the bits of the parameters that have an index (see `Param.bits`), by name.
        announced: the vehicle's hash for exactly these.
        believed: names that an earlier download proved, or that changed under an unchanged hash.

    Returns:
        The names, and True when the hash matches. Without a match: the best guess, and False.
    """
    hashed = _hashed_bytes(bits.items())
    guess: frozenset[str] | None = None
    for candidate in _candidates([name for name, _ in hashed], frozenset(believed)):
        if guess is None:
            guess = candidate
        if _hash(hashed, candidate) == announced:
            return candidate, True
    return guess or frozenset(), False


def _hashed_bytes(bits: Iterable[tuple[str, int]]) -> list[tuple[str, bytes]]:
    """Return the bytes that the hash covers of each parameter, with its name, in the order of the hash: the
    name without NUL, and the 4 value bytes."""
    return [
        (name, name.encode("latin-1") + (each & 0xFFFFFFFF).to_bytes(4, "little"))
        for name, each in sorted(bits, key=itemgetter(0))
    ]


def _hash(hashed: Iterable[tuple[str, bytes]], leave_out: frozenset[str]) -> int:
    return crc32_px4(b"".join(each for name, each in hashed if name not in leave_out))


@lru_cache(maxsize=GROUP_NAMES_MAX)
def _group_of(name: str) -> re.Pattern[str] | None:
    return next((group for group in _GROUPS if group.fullmatch(name)), None)


def _candidates(names: Sequence[str], believed: frozenset[str]) -> Iterator[frozenset[str]]:
    found = (frozenset(name for name in names if _group_of(name) is group) for group in _GROUPS)
    groups = [each for each in found if each]
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
    for name in names[: HASHED_PARAMETERS_MAX // max(len(names), 1)]:
        yield first ^ {name}
