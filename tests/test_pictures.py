"""The pictures of the downloads: made from the tables of docs/performance.md, and shown in the README."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
FIGURES = (ROOT / "docs/performance.md").read_text(encoding="utf-8")
LOOKS = ("light", "dark")


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "bench")
    import pictures

    return pictures


@pytest.mark.parametrize("look", LOOKS)
def test_the_pictures_are_those_of_the_tables(pictures: ModuleType, look: str) -> None:
    drawn = pictures.draw(pictures.downloads_in(FIGURES), look)
    kept = (ROOT / f"docs/images/downloads-{look}.svg").read_text(encoding="utf-8")
    assert kept == drawn, "run `make pictures`"


def test_gateway_and_warm_start_are_bars_of_their_own(pictures: ModuleType) -> None:
    downloads = pictures.downloads_in(FIGURES)
    assert {each.autopilot for each in downloads if each.way == "gateway"} == {"PX4", "ArduPilot"}
    assert {each.label for each in downloads if each.way == "warm"} == {"paramclient, warm"}


def test_the_readme_shows_the_pictures_with_their_figures_as_text(pictures: ModuleType) -> None:
    reported = pictures.alternative_text(pictures.downloads_in(FIGURES))
    [shown] = re.findall(r"<picture>\n(.*?)</picture>", README, re.DOTALL)
    files = re.findall(r'(?:src|srcset)="([^"]*)"', shown)
    assert files == ["docs/images/downloads-dark.svg", "docs/images/downloads-light.svg"]
    assert 'media="(prefers-color-scheme: dark)"' in shown
    assert re.findall(r'alt="([^"]*)"', shown) == [reported], "the text of the picture is an old one"
