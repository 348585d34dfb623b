"""Passive tables: from the traffic of other stations, on listen-only links and in logs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

from paramclient.errors import NoReply
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_result import (
    Announcement,
    FetchContext,
    FetchResult,
    FetchSource,
    Policy,
    Progress,
)
from paramclient.protocol.params.hash_check import HashCheck
from paramclient.protocol.params.sync import Sync
from paramclient.protocol.wire import PARAMETERS_MAX, ParamValue

__all__ = ["PASSIVE_TIMEOUT", "PassiveTable", "PassiveFetch"]

PASSIVE_TIMEOUT: Final = 20.0
"""Seconds, by default, in which another station may begin to request the list."""
LIST_PAUSE_MAX: Final = 5.0
"""Seconds without a new value after which a list counts as over: in PX4's low-bandwidth mode a value arrives
every 0.13 s, and a station that missed some requests them again within 1 to 2 s."""


class PassiveTable:
    """Collects the lists of a component that other stations request, and the hashes that it announces to
    them.

    A table is complete when every index below the count was received since the table was last in doubt. An
    announced hash proves it where the hash recomputed from the table is the same.

    Args:
        fetch_context: the component's.
        sync: the component's.
        whole: called each time that the table is complete or confirmed.
        is_log: whether the link is a log, which ends.

    Attributes:
        names: received names, by index under `count`.
        count: the param_count received with them, or None.
        new_index_at: when the last new index was received.
        is_log: as above.
        is_over: whether nothing more is received.
    """

    def __init__(
        self,
        fetch_context: FetchContext,
        sync: Sync,
        *,
        whole: Callable[[FetchResult, float], None],
        is_log: bool,
    ) -> None:
        self.names: dict[int, str] = {}
        self.count: int | None = None
        self.new_index_at = -math.inf
        self.is_log = is_log
        self.is_over = False
        self._fetch_context = fetch_context
        self._table = fetch_context.table
        self._sync = sync
        self._whole = whole
        self._began_at = 0.0
        self._is_whole = False

    def receive(self, message: ParamValue, now: float) -> None:
        """Process a PARAM_VALUE of the component, after the table has stored it."""
        name, _, _, count, index = message
        if index >= count or count > PARAMETERS_MAX:
            return
        names = self.names
        if count != self.count or names.get(index, name) != name:
            self.forget()
            self.count = count
            self._began_at = now
        if index not in names:
            names[index] = name
            self.new_index_at = now
            if len(names) == count:
                self._complete(now)

    def announced(self, announcement: Announcement, now: float) -> None:
        """Process a hash that the component has announced to any station."""
        table = self._table
        if not table.complete:
            return
        if self._sync.compare(now):
            if not self._sync.synced:
                self._whole(self._result("cache", (), announcement.hash, now), now)
        elif self._is_whole and self._is_proven(announcement):
            self._whole(self._result("stream", (), table.hash, now), now)
        elif table.hash is not None:
            self.forget()
            self._sync.contradicted()

    def forget(self) -> None:
        """Discard the received indices: they count when they are received again."""
        self.names.clear()
        self.count = None
        self._is_whole = False

    def settled(self, now: float, notes: tuple[str, ...] = ()) -> FetchResult | None:
        """Return the table as a result if it is known to match the vehicle's."""
        if not self._sync.synced:
            return None
        source: FetchSource = "stream" if self._is_whole else "cache"
        return self._result(source, (), self._table.hash, now, notes)

    def result(self, now: float, notes: tuple[str, ...] = ()) -> FetchResult | None:
        """Return the result so far; None if nothing was received."""
        result = self.settled(now, notes)
        if result is not None:
            return result
        if not self.names or self.count is None:
            return None
        self._table.place(self.names)
        missing = tuple(index for index in range(self.count) if index not in self.names)
        return self._result("stream", missing, None, now, notes)

    def _complete(self, now: float) -> None:
        """Finish the table: every index was received."""
        table = self._table
        self._is_whole = True
        self._fetch_context.changed(table.settle(self.names))
        table.complete = True
        table.count = self.count
        announced = self._sync.announced
        if announced is None or not self._is_proven(announced):
            table.unconfirm()
        self._whole(self._result("stream", (), table.hash, now), now)

    def _is_proven(self, announcement: Announcement) -> bool:
        proof = HashCheck(self._table)
        proof.before = announcement
        return proof.is_given(self._table.size)

    def _result(
        self,
        source: FetchSource,
        missing: tuple[int, ...],
        confirmed: int | None,
        now: float,
        notes: tuple[str, ...] = (),
    ) -> FetchResult:
        count = (self.count if self.names else self._table.count) or 0
        return FetchResult(
            *self._fetch_context.context.target,
            self._table.params.copy(),
            source,
            count,
            count - len(missing),
            missing,
            confirmed,
            max(0.0, now - self._began_at),
            notes,
        )


class PassiveFetch(Fetch):
    """A fetch without requests: it waits for a table from the traffic of other stations.

    It ends when the table is complete or confirmed, and with a partial result when the list has paused for
    `LIST_PAUSE_MAX`. Without requests of another station it does not end. In a log it ends with the log, as
    only then the last values are known.
    """

    def __init__(self, fetch_context: FetchContext, passive_table: PassiveTable, now: float) -> None:
        self._passive_table = passive_table
        super().__init__(
            fetch_context,
            now,
            announced=None,
            refresh=False,
            listed=False,
            policy=Policy.CACHE_ONLY,
            may_use_file=lambda: False,
        )

    def table_received(self, result: FetchResult, now: float) -> None:
        """End with a table that is complete or confirmed."""
        if not self._passive_table.is_log:
            self.finish(result, now)

    def over(self, now: float) -> None:
        """End with the result so far: nothing more is received."""
        result = self._passive_table.result(now)
        if result is None:
            self.fail(self._nothing(now), now)
        else:
            self.finish(result, now)

    def tick(self, now: float) -> None:
        if self.next_deadline() <= now:
            self.over(now)

    def next_deadline(self) -> float:
        passive_table = self._passive_table
        if passive_table.is_log or not passive_table.names:
            return math.inf
        return max(passive_table.new_index_at, self.begun_at) + LIST_PAUSE_MAX

    def partial(self, now: float, note: str) -> FetchResult:
        result = self._passive_table.result(now, (note,))
        if result is None:
            raise self._nothing(now)
        return result

    @property
    def is_silent(self) -> bool:
        passive_table = self._passive_table
        return not (passive_table.names or passive_table.is_log)

    def progress(self, now: float) -> Progress:
        passive_table = self._passive_table
        return Progress(len(passive_table.names), passive_table.count, 0.0, None)

    def _begin_download(self, now: float, present: Mapping[int, str] | None = None) -> None:
        passive_table = self._passive_table
        if passive_table.is_over:
            self.over(now)
        elif not passive_table.is_log and (result := passive_table.settled(now)) is not None:
            self.finish(result, now)

    def _nothing(self, now: float) -> NoReply:
        system, component = self._target
        what = f"the parameters of {system}/{component}, which no other station has requested"
        return NoReply(what, attempts=0, waited=now - self.begun_at)
