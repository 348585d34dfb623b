"""The state that a restore without a given state goes back to: the snapshot before the last `apply`, and the
changes since then. A second restore to it is refused."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from paramclient.errors import AlreadyRestored, NotInCache, UnknownVehicle
from paramclient.model.paramset import ParamSet, RestorePoint
from paramclient.model.wording import age_in_words
from paramclient.provision.apply_restore import BEFORE_APPLY, BEFORE_RESTORE

if TYPE_CHECKING:
    from paramclient.cache import ParamCache, SnapshotSummary

__all__ = ["choose_restore_point", "load_restore_point", "load_state_before_apply"]


def load_state_before_apply(
    cache: ParamCache, key: str, component: int, *, extended: bool = False
) -> ParamSet:
    """Return the state that the cache stored of a component before the latest `apply`.

    Args:
        cache: the cache.
        key: `Identity.key` of the vehicle.
        component: component id.
        extended: that of extended parameters.

    Raises:
        AlreadyRestored: a restore ran since that `apply`.
        CacheError: the cache has no snapshot from before an `apply`.
    """
    number = _find_snapshot(cache, key, component, extended=extended).id
    return cache.state_at(key, component, number, extended=extended)


def load_restore_point(
    cache: ParamCache, key: str, component: int, *, extended: bool = False
) -> RestorePoint:
    """Return the state before the latest `apply`, and what happened after it.

    Arguments and errors as of `load_state_before_apply`.
    """
    snapshot = _find_snapshot(cache, key, component, extended=extended)
    try:
        state = cache.state_at(key, component, snapshot.id, extended=extended)
        table = cache.load(key, component, extended=extended)
        entries = cache.history(key, component, extended=extended)
    except UnknownVehicle:  # removed from the cache since the line above
        raise _none(_apply_to(key)) from None
    now = {} if table is None else table.params
    latest = {entry.name: entry.at for entry in entries}  # of several entries of a name, the last one
    changes = {
        name: at
        for name, at in sorted(latest.items(), key=lambda change: change[1])[::-1]
        if name in now and name in state and now[name].settable != state[name].settable
    }
    return RestorePoint(snapshot.id, snapshot.at, state, changes)


def choose_restore_point(snapshots: Sequence[SnapshotSummary], apply: str) -> SnapshotSummary:
    """Return the snapshot that a restore without a time writes: the newest one from before an `apply`.

    A restore stores a snapshot before its first write. If there is one after the `apply`, even of a restore
    that did not end, the state must be named: another restore would also undo later changes.

    Args:
        snapshots: the snapshots of a component, the newest last.
        apply: the `apply` in words, for messages.

    Raises:
        AlreadyRestored: a restore ran since that `apply`.
        NotInCache: there is no snapshot from before an `apply`.
    """
    points = [each for each in snapshots if each.reason == BEFORE_APPLY]
    if not points:
        raise _none(apply)
    point, now = points[-1], time.time()
    restores = [each for each in snapshots if each.reason == BEFORE_RESTORE and each.id > point.id]
    if restores:
        ago = age_in_words(now - restores[-1].at)
        raise AlreadyRestored(
            f"a restore ran {ago} ago, after the last apply ({age_in_words(now - point.at)} ago)",
            before_apply=point.id,
            before_restore=restores[-1].id,
            restored_at=restores[-1].at,
        )
    return point


def _find_snapshot(cache: ParamCache, key: str, component: int, *, extended: bool = False) -> SnapshotSummary:
    try:
        snapshots = cache.snapshots(key, component, extended=extended)
    except UnknownVehicle:
        snapshots = []
    return choose_restore_point(snapshots, _apply_to(key))


def _apply_to(key: str) -> str:
    return f"an apply to {key}"


def _none(apply: str) -> NotInCache:
    return NotInCache(f"the cache has no snapshot from before {apply}; name the time of the state to restore")
