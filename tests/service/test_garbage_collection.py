"""Full garbage collections of a process that serves wait for an idle moment, and skip followed components."""

from __future__ import annotations

import asyncio
import gc
import weakref
from collections.abc import Iterator

import pytest

from paramclient.service.garbage_collection import (
    COLLECTED_COMPONENTS_MAX,
    COLLECTIONS_WHEN_BUSY,
    COLLECTIONS_WHEN_IDLE,
    GarbageCollection,
)
from tests.shell import in_simulated_time


def test_collections_go_through_no_components_that_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    for name in ("freeze", "unfreeze"):
        monkeypatch.setattr(gc, name, lambda name=name: calls.append(name))
    monkeypatch.setattr(gc, "collect", lambda generation=2: calls.append(f"collect {generation}"))

    def after(followed: range) -> list[str]:
        calls.clear()
        garbage.check(set(followed), is_busy=True)
        return calls

    garbage = GarbageCollection()
    assert after(range(COLLECTED_COMPONENTS_MAX - 1)) == []
    assert after(range(COLLECTED_COMPONENTS_MAX)) == ["collect 1", "freeze"]
    assert after(range(2 * COLLECTED_COMPONENTS_MAX - 1)) == []
    assert after(range(2 * COLLECTED_COMPONENTS_MAX)) == ["collect 1", "freeze"]
    assert after(range(1, 2 * COLLECTED_COMPONENTS_MAX)) == []
    assert after(range(COLLECTED_COMPONENTS_MAX, 2 * COLLECTED_COMPONENTS_MAX)) == [
        "unfreeze",
        "collect 2",
        "freeze",
    ]
    assert after(range(2 * COLLECTED_COMPONENTS_MAX)) == ["collect 1", "freeze"]
    assert after(range(2 * COLLECTED_COMPONENTS_MAX)) == []


@pytest.mark.parametrize(
    ("collections", "is_busy", "collects"),
    [
        (COLLECTIONS_WHEN_IDLE, False, True),
        (COLLECTIONS_WHEN_IDLE, True, False),
        (COLLECTIONS_WHEN_IDLE - 1, False, False),
    ],
)
def test_a_full_collection_waits_until_no_request_is_in_progress(
    monkeypatch: pytest.MonkeyPatch, collections: int, is_busy: bool, collects: bool
) -> None:
    calls: list[str] = []
    monkeypatch.setattr(gc, "collect", lambda: calls.append("collect"))
    monkeypatch.setattr(gc, "get_count", lambda: (0, 0, collections))
    GarbageCollection().check(set(), is_busy=is_busy)
    assert calls == ["collect"] * collects


@in_simulated_time
async def test_python_starts_full_collections_late_and_as_before_afterwards() -> None:
    before = gc.get_threshold()
    task = asyncio.create_task(GarbageCollection().run(lambda: (), lambda: True))
    await asyncio.sleep(0)
    assert gc.get_threshold() == (*before[:2], COLLECTIONS_WHEN_BUSY)
    task.cancel()
    await asyncio.wait([task])
    assert gc.get_threshold() == before


class Cycle:
    def __init__(self) -> None:
        self.itself = self


@pytest.fixture
def collection() -> Iterator[GarbageCollection]:
    yield GarbageCollection()
    gc.unfreeze()


def test_memory_of_forgotten_components_is_freed(collection: GarbageCollection) -> None:
    """A system that sends many addresses replaces them all the time, while others are frozen."""
    living: list[weakref.ref[Cycle]] = []
    for _ in range(20):
        followed = {Cycle() for _ in range(COLLECTED_COMPONENTS_MAX)}
        living += [weakref.ref(each) for each in followed]
        collection.check(set(followed), is_busy=True)
    del followed
    assert sum(each() is not None for each in living) <= COLLECTED_COMPONENTS_MAX
