"""The list of the simulated ArduPilot, and its handling of other requests during a list."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Container, Sequence
from functools import partial

import pytest

from paramclient.protocol.ftp import Opcode, Packet
from paramclient.sim import ArduPilotVehicle
from paramclient.wire import messages
from tests.ground_station import LIST, Station, cast, indices, read

SET = cast("RTL_ALT", 1234.0)
LOOP = 0.006
"""Period of the vehicle's loop in seconds."""

quiet = ArduPilotVehicle
near = partial(pytest.approx, abs=LOOP)


def listing(seconds: float, vehicle: ArduPilotVehicle | None = None) -> Station:
    """Return a station that requested the list this long ago. The first slot starts at 0.1 s."""
    return Station(quiet() if vehicle is None else vehicle).send(LIST).wait(seconds)


def acknowledged(station: Station) -> list[float]:
    """Return when the set was acknowledged."""
    return [
        time
        for time, _, message in station.log
        if isinstance(message, messages.ParamValue)
        and (message.param_id, message.param_index) == ("RTL_ALT", messages.NO_INDEX)
    ]


def answered(station: Station, wanted: Container[int]) -> list[float]:
    """Return when reads of these indices, far ahead of the list, were answered."""
    return [
        time
        for time, _, message in station.log
        if isinstance(message, messages.ParamValue) and message.param_index in wanted
    ]


def pauses(station: Station, without: Container[int] = ()) -> list[tuple[float, float]]:
    """Return the pauses of the list longer than 20 ms, each with start and end."""
    times = [
        time
        for time, _, message in station.log
        if isinstance(message, messages.ParamValue) and message.param_index not in without
    ]
    return [pair for pair in itertools.pairwise(times) if pair[1] - pair[0] > 0.02]


def test_40_reads_at_once_lose_15() -> None:
    station = listing(0.15).send(*(read(index=index) for index in range(1300, 1340))).wait(2.0)
    assert sorted(set(indices(station.values())) - set(range(1300))) == [*range(1300, 1382)]
    station = listing(0.15).send(*(read(index=index) for index in range(1300, 1340))).wait(0.7)
    times = answered(station, range(1300, 1340))
    assert times == near([0.23] * 5 + [0.3] * 5 + [0.4] * 5 + [0.53] * 5 + [0.6] * 5)


def test_on_a_slow_link_a_list_does_not_delay_responses() -> None:
    station = listing(0.15, quiet(burst=1, period=0.025)).send(SET, read(index=1000)).wait(0.1)
    assert acknowledged(station) == near([0.156])
    assert answered(station, [1000]) == near([0.2])


def ask_for_file(station: Station, packets: Sequence[Packet]) -> Station:
    return station.send(*(messages.FileTransfer(0, 1, 1, packet.pack()) for packet in packets))


def test_a_list_pauses_a_file_burst() -> None:
    """20 blocks can wait. They are sent in the next pause, and the list continues."""
    station = Station(quiet())
    ask_for_file(station, [Packet(2, 3, Opcode.OPEN_FILE_RO, b"@PARAM/param.pck")]).wait(0.02)
    burst = Packet(4, 3, Opcode.BURST_READ_FILE, size=239)
    ask_for_file(station, [burst]).send(LIST).wait(2.0)
    times = [time for time, _, message in station.log if isinstance(message, messages.FileTransfer)][1:]
    assert len(times) == 65
    at_once = [(time, count) for time, count in Counter(times).items() if count > 1]
    assert [count for _, count in at_once] == [20, 20, 11]
    assert [time for time, _ in at_once] == near([0.23, 0.36, 0.49])
    assert not [time for time in times if 0.1 < time < 0.229]
    assert pauses(station) == []
