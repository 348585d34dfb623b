"""Whether a hash that the vehicle announced belongs to the table that has come."""

from __future__ import annotations

from paramclient.protocol.params.fetch_notes import MOVED, UNBRACKETED, UNPROVEN
from paramclient.protocol.params.fetch_result import Announcement
from paramclient.protocol.params.hash_exclusions import find_volatile
from paramclient.protocol.params.table import Table

__all__ = ["Proof"]


class Proof:
    """The hashes that were announced in the course of one fetch, and what they prove.

    A table is the vehicle's when the hash computed from it is an announced one; or when the vehicle announced
    the same before and after, as then nothing moved between. A hash counts only with the count that was
    announced with it: what came into use since would be taken for what the hash leaves out.

    Attributes:
        before: announced before any value counted, or None.
        meanwhile: announced in the course of the download, or None.
    """

    def __init__(self, table: Table) -> None:
        self.before: Announcement | None = None
        self.meanwhile: Announcement | None = None
        self._table = table
        self._is_old = False

    def forget(self) -> None:
        """What was announced is about another table."""
        self.before = self.meanwhile = None
        self._is_old = False

    def doubt(self) -> None:
        """The vehicle was away for a while: what it announced before proves nothing by itself."""
        self.before = self.before if self.meanwhile is None else self.meanwhile
        self.meanwhile = None
        self._is_old = True

    def is_given(self, count: int) -> bool:
        """Whether what was announced so far proves the table, which has so many parameters.

        Then it is what the vehicle had at that moment, and the hash need not be waited for again.
        """
        announced = self.before if self.meanwhile is None else self.meanwhile
        if announced is None or announced.count != count or (self._is_old and self.meanwhile is None):
            return False
        table = self._table
        volatile, is_proven = find_volatile(table.listed_bits(), announced.hash, believed=table.volatile)
        if is_proven:
            self._confirm(announced, volatile, proven=True)
        return is_proven

    def settle(self, after: Announcement, count: int, *, needs_proof: bool = False) -> tuple[str, ...] | None:
        """Judge by what was announced after the download; give what is to be noted of it.

        With `needs_proof`, that the vehicle announced the same before and after does not do: None is given
        where nothing else speaks for the table.
        """
        table = self._table
        volatile, is_proven = find_volatile(table.listed_bits(), after.hash, believed=table.volatile)
        is_proven = is_proven and after.count == count
        if needs_proof and not is_proven:
            return None
        if after.count != count:
            return (MOVED,)
        if is_proven or (self.before is not None and self.before.hash == after.hash):
            self._confirm(after, volatile, proven=is_proven)
            return () if is_proven else (UNPROVEN,)
        return (UNBRACKETED,) if self.before is None else (MOVED,)

    def _confirm(self, announced: Announcement, volatile: frozenset[str], *, proven: bool) -> None:
        self._table.confirm(announced.hash, volatile, proven=proven)
        self._table.verify()
