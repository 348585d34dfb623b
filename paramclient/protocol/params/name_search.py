"""Search for names that may not exist: PARAM_REQUEST_READ for all of them, and what silence means."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final

from paramclient.errors import NoReply
from paramclient.protocol.params.foreign_list import Following
from paramclient.protocol.params.reads import BATCH_INTERVAL, KnownParams, Reads
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.wire import ParamError, ParamRequestRead, ParamValue

__all__ = ["NameSearch", "NameSearches"]

WINDOW: Final = 18
"""Names that are requested at once. With the control, and one of an earlier window, they fit into the 20
requests that ArduPilot queues."""
LOOK_TIME: Final = 0.01
"""Seconds that ArduPilot takes to look up one request, at most: its simulation does so about every 5 ms
(measured), boards every millisecond. One for a parameter that it does not have takes no longer."""
RISK: Final = 1e-6
"""The chance that all requests of one name were lost, on a link as bad as it may be by what was seen, below
which the name counts as unknown."""
CLEAN_RISK: Final = 1e-3
"""The same where nothing at all was lost so far: the link is then much better than it may be."""
PASSES_MIN: Final = 2
"""Requests of one name that were passed over, at the least, before it counts as unknown."""
CONTROL_RISK: Final = 0.01
"""The chance of losing all controls of a window to go below."""
CONTROLS_MAX: Final = 4
CONTROLS_LOST_MAX: Final = 3
"""Windows in a row without an answer to their control, after which the search gives up."""


class NameSearch(Operation[None]):
    """One search; see `NameSearches`.

    Attributes:
        unknown: names that the component does not have.
        open: names of which nothing is known: the search has given up, or is not over.
        attempts: windows sent.
    """

    def __init__(self, names: Iterable[str], begun_at: float) -> None:
        super().__init__(begun_at)
        self.passes = dict.fromkeys(names, 0)
        self.unknown: set[str] = set()
        self.attempts = 0

    @property
    def open(self) -> frozenset[str]:
        """Names of which nothing is known."""
        return frozenset(self.passes)

    def leave_out(self, names: Iterable[str]) -> None:
        """Search no longer for these names. What was requested may still be answered."""
        for name in names:
            self.passes.pop(name, None)


class NameSearches(Machine):
    """Every search of one component, one after the other.

    PX4 up to 1.17 and ArduPilot say nothing to a name that they do not have. Both serve requests in order, so
    an answer to a later request says that a name before it was lost or does not exist. A window of names is
    therefore followed by a control, an index that exists, or by several where much is lost. What is silent
    when one is answered is requested again with the next window, without waiting for a timeout. Each window
    has other controls, so that a late answer is not taken for one of a later window.

    A value that comes goes into the table as any other does.

    Args:
        context, reads, table: the component's.
        following: the list that another station may be having sent.
    """

    def __init__(
        self,
        context: Context,
        reads: Reads,
        table: KnownParams,
        following: Following,
    ) -> None:
        self._target = context.target
        self._round_trip = context.round_trip
        self._reads = reads
        self._send = context.send
        self._table = table
        self._following = following
        self._searches: deque[NameSearch] = deque()
        self._waiting: deque[str] = deque()  # for this pass
        self._silent: list[str] = []  # for the next one
        self._window: set[str] = set()
        self._controls: set[int] = set()
        self._controls_sent = 0
        self._controls_lost = 0
        self._sent_at = self._heard_at = -math.inf

    def __len__(self) -> int:
        return len(self._searches)

    def _is_listing(self, now: float) -> bool:
        """Whether a list comes, for us or for another station: then an index comes without a request."""
        reads = self._reads
        is_ours = reads.list_runs_again or not reads.is_idle or now < reads.list_until
        return is_ours or self._following.is_running(now)

    def begin(self, names: Iterable[str], now: float) -> NameSearch:
        """Search for names, behind the searches that are open.

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
        """End a search early. What was sent cannot be taken back, and is answered or not."""
        if search in self._searches:
            self._leave(search, now)

    def heard(self, message: ParamValue, now: float) -> None:
        """Every PARAM_VALUE of the component passes here after it went into the table."""
        if not self._searches:
            return
        search = self._searches[0]
        passes = search.passes.pop(message.param_id, None)
        is_found = passes is not None
        if passes is not None:
            for _ in range(passes):
                self._round_trip.timed_out(1)  # it exists: what was passed over was lost
            self._round_trip.answered(self._sent_at, now, 2)
            self._heard_at = now
            self._window.discard(message.param_id)
        if message.param_index in self._controls and not self._is_listing(now):
            is_sure = self._heard_at <= self._sent_at  # else the vehicle may have served names first
            self._round_trip.answered(self._sent_at, now, 1 if is_sure else 2)
            self._controls_lost = 0
            self._pass_over(search)
            self._send_window(search, now)
        elif is_found:
            self._go_on(search, now)

    def refused(self, message: ParamError, now: float) -> None:
        """A PARAM_ERROR that may be about a name."""
        if not self._searches or message.param_index >= 0:
            return
        search = self._searches[0]
        if search.passes.pop(message.param_id, None) is not None:
            search.unknown.add(message.param_id)
            self._heard_at = now
            self._window.discard(message.param_id)
            self._go_on(search, now)

    def tick(self, now: float) -> None:
        """See that a control is lost."""
        if self.next_deadline() > now:
            return
        search = self._searches[0]
        self._round_trip.timed_out(1)
        self._controls_lost += 1
        if self._controls_lost >= CONTROLS_LOST_MAX:
            self._leave(search, now)
        else:
            self._waiting.extendleft(sorted(self._window, reverse=True))
            self._send_window(search, now)

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity."""
        if not self._searches:
            return math.inf
        serving = 0.0
        if self._reads.pace.is_batched:  # the next batch may begin only then
            serving = BATCH_INTERVAL + LOOK_TIME * len(self._window)
        return max(self._sent_at, self._heard_at) + self._round_trip.timeout + serving

    def resume(self, now: float) -> None:
        """The link is back: what was in flight is requested again."""
        if self._searches:
            self._start(now)

    def lose(self, now: float) -> None:
        """The component is lost."""
        what = f"names of {self._target[0]}/{self._target[1]} (lost)"
        self._end_all(
            lambda search: NoReply(what, attempts=search.attempts, waited=now - search.begun_at), now
        )

    def fail_all(self, error: Exception, now: float) -> None:
        """Nothing can be answered any more."""
        self._end_all(lambda search: error, now)

    def _start(self, now: float) -> None:
        """Begin the first search, or begin it again."""
        search = self._searches[0]
        self._waiting = deque(search.passes)
        self._silent = []
        self._controls_lost = 0
        self._send_window(search, now)

    def _go_on(self, search: NameSearch, now: float) -> None:
        """Send the next window if nothing of this one is awaited."""
        if not self._window:
            self._send_window(search, now)

    def _pass_over(self, search: NameSearch) -> None:
        """The control of this window is answered: what is silent is lost, or does not exist."""
        risk = RISK if self._round_trip.seen_loss else CLEAN_RISK
        enough = max(PASSES_MIN, math.ceil(math.log(risk) / math.log(self._round_trip.feared_loss)))
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
        controls = self._round_trip.copies(CONTROL_RISK, CONTROLS_MAX)
        most = WINDOW - 2 * (controls - 1)  # the others of the window before may be queued still
        while self._waiting and len(self._window) < most:
            name = self._waiting.popleft()
            if name in search.passes:
                self._window.add(name)
                self._send(ParamRequestRead(*self._target, name, -1))
        if self._window:
            search.attempts += 1
            self._sent_at = now
            for _ in range(controls):
                self._send_control()
        elif search.passes:  # what was left over has been answered meanwhile
            self._send_window(search, now)
        else:
            self._leave(search, now)

    def _send_control(self) -> None:
        """Request an index that exists, and was not requested before if there are several.

        They fall, as rising ones would look like a list that another station has requested.
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
