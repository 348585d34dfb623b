"""The packed parameter file of a component as other stations read it over MAVFTP."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from paramclient.errors import PackError
from paramclient.protocol.ftp import ObservedRead, ObservedReads
from paramclient.protocol.ftp.packets import Opcode, Packet
from paramclient.protocol.ftp.param_pck import PACK_SIZE_MAX, Pack, PackedParam, decode_prefix
from paramclient.protocol.ftp.passive import path_of
from paramclient.protocol.params.file_download import PARAMETER_FILE
from paramclient.protocol.wire import PARAMETERS_MAX, FileTransfer, ParamValue

__all__ = ["FileObserver", "ObservedPack", "acknowledges_open", "opens_parameter_file"]

HEADER_SIZE: Final = 6
"""Bytes of the file's header, which says how many entries the file has."""
NOTES_MAX: Final = 20
"""Notes that are kept: a log of a bad link may contain hundreds of failed reads."""


class ObservedPack(NamedTuple):
    """The proven part of one read of the file.

    Attributes:
        pack: the entries, at most those before the first gap.
        start: the index of the first entry.
        newer: names with a PARAM_VALUE received after the file was opened.
        began_at: when the file was opened, in seconds.
    """

    pack: Pack
    start: int
    newer: frozenset[str]
    began_at: float

    def entries(self) -> Iterator[tuple[int, PackedParam]]:
        """Yield each entry with its index."""
        return enumerate(self.pack.entries, start=self.start)


class FileObserver:
    """Assembles the parameter files that other stations read, and notes what could not be used.

    Only a read with a received open request counts, as nothing else names the file. Of a file with gaps the
    entries before the first gap are used: no entry depends on later ones.

    Args:
        file_read: called with the proven part of each read, and the time.

    Attributes:
        notes: what was not used, and why, since `clear_notes`.
    """

    def __init__(self, file_read: Callable[[ObservedPack, float], None]) -> None:
        self.notes: list[str] = []
        self._file_read = file_read
        self._reads = ObservedReads(_is_parameter_file, size_max=PACK_SIZE_MAX, ended=self._ended)
        self._names: dict[ObservedRead, set[str]] = {}
        self._counts: dict[ObservedRead, int] = {}

    @property
    def is_reading(self) -> bool:
        """Whether another station is reading the file."""
        return bool(self._reads.running)

    def receive_request(self, message: FileTransfer, station: tuple[int, int], now: float) -> None:
        """Process a FILE_TRANSFER_PROTOCOL that a station has sent to the component."""
        packet = Packet.unpack(message.payload)
        if packet.opcode < Opcode.ACK:
            self._reads.receive_request(packet, station, now)

    def receive_reply(self, message: FileTransfer, now: float) -> None:
        """Process a FILE_TRANSFER_PROTOCOL that the component has sent to a station."""
        addressee = (message.target_system, message.target_component)
        self._reads.receive_reply(Packet.unpack(message.payload), addressee, now)

    def receive_value(self, message: ParamValue) -> None:
        """Process a PARAM_VALUE of the component: it is newer than a file that was opened before."""
        for read in self._reads.running:
            self._names.setdefault(read, set()).add(message.param_id)
            if message.param_count <= PARAMETERS_MAX:
                self._counts[read] = message.param_count

    def tick(self, now: float) -> None:
        """End the reads that have stopped."""
        self._reads.tick(now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return self._reads.next_deadline()

    def close(self, now: float) -> None:
        """End all reads with what was received: the component restarts or is lost, or the log is over."""
        self._reads.close_all(now)

    def forget(self) -> None:
        """Forget everything: another vehicle uses the address."""
        self._reads.forget()
        self._names.clear()
        self._counts.clear()
        self.notes.clear()

    def _ended(self, read: ObservedRead, now: float) -> None:
        newer = frozenset(self._names.pop(read, ()))
        count = self._counts.pop(read, None)
        if not read.blocks.received:
            return
        system, component = read.station
        file = f"parameter file that station {system}/{component} read"
        data = read.blocks.prefix
        try:
            if len(data) < HEADER_SIZE:
                raise PackError("its first bytes were not received", offset=0)
            pack, number = decode_prefix(data)
            if count not in (None, pack.total) or pack.total > PARAMETERS_MAX:
                raise PackError(f"it has {pack.total} parameters, and the vehicle has {count}", offset=4)
        except PackError as error:
            self._note(f"The {file} was not used: {error}.")
            return
        self._file_read(ObservedPack(pack, _start_of(read.path), newer, read.began_at), now)
        if len(pack.entries) < number:
            taken = f"{len(pack.entries)} of {number} parameters were taken from the {file}"
            self._note(f"{taken}: bytes from {len(data)} on are missing.")

    def _note(self, text: str) -> None:
        if len(self.notes) < NOTES_MAX:
            self.notes.append(text)


def opens_parameter_file(message: FileTransfer) -> bool:
    """Return whether a station requests to open the parameter file."""
    packet = Packet.unpack(message.payload)
    return packet.opcode == Opcode.OPEN_FILE_RO and _is_parameter_file(path_of(packet))


def acknowledges_open(message: FileTransfer) -> bool:
    """Return whether a server acknowledges that it has opened a file for reading."""
    packet = Packet.unpack(message.payload)
    return packet.opcode == Opcode.ACK and packet.requested == Opcode.OPEN_FILE_RO


def _is_parameter_file(path: str) -> bool:
    return path.partition("?")[0] == PARAMETER_FILE


def _start_of(path: str) -> int:
    """Return the index of the file's first parameter, from the query with which it was opened."""
    match = _start(path)
    return 0 if match is None else int(match[1])


_start: Final = re.compile(r"[?&]start=([0-9]{1,5})(?![0-9])").search
