"""Ftp: MAVFTP file calls of one component."""

from __future__ import annotations

import builtins
from collections.abc import Callable
from typing import TypeVar

import anyio

from paramclient.client.component_core import ComponentCore
from paramclient.protocol.ftp import FILE_SIZE_MAX, DirectoryEntry, FileTransfers
from paramclient.protocol.ftp.transfer_job import FileTransferJob

__all__ = ["Ftp"]

Result = TypeVar("Result")


class Ftp:
    """Reads and writes files of one component over MAVFTP; see `ParamClient.ftp`.

    A vehicle serves one file at a time, so calls run in order, including the file download of `fetch_all`.
    After each call, also after an error or cancellation, the client closes the file session on board.

    Raises:
        FileTransferError: the vehicle reports an error.
        NoReply: the vehicle does not respond in time, or it is lost.
        LinkError: the link failed, or the client was closed.
    """

    def __init__(self, core: ComponentCore) -> None:
        self._core = core

    def __repr__(self) -> str:
        return f"<Ftp {self._core.label}>"

    async def read(
        self,
        path: str,
        *,
        timeout: float | None = None,
        progress: Callable[[int, int | None], None] | None = None,
        limit: int = FILE_SIZE_MAX,
    ) -> bytes:
        """Read a file and return its content.

        Args:
            path: path on the vehicle, such as `@PARAM/param.pck` or `/fs/microsd/log.txt`.
            timeout: seconds; None: the number of attempts, which follows the link quality, limits the time.
            progress: called about ten times a second, from this task, with the received bytes and the file
                size that the vehicle reports (None before the report; an estimate for files that ArduPilot
                generates).
            limit: maximum file size in bytes; a larger file is not read.

        Raises:
            UsageError: the path is not valid.
            FileTransferError, NoReply, LinkError: as for every call, see `Ftp`.
        """
        what = f"the file {path}"
        files, now = self._begin(what)
        job = files.read(path, now, limit=limit)
        report = None if progress is None else lambda: progress(job.received, job.size)
        return await self._wait(job, what, timeout, report)

    async def write(self, path: str, data: bytes, *, timeout: float | None = None) -> None:
        """Write a file, replacing an existing one.

        After an error or cancellation, the data written so far stays on board.

        Args:
            path: path on the vehicle.
            data: content of the file.
            timeout: as in `read`.

        Raises:
            UsageError: the path is not valid.
            FileTransferError, NoReply, LinkError: as for every call, see `Ftp`.
        """
        what = f"the writing of {path}"
        files, now = self._begin(what)
        job = files.write(path, data, now)
        await self._wait(job, what, timeout)

    async def list(
        self, path: str = "/", *, timeout: float | None = None
    ) -> builtins.tuple[DirectoryEntry, ...]:
        """Return the entries of a directory.

        Args:
            path: path on the vehicle.
            timeout: as in `read`.

        Raises:
            UsageError: the path is not valid.
            FileTransferError, NoReply, LinkError: as for every call, see `Ftp`.
        """
        what = f"the directory {path}"
        files, now = self._begin(what)
        job = files.list(path, now)
        return await self._wait(job, what, timeout)

    async def checksum(self, path: str, *, timeout: float | None = None) -> int:
        """Return the CRC-32 of a file, computed on board: initial value 0, no final xor, as in PX4's hash.

        Args:
            path: path on the vehicle.
            timeout: as in `read`.

        Raises:
            UsageError: the path is not valid.
            FileTransferError, NoReply, LinkError: as for every call, see `Ftp`.
        """
        what = f"the checksum of {path}"
        files, now = self._begin(what)
        job = files.checksum(path, now)
        return await self._wait(job, what, timeout)

    def _begin(self, what: str) -> builtins.tuple[FileTransfers, float]:
        """Return the file transfers of the component and the time.

        Raises:
            NoReply: the component is lost.
            LinkError: the link failed, or the client is not open.
        """
        core, now = self._core, anyio.current_time()
        core.client.check_open()
        core.machine.check_present(f"{what} of {core.label}", now)
        return core.machine.files, now

    async def _wait(
        self,
        job: FileTransferJob[Result],
        what: str,
        timeout: float | None,
        report: Callable[[], None] | None = None,
    ) -> Result:
        core = self._core
        job.is_of_caller = True
        try:
            return await core.wait(job, timeout, lambda: (f"{what} of {core.label}", 0), report)
        finally:
            core.machine.files.release(job, anyio.current_time())
            core.client.wake()
            await core.wait_until_files_closed()
