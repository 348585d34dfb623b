"""What a client has done so far, in numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from paramclient.protocol.station import Address, Station

__all__ = ["ClientStats"]


@dataclass(frozen=True, slots=True)
class ClientStats:
    """What a client has done since it was made; see `ParamClient.stats`.

    Attributes:
        bytes_received, bytes_sent: over the link, those of another program that shares it not among the sent.
        frames_received, frames_sent: whole ones.
        skipped: bytes that came and belong to no whole frame of a known id.
        damaged: what looked like a frame of a known id and had a wrong checksum.
        unusable_names: messages that were left out as no parameter file can hold the name in them, and values
            of packed files likewise.
        lost: frames that were lost on the way, by the gaps in their sequence numbers; None where the client
            was made without `traffic=True`.
        repeated: frames that came twice; None as before.
        reads, writes: parameters that were asked for one by one, and written.
        retries: requests of these that were sent for another time.
        downloads: fetches that brought a whole table.
        cache_hits: fetches that the cache settled, because the vehicle's hash confirmed it or a sample
            agreed.
        round_trips: the measured round trip in seconds, smoothed, by (system, component), of those that have
            answered something.
    """

    bytes_received: int
    bytes_sent: int
    frames_received: int
    frames_sent: int
    skipped: int
    damaged: int
    unusable_names: int
    lost: int | None
    repeated: int | None
    reads: int
    writes: int
    retries: int
    downloads: int
    cache_hits: int
    round_trips: Mapping[Address, float]

    @classmethod
    def of(cls, station: Station, *, downloads: int, cache_hits: int) -> ClientStats:
        """Of the core of a client."""
        frames, skipped, damaged = station.framing
        machines = station.components.values()
        return cls(
            bytes_received=station.bytes_received,
            bytes_sent=station.bytes_sent,
            frames_received=frames,
            frames_sent=station.frames_sent,
            skipped=skipped,
            damaged=damaged,
            unusable_names=sum(machine.table.left_out for machine in machines),
            lost=None if station.traffic is None else station.traffic.lost,
            repeated=None if station.traffic is None else station.traffic.repeated,
            reads=sum(machine.reads.asked for machine in machines),
            writes=sum(machine.writes.asked for machine in machines),
            retries=sum(machine.reads.retries + machine.writes.retries for machine in machines),
            downloads=downloads,
            cache_hits=cache_hits,
            round_trips={
                machine.address: machine.round_trip.smoothed
                for machine in machines
                if machine.round_trip.smoothed is not None
            },
        )
