"""What a fetch works with, what it is told, what it tells meanwhile, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from paramclient.model.values import Param, Trust
from paramclient.protocol.ftp import FileTransfers
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch_notes import MOVED
from paramclient.protocol.params.foreign_list import Following
from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.sampling import Sample
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.scheduler import Turns
from paramclient.protocol.wire import ParamValue

__all__ = ["Announcement", "FetchResult", "Means", "Policy", "Progress", "Sampled"]

FRESH_HASH: Final = 1.0
"""Seconds for which an announced hash answers the question what the hash is. It is asked for when a component
is found, so that a fetch right after that need not wait for another round trip."""


class Policy(StrEnum):
    """What may be asked of a vehicle to bring a table up to date.

    Attributes:
        AUTO: whatever is the cheapest sure way.
        HASH_ONLY: its hash and nothing more, for a vehicle in flight or a link that costs: a table that the
            hash does not confirm stays as it was cached.
        CACHE_ONLY: nothing.
    """

    AUTO = "auto"
    HASH_ONLY = "hash-only"
    CACHE_ONLY = "cache-only"


@dataclass(frozen=True, slots=True)
class Means:
    """What a fetch works with; all of it is the component's.

    Attributes:
        context, reads, table, turns, files: as their names say.
        changed: is told of changes that no PARAM_VALUE brought.
        doubt: is told that a table has turned out not to be what it was.
        following: the list that another station may be having sent.
    """

    context: Context
    reads: Reads
    table: Table
    turns: Turns
    files: FileTransfers
    changed: Callable[[list[Change]], None]
    doubt: Callable[[float], None]
    following: Following


@dataclass(frozen=True, slots=True)
class Sampled:
    """What sample of a cached table may settle a fetch of a vehicle without a hash.

    Attributes:
        size: how many parameters.
        seed: of the draw.
    """

    size: int
    seed: int


@dataclass(frozen=True, slots=True)
class Announcement:
    """A `_HASH_CHECK` that the vehicle has sent: its hash, the count with it, and when it came."""

    hash: int
    count: int
    at: float

    @classmethod
    def of(cls, message: ParamValue, at: float) -> Announcement:
        """What such a message says."""
        return cls(int.from_bytes(message.raw, "little"), message.param_count, at)

    @classmethod
    def answering(cls, read: Read) -> Announcement | None:
        """What the answer to a read of `_HASH_CHECK` says, or None without one."""
        return None if read.result is None else cls.of(read.result, read.ended_at)

    def is_fresh(self, now: float) -> bool:
        """Whether it need not be asked for again."""
        return now - self.at <= FRESH_HASH


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a fetch is.

    Attributes:
        received: parameters that have come.
        total: parameters that the component has, or None before it said so.
        rate: parameters a second since the first one came.
        seconds_left: at that rate, or None while it cannot be told.
    """

    received: int
    total: int | None
    rate: float
    seconds_left: float | None

    @classmethod
    def after(cls, received: int, total: int | None, came: int, running: float) -> Progress:
        """What it is when so many of those received came in so many seconds."""
        rate = came / running if came > 0 and running > 0 else 0.0
        left = (total - received) / rate if rate and total is not None else None
        return cls(received, total, rate, left)


@dataclass(frozen=True, slots=True)
class FetchResult:
    """What `fetch_all` brought.

    Attributes:
        system, component: whose parameters.
        params: all that are known, by name, as they were at the end of the fetch.
        source: "cache" when the vehicle's hash confirmed the cached table, when the policy allows no more
            than the cache, or when a sample agreed with it; "ftp" when it came as one packed file, "stream"
            when it came by list.
        count: parameters that the component says it has.
        received: how many of them are known.
        missing: indices that did not come, rising. Empty when the fetch is complete.
        hash: the PX4 hash under which the vehicle confirmed the table; None for a vehicle without one, when
            the table moved during the download, and when the policy kept it from being asked.
        elapsed: seconds from the call to the end.
        resumed: how many were known already from an earlier download that did not come to its end.
        notes: what else is worth knowing, in sentences.
        lost: values that the list should have brought and did not, so that they had to be asked for one by
            one or by listing again; 0 from the cache.
        repeated: values that came although they had come before; 0 from the cache.
        round_trip: the component's measured round trip in seconds, smoothed, or None.
        sample: what a sample of the cached table has shown, where that settled the fetch: then nothing is
            *verified*, and `sample.confidence` says how far it can be trusted. Else None.
    """

    system: int
    component: int
    params: Mapping[str, Param]
    source: str
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
    sample: Sample | None = None

    @property
    def complete(self) -> bool:
        return not self.missing

    @property
    def sampled(self) -> bool:
        """Whether a sample of the cached table settled it, so that nothing of it is *verified*."""
        return self.sample is not None

    @property
    def has_moved(self) -> bool:
        """Whether the vehicle's hash has told that the table moved while it came: it may be a mixture."""
        return MOVED in self.notes

    @property
    def is_confirmed(self) -> bool:
        """Whether every value was heard in this session, or the vehicle's hash stands for it."""
        if not self.resumed or self.hash is not None:
            return True
        return all(param.trust is not Trust.CACHED or param.index is None for param in self.params.values())

    def __repr__(self) -> str:
        missing = f", {len(self.missing)} missing" if self.missing else ""
        return (
            f"<FetchResult {self.system}/{self.component} {self.received} params{missing} "
            f"from {self.source} in {self.elapsed:.2f} s>"
        )
