"""What goes over a link, counted: every frame and byte, losses by sequence numbers, rates, and the hook."""

from __future__ import annotations

import struct
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient import LinkError, ParamClient, TrafficReport, UsageError
from paramclient.protocol import wire
from paramclient.protocol.station import Station
from paramclient.protocol.stats import packet_loss as numbers
from paramclient.protocol.stats import traffic as room
from paramclient.protocol.stats.packet_loss import (
    CERTAIN_GAP,
    GAP_MAX,
    NUMBERING_CONFIRMATION_FRAMES,
    NUMBERING_TIMEOUT,
    REORDER_DEPTH,
    SequenceCheck,
)
from paramclient.protocol.stats.sniffer import UNPROVEN_BYTES_MAX, SeenFrame, Sniffer
from paramclient.protocol.stats.traffic import RATE_WINDOW, ComponentTraffic, Traffic
from paramclient.protocol.wire import Framer, Heartbeat
from paramclient.sim import Air, FaultyLink, PX4Vehicle
from tests.simulation import Simulation

PX4 = Heartbeat(2, wire.MAV_AUTOPILOT_PX4, system_status=3)
UNKNOWN = 4_711_000
"""A message id that no dialect has."""


def frame(
    message_id: int = 30, sequence: int = 0, *, system: int = 1, component: int = 1, version: int = 2
) -> bytes:
    payload = bytes(range(1, 29))
    where = {"system": system, "component": component, "sequence": sequence}
    return wire.build_frame(message_id, payload, version=version, **where)


def heartbeat(sequence: int = 0, *, system: int = 1, component: int = 1) -> bytes:
    return wire.encode(PX4, system=system, component=component, sequence=sequence)


def unknown(sequence: int = 0, *, size: int = 5, system: int = 1, component: int = 1) -> bytes:
    """A frame with an id that the dialect does not have; its checksum cannot be checked."""
    head = bytes((size, 0, 0, sequence, system, component)) + UNKNOWN.to_bytes(3, "little")
    return b"\xfd" + head + bytes(size) + b"\x12\x34"


def signed(sequence: int = 0) -> bytes:
    plain = frame(sequence=sequence)
    body = plain[1:2] + b"\x01" + plain[3:-2]
    crc = wire.checksum(30, body)
    assert crc is not None
    return b"\xfd" + body + crc.to_bytes(2, "little") + b"\x55" * 13


def damaged(sequence: int = 0) -> bytes:
    whole = frame(sequence=sequence)
    return whole[:-1] + bytes((whole[-1] ^ 1,))


def sniffed(data: Iterable[bytes], *, stream: bool = True) -> tuple[list[SeenFrame], Sniffer]:
    sniffer = Sniffer(stream=stream)
    seen = [each for chunk in data for each in sniffer.receive(chunk)]
    return seen + sniffer.flush(), sniffer


# every frame and every byte


def test_a_frame_is_seen_with_all_that_counts() -> None:
    data = frame(30, 7, system=3, component=4)
    [seen], _ = sniffed([data])
    assert seen == SeenFrame(30, 3, 4, 7, bytes(range(1, 29)), 2, 40, False, True, data)
    [seen], _ = sniffed([frame(30, 7, version=1)])
    assert (seen.version, seen.size, seen.is_signed) == (1, 36, False)
    [seen], _ = sniffed([signed()])
    assert (seen.version, seen.size, seen.is_signed, seen.is_known) == (2, 53, True, True)


def test_names_and_words_are_those_of_the_dialect() -> None:
    assert wire.message_name(0) == "HEARTBEAT"
    assert wire.message_name(UNKNOWN) == f"UNKNOWN_{UNKNOWN}"
    assert wire.enum_word("MAV_TYPE", 1) == "fixed wing"
    assert wire.enum_word("MAV_STATE", 4) == "active"
    assert wire.enum_word("MAV_TYPE", 250) == "250"


