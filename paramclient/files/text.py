"""Text of a file: its encoding, lines, comments and numbers, and what is wrong with them."""

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
from paramclient.files.param_file import TooManyParams
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, Value, bits_of, format_value, from_bits, type_name

__all__ = [
    "ANY_MARK",
    "Builder",
    "Line",
    "Problems",
    "as_type",
    "comment_lines",
    "decode_text",
    "is_plain",
    "lines_of",
    "parse_number",
    "shown",
    "time_of",
    "value_text",
]

MOST_PROBLEMS: Final = 20
"""Bad lines that an error lists; a file of another kind has nothing but such lines."""
MOST_SHOWN: Final = 80
"""Characters of a bad line that an error shows."""
LONGEST_NUMBER: Final = 400
"""Characters of a number: the longest decimal form of a double that is not padded has fewer."""

_BOMS: Final = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_line_end: Final = re.compile(r"\r\n|\n|\r")
_whole: Final = re.compile(r"[+-]?[0-9]+").fullmatch
_hexadecimal: Final = re.compile(r"0[xX][0-9a-fA-F]+").fullmatch
_fraction: Final = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?").fullmatch
_word: Final = re.compile(r"([+-]?)(?:(nan)|inf(?:inity)?)", re.IGNORECASE).fullmatch
ANY_MARK: Final = re.compile(r"(?<![0-9]\.)#|#(?!INF|IND|[QS]?NAN)|(?:(?<=[ \t])|^)(?://|;)")
"""What begins a comment in a list of parameters: nothing in these can begin with `//` or `;`. The `#` of
`1.#INF` and `-1.#IND`, which older C libraries of Windows print for what is no number, begins none."""
_control: Final = re.compile(r"[\x00-\x08\x0e-\x1f\x7f]")
_PLAIN_NAN: Final = struct.pack("<d", math.nan)


class Line(NamedTuple):
    """One line: what it says, and its comment without the mark (None for a line without one)."""

    number: int
    text: str
    comment: str | None


@dataclass(slots=True)
class Problems:
    """What is wrong with a file, collected so that all of it is told at once.

    Args:
        source: the file's name.
    """

    source: str
    found: list[tuple[int, str, str]] = field(default_factory=list)
    count: int = 0

    def add(self, line: int, expected: str, found: str) -> None:
        """A line that is not what was expected. Few are kept, as in a file of another kind all are so."""
        self.count += 1
        if self.count <= MOST_PROBLEMS:
            self.found.append((line, expected, found))

    def raise_if_any(self) -> None:
        """Raise one FileError for all of it, if there is anything."""
        if not self.found:
            return
        place = f"{self.source}:" if self.source else "line "
        more = [
            f"{place}{line}: expected {expected}, found {found}" for line, expected, found in self.found[1:]
        ]
        if self.count > MOST_PROBLEMS:
            more.append(f"and {self.count - MOST_PROBLEMS} more bad lines")
        line, expected, found = self.found[0]
        raise FileError(
            f"expected {expected}, found {found}",
            source=self.source,
            line=line,
            expected=expected,
            more=tuple(more),
        )


