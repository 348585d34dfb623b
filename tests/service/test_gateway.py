"""The gateway: each rule by which ground stations are answered from the tables of the service."""

from __future__ import annotations

import gc
import logging
import math
import random
import socket
import struct
import sys
import tracemalloc
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from unittest.mock import Mock

import anyio
import fastcrc
import pytest

from paramclient import ParamType
from paramclient.client import taps
from paramclient.client.signing import Signing
from paramclient.errors import UsageError
from paramclient.links import sockets
from paramclient.model.values import Encoding, encode_value
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.protocol.param_pck import PackedParam, decode, encode
from paramclient.service import Hub, kept_file, kept_table, stations
from paramclient.service.kept_file import FileQuery, Rows
from paramclient.service.stations import MavlinkEndpoint, parse_endpoint
from paramclient.sim import Air, ArduPilotVehicle, Camera, Endpoint, PX4Vehicle, Vehicle
from paramclient.wire import frames, messages
from paramclient.wire.messages import FileTransfer, ParamRequestList, ParamRequestRead, ParamSet, ParamValue
from paramclient.wire.signing import SigningKey
from tests.conversations.virtual import Puppet
from tests.ground_station import Station as GroundStation
from tests.service.ground_stations import Partner, Served, StationsLink, gateway_over
from tests.service.hub import V, browsing
from tests.shell import VALUES, Late, PeersLink, Radio, Tap, a_client, bits, generic, small_px4, until

T = TypeVar("T")
LIST = ParamRequestList(1, 1)
BURST = Packet(3, 0, Opcode.BURST_READ_FILE, size=239)
REQUESTS = (ParamRequestList, ParamRequestRead, ParamSet)
GCS = messages.Heartbeat(6, 8)
KEY = SigningKey(bytes(range(32)))


def set_to(name: str, value: float, kind: ParamType = ParamType.INT32) -> ParamSet:
    return ParamSet(1, 1, name, encode_value(value, kind, Encoding.BYTEWISE), kind)


def requested(vehicle: Tap) -> list[object]:
    """What was requested of a vehicle about its parameters."""
    return [message for _, _, message in vehicle.received if isinstance(message, REQUESTS)]


def askers(vehicle: Tap) -> set[int]:
    """The system ids under which a vehicle was asked about its parameters."""
    return {frame.system for _, frame, message in vehicle.received if isinstance(message, REQUESTS)}


def first_value_at(station: Partner) -> float:
    """The time of the first value that a station has received."""
    return next(at for at, frame in zip(station.times, station.frames, strict=True) if frame.message_id == 22)


async def listed(station: Partner, seconds: float = 0.5) -> int:
    """How many values answer a list."""
    await station.ask(LIST, seconds=seconds)
    return len(station.of(ParamValue))


def by_name(station: Partner) -> dict[str, bytes]:
    return {each.param_id: each.raw for each in station.of(ParamValue)}


@asynccontextmanager
async def in_sync(vehicle: Endpoint, **options: Any) -> AsyncIterator[tuple[Served, Tap, Partner]]:
    """A gateway whose table is in sync, its vehicle, and a station."""
    tap = Tap(vehicle)
    async with gateway_over(tap, **options) as served:
        await served.synced()
        station = served.partner()
        tap.received.clear()
        yield served, tap, station


# 1: frames pass


async def test_rule_1_frames_pass_and_none_between_stations() -> None:
    vehicle = Tap(small_px4())
    async with gateway_over(vehicle) as served:
        first, second = served.partner(), served.partner(system=250)
        first.send(GCS, messages.SetupSigning(1, 1, KEY, 1))
        second.send(GCS)
        await anyio.sleep(3.0)
        for each in (first, second):
            assert each.of(messages.Heartbeat, system=1)
            assert {frame.system for frame in each.frames} == {1}
        assert {frame.system for _, frame, _ in vehicle.received} == {250, 254, 255}
        assert not vehicle.messages(messages.SetupSigning)  # a key is never passed on


async def test_rule_1_a_frame_goes_to_the_link_of_its_target() -> None:
    vehicles = [Tap(small_px4(system=number)) for number in (1, 2)]
    async with gateway_over(*vehicles) as served:
        station = served.partner()
        await served.synced()
        await station.ask(
            messages.CommandLong(2, 1, 400), messages.CommandLong(0, 0, 401), messages.CommandLong(9, 1, 402)
        )
        sent = [[each.command for each in vehicle.messages(messages.CommandLong)] for vehicle in vehicles]
        assert [[each for each in one if 400 <= each < 500] for one in sent] == [[401, 402], [400, 401, 402]]
        await station.ask(ParamSet(0, 1, "PARAM_01", bytes(4), ParamType.INT32), ParamRequestList(0, 0))
        for each in vehicles:  # a set for any vehicle is no write of one
            sets = [frame.system for _, frame, message in each.received if isinstance(message, ParamSet)]
            assert sets == [255]
        assert len(station.of(ParamValue)) >= 2 * 26
        await station.ask(messages.CommandLong(2, 1, messages.MAV_CMD_PREFLIGHT_STORAGE, 2.0), seconds=0.01)
        assert [(await each.component()).sync_state for each in served.clients] == ["synced", "checking"]


async def test_rule_1_stations_with_equal_ids_send_equal_frames() -> None:
    """As two programs with pymavlink do, whose first message is a list."""
    async with in_sync(small_px4()) as (served, vehicle, station):
        stations = [station, served.partner(), served.partner()]
        for each in stations:
            each.send(LIST, ParamRequestRead(1, 1, "NONE", -1), messages.CommandLong(1, 1, 400))
        await anyio.sleep(3.0)
        for each in stations:
            assert len(each.of(ParamValue)) == 26
            assert len(each.of(messages.ParamError)) == 1
        same = messages.encode(messages.CommandLong(1, 1, 401), system=255, component=190, sequence=0)
        for each in (station, station, served.partner(), served.partner()):  # a program started anew
            each.send_bytes(same)
            await anyio.sleep(0.5)
        assert [each.command for each in vehicle.messages(messages.CommandLong)] == [400] * 3 + [401] * 4


async def test_rule_1_a_list_at_the_first_heartbeat_stays_off_the_radio() -> None:
    vehicle = Tap(small_px4())
    async with gateway_over(vehicle) as served:
        station = await served.heard()
        await station.ask(LIST, seconds=3.0)
        assert {each.param_index for each in station.of(ParamValue)} >= set(range(25))
        assert askers(vehicle) == {254}


@pytest.mark.parametrize("system", [0, 1])
async def test_rule_1_a_list_that_was_asked_before_the_vehicle_was_heard_is_answered(system: int) -> None:
    """It passes to a vehicle that may be there; the values are then answers to the gateway too."""
    vehicle = Tap(Air.symmetric([ArduPilotVehicle(ftp=system == 0)], delay=0.02, rate=5_760))
    async with gateway_over(vehicle) as served:
        station = served.partner()
        opening = Packet(1, 5, Opcode.OPEN_FILE_RO, b"@PARAM/param.pck")
        station.send(GCS, ParamRequestList(system, 1), FileTransfer(0, system, 1, opening.pack()))
        await until(lambda: served.clients[0].components)
        await served.synced()
        await anyio.sleep(2.0)
        assert {each.param_index for each in station.of(ParamValue)} >= set(range(1382))
        kinds = (*REQUESTS, FileTransfer)
        senders = {frame.system for _, frame, message in vehicle.received if isinstance(message, kinds)}
        assert senders == ({254, 255} if system else {254})


@pytest.mark.parametrize(("system", "expected"), [(1, {1: 26}), (0, {1: 26, 2: 26})])
async def test_rule_1_such_a_list_is_answered_by_those_asked(system: int, expected: dict[int, int]) -> None:
    async with gateway_over(Air([Late(small_px4(system=2), 1.0), Late(small_px4(system=1), 2.0)])) as served:
        station = served.partner()
        await station.ask(ParamRequestList(system, system), seconds=3.0)
        await served.clients[0].fetch_all()
        await anyio.sleep(1.0)
        assert Counter(each.system for each in station.frames if each.message_id == 22) == expected


# 2: answered from the table


def answers_of(vehicle: Endpoint, kind: type[T], *requests: messages.Message) -> list[T]:
    """The answers of a kind by a vehicle to a station that is connected to it."""
    return GroundStation(vehicle).send(*requests).wait(4.0).receive(kind)


@pytest.mark.parametrize("kind", [PX4Vehicle, ArduPilotVehicle, generic])
async def test_rule_2_lists_and_reads_have_the_bytes_of_the_vehicle(kind: Callable[..., Vehicle]) -> None:
    name = kind().listed[2].name
    async with in_sync(kind()) as (_, vehicle, station):
        for request in (LIST, ParamRequestRead(1, 1, name, -1), ParamRequestRead(1, 1, "", 1)):
            wanted = answers_of(kind(), ParamValue, request)
            await station.ask(request)
            assert station.of(ParamValue) == wanted
        assert not requested(vehicle)
        small = ParamRequestRead(1, 1, name.lower(), -1)  # an ArduPilot answers it
        await station.ask(small, seconds=3.0)
        assert station.of(ParamValue) == answers_of(kind(), ParamValue, small)


async def test_rule_2_px4_answers_its_hash_and_goes_on_with_its_list() -> None:
    async with in_sync(small_px4()) as (served, vehicle, station):
        await station.ask(ParamRequestRead(1, 1, "_HASH_CHECK", -1), seconds=0.1)
        [answer] = station.of(ParamValue)
        assert (answer.param_id, answer.param_index, answer.param_count) == ("_HASH_CHECK", 65535, 25)
        assert int.from_bytes(answer.raw, "little") == (await served.clients[0].component()).hash
        await station.ask(ParamSet(1, 1, "_HASH_CHECK", bytes(4), 5))
        assert not requested(vehicle)


