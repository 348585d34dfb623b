"""ReplayLink: a telemetry log as a link."""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO, Final

import anyio
import anyio.lowlevel

from paramclient.links.link import BaseLink, Peer
from paramclient.links.names import LinkSpec
from paramclient.links.refusals import reason
from paramclient.links.tlog import Record, open_log, read_records

LOG_PEER: Final = "log"
"""The only peer of a log."""
RECORDS_PER_READ: Final = 256
"""Frames that one `receive` returns at most, so that other tasks run in between."""
PAUSE_MAX: Final = 60.0
"""Seconds of the log after which a pause is shortened: joined logs may be days apart."""


class ReplayLink(BaseLink):
    """Delivers the frames of a log, of both directions, at the times in the log.

    Data that is sent is discarded. Opening the link again starts at the beginning of the log.

    Args:
        spec: a parsed name such as `replay:flight.tlog?speed=10`: ten times the original speed. 0 is as fast
            as the file can be read; without speed, the original speed.

    Attributes:
        at: the time of the last delivered frame, as a Unix time in seconds; None before the first.
    """

    reconnects = False

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec.name)
        self.at: float | None = None
        self._path = spec.host
        self._speed = dict(spec.options).get("speed", 1.0)
        self._file: BinaryIO | None = None
        self._records: Iterator[Record] = iter(())
        self._next: Record | None = None
        self._due = 0.0
        self._is_over = False
        self._closed = anyio.Event()

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`."""
        await anyio.lowlevel.checkpoint()
        if self._next is not None and self._due > anyio.current_time():
            with anyio.CancelScope(deadline=self._due):
                await self._closed.wait()
        elif self._is_over:
            await self._closed.wait()
        self._opened()
        found: list[tuple[Peer, bytes]] = []
        while self._next is not None and self._due <= anyio.current_time() and len(found) < RECORDS_PER_READ:
            found.append((LOG_PEER, self._next.data))
            self.at = self._next.at
            self._advance(self._next)
        self._is_over = not found
        return found

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`; discards the data."""
        await anyio.lowlevel.checkpoint()

    async def _open(self, opening: int) -> None:
        await anyio.lowlevel.checkpoint()
        self._file = open_log(self._path, self.name)
        self._records = read_records(self._file)
        self._closed = anyio.Event()
        self._due = anyio.current_time()
        self._is_over = False
        self._next = next(self._records, None)

    async def _release(self) -> None:
        self._closed.set()
        self._records = iter(())
        if self._file is not None:
            self._file.close()
            self._file = None

    def _advance(self, before: Record) -> None:
        try:
            self._next = next(self._records, None)
        except OSError as error:
            raise self._error(f"cannot read: {reason(error)}") from error
        if self._next is not None and self._speed:
            self._due += min(max(self._next.at - before.at, 0.0), PAUSE_MAX) / self._speed
