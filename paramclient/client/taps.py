"""Taps: receivers of all frames of a link, which one cutter finds in its bytes.

`Framer` returns proven frames of known messages and skips everything else as fast as it can. Here everything
counts, and speed does not matter: this runs only for the receivers of all frames of a link.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator, Sequence
from typing import Final, NamedTuple

from paramclient.wire.frames import Frame, checksum
from paramclient.wire.signing import SIGNATURE_LENGTH

UNPROVEN_BYTES_MAX: Final = 4096
"""Bytes of a stream without a proven frame that are kept until the following ones arrive."""
UNFINISHED_PEERS_MAX: Final = 256
"""Peers of a stream with undecided bytes."""

_MAGIC_V1 = 0xFE
_MAGICS = (b"\xfd", b"\xfe")
_MAGIC = re.compile(b"[\xfd\xfe]").search
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
        self._undecided: dict[Hashable, bytes] = {}

    def cut(self, data: bytes, peer: Hashable) -> list[SeenFrame]:
        """Return the frames that a chunk completes, in order. An empty chunk ends the peer's stream."""
        is_final = not (self._stream and data)
        data = self._undecided.pop(peer, b"") + data
        seen: list[SeenFrame] = []
        decided = at = 0
        while (found := _MAGIC(data, at)) is not None:
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
            self._undecided[peer] = data[decided:]
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
        while (found := _MAGIC(gap, at)) is not None:
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
