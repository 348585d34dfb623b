"""The subcommand diff: sources, comparison, output and exit codes."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import pytest

from paramclient import ParamCache, ParamClient, ParamType
from paramclient.cache import StoredParam, TableState
from paramclient.cli import session as cli_session
from paramclient.links import SimLink
from paramclient.model.identity import Identity
from paramclient.model.values import Param, Value, bits_of
from paramclient.sim import GenericVehicle
from tests.caches import NOW, PX4, update
from tests.commands import Command

INT32, REAL32 = ParamType.INT32, ParamType.REAL32
AT = "2026-11-18T11:06:40.000Z"
"""NOW, as it is printed."""
FIRST = replace(PX4, system=1, uid="aa00000000000001")
SECOND = replace(PX4, system=2, uid="bb00000000000002")
THIRD = replace(PX4, system=3, uid="cc00000000000003")

Write: TypeAlias = Callable[..., str]
Content = dict[str, tuple[Value, int] | tuple[Value, int, Value]]


def keep(cache: Path, content: Content, identity: Identity = FIRST, *, component: int = 1) -> None:
    """Store a table in the cache."""
    params = [
        Param(name, value, kind, index, bits_of(value, kind), default=default[0] if default else None)
        for index, (name, (value, kind, *default)) in enumerate(content.items())
    ]
    state = TableState(None, len(params), complete=True, synced_at=NOW)
    with ParamCache(cache) as kept:
        stored = [StoredParam.of(each, NOW) for each in params]
        kept.save(update(*stored, identity=identity, component=component, replace=True, table=state))


BEFORE: Content = {
    "A_SAME": (1, INT32, 1),
    "B_FLOAT": (0.1, REAL32, 0.1),
    "C_LEFT": (5, INT32, 5),
    "E_BOTH": (7, INT32, 0),
    "F_CONFLICT": (1.5, REAL32, 0.0),
    "G_TYPE": (1, INT32, 1),
}
AFTER = BEFORE | {"B_FLOAT": (0.2, REAL32, 0.1), "D_RIGHT": (6, INT32, 0)}
AFTER |= {"F_CONFLICT": (2.5, REAL32, 0.0), "G_TYPE": (1.0, REAL32, 1)}
del AFTER["C_LEFT"]


@pytest.fixture
def two(cache: Path) -> None:
    """Store two vehicles in the cache."""
    keep(cache, BEFORE)
    keep(cache, AFTER, SECOND)


@pytest.mark.usefixtures("two")
def test_diff_prints_a_table_of_differences(command: Command) -> None:
    outcome = command("diff", 1, 2)
    assert outcome.code == 1
    assert outcome.rows == [
        ["name", "left 1/1", "right 2/1", "is"],
        ["B_FLOAT", "0.1", "0.2", "different"],
        ["C_LEFT", "5", "only left"],
        ["D_RIGHT", "6", "only right"],
        ["F_CONFLICT", "1.5", "2.5", "different"],
        ["G_TYPE", "1", "1.0", "same, INT32 and REAL32"],
    ]
    assert outcome.err.splitlines() == [
        f"left: 6 parameters of 1/1 px4 from cache uid:aa00000000000001, {AT}",
        f"right: 6 parameters of 2/1 px4 from cache uid:bb00000000000002, {AT}",
        "3 same; 2 different; 1 only left; 1 only right; 1 of another type",
    ]


@pytest.mark.usefixtures("two")
def test_a_base_shows_the_side_that_has_changed(command: Command, cache: Path) -> None:
    keep(cache, {"B_FLOAT": (0.1, REAL32), "F_CONFLICT": (0.5, REAL32)}, THIRD)
    outcome = command("diff", 1, 2, "--base", 3)
    assert outcome.rows[0] == ["name", "left 1/1", "right 2/1", "base 3/1", "is", "changed"]
    assert {row[0]: row[1:] for row in outcome.rows[1:]} == {
        "B_FLOAT": ["0.1", "0.2", "0.1", "different", "right"],
        "C_LEFT": ["5", "only left", "unknown"],
        "D_RIGHT": ["6", "only right", "unknown"],
        "F_CONFLICT": ["1.5", "2.5", "0.5", "different", "conflict"],
        "G_TYPE": ["1", "1.0", "same, INT32 and REAL32", "unknown"],
    }
    assert "; changed from the base: 1 right, 1 conflict, 5 not in the base\n" in outcome.err


@pytest.mark.usefixtures("two")
def test_the_defaults_are_a_base(command: Command) -> None:
    outcome = command("diff", 1, 2, "--base", "defaults", "--json")
    assert outcome.code == 1
    assert outcome.json["base"]["source"] == "the firmware's defaults"
    assert outcome.json["changed_sides"] == {"neither": 3, "left": 0, "right": 2, "both": 1, "conflict": 1}
    found = outcome.json["params"].items()
    assert {name: (entry["is"], entry["changed_side"]) for name, entry in found} == {
        "B_FLOAT": ("different", "right"),
        "C_LEFT": ("only left", "neither"),
        "D_RIGHT": ("only right", "right"),
        "E_BOTH": ("same", "both"),
        "F_CONFLICT": ("different", "conflict"),
        "G_TYPE": ("same", "neither"),
    }


@pytest.mark.usefixtures("two")
def test_only_compares_the_named_parameters(command: Command) -> None:
    assert command("diff", 1, 2, "--only", "A_*", "--only", "E_BOTH").code == 0
    narrowed = command("diff", 1, 2, "--only", "?_FLOAT", "--json")
    assert (narrowed.code, list(narrowed.json["params"])) == (1, ["B_FLOAT"])
    misspelt = command("diff", 1, 2, "--only", "A_*", "--only", "B_FLAOT")
    assert (misspelt.code, misspelt.out) == (2, "")
    assert "called B_FLAOT (did you mean B_FLOAT?)" in misspelt.err


# Sources


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["9", "1"], "9 is not in the cache"),
        (["1", "1", "--vehicle", "1/9"], "which has 1/1 (uid:aa00000000000001)"),
        (["udpin:x", "1"], "(cache:VEHICLE); link name 'udpin:x': "),
        (["", "1"], "no such file"),
        (["cache:", "1"], "needs a name"),
        (["a\0b", "1"], "a\\x00b"),
        (["1", "x" * 5000], "no such file"),
    ],
)
def test_an_unknown_source_is_an_error(command: Command, words: list[str], text: str) -> None:
    outcome = command("diff", *words)
    assert (outcome.code, outcome.out) == (2, "")
    assert text in outcome.err


def test_the_autopilot_is_the_default_component(command: Command, cache: Path) -> None:
    keep(cache, {"CAM": (1, INT32)}, component=100)
    only = command("diff", 1, 1, "--json").json
    assert (only["left"]["component"], only["left"]["count"]) == (100, 1)
    keep(cache, {"A": (1, INT32)})
    assert command("diff", 1, 1, "--json").json["left"]["component"] == 1
    assert command("diff", 1, 1, "--vehicle", "1/100", "--json").json["left"]["component"] == 100


# Files


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Write a file of these lines to the working directory."""
    monkeypatch.chdir(tmp_path)

    def place(name: str, *lines: str) -> str:
        (tmp_path / name).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
        return name

    return place


