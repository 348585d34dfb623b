"""Line-based formats with one parameter per line: QGroundControl's, MAVProxy's, Mission Planner's.

QGroundControl (user guide, "Parameter File Format"; ParameterManager.cc) splits a line at tabs, accepts lines
with five columns and skips those that begin with `#`. MAVProxy (pymavlink, mavparm.py) and ArduPilot
(AP_Param.cpp) accept a name and a value separated by spaces, tabs or a comma; MAVProxy ends a line at `#`,
ArduPilot ignores everything after the value. Mission Planner (ParamFile.cs) silently skips every line with
more than these two. Comments are therefore written on separate lines, which all of them skip.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import AUTOPILOT, FileFormat, ParamFile, TooManyParams
from paramclient.files.includes import Includes
from paramclient.files.text import (
    Builder,
    Problems,
    TextLine,
    as_type,
    comment_lines,
    lines_of,
    parse_number,
    value_text,
)
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, WireValue, check_name

__all__ = ["is_pair", "is_qgc_row", "read_pairs", "read_qgc", "write_pairs", "write_qgc"]

_QGC_COLUMNS: Final = "Vehicle-Id Component-Id Name Value Type"
_QGC_ROW: Final = "vehicle, component, name, value and type, with tabs between them"
_qgc_nan: Final = re.compile(r"--\.-+").fullmatch
"""QGroundControl's notation of NaN (Fact.cc)."""
_include: Final = re.compile(r"@include[ \t]+(.*\S)").fullmatch
_blanks: Final = re.compile(r"[ \t]+")
_between: Final = re.compile(r"[ \t]*[,=][ \t]*|[ \t]+")
_decimal_comma: Final = re.compile(r"(?:^|[ \t,=])[+-]?[0-9]+,[0-9]+$").search
_name: Final = re.compile(r"(?=.*[A-Za-z])[^@\s,=#;/][^\s,=#;]*(?<!:)").fullmatch
_qgc_row: Final = re.compile(r"[0-9]+[ \t]+[0-9]+[ \t]+[^ \t]+[ \t]+[^ \t]+[ \t]+[0-9]+").fullmatch


def read_pairs(
    text: str,
    file_format: FileFormat,
    source: str,
    includes: Includes | None = None,
    params_max: int | None = None,
) -> ParamFile:
    """Read a file with a name and a value on each line.

    Name and value are separated by spaces, tabs, a comma or `=`. After the value, only a comment may follow,
    or ArduPilot's `@READONLY`, which is kept as a comment. `@include FILE` is replaced with the lines of
    another file, of which only the comments of parameters are kept.

    Args:
        text: the content.
        file_format: which of the two formats the file has.
        source: the file's name, for errors.
        includes: reads the files of `@include` lines; None for bytes without a file on disk.
        params_max: as for `Builder`.

    Raises:
        FileError: a line is something else, also in an included file.
    """
    builder = Builder(source, params_max)
    expected = "NAME,VALUE" if file_format is FileFormat.MISSION_PLANNER else "NAME VALUE"
    header, footer = _read_pairs(text, source, expected, builder, includes, is_included=False)
    return ParamFile(builder.result(), file_format, source, header, footer, tuple(builder.notes))


