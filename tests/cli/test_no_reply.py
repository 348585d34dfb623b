"""What commands say when nothing answers: what was received instead, and what is awaited."""

from __future__ import annotations

import sys
from typing import Any

import pytest

from paramclient.sim import GenericVehicle, PX4Vehicle
from paramclient.wire.messages import Heartbeat, Message
from tests.commands import Command, Put
from tests.shell import Tap

URL = "sim:custom"


@pytest.fixture
def command(command: Command) -> Command:
    """Run the command line without a cache."""
    return lambda *words: command(*words, "--no-cache")


class Deaf(PX4Vehicle):
    """A vehicle that sends, and receives no request."""

    def receive(self, data: bytes, now: float) -> None:
        """Lose what is sent to the vehicle."""


class Station(GenericVehicle):
    """A ground station, which sends heartbeats."""

    def send(self, message: Message) -> None:
        if isinstance(message, Heartbeat):
            super().send(Heartbeat(6, 8))


CURE = "Check the link towards the vehicle, and whether the vehicle requires signed messages."


@pytest.mark.parametrize("words", [["get", "A"], ["set", "A", 2], ["fetch"]])
def test_a_vehicle_that_speaks_and_does_not_answer(command: Command, put: Put, words: list[Any]) -> None:
    done = command(words[0], put(Deaf(table={"A": 1})), *words[1:])
    assert done.code == 3
    assert "1/1 sends messages (the last one " in done.err, done.err
    assert done.err.endswith(f"{CURE}\n")


def test_one_cause_of_many_writes_is_explained_once(command: Command, put: Put) -> None:
    done = command("set", put(Deaf(table={"A": 1, "B": 2})), "A", 2, "B", 3, "--json")
    assert {each["status"] for each in done.json["results"]} == {"not tried"}, "the type could not be read"
    assert all(CURE in each["reason"] for each in done.json["results"])
    assert done.err.count(CURE) == 1


def test_only_another_station_is_received(command: Command, put: Put) -> None:
    done = command("get", put(Station({}, system=252, component=190)), "A", "--timeout", 3)
    assert done.code == 3
    assert done.err == (
        "paramclient: no reply: an autopilot in 3.0 s. Heard on sim:custom so far: only 252/190 ground "
        "station, and no vehicle.\n"
    )


def test_a_vehicle_that_falls_silent(command: Command, put: Put) -> None:
    """It is switched off by the first request."""
    vehicle = GenericVehicle({"A": 1})
    dying = Tap(vehicle, down=lambda message: not vehicle.requests["PARAM_REQUEST_READ"])
    done = command("get", put(dying), "A")
    assert done.code == 3
    assert "Nothing was received of 1/1 for " in done.err


# On a terminal


def use_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make stderr look like a terminal of 100 columns."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "100")


def drawn(err: str) -> list[str]:
    """The texts of the line, as they were drawn one after the other."""
    return err.split("\r\x1b[K")[1:]


def test_a_terminal_says_what_is_awaited(command: Command, put: Put, monkeypatch: pytest.MonkeyPatch) -> None:
    use_terminal(monkeypatch)
    texts = drawn(command("get", put(Station({}, system=252, component=190)), "A", "--timeout", 3.2).err)
    received = "Heard on sim:custom so far: only 252/190 ground station, an"
    assert texts[0] == "waiting for an autopilot on sim:custom (0 s). " + received[: 99 - 46]
    assert texts[-2].startswith("waiting for an autopilot on sim:custom (3 s). ")
    assert len(texts) == 7, "six times, and the erasure with the error after it"
    assert texts[-1].startswith("paramclient: no reply: ")
    for words, shown in (
        *((words, "waiting for A of 1/1 PX4 quadrotor (0 s).") for words in (["get", "A"], ["set", "A", 2])),
        (["fetch"], "fetching 1/1 PX4 quadrotor: waiting for the first response (0 s)."),
    ):
        assert drawn(command(words[0], put(Deaf(table={"A": 1})), *words[1:]).err)[0] == shown


def test_a_quick_response_prints_nothing(command: Command, put: Put, monkeypatch: pytest.MonkeyPatch) -> None:
    use_terminal(monkeypatch)
    assert command("get", put(GenericVehicle({"A": 1})), "A").err == ""
