"""The types of the blocking client, written from the asynchronous one (`make sync`)."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

from paramclient import metadata, provision
from paramclient.client import client, component, streams
from paramclient.provision import inspection

STUB = Path(__file__).parent.parent / "paramclient" / "sync.pyi"

CLASSES: dict[ModuleType, list[str]] = {
    component: ["Component"],
    inspection: ["Wanted"],
    streams: ["Changes"],
    client: ["Event", "Events", "ParamClient"],
}
FUNCTIONS: list[Callable[..., object]] = [
    *(provision.plan, provision.apply, provision.restore, provision.for_each),
    metadata.metadata_of,
]
STREAMS = {"Changes": "Change", "Events": "Event"}
OWN = {name for names in CLASSES.values() for name in names} | {each.__name__ for each in FUNCTIONS}
ATTRIBUTES = {
    "Component": ("system: int", "component: int", "is_extended: bool", "params: ParamMap"),
    "ParamClient": ("link: Link", "cache: ParamCache | None", "listens_only: bool"),
}
"""The public attributes that `__init__` sets."""
INTERNAL = {"join_vehicle", "limited", "load", "vehicle", "wait_for_cache", "wait_until_identified"}
"""Methods for other modules of the asynchronous client."""


def without_await(node: ast.FunctionDef | ast.AsyncFunctionDef) -> ast.FunctionDef:
    """A function without its body, and without `async`."""
    made = ast.parse(f"def {node.name}(): ...").body[0]
    assert isinstance(made, ast.FunctionDef)
    made.args, made.decorator_list, made.returns = node.args, node.decorator_list, node.returns
    if first := ast.get_docstring(node):
        made.body = [ast.Expr(ast.Constant(first.split("\n")[0]))]
    return made


def public_methods(node: ast.ClassDef) -> list[ast.stmt]:
    return [
        without_await(each)
        for each in node.body
        if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)
        and (not each.name.startswith("_") or (each.name == "__init__" and node.name == "ParamClient"))
        and each.name not in {"aclose", "open", "push"} | INTERNAL
    ]


def blocking_class(node: ast.ClassDef) -> str:
    """The class as the caller of the blocking client sees it."""
    head = ast.get_docstring(node) or ""
    lines = [f"class {node.name}:", f"    {head.splitlines()[0]!r}"]
    if node.name in STREAMS:
        item = STREAMS[node.name]
        lines[0] = f"class {node.name}(Iterator[{item}]):"
        lines += [
            f"    def __next__(self) -> {item}: ...",
            f"    def next(self, timeout: float | None = None) -> {item}: ...",
        ]
        return "\n".join(lines)
    if node.decorator_list:
        lines.insert(0, "@dataclass(frozen=True, slots=True)")
        lines += [f"    {ast.unparse(each)}" for each in node.body if isinstance(each, ast.AnnAssign)]
    lines += [f"    {each}" for each in ATTRIBUTES.get(node.name, ())]
    if node.name == "ParamClient":
        lines += [
            "    def __enter__(self) -> Self: ...",
            "    def __exit__(self, *error: object) -> None: ...",
            "    def open(self) -> Self: ...",
            "    def close(self) -> None: ...",
        ]
    for method in public_methods(node):
        lines += [f"    {line}" for line in ast.unparse(ast.fix_missing_locations(method)).splitlines()]
    return "\n".join(lines)


def imports_of(module: ModuleType) -> dict[str, str]:
    """The names that a module imports or defines, each with the import of it."""
    found: dict[str, str] = {}
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.ImportFrom):
            found |= {
                each.asname or each.name: f"from {node.module} import {each.name}" for each in node.names
            }
        if isinstance(node, ast.Import):
            found |= {each.name: f"import {each.name}" for each in node.names}
        if isinstance(node, ast.ClassDef):
            found[node.name] = f"from {module.__name__} import {node.name}"
        if isinstance(node, ast.AnnAssign | ast.Assign):
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            if isinstance(target, ast.Name) and target.id[0].isupper():
                found[target.id] = f"from {module.__name__} import {target.id}"
    return found


def stub() -> str:
    """The whole stub, before it is formatted."""
    parts: list[str] = []
    known: dict[str, str] = {}
    for module, names in CLASSES.items():
        known |= imports_of(module)
        for node in ast.parse(inspect.getsource(module)).body:
            if isinstance(node, ast.ClassDef) and node.name in names:
                parts.append(blocking_class(node))
            if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) in names:
                parts.append(ast.unparse(node))
    for function in FUNCTIONS:
        module = sys.modules[function.__module__]
        known |= imports_of(module)
        (node,) = ast.parse(inspect.getsource(function)).body
        assert isinstance(node, ast.AsyncFunctionDef)
        parts.append(ast.unparse(ast.fix_missing_locations(without_await(node))))
    text = "\n\n".join(parts).replace("Awaitable[Outcome]", "Outcome")
    known |= {
        "Self": "from typing import Self",
        "Iterator": "from collections.abc import Iterator",
        "dataclass": "from dataclasses import dataclass",
    }
    used = {each.id for each in ast.walk(ast.parse(text)) if isinstance(each, ast.Name)}
    imports = sorted({known[name] for name in used & known.keys() - OWN})
    listed = ", ".join(f'"{name}"' for name in sorted(OWN))
    head = ['"""The types of the blocking client. `make sync` writes this file."""', *imports]
    return "\n".join([*head, f"__all__ = [{listed}]", text]) + "\n"


def meaning(text: str) -> tuple[set[str], list[str]]:
    """What a stub imports, and its other statements in order, whatever its form."""
    body = ast.parse(text).body
    imports = [node for node in body if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {
        f"{getattr(node, 'module', '')}.{alias.name} as {alias.asname}"
        for node in imports
        for alias in node.names
    }
    return names, [ast.dump(node) for node in body if node not in imports]


def write() -> None:
    """Write the stub in the form of the project's code."""
    text = stub()
    steps: list[list[str]] = [["check", "--fix", "--select", "I"], ["format"]]
    for step in steps:
        command = [sys.executable, "-m", "ruff", *step, "--quiet", "--stdin-filename", str(STUB), "-"]
        text = subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout
    STUB.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write()
