"""paramclient's own file format, JSON: all fields of every parameter, exactly. Plain and extended parameters.

    {"paramclient": 1, "header": [...], "sets": [
      {"system": 1, "component": 1, "at": "2026-01-31T12:00:00Z", "identity": {...}, "params": {
        "RTL_ALT": {"value": 1500, "type": "INT32", "bits": "000005dc", "default": 1500}}}]}

    {"paramclient_extended": 1, "system": 1, "component": 100, "at": "2026-01-31T12:00:00Z", "params": {
      "CAM_MODE": {"value": 1, "type": "UINT32"},
      "CAM_NAME": {"value": "Front", "type": "CUSTOM"},
      "CAM_LICENSE": {"hex": "ff00fe", "type": "CUSTOM"}}}

`value` is the shortest number that gives the same value in this type. "NaN", "Infinity" and "-Infinity" are
text, as are four raw bytes ("0x0000002a"). `bits` are as in `Param.bits` and must agree with the value: an
edit of only one of the two is an error. In a document of extended parameters, `value` is text for CUSTOM, and
`hex` has the bytes of a value that is neither a number nor text. Each parameter is one line.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import asdict
from datetime import datetime
from typing import Any, Final, NoReturn, TypeAlias

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import FileFormat, ParamFile
from paramclient.files.reading import Reading, as_type, excerpt, is_plain, time_of, undecoded_byte
from paramclient.model.ext_values import (
    EXT_VALUE_SIZE,
    check_ext_value,
    encode_ext_value,
    ext_param,
    own_bytes,
)
from paramclient.model.identity import Identity
from paramclient.model.notation import bits_written, value_json, value_written
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import (
    TYPES_BY_NAME,
    WIRE_SIZE,
    ParamType,
    WireValue,
    check_name,
    from_bits,
    is_portable_name,
    type_name,
)

__all__ = ["json_fields", "read_json", "read_json_text", "write_json"]

FAULT_LENGTH_MAX: Final = 300
"""Characters of one fault in an error, so that a long field does not make the error unreadable."""

Place: TypeAlias = tuple[str | int, ...]
"""Position in a document: keys and list indices from the top."""
Checks: TypeAlias = Mapping[str, Callable[[Any], Any]]
"""By the name of a field, a function that returns the field's content, or raises UsageError."""
VERSION: Final = 1
"""Version of both kinds of documents, written and required."""
_KEY: Final = "paramclient"
"""The key with the version of a document of plain parameters."""
_EXT_KEY: Final = "paramclient_extended"
"""The key with the version of a document of extended parameters."""
_NUMBER_EXPECTED: Final = "expected a number (or NaN, Infinity, 0x and 8 digits for raw bytes)"
_CUSTOM: Final = ParamType.CUSTOM
_EXT_PREFIX: Final = "EXT_"
"""Begins the name of an unknown type of extended parameters: EXT_TYPE_77."""
_WORDS: Final = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
_raw: Final = re.compile(r"0x([0-9a-fA-F]{8})").fullmatch
_type_number: Final = re.compile(r"TYPE_([0-9]{1,3})").fullmatch
_bits: Final = re.compile(r"[0-9a-fA-F]{8}(?:[0-9a-fA-F]{8})?").fullmatch


# Documents


def read_json_text(text: str, source: str) -> Any:
    """Return the content of a JSON text without repeated keys.

    Raises:
        FileError: invalid JSON, or a repeated key.
    """
    if (byte := undecoded_byte(text)) is not None:
        raise FileError(byte[1], source=source, line=text.count("\n", 0, byte[0]) + 1)
    try:
        return json.loads(text, object_pairs_hook=_unique, parse_constant=_no_constant)
    except json.JSONDecodeError as error:
        message = f"expected JSON: {error.msg} (column {error.colno})"
        raise FileError(message, source=source, line=error.lineno) from None
    except RecursionError:
        raise FileError("the document is nested too deep", source=source) from None
    except ValueError as error:
        line = _line_of(text, error.args[1], last=True) if len(error.args) > 1 else None
        raise FileError(str(error.args[0]), source=source, line=line) from None


def _fault(reading: Reading, place: Place, what: str, *, is_name: bool = False) -> None:
    """Add a fault at a position of the document."""
    line = None
    if "params" in place[:-1] and not reading.is_full:
        line = _line_of(reading.text, str(place[place.index("params") + 1]))
    described = f"{'.'.join(map(str, place)) or 'the document'}: {what}"
    if len(described) > FAULT_LENGTH_MAX:
        described = f"{described[:FAULT_LENGTH_MAX]}…"
    reading.fault(line, described, is_name=is_name)


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


def _no_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is not valid JSON; write it as text: {json.dumps(word)}")


def _line_of(text: str, key: str, *, last: bool = False) -> int | None:
    """Return the line of a key, if the key occurs once or the last occurrence is meant."""
    places = [match.start() for match in re.finditer(rf'"{re.escape(key)}"[ \t]*:', text)]
    return text.count("\n", 0, places[-1]) + 1 if places and (last or len(places) == 1) else None


