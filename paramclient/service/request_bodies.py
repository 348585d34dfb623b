"""Models of request bodies, and the values and parameter sets in them."""

from __future__ import annotations

import base64
import binascii
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StrictFloat, StrictInt, model_validator

from paramclient.errors import UsageError
from paramclient.files import FileFormat, ParamFile, loads
from paramclient.metadata.info import number_of
from paramclient.model.ext_values import check_ext_value, encode_ext_value, ext_param
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import Param, ParamType, WireValue, check_name, from_bits, type_name

if TYPE_CHECKING:
    from paramclient.client.component import Component
    from paramclient.service.targets import Target

__all__ = [
    "ApplyRequest",
    "Bits",
    "FetchRequest",
    "Hex",
    "MetadataRequest",
    "PlanRequest",
    "RestoreRequest",
    "SnapshotNumber",
    "SnapshotRequest",
    "Timestamp",
    "UploadedFile",
    "Value",
    "WriteManyRequest",
    "WriteOptions",
    "WriteRequest",
    "range_faults",
    "resolve_value",
    "values_set",
]

FILE_BYTES_MAX: Final = 2 * 2**20
"""Maximum size of a parameter file in bytes; a table of 10,000 parameters takes 1 MB."""
VALUES_MAX: Final = 10_000
"""Maximum number of values of a request: more than a vehicle has."""


class Body(BaseModel):
    """A request body. An unknown member is refused, so that a misspelt one is not ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Bits(Body):
    """A value by its bits, as in the member `bits` of a parameter."""

    bits: Annotated[str, Field(pattern="^[0-9a-fA-F]{1,256}$")]


class Hex(Body):
    """The bytes of a value: of an extended parameter, or the four of the message of a plain one."""

    hex: Annotated[str, Field(pattern="^([0-9a-fA-F]{2}){0,128}$")]


def _parse_timestamp(given: object) -> object:
    if not isinstance(given, str):
        return given
    try:
        return float(given)
    except ValueError:
        moment = datetime.fromisoformat(given)
        if moment.tzinfo is None:
            raise ValueError("a time needs a time zone, as in 2026-11-20T14:00:00Z") from None
        return moment.timestamp()


GivenValue: TypeAlias = int | float | str | Bits | Hex
"""A value as a request gives it."""
Name = Annotated[str, Field(min_length=1, max_length=16)]
Number: TypeAlias = StrictInt | Annotated[StrictFloat, Field(allow_inf_nan=False)]
Value = Annotated[
    Number | Annotated[str, Field(max_length=400)] | Bits | Hex,
    Field(
        description='A number, "NaN", "Infinity", the name of a value or of bits in the metadata, or '
        '{"bits": …}; of an extended parameter also text and {"hex": …}.'
    ),
]
Values = Annotated[dict[Name, Value], Field(min_length=1, max_length=VALUES_MAX)]
Seconds = Annotated[float | None, Field(gt=0, le=86_400, description="Timeout in seconds.")]
Patterns = Annotated[
    tuple[Annotated[str, Field(min_length=1, max_length=64)], ...], Field(max_length=VALUES_MAX)
]
SnapshotNumber = Annotated[int, Field(ge=1, lt=1 << 62)]
Timestamp = Annotated[
    float,
    BeforeValidator(_parse_timestamp),
    Field(
        ge=0, lt=253_402_300_800, allow_inf_nan=False, description="Unix seconds, or ISO 8601 with a zone."
    ),
]
Force = Annotated[
    bool, Field(description="Write values outside the range in the metadata, NaN and infinities.")
]
Durable = Annotated[bool, Field(description="Respond after value and history are on the disk.")]


class WriteOptions(Body):
    """Options of writes; see `Component.set`."""

    settle_s: Annotated[float, Field(ge=0, le=60)] = 0.0
    force: Force = False
    durable: Durable = False
    timeout_s: Seconds = None


class WriteRequest(WriteOptions):
    """One value."""

    value: Value


class WriteManyRequest(WriteOptions):
    """Several values, by name; written in this order, many at a time."""

    values: Values


class MetadataRequest(Body):
    """Timeout of the vehicle's responses."""

    timeout_s: Seconds = None


class FetchRequest(MetadataRequest):
    """Options of a fetch; see `Component.fetch_all`."""

    refresh: bool = False


