"""The parts of a download: received, requested again, missing; counted only when they are read."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient.errors import UsageError
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params import file_download, list_download
from paramclient.protocol.params.download_ranges import (
    DownloadRange,
    DownloadRanges,
    split_bytes,
    split_indices,
)
from paramclient.protocol.params.fetch_result import Progress
from paramclient.sim import Air, ArduPilotVehicle, Camera, PX4Vehicle
from tests.protocol.ext.camera import CameraSession
from tests.protocol.params.test_list_download import Desk
from tests.simulation import Simulation, is_so, listing_ardupilot


def counts(parts: tuple[DownloadRange, ...]) -> list[tuple[int, int, int]]:
    return [(part.received, part.requested_again, part.missing) for part in parts]


def ranges_of(progress: Progress) -> DownloadRanges:
    assert progress.ranges is not None
    return progress.ranges


def total(progress: Progress) -> tuple[int, int, int]:
    """Received, requested again and missing, of the whole download."""
    [whole] = ranges_of(progress).split(1)
    return whole.received, whole.requested_again, whole.missing


# counting


@given(
    st.integers(0, 200),
    st.integers(1, 60),
    st.sets(st.integers(0, 199)),
    st.sets(st.integers(0, 199)),
)
def test_each_index_counts_once(count: int, number: int, received: set[int], requested: set[int]) -> None:
    parts = split_indices(count, number, received, requested)
    assert len(parts) == min(number, count)
    assert not parts or max(part.size for part in parts) - min(part.size for part in parts) <= 1
    first = 0
    for part in parts:
        indices = set(range(first, first + part.size))
        first += part.size
        assert part.received == len(indices & received)
        assert part.requested_again == len((indices & requested) - received)
        assert part.missing == len(indices - received - requested)
    assert first == count


@given(st.integers(0, 300), st.integers(1, 40), st.sets(st.integers(0, 299)), st.sets(st.integers(0, 299)))
def test_each_byte_counts_once(size: int, number: int, lost: set[int], requested: set[int]) -> None:
    lost = {each for each in lost if each < size}
    spans = [(each, each + 1) for each in sorted(lost)]
    again = [(each, each + 1) for each in sorted(lost & requested)]
    joined: list[tuple[int, int]] = []
    for first, last in spans:
        if joined and joined[-1][1] == first:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    received = set(range(size)) - lost
    assert split_bytes(size, number, joined, again) == split_indices(size, number, received, requested)


def test_a_gap_may_cover_several_parts() -> None:
    parts = split_bytes(100, 4, [(10, 80), (90, 100)], [(20, 30), (60, 80)])
    assert counts(parts) == [(10, 5, 10), (0, 5, 20), (0, 15, 10), (10, 5, 10)]


def test_without_a_part_nothing_can_be_split() -> None:
    ranges = DownloadRanges("parameters", lambda number: split_indices(9, number, (), ()))
    assert repr(ranges) == "<DownloadRanges of parameters>"
    assert counts(ranges.split(100)) == [(0, 0, 1)] * 9
    with pytest.raises(UsageError, match="1 part or more, not 0"):
        ranges.split(0)


# the list


def test_the_ranges_of_a_list_show_what_was_received_requested_again_and_is_missing() -> None:
    desk = Desk()
    assert is_so(desk.download.ranges is None)
    desk.stream([*range(10), *range(12, 50)])
    assert desk.download.ranges is not None
    assert {10, 11} <= set(desk.take()[1:])
    assert counts(desk.download.ranges.split(4)) == [(23, 2, 0), (25, 0, 0), (0, 0, 25), (0, 0, 25)]
    desk.hear(10)
    assert counts(desk.download.ranges.split(4))[0] == (24, 1, 0)
    desk.hear(11)
    desk.stream(range(50, 100))
    assert desk.download.done
    assert counts(desk.download.ranges.split(2)) == [(50, 0, 0), (50, 0, 0)]


def test_an_index_that_was_given_up_is_missing_again() -> None:
    desk = Desk()
    desk.stream([each for each in range(100) if each != 40])
    assert desk.download.ranges is not None
    assert counts(desk.download.ranges.split(1)) == [(99, 1, 0)]
    desk.answer(silent=[40])
    assert desk.download.missing == (40,)
    assert counts(desk.download.ranges.split(1)) == [(99, 0, 1)]


@pytest.mark.parametrize("vehicle", [PX4Vehicle, listing_ardupilot])
def test_a_list_on_a_link_that_loses_packets(vehicle: type[PX4Vehicle | ArduPilotVehicle]) -> None:
    world = Simulation(air=Air.symmetric([vehicle()], loss=0.2, delay=0.05, seed=1))
    fetch = world.meet().begin_fetch(world.now)
    seen = []
    while not fetch.done:
        world.run(0.1)
        progress = fetch.progress(world.now)
        if progress.ranges is not None:
            received, again, missing = total(progress)
            assert (received, received + again + missing) == (progress.received, progress.total)
            assert sum(part.received for part in progress.ranges.split(60)) == received
            seen.append(again)
    assert max(seen) > 10
    assert seen[-1] == 0


# the file


def test_the_ranges_of_a_file_show_what_the_burst_lost() -> None:
    session = Simulation(air=Air.symmetric([ArduPilotVehicle(live_period=0)], loss=0.2, seed=1))
    fetch = session.meet().begin_fetch(session.now)
    seen = []
    while not fetch.done:
        session.run(0.02)
        progress = fetch.progress(session.now)
        if progress.ranges is not None and (parts := progress.ranges.split(50)):
            assert progress.ranges.unit == "bytes"
            assert fetch.file is not None
            whole = total(progress)
            assert whole == tuple(map(sum, zip(*counts(parts), strict=True)))
            seen.append(whole)
    assert len(seen) > 5
    assert sorted(received for received, *_ in seen) == [received for received, *_ in seen]
    assert max(again for _, again, _ in seen) > 0
    assert seen[-1][2] < 2000 < seen[0][2]
    assert ranges_of(fetch.progress(session.now)).split(50) == ()  # the file is closed


# extended parameters


def test_a_list_of_extended_parameters_has_the_same_ranges() -> None:
    table = {f"PARAM_{number:03}": number for number in range(300)}
    session = CameraSession(air=Air.symmetric([Camera(table)], loss=0.2, seed=3))
    fetches = session.camera.ext.fetches
    fetch = session.camera.begin_ext_fetch(session.now)
    assert fetches.progress(fetch, session.now).ranges is None
    seen = []
    while not fetch.done:
        session.run(0.05)
        progress = fetches.progress(fetch, session.now)
        if progress.ranges is not None:
            received, again, missing = total(progress)
            assert (received, received + again + missing) == (progress.received, 300)
            seen.append(again)
    assert max(seen) > 5


# the cost


def test_nothing_is_counted_before_the_statistics_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> tuple[DownloadRange, ...]:
        raise AssertionError("counted, and not read")

    monkeypatch.setattr(list_download, "split_indices", refuse)
    monkeypatch.setattr(file_download, "split_bytes", refuse)
    for vehicle in (PX4Vehicle(), ArduPilotVehicle()):
        world = Simulation(air=Air.symmetric([vehicle], loss=0.1, delay=0.02, seed=2))
        machine: ComponentMachine = world.meet()
        fetch = machine.begin_fetch(world.now)
        reports = []
        while not fetch.done:
            world.run(0.1)
            reports.append(fetch.progress(world.now))
        assert any(progress.ranges is not None for progress in reports)
        assert world.outcome(fetch).complete


def test_reports_are_equal_whatever_their_parts() -> None:
    ranges = DownloadRanges("bytes", lambda number: ())
    assert Progress(1, 2, 3.0, None, ranges) == Progress(1, 2, 3.0, None)
    assert repr(Progress(1, 2, 3.0, None, ranges)) == repr(Progress(1, 2, 3.0, None))
