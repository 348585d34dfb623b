"""Whether a hash that the vehicle announced matches the downloaded table."""

from __future__ import annotations

from paramclient.model.px4_hash import find_volatile
from paramclient.protocol.params.fetch_notes import CHANGED_MEANWHILE, NO_HASH_BEFORE_DOWNLOAD, UNPROVEN
from paramclient.protocol.params.fetch_result import Announcement
from paramclient.protocol.params.table import Table

__all__ = ["HashCheck"]


class HashCheck:
    """The hashes announced during one fetch, and what they prove.

    A table is the vehicle's when the hash recomputed from it equals an announced one; or when the vehicle
    announced the same hash before and after, as then nothing changed between. A hash counts only with the
    count that was announced with it: parameters that came into use since would be taken for excluded ones.

    Attributes:
        before: announced before the first value that counts, or None.
        meanwhile: announced during the download, or None.
    """

    def __init__(self, table: Table) -> None:
        self.before: Announcement | None = None
        self.meanwhile: Announcement | None = None
        self._table = table
        self._is_old = False

    def forget(self) -> None:
        """Forget the announcements: they belong to another table."""
        self.before = self.meanwhile = None
        self._is_old = False

    def doubt(self) -> None:
        """Doubt the announcements: the vehicle was lost, so they prove nothing on their own."""
        self.before = self.before if self.meanwhile is None else self.meanwhile
        self.meanwhile = None
        self._is_old = True

    def is_given(self, count: int) -> bool:
        """Return whether the announcements so far prove the table with this many parameters.

        Then it is the vehicle's table of that moment, and no further hash is needed.
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
        """Decide with the hash announced after the download, and return the notes.

        With `needs_proof`, equal hashes before and after are not enough: None is returned without another
        proof.
        """
        table = self._table
        volatile, is_proven = find_volatile(table.listed_bits(), after.hash, believed=table.volatile)
        is_proven = is_proven and after.count == count
        if needs_proof and not is_proven:
            return None
        if after.count != count:
            return (CHANGED_MEANWHILE,)
        if is_proven or (self.before is not None and self.before.hash == after.hash):
            self._confirm(after, volatile, proven=is_proven)
            return () if is_proven else (UNPROVEN,)
        return (NO_HASH_BEFORE_DOWNLOAD,) if self.before is None else (CHANGED_MEANWHILE,)

    def _confirm(self, announced: Announcement, volatile: frozenset[str], *, proven: bool) -> None:
        self._table.confirm(announced.hash, volatile, proven=proven)
        self._table.verify()
