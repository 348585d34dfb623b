"""File download: all parameters of a component as one packed file over MAVFTP."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Final

from paramclient.errors import FileErrorCode, FileTransferError, NoReply, PackError
from paramclient.model.values import is_portable_name
from paramclient.protocol.ftp import BUSY, FileRead, FileTransfers
from paramclient.protocol.ftp.packets import DATA_SIZE_MAX
from paramclient.protocol.ftp.param_pck import MAGICS, PACK_SIZE_MAX, Pack, decode, total_of
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch_result import Progress
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import FILE_READS_MAX
from paramclient.protocol.scheduler import ListAdmission, ListStatistics
from paramclient.protocol.wire import PARAMETERS_MAX, ParamValue

__all__ = ["PARAMETER_FILE", "WITH_DEFAULTS", "FileDownload"]

PARAMETER_FILE: Final = "@PARAM/param.pck"
"""The parameter file of ArduPilot 4.1 and later, and of PX4 after 1.17."""
WITH_DEFAULTS: Final = "?withdefaults=1"
"""The query for defaults, supported since ArduPilot 4.3; older servers may report that there is no such
file."""
FILE_SILENCE_TIMEOUT: Final = 2.0
"""Seconds of silence after which the file no longer delays the lists of other components."""


class FileDownload(Operation[None]):
    """One download of the packed file into the table. Ends with the table filled, or with an error.

    PARAM_VALUEs may arrive meanwhile: values received since the file was requested are newer than those in
    the file. A param_count that differs from the file's makes the file stale. The download waits for its turn
    on the link, as a list does.

    Args:
        files: the component's.
        list_admission: those of the link.
        table: the table to fill.
        changed: called with the changes.
        now: the time.
        context: the component's. Without support for defaults, the file is requested without them.
        yields: whether to end at once when another station has a file open, and early where no server
            responds.

    Attributes:
        queue_time: seconds for which it has waited for its turn.
        is_in_use: whether it ended because another station has a file open.
        is_useless: whether the component does not have the file, or an unreadable one, which does not change
            with this firmware.
        left_out: the indices of entries whose names no parameter file can hold: they were not stored.
        is_unanswered: whether it ended without any response, though the component was not lost.
    """

    def __init__(
        self,
        files: FileTransfers,
        list_admission: ListAdmission,
        table: Table,
        changed: Callable[[list[Change]], None],
        now: float,
        *,
        context: Context,
        yields: bool = False,
    ) -> None:
        super().__init__(now)
        self._context = context
        self._yields = yields
        self._files = files
        self._list_admission = list_admission
        self._table = table
        self._changed = changed
        self._received_names: set[str] = set()
        self._received_count: int | None = None
        self._attempts = 0
        self._query = WITH_DEFAULTS
        self._not_found: FileTransferError | None = None  # with the defaults
        self._job: FileRead | None = None
        self._silent_at = math.inf
        self._doubts = table.doubts
        self._requested_at = now
        self.queue_time = 0.0
        self.is_useless = False
        self.is_in_use = False
        self.is_unanswered = False
        self.left_out: tuple[int, ...] = ()
        self._count: int | None = None
        self._waits_since: float | None = now
        list_admission.ask(self, now)

    @property
    def is_silent(self) -> bool:
        """Whether nothing of the file was received although it was requested more than once."""
        return self.is_awaited and self._job is not None and self._job.attempts > 1

    @property
    def is_awaited(self) -> bool:
        """Whether nothing of the file was received."""
        return self._job is None or not self._job.received

    @property
    def requested_at(self) -> float:
        """When the opening of the file was requested; infinity while that waits for its turn."""
        return math.inf if self._job is None else self._job.requested_at

    @property
    def attempts(self) -> int:
        """The number of times the present request was sent."""
        return 0 if self._job is None else self._job.attempts

    def silence(self, now: float) -> NoReply:
        """Return the error for a file without a response."""
        return NoReply(PARAMETER_FILE, attempts=self.attempts, waited=now - self.requested_at)

    @property
    def is_served(self) -> bool:
        """Whether the component has opened the file."""
        return self._job is not None and self._job.session is not None

    @property
    def blocked_until(self) -> float | None:
        """When the file is opened again, while another station has a file open; None without one."""
        return None if self._job is None else self._job.blocked_until

    @property
    def silent_at(self) -> float:
        """When the file counts as silent for other lists, while nothing was received."""
        return self._silent_at if self.is_awaited else math.inf

    def give_way(self) -> None:
        """Let a list of the same component run in parallel, as long as nothing of the file is received."""
        self._list_admission.release(self)

    def seen(self) -> ListStatistics:
        """Return the statistics in messages: a burst that is repaired separately skips nothing."""
        blocks = 0 if self._job is None else self._job.received // DATA_SIZE_MAX
        return ListStatistics(blocks, blocks, 0.0, False)

    def begin(self, now: float) -> None:
        """Begin: it is this file's turn."""
        if self._waits_since is not None:
            self.queue_time += now - self._waits_since
            self._waits_since = None
        self._read(now)

    def queue_wait(self, now: float) -> float:
        """Return the seconds for which it has waited for its turn."""
        return self.queue_time + (0.0 if self._waits_since is None else now - self._waits_since)

    def progress(self, now: float) -> Progress:
        """Return the progress by the share of the file, whose size the vehicle reports."""
        job, total = self._job, self.count or self._table.count
        share = min(job.received / job.size, 1.0) if job is not None and job.size else float(self.done)
        received, running = int(share * (total or 0)), now - self.begun_at - self.queue_wait(now)
        left = running * (1 - share) / share if share else None
        rate = received / running if running > 0 else 0.0
        return Progress(received, total, rate, left)

    @property
    def count(self) -> int | None:
        """Parameters of the component, as soon as the file's header was received."""
        return self._count if self._job is None else total_of(self._job.beginning)

    def receive(self, message: ParamValue) -> None:
        """Process a PARAM_VALUE of the component, after the table has stored it."""
        self._received_names.add(message.param_id)
        if message.param_count <= PARAMETERS_MAX:
            self._received_count = message.param_count

    def look(self, now: float) -> None:
        """Check whether the component is known by now to have no file without defaults either."""
        error, job = self._not_found, self._job
        if error is not None and job is not None and not self.is_served and self._context.adds_defaults:
            self._job = None
            self._files.release(job, now, is_served=False)
            self._fails(error, now)

    def cancel(self, now: float, *, is_served: bool = True) -> None:
        """Cancel the download; the file is closed on board, where the component serves files."""
        job, self._job = self._job, None
        self._list_admission.release(self)
        if job is not None:
            self._files.release(job, now, is_served=is_served)

    def _read(self, now: float) -> None:
        self._attempts += 1
        self._requested_at = now
        self._silent_at = now + FILE_SILENCE_TIMEOUT
        self._doubts = self._table.doubts
        self._received_names.clear()
        self._received_count = None
        path = PARAMETER_FILE + self._query
        job = self._job = self._files.read(path, now, limit=PACK_SIZE_MAX, magics=MAGICS)
        job.yields = self._yields
        job.on_done.append(partial(self._take_file, job))

    def _take_file(self, job: FileRead) -> None:
        if self._job is not job:
            return
        self._job = None
        now = job.ended_at
        if job.result is None:
            may_be_the_query = isinstance(job.error, FileTransferError) and job.error.is_not_found
            if may_be_the_query and self._query and not self._context.adds_defaults:
                assert isinstance(job.error, FileTransferError)
                self._not_found = job.error
                self._query = ""
                self._attempts -= 1
                self._read(now)
            else:
                assert job.error is not None
                is_there = self._doubts == self._table.doubts
                self.is_unanswered = is_there and isinstance(job.error, NoReply) and not job.received
                self._fails(job.error, now)
            return
        total = total_of(job.result)
        if self._doubts != self._table.doubts:
            self._is_none(PackError("the vehicle was lost meanwhile", offset=0), now)
            return
        if total is not None and self._received_count not in (None, total):
            self._is_none(
                PackError(f"the vehicle has {self._received_count} parameters by now", offset=4), now
            )
            return
        try:
            pack = decode(job.result)
            if len(pack.entries) < pack.total:
                raise PackError(f"it has {len(pack.entries)} of {pack.total} parameters", offset=2)
            if pack.total > PARAMETERS_MAX:
                raise PackError(f"no component has {pack.total} parameters", offset=4)
        except PackError as error:
            self._is_none(error, now, is_useless=True)
            return
        self._list_admission.release(self)
        self._fill(pack)
        self.finish(None, now)

    def _fails(self, error: Exception, now: float) -> None:
        if isinstance(error, FileTransferError):
            self.is_useless = error.is_not_found or error.code == FileErrorCode.UNKNOWN_COMMAND
            self.is_in_use = error.code in BUSY
        self._list_admission.release(self)
        self.fail(error, now)

    def _is_none(self, error: PackError, now: float, *, is_useless: bool = False) -> None:
        """Read the file again, or give up: the received one is not the vehicle's table."""
        if self._attempts < FILE_READS_MAX:
            self._read(now)
            return
        self.is_useless = is_useless
        self._list_admission.release(self)
        self.fail(error, now)

    def _fill(self, pack: Pack) -> None:
        table = self._table
        changes = table.take_pack(pack, self._requested_at, self._received_names)
        present = {entry.name for entry in pack.entries}
        self.left_out = tuple(
            index for index, entry in enumerate(pack.entries) if not is_portable_name(entry.name)
        )
        changes += table.remove(
            lambda param: (
                param.name not in present
                and (param.index is not None or param.name in table.outdated_indices)
            )
        )
        table.outdated_indices.clear()
        table.count = self._count = pack.total
        self._changed(changes)
