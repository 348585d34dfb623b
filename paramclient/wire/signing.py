"""Signatures of MAVLink 2: created for sent frames, verified with their timestamps in received ones.

The rules are those of the MAVLink guide, "Message Signing". A signature proves that the sender has the key
and that the frame is new; it hides nothing. MAVLink 1 has no place for one.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Final, NoReturn

from paramclient.errors import UsageError
from paramclient.model.names import NamedChoice

KEY_LENGTH: Final = 32
"""Bytes of a signing key."""
SIGNATURE_LENGTH: Final = 13
"""Bytes behind the checksum: link id, timestamp (6), signature (6)."""
UNITS_PER_SECOND: Final = 100_000
"""Units of the timestamp in a second: one is 10 microseconds."""
EPOCH: Final = 1_420_070_400
"""Unix time of timestamp 0: 2015-01-01 UTC."""
LAST_TIMESTAMP: Final = 2**48 - 1
"""The highest timestamp: it has 48 bits."""
TIMESTAMP_LAG_MAX: Final = 60 * UNITS_PER_SECOND
"""Units by which the timestamp of a stream's first frame may be behind ours: 1 minute."""
ADOPTED_TIMESTAMP_MAX: Final = LAST_TIMESTAMP - 24 * 60 * 60 * UNITS_PER_SECOND
"""The highest timestamp that is adopted from other senders: above it one day of signing is left."""
STREAMS_MAX: Final = 4_000
"""Streams with a timestamp: a thousand components over a few links each. Only a sender with the key can begin
one. Further ones are refused: a removed stream would accept its old frames again."""

_MAGIC_V2 = 0xFD
_SIGNED = 0x01
_UNSIGNED_LENGTH = 12  # of a frame of MAVLink 2 without its payload
_RADIO_IDS = frozenset({109, 166})  # RADIO_STATUS, and RADIO from older SiK radios: they have no key


class SigningKey:
    """The 32 bytes that both ends of a signed link share. They are never shown, logged or pickled.

    Args:
        secret: 32 bytes, not all of them zero: that means no signing.

    Attributes:
        fingerprint: 16 hexadecimal digits that identify a key without revealing it.

    Raises:
        UsageError: the key is invalid. The text never repeats the argument.
    """

    __slots__ = ("_hash", "_secret", "fingerprint")

    def __init__(self, secret: bytes) -> None:
        if len(secret) != KEY_LENGTH:
            raise UsageError(f"a signing key has {KEY_LENGTH} bytes, not {len(secret)}")
        if not any(secret):
            raise UsageError("a signing key of zeros means no signing")
        self._secret = bytes(secret)
        self._hash = hashlib.sha256(self._secret)
        # differs from signed data in its beginning, so it is no signature of a frame
        self.fingerprint = hashlib.sha256(b"paramclient fingerprint\0" + self._secret).hexdigest()[:16]

    @classmethod
    def from_text(cls, text: str) -> SigningKey:
        """Return the key in 64 hexadecimal digits, or in base64 (44 characters), with or without space
        around."""
        text = text.strip()
        secret = b""
        try:
            if len(text) == 2 * KEY_LENGTH:
                secret = bytes.fromhex(text)
            elif len(text) == 44:
                secret = base64.b64decode(text, validate=True)
        except (binascii.Error, ValueError):
            pass  # their texts may quote it
        if len(secret) != KEY_LENGTH:
            raise UsageError(
                f"a signing key in text is 64 hexadecimal digits or 44 characters of base64; these are "
                f"{len(text)} characters of something else"
            )
        return cls(secret)

    @classmethod
    def from_passphrase(cls, passphrase: str) -> SigningKey:
        """Return the key of a passphrase: its SHA-256 in UTF-8, as in Mission Planner and MAVProxy."""
        if not passphrase:
            raise UsageError("an empty passphrase means no signing")
        return cls(hashlib.sha256(passphrase.encode()).digest())

    @property
    def secret(self) -> bytes:
        """The 32 bytes, for SETUP_SIGNING."""
        return self._secret

    def signature(self, signed: bytes) -> bytes:
        """Return the 6 bytes for a frame with its checksum, link id and timestamp."""
        digest = self._hash.copy()
        digest.update(signed)
        return digest.digest()[:6]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SigningKey) and hmac.compare_digest(self._secret, other._secret)

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    def __repr__(self) -> str:
        return f"<SigningKey {self.fingerprint}>"

    def __copy__(self) -> SigningKey:
        return self

    def __deepcopy__(self, memo: object) -> SigningKey:
        return self

    def __reduce__(self) -> NoReturn:
        raise TypeError("a signing key is not pickled")


