"""KeptTable: one component's parameters, for which the gateway answers every ground station."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

import anyio

from paramclient.client.component import Component
from paramclient.client.streams import Stream
from paramclient.errors import (
    AmbiguousVehicle,
    ExtAckResult,
    ParamClientError,
    ParamErrorCode,
    Refused,
    TypeMismatch,
    UnknownParameter,
    UsageError,
    ValueNotApplied,
)
from paramclient.model.ext_values import EXT_VALUE_SIZE, ext_bytes, ext_param
from paramclient.model.values import Encoding, Param, Trust, WireValue, decode_value
from paramclient.protocol.dialect import ReportedValue
from paramclient.protocol.events import Change
from paramclient.protocol.ftp import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.reads import read
from paramclient.protocol.watch import SyncState
from paramclient.service.answers import (
    FileQuery,
    PackedTable,
    checksum_answer,
    digest_of,
    file_answers,
    is_complete,
    listed,
    open_answer,
    packed,
    path_of,
    reply,
    value_of,
)
from paramclient.service.stations import GroundStation
from paramclient.wire.messages import (
    HASH_CHECK,
    FileTransfer,
    Message,
    ParamError,
    ParamExtAck,
    ParamExtSet,
    ParamSet,
)

__all__ = ["Asker", "KeptTable"]

PROOF_AGE_MAX: Final = 5.0
"""Seconds since the vehicle last confirmed the table, above which an answer has it checked in the
background."""
SILENT_AFTER: Final = 60.0
"""Seconds of silence after which a component without heartbeats counts as lost."""
UNSERVED_TIME: Final = 30.0
"""Seconds for which requests pass to a component that did not answer the gateway's own fetch."""
STREAM_INTERVAL: Final = 0.05
"""Seconds between two looks for values that a running fetch has brought."""
FIRST_VALUE_TIME: Final = 1.0
"""Seconds without a value of a running fetch, after which one is read beside it: MAVSDK repeats its list
after 2 s and gives up at the sixth."""
LOADING_WAIT: Final = 1.0
"""Seconds that a read waits for the fetch to bring the value before the vehicle is asked."""
READ_TIMEOUT: Final = 3.0
"""Seconds for a value or a name that the table does not have."""
SET_TIMEOUT: Final = 2.9
"""Seconds for a verified write: a station has a result within 3 s."""
FILE_WAIT: Final = 2.5
"""Seconds that the opening of the file waits for a fetch; then it passes to the vehicle."""
ASKED_AT_ONCE: Final = 4
"""Reads by stations that the vehicle is asked for at once."""
PENDING_MAX: Final = 1_000
"""Reads, and sets, that wait for one component, at most; further ones are dropped, as on a full link."""
UNKNOWN_TIME: Final = 30.0
"""Seconds for which a name that the vehicle does not have is remembered."""
OPEN_FILES_MAX: Final = 64
"""Files that stations have open of one component, at most; the oldest is closed first."""
CHECKED_NAMES_MAX: Final = 4_096
"""Names that are remembered as unknown."""

Which: TypeAlias = "str | int"


class Asker(NamedTuple):
    """A station, and the ids under which it asks.

    Attributes:
        station: to which the answer goes.
        system, component: its ids.
        may_write: whether its sets are carried out.
    """

    station: GroundStation
    system: int
    component: int
    may_write: bool = True


@dataclass(slots=True)
class _Progress:
    """What a station that waits for a list has of it."""

    count: int | None = None
    sent: set[int] = field(default_factory=set)


@dataclass(slots=True)
class _OpenFile:
    """A file that a station has open."""

    query: FileQuery
    table: PackedTable
    sequence: int
    content: bytes | None = None


class _Announcer(Stream[Change]):
    """Passes each change on at once."""

    most = 0

    def __init__(self, take: Callable[[Change], None]) -> None:
        super().__init__()
        self._take = take

    def push(self, item: Change) -> None:
        self._take(item)


