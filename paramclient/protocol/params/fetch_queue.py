"""The fetches of one component: one at a time, which everyone who wants one shares, and what follows each."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Final

from paramclient.protocol.params.fetch import Check, Fetch
from paramclient.protocol.params.fetch_result import FetchResult, Means, Policy, Sampled
from paramclient.protocol.params.passive import Overheard, Overhearing
from paramclient.protocol.params.sync import Sync, Upkeep
from paramclient.protocol.params.sync_interval import CheckPace
from paramclient.protocol.requests.machine import Machine

__all__ = ["Fetches"]

EARLY: Final = 0.25
"""Seconds by which a start may seem to be later than the first frame that shows it: messages are not equally
long on their way."""


class Fetches(Machine):
    """What was fetched, is being fetched, and can be.

    Args:
        means: what each of them works with.
        sync: the component's.
        upkeep: what may be asked.
        check_pace: is told how long fetches take.
        ended: is told of each result in which the vehicle has said something of its table.

    Attributes:
        last: the result of the last one that ended, or None.
        file_works: whether this vehicle, with this firmware, gives its table as a file: None while unknown.
        is_same_firmware: whether what the cache knows is of this very vehicle with this very firmware.
        overheard: what comes because others ask for it, where nothing may be asked here; else None.
    """

    def __init__(
        self,
        means: Means,
        sync: Sync,
        upkeep: Upkeep,
        check_pace: CheckPace,
        *,
        ended: Callable[[FetchResult], None],
    ) -> None:
        self._current: Fetch | None = None
        self.last: FetchResult | None = None
        self.file_works: bool | None = None
        self.is_same_firmware = False
        self._means = means
        self._sync = sync
        self._policy = upkeep.policy
        self.overheard: Overheard | None = None
        if upkeep.listens_only:
            self.overheard = Overheard(means, sync, whole=self._overheard_whole, is_log=upkeep.is_log)
        self._ended = ended
        self._check_pace = check_pace
        self._begun_anew_at = -math.inf  # of the last one

    @property
    def current(self) -> Fetch | None:
        """The fetch in progress, or None."""
        return self._current

    @current.setter
    def current(self, fetch: Fetch | None) -> None:
        self._current = fetch
        self._means.context.is_fetching = fetch is not None

    @property
    def notes(self) -> tuple[str, ...]:
        """What was not taken from files that others read, in sentences."""
        return () if self.overheard is None else tuple(self.overheard.file.notes)

    def may_use_file(self) -> bool:
        """Whether the table is worth asking for as a file: it has come as one, or the component says so."""
        return self._means.context.serves_file if self.file_works is None else self.file_works

    def begin(
        self,
        now: float,
        *,
        refresh: bool = False,
        listed: bool = False,
        by_list: bool = False,
        check: Check | None = None,
        sampled: Sampled | None = None,
    ) -> Fetch:
        """Begin one, or join the one under way; give it back with `end`.

        Args:
            now: the time.
            refresh: fetch even if the vehicle's hash would confirm the cached table.
            listed: the list has been asked for already, of all components at once.
            by_list: download by list also where the vehicle serves the file.
            check: how, where nobody waits for it but the watch; joined by a caller it is no check any more.
            sampled: the sample that may settle it where there is no hash, or None.
        """
        fetch = self.current
        if fetch is not None and check is None:
            fetch.check = None
        if fetch is not None and (
            (refresh and fetch.is_about_the_cache) or (sampled is None and fetch.is_sampling)
        ):
            fetch.restart(now)
        may_sample = self.is_same_firmware and self._policy is Policy.AUTO and not self._sync.is_doubted
        if fetch is None and self.overheard is not None:
            fetch = self.current = Overhearing(self._means, self.overheard, now)
            if fetch.done:
                self._overhearing_ended(fetch)
            else:
                fetch.on_done.append(partial(self._overhearing_ended, fetch))
        elif fetch is None:
            fetch = self.current = Fetch(
                self._means,
                now,
                announced=self._sync.announced,
                refresh=refresh,
                listed=listed,
                by_list=by_list,
                policy=self._policy,
                may_use_file=self.may_use_file,
                check=check,
                sampled=sampled if may_sample else None,
            )
            if fetch.done:
                self._fetch_ended(fetch)
            else:
                fetch.on_done.append(partial(self._fetch_ended, fetch))
        fetch.holders += 1
        return fetch

    def end(self, fetch: Fetch, now: float) -> None:
        """Wait for it no longer. The last one who waited cancels it."""
        fetch.holders -= 1
        if fetch.holders <= 0 and not fetch.done:
            fetch.cancel(now)
            if self.current is fetch:
                self.current = None

    def tick(self, now: float) -> None:
        """Do what is due of the fetch in progress, and of the files that others read."""
        if self.overheard is not None:
            self.overheard.file.tick(now)
        if self.current is not None:
            self.current.tick(now)

    def next_deadline(self) -> float:
        """See `Machine`."""
        first = math.inf if self.current is None else self.current.next_deadline()
        return first if self.overheard is None else min(first, self.overheard.file.next_deadline())

    def resume(self, now: float) -> None:
        """See `Machine`."""
        if self.current is not None:
            self.current.resume(now)

    def lose(self, now: float) -> None:
        """End the files that others read. A fetch goes on: the component may only be rebooting."""
        self.interrupt(now)

    def fail_all(self, error: Exception, now: float) -> None:
        """See `Machine`."""
        if self.current is not None:
            fetch = self.current
            fetch.cancel(now)
            fetch.fail(error, now)

    def interrupt(self, now: float) -> None:
        """The component is lost, or starts again: nothing more comes of the files that others read."""
        if self.overheard is not None:
            self.overheard.file.close(now)

    def seems_restarted(self, silent_since: float, now: float) -> bool:
        """The component may have started again, which its clock shows later; see `Fetch.seems_restarted`."""
        return self.current is not None and self.current.seems_restarted(silent_since, now)

    def are_since(self, started_at: float) -> bool:
        """Whether the table is of the run of the component that began then: wholly fetched since, or about to
        be.
        """
        fetch = self.current
        begun_anew_at = self._begun_anew_at if fetch is None else fetch.begun_anew_at
        return begun_anew_at >= started_at - EARLY

    def forget(self) -> None:
        """Another vehicle has taken the address."""
        if self.overheard is not None:
            self.overheard.file.forget()
            self.overheard.forget()
        self.file_works = None
        self._check_pace.forget()
        self.is_same_firmware = False

    def updated(self, now: float) -> None:
        """The vehicle has another firmware now, of which no sample says anything."""
        self._means.table.forget_defaults()
        self.forget()
        if self.current is not None and self.current.is_sampling:
            self.current.restart(now)

    def over(self, now: float) -> None:
        """Nothing more will come."""
        self.interrupt(now)
        if self.overheard is not None:
            self.overheard.is_over = True
        if isinstance(self.current, Overhearing):
            self.current.over(now)

    def _overheard_whole(self, result: FetchResult, now: float) -> None:
        """What others have asked for has made the table whole, or confirmed it."""
        self.last = result
        if self._sync.fetched(result, now):
            self._ended(result)
        if isinstance(self.current, Overhearing):
            self.current.came(result, now)

    def _overhearing_ended(self, fetch: Fetch) -> None:
        self.current = None
        self.last = fetch.result or self.last

    def _fetch_ended(self, fetch: Fetch) -> None:
        self.current = None
        self._means.context.trace("%s/%s: %r", *self._means.context.target, fetch.result or fetch.error)
        if fetch.file_failed is not None:
            self.file_works = not fetch.file_failed
        result = fetch.result
        is_whole = result is not None and result.complete
        self._begun_anew_at = fetch.begun_anew_at if is_whole else -math.inf
        if result is None:
            return
        self.last = result
        self._check_pace.fetched(result, fetch.held_up(fetch.ended_at))
        if self._sync.fetched(result, fetch.ended_at):
            self._ended(result)
