"""ArduPilot's checksum: it proves a cached table, finds what has changed, and never proves a wrong one."""

from __future__ import annotations

import itertools
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace

import anyio
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from paramclient.errors import FileErrorCode
from paramclient.model.px4_hash import crc32_px4, crc32_px4_before
from paramclient.model.values import Param, ParamType, Trust, from_bits
from paramclient.protocol.checksum import CHECKED_READ_SIZE
from paramclient.protocol.fetch import FetchResult, fetch_all
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.protocol.node import Node
from paramclient.protocol.param_pck import PackedParam, encode_entries
from paramclient.protocol.watch import Watch
from paramclient.protocol.writes import write
from paramclient.sim import Air, ArduPilotVehicle, Endpoint
from paramclient.wire.messages import (
    NO_INDEX,
    FileTransfer,
    Heartbeat,
    Message,
    ParamRequestList,
    ParamRequestRead,
    ParamValue,
    encode,
)
from tests.conversations.virtual import Conversation, converse, meanwhile, run, virtual_on_both
from tests.shell import Tap

MOVED = ("INS_GYROFFS_X", "INS_GYR2OFFS_Z", "BARO1_GND_PRESS", "STAT_RUNTIME", "STAT_BOOTCNT")


async def with_cached_table(conversation: Conversation, cached: dict[str, Param], **options: object) -> Node:
    """Return the identified autopilot with a table as the cache loads it."""
    node = await conversation.node()
    await node.identification.settled()
    count_ = sum(param.index is not None for param in cached.values())
    known = {"volatile": (), "volatile_is_known": False, "hash": 1, "count": count_}
    known |= {"moments": dict.fromkeys(cached, -1.0)} | options
    node.plain.table.load(cached.values(), **known)  # type: ignore[arg-type]  # a mapping of options
    return node


@asynccontextmanager
async def cached_on(
    endpoint: Endpoint, cached: dict[str, Param], **options: object
) -> AsyncIterator[tuple[Conversation, Node]]:
    """Open a station, whose autopilot has a table as the cache loads it."""
    async with converse(endpoint) as conversation:
        yield conversation, await with_cached_table(conversation, cached, **options)


def opcodes(conversation: Conversation) -> list[int]:
    """Return the MAVFTP requests that were sent."""
    return [Packet.unpack(each.payload).opcode for each in conversation.sent_of(FileTransfer)]


async def fetched(vehicle: ArduPilotVehicle, node: Node) -> FetchResult:
    """Fetch, and check that every value is the vehicle's, and that nothing is merely cached."""
    result = await fetch_all(node.plain)
    for param in vehicle.listed:
        assert result.params[param.name].same_value(param), param.name
    assert not any(each.trust is Trust.CACHED for each in node.plain.table.params.values())
    return result


@virtual_on_both
async def test_an_unchanged_table_costs_one_request_and_opens_nothing() -> None:
    vehicle = ArduPilotVehicle()
    async with cached_on(Air.symmetric([vehicle], delay=0.02), vehicle.params) as (conversation, node):
        began = anyio.current_time()
        result = await fetched(vehicle, node)
        assert anyio.current_time() - began < 0.05
        assert (result.source, result.changed, result.notes) == ("cache", (), ())
        assert result.hash is not None
        assert opcodes(conversation) == [Opcode.CALC_FILE_CRC32]
        assert {each.trust for each in result.params.values()} == {Trust.VERIFIED}


@pytest.mark.parametrize(("delay", "seconds"), [(0.004, 0.05), (0.05, 0.12)])
@pytest.mark.parametrize("passed", [0, 30])
async def test_seconds_that_were_counted_need_no_read(delay: float, seconds: float, passed: int) -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    vehicle.load({"STAT_RUNTIME": 600})
    cached = vehicle.params
    async with cached_on(Air.symmetric([vehicle], delay=delay), cached) as (conversation, node):
        vehicle.load({"STAT_RUNTIME": int(cached["STAT_RUNTIME"].value) + passed})
        sent, began = len(conversation.sent), anyio.current_time()
        result = await fetched(vehicle, node)
        assert (result.source, result.changed) == ("cache", ())
        assert anyio.current_time() - began < seconds
        assert sum(map(len, conversation.sent[sent:])) < 350  # the answers are shorter
        assert not conversation.sent_of(ParamRequestRead)


