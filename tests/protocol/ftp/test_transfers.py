"""MAVFTP as a client: against a server that follows a script, and whole transfers over bad links."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import (
    ATTEMPTS_MAX,
    ATTEMPTS_MIN,
    BUSY_TIMEOUT,
    OPENS_MAX,
    REOPENS_MAX,
    SESSION_IDLE_TIME,
    TIMEOUT_MAX,
    UNANSWERED_ATTEMPTS_MAX,
    RetryPolicy,
)

from paramclient.errors import FileErrorCode, FileTransferError, LinkError, NoReply, UsageError
from paramclient.model.px4_hash import crc32_px4
from paramclient.model.values import ParamType
from paramclient.protocol.ftp import (
    DATA_SIZE_MAX,
    DirectoryEntry,
    FileRead,
    FileTransfers,
    FileWrite,
    Opcode,
    Packet,
    param_pck,
)
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, Vehicle
from paramclient.sim.ftp import IDLE_LIMIT
from paramclient.wire import frames, messages
from paramclient.wire.messages import FileTransfer, Message
from tests.recordings import DATA
from tests.simulation import is_so

PARAMS = "@PARAM/param.pck"
WITH_DEFAULTS = (DATA / "ardupilot_param_withdefaults.pck").read_bytes()
OWN = (255, 190)

Result = TypeVar("Result")


class Desk:
    """The transfers of component 1/1, with everything they send, and a server that a test plays."""

    def __init__(self, *, keeps_session: bool = True) -> None:
        self.now = 5.0
        self.retry = RetryPolicy()
        self.round_trip = self.retry.round_trip
        self.sent: list[Packet] = []
        autopilot = messages.MAV_AUTOPILOT_ARDUPILOTMEGA if keeps_session else None
        self.context = Context((1, 1), self._send, OWN, self.retry, autopilot=autopilot)
        self.transfers = FileTransfers(self.context)

    def _send(self, message: Message) -> None:
        assert isinstance(message, FileTransfer)
        assert (message.target_network, message.target_system, message.target_component) == (0, 1, 1)
        self.sent.append(Packet.unpack(message.payload.ljust(251, b"\0")))

    def lose_some(self) -> None:
        """Let the link count as one that loses a quarter of the requests, with a round trip of 1 ms."""
        self.retry.answered(0.0, 0.001, 1)
        self.retry.timed_out(1)
        self.retry.answered(0.0, 0.001, 1)

    def take(self) -> list[Packet]:
        sent, self.sent = self.sent, []
        return sent

    def next(self, opcode: Opcode) -> Packet:
        """The only thing that was sent, which is a request of this kind."""
        (packet,) = self.take()
        assert packet.opcode == opcode
        return packet

    def first(self, opcode: Opcode) -> Packet:
        """The first thing that was sent, before copies of it and others."""
        packet = self.take()[0]
        assert packet.opcode == opcode
        return packet

    def opening(self) -> Packet:
        """The request to open a file, beside copies of it and the burst that need not wait for it."""
        first, *others = self.take()
        assert first.opcode == Opcode.OPEN_FILE_RO
        bursts = [packet for packet in others if packet != first]
        assert [packet.opcode for packet in bursts] in ([], [Opcode.BURST_READ_FILE])
        return first

    def hear(self, packet: Packet, *, to: tuple[int, int] = OWN) -> None:
        self.transfers.receive(FileTransfer(0, *to, packet.pack().ljust(251, b"\0")), self.now)

    def answer(
        self,
        request: Packet,
        data: bytes = b"",
        *,
        code: int | None = None,
        session: int | None = None,
        offset: int = 0,
        nth: int = 1,
        complete: bool = False,
    ) -> None:
        """Answer a request; of a burst, with its n-th block."""
        opcode = Opcode.ACK if code is None else Opcode.NAK
        content = data if code is None else bytes((code,)) + data
        self.hear(
            Packet(
                (request.sequence + nth) & 0xFFFF,
                request.session if session is None else session,
                opcode,
                content,
                offset=offset,
                requested=request.opcode,
                burst_complete=complete,
            )
        )

    def pass_time(self, seconds: float = math.inf) -> None:
        """Go from deadline to deadline, so long or until nothing is left to do."""
        end = self.now + seconds
        for _ in range(100_000):
            deadline = self.transfers.next_deadline()
            if deadline > end or deadline == math.inf:
                if end < math.inf:
                    self.now = end
                return
            self.now = max(deadline, self.now)
            self.transfers.tick(self.now)
        raise AssertionError("it does not end")

    def opened(self, path: str = "a.txt", *, size: int = 1000, **options: Any) -> tuple[FileRead, Packet]:
        """A read whose file is open in session 9, and the request for its burst."""
        read = self.transfers.read(path, self.now, **options)
        request = self.first(Opcode.OPEN_FILE_RO)
        self.answer(request, size.to_bytes(4, "little"), session=9)
        return read, self.first(Opcode.BURST_READ_FILE)

    def closed(self, session: int = 9) -> None:
        """The session is to be closed, and is; what else was sent may be looked at afterwards."""
        ends = [packet for packet in self.sent if packet.opcode == Opcode.TERMINATE_SESSION]
        self.sent = [packet for packet in self.sent if packet.opcode != Opcode.TERMINATE_SESSION]
        assert len(set(ends)) == 1
        assert ends[0].session == session
        assert is_so(not self.transfers.is_idle)
        self.answer(ends[0])
        assert self.transfers.is_idle
        assert self.transfers.next_deadline() == math.inf


def error_of(job: Operation[Any]) -> FileTransferError:
    assert isinstance(job.error, FileTransferError)
    return job.error


class TestReading:
    def test_open_burst_end_close(self) -> None:
        desk = Desk()
        read = desk.transfers.read("a.txt", desk.now)
        request = desk.opening()
        assert request.data == b"a.txt"
        assert is_so(read.size is None)
        desk.answer(request, (300).to_bytes(4, "little"), session=9)
        assert read.size == 300
        burst = desk.next(Opcode.BURST_READ_FILE)
        assert (burst.session, burst.offset, burst.size) == (9, 0, DATA_SIZE_MAX)
        desk.answer(burst, b"a" * 239)
        assert read.received == 239
        desk.answer(burst, b"b" * 61, offset=239, nth=2)
        assert is_so(not read.done)
        desk.answer(burst, code=FileErrorCode.EOF, offset=300, nth=3)
        desk.closed()
        assert read.done
        assert read.result == b"a" * 239 + b"b" * 61

    def test_an_empty_file(self) -> None:
        desk = Desk()
        read, burst = desk.opened(size=0)
        desk.answer(burst, code=FileErrorCode.EOF)
        desk.closed()
        assert read.result == b""

    def test_a_gap_is_read_in_the_same_size_while_the_burst_goes_on(self) -> None:
        desk = Desk()
        read, burst = desk.opened(read_size=100)
        desk.answer(burst, b"a" * 100)
        desk.answer(burst, b"c" * 100, offset=200, nth=3)
        gap = desk.next(Opcode.READ_FILE)
        assert (gap.session, gap.offset, gap.size) == (9, 100, 100)
        desk.answer(burst, code=FileErrorCode.EOF, offset=300, nth=4)
        assert is_so(not read.done)
        desk.answer(gap, b"b" * 100, offset=100)
        desk.closed()
        assert read.result == b"a" * 100 + b"b" * 100 + b"c" * 100

    def test_a_burst_that_falls_silent_in_the_middle_is_requested_again(self) -> None:
        desk = Desk()
        read, burst = desk.opened(size=50_000)
        for block in range(10):
            desk.now += 0.01
            desk.answer(burst, bytes((block,)) * 239, offset=239 * block, nth=block + 1)
        desk.pass_time(0.1)
        probe = desk.next(Opcode.READ_FILE)
        assert probe.offset == 2390
        desk.answer(probe, b"x" * 239, offset=2390)
        second = next(packet for packet in desk.take() if packet.opcode == Opcode.BURST_READ_FILE)
        assert second.offset == 2629
        desk.answer(second, code=FileErrorCode.EOF, offset=2629)
        desk.closed()
        assert read.result is not None
        assert len(read.result) == 2629

    def test_without_bursts_everything_is_read_singly(self) -> None:
        desk = Desk()
        read, burst = desk.opened(size=600)
        desk.answer(burst, code=FileErrorCode.UNKNOWN_COMMAND)
        content = bytes(range(200)) * 3
        for _ in range(50):
            for packet in desk.take():
                if packet.opcode == Opcode.READ_FILE:
                    data = content[packet.offset : packet.offset + packet.size]
                    desk.answer(packet, data, code=None if data else 6, offset=packet.offset)
                elif packet.opcode == Opcode.TERMINATE_SESSION:
                    desk.answer(packet)
            desk.pass_time(0.01)
        assert read.result == content

    def test_a_file_that_is_too_long_is_not_taken(self) -> None:
        desk = Desk()
        read, burst = desk.opened(limit=300)
        desk.answer(burst, b"a" * 239)
        desk.answer(burst, b"b" * 239, offset=239, nth=2)
        desk.closed()
        assert "longer than 300 bytes" in str(error_of(read))


class TestWhatIsNotForUs:
    def test_blocks_of_another_session_and_of_an_earlier_file(self) -> None:
        desk = Desk()
        first, old = desk.opened("old")
        desk.answer(old, code=FileErrorCode.EOF)
        desk.closed()
        assert first.done
        read, burst = desk.opened("new")
        desk.answer(old, b"old" * 50)
        desk.answer(burst, b"other" * 10, session=8)
        desk.answer(burst, b"new" * 50)
        desk.answer(burst, code=FileErrorCode.EOF, offset=150, nth=2)
        desk.closed()
        assert read.result == b"new" * 50


class TestRefusals:
    @pytest.mark.parametrize(
        ("code", "errno", "words"),
        [
            (FileErrorCode.FILE_NOT_FOUND, b"", "1/1 does not open a.txt: file not found"),
            (FileErrorCode.FAIL_ERRNO, b"\x02", "1/1 does not open a.txt: fail errno 2"),
            (FileErrorCode.FILE_PROTECTED, b"", "1/1 does not open a.txt: file protected"),
            (77, b"", "1/1 does not open a.txt: error code 77"),
        ],
    )
    def test_a_file_that_cannot_be_opened(self, code: int, errno: bytes, words: str) -> None:
        desk = Desk()
        read = desk.transfers.read("a.txt", desk.now)
        desk.answer(desk.opening(), errno, code=code)
        error = error_of(read)
        assert str(error) == words
        assert (error.path, error.code, error.system, error.component) == ("a.txt", code, 1, 1)
        assert error.is_not_found == (code in (10, 2))
        assert desk.take() == []
        assert desk.transfers.is_idle

    def test_a_session_that_is_lost_on_board_is_opened_again(self) -> None:
        desk = Desk()
        read, burst = desk.opened()
        desk.answer(burst, b"old" * 50)
        desk.answer(burst, code=FileErrorCode.INVALID_SESSION, nth=2)
        assert not read.done
        assert read.received == 0
        request = desk.opening()
        desk.answer(request, bytes(4), session=9)
        again = desk.next(Opcode.BURST_READ_FILE)
        assert again.offset == 0
        desk.answer(again, b"new" * 50)
        desk.answer(again, code=FileErrorCode.EOF, offset=150, nth=2)
        desk.closed()
        assert read.result == b"new" * 50

    def test_but_not_for_ever(self) -> None:
        desk = Desk()
        read, burst = desk.opened()
        for _ in range(OPENS_MAX - 1):
            desk.answer(burst, code=FileErrorCode.FILE_NOT_FOUND)
            desk.answer(desk.opening(), bytes(4), session=9)
            burst = desk.next(Opcode.BURST_READ_FILE)
        desk.answer(burst, code=FileErrorCode.FILE_NOT_FOUND)
        desk.closed()
        assert error_of(read).code == FileErrorCode.FILE_NOT_FOUND

    @pytest.mark.parametrize("code", [FileErrorCode.INVALID_SESSION, FileErrorCode.NO_SESSIONS_AVAILABLE])
    def test_while_another_station_has_a_session_nothing_is_sent(self, code: int) -> None:
        desk = Desk()
        began = desk.now
        read = desk.transfers.read("a", desk.now)
        request = desk.opening()
        assert is_so(read.blocked_until is None)
        while not read.done:
            desk.answer(request, code=code)
            if not read.done:
                assert read.blocked_until == pytest.approx(desk.now + SESSION_IDLE_TIME)
                desk.pass_time(SESSION_IDLE_TIME - 0.01)
                assert desk.take() == []
                desk.pass_time(0.02)
                request = desk.opening()
        assert error_of(read).code == code
        assert BUSY_TIMEOUT <= desk.now - began <= BUSY_TIMEOUT + 2 * SESSION_IDLE_TIME
        assert desk.transfers.is_idle


class TestSilence:
    def test_an_open_is_repeated_with_the_same_number_and_given_up(self) -> None:
        desk = Desk()
        read = desk.transfers.read("a", desk.now)
        desk.pass_time()
        assert isinstance(read.error, NoReply)
        assert read.error.awaited == "a of 1/1"
        opens = [packet for packet in desk.take() if packet.opcode == Opcode.OPEN_FILE_RO]
        assert len(set(opens)) == 1
        assert ATTEMPTS_MIN <= read.error.attempts <= ATTEMPTS_MAX
        assert desk.transfers.is_idle

    def test_a_silent_server_gets_one_last_request_to_close(self) -> None:
        desk = Desk()
        desk.transfers.read("a", desk.now)
        desk.pass_time()
        last = [packet for packet in desk.take() if packet.opcode != Opcode.OPEN_FILE_RO]
        assert [packet.opcode for packet in last] == [
            Opcode.BURST_READ_FILE,
            Opcode.TERMINATE_SESSION,
            Opcode.TERMINATE_SESSION,
        ]

    def test_the_end_of_a_link_ends_everything(self) -> None:
        desk = Desk()
        read, _ = desk.opened()
        waiting = desk.transfers.list("b", desk.now)
        gone = LinkError("gone", link="x")
        desk.transfers.fail_all(gone, desk.now)
        assert read.error is gone
        assert waiting.error is gone
        desk.closed()
        assert read.error is gone


class TestNoServer:
    """Many vehicles have none, and say nothing on request."""

    @staticmethod
    def desk_on_a_bad_link() -> Desk:
        """The round trip is 0.2 s; since it was measured, most requests were lost."""
        desk = Desk()
        desk.retry.answered(0.0, 0.2, 1)
        for _ in range(60):
            desk.retry.timed_out(1)
        assert desk.retry.tries == ATTEMPTS_MAX
        assert desk.retry.timeout > 1.0
        return desk

    def test_a_missing_server_is_reported_in_a_bounded_time_at_any_loss(self) -> None:
        desk = self.desk_on_a_bad_link()
        began = desk.now
        read = desk.transfers.read("a.txt", desk.now)
        desk.pass_time()
        assert isinstance(read.error, NoReply)
        assert read.error.attempts == UNANSWERED_ATTEMPTS_MAX
        assert read.ended_at - began <= UNANSWERED_ATTEMPTS_MAX * TIMEOUT_MAX
        assert desk.transfers.is_idle


class TestTurns:
    def test_one_after_the_other(self) -> None:
        desk = Desk()
        first, burst = desk.opened("a")
        second = desk.transfers.read("b", desk.now)
        third = desk.transfers.checksum("c", desk.now)
        assert desk.take() == []
        desk.answer(burst, code=FileErrorCode.EOF)
        assert is_so(not first.done)
        desk.answer(desk.next(Opcode.TERMINATE_SESSION))
        assert first.done
        request = desk.first(Opcode.OPEN_FILE_RO)
        assert request.data == b"b"
        desk.answer(request, code=FileErrorCode.FILE_NOT_FOUND)
        assert second.done
        desk.answer(desk.next(Opcode.CALC_FILE_CRC32), b"\1\2\3\4")
        assert third.result == 0x04030201
        assert desk.transfers.is_idle

    def test_a_released_transfer_in_progress_is_closed(self) -> None:
        desk = Desk()
        read, burst = desk.opened("a")
        desk.transfers.release(read, desk.now)
        desk.answer(burst, b"late")
        assert not read.done
        desk.closed()

    def test_one_whose_open_is_not_answered_yet_is_closed_too(self) -> None:
        desk = Desk()
        read = desk.transfers.read("a", desk.now)
        request = desk.opening()
        desk.transfers.release(read, desk.now)
        assert {(packet.opcode, packet.session) for packet in desk.take()} == {
            (Opcode.TERMINATE_SESSION, request.session)
        }
        desk.answer(request, bytes(4), session=3)
        desk.closed(session=3)
        assert not read.done


class TestHaste:
    def known_link(self) -> Desk:
        desk = Desk()
        desk.retry.answered(0.0, 0.1, 1)
        return desk

    def test_a_lost_response_to_the_open_restarts_the_read_after_the_burst(self) -> None:
        """The file of the burst is unknown: a failed open has no response either."""
        desk = self.known_link()
        read = desk.transfers.read("a", desk.now)
        first, _, early = desk.take()
        desk.answer(early, b"x" * 239)
        assert desk.take() == []
        desk.answer(early, b"x" * 239, offset=239, nth=2)
        *resets, again, _, burst = desk.take()
        assert {packet.opcode for packet in resets} == {Opcode.TERMINATE_SESSION}, (
            "a reset closes others' too"
        )
        assert again.opcode == Opcode.OPEN_FILE_RO
        assert again.sequence != first.sequence
        assert {packet.session for packet in (*resets, again, burst)} == {first.session}
        desk.answer(early, b"x" * 239, offset=478, nth=3)
        desk.answer(early, b"x" * 239, offset=717, nth=4)
        assert desk.take() == []
        desk.answer(again, bytes(4))
        desk.answer(early, b"y" * 239, nth=5)
        desk.answer(burst, b"abc")
        desk.answer(burst, code=FileErrorCode.EOF, offset=3, nth=2)
        desk.closed(first.session)
        assert read.result == b"abc"

    def test_but_not_for_ever(self) -> None:
        desk = self.known_link()
        desk.transfers.read("a", desk.now)
        opened = 1
        for _ in range(20):
            sent = desk.take()
            if sent:
                opened += 1
                burst = sent[-1]
            desk.answer(burst, b"x" * 239)
        assert opened == 2 + REOPENS_MAX


class TestWriting:
    def test_create_write_close(self) -> None:
        desk = Desk()
        write = desk.transfers.write("a", b"abcde", desk.now, write_size=3)
        request = desk.next(Opcode.CREATE_FILE)
        assert request.data == b"a"
        desk.answer(request, session=9)
        first = desk.next(Opcode.WRITE_FILE)
        assert (first.data, first.offset, first.session) == (b"abc", 0, 9)
        desk.answer(first)
        assert isinstance(write, FileWrite)
        assert write.written == 3
        second = desk.next(Opcode.WRITE_FILE)
        assert (second.data, second.offset) == (b"de", 3)
        desk.answer(second)
        assert is_so(not write.done)
        desk.closed()
        assert write.done
        assert write.error is None

    def test_a_file_that_is_refused_as_a_whole(self) -> None:
        desk = Desk()
        write = desk.transfers.write("a", b"", desk.now)
        desk.answer(desk.next(Opcode.CREATE_FILE), session=9)
        desk.answer(desk.next(Opcode.TERMINATE_SESSION), b"\x16", code=FileErrorCode.FAIL_ERRNO)
        assert "does not take" in str(error_of(write))
        assert desk.transfers.is_idle


class TestListing:
    def test_in_pieces(self) -> None:
        desk = Desk()
        listing = desk.transfers.list("/logs", desk.now)
        first = desk.next(Opcode.LIST_DIRECTORY)
        assert (first.data, first.offset) == (b"/logs", 0)
        desk.answer(first, "F1 ä.bin\t12\0Dold\0S\0".encode())
        second = desk.next(Opcode.LIST_DIRECTORY)
        assert second.offset == 3
        desk.answer(second, b"Fodd\0F\t\0")
        desk.answer(desk.next(Opcode.LIST_DIRECTORY), code=FileErrorCode.EOF)
        assert listing.result == (
            DirectoryEntry("1 ä.bin", 12),
            DirectoryEntry("old", None),
            DirectoryEntry("odd", 0),
            DirectoryEntry("\t", 0),
        )
        assert [entry.is_directory for entry in listing.result] == [False, True, False, False]

    def test_a_checksum_that_is_refused(self) -> None:
        desk = Desk()
        checksum = desk.transfers.checksum("x", desk.now)
        desk.answer(desk.next(Opcode.CALC_FILE_CRC32), code=FileErrorCode.UNKNOWN_COMMAND)
        assert "gives no checksum of x: unknown command" in str(error_of(checksum))


@pytest.mark.parametrize("path", ["", "a\0b", "x" * 240])
def test_paths_that_cannot_be(path: str) -> None:
    with pytest.raises(UsageError, match="path of a file"):
        Desk().transfers.read(path, 0.0)


@pytest.mark.parametrize("size", [0, 240])
def test_sizes_that_cannot_be(size: int) -> None:
    desk = Desk()
    with pytest.raises(UsageError, match="1 to 239"):
        desk.transfers.read("a", 0.0, read_size=size)
    with pytest.raises(UsageError, match="1 to 239"):
        desk.transfers.write("a", b"", 0.0, write_size=size)
    assert desk.transfers.is_idle


packets = st.builds(
    Packet,
    st.integers(0, 8),
    st.sampled_from((0, 9)),
    st.sampled_from((*Opcode, 0, 77)),
    st.binary(max_size=10),
    st.integers(0, 255),
    st.sampled_from((0, 5, 239, 478, 0xFFFF_FFFF)),
    st.sampled_from((*Opcode, 0, 77)),
    st.booleans(),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(packets, max_size=60), st.sampled_from(("read", "list", "checksum", "write")))
def test_a_transfer_ends_whatever_packets_the_server_sends(junk: list[Packet], what: str) -> None:
    """Each number is counted from one of the last requests, so that much of this is taken for an answer."""
    desk = Desk()
    job: Operation[Any] = (
        desk.transfers.write("a", b"abc", desk.now)
        if what == "write"
        else getattr(desk.transfers, what)("a", desk.now)
    )
    sent = desk.take()
    for number, packet in enumerate(junk):
        sent = [*sent, *desk.take()][-4:]
        request = sent[number % len(sent)]
        requested = request.opcode if number % 3 else packet.requested
        sequence = (request.sequence + packet.sequence) & 0xFFFF
        desk.hear(packet._replace(sequence=sequence, requested=requested))
        desk.pass_time(0.02)
    desk.pass_time()
    assert job.done
    assert desk.transfers.is_idle


# Whole transfers


class Ground:
    """Transfers with one vehicle behind an air, in a time that passes as fast as it can."""

    def __init__(self, vehicle: Vehicle, *, round_trip: float | None = None, **faults: Any) -> None:
        self.vehicle = vehicle
        self.air = Air.symmetric([vehicle], **faults)
        self.overtakes = bool(faults.get("reorder"))
        self.now = 0.0
        self.retry = RetryPolicy()
        self.round_trip = self.retry.round_trip
        if round_trip is not None:
            self.retry.answered(0.0, round_trip, 1)
        self.requests = 0
        self._outbox: list[Message] = []
        self._framer = frames.Framer(messages.DECODED_IDS, stream=False)
        is_ardupilot = isinstance(vehicle, ArduPilotVehicle)
        autopilot = messages.MAV_AUTOPILOT_ARDUPILOTMEGA if is_ardupilot else None
        self.transfers = FileTransfers(
            Context((1, 1), self._outbox.append, OWN, self.retry, autopilot=autopilot)
        )
        self.air.tick(self.now)

    def exchange(self) -> None:
        for _ in range(3000):
            for data in self.air.data_to_send():
                for frame in self._framer.receive(data):
                    self.round_trip.received_at = self.now
                    message = messages.decode(frame)
                    if isinstance(message, FileTransfer):
                        self.transfers.receive(message, self.now)
            if self.transfers.next_deadline() <= self.now:
                self.transfers.tick(self.now)
            outgoing, self._outbox[:] = self._outbox[:], []
            for message in outgoing:
                self.requests += 1
                data = messages.encode(message, system=255, component=190, sequence=self.requests & 0xFF)
                self.air.receive(data, self.now)
            self.air.tick(self.now)
            if not outgoing and self._next() > self.now:
                return
        raise AssertionError(f"at {self.now} something is still due")

    def until(self, condition: Callable[[], bool], limit: float = 120.0) -> None:
        end = self.now + limit
        self.exchange()
        while not condition():
            self.now = self._next()
            assert self.now <= end, f"no result in {limit} s"
            self.air.tick(self.now)
            self.exchange()

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        self.until(lambda: self._next() > end, limit=seconds + 1)
        self.now = end

    def outcome(self, job: Operation[Result], limit: float = 120.0) -> Result | None:
        self.until(lambda: job.done, limit)
        if job.error is not None:
            raise job.error
        return job.result

    def read(self, path: str, limit: float = 120.0, **options: Any) -> bytes:
        result = self.outcome(self.transfers.read(path, self.now, **options), limit)
        assert result is not None
        return result

    def settle(self) -> None:
        """Everything is closed, and nothing more is requested.

        An open that was repeated may be overtaken by the close that followed: the server, which lives through
        that with every station, gives up what it has opened once more by itself.
        """
        self.until(lambda: self.transfers.is_idle)
        if not self.overtakes:
            assert self.vehicle.open_files == []
            return
        self.run(IDLE_LIMIT)
        self.vehicle.files["settled"] = b"whole"
        assert self.read("settled") == b"whole"

    def _next(self) -> float:
        deadline = self.air.next_deadline()
        return min(self.transfers.next_deadline(), math.inf if deadline is None else deadline)


def ardupilot(**options: Any) -> ArduPilotVehicle:
    return ArduPilotVehicle(live_period=0.0, **options)


faults = st.fixed_dictionaries(
    {
        "loss": st.sampled_from((0.0, 0.05, 0.2, 0.4)),
        "delay": st.sampled_from((0.0, 0.01, 0.05, 0.3)),
        "jitter": st.sampled_from((0.0, 0.02)),
        "duplicate": st.sampled_from((0.0, 0.1)),
        "reorder": st.sampled_from((0.0, 0.2)),
        "seed": st.integers(0, 10_000),
    }
)
thorough = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])


class TestOnTheAir:
    @thorough
    @given(faults, st.booleans(), st.sampled_from((None, 0.1)))
    def test_the_parameters_of_ardupilot(
        self, faults: dict[str, Any], with_defaults: bool, round_trip: float | None
    ) -> None:
        vehicle = ardupilot()
        ground = Ground(vehicle, round_trip=round_trip, **faults)
        content = ground.read(PARAMS + "?withdefaults=1" * with_defaults)
        if with_defaults:
            assert content == WITH_DEFAULTS
        table = {name: (param.type, param.bits) for name, param in vehicle.params.items()}
        assert {each.name: (each.type, each.bits) for each in param_pck.decode(content).entries} == table
        ground.settle()

    @thorough
    @given(faults, st.sampled_from((48, 110, 239)), st.sampled_from((None, 0.1)))
    def test_the_parameters_of_px4(self, faults: dict[str, Any], size: int, round_trip: float | None) -> None:
        vehicle = PX4Vehicle(ftp=True)
        ground = Ground(vehicle, round_trip=round_trip, **faults)
        content = ground.read(PARAMS, read_size=size)
        assert [each.bits for each in param_pck.decode(content).entries] == [
            param.bits for param in vehicle.params.values()
        ]
        ground.settle()

    @thorough
    @given(faults, st.integers(0, 3000), st.booleans())
    def test_files_of_any_length(self, faults: dict[str, Any], length: int, px4: bool) -> None:
        vehicle = PX4Vehicle() if px4 else ardupilot()
        content = bytes(number * 7 % 251 for number in range(length))
        vehicle.files["a"] = content
        ground = Ground(vehicle, **faults)
        assert ground.read("a") == content
        ground.settle()

    @pytest.mark.parametrize("job", ["list", "checksum"])
    def test_a_list_and_a_checksum_wait_for_the_session_of_another_station(self, job: str) -> None:
        vehicle = ardupilot()
        vehicle.files["d/log"] = b"a" * 1000
        ground = Ground(vehicle)
        opening = Packet(7, 99, Opcode.OPEN_FILE_RO, b"d/log")
        data = messages.encode(FileTransfer(0, 1, 1, opening.pack()), system=254, component=190, sequence=0)
        ground.air.receive(data, ground.now)
        ground.run(0.5)
        if job == "list":
            listed = ground.outcome(ground.transfers.list("d", ground.now))
            assert [entry.name for entry in listed or ()] == ["log"]
        else:
            assert ground.outcome(ground.transfers.checksum("d/log", ground.now)) == crc32_px4(b"a" * 1000)
        assert 3.0 < ground.now < 5.0  # ArduPilot gives a session up after 3 s without a reply

    def test_the_session_of_another_station_on_px4_is_left_alone(self) -> None:
        vehicle = PX4Vehicle()
        vehicle.files.update({"log/1.ulg": b"a" * 1000, "log/2.ulg": b"b" * 1000})
        ground = Ground(vehicle)
        opening = Packet(7, 0, Opcode.OPEN_FILE_RO, b"log/1.ulg")
        data = messages.encode(FileTransfer(0, 1, 1, opening.pack()), system=254, component=190, sequence=0)
        ground.air.receive(data, ground.now)
        read = ground.transfers.read("log/2.ulg", ground.now)
        ground.run(9.0)
        assert (vehicle.open_files, read.done) == (["log/1.ulg"], False)
        assert ground.outcome(read) == b"b" * 1000
        assert 11.0 < ground.now < 16.0  # PX4 closes what is not used for 11 s

    @thorough
    @given(faults, st.integers(0, 1500), st.booleans())
    def test_written_read_listed_and_summed(self, faults: dict[str, Any], length: int, px4: bool) -> None:
        vehicle = PX4Vehicle() if px4 else ardupilot()
        vehicle.files.update({f"d/{number}": b"" for number in range(40)})
        content = bytes(number * 11 % 253 for number in range(length))
        ground = Ground(vehicle, **faults)
        ground.outcome(ground.transfers.write("d/new", content, ground.now))
        assert vehicle.files["d/new"] == content
        assert ground.read("d/new") == content
        entries = ground.outcome(ground.transfers.list("d", ground.now))
        names = [f"d/{entry.name}" for entry in entries or ()]
        assert names == sorted(vehicle.files)
        assert ground.outcome(ground.transfers.checksum("d/new", ground.now)) == crc32_px4(content)
        ground.settle()

    def test_a_value_that_changes_meanwhile_is_the_old_or_the_new_one(self) -> None:
        for seed in range(10):
            vehicle = ardupilot()
            ground = Ground(vehicle, loss=0.2, delay=0.05, seed=seed)
            before = vehicle.params
            read = ground.transfers.read(PARAMS, ground.now)
            while not read.done:
                ground.run(0.05)
                for name in ("WPNAV_SPEED", "ATC_ANG_PIT_P", "RTL_ALT"):
                    vehicle.set_param(name, 777)
            assert read.result is not None
            for each in param_pck.decode(read.result).entries:
                after = vehicle.param(each.name)
                assert each.bits in (before[each.name].bits, after.bits)

    @pytest.mark.parametrize(
        "vehicle", [PX4Vehicle(), PX4Vehicle(ftp=True, table={"A": (ParamType.UINT8, 1)})]
    )
    def test_a_file_that_is_not_there(self, vehicle: Vehicle) -> None:
        ground = Ground(vehicle, loss=0.2, delay=0.05, seed=2)
        with pytest.raises(FileTransferError) as caught:
            ground.read(PARAMS)
        assert caught.value.is_not_found
        ground.settle()

    def test_a_vehicle_without_mavftp(self) -> None:
        ground = Ground(ardupilot(ftp=False), delay=0.05, round_trip=0.1)
        with pytest.raises(NoReply):
            ground.read(PARAMS)
        assert ground.transfers.is_idle

    def test_a_session_that_another_program_left_open(self) -> None:
        for vehicle in (ardupilot(), PX4Vehicle(ftp=True)):
            first = Ground(vehicle)
            first.transfers.read(PARAMS, first.now)
            first.until(lambda: vehicle.open_files == [PARAMS])  # noqa: B023 - it is called here
            ground = Ground(vehicle)
            ground.now = first.now
            assert param_pck.decode(ground.read(PARAMS)).total == len(vehicle.params)
            ground.settle()

    def test_a_reboot_in_the_middle(self) -> None:
        vehicle = ardupilot()
        ground = Ground(vehicle, delay=0.05)
        read = ground.transfers.read(PARAMS, ground.now)
        ground.run(0.3)
        assert read.received > 0
        vehicle.reboot(ground.now, down=0.3)
        assert param_pck.decode(ground.outcome(read) or b"").total == 1382
        ground.settle()

    @pytest.mark.parametrize("after", [0.0, 0.06, 0.12, 0.3])
    def test_released_at_any_moment_it_leaves_nothing_open(self, after: float) -> None:
        for px4 in (False, True):
            for round_trip in (None, 0.1):
                vehicle = PX4Vehicle(ftp=True) if px4 else ardupilot()
                ground = Ground(vehicle, delay=0.05, loss=0.1, seed=1, round_trip=round_trip)
                read = ground.transfers.read(PARAMS, ground.now)
                ground.run(after)
                ground.transfers.release(read, ground.now)
                ground.settle()
                assert not read.done

    @thorough
    @given(faults, st.floats(0.0, 1.5), st.booleans(), st.booleans())
    def test_a_session_is_closed_before_the_end_is_reported(
        self, faults: dict[str, Any], after: float, px4: bool, is_released: bool
    ) -> None:
        vehicle = PX4Vehicle(ftp=True) if px4 else ardupilot()
        ground = Ground(vehicle, **{**faults, "loss": 0.0, "reorder": 0.0, "jitter": 0.0})
        read = ground.transfers.read(PARAMS, ground.now)
        open_at_the_end: list[list[str]] = []
        read.on_done.append(lambda: open_at_the_end.append(vehicle.open_files))
        ground.run(after)
        if is_released and not read.done:
            ground.transfers.release(read, ground.now)
            ground.settle()
            assert open_at_the_end == []
        else:
            ground.outcome(read)
            assert open_at_the_end == [[]]

    def test_two_stations_do_not_take_each_others_files(self) -> None:
        vehicle = PX4Vehicle()
        vehicle.files.update({"a": b"a" * 5000, "b": b"b" * 5000})
        ground = Ground(vehicle)
        read = ground.transfers.read("a", ground.now)
        ground.run(0.02)
        other = Packet(5, 0, Opcode.READ_FILE, size=239, offset=1000)
        data = messages.encode(FileTransfer(0, 1, 1, other.pack()), system=254, component=190, sequence=0)
        ground.air.receive(data, ground.now)
        assert ground.outcome(read) == b"a" * 5000


class TestSpeed:
    """In simulated seconds, over 100 ms: where nothing is lost two round trips, the second to close the
    session, and 0.36 s for the burst.
    """

    @pytest.mark.parametrize(("loss", "median"), [(0.0, 0.6), (0.05, 0.8), (0.2, 1.2)])
    def test_the_parameters_of_ardupilot(self, loss: float, median: float) -> None:
        times = []
        for seed in range(15):
            ground = Ground(ardupilot(), round_trip=0.106, loss=loss, delay=0.05, seed=seed)
            ground.run(0.5)
            start = ground.now
            ground.read(PARAMS + "?withdefaults=1")
            times.append(ground.now - start)
        assert sorted(times)[7] <= median

    def test_a_radio_is_used_to_the_full_and_carries_the_file_once(self) -> None:
        vehicle = ardupilot(ftp_rate=5760.0)
        ground = Ground(vehicle, round_trip=0.2, delay=0.075, rate=5760, queue=1024)
        ground.run(0.5)
        start, sent = ground.now, ground.air.downlink.sent
        ground.read(PARAMS + "?withdefaults=1")
        assert ground.now - start <= 3.4
        ground.settle()
        beats = 2 * (ground.now - start + 1)  # HEARTBEAT and SYSTEM_TIME
        banner = 3
        assert ground.air.downlink.sent - sent <= 64 + 1 + banner + beats + 5

    @pytest.mark.parametrize("round_trip", [0.015, 0.025, 0.05, 0.1])
    @pytest.mark.parametrize("delay", [0.0, 0.02])
    def test_a_serial_port_carries_the_file_once_however_short_the_round_trip(
        self, round_trip: float, delay: float
    ) -> None:
        """Short messages have a short round trip at 57600 baud, and a block arrives behind the banner."""
        ground = Ground(ardupilot(ftp_rate=5760.0), round_trip=round_trip, delay=delay, rate=5760)
        ground.run(0.5)
        start, sent = ground.now, ground.air.downlink.sent
        ground.read(PARAMS + "?withdefaults=1")
        assert ground.now - start <= 3.3
        ground.settle()
        beats = 2 * (ground.now - start + 1)  # HEARTBEAT and SYSTEM_TIME
        banner = 3
        assert ground.air.downlink.sent - sent <= 64 + 1 + banner + beats + 8
