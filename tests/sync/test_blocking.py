"""The blocking client: in scripts, threads, notebooks, a REPL; Ctrl-C, the end of the program, mistakes."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import FrameType
from typing import Any

import anyio
import pytest
import trio

from paramclient import (
    AnotherVehicle,
    ClientClosed,
    LinkError,
    NoReply,
    ParamCache,
    ParamClientError,
    Progress,
    SetStatus,
    Trust,
    UnknownParameter,
    UsageError,
)
from paramclient.links import Peer, SimLink
from paramclient.sim import Air, Endpoint
from paramclient.sync import Component, Discovered, FetchIterator, Lost, ParamClient, client_thread
from tests.cable import TIMEOUT
from tests.shell import Late, Tap, bits, generic, small_px4

ROOT = Path(__file__).parents[2]


def a_client(link: Any, **options: Any) -> ParamClient:
    """A client without a cache, unless one is given."""
    return ParamClient(link, **{"cache": False} | options)


def swift_px4() -> Any:
    """A PX4 vehicle that sends its list in a moment."""
    return small_px4(burst=50, period=0.001)


def threads_of_clients() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if "paramclient" in thread.name]


def until(condition: Callable[[], object]) -> None:
    """Wait until a condition holds that no event reports."""
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


@pytest.fixture(autouse=True)
def nothing_remains() -> Iterator[None]:
    """No thread of ours outlives its client."""
    yield
    assert threads_of_clients() == []
    assert not client_thread._running


def is_waiting() -> bool:
    """Whether the main thread waits for a call of a client, or for a callback of one."""
    frame: FrameType | None = sys._current_frames()[threading.main_thread().ident or 0]
    names = set()
    while frame is not None:
        names.add(frame.f_code.co_name)
        frame = frame.f_back
    return "_next_report" in names or "sleep_in_callback" in names


def send(number: signal.Signals) -> None:
    """Send a signal to this process once the main thread waits."""
    until(is_waiting)
    os.kill(os.getpid(), number)


@contextlib.contextmanager
def ctrl_c() -> Iterator[None]:
    """Press Ctrl-C while the body waits; it must raise KeyboardInterrupt."""
    thread = threading.Thread(target=send, args=[signal.SIGINT])
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012 - the signal must not arrive before
        thread.start()
        yield
    thread.join()


@pytest.fixture(autouse=True)
def raises_keyboard_interrupt() -> Iterator[None]:
    """A job in the background of a shell ignores Ctrl-C, and so would its tests."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


# Calls


def test_the_traceback_of_a_mistake_is_short() -> None:
    """A notebook shows the call, the error and its suggestion, without the frames of the event loop."""
    with a_client(swift_px4()) as client:
        component = client.only_component()
        component.fetch_all()
        mistakes: dict[str, Callable[[], object]] = {
            "get": lambda: component.get("PARAM_0X"),
            "set": lambda: component.set("PARAM_0X", 1),
            "value": lambda: component.set("PARAM_01", "high"),  # type: ignore[arg-type]  # a mistake
            "reset": lambda: component.reset("PARAM_0X"),
            "component": lambda: client.component(system=99, timeout=0.01),
            "link": lambda: ParamClient("udpin:nowhere"),
            "port": lambda: a_client("serial:/dev/not-there").open(),
        }
        for name, mistake in mistakes.items():
            with pytest.raises(ParamClientError) as caught:
                mistake()
            assert len(caught.traceback) <= 5, name  # this function, the lambda, and at most three of ours
            if name == "get":
                assert "Did you mean PARAM_0" in str(caught.value)


def test_the_traceback_of_an_error_in_a_callback_is_whole() -> None:
    def give_up(progress: Progress) -> None:
        raise UsageError("the end")

    with a_client(swift_px4()) as client, pytest.raises(UsageError, match="the end") as caught:
        client.only_component().fetch_all(progress=give_up)
    assert caught.traceback[-1].name == "give_up"


