"""Signing on the command line: keys of a file or the environment, and the key of a vehicle."""

from __future__ import annotations

import base64
import os
import pty
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from paramclient import SigningKey
from paramclient.client.signing import timestamp_now
from paramclient.sim import ArduPilotVehicle, PX4Vehicle
from paramclient.wire import frames, messages
from tests.commands import Command, Put
from tests.shell import VALUES, small_px4

URL = "sim:custom"
KEY = SigningKey(bytes(range(101, 133)))
OTHER_KEY = SigningKey(bytes(range(1, 33)))


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    return a_key_file(tmp_path / "vehicle.key", KEY.secret.hex().encode() + b"\n")


def a_key_file(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    path.chmod(0o600)
    return path


def test_commands_sign_with_the_key_of_a_file_or_the_environment(
    put: Put, key_file: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    get = ("get", put(small_px4(signing_key=KEY)), "PARAM_04", "--json", "--no-cache")
    read = command(*get, "--signing-key", key_file)
    assert (read.code, read.err) == (0, "")
    assert '"PARAM_04"' in read.out
    monkeypatch.setenv("PARAMCLIENT_SIGNING_KEY_FILE", str(key_file))
    assert command(*get).code == 0
    monkeypatch.delenv("PARAMCLIENT_SIGNING_KEY_FILE")
    assert command(*get, "--timeout", 1).code == 3
    key_file.chmod(0o644)
    refused = command(*get, "--signing-key", key_file)
    assert (refused.code, refused.out, refused.err.count("\n")) == (2, "", 1)
    assert "other users than its owner" in refused.err


def test_link_reports_signatures(put: Put, key_file: Path, command: Command) -> None:
    signed = small_px4(signing_key=KEY, signing_timestamp=timestamp_now())
    shown = command("link", put(signed), "--seconds", 0.3, "--signing-key", key_file)
    assert re.search(rf"key {KEY.fingerprint}: [1-9]\d* frames proven", shown.out)
    shown = command("link", put(small_px4()), "--seconds", 0.3, "--signing-key", key_file)
    assert re.search(r": 0 frames proven, [1-9]\d* refused: unsigned\n", shown.out)


def test_a_key_is_set_changed_and_removed(put: Put, key_file: Path, tmp_path: Path, command: Command) -> None:
    url = put(vehicle := small_px4())
    fresh = a_key_file(tmp_path / "fresh.key", base64.b64encode(OTHER_KEY.secret))
    setup = ("signing", "setup", url, "--link-is-safe", "--timeout", 4, "--signing-key")
    disable = ("signing", "disable", url, "--link-is-safe", "--timeout", 2)
    done = command(*setup, key_file)
    assert (done.code, done.out, done.err) == (0, f"1/1 px4 signs with the key {KEY.fingerprint} now\n", "")
    assert vehicle.signing_key == KEY
    refused = command(*setup, fresh)
    assert (refused.code, refused.out) == (1, "")
    assert "1/1 does not answer requests signed with the key" in refused.err
    changed = command(*setup, fresh, "--present-key", key_file)
    assert (changed.code, changed.err) == (0, "")
    assert OTHER_KEY.fingerprint in changed.out
    refused = command(*disable)
    assert (refused.code, refused.out) == (1, "")
    assert "does not answer unsigned requests" in refused.err
    assert vehicle.signing_key == OTHER_KEY
    removed = command(*disable, "--signing-key", fresh, "--json")
    assert (removed.code, removed.err) == (0, "")
    vehicle_json = {"system": 1, "component": 1, "autopilot": "px4"}
    assert removed.json == vehicle_json | {"signs": False, "fingerprint": None}
    assert vehicle.signing_key is None


class Ignorant(PX4Vehicle):
    """A vehicle that takes no key."""

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        if not isinstance(message, messages.SetupSigning):
            super().respond(message, sender)


def test_a_vehicle_that_does_not_obey_is_found_out(put: Put, key_file: Path, command: Command) -> None:
    for key, words, text in (
        (None, ["setup", "--signing-key", key_file], "requests signed with the key, or unsigned: no "),
        (KEY, ["disable"], "1/1 still signs"),
    ):
        url = put(Ignorant(table=VALUES, signing_key=key, usb=True))
        done = command("signing", words[0], url, "--link-is-safe", *words[1:])
        assert (done.code, done.out, text in done.err) == (1, "", True)


def test_nothing_is_sent_before_the_link_is_called_safe(put: Put, key_file: Path, command: Command) -> None:
    url = put(vehicle := small_px4())
    for words, text in (
        (("setup", url, "--signing-key", key_file), "add --link-is-safe"),
        (("disable", url), "add --link-is-safe"),
        (("setup", url, "--link-is-safe"), "no key is given"),
    ):
        refused = command("signing", *words)
        assert (refused.code, refused.out) == (2, "")
        assert text in refused.err
    assert vehicle.requests == {}


@pytest.mark.parametrize(("answer", "is_sent"), [("", False), ("yes", True)])
def test_the_user_of_a_terminal_confirms(
    put: Put,
    command: Command,
    at_terminal: Callable[[str], None],
    monkeypatch: pytest.MonkeyPatch,
    answer: str,
    is_sent: bool,
) -> None:
    monkeypatch.setenv("PARAMCLIENT_SIGNING_PASSPHRASE", "Schlüssel ✈")
    vehicle = ArduPilotVehicle(table=VALUES)
    at_terminal(answer)
    done = command("signing", "setup", put(vehicle))
    assert "in clear text. Can no other person or program listen or send on this link? [y/N]" in done.err
    key = SigningKey.from_passphrase("Schlüssel ✈")
    if is_sent:
        assert (done.code, done.out) == (0, f"1/1 ardupilot signs with the key {key.fingerprint} now\n")
    else:
        assert (done.code, "nothing was sent" in done.err) == (2, True)
    assert vehicle.signing_key == (key if is_sent else None)
    assert is_sent or vehicle.requests == {}


def test_ctrl_c_ends_the_question() -> None:
    ours, theirs = pty.openpty()
    program = [sys.executable, "-m", "paramclient", "signing", "setup", "sim:px4"]
    environment = {**os.environ, "PARAMCLIENT_SIGNING_KEY": KEY.secret.hex()}
    with (
        os.fdopen(ours, "rb", buffering=0) as seen,
        subprocess.Popen(program, stdin=theirs, stderr=theirs, env=environment) as process,
    ):
        text = b""
        while not text.endswith(b"[y/N] "):
            text += seen.read(1)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    os.close(theirs)
