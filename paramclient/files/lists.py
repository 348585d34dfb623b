"""Lists with one parameter per line: QGroundControl's, MAVProxy's, Mission Planner's.

QGroundControl (user guide, "Parameter File Format"; ParameterManager.cc) splits a line at tabs, accepts lines
with five columns and skips those that begin with `#`. MAVProxy (pymavlink, mavparm.py) and ArduPilot
(AP_Param.cpp) accept a name and a value separated by spaces, tabs or a comma; MAVProxy ends a line at `#`,
ArduPilot ignores everything after the value. Mission Planner (ParamFile.cs) silently skips every line with
more than these two. Comments are therefore written on separate lines, which all of them skip.

ArduPilot's build tools replace a line `@include FILE` with the named file (chibios_hwdef.py); its path is
relative to the file with the line. In ArduPilot's tree, it is always in a folder next to that of the file.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePath
from typing import Final, TypeAlias

from paramclient.errors import UsageError
from paramclient.files.disk import LARGEST_FILE, read_bytes
from paramclient.files.formats import AUTOPILOT, FileFormat, ParamFile
from paramclient.files.reading import (
    Reading,
    TextLine,
    as_type,
    comment_lines,
    decode_text,
    lines_of,
    parse_number,
    value_text,
)
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import NAME_LENGTH, ParamType, Value, check_portable_name, is_portable_name

FILES_MAX: Final = 64
"""Files that one file may include in total, nested or not. Two lines in each of a few files could include
thousands."""

_QGC_COLUMNS: Final = "Vehicle-Id Component-Id Name Value Type"
_QGC_IDS: Final = "a system from 1 to 255 and a component from 0 to 255 in the first two columns"
_QGC_TYPE: Final = "a type from 1 to 10 (MAV_PARAM_TYPE) in the last column"
_qgc_nan: Final = re.compile(r"--\.-+").fullmatch
"""QGroundControl's notation of NaN (Fact.cc)."""
_include: Final = re.compile(r"@include[ \t]+(.*\S)").fullmatch
_blanks: Final = re.compile(r"[ \t]+")
_between: Final = re.compile(r"[ \t]*[,=][ \t]*|[ \t]+")
_decimal_comma: Final = re.compile(r"(?:^|[ \t,=])[+-]?[0-9]+,[0-9]+$").search
is_qgc_row: Final = re.compile(r"[0-9]+[ \t]+[0-9]+[ \t]+[^ \t]+[ \t]+[^ \t]+[ \t]+[0-9]+").fullmatch
"""Whether a line could be one of QGroundControl's."""

Comments: TypeAlias = tuple[tuple[str, ...], tuple[str, ...]]
"""The header and the footer of a file."""


# Names and values


def is_pair(text: str) -> bool:
    """Return whether a line has a name and a number."""
    words = _between.split(text)
    return len(words) >= 2 and parse_number(words[1]) is not None and is_portable_name(words[0])


def read_pairs(reading: Reading, file_format: FileFormat) -> ParamFile:
    """Read a file with a name and a value on each line.

    Name and value are separated by spaces, tabs, a comma or `=`. After the value, only a comment may follow,
    or ArduPilot's `@READONLY`, which is kept as a comment. `@include FILE` is replaced with the lines of
    another file, of which only the comments of parameters are kept.

    Raises:
        FileError: a line is something else, also in an included file.
    """
    expected = "NAME,VALUE" if file_format is FileFormat.MISSION_PLANNER else "NAME VALUE"
    return reading.file(file_format, *_Pairs(reading, expected).read(reading.text, reading.source, ()))


def pair_line(separator: str, params: ParamSet, param: WrittenParam) -> str:
    """Return the line of a parameter, or raise UsageError if the format cannot express it."""
    return f"{check_portable_name(param.name)}{separator}{value_text(param)}"


