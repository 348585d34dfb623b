"""Bring a component's table up to date the cheapest sure way: by the vehicle's hash, or by its list."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Final

from paramclient.errors import CacheError, NoReply, UnknownParameter
from paramclient.protocol.download import Download
from paramclient.protocol.hashing import find_volatile
from paramclient.protocol.operation import Operation
from paramclient.protocol.reads import Read, Reads
from paramclient.protocol.repeated import Repeated, repeated_names
from paramclient.protocol.table import Change, Table
from paramclient.protocol.timing import RoundTrip
from paramclient.protocol.wire import HASH_CHECK, Message, ParamValue
from paramclient.values import Param

__all__ = ["Announcement", "Fetch", "FetchResult", "Policy", "Progress"]

FRESH_HASH: Final = 1.0
"""Seconds for which an announced hash answers the question what the hash is. It is asked for when a component
is found, so that a fetch right after that need not wait for another round trip."""
MOST_RESTARTS: Final = 8
"""Times that a vehicle may start again, or turn out to be another one, before a fetch is given up."""


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
class Announcement:
    """A `_HASH_CHECK` that the vehicle has sent: its hash, the count with it, and when it came."""

    hash: int
    count: int
    at: float


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


@dataclass(frozen=True, slots=True)
class FetchResult:
    """What `fetch_all` brought.

    Attributes:
        system, component: whose parameters.
        params: all that are known, by name, as they were at the end of the fetch.
        source: "cache" when the vehicle's hash confirmed the cached table, or when the policy allows no more
            than the cache; "stream" when it was downloaded.
        count: parameters that the component says it has.
        received: how many of them are known.
        missing: indices that did not come, rising. Empty when the fetch is complete.
        hash: the PX4 hash under which the vehicle confirmed the table; None for a vehicle without one, when
            the table moved during the download, and when the policy kept it from being asked.
        elapsed: seconds from the call to the end.
        notes: what else is worth knowing, in sentences.
        lost: values that the list should have brought and did not, so that they had to be asked for one by
            one or by listing again; 0 from the cache.
        repeated: values that came although they had come before; 0 from the cache.
        round_trip: the component's measured round trip in seconds, smoothed, or None.
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
    lost: int = 0
    repeated: int = 0
    round_trip: float | None = None

    @property
    def complete(self) -> bool:
        return not self.missing

    def __repr__(self) -> str:
        missing = f", {len(self.missing)} missing" if self.missing else ""
        return (
            f"<FetchResult {self.system}/{self.component} {self.received} params{missing} "
            f"from {self.source} in {self.elapsed:.2f} s>"
        )


