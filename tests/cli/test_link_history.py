"""Packet loss and round trip of the last minute, as `link` draws them."""

from __future__ import annotations

import re

import pytest
from paramclient.protocol.requests.round_trip import RoundTrip
from paramclient.protocol.stats.traffic import Traffic

from paramclient.cli.block_characters import ASCII, BLOCKS, Piece
from paramclient.cli.link import SCALES
from paramclient.cli.link_history import (
    HISTORY_LENGTH,
    LOSS,
    ROUND_TRIP,
    HistoryRow,
    LinkHistory,
    history_lines,
    sparkline,
)
from paramclient.cli.output import wrapped
from paramclient.wire.messages import Heartbeat, encode

ADDRESS = (1, 1)
UNKNOWN = (None,) * HISTORY_LENGTH


class Watch:
    """A link with one component, which is watched from the time 100.0 on.

    Args:
        validity: seconds for which a round trip counts.
    """

    def __init__(self, validity: float = 5.0) -> None:
        self.now = 100.0
        self.history = LinkHistory(self.now, validity=validity)
        self.traffic = Traffic(is_stream=False)
        self.trip = RoundTrip()
        self._sequence = 0

    def second(self, frames: int = 10, lost: int = 0, trip: float | None = None) -> None:
        """Let a second pass with received and lost frames, the lost ones before the last."""
        for number in range(frames):
            self._sequence += lost if number == frames - 1 else 0
            beat = encode(Heartbeat(2, 12), system=1, component=1, sequence=self._sequence % 256)
            self.traffic.receive(beat, "peer", self.now + 0.5)
            self._sequence += 1
        if trip is not None:
            self.trip.note_response(trip)
        for _ in range(4):
            self.now += 0.25
            self.look()

    def look(self) -> None:
        self.history.take(self.traffic.report(self.now), {ADDRESS: self.trip}, self.now)

    def of(self, quantity: str) -> tuple[float | None, ...]:
        """The samples of a quantity; unknown ones if it has no row."""
        return next((row.values for row in self.history.rows() if row.quantity == quantity), UNKNOWN)


def test_a_sample_of_each_second() -> None:
    watch = Watch()
    watch.look()
    assert watch.history.rows() == []
    for lost in (0, 10, 0, 30):
        watch.second(frames=10, lost=lost)
    assert watch.of(LOSS)[-4:] == (0.0, 0.5, 0.0, 0.75)
    assert watch.of(LOSS)[:-4] == (None,) * 56
    assert [row.address for row in watch.history.rows()] == ["1/1"]


def test_a_second_without_a_frame_is_unknown() -> None:
    watch = Watch()
    watch.second()
    watch.second(frames=0)
    watch.second(frames=2, lost=2)
    assert watch.of(LOSS)[-3:] == (0.0, None, 0.5)


def test_only_the_last_minute_is_kept() -> None:
    watch = Watch()
    watch.second(lost=10)
    for _ in range(HISTORY_LENGTH - 1):
        watch.second()
    assert (len(watch.of(LOSS)), watch.of(LOSS)[0]) == (HISTORY_LENGTH, 0.5)
    watch.second()
    assert watch.of(LOSS) == (0.0,) * HISTORY_LENGTH


def test_a_round_trip_counts_until_the_next_is_due() -> None:
    watch = Watch(validity=3.0)
    watch.second()
    assert watch.of(ROUND_TRIP) == UNKNOWN
    watch.second(trip=0.1)
    for _ in range(4):
        watch.second()
    watch.second(trip=0.1)  # as long as the one before, and measured anew
    watch.second(trip=0.3)
    assert watch.of(ROUND_TRIP)[-8:] == (None, 0.1, 0.1, 0.1, None, None, 0.1, 0.3)


def test_a_late_sample_counts_for_all_its_seconds() -> None:
    watch = Watch()
    watch.second()
    watch.now += 2.0
    watch.second(lost=10)  # seen by the first look after the pause
    assert watch.of(LOSS)[-5:] == (None, 0.0, 0.5, 0.5, None)
    watch.now += 1000.0
    watch.second()
    assert len(watch.of(LOSS)) == HISTORY_LENGTH


def test_late_frames_make_no_negative_loss() -> None:
    watch = Watch()
    watch.second(lost=3)
    late = encode(Heartbeat(2, 12), system=1, component=1, sequence=9)
    watch.traffic.receive(late, "peer", watch.now)
    watch.second(frames=1)
    assert watch.of(LOSS)[-1] == 0.0


# drawing


def test_a_column_shows_the_highest_of_its_seconds() -> None:
    values = [0.0, 0.0, 0.5, 0.0, None, None, None, 1.0, 0.01, 0.0]
    assert sparkline(values, 1.0, BLOCKS, 10) == "▁▁▅▁   █▂▁"
    assert sparkline(values, 1.0, BLOCKS, 5) == "▁▅ █▂"
    assert sparkline(values, 1.0, ASCII, 5) == "_+ #-"
    assert sparkline([0.0, None, 0.0], 0.0, BLOCKS, 3) == "▁ ▁"


def rows() -> list[HistoryRow]:
    losses = (*(None,) * 20, *(0.0,) * 20, *(0.125,) * 20)
    trips = (*(None,) * 30, *(0.05,) * 15, *(1.2,) * 15)
    return [
        HistoryRow("1/1", LOSS, losses),
        HistoryRow("1/1", ROUND_TRIP, trips),
        HistoryRow("12/100", LOSS, losses),
    ]


def text_of(lines: list[list[Piece]]) -> list[str]:
    return ["".join(text for text, _ in line) for line in lines]


def test_the_drawing_states_span_and_maximum() -> None:
    assert text_of(history_lines(rows(), SCALES, BLOCKS, 90)) == [
        "last 60 s, 0 to maximum, 1 s a column",
        f"1/1    loss         12.5% {' ' * 20}{'▁' * 20}{'█' * 20}",
        f"       round trip 1200 ms {' ' * 30}{'▂' * 15}{'█' * 15}",
        f"12/100 loss         12.5% {' ' * 20}{'▁' * 20}{'█' * 20}",
    ]


@pytest.mark.parametrize(
    ("width", "columns"), [(200, 60), (86, 60), (85, 30), (80, 30), (46, 20), (40, 12), (33, 6), (28, 0)]
)
def test_a_narrow_terminal_gets_fewer_columns_and_whole_values(width: int, columns: int) -> None:
    lines = text_of(history_lines(rows(), SCALES, BLOCKS, width))
    if columns:
        assert lines.pop(0) == f"last 60 s, 0 to maximum, {60 // columns} s a column"
    assert len(lines[0][26:]) == columns
    assert re.fullmatch(r"( +▁+█+)?", lines[0][26:])
    assert all("12.5%" in line or "1200 ms" in line for line in lines)
    assert max(map(len, lines)) <= max(width, 26)


def test_without_a_sample_nothing_is_drawn() -> None:
    assert history_lines([], SCALES, BLOCKS, 80) == []


# lines below the table


@pytest.mark.parametrize("width", [24, 30, 40, 80])
def test_lines_are_broken_between_clauses(width: int) -> None:
    text = "udpin:0.0.0.0:14550, 13.5 s: 87 bytes/s received, 36 sent; 4 lost, 0 with a wrong checksum"
    lines = wrapped(text, width)
    assert " ".join(lines) == text
    assert max(map(len, lines)) <= width
    for value in ("13.5 s", "87 bytes/s", "36 sent", "4 lost"):
        assert any(value in line for line in lines)
    assert wrapped("", width) == [""]
    assert wrapped("x" * 100, width) == ["x" * 100]
