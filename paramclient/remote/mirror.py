"""Mirror, ExtMirror: copies of tables that follow the tables of the service, without input and output."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Final, Generic, TypeVar

from paramclient.model.ext_params import ExtParam
from paramclient.model.values import Param, Trust
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.params.change import Added, Change
from paramclient.protocol.params.table import NAMES_MAX

__all__ = ["LOADING_CHANGES_MAX", "ExtMirror", "Mirror", "TableMirror"]

TableParam = TypeVar("TableParam", Param, ExtParam)
TableChange = TypeVar("TableChange")

LOADING_CHANGES_MAX: Final = 20_000
"""Maximum number of changes queued while a table is loaded; with more, the table is loaded again."""


class TableMirror(ABC, Generic[TableParam, TableChange]):
    """A copy of one table of the service.

    A table is loaded as a whole, with the number of the last event that it includes; later events are applied
    in order, and events during the load after it. While the copy may be stale, every value is *cached*.

    Attributes:
        params: the parameters by name; always the same object.
        is_loaded: whether the copy matches the service up to the last received event.
    """

    def __init__(self) -> None:
        self.params: dict[str, TableParam] = {}
        self.is_loaded = False
        self._reported: dict[str, TableParam] = {}  # the parameters with the trust that the service reports
        self._is_first = True
        self._seq = -1
        self._is_reachable = True
        self._waiting: list[tuple[int, TableChange]] | None = None  # None: no load is running, or too many

    def begin(self) -> None:
        """Start a load: queue changes from now on."""
        self._waiting = []

    def load(self, seq: int, params: Mapping[str, TableParam]) -> list[TableChange] | None:
        """Replace the table by its state after this event, and apply the queued changes.

        Args:
            seq: number of the event.
            params: the table.

        Returns:
            The changes, or None if the table has to be loaded again.

        Raises:
            ValueError: the table has more than `MOST_NAMES` names.
        """
        waiting, self._waiting = self._waiting, None
        if waiting is None:
            return None
        if len(params) > NAMES_MAX:
            raise ValueError(f"a table of more than {NAMES_MAX} names")
        before, self._reported = self._reported, dict(params)
        self.is_loaded, self._seq = True, seq
        self.params.clear()
        self.params.update(self._shown(self._reported))
        changes = [] if self._is_first else self._differences(before, self._reported)
        self._is_first = False
        for at, change in waiting:
            changes += [] if (made := self.take(at, change)) is None else [made]
        return changes

    def take(self, seq: int, change: TableChange) -> TableChange | None:
        """Apply a change. Return it if the value has changed.

        Args:
            seq: number of the event.
            change: the change.

        Raises:
            ValueError: the table would have more than `MOST_NAMES` names.
        """
        if not self.is_loaded:
            if self._waiting is not None:
                self._waiting.append((seq, change))
                if len(self._waiting) > LOADING_CHANGES_MAX:
                    self._waiting = None
            return None
        if seq <= self._seq:
            return None
        name, new, by, is_added = self._parts(change)
        old = self._reported.get(name)
        if old is None and new is not None and len(self._reported) >= NAMES_MAX:
            raise ValueError(f"a table of more than {NAMES_MAX} names")
        self._seq = seq
        if new is None:
            self._reported.pop(name, None)
            self.params.pop(name, None)
            return None if old is None else self._change(name, old, None, by)
        self._reported[name] = self.params[name] = new
        if old is not None and old.same_value(new):
            return None
        return self._change(name, old, new, by, is_added=is_added)

    def confirm(self, param: TableParam) -> None:
        """Update the trust of a parameter from a response, if the value is equal."""
        known = self._reported.get(param.name)
        if self.is_loaded and self._is_reachable and known is not None and known.same_value(param):
            self._reported[param.name] = self.params[param.name] = param

    def doubt(self) -> None:
        """Mark the copy as stale until the next load: all values are *cached*."""
        self.is_loaded = False
        self._waiting = None
        self._show()

    def leave(self) -> None:
        """Mark all values as *cached*: the connection is lost."""
        self._is_reachable = False
        self._show()

    def resume(self) -> None:
        """Restore the trust of the values after a reconnection: missed events follow."""
        self._is_reachable = True
        self._show()

    def _show(self) -> None:
        self.params.update(self._shown(self._reported))

    def _shown(self, params: dict[str, TableParam]) -> dict[str, TableParam]:
        if self.is_loaded and self._is_reachable:
            return params
        return {name: param.with_trust(Trust.CACHED) for name, param in params.items()}

    def _differences(
        self, before: Mapping[str, TableParam], now: Mapping[str, TableParam]
    ) -> list[TableChange]:
        """Return the changes between two loads. Names that only the later one has are added to a table."""
        gone = [self._change(name, old, None) for name, old in before.items() if name not in now]
        changed = [
            self._change(name, before.get(name), new, is_added=bool(before))
            for name, new in now.items()
            if (old := before.get(name)) is None or not old.same_value(new)
        ]
        return gone + changed

    @abstractmethod
    def _change(
        self,
        name: str,
        old: TableParam | None,
        new: TableParam | None,
        by: str = "vehicle",
        *,
        is_added: bool = False,
    ) -> TableChange:
        """Return the change of a parameter."""

    @abstractmethod
    def _parts(self, change: TableChange) -> tuple[str, TableParam | None, str, bool]:
        """Return name, parameter and author of a change, and whether the parameter is new."""


class Mirror(TableMirror[Param, Change]):
    """A copy of a table of plain parameters."""

    def _change(
        self,
        name: str,
        old: Param | None,
        new: Param | None,
        by: str = "vehicle",
        *,
        is_added: bool = False,
    ) -> Change:
        return Change.between(name, old, new, by, is_added=is_added)

    def _parts(self, change: Change) -> tuple[str, Param | None, str, bool]:
        return change.name, change.new, change.by, isinstance(change, Added)


class ExtMirror(TableMirror[ExtParam, ExtChange]):
    """A copy of a table of extended parameters."""

    def _change(
        self,
        name: str,
        old: ExtParam | None,
        new: ExtParam | None,
        by: str = "vehicle",
        *,
        is_added: bool = False,
    ) -> ExtChange:
        return ExtChange(name, old, new, by, is_added and old is None)

    def _parts(self, change: ExtChange) -> tuple[str, ExtParam | None, str, bool]:
        return change.name, change.new, change.by, change.is_added