class SigningPolicy(NamedChoice):
    """The received frames that are accepted, where there is a key."""

    SIGNED_ONLY = "signed-only"
    """Frames with a valid signature only."""

    UNSIGNED_RADIOS = "unsigned-radios"
    """Also RADIO_STATUS without a signature, which telemetry radios insert."""

    ACCEPT_ALL = "accept-all"
    """All frames, also those with an invalid signature, which are counted. For links that no other sender can
    reach."""


class Refusal(StrEnum):
    """The reason to refuse a frame."""

    UNSIGNED = "unsigned"
    """It has no signature, and the policy requires one."""

    BAD_SIGNATURE = "bad signature"
    """The signature does not match frame and key: another key, or a forgery."""

    REPLAYED = "replayed"
    """Its stream has had this timestamp or a later one: a replayed or reordered frame."""

    OLD = "old timestamp"
    """The first frame of its stream is more than a minute behind our timestamp."""

    TRUNCATED = "truncated"
    """A part of the signature is missing."""

    TOO_MANY_STREAMS = "too many streams"
    """The limit of streams with a timestamp is reached."""


@dataclass(frozen=True, slots=True)
class SigningStream:
    """One sender on one of its links, by its signed frames.

    Attributes:
        system, component, link_id: its address and link.
        timestamp: of its last frame.
    """

    system: int
    component: int
    link_id: int
    timestamp: int


@dataclass(frozen=True, slots=True)
class SigningReport:
    """The signatures on a link since it was opened.

    Attributes:
        fingerprint: identifies the key.
        link_id: of our signatures.
        policy: the frames that are accepted.
        timestamp: the last one signed or received.
        signed: received frames with a valid signature.
        unsigned: accepted frames without one.
        unproven: frames accepted only by `SigningPolicy.ACCEPT_ALL`, by reason.
        refused: refused frames, by reason.
        streams: the signing senders.
    """

    fingerprint: str
    link_id: int
    policy: SigningPolicy
    timestamp: int
    signed: int
    unsigned: int
    unproven: Mapping[Refusal, int]
    refused: Mapping[Refusal, int]
    streams: tuple[SigningStream, ...]


class Signer:
    """Signs sent frames, with a timestamp that rises from frame to frame and with the time.

    Args:
        key: the key.
        link_id: the number of our link, 0 to 255.
        timestamp: the first one: the time of day, or the last one used with this key if that is higher.

    Attributes:
        key, link_id: as given.
        timestamp: the last one used or received.
    """

    def __init__(self, key: SigningKey, *, link_id: int = 0, timestamp: int) -> None:
        if not 0 <= link_id <= 255:
            raise UsageError(f"a link id is a number from 0 to 255, not {link_id}")
        self.key = key
        self.link_id = link_id
        self.timestamp = timestamp
        self._link = bytes((link_id,))
        self._start = timestamp
        self._started_at: float | None = None

    def advance(self, now: float) -> None:
        """Advance the timestamp with the time, unless frames have advanced it further."""
        if self._started_at is None:
            self._started_at = now
        self.catch_up(self._start + int((now - self._started_at) * UNITS_PER_SECOND))

    def catch_up(self, timestamp: int) -> None:
        """Adopt a received timestamp, if that is later."""
        self.timestamp = max(self.timestamp, min(timestamp, ADOPTED_TIMESTAMP_MAX))

    def sign(self, frame: bytes) -> bytes:
        """Return the signature of a frame of MAVLink 2 that ends in its checksum and has the flag set."""
        self.timestamp += 1
        signed = frame + self._link + self.timestamp.to_bytes(6, "little")
        return signed + self.key.signature(signed)


