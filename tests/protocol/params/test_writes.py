"""Writes, one message at a time: the type first, exactly that type, and proof by value."""

from __future__ import annotations

import math
import struct
from functools import partial

import pytest
from paramclient.protocol.params.reads import Reads
from paramclient.protocol.params.table import Table
from paramclient.protocol.params.writes import Write, Writes
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.retry import INITIAL_TIMEOUT, RetryPolicy

from paramclient.errors import (
    LinkError,
    NoReply,
    ParamErrorCode,
    Refused,
    TypeMismatch,
    UnknownParameter,
    UsageError,
    ValueNotApplied,
)
from paramclient.model.values import Encoding, ParamType, Trust, WireValue, decode_value
from paramclient.wire.messages import Message, ParamError, ParamRequestRead, ParamSet, ParamValue
from tests.simulation import is_so, known, param_value

INT32 = ParamType.INT32
NAN = struct.unpack("<f", b"\x01\x00\xc0\x7f")[0]


class Desk:
    """Writes to component 1/1, with the table and the reads that they need."""

    def __init__(self, encoding: Encoding = Encoding.BYTEWISE) -> None:
        self.now = 0.0
        self.encoding = encoding
        self.may_be_written = True
        self.sent: list[Message] = []
        self.table = Table(encoding)
        self.retry = RetryPolicy()
        self.round_trip = self.retry.round_trip
        self.context = Context((1, 1), self.sent.append, retry=self.retry)
        self.reads = Reads(self.context, self.table)
        self.reads.is_idle = False
        self.writes = Writes(self.context, self.reads, self.table, permission=self)

    def set(self, name: str, value: WireValue, author: str | None = None) -> Write:
        return self.writes.set(name, value, self.now, author)

    def hear(
        self, name: str, value: WireValue, kind: int = ParamType.REAL32, *, at: float | None = None
    ) -> None:
        self.now = self.now if at is None else at
        self.take_in(param_value(name, value, kind=kind, encoding=self.table.encoding))

    def take_in(self, message: ParamValue) -> None:
        self.table.store_value(message, "vehicle")
        self.writes.receive(message, self.now)
        self.reads.receive(message, self.now)

    def knows(self, name: str, value: WireValue, kind: int = ParamType.REAL32) -> None:
        """Receive a value first."""
        self.hear(name, value, kind)

    def pass_time(self, seconds: float = math.inf) -> None:
        """Go from deadline to deadline, so long or until nothing is left to do."""
        end = self.now + seconds
        for _ in range(10_000):
            deadline = min(self.reads.next_deadline(), self.writes.next_deadline())
            if deadline > end or deadline == math.inf:
                self.now = end if end < math.inf else self.now
                return
            self.now = max(deadline, self.now)
            self.reads.tick(self.now)
            self.writes.tick(self.now)
        raise AssertionError("it does not end")

    def take(self) -> list[str]:
        """What was sent, in short: `set NAME value TYPE`, `read NAME`, `read index`."""
        sent, self.sent[:] = list(self.sent), []
        return [self._short(message) for message in sent]

    def _short(self, message: Message) -> str:
        if isinstance(message, ParamSet):
            assert (message.target_system, message.target_component) == (1, 1)
            value, _ = decode_value(message.raw, message.param_type, self.table.encoding)
            return f"set {message.param_id} {value!r} {ParamType(message.param_type).name}"
        assert isinstance(message, ParamRequestRead)
        return f"read {message.param_id or message.param_index}"


# how it goes


def test_a_write_to_a_known_parameter() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    write = desk.set("A", 2.5)
    assert desk.take() == ["set A 2.5 REAL32"]
    desk.hear("A", 2.5, at=0.2)
    assert write.result is not None
    result = write.result
    assert (result.name, result.status, result.requested, result.actual) == ("A", "accepted", 2.5, 2.5)
    assert (result.adjusted, result.attempts, result.param) == (False, 1, desk.table.params["A"])
    assert str(result) == "A = 2.5"
    assert write.ended_at == 0.2
    assert desk.round_trip.smoothed == pytest.approx(0.2)
    assert len(desk.writes) == len(desk.reads) == 0
    assert desk.writes.next_deadline() == math.inf


def test_the_type_is_learnt_first() -> None:
    desk = Desk()
    write = desk.set("A", 5)
    assert desk.take() == ["read A"]
    assert desk.writes.author("A") is None
    desk.hear("A", 3, ParamType.INT16)
    assert desk.take() == ["set A 5 INT16"]
    assert desk.writes.author("A") == "us"
    desk.hear("A", 5, ParamType.INT16)
    assert write.result is not None
    assert write.result.param.type is ParamType.INT16


