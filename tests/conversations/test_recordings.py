"""Recordings of real autopilots as dialogues: requests get the recorded answers after the recorded times."""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Hashable
from dataclasses import replace
from heapq import heappop, heappush

import anyio
import pytest

from paramclient.errors import UnknownParameter
from paramclient.model.values import Encoding, Param, ParamType
from paramclient.protocol.dialect import PLAIN
from paramclient.protocol.fetch import fetch_all
from paramclient.protocol.ftp import Opcode, Packet, read_file
from paramclient.protocol.reads import read
from paramclient.protocol.session import Session
from paramclient.protocol.station import Station
from paramclient.protocol.writes import write
from paramclient.sim import ardupilot_table, px4_table
from paramclient.wire import messages
from tests.conversations.virtual import converse, messages_in, talking
from tests.recordings import DATA, NAMES, from_ground, from_vehicle
from tests.recordings import read as records_of

PX4_HASH = 0xCF579589


def kinds_of(message: messages.Message) -> list[Hashable]:
    """Return the kinds of requests that a message of a vehicle may answer, the likeliest first."""
    match message:
        case messages.ParamValue(param_id=name, param_index=index):
            return [("name", name), ("index", index), "list"]
        case messages.CommandAck() | messages.AutopilotVersion():
            return ["command"]
        case messages.FileTransfer():
            packet = Packet.unpack(message.payload)
            return [("file", packet.requested, (packet.sequence - 1) & 0xFFFF), ("file", packet.requested)]
    return []


def kind_of(message: messages.Message, path: bytes) -> Hashable:
    """Return the kind of a request; of one of MAVFTP, with the file that was opened last."""
    match message:
        case messages.ParamRequestRead(param_index=index) if index >= 0:
            return "index", index
        case messages.ParamRequestRead(param_id=name):
            return "name", name
        case messages.ParamSet(param_id=name, raw=raw):
            return "set", name, raw
        case messages.ParamRequestList():
            return "list"
        case messages.CommandLong():
            return "command"
        case messages.FileTransfer():
            packet = Packet.unpack(message.payload)
            return "file", packet.opcode, packet.offset, path
    return None


class Recorded:
    """An endpoint that answers as the vehicle of a recording did; a repeated request gets the last answer.

    Heartbeats are those of the recording, once a second.
    """

    def __init__(self, name: str) -> None:
        self.unanswered: list[messages.Message] = []
        self._answers: defaultdict[Hashable, list[list[tuple[float, messages.Message]]]] = defaultdict(list)
        self._due: list[tuple[float, int, messages.Message]] = []
        self._number = 0
        self._path = b""
        requests: dict[Hashable, list[tuple[float, messages.Message]]] = {}
        began: dict[int, float] = {}
        ground = [(each.time, each.message) for each in from_ground(name) if each.message is not None]
        merged = [*((*each, True) for each in ground), *((*each, False) for each in from_vehicle(name))]
        merged.sort(key=lambda each: each[0])
        self._beat = next(
            message for _, message in from_vehicle(name) if type(message).__name__ == "Heartbeat"
        )
        for time, message, is_request in merged:
            if is_request:
                answers: list[tuple[float, messages.Message]] = []
                self._answers[self._kind_of(message)].append(answers)
                began[id(answers)] = time
                requests[self._kind_of(message)] = answers
                if isinstance(message, messages.ParamSet):
                    requests["name", message.param_id] = answers
                if isinstance(message, messages.FileTransfer):
                    packet = Packet.unpack(message.payload)
                    requests["file", packet.opcode] = answers
                    answers.append((-1.0, message))
                continue
            found = next((requests[each] for each in kinds_of(message) if each in requests), None)
            if found is not None:
                found.append((time - began[id(found)], message))

    def receive(self, data: bytes, now: float) -> None:
        """Answer the requests in a datagram."""
        for message in messages_in(data):
            kind = self._kind_of(message)
            recorded = self._answers.get(kind)
            if kind is None or not recorded:
                self.unanswered.append(message)
                continue
            answers = recorded.pop(0) if len(recorded) > 1 else recorded[0]
            for delay, answer in answers:
                if delay >= 0:
                    self._say(now + delay, self._renumbered(answer, message, answers[0][1]))

    def _kind_of(self, message: messages.Message) -> Hashable:
        if isinstance(message, messages.FileTransfer):
            packet = Packet.unpack(message.payload)
            self._path = packet.data if packet.opcode == Opcode.OPEN_FILE_RO else self._path
        return kind_of(message, self._path)

    def _renumbered(
        self, answer: messages.Message, request: messages.Message, recorded: messages.Message
    ) -> messages.Message:
        """Return an answer of MAVFTP with the numbers of our request."""
        if not isinstance(answer, messages.FileTransfer):
            return answer
        assert isinstance(request, messages.FileTransfer)
        assert isinstance(recorded, messages.FileTransfer)
        ours, theirs = Packet.unpack(request.payload), Packet.unpack(recorded.payload)
        packet = Packet.unpack(answer.payload)
        sequence = ours.sequence + packet.sequence - theirs.sequence
        payload = packet._replace(sequence=sequence & 0xFFFF, session=ours.session).pack()
        return replace(answer, payload=payload)

    def _say(self, at: float, message: messages.Message) -> None:
        self._number += 1
        heappush(self._due, (at, self._number, message))

    def tick(self, now: float) -> None:
        """Begin with the heartbeats."""
        if not self._number:
            for second in range(120):
                self._say(now + second, self._beat)
        self._now = now

    def next_deadline(self) -> float | None:
        """Return when the next message is due."""
        return self._due[0][0] if self._due else None

    def data_to_send(self) -> list[bytes]:
        """Return the messages that are due."""
        out = []
        while self._due and self._due[0][0] <= self._now:
            _, number, message = heappop(self._due)
            out.append(messages.encode(message, system=1, component=1, sequence=number & 0xFF))
        return out


