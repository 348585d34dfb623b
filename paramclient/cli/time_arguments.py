"""Parsing of times: `2h ago`, `yesterday 14:00`, ISO times, the number of a snapshot."""

from __future__ import annotations

import re
from datetime import date, datetime, time, timedelta, tzinfo
from typing import Final

from paramclient.errors import UsageError

WHEN: Final = (
    "a time is written as 2026-11-20T14:00Z, '2026-11-20 14:00' (of this computer's time zone), 14:00, "
    "'yesterday 14:00', yesterday, or '2h 30min ago'"
)
"""The accepted formats of a time, for messages."""

_UNITS: Final = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("m", "min", "mins", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), 86400.0),
    **dict.fromkeys(("w", "week", "weeks"), 604800.0),
}
"""Seconds of each unit of time."""
_LENGTH: Final = rf"([0-9]{{1,9}}(?:\.[0-9]{{1,9}})?) ?({'|'.join(_UNITS)})(?![a-z])"
"""A number with a unit, such as `30min`."""
_AGO: Final = re.compile(rf"{_LENGTH}(?: ?{_LENGTH})*(?: ago)?", re.ASCII)
"""A time before now, such as `2h 30min ago`."""
_MOMENT: Final = re.compile(
    r"(?:(?P<day>today|yesterday|[0-9]{4}-[0-9]{2}-[0-9]{2})(?:[t ](?=.)|$))?"
    r"(?:(?P<hour>[0-9]{1,2})(?P<minutes>:[0-9]{2}(?::[0-9]{2}(?:\.[0-9]{1,6})?)?)"
    r"(?P<zone> ?(?:z|utc|[+-][0-9]{2}:?[0-9]{2}))?)?",
    re.ASCII,
)
"""A day, a time of day, or both, with or without a time zone."""
_SNAPSHOT: Final = re.compile(r"[0-9]{1,18}", re.ASCII)
"""The id of a snapshot."""


def parse_when(text: str, now: float, zone: tzinfo | None = None) -> float | int:
    """Parse an argument of `ParamCache.state_at`: a time in the past, or the id of a snapshot.

    Args:
        text: a number alone is the id of a snapshot; for all other texts see `parse_time`.
        now: the current time in unix seconds.
        zone: the time zone of times that name none; None for that of this computer.

    Raises:
        UsageError: the text is neither, or the time is in the future.
    """
    if _SNAPSHOT.fullmatch(text.strip()):
        return int(text)
    return parse_time(text, now, zone)


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
        at = _before(words, now) if _AGO.fullmatch(words) else _moment(words, now, zone)
    except (ValueError, OverflowError, OSError):  # the 30th of February; the year 0
        at = None
    if at is None or at < 0:
        raise UsageError(f"{text!r} is not a time: {WHEN}")
    if at > now:
        raise UsageError(f"{text!r} is in the future")
    return at


def _before(words: str, now: float) -> float:
    return now - sum(float(number) * _UNITS[unit] for number, unit in re.findall(_LENGTH, words))


def _moment(words: str, now: float, zone: tzinfo | None) -> float | None:
    found = _MOMENT.fullmatch(words)
    if not (words and found):
        return None
    mark = (found["zone"] or "").strip().upper().replace("UTC", "Z")
    clock = time.fromisoformat(f"{int(found['hour'] or 0):02}{found['minutes'] or ':00'}{mark}")
    zone = clock.tzinfo or zone
    today = datetime.fromtimestamp(now, zone).date()
    days = {"": today, "today": today, "yesterday": today - timedelta(days=1)}
    day = found["day"] or ""
    return datetime.combine(days.get(day) or date.fromisoformat(day), clock, zone).timestamp()
