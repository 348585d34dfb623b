"""The firmware's default of a parameter: that of the vehicle, else that of the metadata."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TypeVar

from paramclient.errors import UsageError
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import Param, Value, WireValue, bits_of, from_bits

AnyParam = TypeVar("AnyParam", Param, WrittenParam)


class DefaultSource(StrEnum):
    """The origin of a default.

    Attributes:
        VEHICLE: the vehicle, or the file or log that a parameter set is from, gives it with the value.
        METADATA: the metadata of the firmware. It does not have the defaults of an airframe, which PX4 sets
            by `param set-default`.
    """

    VEHICLE = "vehicle"
    METADATA = "metadata"


@dataclass(frozen=True, slots=True)
class Default:
    """The firmware's default of a parameter, as a number of the parameter's type, and its origin."""

    value: Value
    source: DefaultSource


def default_of(param: Param | WrittenParam, described: WireValue | None = None) -> Default | None:
    """Return the default of a parameter, or None if it is not known.

    Every command, the service and the page use this rule: the default that the vehicle has given, else that
    of the metadata as far as the type of the parameter can hold it.

    Args:
        param: the parameter.
        described: the default in the metadata (`ParamInfo.default`), or None.
    """
    if param.default is not None:
        return Default(param.default, DefaultSource.VEHICLE)
    if described is None or isinstance(described, bytes):
        return None
    if param.type is None:
        return Default(described, DefaultSource.METADATA)
    try:
        value = from_bits(bits_of(described, param.type), param.type)
    except UsageError:  # not in the range of the type
        return None
    return None if isinstance(value, bytes) else Default(value, DefaultSource.METADATA)


def add_default(param: AnyParam, described: WireValue | None) -> AnyParam:
    """Return a parameter with its default; see `default_of`."""
    if param.default is not None or described is None:
        return param
    default = default_of(param, described)
    return param if default is None else replace(param, default=default.value)


def add_defaults(params: ParamSet, described: Mapping[str, int | float]) -> ParamSet:
    """Return a parameter set with its defaults; see `default_of`.

    Args:
        params: the set.
        described: the defaults in the metadata by name, such as `Metadata.defaults_of`.
    """
    if not described:
        return params
    known = {name: add_default(each, described.get(name)) for name, each in params.items()}
    return replace(params, params=known)
