"""A relay between programs and one vehicle, with a lossy link in between that can be changed while it runs.

The relay is a process of its own. It opens the link to the vehicle once and keeps it open, so the vehicle
has one partner for the whole session: the UDP port of PX4 answers only the first partner that spoke to it.
Programs reach the vehicle through a UDP port on loopback. Every program that has spoken in the last
`PROGRAM_TIMEOUT` seconds receives everything that the vehicle sends. Both directions go through
`paramclient.sim.FaultyLink`.

    with Relay("udpin:127.0.0.1:14550") as relay:
        relay.change(Conditions(loss=0.2, round_trip=0.1, seed=1))
        async with ParamClient(relay.link) as client: ...
"""

from __future__ import annotations

import math
import multiprocessing
import signal
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Final

import anyio
import anyio.from_thread
import anyio.lowlevel

from paramclient.client.taps import FrameCutter
from paramclient.errors import FileErrorCode, LinkError
from paramclient.links import create_link, parse_link
from paramclient.links.link import Peer
from paramclient.links.sockets import UdpIn
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.sim import Air
from paramclient.wire import frames, messages

PROGRAM_TIMEOUT: Final = 5.0
"""Seconds of silence after which a program no longer receives what the vehicle sends."""
START_TIMEOUT: Final = 30.0
"""Seconds for the process of the relay to start and to open the link."""
REPLY_TIMEOUT: Final = 10.0
"""Seconds for the relay to confirm a change of the conditions."""
STOP_TIMEOUT: Final = 5.0
"""Seconds for the process of the relay to end."""
REOPEN_PAUSE: Final = 0.2
"""Seconds between two attempts to open a link to the vehicle that has dropped, as TCP does in a restart."""
SHORTEST_SLEEP: Final = 0.0005
"""Seconds that the relay sleeps at least, so that a deadline that has passed cannot keep it busy."""

FILE_TRANSFER_ID: Final = 110
"""FILE_TRANSFER_PROTOCOL."""
LIST_REQUEST_ID: Final = 21
"""PARAM_REQUEST_LIST."""
PARAMETER_TRAFFIC: Final = frozenset(
    {
        *(messages.message_id(messages.ParamValue), messages.message_id(messages.AutopilotVersion)),
        *(0, 2, 77, 110, 234, 253, 345, 397),
    }
)
"""Messages that the parameter protocol, MAVFTP and identification need; the rest is telemetry. The numbers:
HEARTBEAT, SYSTEM_TIME, COMMAND_ACK, FILE_TRANSFER_PROTOCOL, HIGH_LATENCY2, STATUSTEXT, PARAM_ERROR and
COMPONENT_METADATA."""

spawn = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Conditions:
    """What lies between the programs and the vehicle.

    Attributes:
        loss: the share of datagrams lost in each direction, 0 to 1.
        round_trip: seconds; half of it in each direction.
        rate: bytes per second in each direction; None for no limit. Nothing is lost to a limited rate: what
            the vehicle sends too fast waits in a queue without bound.
        seed: of the random numbers that pick what is lost.
        refuses_files: whether the relay answers each MAVFTP request in the vehicle's place, with the NAK of
            a server that has no such file, so that the table has to be downloaded by list.
        drops_telemetry: whether messages that have nothing to do with parameters are left out on the way
            down, as a vehicle sends less telemetry when it knows that its link is slow.
    """

    loss: float = 0.0
    round_trip: float = 0.0
    rate: float | None = None
    seed: int = 0
    refuses_files: bool = False
    drops_telemetry: bool = False

    def __str__(self) -> str:
        parts = [
            f"{self.loss:.0%} loss" if self.loss else "",
            f"{self.round_trip * 1000:.0f} ms" if self.round_trip else "",
            f"{self.rate * 10:.0f} baud" if self.rate else "",
        ]
        return ", ".join(filter(None, parts)) or "clean"


CLEAN: Final = Conditions()


