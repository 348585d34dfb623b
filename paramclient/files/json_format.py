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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import FileFormat, ParamFile, TooManyParams
from paramclient.files.json_reader import Checks, Place, Reader, between, found, read_json_text, typed
from paramclient.files.text import as_type, is_plain, time_of
from paramclient.model.ext_values import (
    EXT_VALUE_SIZE,
    check_ext_value,
    encode_ext_value,
    ext_param,
    own_bytes,
)
from paramclient.model.identity import Identity
from paramclient.model.notation import value_json, value_written
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import (
    TYPES_BY_NAME,
    ParamType,
    WireValue,
    check_name,
    from_bits,
    is_portable_name,
    type_name,
)

__all__ = [
    "read_json",
    "write_json",
]

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
_date: Final = re.compile(r"[0-9]{4}-[0-9]{2}-").match
_bits: Final = re.compile(r"[0-9a-fA-F]{8}(?:[0-9a-fA-F]{8})?").fullmatch


# Reading


def read_json(text: str, source: str, params_max: int | None = None) -> ParamFile:
    """Read a document of plain or of extended parameters.

    Raises:
        TooManyParams: the document has more parameters than `params_max`.
        FileError: invalid JSON, a repeated key, or not a valid document. The error names up to 20 problems.
    """
    content = read_json_text(text, source)
    reader = Reader(text, source)
    if isinstance(content, dict) and _EXT_KEY in content:
        return ParamFile((_ext_set(reader, content, params_max),), FileFormat.JSON, source)
    document = reader.fields(content, (), _DOCUMENT, {_KEY, "sets"})
    raw_sets = document.get("sets", [])
    named = [each.get("params") for each in raw_sets if isinstance(each, dict)]
    TooManyParams.check(sum(len(each) for each in named if isinstance(each, dict)), params_max, source)
    sets = tuple(_set(reader, each, ("sets", place)) for place, each in enumerate(raw_sets))
    reader.problems.raise_if_any()
    if not any(sets):
        raise FileError("the file contains no parameters", source=source)
    return ParamFile(sets, FileFormat.JSON, source, tuple(document.get("header", [])))


def _ext_set(reader: Reader, content: Mapping[str, object], params_max: int | None) -> ParamSet:
    """Return the set of a document of extended parameters."""
    source = reader.problems.source
    known = {key: each for key, each in content.items() if key in _EXT_DOCUMENT}
    head = reader.fields(known, (), _EXT_DOCUMENT, {"params"})
    TooManyParams.check(len(head.get("params", {})), params_max, source)
    params = {}
    for name, fields in head.get("params", {}).items():
        try:
            params[name] = _ext_param(name, fields)
        except ValueError as error:
            reader.problem(("params", name), str(error))
    reader.problems.raise_if_any()
    if not params:
        raise FileError("the file contains no parameters", source=source)
    ids = head.get("component"), head.get("system")
    return ParamSet(params, *ids, None, head.get("at"), source, is_extended=True)


def _set(reader: Reader, content: object, place: Place) -> ParamSet:
    """Return the set at a position, without invalid fields."""
    fields = reader.fields(content, place, _SET, {"params"})
    params = {}
    for name, each in fields.get("params", {}).items():
        param = _param(reader, name, each, (*place, "params", name))
        if param is not None:
            params[name] = param
    identity = None
    if "identity" in fields:
        known = reader.fields(fields["identity"], (*place, "identity"), _IDENTITY, {"system"})
        identity = Identity(**known) if "system" in known else None
    system, component = fields.get("system"), fields.get("component")
    return ParamSet(params, component, system, identity, fields.get("at"), reader.problems.source)


def _param(reader: Reader, name: str, content: object, place: Place) -> WrittenParam | None:
    before = reader.problems.count
    fields = reader.fields(content, place, _PARAM, {"value"})
    if reader.problems.count > before:
        return None
    value, kind, default = fields["value"], fields.get("type"), fields.get("default")
    try:
        if kind is not None:
            value = as_type(value, kind)
            default = None if default is None else as_type(default, kind)
        if "bits" in fields:
            value = _with_bits(value, kind, fields["bits"])
        comment, is_raw = fields.get("comment", ""), isinstance(value, bytes)
        return WrittenParam(check_name(name), value, kind, default, comment, is_raw=is_raw)
    except UsageError as error:
        reader.problem(place, str(error))
        return None


def _ext_param(name: str, fields: object) -> WrittenParam:
    """Return the parameter that a document has under a name: `value` or `hex`, and `type`.

    Raises:
        ValueError: a field is not valid.
    """
    if not isinstance(name, str) or not is_portable_name(name):
        raise ValueError(f"{name!r:.40} is no name of a parameter")
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


