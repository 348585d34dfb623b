"""Wait for the end of a batch of writes, of plain or of extended parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import anyio

from paramclient.errors import NoReply, ParamClientError

__all__ = ["wait_for_batch"]

Outcome = TypeVar("Outcome")


class _Batch(Protocol[Outcome]):
    """The part of a batch of writes that a caller waits for."""

    on_outcome: Callable[[], None]

    @property
    def ended(self) -> list[Outcome]: ...

    @property
    def done(self) -> bool: ...

    @property
    def result(self) -> tuple[Outcome, ...] | None: ...

    @property
    def begun_at(self) -> float: ...

    @property
    def attempts(self) -> int: ...

    @property
    def open_names(self) -> list[str]: ...

    def give_up(self, error: ParamClientError, now: float) -> None: ...


async def wait_for_batch(
    batch: _Batch[Outcome],
    timeout: float | None,
    progress: Callable[[Outcome], None] | None,
    describe: Callable[[Sequence[str]], str],
) -> tuple[Outcome, ...]:
    """Wait until a batch ends, or give it up at the timeout; report the outcomes as they arrive.

    Args:
        batch: the batch; its first requests are sent already.
        timeout: seconds, or None.
        progress: called with each outcome, or None.
        describe: returns the requests with these names in words, for NoReply.
    """
    reported = 0

    def report() -> None:
        nonlocal reported
        for outcome in batch.ended[reported:]:
            reported += 1
            if progress is not None:
                progress(outcome)

    with anyio.move_on_after(timeout):
        while not batch.done:
            new_outcome = anyio.Event()
            batch.on_outcome = new_outcome.set
            report()
            await new_outcome.wait()
    now = anyio.current_time()
    if not batch.done:
        what = describe(batch.open_names)
        batch.give_up(NoReply(what, attempts=batch.attempts, waited=now - batch.begun_at), now)
    report()
    assert batch.result is not None
    return batch.result
