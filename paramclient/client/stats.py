"""Counters of a client."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from paramclient.protocol.station import Address, Station

__all__ = ["ClientStats"]


@dataclass(frozen=True, slots=True)
class ClientStats:
    """Counters of a client since its creation; see `ParamClient.stats`.

    Attributes:
        bytes_received, bytes_sent: bytes on the link. `bytes_sent` excludes the frames of the forwarded
            program.
        frames_received, frames_sent: complete frames.
        skipped: received bytes outside of complete frames with a known message id.
        damaged: frames with a known message id and a wrong checksum.
        unusable_names: ignored messages, and values of packed files, whose parameter name no parameter file
            can hold.
        lost: lost frames, by the gaps in their sequence numbers; None without `traffic=True`.
        repeated: frames received twice; None without `traffic=True`.
        reads, writes: parameters read one by one, and written.
        retries: retransmitted requests of these reads and writes.
        downloads: fetches that downloaded a complete table.
        cache_hits: fetches served from the cache, because the vehicle's hash matched.
        round_trips: smoothed round-trip time in seconds, by (system, component), of each component that has
            responded to a request.
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
        """Return the counters of a client.

        Args:
            station: its protocol core.
            downloads: number of complete downloads.
            cache_hits: number of fetches served from the cache.
        """
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
            reads=sum(machine.reads.begun for machine in machines),
            writes=sum(machine.writes.begun for machine in machines),
            retries=sum(machine.reads.retries + machine.writes.retries for machine in machines),
            downloads=downloads,
            cache_hits=cache_hits,
            round_trips={
                machine.address: machine.round_trip.smoothed
                for machine in machines
                if machine.round_trip.smoothed is not None
            },
        )
