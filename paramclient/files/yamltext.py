"""YAML text to plain objects, with JSON's idea of words and numbers; only reading YAML loads this room."""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any, Final

import yaml

from paramclient.files.text import shown

__all__ = ["NotYaml", "load"]

DEEPEST: Final = 20
"""Levels of nesting; our document has six, and the parser calls itself for each."""

_STANDARD = "tag:yaml.org,2002:"
_PLAIN_WORDS: Final = (
    ("null", re.compile(r"(?:~|null|)$"), ["~", "n", ""]),
    ("bool", re.compile(r"(?:true|false)$"), list("tf")),
    ("int", re.compile(r"-?(?:0|[1-9][0-9]*)$"), list("-0123456789")),
    ("float", re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?$"), list("-0123456789")),
)


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

    Raises:
        NotYaml: see there.
    """
    try:
        _check_events(text)
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        raise NotYaml(error.problem or str(error), None if mark is None else mark.line + 1) from None
    except yaml.YAMLError as error:
        raise NotYaml(str(error).splitlines()[0], None) from None


def _check_events(text: str) -> None:
    """Follow no references, trust no tags, and nest no deeper than any document of ours."""
    depth = 0
    for event in yaml.parse(text, _Loader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent):
            raise _refused(event, "found an alias (*), which is not followed")
        if getattr(event, "anchor", None) is not None or getattr(event, "tag", None) is not None:
            raise _refused(event, "found an anchor or a tag (&, !), which are not read")
        if depth > DEEPEST:
            raise _refused(event, f"found more than {DEEPEST} levels")


def _refused(at: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=at.start_mark)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # the one in C is not everywhere
    """A safe loader that takes fewer words for something else than text."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key, _ in node.value:
            name = self.construct_object(key, deep=True)
            if not isinstance(name, str):
                raise _refused(key, "found a key that is no text")
            if name in seen:
                raise _refused(key, f"{shown(name)} stands twice")
            seen.add(name)
        mapping: dict[Hashable, Any] = super().construct_mapping(node, deep)
        return mapping


def _whole(_: _Loader, node: Any) -> int:
    try:
        return int(node.value)
    except ValueError:  # Python converts no more than some thousand digits
        raise _refused(node, f"{shown(node.value)} is beyond the range of every type") from None


_Loader.add_constructor(f"{_STANDARD}int", _whole)
_Loader.yaml_implicit_resolvers = {}  # none of those of YAML 1.1
for _tag, _pattern, _first in _PLAIN_WORDS:
    _Loader.add_implicit_resolver(_STANDARD + _tag, _pattern, _first)
