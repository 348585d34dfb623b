"""FileFormat: the supported file formats, and their file extensions."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from pathlib import PurePath
from typing import Final

from paramclient.errors import FileError, UsageError

__all__ = ["ENDINGS", "FileFormat", "LogFormat", "format_of_name", "parse_format"]


class FileFormat(StrEnum):
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


class LogFormat(StrEnum):
    """Formats of on-board logs, which `paramclient.logs` reads. None of them can be written."""

    DATAFLASH = "dataflash"
    """ArduPilot, `.bin`."""
    ULOG = "ulog"
    """PX4, `.ulg`."""


ENDINGS: Final = {
    ".params": FileFormat.QGC,
    ".parm": FileFormat.PARM,
    ".param": FileFormat.MISSION_PLANNER,
    ".pck": FileFormat.PCK,
    ".json": FileFormat.JSON,
}
"""Formats by file extension, in lower case."""


def parse_format(file_format: FileFormat | str) -> FileFormat:
    """Return the format with this name.

    Raises:
        UsageError: there is no such format.
    """
    try:
        return FileFormat(file_format)
    except ValueError:
        raise UsageError(
            f"unknown file format {file_format!r}; the formats are {_listed(FileFormat)}"
        ) from None


def format_of_name(name: str) -> FileFormat:
    """Return the format for the extension of a file's name.

    Raises:
        FileError: the extension is unknown.
    """
    ending = PurePath(name).suffix.lower()
    file_format = ENDINGS.get(ending)
    if file_format is None:
        raise FileError(
            f"unknown file extension {ending!r}. Choose a format ({_listed(FileFormat)}), or one of the "
            f"extensions {_listed(ENDINGS)}",
            source=name,
        )
    return file_format


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)
