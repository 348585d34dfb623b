"""Packet loss and round trip of each component over the last minute, and their drawing."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from paramclient.cli.block_characters import Marks, Piece
from paramclient.client.traffic import ComponentTraffic, TrafficReport
from paramclient.protocol.requests.round_trip import RoundTrip

__all__ = ["HISTORY_LENGTH", "LOSS", "ROUND_TRIP", "HistoryRow", "LinkHistory", "history_lines", "sparkline"]

HISTORY_LENGTH: Final = 60
"""Samples of a component, one for each second: a minute shows fades, and fits beside a label."""
COLUMN_COUNTS: Final = (60, 30, 20, 15, 12, 10, 6)
"""Columns of a drawing, the most first: each stands for the same number of seconds."""
LOSS: Final = "loss"
"""The label of packet loss."""
ROUND_TRIP: Final = "round trip"
"""The label of round trips."""
STYLES: Final = {LOSS: "yellow", ROUND_TRIP: "cyan"}
"""Colours of the drawings."""


class HistoryRow(NamedTuple):
    """One drawn row.

    Attributes:
        address: of the component, `1/1`.
        quantity: `LOSS` or `ROUND_TRIP`.
        values: a sample for each second, the newest last; None where unknown. Loss is a share, a round trip
            is in seconds.
    """

    address: str
    quantity: str
    values: tuple[float | None, ...]

    @property
    def highest(self) -> float | None:
        """The highest sample, which is the end of the scale; None if none is known."""
        return max((value for value in self.values if value is not None), default=None)


class LinkHistory:
    """The samples of the last `HISTORY_LENGTH` seconds, at most, of each component.

    - Loss: of the frames between one sample and the next. Unknown without a frame in that second.
    - Round trip: of the last read that was answered without a timeout, for as long as that is recent. A read
      that had to be repeated after a timeout is no measurement.

    Args:
        began: the time at which the link was opened.
        validity: seconds for which a measured round trip counts.
    """

    def __init__(self, began: float, *, validity: float) -> None:
        self._began = began
        self._second = 0
        self._validity = validity
        self._samples: dict[tuple[int, int], _Samples] = {}

    def take(
        self, report: TrafficReport, round_trips: Mapping[tuple[int, int], RoundTrip], now: float
    ) -> None:
        """Add a sample for each full second since the last one; none before the next second.

        A late sample counts for all seconds that it covers.

        Args:
            report: the current counts of the link.
            round_trips: the round trips by system and component, of those that have any.
            now: the time.
        """
        second = int(now - self._began)
        elapsed, self._second = second - self._second, second
        if elapsed <= 0:
            return
        for each in report.components:
            address = (each.system, each.component)
            samples = self._samples.setdefault(address, _Samples())
            samples.add(each, round_trips.get(address), self._validity, elapsed)

    def rows(self) -> list[HistoryRow]:
        """Return the rows by address. A quantity of which no sample is known has no row."""
        rows = []
        for (system, component), samples in sorted(self._samples.items()):
            for quantity, values in ((LOSS, samples.losses), (ROUND_TRIP, samples.round_trips)):
                padding = (None,) * (HISTORY_LENGTH - len(values))
                row = HistoryRow(f"{system}/{component}", quantity, (*padding, *values))
                if row.highest is not None:
                    rows.append(row)
        return rows


class _Samples:
    """The samples of one component."""

    def __init__(self) -> None:
        self.losses: deque[float | None] = deque(maxlen=HISTORY_LENGTH)
        self.round_trips: deque[float | None] = deque(maxlen=HISTORY_LENGTH)
        self._frames = self._lost = self._measured = 0
        self._age = 0.0

    def add(
        self, traffic: ComponentTraffic, round_trip: RoundTrip | None, validity: float, elapsed: int
    ) -> None:
        unique_frames = traffic.frames - traffic.repeated
        arrived, lost = unique_frames - self._frames, max(traffic.lost - self._lost, 0)
        self._frames, self._lost = unique_frames, traffic.lost
        self.losses.extend([lost / (arrived + lost) if arrived > 0 else None] * min(elapsed, HISTORY_LENGTH))
        latest = None
        if round_trip is not None and round_trip.responses:
            self._age = 0.0 if round_trip.responses != self._measured else self._age + elapsed
            self._measured = round_trip.responses
            latest = round_trip.response_time if self._age < validity else None
        self.round_trips.extend([latest] * min(elapsed, HISTORY_LENGTH))


def sparkline(values: Sequence[float | None], highest: float, marks: Marks, width: int) -> str:
    """Return columns from zero to `highest`, the newest at the right; a blank where nothing is known.

    A column that stands for several seconds shows the highest of them.

    Args:
        values: the samples, None where unknown.
        highest: the value of a full column.
        marks: the characters.
        width: columns, of which `len(values)` must be a multiple.
    """
    each = len(values) // width
    return "".join(_columns(values, each, highest, marks))


def _columns(values: Sequence[float | None], each: int, highest: float, marks: Marks) -> Iterator[str]:
    for at in range(0, len(values), each):
        known = [value for value in values[at : at + each] if value is not None]
        yield marks.column(max(known) / highest if highest else 0.0) if known else " "


def history_lines(
    rows: Sequence[HistoryRow],
    scales: Mapping[str, Callable[[float], str]],
    marks: Marks,
    width: int,
) -> list[list[Piece]]:
    """Return the lines that draw the rows, with the end of each scale; none without rows.

    Below the width of the shortest drawing, only the ends of the scales are shown.

    Args:
        rows: the rows.
        scales: functions that return a value as text, by quantity.
        marks: the characters.
        width: columns of the terminal.
    """
    if not rows:
        return []
    maxima = [scales[row.quantity](row.highest or 0.0) for row in rows]
    label_width = max(len(row.address) for row in rows)
    quantity_width = max(len(row.quantity) for row in rows)
    maximum_width = max(map(len, maxima))
    left = width - label_width - quantity_width - maximum_width - 3
    columns = next((count for count in COLUMN_COUNTS if count <= left), 0)
    lines: list[list[Piece]] = []
    if columns:
        each = HISTORY_LENGTH // columns
        lines.append([(f"last {HISTORY_LENGTH} s, 0 to maximum, {each} s a column", "bold")])
    address = ""
    for row, maximum in zip(rows, maxima, strict=True):
        label = "" if row.address == address else row.address
        address = row.address
        drawn = sparkline(row.values, row.highest or 0.0, marks, columns) if columns else ""
        text = f"{label:{label_width}} {row.quantity:{quantity_width}} {maximum:>{maximum_width}} "
        lines.append([(text, ""), (drawn, STYLES[row.quantity])])
    return lines
