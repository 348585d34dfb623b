"""Thousands of the sessions of `test_sessions.py`, seeded, on all cores: what `make soak` runs.

Hypothesis draws the sessions of one seed, always the same ones, and the next seed draws others. A failure is
reported with its seed; `python -m tests.soak --seed N` runs just those sessions again and looks for the
shortest one that fails.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
import traceback
from dataclasses import dataclass

from hypothesis import Phase, seed, settings
from hypothesis.stateful import run_state_machine_as_test

from tests.conversations.test_sessions import SETTINGS, Sessions

PER_SEED = 100
"""Sessions that one seed stands for."""


@dataclass(frozen=True)
class Outcome:
    """What became of the sessions of one seed."""

    seed: int
    sessions: int
    failure: str


def run_one(number: int, *, sessions: int = PER_SEED, shrinks: bool = False) -> Outcome:
    """Run the sessions of one seed; with `shrinks`, look for the shortest one that fails."""
    phases = (Phase.generate, Phase.shrink) if shrinks else (Phase.generate,)
    chosen = settings(
        SETTINGS,
        max_examples=sessions,
        stateful_step_count=30,
        derandomize=False,
        database=None,
        phases=phases,
    )
    before = Sessions.begun_sessions
    failure = ""

    @seed(number)
    class Seeded(Sessions):
        pass

    try:
        run_state_machine_as_test(Seeded, settings=chosen)
    except Exception:  # any exception is a failure to report
        failure = traceback.format_exc()
    return Outcome(number, Sessions.begun_sessions - before, failure)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sessions", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first seed")
    parser.add_argument("--seed", type=int, help="run only the sessions of this seed, and shorten a failure")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    if options.seed is not None:
        outcome = run_one(options.seed, shrinks=True)
        print(outcome.failure or f"seed {options.seed}: {outcome.sessions} sessions, all right")
        return bool(outcome.failure)

    seeds = range(options.first, options.first + -(-options.sessions // PER_SEED))
    began = time.monotonic()
    done = 0
    failed: list[int] = []
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        for outcome in pool.imap_unordered(run_one, seeds):
            done += outcome.sessions
            if outcome.failure:
                failed.append(outcome.seed)
                print(f"seed {outcome.seed} fails:\n{outcome.failure}", file=sys.stderr)
            minutes = (time.monotonic() - began) / 60
            print(f"{done} sessions in {minutes:.1f} min, {len(failed)} seeds failed", flush=True)
    print(f"{done} sessions of {len(seeds)} seeds: {'all right' if not failed else 'NOT all right'}")
    for number in sorted(failed):
        print(f"to repeat: python -m tests.soak --seed {number}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
