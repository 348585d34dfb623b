"""The report of a diagnosis: results of the measurements of a vehicle and its link, as plain data."""

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
    "HeardStation",
    "VehicleReport",
]


@dataclass(frozen=True, slots=True)
class HeardStation:
    """Another ground station, detected by its heartbeats.

    Attributes:
        system: its system id.
        component: its component id.
        has_our_address: whether it uses the ids of this client.
    """

    system: int
    component: int
    has_our_address: bool


@dataclass(frozen=True, slots=True)
class LinkReport:
    """The state of the link, from its opening to the end of the diagnosis.

    Attributes:
        name: the link's name.
        seconds: time since its opening.
        round_trips: seconds from a command to its acknowledgement, sorted; empty if none was acknowledged.
        unanswered: number of commands that were repeated or not acknowledged.
        loss: share of the vehicle's frames that were lost, 0 to 1, by the gaps in their sequence numbers;
            None if no frame was received.
        lost: number of these frames.
        repeated: number of frames that arrived more than once.
        damaged: number of frames with a wrong checksum.
        unusable_names: number of messages of the vehicle that were left out, because no parameter file can
            hold their parameter name.
        unknown: number of frames with a message id that the dialect does not have.
        other_bytes: received bytes that belong to no frame.
        bytes_received: bytes received in total.
        bytes_sent: bytes sent in total.
        mavlink: version of the vehicle's frames, 1 or 2; 0 if no frame was received.
        signed: number of the vehicle's frames with a signature.
        autopilots: addresses of the other autopilots on the link.
        stations: other ground stations.
        radio_free: free share of the radio's transmit buffer in percent; None if no radio reports it.
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
    stations: tuple[HeardStation, ...]
    radio_free: int | None


@dataclass(frozen=True, slots=True)
class ReadService:
    """Results for PARAM_REQUEST_READ.

    Attributes:
        single: median seconds of sequential reads; None if none was answered.
        rate: reads answered per second with `in_flight` concurrent reads; None if none was answered.
        in_flight: number of concurrent reads.
        answered: number of these that were answered.
        requests: requests sent for them, repeats included.
    """

    single: float | None
    rate: float | None
    in_flight: int
    answered: int
    requests: int


@dataclass(frozen=True, slots=True)
class ListService:
    """Results for PARAM_REQUEST_LIST.

    Attributes:
        count: number of parameters that the vehicle announces; None if no value was received.
        received: number of parameters received.
        elapsed: seconds until the download was complete, or ended by its time limit.
        first: seconds to the first value; None if no value was received.
        rate: values per second while the list was sent; None if too few values were received.
        longest_pause: longest time between two received values in seconds, with a resolution of 0.1 s.
        lost: number of values that were lost from the list and requested again.
        missing: number of indices that were never received.
        is_cut_short: whether the time limit ended the download.
        error: the error if nothing was received, or None.
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
    """Results for MAVFTP and the packed parameter file.

    Attributes:
        is_announced: whether the capabilities in AUTOPILOT_VERSION include MAVFTP; None if unknown.
        is_serving: whether the vehicle answered a request, also with a refusal.
        entries: names of the files and directories in the root, directories with a `/` at the end; None
            if the root could not be listed.
        size: size of `@PARAM/param.pck` in bytes; None if it could not be read.
        elapsed: seconds that the read of it took.
        parameters: number of entries in it.
        defaults: number of entries with the firmware's default.
        error: the error of the read, or None.
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
    """Results for PX4's `_HASH_CHECK`.

    Attributes:
        before: the hash at the beginning of the diagnosis; None if the request was not answered.
        after: the hash at the end of the diagnosis; None if the request was not answered.
        seconds: time between the two.
        confirms_list: whether the hash was the same before and after the list download, so that the next
            session needs no download; None if the list is not complete.
        error: the reason why there is no hash, or None.
    """

    before: int | None
    after: int | None
    seconds: float
    confirms_list: bool | None
    error: str | None


@dataclass(frozen=True, slots=True)
class VehicleReport:
    """The diagnosis of one vehicle and its link. Parts that were not measured, for lack of time, are None.

    Attributes:
        system: its system id.
        component: its component id.
        autopilot: its firmware in a word: px4, ardupilot, generic, …
        vehicle_type: MAV_TYPE of its heartbeat in words.
        identity: hardware id, firmware and capabilities as far as known.
        has_version: whether it answered the request for AUTOPILOT_VERSION.
        encoding: the encoding of its values.
        encoding_reason: the evidence for that encoding.
        is_armed: whether its motors may turn; None if unknown.
        descriptions: URI of the general metadata file that it names in COMPONENT_METADATA; None if it names
            none.
        link: the state of the link.
        reads: results for PARAM_REQUEST_READ.
        list: results for PARAM_REQUEST_LIST.
        files: results for MAVFTP.
        hash: results for the hash.
        elapsed: duration of the diagnosis in seconds.
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
