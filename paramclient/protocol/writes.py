"""Set parameters: PARAM_SET and PARAM_EXT_SET, with proof of each value, one queue per name."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext, suppress
from dataclasses import replace
from typing import Final

import anyio

from paramclient.errors import (
    ExtAckResult,
    LinkError,
    NoReply,
    ParamClientError,
    ParamErrorCode,
    SetFailed,
    TypeMismatch,
    UsageError,
    ValueNotApplied,
    ValueUnsupported,
)
from paramclient.model.identity import autopilot_name, reason_against_non_finite
from paramclient.model.names import is_group_switch
from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    Trust,
    WireValue,
    format_value,
    type_name,
)
from paramclient.protocol.channel import Inbox
from paramclient.protocol.reads import read, refusal
from paramclient.protocol.session import ReplacedValue, Session
from paramclient.protocol.set_results import SetManyResult, SetOutcome, SetResult, SetStatus
from paramclient.wire.messages import Message, ParamError, ParamExtAck, StatusText

__all__ = ["write", "write_many"]

UNCHANGED_MAX: Final = 5
"""Sets that leave the old value, after which the vehicle has not applied it: a PARAM_SET can be lost."""
SILENT_SETS_MAX: Final = 3
"""Sets without an acknowledgement, after which a read shows the value: some firmware acknowledges none."""
SETS_MAX: Final = 12
SETS_LOST: Final = 1e-4
"""Probability that sets without an acknowledgement, which leave the old value, are lost."""
EVIDENCE_READS: Final = 8
"""Indices that are read for evidence of the encoding: few components begin with more zeros and floats."""
EXT_PROGRESS_TIMEOUT: Final = 60.0
"""Seconds for a component that reports progress to finish: a camera formats a card meanwhile."""
BATCH_SIZE: Final = 20
"""Sets in flight: bursts of 20 to a PX4 and 30 to an ArduPilot were all acknowledged (measured)."""
LATE_ANSWER_TIME: Final = 0.3
"""Seconds after a write in which an ArduPilot may answer an earlier read: it takes the value when it queues
the answer, and sends it up to 100 ms later."""
DENIED: Final = "Param write denied ("
"""The beginning of ArduPilot's STATUSTEXT for a read-only parameter."""


