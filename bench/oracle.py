"""The client that a download is measured against: it is told of each loss, so it never waits in vain.

It sees what no client can see: a frame that the simulated link loses is reported to it at the moment when
it, or the answer to it, would have arrived. So it never waits longer than one round trip for anything, and it
keeps as many requests in flight as the vehicle serves. What it cannot do is to make the vehicle or the link
faster. `oracle_time` runs it by list: reads for the gaps, after as many passes of the list as it is told.
`file_oracle_time` runs it by file: one burst, and reads for the gaps.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from heapq import heappop, heappush
from typing import Any, Final

from paramclient.protocol import wire
from paramclient.protocol.ftp.packets import MOST_DATA, Opcode, Packet
from paramclient.protocol.packfetch import PARAMETER_FILE, WITH_DEFAULTS
from paramclient.sim import Air, Endpoint, FaultyLink

__all__ = ["FILE_FRAME", "TellingLink", "file_oracle_time", "oracle_time"]

GROUND = {"system": 255, "component": 190}
LIMIT: Final = 600.0
FILE_FRAME: Final = 27 + MOST_DATA
"""Bytes of a frame with a full block of a file."""
SESSION: Final = 1
ROUNDING: Final = 1e-9


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
            self.losses.append((max(now, self._free_at) + self._delay, data))

    @property
    def is_free_at(self) -> float:
        """When the next datagram would leave without waiting."""
        return self._free_at

    @property
    def travel(self) -> float:
        """Seconds on the way."""
        return self._delay


class _Oracle:
    """One run: what is missing, when to ask for it, and what was reported lost."""

    def __init__(
        self, vehicle: Endpoint, air: Air, count: int, *, passes: int, reads_per_second: float
    ) -> None:
        self.vehicle = vehicle
        self.air = air
        self.missing = set(range(count))
        self.count = count
        self.passes = passes
        self.per_read = 1.0 / reads_per_second
        self.sequence = 0
        self.to_ask: list[int] = []
        self.known: list[tuple[float, int, int]] = []  # (when, kind, index) of reports that are still to come
        self.next_send = 0.0
        self.stream_end = math.inf

    def run(self, limit: float) -> float:
        """Seconds until every parameter has come."""
        now = 0.0
        self.air.tick(now)
        self.ask_for_list(now)
        framer = wire.Framer({22}, stream=False)
        while self.missing and now < limit:
            self.learn_of_losses(now)
            self.ask(now)
            now = self.next_event(now)
            self.air.tick(now)
            for data in self.air.data_to_send():
                for frame in framer.receive(data):
                    message = wire.decode(frame)
                    if isinstance(message, wire.ParamValue):
                        self.missing.discard(message.param_index)
                        if message.param_index == self.count - 1:
                            self.end_of_stream(now)
        return now

    def next_event(self, now: float) -> float:
        deadline = self.air.next_deadline()
        times = [math.inf if deadline is None else deadline]
        if self.known:
            times.append(self.known[0][0])
        if self.to_ask:
            times.append(self.next_send)
        return max(min(times), now + 1e-7)

    def learn_of_losses(self, now: float) -> None:
        """Turn what the links lost into reports at their time, and take those that are due."""
        uplink, downlink = self.air.uplink, self.air.downlink
        assert isinstance(uplink, TellingLink)
        assert isinstance(downlink, TellingLink)
        for at, data in downlink.losses:
            self.report(at, data)
        for at, data in uplink.losses:
            self.report(at + downlink.travel, data)
        downlink.losses.clear()
        uplink.losses.clear()
        while self.known and self.known[0][0] <= now:
            _, kind, index = heappop(self.known)
            if kind == 21:
                self.ask_for_list(now)
            elif index == self.count - 1 and kind == 22 and self.stream_end == math.inf:
                self.end_of_stream(now)
                self.want(index)
            else:
                self.want(index)

    def report(self, at: float, data: bytes) -> None:
        for frame in wire.Framer({20, 21, 22}, stream=False).receive(data):
            message = wire.decode(frame)
            if isinstance(message, wire.ParamValue):
                heappush(self.known, (at, 22, message.param_index))
            elif isinstance(message, wire.ParamRequestRead):
                heappush(self.known, (at, 20, message.param_index))
            else:
                heappush(self.known, (at, 21, 0))

    def want(self, index: int) -> None:
        if index in self.missing:
            self.to_ask.append(index)

    def end_of_stream(self, now: float) -> None:
        """The last value of a pass has come, or would have."""
        if self.stream_end < math.inf:
            return
        self.stream_end = now
        if self.passes > 1 and len(self.missing) > 1:
            self.passes -= 1
            self.stream_end = math.inf
            self.to_ask.clear()
            self.ask_for_list(now)

    def ask_for_list(self, now: float) -> None:
        self.send(wire.ParamRequestList(1, 1), now)

    def ask(self, now: float) -> None:
        """Ask for what is known to be missing, at the rate at which it is served."""
        while self.to_ask and self.next_send <= now:
            index = self.to_ask.pop(0)
            if index in self.missing:
                self.send(wire.ParamRequestRead(1, 1, "", index), now)
                self.next_send = max(self.next_send, now - 4 * self.per_read) + self.per_read
                uplink = self.air.uplink
                assert isinstance(uplink, TellingLink)
                self.next_send = max(self.next_send, uplink.is_free_at)

    def send(self, message: wire.Message, now: float) -> None:
        self.sequence = (self.sequence + 1) & 0xFF
        self.air.receive(wire.encode(message, **GROUND, sequence=self.sequence), now)


class _FileOracle:
    """One run by file: what has come, what was reported lost, and when to ask for it.

    It asks for the burst together with the open, and for each lost block singly, so that the vehicle gets to
    hear that as soon as its burst is over and then no quicker than it serves.

    Attributes:
        end: where the file ends, once the end of the burst has come or was reported lost.
    """

    def __init__(self, air: Air, *, burst_seconds: float, reads_per_second: float) -> None:
        self.air = air
        self.burst_seconds = burst_seconds
        self.per_read = 1.0 / reads_per_second
        self.end: int | None = None
        self.sequence = 0
        self.lost_opens: set[int] = set()
        self.missing: set[int] = set()
        self.to_ask: deque[int] = deque()
        self.known: list[tuple[float, int, Packet]] = []  # reports that are still to come, and in which order
        self.next_send = 0.0

    def run(self) -> float:
        """Seconds until the whole file has come."""
        now = 0.0
        self.air.tick(now)
        self.begin(now)
        framer = wire.Framer({110}, stream=False)
        while (self.end is None or self.missing) and now < LIMIT:
            self.learn_of_losses(now)
            self.ask(now)
            now = self.next_event(now)
            self.air.tick(now)
            for data in self.air.data_to_send():
                for frame in framer.receive(data):
                    message = wire.decode(frame)
                    assert isinstance(message, wire.FileTransfer)
                    self.take(Packet.unpack(message.payload))
        return now

    def take(self, packet: Packet) -> None:
        if packet.opcode == Opcode.ACK:
            self.missing.discard(packet.offset)
        elif packet.requested == Opcode.BURST_READ_FILE and packet.data[:1] == b"\x06":
            self.end = packet.offset

    def next_event(self, now: float) -> float:
        deadline = self.air.next_deadline()
        times = [math.inf if deadline is None else deadline]
        if self.known:
            times.append(self.known[0][0])
        if self.to_ask:
            times.append(self.next_send)
        return max(min(times), now + 1e-7)

    def learn_of_losses(self, now: float) -> None:
        """Turn what the links lost into reports at their time, and take those that are due."""
        uplink, downlink = self.air.uplink, self.air.downlink
        assert isinstance(uplink, TellingLink)
        assert isinstance(downlink, TellingLink)
        for losses, later in ((downlink.losses, 0.0), (uplink.losses, downlink.travel)):
            for at, data in losses:
                for frame in wire.Framer({110}, stream=False).receive(data):
                    message = wire.decode(frame)
                    assert isinstance(message, wire.FileTransfer)
                    packet = Packet.unpack(message.payload)
                    heappush(self.known, (at + later, packet.sequence, packet))
            losses.clear()
        while self.known and self.known[0][0] <= now:
            self.reported(heappop(self.known)[2], now)

    def reported(self, packet: Packet, now: float) -> None:
        """This would have come by now, or the answer to it."""
        match packet.opcode:
            case Opcode.OPEN_FILE_RO:
                self.lost_opens.add(packet.sequence)
                self.begin(now)
            case Opcode.BURST_READ_FILE:
                if packet.sequence - 1 not in self.lost_opens:
                    self.burst(now)
            case Opcode.READ_FILE:
                self.to_ask.append(packet.offset)
            case Opcode.ACK if packet.requested in (Opcode.READ_FILE, Opcode.BURST_READ_FILE):
                self.missing.add(packet.offset)
                self.to_ask.append(packet.offset)
            case _:  # the answer to the open says nothing that it needs, the end of the burst does
                self.take(packet)

    def begin(self, now: float) -> None:
        self.send(Packet(0, SESSION, Opcode.OPEN_FILE_RO, (PARAMETER_FILE + WITH_DEFAULTS).encode()), now)
        self.burst(now)

    def burst(self, now: float) -> None:
        self.send(Packet(0, SESSION, Opcode.BURST_READ_FILE, size=MOST_DATA), now)
        self.next_send = now + self.burst_seconds

    def ask(self, now: float) -> None:
        """Ask for what is known to be missing, at the rate at which it is served."""
        while self.to_ask and self.next_send <= now + ROUNDING:
            offset = self.to_ask.popleft()
            self.send(Packet(0, SESSION, Opcode.READ_FILE, size=MOST_DATA, offset=offset), now)
            self.next_send = max(self.next_send, now) + self.per_read

    def send(self, packet: Packet, now: float) -> None:
        self.sequence += 1
        payload = packet._replace(sequence=self.sequence).pack()
        message = wire.FileTransfer(0, 1, 1, payload)
        self.air.receive(wire.encode(message, **GROUND, sequence=self.sequence & 0xFF), now)


def oracle_time(vehicle: Endpoint, air: Air, count: int, *, passes: int, reads_per_second: float) -> float:
    """Seconds that one run of the oracle takes.

    Args:
        vehicle: a fresh simulated vehicle, the only one in `air`.
        air: with a `TellingLink` in each direction.
        count: the vehicle's parameters.
        passes: times that the list is asked for; reads fill the gaps after the last one.
        reads_per_second: what the vehicle or the link serves.
    """
    return _Oracle(vehicle, air, count, passes=passes, reads_per_second=reads_per_second).run(LIMIT)


def file_oracle_time(
    make: Callable[[], Endpoint],
    uplink: TellingLink,
    downlink: TellingLink,
    *,
    burst_rate: float,
    reads_per_second: float,
) -> float:
    """Seconds that one run of the oracle by file takes.

    Args:
        make: makes a fresh simulated vehicle, which serves param.pck.
        uplink, downlink: what lies between.
        burst_rate: bytes per second of the vehicle's burst.
        reads_per_second: what the vehicle or the link serves.
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
        burst_seconds=math.ceil(alone.end / MOST_DATA) * FILE_FRAME / burst_rate,
        reads_per_second=reads_per_second,
    ).run()
