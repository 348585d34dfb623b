"""Full garbage collections of a process that serves skip the components that are followed."""

from __future__ import annotations

import gc

import pytest

from paramclient.service import garbage_collection
from paramclient.service.garbage_collection import COLLECTED_COMPONENTS_MAX, ComponentFreezer


def test_collections_go_through_no_components_that_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    collections = 0
    monkeypatch.setattr(gc, "freeze", lambda: calls.append("freeze"))
    monkeypatch.setattr(gc, "unfreeze", lambda: calls.append("unfreeze"))
    monkeypatch.setattr(garbage_collection, "_full_collections", lambda: collections)

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
    assert after(range(COLLECTED_COMPONENTS_MAX, 2 * COLLECTED_COMPONENTS_MAX)) == ["unfreeze"]
    assert after(range(2 * COLLECTED_COMPONENTS_MAX)) == [], "what was forgotten is not collected yet"
    collections += 1
    assert after(range(2 * COLLECTED_COMPONENTS_MAX)) == ["freeze"]
    assert after(range(2 * COLLECTED_COMPONENTS_MAX)) == []


def test_full_collections_are_counted() -> None:
    before = garbage_collection._full_collections()
    gc.collect()
    assert garbage_collection._full_collections() > before
