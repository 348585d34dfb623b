"""The README and the pages: their programs run, their links lead somewhere, and what they name exists."""

from __future__ import annotations

import io
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from functools import cache
from pathlib import Path
from types import ModuleType
from unittest import mock

import pytest

import paramclient
import paramclient.links
import paramclient.metadata
import paramclient.provision
import paramclient.remote
import paramclient.sim
import paramclient.testing
from paramclient import cli
from paramclient.cli.exit_codes import ExitCode

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
GUIDES_AND_INTERNALS = [*sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("internals/*.md"))]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *GUIDES_AND_INTERNALS]


def name_of(page: Path) -> str:
    return page.relative_to(DOCS if page.is_relative_to(DOCS) else ROOT).with_suffix("").as_posix()


EVERY_PAGE = pytest.mark.parametrize("page", PAGES, ids=name_of)

FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
DIRECTIVE = re.compile(r"^\.\. (\w+):: ([\w.]+)(?:\(\))?$", re.MULTILINE)
COMMANDS = [
    "fetch",
    "get",
    "set",
    "watch",
    "link",
    "check",
    "ports",
    "show",
    "diff",
    "save",
    "history",
    "search",
    "info",
    "sim",
]
COMMANDS += ["apply", "verify", "restore", "import", "serve", "token"]

LINK = re.compile(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)")
SERVICE = "http://127.0.0.1:8765"
"""The address of a service in programs."""
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


def blocks(page: Path, language: str) -> list[str]:
    return [code for kind, code in FENCE.findall(page.read_text(encoding="utf-8")) if kind == language]


def programs() -> Iterator[tuple[str, str]]:
    """Every Python program of the pages, with its name."""
    for page in PAGES:
        for number, code in enumerate(blocks(page, "python"), start=1):
            yield f"{name_of(page)}-{number}", code


def needs_service(code: str) -> bool:
    """Return whether a program is a client of a service."""
    return SERVICE in code


def commands() -> list[list[str]]:
    """Every call of the command in the pages, without the comment and what the shell does."""
    lines = [line for page in PAGES for code in blocks(page, "sh") for line in code.splitlines()]
    words = [shlex.split(line, comments=True) for line in lines]
    return [
        [word for word in each[1:] if not word.startswith(">")]
        for each in words
        if each[:1] == ["paramclient"]
    ]


def run(*arguments: str, cwd: Path | None = None, **environment: str) -> str:
    """Run a Python program; what it printed. It must end well, and complain of nothing."""
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@contextmanager
def serving(*arguments: str, cwd: Path) -> Iterator[str]:
    """Run a service in a process of its own; its address."""
    words = ["-m", "paramclient", "serve", *arguments, "--listen", "127.0.0.1:0"]
    with subprocess.Popen(
        [sys.executable, *words],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        encoding="utf-8",
    ) as process:
        try:
            assert process.stdout is not None
            found = re.fullmatch(r"serving on (\S+)\n", process.stdout.readline())
            assert found
            yield found[1]
        finally:
            process.terminate()


@pytest.mark.parametrize(
    "program", [pytest.param(code, id=name) for name, code in programs() if not needs_service(code)]
)
def test_a_program_runs(program: str, tmp_path: Path) -> None:
    folders = {"XDG_CACHE_HOME": str(tmp_path), "XDG_STATE_HOME": str(tmp_path)}
    run("-W", "error", "-c", program, cwd=tmp_path, **folders)


def test_the_programs_over_a_service_run(tmp_path: Path) -> None:
    found = [code for _, code in programs() if needs_service(code)]
    assert found
    with serving("sim:px4", "--no-cache", cwd=tmp_path) as address:
        for code in found:
            run("-W", "error", "-c", code.replace(SERVICE, address), cwd=tmp_path)


def test_programs_are_typed(tmp_path: Path) -> None:
    for name, code in programs():
        file = tmp_path / f"{re.sub(r'[^a-z0-9]', '_', name.lower())}.py"
        file.write_text(code, encoding="utf-8")
    settings = ["--config-file", str(ROOT / "pyproject.toml"), "--cache-dir", str(ROOT / ".mypy_cache")]
    files = sorted(map(str, tmp_path.glob("*.py")))
    assert len(files) == len(list(programs()))
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *settings, "--no-error-summary", *files],
        cwd=ROOT,
        capture_output=True,
        encoding="utf-8",
        timeout=300,
        check=False,
    )
    assert (done.stdout.replace(f"{tmp_path}/", ""), done.stderr) == ("", "")


def test_the_first_example_prints_what_its_comments_say(tmp_path: Path) -> None:
    (example,) = blocks(ROOT / "README.md", "python")
    printed = run("-W", "error", "-c", example, XDG_CACHE_HOME=str(tmp_path))
    assert printed == "903, MC_ROLL_P = 4.0, MC_ROLL_P = 6.0\n"


