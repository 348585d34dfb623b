"""JSON documents as files: parsing, the fields of objects, and the line of each fault."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from typing import Any, Final, NoReturn, TypeAlias

from paramclient.errors import FileError, UsageError
from paramclient.files.reading import Reading
from paramclient.files.text import excerpt, undecoded_byte

__all__ = ["Checks", "Document", "Place", "between", "found", "read_json_text", "typed"]

FAULT_LENGTH_MAX: Final = 300
"""Characters of one fault in an error, so that a long field does not make the error unreadable."""

Place: TypeAlias = tuple[str | int, ...]
"""Position in a document: keys and list indices from the top."""
Checks: TypeAlias = Mapping[str, Callable[[Any], Any]]
"""By the name of a field, a function that returns the field's content, or raises UsageError."""


def read_json_text(text: str, source: str) -> Any:
    """Return the content of a JSON text without repeated keys.

    Raises:
        FileError: invalid JSON, or a repeated key.
    """
    if (byte := undecoded_byte(text)) is not None:
        raise FileError(byte[1], source=source, line=text.count("\n", 0, byte[0]) + 1, expected="UTF-8 text")
    try:
        return json.loads(text, object_pairs_hook=_unique, parse_constant=_no_constant)
    except json.JSONDecodeError as error:
        message = f"expected JSON: {error.msg} (column {error.colno})"
        raise FileError(message, source=source, line=error.lineno, expected="JSON") from None
    except RecursionError:
        raise FileError("the document is nested too deep", source=source) from None
    except ValueError as error:
        line = _line_of(text, error.args[1], last=True) if len(error.args) > 1 else None
        raise FileError(str(error.args[0]), source=source, line=line) from None


class Document:
    """One document while it is read; its faults are those of the file."""

    def __init__(self, reading: Reading) -> None:
        self.reading = reading

    def fault(self, place: Place, what: str, *, is_name: bool = False) -> None:
        """Add a fault at a position of the document."""
        line = None
        if "params" in place[:-1] and not self.reading.is_full:
            line = _line_of(self.reading.text, str(place[place.index("params") + 1]))
        described = f"{'.'.join(map(str, place)) or 'the document'}: {what}"
        if len(described) > FAULT_LENGTH_MAX:
            described = f"{described[:FAULT_LENGTH_MAX]}…"
        self.reading.fault(line, described, is_name=is_name)

    def fields(
        self, content: object, place: Place, checks: Checks, required: AbstractSet[str]
    ) -> dict[str, Any]:
        """Return the valid fields of an object without nulls; add a fault for each other field."""
        if not isinstance(content, dict):
            self.fault(place, f"it should be an object{found(content)}")
            return {}
        valid = {}
        for key, each in content.items():
            if key not in checks:
                self.fault((*place, key), "unknown field")
            elif each is not None or key in required:
                try:
                    valid[key] = checks[key](each)
                except UsageError as error:
                    self.fault((*place, key), str(error))
        for key in sorted(required - content.keys()):
            self.fault((*place, key), "the field is missing")
        return valid


def found(content: object) -> str:
    """Return the end of a fault that shows a wrong value; "" for an object or a list."""
    return "" if isinstance(content, dict | list) else f", found {content!r}"


def typed(kind: type, words: str) -> Callable[[Any], Any]:
    """Return the check of a field of one type."""

    def check(content: Any) -> Any:
        if not isinstance(content, kind) or isinstance(content, bool):
            raise UsageError(f"it should be {words}{found(content)}")
        return content

    return check


def between(low: int, high: float, words: str) -> Callable[[Any], Any]:
    """Return the check of a whole number."""
    whole = typed(int, words)

    def check(content: Any) -> Any:
        if not low <= whole(content) <= high:
            raise UsageError(f"it should be {words}{found(content)}")
        return content

    return check


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"{excerpt(key)} occurs twice", key)
        content[key] = value
    return content


def _no_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is not valid JSON; write it as text: {json.dumps(word)}")


def _line_of(text: str, key: str, *, last: bool = False) -> int | None:
    """Return the line of a key, if the key occurs once or the last occurrence is meant."""
    places = [match.start() for match in re.finditer(rf'"{re.escape(key)}"[ \t]*:', text)]
    return text.count("\n", 0, places[-1]) + 1 if places and (last or len(places) == 1) else None