async def test_rule_2_a_station_that_has_heard_no_heartbeat_hears_one_before_the_list() -> None:
    """MAVProxy asks whatever it has heard, and decodes a PX4's integers by its heartbeat."""
    async with in_sync(small_px4()) as (_, _, station):
        await station.ask(LIST, seconds=0.1)
        first, *others = (each for each in station.frames if each.system == 1)
        assert isinstance(beat := messages.decode(first), messages.Heartbeat)
        assert (beat.autopilot, len(station.of(ParamValue)), others[0].message_id) == (12, 26, 22)


async def test_rule_2_an_unknown_name_is_asked_of_the_vehicle_once() -> None:
    async with in_sync(small_px4()) as (served, vehicle, station):
        other = served.partner(system=9)
        other.send(ParamRequestRead(1, 1, "NONE", -1))
        await station.ask(ParamRequestRead(1, 1, "NONE", -1), seconds=3.0)
        assert station.of(messages.ParamError) == [messages.ParamError(255, 190, "NONE", -1, 1)]
        assert other.of(messages.ParamError) == [messages.ParamError(9, 190, "NONE", -1, 1)]
        vehicle.received.clear()
        await station.ask(ParamRequestRead(1, 1, "NONE", -1), ParamRequestRead(1, 1, "", 999))
        assert len(station.of(messages.ParamError)) == 2
        assert not requested(vehicle)
        await anyio.sleep(kept_table.REMEMBERED_TIME)
        await station.ask(ParamRequestRead(1, 1, "NONE", -1))
        assert ParamRequestRead(1, 1, "NONE", -1) in requested(vehicle)


@pytest.mark.parametrize("seed", range(4))
async def test_rule_2_an_unknown_name_is_known_to_be_unknown_in_3_seconds_also_with_losses(seed: int) -> None:
    air = Air.symmetric([PX4Vehicle()], loss=0.2, delay=0.05, seed=seed)
    async with in_sync(air) as (_, vehicle, station):
        await station.ask(ParamRequestRead(1, 1, "NONE", -1), seconds=3.0)
        asked = len(requested(vehicle))
        await station.ask(ParamRequestRead(1, 1, "NONE", -1), seconds=3.0)
        assert len(requested(vehicle)) == asked


async def test_rule_2_a_name_that_the_vehicle_has_by_now_is_not_unknown() -> None:
    also = Puppet(lambda message: (), heartbeat=None)
    async with in_sync(Air([small_px4(param_error=True), also])) as (_, vehicle, station):
        await station.ask(ParamRequestRead(1, 1, "NEW", -1))
        also.say(ParamValue("NEW", bytes(4), ParamType.INT32, 25, 65535))
        await station.ask(GCS)
        await station.ask(set_to("NEW", 5))
        assert set_to("NEW", 5) in requested(vehicle)


async def test_rule_2_extended_parameters() -> None:
    camera = Tap(Camera(slow={"CAM_NAME": 10.0}))
    wanted = answers_of(Camera(), messages.ParamExtValue, messages.ParamExtRequestList(1, 100))
    async with gateway_over(camera) as served:
        station, other, one = await served.heard(), await served.heard(system=9), wanted[2]
        same = messages.ParamExtSet(1, 100, one.param_id, one.raw, one.param_type)
        await station.ask(same, seconds=3.0)  # before any list
        assert (len(station.of(messages.ParamExtAck)), other.of(messages.ParamExtAck)) == (1, [])
        await station.ask(messages.ParamExtRequestList(1, 100), seconds=5.0)
        assert station.of(messages.ParamExtValue) == wanted
        camera.received.clear()
        await station.ask(messages.ParamExtRequestList(1, 100))
        assert station.of(messages.ParamExtValue) == wanted
        reads = ((one.param_id, -1), ("", 2))
        await station.ask(*(messages.ParamExtRequestRead(1, 100, *each) for each in reads))
        assert station.of(messages.ParamExtValue) == [one, one]
        assert not camera.messages(messages.ParamExtRequestList)
        new = messages.ParamExtSet(1, 100, "CAM_NAME", b"Rear".ljust(128, b"\0"), ParamType.CUSTOM)
        await station.ask(new, new, seconds=12.0)
        working, acknowledged = station.of(messages.ParamExtAck)
        assert acknowledged == messages.ParamExtAck("CAM_NAME", new.raw, ParamType.CUSTOM, 0)
        assert working.param_result == 3  # PARAM_ACK_IN_PROGRESS
        await station.ask(messages.ParamExtSet(1, 100, "CAM_NAME", bytes(128), ParamType.UINT8))
        assert station.of(messages.ParamExtAck) == [replace(acknowledged, param_result=1)]
        await station.ask(messages.ParamExtRequestRead(1, 100, "NONE", -1), seconds=4.0)
        assert not station.of(messages.ParamError)


async def test_rule_2_extended_parameters_are_asked_of_the_camera_again_after_a_moment() -> None:
    """Nothing announces or confirms them."""
    whole: messages.Message = messages.ParamExtRequestList(1, 100)
    one = messages.ParamExtRequestRead(1, 100, "CAM_ISO", -1)
    async with gateway_over(camera := Camera()) as served:
        station = await served.heard()
        for value, request in enumerate((whole, one, whole), 3200):
            camera.set_ext_param("CAM_ISO", value)
            await station.ask(request, seconds=10.0)
            sent = {each.raw[:4] for each in station.of(messages.ParamExtValue) if each.param_id == "CAM_ISO"}
            assert sent == {struct.pack("<I", value)}


def direct_file(path: str, size: int) -> bytes:
    """A file as the simulated vehicle serves it."""
    opening = Packet(1, 0, Opcode.OPEN_FILE_RO, path.encode())
    burst = Packet(3, 0, Opcode.BURST_READ_FILE, size=size)
    sent = (FileTransfer(0, 1, 1, each.pack()) for each in (opening, burst))
    _, *said = answers_of(ArduPilotVehicle(), FileTransfer, *sent)
    return content_of([Packet.unpack(each.payload) for each in said])


def content_of(packets: list[Packet]) -> bytes:
    """The content in the answers to a burst."""
    *pieces, last = packets
    assert (last.opcode, last.code) == (Opcode.NAK, 6)
    assert [each.sequence for each in packets] == [packets[0].sequence + at for at in range(len(packets))]
    return b"".join(each.data for each in pieces)


@pytest.mark.parametrize("size", [255, 110, 80])
@pytest.mark.parametrize("query", ["", "?withdefaults=1", "?start=100&count=50"])
async def test_rule_2_the_parameter_file_in_the_requested_pieces(size: int, query: str) -> None:
    path = f"@PARAM/param.pck{query}"
    async with in_sync(ArduPilotVehicle()) as (_, vehicle, station):
        [opened] = await station.ask_file(Opcode.OPEN_FILE_RO, data=path.encode(), session=3, sequence=5)
        assert (opened.opcode, opened.session, opened.sequence) == (Opcode.ACK, 3, 6)
        content = content_of(await station.ask_file(Opcode.BURST_READ_FILE, size=size, session=3))
        size = min(size, 239)  # what fits in a message
        assert max(map(len, station.datagrams)) <= 1_400
        pack = decode(direct_file(path, size))
        rows = [each._replace(default=None) if each.default == each.bits else each for each in pack.entries]
        assert content == encode(rows, total=pack.total, with_defaults=pack.with_defaults, read_size=size)
        await station.ask_file(Opcode.OPEN_FILE_RO, data=path.encode(), session=4)
        await station.ask_file(Opcode.TERMINATE_SESSION, session=4)
        [part] = await station.ask_file(Opcode.READ_FILE, offset=size, size=size, session=3)
        assert part.data == content[size : 2 * size]
        close, session = (Opcode.RESET_SESSIONS, 0) if query else (Opcode.TERMINATE_SESSION, 3)
        [closed] = await station.ask_file(close, session=session)
        assert closed.opcode == Opcode.ACK
        assert not vehicle.messages(FileTransfer)


async def test_rule_2_a_repeated_opening_has_the_same_answer_when_the_table_is_in_doubt() -> None:
    async with in_sync(ArduPilotVehicle()) as (served, vehicle, station):
        opening = partial(station.ask_file, Opcode.OPEN_FILE_RO, data=b"@PARAM/param.pck", seconds=0.01)
        opened = await opening()
        vehicle.is_deaf = True
        (await served.clients[0].component()).watch.doubt()
        await anyio.sleep(0.05)
        assert opened == await opening() != []
        await opening(sequence=9, seconds=5.0)  # fails, or passes and opens another file
        assert not await station.ask_file(Opcode.READ_FILE, size=80)


async def test_rule_2_the_file_of_a_px4_is_padded_for_pieces_of_239_bytes() -> None:
    """Whatever is requested: it sends no others."""
    async with gateway_over(vehicle := Tap(PX4Vehicle(ftp=True))) as served:
        await (await served.clients[0].component()).wait_until_identified(5.0)
        await served.synced()
        station = served.partner()
        vehicle.received.clear()
        await station.ask_file(Opcode.OPEN_FILE_RO, data=b"@PARAM/param.pck")
        content = content_of(await station.ask_file(Opcode.BURST_READ_FILE, size=80))
        rows = decode(content).entries
        assert content == encode(rows, total=903, read_size=239) != encode(rows, total=903, read_size=80)
        assert not vehicle.messages(FileTransfer)


@pytest.mark.parametrize("query", ["?colour=1", "?start=x", "?start=9999", "?withdefaults=2"])
async def test_rule_2_a_query_that_the_table_does_not_answer_is_passed(query: str) -> None:
    async with in_sync(ArduPilotVehicle()) as (served, vehicle, station):
        (await served.clients[0].component()).watch.doubt()
        data = f"@PARAM/param.pck{query}".encode()
        assert await station.ask_file(Opcode.OPEN_FILE_RO, data=data, seconds=2.0)
        assert data in [Packet.unpack(each.payload).data for each in vehicle.messages(FileTransfer)]


def test_rule_2_a_file_with_defaults_that_are_unknown_is_one_without() -> None:
    entries = [PackedParam("A", ParamType.INT8, 5), PackedParam("B", ParamType.REAL32, 7)]
    plain, full = FileQuery(), FileQuery(with_defaults=True)
    unknown, known = Rows(entries, has_defaults=False), Rows(entries, has_defaults=True)
    assert unknown.content(full, 80) == unknown.content(plain, 80) == known.content(plain, 80)
    assert known.content(full, 80)[:2] == b"\x1c\x67"
    assert unknown.content(full, 80)[:2] == b"\x1b\x67"


