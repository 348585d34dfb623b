"""Tap: a receiver of all frames of a link, such as the telemetry log and the forwarder."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence

from paramclient.client.frame_cutter import SeenFrame

__all__ = ["Tap"]


class Tap:
    """Receiver of all frames on a link: `open`, then `run` while the client is open, then `close`."""

    async def open(self) -> None:
        """Prepare to receive.

        Raises:
            UsageError, LinkError: it cannot receive.
        """

    def received(self, frames: Sequence[SeenFrame], size: int, peer: Hashable) -> None:
        """Take the frames that a received chunk of this size completes. Neither blocks nor raises."""

    def sent(self, frame: bytes) -> None:
        """Take a frame that is passed to the link. Neither blocks nor raises."""

    async def run(self, to_vehicles: Callable[[bytes], None]) -> None:
        """Work in the background, until cancelled; `to_vehicles` sends a frame of another program."""

    async def close(self) -> None:
        """Process the remaining frames and release what `open` has taken."""
