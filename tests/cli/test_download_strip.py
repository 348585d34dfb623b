"""The strip of a download on a terminal: received, requested again, missing."""

from __future__ import annotations

import io
import re
import sys
from itertools import cycle, islice

import pytest

from paramclient.cli.block_characters import ASCII, BLOCKS, Marks, Piece, marks_for
from paramclient.cli.download_strip import STRIP_WIDTH_MAX, strip_lines
from paramclient.protocol.params.download_ranges import DownloadRange, DownloadRanges, split_indices
from paramclient.protocol.params.fetch_result import Progress
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from tests.commands import Command, Outcome, Put, behind, in_process, leaping


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run the command line in this process on simulated time, with stderr as a terminal of 80 columns."""
    leaping(monkeypatch)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    run = in_process(capsys)

    def call(*words: object) -> Outcome:
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
        return run(*words, "--no-cache")

    return call


@pytest.fixture
def put(monkeypatch: pytest.MonkeyPatch) -> Put:
    """Connect every URL to a simulated vehicle."""
    return behind(monkeypatch, "sim:custom")


def progress(*parts: tuple[int, int, int], unit: str = "parameters") -> Progress:
    """Return the progress of a download with these parts: received, requested again, missing."""
    made = tuple(DownloadRange(*part) for part in parts)
    received = sum(part.received for part in made)
    ranges = DownloadRanges(
        "bytes" if unit == "bytes" else "parameters", lambda number: tuple(islice(made, number))
    )
    return Progress(received, sum(part.size for part in made), 120.4, 3.6, ranges)


def text_of(lines: list[list[Piece]]) -> list[str]:
    return ["".join(text for text, _ in line) for line in lines]


@pytest.mark.parametrize(("marks", "strip"), [(BLOCKS, "█▒▒▅·▂▇"), (ASCII, "#??+.-%")])
def test_each_cell_shows_the_state_of_its_part(marks: Marks, strip: str) -> None:
    state = progress((9, 0, 0), (8, 1, 0), (0, 1, 8), (5, 0, 4), (0, 0, 9), (1, 0, 8), (8, 0, 1))
    assert text_of(strip_lines("fetching 1/1 px4", state, marks, 80)) == [
        "fetching 1/1 px4  31/63 120/s, 4 s left",
        strip,
        f"{marks.full} 31 received  {marks.requested_again} 2 requested again  {marks.missing} 30 missing",
    ]


def test_the_states_differ_without_colours_and_with_them() -> None:
    state = progress((9, 0, 0), (8, 1, 0), (5, 0, 4), (0, 0, 9))
    for marks in (BLOCKS, ASCII):
        strip = strip_lines("", state, marks, 80)[1]
        assert len({text for text, _ in strip}) == len({style for _, style in strip}) == 4
        partly = {marks.column(share / 100) for share in range(1, 100)}
        assert not partly & {marks.full, marks.requested_again, marks.missing, marks.levels[0]}


@pytest.mark.parametrize("width", [10, 24, 40, 80, 400])
def test_a_narrow_terminal_breaks_no_item(width: int) -> None:
    received = set(range(0, 903, 2))
    ranges = DownloadRanges("parameters", lambda number: split_indices(903, number, received, {1, 3}))
    lines = text_of(strip_lines("fetching 1/1 px4", Progress(452, 903, 0.0, None, ranges), BLOCKS, width))
    cells = min(width, STRIP_WIDTH_MAX)
    [strip] = [line for line in lines if len(line) == cells and set(line) <= {*BLOCKS.levels, "▒", "·"}]
    assert "▒" in strip
    items = ["fetching 1/1 px4", "452/903 0/s", "█ 452 received", "▒ 2 requested again", "· 449 missing"]
    assert [item for line in lines if line != strip for item in line.split("  ")] == items
    assert all(len(line) <= width or line in items for line in lines)


def test_of_a_file_bytes_are_counted() -> None:
    lines = text_of(strip_lines("fetching", progress((2000, 0, 0), (0, 478, 22), unit="bytes"), BLOCKS, 80))
    assert lines[-1] == "█ 2,000 received  ▒ 478 requested again  · 22 missing  in bytes"


def test_before_the_size_is_known_only_the_figures_are_shown() -> None:
    assert text_of(strip_lines("fetching", progress(), BLOCKS, 80)) == ["fetching  0/0 120/s, 4 s left"]
    assert text_of(strip_lines("fetching", Progress(3, None, 0.0, None), BLOCKS, 80)) == ["fetching  3/? 0/s"]


@pytest.mark.parametrize(
    ("encoding", "marks"),
    [("utf-8", BLOCKS), ("utf-16", BLOCKS), ("ascii", ASCII), ("latin-1", ASCII), ("cp437", ASCII)],
)
def test_an_output_without_blocks_gets_ascii(encoding: str, marks: Marks) -> None:
    assert marks_for(io.TextIOWrapper(io.BytesIO(), encoding=encoding)) is marks
    assert marks_for(io.StringIO()) is ASCII  # of no encoding
    assert "".join([ASCII.levels, ASCII.requested_again, ASCII.missing]).isascii()


def test_columns_are_as_high_as_their_share() -> None:
    for marks in (BLOCKS, ASCII):
        heights = [marks.levels.index(marks.column(share / 1000)) for share in range(1001)]
        assert heights == sorted(heights)
        assert heights.count(0) == heights.count(len(marks.levels) - 1) == 1
        assert set(heights) == set(range(len(marks.levels)))


# the command


def strips(text: str) -> list[str]:
    """The strips that were drawn, in order."""
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)
    return re.findall(r"^[▁-█▒·]{20,}$", plain.replace("\r", "\n"), re.MULTILINE)


@pytest.mark.parametrize("vehicle", [PX4Vehicle, ArduPilotVehicle])
def test_fetch_draws_the_indices_as_they_are_received(
    command: Command, put: Put, monkeypatch: pytest.MonkeyPatch, vehicle: type[PX4Vehicle | ArduPilotVehicle]
) -> None:
    monkeypatch.setattr("paramclient.cli.output.marks_for", lambda output: BLOCKS)
    done = command("fetch", put(Air.symmetric([vehicle()], loss=0.2, delay=0.05, seed=1)))
    assert done.code == 0
    drawn = strips(done.err)
    assert len(drawn) > 5
    assert all(len(strip) == 80 for strip in drawn)
    assert drawn[0].endswith("·" * 30)
    assert any("▒" in strip for strip in drawn)
    missing = [strip.count("·") for strip in drawn]
    assert missing == sorted(missing, reverse=True)
    assert missing[-1] == 0
    assert drawn[-1].count("█") > 60
    assert "requested again" in done.err


def test_the_parts_repeat_nothing_from_one_report_to_the_next() -> None:
    """A report is drawn anew: the strip has no memory."""
    states = cycle([progress((1, 0, 0), (0, 0, 1)), progress((1, 0, 0), (1, 0, 0))])
    drawn = [text_of(strip_lines("", next(states), BLOCKS, 40))[1] for _ in range(4)]
    assert drawn == ["█·", "██"] * 2
