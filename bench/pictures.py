"""Draws the comparison with other clients into docs/images: `make pictures`.

The figures are those of the tables in docs/performance.md, so that picture and tables cannot differ.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape

__all__ = ["LOOKS", "Download", "alternative_text", "description", "downloads_in", "draw", "main"]

ROOT: Final = Path(__file__).parent.parent
PAGE: Final = ROOT / "docs/performance.md"
"""The page with the figures."""
IMAGES: Final = ROOT / "docs/images"
"""The folder of the pictures."""
TITLE: Final = "Seconds to read every parameter"
"""The title of the picture."""
CONDITIONS: Final = {"clean": "No packet loss", "5%": "5% packet loss", "20%": "20% packet loss"}
"""The rows of the table, in words."""

WIDTH: Final = 860
"""Width of the picture: that of a page on GitHub."""
PANEL_WIDTH: Final = 416
"""Width of the part for one autopilot."""
LABEL_WIDTH: Final = 140
"""Width of the clients' names: that of `paramclient, by file`."""
VALUE_WIDTH: Final = 54
"""Width of the seconds behind the longest bar."""
TOP: Final = 92
"""Height of the titles."""
GROUP_HEAD: Final = 24
"""Height of the heading of a group of bars."""
ROW: Final = 19
"""Height of a bar with its distance from the next one."""
BAR: Final = 11
"""Height of a bar."""
GROUP_GAP: Final = 16
"""Distance between two groups of bars."""
FOOT: Final = 50
"""Height of the axis and the notes."""
WAY_GAP: Final = 6
"""Distance between the bars of two ways."""
WAYS: Final = {"list": "", "file": ", by file", "gateway": ", by gateway", "warm": ", warm"}
"""The ways in the order of their bars, as they stand behind the client."""
TICK: Final = 30
"""Seconds between two lines of the axis."""
FONT: Final = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
"""Fonts of the system: a picture in a page may load nothing."""

LOOKS: Final = {
    "light": {"text": "#1f2328", "quiet": "#59636e", "grid": "#d8dee4", "ours": "#0969da", "peer": "#afb8c1"},
    "dark": {"text": "#e6edf3", "quiet": "#9198a1", "grid": "#30363d", "ours": "#4493f8", "peer": "#59636e"},
}
"""Colours of the pictures for light and dark pages; the ground is that of the page."""


@dataclass(frozen=True, slots=True)
class Download:
    """One figure of the table.

    Attributes:
        autopilot: `PX4`, `ArduPilot`.
        way: "list", "file" (the vehicle's MAVFTP parameter file), "gateway" or "warm" (a proven cache).
        count: parameters of the vehicle.
        condition: `clean`, or the share of lost datagrams.
        client: the name of the client.
        seconds: the time, as in the table.
    """

    autopilot: str
    way: str
    count: int
    condition: str
    client: str
    seconds: str

    @property
    def label(self) -> str:
        """The client and the way, short enough for the picture."""
        return self.client.partition(",")[0] + WAYS[self.way]

    @property
    def is_ours(self) -> bool:
        return self.client == "paramclient" or self.way == "gateway"


def downloads_in(text: str) -> list[Download]:
    """Return the figures of the tables of other clients and of the gateway, in the order of their bars.

    Cells without a number ("not supported") are left out. Of the gateway, the slowest station in sync counts.

    Raises:
        ValueError: a table is missing, or a row has another form.
    """
    (_, *clients), *rows = _table(text, "Other clients")
    downloads = []
    for what, *cells in rows:
        row = re.fullmatch(r"(\w+)(?: (?:by )?(list|file|warm))?, (\d+), (\S+)", what)
        if row is None or row[4] not in CONDITIONS or len(cells) != len(clients):
            raise ValueError(f"unexpected row in the table of {PAGE.name}: {what}")
        for client, cell in zip(clients, cells, strict=True):
            if seconds := re.match(r"\d+\.\d+\b", cell):
                downloads.append(Download(row[1], row[2] or "list", int(row[3]), row[4], client, seconds[0]))
    counts = {each.autopilot: each.count for each in downloads}
    _, *stations = _table(text, "Ground stations behind the gateway")
    for autopilot, count in counts.items():
        in_sync = [cells[3] for cells in stations if cells[0] == f"{autopilot} 20%" and cells[3]]
        downloads.append(Download(autopilot, "gateway", count, "20%", "any", max(in_sync, key=float)))
    return sorted(downloads, key=lambda each: list(WAYS).index(each.way))


def _table(text: str, heading: str) -> list[list[str]]:
    """Return the cells of the first table below a heading, without the line below its first row."""
    found = re.search(rf"^## {heading}$.*?^(\|.*?)\n\n", text, re.MULTILINE | re.DOTALL)
    if found is None:
        raise ValueError(f"{PAGE.name} has no table below {heading!r}")
    first, _, *rows = (_cells(line) for line in found[1].splitlines())
    return [first, *rows]


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def description(downloads: list[Download]) -> str:
    """Return all figures as sentences, for a reader who cannot see the picture."""
    return " ".join(
        f"{autopilot}, {_lower(words)}: {_figures(downloads, autopilot, condition)}."
        for autopilot in _autopilots(downloads)
        for condition, words in CONDITIONS.items()
    )


def alternative_text(downloads: list[Download]) -> str:
    """Return the text for pages instead of the picture: the figures of the last condition."""
    condition, words = list(CONDITIONS.items())[-1]
    reported = "; ".join(
        f"{autopilot}: {_figures(downloads, autopilot, condition)}" for autopilot in _autopilots(downloads)
    )
    return f"{TITLE}, as bars without packet loss and with 5% and 20%. At {_lower(words)}, {reported}."


