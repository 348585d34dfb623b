"""paramclient's own file format, JSON: all fields of every parameter, exactly.

    {"paramclient": 1, "header": [...], "sets": [
      {"system": 1, "component": 1, "at": "2026-01-31T12:00:00Z", "identity": {...}, "params": {
        "RTL_ALT": {"value": 1500, "type": "INT32", "bits": "000005dc", "default": 1500}}},
      {"system": 1, "component": 100, "extended": true, "params": {
        "CAM_NAME": {"value": "Front", "type": "CUSTOM"},
        "CAM_LICENSE": {"value": "hex:ff00fe", "type": "CUSTOM"}}}]}

`value` is the shortest number that gives the same value in this type. "NaN", "Infinity" and "-Infinity" are
text, as are raw bytes ("0x0000002a", a little-endian number). The value of an extended parameter of the type
CUSTOM is text, or bytes in hexadecimal after `hex:`. `bits` are as in `Param.bits` and must agree with the
value: an edit of only one of the two is an error. Each parameter is one line.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import asdict, fields
from datetime import datetime
from typing import Any, Final, NoReturn, TypeAlias

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import FileFormat, ParamFile
from paramclient.files.reading import FAULTS_MAX, Reading, as_type, decoded, excerpt, is_plain
from paramclient.model.identity import Identity
from paramclient.model.notation import bits_written, time_text, value_written
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import (
    HEX,
    TYPES_BY_NAME,
    WIRE_SIZE,
    ParamType,
    Value,
    bits_of,
    check_name,
    from_bits,
    is_portable_name,
    parse_ext_value,
)

FAULT_LENGTH_MAX: Final = 300
"""Characters of one fault in an error, so that a long field does not make the error unreadable."""

Place: TypeAlias = tuple[str | int, ...]
"""Position in a document: keys and list indices from the top."""
Checks: TypeAlias = Mapping[str, Callable[[Any], Any]]
"""By the name of a field, a function that returns the field's content, or raises UsageError."""
VERSION: Final = 1
"""Version of documents, written and required."""
_KEY: Final = "paramclient"
"""The key with the version."""
_CUSTOM: Final = ParamType.CUSTOM
_TYPES: Final = TYPES_BY_NAME | {_CUSTOM.name: _CUSTOM}
_WORDS: Final = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
_raw: Final = re.compile(r"0x([0-9a-fA-F]{8,256})").fullmatch
_type_number: Final = re.compile(r"TYPE_([0-9]{1,3})").fullmatch
_remark: Final = re.compile(r'"(?:comment|source|header)"\s*:[^"]*(?:"(?:[^"\\]|\\.)*"[\s,]*)+')
"""Texts for readers only, with their keys."""
_bits: Final = re.compile(r"[0-9a-fA-F]{8}(?:[0-9a-fA-F]{8})?").fullmatch

# Documents


def read_json_text(text: str, source: str) -> Any:
    """Return the content of a JSON text without repeated keys.

    Raises:
        FileError: invalid JSON, or a repeated key.
    """
    try:
        return json.loads(text, object_pairs_hook=_unique, parse_constant=_no_constant, parse_int=_parse_int)
    except json.JSONDecodeError as error:
        message = f"expected JSON: {error.msg} (column {error.colno})"
        raise FileError(message, source=source, line=error.lineno) from None
    except RecursionError:
        raise FileError("the document is nested too deep", source=source) from None
    except ValueError as error:
        line = _line_of(text, error.args[1], last=True) if len(error.args) > 1 else None
        raise FileError(str(error.args[0]), source=source, line=line) from None


def _fault(reading: Reading, place: Place, what: str) -> None:
    """Add a fault at a position of the document."""
    line, is_row = None, "params" in place[:-1]
    if is_row and reading.fault_count < FAULTS_MAX:
        line = _line_of(reading.text, str(place[place.index("params") + 1]))
    described = f"{'.'.join(map(str, place)) or 'the document'}: {what}"
    if len(described) > FAULT_LENGTH_MAX:
        described = f"{described[:FAULT_LENGTH_MAX]}…"
    reading.fault(line, described, is_row=is_row)