@pytest.mark.usefixtures("two")
def test_an_existing_file_has_precedence(command: Command, write: Write, tmp_path: Path) -> None:
    for name in ("1", "aa0000", "tcp:one:1"):
        write(name, "A 1")
        outcome = command("diff", name, "cache:1", "--json")
        assert (outcome.json["left"]["source"], outcome.json["right"]["system"]) == (name, 1)
    (tmp_path / "2").mkdir()
    assert command("diff", "2", "2").code == 0


def test_a_name_that_no_vehicle_has_is_left_out(command: Command, write: Write) -> None:
    left, right = write("left.param", "A,1", "SIM_GPS1_BYTELOSS,0"), write("right.param", "A,1")
    for words in (["diff", left, right], ["show", left]):
        outcome = command(*words)
        assert (outcome.code, "(incomplete: without 1 parameter that" in outcome.err) == (0, True)
        assert all(each in outcome.err.splitlines()[0] for each in ("left.param: line 2: ", "_BYTELOSS"))
    assert command("save", left, "new.param").code == 0
    assert "(incomplete: without 1 parameter that" in command("show", "new.param").err


def test_a_file_is_read_from_stdin(command: Command, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    write("quad.param", "A,1", "B,2")
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"A 1\nB 3\n")))
    outcome = command("diff", "quad.param", "-", "--json")
    assert (outcome.code, list(outcome.json["params"])) == (1, ["B"])
    assert outcome.json["right"]["source"] == "standard input"
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"A 1\nB 3\n")))
    assert command("diff", "quad.param", "quad.param", "--base", "-").code == 0


# Links


def test_two_links_are_compared(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def client(url: str, **options: Any) -> ParamClient:
        return ParamClient(SimLink(vehicles.pop(url), url), **options)  # each link is opened once

    monkeypatch.setattr(cli_session, "ParamClient", client)
    one, two = GenericVehicle({"A": 1, "B": 2}), GenericVehicle({"A": 1, "B": 3}, system=7)
    vehicles = {"tcp:one:1": one, "tcp:two:1": two}
    outcome = command("diff", "tcp:one:1", "tcp:two:1", "--base", "tcp:one:1", "--json")
    assert (outcome.code, outcome.err) == (1, "")
    [(name, entry)] = outcome.json["params"].items()
    values = entry["left"]["value"], entry["right"]["value"]
    assert (name, values, entry["changed_side"]) == ("B", (2, 3), "right")
    assert (outcome.json["left"]["system"], outcome.json["right"]["system"]) == (1, 7)
    assert outcome.json["right"]["source"] == "link tcp:two:1"
