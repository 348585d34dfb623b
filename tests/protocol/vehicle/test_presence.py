"""Whether a component is there: its heartbeats, its silence, its reboots."""

from __future__ import annotations

import math
from collections.abc import Sequence

from paramclient.protocol.vehicle.presence import (
    LOST_AFTER,
    LOST_AFTER_HIGH_LATENCY,
    Presence,
)
from paramclient.protocol.vehicle.reboot_detection import (
    BOOT_CLOCK_WRAP,
    REORDERING_TIME,
)

from paramclient.wire.messages import (
    MAV_AUTOPILOT_PX4,
    MAV_STATE_ACTIVE,
    MAV_STATE_BOOT,
    Heartbeat,
    SystemTime,
)
from tests.simulation import is_so

ACTIVE = Heartbeat(2, MAV_AUTOPILOT_PX4, system_status=MAV_STATE_ACTIVE)
BOOT = Heartbeat(2, MAV_AUTOPILOT_PX4, system_status=MAV_STATE_BOOT)


def beating(*times: float) -> Presence:
    presence = Presence()
    for now in times:
        presence.receive(now)
        assert not presence.heartbeat(ACTIVE, now)
    return presence


# silence


def test_the_first_word_has_no_silence_before_it() -> None:
    presence = Presence()
    assert presence.receive(7.0) == math.inf
    assert presence.receive(9.5) == 2.5


def test_a_component_without_heartbeats_is_never_lost() -> None:
    presence = Presence()
    presence.receive(1.0)
    assert not presence.has_beaten
    assert presence.heartbeat_timeout == math.inf
    assert presence.lost_at() == math.inf
    assert not presence.was_silent(LOST_AFTER - 0.1)
    assert presence.was_silent(LOST_AFTER), "another vehicle may speak now all the same"


def test_five_seconds_after_the_last_word_it_is_lost() -> None:
    presence = beating(1.0)
    assert presence.lost_at() == 1.0 + LOST_AFTER
    presence.receive(3.5)
    assert presence.lost_at() == 3.5 + LOST_AFTER, "whatever the word was"
    presence.is_lost = True
    assert presence.lost_at() == math.inf


def test_the_heartbeat_timeout_is_three_intervals_of_a_slow_heartbeat() -> None:
    presence = beating(0.0, 10.0)
    assert presence.heartbeat_timeout == 30.0
    assert presence.gap == 25.0, "no gap after each of its heartbeats"


def test_high_latency_needs_more_patience_until_the_next_heartbeat() -> None:
    presence = beating(0.0, 1.0)
    presence.receive(2.0)
    presence.high_latency()
    assert is_so(presence.is_high_latency)
    assert presence.lost_at() == 2.0 + LOST_AFTER_HIGH_LATENCY
    presence.receive(30.0)
    presence.heartbeat(ACTIVE, 30.0)
    assert not presence.is_high_latency
    assert presence.lost_at() == 30.0 + LOST_AFTER


def test_a_component_first_received_in_high_latency_mode_can_be_lost() -> None:
    presence = Presence()
    presence.receive(2.0)
    presence.high_latency()
    assert presence.lost_at() == 2.0 + LOST_AFTER_HIGH_LATENCY


# reboots


def reboots(clock: Sequence[tuple[float, int]]) -> list[float]:
    """When a SYSTEM_TIME shows a reboot: pairs of a time in seconds and a value in milliseconds."""
    presence = Presence()
    return [now for now, boot_ms in clock if presence.system_time(SystemTime(0, boot_ms), now)]