async def test_rule_2_a_file_passes_where_the_refusal_of_a_set_may_be_rounded() -> None:
    (model := ArduPilotVehicle(read_only=["BARO_PROBE_EXT"])).load({"BARO_PROBE_EXT": (1 << 25) + 1})
    async with in_sync(model) as (_, vehicle, station):
        await station.ask(ParamSet(1, 1, "BARO_PROBE_EXT", struct.pack("<f", 1 << 25), ParamType.INT32))
        assert await station.ask_file(Opcode.OPEN_FILE_RO, data=b"@PARAM/param.pck", session=5)
        passed = [Packet.unpack(each.payload).opcode for each in vehicle.messages(FileTransfer)]
        assert Opcode.OPEN_FILE_RO in passed


async def test_rule_2_a_file_passes_while_an_announced_integer_may_be_rounded() -> None:
    (model := ArduPilotVehicle()).load({"BARO_PROBE_EXT": 1 << 25})
    async with in_sync(model) as (_, vehicle, station):
        for name, value, passes in (("STAT_RUNTIME", 1 << 23, False), ("BARO_PROBE_EXT", 1 << 24, True)):
            model.set_param(name, value)  # announced as float32
            await anyio.sleep(0.1)
            assert await station.ask_file(Opcode.OPEN_FILE_RO, data=b"@PARAM/param.pck", session=passes)
            opened = [Packet.unpack(each.payload).opcode for each in vehicle.messages(FileTransfer)]
            assert (Opcode.OPEN_FILE_RO in opened) == passes


@pytest.mark.parametrize("query", [b"", b"?withdefaults=1"])
async def test_rule_2_the_checksum_of_the_parameter_file(query: bytes) -> None:
    """The vehicle may send a default that is the value, which the table does not keep."""
    data = b"@PARAM/param.pck" + query
    request = FileTransfer(0, 1, 1, Packet(1, 0, Opcode.CALC_FILE_CRC32, data).pack())
    [wanted] = answers_of(ArduPilotVehicle(), FileTransfer, request)
    async with in_sync(ArduPilotVehicle()) as (_, vehicle, station):
        assert await station.ask_file(Opcode.CALC_FILE_CRC32, data=data) == [Packet.unpack(wanted.payload)]
        assert bool(vehicle.messages(FileTransfer)) == bool(query)


async def test_rule_2_other_files_pass_and_an_upload_has_the_table_proven() -> None:
    async with in_sync(ArduPilotVehicle()) as (served, vehicle, station):
        component = await served.clients[0].component()
        [answer] = await station.ask_file(Opcode.OPEN_FILE_RO, data=b"nothing.txt")
        assert answer.opcode == Opcode.NAK
        assert vehicle.messages(FileTransfer)
        vehicle.received.clear()
        await station.ask_file(Opcode.OPEN_FILE_RO, data=b"@PARAM/param.pck", sequence=3)
        await station.ask_file(Opcode.CREATE_FILE, data=b"@PARAM/param.pck", sequence=5)  # in this session
        await station.ask_file(Opcode.TERMINATE_SESSION, sequence=7, seconds=0.1)
        passed = [Packet.unpack(each.payload).opcode for each in vehicle.messages(FileTransfer)]
        assert passed[:2] == [Opcode.CREATE_FILE, Opcode.TERMINATE_SESSION]
        assert component.sync_state == "checking"
        await anyio.sleep(10.0)
        assert component.sync_state == "synced"


@pytest.mark.parametrize("opcode", [Opcode.TERMINATE_SESSION, Opcode.RESET_SESSIONS])
async def test_rule_2_a_station_does_not_close_the_session_of_the_fetch(opcode: Opcode) -> None:
    """An ArduPilot has one, and the list takes 20 s over a radio."""
    vehicle = Tap(Air.symmetric([ArduPilotVehicle()], loss=0.05, delay=0.02, rate=5_760, seed=1))
    async with gateway_over(vehicle) as served:
        component = await served.clients[0].component()
        station = served.partner()
        await station.ask(LIST, seconds=0.1)
        while component.sync_state != "synced":
            assert (await station.ask_file(opcode, seconds=0.1))[-1].opcode == Opcode.ACK
        assert not vehicle.messages(ParamRequestList)


# 3: never older than known


async def test_rule_3_a_list_that_is_asked_during_the_fetch_streams_it() -> None:
    """All who ask share one fetch; the first value comes within 2 s."""
    vehicle = Tap(Air.symmetric([PX4Vehicle()], loss=0.2, delay=0.05, seed=1))
    async with gateway_over(vehicle) as served:
        await served.clients[0].component()
        stations = [served.partner(system=number) for number in range(250, 254)]
        began = anyio.current_time()
        for _ in range(2):
            for each in stations:
                each.send(LIST)
            await anyio.sleep(1.0)
        component = await served.clients[0].component()
        await until(lambda: component.sync_state == "synced")
        await anyio.sleep(1.0)
        for each in stations:
            indices = [value.param_index for value in each.of(ParamValue) if value.param_id != "_HASH_CHECK"]
            assert (sorted({*indices}), max(Counter(indices).values())) == ([*range(component.count or 0)], 2)
            assert first_value_at(each) - began <= 2.0
        assert len(vehicle.messages(ParamRequestList)) <= 5  # of the gateway alone
        assert askers(vehicle) == {254}


async def test_rule_3_the_first_value_of_a_fetch_that_brings_none_is_requested() -> None:
    """Each second, so that it comes within 2 s if none is lost; here, the first request is."""
    ask, value = ParamRequestRead(1, 1, "", 0), ParamValue("A", bytes(4), ParamType.INT32, 9, 0)
    beat = messages.Heartbeat(2, 3)
    vehicle = Puppet(lambda each: [value] * (each == ask and vehicle.received.count(ask) > 1), heartbeat=beat)
    async with gateway_over(vehicle) as served:
        assert await listed(await served.heard(), seconds=2.2) == 1


async def test_rule_3_stations_during_a_long_fetch() -> None:
    """Reads of gaps wait; there is no file, so that no download begins."""
    vehicle, gaps = Tap(ArduPilotVehicle(ftp_rate=2_000.0)), range(700, 710)
    async with gateway_over(vehicle) as served:
        await served.clients[0].component()
        station, other, flood = (served.partner() for _ in range(3))
        other.send(LIST)
        data, tasks = b"@PARAM/param.pck?withdefaults=1", len(anyio.get_running_tasks())
        openings = (Packet(number, 0, Opcode.OPEN_FILE_RO, data) for number in range(3_000))
        flood.send(*(FileTransfer(0, 1, 1, each.pack()) for each in openings))
        await anyio.sleep(0.5)
        assert len(anyio.get_running_tasks()) <= tasks + stations.REQUESTS_MAX + 20
        [answer] = await station.ask_file(Opcode.OPEN_FILE_RO, data=data, seconds=2.9)
        assert (answer.opcode, answer.code) == (Opcode.NAK, 10)
        await station.ask_file(Opcode.CALC_FILE_CRC32, data=data[:16], seconds=2.9)
        station.send(LIST)
        for _ in range(10):
            station.send(*(ParamRequestRead(1, 1, "", index) for index in gaps))
            await anyio.sleep(2.0)
        assert len(by_name(station)) == len(by_name(other)) == 1382
        assert not station.of(messages.ParamError)
        sent = [frame.payload for _, frame, _ in vehicle.received if frame.system != 254]
        assert [Packet.unpack(each[3:]).opcode for each in sent] == [Opcode.CALC_FILE_CRC32]
        assert not {each.param_index for each in vehicle.messages(ParamRequestRead)} & {*gaps}


@pytest.mark.parametrize("seed", [1, 2, 3])
async def test_rule_3_no_list_is_requested_beside_a_file_that_fills_the_radio(seed: int) -> None:
    """A station that is connected directly has the list after 18 to 21 s. The first block has values."""
    vehicle = Tap(Air.symmetric([ArduPilotVehicle()], loss=0.05, delay=0.02, rate=5_760, seed=seed))
    async with gateway_over(vehicle) as served:
        station = await served.heard()
        await anyio.sleep(2.0)
        asked_at = anyio.current_time()
        await station.ask(LIST, seconds=12.0)
        assert len(by_name(station)) == 1382
        assert first_value_at(station) - asked_at <= 1.0
        assert not requested(vehicle)  # neither a list nor a first value


async def test_rule_3_an_old_proof_is_renewed_behind_the_answer_and_differences_are_announced() -> None:
    for model in (small_px4(), small_px4(armed=True)):
        async with in_sync(model, watch_interval=0) as (_, vehicle, station):
            await station.ask(GCS, seconds=6.0)
            model.load({"PARAM_01": 77})  # announces nothing
            vehicle.received.clear()
            await station.ask(LIST, seconds=0.3)
            assert by_name(station)["PARAM_01"] == struct.pack("<i", 1)
            assert not requested(vehicle)
            await anyio.sleep(5.0)
            assert by_name(station)["PARAM_01"] == struct.pack("<i", 77)
            vehicle.received.clear()
            await station.ask(LIST, seconds=1.0)
            assert by_name(station)["PARAM_01"] == struct.pack("<i", 77)
            assert not requested(vehicle)  # the proof is young


async def test_rule_3_no_value_is_served_old_that_the_hash_contradicts_or_leaves_out() -> None:
    model = PX4Vehicle()
    async with in_sync(Air.symmetric([model], delay=0.05, rate=5_760.0)) as (_, _, station):
        for name in ("WV_YRATE_MAX", "CAL_ACC0_XOFF"):
            await anyio.sleep(8.0)
            model.load({name: 12.0})  # announces nothing
            await station.ask(ParamRequestRead(1, 1, name, -1), seconds=1.0)
            await station.ask(LIST, *[ParamRequestRead(1, 1, name, -1)] * 2, seconds=10.0)
            found = {each.raw for each in station.of(ParamValue) if each.param_id == name}
            assert found == {struct.pack("<f", 12)}


