"""Signing as users have it: keys, clients, commands, and what never shows."""

from __future__ import annotations

import base64
import logging
import os
import pty
import re
import select
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest import mock

import anyio
import pytest

import paramclient
from paramclient import NoReply, ParamClient, Signing, SigningKey, SigningPolicy, UsageError, read_key
from paramclient.cli import run
from paramclient.cli import session as cli_session
from paramclient.cli import signing as signing_commands
from paramclient.client import signing
from paramclient.client.signing import key_from_environment
from paramclient.links import SimLink
from paramclient.sim import ArduPilotVehicle, Vehicle
from paramclient.wire import frames, messages
from paramclient.wire.signing import UNITS_PER_SECOND, Refusal
from tests.shell import VALUES, in_simulated_time, simulated_time_loop, small_px4

SECRET = bytes(range(101, 133))
KEY = SigningKey(SECRET)
OTHER_KEY = SigningKey(bytes(range(1, 33)))
NOW = 36_000_000_000_000
TIMEOUT = 60.0

FORMS = [SECRET, SECRET.hex().encode(), SECRET.hex().upper().encode(), base64.b64encode(SECRET)]
FORMS += [repr(SECRET)[2:-1].encode(), ", ".join(map(str, SECRET[:8])).encode()]
"""How the key could show."""


@pytest.fixture(autouse=True)
def no_key(monkeypatch: pytest.MonkeyPatch) -> None:
    """An environment without a key."""
    for name in ("KEY", "KEY_FILE", "PASSPHRASE"):
        monkeypatch.delenv(f"PARAMCLIENT_SIGNING_{name}", raising=False)


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    return a_file(tmp_path / "vehicle.key", SECRET.hex().encode() + b"\n")


def a_file(path: Path, data: bytes, mode: int = 0o600) -> Path:
    path.write_bytes(data)
    path.chmod(mode)
    return path


def a_client(link: Any, **options: Any) -> ParamClient:
    given: dict[str, Any] = {"cache": False, "signing": KEY} | options
    return ParamClient(link, **given)


def signed_vehicle(**options: Any) -> Vehicle:
    return small_px4(**{"signing_key": KEY} | options)


# Keys


@pytest.mark.parametrize(
    "data",
    [SECRET, SECRET.hex().encode(), b"\n " + SECRET.hex().upper().encode() + b"\r\n", FORMS[3] + b"\n"],
)
def test_a_file_holds_a_key_as_it_is_or_as_text(tmp_path: Path, data: bytes) -> None:
    assert read_key(a_file(tmp_path / "key", data)) == KEY


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o620, 0o601])
def test_a_key_that_others_can_get_at_is_refused(tmp_path: Path, mode: int) -> None:
    path = a_file(tmp_path / "key", SECRET, mode)
    with pytest.raises(
        UsageError, match=rf"key: other users than its owner .* \(mode {mode:o}\); run `chmod 600`"
    ):
        read_key(path)


@pytest.mark.parametrize(
    "data", [b"", b"hunter2-hunter2", SECRET[:31], SECRET + b"\n", b"\xff" * 44, bytes(32), b"ab" * 600]
)
def test_a_file_without_a_key_is_named_and_not_quoted(tmp_path: Path, data: bytes) -> None:
    path = a_file(tmp_path / "no.key", data)
    with pytest.raises(UsageError) as caught:
        read_key(path)
    assert str(caught.value).startswith(f"{path}: a signing key ")
    shown = "".join(traceback.format_exception(caught.value))
    assert not data or data.decode("latin-1") not in shown
    assert caught.value.__cause__ is None
    assert caught.value.__suppress_context__


