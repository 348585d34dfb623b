"""Metadata files that the user has added for a vehicle type and a firmware version."""

from __future__ import annotations

import logging
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias, get_args

from paramclient.errors import MetadataError, UsageError
from paramclient.metadata.formats import read_metadata
from paramclient.metadata.info import Metadata
from paramclient.model.identity import Identity, autopilot_name, version_text

__all__ = ["AddedFiles", "AddedMetadata", "VehicleKind", "file_address", "replace_file"]

VehicleKind: TypeAlias = Literal["copter", "plane", "rover", "sub", "tracker", "blimp", "px4"]
"""The firmwares whose metadata can be added: ArduPilot's, one for each vehicle type, and PX4."""

_KINDS: Final[dict[str, VehicleKind]] = {
    "ArduCopter": "copter",
    "ArduPlane": "plane",
    "ArduRover": "rover",
    "APMrover2": "rover",
    "Rover": "rover",
    "ArduSub": "sub",
    "AntennaTracker": "tracker",
    "Blimp": "blimp",
}
"""Kinds by the name of the vehicle in apm.pdef.xml and apm.pdef.json."""
_TYPES: Final[dict[int, VehicleKind]] = {
    **dict.fromkeys((2, 3, 4, 13, 14, 15, 29, 35), "copter"),
    **dict.fromkeys((1, 19, 20, 21, 22, 23, 24, 25), "plane"),
    **dict.fromkeys((10, 11), "rover"),
    12: "sub",
    5: "tracker",
    7: "blimp",
}
"""Kinds of ArduPilot by MAV_TYPE."""
_FOLDERS: Final[dict[VehicleKind, str]] = {
    "copter": "ArduCopter",
    "plane": "ArduPlane",
    "rover": "Rover",
    "sub": "ArduSub",
    "tracker": "AntennaTracker",
    "blimp": "Blimp",
}
"""Folders of ArduPilot's metadata files on the internet."""
_AUTOPILOT_COMPONENT: Final = 1
_version: Final = re.compile(r"[0-9]{1,3}(\.[0-9]{1,3}){0,2}").fullmatch
_kinds: Final[dict[str, VehicleKind]] = {kind: kind for kind in get_args(VehicleKind)}
_name: Final = re.compile(rf"({'|'.join(get_args(VehicleKind))})(?:-([0-9.]+))?\.added").fullmatch

logger = logging.getLogger(__name__)


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
        return f"{self.kind} {self.firmware or 'any version'}"


class AddedFiles:
    """The added files: copies in a folder, named after vehicle type and firmware version.

    Every call blocks for a few milliseconds, and for about half a second if it reads a file of ArduPilot.

    Args:
        folder: the folder; made when the first file is added.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __iter__(self) -> Iterator[AddedMetadata]:
        found: list[AddedMetadata] = []
        with suppress(OSError):
            named = ((_name(path.name), path) for path in self.folder.iterdir())
            found += [AddedMetadata(_kinds[match[1]], match[2], path) for match, path in named if match]
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
            MetadataError: the file cannot be read or copied, or has no metadata.
        """
        if firmware is not None and not _version(firmware):
            raise UsageError(f"a firmware version is written as 4.6 or 4.6.1, not {firmware!r}")
        metadata = read_metadata(path)
        source = os.fspath(path)
        chosen = kind or _kind_of_file(metadata)
        if chosen is None:
            raise UsageError(f"{source} names no vehicle type that is known; give one of {', '.join(_kinds)}")
        name = f"{chosen}.added" if firmware is None else f"{chosen}-{firmware}.added"
        added = AddedMetadata(chosen, firmware, self.folder / name)
        try:
            replace_file(added.path, Path(path).read_bytes())
        except OSError as error:
            raise MetadataError(f"{source}: cannot be copied: {error.strerror}", source=source) from error
        return added, metadata

    def remove(self, kind: VehicleKind, firmware: str | None = None) -> AddedMetadata:
        """Remove the file for a vehicle type and version; return what it was.

        Raises:
            UsageError: there is none.
            MetadataError: it cannot be removed.
        """
        for each in self:
            if (each.kind, each.firmware) == (kind, firmware):
                try:
                    each.path.unlink(missing_ok=True)
                except OSError as error:
                    text = f"{each.path}: cannot be removed: {error.strerror}"
                    raise MetadataError(text, source=str(each.path)) from error
                return each
        known = ", ".join(map(str, self)) or "none"
        raise UsageError(f"no metadata was added for {kind} {firmware or 'any version'}; added: {known}")

    def find(
        self, identity: Identity, component: int, read: Callable[[Path], Metadata] = read_metadata
    ) -> Metadata | None:
        """Return the added metadata of a firmware: that with the longest version that fits; None for none.

        A file for a version is not used while the version of the vehicle is unknown. A file that cannot be
        read is reported as a warning.
        """
        kind = _kind_of(identity)
        if component != _AUTOPILOT_COMPONENT or kind is None:
            return None
        version = None if not identity.firmware else version_text(identity.firmware).partition("-")[0]
        fitting = [each for each in self if each.kind == kind and _fits(each.firmware, version)]
        for each in sorted(fitting, key=lambda one: len(_numbers(one.firmware)), reverse=True):
            try:
                return read(each.path)
            except MetadataError as error:
                logger.warning("%s", error)
        return None


def file_address(identity: Identity) -> str:
    """Return the internet address of the metadata file of an ArduPilot, or of the folder of all files."""
    folder = _FOLDERS.get(_TYPES.get(identity.vehicle_type, "px4"))
    files = "https://autotest.ardupilot.org/Parameters/"
    return files if folder is None else f"{files}{folder}/apm.pdef.xml"


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file atomically by one that only its owner can read; create the folder if needed.

    Raises:
        OSError: writing failed; an existing file is unchanged.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    number, part = tempfile.mkstemp(dir=path.parent, suffix=".new")  # mode 0600
    try:
        with os.fdopen(number, "wb") as file:
            file.write(content)
        Path(part).replace(path)
    except BaseException:
        with suppress(OSError):
            Path(part).unlink()
        raise


def _kind_of(identity: Identity) -> VehicleKind | None:
    name = autopilot_name(identity.autopilot)
    if name == "px4":
        return "px4"
    return _TYPES.get(identity.vehicle_type) if name == "ardupilot" else None


def _kind_of_file(metadata: Metadata) -> VehicleKind | None:
    """Return the only vehicle type that a file names; PX4's files are recognized by the types of
    parameters."""
    kinds = {_KINDS[info.group] for info in metadata.values() if info.group in _KINDS}
    if not kinds and all(info.type is not None for info in metadata.values()):
        return "px4"
    return kinds.pop() if len(kinds) == 1 else None


def _fits(required_version: str | None, version: str | None) -> bool:
    """Return whether a version is one of those that were given: 4.6.1 is one of 4.6."""
    numbers = _numbers(required_version)
    return not numbers or (version is not None and _numbers(version)[: len(numbers)] == numbers)


def _numbers(version: str | None) -> tuple[int, ...]:
    return () if version is None else tuple(map(int, version.split(".")))