# Reading


def read_json(reading: Reading, file_format: FileFormat) -> ParamFile:
    """Read a document of plain or of extended parameters.

    Raises:
        FileError: invalid JSON, a repeated key, or not a valid document. The error names up to 20 faults.
    """
    content = read_json_text(reading.text, reading.source)
    if not isinstance(content, dict) or not content.keys() & {_KEY, _EXT_KEY}:
        raise FileError("not a parameter file of paramclient (JSON)", source=reading.source)
    if _EXT_KEY in content:
        known = {key: each for key, each in content.items() if key in _EXT_DOCUMENT}
        return reading.file(file_format, sets=(_set(reading, known, ()),))
    fields = _checked(reading, content, (), _DOCUMENT, {_KEY, "sets"})
    sets = [_set(reading, each, ("sets", place)) for place, each in enumerate(fields.get("sets", []))]
    return reading.file(file_format, tuple(fields.get("header", [])), sets=tuple(sets))


def _set(reading: Reading, content: object, place: Place) -> ParamSet:
    """Return the set at a position, without invalid fields; at the top, that of extended parameters."""
    is_extended = not place
    fields = _checked(reading, content, place, _EXT_DOCUMENT if is_extended else _SET, {"params"})
    params = {}
    for name, each in fields.get("params", {}).items():
        at = (*place, "params", name)
        try:
            if not is_portable_name(check_name(name)) and is_extended:
                raise UsageError("no name of a parameter")
        except UsageError as error:
            _fault(reading, at, str(error), is_name=True)
            continue
        try:
            param = _ext_param(name, each) if is_extended else _param(reading, name, each, at)
        except ValueError as error:
            _fault(reading, at, str(error))
            continue
        if param is not None:
            params[name] = param
    identity = None
    if "identity" in fields:
        known = _checked(reading, fields["identity"], (*place, "identity"), _IDENTITY, {"system"})
        identity = Identity(**known) if "system" in known else None
    ids = fields.get("component"), fields.get("system")
    return ParamSet(params, *ids, identity, fields.get("at"), reading.source, is_extended)


def _param(reading: Reading, name: str, content: object, place: Place) -> WrittenParam | None:
    """Return a plain parameter; None, with faults, if a field is not valid.

    Raises:
        UsageError: the fields contradict each other.
    """
    before = reading.fault_count
    fields = _checked(reading, content, place, _PARAM, {"value"})
    if reading.fault_count > before:
        return None
    value, kind, default = fields["value"], fields.get("type"), fields.get("default")
    if kind is not None:
        value = as_type(value, kind)
        default = None if default is None else as_type(default, kind)
    if "bits" in fields:
        value = _with_bits(value, kind, fields["bits"])
    return WrittenParam(
        name, value, kind, default, fields.get("comment", ""), is_raw=isinstance(value, bytes)
    )


def _ext_param(name: str, fields: object) -> WrittenParam:
    """Return an extended parameter: `value` or `hex`, and `type`.

    Raises:
        ValueError: a field is not valid.
    """
    if not isinstance(fields, dict) or not {"type"} <= fields.keys() <= {"value", "hex", "type"}:
        raise ValueError("expected value or hex, and type")
    written = fields.get("type")
    number = _CUSTOM if written == _CUSTOM.name else _type(written, _EXT_PREFIX)
    if ("value" in fields) == ("hex" in fields):
        raise ValueError("expected either value or hex")
    if "hex" in fields:
        raw = bytes.fromhex(_text(fields["hex"]))
        if len(raw) > EXT_VALUE_SIZE or own_bytes(raw, number) != raw:
            raise ValueError(f"hex is not a value of type {type_name(number)}")
        return WrittenParam.of(ext_param(name, raw, number))
    value = fields["value"]
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError("the value must be a number or text")
    if number != _CUSTOM and isinstance(value, str):
        value = _WORDS.get(value, value)
    return WrittenParam.of(ext_param(name, encode_ext_value(check_ext_value(value), number), number))


def _whole(low: int, high: float, words: str) -> Callable[[Any], Any]:
    return _expected(lambda content: type(content) is int and low <= content <= high, words)


_text: Final = _expected(lambda content: isinstance(content, str), "text")
_list: Final = _expected(lambda content: isinstance(content, list), "a list")
_object: Final = _expected(lambda content: isinstance(content, dict), "an object")
_count: Final = _whole(0, math.inf, "a whole number from 0")
_id: Final = _whole(1, 255, "an id from 1 to 255")
_component: Final = _whole(0, 255, "an id from 0 to 255")
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
    return moment.timestamp()


def _type(content: object, prefix: str = "") -> ParamType | int:
    text = _text(content)
    if text in TYPES_BY_NAME:
        return TYPES_BY_NAME[text]
    if text.startswith(prefix) and (match := _type_number(text.removeprefix(prefix))):
        number = int(match[1])
        if number <= 255 and number not in TYPES_BY_NAME.values():
            return number
    raise UsageError(f"unknown type {text!r}; the types are {', '.join(TYPES_BY_NAME)}")


