"""paramclient's own file format, as JSON and as YAML: all fields of every parameter, exactly.

    {"paramclient": 1, "header": [...], "sets": [
      {"system": 1, "component": 1, "at": "2026-01-31T12:00:00Z", "identity": {...}, "params": {
        "RTL_ALT": {"value": 1500, "type": "INT32", "bits": "000005dc", "default": 1500}}}]}

`value` is the shortest number that gives the same value in this type. "NaN", "Infinity" and "-Infinity" are
text, as are four raw bytes ("0x0000002a"). `bits` are as in `Param.bits` and must agree with the value: an
edit of only one of the two is an error. Each parameter is one line.
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
from paramclient.files.formats import FileFormat
from paramclient.files.param_file import ParamFile
from paramclient.files.text import excerpt, is_plain, time_of
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, WireValue, format_value, shortest_float, type_name

__all__ = [
    "is_document",
    "parse_json",
    "parse_yaml",
    "read_json",
    "read_yaml",
    "write_json",
    "write_yaml",
    "yaml_flow",
    "yaml_key",
]

VERSION: Final = 1
"""Version of the format, written to documents and required in documents that are read."""

PROBLEM_LENGTH_MAX: Final = 300
"""Characters of one problem in an error, so that a long field does not make the error unreadable."""

_first_key: Final = re.compile(r"""["']?paramclient(?:_extended)?["']?[ \t]*:""").match
_plain_key: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*").fullmatch
_YAML_WORDS: Final = frozenset({"y", "n", "yes", "no", "on", "off", "true", "false", "null"})
"""Words, in any case, that YAML does not parse as text unless quoted."""
_exponent: Final = re.compile(r"^(-?[0-9]+)(e[+-][0-9]+)$")
_beyond_ascii: Final = re.compile(r"[^\x20-\x7e]")


def is_document(first: str) -> bool:
    """Return whether this first line with content starts a document in YAML."""
    return _first_key(first) is not None or first == "---"


def read_json(text: str, source: str, params_max: int | None = None) -> ParamFile:
    """Read a document in JSON.

    Raises:
        FileError: invalid JSON, a repeated key, or not a valid document.
    """
    return _file(parse_json(text, source), FileFormat.JSON, source, text, params_max)


def parse_json(text: str, source: str) -> object:
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


def read_yaml(text: str, source: str, params_max: int | None = None) -> ParamFile:
    """Read a document in YAML.

    Words and numbers have the same meaning as in JSON: NO is text and not false, 010 is not 8, 1:30 is not
    90. Anchors, aliases and tags are rejected.

    Raises:
        FileError: invalid YAML, a repeated key, or not a valid document; or PyYAML is not installed.
    """
    return _file(parse_yaml(text, source), FileFormat.YAML, source, text, params_max)


def parse_yaml(text: str, source: str) -> object:
    """Return the content of a YAML text, with JSON's rules.

    Raises:
        FileError: invalid YAML, or a repeated key; or PyYAML is not installed.
    """
    if find_spec("yaml") is None:
        raise FileError("YAML is read with PyYAML: pip install 'paramclient[yaml]'", source=source)
    from paramclient.files.yaml_parser import InvalidYaml, load  # imported here because it needs the extra

    try:
        content: object = load(text)
    except InvalidYaml as error:
        raise FileError(f"expected YAML: {error}", source=source, line=error.line, expected="YAML") from None
    return content


def write_json(sets: Sequence[ParamSet], around: ParamFile) -> Iterator[str]:
    """Generate the lines of a document in JSON.

    Raises:
        UsageError: a NaN with payload bits has no type.
    """
    header = _header(around)
    yield "{"
    yield f'  "paramclient": {VERSION},'
    if header:
        yield f'  "header": {_json(header)},'
    yield '  "sets": ['
    for place, each in enumerate(sets):
        yield "    {"
        for key, content in _set_fields(each).items():
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
    """Generate the lines of a document in YAML, without PyYAML. Values are written as in JSON.

    Raises:
        UsageError: as `write_json`.
    """
    header = _header(around)
    yield f"paramclient: {VERSION}"
    if header:
        yield "header:"
        yield from (f"  - {yaml_flow(line)}" for line in header)
    yield "sets:"
    for each in sets:
        mark = "-"
        for key, content in _set_fields(each).items():
            yield f"  {mark} {key}: {yaml_flow(content)}"
            mark = " "
        yield f"  {mark} params:"
        for param in each.values():
            yield f"      {yaml_key(param.name)}: {yaml_flow(_fields(param))}"


def _file(
    content: object, file_format: FileFormat, source: str, text: str, params_max: int | None
) -> ParamFile:
    from paramclient.files.document_schema import InvalidDocument, parse  # imported here: loads pydantic

    if isinstance(content, dict) and "paramclient_extended" in content:
        raise FileError("it has extended parameters, and plain ones are expected", source=source)
    try:
        sets, header = parse(content, source, params_max)
    except InvalidDocument as error:
        problems = [_problem(place, what, text) for place, what in error.problems]
        more = [": ".join(filter(None, (_prefix(source, line), what))) for line, what in problems[1:]]
        if error.count > len(problems):
            more.append(f"and {error.count - len(problems)} more")
        line, what = problems[0]
        raise FileError(what, source=source, line=line, more=tuple(more)) from None
    if not any(sets):
        raise FileError("the file contains no parameters", source=source)
    return ParamFile(sets, file_format, source, header)


def _problem(place: Sequence[str | int], what: str, text: str) -> tuple[int | None, str]:
    """Return the line of a problem, if certain, and its description."""
    line = None
    if len(place) > 3 and place[2] == "params":
        line = _line_of(text, str(place[3]))
    described = f"{'.'.join(map(str, place)) or 'the document'}: {what}"
    is_short = len(described) <= PROBLEM_LENGTH_MAX
    return line, described if is_short else f"{described[:PROBLEM_LENGTH_MAX]}…"


def _prefix(source: str, line: int | None) -> str:
    return source if line is None else f"{source}:{line}" if source else f"line {line}"


def _line_of(text: str, key: str, *, last: bool = False) -> int | None:
    """Return the line of a key, if the key occurs once or the last occurrence is meant."""
    found = [match.start() for match in re.finditer(rf"""["']?{re.escape(key)}["']?[ \t]*:""", text)]
    return text.count("\n", 0, found[-1]) + 1 if found and (last or len(found) == 1) else None


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


def _header(around: ParamFile) -> list[str]:
    return [_encodable(line) for line in (*around.header, *around.footer)]


def _set_fields(params: ParamSet) -> dict[str, Any]:
    """Return the fields of a set, without its parameters."""
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
    """Return the fields of a parameter."""
    fields: dict[str, Any] = {"value": _scalar(param.settable, param.type_number)}
    if param.type_number is not None:
        is_wide = param.type is not None and param.type.size == 8
        fields["type"] = type_name(param.type_number)
        fields["bits"] = f"{param.bits_as(param.type_number):0{16 if is_wide else 8}x}"
    elif isinstance(param.value, float) and not is_plain(param.value):
        raise UsageError(f"{param.name} is a NaN with payload bits, and has no type for them")
    if param.default is not None:
        fields["default"] = _scalar(param.default, param.type_number)
    if param.comment:
        fields["comment"] = _encodable(param.comment)
    return fields


def _scalar(value: WireValue, kind: ParamType | int | None) -> int | float | str:
    if isinstance(value, bytes):
        return format_value(value)
    if isinstance(value, int) or math.isfinite(value):
        is_float32 = isinstance(value, float) and kind == ParamType.REAL32
        return shortest_float(value) if is_float32 else value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def _encodable(text: str) -> str:
    """Return text without lone surrogates, which a file name may have and a document may not."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def _json(content: object) -> str:
    return json.dumps(content, allow_nan=False)


def yaml_flow(content: object) -> str:
    """Return a value in YAML, on one line."""
    if isinstance(content, dict):
        return f"{{{', '.join(f'{yaml_key(key)}: {yaml_flow(each)}' for key, each in content.items())}}}"
    if isinstance(content, str):
        return _beyond_ascii.sub(_escaped, json.dumps(content, ensure_ascii=False))
    text = _json(content)
    # YAML 1.1 parses a number with an exponent and no point as text.
    return _exponent.sub(r"\1.0\2", text)


def yaml_key(key: str) -> str:
    """Return a key in YAML, quoted where a parser would take it for something else."""
    return key if _plain_key(key) and key.lower() not in _YAML_WORDS else yaml_flow(key)


def _escaped(match: re.Match[str]) -> str:
    return f"\\U{ord(match[0]):08x}"