async def test_rule_3_the_hash_is_answered_in_under_a_second_before_the_table_is() -> None:
    async with gateway_over(Air.symmetric([PX4Vehicle()], delay=0.1, rate=20_000.0)) as served:
        station = await served.heard()
        await station.ask(LIST, ParamRequestRead(1, 1, "_HASH_CHECK", -1), seconds=0.9)
        assert "_HASH_CHECK" in by_name(station)
        assert not (await served.clients[0].component()).session.table.is_complete


@pytest.mark.parametrize("beat_at", [2, 10])
@pytest.mark.parametrize(("autopilot", "kind"), [(3, "<f"), (12, "<i"), (3, "<i")])
async def test_rule_3_no_value_is_served_or_set_in_doubt(autopilot: int, kind: str, beat_at: int) -> None:
    """The first heartbeat may wait behind a list; 120.0 of an ArduPilot is another number byte by byte.

    Where a heartbeat is not that of the bytes, requests pass after the fetch.
    """
    raw = struct.pack(kind, 120)
    values = [ParamValue(f"INT_{index}", raw, ParamType.INT32, 2, index) for index in range(2)]
    answers = {ParamRequestList: values, ParamRequestRead: values[:1]}
    vehicle = Puppet(lambda message: answers.get(type(message), []), heartbeat=None)
    async with gateway_over(vehicle) as served:
        station = served.partner()
        station.send(GCS)
        vehicle.say(values[0])
        write = ParamSet(1, 1, "INT_0", raw, ParamType.INT32)
        for _ in range(beat_at):
            await station.ask(LIST, ParamRequestRead(1, 1, "", 0), write, seconds=1.0)
            assert {each.raw for each in station.of(ParamValue)} <= {raw}
        for _ in range(6):
            vehicle.say(messages.Heartbeat(2, autopilot))
            await station.ask(LIST, ParamRequestRead(1, 1, "", 0), seconds=1.0)
            assert {each.raw for each in station.of(ParamValue)} <= {raw}
        sets = {each.raw for each in vehicle.received if isinstance(each, ParamSet)}
        assert sets == ({raw} if (autopilot, kind, beat_at) != (3, "<i", 2) else set())
        assert {(each.raw, each.param_index) for each in station.of(ParamValue)} == {(raw, 0), (raw, 1)}


async def test_rule_3_no_integer_is_served_while_nothing_tells_its_encoding() -> None:
    copter = ArduPilotVehicle(table={"WHOLE": 5}, telemetry=4)
    vehicle = Tap(copter, down=lambda message: not isinstance(message, messages.Heartbeat))
    async with gateway_over(vehicle) as served:
        await (station := await served.heard()).ask(LIST, seconds=8.0)
        assert set(by_name(station).values()) <= {struct.pack("<f", 5)}


async def test_rule_3_a_list_with_a_name_that_is_not_stored_is_the_vehicles() -> None:
    model = partial(generic, table={"A": 1.0, "B,": 2.0})
    async with in_sync(model()) as (_, _, station):
        await station.ask(LIST)
        assert station.of(ParamValue) == answers_of(model(), ParamValue, LIST)


async def test_rule_3_a_list_of_which_a_value_never_comes_is_not_fetched_for_each_station() -> None:
    vehicle = Tap(small_px4(), down=lambda message: getattr(message, "param_index", None) != 5)
    async with gateway_over(vehicle) as served:
        await (await served.heard()).ask(LIST, seconds=10.0)
        station, before = await served.heard(), len(vehicle.messages(messages.ParamRequestList))
        await station.ask(LIST)
        assert {each.param_index for each in station.of(messages.ParamValue)} == {*range(25)} - {5}
        assert len(vehicle.messages(messages.ParamRequestList)) == before


async def test_rule_3_cached_values_are_never_served(tmp_path: Path) -> None:
    cache = tmp_path / "cache.db"
    async with in_sync(small_px4(), cache=cache):
        pass
    vehicle = Tap(small_px4())
    async with gateway_over(vehicle, cache=cache) as served:
        assert {each.trust for each in (await served.clients[0].component()).params.values()} == {"cached"}
        vehicle.is_deaf = True
        station = served.partner()
        reads = (ParamRequestRead(1, 1, name, -1) for name in ("PARAM_01", "_HASH_CHECK"))
        await station.ask(LIST, *reads, seconds=2.0)
        assert not station.of(ParamValue)


@pytest.mark.parametrize("silence", ["is_mute", "is_deaf"])
async def test_rule_3_a_value_is_not_served_after_a_set_without_an_answer(silence: str) -> None:
    """It may be the new one."""
    async with in_sync(ArduPilotVehicle(table=VALUES)) as (_, vehicle, station):
        assert await listed(station) == 24
        await station.ask(set_to("PARAM_01", 1, ParamType.REAL32), seconds=1.0)  # shows the encoding
        setattr(vehicle, silence, True)
        await station.ask(set_to("PARAM_01", 5, ParamType.REAL32), seconds=3.0)
        assert await listed(station, 0.1) == 23
        assert not await station.ask_file(Opcode.OPEN_FILE_RO, data=b"@PARAM/param.pck", seconds=0.1)
        setattr(vehicle, silence, False)
        await station.ask(seconds=2.0)
        assert by_name(station) == {"PARAM_01": struct.pack("<f", 5 if silence == "is_mute" else 1)}
        assert await listed(station) == 24


async def test_rule_3_a_value_is_read_again_after_a_set_that_passes() -> None:
    """To any vehicle: its acknowledgement may be lost."""
    vehicle = Tap(generic())
    async with gateway_over(vehicle, generic(system=2)) as served:
        await served.synced()
        station = served.partner()
        vehicle.is_mute = True
        await station.ask(replace(set_to("PARAM_03", 5, ParamType.REAL32), target_system=0))
        vehicle.is_mute = False
        await station.ask(ParamRequestRead(1, 1, "PARAM_03", -1))
        assert by_name(station) == {"PARAM_03": struct.pack("<f", 5)}


async def test_rule_3_a_value_is_served_without_its_index_after_another_count() -> None:
    """The values are those of the vehicle, and the indices of an earlier list."""
    also = Puppet(lambda message: (), heartbeat=None)
    async with in_sync(Air([small_px4(), also])) as (_, vehicle, station):
        also.say(ParamValue("NEW", bytes(4), ParamType.INT32, 26, 65535))
        for place, seconds in (((26, 65535), 0.1), ((25, 8), 5.0)):
            await station.ask(GCS, seconds=seconds)
            await station.ask(ParamRequestRead(1, 1, "PARAM_07", -1), seconds=0.1)
            assert station.of(ParamValue)[-1] == ParamValue("PARAM_07", struct.pack("<i", 7), 6, *place)
            assert bool(requested(vehicle)) == (place == (25, 8))


async def test_rule_3_a_lost_vehicle_is_silent() -> None:
    async with in_sync(small_px4()) as (_, vehicle, station):
        read, write = ParamRequestRead(1, 1, "PARAM_01", -1), set_to("PARAM_01", 5)
        vehicle.is_mute = vehicle.is_deaf = True
        await anyio.sleep(3.5)
        await station.ask(write, seconds=3.0)  # the vehicle is lost before an error is due
        assert not station.frames
        vehicle.received.clear()
        await station.ask(LIST, read, write, seconds=5.0)
        assert not station.frames
        assert not askers(vehicle)
        vehicle.is_mute = vehicle.is_deaf = False
        await anyio.sleep(10.0)
        assert not station.of(ParamValue)
        assert not vehicle.messages(ParamSet)
        assert await listed(station) == 26


async def test_rule_3_a_component_without_heartbeats_is_lost_after_a_minute() -> None:
    value = messages.ParamExtValue("A", bytes(128), ParamType.UINT8, 1, 0)
    asks = (messages.ParamExtRequestList, messages.ParamExtRequestRead)
    vehicle = Puppet(lambda each: [value] * isinstance(each, asks), heartbeat=None, component=100)
    async with gateway_over(vehicle) as served:
        vehicle.say(value)
        station = served.partner()
        for seconds, answers in ((0.0, 1), (50.0, 1), (61.0, 0)):
            await anyio.sleep(seconds)
            await station.ask(messages.ParamExtRequestRead(1, 100, "A", -1))
            assert len(station.of(messages.ParamExtValue)) == answers, seconds
            await station.ask(messages.ParamExtSet(1, 100, "A", bytes(128), ParamType.UINT8), seconds=3.0)
            assert len(station.of(messages.ParamExtAck)) == answers, seconds


@pytest.mark.parametrize("seconds", [0.0, 0.5])
async def test_rule_3_a_vehicle_lost_during_the_fetch_is_served_when_it_is_back(seconds: float) -> None:
    vehicle = Tap(Air.symmetric([PX4Vehicle()], rate=20_000.0))
    async with gateway_over(vehicle) as served:
        station = await served.heard()
        await station.ask(LIST, seconds=seconds)
        vehicle.is_mute = True
        await anyio.sleep(10.0)
        vehicle.is_mute = False
        await anyio.sleep(3.0)
        vehicle.received.clear()
        await station.ask(LIST, seconds=6.0)
        assert len(by_name(station)) == 904
        assert askers(vehicle) <= {254}


@pytest.mark.parametrize("request_sent", [LIST, FileTransfer(0, 1, 1, BURST.pack())])
async def test_rule_3_a_vehicle_that_is_lost_during_an_answer_ends_it(request_sent: messages.Message) -> None:
    async with in_sync(ArduPilotVehicle()) as (served, _, station):
        await station.ask_file(Opcode.OPEN_FILE_RO, data=b"@PARAM/param.pck")
        await station.ask(request_sent, seconds=0.01)
        served.clients[0].core.station.nodes[1, 1].presence.is_lost = True
        await anyio.sleep(0.01)
        received = len(station.frames)
        assert 0 < received < 900
        await anyio.sleep(0.5)
        assert len(station.frames) - received <= 5