def _number(content: object) -> WireValue:
    if isinstance(content, str):
        if content in _WORDS:
            return _WORDS[content]
        if match := _raw(content):
            return int(match[1], 16).to_bytes(4, "little")
    elif isinstance(content, int | float) and not isinstance(content, bool):
        if not math.isinf(content):
            return content
        raise UsageError("the number is beyond the range of a double")
    raise UsageError(f"{_NUMBER_EXPECTED}{_found(content)}")


def _with_bits(value: WireValue, kind: ParamType | int | None, text: str) -> WireValue:
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
    "component": _component,
    "identity": _object,
    "at": _time,
    "source": _text,
    "params": _object,
}
_IDENTITY: Final[Checks] = {
    "system": _id,
    "link": _text,
    "uid": _text,
    "git_hash": _text,
    **dict.fromkeys(
        ("autopilot", "vehicle_type", "firmware", "board", "vendor_id", "product_id", "capabilities"), _count
    ),
}
_PARAM: Final[Checks] = {
    "value": _number,
    "type": _type,
    "bits": _text,
    "default": _number,
    "comment": _text,
}
_EXT_DOCUMENT: Final[Checks] = {_EXT_KEY: _version, **_SET}


# Writing


def write_json(sets: Sequence[ParamSet], around: ParamFile) -> Iterator[str]:
    """Generate the lines of a document: of one set of extended parameters, or of sets of plain ones.

    Raises:
        UsageError: a NaN with payload bits has no type.
    """
    if sets[0].is_extended:
        yield from _set_lines(sets[0], {_EXT_KEY: VERSION}, "")
        return
    header = [_encodable(line) for line in (*around.header, *around.footer)]
    yield "{"
    yield f'  "{_KEY}": {VERSION},'
    if header:
        yield f'  "header": {_json(header)},'
    yield '  "sets": ['
    for number, each in enumerate(sets, start=1):
        *lines, last = _set_lines(each, {}, "    ")
        yield from (*lines, f"{last}," if number < len(sets) else last)
    yield "  ]"
    yield "}"


def _set_lines(params: ParamSet, first: Mapping[str, object], indent: str) -> Iterator[str]:
    """Generate the lines of the object of a set."""
    fields = {
        **first,
        "system": params.system,
        "component": params.component,
        "at": None if params.at is None else time_of(params.at),
        "source": _encodable(params.source) or None,
        "identity": None if params.identity is None else asdict(params.identity),
    }
    yield f"{indent}{{"
    for key, content in fields.items():
        if content is not None:
            yield f"{indent}  {_json(key)}: {_json(content)},"
    yield f'{indent}  "params": {{'
    for number, param in enumerate(params.values(), start=1):
        comma = "," if number < len(params) else ""
        yield f"{indent}    {_json(param.name)}: {_json(json_fields(params, param))}{comma}"
    yield f"{indent}  }}"
    yield f"{indent}}}"


def json_fields(params: ParamSet, param: WrittenParam) -> dict[str, object]:
    """Return the fields of a parameter, or raise UsageError if the format cannot express it."""
    return _ext_fields(param) if params.is_extended else _fields(param)


def _fields(param: WrittenParam) -> dict[str, object]:
    fields: dict[str, object] = {"value": value_written(param.settable, param)}
    if param.type_number is not None:
        param.bits_as(param.type_number)  # raises UsageError if the value does not fit
        fields["type"] = _type_text(param)
        fields["bits"] = bits_written(param)
    elif isinstance(param.value, float) and not is_plain(param.value):
        raise UsageError(f"{param.name} is a NaN with payload bits, and has no type for them")
    if param.default is not None:
        fields["default"] = value_written(param.default, param)
    if param.comment:
        fields["comment"] = _encodable(param.comment)
    return fields


def _type_text(param: WrittenParam) -> str:
    number = param.type_number or ParamType.UNKNOWN
    return f"TYPE_{number}" if param.type is ParamType.UNKNOWN else type_name(number)


def _ext_fields(param: WrittenParam) -> dict[str, object]:
    """Return the fields of an extended parameter; reading them gives the same bytes."""
    number = param.type_number or ParamType.UNKNOWN
    value, raw = param.settable, encode_ext_value(param.settable, number)
    kind = type_name(number)
    if param.type is ParamType.UNKNOWN:
        kind = _EXT_PREFIX + kind
    if isinstance(value, float):
        written = value_json(value, ParamType(number))
        if not isinstance(written, str) or encode_ext_value(_WORDS[written], number) == raw:
            return {"value": written, "type": kind}  # else a NaN with payload bits
    elif not isinstance(value, bytes):
        return {"value": value, "type": kind}
    return {"hex": raw.hex(), "type": kind}


def _encodable(text: str) -> str:
    """Return text without lone surrogates, which a file name may have and a document may not."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def _json(content: object) -> str:
    return json.dumps(content, allow_nan=False)
