"""PARAM_REQUEST_READ: order, pacing and outcomes. For timeouts and retries see `requests.retry`.

`ValueReads` has what the reads of plain and of extended parameters share.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import deque
from collections.abc import Collection
from typing import ClassVar, Final, Generic, Protocol, TypeAlias, TypeVar

from paramclient.errors import (
    NoReply,
    ParamErrorCode,
    Refused,
    TypeMismatch,
    UnknownParameter,
    VehicleError,
)
from paramclient.model.similar_names import did_you_mean, nearest_names
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.pacing import LinkBandwidth, Pace
from paramclient.protocol.requests.retry import ReadAttempts, ReadRetries, RetryPolicy
from paramclient.protocol.wire import (
    PARAMETERS_MAX,
    Message,
    ParamError,
    ParamExtValue,
    ParamRequestRead,
    ParamValue,
)

__all__ = ["Key", "Read", "Reads", "ValueRead", "ValueReads"]

Key: TypeAlias = str | int
"""The parameter of a read: a name, or an index."""

Response = TypeVar("Response", bound=ParamValue | ParamExtValue)

CONTROL_INDEX: Final = 0
"""The index of the control read: every component with parameters has it. Used until another index is known to
be answered."""
COPY_RESERVE: Final = 2.0
"""Requests that the pacing must still allow when a request is sent again early."""
NAMES_GIVEN_UP_MAX: Final = 2
"""Reads by name that one tick gives up: the search for similar names takes up to 8 ms for each."""


class ValueRead(Operation[Response]):
    """One request for a parameter and its response, shared by all callers of the same parameter.

    Attributes:
        key: name or index.
        holders: callers that wait for the response; at 0 the read is dropped.
        request: its attempts.
        is_of_caller: whether a caller waits for it, and not only a fetch.
        ask_again_at: when the request is sent again because the response may be older than a PARAM_SET;
            otherwise infinity.
    """

    def __init__(self, key: Key, policy: RetryPolicy, begun_at: float) -> None:
        super().__init__(begun_at)
        self.key = key
        self.request = ReadAttempts(policy)
        self.ask_again_at = math.inf
        self.holders = 0
        self.is_of_caller = False

    @property
    def attempts(self) -> int:
        """Requests sent."""
        return self.request.count


Read: TypeAlias = ValueRead[ParamValue]
"""One PARAM_REQUEST_READ and its response."""


class KnownParams(Protocol):
    """The part of a table that distinguishes an unknown parameter from a lost response."""

    @property
    def params(self) -> Collection[str]:
        """The known names."""

    @property
    def count(self) -> int | None:
        """The number of parameters in the list; None while it is unknown."""

    @property
    def live_count(self) -> int | None:
        """The count that the component has sent on this link; None if it is only that of the cache."""


class ValueReads(Machine, Generic[Response]):
    """The reads of one component by one protocol: paced by how fast it serves them, callers' reads before
    those of a download.

    Silence is not a response: PX4 up to 1.17 and ArduPilot do not respond to a read of a parameter that they
    do not have. A silent read is therefore accompanied by a control read of an index that exists. If the
    control reads are answered, and a name that nothing has announced or an index that is not below the count
    is not, the link is not the cause: the parameter is unknown. An index that is not below a count which the
    component has sent itself is unknown in any case: on a slow link, control reads may end too late to show
        it.

    Args:
        context, table: the component's.
        bandwidth: the bandwidth that all reads of the link may use together; None for a link with one
            component.

    Attributes:
        pace: the rate limit of requests.
        begun, retries: reads so far, and repeated requests.
        answered_at: when a read, or its control read, was answered last.
        list_runs_again: set while a list is sent another time: it may then contain the response to a read by
            index, which shows nothing about the round trip.
        is_idle: false while a list is received: then no request is sent twice to save time.
        list_until: until when values of an abandoned list may still arrive.
        control: the index of the control read, which is known to exist.
        sent_at: when a request was sent last.
    """

    _what: ClassVar[str] = "parameter"
    """What is read, in messages."""

    def __init__(
        self,
        context: Context,
        table: KnownParams,
        share: LinkBandwidth | None = None,
    ) -> None:
        self._target = context.target
        self._retry_policy = context.retry
        self._retries = ReadRetries(context.retry)
        self._send = context.send
        self._reschedule = context.reschedule
        self._table = table
        self._trace = context.trace
        self.begun = self.retries = 0
        self.pace = Pace(context.round_trip, share)
        self._open: dict[Key, ValueRead[Response]] = {}
        self._in_flight: dict[Key, ValueRead[Response]] = {}
        self._again: deque[ValueRead[Response]] = deque()
        self._caller_queue: deque[ValueRead[Response]] = deque()
        self._fetch_queue: deque[ValueRead[Response]] = deque()
        self.answered_at = self.sent_at = -math.inf
        self.list_runs_again = False
        self.is_idle = True
        self.list_until = -math.inf
        self.control = CONTROL_INDEX
        self._control_index = CONTROL_INDEX  # of the control read in flight

    def __len__(self) -> int:
        return len(self._open)

    def __contains__(self, key: Key) -> bool:
        return key in self._open

    def _is_known(self, key: Key) -> bool:
        """Return whether anything has announced such a parameter."""
        if isinstance(key, str):
            return key in self._table.params
        return self._table.count is None or key < self._table.count

    def ask(self, key: Key, now: float, *, urgent: bool = True) -> ValueRead[Response]:
        """Begin a read, or join an open one of the same parameter. Give it back with `release`."""
        read = self._open.get(key)
        if read is None:
            read = ValueRead(key, self._retry_policy, now)
            self.begun += 1
            self._open[key] = read
            (self._caller_queue if urgent else self._fetch_queue).append(read)
        elif urgent and read in self._fetch_queue:
            self._fetch_queue.remove(read)
            self._caller_queue.append(read)
        read.holders += 1
        self._reschedule()
        self._send_waiting(now, may_copy=False)  # other reads may begin at the same moment
        return read

    def release(self, read: ValueRead[Response]) -> None:
        """Give a read back. The last holder drops it."""
        read.holders -= 1
        if read.holders <= 0:
            read.drop_callbacks()
            if self._open.get(read.key) is read:
                self._reschedule()
                self._drop(read)

    def receive(self, message: Response, now: float) -> None:
        """Process a PARAM_VALUE of the component, after the table has stored it."""
        name, _, _, count, index = message
        open_reads = self._open
        is_answer = False
        for read in (open_reads.get(name), open_reads.get(index)) if open_reads else ():
            if read is None or open_reads.get(read.key) is not read:
                continue
            if read.attempts:
                is_answer = True
                self._count_answer(read, now)
                self._trace(
                    "%s/%s %s: answered %.3f s after try %s",
                    *self._target,
                    read.key,
                    now - read.request.sent_at,
                    read.attempts,
                )
            self._drop(read)
            read.finish(message, now)
            self._send_waiting(now)
        self._hear_control(index, count, now, is_answer=is_answer)

    def defer(self, message: Response, until: float, now: float) -> None:
        """Ignore a response whose value may be older than a PARAM_SET, and request it again at `until`."""
        is_answer = False
        for key in (message.param_id, message.param_index):
            read = self._in_flight.get(key)
            if read is not None and read.request.sent_at < math.inf:
                is_answer = True
                self._count_answer(read, now)
                read.request.sent_at = math.inf
                read.ask_again_at = until
        self._hear_control(message.param_index, message.param_count, now, is_answer=is_answer)

    def _hear_control(self, index: int, count: int, now: float, *, is_answer: bool) -> None:
        """Process a response with an index: the index exists and may serve for control reads.

        If a read of the same parameter was in flight, the message may be the response to either request:
        `is_answer`.
        """
        if index < count <= PARAMETERS_MAX:
            self.control = index  # exists and is answered
        if index == self._control_index and self._retries.is_control_awaited:
            self._retries.control_answered(now, is_answer=is_answer)
            self.answered_at = now
            if not self.list_runs_again:  # otherwise the list may have brought the value
                self._retries.count_control(read.request for read in self._in_flight.values())

    def refused(self, message: ParamError, now: float) -> None:
        """Process a PARAM_ERROR that may belong to a read."""
        key: Key = message.param_id if message.param_index < 0 else message.param_index
        read = self._in_flight.get(key)
        if read is not None:
            self._count_answer(read, now)
            self._drop(read)
            read.fail(self.error_of(message, read.key), now)
            self._send_waiting(now)

    def error_of(self, message: ParamError, key: Key) -> VehicleError:
        """Return the exception for a PARAM_ERROR."""
        system, component = self._target
        name, index = (key, None) if isinstance(key, str) else (None, key)
        words = ParamErrorCode.name_of(message.error)
        what = name if name is not None else f"{self._what} {index}"
        if message.error == ParamErrorCode.DOES_NOT_EXIST:
            return self._unknown(key)
        if message.error == ParamErrorCode.TYPE_MISMATCH:
            return TypeMismatch(
                f"{system}/{component} refuses {what}: {words}",
                system=system,
                component=component,
                name=name,
                index=index,
            )
        return Refused(
            f"{system}/{component} refuses {what}: {words}",
            system=system,
            component=component,
            name=name,
            index=index,
            code=message.error,
        )

    def tick(self, now: float) -> None:
        """Repeat timed-out requests and give up reads that are out of attempts."""
        timeout = self._retry_policy.timeout
        given_up = 0
        for read in [read for read in self._in_flight.values() if self._due_at(read) <= now]:
            if self._in_flight.get(read.key) is not read:
                continue  # ended by the end of another read
            if given_up >= NAMES_GIVEN_UP_MAX:
                break  # the others are due in the next tick
            if read.ask_again_at < math.inf:
                read.ask_again_at = math.inf
                self._again.append(read)
                continue
            may_be_in_list = self.list_runs_again and isinstance(read.key, int)
            self._retries.timed_out(read.request, shows_loss=not may_be_in_list)
            if self._retries.should_give_up(read.request, now, is_known=self._is_known(read.key)):
                self._drop(read)
                self._trace("%s/%s %s: given up after try %s", *self._target, read.key, read.attempts)
                given_up += isinstance(read.key, str)
                read.fail(self._timeout_error(read, now), now)
            else:
                self._trace(
                    "%s/%s %s: no answer to try %s in %.3f s", *self._target, read.key, read.attempts, timeout
                )
                read.request.sent_at = math.inf
                self._again.append(read)
        self._send_waiting(now)

    def is_silent(self, now: float) -> bool:
        """Return whether all requests have been unanswered for so long, and so often, that more are
        pointless."""
        return self._retries.is_silent(now)

    def reset_timeouts(self) -> None:
        """Reset the count of timeouts: the silence has another cause."""
        self._retries.reset_timeouts()

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        earliest = math.inf
        if self._in_flight:
            earliest = min(map(self._due_at, self._in_flight.values()))
        if self._again or self._caller_queue or self._fetch_queue:
            return min(earliest, self.pace.next_at())
        if self._needed_copy() is not None:
            return min(earliest, self.pace.next_at(COPY_RESERVE))
        return earliest

    def resume(self, now: float) -> None:
        """Queue everything that was in flight again: the link is back."""
        self._retries.resume()
        self._again.clear()
        for read in self._in_flight.values():
            read.request.uncount()
            read.request.sent_at = read.ask_again_at = math.inf
            self._again.append(read)
        self._send_waiting(now)

    def lose(self, now: float) -> None:
        """End the reads of callers: the component is lost. Those of a fetch go on for a while."""
        for read in list(self._open.values()):
            if self._open.get(read.key) is read and read.is_of_caller:
                self._drop(read)
                what = f"{self._name(read.key)} (lost)"
                read.fail(NoReply(what, attempts=read.attempts, waited=now - read.begun_at), now)

    def fail_all(self, error: Exception, now: float) -> None:
        """End all open reads with the error. Later reads are not affected."""
        for read in list(self._open.values()):
            if self._open.get(read.key) is read:
                self._drop(read)
                read.fail(error, now)

    def _due_at(self, read: ValueRead[Response]) -> float:
        """Return when a read in flight times out, or is sent again."""
        return min(read.request.due_at, read.ask_again_at)

    def _time_to_serve(self) -> float:
        """Return the seconds until a request sent now is answered, given the requests in flight."""
        requests = [read.request for read in self._in_flight.values()]
        in_flight = sum(1 + each.copies for each in requests if each.sent_at < math.inf)
        return self._retries.serving_time(in_flight, self.pace.quickest)

    def _seems_unknown(self, read: ValueRead[Response]) -> bool:
        return self._retries.seems_unknown(read.request, is_known=self._is_known(read.key))

    def _count_answer(self, read: ValueRead[Response], now: float) -> None:
        self._note_response(now)
        if self.list_runs_again and isinstance(read.key, int):
            return
        request = read.request
        request.answered(now)
        self.pace.answered(now - request.sent_at if request.is_measurable else None, now)

    def _note_response(self, now: float) -> None:
        self.answered_at = now
        self.reset_timeouts()

    def _timeout_error(self, read: ValueRead[Response], now: float) -> Exception:
        count = self._table.live_count
        if isinstance(read.key, int) and count is not None and read.key >= count:
            return self._unknown(read.key, f": it has {count}, counted from 0")
        if self._seems_unknown(read):
            return self._unknown(read.key, ": it does not respond to reads of this name, but to others")
        return NoReply(self._name(read.key), attempts=read.attempts, waited=now - read.begun_at)

    def _unknown(self, key: Key, reason: str = "") -> UnknownParameter:
        system, component = self._target
        name, index = (key, None) if isinstance(key, str) else (None, key)
        text = f"{system}/{component} has no {f'{self._what} {index}' if name is None else name}{reason}"
        nearest = () if name is None else nearest_names(name, self._table.params)
        if nearest:
            text = f"{text}.{did_you_mean(nearest)}"
        return UnknownParameter(
            text, system=system, component=component, name=name, index=index, nearest=nearest
        )

    def _name(self, key: Key) -> str:
        what = key if isinstance(key, str) else f"{self._what} {key}"
        return f"{what} of {self._target[0]}/{self._target[1]}"

    @property
    def _is_answered(self) -> bool:
        """Whether no request is unanswered: one more cannot make a queue."""
        return not self._in_flight and self.answered_at >= self.sent_at

    def _transmit(self, read: ValueRead[Response], now: float, *, is_charged: bool = True) -> None:
        read.request.sent(now)
        self.retries += read.attempts > 1
        read.request.serving_time = self._time_to_serve() if self.pace.is_batched else 0.0
        self._retries.sent(now)
        self.pace.sent(now, is_charged=is_charged)
        self._request(read, now)
        is_known = self._is_known(read.key)
        if read.key != self.control and self._retries.needs_control(read.request, is_known=is_known):
            self._send_control(now)

    def _request(self, read: ValueRead[Response], now: float) -> None:
        self.sent_at = now
        self._send(self._message_for(read.key))

    @abstractmethod
    def _message_for(self, key: Key) -> Message:
        """Return the request for a parameter."""

    def _send_control(self, now: float) -> None:
        """Send a control read, unless another one or a read of that index is in flight."""
        if not self._retries.may_send_control(now):
            return
        if not self._is_known(self.control):
            self.control = CONTROL_INDEX  # the vehicle has fewer parameters by now
        self._control_index = self.control
        self.pace.sent(now)
        self._send(self._message_for(self.control))

    def _send_waiting(self, now: float, *, may_copy: bool = True) -> None:
        """Send waiting requests as the rate limit allows; on an idle link, send copies instead of waiting.

        A caller's read is sent regardless of the rate limit if nothing is in flight and the last request was
        answered: a caller that reads one value after the other is as fast as the vehicle.
        """
        while self._again or self._caller_queue or self._fetch_queue:
            queue = self._caller_queue or self._again or self._fetch_queue
            if self._open.get(queue[0].key) is not queue[0]:
                queue.popleft()
                continue
            has_token = self.pace.may_send(now)
            if not has_token and not (queue is self._caller_queue and self._is_answered):
                return
            read = queue.popleft()
            self._in_flight[read.key] = read
            self._transmit(read, now, is_charged=has_token)
        while (
            may_copy
            and (read_again := self._needed_copy()) is not None
            and self.pace.may_send(now, COPY_RESERVE)
        ):
            read_again.request.copies += 1
            self.pace.sent(now)
            self._request(read_again, now)

    def _needed_copy(self) -> ValueRead[Response] | None:
        """Return a read for which a copy is worthwhile while its response may be on the way."""
        if not self.is_idle or not self._in_flight:
            return None
        copies = self._retries.copies
        if not copies:
            return None
        fewest = min(self._in_flight.values(), key=lambda read: read.request.copies)
        is_in_flight = fewest.request.sent_at < math.inf
        return fewest if fewest.request.copies < copies and is_in_flight else None

    def _drop(self, read: ValueRead[Response]) -> None:
        del self._open[read.key]
        self._in_flight.pop(read.key, None)
        if not self._open:
            self.pace.idle()


class Reads(ValueReads[ParamValue]):
    """The PARAM_REQUEST_READs to one component; see `ValueReads`."""

    def _message_for(self, key: Key) -> Message:
        if isinstance(key, int):
            return ParamRequestRead(*self._target, "", key)
        return ParamRequestRead(*self._target, key, -1)
