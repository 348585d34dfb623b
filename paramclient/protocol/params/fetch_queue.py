"""The fetches of one component: one at a time, shared by all callers, and the handling of each result."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Final

from paramclient.protocol.params.fetch import Check, Fetch
from paramclient.protocol.params.fetch_result import FetchContext, FetchResult
from paramclient.protocol.params.passive import PassiveFetch, PassiveTable
from paramclient.protocol.params.sync import Sync, SyncSettings
from paramclient.protocol.requests.machine import Machine

__all__ = ["Fetches"]

BOOT_TIME_TOLERANCE: Final = 0.25
"""Seconds by which a boot may seem later than the first frame after it: the latency of messages differs."""


class Fetches(Machine):
    """The last fetch, the one in progress, and what may be fetched.

    Args:
        fetch_context: the objects that each fetch uses.
        sync: the component's.
        sync_settings: what may be requested.
        ended: called with each result for which the vehicle has sent something of its table.

    Attributes:
        last: the result of the last fetch, or None.
        file_works: whether this vehicle, with this firmware, serves its table as a file: None while unknown.
        passive_table: the table from the traffic of other stations, where nothing may be requested; otherwise
            None.
    """

    def __init__(
        self,
        fetch_context: FetchContext,
        sync: Sync,
        sync_settings: SyncSettings,
        *,
        ended: Callable[[FetchResult], None],
    ) -> None:
        self._current: Fetch | None = None
        self.last: FetchResult | None = None
        self.file_works: bool | None = None
        self._fetch_context = fetch_context
        self._sync = sync
        self._fetch_policy = sync_settings.policy
        self.passive_table: PassiveTable | None = None
        if sync_settings.listens_only:
            self.passive_table = PassiveTable(
                fetch_context, sync, whole=self._passive_ended, is_log=sync_settings.is_log
            )
        self._ended = ended
        self._restarted_at = -math.inf  # of the last fetch

    @property
    def current(self) -> Fetch | None:
        """The fetch in progress, or None."""
        return self._current

    @current.setter
    def current(self, fetch: Fetch | None) -> None:
        self._current = fetch
        self._fetch_context.context.is_fetching = fetch is not None

    def may_use_file(self) -> bool:
        """Return whether to request the file: the table was received as one, or the component says that it
        serves it."""
        return self._fetch_context.context.serves_file if self.file_works is None else self.file_works

    def begin(
        self,
        now: float,
        *,
        refresh: bool = False,
        listed: bool = False,
        by_list: bool = False,
        check: Check | None = None,
    ) -> Fetch:
        """Begin a fetch, or join the one in progress; give it back with `end`.

        Args:
            now: the time.
            refresh: fetch even if the vehicle's hash would confirm the cached table.
            listed: the list was requested already, of all components at once.
            by_list: download by list even if the vehicle serves the file.
            check: the options of a fetch that only the watch has requested; a caller that joins ends the
                check.
        """
        fetch = self.current
        if fetch is not None and check is None:
            fetch.check = None
        if fetch is not None and refresh and fetch.may_end_with_cache:
            fetch.restart(now)
        if fetch is None and self.passive_table is not None:
            fetch = self.current = PassiveFetch(self._fetch_context, self.passive_table, now)
            if fetch.done:
                self._passive_fetch_ended(fetch)
            else:
                fetch.on_done.append(partial(self._passive_fetch_ended, fetch))
        elif fetch is None:
            fetch = self.current = Fetch(
                self._fetch_context,
                now,
                announced=self._sync.announced,
                refresh=refresh,
                listed=listed,
                by_list=by_list,
                policy=self._fetch_policy,
                may_use_file=self.may_use_file,
                check=check,
            )
            if fetch.done:
                self._fetch_ended(fetch)
            else:
                fetch.on_done.append(partial(self._fetch_ended, fetch))
        fetch.holders += 1
        return fetch

    def end(self, fetch: Fetch, now: float) -> None:
        """Give a fetch back. The last holder cancels it."""
        fetch.holders -= 1
        if fetch.holders <= 0 and not fetch.done:
            fetch.cancel(now)
            fetch.drop_callbacks()
            if self.current is fetch:
                self.current = None

    def tick(self, now: float) -> None:
        """Do what is due of the fetch in progress."""
        if self.current is not None:
            self.current.tick(now)

    def next_deadline(self) -> float:
        """See `Machine`."""
        return math.inf if self.current is None else self.current.next_deadline()

    def resume(self, now: float) -> None:
        """See `Machine`."""
        if self.current is not None:
            self.current.resume(now)

    def fail_all(self, error: Exception, now: float) -> None:
        """See `Machine`."""
        if self.current is not None:
            fetch = self.current
            fetch.cancel(now)
            fetch.fail(error, now)

    def seems_restarted(self, silent_since: float, now: float) -> bool:
        """Restart the fetch where the component may have restarted, before its clock shows that; see
        `Fetch.seems_restarted`."""
        return self.current is not None and self.current.seems_restarted(silent_since, now)

    def are_since(self, started_at: float) -> bool:
        """Return whether the whole table was fetched since the component's boot then, or is about to be."""
        fetch = self.current
        restarted_at = self._restarted_at if fetch is None else fetch.restarted_at
        return restarted_at >= started_at - BOOT_TIME_TOLERANCE

    def forget(self) -> None:
        """Forget everything: another vehicle uses the address."""
        if self.passive_table is not None:
            self.passive_table.forget()
        self.file_works = None

    def updated(self) -> None:
        """Forget what depends on the firmware: it has changed."""
        self._fetch_context.table.forget_defaults()
        self.forget()

    def over(self, now: float) -> None:
        """End the passive fetch: nothing more is received."""
        if self.passive_table is not None:
            self.passive_table.is_over = True
        if isinstance(self.current, PassiveFetch):
            self.current.over(now)

    def _passive_ended(self, result: FetchResult, now: float) -> None:
        """Take the result of a table that the traffic of other stations has completed or confirmed."""
        self.last = result
        if self._sync.fetched(result, now):
            self._ended(result)
        if isinstance(self.current, PassiveFetch):
            self.current.table_received(result, now)

    def _passive_fetch_ended(self, fetch: Fetch) -> None:
        self.current = None
        self.last = fetch.result or self.last

    def _fetch_ended(self, fetch: Fetch) -> None:
        self.current = None
        self._fetch_context.context.trace(
            "%s/%s: %r", *self._fetch_context.context.target, fetch.result or fetch.error
        )
        if fetch.file_failed is not None:
            self.file_works = not fetch.file_failed
        result = fetch.result
        is_whole = result is not None and result.complete
        self._restarted_at = fetch.restarted_at if is_whole else -math.inf
        if result is None:
            return
        self.last = result
        waited = fetch.queue_wait(fetch.ended_at)
        if self._sync.fetched(result, fetch.ended_at, waited=waited):
            self._ended(result)
