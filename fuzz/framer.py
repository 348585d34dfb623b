"""Fuzz target: both framers, compared with a simple reference framer."""

from __future__ import annotations

from typing import Final

from pymavlink.dialects.v20 import all as dialect
from pymavlink.generator.mavcrc import x25crc

from fuzz.draw import Draw
from paramclient.client.taps import FrameCutter
from paramclient.wire import messages
from paramclient.wire.frames import Frame, Framer, build_frame, checksum
from paramclient.wire.signing import Signer, SigningKey, SigningPolicy, Verifier

__all__ = ["INPUT_SIZE_MAX", "run"]

INPUT_SIZE_MAX: Final = 1024
"""Maximum bytes of an input: longer ones are slow and find nothing new."""

FRAME_SIZE_MAX = 280
"""Bytes of the longest frame: MAVLink 2 with a signature."""
IDS = (0, 2, 20, 21, 22, 23, 76, 77, 110, 148, 235, 253, 256, 345, 397, 1, 33, 12915)
"""Message ids of whole frames: those that the library decodes, and some others."""

EXTRAS = {number: message.crc_extra for number, message in dialect.mavlink_map.items()} | {397: 182}
KEY = SigningKey(bytes(range(32)))


def run(data: bytes) -> None:
    """Feed frames, parts of frames and noise in arbitrary chunks: each framer finds exactly the frames."""
    draw = Draw(data)
    chunks: list[bytes] = [b""]
    while not draw.is_over:
        piece, is_cut = _piece(draw)
        chunks[-1] += piece
        if is_cut:
            chunks.append(b"")
    _check_datagrams(chunks)
    _check_stream(chunks)
    _check_cutter(chunks)


def _check_datagrams(chunks: list[bytes]) -> None:
    framer, chosen, guarded = (Framer(ids, stream=False) for ids in (None, messages.DECODED_IDS, None))
    guarded.guard = Verifier(Signer(KEY, timestamp=0), SigningPolicy.ACCEPT_ALL).accepts
    for chunk in chunks:
        frames = _frames_of(chunk)
        before = framer.skipped
        assert framer.receive(chunk) == [frame for frame, _ in frames]
        assert framer.skipped - before == len(chunk) - sum(size for _, size in frames)
        assert guarded.receive(chunk) == [frame for frame, _ in frames]
        understood = [frame for frame, _ in frames if frame.message_id in messages.DECODED_IDS]
        assert chosen.receive(chunk) == understood
        for frame in understood:
            _check_codec(frame)


def _check_stream(chunks: list[bytes]) -> None:
    framer = Framer()
    found: list[Frame] = []
    for chunk in chunks:
        found += framer.receive(chunk)
        assert len(framer._tail) < FRAME_SIZE_MAX
    found += framer.flush()
    frames = _frames_of(b"".join(chunks))
    assert found == [frame for frame, _ in frames]
    assert framer.frames == len(frames)
    assert framer.skipped == sum(map(len, chunks)) - sum(size for _, size in frames)


def _check_cutter(chunks: list[bytes]) -> None:
    cutter = FrameCutter(stream=True)
    seen = []
    for chunk in (*filter(None, chunks), b""):
        seen += cutter.cut(chunk, "vehicle")
    assert not cutter.unfinished
    data = b"".join(chunks)
    # bytes that cannot be checked may count as a frame, but must not displace a verified frame
    proven = [each.frame for each in seen if each.is_known]
    assert proven == [frame for frame, _ in _frames_of(data)]
    assert sum(each.size for each in seen) + cutter.other_bytes <= len(data)


def _check_codec(frame: Frame) -> None:
    message = messages.decode(frame)
    assert message is not None
    options = {"system": frame.system, "component": frame.component, "sequence": frame.sequence}
    data = messages.encode(message, **options)
    (again,) = Framer(stream=False).receive(data)
    reported = messages.decode(again)
    assert reported is not None
    assert messages.encode(reported, **options) == data


def _frames_of(data: bytes) -> list[tuple[Frame, int]]:
    """Return the frames in complete data, each with its size: byte by byte, with pymavlink's CRC."""
    found = []
    at = 0
    while at < len(data):
        frame = _frame_at(data, at)
        if frame is not None:
            found.append(frame)
        at += 1 if frame is None else frame[1]
    return found


def _frame_at(data: bytes, at: int) -> tuple[Frame, int] | None:
    if data[at] == 0xFE and len(data) >= at + 8:
        size, sequence, system, component, number = data[at + 1 : at + 6]
        start, signature, version = at + 6, 0, 1
    elif data[at] == 0xFD and len(data) >= at + 12 and data[at + 2] in (0, 1):
        size, flags, _, sequence, system, component = data[at + 1 : at + 7]
        number = int.from_bytes(data[at + 7 : at + 10], "little")
        start, signature, version = at + 10, 13 * flags, 2
    else:
        return None
    end = start + size
    extra = EXTRAS.get(number)
    if extra is None or len(data) < end + 2 + signature:
        return None
    crc = x25crc(data[at + 1 : end])
    crc.accumulate(bytes((extra,)))
    if data[end : end + 2] != crc.crc.to_bytes(2, "little"):
        return None
    frame = Frame(number, system, component, sequence, data[start:end], version)
    return frame, end + 2 + signature - at


def _piece(draw: Draw) -> tuple[bytes, bool]:
    """Return the next piece of data, and whether a chunk ends after it."""
    kind = draw.number()
    is_cut = bool(kind & 0x80)
    match kind % 8:
        case 0 | 1:
            return draw.take(draw.number() % 40), is_cut
        case 2:
            return b"\xfd" + draw.take(draw.number() % 16), is_cut
        case 3:
            return b"\xfe" + draw.take(draw.number() % 16), is_cut
        case _ as much:
            return _damaged(_frame(draw), much, draw), is_cut


def _frame(draw: Draw) -> bytes:
    number = draw.one_of(IDS)
    version = 1 if number < 256 and draw.number() % 4 == 0 else 2
    payload = draw.take(draw.number() % 60)
    system, component, sequence = draw.take(3)
    return build_frame(
        number, payload, system=system, component=component, sequence=sequence, version=version
    )


def _damaged(frame: bytes, much: int, draw: Draw) -> bytes:
    """Return a frame unchanged, signed, truncated, or with one byte changed."""
    match much:
        case 5 if frame[0] == 0xFD:
            body = frame[1:2] + b"\x01" + frame[3:-2]
            number = int.from_bytes(frame[7:10], "little")
            crc = checksum(number, body)
            assert crc is not None
            return b"\xfd" + body + crc.to_bytes(2, "little") + draw.take(13)
        case 6:
            return frame[: draw.number() % len(frame)]
        case 7:
            at = draw.number() % len(frame)
            return frame[:at] + draw.take(1) + frame[at + 1 :]
    return frame
