"""Air: a link between a program and simulated vehicles that loses, delays, reorders and damages datagrams."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Any, Protocol

from paramclient.errors import UsageError
from paramclient.sim.device import OUT_LIMIT
from paramclient.sim.param_table import check_range


class Endpoint(Protocol):
    """The remote end of a link: a vehicle, or an `Air` with several vehicles.

    Time is any monotonic clock in seconds; the first call defines the start. After `receive` and `tick`, the
    caller sends the result of `data_to_send`, and calls `tick` again at `next_deadline`::

        endpoint.tick(now)
        for datagram in endpoint.data_to_send(): ...
        wake_at = endpoint.next_deadline()
    """

    def receive(self, data: bytes, now: float) -> None:
        """Take one datagram (or a piece of a byte stream) at the time `now`. Never raises."""

    def tick(self, now: float) -> None:
        """Do all work that is due by `now`. Late work is done at `now`, not at its deadline."""

    def next_deadline(self) -> float | None:
        """Return the time of the next work; None if there is none, as before the first call."""

    def data_to_send(self) -> list[bytes]:
        """Return the data to send, and clear it. Each item is one frame, to be sent as one datagram."""


@dataclass(kw_only=True, eq=False)
class FaultyLink:
    """One direction of a link with faults, reproducible by its seed.

    A datagram first waits in the queue of `rate`; then it may be lost; then it travels for `delay` plus up
    to `jitter`. Jitter does not change the order of datagrams. Only datagrams selected by `reorder` are
    delayed by up to 30 ms more, so that later ones overtake them.

    Args:
        loss: the share of datagrams that are lost, 0 to 1.
        loss_burst: the average number of datagrams lost in a row: 1 for independent losses, more for a
            fading link (Gilbert's model: a good state without losses, and a bad state that loses all).
        delay: one-way delay in seconds.
        jitter: additional delay in seconds, uniform between 0 and this.
        duplicate: the share of datagrams that arrive twice, 0 to 1.
        reorder: the share of datagrams that are overtaken, 0 to 1.
        bit_errors: the probability of each bit to be inverted, 0 to 1.
        rate: bytes per second; None for no limit.
        queue: bytes that may wait in the queue of `rate`, including those in transmission. If the link is
            busy and the queue is full, a datagram is lost. None for no limit.
        seed: of this link's random numbers.

    Attributes:
        sent: datagrams given to `send`.
        lost: the number of them that do not arrive, because of `loss` or a full queue.
        free_at: when a new datagram would leave without waiting, or earlier.

    Raises:
        UsageError: an argument is out of range.
    """

    loss: float = 0.0
    loss_burst: float = 1.0
    delay: float = 0.0
    jitter: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    bit_errors: float = 0.0
    rate: float | None = None
    queue: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        shares = ("loss", "duplicate", "reorder", "bit_errors")
        check_range(0.0, 1.0, **{name: getattr(self, name) for name in shares})
        check_range(1.0, loss_burst=self.loss_burst)
        check_range(0.0, delay=self.delay, jitter=self.jitter, queue=self.queue or 0)
        if self.rate is not None and not 0.0 < self.rate < math.inf:
            raise UsageError(f"rate must be a number of bytes per second above 0, not {self.rate}")
        if self.queue is not None and self.rate is None:
            raise UsageError("queue needs a rate")
        self._is_fading = False
        self._random = random.Random(self.seed)
        self._flying: list[tuple[float, int, bytes]] = []
        self._last_arrival = self.free_at = -math.inf
        self.sent = self.lost = 0

    def send(self, data: bytes, now: float) -> None:
        """Send one datagram."""
        self.sent += 1
        leaves_at = now
        if self.rate is not None:
            starts_at = max(now, self.free_at)
            waiting = (starts_at - now) * self.rate
            if self.queue is not None and waiting and waiting + len(data) > self.queue:
                self.lost += 1
                return
            leaves_at = self.free_at = starts_at + len(data) / self.rate
        chance = self._random.random
        if self.loss and self._loses():
            self.lost += 1
            return
        arrives_at = leaves_at + self.delay
        if self.jitter:
            arrives_at += self.jitter * chance()
        arrives_at = max(arrives_at, self._last_arrival)
        if self.reorder and chance() < self.reorder:
            arrives_at += _HELD_BACK * chance()
        else:
            self._last_arrival = arrives_at
        is_doubled = self.duplicate and chance() < self.duplicate
        for copy in range(2 if is_doubled else 1):
            heappush(self._flying, (arrives_at, 2 * self.sent + copy, self._damaged(data)))

    def deliver(self, now: float) -> list[bytes]:
        """Return the datagrams that have arrived by `now`, in order of arrival."""
        arrived = []
        while self._flying and self._flying[0][0] <= now:
            arrived.append(heappop(self._flying)[2])
        return arrived

    def next_deadline(self) -> float | None:
        """Return the arrival time of the next datagram; None if there is none in flight."""
        return self._flying[0][0] if self._flying else None

    def _loses(self) -> bool:
        """Return whether the next datagram is lost; with bursts, whether the link is in its bad state."""
        if self.loss_burst == 1.0 or self.loss == 1.0:
            return self._random.random() < self.loss
        into_fading = self.loss / max(1.0 - self.loss, 1e-9) / self.loss_burst
        change = 1.0 / self.loss_burst if self._is_fading else into_fading
        self._is_fading ^= self._random.random() < change
        return self._is_fading

    def _damaged(self, data: bytes) -> bytes:
        if not self.bit_errors:
            return data
        damaged = bytearray(data)
        for bit in range(8 * len(damaged)):
            if self._random.random() < self.bit_errors:
                damaged[bit // 8] ^= 1 << bit % 8
        return bytes(damaged)


class Air:
    """Several vehicles behind one faulty link; itself an `Endpoint`.

    Received data goes to every vehicle, as on one radio channel. Between two calls, all work is done at its
    own due time, so the outcome does not depend on how often `tick` is called.

    Args:
        vehicles: any endpoints.
        uplink: from the program to the vehicles; None for a link without faults.
        downlink: from the vehicles to the program; None for a link without faults.

    Attributes:
        vehicles: as given.
        uplink, downlink: as given; may be replaced.
        vehicle_count: the number of vehicles; infinite if an endpoint does not say its number.
    """

    def __init__(
        self,
        vehicles: Sequence[Endpoint],
        *,
        uplink: FaultyLink | None = None,
        downlink: FaultyLink | None = None,
    ) -> None:
        self.uplink = uplink or FaultyLink()
        self.downlink = downlink or FaultyLink()
        self.vehicles = tuple(vehicles)
        self.vehicle_count: float = sum(getattr(each, "vehicle_count", math.inf) for each in vehicles)
        self._out: list[bytes] = []

    @classmethod
    def symmetric(cls, vehicles: Sequence[Endpoint], *, seed: int = 0, **faults: Any) -> Air:
        """Make an `Air` with the same faults in both directions; `delay` is one-way.

        See `FaultyLink` for the faults. The two directions use different random numbers, both derived from
        the seed.
        """
        uplink, downlink = FaultyLink(seed=2 * seed, **faults), FaultyLink(seed=2 * seed + 1, **faults)
        return cls(vehicles, uplink=uplink, downlink=downlink)

    def receive(self, data: bytes, now: float) -> None:
        """Take one datagram for all vehicles."""
        self.tick(now)
        self.uplink.send(data, now)
        self._step(now, [*map(_at, self.vehicles)])

    def tick(self, now: float) -> None:
        """Do all work that is due by `now`, in the order of its deadlines."""
        due = [*map(_at, self.vehicles)]
        while (first := min(*due, _at(self.uplink), _at(self.downlink), now)) < now:
            self._step(first, due)
        self._step(now, [now] * len(due))

    def next_deadline(self) -> float | None:
        """Return the earliest deadline of the vehicles and links."""
        first = min(*map(_at, self.vehicles), _at(self.uplink), _at(self.downlink))
        return None if first == math.inf else first

    def data_to_send(self) -> list[bytes]:
        """Return the datagrams that have arrived at the program, and clear them."""
        out, self._out = self._out, []
        return out

    def _step(self, now: float, due: list[float]) -> None:
        """Advance to `now`; skips vehicles without due work and received data."""
        up = self.uplink.deliver(now)
        for place, vehicle in enumerate(self.vehicles):
            if up or due[place] <= now:
                vehicle.tick(now)
                for data in up:
                    vehicle.receive(data, now)
                for data in vehicle.data_to_send():
                    self.downlink.send(data, now)
                due[place] = _at(vehicle)
        self._out += self.downlink.deliver(now)[: OUT_LIMIT - len(self._out)]


_HELD_BACK = 0.03
"""Largest additional delay of a reordered datagram, in seconds."""


def _at(part: Endpoint | FaultyLink) -> float:
    deadline = part.next_deadline()
    return math.inf if deadline is None else deadline
