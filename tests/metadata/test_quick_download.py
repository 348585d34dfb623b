"""Downloads of metadata that the user has not requested: only where they are quick, and never for long."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import pytest

from paramclient import LinkError
from paramclient.metadata import MetadataStore, download, load_if_quick
from paramclient.metadata.quick_download import QUICK_TIMEOUT
from paramclient.protocol.wire import CommandLong, FileTransfer
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, GenericVehicle, PX4Vehicle
from tests.shell import Tap, a_client, in_simulated_time, residue, simulated_time_loop


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


@in_simulated_time
async def test_on_a_quick_link_the_metadata_is_loaded_and_remembered(tmp_path: Path) -> None:
    store = MetadataStore(tmp_path)
    async with a_client(PX4Vehicle(metadata=True)) as client:
        component = await client.component()
        await component.fetch_all()
        found = await load_if_quick(component, store=store)
        assert found.metadata is not None
        assert found.note == ""
        assert "MC_ROLL_P" in found.metadata
        assert await anyio.to_thread.run_sync(store.known, component.identity, 1) is not None


@in_simulated_time
async def test_a_slow_transfer_is_given_up_without_residue() -> None:
    vehicle = PX4Vehicle(metadata=True, ftp_rate=2_000.0)
    async with a_client(vehicle) as client:
        component = await client.component()
        await component.fetch_all()
        began = anyio.current_time()
        found = await load_if_quick(component)
        assert (found.metadata, found.note) == (None, "the transfer did not end within 2 s")
        assert QUICK_TIMEOUT <= anyio.current_time() - began < QUICK_TIMEOUT + 0.5
        assert not residue(component)
        await anyio.sleep(1.0)
        assert not vehicle.open_files


@in_simulated_time
async def test_less_time_is_taken_where_less_is_left() -> None:
    async with a_client(PX4Vehicle(metadata=True, ftp_rate=2_000.0)) as client:
        component = await client.component()
        assert (await load_if_quick(component)).note == "the vehicle has not reported its capabilities"
        await component.fetch_all()
        found = await load_if_quick(component, timeout=0.5)
        assert found.note == "the transfer did not end within 0.5 s"


@pytest.mark.parametrize(
    ("vehicle", "note"),
    [
        (PX4Vehicle(metadata=True, armed=True), "the vehicle is armed"),
        (
            PX4Vehicle(metadata=True, burst=1, period=0.125),
            "the link is slow: its list arrived at less than 200 values/s",
        ),
        (ArduPilotVehicle(), "ArduPilot does not serve its metadata"),
        (GenericVehicle(table={"A": 1}), "the vehicle does not announce MAVFTP"),
    ],
)
@in_simulated_time
async def test_where_it_cannot_be_quick_nothing_is_requested(vehicle: Any, note: str) -> None:
    tap = Tap(vehicle)
    async with a_client(tap) as client:
        component = await client.component()
        await component.fetch_all()
        before = len(tap.messages(CommandLong)), len(tap.messages(FileTransfer))
        found = await load_if_quick(component)
        assert (found.metadata, found.note) == (None, note)
        assert (len(tap.messages(CommandLong)), len(tap.messages(FileTransfer))) == before


@in_simulated_time
async def test_a_listening_client_requests_nothing() -> None:
    tap = Tap(PX4Vehicle(metadata=True))
    async with a_client(tap, listen_only=True) as client:
        found = await load_if_quick(await client.component())
        assert (found.metadata, found.note) == (None, "the client only listens")
    assert not tap.received


@in_simulated_time
async def test_a_vehicle_without_metadata_is_reported_as_such() -> None:
    async with a_client(PX4Vehicle()) as client:
        component = await client.component()
        await component.fetch_all()
        assert (await load_if_quick(component)).note == "the vehicle serves no metadata"


@in_simulated_time
async def test_lost_packets_do_not_prevent_it() -> None:
    air = Air(
        [PX4Vehicle(metadata=True)],
        uplink=FaultyLink(loss=0.1, seed=3),
        downlink=FaultyLink(loss=0.1, seed=4),
    )
    async with a_client(air) as client:
        component = await client.component()
        await component.fetch_all()
        found = await load_if_quick(component)
        assert found.metadata is not None, found.note


@in_simulated_time
async def test_the_end_of_the_client_is_an_error() -> None:
    async with a_client(PX4Vehicle(metadata=True)) as client:
        component = await client.component()
        await component.fetch_all()
    with pytest.raises(LinkError):
        await load_if_quick(component)
