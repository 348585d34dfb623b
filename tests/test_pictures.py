"""The pictures of the downloads: made from the README's table, readable alone, and shown on both pages."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
LOOKS = ("light", "dark")


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


def test_a_warm_start_is_a_bar_of_its_own(pictures: ModuleType) -> None:
    downloads = pictures.downloads_in(README)
    assert [each.label for each in downloads if each.way == "warm"] == 3 * ["paramclient, warm"]
    drawn = pictures.draw(downloads, "light")
    assert ">paramclient, warm<" in drawn
    assert "Warm: a proven cache" in drawn


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
