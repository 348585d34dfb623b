"""The forms that have a parameter on each line: QGroundControl's, MAVProxy's, Mission Planner's.

QGroundControl (user guide, "Parameter File Format"; ParameterManager.cc) splits a line at tabs, takes those
with five columns and skips those that begin with `#`. MAVProxy (pymavlink, mavparm.py) and ArduPilot
(AP_Param.cpp) take a name and a value with spaces, tabs or a comma between them; `#` ends a line for the one,
and the other looks at nothing behind the value. Mission Planner (ParamFile.cs) skips without a word every
line that has more than these two. So comments are written on lines of their own, which all of them skip.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.files.includes import Includes
from paramclient.files.param_file import AUTOPILOT, FileForm, ParamFile, TooManyParams
from paramclient.files.text import (
    Builder,
    Line,
    Problems,
    as_type,
    comment_lines,
    lines_of,
    parse_number,
    shown,
    value_text,
)
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, Value, check_name

__all__ = ["is_pair", "is_qgc_row", "read_pairs", "read_qgc", "write_pairs", "write_qgc"]

DELETED_SHOWN_MAX: Final = 10
"""Names that the note on one `@delete` line lists."""
DELETES_MAX: Final = 256
"""`@delete` lines of one file: each looks through all parameters above it."""
DELETE_LOOKS_MAX: Final = 1_000_000
"""Parameters that the `@delete` lines of one file look at, one after the other: half a second."""
_QGC_COLUMNS: Final = "Vehicle-Id Component-Id Name Value Type"
_QGC_ROW: Final = "vehicle, component, name, value and type, with tabs between them"
_qgc_nan: Final = re.compile(r"--\.-+").fullmatch
"""What QGroundControl writes for NaN (Fact.cc)."""
_include: Final = re.compile(r"@include[ \t]+(.*\S)").fullmatch
_delete: Final = re.compile(r"@delete[ \t]+(\S{1,64})").fullmatch
_blanks: Final = re.compile(r"[ \t]+")
_between: Final = re.compile(r"[ \t]*[,=][ \t]*|[ \t]+")
_decimal_comma: Final = re.compile(r"(?:^|[ \t,=])[+-]?[0-9]+,[0-9]+$").search
_name: Final = re.compile(r"(?=.*[A-Za-z])[^@\s,=#;/][^\s,=#;]*(?<!:)").fullmatch
_qgc_row: Final = re.compile(r"[0-9]+[ \t]+[0-9]+[ \t]+[^ \t]+[ \t]+[^ \t]+[ \t]+[0-9]+").fullmatch


@dataclass(slots=True)
class _Lines:
    """What the lines of one file say, with those of the files that it includes.

    Attributes:
        params: the parameters in order, each with the place where it stands, for notes.
        notes: what its `@delete` lines took out.
        deletes: how many such lines it has.
        looks: how many parameters these have looked at.
        params_max: parameters that there may be; None for any number.
    """

    params: list[tuple[WrittenParam, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    deletes: int = 0
    looks: int = 0
    params_max: int | None = None

    def delete(self, pattern: str, place: str) -> None:
        """Take out the parameters so far whose names fit a glob."""
        self.deletes += 1
        self.looks += len(self.params)
        names = {param.name for param, _ in self.params if fnmatchcase(param.name, pattern)}
        if not names:
            self.notes.append(f"@delete {pattern} in {place} fits no parameter above it.")
            return
        self.params = [each for each in self.params if each[0].name not in names]
        listed = ", ".join(sorted(names)[:DELETED_SHOWN_MAX])
        listed += ", …" if len(names) > DELETED_SHOWN_MAX else ""
        self.notes.append(f"@delete {pattern} in {place} takes out {listed}.")


def read_pairs(
    text: str,
    form: FileForm,
    source: str,
    includes: Includes | None = None,
    params_max: int | None = None,
) -> ParamFile:
    """Read a file with a name and a value on each line.

    A name is followed by a value, with spaces, tabs, a comma or `=` between them, and by nothing else but a
    comment, or ArduPilot's `@READONLY`, which is kept as one. `@include FILE` stands for the lines of another
    file; of its comments only those of its parameters are kept. `@delete GLOB` takes out the parameters above
    it in its file, and in those included there, whose names fit; forks of ArduPilot have it.

    Args:
        text: what the file holds.
        form: which of the two it is.
        source: its name, for errors.
        includes: follows its `@include` lines; None for bytes that are no file on a disk.
        params_max: as for `Builder`.

    Raises:
        FileError: for any line that is something else, also in an included file.
    """
    problems = Problems(source)
    lines = _Lines(params_max=params_max)
    header, footer = _read_lines(text, form, lines, problems, includes, is_included=False)
    builder = Builder(problems, params_max)
    for param, place in lines.params:
        builder.add(param, place=place)
    sets = builder.result()
    return ParamFile(sets, form, source, header, footer, (*lines.notes, *builder.notes))


def _read_lines(
    text: str,
    form: FileForm,
    lines: _Lines,
    problems: Problems,
    includes: Includes | None,
    *,
    is_included: bool,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Add the parameters of one file to `lines`, and what is wrong with it to `problems`."""
    expected = "NAME,VALUE" if form is FileForm.MISSION_PLANNER else "NAME VALUE"

    def include(line: Line, path: str) -> None:
        try:
            if includes is None:
                raise UsageError("only a file on the disk can include another one")
            found = includes.follow(path)
            inner = _Lines(params_max=lines.params_max)
            problems_inside = Problems(found.source)
            _read_lines(found.text, form, inner, problems_inside, found.includes, is_included=True)
            problems_inside.raise_if_any()
            lines.params += inner.params
            lines.notes += inner.notes
        except FileError as error:
            here = f"{problems.source}:{line.number}: includes that file"
            raise error.with_more(here) from None
        except UsageError as error:
            problems.add(line.number, f"@include with a file that can be read ({error})", shown(line.text))

    def take(line: Line, comment: str) -> None:
        place = f"{problems.source}:{line.number}" if is_included else f"line {line.number}"
        if match := _include(line.text):
            include(line, match[1])
            return
        if match := _delete(line.text):
            if lines.deletes >= DELETES_MAX:
                problems.add(line.number, f"at most {DELETES_MAX} lines with @delete", shown(line.text))
            elif lines.looks + len(lines.params) > DELETE_LOOKS_MAX:
                most = f"@delete lines that look at {DELETE_LOOKS_MAX:,} parameters together"
                problems.add(line.number, f"at most {most}", shown(line.text))
            else:
                lines.delete(match[1], place)
            return
        words = _between.split(line.text)
        if words[-1] == "@READONLY":
            comment = f"{comment}\n@READONLY" if comment else "@READONLY"
            words.pop()
        problem = _wrong_with_pair(line.text, words, expected)
        if problem is not None:
            problems.add(line.number, problem, shown(line.text))
            return
        value = parse_number(words[1])
        assert value is not None
        number = None if is_included else line.number
        lines.params.append((WrittenParam(words[0], value, comment=comment, line=number), place))
        TooManyParams.check(len(lines.params), lines.params_max, problems.source)

    return _walk(text, take)