def test_the_environment_names_a_key_in_one_of_three_ways(key_file: Path) -> None:
    assert key_from_environment({}) is None
    assert key_from_environment({"PARAMCLIENT_SIGNING_KEY": ""}) is None
    assert key_from_environment({"PARAMCLIENT_SIGNING_KEY": SECRET.hex()}) == KEY
    assert key_from_environment({"PARAMCLIENT_SIGNING_KEY": FORMS[3].decode()}) == KEY
    assert key_from_environment({"PARAMCLIENT_SIGNING_KEY_FILE": str(key_file)}) == KEY
    by_words = key_from_environment({"PARAMCLIENT_SIGNING_PASSPHRASE": "my words"})
    assert by_words == SigningKey.from_passphrase("my words")
    both = {"PARAMCLIENT_SIGNING_KEY": SECRET.hex(), "PARAMCLIENT_SIGNING_PASSPHRASE": "my words"}
    with pytest.raises(UsageError, match="KEY and PARAMCLIENT_SIGNING_PASSPHRASE"):
        key_from_environment(both)
    with pytest.raises(UsageError, match=r"^PARAMCLIENT_SIGNING_KEY: a signing key in text") as caught:
        key_from_environment({"PARAMCLIENT_SIGNING_KEY": "hunter2-hunter2"})
    assert "hunter2" not in str(caught.value)


def test_invalid_signing_settings_are_refused_at_once() -> None:
    assert Signing(KEY, "signed-only").policy == SigningPolicy.SIGNED_ONLY
    with pytest.raises(
        UsageError, match="unknown signing policy 'none'; choose one of signed-only, unsigned-radios, accept"
    ):
        Signing(KEY, "none")
    for link_id in (-1, 256):
        with pytest.raises(UsageError, match=f"0 to 255, not {link_id}"):
            Signing(KEY, link_id=link_id)


# Timestamps


@in_simulated_time
async def test_a_client_whose_clock_was_set_back_adopts_the_timestamp_of_the_vehicle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vehicle = signed_vehicle(signing_timestamp=NOW)
    for now in (NOW, NOW - 50 * UNITS_PER_SECOND):
        monkeypatch.setattr(signing, "timestamp_now", lambda now=now: now)
        async with a_client(vehicle) as client:
            component = await client.component()
            assert (await component.get("PARAM_04", timeout=2.0)).name == "PARAM_04"


# Clients


@in_simulated_time
async def test_a_signed_client() -> None:
    vehicle = signed_vehicle()
    async with (
        a_client(vehicle) as client,
        a_client(signed_vehicle(), signing=Signing(KEY, link_id=1)) as other,
    ):
        component = await client.component()
        assert dict((await component.fetch_all()).params).keys() == vehicle.params.keys()
        assert (await component.set("PARAM_04", 44)).actual == 44
        assert vehicle.param("PARAM_04").value == 44
        report = client.signing_report()
        assert report is not None
        assert (report.fingerprint, report.policy) == (KEY.fingerprint, "unsigned-radios")
        assert report.signed > 10
        assert [(each.system, each.component, each.link_id) for each in report.streams] == [(1, 1, 0)]
        beside = other.signing_report()
        assert beside is not None
        assert (report.link_id, beside.link_id) == (0, 1)
    async with ParamClient(small_px4(), cache=False) as unsigned:
        assert unsigned.signing_report() is None


@in_simulated_time
async def test_no_reply_says_that_frames_were_refused() -> None:
    async with a_client(signed_vehicle(), signing=OTHER_KEY) as client:
        with pytest.raises(NoReply, match=r"an autopilot \(frames were refused, [0-9]+ for: bad signature\)"):
            await client.component(timeout=3.0)
    async with a_client(small_px4()) as client:
        with pytest.raises(NoReply, match=r"system id 1 \(frames were refused, [0-9]+ for: unsigned\) in"):
            await client.component(1, timeout=3.0)
        report = client.signing_report()
        assert report is not None
        assert report.refused.keys() == {Refusal.UNSIGNED}


