"""What goes over a link, counted: every frame and byte, losses by sequence numbers, rates, and the hook."""

from __future__ import annotations

import struct
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paramclient.protocol.stats import traffic as room
from paramclient.protocol.stats.packet_loss import CERTAIN_GAP, GAP_MAX, REORDER_DEPTH
from paramclient.protocol.stats.traffic import Traffic

from paramclient import LinkError, ParamClient
from paramclient.client.frame_cutter import SeenFrame, Sniffer
from paramclient.client.traffic import ComponentTraffic, TrafficReport
from paramclient.protocol.station import Station
from paramclient.sim import Air, FaultyLink, PX4Vehicle
from paramclient.wire import frames, messages
from paramclient.wire.frames import Framer
from paramclient.wire.loss import SequenceCheck
from paramclient.wire.messages import Heartbeat
from tests.simulation import Simulation

PX4 = Heartbeat(2, messages.MAV_AUTOPILOT_PX4, system_status=3)
UNKNOWN = 4_711_000
"""A message id that no dialect has."""


def frame(
    message_id: int = 30, sequence: int = 0, *, system: int = 1, component: int = 1, version: int = 2
) -> bytes:
    payload = bytes(range(1, 29))
    where = {"system": system, "component": component, "sequence": sequence}
    return frames.build_frame(message_id, payload, version=version, **where)


def heartbeat(sequence: int = 0, *, system: int = 1, component: int = 1) -> bytes:
    return messages.encode(PX4, system=system, component=component, sequence=sequence)


def unknown(sequence: int = 0, *, size: int = 5, system: int = 1, component: int = 1) -> bytes:
    """A frame with an id that the dialect does not have; its checksum cannot be checked."""
    head = bytes((size, 0, 0, sequence, system, component)) + UNKNOWN.to_bytes(3, "little")
    return b"\xfd" + head + bytes(size) + b"\x12\x34"


def signed(sequence: int = 0) -> bytes:
    plain = frame(sequence=sequence)
    body = plain[1:2] + b"\x01" + plain[3:-2]
    crc = frames.checksum(30, body)
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


@given(st.integers(0, 2000), st.integers(0, 255), st.integers(1, 600))
def test_a_sender_that_starts_anew_has_lost_nothing(before: int, first: int, after: int) -> None:
    jump = (first - before) % 256
    if GAP_MAX + 1 < jump < 256 - REORDER_DEPTH:
        check = check_of([*range(before + 1), *range(first, first + after)])
        assert (check.lost, check.repeated, check.late) == (0, 0, 0)


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


def test_a_radio_reports_its_status() -> None:
    traffic = Traffic(is_stream=False)
    payload = struct.pack("<HHBBBBB", 3, 2, 200, 190, 96, 40, 42)
    data = frames.build_frame(109, payload, system=51, component=68, sequence=0)
    traffic.receive(data, "peer", 0.0)
    assert only(traffic.report(0.0)).radio == room.RadioStatus(200, 40, 190, 42, 96, 3, 2)
    short = frames.build_frame(109, b"", system=51, component=68, sequence=1)
    traffic.receive(short, "peer", 0.0)
    assert only(traffic.report(0.0)).radio == room.RadioStatus(0, 0, 0, 0, 0, 0, 0)


# the hook


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
