"""An implementation that is not ours at the far end: the C++ vehicle of MAVSDK, in this process.

Over `raw://` bytes pass by function calls, over UDP by loopback. What it does differently from real
autopilots: its heartbeat says autopilot 0, it has no hardware id and no hash, and it answers with PARAM_ERROR
what it cannot do.
"""

from __future__ import annotations

import asyncio
import math
import random
import socket
import struct
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest
from mavsdk import ComponentType, Configuration, ConnectionResult, Mavsdk, log_subscribe, log_unsubscribe
from mavsdk.plugins.camera_server import CameraServer
from mavsdk.plugins.ftp_server import FtpServer
from mavsdk.plugins.param_server import ParamServer
from paramclient.model.ext_params import ExtParamType

from paramclient import Encoding, LinkError, NoReply, ParamClient, ParamType, UnknownParameter, UsageError
from paramclient.errors import SetFailed
from paramclient.links import Peer
from tests.shell import TIMEOUT, bits, residue, until


def float32(value: float) -> float:
    (same,) = struct.unpack("<f", struct.pack("<f", value))
    return float(same)


def some_values() -> dict[str, int | float]:
    """A thousand parameters, with the values that are hard to carry among them."""
    source = random.Random(1)
    integers = [0, 1, -1, 2**31 - 1, -(2**31), -5000000, 2139095041, -8388607, -4194305, 2143289343]
    integers += [source.randrange(-(2**31), 2**31) for _ in range(490)]
    floats = [0.0, -0.0, math.nan, math.inf, -math.inf, 1e-45, 3.4028234663852886e38, math.pi, 16777217.0]
    floats += [source.uniform(-1e6, 1e6) for _ in range(491)]
    values: dict[str, int | float] = {f"INT_{number:03}": value for number, value in enumerate(integers)}
    return values | {f"FLOAT_{number:010}": float32(value) for number, value in enumerate(floats)}


VALUES = some_values()


@pytest.fixture(scope="module", autouse=True)
def _quiet() -> Iterator[None]:
    """MAVSDK prints its log on standard output, unless a caller takes it."""
    log_subscribe(lambda *_: True)
    yield
    log_unsubscribe()


class Vehicle:
    """An autopilot with parameters, by MAVSDK."""

    def __init__(self, mavsdk: Mavsdk) -> None:
        self.mavsdk = mavsdk
        self.server = ParamServer(mavsdk.server_component())
        for name, value in VALUES.items():
            provide = (
                self.server.provide_param_int if isinstance(value, int) else self.server.provide_param_float
            )
            provide(name, value)

    def connect(self, url: str) -> None:
        assert self.mavsdk.add_any_connection(url) is ConnectionResult.SUCCESS


@contextmanager
def a_vehicle() -> Iterator[Vehicle]:
    configuration = Configuration.create_with_component_type(ComponentType.AUTOPILOT)
    try:
        with Mavsdk(configuration) as mavsdk:
            yield Vehicle(mavsdk)
    finally:
        configuration.destroy()


class RawLink:
    """Bytes to and from a vehicle by function calls. It calls from threads of its own."""

    name = "raw:mavsdk"
    is_stream = False
    reconnects = False

    def __init__(self, vehicle: Vehicle) -> None:
        self._mavsdk = vehicle.mavsdk
        self._arrived: list[bytes] = []
        self._wake = asyncio.Event()
        self._subscription: Any = None

    async def open(self) -> None:
        loop = asyncio.get_running_loop()
        assert self._mavsdk.add_any_connection("raw://") is ConnectionResult.SUCCESS
        self._subscription = self._mavsdk.subscribe_raw_bytes_to_be_sent(
            lambda data: loop.call_soon_threadsafe(self._take, data)
        )

    async def receive(self) -> list[tuple[Peer, bytes]]:
        while not self._arrived:
            if self._subscription is None:
                raise LinkError("closed", link=self.name)
            self._wake.clear()
            await self._wake.wait()
        arrived, self._arrived = self._arrived, []
        return [("mavsdk", data) for data in arrived]

    async def send(self, data: bytes, peer: Peer | None) -> None:
        await asyncio.sleep(0)
        self._mavsdk.pass_received_raw_bytes(data)

    async def close(self) -> None:
        if self._subscription is not None:
            self._mavsdk.unsubscribe_raw_bytes_to_be_sent(self._subscription)
            self._subscription = None
        self._wake.set()

    def _take(self, data: bytes) -> None:
        self._arrived.append(data)
        self._wake.set()


