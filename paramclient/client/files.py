"""MAVFTP calls: read files of a component, and their checksums."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from paramclient.protocol import ftp
from paramclient.protocol.channel import Channel

if TYPE_CHECKING:
    from paramclient.client.component import Component

__all__ = ["Ftp"]


class Ftp:
    """The files of a component over MAVFTP; see `ParamClient.ftp`.

    A vehicle serves one file at a time: calls run one after the other.
    """

    def __init__(self, component: Component) -> None:
        self._component = component

    def __repr__(self) -> str:
        return f"<Ftp {self._component.system}/{self._component.component}>"

    async def read(
        self,
        path: str,
        *,
        size_max: int = ftp.FILE_SIZE_MAX,
        progress: Callable[[int, int | None], None] | None = None,
        timeout: float | None = None,
    ) -> bytes:
        """Read a file. Its session on board is closed, also on cancellation.

        Args:
            path: of the file, as the component names it.
            size_max: bytes, at most.
            progress: called with the bytes received and the size, which is an estimate for generated files.
            timeout: seconds; None waits as long as the component answers.

        Raises:
            UsageError: the path is not valid, or the client only listens.
            FileTransferError: the component refused it, or the file is larger than `size_max`.
            NoReply: it does not answer.
            LinkError: the link failed, or the client was closed.
        """
        with self._channel(path, timeout) as channel:
            return await ftp.read_file(channel, path, size_max=size_max, progress=progress)

    async def checksum(self, path: str, *, timeout: float | None = None) -> int:
        """Return the CRC-32 of a file, computed by the component; see `crc32_px4`.

        Raises:
            UsageError, FileTransferError, NoReply, LinkError: as from `read`.
        """
        with self._channel(path, timeout) as channel:
            return await ftp.checksum(channel, path)

    @contextmanager
    def _channel(self, path: str, timeout: float | None) -> Iterator[Channel]:
        """Raise NoReply at the timeout."""
        component = self._component
        component.core.station.check_may_send()
        with component.limited(timeout, f"{path} of {component.system}/{component.component}"):
            yield component.node.channel
