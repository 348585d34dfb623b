"""Moments of the past in the words of a user, at which the cache gives values and changes."""

from __future__ import annotations

import re
from datetime import date, datetime, timedelta, tzinfo
from datetime import time as time_of_day
from typing import Final

from paramclient.errors import UsageError

WHEN: Final = (
    "a time is written as 2026-11-20T14:00Z, '2026-11-20 14:00' (of this computer's time zone), 14:00, "
    "'yesterday 14:00', yesterday, or '2h 30min ago'"
)
"""The accepted formats of a time, for messages."""

_UNITS: Final = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0, "w": 604800.0}
"""Seconds of each unit of time, by its first letter."""
_LENGTH: Final = r"([0-9]{1,9}(?:\.[0-9]{1,9})?) ?(s|sec|second|m|min|minute|h|hour|d|day|w|week)s?(?![a-z])"
"""A number with a unit, such as `30min`."""
_AGO: Final = re.compile(rf"{_LENGTH}(?: ?{_LENGTH})*(?: ago)?", re.ASCII)
"""A time before now, such as `2h 30min ago`."""
SNAPSHOT_DIGITS_MAX: Final = 18
"""Digits of the number of a snapshot; a longer text is a time, if anything."""
_MOMENT: Final = re.compile(
    r"(?:(?P<day>today|yesterday|[0-9]{4}-[0-9]{2}-[0-9]{2})(?:[t ](?=.)|$))?"
    r"(?:(?P<hour>[0-9]{1,2})(?P<minutes>:[0-9]{2}(?::[0-9]{2}(?:\.[0-9]{1,6})?)?)"
    r"(?P<zone> ?(?:z|utc|[+-][0-9]{2}:?[0-9]{2}))?)?",
    re.ASCII,
)
"""A day, a time of day, or both, with or without a time zone."""


def parse_moment(text: str, now: float) -> float | int:
    """Return the time in a text as `parse_time`, or the number of a snapshot, as `state_at` takes them."""
    return int(text) if text.isdecimal() and len(text) <= SNAPSHOT_DIGITS_MAX else parse_time(text, now)


def parse_time(text: str, now: float, zone: tzinfo | None = None) -> float:
    """Parse a time in the past; return it in unix seconds.

    A day without a time is its midnight, a time without a day is today's. `yesterday` is the calendar day
    before, `1d ago` is 24 hours ago. The times that paramclient prints are accepted.

    Args:
        text: see `WHEN`.
        now: the current time in unix seconds.
        zone: the time zone of times that name none; None for that of this computer.

    Raises:
        UsageError: the text is not a time, or the time is in the future.
    """
    words = " ".join(text.lower().split())
    try:
        lengths = re.findall(_LENGTH, words) if _AGO.fullmatch(words) else []
        ago = sum(float(number) * _UNITS[unit[0]] for number, unit in lengths)
        at = now - ago if lengths else _moment(words, now, zone)
    except (ValueError, OverflowError, OSError):  # the 30th of February; the year 0
        at = None
    if at is None or at < 0:
        raise UsageError(f"{text!r} is not a time: {WHEN}")
    if at > now:
        raise UsageError(f"{text!r} is in the future")
    return at


def _moment(words: str, now: float, zone: tzinfo | None) -> float | None:
    found = _MOMENT.fullmatch(words)
    if not (words and found):
        return None
    mark = (found["zone"] or "").strip().upper().replace("UTC", "Z")
    clock = time_of_day.fromisoformat(f"{int(found['hour'] or 0):02}{found['minutes'] or ':00'}{mark}")
    zone = clock.tzinfo or zone
    today = datetime.fromtimestamp(now, zone).date()
    days = {"": today, "today": today, "yesterday": today - timedelta(days=1)}
    day = found["day"] or ""
    return datetime.combine(days.get(day) or date.fromisoformat(day), clock, zone).timestamp()
