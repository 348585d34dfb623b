"""The interval at which the whole table of a vehicle without a hash is fetched to detect changes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from statistics import median_low
from typing import Final

from paramclient.protocol.params.fetch_result import FetchResult

__all__ = ["SyncInterval"]

FILE_SHARE: Final = 0.05
"""The share of time that reads of the parameter file may take when no interval was chosen: 1.5 s of 30 s."""
CHOSEN_SHARE: Final = 0.5
"""The share of time that checks may take when the user has chosen their interval, and that a check may take
at once after a sign of change."""
PAUSE_MIN: Final = 1.0
"""Seconds from the end of one fetch to a check, at least: a count may change all the time."""
RESERVE_SHARE: Final = 0.05
"""The share of the interval by which a check begins earlier than previous durations require: the next one may
take longer (measured on an ArduCopter: up to 0.9 s longer than the median)."""
FETCHES_KEPT: Final = 5
"""Fetches of one kind whose median duration counts: a single slow one changes nothing."""
UNCONFIRMED_INTERVALS: Final = 4
"""Intervals until the next check, at most, while only one fetch was measured: it may have been a slow one."""


class SyncInterval:
    """Computes the interval of checks from the duration of the last fetches.

    Without a chosen interval only the parameter file is read, of vehicles that have served it or say that
    they do. A slow link is checked less often, but never not at all.

    Args:
        interval: seconds between two checks on a link that is fast enough; infinity for no checks.
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
        """Record the duration of a fetch of the whole table.

        Args:
            result: of the fetch.
            waited: seconds for which the fetch waited for its turn on the link.
        """
        if result.source in _KINDS and not result.missing:
            times = self._times.setdefault(result.source, deque(maxlen=FETCHES_KEPT))
            times.append(result.elapsed - waited)

    def forget(self) -> None:
        """Drop all measurements: another vehicle uses the address, or the firmware has changed."""
        self._times.clear()

    @property
    def has_file(self) -> bool:
        """Whether the table was received as a file."""
        return "ftp" in self._times

    @property
    def file_is_quick(self) -> bool:
        """Whether the file is fast enough to be read in every interval."""
        return self.has_file and self._time <= FILE_SHARE * self._interval

    @property
    def hash_interval(self) -> float:
        """Seconds from one response with the hash to the next request, early enough for a fetch after it to
        end within the interval, where that takes only a small share of it."""
        times = self._times.get("ftp") or self._times.get("stream") or (0.0,)
        return self._target_interval - min(median_low(times), FILE_SHARE * self._interval)

    def interval(self, *, may_use_file: bool) -> float:
        """Return the seconds from the start of one check to the next, so that it ends within the interval.

        Infinity where there is nothing to check with.

        Args:
            may_use_file: whether the vehicle says that it serves the file.
        """
        if self._is_chosen:
            return self._stretched(CHOSEN_SHARE)
        return self._stretched(FILE_SHARE) if self.has_file or may_use_file else math.inf

    def _stretched(self, share: float) -> float:
        """Return the interval less the duration of a check, or longer, to stay within that share of time."""
        times, took = self._last_times, self._time
        longest = UNCONFIRMED_INTERVALS * self._interval if len(times) == 1 else math.inf
        return max(self._target_interval - took, min(took / share, longest))

    @property
    def _target_interval(self) -> float:
        """Seconds from one check to the next within which the next one should end."""
        return self._interval * (1.0 - RESERVE_SHARE)

    @property
    def shortest_pause(self) -> float:
        """Seconds from the end of one fetch to a check, at least, for any reason."""
        times = self._times.get("ftp") or self._times.get("stream") or (0.0,)
        return max(PAUSE_MIN, median_low(times) * (1.0 / CHOSEN_SHARE - 1.0))

    def download_time(self, *, may_use_file: bool) -> float:
        """Return the expected seconds of a download of the whole table; 0 before a measurement.

        Args:
            may_use_file: whether the vehicle serves the file.
        """
        times = self._times.get("ftp" if self.has_file and may_use_file else "stream", (0.0,))
        return median_low(times)

    @property
    def _time(self) -> float:
        """The duration of a fetch in seconds; 0 before the first measurement."""
        times = self._last_times
        return median_low(times) if times else 0.0

    @property
    def _last_times(self) -> Sequence[float]:
        """The durations of the last fetches of the kind that checks use."""
        kind = "ftp" if self.has_file or not self._is_chosen else "stream"
        return self._times.get(kind, ())


_KINDS = frozenset(("ftp", "stream"))
