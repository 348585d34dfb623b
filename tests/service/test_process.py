"""The command that serves, as a process with real sockets: how it begins, what it survives, how it ends."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import anyio
import httpx
import pytest
from websockets.asyncio.client import connect

from paramclient import ParamCache
from paramclient.cli import serve as command
from paramclient.errors import UsageError
from paramclient.links import create_link, serve_endpoint
from paramclient.protocol import wire
from paramclient.service import Listening
from tests.commands import in_process
from tests.shell import TIMEOUT, VALUES, Tap, small_px4, until

C = "/api/v1/components/1/1"


@asynccontextmanager
async def served(*words: str) -> AsyncIterator[tuple[asyncio.subprocess.Process, httpx.AsyncClient]]:
    """The command in a process of its own, and a client of it."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        *("-m", "paramclient", "serve", *words, "--listen", "127.0.0.1:0"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
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


async def ended(process: asyncio.subprocess.Process) -> tuple[int, str]:
    """How a process ends, and what it has said on stderr."""
    with anyio.fail_after(TIMEOUT):
        _, err = await process.communicate()
    assert process.returncode is not None
    return process.returncode, err.decode()


@pytest.mark.asyncio
async def test_serve_waits_for_a_vehicle_and_ends_cleanly(tmp_path: Path) -> None:
    """The link is not there yet when it begins. At the end listeners are let go, and callers answered."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    vehicle = Tap(small_px4())
    async with (
        served(f"tcp:127.0.0.1:{port}", "--cache", str(tmp_path / "cache")) as (process, browser),
        anyio.create_task_group() as tasks,
    ):

        async def state() -> str:
            return str((await browser.get("/health")).json()["links"][0]["state"])

        with anyio.fail_after(TIMEOUT):
            while await state() != "failed":  # noqa: ASYNC110 - requested over HTTP
                await asyncio.sleep(0.05)
        await tasks.start(serve_endpoint, vehicle, create_link(f"tcpin:127.0.0.1:{port}"))
        await browser.post("/api/v1/find", json={})
        fetched = (await browser.post(f"{C}/fetch", json={})).json()
        assert fetched["received"] == len(VALUES) + 1
        with ParamCache(tmp_path / "cache") as cache:
            await until(cache.components)  # a change of what was never kept is none
        done = await browser.put(f"{C}/params/PARAM_01", json={"value": 77})
        assert done.status_code == 200, done.text

        address = str(browser.base_url).replace("http", "ws")
        async with (
            browser.stream("GET", "/api/v1/events") as stream,
            connect(f"{address}/api/v1/ws") as frames,
        ):
            lines = stream.aiter_lines()
            assert (await anext(lines)).startswith("id: ")
            assert json.loads(await frames.recv())["type"] == "hello"
            vehicle.is_deaf = True
            pending = asyncio.create_task(browser.put(f"{C}/params/PARAM_02", json={"value": 5}))
            await until(
                lambda: any(each.param_id == "PARAM_02" for each in vehicle.messages(wire.ParamSetMessage))
            )
            process.send_signal(signal.SIGTERM)
            answer = await pending
            assert (answer.status_code, answer.json()["type"]) == (503, "urn:paramclient:closing")
            async for _ in lines:
                pass
            async for _ in frames:
                pass
            assert frames.close_code == 1001
        code, err = await ended(process)
        assert code == 0, err
        assert "Traceback" not in err
        tasks.cancel_scope.cancel()
    with ParamCache(tmp_path / "cache") as cache:
        kept = cache.component(system=1)
        assert kept.params["PARAM_01"].value == 77
        assert [each.by for each in cache.history(kept.key, name="PARAM_01")] == ["us for local"]


@pytest.mark.asyncio
async def test_ctrl_c_ends_it_too_and_a_page_of_the_api_is_there() -> None:
    async with served("sim:px4", "--no-cache", "--no-fetch") as (process, browser):
        assert (await browser.get("/docs")).status_code == 200
        found = (await browser.post("/api/v1/find", json={})).json()
        assert (found["link"], found["params"]) == ("sim:px4", 0)
        process.send_signal(signal.SIGINT)
        code, err = await ended(process)
        assert (code, err) == (0, "")


def test_invalid_arguments_of_serve_are_reported_in_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    call = in_process(capsys)
    for words, what in (
        ((), "no link is given"),
        (("nonsense:",), "link name"),
        (("sim:px4", "--listen", "8765"), "HOST:PORT"),
        (("sim:px4", "--listen", "[::1"), "HOST:PORT"),
        (("sim:px4", "--cache", "a", "--no-cache"), "exclude"),
        (("sim:px4", "--tls-cert", "a.pem", "--no-cache"), "key"),
    ):
        outcome = call("serve", *words)
        assert outcome.code == 2, outcome
        assert what in outcome.err


def test_without_its_libraries_it_says_how_to_install_them(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "find_spec", lambda name: None if name == "uvicorn" else object())
    outcome = in_process(capsys)("serve", "sim:px4")
    assert outcome.code == 2
    assert "serving needs uvicorn: pip install 'paramclient[service]'" in outcome.err


def test_an_address_that_is_taken_is_a_link_that_fails(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        outcome = in_process(capsys)("serve", "sim:px4", "--no-cache", "--listen", f"127.0.0.1:{port}")
    assert outcome.code == 4
    assert f"cannot listen on 127.0.0.1:{port}" in outcome.err


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("127.0.0.1:8765", "http://127.0.0.1:8765"),
        ("localhost:0", "http://localhost:0"),
        ("[::1]:80", "http://[::1]:80"),
    ],
)
def test_valid_listening_addresses(text: str, url: str) -> None:
    assert Listening.at(text).url == url


@pytest.mark.parametrize("text", ["", "8765", ":8765", "a:", "a:x", "a:65536", "::1:80", "a:-1", "a:٣"])
def test_invalid_listening_addresses_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        Listening.at(text)
