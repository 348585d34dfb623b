"""Documents of the history: changes of values, and snapshots."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from paramclient.documents.document import Document, Maybe, Scalar
from paramclient.documents.param import WrittenParamDoc
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import bits_text, hash_text, time_text, value_json
from paramclient.model.values import type_name

if TYPE_CHECKING:
    from paramclient.cache import HistoryEntry, SnapshotSummary
    from paramclient.model.paramset import ParamSet

__all__ = [
    "ExactDoc",
    "HistoryDoc",
    "HistoryEntryDoc",
    "SnapshotDoc",
    "SnapshotsDoc",
    "WholeSnapshotDoc",
]


class ExactDoc(Document):
    """The exact value: its type and bits."""

    type: str
    bits: str


class HistoryEntryDoc(Document):
    """One change of a value; see `HistoryEntry`.

    `at` (unix seconds) and the exact values are for programs that process the change further.
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
        """Return the document of a change; with `exact`, including the time as a number and exact values."""
        old, new = entry.old, entry.new
        return cls(
            time=time_text(entry.at),
            component=entry.component,
            name=entry.name,
            old=value_json(old.settable, old.type_number),
            new=None if new is None else value_json(new.settable, new.type_number),
            by=entry.by,
            at=entry.at if exact else None,
            old_exact=ExactDoc(type=type_name(old.type_number), bits=bits_text(old)) if exact else None,
            new_exact=ExactDoc(type=type_name(new.type_number), bits=bits_text(new))
            if exact and new is not None
            else None,
        )


class HistoryDoc(Document):
    """Changes of values, the newest last. `before` is the argument of a request for earlier changes."""

    history: list[HistoryEntryDoc]
    before: Maybe[float] = None

    @classmethod
    def of(
        cls,
        entries: Iterable[HistoryEntry],
        *,
        exact: bool = False,
        before: float | None = None,
    ) -> HistoryDoc:
        """Lines of history."""
        return cls(
            history=[HistoryEntryDoc.of(entry, exact=exact) for entry in entries],
            before=before,
        )


class SnapshotDoc(Document):
    """A snapshot of a table, without its parameters; see `SnapshotSummary`."""

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
        """Return the document of a `SnapshotSummary`; with `exact`, including the time as a number."""
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
        """Return the document of the snapshots of a vehicle."""
        return cls(snapshots=[SnapshotDoc.of(each, exact=exact) for each in kept])


class WholeSnapshotDoc(SnapshotDoc):
    """A snapshot with its parameters by name, and the identity of the vehicle at that time."""

    source: str
    system: int | None
    autopilot: str | None
    uid: str | None
    params: dict[str, WrittenParamDoc]

    @classmethod
    def whole(cls, summary: SnapshotSummary, params: ParamSet) -> WholeSnapshotDoc:
        """Return the document of a snapshot with its parameters."""
        identity = params.identity
        return cls(
            **SnapshotDoc.of(summary, exact=True).model_dump(),
            source=params.source,
            system=params.system,
            autopilot=None if identity is None else autopilot_name(identity.autopilot),
            uid=None if identity is None else identity.uid,
            params={name: WrittenParamDoc.of(param) for name, param in params.items()},
        )
