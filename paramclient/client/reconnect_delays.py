"""Reconnection of a link: delays between attempts, and the timeout. `link_task` makes the attempts."""

from __future__ import annotations

from typing import Final

import anyio

__all__ = ["LINK_TIMEOUT", "RECONNECT_BACKOFF_MAX", "RECONNECT_BACKOFF_MIN", "Backoff"]

LINK_TIMEOUT: Final = 10.0
"""Seconds for which calls wait for a reconnection before they fail with the error of the link."""
RECONNECT_BACKOFF_MIN: Final = 0.25
"""Seconds before the first attempt to reopen a link; doubled after each attempt."""
RECONNECT_BACKOFF_MAX: Final = 5.0
"""Maximum seconds between two attempts to reopen a link."""


class Backoff:
    """The times of the attempts to reopen a lost connection: without a time limit, ever less often.

    It begins when it is created. Calls that wait for the connection fail after `LINK_TIMEOUT`; the attempts
    continue.
    """

    def __init__(self) -> None:
        self._deadline = anyio.current_time() + LINK_TIMEOUT
        self._delay = RECONNECT_BACKOFF_MIN

    @property
    def is_timed_out(self) -> bool:
        """Whether the connection has been lost for `LINK_TIMEOUT`."""
        return anyio.current_time() >= self._deadline

    async def wait(self) -> None:
        """Wait until the next attempt. One attempt is made at the timeout."""
        left = self._deadline - anyio.current_time()
        await anyio.sleep(min(self._delay, left) if left > 0 else self._delay)
        self._delay = min(self._delay * 2, RECONNECT_BACKOFF_MAX)
