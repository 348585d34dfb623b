"""Taps: receivers of all frames of a link, which one cutter finds in its bytes; the telemetry log, traffic.

`Framer` returns proven frames of known messages and skips everything else as fast as it can. Here everything
counts, and speed does not matter: this runs only for the receivers of all frames of a link.
"""

from __future__ import annotations

import logging
import os
import struct
import time
from collections import Counter, defaultdict, deque
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

import anyio
import anyio.to_thread

from paramclient.errors import UsageError
from paramclient.links.tlog import packed_time
from paramclient.protocol.addresses import Address
from paramclient.wire.frames import Frame, bears_key, checksum, find_magic, unsign_frame
from paramclient.wire.loss import SequenceCheck
from paramclient.wire.messages import Heartbeat, decode
from paramclient.wire.signing import SIGNATURE_LENGTH

UNPROVEN_BYTES_MAX: Final = 4096
"""Bytes of a stream without a proven frame that are kept until the following ones arrive."""
UNFINISHED_PEERS_MAX: Final = 256
"""Peers of a stream with undecided bytes."""

_MAGIC_V1 = 0xFE
_MAGICS = (b"\xfd", b"\xfe")
_SIGNED = 0x01
_HEADER_LENGTH = 10  # of MAVLink 2


class SeenFrame(NamedTuple):
    """One frame, as its header describes it.

    Attributes:
        frame: its content.
        data: the bytes of the whole frame.
        is_signed: whether it has a signature, which is not verified.
        is_known: false for an id outside the dialect, so that no checksum proves the frame.
        is_proven: whether it is whole and its checksum is right.
        size: of the whole frame, in bytes.
    """

    frame: Frame
    data: bytes
    is_signed: bool
    is_known: bool
    is_proven: bool
    size: int


class Tap:
    """Receiver of all frames on a link: `open`, then `run` while the client is open, then `close`."""

    async def open(self) -> None:
        """Prepare to receive.

        Raises:
            UsageError: it cannot receive.
        """

    def received(self, frames: Sequence[SeenFrame], size: int, peer: Hashable) -> None:
        """Take the frames that a received chunk of this size completes. Neither blocks nor raises."""

    def sent(self, frame: bytes) -> None:
        """Take a frame that is passed to the link. Neither blocks nor raises."""

    async def run(self) -> None:
        """Work in the background, until cancelled."""

    async def close(self) -> None:
        """Process the remaining frames and release what `open` has taken."""


class FrameCutter:
    """Cuts received bytes into whole frames, and accounts for each other byte.

    Bytes between two proven frames are classified from their beginning: a whole frame with a known id has a
    wrong checksum; one with an unknown id counts as a frame when another one, or the end, follows directly;
    anything else is other bytes.

    Args:
        stream: whether a frame may be spread over several chunks of a peer.

    Attributes:
        damaged: frames with a wrong checksum.
        other_bytes: bytes outside of frames.
    """

    def __init__(self, *, stream: bool) -> None:
        self.damaged = 0
        self.other_bytes = 0
        self._stream = stream
        self._undecided: dict[Hashable, tuple[bytes, int]] = {}  # and where the search goes on

    def cut(self, data: bytes, peer: Hashable) -> list[SeenFrame]:
        """Return the frames that a chunk completes, in order. An empty chunk ends the peer's stream."""
        is_final = not (self._stream and data)
        undecided, at = self._undecided.pop(peer, (b"", 0))
        data = undecided + data
        seen: list[SeenFrame] = []
        decided = 0
        while (found := find_magic(data, at)) is not None:
            at = found.start()
            each = _frame_at(data, at)
            if each.is_proven:
                seen += [*self._classified(data[decided:at]), each]
                decided = at = at + each.size
                continue
            has_header = len(data) - at >= _HEADER_LENGTH
            if not is_final and at + each.size > len(data) and (each.is_known or not has_header):
                break
            at += 1
        else:
            at = len(data)
        if is_final or at - decided > UNPROVEN_BYTES_MAX:
            seen += self._classified(data[decided:at])
            decided = at
        if decided < len(data):
            self._undecided[peer] = data[decided:], at - decided
            if len(self._undecided) > UNFINISHED_PEERS_MAX:
                del self._undecided[next(iter(self._undecided))]
        return seen

    @property
    def unfinished(self) -> list[Hashable]:
        """The peers with undecided bytes."""
        return list(self._undecided)

    def _classified(self, gap: bytes) -> Iterator[SeenFrame]:
        """Count the bytes between two proven frames; return the frames that nothing proves."""
        at = 0
        while (found := find_magic(gap, at)) is not None:
            start = found.start()
            self.other_bytes += start - at
            each = _frame_at(gap, start)
            at = start + each.size
            if each.is_known and at <= len(gap):
                self.damaged += 1
            elif at == len(gap) or gap[at : at + 1] in _MAGICS:
                yield each
            else:
                self.other_bytes += 1
                at = start + 1
        self.other_bytes += len(gap) - at


