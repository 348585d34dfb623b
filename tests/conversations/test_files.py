"""MAVFTP: files that arrive whole, refusals, sessions that are closed on board whatever happens."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from contextlib import suppress
from functools import partial
from random import Random

import anyio
import pytest

from paramclient.errors import FileErrorCode, FileTransferError, LinkError, NoReply, UsageError
from paramclient.model.px4_hash import crc32_px4
from paramclient.model.values import ParamType
from paramclient.protocol.fetch import fetch_all
from paramclient.protocol.ftp import (
    FileCutOff,
    Opcode,
    Packet,
    checksum,
    path_bytes,
    read_file,
)
from paramclient.protocol.param_pck import PackedParam, encode
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from paramclient.wire.messages import FileTransfer, Message, ParamRequestList, ParamRequestRead, ParamValue
from tests.conversations.virtual import Silence, Tap, converse, virtual, virtual_on_both

BOTH = pytest.mark.parametrize("make", [PX4Vehicle, ArduPilotVehicle])
Maker = type[PX4Vehicle] | type[ArduPilotVehicle]
CONTENT = Random(1).randbytes(60_000)


def note(received: list[int], number: int, size: int | None) -> None:
    """Note the progress of a transfer."""
    received.append(number)


def packet_in(message: Message) -> Packet | None:
    """Return the packet in a message of MAVFTP."""
    return Packet.unpack(message.payload) if isinstance(message, FileTransfer) else None


@virtual
@BOTH
async def test_the_answer_to_the_last_request_of_an_earlier_program_is_not_taken(make: Maker) -> None:
    vehicle = make()
    vehicle.files["a.bin"] = CONTENT[:100]
    for path in ("none.bin", "a.bin"):
        async with converse(Air([vehicle])) as conversation:
            channel = (await conversation.node()).channel
            if path == "a.bin":
                assert await read_file(channel, path) == CONTENT[:100]
            else:
                with pytest.raises(FileTransferError):
                    await read_file(channel, path)


@virtual_on_both
@BOTH
@pytest.mark.parametrize("loss", [0.0, 0.2])
async def test_files_of_every_size_arrive_whole_and_are_closed(make: Maker, loss: float) -> None:
    vehicle = make()
    async with converse(Air.symmetric([vehicle], loss=loss, delay=0.02, seed=2)) as conversation:
        channel = (await conversation.node()).channel
        for size in (0, 1, 239, 240, 5_000, 60_000):
            vehicle.files["a.bin"] = CONTENT[:size]
            received: list[int] = []
            began = anyio.current_time()
            content = await read_file(channel, "a.bin", progress=partial(note, received))
            assert content == CONTENT[:size]
            assert anyio.current_time() - began < (40.0 if loss else 4.0)
            assert received == sorted(received)
            assert (received or [0])[-1] >= size
            assert vehicle.open_files == []


@virtual
async def test_blocks_in_another_order_and_twice_and_in_smaller_reads() -> None:
    vehicle = ArduPilotVehicle()
    vehicle.files["a.bin"] = CONTENT[:9_000]
    air = Air.symmetric([vehicle], reorder=0.3, duplicate=0.3, jitter=0.02, delay=0.01, seed=1)
    async with converse(air) as conversation:
        channel = (await conversation.node()).channel
        assert await read_file(channel, "a.bin") == CONTENT[:9_000]
        assert vehicle.open_files == []


@virtual
async def test_refusals_say_why_and_leave_nothing_open() -> None:
    for vehicle in (PX4Vehicle(), ArduPilotVehicle()):
        vehicle.files["big.bin"] = CONTENT
        async with converse(vehicle) as conversation:
            channel = (await conversation.node()).channel
            with pytest.raises(FileTransferError, match=r"1/1 refused no\.bin: file not found") as caught:
                await read_file(channel, "no.bin")
            assert caught.value.code == FileErrorCode.FILE_NOT_FOUND
            with pytest.raises(FileTransferError) as caught:
                await read_file(channel, "big.bin", size_max=1_000)
            assert caught.value.code == FileErrorCode.INVALID_DATA_SIZE
            await anyio.sleep(3.0)
            assert vehicle.open_files == []
            assert not channel.inboxes


@pytest.mark.parametrize("path", ["", "a\0b", "x" * 239])
def test_a_path_that_no_message_holds_is_refused(path: str) -> None:
    with pytest.raises(UsageError):
        path_bytes(path)


@virtual
async def test_a_refused_read_ends_the_transfer_and_a_server_without_bursts_serves_reads() -> None:
    vehicle = ArduPilotVehicle()
    vehicle.files["a.bin"] = CONTENT[:2_000]
    async with converse(vehicle) as conversation:
        channel = (await conversation.node()).channel

        def answers(opcode: int, code: int) -> Callable[[], Coroutine[object, object, None]]:
            """Return what answers each request of a kind with a NAK, before the vehicle does."""

            async def run() -> None:
                seen = 0
                while True:
                    for message in conversation.sent_of(FileTransfer)[seen:]:
                        seen += 1
                        request = Packet.unpack(message.payload)
                        if request.opcode == opcode:
                            nak = Packet(
                                *(request.sequence + 1, request.session, Opcode.NAK, bytes((code,))),
                                requested=opcode,
                            )
                            conversation.hear(FileTransfer(0, 255, 190, nak.pack()))
                    await anyio.sleep(0.001)

            return run

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(answers(Opcode.BURST_READ_FILE, FileErrorCode.UNKNOWN_COMMAND))
            assert await read_file(channel, "a.bin") == CONTENT[:2_000]
            tasks.cancel_scope.cancel()
        requests = [Packet.unpack(each.payload).opcode for each in conversation.sent_of(FileTransfer)]
        assert requests.count(Opcode.READ_FILE) >= 9
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(answers(Opcode.BURST_READ_FILE, FileErrorCode.FAIL))
            with pytest.raises(FileTransferError):
                await read_file(channel, "a.bin")
            tasks.cancel_scope.cancel()
        await anyio.sleep(1.0)
        assert vehicle.open_files == []


@virtual
async def test_the_session_of_another_station_is_waited_for() -> None:
    vehicle = ArduPilotVehicle()
    vehicle.files.update({"a.bin": CONTENT[:500], "other.bin": CONTENT[:500]})
    async with converse(vehicle) as conversation:
        channel = (await conversation.node()).channel
        other = Packet(77, 5, Opcode.OPEN_FILE_RO, b"other.bin")
        channel.send(FileTransfer(0, 1, 1, other.pack()))
        await anyio.sleep(0.1)
        assert vehicle.open_files == ["other.bin"]
        began = anyio.current_time()
        assert await read_file(channel, "a.bin") == CONTENT[:500]
        assert 3.0 < anyio.current_time() - began < 5.0


@virtual
async def test_a_silent_server_is_no_reply_and_a_file_that_is_cut_off_keeps_its_beginning() -> None:
    vehicle = ArduPilotVehicle()
    vehicle.files["a.bin"] = CONTENT
    endpoint = Silence(vehicle, at=1e9)
    async with converse(endpoint) as conversation:
        channel = (await conversation.node()).channel
        endpoint.at = began = anyio.current_time() + 0.5
        with pytest.raises(FileCutOff) as caught:
            await read_file(channel, "a.bin")
        assert anyio.current_time() - began < 10.0
        prefix = caught.value.prefix
        assert 5_000 < len(prefix) < 60_000
        assert CONTENT.startswith(prefix)
        with pytest.raises(NoReply):
            await read_file(channel, "a.bin", open_attempts=lambda: 3)


@virtual_on_both
@BOTH
async def test_cancelled_at_any_moment_a_session_is_closed_on_board(make: Maker) -> None:
    for step in range(8):
        vehicle = make()
        vehicle.files["a.bin"] = CONTENT[:20_000]
        async with converse(Air.symmetric([vehicle], delay=0.04)) as conversation:
            channel = (await conversation.node()).channel
            with anyio.move_on_after(0.02 + 0.055 * step):
                await read_file(channel, "a.bin")
            began = anyio.current_time()
            await anyio.sleep(0.3)
            assert vehicle.open_files == []
            assert not channel.inboxes
            assert await read_file(channel, "a.bin") == CONTENT[:20_000]
            assert anyio.current_time() - began < 3.0


@virtual
async def test_sessions_are_closed_where_packets_are_lost_in_bursts() -> None:
    vehicle = ArduPilotVehicle()
    vehicle.files["a.bin"] = CONTENT[:20_000]
    air = Air.symmetric([vehicle], loss=0.05, loss_burst=4.0, delay=0.3, seed=5)
    async with converse(air) as conversation:
        channel = (await conversation.node()).channel
        for number in range(30):
            with suppress(NoReply), anyio.move_on_after(number * 0.06):
                await read_file(channel, "a.bin")
            await anyio.sleep(0.4)  # what was sent last arrives
            assert vehicle.open_files == []


@virtual
async def test_a_cancelled_transfer_ends_within_2_s_although_its_closing_is_lost() -> None:
    vehicle = ArduPilotVehicle()
    vehicle.files["a.bin"] = CONTENT
    endpoint = Silence(vehicle, at=1e9)
    async with converse(endpoint) as conversation:
        channel = (await conversation.node()).channel
        endpoint.at = anyio.current_time() + 0.3
        with anyio.move_on_after(0.5):
            await read_file(channel, "a.bin")
        assert anyio.current_time() - endpoint.at < 2.5
        assert not channel.inboxes


@virtual_on_both
async def test_uses_of_mavftp_take_turns() -> None:
    vehicle = ArduPilotVehicle()
    files = {f"{number}.bin": CONTENT[number : 3_000 + number] for number in range(4)}
    vehicle.files.update(files)
    async with converse(Air.symmetric([vehicle], delay=0.02)) as conversation:
        channel = (await conversation.node()).channel
        got: dict[str, bytes] = {}

        async def fetch(path: str) -> None:
            got[path] = await read_file(channel, path)

        async with anyio.create_task_group() as tasks:
            for path in files:
                tasks.start_soon(fetch, path)
            tasks.start_soon(checksum, channel, "0.bin")
        assert got == files
        assert anyio.current_time() < 3.0


@virtual
@BOTH
async def test_the_checksum_of_a_file_opens_no_session(make: Maker) -> None:
    vehicle = make()
    vehicle.files["a.bin"] = CONTENT
    async with converse(vehicle) as conversation:
        channel = (await conversation.node()).channel
        assert await checksum(channel, "a.bin") == crc32_px4(CONTENT)
        with pytest.raises(FileTransferError):
            await checksum(channel, "no.bin")


@virtual
async def test_the_end_of_the_link_ends_a_transfer() -> None:
    vehicle = ArduPilotVehicle()
    vehicle.files["a.bin"] = CONTENT
    async with converse(vehicle) as conversation:
        channel = (await conversation.node()).channel
        raised: list[LinkError] = []

        async def fetch() -> None:
            with pytest.raises(LinkError) as caught:
                await read_file(channel, "a.bin")
            raised.append(caught.value)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(fetch)
            await anyio.sleep(0.3)
            conversation.station.fail(LinkError("gone", link="x"), for_good=True)
        assert raised


# the parameter file


def pack_of(vehicle: ArduPilotVehicle, number: int | None = None) -> bytes:
    """Return the parameter file of a vehicle, or of some of its parameters."""
    rows = [PackedParam(each.name, each.type, each.bits) for each in vehicle.listed[:number]]
    return encode(rows, total=len(rows) if number else None)


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
@virtual
async def test_a_file_that_is_not_valid_leads_to_the_list_and_drops_nothing(content: bytes | None) -> None:
    vehicle = ArduPilotVehicle()
    async with converse(vehicle) as conversation:
        session = (await conversation.node()).plain
        first = await fetch_all(session)
        broken = pack_of(vehicle)[:-7] if content is None else content
        vehicle.files.update(dict.fromkeys(("@PARAM/param.pck", "@PARAM/param.pck?withdefaults=1"), broken))
        second = await fetch_all(session)
        assert (first.source, second.source) == ("ftp", "stream")
        assert second.params.keys() == first.params.keys()
        assert not second.missing
        assert any("Downloaded as a list" in note for note in second.notes)
        assert not [each for each in conversation.changes if each.kind == "removed"]


@virtual
async def test_a_short_file_replaces_no_table_where_the_indices_begin_at_1() -> None:
    vehicle = ArduPilotVehicle()
    tap = Tap(
        vehicle, up=lambda message: not (isinstance(message, ParamRequestRead) and message.param_index == 0)
    )
    async with converse(tap) as conversation:
        session = (await conversation.node()).plain
        first = await fetch_all(session)
        short = pack_of(vehicle, 10)
        vehicle.files.update(dict.fromkeys(("@PARAM/param.pck", "@PARAM/param.pck?withdefaults=1"), short))
        second = await fetch_all(session, refresh=True)
        assert (second.source, second.count, second.complete) == ("stream", first.count, True)
        assert second.params.keys() == first.params.keys()


@pytest.mark.parametrize("is_cached", [False, True])
@virtual
async def test_a_fetch_does_not_wait_for_another_file(is_cached: bool) -> None:
    vehicle = ArduPilotVehicle()
    async with converse(vehicle) as conversation:
        node = await conversation.node()
        if is_cached:
            await fetch_all(node.plain)
        async with node.channel.ftp:  # as while a log is downloaded
            result = await fetch_all(node.plain)
        assert (result.source, result.complete) == ("stream", True)
        assert result.elapsed < 6.0
        assert any("in use for another file" in note for note in result.notes)
        assert (await fetch_all(node.plain)).source in ("ftp", "cache")


@virtual
async def test_integers_of_a_file_are_exact_and_keep_so_beside_rounded_messages() -> None:
    vehicle = ArduPilotVehicle()
    name = next(each.name for each in vehicle.listed if each.type == 6 and each.name.startswith("COMPASS"))
    vehicle.set_param(name, 2**24 + 1)
    async with converse(vehicle) as conversation:
        session = (await conversation.node()).plain
        result = await fetch_all(session)
        assert result.source == "ftp"
        assert result.params[name].value == 2**24 + 1
        conversation.hear(ParamValue(name, b"\0\0\x80\x4b", 6, result.count, 65535))  # 2**24 as float32
        assert session.table.params[name].value == 2**24 + 1
        default = session.table.params[name].default
        assert isinstance(default, int)


@virtual
async def test_a_refused_file_is_not_requested_again_on_the_link() -> None:
    vehicle = PX4Vehicle(param_error=True)  # claims to have it, and answers: file not found
    async with converse(vehicle) as conversation:
        session = (await conversation.node()).plain
        await session.identification.settled()
        for _ in range(2):
            result = await fetch_all(session, refresh=True)
            assert (result.source, bool(result.missing)) == ("stream", False)
        opened = [packet for each in conversation.sent_of(FileTransfer) if (packet := packet_in(each))]
        assert sum(packet.opcode == Opcode.OPEN_FILE_RO for packet in opened) <= 1
        assert len(conversation.sent_of(ParamRequestList)) == 2


@virtual
async def test_a_lost_opening_of_the_file_is_repeated_before_the_list_is_taken() -> None:
    vehicle = ArduPilotVehicle()
    left = [1]

    def lose_first(message: Message) -> bool:
        if (packet := packet_in(message)) and packet.opcode == Opcode.OPEN_FILE_RO and left[0]:
            left[0] -= 1
            return False
        return True

    async with converse(Tap(vehicle, up=lose_first)) as conversation:
        result = await fetch_all((await conversation.node()).plain)
        assert (result.source, result.elapsed < 2.0) == ("ftp", True)


@virtual
async def test_a_file_of_a_table_that_changes_meanwhile_is_right_in_the_end() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    async with converse(Air.symmetric([vehicle], delay=0.02)) as conversation:
        session = (await conversation.node()).plain
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(fetch_all, session)
            await anyio.sleep(0.3)
            vehicle.set_param("EK2_ENABLE", 1)
            vehicle.set_param("RTL_ALT", 4321)
        assert session.table.params["RTL_ALT"].value == 4321
        result = await fetch_all(session)
        assert {name: each.bits for name, each in vehicle.params.items()} == {
            name: each.bits for name, each in result.params.items() if each.index is not None
        }
