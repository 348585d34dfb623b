"""Fetch every parameter of a component: the list's stream, its gaps, and what becomes of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from paramclient.errors import NoReply
from paramclient.protocol.params.list_stream import LONGEST_JUMP, REORDER_DEPTH, SHORTEST_QUIET, ListStream
from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.round_trip import LONGEST_SILENCE
from paramclient.protocol.scheduler import Seen, Turns
from paramclient.protocol.wire import MOST_PARAMETERS, NO_INDEX, ParamRequestList, ParamValue

__all__ = ["Download", "present_of"]

ENOUGH_PRESENT: Final = 0.5
"""The share of a table that must be there for its rest to be worth asking for one by one, where it is not
known how fast the list comes."""
LIST_PATIENCE: Final = 20.0
"""Seconds of silence after which PARAM_REQUEST_LIST counts as not answered: longer than ArduPilot leaves it
unanswered after a boot."""
LIST_DELAY: Final = 0.13
"""Seconds by which the first value of ArduPilot's list may come later than a short answer (measured: up to
0.09 s). Asking again meanwhile begins it anew."""
LIST_VARIATION: Final = 3.0
"""How many times longer than the first list another one may take to begin: reads, which wait for each other,
say less of that."""
LIST_RISK: Final = 0.05
MOST_LISTS_AT_ONCE: Final = 3
"""The chance of no answer to go below, where the list is asked for another time, by asking twice at once. The
first time PX4 would take the second for a restart, and leave out its hash."""
LIST_TRIES: Final = 12
"""Times that it is asked for, at the least, when the component is heard: enough where many are lost."""
LONGEST_LIST_WAIT: Final = 2.5
"""Seconds between two of them, at the most, on a link that answers sooner than that."""
EVEN_LISTS: Final = 3
"""Of these the first follow each other without a longer wait: they were lost rather than left unanswered."""
MOST_PASSES: Final = 20
"""Times that the list may be asked for: anew when the count has moved, or when too much is missing to be read
one by one."""
MOST_VAIN_PASSES: Final = 3
"""Passes in a row that bring nothing, after which only single reads are tried."""
MOST_MOVES: Final = 8
"""Times that a moved count makes everything count again. A table that still moves is taken as it comes."""
FEW: Final = 24
"""Missing values that are never worth another pass of the list."""
MOST_ASKED: Final = 256
"""Indices asked for at a time; the pace of the reads says how many of them are in flight."""
RELIST_GAIN: Final = 1.2
"""How many times faster another pass of the list must be than single reads, by the rates measured so far."""
LONGEST_LEAD: Final = 0.2
"""Seconds before the end of ArduPilot's list from which reads are sent at the earliest: the list pauses only
0.2 s after the first read (measured)."""
LEAD_MARGIN: Final = 0.02
"""Seconds by which a request for another pass is to arrive behind the expected end of this one: one that
arrives before it cuts it off."""
MOST_LOSS: Final = 0.9
"""The share of lost exchanges with which is reckoned at most."""
ASSUMED_LIST: Final = 5.0
"""Seconds that a list is taken to last before its pace was measured: on a cable one, on a radio thirty."""
DEAD: Final = 1e-3
"""The chance of bad luck below which an index counts as dead, by what was answered while it kept silent."""
BURST_GAIN: Final = 3.0
"""How many times faster than such a stream the link is taken to be: within a burst of PX4 it is a lot more,
but a program that was busy sees bursts on any link."""
PACED_GAIN: Final = 1.3
"""The same for ArduPilot, whose list takes 30 % of what its port carries (measured): single reads may then be
as many as its list has values."""


class Download(Operation[None]):
    """One download by list. It ends by itself, and then `missing` says what did not come.

    The stream goes by rising index. An index that it passed over is asked for while it still runs; what is
    ahead of it is left to it, until it falls quiet. PX4 starts its stream anew, without a hash, when it hears
    a second PARAM_REQUEST_LIST: so that is sent again only while nothing has come, or when a moved count has
    made what came worthless.

    The count may move: then indices shift, and everything counts again from that moment. Answers to single
    reads tell the count of now while a running stream of ArduPilot goes by that of its beginning; so a
    different count in an answer is noted, and settled by another pass when the stream is over.

    The list waits for its turn where others of the same link run. It does not end before its time while the
    component answers, however slowly: an index is given up when others are answered that are asked for
    together with it, and all of them when nothing at all is for `LONGEST_SILENCE`.

    With what is there already only the rest is asked for. Should that turn out to be of another count, or to
    have other names, it counts as nothing.

    Args:
        target, round_trip, send, reads, turns, now: as their names say.
        listed: whether the list was requested already.
        count, present: what is there already, by index, of so many parameters.
        beside_file: whether a file has been requested that may still bring everything. Then no pass is
            requested before the one before it has ended.

    Attributes:
        count: parameters that the vehicle said it has; None before the first value.
        names: what came under that count, by index.
        given_up: indices that stayed silent too often, or were answered with what cannot be true.
        repeated: values that came although they had come before.
        resumed: how many of them were there already.
        lists: how often the list was asked for.
        gives_way: whether what the list leaves missing comes otherwise, so that it is not asked for again.
        held_up: seconds for which it waited for its turn; with `held_since` while it waits.
        held_since: since when it waits, or None.
    """

    def __init__(
        self,
        context: Context,
        reads: Reads,
        turns: Turns,
        now: float,
        *,
        listed: bool = False,
        count: int | None = None,
        present: Mapping[int, str] | None = None,
        beside_file: bool = False,
    ) -> None:
        super().__init__(now)
        self._target = context.target
        self._round_trip = context.round_trip
        self._send = context.send
        self._reads = reads
        self._turns = turns
        self.count = count if present else None
        self.names = dict(present or {})
        self.resumed = len(self.names)
        self.given_up: set[int] = set()
        self.repeated = 0
        self._lost: set[int] = set()
        self.lists = 0
        self.gives_way = False
        self._is_beside_file = beside_file
        self.held_up = 0.0
        self.held_since: float | None = None
        self._passes = 1
        self._vain_passes = 0
        self._moves = 0
        self._stream = ListStream(now)
        self._asked: dict[int, Read] = {}
        self._next = 0  # below it, whatever is missing was asked for since the stream was over
        self._vain = 0  # values in a row that had come before
        self._is_streaming = True
        self._other_count: int | None = None
        self._silent_at = math.inf  # when an unanswered list no longer takes anything of the link
        self._tries: dict[int, tuple[int, int]] = {}  # what reads in vain have shown: requests, controls
        self._places = {name: index for index, name in self.names.items()}  # of what was there already
        self._is_heard = self._is_checked = False  # whether anything has come, and was asked for to see that
        self._list_patience = math.inf  # how long another pass may let its first value be waited for
        self._is_answered = False  # the first answer to it tells the round trip
        self._list_wait = 0.0
        self._ahead_at: float | None = None  # when the next pass was requested, before the end of this one
        self._list_asked = 0  # times since the turn began
        self._is_heeded = False  # its head has come since
        self._has_looked = False  # at what it has passed over, as its end is near
        self._list_at = now
        self._patient_since = now
        if listed:
            self.lists = 1
            self._list_wait = self._round_trip.repeat_timeout(1) + LIST_DELAY
            self._list_asked = 1
            self._silent_at = now + self._list_wait
            turns.has_begun(self)
        elif present:
            self._go_on(now)
        else:
            self._ask_for_turn(now)

    @property
    def received(self) -> int:
        return len(self.names)

    @property
    def lost(self) -> int:
        """Values that the list should have brought and did not.

        So many of its indices had to be asked for one by one, or by another pass. What comes late counts as
        lost once it was asked for.
        """
        return len(self._lost)

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices below the count that have not come, rising."""
        return tuple(index for index in range(self.count or 0) if index not in self.names)

    @property
    def is_settled(self) -> bool:
        """Whether the count came to rest."""
        return self._moves < MOST_MOVES

    @property
    def progress(self) -> tuple[int, int | None]:
        """Received, and total where it is known."""
        return self.received, self.count

    @property
    def is_awaited(self) -> bool:
        """Whether nothing has come of the list since it was asked for."""
        return self._stream.is_awaited

    @property
    def silent_at(self) -> float:
        """While nothing has come of the list: when that has lasted too long."""
        return self._silent_at if self._stream.is_awaited else math.inf

    def seen(self) -> Seen:
        """What the list has shown since it was asked for."""
        return self._stream.seen()

    def begin(self, now: float) -> None:
        """It is this list's turn."""
        if self.held_since is not None:
            self.held_up += now - self.held_since
            self.held_since = None
        self._patient_since = now
        is_running = self._stream.is_at_pace and now < self._quiet_at
        if self.lists == 0 and is_running:
            return  # somebody else has asked for it meanwhile
        self._stream.rewind()
        self._stream.heard_at = now
        self._list_wait = 0.0
        self._list_asked = 0
        self._ask_for_list(now)
        self._silent_at = now + self._list_wait

    def held_for(self, now: float) -> float:
        """Seconds for which it has waited for its turn so far."""
        return self.held_up + (0.0 if self.held_since is None else now - self.held_since)

    def heard(self, message: ParamValue, now: float) -> None:
        """Every PARAM_VALUE of the component passes here, before the reads take their answers."""
        name, _, _, count, index = message
        stream = self._stream
        if count == self.count and index == stream.front + 1 and self._goes_straight_on(index):
            self.names[index] = name
            self._vain = 0
            stream.goes_on(index, now)
            return
        if index >= count or count > MOST_PARAMETERS:
            if index == NO_INDEX and self.count is not None and count <= MOST_PARAMETERS:
                # pushed, or an answer by name: it goes by the count of now, where ArduPilot's stream does not
                self._other_count = None if count == self.count else count
            return
        if self.done:
            return
        self._is_heard = True
        if self._ahead_at is not None and index <= LONGEST_JUMP < stream.front:
            self._stream_ends()  # the pass that was requested before its end has begun
            self._ahead_at = now
            self._ask_for_another_pass(now)
        if self.count is None:
            self._note_answer(now)
            self.count = count
        elif self.resumed and self._contradicts(index, name) and count == self.count:
            self._start_over(count)
            self._ask_for_another_pass(now)
        elif count != self.count and self._moves < MOST_MOVES:
            if index in self._asked or not self._is_streaming:
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
        if index not in self._asked:
            self._follow(index, is_repeated, now)
        if (holes and self.held_since is None) or self._asked or not self._is_streaming:
            self._ask_for_gaps(now)
            self._finish_if_complete(now)

    def _goes_straight_on(self, index: int) -> bool:
        """Whether the next value of a list that runs brings nothing but itself: so it is with nearly all."""
        stream, left = self._stream, (self.count or 0) - 1
        if index in self.names or index >= left or len(self.names) >= left or not self._is_streaming:
            return False
        is_troubled = self._asked or stream.holes or self.given_up or self._vain_passes or self.resumed
        return not (is_troubled or stream.is_awaited or self.done)

    def heed(self, now: float) -> None:
        """The head of the list has come: it was heard, and is not asked for again yet.

        Once for each time that it was asked for: one head after the other, and no list, must not keep a turn.
        """
        if self.count is None and not self._is_heeded:
            self._is_heeded = True
            self._note_answer(now)
            self._list_at = now
            self._list_wait = max(self._list_wait, SHORTEST_QUIET)
            self._silent_at = now + self._list_wait

    def go_on(self, now: float) -> None:
        """What is missing does not come otherwise."""
        self.gives_way = self._is_beside_file = False
        self.tick(now)

    def tick(self, now: float) -> None:
        """Ask for the list again, or see that the stream is over."""
        if self.done or self.held_since is not None:
            return
        if self.count is None:
            if self._list_at + self._list_wait <= now and not self.gives_way:
                if self._turns.is_beside_others(self):
                    self._patient_since = now  # it may have no room to answer
                is_gone = now - self._round_trip.heard_at >= LONGEST_SILENCE
                is_enough = is_gone or self._list_asked >= LIST_TRIES
                if is_enough and now - self._patient_since >= LIST_PATIENCE:
                    self._end_in_vain(now)
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
        """When to see what the list has passed over: once for each pass, as its end comes near."""
        return math.inf if self._has_looked else self._ending_at

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity. The reads have deadlines of their own."""
        if self.done or self.held_since is not None:
            return math.inf
        if self.count is None:
            return math.inf if self.gives_way else self._list_at + self._list_wait
        if not self._is_streaming:
            return math.inf
        return self._quiet_at if self._asked or self.gives_way else min(self._quiet_at, self._end_look_at)

    def resume(self, now: float) -> None:
        """The link is back: what was not sent while it was away is worth asking for now."""
        self._list_at = now - self._list_wait
        self._patient_since = self._stream.heard_at = now
        self._silent_at = now + self._round_trip.timeout

    def cancel(self) -> None:
        """Nobody waits for it any more; a stream that runs goes on and still fills the table."""
        stream = self._stream
        if self._is_streaming and not stream.is_awaited and self.count is not None:
            self._learn_pace()
            left = self.count - stream.front + (0 if self._ahead_at is None else self.count)
            self._reads.list_until = self._quiet_at + left * stream.gap
        self._stream_ends()
        self._forget_reads()

    @property
    def _quiet_at(self) -> float:
        """When a stream from which nothing more has come is taken to be over."""
        timeout = self._round_trip.timeout
        if self._stream.is_awaited and self._passes > 1:
            timeout = min(timeout, self._list_patience)
        stream = self._stream
        quiet_at = stream.quiet_at(timeout, (self.count or 0) - 1 - stream.front)
        if stream.is_bursty and self._turns.is_beside_others(self):
            # on a link so fast it is the program that has no time for more, or the vehicle, and pauses
            return max(quiet_at, stream.heard_at + max(SHORTEST_QUIET, timeout))
        return quiet_at

    def _note_answer(self, now: float) -> None:
        if not self._is_answered and self.lists:
            self._is_answered = True
            self._round_trip.answered(self._list_at, now, self.lists)
            if self.lists == 1:
                self._list_patience = LIST_VARIATION * (now - self._list_at)

    def _go_on(self, now: float) -> None:
        """Ask for what is missing, unless a list still comes that will bring it."""
        assert self.count is not None
        self._stream.gap = self._reads.pace.gap or ASSUMED_LIST / self.count
        self._is_streaming = now < self._reads.list_until and len(self.names) < self.count
        self._reads.is_idle = not self._is_streaming
        if not self._is_streaming:
            self._check(now)
            self._ask_for_gaps(now)

    def _check(self, now: float) -> None:
        """Ask for one value that is there: its answer tells whether count and indices are still the same."""
        self._is_checked = True
        self._ask(max(self.names), now)

    def _contradicts(self, index: int, name: str) -> bool:
        """Whether a value shows that what was there already is not of the vehicle as it is now."""
        return self.names.get(index, name) != name or self._places.get(name, index) != index

    def _ask_for_turn(self, now: float) -> None:
        self.held_since = now
        self._turns.ask(self, now)

    def _ask_for_list(self, now: float) -> None:
        self._list_at = now
        self._is_heeded = self._has_looked = False
        self._list_asked += 1
        timeout = self._round_trip.repeat_timeout(self._list_asked)
        if self._round_trip.smoothed is not None:
            timeout += LIST_DELAY
        growth = 2 if self._list_asked > EVEN_LISTS else 1
        self._list_wait = max(min(self._list_wait * growth, LONGEST_LIST_WAIT), timeout)
        self._stream.is_awaited = True
        self._reads.is_idle = False
        ahead_at, self._ahead_at = self._ahead_at, None
        if ahead_at is not None and now < ahead_at + timeout:
            self._list_at = ahead_at
        else:
            self._request_list()

    def _request_list(self) -> None:
        self.lists += 1
        copies = self._round_trip.copies(LIST_RISK, MOST_LISTS_AT_ONCE)
        if self._passes == 1 and not self._reads.pace.is_batched:
            copies = 1
        for _ in range(copies):
            self._send(ParamRequestList(*self._target))

    def _ask_for_another_pass(self, now: float) -> None:
        self._passes += 1
        self._vain_passes += 1
        self._vain = 0
        self._is_streaming = self._reads.list_runs_again = True
        self._next = 0
        self._ask_for_turn(now)

    def _follow(self, index: int, is_repeated: bool, now: float) -> None:
        """The stream has brought an index, or the vehicle has pushed a change into it."""
        if is_repeated:
            self._vain += 1
        else:
            self._vain = self._vain_passes = 0
        stream = self._stream
        if self._is_streaming and index > stream.front:
            behind = stream.front + 1
            if not stream.takes(index, now):
                return
            if index > behind and not self._reads.pace.is_batched:
                stream.pass_over(hole for hole in range(behind, index) if hole not in self.names)
        stream.heard_at = now
        count = self.count or 0
        if stream.front == count - 1 or len(self.names) >= count:
            self._stream_ends()
        elif self._vain > count:
            # others begin the list anew again and again: leave it to them, and read what is missing
            self._passes = MOST_PASSES
            self._stream_ends()

    def _learn_pace(self) -> None:
        """What the stream has told of the link so far: worked out when it is needed, not for each value."""
        stream = self._stream
        stream.measure()
        if stream.is_at_pace:
            came, passed, _, is_bursty = stream.seen()
            loss = 1 - came / passed if passed else 0.0
            self._round_trip.list_loss = 1.0 - (1.0 - loss) ** 2
            gain = PACED_GAIN if self._reads.pace.is_batched else 1.0
            self._reads.pace.stream_seen(stream.gap, loss, BURST_GAIN if is_bursty else gain)

    def _stream_ends(self, *, is_cut: bool = False) -> None:
        self._learn_pace()
        if self._reads.list_runs_again:
            self._reads.pace.rest()  # answers that the list may have given were not counted
        self._is_streaming = self._reads.list_runs_again = False
        self._reads.is_idle = True
        self.held_since = None
        self._reads.pace.stream_ended()
        self._turns.give_back(self, is_cut=is_cut)

    def _start_over(self, count: int | None) -> None:
        """The count has moved: indices heard before may mean other parameters now."""
        if self._is_streaming:
            self._learn_pace()
        self._forget_reads()
        self._ahead_at = None
        self._moves += 1
        self.count = count
        self.names.clear()
        self._lost.clear()
        self._places.clear()
        self.resumed = 0
        self.given_up.clear()
        self._tries.clear()
        self._stream.rewind()
        self._stream.is_awaited = True
        self._next = self._vain = 0
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
                if len(self._asked) >= MOST_ASKED:
                    break
                del self._stream.holes[index]
                if index not in self._asked and index not in self.given_up:
                    self._ask(index, now)
        elif self._ahead_at is not None or self._another_pass_is_faster(
            count - len(self.names) - len(self.given_up)
        ):
            self._lost.update(self.missing)
            self._ask_for_another_pass(now)
        else:
            self._ask_in_order(count, now)

    @property
    def _ending_at(self) -> float:
        """When something that is sent reaches the vehicle at the end of its list; infinity where unknown.

        ArduPilot's list comes evenly. Reads beside it take more from it than they bring.
        """
        stream, trip = self._stream, self._round_trip.shortest
        if not (self._is_streaming and self._reads.pace.is_batched) or stream.is_awaited or trip == math.inf:
            return math.inf
        last = (self.count or 0) - 1
        if stream.front < last // 2:
            return math.inf  # its pace is not known well enough
        return stream.ends_at(last) - min(trip, LONGEST_LEAD) + LEAD_MARGIN

    def _read_at_the_end(self, now: float) -> None:
        """Ask for what the list has passed over, so that the requests arrive when it is over.

        Where another pass brings that sooner, it is requested.
        """
        if self._ahead_at is not None or now < self._ending_at:
            return
        self._learn_pace()
        front = self._stream.front - REORDER_DEPTH
        missing = [index for index in range(self.count or 0) if index not in self.names]
        passed_over = sum(index < front for index in missing)
        to_be_lost = round(self._stream_loss * (len(missing) - passed_over))
        if self._asked or not self._another_pass_is_faster(passed_over + to_be_lost):
            self._ask_in_order(front, now)
        elif not self._is_beside_file:
            self._ahead_at = now
            self._request_list()

    def _ask_in_order(self, stop: int, now: float) -> None:
        """Ask for what is missing below an index, and was not asked for."""
        while len(self._asked) < MOST_ASKED and self._next < stop:
            index = self._next
            self._next += 1
            if not (index in self.names or index in self.given_up or index in self._asked):
                self._ask(index, now)

    def _another_pass_is_faster(self, missing: int) -> bool:
        if self.count is None or self._passes >= MOST_PASSES or missing <= FEW:
            return False
        if self._vain_passes >= MOST_VAIN_PASSES or not self._turns.is_free:
            return False
        trip = self._round_trip.smoothed or self._round_trip.timeout
        by_pass = self.count * self._stream.gap + trip + self._time_to_read(missing * self._stream_loss)
        if self._reads.pace.is_batched:
            by_pass += len(self._asked) / self._reads.pace.prospect  # its list waits until they are served
        return self._time_to_read(missing) > RELIST_GAIN * by_pass

    @property
    def _stream_loss(self) -> float:
        """The share of the list's values that are lost, as far as the last pass has shown."""
        came, passed, _, _ = self._stream.seen()
        return 1.0 - came / passed if passed else 0.0

    def _time_to_read(self, missing: float) -> float:
        """Seconds that so many single reads take, by the rate and the loss measured on this link.

        The last one of them to be answered needs about so many tries that all of them would have been lost.
        """
        if missing < 1.0:
            return missing * self._round_trip.timeout
        loss = min(max(self._round_trip.seen_loss, 1.0 - (1.0 - self._stream_loss) ** 2), MOST_LOSS)
        tries = math.log(missing) / -math.log(loss) if loss > 0.0 else 0.0
        return missing / (self._reads.pace.prospect * (1.0 - loss)) + tries * self._round_trip.timeout / 2

    def _ask(self, index: int, now: float) -> None:
        self._lost.add(index)
        if self._stream.front in self.names:
            self._reads.control = self._stream.front
        read = self._asked[index] = self._reads.ask(index, now, urgent=False)

        def ended() -> None:
            if self._asked.get(index) is not read:
                return
            del self._asked[index]
            if index not in self.names and self._other_count is None:
                self._unanswered(index, read)
            self._ask_for_gaps(read.ended_at)
            self._finish_if_complete(read.ended_at)

        read.on_done.append(ended)

    def _unanswered(self, index: int, read: Read) -> None:
        """A read has ended without its value: for good, or is it worth asking again?"""
        now = read.ended_at
        if isinstance(read.error, NoReply) and read.begun_at <= self._turns.beside_others_at(self):
            self._reads.forgive()  # there may have been no room for an answer
        elif not isinstance(read.error, NoReply) or self._seems_dead(index, read):
            self.given_up.add(index)
            return
        elif now - self._round_trip.heard_at >= LONGEST_SILENCE or self._reads.is_silent(now):
            self._give_up_the_rest()
        self._next = min(self._next, index)

    def _seems_dead(self, index: int, read: Read) -> bool:
        """Whether what was asked for together with it was answered too often for this to be bad luck."""
        attempts, controls = self._tries.get(index, (0, 0))
        attempts, controls = attempts + read.attempts, controls + read.controls
        self._tries[index] = attempts, controls
        answered = min(controls / max(attempts - 2, 1), 1.0)
        return (1.0 - answered) ** attempts < DEAD

    def _finish_if_complete(self, now: float) -> None:
        if self.done or self.count is None or self._is_streaming or self._asked:
            return
        if self.gives_way and len(self.names) < self.count:
            return
        if self._other_count is not None:
            # answers went by another count than the stream: its indices are of the past
            self._start_over(self._other_count)
            if self._passes < MOST_PASSES:
                self._ask_for_another_pass(now)
            else:
                self._ask_for_gaps(now)
        elif self.resumed and not self._is_heard:
            (self._end_in_vain if self._is_checked else self._check)(now)
        else:
            self.finish(None, now)  # whatever has not come was asked for and given up

    def _give_up_the_rest(self) -> None:
        """Nothing at all was answered while one read used up its tries: more of them lead nowhere."""
        if not self._is_streaming and self.count is not None:
            self._forget_reads()
            self.given_up.update(index for index in range(self.count) if index not in self.names)

    def _forget_reads(self) -> None:
        asked, self._asked = self._asked, {}
        for read in asked.values():
            self._reads.release(read)

    def _end_in_vain(self, now: float) -> None:
        """Nothing has come."""
        self._stream_ends()
        system, component = self._target
        what = f"the parameter list of {system}/{component}"
        waited = now - self.begun_at - self.held_up
        self.fail(NoReply(what, attempts=self.lists, waited=waited), now)


def present_of(table: Table, reads: Reads) -> dict[int, str]:
    """What is there of an unfinished table, by index; nothing where that is too little to go on with."""
    count = table.count
    if table.complete or not count:
        return {}
    present = table.present()
    # with a list's pace measured, the download finds out itself whether another one is faster
    return present if reads.pace.gap or len(present) >= ENOUGH_PRESENT * count else {}
