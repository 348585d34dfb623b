"""KeptTable: one component's parameters, for which the gateway answers every ground station."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from typing import Final, NamedTuple, TypeAlias, TypeVar

import anyio

from paramclient import errors
from paramclient.client.component import Component
from paramclient.client.streams import Stream
from paramclient.errors import ExtAckResult, ParamClientError, ParamErrorCode
from paramclient.model.values import (
    EXT_VALUE_SIZE,
    WIRE_SIZE,
    Encoding,
    Param,
    ParamType,
    Trust,
    as_reported,
    ext_bytes,
)
from paramclient.protocol.channel import task_group
from paramclient.protocol.dialect import ReportedValue
from paramclient.protocol.digest import may_confirm
from paramclient.protocol.reads import is_stale, read, read_again
from paramclient.protocol.session import Session
from paramclient.protocol.table import Change
from paramclient.protocol.watch import SyncState
from paramclient.service.stations import REQUESTS_MAX, GroundStation
from paramclient.wire import messages
from paramclient.wire.messages import HASH_CHECK, NO_INDEX, Message

PROOF_AGE_MAX: Final = 5.0
"""Seconds since the vehicle last confirmed the table, above which an answer has it checked in the
background."""
SILENT_AFTER: Final = 60.0
"""Seconds of silence after which a component without heartbeats counts as lost."""
PROGRESS_INTERVAL: Final = 0.05
"""Seconds between two looks for values that a running fetch has brought."""
FIRST_VALUE_TIME: Final = 1.0
"""Seconds without a value of a running fetch, after which one is requested beside it, and again: MAVSDK
repeats its list after 2 s and gives up at the sixth."""
LOADING_WAIT: Final = 0.2
"""Seconds that a read by name waits for a fetch to bring the value before the vehicle is asked."""
READ_TIMEOUT: Final = 3.0
"""Seconds for a value or a name that the table does not have."""
SET_TIMEOUT: Final = 2.9
"""Seconds for a verified write: a station has a result within 3 s."""
OVERTAKING_BEATS: Final = 2
"""Heartbeats since a set that show, during a fetch, that its acknowledgement does not wait behind the list in
the radio's queue: an error would be wrong then. The first of them may be older than the set."""
REMEMBERED_TIME: Final = 30.0
"""Seconds for which is remembered that the vehicle does not have a name, or has not sent all of its list, and
for which requests pass to a component that did not answer the gateway's own fetch."""
UNKNOWN_NAMES_MAX: Final = 4_096
"""Names that are remembered as unknown, at most."""

CODES: Final = (
    (errors.UnknownParameter, ParamErrorCode.DOES_NOT_EXIST),
    (errors.TypeMismatch, ParamErrorCode.TYPE_MISMATCH),
    (errors.AmbiguousVehicle, ParamErrorCode.PERMISSION_DENIED),
    ((errors.UsageError, errors.ValueNotApplied), ParamErrorCode.VALUE_OUT_OF_RANGE),
    (ParamClientError, ParamErrorCode.COMPONENT_NOT_FOUND),  # it does not answer
)
"""The codes of PARAM_ERROR by exception; the first class that matches counts."""

Key = TypeVar("Key")
Which: TypeAlias = "str | int"
SetKey: TypeAlias = tuple[str, bytes, int, int]
"""Name, bytes and type in a set, and the number of the change of mind: a set back is no repetition."""


class Asker(NamedTuple):
    """A station, and the ids under which it asks.

    Attributes:
        station: to which the answer goes.
        system, component: its ids.
    """

    station: GroundStation
    system: int
    component: int


class Pending(dict[Key, set[Asker]]):
    """Requests that wait, each with all who ask it."""

    def begins(self, key: Key, asker: Asker) -> bool:
        """Add one who asks, unless its station waits for too much; return whether it is the first one."""
        if asker in self.get(key, ()) or asker.station.waiting >= REQUESTS_MAX:
            return False
        asker.station.waiting += 1
        self.setdefault(key, set()).add(asker)
        return len(self[key]) == 1

    def end(self, key: Key) -> set[Asker]:
        """Remove a request, and return who asked it."""
        askers = self.pop(key)
        for each in askers:
            each.station.waiting -= 1
        return askers


# Messages from parameters