def write_pairs(sets: Sequence[ParamSet], form: FileForm, around: ParamFile) -> Iterator[str]:
    """The lines of a file with a name and a value on each.

    Args:
        sets: one set; the form cannot say more.
        form: with a comma for Mission Planner, else with a space.
        around: for what stands on top and at the end.

    Raises:
        UsageError: the form cannot say it.
    """
    comma = "," if form is FileForm.MISSION_PLANNER else " "
    rows = ((param, f"{_pair_name(param)}{comma}{value_text(param)}") for param in sets[0].values())
    yield from _framed(around.header, rows, around.footer)


def is_qgc_row(text: str) -> bool:
    """Whether a line could be one of QGroundControl's."""
    return _qgc_row(text) is not None


def is_pair(text: str) -> bool:
    """Whether a line has a name and a number."""
    words = _between.split(text)
    return len(words) >= 2 and _name(words[0]) is not None and parse_number(words[1]) is not None


def read_qgc(text: str, source: str, params_max: int | None = None) -> ParamFile:
    """Read a file of QGroundControl. Spaces between its columns do for tabs, as others write it so.

    Raises:
        FileError: for any line that is not five columns, or whose value does not fit its type.
    """
    builder = Builder(Problems(source), params_max)

    def take(line: Line, comment: str) -> None:
        columns = _blanks.split(line.text)
        if len(columns) != 5:
            builder.problems.add(line.number, _QGC_ROW, shown(line.text))
            return
        try:
            system, component = (_address(each) for each in columns[:2])
            kind = _type(columns[4])
            name, value = _checked_name(columns[2]), _qgc_value(columns[3])
            param = WrittenParam(name, _fitting(value, kind), kind, comment=comment, line=line.number)
        except UsageError as error:
            builder.problems.add(line.number, str(error), shown(line.text))
            return
        builder.add(param, system=system, component=component)

    header, footer = _walk(text, take)
    return ParamFile(builder.result(), FileForm.QGC, source, header, footer, tuple(builder.notes))


