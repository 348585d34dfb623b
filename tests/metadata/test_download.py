"""Metadata of vehicles: the request, the files, and the metadata cache."""

from __future__ import annotations

import json
import logging
import lzma
import math
import os
import stat
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import pytest

from paramclient import ClientClosed, FileTransferError, NoReply, ParamCache, UsageError
from paramclient.client.local import local
from paramclient.errors import MetadataError
from paramclient.metadata import Metadata, MetadataStore, download, metadata_cache, metadata_of
from paramclient.model.identity import Identity
from paramclient.model.px4_hash import crc32_px4
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.events import EventMaker
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.retry import VersionAttempts
from paramclient.protocol.vehicle.commands import MessageRequests
from paramclient.protocol.vehicle.metadata_request import MetadataRequests
from paramclient.protocol.wire import (
    AUTOPILOT_VERSION_ID,
    CommandAck,
    CommandLong,
    ComponentMetadata,
    FileTransfer,
)
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle
from paramclient.sim.metadata import GENERAL_FILE, METADATA_FILE
from tests.recordings import identity_in
from tests.shell import (
    FlakyLink,
    Tap,
    a_client,
    generic,
    in_simulated_time,
    outcome,
    residue,
    simulated_time_loop,
    small_px4,
    tasks_beside,
)

IDENTITY = Identity(1, "link", "abcd", 12, 2, 0x01110000, "0123abcd", 1)


@pytest.fixture(autouse=True)
def _threads_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop the clock of a `SimulatedTimeLoop` while a worker thread reads files."""
    in_thread = download._in_thread

    async def counted(*args: Any, **kwargs: Any) -> Any:
        simulated_time_loop().threads += 1
        try:
            return await in_thread(*args, **kwargs)
        finally:
            simulated_time_loop().threads -= 1

    monkeypatch.setattr(download, "_in_thread", counted)


def describing(**options: Any) -> PX4Vehicle:
    """Return a small vehicle with metadata of its parameters."""
    return small_px4(metadata=True, **options)


def file_of(document: object) -> bytes:
    return lzma.compress(json.dumps(document).encode())


def publish(vehicle: PX4Vehicle, **entry: Any) -> None:
    """Replace the entry of the parameter metadata in a vehicle's general file."""
    kinds = [
        {"type": 1, "uri": f"mftp://{METADATA_FILE}"} | entry,
        {"type": 4, "uri": "https://x.invalid/e"},
    ]
    vehicle.files[GENERAL_FILE] = file_of({"version": 1, "metadataTypes": kinds})


def reads_of(tap: Tap) -> int:
    """Return the number of MAVFTP messages that the station has sent."""
    return len(tap.messages(FileTransfer))


async def files_in(folder: Path) -> list[Path]:
    return await anyio.to_thread.run_sync(lambda: sorted(folder.iterdir()))


# Complete downloads


@in_simulated_time
async def test_a_vehicle_describes_its_parameters() -> None:
    vehicle = PX4Vehicle(metadata=True)
    async with a_client(vehicle) as client:
        component = await client.component()
        read = await metadata_of(component)
        assert read is not None
        assert len(read) == 919
        assert read["MC_ROLL_P"].units == "1/s"
        assert read["COM_FLTMODE1"].parse("return") == 5
        assert read["EKF2_GPS_CTRL"].text(7) == "Position|Altitude|Velocity"
        volatile = {info.name for info in read.values() if info.is_volatile}
        assert volatile == {name for name, entry in vehicle._by_name.items() if entry.volatile}
        assert read.source == f"mftp://{METADATA_FILE} of 1/1"
        assert not residue(component)
        await anyio.sleep(1.0)
        assert not vehicle.open_files


@in_simulated_time
async def test_download_with_packet_loss() -> None:
    vehicle = describing(ftp_rate=10_000)
    link = Air([vehicle], uplink=FaultyLink(loss=0.3, seed=5), downlink=FaultyLink(loss=0.3, seed=6))
    async with a_client(link) as client:
        read = await metadata_of(await client.component())
        assert read is not None
        assert "PARAM_03" in read


