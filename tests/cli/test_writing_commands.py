"""Subcommands that write, with several vehicles on the link: only a named vehicle is written to."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import anyio
import pytest

from paramclient import ParamCache, ParamClient
from paramclient.cache import TableState
from paramclient.cli import session as cli_session
from paramclient.links import SimLink
from paramclient.model.identity import Identity
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, Vehicle
from paramclient.wire import messages
from tests.caches import NOW, stored, update
from tests.commands import Command, Put, behind
from tests.shell import Late, Tap

URL = "udpin:0.0.0.0:14550"
SOURCE = "udpin:0.0.0.0:14551"
"""Another link, with values to be written."""
TABLE: dict[str, Any] = {"MC_ROLL_P": 4.0, "MC_PITCH_P": 4.0}
LISTED = (
    "paramclient: 2 vehicles on this link: 1/1 PX4 quadrotor, 2/1 ArduPilot quadrotor. "
    "Choose one with --vehicle 1/1, or all with --vehicle all.\n"
)
Words: TypeAlias = Callable[[str], list[str]]
"""Returns the arguments of a subcommand."""
"""What identifies vehicles."""


@pytest.fixture
def words(tmp_path: Path, cache: Path) -> Words:
    """Return the arguments of a subcommand that writes; only the vehicle is not named."""
    file = tmp_path / "wanted.param"
    file.write_text("MC_ROLL_P,7\nMC_PITCH_P,7\n")
    key = tmp_path / "vehicle.key"
    key.write_bytes(bytes(range(101, 133)))
    key.chmod(0o600)
    source = Identity(9, URL, "beef000000000009")
    values = [stored(name, 7, index=index) for index, name in enumerate(TABLE)]
    with ParamCache(cache) as kept:
        kept.save(update(*values, identity=source, table=TableState(count=2, complete=True, synced_at=NOW)))
    commands = {
        "set": ["set", URL, "MC_ROLL_P", "7"],
        "apply": ["apply", URL, str(file), "--yes"],
        "apply to see": ["apply", URL, str(file), "--dry-run"],
        "apply from the cache": ["apply", URL, "cache:9", "--yes"],
        "restore": ["restore", URL, str(file), "--yes"],
        "restore to see": ["restore", URL, str(file), "--dry-run"],
        "signing setup": ["signing", "setup", URL, "--signing-key", str(key), "--link-is-safe"],
        "signing disable": ["signing", "disable", URL, "--signing-key", str(key), "--link-is-safe"],
    }
    return lambda name: commands[name]


WRITING = ["set", "apply", "apply from the cache", "restore"]
SIGNING = ["signing setup", "signing disable"]


def px4(system: int = 1, **options: Any) -> PX4Vehicle:
    return PX4Vehicle(system=system, **{"table": TABLE} | options)


def copter(system: int = 2, **options: Any) -> ArduPilotVehicle:
    return ArduPilotVehicle(system=system, live=(), **{"table": TABLE} | options)


def untouched(*vehicles: Vehicle) -> bool:
    """Return whether nothing was written to these vehicles."""
    return all(
        not each.requests["PARAM_SET"] and each.signing_key is None and dict(each.values) == TABLE
        for each in vehicles
    )


@pytest.mark.parametrize("phase", [0.0, 0.7, 1.15])
@pytest.mark.parametrize("name", [*WRITING, *SIGNING, "apply to see", "restore to see"])
def test_nothing_is_written_to_two(command: Command, put: Put, words: Words, name: str, phase: float) -> None:
    for first, second in ((0.0, phase), (phase, 0.0)):
        one, two = px4(), copter()
        air = Tap(Air([Late(one, first), Late(two, second)]))
        put(air)
        done = command(*words(name))
        listed = LISTED if name not in SIGNING else LISTED.replace(", or all with --vehicle all", "")
        assert (done.code, done.out, done.err) == (2, "", listed)
        assert untouched(one, two)
        assert {type(message) for _, _, message in air.received} <= {messages.Heartbeat, messages.CommandLong}


@pytest.mark.parametrize("name", [*WRITING, *SIGNING])
@pytest.mark.parametrize("system", [1, 2])
def test_only_the_named_one_is_set(command: Command, put: Put, words: Words, name: str, system: int) -> None:
    one, two = px4(), copter()
    put(Air([one, two] if system == 2 else [two, one]))
    done = command(*words(name), "--vehicle", system, "--timeout", 30)
    named, other = (one, two) if system == 1 else (two, one)
    assert untouched(other)
    if name == "signing disable":
        return
    assert done.code == 0, done.err
    assert not untouched(named)


@pytest.mark.parametrize("name", [*WRITING, *SIGNING])
@pytest.mark.parametrize("first", [0.0, 0.9])
def test_component_chooses_between_two_autopilots_of_a_system(
    command: Command, put: Put, words: Words, name: str, first: float
) -> None:
    one, two = px4(), copter(1, component=2)
    put(Air([Late(one, first), Late(two, 0.9 - first)]))
    done = command(*words(name))
    assert (done.code, done.out) == (2, "")
    assert "2 autopilots in system 1 on this link: 1/1 PX4 quadrotor, 1/2 Ardu" in done.err
    assert "Choose one with --vehicle 1/1.\n" in done.err
    assert untouched(one, two)
    if name == "set":
        assert command(*words(name), "--vehicle", "1/2", "--timeout", 30).code == 0
        assert (untouched(one), untouched(two)) == (True, False)


# Vehicles that appear and disappear


@pytest.mark.parametrize("name", ["apply", "restore"])
def test_a_vehicle_that_appears_during_the_read_stops_the_write(
    command: Command, put: Put, cache: Path, words: Words, name: str
) -> None:
    table = {**TABLE, **{f"PARAM_{number:03}": number for number in range(300)}}
    one, two = px4(table=table, burst=1, period=0.02), copter()
    put(Air([one, Late(two, 4.0)]))
    done = command(*words(name))
    assert (done.code, done.out) == (2, "")
    assert done.err.endswith(LISTED)
    assert (one.requests["PARAM_SET"], two.requests["PARAM_SET"]) == (0, 0)
    assert one.requests["PARAM_REQUEST_LIST"]
    with ParamCache(cache) as kept:
        found = [each for each in kept.vehicles() if each.identity.system == 1]
        assert not any(kept.snapshots(each.key) for each in found), "nothing to restore was kept"


@pytest.mark.parametrize("is_replaced", [False, True])
def test_a_vehicle_that_appears_during_the_metadata_download_is_not_written_to(
    command: Command, put: Put, monkeypatch: pytest.MonkeyPatch, is_replaced: bool
) -> None:
    one, two = px4(), copter()
    until = 3.0 if is_replaced else math.inf
    put(Air([Late(one, 0.0, until=until), Late(two, 12.0 if is_replaced else 3.0)]))

    async def slowly(*_: object, **__: object) -> None:
        await anyio.sleep(15.0)

    monkeypatch.setattr("paramclient.cli.set_command.known_of_session", slowly)
    done = command("set", URL, "MC_ROLL_P", "7")
    assert (done.code, done.out) == (2, "")
    gone = "quadrotor is no longer heard; 2/1 ArduPilot quadrotor is heard instead. Nothing was written."
    assert (gone if is_replaced else LISTED) in done.err
    assert untouched(one, two)


# Ambiguous sources


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_no_ambiguous_file_is_used(command: Command, monkeypatch: pytest.MonkeyPatch, dry: list[str]) -> None:
    target, (one, two) = px4(5), (px4(), copter())
    links = {URL: SimLink(target, URL), SOURCE: SimLink(Air([one, Late(two, 0.9)]), SOURCE)}
    monkeypatch.setattr(cli_session, "ParamClient", lambda url, **options: ParamClient(links[url], **options))
    done = command("apply", URL, SOURCE, "--yes", *dry)
    assert (done.code, done.out, done.err) == (2, "", LISTED)
    assert untouched(target, one, two)


# time


def test_a_simulated_link_has_no_second_vehicle(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    behind(monkeypatch, URL)(SimLink(Air([Air([px4()])]), "sim:px4"))
    assert command("set", URL, "MC_ROLL_P", "7", "--timeout", "0.9").code == 0


def test_a_short_timeout_reports_the_remaining_wait(command: Command, put: Put) -> None:
    one = px4()
    put(Tap(one))
    done = command("set", URL, "MC_ROLL_P", "7", "--timeout", "1")
    assert (done.code, done.out) == (3, "")
    assert "an autopilot, then 1.2 s without another vehicle" in done.err
    assert untouched(one)