def test_the_calls_of_the_asynchronous_client_without_await() -> None:
    vehicle = swift_px4()
    reported: list[tuple[Progress, str]] = []
    with a_client(vehicle) as client:
        component = client.only_component()
        result = component.fetch_all(
            progress=lambda progress: reported.append((progress, threading.current_thread().name))
        )
        assert result.complete
        assert bits(component.params) == bits(vehicle.params)
        assert component.get("PARAM_01").value == 1
        assert component.set("PARAM_01", 77).status == "accepted"
        many = component.set_many({"PARAM_02": 8, "PARAM_04": 9})
        assert many.counts == {SetStatus.ACCEPTED: 2}
        assert vehicle.params["PARAM_04"].value == component.params["PARAM_04"].value == 9
        assert client.fetch_all().complete
        assert (component.system, component.component, component.autopilot) == (1, 1, "px4")
        with pytest.raises(UnknownParameter, match="NO_SUCH"):
            component.get("NO_SUCH")
        with pytest.raises(NoReply):
            client.component(system=99, timeout=0.01)
    assert reported[-1] == (Progress(25, 25, reported[-1][0].rate, 0.0), threading.current_thread().name)
    ranges = reported[-1][0].ranges
    assert ranges is not None
    assert [part.received for part in ranges.split(5)] == [5] * 5


def test_one_object_for_each_component() -> None:
    with a_client(Air([generic(), generic(system=2)])) as client:
        component = client.component(1)
        other = client.component(2)
        assert client.component(1) is component
        assert client.components[1, 1] is component
        assert client.autopilots == [component, other]
        with pytest.raises(AnotherVehicle):
            client.successor(component, 2, timeout=None)
        assert dict(client.components) == {(1, 1): component, (2, 1): other}
        assert list(client.components.values()) == [component, other]
        assert len(client.components) == 2
        assert (3, 1) not in client.components
        assert component.ext is component.ext
        assert client.ftp(component) is not None


def test_params_are_a_live_view_that_may_change_during_an_iteration() -> None:
    with a_client(swift_px4()) as client:
        component = client.component()
        params = component.params
        assert params is component.params
        assert len(params) == 0
        component.fetch_all()
        assert len(params) == 25
        for name in params:
            client_thread_of(client).client.components[1, 1].params._params.compact.pop(name, None)  # type: ignore[attr-defined]  # as the event loop does
        assert list(params.items()) == []
        assert params.get("PARAM_01") is None
        with pytest.raises(KeyError, match="PARAM_01"):
            params["PARAM_01"]
        assert component.ext.params == {}
        assert repr(component.ext.params) == "{}"


def client_thread_of(client: ParamClient) -> client_thread.ClientThread:
    return client._thread


def test_a_set_is_in_the_cache_after_the_with(tmp_path: Path) -> None:
    with ParamClient(swift_px4(), cache=tmp_path / "cache") as client:
        component = client.component()
        component.fetch_all()
        component.set("PARAM_01", 77)
    with ParamCache(tmp_path / "cache") as cache:
        assert cache.component(system=1).params["PARAM_01"].value == 77


def test_values_may_be_those_of_an_iterator_that_calls_the_client() -> None:
    with a_client(generic()) as client:
        component = client.component()
        done = component.set_many(
            (name, float(component.get(name).value) + 1) for name in ("PARAM_01", "PARAM_02")
        )
        assert [each.result.actual for each in done.outcomes if each.result is not None] == [2, 3]


def test_progress_may_call_the_client_and_an_error_of_it_ends_the_call() -> None:
    states: list[str] = []

    def stop(progress: Progress) -> None:
        states.append(component.state)
        raise ZeroDivisionError

    with a_client(generic(burst=1, period=0.1)) as client:
        component = client.component()
        with pytest.raises(ZeroDivisionError):
            component.fetch_all(progress=stop)
        until(lambda: component.state != "fetching")
    assert states == ["fetching"]


def test_the_progress_of_a_fetch_is_an_iterator() -> None:
    with a_client(swift_px4()) as client:
        component = client.component()
        fetch = FetchIterator(component)
        seen = [(progress.received, progress.total) for progress in fetch]
        assert seen[-1] == (fetch.result.count, fetch.result.count)
        assert fetch.result.complete
        assert list(fetch) == []
        assert FetchIterator(component, refresh=True).result.complete
        with pytest.raises(UsageError):
            list(FetchIterator(component, accept="sampled", sample=0))
    with pytest.raises(ClientClosed):
        FetchIterator(component)


def test_a_body_may_call_the_client_while_a_fetch_reports() -> None:
    with a_client(generic(burst=1, period=0.05)) as client:
        component = client.component()
        states = [component.state for _ in FetchIterator(component)]
        assert states[0] == "fetching"


