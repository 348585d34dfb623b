"""What a parameter file is, once it is read: its sets, its form, and what stands around them."""

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
    "ParamFile",
    "TooManyParams",
    "address",
    "as_form",
    "form_of_name",
]

AUTOPILOT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1: whom a file means that names no component."""


class FileForm(StrEnum):
    """The forms in which ground stations and autopilots keep parameters."""

    QGC = "qgc"
    """QGroundControl, `.params`: system, component, name, value and type, in columns."""
    PARM = "parm"
    """MAVProxy and ArduPilot, `.parm`: a name and a value."""
    MISSION_PLANNER = "mission-planner"
    """Mission Planner, `.param`: a name, a comma and a value."""
    PCK = "pck"
    """`param.pck`, the packed file that vehicles give over MAVFTP."""
    PX4_SCRIPT = "px4-script"
    """Lines of a PX4 start script: `param set NAME VALUE`. It is only read."""
    JSON = "json"
    """The document of paramclient: all that is known of a parameter, exactly."""
    YAML = "yaml"
    """The same document, for people to edit. Reading it needs PyYAML."""


ENDINGS: Final = {
    ".params": FileForm.QGC,
    ".parm": FileForm.PARM,
    ".param": FileForm.MISSION_PLANNER,
    ".pck": FileForm.PCK,
    ".json": FileForm.JSON,
    ".yaml": FileForm.YAML,
    ".yml": FileForm.YAML,
}


@dataclass(frozen=True, slots=True)
class ParamFile:
    """A parameter file as it was read.

    Attributes:
        sets: its parameters, a set for each component, in the order in which they come.
        form: the form it has.
        source: its name, as it was given.
        header: the lines of comment on top, without their marks.
        footer: those behind the last parameter. All others stand with the parameter that follows them.
        notes: what a reader may want to know, in sentences: lines that say the same twice, parts left out.
    """

    sets: tuple[ParamSet, ...]
    form: FileForm
    source: str = ""
    header: tuple[str, ...] = ()
    footer: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def choose(self, component: int | None = None, *, system: int | None = None) -> ParamSet:
        """The set of a component.

        A set that names no system or component fits every one that is asked for.

        Args:
            component: its id; None for the autopilot, or for the only one that there is.
            system: its system id; None for the only one that fits.

        Raises:
            FileError: none fits, or more than one. It names what there is.
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
        many = "more than one fits" if fits else "none fits"
        raise FileError(f"{many} ({wanted}); the file holds {there}", source=self.source)

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
    """Whose parameters these are: `1/100`, and a question mark for what is not said."""
    return "/".join("?" if each is None else str(each) for each in (params.system, params.component))


def as_form(form: FileForm | str) -> FileForm:
    """The form of this name.

    Raises:
        UsageError: there is none.
    """
    try:
        return FileForm(form)
    except ValueError:
        raise UsageError(f"no form of file is called {form!r}; there are {_listed(FileForm)}") from None


def form_of_name(name: str) -> FileForm:
    """The form that the ending of a file's name stands for.

    Raises:
        FileError: for none.
    """
    ending = PurePath(name).suffix.lower()
    form = ENDINGS.get(ending)
    if form is None:
        raise FileError(
            f"the ending {ending!r} stands for no form; name one ({_listed(FileForm)}), or end in one of "
            f"{_listed(ENDINGS)}",
            source=name,
        )
    return form


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)