@in_simulated_time
async def test_a_key_is_sent_only_if_the_caller_says_that_the_link_is_safe() -> None:
    vehicle = ArduPilotVehicle(table=VALUES)
    async with a_client(vehicle, signing=None) as client:
        component = await client.component()
        with pytest.raises(UsageError, match="sends the key unencrypted"):
            await component.setup_signing(KEY)
        assert vehicle.requests["SETUP_SIGNING"] == 0
        await component.setup_signing(KEY, link_is_safe=True)
    assert vehicle.signing_key == KEY
    async with a_client(vehicle) as client:
        component = await client.component()
        assert (await component.fetch_all()).complete
        await component.setup_signing(None, link_is_safe=True)
    assert vehicle.signing_key is None


@in_simulated_time
async def test_a_vehicle_of_mavlink_1_is_given_no_key() -> None:
    vehicle = small_px4(mavlink_version=1)
    async with a_client(vehicle, signing=None) as client:
        with pytest.raises(UsageError, match="1/1 uses MAVLink 1"):
            await (await client.component()).setup_signing(KEY, link_is_safe=True)


@in_simulated_time
async def test_accept_all_answers_a_mavlink_1_vehicle_unsigned() -> None:
    vehicle = small_px4(mavlink_version=1)
    async with a_client(vehicle, signing=Signing(KEY, SigningPolicy.ACCEPT_ALL)) as client:
        component = await client.component()
        assert (await component.fetch_all()).complete
        report = client.signing_report()
        assert report is not None
        assert (report.signed, report.unsigned > 20) == (0, True)


# What never shows


