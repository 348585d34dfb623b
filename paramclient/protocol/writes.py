"""Set parameters: PARAM_SET and PARAM_EXT_SET, with proof of each value, one queue per name."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import anyio

from paramclient.errors import (
    AnotherVehicle,
    ExtAckResult,
    LinkError,
    NoReply,
    ParamClientError,
    ParamErrorCode,
    SetFailed,
    TypeMismatch,
    UnknownParameter,
    UsageError,
    ValueNotApplied,
    ValueUnsupported,
)
from paramclient.model.identity import autopilot_name, reason_against_non_finite
from paramclient.model.names import is_group_switch
from paramclient.model.values import Param, ParamType, Trust, Value, format_value
from paramclient.protocol.channel import Inbox, task_group
from paramclient.protocol.list_download import download_list
from paramclient.protocol.reads import queue_time, read, read_param, refusal
from paramclient.protocol.session import Session
from paramclient.protocol.set_results import SetManyResult, SetOutcome, SetResult, SetStatus
from paramclient.wire.messages import Message, ParamError, ParamExtAck, StatusText

SILENT_SETS_MAX: Final = 3
"""Sets without an acknowledgement, after which a read shows the value: some firmware acknowledges none."""
ACKS_MAX: Final = 4
"""Acknowledgements of one set: some firmware sends the old value first, and PX4 the new one twice; a link may
double each."""
SETS_MIN: Final = 5
SETS_MAX: Final = 9
"""Sets after which the value counts as kept, by the link's loss; up to three more await the next read."""
SETS_TIME: Final = 5.0
"""Seconds after which two sets are sent at once; after twice as many, the fewest suffice."""
SETS_LOST: Final = 1e-4
"""Probability that all sets are lost, at which a vehicle that keeps the old value has not applied them."""
QUEUE_WAITS: Final = 3
"""Waits for the wanted value, each as long as an answer ever took, while older ones still arrive."""
EVIDENCE_MAX: Final = 32
"""Indices that are read for evidence of the encoding: few components begin with more zeros and floats."""
EVIDENCE_READS: Final = 8
"""Those that are read at once: mostly, they suffice."""
EXT_PROGRESS_TIMEOUT: Final = 60.0
"""Seconds for a component that reports progress to finish: a camera formats a card meanwhile."""
EXT_PROGRESS_READ: Final = 2.0
"""Seconds after which a read shows the value meanwhile: the final acknowledgement may be lost."""
EXT_TAKEN: Final = (ExtAckResult.ACCEPTED, ExtAckResult.IN_PROGRESS)
BATCH_SIZE: Final = 20
"""Sets in flight: bursts of 20 to a PX4 and 30 to an ArduPilot were all acknowledged (measured)."""
UNWATCHED: Final = "It was not seen whether the vehicle changes the value later: it answers no more."
DENIED: Final = "Param write denied ("
"""The beginning of ArduPilot's STATUSTEXT for a read-only parameter."""


async def write(
    session: Session,
    name: str,
    value: Value,
    *,
    settle: float = 0.0,
    force: bool = False,
    author: str = "us",
    turn: AbstractAsyncContextManager[object] | None = None,
    report: Callable[[SetResult | None], None] = lambda result: None,
    vehicles: int | None = None,
) -> SetResult:
    """Set one parameter, and prove its value by what the component reports.

    No set is sent before the encoding is certain and the type is known: an integer in the wrong encoding
    would be taken as another number. Only the wanted value proves success. Another value may be the answer to
    an old read, a part of a list, or an adjustment by the vehicle: it is read once more, and counts when a
    second set leads to it again. A set that is not acknowledged is proven by a read too. A set whose caller
    is cancelled may still take effect.

    Args:
        session: the component's.
        name: param_id.
        value: to write.
        settle: seconds after which the value is read once more; a different one is an adjustment.
        force: also send NaN and infinity to a vehicle that cannot store them.
        author: of the change, for the history.
        turn: entered while requests are sent, but not while the value is watched.
        report: called with None before each set is sent, and with the result before the value is watched.
        vehicles: `Identification.vehicles` of the vehicle to which it is sent; None for the present one.

    Raises:
        UsageError: the value does not fit the type, or must not be sent.
        UnknownParameter: the component has no such parameter.
        Refused: it gave another reason.
        TypeMismatch: the type changed during the write.
        ValueNotApplied: it kept another value, and gave no reason.
        AnotherVehicle: another vehicle has answered meanwhile; nothing was written to it.
        NoReply: it did not answer. The value may have been set.
        LinkError: the link is closed for good.
    """
    vehicles = session.identification.vehicles if vehicles is None else vehicles
    _check_finite(session, name, value, force=force)
    began = anyio.current_time()
    if session.spelled(name) != name:
        name = (await read(session, name)).param_id
    before_turn = anyio.current_time() - began
    async with session.lock(name):
        session.writing[name] = author
        try:
            async with turn or nullcontext():
                began, before = anyio.current_time() - before_turn, await _read_writable(session, name)
                try:
                    result = await _Write(session, vehicles, before, value, report, began).run()
                except (NoReply, LinkError, UnknownParameter, anyio.get_cancelled_exc_class()):
                    session.foreign_set(name, author, anyio.current_time())  # it may be acknowledged yet
                    session.table.doubt(name)
                    raise
            if settle > 0:
                report(result)
                result = await _settled(session, vehicles, result, settle)
            return result
        finally:
            session.sent.pop(name, None)
            del session.writing[name]
            session.written_at = anyio.current_time()