def _frame_at(data: bytes, at: int) -> SeenFrame:
    """Return the frame whose header begins there; one that is cut off is not proven."""
    head = data[at : at + _HEADER_LENGTH].ljust(_HEADER_LENGTH, b"\0")
    flags = 0
    if head[0] == _MAGIC_V1:
        size, sequence, system, component, number = head[1:6]
        payload_at, version = at + 6, 1
    else:
        size, flags, _, sequence, system, component = head[1:7]
        number = int.from_bytes(head[7:10], "little")
        payload_at, version = at + _HEADER_LENGTH, 2
    crc_at = payload_at + size
    end = crc_at + 2 + (SIGNATURE_LENGTH if flags else 0)
    crc = checksum(number, data[at + 1 : crc_at])
    is_known = crc is not None and flags in (0, _SIGNED)
    is_proven = is_known and end <= len(data) and crc == int.from_bytes(data[crc_at : crc_at + 2], "little")
    frame = Frame(number, system, component, sequence, data[payload_at:crc_at], version)
    return SeenFrame(frame, data[at:end], flags == _SIGNED, is_known, is_proven, end - at)


# The telemetry log

RECORDING_FLUSH_INTERVAL: Final = 0.25
"""Seconds between two writes to the file: a killed process loses the frames of at most this time."""
UNWRITTEN_BYTES_MAX: Final = 16 * 1024 * 1024
"""Maximum number of bytes queued for the disk: 10 seconds of a link with 100 Mbit/s, an hour of a radio. A
disk that falls further behind does not catch up, and the limit bounds memory."""

logger = logging.getLogger(__name__)