class UploadedFile(Body):
    """A parameter file, as text or in base64. Its name can indicate its format; `component` selects a set."""

    name: Annotated[str, Field(max_length=255)] = ""
    text: Annotated[str, Field(max_length=FILE_BYTES_MAX)] | None = None
    base64: Annotated[str, Field(max_length=FILE_BYTES_MAX * 4 // 3 + 4)] | None = None
    format: FileFormat | None = None
    component: Annotated[int, Field(ge=1, le=255)] | None = None

    @model_validator(mode="after")
    def _is_one(self) -> UploadedFile:
        if (self.text is None) == (self.base64 is None):
            raise ValueError("a file needs either `text` or `base64`")
        return self

    def read(self, *, partial: bool = False) -> ParamFile:
        """Parse the file; see `files.loads`. Blocks for up to seconds.

        Raises:
            FileError: the file is invalid.
            UsageError: the member is not base64.
        """
        if self.text is not None:
            data = self.text.encode("utf-8", "surrogatepass")
        else:
            try:
                data = base64.b64decode(self.base64 or "", validate=True)
            except (binascii.Error, ValueError) as error:
                raise UsageError(f"{self.name or 'the file'} is not valid base64: {error}") from None
        return loads(data, source=self.name, file_format=self.format, partial=partial)

    def read_set(self, target: Target) -> ParamSet:
        """Parse the file, and return its set for a component; see `read`."""
        file, component = self.read(), target.component
        is_of_several = len({each.system for each in file.sets}) > 1
        chosen = component.component if self.component is None else self.component
        return file.choose(chosen, system=component.system if is_of_several else None)


class PlanRequest(Body):
    """Wanted parameters: exactly one of `values`, `file` and `snapshot`, limited to `only`."""

    values: Values | None = None
    file: UploadedFile | None = None
    snapshot: SnapshotNumber | None = None
    only: Patterns | None = None
    include: Patterns = ()
    force: Force = False

    @model_validator(mode="after")
    def _is_one(self) -> PlanRequest:
        if sum(each is not None for each in (self.values, self.file, self.snapshot)) != 1:
            raise ValueError("exactly one of `values`, `file` and `snapshot` is needed")
        return self


class ApplyRequest(PlanRequest):
    """Wanted parameters with options; see `paramclient.provision.apply`."""

    reboot: bool = False
    allow_armed: bool = False
    skip_invalid: bool = False
    durable: Durable = False
    timeout_s: Seconds = None


class RestoreRequest(Body):
    """The state to restore: a snapshot, a time, or without both the state before the last apply."""

    snapshot: SnapshotNumber | None = None
    at: Timestamp | None = None
    include: Patterns = ()
    force: Force = False
    reboot: bool = False
    allow_armed: bool = False
    dry_run: bool = False
    timeout_s: Seconds = None

    @model_validator(mode="after")
    def _is_one(self) -> RestoreRequest:
        if self.snapshot is not None and self.at is not None:
            raise ValueError("`snapshot` and `at` exclude each other")
        return self

    @property
    def when(self) -> int | float | None:
        """The number of the snapshot, the time, or None."""
        return self.at if self.snapshot is None else self.snapshot


class SnapshotRequest(Body):
    """Reason of a snapshot."""

    reason: Annotated[str, Field(min_length=1, max_length=200)]


async def values_set(values: dict[str, GivenValue], target: Target) -> ParamSet:
    """Return values as a set. Values of extended parameters take the types that the component reports.

    Raises:
        UsageError: a name or value is invalid.
        ParamClientError: the component did not send the type of an extended parameter.
    """
    found, is_extended = {}, target.component.is_extended
    for name, given in values.items():
        value = await resolve_value(target, name, given)
        if is_extended:
            number = (await _known(target.component, name)).type_number
            found[name] = WrittenParam.of(ext_param(name, encode_ext_value(value, number), number))
        else:
            found[name] = WrittenParam(check_name(name), value)
    return ParamSet(found, is_extended=is_extended)


async def resolve_value(target: Target, name: str, given: GivenValue) -> WireValue:
    """Return the value of a request. Text for a number is the number: JavaScript rounds 64-bit integers.

    Raises:
        UsageError: no value has this name, or the bits do not fit the type.
        ParamClientError: the component did not send the type of an extended parameter.
    """
    if isinstance(given, Hex):
        return bytes.fromhex(given.hex)
    if isinstance(given, Bits):
        return _value_of_bits(target.component, name, int(given.bits, 16))
    is_extended = target.component.is_extended
    if not isinstance(given, str):
        return check_ext_value(given) if is_extended else given
    if is_extended and (await _known(target.component, name)).type == ParamType.CUSTOM:
        return check_ext_value(given)
    number = number_of(given)
    if number is not None:
        return number
    info = target.info(name)
    if info is None:
        raise UsageError(f"{name}: {given!r} is not a number, and there is no metadata with names of values")
    return info.parse(given)


def _value_of_bits(component: Component, name: str, bits: int) -> WireValue:
    known = component.params.get(name)
    if known is None:
        raise UsageError(f"{name}: the type is not known; read the parameter first")
    if known.type != ParamType.CUSTOM and bits >> (32 if known.is_raw else 8 * known.type.size):
        raise UsageError(f"{name}: {bits:x} has more bits than {type_name(known.type_number)}")
    return from_bits(bits, known.type_number, is_raw=known.is_raw)


async def _known(component: Component, name: str) -> Param:
    return component.params.get(name) or await component.get(name)


def range_faults(target: Target, values: dict[str, WireValue]) -> dict[str, str]:
    """Return, by name, why values are outside the range in the metadata."""
    found = {}
    for name, value in values.items():
        info = target.info(name)
        fault = None if info is None else info.problem(value)
        if fault is not None:
            found[name] = fault
    return found