async def write_many(
    session: Session,
    pairs: Sequence[tuple[str, Value]],
    *,
    progress: Callable[[SetOutcome], None] | None = None,
    timeout: float | None = None,
    settle: float = 0.0,
    force: bool = False,
    author: str = "us",
) -> SetManyResult:
    """Set several parameters, as many at once as the component serves.

    Values of one parameter are set in order. A parameter that shows or hides others (`*_ENABLE`) is set
    alone, after those before it. When the link fails, the component does not answer any more, another vehicle
    takes its place, or the timeout expires, the other parameters are not tried, and the result has the error.

    Args:
        session, settle, force, author: as for `write`.
        pairs: names and values, in order.
        progress: called with each outcome, as it is known.
        timeout: seconds; None for no limit.
    """
    began = anyio.current_time()
    vehicles = session.identification.vehicles
    done = progress or (lambda outcome: None)
    outcomes = [SetOutcome(name, value, SetStatus.NOT_TRIED) for name, value in pairs]
    limiter = anyio.CapacityLimiter(BATCH_SIZE)
    failures: list[ParamClientError] = []

    @asynccontextmanager
    async def turn() -> AsyncIterator[None]:
        async with limiter:
            if failures:
                raise failures[0]
            yield

    async def write_one(place: int) -> None:
        name, value = pairs[place]

        def report(result: SetResult | None) -> None:
            status = SetStatus.UNKNOWN if result is None else SetStatus(result.status)
            outcomes[place] = SetOutcome(name, value, status, result)

        try:
            result = await write(
                session,
                name,
                value,
                settle=settle,
                force=force,
                author=author,
                turn=turn(),
                report=report,
                vehicles=vehicles,
            )
        except (NoReply, LinkError, AnotherVehicle) as error:
            failures.append(error)
            outcomes[place] = replace(outcomes[place], error=error)
        except ParamClientError as error:
            outcomes[place] = replace(outcomes[place], status=SetStatus.REFUSED, error=error)
        else:
            report(result)
        done(outcomes[place])

    async def write_in_order(places: Sequence[int]) -> None:
        for place in places:
            await write_one(place)

    autopilot = autopilot_name(session.identification.autopilot or 0)
    places = list(range(len(pairs)))
    with anyio.move_on_after(timeout) as scope:
        while places and not failures:
            switches = (at for at, place in enumerate(places) if is_group_switch(pairs[place][0], autopilot))
            together = max(next(switches, len(places)), 1)
            by_name: defaultdict[str, list[int]] = defaultdict(list)
            for place in places[:together]:
                by_name[session.spelled(pairs[place][0])].append(place)
            async with task_group() as tasks:  # its errors are those of `done`
                for same_name in by_name.values():
                    tasks.start_soon(write_in_order, same_name)
            del places[:together]
        for place in places:  # behind a failure
            outcomes[place] = replace(outcomes[place], error=failures[0])
            done(outcomes[place])
    elapsed = anyio.current_time() - began
    if scope.cancelled_caught:
        failures.insert(0, NoReply(f"{len(pairs)} writes to {session.channel}", attempts=0, waited=elapsed))
        for place, each in enumerate(outcomes):
            if each.error is None and each.status in (SetStatus.NOT_TRIED, SetStatus.UNKNOWN):
                outcomes[place] = replace(each, error=failures[0])
    return SetManyResult(*session.channel.target, tuple(outcomes), failures[0] if failures else None, elapsed)