def value_of(session: Session, param: Param, *, index: int | None = None) -> ReportedValue:
    """Return a parameter as its component would send it: the same bytes, index and count.

    Args:
        session: the component's.
        param: of its table.
        index: of the parameter in an answer by index; None for an answer by name, and for a change: an
            ArduPilot sends these without an index.
    """
    if index is None:
        known = NO_INDEX if param.index is None or session.identification.is_ardupilot else param.index
        index = known if session.table.names.get(known) == param.name else NO_INDEX  # of another count
    if session.dialect.has_ack:
        raw = ext_bytes(param).ljust(EXT_VALUE_SIZE, b"\0")
    elif param.is_raw:
        raw = param.bits.to_bytes(WIRE_SIZE, "little")
    else:
        raw = as_reported(param.bits, param.type, session.table.encoding)
    return session.dialect.value(param.name, raw, param.type, session.table.count or 0, index)


def digest_of(session: Session) -> messages.ParamValue | None:
    """Return the `_HASH_CHECK` of a PX4; None for another vehicle, or while it is unknown."""
    table = session.table
    if not session.identification.is_px4 or table.hash is None or table.count is None:
        return None
    raw = table.hash.to_bytes(WIRE_SIZE, "little")
    return messages.ParamValue(HASH_CHECK, raw, ParamType.UINT32, table.count, NO_INDEX)


def listed(session: Session) -> list[ReportedValue]:
    """Return the values of the list that are known to be the vehicle's, by index."""
    known = ((index, known_param(session, name)) for index, name in sorted(session.table.names.items()))
    return [value_of(session, param, index=index) for index, param in known if param is not None]


def whole_list(session: Session) -> list[ReportedValue]:
    """Return the answers to a request for the list of a table in sync; empty if it is not complete."""
    values = listed(session) if session.table.is_complete else []
    if not values or len(values) < len(session.table.names):
        return []
    return values if (digest := digest_of(session)) is None else [digest, *values]


def known_param(session: Session, name: str | None) -> Param | None:
    """Return a parameter whose value is known to be the vehicle's."""
    param = None if name is None else session.table.params.get(name)
    return param if param is not None and param.trust is not Trust.CACHED and is_decoded(session) else None


def is_decoded(session: Session) -> bool:
    """Whether values are those that the vehicle has sent: in another encoding, the bytes are not theirs.

    A heartbeat that says so may be late, and the values themselves show it before; a file does not.
    """
    identification = session.identification
    is_shown = not session.serves_file or identification.autopilot is not None or bool(session.table.evidence)
    is_certain = is_shown and identification.is_encoding_certain and not session.encoding_doubt
    return session.dialect.has_ack or is_certain


