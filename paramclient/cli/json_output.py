"""JSON of parameters, sets, fetches and writes, as the command prints it and the service sends it.

A class of this module and of `json_apply` is the shape of one object. Its `of(…)` builds it
from an object of the library, and `as_json` serialises it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Self

from paramclient.model.defaults import add_default, default_of
from paramclient.model.identity import Identity, autopilot_name, version_text
from paramclient.model.notation import (
    Scalar,
    bits_text,
    bits_written,
    hash_text,
    rounded,
    time_or_none,
    time_text,
    value_json,
    value_written,
)
from paramclient.model.values import Param, ParamType, format_value, type_name
from paramclient.protocol.identity import kind_in_words

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler, TypeAdapter
    from pydantic_core import CoreSchema

    from paramclient.cache import HistoryEntry, SnapshotSummary
    from paramclient.client.component import Component
    from paramclient.metadata import Metadata, ParamInfo
    from paramclient.model.paramset import ParamSet, WrittenParam
    from paramclient.protocol.fetch import FetchResult
    from paramclient.protocol.set_results import SetOutcome

__all__ = [
    "FetchJson",
    "HistoryLineJson",
    "InfoJson",
    "Json",
    "OriginJson",
    "ParamJson",
    "SetJson",
    "SnapshotJson",
    "VehicleJson",
    "WriteJson",
    "WrittenJson",
    "as_json",
    "short_text",
]

SHORT_TEXT_LENGTH_MAX: Final = 400
"""Characters of the members `text` and `units`, which thousands of rows may repeat."""


@dataclass(frozen=True, slots=True)
class Json:
    """An object with these members in this order.

    A member with the default None is left out if it is None; a member without a default is then null. The
    name in JSON has no trailing underscore: `is_` is `is`.
    """

    @classmethod
    def take(cls, source: object, **members: Any) -> Self:
        """Return an object with these members, and with the attributes of `source` for the others."""
        names = [each.name for each in fields(cls) if each.name not in members]
        return cls(**{name: getattr(source, name) for name in names if hasattr(source, name)}, **members)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler(source)
        members: Any = handler.resolve_ref_schema(schema)
        for member in members["schema"]["fields"]:
            if member["schema"]["type"] == "default":
                member["serialization_exclude_if"] = _is_none
            if member["name"].endswith("_"):
                member["serialization_alias"] = member["name"].removesuffix("_")
        return schema


def as_json(item: object) -> Any:
    """Return objects of this module, also in lists and mappings, as objects that `json.dumps` accepts."""
    if isinstance(item, Json):
        kind: Any = type(item)  # not Hashable for mypy
        return _adapter(kind).dump_python(item, mode="json", by_alias=True)
    if isinstance(item, Mapping):
        return {str(key): as_json(value) for key, value in item.items()}
    if isinstance(item, list | tuple):
        return [as_json(each) for each in item]
    return item


@cache
def _adapter(kind: Any) -> TypeAdapter[Json]:
    from pydantic import TypeAdapter  # only here: takes a fifth of the time of a command

    return TypeAdapter(kind)


def _is_none(value: object) -> bool:
    return value is None


def short_text(text: str | None) -> str | None:
    """Return a text of metadata; None if it is empty or longer than `SHORT_TEXT_LENGTH_MAX`."""
    return text if text and len(text) <= SHORT_TEXT_LENGTH_MAX else None


# Parameters


@dataclass(frozen=True, slots=True, kw_only=True)
class InfoJson(Json):
    """The metadata of a parameter."""

    short_description: str | None = None
    long_description: str | None = None
    units: str | None = None
    minimum: Scalar | None = None
    maximum: Scalar | None = None
    increment: Scalar | None = None
    decimals: int | None = None
    default: Scalar | None = None
    values: dict[str, str] | None = None
    bits: dict[str, str] | None = None
    reboot_required: bool | None = None
    is_read_only: bool | None = None
    is_volatile: bool | None = None
    category: str | None = None
    group: str | None = None

    @classmethod
    def of(cls, info: ParamInfo) -> InfoJson:
        """Return the metadata of a parameter, without empty members."""
        named = ("short_description", "long_description", "units", "category", "group")
        flags = ("reboot_required", "is_read_only", "is_volatile")
        return cls.take(
            info,
            **{name: getattr(info, name) or None for name in (*named, *flags)},
            **{name: _number(getattr(info, name)) for name in ("minimum", "maximum", "increment", "default")},
            values={format_value(value): name for value, name in info.values.items()} or None,
            bits={str(bit): name for bit, name in info.bits.items()} or None,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ParamJson(Json):
    """One parameter of a vehicle; in the output of the command its name is the key.

    `default_source` is the origin of `default`: `vehicle` or `metadata`. `text` is the meaning of the value.
    `name`, `is_default`, `trust` and `heard_at` (unix seconds) come with parameters of a table, `metadata` on
    request.
    """

    name: str | None = None
    value: Scalar
    type: str
    index: int | None
    bits: str
    default: Scalar | None = None
    default_source: str | None = None
    is_default: bool | None = None
    trust: str | None = None
    heard_at: float | None = None
    text: str | None = None
    units: str | None = None
    metadata: InfoJson | None = None

    @classmethod
    def of(
        cls,
        param: Param,
        info: ParamInfo | None = None,
        *,
        described: int | float | None = None,
        whole: bool = False,
    ) -> ParamJson:
        """Return a parameter with its default, also that of the metadata.

        Args:
            param: the parameter.
            info: its metadata, or None.
            described: its default in the metadata, where `info` is None; or None.
            whole: whether to include all metadata.
        """
        default = default_of(param, described if info is None else info.default)
        return cls(
            value=value_json(param.settable, param.type_number),
            type=type_name(param.type_number),
            index=param.index,
            bits=bits_text(param),
            default=None if default is None else value_json(default.value, param.type_number),
            default_source=None if default is None else default.source.value,
            text=None if info is None else short_text(info.text(param.settable)),
            units=None if info is None else short_text(info.units),
            metadata=InfoJson.of(info) if info is not None and whole else None,
        )

    @classmethod
    def of_table(
        cls,
        param: Param,
        info: ParamInfo | None = None,
        *,
        described: int | float | None = None,
        heard_at: float | None = None,
        whole: bool = False,
    ) -> ParamJson:
        """Return a parameter with its name, its trust, and the unix time in seconds of its reception."""
        shown = cls.of(param, info, described=described, whole=whole)
        is_changed = add_default(param, described if info is None else info.default).is_changed
        return replace(
            shown,
            name=param.name,
            is_default=None if is_changed is None else not is_changed,
            trust=param.trust.value,
            heard_at=heard_at,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenJson(Json):
    """A parameter of a file or of another set. Without a type, `bits` is null."""

    value: Scalar
    type: str | None
    bits: str | None
    default: Scalar | None = None
    default_source: str | None = None
    comment: str | None = None
    text: str | None = None

    @classmethod
    def of(cls, param: WrittenParam, source: str | None = None) -> WrittenJson:
        """Return a parameter, with the origin of its default if that is given."""
        return replace(
            cls.compared(param),
            default=None if param.default is None else value_written(param.default, param),
            default_source=source,
            comment=param.comment or None,
        )

    @classmethod
    def compared(cls, param: WrittenParam, metadata: Metadata | None = None) -> WrittenJson:
        """Return a parameter of one side of a comparison, with the meaning of its value."""
        info = None if metadata is None else metadata.find(param.name)
        return cls(
            value=value_written(param.settable, param),
            type=None if param.type_number is None else type_name(param.type_number),
            bits=bits_written(param),
            text=None if info is None else short_text(info.text(param.settable)),
        )


# Vehicles and sets


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleJson(Json):
    """A vehicle that is written to; `firmware` is null if it is not known."""

    system: int
    component: int
    autopilot: str
    kind: str
    firmware: str | None
    uid: str | None

    @classmethod
    def of(cls, vehicle: Component) -> VehicleJson:
        """Return the vehicle of a component."""
        return cls.at(vehicle.system, vehicle.component, vehicle.identity)

    @classmethod
    def at(cls, system: int, component: int, identity: Identity) -> VehicleJson:
        """Return a vehicle by address and identity."""
        return cls(
            system=system,
            component=component,
            autopilot=autopilot_name(identity.autopilot),
            kind=kind_in_words(identity.autopilot, identity.vehicle_type),
            firmware=version_text(identity.firmware) if identity.firmware else None,
            uid=identity.uid,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class OriginJson(Json):
    """The origin of a set, and the time `at` which the vehicle had these values."""

    source: str
    system: int | None
    component: int | None
    autopilot: str | None
    uid: str | None
    at: str | None
    count: int

    @classmethod
    def of(cls, params: ParamSet) -> Self:
        """Return the origin of a set."""
        identity = params.identity
        return cls.take(
            params,
            autopilot=None if identity is None else autopilot_name(identity.autopilot),
            uid=None if identity is None else identity.uid,
            at=time_or_none(params.at),
            count=len(params),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SetJson(OriginJson):
    """A set with its parameters by name."""

    params: dict[str, WrittenJson]

    @classmethod
    def with_sources(cls, params: ParamSet, sources: Mapping[str, str]) -> SetJson:
        """Return a set, with the origins of its defaults by name where they are given."""
        written = {name: WrittenJson.of(param, sources.get(name)) for name, param in params.items()}
        return cls.take(OriginJson.of(params), params=written)


# Fetches and writes


@dataclass(frozen=True, slots=True, kw_only=True)
class FetchJson(Json):
    """A fetched table. `missing` are indices, `cached` names whose values are not confirmed.

    `changed` are names whose cached values an ArduPilot did not confirm, and which were read.
    """

    system: int
    component: int
    autopilot: str
    uid: str | None
    count: int
    received: int
    source: str
    hash: str | None
    missing: tuple[int, ...]
    cached: tuple[str, ...]
    changed: tuple[str, ...]
    lost: int
    repeated: int
    round_trip_s: float | None
    elapsed_s: float
    bytes_received: int
    bytes_sent: int
    params: dict[str, ParamJson]

    @classmethod
    def of(
        cls,
        component: Component,
        result: FetchResult,
        params: Iterable[Param],
        *,
        bytes_received: int,
        bytes_sent: int,
        described: Mapping[str, int | float],
    ) -> FetchJson:
        """Return a fetch with these parameters; `described` has defaults of the metadata by name."""
        return cls.take(
            result,
            system=component.system,
            component=component.component,
            autopilot=component.autopilot,
            uid=component.identity.uid,
            hash=hash_text(result.hash),
            round_trip_s=rounded(result.round_trip),
            elapsed_s=round(result.elapsed, 4),
            bytes_received=bytes_received,
            bytes_sent=bytes_sent,
            params={each.name: ParamJson.of(each, described=described.get(each.name)) for each in params},
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class WriteJson(Json):
    """The outcome of one write. `error` is the class of the error, `reason` its text."""

    name: str
    requested: Scalar
    actual: Scalar | None
    status: str
    reason: str | None = None
    error: str | None = None
    note: str | None = None
    text: str | None = None
    reboot_required: bool | None = None

    @classmethod
    def of(cls, outcome: SetOutcome, kind: ParamType | int, info: ParamInfo | None) -> WriteJson:
        """Return an outcome; `kind` is the vehicle's type of the parameter, `info` its metadata, or None."""
        requested, actual, error, result = outcome.requested, outcome.reported, outcome.error, outcome.result
        return cls(
            name=outcome.name,
            requested=value_json(requested, kind if isinstance(requested, bytes) else ParamType.REAL64),
            actual=None if actual is None else value_json(actual, kind),
            status=outcome.status.value,
            reason=None if error is None else str(error),
            error=None if error is None else type(error).__name__,
            note=None if result is None else result.note or None,
            text=None if info is None or actual is None else info.text(actual) or None,
            reboot_required=(info is not None and info.reboot_required) or None,
        )


# The cache


@dataclass(frozen=True, slots=True, kw_only=True)
class HistoryLineJson(Json):
    """One change of a value."""

    time: str
    component: int
    name: str
    old: Scalar
    new: Scalar | None
    by: str

    @classmethod
    def of(cls, entry: HistoryEntry) -> HistoryLineJson:
        """Return a change."""
        return cls.take(
            entry,
            time=time_text(entry.at),
            old=value_json(entry.old.settable, entry.old.type_number),
            new=None if entry.new is None else value_json(entry.new.settable, entry.new.type_number),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotJson(Json):
    """A snapshot of a table, without its parameters."""

    id: int
    time: str
    component: int
    size: int
    complete: bool
    hash: str | None
    reason: str

    @classmethod
    def of(cls, summary: SnapshotSummary) -> SnapshotJson:
        """Return a snapshot."""
        return cls.take(summary, time=time_text(summary.at), hash=hash_text(summary.hash))


def _number(number: int | float | None) -> Scalar | None:
    return None if number is None else value_json(number, ParamType.REAL64)
