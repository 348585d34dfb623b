"""Metadata files: PX4's parameters.json, ArduPilot's apm.pdef.xml and apm.pdef.json.

PX4's has the schema of MAVLink's component metadata (`parameter.schema.json` and `general.schema.json`). PX4
uses version 1; later versions only add fields. Unknown fields are ignored, as MAVLink requires.

ArduPilot's build generates its files from source comments (`Tools/autotest/param_metadata`: xmlemit.py,
jsonemit.py). The texts are written by hand: a range or a list that cannot be parsed as numbers is left out. A
file with another structure is rejected.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Annotated, Any, Final, NotRequired, TypeAlias, TypeVar
from xml.etree.ElementTree import Element, ParseError, iterparse

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, with_config
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from paramclient.errors import UsageError
from paramclient.metadata.info import BITS_MAX, Metadata, ParamInfo, finite, number_of, whole
from paramclient.model.values import ParamType

# PX4

_STRICT: Final = ConfigDict(strict=True, frozen=True)
Model = TypeVar("Model", bound=BaseModel)


class _Strict(BaseModel):
    """Strict types: text is not converted to numbers, nor numbers to booleans."""

    model_config = _STRICT


# TypedDicts, because a file has many of them and a model takes three times the memory.
@with_config(_STRICT)
class _Named(TypedDict):
    value: float
    description: NotRequired[str]


@with_config(_STRICT)
class _Bit(TypedDict):
    index: Annotated[int, Field(ge=0, lt=BITS_MAX)]
    description: NotRequired[str]


def _values_of(given: list[_Named]) -> Mapping[int | float, str]:
    named = {finite(each["value"]): each.get("description") for each in given}
    return {value: name for value, name in named.items() if name and value is not None}


def _bits_of(given: list[_Bit]) -> Mapping[int, str]:
    return {each["index"]: name for each in given if (name := each.get("description"))}


_Number: TypeAlias = Annotated[float | None, AfterValidator(finite)]


class _Parameter(_Strict):
    """A parameter. The fields that are given are those of a ParamInfo."""

    name: str = Field(min_length=1, max_length=16)
    type: Annotated[str, AfterValidator(lambda name: _TYPES.get(name))] = ""
    short_description: str = Field("", alias="shortDesc")
    long_description: str = Field("", alias="longDesc")
    units: str = ""
    minimum: _Number = Field(None, alias="min")
    maximum: _Number = Field(None, alias="max")
    increment: _Number = None
    decimals: int | None = Field(None, alias="decimalPlaces", ge=0)
    default: Annotated[float | None, AfterValidator(whole)] = None
    values: Annotated[list[_Named], AfterValidator(_values_of)] = Field([])
    bits: Annotated[list[_Bit], AfterValidator(_bits_of)] = Field([], alias="bitmask", max_length=BITS_MAX)
    reboot_required: bool = Field(False, alias="rebootRequired")
    is_read_only: bool = Field(False, alias="readOnly")
    is_volatile: bool = Field(False, alias="volatile")
    category: str = ""
    group: str = ""

    def info(self) -> ParamInfo:
        fields: dict[str, Any] = {name: getattr(self, name) for name in self.model_fields_set}
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            fields |= {"minimum": None, "maximum": None}
        return ParamInfo(**fields)


class _Parameters(_Strict):
    version: int = Field(ge=1)
    parameters: list[_Parameter]


class MetadataFile(_Strict):
    """The address of one kind of metadata.

    Attributes:
        type: COMP_METADATA_TYPE; 1 for parameters.
        uri: `mftp://…` for a file on board, or `https://…`.
        crc: the CRC-32 of the file, or None if the file may change.
        fallback_uri, fallback_crc: a second address, or "" and None.
    """

    type: int
    uri: str
    crc: int | None = Field(None, alias="fileCrc", ge=0, lt=1 << 32)
    fallback_uri: str = Field("", alias="uriFallback")
    fallback_crc: int | None = Field(None, alias="fileCrcFallback", ge=0, lt=1 << 32)


class _General(_Strict):
    version: int = Field(ge=1)
    files: list[MetadataFile] = Field(alias="metadataTypes")


def read_parameters(document: object) -> Metadata:
    """Read a parameters.json that has been parsed as JSON.

    Raises:
        UsageError: the document does not follow the schema.
    """
    return Metadata.of(each.info() for each in validated(_Parameters, document).parameters)


def read_general(document: object) -> tuple[MetadataFile, ...]:
    """Read a general metadata file that has been parsed as JSON: kinds of metadata and their addresses.

    Raises:
        UsageError: the document does not follow the schema.
    """
    return tuple(validated(_General, document).files)


def validated(model: type[Model], document: object, within: tuple[int | str, ...] = ()) -> Model:
    """Return a part of a document as an instance of a model.

    Args:
        model: the model.
        document: the part.
        within: the place of the part in the file.

    Raises:
        UsageError: the part is invalid, with the place of the first problem.
    """
    try:
        return model.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        steps = (*within, *first["loc"])
        place = "".join(f"[{each}]" if isinstance(each, int) else f".{each}" for each in steps)
        raise UsageError(f"{place.lstrip('.')}{': ' if place else ''}{first['msg']}") from None


_TYPES: Final = {kind.name.capitalize(): kind for kind in ParamType if kind.is_integer} | {
    "Float": ParamType.REAL32
}


# ArduPilot


def read_xml(content: bytes) -> Metadata:
    """Read an apm.pdef.xml.

    Rejects document type declarations, and with them entities: the files have none.

    Raises:
        UsageError: the file is invalid.
    """
    if b"<!DOCTYPE" in content:
        raise UsageError("has a document type (<!DOCTYPE …>), which ArduPilot's files do not have")
    try:
        return _gathered(_infos_of_xml(content))
    except UsageError:
        raise
    except (ParseError, ValueError, LookupError) as error:
        raise UsageError(f"not XML: {error}") from None


def read_json(document: dict[str, object]) -> Metadata:
    """Read an apm.pdef.json that has been parsed as JSON.

    Raises:
        UsageError: the document is invalid.
    """
    if document.get("json") is None:
        raise UsageError('has no "json" member, which ArduPilot\'s files have')
    return _gathered(_infos_of_json(document))


def _infos_of_json(document: dict[str, object]) -> Iterator[ParamInfo]:
    for group, described in document.items():
        if group == "json":
            continue
        if not isinstance(described, dict):
            raise UsageError(f"{group:.40}: Input should be a valid dictionary")
        for name, each in described.items():
            yield validated(_Described, each, (group, name)).info(name, group)


def _infos_of_xml(content: bytes) -> Iterator[ParamInfo]:
    """Generate the parameters; each element is freed once it has been read."""
    group, param = "", None
    for number, (event, element) in enumerate(iterparse(io.BytesIO(content), ["start", "end"])):
        if not number and element.tag != "paramfile":
            raise UsageError(f"begins with <{element.tag}>, not with <paramfile> as ArduPilot's files")
        if event == "start" and element.tag == "parameters":
            group = element.get("name", "")
        elif event == "start" and element.tag == "param":
            if param is not None:
                raise UsageError(f"has a parameter inside {param}")
            param = element.get("name", "")
            if not param.rpartition(":")[2]:
                raise UsageError("has a parameter without a name")
        elif event == "end" and element.tag == "param" and param is not None:
            yield validated(_Described, _fields_of_xml(element), (group, param)).info(param, group)
            param = None
            element.clear()


def _fields_of_xml(element: Element) -> dict[str, object]:
    """Return the fields of a parameter as they are in the JSON."""

    def texts(tag: str, key: str) -> dict[str, str]:
        return {each.get(key, ""): "".join(each.itertext()) for each in element.iter(tag)}

    fields: dict[str, object] = dict(texts("field", "name"))
    fields["DisplayName"] = element.get("humanName", "")
    fields["Description"] = element.get("documentation", "")
    fields["User"] = element.get("user", "")
    for name, tag in (("Values", "value"), ("Bitmask", "bit")):
        fields[name] = texts(tag, "code") or fields.get(name, "")
    return fields


_ITEM: Final = re.compile(r",(?=\s*[+-]?[0-9.]+\s*:)")
"""Separator of items: a comma before a number and a colon, as a name may contain commas."""


def _range(span: Mapping[str, str] | str) -> tuple[int | float | None, int | float | None]:
    text = span if isinstance(span, str) else f"{span.get('low', '')} {span.get('high', '')}"
    parts = text.replace(",", " ").split()
    low, high = (_number(part) for part in parts) if len(parts) == 2 else (None, None)
    return (None, None) if low is None or high is None or low > high else (low, high)


def _named(items: Mapping[str, str] | str) -> dict[int | float, str]:
    """Return the names of values or bits; a text is `0:Disabled,1:Enabled`, and empty in another format."""
    if isinstance(items, str):
        parts = [each.partition(":") for each in _ITEM.split(items)]
        items = {code: name for code, _, name in parts} if all(colon for _, colon, _ in parts) else {}
    named = {_number(code): name.strip() for code, name in items.items()}
    return {code: name for code, name in named.items() if code is not None and name}


def _named_bits(items: Mapping[str, str] | str) -> Mapping[int, str]:
    return {bit: name for bit, name in _named(items).items() if isinstance(bit, int) and 0 <= bit < BITS_MAX}


def _number(text: str) -> int | float | None:
    """Return a finite number, whole numbers as int; None for other text."""
    with suppress(UsageError):
        return finite(number_of(text))
    return None


_Names: TypeAlias = dict[str, str] | str
_Flag: TypeAlias = Annotated[str, AfterValidator(lambda text: text.strip().lower() == "true")]


class _Described(BaseModel):
    """A parameter in the JSON. A field that the build could not parse is one text.

    The fields that are given are those of a ParamInfo, except for the range.
    """

    short_description: str = Field("", alias="DisplayName")
    long_description: str = Field("", alias="Description")
    category: str = Field("", alias="User")
    units: str = Field("", alias="Units")
    range: Annotated[_Names, AfterValidator(_range)] = Field("", alias="Range")
    increment: Annotated[str, AfterValidator(_number)] = Field("", alias="Increment")
    values: Annotated[_Names, AfterValidator(_named)] = Field("", alias="Values")
    bits: Annotated[_Names, AfterValidator(_named_bits)] = Field("", alias="Bitmask")
    reboot_required: _Flag = Field("", alias="RebootRequired")
    is_read_only: _Flag = Field("", alias="ReadOnly")
    is_volatile: _Flag = Field("", alias="Volatile")

    def info(self, name: str, group: str) -> ParamInfo:
        """Return the description; the name may be that of the vehicle, a colon and the parameter's."""
        fields: dict[str, Any] = {each: getattr(self, each) for each in self.model_fields_set}
        low, high = fields.pop("range", (None, None))
        return ParamInfo(name.rpartition(":")[2], minimum=low, maximum=high, group=group, **fields)


def _gathered(found: Iterable[ParamInfo]) -> Metadata:
    """Return the parameters of all groups. Leaves out those that two vehicles describe differently."""
    infos: dict[str, ParamInfo] = {}
    doubtful = set()
    for info in found:
        before = infos.setdefault(info.name, info)
        if replace(before, group="") != replace(info, group=""):
            doubtful.add(info.name)
    if not infos:
        raise UsageError("describes no parameters")
    return Metadata.of(info for info in infos.values() if info.name not in doubtful)