def _checked(
    reading: Reading, content: object, place: Place, checks: Checks, required: AbstractSet[str]
) -> dict[str, Any]:
    """Return the valid fields of an object without nulls; add a fault for each other field."""
    if not isinstance(content, dict):
        _fault(reading, place, f"it should be an object{_found(content)}")
        return {}
    valid = {}
    for key, each in content.items():
        if key not in checks:
            _fault(reading, (*place, key), "unknown field")
        elif each is not None or key in required:
            try:
                valid[key] = checks[key](each)
            except UsageError as error:
                _fault(reading, (*place, key), str(error))
    for key in sorted(required - content.keys()):
        _fault(reading, (*place, key), "the field is missing")
    return valid


def _found(content: object) -> str:
    """Return the end of a fault that shows a wrong value; "" for an object or a list."""
    return "" if isinstance(content, dict | list) else f", found {content!r}"


def _expected(is_valid: Callable[[Any], bool], words: str) -> Callable[[Any], Any]:
    """Return the check of a field."""

    def check(content: Any) -> Any:
        if not is_valid(content):
            raise UsageError(f"it should be {words}{_found(content)}")
        return content

    return check


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"{excerpt(key)} occurs twice", key)
        content[key] = value
    return content


def _parse_int(digits: str) -> int | float:
    """Return a whole number; infinity beyond the range of a double, as for a fraction."""
    number = float(digits)
    return int(digits) if math.isfinite(number) else number


def _no_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is not valid JSON; write it as text: {json.dumps(word)}")


def _line_of(text: str, key: str, *, last: bool = False) -> int | None:
    """Return the line of a key, if the key occurs once or the last occurrence is meant."""
    written = f'"{re.escape(key)}"|{re.escape(json.dumps(key))}'  # also with escapes
    places = [match.start() for match in re.finditer(rf"(?:{written})[ \t]*:", text)]
    return text.count("\n", 0, places[-1]) + 1 if places and (last or len(places) == 1) else None


# Reading


def read_json(reading: Reading, file_format: FileFormat) -> ParamFile:
    """Read a document.

    Raises:
        FileError: invalid JSON, a repeated key, or not a valid document. The error names up to 20 faults.
    """

    def read_remark(found: re.Match[str]) -> str:
        if (known := decoded(found[0])) != found[0]:
            line = reading.text.count("\n", 0, found.start()) + 1
            reading.foreign.append(f"line {line}")
        return known

    content = read_json_text(_remark.sub(read_remark, reading.text), reading.source)
    if not isinstance(content, dict) or _KEY not in content:
        raise FileError("not a parameter file of paramclient (JSON)", source=reading.source)
    if type(version := content[_KEY]) is int and version > VERSION:
        what = f"a newer paramclient wrote it, in version {version} of the format"
        raise FileError(what, source=reading.source)
    found = _checked(reading, content, (), _DOCUMENT, {_KEY, "sets"})
    sets = [_set(reading, each, ("sets", place)) for place, each in enumerate(found.get("sets", []))]
    return reading.file(file_format, tuple(found.get("header", [])), sets=tuple(sets))


def _set(reading: Reading, content: object, place: Place) -> ParamSet:
    """Return the set at a position, without invalid fields."""
    found = _checked(reading, content, place, _SET, {"params"})
    is_extended = found.get("extended", False)
    params = {}
    for name, each in found.get("params", {}).items():
        at, before = (*place, "params", name), reading.fault_count
        known = _checked(reading, each, at, _PARAM, {"value"})
        if reading.fault_count == before:
            try:
                params[name] = _param(name, known, is_extended=is_extended)
            except UsageError as error:
                _fault(reading, at, str(error))
        if name in params and not is_portable_name(name):
            at_line = "" if (line := _line_of(reading.text, name)) is None else f"line {line}: "
            reading.notes.append(f"{at_line}the client ignores a parameter called {name!r} of a vehicle.")
    identity = None
    if "identity" in found:
        known = _checked(reading, found["identity"], (*place, "identity"), _IDENTITY, _IDS)
        identity = Identity(**known) if known.keys() >= _IDS else None
    ids, lacks = (found.get("component"), found.get("system")), found.get("lacks", "")
    return ParamSet(params, *ids, identity, found.get("at"), reading.source, is_extended, lacks)