@pytest.mark.parametrize("stream", [True, False])
def test_damaged_unknown_and_signed_frames_and_other_bytes_are_distinguished(stream: bool) -> None:
    data = b"noise" + frame(sequence=1) + damaged(2) + unknown(3) + b"\xfd\xfe" + signed(4) + unknown(5)
    seen, sniffer = sniffed([data], stream=stream)
    assert [(each.sequence, each.is_known, each.is_signed) for each in seen] == [
        (1, True, False),
        (3, False, False),
        (4, True, True),
        (5, False, False),
    ]
    assert (sniffer.damaged, sniffer.other_bytes) == (1, 7)


def test_a_header_that_claims_too_much_hides_nothing() -> None:
    seen, sniffer = sniffed([b"\xfd\xff\x00\x00" + frame(sequence=1) + frame(sequence=2)])
    assert [each.sequence for each in seen] == [1, 2]
    assert (sniffer.damaged, sniffer.other_bytes) == (0, 4)


def test_unproven_bytes_of_a_stream_are_bounded() -> None:
    sniffer = Sniffer(stream=True)
    count = 0
    for _ in range(2000):
        count += len(sniffer.receive(unknown()))
        assert len(sniffer._tail) <= UNPROVEN_BYTES_MAX + 280
    assert count > 1500
    noisy = Sniffer(stream=True)
    for _ in range(100):
        assert noisy.receive(b"no frame in here" * 20) == []
    assert len(noisy._tail) + noisy.other_bytes == 32_000
    assert noisy.other_bytes > 20_000


pieces = st.lists(
    st.one_of(
        st.builds(frame, st.just(30), st.integers(0, 255), version=st.sampled_from([1, 2])),
        st.builds(signed, st.integers(0, 255)),
        st.builds(damaged, st.integers(0, 255)),
        st.builds(unknown, st.integers(0, 255), size=st.integers(0, 40)),
        st.binary(max_size=40),
        st.sampled_from([b"\xfd", b"\xfe\x00", b"\xfd\x09\x00\x00\x00"]),
    ),
    max_size=12,
)


@given(pieces, st.data())
def test_the_sniffer_finds_the_frames_of_the_framer_and_counts_every_byte(
    parts: list[bytes], data: st.DataObject
) -> None:
    whole = b"".join(parts)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), max_size=6)))
    chunks = [whole[a:b] for a, b in zip([0, *cuts], [*cuts, len(whole)], strict=True)]
    framer = Framer()
    expected = [each for chunk in chunks for each in framer.receive(chunk)] + framer.flush()
    seen, sniffer = sniffed(chunks)
    assert [each[:6] for each in seen if each.is_known] == [tuple(each) for each in expected]
    proven = sum(each.size for each in seen)
    assert proven + sniffer.other_bytes <= len(whole)
    if not sniffer.damaged:
        assert proven + sniffer.other_bytes == len(whole)


# what was lost


def check_of(sequence: Iterable[int], *, period: float = 0.02) -> SequenceCheck:
    check = SequenceCheck()
    for count, number in enumerate(sequence):
        check.receive(number % 256, count * period)
    return check


@given(st.integers(0, 255), st.lists(st.booleans(), max_size=1500))
def test_any_loss_of_few_in_a_row_is_counted_exactly(start: int, arrives: list[bool]) -> None:
    received = [start]
    lost = run = 0
    for offset, has_arrived in enumerate(arrives, start=1):
        if has_arrived or run == CERTAIN_GAP:
            received.append(start + offset)
            lost += run
            run = 0
        else:
            run += 1
    check = check_of(received)
    assert (check.lost, check.repeated, check.late) == (lost, 0, 0)