@dataclass(eq=False)
class _Write:
    """One set, while it runs.

    Attributes:
        before: the parameter before the first set.
        wanted: the value that proves success.
        began: when the write began, before the parameter was read, and without the time for its turn.
        attempts: sets that were sent.
        copies, sent_at: of the last of them, how many were sent at once, and when.
    """

    session: Session
    vehicles: int
    before: Param
    value: Value
    report: Callable[[SetResult | None], None]
    began: float
    attempts: int = 0

    def __post_init__(self) -> None:
        self.channel = self.session.channel
        self.name = self.before.name
        self._encode()
        self._confirm = partial(self.session.confirm, self.vehicles)
        self._has_new_type = False

    async def run(self) -> SetResult:
        """Send the set until its outcome is proven: by the wanted value, or by the same other one twice."""
        replaced = self.session.replaced.get(self.name)
        if replaced and any(map(self._is_wanted, replaced.params)):  # a late answer would prove it
            await anyio.sleep_until(replaced.until + 0.001)
        dialect = self.session.dialect
        keys = [(ParamExtAck, self.name)] if dialect.has_ack else [(dialect.value, self.name), StatusText]
        adjusted: Param | None = None
        with self.channel.inbox(*keys) as inbox:
            while True:
                answer = await self._set(inbox)
                await self._confirm()
                if answer.type != self.before.type:
                    self._retype(answer)
                elif self._is_wanted(answer) or self._is_converted(answer):
                    return self._result(answer)
                elif answer.same_value(self.before):
                    sets_max = min(max(self.channel.timing.attempts_for(SETS_LOST), SETS_MIN), SETS_MAX)
                    is_late = anyio.current_time() - self.began > 2 * SETS_TIME
                    if self.attempts >= (SETS_MIN if is_late else sets_max):
                        if wanted := await self._wanted_behind(inbox, self.sent_at):
                            return self._result(wanted)
                        raise self._not_applied(answer)
                elif adjusted is not None and (adjusted.same_value(answer) or self.attempts >= SETS_MAX):
                    return self._result(await self._wanted_behind(inbox, self.began) or answer)
                else:
                    adjusted = answer

    async def _set(self, inbox: Inbox) -> Param:
        """Send the set until it is acknowledged; return the wanted value, or what a read shows.

        Silence may be that of a firmware that acknowledges nothing, and another value may be an older one.
        """
        channel = self.channel
        what = f"the acknowledgement of {self.name} by {channel}"
        answer: Param | ParamExtAck | None = None
        self._has_other_value = False
        with suppress(NoReply):
            answer = await channel.exchange(
                self._request,
                inbox,
                self._accept,
                what=what,
                attempts=lambda: 0 if self._has_other_value else SILENT_SETS_MAX // self.copies,
                copies=lambda attempt: self.copies,
                ready=self._confirm,
            )
        until = anyio.current_time() + EXT_PROGRESS_TIMEOUT
        while isinstance(answer, ParamExtAck) and answer.param_result == ExtAckResult.IN_PROGRESS:
            now = anyio.current_time()
            if now >= until or channel.is_silent(self.began):
                break
            answer = await channel.wait_for(inbox, self._accept, now, 0, EXT_PROGRESS_READ) or answer
            if channel.is_silent(self.began):
                break
            await self._confirm()
            with suppress(NoReply):  # the final acknowledgement may be lost
                if self._is_wanted(shown := await self._read(inbox)):
                    return shown
        refused = None
        if isinstance(answer, ParamExtAck) and answer.param_result not in EXT_TAKEN:
            kind = ValueUnsupported if answer.param_result == ExtAckResult.VALUE_UNSUPPORTED else SetFailed
            why = f"{channel} refused {self.name}: {ExtAckResult.name_of(answer.param_result)}"
            refused = kind(why, *channel.target, code=answer.param_result, name=self.name)
        elif isinstance(answer, Param) and answer.type == self.before.type:
            if self.session.acknowledging[self.name] % ACKS_MAX == 0:  # none came in another type
                del self.session.acknowledging[self.name]
            return answer
        if not channel.is_silent(self.began):
            with suppress(NoReply):  # only a read shows a changed type, or an extended parameter's value
                shown = await self._read(inbox)
                if refused is None or self._is_wanted(shown):  # it was the refusal of another set
                    return shown
        raise refused or NoReply(what, attempts=self.attempts, waited=anyio.current_time() - self.began)

    async def _wanted_behind(self, inbox: Inbox, since: float) -> Param | None:
        """Return the wanted value if it comes behind answers to earlier reads, queued by a slow link."""
        for _ in range(QUEUE_WAITS):
            self._has_other_value = False
            answer = await self.channel.wait_for(inbox, self._accept, since, 0, self.channel.timing.slowest)
            if isinstance(answer, Param) and self._is_wanted(answer):
                return answer
            if not self._has_other_value:
                break
            since = anyio.current_time()
        return None

    def _request(self, attempt: int) -> Message:
        """Return the set, and count its copies as sent."""
        self.sent_at = anyio.current_time()
        is_late = self.sent_at - self.began > SETS_TIME and not self.session.dialect.has_ack
        self.copies = 2 if is_late and self.attempts else 1
        self.attempts += self.copies
        self.report(None)
        self.session.acknowledging[self.name] += self.copies * ACKS_MAX
        self.session.sent[self.name] = self._raw
        return self.session.dialect.set_request(*self.channel.target, self.name, self._raw, self.before.type)

    def _accept(self, message: Message) -> Param | ParamExtAck | None:
        """Return an acknowledgement: PARAM_EXT_ACK, the wanted value, or any in another type."""
        session, encoding = self.session, self.session.table.encoding
        if isinstance(message, ParamExtAck):
            return message
        if isinstance(message, ParamError):
            raise refusal(session, self.name, message.error)
        if isinstance(message, StatusText):
            if message.text.startswith(f"{DENIED}{self.name})"):
                raise refusal(session, self.name, ParamErrorCode.READ_ONLY)
            return None
        assert isinstance(message, session.dialect.value)
        _, raw, number, _, _ = session.typed(message)
        param = session.dialect.param(self.name, raw, number, None, encoding)
        if self._is_wanted(param) or number != self.before.type:
            return param
        self._has_other_value = True
        return None

    async def _read(self, inbox: Inbox) -> Param:
        """Return the parameter as the component reports it now."""
        param = await read_param(self.session, self.name)
        while inbox and not self.session.dialect.has_ack:
            self._accept(await inbox.next())  # a refusal that came behind the value
        return param

    def _encode(self) -> None:
        """Set the bytes to send, and the value that proves success."""
        session, number = self.session, self.before.type
        encoding = session.table.encoding
        self._raw = session.dialect.encode(self.value, number, encoding)
        self.wanted = session.dialect.param(self.name, self._raw, number, None, encoding)

    def _is_wanted(self, param: Param) -> bool:
        return self.wanted.same_value(param)

    def _is_converted(self, param: Param) -> bool:
        """Return whether the value is the wanted one as an ArduPilot converts it: 3000 of 3000.5."""
        is_finite = isinstance(self.value, float) and math.isfinite(self.value)
        return param.type.is_integer and is_finite and param.value == int(self.value)

    def _result(self, param: Param) -> SetResult:
        actual = self.session.table.params.get(self.name, param)
        if not actual.same_value(param):
            actual = replace(param, index=actual.index, default=actual.default)
        exact = self._is_wanted(param)
        if exact and actual.type not in (ParamType.REAL32, ParamType.REAL64):
            exact = isinstance(self.value, bytes) or actual.settable == self.value
        return SetResult(self.name, "accepted" if exact else "adjusted", self.value, actual, self.attempts)

    def _retype(self, answer: Param) -> None:
        """Take another type than the known one: encode again, or raise TypeMismatch; also the second time."""
        self.before = replace(answer, trust=Trust.LIVE)
        try:
            if self._has_new_type:
                raise UsageError("it acknowledges a set with another type than it was sent")
            self._has_new_type = True
            self._encode()
        except UsageError as error:
            what = f"{self.name} of {self.channel} is {answer.type.name} now: {error}"
            raise TypeMismatch(what, *self.channel.target, name=self.name) from None

    def _not_applied(self, actual: Param) -> ValueNotApplied:
        target, kept = self.channel.target, actual.settable
        words, sent = (format_value(each, actual.type) for each in (kept, self.value))
        what = f"{self.channel} keeps {self.name} at {words}; {sent} was sent {self.attempts} times"
        return ValueNotApplied(what, *target, name=self.name, requested=self.value, actual=kept)