def bits(params: dict[str, Param]) -> dict[str, tuple[int, int]]:
    """Return type and bits of the parameters with an index."""
    return {name: (each.type, each.bits) for name, each in params.items() if each.index is not None}


PX4_TABLE = {row.name: (int(row.type), row.bits) for row in px4_table()}
ARDUPILOT_TABLE = {row.name: (int(row.type), row.bits) for row in ardupilot_table()}


async def named(session: Session, which: str | int) -> Param:
    """Read a parameter."""
    return session.table.params[(await read(session, which)).param_id]


async def test_px4s_list_is_complete_and_its_hash_is_proven() -> None:
    async with talking(Recorded("px4_full_download")) as (conversation, session):
        result = await fetch_all(session)
        assert (result.source, result.count, result.hash) == ("stream", 903, PX4_HASH)
        assert bits(dict(result.params)) == PX4_TABLE
        assert session.table.volatile == {row.name for row in px4_table() if row.volatile}
        assert len(conversation.sent_of(messages.ParamRequestList)) == 1
        assert result.notes == ()


async def test_ardupilots_list_is_complete() -> None:
    async with talking(Recorded("ardupilot_full_download")) as (conversation, session):
        session.serves_file = False
        result = await fetch_all(session)
        assert (result.source, result.count, result.hash) == ("stream", 1382, None)
        assert bits(dict(result.params)) == ARDUPILOT_TABLE
        assert len(conversation.sent_of(messages.ParamRequestList)) == 1


async def test_ardupilots_file_with_its_defaults() -> None:
    async with talking(Recorded("ardupilot_ftp_download")) as (conversation, session):
        conversation.hear(messages.AutopilotVersion(64495, 0x04060000, uid=7))
        result = await fetch_all(session)
        assert (result.source, result.count) == ("ftp", 1382)
        assert bits(dict(result.params)) == ARDUPILOT_TABLE
        assert (
            sum(each.default is not None and each.default != each.value for each in result.params.values())
            == 41
        )
        requests = [
            Packet.unpack(each.payload).opcode for each in conversation.sent_of(messages.FileTransfer)
        ]
        assert requests == [Opcode.OPEN_FILE_RO, Opcode.BURST_READ_FILE, Opcode.TERMINATE_SESSION]


async def test_the_file_is_the_recorded_one_byte_by_byte() -> None:
    async with converse(Recorded("ardupilot_ftp_download")) as conversation:
        channel = (await conversation.node()).channel
        content = await read_file(channel, "@PARAM/param.pck")
        assert content == (DATA / "ardupilot_param.pck").read_bytes()


