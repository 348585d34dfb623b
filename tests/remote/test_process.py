"""A service over real sockets, in a thread of its own: the library and the command as users have them."""

from __future__ import annotations

import asyncio
import gc
import re
import socket
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

from paramclient import LinkError, ParamClient, UsageError, provision, sync
from paramclient.client import reconnect_delays
from paramclient.model.paramset import ParamSet
from paramclient.service import Hub, Listening, serve
from tests.commands import in_process
from tests.shell import TIMEOUT, small_px4, tasks_beside, until

CERT, KEY = (Path(__file__).parents[1] / "data" / name for name in ("tls_station.pem", "tls_station.key"))


@contextmanager
def running(vehicle: Any, port: int = 0, **tls: Path) -> Iterator[str]:
    """The address of a service with this vehicle."""
    started = threading.Event()
    reported: list[Any] = []

    async def run() -> None:
        stop = anyio.Event()

        def listens(url: str) -> None:
            reported.extend([url, asyncio.get_running_loop(), stop])
            started.set()

        hub = Hub([vehicle], cache=False)
        await serve(hub, listening=Listening("127.0.0.1", port, **tls), stop=stop, listens=listens)

    thread = threading.Thread(target=asyncio.run, args=(run(),))
    thread.start()
    assert started.wait(TIMEOUT)
    url, loop, stop = reported
    try:
        yield url
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(TIMEOUT)
        assert not thread.is_alive()


@pytest.mark.asyncio
async def test_the_library_over_sockets_and_through_a_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reconnect_delays, "LINK_TIMEOUT", 0.5)
    monkeypatch.setattr(reconnect_delays, "RECONNECT_BACKOFF_MIN", 0.05)
    monkeypatch.setattr(reconnect_delays, "RECONNECT_BACKOFF_MAX", 0.1)
    vehicle = small_px4()
    with anyio.fail_after(TIMEOUT):
        with running(vehicle) as url:
            client = ParamClient(url)
            await client.__aenter__()
            component = await client.component()
            assert (await component.fetch_all()).complete
            assert (await component.set("PARAM_01", 77)).actual == 77
            assert component.params["PARAM_01"].value == 77
        await until(lambda: "reconnecting" in repr(client))
        refused = r"connection refused\. Is `paramclient serve` running there\?"
        with pytest.raises(LinkError, match="connection refused") as caught:
            await component.get("PARAM_01")
        assert re.fullmatch(f"{url}: {refused}", str(caught.value))
        assert caught.value.link == url
        with running(vehicle, int(url.rpartition(":")[2])):
            await until(lambda: "open" in repr(client))
            assert (await component.get("PARAM_01")).value == 77
            await client.__aexit__(None, None, None)
    assert not tasks_beside()


