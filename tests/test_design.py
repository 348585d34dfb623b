"""The rules that keep the rooms apart, read from the source: which room may import which, what the core may
touch."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from graphlib import TopologicalSorter
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "paramclient"

LOW = {"errors", "version"}
CORE = {"errors", "model", "protocol.wire"}
MACHINES = CORE | {
    "protocol.stats",
    *("protocol.addresses", "protocol.requests"),
    *("protocol.ftp", "protocol.ftp.packets", "protocol.ftp.param_pck"),
}
PROTOCOL = MACHINES | {
    "protocol",
    "protocol.params",
    "protocol.ext",
    "protocol.vehicle",
    "protocol.stats",
    "protocol.scheduler",
}
SHELL = LOW | PROTOCOL | {"links", "cache", "client"}

MAY_IMPORT = {
    "errors": set[str](),
    "version": set[str](),
    "model": {"errors"},
    "protocol.wire": {"errors", "model"},
    "protocol.addresses": set[str](),
    "protocol.requests": CORE | {"protocol.stats"},
    "protocol.scheduler": {"protocol.requests"},
    "protocol.ftp.packets": {"errors", "model"},
    "protocol.ftp.param_pck": {"errors", "model"},
    "protocol.ftp": MACHINES,
    "protocol.stats": CORE,
    "protocol.params": MACHINES | {"protocol.scheduler", "protocol.vehicle"},
    "protocol.ext": MACHINES | {"protocol.params"},
    "protocol.vehicle": CORE | {"protocol.requests", "protocol.addresses"},
    "protocol": PROTOCOL,
    "sim": CORE | {"protocol.ftp.packets", "protocol.ftp.param_pck"},
    "links": {"errors", "model", "protocol.wire", "sim"},
    "cache": {"errors", "model"},
    "files": {"errors", "model", "protocol.ftp.param_pck"},
    "client": SHELL | {"remote", "sim"},
    "remote": SHELL | {"documents"},
    "sync": SHELL | {"sim", "metadata", "diagnosis", "provision"},
    "metadata": SHELL,
    "provision.apply_rules": {"errors", "model"},
    "provision.planning": {"errors", "model", "provision.apply_rules"},
    "provision": SHELL | {"files", "provision.planning", "provision.apply_rules"},
    "logs": SHELL | {"files"},
    "diagnosis": SHELL | {"metadata"},
    "testing": {"errors", "sim"},
    "documents": SHELL | {"files", "metadata", "provision", "provision.planning", "logs", "diagnosis"},
    "": SHELL | {"files"},
}
"""Which other rooms a room may import; the longest name that fits a module counts. The empty name is the
public face. What is not named, command and service, may import all of these, and none of these imports it."""

PURE = ("errors", "model", "protocol", "sim", "provision.planning")
"""Rooms without input and output: time and bytes are arguments."""

IMPURE_MODULES = {
    *("anyio", "asyncio", "trio", "sniffio", "concurrent", "multiprocessing", "threading", "queue", "sched"),
    *("socket", "socketserver", "select", "selectors", "ssl", "http", "urllib", "serialx", "serial"),
    *("time", "calendar", "zoneinfo", "signal"),
    *("os", "io", "pathlib", "shutil", "tempfile", "glob", "fileinput", "sqlite3", "dbm", "mmap", "fcntl"),
    *("subprocess", "platform", "platformdirs", "getpass", "secrets", "uuid", "pydantic"),
}
IMPURE_CALLS = {"open", "input", "print", "exec", "eval", "__import__"}
CLOCKS = {"datetime.now", "datetime.today", "datetime.utcnow", "date.today"}

COMMAND = ("cli", "__main__")
SERVICE = "service"
SERVICE_LIBRARIES = {"fastapi", "prometheus_client", "starlette", "uvicorn", "websockets"}
COMMAND_LIBRARIES = {"rich", "cyclopts"}


@dataclass(frozen=True)
class Import:
    """One module that another imports. `runs_at_import` is false inside functions and for types only."""

    module: str
    names: tuple[str, ...]
    runs_at_import: bool
    for_types_only: bool
    line: int

    @property
    def top(self) -> str:
        return self.module.split(".", 1)[0]


MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
EVERY_MODULE = pytest.mark.parametrize("module", MODULES)


@cache
def source_of(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text(encoding="utf-8"), filename=str(MODULES[module]))


@cache
def imports_of(module: str) -> tuple[Import, ...]:
    return tuple(walk_imports(source_of(module)))


def walk_imports(node: ast.AST, *, at_import: bool = True, for_types: bool = False) -> Iterator[Import]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            for alias in child.names:
                yield Import(alias.name, (), at_import and not for_types, for_types, child.lineno)
        elif isinstance(child, ast.ImportFrom):
            names = tuple(alias.name for alias in child.names)
            origin = "." * child.level + (child.module or "")
            yield Import(origin, names, at_import and not for_types, for_types, child.lineno)
        elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            yield from walk_imports(child, at_import=at_import, for_types=True)
        else:
            inside = at_import and not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from walk_imports(child, at_import=inside, for_types=for_types)


def own_imports_of(module: str) -> Iterator[tuple[str, Import]]:
    """The package's own modules that one imports: `from package import module` counts as the module."""
    for each in imports_of(module):
        if each.top == "paramclient":
            submodules = [f"{each.module}.{name}" for name in each.names]
            targets = {name if name in MODULES else each.module for name in submodules} or {each.module}
            for target in targets:
                yield target, each


