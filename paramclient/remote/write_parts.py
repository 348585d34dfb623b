"""Writes of many values in several requests, one after the other."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from typing import TypeAlias, TypeVar

import anyio

from paramclient.errors import LinkError, NoReply, ParamClientError
from paramclient.protocol.params.write_batch import SetStatus

__all__ = ["requests_of", "write_in_parts"]

Written = TypeVar("Written")
Outcome = TypeVar("Outcome")
Part: TypeAlias = tuple[list[Outcome], ParamClientError | None]
"""The outcomes of the values of a request, and the reason if some were not tried, or None."""


def requests_of(pairs: Iterable[tuple[str, Written]], most: int) -> Iterator[list[tuple[str, Written]]]:
    """Divide pairs, in order, into requests that have each name once, and at most this number of values."""
    part: dict[str, Written] = {}
    for name, value in pairs:
        if name in part or len(part) == most:
            yield list(part.items())
            part = {}
        part[name] = value
    if part:
        yield list(part.items())


async def write_in_parts(
    parts: Iterable[Sequence[tuple[str, Written]]],
    write: Callable[[Sequence[tuple[str, Written]], float | None], Awaitable[Part[Outcome]]],
    not_written: Callable[[str, Written, SetStatus, ParamClientError], Outcome],
    *,
    timeout: float | None,
    progress: Callable[[Outcome], None] | None,
) -> tuple[tuple[Outcome, ...], ParamClientError | None]:
    """Write values in several requests until one fails.

    Args:
        parts: the values of each request.
        write: sends a request with a timeout in seconds; returns its outcomes, and the reason if some were
            not tried.
        not_written: creates the outcome of a value that a failed request had, or that was not sent.
        timeout: seconds for all requests; None for no limit.
        progress: called with each outcome.

    Returns:
        The outcomes of all values, and the reason if some were not tried, or None.

    Raises:
        ParamClientError: the first request was refused. Nothing was written.
    """
    began = anyio.current_time()
    outcomes: list[Outcome] = []
    failure: ParamClientError | None = None
    for part in parts:
        if failure is not None:
            done = [not_written(*pair, SetStatus.NOT_TRIED, failure) for pair in part]
        else:
            left = None if timeout is None else began + timeout - anyio.current_time()
            try:
                done, failure = await write(part, left)
            except ParamClientError as error:
                is_open = isinstance(error, (NoReply, LinkError))  # the service may have written them
                if not is_open and not outcomes:
                    raise
                failure = error
                status = SetStatus.UNKNOWN if is_open else SetStatus.NOT_TRIED
                done = [not_written(*pair, status, error) for pair in part]
        for outcome in done:
            outcomes.append(outcome)
            if progress is not None:
                progress(outcome)
    return tuple(outcomes), failure