async def _settled(session: Session, vehicles: int, result: SetResult, seconds: float) -> SetResult:
    """Read a value once more after some seconds. A vehicle that is lost meanwhile has acknowledged it."""
    channel = session.channel
    with channel.gate.until_closed(), channel.waiting_until(anyio.current_time() + seconds):
        await anyio.sleep_forever()
    with suppress(NoReply):
        if not channel.is_lost:
            now = await read_param(session, result.name)
            await session.confirm(vehicles)
            return result if now.same_value(result.param) else replace(result, status="adjusted", param=now)
    return replace(result, note=UNWATCHED)


async def _read_writable(session: Session, name: str) -> Param:
    """Return a parameter, as soon as its type and the encoding are certain.

    Raises:
        UsageError: the parameter is an integer, and the values contradict the encoding.
        NoReply: the component was lost meanwhile.
    """
    param, began, table = await _known(session, name), anyio.current_time(), session.table
    if session.dialect.has_ack:  # its values need no encoding
        return param
    is_shown = param.type is ParamType.REAL32 or table.encoding in table.evidence
    if session.identification.autopilot is None or not is_shown:
        with session.channel.gate.until_closed(or_failed=True):
            await session.identification.encoding_certain()
    if session.channel.is_lost:
        raise NoReply(f"the encoding of {session.channel}", attempts=0, waited=anyio.current_time() - began)
    param = await _known(session, name)
    if param.type.is_integer and session.identification.chosen is None:
        # 0 is the same in both, and files have no encoding; a whole list has shown all that there is.
        is_seen = not session.serves_file and all(each.trust is Trust.LIVE for each in table.params.values())
        if not (table.evidence or (table.is_complete and is_seen)):
            await session.seeking.join(lambda: _seek_evidence(session))
        if doubt := session.encoding_doubt:
            raise UsageError(f"{name} was not written. {doubt}")
    return param


