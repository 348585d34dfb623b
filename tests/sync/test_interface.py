"""The blocking classes have the calls of the asynchronous ones, with the same arguments."""

from __future__ import annotations

import inspect
import subprocess
import sys
from dataclasses import fields, is_dataclass
from typing import Any

import pytest

import paramclient
import paramclient.diagnosis
import paramclient.metadata
import paramclient.provision
import paramclient.sync
from paramclient.client.subscription import Subscription
from tests.sync_interface import BLOCKING, Call, blocking_source

NAMES = {"aclose": "close", "__aenter__": "__enter__", "__aexit__": "__exit__"}
"""Calls that have another name."""

BY_LOOPS = {"__aiter__", "__anext__", "push", "end"}
"""What a loop needs of a stream, or the client itself."""


FUNCTIONS = {
    name: getattr(module, name)
    for module in (paramclient.provision, paramclient.metadata, paramclient.diagnosis)
    for name in module.__all__
    if inspect.iscoroutinefunction(getattr(module, name))
}
"""The asynchronous functions that take a client or a component."""


def test_the_blocking_classes_are_as_generated() -> None:
    assert BLOCKING.read_text(encoding="utf-8") == blocking_source(), "run `make sync`"


def test_every_asynchronous_class_has_a_blocking_one() -> None:
    """Classes with calls to await, streams, and what holds a component."""
    offered = {name: getattr(paramclient, name) for name in paramclient.__all__}
    classes = {name: thing for name, thing in offered.items() if inspect.isclass(thing)}
    asynchronous = {
        name
        for name, thing in classes.items()
        if any(map(inspect.iscoroutinefunction, list(vars(thing).values())))
        or issubclass(thing, Subscription)
        or (is_dataclass(thing) and "Component" in {each.type for each in fields(thing)})
    }
    others = {"Event", "FetchIterator", "Wanted", *FUNCTIONS}
    assert asynchronous | others == set(paramclient.sync.__all__)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_asynchronous_function_has_a_blocking_one(name: str) -> None:
    ours, theirs = getattr(paramclient.sync, name), FUNCTIONS[name]
    assert not inspect.iscoroutinefunction(ours)
    assert ours.__doc__
    ours, theirs = inspect.signature(ours), inspect.signature(theirs)
    assert [(each.name, each.kind, each.default) for each in ours.parameters.values()] == [
        (each.name, each.kind, each.default) for each in theirs.parameters.values()
    ]
    assert {each.name: each.annotation for each in ours.parameters.values()} == {
        each.name: each.annotation for each in theirs.parameters.values()
    }
    assert ours.return_annotation == theirs.return_annotation


def test_the_functions_are_imported_at_their_first_use() -> None:
    program = "import sys, paramclient.sync; print('paramclient.provision' in sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert run.stdout.strip() == "False"


def test_every_call_has_the_same_arguments() -> None:
    for name in paramclient.sync.__all__:
        if name in {"Event", "FetchIterator", "Wanted", *FUNCTIONS}:
            continue
        asynchronous, blocking = getattr(paramclient, name), getattr(paramclient.sync, name)
        if is_dataclass(asynchronous):
            assert [(each.name, each.type) for each in fields(asynchronous)] == [
                (each.name, each.type) for each in fields(blocking)
            ]
            continue
        for member in {"__init__", "__aenter__", "__aexit__", *public(asynchronous)} & dir_of(asynchronous):
            ours, theirs = getattr(blocking, NAMES.get(member, member)), getattr(asynchronous, member)
            if inspect.isfunction(theirs) and member != "__init__":
                assert inspect.signature(ours) == inspect.signature(theirs), f"{name}.{member}"
            elif name == "ParamClient":
                assert callable(ours) == callable(theirs), f"{name}.{member}"
    assert inspect.signature(paramclient.sync.ParamClient) == inspect.signature(paramclient.ParamClient)


def test_the_iterator_of_a_fetch_has_the_arguments_of_the_call() -> None:
    wanted = inspect.signature(paramclient.sync.Component.fetch_all).parameters
    ours = inspect.signature(paramclient.sync.FetchIterator).parameters
    assert {**ours, "self": None}.keys() - {"component"} == wanted.keys() - {"progress"}
    for name in ours.keys() - {"component"}:
        assert (ours[name].default, ours[name].kind) == (wanted[name].default, wanted[name].kind)
        assert ours[name].annotation == wanted[name].annotation


def public(kind: Any) -> set[str]:
    return {name for name in vars(kind) if not name.startswith("_")} - BY_LOOPS


def dir_of(kind: Any) -> set[str]:
    return set(dir(kind))


@pytest.mark.parametrize(
    ("call", "lines"),
    [
        (Call("f", ["a", "b"]), ["    return f(a, b)"]),
        (Call("f", ["a" * 60, "b" * 39]), ["    return f(", f"        {'a' * 60}, {'b' * 39}", "    )"]),
        (
            Call("f", ["a" * 60, "b" * 60]),
            ["    return f(", f"        {'a' * 60},", f"        {'b' * 60},", "    )"],
        ),
        (
            Call("f", [Call("partial", ["a" * 60, "b" * 31]), "c"]),
            [
                "    return f(",
                "        partial(",
                f"            {'a' * 60}, {'b' * 31}",
                "        ),",
                "        c,",
                "    )",
            ],
        ),
    ],
)
def test_calls_are_laid_out_as_ruff_does(call: Call, lines: list[str]) -> None:
    assert call.laid_out(4, "return ", "") == lines