async def test_reads_and_sets_of_px4() -> None:
    async with talking(endpoint := Recorded("px4_get_set")) as (_, session):
        before = await named(session, "MPC_XY_VEL_MAX")
        assert (before.type, before.value) == (ParamType.REAL32, 12.0)
        assert (await named(session, 100)).index == 100
        for unknown in ("NO_SUCH_PARAM", 5000):
            with pytest.raises(UnknownParameter):
                await read(session, unknown)
        digest = await read(session, messages.HASH_CHECK)
        assert (digest.param_type, digest.param_count) == (ParamType.UINT32, 903)
        sets = [
            each.message for each in from_ground("px4_get_set") if isinstance(each.message, messages.ParamSet)
        ]
        (wanted,) = struct.unpack("<f", sets[0].raw)
        result = await write(session, "MPC_XY_VEL_MAX", wanted)
        assert (result.status, result.actual, result.attempts) == ("accepted", wanted, 1)
        assert endpoint.unanswered


async def test_reads_and_sets_of_ardupilot() -> None:
    async with talking(Recorded("ardupilot_get_set")) as (_, session):
        assert (await named(session, "RTL_ALT")).index is None  # its answer has 65535
        assert (await named(session, 100)).index == 100
        for unknown in ("NO_SUCH_PARAM", 5000):
            with pytest.raises(UnknownParameter):
                await read(session, unknown)
        sets = [
            each.message
            for each in from_ground("ardupilot_get_set")
            if isinstance(each.message, messages.ParamSet)
        ]
        for request, status in zip(sets[:2], ("adjusted", "accepted"), strict=True):
            (wanted,) = struct.unpack("<f", request.raw)
            result = await write(session, "RTL_ALT", wanted)
            assert isinstance(result.actual, int)
            assert (result.status, result.actual) == (status, int(wanted))
        result = await write(session, "EK2_ENABLE", 1)
        assert (result.status, session.table.count) == ("accepted", 1434)


@pytest.mark.parametrize("name", ["ardupilot_30_sets", "px4_20_sets"])
async def test_many_sets_at_once_are_acknowledged_as_they_were(name: str) -> None:
    async with talking(Recorded(name)) as (conversation, session):
        sets = [each.message for each in from_ground(name) if isinstance(each.message, messages.ParamSet)]
        first = {request.param_id: request for request in reversed(sets)}
        values = [each for _, each in from_vehicle(name) if isinstance(each, messages.ParamValue)]
        types = {each.param_id: each.param_type for each in reversed(values)}
        for param_id in first:  # the types, which the recording does not have reads for
            conversation.hear(messages.ParamValue(param_id, bytes(4), types[param_id], 10, messages.NO_INDEX))
        async with anyio.create_task_group() as tasks:
            for request in first.values():
                encoding = session.table.encoding
                param = PLAIN.param(request.param_id, request.raw, types[request.param_id], None, encoding)
                tasks.start_soon(write, session, request.param_id, param.settable)
        assert anyio.current_time() < 5.0
        for request in first.values():
            held = session.table.params[request.param_id]
            expected = PLAIN.param(
                request.param_id, request.raw, types[request.param_id], None, session.table.encoding
            )
            assert held.value == expected.value


@pytest.mark.parametrize("name", NAMES)
async def test_a_listener_takes_every_value_and_sends_nothing(name: str) -> None:
    sent: list[bytes] = []
    options = {"is_stream": False, "spawn": lambda *work: None, "listens_only": True}
    station = Station(link="log", send=lambda data, peer: sent.append(data), **options)  # type: ignore[arg-type]
    last: dict[str, bytes] = {}
    for record in records_of(name):
        station.receive(record.data, "peer", record.time)
        if isinstance(record.message, messages.ParamValue) and record.message.param_id != messages.HASH_CHECK:
            last[record.message.param_id.upper()] = record.message.raw  # one read was of rtl_alt
    session = station.nodes[1, 1].plain
    assert not sent
    assert set(session.table.params) == set(last)
    encoding = session.table.encoding
    assert encoding is (Encoding.BYTEWISE if name.startswith("px4") else Encoding.C_CAST)
    for param_id, raw in last.items():
        held = session.table.params[param_id]
        assert held.bits == PLAIN.param(param_id, raw, held.type, None, encoding).bits
