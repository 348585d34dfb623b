"""The steps that a client logs and counts."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
from pathlib import Path

import anyio
import pytest

from paramclient.cli import run
from tests.shell import FlakyLink, a_client, generic, in_simulated_time, small_px4

WATCHED = "paramclient"


def reported(caplog: pytest.LogCaptureFixture, room: str = "protocol") -> list[str]:
    return [each.getMessage() for each in caplog.records if each.name == f"{WATCHED}.{room}"]


@in_simulated_time
async def test_each_step_is_reported_in_one_line(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    vehicle, path = small_px4(), tmp_path / "cache"
    with caplog.at_level(logging.DEBUG, WATCHED):
        async with a_client(vehicle, cache=path) as client:
            component = await client.component()
            await component.fetch_all()
            await component.get("PARAM_01")
            await component.set("PARAM_01", 9)
    steps = reported(caplog)
    for step in (
        r"to system 1: COMMAND_LONG 512 \(148\)",
        r"1/1: the list is requested, 0 there",
        r"to system 1: PARAM_REQUEST_LIST",
        r"1/1: <FetchResult 1/1 25 params from stream in [0-9.]+ s>",
        r"to system 1: PARAM_REQUEST_READ PARAM_01",
        r"1/1 PARAM_01: answered [0-9.]+ s after try 1",
        r"to system 1: PARAM_SET PARAM_01 to 09000000 of type 6",
        r"1/1 PARAM_01: accepted after try 1",
    ):
        assert sum(bool(re.fullmatch(step, each)) for each in steps) == 1, step
    assert len(steps) < 15, "values of a list are not reported one by one"
    assert reported(caplog, "client")[0] == "sim:custom: open"
    assert reported(caplog, "client")[-1] == "sim:custom: closing"
    assert any("nothing" in each for each in reported(caplog, "client.cache_writer"))
    caplog.clear()
    with caplog.at_level(logging.DEBUG, WATCHED):
        async with a_client(vehicle, cache=path) as client:
            await (await client.component()).fetch_all()
    crc = f"{vehicle.announced_hash():08x}"
    assert f"1/1: hash {crc} announced, {crc} here" in reported(caplog)
    assert any(
        "<CachedComponent 1/1 px4 25 params" in each for each in reported(caplog, "client.cache_writer")
    )


@in_simulated_time
async def test_a_link_that_drops_and_returns_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    link = FlakyLink(generic())
    with caplog.at_level(logging.DEBUG, WATCHED):
        async with a_client(link) as client:
            await client.component()
            await link.drop()
            await anyio.sleep(3.0)
    levels = {each.levelname for each in caplog.records if each.name == "paramclient.client.link_task"}
    assert levels == {"WARNING", "INFO"}


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
        assert "protocol: to system 1: PARAM_REQUEST_READ MC_ROLL_P\n" in reported.err
        assert "MC_ROLL_P" in reported.out
        assert "protocol" not in reported.out
    assert run(["link", "sim:px4", "--seconds", "0.1", "-v"]) == 0
    assert "client: sim:px4: open\n" in capsys.readouterr().err
    assert run(["get", "sim:px4", "MC_ROLL_P", "--no-cache"]) == 0
    assert capsys.readouterr().err == ""
    assert logging.getLogger(WATCHED).level == level


def test_control_characters_are_not_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["get", "sim:px4", "BAD\x1b[31m", "-v", "--no-cache"]) == 2
    assert "\x1b" not in capsys.readouterr().err


# numbers