async def test_pressure_that_a_rover_measures_all_the_time_needs_no_read() -> None:
    vehicle = ArduPilotVehicle(kind="rover", live_period=0.0)
    vehicle.load({"STAT_RUNTIME": 600})
    async with cached_on(Air.symmetric([vehicle], delay=0.004), vehicle.params) as (conversation, node):
        for step, reads in ((0.5, 0), (1.25, 0), (-3.5, 0), (4000.0, 2)):
            moved = {n: float(vehicle.param(n).value) + step for n in ("BARO1_GND_PRESS", "BARO2_GND_PRESS")}
            vehicle.load(moved)
            vehicle.load({"STAT_RUNTIME": int(vehicle.param("STAT_RUNTIME").value) + 30})
            await anyio.sleep(30)
            node.plain.table.doubt()
            sent = len(conversation.sent)
            result = await fetched(vehicle, node)
            assert (result.source, result.changed) == ("cache", ())
            assert len(conversation.sent_of(ParamRequestRead)) <= reads
            assert reads or sum(map(len, conversation.sent[sent:])) < 350  # the answers are shorter


async def test_a_value_that_moves_between_two_requests_starts_no_search() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    cached = vehicle.params

    def passes(message: Message) -> bool:
        if isinstance(message, FileTransfer) and len(opcodes(conversation)) > 1:
            vehicle.load({"STAT_RUNTIME": 60})
        return True

    async with converse(Tap(vehicle, up=passes)) as conversation:
        vehicle.load({"STAT_RUNTIME": 30})
        assert (await fetched(vehicle, await with_cached_table(conversation, cached))).source == "cache"
        assert len(opcodes(conversation)) <= 6


@pytest.mark.parametrize(("after", "is_lost"), [(0, False), (1, False), (1, True), (2, False), (3, False)])
async def test_pressure_that_moves_between_answers_costs_nothing(after: int, is_lost: bool) -> None:
    vehicle = ArduPilotVehicle(kind="rover", live_period=0.0)
    moved = {n: float(vehicle.param(n).value) + 0.5 for n in ("BARO1_GND_PRESS", "BARO2_GND_PRESS")}
    answers = itertools.count()

    def passes(message: Message) -> bool:
        if isinstance(message, FileTransfer) and next(answers) == after:
            vehicle.load(moved)
            for name, new in moved.items():
                conversation.hear(ParamValue(name, struct.pack("<f", new), 9, len(vehicle.listed), NO_INDEX))
            return not is_lost
        return True

    async with converse(Air.symmetric([Tap(vehicle, down=passes)], delay=0.05)) as conversation:
        node = await with_cached_table(conversation, vehicle.params)
        began = anyio.current_time()
        result = await fetched(vehicle, node)
        assert (result.source, result.changed) == ("cache", ())
        assert anyio.current_time() - began < 0.15 + 0.2 * is_lost
        assert len(set(conversation.sent_of(FileTransfer))) == 4


async def test_values_that_move_are_read_by_their_checksum_and_learnt() -> None:
    vehicle = ArduPilotVehicle()
    async with converse(vehicle) as conversation:
        cached = vehicle.params
        vehicle.load({"STAT_RUNTIME": 4711, "BARO1_GND_PRESS": 94_000.5, "ATC_RAT_RLL_P": 0.25})
        node = await with_cached_table(conversation, cached)
        result = await fetched(vehicle, node)
        assert (result.source, result.changed) == ("cache", ("ATC_RAT_RLL_P",))
        assert node.plain.table.volatile >= {"STAT_RUNTIME"}


async def test_an_announcement_before_the_cached_table_takes_no_index_away() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    async with converse(vehicle) as conversation:
        node = await conversation.node()
        value = struct.pack("<f", 31.0)
        conversation.hear(ParamValue("STAT_RUNTIME", value, ParamType.INT32, 1382, NO_INDEX))
        assert node.plain.table.params["STAT_RUNTIME"].index is None
        await with_cached_table(conversation, vehicle.params)
        result = await fetched(vehicle, node)
        assert (result.source, result.missing) == ("cache", ())