def room_of(module: str) -> str:
    """The longest entry of the table that the module belongs to, or its name inside the package."""
    name = module.removeprefix("paramclient").removeprefix(".")
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        if (room := ".".join(parts[:length])) in MAY_IMPORT:
            return room
    return name


def is_pure(module: str) -> bool:
    room = room_of(module)
    return room in PURE or room.split(".")[0] in PURE


def is_command(module: str) -> bool:
    return room_of(module).split(".")[0] in COMMAND


@EVERY_MODULE
def test_imports_are_absolute_and_point_one_way(module: str) -> None:
    assert all(each.top for each in imports_of(module))
    room = room_of(module)
    for target, each in own_imports_of(module):
        where = f"{module}:{each.line} imports {target}"
        if room in MAY_IMPORT:
            assert room_of(target) in MAY_IMPORT[room] | {room}, where
        elif not is_command(module):
            assert not is_command(target), where


def test_no_module_imports_itself_through_others() -> None:
    """Imports of types count, and those inside of functions."""
    graph = {
        module: {target for target, _ in own_imports_of(module) if target != module} for module in MODULES
    }
    TopologicalSorter(graph).prepare()


COUNTERPARTS = {
    "app": "the application: of the command line, of the service",
    "apply": "the set-up of a vehicle: the command, its route",
    "ardupilot": "what is ArduPilot's: its metadata, its simulated vehicle",
    "check": "the check of a vehicle: the command and its document",
    "client": "the client: over a link, over a service",
    "component": "a component: for users, over a service, on the wire, as a document",
    "change": "a change: of a parameter, of an extended one",
    "diff": "the comparison: the command and its document",
    "events": "events: on the wire, for users, over HTTP",
    "extended": "extended parameters: on the wire, in the command",
    "fetch": "a fetch: of parameters, of extended ones",
    "fleet": "several vehicles: in the cache, as a command, as a document, in a set-up",
    "formats": "the format of a file, recognized by its content: parameters, metadata",
    "history": "the history: the command, its document, its route",
    "link": "a link: bytes, the command, its document, over a service, in the service",
    "metadata": "metadata: the command, the route, of simulated vehicles",
    "param_pck": "the packed parameter file: its bytes, as a format of parameter files",
    "params": "parameters: plain data, the route",
    "paramset": "a set of parameters: plain data, its document",
    "passive": "what others request: files over MAVFTP, tables",
    "ports": "serial ports: the list, the command",
    "problems": "errors of the service: reported by it, raised by its client",
    "px4": "what is PX4's: its metadata, its simulated vehicle",
    "reads": "reads: of parameters, of extended ones",
    "results": "results: of a set-up, as documents, printed",
    "signing": "MAVLink signing: frames, keys of a client, the command",
    "table": "the table: of parameters, of extended ones",
    "traffic": "traffic on a link: counted, as a document",
    "write_batch": "many writes: of parameters, of extended ones",
    "writes": "writes: of parameters, of extended ones",
}
"""Names of modules that stand in several rooms, and of what each is the room's part."""