def test_a_cached_type_is_not_enough_but_a_verified_one_is() -> None:
    desk = Desk()
    desk.table.fill({"A": known("A", 1), "B": known("B", 1)})
    desk.table.confirm(5, frozenset("A"), proven=True)
    desk.table.verify()
    desk.set("A", 5)
    desk.set("B", 5)
    assert desk.take() == ["read A", "set B 5 INT32"]
    assert desk.table.params["B"].trust is Trust.VERIFIED


def test_nothing_is_sent_before_the_encoding_may_be_written() -> None:
    desk = Desk()
    desk.knows("A", 1, INT32)
    desk.may_be_written = False
    first, second = desk.set("A", 2), desk.set("B", 3)
    desk.pass_time(10.0)
    assert desk.take() == []
    desk.may_be_written = True
    desk.table.use_encoding(Encoding.C_CAST)
    desk.writes.proceed(desk.now)
    assert desk.take() == ["set A 2 INT32", "read B"]
    desk.writes.proceed(desk.now)
    assert desk.take() == []
    desk.hear("A", 2, INT32)
    assert first.done
    assert not second.done


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (ParamType.REAL32, 0.1),
        (ParamType.REAL32, math.inf),
        (ParamType.REAL32, NAN),
        (ParamType.INT32, -5_000_000),
        (ParamType.UINT8, 255),
        (ParamType.INT32, 7.0),
        (ParamType.INT32, b"\x01\x00\xa0\x7f"),
        (ParamType.INT64, b"\x01\x02\x03\x04"),
    ],
)
def test_values_that_are_taken_as_they_are(kind: ParamType, value: WireValue) -> None:
    desk = Desk()
    desk.take_in(ParamValue("A", bytes(4), kind, 10, 65535))
    write = desk.set("A", value)
    [message] = desk.sent
    assert isinstance(message, ParamSet)
    assert message.param_type == kind
    if isinstance(value, bytes):
        assert message.raw == value
    desk.take_in(ParamValue("A", message.raw, kind, 10, 65535))
    assert write.result is not None
    assert write.result.status == "accepted"


def test_the_number_of_raw_bytes_is_not_written_as_a_number() -> None:
    desk = Desk(Encoding.C_CAST)
    infinite = struct.pack("<f", math.inf)
    desk.take_in(ParamValue("A", infinite, ParamType.INT32, 10, 65535))
    held = desk.table.params["A"]
    assert (held.value, held.settable) == (0x7F800000, infinite)
    write = desk.set("A", held.value)
    assert isinstance(write.error, UsageError)
    assert "number of the raw bytes" in str(write.error)
    assert desk.sent == []
    desk.set("A", held.settable)
    [message] = desk.sent
    assert isinstance(message, ParamSet)
    assert message.raw == infinite


def test_ardupilot_cuts_off_the_fraction() -> None:
    desk = Desk(Encoding.C_CAST)
    desk.knows("A", 0, INT32)
    write = desk.set("A", 1234.7)
    [message] = desk.sent
    assert isinstance(message, ParamSet)
    assert struct.unpack("<f", message.raw)[0] == pytest.approx(1234.7)
    desk.hear("A", 1234, INT32)
    assert write.result is not None
    assert (write.result.status, write.result.requested, write.result.actual) == ("adjusted", 1234.7, 1234)
    assert str(write.result) == "A = 1234 (adjusted from 1234.7)"


# other values on the way


def test_an_old_value_passing_by_proves_nothing() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    desk.retry.answered(0.0, 0.1, 1)
    write = desk.set("A", 2.0)
    desk.hear("A", 1.0, at=0.01)
    assert not write.done
    desk.hear("A", 2.0, at=0.05)
    assert write.result is not None
    assert write.result.attempts == 1
    assert desk.take() == ["set A 2.0 REAL32"]


def test_a_lost_write_is_seen_by_a_read_and_sent_again() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    write = desk.set("A", 2.0)
    desk.hear("A", 1.0, at=0.1)  # requested by another station
    desk.pass_time(0.6)
    assert desk.take() == ["set A 2.0 REAL32", "read A"]
    desk.hear("A", 1.0)
    assert desk.take() == ["set A 2.0 REAL32"]
    desk.hear("A", 2.0)
    assert write.result is not None
    assert (write.result.status, write.result.attempts) == ("accepted", 2)


def test_a_write_without_an_answer_is_sent_again_after_the_time_out() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    desk.set("A", 2.0)
    desk.pass_time(2.2 * INITIAL_TIMEOUT)
    # after the third the vehicle may be silent on just this write
    assert desk.take() == ["set A 2.0 REAL32"] * 3 + ["read A"]


