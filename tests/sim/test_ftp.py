"""MAVFTP of the simulated vehicles, one request at a time, and its unsupported operations."""

from __future__ import annotations

from paramclient.errors import FileErrorCode
from paramclient.model.values import ParamType
from paramclient.protocol import param_pck
from paramclient.protocol.ftp import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.param_pck import PackedParam
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, Vehicle
from paramclient.wire import messages
from tests.ground_station import Station

PARAMS = b"@PARAM/param.pck"


class Pilot(Station):
    """A ground station that sends one request after the other, each with its own sequence number."""

    def __init__(self, vehicle: Vehicle, *, component: int = 190) -> None:
        super().__init__(vehicle)
        self.vehicle = vehicle
        self.component = component
        self.sequence = 0

    def request(self, packet: Packet) -> None:
        message = messages.FileTransfer(0, 1, 1, packet.pack())
        self.send_bytes(messages.encode(message, system=255, component=self.component, sequence=0))

    def listen(self, seconds: float) -> list[Packet]:
        """Return the responses within this time."""
        answers = self.wait(seconds).receive(messages.FileTransfer)
        assert all((each.target_system, each.target_component) == (255, self.component) for each in answers)
        return [Packet.unpack(each.payload) for each in answers]

    def call(
        self, opcode: Opcode, data: bytes = b"", *, session: int = 3, offset: int = 0, size: int = 0
    ) -> Packet:
        """Send one request; return its only response."""
        self.sequence += 2
        self.request(Packet(self.sequence, session, opcode, data, size, offset))
        (answer,) = self.listen(0.1)
        assert answer.sequence == self.sequence + 1
        assert answer.requested == opcode
        return answer

    def burst(self, *, session: int = 3, offset: int = 0, size: int = DATA_SIZE_MAX) -> list[Packet]:
        self.sequence += 2
        self.request(Packet(self.sequence, session, Opcode.BURST_READ_FILE, size=size, offset=offset))
        self.sequence += 10_000
        return self.listen(10.0)


def refusal(answer: Packet) -> tuple[int, ...]:
    assert answer.opcode == Opcode.NAK
    return tuple(answer.data)


def packed(vehicle: Vehicle) -> list[PackedParam]:
    return [PackedParam(each.name, ParamType(each.type), each.bits, None) for each in vehicle.params.values()]


# Sessions


def test_px4_closes_a_session_after_11_s() -> None:
    pilot = Pilot(PX4Vehicle())
    pilot.vehicle.files["a"] = b"a"
    pilot.call(Opcode.OPEN_FILE_RO, b"a")
    pilot.listen(10.5)
    assert pilot.call(Opcode.READ_FILE, session=0, size=1).data == b"a"
    pilot.listen(11.0)
    assert refusal(pilot.call(Opcode.READ_FILE, session=0, size=1)) == (FileErrorCode.INVALID_SESSION,)
    assert pilot.call(Opcode.OPEN_FILE_RO, b"a").opcode == Opcode.ACK


def test_px4_assigns_session_numbers() -> None:
    pilot = Pilot(PX4Vehicle(ftp=True))
    pilot.vehicle.files["a"] = b"a"
    assert pilot.call(Opcode.OPEN_FILE_RO, b"a", session=3).session == 0
    assert refusal(pilot.call(Opcode.OPEN_FILE_RO, b"a", session=4)) == (FileErrorCode.NO_SESSIONS_AVAILABLE,)
    assert refusal(pilot.call(Opcode.TERMINATE_SESSION, session=3)) == (FileErrorCode.INVALID_SESSION,)
    assert pilot.call(Opcode.TERMINATE_SESSION, session=0).opcode == Opcode.ACK
    pilot.call(Opcode.OPEN_FILE_RO, b"a")
    assert pilot.call(Opcode.RESET_SESSIONS, session=9).opcode == Opcode.ACK
    assert pilot.call(Opcode.OPEN_FILE_RO, b"a").opcode == Opcode.ACK


# Pace


def test_a_repeated_request_gets_the_same_response() -> None:
    pilot = Pilot(ArduPilotVehicle())
    pilot.vehicle.files["a"] = b"a"
    request = Packet(7, 3, Opcode.OPEN_FILE_RO, b"a")
    pilot.request(request)
    pilot.request(request)
    first, second = pilot.listen(0.1)
    assert first == second
    assert first.opcode == Opcode.ACK
    other = Pilot(pilot.vehicle, component=191)
    other.now = pilot.now
    other.request(request)
    (answer,) = other.listen(0.1)
    assert refusal(answer) == (FileErrorCode.FAIL,)


def test_px4_ends_a_burst_after_168_blocks() -> None:
    pilot = Pilot(PX4Vehicle())
    pilot.vehicle.files["a"] = bytes(50_000)
    pilot.call(Opcode.OPEN_FILE_RO, b"a")
    blocks = pilot.burst(session=0, size=100)
    assert [each.burst_complete for each in blocks] == [False] * 167 + [True]
    assert {len(each.data) for each in blocks} == {239}
    rest = pilot.burst(session=0, offset=168 * 239)
    assert sum(len(each.data) for each in (*blocks, *rest) if each.opcode == Opcode.ACK) == 50_000


# Switches


def test_newer_px4_has_a_param_pck() -> None:
    old, new = Pilot(PX4Vehicle()), Pilot(PX4Vehicle(ftp=True))
    assert refusal(old.call(Opcode.OPEN_FILE_RO, PARAMS)) == (FileErrorCode.FILE_NOT_FOUND,)
    assert new.call(Opcode.OPEN_FILE_RO, PARAMS).opcode == Opcode.ACK
    data = b"".join(each.data for each in new.burst(session=0) if each.opcode == Opcode.ACK)
    assert list(param_pck.decode(data).entries) == packed(new.vehicle)
