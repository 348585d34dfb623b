"""The command line: JSON, tables, exit codes, signals, help, and escaped text from the wire."""

from __future__ import annotations

import math
import os
import pty
import re
import select
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import paramclient
from paramclient import LinkError, ParamType, errors
from paramclient.cli.app import run
from paramclient.cli.output import ExitCode, code_of
from paramclient.errors import ClientClosed, ParamClientError
from paramclient.links import Peer, SimLink
from paramclient.sim import ArduPilotVehicle, GenericVehicle, PX4Vehicle, SimParam, px4_table
from paramclient.wire import frames, messages
from tests.commands import Command, Outcome, Put, in_process, strict
from tests.shell import Eventful

ROOT = Path(__file__).parents[2]
URL = "sim:custom"
TIMEOUT = 60.0  # seconds after which a test fails; a passing test never waits that long

HASH = "cf579589"
"""Of the simulated PX4 vehicle's table, as the recordings of the real one have it."""


@pytest.fixture
def live_command(capsys: pytest.CaptureFixture[str]) -> Command:
    """Run the command line in this process in real time, for sockets to another process."""
    return in_process(capsys)


@pytest.fixture(scope="session")
def warm_cache(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return a cache file with the table of `sim:px4`."""
    path = tmp_path_factory.mktemp("warm") / "cache.sqlite3"
    assert run(["fetch", "sim:px4", "--cache", str(path)]) == 0
    return path.read_bytes()


@pytest.fixture
def warm(warm_cache: bytes, tmp_path: Path) -> Path:
    """Return a copy of the warm cache for one test."""
    path = tmp_path / "warm.sqlite3"
    path.touch(mode=0o600)
    path.write_bytes(warm_cache)
    return path


# processes

PLAIN = {
    name: value
    for name, value in os.environ.items()
    if name not in {"FORCE_COLOR", "NO_COLOR", "TTY_COMPATIBLE", "COLUMNS", "PYTHONUNBUFFERED"}
}
"""The environment without what changes how programs print."""


@contextmanager
def process(*arguments: object, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Run the command line in a new process, which is killed afterwards."""
    words = [sys.executable, "-m", "paramclient", *map(str, arguments)]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": PLAIN, **options}
    with subprocess.Popen(words, cwd=ROOT, text=True, **options) as started:
        watchdog = threading.Timer(TIMEOUT, started.kill)
        watchdog.start()
        try:
            yield started
        finally:
            watchdog.cancel()
            if started.poll() is None:
                started.kill()


def ended(started: subprocess.Popen[str]) -> Outcome:
    """Wait for the end of a process."""
    out, err = started.communicate(timeout=TIMEOUT)
    return Outcome(started.returncode, out or "", err or "")


def run_process(*arguments: object, **options: Any) -> Outcome:
    with process(*arguments, **options) as started:
        return ended(started)


def line_of(stream: Any) -> str:
    """Return the next line that a process prints."""
    line = str(stream.readline())
    assert line.endswith("\n"), "the process has ended"
    return line


@contextmanager
def simulated(vehicle: str) -> Iterator[str]:
    """Run `sim` in a new process on a port that the system chooses; return its URL."""
    with process("sim", vehicle, "--link", "udpin:127.0.0.1:0") as started:
        found = re.search(r" listens on udpin:127\.0\.0\.1:([0-9]+);", line_of(started.stdout))
        assert found is not None
        assert int(found[1]) > 0
        yield f"udpout:127.0.0.1:{found[1]}"


# fetch


def test_fetch_prints_a_table_and_a_summary(command: Command, warm: Path) -> None:
    fetched = command("fetch", "sim:px4", "--cache", warm)
    assert fetched.code == 0
    header, *rows = fetched.words
    assert header == ["name", "value", "type", "index", "trust"]
    assert len(rows) == 903
    by_name = {row[0]: row[1:] for row in rows}
    assert by_name["MC_ROLL_P"] == ["4.0", "REAL32", "547", "verified"]
    volatile = {row.name for row in px4_table() if row.volatile}
    assert {name for name, row in by_name.items() if row[-1] == "live"} == volatile
    assert re.fullmatch(
        r"903 parameters of 1/1 PX4 quadrotor from cache in [0-9.]+ s, round trip [0-9.]+ ms, "
        r"[0-9,]+ bytes received, [0-9,]+ sent; "
        rf"hash {HASH}\n",
        fetched.err,
    )


def test_missing_parameters_are_named(command: Command, put: Put) -> None:
    url = put(GenericVehicle({"A": 1, "B": 2, "C": 3}, dead=["B"]))
    fetched = command("fetch", url, "--json", "--no-cache", "--timeout", 5)
    found = [fetched.json[each] for each in ("missing", "count", "received")]
    assert (fetched.code, found, [*fetched.json["params"]]) == (1, [[1], 3, 2], ["A", "C"])
    read = command("get", url, "?", "B*", "--no-cache", "--timeout", 5)
    assert (read.code, "a parameter of 1/1 that matches B* in time" in read.err) == (3, True)
    for err in (fetched.err, read.err):
        assert "paramclient: incomplete: 1/1 generic did not send 1 parameter, index 1; " in err


# get


# set


def test_nan_can_be_forced(command: Command) -> None:
    wanted = ("MC_ROLL_P", "nan", "MC_PITCH_P", "-inf")
    refused = command("set", "sim:px4", *wanted, "MC_YAW_P", 3, "--json", "--no-cache")
    assert refused.code == 2
    assert [each["status"] for each in refused.json["results"]] == ["refused", "refused", "accepted"]
    assert "PX4 cannot save NaN and infinity" in refused.json["results"][0]["reason"]
    assert command("set", "sim:px4", *wanted, "--force", "--json", "--no-cache").json["results"] == [
        {"name": "MC_ROLL_P", "requested": "NaN", "actual": "NaN", "status": "accepted"},
        {"name": "MC_PITCH_P", "requested": "-Infinity", "actual": "-Infinity", "status": "accepted"},
    ]


@pytest.mark.parametrize(
    ("name", "text", "held"),
    [
        ("I", "16777217", 16777217),
        ("I", "-16777217", -16777217),
        ("I", "-0x10", -16),
        ("U", "4294967295", 4294967295),
        ("F", "-.5", -0.5),
        ("F", "7", 7.0),
        ("F", "INF", float("inf")),
    ],
)
def test_numbers_are_parsed_exactly(command: Command, put: Put, name: str, text: str, held: float) -> None:
    table = [SimParam("I", ParamType.INT32, 1), SimParam("U", ParamType.UINT32, 1), SimParam("F", 9, 1.0)]
    vehicle = GenericVehicle(table)
    done = command("set", put(vehicle), name, text, "--json", "--no-cache")
    assert (done.code, done.json["results"][0]["status"]) == (0, "accepted")
    assert vehicle.values[name] == held


def test_fetch_names_changes_since_a_table_was_cached(command: Command, put: Put, tmp_path: Path) -> None:
    vehicle = ArduPilotVehicle()
    fetch = ("fetch", put(vehicle), "RTL_ALT", "--cache", tmp_path / "cache.sqlite3")
    assert command(*fetch).code == 0
    vehicle.load({"RTL_ALT": 2000})
    assert "Changed since they were cached: RTL_ALT." in command(*fetch).err
    vehicle.load({"RTL_ALT": 2500})
    found = command(*fetch, "--json").json
    assert (found["source"], found["changed"]) == ("cache", ["RTL_ALT"])
    assert found["params"]["RTL_ALT"]["value"] == 2500


# watch


def test_watch_prints_lines_of_json_as_values_change(live_command: Command, tmp_path: Path) -> None:
    with simulated("px4") as url, process("watch", url, "MC_ROLL_P", "--json", "--no-cache") as watching:
        assert line_of(watching.stderr) == "watching MC_ROLL_P of 1/1 PX4 quadrotor\n"
        done = live_command("set", url, "MC_PITCH_P", 7, "MC_ROLL_P", "nan", "--force", "--no-cache")
        assert done.code == 0
        change = strict(line_of(watching.stdout))
        assert abs(datetime.fromisoformat(change.pop("time")).timestamp() - time.time()) < TIMEOUT
        values = {"system": 1, "component": 1, "old": 4.0, "new": "NaN"}
        assert change == {"name": "MC_ROLL_P", **values, "by": "vehicle", "kind": "changed"}
        watching.send_signal(signal.SIGINT)
        outcome = ended(watching)
    assert (outcome.code, outcome.out, outcome.err) == (130, "", "")


class Restless(PX4Vehicle):
    """A vehicle that is lost after 2 s for 8 s, and returns disarmed with another value of B."""

    reboots_at: float | None = None

    def tick(self, now: float) -> None:
        self.reboots_at = self.reboots_at or now + 1.5
        if now > self.reboots_at:
            self.reboots_at = math.inf
            self.set_param("B", 3)
            self.reboot(now, down=8.0)
        super().tick(now)

    def send(self, message: messages.Message) -> None:
        if isinstance(message, messages.Heartbeat) and self.reboots_at == math.inf:
            message = replace(message, base_mode=0)
        super().send(message)


def test_watch_prints_events_of_the_vehicle(command: Command, put: Put) -> None:
    printed = command("watch", put(Restless(table={"A": 1, "B": 2})), "--no-cache", "--timeout", 20, "--json")
    assert (printed.code, printed.err) == (0, "watching 2 parameters of 1/1 PX4 quadrotor\n")
    lines = [strict(line) for line in printed.out.splitlines()]
    for each in lines:
        datetime.fromisoformat(each.pop("time"))
    where = {"system": 1, "component": 1}
    crc = lines[-1]["hash"]
    assert re.fullmatch("[0-9a-f]{8}", crc)
    assert lines == [
        {"event": "lost", **where, "silence_s": pytest.approx(5.0, abs=0.1)},
        {"event": "found", **where, "silence_s": pytest.approx(9.0, abs=1.5)},
        {"event": "rebooted", **where},
        {**where, "name": "B", "old": 2, "new": 3, "by": "vehicle", "kind": "changed"},
        {"event": "resynced", **where, "changed": ["B"], "hash": crc},
    ]


def test_watch_does_not_count_the_parameters_of_a_log_before_it_is_read(command: Command) -> None:
    watched = command("watch", f"replay:{ROOT}/tests/data/px4_20_sets.tlog?speed=0", "--no-cache")
    assert (watched.code, watched.err) == (0, "watching all parameters of 1/1 PX4 quadrotor\n")


def test_a_name_that_a_log_does_not_have_is_named(command: Command) -> None:
    fetched = command("fetch", f"replay:{ROOT}/tests/data/px4_full_download.tlog", "MC_ROLL_PP", "--no-cache")
    assert fetched.code == 2
    assert fetched.err.endswith("1/1 has no parameter that matches MC_ROLL_PP; did you mean MC_ROLL_P?\n")


def test_a_link_that_fails_during_watch_is_reported_once(command: Command, put: Put) -> None:
    def fail() -> None:
        raise LinkError("it is gone", link=URL)

    watched = command("watch", put(Eventful(PX4Vehicle(table={"A": 1}), (9.0, fail))), "A", "--no-cache")
    assert (watched.code, watched.out) == (4, "")
    assert watched.err == "watching A of 1/1 PX4 quadrotor\nparamclient: it is gone\n"


# link


class Modem(PX4Vehicle):
    """A vehicle with a telemetry radio, and with a message that is in no dialect."""

    def data_to_send(self) -> list[bytes]:
        if sent := super().data_to_send():
            status = b"\x03\x00\x02\x00\xc8\xbe\x60\x28\x2a"
            sent.append(frames.build_frame(109, status, system=51, component=68, sequence=0))
            sent.append(b"\xfd\x01\x00\x00\x00\x33\x44\xff\xff\x7f" + b"abc")
        return sent


def test_link_prints_a_table_of_components(command: Command, put: Put) -> None:
    ended = Eventful(Modem(telemetry=20), (2.0, lambda: signal.raise_signal(signal.SIGINT)))
    received = command("link", put(ended))
    assert (received.code, "so far: 1/1 PX4 quadrotor.\n" in received.err) == (130, True)
    lines = received.out.splitlines()
    assert re.fullmatch(r"1/1 +PX4 quadrotor +2 +[0-9.]+ +[0-9,]+ +0\.0% +[0-9.]+ ms +[0-9.]+ s", lines[1])
    assert re.match(r"51/68 +radio +2 +[0-9.]+ ", lines[2])
    assert re.match(r"1/1 standby: ATTITUDE [0-9.]+/s, HEARTBEAT [0-9.]+/s, ", lines[4])
    assert re.match(r"51/68: RADIO_STATUS [0-9.]+/s, UNKNOWN_8388607 [0-9.]+/s$", lines[5])
    assert lines[6].startswith("  errors 3, fixed 2, rssi 200, remote_rssi 190, free 96, noise 40, ")
    assert re.search(r"[\d,]+ frames, 0 lost, 0 with a wrong checksum, [1-9]\d* of unknown ids", lines[-1])


def test_link_is_live_on_a_terminal() -> None:
    shown = on_terminal("link", "sim:px4", "--seconds", 1.5, COLUMNS="80")
    assert shown.code == 0
    assert shown.out.count("round trip") >= 3
    *_, last = shown.out.split("heartbeat")
    assert "PX4 quadrotor" in last  # the last table stays
    assert "1/1 standby: " in last


# Exit codes and signals


@pytest.mark.parametrize(
    ("words", "awaited"),
    [
        ("fetch --timeout 0.1 --no-cache --json", "an autopilot"),
        ("link --seconds 0.1 --json", "a MAVLink frame"),
    ],
)
def test_a_silent_link_is_exit_code_3(live_command: Command, words: str, awaited: str) -> None:
    name, *options = words.split()
    outcome = live_command(name, "udpin:127.0.0.1:0", *options)
    assert (outcome.code, outcome.out) == (3, "")
    assert outcome.err.startswith(f"paramclient: no reply: {awaited} ")
    hint = " s. Nothing was received on udpin:127.0.0.1:0. Is the vehicle sending to this port?\n"
    assert outcome.err.endswith(hint)


def test_a_failed_link_is_exit_code_4(live_command: Command, put: Put) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        outcome = live_command("fetch", f"tcp:127.0.0.1:{taken.getsockname()[1]}", "--no-cache")
    assert (outcome.code, outcome.out) == (4, "")
    assert "connection refused" in outcome.err
    assert outcome.err.count("\n") == 1

    class Dropping(SimLink):
        async def receive(self) -> list[tuple[Peer, bytes]]:
            data = await super().receive()
            if self.endpoint.requests["PARAM_SET"]:  # type: ignore[attr-defined]  # a vehicle's
                raise LinkError(f"{self.name}: gone", link=self.name)
            return data

    url = put(Dropping(GenericVehicle({"A": 1, "B_ENABLE": 1})))
    done = live_command("set", url, "A", 2, "B_ENABLE", 3, "--json", "--no-cache")
    assert done.code == 4
    found = [(each["status"], each["error"]) for each in done.json["results"]]
    assert found == [("unknown", "LinkError"), ("not tried", "LinkError")]


def test_a_failed_cache_is_code_5_and_a_warning_for_fetch(command: Command, put: Put, tmp_path: Path) -> None:
    for arguments in (["show"], ["show", "--json"], ["cache", "list"], ["history", "1"]):
        outcome = command(*arguments, "--cache", tmp_path)
        assert (outcome.code, outcome.out) == (5, "")
        assert outcome.err.startswith(f"paramclient: the cache {tmp_path} ")
        assert outcome.err.count("\n") == 1
    fetched = command("fetch", put(GenericVehicle({"A": 1})), "--json", "--cache", tmp_path)
    assert (fetched.code, fetched.json["received"]) == (0, 1)
    assert fetched.err.startswith("paramclient: warning: continuing without the cache: ")
    for words in (["restore", "sim:px4"], ["reset", "sim:px4", "MC_*"]):
        refused = command(*words, "--cache", tmp_path)
        assert (refused.code, refused.err.count("\n"), "nothing was sent: " in refused.err) == (5, 1, True)


def test_every_error_has_an_exit_code() -> None:
    for kind in (getattr(errors, name) for name in errors.__all__):
        if issubclass(kind, ParamClientError) and kind is not ParamClientError:
            assert code_of(kind.__new__(kind)) > ExitCode.DONE
    assert code_of(ClientClosed("", link="")) == ExitCode.LINK


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_fetch_that_is_interrupted_ends_cleanly(number: int, code: int, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(TIMEOUT)
        url = f"udpout:127.0.0.1:{listener.getsockname()[1]}"
        with process("fetch", url, "--cache", tmp_path / "cache.sqlite3") as fetching:
            listener.recv(100)  # the client has sent a request
            fetching.send_signal(number)
            hint = f"Nothing was received on {url}. Is the address right, and does the vehicle listen there?"
            expected = f"interrupted while waiting for an autopilot on {url}. {hint}\n"
            assert ended(fetching) == Outcome(code, "", expected)


@pytest.mark.parametrize("kept", [True, False])
def test_ctrl_c_in_a_fetch_says_what_is_kept(command: Command, put: Put, tmp_path: Path, kept: bool) -> None:
    cache = ["--cache", tmp_path / "cache"] if kept else ["--no-cache"]
    vehicle = Eventful(PX4Vehicle(burst=1, period=0.2), (30.0, lambda: signal.raise_signal(signal.SIGINT)))
    done = command("fetch", put(vehicle), *cache)
    assert (done.code, done.out) == (130, "")
    where = "kept in the cache" if kept else "not kept, without a cache"
    said = rf"interrupted: ([0-9]+) of 903 parameters of 1/1 PX4 quadrotor received and {where}\n"
    assert (found := re.fullmatch(said, done.err))
    if kept:
        assert command("cache", "list", *cache, "--json").json["components"][0]["size"] == int(found[1]) > 0


def test_a_second_signal_does_not_wait(live_command: Command, warm: Path) -> None:
    with simulated("px4") as url, process("watch", url, "MC_ROLL_P", "--cache", warm) as watching:
        line_of(watching.stderr)
        with sqlite3.connect(warm) as other:
            other.execute("BEGIN IMMEDIATE")  # the client cannot write the change, so that its end waits
            assert live_command("set", url, "MC_ROLL_P", 6, "--no-cache").code == 0
            line_of(watching.stdout)
            deadline = time.monotonic() + TIMEOUT
            while watching.poll() is None and time.monotonic() < deadline:
                watching.send_signal(signal.SIGINT)
                time.sleep(0.05)
        other.close()
        assert ended(watching) == Outcome(-signal.SIGINT, "", "")


def test_a_closed_pipe_ends_the_command_silently(warm: Path) -> None:
    kept = ("--cache", warm)
    for words, code in (
        (["fetch", "sim:px4", *kept], 141),
        (["show", "--json", *kept], 141),
        (["-h"], 0),
        ([], 0),
    ):
        reading, writing = os.pipe()
        os.close(reading)
        try:
            outcome = run_process(*words, stdout=writing)
        finally:
            os.close(writing)
        assert (outcome.code, outcome.err) == (code, "")


@pytest.mark.parametrize("closed", range(3))
def test_a_command_runs_without_a_standard_stream(closed: int) -> None:
    words = ("reset", "sim:ardupilot", "RELAY1_FUNCTION", "--no-cache")
    done = run_process(*words, preexec_fn=partial(os.close, closed))
    shown = ("accepted" in done.out, "writing to 1/1" in done.err)
    assert (done.code, *shown) == (0, closed != 1, closed != 2), done.err


def test_a_full_disk_is_reported(warm: Path) -> None:
    with Path("/dev/full").open("w") as full:
        outcome = run_process("show", "--json", "--cache", warm, stdout=full)
    assert outcome.code == 1
    assert outcome.err == "paramclient: cannot write the output: No space left on device\n"


# Extras and lazy loading


def test_without_the_extra_the_message_names_it() -> None:
    program = """if True:
        import sys
        sys.modules["cyclopts"] = sys.modules["rich"] = None
        sys.argv = ["paramclient", "fetch", "sim:px4"]
        from paramclient.__main__ import main
        main()
    """
    outcome = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT
    )
    needs = "paramclient: the command needs cyclopts and rich: pip install 'paramclient[cli]'\n"
    assert (outcome.returncode, outcome.stdout, outcome.stderr) == (2, "", needs)


def test_rich_and_the_simulators_load_only_if_needed() -> None:
    program = "import sys, paramclient.cli; sys.exit(not {'rich', 'paramclient.sim'}.isdisjoint(sys.modules))"
    assert subprocess.run([sys.executable, "-c", program], cwd=ROOT, timeout=TIMEOUT).returncode == 0


def test_the_help_of_fetch_fits_on_a_screen_with_the_connection_last() -> None:
    lines = run_process("fetch", "--help", env={**PLAIN, "COLUMNS": "80"}).out.splitlines()
    assert len(lines) <= 50
    groups = [line.split()[1] for line in lines if line.startswith("╭")]
    assert groups == ["Arguments", "Parameters", "Connection"]


def test_help_wraps_at_the_terminal_and_has_no_examples_of_other_subcommands() -> None:
    narrow = {**PLAIN, "COLUMNS": "80"}
    assert "\nparameter also text, or bytes as hex:00FF. " in run_process("set", "--help", env=narrow).out
    for words in (["cache"], ["metadata", "list", "--help"]):
        assert "Examples:" not in run_process(*words, env=narrow).out


def test_the_module_runs_the_command_line() -> None:
    assert run_process("--version") == Outcome(0, f"paramclient {paramclient.__version__}\n", "")


@pytest.mark.parametrize("arguments", [[], ["fetch"], ["cache", "remove"]], ids=" ".join)
def test_help_has_examples(live_command: Command, arguments: Sequence[str]) -> None:
    helped = live_command(*arguments, "--help")
    assert (helped.code, helped.err) == (0, "")
    assert helped.out.startswith(f"Usage: {' '.join(['paramclient', *arguments])} ")
    assert f"Examples:\n  {' '.join(['paramclient', *arguments])}" in helped.out
    assert "\x1b" not in helped.out
    if not arguments:
        assert "Exit codes: 0 done;" in helped.out
        assert live_command().out == helped.out


# Output


class Hostile(GenericVehicle):
    """A vehicle whose names contain escape sequences of terminals."""

    NAMES = ("\x1b[2J\x1b]0;own\x07", "[red]B[/red]", "\x9b31mC\r\n", "D\u00e9\x7f:boom:")

    def send(self, message: messages.Message) -> None:
        if isinstance(message, messages.ParamValue):
            message = message._replace(param_id=self.NAMES["ABCD".index(message.param_id)])
        super().send(message)


def test_text_from_the_wire_is_escaped(command: Command, put: Put, tmp_path: Path) -> None:
    cache = tmp_path / "cache.sqlite3"
    url = put(Hostile(dict.fromkeys("ABCD", 1)))
    for outcome in (fetched := command("fetch", url, "--cache", cache), command("show", "--cache", cache)):
        assert [row[0] for row in outcome.words[1:]] == ["[red]B[/red]"]  # all other names are unusable
        assert (outcome.out + outcome.err).replace("\n", "").isprintable()
        assert (outcome.out + outcome.err).isascii()
    assert fetched.code == 0
    assert "not every parameter file can hold such names" in fetched.err
    fetched = command("fetch", url, "--json", "--cache", cache)
    assert list(fetched.json["params"]) == ["[red]B[/red]"]
    assert fetched.out.replace("\n", "").isprintable()
    assert fetched.out.isascii()


def on_terminal(*arguments: object, **environment: str) -> Outcome:
    """Run the command line with stdout and stderr on one terminal."""
    (ours, theirs), printed = pty.openpty(), b""
    try:
        env = {**PLAIN, "TERM": "xterm", **environment}
        with process(*arguments, stdout=theirs, stderr=theirs, env=env) as started:
            os.close(theirs)
            # the terminal ends when the last process closes it
            while select.select([ours], [], [], TIMEOUT)[0]:
                try:
                    printed += os.read(ours, 65536)
                except OSError:
                    break
            return Outcome(started.wait(TIMEOUT), printed.decode(), "")
    finally:
        os.close(ours)


def test_a_rate_is_that_of_a_while(command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    shown = command("fetch", "sim:px4?rate=10000", "--no-cache").err
    rates = [*map(int, re.findall(r"/903 ([0-9]+)/s", shown))]
    assert len(rates) > 5
    assert max(rates) < 400  # a parameter takes 37 bytes
    file = tmp_path / "quad.parm"
    file.write_text("MC_ROLL_P 6\nMC_YAW_P 2\n")
    shown = command("apply", "sim:px4?rate=10000", file, "--dry-run", "--no-cache").err
    assert "\x1b[Kreading 1/1 PX4 quadrotor (" in shown
    shown = command("apply", "sim:px4?rate=10000", file, "--yes", "--no-cache").err
    assert "\x1b[Ksetting 1/1 PX4 quadrotor 2/2\r" in shown, "without the rate of two at once"


def test_progress_is_drawn_on_a_terminal(tmp_path: Path) -> None:
    shown = on_terminal("fetch", "sim:px4?rate=20000", "--no-cache")
    assert shown.code == 0
    assert re.search(r"fetching 1/1 PX4 quadrotor .*[0-9]+/903 [0-9]+/s, [0-9]+ s left", shown.out)
    assert "\x1b[1m" in shown.out  # the heading of the table
    assert "\r\x1b[K\x1b[1mname" in shown.out  # the line is erased before the table

    plain = on_terminal("fetch", "sim:px4", "--no-cache", NO_COLOR="1")
    assert re.search(r"[0-9]+/903", plain.out)
    assert not re.search(r"\x1b\[(3|9)[0-9]m", plain.out)


# sim


def test_sim_serves_other_processes_through_a_faulty_link(live_command: Command) -> None:
    faults = "loss=0.05&delay=0.01&jitter=0.005&bit_errors=0.00001&duplicate=0.01&seed=1"
    with simulated(f"px4?system=42&{faults}") as url:
        fetched = live_command("fetch", url, "--json", "--no-cache")
    assert fetched.code == 0
    assert (fetched.json["system"], fetched.json["received"], fetched.json["missing"]) == (42, 903, [])
    with simulated("camera?loss=0.05&seed=1") as url:
        camera = ("--vehicle", "1/100", "--extended", "--no-cache")
        assert live_command("set", url, *camera, "CAM_CLOCK", 2**62 + 1).code == 0
    with simulated("px4?loss=1") as url:
        assert live_command("get", url, "MC_ROLL_P", "--timeout", 1, "--no-cache").code == 3