async def test_a_restart_is_recognized_by_the_boot_count() -> None:
    vehicle = ArduPilotVehicle()
    async with converse(vehicle) as conversation:
        cached = vehicle.params
        node = await with_cached_table(conversation, cached)
        vehicle.load({name: cached[name].value * 2 + 1 for name in MOVED})  # type: ignore[operator]  # numbers
        sent, began = len(conversation.sent), anyio.current_time()
        result = await fetched(vehicle, node)
        assert (result.source, result.changed) == ("cache", ())
        assert sum(map(len, conversation.sent[sent:])) < 2_000
        assert anyio.current_time() - began < 0.4


async def test_two_values_changed_by_others_are_found_and_named() -> None:
    vehicle = ArduPilotVehicle()
    async with converse(vehicle) as conversation:
        cached = vehicle.params
        cached["ATC_RAT_RLL_P"] = replace(cached["ATC_RAT_RLL_P"], default=0.135)
        node = await with_cached_table(conversation, cached)
        vehicle.load({"ATC_RAT_RLL_P": 0.25, "FORMAT_VERSION": 121})
        sent, began = len(conversation.sent), anyio.current_time()
        result = await fetched(vehicle, node)
        assert (result.source, set(result.changed)) == ("cache", {"ATC_RAT_RLL_P", "FORMAT_VERSION"})
        assert "ATC_RAT_RLL_P" in result.notes[0]
        assert result.params["ATC_RAT_RLL_P"].default == 0.135
        assert sum(map(len, conversation.sent[sent:])) < 1_000
        assert anyio.current_time() - began < 0.2
        assert {each.name: each.by for each in conversation.changes}["FORMAT_VERSION"] == "vehicle"


async def test_changed_values_are_found_in_less_time_than_the_file_takes() -> None:
    """Also values without a short decimal form, of which the checksum does not show in which row they are."""
    elapsed = []
    for cached, values in (
        ({}, {}),
        (ArduPilotVehicle().params, {"ATC_RAT_RLL_P": 0.25, "FORMAT_VERSION": 121}),
        (ArduPilotVehicle().params, {"ATC_RAT_RLL_P": 0.2512345}),
    ):
        vehicle = ArduPilotVehicle(live_period=0.0)
        vehicle.load(values)
        async with converse(Air.symmetric([vehicle], delay=0.05)) as conversation:
            node = await with_cached_table(conversation, cached, count=len(cached) or None)
            result = await fetched(vehicle, node)
            assert (result.source, set(result.changed)) == ("cache" if cached else "ftp", set(values))
            elapsed.append(result.elapsed)
    assert max(elapsed[1:]) < elapsed[0]


@pytest.mark.parametrize("delay", [0.002, 0.05, 0.3])
@pytest.mark.parametrize("is_simple", [True, False], ids=["simple", "odd"])
async def test_a_search_ends_where_the_file_is_quicker(delay: float, is_simple: bool) -> None:
    floats = [each.name for each in ArduPilotVehicle().listed if each.type is ParamType.REAL32]
    for number in (5, 12, 20):
        vehicle = ArduPilotVehicle()
        cached = vehicle.params
        names = [name for name in floats if name[:3] not in ("INS", "BAR")][number :: 400 // number][:number]
        vehicle.load({name: at + (2.5 if is_simple else 1 / 7) for at, name in enumerate(names)})
        async with cached_on(Air.symmetric([vehicle], delay=delay), cached) as (_, node):
            result = await fetched(vehicle, node)
            assert result.elapsed < 0.45 + 6 * 2 * delay  # the file takes 0.37 s and 3 round trips


async def test_a_changed_count_costs_one_round_trip() -> None:
    elapsed = []
    for cached in ({}, ArduPilotVehicle().params):
        vehicle = ArduPilotVehicle(live_period=0.0)
        vehicle.load({"EK2_ENABLE": 1})
        async with converse(Air.symmetric([vehicle], delay=0.05)) as conversation:
            node = await with_cached_table(conversation, cached, count=len(cached) or None)
            result = await fetched(vehicle, node)
            assert result.source == "ftp"
            elapsed.append(result.elapsed)
    assert elapsed[1] - elapsed[0] < 0.12


async def test_a_download_in_place_of_a_search_names_the_changes() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    async with cached_on(vehicle, vehicle.params) as (_, node):
        names = NAMES[300:700:20]
        vehicle.load({**dict.fromkeys(names, 3), "STAT_RUNTIME": 5})
        result = await fetch_all(node.plain)
        assert (result.source, set(result.changed) - set(names)) == ("ftp", set())
        assert len(result.changed) >= len(names) - 1  # one may have been 3
        assert any("Changed since they were cached" in note for note in result.notes)


async def test_a_value_that_is_another_at_each_read_ends_the_search() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)

    def passes(message: Message) -> bool:
        if isinstance(message, ParamRequestRead):
            vehicle.load({"ATC_RAT_RLL_P": 0.25 + len(conversation.sent) / 1024})
        return True

    async with converse(Tap(vehicle, up=passes)) as conversation:
        node = await with_cached_table(conversation, vehicle.params)
        vehicle.load({"ATC_RAT_RLL_P": 0.25})
        began = anyio.current_time()
        await fetched(vehicle, node)
        assert anyio.current_time() - began < 2.0


