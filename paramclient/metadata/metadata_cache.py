"""MetadataStore: metadata files of vehicles, cached on disk."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from paramclient.errors import MetadataError
from paramclient.metadata.added_files import AddedFiles
from paramclient.metadata.formats import PACKED_SIZE_MAX, read_content, read_metadata, unpacked
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

logger = logging.getLogger(__name__)


class MetadataStore:
    """Metadata files by CRC-32, and the file of each firmware.

    A folder of small files, each replaced atomically and readable only by its owner. A file that no longer
    has its checksum is deleted and treated as missing. Several processes may use the folder at the same time.
    Disk errors are logged as warnings, and nothing is cached. Every call blocks for a few milliseconds, and
    `known` for up to some seconds if it parses a large file. The parsed files are kept by this object.

    Args:
        folder: the folder; created when the first file is cached.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self._parsed: dict[object, Metadata] = {}  # the most recently used last

    @classmethod
    def beside(cls, cache: str | os.PathLike[str]) -> MetadataStore:
        """Return the store of a cache: the folder with the cache's name and the suffix `.metadata`."""
        return cls(Path(cache).with_suffix(".metadata"))

    def __repr__(self) -> str:
        return f"<MetadataStore {self.folder}>"

    @property
    def added(self) -> AddedFiles:
        """The metadata files that the user has added."""
        return AddedFiles(self.folder / "added")

    @property
    def has_notes(self) -> bool:
        """Whether metadata of any firmware is cached or was added."""
        try:
            is_cached = any(path.suffix == _NOTES for path in self.folder.iterdir())
        except OSError:
            return False
        return is_cached or any(True for _ in self.added)

    def get(self, crc: int) -> bytes | None:
        """Return a file as stored on board, or None if it is not cached."""
        path = self._file(crc)
        content = self._read(path)
        if content is None:
            return None
        if not has_checksum(content, crc):
            logger.warning("%s is damaged and was removed", path)
            self._remove(path)
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

    def remember_failure(self, identity: Identity, component: int) -> None:
        """Record that the metadata of a firmware could not be downloaded quickly on the identity's link."""
        path = self._failure(identity, component)
        if path is not None:
            self._write(path, b"")

    def has_failed(self, identity: Identity, component: int, *, within: float) -> bool:
        """Return whether a quick download failed on this link, `within` seconds ago or less.

        Also True for a firmware without a commit, whose failure could not be recorded.
        """
        path = self._failure(identity, component)
        if path is None:
            return True
        try:
            return time.time() - path.stat().st_mtime <= within
        except OSError:
            return False

    def known(self, identity: Identity, component: int) -> Metadata | None:
        """Return the metadata of a firmware, or None.

        The cached metadata of a firmware with this version, commit and board, which the vehicle has provided;
        otherwise a file that was added for its vehicle type and version.
        """
        return self._cached(identity, component) or self.added.find(identity, component, self._parse_added)

    def _cached(self, identity: Identity, component: int) -> Metadata | None:
        path = self._note(identity, component)
        noted = None if path is None else self._read(path)
        if path is None or noted is None:
            return None
        crc = int(noted, 16) if _NOTE.fullmatch(noted) else None
        parsed = None if crc is None else self._parsed.get(crc)
        if crc is not None and parsed is not None and self._file(crc).exists():
            with suppress(OSError):
                os.utime(self._file(crc))
            return self._keep(crc, parsed)
        content = None if crc is None else self.get(crc)
        if content is None:
            self._remove(path)
            return None
        try:
            source = f"the cached metadata {noted.decode('ascii').strip()}"
            return self._keep(crc, read_content(content, source=source))
        except MetadataError as error:
            logger.warning("%s", error)
            self._remove(path)
            return None

    def _parse_added(self, path: Path) -> Metadata:
        """Return the content of an added file; that of an unchanged file is parsed once."""
        try:
            found = path.stat()
        except OSError:
            return read_metadata(path)  # raises the error
        key = (path, found.st_mtime_ns, found.st_size, found.st_ino)
        return self._keep(key, self._parsed.get(key) or read_metadata(path))

    def _keep(self, key: object, metadata: Metadata) -> Metadata:
        """Keep parsed metadata as the most recently used, and return it."""
        self._parsed.pop(key, None)
        self._parsed[key] = metadata
        for each in list(self._parsed)[:-PARSED_FILES_MAX]:
            self._parsed.pop(each, None)
        return metadata

    def known_of_sets(self, sets: Sequence[ParamSet]) -> list[Metadata | None]:
        """Return the metadata of each set's firmware; for a set without identity, that of another set."""
        own = [
            None
            if params.identity is None or params.component is None
            else self.known(params.identity, params.component)
            for params in sets
        ]
        first = next(filter(None, own), None)
        return [first if each is None else each for each in own]

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

    def _failure(self, identity: Identity, component: int) -> Path | None:
        """Return the file that records a failed download; None for a firmware without a commit."""
        note = self._note(identity, component)
        if note is None:
            return None
        link = hashlib.sha256(identity.link.encode()).hexdigest()[:16]
        return note.with_suffix(f".{link}{_FAILURES}")

    def _read(self, path: Path) -> bytes | None:
        try:
            with path.open("rb") as file:
                content = file.read(PACKED_SIZE_MAX + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            logger.warning("%s cannot be read: %s", path, error.strerror)
            return None
        return content

    def _write(self, path: Path, content: bytes) -> None:
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            number, name = tempfile.mkstemp(dir=self.folder, suffix=".new")  # mode 0600
            try:
                with os.fdopen(number, "wb") as file:
                    file.write(content)
                Path(name).replace(path)
            except BaseException:
                with suppress(OSError):
                    Path(name).unlink()
                raise
            self._delete_oldest()
        except OSError as error:
            logger.warning("%s cannot be written: %s", path, error.strerror)

    def _delete_oldest(self) -> None:
        """Delete the least recently used files, and temporary files of killed processes."""
        found = []
        for path in self.folder.iterdir():
            with suppress(OSError):
                found.append((path.stat().st_mtime, path))
        for _, path in sorted(found, reverse=True)[CACHED_FILES_MAX:]:
            self._remove(path)

    def _remove(self, path: Path) -> None:
        with suppress(OSError):
            path.unlink()


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


_NOTES: Final = ".firmware"
_FAILURES: Final = ".failed"
_NOTE: Final = re.compile(rb"[0-9a-f]{8}\n")
