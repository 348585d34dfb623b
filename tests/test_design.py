"""Rules of the design, read from the source: imports of rooms, what the core touches, names, start-up.

Each test lists all offenders.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.test_docs import ROOT, run

MODEL = {"errors", "model"}
PROTOCOL = MODEL | {"wire", "protocol"}
SHELL = PROTOCOL | {"version", "links", "cache", "client"}
MAY_IMPORT = {
    "errors": set[str](),
    "version": set[str](),
    "model": {"errors"},
    "wire": MODEL,
    "protocol": PROTOCOL,
    "sim": PROTOCOL,
    "links": MODEL | {"wire", "sim"},
    "cache": MODEL,
    "files": PROTOCOL,
    "metadata": SHELL | {"files"},
    "client": SHELL | {"sim"},
    "provision": SHELL | {"files", "metadata", "logs"},
    "logs": SHELL | {"files", "metadata"},
    "sync": SHELL | {"sim", "metadata", "provision"},
    "testing": {"errors", "sim"},
    "": SHELL | {"files"},
}
"""The rooms that a room may import. The empty name is the public face. The command and the service, which are
not named, may import all of these, and none of these imports them."""

PURE = ("errors", "model", "wire", "protocol", "sim")
"""Rooms without input and output: time and bytes are arguments, or the event loop's time."""
IMPURE_MODULES = {
    *("asyncio", "trio", "sniffio", "concurrent", "multiprocessing", "threading", "queue", "sched"),
    *("socket", "socketserver", "select", "selectors", "ssl", "http", "urllib", "serialx", "serial"),
    *("time", "calendar", "zoneinfo", "signal", "uuid", "pydantic"),
    *("os", "io", "pathlib", "shutil", "tempfile", "glob", "fileinput", "sqlite3", "dbm", "mmap", "fcntl"),
    *("subprocess", "platform", "platformdirs", "getpass", "secrets"),
}
IMPURE_CALLS = {"open", "input", "print", "exec", "eval", "__import__"}
CLOCKS = {"datetime.now", "datetime.today", "datetime.utcnow", "date.today"}

LIBRARIES = {
    "pymavlink": ("wire.frames", "logs"),
    "anyio": ("protocol", "client", "links", "provision", "metadata", "logs", "service", "cli"),
    "asyncio": ("cli", "__main__", "service", "client", "links"),
    "trio": ("client",),
    "serialx": ("links",),
    "psycopg": ("cache",),
    "pyulog": ("logs",),
    "httpx": (),
    **dict.fromkeys(["rich", "cyclopts"], ("cli", "__main__")),
    **dict.fromkeys(["fastapi", "starlette", "uvicorn", "websockets"], ("service",)),
}
"""The rooms or modules that may import a library: few know an event loop."""

SHARED_NAMES = {*("ParamClient", "Component", "Events", "Changes", "ParamInfo"), *("Stream", "ParamSet")}
"""Constants and classes that may have one name in two modules: blocking twins, an event of a component and
the public one, a message and a set of parameters."""

COMMAND = ("cli", "__main__")
JSON = {"cli.json_output"}
"""What the command prints and the service sends."""

MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((ROOT / "paramclient").rglob("*.py"))
}


class Import(NamedTuple):
    """A module that another imports. `runs_at_import` is false inside functions and for types only."""

    module: str
    names: tuple[str, ...]
    runs_at_import: bool
    place: str

    @property
    def top(self) -> str:
        return self.module.split(".", 1)[0]


@cache
def source_of(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


@cache
def imports_of(module: str) -> tuple[Import, ...]:
    def walk(node: ast.AST, runs: bool) -> Iterator[Import]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                for alias in child.names:
                    yield Import(alias.name, (), runs, f"{module}:{child.lineno}")
            elif isinstance(child, ast.ImportFrom):
                origin = "." * child.level + (child.module or "")
                names = tuple(alias.name for alias in child.names)
                yield Import(origin, names, runs, f"{module}:{child.lineno}")
            else:
                is_later = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) or (
                    isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
                )
                yield from walk(child, runs and not is_later)

    return tuple(walk(source_of(module), runs=True))


def all_imports() -> Iterator[tuple[str, Import]]:
    return ((module, each) for module in MODULES for each in imports_of(module))


def own_imports() -> Iterator[tuple[str, str, Import]]:
    """The package's own modules that one imports: `from package import module` counts as the module."""
    for module, each in all_imports():
        if each.top == "paramclient":
            submodules = [f"{each.module}.{name}" for name in each.names]
            for target in {name if name in MODULES else each.module for name in submodules} or {each.module}:
                yield module, target, each


def inside(module: str) -> str:
    return module.removeprefix("paramclient").removeprefix(".")


