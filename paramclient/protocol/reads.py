"""Read single parameters: PARAM_REQUEST_READ and PARAM_EXT_REQUEST_READ, and what silence means."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import nullcontext, suppress
from typing import Final

import anyio

from paramclient.errors import (
    NoReply,
    ParamClientError,
    ParamErrorCode,
    Refused,
    TypeMismatch,
    UnknownParameter,
    VehicleError,
)
from paramclient.model.names import did_you_mean, nearest_names
from paramclient.model.values import Param, Trust
from paramclient.protocol.channel import ATTEMPTS_MAX, BACKOFF_FROM, PATIENCE_MIN, Inbox, task_group
from paramclient.protocol.dialect import ReportedValue
from paramclient.protocol.identity import HEARTBEAT_WAIT
from paramclient.protocol.list_download import download_list
from paramclient.protocol.session import Session
from paramclient.wire.messages import HASH_CHECK, Message, ParamError

CONTROL_LOST: Final = 1e-4
"""Probability that all requests of the control read are lost, which decides whether a component answers
reads at all."""
CONTROL_REQUESTS_MIN: Final = 8
FIRST_ATTEMPTS: Final = 5
"""Attempts of a read before anything was answered: 3.3 s, and the list answers where reads do not."""
SLOT_ARDUPILOT: Final = 0.1
"""Seconds between two times at which an ArduPilot answers reads."""
READS_PER_SLOT_ARDUPILOT: Final = 5
"""Reads that it answers then; others wait for the next slot."""


async def read(session: Session, which: str | int) -> ReportedValue:
    """Read one parameter, by name or index. Its value is in the table then.

    A component that leaves this read unanswered and answers another one of its kind has no such parameter:
    PX4 before 1.18 and ArduPilot before 4.7 say nothing of an unknown name. One that answers no reads by name
    is read by index, or by its list. A read of what another caller is reading awaits the answer to that
    request first.

    Raises:
        UnknownParameter: the component has no such parameter.
        Refused: it gave another reason.
        NoReply: it answered nothing.
        LinkError: the link is closed for good.
    """
    spelled = session.spelled(which) if isinstance(which, str) else which
    if spelled != which:
        with suppress(UnknownParameter, NoReply):
            return await _read(session, spelled, which)
    known = session.table.params.get(which) if isinstance(which, str) else None
    if known is not None and known.index is not None and _reads_by_index(session):
        try:
            if (answer := await _read(session, known.index)).param_id == which:
                return answer
        except (UnknownParameter, NoReply) as error:  # some answer reads by name only
            if isinstance(error, NoReply) and (session.serves_reads.get(int) or session.channel.is_lost):
                raise
    return await _read(session, which)


def _reads_by_index(session: Session) -> bool:
    """Return whether to read known names by their index.

    An ArduPilot repeats the index in its answer, which tells that from the acknowledgement of a set.
    """
    is_told = session.identification.is_ardupilot and session.serves_reads.get(int) is not False
    return session.only_by_index or (is_told and bool(session.table.is_complete or session.serves_file))


async def _read(session: Session, which: str | int, alias: str | int | None = None) -> ReportedValue:
    """Read a parameter. Where that is not answered, a component may have it as the alias."""
    channel = session.channel
    began, must_wait = anyio.current_time(), channel.window.value == 0
    async with channel.window:
        if must_wait and channel.is_lost:  # while others were read
            raise NoReply(_what(session, which), attempts=0, waited=anyio.current_time() - began)
        is_first = which not in session.reading
        session.reading.setdefault(which, anyio.current_time())
        try:
            with channel.inbox(*((session.dialect.value, each) for each in (which, alias))) as inbox:
                try:
                    return await _ask(session, inbox, which, is_asked=not is_first)
                except NoReply:
                    if which == HASH_CHECK or channel.is_lost:
                        raise
                    if alias is not None:
                        channel.send(session.dialect.request_read(channel.reads_from, alias))
                    if (control := await _control_read(session, which)) is None:
                        is_over = channel.is_lost or bool(alias and inbox)
                        if is_over or (listed := await _read_list(session, inbox, which)) is None:
                            raise
                        return listed
                if control.param_id in (which, alias):
                    session.serves_reads.setdefault(type(which), False)  # by its index only
                    return control
                with suppress(NoReply):  # it answers by now, and may only have been busy
                    return await _ask(session, inbox, which, channel.timing.attempts_for(CONTROL_LOST))
        finally:
            if is_first:
                del session.reading[which]
    raise _unknown(session, which, ": it does not respond to reads of this name, but to others")


async def _ask(
    session: Session, inbox: Inbox, which: str | int, requests: int = 0, *, is_asked: bool = False
) -> ReportedValue:
    """Request a parameter until it is received, and learn whether such reads are answered.

    Few attempts suffice where another way is left: before anything was ever answered, where such reads were
    not answered before, and for a hash that was not confirmed on this link. One that is asked for already is
    awaited first. Where the round trip is long and silence would mean something, several copies are sent at
    once.
    """
    channel, dialect, table = session.channel, session.dialect, session.table
    is_served = session.serves_reads.get(type(which))

    def accept(message: Message) -> ReportedValue | None:
        if isinstance(message, ParamError):
            raise refusal(session, which, message.error)
        known = table.params.get(which if isinstance(which, str) else table.names.get(which, ""))
        if isinstance(message, dialect.value) and (known is None or known.type == message.param_type):
            return message
        return None  # in another type, a value acknowledges a set

    def requests_max() -> int:  # of this moment: the loss is better known with each answer
        most = requests or timing.attempts_max
        return min(most, FIRST_ATTEMPTS) if is_first else most

    def copies(attempt: int) -> int:
        if is_certain or attempt < singles:
            return 1
        most = requests_max()  # the last of which wait for longest
        return max(1, min(int(most * timing.timeout(most if is_known else 0) / PATIENCE_MIN), timing.copies))

    def attempts_max() -> int:
        if channel.is_streaming:  # on a slow link, the answer is queued behind the list
            return ATTEMPTS_MAX
        if is_served is False:
            return 1
        most = requests_max()
        return min(most, singles) + math.ceil(max(most - singles, 0) / copies(singles))

    wait, timing = queue_time(session), channel.timing
    is_there, singles = which in table.params or which in table.names, 1 if requests else BACKOFF_FROM
    is_certain = bool(is_served) and is_there and not requests
    is_known, has_time = timing.round_trip is not None, timing.timeout(0) * FIRST_ATTEMPTS > PATIENCE_MIN
    may_be_off = which == HASH_CHECK and is_known and (table.hash is None or bool(table.unverified()))
    is_first = is_served is None and (may_be_off if which == HASH_CHECK else has_time or not is_known)
    if is_asked:
        answer: ReportedValue | None = await channel.wait_for(inbox, accept, anyio.current_time(), 0, wait)
        if answer is not None:
            return answer
    request, what = dialect.request_read(channel.reads_from, which), _what(session, which)
    received: ReportedValue = await channel.exchange(
        request, inbox, accept, what=what, attempts=attempts_max, timeout_min=wait, copies=copies
    )
    # Else it may be of the list, the acknowledgement of a set, or the answer to a read by index.
    is_of_control = not requests and session.control.locked()
    if not (session.only_by_index or None in session.reading or which in session.sent or is_of_control):
        session.serves_reads[type(which)] = True
    return received


def _what(session: Session, which: str | int) -> str:
    return f"parameter {which} of {session.channel}"


async def read_param(session: Session, which: str | int) -> Param:
    """Read one parameter, and return it as the component has reported it.

    Raises:
        UnknownParameter, Refused, NoReply, LinkError: as from `read`.
    """
    message = await read(session, which)
    if session.identification.autopilot is None and not session.dialect.has_ack:
        with anyio.move_on_after(HEARTBEAT_WAIT):  # it tells the encoding
            await session.identification.encoding_certain()
    known = session.table.params.get(message.param_id)
    if known is not None and (isinstance(which, str) or known.index == which):
        return known
    index = message.param_index if message.param_index < message.param_count else None
    return session.dialect.param(*message[:3], index, session.table.encoding)


async def read_many(session: Session, names: Iterable[str]) -> None:
    """Read several parameters into the table, as many at once as the component serves; some may fail.

    Raises:
        LinkError: the link is closed for good.
    """

    async with task_group() as tasks:
        for name in names:
            tasks.start_soon(read_again, session, name, anyio.current_time())
    session.channel.gate.check()


def is_stale(session: Session, name: str, age: float) -> bool:
    """Return whether a known value is older than so many seconds, not being read, and outside PX4's hash, so
    that nothing tells of a change."""
    is_outside = session.identification.is_px4 and name in session.table.volatile
    is_old = anyio.current_time() - session.table.moments.get(name, math.inf) > age
    return is_outside and is_old and name not in session.reading


async def read_again(session: Session, name: str, at: float) -> None:
    """Read a parameter at a time; it may fail."""
    await anyio.sleep_until(at)
    with suppress(ParamClientError):
        await read(session, name)


def refusal(session: Session, which: str | int, code: int) -> UnknownParameter | TypeMismatch | Refused:
    """Return the error for a PARAM_ERROR with this code."""
    if code == ParamErrorCode.DOES_NOT_EXIST:
        return _unknown(session, which)
    channel = session.channel
    name, index = (which, None) if isinstance(which, str) else (None, which)
    what = f"{channel} refused {which}: {ParamErrorCode.name_of(code)}"
    if code == ParamErrorCode.TYPE_MISMATCH:
        return TypeMismatch(what, *channel.target, name=name, index=index)
    return Refused(what, *channel.target, code=code, name=name, index=index)


def queue_time(session: Session, more: int = 0) -> float:
    """Return the seconds that an ArduPilot takes to answer the reads in flight, and `more`; 0 for others.

    Without it, sets, which are answered at once, would measure a round trip at which all reads are repeated.
    """
    if not session.identification.is_ardupilot:
        return 0.0
    channel = session.channel
    slots = 1 + (channel.window_size - channel.window.value + more) // READS_PER_SLOT_ARDUPILOT
    return slots * SLOT_ARDUPILOT + (channel.timing.round_trip or 0.0)


async def _control_read(session: Session, which: str | int) -> ReportedValue | None:
    """Read something that the component certainly has; return None if reads of this kind are not answered.

    That is the same parameter by its index, where that is known: some components answer no read by name.
    """
    live = {name: param.index for name, param in session.table.params.items() if param.trust is Trust.LIVE}
    same = live.pop(which, None) if isinstance(which, str) else None
    known: Iterable[str | int | None] = live.values() if _reads_by_index(session) else [*live]
    likely: str | int = next((each for each in known if each), 1) if same is None else same
    async with nullcontext() if session.serves_reads.get(type(which)) else session.control:
        while None in session.reading:  # noqa: ASYNC110 - the values of a list would be taken for the answers
            await anyio.sleep(session.channel.timing.timeout(0))
        control = await _try(session, likely) or await _try(session, 0)  # the indices may be 0, 2, 4, …
        is_proven = not isinstance(which, str) or session.serves_reads.get(str)
        if control is None or is_proven or control.param_id == which:
            return control
        if str not in session.serves_reads:
            await anyio.sleep(1.25 * session.channel.timing.slowest)  # for its other answers
            await _try(session, control.param_id)
        session.only_by_index = session.serves_reads.get(str) is False
        return control if session.serves_reads.get(str) else None


async def _try(session: Session, which: str | int) -> ReportedValue | None:
    """Read a parameter that the component has; return None, and remember it, if that is not answered.

    One that is lost meanwhile, or answers no reads of either kind, is asked no more.
    """
    channel = session.channel
    if channel.is_lost or [*session.serves_reads.values()] == [False, False]:
        return None
    requests = max(channel.timing.attempts_for(CONTROL_LOST), CONTROL_REQUESTS_MIN)
    with channel.inbox((session.dialect.value, which)) as inbox:
        try:
            answer = await _ask(session, inbox, which, requests)
            return answer if session.serves_reads.get(type(which)) else None
        except (NoReply, VehicleError):
            session.serves_reads.setdefault(type(which), False)
            return None


async def _read_list(session: Session, inbox: Inbox, which: str | int) -> ReportedValue | None:
    """Take a parameter from the list of a component that answers no reads; None if values of it were lost.

    The rest of the list is not awaited.

    Raises:
        UnknownParameter: it is not in the list. Some components count parameters that they never send.
        LinkError: the link is closed for good.
    """
    answers: list[ReportedValue] = []
    has_gap: bool | None = None

    async def take() -> None:
        while not answers:
            message = await inbox.next()
            if isinstance(message, session.dialect.value):
                answers.append(message)
        tasks.cancel_scope.cancel()

    async with task_group() as tasks:
        tasks.start_soon(take)
        with suppress(NoReply):
            for _ in range(1 + session.listing.is_running):  # one that runs may have passed the parameter
                listed = await session.listing.join(lambda: download_list(session))
                has_gap = listed.has_gap or (bool(listed.missing) and which in session.table.params)
        tasks.cancel_scope.cancel()
    if answers or has_gap is not None:
        session.serves_reads = {str: False, int: False} | session.serves_reads
    if answers:
        return answers[0]
    if session.channel.is_lost or has_gap is not False:
        return None
    sent = f" (its list has {len(session.table.names)} of {session.table.count} parameters)"
    raise _unknown(session, which, sent=sent * (not session.table.is_complete))


def _unknown(session: Session, which: str | int, reason: str = "", sent: str = "") -> UnknownParameter:
    name, index = (which, None) if isinstance(which, str) else (None, which)
    nearest = () if name is None else nearest_names(name, session.table.params)
    what = f"{session.channel} has no {'' if name else 'parameter with index '}{which}"
    what += (did_you_mean(nearest) or reason) + sent
    return UnknownParameter(what, *session.channel.target, name=name, index=index, nearest=nearest)
