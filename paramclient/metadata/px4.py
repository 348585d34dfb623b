"""Descriptions in the schema of MAVLink's component metadata, which PX4 uses: parameters.json.

Source of the schema: `parameter.schema.json` and `general.schema.json` of MAVLink. PX4 says version 1,
later ones only add to it. Fields that are not known here are passed over, as MAVLink asks.
"""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import Annotated, Final, NotRequired, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, with_config
from typing_extensions import TypedDict  # pydantic, whose own it is, takes no other before Python 3.12

from paramclient.errors import MetadataError
from paramclient.metadata.info import MOST_BITS, Metadata, ParamInfo
from paramclient.model.values import ParamType

__all__ = ["MetadataFile", "read_general", "read_parameters", "told", "whole"]

MOST_PARAMS: Final = 65_535
"""As many as a vehicle can count."""
MOST_NAMES: Final = 10_000
"""Values of one parameter that have names."""
MOST_FILES: Final = 1_000
"""Kinds of metadata; MAVLink has six."""
MOST_DECIMALS: Final = 50
"""Places behind the point; a float32 has no use for more."""

_STRICT: Final = ConfigDict(strict=True, frozen=True)
Model = TypeVar("Model", bound=BaseModel)


class _Strict(BaseModel):
    """No text counts as a number, and no number as a flag."""

    model_config = _STRICT


# no models: there are many of them, and a model takes three times the memory
@with_config(_STRICT)
class _Named(TypedDict):
    value: float
    description: NotRequired[str]


@with_config(_STRICT)
class _Bit(TypedDict):
    index: Annotated[int, Field(ge=0, lt=MOST_BITS)]
    description: NotRequired[str]


class _Parameter(_Strict):
    name: str = Field(min_length=1, max_length=16)
    type: str = ""
    short: str = Field("", alias="shortDesc")
    long: str = Field("", alias="longDesc")
    units: str = ""
    minimum: float | None = Field(None, alias="min")
    maximum: float | None = Field(None, alias="max")
    increment: float | None = None
    decimals: int | None = Field(None, alias="decimalPlaces", ge=0, le=MOST_DECIMALS)
    default: float | None = None
    values: list[_Named] = Field([], max_length=MOST_NAMES)
    bits: list[_Bit] = Field([], alias="bitmask", max_length=MOST_BITS)
    reboot_required: bool = Field(False, alias="rebootRequired")
    is_read_only: bool = Field(False, alias="readOnly")
    is_volatile: bool = Field(False, alias="volatile")
    category: str = ""
    group: str = ""

    def info(self) -> ParamInfo:
        low, high = _finite(self.minimum), _finite(self.maximum)
        if low is not None and high is not None and low > high:
            low = high = None
        values = {whole(each["value"]): each.get("description") for each in self.values}
        bits = {each["index"]: each.get("description") for each in self.bits}
        return ParamInfo(
            self.name,
            _TYPES.get(self.type),
            self.short,
            self.long,
            self.units,
            low,
            high,
            _finite(self.increment),
            self.decimals,
            None if self.default is None else whole(self.default),
            MappingProxyType(
                {value: name for value, name in values.items() if name and math.isfinite(value)}
            ),
            MappingProxyType({bit: name for bit, name in bits.items() if name}),
            self.reboot_required,
            self.is_read_only,
            self.is_volatile,
            self.category,
            self.group,
        )


class _Parameters(_Strict):
    version: int = Field(ge=1)
    parameters: list[_Parameter] = Field(max_length=MOST_PARAMS)


class MetadataFile(_Strict):
    """Where one kind of description lies.

    Attributes:
        type: COMP_METADATA_TYPE; 1 for that of parameters.
        uri: where: `mftp://…` on board, or `https://…`.
        crc: the CRC-32 of the file there, or None where it may change.
        fallback_uri, fallback_crc: another place, or "" and None.
    """

    type: int
    uri: str
    crc: int | None = Field(None, alias="fileCrc", ge=0, lt=1 << 32)
    fallback_uri: str = Field("", alias="uriFallback")
    fallback_crc: int | None = Field(None, alias="fileCrcFallback", ge=0, lt=1 << 32)


class _General(_Strict):
    version: int = Field(ge=1)
    files: list[MetadataFile] = Field(alias="metadataTypes", max_length=MOST_FILES)


def read_parameters(document: object, *, source: str) -> Metadata:
    """Take a parameters.json, its JSON read.

    Raises:
        MetadataError: it is none, or breaks its schema.
    """
    read = _read(_Parameters, document, source)
    return Metadata.of((each.info() for each in read.parameters), source=source)


def read_general(document: object, *, source: str) -> tuple[MetadataFile, ...]:
    """Take a general metadata file, its JSON read: what else there is, and where.

    Raises:
        MetadataError: it is none, or breaks its schema.
    """
    return tuple(_read(_General, document, source).files)


def whole(number: int | float) -> int | float:
    """A number as an int, where it is whole."""
    return int(number) if isinstance(number, float) and number.is_integer() else number


def told(error: ValidationError) -> str:
    """What was found first, in words: behind the name of the file."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = "".join(f"[{each}]" if isinstance(each, int) else f".{each}" for each in first["loc"])
    return f"{', ' if place else ''}{place.lstrip('.')}: {first['msg']}"


def _read(model: type[Model], document: object, source: str) -> Model:
    try:
        return model.model_validate(document)
    except ValidationError as error:
        raise MetadataError(f"{source}{told(error)}", source=source) from None


def _finite(number: float | None) -> int | float | None:
    return None if number is None or not math.isfinite(number) else whole(number)


_TYPES: Final = {
    "Uint8": ParamType.UINT8,
    "Int8": ParamType.INT8,
    "Uint16": ParamType.UINT16,
    "Int16": ParamType.INT16,
    "Uint32": ParamType.UINT32,
    "Int32": ParamType.INT32,
    "Float": ParamType.REAL32,
}