class Verifier:
    """Decides for each received frame whether to accept it.

    Args:
        signer: ours: its key is the valid one, and its timestamp adopts later received ones.
        policy: the frames that are accepted.
        most_streams: the number of streams that are followed.
    """

    def __init__(
        self,
        signer: Signer,
        policy: SigningPolicy = SigningPolicy.UNSIGNED_RADIOS,
        *,
        most_streams: int = STREAMS_MAX,
    ) -> None:
        self.policy = policy
        self._signer = signer
        self._most_streams = most_streams
        self._streams: dict[tuple[int, int, int], int] = {}
        self._signed = 0
        self._unsigned = 0
        self._unproven: Counter[Refusal] = Counter()
        self._refused: Counter[Refusal] = Counter()

    def accepts(self, frame: bytes) -> bool:
        """Return whether to accept a frame with a valid checksum; its signature may be truncated."""
        flaw = self._flaw(frame)
        if flaw is None:
            return True
        is_accepted = self.policy is SigningPolicy.ACCEPT_ALL and flaw is not Refusal.TRUNCATED
        (self._unproven if is_accepted else self._refused)[flaw] += 1
        return is_accepted

    def report(self) -> SigningReport:
        """Return the present counts."""
        return SigningReport(
            fingerprint=self._signer.key.fingerprint,
            link_id=self._signer.link_id,
            policy=self.policy,
            timestamp=self._signer.timestamp,
            signed=self._signed,
            unsigned=self._unsigned,
            unproven=MappingProxyType(dict(self._unproven)),
            refused=MappingProxyType(dict(self._refused)),
            streams=tuple(SigningStream(*key, last) for key, last in sorted(self._streams.items())),
        )

    def _flaw(self, frame: bytes) -> Refusal | None:
        if not (frame[0] == _MAGIC_V2 and frame[2] & _SIGNED):
            return self._flaw_of_unsigned(frame)
        if len(frame) < _UNSIGNED_LENGTH + frame[1] + SIGNATURE_LENGTH:
            return Refusal.TRUNCATED
        signer = self._signer
        if not hmac.compare_digest(signer.key.signature(frame[:-6]), frame[-6:]):
            return Refusal.BAD_SIGNATURE
        stream = (frame[5], frame[6], frame[-13])
        timestamp = int.from_bytes(frame[-12:-6], "little")
        last = self._streams.get(stream)
        if last is None:
            if timestamp < signer.timestamp - TIMESTAMP_LAG_MAX:
                return Refusal.OLD
            if len(self._streams) >= self._most_streams:
                return Refusal.TOO_MANY_STREAMS
        elif timestamp <= last:
            return Refusal.REPLAYED
        self._streams[stream] = timestamp
        self._signed += 1
        signer.catch_up(timestamp)
        return None

    def _flaw_of_unsigned(self, frame: bytes) -> Refusal | None:
        number = int.from_bytes(frame[7:10], "little") if frame[0] == _MAGIC_V2 else frame[5]
        is_radio = number in _RADIO_IDS and self.policy is SigningPolicy.UNSIGNED_RADIOS
        if is_radio or self.policy is SigningPolicy.ACCEPT_ALL:
            self._unsigned += 1
            return None
        return Refusal.UNSIGNED


def timestamp_of(unix_time: float) -> int:
    """Return the timestamp of a moment; 0 before 2015, as with a clock that is not set."""
    return min(max(int((unix_time - EPOCH) * UNITS_PER_SECOND), 0), ADOPTED_TIMESTAMP_MAX)
