"""Simulated vehicles, values and messages that several tests need."""

from __future__ import annotations

import struct
from dataclasses import replace
from functools import partial

from paramclient.model.values import Encoding, Param, ParamType, Trust, WireValue, encode_value
from paramclient.sim import ArduPilotVehicle
from paramclient.wire.messages import NO_INDEX, Message, ParamSet, ParamValue

__all__ = ["clamped", "is_so", "known", "listing_ardupilot", "param_value"]

listing_ardupilot = partial(ArduPilotVehicle, ftp=False)
"""An ArduPilot without MAVFTP, which gives its table by list alone."""


def param_value(
    name: str,
    value: WireValue = 0.0,
    *,
    index: int = NO_INDEX,
    count: int = 10,
    kind: int = ParamType.REAL32,
    encoding: Encoding = Encoding.BYTEWISE,
) -> ParamValue:
    """A PARAM_VALUE as a component would send it."""
    return ParamValue(name, encode_value(value, kind, encoding), kind, count, index)


def clamped(message: Message, name: str, low: float, high: float) -> Message:
    """A set of this parameter of an ArduPilot with its value in this range; any other message as it is."""
    if not isinstance(message, ParamSet) or message.param_id != name:
        return message
    (value,) = struct.unpack("<f", message.raw)
    return replace(message, raw=struct.pack("<f", min(max(value, low), high)))


def known(
    name: str, value: int | float = 0.0, *, index: int | None = 0, kind: ParamType | None = None
) -> Param:
    """A parameter as the cache may have kept it: INT32 or REAL32 by its value, unless it is said."""
    if kind is None:
        kind = ParamType.INT32 if isinstance(value, int) else ParamType.REAL32
    raw = encode_value(value, kind, Encoding.BYTEWISE)[: kind.size]
    return Param(name, value, kind, index, int.from_bytes(raw, "little"), Trust.CACHED)


def is_so(claim: bool) -> bool:
    """The claim as it is; for attributes that change behind the type checker's back."""
    return claim
