"""The state that a restore without a given state goes back to: the snapshot before the last `apply`, and the
changes since then. A second restore to it is refused."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from paramclient.errors import AlreadyRestored, NotInCache, UnknownVehicle
from paramclient.model.paramset import RestorePoint
from paramclient.model.wording import age_in_words
from paramclient.provision.apply_restore import BEFORE_APPLY, BEFORE_RESTORE

if TYPE_CHECKING:
    from paramclient.cache import ParamCache

__all__ = ["load_restore_point"]


def load_restore_point(
    cache: ParamCache, key: str, component: int, *, extended: bool = False
) -> RestorePoint:
    """Return the state that the cache stored before the latest `apply`, and what happened after it.

    A restore stores a snapshot before its first write. If there is one after the `apply`, even of a restore
    that did not end, the state must be named: another restore would also undo later changes.

    Args:
        cache: the cache.
        key: `Identity.key` of the vehicle.
        component: component id.
        extended: that of extended parameters.

    Raises:
        AlreadyRestored: a restore ran since that `apply`.
        NotInCache: there is no snapshot from before an `apply`.
        CacheError: the cache cannot be read.
    """
    missing = NotInCache(
        f"the cache has no snapshot from before an apply to {key}; name the time of the state to restore"
    )
    try:
        snapshots = cache.snapshots(key, component, extended=extended)
        points = [each for each in snapshots if each.reason == BEFORE_APPLY]
        if not points:
            raise missing
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
        state = cache.state_at(key, component, point.id, extended=extended)
        table = cache.load(key, component, extended=extended)
        entries = cache.history(key, component, extended=extended)
    except UnknownVehicle:
        raise missing from None
    held = {} if table is None else table.params
    latest = {entry.name: entry.at for entry in entries}  # of several entries of a name, the last one
    changes = {
        name: at
        for name, at in sorted(latest.items(), key=lambda change: change[1])[::-1]
        if name in held and name in state and held[name].settable != state[name].settable
    }
    return RestorePoint(point.id, point.at, state, changes)