@in_simulated_time
async def test_a_cached_file_is_not_downloaded_again(tmp_path: Path) -> None:
    cache = tmp_path / "cache.sqlite3"
    for expected in (True, False):
        tap = Tap(describing())
        async with a_client(tap, cache=str(cache)) as client:
            component = await client.component()
            before = reads_of(tap)
            read = await metadata_of(component)
            assert read is not None
            assert (reads_of(tap) > before) is expected
            folder = tmp_path / "cache.metadata"
            kept = await files_in(folder)
            assert len(kept) == 3
            assert {stat.S_IMODE(path.stat().st_mode) for path in kept} == {0o600}
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
            known = MetadataStore(folder).known(component.identity, 1)
            assert known is not None
            assert known.params == read.params


@in_simulated_time
async def test_metadata_of_another_firmware_is_downloaded(tmp_path: Path) -> None:
    kept = MetadataStore(tmp_path)
    for units in ("m", "s"):
        vehicle = describing()
        vehicle.files[METADATA_FILE] = file_of(
            {"version": 1, "parameters": [{"name": "PARAM_03", "units": units}]}
        )
        publish(vehicle, fileCrc=crc32_px4(vehicle.files[METADATA_FILE]))
        async with a_client(vehicle) as client:
            read = await metadata_of(await client.component(), store=kept)
            assert read is not None
            assert read["PARAM_03"].units == units


@in_simulated_time
async def test_a_simulated_vehicle_is_never_taken_for_the_real_one(tmp_path: Path) -> None:
    """The simulated PX4 has the version and board of the recorded one, but not its commit."""
    real = identity_in("px4_full_download", 12)
    store, other_store = MetadataStore(tmp_path / "first"), MetadataStore(tmp_path / "second")
    async with a_client(PX4Vehicle(metadata=True)) as client:
        component = await client.component()
        assert await metadata_of(component, store=store) is not None
        simulated = component.identity
    for field in ("autopilot", "firmware", "board", "vendor_id", "product_id"):
        assert getattr(simulated, field) == getattr(real, field)
    assert store.known(simulated, 1) is not None
    assert store.known(real, 1) is None
    content = described("RTL_RETURN_ALT")
    other_store.put(content, crc32_px4(content))
    other_store.remember(real, 1, crc32_px4(content))
    other_store.remember_failure(real, 1)
    assert other_store.known(real, 1) is not None
    assert other_store.known(simulated, 1) is None
    assert not other_store.has_failed(replace(simulated, link=real.link), 1, within=math.inf)


@pytest.mark.parametrize(
    ("vehicle", "recording", "autopilot", "digits"),
    [
        (PX4Vehicle, "px4_full_download", 12, 16),
        (ArduPilotVehicle, "ardupilot_full_download", 3, 8),
    ],
)
@in_simulated_time
async def test_simulated_autopilots_report_a_commit_of_their_own(
    vehicle: type[PX4Vehicle | ArduPilotVehicle], recording: str, autopilot: int, digits: int
) -> None:
    async with a_client(vehicle()) as client:
        component = await client.component()
        await anyio.sleep(0.5)
        assert component.identity.git_hash == ("5eed5eed" * 2)[:digits]
        assert component.identity.firmware == identity_in(recording, autopilot).firmware
        assert component.identity.git_hash != identity_in(recording, autopilot).git_hash


@in_simulated_time
async def test_metadata_of_a_simulated_px4_is_not_used_for_one_with_another_table(tmp_path: Path) -> None:
    cache = ParamCache(tmp_path / "cache.sqlite3")
    identities = []
    for vehicle in (describing(), describing(system=2), PX4Vehicle(table={"RTL_RETURN_ALT": 1.0})):
        async with a_client(vehicle, cache=cache) as client:
            component = await client.component()
            await anyio.sleep(0.5)
            identities.append(component.identity)
            if len(identities) == 1:
                assert await metadata_of(component) is not None
    store = MetadataStore.beside(cache.path)
    assert [store.known(each, 1) is not None for each in identities] == [True, True, False]


@in_simulated_time
async def test_without_a_cache_nothing_is_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(MetadataStore, "put", forbidden)
    async with a_client(describing()) as client:
        assert await metadata_of(await client.component()) is not None
    async with a_client(describing(), cache=str(tmp_path / "c")) as client:
        assert await metadata_of(await client.component(), store=False) is not None