def test_no_two_modules_share_a_name_but_counterparts() -> None:
    rooms: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        if path.stem != "__init__":
            rooms.setdefault(path.stem, []).append(module.rpartition(".")[0])
    assert {name for name, places in rooms.items() if len(places) > 1} == COUNTERPARTS.keys()
    assert all(len(places) == len(set(places)) for places in rooms.values())


SAME_NAME_CONSTANTS = {"MIGRATIONS": "the schema of each store"}
"""Constants of one name with different values, and the reason."""

SAME_NAME_CLASSES = {
    "ParamInfo": "the metadata of a parameter, and what a plan needs of it (a Protocol)",
    **dict.fromkeys(
        [
            *("ParamClient", "Component", "ExtParams", "Ftp", "Events", "Changes", "ExtChanges"),
            *("Discovered", "Lost", "Found", "Rebooted", "Resynced", "Contested", "Uncontested"),
        ],
        "asynchronous, and blocking",
    ),
}
"""Classes of one name, and the reason."""


def names_with_several_contents(public: Iterator[tuple[str, str]]) -> set[str]:
    contents: dict[str, set[str]] = {}
    for name, content in public:
        if not is_private(name):
            contents.setdefault(name, set()).add(content)
    return {name for name, found in contents.items() if len(found) > 1}


def statements_outside_the_service() -> Iterator[tuple[str, ast.stmt]]:
    for module in MODULES:
        if room_of(module).split(".")[0] != SERVICE:
            yield from ((module, node) for node in source_of(module).body)


def constants() -> Iterator[tuple[str, str]]:
    """The name and the value of each constant."""
    for _, node in statements_outside_the_service():
        match node:
            case (
                ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value)
                | ast.Assign(targets=[ast.Name(id=name)], value=value)
            ) if name.isupper():
                yield name, ast.unparse(value)


def classes() -> Iterator[tuple[str, str]]:
    """The name and the module of each class."""
    for module, node in statements_outside_the_service():
        if isinstance(node, ast.ClassDef):
            yield node.name, module


def test_no_two_constants_of_one_name_have_different_values() -> None:
    assert names_with_several_contents(constants()) == SAME_NAME_CONSTANTS.keys()


def test_no_two_classes_share_a_name_but_counterparts() -> None:
    assert names_with_several_contents(classes()) == SAME_NAME_CLASSES.keys()


NAMEDTUPLE_METHODS = {"_make", "_replace", "_asdict", "_fields"}
"""Names that begin with an underscore and are public nevertheless, so that no field can have them."""


def own_names_of(source: ast.Module) -> set[str]:
    """The names that a module gives to functions, classes, variables and attributes."""
    names = set[str]()
    for node in ast.walk(source):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                names.add(node.name)
            case ast.Attribute(ctx=ast.Store()):
                names.add(node.attr)
            case ast.Name(ctx=ast.Store()):
                names.add(node.id)
    return names


def private_names_in(source: ast.Module) -> Iterator[tuple[str, int]]:
    """The names of other modules that begin with one underscore, and the lines on which they are used.

    Those of a base class are its subclasses' too, for themselves: `self._x`.
    """
    own = own_names_of(source) | NAMEDTUPLE_METHODS
    for node in ast.walk(source):
        match node:
            case ast.ImportFrom(names=aliases):
                yield from ((alias.name, node.lineno) for alias in aliases if is_private(alias.name))
            case ast.Attribute(value=ast.Name(id="self" | "cls")):
                continue
            case ast.Attribute(attr=name) if is_private(name) and name not in own:
                yield name, node.lineno


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


@EVERY_MODULE
def test_no_module_uses_the_private_names_of_another(module: str) -> None:
    """What the package needs of a component beyond its public calls is in `client.local`."""
    assert list(private_names_in(source_of(module))) == []


@pytest.mark.parametrize(
    ("program", "found"),
    [
        ("def f(other): return other._x", ["_x"]),
        ("def f(other): return other.part._x.y", ["_x"]),
        ("from other import _x", ["_x"]),
        ("class C:\n    def f(self): return self.other._x", ["_x"]),
        ("class C:\n    def f(self): return self._x", []),
        ("class C:\n    def f(self, other): self._x = other._x", []),
        ("def f(other): return other.__class__, other._replace()", []),
    ],
)
def test_private_names_are_found(program: str, found: list[str]) -> None:
    assert [name for name, _ in private_names_in(ast.parse(program))] == found