@pytest.mark.parametrize("is_begun", [False, True])
async def test_rule_3_a_change_before_and_during_an_answer_is_in_it(is_begun: bool) -> None:
    async with in_sync(PX4Vehicle()) as (served, _, station):
        component = await served.clients[0].component()
        name = component.session.table.names[900]
        served.link.is_stuck = not is_begun
        await station.ask(GCS, seconds=1.5)  # a heartbeat of the vehicle holds the sender up
        await station.ask(LIST, seconds=0.01)
        await component.set(name, 3)
        served.link.is_stuck = False
        await anyio.sleep(0.5)
        _, *_, last = [each for each in station.of(ParamValue) if each.param_id == name]
        assert last.raw == encode_value(3, last.param_type, component.encoding)
        assert {each.param_count for each in station.of(ParamValue)} == {component.count}


# 4: sets


async def test_rule_4_a_set_is_a_verified_write_of_its_station() -> None:
    async with in_sync(small_px4()) as (served, vehicle, station):
        other = await served.heard(system=9)
        changes = (await served.clients[0].component()).changes()
        vehicle.received.clear()
        for _ in range(3):
            station.send(set_to("PARAM_01", 33))
        await station.ask(seconds=1.0)
        assert by_name(station) == by_name(other) == {"PARAM_01": struct.pack("<i", 33)}
        assert len(vehicle.messages(ParamSet)) == 1
        assert (await anext(changes)).by == "us for station 255/190"
        other.clear()
        await station.ask(set_to("PARAM_01", 33), seconds=1.0)  # all hear of it again, as from a vehicle
        assert by_name(station) == by_name(other) == {"PARAM_01": struct.pack("<i", 33)}


async def test_rule_4_different_sets_queue() -> None:
    async with in_sync(Air.symmetric([small_px4()], loss=0.3, delay=0.05, seed=4)) as (served, _, first):
        second = served.partner(system=9)
        await second.ask(set_to("PARAM_01", 9), seconds=0.01)
        await first.ask(set_to("PARAM_01", 33), seconds=5.0)
        assert (await (await served.clients[0].component()).get("PARAM_01")).value == 33
        assert by_name(first)["PARAM_01"] == by_name(second)["PARAM_01"] == struct.pack("<i", 33)


async def test_rule_4_sets_that_wait_for_others_are_not_refused() -> None:
    model = PX4Vehicle()
    names = [name for name, value in model.values.items() if isinstance(value, float)][:190]
    async with in_sync(Air.symmetric([model], delay=0.3)) as (_, _, station):
        await station.ask(*(set_to(name, 3, ParamType.REAL32) for name in names), seconds=7.0)
        assert not station.of(messages.ParamError)
        assert by_name(station).keys() >= {*names}


async def test_rule_4_a_set_back_is_no_repetition() -> None:
    async with in_sync(Air.symmetric([small_px4()], delay=0.05)) as (_, vehicle, station):
        back = [set_to("PARAM_01", value) for value in (9, 9, 33, 9, 9)]
        await station.ask(*back, seconds=3.0)
        assert vehicle.messages(ParamSet) == back[1:4]
        assert by_name(station)["PARAM_01"] == struct.pack("<i", 9)


async def test_rule_4_an_error_goes_to_the_asker_alone_within_3_seconds() -> None:
    async with in_sync(small_px4()) as (served, vehicle, station):
        other = await served.heard(system=9)
        await station.ask(set_to("PARAM_01", 5, ParamType.INT16), seconds=0.1)
        assert station.of(messages.ParamError) == [messages.ParamError(255, 190, "PARAM_01", -1, 7)]
        await station.ask(ParamSet(1, 1, "PARAM_00", struct.pack("<f", math.nan), 9), seconds=0.1)
        assert station.of(messages.ParamError) == [messages.ParamError(255, 190, "PARAM_00", -1, 2)]
        assert by_name(station) == {"PARAM_00": bytes(4)}  # the value that stays
        for name in ("NONE", "param_01"):
            await station.ask(set_to(name, 5), seconds=3.0)
            assert station.of(messages.ParamError) == [messages.ParamError(255, 190, name, -1, 1)]
        vehicle.is_deaf = True
        await station.ask(set_to("PARAM_01", 5), seconds=3.0)
        assert station.of(messages.ParamError) == [messages.ParamError(255, 190, "PARAM_01", -1, 4)]
        assert not other.of(messages.ParamError)


async def test_rule_4_a_name_that_is_not_stored_is_unknown() -> None:
    ask, value = ParamRequestRead(1, 1, "B,", -1), ParamValue("B,", bytes(4), ParamType.REAL32, 25, 65535)
    also = Puppet(lambda message: [value] * (message == ask), heartbeat=None)
    async with in_sync(Air([small_px4(), also])) as (_, _, station):
        await station.ask(set_to("B,", 1, ParamType.REAL32), seconds=3.0)
        assert [each.error for each in station.of(messages.ParamError)] == [1]


async def test_rule_4_an_ardupilot_takes_names_in_any_case_and_values_of_any_type() -> None:
    async with in_sync(ArduPilotVehicle()) as (_, _, station):
        await station.ask(set_to("angle_max", 3, ParamType.REAL32), seconds=1.0)
        assert by_name(station) == {"ANGLE_MAX": struct.pack("<f", 3)}


@pytest.mark.parametrize("queue", [12_288, None])
async def test_rule_4_a_set_during_the_fetch_has_its_result_with_the_list(queue: int | None) -> None:
    """The acknowledgement waits behind the list; an error after 3 s would be wrong."""
    async with gateway_over(Air.symmetric([PX4Vehicle()], delay=0.02, rate=5_760.0, queue=queue)) as served:
        station = await served.heard()
        await station.ask(LIST, seconds=2.0)
        for _ in range(8):
            station.send(set_to("VT_B_DEC_MSS", 3, ParamType.REAL32))
            await anyio.sleep(1.0)
        assert by_name(station)["VT_B_DEC_MSS"] == struct.pack("<f", 3)
        assert not station.of(messages.ParamError)


@pytest.mark.parametrize("index", [40, 140, 1300])
async def test_rule_4_an_error_within_3_seconds_during_the_fetch_where_no_queue_fills(index: int) -> None:
    """Its list has brought the old value, brings it meanwhile, or later."""
    model = ArduPilotVehicle(ftp=False, burst=1, period=0.025)
    vehicle, name = Tap(Air.symmetric([model], delay=0.05, rate=5_760.0)), model.listed[index].name
    async with gateway_over(vehicle) as served:
        station = await served.heard()
        await station.ask(LIST, seconds=2.0)
        vehicle.is_deaf = True
        await station.ask(set_to(name, 3, ParamType.REAL32), seconds=3.0)
        assert station.of(messages.ParamError) == [messages.ParamError(255, 190, name, -1, 4)]


async def test_rule_4_an_error_within_3_seconds_where_the_type_has_to_be_read() -> None:
    vehicle = Tap(Air.symmetric([small_px4()], delay=0.5))
    async with gateway_over(vehicle) as served:
        station = await served.heard()
        await station.ask(set_to("PARAM_01", 33), seconds=0.8)
        vehicle.is_deaf = True  # before the set
        await anyio.sleep(2.2)
        assert [each.error for each in station.of(messages.ParamError)] == [4]


async def test_rule_4_an_error_within_3_seconds_during_the_fetch_by_a_camera_too() -> None:
    vehicle = Tap(Camera(burst=1, period=1.0))
    write = messages.ParamExtSet(1, 100, "CAM_NAME", bytes(128), ParamType.CUSTOM)
    async with gateway_over(vehicle) as served:
        station = await served.heard()
        await station.ask(messages.ParamExtRequestList(1, 100), seconds=2.0)
        vehicle.is_deaf = True
        await station.ask(write, seconds=3.0)
        assert [each.param_result for each in station.of(messages.ParamExtAck)] == [2]
        vehicle.is_mute = True
        await anyio.sleep(3.5)
        await station.ask(write, seconds=3.0)  # the camera is lost before an error is due
        assert not station.frames


# 5: changes


async def test_rule_5_changes_by_others_are_announced() -> None:
    radio = Radio(small_px4())
    async with in_sync(radio) as (_, _, station):
        await station.ask(GCS)
        radio.other.append(messages.encode(set_to("PARAM_02", 8), system=7, component=1, sequence=0))
        await anyio.sleep(2.0)
        assert by_name(station) == {"PARAM_02": struct.pack("<i", 8)}


# 6: packed, not paced


async def test_rule_6_frames_are_packed() -> None:
    async with in_sync(PX4Vehicle()) as (_, _, station):
        await station.ask(LIST, seconds=0.1)
        values = [data for data in station.datagrams if len(data) > 100]
        assert len(station.of(ParamValue)) == 904
        assert max(map(len, values)) <= 1_400
        assert len(values) <= 26
        assert station.times[-1] - station.times[0] >= 24 * stations.DATAGRAM_INTERVAL > 0.04
        await anyio.sleep(1.0)
        await station.ask(LIST, seconds=0.1)  # after a pause too
        assert station.times[-1] - station.times[0] > 0.04


async def test_rule_6_queues_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stations, "STATION_QUEUE_MAX", 10)
    monkeypatch.setattr(stations, "STREAMS_PER_STATION_MAX", 5)
    async with gateway_over(small_px4()) as served:
        station = await served.heard()
        for station.address in [(system, 190) for system in range(100, 200)]:
            station.send(GCS)
        served.link.is_stuck = True
        await anyio.sleep(30.0)
        [there] = served.gateway.stations
        assert there.dropped > 10
        assert len(there.sources) == stations.SOURCES_MAX
        station.clear()
        for stream in range(20):
            there.stream(stream, (1, 1), iter([GCS]))
        served.link.is_stuck = False
        await anyio.sleep(0.5)
        assert len(station.frames) <= 20


async def test_rule_6_stations_are_bounded_and_silent_ones_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stations, "STATIONS_MAX", 2)
    async with gateway_over(small_px4()) as served:
        for each in (partners := [served.partner(system=number) for number in (7, 8, 9)]):
            await each.ask(GCS)
        assert [each.sources for each in served.gateway.stations] == [{(8, 190)}, {(9, 190)}]
        await anyio.sleep(stations.STATION_TIMEOUT)
        await partners[2].ask(GCS)
        assert [each.sources for each in served.gateway.stations] == [{(9, 190)}]


