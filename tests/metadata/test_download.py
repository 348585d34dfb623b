"""Metadata of vehicles: the request, the files, and the metadata cache."""

from __future__ import annotations

import json
import logging
import lzma
import stat
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import pytest

from paramclient import FileTransferError, NoReply
from paramclient.errors import FileError
from paramclient.metadata import Metadata, MetadataStore, download, metadata_of
from paramclient.model.identity import Identity
from paramclient.model.px4_hash import crc32_px4
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from paramclient.sim.px4 import GENERAL_FILE, METADATA_FILE
from paramclient.wire.messages import FileTransfer
from tests.caches import read_only
from tests.shell import Tap, a_client, generic, outcome, residue, small_px4

IDENTITY = Identity(1, "link", "abcd", 12, 2, 0x01110000, "0123abcd", 1)


def describing(**options: Any) -> PX4Vehicle:
    """Return a small vehicle with metadata of its parameters."""
    return small_px4(metadata=True, **options)


def file_of(document: object) -> bytes:
    return lzma.compress(json.dumps(document).encode())


def publish(vehicle: PX4Vehicle, **entry: Any) -> None:
    """Replace the entry of the parameter metadata in a vehicle's general file."""
    kinds = [{"type": 1, "uri": f"mftp://{METADATA_FILE}"} | entry, {"type": 4, "uri": "https://x.invalid/e"}]
    vehicle.files[GENERAL_FILE] = file_of({"version": 1, "metadataTypes": kinds})


def reads_of(tap: Tap) -> int:
    """Return the number of MAVFTP messages that the station has sent."""
    return len(tap.messages(FileTransfer))


# Complete downloads


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
        assert read.source == f"mftp://{METADATA_FILE} of 1/1"
        assert not residue(component)
        await anyio.sleep(1.0)
        assert not vehicle.open_files


async def test_a_cached_file_is_not_downloaded_again(tmp_path: Path) -> None:
    cache, folder = tmp_path / "cache.sqlite3", tmp_path / "cache.metadata"
    for expected in (True, False):
        tap = Tap(describing())
        async with a_client(tap, cache=str(cache)) as client:
            component = await client.component()
            before = reads_of(tap)
            read = await metadata_of(component)
            assert read is not None
            assert (reads_of(tap) > before) is expected
            kept = await anyio.to_thread.run_sync(lambda: [*folder.iterdir()])
            assert len(kept) == 3
            assert {stat.S_IMODE(path.stat().st_mode) for path in kept} == {0o600}
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
            known = MetadataStore(folder).known(component.identity, 1)
            assert known is not None
            assert known.params == read.params


# Errors


@pytest.mark.parametrize("make", [PX4Vehicle, ArduPilotVehicle, generic])
async def test_vehicles_without_metadata(make: Any) -> None:
    async with a_client(make()) as client:
        component = await client.component()
        began = anyio.current_time()
        assert await metadata_of(component) is None
        assert anyio.current_time() - began < 1.5


async def test_a_file_on_another_component() -> None:
    vehicle, camera = describing(), PX4Vehicle(component=100, table={"CAM_MODE": 1})
    camera.files["/p.json"] = json.dumps({"version": 1, "parameters": [{"name": "CAM_MODE"}]}).encode()
    for number, expected in ((100, Metadata), (101, FileError)):
        publish(vehicle, uri=f"mftp://[;comp={number}]/p.json")
        async with a_client(Air([vehicle, camera])) as client:
            await client.component(component=100)
            result = await outcome(metadata_of(await client.component()))
            assert isinstance(result, expected), result


