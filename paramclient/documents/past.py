"""What was: changes of values, and tables that were set down."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from paramclient.documents.base import Document, Maybe, Scalar
from paramclient.documents.written import SetDoc
from paramclient.notation import bits_text, hash_text, time_text, value_json
from paramclient.values import type_name

if TYPE_CHECKING:
    from paramclient.cache import HistoryEntry, Snapshot, SnapshotSummary

__all__ = ["ExactDoc", "HistoryDoc", "HistoryEntryDoc", "SnapshotDoc", "SnapshotsDoc", "WholeSnapshotDoc"]


class ExactDoc(Document):
    """A value to the last bit."""

    type: str
    bits: str


class HistoryEntryDoc(Document):
    """One change of a value; see `HistoryEntry`.

    `at` (unix seconds) and the exact values are said to programs that go on with them.
    """

    time: str
    component: int
    name: str
    old: Scalar
    new: Scalar | None
    by: str
    at: Maybe[float] = None
    old_exact: Maybe[ExactDoc] = None
    new_exact: Maybe[ExactDoc] = None

    @classmethod
    def of(cls, entry: HistoryEntry, *, exact: bool = False) -> HistoryEntryDoc:
        """A line of history."""
        old, new = entry.old, entry.new
        return cls(
            time=time_text(entry.at),
            component=entry.component,
            name=entry.name,
            old=value_json(old.value, old.type),
            new=None if new is None else value_json(new.value, new.type),
            by=entry.by,
            at=entry.at if exact else None,
            old_exact=ExactDoc(type=type_name(old.type), bits=bits_text(old)) if exact else None,
            new_exact=ExactDoc(type=type_name(new.type), bits=bits_text(new))
            if exact and new is not None
            else None,
        )


class HistoryDoc(Document):
    """Changes of values, the newest last. `before` is what to ask with for those that came before them."""

    history: list[HistoryEntryDoc]
    before: Maybe[str] = None

    @classmethod
    def of(cls, entries: Iterable[HistoryEntry]) -> HistoryDoc:
        """Lines of history."""
        return cls(history=[HistoryEntryDoc.of(entry) for entry in entries])


class SnapshotDoc(Document):
    """A table as it was set down at a moment, without its parameters; see `SnapshotSummary`."""

    id: int
    time: str
    component: int
    size: int
    complete: bool
    hash: str | None
    reason: str
    at: Maybe[float] = None

    @classmethod
    def of(cls, summary: SnapshotSummary, *, exact: bool = False) -> SnapshotDoc:
        """All of it but the vehicle's key; with the time as a number where a program goes on with it."""
        return cls(
            id=summary.id,
            time=time_text(summary.at),
            component=summary.component,
            size=summary.size,
            complete=summary.complete,
            hash=hash_text(summary.hash),
            reason=summary.reason,
            at=summary.at if exact else None,
        )


class SnapshotsDoc(Document):
    """Snapshots, the newest last."""

    snapshots: list[SnapshotDoc]

    @classmethod
    def of(cls, kept: Iterable[SnapshotSummary], *, exact: bool = False) -> SnapshotsDoc:
        """Those of a vehicle."""
        return cls(snapshots=[SnapshotDoc.of(each, exact=exact) for each in kept])


class WholeSnapshotDoc(SnapshotDoc):
    """A snapshot with its parameters."""

    state: SetDoc

    @classmethod
    def whole(cls, snapshot: Snapshot) -> WholeSnapshotDoc:
        """All of it."""
        return cls(**SnapshotDoc.of(snapshot, exact=True).model_dump(), state=SetDoc.of(snapshot.params))
