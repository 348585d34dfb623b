"""List download: PARAM_REQUEST_LIST, the repair of its gaps, restarts when the count changes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import filterfalse
from typing import Final

from paramclient.errors import NoReply
from paramclient.protocol.params.list_stream import JUMP_MAX, ListStream
from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import (
    COUNT_CHANGES_MAX,
    EMPTY_LISTS_MAX,
    LIST_REORDER_DEPTH,
    LIST_SILENCE_MIN,
    LISTS_MAX,
    ListAttempts,
    ReadRetries,
)
from paramclient.protocol.scheduler import ListAdmission, ListStatistics
from paramclient.protocol.wire import NO_INDEX, PARAMETERS_MAX, ParamRequestList, ParamValue

__all__ = ["ListDownload", "present_of"]

RESUME_SHARE_MIN: Final = 0.5
"""The share of the table that must be present for single reads of the missing values to be worthwhile, where
the pace of the list is unknown."""
MISSING_WITHOUT_LIST_MAX: Final = 24
"""Missing values that are never worth another pass of the list."""
REQUESTED_INDICES_MAX: Final = 256
"""Indices requested at a time; the pacing of reads decides how many are in flight."""
RELIST_GAIN: Final = 1.2
"""How many times faster than single reads another pass of the list must be, by the rates measured so far."""
LEAD_MAX: Final = 0.2
"""Seconds before the end of ArduPilot's list at which reads are sent at the earliest: the list pauses only
0.2 s after the first read (measured)."""
LEAD_MARGIN: Final = 0.02
"""Seconds after the expected end of a pass at which the request for the next one is to arrive: an earlier one
cuts the pass off."""
LOSS_MAX: Final = 0.9
"""The highest packet loss that estimates assume, as a share of exchanges."""
LIST_TIME_ASSUMED: Final = 5.0
"""Seconds that a list is assumed to take before its pace is measured: on a cable 1, on a radio 30."""
BURST_GAIN: Final = 3.0
"""The assumed speed of the link, as a multiple of the pace of a list in bursts: within a burst of PX4 the
link is much faster, but a busy program sees bursts on any link."""
PACED_GAIN: Final = 1.3
"""The same for ArduPilot, whose list uses 30 % of its port's bandwidth (measured): single reads may be as
fast as its list."""


class ListDownload(Operation[None]):
    """One list download. `missing` says at its end which indices were not received.

    The list is sent by rising index. Skipped indices are read while the list still runs; indices ahead of it
    are left to the list until it goes silent. PX4 restarts its list, without a hash, when it receives a
    second PARAM_REQUEST_LIST: so that is repeated only while nothing was received, or when a changed count
    has invalidated the received values.

    When the count changes, indices shift and all values are requested again. Responses to single reads carry
    the present count, while a running list of ArduPilot carries the count of its beginning; so a different
    count in a response is noted, and settled by another pass after the end of the list.

    The list waits for its turn where other lists of the link run. It does not end early while the component
    answers, however slowly: an index is given up when reads sent together with it are answered, and all of
    them when nothing at all is answered for `SILENCE_MAX`.

    With values present from an earlier download only the missing ones are requested. If those values turn out
    to belong to another count or to other names, they are discarded.

    Args:
        context, reads, list_admission, now: as their names say.
        listed: whether the list was requested already.
        count, present: the values of an earlier download: param_count and names by index.
        parallel_to_file: whether a file was requested that may still bring everything. Then no pass is
            requested before the end of the previous one.

    Attributes:
        count: the vehicle's param_count; None before the first value.
        names: names received under that count, by index.
        given_up: indices that stayed silent too often, or had invalid responses.
        repeated: values received more than once.
        resumed: values present at the beginning.
        lists: requests for the list.
        gives_way: whether the gaps of the list are left to the file.
        queue_time: seconds for which it has waited for its turn; see `held_since`.
        held_since: when the present wait began, or None.
    """

    def __init__(
        self,
        context: Context,
        reads: Reads,
        list_admission: ListAdmission,
        now: float,
        *,
        listed: bool = False,
        count: int | None = None,
        present: Mapping[int, str] | None = None,
        parallel_to_file: bool = False,
    ) -> None:
        super().__init__(now)
        self._target = context.target
        self._retry_policy = context.retry
        self._round_trip = context.round_trip
        self._send = context.send
        self._reads = reads
        self._list_admission = list_admission
        self.count = count if present else None
        self.names = dict(present or {})
        self.resumed = len(self.names)
        self.given_up: set[int] = set()
        self.repeated = 0
        self._lost: set[int] = set()
        self.lists = 0
        self.gives_way = False
        self._is_parallel_to_file = parallel_to_file
        self.queue_time = 0.0
        self.held_since: float | None = None
        self._passes = 1
        self._empty_passes = 0
        self._count_changes = 0
        self._stream = ListStream(now)
        self._requested: dict[int, Read] = {}
        self._next = 0  # below it, every missing index was requested since the end of the list
        self._repeated_in_row = 0  # repeated values in a row
        self._is_streaming = True
        self._other_count: int | None = None
        self._silent_at = math.inf  # when an unanswered list no longer uses the link
        self._tries: dict[int, tuple[int, int]] = {}  # of unanswered reads: requests, answered controls
        self._places = {name: index for index, name in self.names.items()}  # of an earlier download
        self._is_received = self._is_checked = False  # a value was received; a present one was read to check
        self._list_timeout = math.inf  # seconds in which another pass may stay without a value
        self._is_answered = False  # its first value measures the round trip
        self._ahead_at: float | None = None  # when the next pass was requested before the end of this one
        self._request = ListAttempts(context.retry, now)
        self._is_head_counted = False  # its head has been received since
        self._has_looked = False  # near its end, skipped indices were looked at
        if listed:
            self.lists = 1
            self._request.was_sent()
            self._silent_at = self._request.due_at
            list_admission.has_begun(self)
        elif present:
            self._resume_download(now)
        else:
            self._ask_for_turn(now)

    @property
    def received(self) -> int:
        return len(self.names)

    @property
    def lost(self) -> int:
        """Values of the list that were lost.

        These indices had to be read one by one, or by another pass. A late value counts as lost once it was
        requested.
        """
        return len(self._lost)

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices below the count that were not received, rising."""
        return tuple(filterfalse(self.names.__contains__, range(self.count or 0)))

    @property
    def is_settled(self) -> bool:
        """Whether the count has stopped changing."""
        return self._count_changes < COUNT_CHANGES_MAX

    @property
    def progress(self) -> tuple[int, int | None]:
        """The number of received values, and of all where it is known."""
        return self.received, self.count

    @property
    def is_awaited(self) -> bool:
        """Whether nothing of the list was received since its request."""
        return self._stream.is_awaited

    @property
    def silent_at(self) -> float:
        """When the list counts as silent, while nothing of it was received."""
        return self._silent_at if self._stream.is_awaited else math.inf

    def seen(self) -> ListStatistics:
        """Return the statistics of the list since its request."""
        return self._stream.seen()

    def begin(self, now: float) -> None:
        """Begin: it is this list's turn."""
        if self.held_since is not None:
            self.queue_time += now - self.held_since
            self.held_since = None
        self._request.timeout_since = now
        is_running = self._stream.is_at_pace and now < self._quiet_at
        if self.lists == 0 and is_running:
            return  # another station has requested it meanwhile
        self._stream.rewind()
        self._stream.received_at = now
        self._request.restart()
        self._ask_for_list(now)
        self._silent_at = now + self._request.wait

    def queue_wait(self, now: float) -> float:
        """Return the seconds for which it has waited for its turn."""
        return self.queue_time + (0.0 if self.held_since is None else now - self.held_since)

    def receive(self, message: ParamValue, now: float) -> None:
        """Process a PARAM_VALUE of the component, before the reads do."""
        name, _, _, count, index = message
        stream = self._stream
        if count == self.count and index == stream.front + 1 and self._is_next_in_order(index):
            self.names[index] = name
            self._repeated_in_row = 0
            stream.goes_on(index, now)
            return
        if index >= count or count > PARAMETERS_MAX:
            if index == NO_INDEX and self.count is not None and count <= PARAMETERS_MAX:
                # pushed, or a response by name: it has the present count, where ArduPilot's list does not
                self._other_count = None if count == self.count else count
            return
        if self.done:
            return
        self._is_received = True
        if self._ahead_at is not None and index <= JUMP_MAX < stream.front:
            self._stream_ends()  # the pass that was requested before the end of this one has begun
            self._ahead_at = now
            self._ask_for_another_pass(now)
        if self.count is None:
            self._note_answer(now)
            self.count = count
        elif self.resumed and self._contradicts(index, name) and count == self.count:
            self._start_over(count)
            self._ask_for_another_pass(now)
        elif count != self.count and self._count_changes < COUNT_CHANGES_MAX:
            if index in self._requested or not self._is_streaming:
                self._other_count = count
                return
            self._start_over(count)
        if index >= self.count:
            return
        names, holes = self.names, stream.holes
        self.repeated += (is_repeated := index in names)
        names[index] = name
        if holes:
            holes.pop(index, None)
        if self.given_up:
            self.given_up.discard(index)
        if index not in self._requested:
            self._follow(index, is_repeated, now)
        if (holes and self.held_since is None) or self._requested or not self._is_streaming:
            self._ask_for_gaps(now)
            self._finish_if_complete(now)

    def _is_next_in_order(self, index: int) -> bool:
        """Return whether a value is simply the next one of a running list, as nearly all are."""
        stream, left = self._stream, (self.count or 0) - 1
        if index in self.names or index >= left or len(self.names) >= left or not self._is_streaming:
            return False
        is_troubled = self._requested or stream.holes or self.given_up or self._empty_passes or self.resumed
        return not (is_troubled or stream.is_awaited or self.done)

    def note_list_head(self, now: float) -> None:
        """Note that the head of the list was received, so that the request is not repeated yet.

        Counts once for each request: heads without a list behind them must not keep a turn.
        """
        if self.count is None and not self._is_head_counted:
            self._is_head_counted = True
            self._note_answer(now)
            self._request.head_received(now)
            self._silent_at = self._request.due_at

    def request_missing(self, now: float) -> None:
        """Request what is missing: the file will not bring it."""
        self.gives_way = self._is_parallel_to_file = False
        self.tick(now)

    def tick(self, now: float) -> None:
        """Repeat the request for the list, or detect its end."""
        if self.done or self.held_since is not None:
            return
        if self.count is None:
            if self._request.due_at <= now and not self.gives_way:
                if self._list_admission.is_parallel_to_others(self):
                    self._request.timeout_since = now  # the vehicle may have no bandwidth to answer
                if self._request.should_give_up(now):
                    self._end_unanswered(now)
                else:
                    self._ask_for_list(now)
            return
        if self._is_streaming and self._quiet_at <= now:
            self._stream_ends(is_cut=True)
        self._has_looked = self._has_looked or self._ending_at <= now
        self._ask_for_gaps(now)
        self._finish_if_complete(now)

    @property
    def _end_look_at(self) -> float:
        """When to look at the skipped indices: once for each pass, near its end."""
        return math.inf if self._has_looked else self._ending_at

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity. The reads have deadlines of their own."""
        if self.done or self.held_since is not None:
            return math.inf
        if self.count is None:
            return math.inf if self.gives_way else self._request.due_at
        if not self._is_streaming:
            return math.inf
        return self._quiet_at if self._requested or self.gives_way else min(self._quiet_at, self._end_look_at)

    def resume(self, now: float) -> None:
        """Repeat what could not be sent: the link is back."""
        self._request.resume(now)
        self._stream.received_at = now
        self._silent_at = now + self._retry_policy.timeout

    def cancel(self) -> None:
        """Cancel the download; a running list goes on and still fills the table."""
        stream = self._stream
        if self._is_streaming and not stream.is_awaited and self.count is not None:
            self._learn_pace()
            left = self.count - stream.front + (0 if self._ahead_at is None else self.count)
            self._reads.list_until = self._quiet_at + left * stream.gap
        self._stream_ends()
        self._forget_reads()

    @property
    def _quiet_at(self) -> float:
        """When a list without further values counts as over."""
        timeout = self._retry_policy.timeout
        if self._stream.is_awaited and self._passes > 1:
            timeout = min(timeout, self._list_timeout)
        stream = self._stream
        quiet_at = stream.quiet_at(timeout, (self.count or 0) - 1 - stream.front)
        if stream.is_bursty and self._list_admission.is_parallel_to_others(self):
            # on a link this fast, the cause of a pause is this program or the vehicle
            return max(quiet_at, stream.received_at + max(LIST_SILENCE_MIN, timeout))
        return quiet_at

    def _note_answer(self, now: float) -> None:
        if not self._is_answered and self.lists:
            self._is_answered = True
            self._retry_policy.answered(self._request.sent_at, now, self.lists)
            if self.lists == 1:
                self._list_timeout = self._request.later_timeout(now - self._request.sent_at)

    def _resume_download(self, now: float) -> None:
        """Read what is missing, unless a running list will bring it."""
        assert self.count is not None
        self._stream.gap = self._reads.pace.gap or LIST_TIME_ASSUMED / self.count
        self._is_streaming = now < self._reads.list_until and len(self.names) < self.count
        self._reads.is_idle = not self._is_streaming
        if not self._is_streaming:
            self._check(now)
            self._ask_for_gaps(now)

    def _check(self, now: float) -> None:
        """Read one present value: the response shows whether count and indices are unchanged."""
        self._is_checked = True
        self._ask(max(self.names), now)

    def _contradicts(self, index: int, name: str) -> bool:
        """Return whether a value shows that the present values are stale."""
        return self.names.get(index, name) != name or self._places.get(name, index) != index

    def _ask_for_turn(self, now: float) -> None:
        self.held_since = now
        self._list_admission.ask(self, now)

    def _ask_for_list(self, now: float) -> None:
        self._request.sent(now)
        self._is_head_counted = self._has_looked = False
        self._stream.is_awaited = True
        self._reads.is_idle = False
        ahead_at, self._ahead_at = self._ahead_at, None
        if ahead_at is not None and now < ahead_at + self._request.timeout:
            self._request.sent_at = ahead_at
        else:
            self._request_list()

    def _request_list(self) -> None:
        self.lists += 1
        copies = self._request.copies
        if self._passes == 1 and not self._reads.pace.is_batched:
            copies = 1
        for _ in range(copies):
            self._send(ParamRequestList(*self._target))

    def _ask_for_another_pass(self, now: float) -> None:
        self._passes += 1
        self._empty_passes += 1
        self._repeated_in_row = 0
        self._is_streaming = self._reads.list_runs_again = True
        self._next = 0
        self._ask_for_turn(now)

    def _follow(self, index: int, is_repeated: bool, now: float) -> None:
        """Follow the list to an index, which may also be that of a change that the vehicle pushed."""
        if is_repeated:
            self._repeated_in_row += 1
        else:
            self._repeated_in_row = self._empty_passes = 0
        stream = self._stream
        if self._is_streaming and index > stream.front:
            behind = stream.front + 1
            if not stream.takes(index, now):
                return
            if index > behind and not self._reads.pace.is_batched:
                stream.pass_over(hole for hole in range(behind, index) if hole not in self.names)
        stream.received_at = now
        count = self.count or 0
        if stream.front == count - 1 or len(self.names) >= count:
            self._stream_ends()
        elif self._repeated_in_row > count:
            # other stations restart the list again and again: read the missing values instead
            self._passes = LISTS_MAX
            self._stream_ends()

    def _learn_pace(self) -> None:
        """Pass the list's pace to the reads: computed when needed, not for each value."""
        stream = self._stream
        stream.measure()
        if stream.is_at_pace:
            received, covered, _, is_bursty = stream.seen()
            loss = 1 - received / covered if covered else 0.0
            self._round_trip.list_loss = 1.0 - (1.0 - loss) ** 2
            gain = PACED_GAIN if self._reads.pace.is_batched else 1.0
            self._reads.pace.stream_seen(stream.gap, loss, BURST_GAIN if is_bursty else gain)

    def _stream_ends(self, *, is_cut: bool = False) -> None:
        self._learn_pace()
        if self._reads.list_runs_again:
            self._reads.pace.rest()  # responses that the list may have brought were not counted
        self._is_streaming = self._reads.list_runs_again = False
        self._reads.is_idle = True
        self.held_since = None
        self._reads.pace.stream_ended()
        self._list_admission.release(self, is_cut=is_cut)

    def _start_over(self, count: int | None) -> None:
        """Start again: the count has changed, and earlier indices may mean other parameters now."""
        if self._is_streaming:
            self._learn_pace()
        self._forget_reads()
        self._ahead_at = None
        self._count_changes += 1
        self.count = count
        self.names.clear()
        self._lost.clear()
        self._places.clear()
        self.resumed = 0
        self.given_up.clear()
        self._tries.clear()
        self._stream.rewind()
        self._stream.is_awaited = True
        self._next = self._repeated_in_row = 0
        self._other_count = None

    def _ask_for_gaps(self, now: float) -> None:
        count = self.count
        if self.done or count is None or self._other_count is not None or self.gives_way:
            return
        if self._is_streaming:
            if self._reads.pace.is_batched:
                self._read_at_the_end(now)
                return
            self._learn_pace()
            for index in self._stream.lost():
                if len(self._requested) >= REQUESTED_INDICES_MAX:
                    break
                del self._stream.holes[index]
                if index not in self._requested and index not in self.given_up:
                    self._ask(index, now)
        elif self._ahead_at is not None or self._another_pass_is_faster(
            count - len(self.names) - len(self.given_up)
        ):
            self._lost.update(self.missing)
            self._ask_for_another_pass(now)
        else:
            self._read_missing_below(count, now)

    @property
    def _ending_at(self) -> float:
        """When something sent now reaches the vehicle at the end of its list; infinity where unknown.

        ArduPilot's list is evenly spaced. Reads in parallel cost the list more than they bring.
        """
        stream, trip = self._stream, self._round_trip.shortest
        if not (self._is_streaming and self._reads.pace.is_batched) or stream.is_awaited or trip == math.inf:
            return math.inf
        last = (self.count or 0) - 1
        if stream.front < last // 2:
            return math.inf  # its pace is not known well enough
        return stream.ends_at(last) - min(trip, LEAD_MAX) + LEAD_MARGIN

    def _read_at_the_end(self, now: float) -> None:
        """Read the skipped indices, timed so that the requests arrive at the end of the list.

        If another pass is faster, it is requested.
        """
        if self._ahead_at is not None or now < self._ending_at:
            return
        self._learn_pace()
        front = self._stream.front - LIST_REORDER_DEPTH
        missing = [index for index in range(self.count or 0) if index not in self.names]
        passed_over = sum(index < front for index in missing)
        to_be_lost = round(self._stream_loss * (len(missing) - passed_over))
        if self._requested or not self._another_pass_is_faster(passed_over + to_be_lost):
            self._read_missing_below(front, now)
        elif not self._is_parallel_to_file:
            self._ahead_at = now
            self._request_list()

    def _read_missing_below(self, end: int, now: float) -> None:
        """Read what is missing below an index and was not requested."""
        while len(self._requested) < REQUESTED_INDICES_MAX and self._next < end:
            index = next(filterfalse(self.names.__contains__, range(self._next, end)), end)
            self._next = min(index + 1, end)
            if not (index == end or index in self.given_up or index in self._requested):
                self._ask(index, now)

    def _another_pass_is_faster(self, missing: int) -> bool:
        if self.count is None or self._passes >= LISTS_MAX or missing <= MISSING_WITHOUT_LIST_MAX:
            return False
        if self._empty_passes >= EMPTY_LISTS_MAX or not self._list_admission.is_free:
            return False
        trip = self._round_trip.smoothed or self._retry_policy.timeout
        by_pass = self.count * self._stream.gap + trip + self._time_to_read(missing * self._stream_loss)
        if self._reads.pace.is_batched:
            # the vehicle serves them before its list
            by_pass += len(self._requested) / self._reads.pace.prospect
        return self._time_to_read(missing) > RELIST_GAIN * by_pass

    @property
    def _stream_loss(self) -> float:
        """The packet loss of the last pass, as a share of its values."""
        received, covered, _, _ = self._stream.seen()
        return 1.0 - received / covered if covered else 0.0

    def _time_to_read(self, missing: float) -> float:
        """Return the seconds for this many single reads, by the rate and the loss measured on this link.

        The last one to be answered needs about as many attempts as would lose all of them.
        """
        if missing < 1.0:
            return missing * self._retry_policy.timeout
        loss = min(max(self._round_trip.seen_loss, 1.0 - (1.0 - self._stream_loss) ** 2), LOSS_MAX)
        tries = math.log(missing) / -math.log(loss) if loss > 0.0 else 0.0
        return missing / (self._reads.pace.prospect * (1.0 - loss)) + tries * self._retry_policy.timeout / 2

    def _ask(self, index: int, now: float) -> None:
        self._lost.add(index)
        if self._stream.front in self.names:
            self._reads.control = self._stream.front
        read = self._requested[index] = self._reads.ask(index, now, urgent=False)

        def ended() -> None:
            if self._requested.get(index) is not read:
                return
            del self._requested[index]
            if index not in self.names and self._other_count is None:
                self._unanswered(index, read)
            self._ask_for_gaps(read.ended_at)
            self._finish_if_complete(read.ended_at)

        read.on_done.append(ended)

    def _unanswered(self, index: int, read: Read) -> None:
        """Decide after an unanswered read whether to repeat it or to give it up."""
        now = read.ended_at
        if isinstance(read.error, NoReply) and read.begun_at <= self._list_admission.parallel_to_others_at(
            self
        ):
            self._reads.reset_timeouts()  # the vehicle may have had no bandwidth to answer
        elif not isinstance(read.error, NoReply) or self._seems_dead(index, read):
            self.given_up.add(index)
            return
        elif self._retry_policy.is_silent_too_long(now) or self._reads.is_silent(now):
            self._give_up_missing()
        self._next = min(self._next, index)

    def _seems_dead(self, index: int, read: Read) -> bool:
        """Return whether reads sent together with it were answered too often for mere packet loss."""
        attempts, controls = self._tries.get(index, (0, 0))
        attempts, controls = attempts + read.attempts, controls + read.request.controls
        self._tries[index] = attempts, controls
        return ReadRetries.is_dead_index(attempts, controls)

    def _finish_if_complete(self, now: float) -> None:
        if self.done or self.count is None or self._is_streaming or self._requested:
            return
        if self.gives_way and len(self.names) < self.count:
            return
        if self._other_count is not None:
            # responses had another count than the list: its indices are stale
            self._start_over(self._other_count)
            if self._passes < LISTS_MAX:
                self._ask_for_another_pass(now)
            else:
                self._ask_for_gaps(now)
        elif self.resumed and not self._is_received:
            (self._end_unanswered if self._is_checked else self._check)(now)
        else:
            self.finish(None, now)  # every missing index was requested and given up

    def _give_up_missing(self) -> None:
        """Give up all missing indices: no read was answered while one used up its attempts."""
        if not self._is_streaming and self.count is not None:
            self._forget_reads()
            self.given_up.update(index for index in range(self.count) if index not in self.names)

    def _forget_reads(self) -> None:
        open_reads, self._requested = self._requested, {}
        for read in open_reads.values():
            self._reads.release(read)

    def _end_unanswered(self, now: float) -> None:
        """End with an error: nothing was received."""
        self._stream_ends()
        system, component = self._target
        what = f"the parameter list of {system}/{component}"
        waited = now - self.begun_at - self.queue_time
        self.fail(NoReply(what, attempts=self.lists, waited=waited), now)


def present_of(table: Table, reads: Reads) -> dict[int, str]:
    """Return the present names of an unfinished table by index; none where they are too few to resume."""
    count = table.count
    if table.complete or not count:
        return {}
    present = table.present()
    # once a list's pace is measured, the download decides whether another pass is faster
    return present if reads.pace.gap or len(present) >= RESUME_SHARE_MIN * count else {}