def test_a_value_that_the_vehicle_makes_of_it_twice_is_its_adjustment() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    write = desk.set("A", 900.0)
    for seconds in (0.6, 0.3):
        desk.hear("A", 100.0)
        desk.pass_time(seconds)
        desk.hear("A", 100.0)
    assert desk.take() == ["set A 900.0 REAL32", "read A"] * 2
    assert write.result is not None
    assert (write.result.status, write.result.actual, write.result.attempts) == ("adjusted", 100.0, 2)


def test_another_stations_value_is_not_taken_for_an_adjustment() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    write = desk.set("A", 3.0)  # is lost
    desk.hear("A", 2.0, at=0.1)  # another station has set it
    desk.pass_time(0.6)
    desk.hear("A", 2.0)
    assert not write.done
    assert desk.take() == ["set A 3.0 REAL32", "read A", "set A 3.0 REAL32"]
    desk.hear("A", 3.0)
    assert write.result is not None
    assert write.result.status == "accepted"


# how it fails


def silent(desk: Desk, write: Write, *, answering_reads: WireValue | None = None) -> Exception:
    """Let a vehicle be silent on writes to A; it may answer reads of it."""
    for _ in range(1000):
        if write.done:
            break
        desk.pass_time(0.01)
        if answering_reads is not None and "read A" in desk.take():
            desk.hear("A", answering_reads)
    assert write.error is not None
    assert len(desk.writes) == len(desk.reads) == 0
    return write.error


def test_without_any_answer_there_is_no_reply() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    write = desk.set("A", 2.0)
    desk.pass_time()
    assert isinstance(write.error, NoReply)
    assert write.error.awaited == "PARAM_SET A to 1/1"
    assert write.error.attempts == write.attempts == 3
    assert write.error.waited == pytest.approx(desk.now)


def test_a_vehicle_that_answers_every_write_with_the_old_value_does_not_apply_it() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    for _ in range(60):
        desk.retry.answered(0.0, 0.02, 1)
    write = desk.set("A", 2.0)
    while not write.done:
        if desk.take():
            desk.hear("A", 1.0)
        desk.pass_time(0.01)
    assert isinstance(write.error, ValueNotApplied)
    assert write.error.actual == 1.0


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (ParamErrorCode.READ_ONLY, Refused),
        (ParamErrorCode.VALUE_OUT_OF_RANGE, Refused),
        (99, Refused),
        (ParamErrorCode.TYPE_MISMATCH, TypeMismatch),
        (ParamErrorCode.DOES_NOT_EXIST, UnknownParameter),
    ],
)
@pytest.mark.parametrize("old_value", ["before", "after", "never"])
def test_a_refusal_with_a_reason(code: int, kind: type[Exception], old_value: str) -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    write = desk.set("A", 2.0)
    if old_value == "before":
        desk.hear("A", 1.0)
    assert desk.writes.refused(ParamError(255, 190, "A", -1, code), 0.1)
    if old_value == "after":
        desk.hear("A", 1.0)
    assert type(write.error) is kind
    assert desk.take() == ["set A 2.0 REAL32"]
    if isinstance(write.error, Refused):
        assert write.error.code == code
    desk.pass_time()
    assert desk.take() == []


@pytest.mark.parametrize("after_the_value", [False, True])
def test_ardupilots_text_is_a_refusal(after_the_value: bool) -> None:
    desk = Desk(Encoding.C_CAST)
    desk.knows("A", 1.0)
    write = desk.set("A", 2.0)
    desk.writes.denied("B", 0.0)
    if after_the_value:
        desk.hear("A", 1.0)
    desk.writes.denied("A", 0.1)
    if not after_the_value:
        desk.hear("A", 1.0)
    assert isinstance(write.error, Refused)
    assert write.error.code == ParamErrorCode.READ_ONLY
    assert write.error.reason == "read only"
    desk.writes.denied("A", 0.2)


def test_a_type_that_changes_twice_is_a_mismatch() -> None:
    desk = Desk()
    desk.knows("A", 1, INT32)
    write = desk.set("A", 5)
    desk.hear("A", 1.0, ParamType.REAL32)
    desk.hear("A", 1, ParamType.INT16)
    assert isinstance(write.error, TypeMismatch)
    assert "REAL32" in str(write.error)
    assert "INT16" in str(write.error)


# several


