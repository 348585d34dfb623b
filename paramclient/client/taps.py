"""The telemetry log and the forwarder of a client: both receive all frames of the link."""

from __future__ import annotations

import os
from collections.abc import Callable

import anyio.abc

from paramclient.client.forwarding import Forwarder
from paramclient.client.link_task import Tap
from paramclient.client.recording import Capture
from paramclient.client.traffic import Traffic
from paramclient.links import Link, create_link

__all__ = ["LinkTaps"]


class LinkTaps:
    """The optional telemetry log and the optional forwarder of a client.

    Args:
        tlog: path of the log to create, or None.
        forward: link to the other program, or None.
        is_stream: whether the vehicle link delivers a byte stream.
        counts_traffic: whether all traffic is counted.

    Attributes:
        forwarder: the forwarder, or None.
        traffic: the counts of all traffic, or None.
        taps: the receivers of all data on the link.
    """

    def __init__(
        self,
        tlog: str | os.PathLike[str] | None,
        forward: str | Link | None,
        *,
        is_stream: bool,
        counts_traffic: bool,
    ) -> None:
        self.forwarder: Forwarder | None = None
        self._capture: Capture | None = None
        self.traffic: Traffic | None = None
        self.taps: list[Tap] = []
        if tlog is not None:
            self._capture = Capture(tlog, is_stream=is_stream)
            self.taps.append(self._capture)
        if forward is not None:
            self.forwarder = Forwarder(create_link(forward), is_stream=is_stream)
            self.taps.append(self.forwarder)
        if counts_traffic:
            self.traffic = Traffic(is_stream=is_stream)
            self.taps.append(self.traffic)

    def share(self, to_vehicle: Callable[[bytes], None]) -> None:
        """Pass the frames of the program to this function, which sends them to the vehicles."""
        if self.forwarder is not None:
            self.forwarder.to_vehicle = to_vehicle

    async def open(self) -> None:
        """Open the link to the program and create the log.

        Raises:
            UsageError: the log exists or cannot be created.
            LinkError: the link to the program cannot be opened.
        """
        if self.forwarder is not None:
            await self.forwarder.open()
        if self._capture is not None:
            await self._capture.open()

    def start(self, tasks: anyio.abc.TaskGroup) -> None:
        """Start the tasks of the forwarder and of the log in this task group."""
        if self.forwarder is not None:
            tasks.start_soon(self.forwarder.read, name="paramclient forward reader")
            tasks.start_soon(self.forwarder.send, name="paramclient forward sender")
        if self._capture is not None:
            tasks.start_soon(self._capture.run, name="paramclient tlog writer")

    async def close(self) -> None:
        """Close the link to the program, write the remaining frames and close the log."""
        try:
            if self.forwarder is not None:
                await self.forwarder.close()
        finally:
            if self._capture is not None:
                await self._capture.close()
