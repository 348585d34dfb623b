"""Helpers that run the command line in the test process, with simulated vehicles behind every link."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

import anyio
import anyio.to_thread
import pytest

from paramclient import ParamClient
from paramclient.cli import session as cli_session
from paramclient.cli import signing
from paramclient.cli.app import run
from paramclient.links import SimLink
from paramclient.sim import Endpoint
from tests.shell import PeersLink, SimulatedTimeLoop, while_the_clock_stands


def strict(text: str) -> Any:
    """Read JSON as a parser does that knows no NaN."""

    def refuse(constant: str) -> NoReturn:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


@dataclass(frozen=True)
class Outcome:
    """The exit code and the output of a command."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The one object on the one line of stdout."""
        assert self.out.endswith("\n")
        assert self.out.count("\n") == 1
        return strict(self.out)

    @property
    def words(self) -> list[list[str]]:
        """The words of each line on stdout."""
        return [line.split() for line in self.out.splitlines()]

    @property
    def rows(self) -> list[list[str]]:
        """The cells of the table on stdout; none of them has two blanks in it."""
        return [[cell.strip() for cell in line.split("  ") if cell.strip()] for line in self.out.splitlines()]


Command: TypeAlias = Callable[..., Outcome]
"""Takes the arguments of a command, of any type."""
Put: TypeAlias = Callable[[Endpoint | SimLink | PeersLink], str]
"""Takes a simulated vehicle or a link; returns its URL."""


WITHOUT_CACHE = frozenset({"check", "link", "ports", "signing"})
"""Subcommands without the option --cache."""


def in_process(capsys: pytest.CaptureFixture[str], *cache: str) -> Command:
    """Return a function that runs a command in this process, with the arguments `cache` where they fit."""

    def call(*arguments: object) -> Outcome:
        words = [*map(str, arguments)]
        takes_cache = WITHOUT_CACHE.isdisjoint(words[:1]) and {"--cache", "--no-cache"}.isdisjoint(words)
        code = run([*words, *(cache if takes_cache else ())])
        printed = capsys.readouterr()
        return Outcome(code, printed.out, printed.err)

    return call


def metadata_file(folder: Path, **fields: dict[str, object]) -> Path:
    """Write metadata as PX4 has it, with these fields of each parameter; the type is Float unless given."""
    path = folder / "parameters.json"
    entries = [{"name": name, "type": "Float"} | each for name, each in fields.items()]
    path.write_text(json.dumps({"version": 1, "parameters": entries}), encoding="utf-8")
    return path


def behind(monkeypatch: pytest.MonkeyPatch, url: str) -> Put:
    """Return a function that connects every URL to a vehicle or a link, and returns `url`."""

    def place(far_end: Endpoint | SimLink | PeersLink) -> str:
        def link_of(url: str) -> SimLink | PeersLink:
            return far_end if isinstance(far_end, SimLink | PeersLink) else SimLink(far_end, url)

        def client(url: str, **options: Any) -> ParamClient:
            return ParamClient(link_of(url), **options)

        monkeypatch.setattr(cli_session, "ParamClient", client)
        monkeypatch.setattr(signing, "create_link", link_of)
        return url

    return place


def leaping(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run commands on an event loop with simulated time, on which waits take no time.

    The time of day follows it, and goes on from one command to the next.
    """
    in_thread, loops, began = anyio.to_thread.run_sync, [SimulatedTimeLoop()], time.time()
    loops[0].close()
    began -= loops[0].now

    def next_loop() -> SimulatedTimeLoop:
        loop = SimulatedTimeLoop()
        loop.now = loops[-1].now
        loops.append(loop)
        return loop

    really_run = anyio.run
    monkeypatch.setattr(time, "time", lambda: began + loops[-1].now)
    monkeypatch.setattr(anyio.to_thread, "run_sync", while_the_clock_stands(in_thread))
    monkeypatch.setattr(
        anyio, "run", lambda *call: really_run(*call, backend_options={"loop_factory": next_loop})
    )
