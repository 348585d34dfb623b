"""Arguments that a new user mistakes: no link, a misspelled file, swapped arguments, a comma in a number."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient.sim import Air, PX4Vehicle
from tests.commands import Command, Put
from tests.shell import Late


@pytest.fixture
def command(command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    """Run the command line in a new folder."""
    monkeypatch.chdir(tmp_path)
    return command


NO_VALUE = "set takes pairs of NAME and VALUE, or NAME=VALUE"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("set MC_ROLL_P MC_YAW_P 6.5", "link name 'MC_ROLL_P': the kind of link is missing; a file, "),
        ("get 14550 MC_YAW_P", "link name '14550': the kind of link is missing"),
        ("get a\0b MC_YAW_P", "link name 'a\\x00b'"),
        ("apply sim:px4 my.json", "no such file: my.json, nor a vehicle in the cache (cache:VEHICLE)\n"),
        ("cache list 1 2", "not expected: 1 2\n"),
        ("check sim:px4 --vehicle all", "--vehicle all is not possible here: check measures one vehicle"),
        ("reset sim:px4", "reset takes names, or --all\n"),
        ("reset sim:px4 MC_ROLL_P --all", "reset takes names, or --all\n"),
        ("set sim:px4", f"{NO_VALUE}\n"),
        ("set sim:px4 MC_ROLL_P = 6.5", f"{NO_VALUE}, and 6.5 has no value\n"),
        ("set sim:px4 MC_ROLL_P 6.5 MC_YAW_P", f"{NO_VALUE}, and MC_YAW_P has no value\n"),
        ("get sim:px4 SEVENTEEN_LETTERS", "parameter name 'SEVENTEEN_LETTERS' has 17 bytes"),
        ("watch sim:px4 ÄÖÜ", "parameter name '\\xc4\\xd6\\xdc': only printable ASCII"),
        ("fetch sim:px4 -q", "Unknown option: -q."),
        ("fetch sim:px4 --no-json", "Unknown option: --no-json."),
        ("fetch sim:px4 --timeout nan", 'Invalid value "nan" for --timeout. It must be a number of seconds'),
        ("fetch sim:px4 --timeout 0", 'Invalid value "0.0" for --timeout. It must be a number of seconds'),
        ("fetch sim:px4 --no-cache --cache x", "Invalid values for group Cache. Mutually exclusive"),
        ("fetch sim:px4 --encoding json", 'Invalid value "json" for --encoding. Choose from: "bytewise"'),
        ("get sim:px4 A --vehicle 4/300", "system ids are 1 to 255, component ids 0 to 255, not 300"),
        ("diff . sim:px4", ". is a folder, not a file, nor a vehicle in the cache"),
        ("restore sim:px4 /", "/ is a folder, not a file, nor the number of a snapshot"),
        ("get sim:px4 A --vehicle 0", "system ids are 1 to 255, component ids 0 to 255, not 0"),
        ("get sim:px4 A --vehicle px4", "--vehicle px4: a vehicle is written as 4, as 4/1"),
        ("get sim:px4 A --vehicle uid:0a0a", "--vehicle uid:0a0a: a vehicle is written as 4, as 4/1"),
        ("get sim:px4 A --vehicle ", "--vehicle : a vehicle is written as 4, as 4/1"),
        ("save sim:px4 new.param --format exe", 'Invalid value "exe" for --format. Choose from: "qgc"'),
        ("save udpout:127.0.0.1:9 none/new.param", "none/new.param: cannot be written: No such file"),
        ("restore sim:px4 quad.param", "no such file: quad.param, nor the number of a snapshot (history"),
        ("watch sim:px4 --vehicle all --timeout 3", "--timeout 3 is too short: --vehicle all listens "),
        ("save 1 new.param --no-cache", "'1' is a vehicle in the cache, which --no-cache excludes"),
        ("fect sim:px4", 'Unknown command "fect". Did you mean "fetch"?'),
        ("token anna", 'Command "token" parameter --file requires an argument. Usage: paramclient token'),
        ("metadata add -", "-: cannot be read: No such file"),
        ("history", 'Command "history" parameter VEHICLE requires an argument.'),
        ("get MC_ROLL_P", 'Command "get" parameter NAME requires an argument. Usage: paramclient get'),
    ],
)
def test_a_mistaken_argument_is_named(command: Command, words: str, text: str) -> None:
    outcome = command(*words.split(" "))
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err.startswith(f"paramclient: {text}")
    assert outcome.err.count("\n") == 1 or text.startswith("link name"), "whose forms are listed"
    assert not Path("new.param").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["fetch", "LINK", "MC_ROLL_PP"],
        ["get", "LINK", "MC_ROLL_PP"],
        ["set", "LINK", "MC_ROLL_PP", 5],
        ["reset", "LINK", "MC_ROLL_PP"],
        ["watch", "LINK", "MC_ROLL_PP"],
        ["show", "1", "MC_ROLL_PP"],
        ["info", "MC_ROLL_PP"],
        ["history", "1", "MC_ROLL_PP"],
        ["save", "LINK", "new.param", "--only", "MC_ROLL_PP"],
        ["diff", "LINK", "1", "--only", "MC_ROLL_PP"],
        ["apply", "LINK", "quad.param"],
    ],
    ids=lambda words: words[0],
)
def test_unknown_names_have_one_exit_code_and_a_hint(command: Command, put: Put, words: list[object]) -> None:
    Path("quad.param").write_text("MC_ROLL_PP,5\n", encoding="utf-8")
    url = put(PX4Vehicle(table={"MC_ROLL_P": 4.0, "MC_YAW_P": 2.0}))
    assert command("fetch", url).code == 0
    done = command(*(url if word == "LINK" else word for word in words))
    assert done.code == 2
    assert "did you mean MC_ROLL_P?" in done.out + done.err
    assert "writing to" not in done.err


def test_a_first_command_suggests_names_but_not_over_a_slow_link(command: Command, put: Put) -> None:
    for name, *value in (["get"], ["set", 5]):
        for delay, is_fetched in ((0.0, True), (0.2, False)):
            vehicle = PX4Vehicle(table={"MC_ROLL_P": 4.0, "MC_YAW_P": 2.0})
            url = put(Air.symmetric([vehicle], delay=delay))
            done = command(name, url, "MC_ROLL_PP", *value, "--no-cache")
            assert (done.code, "did you mean MC_ROLL_P?" in done.out + done.err) == (2, is_fetched)
            assert bool(vehicle.requests["PARAM_REQUEST_LIST"]) == is_fetched


def test_a_text_that_is_neither_a_number_nor_a_known_name_is_quoted(command: Command) -> None:
    outcome = command("set", "sim:px4", "MC_ROLL_P=6,5")
    assert outcome.code == 2
    assert "'6,5' is not a number. 1/1 PX4 quadrotor does not describe its parameters" in outcome.err
    assert "https://autotest.ardupilot.org/Parameters/" in outcome.err


@pytest.mark.parametrize("timeout", [[], ["--timeout", "60"]])
def test_the_error_of_several_vehicles_lists_them(command: Command, put: Put, timeout: list[str]) -> None:
    vehicles = [Late(PX4Vehicle(system=number, table={"GAIN": 4.0}), number / 5) for number in (1, 2, 3, 4)]
    outcome = command("set", put(Air(vehicles)), "GAIN", 5, *timeout)
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err == (
        "paramclient: 4 vehicles on this link: 1/1 PX4 quadrotor, 2/1 PX4 quadrotor, 3/1 PX4 quadrotor, "
        "4/1 PX4 quadrotor. Choose one with --vehicle 1/1, or all with --vehicle all.\n"
    )


def test_the_comparison_of_a_short_file_with_a_whole_table_mentions_partial(command: Command) -> None:
    Path("quad.parm").write_text("MC_ROLL_P 4.0\nMC_YAW_P 2.9\n", encoding="utf-8")
    hint = "--partial leaves out the parameters that the file does not have\n"
    assert command("diff", "quad.parm", "sim:px4").err.endswith(hint)
    assert command("diff", "sim:px4", "quad.parm").err.endswith(hint)
    assert hint not in command("diff", "sim:px4", "quad.parm", "--partial").err
    Path("few.parm").write_text("MC_ROLL_P 4.0\n", encoding="utf-8")
    assert command("diff", "few.parm", "sim:px4", "--partial").code == 0
    assert command("diff", "sim:px4", "few.parm", "--partial").code == 0
    assert command("save", "sim:px4", "whole.parm").code == 0
    assert "--partial" not in command("diff", "whole.parm", "quad.parm").err
    whole = Path("whole.parm").read_text(encoding="utf-8")
    Path("whole.parm").write_text(whole.replace("MC_ROLL_P 4.0", "MC_ROLL_P 5.0"), encoding="utf-8")
    assert "1 different\n" in (compared := command("diff", "whole.parm", "sim:px4")).err
    assert "--partial" not in compared.err


def test_an_excerpt_of_a_wrong_file_has_no_escapes(command: Command) -> None:
    Path("readme.parm").write_text(f"{'This is a long line of text. ' * 20}\n", encoding="utf-8")
    outcome = command("apply", "sim:px4", "readme.parm")
    assert outcome.code == 2
    assert "...'" in outcome.err
    assert "\\u2026" not in outcome.err
