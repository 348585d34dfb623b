"""ClientCore: the link of a client, its protocol core, cache and tasks; opening and closing."""

from __future__ import annotations

import logging
import math
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Final

import anyio
import anyio.abc

from paramclient.cache import ParamCache
from paramclient.client.cache_writer import CacheWriter
from paramclient.client.link_task import LinkTask
from paramclient.client.signing_timestamps import TimestampKeeper
from paramclient.client.taps import LinkTaps
from paramclient.errors import ClientClosed, LinkError, UsageError
from paramclient.links import Link
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.station import Station

__all__ = ["ClientCore"]

CLOSING_HASH_TIMEOUT: Final = 0.5
"""Seconds for which closing waits for the hash after a write, if the next session needs it for the cache."""
SESSION_CLOSE_TIMEOUT: Final = 2.0
"""Seconds for which closing waits for the end of file sessions on board. The request has been sent by then; a
running burst on a radio delays it, and the vehicle executes it after the burst."""

logger = logging.getLogger("paramclient.client")


class ClientCore:
    """The link of a client, the protocol core, the cache and their tasks.

    Args:
        link: the link, not open.
        station: the protocol core of the link.
        cache: the cache of its tables, or None.
        owns_cache: whether `close` closes the cache.
        taps: the telemetry log and the forwarder.
        keeper: stores the signature timestamps; None without a key.

    Attributes:
        link, station, cache: as given.
        link_task: the tasks that read and send; `activity` is set when anything was received.
        cache_writer: writes tables to the cache.
        opened_at: when the client was opened, by the clock of the event loop.
        dispatch: processes the events of the protocol core; called after each change of its state.
        end_streams: called when no further event can happen, with the error of waiting consumers, or with
            None at the end of a log.
    """

    def __init__(
        self,
        link: Link,
        station: Station,
        cache: ParamCache | None,
        *,
        owns_cache: bool,
        taps: LinkTaps,
        keeper: TimestampKeeper | None,
    ) -> None:
        self.link = link
        self.station = station
        self.cache = cache
        self.opened_at = -math.inf
        self.dispatch: Callable[[], None] = _nothing
        self.end_streams: Callable[[LinkError | None], None] = _nothing
        self.link_task = LinkTask(
            link,
            station,
            dispatch=lambda: self.dispatch(),
            end=self._end,
            taps=taps.taps,
            may_rest=taps.forwarder is None,
        )
        self.cache_writer = CacheWriter(
            cache,
            owned=owns_cache,
            identity_of=station.identity_of,
            is_doubted=station.is_doubted,
            detect_suspend=self.link_task.detect_suspend,
        )
        self._taps = taps
        if not station.listens_only:
            taps.share(self.link_task.send_for_another)
        self._keeper = keeper
        self._tasks: anyio.abc.TaskGroup | None = None
        self._outlasting: list[anyio.CancelScope] = []
        self._was_opened = False

    @property
    def is_over(self) -> bool:
        """Whether no further event can happen: the log has ended, or the client or its link for good."""
        return self.station.is_over or self.link_task.ended is not None

    @property
    def state(self) -> str:
        """open, reconnecting or closed."""
        if self._tasks is None or self.link_task.ended is not None:
            return "closed"
        return "reconnecting" if self.link_task.is_disconnected else "open"

    def check_open(self) -> None:
        """Check that requests can be sent.

        Raises:
            LinkError: the link failed, or the client is not open.
        """
        if self.link_task.broken is not None:
            raise self.link_task.broken.with_traceback(None)
        if self._tasks is None:
            raise ClientClosed(
                "the client is not open; use `async with` (`with` in paramclient.sync) or `open`",
                link=self.link.name,
            )

    def wake(self) -> None:
        """Run the sender: something is to be sent, or a deadline has changed."""
        self.link_task.wake()

    def start(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run a function in a task that ends with the client."""
        assert self._tasks is not None, "no message arrives before"
        self._tasks.start_soon(work)

    async def open(self) -> None:
        """Open the link and the cache, and start the tasks.

        Raises:
            UsageError, LinkError: as from entering a `ParamClient`.
        """
        if self._was_opened:
            raise UsageError("a ParamClient can be opened only once; create a new one")
        self._was_opened = True
        try:
            await self.link.open()
            await self.cache_writer.open()
            await self._taps.open()
            if self._keeper is not None:
                self.station.begin_signing(*await self._keeper.open())
        except BaseException:
            await self._release()
            raise
        logger.debug("%s: open", self.link.name)
        tasks = anyio.create_task_group()
        await tasks.__aenter__()
        self._tasks = tasks
        self.opened_at = self.station.listening_since = anyio.current_time()
        tasks.start_soon(self._run_until_files_closed, self.link_task.read, name="paramclient reader")
        tasks.start_soon(self._run_until_files_closed, self.link_task.send, name="paramclient sender")
        tasks.start_soon(self.cache_writer.run, name="paramclient cache writer")
        self._taps.start(tasks)
        if self._keeper is not None:
            tasks.start_soon(self._keeper.run, name="paramclient timestamp keeper")

    async def close(self, *, failed: bool) -> None:
        """End waiting calls, write new values, and release the link and the cache.

        Cancellation does not skip these steps.

        Args:
            failed: whether the body of the `async with` has raised; then closing does not wait for a hash.
        """
        tasks = self._tasks
        assert tasks is not None
        try:
            if not failed and self.link_task.broken is None:
                await self._let_hashes_settle()
        finally:
            closed = ClientClosed("the client was closed", link=self.link.name)
            try:
                await self._close_files(closed)
            finally:
                self._end(closed)
                for scope in (*self._outlasting, tasks.cancel_scope):
                    scope.cancel()
            try:
                # without the caller's exception, which the task group would wrap in an ExceptionGroup
                await tasks.__aexit__(None, None, None)
            finally:
                await self._release()

    async def _release(self) -> None:
        """Close the link, the cache and the taps, also when cancelled."""
        logger.debug("%s: closing", self.link.name)
        with anyio.CancelScope(shield=True):
            try:
                await self.link.close()
                for machine in self.station.components.values():
                    await self.cache_writer.save_on_close(machine)
            finally:
                try:
                    await self.cache_writer.close()
                finally:
                    try:
                        if self._keeper is not None:
                            await self._keeper.close()
                    finally:
                        await self._taps.close()

    def _end(self, error: LinkError) -> None:
        """End all calls and streams permanently with this error."""
        self.dispatch()
        self.link_task.fail_for_good(error)
        self.end_streams(error)

    async def _let_hashes_settle(self) -> None:
        """Wait for the hash after writes of this client, if it cannot be computed locally."""
        with anyio.move_on_after(CLOSING_HASH_TIMEOUT):
            while any(
                machine.is_settling and machine.table.complete and not machine.table.volatile_known
                for machine in self.station.components.values()
            ):
                await self.link_task.activity.wait()

    async def _run_until_files_closed(self, work: Callable[[], Awaitable[None]]) -> None:
        """Run a task until file sessions are closed, also if a scope around the client is cancelled."""
        if self.link_task.ended is None:
            with anyio.CancelScope(shield=True) as scope:
                self._outlasting.append(scope)
                await work()

    async def _close_files(self, error: LinkError) -> None:
        """End waiting calls, and close open file sessions on board, also when cancelled.

        ArduPilot has one session for all links: an open session blocks file access of all stations for 3 s.
        """
        if self.link_task.broken is None:
            self.link_task.fail_calls(error)
            machines = [each for each in self.station.components.values() if each.files.is_closing]
            if not machines:
                return
            with anyio.CancelScope(shield=True), anyio.move_on_after(SESSION_CLOSE_TIMEOUT):
                async with anyio.create_task_group() as tasks:
                    # `asyncio.run` cancels the other tasks one by one when its main task has ended: these
                    # replace the reader and the sender
                    tasks.start_soon(self.link_task.read)
                    tasks.start_soon(self.link_task.send)
                    for machine in machines:
                        await self._wait_until_closed(machine)
                    tasks.cancel_scope.cancel()

    async def wait_until_files_closed(self, machine: ComponentMachine) -> None:
        """Wait at most one round trip until the file session that a component closes is closed on board.

        During a burst, vehicles ignore the request.
        """
        if machine.files.is_closing and self.link_task.broken is None:
            with anyio.move_on_after(machine.retry.prompt_timeout):
                await self._wait_until_closed(machine)

    async def _wait_until_closed(self, machine: ComponentMachine) -> None:
        carrier, files = self.link_task, machine.files

        def wake_waiter(now: float) -> None:
            carrier.notify()

        self.wake()
        while files.is_closing and not (carrier.is_disconnected or carrier.ended or machine.presence.is_lost):
            if wake_waiter not in files.on_closed:
                files.on_closed.append(wake_waiter)
            await carrier.activity.wait()


def _nothing(*_: object) -> None:
    return
