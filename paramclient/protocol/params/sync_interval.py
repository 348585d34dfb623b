"""How often the whole table of a vehicle without a hash is fetched to see whether it has moved."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from statistics import median_low
from typing import Final

from paramclient.protocol.params.fetch_result import FetchResult

__all__ = ["CheckPace"]

FILE_SHARE: Final = 0.05
"""The share of the time that reading the parameter file may take where nobody has chosen an interval: 1.5 s
of 30 s."""
CHOSEN_SHARE: Final = 0.5
"""The share of the time that checks may take where the user has chosen their interval, and that a check may
take at once, because a sign has come that the table moved."""
SHORTEST_PAUSE: Final = 1.0
"""Seconds from the end of one fetch to a check at the earliest: a count may move all the time."""
RESERVE_SHARE: Final = 0.05
"""The share of the interval by which a check begins earlier than the last ones say that it must to end within
it: the next one may take longer (measured on an ArduCopter: up to 0.9 s longer than the median)."""
FETCHES_KEPT: Final = 5
"""Fetches of one kind of which the median time counts: one that took long for once changes nothing."""
UNCONFIRMED_INTERVALS: Final = 4
"""Intervals until the next check, at most, while only one fetch was measured: it may be the one that took
long."""


class CheckPace:
    """Chooses the time between two checks by the time that the last fetches took.

    Without a chosen interval only the parameter file is read, of vehicles that have given it or say that they
    serve it. A slow link is looked at less often, never not at all.

    Args:
        interval: seconds between two checks on a link that is quick enough; infinity for no checks.
        is_chosen: whether the user has chosen that interval, so that the list is fetched where there is no
            file.
    """

    def __init__(self, interval: float, *, is_chosen: bool) -> None:
        self._interval = interval
        self._is_chosen = is_chosen
        self._times: dict[str, deque[float]] = {}

    @property
    def may_list(self) -> bool:
        """Whether a check may download the list."""
        return self._is_chosen

    def fetched(self, result: FetchResult, waited: float) -> None:
        """Take the time of a fetch that has brought the whole table.

        Args:
            result: of the fetch.
            waited: seconds of it in which it waited for its turn on the link.
        """
        if result.source in _KINDS and not result.missing:
            times = self._times.setdefault(result.source, deque(maxlen=FETCHES_KEPT))
            times.append(result.elapsed - waited)

    def forget(self) -> None:
        """Drop what was measured: another vehicle has taken the address, or this one has another firmware."""
        self._times.clear()

    @property
    def has_file(self) -> bool:
        """Whether the table has come as a file."""
        return "ftp" in self._times

    @property
    def file_is_quick(self) -> bool:
        """Whether the file comes so quickly that it can be read in every interval."""
        return self.has_file and self._time <= FILE_SHARE * self._interval

    @property
    def hash_interval(self) -> float:
        """Seconds from one answer with the hash to the next question, so early that the fetch which may
        follow ends within the interval, where that takes no more than a small share of it."""
        times = self._times.get("ftp") or self._times.get("stream") or (0.0,)
        return self._aim - min(median_low(times), FILE_SHARE * self._interval)

    def interval(self, *, may_use_file: bool) -> float:
        """Return the seconds from the start of one check to that of the next: it ends within the interval.

        Infinity where there is nothing to check with.

        Args:
            may_use_file: whether the vehicle says that it serves the file.
        """
        if self._is_chosen:
            return self._stretched(CHOSEN_SHARE)
        return self._stretched(FILE_SHARE) if self.has_file or may_use_file else math.inf

    def _stretched(self, share: float) -> float:
        """The interval less the time of a check, or longer: checks take no more than that share of it."""
        times, took = self._last_times, self._time
        longest = UNCONFIRMED_INTERVALS * self._interval if len(times) == 1 else math.inf
        return max(self._aim - took, min(took / share, longest))

    @property
    def _aim(self) -> float:
        """Seconds from one check to the next in which that should end."""
        return self._interval * (1.0 - RESERVE_SHARE)

    @property
    def shortest_pause(self) -> float:
        """Seconds from the end of one fetch until a check at the earliest, whatever the reason for it is."""
        return max(SHORTEST_PAUSE, self._time * (1.0 / CHOSEN_SHARE - 1.0))

    @property
    def _time(self) -> float:
        """Seconds that a fetch takes; 0 while none was measured."""
        times = self._last_times
        return median_low(times) if times else 0.0

    @property
    def _last_times(self) -> Sequence[float]:
        """The times of the last fetches of the kind that checks are."""
        kind = "ftp" if self.has_file or not self._is_chosen else "stream"
        return self._times.get(kind, ())


_KINDS = frozenset(("ftp", "stream"))