@cache
def anchors(page: Path) -> frozenset[str]:
    """The anchors of a page's headings, as GitHub and the pages' builder make them."""
    headings = HEADING.findall(FENCE.sub("", page.read_text(encoding="utf-8")))
    return frozenset(re.sub(r"[^\w -]", "", each.lower()).replace(" ", "-") for each in headings)


@EVERY_PAGE
def test_links_lead_somewhere(page: Path) -> None:
    """Sphinx follows the links of the pages in `docs` only, and the README is not among them."""
    for target, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        if target.startswith("https://"):
            continue
        place = page.parent / target if target else page
        assert place.exists(), f"{page.name}: {target}"
        if anchor:
            assert anchor in anchors(place), f"{page.name}: {target}#{anchor}"


def test_every_page_is_in_the_table_of_contents() -> None:
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    for page in [*GUIDES_AND_INTERNALS, *DOCS.glob("api/*.rst")]:
        name = name_of(page)
        assert name == "index" or re.search(rf"^{name}$", index, re.MULTILINE), name


@pytest.mark.parametrize(
    "module",
    [
        *(paramclient, paramclient.links, paramclient.metadata, paramclient.provision),
        *(paramclient.remote, paramclient.sim, paramclient.testing),
    ],
    ids=lambda m: m.__name__,
)
def test_every_public_name_is_in_the_pages(module: ModuleType) -> None:
    documented = set()
    for page in DOCS.glob("api/*.rst"):
        current = ""
        for directive, name in DIRECTIVE.findall(page.read_text(encoding="utf-8")):
            if directive in ("currentmodule", "automodule"):
                current = name
            else:
                documented.add(f"{current}.{name}")
    public = {f"{module.__name__}.{name}" for name in module.__all__ if name != "__version__"}
    assert public == {name for name in documented if name.rpartition(".")[0] == module.__name__}


def test_the_page_of_the_design_names_every_room() -> None:
    text = (DOCS / "internals/design.md").read_text(encoding="utf-8")
    package = ROOT / "paramclient"
    core = package / "protocol"
    told_as_a_whole = {core / "wire", core / "ftp"}
    parts = [path.parent for path in core.glob("*/__init__.py") if path.parent not in told_as_a_whole]
    shown = (package, package / "model", package / "client", core, *parts)
    modules = {path.name for folder in shown for path in folder.glob("*.py")}
    folders = {f"{path.parent.name}/" for folder in shown for path in folder.glob("*/__init__.py")}
    rooms = (modules | folders) - {"__init__.py", "__main__.py", "version.py"}
    assert set(re.findall(r"^ {2,6}(\w+(?:\.py|/)) ", text, re.MULTILINE)) == rooms


def test_make_knows_what_the_pages_say() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for code in [*re.findall(r"`(make [^`]+)`", text), *blocks(page, "sh")]:
            named |= set(re.findall(r"\bmake ([a-z]+)", code))
    assert {"demo", "test", "docs"} <= named <= targets


@cache
def help_of(*words: str) -> str:
    """What the command prints about one of its own, in this process."""
    printed = io.StringIO()
    with mock.patch.dict(os.environ, COLUMNS="200"), redirect_stdout(printed):
        assert cli.run([*words, "--help"]) == ExitCode.DONE
    return printed.getvalue()


def subcommand(words: list[str]) -> list[str]:
    return words[:2] if words[0] in ("cache", "fleet", "signing") else words[:1]


def test_every_command_is_shown_and_exists() -> None:
    used = {tuple(subcommand(words)) for words in commands()}
    cache = {("cache", verb) for verb in ("list", "history", "path", "add", "remove", "copy")}
    fleet = {("fleet", "diff")}
    signing = {("signing", verb) for verb in ("setup", "disable")}
    assert used == {(verb,) for verb in COMMANDS} | cache | fleet | signing
    for words in used:
        assert words[-1] in help_of(*words)


def test_options_in_examples_exist() -> None:
    for words in commands():
        options = help_of(*subcommand(words))
        for option in (word for word in words if word.startswith("--")):
            assert re.search(rf"{option}\b", options), f"paramclient {shlex.join(words)}: no {option}"


def test_the_page_of_the_command_names_every_option() -> None:
    page = (DOCS / "command.md").read_text(encoding="utf-8")
    offered = set()
    for command in COMMANDS:
        offered |= set(re.findall(r"--[a-z][a-z-]+", help_of(command)))
    for verb in ("setup", "disable"):
        offered |= set(re.findall(r"--[a-z][a-z-]+", help_of("signing", verb)))
    for verb in ("list", "history", "path", "add", "remove", "copy"):
        offered |= set(re.findall(r"--[a-z][a-z-]+", help_of("cache", verb)))
    offered |= set(re.findall(r"--[a-z][a-z-]+", help_of("fleet", "diff")))
    named = set(re.findall(r"`(--[a-z][a-z-]+)", page))
    assert named - {"--help"} == offered - {"--help", "--version"}