class Fetch(Operation[FetchResult]):
    """One fetch: hash first where a cached table has one, else or on a difference the list.

    The table that a download brought is confirmed when the hash that is computed from it is one that the
    vehicle announced in the course of it, or when the vehicle announced the same before and after: then
    nothing moved between. For the latter it is asked for once more after the download.

    Attributes:
        holders: how many wait for it; with none left it is cancelled.
        download: the download by list, once it is needed.
    """

    def __init__(
        self,
        target: tuple[int, int],
        round_trip: RoundTrip,
        send: Callable[[Message], None],
        reads: Reads,
        table: Table,
        now: float,
        *,
        announced: Announcement | None,
        expects_hash: Callable[[], bool],
        refresh: bool,
        listed: bool,
        policy: Policy,
        changed: Callable[[list[Change]], None],
        doubt: Callable[[float], None],
    ) -> None:
        super().__init__(now)
        self._target = target
        self._round_trip = round_trip
        self._send = send
        self._reads = reads
        self._table = table
        self._changed = changed
        self._doubt = doubt
        self._expects_hash = expects_hash
        self._hash_read: Read | None = None
        self._before: Announcement | None = None  # announced before any value counted
        self._meanwhile: Announcement | None = None  # announced in the course of the download
        self._was_asked_meanwhile = False
        self._is_hash_unknown = False  # the vehicle answers, but not to that
        self._first_value_at = math.inf
        self._listed = listed
        self._repeated: Repeated | None = None
        self._policy = policy
        self._restarts = 0
        self.holders = 0
        self.download: Download | None = None
        if policy is Policy.CACHE_ONLY or refresh or listed or table.hash is None or not table.complete:
            self._begin_download(now)
        elif announced is not None and now - announced.at <= FRESH_HASH:
            self._compare(announced, now)
        else:
            self._ask_hash(self._hash_came_first, now)

    def announced(self, announcement: Announcement) -> None:
        """A `_HASH_CHECK` passed by: PX4 sends one at the head of its list."""
        if self.download is not None and not self.download.names:
            self.download.heed(announcement.at)
            if self._before is None:
                self._before = announcement

    def heard(self, message: ParamValue, now: float) -> None:
        """Every PARAM_VALUE of the component passes here, before the reads take their answers."""
        download = self.download
        if download is not None and not download.done:
            if self._first_value_at > now:
                self._first_value_at = now
            download.heard(message, now)
            if self._before is not None or self._was_asked_meanwhile:
                return
            if self._expects_hash() and not self.done:
                # the one at the head of the list was lost; asked for now, it need not be waited for later
                self._was_asked_meanwhile = True
                self._ask_hash(self._hash_came_meanwhile, now)

    def tick(self, now: float) -> None:
        if self.download is not None:
            self.download.tick(now)
        if self._repeated is not None:
            self._repeated.tick(now)

    def next_deadline(self) -> float:
        if self._repeated is not None:
            return self._repeated.next_deadline()
        return math.inf if self.download is None else self.download.next_deadline()

    def resume(self, now: float) -> None:
        """The link is back."""
        if self.download is not None:
            self.download.resume(now)

    def restart(self, now: float) -> None:
        """The vehicle is another one, or has started again: what came is not about it. Fetch it anew."""
        self._drop()
        self._restarts += 1
        if self._restarts > MOST_RESTARTS:
            system, component = self._target
            what = f"the parameters of {system}/{component}, which has started again {self._restarts} times"
            self.fail(NoReply(what, attempts=self._restarts, waited=now - self.begun_at), now)
            return
        self._before = self._meanwhile = None
        self._was_asked_meanwhile = False
        self._listed = False
        self._begin_download(now)

    def cancel(self) -> None:
        """Nobody waits any more. What is on its way still goes into the table."""
        self._drop()

    def partial(self, now: float, note: str) -> FetchResult:
        """What has come so far, for someone whose time is up while it goes on.

        Raises:
            NoReply: nothing has come.
        """
        download = self.download
        if download is None or download.count is None:
            system, component = self._target
            attempts = 1 if download is None else download.lists
            waited = now - self.begun_at
            raise NoReply(f"the parameters of {system}/{component}", attempts=attempts, waited=waited)
        return self._result("stream", download.count, download.missing, None, now, (note,))

    @property
    def is_silent(self) -> bool:
        """Whether nothing has come although it was asked for more than once."""
        if self.download is not None:
            return self.download.count is None and self.download.lists > 1
        read = self._hash_read
        return read is not None and read.attempts > 1 and not read.controls

    def progress(self, now: float) -> Progress:
        """How far it is."""
        received, total = (0, self._table.count) if self.download is None else self.download.progress
        running = now - self._first_value_at
        rate = received / running if received and running > 0 else 0.0
        left = (total - received) / rate if rate and total is not None else None
        return Progress(received, total, rate, left)

    def _ask_hash(self, then: Callable[[Read], None], now: float) -> None:
        read = self._hash_read = self._reads.ask(HASH_CHECK, now)

        def ended() -> None:
            if self._hash_read is read:
                self._hash_read = None
                then(read)

        read.on_done.append(ended)

    def _hash_came_meanwhile(self, read: Read) -> None:
        self._meanwhile = _announced_in(read)
        self._is_hash_unknown = isinstance(read.error, UnknownParameter)
        if self.download is not None and self.download.done:
            self._download_ended(self.download)

    def _hash_came_first(self, read: Read) -> None:
        announcement = _announced_in(read)
        if announcement is None:
            self._begin_download(read.ended_at)
        else:
            self._compare(announcement, read.ended_at)

    def _compare(self, announcement: Announcement, now: float) -> None:
        table = self._table
        listed = table.listed()
        if announcement.hash != table.hash or announcement.count != len(listed):
            self._before = announcement
            self._begin_download(now)
            return
        table.count = announcement.count
        table.verify()
        notes = () if table.volatile_known else (_UNPROVEN,)
        self.finish(self._result("cache", announcement.count, (), announcement.hash, now, notes), now)

    def _begin_download(self, now: float) -> None:
        if self._policy is not Policy.AUTO:
            self._stay_with_cache(now)
            return
        self._doubt(now)
        download = self.download = Download(
            self._target, self._round_trip, self._send, self._reads, now, listed=self._listed
        )

        download.on_done.append(partial(self._download_ended, download))

    def _stay_with_cache(self, now: float) -> None:
        """The policy allows no download: give what is known, and say so."""
        table = self._table
        if not table.params:
            system, component = self._target
            what = (
                f"nothing is cached of {system}/{component}, and the policy {self._policy} allows no download"
            )
            self.fail(CacheError(what), now)
            return
        present = {param.index for param in table.listed()}
        count = len(present) if table.count is None else table.count
        missing = tuple(index for index in range(count) if index not in present)
        note = _NOT_ASKED if self._policy is Policy.CACHE_ONLY else _NOT_CONFIRMED
        self.finish(self._result("cache", count, missing, None, now, (note,)), now)

    def _download_ended(self, download: Download) -> None:
        if download.error is not None:
            self.fail(download.error, download.ended_at)
            return
        if self._hash_read is not None or self._asks_for_repeated(download):
            return  # it is on its way
        now = download.ended_at if self._repeated is None else self._repeated.ended_at
        if self._is_proven(download):
            self._finish_download(download, now, ())
        elif self._expects_hash() and not self._is_hash_unknown:
            self._ask_hash(partial(self._hash_came_last, download), now)
        else:
            self._settle(download, None, now)

    def _asks_for_repeated(self, download: Download) -> bool:
        """Whether it is still being asked what the vehicle means by names that came more than once."""
        if self._repeated is None:
            names = repeated_names(download.names)
            if not (names or self._table.passed_over):
                return False
            self._repeated = Repeated(names, self._round_trip, self._reads, self._table, download.ended_at)
            self._repeated.on_done.append(lambda: self._download_ended(download))
        return not self._repeated.done

    def _is_proven(self, download: Download) -> bool:
        """Whether the hash computed from what came is the one that was announced meanwhile.

        Then the table is what the vehicle had at that moment, and the hash need not be waited for again.
        """
        announced = self._before if self._meanwhile is None else self._meanwhile
        if announced is None or download.missing or not download.is_settled:
            return False
        if announced.count != download.count:
            return False  # what came into use since would be taken for what the hash leaves out
        self._remove_what_is_gone(download)
        table = self._table
        volatile, is_proven = find_volatile(table.listed(), announced.hash, believed=table.volatile)
        if is_proven:
            table.confirm(announced.hash, volatile, proven=True)
        return is_proven

    def _remove_what_is_gone(self, download: Download) -> None:
        present = frozenset(download.names.values())
        gone = self._table.remove(lambda param: param.index is not None and param.name not in present)
        self._changed(gone)

    def _hash_came_last(self, download: Download, read: Read) -> None:
        self._settle(download, _announced_in(read), read.ended_at)

    def _settle(self, download: Download, after: Announcement | None, now: float) -> None:
        """The download is over and the hash is known, if there is one."""
        table = self._table
        notes: tuple[str, ...] = ()
        if not download.missing:
            self._remove_what_is_gone(download)
            if not download.is_settled:
                notes = (_UNSETTLED,)
            table.unconfirm()
        if after is not None and not download.missing:
            before = self._before
            if after.count != download.count:
                notes += (_MOVED,)
            else:
                volatile, proven = find_volatile(table.listed(), after.hash, believed=table.volatile)
                if proven or (before is not None and before.hash == after.hash):
                    table.confirm(after.hash, volatile, proven=proven)
                    notes += () if proven else (_UNPROVEN,)
                else:
                    notes += (_UNBRACKETED,) if before is None else (_MOVED,)
        self._finish_download(download, now, notes)

    def _finish_download(self, download: Download, now: float, notes: tuple[str, ...]) -> None:
        count = download.count or 0
        missing = download.missing
        table = self._table
        if self._repeated is not None and self._repeated.names:
            notes += (self._repeated.note,)
            table.complete = False
        elif not missing:
            table.complete = download.is_settled
        table.count = count
        self.finish(
            self._result("stream", count, missing, table.hash if not missing else None, now, notes), now
        )

    def _result(
        self,
        source: str,
        count: int,
        missing: tuple[int, ...],
        confirmed: int | None,
        now: float,
        notes: tuple[str, ...],
    ) -> FetchResult:
        params = dict(self._table.params)
        received = count - len(missing)
        elapsed = now - self.begun_at
        download = self.download
        return FetchResult(
            *self._target,
            params,
            source,
            count,
            received,
            missing,
            confirmed,
            elapsed,
            notes,
            lost=0 if download is None else download.lost,
            repeated=0 if download is None else download.repeated,
            round_trip=self._round_trip.smoothed,
        )

    def _drop(self) -> None:
        read, self._hash_read = self._hash_read, None
        if read is not None:
            self._reads.release(read)
        repeated, self._repeated = self._repeated, None
        if repeated is not None:
            repeated.cancel()
        if self.download is not None:
            self.download.cancel()


def _announced_in(read: Read) -> Announcement | None:
    """What the answer to a read of `_HASH_CHECK` says, or None without one."""
    message = read.result
    if message is None:
        return None
    return Announcement(int.from_bytes(message.raw, "little"), message.param_count, read.ended_at)


_UNPROVEN = (
    "Which parameters this firmware leaves out of its hash could not be proven, "
    "so after a start from the cache every value is read afresh."
)
_MOVED = "The table moved during the download, so no hash stands for it; the next session downloads it again."
_UNBRACKETED = (
    "No hash was heard before the download, and what this firmware leaves out of it could not be proven, "
    "so none stands for the table; the next session downloads it again."
)
_NOT_ASKED = "The vehicle was not asked, as the policy is cache-only: the values are those last known."
_NOT_CONFIRMED = (
    "The vehicle's hash did not confirm the cached table, and the policy hash-only allows no download: "
    "the values are those last known."
)
_UNSETTLED = "The number of parameters kept changing during the download."
