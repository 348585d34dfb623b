"""JSON that is parsed value by value, so that other threads run meanwhile.

A JSON parser in C lets no other thread run until it has ended: 5 MB of small values take half a second.
"""

from __future__ import annotations

import re
from typing import Any, Final, cast

from pydantic_core import from_json

__all__ = ["parse_json"]

SEPARATORS_MAX: Final = 200_000
"""Commas and opening brackets of a file, which bound its values and with them its memory, 25 MB. ArduPilot's
files, which describe 4,600 parameters, have 45,000, and PX4's 31,000 for 1,800 parameters."""
DEPTH_MAX: Final = 200
"""Levels of objects and arrays; PX4's file has nine."""
STRING_BYTES_MAX: Final = 524_288
"""Bytes of a string, which is parsed in one call: the texts of one parameter may have 65,536 characters, and
an escaped one takes six bytes."""
SCALAR_BYTES_MAX: Final = 4_300
"""Bytes of a number: as many digits as Python converts."""
FLAT_BYTES_MAX: Final = 4_096
"""Bytes of an object or array without further ones that is parsed in one call, which takes at most 0.1 ms."""


def parse_json(content: bytes) -> object:
    """Parse a JSON document in UTF-8. The last one of equal keys counts; NaN and Infinity are numbers.

    Blocks for about 2 s with the largest document, in which other threads run.

    Raises:
        ValueError: the text is not JSON, or exceeds a limit. The message continues the name of the file.
    """
    separators = 0
    for each in (b",", b"[", b"{"):
        separators += content.count(each)  # one by one: each call blocks other threads
    if separators > SEPARATORS_MAX:
        raise ValueError(f"has more than {SEPARATORS_MAX:,} values")
    return _Parser(content).document()


class _Parser:
    """Parses one document. The position is that of the next byte."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def document(self) -> object:
        """Return the content of the document."""
        found = self._value(0)
        self._skip_space()
        if self._at < len(self._content):
            raise self._error("trailing characters")
        return found

    def _value(self, depth: int) -> object:
        first = self._skip_space()
        if first == b'"':
            return self._string()
        if first not in (b"{", b"["):
            return self._scalar()
        flat = _FLAT.match(self._content, self._at, self._at + FLAT_BYTES_MAX)
        if flat is not None:
            return self._parsed(flat.end())
        if depth >= DEPTH_MAX:
            raise self._error("recursion limit exceeded")
        self._at += 1
        return self._object(depth + 1) if first == b"{" else self._array(depth + 1)

    def _object(self, depth: int) -> dict[str, object]:
        found: dict[str, object] = {}
        if self._skip_space() == b"}":
            self._at += 1
            return found
        while True:
            if self._skip_space() != b'"':
                raise self._error("key must be a string")
            key = self._string()
            if self._skip_space() != b":":
                raise self._error("expected `:`")
            self._at += 1
            found[key] = self._value(depth)
            if self._is_last(b"}"):
                return found

    def _array(self, depth: int) -> list[object]:
        found: list[object] = []
        if self._skip_space() == b"]":
            self._at += 1
            return found
        while True:
            found.append(self._value(depth))
            if self._is_last(b"]"):
                return found

    def _is_last(self, end: bytes) -> bool:
        """Pass a comma, or the end of an object or array; return whether it was the end."""
        found = self._skip_space()
        if found not in (b",", end):
            raise self._error(f"expected `,` or `{end.decode()}`")
        self._at += 1
        return found == end

    def _string(self) -> str:
        content = self._content
        end = content.find(b'"', self._at + 1)
        while end > 0 and content[end - 1] == _BACKSLASH:
            before = end - 1
            while content[before - 1] == _BACKSLASH:  # stops at the quotation mark at the latest
                before -= 1
            if (end - before) % 2 == 0:
                break
            end = content.find(b'"', end + 1)
        if end < 0:
            self._at = len(content)
            raise self._error("EOF while parsing a string")
        if end - self._at > STRING_BYTES_MAX:
            raise self._error(f"a string of more than {STRING_BYTES_MAX:,} bytes")
        return cast(str, self._parsed(end + 1))

    def _scalar(self) -> object:
        found = _SCALAR.match(self._content, self._at, self._at + SCALAR_BYTES_MAX + 1)
        end = self._at if found is None else found.end()
        if end > self._at + SCALAR_BYTES_MAX:
            raise self._error("number out of range")
        if end == self._at:
            raise self._error("expected value")
        return self._parsed(end)

    def _parsed(self, end: int) -> Any:
        """Return the value that ends before this position, and continue there."""
        try:
            found = from_json(self._content[self._at : end])
        except ValueError as error:
            raise self._error(_PLACE.sub("", str(error))) from None
        self._at = end
        return found

    def _skip_space(self) -> bytes:
        """Pass white space; return the next byte, or none at the end."""
        content, at = self._content, self._at
        found = content[at : at + 1]
        if found in _SPACE:
            space = _SPACES.match(content, at)
            assert space is not None
            self._at = at = space.end()
            found = content[at : at + 1]
        return found

    def _error(self, reason: str) -> ValueError:
        content, at = self._content, self._at
        if at >= len(content) and not reason.startswith("EOF"):
            reason = "EOF while parsing a value"
        line, column = content.count(b"\n", 0, at) + 1, at - content.rfind(b"\n", 0, at)
        return ValueError(f"not JSON: {reason} at line {line} column {column}")


_BACKSLASH: Final = ord("\\")
_SPACE: Final = b" \n\r\t"
_SPACES: Final = re.compile(rb"[ \n\r\t]*+")
_FLAT: Final = re.compile(rb'[\[{][^"\[\]{}\\]*+(?:"[^"\\]*+"[^"\[\]{}\\]*+)*+[\]}]')
"""An object or array without further ones, and without escaped characters."""
_SCALAR: Final = re.compile(rb'[^ \n\r\t,:"\[\]{}]*+')
"""A number, true, false or null."""
_PLACE: Final = re.compile(r" at line \d+ column \d+$")
