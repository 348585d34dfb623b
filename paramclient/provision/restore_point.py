"""The state before the last `apply` in the cache: its snapshot, changes since then, a restore since then."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from paramclient.errors import NotInCache, UnknownVehicle
from paramclient.model.paramset import ParamSet
from paramclient.provision.apply_restore import BEFORE_RESTORE
from paramclient.provision.vehicle_params import BEFORE_APPLY

if TYPE_CHECKING:
    from paramclient.cache import HistoryEntry, ParamCache, SnapshotSummary

__all__ = ["RestorePoint", "load_restore_point", "load_state_before_apply"]


@dataclass(frozen=True, slots=True)
class RestorePoint:
    """The state of a component before the last `apply`.

    Attributes:
        snapshot: the snapshot that `apply` stored.
        state: its parameters.
        changes: the latest change of each parameter that has another value in the cache than in `state`,
            newest first, as far as the history has them. They are those of the `apply` and later ones, of all
            authors.
        restored: the newest snapshot that a `restore` has stored since then; None if there is none.
    """

    snapshot: SnapshotSummary
    state: ParamSet
    changes: Sequence[HistoryEntry]
    restored: SnapshotSummary | None


def load_state_before_apply(cache: ParamCache, key: str, component: int) -> ParamSet:
    """Return the state that the cache stored of a component before the latest `apply`.

    Args:
        cache: the cache.
        key: `Identity.key` of the vehicle.
        component: component id.

    Raises:
        CacheError: the cache has no snapshot from before an `apply`.
    """
    return cache.state_at(key, component, _point_of(_snapshots(cache, key, component), key).id)


def load_restore_point(cache: ParamCache, key: str, component: int) -> RestorePoint:
    """Return the state before the latest `apply`, and what happened after it.

    Arguments and errors as of `load_state_before_apply`.
    """
    snapshots = _snapshots(cache, key, component)
    snapshot = _point_of(snapshots, key)
    try:
        state = cache.state_at(key, component, snapshot.id)
        table = cache.load(key, component)
        entries = cache.history(key, component)
    except UnknownVehicle:  # removed from the cache since the line above
        raise _none(key) from None
    restores = [each for each in snapshots if each.reason == BEFORE_RESTORE and each.id > snapshot.id]
    now = {} if table is None else table.params
    latest = {entry.name: entry for entry in entries}  # of several entries of a name, the last one
    changes = [
        entry
        for name, entry in reversed(latest.items())
        if name in now and name in state and now[name].settable != state[name].settable
    ]
    changes.sort(key=lambda entry: entry.at, reverse=True)
    return RestorePoint(snapshot, state, changes, restores[-1] if restores else None)


def _snapshots(cache: ParamCache, key: str, component: int) -> Sequence[SnapshotSummary]:
    try:
        return cache.snapshots(key, component)
    except UnknownVehicle:
        return ()


def _point_of(snapshots: Iterable[SnapshotSummary], key: str) -> SnapshotSummary:
    """Return the newest snapshot from before an `apply`."""
    points = [each for each in snapshots if each.reason == BEFORE_APPLY]
    if not points:
        raise _none(key)
    return points[-1]


def _none(key: str) -> NotInCache:
    return NotInCache(
        f"the cache has no snapshot from before an apply to {key}; name the time of the state to restore"
    )
