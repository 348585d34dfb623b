"""MAVFTP: the files of a component.

`blocks`: received pieces of a file, and its gaps.
`file_read`: the read of a file: one burst, and single reads of lost blocks.
`file_write`: the write of a file.
`packets`: the payload of FILE_TRANSFER_PROTOCOL.
`param_pck`: the packed parameter file.
`transfer_job`: sessions, retries and errors, common to all transfers.
`transfers`: the queue of transfers of a component: reads, writes, lists, checksums.
"""

from __future__ import annotations

from paramclient.protocol.ftp.file_read import FILE_SIZE_MAX, FileRead
from paramclient.protocol.ftp.file_write import FileWrite
from paramclient.protocol.ftp.transfer_job import BUSY
from paramclient.protocol.ftp.transfers import (
    DirectoryEntry,
    FileChecksum,
    FileList,
    FileTransfers,
)

__all__ = [
    "BUSY",
    "FILE_SIZE_MAX",
    "DirectoryEntry",
    "FileChecksum",
    "FileList",
    "FileRead",
    "FileTransfers",
    "FileWrite",
]
