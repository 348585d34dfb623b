"""Text of parameter files: encoding, lines, comments, numbers, and the list of bad lines."""

from __future__ import annotations

import codecs
import math
import re
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Final, NamedTuple

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import TooManyParams
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, WireValue, bits_of, format_value, from_bits, type_name

__all__ = [
    "Builder",
    "TextLine",
    "Problems",
    "as_type",
    "comment_lines",
    "decode_text",
    "excerpt",
    "is_plain",
    "lines_of",
    "parse_number",
    "time_of",
    "value_text",
]

PROBLEMS_MAX: Final = 20
"""Bad lines that an error lists: in a file of another kind, every line is bad."""
EXCERPT_LENGTH_MAX: Final = 80
"""Characters of a bad line that an error shows, so that the error stays readable."""
NUMBER_LENGTH_MAX: Final = 400
"""Characters of a number: the longest decimal form of a double without padding has fewer."""

_BOMS: Final = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_line_end: Final = re.compile(r"\r\n|\n|\r")
_whole: Final = re.compile(r"[+-]?[0-9]+").fullmatch
_hexadecimal: Final = re.compile(r"0[xX][0-9a-fA-F]+").fullmatch
_fraction: Final = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?").fullmatch
_nan_or_infinity: Final = re.compile(r"([+-]?)(?:(nan)|inf(?:inity)?)", re.IGNORECASE).fullmatch
_comment_start: Final = re.compile(r"(?<![0-9]\.)#|#(?!INF|IND|[QS]?NAN)|(?:(?<=[ \t])|^)(?://|;)")
"""Start of a comment in a parameter list: no name or value can begin with `//` or `;`. The `#` of `1.#INF`
and `-1.#IND`, which older C libraries of Windows print for infinity and NaN, does not start a comment."""
_control: Final = re.compile(r"[\x00-\x08\x0e-\x1f\x7f]")
_PLAIN_NAN: Final = struct.pack("<d", math.nan)


class TextLine(NamedTuple):
    """One line: its content, and its comment without the comment character (None without a comment)."""

    number: int
    text: str
    comment: str | None


@dataclass(slots=True)
class Problems:
    """The bad lines of a file, collected for one error.

    Args:
        source: the file's name.
    """

    source: str
    count: int = 0
    _found: list[tuple[int | None, str, str | None]] = field(default_factory=list)

    @property
    def is_full(self) -> bool:
        """Whether further problems are only counted: in a file of another kind, every line is bad."""
        return self.count >= PROBLEMS_MAX

    def add(self, line: int | None, problem: str, expected: str | None = None) -> None:
        """Add a problem.

        Args:
            line: the bad line; None for an unknown one.
            problem: the problem, as the end of a sentence.
            expected: the expected content of the line, if it has a description.
        """
        if not self.is_full:
            self._found.append((line, problem, expected))
        self.count += 1

    def add_line(self, line: TextLine, expected: str) -> None:
        """Add a bad line."""
        self.add(line.number, f"expected {expected}, found {excerpt(line.text)}", expected)

    def raise_if_any(self) -> None:
        """Raise one FileError for all problems, if there are any."""
        if not self._found:
            return
        more = [": ".join(filter(None, (self._place(line), what))) for line, what, _ in self._found[1:]]
        if self.count > len(self._found):
            more.append(f"and {self.count - len(self._found)} more")
        line, what, expected = self._found[0]
        raise FileError(what, source=self.source, line=line, expected=expected, more=tuple(more))

    def _place(self, line: int | None) -> str:
        if line is None:
            return self.source
        return f"{self.source}:{line}" if self.source else f"line {line}"


@dataclass(slots=True)
class Builder:
    """Collects the parameters of a file into sets, one per component.

    If a name occurs twice, the last value is used, as in ground stations and autopilots, which set one value
    after the other. A note reports the repetition.

    Args:
        source: the file's name.
        params_max: maximum number of parameters, repeated ones counted each time; None for any.
    """

    source: str
    params_max: int | None = None
    notes: list[str] = field(default_factory=list)
    _sets: dict[tuple[int | None, int | None], dict[str, WrittenParam]] = field(default_factory=dict)
    _places: dict[tuple[int | None, int | None, str], str] = field(default_factory=dict)
    _count: int = 0
    _repeated: int = 0

    def add(
        self, param: WrittenParam, place: str, *, system: int | None = None, component: int | None = None
    ) -> None:
        """Add a parameter; it replaces an earlier one with the same name.

        Args:
            param: the parameter.
            place: its position, for notes.
            system, component: the ids of the set.

        Raises:
            TooManyParams: the file has more parameters than `params_max`.
        """
        self._count += 1
        TooManyParams.check(self._count, self.params_max, self.source)
        params = self._sets.setdefault((system, component), {})
        before = params.get(param.name)
        params[param.name] = param
        key = (system, component, param.name)
        if before is not None:
            self._note_repeated(param, place, before, self._places[key])
        self._places[key] = place

    def result(self) -> tuple[ParamSet, ...]:
        """Return the sets.

        Raises:
            FileError: the file has no parameters.
        """
        if not self._sets:
            raise FileError("the file contains no parameters", source=self.source)
        if self._repeated > PROBLEMS_MAX:
            more = self._repeated - PROBLEMS_MAX
            self.notes.append(f"{more} more {'line repeats' if more == 1 else 'lines repeat'} a name.")
        return tuple(
            ParamSet(params, component, system, source=self.source)
            for (system, component), params in self._sets.items()
        )

    def _note_repeated(self, param: WrittenParam, place: str, other: WrittenParam, elsewhere: str) -> None:
        self._repeated += 1
        if self._repeated > PROBLEMS_MAX:
            return
        if _same(other, param):
            self.notes.append(f"{param.name} occurs twice with the same value, in {elsewhere} and {place}.")
        else:
            used, ignored = f"{_value_and_type(param)} in {place}", f"{_value_and_type(other)} in {elsewhere}"
            self.notes.append(f"{param.name} occurs twice: {used} is used, not {ignored}.")


