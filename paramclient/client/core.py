"""ClientCore: the link of a client, its station, cache and tasks. ClientTask: opens and closes it."""

from __future__ import annotations

import logging
import sys
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import AsyncExitStack
from functools import partial
from typing import Any, Final

import anyio
import anyio.abc

from paramclient.client.cache_writer import CacheWriter
from paramclient.client.link_task import LinkTask
from paramclient.client.signing import TimestampKeeper
from paramclient.client.taps import FrameCutter, Tap
from paramclient.errors import ClientClosed, LinkError, ParamClientError, UsageError
from paramclient.links import Link
from paramclient.protocol.station import Station

__all__ = ["ClientCore", "ClientTask"]

TASK_NAME: Final = "paramclient client"
"""Name of the task, in the debuggers of asyncio and trio."""

logger = logging.getLogger(__name__)

running: set[ClientTask] = set()
"""The tasks that have not ended: asyncio itself holds only weak references to its tasks."""


class ClientCore:
    """The link of a client, the station, the cache and their tasks.

    Args:
        link: the link, not open.
        cache_writer: writes tables to the cache.
        taps: receivers of all frames of the link.
        cutter: cuts received data for the taps.
        keeper: stores the signature timestamps; None without a key.
        new_station: makes the station, of functions that queue bytes and start background work.
        ended: called when the streams end: with a log, with a link that has failed for good, or at closing.

    Attributes:
        link_task, station, cache_writer: the parts.
        cache: the cache of the tables, or None.
        is_over: whether a log has ended.
    """

    def __init__(
        self,
        link: Link,
        cache_writer: CacheWriter,
        taps: Sequence[Tap],
        cutter: FrameCutter,
        keeper: TimestampKeeper | None,
        new_station: Callable[..., Station],
        ended: Callable[[], None],
    ) -> None:
        self.link = link
        self.cache_writer = cache_writer
        self.cache = cache_writer.cache
        self.is_over = False
        self.link_task = LinkTask(link, taps=taps, cutter=cutter, ended=self._link_ended)
        self.station = self.link_task.station = new_station(send=self.link_task.queue, spawn=self.spawn)
        self._taps = taps
        self._keeper = keeper
        self._ended = ended
        self._io: anyio.abc.TaskGroup | None = None
        self._work: anyio.abc.TaskGroup | None = None
        self._was_opened = False
        self._steps = AsyncExitStack()

    @property
    def state(self) -> str:
        """open, reconnecting or closed."""
        if self._io is None or self.station.gate.is_closed:
            return "closed"
        return "reconnecting" if self.link_task.is_disconnected else "open"

    def check_open(self) -> None:
        """Check that requests can be sent.

        Raises:
            LinkError: the link failed, or the client is not open.
        """
        self.station.gate.check()
        if self._io is None:
            raise ClientClosed("the client is not open; use `async with` or `open`", link=self.link.name)
        if self._work is None or self._work.cancel_scope.cancel_called:
            raise ClientClosed("the client was closed", link=self.link.name)

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
        """Open the link and the cache, and start the tasks.

        Raises:
            UsageError, LinkError: as from entering a `ParamClient`.
        """
        if self._was_opened:
            raise UsageError("a ParamClient can be opened only once; create a new one")
        self._was_opened = True
        async with AsyncExitStack() as steps:  # the way back
            steps.push_async_callback(self._release)
            await self.link.open()
            await self.cache_writer.open()
            for tap in self._taps:
                await tap.open()
            if self._keeper is not None:
                self.station.begin_signing(*await self._keeper.open())
            self.station.listening_since = anyio.current_time()
            io = self._io = await steps.enter_async_context(anyio.create_task_group())
            steps.callback(io.cancel_scope.cancel)
            steps.callback(self._end)
            self._work = await steps.enter_async_context(anyio.create_task_group())
            steps.callback(self._work.cancel_scope.cancel)
            io.start_soon(self.link_task.read, name="paramclient reader")
            io.start_soon(self.link_task.send, name="paramclient sender")
            io.start_soon(self.cache_writer.run, name="paramclient cache writer")
            for tap in self._taps:
                io.start_soon(tap.run, self.link_task.forward)
            if self._keeper is not None:
                io.start_soon(self._keeper.run, name="paramclient timestamp keeper")
            self.spawn(self.station.send_heartbeats)
            self._steps = steps.pop_all()

    async def close(self) -> None:
        """End waiting calls, write new values, and release the link and the cache.

        Conversations are cancelled first, while the link still carries what they send to close files on
        board. Cancellation does not skip these steps.
        """
        await self._steps.aclose()

    def _end(self) -> None:
        self._work = None
        self.station.fail(ClientClosed("the client was closed", link=self.link.name), for_good=True)
        self.link_task.notify()
        self._ended()

    async def _release(self) -> None:
        with anyio.CancelScope(shield=True):
            self.link_task.end_streams()
            closing: list[Callable[[], Awaitable[None]]] = [
                partial(self.cache_writer.close, self.station.nodes.values()),
                *(tap.close for tap in self._taps),
                self.link.close,
            ]
            for close in closing:
                try:
                    await close()
                except ParamClientError as error:
                    logger.warning("%s: %s", self.link.name, error)
            if self._keeper is not None:
                await self._keeper.close()

    def _link_ended(self) -> None:
        self.is_over = not self.station.gate.is_closed
        if self.is_over:
            for node in self.station.nodes.values():
                node.presence.is_over = True
        self._ended()


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
        running.add(self)
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
            running.discard(self)

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
