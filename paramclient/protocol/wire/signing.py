"""Signatures of MAVLink 2: made for what is sent, checked with their timestamps in what comes.

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

__all__ = [
    "Refusal",
    "Signer",
    "SigningKey",
    "SigningPolicy",
    "SigningReport",
    "SigningStream",
    "Verifier",
    "timestamp_of",
]

KEY_LENGTH: Final = 32
SIGNATURE_LENGTH: Final = 13
"""Bytes behind the checksum: link id, timestamp (6), signature (6)."""
UNITS: Final = 100_000
"""Of the timestamp in a second: it counts 10 microseconds."""
EPOCH: Final = 1_420_070_400
"""Unix time at which it begins: 2015-01-01 UTC."""
LAST_TIMESTAMP: Final = 2**48 - 1
MOST_BEHIND: Final = 60 * UNITS
"""How far behind ours the timestamp of a stream's first frame may be: one minute."""
MOST_AHEAD: Final = LAST_TIMESTAMP - 24 * 60 * 60 * UNITS
"""The highest timestamp that is taken over from others: behind it a day is left to be signed."""
MOST_STREAMS: Final = 4_000
"""Streams whose timestamps are kept: a thousand components over a few links each. Only who has the key can
begin one. Further ones are refused: to forget one would open the way for its old frames."""

_MAGIC_V2 = 0xFD
_SIGNED = 0x01
_UNSIGNED_LENGTH = 12  # of a frame of MAVLink 2 without its payload
_RADIO_IDS = frozenset({109, 166})  # RADIO_STATUS, and RADIO as older SiK radios send it: they have no key


class SigningKey:
    """The 32 bytes that both ends of a signed link share. They are never shown, logged or pickled.

    Args:
        secret: 32 bytes, not all of them zero: that means no signing.

    Attributes:
        fingerprint: 16 hexadecimal digits that tell a key from others and do not give it away.

    Raises:
        UsageError: it is no such key. The text never repeats what was given.
    """

    __slots__ = ("_hash", "_secret", "fingerprint")

    def __init__(self, secret: bytes) -> None:
        if len(secret) != KEY_LENGTH:
            raise UsageError(f"a signing key has {KEY_LENGTH} bytes, not {len(secret)}")
        if not any(secret):
            raise UsageError("a signing key of zeros means no signing")
        self._secret = bytes(secret)
        self._hash = hashlib.sha256(self._secret)
        # begins otherwise than what is signed, so it is the signature of nothing
        self.fingerprint = hashlib.sha256(b"paramclient fingerprint\0" + self._secret).hexdigest()[:16]

    @classmethod
    def from_text(cls, text: str) -> SigningKey:
        """The key in 64 hexadecimal digits, or in base64 (44 characters), with or without space around."""
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
        """The SHA-256 of the text in UTF-8, as Mission Planner and MAVProxy make it."""
        if not passphrase:
            raise UsageError("an empty passphrase means no signing")
        return cls(hashlib.sha256(passphrase.encode()).digest())

    @property
    def secret(self) -> bytes:
        """The bytes themselves, for SETUP_SIGNING."""
        return self._secret

    def signature(self, signed: bytes) -> bytes:
        """The 6 bytes for a frame with its checksum, link id and timestamp."""
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


class SigningPolicy(StrEnum):
    """What is accepted of what comes, where there is a key."""

    SIGNED_ONLY = "signed-only"
    """Only what is rightly signed."""

    UNSIGNED_RADIOS = "unsigned-radios"
    """That, and RADIO_STATUS without a signature, which telemetry radios put in on the way."""

    ACCEPT_ALL = "accept-all"
    """Everything, wrongly signed frames too; what is wrong is counted. For links that nobody else reaches."""


