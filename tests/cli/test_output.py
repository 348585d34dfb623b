"""Tables and lines on narrow terminals, and times with their zone."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterator

import pytest

from paramclient.cache.moments import parse_time
from paramclient.cli.output import local_time, print_line, print_table, say
from paramclient.sim import PX4Vehicle
from tests.commands import Command, Put

Print = Callable[..., list[str]]


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Print:
    """Print a table on a terminal of some width; return its lines without styles."""

    def call(width: int, columns: list[str], rows: list[tuple[object, ...]]) -> list[str]:
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
        print_table(columns, rows)
        return re.sub("\x1b\\[[0-9;]*m", "", capsys.readouterr().out).splitlines()

    return call


def test_sentences_in_the_last_column_are_wrapped_at_spaces(printed: Print) -> None:
    reason = "the vehicle keeps its own value and gives no reason"
    lines = printed(40, ["name", "reason"], [("MC_ROLL_P", reason)])
    assert len(lines) > 2
    assert max(map(len, lines)) <= 40
    assert " ".join(" ".join(lines[1:]).split()) == f"MC_ROLL_P {reason}"


def test_lines_wrap_at_spaces(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    change = "  changed: 2026-11-24T14:39:42.013+01:00  1500.125 -> 16777216.5  (us for ground station 2)"
    print_line(change)
    say(change)
    assert capsys.readouterr() == (f"{change}\n", f"{change}\n"), "not for pipes and files"
    monkeypatch.setenv("COLUMNS", "40")
    for stream in (sys.stdout, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    print_line(change)
    say(f"{change}\nshort")
    out, err = capsys.readouterr()
    assert err == f"{out}short\n"
    assert max(map(len, out.splitlines())) <= 40
    assert out.split() == change.split()
    assert [len(line) - len(line.lstrip()) for line in out.splitlines()] == [2, 4, 4]
    print_line("")
    assert capsys.readouterr().out == "\n"


# times


@pytest.fixture
def in_zone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "XYZ-05:30")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("in_zone")
def test_times_are_local_with_their_zone_and_can_be_parsed_back(command: Command, put: Put) -> None:
    at = 1_795_000_000.125
    assert local_time(at) == "2026-11-18T16:36:40.125+05:30"
    assert parse_time(local_time(at), at + 1) == parse_time("2026-11-18 16:36:40.125", at + 1) == at
    assert parse_time("yesterday 16:36:40.125", at + 86400) == at
    vehicle = PX4Vehicle(table={"A": 1, "B": 2})
    assert command("fetch", put(vehicle)).code == 0
    assert command("set", put(vehicle), "A", 3).code == 0
    local = r"[0-9-]{10}T[0-9:.]{12}\+05:30"
    history = command("history", 1, "--since", "1h ago")
    assert re.fullmatch(local, history.rows[1][0])
    assert re.search(f", {local}$", command("show", 1).err.strip())
    assert re.fullmatch(local, command("cache", "list").rows[1][4])
    [line] = command("history", 1, "--json").json["history"]
    assert line["time"].endswith("Z")
    times = [parse_time(text, time.time() + 1000) for text in (line["time"], history.rows[1][0])]
    assert times[0] == pytest.approx(times[1])
