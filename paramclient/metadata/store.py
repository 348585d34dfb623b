"""Metadata files: reading, a cache of those of vehicles, and files that the user has added."""

from __future__ import annotations

import hashlib
import logging
import lzma
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal, TypeAlias, get_args

from paramclient.errors import FileError, UsageError
from paramclient.files.disk import read_bytes, replace_file
from paramclient.files.formats import AUTOPILOT
from paramclient.files.reading import decoded
from paramclient.metadata.info import Metadata
from paramclient.model.identity import Identity, autopilot_name, version_text
from paramclient.model.paramset import ParamSet
from paramclient.model.px4_hash import crc32_px4

PACKED_SIZE_MAX: Final = 4 << 20
"""Bytes of a packed file, or of a file from a vehicle; PX4's has about 0.1 million."""
CONTENT_SIZE_MAX: Final = 8 << 20
"""Bytes of a file, and of an unpacked one; those of ArduPilot and PX4 have 2 to 5 million. To read one takes
up to seven times as much memory, if its text is not ASCII."""
UNPACKING_MEMORY_MAX: Final = 96 << 20
"""Bytes of memory for unpacking. PX4 packs with a dictionary of 64 million, `xz -9`."""
PARSED_FILES_MAX: Final = 2
"""Most recently used files that are kept parsed: a comparison has mostly one or two firmwares. The largest
takes 50 MB."""
_NOTES: Final = ".firmware"

VehicleKind: TypeAlias = Literal["copter", "plane", "rover", "sub", "tracker", "blimp", "px4"]
"""The firmwares whose metadata can be added: ArduPilot's, one for each vehicle type, and PX4."""

ARDUPILOT: Final[dict[VehicleKind, tuple[str, tuple[int, ...]]]] = {
    "copter": ("ArduCopter", (2, 3, 4, 13, 14, 15, 29, 35)),
    "plane": ("ArduPlane", (1, 19, 20, 21, 22, 23, 24, 25)),
    "rover": ("Rover", (10, 11)),
    "sub": ("ArduSub", (12,)),
    "tracker": ("AntennaTracker", (5,)),
    "blimp": ("Blimp", (7,)),
}
"""ArduPilot's firmwares: the name in its metadata files, which is also their folder on the internet; and
MAV_TYPE of the heartbeat."""
OLD_NAMES: Final = {"APMrover2": "Rover", "ArduRover": "Rover"}
"""Names of earlier versions of these firmwares."""
_has_encoding: Final = re.compile(rb"""\s*<\?xml[^>]*encoding=["'](?!utf-8)""", re.IGNORECASE).match
"""Whether an XML declaration names another encoding than UTF-8."""
_version: Final = re.compile(r"[0-9]{1,3}(\.[0-9]{1,3}){0,2}").fullmatch
_kinds: Final[dict[str, VehicleKind]] = {kind: kind for kind in get_args(VehicleKind)}
_name: Final = re.compile(rf"({'|'.join(_kinds)})(?:-([0-9.]+))?\.added").fullmatch

logger = logging.getLogger(__name__)


# Reading


def read_metadata(path: str | os.PathLike[str]) -> Metadata:
    """Read a metadata file: PX4's parameters.json, or ArduPilot's apm.pdef.xml or apm.pdef.json.

    Each may be packed with xz. The format is detected from the content, not from the name.

    Raises:
        FileError: the file cannot be read, is too large, or has another format.
    """
    source = os.fspath(path)
    return read_content(read_bytes(source), source=source)


def read_content(content: bytes, *, source: str) -> Metadata:
    """Read the bytes of a metadata file, as `read_metadata`.

    Args:
        content: the bytes, possibly packed.
        source: their origin, for errors and for users.

    Raises:
        FileError: as `read_metadata`.
    """
    with naming(source):
        metadata = _read_unpacked(unpacked(content).removeprefix(b"\xef\xbb\xbf"))
    return replace(metadata, source=source)


@contextmanager
def naming(source: str) -> Iterator[None]:
    """Turn UsageError into FileError with the origin of a file."""
    try:
        yield
    except UsageError as error:
        raise FileError(str(error), source=source) from None


def json_of(content: bytes) -> dict[str, object]:
    """Parse a JSON object. Bytes that are not UTF-8 are read as Windows-1252.

    Raises:
        UsageError: the text is not a JSON object.
    """
    from pydantic_core import from_json  # imported here: loads pydantic

    try:
        document = from_json(_text_of(content))
    except ValueError as error:
        raise UsageError(f"not JSON: {error}") from None
    if not isinstance(document, dict):
        raise UsageError("is JSON, but not an object")
    return document


def _text_of(content: bytes) -> str:
    return decoded(content.decode("utf-8", "surrogateescape"))


