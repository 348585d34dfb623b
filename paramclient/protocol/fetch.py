"""Fetch all parameters: from the cache where the vehicle confirms it, else by file or by list."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal, TypeAlias

import anyio

from paramclient.errors import NoReply
from paramclient.model.names import NamedChoice, first_of
from paramclient.model.paramset import ParamMap
from paramclient.model.values import Param
from paramclient.protocol.checksum import is_moving
from paramclient.protocol.digest import Answer, ask, settle
from paramclient.protocol.file_download import download_file
from paramclient.protocol.ftp import SILENT_LOST
from paramclient.protocol.list_download import ListResult, download_list
from paramclient.protocol.reads import read_many
from paramclient.protocol.session import UNANSWERED, FileUnavailable, Session

FetchSource: TypeAlias = Literal["cache", "ftp", "stream"]
"""Where a fetch has the values from: the cache, the packed file (MAVFTP) or the list."""

IDENTITY_TIME: Final = 1.5
"""Seconds in which a fetch awaits the heartbeat that tells how a table is confirmed, and whether there is a
file."""
ROUNDS_MAX: Final = 3
"""Downloads, while the table changes during them."""
NOT_REFRESHED: Final = "The values outside the hash were not read again, because the policy is hash-only."
LEFT_OUT: Final = "Skipped {}: not every parameter file can hold such names."
NOT_READ: Final = "Values outside the vehicle's hash could not be read: {}."
CHANGED: Final = "Changed since they were cached: {}."
SHOWN_MAX: Final = 5
"""Names that a note has, so that it stays readable."""
INCOMPLETE: Final = "it has not all parameters, or the vehicle has another number of them by now"
UNCONFIRMED: Final = "The known table was not confirmed: {}."
LOST: Final = "The component was lost."
REPLACED: Final = "Another vehicle has taken the address, and its parameters were fetched: {}."
PROGRESS_RATE_TIME_MIN: Final = 0.1
"""Seconds of a fetch from which its rate is given: a burst of packets arrives at once."""


class Policy(NamedChoice):
    """The requests that a fetch may send."""

    AUTO = "auto"
    """Whatever is cheapest and certain."""
    HASH_ONLY = "hash-only"
    """The digest only, for a vehicle in flight or a metered link: a table that it does not confirm stays as
    cached."""
    CACHE_ONLY = "cache-only"
    """None."""


@dataclass(frozen=True, slots=True)
class Progress:
    """The progress of a fetch.

    Attributes:
        received: parameters received.
        total: parameters of the component, or None while unknown.
        rate: parameters per second since the fetch began; 0 in the first 0.1 s.
        seconds_left: at that rate, or None while unknown.
    """

    received: int
    total: int | None
    rate: float = 0.0
    seconds_left: float | None = None

    @classmethod
    def after(cls, received: int, total: int | None, elapsed: float) -> Progress:
        """Return the progress `elapsed` seconds after the begin."""
        rate = received / elapsed if elapsed >= PROGRESS_RATE_TIME_MIN else 0.0
        return cls(received, total, rate, (total - received) / rate if rate and total is not None else None)


@dataclass(frozen=True, slots=True)
class FetchResult:
    """The result of `fetch_all`.

    Attributes:
        system, component: the component's address.
        params: all known parameters by name, as they were at the end of the fetch.
        source: "cache" when the vehicle confirmed the cached table, or the policy allows only the cache;
            "ftp" for the packed file, "stream" for the list.
        count: parameters that the component says it has.
        missing: indices that were neither received in this fetch nor confirmed, rising. Empty when it is
            complete. A policy other than AUTO counts cached values as there.
        cached: names whose values were neither received in this fetch nor confirmed.
        hash: the PX4 hash, or ArduPilot's checksum, by which the vehicle confirmed the table, or None.
        elapsed: seconds from the call to the end.
        notes: further sentences for the user.
        lost: values of the list that were lost, so that they had to be read one by one or by another list.
        repeated: values received more than once.
        round_trip: the measured round trip in seconds, smoothed, or None.
        changed: names whose cached values were others, where an ArduPilot computed a checksum of the table;
            without those that it changes itself at each start or all the time.
    """

    system: int
    component: int
    params: Mapping[str, Param]
    source: FetchSource
    count: int
    missing: tuple[int, ...]
    hash: int | None
    elapsed: float
    notes: tuple[str, ...] = ()
    lost: int = 0
    repeated: int = 0
    round_trip: float | None = None
    changed: tuple[str, ...] = ()
    cached: tuple[str, ...] = ()

    @property
    def received(self) -> int:
        """Parameters of the list that are not missing."""
        return self.count - len(self.missing)

    @property
    def complete(self) -> bool:
        """Whether no parameter of the list is missing."""
        return self.count > 0 and not self.missing

    def __repr__(self) -> str:
        missing = f", {len(self.missing)} missing" if self.missing else ""
        what = f"{self.received} params{missing} from {self.source} in {self.elapsed:.2f} s"
        return f"<FetchResult {self.system}/{self.component} {what}>"


async def fetch_all(
    session: Session,
    *,
    refresh: bool = False,
    policy: Policy = Policy.AUTO,
    progress: Callable[[Progress], None] | None = None,
) -> FetchResult:
    """Fetch all parameters into the table. Callers at the same time share one fetch.

    A cached table that the vehicle confirms is kept, and the values outside its digest are read. Otherwise
    the table is downloaded: as a file where that is served, as a list elsewhere. A component that is lost
    ends the fetch with what was received.

    Args:
        session: the component's.
        refresh: download also if the vehicle confirms the table.
        policy: the requests that may be sent.
        progress: called as values arrive.

    Raises:
        NoReply: the component does not answer.
        LinkError: the link is closed for good.
    """

    began = anyio.current_time()

    def observe(received: int, total: int | None) -> None:
        if progress is not None:
            progress(Progress.after(received, total, anyio.current_time() - began))

    session.observers.add(observe)
    try:
        while True:
            result: FetchResult = await session.fetching.join(
                lambda: _Fetch(session, policy).run(refresh=refresh)
            )
            if not refresh or result.source != "cache":  # else another caller began it
                return result
    finally:
        session.observers.discard(observe)


class _Fetch:
    """One fetch, while it runs."""

    def __init__(self, session: Session, policy: Policy) -> None:
        self.session = session
        self.table = session.table
        self.policy = policy
        self.notes: list[str] = []
        self.listed = ListResult()
        self._began = anyio.current_time()
        self._before = dict(session.table.params)
        self._changed: tuple[str, ...] = ()
        self._ftp_is_silent = False
        self._vehicles = session.identification.vehicles

    async def run(self, *, refresh: bool) -> FetchResult:
        """Fetch, and return the result."""
        if self.policy is Policy.CACHE_ONLY:
            return self._unconfirmed()
        wait = 0.0 if self.session.dialect.has_ack else IDENTITY_TIME
        with self.session.channel.gate.until_closed(or_failed=True), anyio.move_on_after(wait):
            await self.session.identification.heard()
        answer = Answer()
        if self.table.is_complete or self.policy is Policy.HASH_ONLY:
            answer = await ask(self.session, refresh=refresh)
        elif self.session.identification.is_ardupilot and not refresh:
            is_cached = any(self._before[name].index is not None for name in self.table.unverified())
            answer = Answer(reason=INCOMPLETE * is_cached, is_other=is_cached and self.table.was_complete)
        if answer.is_current:
            self._name_changes()
            if self.policy is Policy.AUTO:
                await self._read_unverified()
            elif self.table.unverified():
                self.notes.append(NOT_REFRESHED)
            if not self._is_replaced():
                return self._result("cache")
        if answer.reason:
            self.notes.append(UNCONFIRMED.format(answer.reason))
        if self.policy is Policy.HASH_ONLY:
            return self._unconfirmed()
        self._ftp_is_silent, digest = answer.is_silent, answer.digest
        source: FetchSource = "stream"
        for _ in range(ROUNDS_MAX):
            if self.session.channel.is_silent(self._began):
                break
            source = await self._download()
            is_whole = self.table.is_complete and not self.listed.missing
            if not self._is_replaced() and (
                not is_whole or await settle(self.session, digest, self.listed.digest, self.notes)
            ):
                break
            digest = None  # it was of the table before
        if answer.is_other or (answer.reason == UNANSWERED and self.session.serves_checksum):
            self._name_changes()
        return self._result(source)

    def _is_replaced(self) -> bool:
        """Return whether another vehicle has taken the address since the last call, and tell so."""
        identification, before = self.session.identification, self._vehicles
        self._vehicles = identification.vehicles
        if self._vehicles != before:
            self.notes.append(REPLACED.format(identification.identity))
            self._before.clear()
        return self._vehicles != before

    def _name_changes(self) -> None:
        """Take note of the values that are others than at the begin, without those that change themselves."""
        changed = differing(self._before, self.table.params) if self._before else ()
        self._changed = tuple(name for name in changed if not is_moving(name))
        if self._changed:
            self.notes.append(CHANGED.format(first_of(self._changed, SHOWN_MAX)))

    async def _download(self) -> FetchSource:
        """Download the file, or the list where there is none."""
        session = self.session
        has_file = session.serves_file is not False and session.identification.may_serve_file
        if has_file and not self._ftp_is_silent and not session.dialect.has_ack:
            try:
                await download_file(session)
                self.table.complete()
                return "ftp"
            except FileUnavailable as error:
                if session.channel.is_silent(self._began):
                    return "ftp"
                self.notes.append(f"Downloaded as a list: {error.reason}.")
                self._ftp_is_silent = error.is_silent
        began = anyio.current_time()
        self.listed = await download_list(session)
        by_loss = session.channel.timing.attempts_for(SILENT_LOST) if self.listed.lost else 0
        if self._ftp_is_silent and not self.listed.missing and session.ftp_unanswered >= by_loss:
            session.serves_file = False
        with session.channel.gate.until_closed(or_failed=True):
            await session.identification.encoding_certain()
        if not self.listed.missing:
            self.table.complete(began)
        return "stream"

    async def _read_unverified(self) -> None:
        """Read the values that the digest does not cover."""
        is_px4, table = self.session.identification.is_px4, self.table
        outside = table.volatile & table.params.keys() if is_px4 else set[str]()
        await read_many(self.session, names := sorted({*table.unverified(), *outside}))
        if left := [name for name in names if table.moments.get(name, math.inf) < self._began]:
            table.doubt(*left)
            self.notes.append(NOT_READ.format(first_of(left, SHOWN_MAX)))

    def _unconfirmed(self) -> FetchResult:
        """Return the table as it is cached."""
        self.notes.append(f"The vehicle has not confirmed the cached table: the policy is {self.policy}.")
        return replace(self._result("cache"), hash=None)

    def _result(self, source: FetchSource) -> FetchResult:
        channel, moments = self.session.channel, self.table.moments.values()
        if self.policy is Policy.AUTO and channel.is_silent(self._began):
            if source != "cache" and max(moments, default=-math.inf) < self._began:
                waited = anyio.current_time() - self._began
                raise NoReply(f"the parameters of {channel}", attempts=0, waited=waited)
            self.notes.append(LOST)
        if left_out := sorted(map(repr, self.table.left_out)):
            self.notes.append(LEFT_OUT.format(first_of(left_out, SHOWN_MAX)))
        if doubt := self.session.encoding_doubt:
            self.notes.append(doubt)
        result = result_of(
            self.session, source, self._began, self.notes, policy=self.policy, listed=self.listed
        )
        return replace(result, changed=self._changed)


def result_of(
    session: Session,
    source: FetchSource,
    began: float,
    notes: Iterable[str],
    *,
    policy: Policy,
    listed: ListResult | None = None,
) -> FetchResult:
    """Return the result of a fetch with the table as it is; of a partial one where it was ended."""
    channel, table, listed = session.channel, session.table, listed or ListResult()
    cached, missing = dict.fromkeys(table.unverified(began)), {*table.missing(), *listed.missing}
    if policy is Policy.AUTO:
        missing |= {index for index, name in table.names.items() if name in cached}
    return FetchResult(
        channel.system,
        channel.component,
        ParamMap(dict(table.params)),
        source,
        table.count or len(table.params) + len(missing),  # none where it cannot be one
        tuple(sorted(missing)),
        table.hash if table.is_complete and (source == "cache" or not missing) else None,
        anyio.current_time() - began,
        tuple(dict.fromkeys(notes)),
        listed.lost,
        listed.repeated,
        channel.timing.round_trip,
        cached=tuple(cached),
    )


def differing(before: Mapping[str, Param], now: Mapping[str, Param]) -> tuple[str, ...]:
    """Return the names whose parameters are others than before, new, or gone."""
    names = dict.fromkeys([*before, *now])
    return tuple(
        name for name in names if (name in before) != (name in now) or not before[name].same_value(now[name])
    )
