"""The subcommand history, and the parsing of times."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest

from paramclient.cache import BY_US, ParamCache, TableState
from paramclient.cache.moments import parse_time
from paramclient.errors import UsageError
from paramclient.model.notation import time_text
from tests.caches import NOW, PX4, stored, update
from tests.commands import Command

DONE = TableState(complete=True)
EAST = timezone(timedelta(hours=2))


# Moments


def at(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("2026-11-20T14:00Z", "2026-11-20T14:00Z"),
        ("2026-11-20 14:00", "2026-11-20T14:00+02:00"),
        ("2026-11-20 14:00 +05:30", "2026-11-20T14:00+05:30"),
        ("2026-11-20T14:00-0800", "2026-11-20T14:00-08:00"),
        ("2026-11-19", "2026-11-19T00:00+02:00"),
        ("Yesterday", "2026-11-20T00:00+02:00"),
        (" yesterday  9:05 ", "2026-11-20T09:05+02:00"),
        ("yesterday 14:00Z", "2026-11-19T14:00Z"),
        ("today 0:30", "2026-11-21T00:30+02:00"),
        ("00:59:59.5", "2026-11-21T00:59:59.5+02:00"),
        ("21:00Z", "2026-11-20T21:00Z"),
        ("2h ago", "2026-11-20T21:00Z"),
        ("2h", "2026-11-20T21:00Z"),
        ("1 hour 30 minutes ago", "2026-11-20T21:30Z"),
        ("1.5 days ago", "2026-11-19T11:00Z"),
        ("2 WEEKS AGO", "2026-11-06T23:00Z"),
    ],
)
def test_times_are_parsed(text: str, moment: str) -> None:
    """23:00 in Greenwich is the next day in the time zone of the user, whose days apply."""
    assert parse_time(text, at("2026-11-20T23:00Z"), EAST) == at(moment)


@pytest.mark.parametrize(
    "text",
    [
        *("", " ", "ago", "now", "2", "2 ago", "h", "2h ago ago", "2hago", "2 parsecs", "2 mins. ago", "-2h"),
        *("2h -1h ago", "1e3s", "9" * 30, "999999999w", "99999w ago", "\u0662h ago", "2h\0ago"),
        *("2026-02-30", "2026-13-01", "2026-11", "20.11.2026", "11/20/2026", "2026-W47-5", "0000-01-01"),
        *("1969-12-31", "24:30", "14", "14:0", "14:00:", "today14:00", "yesterday T14:00", "T14:00"),
        *("14:00 25:00", "1h yesterday", "2026-11-20T14:00+99:00"),
    ],
)  # fmt: skip
def test_an_invalid_time_is_an_error_that_lists_the_formats(text: str) -> None:
    with pytest.raises(UsageError, match=r"is not a time: a time is written as 2026-11-20T14:00Z"):
        parse_time(text, NOW, EAST)


@pytest.mark.parametrize("text", ["2027-01-01", "23:59", "today 12:00"])
def test_a_time_in_the_future_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is in the future"):
        parse_time(text, at("2026-11-20T08:00Z"), UTC)


# history


HOUR_AGO = float(int(time.time()) - 3600)  # at the collection of the tests, which may run much later


@pytest.fixture
def known(cache: Path) -> None:
    """A vehicle with some changes in the last hour."""
    with ParamCache(cache) as kept:
        for number, items in enumerate(([("A", 1), ("B", 1)], [("A", 2)], [("B", 2)])):
            at = HOUR_AGO + 600 * number
            kept.save(update(*(stored(*item, at=at, by=BY_US) for item in items), table=DONE, at=at))
        at = HOUR_AGO + 1300
        kept.save(update(stored("C", 1, at=at), stored("C", 2, at=at), component=154, at=at))
        kept.store_snapshot(PX4.key, 1, reason="before apply \x1b[31m.parm", at=HOUR_AGO + 1500)
        kept.store_snapshot(PX4.key, 154, reason="by hand", at=HOUR_AGO + 1900)


@pytest.mark.usefixtures("known")
def test_history_prints_the_cached_changes_since_a_time(command: Command) -> None:
    found = command("history", "1", "--json").json["history"]
    lines = [(each["component"], each["name"], each["old"], each["new"]) for each in found]
    assert lines == [(1, "A", 1, 2), (1, "B", 1, 2), (154, "C", 1, 2)]
    first = time_text(HOUR_AGO + 600)
    header = ["time", "component", "name", "old", "new", "by"]
    assert command("history", "1", "A").words == [header, [first, "1", "A", "1", "2", "us"]]
    second = time_text(HOUR_AGO + 900)
    assert command("history", "1", "--since", "0s ago").err == "no changes are in the cache\n"
    since = command("history", "1/1", "--since", second, "--json").json["history"]
    assert [each["name"] for each in since] == ["B"]
    since = command("history", "1", "--since", first, "--json").json["history"]
    assert [each["name"] for each in since] == ["A", "B", "C"]


@pytest.mark.usefixtures("known")
def test_snapshots_are_listed_with_their_numbers(command: Command) -> None:
    first, second = (time_text(HOUR_AGO + after) for after in (1500, 1900))
    assert command("history", "uid:000200", "--snapshots", "--json").json["snapshots"][1]["id"] == 2
    assert command("history", "1", "--snapshots").words == [
        ["id", "time", "component", "params", "reason"],
        ["1", first, "1", "2", "before", "apply", "\\x1b[31m.parm"],
        ["2", second, "154", "1", "by", "hand", "(not", "complete)"],
    ]
    for narrowed in (["1/154"], ["1", "--since", time_text(HOUR_AGO + 1700)]):
        found = command("history", *narrowed, "--snapshots", "--json").json["snapshots"]
        assert [each["id"] for each in found] == [2]
    for wrong, why in ((["--since", "soon"], "is not a time"), (["A", "--snapshots"], "takes no parameter")):
        failed = command("history", "1", *wrong)
        assert (failed.code, failed.out, why in failed.err) == (2, "", True)
