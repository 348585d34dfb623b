"""The steps that a client logs and counts."""

from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

import pytest

from paramclient.cli import run
from tests.client.conftest import fetched
from tests.shell import small_px4

WATCHED = "paramclient"


async def test_each_step_is_one_line(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    with caplog.at_level(logging.DEBUG, WATCHED):
        async with fetched(small_px4(), cache=tmp_path / "cache") as (_, component):
            await component.get("PARAM_01")
            await component.set("PARAM_01", 9)
    steps = [each.getMessage() for each in caplog.records]
    for words in (
        "open",
        "ParamRequestList(",
        "<FetchResult 1/1 25 params",
        "'PARAM_01'",
        "ParamSet(",
        "closing",
    ):
        assert any(words in each for each in steps), words
    assert len(steps) < 20, "values of a list are not reported one by one"


def test_nothing_is_printed_unless_requested() -> None:
    program = """
import asyncio, logging, paramclient
paramclient.ParamClient  # loads its module
names = [name for name in logging.root.manager.loggerDict if name.startswith("paramclient")]
assert names and not any(logging.getLogger(name).handlers for name in names)
async def main():
    async with paramclient.ParamClient("sim:px4", cache=False) as client:
        await (await client.component()).get("MC_ROLL_P")
asyncio.run(main())
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert (done.stdout, done.stderr) == ("", "")


def test_the_command_logs_its_steps(capsys: pytest.CaptureFixture[str]) -> None:
    level = logging.getLogger(WATCHED).level
    for option in ("-v", "--verbose"):
        assert run(["get", "sim:px4", "MC_ROLL_P", "--no-cache", option]) == 0
        reported = capsys.readouterr()
        assert "ParamRequestRead" in reported.err
        assert "MC_ROLL_P" in reported.out
        assert "ParamRequestRead" not in reported.out
    assert run(["get", "sim:px4", "MC_ROLL_P", "--no-cache"]) == 0
    assert capsys.readouterr().err == ""
    assert logging.getLogger(WATCHED).level == level
    assert run(["get", "sim:px4", "BAD\x1b[31m", "-v", "--no-cache"]) == 2
    assert "\x1b" not in capsys.readouterr().err