def test_writes_to_one_name_go_in_order_and_others_beside_them() -> None:
    desk = Desk()
    for name in "AB":
        desk.knows(name, 0.0)
    done: list[str] = []
    for name, value in (("A", 1.0), ("A", 2.0), ("B", 3.0)):
        desk.set(name, value).on_done.append(partial(done.append, f"{name}{value}"))
    assert desk.take() == ["set A 1.0 REAL32", "set B 3.0 REAL32"]
    assert len(desk.writes) == 2
    desk.hear("B", 3.0)
    desk.hear("A", 1.0)
    assert desk.take() == ["set A 2.0 REAL32"]
    desk.hear("A", 2.0)
    assert done == ["B3.0", "A1.0", "A2.0"]


# the link is lost and reconnected


def test_when_the_link_is_back_writes_are_sent_again() -> None:
    desk = Desk()
    for name in "AB":
        desk.knows(name, 0.0)
    write = desk.set("A", 1.0)
    desk.set("B", 1.0)
    desk.hear("B", 0.0)
    desk.pass_time(0.9)  # B is being read
    desk.set("C", 1.0)
    desk.take()
    desk.writes.resume(50.0)
    assert desk.take() == ["set A 1.0 REAL32"]
    assert write.attempts == 1


def test_when_the_link_is_gone_all_fail() -> None:
    desk = Desk()
    desk.knows("A", 0.0)
    error = LinkError("gone", link="x")
    writes = [desk.set("A", 1.0), desk.set("A", 2.0), desk.set("B", 1.0)]
    again: list[Write] = []
    writes[0].on_done.append(lambda: desk.writes.cancel(writes[1], desk.now))
    writes[0].on_done.append(lambda: again.append(desk.set("A", 9.0)))
    desk.writes.fail_all(error, 1.0)
    assert [write.error for write in writes] == [error] * 3
    assert [write.done for write in again] == [False]
    assert len(desk.writes) == 1
    assert len(desk.reads) == 0


# watched after the acknowledgement


def test_a_watched_value_is_read_once_more_and_then_the_write_ends() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    write = desk.writes.set("A", 80.0, desk.now, settle=1.2)
    desk.take()
    desk.hear("A", 80.0, at=0.1)
    assert not is_so(write.done)
    assert desk.writes.author("A") is None  # what changes now is not ours
    desk.pass_time(1.1)
    assert desk.take() == []
    desk.pass_time(0.2)
    assert desk.take() == ["read A"]
    desk.hear("A", 80.0)
    assert write.result is not None
    assert (write.result.status, write.result.actual, write.result.attempts) == ("accepted", 80.0, 1)
    assert len(desk.writes) == len(desk.reads) == 0


def test_a_change_by_the_vehicle_while_a_value_is_watched_is_an_adjustment() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    write = desk.writes.set("A", 80.0, desk.now, settle=1.2)
    desk.hear("A", 80.0, at=0.1)
    desk.hear("A", 45.0, at=0.9)
    assert not write.done
    desk.pass_time(0.5)
    desk.hear("A", 45.0)
    assert write.result is not None
    assert write.result.adjusted
    assert (write.result.requested, write.result.actual, write.result.param.value) == (80.0, 45.0, 45.0)


def test_a_watch_that_cannot_be_ended_says_that_the_value_was_acknowledged() -> None:
    desk = Desk()
    desk.knows("A", 1.0)
    left: list[str] = []
    desk.writes.on_outcome_unknown = lambda name, by, now: left.append(name)
    lost = desk.writes.set("A", 2.0, desk.now, settle=1.0)
    desk.hear("A", 2.0)
    desk.writes.lose(desk.now)
    assert isinstance(lost.error, NoReply)
    assert "acknowledged" in str(lost.error)
    cancelled = desk.writes.set("A", 3.0, desk.now, settle=1.0)
    desk.hear("A", 3.0)
    desk.writes.cancel(cancelled, desk.now)
    assert len(desk.writes) == 0
    unanswered = desk.writes.set("A", 4.0, desk.now, settle=1.0)
    desk.hear("A", 4.0)
    desk.pass_time()
    assert isinstance(unanswered.error, NoReply)
    assert "acknowledged" in str(unanswered.error)
    assert left == []  # the author of later changes is certain


# NaN and infinity


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, struct.pack("<f", math.inf)])
def test_nan_and_infinity_are_not_sent_unless_forced(value: WireValue) -> None:
    desk = Desk()
    desk.writes.against_non_finite = "it stops"
    write = desk.set("A", value)  # the type is not known yet
    desk.hear("A", 1.0)
    assert isinstance(write.error, UsageError)
    assert "it stops" in str(write.error)
    assert desk.take() == ["read A"]
    assert len(desk.writes) == 0
    forced = desk.writes.set("A", value, desk.now, force=True)
    assert [each[:5] for each in desk.take()] == ["set A"]
    assert not forced.done