def test_a_forgotten_iterator_cancels_its_fetch() -> None:
    with a_client(generic(burst=1, period=0.2)) as client:
        component = client.component()
        fetch = FetchIterator(component)
        next(fetch)
        del fetch
        gc.collect()
        until(lambda: component.state != "fetching")


def test_closing_the_client_ends_the_iterator_of_a_fetch() -> None:
    with a_client(generic(burst=1, period=0.2)) as client:
        fetch = FetchIterator(client.component())
        next(fetch)
    with pytest.raises(ClientClosed):
        list(fetch)


def test_an_exception_of_the_body_is_raised_unchanged() -> None:
    error = ZeroDivisionError()
    try:
        with a_client(generic()) as client:
            client.component()
            raise error
    except ZeroDivisionError as caught:
        assert caught is error  # noqa: PT017 - `pytest.raises` would want one statement


# Streams


def test_changes_and_events_are_iterators() -> None:
    with a_client(Late(generic(), 0.0, until=0.3)) as client:
        events = client.events()
        component = client.component()
        changes = component.changes()
        component.get("PARAM_01")
        component.set("PARAM_01", 77)
        change = next(changes)
        assert (change.name, change.new and change.new.value) == ("PARAM_01", 77)
        with pytest.raises(TimeoutError):
            changes.next(timeout=0.01)
        for event in events:
            assert event.component is component
            if isinstance(event, Lost):
                assert event.silence > 5.0
                break
            assert isinstance(event, Discovered)
        changes = component.changes()
        with pytest.raises(NoReply):
            component.get("PARAM_01")
    with pytest.raises(ClientClosed, match="was closed"):
        next(changes)
    with pytest.raises(ClientClosed, match="was closed"):
        events.next(timeout=1.0)


def test_a_stream_gives_what_it_had_queued_when_the_client_was_closed() -> None:
    client = a_client(generic())
    events = client.events()
    with pytest.raises(ClientClosed, match="not open"):
        next(events)
    with client:
        component = client.component()
        changes = component.changes()
        component.get("PARAM_01")
    assert next(changes).name == "PARAM_01"
    with pytest.raises(ClientClosed, match="was closed"):
        next(changes)
    assert isinstance(next(events), Discovered)
    with pytest.raises(ClientClosed, match="was closed"):
        next(component.changes())


def test_streams_end_with_a_log(tmp_path: Path) -> None:
    with a_client(generic(), tlog=tmp_path / "log.tlog") as client:
        client.component().get("PARAM_01")
    with a_client(f"replay:{tmp_path / 'log.tlog'}") as client:
        events = client.events()
        assert {type(event) for event in events} <= {Discovered}
        with pytest.raises(StopIteration):
            next(events)


def test_a_forgotten_stream_is_released() -> None:
    with a_client(generic()) as client:
        component = client.component()
        listeners = client_thread_of(client).client.components[1, 1]._subscriptions  # type: ignore[attr-defined]  # of the asynchronous component
        changes = component.changes()
        assert len(listeners) == 1
        del changes
        until(lambda: not len(listeners))


# Open and close


def test_opened_and_closed_as_in_a_repl() -> None:
    client = a_client(swift_px4())
    assert client.open() is client
    component = client.component()
    component.fetch_all()
    assert " open, " in repr(client)
    client.close()
    client.close()
    assert " closed, " in repr(client)
    assert len(component.params) == 25, "what was known stays readable"
    assert component.state == "lost" or component.params["PARAM_01"].trust is not Trust.VERIFIED
    calls: list[Callable[[], object]] = [
        client.component,
        client.fetch_all,
        lambda: component.get("PARAM_01"),
        lambda: component.set("PARAM_01", 1),
        lambda: component.set_many({"PARAM_01": 1}),
        component.fetch_all,
    ]
    for call in calls:
        with pytest.raises(ClientClosed, match="was closed") as caught:
            call()
        assert caught.value.link == client.link.name
    with pytest.raises(UsageError, match="opened only once"):
        client.open()


def test_a_client_that_is_not_open() -> None:
    client = a_client(generic())
    client.close()
    for call in (client.component, client.fetch_all):
        with pytest.raises(ClientClosed, match="use `with` or `open`"):
            call()
    assert dict(client.components) == {}
    with client:
        with pytest.raises(UsageError, match="opened only once"):
            client.open()
        assert client.component().get("PARAM_01").value == 1


