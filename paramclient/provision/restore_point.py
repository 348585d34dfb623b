"""The state before the last `apply` in the cache: its snapshot, changes since then, a restore since then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from paramclient.errors import NotInCache, UnknownVehicle
from paramclient.model.paramset import ParamSet
from paramclient.provision.apply_restore import BEFORE_RESTORE
from paramclient.provision.vehicle_params import BEFORE_APPLY, load_state_before_apply

if TYPE_CHECKING:
    from paramclient.cache import HistoryEntry, ParamCache, SnapshotSummary

__all__ = ["RestorePoint", "load_restore_point"]


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


def load_restore_point(cache: ParamCache, key: str, component: int) -> RestorePoint:
    """Return the state that the cache stored of a component before the latest `apply`.

    Args:
        cache: the cache.
        key: `Identity.key` of the vehicle.
        component: component id.

    Raises:
        CacheError: the cache has no snapshot from before an `apply`.
    """
    state = load_state_before_apply(cache, key, component)
    try:
        snapshots = cache.snapshots(key, component)
        snapshot = [each for each in snapshots if each.reason == BEFORE_APPLY][-1]
        table = cache.load(key, component)
        entries = cache.history(key, component)
    except (UnknownVehicle, IndexError):  # removed from the cache since the line above
        raise NotInCache(f"the cache has no snapshot from before an apply to {key}") from None
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
