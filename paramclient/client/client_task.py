"""ClientTask: the task that keeps a client open from `ParamClient.open` to `ParamClient.aclose`."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Coroutine
from typing import Any, Final

import anyio

from paramclient.client.core import ClientCore
from paramclient.errors import ClientClosed, LinkError

__all__ = ["ClientTask"]

TASK_NAME: Final = "paramclient client"
"""Name of the task, in the debuggers of asyncio and trio."""

logger = logging.getLogger(__name__)

_running: set[ClientTask] = set()
"""The tasks that have not ended: asyncio itself holds only weak references to its tasks."""


class ClientTask:
    """Opens and closes a client in one task of its own.

    The task group of a client must be entered and exited in one task. The callers of `open` and of `close`
    may be different tasks. If the event loop ends first, it cancels the task, which then closes the client.

    Args:
        client: what to open and to close.
    """

    def __init__(self, client: ClientCore) -> None:
        self._client = client
        self._link = client.link.name
        self._scope = anyio.CancelScope()
        self._opened = anyio.Event()
        self._is_to_close = anyio.Event()
        self._ended = anyio.Event()
        self._error: Exception | None = None

    async def open(self) -> None:
        """Start the task and wait until the client is open. Cancellation closes the client again.

        Raises:
            ClientClosed: `close` was called meanwhile.
            Exception: the client cannot be opened.
        """
        _running.add(self)
        _spawn(self._run)
        await self._wait(self._opened)
        if self._ended.is_set():
            self._raise_error()
            raise ClientClosed("the client was closed while it was being opened", link=self._link)

    async def close(self) -> None:
        """Close the client and wait until the task has ended; without effect after that.

        Cancellation skips no step of closing.

        Raises:
            Exception: an unexpected error that has ended the client, or occurred while it was closed; from
                the first call only.
        """
        if not self._opened.is_set():
            self._scope.cancel()
        self._is_to_close.set()
        await self._wait(self._ended)
        self._raise_error()

    async def _wait(self, event: anyio.Event) -> None:
        """Wait for an event. If that is cancelled, cancel the task and wait for its end."""
        try:
            await event.wait()
        except BaseException:
            self._scope.cancel()
            with anyio.CancelScope(shield=True):
                await self._ended.wait()
            raise

    async def _run(self) -> None:
        try:
            with self._scope:
                await self._client.open()
                await self._stay_open()
        except Exception as error:
            self._keep(error)
        finally:
            self._opened.set()
            self._ended.set()
            _running.discard(self)

    async def _stay_open(self) -> None:
        """Keep the client open until it is to be closed, the task is cancelled or a task of it fails."""
        try:
            self._opened.set()
            await self._is_to_close.wait()
        finally:
            await self._client.close()

    def _keep(self, error: Exception) -> None:
        """Keep an error for the caller of `open` or `close`, and make it the cause of ClientClosed."""
        self._error = error
        if not self._opened.is_set():
            return
        if not self._is_to_close.is_set():
            logger.error("%s: an unexpected error has ended the client", self._link, exc_info=error)
        try:
            self._client.check_open()
        except LinkError as ended:
            ended.__cause__ = error

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error


def _spawn(function: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a function in a task that belongs to the event loop, not to the caller's task."""
    if "trio" in sys.modules:
        from trio import lowlevel

        if lowlevel.in_trio_task():
            lowlevel.spawn_system_task(function, name=TASK_NAME)
            return
    import asyncio

    asyncio.get_running_loop().create_task(function(), name=TASK_NAME)