def test_arguments_are_checked_at_once() -> None:
    with pytest.raises(UsageError, match="1 to 255"):
        a_client(generic(), system=0)


def test_a_link_that_cannot_be_opened() -> None:
    client = a_client("tcp:127.0.0.1:1")
    with pytest.raises(LinkError, match="refused"):
        client.open()
    assert threads_of_clients() == []
    with pytest.raises(ClientClosed, match="was closed"):
        client.component()


def test_an_event_loop_that_cannot_be_created(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(function: object) -> None:
        raise OSError("too many open files")

    client = a_client(generic())
    with monkeypatch.context() as patch:
        patch.setattr(anyio, "run", fail)
        with pytest.raises(OSError, match="too many"):
            client.open()
    with pytest.raises(ClientClosed, match="was closed"):
        client.component()


class FaultyLink(SimLink):
    """A link with a mistake in its program.

    Attributes:
        fails: makes the next read fail.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(endpoint, "tcp:faulty:5760")
        self.fails = False

    async def receive(self) -> list[tuple[Peer, bytes]]:
        while not self.fails:  # noqa: ASYNC110 - another thread sets it
            await anyio.sleep(0.001)
        raise ZeroDivisionError("a mistake")


def test_an_unexpected_error_reaches_the_callers(caplog: pytest.LogCaptureFixture) -> None:
    link = FaultyLink(generic())
    client = a_client(link).open()
    link.fails = True
    with caplog.at_level(logging.CRITICAL, "paramclient"):
        with pytest.raises(ClientClosed):
            client.component(timeout=None)
        with pytest.raises(ExceptionGroup) as caught:
            client.close()
    assert caught.group_contains(ZeroDivisionError)
    client.close()


# Threads and event loops


def test_several_threads_share_a_client() -> None:
    with a_client(generic()) as client, ThreadPoolExecutor(8) as threads:
        component = client.component()
        names = [f"PARAM_{number:02}" for number in range(24)]
        assert [each.name for each in threads.map(component.get, names)] == names


@pytest.mark.parametrize("call", ["component", "changes", "get"])
def test_closing_ends_the_calls_of_other_threads(call: str) -> None:
    tap = Tap(generic())
    client = a_client(tap).open()
    component = client.component()
    tap.is_deaf = True
    calls: dict[str, Callable[[], object]] = {
        "component": lambda: client.component(99, timeout=None),
        "changes": lambda: next(component.changes()),
        "get": lambda: component.get("PARAM_01"),
    }
    with ThreadPoolExecutor(1) as threads:
        waiting = threads.submit(calls[call])
        time.sleep(0.02)
        client.close()
        with pytest.raises(ClientClosed):
            waiting.result(TIMEOUT)


@pytest.mark.parametrize("loop", [asyncio.run, trio.run], ids=["asyncio", "trio"])
def test_in_a_notebook_cell(loop: Callable[..., Any]) -> None:
    """A notebook runs its cells in a thread whose event loop runs."""

    async def cell() -> None:
        with a_client(swift_px4()) as client:
            component = client.component()
            assert component.fetch_all().complete
            changes = component.changes()
            assert component.set("PARAM_01", 77).actual == 77
            assert next(changes).name == "PARAM_01"
            assert component.params["PARAM_01"].value == 77
        client = a_client(generic())
        events = client.events()
        client.open()
        assert isinstance(next(events), Discovered)
        client.close()

    loop(cell if loop is trio.run else cell())


def test_next_to_a_running_event_loop() -> None:
    async def work() -> None:
        client = a_client(generic())
        await asyncio.to_thread(client.open)
        component = await asyncio.to_thread(client.component)
        param = await asyncio.to_thread(component.get, "PARAM_01")
        assert param.value == 1
        await asyncio.to_thread(client.close)

    asyncio.run(work())


class Caller:
    """An endpoint that calls the client from its event loop, which would wait for itself."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.component: Component | None = None
        self.raised: list[Exception] = []
        self._endpoint = endpoint

    def receive(self, data: bytes, now: float) -> None:
        self._endpoint.receive(data, now)
        if self.component is not None and not self.raised:
            assert self.component.autopilot == "generic", "what is known can be read"
            try:
                self.component.get("PARAM_01")
            except UsageError as error:
                self.raised.append(error)

    def tick(self, now: float) -> None:
        self._endpoint.tick(now)

    def next_deadline(self) -> float | None:
        return self._endpoint.next_deadline()

    def data_to_send(self) -> list[bytes]:
        return self._endpoint.data_to_send()


def test_a_call_in_the_event_loop_of_the_client_is_refused() -> None:
    caller = Caller(generic())
    with a_client(caller) as client:
        caller.component = client.component()
        caller.component.get("PARAM_02")
    assert "callback" in str(caller.raised[0])


def test_a_forked_process_is_refused() -> None:
    with a_client(generic()) as client:
        component = client.component()
        with pytest.warns() if sys.version_info >= (3, 12) else contextlib.nullcontext():
            child = os.fork()
        if child == 0:
            status = 1
            try:
                component.get("PARAM_01")
            except UsageError:
                status = 0
            finally:
                os._exit(status)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert component.get("PARAM_01").value == 1


# Forgotten


def test_a_forgotten_client_is_closed(tmp_path: Path) -> None:
    client = ParamClient(swift_px4(), cache=tmp_path / "cache").open()
    component = client.component()
    del client
    assert component.fetch_all().complete, "a component keeps its client"
    changes = component.changes()
    component.set("PARAM_01", 77)
    del component
    assert next(changes).name == "PARAM_01"
    assert threads_of_clients()
    del changes
    until(lambda: not threads_of_clients())
    with ParamCache(tmp_path / "cache") as cache:
        assert cache.component(system=1).params["PARAM_01"].value == 77


def test_a_client_that_was_never_opened_is_forgotten() -> None:
    a_client(generic())
    gc.collect()


# Ctrl-C


@pytest.mark.parametrize("call", ["component", "changes", "fetch_all", "get", "progress", "iterator"])
def test_ctrl_c_ends_a_call_at_once(call: str) -> None:
    tap = Tap(generic(burst=1, period=0.2))
    with a_client(tap) as client:
        component = client.component()

        def sleep_in_callback(progress: Progress) -> None:
            time.sleep(TIMEOUT)

        calls: dict[str, Callable[[], object]] = {
            "component": lambda: client.component(99, timeout=None),
            "changes": lambda: next(component.changes()),
            "fetch_all": component.fetch_all,
            "get": lambda: component.get("PARAM_01"),
            "progress": lambda: component.fetch_all(progress=sleep_in_callback),
            "iterator": lambda: list(FetchIterator(component)),
        }
        tap.is_mute = call == "get"
        began = time.monotonic()
        with ctrl_c():
            calls[call]()
        assert time.monotonic() - began < TIMEOUT / 2
        tap.is_mute = False
        machine = client_thread_of(client).client.components[1, 1].machine  # type: ignore[attr-defined]  # of the asynchronous component
        assert not len(machine.reads)
        assert machine.fetch is None
        assert component.get("PARAM_01").value == 1, "the client is as usable as before"


def test_ctrl_c_loses_no_change() -> None:
    with a_client(generic()) as client:
        component = client.component()
        changes = component.changes()
        component.get("PARAM_01")
        call = changes._take_one

        def interrupted(timeout: float | None) -> None:
            call(timeout)
            raise KeyboardInterrupt

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(changes, "_take_one", interrupted)
            with pytest.raises(KeyboardInterrupt):
                next(changes)
        assert next(changes).name == "PARAM_01"


def test_ctrl_c_in_the_body_closes_the_client() -> None:
    client = a_client(generic())
    thread = threading.Thread(target=send, args=[signal.SIGINT])
    with pytest.raises(KeyboardInterrupt), client:  # noqa: PT012 - the signal must not arrive before
        thread.start()
        client.component(99, timeout=None)
    assert " closed, " in repr(client)


def test_a_signal_handler_may_close_the_client() -> None:
    client = a_client(generic()).open()
    before = signal.signal(signal.SIGTERM, lambda number, frame: client.close())
    try:
        threading.Thread(target=send, args=[signal.SIGTERM]).start()
        with pytest.raises(ClientClosed):
            client.component(99, timeout=None)
    finally:
        signal.signal(signal.SIGTERM, before)


def test_ctrl_c_while_the_client_opens() -> None:
    client = a_client(NeverOpenLink(generic()))
    with ctrl_c():
        client.open()
    assert threads_of_clients() == []


class NeverOpenLink(SimLink):
    """A link that does not open."""

    async def open(self) -> None:
        await anyio.sleep_forever()


# Programs


def run(*arguments: str, cache: Path, typed: str = "") -> tuple[str, float]:
    """What a Python program prints, with a cache of its own, and the seconds that it took."""
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-W", "error", *arguments],
        env=os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(cache)},
        input=typed,
        capture_output=True,
        encoding="utf-8",
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout, time.monotonic() - began