class _Pairs:
    """The lines of one file with a name and a value on each, and of the files that it includes."""

    def __init__(self, reading: Reading, expected: str) -> None:
        self._reading = reading
        self._expected = expected
        self._sizes: list[int] = []  # of the included files

    def read(self, text: str, source: str, chain: tuple[Path, ...]) -> Comments:
        """Add the parameters of one file, and return its header and footer.

        Args:
            text: its content.
            source: its name.
            chain: the real paths of the files that include each other, up to the one that includes this one.
        """
        return _read_commented_lines(text, self._reading, partial(self._take, source, chain))

    def _take(self, source: str, chain: tuple[Path, ...], line: TextLine, comment: str) -> None:
        if match := _include(line.text):
            self._include(line, match[1], source, chain)
            return
        words = _between.split(line.text)
        if words[-1] == "@READONLY":
            comment = f"{comment}\n@READONLY" if comment else "@READONLY"
            words.pop()
        value = self._number(line, words, source)
        expected = f"{self._expected} with a parameter's name"
        if value is None or not _has_name(self._reading, line, words[0], expected, source):
            return
        number = None if chain else line.number
        place = f"{source}:{line.number}" if chain else f"line {line.number}"
        self._reading.add(WrittenParam(words[0], value, comment=comment, line=number), place)

    def _number(self, line: TextLine, words: list[str], source: str) -> int | float | None:
        """Return the value of a line; None, with a fault, if it has none."""
        value = parse_number(words[1]) if len(words) > 1 else None
        if line.text.startswith("@") and value is None:
            problem = " (an unknown instruction for ArduPilot's tools)"
        elif _decimal_comma(line.text) and len(words) == 3:
            problem = " with a decimal point (1.5, not 1,5) and no third column"
        elif len(words) == 3 and value is not None:
            problem = " and nothing after it (no unit, no further column)"
        elif len(words) == 2 and value is not None:
            return value
        else:
            problem = " with a number" if len(words) == 2 else ""
        self._reading.bad_line(line, f"{self._expected}{problem}", source)
        return None

    def _include(self, line: TextLine, path: str, source: str, chain: tuple[Path, ...]) -> None:
        before = self._reading.fault_count
        try:
            self._read_included(path, source, chain)
        except UsageError as error:
            self._reading.bad_line(line, f"@include with a readable file ({error})", source, is_row=False)
            return
        if self._reading.fault_count > before and not self._reading.partial:
            self._reading.fault(line.number, "includes that file", source=source)

    def _read_included(self, path: str, source: str, chain: tuple[Path, ...]) -> None:
        """Add the parameters of an included file.

        A path is relative to the folder of the file with the line. The file must be in the folder of the
        first file, beside that folder, or below either, also after symbolic links are resolved.

        Raises:
            UsageError: the file must not be included or cannot be read; with the reason in words.
        """
        if not self._reading.is_on_disk:
            raise UsageError("only a file on disk can include another file")
        if PurePath(path).is_absolute():
            raise UsageError("absolute paths are not allowed")
        chain = (*chain, Path(os.path.realpath(source)))
        name = str(Path(source).parent / path)
        real = Path(os.path.realpath(name))
        top = chain[0].parent.parent
        if not real.is_relative_to(top):
            raise UsageError(f"it lies outside of {top}; only files below that folder can be included")
        if real in chain:
            raise UsageError("the files include each other (circular @include)")
        if len(self._sizes) == FILES_MAX:
            raise UsageError(f"more than {FILES_MAX} files are included")
        data = read_bytes(name)
        self._sizes.append(len(data))
        if sum(self._sizes) > LARGEST_FILE:
            raise UsageError("the included files are too large together")
        self.read(decode_text(data, name), name, chain)


# QGroundControl's


