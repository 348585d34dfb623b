"""Descriptions that came from vehicles, kept on disk."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from paramclient.errors import MetadataError
from paramclient.metadata.formats import LARGEST_PACKED, read_content, unpacked
from paramclient.metadata.info import Metadata
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet
from paramclient.model.values import crc32_px4

__all__ = ["MetadataStore", "has_checksum"]

MOST_FILES: Final = 64
"""Files that are kept, those that were used last: three for a firmware, of 0.1 million bytes with PX4."""

logger = logging.getLogger(__name__)


class MetadataStore:
    """Files of descriptions by their CRC-32, and which one belongs to which firmware.

    A folder of small files, each written in one go and readable by its owner alone. What does not have its
    checksum any more is thrown away, and is as if it had never been there. Several processes may use it at
    once. A disk that fails is no error: it is warned of, and nothing is kept. Every call blocks for a few
    milliseconds.

    Args:
        folder: the folder; it is made when something is to be kept.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    @classmethod
    def beside(cls, cache: str | os.PathLike[str]) -> MetadataStore:
        """The one that belongs to a cache: the folder of its name with `.metadata` for a suffix."""
        return cls(Path(cache).with_suffix(".metadata"))

    def __repr__(self) -> str:
        return f"<MetadataStore {self.folder}>"

    @property
    def has_notes(self) -> bool:
        """Whether anything is kept for any firmware."""
        try:
            return any(path.suffix == _NOTES for path in self.folder.iterdir())
        except OSError:
            return False

    def get(self, crc: int) -> bytes | None:
        """A file as the vehicle has it, or None where it is not here."""
        path = self._file(crc)
        content = self._read(path)
        if content is None:
            return None
        if not has_checksum(content, crc):
            logger.warning("%s is damaged and was removed", path)
            self._remove(path)
            return None
        with suppress(OSError):
            os.utime(path)  # those used last are kept
        return content

    def put(self, content: bytes, crc: int) -> None:
        """Keep a file that has this checksum."""
        self._write(self._file(crc), content)

    def remember(self, identity: Identity, component: int, crc: int) -> None:
        """Note that the file with this checksum describes the parameters of a firmware."""
        path = self._note(identity, component)
        if path is not None:
            self._write(path, f"{crc:08x}\n".encode("ascii"))

    def known(self, identity: Identity, component: int) -> Metadata | None:
        """What is kept of a firmware: of its version, commit and board. None for nothing."""
        path = self._note(identity, component)
        noted = None if path is None else self._read(path)
        if path is None or noted is None:
            return None
        content = self.get(int(noted, 16)) if _NOTE.fullmatch(noted) else None
        if content is None:
            self._remove(path)
            return None
        try:
            return read_content(content, source=f"the cached descriptions {noted.decode('ascii').strip()}")
        except MetadataError as error:
            logger.warning("%s", error)
            self._remove(path)
            return None

    def known_of_sets(self, sets: Sequence[ParamSet]) -> list[Metadata | None]:
        """For each set what is kept for its vehicle's firmware; where it names none, what another one has."""
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
        """Where it is noted what belongs to a firmware; None for one that has not said its commit."""
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

    def _read(self, path: Path) -> bytes | None:
        try:
            with path.open("rb") as file:
                content = file.read(LARGEST_PACKED + 1)
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
            self._make_room()
        except OSError as error:
            logger.warning("%s cannot be written: %s", path, error.strerror)

    def _make_room(self) -> None:
        """Throw away what was used least lately, and what a process that died has left."""
        found = []
        for path in self.folder.iterdir():
            with suppress(OSError):
                found.append((path.stat().st_mtime, path))
        for _, path in sorted(found, reverse=True)[MOST_FILES:]:
            self._remove(path)

    def _remove(self, path: Path) -> None:
        with suppress(OSError):
            path.unlink()


def has_checksum(content: bytes, crc: int) -> bool:
    """Whether a file has a CRC-32: as it is, or unpacked.

    The protocol means the packed file, and so does PX4 for that with the parameters; for its general file it
    announces the checksum of what is packed in it (PX4, `src/lib/component_information/CMakeLists.txt`).
    """
    if crc32_px4(content) == crc:
        return True
    try:
        return crc32_px4(unpacked(content, source="")) == crc
    except MetadataError:
        return False


_NOTES: Final = ".firmware"
_NOTE: Final = re.compile(rb"[0-9a-f]{8}\n")
