"""What the command that serves does for the process that it has alone."""

from __future__ import annotations

import gc

import pytest

from paramclient.cli import serve as serve_room
from paramclient.cli.serve import COLLECTED_COMPONENTS_MAX, Collections


def test_collections_go_through_no_components_that_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    collections = 0
    monkeypatch.setattr(gc, "freeze", lambda: calls.append("freeze"))
    monkeypatch.setattr(gc, "unfreeze", lambda: calls.append("unfreeze"))
    monkeypatch.setattr(serve_room, "_full_collections", lambda: collections)

    def after(followed: range) -> list[str]:
        calls.clear()
        sparing.look(set(followed))
        return calls

    sparing = Collections()
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
    before = serve_room._full_collections()
    gc.collect()
    assert serve_room._full_collections() > before
