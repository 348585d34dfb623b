"""JSON of the cache: tables, changes and snapshots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from paramclient.cli.json_output import Json, ParamJson
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import Scalar, hash_text, time_or_none, time_text, value_json

if TYPE_CHECKING:
    from paramclient.cache import CachedComponent, CachedSummary, HistoryEntry, SnapshotSummary

__all__ = ["HistoryLineJson", "SnapshotJson", "SummaryJson", "TableJson"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TableJson(Json):
    """The cached table of a component."""

    system: int
    component: int
    autopilot: str
    uid: str | None
    hash: str | None
    synced_at: str | None
    params: dict[str, ParamJson]

    @classmethod
    def of(cls, table: CachedComponent, params: Mapping[str, ParamJson]) -> TableJson:
        """Return a table with these parameters."""
        return cls.take(
            table,
            autopilot=autopilot_name(table.autopilot),
            uid=table.identity.uid,
            hash=hash_text(table.hash),
            synced_at=time_or_none(table.synced_at),
            params=dict(params),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SummaryJson(Json):
    """A cached table without its parameters; `extended` is the number of extended ones."""

    key: str
    system: int
    component: int
    autopilot: str
    uid: str | None
    size: int
    count: int | None
    complete: bool
    hash: str | None
    synced_at: str | None
    updated_at: str | None
    extended: int | None = None

    @classmethod
    def of(cls, summary: CachedSummary, extended: int | None = None) -> SummaryJson:
        """Return a summary, with the number of extended parameters or None."""
        return cls.take(
            summary,
            autopilot=autopilot_name(summary.autopilot),
            uid=summary.identity.uid,
            hash=hash_text(summary.hash),
            synced_at=time_or_none(summary.synced_at),
            updated_at=time_or_none(summary.updated_at),
            extended=extended,
        )


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
