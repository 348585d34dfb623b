"""Air: a link between a program and simulated vehicles that loses, delays, reorders and damages datagrams."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from heapq import heappop, heappush
from typing import Protocol, TypedDict, Unpack

from paramclient.errors import UsageError
from paramclient.sim.other_station import OtherStation

__all__ = ["Air", "Endpoint", "FaultyLink"]


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


class Faults(TypedDict, total=False):
    """Faults of a link; see `FaultyLink`."""

    loss: float
    loss_burst: float
    delay: float
    jitter: float
    duplicate: float
    reorder: float
    bit_errors: float
    rate: float | None
    queue: int | None


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
        duplicated: the number of them that arrive twice.
        delivered: datagrams returned by `deliver`; in the end `sent - lost + duplicated`.

    Raises:
        UsageError: an argument is out of range.
    """

    def __init__(
        self,
        *,
        loss: float = 0.0,
        loss_burst: float = 1.0,
        delay: float = 0.0,
        jitter: float = 0.0,
        duplicate: float = 0.0,
        reorder: float = 0.0,
        bit_errors: float = 0.0,
        rate: float | None = None,
        queue: int | None = None,
        seed: int = 0,
    ) -> None:
        shares = {"loss": loss, "duplicate": duplicate, "reorder": reorder, "bit_errors": bit_errors}
        for name, share in shares.items():
            if not 0.0 <= share <= 1.0:
                raise UsageError(f"{name} must be a share between 0 and 1, not {share}")
        if not (math.isfinite(loss_burst) and loss_burst >= 1.0):
            raise UsageError(f"loss_burst must be a number of datagrams from 1 up, not {loss_burst}")
        for name, seconds in {"delay": delay, "jitter": jitter}.items():
            if not (math.isfinite(seconds) and seconds >= 0.0):
                raise UsageError(f"{name} must be a number of seconds from 0 up, not {seconds}")
        if rate is not None and not (math.isfinite(rate) and rate > 0.0):
            raise UsageError(f"rate must be a number of bytes per second above 0, not {rate}")
        if queue is not None and (rate is None or queue < 0):
            raise UsageError("queue must be a number of bytes from 0 up, and needs a rate")
        self._loss = loss
        self._loss_burst = loss_burst
        self._is_fading = False
        self._delay = delay
        self._jitter = jitter
        self._duplicate = duplicate
        self._reorder = reorder
        self._bit_errors = bit_errors
        self._rate = rate
        self._queue = queue
        self._random = random.Random(seed)
        self._flying: list[tuple[float, int, bytes]] = []
        self._number = 0
        self._free_at = -math.inf
        self._last_arrival = -math.inf
        self.sent = 0
        self.lost = 0
        self.duplicated = 0
        self.delivered = 0

    def send(self, data: bytes, now: float) -> None:
        """Send one datagram."""
        self.sent += 1
        leaves_at = now
        if self._rate is not None:
            starts_at = max(now, self._free_at)
            waiting = (starts_at - now) * self._rate
            if self._queue is not None and waiting and waiting + len(data) > self._queue:
                self.lost += 1
                return
            leaves_at = self._free_at = starts_at + len(data) / self._rate
        chance = self._random.random
        if self._loss and self._loses():
            self.lost += 1
            return
        arrives_at = leaves_at + self._delay
        if self._jitter:
            arrives_at += self._jitter * chance()
        arrives_at = max(arrives_at, self._last_arrival)
        if self._reorder and chance() < self._reorder:
            arrives_at += _HELD_BACK * chance()
        else:
            self._last_arrival = arrives_at
        copies = 1
        if self._duplicate and chance() < self._duplicate:
            self.duplicated += 1
            copies = 2
        for _ in range(copies):
            self._number += 1
            heappush(self._flying, (arrives_at, self._number, self._damaged(data)))

    def deliver(self, now: float) -> list[bytes]:
        """Return the datagrams that have arrived by `now`, in order of arrival."""
        arrived = []
        while self._flying and self._flying[0][0] <= now:
            arrived.append(heappop(self._flying)[2])
        self.delivered += len(arrived)
        return arrived

    def next_deadline(self) -> float | None:
        """Return the arrival time of the next datagram; None if there is none in flight."""
        return self._flying[0][0] if self._flying else None

    def _loses(self) -> bool:
        """Return whether the next datagram is lost; with bursts, whether the link is in its bad state."""
        if self._loss_burst == 1.0 or self._loss == 1.0:
            return self._random.random() < self._loss
        if self._is_fading:
            change = 1.0 / self._loss_burst
        else:
            change = self._loss / max(1.0 - self._loss, 1e-9) / self._loss_burst
        self._is_fading ^= self._random.random() < change
        return self._is_fading

    def _damaged(self, data: bytes) -> bytes:
        if not self._bit_errors:
            return data
        damaged = bytearray(data)
        at = self._gap()
        while at < 8 * len(damaged):
            damaged[at // 8] ^= 1 << at % 8
            at += 1 + self._gap()
        return bytes(damaged)

    def _gap(self) -> int:
        """Return the number of undamaged bits before the next damaged one."""
        if self._bit_errors == 1.0:
            return 0
        # 1 - random() is above 0. The limit avoids overflow with tiny error rates.
        return int(min(math.log(1.0 - self._random.random()) / math.log1p(-self._bit_errors), _FAR))


class Air:
    """Several vehicles behind one faulty link; itself an `Endpoint`.

    Received data goes to every vehicle, as on one radio channel. Between two calls, all work is done at its
    own due time, so the outcome does not depend on how often `tick` is called.

    Args:
        vehicles: any endpoints.
        uplink: from the program to the vehicles; None for a link without faults.
        downlink: from the vehicles to the program; None for a link without faults.
        others: further ground stations on the channel. Their data goes through both links, to the vehicles
            and to the program.

    Attributes:
        vehicles, uplink, downlink, others: as given.
    """

    def __init__(
        self,
        vehicles: Sequence[Endpoint],
        *,
        uplink: FaultyLink | None = None,
        downlink: FaultyLink | None = None,
        others: Sequence[OtherStation] = (),
    ) -> None:
        self.vehicles = tuple(vehicles)
        self.others = tuple(others)
        self.uplink = FaultyLink() if uplink is None else uplink
        self.downlink = FaultyLink() if downlink is None else downlink
        self._out: list[bytes] = []

    @property
    def vehicle_count(self) -> int | None:
        """The number of vehicles; None if an endpoint does not say its number."""
        counts = [getattr(each, "vehicle_count", None) for each in self.vehicles]
        known = [count for count in counts if isinstance(count, int)]
        return sum(known) if len(known) == len(counts) else None

    @classmethod
    def symmetric(
        cls,
        vehicles: Sequence[Endpoint],
        *,
        others: Sequence[OtherStation] = (),
        seed: int = 0,
        **faults: Unpack[Faults],
    ) -> Air:
        """Make an `Air` with the same faults in both directions; `delay` is one-way.

        See `FaultyLink` for the faults. The two directions use different random numbers, both derived from
        the seed.
        """
        uplink = FaultyLink(seed=2 * seed, **faults)
        downlink = FaultyLink(seed=2 * seed + 1, **faults)
        return cls(vehicles, uplink=uplink, downlink=downlink, others=others)

    def receive(self, data: bytes, now: float) -> None:
        """Take one datagram for all vehicles."""
        self.tick(now)
        self.uplink.send(data, now)
        self._step(now, self._deadlines())

    def tick(self, now: float) -> None:
        """Do all work that is due by `now`, in the order of its deadlines."""
        due = self._deadlines()
        while (first := min(*due, _at(self.uplink), _at(self.downlink), now)) < now:
            self._step(first, due)
        self._step(now, [now] * len(due))

    def next_deadline(self) -> float | None:
        """Return the earliest deadline of the vehicles, stations and links."""
        first = min(*self._deadlines(), _at(self.uplink), _at(self.downlink))
        return None if first == math.inf else first

    def data_to_send(self) -> list[bytes]:
        """Return the datagrams that have arrived at the program, and clear them."""
        out, self._out = self._out, []
        return out

    def _deadlines(self) -> list[float]:
        return [*map(_at, self.vehicles), *map(_at, self.others)]

    def _step(self, now: float, due: list[float]) -> None:
        """Advance to `now`; skips vehicles without due work and received data."""
        for place, station in enumerate(self.others, start=len(self.vehicles)):
            if due[place] <= now:
                station.tick(now)
                for data in station.data_to_send():
                    self.uplink.send(data, now)
                    self.downlink.send(data, now)
                due[place] = _at(station)
        up = self.uplink.deliver(now)
        for place, vehicle in enumerate(self.vehicles):
            if up or due[place] <= now:
                vehicle.tick(now)
                for data in up:
                    vehicle.receive(data, now)
                for data in vehicle.data_to_send():
                    self.downlink.send(data, now)
                due[place] = _at(vehicle)
        arrived = self.downlink.deliver(now)
        self._out += arrived[: OUT_LIMIT - len(self._out)]


OUT_LIMIT = 20_000
"""Frames that an endpoint keeps for `data_to_send`; further ones are dropped to bound the memory."""

_HELD_BACK = 0.03
"""Largest additional delay of a reordered datagram, in seconds."""
_FAR = 1e9
"""Largest gap between bit errors, in bits."""


def _at(part: Endpoint | OtherStation | FaultyLink) -> float:
    deadline = part.next_deadline()
    return math.inf if deadline is None else deadline
