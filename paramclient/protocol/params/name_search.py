"""Search for many names that may not exist: windows of PARAM_REQUEST_READ, each with control reads."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final

from paramclient.errors import NoReply
from paramclient.protocol.params.foreign_list import ForeignList
from paramclient.protocol.params.reads import KnownParams, Reads
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import NameRetries
from paramclient.protocol.wire import ParamError, ParamRequestRead, ParamValue

__all__ = ["NameSearch", "NameSearches"]

WINDOW_SIZE: Final = 18
"""Names requested at once. With the control, and one of an earlier window, they fit into the 20 requests that
ArduPilot queues."""


class NameSearch(Operation[None]):
    """One search; see `NameSearches`.

    Attributes:
        unknown: names that the component does not have.
        open: names without a verdict: the search was given up, or is not over.
        attempts: windows sent.
    """

    def __init__(self, names: Iterable[str], begun_at: float) -> None:
        super().__init__(begun_at)
        self.passes = dict.fromkeys(names, 0)
        self.unknown: set[str] = set()
        self.attempts = 0

    @property
    def open(self) -> frozenset[str]:
        """Names without a verdict."""
        return frozenset(self.passes)

    def leave_out(self, names: Iterable[str]) -> None:
        """Remove names from the search. Requests in flight may still be answered."""
        for name in names:
            self.passes.pop(name, None)


class NameSearches(Machine):
    """The searches of one component, one after the other.

    PX4 up to 1.17 and ArduPilot do not respond to a name that they do not have. Both serve requests in order,
    so the response to a later request shows that an unanswered name before it was lost or does not exist. A
    window of names is therefore followed by a control read, an index that exists, or by several where packet
    loss is high. Names that are silent when a control is answered are requested again with the next window,
    without waiting for a timeout. Each window has other controls, so that a late response is not taken for
    one of a later window.

    Received values go into the table like any other.

    Args:
        context, reads, table: the component's.
        foreign_list: the list that another station may have requested.
    """

    def __init__(
        self,
        context: Context,
        reads: Reads,
        table: KnownParams,
        foreign_list: ForeignList,
    ) -> None:
        self._target = context.target
        self._retries = NameRetries(context.retry)
        self._reads = reads
        self._send = context.send
        self._table = table
        self._foreign_list = foreign_list
        self._searches: deque[NameSearch] = deque()
        self._waiting: deque[str] = deque()  # for this pass
        self._silent: list[str] = []  # for the next one
        self._window: set[str] = set()
        self._controls: set[int] = set()
        self._controls_sent = 0

    def __len__(self) -> int:
        return len(self._searches)

    def _is_listing(self, now: float) -> bool:
        """Return whether a list is received, for us or for another station: then an index arrives without a
        request."""
        reads = self._reads
        is_ours = reads.list_runs_again or not reads.is_idle or now < reads.list_until
        return is_ours or self._foreign_list.is_running(now)

    def begin(self, names: Iterable[str], now: float) -> NameSearch:
        """Begin a search for names, after the open searches.

        Args:
            names: param_ids, as the component spells them.
            now: the time.
        """
        search = NameSearch(names, now)
        if not search.passes:
            search.finish(None, now)
            return search
        self._searches.append(search)
        if len(self._searches) == 1:
            self._start(now)
        return search

    def cancel(self, search: NameSearch, now: float) -> None:
        """Cancel a search. Requests in flight cannot be recalled and may be answered."""
        if search in self._searches:
            self._leave(search, now)

    def receive(self, message: ParamValue, now: float) -> None:
        """Process a PARAM_VALUE of the component, after the table has stored it."""
        if not self._searches:
            return
        search = self._searches[0]
        passes = search.passes.pop(message.param_id, None)
        is_found = passes is not None
        if passes is not None:
            self._retries.name_answered(passes, now)
            self._window.discard(message.param_id)
        if message.param_index in self._controls and not self._is_listing(now):
            self._retries.control_answered(now)
            self._pass_over(search)
            self._send_window(search, now)
        elif is_found:
            self._go_on(search, now)

    def refused(self, message: ParamError, now: float) -> None:
        """Process a PARAM_ERROR that may belong to a name."""
        if not self._searches or message.param_index >= 0:
            return
        search = self._searches[0]
        if search.passes.pop(message.param_id, None) is not None:
            search.unknown.add(message.param_id)
            self._retries.received_at = now
            self._window.discard(message.param_id)
            self._go_on(search, now)

    def tick(self, now: float) -> None:
        """Detect a lost control."""
        if self.next_deadline() > now:
            return
        search = self._searches[0]
        self._retries.control_timed_out()
        if self._retries.should_give_up:
            self._leave(search, now)
        else:
            self._waiting.extendleft(sorted(self._window, reverse=True))
            self._send_window(search, now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        if not self._searches:
            return math.inf
        return self._retries.due_at(len(self._window), is_batched=self._reads.pace.is_batched)

    def resume(self, now: float) -> None:
        """Repeat what was in flight: the link is back."""
        if self._searches:
            self._start(now)

    def lose(self, now: float) -> None:
        """End all searches: the component is lost."""
        what = f"names of {self._target[0]}/{self._target[1]} (lost)"
        self._end_all(
            lambda search: NoReply(what, attempts=search.attempts, waited=now - search.begun_at), now
        )

    def fail_all(self, error: Exception, now: float) -> None:
        """End all searches with the error."""
        self._end_all(lambda search: error, now)

    def _start(self, now: float) -> None:
        """Begin the first search, also after an interruption."""
        search = self._searches[0]
        self._waiting = deque(search.passes)
        self._silent = []
        self._retries.restart()
        self._send_window(search, now)

    def _go_on(self, search: NameSearch, now: float) -> None:
        """Send the next window if nothing of this one is in flight."""
        if not self._window:
            self._send_window(search, now)

    def _pass_over(self, search: NameSearch) -> None:
        """Count silent names after an answered control: they are lost, or do not exist."""
        enough = self._retries.passes_max
        for name in sorted(search.passes.keys() & self._window):
            search.passes[name] += 1
            if search.passes[name] < enough:
                self._silent.append(name)
            else:
                del search.passes[name]
                search.unknown.add(name)

    def _send_window(self, search: NameSearch, now: float) -> None:
        """Request the next names, or end the search."""
        self._window.clear()
        self._controls.clear()
        if not self._waiting:
            self._waiting.extend(self._silent)
            self._silent = []
        controls = self._retries.controls
        window_size = WINDOW_SIZE - 2 * (controls - 1)  # requests of the window before may still be queued
        while self._waiting and len(self._window) < window_size:
            name = self._waiting.popleft()
            if name in search.passes:
                self._window.add(name)
                self._send(ParamRequestRead(*self._target, name, -1))
        if self._window:
            search.attempts += 1
            self._retries.sent_at = now
            for _ in range(controls):
                self._send_control()
        elif search.passes:  # the remaining names have been answered meanwhile
            self._send_window(search, now)
        else:
            self._leave(search, now)

    def _send_control(self) -> None:
        """Send a control read of an existing index that was not used before, if there are several.

        The indices fall: rising ones would look like a list that another station has requested.
        """
        self._controls_sent += 1
        count = self._table.count
        control = -self._controls_sent % count if count else self._reads.control
        self._controls.add(control)
        self._send(ParamRequestRead(*self._target, "", control))

    def _leave(self, search: NameSearch, now: float) -> None:
        """End a search, and begin the next one."""
        was_first = self._searches[0] is search
        self._searches.remove(search)
        if was_first:
            self._clear()
        search.finish(None, now)
        if was_first and self._searches and not self._window:
            self._start(now)

    def _end_all(self, error_of: Callable[[NameSearch], Exception], now: float) -> None:
        searches, self._searches = self._searches, deque()
        self._clear()
        for search in searches:
            search.fail(error_of(search), now)

    def _clear(self) -> None:
        self._window.clear()
        self._controls.clear()
