"""Policy, inputs, progress and result of a fetch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal, TypeAlias

from paramclient.model.values import Param, Trust
from paramclient.protocol.ftp import FileTransfers
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch_notes import CHANGED_MEANWHILE
from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.scheduler import ListAdmission
from paramclient.protocol.wire import ParamValue

__all__ = ["Announcement", "FetchResult", "FetchContext", "FetchSource", "Policy", "Progress"]

FetchSource: TypeAlias = Literal["cache", "ftp", "stream"]
"""Where a fetch has the values from: the cache, the packed file (MAVFTP) or the list."""

FRESH_HASH: Final = 1.0
"""Seconds for which an announced hash is used without a new request. The hash is requested when a component
is found, so that a fetch right after that saves a round trip."""


class Policy(StrEnum):
    """The requests that a fetch may send.

    Attributes:
        AUTO: whatever is cheapest and certain.
        HASH_ONLY: the hash only, for a vehicle in flight or a metered link: a table that the hash does not
            confirm stays as cached.
        CACHE_ONLY: none.
    """

    AUTO = "auto"
    HASH_ONLY = "hash-only"
    CACHE_ONLY = "cache-only"


@dataclass(frozen=True, slots=True)
class FetchContext:
    """The objects of the component that a fetch uses.

    Attributes:
        context, reads, table, list_admission, files: as their names say.
        changed: called with changes that no PARAM_VALUE brought.
        doubt: called when a table turns out to have changed.
    """

    context: Context
    reads: Reads
    table: Table
    list_admission: ListAdmission
    files: FileTransfers
    changed: Callable[[list[Change]], None]
    doubt: Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Announcement:
    """A received `_HASH_CHECK`: hash, count, and time of reception."""

    hash: int
    count: int
    at: float

    @classmethod
    def of(cls, message: ParamValue, at: float) -> Announcement:
        """Return the announcement in a message."""
        return cls(int.from_bytes(message.raw, "little"), message.param_count, at)

    @classmethod
    def answering(cls, read: Read) -> Announcement | None:
        """Return the announcement in the response to a read of `_HASH_CHECK`, or None without one."""
        return None if read.result is None else cls.of(read.result, read.ended_at)

    def is_fresh(self, now: float) -> bool:
        """Return whether the hash need not be requested again."""
        return now - self.at <= FRESH_HASH


@dataclass(frozen=True, slots=True)
class Progress:
    """The progress of a fetch.

    Attributes:
        received: parameters received.
        total: parameters of the component, or None while unknown.
        rate: parameters per second since the first one was received.
        seconds_left: at that rate, or None while unknown.
    """

    received: int
    total: int | None
    rate: float
    seconds_left: float | None

    @classmethod
    def after(cls, received: int, total: int | None, downloaded: int, running: float) -> Progress:
        """Return the progress when `downloaded` of the received ones took `running` seconds."""
        rate = downloaded / running if downloaded > 0 and running > 0 else 0.0
        left = (total - received) / rate if rate and total is not None else None
        return cls(received, total, rate, left)


@dataclass(frozen=True, slots=True)
class FetchResult:
    """The result of `fetch_all`.

    Attributes:
        system, component: the component's address.
        params: all known parameters by name, as they were at the end of the fetch.
        source: "cache" when the vehicle's hash confirmed the cached table, or when the policy allows only the
            cache; "ftp" for the packed file, "stream" for the list.
        count: parameters that the component says it has.
        received: how many of them are known.
        missing: indices that were not received, rising. Empty when the fetch is complete.
        hash: the PX4 hash by which the vehicle confirmed the table; None for a vehicle without one, when the
            table changed during the download, and when the policy permits no request for it.
        elapsed: seconds from the call to the end.
        resumed: parameters that were known from an earlier, unfinished download.
        notes: further sentences for the user.
        lost: values of the list that were lost, so that they had to be read one by one or by another list; 0
            from the cache.
        repeated: values received more than once; 0 from the cache.
        round_trip: the component's measured round trip in seconds, smoothed, or None.
    """

    system: int
    component: int
    params: Mapping[str, Param]
    source: FetchSource
    count: int
    received: int
    missing: tuple[int, ...]
    hash: int | None
    elapsed: float
    notes: tuple[str, ...] = ()
    resumed: int = 0
    lost: int = 0
    repeated: int = 0
    round_trip: float | None = None

    @property
    def complete(self) -> bool:
        return not self.missing

    @property
    def may_be_mixed(self) -> bool:
        """Whether the vehicle's hash shows that the table changed during the download: it may be a
        mixture."""
        return CHANGED_MEANWHILE in self.notes

    @property
    def is_confirmed(self) -> bool:
        """Whether every value was received in this session, or is covered by the vehicle's hash."""
        if not self.resumed or self.hash is not None:
            return True
        return all(param.trust is not Trust.CACHED or param.index is None for param in self.params.values())

    def __repr__(self) -> str:
        missing = f", {len(self.missing)} missing" if self.missing else ""
        return (
            f"<FetchResult {self.system}/{self.component} {self.received} params{missing} "
            f"from {self.source} in {self.elapsed:.2f} s>"
        )
