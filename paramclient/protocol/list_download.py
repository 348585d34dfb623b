"""Download all parameters by the list: PARAM_REQUEST_LIST, and reads of the indices that were lost."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

import anyio

from paramclient.errors import NoReply, ParamErrorCode
from paramclient.protocol.channel import (
    ATTEMPTS_MAX,
    LATE_GRACE,
    LATE_WAKE_UP,
    UNANSWERED_MAX,
    Inbox,
    task_group,
)
from paramclient.protocol.dialect import Digest
from paramclient.protocol.session import Session
from paramclient.wire.messages import HASH_CHECK, PARAMETERS_MAX, Message, ParamError

LIST_REQUESTS_MAX: Final = 12
"""Requests for a list that does not begin: an ArduPilot ignores them early after its start."""
LIST_REQUESTS_ALONE: Final = 3
"""The first of them; reads of the index 1 or 0 take turns with the others, for firmware without a list. None
is alone where reads by index were answered, and reads by name were not."""
LIST_TIMEOUT_MIN: Final = 0.2
"""Seconds to wait for the first value of a list, at least: a second request makes the list begin again."""
PAUSE_PX4: Final = 0.12
"""Seconds without a value after which a PX4's list has ended: it sends 20 values every 20 ms."""
PAUSE_OTHERS: Final = 0.6
"""The same for other components: ArduPilot's list pauses for up to 0.5 s while it serves reads."""
PAUSE_TAIL: Final = 0.06
"""The same at the last values of a list, where a pause is rare."""
PAUSE_END: Final = 0.03
"""The same behind the last value by its count, which is false where others follow."""
INTERVALS_END: Final = 2
"""The same in mean intervals between two values, on a slow link."""
PAUSE_GROWING: Final = 2.0
"""The same for a component whose count grows or is false: only the pause tells the end of its list."""
PAUSE_INTERVALS: Final = 8
"""Mean intervals between two values after which a slow list has ended: PX4 sends 8 values a second in its
low-bandwidth mode."""
TAIL: Final = 4
"""Indices before the end of the list that may still be on their way when it is over."""
READS_PER_SECOND_ARDUPILOT: Final = 49.0
"""Reads that an ArduPilot serves in a second: five in every 100 ms."""
PASS_OVERHEAD: Final = 0.15
"""Seconds that another pass of the list takes beside its values."""
FRUITLESS_PASSES_MAX: Final = 5
"""Passes in a row without a new value, after which the count may be false: a request can be lost."""
TIMES_MAX: Final = 3
"""Times that a value may come in one list, requested by several programs: others are answers to reads."""
QUEUE_TIME: Final = 1.0
"""Seconds without a missing value after which no answer to a read waits behind others in the queue of a slow
radio: PX4 fills that with its list within a second, at 57600 baud for 6 s, and answers reads behind it."""
READS_AHEAD: Final = 4
"""Indices behind the last that are read at once where no list is served."""
ATTEMPTS_DOUBTFUL: Final = 3
"""Attempts to read the index 0 or one behind the last, where no list is served: others are answered."""
GAPS_INTERVAL: Final = 0.02
"""Seconds after which gaps are looked at again without a new value."""


@dataclass(slots=True)
class ListResult:
    """The result of a download.

    Attributes:
        missing: indices that were not received.
        lost: values of the list that were lost, and read one by one or by another list.
        repeated: values received more than once.
        digest: PX4's, which begins its list; it is of the table at that moment.
        has_gap: whether values are missing that were sent: some of the list were lost, and reads of them
            would not have been answered.
        is_served: whether values of a list arrived; else they were read one by one.
    """

    missing: list[int] = field(default_factory=list)
    lost: int = 0
    repeated: int = 0
    digest: Digest | None = None
    has_gap: bool = False
    is_served: bool = True


async def download_list(session: Session) -> ListResult:
    """Download the list into the table, and read what is lost of it.

    PX4 answers reads beside its list at once, so gaps are read while it runs. An ArduPilot's list almost
    stands still while it serves reads, so its gaps are read when it is over, or by another pass of the list
    where that is quicker, or where reads are not answered. A list that runs is not requested again. Ends with
    what was received when the component is lost.

    Raises:
        NoReply: the list does not begin.
        LinkError: the link is closed for good.
    """
    channel = session.channel
    with channel.inbox(session.dialect.value) as inbox:
        session.reading.setdefault(None, anyio.current_time())
        try:
            download = _Download(session, inbox)
            await download.begin()
            await download.run()
        finally:
            session.reading.pop(None, None)
            channel.is_streaming = False
    return download.result