class RealVehicle:
    """The vehicle's end of the lossy link: an `Endpoint` whose messages are received on another link.

    Args:
        is_stream: whether the vehicle's link delivers a byte stream, which is cut into frames here. A
            datagram stays one datagram.

    Attributes:
        outgoing: datagrams to be sent over the link to the vehicle.
        first_request_at: when a program first requested the list or a file, on the clock of
            `time.monotonic`, since the last change of the conditions; None before.
    """

    def __init__(self, *, is_stream: bool) -> None:
        self.outgoing: list[bytes] = []
        self.first_request_at: float | None = None
        self._conditions = CLEAN
        self._cutter = FrameCutter(stream=True) if is_stream else None
        self._framer = frames.Framer({FILE_TRANSFER_ID}, stream=False)
        self._incoming: list[tuple[float, bytes]] = []
        self._now = 0.0
        self._sequence = 0

    def change(self, conditions: Conditions) -> None:
        """Put other conditions into force."""
        self._conditions = conditions
        self.first_request_at = None

    def take_request(self, data: bytes, now: float) -> None:
        """Take note of what a program sends at the time `now`, before anything is lost."""
        if self.first_request_at is None and _message_id(data) in (LIST_REQUEST_ID, FILE_TRANSFER_ID):
            self.first_request_at = now

    def take_data(self, data: bytes, peer: Peer, now: float) -> None:
        """Take what the vehicle has sent over its link at the time `now`."""
        cut = [data] if self._cutter is None else [each.data for each in self._cutter.cut(data, peer)]
        for datagram in cut:
            if _message_id(datagram) in PARAMETER_TRAFFIC or not self._conditions.drops_telemetry:
                self._incoming.append((now, datagram))

    def receive(self, data: bytes, now: float) -> None:
        """See `Endpoint.receive`."""
        if self._conditions.refuses_files:
            for frame in self._framer.receive(data):
                if isinstance(message := messages.decode(frame), messages.FileTransfer):
                    self._incoming.append((now, self._refusal(message, frame)))
                    return
        self.outgoing.append(data)

    def tick(self, now: float) -> None:
        """See `Endpoint.tick`."""
        self._now = now

    def next_deadline(self) -> float | None:
        """See `Endpoint.next_deadline`."""
        return self._incoming[0][0] if self._incoming else None

    def data_to_send(self) -> list[bytes]:
        """See `Endpoint.data_to_send`."""
        due = [data for at, data in self._incoming if at <= self._now]
        del self._incoming[: len(due)]
        return due

    def _refusal(self, message: messages.FileTransfer, frame: frames.Frame) -> bytes:
        """Encode the NAK with which a server answers that it has no such file."""
        request = Packet.unpack(message.payload)
        self._sequence = (self._sequence + 1) % 256
        is_close = request.opcode in (Opcode.TERMINATE_SESSION, Opcode.RESET_SESSIONS)
        answer = Packet(
            sequence=(request.sequence + 1) & 0xFFFF,
            session=request.session,
            opcode=Opcode.ACK if is_close else Opcode.NAK,
            requested=request.opcode,
            data=b"" if is_close else bytes([FileErrorCode.FILE_NOT_FOUND]),
        )
        reply = messages.FileTransfer(0, frame.system, frame.component, answer.pack())
        return messages.encode(
            reply, system=message.target_system, component=message.target_component, sequence=self._sequence
        )


class Relay:
    """The relay as the program that starts it sees it, as a context manager.

    Args:
        vehicle_link: the name of the link to the vehicle.
        listeners: ports on loopback that receive everything from the start, for programs that listen and
            speak only to who has spoken to them.

    Attributes:
        link: the name of the link with which a program reaches the vehicle, while the relay runs.

    Raises:
        LinkError: on entering: the link to the vehicle cannot be opened. In the other calls: the relay has
            ended, as the vehicle's link failed.
    """

    def __init__(self, vehicle_link: str, *, listeners: Sequence[int] = ()) -> None:
        self._vehicle_link = parse_link(vehicle_link).name
        self._listeners = tuple(listeners)
        self._process: multiprocessing.process.BaseProcess | None = None
        self._control: Connection | None = None
        self.link = ""

    def __enter__(self) -> Relay:
        self._control, control = spawn.Pipe()
        self._process = spawn.Process(target=_run, args=(self._vehicle_link, self._listeners, control))
        self._process.start()
        control.close()
        try:
            port = self._reply(START_TIMEOUT)
        except BaseException:
            self._stop()
            raise
        self.link = f"udpout:127.0.0.1:{port}"
        return self

    def __exit__(self, *error: object) -> None:
        self._stop()

    def change(self, conditions: Conditions) -> None:
        """Put other conditions into force. What is on its way at that moment arrives at once."""
        self._ask(conditions)

    def first_request_at(self) -> float | None:
        """Return when a program first requested the list or a file since the conditions were changed.

        On the clock of `time.monotonic`; None when none did.
        """
        return self._ask(None)

    def _ask(self, conditions: Conditions | None) -> float | None:
        assert self._control is not None
        try:
            self._control.send(conditions)
        except OSError as error:
            raise LinkError(f"{self._vehicle_link}: the relay has ended", link=self._vehicle_link) from error
        return self._reply(REPLY_TIMEOUT)

    def _reply(self, timeout: float) -> float | None:
        assert self._control is not None
        reply: float | str | None = f"{self._vehicle_link}: the relay did not answer for {timeout:.0f} s"
        try:
            if self._control.poll(timeout):
                reply = self._control.recv()
        except (EOFError, OSError):
            reply = f"{self._vehicle_link}: the relay has ended"
        if isinstance(reply, str):
            raise LinkError(reply, link=self._vehicle_link)
        return reply

    def _stop(self) -> None:
        assert self._control is not None
        assert self._process is not None
        self._control.close()
        self._process.join(STOP_TIMEOUT)
        if self._process.is_alive():  # it does not heed SIGTERM
            self._process.kill()
            self._process.join()
        self._process.close()