@pytest.mark.parametrize(("loss", "delay"), [(0.05, 0.2), (0.2, 0.05), (0.2, 0.2)])
@pytest.mark.parametrize("changed", [{}, {"STAT_RUNTIME": 99, "ATC_RAT_RLL_P": 0.25}], ids=["same", "other"])
def test_loss_leaves_nothing_wrong(loss: float, delay: float, changed: dict[str, float]) -> None:
    async def main() -> None:
        for seed in range(4):
            vehicle = ArduPilotVehicle()
            cached = vehicle.params
            vehicle.load(changed)
            async with converse(Air.symmetric([vehicle], loss=loss, delay=delay, seed=seed)) as conversation:
                result = await fetched(vehicle, await with_cached_table(conversation, cached))
                assert result.changed == tuple(changed)[1:]  # without the run time

    run(main)


CASES = {
    "unknown command": ("ftp", "refused"),
    "silent": ("stream", "MAVFTP did not answer"),
    "denied": ("stream", "no file of its parameters"),
    "announced": ("ftp", "another number"),
    "announced later": ("ftp", "another number"),
    "count": ("ftp", "other parameters"),
    "many": ("ftp", "quicker than a search"),
    "renamed": ("ftp", "other parameters"),
    "rounded": ("cache", ""),
}


@pytest.mark.parametrize("kind", CASES)
async def test_where_it_does_not_work_the_table_is_downloaded(kind: str) -> None:
    vehicle = ArduPilotVehicle(ftp=kind != "denied")
    cached = vehicle.params
    if kind in ("count", "announced", "announced later"):
        vehicle.load({"EK2_ENABLE": 1})
    elif kind == "many":
        vehicle.load(dict.fromkeys(list(cached)[300:700:20], 3))
    elif kind == "renamed":
        cached["STAT_BOOTCNX"] = replace(cached.pop("STAT_BOOTCNT"), name="STAT_BOOTCNX")
        vehicle.load({"STAT_RUNTIME": 5})
    elif kind == "rounded":
        vehicle.load({"BARO_PROBE_EXT": 0x7654321})
        cached["BARO_PROBE_EXT"] = replace(cached["BARO_PROBE_EXT"], bits=0x7654320)

    def passes(message: Message) -> bool:
        if not isinstance(message, FileTransfer) or kind not in ("silent", "unknown command"):
            return True
        request = Packet.unpack(message.payload)
        if kind == "silent" or request.opcode != Opcode.CALC_FILE_CRC32:
            return kind != "silent"
        code = bytes((FileErrorCode.UNKNOWN_COMMAND,))
        refusal = Packet(request.sequence + 1, 0, Opcode.NAK, code, requested=request.opcode)
        conversation.hear(FileTransfer(0, 255, 190, refusal.pack()))
        return False

    announcement = ParamValue("STAT_RUNTIME", bytes(4), ParamType.INT32, 1434, NO_INDEX)
    async with converse(Tap(vehicle, up=passes)) as conversation:
        if kind == "announced":
            await conversation.node()
            conversation.hear(announcement)
        node = await with_cached_table(conversation, cached)
        if kind == "announced later":
            conversation.hear(announcement)
        began = anyio.current_time()
        result = await fetched(vehicle, node)
        source, reason = CASES[kind]
        assert (result.source, result.hash is None) == (source, source != "cache")
        assert reason in " ".join(result.notes)
        assert ("EK2_ENABLE" in result.changed) == (kind in ("count", "announced later"))
        assert anyio.current_time() - began < 3.0


