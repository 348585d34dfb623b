"""ParamFile, the content of a parameter file, and FileForm, the supported formats.

`formats` detects the format of a file, and calls its parser:

- `line_formats`: QGC, PARM and MISSION_PLANNER, with the `@include` lines of `includes`.
- `param_pck`: PCK.
- `script`: PX4_SCRIPT.
- `document_format`: JSON and YAML. `extended_document` parses files of extended parameters.
- `paramclient.logs.onboard`: on-board logs (`LogForm`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import PurePath
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.model.paramset import ParamSet

__all__ = [
    "AUTOPILOT",
    "ENDINGS",
    "FileForm",
    "LogForm",
    "ParamFile",
    "TooManyParams",
    "WRITABLE",
    "address",
    "parse_format",
    "format_of_name",
]

AUTOPILOT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1: the component of a file that names no component."""


class FileForm(StrEnum):
    """Formats in which ground stations and autopilots store parameters."""

    QGC = "qgc"
    """QGroundControl, `.params`: system, component, name, value and type, in columns."""
    PARM = "parm"
    """MAVProxy and ArduPilot, `.parm`: a name and a value."""
    MISSION_PLANNER = "mission-planner"
    """Mission Planner, `.param`: a name, a comma and a value."""
    PCK = "pck"
    """`param.pck`, the packed file that vehicles serve over MAVFTP."""
    PX4_SCRIPT = "px4-script"
    """Lines of a PX4 start script: `param set NAME VALUE`. Can only be read."""
    JSON = "json"
    """paramclient's own format: all fields of every parameter, exactly."""
    YAML = "yaml"
    """paramclient's own format as YAML, for editing by hand. Reading it needs PyYAML."""


WRITABLE: Final = tuple(form for form in FileForm if form is not FileForm.PX4_SCRIPT)
"""Formats that can be written."""


class LogForm(StrEnum):
    """Formats of on-board logs, which `paramclient.logs` reads. None of them can be written."""

    DATAFLASH = "dataflash"
    """ArduPilot, `.bin`."""
    ULOG = "ulog"
    """PX4, `.ulg`."""


ENDINGS: Final = {
    ".params": FileForm.QGC,
    ".parm": FileForm.PARM,
    ".param": FileForm.MISSION_PLANNER,
    ".pck": FileForm.PCK,
    ".json": FileForm.JSON,
    ".yaml": FileForm.YAML,
    ".yml": FileForm.YAML,
}
"""Formats by file extension, in lower case."""


@dataclass(frozen=True, slots=True)
class ParamFile:
    """The content of a parameter file.

    Attributes:
        sets: the parameters, one set per component, in the order of the file.
        form: the format.
        source: the file's name, as given.
        header: the comment lines at the top, without comment characters.
        footer: the comment lines after the last parameter. All others belong to the parameter below them.
        notes: remarks for the user, in sentences: repeated lines, parts left out.
    """

    sets: tuple[ParamSet, ...]
    form: FileForm | LogForm
    source: str = ""
    header: tuple[str, ...] = ()
    footer: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

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
        there = ", ".join(map(address, self.sets))
        many = "several sets match" if fits else "no set matches"
        raise FileError(f"{many} ({wanted}); the file contains {there}", source=self.source)

    def __repr__(self) -> str:
        held = ", ".join(f"{address(each)}: {len(each)}" for each in self.sets)
        return f"<ParamFile {self.source or 'unnamed'} {self.form} {held}>"


class TooManyParams(FileError):
    """A file holds more parameters than its reader takes. The rest of the file was not read."""

    @classmethod
    def check(cls, count: int, params_max: int | None, source: str) -> None:
        """Raise it if there are more than `params_max`; None is no limit."""
        if params_max is not None and count > params_max:
            raise cls(f"the file holds more than {params_max:,} parameters", source=source)


def address(params: ParamSet) -> str:
    """Return the system and component id of a set, `1/100`, with a question mark for an unknown id."""
    return "/".join("?" if each is None else str(each) for each in (params.system, params.component))


def parse_format(form: FileForm | str) -> FileForm:
    """Return the format with this name.

    Raises:
        UsageError: there is no such format.
    """
    try:
        return FileForm(form)
    except ValueError:
        raise UsageError(f"unknown file format {form!r}; the formats are {_listed(FileForm)}") from None


def format_of_name(name: str) -> FileForm:
    """Return the format for the extension of a file's name.

    Raises:
        FileError: the extension is unknown.
    """
    ending = PurePath(name).suffix.lower()
    form = ENDINGS.get(ending)
    if form is None:
        raise FileError(
            f"unknown file extension {ending!r}. Choose a format ({_listed(WRITABLE)}), or one of the "
            f"extensions {_listed(ENDINGS)}",
            source=name,
        )
    return form


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)