@in_simulated_time
async def test_a_file_without_a_checksum_is_not_cached(tmp_path: Path) -> None:
    vehicle = describing()
    publish(vehicle)  # without a checksum
    kept = MetadataStore(tmp_path)
    async with a_client(vehicle) as client:
        component = await client.component()
        assert await metadata_of(component, store=kept) is not None
        assert kept.known(component.identity, 1) is None
        assert [path.suffix for path in await files_in(tmp_path)] == [".metadata"]  # the general file


@in_simulated_time
async def test_the_checksum_may_be_that_of_the_unpacked_file(tmp_path: Path) -> None:
    """PX4 announces this checksum for its general file."""
    vehicle = describing()
    unpacked = lzma.decompress(vehicle.files[METADATA_FILE])
    publish(vehicle, fileCrc=crc32_px4(unpacked))
    kept = MetadataStore(tmp_path)
    async with a_client(vehicle) as client:
        component = await client.component()
        read = await metadata_of(component, store=kept)
        known = kept.known(component.identity, 1)
    assert read is not None
    assert known is not None
    assert known.params == read.params


# Errors


@pytest.mark.parametrize("make", [PX4Vehicle, ArduPilotVehicle, generic])
@in_simulated_time
async def test_vehicles_without_metadata(make: Any) -> None:
    async with a_client(make()) as client:
        component = await client.component()
        began = anyio.current_time()
        assert await metadata_of(component) is None
        assert anyio.current_time() - began < 1.5
        assert not local(component).machine.metadata_requests.is_asking


@in_simulated_time
async def test_a_general_file_without_parameters() -> None:
    vehicle = describing()
    vehicle.files[GENERAL_FILE] = file_of({"version": 1, "metadataTypes": [{"type": 4, "uri": "mftp://e"}]})
    async with a_client(vehicle) as client:
        assert await metadata_of(await client.component()) is None


@in_simulated_time
async def test_nothing_is_downloaded_from_the_internet() -> None:
    vehicle = describing()
    publish(vehicle, uri="https://example.invalid/parameters.json.xz")
    async with a_client(vehicle) as client:
        with pytest.raises(
            MetadataError, match=r"1/1 .* at https://example\.invalid/.*, which is not downloaded"
        ) as caught:
            await metadata_of(await client.component())
    assert caught.value.source == "https://example.invalid/parameters.json.xz"


@in_simulated_time
async def test_a_file_on_board_is_preferred_to_the_internet() -> None:
    vehicle = describing()
    publish(vehicle, uri="https://example.invalid/p", uriFallback=f"mftp://{METADATA_FILE}")
    async with a_client(vehicle) as client:
        assert await metadata_of(await client.component()) is not None


@in_simulated_time
async def test_a_file_on_another_component() -> None:
    vehicle, camera = describing(), PX4Vehicle(component=100, table={"CAM_MODE": 1})
    camera.files["/p.json"] = json.dumps({"version": 1, "parameters": [{"name": "CAM_MODE"}]}).encode()
    for number, expected in ((100, Metadata), (101, MetadataError)):
        publish(vehicle, uri=f"mftp://[;comp={number}]/p.json")
        async with a_client(Air([vehicle, camera])) as client:
            await client.component(component=100)
            result = await outcome(metadata_of(await client.component()))
            assert isinstance(result, expected), result


@pytest.mark.parametrize("wrong", ["checksum", "missing", "damaged", "long"])
@in_simulated_time
async def test_files_that_are_not_as_announced(wrong: str, tmp_path: Path) -> None:
    vehicle = describing()
    content = vehicle.files[METADATA_FILE]
    if wrong == "checksum":
        publish(vehicle, fileCrc=crc32_px4(content) ^ 1)
    elif wrong == "missing":
        del vehicle.files[METADATA_FILE]
    elif wrong == "damaged":
        vehicle.files[METADATA_FILE] = content[:-20]
        publish(vehicle, fileCrc=crc32_px4(content[:-20]))
    else:
        publish(vehicle, uri="mftp://" + "x" * 240)
    kept = MetadataStore(tmp_path)
    said = {
        "checksum": (MetadataError, "does not have the announced checksum"),
        "missing": (FileTransferError, "file not found"),
        "damaged": (
            MetadataError,
            f"mftp://{METADATA_FILE} of 1/1: cannot be unpacked: the file is truncated",
        ),
        "long": (MetadataError, r"1/1 announces its metadata at mftp://x*: .* 239 bytes"),
    }[wrong]
    async with a_client(vehicle) as client:
        component = await client.component()
        with pytest.raises(said[0], match=said[1]):
            await metadata_of(component, store=kept)
        assert kept.known(component.identity, 1) is None
        await anyio.sleep(1.0)
        assert not vehicle.open_files