async def test_the_integers_of_a_file_stay_where_the_first_heartbeat_is_behind_it() -> None:
    vehicle, began = ArduPilotVehicle(live_period=0.0), anyio.current_time()

    def passes(message: Message) -> bool:
        return not isinstance(message, Heartbeat) or anyio.current_time() > began + 1.8

    async with converse(Tap(vehicle, down=passes)) as conversation:
        conversation.hear(ParamValue("ATC_RAT_RLL_P", bytes(4), ParamType.REAL32, 1382, NO_INDEX))
        node = await conversation.node()
        result = await fetch_all(node.plain)
        await anyio.sleep(4.0)
        for params in (result.params, node.plain.table.params):
            assert all(params[param.name].same_value(param) for param in vehicle.listed)


@pytest.mark.parametrize("late", [0.0, 2.0])
async def test_a_cached_table_is_proven_where_the_first_heartbeat_is_behind_the_version(late: float) -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    cached = vehicle.params

    def passes(message: Message) -> bool:
        return not isinstance(message, Heartbeat) or anyio.current_time() > 0.9 + late

    async with converse(Tap(vehicle, down=passes)) as conversation:
        value = cached["ATC_RAT_RLL_P"].bits.to_bytes(4, "little")
        conversation.hear(ParamValue("ATC_RAT_RLL_P", value, ParamType.REAL32, len(vehicle.listed), NO_INDEX))
        node = await with_cached_table(conversation, cached)
        await anyio.sleep(late)
        assert node.identification.autopilot is None
        result = await fetch_all(node.plain)
        assert (result.source, result.notes) == ("cache", ())


async def test_nothing_is_checked_or_changed_by_a_refresh_or_without_a_complete_table() -> None:
    vehicle = ArduPilotVehicle()
    cached = vehicle.params
    del cached["STAT_RESET"]
    for table, refresh in (({}, False), (cached, False), (vehicle.params, True)):
        async with converse(vehicle) as conversation:
            node = await with_cached_table(conversation, table, count=len(table) and len(vehicle.params))
            assert (await fetch_all(node.plain, refresh=refresh)).source == "ftp"
            assert Opcode.CALC_FILE_CRC32 not in opcodes(conversation)


async def test_another_stations_open_file_costs_one_request() -> None:
    vehicle = ArduPilotVehicle()
    async with cached_on(vehicle, vehicle.params) as (conversation, node):
        opening = Packet(7, 3, Opcode.OPEN_FILE_RO, b"@PARAM/param.pck")
        data = encode(FileTransfer(0, 1, 1, opening.pack()), system=252, component=190, sequence=0)
        vehicle.receive(data, anyio.current_time())
        await anyio.sleep(0.1)
        result = await fetched(vehicle, node)
        assert result.source != "cache"
        assert "MAVFTP is in use for another file" in " ".join(result.notes)
        assert opcodes(conversation).count(Opcode.CALC_FILE_CRC32) == 1


NAMES = [param.name for param in ArduPilotVehicle().listed]
CHANGES = st.dictionaries(st.sampled_from(NAMES), st.integers(1, 2**32 - 1), min_size=1, max_size=20)


