"""PARAM_EXT_REQUEST_LIST: a list of all extended parameters, and reads of what it lacks."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal

from paramclient.errors import NoReply
from paramclient.model.ext_params import ExtParam
from paramclient.model.wording import counted
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.ext.reads import ExtRead, ExtReads
from paramclient.protocol.ext.table import ExtTable
from paramclient.protocol.params.fetch_result import Progress
from paramclient.protocol.params.list_download import REQUESTED_INDICES_MAX
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import COUNT_CHANGES_MAX, ExtListAttempts
from paramclient.protocol.wire import ParamExtRequestList, ParamExtValue

__all__ = ["ExtFetch", "ExtFetchResult", "ExtFetches"]


@dataclass(frozen=True, slots=True)
class ExtFetchResult:
    """The outcome of a `fetch_all` of extended parameters.

    Attributes:
        system, component: MAVLink ids of the component.
        params: a copy of the table, by name.
        count: the param_count of the component; None while unknown.
        missing: the indices below it that were not received, in order.
        source: "stream": the list and reads by index; "cache" where the policy allows no download.
        elapsed: seconds.
        notes: what is worth knowing, as sentences.
    """

    system: int
    component: int
    params: Mapping[str, ExtParam]
    count: int | None
    missing: tuple[int, ...]
    source: Literal["stream", "cache"]
    elapsed: float
    notes: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether nothing is missing."""
        return self.count is not None and not self.missing

    def __repr__(self) -> str:
        missing = f", {len(self.missing)} missing" if self.missing else ""
        params = counted(len(self.params), "extended param")
        whose = f"{self.system}/{self.component}"
        return f"<ExtFetchResult {whose} {params}{missing} from {self.source} in {self.elapsed:.2f} s>"


class ExtFetch(Operation[ExtFetchResult]):
    """One fetch of all extended parameters, shared by its callers; see `ExtFetches`.

    Attributes:
        holders: callers that wait for it; at 0 it is dropped.
        request: the requests for the list.
        received: the names by index, since the fetch began.
        dead: indices whose reads were in vain.
        reads: the open reads of missing indices.
        unread: missing indices that are read next.
        value_at: when the last value was received; minus infinity before the first.
        quiet_since: when that was, or when the list was requested again.
        longest: the longest time between two values of the list in seconds; None before two.
        lists: the lists that have begun.
    """

    def __init__(self, request: ExtListAttempts, begun_at: float) -> None:
        super().__init__(begun_at)
        self.holders = 0
        self.request = request
        self.received: dict[int, str] = {}
        self.dead: set[int] = set()
        self.value_at = self.quiet_since = -math.inf
        self.lists = 0
        self.first_at = math.inf
        self.longest: float | None = None
        self.front = -1
        self.downloaded = 0
        self.count_changes = 0
        self.reads: dict[int, ExtRead] = {}
        self.unread: deque[int] = deque()

    @property
    def has_begun(self) -> bool:
        """Whether any value was received."""
        return self.value_at > -math.inf

    @property
    def is_repairing(self) -> bool:
        """Whether the list is over and missing indices are read."""
        return bool(self.reads)


