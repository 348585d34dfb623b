"""Format detection, and conversion of parameter files from and to bytes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import PurePath
from typing import Final, TypeAlias

from paramclient.errors import FileError, UsageError
from paramclient.files import json_format, line_formats, param_pck
from paramclient.files.formats import AUTOPILOT, ENDINGS, FileFormat, ParamFile, address, parse_format
from paramclient.files.includes import Includes
from paramclient.files.text import decode_text, lines_of, time_of
from paramclient.model.identity import autopilot_name, version_text
from paramclient.model.paramset import ParamSet
from paramclient.model.values import check_name
from paramclient.model.wording import counted

__all__ = ["LARGEST_FILE", "Content", "dumps", "loads"]

LARGEST_FILE: Final = 16 * 1024 * 1024
"""Largest parameter file, in bytes. 65,535 parameters, the most that an index can count, with names, bits,
defaults and comments take less in the longest format."""

Content: TypeAlias = ParamFile | ParamSet | Iterable[ParamSet]
"""Content to write: a file as read, the parameters of one component, or of several."""


def loads(
    data: bytes,
    *,
    source: str = "",
    file_format: FileFormat | str | None = None,
    includes: Includes | None = None,
    params_max: int | None = None,
) -> ParamFile:
    """Parse a parameter file.

    Detects the format from the content. MAVProxy and Mission Planner read each other's lists, so the
    extension decides between them (`.parm`, `.param`); with another extension, a comma means Mission
    Planner. If the first line matches no format, the extension decides which format the error describes.

    Args:
        data: the complete file.
        source: the file's name, for errors and `ParamSet.source`.
        file_format: the format; None to detect it.
        includes: reads the files of `@include` lines; None rejects such lines, as bytes have no folder.
        params_max: maximum number of parameters; None for any. A longer file is not read to its end.

    Raises:
        TooManyParams: the file has more parameters than `params_max`.
        FileError: unknown format, damaged, or without parameters. The error names up to 20 bad lines.
        UsageError: unknown format name.
    """
    file_format = None if file_format is None else parse_format(file_format)
    if len(data) > LARGEST_FILE:
        raise FileError(f"a parameter file has at most {LARGEST_FILE} bytes", source=source)
    if not data:
        raise FileError("the file is empty", source=source)
    if file_format is FileFormat.PCK or (file_format is None and param_pck.is_packed(data)):
        return param_pck.read_packed(data, source)
    text = decode_text(data, source)
    file_format = file_format or _format_of(text, source)
    match file_format:
        case FileFormat.QGC:
            return line_formats.read_qgc(text, source, params_max)
        case FileFormat.JSON:
            return json_format.read_json(text, source, params_max)
        case _:
            return line_formats.read_pairs(text, file_format, source, includes, params_max)


def dumps(content: Content, *, file_format: FileFormat | str | None = None, target: str = "") -> bytes:
    """Return the bytes of a parameter file.

    Args:
        content: the content to write. A `ParamFile` keeps its header, footer and comments if the format
            supports them; other content gets a header that names the vehicle.
        file_format: the format; None for that of a `ParamFile`.
        target: the name of the target file, for errors.

    Raises:
        FileError: the format cannot express the content (the guide lists what each can), or there are no
            parameters.
        UsageError: unknown format, or none given.
    """
    if file_format is None and isinstance(content, ParamFile):
        file_format = content.file_format
    if file_format is None:
        raise UsageError("give the format in which to write the parameters")
    file_format = parse_format(file_format)
    try:
        around = _as_file(content, file_format)
        sets = [each for each in around.sets if each]
        return _bytes(sets, file_format, around)
    except UsageError as error:
        raise FileError(str(error), source=target) from error


def _bytes(sets: list[ParamSet], file_format: FileFormat, around: ParamFile) -> bytes:
    if not sets:
        raise UsageError("there are no parameters to write")
    if len(sets) > 1 and file_format in (FileFormat.PARM, FileFormat.MISSION_PLANNER, FileFormat.PCK):
        components = ", ".join(map(address, sets))
        raise UsageError(
            f"the format {file_format} holds one component, and there are {components}; choose one"
        )
    _check(sets)
    if any(each.is_extended for each in sets):
        if file_format is not FileFormat.JSON:
            raise UsageError(f"the format {file_format} cannot hold extended parameters; write .json")
        if len(sets) > 1:
            raise UsageError("a file of extended parameters holds one component, and no plain parameters")
    match file_format:
        case FileFormat.PCK:
            return param_pck.write_packed(sets[0])
        case FileFormat.QGC:
            lines = line_formats.write_qgc(sets, around)
        case FileFormat.JSON:
            lines = json_format.write_json(sets, around)
        case _:
            lines = line_formats.write_pairs(sets, file_format, around)
    return "".join(f"{line}\n" for line in lines).encode("utf-8", "backslashreplace")


def _format_of(text: str, source: str) -> FileFormat:
    """Return the format of a text.

    Raises:
        FileError: the text has no line with content.
    """
    if text.lstrip().startswith("{"):  # it may be one line of megabytes, in which no comment is sought
        return FileFormat.JSON
    first = next((line for line in lines_of(text) if line.text), None)
    if first is None:
        raise FileError("the file contains no parameters", source=source)
    if first.text.startswith("{"):
        return FileFormat.JSON  # behind comments
    if line_formats.is_qgc_row(first.text):
        return FileFormat.QGC
    named = ENDINGS.get(PurePath(source).suffix.lower())
    if named in (FileFormat.PARM, FileFormat.MISSION_PLANNER):
        return named
    if named in (FileFormat.QGC, FileFormat.JSON) and not line_formats.is_pair(first.text):
        return named  # no other format is possible, and reading gives the error for this one
    return FileFormat.MISSION_PLANNER if "," in first.text else FileFormat.PARM


def _as_file(content: Content, file_format: FileFormat) -> ParamFile:
    if isinstance(content, ParamFile):
        return content
    sets = (content,) if isinstance(content, ParamSet) else tuple(content)
    if file_format is FileFormat.JSON:
        return ParamFile(sets, file_format)  # the document has fields for the header's facts
    return ParamFile(sets, file_format, header=tuple(line for each in sets for line in _header_lines(each)))


def _header_lines(params: ParamSet) -> Iterator[str]:
    """Generate a description of a set, for the header of a file."""
    identity = params.identity
    kind = "" if identity is None else f", {autopilot_name(identity.autopilot)}"
    yield f"{counted(len(params), 'parameter')} of system/component {address(params)}{kind}"
    if identity is not None:
        commit = f", commit {identity.git_hash}" if identity.git_hash else ""
        firmware = f", firmware {version_text(identity.firmware)}{commit}" if identity.firmware else ""
        yield f"of the vehicle {identity.key}{firmware}"
    if params.at is not None:
        yield f"as of {time_of(params.at, 'seconds')}"
    if params.source:
        yield f"from {params.source}"


def _check(sets: list[ParamSet]) -> None:
    """Raise UsageError for invalid names or ids, or two sets of one component: nothing
    distinguishes them."""
    seen = set()
    for each in sets:
        for number, least in ((each.system, 1), (each.component, 0)):
            if number is not None and not least <= number <= 255:
                raise UsageError(f"a system or component has an id from {least} to 255, not {number}")
        for param in each.values():
            check_name(param.name)
        ids = (each.system, AUTOPILOT if each.component is None else each.component)
        if ids in seen:
            raise UsageError(f"two sets have the same component, {address(each)}")
        seen.add(ids)