@given(st.integers(0, 255), st.lists(st.tuples(st.integers(0, GAP_MAX), st.integers(0, 300)), max_size=8))
def test_a_long_gap_is_counted_exactly(start: int, gaps: list[tuple[int, int]]) -> None:
    number = start
    received = [number]
    for gap, run in gaps:
        received += range(number + gap + 1, number + gap + 1 + NUMBERING_CONFIRMATION_FRAMES + 1 + run)
        number = received[-1]
    check = check_of(received)
    assert (check.lost, check.repeated, check.late) == (sum(gap for gap, _ in gaps), 0, 0)


@given(st.integers(0, 255), st.lists(st.integers(1, 3), min_size=1, max_size=600))
def test_repeated_frames_are_no_loss(start: int, copies: list[int]) -> None:
    check = check_of(start + offset for offset, count in enumerate(copies) for _ in range(count))
    assert (check.lost, check.repeated, check.late) == (0, sum(copies) - len(copies), 0)


@given(st.integers(0, 255), st.lists(st.integers(0, CERTAIN_GAP - 1), min_size=1, max_size=600))
def test_slightly_reordered_frames_are_no_loss(start: int, delays: list[int]) -> None:
    order = sorted(range(1, len(delays) + 1), key=lambda each: (each + delays[each - 1], each))
    check = check_of([start, *(start + each for each in order)])
    behind = sum(each < max(order[:place], default=0) for place, each in enumerate(order))
    assert (check.lost, check.repeated, check.late) == (0, 0, behind)


def test_frames_beyond_the_reorder_depth_are_counted_once_as_lost() -> None:
    check = check_of([*range(50), *range(51, 51 + REORDER_DEPTH), 50])
    assert (check.lost, check.late) == (0, 1)
    check = check_of([*range(50), *range(51, 52 + REORDER_DEPTH), 50, *range(52 + REORDER_DEPTH, 200)])
    assert (check.lost, check.late) == (1, 0)


def test_a_late_one_of_a_long_gap_makes_that_shorter() -> None:
    check = check_of([*range(10), 40, 38, 39, 41])
    assert (check.lost, check.late) == (28, 2)


@given(st.integers(0, 2000), st.integers(0, 255), st.integers(1, 600))
def test_a_sender_that_starts_anew_has_lost_nothing(before: int, first: int, after: int) -> None:
    jump = (first - before) % 256
    if GAP_MAX + 1 < jump < 256 - REORDER_DEPTH:
        check = check_of([*range(before + 1), *range(first, first + after)])
        assert (check.lost, check.repeated, check.late) == (0, 0, 0)


@given(st.integers(0, 2000), st.integers(0, 255), st.integers(1, 600))
def test_after_a_silence_a_jump_of_sequence_numbers_is_no_loss(before: int, first: int, after: int) -> None:
    check = check_of(range(before + 1))
    now = before * 0.02 + NUMBERING_TIMEOUT + 0.1
    for count in range(after):
        check.receive((first + count) % 256, now + count * 0.02)
    assert check.lost <= CERTAIN_GAP


def test_a_frame_may_be_late_and_repeated() -> None:
    check = check_of([0, 2, 1, 1])
    assert (check.lost, check.late, check.repeated) == (0, 1, 1)


def test_a_number_between_two_numberings_is_not_late() -> None:
    check = check_of([0, 40, 1, 39])
    assert (check.lost, check.late, check.repeated) == (0, 0, 1)
    assert check_of([0, 40, 39, 1]).lost == 0


def test_a_numbering_is_forgotten_after_several_gaps() -> None:
    check = check_of(
        [*range(6), *range(50, 56), *range(100, 261), 263, 264]
    )  # 261 is 5, the end of the first
    assert check.lost == 44 + 44 + 2


def test_a_jump_back_by_a_little_is_none() -> None:
    check = check_of([*range(12), *range(100)])
    assert check.lost == 0


