"""What a diagnosis has measured: plain data."""

from __future__ import annotations

from dataclasses import dataclass

from paramclient.model.identity import Identity
from paramclient.model.values import Encoding

__all__ = [
    "FileService",
    "HashService",
    "LinkReport",
    "ListService",
    "ReadService",
    "Station",
    "VehicleReport",
]


@dataclass(frozen=True, slots=True)
class Station:
    """A ground station other than this client, by its heartbeats.

    Attributes:
        system, component: its address.
        has_our_address: whether it uses the ids of this client.
    """

    system: int
    component: int
    has_our_address: bool


@dataclass(frozen=True, slots=True)
class LinkReport:
    """The link, from its opening to the end of the diagnosis.

    Attributes:
        name: the link's name.
        seconds: how long it was listened to.
        round_trips: seconds from a command to its acknowledgement, sorted; empty where none was answered.
        unanswered: commands that were repeated or not answered at all.
        loss: share of the vehicle's frames that were lost on the way to this client, 0 to 1, by the gaps in
            their sequence numbers; None where no frame came.
        lost: how many frames that are.
        repeated: frames that arrived more than once.
        damaged: frames with a wrong checksum.
        unusable_names: messages of the vehicle that were left out, as no parameter file can hold the name in
            them.
        unknown: frames with an id that the dialect does not have.
        other_bytes: bytes received that belong to no frame.
        bytes_received, bytes_sent: totals.
        mavlink: version of the vehicle's frames, 1 or 2; 0 where none came.
        signed: frames of the vehicle with a signature.
        autopilots: addresses of the other autopilots on the link.
        stations: ground stations other than this client.
        radio_free: the percentage of the radio's transmit buffer that is free, where a radio reports it.
    """

    name: str
    seconds: float
    round_trips: tuple[float, ...]
    unanswered: int
    loss: float | None
    lost: int
    repeated: int
    damaged: int
    unusable_names: int
    unknown: int
    other_bytes: int
    bytes_received: int
    bytes_sent: int
    mavlink: int
    signed: int
    autopilots: tuple[tuple[int, int], ...]
    stations: tuple[Station, ...]
    radio_free: int | None


@dataclass(frozen=True, slots=True)
class ReadService:
    """PARAM_REQUEST_READ.

    Attributes:
        single: median seconds of reads that were made one after the other; None where none was answered.
        rate: reads answered per second with `in_flight` of them requested at once; None likewise.
        in_flight: how many were requested at once.
        answered: how many of these were answered.
        requests: requests sent for them, repeats included.
    """

    single: float | None
    rate: float | None
    in_flight: int
    answered: int
    requests: int


@dataclass(frozen=True, slots=True)
class ListService:
    """PARAM_REQUEST_LIST.

    Attributes:
        count: parameters that the vehicle says it has; None where no value came.
        received: how many of them came.
        elapsed: seconds until the download was over, or ended by its time limit.
        first: seconds to the first value; None where none came.
        rate: values per second while the list was sent; None where too few came.
        longest_pause: seconds between two moments at which values had come, to 0.1 s.
        lost: values that the list did not bring and that were requested again.
        missing: indices that did not come at all.
        is_cut_short: whether the time limit ended it.
        error: why nothing came, or None.
    """

    count: int | None
    received: int
    elapsed: float
    first: float | None
    rate: float | None
    longest_pause: float
    lost: int
    missing: int
    is_cut_short: bool
    error: str | None


@dataclass(frozen=True, slots=True)
class FileService:
    """MAVFTP and the packed parameter file.

    Attributes:
        is_announced: whether the capabilities in AUTOPILOT_VERSION include MAVFTP; None where unknown.
        is_serving: whether a request was answered with anything but silence.
        entries: names of the files and directories in the root, directories with a `/` at the end; None
            where it could not be listed.
        size: bytes of `@PARAM/param.pck`; None where it could not be read.
        elapsed: seconds in which that was read.
        parameters: entries in it.
        defaults: entries for which it tells the firmware's default.
        error: why it could not be read.
    """

    is_announced: bool | None
    is_serving: bool
    entries: tuple[str, ...] | None
    size: int | None
    elapsed: float | None
    parameters: int | None
    defaults: int | None
    error: str | None


@dataclass(frozen=True, slots=True)
class HashService:
    """PX4's `_HASH_CHECK`.

    Attributes:
        before, after: the hash at the beginning and at the end of the diagnosis; None where it was not
            answered.
        seconds: between the two.
        confirms_list: whether it was the same before and after the list download, so that the next session
            can do without one; None where the list is not complete.
        error: why there is none.
    """

    before: int | None
    after: int | None
    seconds: float
    confirms_list: bool | None
    error: str | None


@dataclass(frozen=True, slots=True)
class VehicleReport:
    """One vehicle and the link to it. A part that was not measured, for want of time, is None.

    Attributes:
        system, component: its address.
        autopilot: in a word: px4, ardupilot, generic, …
        vehicle_type: MAV_TYPE of its heartbeat in words.
        identity: hardware id, firmware, capabilities as far as known.
        has_version: whether it answered the request for AUTOPILOT_VERSION.
        encoding, encoding_reason: how it lays out values, and the evidence for it.
        is_armed: whether its motors may turn; None where that is not known.
        descriptions: address of the general metadata file that it names in COMPONENT_METADATA; None where it
            names none.
        link, reads, list, files, hash: what was measured.
        elapsed: seconds that everything took.
    """

    system: int
    component: int
    autopilot: str
    vehicle_type: str | None
    identity: Identity
    has_version: bool
    encoding: Encoding
    encoding_reason: str
    is_armed: bool | None
    descriptions: str | None
    link: LinkReport
    reads: ReadService | None
    list: ListService | None
    files: FileService | None
    hash: HashService | None
    elapsed: float