def read_qgc(reading: Reading, file_format: FileFormat) -> ParamFile:
    """Read a file of QGroundControl. Columns may be separated by spaces too, as other programs write them.

    Raises:
        FileError: a line does not have five columns, or its value does not fit its type.
    """

    def take(line: TextLine, comment: str) -> None:
        columns = _blanks.split(line.text)
        if len(columns) != 5:  # a name that is empty or has a space
            columns = [each.strip() for each in line.text.split("\t")]
        try:
            if len(columns) != 5:
                raise UsageError("vehicle, component, name, value and type, with tabs between them")
            system, component = _whole(columns[0], 1, 255, _QGC_IDS), _whole(columns[1], 0, 255, _QGC_IDS)
            kind = ParamType(_whole(columns[4], 1, 10, _QGC_TYPE))
            value = _qgc_value(columns[3], kind)
        except UsageError as error:
            reading.bad_line(line, str(error))
            return
        if _has_name(reading, line, columns[2], "a parameter's name in the third column"):
            param = WrittenParam(columns[2], value, kind, comment=comment, line=line.number)
            reading.add(param, f"line {line.number}", system, component)

    return reading.file(file_format, *_read_commented_lines(reading.text, reading, take))


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
    return write_list(qgc_line, sets, replace(around, header=tuple(header)))


def qgc_line(params: ParamSet, param: WrittenParam) -> str:
    """Return the line of a parameter, or raise UsageError if the format cannot express it."""
    if params.system is None:
        raise UsageError("the format needs a system id for each parameter, and the set has none: give it one")
    if not isinstance(param.type, ParamType):
        raise UsageError(f"{param.name} has no type that MAVLink defines, and this format needs one")
    component = AUTOPILOT if params.component is None else params.component
    text = value_text(param)
    if isinstance(param.value, float) and not math.isfinite(param.value):
        text = text.lower().removesuffix("inity")  # Qt's notation
    return f"{params.system}\t{component}\t{check_portable_name(param.name)}\t{text}\t{int(param.type)}"


def _whole(text: str, low: int, high: int, expected: str) -> int:
    number = parse_number(text)
    if not isinstance(number, int) or not low <= number <= high:
        raise UsageError(expected)
    return number


def _qgc_value(text: str, kind: ParamType) -> Value:
    number = math.nan if _qgc_nan(text) else parse_number(text)
    if number is None:
        raise UsageError(f"a number{' with a decimal point' * (',' in text)} in the fourth column")
    try:
        return as_type(number, kind)
    except UsageError as error:
        raise UsageError(f"a value that its type can hold ({error})") from None


# Both


def write_list(
    line_of: Callable[[ParamSet, WrittenParam], str], sets: Sequence[ParamSet], around: ParamFile
) -> Iterator[str]:
    """Generate the lines of a file, so that reading it gives the same header, comments and footer.

    Args:
        line_of: returns the line of a parameter, or raises UsageError.
        sets: the parameters.
        around: for header and footer.
    """
    yield from comment_lines(around.header)
    rows = ((params, param) for params in sets for param in params.values())
    for place, (params, param) in enumerate(rows):
        if param.comment:
            if place == 0:
                yield ""
            yield from comment_lines([param.comment])
        yield line_of(params, param)
    yield from comment_lines(around.footer)


def _has_name(reading: Reading, line: TextLine, name: str, expected: str, source: str = "") -> bool:
    """Return whether a vehicle can have the name in a line; else add the line."""
    try:
        check_portable_name(name)
    except UsageError as error:
        reading.bad_line(line, f"{expected} ({error})", source)
        reading.overlong_count += len(name) > NAME_LENGTH and bool(re.fullmatch("[A-Z0-9_]+", name))
        return False
    return True


def _read_commented_lines(text: str, reading: Reading, take: Callable[[TextLine, str], None]) -> Comments:
    """Call `take` for each line with content, with its comments; return header and footer.

    The header is the comments above the first parameter, up to the last empty line if there is one.
    """
    header: list[str] | None = None
    waiting: list[str] = []
    at_top = True
    for line in lines_of(text):
        if line.is_foreign:
            reading.foreign.append(f"line {line.number}")
        if line.text:
            if at_top and header is None:
                header, waiting = waiting, []
            at_top = False
            if line.comment:
                waiting.append(line.comment)
            take(line, "\n".join(waiting))
            waiting = []
        elif line.comment is not None:
            waiting.append(line.comment)
        elif at_top:
            header, waiting = [*(header or []), *waiting], []
    return tuple(header or []), tuple(waiting)
