"""YAML text to plain objects, with JSON's idea of words and numbers; only reading YAML loads this room."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final

import yaml

from paramclient.files.text import shown

__all__ = ["NotYaml", "load"]

DEEPEST: Final = 20
"""Levels of nesting; our document has six, and the parser calls itself for each."""


class NotYaml(Exception):
    """The text is no YAML, or has in it what is not read.

    Attributes:
        line: where that showed, from 1, or None.
    """

    def __init__(self, message: str, line: int | None) -> None:
        super().__init__(message)
        self.line = line


def load(text: str) -> Any:
    """The content of one YAML document: dicts, lists, strings, numbers, booleans and None.

    It is built from the parser's events, without the nodes that PyYAML makes of them: those take a kilobyte
    for each value.

    Raises:
        NotYaml: see there.
    """
    try:
        return _content(yaml.parse(text, _Parser))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        raise NotYaml(error.problem or str(error), None if mark is None else mark.line + 1) from None
    except yaml.YAMLError as error:
        raise NotYaml(str(error).splitlines()[0], None) from None


def _content(events: Iterator[Any]) -> Any:
    """What stands in the one document that there is.

    It follows no references, trusts no tags, and nests no deeper than any document of ours.
    """
    whole: list[Any] = []
    above: list[_Collection] = [_Collection(whole)]
    documents = 0
    for event in events:
        match event:
            case yaml.DocumentStartEvent():
                documents += 1
                if documents > 1:
                    raise _refused(event, "expected a single document in the stream, found another document")
            case yaml.AliasEvent():
                raise _refused(event, "found an alias (*), which is not followed")
            case yaml.CollectionEndEvent():
                above.pop()
            case yaml.ScalarEvent() | yaml.CollectionStartEvent():
                if event.anchor is not None or event.tag is not None:
                    raise _refused(event, "found an anchor or a tag (&, !), which are not read")
                if isinstance(event, yaml.ScalarEvent):
                    above[-1].add(event, _scalar(event))
                    continue
                if len(above) > DEEPEST:
                    raise _refused(event, f"found more than {DEEPEST} levels")
                inner = _Collection({} if isinstance(event, yaml.MappingStartEvent) else [])
                above[-1].add(event, inner.content)
                above.append(inner)
    return whole[0] if whole else None


class _Collection:
    """A list or a mapping that is being read."""

    def __init__(self, content: list[Any] | dict[str, Any]) -> None:
        self.content = content
        self._key: str | None = None

    def add(self, event: Any, value: Any) -> None:
        """Take a value in, or the key of the next one."""
        if isinstance(self.content, list):
            self.content.append(value)
        elif self._key is not None:
            self.content[self._key] = value
            self._key = None
        elif not isinstance(value, str):
            raise _refused(event, "found a key that is no text")
        elif value in self.content:
            raise _refused(event, f"{shown(value)} stands twice")
        else:
            self._key = value


def _scalar(event: Any) -> str | int | float | bool | None:
    """What a scalar means; without quotes and marks it may be more than text."""
    text: str = event.value
    if not event.implicit[0]:
        return text
    if text in _WORDS:
        return _WORDS[text]
    if _whole(text):
        try:
            return int(text)
        except ValueError:  # Python converts no more than some thousand digits
            raise _refused(event, f"{shown(text)} is beyond the range of every type") from None
    return float(text) if _fraction(text) else text


def _refused(at: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=at.start_mark)


_Parser: Final = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The parser in C is not everywhere."""
_WORDS: Final = {"~": None, "null": None, "": None, "true": True, "false": False}
_whole: Final = re.compile(r"-?(?:0|[1-9][0-9]*)").fullmatch
_fraction: Final = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?").fullmatch