def test_the_simulators_load_only_with_a_simulated_link() -> None:
    for module in MODULES:
        if not is_pure(module) and not is_command(module) and module != "paramclient.testing":
            for target, each in own_imports_of(module):
                assert not (each.runs_at_import and room_of(target) == "sim"), f"{module}:{each.line}"


def test_few_modules_know_an_event_loop_by_name() -> None:
    """The library runs on trio too: see `tests/client/test_backends.py`. uvicorn runs on asyncio alone, and
    so do serial ports on Windows. anyio cannot start a task that belongs to no other task."""
    loops = {"asyncio", "trio"}
    uses = {module for module in MODULES for each in imports_of(module) if each.top in loops}
    assert {module for module in uses if not is_command(module)} == {
        "paramclient.client.client_task",
        "paramclient.links.serial_transport",
        "paramclient.service.connections",
    }


def test_only_the_remote_client_knows_httpx() -> None:
    for module in MODULES:
        if not module.startswith("paramclient.remote"):
            assert not {"httpx", "httpx_sse"} & {each.top for each in imports_of(module)}, module


def test_only_the_client_chooses_the_remote_one() -> None:
    uses = {
        module
        for module in MODULES
        for target, _ in own_imports_of(module)
        if room_of(target).startswith("remote") and not room_of(module).startswith("remote")
    }
    assert uses == {"paramclient.client.client"}


RETRY_WORDS = re.compile(r"ATTEMPTS|RETRY|BACKOFF|COPIES")


def constants_of(module: str) -> set[str]:
    return {
        node.target.id
        for node in source_of(module).body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }


def test_to_change_a_retry_rule_is_to_change_one_module() -> None:
    """The scheduler repeats no requests: it tries again to run more lists in parallel."""
    core = {module for module in MODULES if module.startswith("paramclient.protocol.")}
    rules = {module for module in core if any(map(RETRY_WORDS.search, constants_of(module)))}
    assert rules - {"paramclient.protocol.scheduler"} == {"paramclient.protocol.requests.retry"}


def test_one_module_requests_messages() -> None:
    core = {module for module in MODULES if module.startswith("paramclient.protocol.")}
    uses = {
        module for module in core for each in imports_of(module) if "MAV_CMD_REQUEST_MESSAGE" in each.names
    }
    assert uses - {"paramclient.protocol.wire"} == {"paramclient.protocol.vehicle.commands"}


def test_only_the_wire_and_the_reader_of_dataflash_logs_use_pymavlink() -> None:
    uses = {
        (module, each.module) for module in MODULES for each in imports_of(module) if each.top == "pymavlink"
    }
    assert uses == {
        ("paramclient.protocol.wire.frames", "pymavlink.dialects.v20"),
        ("paramclient.logs.dataflash", "pymavlink.DFReader"),
    }


