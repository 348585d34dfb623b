"""Writer of telemetry logs: a vehicle, ground stations, and files that they read over MAVFTP."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Self

from paramclient.errors import FileErrorCode
from paramclient.links.tlog import packed_time
from paramclient.model.values import Encoding, ParamType, encode_value
from paramclient.protocol import wire
from paramclient.protocol.ftp.packets import Opcode, Packet
from tests.simulation import param_value

NOW = 1_700_000_000.0
UID = "00000000deadbeef"
KEY = f"uid:{UID}"


class Log:
    """Writes a log of a vehicle with a table of INT32, and of a ground station.

    Attributes:
        at: the time of the next frame.
    """

    def __init__(self, at: float = NOW) -> None:
        self.at = at
        self.values: dict[str, int] = {}
        self.data = b""

    def say(self, *messages: wire.Message, system: int = 1, component: int = 1) -> Self:
        for message in messages:
            self.data += packed_time(self.at) + wire.encode(
                message, system=system, component=component, sequence=0
            )
        return self

    def beat(self) -> Self:
        return self.say(wire.Heartbeat(2, wire.MAV_AUTOPILOT_GENERIC, system_status=4))

    def identify(self) -> Self:
        return self.say(wire.AutopilotVersion(0, uid=0xDEADBEEF, flight_sw_version=7))

    def wait(self, seconds: float) -> Self:
        self.at += seconds
        return self

    def list(self, **values: int) -> Self:
        self.values |= values
        for index, name in enumerate(self.values):
            self.report(name, index)
        return self

    def report(self, name: str, index: int = 65535, **values: int) -> Self:
        self.values |= values
        count = len(self.values)
        kind = ParamType.INT32
        return self.say(param_value(name, self.values[name], index=index, count=count, kind=kind))

    def change(self, name: str, value: int) -> Self:
        return self.report(name, **{name: value})

    def set(self, name: str, value: int) -> Self:
        raw = encode_value(value, ParamType.INT32, Encoding.BYTEWISE)
        self.say(wire.ParamSetMessage(1, 1, name, raw, ParamType.INT32), system=255, component=190)
        return self.change(name, value)

    def write(self, path: Path) -> Path:
        path.write_bytes(self.data)
        return path


STATION = (255, 230)
"""System and component id of MAVProxy."""
BLOCK = 239


class FileLog(Log):
    """Writes a log of an ArduPilot vehicle, in which ground stations read files.

    Attributes:
        sequence: of the next request of any station.
    """

    def __init__(self, at: float = NOW) -> None:
        super().__init__(at)
        self.sequence = 0

    def beat(self, component: int = 1) -> Self:
        self.say(wire.Heartbeat(2, wire.MAV_AUTOPILOT_ARDUPILOTMEGA, system_status=4), component=component)
        return self

    def ask(self, opcode: int, *, session: int, station: tuple[int, int] = STATION, **fields: object) -> int:
        """Add a request; return its sequence number."""
        packet = Packet(self.sequence, session, opcode, **fields)  # type: ignore[arg-type]  # any
        self.say(wire.FileTransfer(0, 1, 1, packet.pack()), system=station[0], component=station[1])
        self.sequence = (self.sequence + 1) & 0xFFFF
        return packet.sequence

    def reply(
        self, to: int, requested: int, *, session: int, station: tuple[int, int] = STATION, **fields: object
    ) -> Self:
        """Add a response to the request with this sequence number, or to one of a burst after it."""
        fields = {"opcode": Opcode.ACK} | fields
        packet = Packet((to + 1) & 0xFFFF, session, requested=requested, **fields)  # type: ignore[arg-type]  # any
        self.say(wire.FileTransfer(0, *station, packet.pack()))
        return self

    def open(
        self,
        path: str = "@PARAM/param.pck?withdefaults=1",
        *,
        session: int = 11,
        station: tuple[int, int] = STATION,
    ) -> Self:
        """Add the open request and its response, with an estimated size."""
        to = self.ask(Opcode.OPEN_FILE_RO, session=session, station=station, data=path.encode())
        size = (16_284).to_bytes(4, "little")
        return self.reply(to, Opcode.OPEN_FILE_RO, session=session, station=station, data=size)

    def burst(
        self,
        data: bytes,
        blocks: Iterable[int] | None = None,
        *,
        session: int = 11,
        station: tuple[int, int] = STATION,
        is_ended: bool = True,
        gap: float = 0.006,
    ) -> Self:
        """Add a burst of the blocks with these numbers, None for all, with the NAK at the end of the file."""
        to = self.ask(Opcode.BURST_READ_FILE, session=session, station=station, size=BLOCK)
        count = -(-len(data) // BLOCK)
        for number in range(count) if blocks is None else blocks:
            at = number * BLOCK
            self.wait(gap).reply_block(to + number, Opcode.BURST_READ_FILE, data, at, session, station)
        if is_ended:
            self.end(to + count, len(data), session=session, station=station)
        return self

    def read(self, data: bytes, at: int, *, session: int = 11, station: tuple[int, int] = STATION) -> Self:
        """Add a single read of one block."""
        to = self.ask(Opcode.READ_FILE, session=session, station=station, size=BLOCK, offset=at)
        return self.reply_block(to, Opcode.READ_FILE, data, at, session, station)

    def reply_block(
        self, to: int, requested: int, data: bytes, at: int, session: int, station: tuple[int, int]
    ) -> Self:
        block = data[at : at + BLOCK]
        return self.reply(to, requested, session=session, station=station, data=block, offset=at)

    def end(self, to: int, at: int, *, session: int = 11, station: tuple[int, int] = STATION) -> Self:
        """Add the NAK of a burst at the end of the file."""
        data = bytes([FileErrorCode.EOF])
        return self.reply(
            to,
            Opcode.BURST_READ_FILE,
            session=session,
            station=station,
            opcode=Opcode.NAK,
            data=data,
            offset=at,
        )

    def close(self, *, session: int = 11, station: tuple[int, int] = STATION) -> Self:
        """Add the end of a session."""
        to = self.ask(Opcode.TERMINATE_SESSION, session=session, station=station)
        return self.reply(to, Opcode.TERMINATE_SESSION, session=session, station=station)

    def value(self, name: str, value: float, *, count: int, kind: ParamType = ParamType.INT16) -> Self:
        """Add an unsolicited PARAM_VALUE of ArduPilot."""
        raw = encode_value(value, kind, Encoding.C_CAST)
        self.say(wire.ParamValue(name, raw, kind, count, wire.NO_INDEX))
        return self

    def made_up(self, values: Sequence[tuple[str, float]]) -> Self:
        """Add MAVProxy's record of a file that it has read: not from the vehicle, all REAL32, at one time."""
        for index, (name, value) in enumerate(values):
            raw = encode_value(float(value), ParamType.REAL32, Encoding.C_CAST)
            self.say(wire.ParamValue(name, raw, ParamType.REAL32, len(values), index), component=190)
        return self