@given(st.integers(0, 255), st.integers(0, 255), st.lists(st.booleans(), max_size=600))
def test_two_numberings_side_by_side_have_lost_nothing(first: int, second: int, turns: list[bool]) -> None:
    apart = (second - first) % 256
    if (
        REORDER_DEPTH + NUMBERING_CONFIRMATION_FRAMES
        < apart
        < 256 - REORDER_DEPTH - NUMBERING_CONFIRMATION_FRAMES
    ):
        at = [first, second]
        received = [first, second]
        for turn in [False, True, *turns]:
            at[turn] += 1
            received.append(at[turn])
        check = SequenceCheck()
        for number in received:
            check.receive(number % 256, 0.0)
        assert check.lost == 0


def test_losses_are_counted_in_each_of_two_numberings() -> None:
    received = [number for each in range(200) for number in (each, each + 120) if number not in (50, 51, 190)]
    assert check_of(received).lost == 4  # 190 is in both


def test_many_numberings_are_forgotten_again() -> None:
    check = SequenceCheck()
    for number in range(5000):
        check.receive(number * 67 % 256, 0.0)
        assert len(check._numberings) <= numbers.NUMBERINGS_MAX


# counted by component and by message


def only(report: TrafficReport) -> ComponentTraffic:
    [component] = report.components
    return component


def test_components_messages_and_totals() -> None:
    traffic = Traffic(is_stream=False)
    for second in range(10):
        traffic.sent((second + 1) * 21, second)
        traffic.receive(heartbeat(second, system=9, component=68), "peer", second)
        traffic.receive(heartbeat(second * 5), "peer", second)
        for each in range(1, 5):
            traffic.receive(frame(30, second * 5 + each), "peer", second + each / 5)
    report = traffic.report(10.0)
    assert report.seconds == 10.0
    assert (report.bytes_received, report.bytes_sent) == (20 * 21 + 40 * 40, 210)
    assert report.received_rate == pytest.approx(202, rel=0.1)
    assert report.sent_rate == pytest.approx(21, rel=0.25)
    assert (report.frames, report.damaged, report.unknown, report.other_bytes) == (60, 0, 0, 0)
    first, second_ = report.components
    assert (first.system, first.component, second_.system, second_.component) == (1, 1, 9, 68)
    assert (first.frames, first.bytes, first.version) == (50, 10 * 21 + 40 * 40, 2)
    assert first.frame_rate == pytest.approx(5, rel=0.1)
    assert first.byte_rate == pytest.approx(181, rel=0.1)
    assert first.heartbeat == PX4
    assert first.heartbeat_age == 1.0
    assert first.age == pytest.approx(0.2)
    assert (first.lost, first.loss, first.repeated, first.late, first.signed) == (0, 0.0, 0, 0, 0)
    assert [(each.name, each.count) for each in first.messages] == [("ATTITUDE", 40), ("HEARTBEAT", 10)]
    assert first.messages[0].rate == pytest.approx(4, rel=0.1)


def test_rates_and_loss_are_recent() -> None:
    traffic = Traffic(is_stream=False)
    for number in range(100):  # every second one is lost
        traffic.receive(frame(30, number * 2 % 256), "peer", number * 0.02)
    component = only(traffic.report(2.0))
    assert (component.frame_rate, component.lost) == (50.0, 99)
    assert component.loss == pytest.approx(0.5, abs=0.01)
    for number in range(200, 600):
        traffic.receive(frame(30, (number - 1) % 256), "peer", number * 0.02)
    component = only(traffic.report(12.0))
    assert (component.lost, component.loss) == (99, 0.0)
    assert component.frame_rate == pytest.approx(50, rel=0.01)
    component = only(traffic.report(12.0 + 2 * RATE_WINDOW))
    assert (component.frame_rate, component.byte_rate, component.loss, component.lost) == (0.0, 0.0, None, 99)
    assert component.age == pytest.approx(2 * RATE_WINDOW + 0.02)


def test_repeated_frames_do_not_hide_losses() -> None:
    traffic = Traffic(is_stream=False)
    for number in range(100):
        for _ in range(3):
            traffic.receive(frame(30, number * 2 % 256), "peer", number * 0.02)
    component = only(traffic.report(2.0))
    assert (component.frames, component.lost, component.repeated) == (300, 99, 200)
    assert component.loss == pytest.approx(0.5, abs=0.01)