def draw(downloads: list[Download], look: str) -> str:
    """Return the picture as SVG, for a light or a dark page."""
    return "\n".join(_lines(downloads, LOOKS[look])) + "\n"


def main() -> None:
    """Write the pictures."""
    downloads = downloads_in(PAGE.read_text(encoding="utf-8"))
    for look in LOOKS:
        path = IMAGES / f"downloads-{look}.svg"
        path.write_text(draw(downloads, look), encoding="utf-8")
        print(path.relative_to(ROOT))


def _autopilots(downloads: list[Download]) -> list[str]:
    return list(dict.fromkeys(each.autopilot for each in downloads))


def _group(downloads: list[Download], autopilot: str, condition: str) -> list[Download]:
    return [each for each in downloads if (each.autopilot, each.condition) == (autopilot, condition)]


def _figures(downloads: list[Download], autopilot: str, condition: str) -> str:
    return ", ".join(f"{each.label} {each.seconds} s" for each in _group(downloads, autopilot, condition))


def _lower(words: str) -> str:
    return words[0].lower() + words[1:]


def _lines(downloads: list[Download], look: dict[str, str]) -> Iterator[str]:
    autopilots = _autopilots(downloads)
    heights = [
        GROUP_HEAD
        + WAY_GAP * (len(WAYS) - 1)
        + ROW * max(len(_group(downloads, autopilot, condition)) for autopilot in autopilots)
        for condition in CONDITIONS
    ]
    bottom = TOP + sum(heights) + GROUP_GAP * (len(heights) - 1)
    height = bottom + FOOT
    end = -(-max(float(each.seconds) for each in downloads) // TICK) * TICK
    scale = (PANEL_WIDTH - LABEL_WIDTH - VALUE_WIDTH) / end

    yield (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" '
        f'height="{height}" role="img" aria-labelledby="title figures">'
    )
    yield f'<title id="title">{escape(TITLE)}</title>'
    yield f'<desc id="figures">{escape(description(downloads))}</desc>'
    yield "<style>"
    yield f"text {{ font: 12px {FONT}; fill: {look['text']}; }}"
    yield ".title { font-size: 17px; font-weight: 600; }"
    yield ".panel { font-size: 14px; font-weight: 600; }"
    yield f".group {{ font-weight: 600; fill: {look['quiet']}; }}"
    yield f".quiet {{ fill: {look['quiet']}; }}"
    yield ".value { font-variant-numeric: tabular-nums; }"
    yield f".ours {{ font-weight: 600; fill: {look['ours']}; }}"
    yield f".axis {{ font-size: 11px; fill: {look['quiet']}; text-anchor: middle; }}"
    yield "</style>"
    yield f'<text class="title" x="0" y="22">{escape(TITLE)}</text>'
    yield (
        '<text class="quiet" x="0" y="43">Simulated vehicles over UDP, median of several downloads. '
        "Where datagrams are lost, the round-trip time is 100 ms.</text>"
    )
    for column, autopilot in enumerate(autopilots):
        yield from _panel(
            downloads,
            autopilot,
            look,
            left=column * (WIDTH - PANEL_WIDTH),
            heights=heights,
            bottom=bottom,
            scale=scale,
            end=end,
        )
    others = dict.fromkeys(each.client for each in downloads if ", " in each.client)
    notes = [each.replace(", ", ": ", 1) for each in others]
    notes += [
        "By file: the MAVFTP parameter file",
        "By gateway: any station behind it",
        "Warm: a proven cache",
    ]
    yield f'<text class="quiet" x="0" y="{height - 5}">{escape(". ".join(notes))}.</text>'
    yield "</svg>"


def _panel(
    downloads: list[Download],
    autopilot: str,
    look: dict[str, str],
    *,
    left: int,
    heights: list[int],
    bottom: int,
    scale: float,
    end: float,
) -> Iterator[str]:
    """Yield the part for one autopilot."""
    count = next(each.count for each in downloads if each.autopilot == autopilot)
    zero = left + LABEL_WIDTH
    yield (
        f'<text class="panel" x="{left}" y="{TOP - 14}">{escape(autopilot)}'
        f'<tspan class="quiet" font-weight="400" font-size="12" dx="8">{count:,} parameters</tspan></text>'
    )
    for tick in range(0, int(end) + 1, TICK):
        x = zero + tick * scale
        yield (
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{bottom}" stroke="{look["grid"]}" '
            'stroke-width="1"/>'
        )
        yield f'<text class="axis" x="{x:.1f}" y="{bottom + 16}">{tick}{" s" if tick else ""}</text>'
    top = TOP
    for (condition, words), height in zip(CONDITIONS.items(), heights, strict=True):
        yield f'<text class="group" x="{left}" y="{top + 14}">{escape(words)}</text>'
        for row, each in enumerate(_group(downloads, autopilot, condition)):
            base = top + GROUP_HEAD + row * ROW + list(WAYS).index(each.way) * WAY_GAP + BAR - 1
            kind = "ours" if each.is_ours else "peer"
            text = ' class="ours"' if each.is_ours else ""
            width = float(each.seconds) * scale
            yield f'<text{text} x="{left}" y="{base}">{escape(each.label)}</text>'
            yield (
                f'<rect x="{zero}" y="{base - BAR + 1}" width="{width:.1f}" height="{BAR}" '
                f'fill="{look[kind]}"/>'
            )
            yield (
                f'<text class="value{" ours" if each.is_ours else ""}" x="{zero + width + 6:.1f}" '
                f'y="{base}">{each.seconds} s</text>'
            )
        top += height + GROUP_GAP


if __name__ == "__main__":
    main()
