"""The parts of a download in progress: what was received, requested again, and is missing."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from paramclient.errors import UsageError

__all__ = ["DownloadRange", "DownloadRanges", "split_bytes", "split_indices"]


@dataclass(frozen=True, slots=True)
class DownloadRange:
    """One part of a download: consecutive indices of a list, or consecutive bytes of a file.

    Each index or byte of the part counts for one of the attributes.

    Attributes:
        received: indices or bytes received.
        requested_again: lost ones that were requested again and not received since.
        missing: neither received nor requested again.
    """

    received: int
    requested_again: int
    missing: int

    @property
    def size(self) -> int:
        """The number of indices or bytes."""
        return self.received + self.requested_again + self.missing


class DownloadRanges:
    """The parts of one download. They are counted when `split` is called, and not before.

    Args:
        unit: as below.
        split: counts the parts; see `split`.

    Attributes:
        unit: what is counted: "parameters" of a list, or "bytes" of the MAVFTP parameter file.
    """

    __slots__ = ("_split", "unit")

    def __init__(
        self, unit: Literal["parameters", "bytes"], split: Callable[[int], tuple[DownloadRange, ...]]
    ) -> None:
        self.unit: Literal["parameters", "bytes"] = unit
        self._split = split

    def split(self, number: int) -> tuple[DownloadRange, ...]:
        """Return the present state of `number` parts of nearly equal size, in order.

        Fewer if the download has fewer indices or bytes; none while its size is unknown, and after its end.
        May be called from any thread.

        Raises:
            UsageError: `number` is less than 1.
        """
        if number < 1:
            raise UsageError(f"a download is split into 1 part or more, not {number}")
        return self._split(number)

    def __repr__(self) -> str:
        return f"<DownloadRanges of {self.unit}>"


def split_indices(
    count: int, number: int, received: Container[int], requested: Container[int]
) -> tuple[DownloadRange, ...]:
    """Return `number` parts of the indices below `count`.

    Args:
        count: the number of indices.
        number: parts, at most.
        received: the received indices.
        requested: indices that were requested again; those in `received` as well do not count.
    """
    parts = []
    for first, last in pairwise(_bounds(count, number)):
        unreceived = [index for index in range(first, last) if index not in received]
        again = sum(index in requested for index in unreceived)
        parts.append(DownloadRange(last - first - len(unreceived), again, len(unreceived) - again))
    return tuple(parts)


def split_bytes(
    size: int, number: int, gaps: Iterable[tuple[int, int]], requested: Iterable[tuple[int, int]]
) -> tuple[DownloadRange, ...]:
    """Return `number` parts of a file.

    Args:
        size: bytes of the file.
        number: parts, at most.
        gaps: first byte and end of what was not received, rising and apart from each other.
        requested: the same of what was requested again: parts of gaps, rising and apart from each other.
    """
    bounds = _bounds(size, number)
    unreceived, again = _overlaps(bounds, gaps), _overlaps(bounds, requested)
    return tuple(
        DownloadRange(last - first - lost, repeated, lost - repeated)
        for (first, last), lost, repeated in zip(pairwise(bounds), unreceived, again, strict=True)
    )


def _bounds(size: int, number: int) -> list[int]:
    """Return the beginnings of the parts, and the end of the last one."""
    number = min(number, size)
    return [size * at // number for at in range(number + 1)] if number else []


def _overlaps(bounds: list[int], spans: Iterable[tuple[int, int]]) -> list[int]:
    """Return how much of each part the spans cover."""
    covered = [0] * max(len(bounds) - 1, 0)
    at = 0
    for first, last in spans:
        while at < len(covered) and bounds[at + 1] <= first:
            at += 1
        part = at
        while part < len(covered) and bounds[part] < last:
            covered[part] += min(last, bounds[part + 1]) - max(first, bounds[part])
            part += 1
    return covered