def _param(name: str, found: Mapping[str, Any], *, is_extended: bool) -> WrittenParam:
    """Return the parameter of valid fields.

    Raises:
        UsageError: no parameter can have the name, or the fields contradict each other.
    """
    kind, default = found.get("type"), found.get("default")
    value = _custom(found["value"]) if kind is _CUSTOM else _number(found["value"])
    is_raw = isinstance(value, bytes) and kind is not _CUSTOM
    if is_extended and (kind is None or (is_raw and isinstance(kind, ParamType))):
        raise UsageError("an extended parameter has a type, and raw bytes only if MAVLink does not define it")
    if not is_extended and (kind is _CUSTOM or (isinstance(value, bytes) and len(value) > WIRE_SIZE)):
        raise UsageError("a plain parameter is a number, or four raw bytes")
    if kind is not None:
        value = as_type(value, kind)
        default = None if default is None else as_type(default, kind)
    if "bits" in found:
        value = _with_bits(value, kind, found["bits"])
        is_raw = isinstance(value, bytes)
    return WrittenParam(check_name(name), value, kind, default, found.get("comment", ""), is_raw=is_raw)


def _whole(low: int, high: float, words: str) -> Callable[[Any], Any]:
    return _expected(lambda content: type(content) is int and low <= content <= high, words)


_text: Final = _expected(lambda content: isinstance(content, str) and decoded(content) == content, "text")
_list: Final = _expected(lambda content: isinstance(content, list), "a list")
_object: Final = _expected(lambda content: isinstance(content, dict), "an object")
_count: Final = _whole(0, math.inf, "a whole number from 0")
_id: Final = _whole(1, 255, "an id from 1 to 255")
_version: Final = _whole(VERSION, VERSION, f"{VERSION}, the version of the format")


def _texts(content: object) -> list[str]:
    return [_text(each) for each in _list(content)]


def _time(content: object) -> float:
    try:
        moment = datetime.fromisoformat(_text(content).upper())
    except ValueError:  # a number could be seconds or milliseconds
        raise UsageError(f"a time is written as 2026-01-31T12:00:00Z{_found(content)}") from None
    if moment.tzinfo is None:
        raise UsageError("the time needs its zone, as in 2026-01-31T12:00:00Z")
    if not 1 < moment.year < 9999:
        raise UsageError(f"not every time zone has this time{_found(content)}")
    return moment.timestamp()


def _type(content: object) -> ParamType | int:
    text = _text(content)
    if text in _TYPES:
        return _TYPES[text]
    if match := _type_number(text):
        number = int(match[1])
        if number <= 255 and number not in TYPES_BY_NAME.values():
            return number
    raise UsageError(f"unknown type {text!r}; the types are {', '.join(TYPES_BY_NAME)}")


