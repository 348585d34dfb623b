"""The rate of requests to a component."""

from __future__ import annotations

import pytest

from paramclient.protocol.requests.pacing import (
    BATCHED_RATE,
    BURST_MIN,
    FIRST_RATE,
    QUEUEING_DELAY,
    RATE_MAX,
    RATE_MIN,
    READS_PER_LIST_VALUE,
    UPSTREAM_SHARE,
    LinkBandwidth,
    Pace,
)
from paramclient.protocol.requests.retry import RetryPolicy
from paramclient.protocol.requests.round_trip import RoundTrip


def burst(pace: Pace, now: float) -> int:
    """How many requests go out at once."""
    sent = 0
    while pace.may_send(now):
        pace.sent(now)
        sent += 1
    return sent


def serve(pace: Pace, seconds: float, delay: float, *, rate: float = 1e9, since: float = 0.0) -> float:
    """Ask as fast as allowed; answers arrive after `delay`, at `rate` at the most. Gives the end."""
    now = since
    answers: list[tuple[float, float]] = []
    free_at = since
    while now < since + seconds:
        for at, requested_at in [answer for answer in answers if answer[0] <= now]:
            answers.remove((at, requested_at))
            pace.answered(now - requested_at, now)
        while pace.may_send(now):
            pace.sent(now)
            free_at = max(free_at, now) + 1 / rate
            answers.append((free_at + delay, now))
        now += 0.001
    return now


def test_the_first_rate_is_that_of_the_slowest_autopilot() -> None:
    pace = Pace(RoundTrip())
    assert burst(pace, 5.0) == BURST_MIN
    assert pace.next_at() == pytest.approx(5.0 + 1 / FIRST_RATE)
    assert not pace.may_send(5.01)
    assert pace.may_send(pace.next_at())


def test_a_request_may_be_sent_at_next_at_exactly() -> None:
    pace = Pace(RoundTrip())
    now = 1234.567
    for _ in range(10_000):
        burst(pace, now)
        now = pace.next_at()
        assert pace.may_send(now)


def test_a_reserve_is_kept() -> None:
    pace = Pace(RoundTrip())
    for _ in range(int(BURST_MIN) - 2):
        pace.sent(0.0)
    assert pace.may_send(0.0, reserve=1.0)
    assert not pace.may_send(0.0, reserve=1.5)
    assert pace.next_at(1.5) == pytest.approx(0.5 / FIRST_RATE)


def test_the_rate_rises_while_responses_keep_up() -> None:
    pace = Pace(RoundTrip())
    serve(pace, 3.0, 0.02)
    assert pace.rate == RATE_MAX


def test_the_rate_stays_near_the_served_rate() -> None:
    pace = Pace(RoundTrip())
    end = serve(pace, 3.0, 0.02, rate=120.0)
    assert FIRST_RATE <= pace.rate < 400.0
    # and a request waits for the others that are before it, not for ever
    assert pace.next_at() < end + 1.0


@pytest.mark.parametrize("silent", [0, 64])
def test_the_rate_never_exceeds_that_of_a_vehicle_that_serves_batches(silent: int) -> None:
    policy = RetryPolicy()
    for number in range(100):
        if number < silent:
            policy.timed_out(1)
        else:
            policy.answered(0.0, 0.02, 1)
    pace = Pace(policy.round_trip)
    pace.is_batched = True
    serve(pace, 3.0, 0.02)
    assert pace.rate == pytest.approx(BATCHED_RATE / (1.0 - policy.round_trip.seen_loss) ** 0.5)
    assert pace.prospect == pace.rate
    assert (pace.rate > BATCHED_RATE) is (silent > 0)


def test_answers_that_queue_up_slow_it_down() -> None:
    pace = Pace(RoundTrip())
    serve(pace, 1.0, 0.02)
    fast = pace.rate
    serve(pace, 3.0, 0.02 + 3 * QUEUEING_DELAY, since=1.0)
    assert pace.rate < fast


@pytest.mark.parametrize(("late", "is_believed"), [(1.0, True), (1.5, False)])
def test_a_little_too_few_answers_count_when_they_are_late_as_well(late: float, is_believed: bool) -> None:
    pace = Pace(RoundTrip())
    pace.answered(0.1, 0.0)  # the quickest one
    now = 0.0
    for _ in range(8):
        burst(pace, now)
        now += 0.028  # 36 a second: 7 of 10 requested
        pace.answered(0.1 * late, now)
    assert (pace.rate > FIRST_RATE) is is_believed


