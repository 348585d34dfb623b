"""One file while it is read, and its text: lines, comments, numbers, notes and faults."""

from __future__ import annotations

import codecs
import math
import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final, NamedTuple

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import FileFormat, ParamFile, address
from paramclient.model.names import counted, first_of
from paramclient.model.notation import value_written
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, Value, bits_of, format_value, from_bits

FAULTS_MAX: Final = 20
"""Bad lines that an error lists: in a file of another kind, every line is bad."""
EXCERPT_LENGTH_MAX: Final = 80
"""Characters of a bad line that an error shows, so that the error stays readable."""
NUMBER_LENGTH_MAX: Final = 400
"""Characters of a number: the longest decimal form of a double without padding has fewer."""
UTF16_MARKS: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
"""The byte order marks with which a text in UTF-16 begins."""

_line_end: Final = re.compile(r"\r\n|\n|\r")
_number: Final = re.compile(
    r"(?P<whole>[+-]?[0-9]+)|(?P<hexadecimal>0x[0-9a-f]+)"
    r"|(?P<fraction>[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?)"
    r"|(?P<word>\+?nan|[+-]?inf(?:inity)?)",  # the bits of a negative NaN are not defined
    re.IGNORECASE | re.ASCII,
).fullmatch
_comment_start: Final = re.compile(r"(?<![0-9]\.)#|#(?!INF|IND|[QS]?NAN)|(?:(?<=[ \t])|^)(?://|;)")
"""Start of a comment in a parameter list: no name or value can begin with `//` or `;`. The `#` of `1.#INF`
and `-1.#IND`, which older C libraries of Windows print for infinity and NaN, does not start a comment."""
_control: Final = re.compile(r"[\x00-\x08\x0e-\x1f\x7f]")
_control_before_comment: Final = re.compile(rf"^[^#\n]*?({_control.pattern})", re.MULTILINE)
_undecoded: Final = re.compile(r"[\udc80-\udcff]")
"""A byte that is not UTF-8, as `decode_text` returns it."""
_PLAIN_NAN: Final = struct.pack("<d", math.nan)


