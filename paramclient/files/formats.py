"""Which form a file has, and from its bytes to what it says and back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import PurePath
from typing import Final, TypeAlias

from paramclient.errors import FileError, UsageError
from paramclient.files import document, line_formats, param_pck, script
from paramclient.files.includes import Includes
from paramclient.files.param_file import AUTOPILOT, ENDINGS, FileForm, ParamFile, address, as_form
from paramclient.files.text import decode_text, lines_of, time_of
from paramclient.model.identity import autopilot_name
from paramclient.model.paramset import ParamSet
from paramclient.model.values import check_name

__all__ = ["LARGEST_FILE", "Content", "dumps", "loads"]

LARGEST_FILE: Final = 16 * 1024 * 1024
"""Bytes of the largest file that is looked at: 65,535 parameters, as many as an index can count, with names,
bits, defaults and comments take less in the longest of the forms."""

Content: TypeAlias = ParamFile | ParamSet | Iterable[ParamSet]
"""What can be written: a file as it was read, the parameters of one component, or of several."""


def loads(
    data: bytes,
    *,
    source: str = "",
    form: FileForm | str | None = None,
    includes: Includes | None = None,
    params_max: int | None = None,
) -> ParamFile:
    """Read a parameter file from its bytes.

    The form is told by what is in it. MAVProxy and Mission Planner read each other's lists, so there the
    ending counts (`.parm`, `.param`); with another one a comma means Mission Planner. For a text whose first
    line fits no form, the ending says what is expected.

    Args:
        data: all of it.
        source: its name, for errors and `ParamSet.source`.
        form: the form that it has; None to find out.
        includes: follows the `@include` lines of a list; None refuses them, as bytes lie in no folder.
        params_max: parameters that it may hold; None for any number. A file with more is not read to its end.

    Raises:
        TooManyParams: it holds more than `params_max`.
        FileError: it has none of the forms, is damaged, or holds no parameter. Up to 20 bad lines are named.
        UsageError: no such form.
    """
    form = None if form is None else as_form(form)
    if len(data) > LARGEST_FILE:
        raise FileError(f"no parameter file has more than {LARGEST_FILE} bytes", source=source)
    if not data:
        raise FileError("the file is empty", source=source)
    if form is FileForm.PCK or (form is None and param_pck.is_packed(data)):
        return param_pck.read_packed(data, source)
    text = decode_text(data, source)
    form = form or _form_of(text, source)
    match form:
        case FileForm.QGC:
            return line_formats.read_qgc(text, source, params_max)
        case FileForm.PX4_SCRIPT:
            return script.read_script(text, source, params_max)
        case FileForm.JSON:
            return document.read_json(text, source, params_max)
        case FileForm.YAML:
            return document.read_yaml(text, source, params_max)
        case _:
            return line_formats.read_pairs(text, form, source, includes, params_max)


def dumps(content: Content, *, form: FileForm | str | None = None, target: str = "") -> bytes:
    """The bytes of a parameter file.

    Args:
        content: what is to be in it. A `ParamFile` keeps its header, footer and comments, as far as the form
            has such; others get a header that says whose parameters they are.
        form: the form; None for that of a `ParamFile`.
        target: the name of the file that it is for, for errors.

    Raises:
        FileError: the form cannot say it (what each can is in the guide), or there is no parameter.
        UsageError: no such form, or none is given.
    """
    if form is None and isinstance(content, ParamFile):
        form = content.form
    if form is None:
        raise UsageError("a form is needed to write parameters")
    form = as_form(form)
    try:
        around = _as_file(content, form)
        sets = [each for each in around.sets if each]
        return _bytes(sets, form, around)
    except UsageError as error:
        raise FileError(str(error), source=target) from error


def _bytes(sets: list[ParamSet], form: FileForm, around: ParamFile) -> bytes:
    if not sets:
        raise UsageError("there is no parameter to write")
    if len(sets) > 1 and form in (FileForm.PARM, FileForm.MISSION_PLANNER, FileForm.PCK):
        held = ", ".join(map(address, sets))
        raise UsageError(f"the form {form} holds one component, and there are {held}; choose one")
    _check(sets)
    match form:
        case FileForm.PCK:
            return param_pck.write_packed(sets[0])
        case FileForm.PX4_SCRIPT:
            raise UsageError("start scripts of PX4 are read and not written")
        case FileForm.QGC:
            lines = line_formats.write_qgc(sets, around)
        case FileForm.JSON:
            lines = document.write_json(sets, around)
        case FileForm.YAML:
            lines = document.write_yaml(sets, around)
        case _:
            lines = line_formats.write_pairs(sets, form, around)
    return "".join(f"{line}\n" for line in lines).encode("utf-8", "backslashreplace")


def _form_of(text: str, source: str) -> FileForm:
    """The form of a text.

    Raises:
        FileError: nothing in it says anything.
    """
    if text.lstrip().startswith("{"):  # it may be one line of megabytes, in which no comment is sought
        return FileForm.JSON
    first = next((line for line in lines_of(text) if line.text), None)
    if first is None:
        raise FileError("the file holds no parameter", source=source)
    if first.text.startswith("{"):
        return FileForm.JSON  # behind comments
    if line_formats.is_qgc_row(first.text):
        return FileForm.QGC
    if any(script.is_script_line(line.text) for line in lines_of(text)):
        return FileForm.PX4_SCRIPT
    if document.is_document(first.text):
        return FileForm.YAML
    named = ENDINGS.get(PurePath(source).suffix.lower())
    if named in (FileForm.PARM, FileForm.MISSION_PLANNER):
        return named
    if named in (FileForm.QGC, FileForm.JSON, FileForm.YAML) and not line_formats.is_pair(first.text):
        return named  # it is that or nothing, and the error says what was expected of it
    return FileForm.MISSION_PLANNER if "," in first.text else FileForm.PARM


def _as_file(content: Content, form: FileForm) -> ParamFile:
    if isinstance(content, ParamFile):
        return content
    sets = (content,) if isinstance(content, ParamSet) else tuple(content)
    if form in (FileForm.JSON, FileForm.YAML):
        return ParamFile(sets, form)  # what a header would say stands in fields
    return ParamFile(sets, form, header=tuple(line for each in sets for line in _about(each)))


def _about(params: ParamSet) -> Iterator[str]:
    """What is known of a set, in lines for people."""
    who = params.identity
    kind = "" if who is None else f", {autopilot_name(who.autopilot)}"
    parameters = "parameter" if len(params) == 1 else "parameters"
    yield f"{len(params)} {parameters} of system/component {address(params)}{kind}"
    if who is not None:
        commit = f", commit {who.git_hash}" if who.git_hash else ""
        version = ".".join(str(who.firmware >> shift & 0xFF) for shift in (24, 16, 8))
        firmware = f", firmware {version}{commit}" if who.firmware else ""
        yield f"of the vehicle {who.key}{firmware}"
    if params.at is not None:
        yield f"as of {time_of(params.at, 'seconds')}"
    if params.source:
        yield f"from {params.source}"


def _check(sets: list[ParamSet]) -> None:
    """Nobody could tell two sets of one component apart, nor use odd names or ids: UsageError."""
    seen = set()
    for each in sets:
        for number in (each.system, each.component):
            if number is not None and not 1 <= number <= 255:
                raise UsageError(f"systems and components have ids from 1 to 255, not {number}")
        for param in each.values():
            check_name(param.name)
        whose = (each.system, each.component or AUTOPILOT)
        if whose in seen:
            raise UsageError(f"two sets are of one component, {address(each)}")
        seen.add(whose)
