"""Fetch every parameter of a component: the list's stream, its gaps, and what becomes of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from paramclient.errors import NoReply
from paramclient.protocol.operation import Operation
from paramclient.protocol.reads import Read, Reads
from paramclient.protocol.timing import RoundTrip
from paramclient.protocol.wire import NO_INDEX, Message, ParamRequestList, ParamValue

__all__ = ["Download"]

LIST_PATIENCE: Final = 20.0
"""Seconds of silence after which PARAM_REQUEST_LIST counts as not answered: longer than ArduPilot leaves it
unanswered after a boot."""
LONGEST_LIST_WAIT: Final = 5.0
"""Seconds between two of them, at the most, on a link that answers sooner than that."""
MOST_PASSES: Final = 20
"""Times that the list may be asked for: anew when the count has moved, or when too much is missing to be read
one by one."""
MOST_VAIN_PASSES: Final = 3
"""Passes in a row that bring nothing, after which only single reads are tried."""
MOST_MOVES: Final = 8
"""Times that a moved count makes everything count again. A table that still moves is taken as it comes."""
SHORTEST_QUIET: Final = 0.25
"""Seconds without a value after which a stream may be over, at the least: PX4 sends every 20 ms, ArduPilot
every 10."""
REORDER_DEPTH: Final = 3
"""Later values that must have come before a missing one counts as lost, as in TCP's fast retransmit."""
ENOUGH_ADVANCES: Final = 20
"""Values after which the stream's own pace is known."""
QUIET_GAPS: Final = 3.0
"""A stream that pauses for so many of its longest gaps is over; a radio's pauses count among its gaps."""
SHORTEST_QUIET_AT_PACE: Final = 0.06
LONGEST_JUMP: Final = 40
"""Indices that the stream may pass over at once. A longer jump is believed when the next value goes on from
there: PX4 pushes changed parameters, with their index, into a running stream."""
FEW: Final = 24
"""Missing values that are never worth another pass of the list."""
MOST_ASKED: Final = 256
"""Indices asked for at a time; the pace of the reads says how many of them are in flight."""
RELIST_GAIN: Final = 1.5
"""How many times faster another pass of the list must be than single reads, by the rates measured so far."""