def test_a_clock_that_begins_anew_is_a_reboot() -> None:
    assert reboots([(0.0, 500_000), (1.0, 501_000), (6.0, 1_200), (7.0, 2_200)]) == [6.0]
    assert reboots([(0.0, 50_000), (60.0, 40_000)]) == [60.0], "it was silent for a minute"
    assert reboots([(0.0, 3 * BOOT_CLOCK_WRAP // 4), (9.0, 3_000)]) == [9.0], "after weeks"


def test_each_reboot_counts_once() -> None:
    clock = [(0.0, 50_000), (5.0, 1_000), (6.0, 2_000), (6.0, 2_000), (20.0, 500), (21.0, 1_500)]
    assert reboots(clock) == [5.0, 20.0]


def test_reordered_and_repeated_clocks_are_no_reboot() -> None:
    assert reboots([(0.0, 50_000), (0.1, 49_000), (0.2, 51_000), (0.2, 51_000), (1.0, 50_000)]) == []
    soon = int(1000 * REORDERING_TIME) + 100
    assert reboots([(0.0, soon), (0.1, 200), (1.0, soon + 1_000)]) == [], "soon after it was switched on"
    assert reboots([(0.0, soon), (0.1, 150)]) == [0.1]


def test_a_simulated_clock_may_run_faster() -> None:
    clock = [(float(second), 20_000 * second) for second in range(10)]
    assert reboots(clock) == []
    assert reboots([*clock, (12.0, 4_000)]) == [12.0]


def test_a_clock_that_is_full_begins_at_zero() -> None:
    assert reboots([(0.0, BOOT_CLOCK_WRAP - 500), (1.0, 500), (2.0, 1_500)]) == []
    assert reboots([(0.0, BOOT_CLOCK_WRAP - 500), (1.0, 500), (9.0, 8_500), (14.0, 1_000)]) == [14.0]


def states(*beats: tuple[float, Heartbeat]) -> list[float]:
    presence = Presence()
    return [now for now, beat in beats if presence.heartbeat(beat, now)]


def test_a_heartbeat_that_says_it_boots_is_a_reboot() -> None:
    assert states((0.0, ACTIVE), (5.0, BOOT), (6.0, BOOT), (7.0, ACTIVE)) == [5.0]
    assert states((0.0, ACTIVE), (5.0, BOOT), (7.0, ACTIVE), (20.0, BOOT)) == [5.0, 20.0]


def test_a_component_first_received_while_it_boots_has_not_rebooted() -> None:
    assert states((0.0, BOOT), (1.0, BOOT), (2.0, ACTIVE)) == []


def test_clock_and_heartbeat_report_one_reboot_only() -> None:
    presence = beating(0.0, 1.0)
    assert not presence.system_time(SystemTime(0, 90_000), 1.0)
    assert presence.heartbeat(BOOT, 6.0)
    assert not presence.system_time(SystemTime(0, 500), 6.0)
    assert not presence.system_time(SystemTime(0, 1_500), 7.0)


# clocks in telemetry

ATTITUDE_ID, GLOBAL_POSITION_ID = 30, 33


def telemetry_reboots(clock: Sequence[tuple[float, int, int]]) -> list[float]:
    """When telemetry shows a reboot, by messages with a time in seconds, an id and milliseconds."""
    presence = Presence()
    return [now for now, number, boot_ms in clock if presence.boot_clock(number, boot_ms, now)]


def test_a_clock_in_telemetry_that_begins_anew_is_a_reboot() -> None:
    clock = [(0.0, ATTITUDE_ID, 60_000), (0.1, GLOBAL_POSITION_ID, 60_080), (1.9, GLOBAL_POSITION_ID, 316)]
    assert telemetry_reboots([*clock, (2.0, ATTITUDE_ID, 400), (2.1, GLOBAL_POSITION_ID, 500)]) == [1.9]


def test_clocks_of_different_messages_are_not_compared() -> None:
    """One that is filled with another clock, with a constant or with nothing shows no reboot."""
    clock = [
        (second, number, boot_ms)
        for second in range(20)
        for number, boot_ms in (
            (ATTITUDE_ID, 90_000 + 1000 * second),
            (GLOBAL_POSITION_ID, 1000 * second + 1),
            (132, 700),
            (143, 0 if second % 2 else 90_000),
        )
    ]
    assert telemetry_reboots(clock) == []


def test_late_frames_of_the_run_before_are_no_second_reboot() -> None:
    """They arrive over a slower way, after those of the new run."""
    clock = [(0.0, 60_000), (2.0, 400), (2.1, 61_000), (2.2, 600), (4.0, 61_500), (4.1, 2_500), (9.0, 7_400)]
    assert telemetry_reboots([(now, ATTITUDE_ID, boot_ms) for now, boot_ms in clock]) == [2.0]


# sequence numbers


def test_a_numbering_that_begins_is_noticed() -> None:
    presence = Presence()
    assert not presence.numbering_begins(0), "the first frame that is received"
    presence.numbering_begins(200)
    assert presence.numbering_begins(1)
    assert not presence.numbering_begins(2)
