"""What the command that serves does for the process that it has alone."""

from __future__ import annotations

import gc

import pytest

from paramclient.cli import serve as serve_room
from paramclient.cli.serve import FEW_COMPONENTS, Collections


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
    assert after(range(FEW_COMPONENTS - 1)) == []
    assert after(range(FEW_COMPONENTS)) == ["freeze"]
    assert after(range(2 * FEW_COMPONENTS - 1)) == []
    assert after(range(2 * FEW_COMPONENTS)) == ["freeze"]
    assert after(range(1, 2 * FEW_COMPONENTS)) == []
    assert after(range(FEW_COMPONENTS, 2 * FEW_COMPONENTS)) == ["unfreeze"]
    assert after(range(2 * FEW_COMPONENTS)) == [], "what was forgotten is not collected yet"
    collections += 1
    assert after(range(2 * FEW_COMPONENTS)) == ["freeze"]
    assert after(range(2 * FEW_COMPONENTS)) == []


def test_full_collections_are_counted() -> None:
    before = serve_room._full_collections()
    gc.collect()
    assert serve_room._full_collections() > before