def decode_text(data: bytes, source: str) -> str:
    """Return the text of a file: UTF-8, or UTF-16 with a byte order mark.

    Raises:
        FileError: the file has another encoding, or is not text.
    """
    encoding = "utf-8"
    for mark, name in _BOMS:
        if data.startswith(mark):
            data, encoding = data[len(mark) :], name
            break
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise FileError(
            f"expected {encoding.upper()} text, found the byte 0x{data[error.start]:02x}",
            source=source,
            line=line,
            expected=f"{encoding.upper()} text",
        ) from None
    if control := _control.search(text):
        line = text.count("\n", 0, control.start()) + 1
        found = f"the character 0x{ord(control[0]):02x}"
        raise FileError(
            f"expected text, found {found}: unknown file format",
            source=source,
            line=line,
            expected="text",
        )
    return text


def lines_of(text: str) -> Iterator[TextLine]:
    """Generate all lines, empty ones included, with their comments."""
    for number, line in enumerate(_split(text), start=1):
        found = _comment_start.search(line)
        if found is None:
            yield TextLine(number, line.strip(" \t"), None)
        else:
            comment = line[found.end() :].rstrip()
            yield TextLine(number, line[: found.start()].strip(" \t"), comment.removeprefix(" "))


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
    if len(text) > NUMBER_LENGTH_MAX:
        return None
    if _whole(text):
        return int(text)
    if _hexadecimal(text):
        return int(text, 16)
    if _fraction(text):
        value = float(text)
        return value if math.isfinite(value) else None
    if word := _nan_or_infinity(text):
        if word[2]:
            return None if word[1] == "-" else math.nan  # the bits of a negative NaN are not defined
        return -math.inf if word[1] == "-" else math.inf
    return None


def as_type(value: WireValue, kind: ParamType | int) -> WireValue:
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
    if isinstance(value, bytes):
        raw = format_value(value)
        raise UsageError(f"{param.name} is {raw}, which is not a number; json can keep it")
    if isinstance(value, str):
        raise UsageError(f"{param.name} is text, and not a number")
    if isinstance(value, float) and not math.isfinite(value):
        if not is_plain(value):
            raise UsageError(f"{param.name} is a NaN with payload bits; json can keep them")
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return format_value(value, ParamType.REAL64 if param.type_number is None else param.type_number)


def time_of(at: float, digits: str = "auto") -> str:
    """Return a Unix time in ISO 8601, UTC.

    Raises:
        UsageError: the time is outside the range of the calendar.
    """
    try:
        moment = datetime.fromtimestamp(at, UTC)
    except (ArithmeticError, OSError, ValueError):
        raise UsageError(f"{at!r} is not a valid Unix time in seconds") from None
    return moment.isoformat(timespec=digits).replace("+00:00", "Z")


def is_plain(value: float) -> bool:
    """Return whether the value is not a NaN, or is the NaN without payload bits."""
    return not math.isnan(value) or struct.pack("<d", value) == _PLAIN_NAN


def excerpt(text: str) -> str:
    """Return a piece of a file for an error: quoted, and shortened if it is long."""
    return repr(text if len(text) <= EXCERPT_LENGTH_MAX else f"{text[:EXCERPT_LENGTH_MAX]}…")


def _split(text: str) -> Iterator[str]:
    start = 0
    for end in _line_end.finditer(text):
        yield text[start : end.start()]
        start = end.end()
    yield text[start:]


def _value_and_type(param: WrittenParam) -> str:
    kind = "" if param.type_number is None else f" ({type_name(param.type_number)})"
    return format_value(param.settable, ParamType.REAL64) + kind


def _same(a: WrittenParam, b: WrittenParam) -> bool:
    """Return whether two values are equal as written: 1 and 1.0 are, −0.0 and 0.0 are not."""
    if a.type_number != b.type_number or a.is_raw or b.is_raw:
        return a.type_number == b.type_number and a.settable == b.settable
    if not (isinstance(a.value, int | float) and isinstance(b.value, int | float)):
        return a.value == b.value
    if math.isnan(a.value) or math.isnan(b.value):
        return math.isnan(a.value) and math.isnan(b.value)
    return a.value == b.value and math.copysign(1, a.value) == math.copysign(1, b.value)