class KeptTable:
    """The parameters of one component in one protocol, plain or extended.

    Args:
        component: with plain or with extended parameters.
        announce: called with each value that has changed, for all stations.

    Attributes:
        component, session, source: of the component.
    """

    def __init__(self, component: Component, announce: Callable[[KeptTable, Message], None]) -> None:
        self.component = component
        self.session = component.session
        self.source = (component.system, component.component)
        self._announce = announce
        self._changes = 0
        self._snapshot: tuple[object, list[ReportedValue]] | None = None
        self._packed: tuple[object, PackedTable | None] | None = None
        self._unserved_until = -math.inf
        self._unknown: dict[Which, float] = {}
        self._reads: dict[Which, set[Asker]] = {}
        self._sets: dict[tuple[str, bytes, int], set[Asker]] = {}
        self._waiting: dict[GroundStation, _Progress] = {}
        self._opening: set[Hashable] = set()
        self._uploads: set[Hashable] = set()
        self._files: dict[Hashable, _OpenFile] = {}
        self._loaded: anyio.Event | None = None  # while a fetch runs
        self._asking = anyio.CapacityLimiter(ASKED_AT_ONCE)
        self._announcer = _Announcer(self._changed)  # a stream lives as long as it is referenced
        component.subscribers.add(self._announcer)

    # the state

    @property
    def is_lost(self) -> bool:
        """Whether the component is lost: nothing is answered in its name."""
        return self.component.node.presence.is_lost or self.component.silence > SILENT_AFTER

    @property
    def is_kept(self) -> bool:
        """Whether the gateway answers for the component; otherwise requests pass to it."""
        node, now = self.component.node, anyio.current_time()
        is_usable = not (self.session.table.left_out or node.has_rival(now))
        return is_usable and node.identification.has_parameters and now >= self._unserved_until

    @property
    def withholds(self) -> bool:
        """Whether values of the component are answers to the gateway: it announces changes itself."""
        return self.session.table.is_complete or self._loaded is not None or self.session.fetching.is_running

    def _known_list(self) -> list[ReportedValue] | None:
        """Return the answers to a list; None while the table is not complete and in sync."""
        table = self.session.table
        if self.component.sync_state is not SyncState.SYNCED:
            return None
        key = self._state_key()
        if self._snapshot is None or self._snapshot[0] != key:
            if not is_complete(self.session):
                return None
            self._snapshot = (key, listed(self.session))
        assert table.count is not None
        return self._snapshot[1]

    def _known_file(self) -> PackedTable | None:
        """Return the entries of the file; None while the table does not have them."""
        if self._known_list() is None:
            return None
        key = self._state_key()
        if self._packed is None or self._packed[0] != key:
            self._packed = (key, packed(self.session))
        return self._packed[1]

    def _state_key(self) -> object:
        table = self.session.table
        return (self._changes, table.count, self.component.watch.confirmed_at, table.hash)

    def _changed(self, change: Change) -> None:
        self._changes += 1
        if change.new is not None:
            self._unknown.pop(change.name, None)
            if change.kind != "first" and not self.is_lost:
                self._announce(self, value_of(self.session, change.new))

    # lists

    def list(self, station: GroundStation) -> None:
        """Answer a request for the list: from the table, or as a fetch brings it."""
        if self.is_lost:
            return
        values = self._known_list()
        if values is not None:
            self.component.watch.check(older_than=PROOF_AGE_MAX)
            station.stream((self, "list"), self.source, self._current(values))
        elif station not in self._waiting:
            self._waiting[station] = _Progress()
            self.load()

    def _current(self, values: Iterable[ReportedValue]) -> Iterator[Message]:
        """Yield the values of one list, each as it is by then, until the component is lost or restarts."""
        node, before = self.component.node, self._changes
        generation = node.generation
        for value in values:
            if self.is_lost or node.generation != generation:
                return
            if self._changes != before and value.param_id in self.session.table.params:
                now = value_of(self.session, self.session.table.params[value.param_id])
                value = now._replace(param_count=value.param_count, param_index=value.param_index)
            yield value

    def doubt(self) -> None:
        """Have the table checked soon: a station may have changed values that are not announced."""
        self.component.watch.doubt()

    def load(self) -> None:
        """Fetch the table, unless that is in progress; all stations that wait share the fetch."""
        if self._loaded is None:
            self._loaded = anyio.Event()
            self.component.core.spawn(self._load)

    async def _load(self) -> None:
        try:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._stream_progress)
                try:
                    await self.component.fetch_all()
                except ParamClientError:
                    self._unserved_until = anyio.current_time() + UNSERVED_TIME
                tasks.cancel_scope.cancel()
            values = self._known_list()
            for station, progress in self._waiting.items():
                self._send_known(station, progress)
                if values is not None and progress.count != values[0].param_count:
                    station.stream((self, "list"), self.source, self._current(values))
        finally:
            if self._loaded is not None:
                self._loaded.set()
            self._loaded = None
            self._waiting.clear()

    async def _stream_progress(self) -> None:
        """Send what the fetch has brought to the stations that wait; read one value if it brings none."""
        began, has_asked = anyio.current_time(), False
        while True:
            await anyio.sleep(STREAM_INTERVAL)
            for station, progress in list(self._waiting.items()):
                self._send_known(station, progress)
            is_late = anyio.current_time() - began >= FIRST_VALUE_TIME
            if is_late and not has_asked and any(not each.sent for each in self._waiting.values()):
                has_asked = True
                self.component.core.spawn(read, self.session, 0)

    def _send_known(self, station: GroundStation, progress: _Progress) -> None:
        """Send the values of the list that the station does not have; another count begins it again."""
        table = self.session.table
        values = self._known_list()
        if values is not None and not progress.sent:
            progress.count = values[0].param_count
            progress.sent.update(table.names)
            station.stream((self, "list"), self.source, self._current(values))
            return
        if progress.count != table.count:
            progress.count = table.count
            progress.sent.clear()
        for index, name in sorted(table.names.items()):
            param = table.params.get(name)
            if index not in progress.sent and param is not None and param.trust is not Trust.CACHED:
                progress.sent.add(index)
                value = value_of(self.session, param, by_name=False)
                station.say(value._replace(param_index=index), self.source)

    # single values

    def read(self, asker: Asker, which: Which) -> None:
        """Answer a read; the vehicle is asked for what the table does not have."""
        if self.is_lost:
            return
        message = self._known(which)
        if message is not None:
            if which == HASH_CHECK:
                self.component.watch.check(older_than=PROOF_AGE_MAX)
            asker.station.say(message, self.source)
        elif self._is_unknown(which):
            self._refuse([asker], which, ParamErrorCode.DOES_NOT_EXIST)
        elif which in self._reads:
            self._reads[which].add(asker)
        elif len(self._reads) < PENDING_MAX:
            self._reads[which] = {asker}
            self.component.core.spawn(self._read, which)

    def has(self, which: Which) -> bool:
        """Return whether the table has the value."""
        return self._known(which) is not None

    def _known(self, which: Which) -> Message | None:
        table = self.session.table
        if which == HASH_CHECK:
            is_current = self.component.sync_state is SyncState.SYNCED
            return digest_of(self.session) if is_current else None
        name = table.names.get(which) if isinstance(which, int) else which
        param = None if name is None else table.params.get(name)
        if param is None or param.trust is Trust.CACHED:
            return None
        value = value_of(self.session, param, by_name=isinstance(which, str))
        return value._replace(param_index=which) if isinstance(which, int) else value

    def _is_unknown(self, which: Which) -> bool:
        is_beyond = isinstance(which, int) and which not in self.session.table.names
        if is_beyond and self._known_list() is not None:
            return True
        return self._unknown.get(which, -math.inf) > anyio.current_time()

    async def _read(self, which: Which) -> None:
        try:
            with anyio.move_on_after(READ_TIMEOUT):
                message = await self._find(which)
                for asker in self._reads[which]:
                    asker.station.say(message, self.source)
        except (UnknownParameter, Refused) as error:
            if len(self._unknown) >= CHECKED_NAMES_MAX:
                self._unknown.clear()
            self._unknown[which] = anyio.current_time() + UNKNOWN_TIME
            self._refuse(self._reads[which], which, _code_of(error))
        finally:
            del self._reads[which]

    async def _find(self, which: Which) -> Message:
        """Wait for the value if a fetch may bring it; then ask the vehicle."""
        if self._known_list() is None:
            self.load()
            with anyio.move_on_after(LOADING_WAIT):
                while self._loaded is not None and not self.has(which):  # noqa: ASYNC110 - no event for one
                    await anyio.sleep(STREAM_INTERVAL)
        known = self._known(which)
        if known is not None:
            return known
        async with self._asking:
            message = await read(self.session, which)
        return message._replace(param_id=which) if isinstance(which, str) else message

    def set(self, asker: Asker, message: ParamSet | ParamExtSet) -> None:
        """Carry out a set as a verified write; equal ones at the same time are one."""
        if self.is_lost:
            return
        name, key = message.param_id, (message.param_id, message.raw, message.param_type)
        if asker.station.endpoint.is_readonly:
            self._reject([asker], key, ParamErrorCode.READ_ONLY)
        elif not asker.may_write:
            self._reject([asker], key, ParamErrorCode.PERMISSION_DENIED)
        elif key in self._sets:
            self._sets[key].add(asker)
        elif len(self._sets) < PENDING_MAX:
            self._sets[key] = {asker}
            self.component.core.spawn(self._set, key, f"station {asker.system}/{asker.component}", name)

    async def _set(self, key: tuple[str, bytes, int], author: str, name: str) -> None:
        code: int = ParamErrorCode.COMPONENT_NOT_FOUND  # it does not answer
        try:
            with anyio.move_on_after(SET_TIMEOUT):
                value = await self._value_to_set(*key)
                result = await self.component.set(name, value, author=author)
                self._acknowledge(self._sets[key], key, result.param)
                return
        except ParamClientError as error:
            code = _code_of(error)
        finally:
            askers = self._sets.pop(key)
        self._reject(askers, key, code)

    async def _value_to_set(self, name: str, raw: bytes, number: int) -> WireValue:
        """Return the value in a set.

        Raises:
            TypeMismatch: the component takes values byte by byte, and the type is another one.
        """
        table = self.session.table
        known = table.params.get(name)
        if known is None or known.trust is Trust.CACHED:
            await read(self.session, name)
            known = table.params[name]
        is_cast = table.encoding is Encoding.C_CAST and not self.session.dialect.has_ack
        if number != known.type_number and not is_cast:
            system, component = self.source
            what = f"{name} of {system}/{component} has another type"
            raise TypeMismatch(what, system=system, component=component, name=name)
        if self.session.dialect.has_ack:
            return ext_param(name, raw, number).settable
        value, _ = decode_value(raw, known.type_number, table.encoding)
        return value

    def _acknowledge(self, askers: Iterable[Asker], key: tuple[str, bytes, int], param: Param) -> None:
        for asker in askers:
            if self.session.dialect.has_ack:
                raw = ext_bytes(param).ljust(EXT_VALUE_SIZE, b"\0")
                ack = ParamExtAck(key[0], raw, param.type_number, ExtAckResult.ACCEPTED)
                asker.station.say(ack, self.source)
            else:
                asker.station.say(value_of(self.session, param), self.source)

    def _reject(self, askers: Iterable[Asker], key: tuple[str, bytes, int], code: int) -> None:
        """Refuse a set, and show the value that stays."""
        name, raw, number = key
        if self.session.dialect.has_ack:
            is_value = code in (ExtAckResult.VALUE_UNSUPPORTED, ParamErrorCode.TYPE_MISMATCH)
            result = ExtAckResult.VALUE_UNSUPPORTED if is_value else ExtAckResult.FAILED
            for asker in askers:
                asker.station.say(ParamExtAck(name, raw, number, result), self.source)
            return
        self._refuse(askers, name, code)
        value = self._known(name)
        if value is not None and code in (ParamErrorCode.READ_ONLY, ParamErrorCode.VALUE_OUT_OF_RANGE):
            for asker in askers:
                asker.station.say(value, self.source)

    def _refuse(self, askers: Iterable[Asker], which: Which, code: int) -> None:
        """Send a PARAM_ERROR to each asker, with its ids: others would take it for their own requests."""
        name, index = (which, -1) if isinstance(which, str) else ("", which)
        for station, system, component, _ in askers:
            if not (self.session.dialect.has_ack or self.is_lost):
                station.say(ParamError(system, component, name, index, code), self.source)

    # the file

    def take_file_request(self, asker: Asker, payload: bytes, route: Callable[[], None]) -> bool:
        """Answer a request of MAVFTP about the parameter file; return whether it was one.

        Args:
            asker: the station.
            payload: of the message.
            route: passes the request to the vehicle.
        """
        request = Packet.unpack(payload)
        key: Hashable = (asker.station, asker.system, asker.component, request.session)
        match request.opcode:
            case Opcode.OPEN_FILE_RO | Opcode.CALC_FILE_CRC32:
                if self._is_new(key, request):
                    del self._files[key]
                query = FileQuery.of(path_of(request))
                return query is not None and self._begin_file(asker, key, request, query, route)
            case Opcode.READ_FILE | Opcode.BURST_READ_FILE if key in self._files:
                self._send_file(asker, key, request)
                return True
            case Opcode.TERMINATE_SESSION | Opcode.RESET_SESSIONS:
                if self._uploads:
                    self._uploads.discard(key)
                    self.doubt()
                if self._files.pop(key, None) is not None:
                    self._say(asker, reply(request))
                    return True
            case Opcode.CREATE_FILE if FileQuery.of(path_of(request)) is not None:
                self._uploads.add(key)
        return False

    def _is_new(self, key: Hashable, request: Packet) -> bool:
        file = self._files.get(key)
        return (
            request.opcode == Opcode.OPEN_FILE_RO and file is not None and file.sequence != request.sequence
        )

    def _begin_file(
        self, asker: Asker, key: Hashable, request: Packet, query: FileQuery, route: Callable[[], None]
    ) -> bool:
        """Open the file, or answer its checksum; wait for a fetch that may bring the table."""
        identification, serves = self.session.identification, self.session.serves_file
        if self.is_lost:
            return True
        if not (serves or (serves is None and identification.is_ardupilot and identification.may_serve_file)):
            return False
        opening = (key, request.opcode, request.sequence)
        if opening in self._opening:
            return True
        if self._known_list() is None:
            self._opening.add(opening)
            self.component.core.spawn(self._begin_file_later, asker, key, request, query, route)
            return True
        table = self._known_file()
        if table is None or query.start >= len(table.rows):
            return False
        self.component.watch.check(older_than=PROOF_AGE_MAX)
        if request.opcode == Opcode.CALC_FILE_CRC32:
            self._say(asker, checksum_answer(request, table, query))
            return True
        if key not in self._files:
            self._files[key] = _OpenFile(query, table, request.sequence)
            if len(self._files) > OPEN_FILES_MAX:
                del self._files[next(iter(self._files))]
        self._say(asker, open_answer(request, self._files[key].table))
        return True

    async def _begin_file_later(
        self, asker: Asker, key: Hashable, request: Packet, query: FileQuery, route: Callable[[], None]
    ) -> None:
        self.load()
        try:
            with anyio.move_on_after(FILE_WAIT):
                if self._loaded is not None:
                    await self._loaded.wait()
        finally:
            self._opening.discard((key, request.opcode, request.sequence))
        is_known = self._known_list() is not None
        if not (is_known and self._begin_file(asker, key, request, query, route)):
            route()

    def _send_file(self, asker: Asker, key: Hashable, request: Packet) -> None:
        """Send a part of an open file: the first read says in which pieces it is read."""
        file = self._files[key]
        if file.content is None:
            size = min(request.size or DATA_SIZE_MAX, DATA_SIZE_MAX)
            file.content = file.table.file(file.query, DATA_SIZE_MAX if self._is_px4 else size)
        answers = (
            FileTransfer(0, asker.system, asker.component, each.pack())
            for each in file_answers(request, file.content)
            if not self.is_lost
        )
        if request.opcode == Opcode.READ_FILE:
            for answer in answers:
                asker.station.say(answer, self.source)
        else:
            asker.station.stream((self, "file", key), self.source, answers)

    @property
    def _is_px4(self) -> bool:
        return self.session.identification.is_px4

    def _say(self, asker: Asker, packet: Packet) -> None:
        answer = FileTransfer(0, asker.system, asker.component, packet.pack())
        asker.station.say(answer, self.source)


def _code_of(error: ParamClientError) -> int:
    """Return the PARAM_ERROR of an error."""
    match error:
        case UnknownParameter():
            return ParamErrorCode.DOES_NOT_EXIST
        case Refused(code=code):
            return code
        case TypeMismatch():
            return ParamErrorCode.TYPE_MISMATCH
        case AmbiguousVehicle():
            return ParamErrorCode.PERMISSION_DENIED
        case UsageError() | ValueNotApplied():
            return ParamErrorCode.VALUE_OUT_OF_RANGE
        case _:
            return ParamErrorCode.COMPONENT_NOT_FOUND