@pytest.mark.parametrize("seconds", [1.0, 3.0])
async def test_rule_6_telemetry_holds_no_list_up(seconds: float) -> None:
    """Of a message that has waited for 2 s, the newest is sent: a slow link carries no others."""
    vehicle = Puppet(lambda message: ())
    async with in_sync(Air([small_px4(), vehicle])) as (served, _, station):
        await station.ask(GCS)
        frame = frames.build_frame(30, bytes(range(28)), system=1, component=1, sequence=1)
        served.link.is_stuck = True
        for _ in range(2_000):
            vehicle.say_bytes(frame)
        vehicle.say_bytes(frames.build_frame(74, bytes(20), system=1, component=1, sequence=2))
        await anyio.sleep(seconds)
        served.link.is_stuck = False
        await station.ask(LIST, seconds=1.0)
        ids = [each.message_id for each in station.frames]
        assert (first := ids.index(22)) < 200
        assert (30 in ids[first : first + 3]) == (seconds < 2)  # nor is it held up
        assert (ids.count(30) > 200, ids.count(74)) == (seconds < 2, 1)


# 7: sequence numbers


@pytest.mark.parametrize("loss", [0.0, 0.2])
async def test_rule_7_no_losses_but_those_of_the_radio(loss: float) -> None:
    async with gateway_over(Air.symmetric([PX4Vehicle()], loss=loss, seed=3)) as served:
        station = await served.heard()
        await served.synced()
        for _ in range(5):
            station.send(LIST)
            await anyio.sleep(1.0)
        await anyio.sleep(20.0)
        assert (station.lost[1, 1] > 0) == (loss > 0)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("extra", [0, 1, 111, 255])
def test_rule_7_renumbered_frames_are_valid_whatever_their_extra_byte_is(version: int, extra: int) -> None:
    payload = bytes(range(1, 26))
    head = bytes((0xFE, 25)) if version == 1 else bytes((0xFD, 25, 0, 0))
    tail = bytes((1, 1, 22)) if version == 1 else bytes((1, 1, 22, 0, 0))

    def frame(sequence: int) -> bytes:
        body = head + bytes((sequence,)) + tail + payload
        return body + fastcrc.crc16.mcrf4xx(body[1:] + bytes((extra,))).to_bytes(2, "little")

    for sequence in range(256):
        assert frames.renumber_frame(frame(17), sequence) == frame(sequence)


# 8: signing


async def test_rule_8_without_the_key_parameters_are_routed_and_frames_untouched() -> None:
    async with gateway_over(small_px4(signing_key=KEY)) as served:
        station = served.partner(key=KEY)
        assert await listed(station, seconds=8.0) == 26
        assert station.verifier is not None
        report = station.verifier.report()
        assert not report.refused
        assert {each.link_id for each in report.streams} == {0}  # the vehicle's
        assert station.lost[1, 1] == 0


async def test_rule_8_answers_are_signed_with_a_link_id_of_their_own() -> None:
    vehicle = Tap(small_px4(signing_key=KEY))
    async with gateway_over(vehicle, endpoint={"key": KEY}, signing=KEY) as served:
        await served.synced()
        station, other = served.partner(key=KEY), served.partner(system=9)
        other.send(GCS, LIST)  # unsigned
        vehicle.received.clear()
        await station.ask(LIST, set_to("PARAM_01", 5), seconds=3.0)
        assert len(station.of(ParamValue)) >= 26
        assert len(vehicle.messages(ParamSet)) == 1
        assert not vehicle.messages(ParamRequestList)
        assert station.of(messages.Heartbeat)
        assert station.verifier is not None
        report = station.verifier.report()
        assert not report.refused
        assert {each.link_id for each in report.streams} == {0, stations.ANSWER_LINK_ID}
        assert stations.ANSWER_LINK_ID >= 200
        assert not other.frames


@pytest.mark.parametrize("is_trusted", [False, True])
async def test_rule_8_an_unsigned_set_is_signed_for_a_trusted_endpoint_alone(is_trusted: bool) -> None:
    model = small_px4(signing_key=KEY)
    async with in_sync(model, endpoint={"is_trusted": is_trusted}, signing=KEY) as (_, _, station):
        await station.ask(set_to("PARAM_01", 5), seconds=3.0)
        assert model.values["PARAM_01"] == (5 if is_trusted else 1)
        await station.ask(LIST, seconds=3.0)
        assert (len(station.of(ParamValue)), station.lost[1, 1]) == (26 * is_trusted, 0)
        assert {bool(data[2]) for data in station.datagrams} == {not is_trusted}


async def test_rule_8_no_set_is_signed_for_an_unsigned_station_where_the_vehicle_does_not_sign() -> None:
    async with in_sync(small_px4(), signing=Signing(KEY, "accept-all")) as (_, vehicle, station):
        await station.ask(set_to("PARAM_01", 5), seconds=1.0)
        assert askers(vehicle) == {255}


# 9: no ground station


RANGE = {"MAV_GCS_SYSID": 200.0, "MAV_GCS_SYSID_HI": 255.0}


@pytest.mark.parametrize(("table", "own"), [({"SYSID_MYGCS": 254.0, "A": 1.0}, 253), (RANGE, 199)])
async def test_rule_9_the_gateway_is_no_ground_station(table: dict[str, float], own: int) -> None:
    async with in_sync(ArduPilotVehicle(table=table)) as (_, vehicle, _):
        await anyio.sleep(3.0)
        vehicle.received.clear()
        await anyio.sleep(3.0)
        assert {each.type for each in vehicle.messages(messages.Heartbeat)} == {18}
        assert {frame.system for _, frame, _ in vehicle.received} == {own}


async def test_rule_9_the_gateway_has_the_id_of_no_station() -> None:
    """Otherwise it would take their answers for its own."""
    async with in_sync(ArduPilotVehicle(), system=255, component=1) as (served, vehicle, _):
        station = served.partner(system=254, component=191)
        await served.partner(system=253).ask(GCS)
        await station.ask(GCS, seconds=2.0)
        vehicle.received.clear()
        [answer] = await station.ask_file(Opcode.OPEN_FILE_RO, data=b"nothing.txt")
        assert answer.opcode == Opcode.NAK
        await anyio.sleep(2.0)
        assert {frame.system for _, frame, _ in vehicle.received} == {252, 254}


async def test_rule_9_a_companion_may_have_the_system_id_of_the_gateway() -> None:
    async with in_sync(ArduPilotVehicle(), system=1) as (served, _, _):
        companion = served.partner(system=1, component=9)
        [answer] = await companion.ask_file(Opcode.OPEN_FILE_RO, data=b"nothing.txt")
        assert answer.opcode == Opcode.NAK


# 10: all components, and two vehicles with one id


async def test_rule_10_a_list_of_all_components() -> None:
    async with in_sync(Air([small_px4(), Puppet(lambda message: (), component=5)])) as (_, vehicle, station):
        await station.ask(ParamRequestList(1, 5), seconds=30.0)
        vehicle.received.clear()
        await station.ask(ParamRequestList(1, 0), seconds=1.0)
        assert len(station.of(ParamValue)) == 26
        asked = [message for _, frame, message in vehicle.received if frame.system == 255]
        assert asked == [ParamRequestList(1, 5)]


async def test_rule_10_what_is_asked_of_all_components() -> None:
    """A read is answered by those that have the name, and a set is one of the autopilot."""
    gimbal = generic(component=5, table={"TILT": 1.0})
    async with in_sync(Air([gimbal, small_px4()])) as (served, vehicle, station):
        await (await served.clients[0].component(1, 5)).fetch_all()
        vehicle.received.clear()
        write = ParamSet(1, 0, "PARAM_01", struct.pack("<i", 9), ParamType.INT32)
        await station.ask(ParamRequestRead(1, 0, "TILT", -1), write, seconds=1.0)
        assert by_name(station) == {"TILT": struct.pack("<f", 1), "PARAM_01": struct.pack("<i", 9)}
        assert requested(vehicle) == [replace(write, target_component=1)]


async def test_rule_10_a_read_for_whichever_vehicle_is_answered_from_each_table() -> None:
    async with gateway_over(Air([small_px4(), small_px4(system=2)])) as served:
        await served.clients[0].fetch_all()
        await (station := await served.heard()).ask(ParamRequestRead(0, 0, "PARAM_01", -1))
        assert {each.system for each in station.frames if each.message_id == 22} == {1, 2}


async def test_rule_10_what_is_for_an_autopilot_that_is_not_served_is_not_refused_by_another_one() -> None:
    """Its list has a name that is not stored."""
    gimbal = generic(component=5, table={"TILT": 1.0})
    vehicle = generic(table={"A,B": 1, "GAIN": 2}, autopilot=12)
    async with gateway_over(Air([gimbal, vehicle])) as served:
        station = await served.heard()
        await served.clients[0].fetch_all()
        reads = [ParamRequestRead(1, 0, name, -1) for name in ("TILT", "GAIN")]
        await station.ask(replace(set_to("GAIN", 9), target_component=0), *reads, seconds=3.0)
        assert (vehicle.param("GAIN").value, station.of(messages.ParamError)) == (9, [])
        assert by_name(station).keys() == {"TILT", "GAIN"}


@pytest.mark.parametrize("is_one_link", [False, True])
async def test_rule_10_two_vehicles_with_one_id(is_one_link: bool, caplog: pytest.LogCaptureFixture) -> None:
    vehicles = [Tap(small_px4()), Tap(small_px4())]
    async with gateway_over(*[PeersLink(dict(enumerate(vehicles)))] if is_one_link else vehicles) as served:
        await served.synced()
        station = served.partner()
        with caplog.at_level(logging.WARNING):
            await station.ask(LIST, seconds=2.0)
        assert caplog.text.count("1/1 is on two links") == (not is_one_link)
        for each in vehicles:
            assert [frame.system for _, frame, message in each.received if message == LIST][-1] == 255
        assert len(station.of(ParamValue)) == 52
        vehicles[1].is_mute = True
        await anyio.sleep(6.0)
        for each in vehicles:
            each.received.clear()
        assert await listed(station) == 26
        assert not any(map(requested, vehicles))