class Reading:
    """One file while it is read, with the files that it includes.

    If a name occurs twice, the last value is used, as in ground stations and autopilots, which set one value
    after the other. A note reports the repetition.

    Args:
        data: the content.
        source: the file's name.
        partial: leave out parameters that cannot be taken, with a note; else no parameter is taken.
        is_on_disk: whether the file can include others: bytes have no folder.
    """

    def __init__(self, data: bytes, source: str, *, partial: bool = False, is_on_disk: bool = False) -> None:
        self.data = data
        self.source = source
        self.is_on_disk = is_on_disk
        self.partial = partial
        self.fault_count = 0
        self.overlong_count = 0  # of these, for names that are too long for any vehicle
        self.notes: list[str] = []
        self._faults: list[tuple[str, int | None, str]] = []
        self._is_damaged = False  # by a fault that is not of one parameter
        self._sets: dict[tuple[int | None, int | None], dict[str, tuple[WrittenParam, str]]] = {}
        self._repeated = 0
        self.foreign: list[str] = []  # places of comments that are not UTF-8

    @cached_property
    def text(self) -> str:
        """The content as text; FileError if it is none."""
        return decode_text(self.data, self.source)

    @cached_property
    def first(self) -> str:
        """The first line with content, without comments; FileError if there is none."""
        if self.text.lstrip().startswith("{"):  # it may be one line of megabytes, with `#` in its texts
            return "{"
        first = next((line.text for line in lines_of(self.text) if line.text), None)
        if first is None:
            raise FileError("the file contains no parameters", source=self.source)
        return first

    def fault(self, line: int | None, what: str, source: str = "", *, is_row: bool = False) -> None:
        """Add a fault.

        Args:
            line: the bad line; None for an unknown one.
            what: the fault, as the end of a sentence.
            source: the file, if it is another one.
            is_row: whether only one parameter is bad.
        """
        if self.fault_count < FAULTS_MAX:
            self._faults.append((source or self.source, line, what))
        self.fault_count += 1
        self._is_damaged |= not is_row

    def bad_line(self, line: TextLine, expected: str, source: str = "", *, is_row: bool = True) -> None:
        """Add a line that has other content than expected."""
        what = f"expected {expected}, found {excerpt(line.text)}"
        if byte := _undecoded.search(line.text):
            what = f"expected UTF-8 text, found the byte 0x{ord(byte[0]) - 0xDC00:02x}"
        self.fault(line.number, what, source, is_row=is_row)

    def add(
        self, param: WrittenParam, place: str, system: int | None = None, component: int | None = None
    ) -> None:
        """Add a parameter of a component; it replaces an earlier one with the same name.

        Args:
            param: the parameter.
            place: its position, for notes.
            system, component: the ids of the set.
        """
        params = self._sets.setdefault((system, component), {})
        if param.name in params:
            self._repeated += 1
            if self._repeated <= FAULTS_MAX:
                self.notes.append(_repetition(*params[param.name], param, place))
        params[param.name] = param, place

    def file(
        self,
        file_format: FileFormat,
        header: tuple[str, ...] = (),
        footer: tuple[str, ...] = (),
        sets: tuple[ParamSet, ...] | None = None,
    ) -> ParamFile:
        """Return the content: the added parameters, or `sets`.

        Raises:
            FileError: the file has faults, all of which the error has, or no parameters.
        """
        found = sets or tuple(
            ParamSet({name: p for name, (p, _) in each.items()}, component, system, source=self.source)
            for (system, component), each in self._sets.items()
        )
        is_refused = self._is_damaged or not self.partial or not any(found)
        own = "" if is_refused else self.source  # which stands before each note
        faults = [FileError(what, source="" if of == own else of, line=at) for of, at, what in self._faults]
        told = [*map(str, faults)]
        if (more := self.fault_count - len(told)) > 0:
            told.append(f"and {more} more")
        if told and is_refused:
            first = faults[0]
            raise FileError(first.reason, source=first.source, line=first.line, more=tuple(told[1:]))
        if not any(found):
            raise FileError("the file contains no parameters", source=self.source)
        self.notes += [f"{each}; left out." for each in told]
        unread = f"without {counted(self.fault_count, 'parameter')} that cannot be read" if told else ""

        def lacks_of(each: ParamSet) -> str:
            begin = lacks_begin(each, found)
            known = [line.removeprefix(begin) for line in header if line.startswith(begin)]
            return "; ".join(filter(None, (each.lacks, *known, unread)))

        sets = tuple(replace(each, lacks=lacks_of(each)) for each in found)
        if (more := self._repeated - FAULTS_MAX) > 0:
            self.notes.append(f"{more} more {'line repeats' if more == 1 else 'lines repeat'} a name.")
        if self.foreign:
            places = first_of(self.foreign, FAULTS_MAX)
            self.notes.append(f"Comments that are not UTF-8 were read as Windows-1252: {places}.")
        count = self.fault_count - self.overlong_count
        return ParamFile(sets, file_format, self.source, header, footer, tuple(self.notes), count)


def lacks_begin(params: ParamSet, sets: Sequence[ParamSet]) -> str:
    """Return the begin of the line with `ParamSet.lacks` of one of a list's sets, in its header."""
    return "incomplete: " if len(sets) == 1 else f"incomplete: {address(params)}: "


def _repetition(before: WrittenParam, at: str, param: WrittenParam, place: str) -> str:
    """Return the note on a name that occurs twice. 1 and 1.0 are the same value, −0.0 and 0.0 are not."""
    ignored, used = (
        format_value(each.settable, ParamType.REAL64) + ("" if each.type is None else f" ({each.type.name})")
        for each in (before, param)
    )
    if (before.value, before.type, ignored[0]) == (param.value, param.type, used[0]) or ignored == used:
        return f"{param.name} occurs twice with the same value, in {at} and {place}."
    return f"{param.name} occurs twice: {used} in {place} is used, not {ignored} in {at}."


# Text


