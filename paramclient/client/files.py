"""The files of a component over MAVFTP, as users see them."""

from __future__ import annotations

import builtins
from collections.abc import Callable
from typing import TypeVar

import anyio

from paramclient.client.component import Component
from paramclient.client.local import local
from paramclient.protocol.ftp import FILE_SIZE_MAX, DirectoryEntry, FileTransfers
from paramclient.protocol.ftp.transfer_job import Job

__all__ = ["Ftp"]

Result = TypeVar("Result")


class Ftp:
    """Reads and writes the files of one component; `ParamClient.ftp` gives it.

    A vehicle serves one file at a time, so calls are done in order, a `fetch_all` that reads the parameter
    file among them. However one ends, also cancelled, the file is closed on board.

    Every call raises FileTransferError when the vehicle says no, NoReply when it does not answer in time or
    is lost, and LinkError when the link failed or the client was closed.
    """

    def __init__(self, component: Component) -> None:
        self._component = local(component)

    def __repr__(self) -> str:
        return f"<Ftp {self._component.system}/{self._component.component}>"

    async def read(
        self,
        path: str,
        *,
        timeout: float | None = None,
        progress: Callable[[int, int | None], None] | None = None,
        limit: int = FILE_SIZE_MAX,
    ) -> bytes:
        """Read a whole file.

        Args:
            path: as the vehicle names it, such as `@PARAM/param.pck` or `/fs/microsd/log.txt`.
            timeout: seconds; None leaves it to the number of tries, which follows the link.
            progress: called about ten times a second, from this task, with the bytes that have come and the
                size that the vehicle gives (None before it did; ArduPilot's is an estimate for files that
                it makes up).
            limit: bytes above which the file is not taken.

        Raises:
            UsageError: the path cannot be.
        """
        what = f"the file {path}"
        files, now = self._begin(what)
        job = files.read(path, now, limit=limit)
        tell = None if progress is None else lambda: progress(job.received, job.size)
        return await self._wait(job, what, timeout, tell)

    async def write(self, path: str, data: bytes, *, timeout: float | None = None) -> None:
        """Write a whole file in the place of one that may be there.

        When it fails or is cancelled half-way, what was written until then stays on board.

        Raises:
            UsageError: the path cannot be.
        """
        what = f"the writing of {path}"
        files, now = self._begin(what)
        job = files.write(path, data, now)
        await self._wait(job, what, timeout)

    async def list(
        self, path: str = "/", *, timeout: float | None = None
    ) -> builtins.tuple[DirectoryEntry, ...]:
        """The entries of a directory.

        Raises:
            UsageError: the path cannot be.
        """
        what = f"the directory {path}"
        files, now = self._begin(what)
        job = files.list(path, now)
        return await self._wait(job, what, timeout)

    async def checksum(self, path: str, *, timeout: float | None = None) -> int:
        """The CRC-32 of a file, computed on board: start value 0 and no final xor, as in PX4's hash.

        Raises:
            UsageError: the path cannot be.
        """
        what = f"the checksum of {path}"
        files, now = self._begin(what)
        job = files.checksum(path, now)
        return await self._wait(job, what, timeout)

    def _begin(self, what: str) -> builtins.tuple[FileTransfers, float]:
        """What to ask, and the time, if anything may be asked."""
        component, now = self._component, anyio.current_time()
        component.client.check_open()
        component.machine.check_present(f"{what} of {component.system}/{component.component}", now)
        return component.machine.files, now

    async def _wait(
        self,
        job: Job[Result],
        what: str,
        timeout: float | None,
        tell: Callable[[], None] | None = None,
    ) -> Result:
        component = self._component
        job.is_of_caller = True
        awaited = f"{what} of {component.system}/{component.component}"
        try:
            return await component.wait(job, timeout, lambda: (awaited, 0), tell)
        finally:
            component.machine.files.release(job, anyio.current_time())
            component.wake()
            await component.wait_until_files_closed()
