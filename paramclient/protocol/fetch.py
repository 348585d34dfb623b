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
from paramclient.protocol.table import Change, Table
from paramclient.protocol.timing import RoundTrip
from paramclient.protocol.turns import Turns
from paramclient.protocol.wire import HASH_CHECK, Message, ParamValue
from paramclient.values import Param, Trust

__all__ = ["Announcement", "Fetch", "FetchResult", "Policy", "Progress", "present_of"]

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


ENOUGH_PRESENT: Final = 0.5
"""The share of a table that must be there for its rest to be worth asking for one by one, where it is not
known how fast the list comes."""


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
        resumed: how many were known already from an earlier download that did not come to its end.
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
    resumed: int = 0
    lost: int = 0
    repeated: int = 0
    round_trip: float | None = None

    @property
    def complete(self) -> bool:
        return not self.missing

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


class Fetch(Operation[FetchResult]):
    """One fetch: hash first where a cached table has one, else or on a difference the list.

    The table that a download brought is confirmed when the hash that is computed from it is one that the
    vehicle announced in the course of it, or when the vehicle announced the same before and after: then
    nothing moved between. For the latter it is asked for once more after the download.

    What an earlier download has left unfinished is gone on with, when the count is still the same. With a
    hash it must be proven in the end, or all is downloaded after all; without one what the cache knows stays
    *cached*.

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
        turns: Turns,
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
        self._turns = turns
        self._changed = changed
        self._doubt = doubt
        self._expects_hash = expects_hash
        self._hash_read: Read | None = None
        self._before: int | None = None  # the hash announced before any value counted
        self._meanwhile: int | None = None  # the hash announced in the course of the download
        self._was_asked_meanwhile = False
        self._is_hash_unknown = False  # the vehicle answers, but not to that
        self._first_value_at = math.inf
        self._held_before = 0.0  # by a download that was begun anew
        self._listed = listed
        self._policy = policy
        self._restarts = 0
        self.holders = 0
        self.download: Download | None = None
        self._notes: tuple[str, ...] = ()
        if policy is Policy.CACHE_ONLY or refresh or listed:
            self._begin_download(now)
        elif table.hash is None or not table.complete:
            self._begin_or_resume(announced, now)
        elif announced is not None and now - announced.at <= FRESH_HASH:
            self._compare(announced, now)
        else:
            self._ask_hash(self._hash_came_first, now)

    def announced(self, announcement: Announcement) -> None:
        """A `_HASH_CHECK` passed by: PX4 sends one at the head of its list."""
        if self.download is not None and not self.download.names:
            self.download.heed(announcement.at)
            if self._before is None:
                self._before = announcement.hash

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

    def next_deadline(self) -> float:
        return math.inf if self.download is None else self.download.next_deadline()

    def resume(self, now: float) -> None:
        """The link is back."""
        if self.download is not None:
            self.download.resume(now)

    def restart(self, now: float) -> None:
        """The vehicle is another one, or has started again: what came is not about it. Fetch it anew."""
        self._drop()
        held_up = self.held_up(now)
        self._restarts += 1
        if self._restarts > MOST_RESTARTS:
            system, component = self._target
            what = f"the parameters of {system}/{component}, which has started again {self._restarts} times"
            self.fail(NoReply(what, attempts=self._restarts, waited=now - self.begun_at), now)
            return
        self._held_before = held_up
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

    def held_up(self, now: float) -> float:
        """Seconds for which its list has waited for its turn: other lists of the same link ran."""
        return self._held_before + (0.0 if self.download is None else self.download.held_for(now))

    def progress(self, now: float) -> Progress:
        """How far it is."""
        received, total = (0, self._table.count) if self.download is None else self.download.progress
        running = now - self._first_value_at
        came = received - (0 if self.download is None else self.download.resumed)
        rate = came / running if came > 0 and running > 0 else 0.0
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
        if read.result is not None:
            self._meanwhile = int.from_bytes(read.result.raw, "little")
        self._is_hash_unknown = isinstance(read.error, UnknownParameter)
        if self.download is not None and self.download.done:
            self._download_ended(self.download)

    def _hash_came_first(self, read: Read) -> None:
        if read.result is None:
            self._begin_download(read.ended_at)
        else:
            message = read.result
            announced = int.from_bytes(message.raw, "little")
            self._compare(Announcement(announced, message.param_count, read.ended_at), read.ended_at)

    def _compare(self, announcement: Announcement, now: float) -> None:
        table = self._table
        listed = table.listed()
        if announcement.hash != table.hash or announcement.count != len(listed):
            self._before = announcement.hash
            self._begin_download(now)
            return
        table.count = announcement.count
        table.verify()
        notes = () if table.volatile_known else (_UNPROVEN,)
        if self._policy is Policy.HASH_ONLY:
            notes = (_NOT_REFRESHED,) if table.unhashed() else ()
        self.finish(self._result("cache", announcement.count, (), announcement.hash, now, notes), now)

    def _begin_or_resume(self, announced: Announcement | None, now: float) -> None:
        """Go on with what is there, if that is enough and the vehicle's count is still the same."""
        if not present_of(self._table, self._reads):
            self._begin_download(now)
        elif not self._expects_hash():
            self._resume(now)
        elif announced is not None and now - announced.at <= FRESH_HASH:
            self._resume_under(announced, now)
        else:
            self._ask_hash(self._hash_came_to_resume, now)

    def _hash_came_to_resume(self, read: Read) -> None:
        if read.result is not None:
            message = read.result
            announced = int.from_bytes(message.raw, "little")
            self._resume_under(Announcement(announced, message.param_count, read.ended_at), read.ended_at)
        elif isinstance(read.error, UnknownParameter):
            self._is_hash_unknown = True
            self._resume(read.ended_at)
        else:
            self._begin_download(read.ended_at)

    def _resume_under(self, announcement: Announcement, now: float) -> None:
        self._before = announcement.hash
        if announcement.count == self._table.count:
            self._resume(now)
        else:
            self._begin_download(now)

    def _resume(self, now: float) -> None:
        self._begin_download(now, present=present_of(self._table, self._reads))

    def _begin_download(self, now: float, present: Mapping[int, str] | None = None) -> None:
        if self._policy is not Policy.AUTO:
            self._stay_with_cache(now)
            return
        self._doubt(now)
        download = self.download = Download(
            self._target,
            self._round_trip,
            self._send,
            self._reads,
            self._turns,
            now,
            listed=self._listed,
            count=self._table.count,
            present=present,
        )
        if download.done:
            self._download_ended(download)
        download.on_done.append(partial(self._download_ended, download))

    def _stay_with_cache(self, now: float) -> None:
        """The policy allows no download: give what is known, and say so."""
        table = self._table
        if not table.params:
            system, component = self._target
            what = f"nothing is cached of {system}/{component}, and the policy is {self._policy}"
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
        elif self._hash_read is not None:
            return  # it is on its way
        elif self._is_proven(download):
            self._finish_download(download, download.ended_at, ())
        elif self._expects_hash() and not self._is_hash_unknown:
            self._ask_hash(partial(self._hash_came_last, download), download.ended_at)
        else:
            self._settle(download, None, download.ended_at)

    def _is_proven(self, download: Download) -> bool:
        """Whether the hash computed from what came is the one that was announced meanwhile.

        Then the table is what the vehicle had at that moment, and the hash need not be waited for again.
        """
        announced = self._before if self._meanwhile is None else self._meanwhile
        if announced is None or download.missing or not download.is_settled:
            return False
        self._remove_what_is_gone(download)
        table = self._table
        volatile, is_proven = find_volatile(table.listed(), announced, believed=table.volatile)
        if is_proven:
            table.confirm(announced, volatile, proven=True)
            table.verify()
        return is_proven

    def _remove_what_is_gone(self, download: Download) -> None:
        table = self._table
        table.place(download.names)
        present = frozenset(download.names.values())
        gone = table.remove(
            lambda param: (
                param.name not in present and (param.index is not None or param.name in table.displaced)
            )
        )
        table.displaced.clear()
        self._changed(gone)

    def _hash_came_last(self, download: Download, read: Read) -> None:
        after = None if read.result is None else int.from_bytes(read.result.raw, "little")
        self._settle(download, after, read.ended_at)

    def _settle(self, download: Download, after: int | None, now: float) -> None:
        """The download is over and the hash is known, if there is one."""
        table = self._table
        notes: tuple[str, ...] = ()
        if not download.missing:
            self._remove_what_is_gone(download)
            if not download.is_settled:
                notes = (_UNSETTLED,)
            table.unconfirm()
        if after is not None and not download.missing:
            volatile, proven = find_volatile(table.listed(), after, believed=table.volatile)
            if download.resumed and not proven:
                # what was heard earlier is not what the vehicle has now, or cannot be told from it
                self._notes = (_NOT_RESUMED,)
                self._before = self._meanwhile = None
                self._was_asked_meanwhile = False
                self._begin_download(now)
                return
            if proven or after == self._before:
                table.confirm(after, volatile, proven=proven)
                table.verify()
                notes += () if proven else (_UNPROVEN,)
            else:
                notes += (_UNBRACKETED,) if self._before is None else (_MOVED,)
        self._finish_download(download, now, notes)

    def _finish_download(self, download: Download, now: float, notes: tuple[str, ...]) -> None:
        count = download.count or 0
        missing = download.missing
        table = self._table
        if not missing:
            table.complete = download.is_settled
        else:
            table.place(download.names)
        table.count = count
        if download.resumed and table.hash is None:
            earlier = sum(param.trust is Trust.CACHED for param in table.listed())
            notes += (_FROM_MEMORY.format(earlier),) if earlier else ()
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
            self._notes + notes,
            resumed=0 if download is None else download.resumed,
            lost=0 if download is None else download.lost,
            repeated=0 if download is None else download.repeated,
            round_trip=self._round_trip.smoothed,
        )

    def _drop(self) -> None:
        read, self._hash_read = self._hash_read, None
        if read is not None:
            self._reads.release(read)
        if self.download is not None:
            self.download.cancel()


def present_of(table: Table, reads: Reads) -> dict[int, str]:
    """What is there of an unfinished table, by index; nothing where that is too little to go on with."""
    count = table.count
    if table.complete or not count:
        return {}
    present = table.present()
    # with a list's pace measured, the download finds out itself whether another one is faster
    return present if reads.pace.gap or len(present) >= ENOUGH_PRESENT * count else {}


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
_NOT_REFRESHED = "What the hash leaves out was not read afresh, as the policy is hash-only."
_UNSETTLED = "The number of parameters kept changing during the download."
_NOT_RESUMED = (
    "What an earlier download had brought could not be confirmed by the vehicle's hash, "
    "so all was downloaded anew."
)
_FROM_MEMORY = (
    "{} values are those of an earlier session: this vehicle has no hash to confirm them. "
    "A fetch with refresh=True reads them anew."
)