async def write(
    session: Session,
    name: str,
    value: WireValue,
    *,
    settle: float = 0.0,
    force: bool = False,
    author: str = "us",
    turn: AbstractAsyncContextManager[object] | None = None,
    sending: Callable[[], None] = lambda: None,
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
        sending: called before the first set is sent.

    Raises:
        UsageError: the value does not fit the type, or must not be sent.
        UnknownParameter: the component has no such parameter.
        Refused: it gave another reason.
        TypeMismatch: the type changed during the write.
        ValueNotApplied: it kept another value, and gave no reason.
        NoReply: it did not answer. The value may have been set.
        LinkError: the link is closed for good.
    """
    gate = session.channel.gate
    _check_finite(session, name, value, force=force)
    if session.spelled(name) != name:
        name = (await read(session, name)).param_id
    async with session.lock(name):
        session.writing[name] = author
        try:
            async with turn or nullcontext():
                await _learn_type(session, name)
                await _check_encoding(session, name)
                before = session.table.params[name]
                await gate.wait()
                sending()
                try:
                    result = await _Write(session, name, value).run()
                except (NoReply, LinkError, anyio.get_cancelled_exc_class()):
                    session.foreign_set(name, author, anyio.current_time())  # it may be acknowledged yet
                    raise
            if session.identification.is_ardupilot and not result.param.same_value(before):
                late = ReplacedValue(before, anyio.current_time() + LATE_ANSWER_TIME)
                session.replaced[name].append(late)
                session.spawn(_ignore_late_answers, session, late)
            if settle > 0:
                with gate.until_closed():
                    await anyio.sleep(settle)
                await read(session, name)
                now = session.table.params[name]
                if not now.same_value(result.param):
                    result = replace(result, status="adjusted", param=now)
            return result
        finally:
            session.acknowledging.discard(name)
            del session.writing[name]
            session.written_at = anyio.current_time()


async def write_many(
    session: Session,
    pairs: Sequence[tuple[str, WireValue]],
    *,
    progress: Callable[[SetOutcome], None] | None = None,
    timeout: float | None = None,
    settle: float = 0.0,
    force: bool = False,
    author: str = "us",
) -> SetManyResult:
    """Set several parameters, as many at once as the component serves.

    A parameter that shows or hides others (`*_ENABLE`) is set alone, after those before it. When the link
    fails, the component does not answer any more, or the timeout expires, the other parameters are not tried,
    and the result has the error.

    Args:
        session, settle, force, author: as for `write`.
        pairs: names and values, in order.
        progress: called with each outcome, as it is known.
        timeout: seconds; None for no limit.
    """
    began, system, component = anyio.current_time(), *session.channel.target
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

        def sending() -> None:
            outcomes[place] = replace(outcomes[place], status=SetStatus.UNKNOWN)

        try:
            result = await write(
                session,
                name,
                value,
                settle=settle,
                force=force,
                author=author,
                turn=turn(),
                sending=sending,
            )
        except (NoReply, LinkError) as error:
            failures.append(error)
            outcomes[place] = replace(outcomes[place], error=error)
        except ParamClientError as error:
            outcomes[place] = replace(outcomes[place], status=SetStatus.REFUSED, error=error)
        else:
            outcomes[place] = SetOutcome(name, value, SetStatus(result.status), result)
        done(outcomes[place])

    autopilot = autopilot_name(session.identification.autopilot or 0)
    places = list(range(len(pairs)))
    with anyio.move_on_after(timeout) as scope:
        while places and not failures:
            switches = (at for at, place in enumerate(places) if is_group_switch(pairs[place][0], autopilot))
            together = max(next(switches, len(places)), 1)
            try:
                async with anyio.create_task_group() as tasks:
                    for place in places[:together]:
                        tasks.start_soon(write_one, place)
            except ExceptionGroup as group:  # of `done`
                raise group.exceptions[0] from None
            del places[:together]
        for place in places:  # behind a failure
            outcomes[place] = replace(outcomes[place], error=failures[0])
            done(outcomes[place])
    elapsed = anyio.current_time() - began
    if scope.cancelled_caught:
        error = NoReply(f"{len(pairs)} writes to {system}/{component}", attempts=0, waited=elapsed)
        failures.insert(0, error)
        open_states = (SetStatus.NOT_TRIED, SetStatus.UNKNOWN)
        outcomes = [
            replace(each, error=error) if each.status in open_states and each.error is None else each
            for each in outcomes
        ]
    return SetManyResult(system, component, tuple(outcomes), failures[0] if failures else None, elapsed)


class _Write:
    """One set, while it runs.

    Attributes:
        before: the parameter before the first set.
        wanted: the value that proves success.
    """

    def __init__(self, session: Session, name: str, value: WireValue) -> None:
        self.session = session
        self.channel = session.channel
        self.name = name
        self.value = value
        self.before = session.table.params[name]
        self.wanted = self.before
        self.attempts = 0
        self._raw = b""
        self._has_new_type = False

    async def run(self) -> SetResult:
        """Send the set until its outcome is proven."""
        channel = self.channel
        key = self.session.dialect.value
        keys = [(key, self.name), StatusText]
        if self.session.dialect.has_ack:
            keys = [(ParamExtAck, self.name)]
        began = anyio.current_time()
        adjusted: Param | None = None
        unanswered = unchanged = 0
        with channel.inbox(*keys) as inbox:
            self._encode()
            for each in list(self.session.replaced.get(self.name, ())):
                if self._is_wanted(each.param):  # its acknowledgement would be ignored
                    await anyio.sleep_until(each.until + 0.001)
            while True:
                await channel.gate.wait()
                sent = anyio.current_time()
                number = self.before.type_number
                self.session.acknowledging.add(self.name)
                channel.send(self.session.dialect.request_set(channel.target, self.name, self._raw, number))
                self.attempts += 1
                answer = await self._answer(inbox, sent)
                is_silent = answer is None
                if answer is None:
                    unanswered += 1
                    if unanswered < SILENT_SETS_MAX:
                        continue
                    try:
                        answer = await self._read()
                    except NoReply:
                        what = f"the acknowledgement of {self.name} by {channel.system}/{channel.component}"
                        waited = anyio.current_time() - began
                        raise NoReply(what, attempts=self.attempts, waited=waited) from None
                if answer.type_number != number:
                    self._retype(answer)
                    continue
                if self._is_wanted(answer) or self._is_converted(answer):
                    return self._result(answer)
                if adjusted is not None and (adjusted.same_value(answer) or self.attempts >= SETS_MAX):
                    return self._result(answer)
                if not answer.same_value(self.before):
                    adjusted = answer
                    continue
                unchanged += not is_silent
                sets_max = min(max(channel.timing.attempts_for(SETS_LOST), UNCHANGED_MAX), SETS_MAX)
                if unchanged >= UNCHANGED_MAX or self.attempts >= sets_max:
                    raise self._not_applied(answer)

    def _encode(self) -> None:
        """Set the bytes to send, and the value that proves success."""
        session, number = self.session, self.before.type_number
        encoding = session.table.encoding
        self._raw = session.dialect.encode(self.value, number, encoding)
        self.wanted = session.dialect.param(self.name, self._raw, number, None, encoding)

    async def _answer(self, inbox: Inbox, sent: float) -> Param | None:
        """Wait for the parameter after a set: the wanted value, or what a read shows; None in silence."""
        if self.session.dialect.has_ack:
            return await self._ext_answer(inbox, sent)
        other: list[Param] = []

        def accept(message: Message) -> Param | None:
            param = self._take(message)
            if param is None or self._is_wanted(param) or param.type_number != self.before.type_number:
                return param
            other.append(param)
            return None

        answer = await self.channel.wait_for(inbox, accept, sent, min(self.attempts - 1, 3))
        if answer is not None:
            if self.attempts == 1 and not self.channel.is_streaming:
                self.channel.timing.measure(anyio.current_time() - sent)
            is_typed = answer.type_number == self.before.type_number
            return answer if is_typed else await self._read()  # only a read shows that the type has changed
        if not other:
            return None
        param = await self._read()
        while inbox:
            self._take(await inbox.next())  # a refusal that came behind the value
        return param

    async def _ext_answer(self, inbox: Inbox, sent: float) -> Param | None:
        """Wait for PARAM_EXT_ACK, as long as the component reports progress; then read the value."""
        attempt = min(self.attempts - 1, 3)
        while True:
            ack = await self.channel.wait_for(inbox, _ext_ack, sent, attempt)
            if ack is None or ack.param_result != ExtAckResult.IN_PROGRESS:
                break
            sent, attempt = anyio.current_time() + EXT_PROGRESS_TIMEOUT, 0
        if ack is None:
            return None
        if ack.param_result == ExtAckResult.ACCEPTED:
            return await self._read()
        system, component = self.channel.target
        kind = ValueUnsupported if ack.param_result == ExtAckResult.VALUE_UNSUPPORTED else SetFailed
        reason = ExtAckResult.name_of(ack.param_result)
        raise kind(
            f"{system}/{component} refused {self.name}: {reason}",
            system=system,
            component=component,
            code=ack.param_result,
            name=self.name,
        )

    async def _read(self) -> Param:
        """Return the parameter as the component reports it now."""
        self.session.acknowledging.discard(self.name)
        await read(self.session, self.name)
        return self.session.table.params[self.name]

    def _take(self, message: Message) -> Param | None:
        """Return the parameter in a value, and raise the error in a refusal."""
        if isinstance(message, ParamError):
            raise refusal(self.session, self.name, message.error)
        if isinstance(message, StatusText):
            if message.text.startswith(f"{DENIED}{self.name})"):
                raise refusal(self.session, self.name, ParamErrorCode.READ_ONLY)
            return None
        assert isinstance(message, self.session.dialect.value)
        encoding = self.session.table.encoding
        number = message.param_type
        if number == ParamType.REAL32 and self.before.type_number != number:
            number = self._known_type(message.raw)
        elif (number, message.raw) == (self.before.type_number, self._raw):
            # this value, and not the rounded form of the one before
            self.session.table.store(message, anyio.current_time(), is_exact=True)
        return self.session.dialect.param(self.name, message.raw, number, None, encoding)

    def _known_type(self, raw: bytes) -> int:
        """Return the known integer type for a value in REAL32, if it holds the value.

        ArduPilot answers a PARAM_SET with REAL32, whatever the parameter's type is, if the value is the
        default and was never stored (measured on 4.6-dev).
        """
        known = self.before.type
        encoding = self.session.table.encoding
        if encoding is Encoding.C_CAST and isinstance(known, ParamType) and known.is_integer:
            param = self.session.dialect.param(self.name, raw, known, None, encoding)
            if not param.is_raw:
                return known
        return ParamType.REAL32

    def _is_wanted(self, param: Param) -> bool:
        return self.wanted.same_value(param)

    def _is_converted(self, param: Param) -> bool:
        """Return whether the value is the wanted one as an ArduPilot converts it: 3000 of 3000.5."""
        return (
            isinstance(self.value, float)
            and isinstance(param.type, ParamType)
            and param.type.is_integer
            and math.isfinite(self.value)
            and param.value == int(self.value)
        )

    def _result(self, param: Param) -> SetResult:
        actual = self.session.table.params.get(self.name, param)
        if not actual.same_value(param):
            actual = replace(param, index=actual.index, default=actual.default)
        exact = self._is_wanted(param)
        if exact and actual.type_number != ParamType.REAL32 and not isinstance(self.value, bytes):
            exact = actual.settable == self.value
        return SetResult(self.name, "accepted" if exact else "adjusted", self.value, actual, self.attempts)

    def _retype(self, answer: Param) -> None:
        """Take another type than the known one: encode again, or raise TypeMismatch; also the second time."""
        system, component = self.channel.target
        self.before = replace(answer, trust=Trust.LIVE)
        try:
            if self._has_new_type:
                raise UsageError("it acknowledges a set with another type than it was sent")
            self._has_new_type = True
            self._encode()
        except UsageError as error:
            raise TypeMismatch(
                f"{self.name} of {system}/{component} is {type_name(answer.type_number)} now: {error}",
                system=system,
                component=component,
                name=self.name,
            ) from None

    def _not_applied(self, actual: Param) -> ValueNotApplied:
        system, component = self.channel.target
        number = actual.type_number
        return ValueNotApplied(
            f"{system}/{component} keeps {self.name} at {format_value(actual.settable, number)}; "
            f"{format_value(self.value, number)} was sent {self.attempts} times",
            system=system,
            component=component,
            name=self.name,
            requested=self.value,
            actual=actual.settable,
        )


async def _learn_type(session: Session, name: str) -> None:
    """Read a parameter whose type was neither received nor verified on this link."""
    known = session.table.params.get(name)
    if known is None or known.trust is Trust.CACHED:
        await read(session, name)


async def _check_encoding(session: Session, name: str) -> None:
    """Wait until the encoding of an integer is certain, and raise UsageError if the values contradict it.

    Where neither the component nor the user names the encoding, and 0 shows none, other values are read.
    """
    channel, identification, table = session.channel, session.identification, session.table
    with channel.gate.until_closed(or_failed=True):
        await identification.encoding_certain()
    kind = table.params[name].type
    if session.dialect.has_ack or not (isinstance(kind, ParamType) and kind.is_integer):
        return
    if not (identification.is_encoding_known or table.evidence):
        with channel.inbox(session.dialect.value) as inbox, anyio.move_on_after(channel.timing.timeout(0)):
            for index in range(EVIDENCE_READS):
                channel.send(session.dialect.request_read(channel.reads_from, index))
            while not table.evidence:
                await inbox.next()
    if doubt := session.encoding_doubt:
        raise UsageError(f"{name} was not written. {doubt}")


async def _ignore_late_answers(session: Session, late: ReplacedValue) -> None:
    """Let the value before a write be ignored for its time; read the present one if it was received."""
    name = late.param.name
    await anyio.sleep_until(late.until)
    session.replaced[name].remove(late)
    if not session.replaced[name]:
        del session.replaced[name]
    if late.was_received:
        with suppress(ParamClientError):
            await read(session, name)


def _check_finite(session: Session, name: str, value: WireValue, *, force: bool) -> None:
    if force or not isinstance(value, float) or math.isfinite(value):
        return
    why = reason_against_non_finite(autopilot_name(session.identification.autopilot or 0))
    if why:
        system, component = session.channel.target
        raise UsageError(
            f"{name} = {value} was not sent to {system}/{component}: {why}. Force it to send it all the same."
        )


def _ext_ack(message: Message) -> ParamExtAck | None:
    return message if isinstance(message, ParamExtAck) else None