class ExtFetches(Machine):
    """The fetches of one component's extended parameters: one at a time, which concurrent callers share.

    The list is requested until its first value is received. When it is over, each missing index is read. A
    changed param_count invalidates all indices: the list is then requested again.

    Args:
        context, reads, table: the component's.
        removed: called with the parameters that a complete list was without.

    Attributes:
        current: the fetch in progress, or None.
        last: the result of the last complete fetch, or None.
        is_spoken: whether the component has sent an extended parameter.
    """

    def __init__(
        self,
        context: Context,
        reads: ExtReads,
        table: ExtTable,
        removed: Callable[[list[ExtChange]], None],
    ) -> None:
        self._target = context.target
        self._policy = context.retry
        self._send = context.send
        self._trace = context.trace
        self._reads = reads
        self._table = table
        self._removed = removed
        self.current: ExtFetch | None = None
        self.last: ExtFetchResult | None = None
        self.is_spoken = False

    def begin(self, now: float) -> ExtFetch:
        """Begin a fetch, or join the one in progress. Give it back with `end`."""
        fetch = self.current
        if fetch is None:
            request = ExtListAttempts(self._policy, now, is_spoken=self.is_spoken)
            fetch = self.current = ExtFetch(request, now)
            self._request(fetch, now)
        fetch.holders += 1
        return fetch

    def end(self, fetch: ExtFetch) -> None:
        """Give a fetch back. The last holder cancels it."""
        fetch.holders -= 1
        if fetch.holders <= 0 and self.current is fetch:
            fetch.drop_callbacks()
            self._leave(fetch)

    def receive(self, message: ParamExtValue, now: float) -> None:
        """Process a PARAM_EXT_VALUE, after the table has taken it."""
        self.is_spoken = True
        fetch = self.current
        if fetch is None:
            return
        fetch.request.is_spoken = True
        if message.param_count != self._table.count:
            return  # one that no component can have
        index = message.param_index
        fetch.lists = max(fetch.lists, 1)
        if fetch.value_at >= fetch.quiet_since and fetch.has_begun and not fetch.is_repairing:
            fetch.longest = max(fetch.longest or 0.0, now - fetch.value_at)
        fetch.first_at = min(fetch.first_at, now)
        fetch.value_at = fetch.quiet_since = now
        if index < message.param_count:
            fetch.downloaded += index not in fetch.received
            fetch.received[index] = message.param_id
            fetch.front = max(fetch.front, index)
        self._look(fetch, now)

    def count_changed(self, now: float) -> None:
        """Begin the list again: all indices have become invalid."""
        fetch = self.current
        if fetch is None or not fetch.has_begun or fetch.count_changes >= COUNT_CHANGES_MAX:
            return
        fetch.count_changes += 1
        self.restart(now)

    def restart(self, now: float) -> None:
        """Begin the list in progress again: the component has restarted, or is another one."""
        fetch = self.current
        if fetch is not None:
            self._release(fetch)
            fetch.received.clear()
            fetch.dead.clear()
            fetch.front = -1
            fetch.lists = 0
            fetch.longest = None
            fetch.value_at = fetch.quiet_since = -math.inf
            fetch.request.restart()
            self._request(fetch, now)

    def partial(self, fetch: ExtFetch, now: float, *notes: str) -> ExtFetchResult:
        """Return the result so far."""
        return self._result(fetch, now, notes)

    def progress(self, fetch: ExtFetch, now: float) -> Progress:
        """Return the progress of a fetch."""
        running = now - fetch.first_at if fetch.first_at < math.inf else 0.0
        return Progress.after(len(fetch.received), self._table.count, fetch.downloaded, running)

    def tick(self, now: float) -> None:
        """Repeat the request for the list, or read what is missing after it."""
        fetch = self.current
        if fetch is None or self._due_at(fetch) > now:
            return
        if fetch.has_begun:
            self._repair(fetch, now)
            return
        fetch.request.timed_out()
        if fetch.request.should_give_up(now):
            what = f"extended parameters of {self._target[0]}/{self._target[1]}"
            self._fail(fetch, NoReply(what, attempts=fetch.request.count, waited=now - fetch.begun_at), now)
        else:
            self._request(fetch, now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return math.inf if self.current is None else self._due_at(self.current)

    def resume(self, now: float) -> None:
        """Request the list again unless values of it were received: the link is back."""
        fetch = self.current
        if fetch is None:
            return
        if fetch.has_begun:
            fetch.quiet_since = now
        else:
            fetch.request.resume(now)

    def lose(self, now: float) -> None:
        """End the fetch: the component is lost."""
        fetch = self.current
        if fetch is not None:
            what = f"extended parameters of {self._target[0]}/{self._target[1]} (lost)"
            self._fail(fetch, NoReply(what, attempts=fetch.request.count, waited=now - fetch.begun_at), now)

    def fail_all(self, error: Exception, now: float) -> None:
        """End the fetch with the error."""
        if self.current is not None:
            self._fail(self.current, error, now)

    def _request(self, fetch: ExtFetch, now: float) -> None:
        copies = fetch.request.copies if fetch.request.count else 1
        fetch.request.sent(now)
        for _ in range(copies):
            self._send(ParamExtRequestList(*self._target))

    def _due_at(self, fetch: ExtFetch) -> float:
        if not fetch.has_begun:
            return fetch.request.due_at
        if fetch.is_repairing:
            return math.inf
        left = 0 if self._table.count is None else self._table.count - 1 - fetch.front
        silence = fetch.request.silence_before_end(fetch.request.timeout, left, fetch.longest)
        return fetch.quiet_since + silence

    def _missing(self, fetch: ExtFetch) -> list[int]:
        count = self._table.count or 0
        return [index for index in range(count) if index not in fetch.received]

    def _repair(self, fetch: ExtFetch, now: float) -> None:
        """Read each missing index, or request the list again: it is over."""
        missing = [index for index in self._missing(fetch) if index not in fetch.dead]
        self._trace("%s/%s: the extended list lacks %s", *self._target, len(missing))
        if fetch.request.should_list_again(len(missing), self._table.count or 0, fetch.lists):
            fetch.lists += 1
            fetch.front = -1
            fetch.longest = None
            fetch.quiet_since = now
            self._request(fetch, now)
            return
        fetch.unread.extend(missing)
        self._read_next(fetch, now)
        self._look(fetch, now)

    def _read_next(self, fetch: ExtFetch, now: float) -> None:
        """Read missing indices, few at a time: a component may claim thousands."""
        while fetch.unread and len(fetch.reads) < REQUESTED_INDICES_MAX:
            index = fetch.unread.popleft()
            if index not in fetch.received:
                fetch.reads[index] = read = self._reads.ask(index, now, urgent=False)
                read.on_done.append(partial(self._read_ended, fetch, index, read))

    def _read_ended(self, fetch: ExtFetch, index: int, read: ExtRead) -> None:
        if fetch.reads.pop(index, None) is not read:
            return  # the list has begun again, or the fetch has ended
        if read.error is not None:
            fetch.dead.add(index)
        self._read_next(fetch, read.ended_at)
        self._look(fetch, read.ended_at)

    def _look(self, fetch: ExtFetch, now: float) -> None:
        """End the fetch if nothing is left to wait for."""
        if len(fetch.received) + len(fetch.dead) < (self._table.count or 0):
            return  # without a look at each index, for each value
        missing = self._missing(fetch)
        if missing and not (fetch.has_begun and set(missing) <= fetch.dead):
            return
        result = self._result(fetch, now, ())
        if result.complete:
            self._removed(self._table.keep_only(set(fetch.received.values()), now))
            result = self._result(fetch, now, ())
            self.last = result
        self._leave(fetch)
        fetch.finish(result, now)

    def _result(self, fetch: ExtFetch, now: float, notes: tuple[str, ...]) -> ExtFetchResult:
        return ExtFetchResult(
            *self._target,
            dict(self._table.params),
            self._table.count if fetch.has_begun else None,
            tuple(self._missing(fetch)),
            "stream",
            now - fetch.begun_at,
            notes,
        )

    def _fail(self, fetch: ExtFetch, error: Exception, now: float) -> None:
        self._leave(fetch)
        fetch.fail(error, now)

    def _leave(self, fetch: ExtFetch) -> None:
        self._release(fetch)
        self.current = None

    def _release(self, fetch: ExtFetch) -> None:
        fetch.unread.clear()
        reads, fetch.reads = fetch.reads, {}
        for read in reads.values():
            self._reads.release(read)
