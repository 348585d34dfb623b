"""Fixtures for the command line: a cache, commands on simulated time, vehicles behind every link."""

from __future__ import annotations

import os
import pty
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.commands import Command, Put, behind, in_process, leaping


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache.sqlite3"


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], cache: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run the command line in this process, on simulated time, with a new cache."""
    leaping(monkeypatch)
    return in_process(capsys, "--cache", str(cache))


@pytest.fixture
def put(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Put:
    """Connect every URL to simulated vehicles; return the URL of the module."""
    return behind(monkeypatch, getattr(request.module, "URL", "udpin:0.0.0.0:14550"))


@pytest.fixture
def at_terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Make stdin a terminal at which the user has typed an answer."""
    with ExitStack() as opened:

        def answer(text: str) -> None:
            hand, terminal = pty.openpty()
            os.write(hand, f"{text}\n".encode())
            opened.enter_context(os.fdopen(hand, "wb"))
            monkeypatch.setattr(sys, "stdin", opened.enter_context(os.fdopen(terminal, encoding="utf-8")))
            monkeypatch.setattr(sys.stderr, "isatty", lambda: True)

        yield answer
