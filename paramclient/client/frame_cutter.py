"""All bytes of a link, including unusable ones: frames, damaged frames, and other bytes.

`Framer` returns proven frames and skips everything else as fast as it can. Here everything counts, and speed
does not matter: this runs only where a user looks at the link itself.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Final, NamedTuple

from paramclient.wire.frames import bears_key, checksum

__all__ = ["FrameCutter", "SeenFrame", "Sniffer"]

UNPROVEN_BYTES_MAX: Final = 4096
"""Bytes of a stream without a proven frame that are kept until the following ones arrive."""
UNFINISHED_PEERS_MAX: Final = 256
"""Peers of a stream with an unfinished frame in a `FrameCutter`."""

_MAGIC_V1 = 0xFE
_MAGIC_V2 = 0xFD
_MAGIC = re.compile(b"[\xfd\xfe]").search
_SIGNED = 0x01
_SIGNATURE_LENGTH = 13


class SeenFrame(NamedTuple):
    """One frame.

    Attributes:
        message_id, system, component, sequence, payload, version: as in `Frame`.
        size: of the whole frame, in bytes.
        is_signed: whether it has a signature, which is not verified.
        is_known: false for an id outside the dialect, so that no checksum proves the frame.
        data: the bytes of the whole frame.
    """

    message_id: int
    system: int
    component: int
    sequence: int
    payload: bytes
    version: int
    size: int
    is_signed: bool
    is_known: bool
    data: bytes


class Sniffer:
    """Finds every frame in received bytes, and accounts for each other byte.

    Bytes between two proven frames are classified from their beginning: a whole frame with a known id has a
    wrong checksum; one with an unknown id counts as a frame when another one, or the end, follows directly;
    anything else is other bytes.

    Args:
        stream: whether a frame may be spread over several calls; see `Framer`.

    Attributes:
        damaged: frames with a wrong checksum.
        other_bytes: bytes outside of frames.
    """

    def __init__(self, *, stream: bool) -> None:
        self.damaged = 0
        self.other_bytes = 0
        self._stream = stream
        self._tail = b""

    def receive(self, data: bytes) -> list[SeenFrame]:
        """Process received bytes and return the frames that are decided by now, in order."""
        seen, rest = self._scan(self._tail + data, final=not self._stream)
        self._tail = rest
        return seen

    def flush(self) -> list[SeenFrame]:
        """Return the frames in the unfinished end: the stream has ended or was interrupted."""
        seen, self._tail = self._scan(self._tail, final=True)
        return seen

    def _scan(self, data: bytes, *, final: bool) -> tuple[list[SeenFrame], bytes]:
        """Return the frames in `data`, and the undecided bytes at its end."""
        seen: list[SeenFrame] = []
        explained = at = 0
        while (found := _MAGIC(data, at)) is not None:
            at = found.start()
            frame = _frame_at(data, at)
            if frame is None or at + frame.size > len(data):
                if not final and (frame is None or frame.is_known):
                    break
            elif frame.is_known and _is_proven(data, at, frame):
                seen += self._explain(data[explained:at])
                seen.append(frame)
                explained = at = at + frame.size
                continue
            at += 1
        else:
            at = len(data)
        if final or at - explained > UNPROVEN_BYTES_MAX:
            seen += self._explain(data[explained:at])
            explained = at
        return seen, data[explained:]

    def _explain(self, gap: bytes) -> list[SeenFrame]:
        """Classify the bytes between two proven frames; return the frames that nothing proves."""
        seen: list[SeenFrame] = []
        at = 0
        while at < len(gap):
            frame = _frame_at(gap, at)
            end = len(gap) + 1 if frame is None else at + frame.size
            if frame is not None and frame.is_known and end <= len(gap):
                self.damaged += 1
            elif frame is not None and (end == len(gap) or gap[end : end + 1] in _MAGICS):
                seen.append(frame)
            else:
                found = _MAGIC(gap, at + 1)
                end = len(gap) if found is None else found.start()
                self.other_bytes += end - at
            at = end
        return seen


class FrameCutter:
    """Cuts received bytes into whole frames, for programs that forward them unchanged.

    Left out are damaged frames, bytes outside of frames, and frames with a signing key.

    Args:
        stream: whether a frame may be spread over several calls.
    """

    def __init__(self, *, stream: bool) -> None:
        self._stream = stream
        self._sniffers: dict[Hashable, Sniffer] = {}

    def cut(self, data: bytes, peer: Hashable) -> list[bytes]:
        """Return the frames that a chunk completes, in order. An empty chunk means the end of the peer's
        stream."""
        if not data:
            sniffer = self._sniffers.pop(peer, None)
            return [] if sniffer is None else self._clean(sniffer.flush())
        key = peer if self._stream else None
        sniffer = self._sniffers.get(key)
        if sniffer is None:
            sniffer = self._sniffers[key] = Sniffer(stream=self._stream)
            if len(self._sniffers) > UNFINISHED_PEERS_MAX:
                del self._sniffers[next(iter(self._sniffers))]
        return self._clean(sniffer.receive(data))

    def flush(self) -> list[bytes]:
        """Return the frames in the unfinished ends: the link is down, or closed."""
        return [data for peer in list(self._sniffers) for data in self.cut(b"", peer)]

    def _clean(self, frames: list[SeenFrame]) -> list[bytes]:
        return [seen.data for seen in frames if not bears_key(seen.data)]


_MAGICS = (bytes((_MAGIC_V1,)), bytes((_MAGIC_V2,)))


def _frame_at(data: bytes, at: int) -> SeenFrame | None:
    """Return the frame by the header there, proven or not; None without one, or if it is cut off."""
    magic = data[at]
    if magic == _MAGIC_V1 and at + 6 <= len(data):
        size, sequence, system, component, message_id = data[at + 1 : at + 6]
        payload = data[at + 6 : at + 6 + size]
        known = checksum(message_id, b"") is not None
        whole = size + 8
        frame = data[at : at + whole]
        return SeenFrame(message_id, system, component, sequence, payload, 1, whole, False, known, frame)
    if magic == _MAGIC_V2 and at + 10 <= len(data):
        size, flags, _, sequence, system, component = data[at + 1 : at + 7]
        message_id = int.from_bytes(data[at + 7 : at + 10], "little")
        payload = data[at + 10 : at + 10 + size]
        whole = size + 12 + (_SIGNATURE_LENGTH if flags else 0)
        known = flags in (0, _SIGNED) and checksum(message_id, b"") is not None
        is_signed = flags == _SIGNED
        frame = data[at : at + whole]
        return SeenFrame(message_id, system, component, sequence, payload, 2, whole, is_signed, known, frame)
    return None


def _is_proven(data: bytes, at: int, frame: SeenFrame) -> bool:
    crc_at = at + frame.size - 2 - (_SIGNATURE_LENGTH if frame.is_signed else 0)
    return checksum(frame.message_id, data[at + 1 : crc_at]) == int.from_bytes(
        data[crc_at : crc_at + 2], "little"
    )