@in_simulated_time
async def test_a_vehicle_that_does_not_respond() -> None:
    tap = Tap(describing())
    async with a_client(tap) as client:
        component = await client.component()
        await component.get("PARAM_03")
        tap.is_deaf = True
        result = await outcome(metadata_of(component))
        assert isinstance(result, NoReply)
        assert result.attempts >= 5
        began = anyio.current_time()
        result = await outcome(metadata_of(component, timeout=0.7))
        assert isinstance(result, NoReply)
        assert anyio.current_time() - began == pytest.approx(0.7, abs=0.01)
        assert not local(component).machine.metadata_requests.is_asking
        tap.is_mute = True
        result = await outcome(metadata_of(component))
        assert isinstance(result, NoReply)
        assert "lost" in str(result)
        result = await outcome(metadata_of(component))
        assert isinstance(result, NoReply)
        assert result.attempts == 0  # no request was sent
        tap.is_mute = tap.is_deaf = False
        await anyio.sleep(1.5)
        assert await metadata_of(component) is not None


@in_simulated_time
async def test_closing_the_client_during_a_download() -> None:
    tap = Tap(describing())
    async with anyio.create_task_group() as tasks:
        results: list[object] = []
        async with a_client(tap) as client:
            component = await client.component()
            tap.is_deaf = True

            async def ask() -> None:
                results.append(await outcome(metadata_of(component)))

            tasks.start_soon(ask)
            await anyio.sleep(0.05)
    assert [type(result) for result in results] == [ClientClosed]
    assert not tasks_beside()
    assert isinstance(await outcome(metadata_of(component)), ClientClosed)


@in_simulated_time
async def test_cancellation_closes_files_and_sessions(tmp_path: Path) -> None:
    """At every point of the download."""
    for moment in (0.001, 0.012, 0.03, 0.05, 0.1, 0.2):
        vehicle = describing(ftp_rate=20_000)
        async with a_client(vehicle) as client:
            component = await client.component()
            with anyio.move_on_after(moment):
                await metadata_of(component, store=MetadataStore(tmp_path / str(moment)))
            assert not local(component).machine.metadata_requests.is_asking
            await anyio.sleep(1.0)
            assert not vehicle.open_files
            assert await metadata_of(component) is not None


@in_simulated_time
async def test_concurrent_requests_share_a_response() -> None:
    tap = Tap(describing())
    async with a_client(tap) as client:
        component = await client.component()
        async with anyio.create_task_group() as tasks:
            for _ in range(3):
                tasks.start_soon(metadata_of, component)
        assert [message.params[0] for message in tap.messages(CommandLong)].count(397.0) == 1


@in_simulated_time
async def test_a_link_that_drops_during_a_download() -> None:
    tap = Tap(describing())
    link = FlakyLink(tap)
    async with a_client(link) as client:
        component = await client.component()
        await component.get("PARAM_03")
        await anyio.sleep(2.0)
        waited = [local(component).machine.is_waiting]
        tap.is_deaf = True
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(metadata_of, component)
            await anyio.sleep(0.01)
            waited.append(local(component).machine.is_waiting)
            await link.drop()
            requested = len(tap.messages(CommandLong))
            tap.is_deaf = False
        assert len(tap.messages(CommandLong)) > requested
        assert link.openings == 2
        assert waited == [False, True]


@in_simulated_time
async def test_a_too_large_file_is_not_downloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download, "PACKED_SIZE_MAX", 400)
    vehicle = describing()
    assert len(vehicle.files[GENERAL_FILE]) < 400 < len(vehicle.files[METADATA_FILE])
    async with a_client(vehicle) as client:
        with pytest.raises(FileTransferError, match="longer than 400 bytes"):
            await metadata_of(await client.component())