def free_port() -> int:
    with socket.socket(type=socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


@asynccontextmanager
async def connected(kind: str, **options: Any) -> AsyncIterator[tuple[ParamClient, Vehicle]]:
    """A client and a vehicle on a link of this kind."""
    with a_vehicle() as vehicle:
        link: RawLink | str = "udpin:127.0.0.1:0"
        if kind == "raw":
            link = RawLink(vehicle)
        elif kind == "udpout":
            port = free_port()
            vehicle.connect(f"udpin://127.0.0.1:{port}")
            link = f"udpout:127.0.0.1:{port}"
        async with ParamClient(link, **{"cache": False} | options) as client:
            if kind == "udpin":
                opened: Any = client.link
                vehicle.connect(f"udpout://127.0.0.1:{opened.address[1]}")
            with anyio.fail_after(TIMEOUT):
                yield client, vehicle


def bits_of(value: float) -> int:
    number, layout = (value, "<i") if isinstance(value, int) else (value, "<f")
    return int.from_bytes(struct.pack(layout, number), "little")


BITS = {name: bits_of(value) for name, value in VALUES.items()}


@pytest.mark.asyncio
@pytest.mark.parametrize("kind", ["raw", "udpin", "udpout"])
async def test_a_thousand_parameters_to_the_last_bit(kind: str) -> None:
    async with connected(kind) as (client, _):
        component = await client.component()
        result = await component.fetch_all()
        assert result.complete
        assert (result.count, result.received, result.hash, result.source) == (1000, 1000, None, "stream")
        assert bits(result.params) == BITS
        kinds = {name: param.type for name, param in result.params.items()}
        assert {name for name, kind in kinds.items() if kind == ParamType.INT32} == set(list(VALUES)[:500])
        assert {name for name, kind in kinds.items() if kind == ParamType.REAL32} == set(list(VALUES)[500:])
        assert sorted(param.index or 0 for param in result.params.values()) == list(range(1000))
        everything = await client.fetch_all()
        assert bits(everything.results[1, 1].params) == BITS


@pytest.mark.asyncio
async def test_the_identity_of_the_mavsdk_server() -> None:
    async with connected("raw") as (client, _):
        component = await client.component()
        await component.fetch_all()
        await until(lambda: component.identity.capabilities)
        assert (component.system, component.component) == (1, 1)
        assert component.autopilot == "generic"
        assert component.identity.uid is None
        assert component.encoding is Encoding.BYTEWISE
        assert component.encoding_reason == "the standard's encoding, as nothing says otherwise"
        assert repr(component).startswith("<Component 1/1 generic synced 1000 params from stream")


@pytest.mark.asyncio
@pytest.mark.parametrize("kind", ["raw", "udpin", "udpout"])
async def test_reading_and_writing(kind: str) -> None:
    async with connected(kind) as (client, vehicle):
        component = await client.component()
        for name in ("INT_005", "INT_009", "FLOAT_0000000002", "FLOAT_0000000006"):
            param = await component.get(name)
            assert (param.name, param.bits) == (name, BITS[name])
            assert param.index is not None
            assert await component.get(param.index) == param
        for value in (0, -5000000, 2139095041, -(2**31), 2**31 - 1):
            done = await component.set("INT_001", value)
            assert (done.status, done.actual, done.param.type) == ("accepted", value, ParamType.INT32)
            assert vehicle.server.retrieve_param_int("INT_001") == value
        for number in (0.1, -0.5, math.inf, 1e-45):
            done = await component.set("FLOAT_0000000001", number)
            assert (done.status, done.actual, done.param.type) == (
                "accepted",
                float32(number),
                ParamType.REAL32,
            )
            assert vehicle.server.retrieve_param_float("FLOAT_0000000001") == float32(number)
        assert (await component.set("FLOAT_0000000001", 3)).actual == 3.0, "a whole number for a float"
        assert (await component.set("INT_001", 3.0)).actual == 3, "and the other way round"
        with pytest.raises(UsageError):
            await component.set("INT_001", 3.5)
        assert vehicle.server.retrieve_param_int("INT_001") == 3
        assert not residue(component)


@pytest.mark.asyncio
async def test_many_at_once() -> None:
    async with connected("raw") as (client, vehicle):
        component = await client.component()
        names = list(VALUES)[:200]
        assert {param.name: param.bits for param in await asyncio.gather(*map(component.get, names))} == {
            name: BITS[name] for name in names
        }
        await asyncio.gather(*(component.set(name, number) for number, name in enumerate(names)))
        assert [vehicle.server.retrieve_param_int(name) for name in names] == list(range(200))


@pytest.mark.asyncio
@pytest.mark.parametrize("kind", ["raw", "udpin"])
async def test_the_mavsdk_server_answers_unknown_names_with_an_error(kind: str) -> None:
    async with connected(kind) as (client, _):
        component = await client.component()
        await component.get("INT_001")
        for call in (component.get("NOT_THERE"), component.set("NOT_THERE", 1), component.get(1000)):
            with pytest.raises(UnknownParameter) as caught:
                await call
            assert (caught.value.system, caught.value.component) == (1, 1)
        assert not residue(component)


@pytest.mark.asyncio
async def test_its_table_is_kept_for_the_next_session(tmp_path: Path) -> None:
    for known in (0, 1000):
        async with connected("raw", cache=tmp_path / "cache") as (client, _):
            component = await client.component()
            assert len(component.params) == known
            assert (await component.fetch_all()).source == "stream", "it has no hash to confirm it with"
    assert bits(component.params) == BITS


class LossyLink(RawLink):
    """One that loses messages, by a seed."""

    def __init__(self, vehicle: Vehicle, loss: float, seed: int) -> None:
        super().__init__(vehicle)
        self._loss = loss
        self._random = random.Random(seed)

    async def send(self, data: bytes, peer: Peer | None) -> None:
        if self._random.random() >= self._loss:
            await super().send(data, peer)

    def _take(self, data: bytes) -> None:
        if self._random.random() >= self._loss:
            super()._take(data)


@pytest.mark.asyncio
@pytest.mark.parametrize("loss", [0.0, 0.05])
async def test_its_files_are_read_to_the_last_byte(loss: float, tmp_path: Path) -> None:
    """Its server refuses what lies beyond the end of a file."""
    sizes = [0, 1, 238, 239, 240, 3 * 239, 5000, 80_000]
    contents = {f"{size}.bin": random.Random(size).randbytes(size) for size in sizes}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    with a_vehicle() as vehicle:
        FtpServer(vehicle.mavsdk.server_component()).set_root_dir(str(tmp_path))
        async with ParamClient(LossyLink(vehicle, loss, seed=1), cache=False) as client:
            with anyio.fail_after(TIMEOUT):
                files = client.ftp(await client.component())
                assert {entry.name: entry.size for entry in await files.list("/")} == {
                    name: len(content) for name, content in contents.items()
                }
                for name, content in contents.items():
                    assert await files.read(f"/{name}") == content, name


# extended parameters

TEXTS = {"TEXT": "hello", "LONGEST": "x" * 128, "SIXTEEN_LETTERS_": "Übergröße", "EMPTY": ""}


@asynccontextmanager
async def with_extended(
    kind: ComponentType, loss: float = 0.0
) -> AsyncIterator[tuple[ParamClient, ParamServer]]:
    """A client and a component of this kind, whose parameters are served by both protocols."""
    configuration = Configuration.create_with_component_type(kind)
    try:
        with Mavsdk(configuration) as mavsdk:
            vehicle = Vehicle(mavsdk)
            for name, text in TEXTS.items():
                vehicle.server.provide_param_custom(name, text)
            if kind is ComponentType.CAMERA:
                CameraServer(mavsdk.server_component())
            async with ParamClient(LossyLink(vehicle, loss, seed=2), cache=False) as client:
                with anyio.fail_after(TIMEOUT):
                    yield client, vehicle.server
    finally:
        configuration.destroy()


ADDRESSES = {ComponentType.CAMERA: (1, 100), ComponentType.AUTOPILOT: (1, 1)}


@pytest.mark.asyncio
@pytest.mark.parametrize("kind", list(ADDRESSES))
@pytest.mark.parametrize("loss", [0.0, 0.1])
async def test_extended_parameters_of_every_type_that_it_has(kind: ComponentType, loss: float) -> None:
    async with with_extended(kind, loss) as (client, server):
        component = await client.component(*ADDRESSES[kind])
        ext = component.ext
        assert ext.is_expected is (kind is ComponentType.CAMERA)
        result = await ext.fetch_all()
        assert result.complete
        assert (result.count, len(result.params)) == (1000 + len(TEXTS), 1000 + len(TEXTS))
        for name, value in VALUES.items():
            param = result.params[name]
            is_whole = isinstance(value, int)
            assert param.type is (ExtParamType.INT32 if is_whole else ExtParamType.REAL32)
            assert int.from_bytes(param.raw, "little") == BITS[name]
        for name, text in TEXTS.items():
            param = result.params[name]
            assert (param.value, param.type) == (text, ExtParamType.CUSTOM)
            assert await ext.get(name) == param
            assert param.index is not None
            assert await ext.get(param.index) == param
        assert (await ext.set("INT_001", -5000000)).actual == -5000000
        assert server.retrieve_param_int("INT_001") == -5000000
        assert (await ext.set("FLOAT_0000000001", 0.1)).actual == float32(0.1)
        for text in ("", "y" * 128, "grün"):
            done = await ext.set("TEXT", text)
            assert (done.status, done.actual) == ("accepted", text)
            assert server.retrieve_param_custom("TEXT") == text.encode()
        assert not component.core.machine.is_busy


@pytest.mark.asyncio
async def test_the_mavsdk_server_and_unusual_extended_writes() -> None:
    async with with_extended(ComponentType.CAMERA) as (client, server):
        component = await client.component(1, 100)
        ext = component.ext
        await ext.fetch_all()
        done = await ext.set("TEXT", b"A\0B")
        assert (done.status, done.actual) == ("adjusted", "A"), "it cuts values at the first zero"
        with pytest.raises(UnknownParameter):
            await ext.set("NO_SUCH", 1)
        with pytest.raises(UnknownParameter):
            await ext.get("NO_SUCH")
        table = component.core.machine.ext.table
        known = table.params["INT_001"]
        table.params["INT_001"] = type(known).of("INT_001", b"text", ExtParamType.CUSTOM, known.index)
        with pytest.raises(SetFailed):
            await ext.set("INT_001", "text")
        result = await ext.set_many(dict.fromkeys(list(VALUES)[:100], 7))
        assert [each.name for each in result.outcomes if not each.is_set] == ["INT_001"]
        assert server.retrieve_param_int("INT_099") == 7


@pytest.mark.asyncio
async def test_its_two_tables_are_apart() -> None:
    async with with_extended(ComponentType.CAMERA) as (client, _):
        component = await client.component(1, 100)
        plain = await component.fetch_all()
        assert (plain.count, len(component.ext.params)) == (1000, 0)
        extended = await component.ext.fetch_all()
        assert (extended.count, component.count) == (1000 + len(TEXTS), 1000)
        assert not set(TEXTS) & set(component.params)
        with pytest.raises((NoReply, UnknownParameter)):
            await component.get("TEXT", timeout=5.0)