def test_the_command_over_a_service(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    vehicle = small_px4()
    command = in_process(capsys)
    with running(vehicle) as url:
        assert command("set", url, "PARAM_01", 5).code == 0
        assert vehicle.param("PARAM_01").value == 5
        assert command("get", url, "PARAM_01", "--json").json["params"]["PARAM_01"]["value"] == 5
        fetched = command("fetch", url, "--json")
        assert (fetched.code, len(fetched.json["params"])) == (0, 25)
        watched = command(
            "watch", url, "--timeout", 5.0, "--json"
        )  # it fetches all first, on a busy machine too
        assert watched.code == 0
        saved = command("save", url, tmp_path / "all.params")
        assert saved.code == 0
        assert command("diff", url, tmp_path / "all.params").code == 0
        refused = command("link", url)
        assert refused.code != 0
        assert "does not report the traffic" in refused.err
        refused = command("get", url, "PARAM_01", "--no-cache")
        assert refused.code != 0
        assert "cache is only for a client with its own link" in refused.err
    assert not list(tmp_path.glob("**/*.sqlite3")), "nothing is cached here"


def test_a_command_asks_whether_the_service_runs() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(LinkError, match=r"connection refused\. Is `paramclient serve` running there\?"):
            asyncio.run(ParamClient(url).__aenter__())


@pytest.mark.parametrize(
    ("call", "command", "path"),
    [
        ("apply", "apply {} FILE", "apply"),
        ("restore", "restore {}", "restore"),
        ("verify", "verify {} FILE", "verify"),
        ("prepare", "apply --dry-run {} FILE", "plan"),
    ],
)
def test_a_set_up_by_the_library_names_the_command_and_the_request_that_do_it(
    call: str, command: str, path: str
) -> None:
    vehicle = small_px4()
    wanted = ParamSet.of([vehicle.param("PARAM_01")])
    with running(vehicle) as url, sync.ParamClient(url) as client:
        component = client.only_component()
        with pytest.raises(UsageError, match="a service does not give") as caught:
            getattr(sync, call)(component, wanted)
        reported = str(caught.value)
        assert f"does not give {call}() the link itself" in reported
        assert f"`paramclient {command.format(url)}`" in reported
        assert f"POST {url}/api/v1/components/1/1/{path}, for example with httpx" in reported
    assert vehicle.requests["PARAM_SET"] == 0


@pytest.mark.parametrize("call", ["metadata_of", "load_if_quick", "check_vehicle"])
def test_a_call_that_needs_the_link_says_what_to_do_over_a_service(call: str) -> None:
    with running(small_px4()) as url, sync.ParamClient(url) as client:
        component = client.only_component()
        arguments = (client, component) if call == "check_vehicle" else (component,)
        with pytest.raises(UsageError) as caught:
            getattr(sync, call)(*arguments)
    told = str(caught.value)
    assert told.startswith(f"a service does not give {call}() the link itself, which it needs. ")
    if call == "check_vehicle":
        assert "Run `paramclient check LINK`, or pass an open ParamClient(LINK, traffic=True" in told
    else:
        assert f"run `paramclient get {url} NAME --metadata vehicle`" in told
        assert f"POST {url}/api/v1/components/1/1/metadata" in told


def test_a_whole_set_up_is_refused_before_anything_is_written() -> None:
    vehicle = small_px4()

    async def apply(url: str) -> None:
        async with ParamClient(url) as client:
            component = await client.component()
            await provision.apply(component, ParamSet.of([vehicle.param("PARAM_01")]))

    with running(vehicle) as url, pytest.raises(UsageError, match="a service does not give"):
        asyncio.run(apply(url))
    assert vehicle.requests["PARAM_SET"] == 0


def test_without_its_library_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith(("paramclient.remote", "httpx"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr("importlib.util.find_spec", lambda name, package=None: None)
    with pytest.raises(UsageError, match=r"pip install 'paramclient\[remote\]'"):
        ParamClient("http://127.0.0.1:1")


@pytest.mark.parametrize("loop", ["asyncio", "trio"])
def test_over_tls_on_both_event_loops(loop: str, monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle = small_px4()

    async def work(url: str) -> None:
        async with ParamClient(url) as one, ParamClient(url) as other:
            component = await one.component()
            changes = (await other.component()).changes()
            assert (await component.fetch_all()).complete
            assert (await component.set("PARAM_01", 77)).actual == 77
            async for change in changes:
                if change.name == "PARAM_01" and change.new is not None and change.new.value == 77:
                    break
            with anyio.move_on_after(0):
                await component.get("PARAM_02")
            assert (await component.get("PARAM_01")).value == 77

    async def enter(url: str) -> None:
        async with ParamClient(url):
            pass

    with running(vehicle, tls_cert=CERT, tls_key=KEY) as url:
        with pytest.raises(LinkError, match="its certificate is not trusted: self-signed certificate"):
            anyio.run(enter, url, backend=loop)
        monkeypatch.setenv("SSL_CERT_FILE", str(CERT))
        anyio.run(work, url, backend=loop)
    with running(vehicle) as url, pytest.raises(LinkError, match="TLS: "):
        anyio.run(enter, url.replace("http:", "https:"), backend=loop)


@pytest.mark.parametrize("loop", ["asyncio", "trio"])
def test_a_handshake_that_is_cancelled_leaves_no_connection_open(loop: str) -> None:
    async def give_up_in_the_middle(listener: socket.socket) -> None:
        port = listener.getsockname()[1]

        async def greeted() -> None:
            reached, _ = await anyio.to_thread.run_sync(listener.accept)
            with reached:
                assert await anyio.to_thread.run_sync(reached.recv, 1)
                tasks.cancel_scope.cancel()

        async def enter() -> None:
            async with ParamClient(f"https://127.0.0.1:{port}"):
                pass

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(greeted)
            tasks.start_soon(enter)

    gc.collect()
    with warnings.catch_warnings(record=True) as reported, socket.create_server(("127.0.0.1", 0)) as listener:
        warnings.simplefilter("always")
        anyio.run(give_up_in_the_middle, listener, backend=loop)
        gc.collect()
    assert [str(each.message) for each in reported if issubclass(each.category, ResourceWarning)] == []


@pytest.mark.asyncio
async def test_a_service_ends_in_good_order_with_a_listener_over_tls(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(CERT))
    with anyio.fail_after(TIMEOUT):
        with running(small_px4(), tls_cert=CERT, tls_key=KEY) as url:
            client = ParamClient(url)
            await client.__aenter__()
        await until(lambda: "reconnecting" in repr(client))
        await client.__aexit__(None, None, None)
    assert [record.message for record in caplog.records if record.levelname == "ERROR"] == []