@in_simulated_time
async def test_nothing_is_stored_after_the_vehicle_was_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = MetadataStore(tmp_path)
    read_parameters = download._read_parameters
    async with a_client(describing()) as client:
        component = await client.component()
        await anyio.sleep(1.0)

        def read(content: bytes, source: str) -> Metadata:
            who = local(component).machine.identification
            who.identity = replace(who.identity, uid="another")
            return read_parameters(content, source)

        monkeypatch.setattr(download, "_read_parameters", read)
        assert await metadata_of(component, store=kept) is not None
        assert not kept.has_notes


# The request


class Asked:
    """The metadata request of a component, with the sent messages."""

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.context = Context((1, 1), self.sent.append)
        self.messages = MessageRequests(self.context)
        self.machine = MetadataRequests(self.context, self.messages)


def test_the_request_and_its_responses() -> None:
    requested = Asked()
    ask = requested.machine.ask(0.0)
    assert requested.sent == [CommandLong(1, 1, 512, (397.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))]
    requested.machine.receive(ComponentMetadata("mftp://a", 7), 0.1)
    assert ask.result == ComponentMetadata("mftp://a", 7)
    requested.machine.receive(ComponentMetadata("mftp://b", 8), 0.2)  # unsolicited
    assert requested.messages.next_deadline() == float("inf")
    ask = requested.machine.ask(1.0)
    requested.machine.receive(ComponentMetadata("", 0), 1.1)
    assert ask.done
    assert ask.result is None


@pytest.mark.parametrize(
    ("result", "is_answer"), [(0, False), (1, False), (2, True), (3, True), (4, True), (5, False)]
)
def test_refusals_end_the_request(result: int, is_answer: bool) -> None:
    requested = Asked()
    ask = requested.machine.ask(0.0)
    requested.messages.acknowledged(CommandAck(512, result, 255, 190), 0.1)
    assert ask.done is is_answer


def test_the_refusal_of_another_request_is_ignored() -> None:
    requested = Asked()
    ask = requested.machine.ask(0.0)
    requested.messages.acknowledged(CommandAck(511, 3, 255, 190), 0.1)
    requested.messages.acknowledged(CommandAck(512, 3, 254, 190), 0.1)  # another station's
    version = requested.messages.begin(AUTOPILOT_VERSION_ID, VersionAttempts(requested.context.retry), 0.1)
    requested.messages.acknowledged(CommandAck(512, 3, 255, 190), 0.1)  # may belong to AUTOPILOT_VERSION
    assert not ask.done
    requested.messages.end(version)
    requested.messages.acknowledged(CommandAck(512, 3), 0.1)  # MAVLink 1 has no target in COMMAND_ACK
    assert ask.done


def test_the_request_is_repeated_until_it_is_given_up() -> None:
    requested = Asked()
    ask = requested.machine.ask(0.0)
    late = requested.machine.ask(0.5)
    now = 0.0
    while not ask.done:
        now = requested.messages.next_deadline()
        assert now < 100.0
        requested.messages.tick(now)
    assert isinstance(ask.error, NoReply)
    assert isinstance(late.error, NoReply)
    assert len(requested.sent) == ask.attempts >= 5
    assert "COMPONENT_METADATA of 1/1" in str(ask.error)
    requested.messages.tick(now + 1)
    requested.machine.release(ask)


def test_the_request_is_repeated_when_the_link_is_restored() -> None:
    requested = Asked()
    requested.machine.resume(0.0)
    assert requested.sent == []
    requested.machine.ask(0.0)
    requested.machine.resume(0.5)
    assert len(requested.sent) == 2
    sent: list[Any] = []
    machine = ComponentMachine(
        1, 1, own_address=(255, 190), link="link", send=sent.append, observer=EventMaker(lambda _: None)
    )
    machine.metadata_requests.ask(0.0)
    machine.resume(0.5)
    assert len(sent) == 2


# The metadata cache


def described(name: str = "A") -> bytes:
    return file_of({"version": 1, "parameters": [{"name": name}]})


def test_a_firmware_is_identified_by_version_commit_and_board(tmp_path: Path) -> None:
    kept = MetadataStore(tmp_path / "a" / "b")
    assert kept.known(IDENTITY, 1) is None
    content = described()
    kept.put(content, crc32_px4(content))
    kept.remember(IDENTITY, 1, crc32_px4(content))
    for same in (IDENTITY, replace(IDENTITY, system=7, uid="ffff", link="other")):
        known = kept.known(same, 1)
        assert known is not None
        assert list(known) == ["A"]
    for other in (
        replace(IDENTITY, firmware=1),
        replace(IDENTITY, git_hash="ffff"),
        replace(IDENTITY, board=2),
        replace(IDENTITY, autopilot=3),
    ):
        assert kept.known(other, 1) is None
    assert kept.known(IDENTITY, 2) is None
    assert repr(kept) == f"<MetadataStore {tmp_path / 'a' / 'b'}>"