def unpacked(content: bytes) -> bytes:
    """Return the content of a file that may be packed with xz.

    Raises:
        UsageError: the file is damaged, or too large.
    """
    is_packed = content.startswith(b"\xfd7zXZ\0")
    if len(content) > (PACKED_SIZE_MAX if is_packed else CONTENT_SIZE_MAX):
        raise UsageError("is too large for a metadata file")
    if not is_packed:
        return content
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=UNPACKING_MEMORY_MAX)
    try:
        result = unpacker.decompress(content, CONTENT_SIZE_MAX + 1)
    except lzma.LZMAError as error:
        raise UsageError(f"cannot be unpacked: {error}") from None
    if len(result) > CONTENT_SIZE_MAX:
        raise UsageError("is too large for a metadata file")
    if not unpacker.eof:
        raise UsageError("cannot be unpacked: the file is truncated")
    return result


def _read_unpacked(content: bytes) -> Metadata:
    start = content.lstrip(b" \t\r\n")[:1]
    if start not in (b"<", b"{"):
        what = "PX4's parameters.json, ArduPilot's apm.pdef.xml or apm.pdef.json"
        raise UsageError(f"is neither JSON nor XML; expected {what}")
    from paramclient.metadata import schemas  # imported here: loads pydantic

    if start == b"<":
        return schemas.read_xml(content if _has_encoding(content) else _text_of(content).encode())
    document = json_of(content)
    if "parameters" in document:
        return schemas.read_parameters(document)
    if "metadataTypes" in document:
        raise UsageError(
            "is the general metadata file, which only names other files; use the file with the parameters"
        )
    return schemas.read_json(document)


# Files of vehicles


class MetadataStore:
    """Metadata files by CRC-32, and the file of each firmware.

    A folder of small files, each replaced atomically and readable only by its owner. A file that no longer
    has its checksum is deleted and treated as missing. Several processes may use the folder at the same time.
    A file that cannot be read is logged as a warning. Every call blocks for a few milliseconds, and
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

    @property
    def has_notes(self) -> bool:
        """Whether metadata of any firmware is cached or was added."""
        return bool([*self.folder.glob(f"*{_NOTES}"), *self.added])

    def get(self, crc: int) -> bytes | None:
        """Return a file as stored on board, or None if it is not cached."""
        path = self._file(crc)
        content = self._read(path)
        if content is not None and not has_checksum(content, crc):
            logger.warning("%s is damaged and was removed", path)
            _remove(path)
            return None
        return content

    def keep(self, files: Mapping[int, bytes], identity: Identity, component: int, crc: int) -> None:
        """Cache files by checksum, and record which of them describes a firmware's parameters.

        Raises:
            FileError: one cannot be written.
        """
        for checksum, content in files.items():
            _replace(self._file(checksum), content)
        if (note := self._note(identity, component)) is not None:
            _replace(note, f"{crc:08x}\n".encode("ascii"))

    def known(self, identity: Identity, component: int) -> Metadata | None:
        """Return the metadata of a firmware, or None.

        The cached metadata of a firmware with this version, commit and board, which the vehicle has provided;
        otherwise a file that was added for its vehicle type and version.
        """
        return self._cached(identity, component) or self.added.find(identity, component)

    def known_of_sets(self, sets: Sequence[ParamSet]) -> list[Metadata | None]:
        """Return the known metadata of each set's firmware; for a set without identity, that of another."""
        own = [
            None if each.identity is None else self.known(each.identity, each.component or AUTOPILOT)
            for each in sets
        ]
        first = next(filter(None, own), None)
        return [
            first if known is None and each.identity is None else known
            for known, each in zip(own, sets, strict=True)
        ]

    def _cached(self, identity: Identity, component: int) -> Metadata | None:
        note = self._note(identity, component)
        noted = None if note is None else self._read(note)
        if note is None or noted is None:
            return None
        try:
            crc = int(noted, 16)
            if (content := self.get(crc)) is not None:
                return _parsed(self._file(crc), content)
        except FileError as error:
            logger.warning("%s", error)
        except ValueError:
            logger.warning("%s is damaged and was removed", note)
        _remove(note)
        return None

    def _file(self, crc: int) -> Path:
        return self.folder / f"{crc:08x}.metadata"

    def _note(self, identity: Identity, component: int) -> Path | None:
        """Return the file that names a firmware's metadata; None for a firmware without a commit."""
        if not identity.git_hash:
            return None
        firmware = replace(identity, system=0, link="", uid=None, vehicle_type=0, capabilities=0)
        name = hashlib.sha256(repr((firmware, component)).encode()).hexdigest()[:16]
        return self.folder / f"{name}{_NOTES}"

    def _read(self, path: Path) -> bytes | None:
        if not path.exists():
            return None
        try:
            return read_bytes(str(path))
        except FileError as error:
            logger.warning("%s", error)
            return None


def has_checksum(content: bytes, crc: int) -> bool:
    """Return whether a file, packed or unpacked, has a CRC-32.

    The protocol specifies the checksum of the packed file. PX4 follows it for the parameter file, but
    announces the checksum of the unpacked general file (`src/lib/component_information/CMakeLists.txt`).
    """
    if crc32_px4(content) == crc:
        return True
    with suppress(UsageError):
        return crc32_px4(unpacked(content)) == crc
    return False


@lru_cache(maxsize=PARSED_FILES_MAX)
def _parsed(path: Path, content: bytes) -> Metadata:
    return read_content(content, source=str(path))


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink()


# Files that the user has added


