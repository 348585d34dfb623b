"""MetadataStore: metadata files of vehicles, cached on disk, and files that the user has added."""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Final

from paramclient.errors import MetadataError
from paramclient.metadata.added_files import AddedFiles, replace_file
from paramclient.metadata.formats import PACKED_SIZE_MAX, read_metadata, unpacked
from paramclient.metadata.info import Metadata
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet
from paramclient.model.px4_hash import crc32_px4

__all__ = ["MetadataStore", "has_checksum"]

CACHED_FILES_MAX: Final = 64
"""Most recently used files that are kept: three for a firmware, with about 0.1 million bytes for PX4."""
PARSED_FILES_MAX: Final = 2
"""Most recently used files that are kept parsed: a comparison has mostly one or two firmwares. The largest
takes 50 MB."""
_NOTES: Final = ".firmware"
_note: Final = re.compile(rb"[0-9a-f]{8}\n").fullmatch

logger = logging.getLogger(__name__)


class MetadataStore:
    """Metadata files by CRC-32, and the file of each firmware.

    A folder of small files, each replaced atomically and readable only by its owner. A file that no longer
    has its checksum is deleted and treated as missing. Several processes may use the folder at the same time.
    Disk errors are logged as warnings, and nothing is cached. Every call blocks for a few milliseconds, and
    `known` for up to half a second if it parses a large file. The last two parsed files are kept.

    Args:
        folder: the folder; created when the first file is cached.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.added = AddedFiles(self.folder / "added")

    @classmethod
    def beside(cls, cache: str | os.PathLike[str]) -> MetadataStore:
        """Return the store of a cache: the folder with the cache's name and the suffix `.metadata`."""
        return cls(Path(cache).with_suffix(".metadata"))

    def __repr__(self) -> str:
        return f"<MetadataStore {self.folder}>"

    @property
    def has_notes(self) -> bool:
        """Whether metadata of any firmware is cached or was added."""
        return any(path.suffix == _NOTES for path in self._files()) or any(True for _ in self.added)

    def get(self, crc: int) -> bytes | None:
        """Return a file as stored on board, or None if it is not cached."""
        path = self._file(crc)
        content = self._read(path)
        if content is not None and not has_checksum(content, crc):
            logger.warning("%s is damaged and was removed", path)
            _remove(path)
            return None
        with suppress(OSError):
            os.utime(path)  # marks the file as recently used
        return content

    def put(self, content: bytes, crc: int) -> None:
        """Cache a file with this checksum."""
        self._write(self._file(crc), content)

    def remember(self, identity: Identity, component: int, crc: int) -> None:
        """Record that the file with this checksum describes a firmware's parameters."""
        path = self._note(identity, component)
        if path is not None:
            self._write(path, f"{crc:08x}\n".encode("ascii"))

    def known(self, identity: Identity, component: int) -> Metadata | None:
        """Return the metadata of a firmware, or None.

        The cached metadata of a firmware with this version, commit and board, which the vehicle has provided;
        otherwise a file that was added for its vehicle type and version.
        """
        return self._cached(identity, component) or self.added.find(identity, component, _parsed)

    def known_of_sets(self, sets: Iterable[ParamSet]) -> list[Metadata | None]:
        """Return the metadata of each set's firmware; for a set without identity, that of another set."""
        own = [
            None
            if params.identity is None or params.component is None
            else self.known(params.identity, params.component)
            for params in sets
        ]
        first = next(filter(None, own), None)
        return [first if each is None else each for each in own]

    def _cached(self, identity: Identity, component: int) -> Metadata | None:
        path = self._note(identity, component)
        noted = None if path is None else self._read(path)
        if path is None or noted is None:
            return None
        crc = int(noted, 16) if _note(noted) else None
        if crc is not None and self.get(crc) is not None:
            try:
                return _parsed_once(self._file(crc), crc)
            except MetadataError as error:
                logger.warning("%s", error)
        _remove(path)
        return None

    def _file(self, crc: int) -> Path:
        return self.folder / f"{crc:08x}.metadata"

    def _note(self, identity: Identity, component: int) -> Path | None:
        """Return the file that names a firmware's metadata; None for a firmware without a commit."""
        if not identity.git_hash:
            return None
        what = (
            identity.autopilot,
            identity.firmware,
            identity.git_hash,
            identity.board,
            identity.vendor_id,
            identity.product_id,
            component,
        )
        return self.folder / f"{hashlib.sha256(repr(what).encode()).hexdigest()[:16]}{_NOTES}"

    def _files(self) -> Iterator[Path]:
        with suppress(OSError):
            yield from self.folder.iterdir()

    def _read(self, path: Path) -> bytes | None:
        try:
            with path.open("rb") as file:
                return file.read(PACKED_SIZE_MAX + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            logger.warning("%s cannot be read: %s", path, error.strerror)
            return None

    def _write(self, path: Path, content: bytes) -> None:
        """Replace a file, and delete the least recently used ones and those of killed processes."""
        try:
            replace_file(path, content)
        except OSError as error:
            logger.warning("%s cannot be written: %s", path, error.strerror)
            return
        times = {}
        for each in self._files():
            with suppress(OSError):
                times[each] = each.stat().st_mtime
        for each in sorted(times, key=times.__getitem__, reverse=True)[CACHED_FILES_MAX:]:
            _remove(each)


def has_checksum(content: bytes, crc: int) -> bool:
    """Return whether a file, packed or unpacked, has a CRC-32.

    The protocol specifies the checksum of the packed file. PX4 follows it for the parameter file, but
    announces the checksum of the unpacked general file (`src/lib/component_information/CMakeLists.txt`).
    """
    if crc32_px4(content) == crc:
        return True
    try:
        return crc32_px4(unpacked(content, source="")) == crc
    except MetadataError:
        return False


def _parsed(path: Path) -> Metadata:
    """Return the content of a metadata file; that of an unchanged file is parsed once."""
    try:
        found = path.stat()
    except OSError:
        return read_metadata(path)  # raises the error
    return _parsed_once(path, (found.st_mtime_ns, found.st_size, found.st_ino))


@lru_cache(maxsize=PARSED_FILES_MAX)
def _parsed_once(path: Path, version: object) -> Metadata:
    return read_metadata(path)


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
