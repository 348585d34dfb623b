"""Fuzz target: signed frames. Accepted and refused frames follow the rules of the MAVLink guide."""

from __future__ import annotations

import hashlib
from collections import Counter
from contextlib import suppress
from typing import Final

from fuzz.draw import Draw
from paramclient.errors import UsageError
from paramclient.wire.frames import Framer, build_frame, sign_frame, unsign_frame
from paramclient.wire.signing import (
    ADOPTED_TIMESTAMP_MAX,
    LAST_TIMESTAMP,
    Refusal,
    Signer,
    SigningKey,
    SigningPolicy,
    Verifier,
)

__all__ = ["INPUT_SIZE_MAX", "run"]

INPUT_SIZE_MAX: Final = 600
"""Maximum bytes of an input: longer ones are slow and find nothing new."""

SECRET: Final = bytes(range(32))
OTHER_SECRET: Final = bytes(range(1, 33))
STREAMS_MAX: Final = 4
MINUTE: Final = 60 * 100_000
IDS: Final = (0, 22, 109, 166, 253, 256)
LEAPS: Final = (1, 1, 2, 0, -1, 100_000, -MINUTE, -MINUTE - 1, MINUTE, 10**12, -(10**12), LAST_TIMESTAMP)
STARTS: Final = (36_000_000_000_000, 36_000_000_000_000, 0, ADOPTED_TIMESTAMP_MAX)


def run(data: bytes) -> None:
    """Receive frames of several senders: signed, unsigned, forged, truncated, repeated; send own frames."""
    with suppress(UsageError):
        key = SigningKey.from_text(data.decode("latin-1"))
        assert SigningKey.from_text(key.secret.hex()) == key
    session = _Session(Draw(data))
    while not session.draw.is_over:
        session.draw.one_of((session.hear, session.hear, session.hear, session.speak, session.wait))()
    session.check_report()


class _Session:
    def __init__(self, draw: Draw) -> None:
        self.draw = draw
        self.policy = draw.one_of(tuple(SigningPolicy))
        self.time = draw.one_of(STARTS)
        self.now = 0.0
        self.signer = Signer(SigningKey(SECRET), link_id=draw.number(), timestamp=self.time)
        self.verifier = Verifier(self.signer, self.policy, most_streams=STREAMS_MAX)
        self.framer = Framer(stream=False)
        self.framer.guard = self.verifier.accepts
        self.received: list[bytes] = []
        self.streams: dict[bytes, int] = {}
        self.refused: Counter[Refusal] = Counter()
        self.unproven: Counter[Refusal] = Counter()
        self.signed = 0
        self.unsigned = 0

    def hear(self) -> None:
        frame = self._frame()
        taken = self.framer.receive(frame)
        flaw = self._flaw(frame)
        is_taken = flaw is None or (self.policy is SigningPolicy.ACCEPT_ALL and flaw is not Refusal.TRUNCATED)
        assert len(taken) == is_taken
        if flaw is not None:
            (self.unproven if is_taken else self.refused)[flaw] += 1
        assert self.signer.timestamp == self.time

    def speak(self) -> None:
        if self.time == LAST_TIMESTAMP:
            return
        frame = sign_frame(self._unsigned(), self.signer)
        if frame[0] == 0xFD:
            self.time += 1
            assert frame[-12:-6] == self.time.to_bytes(6, "little")
            assert frame[-6:] == hashlib.sha256(SECRET + frame[:-6]).digest()[:6]
            assert len(Framer(stream=False).receive(frame)) == 1
            assert Framer(stream=False).receive(unsign_frame(frame)) == Framer(stream=False).receive(frame)
        assert self.signer.timestamp == self.time

    def wait(self) -> None:
        self.now += self.draw.number(3)
        before = self.signer.timestamp
        self.signer.advance(self.now)
        assert before <= self.signer.timestamp <= LAST_TIMESTAMP
        self.time = self.signer.timestamp

    def check_report(self) -> None:
        report = self.verifier.report()
        assert (report.signed, report.unsigned) == (self.signed, self.unsigned)
        assert (dict(report.refused), dict(report.unproven)) == (self.refused, self.unproven)
        reported = {
            bytes((each.system, each.component, each.link_id)): each.timestamp for each in report.streams
        }
        assert reported == self.streams
        assert len(reported) <= STREAMS_MAX

    def _flaw(self, frame: bytes) -> Refusal | None:
        """Return why the rules refuse a frame, or None; record the timestamp of an accepted one."""
        if frame[0] == 0xFE or not frame[2]:
            number = frame[5] if frame[0] == 0xFE else int.from_bytes(frame[7:10], "little")
            if self.policy is SigningPolicy.SIGNED_ONLY or (
                self.policy is SigningPolicy.UNSIGNED_RADIOS and number not in (109, 166)
            ):
                return Refusal.UNSIGNED
            self.unsigned += 1
            return None
        if len(frame) < 12 + frame[1] + 13:
            return Refusal.TRUNCATED
        body, stream, timestamp = frame[:-6], frame[5:7] + frame[-13:-12], frame[-12:-6]
        if hashlib.sha256(SECRET + body).digest()[:6] != frame[-6:]:
            return Refusal.BAD_SIGNATURE
        when = int.from_bytes(timestamp, "little")
        if stream in self.streams:
            if when <= self.streams[stream]:
                return Refusal.REPLAYED
        elif when + MINUTE < self.time:
            return Refusal.OLD
        elif len(self.streams) == STREAMS_MAX:
            return Refusal.TOO_MANY_STREAMS
        self.streams[stream] = when
        self.time = max(self.time, min(when, ADOPTED_TIMESTAMP_MAX))
        self.signed += 1
        return None

    def _unsigned(self) -> bytes:
        draw = self.draw
        number, system, component = draw.one_of(IDS), draw.one_of((1, 2, 255)), draw.one_of((1, 190))
        version = 1 if number < 256 and draw.number() % 8 == 0 else 2
        payload = draw.take(draw.number() % 12)
        return build_frame(number, payload, system=system, component=component, sequence=0, version=version)

    def _frame(self) -> bytes:
        """Return a frame with a valid checksum."""
        draw = self.draw
        way = draw.number() % 8
        if way == 0 and self.received:
            return draw.one_of(self.received)
        frame = self._unsigned()
        if way == 1 or frame[0] == 0xFE:
            return frame
        timestamp = min(max(self.time + draw.one_of(LEAPS), 0), LAST_TIMESTAMP)
        secret = OTHER_SECRET if way == 2 else SECRET
        signer = Signer(SigningKey(secret), link_id=draw.number() % 3, timestamp=timestamp - 1)
        frame = sign_frame(frame, signer)
        self.received.append(frame)
        if way == 3:
            return frame[: -1 - draw.number() % 13]
        if way == 4:
            at = len(frame) - 1 - draw.number() % 13
            return frame[:at] + draw.take(1) + frame[at + 1 :]
        return frame