def _number(content: object) -> Value:
    if isinstance(content, str):
        if content in _WORDS:
            return _WORDS[content]
        if match := _raw(content):
            return int(match[1], 16).to_bytes((len(match[1]) + 1) // 2, "little")
    elif isinstance(content, int | float) and not isinstance(content, bool):
        if abs(content) < 2**1024:
            return content
        raise UsageError("the number is beyond the range of a double")
    raise UsageError(f"expected a number (or NaN, Infinity, 0x and 8 digits for raw bytes){_found(content)}")


def _custom(content: object) -> Value:
    """Return a CUSTOM value: text, or bytes after `hex:`."""
    return from_bits(bits_of(parse_ext_value("value", _text(content), _CUSTOM), _CUSTOM), _CUSTOM)


def _with_bits(value: Value, kind: ParamType | int | None, text: str) -> Value:
    """Return the value of the bits, if it agrees with the given value; else raise UsageError."""
    if kind is None:
        raise UsageError("bits need a type")
    if not _bits(text):
        raise UsageError(f"bits are 8 or 16 hexadecimal digits, not {text!r}")
    bits, is_raw = int(text, 16), isinstance(value, bytes)
    size = kind.size if isinstance(kind, ParamType) and not is_raw else WIRE_SIZE
    if bits >> 8 * size:
        raise UsageError(f"bits {text} exceed the size of the type")
    exact = from_bits(bits, kind, is_raw=is_raw)
    if exact != value and (exact == exact or value == value):  # two NaNs may differ in their payload
        raise UsageError(f"value {value!r} and bits {text} ({exact!r}) contradict each other; leave out one")
    return exact


_DOCUMENT: Final[Checks] = {_KEY: _version, "header": _texts, "sets": _list}
_SET: Final[Checks] = {
    "system": _id,
    "component": _whole(0, 255, "an id from 0 to 255"),
    "extended": _expected(lambda content: isinstance(content, bool), "true or false"),
    "identity": _object,
    "at": _time,
    "source": _text,
    "lacks": _text,
    "params": _object,
}
_IDENTITY: Final[Checks] = {
    each.name: _text if "str" in str(each.type) else _count for each in fields(Identity)
} | {"system": _id}
_IDS: Final = frozenset({"system", "link"})
"""The fields that an identity has at least."""
_PARAM: Final[Checks] = {
    "value": lambda content: content,  # its notation depends on the type
    "type": _type,
    "bits": _text,
    "default": _number,
    "comment": _text,
}


# Writing


def write_json(sets: Sequence[ParamSet], around: ParamFile) -> Iterator[str]:
    """Generate the lines of a document.

    Raises:
        UsageError: a NaN with payload bits has no type.
    """
    header = [_encodable(line) for line in (*around.header, *around.footer)]
    document = {_KEY: VERSION, "header": header or None, "sets": [_set_fields(each) for each in sets]}
    yield _json(_without_none(document))


def _set_fields(params: ParamSet) -> dict[str, object]:
    return _without_none(
        {
            "system": params.system,
            "component": params.component,
            "extended": params.is_extended or None,
            "at": None if params.at is None else time_text(params.at, "auto"),
            "source": _encodable(params.source) or None,
            "lacks": _encodable(params.lacks) or None,
            "identity": None if params.identity is None else asdict(params.identity),
            "params": {param.name: json_fields(params, param) for param in params.values()},
        }
    )


def json_fields(params: ParamSet, param: WrittenParam) -> dict[str, object]:
    """Return the fields of a parameter, or raise UsageError if the format cannot express it."""
    number, value = param.type, param.settable
    if number is not None:
        param.bits_as(number)  # raises UsageError if the value does not fit
    elif isinstance(value, float) and not is_plain(value):
        raise UsageError(f"{param.name} is a NaN with payload bits, and has no type for them")
    if isinstance(value, str) and value.startswith(HEX):  # as text, it would read as bytes
        value = value.encode()
    is_exact = params.is_extended and isinstance(value, str | bytes)
    kind = None if number is None else ParamType(number).name
    return _without_none(
        {
            "value": value_written(value, param),
            "type": "TYPE_11" if param.is_raw and number == _CUSTOM else kind,
            "bits": None if is_exact else bits_written(param),
            "default": None if param.default is None else value_written(param.default, param),
            "comment": _encodable(param.comment) or None,
        }
    )


def _without_none(fields: Mapping[str, object]) -> dict[str, object]:
    return {name: content for name, content in fields.items() if content is not None}


def _json(content: object, indent: str = "\n") -> str:
    """Return JSON in which an object or a list is on one line if it contains no other."""
    parts: list[tuple[str, object]] = []
    if isinstance(content, dict):
        parts = [(f"{json.dumps(key)}: ", each) for key, each in content.items()]
    elif isinstance(content, list):
        parts = [("", each) for each in content]
    if not any(isinstance(each, dict | list) for _, each in parts):
        return json.dumps(content, allow_nan=False)
    begin, end = "{}" if isinstance(content, dict) else "[]"
    inner = f"{indent}  "
    lines = f",{inner}".join(f"{key}{_json(each, inner)}" for key, each in parts)
    return f"{begin}{inner}{lines}{indent}{end}"


def _encodable(text: str) -> str:
    """Return text without lone surrogates, which a file name may have and a document may not."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