def _read_pairs(
    text: str, source: str, expected: str, builder: Builder, includes: Includes | None, *, is_included: bool
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Add the parameters of one file, and of those that it includes; return header and footer."""
    problems = Problems(source)

    def include(line: TextLine, path: str) -> None:
        try:
            if includes is None:
                raise UsageError("only a file on disk can include another file")
            found, inner = includes.read(path)
            _read_pairs(found, inner.source, expected, builder, inner, is_included=True)
        except TooManyParams:
            raise
        except FileError as error:
            raise error.with_more(f"{source}:{line.number}: includes that file") from None
        except UsageError as error:
            problems.add_line(line, f"@include with a file that can be read ({error})")

    def take(line: TextLine, comment: str) -> None:
        if match := _include(line.text):
            include(line, match[1])
            return
        words = _between.split(line.text)
        if words[-1] == "@READONLY":
            comment = f"{comment}\n@READONLY" if comment else "@READONLY"
            words.pop()
        problem = _pair_problem(line.text, words, expected)
        if problem is not None:
            problems.add_line(line, problem)
            return
        value = parse_number(words[1])
        assert value is not None
        number = None if is_included else line.number
        place = f"{source}:{line.number}" if is_included else f"line {line.number}"
        builder.add(WrittenParam(words[0], value, comment=comment, line=number), place)

    header, footer = _read_commented_lines(text, take)
    problems.raise_if_any()
    return header, footer


def write_pairs(sets: Sequence[ParamSet], file_format: FileFormat, around: ParamFile) -> Iterator[str]:
    """Generate the lines of a file with a name and a value on each line.

    Args:
        sets: one set, as the format has no components.
        file_format: decides the separator: a comma for Mission Planner, else a space.
        around: for header and footer.

    Raises:
        UsageError: the format cannot express a name or a value.
    """
    comma = "," if file_format is FileFormat.MISSION_PLANNER else " "
    rows = ((param, f"{_pair_name(param)}{comma}{value_text(param)}") for param in sets[0].values())
    yield from _with_comments(around.header, rows, around.footer)


def is_qgc_row(text: str) -> bool:
    """Return whether a line could be one of QGroundControl's."""
    return _qgc_row(text) is not None


def is_pair(text: str) -> bool:
    """Return whether a line has a name and a number."""
    words = _between.split(text)
    return len(words) >= 2 and _name(words[0]) is not None and parse_number(words[1]) is not None


def read_qgc(text: str, source: str, params_max: int | None = None) -> ParamFile:
    """Read a file of QGroundControl. Columns may be separated by spaces too, as other programs write them.

    Raises:
        FileError: a line does not have five columns, or its value does not fit its type.
    """
    builder, problems = Builder(source, params_max), Problems(source)

    def take(line: TextLine, comment: str) -> None:
        columns = _blanks.split(line.text)
        if len(columns) != 5:
            problems.add_line(line, _QGC_ROW)
            return
        try:
            system, component = _address(columns[0], 1), _address(columns[1], 0)
            kind = _type(columns[4])
            name, value = _checked_name(columns[2]), _qgc_value(columns[3])
            param = WrittenParam(name, _fitting(value, kind), kind, comment=comment, line=line.number)
        except UsageError as error:
            problems.add_line(line, str(error))
            return
        builder.add(param, f"line {line.number}", system=system, component=component)

    header, footer = _read_commented_lines(text, take)
    problems.raise_if_any()
    return ParamFile(builder.result(), FileFormat.QGC, source, header, footer, tuple(builder.notes))


def write_qgc(sets: Sequence[ParamSet], around: ParamFile) -> Iterator[str]:
    """Generate the lines of a file of QGroundControl.

    Raises:
        UsageError: a set has no system id, or a parameter has no type; or a value is not a number.
    """
    header = list(around.header)
    if _QGC_COLUMNS not in header:
        systems = ", ".join(str(each) for each in dict.fromkeys(params.system for params in sets))
        header = [f"Onboard parameters for Vehicle {systems}", "", *header, *([""] if header else [])]
        header.append(_QGC_COLUMNS)
    rows = ((param, _qgc_line(params, param)) for params in sets for param in params.values())
    yield from _with_comments(header, rows, around.footer)


def _read_commented_lines(
    text: str, take: Callable[[TextLine, str], None]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Call `take` for each line with content, with its comments; return header and footer.

    The header is the comments above the first parameter, up to the last empty line if there is one.
    """
    header: list[str] = []
    waiting: list[str] = []
    at_top, has_gap = True, False
    for line in lines_of(text):
        if line.text:
            if at_top and not has_gap:
                header, waiting = waiting, []
            at_top = False
            if line.comment:
                waiting.append(line.comment)
            take(line, "\n".join(waiting))
            waiting = []
        elif line.comment is not None:
            waiting.append(line.comment)
        elif at_top:
            has_gap = True
            header += waiting
            waiting = []
    return tuple(header), tuple(waiting)


def _with_comments(
    header: Sequence[str], rows: Iterable[tuple[WrittenParam, str]], footer: Sequence[str]
) -> Iterator[str]:
    """Generate the lines of a file, so that reading it gives the same header, comments and footer."""
    yield from comment_lines(header)
    for place, (param, row) in enumerate(rows):
        if param.comment:
            if place == 0:
                yield ""
            yield from comment_lines([param.comment])
        yield row
    yield from comment_lines(footer)


def _pair_problem(text: str, words: list[str], expected: str) -> str | None:
    """Return the expected content of a line, or None if the line is valid."""
    if text.startswith("@"):
        return f"{expected} (an unknown instruction for ArduPilot's tools)"
    if _decimal_comma(text) and len(words) == 3:
        return f"{expected} with a decimal point (1.5, not 1,5)"
    if len(words) == 3 and parse_number(words[1]) is not None:
        return f"{expected} and nothing after it (no unit, no further column)"
    if len(words) != 2:
        return expected
    if parse_number(words[1]) is None:
        return f"{expected} with a number"
    if _name(words[0]) is None:
        return f"{expected} with a parameter's name"
    try:
        check_name(words[0])
    except UsageError as error:
        return f"{expected} ({error})"
    return None


def _pair_name(param: WrittenParam) -> str:
    """Return the name if a line can begin with it; else raise UsageError."""
    if _name(param.name) is None:
        raise UsageError(f"the name {param.name!r} cannot be written in this format; json keeps it")
    return param.name


def _qgc_line(params: ParamSet, param: WrittenParam) -> str:
    if params.system is None:
        raise UsageError(
            "this format needs the system id of each parameter, and the set has none: give it one"
        )
    if not isinstance(param.type_number, ParamType):
        raise UsageError(f"{param.name} has no type that MAVLink defines, and this format needs one")
    component = AUTOPILOT if params.component is None else params.component
    text = value_text(param)
    if isinstance(param.value, float) and not math.isfinite(param.value):
        text = text.lower().removesuffix("inity")  # Qt's notation
    return f"{params.system}\t{component}\t{_pair_name(param)}\t{text}\t{int(param.type_number)}"


def _address(text: str, least: int) -> int:
    number = parse_number(text)
    if not isinstance(number, int) or not least <= number <= 255:
        raise UsageError("a system from 1 to 255 and a component from 0 to 255 in the first two columns")
    return number


def _type(text: str) -> ParamType:
    number = parse_number(text)
    if not isinstance(number, int) or not 1 <= number <= ParamType.REAL64:
        raise UsageError("a type from 1 to 10 (MAV_PARAM_TYPE) in the last column")
    return ParamType(number)


def _fitting(value: int | float, kind: ParamType) -> WireValue:
    try:
        return as_type(value, kind)
    except UsageError as error:
        raise UsageError(f"a value that its type can hold ({error})") from None


def _checked_name(text: str) -> str:
    if _name(text) is None:
        raise UsageError("a parameter's name in the third column")
    return check_name(text)


def _qgc_value(text: str) -> int | float:
    if _qgc_nan(text):
        return math.nan
    number = parse_number(text)
    if number is None:
        comma = " with a decimal point" if "," in text else ""
        raise UsageError(f"a number{comma} in the fourth column")
    return number
