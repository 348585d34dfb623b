"""Metadata in the schema of MAVLink's component metadata, which PX4 uses: parameters.json.

Source of the schema: `parameter.schema.json` and `general.schema.json` of MAVLink. PX4 uses version 1; later
versions only add fields. Unknown fields are ignored, as MAVLink requires.
"""

from __future__ import annotations

from typing import Annotated, Final, NotRequired, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, with_config
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from paramclient.errors import MetadataError
from paramclient.metadata.info import BITS_MAX, Metadata, ParamInfo, finite, names_of, whole
from paramclient.model.values import ParamType

__all__ = ["MetadataFile", "read_general", "read_parameters", "validated"]

PARAMS_MAX: Final = 65_535
"""Parameters of a file: as many as param_count can count."""
VALUE_NAMES_MAX: Final = 10_000
"""Named values of one parameter."""
METADATA_FILES_MAX: Final = 1_000
"""Kinds of metadata; MAVLink has six."""
DECIMALS_MAX: Final = 50
"""Decimal places; a float32 never needs more."""

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


class _Parameter(_Strict):
    name: str = Field(min_length=1, max_length=16)
    type: str = ""
    short: str = Field("", alias="shortDesc")
    long: str = Field("", alias="longDesc")
    units: str = ""
    minimum: float | None = Field(None, alias="min")
    maximum: float | None = Field(None, alias="max")
    increment: float | None = None
    decimals: int | None = Field(None, alias="decimalPlaces", ge=0, le=DECIMALS_MAX)
    default: float | None = None
    values: list[_Named] = Field([], max_length=VALUE_NAMES_MAX)
    bits: list[_Bit] = Field([], alias="bitmask", max_length=BITS_MAX)
    reboot_required: bool = Field(False, alias="rebootRequired")
    is_read_only: bool = Field(False, alias="readOnly")
    is_volatile: bool = Field(False, alias="volatile")
    category: str = ""
    group: str = ""

    def info(self) -> ParamInfo:
        low, high = finite(self.minimum), finite(self.maximum)
        if low is not None and high is not None and low > high:
            low = high = None
        values = {finite(each["value"]): each.get("description") for each in self.values}
        bits = {each["index"]: each.get("description") for each in self.bits}
        return ParamInfo(
            self.name,
            _TYPES.get(self.type),
            self.short,
            self.long,
            self.units,
            low,
            high,
            finite(self.increment),
            self.decimals,
            whole(self.default),
            names_of({value: name for value, name in values.items() if name and value is not None}),
            names_of({bit: name for bit, name in bits.items() if name}),
            self.reboot_required,
            self.is_read_only,
            self.is_volatile,
            self.category,
            self.group,
        )


class _Parameters(_Strict):
    version: int = Field(ge=1)
    parameters: list[_Parameter] = Field(max_length=PARAMS_MAX)


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
    files: list[MetadataFile] = Field(alias="metadataTypes", max_length=METADATA_FILES_MAX)


def read_parameters(document: object, *, source: str) -> Metadata:
    """Read a parameters.json that has been parsed as JSON.

    Raises:
        MetadataError: the document does not follow the schema.
    """
    read = validated(_Parameters, document, source)
    return Metadata.of((each.info() for each in read.parameters), source=source)


def read_general(document: object, *, source: str) -> tuple[MetadataFile, ...]:
    """Read a general metadata file that has been parsed as JSON: kinds of metadata and their addresses.

    Raises:
        MetadataError: the document does not follow the schema.
    """
    return tuple(validated(_General, document, source).files)


def validated(model: type[Model], document: object, source: str, within: tuple[int | str, ...] = ()) -> Model:
    """Return a part of a document as an instance of a model.

    Args:
        model: the model.
        document: the part.
        source: the file, for errors.
        within: the place of the part in the file.

    Raises:
        MetadataError: the part is invalid, with the place of the first problem.
    """
    try:
        return model.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        steps = (*within, *first["loc"])
        place = "".join(f"[{each}]" if isinstance(each, int) else f".{each}" for each in steps)
        comma = ", " if place else ""
        raise MetadataError(f"{source}{comma}{place.lstrip('.')}: {first['msg']}", source=source) from None


_TYPES: Final = {
    "Uint8": ParamType.UINT8,
    "Int8": ParamType.INT8,
    "Uint16": ParamType.UINT16,
    "Int16": ParamType.INT16,
    "Uint32": ParamType.UINT32,
    "Int32": ParamType.INT32,
    "Float": ParamType.REAL32,
}