@settings(deadline=None, max_examples=40, phases=[Phase.generate])
@given(changes=CHANGES, kind=st.sampled_from(["values", "type", "name", "count"]), place=st.integers(0, 1381))
def test_no_difference_is_ever_taken_for_equal(changes: dict[str, int], kind: str, place: int) -> None:
    async def main() -> None:
        vehicle = ArduPilotVehicle(live_period=0.0)
        cached = vehicle.params
        for name, difference in changes.items():
            param = cached[name]
            bits = param.bits ^ (difference & (1 << 8 * param.type.size) - 1)
            cached[name] = replace(param, bits=bits, value=from_bits(bits, param.type))
        name = NAMES[place]
        param = cached[name]
        if kind == "type":
            other = ParamType.INT8 if param.type is not ParamType.INT8 else ParamType.INT16
            cached[name] = Param(name, 1, other, param.index, 1)
        elif kind == "name":
            cached[name] = replace(param, name="NO_SUCH_NAME")
        elif kind == "count":
            del cached[NAMES[-1]]
        async with cached_on(vehicle, {each.name: each for each in cached.values()}) as (_, node):
            assert set((await fetched(vehicle, node)).params) == set(vehicle.params)

    run(main)


def _of_another_type(cached: dict[str, Param], name: str) -> None:
    param = cached[name]
    kind = ParamType.REAL32 if param.type is ParamType.INT32 else ParamType.INT32
    cached[name] = Param(name, from_bits(param.bits, kind), kind, param.index, param.bits)


def _renamed(cached: dict[str, Param], old: str, new: str) -> None:
    cached[new] = replace(cached.pop(old), name=new)


def _swapped(cached: dict[str, Param], one: str, other: str) -> None:
    first, second = cached[one], cached[other]
    cached |= {one: replace(first, index=second.index), other: replace(second, index=first.index)}


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (_of_another_type, ["RTL_ALT"]),
        (_of_another_type, ["STAT_RUNTIME"]),
        (_of_another_type, ["ATC_RAT_RLL_P"]),
        (_renamed, ["EK3_HRT_FILT", "EK3_HRT_FILQ"]),
        (_renamed, ["STAT_RUNTIME", "STAT_RUNTIMX"]),
        (_renamed, ["STAT_FLTTIME", "STAT_FLYTIME"]),
        (_swapped, ["COMPASS_OFS_X", "COMPASS_OFS_Y"]),
    ],
)
async def test_no_value_makes_up_for_a_name_or_type(change: Callable[..., None], names: list[str]) -> None:
    """The checksum is linear: some value of 4 bytes has it, whatever stands before."""
    vehicle = ArduPilotVehicle(live_period=0.0)
    cached = vehicle.params
    change(cached, *names)
    async with cached_on(vehicle, cached) as (_, node):
        assert set((await fetched(vehicle, node)).params) == set(vehicle.params)


async def test_a_change_in_the_middle_of_a_proof_is_not_proven() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    async with cached_on(Air.symmetric([vehicle], delay=0.05), vehicle.params) as (conversation, node):
        async with meanwhile(fetched(vehicle, node)) as ends:
            await anyio.sleep(0.06)
            vehicle.load({"EK2_ENABLE": 1})
            value = ParamValue("ATC_RAT_RLL_P", struct.pack("<f", 0.25), ParamType.REAL32, 1434, NO_INDEX)
            conversation.hear(value)
        assert (ends[0].missing, len(ends[0].params)) == ((), 1434)


async def test_a_restart_within_a_slow_proof_leaves_no_value_of_before() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    cached = vehicle.params
    vehicle.load({"ATC_RAT_RLL_P": 0.2512345})
    async with cached_on(Air.symmetric([vehicle], delay=0.3), cached) as (_, node):
        async with meanwhile(fetched(vehicle, node)) as ends:
            await anyio.sleep(0.9)
            vehicle.reboot()
        assert (ends[0].source, ends[0].changed) == ("cache", ("ATC_RAT_RLL_P",))


async def test_an_acknowledgement_as_real32_changes_no_type() -> None:
    """ArduPilot acknowledges the set of a default as REAL32, whatever the type is."""
    vehicle = ArduPilotVehicle(live_period=0.0)
    async with cached_on(vehicle, vehicle.params) as (_, node):
        await fetch_all(node.plain)
        for name in ("BARO_PROBE_EXT", "LOG_BITMASK", "RTL_ALT", "ARMING_CHECK"):
            before = vehicle.param(name)
            await write(node.plain, name, before.value)
            assert node.plain.table.params[name].same_value(before)
        result = await fetched(vehicle, node)
        assert (result.source, result.changed) == ("cache", ())


