"""Text of parameter files: encoding, lines, comments and numbers."""

from __future__ import annotations

import codecs
import math
import re
import struct
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import Final, NamedTuple

from paramclient.errors import FileError, UsageError
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import ParamType, WireValue, bits_of, format_value, from_bits

__all__ = [
    "TextLine",
    "as_type",
    "comment_lines",
    "decode_text",
    "excerpt",
    "is_plain",
    "lines_of",
    "parse_number",
    "time_of",
    "undecoded_byte",
    "value_text",
]

EXCERPT_LENGTH_MAX: Final = 80
"""Characters of a bad line that an error shows, so that the error stays readable."""
NUMBER_LENGTH_MAX: Final = 400
"""Characters of a number: the longest decimal form of a double without padding has fewer."""

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
_undecoded: Final = re.compile(r"[\udc80-\udcff]")
"""A byte that is not UTF-8, as `decode_text` returns it."""
_PLAIN_NAN: Final = struct.pack("<d", math.nan)


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
    is_utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = data.decode("utf-16") if is_utf16 else data.decode("utf-8-sig", "surrogateescape")
    except UnicodeDecodeError as error:
        found = f"the byte 0x{data[error.start]:02x}"
        raise FileError(f"expected UTF-16 text, found {found}", source=source, expected="text") from None
    if control := _control.search(text):
        line = text.count("\n", 0, control.start()) + 1
        found = f"the character 0x{ord(control[0]):02x}"
        message = f"expected text, found {found}: unknown file format"
        raise FileError(message, source=source, line=line, expected="text")
    return text


def undecoded_byte(text: str) -> tuple[int, str] | None:
    """Return the position of the first byte that is not UTF-8, and a sentence on it; None if all are."""
    if found := _undecoded.search(text):
        return found.start(), f"expected UTF-8 text, found the byte 0x{ord(found[0]) - 0xDC00:02x}"
    return None


def lines_of(text: str) -> Iterator[TextLine]:
    """Generate all lines, empty ones included, with their comments."""
    start = 0
    for number, end in enumerate((*_line_end.finditer(text), None), start=1):
        line = text[start:] if end is None else text[start : end.start()]
        start = 0 if end is None else end.end()
        found = _comment_start.search(line)
        if found is None:
            yield TextLine(number, line.strip(" \t"), None)
            continue
        comment = line[found.end() :].rstrip().removeprefix(" ")
        known = _undecoded.sub(_from_windows, comment)
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
    if found.lastgroup in ("whole", "hexadecimal"):
        return int(text, 10 if found.lastgroup == "whole" else 16)
    value = float(text)
    return value if found.lastgroup == "word" or math.isfinite(value) else None


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
    if isinstance(value, bytes | str):
        raw = format_value(value)
        raise UsageError(f"{param.name} is {raw}, which is not a number; json can keep it")
    if math.isfinite(value):
        return format_value(value, ParamType.REAL64 if param.type_number is None else param.type_number)
    if not is_plain(value):
        raise UsageError(f"{param.name} is a NaN with payload bits; json can keep them")
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


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


def _from_windows(byte: re.Match[str]) -> str:
    return bytes((ord(byte[0]) - 0xDC00,)).decode("cp1252", "replace")
