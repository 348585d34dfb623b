"""Many values at once as one file: the upload of param.pck to ArduPilot, and the proof of each value.

How ArduPilot takes the file (AP_Filesystem_Param.cpp and GCS_FTP.cpp of 4.6-dev, and of the main branch):

- It is parsed when it is closed, and the closing is acknowledged whatever became of it: only reading proves a
  value.
- The header's last number is the length of the file. A file of another length, or with another magic, is
  dropped.
- Entries are applied in order up to the first invalid one: the earlier ones stay applied. There is no
  padding, and no default.
- A name that the vehicle does not have is skipped. Each other value is converted to the parameter's type, as
  that of a PARAM_SET is; an int32 for an int32 keeps all bits. NaN and infinity change nothing.
- 4.6 also writes parameters that refuse a PARAM_SET as read-only; the main branch skips them.
- No PARAM_VALUE is sent for the changes, not to other stations either, and the on-board log has no entry.
- A value that equals the default is not stored if none was stored before; a PARAM_SET stores it.
- After an entry that switches on a group, the vehicle waits 0.1 s, and parses the file once more, up to 4
  times; the acknowledgement of the closing waits for that.

The recordings `ardupilot_param_upload` and `ardupilot_upload_abandoned` show this, except for the last but
two and the main branch.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from typing import Final, NamedTuple

from paramclient.errors import FileTransferError, PackError
from paramclient.model.px4_hash import crc32_px4
from paramclient.model.values import Encoding, Param, ParamType, Trust, as_reported
from paramclient.protocol.ftp import BUSY, CommittedWrite, FileChecksums, FileRead, FileTransfers
from paramclient.protocol.ftp.file_write import BLOCKS_IN_FLIGHT_MAX
from paramclient.protocol.ftp.packets import DATA_SIZE_MAX, FRAME_OVERHEAD
from paramclient.protocol.ftp.param_pck import (
    PACK_SIZE_MAX,
    PACKABLE,
    PackedParam,
    decode,
    encode,
    encode_upload,
)
from paramclient.protocol.ftp.transfers import CHECKSUMS_IN_FLIGHT_MAX
from paramclient.protocol.params.file_download import PARAMETER_FILE
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.write_window import WRITES_IN_FLIGHT_FIRST, WRITES_IN_FLIGHT_MAX
from paramclient.protocol.wire import NO_INDEX, ParamValue

__all__ = ["ParamUpload", "UploadHooks", "Uploads", "WriteWay"]

UPLOAD_VALUES_MIN: Final = 21
"""Values of a file, at least: fewer are sent by PARAM_SET within two round trips."""
UPLOAD_VALUES_MAX: Final = 2_900
"""Values of a file, at most: each takes up to 22 bytes of the 65,535 that its header can count."""
GAIN_MIN: Final = 0.1
"""Seconds, at least, that an upload should save: the vehicle takes some of them to apply the values, and
other stations see no PARAM_VALUE of an upload."""
CHECKSUM_READ_SIZE: Final = 64
"""Bytes that ArduPilot reads at a time to compute the checksum of a file (AP_Filesystem.cpp, `crc32`): the
padding of the file depends on it."""
SPANS_MAX: Final = 16
"""Parts of the table whose checksums are requested; more are read as one."""
SET_SIZE: Final = 35
"""Bytes of a PARAM_SET in MAVLink 2."""
VALUE_SIZE: Final = 37
"""Bytes of a PARAM_VALUE in MAVLink 2."""
RADIO_RATE_MAX: Final = 12_000.0
"""Bytes per second of a file up to which a link counts as a radio: 115,200 baud. Both directions share the
air of a telemetry radio, and a burst of ArduPilot on a faster link does not use all of it."""
ENTRY_SIZE: Final = 11
"""Bytes of a parameter in the file that is read (measured: 15,140 for 1,382), and of the frames."""
CHECKSUM_SIZE: Final = 2 * FRAME_OVERHEAD + 40
"""Bytes of a request for the checksum of a part of the parameter file, and of its response."""

INTERNAL: Final = re.compile(r"MIS_TOTAL|ARSPD\d?_DEVID|MNT\d_DEVID|BARO\d?_(GND_PRESS|DEVID)")
"""ArduPilot's parameters that refuse a PARAM_SET (AP_PARAM_FLAG_INTERNAL_USE_ONLY in its source). An uploaded
file sets them in 4.6, so they are not uploaded."""
MOVING: Final = re.compile(r"STAT_\w+|BARO\d?_GND_PRESS|GND_ABS_PRESS\d?|ARSPD\d?_OFFSET")
"""ArduPilot's parameters that change by themselves all the time: the checksum of a part with one of them
seldom matches."""


class WriteWay(StrEnum):
    """The way in which a call writes many values: PARAM_SETs, or one file."""

    QUICKEST = "quickest"
    """By the way that should take less time, as far as the link is measured."""
    SETS = "sets"
    """By PARAM_SET."""
    FILE = "file"
    """By one file where that is possible."""


class UploadHooks(NamedTuple):
    """What an upload needs of its owner.

    Attributes:
        may_commit: called with the time before the vehicle can take the file; false stops the upload.
        proven: called with a PARAM_VALUE for each value that the vehicle is proven to have, and the time.
    """

    may_commit: Callable[[float], bool]
    proven: Callable[[ParamValue, float], None]


class _Span(NamedTuple):
    """A part of the table: the indices from `first` to `last`.

    Attributes:
        is_known: whether all its values are known, so that its checksum can be computed.
    """

    first: int
    last: int
    is_known: bool

    @property
    def path(self) -> str:
        return f"{PARAMETER_FILE}?start={self.first}&count={self.last - self.first + 1}"


class ParamUpload(Operation[None]):
    """One upload, until each of its values is proven or cannot be.

    A part of the table whose other values are known is proven by its checksum. Otherwise, or if the checksum
    differs, that part is read. A name in `unproven` at the end was skipped by the vehicle, or is not where
    the table had it.

    Args:
        files, table: the component's.
        entries: the values by name. The table has each name with its index.
        hooks: see there.
        now: the time.

    Attributes:
        unproven: the names without a proof so far.
        is_committed: whether the vehicle may have taken the file.
    """

    def __init__(
        self,
        files: FileTransfers,
        table: Table,
        entries: Mapping[str, PackedParam],
        hooks: UploadHooks,
        now: float,
    ) -> None:
        super().__init__(now)
        self._files = files
        self._table = table
        self._entries = entries
        self._hooks = hooks
        self.unproven = set(entries)
        self.is_committed = False
        self._spans: list[_Span] = []
        self._job: CommittedWrite | FileChecksums | FileRead | None = None

    def begin(self, now: float) -> None:
        """Begin to write the file."""
        rows = sorted(self._entries.values())  # neighbours share the beginnings of their names
        job = self._files.write_whole(PARAMETER_FILE, encode_upload(rows), now, may_commit=self._commit)
        job.yields = True
        self._wait_for(job, lambda at: self._written(job, at))

    def cancel(self, now: float) -> None:
        """Cancel the upload. Its session on board is closed; a file that is not committed changes nothing."""
        self.drop_callbacks()
        job, self._job = self._job, None
        if job is not None:
            self._files.release(job, now)

    def _wait_for(
        self, job: CommittedWrite | FileChecksums | FileRead, on_end: Callable[[float], None]
    ) -> None:
        self._job = job

        def ended() -> None:
            if self._job is job:
                self._job = None
                on_end(job.ended_at)

        job.on_done.append(ended)

    def _commit(self, now: float) -> bool:
        self.is_committed = self._hooks.may_commit(now)
        return self.is_committed

    def _written(self, job: CommittedWrite, now: float) -> None:
        if job.error is not None:
            self.fail(job.error, now)
            return
        spans = spans_of(self._entries, self._table)
        known = [span for span in spans if span.is_known]
        self._spans = [span for span in spans if not span.is_known]
        if not known:
            self._read_next(now)
            return
        checks = self._files.checksums([span.path for span in known], now)
        self._wait_for(checks, lambda at: self._checked(known, checks, at))

    def _checked(self, spans: Sequence[_Span], job: FileChecksums, now: float) -> None:
        """Compare the checksum of each part with that of the part as it should be."""
        if job.result is None:
            assert job.error is not None
            self.fail(job.error, now)
            return
        names, count = self._table.present(), self._table.count or 0
        for span, found in zip(spans, job.result, strict=True):
            indices = range(span.first, span.last + 1)
            inside = [name for index in indices if (name := names.get(index)) is not None]
            rows = [self._entries.get(name) or _packed(self._table.params[name]) for name in inside]
            is_whole = len(rows) == len(indices) and count >= len(rows)
            if is_whole and found == crc32_px4(encode(rows, total=count, read_size=CHECKSUM_READ_SIZE)):
                for row in rows:
                    self._prove(row, count, now)
            else:
                self._spans.append(span)
        self._read_next(now)

    def _read_next(self, now: float) -> None:
        """Read the next part that is not proven; all of them at once if there are several."""
        if not self._spans or not self.unproven:
            self.finish(None, now)
            return
        first, last = min(span.first for span in self._spans), max(span.last for span in self._spans)
        self._spans.clear()
        job = self._files.read(_Span(first, last, False).path, now, limit=PACK_SIZE_MAX)
        job.yields = True
        self._wait_for(job, lambda at: self._take_file(job, at))

    def _take_file(self, job: FileRead, now: float) -> None:
        """Compare the values of a part that was read."""
        if job.result is None:
            assert job.error is not None
            self.fail(job.error, now)
            return
        try:
            pack = decode(job.result)
        except PackError as error:
            self.fail(error, now)
            return
        for row in pack.entries:
            entry = self._entries.get(row.name)
            if entry is not None and (entry.type, entry.bits) == (row.type, row.bits):
                self._prove(row, pack.total, now)
        self._read_next(now)

    def _prove(self, row: PackedParam, count: int, now: float) -> None:
        if row.name in self.unproven:
            self.unproven.discard(row.name)
            raw = as_reported(row.bits, row.type, Encoding.C_CAST)
            self._hooks.proven(ParamValue(row.name, raw, row.type, count, NO_INDEX), now)


class Uploads:
    """Decides which values are written as one file, and begins the uploads to one component.

    Args:
        context, files, table: the component's.

    Attributes:
        way: how many values are written; other than QUICKEST for measurements.
    """

    def __init__(self, context: Context, files: FileTransfers, table: Table) -> None:
        self._context = context
        self._files = files
        self._table = table
        self._is_useless = False
        self.way = WriteWay.QUICKEST

    def forget(self) -> None:
        """Forget that an upload has failed: another firmware may take it."""
        self._is_useless = False

    def is_served(self, now: float) -> bool:
        """Return whether the vehicle takes uploads now, as far as known."""
        context = self._context
        may = context.is_ardupilot and context.serves_file and self._table.encoding is Encoding.C_CAST
        is_free = self._files.is_idle and not self._files.is_in_use(now) and not context.is_fetching
        return may and is_free and not self._is_useless and self.way is not WriteWay.SETS

    def entry(self, name: str) -> Param | None:
        """Return the parameter with this name if its value can be uploaded and proven; None otherwise."""
        known = self._table.params.get(name)
        if known is None or known.index is None or known.trust is Trust.CACHED or known.is_raw:
            return None
        return known if known.type_number in PACKABLE and not INTERNAL.fullmatch(name) else None

    def is_quicker(self, values: Sequence[Param]) -> bool:
        """Return whether an upload of these parameters should take less time than their PARAM_SETs."""
        if not UPLOAD_VALUES_MIN <= len(values) <= UPLOAD_VALUES_MAX:
            return False
        trip, rate = self._context.round_trip.smoothed, self._files.byte_rate
        if self.way is WriteWay.FILE:
            return True
        if trip is None or not rate:
            return False
        entries = {param.name: _packed(param) for param in values}
        spans = spans_of(entries, self._table)
        return upload_time(entries, spans, trip, rate) + GAIN_MIN < set_time(len(values), trip, rate)

    def begin(self, entries: Mapping[str, PackedParam], hooks: UploadHooks, now: float) -> ParamUpload:
        """Begin an upload."""
        upload = ParamUpload(self._files, self._table, entries, hooks, now)
        upload.on_done.append(lambda: self._ended(upload, len(entries)))
        upload.begin(now)
        return upload

    def _ended(self, upload: ParamUpload, number: int) -> None:
        """Take an upload that the vehicle has refused, or of which it has taken nothing, for useless."""
        error = upload.error
        is_refused = isinstance(error, FileTransferError) and error.code not in BUSY
        is_dropped = error is None and len(upload.unproven) == number
        self._is_useless = self._is_useless or is_refused or is_dropped


def spans_of(entries: Mapping[str, PackedParam], table: Table) -> list[_Span]:
    """Return the parts of a table that have all these names, each as short as possible.

    A part ends before an index whose value is not known, or changes by itself.
    """
    names = table.present()
    indices = sorted(index for index, name in names.items() if name in entries)
    if not indices:
        return []
    spans: list[_Span] = []
    first = last = indices[0]
    for index in indices[1:]:
        if all(_is_known(names.get(between), table) for between in range(last + 1, index)):
            last = index
        else:
            spans.append(_Span(first, last, True))
            first = last = index
    spans.append(_Span(first, last, True))
    return spans if len(spans) <= SPANS_MAX else [_Span(indices[0], indices[-1], False)]


def set_time(number: int, trip: float, rate: float) -> float:
    """Return the seconds that PARAM_SETs of this many values should take."""
    rounds, window = 0, WRITES_IN_FLIGHT_FIRST
    left = number
    while left > 0:
        left -= window
        window = min(2 * window, WRITES_IN_FLIGHT_MAX)
        rounds += 1
    size = VALUE_SIZE + (SET_SIZE if rate <= RADIO_RATE_MAX else 0)
    return max(rounds * trip, trip + number * size / rate)


def upload_time(
    entries: Mapping[str, PackedParam], spans: Sequence[_Span], trip: float, rate: float
) -> float:
    """Return the seconds that an upload of these values should take, with the proof of each."""
    size = len(encode_upload(sorted(entries.values())))
    blocks = -(-size // DATA_SIZE_MAX)
    rounds = 2 + -(-(blocks - 1) // BLOCKS_IN_FLIGHT_MAX)
    sent = size + (blocks + 3) * 2 * FRAME_OVERHEAD + len(spans) * CHECKSUM_SIZE
    known = sum(span.is_known for span in spans)
    rounds += -(-known // CHECKSUMS_IN_FLIGHT_MAX)
    for span in spans:
        if not span.is_known:
            rounds += 3
            sent += (span.last - span.first + 1) * ENTRY_SIZE
    return rounds * trip + sent / rate


def _is_known(name: str | None, table: Table) -> bool:
    param = None if name is None else table.params.get(name)
    if param is None or param.trust is Trust.CACHED or param.is_raw:
        return False
    return param.type_number in PACKABLE and not MOVING.fullmatch(param.name)


def _packed(param: Param) -> PackedParam:
    assert isinstance(param.type_number, ParamType)
    return PackedParam(param.name, param.type_number, param.bits)
