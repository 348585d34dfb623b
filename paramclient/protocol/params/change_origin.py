"""The author of a change, and second changes that need another read."""

from __future__ import annotations

import math
from typing import Final

from paramclient.errors import UsageError

__all__ = ["Authors", "by_us", "check_author", "is_ours"]

BY_US: Final = "us"
"""The author of a change by our own write."""
BY_US_FOR: Final = "us for "
"""The beginning of the author of a change by our write on behalf of a name."""
AUTHOR_LENGTH_MAX: Final = 128
"""Characters of an author's name: enough for a name with an address, and a program's own description."""

FOREIGN_SET_MEMORY: Final = 2.0
"""Seconds for which a PARAM_SET of another station explains a change."""
FOREIGN_SETS_MAX: Final = 256
"""PARAM_SETs of other stations that are remembered; the oldest is dropped first."""
RECENT_CHANGES_MAX: Final = 4_096
"""Changes remembered for that time: more names than an autopilot has; the oldest is dropped first."""
DOUBT_TIME: Final = 2.0
"""Seconds within which a second change of one value may be a late response: ArduPilot takes the values for a
batch of responses up to 100 ms before it sends them, and a PARAM_SET meanwhile overtakes them."""

_NO_SET: Final = ("", -math.inf, b"")


def check_author(author: str | None) -> str | None:
    """Return the author of a change, checked for the history.

    Raises:
        UsageError: it is empty, too long, or contains more than printable ASCII.
    """
    if author is None:
        return None
    if not 1 <= len(author) <= AUTHOR_LENGTH_MAX or not (author.isascii() and author.isprintable()):
        raise UsageError(
            f"author must have 1 to {AUTHOR_LENGTH_MAX} printable ASCII characters, not {author!r:.200}"
        )
    return author


def by_us(author: str | None) -> str:
    """Return the author of a change by our own write: "us", or "us for NAME"."""
    return BY_US if author is None else BY_US_FOR + author


def is_ours(by: str) -> bool:
    """Return whether the author is a write of ours, on behalf of any name."""
    return by == BY_US or by.startswith(BY_US_FOR)


class Authors:
    """The recent changes of one component's values, and their authors.

    Attributes:
        foreign_sets: by name, the station whose last PARAM_SET was received, when, and the 4 bytes of its
            value; ourselves without bytes, where a write was given up before its value had arrived.
    """

    __slots__ = ("_changed_at", "_doubts", "foreign_sets")

    def __init__(self) -> None:
        self.foreign_sets: dict[str, tuple[str, float, bytes]] = {}
        self._changed_at: dict[str, float] = {}
        self._doubts: dict[str, float] = {}  # changed twice: when to read it

    def foreign_set(self, name: str, station: str, now: float, raw: bytes = b"") -> None:
        """Record a PARAM_SET of another station, or one of ours that no caller waits for any more."""
        self.foreign_sets.pop(name, None)
        self.foreign_sets[name] = (station, now, raw)
        if len(self.foreign_sets) > FOREIGN_SETS_MAX:
            del self.foreign_sets[next(iter(self.foreign_sets))]

    def of(self, name: str, now: float) -> str:
        """Return the author of a change of a parameter without an active write of ours."""
        station, at, _ = self.foreign_sets.get(name, _NO_SET)
        return station if now - at <= FOREIGN_SET_MEMORY else "vehicle"

    def setter_of(self, name: str, raw: bytes, now: float) -> str | None:
        """Return the station whose PARAM_SET had just this value, or None.

        Args:
            name: the parameter.
            raw: the 4 bytes of the value as the vehicle sends it.
            now: the time.
        """
        station, at, its_raw = self.foreign_sets.get(name, _NO_SET)
        return station if its_raw == raw and now - at <= FOREIGN_SET_MEMORY else None

    def changed(self, name: str, now: float, is_written: bool) -> None:
        """Record a change: after a second one within `DOUBT_TIME` seconds, the later value may be the older
        one."""
        changed_at = self._changed_at
        before = changed_at.pop(name, None)
        if (
            before is not None
            and now - before <= DOUBT_TIME
            and not is_written
            and len(self._doubts) < RECENT_CHANGES_MAX
        ):
            self._doubts.setdefault(name, now + DOUBT_TIME / 2)
        changed_at[name] = now
        if len(changed_at) > RECENT_CHANGES_MAX:
            del changed_at[next(iter(changed_at))]

    def forget(self, now: float) -> None:
        """Drop expired entries; once a second is enough."""
        self._changed_at = {name: at for name, at in self._changed_at.items() if now - at <= DOUBT_TIME}

    def doubted(self, now: float) -> list[str]:
        """Take the names whose values are to be read now."""
        due = [name for name, at in self._doubts.items() if at <= now]
        for name in due:
            del self._doubts[name]
        return due

    def next_deadline(self) -> float:
        """Return when `doubted` has names, or infinity."""
        return next(iter(self._doubts.values()), math.inf)

    def clear(self) -> None:
        """Drop all planned reads."""
        self._doubts.clear()