class _Download:
    """The state of one download, while it runs: what was received when, and which reads are in flight."""

    def __init__(self, session: Session, inbox: Inbox) -> None:
        self.session = session
        self.channel = session.channel
        self.table = session.table
        self.result = ListResult()
        self.reads_beside = session.identification.is_px4
        self._inbox = inbox
        self._received: set[int] = set()  # indices of this list
        self._count: int | None = None
        self._began = 0.0
        self._begins_at = -math.inf  # at the latest, of a list that was requested repeatedly
        self._times: Counter[int] = Counter()  # that each index was received
        self._reached = -1  # the highest index
        self._listed = 0  # values of this pass that no read had asked for
        self._listed_at = 0.0  # when the last of them arrived
        self._rate_before = 0.0  # values per second of the quickest pass before it
        self._lost: set[int] = set()  # indices of values of the list
        self._skipped: set[int] = set()  # missing indices below the highest one
        self._reading: set[int] = set()  # indices whose reads are in flight
        self._tried: dict[int, int] = {}  # attempts in vain by index that was ever read
        self._gained_at = 0.0  # when the last value arrived that was missing

    async def begin(self) -> None:
        """Request the list until its first value arrives; later a value too, where no list is served."""
        channel, dialect, target = self.channel, self.session.dialect, self.channel.reads_from
        self._began = anyio.current_time()

        def request(attempt: int) -> Message:
            self.session.report(0, self.table.count)
            self._begins_at = anyio.current_time() if attempt else -math.inf
            if attempt < LIST_REQUESTS_ALONE or attempt % 2 == 0:
                if self.session.only_by_index:
                    self._reading.add(1)
                    self.channel.send(dialect.request_read(target, 1))
                    if self.table.is_growing:  # twice: the read ends the attempts, and shows no gap
                        self.channel.send(dialect.request_list(target))
                return dialect.request_list(target)
            which = int(attempt % 4 != 1)  # 1 is everywhere but where 0 is the only one
            self._reading.add(which)
            return dialect.request_read(target, which)

        first: Message = await channel.exchange(
            request,
            self._inbox,
            self._first,
            what=f"the list of {channel}",
            attempts=lambda: ATTEMPTS_MAX if channel.ftp.locked() else LIST_REQUESTS_MAX,  # behind its blocks
            timeout_min=LIST_TIMEOUT_MIN,
        )
        channel.is_streaming = True
        self._begins_at += anyio.current_time() - self._began
        if self._reading:
            self._began = anyio.current_time()  # of the list, if there is one
        self._listed_at = self._began
        self._take(first)
        self._tried, self._reading = dict.fromkeys(self._reading, 0), set()

    def _first(self, message: Message) -> Message | None:
        """Return the first value of the list; PX4's hash comes before it, and says nothing of its end."""
        assert isinstance(message, self.session.dialect.value)
        if message.param_index in self.table.names:
            return message
        self._take(message)
        return None

    async def run(self) -> None:
        """Receive the list and read its gaps."""
        if not self.reads_beside:
            await self._take_passes()
        await self._read_gaps()
        serves_reads, count = self.session.serves_reads.get(int, not self._is_served), self._count
        has_loss = not serves_reads and any(0 < index < self._reached for index in self._lost)
        # passes without a new value after which the count may be false: some may be lost
        left = 0 if serves_reads or count == 1 else FRUITLESS_PASSES_MAX if has_loss else 1
        while left and self._gaps() and not self.channel.is_silent(self._began):
            await self._next_pass()
            left -= self._gained_at < self._began
        is_silent = self.channel.is_silent(self._began)
        has_loss |= not (serves_reads or self._listed or count == 1)  # the last pass has brought nothing
        if not has_loss and not is_silent:
            self.table.end_list()
        self.result.missing = missing = self._missing()
        self.result.is_served = self._is_served
        if is_silent or not serves_reads:
            first = min(self._received, default=0)
            self.result.has_gap = any(has_loss or first < each < self._reached for each in missing)
        # what lies behind the highest index was only counted
        self.result.lost = len(self._lost & {*self._received, *missing} & {*range(self._reached + 1)})

    async def _take_passes(self) -> None:
        """Receive the list until it is over, and once more while that is quicker than to read its gaps."""
        while not self._is_over():
            await self._take_for(GAPS_INTERVAL)
        fruitless = 0
        while (missing := self._missing()) and self._is_served and not self.channel.is_silent(self._began):
            seconds_left = len(self.table.names) / self._rate() + PASS_OVERHEAD
            is_slower = len(missing) / READS_PER_SECOND_ARDUPILOT > seconds_left
            has_begun = len(self._received) > self.channel.window_size  # others may answer earlier reads
            is_few = len(missing) < self.channel.window_size
            if (has_begun and not is_slower) or is_few or fruitless >= FRUITLESS_PASSES_MAX:
                return
            self._lost.update(missing)
            await self._next_pass()
            fruitless = fruitless + 1 if self._gained_at < self._began else 0

    async def _next_pass(self) -> None:
        """Request the list once more, where that is quicker than reads, and receive it."""
        await self.channel.gate.wait()
        self.channel.send(self.session.dialect.request_list(self.channel.reads_from))
        before, self._reached = self._reached, -1
        self._skipped.clear()
        self._rate_before, self._listed = self._rate(), 0
        self._began = self._listed_at = anyio.current_time()
        while (self.table.is_growing or self._missing()) and not self._is_over():
            await self._take_for(GAPS_INTERVAL)
        self._reached = max(self._reached, before)

    async def _read_gaps(self) -> None:
        """Read what is missing, several copies of the last ones.

        Where no value arrives for seconds, and a window of reads is given up, the count is false: the
        component has none of the others.
        """
        async with task_group() as tasks:
            while not self._is_read() and not self.channel.is_silent(self._began):
                self.channel.is_streaming = not self._is_over() or self._may_begin_again()
                for index in self._gaps():
                    if len(self._reading) >= self.channel.window_size:
                        break
                    if index not in self._reading and not self._is_given_up(index):
                        self._reading.add(index)
                        self._tried.setdefault(index, 0)
                        if self._is_served:
                            self._lost.add(index)
                        tasks.start_soon(self._read, index)
                await self.channel.gate.wait()
                await self._take_for(GAPS_INTERVAL)
            tasks.cancel_scope.cancel()

    def _is_read(self) -> bool:
        """Return whether the list has ended, and nothing more of it can be read."""
        now = anyio.current_time()
        if not self._is_over() or (self.table.is_growing and now - self._listed_at < PAUSE_GROWING):
            return False
        if (missing := self._gaps()) and now - self._gained_at < QUEUE_TIME:
            return False
        attempts_max = self._attempts_max()  # once, where a false count makes thousands of gaps
        given_up = sum(self._tried.get(index, 0) >= attempts_max for index in missing)
        is_fruitless = self.table.is_growing or given_up >= self.channel.window_size
        patience = UNANSWERED_MAX if is_fruitless else 2 * UNANSWERED_MAX
        return given_up == len(missing) or now - self._gained_at >= patience

    def _is_given_up(self, index: int) -> bool:
        return self._tried.get(index, 0) >= self._attempts_max()

    def _attempts_max(self) -> int:
        return 1 if self.session.serves_reads.get(int) is False else self.channel.timing.attempts_max

    async def _read(self, index: int) -> None:
        """Read one index, or give it up."""
        channel, timing, dialect = self.channel, self.channel.timing, self.session.dialect

        def accept(message: Message) -> Message | None:
            is_other = isinstance(message, ParamError) and message.error != ParamErrorCode.DOES_NOT_EXIST
            return None if is_other else message

        def copies(attempt: int) -> int:
            return timing.copies if self._is_over() and len(self._missing()) <= channel.window_size else 1

        def most() -> int:
            is_certain = self._is_served or 0 < index < (self._count or 0)
            return min(self._attempts_max(), ATTEMPTS_MAX if is_certain else ATTEMPTS_DOUBTFUL)

        request, what = dialect.request_read(channel.reads_from, index), f"index {index} of {channel}"
        attempts, slow = ATTEMPTS_MAX, 0.0 if self._is_served else min(timing.slowest, QUEUE_TIME)
        with channel.inbox((dialect.value, index)) as inbox:
            try:
                await channel.exchange(
                    request, inbox, accept, what=what, attempts=most, copies=copies, timeout_min=slow
                )
                if not self._may_begin_again():  # else it may be of a list that runs again
                    self.session.serves_reads[int] = True
            except NoReply as error:
                attempts = error.attempts if most() == self._attempts_max() else ATTEMPTS_MAX
        await self._take_received()
        self._reading.discard(index)
        if index not in self._received:
            self._tried[index] = attempts

    def _missing(self) -> list[int]:
        """Return the indices that were not received, or whose values were forgotten with their encoding, or
        at a change of the count."""
        self._received &= self.table.names.keys()
        return self.table.missing(self._received)

    def _gaps(self) -> list[int]:
        """Return the indices to read: below the end of the list so far, or all that are missing.

        Those behind the last are read too where the count may be false, or where they may begin at 1.
        """
        if not self._is_over():
            return sorted(index for index in self._skipped if index <= self._reached - TAIL)
        gaps, count = set(self._missing()), self._count or 0
        if self.table.is_growing or not self._is_served:
            is_open = self.table.is_growing and not self._is_served
            gaps |= {0, *range(count, count + (READS_AHEAD if is_open else 1 + (0 not in self._received)))}
        elif 0 in gaps:
            gaps.add(count)
        return sorted(index for index in gaps - self._received if index < PARAMETERS_MAX)

    def _may_begin_again(self) -> bool:
        """Return whether the list may run once more, as it was requested again before it began."""
        seconds = len(self.table.names) / self._rate() if self._is_served else 0.0
        return anyio.current_time() < self._begins_at + seconds

    def _is_over(self) -> bool:
        """Return whether the list has ended: by its last index, or by a pause."""
        count = None if self.table.is_growing else self._count
        interval, pause = 1 / self._rate() if self._listed else 0.0, PAUSE_OTHERS
        if count is not None and self._reached >= count - 1:
            pause = 0.0 if self.result.digest else max(PAUSE_END, INTERVALS_END * interval)
        else:
            if count is not None and self._reached >= count - TAIL:
                pause = PAUSE_TAIL
            elif self.reads_beside:
                pause = PAUSE_PX4
            pause = max(pause, PAUSE_INTERVALS * interval or self.channel.timing.timeout(0))
        return anyio.current_time() - self._listed_at >= pause or self.channel.is_silent(self._began)

    @property
    def _is_served(self) -> bool:
        """Whether values of a list arrived, beside those that were read."""
        return bool(self._listed or self._rate_before)

    def _rate(self) -> float:
        """Return the values per second of this list so far, or of an earlier pass."""
        return max(self._rate_before, self._listed / max(self._listed_at - self._began, 0.01))

    async def _take_for(self, seconds: float) -> None:
        """Take the values that arrive, at most for some seconds without one."""
        self.channel.gate.check()
        with anyio.move_on_after(seconds) as scope:
            self._take(await self._inbox.next())
        if anyio.current_time() > scope.deadline + LATE_WAKE_UP:
            await anyio.sleep(LATE_GRACE)
        await self._take_received()
        self.session.report(len(self._received), self._count)

    async def _take_received(self) -> None:
        while self._inbox:
            self._take(await self._inbox.next())

    def _take(self, message: Message) -> None:
        """Take one value."""
        assert isinstance(message, self.session.dialect.value)
        index, now = message.param_index, anyio.current_time()
        if message.param_id == HASH_CHECK:
            self.result.digest = Digest.of(message)
        if index not in self.table.names:
            return
        if self._count != self.table.count:
            self._count = self.table.count
            if not self.table.is_growing:
                self._received &= self.table.names.keys()
                self._skipped.clear()
                self._tried.clear()
                self._reached = -1
        self._times[index] += 1
        is_other = index in self._tried or self._times[index] > TIMES_MAX
        if index not in self._reading and (index > self._reached or not is_other):
            self._listed_at = now
            self._listed += 1
        if index in self._received:
            self.result.repeated += 1
        elif self._times[index] <= TIMES_MAX:  # the count may change again and again
            self._gained_at = now
        self._received.add(index)
        self._skipped.discard(index)
        if index > self._reached:
            self._skipped |= set(range(self._reached + 1, index)) - self._received
            self._reached = index
