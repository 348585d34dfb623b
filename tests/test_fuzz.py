"""What a fuzzer has found, played again: the inputs in `fuzz/`, through the same functions."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest

from fuzz import component

ROOT = Path(__file__).parent.parent
FUZZ = ROOT / "fuzz"
TARGETS = ("component", "files", "framer", "metadata", "pack", "signing", "tlog")


def target(name: str) -> Callable[[bytes], None]:
    run: Callable[[bytes], None] = importlib.import_module(f"fuzz.{name}").run
    return run


def inputs(kind: str, name: str) -> list[Path]:
    return sorted(path for path in (FUZZ / kind / name).glob("*") if path.is_file())


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_no_input_of_the_corpus_finds_a_fault(name: str) -> None:
    """The corpus, all of it in one test: each input takes a millisecond."""
    run = target(name)
    kept = inputs("corpus", name)
    assert kept
    for path in kept:
        try:
            run(path.read_bytes())
        except Exception as error:
            raise AssertionError(f"{path.relative_to(ROOT)} finds a fault") from error


ANY = (b"", b"\0", b"\xff" * 40, bytes(range(256)))
FOUND = [
    pytest.param(name, path.read_bytes(), id=path.name)
    for name in TARGETS
    for path in inputs("findings", name)
]


@pytest.mark.parametrize(("name", "data"), [*FOUND, *((name, data) for name in TARGETS for data in ANY)])
def test_inputs_that_once_found_a_fault_find_none_now_nor_does_any_input(name: str, data: bytes) -> None:
    target(name)(data)


def test_a_fault_is_found() -> None:
    """Without a limit of the library, an input of the corpus fails: the harness looks at what it should."""
    inputs_of_corpus = [path.read_bytes() for path in inputs("corpus", "component")]
    with mock.patch.object(component, "BOUNDS", component.BOUNDS[1:]), pytest.raises(ExceptionGroup):
        any(target("component")(data) for data in inputs_of_corpus)


def test_every_target_is_tested_and_its_corpus_is_small() -> None:
    rooms = {path.stem for path in FUZZ.glob("*.py")} - {"__init__", "__main__", "draw", "keep"}
    assert rooms == set(TARGETS)
    assert {path.name for path in (FUZZ / "corpus").iterdir()} == set(TARGETS)
    # each test run reads them all
    assert sum(path.stat().st_size for path in FUZZ.rglob("*") if path.is_file()) < 300_000