_text: Final = typed(str, "text")
_list: Final = typed(list, "a list")
_object: Final = typed(dict, "an object")
_count: Final = between(0, math.inf, "a whole number from 0")
_id: Final = between(1, 255, "an id from 1 to 255")
_component: Final = between(0, 255, "an id from 0 to 255")
_version: Final = between(VERSION, VERSION, f"{VERSION}, the version of the format")


def _texts(content: object) -> list[str]:
    return [_text(each) for each in _list(content)]


def _time(content: object) -> float:
    if not isinstance(content, str) or not _date(content):  # a number could be seconds or milliseconds
        raise UsageError(f"a time is written as 2026-01-31T12:00:00Z{found(content)}")
    try:
        moment = datetime.fromisoformat(content.upper())
    except ValueError as error:
        raise UsageError(f"{error}{found(content)}") from None
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
    if isinstance(content, int | float) and not isinstance(content, bool):
        return content
    if isinstance(content, str):
        if content in _WORDS:
            return _WORDS[content]
        if match := _raw(content):
            return int(match[1], 16).to_bytes(4, "little")
    raise UsageError(f"{_NUMBER_EXPECTED}{found(content)}")


def _with_bits(value: WireValue, kind: ParamType | int | None, text: str) -> WireValue:
    """Return the value of the bits, if it agrees with the given value; else raise UsageError."""
    if kind is None:
        raise UsageError("bits need a type")
    if not _bits(text):
        raise UsageError(f"bits are 8 or 16 hexadecimal digits, not {text!r}")
    bits = int(text, 16)
    size = kind.size if isinstance(kind, ParamType) and not isinstance(value, bytes) else 4
    if bits >= 1 << 8 * size:
        raise UsageError(f"bits {text} exceed the size of the type")
    exact = from_bits(bits, kind, is_raw=isinstance(value, bytes))
    both_nan = value != value and exact != exact
    if exact != value and not both_nan:
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
_EXT_DOCUMENT: Final[Checks] = {
    _EXT_KEY: _version,
    "system": _id,
    "component": _component,
    "at": _time,
    "params": _object,
}


# Writing


def write_json(sets: Sequence[ParamSet], around: ParamFile) -> Iterator[str]:
    """Generate the lines of a document: of one set of extended parameters, or of sets of plain ones.

    Raises:
        UsageError: a NaN with payload bits has no type.
    """
    if sets[0].is_extended:
        yield from _ext_lines(sets[0])
        return
    header = [_encodable(line) for line in (*around.header, *around.footer)]
    yield "{"
    yield f'  "{_KEY}": {VERSION},'
    if header:
        yield f'  "header": {_json(header)},'
    yield '  "sets": ['
    for place, each in enumerate(sets):
        yield "    {"
        identity = None if each.identity is None else asdict(each.identity)
        for key, content in {**_about(each), "identity": identity}.items():
            if content is not None:
                yield f"      {_json(key)}: {_json(content)},"
        yield '      "params": {'
        yield from _rows({param.name: _fields(param) for param in each.values()}, "        ")
        yield "      }"
        yield "    }," if place < len(sets) - 1 else "    }"
    yield "  ]"
    yield "}"


def _ext_lines(content: ParamSet) -> Iterator[str]:
    """Generate the lines of a document of extended parameters."""
    yield "{"
    for key, each in {_EXT_KEY: VERSION, **_about(content)}.items():
        if each is not None:
            yield f"  {_json(key)}: {_json(each)},"
    yield '  "params": {'
    yield from _rows({param.name: _ext_fields(param) for param in content.values()}, "    ")
    yield "  }"
    yield "}"


def _about(params: ParamSet) -> dict[str, object]:
    return {
        "system": params.system,
        "component": params.component,
        "at": None if params.at is None else time_of(params.at),
        "source": _encodable(params.source) or None,
    }


def _rows(params: Mapping[str, Mapping[str, object]], indent: str) -> Iterator[str]:
    last = len(params) - 1
    for number, (name, fields) in enumerate(params.items()):
        yield f"{indent}{_json(name)}: {_json(fields)}{',' if number < last else ''}"


def _fields(param: WrittenParam) -> dict[str, object]:
    fields: dict[str, object] = {"value": value_written(param.settable, param)}
    if param.type_number is not None:
        is_wide = param.type is not None and param.type.size == 8
        fields["type"] = _type_text(param)
        fields["bits"] = f"{param.bits_as(param.type_number):0{16 if is_wide else 8}x}"
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