class Refusal(StrEnum):
    """What is wrong with a frame."""

    UNSIGNED = "unsigned"
    """It has no signature, and the policy asks for one."""

    BAD_SIGNATURE = "bad signature"
    """The signature does not fit frame and key: another key, or a forgery."""

    REPLAYED = "replayed"
    """Its stream has had this timestamp or a later one: sent again, or overtaken on the way."""

    OLD = "old timestamp"
    """The first frame of its stream is more than a minute behind our timestamp."""

    TRUNCATED = "truncated"
    """A part of the signature is missing."""

    TOO_MANY_STREAMS = "too many streams"
    """There is no room for the timestamp of one more stream."""


@dataclass(frozen=True, slots=True)
class SigningStream:
    """One sender on one of its links, as its signed frames tell.

    Attributes:
        system, component, link_id: who it is.
        timestamp: of its last frame.
    """

    system: int
    component: int
    link_id: int
    timestamp: int


@dataclass(frozen=True, slots=True)
class SigningReport:
    """How the signatures on a link stand, since it was opened.

    Attributes:
        fingerprint: tells the key from others.
        link_id: with which our frames are signed.
        policy: what is accepted.
        timestamp: the last one that was signed, or heard of.
        signed: frames that came with a right signature.
        unsigned: frames without one that were accepted.
        unproven: frames that only `SigningPolicy.ACCEPT_ALL` let pass, by what is wrong with them.
        refused: frames that were refused, by the reason.
        streams: who signs.
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
    """Signs what is sent, with a timestamp that rises from frame to frame and with the time.

    Args:
        key: the key.
        link_id: which of our links this is, 0 to 255.
        timestamp: where it begins: the time of day, or the last one used with this key if that is higher.

    Attributes:
        key, link_id: as given.
        timestamp: the last one used, or heard of.
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
        """Let the timestamp follow the time, where frames have not brought it further already."""
        if self._started_at is None:
            self._started_at = now
        self.catch_up(self._start + int((now - self._started_at) * UNITS))

    def catch_up(self, timestamp: int) -> None:
        """Go on from another's timestamp, if that is later."""
        self.timestamp = max(self.timestamp, min(timestamp, MOST_AHEAD))

    def sign(self, frame: bytes) -> bytes:
        """The signature put to a frame of MAVLink 2 that ends in its checksum and has the flag set."""
        self.timestamp += 1
        signed = frame + self._link + self.timestamp.to_bytes(6, "little")
        return signed + self.key.signature(signed)


class Verifier:
    """Says of each frame that comes whether it may be believed.

    Args:
        signer: ours: its key is the one that counts, and its timestamp goes on from later ones that come.
        policy: what is accepted.
        most_streams: how many streams are followed.
    """

    def __init__(
        self,
        signer: Signer,
        policy: SigningPolicy = SigningPolicy.UNSIGNED_RADIOS,
        *,
        most_streams: int = MOST_STREAMS,
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
        """Whether a frame, its checksum proven, is to be taken; it may be one whose end is cut off."""
        flaw = self._flaw(frame)
        if flaw is None:
            return True
        is_accepted = self.policy is SigningPolicy.ACCEPT_ALL and flaw is not Refusal.TRUNCATED
        (self._unproven if is_accepted else self._refused)[flaw] += 1
        return is_accepted

    def report(self) -> SigningReport:
        """How it stands."""
        return SigningReport(
            fingerprint=self._signer.key.fingerprint,
            link_id=self._signer.link_id,
            policy=self.policy,
            timestamp=self._signer.timestamp,
            signed=self._signed,
            unsigned=self._unsigned,
            unproven=MappingProxyType(dict(self._unproven)),
            refused=MappingProxyType(dict(self._refused)),
            streams=tuple(SigningStream(*who, last) for who, last in sorted(self._streams.items())),
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
            if timestamp < signer.timestamp - MOST_BEHIND:
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
    """The timestamp of a moment; 0 before 2015, where a clock is not set."""
    return min(max(int((unix_time - EPOCH) * UNITS), 0), MOST_AHEAD)