async def _known(session: Session, name: str) -> Param:
    """Return a parameter that was received or verified on this link; read it if it was not."""
    known = session.table.params.get(name)
    return await read_param(session, name) if known is None or known.trust is Trust.CACHED else known


async def _seek_evidence(session: Session) -> None:
    """Read integers other than 0 that a file has shown, and the first values of the list, until one shows the
    encoding or all had time to be answered.

    Where none of these does, or no reads by index are answered, the whole list may show it.
    """
    channel, table, began = session.channel, session.table, anyio.current_time()
    known = [each for each in table.params.values() if each.type.is_integer and each.value]
    if session.serves_reads.get(int) is not False:
        ways = [way for each in known for way in (each.name, each.index) if way is not None]
        ways = (ways * EVIDENCE_READS)[:EVIDENCE_READS]  # each several times, where they are few
        ways += range(min(EVIDENCE_MAX, table.count or EVIDENCE_MAX))
        with channel.inbox(session.dialect.value) as inbox:
            for first in range(0, len(ways), EVIDENCE_READS):
                sent, seconds = anyio.current_time(), queue_time(session, EVIDENCE_READS)
                for which in ways[first : first + EVIDENCE_READS]:
                    channel.send(session.dialect.request_read(channel.reads_from, which))
                if await channel.wait_for(inbox, lambda message: table.evidence or None, sent, 0, seconds):
                    return
        is_seen = table.is_complete and min(table.moments.values(), default=began) >= began
        if is_seen or (session.serves_file and not known):
            return
    with suppress(NoReply), anyio.move_on_after(2 * SETS_TIME):  # it has no list either
        await session.listing.join(lambda: download_list(session))


def _check_finite(session: Session, name: str, value: Value, *, force: bool) -> None:
    if force or not isinstance(value, float) or math.isfinite(value):
        return
    if why := reason_against_non_finite(autopilot_name(session.identification.autopilot or 0)):
        not_sent = f"{name} = {value} was not sent to {session.channel}"
        raise UsageError(f"{not_sent}: {why}. With force (--force) it is sent all the same.")
