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
from paramclient.model import paramset

STUB = Path(__file__).parent.parent / "paramclient" / "sync.pyi"

CLASSES: dict[ModuleType, list[str]] = {
    component: ["Component"],
    paramset: ["AnyParams"],
    streams: ["Changes"],
    client: ["Event", "Events", "ParamClient"],
}
FUNCTIONS: list[Callable[..., object]] = [
    *(provision.plan, provision.apply, provision.restore, provision.for_each),
    metadata.metadata_of,
]
OWN = {name for names in CLASSES.values() for name in names} | {each.__name__ for each in FUNCTIONS}
MEMBERS = {
    "Component": "system: int; component: int; is_extended: bool; params: ParamMap",
    "ParamClient": """
link: Link; cache: ParamCache | None; listens_only: bool
def __enter__(self) -> Self: ...
def __exit__(self, *error: object) -> None: ...
def open(self) -> Self: ...
def close(self) -> None: ...
""",
    **{
        name: f"""
def __next__(self) -> {item}: ...
def next(self, timeout: float | None = None) -> {item}: ...
"""
        for name, item in {"Changes": "Change", "Events": "Event"}.items()
    },
}
"""Members that the blocking classes have for themselves, or that `__init__` sets."""
INTERNAL = {"join_vehicle", "limited", "load", "vehicle", "wait_for_cache", "wait_until_identified"}
"""Methods for other modules of the asynchronous client."""
GENERIC = {
    "Self": "from typing import Self",
    "Iterator": "from collections.abc import Iterator",
    "dataclass": "from dataclasses import dataclass",
}


def without_await(node: ast.FunctionDef | ast.AsyncFunctionDef) -> ast.FunctionDef:
    """A function without its body, and without `async`."""
    (made,) = ast.parse(f"def {node.name}(): ...").body
    assert isinstance(made, ast.FunctionDef)
    made.args, made.decorator_list, made.returns = node.args, node.decorator_list, node.returns
    if first := ast.get_docstring(node):
        made.body = [ast.Expr(ast.Constant(first.split("\n")[0]))]
    return made


def blocking(node: ast.stmt) -> ast.stmt:
    """A class, or a function, as the caller of the blocking client sees it."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return without_await(node)
    if isinstance(node, ast.ClassDef):
        members: list[ast.stmt] = [ast.Expr(ast.Constant((ast.get_docstring(node) or "").splitlines()[0]))]
        if node.decorator_list:
            members += [each for each in node.body if isinstance(each, ast.AnnAssign)]
        members += ast.parse(MEMBERS.get(node.name, "")).body
        own = "__init__" if node.name == "ParamClient" else ""
        is_stream = node.name in ("Changes", "Events")
        for each in () if is_stream else node.body:
            if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef):
                is_public = each.name == own or not each.name.startswith("_")
                if is_public and each.name not in {"aclose", "open", "push"} | INTERNAL:
                    members.append(without_await(each))
        if is_stream:
            node.bases = [ast.parse(f"Iterator[{node.name.removesuffix('s')}]", mode="eval").body]
        node.body = members
    return node


def imports_of(module: ModuleType) -> dict[str, str]:
    """The names that a module imports or defines, each with the import of it."""
    found: dict[str, str] = {}
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        match node:
            case ast.ImportFrom() | ast.Import():
                origin = f"from {node.module} " if isinstance(node, ast.ImportFrom) else ""
                found |= {each.asname or each.name: f"{origin}import {each.name}" for each in node.names}
            case (
                ast.ClassDef(name=name)
                | ast.AnnAssign(target=ast.Name(id=name))
                | ast.Assign(targets=[ast.Name(id=name)])
            ) if name[0].isupper():
                found[name] = f"from {module.__name__} import {name}"
    return found


def stub() -> str:
    """The whole stub, before it is formatted."""
    parts: list[ast.stmt] = []
    known = dict(GENERIC)
    for module, names in CLASSES.items():
        known = imports_of(module) | known
        for node in ast.parse(inspect.getsource(module)).body:
            target = getattr(node, "name", None) or ast.unparse(getattr(node, "target", ast.Constant(0)))
            parts += [blocking(node)] if target in names else []
    for function in FUNCTIONS:
        known = imports_of(sys.modules[function.__module__]) | known
        parts += map(blocking, ast.parse(inspect.getsource(function)).body)
    text = "\n\n".join(ast.unparse(ast.fix_missing_locations(each)) for each in parts)
    text = text.replace("Awaitable[Outcome]", "Outcome")
    used = {each.id for each in ast.walk(ast.parse(text)) if isinstance(each, ast.Name)}
    imports = sorted({known[name] for name in used & known.keys() - OWN})
    head = ['"""The types of the blocking client. `make sync` writes this file."""', *imports]
    return "\n".join([*head, f"__all__ = {sorted(OWN)}", text]) + "\n"


def meaning(text: str) -> tuple[set[str], list[str]]:
    """What a stub imports, and its other statements in order, whatever its form."""
    body = ast.parse(text).body
    imports = [node for node in body if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {f"{getattr(node, 'module', '')} {each.name}" for node in imports for each in node.names}
    return names, [ast.dump(node) for node in body if node not in imports]


def write() -> None:
    """Write the stub in the form of the project's code."""
    text = stub()
    for step in (["check", "--fix", "--select", "I"], ["format"]):
        command = [sys.executable, "-m", "ruff", *step, "--quiet", "--stdin-filename", str(STUB), "-"]
        text = subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout
    STUB.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write()