@pytest.mark.parametrize("module", [module for module in MODULES if is_pure(module)])
def test_the_core_touches_nothing_outside(module: str) -> None:
    for each in imports_of(module):
        assert each.top not in IMPURE_MODULES, f"{module}:{each.line} imports {each.module}"
    for node in ast.walk(source_of(module)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in IMPURE_CALLS, f"{module}:{node.lineno} calls {node.func.id}"
        if isinstance(node, ast.Attribute):
            assert ast.unparse(node) not in CLOCKS, f"{module}:{node.lineno} reads the clock"


@pytest.mark.parametrize("module", [module for module in MODULES if is_pure(module)])
def test_randomness_of_the_core_is_seeded(module: str) -> None:
    for each in imports_of(module):
        if each.module == "random":
            assert set(each.names) <= {"Random"}, f"{module}:{each.line}"
    for node in ast.walk(source_of(module)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "random":
            assert node.attr == "Random", f"{module}:{node.lineno} uses random.{node.attr}"
        if isinstance(node, ast.Call) and ast.unparse(node.func) in {"random.Random", "Random"}:
            assert node.args or node.keywords, f"{module}:{node.lineno}: Random() without a seed"


@EVERY_MODULE
def test_only_the_command_loads_its_libraries(module: str) -> None:
    for each in imports_of(module):
        if each.top in COMMAND_LIBRARIES:
            assert is_command(module), f"{module}:{each.line} imports {each.module}"


@EVERY_MODULE
def test_only_the_service_loads_its_libraries(module: str) -> None:
    """And only the command knows the service, which it imports when it is to serve."""
    is_service = room_of(module).split(".")[0] == SERVICE
    for each in imports_of(module):
        if each.top in SERVICE_LIBRARIES:
            assert is_service, f"{module}:{each.line} imports {each.module}"
    for target, each in own_imports_of(module):
        if room_of(target).split(".")[0] == SERVICE and not is_service:
            assert is_command(module), f"{module}:{each.line} imports {target}"
            assert not each.runs_at_import, f"{module}:{each.line} imports {target}"


@EVERY_MODULE
def test_every_module_says_what_it_is(module: str) -> None:
    assert ast.get_docstring(source_of(module))


@pytest.mark.parametrize("package", [name for name, path in MODULES.items() if path.stem == "__init__"])
def test_every_package_names_what_is_in_it(package: str) -> None:
    inside = {name.rpartition(".")[2] for name in MODULES if name.rpartition(".")[0] == package}
    reported = ast.get_docstring(source_of(package)) or ""
    assert {name for name in inside if not name.startswith("_")} <= set(re.findall(r"`(\w+)`", reported))


@EVERY_MODULE
def test_the_names_in_all_exist_once(module: str) -> None:
    """`__all__`, where there is one, is a plain list without repetitions, of names that the module binds."""
    offered = offers_of(module)
    bound = bound_names(source_of(module))
    assert len(offered) == len(set(offered))
    assert set(offered) <= bound or "__getattr__" in bound


def test_the_package_offers_what_it_imports_and_nothing_else() -> None:
    source = source_of("paramclient")
    offered = offers_of("paramclient")
    assert "__version__" in offered
    imported = {
        alias.asname or alias.name
        for block in source.body
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert len(imported) > 100
    assert imported <= set(offered)

    import paramclient

    assert sorted(paramclient.__all__) == sorted(offered)
    for name in offered:
        assert getattr(paramclient, name) is not None


def offers_of(module: str) -> list[str]:
    for node in source_of(module).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            names: list[str] = ast.literal_eval(node.value)
            return names
    return []


def bound_names(source: ast.Module) -> set[str]:
    """The names that a module binds at its top, also for types only."""
    names: set[str] = set()
    blocks = [node.body for node in source.body if isinstance(node, ast.If)]
    for node in [*source.body, *chain.from_iterable(blocks)]:
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                names.add(node.name)
            case ast.Import() | ast.ImportFrom():
                names.update(alias.asname or alias.name for alias in node.names)
            case ast.Assign(targets=targets):
                names.update(ast.unparse(target) for target in targets)
            case ast.AnnAssign(target=target):
                names.add(ast.unparse(target))
    return names


def test_importing_the_package_loads_nothing_that_only_some_need() -> None:
    """Start-up is part of the command's promise; mavutil, besides, changes the process that imports it."""
    unwanted = [
        "rich",
        "cyclopts",
        "pydantic",
        "serialx",
        "yaml",
        "pymavlink.mavutil",
        "psycopg",
        "psycopg_pool",
    ]
    unwanted += ["paramclient.sim", "paramclient.testing", "paramclient.cli", "paramclient.provision"]
    unwanted += ["paramclient.documents", "paramclient.service", "fastapi", "starlette", "uvicorn", "httpx"]
    unwanted += ["filelock", "prometheus_client", "httpx_sse"]
    unwanted += ["paramclient.remote", "paramclient.sync"]
    loaded = f"[name for name in {unwanted!r} if name in sys.modules]"
    program = f"import sys; from paramclient import *; print({loaded})"
    run = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True, timeout=60
    )
    assert run.stdout.strip() == "[]"


def test_the_version_stands_in_one_place() -> None:
    from paramclient.version import __version__

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "version" not in project["project"]
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["hatch"]["version"]["path"] == "paramclient/version.py"
    for module in MODULES:
        for node in ast.walk(source_of(module)):
            if isinstance(node, ast.Constant) and node.value == __version__:
                assert module == "paramclient.version", f"{module}:{node.lineno} repeats the version"
