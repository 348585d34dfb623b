"""The table of a component's extended parameters."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

from paramclient.model.ext_params import ExtParam
from paramclient.model.values import Trust
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.params.table import NAMES_MAX, NameQuota
from paramclient.protocol.wire import PARAMETERS_MAX

__all__ = ["ExtTable"]


EXT_OVERWRITTEN_MAX: Final = 1_024
"""Replaced values that wait for the cache: some tens fit between two writes to the disk."""


class ExtTable:
    """The extended parameters of one component, apart from its plain ones.

    Args:
        name_quota: the name count shared by all tables of the link.

    Attributes:
        params: by name, in the order of first reception. Shared with readers; never replaced.
        revision: changes whenever a parameter in `params` does.
        count: the latest param_count, or None. Indices are valid for this count only.
        moments: when each value was last observed, by name, in seconds of the core's clock.
        dirty: names whose value, type or index changed since the last `take_dirty`, with the author.
        gone: when each removed name was found missing, since the last `take_removed_at`.
        overwritten: values that were replaced before they reached the cache, with author and moment; the
            oldest are dropped above `EXT_OVERWRITTEN_MAX`.
    """

    def __init__(self, name_quota: NameQuota | None = None) -> None:
        self._name_quota = NameQuota() if name_quota is None else name_quota
        self.params: dict[str, ExtParam] = {}
        self.revision = 0
        self.count: int | None = None
        self.moments: dict[str, float] = {}
        self.dirty: dict[str, str] = {}
        self.gone: dict[str, float] = {}
        self.overwritten: list[tuple[ExtParam, str, float]] = []
        self._names: dict[int, str] = {}  # by index

    @property
    def complete(self) -> bool:
        """Whether the table has a parameter for every index below `count`."""
        return self.count is not None and len(self._names) >= self.count

    def use_count(self, count: int) -> bool:
        """Take the param_count of a message; return whether it is another one: all indices are then
        unknown."""
        if count == self.count or not 1 <= count <= PARAMETERS_MAX:
            return False
        is_another = self.count is not None
        self.count = count
        if is_another:
            params = self.params
            for name in self._names.values():  # at a count that alternates, few have an index
                param = params.get(name)
                if param is not None:
                    params[name] = param.with_index(None)
            self._names.clear()
            self.revision += 1
        return is_another

    def use_index(self, name: str, index: int) -> None:
        """Take the index of a known parameter."""
        if self.count is None or index >= self.count:
            return
        before = self._names.get(index)
        if before is not None and before != name and before in self.params:
            self._put(self.params[before].with_index(None))
        old = self.params[name].index
        if old is not None and old != index and self._names.get(old) == name:
            del self._names[old]
        self._names[index] = name
        if old != index:
            self._put(self.params[name].with_index(index))
            self.dirty.setdefault(name, "vehicle")

    def store(self, param: ExtParam, by: str, moment: float) -> ExtChange | None:
        """Store an observed value; return its change, or None where the value is known.

        An older observation than the stored one is ignored, as is a new name in a full table.

        Args:
            param: the value. Its index is not stored; see `use_index`.
            by: the author of the change, if it is one.
            moment: when the value arrived from the link.
        """
        name = param.name
        old = self.params.get(name)
        if old is None:
            if not self._name_quota.has_capacity(len(self.params)):
                return None
            self._name_quota.taken += 1
        elif self.moments.get(name, moment) > moment and old.trust is not Trust.CACHED:
            return None
        is_known = old is not None and old.same_value(param)
        if old is not None and not is_known and name in self.dirty:
            self.overwritten.append((old, self.dirty[name], self.moments.get(name, moment)))
            del self.overwritten[:-EXT_OVERWRITTEN_MAX]
        self.moments[name] = moment
        self._put(param.with_index(None if old is None else old.index))
        if is_known:
            return None
        self.dirty[name] = by
        self.gone.pop(name, None)
        return ExtChange(name, old, self.params[name], by)

    def keep_only(self, names: Collection[str], now: float) -> list[ExtChange]:
        """Remove all other parameters: a complete list was without them."""
        missing = [name for name in self.params if name not in names]
        if len(self.gone) + len(missing) <= NAMES_MAX:
            self.gone.update(dict.fromkeys(missing, now))
        return [self._remove(name) for name in missing]

    def take_dirty(self) -> dict[str, str]:
        """Return `dirty`, and empty it."""
        dirty, self.dirty = self.dirty, {}
        return dirty

    @property
    def live_count(self) -> int | None:
        """The count that the component has sent on this link. The cache gives none."""
        return self.count

    def take_removed_at(self) -> dict[str, float]:
        """Return `gone`, and empty it."""
        gone, self.gone = self.gone, {}
        return gone

    def take_overwritten(self) -> list[tuple[ExtParam, str, float]]:
        """Return `overwritten`, and empty it."""
        overwritten, self.overwritten = self.overwritten, []
        return overwritten

    def mark_dirty(self) -> None:
        """Mark all values as changed: the cache may lack them."""
        for name in self.params:
            self.dirty.setdefault(name, "vehicle")

    def restore(self, params: Mapping[str, ExtParam], moments: Mapping[str, float]) -> list[ExtChange]:
        """Load a cached table. Values received on this link
        stay."""
        changes = []
        for name, param in params.items():
            known = self.params.get(name)
            if known is None:
                if not self._name_quota.has_capacity(len(self.params)):
                    continue
                self._name_quota.taken += 1
            elif known.trust is not Trust.CACHED:
                continue
            index = None if known is None else known.index
            self._put(param.with_trust(Trust.CACHED).with_index(index))
            if name in moments:
                self.moments[name] = moments[name]
            if known is None or not known.same_value(param):
                changes.append(ExtChange(name, known, self.params[name]))
        return changes

    def doubt(self) -> None:
        """Mark all values as cached: another vehicle may have the address, or this one has restarted."""
        for param in self.params.values():
            self._put(param.with_trust(Trust.CACHED))

    def doubt_value(self, name: str) -> None:
        """Mark one value as cached: it may be older than a change."""
        if name in self.params:
            self._put(self.params[name].with_trust(Trust.CACHED))

    def age(self, unseen: float) -> None:
        """Move all moments back by the seconds of a system suspend that the core's clock does not have."""
        for moments in (self.moments, self.gone):
            moments.update({name: at - unseen for name, at in moments.items()})
        self.overwritten = [(param, by, at - unseen) for param, by, at in self.overwritten]

    def forget(self) -> list[ExtChange]:
        """Remove everything: another vehicle has the address."""
        self.count = None
        self._names.clear()
        self.dirty.clear()
        self.overwritten.clear()
        self.gone.clear()
        return [self._remove(name) for name in list(self.params)]

    def _put(self, param: ExtParam) -> None:
        self.params[param.name] = param
        self.revision += 1

    def _remove(self, name: str) -> ExtChange:
        param = self.params.pop(name)
        self.revision += 1
        self.moments.pop(name, None)
        self.dirty.pop(name, None)
        self._name_quota.taken -= 1
        if param.index is not None and self._names.get(param.index) == name:
            del self._names[param.index]
        return ExtChange(name, param, None)