@pytest.mark.parametrize(
    ("wrong", "error", "said"),
    [
        ("checksum", FileError, "does not have the announced checksum"),
        ("missing", FileTransferError, "file not found"),
        ("damaged", FileError, f"{METADATA_FILE} of 1/1: cannot be unpacked: the file is truncated"),
        ("address", FileError, r"mftp://x*: announced by 1/1: .* 1 to 238 bytes"),
        ("size", FileTransferError, "longer than 400 bytes"),
        ("place", FileError, r"^https://example\.invalid/p\.xz: 1/1 has its metadata .* not downloaded"),
    ],
)
async def test_a_file_that_is_not_as_announced_or_elsewhere(
    wrong: str, error: type[Exception], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicle = describing()
    content = vehicle.files[METADATA_FILE]
    if wrong == "checksum":
        publish(vehicle, fileCrc=crc32_px4(content) ^ 1)
    elif wrong == "missing":
        del vehicle.files[METADATA_FILE]
    elif wrong == "damaged":
        vehicle.files[METADATA_FILE] = content[:-20]
        publish(vehicle, fileCrc=crc32_px4(content[:-20]))
    elif wrong == "size":
        monkeypatch.setattr(download, "PACKED_SIZE_MAX", 400)
        assert len(vehicle.files[GENERAL_FILE]) < 400 < len(content)
    else:
        publish(vehicle, uri="https://example.invalid/p.xz" if wrong == "place" else "mftp://" + "x" * 240)
    kept = MetadataStore(tmp_path)
    async with a_client(vehicle) as client:
        component = await client.component()
        with pytest.raises(error, match=said):
            await metadata_of(component, store=kept)
        assert kept.known(component.identity, 1) is None
        await anyio.sleep(1.0)
        assert not vehicle.open_files


async def test_a_vehicle_that_does_not_respond() -> None:
    tap = Tap(describing())
    async with a_client(tap) as client:
        component = await client.component()
        tap.is_deaf = True
        began = anyio.current_time()
        assert isinstance(await outcome(metadata_of(component, timeout=0.7)), NoReply)
        assert anyio.current_time() - began == pytest.approx(0.7, abs=0.01)
        assert isinstance(await outcome(metadata_of(component)), NoReply)
        tap.is_deaf = False
        assert await metadata_of(component) is not None


async def test_cancellation_closes_files_and_sessions(tmp_path: Path) -> None:
    """At every point of the download."""
    for moment in (0.001, 0.012, 0.03, 0.05, 0.1, 0.2):
        vehicle = describing(ftp_rate=20_000)
        async with a_client(vehicle) as client:
            component = await client.component()
            with anyio.move_on_after(moment):
                await metadata_of(component, store=MetadataStore(tmp_path / str(moment)))
            await anyio.sleep(1.0)
            assert not vehicle.open_files
            assert await metadata_of(component) is not None


# The metadata cache


def described(name: str = "A") -> bytes:
    return file_of({"version": 1, "parameters": [{"name": name}]})


def test_a_firmware_is_identified_by_version_commit_and_board(tmp_path: Path) -> None:
    kept = MetadataStore(tmp_path / "a" / "b")
    assert kept.known(IDENTITY, 1) is None
    content = described()
    kept.keep({crc32_px4(content): content}, IDENTITY, 1, crc32_px4(content))
    for same in (IDENTITY, replace(IDENTITY, system=7, uid="ffff", link="other")):
        known = kept.known(same, 1)
        assert known is not None
        assert list(known) == ["A"]
    others: tuple[dict[str, Any], ...] = ({"firmware": 1}, {"git_hash": "f"}, {"board": 2}, {"autopilot": 3})
    assert all(kept.known(replace(IDENTITY, **other), 1) is None for other in others)
    assert kept.known(IDENTITY, 2) is None


@pytest.mark.parametrize("damage", [b"", b"x", b"\xff" * 100])
def test_a_damaged_file_is_deleted(damage: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    kept = MetadataStore(tmp_path)
    content = described()
    crc = crc32_px4(content)
    kept.keep({crc: content}, IDENTITY, 1, crc)
    (path,) = tmp_path.glob("*.metadata")
    path.write_bytes(damage)
    with caplog.at_level(logging.WARNING, "paramclient"):
        assert kept.known(IDENTITY, 1) is None
    assert "is damaged and was removed" in caplog.text
    assert not list(tmp_path.iterdir())


async def test_a_read_only_folder_is_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """For the cache too, whose cause is the same."""
    path = tmp_path / "cache"
    with read_only(tmp_path):
        async with a_client(describing(), cache=str(path)) as client:
            component = await client.component()
            assert await metadata_of(component) is not None
            await component.fetch_all()
            assert MetadataStore.beside(path).known(component.identity, 1) is None
    [warning] = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    assert "cannot be written" in warning
