"""One other program on the same link: what goes to it and from it, and that it holds nothing up."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections import deque
from pathlib import Path

import anyio
import anyio.lowlevel
import pytest

from paramclient import LinkError, ParamType
from paramclient.cli import run
from paramclient.client import forwarding, link_task
from paramclient.links import Peer, create_link
from paramclient.links.tlog import read_records
from paramclient.model.values import Encoding, encode_value
from paramclient.wire import frames, messages, signing
from tests.shell import FlakyLink, Tap, a_client, bits, generic, in_simulated_time, small_px4, tasks_beside


class Program:
    """A link to another program.

    Attributes:
        received: the frames that it was given.
        is_stuck: it takes nothing, and a sender waits.
    """

    name = "program"
    is_stream = False
    reconnects = False

    def __init__(self) -> None:
        self.received: list[bytes] = []
        self.is_stuck = False
        self._said: deque[bytes] = deque()
        self._activity = anyio.Event()
        self._is_open = False

    def say(self, *said: messages.Message, system: int = 255) -> None:
        for message in said:
            self.say_bytes(messages.encode(message, system=system, component=190, sequence=0))

    def say_bytes(self, data: bytes) -> None:
        self._said.append(data)
        self._activity.set()

    def messages(self) -> list[messages.Message]:
        framer = frames.Framer(messages.DECODED_IDS, stream=False)
        found = [messages.decode(each) for data in self.received for each in framer.receive(data)]
        return [message for message in found if message is not None]

    async def open(self) -> None:
        self._is_open = True

    async def receive(self) -> list[tuple[Peer, bytes]]:
        while self._is_open and not self._said:
            self._activity = anyio.Event()
            await self._activity.wait()
        if not self._is_open:
            raise LinkError("program: closed", link="program")
        said = [("program", data) for data in self._said]
        self._said.clear()
        return [*said]

    async def send(self, data: bytes, peer: Peer | None) -> None:
        assert peer is None
        while self.is_stuck:  # noqa: ASYNC110 - no event reports it
            await anyio.sleep(1.0)
        self.received.append(data)

    async def close(self) -> None:
        self._is_open = False
        self._activity.set()


class Recorded(Tap):
    """Keeps what the vehicle has sent."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]  # one endpoint
        self.said: list[bytes] = []

    def data_to_send(self) -> list[bytes]:
        data = super().data_to_send()
        self.said += data
        return data


def a_set(name: str, value: int) -> messages.ParamSet:
    return messages.ParamSet(
        1, 1, name, encode_value(value, ParamType.INT32, Encoding.BYTEWISE), ParamType.INT32
    )


@in_simulated_time
async def test_every_frame_of_the_vehicle_is_passed_on_and_none_of_ours() -> None:
    vehicle, program = Recorded(small_px4()), Program()
    async with a_client(vehicle, forward=program) as client:
        result = await (await client.component()).fetch_all()
        assert result.complete
        await anyio.sleep(1.5)
        assert program.received == vehicle.said
    assert not any(isinstance(each, messages.ParamRequestList) for each in program.messages())


@in_simulated_time
async def test_requests_of_the_program_reach_the_vehicle_and_responses_the_program() -> None:
    vehicle, program = Tap(generic()), Program()
    async with a_client(vehicle, forward=program) as client:
        component = await client.component()
        await anyio.sleep(10.0)
        program.received.clear()
        program.say(messages.ParamRequestRead(1, 1, "PARAM_04", -1), system=200)
        await anyio.sleep(0.5)
        [answer] = [each for each in program.messages() if isinstance(each, messages.ParamValue)]
        assert answer.param_id == "PARAM_04"
        assert component.params["PARAM_04"].value == 4
        assert [frame.system for _, frame, _ in vehicle.received if frame.message_id == 20] == [200]
        # also messages that mean nothing here
        program.say_bytes(data := frames.build_frame(4, bytes(range(14)), system=9, component=9, sequence=7))
        await anyio.sleep(0.5)
        assert client.bytes_sent > 0
        assert data not in program.received


@in_simulated_time
async def test_a_key_is_never_passed_on() -> None:
    """Neither way: the guide to message signing asks that it stays on the link on which it was sent."""
    vehicle, program = Tap(generic()), Program()
    key = messages.SetupSigning(1, 1, signing.SigningKey(bytes(range(32))), 1)
    async with a_client(vehicle, forward=program) as client:
        await client.component()
        program.say(key, system=200)
        program.say(messages.ParamRequestRead(1, 1, "PARAM_04", -1), system=200)
        await anyio.sleep(0.5)
        ids = [seen.message_id for _, seen, _ in vehicle.received if seen.system == 200]
    assert ids == [20]


@in_simulated_time
async def test_a_write_of_the_program_is_a_change_by_its_station() -> None:
    """Also where it has the ids that a client has."""
    program = Program()
    async with a_client(generic(), forward=program) as client:
        component = await client.component()
        await component.fetch_all()
        changes = component.changes()
        program.say(a_set("PARAM_01", 33))
        change = await anext(changes)
        assert (change.name, change.by) == ("PARAM_01", "station 255/190")
        assert change.new is not None
        assert change.new.value == 33
        assert (await component.set("PARAM_02", 5)).status == "accepted"
        assert (await anext(changes)).by == "us"


