"""A copy of one component's table that follows the service's. Without input and output."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from paramclient.model.values import Param, Trust
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.table import NAMES_MAX

__all__ = ["MOST_WAITING", "Mirror"]

MOST_WAITING: Final = 20_000
"""Changes that are kept while a table is being loaded; with more it is loaded again instead."""


class Mirror:
    """What is known here of one table of the service.

    A table is loaded whole, and says after which event that was; later events are applied to it in their
    order, those that come while it is loaded afterwards. While it is not known to be what the service has,
    every value counts as *cached*, whatever it was before.

    Attributes:
        params: what is shown, by name; the object stays the same.
        is_loaded: whether it is the service's table, as far as events have come.
    """

    def __init__(self) -> None:
        self.params: dict[str, Param] = {}
        self.is_loaded = False
        self._told: dict[str, Param] = {}  # the same with the trust that the service has in it
        self._is_first = True
        self._seq = -1
        self._is_reachable = True
        self._waiting: list[tuple[int, Change]] | None = None  # None: nobody is loading, or too many

    def begin(self) -> None:
        """It is asked for now: what happens from here on is kept."""
        self._waiting = []

    def load(self, seq: int, params: Mapping[str, Param]) -> list[Change] | None:
        """Take the whole table as it was after this event.

        Returns:
            What is different from before, or None where it has to be loaded again.

        Raises:
            ValueError: it has more names than there can be.
        """
        waiting, self._waiting = self._waiting, None
        if waiting is None:
            return None
        if len(params) > NAMES_MAX:
            raise ValueError(f"a table of more than {NAMES_MAX} names")
        before, self._told = self._told, dict(params)
        self.is_loaded, self._seq = True, seq
        self.params.clear()
        self.params.update(self._shown(self._told))
        changes = [] if self._is_first else _differences(before, self._told)
        self._is_first = False
        for at, change in waiting:
            changes += [] if (made := self.take(at, change)) is None else [made]
        return changes

    def take(self, seq: int, change: Change) -> Change | None:
        """Take one change; give it, if it is one of the value.

        Raises:
            ValueError: the table would have more names than there can be.
        """
        if not self.is_loaded:
            if self._waiting is not None:
                self._waiting.append((seq, change))
                if len(self._waiting) > MOST_WAITING:
                    self._waiting = None
            return None
        if seq <= self._seq:
            return None
        name, new, by = change.name, change.new, change.by
        old = self._told.get(name)
        if old is None and new is not None and len(self._told) >= NAMES_MAX:
            raise ValueError(f"a table of more than {NAMES_MAX} names")
        self._seq = seq
        if new is None:
            self._told.pop(name, None)
            self.params.pop(name, None)
            return None if old is None else Change(name, old, None, by)
        self._told[name] = self.params[name] = new
        return None if old is not None and old.same_value(new) else Change(name, old, new, by)

    def confirm(self, param: Param) -> None:
        """An answer has told of a parameter: its trust counts, where it has the same value here."""
        known = self._told.get(param.name)
        if self.is_loaded and self._is_reachable and known is not None and known.same_value(param):
            self._told[param.name] = self.params[param.name] = param

    def doubt(self) -> None:
        """It has to be loaded anew; until then nothing in it is more than cached."""
        self.is_loaded = False
        self._waiting = None
        self._show()

    def leave(self) -> None:
        """The service cannot be reached."""
        self._is_reachable = False
        self._show()

    def resume(self) -> None:
        """It is reached again, and what happened meanwhile will be told."""
        self._is_reachable = True
        self._show()

    def _show(self) -> None:
        self.params.update(self._shown(self._told))

    def _shown(self, told: dict[str, Param]) -> dict[str, Param]:
        if self.is_loaded and self._is_reachable:
            return told
        return {name: param.with_trust(Trust.CACHED) for name, param in told.items()}


def _differences(before: Mapping[str, Param], now: Mapping[str, Param]) -> list[Change]:
    gone = [Change(name, old, None) for name, old in before.items() if name not in now]
    moved = [
        Change(name, before.get(name), new)
        for name, new in now.items()
        if (old := before.get(name)) is None or not old.same_value(new)
    ]
    return gone + moved