@dataclass(slots=True)
class Builder:
    """Gathers the parameters of a file into sets, one for each component.

    Of a name that comes twice the last value counts, as it does for ground stations and autopilots, which set
    one after the other. A note tells.

    Args:
        problems: what is wrong with the file.
        params_max: parameters that the file may hold, repeated ones counted each time; None for any number.
    """

    problems: Problems
    params_max: int | None = None
    sets: dict[tuple[int | None, int | None], dict[str, WrittenParam]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    repeated: int = 0
    count: int = 0
    _places: dict[tuple[int | None, int | None, str], str] = field(default_factory=dict)

    def add(
        self,
        param: WrittenParam,
        *,
        system: int | None = None,
        component: int | None = None,
        place: str = "",
    ) -> None:
        """Take a parameter in, in the place of one that has its name.

        Args:
            param: the parameter.
            system, component: whose it is.
            place: where it stands, in words; "" for its line.

        Raises:
            TooManyParams: the file holds more than it may.
        """
        self.count += 1
        TooManyParams.check(self.count, self.params_max, self.problems.source)
        params = self.sets.setdefault((system, component), {})
        before = params.get(param.name)
        params[param.name] = param
        key = (system, component, param.name)
        place = place or f"line {param.line}"
        if before is not None:
            self.note_repeated(param, place, before, self._places[key])
        self._places[key] = place

    def place_of(self, name: str) -> str:
        """Where the value stands that counts, for a file that names no components."""
        return self._places[None, None, name]

    def note_repeated(self, param: WrittenParam, place: str, other: WrittenParam, elsewhere: str) -> None:
        """Tell that a name comes twice, and which value counts."""
        self.repeated += 1
        if self.repeated > MOST_PROBLEMS:
            return
        if _same(other, param):
            self.notes.append(f"{param.name} stands with one value in {elsewhere} and {place}.")
        else:
            counts, not_this = f"{_told(param)} in {place}", f"{_told(other)} in {elsewhere}"
            self.notes.append(f"{param.name} stands twice: {counts} counts, not {not_this}.")

    def result(self) -> tuple[ParamSet, ...]:
        """The sets.

        Raises:
            FileError: something is wrong with the file, or there is nothing in it.
        """
        self.problems.raise_if_any()
        if not self.sets:
            raise FileError("the file holds no parameter", source=self.problems.source)
        if self.repeated > MOST_PROBLEMS:
            more = self.repeated - MOST_PROBLEMS
            self.notes.append(f"{more} more {'line repeats' if more == 1 else 'lines repeat'} a name.")
        return tuple(
            ParamSet(params, component, system, source=self.problems.source)
            for (system, component), params in self.sets.items()
        )


def decode_text(data: bytes, source: str) -> str:
    """The text of a file: UTF-8, or UTF-16 where a byte order mark says so.

    Raises:
        FileError: it is in another encoding, or not text.
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
            f"expected text, found {found}: no parameter file of a known form",
            source=source,
            line=line,
            expected="text",
        )
    return text


def lines_of(text: str, mark: re.Pattern[str] = ANY_MARK) -> Iterator[Line]:
    """All lines, also the empty ones, with the comments that this mark begins."""
    for number, line in enumerate(_split(text), start=1):
        found = mark.search(line)
        if found is None:
            yield Line(number, line.strip(" \t"), None)
        else:
            comment = line[found.end() :].rstrip()
            yield Line(number, line[: found.start()].strip(" \t"), comment.removeprefix(" "))


def comment_lines(comments: Iterable[str]) -> Iterator[str]:
    """The same as lines of a file, with their marks. What breaks a line begins another comment."""
    for comment in comments:
        for piece in comment.split("\n"):
            for line in piece.splitlines() or [""]:
                clean = _control.sub(" ", line).rstrip()
                yield f"# {clean}" if clean and not clean.startswith("#") else f"#{clean}"


def parse_number(text: str) -> int | float | None:
    """A number as the forms write it, or None: decimal, hexadecimal (`0x1F`), nan, inf.

    A number without point and exponent is an int, all others are floats. A decimal comma, units, digits of
    other scripts and numbers beyond the range of a double are no numbers.
    """
    if len(text) > LONGEST_NUMBER:
        return None
    if _whole(text):
        return int(text)
    if _hexadecimal(text):
        return int(text, 16)
    if _fraction(text):
        value = float(text)
        return value if math.isfinite(value) else None
    if word := _word(text):
        if word[2]:
            return None if word[1] == "-" else math.nan  # which bits a negative one has, nobody says
        return -math.inf if word[1] == "-" else math.inf
    return None


def as_type(value: Value, kind: ParamType | int) -> Value:
    """The value as a parameter of this type holds it: a float32 for REAL32, an int for 6.0 as INT32.

    Raises:
        UsageError: it does not fit.
    """
    return value if isinstance(value, bytes) else from_bits(bits_of(value, kind), kind)


def value_text(param: WrittenParam) -> str:
    """The shortest number that reads back as the same value.

    Raises:
        UsageError: no text says this value: raw bytes, or a NaN that is not the plain one.
    """
    value = param.value
    if isinstance(value, bytes):
        shown_value = format_value(value)
        raise UsageError(f"{param.name} is {shown_value}, which is no number; json and yaml can keep it")
    if isinstance(value, float) and not math.isfinite(value):
        if not is_plain(value):
            raise UsageError(f"{param.name} is a NaN with bits of its own; json and yaml can keep them")
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return format_value(value, ParamType.REAL64 if param.type is None else param.type)


def time_of(at: float, digits: str = "auto") -> str:
    """A unix time in ISO 8601, UTC.

    Raises:
        UsageError: no calendar has it.
    """
    try:
        moment = datetime.fromtimestamp(at, UTC)
    except (ArithmeticError, OSError, ValueError):
        raise UsageError(f"{at!r} is no time in unix seconds") from None
    return moment.isoformat(timespec=digits).replace("+00:00", "Z")


def is_plain(value: float) -> bool:
    """Whether the value is no NaN, or the one that the word stands for."""
    return not math.isnan(value) or struct.pack("<d", value) == _PLAIN_NAN


def shown(text: str) -> str:
    """A piece of a file as an error shows it: quoted, and not all of a long one."""
    return repr(text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}…")


def _split(text: str) -> Iterator[str]:
    start = 0
    for end in _line_end.finditer(text):
        yield text[start : end.start()]
        start = end.end()
    yield text[start:]


def _told(param: WrittenParam) -> str:
    kind = "" if param.type is None else f" ({type_name(param.type)})"
    return format_value(param.value, ParamType.REAL64) + kind


def _same(a: WrittenParam, b: WrittenParam) -> bool:
    """Whether both say the same. 1 and 1.0 do, −0.0 and 0.0 do not."""
    if a.type != b.type or isinstance(a.value, bytes) or isinstance(b.value, bytes):
        return a.type == b.type and a.value == b.value
    if math.isnan(a.value) or math.isnan(b.value):
        return math.isnan(a.value) and math.isnan(b.value)
    return a.value == b.value and math.copysign(1, a.value) == math.copysign(1, b.value)
