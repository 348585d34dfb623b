"""The timeouts by the measured round trip, and how many tries an answer is worth."""

from __future__ import annotations

import math

import pytest

from paramclient.protocol.requests.retry import (
    ATTEMPTS_MAX,
    ATTEMPTS_MIN,
    BACKOFF_TIMEOUTS_MAX,
    BACKOFF_TIMEOUTS_MIN,
    INITIAL_TIMEOUT,
    SERVING_TIME,
    SILENCE_MAX,
    TIMEOUT_MAX,
    TIMEOUT_MIN,
    RetryPolicy,
)


def measured(sample: float, times: int = 1) -> RetryPolicy:
    policy = RetryPolicy()
    for _ in range(times):
        policy.answered(10.0, 10.0 + sample, 1)
    return policy


def test_before_anything_was_measured() -> None:
    policy = RetryPolicy()
    assert policy.timeout == INITIAL_TIMEOUT
    assert policy.round_trip.smoothed is None
    assert policy.round_trip.loss == pytest.approx(0.1)
    assert policy.round_trip.seen_loss == 0.0


def test_the_first_samples_give_two_round_trips() -> None:
    policy = measured(0.5)
    assert policy.round_trip.smoothed == 0.5
    assert policy.timeout == pytest.approx(1.0)


def test_samples_are_smoothed() -> None:
    policy = measured(0.5)
    policy.answered(20.0, 21.3, 1)
    assert policy.round_trip.smoothed == pytest.approx(0.6)
    assert policy.round_trip.variation == pytest.approx(0.25 + (0.8 - 0.25) / 4)


def test_on_a_steady_link_no_request_is_repeated_before_a_vehicle_responds() -> None:
    assert measured(0.001, 100).timeout == TIMEOUT_MIN
    steady = measured(0.3, 100)
    assert 0.3 < steady.timeout < 0.35


def test_a_response_to_a_repeated_request_is_no_sample() -> None:
    policy = measured(0.2)
    policy.answered(0.0, 3.0, 2)
    assert policy.round_trip.smoothed == pytest.approx(0.2)


def test_silences_in_a_row_back_off_and_a_sample_ends_that() -> None:
    policy = measured(0.1, 50)
    before = policy.timeout
    for _ in range(BACKOFF_TIMEOUTS_MIN - 1):
        policy.timed_out(1)
    assert policy.timeout == before
    policy.timed_out(1)
    assert policy.timeout == 2 * before
    for _ in range(20 * BACKOFF_TIMEOUTS_MIN):
        policy.timed_out(3)
    assert policy.timeout == TIMEOUT_MAX
    policy.answered(0.0, 0.1, 1)
    assert policy.timeout == pytest.approx(before)


def test_an_answer_that_fits_the_last_request_ends_the_silences() -> None:
    policy = measured(0.1, 50)
    for _ in range(4):
        for _ in range(BACKOFF_TIMEOUTS_MIN - 1):
            policy.timed_out(1)
        policy.answered(0.0, 0.09, 2)
    assert policy.timeout < 0.2
    for _ in range(BACKOFF_TIMEOUTS_MAX):
        policy.timed_out(1)
        policy.answered(0.0, 0.01, 2)  # too soon to be the answer to the last request
    assert policy.timeout > 0.2
    for _ in range(4):
        policy.answered(0.0, 0.09, 2)
    assert policy.timeout < 0.2


def test_the_worse_the_link_the_more_silences_are_no_surprise() -> None:
    good, bad = measured(0.1, 50), measured(0.1, 50)
    for _ in range(100):
        for _ in range(2):
            bad.timed_out(1)
        bad.answered(0.0, 0.1, 1)
    before = bad.timeout
    for _ in range(BACKOFF_TIMEOUTS_MIN):
        good.timed_out(3)
        bad.timed_out(3)
    assert good.timeout > 1.9 * 0.12
    assert bad.timeout == before
    for _ in range(BACKOFF_TIMEOUTS_MAX):
        bad.timed_out(3)
    assert bad.timeout > 1.9 * before


def test_before_reads_are_known_they_get_longer_than_what_is_answered_at_once() -> None:
    policy = measured(0.02, 2)
    assert policy.prompt_timeout == TIMEOUT_MIN
    assert policy.timeout == pytest.approx(0.02 + SERVING_TIME)
    known = measured(0.02, 50)
    assert known.timeout == known.prompt_timeout


def test_how_many_requests_at_once_a_risk_is_worth() -> None:
    policy = measured(0.1, 50)
    assert policy.copies(0.05, 3) == 1
    for _ in range(200):
        policy.timed_out(1)
        policy.answered(0.0, 0.1, 1)
    assert policy.copies(0.3, 9) == 2
    assert policy.copies(0.05, 3) == 3


def test_a_slow_link_gets_what_it_needs() -> None:
    policy = measured(9.0, 100)
    for _ in range(100):
        policy.timed_out(3)
    assert 9.0 < policy.timeout < 10.0


def test_the_share_that_is_lost() -> None:
    policy = RetryPolicy()
    for _ in range(200):
        policy.answered(0.0, 0.1, 1)
        policy.timed_out(1)
    assert policy.round_trip.loss == pytest.approx(0.5, abs=0.02)
    assert policy.round_trip.seen_loss == pytest.approx(0.5, abs=0.02)
    for _ in range(200):
        policy.timed_out(3)  # may have no answer at all
        policy.answered(0.0, 0.1, 3)
    assert policy.round_trip.loss == pytest.approx(0.5, abs=0.02)


def test_the_number_of_tries_follows_the_loss() -> None:
    clean = measured(0.1, 200)
    assert clean.tries == ATTEMPTS_MIN
    lossy = measured(0.1)
    for number in range(200):
        lossy.answered(0.0, 0.1, 1)
        if number % 2:
            lossy.timed_out(1)
    assert ATTEMPTS_MIN < lossy.tries < ATTEMPTS_MAX
    dead = RetryPolicy()
    for _ in range(200):
        dead.timed_out(1)
    assert dead.tries == ATTEMPTS_MAX


def test_enough_is_enough() -> None:
    policy = measured(0.1, 200)
    assert not policy.should_give_up(ATTEMPTS_MIN - 1, 1e9)
    assert policy.should_give_up(ATTEMPTS_MIN, 0.0)
    for _ in range(50):
        policy.timed_out(1)
    assert policy.tries > ATTEMPTS_MIN
    assert not policy.should_give_up(ATTEMPTS_MIN, 1e9)  # nothing updates its `received_at`


def test_requests_to_a_lost_component_end() -> None:
    policy = RetryPolicy()
    for _ in range(50):
        policy.timed_out(1)
    policy.round_trip.received_at = 100.0
    assert not policy.should_give_up(ATTEMPTS_MIN, 99.0 + SILENCE_MAX)
    assert policy.should_give_up(ATTEMPTS_MIN, 100.0 + SILENCE_MAX)
    assert not policy.should_give_up(ATTEMPTS_MIN - 1, 100.0 + SILENCE_MAX)


def test_a_response_to_a_request_of_unknown_time_is_no_round_trip_sample() -> None:
    """One such number would make every time-out none."""
    for known in (False, True):
        policy = RetryPolicy()
        if known:
            policy.answered(1.0, 1.2, 1)
        before = policy.timeout
        for sent_at in (-math.inf, math.inf):
            policy.answered(sent_at, 5.0, 1)
            assert policy.timeout == before
