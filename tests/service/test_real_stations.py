"""Real ground stations behind the gateway: pymavlink and MAVSDK, each at an endpoint of its own."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import anyio.to_process
import pytest

from paramclient.model.values import Encoding, decode_value
from paramclient.service import Hub
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, Vehicle
from paramclient.wire.messages import ParamRequestList, ParamRequestRead, ParamSet
from tests.shell import TIMEOUT, Tap, small_px4, until
from tests.simulated_on_udp import free_port


def fetch_with_pymavlink(port: int, lists: int = 1) -> tuple[dict[str, float], float]:
    """Request lists and, of what has not come after a second of silence, single values.

    Returns the values, and the share of frames that are lost by their sequence numbers, in percent.
    """
    from pymavlink import mavutil

    master = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
    master.wait_heartbeat(timeout=TIMEOUT)
    encoding = Encoding.C_CAST if master.messages["HEARTBEAT"].autopilot == 3 else Encoding.BYTEWISE
    values: dict[str, float] = {}
    for _ in range(lists):
        missing: set[int] | None = None
        master.mav.param_request_list_send(1, 1)
        while missing is None or missing:
            if (message := master.recv_match(type="PARAM_VALUE", blocking=True, timeout=1.0)) is None:
                for index in sorted(missing or ())[:10]:
                    master.mav.param_request_read_send(1, 1, b"", index)
            elif message.param_index < message.param_count:
                missing = set(range(message.param_count)) if missing is None else missing
                missing.discard(message.param_index)
                raw = struct.pack("<f", message.param_value)
                values[message.param_id] = float(decode_value(raw, message.param_type, encoding)[0])
        master.wait_heartbeat(timeout=TIMEOUT)
    return values, float(master.packet_loss())


def fetch_with_mavsdk(port: int) -> tuple[dict[str, float], None]:
    """Download all parameters with MAVSDK, which counts no losses."""
    with mavsdk_params(port) as param:
        found = param.get_all_params()
        return {each.name: float(each.value) for each in (*found.int_params, *found.float_params)}, None


@contextmanager
def mavsdk_params(port: int) -> Iterator[Any]:
    """MAVSDK's calls for the parameters of the first autopilot that sends to a port."""
    from mavsdk import ComponentType, Configuration, Mavsdk, log_subscribe
    from mavsdk.plugins.param import Param

    log_subscribe(lambda *_: True)  # MAVSDK would log on stdout
    with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        yield Param(mavsdk.first_autopilot(timeout_s=TIMEOUT))


@asynccontextmanager
async def stations_of(vehicle: Vehicle, stations: int, **faults: Any) -> AsyncIterator[tuple[Tap, list[int]]]:
    """A service whose table is in sync, and the ports on which its stations listen."""
    radio = Tap(Air.symmetric([vehicle], seed=1, **faults))
    ports = [free_port() for _ in range(stations)]
    async with Hub([radio], cache=False, mavlink=[f"udpout:127.0.0.1:{port}" for port in ports]) as hub:
        await until(lambda: hub.targets and hub.targets[0].component.sync_state == "synced", 0.05)
        radio.received.clear()
        yield radio, ports


@pytest.mark.asyncio
@pytest.mark.parametrize("kind", [PX4Vehicle, partial(ArduPilotVehicle, live_period=0.0)])
async def test_stations_get_every_value_and_the_radio_carries_none(kind: Callable[[], Vehicle]) -> None:
    vehicle = kind()
    found: list[dict[str, float]] = []

    async def fetch(way: Any, port: int) -> None:
        found.append((await anyio.to_process.run_sync(way, port))[0])

    async with stations_of(vehicle, 2, loss=0.2, delay=0.05) as (radio, ports):
        async with anyio.create_task_group() as tasks:
            for way, port in zip((fetch_with_pymavlink, fetch_with_mavsdk), ports, strict=True):
                tasks.start_soon(fetch, way, port)
        assert not radio.messages(ParamRequestList)
        assert len(radio.messages(ParamRequestRead)) <= 5  # the proof of a table that was proven 5 s before
    truth = {name: float(value) for name, value in vehicle.values.items() if not isinstance(value, bytes)}
    for values in found:
        assert {name: values[name] for name in truth} == pytest.approx(truth, rel=1e-6)


@pytest.mark.asyncio
async def test_pymavlink_counts_no_losses() -> None:
    async with stations_of(PX4Vehicle(), 1) as (_, [port]):
        assert (await anyio.to_process.run_sync(fetch_with_pymavlink, port, 3))[1] == 0.0


MAVPROXY = shutil.which("mavproxy.py")


@pytest.mark.asyncio
@pytest.mark.skipif(MAVPROXY is None, reason="MAVProxy is not installed")
async def test_mavproxy_counts_no_losses(tmp_path: Path) -> None:
    options: dict[str, Any] = {
        "cwd": tmp_path,
        "env": os.environ | {"HOME": str(tmp_path), "PYTHONUNBUFFERED": "1"},
    }
    async with stations_of(PX4Vehicle(), 1) as (radio, [port]):
        command = [str(MAVPROXY), f"--master=udpin:127.0.0.1:{port}", "--default-modules=param,link"]
        async with await anyio.open_process(
            [*command, f"--state-basedir={tmp_path}"], stderr=subprocess.STDOUT, **options
        ) as mavproxy:
            assert mavproxy.stdin is not None
            assert mavproxy.stdout is not None
            lists, text = 0, ""
            with anyio.fail_after(TIMEOUT):
                while "% loss" not in text:
                    text += (await mavproxy.stdout.receive()).decode()
                    if text.count("Received 903 parameters") > lists:
                        lists += 1
                        await mavproxy.stdin.send(b"param fetch\n" if lists < 3 else b"link\n")
            mavproxy.kill()
        assert " 0 lost, 0.0% loss" in text
        assert not radio.messages(ParamRequestList)


def set_with_mavsdk(port: int) -> tuple[int, str]:
    """Set a parameter, and another one as if it had another type; return what is read, and the error."""
    with mavsdk_params(port) as param:
        param.set_param_int("PARAM_01", 77)
        error = ""
        try:
            param.set_param_float("PARAM_02", 1.5)
        except Exception as refused:
            error = str(refused)
        return param.get_param_int("PARAM_01"), error


@pytest.mark.asyncio
async def test_mavsdk_sets_a_parameter() -> None:
    vehicle = small_px4()
    async with stations_of(vehicle, 1, loss=0.2, delay=0.05) as (radio, [port]):
        value, error = await anyio.to_process.run_sync(set_with_mavsdk, port)
        assert (value, vehicle.values["PARAM_01"]) == (77, 77)
        assert error
        assert {each.param_id for each in radio.messages(ParamSet)} == {"PARAM_01"}
