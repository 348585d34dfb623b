"""paramclient's own document, as JSON and as YAML: everything that is known, exactly.

    {"paramclient": 1, "header": [...], "sets": [
      {"system": 1, "component": 1, "at": "2026-01-31T12:00:00Z", "identity": {...}, "params": {
        "RTL_ALT": {"value": 1500, "type": "INT32", "bits": "000005dc", "default": 1500}}}]}

`value` is the shortest number that gives the same value in this type; "NaN", "Infinity" and "-Infinity" are
written as text, and so are four raw bytes ("0x0000002a"). `bits` are as in `Param.bits`: where they stand
they must agree with the value, as who changes only one of the two has made a mistake. A parameter is a line.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from typing import Any, Final, NoReturn

from paramclient.errors import FileError, UsageError
from paramclient.files.param_file import FileForm, ParamFile
from paramclient.files.text import is_plain, shown, time_of
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, Value, format_value, shortest_float, type_name

__all__ = ["is_document", "read_json", "read_yaml", "write_json", "write_yaml"]

VERSION: Final = 1
"""Of what a document holds; one that is read has this."""

LONGEST_PROBLEM: Final = 300
"""Characters in which an error tells of one field, whatever stands in it."""

_first_key: Final = re.compile(r"""["']?paramclient["']?[ \t]*:""").match
_plain_key: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*").fullmatch
_YAML_WORDS: Final = frozenset({"y", "n", "yes", "no", "on", "off", "true", "false", "null"})
"""What YAML takes for something else than text where it stands without quotes, in any case."""
_exponent: Final = re.compile(r"^(-?[0-9]+)(e[+-][0-9]+)$")
_beyond_ascii: Final = re.compile(r"[^\x20-\x7e]")


def is_document(first: str) -> bool:
    """Whether the first line that says something is that of a document in YAML."""
    return _first_key(first) is not None or first == "---"


def read_json(text: str, source: str, params_max: int | None = None) -> ParamFile:
    """Read a document in JSON.

    Raises:
        FileError: it is no JSON, names a key twice, or is not such a document.
    """
    try:
        content = json.loads(
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
        raise FileError("no document is nested that deep", source=source) from None
    except ValueError as error:
        line = _line_of(text, error.args[1], last=True) if len(error.args) > 1 else None
        raise FileError(str(error.args[0]), source=source, line=line) from None
    return _file(content, FileForm.JSON, source, text, params_max)


def read_yaml(text: str, source: str, params_max: int | None = None) -> ParamFile:
    """Read a document in YAML.

    Words and numbers mean what they mean in JSON: NO is text and not false, 010 is not 8, 1:30 not 90.
    Anchors, aliases and tags are refused.

    Raises:
        FileError: it is no YAML, names a key twice, or is not such a document; or PyYAML is not installed.
    """
    if find_spec("yaml") is None:
        raise FileError("YAML is read with PyYAML: pip install 'paramclient[yaml]'", source=source)
    from paramclient.files.yamltext import NotYaml, load  # only here: needs the extra

    try:
        content = load(text)
    except NotYaml as error:
        raise FileError(f"expected YAML: {error}", source=source, line=error.line, expected="YAML") from None
    return _file(content, FileForm.YAML, source, text, params_max)


def write_json(sets: Sequence[ParamSet], around: ParamFile) -> Iterator[str]:
    """The lines of a document in JSON.

    Raises:
        UsageError: a NaN with bits of its own has no type to say which.
    """
    header = _header(around)
    yield "{"
    yield f'  "paramclient": {VERSION},'
    if header:
        yield f'  "header": {_json(header)},'
    yield '  "sets": ['
    for place, each in enumerate(sets):
        yield "    {"
        for key, content in _about(each).items():
            yield f"      {_json(key)}: {_json(content)},"
        yield '      "params": {'
        last = len(each) - 1
        for number, param in enumerate(each.values()):
            yield f"        {_json(param.name)}: {_json(_fields(param))}{',' if number < last else ''}"
        yield "      }"
        yield "    }," if place < len(sets) - 1 else "    }"
    yield "  ]"
    yield "}"


def write_yaml(sets: Sequence[ParamSet], around: ParamFile) -> Iterator[str]:
    """The lines of the same document in YAML, which needs no library. A value is written as in JSON.

    Raises:
        UsageError: as `write_json`.
    """
    header = _header(around)
    yield f"paramclient: {VERSION}"
    if header:
        yield "header:"
        yield from (f"  - {_flow(line)}" for line in header)
    yield "sets:"
    for each in sets:
        mark = "-"
        for key, content in _about(each).items():
            yield f"  {mark} {key}: {_flow(content)}"
            mark = " "
        yield f"  {mark} params:"
        for param in each.values():
            yield f"      {_key(param.name)}: {_flow(_fields(param))}"


def _file(content: object, form: FileForm, source: str, text: str, params_max: int | None) -> ParamFile:
    from paramclient.files.document_schema import Wrong, parse  # only here: loads pydantic

    try:
        sets, header = parse(content, source, params_max)
    except Wrong as error:
        problems = [_problem(place, what, text) for place, what in error.problems]
        more = [": ".join(filter(None, (_at(source, line), what))) for line, what in problems[1:]]
        if error.count > len(problems):
            more.append(f"and {error.count - len(problems)} more")
        line, what = problems[0]
        raise FileError(what, source=source, line=line, more=tuple(more)) from None
    if not any(sets):
        raise FileError("the file holds no parameter", source=source)
    return ParamFile(sets, form, source, header)


def _problem(place: Sequence[str | int], what: str, text: str) -> tuple[int | None, str]:
    """The line of what is wrong, where that is certain, and the words for it."""
    line = None
    if len(place) > 3 and place[2] == "params":
        line = _line_of(text, str(place[3]))
    told = f"{'.'.join(map(str, place)) or 'the document'}: {what}"
    return line, told if len(told) <= LONGEST_PROBLEM else f"{told[:LONGEST_PROBLEM]}…"


def _at(source: str, line: int | None) -> str:
    return source if line is None else f"{source}:{line}" if source else f"line {line}"


def _line_of(text: str, key: str, *, last: bool = False) -> int | None:
    """The line in which a key stands, if there is one of this name alone, or the last one is meant."""
    found = [match.start() for match in re.finditer(rf"""["']?{re.escape(key)}["']?[ \t]*:""", text)]
    return text.count("\n", 0, found[-1]) + 1 if found and (last or len(found) == 1) else None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"{shown(key)} stands twice", key)
        content[key] = value
    return content


def _no_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is no JSON; as text it can stand: {json.dumps(word)}")


def _finite(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        raise ValueError(f"{shown(text)} is beyond the range of a double")
    return number


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:  # Python converts no more than some thousand digits
        raise ValueError(f"{shown(text)} is beyond the range of every type") from None


def _header(around: ParamFile) -> list[str]:
    return [_encodable(line) for line in (*around.header, *around.footer)]


def _about(params: ParamSet) -> dict[str, Any]:
    """What a document says of a set but for its parameters."""
    identity = None if params.identity is None else asdict(params.identity)
    about = {
        "system": params.system,
        "component": params.component,
        "at": None if params.at is None else time_of(params.at),
        "source": _encodable(params.source) or None,
        "identity": identity,
    }
    return {key: content for key, content in about.items() if content is not None}


def _fields(param: WrittenParam) -> dict[str, Any]:
    """What a document says of a parameter."""
    fields: dict[str, Any] = {"value": _scalar(param.value, param.type)}
    if param.type is not None:
        is_wide = isinstance(param.type, ParamType) and param.type.size == 8
        fields["type"] = type_name(param.type)
        fields["bits"] = f"{param.bits_as(param.type):0{16 if is_wide else 8}x}"
    elif isinstance(param.value, float) and not is_plain(param.value):
        raise UsageError(f"{param.name} is a NaN with bits of its own, and has no type to say which")
    if param.default is not None:
        fields["default"] = _scalar(param.default, param.type)
    if param.comment:
        fields["comment"] = _encodable(param.comment)
    return fields


def _scalar(value: Value, kind: ParamType | int | None) -> int | float | str:
    if isinstance(value, bytes):
        return format_value(value)
    if isinstance(value, int) or math.isfinite(value):
        is_float32 = isinstance(value, float) and kind == ParamType.REAL32
        return shortest_float(value) if is_float32 else value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def _encodable(text: str) -> str:
    """Text without halves of characters, which a file's name may have and a document may not."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def _json(content: object) -> str:
    return json.dumps(content, allow_nan=False)


def _flow(content: object) -> str:
    """A value in YAML, on one line."""
    if isinstance(content, dict):
        return f"{{{', '.join(f'{_key(key)}: {_flow(each)}' for key, each in content.items())}}}"
    if isinstance(content, str):
        return _beyond_ascii.sub(_escaped, json.dumps(content, ensure_ascii=False))
    text = _json(content)
    # older YAML takes a number with an exponent and no point for text
    return _exponent.sub(r"\1.0\2", text)


def _key(key: str) -> str:
    return key if _plain_key(key) and key.lower() not in _YAML_WORDS else _flow(key)


def _escaped(match: re.Match[str]) -> str:
    return f"\\U{ord(match[0]):08x}"
