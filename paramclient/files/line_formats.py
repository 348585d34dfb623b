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
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import FileFormat
from paramclient.files.includes import Includes
from paramclient.files.param_file import AUTOPILOT, ParamFile, TooManyParams
from paramclient.files.text import (
    Builder,
    Problems,
    TextLine,
    as_type,
    comment_lines,
    excerpt,
    lines_of,
    parse_number,
    value_text,
)
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, WireValue, check_name

__all__ = ["is_pair", "is_qgc_row", "read_pairs", "read_qgc", "write_pairs", "write_qgc"]

DELETED_SHOWN_MAX: Final = 10
"""Names that the note on one `@delete` line lists, so that the note stays readable."""
DELETES_MAX: Final = 256
"""`@delete` lines of one file: each is compared with all parameters above it."""
DELETE_COMPARISONS_MAX: Final = 1_000_000
"""Comparisons of parameters with `@delete` lines in one file; takes half a second."""
_QGC_COLUMNS: Final = "Vehicle-Id Component-Id Name Value Type"
_QGC_ROW: Final = "vehicle, component, name, value and type, with tabs between them"
_qgc_nan: Final = re.compile(r"--\.-+").fullmatch
"""QGroundControl's notation of NaN (Fact.cc)."""
_include: Final = re.compile(r"@include[ \t]+(.*\S)").fullmatch
_delete: Final = re.compile(r"@delete[ \t]+(\S{1,64})").fullmatch
_blanks: Final = re.compile(r"[ \t]+")
_between: Final = re.compile(r"[ \t]*[,=][ \t]*|[ \t]+")
_decimal_comma: Final = re.compile(r"(?:^|[ \t,=])[+-]?[0-9]+,[0-9]+$").search
_name: Final = re.compile(r"(?=.*[A-Za-z])[^@\s,=#;/][^\s,=#;]*(?<!:)").fullmatch
_qgc_row: Final = re.compile(r"[0-9]+[ \t]+[0-9]+[ \t]+[^ \t]+[ \t]+[^ \t]+[ \t]+[0-9]+").fullmatch


@dataclass(slots=True)
class _Lines:
    """The content of one file, with that of the files that it includes.

    Attributes:
        params: the parameters in order, each with its position, for notes.
        notes: a note for each `@delete` line.
        deletes: number of `@delete` lines.
        comparisons: number of parameters that were compared with these lines.
        params_max: maximum number of parameters; None for any.
    """

    params: list[tuple[WrittenParam, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    deletes: int = 0
    comparisons: int = 0
    params_max: int | None = None

    def delete(self, pattern: str, place: str) -> None:
        """Remove the parameters so far whose names match a glob."""
        self.deletes += 1
        self.comparisons += len(self.params)
        names = {param.name for param, _ in self.params if fnmatchcase(param.name, pattern)}
        if not names:
            self.notes.append(f"@delete {pattern} in {place} matches no parameter above it.")
            return
        self.params = [each for each in self.params if each[0].name not in names]
        listed = ", ".join(sorted(names)[:DELETED_SHOWN_MAX])
        listed += ", …" if len(names) > DELETED_SHOWN_MAX else ""
        self.notes.append(f"@delete {pattern} in {place} removes {listed}.")


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
    another file, of which only the comments of parameters are kept. `@delete GLOB` removes the parameters
    above it in its file, and in the files included there, whose names match; forks of ArduPilot have it.

    Args:
        text: the content.
        file_format: which of the two formats the file has.
        source: the file's name, for errors.
        includes: reads the files of `@include` lines; None for bytes without a file on disk.
        params_max: as for `Builder`.

    Raises:
        FileError: a line is something else, also in an included file.
    """
    problems = Problems(source)
    lines = _Lines(params_max=params_max)
    header, footer = _read_lines(text, file_format, lines, problems, includes, is_included=False)
    builder = Builder(problems, params_max)
    for param, place in lines.params:
        builder.add(param, place=place)
    sets = builder.result()
    return ParamFile(sets, file_format, source, header, footer, (*lines.notes, *builder.notes))


def _read_lines(
    text: str,
    file_format: FileFormat,
    lines: _Lines,
    problems: Problems,
    includes: Includes | None,
    *,
    is_included: bool,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Add the parameters of one file to `lines`, and its bad lines to `problems`."""
    expected = "NAME,VALUE" if file_format is FileFormat.MISSION_PLANNER else "NAME VALUE"

    def include(line: TextLine, path: str) -> None:
        try:
            if includes is None:
                raise UsageError("only a file on disk can include another file")
            found = includes.follow(path)
            inner = _Lines(params_max=lines.params_max)
            problems_inside = Problems(found.source)
            _read_lines(found.text, file_format, inner, problems_inside, found.includes, is_included=True)
            problems_inside.raise_if_any()
            lines.params += inner.params
            lines.notes += inner.notes
        except FileError as error:
            here = f"{problems.source}:{line.number}: includes that file"
            raise error.with_more(here) from None
        except UsageError as error:
            problems.add(line.number, f"@include with a file that can be read ({error})", excerpt(line.text))

    def take(line: TextLine, comment: str) -> None:
        place = f"{problems.source}:{line.number}" if is_included else f"line {line.number}"
        if match := _include(line.text):
            include(line, match[1])
            return
        if match := _delete(line.text):
            if lines.deletes >= DELETES_MAX:
                problems.add(line.number, f"at most {DELETES_MAX} lines with @delete", excerpt(line.text))
            elif lines.comparisons + len(lines.params) > DELETE_COMPARISONS_MAX:
                most = f"at most {DELETE_COMPARISONS_MAX:,} comparisons of @delete lines with parameters"
                problems.add(line.number, most, excerpt(line.text))
            else:
                lines.delete(match[1], place)
            return
        words = _between.split(line.text)
        if words[-1] == "@READONLY":
            comment = f"{comment}\n@READONLY" if comment else "@READONLY"
            words.pop()
        problem = _pair_problem(line.text, words, expected)
        if problem is not None:
            problems.add(line.number, problem, excerpt(line.text))
            return
        value = parse_number(words[1])
        assert value is not None
        number = None if is_included else line.number
        lines.params.append((WrittenParam(words[0], value, comment=comment, line=number), place))
        TooManyParams.check(len(lines.params), lines.params_max, problems.source)

    return _read_commented_lines(text, take)


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
    builder = Builder(Problems(source), params_max)

    def take(line: TextLine, comment: str) -> None:
        columns = _blanks.split(line.text)
        if len(columns) != 5:
            builder.problems.add(line.number, _QGC_ROW, excerpt(line.text))
            return
        try:
            system, component = (_address(each) for each in columns[:2])
            kind = _type(columns[4])
            name, value = _checked_name(columns[2]), _qgc_value(columns[3])
            param = WrittenParam(name, _fitting(value, kind), kind, comment=comment, line=line.number)
        except UsageError as error:
            builder.problems.add(line.number, str(error), excerpt(line.text))
            return
        builder.add(param, system=system, component=component)

    header, footer = _read_commented_lines(text, take)
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
        raise UsageError(f"the name {param.name!r} cannot be written in this format; json and yaml keep it")
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


def _address(text: str) -> int:
    number = parse_number(text)
    if not isinstance(number, int) or not 1 <= number <= 255:
        raise UsageError("a system and a component from 1 to 255 in the first two columns")
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
