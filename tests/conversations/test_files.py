"""MAVFTP: files that arrive whole, refusals, sessions that are closed on board whatever happens."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from functools import partial
from random import Random

import anyio
import pytest

from paramclient.errors import FileErrorCode, FileTransferError, NoReply, UsageError
from paramclient.model.px4_hash import crc32_px4
from paramclient.model.values import ParamType
from paramclient.protocol.fetch import fetch_all
from paramclient.protocol.ftp import FileCutOff, Opcode, Packet, checksum, path_bytes, read_file
from paramclient.protocol.param_pck import PackedParam, encode
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, SimParam
from paramclient.wire.messages import FileTransfer, Message, ParamValue
from paramclient.wire.messages import encode as frame
from tests.conversations.virtual import losing, meanwhile, talking, virtual_on_both
from tests.shell import Tap, bits

BOTH = pytest.mark.parametrize("make", [PX4Vehicle, ArduPilotVehicle])
Maker = type[PX4Vehicle] | type[ArduPilotVehicle]
CONTENT = Random(1).randbytes(60_000)


def serving(size: int = 60_000, make: Maker = ArduPilotVehicle) -> PX4Vehicle | ArduPilotVehicle:
    """Return a vehicle with a file of this size."""
    vehicle = make()
    vehicle.files["a.bin"] = CONTENT[:size]
    return vehicle


def note(received: list[int], number: int, size: int | None) -> None:
    """Note the progress of a transfer."""
    received.append(number)


def packets_in(messages: Iterable[Message]) -> list[Packet]:
    """Return the packets in messages of MAVFTP."""
    return [Packet.unpack(each.payload) for each in messages if isinstance(each, FileTransfer)]


@BOTH
async def test_the_answer_to_the_last_request_of_an_earlier_program_is_not_taken(make: Maker) -> None:
    vehicle = serving(100, make)
    async with talking(Air([vehicle])) as (_, session):
        with pytest.raises(FileTransferError):
            await read_file(session.channel, "none.bin")
    async with talking(Air([vehicle])) as (_, session):
        assert await read_file(session.channel, "a.bin") == CONTENT[:100]


@virtual_on_both
@BOTH
@pytest.mark.parametrize("loss", [0.0, 0.2])
async def test_files_of_every_size_arrive_whole_and_are_closed(make: Maker, loss: float) -> None:
    vehicle = make()
    async with talking(Air.symmetric([vehicle], loss=loss, delay=0.02, seed=2)) as (_, session):
        for size in (0, 1, 239, 240, 5_000, 60_000):
            vehicle.files["a.bin"] = CONTENT[:size]
            received = [0]
            began = anyio.current_time()
            content = await read_file(session.channel, "a.bin", progress=partial(note, received))
            assert content == CONTENT[:size]
            assert anyio.current_time() - began < (40.0 if loss else 4.0)
            assert received == sorted(received)
            assert received[-1] >= size
            assert vehicle.open_files == []


async def test_refusals_say_why_and_leave_nothing_open() -> None:
    for make in (PX4Vehicle, ArduPilotVehicle):
        vehicle = serving(make=make)
        async with talking(vehicle) as (_, session):
            with pytest.raises(FileTransferError, match=r"1/1 refused no\.bin: file not found") as caught:
                await read_file(session.channel, "no.bin")
            assert caught.value.code == FileErrorCode.FILE_NOT_FOUND
            with pytest.raises(FileTransferError) as caught:
                await read_file(session.channel, "a.bin", size_max=1_000)
            assert caught.value.code == FileErrorCode.INVALID_DATA_SIZE
            await anyio.sleep(3.0)
            assert vehicle.open_files == []
            assert not session.channel.inboxes
            assert await checksum(session.channel, "a.bin") == crc32_px4(CONTENT)  # opens no session
            with pytest.raises(FileTransferError):
                await checksum(session.channel, "no.bin")


@pytest.mark.parametrize("path", ["", "a\0b", "x" * 239])
def test_a_path_that_no_message_holds_is_refused(path: str) -> None:
    with pytest.raises(UsageError):
        path_bytes(path)


@pytest.mark.parametrize("code", [FileErrorCode.UNKNOWN_COMMAND, FileErrorCode.FAIL])
async def test_refused_read_ends_transfer_and_server_without_bursts_serves_reads(code: FileErrorCode) -> None:
    vehicle = serving(2_000)

    def up(message: Message) -> bool:
        for request in packets_in([message]):
            if request.opcode == Opcode.BURST_READ_FILE:
                numbers = request.sequence + 1, request.session, Opcode.NAK, bytes((code,))
                nak = Packet(*numbers, requested=request.opcode)
                conversation.hear(FileTransfer(0, 255, 190, nak.pack()))
                return False
        return True

    async with talking(Tap(vehicle, up=up)) as (conversation, session):
        if code is FileErrorCode.UNKNOWN_COMMAND:
            assert await read_file(session.channel, "a.bin") == CONTENT[:2_000]
            requests = [each.opcode for each in packets_in(conversation.sent_of(FileTransfer))]
            assert requests.count(Opcode.READ_FILE) >= 9
        else:
            with pytest.raises(FileTransferError):
                await read_file(session.channel, "a.bin")
        await anyio.sleep(1.0)
        assert vehicle.open_files == []


async def test_the_session_of_another_station_is_waited_for() -> None:
    vehicle = serving(500)
    vehicle.files["other.bin"] = CONTENT[:500]
    async with talking(vehicle) as (_, session):
        session.channel.send(FileTransfer(0, 1, 1, Packet(77, 5, Opcode.OPEN_FILE_RO, b"other.bin").pack()))
        await anyio.sleep(0.1)
        assert vehicle.open_files == ["other.bin"]
        began = anyio.current_time()
        assert await read_file(session.channel, "a.bin") == CONTENT[:500]
        assert 3.0 < anyio.current_time() - began < 5.0


async def test_a_silent_server_is_no_reply_and_a_file_that_is_cut_off_keeps_its_beginning() -> None:
    endpoint = Tap(serving())
    async with talking(endpoint) as (_, session):
        endpoint.silent_at = began = anyio.current_time() + 0.5
        with pytest.raises(FileCutOff) as caught:
            await read_file(session.channel, "a.bin")
        assert anyio.current_time() - began < 10.0
        prefix = caught.value.prefix
        assert 5_000 < len(prefix) < 60_000
        assert CONTENT.startswith(prefix)
        with pytest.raises(NoReply):
            await read_file(session.channel, "a.bin", open_attempts=lambda: 3)


@virtual_on_both
@BOTH
async def test_cancelled_at_any_moment_a_session_is_closed_on_board(make: Maker) -> None:
    for step in range(8):
        vehicle = serving(20_000, make)
        async with talking(Air.symmetric([vehicle], delay=0.04)) as (_, session):
            with anyio.move_on_after(0.02 + 0.055 * step):
                await read_file(session.channel, "a.bin")
            began = anyio.current_time()
            await anyio.sleep(0.3)
            assert vehicle.open_files == []
            assert not session.channel.inboxes
            assert await read_file(session.channel, "a.bin") == CONTENT[:20_000]
            assert anyio.current_time() - began < 3.0


@virtual_on_both
async def test_uses_of_mavftp_take_turns() -> None:
    vehicle = ArduPilotVehicle()
    files = {f"{number}.bin": CONTENT[number : 3_000 + number] for number in range(4)}
    vehicle.files.update(files)
    async with talking(Air.symmetric([vehicle], delay=0.02)) as (_, session):
        got: dict[str, bytes] = {}
        began = anyio.current_time()

        async def fetch(path: str) -> None:
            got[path] = await read_file(session.channel, path)

        async with anyio.create_task_group() as tasks:
            for path in files:
                tasks.start_soon(fetch, path)
            tasks.start_soon(checksum, session.channel, "0.bin")
        assert got == files
        assert anyio.current_time() - began < 3.0


# the parameter file


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(encode([]), id="empty"),
        pytest.param(encode([PackedParam("RTL_ALT", ParamType.INT16, 1500)]), id="short"),
        pytest.param(b"no parameter file", id="other"),
        pytest.param(b"", id="none"),
        pytest.param(None, id="cut off"),
    ],
)
async def test_a_file_that_is_not_valid_leads_to_the_list_and_drops_nothing(content: bytes | None) -> None:
    vehicle = ArduPilotVehicle()
    async with talking(vehicle) as (conversation, session):
        first = await fetch_all(session)
        if content is None:
            rows = [PackedParam(each.name, each.type, each.bits ^ 1) for each in vehicle.listed]
            content = encode(rows)[:-7]
        vehicle.files.update(dict.fromkeys(("@PARAM/param.pck", "@PARAM/param.pck?withdefaults=1"), content))
        second = await fetch_all(session, refresh=True)
        assert (first.source, second.source) == ("ftp", "stream")
        assert second.params.keys() == first.params.keys()
        assert not second.missing
        assert any("Downloaded as a list" in note for note in second.notes)
        assert {each.kind for each in conversation.changes} == {"first"}


@pytest.mark.parametrize("is_cached", [False, True])
async def test_a_fetch_does_not_wait_for_another_file(is_cached: bool) -> None:
    async with talking(ArduPilotVehicle()) as (_, session):
        if is_cached:
            await fetch_all(session)
        async with session.channel.ftp:  # as while a log is downloaded
            result = await fetch_all(session)
        assert (result.source, result.complete) == ("stream", True)
        assert result.elapsed < 6.0
        assert any("in use for another file" in note for note in result.notes)
        assert (await fetch_all(session)).source in ("ftp", "cache")


async def test_integers_of_a_file_are_exact_and_keep_so_beside_rounded_messages() -> None:
    unset = SimParam("B", ParamType.REAL32, math.nan)
    vehicle, name = ArduPilotVehicle(table=[SimParam("A", ParamType.INT32, 5), unset]), "A"
    vehicle.set_param(name, 2**24 + 1)
    async with talking(vehicle) as (conversation, session):
        result = await fetch_all(session)
        assert result.source == "ftp"
        assert result.params[name].value == 2**24 + 1
        conversation.hear(ParamValue(name, b"\0\0\x80\x4b", 6, result.count, 65535))  # 2**24 as float32
        assert session.table.params[name].value == 2**24 + 1
        default = session.table.params[name].default
        assert (default, type(default)) == (5, int)


async def test_a_refused_file_is_not_requested_again_on_the_link() -> None:
    """The vehicle claims to have it, and answers: file not found."""
    async with talking(PX4Vehicle(param_error=True)) as (conversation, session):
        await session.identification.settled()
        for _ in range(2):
            result = await fetch_all(session, refresh=True)
            assert (result.source, bool(result.missing)) == ("stream", False)
        requests = [each.opcode for each in packets_in(conversation.sent_of(FileTransfer))]
        assert requests.count(Opcode.OPEN_FILE_RO) <= 1


async def test_a_file_that_another_station_has_closed_is_requested_again_the_next_time() -> None:
    vehicle, blocks = ArduPilotVehicle(), itertools.count()

    def closes(message: Message) -> bool:
        if not isinstance(message, FileTransfer) or next(blocks) != 20:
            return True
        reset = FileTransfer(0, 1, 1, Packet(1, 0, Opcode.RESET_SESSIONS).pack())
        vehicle.receive(frame(reset, system=250, component=190, sequence=0), anyio.current_time())
        return False

    async with talking(Tap(vehicle, down=closes)) as (_, session):
        assert [(await fetch_all(session, refresh=True)).source for _ in range(2)] == ["stream", "ftp"]


async def test_a_lost_opening_of_the_file_is_repeated_before_the_list_is_taken() -> None:
    def opens(message: Message) -> bool:
        return any(each.opcode == Opcode.OPEN_FILE_RO for each in packets_in([message]))

    async with talking(Tap(ArduPilotVehicle(), up=losing(1, opens))) as (conversation, session):
        result = await fetch_all(session)
        assert (result.source, result.elapsed < 2.0) == ("ftp", True)
        assert sum(map(opens, conversation.sent_of(FileTransfer))) > 1


@pytest.mark.parametrize(("name", "block"), [("RELAY1_FUNCTION", 3), ("SIM_MAG2_OFS_X", 27)])
async def test_a_lost_block_of_a_file_that_has_moved_is_not_put_into_it(name: str, block: int) -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)

    def is_lost(message: Message) -> bool:
        return any(each.data and each.offset == 239 * block for each in packets_in([message]))

    def moves(message: Message) -> bool:
        if any(each.opcode == Opcode.READ_FILE for each in packets_in([message])):
            vehicle.set_param(name, 0)  # its default: the file is shorter, and decodes with the old block too
        return True

    async with talking(Tap(vehicle, up=moves, down=losing(1, is_lost))) as (_, session):
        result = await fetch_all(session)
        assert result.source == "ftp"
        assert bits(result.params) == bits(vehicle.params)


async def test_a_file_of_a_table_that_changes_meanwhile_is_right_in_the_end() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    async with talking(Air.symmetric([vehicle], delay=0.02)) as (_, session):
        async with meanwhile(fetch_all(session)):
            await anyio.sleep(0.3)
            vehicle.set_param("EK2_ENABLE", 1)
            vehicle.set_param("RTL_ALT", 4321)
        assert session.table.params["RTL_ALT"].value == 4321
        result = await fetch_all(session)
        listed = {name: each for name, each in result.params.items() if each.index is not None}
        assert bits(listed) == bits(vehicle.params)


@pytest.mark.parametrize("rate", [4_500.0, 2_000.0])
async def test_a_burst_over_a_slow_link_is_requested_once(rate: float) -> None:
    """A block of it takes longer than a pause in a quick burst."""
    endpoint = Tap(Air.symmetric([ArduPilotVehicle()], loss=0.05, delay=0.05, rate=rate, seed=1))
    async with talking(endpoint) as (conversation, session):
        result = await fetch_all(session)
        assert (result.source, result.complete) == ("ftp", True)
        sent = [each.opcode for each in packets_in(conversation.sent_of(FileTransfer))]
        assert sent.count(Opcode.BURST_READ_FILE) <= 2
        assert result.elapsed < 30_000 / rate


async def test_a_burst_whose_first_blocks_are_lost_is_requested_once() -> None:
    """Another one would send the whole file again, which takes seconds over a radio."""

    def is_block(message: Message) -> bool:
        return any(each.requested == Opcode.BURST_READ_FILE for each in packets_in([message]))

    vehicle = Tap(ArduPilotVehicle(ftp_rate=1_920.0), down=losing(2, is_block))
    async with talking(vehicle) as (conversation, session):
        assert (await fetch_all(session)).source == "ftp"
        sent = [each.opcode for each in packets_in(conversation.sent_of(FileTransfer))]
        assert sent.count(Opcode.BURST_READ_FILE) == 1
