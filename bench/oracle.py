"""The oracle: an ideal client that is informed of each lost packet, as the reference for downloads.

The oracle begins like a program, with the first heartbeat of the vehicle. The heartbeat has all information
except whether an ArduPilot serves its parameters as a file: there the oracle waits for AUTOPILOT_VERSION
before it requests the list, because the vehicle would not serve a file during a list. Unlike a client, the
oracle is informed of a frame that the simulated link loses, at the time at which that frame, or the response
to it, would have arrived. It therefore never waits longer than one round trip. It knows the service rates of
the vehicle, and keeps as many requests in flight as the vehicle answers. It cannot make the vehicle or the
link faster.

`oracle_time` is for list downloads: after a given number of passes of the list, the oracle fills the gaps
with reads, either immediately or after the list, because an ArduPilot pauses a list for reads.
`file_oracle_time` is for file downloads: one burst, reads for the gaps, and the end of the session, without
which the next program would have to wait.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from heapq import heappop, heappush
from typing import Any, Final

from paramclient.protocol.file_download import WITH_DEFAULTS
from paramclient.protocol.ftp import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.param_pck import PARAM_FILE
from paramclient.sim import Air, Endpoint, FaultyLink
from paramclient.wire import messages
from paramclient.wire.frames import Framer

__all__ = ["FILE_FRAME", "TellingLink", "file_oracle_time", "oracle_time"]

GROUND = {"system": 255, "component": 190}
LIMIT: Final = 600.0
FILE_FRAME: Final = 27 + DATA_SIZE_MAX
"""Bytes of a frame with a full block of a file."""
SESSION: Final = 1
ROUNDING: Final = 1e-9
VERSION_ID: Final = messages.message_id(messages.AutopilotVersion)
VERSION_REQUEST: Final = messages.CommandLong(1, 1, messages.MAV_CMD_REQUEST_MESSAGE, float(VERSION_ID))


class TellingLink(FaultyLink):
    """A faulty link that reports what it loses, with the time at which it would have arrived."""

    def __init__(self, **faults: Any) -> None:
        super().__init__(**faults)
        self.losses: list[tuple[float, bytes]] = []

    def send(self, data: bytes, now: float) -> None:
        """As `FaultyLink.send`."""
        lost = self.lost
        super().send(data, now)
        if self.lost > lost:
            self.losses.append((max(now, self.free_at) + self.delay, data))


class _Oracle(ABC):
    """One run: requests at the first heartbeat, and again for each reported loss.

    Attributes:
        next_send: the time at which the next request of `ask` may leave.
    """

    understood: frozenset[int]
    """The ids of the messages that the oracle receives and sends, and whose losses are reported to it."""

    def __init__(self, air: Air) -> None:
        assert isinstance(air.uplink, TellingLink)
        assert isinstance(air.downlink, TellingLink)
        self.air = air
        self.uplink, self.downlink = air.uplink, air.downlink
        self.next_send = 0.0
        self._known: list[tuple[float, int, messages.Message]] = []  # future reports, in order
        self._sequence = 0

    def run(self) -> float:
        """Return the seconds from the first heartbeat to the last parameter."""
        now = 0.0
        began = math.inf
        self.air.tick(now)
        while not self.is_done() and now < LIMIT:
            self._learn_of_losses(now)
            self.ask(now)
            now = self._next_event(now)
            self.air.tick(now)
            for data in self.air.data_to_send():
                for message in self._read(data):
                    if not isinstance(message, messages.Heartbeat):
                        self.take(message, now)
                    elif began == math.inf:
                        began = now
                        self.begin(now)
        return now - began

    @abstractmethod
    def begin(self, now: float) -> None:
        """Request the parameters."""

    @abstractmethod
    def take(self, message: messages.Message, now: float) -> None:
        """Process a message of the vehicle."""

    @abstractmethod
    def reported(self, message: messages.Message, now: float) -> None:
        """Process the loss of a message that, or whose response, would have arrived now."""

    @abstractmethod
    def ask(self, now: float) -> None:
        """Request missing parameters at the rate at which the vehicle serves them."""

    @abstractmethod
    def wants(self) -> bool:
        """Whether `ask` has a request to send."""

    @abstractmethod
    def is_done(self) -> bool:
        """Whether all parameters were received."""

    def send(self, message: messages.Message, now: float) -> None:
        self._sequence += 1
        self.air.receive(messages.encode(message, **GROUND, sequence=self._sequence & 0xFF), now)

    def _read(self, data: bytes) -> list[messages.Message]:
        found = map(messages.decode, Framer({0, *self.understood}, stream=False).receive(data))
        return [message for message in found if message is not None]

    def _next_event(self, now: float) -> float:
        deadline = self.air.next_deadline()
        times = [math.inf if deadline is None else deadline]
        if self._known:
            times.append(self._known[0][0])
        if self.wants():
            times.append(self.next_send)
        return max(min(times), now + 1e-7)

    def _learn_of_losses(self, now: float) -> None:
        """Convert the losses of the links to reports, and process those that are due."""
        for losses, later in ((self.downlink.losses, 0.0), (self.uplink.losses, self.downlink.delay)):
            for at, data in losses:
                for message in self._read(data):
                    self._sequence += 1
                    heappush(self._known, (at + later, self._sequence, message))
            losses.clear()
        while self._known and self._known[0][0] <= now:
            message = heappop(self._known)[2]
            if not isinstance(message, messages.Heartbeat):
                self.reported(message, now)


class _ListOracle(_Oracle):
    """The oracle for list downloads: reads for the gaps immediately, or after the last pass."""

    understood = frozenset({20, 21, 22, 76, VERSION_ID})

    def __init__(
        self,
        air: Air,
        count: int,
        *,
        passes: int,
        reads_per_second: float,
        reads_beside: bool,
        asks_version: bool,
    ) -> None:
        super().__init__(air)
        self.asks_version = asks_version
        self.missing = set(range(count))
        self.count = count
        self.passes = passes
        self.per_read = 1.0 / reads_per_second
        self.reads_beside = reads_beside
        self.to_ask: deque[int] = deque()
        self.is_over = False

    def begin(self, now: float) -> None:
        self.send(VERSION_REQUEST if self.asks_version else messages.ParamRequestList(1, 1), now)

    def take(self, message: messages.Message, now: float) -> None:
        if isinstance(message, messages.AutopilotVersion):
            if self.asks_version:
                self.asks_version = False
                self.begin(now)
        elif isinstance(message, messages.ParamValue):
            self.missing.discard(message.param_index)
            if message.param_index == self.count - 1:
                self._end_pass(now)

    def reported(self, message: messages.Message, now: float) -> None:
        if isinstance(message, messages.ParamRequestList | messages.CommandLong | messages.AutopilotVersion):
            self.begin(now)
        elif isinstance(message, messages.ParamValue | messages.ParamRequestRead):
            if message.param_index in self.missing:
                self.to_ask.append(message.param_index)
            if message.param_index == self.count - 1 and isinstance(message, messages.ParamValue):
                self._end_pass(now)

    def _end_pass(self, now: float) -> None:
        """Process the end of a pass: its last value was received, or reported lost."""
        if self.is_over:
            return
        if self.passes > 1 and len(self.missing) > 1:
            self.passes -= 1
            self.to_ask.clear()
            self.begin(now)
        else:
            self.is_over = True

    def wants(self) -> bool:
        return bool(self.to_ask) and (self.reads_beside or self.is_over)

    def ask(self, now: float) -> None:
        while self.wants() and self.next_send <= now:
            index = self.to_ask.popleft()
            if index in self.missing:
                self.send(messages.ParamRequestRead(1, 1, "", index), now)
                self.next_send = max(self.next_send, now - 4 * self.per_read) + self.per_read
                self.next_send = max(self.next_send, self.uplink.free_at)

    def is_done(self) -> bool:
        return not self.missing


class _FileOracle(_Oracle):
    """The oracle for file downloads: requests the burst together with the open, and each lost block singly.

    The requests for lost blocks arrive after the burst, at most at the rate at which they are served. At the
    end the oracle closes the session.

    Attributes:
        end: the size of the file in bytes, once the end of the burst was received or reported lost.
    """

    understood = frozenset({110})

    def __init__(self, air: Air, *, burst_seconds: float, reads_per_second: float) -> None:
        super().__init__(air)
        self.burst_seconds = burst_seconds
        self.per_read = 1.0 / reads_per_second
        self.end: int | None = None
        self.number = 0
        self.lost_opens: set[int] = set()
        self.missing: set[int] = set()
        self.to_ask: deque[int] = deque()
        self.is_closing = self.is_closed = False

    def begin(self, now: float) -> None:
        self._request(Packet(0, SESSION, Opcode.OPEN_FILE_RO, (PARAM_FILE + WITH_DEFAULTS).encode()), now)
        self._burst(now)

    def take(self, message: messages.Message, now: float) -> None:
        assert isinstance(message, messages.FileTransfer)
        packet = Packet.unpack(message.payload)
        if packet.requested == Opcode.TERMINATE_SESSION:
            self.is_closed = True
        elif packet.opcode == Opcode.ACK:
            self.missing.discard(packet.offset)
        elif packet.requested == Opcode.BURST_READ_FILE and packet.data[:1] == b"\x06":
            self.end = packet.offset
        self._close_when_whole(now)

    def reported(self, message: messages.Message, now: float) -> None:
        assert isinstance(message, messages.FileTransfer)
        packet = Packet.unpack(message.payload)
        match packet.opcode:
            case Opcode.OPEN_FILE_RO:
                self.lost_opens.add(packet.sequence)
                self.begin(now)
            case Opcode.BURST_READ_FILE:
                if packet.sequence - 1 not in self.lost_opens:
                    self._burst(now)
            case Opcode.READ_FILE:
                self.to_ask.append(packet.offset)
            case Opcode.TERMINATE_SESSION:
                self._close(now)
            case Opcode.ACK if packet.requested in (Opcode.READ_FILE, Opcode.BURST_READ_FILE):
                self.missing.add(packet.offset)
                self.to_ask.append(packet.offset)
            case Opcode.ACK if packet.requested == Opcode.TERMINATE_SESSION:
                self._close(now)
            case _:  # the response to the open is not needed: the end of the burst has the size
                self.take(message, now)

    def wants(self) -> bool:
        return bool(self.to_ask)

    def ask(self, now: float) -> None:
        while self.to_ask and self.next_send <= now + ROUNDING:
            offset = self.to_ask.popleft()
            self._request(Packet(0, SESSION, Opcode.READ_FILE, size=DATA_SIZE_MAX, offset=offset), now)
            self.next_send = max(self.next_send, now) + self.per_read

    def is_done(self) -> bool:
        return self.is_closed

    def _burst(self, now: float) -> None:
        self._request(Packet(0, SESSION, Opcode.BURST_READ_FILE, size=DATA_SIZE_MAX), now)
        self.next_send = now + self.burst_seconds

    def _close_when_whole(self, now: float) -> None:
        if self.end is not None and not self.missing and not self.is_closing:
            self.is_closing = True
            self._close(now)

    def _close(self, now: float) -> None:
        self._request(Packet(0, SESSION, Opcode.TERMINATE_SESSION), now)

    def _request(self, packet: Packet, now: float) -> None:
        self.number += 1
        self.send(messages.FileTransfer(0, 1, 1, packet._replace(sequence=self.number).pack()), now)


def oracle_time(
    air: Air,
    count: int,
    *,
    passes: int,
    reads_per_second: float,
    reads_beside: bool,
    asks_version: bool,
) -> float:
    """Return the seconds of one list download by the oracle.

    Args:
        air: a channel with a new simulated vehicle, and a `TellingLink` in each direction.
        count: the number of the vehicle's parameters.
        passes: number of list requests; reads fill the gaps after the last one.
        reads_per_second: the read rate of the vehicle or the link.
        reads_beside: whether to read also during the list.
        asks_version: whether to wait for AUTOPILOT_VERSION before the list request.
    """
    return _ListOracle(
        air,
        count,
        passes=passes,
        reads_per_second=reads_per_second,
        reads_beside=reads_beside,
        asks_version=asks_version,
    ).run()


def file_oracle_time(
    make: Callable[[], Endpoint],
    uplink: TellingLink,
    downlink: TellingLink,
    *,
    burst_rate: float,
    reads_per_second: float,
) -> float:
    """Return the seconds of one file download by the oracle.

    Args:
        make: creates a simulated vehicle that serves param.pck.
        uplink, downlink: the links to and from the vehicle.
        burst_rate: bytes per second of the vehicle's burst.
        reads_per_second: the read rate of the vehicle or the link.
    """
    alone = _FileOracle(
        Air([make()], uplink=TellingLink(), downlink=TellingLink()),
        burst_seconds=0.0,
        reads_per_second=reads_per_second,
    )
    alone.run()
    assert alone.end is not None
    return _FileOracle(
        Air([make()], uplink=uplink, downlink=downlink),
        burst_seconds=math.ceil(alone.end / DATA_SIZE_MAX) * FILE_FRAME / burst_rate,
        reads_per_second=reads_per_second,
    ).run()