class Download(Operation[None]):
    """One download by list. It ends by itself, and then `missing` says what did not come.

    The stream goes by rising index. An index that it passed over is asked for while it still runs; what is
    ahead of it is left to it, until it falls quiet. PX4 starts its stream anew, without a hash, when it hears
    a second PARAM_REQUEST_LIST: so that is sent again only while nothing has come, or when a moved count has
    made what came worthless.

    The count may move: then indices shift, and everything counts again from that moment. Answers to single
    reads tell the count of now while a running stream of ArduPilot goes by that of its beginning; so a
    different count in an answer is noted, and settled by another pass when the stream is over.

    Attributes:
        count: parameters that the vehicle said it has; None before the first value.
        names: what came under that count, by index.
        given_up: indices that stayed silent too often, or were answered with what cannot be true.
        repeated: values that came although they had come before.
        lists: how often the list was asked for.
    """

    def __init__(
        self,
        target: tuple[int, int],
        round_trip: RoundTrip,
        send: Callable[[Message], None],
        reads: Reads,
        now: float,
        *,
        listed: bool = False,
    ) -> None:
        super().__init__(now)
        self._target = target
        self._round_trip = round_trip
        self._send = send
        self._reads = reads
        self.count: int | None = None
        self.names: dict[int, str] = {}
        self.given_up: set[int] = set()
        self.repeated = 0
        self._lost: set[int] = set()
        self.lists = 0
        self._passes = 1
        self._vain_passes = 0
        self._moves = 0
        self._front = -1  # the highest index that the stream has reached
        self._front_at = now  # when that was
        self._jump = -1  # an index too far ahead to be believed at once
        self._advances = 0  # how often the stream went forward
        self._holes: dict[int, int] = {}  # what it passed over: index -> advances when that happened
        self._asked: dict[int, Read] = {}
        self._next = 0  # below it, whatever is missing was asked for since the stream was over
        self._vain = 0  # values in a row that had come before
        self._is_streaming = True
        self._other_count: int | None = None
        self._heard_at = now  # the last value of the stream
        self._began = (0, now)  # where and when the stream began
        self._gap = 0.0  # the mean time between two values of it
        self._longest = 0.0  # the longest of late
        self._is_awaited = True  # the list was asked for, and no value of it has come
        self._is_answered = False  # the first answer to it tells the round trip
        self._list_wait = 0.0
        self._list_at = now
        self._patient_since = now
        if listed:
            self.lists = 1
            self._list_wait = round_trip.timeout
        else:
            self._ask_for_list(now)

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

    def heard(self, message: ParamValue, now: float) -> None:
        """Every PARAM_VALUE of the component passes here, before the reads take their answers."""
        name, _, _, count, index = message
        if index == NO_INDEX and self.count is not None and count != NO_INDEX:
            # pushed, or an answer by name: it goes by the count of now, where ArduPilot's stream does not
            self._other_count = None if count == self.count else count
        if index == NO_INDEX or count == NO_INDEX or index >= count or self.done:
            return
        if self.count is None:
            self._note_answer(now)
            self.count = count
        elif count != self.count and self._moves < MOST_MOVES:
            if index in self._asked or not self._is_streaming:
                self._other_count = count
                return
            self._start_over(count)
        if index >= self.count:
            return
        if index in self._asked:
            self._take(index, name)
        else:
            self._follow(index, name, now)
        if self._holes or self._asked or not self._is_streaming:
            self._ask_for_gaps(now)
            self._finish_if_complete(now)

    def heed(self, now: float) -> None:
        """The head of the list has come: it was heard, and is not asked for again yet."""
        if self.count is None:
            self._note_answer(now)
            self._list_at = now
            self._list_wait = max(self._list_wait, SHORTEST_QUIET)

    def tick(self, now: float) -> None:
        """Ask for the list again, or see that the stream is over."""
        if self.done:
            return
        if self.count is None:
            if self._list_at + self._list_wait <= now:
                if now - self._patient_since >= LIST_PATIENCE:
                    system, component = self._target
                    what = f"the parameter list of {system}/{component}"
                    self._end_with_error(NoReply(what, attempts=self.lists, waited=now - self.begun_at), now)
                else:
                    self._ask_for_list(now)
            return
        if self._is_streaming and self._quiet_at <= now:
            self._stream_ends()
        self._ask_for_gaps(now)
        self._finish_if_complete(now)

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity. The reads have deadlines of their own."""
        if self.done:
            return math.inf
        if self.count is None:
            return self._list_at + self._list_wait
        return self._quiet_at if self._is_streaming else math.inf

    def resume(self, now: float) -> None:
        """The link is back: what was not sent while it was away is worth asking for now."""
        self._list_at = now - self._list_wait
        self._patient_since = self._heard_at = now

    def cancel(self) -> None:
        """Nobody waits for it any more; a stream that runs goes on and still fills the table."""
        self._stream_ends()
        self._forget_reads()

    @property
    def _quiet_at(self) -> float:
        """When a stream from which nothing more has come is taken to be over."""
        if self._advances < ENOUGH_ADVANCES or self._is_awaited:
            return self._heard_at + max(SHORTEST_QUIET, self._round_trip.timeout)
        return self._heard_at + max(QUIET_GAPS * self._longest, SHORTEST_QUIET_AT_PACE)

    def _note_answer(self, now: float) -> None:
        if not self._is_answered:
            self._is_answered = True
            self._round_trip.answered(self._list_at, now, self.lists)

    def _ask_for_list(self, now: float) -> None:
        self.lists += 1
        self._list_at = now
        timeout = self._round_trip.timeout
        self._list_wait = max(min(self._list_wait * 2, LONGEST_LIST_WAIT), timeout)
        self._is_awaited = True
        self._reads.is_idle = False
        self._send(ParamRequestList(*self._target))

    def _ask_for_another_pass(self, now: float) -> None:
        self._passes += 1
        self._vain_passes += 1
        self._list_wait = 0.0
        self._front = self._jump = -1
        self._vain = 0
        self._holes.clear()
        self._is_streaming = self._reads.list_runs_again = True
        self._heard_at = now
        self._ask_for_list(now)

    def _follow(self, index: int, name: str, now: float) -> None:
        """The stream has brought an index, or the vehicle has pushed a change into it."""
        if self._take(index, name):
            self._vain += 1
        else:
            self._vain = self._vain_passes = 0
        if self._is_streaming and index > self._front:
            if index - self._front > LONGEST_JUMP and not 0 < index - self._jump <= LONGEST_JUMP:
                self._jump = index
                return
            if self._is_awaited:
                self._is_awaited = False
                self._began = (index, now)
            else:
                self._longest *= 0.99
                if now - self._heard_at > self._longest:
                    self._longest = now - self._heard_at
            self._advances += 1
            if index - self._front > 1:
                for hole in range(self._front + 1, index):
                    if hole not in self.names:
                        self._holes[hole] = self._advances
            self._front = index
            self._front_at = now
        self._heard_at = now
        count = self.count or 0
        if self._front == count - 1 or len(self.names) >= count:
            self._stream_ends()
        elif self._vain > count:
            # others begin the list anew again and again: leave it to them, and read what is missing
            self._passes = MOST_PASSES
            self._stream_ends()

    def _take(self, index: int, name: str) -> bool:
        """Keep a name; tell whether one had come before."""
        is_repeated = index in self.names
        if is_repeated:
            self.repeated += 1
        self.names[index] = name
        if self._holes:
            self._holes.pop(index, None)
        if self.given_up:
            self.given_up.discard(index)
        return is_repeated

    def _learn_pace(self) -> None:
        """What the stream has told of the link so far: worked out when it is needed, not for each value."""
        first, since = self._began
        if self._front > first:
            self._gap = (self._front_at - since) / (self._front - first)
        if self._advances >= ENOUGH_ADVANCES:
            self._reads.pace.stream_seen(self._gap)

    def _stream_ends(self) -> None:
        self._learn_pace()
        self._is_streaming = self._reads.list_runs_again = False
        self._reads.is_idle = True

    def _start_over(self, count: int | None) -> None:
        """The count has moved: indices heard before may mean other parameters now."""
        self._learn_pace()
        self._forget_reads()
        self._moves += 1
        self.count = count
        self.names.clear()
        self._lost.clear()
        self.given_up.clear()
        self._holes.clear()
        self._front = self._jump = -1
        self._next = self._vain = 0
        self._is_awaited = True
        self._other_count = None

    def _ask_for_gaps(self, now: float) -> None:
        count = self.count
        if self.done or count is None or self._other_count is not None:
            return
        if self._is_streaming:
            self._learn_pace()
            for index, seen in list(self._holes.items()):
                if len(self._asked) >= MOST_ASKED or self._advances - seen < REORDER_DEPTH - 1:
                    break
                del self._holes[index]
                if index not in self._asked and index not in self.given_up:
                    self._ask(index, now)
        elif self._another_pass_is_faster(count - len(self.names) - len(self.given_up)):
            self._lost.update(self.missing)
            self._ask_for_another_pass(now)
        else:
            while len(self._asked) < MOST_ASKED and self._next < count:
                index = self._next
                self._next += 1
                if not (index in self.names or index in self.given_up or index in self._asked):
                    self._ask(index, now)

    def _another_pass_is_faster(self, missing: int) -> bool:
        if self.count is None or self._passes >= MOST_PASSES or missing <= FEW:
            return False
        if self._vain_passes >= MOST_VAIN_PASSES:
            return False
        trip = self._round_trip
        by_reads = missing / (self._reads.pace.prospect * (1 - trip.loss))
        return by_reads > RELIST_GAIN * (self.count * self._gap + (trip.smoothed or trip.timeout))

    def _ask(self, index: int, now: float) -> None:
        self._lost.add(index)
        read = self._asked[index] = self._reads.ask(index, now, urgent=False)

        def ended() -> None:
            if self._asked.get(index) is not read:
                return
            del self._asked[index]
            if index not in self.names and self._other_count is None:
                self.given_up.add(index)
                if isinstance(read.error, NoReply) and self._reads.answered_at <= read.begun_at:
                    self._give_up_the_rest()
            self._ask_for_gaps(read.ended_at)
            self._finish_if_complete(read.ended_at)

        read.on_done.append(ended)

    def _finish_if_complete(self, now: float) -> None:
        if self.done or self.count is None or self._is_streaming or self._asked:
            return
        if self._other_count is not None:
            # answers went by another count than the stream: its indices are of the past
            self._start_over(self._other_count)
            if self._passes < MOST_PASSES:
                self._ask_for_another_pass(now)
            else:
                self._ask_for_gaps(now)
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

    def _end_with_error(self, error: Exception, now: float) -> None:
        self._stream_ends()
        self.fail(error, now)
