"""What the conversations about one component's parameters, plain or extended, share."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar
from weakref import WeakValueDictionary

import anyio

from paramclient.errors import AnotherVehicle, NoReply
from paramclient.model.values import Param, ParamType, Trust
from paramclient.protocol.channel import Channel, Gate
from paramclient.protocol.dialect import Dialect, Digest, ReportedValue
from paramclient.protocol.ftp import FTP_SILENT_TIME, SILENT_LOST
from paramclient.protocol.identity import Identification
from paramclient.protocol.table import Table
from paramclient.wire.messages import NO_INDEX

T = TypeVar("T")

Spawn = Callable[..., object]
"""Starts an async function, with its arguments, in the background."""

FOREIGN_SET_MEMORY: Final = 2.0
"""Seconds for which a PARAM_SET of another station explains a change."""
FOREIGN_SETS_MAX: Final = 256
"""PARAM_SETs of other stations that are remembered; the oldest is dropped first."""
LATE_TIME: Final = 0.3
"""Seconds after a value in which an older one may arrive: an ArduPilot takes the value of a read when it
queues the answer, and sends it up to 100 ms later; some links let datagrams overtake others."""
REPLACED_MAX: Final = 16
"""Values of one parameter that are remembered meanwhile: it acknowledges its sets every 6 ms at most."""
UNANSWERED: Final = "MAVFTP did not answer"
"""The reason of a `FileUnavailable` that loss may explain."""


class FileUnavailable(Exception):
    """The parameter file, or its checksum, cannot be had; the list can.

    Attributes:
        reason: why, as a sentence for the notes of a fetch.
        is_silent: whether no request was answered.
    """

    def __init__(self, reason: str, *, is_silent: bool = False) -> None:
        super().__init__(reason)
        self.reason = reason
        self.is_silent = is_silent


class Shared(Generic[T]):
    """Work whose result several callers await. The last caller who leaves cancels it.

    Args:
        spawn: starts the work in the background.
        gate: fails after all background work was cancelled.
    """

    def __init__(self, spawn: Spawn, gate: Gate) -> None:
        self._spawn = spawn
        self._gate = gate
        self._run: _Run[T] | None = None

    @property
    def is_running(self) -> bool:
        """Whether the work is in progress."""
        return self._run is not None

    async def join(self, work: Callable[[], Awaitable[T]]) -> T:
        """Await the result of the work in progress, or of `work`, which begins then.

        Cancellation ends this wait only, and the work if no other caller awaits it.

        Raises:
            LinkError: the client was closed; or an error of the work.
        """
        run = self._run
        if run is None:
            run = self._run = _Run()
            self._spawn(self._execute, run, work)
        run.waiters += 1
        try:
            with self._gate.until_closed():  # a client that is being closed starts no work
                await run.done.wait()
                if not run.results and run.error is None:  # it was cancelled
                    await anyio.sleep_forever()
        finally:
            run.waiters -= 1
            if not run.waiters:
                run.scope.cancel()
                self._forget(run)
        if run.error is not None:
            raise run.error.with_traceback(None)
        return run.results[0]

    async def _execute(self, run: _Run[T], work: Callable[[], Awaitable[T]]) -> None:
        try:
            with run.scope:
                run.results.append(await work())
        except Exception as error:  # belongs to the callers
            run.error = error
        finally:
            run.done.set()
            self._forget(run)

    def _forget(self, run: _Run[T]) -> None:
        if self._run is run:
            self._run = None


@dataclass(eq=False, slots=True)
class _Run(Generic[T]):
    waiters: int = 0
    scope: anyio.CancelScope = field(default_factory=anyio.CancelScope)
    done: anyio.Event = field(default_factory=anyio.Event)
    results: list[T] = field(default_factory=list)
    error: Exception | None = None


@dataclass(slots=True)
class Replaced:
    """The values before the last acknowledgement, while an answer to an earlier read may still bring them.

    Attributes:
        params: the parameter before each change.
        until: when such an answer can arrive no more, but to a read that is sent then.
    """

    params: list[Param]
    until: float


class Session:
    """One component's parameters in one dialect, and the conversations about them.

    Args:
        channel, identification: the component's.
        dialect: plain or extended.
        spawn: starts an async function in the background.
        identified: requests the identity and waits for it.

    Attributes:
        table: the current values.
        fetching: the fetch that is in progress, shared by all callers.
        reading: by name or index when a read in progress began; by None, when the list did.
        writing: the authors of the writes in progress, by name.
        sent: by name, the bytes that they have sent.
        serves_file: whether the parameter file was served on this link; None while unknown.
        serves_checksum: likewise, whether its checksum is computed.
        ftp_unanswered: attempts of MAVFTP requests in vain, since the last file.
        announced: the last PX4 hash that was received, also in another station's list, or None.
        written_at: when the last write ended; minus infinity before the first.
        replaced: by name, the values of an ArduPilot before its last changes.
        contradicted: called when a hash is received that is not the table's.
        serves_reads: whether reads by name (str), and by index (int), are answered, as far as known.
        only_by_index: whether reads by index were answered, and reads by name of the same were not.
        control: taken for the reads that decide this: the answer to another one would be taken for theirs.
        listing: the list that is downloaded in place of reads that are not answered.
        seeking: the reads for evidence of the encoding.
        acknowledging: by name, how many values in another type than the parameter's may acknowledge sets yet.
        observers: called with the parameters received and their number, while a fetch runs.
    """

    def __init__(
        self,
        channel: Channel,
        identification: Identification,
        dialect: Dialect,
        spawn: Spawn,
        identified: Callable[[], Awaitable[None]],
    ) -> None:
        self.channel = channel
        self.identification = identification
        self.dialect = dialect
        self.spawn = spawn
        self.table = Table(dialect)
        self.table.author_of = self._author_of
        self.fetching: Shared[Any] = Shared(spawn, channel.gate)
        self.reading: dict[str | int | None, float] = {}
        self.writing: dict[str, str] = {}
        self.sent: dict[str, bytes] = {}
        self.serves_file: bool | None = None
        self.serves_checksum: bool | None = None
        self.ftp_unanswered = 0
        self.announced: Digest | None = None
        self.written_at = -math.inf
        self.replaced: dict[str, Replaced] = {}
        self.contradicted: Callable[[], None] = lambda: None
        self.serves_reads: dict[type[str | int], bool] = {}
        self.only_by_index = False
        self.control = anyio.Lock()
        self.listing: Shared[Any] = Shared(spawn, channel.gate)
        self.seeking: Shared[None] = Shared(spawn, channel.gate)
        self.acknowledging: Counter[str] = Counter()
        self.observers: set[Callable[[int, int | None], None]] = set()
        self._identified = identified
        self._locks: WeakValueDictionary[str, anyio.Lock] = WeakValueDictionary()
        self._foreign_sets: dict[str, tuple[str, float]] = {}
        self._sequences: dict[str, int] = {}  # of the frame with each value

    def receive(self, message: ReportedValue, now: float, sequence: int) -> float | None:
        """Store a value, unless it may be older than the known one.

        Then, return the time at which only the parameter's present value can be received. A first value may
        have waited for a busy program, and is as old as its request: another program may know a later one.

        Args:
            message: the value.
            now: when it arrived.
            sequence: of its frame: a lower one than that of the known value was overtaken.
        """
        name, spelled = message.param_id, self.spelled(message.param_id)
        if name != spelled and self.identification.is_ardupilot and message.param_index == NO_INDEX:
            if spelled in self.table.params:
                name, message = spelled, message._replace(param_id=spelled)
            elif (self.dialect.value, name) not in self.channel.inboxes:
                return None  # in the case of another station's request: the vehicle may have it in capitals
        message = self.typed(message)
        _, raw, number, _, _ = message
        table, replaced, is_sent = self.table, self.replaced.get(name), self.sent.get(name) == raw
        known, may_read = table.params.get(name), not self.identification.listens_only
        if known and known.type != number and self.acknowledging[name]:
            self.acknowledging[name] -= 1
            return None
        is_other = known is not None and not table.is_reported(known, raw, number)
        is_answer = not is_sent and (message.param_index != NO_INDEX or name in self.reading)
        until = table.moments.get(name, -math.inf) + LATE_TIME
        behind = (self._sequences.get(name, sequence) - sequence) % 256
        is_overtaken = may_read and 0 < behind < 128 and now <= until
        if is_overtaken and is_other and not is_sent:
            return until
        asked = min(self.reading.get(each, now) for each in (name, message.param_index))
        is_late = replaced is not None and (now <= replaced.until or asked < replaced.until - LATE_TIME)
        if replaced is not None and is_late and is_other:
            was_it = any(table.is_reported(each, raw, number) for each in replaced.params)
            if is_answer or (was_it and not is_sent):
                return replaced.until
        is_first = (known is None or known.trust is not Trust.LIVE) and not is_sent
        moment = min(asked, self.reading.get(None, now)) if is_first else now
        table.store(message, moment, is_exact=is_sent)
        if name in table.params and not is_overtaken:
            self._sequences[name] = sequence
        if name in table.params and may_read and message.param_index == NO_INDEX:
            before = replaced.params if replaced is not None and now <= replaced.until + LATE_TIME else []
            params = [*before, known][-REPLACED_MAX:] if known is not None and is_other else before
            self.replaced[name] = Replaced(params, now + LATE_TIME)
        return None

    def typed(self, message: ReportedValue) -> ReportedValue:
        """Return a value in the known type of its parameter, where it acknowledges an ArduPilot's default.

        ArduPilot acknowledges the set of a default that was never stored as REAL32, whatever the type is
        (measured on 4.6-dev); the bytes are a float for every type.
        """
        known = self.table.params.get(message.param_id)
        is_ack = self.identification.is_ardupilot and message.param_index == NO_INDEX
        if known is None or not is_ack or known.is_raw or message.param_type != ParamType.REAL32:
            return message
        return message._replace(param_type=known.type)

    def spelled(self, name: str) -> str:
        """Return a name as the vehicle spells it.

        An ArduPilot takes any case, and answers a read in the requested one, but a set in capitals. PX4 has
        names in capitals only. A name that is listed in lower case stays.
        """
        has_capitals = self.identification.is_ardupilot or self.identification.is_px4
        return name.upper() if has_capitals and name.isascii() and name not in self.table.params else name

    async def confirm(self, vehicles: int) -> None:
        """Wait until the link is open, and until it is certain that the same vehicle still uses the address.

        Args:
            vehicles: `Identification.vehicles` at the begin.

        Raises:
            AnotherVehicle: another one does.
            NoReply: the vehicle was lost, has rebooted or its link was interrupted, and did not say before
                or does not say again which one it is.
            LinkError: the link has failed.
        """
        began, identification = anyio.current_time(), self.identification
        await self.channel.gate.wait()
        if not identification.is_confirmed:
            await self._identified()
            await self.channel.gate.wait()
        is_other = identification.vehicles != vehicles
        if is_other and identification.former.uid is not None:
            who = str(identification.former), str(identification.identity)
            raise AnotherVehicle(*self.channel.target, *who)
        if is_other or not identification.is_confirmed:
            raise NoReply(f"the identity of {self.channel}", attempts=0, waited=anyio.current_time() - began)

    def ftp_attempts(self) -> Callable[[], int] | None:
        """Return the function for the attempts of a MAVFTP request that begins now; None where it was
        answered."""
        if self.serves_file or self.serves_checksum:
            return None
        began, timing = anyio.current_time(), self.channel.timing

        def attempts() -> int:
            is_late = anyio.current_time() - began + timing.timeout(0) > FTP_SILENT_TIME
            is_vain = is_late or not self.identification.may_serve_file  # the version may just have arrived
            return 0 if is_vain and not self.serves_checksum else timing.attempts_for(SILENT_LOST)

        return attempts

    def lock(self, name: str) -> anyio.Lock:
        """Return the lock of the writes to one name: they run one after the other."""
        return self._locks.setdefault(name, anyio.Lock())

    def announce(self, digest: Digest) -> None:
        """Take a hash that was received."""
        self.announced = digest
        if self.table.is_complete and self.table.hash not in (None, digest.hash):
            self.contradicted()

    def confirm_announced(self) -> None:
        """Confirm a complete table by the hash that was received last, if it is of as many parameters."""
        table, announced = self.table, self.announced
        if announced is not None and announced.count == table.count and table.is_complete:
            table.confirm(announced.hash)

    @property
    def encoding_doubt(self) -> str:
        """Why the encoding is probably wrong, as a sentence; "" without evidence, or by the user's choice."""
        why = self.table.contradicts if self.identification.chosen is None else ""
        return why and f"The encoding of {self.channel} is probably wrong: {why}."

    def report(self, received: int, total: int | None) -> None:
        """Report the progress of a fetch."""
        for observer in list(self.observers):
            observer(received, total)

    def foreign_set(self, name: str, station: str, now: float) -> None:
        """Remember the PARAM_SET of another station: it explains a change soon after."""
        self._foreign_sets.pop(name, None)
        self._foreign_sets[name] = (station, now)
        if len(self._foreign_sets) > FOREIGN_SETS_MAX:
            del self._foreign_sets[next(iter(self._foreign_sets))]

    def _author_of(self, name: str) -> str:
        station, at = self._foreign_sets.get(name, ("", -math.inf))
        is_recent = self.table.moments[name] - at <= FOREIGN_SET_MEMORY
        return self.writing.get(name) or (station if is_recent else "vehicle")