def write_qgc(sets: Sequence[ParamSet], around: ParamFile) -> Iterator[str]:
    """The lines of a file of QGroundControl.

    Raises:
        UsageError: a set does not say its system, or a parameter its type; or a value is no number.
    """
    header = list(around.header)
    if _QGC_COLUMNS not in header:
        systems = ", ".join(str(each) for each in dict.fromkeys(params.system for params in sets))
        header = [f"Onboard parameters for Vehicle {systems}", "", *header, *([""] if header else [])]
        header.append(_QGC_COLUMNS)
    rows = ((param, _qgc_line(params, param)) for params in sets for param in params.values())
    yield from _framed(header, rows, around.footer)


def _walk(text: str, take: Callable[[Line, str], None]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Give each line that says something, with the comments that belong to it; return header and footer.

    What stands before the first parameter is the header, up to the last empty line if there is one.
    """
    header: list[str] = []
    waiting: list[str] = []
    at_top, parted = True, False
    for line in lines_of(text):
        if line.text:
            if at_top and not parted:
                header, waiting = waiting, []
            at_top = False
            if line.comment:
                waiting.append(line.comment)
            take(line, "\n".join(waiting))
            waiting = []
        elif line.comment is not None:
            waiting.append(line.comment)
        elif at_top:
            parted = True
            header += waiting
            waiting = []
    return tuple(header), tuple(waiting)


def _framed(
    header: Sequence[str], rows: Iterable[tuple[WrittenParam, str]], footer: Sequence[str]
) -> Iterator[str]:
    """The lines of a file, so that `_walk` finds the same header, comments and footer in it."""
    yield from comment_lines(header)
    for place, (param, row) in enumerate(rows):
        if param.comment:
            if place == 0:
                yield ""
            yield from comment_lines([param.comment])
        yield row
    yield from comment_lines(footer)


def _wrong_with_pair(text: str, words: list[str], expected: str) -> str | None:
    """What was expected of a line, or None where it is as it should be."""
    if text.startswith("@"):
        return f"{expected} (a line for ArduPilot's tools that is not known)"
    if _decimal_comma(text) and len(words) == 3:
        return f"{expected} with a decimal point (1.5, not 1,5)"
    if len(words) == 3 and parse_number(words[1]) is not None:
        return f"{expected} and nothing behind it (no unit, no further column)"
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
    """The name, if a line can begin with it; else UsageError."""
    if _name(param.name) is None:
        raise UsageError(
            f"the name {param.name!r} cannot stand in a line of this form; json and yaml keep it"
        )
    return param.name


def _qgc_line(params: ParamSet, param: WrittenParam) -> str:
    if params.system is None:
        raise UsageError("this form names the system of each parameter, and the set has none: give it one")
    if not isinstance(param.type, ParamType):
        raise UsageError(f"{param.name} has no type that MAVLink defines, and this form needs one")
    component = AUTOPILOT if params.component is None else params.component
    text = value_text(param)
    if isinstance(param.value, float) and not math.isfinite(param.value):
        text = text.lower().removesuffix("inity")  # as Qt reads it
    return f"{params.system}\t{component}\t{_pair_name(param)}\t{text}\t{int(param.type)}"


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


def _fitting(value: int | float, kind: ParamType) -> Value:
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