def test_a_frame_that_is_late_makes_no_loss_negative() -> None:
    traffic = Traffic(is_stream=False)
    for sequence, now in ((0, 0.0), (2, 0.1), (1, 4 * RATE_WINDOW), (3, 4 * RATE_WINDOW)):
        traffic.receive(frame(30, sequence), "peer", now)
    assert only(traffic.report(4 * RATE_WINDOW)).loss == 0.0


def test_a_heartbeat_in_a_future_format_is_not_read() -> None:
    traffic = Traffic(is_stream=False)
    traffic.receive(heartbeat(0), "peer", 0.0)
    strange = bytearray(heartbeat(1) + bytes(13))
    strange[2] = 0x02
    strange[10] ^= 0xFF
    traffic.receive(bytes(strange), "peer", 0.0)
    report = traffic.report(0.0)
    assert (report.unknown, only(report).frames, only(report).heartbeat) == (1, 2, PX4)


def test_frames_that_nothing_proves_count_where_the_sender_is_known() -> None:
    traffic = Traffic(is_stream=False)
    traffic.receive(unknown(0, system=77), "peer", 0.0)
    assert traffic.report(0.0).components == ()
    traffic.receive(heartbeat(1), "peer", 0.0)
    traffic.receive(unknown(2), "peer", 0.0)
    traffic.receive(heartbeat(3), "peer", 0.0)
    traffic.receive(signed(4), "peer", 0.0)
    traffic.receive(damaged(5), "peer", 0.0)
    traffic.receive(heartbeat(6), "peer", 0.0)
    traffic.receive(b"?", "peer", 0.0)
    report = traffic.report(0.0)
    assert (report.unknown, report.damaged, report.other_bytes, report.frames) == (2, 1, 1, 6)
    component = only(report)
    assert (component.lost, component.signed, component.frames) == (1, 1, 5)
    assert f"UNKNOWN_{UNKNOWN}" in [each.name for each in component.messages]


def test_a_vehicle_that_is_heard_over_two_links_counts_for_each() -> None:
    traffic = Traffic(is_stream=False)
    for number in range(100):
        traffic.receive(heartbeat(number), "one", 0.0)
        traffic.receive(heartbeat(number + 7), "two", 0.0)
    component = only(traffic.report(1.0))
    assert (component.frames, component.lost, component.repeated, component.late) == (200, 0, 0, 0)


def test_a_radio_reports_its_status() -> None:
    traffic = Traffic(is_stream=False)
    payload = struct.pack("<HHBBBBB", 3, 2, 200, 190, 96, 40, 42)
    data = wire.build_frame(109, payload, system=51, component=68, sequence=0)
    traffic.receive(data, "peer", 0.0)
    assert only(traffic.report(0.0)).radio == room.RadioStatus(200, 40, 190, 42, 96, 3, 2)
    short = wire.build_frame(109, b"", system=51, component=68, sequence=1)
    traffic.receive(short, "peer", 0.0)
    assert only(traffic.report(0.0)).radio == room.RadioStatus(0, 0, 0, 0, 0, 0, 0)


def test_a_stream_is_followed_for_each_peer_and_its_end_counts() -> None:
    traffic = Traffic(is_stream=True)
    one, two = heartbeat(1), heartbeat(1, system=2)
    traffic.receive(one[:9], "one", 0.0)
    traffic.receive(two[:5], "two", 0.0)
    traffic.receive(one[9:], "one", 0.0)
    traffic.receive(two[5:] + damaged() + one[:4], "two", 0.0)
    traffic.receive(b"", "two", 0.0)
    traffic.receive(one[:3], "one", 0.0)
    traffic.pause()
    traffic.receive(one, "one", 0.0)
    report = traffic.report(0.0)
    assert (report.frames, report.damaged, report.other_bytes) == (3, 1, 7)