LEFT_OPEN = """
import contextlib, threading
from paramclient import ClientClosed
from paramclient.sync import ParamClient
client = ParamClient("sim:px4").open()
vehicle = client.component()
vehicle.fetch_all()
def wait(events):
    with contextlib.suppress(ClientClosed):
        next(events)
threading.Thread(target=wait, args=[client.events()], daemon=True).start()
vehicle.set("MC_ROLL_P", 7.25)
"""


@pytest.mark.parametrize(
    "end",
    [
        "",
        "del client, vehicle",
        "import sys; sys.exit()",
        "client.leads_back = client; del client, vehicle",
        "import atexit; atexit.register(lambda: print(vehicle.get('MC_ROLL_P')))",
    ],
)
def test_a_program_ends_without_closing_its_client(end: str, tmp_path: Path) -> None:
    printed, _ = run("-c", LEFT_OPEN + end, cache=tmp_path)
    assert printed == ("MC_ROLL_P = 7.25\n" if "atexit" in end else "")
    assert "7.25" in run("-m", "paramclient", "show", "1", "MC_ROLL_P", cache=tmp_path)[0]


INTERRUPTED = """
import sys
from paramclient.sync import ParamClient
with ParamClient("sim:px4", cache=False) as client:
    print("waiting", flush=True)
    client.component(99, timeout=None)
"""