class Capture(Tap):
    """Writes a `.tlog`: each frame follows its time, eight bytes, big-endian, in unix microseconds.

    The file has complete frames of both directions, without signatures, in the order in which the client read
    and sent them. The time is that of the read, up to 20 ms after the arrival. Damaged frames, other bytes,
    and messages with a signing key are omitted.

    A write error ends the capture with a warning in the log and has no other effect. The file then ends with
    a complete frame.

    Args:
        path: file to create.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)
        self._file: FileIO | None = None
        self._unwritten = bytearray()
        self._has_failed = False

    async def open(self) -> None:
        """Create the file.

        Raises:
            UsageError: the file exists, or cannot be created.
        """
        try:
            self._file = await anyio.to_thread.run_sync(FileIO, self._path, "x")
        except OSError as error:
            problem = f"cannot be created: {error.strerror}"
            if isinstance(error, FileExistsError):
                problem = "exists and is not overwritten; name another file"
            raise UsageError(f"the log {self._path} {problem}") from error

    def received(self, frames: Sequence[SeenFrame], size: int, peer: Hashable) -> None:
        """Queue received frames."""
        for each in frames:
            self.sent(each.data)

    def sent(self, frame: bytes) -> None:
        """Queue a frame."""
        if self._has_failed or bears_key(frame):
            return
        self._unwritten += packed_time(time.time()) + unsign_frame(frame)
        if len(self._unwritten) > UNWRITTEN_BYTES_MAX:
            self._fail("the disk is slower than the link")

    async def run(self) -> None:
        """Write the queued frames in batches, until cancelled or a write error."""
        while not self._has_failed:
            await anyio.sleep(RECORDING_FLUSH_INTERVAL)
            await self._flush()

    async def close(self) -> None:
        """Write the queued frames and close the file."""
        try:
            await self._flush()
        finally:
            if self._file is not None:
                await anyio.to_thread.run_sync(self._file.close)

    async def _flush(self) -> None:
        batch, self._unwritten = self._unwritten, bytearray()
        if self._has_failed or self._file is None or not batch:
            return
        try:
            with anyio.CancelScope(shield=True):  # the batch is no longer queued
                await anyio.to_thread.run_sync(_write, self._file, batch)
        except OSError as error:
            self._fail(error.strerror or str(error))

    def _fail(self, why: str) -> None:
        self._has_failed = True
        self._unwritten.clear()
        logger.warning("the telemetry log %s ends here: %s", self._path, why)


def _write(file: FileIO, data: bytearray) -> None:
    """Write a batch. After an error, truncate the file to its last complete batch.

    Raises:
        OSError: the batch cannot be written.
    """
    whole = file.tell()
    try:
        while data:
            data = data[file.write(data) :]
    except OSError:
        file.truncate(whole)
        raise


# Traffic

RATE_SLICES: Final = 10
"""Slices over which recent rates and losses are measured, 5 s: several heartbeats, and short enough to adjust
an antenna."""
RATE_SLICE: Final = 0.5
"""Seconds of a slice."""
RATE_TIME_MIN: Final = 1.0
"""Seconds, at least, over which a rate is computed."""
RADIO_STATUS_IDS: Final = frozenset({109, 166})
"""RADIO_STATUS, and RADIO from older firmware of SiK radios; both have the same layout."""

RADIO_STATUS_FIELDS: Final = ("errors", "fixed", "rssi", "remote_rssi", "free", "noise", "remote_noise")
"""Its fields, in a radio's own units (SiK: 0 to 254, about half a dB each): packets with errors and
corrected ones; signal and noise at this end, and at the other; the free percentage of the transmit buffer."""

_RADIO_STATUS = struct.Struct("<HHBBBBB")
_What: TypeAlias = str | int  # a number is a message id


@dataclass(slots=True)
class ComponentTraffic:
    """The traffic of one component. Times are of the event loop's clock.

    Attributes:
        system, component: its address.
        version: the MAVLink version of its last frame, 1 or 2.
        received_at: time of its last frame.
        heartbeat, heartbeat_at: its last HEARTBEAT and the time of it, or None.
        radio: the last status of a telemetry radio, by the names in `RADIO_STATUS_FIELDS`; None of others.
        totals: since the link was opened: `frames`, `bytes`, `signed` (frames with a signature, which is not
            verified), `lost` (by the gaps in the sequence numbers, see `SequenceCheck`), `repeated`, `late`
            (received after a later frame); and frames by message id.
        rates: the same per second.
    """

    system: int
    component: int
    version: int = 1
    received_at: float = 0.0
    heartbeat: Heartbeat | None = None
    heartbeat_at: float | None = None
    radio: Mapping[str, int] | None = None
    totals: Counter[_What] = field(default_factory=Counter)
    rates: Mapping[_What, float] = field(default_factory=dict)

    @property
    def messages(self) -> list[int]:
        """Ids of its messages, the most frequent one first."""
        ids = [what for what in self.totals if isinstance(what, int)]
        return sorted(ids, key=lambda each: (-self.rates[each], -self.totals[each], each))

    @property
    def loss(self) -> float | None:
        """The share of its frames that was lost, 0 to 1; None without frames."""
        received, lost = self.rates["frames"] - self.rates["repeated"], max(self.rates["lost"], 0.0)
        return lost / (received + lost) if received > 0 else None


@dataclass(frozen=True, slots=True)
class TrafficReport:
    """The traffic of a link.

    Attributes:
        at: when it was made, by the event loop's clock.
        seconds: the observed time.
        components: by address.
        totals: since the link was opened: `received` and `sent` bytes, whole `frames` received, and those of
            them with an `unknown` id.
        rates: the same per second.
        damaged: frames with a wrong checksum.
        other_bytes: received bytes outside of frames.
    """

    at: float
    seconds: float
    components: tuple[ComponentTraffic, ...]
    totals: Counter[_What]
    rates: Mapping[_What, float]
    damaged: int
    other_bytes: int


class Traffic(Tap):
    """Counts all traffic of a link, as a tap; on request only: an ordinary client does without."""

    def __init__(self) -> None:
        self._began = 0.0
        self._counts: Counter[tuple[Address | None, _What]] = Counter()  # None: of the link
        self._components: dict[Address, ComponentTraffic] = {}
        self._checks: defaultdict[Hashable, SequenceCheck] = defaultdict(SequenceCheck)  # by address and peer
        # the counts before each of the last slices in which something was counted
        self._before: deque[tuple[int, Counter[tuple[Address | None, _What]]]] = deque(maxlen=RATE_SLICES)

    async def open(self) -> None:
        """Begin to observe."""
        self._began = anyio.current_time()

    def received(self, frames: Sequence[SeenFrame], size: int, peer: Hashable) -> None:
        """Count a received chunk and its frames."""
        now = self._count(None, received=size, frames=len(frames))
        for seen in frames:
            frame = seen.frame
            address = (frame.system, frame.component)
            self._count(None, unknown=not seen.is_known)
            if not seen.is_known and address not in self._components:
                continue  # an address that no checksum proves does not count
            source = self._components.setdefault(address, ComponentTraffic(*address))
            source.received_at, source.version = now, frame.version
            check = self._checks[address, peer]
            lost, repeated, late = check.lost, check.repeated, check.late
            check.receive(frame.sequence, now)
            self._count(address, lost=check.lost - lost, repeated=check.repeated - repeated)
            self._count(address, late=check.late - late, frames=1, bytes=seen.size, signed=seen.is_signed)
            self._counts[address, frame.message_id] += 1
            if frame.message_id in RADIO_STATUS_IDS:
                status = _RADIO_STATUS.unpack_from(frame.payload.ljust(_RADIO_STATUS.size, b"\0"))
                source.radio = dict(zip(RADIO_STATUS_FIELDS, status, strict=True))
            elif seen.is_known and isinstance(message := decode(frame), Heartbeat):
                source.heartbeat, source.heartbeat_at = message, now

    def sent(self, frame: bytes) -> None:
        """Count a sent frame."""
        self._count(None, sent=len(frame))

    def report(self, now: float, cutter: FrameCutter, *, is_recent: bool) -> TrafficReport:
        """Return the present counts, and those of the cutter of the received data."""
        first = int(now / RATE_SLICE) - RATE_SLICES + 1 if is_recent else 0
        window = max(now - max(first * RATE_SLICE, self._began), RATE_TIME_MIN)
        slices = (counts for number, counts in self._before if number >= first)
        before = next(slices, self._counts) if is_recent else Counter[tuple[Address | None, _What]]()
        totals: defaultdict[Address | None, Counter[_What]] = defaultdict(Counter)
        rates: defaultdict[Address | None, defaultdict[_What, float]]
        rates = defaultdict(partial(defaultdict, float))
        for (whose, what), count in self._counts.items():
            totals[whose][what] = count
            rates[whose][what] = (count - before[whose, what]) / window
        return TrafficReport(
            at=now,
            seconds=now - self._began,
            components=tuple(
                replace(each, totals=totals[address], rates=rates[address])
                for address, each in sorted(self._components.items())
            ),
            totals=totals[None],
            rates=rates[None],
            damaged=cutter.damaged,
            other_bytes=cutter.other_bytes,
        )

    def _count(self, whose: Address | None, **increases: int) -> float:
        """Increase counts of a component or of the link. Return the time."""
        now = anyio.current_time()
        number = int(now / RATE_SLICE)
        if not self._before or self._before[-1][0] != number:
            self._before.append((number, self._counts.copy()))
        for what, increase in increases.items():
            self._counts[whose, what] += increase
        return now
