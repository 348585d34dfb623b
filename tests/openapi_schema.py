"""Holds answers of the service against the schema that it publishes of itself."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

__all__ = ["Published"]

_TYPES: Final[dict[str, tuple[type, ...]]] = {
    "string": (str,),
    "integer": (int,),
    "number": (int, float),
    "boolean": (bool,),
    "array": (list,),
    "object": (dict,),
    "null": (type(None),),
}
_KNOWN: Final = {
    *("$ref", "type", "properties", "required", "items", "anyOf", "oneOf", "enum", "const"),
    *(
        "additionalProperties",
        "title",
        "description",
        "default",
        "$defs",
        "discriminator",
        "format",
        "propertyNames",
    ),
}


class Published:
    """What `/openapi.json` says.

    Args:
        document: its content.
    """

    def __init__(self, document: Mapping[str, Any]) -> None:
        self._document = document
        self._paths = {
            path: re.compile("/".join(_pattern(part) for part in path.split("/")))
            for path in sorted(document["paths"], key=lambda path: path.count("{"))
        }

    def check(self, method: str, path: str, status: int, content: Any) -> None:
        """See that an answer is what the schema says: nothing else, nothing less, nothing besides.

        Raises:
            AssertionError: it is not; the text says where.
        """
        template = next(each for each, pattern in self._paths.items() if pattern.fullmatch(path))
        responses = self._document["paths"][template][method.lower()]["responses"]
        response = responses.get(str(status), responses["default"])
        (media_type,) = response["content"] if status < 400 else ("application/problem+json",)
        self._see(response["content"][media_type]["schema"], content, f"{method} {template} {status}")

    def _see(self, schema: Mapping[str, Any], content: Any, where: str) -> None:
        fault = self._fault(schema, content, where)
        assert fault is None, fault

    def _fault(self, schema: Mapping[str, Any], content: Any, where: str) -> str | None:
        """What is wrong with it, or None."""
        assert schema.keys() <= _KNOWN, f"{where}: this checker does not know {schema.keys() - _KNOWN}"
        if "$ref" in schema:
            found = self._document
            for part in schema["$ref"].removeprefix("#/").split("/"):
                found = found[part]
            return self._fault(found, content, where)
        for key in ("anyOf", "oneOf"):
            if key in schema:
                faults = [self._fault(each, content, where) for each in schema[key]]
                return None if None in faults else f"{where}: {faults}"
        if "const" in schema and content != schema["const"]:
            return f"{where}: {content!r} is not {schema['const']!r}"
        if "enum" in schema and content not in schema["enum"]:
            return f"{where}: {content!r} is none of {schema['enum']}"
        kind = schema.get("type")
        if kind is not None:
            is_bool = isinstance(content, bool)
            if not isinstance(content, _TYPES[kind]) or (is_bool and kind != "boolean"):
                return f"{where}: {content!r} is no {kind}"
        if isinstance(content, list) and "items" in schema:
            return _first(
                self._fault(schema["items"], each, f"{where}[{place}]") for place, each in enumerate(content)
            )
        return self._fault_of_members(schema, content, where) if isinstance(content, dict) else None

    def _fault_of_members(self, schema: Mapping[str, Any], content: dict[str, Any], where: str) -> str | None:
        members, more = schema.get("properties", {}), schema.get("additionalProperties")
        if missing := set(schema.get("required", ())) - content.keys():
            return f"{where}: {missing} is missing"
        for name, value in content.items():
            if name in members:
                fault = self._fault(members[name], value, f"{where}.{name}")
            elif isinstance(more, dict):
                fault = self._fault(more, value, f"{where}.{name}")
            else:
                fault = None if more is True else f"{where}: {name} is not declared"
            if fault is not None:
                return fault
        return None


def _first(faults: Any) -> str | None:
    return next((fault for fault in faults if fault is not None), None)


def _pattern(part: str) -> str:
    return ".+" if part.startswith("{key") else "[^/]+" if part.startswith("{") else re.escape(part)