async def test_a_list_with_a_gap_in_its_names_is_no_question_for_a_checksum() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    cached = vehicle.params
    cached["WP_NAVALT_MIN_"] = replace(cached["WP_NAVALT_MIN"], name="WP_NAVALT_MIN_")
    async with cached_on(vehicle, cached, count=1382) as (_, node):
        node.plain.table.names[9] = node.plain.table.names[8]
        assert (await fetched(vehicle, node)).source == "ftp"


@pytest.mark.parametrize("is_cached", [True, False], ids=["cached", "downloaded"])
@virtual_on_both
async def test_a_watch_finds_a_lost_announcement_for_one_request(is_cached: bool) -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    async with converse(vehicle) as conversation:
        table = vehicle.params if is_cached else {}
        node = await with_cached_table(conversation, table, count=len(vehicle.params))
        await fetch_all(node.plain)
        watch = Watch(node.plain, node.presence, lambda event: None)
        watch.fetched()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(watch.run)
            before = len(conversation.sent_of(FileTransfer))
            await anyio.sleep(31.0)
            assert len(conversation.sent_of(FileTransfer)) - before == 1
            vehicle.load({"ATC_RAT_RLL_P": 0.25})
            with watch.held():  # as while a program writes
                await anyio.sleep(31.0)
            await anyio.sleep(1.1)
            assert node.plain.table.params["ATC_RAT_RLL_P"].value == 0.25
            assert Opcode.OPEN_FILE_RO not in opcodes(conversation)[before:]
            vehicle.load(dict.fromkeys(NAMES[300:700:20], 3))  # as a written param.pck: not announced
            await anyio.sleep(31.0)
            assert all(node.plain.table.params[name].value == 3 for name in NAMES[300:700:20])
            for is_on in (1, 0):  # with parameters of its own
                vehicle.load({"EK2_ENABLE": is_on})
                await anyio.sleep(31.0)
                assert node.plain.table.count == len(vehicle.listed)
            node.identification.capabilities = 0  # it was restarted without MAVFTP
            await anyio.sleep(62.0)
            assert not conversation.sent_of(ParamRequestList)
            tasks.cancel_scope.cancel()


async def test_a_listed_name_that_no_file_can_contain_is_no_proof_and_no_error() -> None:
    vehicle = ArduPilotVehicle()
    async with cached_on(vehicle, vehicle.params) as (conversation, node):
        conversation.hear(ParamValue("RC MAP", bytes(4), ParamType.REAL32, node.plain.table.count or 0, 0))
        result = await fetch_all(node.plain)
        assert result.source == "ftp"
        assert "no file can contain" in result.notes[0]


async def test_a_run_time_of_an_old_table_is_no_guess_that_hides_another_change() -> None:
    """The bits of one value that make the same difference as a run time of two days more."""
    vehicle = ArduPilotVehicle(live_period=0)
    cached = dict(vehicle.params)
    entries = [PackedParam(each.name, ParamType(each.type), each.bits) for each in vehicle.listed]
    run_time = next(at for at, each in enumerate(entries) if each.name == "STAT_RUNTIME")
    other = max(at for at in range(run_time - 40) if entries[at].type is ParamType.INT32)

    def packed(rows: list[PackedParam]) -> list[bytes]:
        return list(encode_entries(rows, with_defaults=False, read_size=CHECKED_READ_SIZE))

    later = [*entries]
    later[run_time] = later[run_time]._replace(bits=later[run_time].bits + 200_000)
    now, then = packed(entries), packed(later)
    difference = crc32_px4(b"".join(now)) ^ crc32_px4(b"".join(then))
    change = crc32_px4_before(difference, sum(map(len, now[other + 1 :])) + 4)
    name = entries[other].name
    vehicle.load({name: int(from_bits(entries[other].bits ^ change, ParamType.INT32))})
    async with converse(vehicle) as conversation:
        moments = dict.fromkeys(cached, -365 * 86_400.0)
        result = await fetched(vehicle, await with_cached_table(conversation, cached, moments=moments))
        assert (result.source, result.changed) == ("cache", (name,))
