"""ClientCore: the link of a client, its station, cache and tasks; opening and closing."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import Any

import anyio
import anyio.abc

from paramclient.client.cache_writer import CacheWriter
from paramclient.client.frame_cutter import FrameCutter
from paramclient.client.link_task import LinkTask
from paramclient.client.signing_timestamps import TimestampKeeper
from paramclient.client.taps import Tap
from paramclient.errors import ClientClosed, ParamClientError, UsageError
from paramclient.links import Link
from paramclient.protocol.station import Station

__all__ = ["ClientCore"]

logger = logging.getLogger(__name__)


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
        try:
            await self.link.open()
            await self.cache_writer.open()
            for tap in self._taps:
                await tap.open()
            if self._keeper is not None:
                self.station.begin_signing(*await self._keeper.open())
        except BaseException:
            await self._release()
            raise
        self.station.listening_since = anyio.current_time()
        self._io, self._work = anyio.create_task_group(), anyio.create_task_group()
        await self._io.__aenter__()
        await self._work.__aenter__()
        self._io.start_soon(self.link_task.read, name="paramclient reader")
        self._io.start_soon(self.link_task.send, name="paramclient sender")
        self._io.start_soon(self.cache_writer.run, name="paramclient cache writer")
        for tap in self._taps:
            self._io.start_soon(tap.run, self.link_task.forward)
        if self._keeper is not None:
            self._io.start_soon(self._keeper.run, name="paramclient timestamp keeper")
        self.spawn(self.station.send_heartbeats)

    async def close(self) -> None:
        """End waiting calls, write new values, and release the link and the cache.

        Conversations are cancelled first, while the link still carries what they send to close files on
        board. Cancellation does not skip these steps.
        """
        io, work = self._io, self._work
        assert io is not None
        assert work is not None
        work.cancel_scope.cancel()
        try:
            await work.__aexit__(None, None, None)
        finally:
            self._work = None
            self.station.fail(ClientClosed("the client was closed", link=self.link.name), for_good=True)
            self.link_task.notify()
            self._ended()
            io.cancel_scope.cancel()
            try:
                await io.__aexit__(None, None, None)
            finally:
                self._io = None
                await self._release()

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
