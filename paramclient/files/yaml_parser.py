"""YAML parser with JSON's rules for words and numbers. Needs PyYAML; only reading YAML imports it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final

import yaml

from paramclient.files.text import excerpt

__all__ = ["InvalidYaml", "load"]

YAML_NESTING_MAX: Final = 20
"""Levels of nesting; a document has six, and the parser recurses for each level."""


class InvalidYaml(Exception):
    """The text is not valid YAML, or uses an unsupported feature of YAML.

    Attributes:
        line: the line of the problem, from 1, or None.
    """

    def __init__(self, message: str, line: int | None) -> None:
        super().__init__(message)
        self.line = line


def load(text: str, lines: dict[tuple[str | int, ...], int] | None = None) -> Any:
    """Return the content of one YAML document: dicts, lists, strings, numbers, booleans and None.

    Builds the content from the parser's events, because PyYAML's nodes take a kilobyte for each value.

    Args:
        text: the document.
        lines: filled with the line of each value, from 1, by the keys and list indices from the top.

    Raises:
        InvalidYaml: the text is not valid YAML, or uses an unsupported feature.
    """
    try:
        return _content(yaml.parse(text, _Parser), lines)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        raise InvalidYaml(error.problem or str(error), None if mark is None else mark.line + 1) from None
    except yaml.YAMLError as error:
        raise InvalidYaml(str(error).splitlines()[0], None) from None


def _content(events: Iterator[Any], lines: dict[tuple[str | int, ...], int] | None) -> Any:
    """Return the content of the only document, and the line of each value in `lines`.

    Rejects aliases, anchors, tags, and nesting deeper than `YAML_NESTING_MAX`.
    """
    whole: list[Any] = []
    above: list[_Collection] = [_Collection(whole, None)]
    documents = 0
    for event in events:
        match event:
            case yaml.DocumentStartEvent():
                documents += 1
                if documents > 1:
                    raise _error_at(event, "expected a single document in the stream, found another document")
            case yaml.AliasEvent():
                raise _error_at(event, "found an alias (*); aliases are not supported")
            case yaml.CollectionEndEvent():
                above.pop()
            case yaml.ScalarEvent() | yaml.CollectionStartEvent():
                if event.anchor is not None or event.tag is not None:
                    raise _error_at(event, "found an anchor or a tag (&, !); these are not supported")
                place = above[-1].next_place if lines is not None else None
                if lines is not None and place is not None:
                    lines[place] = _line_of(event)
                if isinstance(event, yaml.ScalarEvent):
                    above[-1].add(event, _scalar(event))
                    continue
                if len(above) > YAML_NESTING_MAX:
                    raise _error_at(event, f"found more than {YAML_NESTING_MAX} levels")
                inner = _Collection({} if isinstance(event, yaml.MappingStartEvent) else [], place)
                above[-1].add(event, inner.content)
                above.append(inner)
    return whole[0] if whole else None


class _Collection:
    """A list or a mapping during parsing, at a position; None for the list of documents, or if not needed."""

    def __init__(self, content: list[Any] | dict[str, Any], place: tuple[str | int, ...] | None) -> None:
        self.content = content
        self._place = place
        self._key: str | None = None

    @property
    def next_place(self) -> tuple[str | int, ...] | None:
        """The position of the next value; None if a key comes next."""
        if self._place is None:
            return ()
        step = len(self.content) if isinstance(self.content, list) else self._key
        return None if step is None else (*self._place, step)

    def add(self, event: Any, value: Any) -> None:
        """Add a value, or the key of the next value."""
        if isinstance(self.content, list):
            self.content.append(value)
        elif self._key is not None:
            self.content[self._key] = value
            self._key = None
        elif not isinstance(value, str):
            raise _error_at(event, "found a key that is not text")
        elif value in self.content:
            raise _error_at(event, f"{excerpt(value)} occurs twice")
        else:
            self._key = value


def _scalar(event: Any) -> str | int | float | bool | None:
    """Return the value of a scalar; only a plain scalar can be other than text."""
    text: str = event.value
    if not event.implicit[0]:
        return text
    if text in _WORDS:
        return _WORDS[text]
    if _whole(text):
        try:
            return int(text)
        except ValueError:  # Python limits the digits of an int
            raise _error_at(event, f"{excerpt(text)} is beyond the range of every type") from None
    return float(text) if _fraction(text) else text


def _line_of(event: Any) -> int:
    """Return the line on which an event of the parser starts, from 1."""
    line: int = event.start_mark.line
    return line + 1


def _error_at(at: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=at.start_mark)


_Parser: Final = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The parser in C, where it is installed; otherwise PyYAML's Python parser."""
_WORDS: Final = {"~": None, "null": None, "": None, "true": True, "false": False}
_whole: Final = re.compile(r"-?(?:0|[1-9][0-9]*)").fullmatch
_fraction: Final = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?").fullmatch
