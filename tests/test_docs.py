"""The README and the pages: their links lead somewhere, what they name exists, and their programs run."""

from __future__ import annotations

import io
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from functools import cache
from importlib import import_module
from pathlib import Path
from unittest import mock

import pytest

from paramclient.cli import app
from tests.simulated_on_udp import free_port

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
DOCUMENTED = sorted(DOCS.glob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCUMENTED]

LINK = re.compile(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)")
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHOWN = re.compile(
    r"^```python\n((?:(?!```).*\n)*)```\n\n(?:It prints\b.*\n\n)?```text\n((?:(?!```).*\n)*)```$",
    re.MULTILINE,
)
"""A program, and the output that the page shows below it."""
RECIPE = re.compile(r"^```sh\n(.*)\n```\n(?:\n```text\n((?:(?!```).*\n)*)```\n)?", re.MULTILINE)
"""A command, and the output that the page shows below it, if it prints anything."""
FILE_TO_WRITE = re.compile(r"Write this to `([\w.]+)`:\n\n```text\n(.*?)```", re.DOTALL)
DURATION = re.compile(r"\d+\.\d+ s\b")
TIME = re.compile(r"\d{4}-\d\d-\d\dT[\d:.]+(?:Z|[+-]\d\d:\d\d)")
SITL = "udpin:127.0.0.1:14550"
"""The link of programs that need SITL."""


def name_of(page: Path) -> str:
    return page.relative_to(DOCS if page.is_relative_to(DOCS) else ROOT).with_suffix("").as_posix()


def blocks(page: Path, language: str) -> list[str]:
    return [code for kind, code in FENCE.findall(page.read_text(encoding="utf-8")) if kind == language]


def programs() -> Iterator[tuple[str, str]]:
    """Every Python program of the pages, with its name."""
    for page in PAGES:
        for number, code in enumerate(blocks(page, "python"), start=1):
            yield f"{name_of(page)}-{number}", code


def outputs() -> dict[str, str]:
    """The programs whose page shows what they print, and that output."""
    return {code: text for page in PAGES for code, text in SHOWN.findall(page.read_text(encoding="utf-8"))}