def test_ctrl_c_ends_a_script() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "waiting\n"
        process.send_signal(signal.SIGINT)
        _, complaint = process.communicate(timeout=TIMEOUT)
    assert process.returncode == -signal.SIGINT
    assert complaint.endswith("KeyboardInterrupt\n")


TYPED = """
from paramclient.sync import ParamClient
client = ParamClient("sim:px4").open()
vehicle = client.only_component()
vehicle.fetch_all().complete
print("value", vehicle.get("MC_ROLL_P").value)
client.close()
client
try:
    vehicle.get("MC_ROLL_P")
except Exception as error:
    print("error", error)

"""


def test_typed_into_a_repl(tmp_path: Path) -> None:
    printed, _ = run("-i", "-q", cache=tmp_path, typed=TYPED)
    assert "value 4.0" in printed
    assert "<ParamClient sim:px4 closed, 1 component>" in printed
    assert "error the client was closed" in printed


USER = """
from collections.abc import Mapping
from paramclient import FetchResult, Param, SetManyResult, SetResult
from paramclient.sync import Changes, Component, Event, Lost, ParamClient

def use(client: ParamClient) -> None:
    vehicle: Component = client.component()
    param: Param = vehicle.get("A")
    done: SetResult = vehicle.set("A", 1)
    many: SetManyResult = vehicle.set_many({"A": 1}, progress=lambda outcome: print(outcome.name))
    fetched: FetchResult = vehicle.fetch_all(progress=lambda progress: print(progress.received))
    changes: Changes = vehicle.changes()
    for change in changes:
        print(change.name)
    event: Event = client.events().next(timeout=1)
    if isinstance(event, Lost):
        reveal_type(event.component)
    known: Mapping[str, Param] = vehicle.params
    print(param, done, many, fetched, known)
    vehicle.get(1.5)
    vehicle.set_many({"A": []})
    client.successor(1, 2)
    vehicle.no_such_call()
"""


def test_user_code_is_typed(tmp_path: Path) -> None:
    (tmp_path / "user.py").write_text(USER, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(ROOT / ".mypy_cache"), "user.py"],
        env=os.environ | {"MYPYPATH": str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        encoding="utf-8",
        timeout=300,
        check=False,
    )
    found = [line.split(":", 2)[1:] for line in done.stdout.splitlines() if line.startswith("user.py")]
    assert [(int(number), text.split(":")[0].strip()) for number, text in found] == [
        (17, "note"),
        (20, "error"),
        (21, "error"),
        (22, "error"),
        (23, "error"),
    ], done.stdout
    assert 'Revealed type is "paramclient.sync.blocking.Component"' in done.stdout
