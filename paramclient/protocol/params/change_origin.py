"""Who changed a value, as far as it was heard, and which changes are to be doubted."""

from __future__ import annotations

import math
from typing import Final

from paramclient.errors import UsageError

__all__ = ["Authors", "by_us", "check_asker", "is_ours"]

BY_US: Final = "us"
FOR: Final = "us for "
LONGEST_ASKER: Final = 128
"""Characters of a name with an address, and of what a program says of itself besides."""

FOREIGN_SET_MEMORY: Final = 2.0
"""Seconds for which a PARAM_SET of another station explains a change."""
MOST_FOREIGN_SETS: Final = 256
"""Names remembered for that; the oldest goes first."""
MOST_CHANGES: Final = 4_096
"""Changes remembered for what follows: more names than an autopilot has. The oldest goes first."""
DOUBT: Final = 2.0
"""Seconds within which a second change of one value may be an old answer that came late: ArduPilot takes the
values for a batch of answers up to 100 ms before it sends them, and what was set meanwhile overtakes them."""

_NO_SET: Final = ("", -math.inf, b"")


def check_asker(asker: str | None) -> str | None:
    """Who wants a change, as it will stand in the history.

    Raises:
        UsageError: it is empty, too long, or holds more than printable ASCII.
    """
    if asker is None:
        return None
    if not 1 <= len(asker) <= LONGEST_ASKER or not (asker.isascii() and asker.isprintable()):
        raise UsageError(
            f"who asks for a change is told in 1 to {LONGEST_ASKER} printable ASCII characters, "
            f"not {asker!r:.200}"
        )
    return asker


def by_us(asker: str | None) -> str:
    """The author of a change that a write of ours makes: "us", or "us for NAME"."""
    return BY_US if asker is None else FOR + asker


def is_ours(by: str) -> bool:
    """Whether a write of ours has made the change, for whomever."""
    return by == BY_US or by.startswith(FOR)


class Authors:
    """What is remembered for a few seconds of the changes of one component's values.

    Attributes:
        foreign_sets: by name, the station that was heard setting it last, when, and the four bytes of the
            value; ourselves, where a write was given up before its value had come, with no bytes.
    """

    __slots__ = ("_changed_at", "_doubts", "foreign_sets")

    def __init__(self) -> None:
        self.foreign_sets: dict[str, tuple[str, float, bytes]] = {}
        self._changed_at: dict[str, float] = {}
        self._doubts: dict[str, float] = {}  # what changed again: when to ask for it

    def foreign_set(self, name: str, station: str, now: float, raw: bytes = b"") -> None:
        """Another station was heard setting a parameter; or ours has, and nobody waits for it any more."""
        self.foreign_sets.pop(name, None)
        self.foreign_sets[name] = (station, now, raw)
        if len(self.foreign_sets) > MOST_FOREIGN_SETS:
            del self.foreign_sets[next(iter(self.foreign_sets))]

    def of(self, name: str, now: float) -> str:
        """Who has changed a parameter that no write of ours is about."""
        station, at, _ = self.foreign_sets.get(name, _NO_SET)
        return station if now - at <= FOREIGN_SET_MEMORY else "vehicle"

    def setter_of(self, name: str, raw: bytes, now: float) -> str | None:
        """Return the station that was heard setting a parameter to just this value, or None.

        Args:
            name: the parameter.
            raw: the four bytes of the value as the vehicle sends it.
            now: the time.
        """
        station, at, its_raw = self.foreign_sets.get(name, _NO_SET)
        return station if its_raw == raw and now - at <= FOREIGN_SET_MEMORY else None

    def changed(self, name: str, now: float, is_written: bool) -> None:
        """A value changed: the second time in a short while, the one that came last may be the older one."""
        changed_at = self._changed_at
        before = changed_at.pop(name, None)
        if (
            before is not None
            and now - before <= DOUBT
            and not is_written
            and len(self._doubts) < MOST_CHANGES
        ):
            self._doubts.setdefault(name, now + DOUBT / 2)
        changed_at[name] = now
        if len(changed_at) > MOST_CHANGES:
            del changed_at[next(iter(changed_at))]

    def forget(self, now: float) -> None:
        """Let go of what is too old to matter; once a second will do."""
        self._changed_at = {name: at for name, at in self._changed_at.items() if now - at <= DOUBT}

    def doubted(self, now: float) -> list[str]:
        """Names whose values are to be asked for now."""
        due = [name for name, at in self._doubts.items() if at <= now]
        for name in due:
            del self._doubts[name]
        return due

    def next_deadline(self) -> float:
        """When `doubted` has something to give, or infinity."""
        return next(iter(self._doubts.values()), math.inf)

    def clear(self) -> None:
        """Nothing is to be asked for any more."""
        self._doubts.clear()