def test_counted_components_messages_and_peers_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("COUNTED_COMPONENTS_MAX", "COUNTED_MESSAGES_MAX", "COUNTED_PEERS_MAX"):
        monkeypatch.setattr(room, name, 3)
    traffic = Traffic(is_stream=True)
    for number in range(1, 10):
        traffic.receive(heartbeat(system=number) + b"\xfd", f"peer {number}", 0.0)
        traffic.receive(heartbeat(2 * number), f"peer {number}", 0.0)
        traffic.receive(heartbeat(2 * number + 2), f"peer {number}", 0.0)
        traffic.receive(frame(number + 24), "peer", 0.0)
    assert len(traffic._sniffers) == 3
    assert len(traffic._sources) == 3
    report = traffic.report(0.0)
    assert report.frames == 36
    first = report.components[0]
    assert (len(first.messages), first.lost) == (3, 10)
    assert len(traffic._sources[1, 1]._checks) == 3


# the hook


def test_a_station_counts_only_if_counting_is_on() -> None:
    assert Station(link="x", is_stream=False).traffic is None
    station = Station(link="x", is_stream=False, counts_traffic=True)
    assert station.traffic is not None
    station.tick(0.0)
    station.receive(heartbeat(1), "peer", 0.5)
    station.receive(frame(30, 2), "peer", 1.0)
    station.tick(1.0)
    report = station.traffic.report(2.0)
    assert only(report).frames == 2
    assert (report.seconds, report.bytes_sent) == (2.0, station.bytes_sent)
    assert station.bytes_sent > 21


def test_a_reconnected_link_begins_anew() -> None:
    station = Station(link="x", is_stream=True, counts_traffic=True)
    assert station.traffic is not None
    station.receive(heartbeat(1)[:10], "peer", 0.0)
    station.pause()
    assert station.traffic.report(0.0).other_bytes == 10


@pytest.mark.parametrize("loss", [0.05, 0.3])
def test_counted_losses_agree_with_the_faulty_link(loss: float) -> None:
    faulty = FaultyLink(loss=loss, duplicate=0.05, seed=1)
    air = Air([PX4Vehicle(telemetry=50)], downlink=faulty)
    simulation = Simulation(air=air, station=Station(link="x", is_stream=False, counts_traffic=True))
    simulation.run(60.0)
    assert simulation.station.traffic is not None
    component = only(simulation.station.traffic.report(simulation.now))
    assert faulty.lost > 100
    # of what is lost before the first frame and after the last one, nothing is known
    assert faulty.lost - 5 <= component.lost <= faulty.lost
    assert component.frames - component.repeated + component.lost == pytest.approx(60 * 52, rel=0.02)
    assert component.loss == pytest.approx(loss, abs=0.1)


@pytest.mark.asyncio
async def test_a_client_reports_events() -> None:
    air = Air.symmetric([PX4Vehicle(telemetry=100)], duplicate=0.2, seed=1)
    async with ParamClient(air, cache=False, traffic=True) as client:
        vehicle = await client.component()
        await vehicle.fetch_all()
        report = client.traffic_report()
    component = only(report)
    assert (component.lost, report.damaged, report.other_bytes) == (0, 0, 0)
    assert component.frames > 903
    assert component.repeated > 50
    assert {"PARAM_VALUE", "HEARTBEAT", "ATTITUDE"} <= {each.name for each in component.messages}
    assert report.bytes_received == client.bytes_received
    assert report.bytes_sent == client.bytes_sent
    with pytest.raises(LinkError):
        client.traffic_report()


@pytest.mark.asyncio
async def test_a_client_that_does_not_count_says_so() -> None:
    async with ParamClient("sim:px4", cache=False) as client:
        with pytest.raises(UsageError, match="traffic=True"):
            client.traffic_report()