@dataclass(frozen=True, slots=True)
class AddedMetadata:
    """An added file.

    Attributes:
        kind: the vehicle type.
        firmware: the firmware version, such as 4.6 for all of 4.6.0, 4.6.1, …; None for every version.
        path: the copy of the file.
    """

    kind: VehicleKind
    firmware: str | None
    path: Path

    def __str__(self) -> str:
        return f"{self.kind} {self.firmware or '(any version)'}"


class AddedFiles:
    """The added files: copies in a folder, named after vehicle type and firmware version.

    Every call blocks for a few milliseconds, and for about half a second if it reads a file of ArduPilot.

    Args:
        folder: the folder; made when the first file is added.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __iter__(self) -> Iterator[AddedMetadata]:
        named = ((_name(path.name), path) for path in self.folder.glob("*.added"))
        found = [AddedMetadata(_kinds[match[1]], match[2], path) for match, path in named if match]
        return iter(sorted(found, key=lambda each: (each.kind, _numbers(each.firmware))))

    def add(
        self, path: str | os.PathLike[str], kind: VehicleKind | None = None, firmware: str | None = None
    ) -> tuple[AddedMetadata, Metadata]:
        """Copy a metadata file, in place of one for the same vehicle type and version; return its content.

        Args:
            path: the file, in any format of `read_metadata`.
            kind: the vehicle type; None for that which the file names.
            firmware: the firmware version, see `AddedMetadata`; None for every version.

        Raises:
            UsageError: the version is not one, or the file names no known vehicle type.
            FileError: the file cannot be read or copied, or has no metadata.
        """
        if firmware is not None and not _version(firmware):
            raise UsageError(f"a firmware version is written as 4.6 or 4.6.1, not {firmware!r}")
        source = os.fspath(path)
        content = read_bytes(source)
        metadata = read_content(content, source=source)
        chosen = kind or _kind_of_file(metadata)
        if chosen is None:
            raise UsageError(f"{source} names no vehicle type that is known; give one of {', '.join(_kinds)}")
        name = f"{chosen}.added" if firmware is None else f"{chosen}-{firmware}.added"
        added = AddedMetadata(chosen, firmware, self.folder / name)
        _replace(added.path, content)
        return added, metadata

    def remove(self, kind: VehicleKind, firmware: str | None = None) -> AddedMetadata:
        """Remove the file for a vehicle type and version; return what it was.

        Raises:
            UsageError: there is none.
            FileError: it cannot be removed.
        """
        for each in self:
            if (each.kind, each.firmware) == (kind, firmware):
                try:
                    each.path.unlink(missing_ok=True)
                except OSError as error:
                    raise FileError(f"cannot be removed: {error.strerror}", source=str(each.path)) from error
                return each
        known = ", ".join(map(str, self)) or "none"
        raise UsageError(f"no metadata was added for {kind} {firmware or '(any version)'}; added: {known}")

    def find(self, identity: Identity, component: int) -> Metadata | None:
        """Return the added metadata of a firmware: that with the longest version that fits; None for none.

        A file for a version is not used while the version of the vehicle is unknown. A file that cannot be
        read is reported as a warning.
        """
        kind = _kind_of(identity)
        if component != AUTOPILOT or kind is None:
            return None
        version = None if not identity.firmware else version_text(identity.firmware).partition("-")[0]
        fitting = [each for each in self if each.kind == kind and _fits(each.firmware, version)]
        for each in sorted(fitting, key=lambda one: len(_numbers(one.firmware)), reverse=True):
            try:
                return _parsed(each.path, read_bytes(str(each.path)))
            except FileError as error:
                logger.warning("%s", error)
        return None


def _replace(path: Path, content: bytes) -> None:
    """Replace a file atomically by one that only its owner can read; create the folder if needed.

    Raises:
        FileError: writing failed; an existing file is unchanged.
    """
    with suppress(OSError):  # replacing the file gives the reason
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    replace_file(str(path), content, new_mode=0o600)


def _kind_of(identity: Identity) -> VehicleKind | None:
    name = autopilot_name(identity.autopilot)
    if name == "px4":
        return "px4"
    kinds = (kind for kind, (_, types) in ARDUPILOT.items() if identity.vehicle_type in types)
    return next(kinds, None) if name == "ardupilot" else None


def _kind_of_file(metadata: Metadata) -> VehicleKind | None:
    """Return the only vehicle type that a file names; PX4's files are recognized by the types of
    parameters."""
    names = {OLD_NAMES.get(info.group, info.group) for info in metadata.values()}
    kinds = [kind for kind, (name, _) in ARDUPILOT.items() if name in names]
    if not kinds and all(info.type is not None for info in metadata.values()):
        return "px4"
    return kinds[0] if len(kinds) == 1 else None


def _fits(required_version: str | None, version: str | None) -> bool:
    """Return whether a version is one of those that were given: 4.6.1 is one of 4.6."""
    numbers = _numbers(required_version)
    return not numbers or (version is not None and _numbers(version)[: len(numbers)] == numbers)


def _numbers(version: str | None) -> tuple[int, ...]:
    return () if version is None else tuple(map(int, version.split(".")))