class KeptTable(Stream[Change]):
    """The parameters of one component in one protocol, plain or extended.

    Args:
        component: with plain or with extended parameters.
        announce: called with each value that has changed, for all stations.

    Attributes:
        component, session, source: of the component.
        heartbeat, beats: the component's last heartbeat, and how many there were.
    """

    most = 0  # changes are taken at once, and none is queued

    def __init__(self, component: Component, announce: Callable[[KeptTable, Message], None]) -> None:
        super().__init__()
        self.component = component
        self.session = component.session
        self.source = (component.system, component.component)
        self.heartbeat: Message | None = None
        self.beats = 0
        self._announce = announce
        self._list_at = lru_cache(1)(lambda state: whole_list(component.session))
        self._unserved_until = -math.inf
        self._partial_until = -math.inf
        self._unknown: dict[Which, float] = {}
        self._reads = Pending[Which]()
        self._sets = Pending[SetKey]()
        self._listing: dict[GroundStation, set[int]] = {}  # for a list, and the indices that each has
        self._listing_count: int | None = None
        self._loaded: anyio.Event | None = None  # while a fetch runs
        component.subscribers.add(self)

    # the state

    @property
    def is_lost(self) -> bool:
        """Whether the component is lost: nothing is answered in its name."""
        return self.component.node.presence.is_lost or self.component.silence > SILENT_AFTER

    @property
    def is_kept(self) -> bool:
        """Whether the gateway answers for the component; otherwise requests pass to it."""
        node, now = self.component.node, anyio.current_time()
        doubt = node.identification.is_encoding_certain and not (is_decoded(self.session) or self.is_loading)
        is_unfit = doubt or self.session.table.left_out or node.has_rival(now)
        is_fetched = now >= self._unserved_until or self.state_key is not None
        return node.identification.has_parameters and is_fetched and not is_unfit

    @property
    def is_loading(self) -> bool:
        """Whether a fetch is in progress."""
        return self._loaded is not None or self.session.fetching.is_running

    @property
    def withholds(self) -> bool:
        """Whether values of the component are answers to the gateway: it announces changes itself."""
        return self.session.table.is_complete or self.is_loading or bool(self._reads or self._sets)

    @property
    def state_key(self) -> object:
        """What differs where the list may differ; None while the table is not in sync."""
        table, watch = self.session.table, self.component.watch
        state = (table.revision, table.count, watch.confirmed_at, table.hash)
        return state if self.component.sync_state is SyncState.SYNCED else None

    @property
    def list_if_current(self) -> list[ReportedValue]:
        """The answers to a request for the list; empty while the table is not complete and in sync."""
        key = self.state_key
        return [] if key is None else self._list_at(key)

    def check(self) -> None:
        """Have a table checked in the background that was not confirmed for a while.

        Nothing confirms extended parameters, nor announces a change: they are in doubt then.
        """
        self.component.watch.check(older_than=PROOF_AGE_MAX)
        age = anyio.current_time() - self.component.watch.confirmed_at
        if self.session.dialect.has_ack and age > PROOF_AGE_MAX and not self.is_loading:
            self.component.watch.unconfirmed()
            self.session.table.doubt()

    def doubt(self, *names: str) -> None:
        """Have the table checked, and serve none of its values before: something may have changed them.

        With names, these are read when they are asked for, unless a check finds them anyway.
        """
        if not names:
            self.component.watch.doubt()
        if not (names and may_confirm(self.session)):
            self.session.table.doubt(*names)

    def push(self, item: Change) -> None:
        """Take a change, and announce it unless it is a first value."""
        if item.new is not None and item.kind != "first" and is_decoded(self.session):
            self._announce(self, value_of(self.session, item.new))

    # lists

    def send_list(self, station: GroundStation) -> None:
        """Answer a request for the list: from the table, or as a fetch brings it."""
        self.check()
        is_partial = anyio.current_time() < self._partial_until and not self.is_loading
        if values := self.list_if_current or (listed(self.session) if is_partial else []):
            self._stream(station, values, set())
        else:
            self._listing[station] = set()
            self.load()

    def _stream(self, station: GroundStation, values: Iterable[ReportedValue], sent: set[int]) -> None:
        """Send the values of one list, each as it is by then, until one is in doubt or the component is lost.

        A heartbeat precedes the first one: a station may ask before it has heard one, and MAVProxy does not
        decode a PX4's integers then, although it would hear one while the vehicle itself answers.

        Args:
            station: to which they go.
            values: of the list, as they are now.
            sent: takes the index of each value.
        """
        table, generation = self.session.table, self.component.node.generation
        revision = table.revision

        def current() -> Iterator[Message]:
            for value in values:
                param = table.params.get(value.param_id)
                is_doubtful = param is not None and param.trust is Trust.CACHED
                if is_doubtful or self.is_lost or self.component.node.generation != generation:
                    return
                if not sent and self.heartbeat is not None:
                    yield self.heartbeat
                if table.revision != revision and param is not None:
                    now = value_of(self.session, param, index=value.param_index)
                    value = now._replace(param_count=value.param_count)
                sent.add(value.param_index)
                yield value

        station.stream((self, "list"), self.source, current())

    def load(self) -> anyio.Event:
        """Fetch the table, unless that is in progress; return the event of its end."""
        if self._loaded is None:
            self._loaded = anyio.Event()
            self.component.core.spawn(self._load, self._loaded)
        return self._loaded

    async def _load(self, loaded: anyio.Event) -> None:
        try:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._send_progress)
                try:
                    if (await self.component.fetch_all()).missing:
                        self._partial_until = anyio.current_time() + REMEMBERED_TIME
                except ParamClientError:
                    if not self.is_lost:
                        self._unserved_until = anyio.current_time() + REMEMBERED_TIME
                tasks.cancel_scope.cancel()
            with anyio.move_on_after(READ_TIMEOUT):
                await self._decoded()
            self._send_known()
        finally:
            self._loaded = None
            self._listing.clear()
            loaded.set()

    async def _decoded(self) -> None:
        """Wait until the values are those that the vehicle has sent."""
        while not is_decoded(self.session):  # noqa: ASYNC110 - no event for doubt
            await anyio.sleep(PROGRESS_INTERVAL)

    async def _send_progress(self) -> None:
        """Send what the fetch has brought to the stations that wait; request one value if it brings none.

        Reading it would end with a list where the answer waits behind the file on a slow radio.
        """
        channel, late_at = self.session.channel, anyio.current_time() + FIRST_VALUE_TIME
        while True:
            await anyio.sleep(PROGRESS_INTERVAL)
            if not self._send_known() and self._listing and anyio.current_time() >= late_at:
                late_at += FIRST_VALUE_TIME
                channel.send(self.session.dialect.request_read(channel.reads_from, 0))

    def _send_known(self) -> bool:
        """Send the values of the list that the stations do not have; another count begins it again.

        Return whether any value is known, for stations that wait.
        """
        if self._listing_count != self.session.table.count:
            self._listing_count = self.session.table.count
            for sent in self._listing.values():
                sent.clear()
        values = (self.list_if_current or listed(self.session)) if self._listing else []
        for station, sent in self._listing.items():
            self._stream(station, [value for value in values if value.param_index not in sent], sent)
        return bool(values)

    # single values

    def read(self, asker: Asker, which: Which) -> None:
        """Answer a read; the vehicle is asked for what the table does not have."""
        self.check()
        if value := self.known(which):
            asker.station.say(value, self.source)
            if is_stale(self.session, value.param_id, PROOF_AGE_MAX):
                self.component.core.spawn(read_again, self.session, value.param_id, 0.0)
        elif self._is_unknown(which):
            self._refuse([asker], which, ParamErrorCode.DOES_NOT_EXIST)
        elif self._reads.begins(which, asker):
            self.component.core.spawn(self._read, which, asker.station.reading)

    def known(self, which: Which) -> ReportedValue | None:
        """Return a value that is known to be the vehicle's, by name or index."""
        if which == HASH_CHECK:
            return None if self.state_key is None else digest_of(self.session)
        names = self.session.table.names
        name, index = (names.get(which), which) if isinstance(which, int) else (which, None)
        param = known_param(self.session, name)
        return None if param is None else value_of(self.session, param, index=index)

    def _is_unknown(self, which: Which) -> bool:
        is_beyond = isinstance(which, int) and which not in self.session.table.names
        is_listed = is_beyond and bool(self.list_if_current)
        is_px4 = self.session.identification.is_px4  # and an ArduPilot takes any case
        is_misspelt = is_px4 and isinstance(which, str) and self.session.spelled(which) != which
        return is_listed or is_misspelt or self._unknown.get(which, -math.inf) > anyio.current_time()

    async def _read(self, which: Which, turns: anyio.CapacityLimiter) -> None:
        try:
            self._say(self._reads[which], await self._find(which, turns))
        except (errors.UnknownParameter, errors.Refused) as error:
            if len(self._unknown) >= UNKNOWN_NAMES_MAX:
                self._unknown.clear()
            self._unknown[which] = anyio.current_time() + REMEMBERED_TIME
            self._refuse(self._reads[which], which, _code_of(error))
        finally:
            self._reads.end(which)

    async def _find(self, which: Which, turns: anyio.CapacityLimiter) -> ReportedValue:
        """Wait for the value if a fetch may bring it; then ask the vehicle.

        An index is a gap in a station's list, which the fetch closes. A hash is asked for at once:
        QGroundControl waits 1 s for it.
        """
        by_name = 0.0 if which == HASH_CHECK else LOADING_WAIT
        with anyio.move_on_after(READ_TIMEOUT if isinstance(which, int) else by_name):
            while self.is_loading and not self.known(which):  # noqa: ASYNC110 - no event for one value
                await anyio.sleep(PROGRESS_INTERVAL)
        if known := self.known(which):
            return known
        async with turns:
            value = await read(self.session, which)
        return value._replace(param_id=which) if isinstance(which, str) else value

    def set(self, asker: Asker, message: messages.ParamSet | messages.ParamExtSet) -> None:
        """Carry out a set as a verified write; one that repeats the newest of its parameter joins it."""
        wanted = (message.param_id, message.raw, message.param_type)
        newest = next((each for each in reversed(self._sets) if each[0] == message.param_id), (*wanted, 0))
        key = newest if newest[:3] == wanted else (*wanted, newest[3] + 1)
        if asker.station.endpoint.is_readonly:
            self._reject([asker], key, ParamErrorCode.READ_ONLY)
        elif not self.known(message.param_id) and self._is_unknown(message.param_id):
            self._reject([asker], key, ParamErrorCode.DOES_NOT_EXIST)
        elif self._sets.begins(key, asker):
            self.component.core.spawn(self._set, key, asker)

    async def _set(self, key: SetKey, first: Asker) -> None:
        """Write a value, and write it again while a result may wait behind the list of a fetch.

        Where that keeps the radio's queue full, a value that it has brought before is read as late.
        """
        code, is_open, table = int(ParamErrorCode.COMPONENT_NOT_FOUND), True, self.session.table
        try:
            while is_open:
                async with first.station.writing, task_group() as tasks:
                    began, beats_min = anyio.current_time(), self.beats + OVERTAKING_BEATS
                    known = table.names.get(min(table.names, default=-1), key[0]) if self.is_loading else None
                    tasks.cancel_scope.deadline = began + SET_TIMEOUT
                    tasks.start_soon(self._wait_longer, key, tasks.cancel_scope)
                    if known is not None:
                        tasks.start_soon(read_again, self.session, known, began)
                    code = await self._write(key, f"station {first.system}/{first.component}")
                    tasks.cancel_scope.cancel()
                is_late = table.moments.get(known or "", began) - began > SET_TIMEOUT / 2
                may_come = known is not None and (self.beats < beats_min or is_late)
                is_open = code == ParamErrorCode.COMPONENT_NOT_FOUND and may_come
        except ParamClientError as error:
            code = _code_of(error)
        finally:
            askers = self._sets.end(key)
        if code:
            self._reject(askers, key, code)
        if code == ParamErrorCode.COMPONENT_NOT_FOUND:  # it may have the new value
            await read_again(self.session, self.session.spelled(key[0]), anyio.current_time())

    async def _wait_longer(self, key: SetKey, scope: anyio.CancelScope) -> None:
        """Pass it on that a component works on a set of an extended parameter, and wait for its end then."""
        with self.session.channel.inbox((messages.ParamExtAck, key[0])) as inbox:
            while isinstance(message := await inbox.next(), messages.ParamExtAck):
                if message.param_result == ExtAckResult.IN_PROGRESS:
                    scope.deadline = math.inf
                    self._say(self._sets[key], message)

    async def _write(self, key: SetKey, author: str) -> ParamErrorCode:
        """Write a value, and acknowledge it to the askers.

        A component that takes values byte by byte takes those of its own type only.

        Raises:
            ParamClientError: as from `Component.set`.
        """
        session, is_extended = self.session, self.session.dialect.has_ack
        given, raw, number, _ = key
        name = session.spelled(given)
        await self._decoded()
        askers, params = self._sets[key], session.table.params
        if name not in params or params[name].trust is Trust.CACHED:
            await read(session, name)
        if name not in params:  # it is not stored
            return ParamErrorCode.DOES_NOT_EXIST
        known = params[name].type
        if number != known and (is_extended or session.table.encoding is not Encoding.C_CAST):
            return ParamErrorCode.TYPE_MISMATCH
        value = session.dialect.param(name, raw, known, None, session.table.encoding).settable
        done = value_of(session, (await self.component.set(name, value, author=author)).param)
        if is_extended:
            self._say(askers, messages.ParamExtAck(given, done.raw, number, ExtAckResult.ACCEPTED))
        else:
            self._announce(self, done)
        return ParamErrorCode.NO_ERROR

    def _say(self, askers: Iterable[Asker], message: Message) -> None:
        for asker in () if self.is_lost else askers:
            asker.station.say(message, self.source, is_answer=False)

    def _reject(self, askers: Iterable[Asker], key: SetKey, code: int) -> None:
        """Refuse a set, and show the value that stays."""
        name, raw, number, _ = key
        value = self.known(name)
        if self.session.dialect.has_ack:
            is_value = code in (ExtAckResult.VALUE_UNSUPPORTED, ParamErrorCode.TYPE_MISMATCH)
            result = ExtAckResult.VALUE_UNSUPPORTED if is_value else ExtAckResult.FAILED
            raw, number = (raw, number) if value is None else (value.raw, value.param_type)
            self._say(askers, messages.ParamExtAck(name, raw, number, result))
            return
        self._refuse(askers, name, code)
        if value is not None and code in (ParamErrorCode.READ_ONLY, ParamErrorCode.VALUE_OUT_OF_RANGE):
            self._say(askers, value)

    def _refuse(self, askers: Iterable[Asker], which: Which, code: int) -> None:
        """Send a PARAM_ERROR to each asker, with its ids: others would take it for their own requests."""
        name, index = (which, -1) if isinstance(which, str) else ("", which)
        for asker in () if self.session.dialect.has_ack else askers:
            self._say([asker], messages.ParamError(asker.system, asker.component, name, index, code))


def _code_of(error: ParamClientError) -> int:
    """Return the PARAM_ERROR of an error."""
    codes = (code for kinds, code in CODES if isinstance(error, kinds))
    return error.code if isinstance(error, errors.Refused) else next(codes)
