"""The README and the pages: their programs run, their links lead somewhere, and what they name exists."""

from __future__ import annotations

import ast
import inspect
import io
import json
import os
import re
import shlex
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TypeVar, get_origin
from unittest import mock

import pytest

import paramclient
import paramclient.diagnosis
import paramclient.links
import paramclient.metadata
import paramclient.provision
import paramclient.sim
import paramclient.sync
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

PUBLIC = [
    *(paramclient, paramclient.diagnosis, paramclient.links, paramclient.metadata, paramclient.provision),
    *(paramclient.sim, paramclient.sync, paramclient.testing),
]

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
COMMANDS += ["--install-completion", "reset", "apply", "verify", "restore", "import", "serve", "token"]

LINK = re.compile(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)")
SERVICE = "http://127.0.0.1:8765"
"""The address of a service in programs."""
SITL = "udpin:127.0.0.1:14550"
"""The link of SITL in `sitl.md`."""
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


def blocks(page: Path, language: str) -> list[str]:
    return [code for kind, code in FENCE.findall(page.read_text(encoding="utf-8")) if kind == language]


COMPARED = {
    "pymavlink": "sim:ardupilot",
    "MAVProxy": "sim:ardupilot",
    "MAVSDK": "sim:px4",
    "QGroundControl": "sim:ardupilot",
    "Mission Planner": "sim:ardupilot",
}
"""The programs that `coming-from.md` compares with, and the vehicle with which its tables are tried."""
ROW = re.compile(r"^\|([^|\n]*)\|([^|\n]*)\|([^|\n]*)\|$", re.MULTILINE)
CODE_SPAN = re.compile(r"`([^`]+)`")
TABLE_PROGRAM = """\
from paramclient import {names}
from paramclient.sync import {functions}

with ParamClient("{link}", cache=False) as client:
    vehicle = client.only_component()
    vehicle.fetch_all()
    for name in ("quad.param", "quad.parm", "quad.params"):
        write_file(name, ParamSet.of(vehicle.params.values(), system=1, component=1))
"""


def compared_with(program: str) -> list[tuple[list[str], list[str]]]:
    """Return the commands and the Python code of each row of a table of `coming-from.md`."""
    text = (DOCS / "coming-from.md").read_text(encoding="utf-8")
    section = text.partition(f"\n## {program}\n")[2].partition("\n## ")[0]
    return [
        (
            [each for each in CODE_SPAN.findall(command) if each.startswith("paramclient ")],
            [each for each in CODE_SPAN.findall(python) if re.search(r"\bvehicle\b", each)],
        )
        for _, command, python in ROW.findall(section)
    ]


def table_programs() -> Iterator[tuple[str, str]]:
    """Yield a program for each table of `coming-from.md`, with all code of its column *Python*."""
    for program, link in COMPARED.items():
        rows = [line for _, lines in compared_with(program) for line in lines]
        reads = any("read_file(" in line for line in rows)
        code = TABLE_PROGRAM.format(
            link=link,
            names="ParamSet, read_file, write_file" if reads else "ParamSet, write_file",
            functions="ParamClient, apply" if reads else "ParamClient",
        )
        for line in rows:
            is_expression = isinstance(ast.parse(line).body[0], ast.Expr)
            code += f"    print({line})\n" if is_expression else f"    {line}\n"
        yield f"coming-from-{program}", code


def programs() -> Iterator[tuple[str, str]]:
    """Every Python program of the pages, with its name."""
    for page in PAGES:
        for number, code in enumerate(blocks(page, "python"), start=1):
            yield f"{name_of(page)}-{number}", code
    yield from table_programs()


def needs_service(code: str) -> bool:
    """Return whether a program is a client of a service."""
    return SERVICE in code


def needs_vehicle(code: str) -> bool:
    """Return whether a program needs a vehicle that sends to a UDP port."""
    return f'ParamClient("{SITL}")' in code


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


