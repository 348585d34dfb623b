"""Files of extended parameters, as JSON and as YAML: one component, exactly.

    {"paramclient_extended": 1, "system": 1, "component": 100, "at": "2026-01-31T12:00:00Z", "params": {
      "CAM_MODE": {"value": 1, "type": "UINT32"},
      "CAM_NAME": {"value": "Front", "type": "CUSTOM"},
      "CAM_LICENSE": {"hex": "ff00fe", "type": "CUSTOM"}}}

`value` is a number, or text for CUSTOM; "NaN", "Infinity" and "-Infinity" are text too. `hex` has the bytes
of a value that is neither. No format of a ground station can hold such values.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

from paramclient.errors import FileError, UsageError
from paramclient.files.conversion import LARGEST_FILE
from paramclient.files.disk import read_bytes, replace_file
from paramclient.files.document_format import parse_json, parse_yaml, yaml_flow, yaml_key
from paramclient.files.formats import FileFormat, format_of_name
from paramclient.files.text import decode_text, time_of
from paramclient.model.ext_params import (
    EXT_VALUE_SIZE,
    ExtParam,
    ExtParamType,
    ExtValue,
    check_ext_value,
    encode_ext_value,
    ext_type_name,
    ext_type_number,
)
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.values import Trust, is_portable_name, shortest_float

__all__ = ["ext_param_of_fields", "is_extended_file", "read_extended_file", "write_extended_file"]

VERSION_KEY: Final = "paramclient_extended"
"""The key that marks such a document; its value is the version of the format."""
EXT_VERSION: Final = 1
"""Version of the format, written to documents and required in documents that are read."""
EXT_FORMATS: Final = (FileFormat.JSON, FileFormat.YAML)
"""The formats that can hold extended parameters."""

_marked: Final = re.compile(rb"""\A\s*(?:---\s*)?\{?\s*["']?paramclient_extended["']?\s*:""").match
_WORDS: Final = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


def is_extended_file(path: str | os.PathLike[str]) -> bool:
    """Return whether an existing file begins as one of extended parameters.

    Raises:
        FileError: the file cannot be read.
    """
    return _marked(read_bytes(os.fspath(path))[:200]) is not None


def read_extended_file(path: str | os.PathLike[str]) -> ExtParamSet:
    """Read a file of extended parameters. Blocks until the disk has delivered it.

    Raises:
        FileError: the file cannot be read, or is not one of extended parameters; or it is YAML, and PyYAML is
            not installed.
    """
    source = os.fspath(path)
    data = read_bytes(source)
    if len(data) > LARGEST_FILE:
        raise FileError(f"a parameter file has at most {LARGEST_FILE} bytes", source=source)
    text = decode_text(data, source)
    is_json = text.lstrip().startswith("{")
    content = parse_json(text, source) if is_json else parse_yaml(text, source)
    if not isinstance(content, dict) or VERSION_KEY not in content:
        raise FileError(f"no extended parameters: the key {VERSION_KEY} is missing", source=source)
    if content[VERSION_KEY] != EXT_VERSION:
        raise FileError(f"unknown version {content[VERSION_KEY]!r} of the format", source=source)
    try:
        return _file(content, source)
    except (LookupError, TypeError, ValueError) as error:
        reason = error.args[0] if isinstance(error, KeyError) else error
        raise FileError(f"invalid extended parameters: {reason}", source=source) from None


def write_extended_file(
    path: str | os.PathLike[str], content: ExtParamSet, *, file_format: FileFormat | None = None
) -> FileFormat:
    """Write a file of extended parameters, and replace an existing one atomically.

    Args:
        path: the file.
        content: the parameters.
        file_format: the format; None to choose it by the file extension.

    Returns:
        The format of the written file.

    Raises:
        FileError: the format cannot hold extended parameters, the extension is unknown, there are no
            parameters, or writing failed.
    """
    source = os.fspath(path)
    file_format = format_of_name(source) if file_format is None else file_format
    if file_format not in EXT_FORMATS:
        raise FileError(
            f"the format {file_format} cannot hold extended parameters; write .json or .yaml", source=source
        )
    if not content.params:
        raise FileError("there are no parameters to write", source=source)
    lines = _json_lines(content) if file_format is FileFormat.JSON else _yaml_lines(content)
    data = "".join(f"{line}\n" for line in lines).encode()
    replace_file(source, data)
    return file_format


def _head(content: ExtParamSet) -> dict[str, object]:
    about = {
        VERSION_KEY: EXT_VERSION,
        "system": content.system,
        "component": content.component,
        "at": None if content.at is None else time_of(content.at),
        "source": content.source.encode("utf-8", "backslashreplace").decode() or None,
    }
    return {key: each for key, each in about.items() if each is not None}


def _json_lines(content: ExtParamSet) -> Iterator[str]:
    yield "{"
    for key, each in _head(content).items():
        yield f"  {json.dumps(key)}: {json.dumps(each)},"
    yield '  "params": {'
    last = len(content.params) - 1
    for number, param in enumerate(content.params.values()):
        end = "," if number < last else ""
        yield f"    {json.dumps(param.name)}: {json.dumps(_fields(param), allow_nan=False)}{end}"
    yield "  }"
    yield "}"


def _yaml_lines(content: ExtParamSet) -> Iterator[str]:
    for key, each in _head(content).items():
        yield f"{key}: {yaml_flow(each)}"
    yield "params:"
    for param in content.params.values():
        yield f"  {yaml_key(param.name)}: {yaml_flow(_fields(param))}"


def _fields(param: ExtParam) -> dict[str, object]:
    """Return the fields of a parameter; reading them gives the same bytes."""
    value: ExtValue = param.value
    is_exact = True
    if isinstance(value, float):
        if math.isfinite(value):
            value = shortest_float(value) if param.type == ExtParamType.REAL32 else value
        else:
            value = "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
            is_exact = encode_ext_value(_WORDS[value], param.type) == param.raw
    kind = ext_type_name(param.type)
    if isinstance(value, bytes) or not is_exact:
        return {"hex": param.raw.hex(), "type": kind}
    return {"value": value, "type": kind}


def _file(content: Mapping[str, Any], source: str) -> ExtParamSet:
    found = content["params"]
    if not isinstance(found, dict) or not found:
        raise ValueError("params must have parameters by name")
    params = {name: ext_param_of_fields(name, fields) for name, fields in found.items()}
    system, component = content.get("system"), content.get("component")
    for each in (system, component):
        if each is not None and not (isinstance(each, int) and 1 <= each <= 255):
            raise ValueError("system and component are numbers from 1 to 255")
    return ExtParamSet(params, system, component, source=source)


def ext_param_of_fields(name: str, fields: object) -> ExtParam:
    """Return the parameter that a document has under a name: `value` or `hex`, and `type`.

    Raises:
        ValueError: a field is not valid.
    """
    if not isinstance(name, str) or not is_portable_name(name):
        raise ValueError(f"{name!r:.40} is no name of a parameter")
    if not isinstance(fields, dict) or not fields.keys() <= {"value", "hex", "type"}:
        raise ValueError(f"{name}: expected value or hex, and type")
    number = _number_of(name, fields.get("type"))
    if ("value" in fields) == ("hex" in fields):
        raise ValueError(f"{name}: expected either value or hex")
    if "hex" in fields:
        raw = bytes.fromhex(fields["hex"])
        param = ExtParam.of(name, raw, number, None, Trust.CACHED)
        if len(raw) > EXT_VALUE_SIZE or param.raw != raw:
            raise ValueError(f"{name}: hex is not a value of type {ext_type_name(number)}")
        return param
    value = fields["value"]
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"{name}: the value must be a number or text")
    if number != ExtParamType.CUSTOM and isinstance(value, str):
        value = _WORDS.get(value, value)
    try:
        return ExtParam.of(name, encode_ext_value(check_ext_value(value), number), number, None, Trust.CACHED)
    except UsageError as error:
        raise ValueError(f"{name}: {error}") from None


def _number_of(name: str, type_entry: object) -> int:
    try:
        return ext_type_number(type_entry if isinstance(type_entry, str) else repr(type_entry))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
