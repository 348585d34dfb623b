"""JSON documents as files of parameters: parsing, fields, and the line of each problem."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from typing import Any, Final, NoReturn, TypeAlias

from paramclient.errors import FileError, UsageError
from paramclient.files.text import Problems, excerpt

__all__ = ["Checks", "Place", "Reader", "between", "found", "read_json_text", "typed"]

PROBLEM_LENGTH_MAX: Final = 300
"""Characters of one problem in an error, so that a long field does not make the error unreadable."""

Place: TypeAlias = tuple[str | int, ...]
"""Position in a document: keys and list indices from the top."""
Checks: TypeAlias = Mapping[str, Callable[[Any], Any]]
"""By the name of a field, a function that returns the field's content, or raises UsageError."""


def read_json_text(text: str, source: str) -> object:
    """Return the content of a JSON text without repeated keys.

    Raises:
        FileError: invalid JSON, or a repeated key.
    """
    try:
        content: object = json.loads(
            text,
            object_pairs_hook=_unique,
            parse_constant=_no_constant,
            parse_float=_finite,
            parse_int=_whole,
        )
    except json.JSONDecodeError as error:
        raise FileError(
            f"expected JSON: {error.msg} (column {error.colno})",
            source=source,
            line=error.lineno,
            expected="JSON",
        ) from None
    except RecursionError:
        raise FileError("the document is nested too deep", source=source) from None
    except ValueError as error:
        line = _line_of(text, error.args[1], last=True) if len(error.args) > 1 else None
        raise FileError(str(error.args[0]), source=source, line=line) from None
    return content


class Reader:
    """Reads the fields of one document, and collects the problems."""

    def __init__(self, text: str, source: str) -> None:
        self.problems = Problems(source)
        self._text = text

    def problem(self, place: Place, what: str) -> None:
        """Add a problem at a position of the document."""
        line = None
        if "params" in place[:-1] and not self.problems.is_full:
            line = _line_of(self._text, str(place[place.index("params") + 1]))
        described = f"{'.'.join(map(str, place)) or 'the document'}: {what}"
        is_short = len(described) <= PROBLEM_LENGTH_MAX
        self.problems.add(line, described if is_short else f"{described[:PROBLEM_LENGTH_MAX]}…")

    def fields(
        self, content: object, place: Place, checks: Checks, required: AbstractSet[str]
    ) -> dict[str, Any]:
        """Return the valid fields of an object without nulls; add a problem for each other field."""
        if not isinstance(content, dict):
            self.problem(place, f"it should be an object{found(content)}")
            return {}
        valid = {}
        for key, each in content.items():
            if key not in checks:
                self.problem((*place, key), "unknown field")
            elif each is not None or key in required:
                try:
                    valid[key] = checks[key](each)
                except UsageError as error:
                    self.problem((*place, key), str(error))
        for key in sorted(required - content.keys()):
            self.problem((*place, key), "the field is missing")
        return valid


def found(content: object) -> str:
    """Return the end of a problem that shows a wrong value; "" for an object or a list."""
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

    def check(content: Any) -> Any:
        if not isinstance(content, int) or isinstance(content, bool) or not low <= content <= high:
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


def _finite(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        raise ValueError(f"{excerpt(text)} is beyond the range of a double")
    return number


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:  # Python limits the digits of an int
        raise ValueError(f"{excerpt(text)} is beyond the range of every type") from None


def _line_of(text: str, key: str, *, last: bool = False) -> int | None:
    """Return the line of a key, if the key occurs once or the last occurrence is meant."""
    places = [match.start() for match in re.finditer(rf'"{re.escape(key)}"[ \t]*:', text)]
    return text.count("\n", 0, places[-1]) + 1 if places and (last or len(places) == 1) else None