SHOWN = re.compile(
    r"^```python\n((?:(?!```).*\n)*)```\n\n(?:It prints\b.*\n\n)?```text\n((?:(?!```).*\n)*)```$",
    re.MULTILINE,
)
"""A program, and the output that the page shows below it."""
DURATION = re.compile(r"\d+\.\d+ s\b")


def shown() -> Iterator[tuple[str, str, str]]:
    """Every program whose page shows its output: the page, the program, and that output."""
    for page in PAGES:
        for code, output in SHOWN.findall(page.read_text(encoding="utf-8")):
            yield name_of(page), code, output


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(code, id=name)
        for name, code in programs()
        if not needs_service(code)
        and not needs_vehicle(code)
        and code not in {each for _, each, _ in shown()}
    ],
)
def test_a_program_runs(program: str, tmp_path: Path) -> None:
    folders = {"XDG_CACHE_HOME": str(tmp_path), "XDG_STATE_HOME": str(tmp_path)}
    run("-W", "error", "-c", program, cwd=tmp_path, **folders)


@pytest.mark.parametrize(
    ("program", "output"), [pytest.param(code, output, id=name) for name, code, output in shown()]
)
def test_a_program_prints_what_the_page_shows(program: str, output: str, tmp_path: Path) -> None:
    folders = {"XDG_CACHE_HOME": str(tmp_path), "XDG_STATE_HOME": str(tmp_path)}
    printed = run("-W", "error", "-c", program, cwd=tmp_path, **folders)
    assert DURATION.sub("0.0 s", printed) == DURATION.sub("0.0 s", output)


def test_the_code_for_a_notebook_runs_with_await_at_the_top_level(tmp_path: Path) -> None:
    (cell,) = blocks(DOCS / "scripts.md", "py")
    program = (
        "import ast, asyncio\n"
        f"cell = compile({cell!r}, 'cell', 'exec', ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)\n"
        "asyncio.run(eval(cell))"
    )
    assert run("-W", "error", "-c", program, cwd=tmp_path) == "MC_ROLL_P = 4.0\n"


RECIPE = re.compile(r"^```sh\n(.*)\n```\n(?:\n```text\n((?:(?!```).*\n)*)```\n)?", re.MULTILINE)