@in_simulated_time
async def test_a_program_that_reads_nothing_holds_nothing_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forwarding, "QUEUED_FRAMES_MAX", 10)
    vehicle, program = small_px4(), Program()
    program.is_stuck = True
    async with a_client(vehicle, forward=program) as client:
        began = anyio.current_time()
        component = await client.component()
        assert bits((await component.fetch_all()).params) == bits(vehicle.params)
        assert (await component.set("PARAM_01", 8)).status == "accepted"
        assert anyio.current_time() - began < 3.0
        program.is_stuck = False
        await anyio.sleep(0.0)
        assert len(program.received) <= 11
        await anyio.sleep(3.0)
        assert len(program.received) > 11


@in_simulated_time
async def test_a_program_that_floods_takes_turns_with_us(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_task, "FORWARDED_QUEUE_MAX", 100)
    vehicle, program = Tap(generic()), Program()
    async with a_client(vehicle, forward=program) as client:
        component = await client.component()
        await anyio.sleep(5.0)
        vehicle.received.clear()
        for _ in range(300):
            program.say(messages.StatusText(6, "noise"), system=200)
        await anyio.lowlevel.checkpoint()
        param = await component.get("PARAM_07")
        assert param.value == 7
        await anyio.sleep(1.0)
        kinds = [frame.system for _, frame, _ in vehicle.received]
        assert kinds.count(200) == 100
        assert kinds.index(255) < 60


@in_simulated_time
async def test_frames_of_the_program_are_not_sent_with_listen_only() -> None:
    vehicle, program = Tap(generic()), Program()
    async with a_client(vehicle, forward=program, listen_only=True) as client:
        await client.component()
        program.say(a_set("PARAM_01", 33))
        await anyio.sleep(5.0)
    assert vehicle.received == []
    assert program.received


class Stream(FlakyLink):
    """A link that cuts what it delivers anywhere."""

    is_stream = True

    async def receive(self) -> list[tuple[Peer, bytes]]:
        chunks = await super().receive()
        return [(peer, data[at : at + 7]) for peer, data in chunks for at in range(0, len(data), 7)]


@in_simulated_time
async def test_frames_of_a_stream_are_passed_on_whole_also_after_it_dropped() -> None:
    vehicle, program = Recorded(generic()), Program()
    link = Stream(vehicle)
    async with a_client(link, forward=program) as client:
        component = await client.component()
        await component.fetch_all()
        await link.drop()
        program.say(messages.StatusText(6, "into the void"))
        await anyio.sleep(2.0)
        assert (await component.get("PARAM_01")).value == 1
        await anyio.sleep(0.1)
        assert program.received == vehicle.said
        program.say(a_set("PARAM_01", 3))
        await anyio.sleep(1.0)
        assert component.params["PARAM_01"].value == 3


@in_simulated_time
async def test_forwarded_frames_are_in_the_telemetry_log(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    program = Program()
    async with a_client(generic(), forward=program, tlog=path) as client:
        await client.component()
        program.say(message := a_set("PARAM_01", 3), system=77)
        await anyio.sleep(1.0)
    with path.open("rb") as file:
        frames = [record.data for record in read_records(file)]
    assert messages.encode(message, system=77, component=190, sequence=0) in frames


@in_simulated_time
async def test_a_link_to_the_program_that_fails_for_good(caplog: pytest.LogCaptureFixture) -> None:
    program = Program()
    async with a_client(generic(), forward=program) as client:
        component = await client.component()
        await program.close()
        with caplog.at_level(logging.WARNING):
            assert (await component.fetch_all()).complete
    assert "forwarding has stopped: program: closed" in caplog.text


@pytest.mark.asyncio
async def test_a_program_that_is_not_there_yet_is_waited_for() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
        async with a_client(generic(), forward=f"tcp:127.0.0.1:{port}") as client:
            component = await client.component()
            assert (await component.fetch_all()).complete
            listener.listen()
            listener.setblocking(False)
            loop = asyncio.get_running_loop()
            with anyio.fail_after(20):
                connection, _ = await loop.sock_accept(listener)
                with connection:
                    framer = frames.Framer()
                    while not framer.receive(await loop.sock_recv(connection, 4096)):
                        pass
    assert tasks_beside() == set()


@pytest.mark.asyncio
async def test_a_link_to_the_program_that_cannot_be_opened() -> None:
    first = create_link("udpin:127.0.0.1:0")
    await first.open()
    port = first.address[1]  # type: ignore[attr-defined]  # of links over sockets
    with pytest.raises(LinkError, match="in use"):
        async with a_client(generic(), forward=f"udpin:127.0.0.1:{port}"):
            raise AssertionError("it was opened")
    await first.close()
    assert tasks_beside() == set()


def test_the_command_forwards_too(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", 0))
        program.settimeout(20)
        url = f"udpout:127.0.0.1:{program.getsockname()[1]}"
        assert run(["get", "sim:px4", "MC_ROLL_P", "--no-cache", "--forward", url]) == 0
        assert "MC_ROLL_P" in capsys.readouterr().out
        assert frames.Framer().receive(program.recv(300))
