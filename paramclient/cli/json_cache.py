"""JSON of the cache: changes and snapshots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from paramclient.cli.json_output import Json
from paramclient.model.notation import Scalar, hash_text, time_text, value_json

if TYPE_CHECKING:
    from paramclient.cache import HistoryEntry, SnapshotSummary

__all__ = ["HistoryLineJson", "SnapshotJson"]


@dataclass(frozen=True, slots=True, kw_only=True)
class HistoryLineJson(Json):
    """One change of a value."""

    time: str
    component: int
    name: str
    old: Scalar
    new: Scalar | None
    by: str

    @classmethod
    def of(cls, entry: HistoryEntry) -> HistoryLineJson:
        """Return a change."""
        return cls.take(
            entry,
            time=time_text(entry.at),
            old=value_json(entry.old.settable, entry.old.type_number),
            new=None if entry.new is None else value_json(entry.new.settable, entry.new.type_number),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotJson(Json):
    """A snapshot of a table, without its parameters."""

    id: int
    time: str
    component: int
    size: int
    complete: bool
    hash: str | None
    reason: str

    @classmethod
    def of(cls, summary: SnapshotSummary) -> SnapshotJson:
        """Return a snapshot."""
        return cls.take(summary, time=time_text(summary.at), hash=hash_text(summary.hash))