def is_in(module: str, rooms: tuple[str, ...] | set[str]) -> bool:
    """Whether a module is one of these, or inside one of these rooms."""
    return any(inside(module) == room or (room and inside(module).startswith(f"{room}.")) for room in rooms)


def test_imports_are_absolute_and_public_and_point_one_way() -> None:
    """Linting finds relative ones, and private names of objects."""
    offenders = [each.place for _, each in all_imports() if any(map(is_private, each.names))]
    for module, target, each in own_imports():
        room = max((room for room in MAY_IMPORT if is_in(module, {room})), key=len, default=None)
        if room is None:
            allowed = is_in(module, COMMAND) or not is_in(target, COMMAND)
            allowed = allowed or (is_in(module, {"service"}) and is_in(target, JSON))
        else:
            allowed = is_in(target, MAY_IMPORT[room] | {room})
        if not allowed:
            offenders.append(f"{each.place} imports {target}")
    assert offenders == []


def test_no_module_imports_itself_through_others() -> None:
    """Imports of types count, and those inside functions."""
    graph: dict[str, set[str]] = {module: set() for module in MODULES}
    for module, target, _ in own_imports():
        if target != module:
            graph[module].add(target)
    TopologicalSorter(graph).prepare()


def test_libraries_are_imported_where_they_belong() -> None:
    """Few modules know an event loop by name: the library runs on trio too."""
    assert [
        f"{each.place} imports {each.module}"
        for module, each in all_imports()
        if each.top in LIBRARIES and not is_in(module, LIBRARIES[each.top])
    ] == []


def test_the_core_touches_nothing_outside() -> None:
    """Time and bytes are arguments, and randomness has a seed."""
    offenders = []
    for module in filter(lambda module: is_in(module, PURE), MODULES):
        offenders += [
            f"{each.place} imports {each.module}"
            for each in imports_of(module)
            if (each.top in IMPURE_MODULES and each.top != "anyio")
            or (each.top == "random" and set(each.names) - {"Random"})
        ]
        for node in ast.walk(source_of(module)):
            match node:
                case ast.Call(func=ast.Name(id=name)) if name in IMPURE_CALLS:
                    offenders.append(f"{module}:{node.lineno} calls {name}")
                case ast.Attribute(value=ast.Name(id="random"), attr=name) if name != "Random":
                    offenders.append(f"{module}:{node.lineno} uses random.{name}")
                case ast.Call(args=[], keywords=[]) if ast.unparse(node.func) in {"random.Random", "Random"}:
                    offenders.append(f"{module}:{node.lineno}: Random() without a seed")
                case ast.Attribute() if ast.unparse(node) in CLOCKS:
                    offenders.append(f"{module}:{node.lineno} reads the clock")
    assert offenders == []


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name != "_"


def test_no_test_uses_a_private_name_of_the_package() -> None:
    """As text, such as for `monkeypatch`; linting finds the others."""
    private = {
        name for module in MODULES for name in re.findall(r"\b_[a-z]\w+", ast.unparse(source_of(module)))
    }
    for path in sorted((ROOT / "tests").rglob("*.py")):
        assert private.isdisjoint(re.findall(r"['\"](_\w+)['\"]", path.read_text(encoding="utf-8"))), path


def test_one_name_has_one_meaning() -> None:
    """No two constants of one name have different values, no two classes share a name."""
    contents: dict[str, dict[str, str]] = defaultdict(dict)
    for module in filter(lambda module: not is_in(module, {"service"}), MODULES):
        for node in source_of(module).body:
            match node:
                case ast.ClassDef(name=name):
                    contents[name][module] = module
                case (
                    ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value)
                    | ast.Assign(targets=[ast.Name(id=name)], value=value)
                ) if name.isupper():
                    contents[name].setdefault(ast.unparse(value), module)
    assert {
        name: sorted(found.values())
        for name, found in contents.items()
        if len(found) > 1 and not is_private(name) and name not in SHARED_NAMES
    } == {}


ON_USE = {"paramclient.sim", "paramclient.service", "rich"}
UNUSED = ON_USE | {f"paramclient.{room}" for room in ("testing", "cli", "provision", "sync")}
UNUSED |= {"pymavlink.mavutil", "pydantic", *LIBRARIES} - {"pymavlink", "asyncio", "anyio"}


@pytest.mark.parametrize(
    ("start", "unwanted"),
    [
        ("from paramclient import *", UNUSED),
        ("import paramclient.sync, paramclient.provision, paramclient.logs", ON_USE),
        ("import paramclient.cli", ON_USE),
    ],
)
def test_importing_loads_nothing_that_only_some_need(start: str, unwanted: set[str], tmp_path: Path) -> None:
    """Start-up is part of the command's promise; mavutil, besides, changes the process that imports it."""
    program = f"import sys; {start}; print(sorted({unwanted!r} & sys.modules.keys()))"
    assert run("-c", program, cwd=tmp_path).stdout == "[]\n"