def test_without_requests_that_wait_nothing_is_concluded() -> None:
    pace = Pace(RoundTrip())
    for turn in range(100):
        now = turn * 0.1
        assert pace.may_send(now)
        pace.sent(now)
        pace.answered(0.02, now + 0.02)
    assert pace.rate == FIRST_RATE


def test_a_response_to_a_repeated_request_is_no_delay_sample() -> None:
    pace = Pace(RoundTrip())
    now = 0.0
    for _ in range(200):
        burst(pace, now)
        pace.answered(None, now)
        now += 0.02
    assert pace.rate >= FIRST_RATE


def test_the_rate_is_a_share_of_the_list_rate() -> None:
    pace = Pace(RoundTrip())
    pace.stream_seen(0.1)
    assert pace.rate == pytest.approx(37 * 10 * UPSTREAM_SHARE / 16)
    pace.stream_seen(0.0)  # no stream was seen
    assert pace.rate == pytest.approx(37 * 10 * UPSTREAM_SHARE / 16)
    pace.stream_seen(0.01)
    assert pace.rate == FIRST_RATE
    pace.stream_seen(0.001)
    assert pace.rate == pytest.approx(READS_PER_LIST_VALUE / 0.001)


@pytest.mark.parametrize("gap", [0.125, 0.2, 1.0, 60.0])
def test_a_request_is_always_allowed_even_on_the_slowest_link(gap: float) -> None:
    pace = Pace(RoundTrip())
    burst(pace, 0.0)
    pace.stream_seen(gap)
    assert pace.rate >= RATE_MIN
    now = 0.0
    for _ in range(5):
        now = max(pace.next_at(), now)
        assert pace.may_send(now)
        pace.sent(now)
    assert now < 5 / RATE_MIN + 1.0


def test_requests_dropped_by_the_component_do_not_count_as_packet_loss() -> None:
    policy = RetryPolicy()
    pace = Pace(policy.round_trip)
    pace.stream_seen(0.0001)  # the list lost nothing
    for _ in range(200):
        policy.timed_out(1)
        policy.timed_out(1)
        policy.answered(0.0, 0.02, 1)
    now = 0.0
    answers: list[float] = []
    while now < 2.0:  # it answers one of three, at once
        while pace.may_send(now):
            pace.sent(now)
            pace.sent(now)
            pace.sent(now)
            answers.append(now + 0.02)
        while answers and answers[0] <= now:
            pace.answered(now - answers.pop(0) + 0.02, now)
        now += 0.01
    assert pace.rate <= FIRST_RATE


def test_answers_that_were_not_counted_slow_nothing_down() -> None:
    pace = Pace(RoundTrip())
    now = serve(pace, 0.5, 0.02)
    before = pace.rate
    while now < 3.0:  # a list answers, and what is requested meanwhile is not counted
        while pace.may_send(now):
            pace.sent(now)
        now += 0.01
    pace.rest()
    serve(pace, 0.5, 0.02, since=now)
    assert pace.rate >= before


def test_components_share_what_reads_may_take_of_the_link() -> None:
    share = LinkBandwidth()
    one, two = Pace(RoundTrip(), share), Pace(RoundTrip(), share)
    one.stream_seen(0.1)
    total = 37 * 10 * UPSTREAM_SHARE / 16
    assert one.rate == two.rate == pytest.approx(total)
    one.sent(0.0)
    two.sent(0.0)
    assert one.rate == two.rate == pytest.approx(total / 2)
    two.idle()
    assert one.rate == pytest.approx(total)


def test_parallel_lists_show_the_rate_of_the_link_by_received_values() -> None:
    share = LinkBandwidth()
    one, two = Pace(RoundTrip(), share), Pace(RoundTrip(), share)
    one.stream_seen(0.1, 0.5)
    assert one.rate == pytest.approx(37 * 10 * UPSTREAM_SHARE / 16), (
        "alone: what was lost was lost on the way"
    )
    two.stream_seen(0.1, 0.5)
    assert one.rate == pytest.approx(37 * 10 * UPSTREAM_SHARE / 16)
    two.stream_seen(0.1, 0.0)
    assert one.rate == pytest.approx(37 * 15 * UPSTREAM_SHARE / 16)
    one.stream_ended()
    two.stream_ended()
    assert one.rate == pytest.approx(37 * 15 * UPSTREAM_SHARE / 16), "that still holds"
    one.stream_seen(0.2)
    assert one.rate < 37 * 10 * UPSTREAM_SHARE / 16, "until one of them is received again"


def test_a_stream_of_bursts_shows_a_faster_link() -> None:
    pace = Pace(RoundTrip())
    pace.stream_seen(0.1, 0.0, 3.0)
    assert pace.rate == pytest.approx(3 * 37 * 10 * UPSTREAM_SHARE / 16)
