"""Full garbage collections of a process that serves skip the components that are followed."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

from paramclient.service.garbage_collection import COLLECTED_COMPONENTS_MAX, ComponentFreezer


def test_collections_go_through_no_components_that_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    for name in ("freeze", "unfreeze", "collect"):
        monkeypatch.setattr(gc, name, lambda name=name: calls.append(name))

    def after(followed: range) -> list[str]:
        calls.clear()
        freezer.check(set(followed))
        return calls

    freezer = ComponentFreezer()
    assert after(range(COLLECTED_COMPONENTS_MAX - 1)) == []
    assert after(range(COLLECTED_COMPONENTS_MAX)) == ["freeze"]
    assert after(range(2 * COLLECTED_COMPONENTS_MAX - 1)) == []
    assert after(range(2 * COLLECTED_COMPONENTS_MAX)) == ["freeze"]
    assert after(range(1, 2 * COLLECTED_COMPONENTS_MAX)) == []
    assert after(range(COLLECTED_COMPONENTS_MAX, 2 * COLLECTED_COMPONENTS_MAX)) == [
        "unfreeze",
        "collect",
        "freeze",
    ]
    assert after(range(2 * COLLECTED_COMPONENTS_MAX)) == ["freeze"]
    assert after(range(2 * COLLECTED_COMPONENTS_MAX)) == []


class Cycle:
    def __init__(self) -> None:
        self.itself = self


@pytest.fixture
def fresh_freezer() -> Iterator[ComponentFreezer]:
    yield ComponentFreezer()
    gc.unfreeze()


def test_memory_of_forgotten_components_is_freed(fresh_freezer: ComponentFreezer) -> None:
    """A system that sends many addresses replaces them all the time, while others are frozen."""
    living: list[weakref.ref[Cycle]] = []
    for _ in range(20):
        followed = {Cycle() for _ in range(COLLECTED_COMPONENTS_MAX)}
        living += [weakref.ref(each) for each in followed]
        fresh_freezer.check(set(followed))
    del followed
    assert sum(each() is not None for each in living) <= COLLECTED_COMPONENTS_MAX
