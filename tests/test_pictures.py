"""The pictures of the downloads: made from the README's table, readable alone, and shown on both pages."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
LOOKS = ("light", "dark")
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "bench")
    import pictures

    return pictures


@pytest.mark.parametrize("look", LOOKS)
def test_the_pictures_are_those_of_the_table(pictures: ModuleType, look: str) -> None:
    drawn = pictures.draw(pictures.downloads_in(README), look)
    kept = (ROOT / f"docs/images/downloads-{look}.svg").read_text(encoding="utf-8")
    assert kept == drawn, "run `make pictures`"


def test_every_number_of_the_table_is_a_bar(pictures: ModuleType) -> None:
    table = README.partition("### Comparison with other clients")[2].partition("\n\nMedian")[0]
    rows = re.findall(r"^\| (\w+)(?: by (\w+))?, (\d+), (\S+) \| (.*) \|$", table, re.MULTILINE)
    numbers = [cell.split(" (")[0] for *_, cells in rows for cell in cells.split(" | ") if " (" in cell]
    downloads = pictures.downloads_in(README)
    assert [each.seconds for each in downloads] == numbers
    assert len(numbers) == 30
    assert {(each.autopilot, each.condition) for each in downloads} == {
        (autopilot, condition) for autopilot in ("PX4", "ArduPilot") for condition in ("clean", "5%", "20%")
    }
    assert {each.client.partition(",")[0] for each in downloads} == {
        *("paramclient", "pymavlink", "MAVSDK", "MAVProxy")
    }


@pytest.mark.parametrize("look", LOOKS)
def test_bars_are_as_long_as_their_seconds(pictures: ModuleType, look: str) -> None:
    downloads = pictures.downloads_in(README)
    root = ElementTree.fromstring(pictures.draw(downloads, look))
    bars = [float(bar.attrib["width"]) for bar in root.iter(f"{SVG}rect")]
    values = [
        float((each.text or "").removesuffix(" s"))
        for each in root.iter(f"{SVG}text")
        if each.attrib.get("class", "").startswith("value")
    ]
    assert sorted(values) == sorted(float(each.seconds) for each in downloads)
    longest = max(values)
    scale = bars[values.index(longest)] / longest
    assert bars == pytest.approx([value * scale for value in values], abs=0.06)
    width = float(root.attrib["width"])
    for bar in root.iter(f"{SVG}rect"):
        assert float(bar.attrib["x"]) + float(bar.attrib["width"]) + 50 <= width  # its seconds fit behind it


@pytest.mark.parametrize("look", LOOKS)
def test_a_picture_needs_nothing_besides_itself(pictures: ModuleType, look: str) -> None:
    text = pictures.draw(pictures.downloads_in(README), look)
    assert not re.search(r"href|url\(|@import|@font-face|<script|<image", text)
    root = ElementTree.fromstring(text)
    assert root.attrib["role"] == "img"
    title, figures = (root.find(f"{SVG}{name}") for name in ("title", "desc"))
    assert title is not None
    assert figures is not None
    assert root.attrib["aria-labelledby"].split() == [title.attrib["id"], figures.attrib["id"]]
    assert "PX4, 20% packet loss: paramclient" in (figures.text or "")
    assert "sans-serif" in text


def luminance(colour: str) -> float:
    """Return the relative luminance of a colour `#rrggbb` (WCAG 2)."""
    parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.03928 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize(("look", "ground"), [("light", "#ffffff"), ("dark", "#0d1117")])
def test_text_is_readable_on_the_pages(pictures: ModuleType, look: str, ground: str) -> None:
    for use in ("text", "quiet", "ours"):
        darker, lighter = sorted(map(luminance, (pictures.LOOKS[look][use], ground)))
        assert (lighter + 0.05) / (darker + 0.05) >= 4.5, use


def test_both_pages_show_the_pictures_with_their_figures_as_text(pictures: ModuleType) -> None:
    reported = pictures.alternative_text(pictures.downloads_in(README))
    [shown] = re.findall(r"<picture>\n(.*?)</picture>", README, re.DOTALL)
    assert re.findall(r'(?:src|srcset)="([^"]*)"', shown) == [
        *("docs/images/downloads-dark.svg", "docs/images/downloads-light.svg")
    ]
    assert 'media="(prefers-color-scheme: dark)"' in shown
    assert re.findall(r'alt="([^"]*)"', shown) == [reported], "the text of the picture is an old one"
    index = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    images = re.findall(
        r"^```\{image\} images/downloads-(\w+)\.svg\n:class: only-(\w+)\n.*\n:alt: (.*)\n```$",
        index,
        re.MULTILINE,
    )
    assert images == [(look, look, reported) for look in LOOKS]
    assert index.index("{image}") < index.index("{toctree}")


def test_a_table_of_another_form_is_refused(pictures: ModuleType) -> None:
    with pytest.raises(ValueError, match="no table"):
        pictures.downloads_in("# README\n")
    with pytest.raises(ValueError, match="unexpected row"):
        pictures.downloads_in(README.replace("| PX4, 903, 5% |", "| PX4, 5% |"))
