"""The command that serves, as a process with real sockets: start, a token file, a signal, a second start."""

from __future__ import annotations

import asyncio
import re
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import anyio
import httpx
import pytest

from paramclient.service import add_token
from paramclient.service.server import CONNECTIONS_MAX
from tests.commands import in_process
from tests.service.hub import V, synced
from tests.shell import TIMEOUT

END_TIME = 30.0
"""Seconds within which the service ends on a busy computer, else within 3; a request in it would take 60."""


@asynccontextmanager
async def served(*words: str) -> AsyncIterator[tuple[asyncio.subprocess.Process, httpx.AsyncClient]]:
    """The command in a process of its own, and a client of it."""
    command = (sys.executable, "-m", "paramclient", "serve", *words, "--listen", "127.0.0.1:0")
    process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        assert process.stdout is not None
        with anyio.fail_after(TIMEOUT):
            line = (await process.stdout.readline()).decode()
        found = re.fullmatch(r"serving on (http://127\.0\.0\.1:[1-9]\d*)\n", line)
        assert found, line
        async with httpx.AsyncClient(base_url=found[1], timeout=TIMEOUT) as browser:
            yield process, browser
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.asyncio
async def test_a_signal_ends_it_with_streams_and_requests(tmp_path: Path, number: signal.Signals) -> None:
    """Also with half a request, of which nothing is logged."""
    words = ("sim:px4", "--cache", str(tmp_path / "cache.sqlite3"))
    async with (
        served(*words) as (process, browser),
        anyio.create_task_group() as tasks,
        await anyio.connect_tcp("127.0.0.1", browser.base_url.port or 0) as half,
    ):
        await synced(browser)
        await browser.put(f"{V}/params/MC_ROLL_P", json={"value": 7.5})
        answers = []

        async def wait() -> None:
            body = {"value": 8.5, "settle_s": 60}
            answers.append((await browser.put(f"{V}/params/MC_ROLL_P", json=body)).status_code)

        async with browser.stream("GET", "/api/events") as stream:
            await half.send(b"POST /api/files HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n{")
            lines = stream.aiter_lines()
            assert (await anext(lines)).startswith("data: ")
            tasks.start_soon(wait)
            async for line in lines:
                if '"type":"change"' in line:
                    break
            began = time.monotonic()
            process.send_signal(number)
            async for _ in lines:  # ends
                pass
        out, err = await process.communicate()
        assert time.monotonic() - began < END_TIME
        assert (process.returncode, out, err) == (0, b"", b"")
    assert answers == [503]
    async with served(*words) as (_, browser):  # the values are in the cache
        await synced(browser)
        assert (await browser.post(f"{V}/fetch", json={})).json()["source"] == "cache"


@pytest.mark.asyncio
async def test_it_wants_a_token_of_its_file(tmp_path: Path) -> None:
    token = add_token(tmp_path / "tokens", "anna", "write")
    async with served("sim:px4", "--no-cache", "--tokens", str(tmp_path / "tokens")) as (_, browser):
        assert (await browser.get("/api/vehicles")).status_code == 401
        browser.headers["Authorization"] = f"Bearer {token}"
        await synced(browser)


@pytest.mark.asyncio
async def test_connections_have_a_bound() -> None:
    async with served("sim:px4", "--no-cache") as (_, browser), AsyncExitStack() as opened:
        for _ in range(CONNECTIONS_MAX):
            await opened.enter_async_context(await anyio.connect_tcp("127.0.0.1", browser.base_url.port or 0))
        assert (await browser.get("/health")).status_code == 503


OTHERS = ["0.0.0.0:0", "[::]:0", "192.0.2.1:0", "station.example:0"]
NOT_OURS = "tcpin:192.0.2.1:5760"
INVALID = ["127.0.0.1", ":80", "::1:80", "[::1]", "host:", "host:x", "host:70000"]


@pytest.mark.parametrize(
    ("code", "words", "said"),
    [
        *((2, ["sim:px4", "--listen", address], "--tokens") for address in OTHERS),
        *((2, ["sim:px4", "--listen", address], "HOST:PORT") for address in INVALID),
        (2, ["sim:px4", "--tokens", "no-such-file"], "no-such-file"),
        (2, ["sim:px4", "sim:px4"], "twice"),
        (4, ["sim:px4", "--listen", "127.0.0.1:0", "--mavlink", NOT_OURS], NOT_OURS),
    ],
)
def test_a_failing_start(code: int, words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    options = [] if {"--cache", "--no-cache"} & set(words) else ["--no-cache"]
    ended = in_process(capsys)("serve", *words, *options)
    assert (ended.code, ended.out) == (code, "")
    assert said in ended.err
