"""MAVFTP calls: read and list files of a component."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import anyio

from paramclient.errors import NoReply
from paramclient.protocol import ftp

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
        read_size: int = ftp.DATA_SIZE_MAX,
        size_max: int = ftp.FILE_SIZE_MAX,
        progress: Callable[[int, int | None], None] | None = None,
        timeout: float | None = None,
    ) -> bytes:
        """Read a file. Its session on board is closed, also on cancellation.

        Args:
            path: of the file, as the component names it.
            read_size: bytes of each read, 1 to 239.
            size_max: bytes, at most.
            progress: called with the bytes received and the size, which is an estimate for generated files.
            timeout: seconds; None waits as long as the component answers.

        Raises:
            UsageError: the path is not valid.
            FileTransferError: the component refused it, or the file is larger than `size_max`.
            NoReply: it does not answer.
            LinkError: the link failed, or the client was closed.
        """
        self._component.core.check_open()
        channel = self._component.node.channel
        with self._limit(path, timeout):
            return await ftp.read_file(
                channel, path, read_size=read_size, size_max=size_max, progress=progress
            )

    async def list(self, path: str, *, timeout: float | None = None) -> list[ftp.DirectoryEntry]:
        """Return the entries of a directory.

        Raises:
            UsageError, FileTransferError, NoReply, LinkError: as from `read`.
        """
        self._component.core.check_open()
        with self._limit(path, timeout):
            return await ftp.list_directory(self._component.node.channel, path)

    async def checksum(self, path: str, *, timeout: float | None = None) -> int:
        """Return the CRC-32 of a file, computed by the component; see `crc32_px4`.

        Raises:
            UsageError, FileTransferError, NoReply, LinkError: as from `read`.
        """
        self._component.core.check_open()
        with self._limit(path, timeout):
            return await ftp.checksum(self._component.node.channel, path)

    def _limit(self, path: str, timeout: float | None) -> _Limit:
        return _Limit(f"{path} of {self._component.system}/{self._component.component}", timeout)


class _Limit:
    """Raises NoReply at a timeout."""

    def __init__(self, what: str, timeout: float | None) -> None:
        self._what = what
        self._scope = anyio.move_on_after(timeout)
        self._began = 0.0

    def __enter__(self) -> None:
        self._began = anyio.current_time()
        self._scope.__enter__()

    def __exit__(self, *error: object) -> bool | None:
        handled = self._scope.__exit__(*error)  # type: ignore[arg-type]  # the three parts of an exception
        if self._scope.cancelled_caught:
            raise NoReply(self._what, attempts=0, waited=anyio.current_time() - self._began)
        return handled