def test_a_firmware_without_a_commit_is_not_identified(tmp_path: Path) -> None:
    kept = MetadataStore(tmp_path)
    unknown = replace(IDENTITY, git_hash="")
    kept.remember(unknown, 1, 7)
    assert kept.known(unknown, 1) is None
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", [b"", b"x", b"\xff" * 100])
def test_a_damaged_file_is_deleted(damage: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    kept = MetadataStore(tmp_path)
    content = described()
    crc = crc32_px4(content)
    kept.put(content, crc)
    kept.remember(IDENTITY, 1, crc)
    (path,) = tmp_path.glob("*.metadata")
    path.write_bytes(damage)
    with caplog.at_level(logging.WARNING, "paramclient"):
        assert kept.known(IDENTITY, 1) is None
    assert "is damaged and was removed" in caplog.text
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", [b"", b"zzzzzzzz\n", b"../../../x", b"0" * 100])
def test_a_damaged_firmware_file_is_deleted(damage: bytes, tmp_path: Path) -> None:
    kept = MetadataStore(tmp_path)
    kept.remember(IDENTITY, 1, 7)
    (path,) = tmp_path.iterdir()
    path.write_bytes(damage)
    assert kept.known(IDENTITY, 1) is None
    assert not list(tmp_path.iterdir())


def test_unreadable_metadata_is_forgotten(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    kept = MetadataStore(tmp_path)
    kept.put(b"{}", crc32_px4(b"{}"))
    kept.remember(IDENTITY, 1, crc32_px4(b"{}"))
    with caplog.at_level(logging.WARNING, "paramclient"):
        assert kept.known(IDENTITY, 1) is None
        assert kept.known(IDENTITY, 1) is None
    assert caplog.text.count("WARNING") == 1


def test_the_number_of_files_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata_cache, "CACHED_FILES_MAX", 4)
    kept = MetadataStore(tmp_path)
    contents = [described(f"P{number}") for number in range(6)]
    for number, content in enumerate(contents):
        kept.put(content, crc32_px4(content))
        os.utime(tmp_path / f"{crc32_px4(content):08x}.metadata", (number, number))
        if number == 3:
            assert kept.get(crc32_px4(contents[0])) == contents[0]  # used most recently
    held = [kept.get(crc32_px4(content)) is not None for content in contents]
    assert held == [True, False, False, True, True, True]


def test_disk_errors_are_logged_as_warnings(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("in the way")
    kept = MetadataStore(tmp_path / "file")
    content = described()
    with caplog.at_level(logging.WARNING, "paramclient"):
        kept.put(content, crc32_px4(content))
        kept.remember(IDENTITY, 1, crc32_px4(content))
        assert kept.get(crc32_px4(content)) is None
        assert kept.known(IDENTITY, 1) is None
    assert "cannot be written" in caplog.text


def test_a_failed_write_leaves_no_partial_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kept = MetadataStore(tmp_path)

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    with caplog.at_level(logging.WARNING, "paramclient"):
        kept.put(b"abc", crc32_px4(b"abc"))
    assert not list(tmp_path.iterdir())
    assert "No space left" in caplog.text


def test_the_store_is_beside_the_cache(tmp_path: Path) -> None:
    cache = ParamCache(tmp_path / "parameters.sqlite3")
    assert MetadataStore.beside(cache.path).folder == tmp_path / "parameters.metadata"


# The simulated vehicle


def test_a_mavlink_1_vehicle_cannot_have_metadata() -> None:
    with pytest.raises(UsageError, match="MAVLink 1"):
        PX4Vehicle(metadata=True, mavlink_version=1)


def test_a_vehicle_without_metadata_has_no_files() -> None:
    assert not PX4Vehicle().files
    assert set(PX4Vehicle(metadata=True).files) == {GENERAL_FILE, METADATA_FILE}