class TextLine(NamedTuple):
    """One line: its content, and its comment without the comment character (None without a comment).

    `is_foreign` is true for a comment that is not UTF-8; it is read as Windows-1252.
    """

    number: int
    text: str
    comment: str | None
    is_foreign: bool = False


def decode_text(data: bytes, source: str) -> str:
    """Return the text of a file: UTF-8, or UTF-16 with a byte order mark.

    A byte that is not UTF-8 becomes a lone surrogate (PEP 383), as it is harmless in a comment.

    Raises:
        FileError: the file is not text.
    """
    is_utf16 = data.startswith(UTF16_MARKS)
    try:
        text = data.decode("utf-16") if is_utf16 else data.decode("utf-8-sig", "surrogateescape")
    except UnicodeDecodeError as error:
        message = f"expected UTF-16 text, found the byte 0x{data[error.start]:02x}"
        raise FileError(message, source=source) from None
    if control := _control_before_comment.search(text):
        line = text.count("\n", 0, control.start(1)) + 1
        message = f"expected text, found the character 0x{ord(control[1]):02x}: unknown file format"
        raise FileError(message, source=source, line=line)
    return text


def lines_of(text: str) -> Iterator[TextLine]:
    """Generate all lines, empty ones included, with their comments."""
    for number, line in enumerate(_line_end.split(text), start=1):
        found = _comment_start.search(line)
        if found is None:
            yield TextLine(number, line.strip(" \t"), None)
            continue
        comment = line[found.end() :].rstrip().removeprefix(" ")
        known = decoded(comment)
        yield TextLine(number, line[: found.start()].strip(" \t"), known, known != comment)


def comment_lines(comments: Iterable[str]) -> Iterator[str]:
    """Generate the lines of comments, with comment characters. A line break starts another comment line."""
    for comment in comments:
        for piece in comment.split("\n"):
            for line in piece.splitlines() or [""]:
                clean = _control.sub(" ", line).rstrip()
                yield f"# {clean}" if clean and not clean.startswith("#") else f"#{clean}"


def parse_number(text: str) -> int | float | None:
    """Return a number in the notation of parameter files, or None: decimal, hexadecimal (`0x1F`), nan, inf.

    A number without point and exponent is an int, all others are floats. Decimal commas, units, non-ASCII
    digits and numbers beyond the range of a double give None.
    """
    found = _number(text) if len(text) <= NUMBER_LENGTH_MAX else None
    if found is None:
        return None
    if found.lastgroup == "word":
        return float(text)
    base = {"whole": 10, "hexadecimal": 16}.get(found.lastgroup or "")
    value = float(text) if base is None else int(text, base)
    return value if abs(value) < 2**1024 else None


def as_type(value: Value, kind: ParamType | int) -> Value:
    """Return the value in a parameter's type: a float32 for REAL32, an int for 6.0 as INT32.

    Raises:
        UsageError: the value does not fit.
    """
    return value if isinstance(value, bytes) else from_bits(bits_of(value, kind), kind)


def value_text(param: WrittenParam) -> str:
    """Return the shortest number that parses to the same value.

    Raises:
        UsageError: no text expresses the value: raw bytes, or a NaN with payload bits.
    """
    value = param.settable
    if isinstance(value, bytes | str):
        raise UsageError(f"{param.name} is {format_value(value)}, which is not a number; json can keep it")
    if not is_plain(value):
        raise UsageError(f"{param.name} is a NaN with payload bits; json can keep them")
    return str(value_written(value, param))


def is_plain(value: float) -> bool:
    """Return whether the value is not a NaN, or is the NaN without payload bits."""
    return not math.isnan(value) or struct.pack("<d", value) == _PLAIN_NAN


def excerpt(text: str) -> str:
    """Return a piece of a file for an error: quoted, and shortened if it is long."""
    return repr(text if len(text) <= EXCERPT_LENGTH_MAX else f"{text[:EXCERPT_LENGTH_MAX]}…")


def decoded(text: str) -> str:
    """Return text in which bytes that are not UTF-8 are read as Windows-1252."""
    return _undecoded.sub(lambda byte: bytes((ord(byte[0]) - 0xDC00,)).decode("cp1252", "replace"), text)
