"""The files of a component over MAVFTP, without input and output."""

from __future__ import annotations

from paramclient.protocol.ftp.file_read import LARGEST_FILE, FileRead
from paramclient.protocol.ftp.passive import ObservedRead, ObservedReads
from paramclient.protocol.ftp.transfer_job import BUSY
from paramclient.protocol.ftp.transfers import (
    DirectoryEntry,
    FileChecksum,
    FileList,
    FileTransfers,
    FileWrite,
)

__all__ = [
    "BUSY",
    "LARGEST_FILE",
    "DirectoryEntry",
    "FileChecksum",
    "FileList",
    "FileRead",
    "FileTransfers",
    "FileWrite",
    "ObservedRead",
    "ObservedReads",
]