def run_command(command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command of a page in a folder, with a cache of its own; trailing spaces of the output are cut."""
    name, *words = shlex.split(command)
    assert name == "paramclient"
    done = subprocess.run(
        [sys.executable, "-m", "paramclient", *words],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(cwd), "COLUMNS": "100"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        timeout=60,
        check=False,
    )
    done.stdout = "".join(f"{line.rstrip()}\n" for line in done.stdout.splitlines())
    return done


def test_the_commands_of_the_recipes_print_what_the_page_shows(tmp_path: Path) -> None:
    """In one folder, in the order of the page. A command without a text below it prints nothing."""
    page = (DOCS / "recipes.md").read_text(encoding="utf-8")
    found = RECIPE.findall(page)
    assert len(found) + len(blocks(DOCS / "recipes.md", "python")) == 24
    for command, output in found:
        done = run_command(command, tmp_path)
        assert (done.returncode, done.stdout) == (0, output), command + done.stderr


def test_the_quickstart_starts_from_the_cache_the_second_time(tmp_path: Path) -> None:
    """The first program, twice, in an empty folder with an empty cache."""
    program = blocks(DOCS / "quickstart.md", "python")[0]
    first, second = blocks(DOCS / "quickstart.md", "text")[:2]
    assert ("from stream" in first, "from cache" in second) == (True, True)
    for output in (first, second):
        printed = run("-c", program, cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"))
        assert DURATION.sub("0.0 s", printed) == DURATION.sub("0.0 s", output)


@pytest.mark.parametrize("program", COMPARED)
def test_the_commands_for_users_of_other_programs_run(program: str, tmp_path: Path) -> None:
    """Each command of the tables, in the order of the page, in one folder."""
    assert run_command(f"paramclient fetch {COMPARED[program]} --tlog flight.tlog", tmp_path).returncode == 0
    assert run_command(f"paramclient save {COMPARED[program]} other.parm", tmp_path).returncode == 0
    found = [command for commands, _ in compared_with(program) for command in commands]
    assert len(found) > 4
    for command in found:
        words = command.replace("LINK", COMPARED[program])
        done = run_command(f"{words} --timeout 1" if " watch " in words else words, tmp_path)
        assert done.returncode == 0, command + done.stderr


@contextmanager
def simulating(autopilot: str, link: str, cwd: Path, *options: str) -> Iterator[None]:
    """Run a simulated vehicle in a process of its own."""
    words = ["-m", "paramclient", "sim", autopilot, "--link", link, *options]
    with subprocess.Popen(
        [sys.executable, *words],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            yield
        finally:
            process.terminate()


TIME = re.compile(r"\d{4}-\d\d-\d\dT[\d:.]+(?:Z|[+-]\d\d:\d\d)")
FILE_TO_WRITE = re.compile(r"Write this to `([\w.]+)`:\n\n```text\n(.*?)```", re.DOTALL)


def written(output: str) -> list[list[str]]:
    """Return the rows of a table, without those of counters: the vehicle changes them once in 30 s."""
    return [line.split() for line in output.splitlines() if " skipped " not in line]


@pytest.mark.parametrize(("section", "autopilot"), [("PX4", "px4"), ("ArduPilot", "ardupilot")])
def test_the_commands_for_sitl_print_what_the_page_shows(
    section: str, autopilot: str, tmp_path: Path
) -> None:
    """With a simulated vehicle over UDP, on another port, instead of SITL."""
    page = (DOCS / "sitl.md").read_text(encoding="utf-8")
    text = page.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    (start,) = (line for line in blocks(DOCS / "sitl.md", "sh") if line.startswith("paramclient sim "))
    assert start == "paramclient sim px4 --link udpout:127.0.0.1:14550\n"
    for name, content in FILE_TO_WRITE.findall(text):
        (tmp_path / name).write_text(content, encoding="utf-8")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    found = RECIPE.findall(text)
    assert len(found) == len(re.findall("^```sh$", text, re.MULTILINE)) == 6
    with simulating(autopilot, f"udpout:127.0.0.1:{port}", tmp_path):
        for command, output in found:
            done = run_command(command.replace("14550", port), tmp_path)
            assert (done.returncode, written(done.stdout)) == (0, written(output)), command + done.stderr
        if autopilot == "px4":
            (program,) = blocks(DOCS / "sitl.md", "python")
            assert needs_vehicle(program)
            run(
                "-W",
                "error",
                "-c",
                program.replace("14550", port),
                cwd=tmp_path,
                XDG_CACHE_HOME=str(tmp_path),
            )


def test_the_first_steps_print_what_the_page_shows(tmp_path: Path) -> None:
    """With the four simulated vehicles of the page, on another port; `diff` and `fleet diff` exit with 1."""
    page = (DOCS / "first-steps.md").read_text(encoding="utf-8")
    assert "sim px4 --metadata --link udpout:127.0.0.1:14550 --system $number" in page
    for name, content in FILE_TO_WRITE.findall(page):
        (tmp_path / name).write_text(content, encoding="utf-8")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    found = RECIPE.findall(page)
    assert len(found) == len(re.findall("^```sh$", page, re.MULTILINE)) - 1 == 11
    with ExitStack() as vehicles:
        for number in "1234":
            options = ["--metadata", "--system", number]
            vehicles.enter_context(simulating("px4", f"udpout:127.0.0.1:{port}", tmp_path, *options))
        for command in blocks(DOCS / "first-steps.md", "sh")[0].splitlines():
            done = run_command(command.replace("14550", port), tmp_path)
            assert (done.returncode, "1/1" in done.stdout) == (0, True), command + done.stderr
        for command, output in found:
            done = run_command(command.replace("14550", port), tmp_path)
            assert done.returncode == int("diff " in command), command + done.stderr
            rows, shown_rows = (written(TIME.sub("TIME", text)) for text in (done.stdout, output))
            assert rows == shown_rows, command + done.stderr


def test_the_pages_show_the_output_of_their_programs() -> None:
    assert {"quickstart", "sync", "setup", "extended", "recipes", "coming-from"} <= {
        name for name, _, _ in shown()
    }


def test_the_programs_over_a_service_run(tmp_path: Path) -> None:
    found = [code for _, code in programs() if needs_service(code)]
    assert found
    with serving("sim:px4", "--no-cache", cwd=tmp_path) as address:
        for code in found:
            run("-W", "error", "-c", code.replace(SERVICE, address), cwd=tmp_path)


def write_programs(folder: Path) -> None:
    for name, code in programs():
        file = folder / f"{re.sub(r'[^a-z0-9]', '_', name.lower())}.py"
        file.write_text(code, encoding="utf-8")


@pytest.mark.skipif(find_spec("basedpyright") is None, reason="basedpyright is not installed")
def test_pyright_accepts_the_programs(tmp_path: Path) -> None:
    write_programs(tmp_path)
    settings = {
        "extraPaths": [str(ROOT), *(path for path in sys.path if path.endswith("site-packages"))],
        "pythonVersion": "3.11",
        "typeCheckingMode": "strict",
    }
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "basedpyright", str(tmp_path)],
        cwd=tmp_path,
        capture_output=True,
        encoding="utf-8",
        timeout=300,
        check=False,
    )
    assert done.stdout.replace(f"{tmp_path}/", "") == "0 errors, 0 warnings, 0 notes\n", done.stderr


def test_programs_are_typed(tmp_path: Path) -> None:
    write_programs(tmp_path)
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


@pytest.mark.parametrize("module", PUBLIC, ids=lambda m: m.__name__)
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


MADE_BY_THE_LIBRARY = {
    *("CachedComponent.of", "ClientStats.of"),
    *("Changes.push", "Events.push", "ExtChanges.push", "SimVehicle.__init__"),
    *("ParamCache.save", "ParamCache.merge", "ParamCache.save_ext"),
}
"""Functions of public classes that only the library calls."""
PASSED_BY_THE_LIBRARY = {"ClientThread"}
"""Types of the first argument of blocking classes, which only the library creates."""


def annotations_of(kind: type) -> Iterator[tuple[str, str, str]]:
    """Yield name, annotation and module of the public attributes, arguments and results of a class."""
    for base in kind.__mro__:
        if base.__module__.startswith("paramclient"):
            for name, text in vars(base).get("__annotations__", {}).items():
                yield name, str(text), base.__module__
            for name, member in vars(base).items():
                function = member.fget if isinstance(member, property) else member
                function = getattr(function, "__func__", function)
                for text in getattr(function, "__annotations__", {}).values():
                    yield name, str(text), base.__module__


def find_type(word: str, module: str) -> object:
    """Return what a name in an annotation denotes; None for one that no loaded module of ours has."""
    found: object = sys.modules[module]
    for part in word.split("."):
        found = getattr(found, part, None)
    if found is None:
        ours = [each for name, each in sys.modules.items() if name.startswith("paramclient")]
        found = next((vars(each)[word] for each in ours if word in vars(each)), None)
    return found


def is_of_the_library(found: object) -> bool:
    """Return whether a type is a class or an alias of the library."""
    if isinstance(found, TypeVar) or found is None:
        return False
    return get_origin(found) is not None or getattr(found, "__module__", "").startswith("paramclient")


@pytest.mark.parametrize("module", PUBLIC, ids=lambda m: m.__name__)
def test_every_type_in_a_public_signature_is_public(module: ModuleType) -> None:
    public = {name for each in PUBLIC for name in each.__all__}
    hidden = set()
    for name in module.__all__:
        member = getattr(module, name)
        reported = annotations_of(member) if isinstance(member, type) else []
        if inspect.isfunction(member):
            reported = [("", str(text), member.__module__) for text in member.__annotations__.values()]
        for attribute, text, place in reported:
            where = f"{name}.{attribute}".rstrip(".")
            if (attribute.startswith("_") and attribute != "__init__") or where in MADE_BY_THE_LIBRARY:
                continue
            words = re.findall(r"[A-Za-z_][\w.]*", re.sub(r"Literal\[[^]]*\]", "", text))
            hidden |= {
                (where, word)
                for word in words
                if word.rpartition(".")[2] not in public | PASSED_BY_THE_LIBRARY
                and is_of_the_library(find_type(word, place))
            }
    assert hidden == set()


def test_the_package_shows_public_names_only() -> None:
    assert dir(paramclient) == sorted(paramclient.__all__)


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
    return words[:2] if words[0] in ("cache", "fleet", "metadata", "signing") else words[:1]


WRITES = {"set", "set_many", "reset", "reboot", "setup_signing", "write"}
"""Methods that change a vehicle."""


def writes_to_the_first(code: str) -> list[str]:
    """Return the calls of a program that change the vehicle of a `component()` without an address."""
    events: list[tuple[int, str, bool]] = []
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            is_first = any(
                isinstance(each, ast.Call)
                and isinstance(each.func, ast.Attribute)
                and each.func.attr == "component"
                and not each.args
                and {"system", "component", "peer"}.isdisjoint(word.arg or "" for word in each.keywords)
                for each in ast.walk(node.value)
            )
            events.append((node.lineno, node.targets[0].id, is_first))
    found = []
    for node in ast.walk(ast.parse(code)):
        if not isinstance(node, ast.Call):
            continue
        target: ast.expr | None = None
        if isinstance(node.func, ast.Attribute) and node.func.attr in WRITES:
            target = node.func.value
        elif isinstance(node.func, ast.Name) and node.func.id in ("apply", "restore") and node.args:
            target = node.args[0]
        if isinstance(target, ast.Name):
            bound = [is_first for line, name, is_first in events if name == target.id and line <= node.lineno]
            if bound and bound[-1]:
                found.append(ast.unparse(node))
    return found


@pytest.mark.parametrize(
    "code",
    [pytest.param(code, id=name) for name, code in programs()]
    + [
        pytest.param(path.read_text(encoding="utf-8"), id=path.name)
        for path in sorted((ROOT / "examples").rglob("*.py"))
    ],
)
def test_programs_that_write_refuse_to_choose_among_several_vehicles(code: str) -> None:
    assert not writes_to_the_first(code)


def test_a_write_to_the_first_vehicle_is_found() -> None:
    first = "vehicle = await client.component(timeout=3)"
    program = "async def main():\n    {}\n    await vehicle.set('A', 1)\n"
    assert writes_to_the_first(program.format(first)) == ["vehicle.set('A', 1)"]
    assert not writes_to_the_first(program.format(first.replace("component(", "only_component(")))
    assert not writes_to_the_first(program.format(first.replace("timeout", "system")))


def test_every_command_is_shown_and_exists() -> None:
    used = {tuple(subcommand(words)) for words in commands()}
    cache = {("cache", verb) for verb in ("list", "history", "path", "add", "name", "remove", "copy")}
    fleet = {("fleet", "diff")}
    signing = {("signing", verb) for verb in ("setup", "disable")}
    metadata = {("metadata", verb) for verb in ("add", "list", "remove")}
    assert used == {(verb,) for verb in COMMANDS} | cache | fleet | signing | metadata
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
    for verb in ("list", "history", "path", "add", "name", "remove", "copy"):
        offered |= set(re.findall(r"--[a-z][a-z-]+", help_of("cache", verb)))
    offered |= set(re.findall(r"--[a-z][a-z-]+", help_of("fleet", "diff")))
    for verb in ("add", "list", "remove"):
        offered |= set(re.findall(r"--[a-z][a-z-]+", help_of("metadata", verb)))
    named = set(re.findall(r"`(--[a-z][a-z-]+)", page))
    assert named - {"--help"} == offered - {"--help", "--version"}
