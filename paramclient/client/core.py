"""ClientCore: the link of a client, its station, cache and tasks; opening and closing."""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from functools import partial
from typing import Any, Final

import anyio
import anyio.abc
import anyio.lowlevel

from paramclient.client.cache_writer import CacheWriter
from paramclient.client.link_task import LinkTask
from paramclient.client.signing import Signing
from paramclient.client.taps import Tap
from paramclient.errors import ClientClosed, ParamClientError, UsageError
from paramclient.links import Link
from paramclient.protocol.station import Station

TASK_NAME: Final = "paramclient client"
"""Name of the task, in the debuggers of asyncio and trio."""

logger = logging.getLogger(__name__)

running: set[ClientCore] = set()
"""The clients whose task has not ended: asyncio itself holds only weak references to its tasks."""


class ClientCore:
    """The link of a client, the station, the cache and their tasks.

    All tasks run in one of their own, which `open` starts and `close` ends: the callers of the two may be
    different tasks, and cancelling one of them takes the link away from no conversation that closes a file
    on board. If the event loop ends first, it cancels the task, which then closes the client.

    Args:
        link: the link, not open.
        cache_writer: writes tables to the cache.
        taps: receivers of all frames of the link.
        signing: the key and its options, or None.
        ended: called when the streams end: with a log, with a link that has failed for good, or at closing.

    Attributes:
        link_task, cache_writer: the parts.
        station: set before `open`.
        cache: the cache of the tables, or None.
        is_over: whether a log has ended.
    """

    station: Station

    def __init__(
        self,
        link: Link,
        cache_writer: CacheWriter,
        taps: Sequence[Tap],
        signing: Signing | None,
        ended: Callable[[], None],
    ) -> None:
        self.link = link
        self.cache_writer = cache_writer
        self.cache = cache_writer.cache
        self.is_over = False
        self.link_task = LinkTask(link, taps, ended=self._link_ended)
        self._signing = signing
        self._ended = ended
        self._work: anyio.abc.TaskGroup | None = None
        self._scope: anyio.CancelScope | None = None  # from `open` on: it needs an event loop
        self._is_opened = anyio.Event()
        self._is_to_close = anyio.Event()
        self._is_closed = anyio.Event()
        self._error: Exception | None = None

    @property
    def state(self) -> str:
        """open, reconnecting or closed."""
        if self._work is None or self.station.gate.is_closed:
            return "closed"
        return "reconnecting" if self.link_task.is_disconnected else "open"

    def add_tap(self, tap: Tap) -> None:
        """Pass all frames of the link also to this receiver; before `open`."""
        self.link_task.taps.append(tap)

    def spawn(self, work: Callable[..., Any], *arguments: Any) -> None:
        """Run a function in the background. Its errors are logged, and never end the link."""
        if self._work is not None and not self._work.cancel_scope.cancel_called:
            self._work.start_soon(self._supervise, work, *arguments)

    async def _supervise(self, work: Callable[..., Any], *arguments: Any) -> None:
        try:
            await work(*arguments)
        except ParamClientError as error:
            logger.debug("%s: %s", self.link.name, error)
        except Exception:
            logger.exception("%s: unexpected error", self.link.name)

    async def open(self) -> None:
        """Open the link and the cache, and start the tasks. Cancellation closes the client again.

        Raises:
            UsageError, LinkError: as from entering a `ParamClient`.
            ClientClosed: `close` was called meanwhile.
        """
        if self._scope is not None:
            raise UsageError("a ParamClient can be opened only once; create a new one")
        scope = self._scope = anyio.CancelScope()
        running.add(self)
        _spawn(partial(self._run, scope))
        try:
            await self._is_opened.wait()
        except BaseException:
            scope.cancel()
            with anyio.CancelScope(shield=True):
                await self._is_closed.wait()
            raise
        if self._is_closed.is_set():
            self._raise_error()
            raise ClientClosed("the client was closed while it was being opened", link=self.link.name)

    async def close(self) -> None:
        """End waiting calls, write new values, and release the link and the cache.

        Without effect before `open`, and after the first call. Cancellation skips no step.

        Raises:
            Exception: an unexpected error that has ended the client, or occurred while it was closed; from
                the first call only.
        """
        if self._scope is not None:
            if not self._is_opened.is_set():
                self._scope.cancel()
            self._is_to_close.set()
            with anyio.CancelScope(shield=True):
                await self._is_closed.wait()
            self._raise_error()
            await anyio.lowlevel.checkpoint()

    async def _run(self, scope: anyio.CancelScope) -> None:
        try:
            with scope:
                await self._live()
        except Exception as error:
            self._error = error  # for the caller of `open` or `close`, and as the cause of ClientClosed
            if self._is_opened.is_set() and not self._is_to_close.is_set():
                logger.error("%s: an unexpected error has ended the client", self.link.name, exc_info=error)
            self.link_task.closed.__cause__ = error
        finally:
            self._is_opened.set()
            self._is_closed.set()
            running.discard(self)

    async def _live(self) -> None:
        """Open the client, and close it when it is to be closed, is cancelled or a task of it fails.

        Conversations are cancelled first, while the link still carries what they send to close files on
        board.
        """
        try:
            await self.link.open()
            await self.cache_writer.open()
            for tap in self.link_task.taps:
                await tap.open()
            if self._signing is not None:
                self.station.begin_signing(*self._signing.begin())
            logger.debug("%s: open", self.link.name)
            self.station.listening_since = anyio.current_time()
            async with anyio.create_task_group() as io:
                io.start_soon(self.link_task.read, name="paramclient reader")
                io.start_soon(self.link_task.send, name="paramclient sender")
                io.start_soon(self.cache_writer.run, name="paramclient cache writer")
                for tap in self.link_task.taps:
                    io.start_soon(tap.run)
                try:
                    async with anyio.create_task_group() as self._work:
                        self.spawn(self.station.send_heartbeats)
                        self.station.gate.open()
                        self._is_opened.set()
                        await self._is_to_close.wait()
                        logger.debug("%s: closing", self.link.name)
                        self._work.cancel_scope.cancel()
                finally:
                    self._work = None
                    self.station.fail(self.link_task.closed, for_good=True)
                    self.link_task.notify()
                    self._ended()
                    io.cancel_scope.cancel()
        finally:
            await self._release()

    async def _release(self) -> None:
        with anyio.CancelScope(shield=True):
            self.link_task.end_streams()
            closing: list[Callable[[], Awaitable[None]]] = [
                partial(self.cache_writer.close, self.station.nodes.values()),
                self.link_task.flush,  # the last messages of conversations that were ended
                *(tap.close for tap in self.link_task.taps),
                self.link.close,
            ]
            for close in closing:
                try:
                    await close()
                except ParamClientError as error:
                    logger.warning("%s: %s", self.link.name, error)

    def _link_ended(self) -> None:
        self.is_over = not self.station.gate.is_closed
        if self.is_over:
            for node in self.station.nodes.values():
                node.presence.is_over = True
        self._ended()

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error


def seconds_of(timeout: float | None) -> float:
    """Return a timeout in seconds, infinite for None; raise UsageError for anything but a number from 0."""
    seconds = math.inf if timeout is None else timeout
    if not (isinstance(seconds, int | float) and seconds >= 0):
        raise UsageError(f"a timeout is a number of seconds from 0, or None, not {timeout!r}")
    return seconds


def _spawn(function: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a function in a task that belongs to the event loop, not to the caller's task."""
    if "trio" in sys.modules:
        from trio import lowlevel

        if lowlevel.in_trio_task():
            lowlevel.spawn_system_task(function, name=TASK_NAME)
            return
    import asyncio

    asyncio.get_running_loop().create_task(function(), name=TASK_NAME)