# 11: loops


async def test_rule_11_a_loop_ends() -> None:
    """The endpoint leads to the vehicle link itself."""
    vehicle = Tap(small_px4())
    loop = Puppet(lambda message: (), heartbeat=None)
    async with gateway_over(PeersLink({"vehicle": vehicle, "loop": loop})) as served:
        station = await served.heard()
        await served.synced()
        for _ in range(5):
            for data in station.datagrams:
                loop.say_bytes(data)
            await station.ask(seconds=1.0)
            assert len(station.frames) <= 3
        # of a vehicle that is kept
        station.send_bytes(frames.build_frame(0, bytes(9), system=1, component=1, sequence=1))
        await station.ask(seconds=0.2)
        assert len(station.frames) <= 2
        assert 1 not in {frame.system for _, frame, _ in vehicle.received}
        vehicle.received.clear()
        assert await listed(station) == 26
        assert not requested(vehicle)  # the loop is no second vehicle
        loop.say_bytes(b"".join(station.datagrams * 2))  # as a router may pack them
        await station.ask()
        assert not station.of(ParamValue)


@pytest.mark.parametrize("seconds", [0.0, 2.0])
async def test_rule_11_what_a_station_sends_ends_where_another_one_returns_it(seconds: float) -> None:
    """The vehicle link leads to the endpoint, which knows it when the gateway's own frames come."""
    link = PeersLink({"vehicle": (vehicle := Tap(small_px4()))})
    async with gateway_over(link) as served:
        station = await served.heard()
        link.endpoints["loop"] = served.as_vehicles()
        await anyio.sleep(seconds)
        for command in range(400, 405):
            await station.ask(messages.CommandLong(1, 1, command), seconds=1.0)
            assert len(station.frames) <= 4
        sent = [each.command for each in vehicle.messages(messages.CommandLong) if each.command < 405]
        assert sent == [400] * (1 if seconds else 2) + [401, 402, 403, 404]
        own = [frame.sequence for _, frame, _ in vehicle.received if frame.system == 254]
        assert len(own) == len({*own})


async def test_rule_11_neither_an_echo_of_the_radio_nor_a_key_reaches_a_station() -> None:
    radio = Radio(small_px4())
    async with in_sync(radio) as (served, _, station):
        echo = messages.encode(messages.CommandLong(1, 1, 400), system=9, component=190, sequence=0)
        key = messages.encode(messages.SetupSigning(1, 1, KEY, 1), system=7, component=1, sequence=0)
        served.partner(system=9).send_bytes(echo)
        await station.ask(GCS)
        radio.other += [echo, key]
        await anyio.sleep(0.5)
        assert {frame.system for frame in station.frames} == {1}


async def test_rule_11_a_vehicle_that_moves_is_no_copy_of_itself() -> None:
    vehicle = small_px4()
    link = PeersLink({"before": vehicle})
    async with gateway_over(link) as served:
        station = await served.heard()
        await served.synced()
        link.endpoints = {"after": vehicle}
        await anyio.sleep(12.0)
        station.clear()
        await anyio.sleep(5.0)
        assert len(station.of(messages.Heartbeat)) >= 4
        assert await listed(station) == 26


async def test_rule_11_a_gateway_behind_a_gateway(tmp_path: Path) -> None:
    """The outer gateway downloads the file from the inner one, and proves its cached table by checksums."""
    vehicle = Tap(model := ArduPilotVehicle())
    async with gateway_over(vehicle) as inner:
        await inner.synced()
        vehicle.received.clear()
        for source in ("ftp", "cache"):
            async with gateway_over(inner.as_vehicles(), cache=tmp_path / "cache.db") as outer:
                component = await outer.clients[0].component()
                await component.wait_until_identified(5.0)
                result = await component.fetch_all()
                assert (result.source, result.missing) == (source, ())
                assert bits(result.params) == bits(model.params)
                assert all(each.default is not None for each in result.params.values())
                await outer.partner().ask(set_to("ATC_ANG_RLL_P", len(source), ParamType.REAL32), seconds=1.0)
                assert component.params["ATC_ANG_RLL_P"].value == len(source)
        assert not vehicle.messages(FileTransfer)
        assert [type(each) for each in requested(vehicle)] == [ParamSet] * 2


# 12: MAVLink 1


async def test_rule_12_mavlink_1_only_to_a_station_of_it() -> None:
    async with gateway_over(small_px4()) as served:
        await served.synced()
        old, both = served.partner(version=1), served.partner(system=9)
        beat = messages.encode(GCS, system=9, component=190, sequence=0, version=1)
        both.send_bytes(beat)
        both.send(LIST)
        both.send_bytes(beat)
        await old.ask(LIST, ParamRequestRead(1, 1, "NONE", -1), seconds=3.0)  # which has a PARAM_ERROR in 2
        assert {each.version for each in old.frames if each.message_id == 22} == {1}
        assert {each.version for each in both.frames if each.message_id == 22} == {2}
        assert len(old.of(ParamValue)) == 26


# 13: endpoints


async def test_rule_13_a_readonly_endpoint() -> None:
    async with in_sync(small_px4(), endpoint={"is_readonly": True}) as (_, vehicle, station):
        station.send_bytes(frames.build_frame(44, bytes(4), system=255, component=190, sequence=1))
        harmless = messages.CommandLong(1, 1, 512, 148.0)
        await station.ask(set_to("PARAM_01", 33), messages.CommandLong(1, 1, 400), harmless, LIST, GCS)
        assert station.of(messages.ParamError) == [messages.ParamError(255, 190, "PARAM_01", -1, 5)]
        assert (by_name(station)["PARAM_01"], len(station.of(ParamValue))) == (struct.pack("<i", 1), 1 + 26)
        await station.ask_file(Opcode.CREATE_FILE, data=b"a.txt")
        await station.ask_file(Opcode.LIST_DIRECTORY, data=b"/")
        commands = [message for _, frame, message in vehicle.received if frame.system == 255]
        assert commands[:2] == [harmless, GCS]
        files = [Packet.unpack(each.payload).opcode for each in vehicle.messages(FileTransfer)]
        assert files == [Opcode.LIST_DIRECTORY]


def test_rule_13_names_of_endpoints(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o600)
    assert parse_endpoint("tcpin:5760").name == "tcpin:127.0.0.1:5760"
    assert parse_endpoint("udpin:0.0.0.0:14551?readonly&trusted").is_trusted
    signed = parse_endpoint(f"udpout:127.0.0.1:14550?sign={key}&trusted")
    assert signed.signer is not None
    assert signed.name == "udpout:127.0.0.1:14550"
    assert not signed.is_trusted  # its frames keep their signatures
    with pytest.raises(UsageError, match="no endpoint"):
        parse_endpoint("sim:px4?readonly")
    for option in ("writeonly", "readonly=1", "sign"):
        with pytest.raises(UsageError, match=f"'{option}' is not an option"):
            parse_endpoint(f"tcpin:5760?{option}")


# 14: visible, and the whole service


async def test_rule_14_stations_are_shown_with_what_they_save() -> None:
    link = StationsLink()
    async with browsing(small_px4(), mavlink=[MavlinkEndpoint(link)]) as browser:
        station, quiet = Partner(link), Partner(link, system=9)
        await station.ask(LIST)
        saved = sum(map(len, station.datagrams)) - 21  # but for the heartbeat before the list
        await quiet.ask(GCS)
        await browser.put(f"{V}/params/PARAM_01", json={"value": 9})
        shown, other = (await browser.get("/api/stations")).json()
        assert (other["answered"], other["saved_bytes"], list(by_name(quiet))) == (0, 0, ["PARAM_01"])
        assert shown["name"] == "udpin:stations:14551#station:0"
        assert (shown["ids"], shown["requests"]) == (["255/190"], {"ParamRequestList": 1})
        assert shown["answered"] == 26
        assert shown["saved_bytes"] == saved > 700
        metrics = (await browser.get("/metrics")).text
        for name, value in (("answered", 26), ("dropped", 0)):
            assert f'paramclient_stations_{name}{{endpoint="udpin:stations:14551"}} {value}.0' in metrics


def test_rule_14_a_service_that_only_listens_has_no_stations() -> None:
    with pytest.raises(UsageError, match="only listens"):
        Hub([small_px4()], cache=False, mavlink=["tcpin:0"], listen_only=True)


async def test_a_table_that_could_not_be_fetched_is_fetched_later() -> None:
    vehicle = Tap(small_px4())
    vehicle.is_deaf = True
    async with Hub([vehicle], cache=False) as hub:
        await anyio.sleep(30.0)
        assert hub.targets[0].component.sync_state == "unsynced"
        vehicle.is_deaf = False
        await anyio.sleep(90.0)
        assert hub.targets[0].component.sync_state == "synced"


@pytest.mark.asyncio
async def test_the_command_and_the_client_work_through_the_gateway() -> None:
    endpoints = [parse_endpoint("tcpin:0"), parse_endpoint("udpin:0")]
    vehicle = Tap(small_px4())
    async with Hub([vehicle], cache=False, mavlink=endpoints) as hub:
        await until(lambda: hub.targets and hub.targets[0].component.sync_state == "synced")
        vehicle.received.clear()
        tcp = endpoints[0].address.replace("tcpin", "tcp")

        async def command(*arguments: str) -> str:
            words = [sys.executable, "-m", "paramclient", *arguments, "--no-cache"]
            return (await anyio.run_process(words)).stdout.decode()

        assert "PARAM_01" in await command("fetch", tcp)
        assert "33" in await command("set", tcp, "PARAM_01", "33")
        assert "33" in await command("get", tcp, "PARAM_01")
        async with a_client(endpoints[1].address.replace("udpin", "udpout")) as client:
            component = await client.component()
            assert bits((await component.fetch_all()).params) == bits(hub.targets[0].component.params)
            assert (await component.set("PARAM_01", 34)).status == "accepted"
        assert len(vehicle.messages(ParamSet)) == 2
        assert not vehicle.messages(ParamRequestList)


