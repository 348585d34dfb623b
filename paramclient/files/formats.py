"""Parameter files: FileFormat, the supported formats with their extensions, and ParamFile, the content."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import PurePath
from typing import Final

from paramclient.errors import FileError
from paramclient.model.names import NamedChoice
from paramclient.model.paramset import ParamSet

AUTOPILOT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1: the component of a file that names no component."""


class FileFormat(NamedChoice):
    """Formats in which ground stations and autopilots store parameters."""

    QGC = "qgc"
    """QGroundControl, `.params`: system, component, name, value and type, in columns."""
    PARM = "parm"
    """MAVProxy and ArduPilot, `.parm`: a name and a value."""
    MISSION_PLANNER = "mission-planner"
    """Mission Planner, `.param`: a name, a comma and a value."""
    PCK = "pck"
    """`param.pck`, the packed file that vehicles serve over MAVFTP."""
    JSON = "json"
    """paramclient's own format: all fields of every parameter, exactly."""


ENDINGS: Final = {
    ".params": FileFormat.QGC,
    ".parm": FileFormat.PARM,
    ".param": FileFormat.MISSION_PLANNER,
    ".pck": FileFormat.PCK,
    ".json": FileFormat.JSON,
}
"""Formats by file extension, in lower case."""


def format_of_name(name: str) -> FileFormat:
    """Return the format for the extension of a file's name.

    Raises:
        FileError: the extension is unknown.
    """
    ending = PurePath(name).suffix.lower()
    if (file_format := ENDINGS.get(ending)) is None:
        known = f"a format ({', '.join(FileFormat)}), or one of the extensions {', '.join(ENDINGS)}"
        raise FileError(f"unknown file extension {ending!r}. Choose {known}", source=name)
    return file_format


@dataclass(frozen=True, slots=True)
class ParamFile:
    """The content of a parameter file.

    Attributes:
        sets: the parameters, one set per component, in the order of the file.
        file_format: the format; of an on-board log, that of the log, which cannot be written.
        source: the file's name, as given.
        header: the comment lines at the top, without comment characters.
        footer: the comment lines after the last parameter. All others belong to the parameter below them.
        notes: remarks for the user, in sentences: repeated lines, parts left out.
        faults: number of faults for which parameters were left out, see `partial` of `read_file`. A name that
            is too long for any vehicle is none: real files of ArduPilot have such names.
    """

    sets: tuple[ParamSet, ...]
    file_format: StrEnum
    source: str = ""
    header: tuple[str, ...] = ()
    footer: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    faults: int = 0

    @property
    def is_extended(self) -> bool:
        """Whether the file has extended parameters."""
        return any(each.is_extended for each in self.sets)

    def choose(self, component: int | None = None, *, system: int | None = None) -> ParamSet:
        """Return the set of a component.

        A set without system or component id matches every id.

        Args:
            component: component id; None for the autopilot, or for the only component.
            system: system id; None for the only one that matches.

        Raises:
            FileError: no set or several sets match. The error lists the sets.
        """
        fits = [each for each in self.sets if system is None or each.system in (None, system)]
        if component is not None:
            fits = [each for each in fits if each.component in (None, component)]
        elif len(fits) > 1:
            fits = [each for each in fits if each.component in (None, AUTOPILOT)]
        if len(fits) == 1:
            return fits[0]
        wanted = f"{'any system' if system is None else f'system {system}'}, "
        wanted += "the autopilot" if component is None else f"component {component}"
        there = ", ".join(map(address, self.sets)) + ("; --vehicle chooses one" if fits else "")
        many = "several sets match" if fits else "no set matches"
        raise FileError(f"{many} ({wanted}); the file contains {there}", source=self.source)

    def __repr__(self) -> str:
        description = ", ".join(f"{address(each)}: {len(each)}" for each in self.sets)
        return f"<ParamFile {self.source or 'unnamed'} {self.file_format} {description}>"


def address(params: ParamSet) -> str:
    """Return the system and component id of a set, `1/100`, with a question mark for an unknown id."""
    if params.system is None and params.component is None:
        return "an unknown vehicle"
    return "/".join("?" if each is None else str(each) for each in (params.system, params.component))
