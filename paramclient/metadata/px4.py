"""Metadata in the schema of MAVLink's component metadata, which PX4 uses: parameters.json.

Source of the schema: `parameter.schema.json` and `general.schema.json` of MAVLink. PX4 uses version 1; later
versions only add fields. Unknown fields are ignored, as MAVLink requires.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, NotRequired, TypeAlias, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, with_config
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from paramclient.errors import UsageError
from paramclient.metadata.info import BITS_MAX, Metadata, ParamInfo, finite, names_of, whole
from paramclient.model.values import ParamType

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


def _values(given: list[_Named]) -> Mapping[int | float, str]:
    named = {finite(each["value"]): each.get("description") for each in given}
    return names_of({value: name for value, name in named.items() if name and value is not None})


def _bits(given: list[_Bit]) -> Mapping[int, str]:
    return names_of({each["index"]: name for each in given if (name := each.get("description"))})


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
    values: Annotated[list[_Named], AfterValidator(_values)] = Field([])
    bits: Annotated[list[_Bit], AfterValidator(_bits)] = Field([], alias="bitmask", max_length=BITS_MAX)
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