# faults


async def test_a_silent_reset_by_a_station_is_found() -> None:
    model = small_px4()
    async with in_sync(model) as (_, _, station):
        await station.ask(set_to("PARAM_01", 9), seconds=3.0)
        reset = struct.pack("<7fH2B", 2, 0, 0, 0, 0, 0, 0, 245, 1, 1)
        for number, value in ((76, 1), (75, 2)):  # COMMAND_LONG, COMMAND_INT
            model.load({"PARAM_01": value})
            station.send_bytes(frames.build_frame(number, reset, system=255, component=190, sequence=value))
            await station.ask(LIST, ParamRequestRead(1, 1, "PARAM_01", -1), seconds=3.0)
            values = {each.raw for each in station.of(ParamValue) if each.param_id == "PARAM_01"}
            assert values == {struct.pack("<i", value)}


async def test_a_silent_reset_ends_a_list_and_no_value_on_its_way_is_served() -> None:
    async with in_sync(Air.symmetric([PX4Vehicle()], delay=0.1)) as (_, _, station):
        await station.ask(set_to("CAL_ACC0_XOFF", 5, ParamType.REAL32), seconds=0.15)
        await station.ask(LIST, seconds=0.01)
        await station.ask(messages.CommandLong(1, 1, messages.MAV_CMD_PREFLIGHT_STORAGE, 2.0), seconds=0.03)
        assert len(station.of(ParamValue)) <= 37
        await anyio.sleep(3.0)
        await station.ask(ParamRequestRead(1, 1, "CAL_ACC0_XOFF", -1))
        assert by_name(station) == {"CAL_ACC0_XOFF": bytes(4)}


async def test_a_restart_during_a_list() -> None:
    model = PX4Vehicle()
    async with in_sync(model) as (served, _, station):
        await station.ask(GCS, LIST, seconds=0.01)
        served.link.is_stuck = True
        model.reboot(down=8.0)
        await anyio.sleep(20.0)
        served.link.is_stuck = False
        await anyio.sleep(1.0)
        assert 0 < len(station.of(ParamValue)) < 903
        component = await served.clients[0].component()
        assert component.sync_state == "synced"
        await station.ask(LIST)
        wanted = {name for name, param in component.params.items() if param.index is not None}
        assert by_name(station).keys() - {"_HASH_CHECK"} == wanted


HIDDEN = {f"GRP_{number}": float(number) for number in range(20)}
TABLE = {f"P_{number:03}": float(number) for number in range(300)} | {"GRP_ENABLE": 0.0}
switched = partial(ArduPilotVehicle, table=TABLE, groups={"GRP_ENABLE": HIDDEN})


async def test_a_switch_of_a_group_during_a_list() -> None:
    """The list has one count; what the switch has shown is announced."""
    async with in_sync(switched()) as (served, _, station):
        await station.ask(GCS, LIST, seconds=0.004)
        await (await served.clients[0].component()).set("GRP_ENABLE", 1.0)
        await anyio.sleep(20.0)
        indexed = [each for each in station.of(ParamValue) if each.param_index != 65535]
        assert {each.param_count for each in indexed} == {301}
        await station.ask(LIST)
        assert {each.param_count for each in station.of(ParamValue)} == {321}
        assert by_name(station).keys() == {*TABLE, *HIDDEN}


async def test_a_switch_of_a_group_during_the_fetch() -> None:
    """The list begins again: the indices have changed."""
    async with gateway_over(switched(ftp=False, burst=1)) as served:
        component = await served.clients[0].component()
        station = served.partner()
        await station.ask(LIST, seconds=2.0)
        assert 0 < len(by_name(station)) < 301
        await component.set("GRP_ENABLE", 1.0)
        await anyio.sleep(20.0)
        indexed = {each.param_index for each in station.of(ParamValue) if each.param_count == 321}
        assert indexed >= {*range(321)}


async def test_a_station_that_floods_and_one_that_sends_garbage() -> None:
    """Another station is answered as without them, and what waits for the vehicle does not grow."""
    async with in_sync(Air.symmetric([PX4Vehicle()], delay=0.05)) as (served, vehicle, station):
        flood, garbage = served.partner(system=7), served.partner(system=8)
        noise, tasks = random.Random(1), len(anyio.get_running_tasks())
        for number in range(90):
            opening = partial(Packet, 1, opcode=Opcode.OPEN_FILE_RO, data=b"a.txt")
            opened = [opening(session=(3 * number + each) % 256) for each in range(3)]
            flood.send(*(FileTransfer(0, 1, 1, each.pack()) for each in opened), *[LIST] * 30)
            flood.send(*[ParamRequestRead(1, 1, f"N{number}", -1)] * 20)
            flood.send(*(ParamRequestRead(1, 1, "", index) for index in range(900, 950)))
            flood.send(*(set_to("MC_PITCH_P", number + each / 64, ParamType.REAL32) for each in range(60)))
            for piece in (noise.randbytes(500), *[b"\xfd" * 500] * 9):
                garbage.send_bytes(piece)
            await anyio.sleep(0.01)
        for each in (flood, garbage):
            each.send(messages.CommandLong(1, 1, 400))  # dropped unread, as all of a flood in this second
        assert len(anyio.get_running_tasks()) <= tasks + stations.REQUESTS_MAX + stations.SETS_AT_ONCE
        asked = set_to("MC_ROLL_P", 3, ParamType.REAL32), ParamRequestRead(1, 1, "UNKNOWN", -1)
        await station.ask(LIST, *asked, seconds=1.5)
        assert len(station.of(ParamValue)) >= 904
        assert by_name(station)["MC_ROLL_P"] == struct.pack("<f", 3)
        assert [each.param_id for each in station.of(messages.ParamError)] == ["UNKNOWN"]
        assert len(requested(vehicle)) < 200
        assert not vehicle.messages(messages.CommandLong)
        assert max(len(each.files) for each in served.gateway.stations) == kept_file.OPEN_FILES_MAX
        assert station.of(messages.Heartbeat)


async def test_the_reads_of_a_station_hold_no_other_up() -> None:
    async with in_sync(Air.symmetric([PX4Vehicle()], delay=0.02, rate=2_500)) as (served, _, station):
        served.partner(system=7).send(*(ParamRequestRead(1, 1, f"N{number}", -1) for number in range(200)))
        await station.ask(ParamRequestRead(1, 1, "UNKNOWN", -1), seconds=3.0)
        assert [each.param_id for each in station.of(messages.ParamError)] == ["UNKNOWN"]


async def test_noise_is_searched_once_and_little_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each byte of it may begin a frame. It comes in a datagram, and byte by byte in a stream."""
    counted = Mock(wraps=frames.checksum)
    monkeypatch.setattr(taps, "checksum", counted)
    async with in_sync(small_px4()) as (served, _, _):
        served.partner().send_bytes(b"\xfe" * 60_000)
        await anyio.sleep(0.5)
    cutter = taps.FrameCutter(stream=True)
    for _ in range(2_000):
        cutter.cut(b"\xfe", None)
    assert counted.call_count < 10_000


@pytest.mark.asyncio
async def test_a_station_that_never_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Others are served meanwhile, and its connection is closed."""
    monkeypatch.setattr(sockets, "SEND_TIMEOUT", 0.5)
    monkeypatch.setattr(sockets, "SILENCE_TIMEOUT", 600.0)
    endpoint = parse_endpoint("tcpin:0")
    async with Hub([PX4Vehicle()], cache=False, mavlink=[endpoint]) as hub:
        await until(lambda: hub.targets and hub.targets[0].component.sync_state == "synced")
        name = endpoint.address.replace("tcpin", "tcp")
        with socket.socket() as deaf:
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            deaf.connect(("127.0.0.1", int(name.rpartition(":")[2])))
            deaf.setblocking(False)
            await until(lambda: hub.gateway.stations)
            [station] = hub.gateway.stations

            async def ask() -> None:
                while True:
                    with suppress(OSError):
                        deaf.send(messages.encode(LIST, system=9, component=190, sequence=0))
                    await anyio.sleep(0.05)

            async with anyio.create_task_group() as tasks, a_client(name) as client:
                tasks.start_soon(ask)
                component = await client.component()
                assert len((await component.fetch_all()).params) == 903
                await until(lambda: station not in hub.gateway.stations)
                assert (await component.get(902)).index == 902
                tasks.cancel_scope.cancel()


async def test_memory_stays_flat(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_table, "UNKNOWN_NAMES_MAX", 50)
    sizes = []
    async with gateway_over(small_px4(param_error=True)) as served:
        await served.synced()
        stations = [served.partner(system=number) for number in range(200, 205)]
        tracemalloc.start()
        for number in range(8):
            for each in stations:
                each.send(GCS, LIST, set_to("PARAM_01", number), messages.CommandLong(1, 1, 400, number))
                each.send(*(ParamRequestRead(1, 1, f"N{number}_{name}", -1) for name in range(40)))
            await anyio.sleep(10.0)
            for each in stations:
                each.clear()
            messages.text_of.cache_clear()  # bounded, and of all tests: it grows in steps of its dictionary
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert sizes[-1] - sizes[3] < 8_000, sizes


async def test_twenty_stations_and_ten_vehicles() -> None:
    vehicles = [small_px4(system=number) for number in range(1, 11)]
    async with gateway_over(Air.symmetric(vehicles, loss=0.1, delay=0.05, seed=2)) as served:
        stations = [served.partner(system=number) for number in range(200, 220)]
        for each in stations:
            each.send(GCS)
        await anyio.sleep(3.0)
        for each in stations:
            each.send(ParamRequestList(0, 0))
        await anyio.sleep(30.0)
        for each in stations:
            for vehicle in vehicles:
                known = {value.param_id: value.raw for value in each.of(ParamValue, system=vehicle.system)}
                for param in vehicle.listed:
                    assert known[param.name] == encode_value(param.settable, param.type, Encoding.BYTEWISE)