class _Traffic:
    """The relay inside its process: two links, the lossy link, and the programs from which data was
    received."""

    def __init__(self, vehicle_link: str, listeners: Sequence[int]) -> None:
        self._far = create_link(vehicle_link)
        self._near = UdpIn(parse_link("udpin:127.0.0.1:0"))
        self._vehicle = RealVehicle(is_stream=self._far.is_stream)
        self._air = _air_of(self._vehicle, CLEAN)
        self._listeners: list[Peer] = [("127.0.0.1", port) for port in listeners]
        self._programs: dict[Peer, float] = {}
        self._arrived: list[bytes] = []
        self._wake = anyio.Event()

    async def run(self, control: Connection) -> None:
        """Pass on until the control connection is closed."""
        await self._far.open()
        await self._near.open()
        assert self._near.address is not None
        async with anyio.create_task_group() as tasks:
            token = anyio.lowlevel.current_token()

            def obey() -> None:
                """Take changes of the conditions, in a thread; the end of the connection ends the relay."""
                try:
                    while True:
                        control.send(anyio.from_thread.run_sync(self._change, control.recv(), token=token))
                except (EOFError, OSError):
                    anyio.from_thread.run_sync(tasks.cancel_scope.cancel, token=token)

            tasks.start_soon(self._read_far)
            tasks.start_soon(self._read_near)
            tasks.start_soon(self._pass_on)
            threading.Thread(target=obey, daemon=True).start()
            control.send(self._near.address[1])
        await self._near.close()
        await self._far.close()

    def _change(self, conditions: Conditions | None) -> float | None:
        """Put other conditions into force, if any; when a program first requested the table."""
        old, requested_at = self._air, self._vehicle.first_request_at
        if conditions is not None:
            self._vehicle.outgoing += old.uplink.deliver(math.inf)
            self._arrived += old.downlink.deliver(math.inf)
            self._vehicle.change(conditions)
            self._air = _air_of(self._vehicle, conditions)
            self._wake.set()
        return requested_at

    async def _read_far(self) -> None:
        while True:
            try:
                for peer, data in await self._far.receive():
                    self._vehicle.take_data(data, peer, anyio.current_time())
            except LinkError:
                if not self._far.reconnects:
                    raise
                await anyio.sleep(REOPEN_PAUSE)
                with suppress(LinkError):  # the vehicle is still disconnected
                    await self._far.open()
            self._wake.set()

    async def _read_near(self) -> None:
        while True:
            for peer, data in await self._near.receive():
                now = anyio.current_time()
                if peer not in self._listeners:
                    self._programs[peer] = now
                self._vehicle.take_request(data, now)
                self._air.receive(data, now)
            self._wake.set()

    async def _pass_on(self) -> None:
        while True:
            self._wake = anyio.Event()
            now = anyio.current_time()
            self._air.tick(now)
            outgoing, self._vehicle.outgoing[:] = self._vehicle.outgoing[:], []
            for data in outgoing:
                with suppress(LinkError):  # the reader sees it too, and opens the link again
                    await self._far.send(data, None)
            for peer in [peer for peer, at in self._programs.items() if at + PROGRAM_TIMEOUT < now]:
                del self._programs[peer]
            arrived, self._arrived[:] = [*self._arrived, *self._air.data_to_send()], []
            for data in arrived:
                for peer in (*self._listeners, *self._programs):
                    await self._near.send(data, peer)
            due = self._air.next_deadline()
            sleep = None if due is None else max(due - anyio.current_time(), SHORTEST_SLEEP)
            with anyio.move_on_after(sleep):
                await self._wake.wait()


def _air_of(vehicle: RealVehicle, conditions: Conditions) -> Air:
    return Air.symmetric(
        [vehicle],
        loss=conditions.loss,
        delay=conditions.round_trip / 2,
        rate=conditions.rate,
        seed=conditions.seed,
    )


def _message_id(datagram: bytes) -> int | None:
    """Return the message id of the first frame in a datagram."""
    if datagram[:1] == b"\xfd" and len(datagram) >= 10:
        return int.from_bytes(datagram[7:10], "little")
    return datagram[5] if datagram[:1] == b"\xfe" and len(datagram) >= 6 else None


def _run(vehicle_link: str, listeners: Sequence[int], control: Connection) -> None:
    """Be the relay, in a process of its own.

    Ctrl-C and the end of a terminal reach every process in it; the program that started this one still needs
    its vehicle then, to put back what it has changed. The relay ends with its control connection.
    """
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    try:
        anyio.run(_Traffic(vehicle_link, listeners).run, control)
    except* LinkError as group:
        with suppress(OSError):  # no program listens any more
            control.send("; ".join(str(error) for error in group.exceptions))
    finally:
        control.close()