def test_the_key_shows_nowhere(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """A life with everything in it; then all that was written is looked through."""
    caplog.set_level(logging.DEBUG)
    shown: list[str] = []
    cache = tmp_path / "cache.sqlite3"

    @in_simulated_time
    async def live() -> None:
        vehicle = small_px4()
        async with a_client(vehicle, signing=None, cache=cache) as client:
            component = await client.component()
            await component.setup_signing(KEY, link_is_safe=True)
        settings = Signing(KEY)
        async with a_client(vehicle, signing=settings, cache=cache) as client:
            component = await client.component()
            await component.fetch_all()
            await component.set("PARAM_04", 3)
            for each in (client, client.signing_report(), component, settings, vehicle.signing_report):
                shown.extend([repr(each), str(each)])
            shown.append(repr({name: repr(value) for name, value in vars(client).items()}))
            for call in (
                component.setup_signing(OTHER_KEY),
                component.get("NO_SUCH_NAME", timeout=1.0),
                component.set("NO_SUCH_NAME", 1, timeout=1.0),
            ):
                with pytest.raises(paramclient.ParamClientError) as caught:
                    await call
                shown.extend([repr(caught.value), *traceback.format_exception(caught.value)])
            try:
                raise RuntimeError
            except RuntimeError as error:
                reported = traceback.TracebackException.from_exception(error, capture_locals=True)
                shown.extend(reported.format())

    live()
    printed = capsys.readouterr()
    written = [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    assert written
    assert any(KEY.fingerprint in text for text in shown)
    everything = [*shown, caplog.text, printed.out, printed.err]
    for data in [*written, *(text.encode("utf-8", "surrogateescape") for text in everything)]:
        assert not any(form in data for form in FORMS)


# The command


@pytest.fixture
def put(monkeypatch: pytest.MonkeyPatch) -> Callable[[Vehicle], str]:
    """Puts a vehicle behind every link that a command opens; gives a link's name."""

    def place(vehicle: Vehicle) -> str:
        link = SimLink(vehicle)

        def client(_: object, **options: Any) -> ParamClient:
            return ParamClient(link, **options)

        monkeypatch.setattr(cli_session, "ParamClient", client)
        monkeypatch.setattr(signing_commands, "create_link", lambda _: link)
        return "sim:custom"

    return place


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs commands in this process, one after the other, in one simulated time."""
    now = 1000.0

    def run_in_simulated_time(work: Callable[..., Any], *given: Any) -> Any:
        async def go_on() -> Any:
            nonlocal now
            simulated_time_loop().now = now
            try:
                return await work(*given)
            finally:
                now = simulated_time_loop().now

        return in_simulated_time(go_on)()

    def call(*arguments: object) -> tuple[int, str, str]:
        with mock.patch.object(anyio, "run", run_in_simulated_time):
            code = run([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return call


Command = Callable[..., tuple[int, str, str]]


def test_commands_sign_with_the_key_of_a_file_or_the_environment(
    put: Callable[[Vehicle], str],
    key_file: Path,
    command: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    url = put(signed_vehicle())
    get = ("get", url, "PARAM_04", "--json", "--no-cache")
    code, out, err = command(*get, "--signing-key", key_file)
    assert (code, err) == (0, "")
    assert '"PARAM_04"' in out
    monkeypatch.setenv("PARAMCLIENT_SIGNING_KEY_FILE", str(key_file))
    assert command(*get)[0] == 0
    monkeypatch.delenv("PARAMCLIENT_SIGNING_KEY_FILE")
    assert command(*get, "--timeout", 1)[0] == 3
    key_file.chmod(0o644)
    code, out, err = command(*get, "--signing-key", key_file)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert "other users than its owner" in err


def test_link_reports_signatures(put: Callable[[Vehicle], str], key_file: Path, command: Command) -> None:
    url = put(signed_vehicle(signing_timestamp=signing.timestamp_now()))
    code, out, _ = command("link", url, "--seconds", 0.3, "--signing-key", key_file)
    assert code == 0
    assert re.search(rf"key {KEY.fingerprint}: [1-9][0-9]* frames proven", out)
    code, out, _ = command("link", put(small_px4()), "--seconds", 0.3, "--signing-key", key_file)
    assert code == 0
    assert re.search(r": 0 frames proven, [1-9][0-9]* refused: unsigned\n", out)


def test_setup_and_disable_with_their_proof(
    put: Callable[[Vehicle], str], key_file: Path, command: Command
) -> None:
    vehicle = small_px4()
    url = put(vehicle)
    keyed = ("--signing-key", key_file)
    code, out, err = command("signing", "setup", url, *keyed, "--link-is-safe")
    assert (code, out, err) == (0, f"1/1 px4 signs with the key {KEY.fingerprint} now\n", "")
    assert vehicle.signing_key == KEY
    code, out, err = command("signing", "disable", url, "--link-is-safe", "--timeout", 2)
    assert (code, out) == (1, "")
    assert "does not answer unsigned requests" in err
    assert vehicle.signing_key == KEY
    code, out, err = command("signing", "disable", url, *keyed, "--link-is-safe", "--json")
    assert (code, err) == (0, "")
    assert out == ('{"system": 1, "component": 1, "autopilot": "px4", "signs": false, "fingerprint": null}\n')
    assert vehicle.signing_key is None


def test_a_key_is_changed_with_the_one_before(
    put: Callable[[Vehicle], str], key_file: Path, tmp_path: Path, command: Command
) -> None:
    vehicle = signed_vehicle()
    setup = ("signing", "setup", put(vehicle), "--link-is-safe", "--timeout", 4, "--signing-key")
    fresh = a_file(tmp_path / "fresh.key", base64.b64encode(OTHER_KEY.secret))
    code, _, err = command(*setup, fresh)
    assert (code, "1/1 does not answer requests signed with the key" in err) == (1, True)
    code, out, err = command(*setup, fresh, "--present-key", key_file)
    assert (code, err) == (0, "")
    assert OTHER_KEY.fingerprint in out
    assert vehicle.signing_key == OTHER_KEY


def ignore_keys(monkeypatch: pytest.MonkeyPatch, vehicle: Vehicle) -> None:
    """Let a vehicle ignore SETUP_SIGNING."""
    respond = vehicle.respond

    def ignore(message: messages.Message, sender: frames.Frame) -> None:
        if not isinstance(message, messages.SetupSigning):
            respond(message, sender)

    monkeypatch.setattr(vehicle, "respond", ignore)


def test_a_vehicle_that_does_not_obey_is_found_out(
    put: Callable[[Vehicle], str],
    key_file: Path,
    command: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Firmware without signing, and one that takes no orders over this link."""
    deaf = small_px4()
    ignore_keys(monkeypatch, deaf)
    code, out, err = command("signing", "setup", put(deaf), "--signing-key", key_file, "--link-is-safe")
    assert (code, out) == (1, "")
    assert "1/1 answers, but does not sign with the key" in err
    stubborn = signed_vehicle(usb=True)
    ignore_keys(monkeypatch, stubborn)
    code, out, err = command("signing", "disable", put(stubborn), "--link-is-safe")
    assert (code, out) == (1, "")
    assert "1/1 still signs" in err


def test_nothing_is_sent_before_the_link_is_said_to_be_safe(
    put: Callable[[Vehicle], str], key_file: Path, command: Command
) -> None:
    vehicle = small_px4()
    url = put(vehicle)
    for arguments in (("setup", url, "--signing-key", key_file), ("disable", url)):
        code, out, err = command("signing", *arguments)
        assert (code, out) == (2, "")
        assert "add --link-is-safe" in err
    code, _, err = command("signing", "setup", url, "--link-is-safe")
    assert (code, "no key is given" in err) == (2, True)
    assert vehicle.requests == {}


class Terminal:
    """The command at a terminal with keyboard input."""

    def __init__(self, *arguments: object, **environment: str) -> None:
        self.ours, theirs = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "paramclient", *map(str, arguments)],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            env={**os.environ, "TERM": "dumb", **environment},
            cwd=Path(__file__).parents[2],
            # tests started in the background may inherit an ignored SIGINT
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        os.close(theirs)
        self.seen = b""

    def until(self, text: bytes) -> None:
        while text not in self.seen:
            assert select.select([self.ours], [], [], TIMEOUT)[0], self.seen
            try:
                self.seen += os.read(self.ours, 65536)
            except OSError:
                break
        assert text in self.seen, self.seen

    def type(self, text: bytes) -> None:
        os.write(self.ours, text)

    def interrupt(self) -> None:
        """Ctrl-C until it is heeded: one between the prompt and the reading has to wait for a key."""
        for _ in range(int(TIMEOUT)):
            self.process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(1.0)
                return

    def close(self) -> int:
        try:
            while select.select([self.ours], [], [], TIMEOUT)[0]:
                self.seen += os.read(self.ours, 65536)
        except OSError:
            pass
        try:
            return self.process.wait(TIMEOUT)
        finally:
            self.process.kill()
            os.close(self.ours)


@pytest.fixture
def terminal() -> Iterator[Callable[..., Terminal]]:
    opened: list[Terminal] = []

    def open_one(*arguments: object, **environment: str) -> Terminal:
        opened.append(Terminal(*arguments, **environment))
        return opened[-1]

    yield open_one
    for each in opened:
        if each.process.poll() is None:
            each.process.kill()
            each.process.wait()


def test_a_signing_set_up_that_is_not_confirmed_sends_nothing(terminal: Callable[..., Terminal]) -> None:
    refused = terminal("signing", "setup", "sim:px4", PARAMCLIENT_SIGNING_KEY=SECRET.hex())
    refused.until(b"[y/N] ")
    refused.type(b"\n")
    assert refused.close() == 2
    assert b"nothing was sent" in refused.seen
    ended = terminal("signing", "setup", "sim:px4", PARAMCLIENT_SIGNING_PASSPHRASE="Schlüssel ✈")
    ended.until(b"sim:px4 in clear text. Can no other person or program listen or send on this link? [y/N] ")
    ended.interrupt()
    assert ended.close() == 130
    done = terminal("signing", "setup", "sim:ardupilot", PARAMCLIENT_SIGNING_PASSPHRASE="Schlüssel ✈")
    done.until(b"[y/N] ")
    done.type(b"yes\n")
    done.until(b"now")
    assert done.close() == 0
    key = SigningKey.from_passphrase("Schlüssel ✈")
    assert f"1/1 ardupilot signs with the key {key.fingerprint} now".encode() in done.seen