def run(*arguments: str, cwd: Path, timeout: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder, with a cache of its own; trailing spaces of the output are cut."""
    folders = dict.fromkeys(("XDG_CACHE_HOME", "XDG_STATE_HOME", "TMPDIR"), str(cwd))
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "100"} | folders,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        timeout=timeout,
        check=False,
    )
    done.stdout = "".join(f"{line.rstrip()}\n" for line in done.stdout.splitlines())
    return done


def run_program(code: str, cwd: Path) -> str:
    """Run a program; what it printed. It must end well, and complain of nothing."""
    done = run("-W", "error", "-c", code, cwd=cwd)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def run_command(command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    name, *words = shlex.split(command, comments=True)
    assert name == "paramclient"
    return run("-m", "paramclient", *words, cwd=cwd)


@cache
def anchors(page: Path) -> frozenset[str]:
    """The anchors of a page's headings, as GitHub and the pages' builder make them."""
    headings = re.compile(r"^#+ (.+)$", re.MULTILINE).findall(FENCE.sub("", page.read_text(encoding="utf-8")))
    return frozenset(re.sub(r"[^\w -]", "", each.lower()).replace(" ", "-") for each in headings)


def test_links_lead_somewhere() -> None:
    """Sphinx follows the links of the pages in `docs` only, and the README is not among them."""
    lost = []
    for page in PAGES:
        for target, anchor in LINK.findall(page.read_text(encoding="utf-8")):
            place = page.parent / target if target else page
            is_there = place.exists() and (not anchor or anchor in anchors(place))
            if not (is_there or target.startswith("https://")):
                lost.append(f"{name_of(page)}: {target}#{anchor}")
    assert lost == []


def test_every_page_is_in_the_table_of_contents() -> None:
    """For Sphinx, and as a link for readers of the sources."""
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    names = {name_of(page) for page in DOCUMENTED} - {"index"}
    assert names == set(re.findall(r"^([a-z-]+)$", index.partition(":hidden:")[2], re.MULTILINE))
    assert names <= set(re.findall(r"\(([a-z-]+)\.md\)", index.partition("\n## All pages\n")[2]))


def test_the_pages_are_few_and_short() -> None:
    """Nobody reads more, or finds a sentence again."""
    words = {name_of(page): len(page.read_text(encoding="utf-8").split()) for page in PAGES}
    assert words.pop("README") <= 1000
    assert words.pop("CHANGELOG") <= 1000
    assert len(words) <= 16
    assert words["internals"] <= 2500
    assert sum(words.values()) <= 25_000


def test_the_files_that_the_internals_name_exist() -> None:
    named = re.findall(r"`([\w/]+\.(?:py|toml|yml))`", (DOCS / "internals.md").read_text(encoding="utf-8"))
    assert len(named) > 30
    for each in named:
        assert (ROOT / each).exists() or any((ROOT / "paramclient").rglob(each)), each


def test_the_reference_is_that_of_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(DOCS)
    import reference

    for name in ("command", "json"):
        page = (DOCS / f"{name}.md").read_text(encoding="utf-8")
        assert page == reference.page(name), "run `make reference`"


def test_every_public_module_is_in_the_api() -> None:
    """Sphinx documents what `__all__` lists."""
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    named = set(re.findall(r"^\.\. automodule:: ([\w.]+)$", text, re.MULTILINE))
    rooms = [*(ROOT / "paramclient").glob("[a-z]*.py"), *(ROOT / "paramclient").glob("*/__init__.py")]
    public = {
        f"paramclient.{path.parent.name if path.stem == '__init__' else path.stem}"
        for path in rooms
        if "\n__all__ = " in path.read_text(encoding="utf-8")
    }
    assert named == {"paramclient"} | public - {"paramclient.cli", "paramclient.service"}
    for module, name in re.findall(r"^\.\. auto(?:class|function):: ([\w.]+)\.(\w+)$", text, re.MULTILINE):
        assert hasattr(import_module(module), name)


def test_make_knows_what_the_pages_say() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set()
    for page in PAGES:
        for code in [*re.findall(r"`(make [^`]+)`", page.read_text(encoding="utf-8")), *blocks(page, "sh")]:
            named |= set(re.findall(r"\bmake ([a-z-]+)", code))
    assert {"demo", "test"} <= named <= targets


@cache
def help_of(*words: str) -> str:
    """What the command prints about itself or a subcommand, in this process."""
    printed = io.StringIO()
    with mock.patch.dict(os.environ, COLUMNS="200"), redirect_stdout(printed):
        app.run([*words, "--help"])
    return printed.getvalue()


def subcommands(*words: str) -> Iterator[tuple[str, ...]]:
    """Every subcommand of the command, also those of groups such as `cache`."""
    if "COMMAND" not in help_of(*words).splitlines()[0]:
        yield words
        return
    for name in re.findall(r"^│ ([a-z][a-z-]*) ", help_of(*words), re.MULTILINE):
        yield from subcommands(*words, name)


def test_commands_in_the_pages_exist_with_their_options() -> None:
    known = set(subcommands())
    used = set()
    wrong = []
    for page in PAGES:
        for line in "".join(blocks(page, "sh")).splitlines():
            words = shlex.split(line, comments=True)[1:]
            if line.startswith("paramclient ") and not words[0].startswith("-"):
                names = [each for each in known if list(each) == words[: len(each)]]
                used.update(names)
                given = {word.partition("=")[0] for word in words if word.startswith("--")}
                if not names or not given <= set(re.findall(r"--[a-z][a-z-]+", help_of(*names[0]))):
                    wrong.append(f"{name_of(page)}: {line}")
    assert wrong == []
    assert used == known


def test_the_first_example_prints_what_its_comments_say(tmp_path: Path) -> None:
    (example,) = blocks(ROOT / "README.md", "python")
    assert run_program(example, tmp_path) == "903, MC_ROLL_P = 4.0, MC_ROLL_P = 6.0\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    "code", [pytest.param(code, id=name) for name, code in programs() if SITL not in code]
)
def test_a_program_runs_and_prints_what_its_page_shows(code: str, tmp_path: Path) -> None:
    printed = run_program(code, tmp_path)
    assert code not in outputs() or DURATION.sub("0.0 s", printed) == DURATION.sub("0.0 s", outputs()[code])


@pytest.mark.slow
def test_programs_are_typed(tmp_path: Path) -> None:
    files = [tmp_path / f"{re.sub('[^a-z0-9]', '_', name.lower())}.py" for name, _ in programs()]
    for file, (_, code) in zip(files, programs(), strict=True):
        file.write_text(code, encoding="utf-8")
    files += (ROOT / "examples").rglob("*.py")
    settings = ["--config-file", str(ROOT / "pyproject.toml"), "--cache-dir", str(ROOT / ".mypy_cache")]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *settings, "--no-error-summary", *map(str, files)],
        cwd=ROOT,
        capture_output=True,
        encoding="utf-8",
        timeout=300,
        check=False,
    )
    assert (done.stdout.replace(f"{tmp_path}/", ""), done.stderr) == ("", "")


def rows(output: str) -> list[list[str]]:
    """The words of each line, without times, and without counters, which the vehicle changes once in 30 s."""
    return [TIME.sub("TIME", line).split() for line in output.splitlines() if " skipped " not in line]


@pytest.mark.slow
def test_the_commands_for_users_of_other_programs_run(tmp_path: Path) -> None:
    """Each command of the tables, in the order of the page; each table has its own folder."""
    page = (DOCS / "coming-from.md").read_text(encoding="utf-8")
    for number, section in enumerate(page.split("\n## ")[1:]):
        folder = tmp_path / str(number)
        folder.mkdir()
        link = "sim:px4" if section.startswith("MAVSDK") else "sim:ardupilot"
        assert run_command(f"paramclient fetch {link} --tlog flight.tlog", folder).returncode == 0
        assert run_command(f"paramclient save {link} other.parm", folder).returncode == 0
        for command in re.findall(r"^\|[^|\n]*\| `(paramclient [^`|]*)`", section, re.MULTILINE):
            words = command.replace("LINK", link) + " --timeout 3" * (" watch " in command)
            done = run_command(words, folder)
            assert done.returncode == 0, command + done.stderr


@contextmanager
def simulating(vehicle: str, port: int, cwd: Path) -> Iterator[None]:
    """Run a simulated vehicle in a process of its own, which sends to a port of this computer."""
    with subprocess.Popen(
        [sys.executable, "-m", "paramclient", "sim", vehicle, "--link", f"udpout:127.0.0.1:{port}"],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            yield
        finally:
            process.terminate()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["index", "json", "metadata", "parameter-files", "vehicles"])
def test_the_commands_of_a_page_print_what_it_shows(name: str, tmp_path: Path) -> None:
    """In one folder, in the order of the page; on the first page with its vehicles, on another port.

    A command without a text below it prints nothing. Those that find differences exit with 1.
    """
    text, port = (DOCS / f"{name}.md").read_text(encoding="utf-8"), free_port()
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    for file, content in FILE_TO_WRITE.findall(text):
        (tmp_path / file).write_text(content, encoding="utf-8")
    with ExitStack() as vehicles:
        if name == "index":
            assert 'sim "px4?metadata=1&system=$number" --link udpout:127.0.0.1:14550' in text
            for number in "1234":
                vehicles.enter_context(simulating(f"px4?metadata=1&system={number}", port, tmp_path))
            for command in blocks(DOCS / "index.md", "sh")[0].splitlines():
                assert "1/1" in run_command(command.replace("14550", str(port)), tmp_path).stdout
        for command, output in RECIPE.findall(text):
            done = run_command(command.replace("14550", str(port)), tmp_path)
            assert done.returncode == int("diff " in command and output != ""), command + done.stderr
            assert rows(done.stdout) == rows(output), command + done.stderr


@pytest.mark.slow
def test_the_program_for_sitl_runs(tmp_path: Path) -> None:
    """With a simulated vehicle over UDP, on another port."""
    [program] = [code for code in blocks(DOCS / "testing.md", "python") if SITL in code]
    with simulating("px4", port := free_port(), tmp_path):
        run_program(program.replace("14550", str(port)), tmp_path)
