"""Shell completion: its candidates, the modules that it loads, and the scripts of the shells."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from paramclient import ParamCache, ParamClient
from paramclient.cli import completion
from paramclient.cli.completion import POSITIONALS, candidates, split_line
from paramclient.cli.completion_install import SCRIPTS
from paramclient.cli.completion_table import make_table
from paramclient.sim import PX4Vehicle
from tests.caches import PX4, whole_table

ROOT = Path(__file__).parent.parent.parent
MODULES_MAX = 250
"""Modules that a press of the completion key may load; their number decides how long it takes."""
LINK = "udpin:0.0.0.0:14550"


@pytest.fixture(scope="module")
def table() -> completion.Table:
    return make_table()


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """A cache with one vehicle."""
    import anyio

    async def fetch() -> None:
        async with ParamClient(PX4Vehicle(), cache=tmp_path / "cache.sqlite3") as client:
            await (await client.component()).fetch_all()

    anyio.run(fetch)
    return tmp_path / "cache.sqlite3"


def words(line: str, table: completion.Table) -> list[str]:
    return [word for word, _ in candidates(split_line(line), table)]


def test_every_subcommand_has_kinds_of_arguments(table: completion.Table) -> None:
    assert set(POSITIONALS) == set(table)


def test_subcommands_and_groups(table: completion.Table) -> None:
    assert words("fe", table) == ["fetch"]
    assert words("cache ", table) == ["list", "history", "add", "path", "name", "remove", "copy"]
    assert {"cache", "fleet", "signing", "get"} <= set(words("", table))
    reported = dict(candidates([""], table))
    assert reported["fetch"] == "Fetch all parameters"


def test_options_their_choices_and_their_files(table: completion.Table) -> None:
    assert words(f"fetch {LINK} --ref", table) == ["--refresh"]
    assert words(f"fetch {LINK} --policy ", table) == ["auto", "hash-only", "cache-only"]
    assert words(f"fetch {LINK} --tlog ", table) == [], "the shell completes file names"
    assert not [name for name in words("fetch --", table) if name.startswith(("--no-json", "--empty-"))]
    assert "--no-cache" in words("fetch --", table)
    reported = dict(candidates(["fetch", "--refresh"], table))
    assert reported == {"--refresh": "Download all parameters even if the cache is up to date"}


def test_vehicles_and_names_of_the_cache(table: completion.Table, cache: Path) -> None:
    option = f"--cache {cache}"
    names = words(f"get {LINK} {option} MC_ROLL", table)
    assert "MC_ROLL_P" in names
    assert all(name.startswith("MC_ROLL") for name in names)
    assert words(f"get {LINK} {option} mc_roll_p", table) == ["MC_ROLL_P"]
    with ParamCache(cache) as opened:
        (vehicle,) = opened.vehicles()
    assert words(f"show {option} uid", table) == [vehicle.key]
    assert words(f"show {option} 1 MC_ROLL_P", table) == ["MC_ROLL_P"]
    assert words(f"get {LINK} {option} --system ", table) == ["1"]


def test_nicknames_are_completed_and_name_the_owner_of_parameters(
    table: completion.Table, cache: Path
) -> None:
    with ParamCache(cache) as opened:
        opened.save(whole_table(2, replace(PX4, system=2, uid="0002")))
        (key,) = (each.key for each in opened.vehicles() if each.identity.system == 1)
        opened.set_nickname("1", "tractor")
    option = f"--cache {cache}"
    for line in ("show", "history", "diff", "save", "cache remove"):
        assert words(f"{line} {option} trac", table) == ["tractor"]
    for line in ("search", f"get {LINK}", f"set {LINK}"):
        assert words(f"{line} {option} --vehicle trac", table) == ["tractor"]
    assert words(f"show {option} uid", table).count(key) == 1
    for owner in ("tractor", "1", "1/1", key, "cache:tractor"):
        for line in (
            f"show {option} {owner} ",
            f"show {option} --vehicle {owner} ",
            f"get {LINK} {option} --vehicle {owner} ",
        ):
            names = words(line, table)
            assert "MC_ROLL_P" in names
            assert "PARAM_0" not in names
    assert words(f"show {option} --vehicle tractor MC_ROLL_P MC_PITCH_P", table) == ["MC_PITCH_P"]


def test_names_and_values_of_set_take_turns(table: completion.Table, cache: Path) -> None:
    begin = f"set {LINK} --cache {cache}"
    for before in ("", "A 1 ", "A=1 ", "A 1 B=2 "):
        assert words(f"{begin} {before}MC_ROLL_P", table) == ["MC_ROLL_P"]
    for before in ("A ", "A=1 B "):
        assert words(f"{begin} {before}MC_ROLL_P", table) == []


def test_a_missing_cache_is_not_created_and_a_database_not_queried(
    table: completion.Table, tmp_path: Path
) -> None:
    for place in (tmp_path / "none.sqlite3", "postgresql://192.0.2.1/fleet"):
        assert words(f"get {LINK} --cache {place} M", table) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "split"),
    [
        ("", [""]),
        ("a b", ["a", "b"]),
        ("a b ", ["a", "b", ""]),
        ("a 'b c", ["a", "b c"]),
        ('a "b\\"c" d\\ e', ["a", 'b"c', "d e"]),
        ("a ''", ["a", ""]),
    ],
)
def test_lines_are_split_as_shells_do(line: str, split: list[str]) -> None:
    assert split_line(line) == split


def environment(home: Path, **more: str) -> dict[str, str]:
    folders = {name: str(home / name) for name in ("XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_CONFIG_HOME")}
    return os.environ | {"PYTHONPATH": str(ROOT), "HOME": str(home)} | folders | more


def install(home: Path, *arguments: str, **more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "paramclient", "--install-completion", *arguments],
        env=environment(home, **more),
        capture_output=True,
        encoding="utf-8",
        timeout=60,
        check=False,
    )


@pytest.mark.skipif(sys.platform == "win32", reason="bash")
def test_bash_completes_with_the_installed_script(tmp_path: Path, cache: Path) -> None:
    (tmp_path / ".bashrc").write_text("alias ll='ls -l'")
    for _ in range(2):
        done = install(tmp_path, SHELL="/bin/bash")
        assert (done.returncode, done.stdout) == (0, "")
    rc = (tmp_path / ".bashrc").read_text().splitlines()
    assert rc[0] == "alias ll='ls -l'"
    assert len(rc) == 2
    command = tmp_path / "paramclient"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m paramclient "$@"\n')
    command.chmod(0o755)

    def completed(line: str) -> list[str]:
        program = f"""
            shopt -s expand_aliases
            source ~/.bashrc
            COMP_WORDBREAKS=$' \\t\\n:='
            COMP_LINE="paramclient $1" COMP_POINT=999
            _paramclient {command}
            printf '%s\\n' "${{COMPREPLY[@]}}"
        """
        done = subprocess.run(
            ["bash", "-c", program, "bash", line],
            env=environment(tmp_path),
            capture_output=True,
            encoding="utf-8",
            timeout=60,
            check=True,
        )
        return done.stdout.split()

    assert completed("fet") == ["fetch"]
    assert completed("get udp") == ["udpin:0.0.0.0:14550", "udpout:"]
    assert completed("get udpin:") == ["0.0.0.0:14550"], "bash replaces what follows the colon"
    assert completed(f"get {LINK} --cache {cache} MC_ROLL_P") == ["MC_ROLL_P"]


def test_a_completion_loads_none_of_the_libraries_that_would_delay_it(tmp_path: Path, cache: Path) -> None:
    line = ["get", LINK, "--cache", str(cache), "MC_ROLL_P"]

    def completed(*options: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *options, "-m", "paramclient", *line],
            env=environment(tmp_path, **{completion.COMPLETION_VARIABLE: "fish"}),
            capture_output=True,
            encoding="utf-8",
            timeout=60,
            check=True,
        )

    completed()  # the first one writes the table of options
    done = completed("-X", "importtime")
    assert done.stdout == "MC_ROLL_P\t\n"
    loaded = {row.rpartition("|")[2].strip() for row in done.stderr.splitlines() if "|" in row}
    assert "paramclient.cli.completion" in loaded
    rooms = {".".join(name.split(".")[:2]) for name in loaded if name.startswith("paramclient.")}
    assert rooms == {f"paramclient.{room}" for room in ("cache", "cli", "errors", "model", "version")}
    assert not loaded & {"asyncio", "anyio", "pydantic", "pymavlink", "cyclopts", "rich"}
    assert len(loaded) < MODULES_MAX


def test_zsh_and_fish_get_their_scripts(tmp_path: Path) -> None:
    assert install(tmp_path, SHELL="/usr/bin/zsh").returncode == 0
    assert "completion.zsh" in (tmp_path / ".zshrc").read_text()
    assert install(tmp_path, "fish").returncode == 0
    script = tmp_path / "XDG_CONFIG_HOME/fish/completions/paramclient.fish"
    assert script.read_text() == SCRIPTS["fish"]
    done = install(tmp_path, SHELL="/bin/tcsh")
    assert done.returncode == 2
    assert "bash, zsh, fish" in done.stderr


@pytest.mark.parametrize(
    ("shell", "lines"),
    [
        (
            "zsh",
            ["udpin\\:0.0.0.0\\:14550:a vehicle that sends to this port", "udpout\\::HOST:PORT to send to"],
        ),
        ("fish", ["udpin:0.0.0.0:14550\ta vehicle that sends to this port", "udpout:\tHOST:PORT to send to"]),
    ],
)
def test_zsh_and_fish_are_given_meanings_too(tmp_path: Path, shell: str, lines: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "paramclient", "get", "udp"],
        env=environment(tmp_path, **{completion.COMPLETION_VARIABLE: shell}),
        capture_output=True,
        encoding="utf-8",
        timeout=60,
        check=True,
    )
    assert done.stdout.splitlines() == lines
