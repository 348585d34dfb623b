"""What a client does with everything on the link beside its own work: a log, and another program's share."""

from __future__ import annotations

import os
from collections.abc import Callable

import anyio.abc

from paramclient.client.forwarding import Forwarder
from paramclient.client.link_task import Tap
from paramclient.client.recording import Capture
from paramclient.links import Link, create_link

__all__ = ["Beside"]


class Beside:
    """The telemetry log and the other program of a client, as far as there are any.

    Args:
        tlog: the log to be made, or None.
        forward: the link to the other program, or None.
        is_stream: whether the vehicle link delivers a stream.

    Attributes:
        forwarder: what passes frames on, or None.
        taps: what is to be told of everything on the link.
    """

    def __init__(
        self,
        tlog: str | os.PathLike[str] | None,
        forward: str | Link | None,
        *,
        is_stream: bool,
    ) -> None:
        self.forwarder: Forwarder | None = None
        self._capture: Capture | None = None
        self.taps: list[Tap] = []
        if tlog is not None:
            self._capture = Capture(tlog, is_stream=is_stream)
            self.taps.append(self._capture)
        if forward is not None:
            self.forwarder = Forwarder(create_link(forward), is_stream=is_stream)
            self.taps.append(self.forwarder)

    def share(self, to_vehicle: Callable[[bytes], None]) -> None:
        """Let the program send to the vehicles too, by what takes each of its frames."""
        if self.forwarder is not None:
            self.forwarder.to_vehicle = to_vehicle

    async def open(self) -> None:
        """Make the log and open the link to the program.

        Raises:
            UsageError, LinkError: as they say.
        """
        if self.forwarder is not None:
            await self.forwarder.open()
        if self._capture is not None:
            await self._capture.open()

    def start(self, tasks: anyio.abc.TaskGroup) -> None:
        """Begin what is done until the tasks are cancelled."""
        if self.forwarder is not None:
            tasks.start_soon(self.forwarder.read, name="paramclient forward reader")
            tasks.start_soon(self.forwarder.send, name="paramclient forward sender")
        if self._capture is not None:
            tasks.start_soon(self._capture.run, name="paramclient tlog writer")

    async def close(self) -> None:
        """Write what is left of the log, and leave nothing behind."""
        try:
            if self.forwarder is not None:
                await self.forwarder.close()
        finally:
            if self._capture is not None:
                await self._capture.close()
