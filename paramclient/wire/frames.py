"""Framing of every message of the dialect, on raw bytes: frames from and to bytes, checksums.

pymavlink provides the CRC_EXTRA byte of every message of its `all` dialect, and the names of messages and
enums. Most frames on a link need no decoding, so framing makes no objects of unwanted ones.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Collection
from typing import Final, NamedTuple

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

from paramclient.wire.signing import SIGNATURE_LENGTH, Signer

_MAGIC_V1 = 0xFE
_MAGIC_V2 = 0xFD
_SIGNED = 0x01
_START = struct.Struct("<BBBxBBB3s").unpack_from  # a header of MAVLink 2; version 1 shares two bytes
_CRC_AT = struct.Struct("<H").unpack_from
_HEADER_LENGTH = 10  # of MAVLink 2
_PADDING = bytes(_HEADER_LENGTH)  # behind the data: a header can be read at its last byte
_new = tuple.__new__  # the constructor of a named tuple ends in this call and takes twice as long
_SETUP_SIGNING = (256).to_bytes(3, "little")
_NO_KEY = b""  # of no message

find_magic: Final = re.compile(rb"\xfd(?:.?\Z|.[\0\1])|\xfe", re.DOTALL).search
"""Finds the next byte with which a frame can begin: MAVLink 2 defines one flag, for a signature."""


class Frame(NamedTuple):
    """One frame with a valid checksum. A named tuple, as its creation is part of the hot path.

    Attributes:
        message_id: 24 bits.
        system, component: the sender.
        sequence: 0 to 255.
        payload: as sent; MAVLink 2 cuts trailing zero bytes.
        version: 1 or 2.
    """

    message_id: int
    system: int
    component: int
    sequence: int
    payload: bytes
    version: int


class Framer:
    """Finds the frames in received bytes.

    Every frame with a known message id is checked by its CRC; one with an unknown id cannot be checked and is
    skipped. A rejected candidate is retried from its second byte, so that no noise can hide a frame that
    stands whole outside a longer valid one. The 13 bytes behind the checksum of a signed frame count as its
    signature without a check; the guard verifies them.

    Args:
        message_ids: those to return; None for every known one. Frames with other ids are still checked
            and skipped, but no object is made of them.
        occasional: further ids, returned only while `takes_occasional` is set.
        stream: whether a frame may be spread over several calls (TCP, serial). Datagrams are processed one by
            one and never joined.

    Attributes:
        frames: whole frames, of every id.
        skipped: bytes outside of these.
        damaged: candidates with a known id and a wrong checksum.
    """

    def __init__(
        self,
        message_ids: Collection[int] | None = None,
        *,
        occasional: Collection[int] = (),
        stream: bool = True,
    ) -> None:
        self._usual = _by_id_bytes(_CRC_EXTRA if message_ids is None else message_ids)
        self._all = self._usual | _by_id_bytes(occasional)
        self._numbers = self._usual
        self._number_of = self._numbers.get
        self._guard: Callable[[bytes], bool] | None = None
        self._stream = stream
        self._tail = b""
        self.frames = 0
        self.skipped = 0
        self.damaged = 0

    @property
    def guard(self) -> Callable[[bytes], bool] | None:
        """Called with the bytes of every frame, of every id; returns whether to accept it. None: accept
        all.

        Also called for a signed frame with a truncated signature, which is skipped in any case.
        """
        return self._guard

    @guard.setter
    def guard(self, guard: Callable[[bytes], bool] | None) -> None:
        self._guard = guard
        self._choose()

    @property
    def takes_occasional(self) -> bool:
        """Whether frames with the occasional ids are returned too. The choice costs nothing per frame."""
        return self._numbers is self._all

    @takes_occasional.setter
    def takes_occasional(self, takes: bool) -> None:
        self._numbers = self._all if takes else self._usual
        self._choose()

    def _choose(self) -> None:
        # with a guard, no frame takes the fast path, so that the guard costs nothing where there is none
        self._number_of = self._numbers.get if self._guard is None else _NO_NUMBERS.get

    def receive(self, data: bytes, *, final: bool = False) -> list[Frame]:
        """Process received bytes and return the frames that are complete now, in order.

        Of a stream, at most one unfinished frame (less than 280 bytes) is kept between calls. Where `data` is
        final, as datagrams always are, nothing completes such a candidate, and it is skipped like any
        rejected one. The loop is the hot path of the library: about ten operations for each frame, none for
        each byte.
        """
        if self._tail:
            data = self._tail + data
        may_go_on = self._stream and not final
        found: list[Frame] = []
        number_of = self._number_of
        extra_of = _EXTRA_BY_ID_BYTES.get
        length = len(data)
        last_header_at = length - _HEADER_LENGTH
        good = 0
        skipped = 0
        at = 0
        while at < length:
            if at > last_header_at:
                data += _PADDING
                last_header_at = length
            magic, size, flags, sequence, system, component, key = _START(data, at)
            if magic == _MAGIC_V2:
                crc_at = at + 10 + size
                end = crc_at + 2
                if flags:
                    end += SIGNATURE_LENGTH
                    if flags != _SIGNED:
                        key = _NO_KEY  # a format that is not defined yet
            elif magic == _MAGIC_V1:
                crc_at = at + 6 + size
                end = crc_at + 2
                key = data[at + 5 : at + 6] + b"\0\0"
            else:
                crc_at = end = at
                key = _NO_KEY
            extra = extra_of(key)
            if end > length:
                header_is_cut = crc_at - size > length
                if may_go_on and (header_is_cut or extra is not None):
                    break
                if self._guard is not None and extra is not None:
                    self._show_if_cut_off(data[at:length], crc_at - at, extra)
            elif extra is not None and _CRC_AT(data, crc_at)[0] == mcrf4xx(data[at + 1 : crc_at] + extra):
                good += 1
                number = number_of(key)
                if number is not None:
                    if magic == _MAGIC_V2:
                        payload = data[at + 10 : crc_at]
                        found.append(_new(Frame, (number, system, component, sequence, payload, 2)))
                    else:
                        sequence, system, component = data[at + 2 : at + 5]
                        payload = data[at + 6 : crc_at]
                        found.append(Frame(number, system, component, sequence, payload, 1))
                elif self._guard is not None and self._guard(data[at:end]):
                    number = self._numbers.get(key)
                    if number is not None:
                        found.append(_frame_of(number, data[at:crc_at]))
                at = end
                continue
            if extra is not None and end <= length:
                self.damaged += 1
            candidate = find_magic(data, at + 1)
            next_at = candidate.start() if candidate else length
            skipped += next_at - at
            at = next_at
        self.frames += good
        if skipped:
            self.skipped += skipped
        self._tail = data[at:length]
        return found

    def flush(self) -> list[Frame]:
        """Return the frames behind the unfinished candidate: the stream has ended or was interrupted."""
        return self.receive(b"", final=True)

    def _show_if_cut_off(self, data: bytes, crc_at: int, extra: bytes) -> None:
        """Call the guard with a frame that lacks only a part of its signature."""
        is_proven = crc_at + 2 <= len(data) and _CRC_AT(data, crc_at)[0] == mcrf4xx(data[1:crc_at] + extra)
        if self._guard is not None and is_proven:
            self._guard(data)


def frame_size(data: bytes, at: int) -> int | None:
    """Return the size of the frame at a position, 0 for no frame, None if the end cuts off its header."""
    if at + 3 > len(data):
        return None
    if data[at] == _MAGIC_V1:
        return 8 + data[at + 1]
    if data[at] == _MAGIC_V2 and data[at + 2] <= _SIGNED:
        return 12 + data[at + 1] + (SIGNATURE_LENGTH if data[at + 2] else 0)
    return 0


def _flagged(frame: bytes, flags: int) -> bytes:
    """Return a frame of MAVLink 2 with these flags and a new checksum; it is passed without a checksum."""
    body = frame[1:2] + bytes((flags,)) + frame[3:]
    crc: int = mcrf4xx(body + _EXTRA_BY_ID_BYTES[frame[7:10]])
    return frame[:1] + body + crc.to_bytes(2, "little")


def build_frame(
    message_id: int, payload: bytes, *, system: int, component: int, sequence: int, version: int = 2
) -> bytes:
    """Build a frame from a payload: for messages without a class here, with any id of the dialect.

    MAVLink 2 drops the payload's trailing zeros. The other arguments are those of `encode`.
    """
    if version == 1:
        body = bytes((len(payload), sequence, system, component, message_id)) + payload
        magic = b"\xfe"
    else:
        payload = payload.rstrip(b"\0") or b"\0"
        head = bytes((len(payload), 0, 0, sequence, system, component))
        body = head + message_id.to_bytes(3, "little") + payload
        magic = b"\xfd"
    crc: int = mcrf4xx(body + bytes((_CRC_EXTRA[message_id],)))
    return magic + body + crc.to_bytes(2, "little")


def sign_frame(frame: bytes, signer: Signer) -> bytes:
    """Return the frame with a signature; a frame of MAVLink 1, which has no place for one, unchanged."""
    if frame[0] != _MAGIC_V2:
        return frame
    return signer.sign(_flagged(frame[:-2], _SIGNED))


def unsign_frame(frame: bytes) -> bytes:
    """Return the frame without its signature; one with an id outside the dialect unchanged.

    The guide to message signing requires that for logs: many signatures help to find the key.
    """
    if frame[0] != _MAGIC_V2 or frame[2] != _SIGNED or frame[7:10] not in _EXTRA_BY_ID_BYTES:
        return frame
    return _flagged(frame[: -2 - SIGNATURE_LENGTH], 0)


def renumber_frame(frame: bytes, sequence: int) -> bytes:
    """Return the frame with another sequence number, also one with an id outside the dialect.

    The checksum is linear: it changes by that of the difference alone, so that the CRC_EXTRA, which is the
    last byte of the checksum's input, need not be known.
    """
    at, payload_at = (4, _HEADER_LENGTH) if frame[0] == _MAGIC_V2 else (2, 6)
    if frame[at] == sequence:
        return frame
    crc_at = payload_at + frame[1]
    difference = bytes((frame[at] ^ sequence,)) + bytes(crc_at - at)
    crc: int = _CRC_AT(frame, crc_at)[0] ^ mcrf4xx(difference, 0)
    body = frame[:at] + bytes((sequence,)) + frame[at + 1 : crc_at]
    return body + crc.to_bytes(2, "little") + frame[crc_at + 2 :]


def bears_key(frame: bytes) -> bool:
    """Return whether it is a SETUP_SIGNING, with a key in clear: the guide requires not to log or forward
    it."""
    return frame[0] == _MAGIC_V2 and frame[7:10] == _SETUP_SIGNING


def checksum(message_id: int, body: bytes) -> int | None:
    """Return the checksum of a frame's bytes between its first one and the checksum; None for an unknown
    id."""
    extra = _CRC_EXTRA.get(message_id)
    return None if extra is None else int(mcrf4xx(body + bytes((extra,))))


def message_name(message_id: int) -> str:
    """Return `HEARTBEAT` for 0, and so on; `UNKNOWN_4711` for an id outside the dialect."""
    known = dialect.mavlink_map.get(message_id)
    return _MISSING_NAMES.get(message_id, f"UNKNOWN_{message_id}") if known is None else str(known.msgname)


def enum_word(enum: str, number: int) -> str:
    """Return a value of an enum of the dialect as text: of MAV_TYPE, `fixed wing` for 1, and `type 250`."""
    entry = dialect.enums[enum].get(number)
    if entry is None or entry.name == f"{enum}_ENUM_END":  # which is no value
        return f"{enum.removeprefix('MAV_').lower()} {number}"
    return str(entry.name.removeprefix(f"{enum}_").lower().replace("_", " "))


def _by_id_bytes(ids: Collection[int]) -> dict[bytes, int]:
    """Return message ids by their three bytes in a header of MAVLink 2."""
    return {number.to_bytes(3, "little"): number for number in ids}


def _offsets_of(field: str) -> dict[int, int]:
    """Return the offset of a field in the payload, for each message that has it."""
    offsets = {}
    for number, message in dialect.mavlink_map.items():
        names = message.ordered_fieldnames
        if field in names:
            types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
            lengths = dict(zip(names, message.array_lengths, strict=True))
            before = names[: names.index(field)]
            offsets[number] = sum(_SIZES[types[name]] * max(1, lengths[name]) for name in before)
    return offsets


def _frame_of(number: int, data: bytes) -> Frame:
    """Return the frame in its bytes from the first one to the checksum."""
    if data[0] == _MAGIC_V2:
        return Frame(number, data[5], data[6], data[4], data[10:], 2)
    return Frame(number, data[3], data[4], data[2], data[6:], 1)


_NO_NUMBERS: dict[bytes, int] = {}
# in MAVLink's common set, which pymavlink 2.4.50 has without its unfinished messages
_MISSING_NAMES = {397: "COMPONENT_METADATA"}
_MISSING_EXTRA = {397: 182}
_CRC_EXTRA: dict[int, int] = _MISSING_EXTRA | {
    number: message.crc_extra for number, message in dialect.mavlink_map.items()
}
_EXTRA_BY_ID_BYTES = {number.to_bytes(3, "little"): bytes((extra,)) for number, extra in _CRC_EXTRA.items()}
_SIZES = {
    "char": 1,
    "int8_t": 1,
    "uint8_t": 1,
    "uint8_t_mavlink_version": 1,
    "int16_t": 2,
    "uint16_t": 2,
    "int32_t": 4,
    "uint32_t": 4,
    "float": 4,
    "int64_t": 8,
    "uint64_t": 8,
    "double": 8,
}
_OTHER_CLOCKS = frozenset({251, 252, 254, 257, 263, 11060})
"""Messages whose `time_boot_ms` is not the sender's clock at the moment of sending: NAMED_VALUE_FLOAT,
NAMED_VALUE_INT, DEBUG and NAMED_VALUE_STRING have the time of an application, BUTTON_CHANGE and
CAMERA_IMAGE_CAPTURED that of an earlier event, and are repeated."""

TARGET_OFFSETS: Final = _offsets_of("target_system")
"""The offset of `target_system` in the payload, by message id. A payload that is cut before it has 0."""

BOOT_CLOCK_OFFSETS: Final = {
    number: at
    for number, at in _offsets_of("time_boot_ms").items()
    if number not in TARGET_OFFSETS and number not in _OTHER_CLOCKS
}
"""The offset of the 4 bytes of `time_boot_ms` in the payload, by message id. Messages with a target are
requests to a vehicle, with the time of another program, and are left out. SYSTEM_TIME is included."""
