"""YAML text to plain objects, with JSON's idea of words and numbers; only reading YAML loads this room."""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any, Final

import yaml

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
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        raise NotYaml(error.problem or str(error), None if mark is None else mark.line + 1) from None
    except (yaml.YAMLError, ValueError) as error:
        raise NotYaml(str(error).splitlines()[0], None) from None


class _Loader(yaml.SafeLoader):
    """A safe loader that takes fewer words for something else than text, and follows no references."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise self._refused("an alias (*), which is not followed")
        event = self._next_event()
        if event.anchor is not None or getattr(event, "tag", None) is not None:
            raise self._refused("an anchor or a tag (&, !), which are not read")
        self._depth += 1
        if self._depth > DEEPEST:
            raise self._refused(f"more than {DEEPEST} levels")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key, _ in node.value:
            name = self.construct_object(key, deep=True)
            if not isinstance(name, str):
                raise yaml.MarkedYAMLError(problem="found a key that is no text", problem_mark=key.start_mark)
            if name in seen:
                raise yaml.MarkedYAMLError(problem=f"{name!r} stands twice", problem_mark=key.start_mark)
            seen.add(name)
        return super().construct_mapping(node, deep)

    def _next_event(self) -> Any:
        return self.peek_event()  # type: ignore[no-untyped-call]  # the stubs say nothing of it

    def _refused(self, what: str) -> yaml.MarkedYAMLError:
        return yaml.MarkedYAMLError(problem=f"found {what}", problem_mark=self._next_event().start_mark)


_Loader.yaml_implicit_resolvers = {}  # none of those of YAML 1.1
for _tag, _pattern, _first in _PLAIN_WORDS:
    _Loader.add_implicit_resolver(_STANDARD + _tag, _pattern, _first)
